"""Trajectories in text files."""

from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, InertialError, TimingError
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.io.trajectories import read_inertial_scale, read_inertial_scale_poses, read_tum, write_tum
from tests.helpers.cases import loop_over

EPOCH_NS = 1403715273262142976


def random_trajectory(n: int = 20) -> CameraTrajectory:
    rng = np.random.default_rng(1)
    xyzw = rng.normal(size=(n, 4))
    return CameraTrajectory(
        names=tuple(map(str, range(n))),
        t_s=np.cumsum(rng.integers(1_000_000, 100_000_000, n)) / 1e9,
        cam_from_world_xyzw=xyzw / np.linalg.norm(xyzw, axis=1, keepdims=True),
        cam_in_world=rng.normal(size=(n, 3)) * 100,
        epoch_ns=EPOCH_NS,
    )


def test_poses_of_an_inertial_scale_folder_have_w_first_and_turn_the_world_into_the_camera(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("1000000000 1 2 3 0.8 0 0 0.6\n1500000000 1 2 4 1 0 0 0\n")
    trajectory = read_inertial_scale_poses(tmp_path)
    np.testing.assert_allclose(trajectory.cam_from_world_xyzw, [[0, 0, 0.6, 0.8], [0, 0, 0, 1]])
    np.testing.assert_allclose(trajectory.cam_in_world, [[1, 2, 3], [1, 2, 4]])
    assert trajectory.t_s.tolist() == [0.0, 0.5] and trajectory.epoch_ns == 1_000_000_000


def test_tum_round_trip_keeps_nanoseconds_centres_and_rotations(tmp_path: Path) -> None:
    from scipy.spatial.transform import Rotation

    trajectory = random_trajectory()
    write_tum(tmp_path / "a.tum", trajectory)
    back = read_tum(tmp_path / "a.tum")
    assert [EPOCH_NS + round(t * 1e9) for t in trajectory.t_s] == [back.epoch_ns + round(t * 1e9) for t in back.t_s]
    np.testing.assert_allclose(back.cam_in_world, trajectory.cam_in_world, rtol=1e-11)
    turn = Rotation.from_quat(back.cam_from_world_xyzw) * Rotation.from_quat(trajectory.cam_from_world_xyzw).inv()
    assert turn.magnitude().max() < 1e-10


def test_tum_rotation_is_world_from_camera(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    (tmp_path / "a.tum").write_text(f"# t x y z qx qy qz qw\n1.5 1 2 3 0 0 {half} {half}\n2.5 1 2 4 0 0 0 1\n")
    trajectory = read_tum(tmp_path / "a.tum")
    # The camera is turned 90 deg about z in the world: world x lies along the camera's -y.
    from scipy.spatial.transform import Rotation

    np.testing.assert_allclose(
        Rotation.from_quat(trajectory.cam_from_world_xyzw[0]).apply([1.0, 0, 0]), [0, -1, 0], atol=1e-9
    )
    np.testing.assert_array_equal(trajectory.cam_in_world[0], [1, 2, 3])
    assert trajectory.epoch_ns == 1_500_000_000


def test_tum_before_the_clocks_zero(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text("-0.75 0 0 0 0 0 0 1\n0.25 0 0 0 0 0 0 1\n")
    trajectory = read_tum(tmp_path / "a.tum")
    assert trajectory.epoch_ns == -750_000_000
    write_tum(tmp_path / "b.tum", trajectory)
    assert (tmp_path / "b.tum").read_text().splitlines()[1].startswith("-0.750000000 ")


@loop_over(
    ("rows", "error", "said"),
    [
        (["0 0 0 0 0 0 0", "1 0 0 0 0 0 0"], FormatError, "expected t x y z"),
        (["0 0 0 0 0 0 0 1"], FormatError, "at least two"),
        (["0 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 2"], FormatError, "line 2"),
        (["0 0 0 0 0 0 0 1", "1 0 0 nan 0 0 0 1"], FormatError, "line 2"),
        (["1 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 1"], TimingError, "line 2"),
        (["0 0 0 0 0 0 0 1", "1 0 0 zero 0 0 0 1"], FormatError, "line 2"),
    ],
)
def test_damage_is_named_with_its_line(tmp_path: Path, rows: list[str], error: type[InertialError], said: str) -> None:
    (tmp_path / "a.tum").write_text("\n".join(rows) + "\n")
    with pytest.raises(error, match=said):
        read_tum(tmp_path / "a.tum")


def test_inertial_scale_poses_turn_with_its_gyroscope(shared_data: Path) -> None:
    """Quaternion order and direction: interval rotations of the poses match the gyroscope's in size (any mounting)."""
    from scipy.spatial.transform import Rotation

    for folder in sorted((shared_data / "inertial_scale").iterdir()):
        trajectory, imu = read_inertial_scale(folder)
        assert len(trajectory) == 1800 and trajectory.length_unit == "model"
        cam = Rotation.from_quat(trajectory.cam_from_world_xyzw)
        # Body rates of the camera: exp(w dt) = world_from_cam(t)^-1 world_from_cam(t + dt)
        rates = (cam[:-1] * cam[1:].inv()).as_rotvec() / np.diff(trajectory.t_s)[:, None]
        kernel = np.ones(9) / 9
        speed = np.convolve(np.linalg.norm(rates, axis=1), kernel, "same")
        gyro = np.linalg.norm(imu.gyro_rad_s, axis=1)
        best = 0.0
        for offset_s in np.arange(-2, 12, 0.02) + imu.gyro_t_s[0]:
            at = np.interp(trajectory.t_s[:-1], imu.gyro_t_s - offset_s, gyro)
            best = max(best, np.corrcoef(np.convolve(at, kernel, "same"), speed)[0, 1])
        assert best > 0.9, folder.name


def test_a_capture_file_corrects_the_units_of_an_inertial_scale_folder(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "inertial_scale/D1"
    rows = np.loadtxt(source / "accelerometer.txt")
    for name in ("gyroscope.txt", "poses.txt"):
        (tmp_path / name).write_bytes((source / name).read_bytes())
    with open(tmp_path / "accelerometer.txt", "w") as file:
        for stamp, *xyz in rows.tolist():
            print(int(stamp), *(repr(value / 9.80665) for value in xyz), file=file)
    with pytest.raises(FormatError, match=r'set unit = "g" under \[imu.accel\] in capture.toml'):
        read_inertial_scale(tmp_path)
    (tmp_path / "capture.toml").write_text('[imu]\npath = "."\n[imu.accel]\nunit = "g"\n')
    np.testing.assert_allclose(read_inertial_scale(tmp_path)[1].accel_m_s2, rows[:, 1:], rtol=1e-12)
