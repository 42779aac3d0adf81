"""The refinement of a model, and whether it is believed: by observations that it has not seen."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, Int64Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.inertial.refine._panels import Layout
from colmap_inertial.inertial.refine._residuals import Moving, moving
from colmap_inertial.inertial.refine._system import Factored
from colmap_inertial.inertial.refine.judging_points import carry_points, draw_points, restore_points, select_points
from colmap_inertial.inertial.refine.motion import find_motion_covs
from colmap_inertial.inertial.refine.pictures import (
    apply_noise,
    measure_image_noise,
    measure_shared_errors,
    pictures_alone,
)
from colmap_inertial.inertial.refine.setup import NO_READOUT_S, move_to_middle_lines
from colmap_inertial.inertial.refine.shutter import SHUTTER_LIMITS
from colmap_inertial.inertial.refine.solve import (
    Solution,
    apply_measured_noise,
    evaluate_held_out,
    factor_information,
    solve,
)
from colmap_inertial.inertial.refine.values import READOUT, Estimate, Observations, Problem
from colmap_inertial.inertial.refine.world import (
    FoundWorld,
    derive_log_size,
    differentiate_by_centres,
    find_world,
    size_of,
)


@dataclass(frozen=True, kw_only=True)
class RefineLimits:
    """Limits for accepting a refinement, and of its summary."""

    #: Every so many observations of points with at least so many is held out.
    every: int = 10
    fewest: int = 4
    #: A readout that was not declared predicts observations that were held out better by so many standard deviations.
    better_sigma: float = 2.0
    #: Frames whose covariance is told.
    most_covs: int = 400
    #: Length of a part of the path whose drift is told.
    part_s: float = 10.0
    #: Of the normal equations; more would take hours, too.
    most_bytes: int = 2_000_000_000
    #: What the IMU costs, over what chance makes of it.
    largest_chi2: float = 3.0


LIMITS = RefineLimits()


@dataclass(frozen=True, kw_only=True)
class Stretched:
    """Stretch of a part of the path against the whole.

    Attributes
    ----------
    begin_s, end_s
        Of the part, camera clock.
    percent
        Its size in the refined model over that before, less one; both models of one overall size.
    sigma_percent
        Standard deviation of what is left of its drift.
    end_sigma_m
        Of the position at its end against the first one's, along the world's axes.
    """

    begin_s: float
    end_s: float
    percent: float
    sigma_percent: float
    end_sigma_m: tuple[float, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class Judged:
    """Result of a refinement.

    Attributes
    ----------
    estimate
        The refined poses, points and calibration, of all observations; of the start where it is not believed.
    accepted, reason
        Whether it is believed, and why not.
    held_out
        How many observations.
    before_px, after_px
        Their robust error: root of the mean square, of a model of images alone and of the refined one.
    change, change_sigma
        Mean change of their robust costs (in half squares over variances), and its standard deviation.
    chi2
        What the IMU adds to the sum of squares (its own squares at least), over its degrees of freedom.
    sigma_px
        Standard deviation of an observation.
    shared_errors
        Variance of a frame's pose by its observations, over what independent errors would make of it.
    accel_noise_m_s2_rthz, gyro_noise_rad_s_rthz
        White noise of the sensors, as the refinement found it; as it was known where it did not come so far.
    shared_cov
        (Q, Q) covariance of what is shared; ``None`` where it is not believed.
    world
        How sure its scale and gravity are; ``None`` where it is not believed.
    drift
        How the scale changed along the path; empty where it is not believed.
    velocity_m_s
        (F, 3) of the camera's centre in the world; nan where the IMU says nothing of it, and where it is not believed.
    motion_covs
        (9, 9) covariances of position against the first frame's, velocity and rotation, by frames: all, or evenly
        chosen ones.
    readout
        One that was not declared (s), and its standard deviation; ``None`` where it was, or there is none.
    steps
        Of all solutions.
    """

    estimate: Estimate
    accepted: bool
    reason: Fact | None
    held_out: int
    before_px: float
    after_px: float
    change: float
    change_sigma: float
    chi2: float
    sigma_px: float
    shared_errors: float
    accel_noise_m_s2_rthz: float
    gyro_noise_rad_s_rthz: float
    shared_cov: Array | None = None
    world: FoundWorld | None = None
    drift: tuple[Stretched, ...] = ()
    velocity_m_s: Array
    motion_covs: dict[int, Array] = field(default_factory=dict)
    readout: tuple[float, float] | None
    steps: int


def refine(
    problem: Problem, start: Estimate, at_once_px: Array, t_s: Array, *, readout_declared: bool = True
) -> Judged:
    """Refine, without a tenth of the observations first; with all of them where that predicts the tenth.

    Parameters
    ----------
    problem, start
        Of the model; the observations' standard deviation is measured.
    at_once_px
        (M, 2) observations as COLMAP's model has them: what images alone are judged by.
    t_s
        (F,) times of the frames; nan without one.
    readout_declared
        Otherwise images have none, unless one is found that predicts what was held out better.

    Raises
    ------
    NotObservableError
        Where it would take too much memory.
    """
    needed = Layout.of(problem.observations, len(t_s)).size_bytes
    if needed > LIMITS.most_bytes:
        raise NotObservableError("refinement", Fact("refine-too-large", size_bytes=needed))
    alone = pictures_alone(problem, at_once_px)
    noise = measure_image_noise(alone, start)
    whole, whole_start = apply_noise(problem, noise), start
    problem, alone = whole, apply_noise(alone, noise)
    points = draw_points(problem.observations, len(t_s))
    if points is not None:
        problem, alone = select_points(problem, points), select_points(alone, points)
        start = replace(start, points_m=start.points_m[points])
    # docs/dev/refinement.md#acceptance: two solutions without a tenth of the observations
    kept = ~_choose_held_out(problem.observations)
    seen_alone = solve(_select_observations(alone, kept), start)
    seen = solve(_select_observations(problem, kept), start)
    steps = seen_alone.steps + seen.steps
    # images alone may fit worse than with a rolling shutter: the IMU's own squares are the least that it costs
    chi2 = max(2 * (seen.cost - seen_alone.cost), seen.squares["imu"]) / _count_freedom(problem)
    readout = None
    if seen.converged and not readout_declared:
        readout, problem, seen = _test_readout(problem, kept, seen)
        steps += seen.steps
    if seen.converged and chi2 <= LIMITS.largest_chi2:
        # a false IMU would find itself noisy: it is judged by what was known before
        problem = _measure_noise(problem, kept, seen.estimate)
        seen = solve(_select_observations(problem, kept), seen.estimate)
        steps += seen.steps
    alone = replace(alone, shared_errors=problem.shared_errors)
    before = evaluate_held_out(alone, seen_alone.estimate, alone.observations.select(~kept))
    after = evaluate_held_out(problem, seen.estimate, problem.observations.select(~kept))
    change, change_sigma = _average_change(before, after, problem.observations.frame[~kept])
    reason = _find_doubt(seen_alone, seen, chi2, change, change_sigma) or _find_late_clock(problem, seen.estimate)
    assert problem.inertial is not None
    judged = Judged(
        estimate=whole_start,
        accepted=False,
        reason=reason,
        held_out=len(before),
        before_px=_convert_cost_to_px(before, problem.weighed_px),
        after_px=_convert_cost_to_px(after, problem.weighed_px),
        change=change,
        change_sigma=change_sigma,
        chi2=chi2,
        sigma_px=noise.sigma_px,
        shared_errors=problem.shared_errors,
        accel_noise_m_s2_rthz=problem.inertial.noise.accel_density_m_s2_rthz,
        gyro_noise_rad_s_rthz=problem.inertial.noise.gyro_density_rad_s_rthz,
        velocity_m_s=np.full_like(start.velocity_m_s, np.nan),
        readout=readout,
        steps=steps,
    )
    if reason is not None:
        return judged
    x = seen.estimate
    if points is not None:
        problem, x = restore_points(whole, problem), carry_points(whole.observations, whole_start, x)
        problem = replace(problem, shared_errors=measure_shared_errors(problem, x))
    return _solve_all(judged, problem, x, t_s)


def _average_change(before: Array, after: Array, frame: Int64Array) -> tuple[float, float]:
    """Mean change of the costs (M,) of what was held out, and its standard deviation; frames (M,) are independent."""
    change, count = after - before, len(before)
    mean = float(change.mean()) if count else 0.0
    frames = len(np.unique(frame))
    if frames < 2:
        return mean, np.inf
    squares = float(np.sum(np.bincount(frame, change - mean) ** 2))
    return mean, (squares * frames / (frames - 1)) ** 0.5 / count


def _solve_all(judged: Judged, problem: Problem, x: Estimate, t_s: Array) -> Judged:
    """The refinement by all observations from ``x`` on, with covariances; as it was where that does not succeed."""
    whole = solve(problem, x)
    judged = replace(judged, steps=judged.steps + whole.steps)
    if not whole.converged:
        return replace(judged, reason=Fact("refinement-not-converged-whole"))
    try:
        solved = factor_information(problem, whole.estimate)
    except np.linalg.LinAlgError:
        return replace(judged, reason=Fact("refinement-unsure"))
    assert problem.inertial is not None
    final, cov = whole.estimate, solved.shared_cov()
    if judged.readout is not None:
        cov[READOUT, READOUT] += (SHUTTER_LIMITS.cut_share * final.readout_s) ** 2
    by = moving(problem, final)
    # where the IMU says nothing, the covariance of a velocity is a prior's
    moved = problem.inertial.touched
    informed = np.flatnonzero(np.isfinite(t_s) & moved)
    chosen = informed[:: -(-len(informed) // LIMITS.most_covs) or 1]
    return replace(
        judged,
        estimate=final,
        accepted=True,
        shared_cov=cov,
        world=find_world(problem, final, move_to_middle_lines(problem, final).cam_in_world, solved, by),
        drift=drift_map(problem, judged.estimate, final, t_s, solved, by),
        velocity_m_s=np.where(moved[:, None], by.velocity_m_s, np.nan),
        motion_covs=dict(zip(chosen.tolist(), find_motion_covs(chosen, solved, by), strict=True)),
    )


def _choose_held_out(observations: Observations) -> BoolArray:
    """(M,) what is held out: every tenth observation of points that keep three or more."""
    lengths = np.diff(observations.first)
    often = np.flatnonzero(lengths[observations.point] >= LIMITS.fewest)
    out = np.zeros(len(observations.frame), dtype=np.bool_)
    out[often[LIMITS.every // 2 :: LIMITS.every]] = True
    return out


def _select_observations(problem: Problem, keep: BoolArray) -> Problem:
    return replace(problem, observations=problem.observations.select(keep))


def _measure_noise(problem: Problem, kept: BoolArray, x: Estimate) -> Problem:
    """The problem with noise of images and IMU measured at the solution on nine tenths of the observations."""
    seen = _select_observations(problem, kept)
    shared_errors = measure_shared_errors(seen, x)
    problem, seen = (replace(one, shared_errors=shared_errors) for one in (problem, seen))
    try:
        return replace(problem, inertial=apply_measured_noise(seen, x).inertial)
    except np.linalg.LinAlgError:  # the solution says why not
        return problem


def _count_freedom(problem: Problem) -> float:
    """Residuals minus unknowns that the IMU adds: rows and priors, less velocities, biases and the rest."""
    assert problem.inertial is not None
    # biases walk, or are known beforehand: as many residuals as unknowns
    return float(max(1, 9 * int(problem.inertial.linked.sum()) - 3 * int(problem.inertial.touched.sum())))


def _estimate_readout(problem: Problem, x: Estimate) -> tuple[float, float] | None:
    """Estimated readout and its standard deviation, in seconds; None where there is no standard deviation."""
    try:
        cov = factor_information(problem, x).shared_cov()
    except np.linalg.LinAlgError:
        return None
    return x.readout_s, float(cov[READOUT, READOUT]) ** 0.5


def _test_readout(
    problem: Problem, kept: BoolArray, seen: Solution
) -> tuple[tuple[float, float] | None, Problem, Solution]:
    """A readout that nobody declared, with the problem and its solution; without one, those of a global shutter."""
    observations = problem.observations
    info, free = problem.prior.info.copy(), np.arange(len(problem.prior.info)) != READOUT
    info[READOUT] = info[:, READOUT] = np.where(free, 0.0, NO_READOUT_S**-2)
    still = replace(
        problem,
        observations=replace(observations, line=np.zeros_like(observations.line)),
        prior=replace(problem.prior, info=info, mean=replace(problem.prior.mean, readout_s=0.0)),
    )
    without = solve(_select_observations(still, kept), replace(seen.estimate, readout_s=0.0))
    readout = _estimate_readout(_select_observations(problem, kept), seen.estimate)
    if readout is None or abs(readout[0]) < max(SHUTTER_LIMITS.least_s, SHUTTER_LIMITS.sure_sigma * readout[1]):
        return None, still, without
    held_out = observations.select(~kept)
    before = evaluate_held_out(still, without.estimate, still.observations.select(~kept))
    change, change_sigma = _average_change(before, evaluate_held_out(problem, seen.estimate, held_out), held_out.frame)
    if change > -LIMITS.better_sigma * change_sigma:
        return None, still, without
    return (readout[0], float(np.hypot(readout[1], SHUTTER_LIMITS.cut_share * readout[0]))), problem, seen


def _find_doubt(alone: Solution, seen: Solution, chi2: float, change: float, spread: float) -> Fact | None:
    """Why a refinement is not believed; ``None`` where it is."""
    if not alone.converged:
        return Fact("pictures-not-converged")
    if not seen.converged:
        return Fact("refinement-not-converged")
    if chi2 > LIMITS.largest_chi2:
        return Fact("imu-contradicts-images", chi2=chi2)
    if change >= -spread:
        return Fact("refinement-no-better")
    return None


def _find_late_clock(problem: Problem, x: Estimate) -> Fact | None:
    """Why clocks are too far apart, or a readout too long; ``None`` where readings were looked up as far."""
    assert problem.inertial is not None
    inertial = problem.inertial
    times_s = inertial.nodes_s[inertial.touched] - inertial.middle_s
    shift_s = float(np.abs(x.offset_s + x.clock_rate * times_s).max())
    if shift_s + 0.5 * abs(x.readout_s) <= inertial.turning.half_span_s:
        return None
    return Fact("refined-times-far", shift_s=shift_s, readout_s=abs(x.readout_s))


def _convert_cost_to_px(costs: Array, sigma_px: float) -> float:
    return float(sigma_px * np.sqrt(np.mean(costs))) if len(costs) else 0.0


def drift_map(
    problem: Problem, start: Estimate, x: Estimate, t_s: Array, solved: Factored, by: Moving
) -> tuple[Stretched, ...]:
    """Change of the scale along a path by the refinement, with its uncertainty.

    Parameters
    ----------
    problem, start, x
        The refinement, from where to where.
    t_s
        (F,) times of the frames; nan without one.
    solved, by
        The information at ``x``, and the camera's motion there.
    """
    before, after = (move_to_middle_lines(problem, estimate).cam_in_world for estimate in (start, x))
    timed = np.isfinite(t_s)
    first_s, last_s = float(t_s[timed].min()), float(t_s[timed].max())
    edges = np.linspace(first_s, last_s, max(1, round((last_s - first_s) / LIMITS.part_s)) + 1).tolist()
    with np.errstate(invalid="ignore"):
        parts = [np.flatnonzero((t_s >= begin_s) & (t_s <= end_s)) for begin_s, end_s in pairwise(edges)]
    whole = size_of(before[timed]) / size_of(after[timed])
    by_log = np.stack([derive_log_size(after, part) for part in (np.flatnonzero(timed), *parts)])
    sigma = np.sqrt(np.diagonal(solved.cov_of(*differentiate_by_centres(by_log[1:] - by_log[0], by))[0]))
    last = np.array([part[-1] if len(part) else 0 for part in parts])
    end_sigma_m = np.sqrt(np.diagonal(find_motion_covs(last, solved, by), axis1=1, axis2=2)[:, :3])
    out = []
    for i, (part, (begin_s, end_s)) in enumerate(zip(parts, pairwise(edges), strict=True)):
        sizes = [size_of(centres[part]) if len(part) > 1 else 0.0 for centres in (before, after)]
        if min(sizes) > 0:
            out.append(
                Stretched(
                    begin_s=begin_s,
                    end_s=end_s,
                    percent=100 * (whole * sizes[1] / sizes[0] - 1),
                    sigma_percent=100 * float(sigma[i]),
                    end_sigma_m=tuple(end_sigma_m[i].tolist()),
                )
            )
    return tuple(out)
