"""What an export can be for: one value for each program or format, which says what it writes."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from colmap_inertial.core.options import ExportProgram
from colmap_inertial.io.files import write_json
from colmap_inertial.io.trajectories import write_tum
from colmap_inertial.model import write_files
from colmap_inertial.tools.export.cameras import write_bundler, write_metashape
from colmap_inertial.tools.export.content import ExportContent
from colmap_inertial.tools.export.exposures import exposures_of
from colmap_inertial.tools.export.paths import require_pygltflib, smoothed_path, write_cameras, write_gltf
from colmap_inertial.tools.export.pinhole_model import pinhole_model
from colmap_inertial.tools.export.points import require_laspy, write_las, write_ply
from colmap_inertial.tools.export.transforms import Exposure, transforms, with_row_poses, with_velocities

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
    square: bool = False
    require: Callable[[], None] = lambda: None

    def command_line(self, folder: Path) -> str:
        """What a program is called with for an export; empty for a format."""
        return self.command.format(folder=shlex.quote(str(folder)))


def _write_ply(content: ExportContent, folder: Path) -> None:
    unit = "metres" if content.is_metric else "unknown, not metres"
    up = " ".join(f"{value:.6g}" for value in content.up_in_world)
    write_ply(folder / "points.ply", content.xyz, content.rgb, (f"unit: {unit}", f"up: {up}"))


def _write_las(content: ExportContent, folder: Path) -> None:
    write_las(folder / "points.las", content.xyz, content.rgb, content.on_map)


def _write_tum(content: ExportContent, folder: Path) -> None:
    found = content.source.found
    write_tum(folder / "trajectory.tum", smoothed_path(found.trajectory, found.folder))


def _write_csv(content: ExportContent, folder: Path) -> None:
    originals = {new: old for old, new in content.names.items()}
    write_cameras(folder / "cameras.csv", content.views, content.source.motion, originals, content.on_map)


def _write_gltf(content: ExportContent, folder: Path) -> None:
    found = content.source.found
    path = None if found.trajectory is None else smoothed_path(found.trajectory, found.folder)
    write_gltf(folder / "scene.glb", content.views, path, content.xyz, content.rgb, content.up_in_world)


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


def _add_row_poses(values: dict[str, Any], content: ExportContent) -> dict[str, Any]:
    motion = content.source.motion
    if motion is None or not motion.names:
        content.notes.append("no velocities are known: each picture has one pose, as if it was taken in an instant")
        return values
    return with_row_poses(values, _exposures(content))


def _add_velocities(values: dict[str, Any], content: ExportContent) -> dict[str, Any]:
    exposures = _exposures(content)
    left_out, count = len(content.names) - len(exposures), len(content.names)
    if left_out:
        content.notes.append(f"{left_out} of {count} images have no velocity and are left out of transforms.json")
    return with_velocities(values, exposures)


def _exposures(content: ExportContent) -> dict[str, Exposure]:
    """By the new names."""
    source = content.source
    exposures = exposures_of(source.model, source, content.pictures, content.cameras, content.notes)
    return {content.names[name]: exposure for name, exposure in exposures.items()}


_NERFSTUDIO = (
    "ns-train {method} --data {folder} nerfstudio-data --orientation-method none --center-method none "
    "--auto-scale-poses False --load-3D-points True"
)

#: What all splatting and NeRF trainers read.
TRAINERS = ExportTarget(write=_write_for_trainers, says="")

#: By name: each stands here, and among the choices of ``--for`` (``core.options.ExportProgram``).
TARGETS: Mapping[ExportProgram, ExportTarget] = {
    "metashape": ExportTarget(
        write=_write_metashape,
        says="add the pictures of images/ to a chunk, then File > Import > Import Cameras, cameras.xml: its local "
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
        write=_write_for_trainers,
        command="python train.py -s {folder}",
        says="nothing is needed for metres and up to stay",
    ),
    "gsplat": ExportTarget(
        write=_write_for_trainers,
        command="python examples/simple_trainer.py default --data-dir {folder} --data-factor 1 "
        "--no-normalize-world-space --result-dir {folder}_gsplat",
        says="metres and up stay by --no-normalize-world-space",
    ),
    "nerfstudio": ExportTarget(
        write=_write_for_trainers,
        command=_NERFSTUDIO.replace("{method}", "splatfacto"),
        says="metres and up stay by these options; without them, dataparser_transforms.json leads back",
    ),
    "brush": ExportTarget(
        write=_write_for_trainers, command="brush {folder}", says="nothing is needed for metres and up to stay"
    ),
    "opensplat": ExportTarget(
        write=_write_for_trainers, command="opensplat {folder} --keep-crs", says="metres and up stay by --keep-crs"
    ),
    "instant-ngp": ExportTarget(
        write=partial(_write_for_trainers, add_motion=_add_row_poses),
        command="instant-ngp {folder}/transforms.json",
        says="p = (p' - offset) / scale leads back to metres, with scale and offset of transforms.json",
    ),
    "3dgs-deblur": ExportTarget(
        write=partial(_write_for_trainers, add_motion=_add_velocities),
        command=_NERFSTUDIO.replace("{method}", "splatfacto --pipeline.model.blur-samples 5"),
        says="metres and up stay by these options; velocities are in m/s and rad/s",
    ),
}
