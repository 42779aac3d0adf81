"""The size of a rigid planar target in a model: maximum likelihood in the images, with an interval that means it.

The unknowns are the target's similarity (one scale for all parts, a rotation and a position for each); the cameras are
the model's. Every corner has white noise of one unknown size, and every view a pose error of its own: all distances of
a view share it, so treating corners as independent would promise too much. How large both are comes from the residuals
(:mod:`~colmap_inertial.checks.validate.components`).
The interval of the scale's logarithm is Student's t with Satterthwaite's
degrees of freedom. Numpy only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.checks.validate.components import (
    POSE_ERRORS,
    estimate_ratio,
    normal_equations,
    plain_equations,
    satterthwaite_dof,
    solve,
    weigh_equations,
)
from colmap_inertial.checks.validate.limits import FIT
from colmap_inertial.checks.validate.observations import Observations, Placement, linearise
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import so3_exp


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
        raise NotObservableError("scale", f"{len(obs)} corner observations are too few for {unknowns} unknowns")
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
    raise NotObservableError("scale", "the fit of the target does not settle; the views may be too close together")


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
