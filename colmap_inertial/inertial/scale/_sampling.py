"""Stamps that scatter, and readings that repeat the one before: what a recorder did to a sensor's stream."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraTrajectory, ImuRecording


@dataclass(frozen=True, kw_only=True)
class SamplingLimits:
    """Limits beyond which sampling is reported."""

    #: Scatter of stamps about an even rate: .003 ms in 14 recordings of real sensors and cameras.
    scatter_s: float = 5e-4
    #: Longer steps are pauses, not scatter.
    steps: float = 1.8
    #: Slower cameras take keyframes, at no rate.
    dense_s: float = 0.1
    #: Share of readings that are the same on all axes as the one before: none in these recordings.
    repeated: float = 0.3


_LIMITS = SamplingLimits()


def scatter_s(t_s: Array) -> float:
    """Standard deviation of stamps about an even rate, from each one against the mean of its neighbours (median)."""
    step = np.diff(t_s)
    whole = np.maximum(step[1:], step[:-1]) < _LIMITS.steps * float(np.median(step)) if len(step) > 1 else np.zeros(0)
    if not np.any(whole):
        return 0.0
    off = np.abs(t_s[1:-1] - 0.5 * (t_s[2:] + t_s[:-2]))[whole]
    return float(np.median(off)) / 0.6745 * (2 / 3) ** 0.5


def measure_repeated_share(values: Array) -> float:
    """Share of readings (N, 3) that are the same as the one before."""
    return float(np.mean(np.all(np.diff(values, axis=0) == 0, axis=1))) if len(values) > 1 else 0.0


def describe_sampling(trajectory: CameraTrajectory, imu: ImuRecording) -> tuple[Fact, ...]:
    """Streams whose stamps scatter or whose readings repeat."""
    out = []
    dense = len(trajectory) > 1 and float(np.median(np.diff(trajectory.t_s))) < _LIMITS.dense_s
    streams = {"gyroscope": imu.gyro_t_s, "accelerometer": imu.accel_t_s, "camera": trajectory.t_s if dense else None}
    for name, t_s in streams.items():
        if t_s is not None and (scatter := scatter_s(t_s)) > _LIMITS.scatter_s:
            out.append(Fact("stamps-scatter", sensor=name, scatter_s=scatter))
    for name, values in (("gyroscope", imu.gyro_rad_s), ("accelerometer", imu.accel_m_s2)):
        if (share := measure_repeated_share(values)) > _LIMITS.repeated:
            out.append(Fact("readings-repeat", sensor=name, share=share))
    return tuple(out)
