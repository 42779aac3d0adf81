"""Gravity directions from gyroscope and accelerometer alone, before any reconstruction exists."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_conjugate, quat_rotate
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import FrameTiming, ImuRecording

#: Hand and walking accelerations average out over this time; the gyro carries the attitude meanwhile.
_AVERAGING_S = 3.0


def up_in_imu(imu: ImuRecording, gyro_bias_rad_s: Array, query_s: Array, accel_delay_s: float = 0.0) -> Array:
    """The direction against gravity in the IMU frame.

    The gyroscope gives the attitude relative to the first sample; in that slowly drifting frame the specific force is
    averaged with a Gaussian window, forward and backward in time, so there is no lag.

    Parameters
    ----------
    imu
        The recording.
    gyro_bias_rad_s
        (3,) subtracted from the gyroscope.
    query_s
        (Q,) times on the gyroscope's clock, seconds since the recording's epoch.
    accel_delay_s
        Added to accelerometer stamps to get gyroscope time.

    Returns
    -------
    (Q, 3) unit vectors. An acceleration of 0.2 m/s2 on average over six seconds tilts them by 1 degree, and so does an
    accelerometer bias of that size, which no averaging removes.

    Raises
    ------
    NotObservableError
        Where the recording has no accelerometer.
    """
    if not imu.has_accel:
        raise NotObservableError("gravity", "the recording has no accelerometer; record it along with the gyroscope")
    path = GyroPath(imu.gyro_t_s, imu.gyro_rad_s, gyro_bias_rad_s)
    accel_t = imu.accel_t_s + accel_delay_s
    force_in_start = quat_rotate(path.at(accel_t)[0], imu.accel_m_s2)
    spacing = 0.1
    grid = np.arange(accel_t[0], accel_t[-1] + spacing, spacing)
    cell = np.clip(np.round((accel_t - grid[0]) / spacing).astype(int), 0, len(grid) - 1)
    reach = np.arange(-4 * _AVERAGING_S, 4 * _AVERAGING_S + spacing, spacing)
    window = np.exp(-0.5 * (reach / _AVERAGING_S) ** 2)
    # Normalised convolution: gaps and unequal rates carry their own weight.
    weight = _convolve_same(np.bincount(cell, minlength=len(grid)), window)
    summed = np.stack(
        [_convolve_same(np.bincount(cell, force_in_start[:, k], len(grid)), window) for k in range(3)], axis=1
    )
    mean = summed / np.maximum(weight, 1e-12)[:, None]
    up_in_start = np.stack([np.interp(query_s, grid, mean[:, k]) for k in range(3)], axis=1)
    up = quat_rotate(quat_conjugate(path.at(query_s)[0]), up_in_start)
    return up / np.linalg.norm(up, axis=1, keepdims=True)


def _convolve_same(signal: AnyArray, window: Array) -> Array:
    """Convolution of the signal's length, whichever of the two is longer."""
    half = len(window) // 2
    return np.convolve(signal, window)[half : half + len(signal)]


def gravity_in_cam(timed: CameraTimedImu, timing: FrameTiming) -> dict[str, Array]:
    """Each frame's gravity direction (down, unit vector, camera frame) by name, for frames that the IMU covers;
    none without an accelerometer."""
    imu, calibration = timed.imu, timed.calibration
    if not imu.has_accel:
        return {}
    query_s = timing.pose_t_s() - timed.gyro_offset_s
    covered = (query_s >= imu.gyro_t_s[0]) & (query_s <= imu.gyro_t_s[-1])
    up = up_in_imu(imu, calibration.gyro_bias_rad_s, query_s[covered], calibration.accel_delay_s)
    down_in_cam = -quat_rotate(calibration.cam_from_imu_xyzw, up)
    names = [name for name, inside in zip(timing.names, covered, strict=True) if inside]
    return dict(zip(names, down_in_cam, strict=True))
