"""How trainers read an export, restated from what their code does, without any of our own.

Each function takes the folder that is given to the trainer and returns :class:`Seen`: names, sizes, matrices that
project, centres, points. COLMAP's binary files are read by their published layout with ``struct`` and nothing else.

- ``inria``: 3D Gaussian Splatting. ``sparse/0``; only PINHOLE and SIMPLE_PINHOLE; an angle of view from each focal
  length, so that the principal point is the middle whatever the file says; names end at the first dot.
- ``gsplat``: ``examples/datasets/colmap.py`` with ``normalize=False`` and a factor of 1. Pictures are joined with
  images by the order of their sorted names; sizes are those of the files.
- ``nerfstudio_colmap``: the colmap parser, without its own idea of which way is up.
- ``nerfstudio_data``: the nerfstudio-data parser with orientation, centring and scaling off; OpenGL camera axes; the
  points of ``ply_file_path``; ``applied_transform`` is what it writes down as already done to the world.
- ``deblur_fork``: the same with the fields that 3dgs-deblur adds: velocities of all frames or of none.
"""

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

#: COLMAP's numbers of the models that INRIA's reader takes, and their parameters.
PINHOLES = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4)}


@dataclass
class Seen:
    """What a trainer makes of an export."""

    names: list
    sizes: dict
    #: By name, (3, 4): camera from world, x right, y down, z forward.
    poses: dict
    #: By name, fx, fy, cx, cy in pixels counted from the corner of the picture.
    intrinsics: dict
    points: np.ndarray
    colours: np.ndarray
    extra: dict = field(default_factory=dict)

    def centres(self):
        return {name: -pose[:, :3].T @ pose[:, 3] for name, pose in self.poses.items()}

    def project(self, name, xyz):
        cam = xyz @ self.poses[name][:, :3].T + self.poses[name][:, 3]
        fx, fy, cx, cy = self.intrinsics[name]
        return cam[:, :2] / cam[:, 2:] * [fx, fy] + [cx, cy]


def matrix(qvec):
    """Of COLMAP's quaternion w, x, y, z."""
    w, x, y, z = qvec
    return np.array(
        [
            [1 - 2 * y * y - 2 * z * z, 2 * x * y - 2 * w * z, 2 * x * z + 2 * w * y],
            [2 * x * y + 2 * w * z, 1 - 2 * x * x - 2 * z * z, 2 * y * z - 2 * w * x],
            [2 * x * z - 2 * w * y, 2 * y * z + 2 * w * x, 1 - 2 * x * x - 2 * y * y],
        ]
    )


def colmap_binaries(folder: Path):
    """Cameras, images and points of the three files that every reader takes."""
    cameras, images, points = {}, {}, {}
    with open(folder / "cameras.bin", "rb") as file:
        for _ in range(struct.unpack("<Q", file.read(8))[0]):
            camera_id, model, width, height = struct.unpack("<iiQQ", file.read(24))
            name, count = PINHOLES[model]  # a KeyError is the trainer's assertion
            cameras[camera_id] = name, width, height, struct.unpack(f"<{count}d", file.read(8 * count))
    with open(folder / "images.bin", "rb") as file:
        for _ in range(struct.unpack("<Q", file.read(8))[0]):
            values = struct.unpack("<idddddddi", file.read(64))
            name = b""
            while (char := file.read(1)) != b"\0":
                name += char
            count = struct.unpack("<Q", file.read(8))[0]
            rows = np.frombuffer(file.read(24 * count), [("xy", "<f8", 2), ("point", "<i8")])
            images[values[0]] = values[1:5], np.array(values[5:8]), values[8], name.decode(), rows
    with open(folder / "points3D.bin", "rb") as file:
        for _ in range(struct.unpack("<Q", file.read(8))[0]):
            values = struct.unpack("<QdddBBBd", file.read(43))
            length = struct.unpack("<Q", file.read(8))[0]
            track = struct.unpack(f"<{2 * length}i", file.read(8 * length))
            points[values[0]] = values[1:4], values[4:7], list(zip(track[::2], track[1::2], strict=True))
    return cameras, images, points


def cloud(points):
    return np.array([p[0] for p in points.values()]), np.array([p[1] for p in points.values()])


def inria(folder: Path) -> Seen:
    cameras, images, points = colmap_binaries(folder / "sparse" / "0")
    names, sizes, poses, intrinsics = [], {}, {}, {}
    for qvec, tvec, camera_id, name, _ in images.values():
        model, width, height, params = cameras[camera_id]
        focal = (params[0], params[0]) if model == "SIMPLE_PINHOLE" else params[:2]
        fov = [2 * np.arctan(side / (2 * f)) for side, f in zip((width, height), focal, strict=True)]
        picture = cv2.imread(str(folder / "images" / Path(name).name))
        assert picture is not None and picture.shape[:2] == (height, width)
        assert (folder / "images" / f"{Path(name).name.split('.')[0]}{Path(name).suffix}").is_file()
        names.append(name)
        sizes[name] = width, height
        poses[name] = np.column_stack([matrix(qvec), tvec])
        intrinsics[name] = (
            width / 2 / np.tan(fov[0] / 2), height / 2 / np.tan(fov[1] / 2), width / 2, height / 2
        )  # fmt: skip
    assert len({name.split(".")[0] for name in names}) == len(names)
    return Seen(names, sizes, poses, intrinsics, *cloud(points))


def gsplat(folder: Path) -> Seen:
    cameras, images, points = colmap_binaries(folder / "sparse" / "0")
    files = sorted(path.name for path in (folder / "images").iterdir())
    by_name = dict(zip(sorted(files), files, strict=True))
    names, sizes, poses, intrinsics = [], {}, {}, {}
    for qvec, tvec, camera_id, name, _ in sorted(images.values(), key=lambda image: image[3]):
        _, width, height, (fx, fy, cx, cy) = cameras[camera_id]
        picture = cv2.imread(str(folder / "images" / by_name[name]), cv2.IMREAD_UNCHANGED)[..., :3]
        assert picture.ndim == 3 and picture.shape[2] == 3 and picture.dtype == np.uint8
        scale = np.array(picture.shape[1::-1]) / (width, height)
        names.append(name)
        sizes[name] = picture.shape[1], picture.shape[0]
        poses[name] = np.column_stack([matrix(qvec), tvec])
        intrinsics[name] = (fx * scale[0], fy * scale[1], cx * scale[0], cy * scale[1])
    by_number = {number: image for number, image in images.items()}
    for number, (_, _, track) in points.items():  # which images see a point
        assert all(by_number[image][4]["point"][index] == number for image, index in track)
    return Seen(names, sizes, poses, intrinsics, *cloud(points))


def nerfstudio_colmap(folder: Path) -> Seen:
    cameras, images, points = colmap_binaries(folder / "sparse" / "0")
    names, sizes, poses, intrinsics = [], {}, {}, {}
    for qvec, tvec, camera_id, name, _ in images.values():
        _, width, height, params = cameras[camera_id]
        to_cam = np.eye(4)
        to_cam[:3, :3], to_cam[:3, 3] = matrix(qvec), tvec
        to_world = np.linalg.inv(to_cam)
        to_world[:3, 1:3] *= -1
        names.append(name)
        sizes[name], intrinsics[name] = (width, height), params
        poses[name] = opengl(to_world)
    return Seen(names, sizes, poses, intrinsics, *cloud(points))


def opengl(to_world):
    """(3, 4) camera from world in COLMAP's axes, of a matrix in OpenGL's."""
    rotation = to_world[:3, :3] @ np.diag([1, -1, -1])
    return np.column_stack([rotation.T, -rotation.T @ to_world[:3, 3]])


def nerfstudio_data(folder: Path) -> Seen:
    meta = json.loads((folder / "transforms.json").read_text())
    assert meta["camera_model"] == "OPENCV" and meta.get("orientation_override", "none") == "none"
    assert all(f"{key}_override" not in meta for key in ("center_method",))
    frames = sorted(meta["frames"], key=lambda frame: frame["file_path"])
    names, sizes, poses, intrinsics = [], {}, {}, {}
    for frame in frames:

        def of(key, frame=frame):
            fixed = key in meta
            assert fixed != (key in frame), key  # one or the other, for all frames
            return meta[key] if fixed else frame[key]

        name = Path(frame["file_path"]).name
        assert (folder / frame["file_path"]).is_file()
        assert not any(of(key) for key in ("k1", "k2", "p1", "p2"))
        names.append(name)
        sizes[name] = of("w"), of("h")
        intrinsics[name] = of("fl_x"), of("fl_y"), of("cx"), of("cy")
        angle = 2 * np.arctan(of("w") / 2 / of("fl_x"))
        np.testing.assert_allclose(of("camera_angle_x"), angle, atol=1e-12)
        # auto_orient_and_center_poses with "none" and "none", scale_factor 1: nothing changes
        poses[name] = opengl(np.array(frame["transform_matrix"]))
    # what it would believe was done to the world before
    done = np.array(meta["applied_transform"])
    np.testing.assert_array_equal(done, np.eye(4)[:3])
    points, colours = ply(folder / meta["ply_file_path"])
    return Seen(names, sizes, poses, intrinsics, points, colours, {"meta": meta, "frames": frames})


def ply(path: Path):
    """The points of a binary little-endian PLY, as Open3D or plyfile give them."""
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    fields = [(line.split()[2], kinds[line.split()[1]]) for line in lines if line.startswith("property")]
    (count,) = [int(line.split()[2]) for line in lines if line.startswith("element vertex")]
    rows = np.frombuffer(body, fields)
    assert len(rows) == count
    return (
        np.stack([rows[name].astype(float) for name in "xyz"], axis=1),
        np.stack([rows[name] for name in ("red", "green", "blue")], axis=1),
    )


def deblur_fork(folder: Path) -> Seen:
    seen = nerfstudio_data(folder)
    frames, meta = seen.extra["frames"], seen.extra["meta"]
    given = [{"camera_linear_velocity", "camera_angular_velocity"} <= frame.keys() for frame in frames]
    assert all(given), "of all frames or of none"
    seen.extra["linear"] = {n: np.array(f["camera_linear_velocity"]) for n, f in zip(seen.names, frames, strict=True)}
    seen.extra["angular"] = {n: np.array(f["camera_angular_velocity"]) for n, f in zip(seen.names, frames, strict=True)}
    seen.extra["exposure_s"], seen.extra["readout_s"] = meta["exposure_time"], meta["rolling_shutter_time"]
    assert meta["auto_scale_poses_override"] is False
    return seen


READERS = (inria, gsplat, nerfstudio_colmap, nerfstudio_data)
