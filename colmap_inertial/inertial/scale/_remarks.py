"""What a recording has that the estimate copes with, in words: the user should know, whatever the method."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu, epoch_shift_s
from colmap_inertial.core.sampling import PAUSE_STEPS, is_gap
from colmap_inertial.core.types import CameraTrajectory, ImuRecording
from colmap_inertial.inertial.core.priors import PRIORS

#: Shorter pauses are not worth a sentence.
_PAUSE_S = 0.02
#: Nor is less than this, in which gains change by less than a calibration is sure of them.
_WARMER_K = 10.0


def remarks(trajectory: CameraTrajectory, timed: CameraTimedImu) -> tuple[str, ...]:
    """Sentences on clocks far apart, pauses of the sensors, frames without IMU, and another warmth than calibrated.

    Parameters
    ----------
    trajectory, timed
        Camera and IMU.
    """
    gyro_s, accel_s = timed.gyro_t_s, timed.accel_t_s
    covered = (max(gyro_s[0], accel_s[0]), min(gyro_s[-1], accel_s[-1]))
    said = (
        _far_apart(trajectory, timed),
        _pauses("gyroscope", gyro_s, trajectory),
        _pauses("accelerometer", accel_s, trajectory),
        _uncovered(trajectory, covered),
        _warmer(timed.imu),
    )
    return tuple(sentence for sentence in said if sentence)


def _far_apart(trajectory: CameraTrajectory, timed: CameraTimedImu) -> str:
    shift_s = epoch_shift_s(timed.imu, trajectory.epoch_ns)
    begin_s, end_s = timed.imu.gyro_t_s[0] + shift_s, timed.imu.gyro_t_s[-1] + shift_s
    if begin_s < trajectory.t_s[-1] and end_s > trajectory.t_s[0]:
        return ""
    return (
        "the stamps of camera and IMU have no time in common; the rotations give an offset of "
        f"{timed.calibration.clock_offset_s:.2f} s"
    )


def _pauses(sensor: str, t_s: Array, trajectory: CameraTrajectory) -> str:
    step_s = np.diff(t_s)
    inside = (t_s[1:] > trajectory.t_s[0]) & (t_s[:-1] < trajectory.t_s[-1])
    long_s = step_s[inside & is_gap(t_s, _PAUSE_S, steps=PAUSE_STEPS)]
    if len(long_s) == 0:
        return ""
    times = "once" if len(long_s) == 1 else f"{len(long_s)} times"
    longest = "" if len(long_s) == 1 else f", {long_s.max():.2f} s at the longest"
    return f"the {sensor} pauses {times}, for {long_s.sum():.2f} s in all{longest}"


def _uncovered(trajectory: CameraTrajectory, covered_s: tuple[float, float]) -> str:
    # A frame or so at either end is nothing to speak of.
    slack_s = 2 * float(np.median(np.diff(trajectory.t_s)))
    if covered_s[0] <= trajectory.t_s[0] + slack_s and covered_s[1] >= trajectory.t_s[-1] - slack_s:
        return ""
    count = int(np.sum((trajectory.t_s >= covered_s[0]) & (trajectory.t_s <= covered_s[1])))
    return f"the IMU runs along with {count} of {len(trajectory)} frames only; the scale rests on those"


def _warmer(imu: ImuRecording) -> str:
    if imu.calibration is None or imu.warmer_k is None or abs(imu.warmer_k) < _WARMER_K:
        return ""
    then_c, changed_pct = imu.calibration.temperature_c, 100 * PRIORS.calibrated_gain_per_k * abs(imu.warmer_k)
    return (
        f"the IMU was calibrated at {then_c:.0f} °C and was {imu.temperature_c:.0f} °C warm here: its gains may have "
        f"changed by {changed_pct:.1f} %, which the interval counts; calibrate it as warm as you film"
    )
