"""Scales of recordings of other sensors, with motion capture as truth: a seeded part of ``studies/scale_real.py``."""

import numpy as np
import pytest

from scripts.common import capture_gains as gains, real_imu
from scripts.studies import scale_real as study


@pytest.fixture(scope="module")
def folder(shared_data):
    return shared_data / "real_imu"


@pytest.fixture(scope="module")
def outcomes(folder):
    """Windows of 10 and 3 s of the six recordings, with errors of 2 mm."""
    found = study.windows(folder, (10.0, 3.0), (0.002,), most=3, first=7000)
    return [study.run((folder, window, None, None)) for window in found]


def test_windows_of_other_sensors_are_not_biased_and_their_intervals_hold(outcomes):
    longer = study.summary([o for o in outcomes if o.window.length_s == 10.0])
    assert longer["windows"] >= 15
    assert abs(longer["signed"]) < 1.5
    assert longer["rms"] < 2.6
    assert longer["inside"] >= 75
    assert study.summary(outcomes)["z_rms"] < 1.35


def test_short_clips_are_never_trusted(outcomes):
    short = [o for o in outcomes if o.window.length_s == 3.0]
    assert len(short) >= 15
    assert {o.verdict for o in short} <= {"weak", "refused"}
    assert all(any("short" in str(reason) for reason in o.reasons) for o in short if o.verdict == "weak")


def test_a_window_keeps_the_motion_and_changes_the_rest(folder):
    """What the estimator gets: another scale, axes and clock; the distances between centres are those of the truth."""
    window = next(w for w in study.windows(folder, (10.0,), (0.0,), most=1, first=3) if w.recording == "room1")
    trajectory, imu, truth = study.recorded(folder, window)
    motion = real_imu.read(folder, "room1")
    keep = (motion.t_s >= window.begin_s) & (motion.t_s < window.end_s)
    steps = np.linalg.norm(np.diff(motion.cam_in_world_m[keep], axis=0), axis=1)
    assert np.allclose(np.linalg.norm(np.diff(trajectory.cam_in_world, axis=0), axis=1) * truth, steps)
    assert abs(truth - 1) > 0.01
    assert abs(imu.gyro_t_s[0] - trajectory.t_s[0]) > 10


def test_an_accelerometer_calibrated_by_other_recordings_gives_a_third_of_the_interval(folder):
    """Gains by the motion capture of two rooms hold in the third: their errors differ by less than they are stated."""
    fitted = {name: gains.fitted_gain(folder, name) for name in ("room1", "room3", "room5")}
    for gain in fitted.values():
        assert np.allclose(np.diag(gain), np.mean([np.diag(g) for g in fitted.values()], axis=0), atol=0.0015)
    window = next(w for w in study.windows(folder, (60.0,), (0.002,), most=1, first=11) if w.recording == "room1")
    plain = study.run((folder, window, None, None))
    calibrated = study.run((folder, window, gains.calibration_by(folder, ("room3", "room5")), None))
    assert calibrated.verdict == "trusted"
    assert abs(calibrated.error) < study.Z95 * calibrated.sigma < 0.0045
    assert calibrated.sigma < 0.45 * plain.sigma


def test_an_imu_behind_the_camera_is_found_there_in_short_noisy_clips(folder):
    """The rig's IMU lies 4.5 cm behind the camera; held at a phone's thickness it pulls the scales down by percents."""
    rotation, position_m = real_imu.HANDHELD
    behind_m = float((-rotation.T @ position_m)[2])
    assert behind_m == pytest.approx(-0.045, abs=0.001)
    depths_m, errors = [], []
    for window in study.windows(folder, (5.0,), (0.005,), most=6, first=7000):
        if real_imu.RECORDINGS[window.recording][0] is not real_imu.HANDHELD:
            continue
        trajectory, imu, truth = study.recorded(folder, window)
        estimate = study.estimate_scale(trajectory, imu)
        depths_m.append(estimate.calibration.imu_in_cam_m[2])
        errors.append(np.log((estimate.metres_per_unit or np.nan) / truth))
    assert len(depths_m) >= 15
    assert np.mean(depths_m) == pytest.approx(behind_m, abs=0.012)
    assert abs(np.nanmedian(errors)) < 0.01
