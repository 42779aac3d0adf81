"""Faults of recordings that people really have, put into simulated ones for ``scripts/studies/scale.py``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.tools.simulate import SimulatedRecording

Generator = np.random.Generator
Fault = Callable[[SimulatedRecording, Generator], SimulatedRecording]


def _imu(change: Callable[[ImuRecording, Generator], ImuRecording]) -> Fault:
    return lambda recording, rng: replace(recording, imu=change(recording.imu, rng))


def _sensors(imu: ImuRecording, change: Callable[[Array, Array], tuple[Array, Array]]) -> ImuRecording:
    gyro_t_s, gyro = change(imu.gyro_t_s, imu.gyro_rad_s)
    accel_t_s, accel = change(imu.accel_t_s, imu.accel_m_s2)
    return replace(imu, gyro_t_s=gyro_t_s, gyro_rad_s=gyro, accel_t_s=accel_t_s, accel_m_s2=accel)


def other_rate(imu: ImuRecording, rng: Generator) -> ImuRecording:
    """Every second to fourth sample of each sensor."""
    every = rng.integers(2, 5)
    return _sensors(imu, lambda t_s, values: (t_s[::every], values[::every]))


def jitter(imu: ImuRecording, rng: Generator) -> ImuRecording:
    """Stamps that are off by up to a third of a step."""

    def change(t_s: Array, values: Array) -> tuple[Array, Array]:
        step_s = float(np.median(np.diff(t_s)))
        return t_s + rng.uniform(-1, 1) * step_s / 3 * rng.uniform(-1, 1, len(t_s)), values

    return _sensors(imu, change)


def drops(imu: ImuRecording, rng: Generator) -> ImuRecording:
    """A tenth of the samples missing at most, and a pause of both sensors."""
    share, length_s = rng.uniform(0.01, 0.1), rng.uniform(0.1, 1.0)
    begin_s = rng.uniform(imu.gyro_t_s[0], imu.gyro_t_s[-1] - length_s)

    def change(t_s: Array, values: Array) -> tuple[Array, Array]:
        kept = (rng.random(len(t_s)) > share) & ((t_s < begin_s) | (t_s > begin_s + length_s))
        return t_s[kept], values[kept]

    return _sensors(imu, change)


def vibration(imu: ImuRecording, rng: Generator) -> ImuRecording:
    """Of rotors or a tripod's head: 20 to 80 Hz, coming and going."""
    hz, phase = rng.uniform(20, 80), rng.uniform(0, 2 * np.pi, 3)
    accel_m_s2, gyro_rad_s = np.exp(rng.uniform(np.log(0.2), np.log(3.0))), rng.uniform(0.0, 0.05)

    def wave(t_s: Array) -> Array:
        swell = 1 + 0.5 * np.sin(2 * np.pi * 0.3 * t_s + phase[0])
        return np.asarray(swell[:, None] * np.sin(2 * np.pi * hz * t_s[:, None] + phase))

    return replace(
        imu,
        accel_m_s2=imu.accel_m_s2 + accel_m_s2 * wave(imu.accel_t_s),
        gyro_rad_s=imu.gyro_rad_s + gyro_rad_s * wave(imu.gyro_t_s),
    )


def temperature(imu: ImuRecording, rng: Generator) -> ImuRecording:
    """A device that warms up: biases and gains that settle over half a minute."""
    bias_m_s2, gain, bias_rad_s = rng.normal(0, 0.05, 3), rng.normal(0, 0.001, 3), rng.normal(0, 2e-3, 3)

    def warm(t_s: Array) -> Array:
        return np.asarray(1 - np.exp(-(t_s - t_s[0]) / 30))[:, None]

    return replace(
        imu,
        accel_m_s2=imu.accel_m_s2 * (1 + gain * warm(imu.accel_t_s)) + bias_m_s2 * warm(imu.accel_t_s),
        gyro_rad_s=imu.gyro_rad_s + bias_rad_s * warm(imu.gyro_t_s),
    )


def gain(imu: ImuRecording, rng: Generator) -> ImuRecording:
    """Gains and axes of the accelerometer off by up to 2 to 5 %."""
    size = rng.uniform(0.02, 0.05)
    return replace(imu, accel_m_s2=imu.accel_m_s2 @ (np.eye(3) + size * rng.uniform(-1, 1, (3, 3))).T)


def low_pass(imu: ImuRecording, rng: Generator) -> ImuRecording:
    """A filter of the first order at 2 to 10 Hz."""
    from scipy.signal import lfilter, lfilter_zi

    hz = np.exp(rng.uniform(np.log(2.0), np.log(10.0)))
    keep = np.exp(-2 * np.pi * hz * float(np.median(np.diff(imu.accel_t_s))))
    start = lfilter_zi([1 - keep], [1, -keep])[:, None] * imu.accel_m_s2[:1]
    return replace(imu, accel_m_s2=lfilter([1 - keep], [1, -keep], imu.accel_m_s2, axis=0, zi=start)[0])


def axes_apart(imu: ImuRecording, rng: Generator) -> ImuRecording:
    """Axes of the accelerometer read up to 15 ms apart."""
    late = [np.interp(imu.accel_t_s - rng.uniform(0, 0.015), imu.accel_t_s, axis) for axis in imu.accel_m_s2.T]
    return replace(imu, accel_m_s2=np.stack(late, axis=1))


def own_clock(imu: ImuRecording, rng: Generator) -> ImuRecording:
    """An accelerometer whose stamps run up to .1 % off the gyroscope's."""
    rate = 10 ** rng.uniform(-4, -3) * rng.choice([-1, 1])
    middle_s = imu.accel_t_s.mean()
    return replace(imu, accel_t_s=middle_s + (imu.accel_t_s - middle_s) * (1 + rate))


def saturation(imu: ImuRecording, rng: Generator) -> ImuRecording:
    """Readings cut off in .2 to 5 % of the samples."""
    limit = np.quantile(np.abs(imu.accel_m_s2).max(axis=1), 1 - np.exp(rng.uniform(np.log(0.002), np.log(0.05))))
    return replace(imu, accel_m_s2=np.clip(imu.accel_m_s2, -limit, limit))


def jumps(recording: SimulatedRecording, rng: Generator) -> SimulatedRecording:
    """Poses that jump for a few frames, by up to a fifth of the path's extent."""
    centre = recording.trajectory.cam_in_world.copy()
    size = float(np.ptp(centre, axis=0).max())
    for i in rng.integers(0, len(centre) - 3, rng.integers(1, 8)):
        centre[i : i + 3] += 0.1 * size * rng.standard_normal(3)
    return replace(recording, trajectory=replace(recording.trajectory, cam_in_world=centre))


def outliers(recording: SimulatedRecording, rng: Generator) -> SimulatedRecording:
    """One in twenty poses badly wrong by itself at most."""
    centre = recording.trajectory.cam_in_world.copy()
    wrong = rng.random(len(centre)) < rng.uniform(0.005, 0.05)
    size = float(np.ptp(centre, axis=0).max())
    centre[wrong] += 0.05 * size * rng.standard_normal((int(wrong.sum()), 3))
    return replace(recording, trajectory=replace(recording.trajectory, cam_in_world=centre))


#: Every fault, by name.
FAULTS: dict[str, Fault] = {
    "other_rate": _imu(other_rate),
    "jitter": _imu(jitter),
    "drops": _imu(drops),
    "vibration": _imu(vibration),
    "temperature": _imu(temperature),
    "gain": _imu(gain),
    "low_pass": _imu(low_pass),
    "axes_apart": _imu(axes_apart),
    "own_clock": _imu(own_clock),
    "saturation": _imu(saturation),
    "jumps": jumps,
    "outliers": outliers,
}
