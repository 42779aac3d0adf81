"""The 3-D figure as a still picture: points as an image, lines and words over it in the page's colours."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.report.figures import CAMERA, Figure
from colmap_inertial.report.still import draw_line, draw_text, wrap_svg


@dataclass(frozen=True, kw_only=True)
class StillView:
    """Viewpoint and size of the picture of a model.

    Attributes
    ----------
    azimuth_deg, elevation_deg
        Direction of the eye from the middle of the model; 90 degrees of elevation look straight down.
    distance
        Distance of the eye in half diagonals of the model; ``None`` for a parallel projection, in which lengths can be
        compared.
    """

    azimuth_deg: float = -53.0
    elevation_deg: float = 28.0
    distance: float | None = 3.2
    width: int = 480
    height: int = 380
    #: Pixels of the image of the points for each of the picture.
    density: int = 2
    #: Radius of a point in the image (px): of many, and of so few that they would not be seen.
    point_px: int = 2
    few_point_px: int = 3
    few: int = 6000
    #: Around the model (px).
    margin: int = 22

    @classmethod
    def from_above(cls) -> StillView:
        """Straight down, with y upwards in the picture."""
        return cls(azimuth_deg=-90.0, elevation_deg=90.0, distance=None, width=640, height=440)


OBLIQUE = StillView()


def draw_scene_still(figure: Figure, label: str, view: StillView = OBLIQUE) -> str:
    """A figure of :func:`scene_figure` as an SVG element; ``label`` is for those who cannot see it."""
    # pyramids of cameras would hide the points, and gravity is a point from above
    left_out = {"cameras", "gravity"} if view.distance is None else {"cameras"}
    traces = [trace for trace in figure["data"] if {trace.get("name"), trace.get("legendgroup")}.isdisjoint(left_out)]
    project = _Projection(view, traces)
    over: list[str] = []
    for trace in traces:
        if trace["type"] == "scatter3d" and trace["mode"] == "lines":
            is_grid = trace["name"].startswith("grid")
            look = {"css": "grid"} if is_grid else _look(trace)
            over.insert(0 if is_grid else len(over), draw_line(*_runs(project(_points(trace))[0]), **look))
        elif trace["type"] == "scatter3d" and trace["mode"] == "text":
            ((x, y),) = project(_points(trace))[0].tolist()
            over.append(draw_text(x, y - 6, trace["text"][0], anchor="middle", css="title"))
        elif trace["type"] == "cone":
            ((x, y),) = project(_points(trace))[0].tolist()
            over.append(draw_line([(x - 4, y - 7), (x, y), (x + 4, y - 7)], colour=trace["colorscale"][0][1], width=2))
    cloud = next(trace for trace in traces if trace.get("mode") == "markers")
    image = _draw_points(cloud, project, view)
    legend = [
        draw_line([(view.margin, view.height - 12), (view.margin + 16, view.height - 12)], colour=CAMERA, width=4),
        draw_text(view.margin + 22, view.height - 8, _name_legend(traces), css="title"),
    ]
    # the grid lies under the points, the path and what is written over them
    return wrap_svg([over[0], image, *over[1:], *legend], view.width, view.height, label)


def _name_legend(traces: Sequence[Figure]) -> str:
    names = [
        trace["name"] for trace in traces if trace.get("name", "").startswith(("camera path", "grid", "scale bar"))
    ]
    return ", ".join(names)


def _look(trace: Figure) -> dict[str, Any]:
    return {"colour": trace["line"]["color"], "width": max(1.0, 0.55 * trace["line"]["width"])}


def _points(trace: Figure) -> Array:
    """(N, 3) corners; gaps are not a number."""
    return np.array([trace[name] for name in "xyz"], dtype=np.float64).T


def _runs(at: Array) -> Iterator[list[tuple[float, float]]]:
    """Pieces of a line between its gaps."""
    gaps = np.flatnonzero(np.isnan(at[:, 0]))
    for run in np.split(at, gaps):
        known = [(x, y) for x, y in run.tolist() if x == x]
        if len(known) > 1:
            yield known


class _Projection:
    """Projection of the model into the picture, so that all of it fits."""

    def __init__(self, view: StillView, traces: Sequence[Figure]) -> None:
        a, e = np.radians([view.azimuth_deg, view.elevation_deg])
        backward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        self._axes = np.stack([right, np.cross(backward, right), backward])
        shown = ("markers", "lines")
        corners = np.concatenate([_points(t) for t in traces if t.get("mode") in shown and "grid" not in t["name"]])
        corners = corners[np.isfinite(corners).all(axis=1)]
        low, high = corners.min(axis=0), corners.max(axis=0)
        self._middle, self._size = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-12)
        self._distance = view.distance
        self._scale, self._shift = 1.0, np.zeros(2)
        seen, _ = self(corners)
        first, last = seen.min(axis=0), seen.max(axis=0)
        room = np.array([view.width, view.height - 20]) - 2 * view.margin
        self._scale = float((room / np.maximum(last - first, 1e-9)).min())
        self._shift = np.array([0.5 * view.width, 0.5 * view.height - 8]) - self._scale * 0.5 * (first + last)

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """(N, 2) places in the picture (px), and (N,) how near they are."""
        at = (points - self._middle) @ self._axes.T / self._size
        far = 1.0 if self._distance is None else 1.0 - at[:, 2:] / self._distance
        flat = at[:, :2] * [1.0, -1.0] / far
        return self._scale * flat + self._shift, at[:, 2]


def _draw_points(cloud: Figure, project: _Projection, view: StillView) -> str:
    """The points as an image that lets the page through between them, the nearer over the farther ones."""
    import cv2

    width, height = view.density * view.width, view.density * view.height
    canvas = np.zeros((height, width, 4), dtype=np.uint8)
    at, near = project(_points(cloud))
    rgb = [[int(colour[i : i + 2], 16) for i in (5, 3, 1)] for colour in cloud["marker"]["color"]]
    radius = view.few_point_px if len(rgb) < view.few else view.point_px
    for i in np.argsort(near, kind="stable").tolist():
        centre = round(view.density * float(at[i, 0])), round(view.density * float(at[i, 1]))
        cv2.circle(canvas, centre, radius, (*rgb[i], 255), -1)
    # 9 takes eight times as long, and is no smaller
    data = cv2.imencode(".png", canvas, [cv2.IMWRITE_PNG_COMPRESSION, 6])[1].tobytes()
    place = f'width="{view.width}" height="{view.height}"'
    return f'<image {place} href="data:image/png;base64,{base64.b64encode(data).decode("ascii")}"/>'
