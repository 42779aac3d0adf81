"""Small models and workspaces as other programs write them; lengths by a reader of their own."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pycolmap

WIDTH, HEIGHT, FOCAL = 160, 120, 140.0
COUNT = 8


def poses(count=COUNT):
    """Rotation (cam from world) and centre of cameras on an arc around the origin."""
    for i in range(count):
        angle = 0.35 * i
        centre = np.array([3 * np.cos(angle), 3 * np.sin(angle), 0.8 + 0.2 * np.sin(3 * angle)])
        z = -centre / np.linalg.norm(centre)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        yield np.stack([x, np.cross(z, x), z]), centre


def build(names=None, offset=(0.0, 0.0, 0.0), camera=None, points=60, seed=1):
    """A model with exact observations."""
    rng = np.random.default_rng(seed)
    names = [f"{i:03}.png" for i in range(COUNT)] if names is None else names
    model = pycolmap.Reconstruction()
    if camera is None:
        camera = pycolmap.Camera(
            camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
        )
    model.add_camera_with_trivial_rig(camera)
    world = rng.uniform(-0.7, 0.7, (points, 3)) + offset
    tracks = [pycolmap.Track() for _ in range(points)]
    for i, (rotation, centre) in enumerate(poses(len(names))):
        centre = centre + offset
        px = camera.img_from_cam((world - centre) @ rotation.T)
        inside = np.flatnonzero(((px > 0) & (px < [camera.width, camera.height])).all(axis=1))
        image = pycolmap.Image(
            name=names[i], camera_id=1, image_id=i + 1, points2D=[pycolmap.Point2D(px[k]) for k in inside]
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre))
        for index, k in enumerate(inside):
            tracks[k].add_element(i + 1, index)
    for k in range(points):
        if tracks[k].length() >= 2:
            model.add_point3D(world[k], tracks[k], rng.integers(0, 255, 3, dtype=np.uint8))
    return model


def save(model, folder, *, text=False, old=True):
    """Write a model; ``old``: as before COLMAP 3.12, without rigs and frames."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder))
    if old:
        for name in ("rigs", "frames"):
            (folder / f"{name}{'.txt' if text else '.bin'}").unlink(missing_ok=True)
    return folder


def write_pictures(model, folder):
    """A picture of each image."""
    for image in model.images.values():
        path = Path(folder) / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        picture = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
        picture[::8] = 160
        cv2.imwrite(str(path), picture)


def centres(folder):
    """Camera centres by name, from ``images.bin``, by this module's own reader."""
    data = (Path(folder) / "images.bin").read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, found = 8, {}
    for _ in range(count):
        w, x, y, z, *t = struct.unpack_from("<7d", data, at + 4)
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        end = data.index(b"\0", at + 64)
        found[data[at + 64 : end].decode()] = -rotation.T @ np.array(t)
        at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    return found


def points(folder):
    """Points by number, from ``points3D.bin``, by this module's own reader."""
    data = (Path(folder) / "points3D.bin").read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, found = 8, {}
    for _ in range(count):
        number, *xyz = struct.unpack_from("<Q3d", data, at)
        found[number] = np.array(xyz)
        at += 51 + 8 * struct.unpack_from("<Q", data, at + 43)[0]
    return found


def write_points(path, model, numbers, *, moved=0.0, tracks=True):
    """``points3D.bin`` of some points of a model."""
    out = struct.pack("<Q", len(numbers))
    for number in numbers:
        point = model.points3D[number]
        elements = point.track.elements if tracks else []
        xyz = point.xyz + moved
        out += struct.pack("<Q3d3BdQ", number, *xyz, *map(int, point.color), point.error, len(elements))
        out += b"".join(struct.pack("<II", e.image_id, e.point2D_idx) for e in elements)
    Path(path).write_bytes(out)


def ply_points(path):
    """(N, 3) positions of a PLY whose first element are its vertices, by this module's own reader."""
    data = Path(path).read_bytes()
    end = data.index(b"end_header\n") + 11
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    lines = [line.split() for line in data[:end].decode().splitlines()]
    count = next(int(words[2]) for words in lines if words[:2] == ["element", "vertex"])
    fields = [(words[2], kinds[words[1]]) for words in lines if words[0] == "property" and words[1] in kinds]
    if b"format ascii" in data[:end]:
        rows = [line.split() for line in data[end:].decode().splitlines()[:count]]
        at = [[name for name, _ in fields].index(axis) for axis in "xyz"]
        return np.array([[float(row[i]) for i in at] for row in rows])
    rows = np.frombuffer(data[end:], fields, count)
    return np.stack([rows[axis].astype(float) for axis in "xyz"], axis=1)


def write_ply(path, xyz, *, kind="float"):
    """A binary PLY with colours."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.zeros(len(xyz), [(axis, {"float": "<f4", "double": "<f8"}[kind]) for axis in "xyz"] + [("red", "u1")])
    for i, axis in enumerate("xyz"):
        rows[axis] = np.asarray(xyz)[:, i]
    properties = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}property uchar red\n"
    head += "end_header\n"
    path.write_bytes(head.encode() + rows.tobytes())


def write_json(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))
