"""Depth of one view registered to that of another: metres per unit of the path between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, so3_exp
from colmap_inertial.evidence._surface import SPREAD_PX2, Surface


@dataclass(frozen=True, kw_only=True)
class PairLimits:
    """How two views are registered."""

    #: Points of a view that are compared.
    points: int = 1500
    iterations: int = 12
    #: The fit has come to rest where the logarithm of the scale moves by less.
    rest_log: float = 1e-5
    #: Poses of neighbouring frames may be wrong by this against each other (standard deviations).
    turn_rad: float = 0.005
    shift_m: float = 0.005
    #: Overlap below this share of the points is none.
    overlap: float = 0.3
    #: Of residuals (standard deviations), beyond which they count less: what moved, glass, what was hidden.
    outlier: float = 2.0
    #: Roughness of surfaces at the scale of a window: neighbouring residuals are alike, by so many pixels.
    alike_px: float = 49.0


_LIMITS = PairLimits()


@dataclass(frozen=True, kw_only=True)
class PairScale:
    """What a pair of views says.

    Attributes
    ----------
    log_scale, sigma
        Logarithm of metres per unit of the path, and its standard deviation by the fit alone.
    overlap
        Share of the points that the other view shows, too.
    """

    log_scale: float
    sigma: float
    overlap: float


def register_pair(
    of: Surface, other: Surface, other_from_of: tuple[Array, Array], log_scale: float, limits: PairLimits = _LIMITS
) -> PairScale | None:
    """Scale by which the path must grow for one view's depth to lie on the other's.

    Inverse depths are compared where points of one view fall into the other. Beside the scale, the pose between both
    may be off, with a prior.

    Parameters
    ----------
    of, other
        Two views.
    other_from_of
        Rotation (3, 3) and translation (3,) in units of the path.
    log_scale
        Where the search starts.

    Returns
    -------
    ``None`` where they do not overlap, or do not agree anywhere.
    """
    rotation, translation = other_from_of
    rows, columns = np.nonzero(of.smooth)
    if len(rows) < limits.points // 10:
        return None
    step = max(1, len(rows) // limits.points)
    rows, columns = rows[::step], columns[::step]
    rays = of.source.view.rays()[rows, columns]
    turned = (rays / of.inverse[rows, columns][:, None]) @ rotation.T
    x = np.array([log_scale, 0, 0, 0, 0, 0, 0])
    prior = np.array([0.0, *(1 / limits.turn_rad**2,) * 3, *(1 / limits.shift_m**2,) * 3])
    count = len(rows)
    for _ in range(limits.iterations):
        moved = turned + np.exp(x[0]) * translation
        placed = moved @ so3_exp(x[1:4]).T
        point = placed + x[4:7]
        hit = _look_up(other, point)
        if hit is None or len(hit.kept) < limits.overlap * count:
            return None
        at = placed[hit.kept]
        # d point: by the scale, by a small further turn on the left, by a shift
        by_scale = np.exp(x[0]) * (so3_exp(x[1:4]) @ translation)
        jacobian = np.empty((len(hit.kept), 7))
        jacobian[:, 0] = hit.gradient @ by_scale
        jacobian[:, 1:4] = np.cross(at, hit.gradient)
        jacobian[:, 4:7] = hit.gradient
        spread = 1.4826 * float(np.median(np.abs(hit.residual * hit.depth_m**2)))
        sigma = np.maximum(spread, 1e-4) / hit.depth_m**2
        z = hit.residual / sigma
        weight = np.where(np.abs(z) < limits.outlier, 1.0, limits.outlier / np.abs(z)) / sigma**2
        weight *= min(1.0, step / limits.alike_px)
        normal = jacobian.T @ (weight[:, None] * jacobian) + np.diag(prior)
        change = np.linalg.solve(
            normal + 1e-9 * np.diag(np.diag(normal)), -jacobian.T @ (weight * hit.residual) - prior * x
        )
        change[0] = np.clip(change[0], -0.3, 0.3)
        x = x + change
        if abs(change[0]) < limits.rest_log:
            break
    else:
        if abs(change[0]) > 100 * limits.rest_log:
            return None
    assert hit is not None
    # slopes are noisy, too, which looks like information: walls that slide along themselves would have some
    information = float(1 / np.linalg.inv(normal + 1e-9 * np.diag(np.diag(normal)))[0, 0])
    information -= float(weight @ (hit.slope_sigma * np.linalg.norm(hit.by_slope @ by_scale, axis=1)) ** 2)
    if not information > 0:
        return None
    return PairScale(log_scale=float(x[0]), sigma=information**-0.5, overlap=len(hit.kept) / count)


#: Depths that differ by this share or more disagree, whatever the rest.
_DISAGREE = 0.1


def disagreement(of: Surface, other: Surface, other_from_of: tuple[Array, Array], log_scales: Array) -> Array:
    """(K,) how far depths of one view are from another's for each of K scales of the path; 0 to 1, which is not at all.

    Parameters
    ----------
    of, other, other_from_of
        As of :func:`register_pair`.
    log_scales
        (K,) logarithms of metres per unit.
    """
    rotation, translation = other_from_of
    rows, columns = np.nonzero(of.smooth)
    out = np.ones(len(log_scales))
    if len(rows) == 0:
        return out
    step = max(1, len(rows) // 500)
    rows, columns = rows[::step], columns[::step]
    turned = (of.source.view.rays()[rows, columns] / of.inverse[rows, columns][:, None]) @ rotation.T
    for k, log_scale in enumerate(log_scales.tolist()):
        hit = _look_up(other, turned + np.exp(log_scale) * translation)
        if hit is not None:
            share = np.minimum(np.abs(hit.residual) * hit.depth_m / _DISAGREE, 1.0)
            out[k] = 1.0 - (1.0 - share).sum() / len(turned)
    return out


@dataclass(frozen=True, eq=False, kw_only=True)
class _Hit:
    """Where points fall into a view.

    ``kept`` (K,) are their numbers; ``residual`` (K,) their inverse depth less the view's, 1/m; ``gradient`` (K, 3) its
    derivative by the point; ``by_slope`` (K, 2, 3) the derivative of that by the surface's slope, ``slope_sigma`` (K,)
    the slope's standard deviation; ``depth_m`` (K,).
    """

    kept: Array
    residual: Array
    gradient: Array
    by_slope: Array
    slope_sigma: Array
    depth_m: Array


def _look_up(view: Surface, point: Array) -> _Hit | None:
    grid = view.source.view
    z = point[:, 2]
    front = np.flatnonzero(z > 1e-3)
    if len(front) == 0:
        return None
    (focal_x, focal_y), (centre_x, centre_y) = grid.focal_px, grid.centre_px
    x, y, z = point[front].T
    u, v = focal_x * x / z + centre_x, focal_y * y / z + centre_y
    column, row = np.floor(u).astype(np.intp), np.floor(v).astype(np.intp)
    inside = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height)
    front, x, y, z, u, v, column, row = (a[inside] for a in (front, x, y, z, u, v, column, row))
    on = view.smooth[row, column]
    front, x, y, z, u, v, column, row = (a[on] for a in (front, x, y, z, u, v, column, row))
    if len(front) == 0:
        return None
    slope = view.slope[row, column]
    seen = view.inverse[row, column] + slope[:, 0] * (u - column - 0.5) + slope[:, 1] * (v - row - 0.5)
    seen = np.maximum(seen, 1e-3)
    # derivatives of the pixel by the point: the slope of the surface goes along with them
    by_slope = np.zeros((len(z), 2, 3))
    by_slope[:, 0, 0], by_slope[:, 0, 2] = -focal_x / z, focal_x * x / z**2
    by_slope[:, 1, 1], by_slope[:, 1, 2] = -focal_y / z, focal_y * y / z**2
    gradient = np.einsum("ki,kij->kj", slope, by_slope)
    gradient[:, 2] -= 1 / z**2
    return _Hit(
        kept=front,
        residual=1 / z - seen,
        gradient=gradient,
        by_slope=by_slope,
        slope_sigma=view.noise[row, column] / SPREAD_PX2**0.5,
        depth_m=1 / seen,
    )


def relative_pose(xyzw: Array, centres: Array, of: int, other: int) -> tuple[Array, Array]:
    """Rotation and translation ``other_from_of`` of two poses of a path."""
    rotations = matrix_from_quat(xyzw[[of, other]])
    return rotations[1] @ rotations[0].T, rotations[1] @ (centres[of] - centres[other])
