"""How wrong the blur may be follows from what is known of the gyroscope, and the filter and the gate know it."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.geometry import quat_exp, quat_multiply
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath, middles
from colmap_inertial.imaging.gate import GATE_LIMITS, RecordingVerdict
from colmap_inertial.imaging.gyro_camera import MOST_BIAS_RAD_S, FrameShutter, MotionErrors
from colmap_inertial.imaging.path_filters import path_wiener
from colmap_inertial.imaging.psf import blur_field, blur_path
from colmap_inertial.imaging.transfer import srgb_from_linear
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.tools.simulate.render import colmap_camera
from scripts.common.gated_deblur import deblur_gated
from tests.helpers.far_scene import FarScene
from tests.helpers.turning_cameras import CAM_FROM_IMU, PINHOLE, turning
from tests.references.path_filters import Frequencies, doubt_of, transfer_of

CAMERA = colmap_camera(PINHOLE)
SHUTTER = FrameShutter(width=640, height=480, t_s=2.4, exposure_s=0.03, readout_s=0.0)
CERTAIN = MotionErrors(extent_sigma=0.0)


def chords(gyro, shutter=SHUTTER):
    return blur_field(gyro, CAMERA, shutter, step_px=240).vector_px


def spread(fields):
    """(Gy, Gx, 3) covariance xx, xy, yy over the first axis."""
    off = fields - fields.mean(axis=0)
    x, y = off[..., 0], off[..., 1]
    return np.stack([(x * x).mean(axis=0), (x * y).mean(axis=0), (y * y).mean(axis=0)], axis=-1)


def close(found, expected, share):
    """Within a share of the variances there."""
    scale = (expected[..., 0] + expected[..., 2])[..., None]
    assert (np.abs(found - expected) < share * scale).all(), (found / scale, expected / scale)


def moving(seed=6):
    return FarScene.make(seed, vigour=2.0, size=8).gyro()


def test_errors_spread_the_blur_as_its_covariance_says(subtests):
    for what in ("rotation", "offset", "bias", "extent"):
        with subtests.test(what=what):
            gyro, rng = moving(), np.random.default_rng(1)
            sigma = {"rotation": 0.03, "offset": 0.004, "bias": 0.05, "extent": 0.1}[what]
            told = {
                "rotation": MotionErrors(rotation_cov_rad2=sigma**2 * np.eye(3), extent_sigma=0.0),
                "offset": MotionErrors(offset_sigma_s=sigma, extent_sigma=0.0),
                "bias": MotionErrors(rate_cov_rad2_s2=sigma**2 * np.eye(3), extent_sigma=0.0),
                "extent": MotionErrors(extent_sigma=sigma),
            }[what]
            fields = []
            for _ in range(60):
                three, one = sigma * rng.standard_normal(3), sigma * rng.standard_normal()
                if what == "rotation":
                    turned = quat_multiply(quat_exp(three), gyro.cam_from_imu_xyzw)
                    fields.append(chords(replace(gyro, cam_from_imu_xyzw=turned)))
                elif what == "offset":
                    fields.append(chords(replace(gyro, offset_s=gyro.offset_s + one)))
                elif what == "bias":
                    fields.append(chords(replace(gyro, path=GyroPath(gyro.path.t_s, gyro.path.rate_rad_s, three))))
                else:
                    middle_s = SHUTTER.t_s + 0.5 * SHUTTER.exposure_s
                    exposure_s = SHUTTER.exposure_s * (1 + one)
                    other = replace(SHUTTER, exposure_s=exposure_s, t_s=middle_s - 0.5 * exposure_s)
                    fields.append(chords(gyro, other))
            known = replace(gyro, errors=told)
            cov = blur_field(known, CAMERA, SHUTTER, step_px=240).cov_px2
            close(spread(np.array(fields)), cov, 0.4)  # sixty draws
            assert cov[1, 1, 0] + cov[1, 1, 2] > 0.04  # px^2
            np.testing.assert_array_equal(blur_path(known, CAMERA, SHUTTER, step_px=240).cov_px2, cov)


def test_noise_is_read_off_the_readings_and_spreads_the_blur():
    scene = FarScene.make(6, vigour=2.0, size=8)
    density = 0.1 / np.sqrt(400.0)
    noisy = [replace(scene.gyro(noise_rad_s=0.1, seed=seed), errors=CERTAIN) for seed in range(60)]
    assert noisy[0].path.noise_rad_s_rthz == pytest.approx(density, rel=0.1)
    assert scene.gyro().path.noise_rad_s_rthz < 0.01 * density
    assert GyroPath(np.arange(4.0), np.ones((4, 3)), np.zeros(3)).noise_rad_s_rthz == 0
    found = spread(np.array([chords(gyro) for gyro in noisy]))
    close(2 * found, blur_field(noisy[0], CAMERA, SHUTTER, step_px=240).cov_px2, 0.4)


def test_a_calibration_says_how_wrong_it_may_be_but_of_a_bias_that_nobody_stated():
    stated = turning([0.0, 0.5, 0.0])
    assert np.sqrt(np.diagonal(stated.errors.rate_cov_rad2_s2)) == pytest.approx(np.full(3, MOST_BIAS_RAD_S))
    prior = calibration_prior(
        Declared(
            cam_from_imu_xyzw=CAM_FROM_IMU,
            gyro_time_offset_s=0.25,
            time_offset_sigma_s=0.003,
            gyro_bias_rad_s=np.zeros(3),
            gyro_bias_sigma_rad_s=0.001,
        )
    )
    errors = MotionErrors.of(prior)
    assert errors.offset_sigma_s == pytest.approx(0.003)
    np.testing.assert_allclose(errors.rotation_cov_rad2, 1e-4 * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(errors.rate_cov_rad2_s2, 1e-6 * np.eye(3), atol=1e-12)


def test_a_transfer_s_variance_is_that_of_chords_drawn():
    s = middles(17)
    path = np.outer(s, [14.0, -5.0]) + 2.0 * np.outer(4 * s**2, [0.3, 1.0])
    cov = np.array([[0.5, 0.2], [0.2, 0.3]])
    frequencies = Frequencies.of(64)
    draws = np.random.default_rng(0).multivariate_normal([0, 0], cov, 400)
    exact = transfer_of(path, frequencies)
    found = np.mean([np.abs(transfer_of(path + np.outer(s, w), frequencies) - exact) ** 2 for w in draws], axis=0)
    expected = doubt_of(path, [0.5, 0.2, 0.3], frequencies)
    slow = frequencies.square < 0.15**2
    assert np.abs(found - expected)[slow].mean() < 0.12 * expected[slow].mean()
    assert (expected[slow] > 0).mean() > 0.9


def test_a_filter_that_is_told_of_errors_errs_less_along_a_wrong_path():
    rng = np.random.default_rng(5)
    width, height, long_px = 400, 256, 30
    sharp = rng.random((32, 50)).repeat(8, axis=0).repeat(8, axis=1)
    kernel = np.ones(long_px) / long_px
    blurred = np.apply_along_axis(lambda row: np.convolve(row, kernel, "same"), 1, sharp)
    image, truth = (np.rint(255 * srgb_from_linear(p)).astype(np.uint8) for p in (blurred, sharp))

    def error(length_px, cov_px2):
        lines = BlurField.uniform(width, height, (length_px, 0.0), step_px=64)
        out = path_wiener(image, BlurPath.straight(replace(lines, cov_px2=cov_px2)))
        return np.sqrt(np.mean((out.astype(float) - truth)[:, 40:-40] ** 2))

    certain, doubtful = ([error(px, cov) for px in (30, 34)] for cov in ((0.0, 0.0, 0.0), (16.0, 0.0, 1.0)))
    assert doubtful[1] < 0.97 * certain[1]
    assert doubtful[0] < 1.15 * certain[0]


def test_a_blur_that_is_hardly_known_is_left_alone():
    image = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
    lines = BlurField.uniform(320, 240, (12.0, 0.0))
    trusted = RecordingVerdict(trusted=True, support=9.0, extent_factor=1.0, frames=9, reason="others do")
    off_px2 = (12 * GATE_LIMITS.most_unsure) ** 2
    unsure = replace(lines, cov_px2=(0.6 * off_px2, 0.0, 0.6 * off_px2))
    assert (
        unsure.unsure_share()
        > GATE_LIMITS.most_unsure
        > replace(lines, cov_px2=(0.9 * off_px2, 0.0, 0.0)).unsure_share()
    )
    gated = deblur_gated(image, unsure, recording=trusted)
    assert gated.image is image and gated.reason.code == "blur-uncertain"
    assert lines.times(2.0).unsure_share() == 0 and unsure.times(2.0).unsure_share() == unsure.unsure_share()
    assert BlurField.uniform(320, 240, (0.0, 0.0)).unsure_share() == 0
    with pytest.raises(ValueError, match="cov_px2"):
        replace(lines, cov_px2=(-1.0, 0.0, 1.0))
