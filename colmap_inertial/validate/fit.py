"""The size of a rigid planar target in a model: maximum likelihood in the images, with a 95 % interval.

The unknowns are the target's similarity (one scale for all parts, a rotation and a position for each); the cameras are
the model's. Every corner has white noise of one unknown size, and every view a pose error of its own, made of the kinds
in :data:`POSE_ERRORS`: all distances of a view share it, so treating corners as independent would promise too much.

The variances of pose errors, relative to that of the corner noise, come from the residuals by restricted maximum
likelihood (Patterson & Thompson 1971; Searle, Casella & McCulloch, Variance Components, 1992, chapter 6). The interval
of the scale's logarithm is Student's t with the degrees of freedom of Satterthwaite's approximation (Giesbrecht & Burns
1985). All sums over corners are taken once; what remains are 6x6 matrices by view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import skew, so3_exp
from colmap_inertial.validate.observations import Observations, Placement, linearise


@dataclass(frozen=True, kw_only=True)
class FitLimits:
    """The size of the target and its interval."""

    #: Two images agree on many a wrong board; a result of fewer is not proved.
    enough_views: int = 3
    #: Corners beyond so many standard deviations do not belong.
    outlier_sigma: float = 5.0
    #: Views whose residuals are so many times those of the others do not belong.
    outlier_view_ratio: float = 4.0
    #: A half-width of the 95 % interval of this factor is no result.
    widest_factor: float = 1.3
    #: Single markers whose size differs by more (logarithm) are not what the description says.
    outlying_marker_log: float = 0.05
    #: Pose errors are assumed where they raise twice the log likelihood by more than this. Of data without any, one
    #: set in six passes; always assuming them would widen the intervals of such data to 97 % coverage, and a stricter
    #: test would miss small real ones.
    pose_error_evidence: float = 3.0
    #: A variance component whose effect in one view is below this share of the corner noise counts as zero.
    negligible_ratio: float = 2e-3
    largest_ratio: float = 1e6
    most_iterations: int = 50
    #: The fit has settled when a step would lower the cost by less than this share of the noise variance (a
    #: ten-thousandth of a standard deviation), or by less than this in all.
    settled_share: float = 1e-8
    settled_px2: float = 1e-14
    #: Points that a rigid motion needs, with one to spare.
    least_points: int = 4
    #: Shares of the model's diagonal below which a length says little of the whole, and above which it says much.
    short_share: float = 0.2
    long_share: float = 0.66
    #: Points left out on each side when the model's diagonal is taken.
    outside_pct: float = 1.5
    #: Least spread of the directions of the lengths along an axis, of the largest, to count as one of its own.
    own_direction: float = 0.1


FIT = FitLimits()

#: Kinds of pose error: turn of the camera across the line of sight and about it, shift along the line of sight, turn
#: about the target (the kind that bundle adjustment leaves, where place and aim err together), shift across the line of
#: sight. Shifts are divided by the median distance.
POSE_ERRORS = ("aim_rad", "roll_rad", "range_relative", "orbit_rad", "shift_relative")
_DIMENSIONS = np.array([2.0, 1.0, 1.0, 2.0, 2.0])


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations with each view's pose error kept apart: y = A x + B e_view + noise.

    Attributes
    ----------
    aa, ay, yy
        (p, p), (p,) and scalar products over all corners.
    bb, ba, by
        (V, 6, 6), (V, 6, p), (V, 6) products over the corners of each view. A pose error is a turn (rad) and a shift
        (divided by the median distance) of the camera, in its own frame.
    shapes
        (K, V, 6, 6) covariance of a view's pose error for a unit of each kind.
    count
        Number of residuals.
    """

    aa: Array
    ay: Array
    yy: float
    bb: Array
    ba: Array
    by: Array
    shapes: Array
    count: int


def _derivatives(obs: Observations, at: Placement) -> tuple[Array, Array, Array, Array]:
    """Those of the corners by the placement (M, 2, p), and what :func:`linearise` gives.

    Raises
    ------
    NotObservableError
        When a corner lies behind its camera.
    """
    residual, in_cam, jac = linearise(obs, at)
    if not np.isfinite(residual).all():
        raise NotObservableError("scale", Fact("target-behind-camera"))
    parts = len(at.rotation)
    rotated = np.exp(at.log_scale) * np.einsum("mij,mj->mi", at.rotation[obs.part], obs.target_m)
    jac_world = jac @ obs.cam_from_world[obs.view]
    a = np.zeros((len(obs), 2, 1 + 6 * parts))
    a[:, :, 0] = np.einsum("mij,mj->mi", jac_world, rotated)
    block = np.concatenate([-jac_world @ skew(rotated), jac_world], axis=2)
    columns = 1 + 6 * obs.part[:, None] + np.arange(6)
    np.put_along_axis(a, np.broadcast_to(columns[:, None, :], block.shape), block, axis=2)
    return a, residual, in_cam, jac


def plain_equations(obs: Observations, at: Placement) -> tuple[Array, Array, float]:
    """Normal matrix (p, p), right side (p,) and the residuals' sum of squares where poses have no errors."""
    a, residual, _, _ = _derivatives(obs, at)
    flat, y = a.reshape(-1, a.shape[2]), residual.ravel()
    return flat.T @ flat, flat.T @ y, float(y @ y)


def normal_equations(obs: Observations, at: Placement) -> tuple[Normal, Array, Array]:
    """Normal equations at a placement, with the pose derivatives (M, 2, 6) and the residuals (M, 2)."""
    a, residual, in_cam, jac = _derivatives(obs, at)
    views, first = np.unique(obs.view, return_index=True)
    ends = np.append(first[1:], len(obs))
    unit = float(np.median(np.linalg.norm(in_cam, axis=1)))
    b = np.concatenate([-jac @ skew(in_cam), -unit * jac], axis=2)
    bb, ba, by = np.empty((len(views), 6, 6)), np.empty((len(views), 6, a.shape[2])), np.empty((len(views), 6))
    shapes = np.zeros((len(POSE_ERRORS), len(views), 6, 6))
    for v, (i, j) in enumerate(zip(first, ends, strict=True)):
        bv, av, rv = b[i:j].reshape(-1, 6), a[i:j].reshape(-1, a.shape[2]), residual[i:j].ravel()
        bb[v], ba[v], by[v] = bv.T @ bv, bv.T @ av, bv.T @ rv
        sight = in_cam[i:j].mean(axis=0)
        along = np.outer(sight, sight) / (sight @ sight)
        # a turn about the target is a turn about the camera plus the shift that keeps the target's centre in place
        orbit = np.vstack([np.eye(3), -skew(sight) / unit])
        shapes[0, v, :3, :3] = shapes[4, v, 3:, 3:] = np.eye(3) - along
        shapes[1, v, :3, :3] = shapes[2, v, 3:, 3:] = along
        shapes[3, v] = orbit @ (np.eye(3) - along) @ orbit.T
    flat, y = a.reshape(-1, a.shape[2]), residual.ravel()
    normal = Normal(flat.T @ flat, flat.T @ y, float(y @ y), bb, ba, by, shapes, 2 * len(obs))
    return normal, b, residual


def weigh_equations(n: Normal, ratio: Array) -> tuple[Array, Array, Array, float]:
    """Gain (V, 6, 6) of the pose errors, weighted normal matrix (p, p), right side (p,), and y'y."""
    cov = np.einsum("k,kvij->vij", ratio, n.shapes)
    gain = np.linalg.solve(np.eye(6) + cov @ n.bb, cov)
    gain = 0.5 * (gain + np.swapaxes(gain, 1, 2))
    gain_by = np.einsum("vij,vj->vi", gain, n.by)
    s = n.aa - np.einsum("vki,vkj->ij", n.ba, gain @ n.ba)
    rhs = n.ay - np.einsum("vki,vk->i", n.ba, gain_by)
    return gain, s, rhs, n.yy - float(np.sum(n.by * gain_by))


def solve(s: Array, rhs: Array) -> tuple[Array, float]:
    """Step (p,) and the scale's entry of the inverse; infinite where the data leave the scale free."""
    norm = np.sqrt(np.maximum(np.diag(s), 1e-300))
    w, q = np.linalg.eigh(s / np.outer(norm, norm))
    good = w > 1e-11 * w[-1]
    inverse = (q[:, good] / w[good]) @ q[:, good].T
    free = np.sum(q[0, ~good] ** 2) > 1e-6
    return inverse @ (rhs / norm) / norm, np.inf if free else float(inverse[0, 0] / norm[0] ** 2)


def compute_restricted_likelihood(n: Normal, ratio: Array) -> tuple[float, Array]:
    """Minus twice the restricted log likelihood, corner noise profiled out, and its gradient over ``ratio``."""
    gain, s, rhs, yy = weigh_equations(n, ratio)
    x = np.linalg.solve(s, rhs)
    q = max(yy - float(rhs @ x), 1e-300)
    dof = n.count - len(rhs)
    cov = np.einsum("k,kvij->vij", ratio, n.shapes)
    value = dof * np.log(q) + np.linalg.slogdet(np.eye(6) + cov @ n.bb)[1].sum() + np.linalg.slogdet(s)[1]
    kept = np.eye(6) - n.bb @ gain
    bpb = kept @ n.bb
    f = kept @ n.ba
    g = np.einsum("vij,vj->vi", kept, n.by - n.ba @ x)
    # trace(P B E B'), with P the projection that restricted likelihood weighs by
    bpb = bpb - f @ np.linalg.solve(s, np.swapaxes(f, 1, 2))
    gradient = np.einsum("kvij,vji->k", n.shapes, bpb) - dof / q * np.einsum("vi,kvij,vj->k", g, n.shapes, g)
    return float(value), gradient


def estimate_ratio(n: Normal) -> Array:
    """Restricted maximum likelihood of the pose-error variances: their ratios (K,)."""
    from scipy.optimize import minimize

    # an error of this variance, in each dimension of its kind, is as large as its uncertainty from one view's corners
    unit = len(n.bb) * _DIMENSIONS / np.einsum("kvij,vji->k", n.shapes, n.bb)
    low, high = np.log(FIT.negligible_ratio / 4), np.log(FIT.largest_ratio)
    none = np.zeros(len(unit))
    if np.isinf(
        solve(*weigh_equations(n, none)[1:3])[1]
    ):  # the views leave the scale free: its equations cannot be solved
        return none

    def cost(log_ratio: Array) -> tuple[float, Array]:
        ratio = unit * np.exp(log_ratio)
        value, gradient = compute_restricted_likelihood(n, ratio)
        return value, gradient * ratio

    starts = [np.full(len(unit), np.log(r)) for r in (0.3, 10.0, 300.0, 1e4)]
    start = min(starts, key=lambda x: cost(x)[0])
    minimum = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=[(low, high)] * len(unit))
    if compute_restricted_likelihood(n, none)[0] - minimum.fun < FIT.pose_error_evidence:
        return none
    return np.where(np.exp(minimum.x) < FIT.negligible_ratio, 0.0, unit * np.exp(minimum.x))


def satterthwaite_dof(n: Normal, ratio: Array, corner_var: float, dof: float) -> float:
    """Degrees of freedom of the scale's variance, from the curvature of the restricted likelihood."""
    active = np.flatnonzero(ratio > 0)
    if len(active) == 0:
        return dof

    def parts(log_ratio: Array) -> tuple[Array, float]:
        full = np.zeros(len(ratio))
        full[active] = np.exp(log_ratio)
        gain, s, rhs, yy = weigh_equations(n, full)
        x, inverse = solve(s, rhs)
        q = yy - float(rhs @ x)
        # gradient of -2 log likelihood over (log corner variance, log ratios), corner variance not profiled
        kept = np.eye(6) - n.bb @ gain
        f = kept @ n.ba
        g = np.einsum("vij,vj->vi", kept, n.by - n.ba @ x)
        bpb = kept @ n.bb - f @ np.linalg.solve(s, np.swapaxes(f, 1, 2))
        shapes = n.shapes[active]
        slope = np.einsum("kvij,vji->k", shapes, bpb) - np.einsum("vi,kvij,vj->k", g, shapes, g) / corner_var
        return np.concatenate([[q / corner_var], slope * full[active]]), float(np.log(inverse))

    x0, h, k = np.log(ratio[active]), 1e-3, len(active) + 1
    hessian, slope = np.zeros((k, k)), np.ones(k)
    hessian[0, 0] = dof  # second derivative of dof * u + q exp(-u) at its minimum
    for i in range(len(active)):
        step = h * np.eye(len(active))[i]
        (up, log_up), (down, log_down) = parts(x0 + step), parts(x0 - step)
        hessian[1:, i + 1] = (up[1:] - down[1:]) / (2 * h)
        hessian[0, i + 1] = hessian[i + 1, 0] = -(up[0] - down[0]) / (2 * h)
        slope[i + 1] = (log_up - log_down) / (2 * h)
    w, q = np.linalg.eigh(0.5 * (hessian + hessian.T))
    # -2 log likelihood has twice the curvature of the log likelihood; a flat direction is worth half a sample
    cov = 2 * (q / np.maximum(w, 0.25)) @ q.T
    return float(np.clip(2 / max(slope @ cov @ slope, 1e-12), 1.0, dof))


@dataclass(frozen=True, eq=False, kw_only=True)
class NoiseModel:
    """Sizes of the errors: corner noise, and per-view pose errors relative to it.

    Attributes
    ----------
    corner_px
        Standard deviation of a corner's coordinate.
    pose_ratio
        (5,) variances, in the order of :data:`POSE_ERRORS`, each divided by ``corner_px ** 2``.
    dof
        Degrees of freedom of ``corner_px``.
    """

    corner_px: float
    pose_ratio: Array
    dof: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaleFit:
    """A fitted scale with its uncertainty and residuals.

    Attributes
    ----------
    placement
        The target in the model.
    sigma_log
        Standard deviation of ``placement.log_scale``; infinite where the views do not determine it.
    dof
        Degrees of freedom of ``sigma_log`` (Satterthwaite).
    noise
        The error sizes that were used.
    residual_px
        (M, 2) observed minus projected, with the model's own poses.
    corner_residual_px
        (M, 2) the same after taking out each view's most likely pose error.
    """

    placement: Placement
    sigma_log: float
    dof: float
    noise: NoiseModel
    residual_px: Array
    corner_residual_px: Array

    def half_width_log(self, confidence: float = 0.95) -> float:
        """Half the interval of ``log_scale`` that covers the truth with this probability."""
        from scipy.special import stdtrit

        return float(stdtrit(self.dof, 0.5 + 0.5 * confidence)) * self.sigma_log


def fit_scale(obs: Observations, start: Placement, *, noise: NoiseModel | None = None) -> ScaleFit:
    """Fit the target to its observations.

    Parameters
    ----------
    obs
        What was seen, outliers removed; at least two views.
    start
        Where to begin: every corner in front of its cameras.
    noise
        Error sizes to weigh by; ``None`` estimates them.

    Raises
    ------
    NotObservableError
        When the observations do not outnumber the unknowns, or the fit does not settle.
    """
    at, ratio = start, np.zeros(len(POSE_ERRORS)) if noise is None else noise.pose_ratio
    unknowns = 1 + 6 * len(start.rotation)
    if 2 * len(obs) <= unknowns:
        raise NotObservableError("scale", Fact("corners-too-few", count=len(obs), unknowns=unknowns))
    at = settle(obs, at, pose_ratio=ratio)
    if noise is None:
        for _ in range(2):  # the weights move the fit by a fraction of its error, and that moves the weights less
            ratio = estimate_ratio(normal_equations(obs, at)[0])
            if not ratio.any():
                break
            at = settle(obs, at, pose_ratio=ratio)
    n, b, residual = normal_equations(obs, at)
    gain, s, rhs, yy = weigh_equations(n, ratio)
    step, inverse = solve(s, rhs)
    dof = n.count - unknowns
    if noise is None:
        corner_var = max(yy - float(rhs @ step), 0.0) / dof
        noise = NoiseModel(corner_px=float(np.sqrt(corner_var)), pose_ratio=ratio, dof=float(dof))
        scale_dof = satterthwaite_dof(n, ratio, corner_var, dof) if np.isfinite(inverse) and corner_var > 0 else dof
    else:
        scale_dof = noise.dof
    pose_error = np.einsum("vij,vj->vi", gain, n.by)
    which = np.searchsorted(np.unique(obs.view), obs.view)
    return ScaleFit(
        placement=at,
        sigma_log=noise.corner_px * float(np.sqrt(inverse)),
        dof=float(scale_dof),
        noise=noise,
        residual_px=residual,
        corner_residual_px=residual - np.einsum("mij,mj->mi", b, pose_error[which]),
    )


def settle(
    obs: Observations, at: Placement, *, pose_ratio: Array | None = None, most_iterations: int = FIT.most_iterations
) -> Placement:
    """Gauss-Newton iterations from a first placement.

    Steps are halved while every corner counts alike, when the cost is one function of the placement; with pose errors
    the weights move with the linearisation, and the equations are iterated to their fixed point.

    Parameters
    ----------
    obs
        What was seen.
    at
        Where to begin.
    pose_ratio
        (5,) as in :class:`NoiseModel`; ``None`` for none.
    most_iterations
        After these it gives up.

    Raises
    ------
    NotObservableError
        When it does not settle or a corner comes to lie behind its camera.
    """
    ratio = None if pose_ratio is None or not pose_ratio.any() else pose_ratio
    equations = _equations(obs, at, ratio)
    for _ in range(most_iterations):
        s, rhs, now = equations
        step = solve(s, rhs)[0]
        if rhs @ step <= FIT.settled_share * now / (2 * len(obs)) + FIT.settled_px2:
            return at
        size = max(abs(step[0]), float(np.abs(step[1:].reshape(-1, 6)[:, :3]).max()))
        step *= min(1.0, 0.5 / max(size, 1e-300))
        for _ in range(20):
            residual = linearise(obs, _apply_step(at, step))[0]
            if np.isfinite(residual).all() and (ratio is not None or np.sum(residual**2) <= now):
                break
            step = 0.5 * step
        at = _apply_step(at, step)
        equations = _equations(obs, at, ratio)
    raise NotObservableError("scale", Fact("target-fit-unsettled"))


def _equations(obs: Observations, at: Placement, ratio: Array | None) -> tuple[Array, Array, float]:
    """Normal matrix, right side and cost, with these pose errors; ``None`` for none."""
    return plain_equations(obs, at) if ratio is None else weigh_equations(normal_equations(obs, at)[0], ratio)[1:]


def _apply_step(at: Placement, step: Array) -> Placement:
    move = step[1:].reshape(-1, 6)
    return Placement(
        log_scale=at.log_scale + float(step[0]),
        rotation=so3_exp(move[:, :3]) @ at.rotation,
        centre=at.centre + move[:, 3:],
    )
