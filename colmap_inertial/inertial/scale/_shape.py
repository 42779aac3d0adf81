"""Breaks, drift and stretch of a model's scale: found beside the joint fit, undone, and found again.

Each is a change of the visual path that grows with an unknown or five. To first order about the optimum its derivative
says how large the unknowns would be, how sure that is, and what the scale would do (the score test of Rao, 1948). Noise
levels of the fit are swollen by what is wrong, so that a suspicion is undone, fitted and judged again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.inertial.core import factors as fac, parameters as par
from colmap_inertial.inertial.core.arrow import Inverse
from colmap_inertial.inertial.core.parameters import Estimate, Noise
from colmap_inertial.inertial.scale._setup import Measurements


@dataclass(frozen=True, kw_only=True)
class ShapeLimits:
    """Limits for errors of a model's shape."""

    #: Shorter clips are not searched: 8 of 88 sound ones of 10 and 12 s by hand seemed bent by up to 15 %; none of 32
    #: of 15 s.
    shortest_s: float = 15.0
    #: Breaks are sought so far apart, and from the ends; so many at most.
    spacing_s: float = 1.0
    margin_s: float = 3.0
    most_breaks: int = 120
    #: Squared deviations, in standard deviations, from which a break anywhere, a drift, a stretch are said, and widen
    #: the interval by what they would do to the scale. In 27 clean clips by hand they are 3.5, 4.3 and 5.0 at most.
    break_chi2: float = 10.0
    drift_chi2: float = 7.5
    stretch_chi2: float = 14.0
    #: And from which they are undone, which changes the scale: one sound recording in 10,000, by chi-square of 1, 1 and
    #: 5 degrees of freedom, of some eight independent places for a break.
    break_undone_chi2: float = 19.2
    drift_undone_chi2: float = 15.1
    stretch_undone_chi2: float = 25.7
    #: So many are undone at most.
    most: int = 2
    #: Part of these from which a suspicion is worth another fit.
    worth_a_fit: float = 0.6
    #: Factor on variances under vibration, whose slow errors look like changes of the scale. Squared deviations of 16
    #: clean clips of flights are 3.4 (breaks), 2.8 (drifts) and 2.5 times (stretch) those of 20 by hand, on average.
    shaken: float = 3.0
    #: Standard deviation of what is wrong with sound models.
    tolerated_log: float = 0.003
    #: What is known no better (standard deviation) says nothing: a stretch at rest.
    known_log: float = 0.03


LIMITS = ShapeLimits()
#: Symmetric matrices without trace, orthonormal.
_STRAINS = 0.5**0.5 * np.array(
    [
        np.diag([1.0, -1.0, 0.0]),
        np.diag([1.0, 1.0, -2.0]) / 3**0.5,
        *(np.roll([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], k, (0, 1)) for k in range(3)),
    ]
)
Kind = Literal["break", "drift", "stretch"]


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeFault:
    """Unknowns that stand for a wrong shape of the model.

    Attributes
    ----------
    kind
        A break of the scale, a steady drift of it, or a stretch.
    value, cov
        (q,), (q, q): by how much the logarithm of metres per unit is larger after the break, or at the end than at the
        beginning; of a stretch, the strain that undoes it, in five symmetric matrices without trace.
    by_scale
        (q,) change of the logarithm of the scale with each.
    at_s
        Where it breaks, camera time.
    keeps_after
        Whether the part after the break tells more of the scale than the one before, so that it keeps its metres.
    """

    kind: Kind
    value: Array
    cov: Array
    by_scale: Array
    at_s: float = float("nan")
    keeps_after: bool = False

    @property
    def limit(self) -> float:
        """Chi-square from which it is said."""
        return {"break": LIMITS.break_chi2, "drift": LIMITS.drift_chi2, "stretch": LIMITS.stretch_chi2}[self.kind]

    @property
    def undone_limit(self) -> float:
        """Chi-square from which it is undone."""
        return {
            "break": LIMITS.break_undone_chi2,
            "drift": LIMITS.drift_undone_chi2,
            "stretch": LIMITS.stretch_undone_chi2,
        }[self.kind]

    @property
    def strain(self) -> Array:
        """(3, 3) of a stretch."""
        return np.einsum("i,ijk->jk", self.value, _STRAINS)

    def chi2(self, widened: float, tolerated_log: float = LIMITS.tolerated_log) -> float:
        """Squared deviation from a sound model, in standard deviations; 0 of what is hardly known.

        ``widened`` is the factor on variances, ``tolerated_log`` what is wrong with sound models.
        """
        cov = widened * self.cov
        if float(np.diagonal(cov).max()) > LIMITS.known_log**2:
            return 0.0
        return float(self.value @ np.linalg.solve(cov + tolerated_log**2 * np.eye(len(cov)), self.value))

    def undo(self, t_s: Array, centre: Array) -> Array:
        """(K, 3) centres of a model without it; the part of a broken one that tells more keeps its steps."""
        if self.kind == "stretch":
            return np.asarray(centre @ (np.eye(3) + self.strain))
        log_scale = float(self.value[0]) * _profile(t_s, self.kind, self.at_s)
        if self.keeps_after:
            log_scale = log_scale - float(self.value[0])
        return np.asarray(centre[0] + _scale_steps(centre, np.exp(log_scale)))

    def as_fact(self, t_s: Array, widened: float) -> Fact:
        """What is wrong; ``t_s`` are the nodes' times, ``widened`` the factor on variances."""
        if self.kind == "stretch":
            sizes, axes = np.linalg.eigh(self.strain)
            longest = axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0])
            return Fact("model-stretched", stretch=sizes[2] - sizes[0], axis=longest)
        # where metres per unit are more, lengths of the model are less
        (more, less), sigma = np.expm1(self.value[0] * np.array([1, -1])), (widened * self.cov[0, 0]) ** 0.5
        if self.kind == "drift":
            return Fact("scale-grows", growth=less, sigma=sigma)
        first, since_s = bool(self.keeps_after), self.at_s - float(t_s[0])
        return Fact("scale-breaks", growth=more if first else less, sigma=sigma, since_s=since_s, first=first)


def _profile(t_s: Array, kind: str, at_s: float) -> Array:
    """(K - 1,) growth of the logarithm of the scale between nodes, for a value of one."""
    middle_s = 0.5 * (t_s[1:] + t_s[:-1])
    if kind == "break":
        return np.asarray((middle_s > at_s).astype(np.float64))
    return np.asarray((middle_s - 0.5 * (t_s[0] + t_s[-1])) / (t_s[-1] - t_s[0]))


def _scale_steps(path: Array, factor: Array) -> Array:
    """(K, 3) a path from the origin whose steps are so many times as long."""
    return np.concatenate([np.zeros((1, 3)), np.cumsum(np.diff(path, axis=0) * factor[:, None], axis=0)])


@dataclass(frozen=True, eq=False, kw_only=True)
class Scores:
    """Scores of q changes of the visual path: information (q, q), score (q,), and the scale's response (q,)."""

    information: Array
    score: Array
    by_scale: Array


def score_columns(
    columns: Array, data: Measurements, noise: Noise, centre: fac.Group, inverse: Inverse, step: tuple[Array, Array]
) -> Scores:
    """Score of the residuals at the optimum for changes of the visual path.

    Parameters
    ----------
    columns
        (K, 3, q) metres that the path changes by, per unknown.
    centre, inverse, step
        The group of the visual centres, the inverse of the normal equations, and the last step.
    """
    weight = np.ones(len(columns)) if centre.weight is None else centre.weight
    columns = (data.centre_shape / noise.centre_m * np.sqrt(weight)[:, None, None]) @ columns
    k, _, q = columns.shape
    pulled, pulled_z = np.zeros((k, par.N_STATE, q)), np.zeros((par.N_GLOBALS, q))
    centre.pull_back(columns, pulled, pulled_z)
    states, z = inverse.solve(pulled, pulled_z)
    residual = centre.residual + centre.apply(*step)[:, :, 0]
    return Scores(
        information=np.einsum("kiw,kiv->wv", columns, columns - centre.apply(states, z)),
        score=-np.einsum("kiw,ki->w", columns, residual),
        by_scale=z[par.SCALE],
    )


def camera_path(x: Estimate) -> Array:
    """(K, 3) the fitted path of the camera, not the measured one, whose noise would be mistaken for a smaller scale."""
    return x.imu_in_world_m - x.world_from_imu @ (x.cam_from_imu.T @ x.imu_in_cam_m)


def shape_columns(t_s: Array, path: Array) -> tuple[list[tuple[Kind, float]], Array]:
    """Candidate errors, and the motion (K, 3, q) of the path by each unknown; a stretch has five."""
    first_s, last_s = t_s[0] + LIMITS.margin_s, t_s[-1] - LIMITS.margin_s
    count = int(np.clip((last_s - first_s) // LIMITS.spacing_s + 1, 0, LIMITS.most_breaks))
    kinds: list[tuple[Kind, float]] = [("break", float(at_s)) for at_s in np.linspace(first_s, last_s, count)]
    kinds += [("drift", float("nan")), ("stretch", float("nan"))]
    grown = [_scale_steps(path, _profile(t_s, kind, at_s)) for kind, at_s in kinds[:-1]]
    strained = [(path - path.mean(axis=0)) @ strain for strain in _STRAINS]
    return kinds, np.stack([*grown, *strained], axis=2)


def find_faults(
    kinds: Sequence[tuple[Kind, float]], scores: Scores, *, shaken: bool, t_s: Array, taken: float
) -> list[ShapeFault]:
    """Each of :func:`shape_columns` by itself.

    Parameters
    ----------
    shaken
        Under vibration.
    t_s, taken
        (K,) times of the nodes; how many of the visual noise's degrees of freedom the fitted path follows.
    """
    out, widened = [], LIMITS.shaken if shaken else 1.0
    for i, (kind, at_s) in enumerate(kinds):
        at = slice(i, i + (5 if kind == "stretch" else 1))
        information = scores.information[at, at]
        information = 0.5 * (information + information.T)
        if np.linalg.eigvalsh(information)[0] <= LIMITS.known_log**-2 / 100:
            continue
        cov = np.asarray(np.linalg.inv(information), dtype=np.float64)
        value, by_scale = cov @ scores.score[at], scores.by_scale[at]
        fault = ShapeFault(kind=kind, at_s=at_s, value=value, cov=widened * cov, by_scale=by_scale)
        if kind == "break":
            # without the break, the scale goes with what follows it by as much as that tells of it
            after = float(np.clip(np.abs(by_scale[0]), 0.0, 1.0))
            bias = bias_of_break(float(cov[0, 0]), after, taken * np.array([np.mean(t_s <= at_s), np.mean(t_s > at_s)]))
            fault = replace(fault, cov=fault.cov + bias**2 / 3, keeps_after=after > 0.5)
        out.append(fault)
    return out


def bias_of_break(variance: float, after: float, taken: Array) -> float:
    """What noise in the fitted path may add to a break: a part that stands still has its noise for a path.

    Parameters
    ----------
    variance, after
        Of the break; the share of what is known of the scale that comes from after it.
    taken
        (2,) degrees of freedom of the visual noise that the path follows before and after it.
    """
    # information adds: each part's variance is that of the break less the other's
    parts = variance * np.array([after, 1 - after])
    return float(np.diff(parts * taken)[0])


def find_likeliest_fault(faults: Sequence[ShapeFault], widened: float) -> ShapeFault | None:
    """The likeliest of those that are worth another fit."""
    worth = [one for one in faults if one.chi2(widened) > LIMITS.worth_a_fit * one.limit]
    return max(worth, key=lambda one: one.chi2(widened, 0.0), default=None)


def confirm_fault(fault: ShapeFault, left: Sequence[ShapeFault], widened: float) -> ShapeFault | None:
    """A fault that was undone, with what is left of it, if it counts against noise that it no longer swells."""
    for one in left:
        if one.kind == fault.kind and (one.kind != "break" or one.at_s == fault.at_s):
            found = replace(one, value=fault.value + one.value, keeps_after=fault.keeps_after)
            return found if found.chi2(widened) > found.limit else None
    return None
