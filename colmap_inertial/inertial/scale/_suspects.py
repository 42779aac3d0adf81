"""Signs of an accelerometer that is not what the joint fit takes it for, and what undoes it.

Each suspicion is a change of the readings that grows with an unknown or two. At the optimum of the fit, its derivative
says how far the unknowns would move if they were fitted along, how sure that is, and what the scale would do (the score
test of Rao, 1948): no second fit is needed to ask. In clean recordings the statistics are as theory has them.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.inertial.core import factors as fac, parameters as par
from colmap_inertial.inertial.core.parameters import Estimate, Prior
from colmap_inertial.inertial.core.preintegration import (
    Preintegrated,
    SensorErrors,
    SensorStream,
    SensorStreams,
    preintegrate,
)
from colmap_inertial.inertial.scale._residuals import node_stamps
from colmap_inertial.inertial.scale._setup import Measurements

#: Squared deviation in standard deviations from which a suspicion counts. 935 clean recordings, real and simulated, had
#: 23 at most.
_LARGEST_CHI2 = 28.0
#: The same, for each unknown, of what is left of a fault that was found.
_LEFT_CHI2 = 0.25
#: What is left of a column after the fit's own parameters, in parts of all of them: less is rounding.
_NOTHING_LEFT = 1e-12
#: Derivatives of readings are taken after smoothing by this: to look for faults, where noise would hide them, and to
#: undo them, where motion must not be lost.
_SMOOTH_TO_FIND_S, _SMOOTH_TO_UNDO_S = 0.07, 0.02
#: Noise (m/s2 per root of a hertz) behind a filter, which takes it along.
_FILTERED_ACCEL = 2e-3
#: The x, y and z axes' delays by the two unknowns of "axes": they leave the mean delay, which is fitted, alone.
_AXES = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, -2.0]])


@dataclass(frozen=True, eq=False, kw_only=True)
class Suspicion:
    """Unknowns that stand for something wrong with the accelerometer.

    Attributes
    ----------
    name
        One of those in :func:`perturbations`.
    value, cov
        (q,), (q, q) of the unknowns, had they been fitted along.
    by_scale
        (q,) change of the logarithm of the scale with each.
    """

    name: str
    value: Array
    cov: Array
    by_scale: Array

    @property
    def chi2(self) -> float:
        """Squared deviation from nothing, in standard deviations."""
        return float(self.value @ np.linalg.solve(self.cov, self.value))

    @property
    def scale_variance(self) -> float:
        """Variance of the logarithm of the scale due to the uncertainty of the unknowns."""
        return float(self.by_scale @ self.cov @ self.by_scale)


def perturbations(accel: SensorStream, middle_s: float) -> dict[str, list[Array]]:
    """Changes (N, 3) of the readings by the unknowns of each suspicion.

    ``bandwidth`` (s2): to second order, and but for a delay, a low-pass filter takes from a signal what is proportional
    to its second derivative. ``axes`` (s): axes that are not read at the same time. ``rate``: a clock of its own.
    """
    slope = np.gradient(_smooth(accel.t_s, accel.value, _SMOOTH_TO_FIND_S), accel.t_s, axis=0)
    return {
        "bandwidth": [np.gradient(slope, accel.t_s, axis=0)],
        "axes": [slope * delays for delays in _AXES],
        "rate": [slope * (accel.t_s - middle_s)[:, None]],
    }


def derive_columns(data: Measurements, x: Estimate, imu: fac.Group) -> tuple[dict[str, slice], Array]:
    """Slices of each suspicion's unknowns, and their columns (K, 9, q) of the whitened inertial residuals ``imu``."""
    k, accel = len(data.t_s) - 1, data.streams.accel
    errors = SensorErrors(
        gyro_bias_rad_s=x.gyro_bias_rad_s[:-1],
        accel_bias_m_s2=np.zeros((k, 3)),
        gyro_gain=x.gyro_gain,
        accel_gain=np.zeros((3, 3)),
        accel_delay_s=x.accel_delay_s,
    )
    nodes_s = node_stamps(data, x)
    where: dict[str, slice] = {}
    perturbed: list[Preintegrated] = []
    for name, changes in perturbations(accel, par.middle_s(data.t_s)).items():
        where[name] = slice(len(perturbed), len(perturbed) + len(changes))
        # increments are linear in the readings of the accelerometer
        perturbed += [
            preintegrate(
                nodes_s, SensorStreams(gyro=data.streams.gyro, accel=accel.with_samples(accel.t_s, change)), errors
            )
            for change in changes
        ]
    by = np.stack(
        [np.concatenate([np.zeros((k, 3)), -pre.velocity, -pre.position], axis=1) for pre in perturbed], axis=2
    )
    return where, np.asarray(imu.root @ by)


def score_suspicions(
    where: dict[str, slice], own: Array, explained: Array, residual: Array, by_scale: Array
) -> list[Suspicion]:
    """Results of the score tests: ``p`` and its variance, of ``docs/dev/scale.md#accelerometer-faults``.

    Parameters
    ----------
    where, own
        From :func:`derive_columns`.
    explained
        (K, 9, q) what of the columns the fit's own parameters can do.
    residual
        (K, 9) whitened inertial residuals at the optimum.
    by_scale
        (q,) change of the logarithm of the scale with each column.
    """
    left = np.einsum("kri,krj->ij", own, own - explained)
    score = -np.einsum("kri,kr->i", own, residual)
    out = []
    for name, at in where.items():
        block = 0.5 * (left[at, at] + left[at, at].T)
        if np.linalg.eigvalsh(block)[0] <= _NOTHING_LEFT * np.trace(left):
            continue  # the fit's own parameters can do all of it
        cov = np.linalg.inv(block)
        out.append(Suspicion(name=name, value=cov @ score[at], cov=cov, by_scale=by_scale[at]))
    return out


def find_strongest_suspicion(
    suspicions: list[Suspicion], accel: SensorStream, known: Collection[str] = ()
) -> Suspicion | None:
    """The strongest suspicion that is more than chance, None where there is none.

    Of what is ``known`` to be wrong already, more than half a standard deviation that is left counts. Stamps that part
    by less than a sample from end to end are of one clock: along half an hour even a part in a million would show. The
    camera's path is suspected last: what else is wrong with an accelerometer may look like it.
    """
    least_rate = float(np.median(np.diff(accel.t_s)) / np.ptp(accel.t_s))

    def counts(suspicion: Suspicion) -> bool:
        if suspicion.name in known:
            return suspicion.chi2 > _LEFT_CHI2 * len(suspicion.value)
        return suspicion.chi2 > _LARGEST_CHI2 and (
            suspicion.name != "rate" or abs(float(suspicion.value[0])) > least_rate
        )

    return max(
        filter(counts, suspicions), key=lambda suspicion: (not _is_of_path(suspicion), suspicion.chi2), default=None
    )


@dataclass(frozen=True, kw_only=True)
class LagLimits:
    """Limits of a lag that looks like a filter's: too little of it shows to undo it."""

    #: So late by at least, and by so many standard deviations more: working sensors are by 15 ms at most.
    least_s: float = 0.025
    sigmas: float = 4.0
    #: What is missing of quick changes differs from nothing by more than so many standard deviations, and from what
    #: such a filter takes by less.
    missing_sigmas: float = 2.0


_LAG = LagLimits()


def find_filter_of_lag(suspicions: list[Suspicion], delay_s: float, sigma_s: float) -> float:
    """Time constant of the filter that an accelerometer's lag looks like; 0 where it does not.

    A filter of the first order makes readings late by its time constant, and takes half its square times the second
    derivative from them: each by itself may be something else.

    Parameters
    ----------
    delay_s, sigma_s
        By how much the readings are late, and its standard deviation.
    """
    found = next((one for one in suspicions if one.name == "bandwidth"), None)
    if found is None or delay_s - _LAG.least_s <= _LAG.sigmas * sigma_s:
        return 0.0
    missing, sigma = -float(found.value[0]), float(found.cov[0, 0]) ** 0.5
    expected = 0.5 * delay_s**2
    fits = abs(missing - expected) < _LAG.missing_sigmas * sigma < missing
    return delay_s if fits else 0.0


def _is_of_path(suspicion: Suspicion) -> bool:
    return suspicion.name == "bandwidth" and float(suspicion.value[0]) > 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Faults:
    """Faults of an accelerometer: the sums of the unknowns of each significant suspicion."""

    values: dict[str, Array]

    def with_found(self, suspicion: Suspicion) -> Faults:
        """These, and what is left of one after they were undone."""
        before = self.values.get(suspicion.name, np.zeros(len(suspicion.value)))
        return Faults(values={**self.values, suspicion.name: before + suspicion.value})

    @property
    def path_is_smoothed(self) -> bool:
        """Whether it is the camera's path, and not the accelerometer, that lacks what is quick."""
        return "bandwidth" in self.values and float(self.values["bandwidth"][0]) > 0

    def loosen_delay(self, prior: Prior) -> Prior:
        """The prior where the delay of a filter is not known: it may be none, or all of its time constant."""
        if "bandwidth" not in self.values:
            return prior
        info, at = prior.info.copy(), par.ACCEL_DELAY
        info[at, at] = 1 / (1 / info[at, at] + self._time_constant_s**2)
        return replace(prior, info=info)

    def undo(self, data: Measurements) -> Measurements:
        """The data of a recording with the readings that a sound accelerometer would have given.

        A filter is taken as one of the first order, which applications' are: the reading plus its time constant times
        its derivative. The delay of such a filter is fitted along.
        """
        accel = data.streams.accel
        t_s, value, rough = accel.t_s, accel.value, data.accel_roughness_m_s2_rthz
        slope = np.gradient(_smooth(t_s, value, _SMOOTH_TO_UNDO_S), t_s, axis=0)
        if "bandwidth" in self.values:
            value = value + self._time_constant_s * slope
            # the filter took the noise, too, and it comes back
            rough = max(rough, _FILTERED_ACCEL)
        if "axes" in self.values:
            value = value + slope * self._axes_s
        if "rate" in self.values:
            middle_s = par.middle_s(data.t_s)
            t_s = middle_s + (t_s - middle_s) / (1 + float(self.values["rate"][0]))
        streams = replace(data.streams, accel=accel.with_samples(t_s, value))
        return replace(data, streams=streams, accel_roughness_m_s2_rthz=rough)

    @property
    def _time_constant_s(self) -> float:
        return float(np.sqrt(2 * abs(self.values["bandwidth"][0])))

    @property
    def _axes_s(self) -> Array:
        return np.asarray(self.values["axes"] @ _AXES)

    def as_facts(self) -> list[Fact]:
        """What is wrong, each by itself."""
        out = []
        if "bandwidth" in self.values:
            code = "path-smoothed" if self.path_is_smoothed else "accel-low-passed"
            out.append(Fact(code, cutoff_hz=1 / (2 * np.pi * self._time_constant_s)))
        if "axes" in self.values:
            # a reading that has to be moved forward was taken late
            out.append(Fact("accel-axes-apart", delays_s=self._axes_s))
        if "rate" in self.values:
            out.append(Fact("accel-clock-apart", rate=float(self.values["rate"][0])))
        return out


def _smooth(t_s: Array, values: Array, over_s: float) -> Array:
    width = over_s / float(np.median(np.diff(t_s)))
    reach = max(1, int(np.ceil(3 * width)))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, kernel / kernel.sum(), mode="valid") for column in padded.T], axis=1)
