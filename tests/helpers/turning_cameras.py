"""Cameras that turn as their gyroscope says, and lenses of theirs."""

from functools import cache

import numpy as np

from colmap_inertial.core.geometry import matrix_from_quat, quat_exp
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel, ImuRecording
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.tools.simulate import MotionOptions, make_motion, make_world
from colmap_inertial.tools.simulate.render import Renderer

PINHOLE = CameraModel(model="PINHOLE", width=640, height=480, params=(500.0, 510.0, 330.0, 235.0))
LENS = CameraModel(model="OPENCV", width=640, height=480, params=(500, 504, 322, 237, 0.12, -0.2, 0.001, -0.0005))
FISHEYE = CameraModel(model="OPENCV_FISHEYE", width=640, height=480, params=(260, 262, 322, 237, 0.02, -0.01, 0, 0))
CAM_FROM_IMU = quat_exp(np.array([0.3, -2.1, 0.8]))
#: Instants of an exposure, in shares of it from its middle.
STEPS = (np.arange(48) + 0.5) / 48 - 0.5


def turning(rate_in_cam, rate_hz=200.0, span_s=2.0):
    """A camera that turns steadily, from its gyroscope's samples."""
    t = np.arange(0, span_s, 1 / rate_hz)
    rate = np.asarray(rate_in_cam) @ matrix_from_quat(CAM_FROM_IMU)
    imu = ImuRecording(
        gyro_t_s=t, gyro_rad_s=np.tile(rate, (len(t), 1)), accel_t_s=[], accel_m_s2=np.zeros((0, 3)), epoch_ns=7_000_000
    )
    calibration = calibration_prior(Declared(cam_from_imu_xyzw=CAM_FROM_IMU, gyro_time_offset_s=0.25))
    return GyroCamera.of(imu, calibration, camera_epoch_ns=3_000_000)


def handheld(vigour=1.0, seed=3, gyro_hz=400.0):
    """A hand that only turns, and its perfect gyroscope on a camera's clock of its own."""
    options = MotionOptions(kind="pure_rotation", duration_s=6.0, vigour=vigour, heading_deg=90.0)
    motion = make_motion(options, np.random.default_rng(seed))
    t = np.arange(0.0, 6.0, 1 / gyro_hz)
    rate = motion.rate_in_cam_rad_s(t) @ matrix_from_quat(CAM_FROM_IMU)
    path = GyroPath(t + 11.0, rate, np.zeros(3))
    return motion, GyroCamera(path=path, cam_from_imu_xyzw=CAM_FROM_IMU, offset_s=-11.0)


@cache
def room():
    return Renderer(make_world("room", 5))


def shutter_of(camera, t_s):
    model = camera.model
    return FrameShutter(
        width=model.width,
        height=model.height,
        t_s=t_s,
        exposure_s=camera.exposure_s,
        readout_s=camera.readout_s,
        readout_direction=camera.readout_direction,
    )
