"""Files of stereo programs, rigs and trainers as those write them, and readers of their lengths."""

import json

import numpy as np

from tests.helpers.foreign_models import write_json


def mvsnet_text(image, depths="0.5 0.0125 192.0 2.9"):
    """A camera as MVSNet's ``colmap2mvsnet.py`` writes it."""
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().matrix()
    rows = "\n".join(" ".join(str(value) for value in row) for row in pose.tolist())
    inner = "140.0 0.0 80.0\n0.0 140.0 60.0\n0.0 0.0 1.0"
    return f"extrinsic\n{rows}\n\nintrinsic\n{inner}\n\n{depths}\n"


def in_order(model):
    """Images by number."""
    return [model.images[number] for number in sorted(model.images)]


def write_mvsnet(root, model, **more):
    """``cams/`` of a model, and the pairs beside it."""
    (root / "cams").mkdir(parents=True)
    for i, image in enumerate(in_order(model)):
        (root / "cams" / f"{i:08}_cam.txt").write_text(mvsnet_text(image, **more))
    (root / "pair.txt").write_text("2\n0\n2 1 203.5 2 180.25\n1\n2 0 203.5 2 99.0\n")


def read_mvsnet(path):
    """Centre, rotation cam_from_world, intrinsics and depths of a camera."""
    numbers = [float(word) for word in path.read_text().split() if word not in ("extrinsic", "intrinsic")]
    pose = np.array(numbers[:16]).reshape(4, 4)
    return -pose[:3, :3].T @ pose[:3, 3], pose[:3, :3], numbers[16:25], numbers[25:]


def training_of(model, applied=None, *, centre="poses", fills=True):
    """(4, 4) of nerfstudio's training: its orientation and size; what it saves of that, for the world before it."""
    world = np.eye(4) if applied is None else np.vstack([applied, [0, 0, 0, 1]])
    centres = np.array([image.projection_center() for image in model.images.values()])
    there = centres @ world[:3, :3].T + world[:3, 3]
    turn, _ = np.linalg.qr(np.array([[0.3, 1.0, 0.2], [-0.8, 0.1, 0.5], [0.2, 0.4, 1.0]]))
    turn *= np.sign(np.linalg.det(turn))
    middle = there.mean(axis=0) if centre == "poses" else np.array([0.1, 0.2, -0.3])
    seen = (there - middle) @ turn.T
    scale = 1.0 / np.abs(seen).max() if fills else 1.0
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, -turn @ middle
    return {"transform": (matrix @ world)[:3].tolist(), "scale": float(scale)}


def into_training(values, xyz):
    """Where (N, 3) of the world are in a training."""
    matrix = np.array(values["transform"])
    return values["scale"] * (np.asarray(xyz) @ matrix[:, :3].T + matrix[:, 3])


def write_rig(path, model, prefixes, *, times=1.0, key="cam_from_rig_translation"):
    """A rig configuration of COLMAP's; its first camera is the reference."""
    cameras = [{"image_prefix": prefixes[0], "ref_sensor": True}]
    by_name = {image.name: image for image in in_order(model)}
    for prefix in prefixes[1:]:
        name = next(name for name in by_name if name.startswith(prefix))
        reference = by_name[prefixes[0] + name[len(prefix) :]].cam_from_world()
        relative = by_name[name].cam_from_world() * reference.inverse()
        w = [float(relative.rotation.quat[i]) for i in (3, 0, 1, 2)]
        place = (times * relative.translation).tolist()
        cameras.append({"image_prefix": prefix, "cam_from_rig_rotation": w, key: place})
    write_json(path, [{"cameras": cameras}])
    return cameras


def read_rig(path, key="cam_from_rig_translation"):
    """Translations of a rig's cameras."""
    return [np.array(camera[key]) for camera in json.loads(path.read_text())[0]["cameras"] if key in camera]
