"""How well a rotation suits the matches of two views, whatever the translation between them.

With rays ``f`` and ``g`` and a rotation ``R``, the normals ``n = f x R g`` of a pair's matches are perpendicular to its
translation (L. Kneip, S. Lynen, *Direct optimization of frame-to-frame rotation*, ICCV 2013).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import skew

#: The cross product: of vectors f and g, ``einsum("abc,b,c", _CROSS, f, g)``.
_CROSS = np.stack([skew(axis) for axis in np.eye(3)], axis=1)
#: Keeps the noise of rays that are all alike invertible; small against that of an image one degree wide.
_REGULAR = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class RayMoments:
    """What the matches of M pairs of views say of rotations, summed over the matches.

    Attributes
    ----------
    of_first, of_second
        (M, 3, 3) mean of the products of rays with themselves.
    of_products
        (M, 9, 9) of the products of both rays' coordinates, of which normals are linear functions.
    """

    of_first: Array
    of_second: Array
    of_products: Array

    @classmethod
    def of(cls, rays_first: Array, rays_second: Array) -> RayMoments:
        """Of (M, K, 3) unit rays of each view."""
        products = rays_first[..., :, None] * rays_second[..., None, :]
        return cls(
            of_first=_mean_squares(rays_first),
            of_second=_mean_squares(rays_second),
            of_products=_mean_squares(products.reshape(*rays_first.shape[:2], 9)),
        )

    def measure_spread(self, first_from_second: Array) -> Array:
        """(M,) mean square angle of the matches from their epipolar planes, by the translation that suits rotations
        (M, 3, 3) best.
        """
        turn = first_from_second
        normal_from_products = np.einsum("abc,mcd->mabd", _CROSS, turn).reshape(len(turn), 3, 9)
        normals = normal_from_products @ self.of_products @ np.swapaxes(normal_from_products, 1, 2)
        # noise of both rays, as it shows along a translation: without it, one along the view would suit everything
        noise = (2 + _REGULAR) * np.eye(3) - (self.of_first + turn @ self.of_second @ np.swapaxes(turn, 1, 2))
        whiten = np.linalg.inv(np.linalg.cholesky(noise))
        return np.asarray(np.linalg.eigvalsh(whiten @ normals @ np.swapaxes(whiten, 1, 2))[:, 0])


def _mean_squares(vectors: Array) -> Array:
    """(M, D, D) mean of the products of (M, K, D) vectors with themselves."""
    return np.asarray(np.swapaxes(vectors, 1, 2) @ vectors / vectors.shape[1])
