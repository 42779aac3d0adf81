"""Depth maps and exports of devices, written here byte by byte from one walk through a room."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, MissingExtraError
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate
from colmap_inertial.io.depth_maps import read_depth_map, unpack_lzfse
from colmap_inertial.io.device_folders import is_device_folder, read_device_folder
from tests.helpers.depth_scenes import VIEW, record

MAPS, PATH = record(count=6, seed=2, pose_m=0.0, pose_rad=0.0)
#: Intrinsics as apps write them: of the picture, ten times as large, its top-left pixel's centre at (0, 0).
LARGE = VIEW.resized(960, 720)
MATRIX = np.array([[700.0, 0, LARGE.centre_px[0] - 0.5], [0, 700.0, LARGE.centre_px[1] - 0.5], [0, 0, 1]])
#: Camera to world with y up and z back, as ARKit and OpenGL have cameras.
WORLD_FROM_CAM = np.zeros((6, 4, 4))
WORLD_FROM_CAM[:, :3, :3] = matrix_from_quat(quat_conjugate(PATH.cam_from_world_xyzw)) @ np.diag([1.0, -1.0, -1.0])
WORLD_FROM_CAM[:, :3, 3], WORLD_FROM_CAM[:, 3, 3] = PATH.cam_in_world, 1.0
T_NS = (1_000_000_000 * (5 + np.arange(6))).tolist()


def millimetres(name: str) -> np.ndarray:
    return np.nan_to_num(1000 * MAPS.read(name).depth_m).round().astype(np.uint16)


def confidence(name: str, levels: tuple[int, int]) -> np.ndarray:
    """The upper half is sure."""
    out = np.full((72, 96), levels[0], np.uint8)
    out[:36] = levels[1]
    return out


def write_stray(folder: Path) -> None:
    from colmap_inertial.core.geometry import quat_from_matrix

    (folder / "depth").mkdir(parents=True)
    (folder / "confidence").mkdir()
    # the app turns the camera by half a turn about x: COLMAP's axes
    rows = []
    for k, name in enumerate(MAPS.names):
        cv2.imwrite(str(folder / "depth" / f"{name}.png"), millimetres(name))
        cv2.imwrite(str(folder / "confidence" / f"{name}.png"), confidence(name, (1, 2)))
        xyzw = quat_from_matrix(WORLD_FROM_CAM[k, :3, :3] @ np.diag([1.0, -1.0, -1.0]))
        values = [T_NS[k] * 1e-9, name, *PATH.cam_in_world[k].tolist(), *xyzw.tolist()]
        rows.append(", ".join(map(str, values)))
    (folder / "odometry.csv").write_text("\n".join(["timestamp, frame, x, y, z, qx, qy, qz, qw", *rows]) + "\n")
    large = MATRIX * np.array([[2.0], [2.0], [1.0]])  # of 1920 x 1440
    large[:2, 2] += 0.5
    np.savetxt(folder / "camera_matrix.csv", large, delimiter=", ")
    (folder / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n5, 0, 0, -1, 0, 0, 0\n")


def stored(data: bytes) -> bytes:
    """An LZFSE block that is not compressed."""
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


def write_record3d(folder: Path) -> None:
    from colmap_inertial.core.geometry import quat_from_matrix

    (folder / "rgbd").mkdir(parents=True)
    for k, name in enumerate(MAPS.names):
        depth = np.nan_to_num(MAPS.read(name).depth_m).astype("<f4")
        (folder / "rgbd" / f"{k}.depth").write_bytes(stored(depth.tobytes()))
        (folder / "rgbd" / f"{k}.conf").write_bytes(stored(confidence(name, (1, 2)).tobytes()))
    poses = [[*quat_from_matrix(m[:3, :3]).tolist(), *m[:3, 3].tolist()] for m in WORLD_FROM_CAM]
    known = {"w": 960, "h": 720, "K": MATRIX.T.ravel().tolist(), "poses": poses, "fps": 1}
    (folder / "metadata").write_text(json.dumps(known))


def write_polycam(folder: Path) -> None:
    for part in ("cameras", "depth", "confidence"):
        (folder / "keyframes" / part).mkdir(parents=True)
    for k, name in enumerate(MAPS.names):
        stem = str(T_NS[k] // 1000)
        rows = {f"t_{i}{j}": WORLD_FROM_CAM[k, i, j] for i in range(3) for j in range(4)}
        camera = {"fx": 700.0, "fy": 700.0, "cx": MATRIX[0, 2], "cy": MATRIX[1, 2], "width": 960, "height": 720}
        (folder / "keyframes/cameras" / f"{stem}.json").write_text(json.dumps({**rows, **camera}))
        cv2.imwrite(str(folder / "keyframes/depth" / f"{stem}.png"), millimetres(name))
        cv2.imwrite(str(folder / "keyframes/confidence" / f"{stem}.png"), confidence(name, (127, 255)))


def write_nerfstudio(folder: Path) -> None:
    (folder / "depth").mkdir(parents=True)
    frames = []
    for k, name in enumerate(MAPS.names):
        np.save(folder / "depth" / f"{name}.npy", np.where(confidence(name, (0, 1)) > 0, MAPS.read(name).depth_m, 0.0))
        frames.append(
            {
                "file_path": f"images/{name}.png",
                "depth_file_path": f"depth/{name}.npy",
                "transform_matrix": WORLD_FROM_CAM[k].tolist(),
            }
        )
    centre = {"cx": MATRIX[0, 2] + 0.5, "cy": MATRIX[1, 2] + 0.5}  # nerfstudio counts from the corner
    known = {"fl_x": 700.0, "fl_y": 700.0, **centre, "w": 960, "h": 720, "frames": frames[::-1]}
    (folder / "transforms.json").write_text(json.dumps(known))


WRITERS = {
    "Stray Scanner": write_stray,
    "Record3D": write_record3d,
    "Polycam": write_polycam,
    "nerfstudio": write_nerfstudio,
}


@pytest.mark.parametrize("app", WRITERS)
def test_an_export_gives_the_path_and_the_depth_that_were_written(app: str, tmp_path: Path) -> None:
    WRITERS[app](tmp_path / "export")
    assert is_device_folder(tmp_path / "export")
    found = read_device_folder(tmp_path / "export")
    assert found.app == app and found.is_metric == (app != "nerfstudio")
    np.testing.assert_allclose(found.trajectory.cam_in_world, PATH.cam_in_world, atol=1e-9)
    turned = np.abs(np.sum(found.trajectory.cam_from_world_xyzw * PATH.cam_from_world_xyzw, axis=1))
    np.testing.assert_allclose(turned, 1.0, atol=1e-9)
    np.testing.assert_allclose(np.diff(found.trajectory.t_s), 1.0)
    assert found.depth is not None and set(found.depth.names) == set(found.trajectory.names)
    for name, original in zip(found.trajectory.names, MAPS.names, strict=True):
        depth, true = found.depth.read(name), MAPS.read(original)
        assert np.isnan(depth.depth_m[36:]).all()
        np.testing.assert_allclose(depth.depth_m[:36], true.depth_m[:36], atol=6e-4)
        np.testing.assert_allclose(depth.view.rays(), VIEW.rays(), atol=1e-9)


def test_a_folder_of_anything_else_is_none(tmp_path: Path) -> None:
    assert not is_device_folder(tmp_path)
    with pytest.raises(FormatError) as error:
        read_device_folder(tmp_path)
    assert error.value.code == "no-device-folder"


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    for image, code in (
        (np.zeros((72, 96, 3), np.uint8), "depth-not-one-channel"),
        (np.zeros((96, 72), np.uint16), "depth-of-other-shape"),
    ):
        cv2.imwrite(str(path), image)
        with pytest.raises(FormatError) as error:
            read_depth_map(path, VIEW)
        assert error.value.code == code
    cv2.imwrite(str(path), np.zeros((72, 96), np.uint16))
    cv2.imwrite(str(tmp_path / "c.png"), np.zeros((36, 48), np.uint8))
    with pytest.raises(FormatError) as error:
        read_depth_map(path, VIEW, confidence=tmp_path / "c.png")
    assert error.value.code == "confidence-of-other-size"
    np.save(tmp_path / "b.npy", np.array(["x"] * 6))
    with pytest.raises(FormatError) as error:
        read_depth_map(tmp_path / "b.npy", VIEW)
    assert error.value.code == "depth-no-numbers"


def test_lzfse_that_is_compressed_needs_a_package(monkeypatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "liblzfse", None)
    with pytest.raises(MissingExtraError, match="record3d"):
        unpack_lzfse(Path("0.depth"), b"bvx2" + bytes(20))
    with pytest.raises(FormatError) as error:
        unpack_lzfse(Path("0.depth"), b"PNG" + bytes(20))
    assert error.value.code == "not-lzfse"


def test_poses_that_are_none_are_refused(tmp_path: Path) -> None:
    write_stray(tmp_path / "a")
    file = tmp_path / "a" / "odometry.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([lines[0], lines[2], lines[1]]) + "\n")
    with pytest.raises(FormatError) as error:
        read_device_folder(tmp_path / "a")
    assert error.value.code == "frame-time-not-after"
    file.write_text("\n".join(lines[:2]) + "\n")
    with pytest.raises(FormatError) as error:
        read_device_folder(tmp_path / "a")
    assert error.value.code == "one-pose"
