"""Poses written by another convention are named as such, and right ones never are."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial import PoseConvention, likely_convention
from colmap_inertial.cli import main
from colmap_inertial.core.geometry import quat_conjugate, quat_rotate, so3_exp
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.io.pose_convention import COLMAP, TUM, reread
from colmap_inertial.io.trajectories import read_inertial_scale, read_tum, write_tum
from colmap_inertial.tools.simulate.motion import MotionKind, MotionOptions
from colmap_inertial.tools.simulate.recording import RecordingOptions, SimulatedRecording, simulate_recording

RECORDINGS = ("D1", "D3", "D5", "D7", "D9", "D11", "D13", "D15")
EVERY = (TUM, *TUM.others())
INVERTED, W_FIRST = (PoseConvention(), PoseConvention(rotation="world_from_camera", order="wxyz"))


def simulated(seed: int = 0, kind: MotionKind = "orbit", duration_s: float = 25.0) -> SimulatedRecording:
    return simulate_recording(RecordingOptions(motion=MotionOptions(kind=kind, duration_s=duration_s)), seed=seed)


def without_accelerometer(imu: ImuRecording) -> ImuRecording:
    return replace(imu, accel_t_s=np.empty(0), accel_m_s2=np.empty((0, 3)))


def test_rereading_is_what_a_table_says_by_another_convention() -> None:
    poses = simulated(duration_s=5.0).trajectory
    q, centre = poses.cam_from_world_xyzw, poses.cam_in_world
    # the columns of a COLMAP table, read as a TUM trajectory
    columns = np.concatenate([-quat_rotate(q, centre), q[:, [3, 0, 1, 2]]], axis=1)
    as_tum = replace(poses, cam_in_world=columns[:, :3], cam_from_world_xyzw=quat_conjugate(columns[:, 3:]))
    back = reread(as_tum, TUM, COLMAP)
    np.testing.assert_allclose(back.cam_in_world, centre, atol=1e-12)
    np.testing.assert_allclose(back.cam_from_world_xyzw, q, atol=1e-12)
    for read_as in EVERY:
        for written_as in EVERY:
            again = reread(reread(poses, written_as, read_as), read_as, written_as)
            np.testing.assert_allclose(again.cam_in_world, centre, atol=1e-12)
            np.testing.assert_allclose(again.cam_from_world_xyzw, q, atol=1e-12)
    assert len(set(EVERY)) == 8


@pytest.mark.parametrize("read_as", [TUM, COLMAP], ids=["tum", "colmap"])
def test_simulated_poses_in_another_convention_are_named(read_as: PoseConvention) -> None:
    recording = simulated(seed=3)
    assert likely_convention(recording.trajectory, recording.imu, read_as=read_as) is None
    for written_as in read_as.others():
        wrong = reread(recording.trajectory, written_as, read_as)
        likely = likely_convention(wrong, recording.imu, read_as=read_as)
        assert likely is not None and likely.written_as == (written_as,)
        assert likely.log_likelihood > 12


@pytest.mark.parametrize("name", ["D1", "D11"])
def test_real_poses_in_another_convention_are_named(shared_data: Path, name: str) -> None:
    trajectory, imu = read_inertial_scale(shared_data / "inertial_scale" / name)
    named = {}
    for written_as in TUM.others():
        likely = likely_convention(reread(trajectory, written_as, TUM), imu, read_as=TUM)
        named[written_as] = None if likely is None else likely.written_as
    assert named == {one: (one,) for one in TUM.others()}


def test_right_poses_of_real_recordings_are_not_named(shared_data: Path) -> None:
    for name in RECORDINGS:
        trajectory, imu = read_inertial_scale(shared_data / "inertial_scale" / name)
        assert likely_convention(trajectory, imu) is None, name
        assert likely_convention(trajectory, without_accelerometer(imu)) is None, name


TURN = so3_exp(np.array([np.pi / 2, 0, 0]))
FAULTS: list[tuple[str, Callable[[ImuRecording], ImuRecording]]] = [
    ("accelerometer flipped", lambda imu: replace(imu, accel_m_s2=-imu.accel_m_s2)),
    ("accelerometer turned", lambda imu: replace(imu, accel_m_s2=imu.accel_m_s2 @ TURN.T)),
    ("gyroscope turned", lambda imu: replace(imu, gyro_rad_s=imu.gyro_rad_s @ TURN.T)),
    ("gyroscope inverted", lambda imu: replace(imu, gyro_rad_s=-imu.gyro_rad_s)),
    ("gyroscope mirrored", lambda imu: replace(imu, gyro_rad_s=imu.gyro_rad_s * [-1, 1, 1])),
    (
        "columns exchanged",
        lambda imu: replace(imu, gyro_rad_s=imu.gyro_rad_s[:, [1, 0, 2]], accel_m_s2=imu.accel_m_s2[:, [1, 0, 2]]),
    ),
]


@pytest.mark.parametrize("alter", [pytest.param(alter, id=name) for name, alter in FAULTS])
def test_what_is_wrong_with_the_imu_is_not_blamed_on_the_poses(
    shared_data: Path, alter: Callable[[ImuRecording], ImuRecording]
) -> None:
    for name in ("D7", "D9"):
        trajectory, imu = read_inertial_scale(shared_data / "inertial_scale" / name)
        assert likely_convention(trajectory, alter(imu)) is None, name


def test_right_poses_are_not_named_whatever_the_motion(subtests: pytest.Subtests) -> None:
    for kind in ("static", "pure_rotation", "constant_velocity", "walk", "roam"):
        with subtests.test(kind=kind):
            for seed in range(2):
                recording = simulated(seed, kind)
                # the origin far away, where translations of camera_from_world move most
                far = replace(
                    recording.trajectory, cam_in_world=recording.trajectory.cam_in_world + np.array([20.0, -10.0, 5.0])
                )
                for trajectory in (recording.trajectory, far):
                    assert likely_convention(trajectory, recording.imu) is None


def test_an_imu_that_turns_about_the_camera_is_no_sign_of_translations() -> None:
    recording = simulated(1, "pure_rotation")
    imu = recording.imu
    rate, t_s = imu.gyro_rad_s, imu.gyro_t_s
    arm_m = np.array([0.1, 0.05, 0.0])
    swept = np.cross(rate, np.cross(rate, arm_m)) + np.cross(np.gradient(rate, t_s, axis=0), arm_m)
    more = np.stack([np.interp(imu.accel_t_s, t_s, column) for column in swept.T], axis=1)
    poses = replace(recording.trajectory, cam_in_world=recording.trajectory.cam_in_world + np.array([3.0, -5.0, 2.0]))
    assert likely_convention(poses, replace(imu, accel_m_s2=imu.accel_m_s2 + more)) is None


def test_a_gyroscope_alone_names_both_that_it_cannot_tell_apart() -> None:
    recording = simulated(2)
    wrong = reread(recording.trajectory, INVERTED, TUM)
    likely = likely_convention(wrong, without_accelerometer(recording.imu), read_as=TUM)
    assert likely is not None and set(likely.written_as) == {INVERTED, W_FIRST}
    assert "the quaternions are inverted (camera_from_world, not world_from_camera), or " in likely.sentence
    assert "in the order w x y z, not x y z w" in likely.sentence
    assert likely.sentence.endswith(
        ": write each pose as world_from_camera quaternion in the order x y z w, camera centre"
    )
    assert likely_convention(recording.trajectory, without_accelerometer(recording.imu)) is None


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trajectory with inverted quaternions, the right one, and the IMU recorded with it."""
    folder = tmp_path_factory.mktemp("conventions")
    recording = simulated(4)
    imu = recording.imu
    (folder / "imu").mkdir()
    for name, t_s, values in (
        ("gyroscope", imu.gyro_t_s, imu.gyro_rad_s),
        ("accelerometer", imu.accel_t_s, imu.accel_m_s2),
    ):
        t_ns = imu.epoch_ns + np.rint(t_s * 1e9).astype(np.int64)
        rows = [f"{t} {x:.9g} {y:.9g} {z:.9g}" for t, (x, y, z) in zip(t_ns, values, strict=True)]
        (folder / "imu" / f"{name}.txt").write_text("\n".join(rows) + "\n")
    write_tum(folder / "right.tum", recording.trajectory)
    write_tum(folder / "inverted.tum", reread(recording.trajectory, INVERTED, TUM))
    both = PoseConvention(rotation="camera_from_world", order="wxyz")
    write_tum(folder / "both.tum", reread(recording.trajectory, both, TUM))
    return folder


def exit_code(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(one) for one in arguments])
    return int(end.value.code or 0)


def test_commands_name_it(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = "if the quaternions are inverted (camera_from_world, not world_from_camera)"
    imu, wrong = ["--imu", files / "imu"], files / "inverted.tum"
    assert exit_code("scale", wrong, *imu, "--json", files / "scale.json") == 3
    reasons = json.loads((files / "scale.json").read_text())["reasons"]
    assert said in reasons[0] and "write each pose as" in reasons[0]
    capsys.readouterr()
    assert exit_code("align", wrong, *imu, "--out", files / "calibration.json") == 3
    assert said in " ".join(capsys.readouterr().err.split())
    assert not (files / "calibration.json").exists()
    # inverted and in the other order, rotations turn the right way again; the accelerometer tells
    assert exit_code("align", files / "both.tum", *imu, "--out", files / "calibration.json") == 3
    assert "inverted" in (err := " ".join(capsys.readouterr().err.split())) and "order w x y z" in err
    assert not (files / "calibration.json").exists()
    assert exit_code("align", files / "right.tum", *imu, "--out", files / "right.json") == 0
    assert exit_code("diagnose", wrong, *imu, "--json", files / "findings.json") == 1
    findings = json.loads((files / "findings.json").read_text())["findings"]
    assert [one["code"] for one in findings if one["severity"] == "error"] == ["pose-convention"]
    assert exit_code("diagnose", files / "right.tum", *imu) == 0
    # what was read stays as it was written
    np.testing.assert_allclose(
        reread(read_tum(files / "inverted.tum"), TUM, INVERTED).cam_from_world_xyzw,
        read_tum(files / "right.tum").cam_from_world_xyzw,
        atol=1e-9,
    )
