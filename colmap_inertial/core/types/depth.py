"""Depth that a sensor of the device measured, beside the frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from colmap_inertial.core.arrays import Array, set_fields


@dataclass(frozen=True, eq=False, kw_only=True)
class PinholeGrid:
    """Intrinsics of a depth map, pixels of its own; the top-left pixel's centre is (0.5, 0.5).

    Attributes
    ----------
    width, height
        Pixels.
    focal_px, centre_px
        (x, y).
    """

    width: int
    height: int
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]

    def __post_init__(self) -> None:
        numbers = (*self.focal_px, *self.centre_px)
        if self.width < 1 or self.height < 1 or not np.isfinite(numbers).all() or min(self.focal_px) <= 0:
            raise ValueError("a depth map needs a size, a focal length and a centre")

    def resized(self, width: int, height: int) -> PinholeGrid:
        """The same view in other pixels."""
        x, y = width / self.width, height / self.height
        return PinholeGrid(
            width=width,
            height=height,
            focal_px=(self.focal_px[0] * x, self.focal_px[1] * y),
            centre_px=(self.centre_px[0] * x, self.centre_px[1] * y),
        )

    def rays(self) -> Array:
        """(H, W, 3) points of each pixel's centre at depth one, camera frame: x right, y down, z forward."""
        x = (np.arange(self.width) + 0.5 - self.centre_px[0]) / self.focal_px[0]
        y = (np.arange(self.height) + 0.5 - self.centre_px[1]) / self.focal_px[1]
        grid = np.ones((self.height, self.width, 3))
        grid[..., 0], grid[..., 1] = x[None, :], y[:, None]
        return grid


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthMap:
    """Depth along the optical axis.

    Attributes
    ----------
    depth_m
        (H, W) metres; nan where it was not measured, or with too little confidence.
    view
        Its intrinsics.
    """

    depth_m: Array
    view: PinholeGrid

    def __post_init__(self) -> None:
        depth_m = np.array(self.depth_m, dtype=np.float64)
        if depth_m.shape != (self.view.height, self.view.width):
            raise ValueError(f"depth of shape {depth_m.shape} in a view of {self.view.height} x {self.view.width}")
        depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = np.nan
        depth_m.setflags(write=False)
        set_fields(self, depth_m=depth_m)


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthMaps:
    """Depth maps of frames, each of which is read where it is needed.

    Attributes
    ----------
    names
        (N,) of the frames that have one, in the order of time.
    read
        Reads the map of one of them.
    source
        What wrote them, in a word.
    is_fused
        Whether the device made them from more than its depth sensor: from images and its own motion, too.
    files
        Paths of the files behind, by name; empty where there are none.
    """

    names: tuple[str, ...]
    read: Callable[[str], DepthMap] = field(compare=False)
    source: str
    is_fused: bool = False
    files: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    def renamed(self, own: Mapping[str, str]) -> DepthMaps:
        """The maps under other names.

        Parameters
        ----------
        own
            This one's name of a map by the other.
        """
        having = set(self.names)
        named = {other: name for other, name in own.items() if name in having}
        files = {other: self.files[name] for other, name in named.items() if name in self.files}
        return replace(self, names=tuple(named), read=lambda other: self.read(named[other]), files=files)
