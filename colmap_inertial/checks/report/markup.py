"""Pieces of HTML. They take plain text and escape it."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.checks.report.words import digits
from colmap_inertial.inertial.scale.verdict import TRUSTED_HALF_WIDTH, WEAK_HALF_WIDTH
from colmap_inertial.io.files import read_bytes
from colmap_inertial.io.images import require_modest
from colmap_inertial.io.names import path_in

_UNIT = re.compile(r"(\d) ((?:m|cm|mm|s|ms|px|Hz|m/s²|°/s)\b|%)")
#: Images are embedded no wider than this.
_WIDTH_PX, _QUALITY = 720, 78
#: Half-widths of the 95 % interval, per cent, up to which a scale is trusted, and given at all.
_TRUSTED_PCT, _WEAK_PCT = 100 * TRUSTED_HALF_WIDTH, 100 * WEAK_HALF_WIDTH


def prose(text: str) -> str:
    """Text for a paragraph: escaped, numbers kept on one line with their units."""
    return _UNIT.sub("\\1\N{NO-BREAK SPACE}\\2", escape(text.replace("m/s2", "m/s²").replace("+-", "±")))


def sentence(text: str) -> str:
    """The same, with a capital letter and a full stop."""
    text = text.strip()
    return prose(text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else "."))


def scale_text(model: Mapping[str, Any]) -> str:
    """The scale, in short."""
    return prose(f"1 model unit = {digits(model['metres_per_unit'])} m ±{digits(model['half_width_pct'], 2)} %")


def gauge(half_width_pct: float) -> str:
    """Where the half-width of the interval lies between a tenth of a per cent and a hundred, as an image."""
    left, width, top = 10.0, 480.0, 26.0

    def at(pct: float) -> float:
        return left + width * (min(max(math.log10(pct), -1.0), 2.0) + 1) / 3

    zones = (
        (0.1, _TRUSTED_PCT, "good", "trusted"),
        (_TRUSTED_PCT, _WEAK_PCT, "warn", "weak"),
        (_WEAK_PCT, 100.0, "bad", "refused"),
    )
    here = at(max(half_width_pct, 1e-9))
    parts = [f'<svg class="gauge" viewBox="0 0 500 66" role="img" aria-label="±{digits(half_width_pct, 2)} %">']
    for low, high, tone, name in zones:
        x, end = at(low), at(high)
        parts.append(
            f'<rect x="{x:.1f}" y="{top}" width="{end - x - 2:.1f}" height="10" rx="3" style="fill:var(--{tone})"/>'
            f'<text x="{(x + end) / 2:.1f}" y="{top + 26}" text-anchor="middle">{name}</text>'
        )
    for pct in (_TRUSTED_PCT, _WEAK_PCT):
        parts.append(f'<text x="{at(pct) - 1:.1f}" y="{top + 40}" text-anchor="middle">±{pct:g} %</text>')
    anchor = "start" if here < 60 else "end" if here > 440 else "middle"
    parts.append(
        f'<path class="marker" d="M{here - 6:.1f} {top - 9} h12 l-6 9 z"/>'
        f'<text class="value" x="{here:.1f}" y="{top - 13}" text-anchor="{anchor}">'
        f"±{digits(half_width_pct, 2)} %</text>"
    )
    return "".join([*parts, "</svg>"])


def listing(sentences: Iterable[str]) -> str:
    """A list."""
    return "<ul>" + "".join(f"<li>{sentence(s)}</li>" for s in sentences) + "</ul>"


def facts(pairs: Iterable[tuple[str, str]]) -> str:
    """Labelled values, side by side."""
    inner = "".join(f"<div><dt>{escape(label)}</dt><dd>{prose(value)}</dd></div>" for label, value in pairs)
    return f'<dl class="facts">{inner}</dl>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: Sequence[int] = ()) -> str:
    """A table; columns of ``numbers`` are set flush right."""

    def cells(tag: str, row: Sequence[str]) -> str:
        flush = [' class="n"' if i in numbers else "" for i in range(len(row))]
        return "".join(f"<{tag}{f}>{escape(cell)}</{tag}>" for f, cell in zip(flush, row, strict=True))

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{cells("th", head)}</tr></thead><tbody>{body}</tbody></table></div>'


def bars(seconds: Mapping[str, float]) -> str:
    """Times as bars."""
    longest = max(max(seconds.values()), 1e-9)
    rows = []
    for name, value in seconds.items():
        width = 100 * value / longest
        rows.append(
            f'<b class="soft">{escape(name)}</b><div><i style="width:{width:.1f}%"></i></div><span>{value:.1f} s</span>'
        )
    return f'<div class="bars">{"".join(rows)}</div>'


def images(out: Path, paths: Sequence[str], *, classes: str = "pictures", captions: Sequence[str] | None = None) -> str:
    """Images side by side, embedded; those that are gone are left out."""
    shown = []
    for i, path in enumerate(paths):
        data = _embedded(path_in(out, path))
        if data is not None:
            name = captions[i] if captions else Path(path).stem
            label = escape(name, quote=True)
            shown.append(f'<figure><img src="{data}" alt="{label}"><figcaption>{label}</figcaption></figure>')
    return f'<div class="{classes}">{"".join(shown)}</div>' if shown else ""


def _embedded(path: Path) -> str | None:
    import cv2

    if not path.is_file():
        return None
    data = read_bytes(path)
    require_modest(path, data)
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        return None
    height, width = image.shape[:2]
    if width > _WIDTH_PX:
        image = cv2.resize(image, (_WIDTH_PX, round(height * _WIDTH_PX / width)), interpolation=cv2.INTER_AREA)
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode('ascii')}"
