"""Cameras of undistorted pictures as Metashape's XML and Bundler's text."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate
from colmap_inertial.io.files import write_text
from colmap_inertial.tools.export.transforms import OPENGL_FROM_CAM, View

if TYPE_CHECKING:
    import pycolmap

_LOCAL_METRES = (
    'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'
)


def write_metashape(path: Path, views: list[View], *, metres: bool) -> None:
    """Write cameras as Agisoft Metashape imports them (File, Import, Import Cameras): XML of version 1.5.

    Its focal length is that of the rows; ``b1`` is what columns have more. Transforms are world_from_camera, x right, y
    down, z forward, and the chunk's own is none: the world is the model's. Where
    that is in metres, the chunk says so.
    """
    document = ElementTree.Element("document", version="1.5.0")
    chunk = ElementTree.SubElement(document, "chunk", label="colmap-inertial", enabled="true")
    cameras = sorted({(view.camera.width, view.camera.height, view.camera.params) for view in views})
    sensors = ElementTree.SubElement(chunk, "sensors", next_id=str(len(cameras)))
    for number, (width, height, (fx, fy, _, _)) in enumerate(cameras):
        size = {"width": str(width), "height": str(height)}
        sensor = ElementTree.SubElement(sensors, "sensor", id=str(number), label=f"camera {number}", type="frame")
        ElementTree.SubElement(sensor, "resolution", size)
        ElementTree.SubElement(sensor, "property", name="fixed", value="true")
        calibration = ElementTree.SubElement(sensor, "calibration", {"type": "frame", "class": "adjusted"})
        ElementTree.SubElement(calibration, "resolution", size)
        values = {"f": fy, "cx": 0.0, "cy": 0.0, "b1": fx - fy, "b2": 0.0, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
        for name, value in values.items():
            ElementTree.SubElement(calibration, name).text = repr(value)
    components = ElementTree.SubElement(chunk, "components", next_id="1", active_id="0")
    component = ElementTree.SubElement(components, "component", id="0", label="Component 1")
    transform = ElementTree.SubElement(component, "transform")
    for name, numbers in (("rotation", np.eye(3)), ("translation", np.zeros(3)), ("scale", np.ones(1))):
        ElementTree.SubElement(transform, name, locked="true").text = _text(numbers)
    shot = ElementTree.SubElement(chunk, "cameras", next_id=str(len(views)), next_group_id="0")
    for number, view in enumerate(views):
        camera = view.camera
        sensor_id = cameras.index((camera.width, camera.height, camera.params))
        label = view.name.rpartition(".")[0]
        fields = {"id": str(number), "sensor_id": str(sensor_id), "component_id": "0", "label": label}
        pose = np.eye(4)
        pose[:3, :3] = matrix_from_quat(quat_conjugate(view.cam_from_world_xyzw))
        pose[:3, 3] = view.cam_in_world
        ElementTree.SubElement(ElementTree.SubElement(shot, "camera", fields), "transform").text = _text(pose)
    if metres:
        ElementTree.SubElement(chunk, "reference").text = _LOCAL_METRES
    ElementTree.indent(document)
    text = ElementTree.tostring(document, encoding="unicode")
    write_text(path, f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n')


def _text(numbers: Array) -> str:
    return " ".join(repr(value) for value in numbers.ravel().tolist())


def write_bundler(path: Path, listing: Path, views: list[View], model: pycolmap.Reconstruction) -> None:
    """Write cameras and points as Bundler's ``bundle.out`` (v0.3), and the list of its pictures.

    One focal length, no distortion; cameras look along -z with y up; observations count from the picture's middle,
    upwards.

    Parameters
    ----------
    path, listing
        The two files.
    views
        Of cameras with square pixels.
    model
        The pinhole model whose images they are.
    """
    place = {view.name: i for i, view in enumerate(views)}
    number = {image.image_id: place[image.name] for image in model.images.values()}
    lines = ["# Bundle file v0.3", f"{len(views)} {model.num_points3D()}"]
    for view in views:
        rotation = OPENGL_FROM_CAM @ matrix_from_quat(view.cam_from_world_xyzw)
        rows = [[view.camera.params[0], 0.0, 0.0], *rotation.tolist(), (-rotation @ view.cam_in_world).tolist()]
        lines += [" ".join(f"{value:.15g}" for value in row) for row in rows]
    for point_id in sorted(model.points3D):
        point = model.points3D[point_id]
        seen = [str(len(point.track.elements))]
        for element in point.track.elements:
            image = model.image(element.image_id)
            camera = views[number[element.image_id]].camera
            x, y = image.points2D[element.point2D_idx].xy - np.array([0.5 * camera.width, 0.5 * camera.height])
            seen += [str(number[element.image_id]), str(element.point2D_idx), f"{x:.6g}", f"{-y:.6g}"]
        lines += [
            " ".join(f"{value:.15g}" for value in point.xyz),
            " ".join(str(int(value)) for value in point.color),
            " ".join(seen),
        ]
    write_text(path, "\n".join(lines) + "\n")
    write_text(listing, "".join(f"images/{view.name} 0 {view.camera.params[0]:.15g}\n" for view in views))
