"""A stream that is not what the sensor felt: named, undone where it can be, and never trusted."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.types import CAL, IMU_CAL, ImuCalibration
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.preintegration import SensorStream, SensorStreams, find_saturated, gap_cov
from colmap_inertial.inertial.scale import estimate_scale, first_seconds, gravity_at_latitude_m_s2
from colmap_inertial.inertial.scale._fit import fit_jointly
from colmap_inertial.inertial.scale._setup import prepare
from colmap_inertial.inertial.scale._suspects import Faults, Suspicion, find_strongest_suspicion
from colmap_inertial.inertial.scale.verdict import CAUSES, describe_parts
from colmap_inertial.motion.align import align_camera_imu
from colmap_inertial.tools.simulate.motion import MotionOptions
from colmap_inertial.tools.simulate.recording import RecordingOptions, simulate_recording


@pytest.fixture(scope="module")
def recording():
    return simulate_recording(RecordingOptions(motion=MotionOptions(kind="roam", duration_s=20.0)), seed=7)


def low_passed(imu, hz):
    """A filter of the first order over samples as they come, as applications have it."""
    out = imu.accel_m_s2.copy()
    for i, step_s in enumerate(np.diff(imu.accel_t_s), start=1):
        out[i] = out[i - 1] + (1 - np.exp(-2 * np.pi * hz * step_s)) * (out[i] - out[i - 1])
    return replace(imu, accel_m_s2=out)


def one_axis_late(imu, delay_s):
    accel = imu.accel_m_s2.copy()
    accel[:, 1] = np.interp(imu.accel_t_s - delay_s, imu.accel_t_s, accel[:, 1])
    return replace(imu, accel_m_s2=accel)


def stretched(imu, rate):
    middle_s = imu.accel_t_s.mean()
    return replace(imu, accel_t_s=middle_s + (imu.accel_t_s - middle_s) * (1 + rate))


def saturated(imu, share):
    limit = np.quantile(np.abs(imu.accel_m_s2).max(axis=1), 1 - share)
    return replace(imu, accel_m_s2=np.clip(imu.accel_m_s2, -limit, limit))


@pytest.mark.parametrize(
    ("alter", "code", "read", "value", "within"),
    [
        pytest.param(
            lambda imu: low_passed(imu, 2.0), "accel-low-passed", lambda v: v["cutoff_hz"], 2.0, 0.5, id="2-hz"
        ),
        pytest.param(
            lambda imu: low_passed(imu, 4.0), "accel-low-passed", lambda v: v["cutoff_hz"], 4.0, 0.8, id="4-hz"
        ),
        pytest.param(
            lambda imu: one_axis_late(imu, 0.01),
            "accel-axes-apart",
            lambda v: 1e3 * v["delays_s"][1],
            6.7,
            1.5,
            id="an-axis-late",
        ),
        pytest.param(
            lambda imu: stretched(imu, 1e-3),
            "accel-clock-apart",
            lambda v: 1e6 * v["rate"],
            1000,
            60,
            id="a-clock-of-its-own",
        ),
        pytest.param(
            lambda imu: replace(imu, accel_m_s2=1.05 * imu.accel_m_s2),
            "accel-gain-large",
            lambda v: 100 * v["gains"][0],
            5.0,
            1.5,
            id="gain",
        ),
        pytest.param(
            lambda imu: saturated(imu, 0.03), "readings-cut-off", lambda v: 100 * v["share"], 3.0, 0.2, id="saturated"
        ),
    ],
)
def test_a_fault_of_the_accelerometer_is_named_and_undone(recording, alter, code, read, value, within):
    estimate = estimate_scale(recording.trajectory, alter(recording.imu))
    assert estimate.verdict == "weak"
    found = [reason for reason in estimate.reasons if reason.code == code]
    assert len(found) == 1, estimate.reasons
    assert read(found[0].values) == pytest.approx(value, abs=within)
    assert estimate.ci95[0] < recording.truth.metres_per_unit < estimate.ci95[1]


@pytest.mark.parametrize("width_s", [0.05, 0.12])
@pytest.mark.parametrize("kind", ["roam", "walk"])
def test_a_path_that_was_smoothed_gives_no_scale(kind, width_s):
    recording = simulate_recording(RecordingOptions(motion=MotionOptions(kind=kind, duration_s=22.0)), seed=5)
    trajectory = recording.trajectory
    kernel = np.exp(-0.5 * (np.arange(-15, 16) * np.median(np.diff(trajectory.t_s)) / width_s) ** 2)
    padded = np.pad(trajectory.cam_in_world, ((15, 15), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(c, kernel / kernel.sum(), mode="valid") for c in padded.T], axis=1)
    estimate = estimate_scale(replace(trajectory, cam_in_world=smooth), recording.imu)
    assert estimate.verdict == "refused" and estimate.metres_per_unit is None
    # wider ones may leave nothing that fits at all
    if width_s < 0.1:
        assert any("unsmoothed poses" in str(reason) for reason in estimate.reasons)


def test_a_filter_without_delay_is_the_accelerometer_s_where_the_delay_is_known(recording):
    imu = recording.imu
    kernel = np.exp(-0.5 * (np.arange(-40, 41) * np.median(np.diff(imu.accel_t_s)) / 0.05) ** 2)
    padded = np.pad(imu.accel_m_s2, ((40, 40), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(c, kernel / kernel.sum(), mode="valid") for c in padded.T], axis=1)
    known = align_camera_imu(recording.trajectory, imu)
    cov = known.cov.copy()
    cov[CAL.ACCEL_TIME_OFFSET] = cov[CAL.GYRO_TIME_OFFSET]
    cov[:, CAL.ACCEL_TIME_OFFSET] = cov[:, CAL.GYRO_TIME_OFFSET]
    cov[CAL.ACCEL_TIME_OFFSET, CAL.ACCEL_TIME_OFFSET] += 1e-8
    estimate = estimate_scale(
        recording.trajectory, replace(imu, accel_m_s2=smooth), calibration=replace(known, cov=cov)
    )
    assert estimate.verdict == "weak" and any("low-passed" in str(reason) for reason in estimate.reasons)
    assert estimate.ci95[0] < recording.truth.metres_per_unit < estimate.ci95[1]


def without_errors(cov):
    """A calibration that found nothing to correct, this sure."""
    return ImuCalibration(
        accel_gain=np.zeros((3, 3)),
        accel_bias_m_s2=np.zeros(3),
        gyro_gain=np.zeros((3, 3)),
        gyro_bias_rad_s=np.zeros(3),
        cov=cov,
        gravity_m_s2=9.80665,
        attitudes=24,
    )


@pytest.mark.parametrize("correlation", [0.0, 0.9, 0.98])
def test_gains_that_a_calibration_ties_together_are_no_surprise(recording, correlation):
    cov = np.eye(IMU_CAL.COUNT) * 1e-8
    gains = np.r_[IMU_CAL.ACCEL_GAIN, IMU_CAL.GYRO_GAIN]
    tie = np.kron(np.array([[1, correlation], [correlation, 1]]), np.eye(9)) * 2e-3**2
    cov[np.ix_(gains, gains)] = tie
    known = without_errors(cov)
    estimate = estimate_scale(recording.trajectory, recording.imu, imu_calibration=known)
    assert estimate.verdict == "trusted" and estimate.parts["accel_gain"] < 0.002


def test_a_stream_that_is_cut_off_throughout_is_refused_for_that(recording):
    imu = recording.imu
    ends = np.where(imu.accel_m_s2 > np.median(imu.accel_m_s2, axis=0), 1.0, -1.0) * [5.0, 6.0, 7.0]
    ends[::7, 0] = 0.1  # a third level; the other axes stand at an end
    short = first_seconds(recording.trajectory, 8.0)
    estimate = estimate_scale(short, replace(imu, accel_m_s2=ends + np.array([0, 0, 4.0])))
    assert estimate.verdict == "refused"
    hard = np.clip(imu.accel_m_s2, -8.0, 8.0)
    estimate = estimate_scale(short, replace(imu, accel_m_s2=hard))
    assert estimate.verdict != "trusted" and any("saturated" in str(reason) for reason in estimate.reasons)


def test_a_sound_accelerometer_raises_no_suspicion(subtests):
    for seed in (1, 2, 3, 4):
        with subtests.test(seed=seed):
            sound = simulate_recording(RecordingOptions(motion=MotionOptions(kind="roam", duration_s=20.0)), seed=seed)
            data, prior = prepared(sound)
            found = {one.name: one.chi2 / len(one.value) for one in fit_jointly(data, prior, None).suspicions}
            assert set(found) == {"bandwidth", "axes", "rate"} and max(found.values()) < 9


def prepared(recording):
    return prepare(
        recording.trajectory,
        CameraTimedImu.from_recording(
            recording.imu, align_camera_imu(recording.trajectory, recording.imu), recording.trajectory.epoch_ns
        ),
        gravity_m_s2=9.80665,
        gravity_sigma_m_s2=0.02,
        states_hz=8.0,
    )


def test_what_was_undone_is_suspected_no_more(recording):
    altered = replace(recording, imu=one_axis_late(recording.imu, 0.012))
    data, prior = prepared(altered)
    found = find_strongest_suspicion(fit_jointly(data, prior, None).suspicions, data.streams.accel)
    assert found.name == "axes" and found.chi2 > 100
    undone = Faults(values={}).with_found(found).undo(data)
    again = {one.name: one.chi2 for one in fit_jointly(undone, prior, None).suspicions}
    assert again["axes"] < 0.1 * found.chi2


def test_the_delay_of_an_undone_filter_is_as_uncertain_as_its_time_constant():
    """The variances of two independent delays add up: 3 ms known before, 4 ms of the filter."""
    info = np.eye(par.N_GLOBALS)
    info[par.ACCEL_DELAY, par.ACCEL_DELAY] = 0.003**-2
    prior = par.Prior(mean=None, info=info, gravity_m_s2=9.8, gravity_sigma_m_s2=0.02)
    loosened = Faults(values={"bandwidth": np.array([-0.5 * 0.004**2])}).loosen_delay(prior)
    assert loosened.info[par.ACCEL_DELAY, par.ACCEL_DELAY] ** -0.5 == pytest.approx(0.005)
    assert np.array_equal(np.delete(loosened.info, par.ACCEL_DELAY, axis=0), np.delete(info, par.ACCEL_DELAY, axis=0))


def test_stamps_that_part_by_less_than_a_sample_are_of_one_clock():
    t_s = np.linspace(0, 2000, 400_001)
    accel = SensorStream.from_samples(t_s, np.zeros((len(t_s), 3)))

    def rate(ppm):
        cov = np.array([[(0.1e-6) ** 2]])
        return Suspicion(name="rate", value=np.array([1e-6 * ppm]), cov=cov, by_scale=np.zeros(1))

    # 5 ms in 2000 s
    assert [find_strongest_suspicion([rate(ppm)], accel) is not None for ppm in (-3, -2, 2, 3)] == [
        True,
        False,
        False,
        True,
    ]
    # what is left of a rate that was found is undone to the last
    assert find_strongest_suspicion([rate(1)], accel, {"rate"}) is not None


def test_the_parts_of_the_variance_are_those_of_the_covariance(recording):
    data, prior = prepared(recording)
    fit = fit_jointly(data, prior, None)
    variance = fit.cov[par.SCALE, par.SCALE]
    assert sum(fit.variance_parts.values()) == pytest.approx(variance, rel=1e-9)
    assert max(fit.variance_parts.values()) < variance
    # one more measurement of a parameter with the prior's own information takes off its part, to first order
    gravity = fit.estimate.gravity_m_s2 / np.linalg.norm(fit.estimate.gravity_m_s2)
    with_scale = fit.cov[par.SCALE]
    assert fit.variance_parts["gravity"] == pytest.approx((with_scale[par.GRAVITY] @ gravity / 0.02) ** 2, rel=1e-3)
    gain, info = with_scale[par.ACCEL_GAIN], prior.info[par.ACCEL_GAIN, par.ACCEL_GAIN]
    assert fit.variance_parts["accel_gain"] == pytest.approx(gain @ info @ gain, rel=1e-3)
    assert fit.variance_parts["accel_noise"] > 0 and fit.variance_parts["camera_path"] > 0


def test_the_interval_says_what_it_is_made_of_and_a_calibration_takes_its_part_off(recording):
    cov = np.diag([1e-4**2] * IMU_CAL.COUNT)
    known = without_errors(cov)
    plain = estimate_scale(recording.trajectory, recording.imu)
    better = estimate_scale(recording.trajectory, recording.imu, imu_calibration=known)
    for estimate in (plain, better):
        # the images of a model alone show a rolling shutter
        assert set(estimate.parts) == set(CAUSES) - {"rolling_shutter"}
        assert sum(sigma**2 for sigma in estimate.parts.values()) == pytest.approx(estimate.sigma_log**2)
    assert better.parts["accel_gain"] < 0.5 * plain.parts["accel_gain"]
    made_of = describe_parts(plain.parts)
    assert str(made_of).startswith("the accelerometer's gain +-") and "calibrate-imu" in made_of.advice
    assert "calibrate-imu" not in describe_parts(better.parts).advice


def test_the_latitude_takes_the_part_of_gravity_off(recording):
    plain = estimate_scale(recording.trajectory, recording.imu)
    placed = estimate_scale(
        recording.trajectory, recording.imu, options=ScaleOptions(latitude_deg=45.0, height_m=100.0)
    )
    assert placed.parts["gravity"] < 0.1 * plain.parts["gravity"]
    strength = np.linalg.norm(placed.gravity_in_world_m_s2)
    assert strength == pytest.approx(gravity_at_latitude_m_s2(45.0, 100.0), abs=2e-3)
    # standard gravity says nothing of the place
    same = estimate_scale(recording.trajectory, recording.imu, options=ScaleOptions(gravity_m_s2=9.80665))
    assert same.parts == plain.parts


def test_cut_off_readings_are_found_behind_a_calibration(recording):
    raw = saturated(recording.imu, 0.03)
    rng = np.random.default_rng(5)
    calibration = ImuCalibration(
        accel_gain=np.tril(0.02 * rng.standard_normal((3, 3))),
        accel_bias_m_s2=0.2 * rng.standard_normal(3),
        gyro_gain=0.02 * rng.standard_normal((3, 3)),
        gyro_bias_rad_s=0.01 * rng.standard_normal(3),
        cov=np.eye(IMU_CAL.COUNT) * 1e-8,
        gravity_m_s2=9.80665,
        attitudes=12,
    )
    gyro, accel = find_saturated(calibration.corrected(raw))
    assert not gyro.any()
    np.testing.assert_array_equal(accel, find_saturated(raw)[1])
    assert accel.mean() == pytest.approx(0.03, abs=0.002)


def test_the_gyroscope_s_cut_off_readings_are_a_gap(recording):
    imu = recording.imu
    limit = np.quantile(np.abs(imu.gyro_rad_s), 0.99)
    altered = replace(imu, gyro_rad_s=np.clip(imu.gyro_rad_s, -limit, limit))
    data, _ = prepared(replace(recording, imu=altered))
    assert data.gyro_cut_share > 0.01
    assert data.streams.gyro.paused_s[-1] == pytest.approx(data.gyro_cut_share * np.ptp(imu.gyro_t_s), rel=0.5)
    estimate = estimate_scale(recording.trajectory, altered)
    assert estimate.verdict == "weak" and any(
        "of the gyroscope's readings" in str(reason) for reason in estimate.reasons
    )
    assert estimate.ci95[0] < recording.truth.metres_per_unit < estimate.ci95[1]


def test_the_accelerometer_s_cut_off_readings_are_a_gap_of_its_own(recording):
    imu = recording.imu
    limit = np.quantile(np.abs(imu.accel_m_s2), 0.99)
    altered = replace(imu, accel_m_s2=np.clip(imu.accel_m_s2, -limit, limit))
    whole, cut = (SensorStreams.from_recording(of, of.gyro_t_s, of.accel_t_s) for of in (imu, altered))
    lost_s = np.any(np.abs(imu.accel_m_s2) >= limit, axis=1).mean() * np.ptp(imu.accel_t_s)
    assert whole.accel.paused_s[-1] == 0
    assert cut.accel.paused_s[-1] == pytest.approx(lost_s, rel=0.5)
    assert cut.gyro.paused_s[-1] == 0


def test_lost_samples_are_a_gap_of_their_own_sensor_however_short():
    t_s = np.arange(0, 2, 0.01)
    values = np.random.default_rng(0).standard_normal((len(t_s), 3))
    lost = np.zeros(len(t_s), dtype=bool)
    lost[50:53] = True
    streams = SensorStreams(
        gyro=SensorStream.from_samples(t_s, values), accel=SensorStream.from_samples(t_s, values, lost)
    )
    nodes_s = np.array([0.1, 0.3, 0.7, 1.0])
    gyro_s, accel_s = streams.gap_s(nodes_s)
    np.testing.assert_allclose(gyro_s, 0)
    np.testing.assert_allclose(accel_s, [0, 0.04, 0])
    hidden = np.diagonal(gap_cov(nodes_s, gyro_s, accel_s)[1])
    # the rotation does not suffer; the velocity may be off by 10 m/s2 for that long
    np.testing.assert_allclose(hidden, np.repeat([0, 0.4, 0.4 * 0.4], 3) ** 2)
