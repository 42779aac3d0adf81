"""What each program is called with so that metres and up stay."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from colmap_inertial.core.options import ExportProgram


@dataclass(frozen=True, kw_only=True)
class Program:
    """A program, or a format.

    Attributes
    ----------
    command
        What it is called with; ``{folder}`` is the export. Empty for a format.
    says
        How metres and up stay, or what is there.
    """

    command: str = ""
    says: str


_NERFSTUDIO = (
    "ns-train {method} --data {folder} nerfstudio-data --orientation-method none --center-method none "
    "--auto-scale-poses False --load-3D-points True"
)

PROGRAMS: Mapping[ExportProgram, Program] = {
    "metashape": Program(
        says="add the pictures of images/ to a chunk, then File > Import > Import Cameras, cameras.xml: its local "
        "coordinates are those of the model",
    ),
    "bundler": Program(
        says="bundle.out (v0.3) and list.txt; square pixels, observations counted from the middle upwards",
    ),
    "ply": Program(says="points.ply is in the model's world"),
    "las": Program(says="points.las is in the model's world, without a coordinate system"),
    "tum": Program(says="trajectory.tum has the smoothed path: t_s x y z qx qy qz qw"),
    "csv": Program(says="cameras.csv has time, pose and velocities of each image"),
    "gltf": Program(says="scene.glb is in the model's unit; its root turns up to +y, as glTF has it"),
    "3dgs": Program(
        command="python train.py -s {folder}",
        says="nothing is needed for metres and up to stay",
    ),
    "gsplat": Program(
        command="python examples/simple_trainer.py default --data-dir {folder} --data-factor 1 "
        "--no-normalize-world-space --result-dir {folder}_gsplat",
        says="metres and up stay by --no-normalize-world-space",
    ),
    "nerfstudio": Program(
        command=_NERFSTUDIO.replace("{method}", "splatfacto"),
        says="metres and up stay by these options; without them, dataparser_transforms.json leads back",
    ),
    "brush": Program(command="brush {folder}", says="nothing is needed for metres and up to stay"),
    "opensplat": Program(command="opensplat {folder} --keep-crs", says="metres and up stay by --keep-crs"),
    "instant-ngp": Program(
        command="instant-ngp {folder}/transforms.json",
        says="p = (p' - offset) / scale leads back to metres, with scale and offset of transforms.json",
    ),
    "3dgs-deblur": Program(
        command=_NERFSTUDIO.replace("{method}", "splatfacto --pipeline.model.blur-samples 5"),
        says="metres and up stay by these options; velocities are in m/s and rad/s",
    ),
}


def command_line(program: ExportProgram, folder: Path) -> str:
    """What a program is called with for an export; empty for a format."""
    known = PROGRAMS.get(program)
    return "" if known is None else known.command.format(folder=shlex.quote(str(folder)))
