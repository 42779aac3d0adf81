"""Deblurring in a script of one's own: from a gyroscope, a calibration and frame times to a sharp image."""

import cv2
import numpy as np
import pytest

from colmap_inertial import CameraModel, FrameTiming, ImuRecording, deblur
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, so3_exp
from colmap_inertial.imaging.psf import frame_blur
from colmap_inertial.imaging.transfer import srgb_from_linear
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.model import colmap_camera
from colmap_inertial.tools.simulate.textures import poster

CAMERA = CameraModel(model="PINHOLE", width=320, height=240, params=(400.0, 400.0, 160.0, 120.0))
#: The camera pans and tilts steadily while the frame is exposed: 12 px to the side, 5 px down.
RATE_IN_CAM = np.array([-0.6, 1.5, 0.0])
EXPOSURE_S, START_S = 0.02, 1.0
CAM_FROM_IMU = quat_exp(np.array([0.3, -2.1, 0.8]))
CALIBRATION = calibration_prior(Declared(cam_from_imu_xyzw=CAM_FROM_IMU, gyro_time_offset_s=0.25))


def gyroscope() -> ImuRecording:
    t_s = np.arange(0, 2, 0.005)
    rate = RATE_IN_CAM @ matrix_from_quat(CAM_FROM_IMU)
    return ImuRecording(
        gyro_t_s=t_s, gyro_rad_s=np.tile(rate, (len(t_s), 1)), accel_t_s=[], accel_m_s2=np.zeros((0, 3))
    )


def images() -> tuple[np.ndarray, np.ndarray]:
    """The scene as a still camera sees it in the middle of the exposure, and as the turning one does: (H, W, 3)."""
    light = poster(np.random.default_rng(3), CAMERA.height, CAMERA.width).astype(np.float32)
    light *= 0.9 / light.max()
    focal, _, cx, cy = CAMERA.params
    k = np.array([[focal, 0, cx - 0.5], [0, focal, cy - 0.5], [0, 0, 1]])
    size = (CAMERA.width, CAMERA.height)
    total = np.zeros_like(light)
    for share in (np.arange(61) - 30) / 61:
        mapping = k @ so3_exp(share * EXPOSURE_S * RATE_IN_CAM) @ np.linalg.inv(k)
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        total += cv2.warpPerspective(light, mapping, size, flags=flags, borderMode=cv2.BORDER_REFLECT_101)
    noise = np.random.default_rng(4).normal(0, 0.003, light.shape)
    return tuple(np.rint(255 * srgb_from_linear(linear)).astype(np.uint8) for linear in (light, total / 61 + noise))


def psnr_db(image: np.ndarray, truth: np.ndarray) -> float:
    inside = (slice(20, -20), slice(20, -20))
    return float(10 * np.log10(255**2 / np.mean((image[inside].astype(float) - truth[inside]) ** 2)))


def test_three_calls_make_a_sharp_image():
    sharp, blurred = images()
    timing = FrameTiming(names=("a.jpg", "b.jpg"), t_s=[0.5, START_S], exposure_s=[EXPOSURE_S, EXPOSURE_S], readout_s=0)
    camera = colmap_camera(CAMERA)
    blur = frame_blur("b.jpg", gyroscope(), CALIBRATION, timing, camera)
    restored = deblur(blurred, blur)
    middle = blur.at(np.array([120]), np.array([160]))[0, 0]
    # a camera that turns to the right, and upwards, moves the image to the left and down
    np.testing.assert_allclose(np.abs(middle), 400 * EXPOSURE_S * np.abs(RATE_IN_CAM[[1, 0]]), rtol=0.01)
    assert psnr_db(restored, sharp) > psnr_db(blurred, sharp) + 1.0


def test_what_is_not_known_is_said():
    camera = colmap_camera(CAMERA)
    timing = FrameTiming(names=("a.jpg",), t_s=[START_S])
    with pytest.raises(NotObservableError, match="exposure time is unknown"):
        frame_blur("a.jpg", gyroscope(), CALIBRATION, timing, camera)
    with pytest.raises(ValueError, match=r"c\.jpg: no such frame"):
        frame_blur("c.jpg", gyroscope(), CALIBRATION, timing, camera)
