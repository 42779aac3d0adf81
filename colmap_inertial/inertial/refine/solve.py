"""The most probable poses, points and calibration, by Levenberg and Marquardt's method; the accelerometer's noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.inertial.refine._panels import Layout
from colmap_inertial.inertial.refine._residuals import (
    Derivatives,
    Projected,
    Rows,
    all_rows,
    derivatives,
    imu_rows,
    prior_offset,
    project,
)
from colmap_inertial.inertial.refine._system import Factored, Step, System
from colmap_inertial.inertial.refine.values import (
    ACCEL_DENSITY,
    GYRO_DENSITY,
    N_STATE,
    Estimate,
    Observations,
    Problem,
)


@dataclass(frozen=True, kw_only=True)
class SolveLimits:
    """Limits of the steps by Levenberg and Marquardt."""

    steps: int = 100
    #: Where a step of frames, and of what they share, promises less of the squares' sum (in variances), it is at rest,
    settled: float = 0.1
    #: and where their points by themselves promise no more than so much each: a false one may creep on for ever.
    settled_point: float = 2e-4
    #: Damping of the first step, of the diagonal, and its range.
    first_damping: float = 1e-4
    least_damping: float = 1e-9
    most_damping: float = 1e8
    #: A step to cameras whose numbers differ by more than this share (or as much of 1) is not tried.
    largest_change: float = 0.5
    #: With more damping, every step promises little: what seems to rest then is pushed once more with less.
    rest_damping: float = 1e-3
    #: The robust weights overstate the curvature of the loss, and steps are too short: they are stretched by up to so
    #: much. (With the loss's own second derivatives, as Triggs corrects for them, 6 and 8 steps became 11 to 19.)
    longest_stretch: float = 2.0


SOLVE = SolveLimits()
#: A step counts where the cost falls by more than this share of what it promised.
_GAINS = 1e-4


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """Result of a solve.

    Attributes
    ----------
    estimate
        The most probable one.
    cost
        Half the sum of squares over variances, of observations by the robust loss.
    squares
        Their sum for each kind of residual but observations, over variances.
    steps
        That were taken.
    converged
        Whether it came to rest.
    """

    estimate: Estimate
    cost: float
    squares: dict[str, float]
    steps: int
    converged: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class _Point:
    """All residuals at an estimate."""

    estimate: Estimate
    projected: Projected
    rows: dict[str, Rows]
    offset: Array
    cost: float


def robust_cost(residual_px: Array, sigma_px: float, robust_px: float) -> Array:
    """(M,) Cauchy's loss of (M, 2) residuals, in half squares over variances."""
    squares = np.sum(residual_px**2, axis=1)
    return np.asarray(0.5 * (robust_px / sigma_px) ** 2 * np.log1p(squares / robust_px**2))


def _evaluate(problem: Problem, x: Estimate, observations: Observations) -> _Point:
    projected = project(problem, x, observations)
    rows, offset = all_rows(problem, x), prior_offset(problem, x)
    cost = float(np.sum(robust_cost(projected.residual, problem.weighed_px, problem.robust_px)))
    cost += 0.5 * sum(float(np.sum(block.residual**2)) for block in rows.values())
    # a point that a step brings behind the camera must not look like a gain
    cost += float(np.sum(~projected.seen)) * (problem.robust_px / problem.weighed_px) ** 2 * 5
    cost += 0.5 * float(offset @ problem.prior.info @ offset)
    if problem.distances is not None:
        cost += 0.5 * float(np.sum(problem.distances.residuals(x.points_m)[0] ** 2))
    return _Point(estimate=x, projected=projected, rows=rows, offset=offset, cost=cost)


def _weight_rows(problem: Problem, at: _Point, informs: float = 1.0) -> tuple[Derivatives, Array]:
    """Derivatives and residuals of a problem's rows over their standard deviations, times the roots of their robust
    weights.

    With ``informs``, derivatives of observations tell as much more; what residuals pull with stays.
    """
    squares = np.sum(at.projected.residual**2, axis=1)
    root = 1 / (problem.weighed_px * np.sqrt(1 + squares / problem.robust_px**2))
    by = derivatives(problem, at.estimate, problem.observations, at.projected, root * informs**0.5)
    residual = at.projected.residual * (root / informs**0.5)[:, None]
    if problem.distances is None:
        return by, residual
    # of two numbers as any observation, the second one always zero
    ends = problem.observations.first[1:]
    away, by_away = (
        np.stack([one, np.zeros_like(one)], axis=1) for one in problem.distances.residuals(at.estimate.points_m)
    )
    by = Derivatives(
        by_frame=np.insert(by.by_frame, ends, 0.0, axis=0),
        by_shared=np.insert(by.by_shared, ends, 0.0, axis=0),
        by_point=np.insert(by.by_point, ends, by_away, axis=0),
    )
    return by, np.insert(residual, ends, away, axis=0)


def _build_system(
    problem: Problem, layout: Layout, at: _Point, by: Derivatives, residual: Array, damping: float
) -> System:
    info = problem.prior.info
    return System.build(layout, problem.rows, by, residual, at.rows, (info, -info @ at.offset), damping=damping)


@dataclass(kw_only=True)
class _Damping:
    """Damping by Nielsen's rule (Madsen, Nielsen, Tingleff, *Methods for non-linear least squares*, 2004)."""

    value: float = SOLVE.first_damping
    growth: float = 2.0

    @property
    def is_exhausted(self) -> bool:
        """Whether more of it is of no use."""
        return self.value >= SOLVE.most_damping

    def grow(self) -> None:
        """After a step that leads nowhere."""
        self.value, self.growth = self.value * self.growth, 2 * self.growth

    def shrink(self, ratio: float) -> None:
        """After a step that brought so many times what it promised."""
        self.value = max(self.value * max(0.1, 1 - (2 * ratio - 1) ** 3), SOLVE.least_damping)
        self.growth = 2.0


def solve(problem: Problem, start: Estimate, *, most_steps: int = SOLVE.steps) -> Solution:
    """Refine an estimate (``docs/dev/refinement.md``, Solver)."""
    observations, rows = problem.observations, problem.rows
    layout = Layout.of(observations, len(start.velocity_m_s))
    at, damping = _evaluate(problem, start, observations), _Damping()
    steps, stretch = 0, 1.0
    for steps in range(1, most_steps + 1):
        by, residual = _weight_rows(problem, at)
        gained = pushed = at_rest = False
        while not gained and not damping.is_exhausted:
            system = _build_system(problem, layout, at, by, residual, damping.value)
            step = _find_step(system, rows, by)
            if step is None or not _is_plausible(start, step.apply_to(at.estimate, stretch, problem.distances)):
                damping.grow()
                continue
            promised = _predict_decrease(problem, at, residual, step)
            of_points = _predict_decrease_by_points(system)
            # what frames promise is settled: points that promise more are false, if no step to them brings anything
            at_rest |= damping.value <= SOLVE.rest_damping and promised - of_points < SOLVE.settled
            if promised - min(of_points, SOLVE.settled_point * len(system.pull)) < SOLVE.settled:
                if damping.value <= SOLVE.rest_damping or pushed:
                    return _make_solution(at, steps, converged=at_rest)
                damping, pushed = _Damping(value=SOLVE.rest_damping), True
                continue
            tried, length = _try_step(problem, at, step, stretch, promised)
            ratio = (at.cost - tried.cost) / promised
            gained, stretch = ratio > _GAINS, 1.0
            if not gained:
                damping.grow()
                continue
            at = tried
            damping.shrink(ratio)
            # of the curvature by the weights, the share that this step met
            share = (2 * length - ratio) / length**2
            stretch = 1 / min(max(share, 1 / SOLVE.longest_stretch), 1.0)
        if not gained:
            return _make_solution(at, steps, converged=at_rest)
    return _make_solution(at, steps, converged=False)


def _try_step(problem: Problem, at: _Point, step: Step, stretch: float, promised: float) -> tuple[_Point, float]:
    """What a step leads to, and its length: stretched, or as it is where that brings nothing."""
    for length in (stretch, 1.0) if stretch > 1 else (1.0,):
        tried = _evaluate(problem, step.apply_to(at.estimate, length, problem.distances), problem.observations)
        if (at.cost - tried.cost) / promised > _GAINS:
            break
    return tried, length


def _predict_decrease_by_points(system: System) -> float:
    """Decrease of the cost that points by themselves promise."""
    return 0.5 * float(np.einsum("pi,pij,pj->", system.pull, system.inverse, system.pull))


def _find_step(system: System, observations: Observations, by: Derivatives) -> Step | None:
    """Step of the system; ``None`` where it needs more damping to be solved."""
    try:
        step = system.factor().step(system, observations, by)
    except np.linalg.LinAlgError:
        return None
    return step if all(np.isfinite(part).all() for part in (step.states, step.shared, step.points)) else None


def _is_plausible(start: Estimate, moved: Estimate) -> bool:
    """Whether a step leaves a camera that can be one: a focal length keeps its sign and size."""
    away = np.abs(moved.intrinsics - start.intrinsics)
    return bool(np.all(away <= SOLVE.largest_change * np.maximum(np.abs(start.intrinsics), 1.0)))


def _predict_decrease(problem: Problem, at: _Point, residual: Array, step: Step) -> float:
    """Decrease of the cost by a step, if all were linear."""
    total = -float(np.sum(step.change * residual)) - 0.5 * float(np.sum(step.change**2))
    for block in at.rows.values():
        count = len(block.residual)
        moved = np.einsum("nri,ni->nr", block.here, step.states[:count])
        if block.after is not None:
            moved += np.einsum("nri,ni->nr", block.after, step.states[1:])
        if block.by_shared is not None:
            moved += block.by_shared @ step.shared
        total -= float(np.sum(moved * block.residual)) + 0.5 * float(np.sum(moved**2))
    info = problem.prior.info
    return total - float(step.shared @ info @ (at.offset + 0.5 * step.shared))


def _make_solution(at: _Point, steps: int, *, converged: bool) -> Solution:
    squares = {name: float(np.sum(block.residual**2)) for name, block in at.rows.items()}
    return Solution(estimate=at.estimate, cost=at.cost, squares=squares, steps=steps, converged=converged)


def factor_information(problem: Problem, x: Estimate, *, damping: float = 0.0) -> Factored:
    """The information at an estimate, for covariances."""
    layout = Layout.of(problem.observations, len(x.velocity_m_s))
    at = _evaluate(problem, x, problem.observations)
    return _build_system(problem, layout, at, *_weight_rows(problem, at, problem.informs), damping).factor()


@dataclass(frozen=True, eq=False, kw_only=True)
class Linearised:
    """Rows of observations at an estimate: what is solved for again and again with other noise of the IMU."""

    layout: Layout
    projected: Projected
    by: Derivatives
    residual: Array
    estimate: Estimate

    def solve(self, problem: Problem) -> tuple[Factored, Array, Array]:
        """The information, and the steps (F, 15) and (Q,) to the solution with a problem's noise."""
        x = self.estimate
        at = _Point(
            estimate=x,
            projected=self.projected,
            rows=all_rows(problem, x),
            offset=prior_offset(problem, x),
            cost=np.nan,
        )
        system = _build_system(problem, self.layout, at, self.by, self.residual, 0.0)
        solved = system.factor()
        step = solved.step(system, problem.rows, self.by)
        return solved, step.states, step.shared


def linearise_observations(problem: Problem, x: Estimate) -> Linearised:
    """The observations at an estimate."""
    at = _evaluate(problem, x, problem.observations)
    by, residual = _weight_rows(problem, at, problem.informs)
    layout = Layout.of(problem.observations, len(x.velocity_m_s))
    return Linearised(layout=layout, projected=at.projected, by=by, residual=residual, estimate=x)


def evaluate_held_out(problem: Problem, x: Estimate, observations: Observations) -> Array:
    """(M,) robust costs of observations that were not used."""
    at = project(replace(problem, observations=observations), x, observations)
    cost = robust_cost(at.residual, problem.weighed_px, problem.robust_px)
    return np.where(at.seen, cost, 5 * (problem.robust_px / problem.weighed_px) ** 2)


#: Standard deviation of the logarithm of what was known before: on walks of 40 m, where little tells noise of images
#: from the accelerometer's, the scale's own level was right to a third or thirteen times too large.
_LEVEL_SPREAD = 0.7
#: A level stays within this factor of what was known before; no sensor is quieter than the other numbers.
_MOST_LEVEL = 20.0
_LEAST_LEVELS = {ACCEL_DENSITY: 3e-4, GYRO_DENSITY: 1e-5}
#: Columns of random signs: with four hundred frames the trace is known to a hundredth.
_PROBES, _SEED = 8, 0
#: Steps; the largest of a logarithm; and where they are at rest: a fiftieth of a level is nothing.
_LEVEL_STEPS, _LARGEST_LEVEL_STEP, _LEVEL_AT_REST = 12, 1.0, 0.02


def apply_measured_noise(problem: Problem, x: Estimate) -> Problem:
    """The problem with its accelerometer and gyroscope as noisy as what is left of their readings says.

    The scale estimate knows the noise from the readings' roughness more than from the path: what shakes faster than
    frames follow counts as white noise there. Between frames most of it cancels; and beside images that know poses to
    a millimetre, the path tells what is left. What all observations of a frame err by together is a turn of its camera
    and counts with the gyroscope's: believed as it reads, the path and the lever arm would follow it.

    The levels are those of the greatest restricted likelihood (REML), by Newton's steps with the average information
    (Gilmour, Thompson and Cullis, Biometrics 1995), as the scale's own levels are found. The trace in it, of how many
    residuals the fit explains, is that of random signs (Hutchinson 1990).

    Parameters
    ----------
    problem, x
        A refinement, and its solution with the noise that was assumed.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where nothing determines the solution.
    """
    inertial = problem.inertial
    assert inertial is not None
    known = {name: getattr(inertial.noise, name) for name in _LEAST_LEVELS}
    most = float(np.log(_MOST_LEVEL))
    least = np.array([min(0.0, max(-most, np.log(_LEAST_LEVELS[name] / level))) for name, level in known.items()])

    def at_levels(change: Array) -> Problem:
        levels = {name: level * float(np.exp(c)) for (name, level), c in zip(known.items(), change, strict=True)}
        return replace(problem, inertial=replace(inertial, noise=replace(inertial.noise, **levels)))

    change, at = np.zeros(len(known)), linearise_observations(problem, x)
    for _ in range(_LEVEL_STEPS):
        moved = np.clip(change + _level_step(at_levels(change), x, at, change), least, most)
        step, change = moved - change, moved
        if np.all(np.abs(step) < _LEVEL_AT_REST):
            break
    return at_levels(change)


def _level_step(problem: Problem, x: Estimate, at: Linearised, change: Array) -> Array:
    """Newton's steps of the logarithms of the levels, which have changed by so much from what was known."""
    solved, states, shared = at.solve(problem)
    rows, count = imu_rows(problem, x), len(change)
    shares = [rows.shares[name] for name in _LEAST_LEVELS]
    left = rows.residual[:, :, None] + _apply_rows(rows, states[:, :, None], shared[:, None])
    own = np.concatenate([share @ left for share in shares], axis=2)
    squares = np.sum(left * own, axis=(0, 1))
    signs = np.random.default_rng(_SEED).choice([-1.0, 1.0], (*rows.residual.shape, _PROBES))
    along = _project_on_fit(rows, np.concatenate([signs, own], axis=2), solved)
    explained = np.array([np.sum(signs * (share @ along[:, :, :-count])) for share in shares]) / _PROBES
    whole = np.array([np.trace(share, axis1=1, axis2=2).sum() for share in shares])
    right = np.maximum(whole - explained, 0.01 * whole)
    # of the logarithm of a variance, which is twice that of the density
    average = 0.5 * np.einsum("nrk,nrl->kl", own, own - along[:, :, -count:])
    average[np.diag_indices(count)] = np.maximum(np.diagonal(average), 0.1 * right) + (
        prior := (2 * _LEVEL_SPREAD) ** -2
    )
    gradient = 0.5 * (squares - right) - prior * 2 * change
    step = 0.5 * np.linalg.solve(average, gradient)
    return np.clip(step, -_LARGEST_LEVEL_STEP, _LARGEST_LEVEL_STEP)


def _apply_rows(rows: Rows, states: Array, shared: Array) -> Array:
    """(N, r, k) changes of residuals by steps (F, 15, k), (Q, k)."""
    assert rows.after is not None and rows.by_shared is not None
    return np.asarray(rows.here @ states[:-1] + rows.after @ states[1:] + rows.by_shared @ shared)


def _project_on_fit(rows: Rows, values: Array, solved: Factored) -> Array:
    """(N, r, k) of values the part that the fit follows: derivatives, covariance, derivatives."""
    assert rows.after is not None and rows.by_shared is not None
    place, count = solved.layout.place, values.shape[2]
    sides = np.zeros((len(place), N_STATE, count))
    sides[place[:-1]] += rows.here.transpose(0, 2, 1) @ values
    sides[place[1:]] += rows.after.transpose(0, 2, 1) @ values
    flat = rows.by_shared.reshape(-1, rows.by_shared.shape[2])
    states, shared = solved.solve(sides.reshape(-1, count), flat.T @ values.reshape(-1, count))
    return _apply_rows(rows, states.reshape(-1, N_STATE, count)[place], shared)
