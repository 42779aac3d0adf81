"""Noise levels: what sensors and reconstructions typically have, and what a recording says about its own.

Levels are those of the greatest restricted likelihood (REML), given a prior: what the streams of the sensors show, and
what is typical. Steps are Newton's with the average information matrix (Gilmour, Thompson and Cullis, Biometrics 1995).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.types import JOINT_GYRO_WALK_RAD_S_RTS, TYPICAL_NOISE, ImuNoise
from colmap_inertial.inertial.core.arrow import Inverse
from colmap_inertial.inertial.core.factors import Direct, Group
from colmap_inertial.inertial.core.parameters import Noise
from colmap_inertial.inertial.scale._setup import Measurements

Groups = Mapping[str, Group | Direct]


@dataclass(frozen=True, kw_only=True)
class Level:
    """Prior of a noise level, in the unit of its field of :class:`Noise`."""

    #: The most probable value.
    typical: float
    #: No estimate falls below this: pixels and samples are not finer.
    floor: float
    #: Standard deviation of the logarithm for a device in a hand, with hardly any slow errors of its accelerometer.
    spread: float
    #: The same for a device that vibrates, where slow errors are what there is.
    spread_shaken: float
    #: Residuals that determine it.
    group: str


#: The levels that are estimated. Visual errors: video of about a megapixel of a scene a few metres away. A drift that
#: starts lower may never be found: the fit then rests where the accelerometer's noise stands for it. The gyroscope's
#: noise is not among them: a slow error of the visual rotations looks just like a noisy gyroscope, and real SfM has the
#: one while real gyroscopes are not the other.
LEVELS = {
    "accel_density_m_s2_rthz": Level(
        typical=TYPICAL_NOISE.accel_density_m_s2_rthz, floor=3e-4, spread=0.2, spread_shaken=0.7, group="imu"
    ),
    "rotation_rad": Level(typical=2e-3, floor=5e-5, spread=2.0, spread_shaken=2.0, group="rotation"),
    "centre_m": Level(typical=1e-3, floor=5e-5, spread=2.0, spread_shaken=2.0, group="centre"),
    "drift_m_rts": Level(typical=4e-3, floor=1e-5, spread=2.0, spread_shaken=2.0, group="drift"),
    "accel_slow_m_s2_rts": Level(typical=1e-3, floor=1e-4, spread=0.5, spread_shaken=2.0, group="accel_slow"),
}
#: Typical noise of sensors and reconstructions.
TYPICAL = Noise(
    gyro_density_rad_s_rthz=TYPICAL_NOISE.gyro_density_rad_s_rthz,
    gyro_walk_rad_s2_rthz=JOINT_GYRO_WALK_RAD_S_RTS,
    accel_walk_m_s3_rthz=TYPICAL_NOISE.accel_walk_m_s3_rthz,
    **{name: level.typical for name, level in LEVELS.items()},
)
#: What vibration does to an accelerometer: its most probable value where there is any; and where a search starts, with
#: little white noise, that asks whether it is this.
_SHAKEN_SLOW, _SLOW_START, _QUIET_START = 1e-2, 6e-2, 3e-3
#: White noise of a gyroscope and an accelerometer, rad/s and m/s2 per root of a hertz: least and most of the first,
#: most of the second. Streams that are rougher record motion or vibration.
_LEAST_GYRO, _MOST_GYRO, _LEAST_ACCEL, _MOST_ACCEL = 1e-4, 3e-4, 5e-4, 4e-3
#: Ten times the noise of the noisiest sensor: rotors and engines, not hands (.034 at most in what was recorded).
_VIBRATES = 0.04
#: Largest correlation between errors of neighbouring rotations that is believed.
_LARGEST_CORRELATION = 0.8
#: Part of a level's residuals that is left to it at least. In a hand a hundredth: where camera and IMU do not belong
#: together, noise of the one would otherwise grow to metres and explain the other away. Where a device vibrates, that
#: much would take noise for none that explains all but a little.
_LEAST_LEFT, _LEAST_LEFT_SHAKEN = 1e-2, 1e-6
#: The first steps set levels by their sums of squares (EM; whole logarithms for slow errors). Newton steps follow,
#: damped (Levenberg) by this much at first, and by these factors more or less after a step away or nearer.
_BY_SQUARES, _DAMPED, _MORE, _LESS = 3, 0.3, 3.0, 0.4
_LEAST_DAMPING, _MOST_DAMPING = 0.03, 10.0
#: Largest changes of a variance's logarithm in a step: at first, and then.
_LARGEST_FIRST, _LARGEST_CHANGE = 3.0, 1.8
#: After so many steps without convergence, the largest change shrinks by the factor with each further step.
_PATIENCE, _TIRING = 25, 0.6
#: At rest: the likelihood has no more than this to gain, as standard deviations of the levels (Newton's decrement).
_AT_REST = 0.5


def vibrates(data: Measurements) -> bool:
    """Whether the accelerometer feels rotors or an engine."""
    return data.accel_roughness_m_s2_rthz > _VIBRATES


@dataclass(frozen=True, kw_only=True)
class Expected:
    """Priors of the levels.

    Attributes
    ----------
    noise
        The most probable values.
    floor
        The least that is possible.
    spread
        Standard deviations of the logarithms.
    start
        Where the search for the greatest likelihood begins.
    least_left
        What part of the residuals of a level counts as left to it at least.
    """

    noise: Noise
    floor: Mapping[str, float]
    spread: Mapping[str, float]
    start: Noise
    least_left: float

    @classmethod
    def of(cls, data: Measurements, sheet: ImuNoise | None) -> Expected:
        """Priors from the sensors' streams; a data sheet raises them, never lowers them.

        The white noise of a sensor is in its stream, and so is all that is quicker than the states: motion, and above
        all vibration, of which only a part harms. Up to what sensors have, an accelerometer's stream counts as its
        noise; what is rougher, as the geometric mean of both. Where it vibrates, the white noise is still the sensor's,
        and what harms is an error that stays for a while (it changes with the load on the rotors), which the search
        finds if it begins there; from white noise it may not. Flights without any visual noise show it; with a few
        millimetres of that, poses say nothing of what is quicker than a second, and a white noise that is believed too
        large lowers the scale.
        """
        gyro = float(np.clip(data.gyro_roughness_rad_s_rthz, _LEAST_GYRO, _MOST_GYRO))
        rough = max(data.accel_roughness_m_s2_rthz, _LEAST_ACCEL)
        noise = replace(TYPICAL, gyro_density_rad_s_rthz=gyro, accel_density_m_s2_rthz=rough)
        floor, shaken = {name: level.floor for name, level in LEVELS.items()}, vibrates(data)
        if rough > _MOST_ACCEL:
            noise = replace(noise, accel_density_m_s2_rthz=float(np.sqrt(rough * _MOST_ACCEL)))
        if shaken:
            noise = replace(noise, accel_density_m_s2_rthz=_MOST_ACCEL, accel_slow_m_s2_rts=_SHAKEN_SLOW)
        if sheet is not None:
            levels = [entry.name for entry in fields(ImuNoise)]
            noise = replace(noise, **{name: max(getattr(noise, name), getattr(sheet, name)) for name in levels})
            least = max(floor["accel_density_m_s2_rthz"], sheet.accel_density_m_s2_rthz)
            floor["accel_density_m_s2_rthz"] = least
        start = replace(noise, accel_slow_m_s2_rts=TYPICAL.accel_slow_m_s2_rts)
        if shaken:
            quiet = max(floor["accel_density_m_s2_rthz"], min(noise.accel_density_m_s2_rthz, _QUIET_START))
            start = replace(noise, accel_density_m_s2_rthz=quiet, accel_slow_m_s2_rts=_SLOW_START)
        return cls(
            noise=noise,
            floor=floor,
            spread={name: level.spread_shaken if shaken else level.spread for name, level in LEVELS.items()},
            start=start,
            least_left=_LEAST_LEFT_SHAKEN if shaken else _LEAST_LEFT,
        )


def correlation_factor(group: Group | Direct, states: Array, z: Array) -> float:
    """``Noise.rotation_excess`` from the correlation of consecutive residuals after a step."""
    residual = group.residual + group.apply(states, z)[:, :, 0]
    squares = float(np.sum(residual**2))
    correlation = float(np.sum(residual[1:] * residual[:-1])) / squares if squares > 0 else 0.0
    correlation = float(np.clip(correlation, 0.0, _LARGEST_CORRELATION))
    return float(np.sqrt((1 + correlation) / (1 - correlation)))


def differentiate_by_level(group: Group | Direct, values: Array) -> Array:
    """(N, r, q) whitened values times the derivative of the whitened covariance by the logarithm of the variance."""
    return values if group.share is None else np.asarray(group.share @ values)


@dataclass(eq=False, kw_only=True)
class LevelSearch:
    """The noise levels on their way to the greatest likelihood.

    Attributes
    ----------
    expected
        Prior.
    noise
        Where it stands.
    sums
        For each level: the sum of squares of its residuals, and what it would be at the right level.
    information
        (L, L) of the logarithms of the variances, prior included.
    by_scale
        (L,) change of the logarithm of ``u`` with the logarithm of each variance.
    wanted
        (L,) changes of the logarithms of the variances that lead to the greatest likelihood, to first order.
    decrement
        What is left to gain: the length of that step in standard deviations of the levels.
    """

    expected: Expected
    noise: Noise = field(init=False)
    sums: dict[str, tuple[float, float]] = field(default_factory=dict)
    information: Array = field(default_factory=lambda: np.eye(len(LEVELS)))
    by_scale: Array = field(default_factory=lambda: np.zeros(len(LEVELS)))
    wanted: Array = field(default_factory=lambda: np.ones(len(LEVELS)))
    decrement: float = np.inf
    _damping: float = _DAMPED
    _before: float = np.inf
    _steps: int = 0

    def __post_init__(self) -> None:
        self.noise = self.expected.start

    def update(self, groups: Groups, inverse: Inverse, states: Array, z: Array, *, moving: bool) -> None:
        """Update with a step (K, m, 1), (n, 1) of the other parameters and the inverse of their equations; ``moving``
        moves the levels.
        """
        squares, right, counts = np.zeros((3, len(LEVELS)))
        own = []
        rhs, rhs_z = np.zeros((*states.shape[:2], len(LEVELS))), np.zeros((len(z), len(LEVELS)))
        for i, (name, level) in enumerate(LEVELS.items()):
            group = groups[level.group]
            moved = group.residual[:, :, None] + group.apply(states, z)
            own.append(differentiate_by_level(group, moved))
            squares[i] = float(np.sum(moved * own[i]))
            if name == "rotation_rad":
                squares[i] *= self.noise.rotation_excess**2
            count = group.residual.shape[1] * (
                len(group.residual) if group.weight is None else float(group.weight.sum())
            )
            if group.share is not None:
                count = float(np.trace(group.share, axis1=1, axis2=2).sum())
            counts[i], right[i] = count, max(count - group.count_explained(inverse), self.expected.least_left * count)
            group.pull_back(own[i], rhs[:, :, i : i + 1], rhs_z[:, i : i + 1])
        # a hundredth of the residuals, or they tell nothing of how much larger than expected they are
        expected = np.maximum(right, 0.01 * counts)
        self.sums = {level: (float(squares[i]), float(expected[i])) for i, level in enumerate(LEVELS)}
        followed, followed_z = inverse.solve(rhs, rhs_z)
        self.by_scale = followed_z[0]
        average = np.zeros((len(LEVELS), len(LEVELS)))
        for i, level in enumerate(LEVELS.values()):
            change = groups[level.group].apply(followed, followed_z)
            average[i] = -0.5 * np.einsum("kri,krj->j", own[i], change)
            average[i, i] += 0.5 * float(np.sum(own[i] ** 2))
        noise = self._next(0.5 * (average + average.T), squares, right)
        if moving:
            self.noise = replace(noise, rotation_excess=correlation_factor(groups["rotation"], states, z))

    def _next(self, average: Array, squares: Array, right: Array) -> Noise:
        # Rotations hardly depend on the other levels; their correlation changes along with their level
        at = list(LEVELS).index("rotation_rad")
        others = np.arange(len(LEVELS)) != at
        average[at, :] = average[:, at] = 0.0
        average[at, at] = 0.5 * max(squares[at], right[at])
        now = 2 * np.log([getattr(self.noise, level) for level in LEVELS])
        mean = 2 * np.log([getattr(self.expected.noise, level) for level in LEVELS])
        floor = 2 * np.log([self.expected.floor[level] for level in LEVELS])
        prior = 1 / (2 * np.array([self.expected.spread[level] for level in LEVELS])) ** 2
        self.information = average + np.diag(prior)
        gradient = 0.5 * (squares - right) - prior * (now - mean)
        free = ~((now <= floor + 1e-6) & (gradient < 0))

        def newton(damping: float) -> Array:
            step = np.zeros(len(LEVELS))
            stiff = np.diag(np.where(others, damping * 0.5 * np.maximum(np.maximum(right, squares), 1.0), 0.0))
            step[free] = np.linalg.solve((self.information + stiff)[np.ix_(free, free)], gradient[free])
            return step

        self.wanted = newton(0.0)
        self.decrement = float(max(gradient[free & others] @ self.wanted[free & others], 0.0)) ** 0.5
        self._steps += 1
        if self._steps <= _BY_SQUARES:
            # an accelerometer's noise is known beforehand better than the rest
            part = np.where(np.array(list(LEVELS)) == "accel_density_m_s2_rthz", 0.5, 1.0)
            step = np.clip(
                part * np.log(np.maximum(squares, 1e-9) / np.maximum(right, 1e-9)), -_LARGEST_FIRST, _LARGEST_FIRST
            )
        else:
            if self.decrement > self._before:
                self._damping = min(max(_MORE * self._damping, _LEAST_DAMPING), _MOST_DAMPING)
            elif np.isfinite(self._before):
                self._damping = _LESS * self._damping if self._damping > 1e-3 else 0.0
            self._before = self.decrement
            most = _LARGEST_CHANGE * self._left
            step = np.clip(newton(self._damping), -most, most)
        new = np.exp(0.5 * np.maximum(now + step, floor))
        return replace(self.noise, **dict(zip(LEVELS, map(float, new), strict=True)))

    @property
    def at_rest(self) -> bool:
        """Whether the likelihood has hardly more to gain."""
        return self.decrement * self._left < _AT_REST

    def scale_moves(self) -> float:
        """Change of the logarithm of the scale with the next step of the levels."""
        most = _LARGEST_FIRST * self._left
        return abs(float(self.by_scale @ np.clip(self.wanted, -most, most)))

    @property
    def _left(self) -> float:
        """Remaining part of the largest change."""
        return float(_TIRING ** max(0, self._steps - _PATIENCE))

    def scale_variance(self, groups: Groups, states: Array, z: Array) -> tuple[float, float]:
        """Variance of the scale due to the uncertainty of the levels.

        Parameters
        ----------
        states, z
            (K, m, 1), (n, 1) solution for the scale alone as right-hand side.

        Returns
        -------
        Variance of the logarithm of the scale from the levels, and how many degrees of freedom the scale's own variance
        rests on: ``2 / var(log variance)``, as a variance from that many residuals would have (Satterthwaite 1946).
        """
        cov = np.linalg.inv(self.information)
        shares = []
        for level in LEVELS.values():
            group = groups[level.group]
            values = group.apply(states, z)
            shares.append(float(np.sum(values * differentiate_by_level(group, values))))
        by_level_of_log = np.array(shares) / float(z[0, 0])
        return (
            float(self.by_scale @ cov @ self.by_scale),
            2 / max(float(by_level_of_log @ cov @ by_level_of_log), 1e-12),
        )
