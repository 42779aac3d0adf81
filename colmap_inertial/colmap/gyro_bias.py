"""The gyroscope's bias from matches of neighbouring images, all pairs together.

A rotation by two views alone is poor where they show a wall: a camera that moves sideways looks like one that turns.
The gyroscope knows the rotation but for its bias, which is one for all pairs. With the rotation, every match says that
the direction of translation lies in a plane; the bias is sought for which the planes of each pair have a direction in
common (L. Kneip, S. Lynen, *Direct optimization of frame-to-frame rotation*, ICCV 2013).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import skew, so3_exp
from colmap_inertial.core.threads import one_blas_thread

#: Pairs are left out whose planes meet worse than so many times the usual pair's.
_OUTLIER = 3.0
#: The bias is less sure than residuals say by this factor: matches of a pair err together.
_LOOSER = 3.0
#: Fewer pairs say too little.
_LEAST_PAIRS = 8
#: Matches of the usual pair lie about this close to their epipolar lines, or the gyroscope does not suit them: half a
#: pixel on V1_01; where matches join copies of one thing, two.
_LARGEST_PX = 1.0
#: For derivatives: a tenth of a degree in a third of a second.
_STEP_RAD_S = 5e-3
#: The cross product: of vectors f and g, ``einsum("abc,b,c", _CROSS, f, g)``.
_CROSS = np.stack([skew(axis) for axis in np.eye(3)], axis=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class RayPairs:
    """Matches of M pairs of images, K of each.

    Attributes
    ----------
    first, second
        (M,) places of the images.
    pixel_rad
        What a pixel spans.
    rays_first, rays_second
        (M, K, 3) unit rays, in each camera's frame.
    """

    first: IndexArray
    second: IndexArray
    pixel_rad: float
    rays_first: Array
    rays_second: Array

    def only(self, which: BoolArray) -> RayPairs:
        """Some of the pairs."""
        return RayPairs(
            first=self.first[which],
            second=self.second[which],
            pixel_rad=self.pixel_rad,
            rays_first=self.rays_first[which],
            rays_second=self.rays_second[which],
        )


@one_blas_thread()
def bias_correction(pairs: RayPairs, start_from_cam: Array, bias_lever_s: Array) -> tuple[Array, Array]:
    """What to add to the bias that orientations were integrated with, (3,) rad/s, and its covariance (3, 3).

    Parameters
    ----------
    pairs
        Of images close in time.
    start_from_cam, bias_lever_s
        (N, 3, 3) orientations, and what a change of the bias turns them by (``GyroPath.bias_lever``).

    Raises
    ------
    NotObservableError
        Where there are too few pairs, or no bias suits most of them.
    """
    from scipy.optimize import minimize

    if len(pairs.first) < _LEAST_PAIRS:
        raise NotObservableError("gyroscope bias", f"{len(pairs.first)} pairs of neighbouring images are too few")
    before, after = start_from_cam[pairs.first], start_from_cam[pairs.second]
    rays_first = pairs.rays_first @ np.swapaxes(before, 1, 2)
    lever = bias_lever_s[pairs.second] - bias_lever_s[pairs.first]
    rays_second = pairs.rays_second @ np.swapaxes(after, 1, 2)

    # a normal is linear in the products of its rays' coordinates: what all matches of a pair say is summed once
    products = _squares((rays_first[..., :, None] * rays_second[..., None, :]).reshape(*rays_first.shape[:2], 9))
    of_first, of_second = _squares(rays_first), _squares(rays_second)

    def spread(change: Array) -> Array:
        turn = so3_exp(-(lever @ change))
        normal_from_products = np.einsum("abc,mcd->mabd", _CROSS, turn).reshape(len(turn), 3, 9)
        normals = normal_from_products @ products @ np.swapaxes(normal_from_products, 1, 2)
        # noise of both rays, as it shows along a translation: without it, one along the view would suit everything
        noise = 2 * np.eye(3) - (of_first + turn @ of_second @ np.swapaxes(turn, 1, 2))
        whiten = np.linalg.inv(np.linalg.cholesky(noise))
        return np.asarray(np.linalg.eigvalsh(whiten @ normals @ np.swapaxes(whiten, 1, 2))[:, 0])

    change = np.zeros(3)
    for _ in range(4):
        usual = max(float(np.median(spread(change))), 1e-12)

        def cost(x: Array, usual: float = usual) -> float:
            ratio = spread(x) / (_OUTLIER * usual)
            return float(np.sum(ratio / (1 + ratio)))

        found = minimize(cost, change, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-6, "maxiter": 400})
        moved, change = float(np.abs(found.x - change).max()), np.asarray(found.x)
        if moved < 1e-5:
            break
    least = spread(change)
    variance = max(float(np.median(least)), 1e-12)
    weight = pairs.rays_first.shape[1] / (1 + least / (_OUTLIER * variance)) ** 2 / variance
    if variance > (_LARGEST_PX * pairs.pixel_rad) ** 2:
        raise NotObservableError("gyroscope bias", "matches of neighbouring images suit no bias")
    information = _curvature(lambda x: float(weight @ spread(x)), change)
    values = np.linalg.eigvalsh(information)
    if values[0] <= 0:
        raise NotObservableError("gyroscope bias", "the matches of neighbouring images suit any bias")
    return change, np.asarray(_LOOSER**2 * np.linalg.inv(information))


def _squares(vectors: Array) -> Array:
    """(M, D, D) mean of the products of (M, K, D) vectors with themselves."""
    return np.asarray(np.swapaxes(vectors, 1, 2) @ vectors / vectors.shape[1])


def _curvature(squares: Callable[[Array], float], at: Array) -> Array:
    """Half the second derivative of a sum of squares, (3, 3)."""
    axes = _STEP_RAD_S * np.eye(3)
    middle = squares(at)
    out = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            if a == b:
                out[a, a] = squares(at + axes[a]) - 2 * middle + squares(at - axes[a])
            else:
                p, m = axes[a] + axes[b], axes[a] - axes[b]
                out[a, b] = (squares(at + p) - squares(at + m) - squares(at - m) + squares(at - p)) / 4
    return out / (2 * _STEP_RAD_S**2)
