"""Figures as plain plotly.js specifications; the page colours text and grids for light and dark itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import Action
from colmap_inertial.inertial.scale.verdict import WEAK_HALF_WIDTH, half_width
from colmap_inertial.report.series import SIZES
from colmap_inertial.report.words import digits

Figure = dict[str, Any]
Lines = Sequence[dict[str, list[float | None]]]

CAMERA, IMU, OTHER, GOOD, BAD, QUIET = "#e07b1a", "#3f87cf", "#8a63c7", "#2f9e6e", "#d64550", "#8b93a1"
_TIME = "time since the first frame (s)"
_ACTIONS = {
    Action.PASSED: ("as filmed", QUIET),
    Action.DEBLURRED: ("deblurred", IMU),
    Action.CHANGED: ("changed", OTHER),
    Action.DROPPED: ("left out", BAD),
}
_SETS = {"control": IMU, "check": CAMERA, "mixed": QUIET}


def layout(height: int, x: Figure | None = None, y: Figure | None = None, **more: Any) -> Figure:
    """The layout of all flat figures, with these axes; ``margin`` may change some of its sides."""
    margin = {"l": 58, "r": 12, "t": 34, "b": 46, **more.pop("margin", {})}
    axes = {name: value for name, value in (("xaxis", x), ("yaxis", y)) if value is not None}
    legend = {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom", "xanchor": "left"}
    return {"height": height, "margin": margin, "legend": legend, "hovermode": "closest", **axes, **more}


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


def axis(title: str, **more: Any) -> Figure:
    return {"title": {"text": title}, **more}


def _right_axis(title: str, overlaying: str, **more: Any) -> Figure:
    return {"overlaying": overlaying, "side": "right", "showgrid": False, **axis(title), **more}


def _scale_lines(lines: Lines, factor: float) -> list[dict[str, Any]]:
    return [
        {"t_s": line["t_s"], "values": [None if v is None else round(v * factor, 5) for v in line["values"]]}
        for line in lines
    ]


def _stack_rows(
    sides: Sequence[tuple[str, str, Lines, str]], titles: Sequence[str], *, unit: str, right_unit: str = ""
) -> Figure:
    """Rows over one time axis; a side is name, colour, a line for each row, and its axis (``"left"``, ``"right"``)."""
    gap, count = 0.05, len(titles)
    size = (1 - gap * (count - 1)) / count
    time = axis(_TIME, anchor=f"y{count if count > 1 else ''}", zeroline=False)
    hovermode, margin = ("closest", {"r": 58}) if right_unit else ("x unified", {})
    rows = layout(170 * count + 60, time, hovermode=hovermode, margin=margin)
    data = []
    for row, title in enumerate(titles):
        top = 1 - row * (size + gap)
        key = "" if row == 0 else str(row + 1)
        rows[f"yaxis{key}"] = {
            "domain": [max(0.0, top - size), top],
            "title": {"text": f"{title} ({unit})", "standoff": 6},
            "zeroline": True,
        }
        for name, colour, lines, side in sides:
            yaxis = f"y{key}" if side == "left" else f"y{row + 1 + count}"
            tip = unit if side == "left" else right_unit
            hover = f"%{{x:.2f}} s: %{{y:.4g}} {tip}<extra>{name}</extra>"
            data.append(_line(lines[row], name, colour, yaxis=yaxis, showlegend=row == 0, hovertemplate=hover))
        if right_unit:
            right = _right_axis(right_unit, f"y{key}", zeroline=False)
            right["title"]["standoff"] = 4
            rows[f"yaxis{row + 1 + count}"] = right
    return {"data": data, "layout": rows}


def _underlay(figure: Figure) -> Figure:
    """The first of two curves wide and pale, so that both are seen where they lie on each other."""
    for trace in figure["data"][::2]:
        trace["line"] = {**trace["line"], "width": 5}
        trace["opacity"] = 0.45
    return figure


def rotation_before(rotation: dict[str, Any]) -> Figure | None:
    """Rates as recorded: each sensor in its own axes, on its own clock."""
    before = rotation["before"]
    if not before["gyroscope"]:
        return None
    sides = (("camera", CAMERA), ("gyroscope", IMU))
    speeds_only = rotation["after"] is None and "camera_size" in before
    shown = {key: [before[f"{key}_size"]] if speeds_only else before[key] for key, _ in sides}
    return _stack_rows(
        _convert_to_degrees(shown, sides), ["angular speed"] if speeds_only else ["x", "y", "z"], unit="°/s"
    )


def rotation_after(rotation: dict[str, Any]) -> Figure | None:
    """Both in the camera's axes and on its clock."""
    after = rotation["after"]
    if after is None:
        return None
    return _underlay(
        _stack_rows(_convert_to_degrees(after, (("gyroscope", IMU), ("camera", CAMERA))), ["x", "y", "z"], unit="°/s")
    )


def deviations(rotation: dict[str, Any]) -> Figure | None:
    """Rotation of each camera against its neighbours, compared with the gyroscope; wrong cameras stand out."""
    line = rotation.get("deviation_deg")
    return None if line is None else _stack_rows([("camera", CAMERA, [line], "left")], ["deviation"], unit="°")


def _convert_to_degrees(
    record: dict[str, Any], sides: Sequence[tuple[str, str]]
) -> list[tuple[str, str, list[dict[str, Any]], str]]:
    return [(name, colour, _scale_lines(record[name], math.degrees(1)), "left") for name, colour in sides]


def accelerations(acceleration: dict[str, Any]) -> Figure:
    """Camera and accelerometer; where the model has no unit, the camera has an axis of its own."""
    metric = acceleration["camera_unit"] == "m/s2"
    sides = (
        ("accelerometer", IMU, acceleration["accelerometer"], "left"),
        ("camera", CAMERA, acceleration["camera"], "left" if metric else "right"),
    )
    figure = _stack_rows(
        sides,
        ["level 1", "level 2", "up"],
        unit="m/s²",
        right_unit="" if metric else "model units/s²",
    )
    if metric:
        return _underlay(figure)
    # without a unit the factor between the curves is open: zero in the middle of both, and what a hand does as measure
    for row, (imu, camera) in enumerate(zip(acceleration["accelerometer"], acceleration["camera"], strict=True)):
        key = "" if row == 0 else str(row + 1)
        most = 1.1 * max(SIZES.hand_m_s2, _peak(imu))
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
        "imu_at_frames": ("IMU, averaged from frame to frame", IMU, 5.0),
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
    left_traces = [trace["y"] for trace in data if trace["yaxis"] == "y"]
    x = axis("frequency (Hz)", **_decades([trace["x"] for trace in data]))
    more: Figure = {"showlegend": True}
    if other:
        right = _right_axis("model units/s²/√Hz", "y", **_decades([data[-1]["y"]]))
        more |= {"yaxis2": right, "margin": {"r": 58}}
    return {"data": data, "layout": layout(360, x, axis(f"{unit}/√Hz", **_decades(left_traces)), **more)}


def _decades(columns: Sequence[Sequence[float | None]]) -> Figure:
    """A logarithmic axis; over more than two decades with ticks at tens alone, which do not run into each other."""
    known = [value for column in columns for value in column if value is not None and value > 0]
    wide = bool(known) and math.log10(max(known) / min(known)) > 2
    return {"type": "log", "tickformat": "~g", "dtick": 1 if wide else "D2"}


def informative_parts(parts: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The parts of a recording whose own scale is known well enough to be given, were it that of a model."""
    return [part for part in parts if half_width(part["sigma_log"]) <= WEAK_HALF_WIDTH]


def _intervals(
    parts: Sequence[dict[str, Any]],
    start_s: float,
    off: Sequence[float],
    reach: Sequence[float],
    name: str,
    colour: str,
) -> Figure:
    """Parts of a recording as dots, with how long they are and their 95 % intervals (per cent)."""
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": [0.5 * (part["begin_s"] + part["end_s"]) - start_s for part in parts],
        "y": off,
        "error_y": {"type": "data", "array": reach, "thickness": 1.5, "color": colour},
        "error_x": {
            "type": "data",
            "array": [0.5 * (part["end_s"] - part["begin_s"]) for part in parts],
            "thickness": 3,
            "width": 0,
            "color": colour,
        },
        "marker": {"color": colour, "size": 9},
        "hovertemplate": "%{y:+.2f} %<extra></extra>",
    }


def drift(model: dict[str, Any]) -> Figure:
    """Scales of the parts of a recording that tell one against the scale of the whole, in per cent."""
    whole, width = model["metres_per_unit"], model["half_width_pct"]
    every = model["drift"]["parts"]
    parts = informative_parts(every)
    start_s = model["signals"].get("first_frame_s", every[0]["begin_s"])
    off = [100 * (part["metres_per_unit"] / whole - 1) for part in parts]
    reach = [100 * half_width(part["sigma_log"]) for part in parts]
    dots = _intervals(parts, start_s, off, reach, "part of the recording, 95 %", CAMERA)
    dots["text"] = [f"{digits(part['metres_per_unit'])} m per unit" for part in parts]
    dots["hovertemplate"] = "%{y:+.2f} %, %{text}<extra></extra>"
    key = {
        "type": "scatter",
        "mode": "markers",
        "name": f"interval of the whole, ±{digits(width, 2)} %",
        "x": [None],
        "y": [None],
        "marker": {"color": GOOD, "symbol": "square", "size": 12, "opacity": 0.4},
    }
    band = {"type": "rect", "xref": "paper", "x0": 0, "x1": 1, "y0": -width, "y1": width, "line": {"width": 0}}
    band |= {"fillcolor": GOOD, "opacity": 0.13, "layer": "below"}
    most = 1.15 * max([1.3 * width, *(abs(o) + r for o, r in zip(off, reach, strict=True))])
    x = axis(_TIME, range=[min(0.0, every[0]["begin_s"] - start_s), every[-1]["end_s"] - start_s], zeroline=False)
    y = axis("difference from the whole (%)", zeroline=True, range=[-most, most])
    return {"data": [dots, key], "layout": layout(300, x, y, shapes=[band])}


def refined(model: dict[str, Any], parts: Sequence[dict[str, Any]]) -> Figure:
    """Sizes of the parts of a path against the whole before and after a refinement, in per cent, each with 95 %."""
    start_s = model["signals"].get("first_frame_s", parts[0]["begin_s"])
    reach = [Z95 * part["sigma_percent"] for part in parts]
    before = [100 / (1 + part["percent"] / 100) - 100 for part in parts]
    sides = (("before", CAMERA, before), ("after", GOOD, [0.0] * len(parts)))
    return {
        "data": [_intervals(parts, start_s, off, reach, f"{name} the refinement, 95 %", c) for name, c, off in sides],
        "layout": layout(
            300, axis(_TIME, zeroline=False), axis("difference from the whole (%)", zeroline=True), showlegend=True
        ),
    }


#: Sensors in few letters.
_SHORT = {"imu": "IMU", "depth": "depth", "device": "device", "positions": "GPS"}


def sensors(combined: dict[str, Any]) -> Figure:
    """What each sensor says of the scale, and the combined scale, in per cent of that: a row for each, with 95 %."""
    rows = [
        ("combined", combined),
        *((_SHORT.get(one["sensor"], one["sensor"]), one) for one in combined["evidence"][::-1]),
    ]
    whole = float(combined["metres_per_unit"])
    data = []
    # the axis counts from below
    for colour, name, some in ((GOOD, "combined, 95 %", rows[:1]), (IMU, "one sensor, 95 %", rows[1:])):
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": name,
                "x": [100 * (one["metres_per_unit"] / whole - 1) for _, one in some],
                "y": [label for label, _ in some],
                "text": [f"{digits(one['metres_per_unit'])} m per unit" for _, one in some],
                "error_x": {
                    "type": "data",
                    "array": [50 * (one["ci95"][1] - one["ci95"][0]) / whole for _, one in some],
                    "thickness": 3,
                    "width": 0,
                    "color": colour,
                },
                "marker": {"color": colour, "size": 11},
                "hovertemplate": "%{y}: %{x:+.2f} %, %{text}<extra></extra>",
            }
        )
    x = axis("difference from the combined scale (%)", zeroline=True)
    return {"data": data, "layout": layout(110 + 38 * len(rows), x, {"type": "category", "zeroline": False})}


def device_drift(device: dict[str, Any], start_s: float) -> Figure:
    """How much too long the device's own metres are by parts of the recording, in per cent, each with 95 %."""
    parts = informative_parts(device["parts"])
    off = [100 * (part["length_ratio"] - 1) for part in parts]
    reach = [100 * half_width(part["sigma_log"]) for part in parts]
    dots = _intervals(parts, start_s, off, reach, "part of the recording, 95 %", CAMERA)
    key = {
        "type": "scatter",
        "mode": "markers",
        "name": "interval of the whole",
        "x": [None],
        "y": [None],
        "marker": {"color": GOOD, "symbol": "square", "size": 12, "opacity": 0.4},
    }
    low, high = (100 * (ratio - 1) for ratio in device["ci95"])
    band = {"type": "rect", "xref": "paper", "x0": 0, "x1": 1, "y0": low, "y1": high, "line": {"width": 0}}
    band |= {"fillcolor": GOOD, "opacity": 0.13, "layer": "below"}
    x, y = axis(_TIME, zeroline=False), axis("device's lengths, too long (%)", zeroline=True)
    return {"data": [dots, key], "layout": layout(280, x, y, shapes=[band])}


def blur(frames: Sequence[dict[str, Any]]) -> Figure:
    """Predicted blur of each frame, by what became of it."""
    data = []
    for action, (name, colour) in _ACTIONS.items():
        those = [frame for frame in frames if frame["action"] == action and frame["t_s"] is not None]
        if those:
            points = [(frame["t_s"], round(frame["blur_px"], 2), escape(frame["name"])) for frame in those]
            tip = "%{text}: %{y:.1f} px<extra></extra>"
            data.append(_dots(f"{name} ({len(those)})", points, colour, 0.85, tip))
    return {"data": data, "layout": _make_time_layout(300, "blur (px)")}


def _make_time_layout(height: int, title: str) -> Figure:
    return layout(height, axis(_TIME, zeroline=False), axis(title, rangemode="tozero"))


def shutter_over_time(shutter: dict[str, Any]) -> Figure:
    """Shift of keypoints in each frame."""
    data = []
    for key, name, colour in (("largest_px", "largest in the frame", IMU), ("median_px", "median", CAMERA)):
        line = {"t_s": shutter["t_s"], "values": shutter[key]}
        tip = f"%{{x:.2f}} s: %{{y:.2f}} px<extra>{name}</extra>"
        data.append(_line(line, name, colour, hovertemplate=tip))
    return {"data": data, "layout": _make_time_layout(280, "movement (px)")}


def shutter_field(worst: dict[str, Any]) -> Figure:
    """Shift of keypoints in the frame where it is largest, enlarged where it would not be visible."""
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
    width, height, edge = worst["width"], worst["height"], 0.08
    outline = {"type": "rect", "x0": 0, "x1": width, "y0": 0, "y1": height, "line": {"color": QUIET, "width": 1}}
    across, down = [-edge * width, (1 + edge) * width], [(1 + edge) * height, -edge * height]
    x_axis = axis("x (px)", range=across, constrain="domain", zeroline=False)
    y_axis = axis("y (px)", range=down, scaleanchor="x", constrain="domain", zeroline=False)
    return {"data": data, "layout": layout(420, x_axis, y_axis, shapes=[outline])}


def target_distances(validation: dict[str, Any]) -> Figure:
    """Measured minus known distances, each corner triangulated on its own."""
    distances = validation["distances"]
    step = -(-len(distances) // SIZES.target_distances) or 1
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
    x, y = axis("known distance (mm)", zeroline=False), axis("measured − known (mm)", zeroline=True)
    return {"data": data, "layout": layout(320, x, y)}


def bars(x: Sequence[Any], y: Sequence[Any], texts: Sequence[str] | None = None) -> Figure:
    """Bars that say what they are when pointed at: their text, and y as a residual."""
    trace = {
        "type": "bar",
        "x": list(x),
        "y": list(y),
        "marker": {"color": IMU},
        "hovertemplate": "%{y}<extra></extra>",
    }
    if texts is not None:
        tip = "%{text}, %{y:.2f} px<extra></extra>"
        trace |= {"text": [escape(text) for text in texts], "textposition": "none", "hovertemplate": tip}
    return trace


def target_views(validation: dict[str, Any]) -> Figure:
    """Residuals of the target's corners in each image."""
    views = validation["views"]
    texts = [f"{view['name']}: {view['corners']} corners" for view in views]
    x = axis("images with the target", dtick=max(1, round(len(views) / 8)), zeroline=False)
    return {
        "data": [bars(range(1, len(views) + 1), [round(view["rms_px"], 4) for view in views], texts)],
        "layout": layout(240, x, axis("residual, rms (px)"), showlegend=False, margin={"t": 12}),
    }


def distortion(camera: dict[str, Any]) -> Figure:
    """Shift of points by the lens, relative to a pinhole camera."""
    figure = shutter_field({**camera["distortion"], "width": camera["width"], "height": camera["height"]})
    return {**figure, "layout": {**figure["layout"], "height": 360}}


def residuals_by_image(images: list[dict[str, Any]]) -> Figure:
    """Residuals of each image, in order of the names."""
    residuals = [None if image["rms_px"] is None else round(image["rms_px"], 4) for image in images]
    texts = [f"{image['name']}: {image['observations']} points" for image in images]
    x, y = axis("images, by name", zeroline=False), axis("residual, rms (px)", rangemode="tozero")
    return {
        "data": [bars(range(1, len(images) + 1), residuals, texts)],
        "layout": layout(240, x, y, showlegend=False, margin={"t": 12}),
    }


def residuals_on_sensor(sensor: dict[str, Any]) -> Figure:
    """Mean residual of each part of the sensor: its size as colour, its direction as a line."""
    columns, rows = sensor["columns"], sensor["rows"]
    across, down = sensor["width"] / columns, sensor["height"] / rows
    x, y = [(c + 0.5) * across for c in range(columns)], [(r + 0.5) * down for r in range(rows)]
    mean = np.array([sensor["mean_x_px"], sensor["mean_y_px"]], dtype=np.float64)  # none where nothing is known
    largest = float(np.nanmax(np.abs(mean), initial=0.0)) or 1.0
    times = 0.9 * min(across, down) / largest
    ends_x: list[float | None] = []
    ends_y: list[float | None] = []
    for i, (dx, dy) in enumerate(mean.T.tolist()):
        if not math.isnan(dx):
            r, c = divmod(i, columns)
            ends_x += [round(x[c], 1), round(x[c] + times * dx, 1), None]
            ends_y += [round(y[r], 1), round(y[r] + times * dy, 1), None]
    table = [sensor["rms_px"][r * columns : (r + 1) * columns] for r in range(rows)]
    heat = {
        "type": "heatmap",
        "x": x,
        "y": y,
        "z": table,
        "colorscale": [[0, "#dbe9f7"], [1, "#1f5f9e"]],
        "colorbar": {"title": {"text": "rms (px)"}, "thickness": 12},
        "hovertemplate": "%{z:.2f} px<extra></extra>",
    }
    arrows = {
        "type": "scatter",
        "mode": "lines",
        "x": ends_x,
        "y": ends_y,
        "name": f"mean, drawn {times:.0f} times longer",
        "line": {"color": CAMERA, "width": 1.6},
        "hoverinfo": "skip",
        "showlegend": True,
    }
    plain = {"constrain": "domain", "zeroline": False, "showgrid": False}
    x_axis, y_axis = axis("x (px)", **plain), axis("y (px)", autorange="reversed", scaleanchor="x", **plain)
    return {"data": [heat, arrows], "layout": layout(360, x_axis, y_axis, margin={"r": 70})}


def track_lengths(tracks: dict[str, Any]) -> Figure:
    """Histogram of the number of images that see a point."""
    counts = tracks["counts"]
    names = [str(n) for n in range(2, len(counts) + 2)]
    names[-1] += "+"
    x = axis("images that see a point", type="category")
    shape = layout(240, x, axis("points"), showlegend=False, margin={"t": 12})
    return {"data": [bars(names, counts)], "layout": shape}


def overlap(ground: dict[str, Any], path: list[list[float]], unit: str) -> Figure:
    """Images that see each place, from above, with the camera's path."""
    images = ground["images"]
    step = ground["step"]
    heat = {
        "type": "heatmap",
        "x0": ground["x0"] + 0.5 * step,
        "dx": step,
        "y0": ground["y0"] + 0.5 * step,
        "dy": step,
        "z": [[value or None for value in row] for row in images],
        "zmin": 1,
        "colorscale": [[0, "#d64550"], [0.25, "#e9c46a"], [1, "#2f9e6e"]],
        "colorbar": {"title": {"text": "images"}, "thickness": 12},
        "hovertemplate": "seen by %{z} images<extra></extra>",
    }
    line = {
        "type": "scatter",
        "mode": "lines",
        "x": path[0],
        "y": path[1],
        "name": "camera path",
        "line": {"color": CAMERA, "width": 2},
        "hoverinfo": "skip",
        "showlegend": True,
    }
    plain = {"constrain": "domain", "zeroline": False, "showgrid": False}
    x, y = axis(f"x ({unit})", **plain), axis(f"y ({unit})", scaleanchor="x", **plain)
    return {"data": [heat, line], "layout": layout(420, x, y, margin={"r": 70})}


def seldom_seen(ground: dict[str, Any]) -> float:
    """Share of the ground that fewer than three images see."""
    seen = [value for row in ground["images"] for value in row if value]
    return sum(value < SIZES.fewest_views for value in seen) / max(1, len(seen))
