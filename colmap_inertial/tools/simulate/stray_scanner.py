"""What Stray Scanner writes beside its video, from a scene: IMU, the device's path, intrinsics, depth maps.

Its conventions are those of ``io.device_folders`` and ``io.ios``: one clock, CoreMotion's g with the sign of gravity,
world_from_camera with COLMAP's camera axes in a world whose y points up, millimetres.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array, UInt8Array, UInt16Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, quat_multiply, quat_rotate
from colmap_inertial.core.types import CameraModel, CameraTrajectory, ImuRecording
from colmap_inertial.io.files import write_text
from colmap_inertial.model import colmap_camera
from colmap_inertial.tools.simulate.device import compute_path, draw_device_errors, measure_depth
from colmap_inertial.tools.simulate.scene import Scene
from colmap_inertial.tools.simulate.sensors import STANDARD_GRAVITY_M_S2
from colmap_inertial.tools.simulate.truth import true_metres_per_unit

#: Columns of a depth map.
_DEPTH_PX = 256
#: From a world whose z points up to one whose y does.
_Y_UP_FROM_Z_UP_XYZW = quat_exp(np.array([-np.pi / 2, 0.0, 0.0]))


def write_stray_scanner(scene: Scene, folder: Path) -> dict[str, float]:
    """Write all but the video; returns what is true of the path and the depth maps, for ``truth.json``.

    Poses, depth maps and stamps of frames are of their middle instants.
    """
    options, camera = scene.recipe.device, scene.recipe.camera
    rng = np.random.default_rng([scene.recipe.seed, *b"device"])
    gain = float(np.mean(np.diagonal(scene.imu.errors.accel_matrix)))
    errors = draw_device_errors(options, float(np.log1p(gain)), rng)
    t_s = np.array([camera.middle_s(float(t)) for t in scene.trigger_s])

    world_from_body, body_m = compute_path(scene.motion, t_s, options, errors, rng)
    world_from_cam = quat_multiply(world_from_body, np.array(camera.body_from_cam_xyzw))
    centres = body_m + matrix_from_quat(world_from_body) @ np.array(camera.cam_in_body_m)
    turned = quat_multiply(_Y_UP_FROM_Z_UP_XYZW, world_from_cam)
    _write_odometry(folder / "odometry.csv", t_s, turned, quat_rotate(_Y_UP_FROM_Z_UP_XYZW, centres))
    _write_imu(folder / "imu.csv", scene.imu.recording)
    matrix = np.array(colmap_camera(camera.model).calibration_matrix())
    matrix[:2, 2] -= 0.5  # its pixels count from the centre of the top-left one
    write_text(folder / "camera_matrix.csv", "\n".join(", ".join(map(repr, row)) for row in matrix.tolist()) + "\n")

    sensor = replace(camera, model=_depth_model(camera.model))
    for name in ("depth", "confidence"):
        (folder / name).mkdir()
    for i, t in enumerate(t_s.tolist()):
        true_m = scene.renderer().depth_m(sensor, scene.motion, t)
        depth_m, confidence = measure_depth(true_m, options, errors, rng)
        _write_picture(folder / "depth" / f"{i:06d}.png", np.rint(1000 * depth_m).astype(np.uint16))
        _write_picture(folder / "confidence" / f"{i:06d}.png", confidence)

    cam_from_world, true_centres = scene.camera_pose(camera, t_s)
    truth = CameraTrajectory(
        names=scene.names, t_s=t_s, cam_from_world_xyzw=cam_from_world, cam_in_world=true_centres, length_unit="m"
    )
    return {
        "path_metres_per_unit": true_metres_per_unit(scene.names, centres, truth),
        "depth_factor": float(np.exp(errors.depth_log)),
    }


def _write_odometry(path: Path, t_s: Array, world_from_cam_xyzw: Array, centres: Array) -> None:
    rows = [
        ", ".join([f"{t:.9f}", f"{i:06d}", *(f"{value:.8g}" for value in (*centre, *xyzw))])
        for i, (t, centre, xyzw) in enumerate(zip(t_s, centres, world_from_cam_xyzw, strict=True))
    ]
    write_text(path, "\n".join(["timestamp, frame, x, y, z, qx, qy, qz, qw", *rows]) + "\n")


def _write_imu(path: Path, imu: ImuRecording) -> None:
    """One row for each sample of the gyroscope; the accelerometer's are interpolated."""
    from scipy.interpolate import make_interp_spline

    t_s = imu.gyro_t_s[(imu.gyro_t_s >= imu.accel_t_s[0]) & (imu.gyro_t_s <= imu.accel_t_s[-1])]
    gyro = imu.gyro_rad_s[np.isin(imu.gyro_t_s, t_s)]
    accel_g = -make_interp_spline(imu.accel_t_s, imu.accel_m_s2, k=3)(t_s) / STANDARD_GRAVITY_M_S2
    rows = [
        ", ".join([f"{t:.9f}", *(f"{value:.8f}" for value in (*force, *rate))])
        for t, force, rate in zip(t_s, accel_g, gyro, strict=True)
    ]
    write_text(path, "\n".join(["timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z", *rows]) + "\n")


def _depth_model(model: CameraModel) -> CameraModel:
    """The camera with the pixels of a depth map."""
    camera = colmap_camera(model)
    camera.rescale(_DEPTH_PX, round(_DEPTH_PX * model.height / model.width))
    return CameraModel(
        model=model.model, width=camera.width, height=camera.height, params=tuple(camera.params.tolist())
    )


def _write_picture(path: Path, image: UInt8Array | UInt16Array) -> None:
    import cv2

    if not cv2.imwrite(str(path), image):
        raise OSError(f"{path} could not be written")
