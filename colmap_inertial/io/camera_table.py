"""Tables of a ``capture.toml`` with intrinsics and poses of cameras."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import colmap_px_from_opencv
from colmap_inertial.core.types import CameraModel
from colmap_inertial.io import sensor_yaml
from colmap_inertial.io.device_yaml import read_device_yaml
from colmap_inertial.io.sensor_yaml import CAMERA_MODELS
from colmap_inertial.io.toml_section import Section

CAMERA_KEYS = ("sensor_yaml", "camera", "model", "width", "height", "params", "pixel_origin")


def read_camera_table(table: Section) -> tuple[CameraModel, Array | None, float | None]:
    """The ``[camera]`` table: the model; (4, 4) body_from_cam and the clock's offset where a sheet gives them."""
    sheet, name = table.file("sensor_yaml"), table.text("camera")
    if sheet is not None:
        if any(key in table for key in CAMERA_KEYS[2:]):
            table.fail(
                "sensor_yaml",
                Fact("sheet-gives-intrinsics", others=CAMERA_KEYS[2:]),
            )
        if sensor_yaml.is_asl(sheet):
            return sensor_yaml.read_camera(sheet), sensor_yaml.read_body_from_sensor(sheet), None
        mounted = read_device_yaml(sheet, name)
        pose = mounted.cam_from_imu
        return (
            mounted.camera(),
            None if pose is None else np.asarray(np.linalg.inv(pose), dtype=np.float64),
            mounted.clock_offset_s,
        )
    if name is not None:
        table.fail("camera", Fact("belongs-to-missing", key="sensor_yaml"))
    model = table.require("model", table.choice("model", CAMERA_MODELS))
    width, height = (table.require(key, table.integer(key)) for key in ("width", "height"))
    params = table.require("params", table.numbers("params"))
    count, centre = CAMERA_MODELS[model]
    if len(params) != count:
        table.fail("params", Fact("camera-params-count", model=model, count=count, found=len(params)))
    origin = table.choice("pixel_origin", ("corner", "center"))
    if origin is None:
        table.fail(None, Fact("pixel-origin-missing"))
    values = np.array(params)
    if origin == "center":
        values[centre : centre + 2] = colmap_px_from_opencv(values[centre : centre + 2])
    if (values[:centre] <= 0).any():
        table.fail("params", Fact("focal-lengths-not-positive"))
    return CameraModel(model=model, width=width, height=height, params=tuple(values.tolist())), None, None


def check_transform(table: Section, key: str, rows: list[list[float]]) -> Array:
    """(4, 4) rotation and translation of a 3x3 or 4x4 matrix under a key."""
    shape = (len(rows), len(rows[0]) if rows else 0)
    if shape not in ((3, 3), (4, 4)):
        table.fail(key, Fact("not-a-pose", rows=shape[0], columns=shape[1]))
    matrix = np.eye(4)
    matrix[: shape[0], : shape[1]] = rows
    if not sensor_yaml.is_rotation(matrix[:3, :3]):
        table.fail(key, Fact("matrix-not-a-rotation"))
    if not np.allclose(matrix[3], [0, 0, 0, 1]):
        table.fail(key, Fact("last-row-wrong"))
    return matrix
