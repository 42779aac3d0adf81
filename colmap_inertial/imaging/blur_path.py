"""Motion blur of an image as the curve that each pixel smears along."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, Float32Array
from colmap_inertial.imaging._bilinear import bilinear
from colmap_inertial.imaging.blur_field import BlurField, check_nodes, spread_cov

#: Samples of the exposure; of longer blur, one for each so many pixels.
SAMPLES, SAMPLE_PX = 17, 2.0


@dataclass(frozen=True, eq=False, kw_only=True)
class BlurPath:
    """Path of each pixel's light across the sharp image during the exposure.

    The blurred image is ``g(x) = mean over k of L(x + q_k(x))``, ``L`` the sharp image of the same shutter. The
    path q has a sign and a middle of its own: reversed in time it is another one where it is curved.

    Attributes
    ----------
    width, height
        Size of the image, px.
    step_px
        Distance of the nodes, which lie as those of a `BlurField`; between them the path is bilinear.
    path_px
        (S, Gy, Gx, 2) float32 q (x, y) at the middles of S equal parts of the exposure, px.
    cov_px2
        (Gy, Gx, 3) float32 covariance of its chord, as that of a `BlurField`.
    """

    width: int
    height: int
    path_px: np.ndarray[tuple[int, int, int, int], np.dtype[np.float32]]
    step_px: int = 64
    cov_px2: Float32Array = field(default_factory=lambda: np.zeros(3, np.float32))

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0 or self.step_px <= 0:
            raise ValueError("width, height and step_px must be positive")
        nodes = BlurField.nodes(self.width, self.height, self.step_px)
        samples = max(2, len(self.path_px))
        object.__setattr__(self, "path_px", check_nodes("path_px", self.path_px, (samples, *nodes, 2)))
        object.__setattr__(self, "cov_px2", spread_cov(self.cov_px2, nodes))

    @classmethod
    def straight(cls, lines: BlurField) -> BlurPath:
        """Along the centred lines of a field."""
        samples = samples_for(float(lines.extent_px().max(initial=0)))
        path = (middles(samples)[:, None, None, None] * lines.vector_px).astype(np.float32)
        return cls(width=lines.width, height=lines.height, step_px=lines.step_px, path_px=path, cov_px2=lines.cov_px2)

    def field(self) -> BlurField:
        """The chords: ends of the paths minus their beginnings."""
        samples = len(self.path_px)
        chord = (self.path_px[-1] - self.path_px[0]) * np.float32(samples / (samples - 1))
        return BlurField(
            width=self.width, height=self.height, step_px=self.step_px, vector_px=chord, cov_px2=self.cov_px2
        )

    def times(self, factor: float) -> BlurPath:
        """So many times as long."""
        return replace(self, path_px=self.path_px * np.float32(factor), cov_px2=self.cov_px2 * np.float32(factor**2))

    def halved(self) -> BlurPath:
        """The path of the image at half its size, each pixel of which is two by two; odd sizes are rounded up."""
        width, height = -(-self.width // 2), -(-self.height // 2)
        rows, columns = BlurField.nodes(width, height, self.step_px)
        at = [2 * self.step_px * np.arange(n) + 0.5 for n in (rows, columns)]
        return BlurPath(
            width=width,
            height=height,
            step_px=self.step_px,
            path_px=(np.moveaxis(self.at(*at), 2, 0) / 2).astype(np.float32),
            cov_px2=(self.cov_at(*at) / 4).astype(np.float32),
        )

    def cov_at(self, rows_px: AnyArray, columns_px: AnyArray) -> Array:
        """(R, C, 3) covariance of the chord at the crossings of rows and columns of pixels."""
        nodes = self.cov_px2.astype(np.float64)
        return bilinear(nodes, np.asarray(rows_px) / self.step_px, np.asarray(columns_px) / self.step_px)

    def departure_px(self) -> float:
        """Largest distance of a path from its chord, anywhere in the image."""
        path = self.path_px - self.path_px.mean(axis=0)
        chord = self.field().vector_px
        line = middles(len(path))[:, None, None, None] * chord
        return float(np.hypot(*np.moveaxis(path - line, -1, 0)).max())

    def extent_px(self) -> float:
        """The longest way that a path covers along x or y or in all, anywhere in the image."""
        samples = len(self.path_px)
        span = np.ptp(self.path_px, axis=0) * samples / (samples - 1)
        return float(np.hypot(span[..., 0], span[..., 1]).max())

    def at(self, rows_px: AnyArray, columns_px: AnyArray) -> Array:
        """(R, C, S, 2) the path at the crossings of rows and columns of pixels, between them, too."""
        nodes = np.moveaxis(self.path_px, 0, 2).astype(np.float64)
        return bilinear(nodes, np.asarray(rows_px) / self.step_px, np.asarray(columns_px) / self.step_px)


def samples_for(extent_px: float) -> int:
    """Number of samples of the exposure for blur of this length."""
    return max(SAMPLES, int(np.ceil(extent_px / SAMPLE_PX)))


def middles(samples: int) -> Array:
    """(S,) the middles of equal parts of an exposure that lasts from -1/2 to 1/2."""
    return (np.arange(samples) + 0.5) / samples - 0.5
