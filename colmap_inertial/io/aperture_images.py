"""The ``[apertures]`` table of a capture.toml: the sub-images of a multi-aperture camera and their calibration.

.. code-block:: toml

    [images]
    folder = "green"                # the reference's pictures; their names and times are the exposures'
    times = "frames.csv"

    [apertures]
    calibration = "camchain.yaml"   # Kalibr, OpenCV, COLMAP's rig_config.json, or a COLMAP model with rigs.bin
    unit = "mm"                     # of OpenCV's T or COLMAP's lengths, where they are not metres: m, mm

    [apertures.green]               # the first one is the reference: fused frames are seen through it
    role = "green"                  # red, green, blue, luminance, other
    camera = "cam0"                 # its name in the calibration; by default the aperture's

    [apertures.red]                 # the second one is its partner: disparities are shifts between these two
    role = "red"
    camera = "cam1"
    folder = "red"                  # pictures of the same names here; by default the folder of [images]
    rename = ["_1.", "_2."]         # or: the reference's "IMG_0007_1.tif" is "IMG_0007_2.tif" here
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.geometry import quat_from_matrix
from colmap_inertial.core.types import Aperture, ApertureRig, CameraModel, SpectralRole
from colmap_inertial.io.images import SUFFIXES, read_image
from colmap_inertial.io.names import path_in
from colmap_inertial.io.rig_calibration import Metres, MountedCamera, read_rig_calibration
from colmap_inertial.io.toml_section import Section


@dataclass(frozen=True, kw_only=True)
class SubImages:
    """Where one aperture's pictures are.

    Attributes
    ----------
    folder
        Of the pictures.
    rename
        What in the reference's file name is replaced by what; ``None`` where names are the same.
    """

    folder: Path
    rename: tuple[str, str] | None = None

    def path(self, name: str) -> Path:
        """The picture that belongs to a picture of the reference."""
        if self.rename is None:
            return path_in(self.folder, name)
        old, new = self.rename
        if old not in name:
            raise FormatError(self.folder, f'"{old}" of rename does not occur in the reference\'s file name {name!r}')
        head, _, tail = name.rpartition(old)
        return path_in(self.folder, f"{head}{new}{tail}")


@dataclass(frozen=True, eq=False, kw_only=True)
class ApertureImages:
    """A multi-aperture camera and its pictures.

    Attributes
    ----------
    rig
        The calibrated apertures, the reference first.
    sources
        Where each one's pictures are, in the rig's order.
    """

    rig: ApertureRig
    sources: tuple[SubImages, ...]

    def files(self, names: Iterable[str]) -> list[Path]:
        """The pictures of all apertures but the reference, for fingerprints."""
        return [source.path(name) for name in names for source in self.sources[1:]]


def read_rename(table: Section) -> tuple[str, str] | None:
    """The key ``rename``: what in a file name is replaced by what."""
    texts = table.raw("rename")
    if texts is None:
        return None
    if not (isinstance(texts, list) and len(texts) == 2 and all(isinstance(text, str) and text for text in texts)):
        table.fail("rename", f"must be two texts, what is replaced by what; found {texts!r}")
    return texts[0], texts[1]


def read_apertures_table(table: Section, images: Path | None) -> ApertureImages:
    """The ``[apertures]`` table.

    Parameters
    ----------
    images
        Folder of the reference's pictures.

    Raises
    ------
    FormatError
        Where the calibration cannot be read, lacks a camera, or knows no size and there is no picture.
    """
    if images is None:
        table.fail(None, "belongs to [images], the folder of the reference's pictures, which is missing")
    names = [key for key in table.names() if isinstance(table.raw(key), dict)]
    table.require_known(["calibration", "unit", *names])
    calibration = table.require("calibration", table.file("calibration"))
    units: tuple[Metres, ...] = get_args(Metres)
    unit = table.choice("unit", units)
    if len(names) < 2:
        table.fail(None, f"needs two or more apertures, each a table [apertures.NAME]; found {len(names)}")
    known = read_rig_calibration(calibration, unit=unit)
    roles: tuple[SpectralRole, ...] = get_args(SpectralRole)
    apertures: list[Aperture] = []
    sources: list[SubImages] = []
    for i, name in enumerate(names):
        part = table.table(name)
        part.require_known(["role", "camera", "folder", "rename"])
        role = part.require("role", part.choice("role", roles))
        camera = known.camera(part.text("camera") or name)
        folder = part.file("folder")
        rename = read_rename(part)
        if i == 0 and (rename is not None or (folder is not None and folder != images)):
            part.fail("folder", "is that of [images] for the reference, the first aperture; leave it and rename out")
        source = SubImages(folder=folder or images, rename=rename)
        if i > 0 and source == sources[0]:
            part.fail(None, "has the same pictures as the reference; give folder or rename")
        sources.append(source)
        apertures.append(_aperture(name, role, camera, source, names=sources[0].folder))
    try:
        rig = ApertureRig(apertures=tuple(apertures), length_unit=known.length_unit)
    except ValueError as error:
        raise FormatError(calibration, str(error)) from None
    return ApertureImages(rig=rig, sources=tuple(sources))


def _aperture(name: str, role: SpectralRole, camera: MountedCamera, source: SubImages, *, names: Path) -> Aperture:
    size = camera.size or _size_of_first(source, names)
    rotation = camera.cam_from_rig[:3, :3]
    try:
        model = CameraModel(model=camera.model, width=size[0], height=size[1], params=camera.params)
    except ValueError as error:
        raise FormatError(source.folder, f"{name}: {error}") from None
    return Aperture(
        name=name,
        role=role,
        camera=model,
        cam_from_rig_xyzw=quat_from_matrix(rotation),
        cam_in_rig=np.asarray(-rotation.T @ camera.cam_from_rig[:3, 3]),
    )


def _size_of_first(source: SubImages, names: Path) -> tuple[int, int]:
    """Width and height of an aperture's first picture, where the calibration gives none."""
    found = sorted(p.name for p in names.iterdir() if p.suffix.lower() in SUFFIXES) if names.is_dir() else []
    for name in found:
        if source.rename is None or source.rename[0] in name:
            height, width = read_image(source.path(name)).shape[:2]
            return width, height
    raise FormatError(names, "holds no picture that would give the size, which the calibration does not")
