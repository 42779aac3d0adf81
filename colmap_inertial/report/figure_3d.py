"""The model in 3-D: cloud, path, cameras, a metric grid under them, gravity and a length to compare with."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.report.figures import CAMERA, GOOD, IMU, QUIET, Figure
from colmap_inertial.report.series import SIZES, nice_length
from colmap_inertial.report.words import digits, length


def scene_figure(scene: dict[str, Any]) -> Figure:
    """A turntable of the scene."""
    metric = scene["unit"] == "m"
    unit = "m" if metric else "model units"
    xyz, path = (np.array(scene[key]["xyz"], dtype=np.float64).reshape(3, -1) for key in ("points", "path"))
    low, high = _box(xyz, path)
    size = float((high - low).max())
    step = nice_length(size / SIZES.grid_cells)
    inside = np.all((xyz >= low[:, None]) & (xyz <= high[:, None]), axis=0)
    data: list[Figure] = [
        {
            "type": "scatter3d",
            "mode": "markers",
            "name": f"{inside.sum()} of {scene['points_in_model']} points",
            **_coordinates(xyz[:, inside]),
            "marker": {
                "size": 1.5,
                "color": [c for c, keep in zip(scene["points"]["rgb"], inside, strict=True) if keep],
            },
            "hoverinfo": "skip",
        },
        {
            "type": "scatter3d",
            "mode": "lines",
            "name": "camera path",
            **_coordinates(path),
            "line": {"color": CAMERA, "width": 4},
            "text": [f"{t:.2f} s" for t in scene["path"]["t_s"]],
            "hovertemplate": f"%{{text}}: x %{{x:.3f}}, y %{{y:.3f}}, z %{{z:.3f}} {unit}<extra></extra>",
        },
        _lines(_pyramids(scene["cameras"], 0.035 * size), "cameras", IMU, 1.5),
        _lines(_grid(low, high, step), f"grid of {_length(step, unit)}", QUIET, 1),
    ]
    if metric:
        data += _scale_bar(low, high, step, unit)
    if scene["gravity_known"]:
        data += _gravity(low, high, size)
    axis = {"showbackground": False, "showspikes": False, "nticks": 6}
    scene_layout: Figure = {
        "aspectmode": "data",
        "dragmode": "turntable" if scene["gravity_known"] else "orbit",
        "camera": {"eye": {"x": 1.0, "y": -1.35, "z": 0.8}, "center": {"x": 0, "y": 0, "z": -0.12}},
    }
    for k, name in enumerate("xyz"):
        title = f"{'up' if name == 'z' and scene['gravity_known'] else name} ({unit})"
        scene_layout[f"{name}axis"] = {**axis, "title": {"text": title}, "range": [float(low[k]), float(high[k])]}
    return {
        "data": data,
        "layout": {
            "height": 560,
            "margin": {"l": 0, "r": 0, "t": 8, "b": 0},
            "legend": {"orientation": "h", "x": 0, "y": -0.02, "yanchor": "top", "itemsizing": "constant"},
            "scene": scene_layout,
        },
    }


def _length(value: float, unit: str) -> str:
    return length(value) if unit == "m" else f"{digits(value, 3)} {unit}"


def _box(xyz: Array, path: Array) -> tuple[Array, Array]:
    """Low and high corner (3,) of what is shown: nearly all points, and all of the path."""
    edges = [path.min(axis=1), path.max(axis=1)]
    if xyz.shape[1]:
        edges += list(np.percentile(xyz, [SIZES.outside_pct, 100 - SIZES.outside_pct], axis=1))
    low, high = np.min(edges, axis=0), np.max(edges, axis=0)
    pad = 0.06 * max(float((high - low).max()), 1e-9)
    return low - pad, high + pad


def _coordinates(xyz: Array) -> dict[str, list[float]]:
    return {name: row.tolist() for name, row in zip("xyz", xyz, strict=True)}


def _lines(segments: Array, name: str, colour: str, width: float, **more: Any) -> Figure:
    """(K, P, 3) polygons of P corners each, as one trace."""
    gaps = np.full((len(segments), 1, 3), np.nan)
    corners = np.concatenate([segments, gaps], axis=1).reshape(-1, 3)
    columns = [[None if math.isnan(v) else float(f"{v:.6g}") for v in column.tolist()] for column in corners.T]
    trace = {"type": "scatter3d", "mode": "lines", "name": name, "hoverinfo": "skip", **more}
    return {**trace, **dict(zip("xyz", columns, strict=True)), "line": {"color": colour, "width": width}}


def _pyramids(cameras: dict[str, Any], depth: float) -> Array:
    """(K, 10, 3) the outlines of pyramids from the cameras' centres to their images' corners."""
    centre, right, down, ahead = (np.array(cameras[k], dtype=np.float64).T for k in ("xyz", "right", "down", "ahead"))
    half = cameras["half_width"], cameras["half_height"]
    corners = [
        centre + depth * (ahead + sx * half[0] * right + sy * half[1] * down)
        for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    a, b, c, d = corners
    return np.stack([centre, a, b, centre, c, d, centre, d, a, b, c], axis=1)


def _grid(low: Array, high: Array, step: float) -> Array:
    """(K, 2, 3) lines of a level grid under everything."""
    first, last = np.ceil(low / step) * step, np.floor(high / step) * step
    lines = []
    for k, other in ((0, 1), (1, 0)):
        for at in np.arange(first[k], last[k] + 0.5 * step, step):
            ends = np.empty((2, 3))
            ends[:, k], ends[:, other], ends[:, 2] = at, (low[other], high[other]), low[2]
            lines.append(ends)
    return np.array(lines).reshape(-1, 2, 3)


def _scale_bar(low: Array, high: Array, step: float, unit: str) -> list[Figure]:
    margin = 0.04 * float((high - low).max())
    start = np.array([low[0] + margin, low[1] + margin, low[2] + 0.2 * margin])
    end = start + np.array([step, 0.0, 0.0])
    bar = _lines(np.stack([start, end])[None], f"scale bar, {_length(step, unit)}", GOOD, 8)
    # so far above it that no turn of the view brings the bar through the words
    raised = np.array([0.0, 0.0, 1.5 * margin])
    return [bar, _label(0.5 * (start + end) + raised, _length(step, unit))]


def _label(at: Array, text: str, **more: Any) -> Figure:
    font = {"textposition": "top center", "textfont": {"size": 13, "color": GOOD}}
    shown = {"type": "scatter3d", "mode": "text", "text": [text], "hoverinfo": "skip", "showlegend": False}
    return {**shown, **_coordinates(at[:, None]), **font, **more}


def _gravity(low: Array, high: Array, size: float) -> list[Figure]:
    margin = 0.04 * size
    top = np.array([low[0] + margin, high[1] - margin, min(high[2] - margin, low[2] + 0.35 * size)])
    tip = np.array([top[0], top[1], max(top[2] - 0.2 * size, low[2] + 0.2 * margin)])
    shaft = _lines(np.stack([top, tip])[None], "gravity", GOOD, 5, legendgroup="gravity")
    head = {
        "type": "cone",
        **_coordinates(tip[:, None]),
        "u": [0],
        "v": [0],
        "w": [-1],
        "anchor": "tip",
        "sizemode": "absolute",
        "sizeref": 0.05 * size,
        "colorscale": [[0, GOOD], [1, GOOD]],
        "showscale": False,
        "hoverinfo": "skip",
        "legendgroup": "gravity",
    }
    return [shaft, head, _label(top, "gravity", legendgroup="gravity")]
