"""Write a simulated capture: frames or video, IMU, ``capture.toml``, and the truth beside them."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from fractions import Fraction
from functools import partial
from multiprocessing import get_context, parent_process
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.core.errors import InertialError, OutputExistsError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_multiply, quat_normalize
from colmap_inertial.core.types import CameraModel
from colmap_inertial.io.files import write_json, write_text
from colmap_inertial.model.copying import new_folder
from colmap_inertial.tools.simulate.recipe import VIDEO_FORMATS, SceneRecipe, recipe_text
from colmap_inertial.tools.simulate.render import ShutterCamera, develop
from colmap_inertial.tools.simulate.scene import TICKS_HZ, Scene, make_scene
from colmap_inertial.tools.simulate.sensors import STANDARD_GRAVITY_M_S2
from colmap_inertial.tools.simulate.stray_scanner import write_stray_scanner
from colmap_inertial.tools.simulate.world import WALLS_M

#: Camera (end of its files' names), frame, folder for the depth map.
_Job = tuple[str, int, Path | None]


def write_capture(
    recipe: SceneRecipe, folder: Path, *, workers: int = 1, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Make the capture that a recipe describes.

    Writes ``frames/`` and ``frames.csv``, or ``clip.mp4``; ``gyro.csv``, ``accel.csv``, ``capture.toml``,
    ``truth.json``, ``recipe.toml``; ``depth/`` where the recipe wants it; ``frames_NAME/`` or ``clip_NAME.mp4`` for the
    rig's other cameras. Or what Stray Scanner writes, with the truth and the recipe.

    Parameters
    ----------
    folder
        Must not exist, or be empty; it appears whole or not at all.
    workers
        Processes that render.
    progress
        Called with frames done and frames in all.

    Returns
    -------
    What commands take as the capture: ``capture.toml``, or Stray Scanner's folder.

    Raises
    ------
    OutputExistsError
        Where the folder holds something already.
    InertialError
        Where the path leaves the room, which is black outside.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputExistsError(Fact("folder-exists", folder=str(folder)))
    scene = make_scene(recipe)
    _require_inside(scene)
    with new_folder(folder, into_empty=True) as partial_folder:
        _write_capture(scene, partial_folder, workers, progress)
    return folder if recipe.format == "stray-scanner" else folder / "capture.toml"


def _require_inside(scene: Scene) -> None:
    """Refuse a path on which a camera of the rig is outside the walls when a frame is exposed.

    Raises
    ------
    InertialError
    """
    low_m, high_m = map(np.array, WALLS_M[scene.recipe.world])
    centre_m = np.stack([scene.camera_pose(camera, scene.trigger_s)[1] for camera in _cameras(scene.recipe).values()])
    outside = np.any((centre_m < low_m) | (centre_m > high_m), axis=(0, 2))
    if outside.any():
        first_s = float(scene.trigger_s[np.argmax(outside)])
        raise InertialError(
            Fact(
                "path-leaves-room",
                first_s=first_s,
                outside=int(outside.sum()),
                frames=len(scene.trigger_s),
                low_m=low_m.tolist(),
                high_m=high_m.tolist(),
            )
        )


def _write_capture(scene: Scene, folder: Path, workers: int, progress: Callable[[int, int], None] | None) -> None:
    recipe = scene.recipe
    cameras = _cameras(recipe)
    total, done = len(cameras) * len(scene.names), 0
    write = _write_video if recipe.format in VIDEO_FORMATS else _write_images
    with _processes(recipe, workers) as pool:
        for suffix in cameras:
            depth = folder / f"depth{suffix}" if recipe.depth_maps else None
            if depth is not None:
                depth.mkdir()
            jobs = [(suffix, i, depth) for i in range(len(scene.names))]
            images = map(partial(_render, scene), jobs) if pool is None else pool.map(_render_job, jobs)
            for _ in write(scene, images, folder, suffix):
                done += 1
                if progress is not None:
                    progress(done, total)
    write_text(folder / "recipe.toml", recipe_text(recipe))
    truth = _truth(scene)
    if recipe.format == "stray-scanner":
        truth["device"] = write_stray_scanner(scene, folder)
    else:
        _write_tables(scene, folder)
        write_text(folder / "capture.toml", _capture_toml(recipe))
    write_json(folder / "truth.json", truth)


def _write_tables(scene: Scene, folder: Path) -> None:
    """Samples of gyroscope and accelerometer, and the times of images."""
    for name, t_s, values in (
        ("gyro", scene.imu.recording.gyro_t_s, scene.imu.recording.gyro_rad_s),
        ("accel", scene.imu.recording.accel_t_s, scene.imu.recording.accel_m_s2),
    ):
        rows = [f"{t:.7f},{x:.6f},{y:.6f},{z:.6f}" for t, (x, y, z) in zip(t_s, values, strict=True)]
        write_text(folder / f"{name}.csv", "\n".join(["t,x,y,z", *rows]) + "\n")
    if scene.recipe.format != "h264":
        rows = [f"{name},{t:.9f}" for name, t in zip(scene.names, scene.trigger_s, strict=True)]
        write_text(folder / "frames.csv", "\n".join(["name,t_s", *rows]) + "\n")


# --- rendering, in this process or in several ---------------------------------------------------------------------


def _cameras(recipe: SceneRecipe) -> dict[str, ShutterCamera]:
    """The main camera and those of the rig, by what their files' names end with."""
    return {"": recipe.camera, **{f"_{name}": camera for name, camera in recipe.rig.items()}}


def _render(scene: Scene, job: _Job) -> UInt8Array:
    suffix, index, depth = job
    recipe = scene.recipe
    camera = _cameras(recipe)[suffix]
    renderer = scene.renderer()
    t_s = float(scene.trigger_s[index])
    if depth is not None:
        depth_m = renderer.depth_m(camera, scene.motion, camera.middle_s(t_s))
        np.save(depth / f"{Path(scene.names[index]).stem}.npy", depth_m.astype(np.float32))
    linear = renderer.linear(camera, scene.motion, t_s)
    # a stream for each frame and camera, so that the noise does not depend on who rendered the one before
    stream = [recipe.seed, index, *suffix.encode()]
    return develop(linear, camera, np.random.default_rng(stream))


#: The scene of a rendering process.
_SCENE: list[Scene] = []


def _begin(recipe: SceneRecipe) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that waits for this one ends it
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    _SCENE.append(make_scene(recipe))


def _end_with_the_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _render_job(job: _Job) -> UInt8Array:
    return _render(_SCENE[-1], job)


@contextmanager
def _processes(recipe: SceneRecipe, workers: int) -> Iterator[ProcessPoolExecutor | None]:
    if workers <= 1:
        yield None
        return
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=_begin, initargs=(recipe,)) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)  # the frames that are in work take a second or two
            raise


def _write_images(scene: Scene, images: Iterator[UInt8Array], folder: Path, suffix: str) -> Iterator[None]:
    import cv2

    target = folder / f"frames{suffix}"
    target.mkdir()
    options = [cv2.IMWRITE_JPEG_QUALITY, scene.recipe.quality] if scene.recipe.format == "jpeg" else []
    for name, image in zip(scene.names, images, strict=True):
        if not cv2.imwrite(str(target / name), image[..., ::-1], options):
            raise OSError(f"{target / name} could not be written")
        yield


def _write_video(scene: Scene, images: Iterator[UInt8Array], folder: Path, suffix: str) -> Iterator[None]:
    import av

    camera = scene.recipe.camera.model
    name = "rgb.mp4" if scene.recipe.format == "stray-scanner" else f"clip{suffix}.mp4"
    with av.open(str(folder / name), "w") as container:
        rate = Fraction(scene.recipe.frame_rate_hz).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height = camera.width, camera.height
        stream.pix_fmt = "yuv420p"
        # one thread: more of them make the result depend on the machine's load
        stream.codec_context.thread_count = 1
        stream.options = {"crf": str(scene.recipe.crf), "threads": "1"}
        stream.codec_context.time_base = stream.time_base = Fraction(1, TICKS_HZ)
        for t_s, image in zip(scene.trigger_s, images, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = round(t_s * TICKS_HZ), Fraction(1, TICKS_HZ)
            container.mux(stream.encode(frame))
            yield
        container.mux(stream.encode())


# --- what stands beside the images ------------------------------------------------------------------------------


def _poses(scene: Scene, camera: ShutterCamera) -> list[dict[str, object]]:
    middle_s = np.array([camera.middle_s(float(t)) for t in scene.trigger_s])
    rotation, centre = scene.camera_pose(camera, middle_s)
    return [
        {"name": n, "t_s": t + camera.delay_s, "t_middle_s": m, "cam_from_world_xyzw": q, "cam_in_world_m": c}
        for n, t, m, q, c in zip(scene.names, scene.trigger_s, middle_s, rotation, centre, strict=True)
    ]


def _truth(scene: Scene) -> dict[str, object]:
    recipe, errors = scene.recipe, scene.imu.errors
    # the motion is the body's; the calibration that estimators seek is the main camera's
    camera = recipe.camera
    cam_from_body = quat_conjugate(np.array(camera.body_from_cam_xyzw))
    imu_in_cam = matrix_from_quat(cam_from_body) @ (errors.imu_in_cam_m - np.array(camera.cam_in_body_m))
    return {
        "about": "Truth of a simulated capture: metres, seconds, radians; world z up; poses hold at t_middle_s "
        "(mid-exposure of the middle line) on the camera's clock. recipe.toml gives poses at any other time.",
        "gravity_in_world_m_s2": [0.0, 0.0, -STANDARD_GRAVITY_M_S2],
        "target": {
            "spec": recipe.board.spec(),
            "corners_in_world_m": scene.world().board_corners_m,
        },
        "calibration": {
            "cam_from_imu_xyzw": quat_normalize(quat_multiply(cam_from_body, errors.cam_from_imu_xyzw)),
            **errors.clock_offsets_s,
            "gyro_bias_rad_s": scene.imu.gyro_bias_rad_s.mean(axis=0),
            "imu_in_cam_m": imu_in_cam,
            "readout_s": camera.readout_s,
        },
        "accel_bias_m_s2": scene.imu.accel_bias_m_s2.mean(axis=0),
        "gyro_error_matrix": errors.gyro_matrix,
        "accel_error_matrix": errors.accel_matrix,
        "imu_clock_rate": errors.clock_rate,
        "exposure_s": camera.exposure_s,
        "camera": camera.model,
        "frames": _poses(scene, camera),
        "rig": {
            name: {"camera": other.model, "exposure_s": other.exposure_s, "frames": _poses(scene, other)}
            for name, other in recipe.rig.items()
        },
    }


def _capture_toml(recipe: SceneRecipe) -> str:
    camera = recipe.camera
    if recipe.format == "h264":
        lines = ["[video]", 'file = "clip.mp4"']
    else:
        lines = ["[images]", 'folder = "frames"', 'times = "frames.csv"']
    lines += ["", "[timing]", f"exposure_s = {camera.exposure_s!r}", f"readout_s = {camera.readout_s!r}"]
    lines += [f'readout_direction = "{camera.readout_direction}"']
    if recipe.camera_known:
        lines += _camera_lines("camera", camera.model)
    for sensor, unit in (("gyro", "rad/s"), ("accel", "m/s2")):
        lines += ["", f"[imu.{sensor}]", f'file = "{sensor}.csv"', 'time = "t"', 'time_unit = "s"']
        lines += ['columns = ["x", "y", "z"]', f'unit = "{unit}"']
    lines += ["", "[imu.noise]", *(f"{name} = {value!r}" for name, value in asdict(recipe.imu.noise()).items())]
    lines += ["", "[target]", f'spec = "{recipe.board.spec()}"']
    for name, other in recipe.rig.items():
        if other.delay_s == camera.delay_s:  # others are not synchronised
            source = f'video = "clip_{name}.mp4"' if recipe.format == "h264" else f'folder = "frames_{name}"'
            pose = np.linalg.inv(_body_from_cam(other)) @ _body_from_cam(camera)
            lines += ["", f"[rig.{name}]", source, f"cam_from_reference = {pose.tolist()!r}"]
            lines += _camera_lines(f"rig.{name}.camera", other.model) if recipe.camera_known else []
    return "\n".join(["# A simulated recording; recipe.toml made it, truth.json is its truth.", *lines]) + "\n"


def _camera_lines(table: str, model: CameraModel) -> list[str]:
    lines = ["", f"[{table}]", f'model = "{model.model}"', f"width = {model.width}", f"height = {model.height}"]
    return [*lines, f"params = {list(model.params)!r}", 'pixel_origin = "corner"']


def _body_from_cam(camera: ShutterCamera) -> Array:
    """(4, 4), metres."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = matrix_from_quat(np.array(camera.body_from_cam_xyzw)), camera.cam_in_body_m
    return pose
