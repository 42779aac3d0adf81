"""What each program is called with so that metres and up stay."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from colmap_inertial.options import ExportProgram


@dataclass(frozen=True, kw_only=True)
class Program:
    """A program, or a format.

    Attributes
    ----------
    title
        Its name.
    command
        What it is called with; ``{folder}`` is the export. Empty for a format.
    says
        How metres and up stay, or what is there.
    """

    title: str
    command: str = ""
    says: str


_NERFSTUDIO = (
    "ns-train {method} --data {folder} nerfstudio-data --orientation-method none --center-method none "
    "--auto-scale-poses False --load-3D-points True"
)

PROGRAMS: Mapping[ExportProgram, Program] = {
    "metashape": Program(
        title="Agisoft Metashape",
        says="add the pictures of images/ to a chunk, then File > Import > Import Cameras, cameras.xml: its local "
        "coordinates are in metres, z up",
    ),
    "bundler": Program(
        title="Bundler",
        says="bundle.out (v0.3) and list.txt; square pixels, observations counted from the middle upwards",
    ),
    "ply": Program(title="points as PLY", says="points.ply is in the model's world"),
    "las": Program(title="points as LAS", says="points.las is in the model's world, without a coordinate system"),
    "tum": Program(title="path as TUM text", says="trajectory.tum has the smoothed path: t_s x y z qx qy qz qw"),
    "csv": Program(title="cameras as CSV", says="cameras.csv has time, pose and velocities of each image"),
    "gltf": Program(
        title="cameras, path and points as glTF", says="scene.glb is in metres; its root turns up to +y, as glTF has it"
    ),
    "3dgs": Program(
        title="3D Gaussian Splatting (INRIA)",
        command="python train.py -s {folder}",
        says="nothing is needed for metres and up to stay",
    ),
    "gsplat": Program(
        title="gsplat, simple_trainer",
        command="python examples/simple_trainer.py default --data-dir {folder} --data-factor 1 "
        "--no-normalize-world-space --result-dir {folder}_gsplat",
        says="metres and up stay by --no-normalize-world-space",
    ),
    "nerfstudio": Program(
        title="nerfstudio",
        command=_NERFSTUDIO.replace("{method}", "splatfacto"),
        says="metres and up stay by these options; without them, dataparser_transforms.json leads back",
    ),
    "brush": Program(title="Brush", command="brush {folder}", says="nothing is needed for metres and up to stay"),
    "opensplat": Program(
        title="OpenSplat", command="opensplat {folder} --keep-crs", says="metres and up stay by --keep-crs"
    ),
    "instant-ngp": Program(
        title="instant-ngp",
        command="instant-ngp {folder}/transforms.json",
        says="p = (p' - offset) / scale leads back to metres, with scale and offset of transforms.json",
    ),
    "3dgs-deblur": Program(
        title="3dgs-deblur (a fork of nerfstudio)",
        command=_NERFSTUDIO.replace("{method}", "splatfacto --pipeline.model.blur-samples 5"),
        says="metres and up stay by these options; velocities are in m/s and rad/s",
    ),
}


def command_line(program: ExportProgram, folder: Path) -> str:
    """What a program is called with for an export; empty for a format."""
    known = PROGRAMS.get(program)
    return "" if known is None else known.command.format(folder=shlex.quote(str(folder)))
