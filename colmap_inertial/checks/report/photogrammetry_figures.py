"""Figures of what a model says about itself."""

from __future__ import annotations

from html import escape
from typing import Any

from colmap_inertial.checks.report.figures import CAMERA, IMU, Figure, _axis, _layout, shutter_field

#: Below so many images, a place is seen too seldom to be sure of it.
_FEW = 3


def distortion(camera: dict[str, Any]) -> Figure:
    """Where the lens puts points, from where a pinhole would."""
    figure = shutter_field({**camera["distortion"], "width": camera["width"], "height": camera["height"]})
    return {**figure, "layout": {**figure["layout"], "height": 360}}


def residuals_by_image(images: list[dict[str, Any]], *, height: int = 240) -> Figure:
    """Residuals of each image, in order of the names."""
    data = [
        {
            "type": "bar",
            "x": list(range(1, len(images) + 1)),
            "y": [None if image["rms_px"] is None else round(image["rms_px"], 4) for image in images],
            "text": [escape(f"{image['name']}: {image['observations']} points") for image in images],
            "textposition": "none",
            "marker": {"color": IMU},
            "hovertemplate": "%{text}, %{y:.2f} px<extra></extra>",
        }
    ]
    layout = _layout(height, showlegend=False)
    layout["margin"] = {**layout["margin"], "t": 12}
    layout["xaxis"] = _axis("images, by name", zeroline=False)
    layout["yaxis"] = _axis("residual, rms (px)", rangemode="tozero")
    return {"data": data, "layout": layout}


def residuals_on_sensor(sensor: dict[str, Any]) -> Figure:
    """Mean residual of each part of the sensor: its size as colour, its direction as a line."""
    columns, rows = sensor["columns"], sensor["rows"]
    across, down = sensor["width"] / columns, sensor["height"] / rows
    x, y = [(c + 0.5) * across for c in range(columns)], [(r + 0.5) * down for r in range(rows)]
    known = [v for v in (*sensor["mean_x_px"], *sensor["mean_y_px"]) if v is not None]
    largest = max((abs(v) for v in known), default=0.0) or 1.0
    times = 0.9 * min(across, down) / largest
    ends_x: list[float | None] = []
    ends_y: list[float | None] = []
    for r in range(rows):
        for c in range(columns):
            dx, dy = sensor["mean_x_px"][r * columns + c], sensor["mean_y_px"][r * columns + c]
            if dx is not None:
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
    layout = _layout(360)
    layout["margin"] = {**layout["margin"], "r": 70}
    layout["xaxis"] = _axis("x (px)", constrain="domain", zeroline=False, showgrid=False)
    layout["yaxis"] = _axis(
        "y (px)", autorange="reversed", scaleanchor="x", constrain="domain", zeroline=False, showgrid=False
    )
    return {"data": [heat, arrows], "layout": layout}


def track_lengths(tracks: dict[str, Any]) -> Figure:
    """How many images see a point."""
    counts = tracks["counts"]
    names = [str(n) for n in range(2, len(counts) + 2)]
    names[-1] += "+"
    data = [{"type": "bar", "x": names, "y": counts, "marker": {"color": IMU}, "hovertemplate": "%{y}<extra></extra>"}]
    layout = _layout(240, showlegend=False)
    layout["margin"] = {**layout["margin"], "t": 12}
    layout["xaxis"] = _axis("images that see a point", type="category")
    layout["yaxis"] = _axis("points")
    return {"data": data, "layout": layout}


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
    layout = _layout(420)
    layout["margin"] = {**layout["margin"], "r": 70}
    layout["xaxis"] = _axis(f"x ({unit})", constrain="domain", zeroline=False, showgrid=False)
    layout["yaxis"] = _axis(f"y ({unit})", scaleanchor="x", constrain="domain", zeroline=False, showgrid=False)
    return {"data": [heat, line], "layout": layout}


def seldom_seen(ground: dict[str, Any]) -> float:
    """Share of the ground that fewer than three images see."""
    seen = [value for row in ground["images"] for value in row if value]
    return sum(value < _FEW for value in seen) / max(1, len(seen))
