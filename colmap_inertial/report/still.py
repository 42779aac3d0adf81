"""Figures as still pictures (SVG) for paper, for browsers without scripts, and until plotly.js has drawn them.

They are drawn from the same specifications, as far as the report's own figures use them. Text, grid and axes take the
page's colours, so that they follow a dark screen.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from colmap_inertial.report.figures import IMU, Figure
from colmap_inertial.report.series import thin_line
from colmap_inertial.report.still_axes import Axis, choose_axis, equalise

#: A polygon's or line's corners (px).
Corners = Sequence[tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class StillStyle:
    """Lengths of still plots (px); a page shows them as wide as it is, paper as they are."""

    width: int = 640
    font: int = 13
    #: Width of a letter, on average.
    letter: float = 6.7
    #: Beside the plots: tick labels and titles.
    left: int = 62
    right: int = 14
    right_axis: int = 62
    bottom: int = 46
    legend_row: int = 20
    #: Between ticks.
    ticks_x: float = 75.0
    ticks_y: float = 38.0
    #: Of more dots only every n-th is drawn, and lines are thinned to so many points: two for each pixel across.
    most_dots: int = 1000
    line_points: int = 600
    #: Colours of a table.
    colours: int = 24


STYLE = StillStyle()


def draw_still(figure: Figure, label: str) -> str:
    """A flat figure as an SVG element; ``label`` is for those who cannot see it."""
    layout, data = figure["layout"], figure["data"]
    legend, rows = _legend(data, layout)
    height = layout["height"]
    top = 10 + STYLE.legend_row * rows
    panels = list(_panels(layout, data, top, height - STYLE.bottom))
    parts = [*legend]
    for x, y, spec_y, traces, is_lowest in panels:
        parts += _shapes(layout, x, y)
        for spec, axis, along_x in ((layout["xaxis"], x, True), (spec_y, y, False)):
            parts += _axis(spec, axis, y if along_x else x, along_x=along_x, named=is_lowest or not along_x)
        for trace in traces:
            parts += _trace(trace, x, y)
    return wrap_svg(parts, STYLE.width, height, label)


def wrap_svg(parts: Sequence[str], width: int, height: int, label: str) -> str:
    """An SVG element of these parts."""
    head = f'<svg class="still" viewBox="0 0 {width} {height}" role="img" aria-label="{escape(label)}">'
    return f"{head}{''.join(parts)}</svg>"


def _panels(layout: Figure, data: Sequence[Figure], top: float, bottom: float) -> Iterator[tuple[Any, ...]]:
    """Axes and traces that are drawn over each other; those with an axis on the right come a second time."""
    names = dict.fromkeys(["y", *(trace.get("yaxis", "y") for trace in data)])
    specs = {name: layout.get(f"yaxis{name[1:]}", {}) for name in names}
    right = STYLE.width - _right_margin(specs.values(), data)
    lowest = min(spec.get("domain", (0, 1))[0] for spec in specs.values())
    x_spec = layout["xaxis"]
    lines = all(trace["type"] == "scatter" and trace.get("mode") == "lines" for trace in data)
    x_all = choose_axis(x_spec, (_column(trace, "x") for trace in data), STYLE.left, right, pad=0.0 if lines else 0.02)
    for name, spec in specs.items():
        traces = [trace for trace in data if trace.get("yaxis", "y") == name]
        domain = spec.get("domain") or specs.get(spec.get("overlaying", ""), {}).get("domain") or (0, 1)
        low, high = (bottom - share * (bottom - top) for share in domain)
        y = choose_axis(spec, (_column(trace, "y") for trace in traces), low, high, pad=0.06)
        x = x_all
        if spec.get("scaleanchor"):
            x, y = equalise(x, y)
        yield x, y, spec, traces, domain[0] == lowest and spec.get("side") != "right"


def _right_margin(axes: Iterable[Figure], data: Sequence[Figure]) -> int:
    """Room for an axis on the right, or for the colours of a table."""
    wide = any(spec.get("side") == "right" for spec in axes) or any("colorbar" in trace for trace in data)
    return STYLE.right_axis if wide else STYLE.right


def _column(trace: Figure, name: str) -> list[Any]:
    """Values that an axis has to reach: with their intervals, whole cells of a table, bars from zero."""
    if trace["type"] == "heatmap":
        count = len(trace["z"]) if name == "y" else len(trace["z"][0])
        if name in trace:
            first, step = trace[name][0], trace[name][1] - trace[name][0] if count > 1 else 1.0
        else:
            first, step = trace[f"{name}0"], trace[f"d{name}"]
        return [first - 0.5 * step, first + (count - 0.5) * step]
    values = list(trace[name])
    if trace["type"] == "bar":
        numbers = name == "x" and values and not isinstance(values[0], str)
        return [*values, 0] if name == "y" else [*values, values[0] - 0.5, values[-1] + 0.5] if numbers else values
    reach = trace.get(f"error_{name}", {}).get("array")
    if reach:
        values += [v + sign * r for v, r in zip(values, reach, strict=True) for sign in (-1, 1)]
    return values


def _axis(spec: Figure, axis: Axis, across: Axis, *, along_x: bool, named: bool) -> Iterator[str]:
    """Grid, tick labels and title."""
    on_right = spec.get("side") == "right"
    low, high = sorted((across.begin, across.end))
    for at, text in axis.ticks(STYLE.ticks_x if along_x else STYLE.ticks_y):
        if spec.get("showgrid", True):
            is_zero = spec.get("zeroline") and text.strip("0.") == ""
            ends = ((at, low), (at, high)) if along_x else ((low, at), (high, at))
            yield draw_line(ends, css="zero" if is_zero else "grid")
        if named and along_x:
            yield draw_text(at, max(across.begin, across.end) + 17, text, anchor="middle")
        elif not along_x:
            side = (high + 6, "start") if on_right else (low - 6, "end")
            yield draw_text(side[0], at + 4, text, anchor=side[1])
    title = spec.get("title", {}).get("text", "")
    middle = 0.5 * (axis.begin + axis.end)
    if along_x and named:
        yield draw_text(middle, max(across.begin, across.end) + 37, title, anchor="middle", css="title")
    elif not along_x and title:
        at = STYLE.width - 4 if on_right else 13
        yield draw_text(at, middle, title, anchor="middle", css="title", turned=True)


def _trace(trace: Figure, x: Axis, y: Axis) -> Iterator[str]:
    kind = trace["type"]
    if kind == "bar":
        yield from _bars(trace, x, y)
    elif kind == "heatmap":
        yield from _cells(trace, x, y)
    elif trace.get("mode") == "lines":
        look = trace["line"]
        yield draw_line(
            *_runs(_thin(trace), x, y), colour=look["color"], width=look["width"], opacity=trace.get("opacity", 1.0)
        )
    else:
        yield from _dots(trace, x, y)


def _thin(trace: Figure) -> Figure:
    """A line over time without what is finer than the picture; others stay as they are."""
    if len(trace["x"]) <= STYLE.line_points or None in trace["x"]:
        return trace
    x, y = (np.array(trace[name], dtype=np.float64) for name in "xy")
    if not np.all(np.diff(x) >= 0):
        return trace
    line = thin_line(x, y, STYLE.line_points)
    return {**trace, "x": line["t_s"], "y": line["values"]}


def _runs(trace: Figure, x: Axis, y: Axis) -> Iterator[Corners]:
    """Pieces of a line between its gaps."""
    run: list[tuple[float, float]] = []
    for value_x, value_y in zip(trace["x"], trace["y"], strict=True):
        at = x.place(value_x), y.place(value_y)
        if at[0] is not None and at[1] is not None:
            run.append((at[0], at[1]))
        elif run:
            yield run
            run = []
    if run:
        yield run


def _dots(trace: Figure, x: Axis, y: Axis) -> Iterator[str]:
    look = trace["marker"]
    dots = [corner for run in _runs(trace, x, y) for corner in run]
    for name, axis in (("x", x), ("y", y)):
        error: Figure = trace.get(f"error_{name}", {"array": ()})
        for (at_x, at_y), reach in zip(dots, error["array"], strict=bool(error["array"])):
            half = reach * axis.px_per_unit
            ends = (at_x - half, at_y), (at_x + half, at_y)
            ends = ends if name == "x" else ((at_x, at_y - half), (at_x, at_y + half))
            yield draw_line(ends, colour=error["color"], width=error["thickness"])
    # a line of no length with round ends is a dot
    shown = ([dot, dot] for dot in dots[:: -(-len(dots) // STYLE.most_dots) or 1])
    yield draw_line(*shown, colour=look["color"], width=0.8 * look["size"], opacity=look.get("opacity", 1.0))


def _bars(trace: Figure, x: Axis, y: Axis) -> Iterator[str]:
    zero, half = y.place(0) or y.begin, 0.4 * x.px_per_unit
    for value_x, value_y in zip(trace["x"], trace["y"], strict=True):
        at, top = x.place(value_x), y.place(value_y)
        if at is not None and top is not None:
            yield _box(at - half, top, at + half, zero, trace["marker"]["color"])


def _cells(trace: Figure, x: Axis, y: Axis) -> Iterator[str]:
    """The cells of a table by colour, and what the colours mean."""
    table = trace["z"]
    known = [value for row in table for value in row if value is not None]
    low, high = trace.get("zmin", min(known, default=0)), max(known, default=1)
    (x0, x1), (y0, y1) = _column(trace, "x"), _column(trace, "y")
    edges_x = [x.place(x0 + (x1 - x0) * i / len(table[0])) or 0.0 for i in range(len(table[0]) + 1)]
    edges_y = [y.place(y0 + (y1 - y0) * i / len(table)) or 0.0 for i in range(len(table) + 1)]
    cells: dict[int, list[str]] = {}
    for r, row in enumerate(table):
        for c, value in enumerate(row):
            if value is not None:
                level = min(int((value - low) / ((high - low) or 1) * STYLE.colours), STYLE.colours - 1)
                (left, right), (top, bottom) = edges_x[c : c + 2], edges_y[r : r + 2]
                cells.setdefault(level, []).append(f"M{left:.4g} {top:.4g}H{right:.4g}V{bottom:.4g}H{left:.4g}z")
    colours = [_mix(trace["colorscale"], (level + 0.5) / STYLE.colours) for level in range(STYLE.colours)]
    yield from (f'<path fill="{colours[level]}" d="{"".join(paths)}"/>' for level, paths in sorted(cells.items()))
    left, bottom, top = STYLE.width - STYLE.right_axis + 12.0, max(y.begin, y.end), min(y.begin, y.end)
    for i, colour in enumerate(colours):
        ends = [bottom + (top - bottom) * k / STYLE.colours for k in (i, i + 1)]
        yield _box(left, ends[0], left + 12, ends[1], colour)
    bar = Axis(low=low, high=high if high > low else low + 1, begin=bottom, end=top)
    yield from (draw_text(left + 16, at + 4, text) for at, text in bar.ticks(STYLE.ticks_y))
    yield draw_text(STYLE.width - 4, top - 8, trace["colorbar"]["title"]["text"], anchor="end")


def _mix(scale: Sequence[Sequence[Any]], share: float) -> str:
    """A colour between those of a scale."""
    share = min(max(share, 0.0), 1.0)
    (low, first), (high, second) = next((a, b) for a, b in itertools.pairwise(scale) if share <= b[0] or b is scale[-1])
    part = (share - low) / (high - low)
    ends = ([int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in (first, second))
    return "#" + "".join(f"{round(a + part * (b - a)):02x}" for a, b in zip(*ends, strict=True))


def _shapes(layout: Figure, x: Axis, y: Axis) -> Iterator[str]:
    for shape in layout.get("shapes", ()):
        ends = (x.begin, x.end) if shape.get("xref") == "paper" else (x.place(shape["x0"]), x.place(shape["x1"]))
        across, down = sorted(v or 0.0 for v in ends), (y.place(shape["y0"]) or 0.0, y.place(shape["y1"]) or 0.0)
        colour, width = shape["line"].get("color", "none"), shape["line"].get("width", 1)
        corners = across[0], down[0], across[1], down[1]
        fill = shape.get("fillcolor", "none")
        yield _box(*corners, fill, opacity=shape.get("opacity", 1.0), edge=colour if width else "none")


def _legend(data: Sequence[Figure], layout: Figure) -> tuple[list[str], int]:
    """Names with their colours, from the left, and the number of rows that they take."""
    named = [trace for trace in data if trace.get("showlegend", True) and trace.get("name")]
    if layout.get("showlegend") is False or (len(data) == 1 and not layout.get("showlegend")):
        return [], 0
    left, row, parts = float(STYLE.left), 0, list[str]()
    for trace in named:
        width = 34 + STYLE.letter * len(trace["name"])
        if left + width > STYLE.width and left > STYLE.left:
            left, row = float(STYLE.left), row + 1
        at = 12 + STYLE.legend_row * row
        colour = (trace.get("line") or trace["marker"]).get("color", IMU)
        parts += [draw_line(((left, at), (left + 16, at)), colour=colour, width=4)]
        parts += [draw_text(left + 22, at + 4.5, trace["name"], css="title")]
        left += width
    return parts, row + 1 if parts else 0


def draw_line(*runs: Corners, colour: str = "", width: float = 1.0, opacity: float = 1.0, css: str = "") -> str:
    """Lines through some corners."""
    path = "".join("M" + "L".join(f"{a:.4g} {b:.4g}" for a, b in run) for run in runs)
    if css:
        return f'<path class="{css}" d="{path}"/>'
    look = f'stroke="{colour}" stroke-width="{width:.3g}"' + (f' opacity="{opacity:g}"' if opacity < 1 else "")
    return f'<path d="{path}" fill="none" {look} stroke-linecap="round" stroke-linejoin="round"/>'


def _box(x0: float, y0: float, x1: float, y1: float, fill: str, *, opacity: float = 1.0, edge: str = "none") -> str:
    (left, right), (top, bottom) = sorted((x0, x1)), sorted((y0, y1))
    place = f'x="{left:.4g}" y="{top:.4g}" width="{right - left:.4g}" height="{bottom - top:.4g}"'
    look = f'fill="{fill}"' + (f' opacity="{opacity:g}"' if opacity < 1 else "")
    return f"<rect {place} {look}{f' stroke={edge!r}' if edge != 'none' else ''}/>".replace("'", '"')


def draw_text(x: float, y: float, text: str, *, anchor: str = "start", css: str = "tick", turned: bool = False) -> str:
    """Words at a place."""
    turn = f' transform="rotate(-90 {x:.4g} {y:.4g})"' if turned else ""
    return f'<text class="{css}" x="{x:.4g}" y="{y:.4g}" text-anchor="{anchor}"{turn}>{escape(text)}</text>'
