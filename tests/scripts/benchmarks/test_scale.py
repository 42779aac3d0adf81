"""The benchmark of scale errors: its baseline is right where nothing disturbs it, its windows are what they say."""

import json

import numpy as np
import pytest

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.inertial.scale import first_seconds
from colmap_inertial.motion.align import align_camera_imu
from colmap_inertial.tools.simulate import ImuOptions, MotionOptions, RecordingOptions, SfmOptions, simulate_recording
from scripts.benchmarks.scale import first_windows, main, part_windows, path_length_m, read, recordings_in
from scripts.common.linear_scale import estimate_linear
from scripts.common.scale_sensitivity import Setting, applied, changed_calibration, constants

STILL = {
    "position_white_m": 0.0,
    "position_correlated_m": 0.0,
    "rotation_white_rad": 0.0,
    "rotation_correlated_rad": 0.0,
}
IDEAL = {
    name: 0.0
    for name in (
        *("gyro_density_rad_s_rthz", "accel_density_m_s2_rthz", "gyro_walk_rad_s2_rthz", "accel_walk_m_s3_rthz"),
        *("gyro_scale_sd", "gyro_misalignment_sd", "accel_scale_sd", "accel_misalignment_sd", "clock_rate_sd"),
    )
}


def simulated(seed, *, duration_s=30.0, kind="orbit", **sfm):
    imu = ImuOptions(**IDEAL, lever_arm_m_sd=(0.0, 0.0, 0.0))
    motion = MotionOptions(duration_s=duration_s, kind=kind)
    return simulate_recording(RecordingOptions(motion=motion, imu=imu, sfm=SfmOptions(**{**STILL, **sfm})), seed=seed)


def test_the_baseline_recovers_everything_from_perfect_recordings(subtests):
    for seed in (1, 2, 3):
        with subtests.test(seed=seed):
            s = simulated(seed)
            found = estimate_linear(s.trajectory, s.imu, s.truth.calibration)
            assert found.metres_per_unit == pytest.approx(s.truth.metres_per_unit, rel=0.003)
            assert np.allclose(found.gravity_in_world_m_s2, s.truth.gravity_in_world_m_s2, atol=0.05)
            size = np.linalg.norm(found.accel_bias_in_cam_m_s2)
            assert size == pytest.approx(np.linalg.norm(s.truth.accel_bias_m_s2), abs=0.03)
            aligned = align_camera_imu(s.trajectory, s.imu)
            again = estimate_linear(s.trajectory, s.imu, aligned)
            assert again.metres_per_unit == pytest.approx(s.truth.metres_per_unit, rel=0.005)


def test_noise_of_the_positions_shrinks_the_baseline_s_scale():
    ratios = []
    for seed in range(4):
        s = simulated(seed, position_correlated_m=0.02)
        found = estimate_linear(s.trajectory, s.imu, s.truth.calibration)
        ratios.append(found.metres_per_unit / s.truth.metres_per_unit)
    assert np.mean(ratios) < 0.97


def test_the_baseline_refuses_what_is_too_short():
    s = simulated(1)
    with pytest.raises(NotObservableError, match="3 s"):
        estimate_linear(first_seconds(s.trajectory, 2.5), s.imu, s.truth.calibration)


def test_the_length_of_a_path_is_that_of_the_motion_and_not_of_its_noise():
    clean, noisy = (
        simulated(4, kind="constant_velocity"),
        simulated(4, kind="constant_velocity", position_white_m=0.005),
    )
    for s in (clean, noisy):
        t_s, length_m = path_length_m(s.trajectory, s.truth.metres_per_unit)
        assert np.all(np.diff(length_m) > 0)
        assert length_m[-1] == pytest.approx(0.8 * (t_s[-1] - t_s[0]), rel=0.02)


def test_windows_cover_the_recordings_as_they_say(shared_data):
    folders = recordings_in(shared_data / "inertial_scale")
    assert [folder.name for folder in folders] == ["D1", "D3", "D5", "D7", "D9", "D11", "D13", "D15"]
    assert sum(len(part_windows(folder, (2, 3, 6, 12))) for folder in folders) == 184
    for window in part_windows(folders[1], (3,)):
        assert np.ptp(window.read()[0].t_s) == pytest.approx(20, abs=0.1)
    by_group = {window.group: window for window in first_windows(folders[0], (10.0,), (1.0, 4.0, 1e6))}
    assert list(by_group) == ["first 10 s", "first 1 m", "first 4 m"]
    assert np.ptp(by_group["first 10 s"].read()[0].t_s) == pytest.approx(10, abs=0.05)
    assert by_group["first 1 m"].end_s < by_group["first 4 m"].end_s < read(folders[0])[0].t_s[-1]


def test_the_table_holds_all_methods_beside_the_published_figures(shared_data, tmp_path, capsys):
    folder = tmp_path / "some"
    folder.mkdir()
    for name in ("D1", "D7"):
        (folder / name).symlink_to(shared_data / "inertial_scale" / name)
    where = ["--figure", str(tmp_path / "f.png"), "--json", str(tmp_path / "f.json")]
    main([str(folder), "--seconds", "60", "10", "--metres", "2", "--parts", "2", "--processes", "1", *where])
    out = capsys.readouterr().out
    rows = [line.split() for line in out.splitlines()]
    assert ["first", "60", "s", "published", "1.23", "0.85", "3.52"] in rows
    assert ["first", "60", "s", "of", "these", "-1.99", "0.63", "1.31", "1.31", "1.99"] in rows
    result = json.loads((tmp_path / "f.json").read_text())
    assert set(result) == {"machine", "cores", "versions", "commit", "modified", "outcomes"}
    assert len(result["outcomes"]) == 3 * (2 * 3 + 2 * 2)
    whole = {o["method"]: o for o in result["outcomes"] if o["group"] == "first 60 s" and o["recording"] == "D1"}
    assert abs(whole["joint"]["error"]) < 1.5 and whole["joint"]["inside"]
    assert -10 < whole["linear"]["error"] < 0 and whole["linear"]["half_width"] is None
    assert (tmp_path / "f.png").read_bytes()[:4] == b"\x89PNG"


def test_every_constant_whose_sensitivity_is_studied_acts_on_the_estimate():
    from colmap_inertial.inertial.scale.joint import estimate_joint

    sfm = SfmOptions(rotation_correlated_rad=0.004, correlation_s=1.5)
    s = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=8.0), sfm=sfm), seed=5)
    aligned = align_camera_imu(s.trajectory, s.imu)

    def estimate(setting):
        with applied(setting) as options:
            timed = CameraTimedImu.from_recording(s.imu, changed_calibration(aligned, setting), s.trajectory.epoch_ns)
            found = estimate_joint(s.trajectory, timed, options)
        return found.metres_per_unit, found.sigma_log

    default = estimate(Setting())
    idle = [name for name in constants() if estimate(Setting(constant=name, factor=0.5)) == default]
    assert not idle
    assert estimate(Setting()) == default
