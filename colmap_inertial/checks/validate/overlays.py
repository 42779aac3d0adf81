"""Images of a validation: the corners on the frames, and measured against known distances."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.checks.validate.result import Validation, ViewResiduals
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.geometry import opencv_px_from_colmap

#: Residuals are drawn this many times longer than they are.
MAGNIFIED = 30

_GREEN, _RED, _ORANGE, _WHITE = (80, 220, 60), (60, 60, 240), (0, 165, 255), (255, 255, 255)
_COLOURS = {"control": "#1f77b4", "check": "#d95f02", "mixed": "#999999"}


def write_overlays(validation: Validation, images: Path, folder: Path, *, most_frames: int = 12) -> list[Path]:
    """Write ``distances.svg`` and one JPEG for each of some frames into a folder.

    On the frames: circles where corners were seen, lines to where the fitted target projects (30 times longer than
    they are), orange crosses on corners that were not used. The frames are taken evenly, the one with the largest
    residuals among them.

    Parameters
    ----------
    validation
        What to show.
    images
        The folder that was validated.
    folder
        Where to write; made if absent. Files of the same names are replaced.
    most_frames
        Number of frames.

    Returns
    -------
    The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    chart = folder / "distances.svg"
    chart.write_text(distance_chart(validation), encoding="utf-8")
    order = np.argsort([view.rms_px for view in validation.views])
    picked = {int(order[-1])}
    for i in np.linspace(0, len(order) - 1, most_frames).round().astype(int):
        if len(picked) < most_frames:
            picked.add(int(i))
    out = [chart]
    for i in sorted(picked):
        view = validation.views[i]
        path = folder / (view.name.replace("/", "_").rsplit(".", 1)[0] + ".jpg")
        _write_frame(view, images / view.name, path)
        out.append(path)
    return out


def _write_frame(view: ViewResiduals, source: Path, path: Path) -> None:
    import cv2

    image = cv2.imread(str(source), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise FormatError(source, "the image cannot be read any more")
    size = max(image.shape[:2]) / 1000
    line, radius = max(1, round(1.2 * size)), max(3, round(5 * size))
    seen, expected = opencv_px_from_colmap(view.observed_px), opencv_px_from_colmap(view.projected_px)
    for a, b in zip(seen, expected, strict=True):
        cv2.circle(image, *_fixed(a, radius), _GREEN, line, cv2.LINE_AA, _SHIFT)
        end = a + MAGNIFIED * (b - a)
        cv2.line(image, _fixed(a)[0], _fixed(end)[0], _RED, line, cv2.LINE_AA, _SHIFT)
    for a in opencv_px_from_colmap(view.rejected_px):
        cv2.drawMarker(image, (round(a[0]), round(a[1])), _ORANGE, cv2.MARKER_TILTED_CROSS, 3 * radius, 2 * line)
    words = f"{view.name}: {len(view.corner)} corners, rms {view.rms_px:.2f} px, residuals x{MAGNIFIED}"
    if len(view.rejected_px):
        words += f", {len(view.rejected_px)} not used"
    scale = 0.6 * max(size, 0.6)
    (width, height), base = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, scale, line)
    if width > image.shape[1] - 16:
        scale *= (image.shape[1] - 16) / width
    bottom = image.shape[0] - base - 4
    image[bottom - height - 6 :] = image[bottom - height - 6 :] // 3
    cv2.putText(image, words, (8, bottom), cv2.FONT_HERSHEY_SIMPLEX, scale, _WHITE, line, cv2.LINE_AA)
    if not cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 90]):
        raise FormatError(path, "the picture cannot be written")


_SHIFT = 4


def _fixed(xy: Array, radius: int = 0) -> tuple[tuple[int, int], int]:
    """Position and radius in OpenCV's fixed-point drawing coordinates."""
    return (round(float(xy[0]) * 2**_SHIFT), round(float(xy[1]) * 2**_SHIFT)), radius * 2**_SHIFT


def distance_chart(validation: Validation) -> str:
    """An SVG: measured against known distances, and their differences, in millimetres."""
    from xml.sax.saxutils import escape

    known = np.array([d.known_m for d in validation.distances]) * 1000
    residual = np.array([d.residual_m for d in validation.distances]) * 1000
    sets = [d.set for d in validation.distances]
    title = f"{validation.target.spec}: "
    if validation.scale_error_pct is not None and validation.ci95_pct is not None:
        low, high = validation.ci95_pct
        title += f"scale error {validation.scale_error_pct:+.3f} % (95 %: {low:+.3f} to {high:+.3f})"
    else:
        title += f"{validation.metres_per_unit:.6g} metres per unit"
    legend = sorted(set(sets), key=list(_COLOURS).index)
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1000 440" font-family="sans-serif" font-size="13">',
        '<rect width="1000" height="440" fill="white"/>',
        f'<text x="500" y="24" font-size="15" text-anchor="middle">{escape(title)}</text>',
    ]
    for i, name in enumerate(legend):
        parts.append(f'<circle cx="{70 + 100 * i}" cy="46" r="4" fill="{_COLOURS[name]}"/>')
        parts.append(f'<text x="{80 + 100 * i}" y="50">{name}</text>')
    if len(known):
        top = 1.05 * float(max(known.max(), (known + residual).max()))
        measured = _Axes(70, (0.0, top), (0.0, top), "measured, mm")
        parts += _panel(measured, known, known + residual, sets, end_mm=top)
        low, high = min(float(residual.min()), 0.0), max(float(residual.max()), 0.0)
        rim = 0.1 * max(high - low, 1e-6)
        differences = _Axes(570, (0.0, top), (low - rim, high + rim), "measured - known, mm")
        parts += _panel(differences, known, residual, sets, end_mm=0.0)
    return "\n".join([*parts, "</svg>\n"])


@dataclass(frozen=True)
class _Axes:
    """Where a chart's left edge is, what its axes reach from and to, and the name of the upright one."""

    left: int
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    label: str


def _panel(axes: _Axes, x: Array, y: Array, sets: list[Any], *, end_mm: float) -> list[str]:
    """One chart of 400 x 300 with axes, and a line from 0 to ``end_mm`` at the right edge."""
    left, x_range, y_range = axes.left, axes.x_range, axes.y_range
    top, width, height = 70, 400, 300

    def px(value: float) -> float:
        return left + width * (value - x_range[0]) / (x_range[1] - x_range[0])

    def py(value: float) -> float:
        return top + height * (1 - (value - y_range[0]) / (y_range[1] - y_range[0]))

    out = [f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="none" stroke="#444"/>']
    for tick in _ticks(*x_range):
        out.append(
            f'<line x1="{px(tick):.1f}" y1="{top + height}" x2="{px(tick):.1f}" y2="{top + height + 5}" stroke="#444"/>'
        )
        out.append(f'<text x="{px(tick):.1f}" y="{top + height + 20}" text-anchor="middle">{tick:g}</text>')
    for tick in _ticks(*y_range):
        out.append(f'<line x1="{left}" y1="{py(tick):.1f}" x2="{left + width}" y2="{py(tick):.1f}" stroke="#ddd"/>')
        out.append(f'<text x="{left - 6}" y="{py(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>')
    out.append(
        f'<line x1="{px(x_range[0]):.1f}" y1="{py(0.0):.1f}" x2="{px(x_range[1]):.1f}" y2="{py(end_mm):.1f}" '
        'stroke="#444" stroke-dasharray="4 3"/>'
    )
    for a, b, name in zip(x.tolist(), y.tolist(), sets, strict=True):
        out.append(f'<circle cx="{px(a):.1f}" cy="{py(b):.1f}" r="2.5" fill="{_COLOURS[name]}" fill-opacity="0.6"/>')
    out.append(f'<text x="{left + width / 2}" y="{top + height + 42}" text-anchor="middle">known, mm</text>')
    middle = top + height / 2
    out.append(
        f'<text x="{left - 48}" y="{middle}" text-anchor="middle" transform="rotate(-90 {left - 48} {middle})">'
        f"{axes.label}</text>"
    )
    return out


def _ticks(low: float, high: float) -> list[float]:
    """Four to ten round numbers inside a range."""
    raw = (high - low) / 6
    power = 10 ** np.floor(np.log10(raw))
    step = float(power * min((1, 2, 5, 10), key=lambda m: abs(np.log(m * power / raw))))
    first = int(np.ceil(low / step - 1e-9))
    return [round(i * step, 12) for i in range(first, int(np.floor(high / step + 1e-9)) + 1)]
