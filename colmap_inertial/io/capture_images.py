"""Tables of a capture.toml for images beside the frames: ``[apertures]`` and ``[exposures]``.

The sub-images of a multi-aperture camera and their calibration:

.. code-block:: toml

    [images]
    folder = "green"                # the reference's images; their names and times are the exposures'
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
    folder = "red"                  # images of the same names here; by default the folder of [images]
    rename = ["_1.", "_2."]         # or: the reference's "IMG_0007_1.tif" is "IMG_0007_2.tif" here

A long exposure beside each short one:

.. code-block:: toml

    [images]
    folder = "short"                # the short exposures; their names and times are the frames'
    times = "frames.csv"

    [exposures]
    folder = "long"                 # the long ones: images of the same names here, whatever their endings
    rename = ["_short.", "_long."]  # or: "IMG_7_short.jpg" is "IMG_7_long.jpg" there
    times = "long.csv"              # columns name,t_s and, best, exposure_s, on the clock of the short ones' times
    time_unit = "ns"                # of times, where the header does not say

    long_delay_s = 0.012            # or, in place of times: start of the long exposure minus start of the short one
    long_exposure_s = 0.1           # one for all, where times has no column of it
    short_iso = 1600                # sensitivities, where the pictures' EXIF does not state them
    long_iso = 100
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_from_matrix
from colmap_inertial.core.types import Aperture, ApertureRig, CameraModel, FrameTiming, SpectralRole
from colmap_inertial.io.exif import HEAD_BYTES, exposure_of
from colmap_inertial.io.files import path_in, read_bytes
from colmap_inertial.io.frame_times import stamps_of_csv
from colmap_inertial.io.images import SUFFIXES, read_image
from colmap_inertial.io.rig_calibration import Metres, MountedCamera, read_rig_calibration
from colmap_inertial.io.toml_section import Section
from colmap_inertial.io.units import TIME_UNITS_NS, seconds


@dataclass(frozen=True, kw_only=True)
class SubImages:
    """Location of one aperture's images.

    Attributes
    ----------
    folder
        Of the images.
    rename
        What in the reference's file name is replaced by what; ``None`` where names are the same.
    """

    folder: Path
    rename: tuple[str, str] | None = None

    def path(self, name: str) -> Path:
        """The image that belongs to an image of the reference."""
        if self.rename is None:
            return path_in(self.folder, name)
        old, new = self.rename
        if old not in name:
            raise FormatError(self.folder, Fact("rename-fits-not", old=old, name=name))
        head, _, tail = name.rpartition(old)
        return path_in(self.folder, f"{head}{new}{tail}")


@dataclass(frozen=True, eq=False, kw_only=True)
class ApertureImages:
    """A multi-aperture camera and its images.

    Attributes
    ----------
    rig
        The calibrated apertures, the reference first.
    sources
        Where each one's images are, in the rig's order.
    """

    rig: ApertureRig
    sources: tuple[SubImages, ...]

    def files(self, names: Iterable[str]) -> list[Path]:
        """The images of all apertures but the reference, for fingerprints."""
        return [source.path(name) for name in names for source in self.sources[1:]]


def read_rename(table: Section) -> tuple[str, str] | None:
    """The key ``rename``: what in a file name is replaced by what."""
    texts = table.raw("rename")
    if texts is None:
        return None
    if not (isinstance(texts, list) and len(texts) == 2 and all(isinstance(text, str) and text for text in texts)):
        table.fail("rename", Fact("not-a-rename", found=repr(texts)))
    return texts[0], texts[1]


def read_apertures_table(table: Section, images: Path | None) -> ApertureImages:
    """The ``[apertures]`` table.

    Parameters
    ----------
    images
        Folder of the reference's images.

    Raises
    ------
    FormatError
        Where the calibration cannot be read, lacks a camera, or knows no size and there is no image.
    """
    if images is None:
        table.fail(None, Fact("reference-pictures-missing"))
    names = [key for key in table.names() if isinstance(table.raw(key), dict)]
    table.require_known(["calibration", "unit", *names])
    calibration = table.require("calibration", table.file("calibration"))
    units: tuple[Metres, ...] = get_args(Metres)
    unit = table.choice("unit", units)
    if len(names) < 2:
        table.fail(None, Fact("apertures-too-few", found=len(names)))
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
            part.fail("folder", Fact("reference-in-other-folder"))
        source = SubImages(folder=folder or images, rename=rename)
        if i > 0 and source == sources[0]:
            part.fail(None, Fact("same-pictures-as-reference"))
        sources.append(source)
        apertures.append(_aperture(name, role, camera, source, names=sources[0].folder))
    try:
        rig = ApertureRig(apertures=tuple(apertures), length_unit=known.length_unit)
    except ValueError as error:
        raise FormatError(calibration, Fact("invalid-values", detail=str(error))) from None
    return ApertureImages(rig=rig, sources=tuple(sources))


def _aperture(name: str, role: SpectralRole, camera: MountedCamera, source: SubImages, *, names: Path) -> Aperture:
    size = camera.size or _size_of_first(source, names)
    rotation = camera.cam_from_rig[:3, :3]
    try:
        model = CameraModel(model=camera.model, width=size[0], height=size[1], params=camera.params)
    except ValueError as error:
        raise FormatError(
            source.folder, Fact("wrong-entry", entry=name, fault=Fact("invalid-values", detail=str(error)))
        ) from None
    return Aperture(
        name=name,
        role=role,
        camera=model,
        cam_from_rig_xyzw=quat_from_matrix(rotation),
        cam_in_rig=np.asarray(-rotation.T @ camera.cam_from_rig[:3, 3]),
    )


def _size_of_first(source: SubImages, names: Path) -> tuple[int, int]:
    """Width and height of an aperture's first image, where the calibration gives none."""
    image_names = sorted(p.name for p in names.iterdir() if p.suffix.lower() in SUFFIXES) if names.is_dir() else []
    for name in image_names:
        if source.rename is None or source.rename[0] in name:
            height, width = read_image(source.path(name)).shape[:2]
            return width, height
    raise FormatError(names, Fact("no-picture-of-size"))


#: A long exposure that starts farther from its short one is that of another, or timed by another clock.
_FARTHEST_S = 10.0


@dataclass(frozen=True, eq=False, kw_only=True)
class LongTiming:
    """Times of the long exposures.

    Attributes
    ----------
    names
        (F,) of the short ones that they belong to.
    t_s
        (F,) start of exposure of row 0, on the clock of the short ones.
    exposure_s
        (F,).
    """

    names: tuple[str, ...]
    t_s: Array
    exposure_s: Array


@dataclass(frozen=True, kw_only=True)
class LongExposures:
    """The long exposures beside a folder of short ones.

    Attributes
    ----------
    source
        Where they are.
    times, time_unit
        A CSV with their times, and its unit where the header does not say.
    delay_s
        In place of ``times``: start of the long exposure minus start of the short one.
    exposure_s
        Of all; ``None`` where ``times`` has it or it is unknown.
    short_iso, long_iso
        Sensitivities; ``None`` where only the EXIF may know.
    """

    source: SubImages
    times: Path | None = None
    time_unit: str | None = None
    delay_s: float | None = None
    exposure_s: float | None = None
    short_iso: float | None = None
    long_iso: float | None = None

    def path(self, name: str) -> Path:
        """The long exposure that belongs to a short one.

        Raises
        ------
        FormatError
            Where there is none.
        """
        if self.source.rename is not None and self.source.rename[0] not in name:
            raise FormatError(
                self.source.folder, Fact("short-exposure-not-renamed", old=self.source.rename[0], name=name)
            )
        wanted = self.source.path(name)
        if wanted.is_file():
            return wanted
        for suffix in (*SUFFIXES, *(suffix.upper() for suffix in SUFFIXES)):
            if wanted.with_suffix(suffix).is_file():
                return wanted.with_suffix(suffix)
        raise FormatError(wanted, Fact("long-exposure-missing", name=name))

    def files(self, names: Sequence[str]) -> list[Path]:
        """The long exposures of all short ones.

        Raises
        ------
        FormatError
            Where one is missing.
        """
        return [self.path(name) for name in names]

    def timing(self, short: FrameTiming) -> LongTiming | None:
        """Times of the long exposures; ``None`` where their start or their exposure time is unknown.

        Raises
        ------
        FormatError, TimingError
            Where ``times`` cannot be read, lacks one of them, or is of another clock.
        """
        if self.times is None:
            if self.delay_s is None or self.exposure_s is None:
                return None
            exposures_s = np.full(len(short.names), self.exposure_s)
            return LongTiming(names=short.names, t_s=short.t_s + self.delay_s, exposure_s=exposures_s)
        stamps = stamps_of_csv(self.times, self.time_unit)
        place = {name: i for i, name in enumerate(stamps.names)}
        rows = []
        for name in short.names:
            own = self.path(name).relative_to(self.source.folder).as_posix()
            if own not in place:
                raise TimingError(Fact("long-exposure-without-time", times=str(self.times), name=own, short=name))
            rows.append(place[own])
        t_s = seconds(stamps.t_ns[rows], short.epoch_ns)
        far = np.flatnonzero(np.abs(t_s - short.t_s) > _FARTHEST_S)
        if len(far):
            i = int(far[0])
            raise TimingError(
                Fact("long-exposure-far", times=str(self.times), short=short.names[i], late_s=t_s[i] - short.t_s[i])
            )
        exposure_s = None if stamps.exposure_s is None else stamps.exposure_s[rows]
        if exposure_s is None and self.exposure_s is not None:
            exposure_s = np.full(len(rows), self.exposure_s)
        return None if exposure_s is None else LongTiming(names=short.names, t_s=t_s, exposure_s=exposure_s)

    def stated_gain(
        self, short: Path, long: Path, *, short_exposure_s: float | None = None, long_exposure_s: float | None = None
    ) -> float | None:
        """Light of a long exposure over that of its short one, by exposure times and sensitivities.

        What is not given is looked for in the EXIF of the images; ``None`` where one of the four is unknown.
        """
        values = []
        for path, exposure_s, iso in (
            (short, short_exposure_s, self.short_iso),
            (long, long_exposure_s or self.exposure_s, self.long_iso),
        ):
            if exposure_s is None or iso is None:
                by_exif = exposure_of(read_bytes(path, HEAD_BYTES, what="picture"))
                exposure_s, iso = exposure_s or by_exif[0], iso or by_exif[1]
            if not exposure_s or not iso:
                return None
            values.append(exposure_s * iso)
        return values[1] / values[0]


EXPOSURES_KEYS = (
    *("folder", "rename", "times", "time_unit", "long_delay_s"),
    *("long_exposure_s", "short_iso", "long_iso"),
)


def read_exposures_table(table: Section, images: Path | None) -> LongExposures:
    """The ``[exposures]`` table.

    Parameters
    ----------
    images
        Folder of the short exposures.

    Raises
    ------
    FormatError
        For what is missing or contradicts itself.
    """
    if images is None:
        table.fail(None, Fact("short-exposures-missing"))
    times = table.file("times")
    delay_s = table.number("long_delay_s", low=-_FARTHEST_S, high=_FARTHEST_S)
    exposure_s = table.positive("long_exposure_s")
    source = SubImages(folder=table.file("folder") or images, rename=read_rename(table))
    if source == SubImages(folder=images):
        table.fail(None, Fact("same-pictures-as-images"))
    if times is not None and delay_s is not None:
        table.fail("long_delay_s", Fact("delay-beside-times"))
    if exposure_s is not None and exposure_s > 10:
        table.fail("long_exposure_s", Fact("not-in-range", low=0.0, high=10.0, found=repr(exposure_s)))
    return LongExposures(
        source=source,
        times=times,
        time_unit=table.choice("time_unit", TIME_UNITS_NS),
        delay_s=delay_s,
        exposure_s=exposure_s,
        short_iso=table.positive("short_iso"),
        long_iso=table.positive("long_iso"),
    )
