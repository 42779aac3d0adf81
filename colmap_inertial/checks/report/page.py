"""The page: one file that needs nothing else. Text and tables stand without scripts; plots are drawn by plotly.js."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Iterator, Sequence
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

from colmap_inertial.checks.report.figures import Figure
from colmap_inertial.checks.report.parts import Section
from colmap_inertial.checks.report.sections import sections_of

_HERE = Path(__file__).parent
#: Nothing may be loaded from anywhere, whatever the page holds. (plotly.js builds some of its shaders by evaluation.)
_POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline' 'unsafe-eval'; "
    "font-src data:"
)
_NO_SCRIPT = "The plots need JavaScript. All text and tables are complete without them."


def page_of(content: dict[str, Any], out: Path) -> str:
    """The report as HTML.

    Parameters
    ----------
    content
        As ``colmap_inertial.checks.report`` describes it.
    out
        Folder that its images' paths start from.
    """
    versions = ", ".join(f"{name} {number}" for name, number in content["versions"].items())
    made = content["made"]
    if made is not None:
        versions = f"{made['date']}, {versions}, {made['machine']}, {made['processors']} processors"
    return document(
        list(sections_of(content, out)),
        title=content["title"],
        verdict=content["outcome"]["verdict"],
        source=content["capture"],
        footer=f"{versions}. The same content for programs: report.json.",
    )


def document(sections: Sequence[Section], *, title: str, verdict: str, source: str, footer: str) -> str:
    """A whole page of sections; the texts are plain, and escaped here.

    Parameters
    ----------
    sections
        In order; the first one is the outcome, with a place for links.
    title, verdict, source, footer
        What it is about, what was found (``"trusted"``, ``"weak"``, ``"refused"`` colour the page), where it came from.
    """
    figures: dict[str, Figure] = {}
    body = "".join(_section(section, figures) for section in sections)
    title, verdict = escape(title), escape(verdict)
    links = "".join(f'<a href="#{s.anchor}">{escape(s.short)}</a>' for s in sections[1:] if s.short)
    parts = [
        "<!DOCTYPE html>",
        f'<html lang="en" class="{verdict}"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<link rel="icon" href="data:,">',
        f"<title>{title}: {verdict}</title><style>{_asset('page.css')}</style></head><body>",
        f'<header><h1>{title}</h1><p class="soft small">{escape(source)}</p></header>',
        f'<main><p id="notice" hidden></p><noscript><p>{_NO_SCRIPT}</p></noscript>',
        body.replace("<!--links-->", f"<nav>{links}</nav>" if links else "", 1),
        f"</main><footer>{escape(footer)}</footer>",
    ]
    if figures:
        packed = json.dumps(figures, separators=(",", ":"), allow_nan=False)
        parts += [
            f'<script type="application/octet-stream" id="library">{_library()}</script>',
            f'<script type="application/octet-stream" id="figures">{_packed(packed.encode())}</script>',
            f"<script>{_asset('page.js')}</script>",
        ]
    return "\n".join([*parts, "</body></html>", ""])


def _section(section: Section, figures: dict[str, Figure]) -> str:
    """A section's HTML; its figures get a place, and are kept."""
    return (
        f'<section id="{section.anchor}" class="{section.classes}">'
        + "".join(_placed(section, figures))
        + "</section>\n"
    )


def _placed(section: Section, figures: dict[str, Figure]) -> Iterator[str]:
    for part in section.parts:
        if isinstance(part, str):
            yield part
            continue
        key = f"f{len(figures)}"
        figures[key] = part.figure
        height = part.figure["layout"]["height"]
        label = escape(part.label, quote=True)
        place = f'data-figure="{key}" style="min-height:{height}px"'
        yield f'<div class="plot" {place} role="img" aria-label="{label}"></div>'


@cache
def _asset(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


@cache
def _library() -> str:
    """plotly.js, packed: it is five megabytes long."""
    from plotly.offline import get_plotlyjs

    return _packed(get_plotlyjs().encode())


def _packed(data: bytes) -> str:
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode("ascii")
