"""Choosing an estimator, units, windows, gravity, and the verdict."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm, t

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.inertial.scale import check_units, estimate_scale, first_seconds, gravity_at_latitude_m_s2
from colmap_inertial.inertial.scale.verdict import half_width, student_factor, verdict_of
from colmap_inertial.tools.simulate.recording import RecordingOptions, simulate_recording


def test_the_interval_is_symmetric_in_the_logarithm_and_covers_95_percent():
    verdict, (low, high), reasons = verdict_of(2.0, 0.01)
    assert verdict == "trusted" and reasons == ()
    assert low * high == pytest.approx(4.0)
    draws = 2.0 * np.exp(0.01 * np.random.default_rng(0).standard_normal(100_000))
    assert np.mean((draws > low) & (draws < high)) == pytest.approx(0.95, abs=0.003)


def test_the_width_of_the_interval_decides_the_verdict(subtests):
    for sigma, verdict in (
        (0.0152, "trusted"),
        (0.0154, "weak"),
        (0.150, "weak"),
        (0.152, "refused"),
        (np.inf, "refused"),
    ):
        with subtests.test(sigma=sigma, verdict=verdict):
            assert verdict_of(1.0, sigma)[0] == verdict
            low, high = verdict_of(1.0, sigma)[1]
            if np.isfinite(sigma):
                assert half_width(sigma) == pytest.approx((high - low) / 2)


def test_few_degrees_of_freedom_widen_as_student_has_it():
    for freedom in (3, 4, 7, 20, 1000):
        assert student_factor(freedom) == pytest.approx(t.ppf(0.975, freedom) / norm.ppf(0.975), rel=0.01)
    assert student_factor(0.5) == student_factor(3.0)


def test_failed_checks_lower_and_refusals_refuse():
    check, refusal = Fact("half-without-scale"), Fact("fit-not-converged")
    assert verdict_of(1.0, 0.001, [check])[::2] == ("weak", (check,))
    verdict, _, reasons = verdict_of(1.0, 0.001, [check], refusals=[refusal])
    assert verdict == "refused" and reasons == (refusal, check)


def test_a_verdict_needs_a_positive_scale():
    with pytest.raises(ValueError, match="metres_per_unit"):
        verdict_of(-1.0, 0.1)
    with pytest.raises(ValueError, match="sigma_log"):
        verdict_of(1.0, float("nan"))
    assert verdict_of(2.0, 0.0)[:2] == ("trusted", (2.0, 2.0))


def test_gravity_agrees_with_the_wgs84_table():
    # NIMA TR8350.2, table 3.4: equator, 45 degrees (the older 9.80620 of GRS 80 differs by 2e-5), pole
    assert gravity_at_latitude_m_s2(0) == pytest.approx(9.7803253359, abs=1e-9)
    assert gravity_at_latitude_m_s2(90) == pytest.approx(9.8321849378, abs=1e-7)
    assert gravity_at_latitude_m_s2(-45) == pytest.approx(9.80620, abs=2e-5)
    # the free-air gradient of textbooks
    assert gravity_at_latitude_m_s2(45, 1000) - gravity_at_latitude_m_s2(45) == pytest.approx(-3.086e-3, rel=2e-3)
    for latitude_deg, height_m in ((-90, -1000), (90, 10000)):
        free_air = gravity_at_latitude_m_s2(latitude_deg) - 3.086e-6 * height_m
        assert gravity_at_latitude_m_s2(latitude_deg, height_m) == pytest.approx(free_air, abs=1e-4)
    for latitude_deg in (91, -91, float("nan")):
        with pytest.raises(ValueError, match="latitude"):
            gravity_at_latitude_m_s2(latitude_deg)
    for height_m in (-1001, 10001, float("nan")):
        with pytest.raises(ValueError, match="height"):
            gravity_at_latitude_m_s2(0, height_m)


@pytest.fixture(scope="module")
def recording():
    return simulate_recording(RecordingOptions(), seed=3)


def test_units_are_checked(recording):
    imu = recording.imu
    assert check_units(imu) == []
    assert check_units(replace(imu, accel_m_s2=imu.accel_m_s2 / 9.80665))[0].values["likely"] == "g"
    assert check_units(replace(imu, gyro_rad_s=imu.gyro_rad_s * 180 / np.pi))[0].code == "gyro-in-degrees"
    without_gravity = imu.accel_m_s2 * 0.02
    assert check_units(replace(imu, accel_m_s2=without_gravity))[0].values["likely"] == "without gravity"


def test_wrong_units_are_refused_with_what_to_do(recording):
    imu = replace(recording.imu, accel_m_s2=recording.imu.accel_m_s2 / 9.80665)
    estimate = estimate_scale(recording.trajectory, imu)
    assert estimate.verdict == "refused" and "multiply it by 9.80665" in str(estimate.reasons[0])


def test_times_of_poses_in_another_unit_are_refused_before_any_search(recording, monkeypatch):
    for search in ("align_recording", "likely_convention"):
        monkeypatch.setattr(f"colmap_inertial.inertial.scale.{search}", lambda *_, **__: pytest.fail("searched"))
    poses = replace(recording.trajectory, t_s=recording.trajectory.t_s * 1e3)
    (reason,) = estimate_scale(poses, recording.imu).reasons
    assert reason.code == "poses-not-in-seconds" and reason.values["factor"] == 1000


def test_the_first_seconds_hold_nothing_of_later_frames(recording):
    cut = first_seconds(recording.trajectory, 5.0)
    assert cut.t_s[-1] <= cut.t_s[0] + 5.0 < recording.trajectory.t_s[len(cut)]


def test_the_default_estimate_is_right_and_says_how_long_it_took(recording):
    estimate = estimate_scale(recording.trajectory, recording.imu)
    low, high = estimate.ci95
    assert estimate.method == "joint" and low < recording.truth.metres_per_unit < high
    assert 0 < estimate.runtime_s < 60


def test_clocks_that_run_at_different_rates_give_the_same_scale(recording):
    imu = recording.imu
    fast = replace(imu, gyro_t_s=imu.gyro_t_s * 1.01, accel_t_s=imu.accel_t_s * 1.01)
    estimate = estimate_scale(recording.trajectory, fast)
    assert estimate.metres_per_unit == pytest.approx(recording.truth.metres_per_unit, rel=0.01)
    assert any("IMU's clock is +" in str(note) and "ppm off the camera's" in str(note) for note in estimate.notes)
    assert estimate.verdict == "weak"


def test_a_gyroscope_alone_gives_no_scale(recording):
    alone = replace(recording.imu, accel_t_s=np.zeros(0), accel_m_s2=np.zeros((0, 3)))
    estimate = estimate_scale(recording.trajectory, alone)
    assert estimate.verdict == "refused" and "no accelerometer" in str(estimate.reasons[0])


def test_another_recordings_imu_is_refused(recording):
    other = simulate_recording(RecordingOptions(), seed=4)
    estimate = estimate_scale(recording.trajectory, other.imu)
    assert estimate.verdict == "refused" and estimate.metres_per_unit is None
    assert "time offset" in str(estimate.reasons[0])


def test_a_shared_clock_narrows_the_search(recording):
    estimate = estimate_scale(recording.trajectory, recording.imu, options=ScaleOptions(max_offset_s=1.0))
    assert estimate.verdict == "refused" and "do not overlap" in str(estimate.reasons[0])
