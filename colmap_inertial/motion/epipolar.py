"""Poses of two views by the distances of their matches from the epipolar planes.

With rays ``f`` and ``g`` and a rotation ``R``, the normals ``n = f x R g`` of a pair's matches are perpendicular to its
translation (L. Kneip, S. Lynen, *Direct optimization of frame-to-frame rotation*, ICCV 2013).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import cross, find_tangents, skew, so3_exp

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


@dataclass(frozen=True, kw_only=True)
class RefinementLimits:
    """Limits of :func:`refine_poses`."""

    rounds: int = 20
    #: A match weighs less (Geman-McClure) beyond so many times the usual distance, which is at least this.
    sigmas: float = 2.0
    least_rad: float = 1e-6
    #: No step turns rotation or translation farther; where all are smaller than the least, they have come to rest.
    farthest_rad: float = 0.05
    resting_rad: float = 1e-6
    #: Damping at first, and its factors after a step that makes it worse, or better.
    damping: float = 1e-3
    worse: float = 10.0
    better: float = 0.2


_LIMITS = RefinementLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class RefinedPoses:
    """M relative poses by the matches of their views.

    Attributes
    ----------
    second_from_first
        (M, 3, 3) rotations.
    translation
        (M, 3) unit vectors, frame of the second view, of the sign by which more points lie before both cameras.
    usual_rad
        (M,) one standard deviation of the matches' distances from their epipolar planes, by their median.
    in_front
        (M,) share of the matches whose points lie before both cameras.
    """

    second_from_first: Array
    translation: Array
    usual_rad: Array
    in_front: Array


def refine_poses(second_from_first: Array, translation: Array, rays_first: Array, rays_second: Array) -> RefinedPoses:
    """Refine M relative poses by the Sampson distances of their matches on the unit sphere.

    Damped Gauss-Newton steps, of all pairs at once. COLMAP's own refinement weighs all matches alike: two of two
    hundred that are wrong by some pixels turn views that hardly moved by tenths of a degree.

    Parameters
    ----------
    second_from_first
        (M, 3, 3) rotations to begin with.
    translation
        (M, 3) unit vectors to begin with, frame of the second view; of either sign.
    rays_first, rays_second
        (M, K, 3) unit rays of matches.
    """
    turn, move = second_from_first, translation
    damping = np.full(len(turn), _LIMITS.damping)
    off, slope = _linearise_distances(turn, move, rays_first, rays_second)
    for _ in range(_LIMITS.rounds):
        scale = _LIMITS.sigmas * np.maximum(_usual_size(off), _LIMITS.least_rad)[:, None]
        weight = 1 / (1 + (off / scale) ** 2) ** 2
        normal = np.einsum("mki,mk,mkj->mij", slope, weight, slope)
        normal += (damping * np.trace(normal, axis1=1, axis2=2) / 5)[:, None, None] * np.eye(5)
        step = -np.linalg.solve(normal, np.einsum("mki,mk,mk->mi", slope, weight, off)[..., None])[..., 0]
        step *= np.minimum(1, _LIMITS.farthest_rad / np.maximum(np.linalg.norm(step, axis=1), 1e-300))[:, None]
        new_turn = so3_exp(step[:, :3]) @ turn
        new_move = move + np.einsum("mij,mj->mi", find_tangents(move), step[:, 3:])
        new_move /= np.linalg.norm(new_move, axis=1, keepdims=True)
        new_off, new_slope = _linearise_distances(new_turn, new_move, rays_first, rays_second)
        better = _robust_cost(new_off, scale) < _robust_cost(off, scale)
        turn, move = np.where(better[:, None, None], new_turn, turn), np.where(better[:, None], new_move, move)
        off, slope = np.where(better[:, None], new_off, off), np.where(better[:, None, None], new_slope, slope)
        damping *= np.where(better, _LIMITS.better, _LIMITS.worse)
        if np.abs(step).max(initial=0.0) < _LIMITS.resting_rad:
            break
    forward, backward = _shares_in_front(turn, move, rays_first, rays_second)
    return RefinedPoses(
        second_from_first=turn,
        translation=np.where((forward >= backward)[:, None], move, -move),
        usual_rad=_usual_size(off),
        in_front=np.maximum(forward, backward),
    )


def _shares_in_front(turn: Array, move: Array, rays_first: Array, rays_second: Array) -> tuple[Array, Array]:
    """(M,) shares of matches whose points lie before both cameras, with the translation's sign and with the other."""
    a, g, t = rays_first @ np.swapaxes(turn, 1, 2), rays_second, move[:, None]
    normal = cross(g, a)
    first, second = np.sum(cross(t, g) * normal, axis=2), np.sum(cross(t, a) * normal, axis=2)
    return ((first > 0) & (second > 0)).mean(axis=1), ((first < 0) & (second < 0)).mean(axis=1)


def _linearise_distances(turn: Array, move: Array, rays_first: Array, rays_second: Array) -> tuple[Array, Array]:
    """(M, K) distances of matches from their epipolar planes, radians, to first order, and their (M, K, 5) derivatives.

    With ``a = R f`` and the other view's ray ``g`` the distance is ``g . (t x a) / s`` with ``s^2 = |t x a|^2 +
    |t x g|^2``; derivatives are those by a turn after R, and by a move of t along its tangents.
    """
    a, g, t = rays_first @ np.swapaxes(turn, 1, 2), rays_second, move[:, None]
    tangents = find_tangents(move)
    along_a, along_g = np.sum(a * t, axis=2, keepdims=True), np.sum(g * t, axis=2, keepdims=True)
    size = np.sqrt(np.maximum(2 - along_a**2 - along_g**2, 1e-12))
    normal = cross(a, g)
    off = np.sum(normal * t, axis=2, keepdims=True) / size
    by_turn = cross(a, cross(g, t)) + off / size * along_a * cross(a, t)
    by_move = normal + off / size * (along_a * a + along_g * g)
    return off[..., 0], np.concatenate([by_turn, by_move @ tangents], axis=2) / size


def _usual_size(off: Array) -> Array:
    """(M,) one standard deviation of (M, K) values around zero, by their median."""
    return np.asarray(1.4826 * np.median(np.abs(off), axis=1))


def _robust_cost(off: Array, scale: Array) -> Array:
    """(M,) sum of (M, K) values as Geman and McClure weigh them."""
    square = (off / scale) ** 2
    return np.asarray(np.sum(square / (1 + square), axis=1))
