"""Noise levels: what sensors and reconstructions typically have, and what a recording says about its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from colmap_inertial.scale._factors import Direct, Group
from colmap_inertial.scale._parameters import Noise
from colmap_inertial.types import JOINT_GYRO_NOISE, TYPICAL_NOISE, Array, ImuNoise

#: Visual errors: video of about a megapixel of a scene a few metres away. The gyroscope's levels and the
#: accelerometer's walk are kept; the rest are starting values.
TYPICAL = Noise(
    gyro_rad_s_rthz=JOINT_GYRO_NOISE[0],
    gyro_walk_rad_s_rts=JOINT_GYRO_NOISE[1],
    accel_m_s2_rthz=TYPICAL_NOISE.accel_density_m_s2_rthz,
    accel_walk_m_s2_rts=TYPICAL_NOISE.accel_walk_m_s3_rthz,
    rotation_rad=2e-3,
    centre_m=2e-3,
    drift_m_rts=1e-3,
)
#: No estimate may fall below these: pixels and samples are not finer.
_FLOOR = {"accel_m_s2_rthz": 1e-3, "rotation_rad": 5e-5, "centre_m": 5e-5, "drift_m_rts": 1e-5}
#: Which rows of which residuals speak for which level. The gyroscope's levels are not among them: a slow error of the
#: visual rotations looks just like a noisy gyroscope, and real SfM has the one while real gyroscopes are not the other.
_COMPONENTS = {
    "accel_m_s2_rthz": ("imu", slice(3, 9)),
    "rotation_rad": ("rotation", slice(0, 3)),
    "centre_m": ("centre", slice(0, 3)),
    "drift_m_rts": ("drift", slice(0, 3)),
}
#: Largest correlation between errors of neighbouring rotations that is believed.
_LARGEST_CORRELATION = 0.8
#: How many residuals the starting value counts as.
_WEIGHT = 10.0
#: Largest change of a level in an iteration (logarithm), and largest factor by which changes are taken to shrink.
_LARGEST_CHANGE, _STEADIEST = 0.9, 0.8


def typical_noise(sheet: ImuNoise | None) -> tuple[Noise, dict[str, float]]:
    """Starting levels and the floors of those that are estimated; a data sheet raises both, never lowers them."""
    if sheet is None:
        return TYPICAL, dict(_FLOOR)
    start = replace(
        TYPICAL,
        gyro_rad_s_rthz=max(TYPICAL.gyro_rad_s_rthz, sheet.gyro_density_rad_s_rthz),
        gyro_walk_rad_s_rts=max(TYPICAL.gyro_walk_rad_s_rts, sheet.gyro_walk_rad_s2_rthz),
        accel_m_s2_rthz=max(TYPICAL.accel_m_s2_rthz, sheet.accel_density_m_s2_rthz),
        accel_walk_m_s2_rts=max(TYPICAL.accel_walk_m_s2_rts, sheet.accel_walk_m_s3_rthz),
    )
    return start, {**_FLOOR, "accel_m_s2_rthz": max(_FLOOR["accel_m_s2_rthz"], sheet.accel_density_m_s2_rthz)}


def random_signs(groups: Mapping[str, Group | Direct], count: int) -> dict[str, Array]:
    """(N, r, count) signs for each group, the same in every call."""
    rng = np.random.default_rng(0)
    return {name: rng.choice([-1.0, 1.0], (*group.residual.shape, count)) for name, group in groups.items()}


def sums_of_squares(
    noise: Noise, groups: Mapping[str, Group | Direct], signs: Mapping[str, Array], states: Array, z: Array
) -> dict[str, tuple[float, float]]:
    """For each level: the sum of squares of its residuals after a step, and what it would be at the right level.

    The first column of ``states`` and ``z`` is the step, the others are the solutions for ``signs`` as residuals: they
    estimate how many residuals the parameters use up (Hutchinson's trace), as Forstner's variance components need.
    """
    out = {}
    for level, (name, rows) in _COMPONENTS.items():
        group = groups[name]
        change = group.apply(states, z)[:, rows]
        squares = float(np.sum((group.residual[:, rows] + change[:, :, 0]) ** 2))
        count = len(group.residual) if group.weight is None else float(group.weight.sum())
        rows_each = rows.stop - rows.start
        if level == "rotation_rad":
            squares *= noise.rotation_excess**2
        used = float(np.sum(signs[name][:, rows] * change[:, :, 1:])) / signs[name].shape[2]
        out[level] = squares, max(rows_each * count - used, 0.02 * rows_each * count)
    return out


def correlation_factor(group: Group | Direct, states: Array, z: Array) -> float:
    """``Noise.rotation_excess`` from the correlation of consecutive residuals after a step."""
    residual = group.residual + group.apply(states, z)[:, :, 0]
    squares = float(np.sum(residual**2))
    correlation = float(np.sum(residual[1:] * residual[:-1])) / squares if squares > 0 else 0.0
    correlation = float(np.clip(correlation, 0.0, _LARGEST_CORRELATION))
    return float(np.sqrt((1 + correlation) / (1 - correlation)))


def updated_noise(
    noise: Noise,
    start: Noise,
    floor: Mapping[str, float],
    sums: Mapping[str, tuple[float, float]],
    rotation_excess: float,
    before: Mapping[str, float],
) -> tuple[Noise, dict[str, float]]:
    """New levels, and the logarithmic change of each that the residuals ask for.

    Parameters
    ----------
    before
        The changes asked for the last time. Where they shrink by a steady factor, the rest of the series is added at
        once (Aitken's extrapolation): a level of which most residuals are used up by states converges slowly.
    """
    new, asked = {}, {}
    for level, (squares, expected) in sums.items():
        now = getattr(noise, level)
        ratio = (squares + _WEIGHT * (getattr(start, level) / now) ** 2) / (expected + _WEIGHT)
        change = 0.5 * float(np.log(ratio))
        shrinks = change / before[level] if before.get(level) else 0.0
        # In steps, as the robust weights have to follow
        step = float(
            np.clip(change / (1 - float(np.clip(shrinks, 0.0, _STEADIEST))), -_LARGEST_CHANGE, _LARGEST_CHANGE)
        )
        new[level] = max(now * float(np.exp(step)), floor[level])
        asked[level] = float(np.log(new[level] / now)) if new[level] == floor[level] else change
    return replace(noise, **new, rotation_excess=rotation_excess), asked
