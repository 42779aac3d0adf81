"""The joint scale: corrections, interval and refusal."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.types import ScaleDrift
from colmap_inertial.inertial.core.parameters import N_GLOBALS, SCALE
from colmap_inertial.inertial.core.priors import AccelPart
from colmap_inertial.inertial.scale import interval
from colmap_inertial.inertial.scale.interval import metres_per_unit_of, scale_shift, scale_variances
from colmap_inertial.inertial.scale.joint import _check_drift, estimate_joint
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording


@pytest.fixture(scope="module")
def recording():
    return simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=15.0)), seed=3)


def test_a_fit_that_overstates_the_accelerometer_s_noise_is_corrected_by_its_share(subtests, monkeypatch):
    monkeypatch.setattr(interval, "find_wrong_gain", lambda *_: None)  # nothing contradicts the calibration
    for label, fitted, shift in (
        ("as expected", 1.0, 0.0),
        ("quieter", 0.5, 0.0),
        ("twice", 2.0, 0.75 * 4e-3),
        ("all of it", 30.0, 4e-3),
    ):
        with subtests.test(label):
            cov = np.zeros((N_GLOBALS, N_GLOBALS))
            cov[SCALE, SCALE] = 2e-5
            fit = SimpleNamespace(
                # 300 centres, of which the states take 200
                sums={"centre_m": (90.0, 90.0), "drift_m_rts": (10.0, 10.0)}, cov=cov, freedom=1e6, gain_surprise=2.0,
                t_s=np.linspace(0, 1e4, 100),
                expected_accel_m_s2_rthz=1e-3, noise=SimpleNamespace(accel_density_m_s2_rthz=fitted * 1e-3),
                variance_parts={"accel_gain": 1e-6, "motion": 3e-6}, level_variance=0.0,
                prior_info=None, estimate=SimpleNamespace(metres_per_unit=0.5),
            )  # fmt: skip
            variances = scale_variances(fit, AccelPart(calibrated=True, factor=0.5), clock_rate=1e-3)
            assert scale_shift(fit) == pytest.approx(shift, rel=0.01, abs=1e-12)
            assert metres_per_unit_of(fit) == pytest.approx(0.5 * np.exp(shift), rel=1e-4)
            # the surprise doubles the variance of the gains, and results of the device halve their standard deviation
            assert variances["accel_gain"] == pytest.approx(0.5 * 1e-6, rel=0.02)
            assert variances["motion"] == pytest.approx(3e-6, rel=0.02)
            assert variances["clocks"] == pytest.approx((2 * 1e-3) ** 2)


def test_a_camera_that_stands_in_its_model_has_no_scale(recording):
    still = replace(recording.trajectory, cam_in_world=np.zeros_like(recording.trajectory.cam_in_world))
    timed = CameraTimedImu.from_recording(recording.imu, recording.truth.calibration, still.epoch_ns)
    refused = estimate_joint(still, timed)
    assert (refused.verdict, refused.metres_per_unit) == ("refused", None)
    assert [reason.code for reason in refused.reasons] == ["camera-still"]


def test_a_drift_names_the_least_and_the_largest_scale_and_the_length_of_its_parts():
    parts = {
        "begin_s": np.array([100.0, 105.0, 110.0]),
        "end_s": np.array([105.0, 110.0, 115.0]),
        "log_ratio": np.log([1.02, 0.99, 1.0]),
        "sigma_log": np.full(3, 1e-3),
        "chi2": 400.0,
        "dof": 2,
    }
    trend = {"trend_log_per_s": 0.0, "trend_sigma_log_per_s": 1e-3}
    (doubt,) = _check_drift(ScaleDrift(**parts, **trend, p_value=1e-9))
    assert "from -1.0 to +2.0 % in parts of 5 s" in str(doubt)
    assert _check_drift(ScaleDrift(**parts, **trend, p_value=0.5)) == []
