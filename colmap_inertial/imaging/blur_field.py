"""Motion blur of an image: one vector for each pixel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, Float32Array
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.imaging._bilinear import bilinear


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class BlurField:
    """The line segment that each pixel smears along while it is exposed, centred on the pixel.

    Attributes
    ----------
    width, height
        Size of the image, px.
    step_px
        Distance of the nodes: node ``(i, j)`` sits on the centre of the pixel in row ``i step_px`` and column
        ``j step_px``. The last nodes lie on or beyond the last row and column.
    vector_px
        (Gy, Gx, 2) float32 blur vectors (x, y) at the nodes, px: the end of the segment minus its beginning.
        Between nodes the field is bilinear. A vector and its negative are the same blur.
    cov_px2
        (Gy, Gx, 3) float32 covariance of each (xx, xy, yy), px^2, or what spreads to that; nothing where it is certain.
    """

    width: int
    height: int
    vector_px: np.ndarray[tuple[int, int, int], np.dtype[np.float32]]
    step_px: int = 16
    cov_px2: Float32Array = field(default_factory=lambda: np.zeros(3, np.float32))

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0 or self.step_px <= 0:
            raise ValueError("width, height and step_px must be positive")
        nodes = self.nodes(self.width, self.height, self.step_px)
        object.__setattr__(self, "vector_px", check_nodes("vector_px", self.vector_px, (*nodes, 2)))
        object.__setattr__(self, "cov_px2", spread_cov(self.cov_px2, nodes))

    @staticmethod
    def nodes(width: int, height: int, step_px: int = 16) -> tuple[int, int]:
        """Numbers of node rows and node columns of an image; at least two of each."""
        return max(2, -(-(height - 1) // step_px) + 1), max(2, -(-(width - 1) // step_px) + 1)

    @classmethod
    def uniform(cls, width: int, height: int, vector_px: tuple[float, float], step_px: int = 16) -> BlurField:
        """The same blur everywhere."""
        grid = np.broadcast_to(np.asarray(vector_px, dtype=np.float32), (*cls.nodes(width, height, step_px), 2))
        return cls(width=width, height=height, vector_px=grid, step_px=step_px)

    def at(self, rows_px: AnyArray, columns_px: AnyArray) -> Array:
        """(R, C, 2) the field at the crossings of rows and columns of pixels, between them, too."""
        nodes = self.vector_px.astype(np.float64)
        return bilinear(nodes, np.asarray(rows_px) / self.step_px, np.asarray(columns_px) / self.step_px)

    def per_pixel(self) -> Array:
        """(height, width, 2) the field at every pixel."""
        return self.at(np.arange(self.height), np.arange(self.width))

    def times(self, factor: float) -> BlurField:
        """So many times as long."""
        return replace(
            self, vector_px=self.vector_px * np.float32(factor), cov_px2=self.cov_px2 * np.float32(factor**2)
        )

    def extent_px(self) -> Array:
        """(Gy, Gx) lengths of the vectors at the nodes."""
        return np.asarray(np.hypot(self.vector_px[..., 0], self.vector_px[..., 1]), dtype=np.float64)

    def unsure_share(self) -> float:
        """Uncertainty of the vectors relative to their length, over the image."""
        off, whole = float(self.cov_px2[..., ::2].sum()), float(np.sum(self.vector_px.astype(np.float64) ** 2))
        return (off / whole) ** 0.5 if whole > 0 else 0.0


def check_nodes(name: str, value: AnyArray, shape: tuple[int, ...]) -> AnyArray:
    """A read-only float32 copy of finite values, of a shape."""
    out = np.array(value, dtype=np.float32)
    if out.shape != shape:
        raise ValueError(f"{name}: shape {out.shape}, expected {shape}")
    if not np.isfinite(out).all():
        raise ValueError(f"{name}: must be finite")
    out.setflags(write=False)
    return out


def spread_cov(cov_px2: Float32Array, nodes: tuple[int, int]) -> Float32Array:
    """(Gy, Gx, 3) checked, not to be written to."""
    cov = np.broadcast_to(np.asarray(cov_px2, dtype=np.float32), (*nodes, 3)).copy()
    if not (np.isfinite(cov).all() and (cov[..., ::2] >= 0).all()):
        raise ValueError("cov_px2: must be finite, with variances that are not negative")
    cov.setflags(write=False)
    return cov
