"""Targets of an export: one value for each program or format, with the files that it writes."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate
from colmap_inertial.core.options import ExportProgram
from colmap_inertial.core.types import CameraMotion
from colmap_inertial.io.files import write_json, write_text
from colmap_inertial.io.trajectories import write_tum
from colmap_inertial.model import write_files
from colmap_inertial.tools.export.formats import (
    require_laspy,
    require_pygltflib,
    smooth_path,
    write_cameras,
    write_gltf,
    write_las,
    write_ply,
)
from colmap_inertial.tools.export.source import ExportContent, ExportSource, Picture
from colmap_inertial.tools.export.transforms import (
    OPENGL_FROM_CAM,
    Exposure,
    View,
    add_row_poses,
    add_velocities,
    transforms,
    view_matrices,
)
from colmap_inertial.tools.export.undistort import Undistortion, pinhole_model

if TYPE_CHECKING:
    import pycolmap


def exposures_of(
    model: pycolmap.Reconstruction,
    source: ExportSource,
    pictures: Mapping[str, Picture],
    cameras: Mapping[int, Undistortion],
    notes: list[Fact],
) -> dict[str, Exposure]:
    """Velocity, exposure and readout by image name; images without a velocity are left out.

    The exported image's rows are those of the filmed one, stretched: its readout is that of as many rows as it shows.

    Parameters
    ----------
    model, source
        What is exported.
    pictures
        The exported files: where the rolling shutter was undone there is no readout, where the blur was, no exposure.
    cameras
        What became of the cameras.
    notes
        Gets what the user should know.

    Raises
    ------
    NotObservableError
        Where no velocity is known, and where lines are read out in another direction than down.
    """
    motion = _require_motion(source.motion, pictures)
    readout_s = motion.readout_s or 0.0
    if motion.exposure_s is None and any(not picture.sharpened for picture in pictures.values()):
        notes.append(Fact("blur-not-modelled"))
    place = {name: i for i, name in enumerate(motion.names)}
    exposures = {}
    for image in map(model.image, model.reg_image_ids()):
        index = place.get(image.name)
        if index is None:
            continue
        picture, undistortion = pictures[image.name], cameras[image.camera_id]
        share, late = _rows(undistortion)
        exposed = 0.0 if motion.exposure_s is None or picture.sharpened else float(motion.exposure_s[index])
        left_s = 0.0 if picture.rectified else readout_s
        rotation = image.cam_from_world().rotation.matrix()
        exposures[image.name] = Exposure(
            velocity_in_cam_m_s=rotation @ motion.velocity_in_world_m_s[index],
            angular_velocity_in_cam_rad_s=motion.angular_velocity_in_cam_rad_s[index],
            exposure_s=exposed,
            readout_s=left_s * share,
            late_s=left_s * late,
        )
    if not exposures:
        raise NotObservableError("camera motion", Fact("no-velocities"))
    if motion.exposure_s is not None and len({exposure.exposure_s for exposure in exposures.values()}) > 1:
        notes.append(Fact("one-exposure-for-all"))
    return exposures


def _require_motion(motion: CameraMotion | None, pictures: Mapping[str, Picture]) -> CameraMotion:
    """The motion, where it is known and a program can be told of the pictures' readout."""
    if motion is None or not motion.names:
        raise NotObservableError(
            "camera motion",
            Fact("velocities-not-kept"),
        )
    as_filmed = any(not picture.rectified for picture in pictures.values())
    if as_filmed and (motion.readout_s or 0.0) > 0 and motion.readout_direction != "down":
        raise NotObservableError(
            "rolling shutter",
            Fact("readout-not-told", direction=motion.readout_direction),
        )
    return motion


def _rows(undistortion: Undistortion) -> tuple[float, float]:
    """Rows of the filmed image that the new one shows, and the shift of its middle, as shares of its height."""
    pinhole, height = undistortion.pinhole, undistortion.camera.height
    middle = [0.5 * pinhole.width, 0.5 * pinhole.height]
    step = 0.25 * pinhole.height
    above, at, below = undistortion.source_px(np.array(middle) + np.array([[0.0, -step], [0.0, 0.0], [0.0, step]]))[
        :, 1
    ]
    return float((below - above) * pinhole.height / (2 * step) / height), float(at / height - 0.5)


_LOCAL_METRES = (
    'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'
)

_LOCAL_UNITS = 'LOCAL_CS["Local Coordinates",LOCAL_DATUM["Local Datum",0],UNIT["unknown",1]]'


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
    """Write cameras and points as Bundler's ``bundle.out`` (v0.3), and the list of its images.

    One focal length, no distortion; cameras look along -z with y up; observations count from the image's middle,
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


#: Content of ``transforms.json`` with how the camera moved.
_AddMotion = Callable[[dict[str, Any], ExportContent], dict[str, Any]]


@dataclass(frozen=True, kw_only=True)
class ExportTarget:
    """A program, or a format.

    Attributes
    ----------
    write
        Writes all but ``images/`` into a folder.
    says
        How metres and up stay, or what is there.
    command
        What the program is called with; ``{folder}`` is the export. Empty for a format.
    pictures
        Whether ``images/`` is written.
    has_images, has_points
        Whether images and points of the model are in what is written.
    recentres
        Whether a model far from the origin is brought to it, as the program calculates in single precision.
    square
        Whether pixels must be square.
    require
        Raises :class:`MissingExtraError` where a package is missing.
    """

    write: Callable[[ExportContent, Path], None]
    says: str
    command: str = ""
    pictures: bool = True
    has_images: bool = True
    has_points: bool = True
    recentres: bool = False
    square: bool = False
    require: Callable[[], None] = lambda: None

    def command_line(self, folder: Path) -> str:
        """Command line that starts a program on an export; empty for a format."""
        return self.command.format(folder=shlex.quote(str(folder)))


def _write_ply(content: ExportContent, folder: Path) -> None:
    unit = "metres" if content.is_metric else "unknown, not metres"
    up = " ".join(f"{value:.6g}" for value in content.up_in_world)
    doubles = content.offset is not None
    write_ply(folder / "points.ply", content.xyz, content.rgb, (f"unit: {unit}", f"up: {up}"), doubles=doubles)


def _write_las(content: ExportContent, folder: Path) -> None:
    write_las(folder / "points.las", content.xyz, content.rgb, content.on_map)


def _write_tum(content: ExportContent, folder: Path) -> None:
    source = content.source.found
    write_tum(folder / "trajectory.tum", smooth_path(source.trajectory, source.folder))


def _write_csv(content: ExportContent, folder: Path) -> None:
    originals = {new: old for old, new in content.names.items()}
    write_cameras(folder / "cameras.csv", content.views, content.source.motion, originals, content.on_map)


def _write_gltf(content: ExportContent, folder: Path) -> None:
    source = content.source.found
    path = None if source.trajectory is None else smooth_path(source.trajectory, source.folder)
    write_gltf(folder / "scene.glb", content.views, path, content.xyz, content.rgb, content.up_in_world, content.offset)


def _write_metashape(content: ExportContent, folder: Path) -> None:
    write_metashape(folder / "cameras.xml", content.views, metres=content.is_metric)


def _write_bundler(content: ExportContent, folder: Path) -> None:
    model = pinhole_model(content.source.model, content.cameras, content.names)
    write_bundler(folder / "bundle.out", folder / "list.txt", content.views, model)


def _write_for_trainers(content: ExportContent, folder: Path, add_motion: _AddMotion | None = None) -> None:
    """Model, points and ``transforms.json``."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    write_files(pinhole_model(content.source.model, content.cameras, content.names), sparse, ".bin")
    write_ply(folder / "sparse_pc.ply", content.xyz, content.rgb)
    values = transforms(content.views, content.xyz, content.up_in_world)
    write_json(folder / "transforms.json", values if add_motion is None else add_motion(values, content))


def _write_for_gsplat(content: ExportContent, folder: Path) -> None:
    """The same, and the poses between which gsplat draws rolling-shutter images."""
    _write_for_trainers(content, folder)
    motion = content.source.motion
    if motion is None or not motion.names or not (motion.readout_s or 0.0) > 0:
        return
    if all(picture.rectified for picture in content.pictures.values()):
        return
    if motion.readout_direction != "down":
        content.notes.append(Fact("no-row-poses", direction=motion.readout_direction))
        return
    exposures = exposures_of(content.source.model, content.source, content.pictures, content.cameras, [])
    named = {content.names[name]: exposure for name, exposure in exposures.items()}
    write_json(folder / "viewmats_rs.json", view_matrices(content.views, named))


def write_metadata(path: Path, offset: Array | None, *, metres: bool) -> None:
    """Write what was taken off all coordinates, as ContextCapture, Metashape and others have it: ``SRSOrigin``."""
    document = ElementTree.Element("ModelMetadata", version="1")
    ElementTree.SubElement(document, "SRS").text = _LOCAL_METRES if metres else _LOCAL_UNITS
    origin = np.zeros(3) if offset is None else offset
    ElementTree.SubElement(document, "SRSOrigin").text = ",".join(repr(value) for value in origin.tolist())
    ElementTree.indent(document)
    text = ElementTree.tostring(document, encoding="unicode")
    write_text(path, f'<?xml version="1.0" encoding="utf-8"?>\n{text}\n')


def _add_row_poses(values: dict[str, Any], content: ExportContent) -> dict[str, Any]:
    motion = content.source.motion
    if motion is None or not motion.names:
        content.notes.append(Fact("one-pose-each"))
        return values
    return add_row_poses(values, _exposures(content))


def _add_velocities(values: dict[str, Any], content: ExportContent) -> dict[str, Any]:
    exposures = _exposures(content)
    left_out, count = len(content.names) - len(exposures), len(content.names)
    if left_out:
        content.notes.append(Fact("images-without-velocity", left_out=left_out, images=count))
    return add_velocities(values, exposures)


def _exposures(content: ExportContent) -> dict[str, Exposure]:
    """Exposures by the new names."""
    source = content.source
    exposures = exposures_of(source.model, source, content.pictures, content.cameras, content.notes)
    return {content.names[name]: exposure for name, exposure in exposures.items()}


_NERFSTUDIO = (
    "ns-train {method} --data {folder} nerfstudio-data --orientation-method none --center-method none "
    "--auto-scale-poses False --load-3D-points True"
)

#: What all splatting and NeRF trainers read.
TRAINERS = ExportTarget(write=_write_for_trainers, says="", recentres=True)

#: By name: each stands here, and among the choices of ``--for`` (``core.options.ExportProgram``).
TARGETS: Mapping[ExportProgram, ExportTarget] = {
    "metashape": ExportTarget(
        write=_write_metashape,
        says="add the images in images/ to a chunk, then File > Import > Import Cameras, cameras.xml: its local "
        "coordinates are those of the model",
    ),
    "bundler": ExportTarget(
        write=_write_bundler,
        says="bundle.out (v0.3) and list.txt; square pixels, observations counted from the middle upwards",
        square=True,
    ),
    "ply": ExportTarget(write=_write_ply, says="points.ply is in the model's world", pictures=False, has_images=False),
    "las": ExportTarget(
        write=_write_las,
        says="points.las is in the model's world, without a coordinate system",
        pictures=False,
        has_images=False,
        require=require_laspy,
    ),
    "tum": ExportTarget(
        write=_write_tum,
        says="trajectory.tum has the smoothed path: t_s x y z qx qy qz qw",
        pictures=False,
        has_images=False,
        has_points=False,
    ),
    "csv": ExportTarget(
        write=_write_csv,
        says="cameras.csv has time, pose and velocities of each image",
        pictures=False,
        has_points=False,
    ),
    "gltf": ExportTarget(
        write=_write_gltf,
        says="scene.glb is in the model's unit; its root turns up to +y, as glTF has it",
        pictures=False,
        require=require_pygltflib,
    ),
    "3dgs": ExportTarget(
        recentres=True,
        write=_write_for_trainers,
        command="python train.py -s {folder}",
        says="metres and up are kept without any option",
    ),
    "gsplat": ExportTarget(
        recentres=True,
        write=_write_for_gsplat,
        command="python examples/simple_trainer.py default --data-dir {folder} --data-factor 1 "
        "--no-normalize-world-space --result-dir {folder}_gsplat",
        says="--no-normalize-world-space keeps metres and up",
    ),
    "nerfstudio": ExportTarget(
        recentres=True,
        write=_write_for_trainers,
        command=_NERFSTUDIO.replace("{method}", "splatfacto"),
        says="these options keep metres and up; without them, dataparser_transforms.json converts back",
    ),
    "brush": ExportTarget(
        recentres=True,
        write=_write_for_trainers,
        command="brush {folder}",
        says="metres and up are kept without any option",
    ),
    "opensplat": ExportTarget(
        recentres=True,
        write=_write_for_trainers,
        command="opensplat {folder} --keep-crs",
        says="--keep-crs keeps metres and up",
    ),
    "instant-ngp": ExportTarget(
        recentres=True,
        write=partial(_write_for_trainers, add_motion=_add_row_poses),
        command="instant-ngp {folder}/transforms.json",
        says="p = (p' - offset) / scale converts back to metres, with scale and offset of transforms.json",
    ),
    "3dgs-deblur": ExportTarget(
        recentres=True,
        write=partial(_write_for_trainers, add_motion=_add_velocities),
        command=_NERFSTUDIO.replace("{method}", "splatfacto --pipeline.model.blur-samples 5"),
        says="these options keep metres and up; velocities are in m/s and rad/s",
    ),
}
