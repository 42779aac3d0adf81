"""The export from beginning to end: one folder, whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial import __version__
from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.core.errors import OutputError
from colmap_inertial.core.options import ExportImages, ExportProgram
from colmap_inertial.inertial.georeference import Georeference
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.files import StrPath, write_json
from colmap_inertial.io.frames import read_frames
from colmap_inertial.io.trajectories import write_tum
from colmap_inertial.model import write_files
from colmap_inertial.model.copying import new_folder
from colmap_inertial.model.nerf import EXPORT_FORMAT, NO_SCALE, NO_UP, NOT_METRES
from colmap_inertial.pipeline.run.progress import Progress, silent
from colmap_inertial.reconstruction.drivers.georeference import cameras_as_json
from colmap_inertial.tools.export.cameras import write_bundler, write_metashape
from colmap_inertial.tools.export.exposures import exposures_of
from colmap_inertial.tools.export.names import flat_names
from colmap_inertial.tools.export.paths import require_pygltflib, smoothed_path, write_cameras, write_gltf
from colmap_inertial.tools.export.pictures import Job, write_pictures
from colmap_inertial.tools.export.pinhole_model import needed_cameras, pinhole_model
from colmap_inertial.tools.export.points import require_laspy, sparse_points, write_las, write_ply
from colmap_inertial.tools.export.programs import PROGRAMS, command_line
from colmap_inertial.tools.export.source import ExportSource, Picture, placed_on_earth, read_source
from colmap_inertial.tools.export.transforms import View, transforms, with_row_poses, with_velocities
from colmap_inertial.tools.export.undistort import Undistortion

#: Formats of points and paths.
_WITHOUT_PICTURES = ("ply", "las", "tum", "csv", "gltf")
#: What says up where gravity is unknown: z, as trainers' viewers have it.
_Z_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class Exported:
    """What :func:`export_model` wrote; ``export.json`` says the same.

    Attributes
    ----------
    folder
        The export.
    program
        What it is for; ``None`` for all trainers.
    command
        What the program is called with; empty where there is none.
    says
        How metres and up stay.
    model
        Number of the model, and of all beside it.
    others
        Numbers of all models of the run.
    unit
        ``"m"``, or ``"model"`` where there is no scale.
    images, points
        How many.
    notes
        What the user should know.
    """

    folder: Path
    program: ExportProgram | None
    command: str
    says: str
    model: int
    others: tuple[int, ...]
    unit: str
    images: int
    points: int
    notes: tuple[str, ...] = ()


def export_model(
    out: StrPath,
    folder: StrPath,
    program: ExportProgram | None = None,
    *,
    images: ExportImages = "rectified",
    model: int | None = None,
    image_folder: StrPath | None = None,
    capture: StrPath | None = None,
    georeference: bool = False,
    unscaled: bool = False,
    progress: Progress = silent,
) -> Exported:
    """Write a finished model as other programs read it, in metres and with the same up.

    Parameters
    ----------
    out
        What ``reconstruct`` or ``apply`` wrote, or a folder with a COLMAP model. Only read.
    folder
        New, or empty; it appears whole or not at all.
    program
        What it is for; ``None`` makes what all splatting and NeRF trainers read.
    images
        ``"rectified"``: the pictures that agree with the model; ``"original"``: those that COLMAP saw, with their
        rolling shutter.
    model
        Number of the model; ``None`` takes the largest.
    image_folder
        Folder with the model's pictures, where they are not beside it.
    capture
        The capture that the run was made of: with ``images="original"`` for frames that it deblurred or changed, with
        ``georeference`` for its positions.
    georeference
        Also say where on Earth everything is: ``georeference.json``, columns of ``cameras.csv``, and LAS points in UTM.
        As the run found it, else by the positions of the capture or of the pictures' EXIF.
    unscaled
        Export a model without a scale in its own units.
    progress
        Called with ``"export"``.

    Returns
    -------
    What was written, and the command line that keeps metres and up.

    Raises
    ------
    FormatError
        Where there is no model, a picture is missing or of another size, or a lens cannot be undistorted.
    NotObservableError
        Where the scale was refused; where ``program`` needs velocities and none were kept; where positions leave the
        heading open.
    OutputError
        Where ``folder`` holds something, lies within ``out``, or cannot be written.
    MissingExtraError
        Where a format needs a package that is not installed.
    """
    if capture is not None and images != "original" and not georeference:
        raise ValueError('capture goes with images="original" or georeference')
    out, folder = Path(out), Path(folder)
    inner, outer = folder.resolve(), out.resolve()
    if inner.is_relative_to(outer) or outer.is_relative_to(inner):
        raise OutputError(f"{folder} and {out} lie within each other; choose a folder elsewhere")
    for name, require in (("las", require_laspy), ("gltf", require_pygltflib)):
        if program == name:
            require()
    source = read_source(
        out, model=model, image_folder=None if image_folder is None else Path(image_folder), unscaled=unscaled
    )
    filmed = None if capture is None else load_capture(Path(capture))
    on_map = placed_on_earth(out, source, filmed) if georeference else None
    filmed = filmed if images == "original" else None
    work = _Work(out=out, source=source, program=program, capture=filmed, on_map=on_map)
    with new_folder(folder, into_empty=True) as partial:
        made = work.write(partial, images, progress)
        command = "" if program is None else command_line(program, folder)
        made = replace(made, folder=folder, command=command)
        write_json(partial / "export.json", work.record(made, images))
    return made


@dataclass(eq=False, kw_only=True)
class _Work:
    """One export."""

    out: Path
    source: ExportSource
    program: ExportProgram | None
    capture: Capture | None
    on_map: Georeference | None

    def __post_init__(self) -> None:
        self.model = self.source.model
        self.names = flat_names(self.model.image(i).name for i in self.model.reg_image_ids())

    @property
    def up_in_world(self) -> Array:
        """(3,) unit vector."""
        return _Z_UP if self.source.up_in_world is None else self.source.up_in_world

    def write(self, partial: Path, kind: ExportImages, progress: Progress) -> Exported:
        """All files but ``export.json``."""
        found, notes = self.source.found, self._notes()
        cameras = self._cameras(square=self.program == "bundler")
        views, (xyz, rgb) = self._views(cameras), sparse_points(self.model)
        if self.on_map is not None:
            centres = np.array([view.cam_in_world for view in views])
            named = tuple(view.name for view in views)
            content = {**self.on_map.as_json(), "cameras": cameras_as_json(self.on_map, named, centres)}
            write_json(partial / "georeference.json", content)
            notes += self.on_map.notes
        images = points = 0
        if self.program in _WITHOUT_PICTURES:
            self._write_format(partial, views, xyz, rgb)
            images = len(views) if self.program in ("csv", "gltf") else 0
            points = len(xyz) if self.program in ("ply", "las", "gltf") else 0
        else:
            pictures = self.source.pictures(self.out, list(self.names), kind, self.capture)
            notes += _notes_on(pictures, kind)
            images, points = len(views), len(xyz)
            (partial / "images").mkdir()
            if self.program == "metashape":
                write_metashape(partial / "cameras.xml", views, metres=found.scale.unit == "m")
            elif self.program == "bundler":
                model = pinhole_model(self.model, cameras, self.names)
                write_bundler(partial / "bundle.out", partial / "list.txt", views, model)
            else:
                self._write_for_trainers(partial, views, cameras, pictures, notes)
            self._write_pictures(partial / "images", cameras, pictures, progress)
        return Exported(
            folder=partial,
            program=self.program,
            command="",
            says="" if self.program is None else PROGRAMS[self.program].says,
            model=found.index,
            others=found.others,
            unit=found.scale.unit,
            images=images,
            points=points,
            notes=tuple(notes),
        )

    def _cameras(self, *, square: bool) -> dict[int, Undistortion]:
        where = self.source.found.folder
        return {i: Undistortion.of(self.model.camera(i), where, square=square) for i in needed_cameras(self.model)}

    def _write_format(self, partial: Path, views: list[View], xyz: Array, rgb: UInt8Array) -> None:
        """What needs no pictures."""
        found = self.source.found
        if self.program == "ply":
            unit = "metres" if found.scale.unit == "m" else "unknown, not metres"
            up = " ".join(f"{value:.6g}" for value in self.up_in_world)
            write_ply(partial / "points.ply", xyz, rgb, (f"unit: {unit}", f"up: {up}"))
        elif self.program == "las":
            write_las(partial / "points.las", xyz, rgb, self.on_map)
        elif self.program == "tum":
            write_tum(partial / "trajectory.tum", smoothed_path(found.trajectory, found.folder))
        elif self.program == "csv":
            originals = {new: old for old, new in self.names.items()}
            write_cameras(partial / "cameras.csv", views, self.source.motion, originals, self.on_map)
        else:
            smoothed = None if found.trajectory is None else smoothed_path(found.trajectory, found.folder)
            write_gltf(partial / "scene.glb", views, smoothed, xyz, rgb, self.up_in_world)

    def _write_for_trainers(
        self,
        partial: Path,
        views: list[View],
        cameras: Mapping[int, Undistortion],
        pictures: Mapping[str, Picture],
        notes: list[str],
    ) -> None:
        """Model, points and transforms."""
        (partial / "sparse" / "0").mkdir(parents=True)
        write_files(pinhole_model(self.model, cameras, self.names), partial / "sparse" / "0", ".bin")
        xyz, rgb = sparse_points(self.model)
        write_ply(partial / "sparse_pc.ply", xyz, rgb)
        content = transforms(views, xyz, self.up_in_world)
        if self.program in ("3dgs-deblur", "instant-ngp"):
            content = self._with_motion(content, pictures, cameras, notes)
        write_json(partial / "transforms.json", content)

    def _write_pictures(
        self, folder: Path, cameras: Mapping[int, Undistortion], pictures: Mapping[str, Picture], progress: Progress
    ) -> None:
        of_image = {image.name: image.camera_id for image in map(self.model.image, self.model.reg_image_ids())}

        def jobs() -> Iterator[Job]:
            for name, one in pictures.items():
                if not one.filmed:
                    yield Job(target=folder / self.names[name], source=one.path, undistortion=cameras[of_image[name]])
            filmed = {name for name, one in pictures.items() if one.filmed}
            if self.capture is not None and filmed:
                for frame in read_frames(self.capture, only=filmed)[1]:
                    yield Job(
                        target=folder / self.names[frame.name],
                        source=self.capture.path,
                        undistortion=cameras[of_image[frame.name]],
                        pixels=frame.image,
                    )

        write_pictures(jobs(), len(pictures), progress)

    def _views(self, cameras: Mapping[int, Undistortion]) -> list[View]:
        images = map(self.model.image, self.model.reg_image_ids())
        views = [
            View(
                name=self.names[image.name],
                camera=cameras[image.camera_id].pinhole,
                cam_from_world_xyzw=np.array(image.cam_from_world().rotation.quat),
                cam_in_world=np.array(image.projection_center()),
            )
            for image in images
        ]
        return sorted(views, key=lambda view: view.name)

    def _with_motion(
        self,
        content: dict[str, Any],
        pictures: Mapping[str, Picture],
        cameras: Mapping[int, Undistortion],
        notes: list[str],
    ) -> dict[str, Any]:
        motion = self.source.motion
        if self.program == "instant-ngp" and (motion is None or not motion.names):
            notes.append("no velocities are known: each picture has one pose, as if it was taken in an instant")
            return content
        exposures = exposures_of(self.model, self.source, pictures, cameras, notes)
        named = {self.names[name]: one for name, one in exposures.items()}
        if self.program == "instant-ngp":
            return with_row_poses(content, named)
        left_out = len(self.names) - len(named)
        if left_out:
            notes.append(f"{left_out} of {len(self.names)} images have no velocity and are left out of transforms.json")
        return with_velocities(content, named)

    def _notes(self) -> list[str]:
        """What the user should know of the model."""
        notes = []
        if self.source.found.scale.unit != "m":
            notes.append(NO_SCALE)
        if self.source.up_in_world is None:
            notes.append(NO_UP)
        elif float(self.up_in_world @ _Z_UP) < 0.9:
            notes.append("up is not z in this model (up_in_world says what it is), while most trainers' viewers take z")
        return notes

    def record(self, made: Exported, kind: ExportImages) -> dict[str, object]:
        """The content of ``export.json``."""
        scale, gravity = self.source.found.scale, self.source.gravity_in_world_m_s2
        return {
            "format": EXPORT_FORMAT,
            "version": __version__,
            "for": made.program,
            "command": made.command,
            "keeps_metres_and_up": made.says,
            "unit": "m" if scale.unit == "m" else NOT_METRES,
            "up_in_world": None if self.source.up_in_world is None else self.up_in_world.tolist(),
            "gravity_in_world_m_s2": None if gravity is None else gravity.tolist(),
            "scale": {
                "verdict": scale.verdict,
                "reasons": list(scale.reasons),
                "metres_per_unit": scale.metres_per_unit,
                "relative_ci95": None if scale.relative_ci95 is None else list(scale.relative_ci95),
            },
            "model": made.model,
            "images": {"kind": kind, "count": made.images},
            "points": made.points,
            "names": {new: old for old, new in self.names.items()},
            "notes": list(made.notes),
        }


def _notes_on(pictures: Mapping[str, Picture], kind: ExportImages) -> list[str]:
    """What the user should know of the pictures."""
    notes = []
    bent = sum(not picture.agrees for picture in pictures.values())
    if bent:
        notes.append(
            f"{bent} pictures have their rolling shutter, which the model lacks: they agree with it in the middle "
            "row alone, unless the program models the shutter"
        )
    moved = sum(picture.rectified for picture in pictures.values())
    if moved and kind == "original":
        notes.append(f"{moved} pictures are rectified: those with their rolling shutter (colmap/images) are gone")
    sharpened = sum(picture.sharpened for picture in pictures.values())
    if sharpened and kind == "original":
        notes.append(f"{sharpened} pictures are deblurred; with --capture, they are taken from it as they were filmed")
    return notes
