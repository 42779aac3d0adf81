"""Does the camera move in a way that gives a scale?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from colmap_inertial.checks.diagnose.findings import Finding, Recorded
from colmap_inertial.core.geometry import matrix_from_quat, skew
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.sampling import integral_at
from colmap_inertial.core.types import CameraTrajectory, ImuRecording


@dataclass(frozen=True, kw_only=True)
class MotionCheckLimits:
    """When the motion gives no scale."""

    #: Specific force is compared with itself over windows this long, in means over steps this long.
    window_s: float = 2.0
    step_s: float = 0.05
    #: Below this (rms), nothing but sensor errors and the hand's tremor is left of the acceleration; errors of the axes
    #: leave some of gravity in it where the camera turns, in m/s2 per rad/s. Measured: 0.22 and more in clean
    #: recordings that turn by 0.3 rad/s, 0.11 and less in simulated ones on the spot that turn by 1.5.
    least_accel_m_s2: float = 0.08
    accel_per_turn_m_s: float = 0.05
    #: A camera that turns slower than this (rms) stands on something.
    rotated_rad_s: float = 0.02
    #: A path is straight where it is this many times longer than its points lie off a steady glide.
    straight: float = 20.0


_LIMITS = MotionCheckLimits()

_ADVICE = (
    "record a clip in which the camera itself speeds up and slows down: swing it back and forth by 20 cm or more, "
    "a few times a second or so, for ten seconds or longer"
)


def check_motion_content(recorded: Recorded) -> Iterator[Finding]:
    """Accelerations are all that tells metres; rest, turning on the spot and gliding have none."""
    imu = recorded.imu
    # of numbers in other units no motion is told
    if imu is None or not imu.has_accel or recorded.implausible or recorded.wrong_unit is not None:
        return
    accel = acceleration_rms_m_s2(imu)
    rate = imu.gyro_rad_s - np.median(imu.gyro_rad_s, axis=0)
    rotated = float(np.sqrt(np.mean(np.sum(rate**2, axis=1))))
    if accel is None or accel > _LIMITS.least_accel_m_s2 + _LIMITS.accel_per_turn_m_s * rotated:
        return
    numbers = {"acceleration_rms_m_s2": accel, "turning_rms_rad_s": rotated}
    found = f"the camera's acceleration is {accel:.3f} m/s2 (rms) once gravity is out"
    if recorded.trajectory is not None and _glides(recorded.trajectory):
        code, what = "constant-velocity", "it glides at constant speed"
    elif rotated < _LIMITS.rotated_rad_s:
        code, what = "no-motion", f"it turns by {rotated:.3f} rad/s: it stood on a tripod or table"
    elif recorded.trajectory is not None:
        code, what = "pure-rotation", f"it only turns, by {rotated:.2f} rad/s"
    else:
        code, what = "no-acceleration", f"it turns by {rotated:.2f} rad/s, but stays in place or glides"
    yield Finding(code=code, severity="error", evidence=f"{found}; {what}", advice=_ADVICE, numbers=numbers)


def acceleration_rms_m_s2(imu: ImuRecording) -> float | None:
    """Rms of the acceleration that is left once gravity, drift, bias and a lever arm are out; ``None`` where short.

    The specific force, turned by the integrated gyroscope, is gravity plus acceleration. In each window what is
    constant or changes evenly is taken out, as gravity and the gyroscope's drift do; over all of them, what a bias and
    a lever arm between the IMU and the centre of rotation explain.
    """
    path = GyroPath(imu.gyro_t_s, imu.gyro_rad_s, np.median(imu.gyro_rad_s, axis=0))
    begin_s, end_s = max(imu.gyro_t_s[0], imu.accel_t_s[0]), min(imu.gyro_t_s[-1], imu.accel_t_s[-1])
    steps = round(_LIMITS.window_s / _LIMITS.step_s)
    starts = np.arange(begin_s, end_s - _LIMITS.window_s, _LIMITS.window_s)
    starts = starts[path.covers(starts, starts + _LIMITS.window_s)]
    if len(starts) < 2:
        return None
    edges = starts[:, None] + _LIMITS.step_s * np.arange(steps + 1)
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    force = np.diff(integral_at(imu.accel_t_s, imu.accel_m_s2, edges), axis=1) / _LIMITS.step_s
    rate = np.diff(integral_at(imu.gyro_t_s, imu.gyro_rad_s, edges), axis=1) / _LIMITS.step_s
    turn = matrix_from_quat(path.at(middle.ravel())[0]).reshape(*middle.shape, 3, 3)
    swept = skew(rate)
    lever = skew(np.gradient(rate, _LIMITS.step_s, axis=1)) + swept @ swept
    columns = np.concatenate([(turn @ force[..., None]), turn @ lever, turn], axis=-1)
    time = np.linspace(-1, 1, steps)
    even, _ = np.linalg.qr(np.stack([np.ones(steps), time, time**2], axis=1))
    left = columns - np.einsum("kp,lp,wlij->wkij", even, even, columns)
    y, x = left[..., 0].ravel(), left[..., 1:].reshape(-1, 6)
    rest = y - x @ np.linalg.lstsq(x, y, rcond=1e-6)[0]
    # the median over windows: a moment of lifting the camera does not make a recording lively
    energy = np.sum(rest.reshape(len(starts), -1) ** 2, axis=1) / steps
    return float(np.sqrt(np.median(energy)))


def _glides(trajectory: CameraTrajectory) -> bool:
    """Whether the path is a straight line at constant speed, and longer than its noise."""
    basis = np.stack([np.ones(len(trajectory)), trajectory.t_s - trajectory.t_s.mean()], axis=1)
    fit = np.linalg.lstsq(basis, trajectory.cam_in_world, rcond=None)[0]
    off = np.sqrt(np.mean(np.sum((trajectory.cam_in_world - basis @ fit) ** 2, axis=1)))
    length = float(np.linalg.norm(fit[1])) * float(np.ptp(trajectory.t_s))
    return bool(length > _LIMITS.straight * off)
