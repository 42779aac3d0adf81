"""Noise levels: what sensors and reconstructions typically have, and what a recording says about its own.

Levels are those of the greatest restricted likelihood (REML), given a prior: what the streams of the sensors show, and
what is typical. Steps are Newton's with the average information matrix (Gilmour, Thompson and Cullis, Biometrics 1995).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from colmap_inertial.scale._factors import Direct, Group
from colmap_inertial.scale._parameters import Data, Noise
from colmap_inertial.types import JOINT_GYRO_WALK_RAD_S_RTS, TYPICAL_NOISE, Array, ImuNoise

Groups = Mapping[str, Group | Direct]

#: Visual errors: video of about a megapixel of a scene a few metres away. A drift that starts lower may never be found:
#: the fit then rests where the accelerometer's noise stands for it.
TYPICAL = Noise(
    gyro_rad_s_rthz=TYPICAL_NOISE.gyro_density_rad_s_rthz,
    gyro_walk_rad_s_rts=JOINT_GYRO_WALK_RAD_S_RTS,
    accel_m_s2_rthz=TYPICAL_NOISE.accel_density_m_s2_rthz,
    accel_walk_m_s2_rts=TYPICAL_NOISE.accel_walk_m_s3_rthz,
    rotation_rad=2e-3,
    centre_m=1e-3,
    drift_m_rts=4e-3,
)
#: No estimate may fall below these: pixels and samples are not finer.
_FLOOR = {"accel_m_s2_rthz": 3e-4, "rotation_rad": 5e-5, "centre_m": 5e-5, "drift_m_rts": 1e-5}
#: Which residuals speak for which level. The gyroscope's is not among them: a slow error of the visual rotations looks
#: just like a noisy gyroscope, and real SfM has the one while real gyroscopes are not the other.
GROUP_OF = {"accel_m_s2_rthz": "imu", "rotation_rad": "rotation", "centre_m": "centre", "drift_m_rts": "drift"}
_LEVELS = tuple(GROUP_OF)
#: Standard deviations of the logarithm of a level before anything is known of the recording.
_SPREAD = {"accel_m_s2_rthz": 0.2, "rotation_rad": 2.0, "centre_m": 2.0, "drift_m_rts": 2.0}
#: White noise of a gyroscope and an accelerometer, rad/s and m/s2 per root of a hertz: least and most of the first,
#: most of the second. Streams that are rougher record motion or vibration.
_LEAST_GYRO, _MOST_GYRO, _LEAST_ACCEL, _MOST_ACCEL = 1e-4, 3e-4, 5e-4, 4e-3
#: Largest correlation between errors of neighbouring rotations that is believed.
_LARGEST_CORRELATION = 0.8
#: Largest change of a level in an iteration (logarithm); where it turns back, the next may be this much of the last at
#: most, and grows by the other factor as long as it keeps its direction.
_LARGEST_CHANGE, _TURNED, _KEPT = 0.9, 0.4, 2.5
#: Where levels that explain the same (noise of the centres and their drift) do not come to rest in so many steps, the
#: largest change shrinks by the factor with each further one.
_PATIENCE, _TIRING = 30, 0.6


def roughness(t_s: Array, values: Array) -> float:
    """Density of the white noise that would make samples as rough as they are; more than the noise where they move.

    From third differences, which leave little of a motion that is slow against the samples: 20 times the variance of
    white noise.

    Parameters
    ----------
    t_s, values
        (N,), (N, 3) samples.
    """
    if len(t_s) < 4:
        return 0.0
    return float(np.sqrt(np.mean(np.diff(values, 3, axis=0) ** 2) / 20 * np.median(np.diff(t_s))))


@dataclass(frozen=True, kw_only=True)
class Expected:
    """What is known of the levels beforehand: their most probable values, and the least that is possible."""

    noise: Noise
    floor: Mapping[str, float]

    @classmethod
    def of(cls, data: Data, sheet: ImuNoise | None) -> Expected:
        """From the streams of the sensors; a data sheet raises it, never lowers it.

        The white noise of a sensor is in its stream, and so is all that is quicker than the states: motion, and above
        all vibration, of which only a part harms. Up to what sensors have, an accelerometer's stream counts as its
        noise; what is rougher, as the geometric mean of both.
        """
        gyro = float(np.clip(data.gyro_roughness_rad_s_rthz, _LEAST_GYRO, _MOST_GYRO))
        noise = replace(TYPICAL, gyro_rad_s_rthz=gyro, accel_m_s2_rthz=_stream_noise(data))
        if sheet is None:
            return cls(noise=noise, floor=_FLOOR)
        noise = replace(
            noise,
            gyro_rad_s_rthz=max(noise.gyro_rad_s_rthz, sheet.gyro_density_rad_s_rthz),
            gyro_walk_rad_s_rts=max(noise.gyro_walk_rad_s_rts, sheet.gyro_walk_rad_s2_rthz),
            accel_m_s2_rthz=max(noise.accel_m_s2_rthz, sheet.accel_density_m_s2_rthz),
            accel_walk_m_s2_rts=max(noise.accel_walk_m_s2_rts, sheet.accel_walk_m_s3_rthz),
        )
        least = max(_FLOOR["accel_m_s2_rthz"], sheet.accel_density_m_s2_rthz)
        return cls(noise=noise, floor={**_FLOOR, "accel_m_s2_rthz": least})


def _stream_noise(data: Data) -> float:
    """The accelerometer's noise (m/s2 per root of a hertz) as its own stream has it; see :class:`Expected`."""
    rough = max(data.accel_roughness_m_s2_rthz, _LEAST_ACCEL)
    return rough if rough < _MOST_ACCEL else float(np.sqrt(rough * _MOST_ACCEL))


def random_signs(groups: Groups, count: int) -> dict[str, Array]:
    """(N, r, count) signs for each group, the same in every call."""
    rng = np.random.default_rng(0)
    return {name: rng.choice([-1.0, 1.0], (*group.residual.shape, count)) for name, group in groups.items()}


def correlation_factor(group: Group | Direct, states: Array, z: Array) -> float:
    """``Noise.rotation_excess`` from the correlation of consecutive residuals after a step."""
    residual = group.residual + group.apply(states, z)[:, :, 0]
    squares = float(np.sum(residual**2))
    correlation = float(np.sum(residual[1:] * residual[:-1])) / squares if squares > 0 else 0.0
    correlation = float(np.clip(correlation, 0.0, _LARGEST_CORRELATION))
    return float(np.sqrt((1 + correlation) / (1 - correlation)))


def by_level(group: Group | Direct, values: Array) -> Array:
    """(N, r, q) whitened values times the derivative of the whitened covariance by the logarithm of the variance."""
    return values if group.share is None else np.asarray(group.share @ values)


@dataclass(eq=False, kw_only=True)
class LevelSearch:
    """The noise levels on their way to the greatest likelihood.

    Attributes
    ----------
    expected
        Prior, and where the search starts.
    probes
        How many random vectors estimate the traces (Hutchinson).
    noise
        Where it stands.
    sums
        For each level: the sum of squares of its residuals, and what it would be at the right level.
    information
        (L, L) of the logarithms of the variances, prior included.
    by_scale
        (L,) change of the logarithm of ``u`` with the logarithm of each variance.
    wanted
        (L,) changes of the logarithms of the variances that the last step was to make, before any limit.
    """

    expected: Expected
    probes: int
    noise: Noise = field(init=False)
    sums: dict[str, tuple[float, float]] = field(default_factory=dict)
    information: Array = field(default_factory=lambda: np.eye(len(_LEVELS)))
    by_scale: Array = field(default_factory=lambda: np.zeros(len(_LEVELS)))
    wanted: Array = field(default_factory=lambda: np.ones(len(_LEVELS)))
    _last: Array = field(default_factory=lambda: np.zeros(len(_LEVELS)))
    _steps: int = 0
    _limit: Array = field(default_factory=lambda: np.full(len(_LEVELS), 2 * _LARGEST_CHANGE))

    def __post_init__(self) -> None:
        self.noise = self.expected.noise

    @property
    def columns(self) -> int:
        """How many right-hand sides :meth:`add_columns` fills."""
        return self.probes + len(_LEVELS)

    def add_columns(self, groups: Groups, signs: Mapping[str, Array], rhs: Array, rhs_z: Array) -> None:
        """Fill right-hand sides (K, m, columns), (n, columns): random signs, then each level's residuals."""
        for name, group in groups.items():
            group.pull_back(signs[name], rhs[:, :, : self.probes], rhs_z[:, : self.probes])
        for j, level in enumerate(_LEVELS, start=self.probes):
            group = groups[GROUP_OF[level]]
            values = by_level(group, group.residual[:, :, None])
            group.pull_back(values, rhs[:, :, j : j + 1], rhs_z[:, j : j + 1])

    def update(self, groups: Groups, signs: Mapping[str, Array], states: Array, z: Array) -> None:
        """A step of the levels, given a step of all else and the solutions for :meth:`add_columns` after it."""
        changes = {level: groups[GROUP_OF[level]].apply(states, z) for level in _LEVELS}
        residual = {level: groups[GROUP_OF[level]].residual[:, :, None] for level in _LEVELS}
        information = np.zeros((len(_LEVELS), len(_LEVELS)))
        for i, level in enumerate(_LEVELS):
            group, change = groups[GROUP_OF[level]], changes[level]
            moved = residual[level] + change[:, :, :1]
            squares = float(np.sum(moved * by_level(group, moved)))
            if level == "rotation_rad":
                squares *= self.noise.rotation_excess**2
            count = group.residual.shape[1] * (
                len(group.residual) if group.weight is None else float(group.weight.sum())
            )
            if group.share is not None:
                count = float(np.trace(group.share, axis1=1, axis2=2).sum())
            probed = by_level(group, signs[GROUP_OF[level]]) * change[:, :, 1 : 1 + self.probes]
            used = float(np.sum(probed)) / self.probes
            self.sums[level] = squares, max(count - used, 0.01 * count)
            own = by_level(group, residual[level])
            followed = np.einsum("kri,krj->j", own, change[:, :, 1 + self.probes :])
            information[i] = -0.5 * followed
            information[i, i] += 0.5 * float(np.sum(own**2))
        self.by_scale = z[0, 1 + self.probes :]
        self._step(0.5 * (information + information.T), groups["rotation"], states, z)

    def _step(self, information: Array, rotation: Group | Direct, states: Array, z: Array) -> None:
        squares, right = np.array([self.sums[level] for level in _LEVELS]).T
        # Where residuals are smaller than their level says, so is the information in them
        smaller = np.sqrt(np.maximum(1.0, right / np.maximum(squares, 1e-9)))
        information = information * smaller[:, None] * smaller
        # Rotations hardly depend on the other levels; their correlation changes along with their level
        at = _LEVELS.index("rotation_rad")
        information[at, :] = information[:, at] = 0.0
        information[at, at] = 0.5 * max(squares[at], right[at])
        now = 2 * np.log([getattr(self.noise, level) for level in _LEVELS])
        mean = 2 * np.log([getattr(self.expected.noise, level) for level in _LEVELS])
        floor = 2 * np.log([self.expected.floor[level] for level in _LEVELS])
        prior = 1 / (2 * np.array([_SPREAD[level] for level in _LEVELS])) ** 2
        self.information = information + np.diag(prior)
        step = np.linalg.solve(self.information, 0.5 * (squares - right) - prior * (now - mean))
        self.wanted = np.where((now <= floor + 1e-6) & (step < 0), 0.0, step)
        turned = self._last * step < 0
        self._steps += 1
        most = 2 * _LARGEST_CHANGE * self._left
        self._limit = np.minimum(np.where(turned, _TURNED * self._limit, _KEPT * self._limit), most)
        self._last = np.clip(step, -self._limit, self._limit)
        new = np.exp(0.5 * np.maximum(now + self._last, floor))
        self.noise = replace(
            self.noise,
            **dict(zip(_LEVELS, map(float, new), strict=True)),
            rotation_excess=correlation_factor(rotation, states, z),
        )

    def scale_moves(self) -> float:
        """How much the logarithm of the scale would change with the step that the levels want to make."""
        return abs(float(np.sum(self.by_scale * np.clip(self.wanted, -3.0 * self._left, 3.0 * self._left))))

    @property
    def _left(self) -> float:
        """What is left of the largest change."""
        return float(_TIRING ** max(0, self._steps - _PATIENCE))

    def scale_variance(self, groups: Groups, states: Array, z: Array) -> tuple[float, float]:
        """What the levels' own uncertainty means for the scale.

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
        for level in _LEVELS:
            group = groups[GROUP_OF[level]]
            values = group.apply(states, z)
            shares.append(float(np.sum(values * by_level(group, values))))
        by_level_of_log = np.array(shares) / float(z[0, 0])
        return (
            float(self.by_scale @ cov @ self.by_scale),
            2 / max(float(by_level_of_log @ cov @ by_level_of_log), 1e-12),
        )
