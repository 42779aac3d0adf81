"""Images of a validation: the corners on the frames, and measured against known distances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import opencv_px_from_colmap
from colmap_inertial.validate.result import Validation, ViewResiduals

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
        raise FormatError(source, Fact("image-gone"))
    size = max(image.shape[:2]) / 1000
    line, radius = max(1, round(1.2 * size)), max(3, round(5 * size))
    seen, expected = opencv_px_from_colmap(view.observed_px), opencv_px_from_colmap(view.projected_px)
    for a, b in zip(seen, expected, strict=True):
        cv2.circle(image, *_convert_to_fixed_point(a, radius), _GREEN, line, cv2.LINE_AA, _SHIFT)
        end = a + MAGNIFIED * (b - a)
        cv2.line(image, _convert_to_fixed_point(a)[0], _convert_to_fixed_point(end)[0], _RED, line, cv2.LINE_AA, _SHIFT)
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
        raise FormatError(path, Fact("picture-not-written"))


_SHIFT = 4


def _convert_to_fixed_point(xy: Array, radius: int = 0) -> tuple[tuple[int, int], int]:
    """Position and radius in OpenCV's fixed-point drawing coordinates."""
    return (round(float(xy[0]) * 2**_SHIFT), round(float(xy[1]) * 2**_SHIFT)), radius * 2**_SHIFT


def distance_chart(validation: Validation) -> str:
    """An SVG: measured against known distances, and their differences, in millimetres."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    known = np.array([d.known_m for d in validation.distances]) * 1000
    residual = np.array([d.residual_m for d in validation.distances]) * 1000
    sets = [d.set for d in validation.distances]
    title = f"{validation.target.spec}: "
    if validation.scale_error_pct is not None and validation.ci95_pct is not None:
        low, high = validation.ci95_pct
        title += f"scale error {validation.scale_error_pct:+.3f} % (95 %: {low:+.3f} to {high:+.3f})"
    else:
        title += f"{validation.metres_per_unit:.6g} metres per unit"
    panels = []
    if len(known):
        top = 1.05 * float(max(known.max(), (known + residual).max()))
        low, high = min(float(residual.min()), 0.0), max(float(residual.max()), 0.0)
        rim = 0.1 * max(high - low, 1e-6)
        panels = [
            _Panel(70, top, (0.0, top), "measured, mm", top, list(zip(known, known + residual, sets, strict=True))),
            _Panel(
                570,
                top,
                (low - rim, high + rim),
                "measured - known, mm",
                0.0,
                list(zip(known, residual, sets, strict=True)),
            ),
        ]
    templates = PackageLoader("colmap_inertial.validate")
    environment = Environment(
        loader=templates, autoescape=True, undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    legend = sorted(set(sets), key=list(_COLOURS).index)
    return environment.get_template("distances.svg").render(title=title, legend=legend, colours=_COLOURS, panels=panels)


@dataclass(frozen=True)
class _Panel:
    """One chart: left edge, reach of its axes, name of the upright one, end of the line of no error, points."""

    left: int
    x_end: float
    y_range: tuple[float, float]
    label: str
    line_end: float
    points: Sequence[tuple[float, float, str]]

    def x(self, value: float) -> float:
        """Pixels from the left."""
        return self.left + 400 * value / self.x_end

    def y(self, value: float) -> float:
        """Pixels from the top."""
        return 70 + 300 * (1 - (value - self.y_range[0]) / (self.y_range[1] - self.y_range[0]))

    def ticks(self) -> tuple[list[float], list[float]]:
        """Round numbers along both axes."""
        return _ticks(0.0, self.x_end), _ticks(*self.y_range)


def _ticks(low: float, high: float) -> list[float]:
    """Four to ten round numbers inside a range."""
    raw = (high - low) / 6
    power = 10 ** np.floor(np.log10(raw))
    step = float(power * min((1, 2, 5, 10), key=lambda m: abs(np.log(m * power / raw))))
    first = int(np.ceil(low / step - 1e-9))
    return [round(i * step, 12) for i in range(first, int(np.floor(high / step + 1e-9)) + 1)]
