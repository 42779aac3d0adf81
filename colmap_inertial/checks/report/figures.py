"""Figures as plain plotly.js specifications; the page colours text and grids for light and dark itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from colmap_inertial.checks.words import digits
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.inertial.scale.verdict import WEAK_HALF_WIDTH, half_width

Figure = dict[str, Any]
Lines = Sequence[dict[str, list[float | None]]]

CAMERA, IMU, OTHER, GOOD, BAD, QUIET = "#e07b1a", "#3f87cf", "#8a63c7", "#2f9e6e", "#d64550", "#8b93a1"
_TIME = "time since the first frame (s)"
_ACTIONS = {
    "passed": ("as filmed", QUIET),
    "deblurred": ("deblurred", IMU),
    "changed": ("changed", OTHER),
    "dropped": ("left out", BAD),
}
_SETS = {"control": IMU, "check": CAMERA, "mixed": QUIET}
#: Acceleration that filming by hand reaches, so that less looks like less.
_HAND_M_S2 = 1.0
#: Known distances that are drawn.
_MOST_DISTANCES = 1500


def _layout(height: int, **more: Any) -> Figure:
    return {
        "height": height,
        "margin": {"l": 58, "r": 12, "t": 34, "b": 46},
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom", "xanchor": "left"},
        "hovermode": "closest",
        **more,
    }


def _line(line: dict[str, Any], name: str, colour: str, **more: Any) -> Figure:
    return {
        "type": "scatter",
        "mode": "lines",
        "x": line["t_s"],
        "y": line["values"],
        "name": name,
        "legendgroup": name,
        "line": {"color": colour, "width": 1.4},
        "connectgaps": False,
        **more,
    }


def _dots(name: str, points: Sequence[tuple[float, float, str]], colour: str, opacity: float, tip: str) -> Figure:
    """Points (x, y, text) that say what they are when pointed at."""
    x, y, text = (list(column) for column in zip(*points, strict=True))
    marker = {"color": colour, "size": 6, "opacity": opacity}
    named = {"type": "scatter", "mode": "markers", "name": name, "text": text, "hovertemplate": tip}
    return {**named, "x": x, "y": y, "marker": marker}


def _axis(title: str, **more: Any) -> Figure:
    return {"title": {"text": title}, **more}


def _right_axis(title: str, overlaying: str, **more: Any) -> Figure:
    return {"overlaying": overlaying, "side": "right", "showgrid": False, **_axis(title), **more}


def _scaled(lines: Lines, factor: float) -> list[dict[str, Any]]:
    return [
        {"t_s": line["t_s"], "values": [None if v is None else round(v * factor, 5) for v in line["values"]]}
        for line in lines
    ]


def _rows(
    sides: Sequence[tuple[str, str, Lines, str]], titles: Sequence[str], *, unit: str, right_unit: str = ""
) -> Figure:
    """Rows over one time axis; a side is name, colour, a line for each row, and its axis (``"left"``, ``"right"``)."""
    gap, count = 0.05, len(titles)
    size = (1 - gap * (count - 1)) / count
    layout = _layout(170 * count + 60, hovermode="x unified" if not right_unit else "closest")
    layout["xaxis"] = _axis(_TIME, anchor=f"y{count if count > 1 else ''}", zeroline=False)
    data = []
    for row, title in enumerate(titles):
        top = 1 - row * (size + gap)
        key = "" if row == 0 else str(row + 1)
        layout[f"yaxis{key}"] = {
            "domain": [max(0.0, top - size), top],
            "title": {"text": f"{title} ({unit})", "standoff": 6},
            "zeroline": True,
        }
        for name, colour, lines, side in sides:
            axis = f"y{key}" if side == "left" else f"y{row + 1 + count}"
            tip = unit if side == "left" else right_unit
            hover = f"%{{x:.2f}} s: %{{y:.4g}} {tip}<extra>{name}</extra>"
            data.append(_line(lines[row], name, colour, yaxis=axis, showlegend=row == 0, hovertemplate=hover))
        if right_unit:
            right = _right_axis(right_unit, f"y{key}", zeroline=False)
            right["title"]["standoff"] = 4
            layout[f"yaxis{row + 1 + count}"] = right
    if right_unit:
        layout["margin"] = {**layout["margin"], "r": 58}
    return {"data": data, "layout": layout}


def _underlaid(figure: Figure) -> Figure:
    """The first of two curves wide and pale, so that both are seen where they lie on each other."""
    for trace in figure["data"][::2]:
        trace["line"] = {**trace["line"], "width": 5}
        trace["opacity"] = 0.45
    return figure


def rotation_before(rotation: dict[str, Any]) -> Figure | None:
    """As recorded: each in its own axes, with its own clock."""
    before = rotation["before"]
    if not before["gyroscope"]:
        return None
    sides = (("camera", CAMERA), ("gyroscope", IMU))
    speeds_only = rotation["after"] is None and "camera_size" in before
    shown = {key: [before[f"{key}_size"]] if speeds_only else before[key] for key, _ in sides}
    return _rows(_in_degrees(shown, sides), ["angular speed"] if speeds_only else ["x", "y", "z"], unit="°/s")


def rotation_after(rotation: dict[str, Any]) -> Figure | None:
    """Both in the camera's axes and on its clock."""
    after = rotation["after"]
    if after is None:
        return None
    return _underlaid(_rows(_in_degrees(after, (("gyroscope", IMU), ("camera", CAMERA))), ["x", "y", "z"], unit="°/s"))


def _in_degrees(
    record: dict[str, Any], sides: Sequence[tuple[str, str]]
) -> list[tuple[str, str, list[dict[str, Any]], str]]:
    return [(name, colour, _scaled(record[name], math.degrees(1)), "left") for name, colour in sides]


def accelerations(acceleration: dict[str, Any]) -> Figure:
    """Camera and accelerometer; where the model has no unit, the camera has an axis of its own."""
    metric = acceleration["camera_unit"] == "m/s2"
    sides = (
        ("accelerometer", IMU, acceleration["accelerometer"], "left"),
        ("camera", CAMERA, acceleration["camera"], "left" if metric else "right"),
    )
    figure = _rows(
        sides,
        ["level 1", "level 2", "up"],
        unit="m/s²",
        right_unit="" if metric else "model units/s²",
    )
    if metric:
        return _underlaid(figure)
    # without a unit the factor between the curves is open: zero in the middle of both, and what a hand does as measure
    for row, (imu, camera) in enumerate(zip(acceleration["accelerometer"], acceleration["camera"], strict=True)):
        key = "" if row == 0 else str(row + 1)
        most = 1.1 * max(_HAND_M_S2, _peak(imu))
        figure["layout"][f"yaxis{key}"]["range"] = [-most, most]
        most = 1.6 * _peak(camera) or 1.0
        figure["layout"][f"yaxis{row + 4}"] |= {"range": [-most, most], "tickmode": "auto", "nticks": 5}
    return figure


def _peak(line: dict[str, Any]) -> float:
    return max((abs(value) for value in line["values"] if value is not None), default=0.0)


def spectra(spectrum: dict[str, Any], *, unit: str, factor: float = 1.0) -> Figure:
    """Amplitude densities over frequency, both logarithmic."""
    other = spectrum.get("camera_unit") == "units/s2"
    names = {
        "imu": ("IMU, all samples", QUIET, 1.4),
        "imu_at_frames": ("IMU as the frames see it", IMU, 5.0),
        "camera": ("camera (model units, right)" if other else "camera", CAMERA, 1.6),
    }
    data = []
    for key, (name, colour, width) in names.items():
        curve = spectrum["curves"].get(key)
        if curve is None:
            continue
        right = other and key == "camera"
        values = [None if v is None or v <= 0 else v * (1.0 if right else factor) for v in curve["density"]]
        line = {"t_s": curve["hz"], "values": values}
        tip = f"%{{x:.3g}} Hz: %{{y:.3g}}<extra>{name}</extra>"
        trace = _line(line, name, colour, hovertemplate=tip, yaxis="y2" if right else "y")
        trace["line"] = {"color": colour, "width": width}
        trace["opacity"] = 0.45 if width > 2 else 1.0
        data.append(trace)
    layout = _layout(360)
    layout["showlegend"] = True
    left = [trace["y"] for trace in data if trace["yaxis"] == "y"]
    layout["xaxis"] = _axis("frequency (Hz)", **_decades([trace["x"] for trace in data]))
    layout["yaxis"] = _axis(f"{unit}/√Hz", **_decades(left))
    if other:
        layout["yaxis2"] = _right_axis("model units/s²/√Hz", "y", **_decades([data[-1]["y"]]))
        layout["margin"] = {**layout["margin"], "r": 58}
    return {"data": data, "layout": layout}


def _decades(columns: Sequence[Sequence[float | None]]) -> Figure:
    """A logarithmic axis; over more than two decades with ticks at tens alone, which do not run into each other."""
    known = [value for column in columns for value in column if value is not None and value > 0]
    wide = bool(known) and math.log10(max(known) / min(known)) > 2
    return {"type": "log", "tickformat": "~g", "dtick": 1 if wide else "D2"}


def informative_parts(parts: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The parts of a recording whose own scale is known well enough to be given, were it that of a model."""
    return [part for part in parts if half_width(part["sigma_log"]) <= WEAK_HALF_WIDTH]


def drift(model: dict[str, Any]) -> Figure:
    """Scales of the parts of a recording that tell one against the scale of the whole, in per cent."""
    whole, width = model["metres_per_unit"], model["half_width_pct"]
    every = model["drift"]["parts"]
    parts = informative_parts(every)
    start = model["signals"].get("first_frame_s", every[0]["begin_s"])
    middle = [0.5 * (p["begin_s"] + p["end_s"]) - start for p in parts]
    off = [100 * (p["metres_per_unit"] / whole - 1) for p in parts]
    reach = [100 * half_width(p["sigma_log"]) for p in parts]
    band = {"type": "rect", "xref": "paper", "x0": 0, "x1": 1, "y0": -width, "y1": width, "line": {"width": 0}}
    layout = _layout(300, shapes=[{**band, "fillcolor": GOOD, "opacity": 0.13, "layer": "below"}])
    span = [min(0.0, every[0]["begin_s"] - start), every[-1]["end_s"] - start]
    layout["xaxis"] = _axis(_TIME, range=span, zeroline=False)
    most = 1.15 * max([1.3 * width, *(abs(o) + r for o, r in zip(off, reach, strict=True))])
    layout["yaxis"] = _axis("off the whole (%)", zeroline=True, range=[-most, most])
    lengths = [0.5 * (p["end_s"] - p["begin_s"]) for p in parts]
    data = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": "part of the recording, 95 %",
            "x": middle,
            "y": off,
            "error_y": {"type": "data", "array": reach, "thickness": 1.5, "color": CAMERA},
            "error_x": {"type": "data", "array": lengths, "thickness": 3, "width": 0, "color": CAMERA},
            "marker": {"color": CAMERA, "size": 9},
            "text": [f"{digits(p['metres_per_unit'])} m per unit" for p in parts],
            "hovertemplate": "%{y:+.2f} %, %{text}<extra></extra>",
        },
        {
            "type": "scatter",
            "mode": "markers",
            "name": f"interval of the whole, ±{digits(width, 2)} %",
            "x": [None],
            "y": [None],
            "marker": {"color": GOOD, "symbol": "square", "size": 12, "opacity": 0.4},
        },
    ]
    return {"data": data, "layout": layout}


def refined(model: dict[str, Any], parts: Sequence[dict[str, Any]]) -> Figure:
    """Sizes of the parts of a path against the whole before and after a refinement, in per cent, each with 95 %."""
    start = model["signals"].get("first_frame_s", parts[0]["begin_s"])
    middle = [0.5 * (p["begin_s"] + p["end_s"]) - start for p in parts]
    half = [0.5 * (p["end_s"] - p["begin_s"]) for p in parts]
    reach = [Z95 * p["sigma_percent"] for p in parts]
    before = [100 / (1 + p["percent"] / 100) - 100 for p in parts]
    layout = _layout(300)
    layout["showlegend"] = True
    layout["xaxis"] = _axis(_TIME, zeroline=False)
    layout["yaxis"] = _axis("off the whole (%)", zeroline=True)
    return {
        "data": [
            {
                "type": "scatter",
                "mode": "markers",
                "name": f"{name} the refinement, 95 %",
                "x": middle,
                "y": off,
                "error_y": {"type": "data", "array": reach, "thickness": 1.5, "color": color},
                "error_x": {"type": "data", "array": half, "thickness": 3, "width": 0, "color": color},
                "marker": {"color": color, "size": 9},
                "hovertemplate": "%{y:+.2f} %<extra></extra>",
            }
            for name, off, color in (("before", before, CAMERA), ("after", [0.0] * len(parts), GOOD))
        ],
        "layout": layout,
    }


def blur(frames: Sequence[dict[str, Any]]) -> Figure:
    """Predicted blur of each frame, by what became of it."""
    data = []
    for action, (name, colour) in _ACTIONS.items():
        those = [frame for frame in frames if frame["action"] == action and frame["t_s"] is not None]
        if those:
            points = [(frame["t_s"], round(frame["blur_px"], 2), escape(frame["name"])) for frame in those]
            tip = "%{text}: %{y:.1f} px<extra></extra>"
            data.append(_dots(f"{name} ({len(those)})", points, colour, 0.85, tip))
    return {"data": data, "layout": _over_time(300, "blur (px)")}


def _over_time(height: int, title: str) -> Figure:
    axes = {"xaxis": _axis(_TIME, zeroline=False), "yaxis": _axis(title, rangemode="tozero")}
    return _layout(height, **axes)


def shutter_over_time(shutter: dict[str, Any]) -> Figure:
    """By how much keypoints move in each frame."""
    data = []
    for key, name, colour in (("largest_px", "largest in the frame", IMU), ("median_px", "median", CAMERA)):
        line = {"t_s": shutter["t_s"], "values": shutter[key]}
        tip = f"%{{x:.2f}} s: %{{y:.2f}} px<extra>{name}</extra>"
        data.append(_line(line, name, colour, hovertemplate=tip))
    return {"data": data, "layout": _over_time(280, "movement (px)")}


def shutter_field(worst: dict[str, Any]) -> Figure:
    """Where keypoints of the frame with the largest movement go; longer than it is where it would not be seen."""
    at, shift = np.array(worst["at_px"]), np.array(worst["shift_px"])
    largest = float(np.linalg.norm(shift, axis=1).max())
    times = max(1.0, round(0.09 * worst["width"] / max(largest, 1e-9)))
    ends = at + times * shift
    x, y = (
        [v for a, b in zip(at[:, i], ends[:, i], strict=True) for v in (round(a, 1), round(b, 1), None)] for i in (0, 1)
    )
    length = [f"{v:.2f} px" for v in np.linalg.norm(shift, axis=1)]
    name = "movement" if times == 1 else f"movement, drawn {times:.0f} times longer"
    line = {"color": IMU, "width": 1.6}
    data: list[Figure] = [
        {"type": "scatter", "mode": "lines", "x": x, "y": y, "name": name, "line": line, "hoverinfo": "skip"},
        {
            "type": "scatter",
            "mode": "markers",
            "x": np.round(ends[:, 0], 1).tolist(),
            "y": np.round(ends[:, 1], 1).tolist(),
            "text": length,
            "showlegend": False,
            "marker": {"size": 5, "color": IMU},
            "hovertemplate": "%{text}<extra></extra>",
        },
    ]
    layout = _layout(420)
    width, height, edge = worst["width"], worst["height"], 0.08
    outline = {"type": "rect", "x0": 0, "x1": width, "y0": 0, "y1": height, "line": {"color": QUIET, "width": 1}}
    layout["shapes"] = [outline]
    across, down = [-edge * width, (1 + edge) * width], [(1 + edge) * height, -edge * height]
    layout["xaxis"] = _axis("x (px)", range=across, constrain="domain", zeroline=False)
    layout["yaxis"] = _axis("y (px)", range=down, scaleanchor="x", constrain="domain", zeroline=False)
    return {"data": data, "layout": layout}


def target_distances(validation: dict[str, Any]) -> Figure:
    """Measured minus known distances, each corner triangulated on its own."""
    distances = validation["distances"]
    step = -(-len(distances) // _MOST_DISTANCES) or 1
    data = []
    for kind, colour in _SETS.items():
        those = [distance for distance in distances[::step] if distance["set"] == kind]
        if those:
            points = [
                (round(1000 * d["known_m"], 3), round(1000 * d["residual_m"], 4), escape(" to ".join(d["pair"])))
                for d in those
            ]
            tip = "%{text}: %{x:.1f} mm, off by %{y:+.3f} mm<extra></extra>"
            data.append(_dots(f"{kind} ({len(those)})", points, colour, 0.75, tip))
    layout = _layout(320)
    layout["xaxis"] = _axis("known distance (mm)", zeroline=False)
    layout["yaxis"] = _axis("measured − known (mm)", zeroline=True)
    return {"data": data, "layout": layout}


def target_views(validation: dict[str, Any]) -> Figure:
    """Residuals of the target's corners in each image."""
    views = validation["views"]
    data = [
        {
            "type": "bar",
            "x": list(range(1, len(views) + 1)),
            "y": [round(view["rms_px"], 4) for view in views],
            "text": [escape(f"{view['name']}: {view['corners']} corners") for view in views],
            "textposition": "none",
            "marker": {"color": IMU},
            "hovertemplate": "%{text}, %{y:.2f} px<extra></extra>",
        }
    ]
    layout = _layout(240, showlegend=False)
    layout["margin"] = {**layout["margin"], "t": 12}
    layout["xaxis"] = _axis("images with the target", dtick=max(1, round(len(views) / 8)), zeroline=False)
    layout["yaxis"] = _axis("residual, rms (px)")
    return {"data": data, "layout": layout}
