"""``calibrate-imu``: rests found, gains and biases with intervals that hold, and what they do for a scale."""

import dataclasses
import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial import calibrate_imu, estimate_scale, gravity_at_latitude_m_s2
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import IMU_CAL, IMU_CALIBRATION_PARAMETERS, ImuCalibration, ImuRecording
from colmap_inertial.inertial.static_calibration import _judge_calibration, _residual
from colmap_inertial.inertial.static_calibration._rests import _means, candidate_rests
from colmap_inertial.tools.simulate import RecordingOptions, RestOptions, simulate_recording, simulate_rests
from colmap_inertial.tools.simulate.sensors import IMU_PRESETS
from scripts.studies import calibrate_imu as study

ROOT = Path(__file__).parents[3]
GAINS, BESIDE = np.array([0, 4, 8]), np.array([3, 6, 7])


def calibrated(truth, *, gravity_m_s2=9.81):
    return calibrate_imu(truth.recording, gravity_m_s2=gravity_m_s2, gravity_sigma_m_s2=5e-4)


def blank(**changes) -> ImuCalibration:
    fields = {
        "accel_gain": np.zeros((3, 3)),
        "accel_bias_m_s2": np.zeros(3),
        "gyro_gain": np.zeros((3, 3)),
        "gyro_bias_rad_s": np.zeros(3),
        "cov": np.diag(np.arange(1.0, 25) ** 2 * 1e-8),
        "gravity_m_s2": 9.81,
        "attitudes": 12,
    }
    return ImuCalibration(**{**fields, **changes})


def laid_down(ups, *, rest_s=4.0, turn_s=1.0, seed=0, hz=100.0) -> ImuRecording:
    """A device without errors that lies with these directions up, and shakes on the way from one to the next."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(int(len(ups) * (rest_s + turn_s) * hz)) / hz
    index = (t_s / (rest_s + turn_s)).astype(int)
    moving = t_s - index * (rest_s + turn_s) > rest_s
    accel = 9.81 * np.asarray(ups)[index] + 0.02 * rng.standard_normal((len(t_s), 3))
    gyro = 0.003 * rng.standard_normal((len(t_s), 3))
    accel[moving] += 2 * rng.standard_normal((moving.sum(), 3))
    gyro[moving] += rng.standard_normal((moving.sum(), 3))
    return ImuRecording(gyro_t_s=t_s, gyro_rad_s=gyro, accel_t_s=t_s, accel_m_s2=accel)


# --- what comes out --------------------------------------------------------------------------------------------------


def test_intervals_hold_the_truth():
    """A small part of the study; all of it: scripts/studies/calibrate_imu.py."""
    table = study.study(RestOptions(), 24, 500)
    assert table.pop("runs") == {"refused": 0, "attitudes missed": 0}
    inside = [row["inside"] for row in table.values()]
    assert 92.0 <= np.mean(inside) <= 99.0
    assert min(inside) >= 87.0
    assert all(0.7 < row["z"] < 1.25 for row in table.values())
    assert table["accel gain"]["error"] < 5e-4
    assert table["accel misalignment"]["error"] < np.radians(0.05)
    assert table["gyro gain"]["error"] < 1e-3


def test_a_phone_is_found_out_and_its_readings_become_true():
    truth = simulate_rests(RestOptions(), seed=3)
    found = calibrated(truth)
    assert found.verdict == "good"
    assert found.rests.attitudes == len(found.rests) == 12
    assert found.rms_pct(found.before_m_s2) > 0.5
    assert found.rms_pct(found.after_m_s2) < 0.03
    assert np.degrees(found.turn_residual_rad).max() < 0.3
    calibration = found.calibration
    np.testing.assert_array_equal(calibration.accel_gain[np.triu_indices(3, 1)], 0.0)
    np.testing.assert_allclose(calibration.accel_gain, truth.accel_gain, atol=1e-3)
    np.testing.assert_allclose(calibration.gyro_gain, truth.gyro_gain, atol=2e-3)
    corrected = calibration.corrected(truth.recording)
    assert corrected.calibration is calibration
    assert corrected.repairs[-1] == Fact("imu-corrected", attitudes=12)
    for rest, up in zip(range(12), truth.up_in_imu, strict=True):
        inside = slice(*np.searchsorted(corrected.accel_t_s, [found.rests.begin_s[rest], found.rests.end_s[rest]]))
        np.testing.assert_allclose(corrected.accel_m_s2[inside].mean(axis=0), 9.81 * up, atol=0.01)
    with pytest.raises(ValueError, match="before"):
        calibration.corrected(corrected)
    with pytest.raises(ValueError, match="already"):
        calibrate_imu(corrected)


def test_few_attitudes_leave_misalignments_to_their_prior_and_say_so(subtests):
    for attitudes in (6, 8):
        with subtests.test(attitudes=attitudes):
            truth = simulate_rests(RestOptions(attitudes=attitudes), seed=attitudes)
            found = calibrated(truth)
            assert found.verdict == "weak"
            assert f"{attitudes} attitudes determine the accelerometer's gains and biases, not its misal" in str(
                found.reasons[0]
            )
            calibration = found.calibration
            np.testing.assert_array_equal(calibration.accel_gain.ravel()[BESIDE], 0.0)
            np.testing.assert_allclose(np.sqrt(np.diagonal(calibration.cov))[BESIDE], 2**0.5 * 0.005)
            sigma = np.sqrt(np.diagonal(calibration.cov))[GAINS]
            error = (calibration.accel_gain - truth.accel_gain).ravel()[GAINS]
            assert np.all(np.abs(error) < 3.5 * sigma)
            assert sigma.max() < 2e-3


def test_a_device_that_warms_up_is_named_and_not_good(subtests):
    for seed in (1, 3, 5):
        with subtests.test(seed=seed):
            imu = simulate_rests(RestOptions(), seed=seed).recording
            warm = 1 - np.exp(-(imu.accel_t_s - imu.accel_t_s[0])[:, None] / 40)
            drifting = dataclasses.replace(imu, accel_m_s2=imu.accel_m_s2 + 0.02 * np.array([1.0, -1, 1]) * warm)
            found = calibrate_imu(drifting, gravity_m_s2=9.81, gravity_sigma_m_s2=5e-4)
            assert found.verdict == "weak"
            (drifted,) = (reason for reason in found.reasons if reason.code == "accel-bias-drifted")
            assert 0.015 < drifted.values["drift_m_s2"] < 0.05
            assert not any(
                "warms up:" in str(reason) for reason in calibrated(simulate_rests(RestOptions(), seed=seed)).reasons
            )


def test_what_is_too_little_is_refused_with_what_to_do():
    with pytest.raises(NotObservableError, match=r"rested in 5 attitudes.*six sides.*six of its edges"):
        calibrated(simulate_rests(RestOptions(attitudes=5), seed=1))
    shaken = laid_down(np.eye(3), rest_s=0.5, turn_s=3.0)
    with pytest.raises(NotObservableError, match="no rest was found"):
        calibrate_imu(shaken)
    # twelve attitudes about one axis, which always lies level: its gain shows nowhere
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(12)], axis=1)
    with pytest.raises(NotObservableError, match="too similar to determine the accelerometer's gain along z"):
        calibrate_imu(laid_down(around))
    gyroscope = dataclasses.replace(shaken, accel_t_s=np.zeros(0), accel_m_s2=np.zeros((0, 3)))
    with pytest.raises(NotObservableError, match="no accelerometer"):
        calibrate_imu(gyroscope)


def test_a_gyroscope_that_did_not_turn_about_an_axis_keeps_its_prior_there():
    truth = simulate_rests(RestOptions(), seed=5)
    recording = truth.recording
    # the turns are lost: only the rests were kept
    rests = candidate_rests(recording)[0]
    kept = np.any(
        [
            (recording.gyro_t_s >= begin) & (recording.gyro_t_s <= end)
            for begin, end in zip(rests.begin_s - 0.4, rests.end_s + 0.4, strict=True)
        ],
        axis=0,
    )
    cut = dataclasses.replace(recording, gyro_t_s=recording.gyro_t_s[kept], gyro_rad_s=recording.gyro_rad_s[kept])
    found = calibrate_imu(cut, gravity_m_s2=9.81, gravity_sigma_m_s2=5e-4)
    assert np.isnan(found.turn_residual_rad).all()
    sigma = np.sqrt(np.diagonal(found.calibration.cov))
    assert np.all(sigma[IMU_CAL.GYRO_GAIN] > 0.009)
    np.testing.assert_allclose(found.calibration.gyro_gain, 0.0, atol=1e-12)
    assert found.verdict == "weak"
    assert any("gyroscope's gain about x, y and z" in str(reason) for reason in found.reasons)
    np.testing.assert_allclose(found.calibration.accel_gain, truth.accel_gain, atol=1e-3)


def test_a_gyroscope_with_other_axes_is_left_alone_and_named():
    truth = simulate_rests(RestOptions(), seed=6)
    turned = dataclasses.replace(truth.recording, gyro_rad_s=truth.recording.gyro_rad_s[:, [1, 0, 2]])
    found = calibrate_imu(turned, gravity_m_s2=9.81, gravity_sigma_m_s2=5e-4)
    assert found.verdict == "weak"
    assert any("contradicts the rests" in str(reason) for reason in found.reasons)
    np.testing.assert_allclose(found.calibration.accel_gain, truth.accel_gain, atol=1e-3)
    np.testing.assert_allclose(found.calibration.gyro_gain, 0.0, atol=1e-12)


def test_unknown_gravity_is_counted_in_every_gain_and_said():
    truth = simulate_rests(RestOptions(gravity_m_s2=9.79), seed=4)
    found = calibrate_imu(truth.recording)
    assert found.calibration.gain_sigma > 1.5e-3
    assert "give the latitude" in str(found.reasons[-1])
    known = calibrated(truth, gravity_m_s2=9.79)
    assert known.calibration.gain_sigma < 5e-4
    assert not any("latitude" in str(reason) for reason in known.reasons)


def test_a_calibrated_imu_narrows_the_interval_and_keeps_the_truth_in_it():
    worse = dataclasses.replace(IMU_PRESETS["phone"], accel_scale_sd=0.01, gyro_scale_sd=0.01)
    options = RecordingOptions(imu=worse)
    widths = []
    for seed in (1, 2):
        recorded = simulate_recording(options, seed=seed)
        rests = simulate_rests(RestOptions(imu=worse), seed=seed, errors=recorded.truth.imu.errors)
        calibration = calibrated(rests).calibration
        trajectory, imu, scale = recorded.trajectory, recorded.imu, recorded.truth.metres_per_unit
        plain = estimate_scale(trajectory, imu)
        better = estimate_scale(trajectory, imu, imu_calibration=calibration)
        low, high = better.accepted.ci95
        assert low < scale < high
        assert better.imu_calibration is calibration
        assert plain.imu_calibration is None
        assert plain.as_json()["imu_calibration"] is None
        json.dumps(better.as_json())
        assert better.as_json()["imu_calibration"]["attitudes"] == 12
        np.testing.assert_allclose(better.metres_per_unit, scale, rtol=0.01)
        widths.append(better.accepted.sigma_log / plain.accepted.sigma_log)
        again = estimate_scale(trajectory, calibration.corrected(imu))
        assert again.metres_per_unit == better.metres_per_unit
    assert max(widths) < 0.75


def test_a_recording_warmer_than_its_calibration_is_less_sure_and_says_so():
    recorded = simulate_recording(RecordingOptions(imu=IMU_PRESETS["phone"]), seed=1)
    rests = simulate_rests(RestOptions(imu=IMU_PRESETS["phone"]), seed=1, errors=recorded.truth.imu.errors)
    cool = dataclasses.replace(rests.recording, temperature_c=21.0)
    calibration = calibrate_imu(cool, gravity_m_s2=9.81, gravity_sigma_m_s2=5e-4).calibration
    assert calibration.temperature_c == 21.0

    def estimated(temperature_c, *, gain=1.0):
        imu = dataclasses.replace(recorded.imu, temperature_c=temperature_c, accel_m_s2=gain * recorded.imu.accel_m_s2)
        return estimate_scale(recorded.trajectory, imu, imu_calibration=calibration)

    unknown, alike, warm = estimated(None), estimated(24.0), estimated(51.0)
    assert not any("calibrated at" in str(note) for note in (*unknown.notes, *alike.notes))
    assert any("calibrated at 21 °C and recorded at 51 °C" in str(note) for note in warm.notes)
    assert unknown.sigma_log <= alike.sigma_log < 1.1 * unknown.sigma_log
    assert warm.sigma_log > 1.4 * alike.sigma_log
    assert warm.as_json()["imu_calibration"]["temperature_c"] == 21.0
    # what 30 kelvin may do to a gain: the interval counts it
    low, high = estimated(51.0, gain=1.006).ci95
    assert low < recorded.truth.metres_per_unit < high


# --- the values ------------------------------------------------------------------------------------------------------


def test_a_calibration_is_checked_when_it_is_made():
    for name, value in (
        ("accel_gain", np.zeros((3, 2))),
        ("gyro_gain", np.eye(3)),
        ("cov", np.eye(23)),
        ("gravity_m_s2", -9.8),
        ("gravity_m_s2", np.nan),
        ("temperature_c", np.inf),
        ("attitudes", -1),
    ):
        with pytest.raises(ValueError, match=name):
            blank(**{name: value})


def test_standard_deviations_are_found_by_name_and_along_directions():
    assert len(IMU_CALIBRATION_PARAMETERS) == IMU_CAL.COUNT == len(set(IMU_CALIBRATION_PARAMETERS))
    assert IMU_CALIBRATION_PARAMETERS[IMU_CAL.GYRO_BIAS] == tuple(f"gyro_bias_{axis}_rad_s" for axis in "xyz")
    assert blank().sigma("accel_gain_yx") == pytest.approx(4e-4)
    cov = np.zeros((24, 24))
    cov[3, 3] = 4e-6  # of yx alone: along (1, 1, 0) it counts half
    assert blank(cov=cov).gain_sigma == pytest.approx(1e-3, rel=0.01)
    common = np.zeros(24)
    common[GAINS] = 2e-3
    assert blank(cov=np.outer(common, common)).gain_sigma == pytest.approx(2e-3)


def test_gravity_by_latitude_and_height():
    # WGS 84: equator and poles; 0.3086 mGal a metre less upwards, a little less so higher up
    assert gravity_at_latitude_m_s2(0) == pytest.approx(9.7803253359, abs=1e-10)
    assert gravity_at_latitude_m_s2(-90) == pytest.approx(9.8321849379, abs=1e-9)
    assert gravity_at_latitude_m_s2(45, 1000) - gravity_at_latitude_m_s2(45) == pytest.approx(-3.0848e-3, abs=2e-7)
    fall = [gravity_at_latitude_m_s2(45, h) - gravity_at_latitude_m_s2(45, h + 1) for h in (0, 8000)]
    assert fall[0] == pytest.approx(3.0855e-6, rel=1e-3)
    assert fall[1] < fall[0]
    for wrong in ((91, 0), (0, 20_000)):
        with pytest.raises(ValueError, match="must be from"):
            gravity_at_latitude_m_s2(*wrong)


# --- real rests ------------------------------------------------------------------------------------------------------


def test_the_rests_of_an_xsens_are_found_and_gravity_is_as_long_in_all(shared_data):
    recording = study.read_xsens(shared_data / "imu_rest" / "xsens.csv.xz")
    found = calibrate_imu(recording, gravity_m_s2=9.81744, gravity_sigma_m_s2=5e-4)
    assert len(found.rests) == 38
    assert found.verdict == "good"
    assert found.rms_pct(found.before_m_s2) > 8.0
    assert found.rms_pct(found.after_m_s2) < 0.02
    assert found.calibration.device == "Xsens MTi"
    # its nominal factor of rates is 31 % off; the authors' own calibration has 4778 counts per rad/s
    np.testing.assert_allclose(np.diagonal(found.calibration.gyro_gain), 6258 / 4778 - 1, atol=0.006)


def lying(rng, *, seconds=20.0, accel_m_s2=0.02, gyro_rad_s=1e-3) -> ImuRecording:
    """Readings of a device that lies still, with noise of so much on all axes together."""
    t_s = np.arange(0, seconds, 0.01)
    accel, gyro = (size / 3**0.5 * rng.standard_normal((len(t_s), 3)) for size in (accel_m_s2, gyro_rad_s))
    return ImuRecording(gyro_t_s=t_s, gyro_rad_s=gyro, accel_t_s=t_s, accel_m_s2=accel + np.array([0, 0, 9.81]))


def test_what_shakes_as_a_hand_does_lies_nowhere(subtests):
    for sensor, most in (("accel_m_s2", 0.5), ("gyro_rad_s", 0.03)):
        with subtests.test(sensor=sensor, most=most):
            rng = np.random.default_rng(5)
            assert candidate_rests(lying(rng, **{sensor: 0.8 * most}))
            assert not candidate_rests(lying(rng, **{sensor: 1.3 * most}))


@pytest.mark.parametrize("step_s", [0.02, 0.8], ids=["quick", "slower than blocks"])
def test_means_of_rests_scatter_as_they_say(step_s):
    rng, rests, seconds = np.random.default_rng(6), 80, 9.6
    t_s = np.arange(0, rests * seconds, step_s) + 1e-3
    truth = rng.standard_normal((rests, 3))
    values = truth[(t_s / seconds).astype(int)] + 0.3 * rng.standard_normal((len(t_s), 3))
    begin_s = seconds * np.arange(rests)
    means, sigma, deviation = _means(t_s, values, np.stack([begin_s, begin_s + seconds], axis=1))
    expected = 0.3 / (seconds / step_s) ** 0.5
    assert sigma == pytest.approx(expected, rel=0.1)
    assert np.std(means - truth) == pytest.approx(expected, rel=0.15)
    # of a few readings, the mean takes a part of the scatter along
    assert deviation == pytest.approx(0.3 * (1 - step_s / seconds) ** 0.5, rel=0.05)


def test_what_nine_parameters_leave_is_the_size_of_the_noise():
    rng, found = np.random.default_rng(8), []
    for _ in range(300):
        by, noise = rng.standard_normal((14, 9)), 0.02 * rng.standard_normal(14)
        left = noise - by @ np.linalg.lstsq(by, noise, rcond=None)[0]
        found.append(_residual(SimpleNamespace(accel_residual_m_s2=left), range(14)))
    assert np.mean(found) == pytest.approx(0.02**2, rel=0.1)


def test_a_rest_does_not_go_on_where_one_sensor_pauses():
    truth = simulate_rests(RestOptions(), seed=3)
    imu = truth.recording
    rests = candidate_rests(imu)[0]
    longest = int(np.argmax(rests.end_s - rests.begin_s))
    middle_s = 0.5 * (rests.begin_s[longest] + rests.end_s[longest])
    kept = {name: np.abs(getattr(imu, f"{name}_t_s") - middle_s) > 0.4 for name in ("gyro", "accel")}
    for name, values in (("gyro", "gyro_rad_s"), ("accel", "accel_m_s2")):
        paused = dataclasses.replace(
            imu,
            **{f"{name}_t_s": getattr(imu, f"{name}_t_s")[kept[name]], values: getattr(imu, values)[kept[name]]},
        )
        for found in candidate_rests(paused):
            assert not np.any((found.begin_s < middle_s) & (found.end_s > middle_s)), name


@pytest.mark.parametrize(
    ("entry", "sigma", "said"),
    [
        pytest.param((0, 0), 0.003, "gain along x is only known to .*0.59 %", id="x"),
        pytest.param((2, 2), 0.003, "gain along z is only known to .*0.59 %", id="z"),
        pytest.param((2, 1), 0.003, "leave a misalignment of the accelerometer unknown", id="misalignment"),
    ],
)
def test_the_worst_of_three_axes_makes_a_calibration_weak(entry, sigma, said):
    sigmas = np.full(len(IMU_CALIBRATION_PARAMETERS), 1e-4)
    sound = SimpleNamespace(accel_noise=1.0, turn_noise=1.0, drift_p_value=0.5)
    rests = SimpleNamespace(attitudes=24)

    def judged():
        calibration = SimpleNamespace(cov=np.diag(sigmas**2), gravity_m_s2=9.8)
        return _judge_calibration(calibration, sound, rests, 1e-4, apart=False)

    assert judged() == ("good", ())
    sigmas[np.arange(len(sigmas))[IMU_CAL.ACCEL_GAIN].reshape(3, 3)[entry]] = sigma
    verdict, (why,) = judged()
    assert verdict == "weak" and re.search(said, str(why))
