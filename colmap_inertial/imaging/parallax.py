"""Image motion by the camera's translation: the part of the blur that the gyroscope does not measure.

Close to things, a hand's translation blurs as much as its rotation. It takes the camera's velocity and the depth of
what it sees, from a model of some sort; the lengths' unit is of no matter, as only velocity by depth counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array, check_array
from colmap_inertial.core.types import Projector
from colmap_inertial.imaging._bilinear import interpolate_nodes
from colmap_inertial.imaging.blur_field import BlurField, check_nodes


@dataclass(frozen=True, kw_only=True)
class ParallaxLimits:
    """Limits for spreading depths over an image."""

    #: Spacing of the nodes, as a share of the longer side: depths between a few hundred points tell no more.
    step_share: float = 1 / 24
    #: Points from which the depth at a node is averaged;
    neighbours: int = 6
    #: with fewer in all, depths are not known.
    fewest: int = 12
    #: Points beyond the border count, too, up to this share of the sides.
    beyond: float = 0.1
    #: Depths below this share of the median one are of points that the camera is about to pass, or wrong.
    nearest_share: float = 0.1


_LIMITS = ParallaxLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Parallax:
    """Velocity of a camera relative to the depths in one of its frames.

    Attributes
    ----------
    width, height
        Size of the image, px.
    step_px
        Distance of the nodes, which lie as those of a `BlurField`.
    velocity_in_cam
        (3,) of the camera at the instant that stands for the frame, units of length per second.
    inverse_depth
        (Gy, Gx) float32, per unit of length, along the optical axis.
    """

    width: int
    height: int
    step_px: int
    velocity_in_cam: Array
    inverse_depth: np.ndarray[tuple[int, int], np.dtype[np.float32]]

    def __post_init__(self) -> None:
        velocity = check_array("velocity_in_cam", self.velocity_in_cam, (3,))
        nodes = BlurField.nodes(self.width, self.height, self.step_px)
        inverse = check_nodes("inverse_depth", self.inverse_depth, nodes)
        if (inverse < 0).any():
            raise ValueError("inverse_depth: must not be negative")
        object.__setattr__(self, "velocity_in_cam", velocity)
        object.__setattr__(self, "inverse_depth", inverse)

    def rate_at(self, x_px: Array, y_px: Array) -> Array:
        """(len(y), len(x), 3) velocity times inverse depth at a grid of image points (COLMAP's coordinates), 1/s."""
        at = (np.stack(np.meshgrid(x_px, y_px), axis=-1) - 0.5) / self.step_px
        return interpolate_nodes(self.inverse_depth[..., None], at) * self.velocity_in_cam

    def as_json(self) -> dict[str, object]:
        """As JSON types; the unit of length becomes the median depth, and four digits are kept."""
        unit = float(np.median(self.inverse_depth)) or 1.0
        return {
            "width": self.width,
            "height": self.height,
            "step_px": self.step_px,
            "velocity_in_cam": [float(f"{unit * v:.4g}") for v in self.velocity_in_cam],
            "inverse_depth": [[float(f"{v / unit:.4g}") for v in row] for row in self.inverse_depth],
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Parallax:
        """Inverse of :meth:`as_json`."""
        return cls(**values)


def parallax_from_points(
    points_in_cam: Array, velocity_in_cam: Array, camera: Projector, *, width: int, height: int
) -> Parallax | None:
    """The parallax of a frame from points that it shows.

    Parameters
    ----------
    points_in_cam
        (N, 3) in the camera's frame at the instant that stands for the frame; points that are hidden do harm.
    velocity_in_cam
        (3,) of the camera then, the same unit of length per second.
    camera
        Intrinsics with distortion.
    width, height
        Size of the image, px.

    Returns
    -------
    Inverse depths between the points are averaged from the nearest ones; ``None`` where the points are too few.
    """
    from scipy.spatial import cKDTree

    points = np.asarray(points_in_cam, dtype=np.float64)
    ahead = points[:, 2] > 0
    if ahead.sum() < _LIMITS.fewest:
        return None
    points = points[ahead]
    points = points[points[:, 2] > _LIMITS.nearest_share * np.median(points[:, 2])]
    xy = np.asarray(camera.img_from_cam(points))
    margin = _LIMITS.beyond * np.array([width, height])
    seen = (
        np.isfinite(xy).all(axis=1) & (xy > -margin).all(axis=1) & (xy < np.array([width, height]) + margin).all(axis=1)
    )
    if seen.sum() < _LIMITS.fewest:
        return None
    xy, inverse = xy[seen], 1 / points[seen, 2]
    step_px = max(1, round(_LIMITS.step_share * max(width, height)))
    rows, columns = BlurField.nodes(width, height, step_px)
    nodes = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2) * step_px + 0.5
    neighbours: Any = cKDTree(xy).query(nodes, k=_LIMITS.neighbours)
    away, nearest = neighbours
    weight = 1 / (away**2 + (0.5 * step_px) ** 2)
    smooth = (weight * inverse[nearest]).sum(axis=1) / weight.sum(axis=1)
    return Parallax(
        width=width,
        height=height,
        step_px=step_px,
        velocity_in_cam=np.asarray(velocity_in_cam),
        inverse_depth=smooth.reshape(rows, columns).astype(np.float32),
    )
