"""Figures of what a model says about itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from colmap_inertial.checks.report.figures import CAMERA, Figure, axis, bars, layout, shutter_field
from colmap_inertial.checks.report.sizes import SIZES


def distortion(camera: dict[str, Any]) -> Figure:
    """Where the lens puts points, from where a pinhole would."""
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
    """How many images see a point."""
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
