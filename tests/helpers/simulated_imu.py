"""A simulated IMU recording with stamps of a phone, and the frames that were filmed meanwhile."""

from dataclasses import replace

import numpy as np

from colmap_inertial.core.types import ImuRecording
from colmap_inertial.tools.simulate import RecordingOptions, simulate_recording
from colmap_inertial.tools.simulate.motion import MotionOptions
from colmap_inertial.tools.simulate.sensors import ImuOptions

EPOCH_NS = 1_700_000_000_123_456_789
#: Frames of the simulated recorders: 30 a second, from half a second after the first sample.
FRAME_NS = EPOCH_NS + 500_000_000 + (np.arange(200) * 1e9 / 30).astype(np.int64)


def recorded(gyro_rate_hz: float, accel_rate_hz: float) -> ImuRecording:
    options = RecordingOptions(
        motion=MotionOptions(duration_s=12.0),
        imu=ImuOptions(gyro_rate_hz=gyro_rate_hz, accel_rate_hz=accel_rate_hz, clock_offset_s=(0.0, 0.0)),
    )
    imu = simulate_recording(options, seed=5).imu
    t0 = min(imu.gyro_t_s[0], imu.accel_t_s[0])
    return replace(imu, gyro_t_s=imu.gyro_t_s - t0, accel_t_s=imu.accel_t_s - t0, epoch_ns=EPOCH_NS)


def at_one_clock(imu: ImuRecording) -> ImuRecording:
    inside = imu.gyro_t_s >= imu.accel_t_s[0]
    t_s = imu.gyro_t_s[inside]
    accel = np.stack([np.interp(t_s, imu.accel_t_s, column) for column in imu.accel_m_s2.T], axis=1)
    return replace(imu, gyro_t_s=t_s, gyro_rad_s=imu.gyro_rad_s[inside], accel_t_s=t_s, accel_m_s2=accel)
