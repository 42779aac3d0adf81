"""An existing COLMAP project with pictures, video and IMU, without mapping: a hand films the inside of a box.

Depth and colour inside a box are closed forms, and everything in view is visible.
"""

import struct
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from colmap_inertial.core.geometry import matrix_from_quat, quat_rotate
from colmap_inertial.tools.simulate import (
    MotionOptions,
    RecordingOptions,
    SfmOptions,
    SimulatedRecording,
    simulate_recording,
)
from tests.helpers.simulated_project import write_project

WIDTH, HEIGHT, FOCAL = 160, 120, 130.0
LOW, HIGH = np.array([-2.5, -2.0, -1.0]), np.array([2.5, 3.0, 2.0])
FRAME_RATE_HZ = 30
_WAVES = np.random.default_rng(5).normal(0, 6, (6, 3)).astype("f4")
_COLOURS = np.random.default_rng(6).uniform(-1.4, 1.4, (6, 3)).astype("f4")


@dataclass(frozen=True)
class BoxProject:
    """A user's files, and the truth behind them; ``frames`` are the numbers of the project's images in the video."""

    root: Path
    frame_times: Path
    imu: Path
    recording: SimulatedRecording
    frames: range

    @property
    def names(self) -> list[str]:
        return [f"{i:05}.jpg" for i in self.frames]

    def t_ns(self) -> list[int]:
        """Times of the project's images."""
        trajectory = self.recording.trajectory
        return [trajectory.epoch_ns + round(float(trajectory.t_s[i]) * 1e9) for i in self.frames]


def rays(width=WIDTH, height=HEIGHT, params=(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)):
    """(H, W, 3) directions of a pinhole camera's pixels, z = 1."""
    v, u = np.mgrid[:height, :width] + 0.5
    fx, fy, cx, cy = params
    return np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1)


_RAYS = rays()


def cast(world_from_cam, centre, directions):
    """(H, W) z-depth in metres, and (H, W, 3) normals of the box in the camera frame."""
    along = directions @ world_from_cam.T
    with np.errstate(divide="ignore"):
        wall = np.where(along > 0, (HIGH - centre) / along, (LOW - centre) / along)
    axis = np.argmin(wall, axis=-1)
    depth = np.take_along_axis(wall, axis[..., None], -1)[..., 0]
    inward = -np.sign(np.take_along_axis(along, axis[..., None], -1)) * np.eye(3)[axis]
    return depth, inward @ world_from_cam


def off_the_walls(points):
    """(N,) distances in metres of points from the box's surface."""
    return np.min(np.abs(np.concatenate([points - LOW, points - HIGH], axis=1)), axis=1)


def picture(world_from_cam, centre):
    """(H, W, 3) uint8, BGR."""
    along = _RAYS @ world_from_cam.T
    with np.errstate(divide="ignore"):
        depth = np.min(np.where(along > 0, (HIGH - centre) / along, (LOW - centre) / along), axis=-1)
    points = (centre + depth[..., None] * along).astype("f4")
    light = np.sin(points @ _WAVES.T) @ _COLOURS
    return np.clip(128 + 30 * light, 0, 255).astype(np.uint8)


def pictures(recording, frames):
    """What the camera saw at the given frames."""
    motion, t_s = recording.truth.motion, recording.trajectory.t_s
    for i in frames:
        t = t_s[i : i + 1]
        yield picture(matrix_from_quat(motion.world_from_cam_xyzw(t))[0], motion.cam_in_world_m(t)[0])


def build(root: Path, *, every: int, points: int = 1200) -> BoxProject:
    """Write everything: 20 s of a hand's motion at 30 frames a second, an image of every so many of them."""
    options = RecordingOptions(
        motion=MotionOptions(duration_s=20),
        sfm=SfmOptions(
            frame_rate_hz=FRAME_RATE_HZ,
            position_white_m=0.001,
            position_correlated_m=0.001,
            metres_per_unit=(0.2, 0.3),
        ),
    )
    recording = simulate_recording(options, seed=21)
    given = write_project(root / "given", recording)
    frames = range(2, len(recording.trajectory), every)
    box = BoxProject(root / "project", given.frame_times, given.imu, recording, frames)
    (box.root / "images").mkdir(parents=True)
    for name, image in zip(box.names, pictures(recording, frames), strict=True):
        cv2.imwrite(str(box.root / "images" / name), image, [cv2.IMWRITE_JPEG_QUALITY, 92])
    write_model(box, box.root / "sparse" / "0", box.names, points=points)
    (box.root / "notes.txt").write_text("taken in March\n")
    return box


def write_model(box: BoxProject, folder: Path, names, *, points: int) -> None:
    """COLMAP's model of the images, under any names; with so many points on the walls."""
    recording, rng = box.recording, np.random.default_rng(8)
    truth, trajectory = recording.truth, recording.trajectory
    axis, side = rng.integers(0, 3, points), rng.integers(0, 2, points)
    world = rng.uniform(LOW, HIGH, (points, 3))
    world[np.arange(points), axis] = np.where(side, HIGH[axis], LOW[axis])
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    )
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in range(points)]
    for number, (i, name) in enumerate(zip(box.frames, names, strict=True), start=1):
        t = trajectory.t_s[i : i + 1]
        cam = (world - truth.motion.cam_in_world_m(t)) @ matrix_from_quat(truth.motion.world_from_cam_xyzw(t))[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            px = FOCAL * cam[:, :2] / cam[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        seen = np.flatnonzero((cam[:, 2] > 0.1) & (px > 1).all(1) & (px < [WIDTH - 1, HEIGHT - 1]).all(1))
        for place, k in enumerate(seen):
            tracks[k].add_element(number, place)
        rotation = pycolmap.Rotation3d(trajectory.cam_from_world_xyzw[i])
        pose = pycolmap.Rigid3d(rotation, -(rotation.matrix() @ trajectory.cam_in_world[i]))
        observed = px[seen] + rng.normal(0, 0.3, (len(seen), 2))
        image = pycolmap.Image(
            name=name, camera_id=1, image_id=number, points2D=[pycolmap.Point2D(xy) for xy in observed]
        )
        model.add_image_with_trivial_frame(image, pose)
    placed = quat_rotate(truth.model_from_world_xyzw, world) / truth.metres_per_unit + truth.world_in_model
    for xyz, track in zip(placed, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(xyz, track, np.array([200, 180, 160], dtype=np.uint8))
    folder.mkdir(parents=True)
    model.write_binary(str(folder))


def write_video(path: Path, images, *, stamps_ms, size=(WIDTH, HEIGHT), crf=23) -> Path:
    """H.264 of BGR pictures at another size."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        stream.options = {"crf": str(crf)}
        for image, stamp in zip(images, stamps_ms, strict=True):
            resized = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
            frame = av.VideoFrame.from_ndarray(cv2.cvtColor(resized, cv2.COLOR_BGR2YUV_I420), format="yuv420p")
            frame.pts, frame.time_base = stamp, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def with_exif(jpeg: bytes, date: str, fraction: str | None, offset: str | None = None) -> bytes:
    """A JPEG with DateTimeOriginal, and what else is given, big-endian."""
    texts = {0x9003: date, 0x9011: offset, 0x9291: fraction}
    texts = {tag: text.encode() + b"\0" for tag, text in texts.items() if text is not None}
    start = 8 + 2 + 12 + 4
    at = start + 2 + 12 * len(texts) + 4
    entries, tail = b"", b""
    for tag, text in texts.items():
        value = text.ljust(4, b"\0") if len(text) <= 4 else struct.pack(">I", at + len(tail))
        entries += struct.pack(">HHI", tag, 2, len(text)) + value
        tail += text if len(text) > 4 else b""
    first = struct.pack(">HHHII", 1, 0x8769, 4, 1, start) + struct.pack(">I", 0)
    tiff = b"MM\0*" + struct.pack(">I", 8) + first + struct.pack(">H", len(texts)) + entries + bytes(4) + tail
    body = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]
