"""The export from beginning to end: one folder, whole or not at all."""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_inertial import __version__
from colmap_inertial.core.arrays import AnyArray, UInt8Array
from colmap_inertial.core.errors import FormatError, OutputError
from colmap_inertial.core.facts import Fact, as_fact, with_sentences
from colmap_inertial.core.options import ExportImages, ExportProgram
from colmap_inertial.core.progress import Progress, silent
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.core.threads import frames_at_once, map_in_order
from colmap_inertial.inertial.georeference import Georeference
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.files import StrPath, read_bytes, write_json
from colmap_inertial.io.frames import read_frames
from colmap_inertial.io.images import read_alpha, read_image
from colmap_inertial.model.copying import new_folder
from colmap_inertial.model.nerf import EXPORT_FORMAT, NOT_METRES
from colmap_inertial.run.preparation.geolocation import cameras_as_json
from colmap_inertial.run.stages.frame_folder import encode_image
from colmap_inertial.tools.export.source import ExportContent, Picture, find_georeference, read_source
from colmap_inertial.tools.export.targets import TARGETS, TRAINERS, write_metadata
from colmap_inertial.tools.export.undistort import Undistortion


@dataclass(frozen=True, eq=False, kw_only=True)
class Job:
    """One image to write.

    Attributes
    ----------
    target
        The new file.
    source
        The file that it is made from, or where its pixels come from, for messages.
    undistortion
        What its camera becomes.
    pixels
        (H, W) or (H, W, 3) where they are decoded already; ``None`` reads the file.
    """

    target: Path
    source: Path
    undistortion: Undistortion
    pixels: AnyArray | None = None

    def write(self) -> None:
        """Write it."""
        image: AnyArray = read_image(self.source) if self.pixels is None else self.pixels
        camera = self.undistortion.camera
        if image.shape[:2] != (camera.height, camera.width):
            raise FormatError(
                self.source,
                Fact(
                    "picture-of-another-size",
                    width=image.shape[1],
                    height=image.shape[0],
                    camera_width=camera.width,
                    camera_height=camera.height,
                ),
            )
        if self.pixels is None and self.undistortion.is_same() and _is_plain(self.source, self.target, image):
            shutil.copyfile(self.source, self.target)
        else:
            encode_image(self.target, self.undistortion.resampled(three_channels(image)), alpha=self._alpha())

    def _alpha(self) -> UInt8Array | None:
        """(h, w) alpha of the new image, where the file has one and the new format holds it."""
        if self.pixels is not None or self.target.suffix.lower() != ".png":
            return None
        alpha = read_alpha(read_bytes(self.source, what="picture"))
        if alpha is None:
            return None
        return self.undistortion.resampled(np.asarray(alpha // 257 if alpha.dtype == np.uint16 else alpha, np.uint8))


def write_pictures(jobs: Iterable[Job], count: int, progress: Progress) -> None:
    """Write images as pinhole cameras would have taken them; a few at a time.

    Parameters
    ----------
    jobs, count
        The images, and how many there are.
    progress
        Called with ``"export"``.

    Raises
    ------
    FormatError
        For an image that cannot be read, or whose size is not the camera's.
    """
    progress("export", 0, count)
    for done, _ in enumerate(map_in_order(Job.write, jobs, workers=frames_at_once()), start=1):
        progress("export", done, count)


def three_channels(image: AnyArray) -> UInt8Array:
    """(H, W, 3) the image in 8 bit and three channels: trainers read nothing else."""
    shown = np.asarray(image // 257 if image.dtype == np.uint16 else image, dtype=np.uint8)
    return np.repeat(shown[:, :, None], 3, axis=2) if shown.ndim == 2 else shown


def _is_plain(source: Path, target: Path, image: AnyArray) -> bool:
    """Whether trainers can read a file as it is; some of them would heed an orientation in its metadata."""
    suffix = {".jpeg": ".jpg"}.get(source.suffix.lower(), source.suffix.lower())
    plain = image.ndim == 3 and image.dtype == np.uint8 and suffix == target.suffix
    if not plain:
        return False
    with open(source, "rb") as file:
        head = file.read(1 << 16)
    return b"Exif" not in head and b"eXIf" not in head  # in JPEG, in PNG


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class Exported:
    """Result of :func:`export_model`; the same as ``export.json``.

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
    notes: tuple[Fact, ...] = ()


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
        ``"rectified"``: the images that agree with the model; ``"original"``: those that COLMAP saw, with their
        rolling shutter.
    model
        Number of the model; ``None`` takes the largest.
    image_folder
        Folder with the model's images, where they are not beside it.
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
        Where there is no model, an image is missing or of another size, or a lens cannot be undistorted.
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
        raise OutputError(Fact("folders-within-each-other", folder=str(folder), out=str(out)))
    target = TRAINERS if program is None else TARGETS[program]
    target.require()
    source = read_source(
        out, model=model, image_folder=None if image_folder is None else Path(image_folder), unscaled=unscaled
    )
    filmed = None if capture is None else load_capture(Path(capture))
    on_map = find_georeference(out, source, filmed) if georeference else None
    filmed = filmed if images == "original" else None
    with new_folder(folder, into_empty=True) as partial:
        content = ExportContent.of(source, on_map, square=target.square)
        if on_map is not None:
            _write_georeference(partial / "georeference.json", content, on_map)
        if target.pictures:
            content = replace(content, pictures=source.pictures(out, list(content.names), images, filmed))
            content.notes.extend(_notes_on(content.pictures, images))
            content.notes.extend(_notes_on_masks(out, source.found.images, content.names.values()))
            (partial / "images").mkdir()
        if target.recentres and content.offset is not None:
            content = content.recentred()
            write_metadata(partial / "metadata.xml", content.offset, metres=content.is_metric)
        target.write(content, partial)
        if target.pictures:
            write_pictures(_jobs(content, partial / "images", filmed), len(content.pictures), progress)
        source_view = source.found
        made = Exported(
            folder=folder,
            program=program,
            command=target.command_line(folder),
            says=target.says,
            model=source_view.index,
            others=source_view.others,
            unit=source_view.scale.unit,
            images=len(content.views) if target.has_images else 0,
            points=len(content.xyz) if target.has_points else 0,
            notes=tuple(map(as_fact, content.notes)),
        )
        write_json(partial / "export.json", _record(made, content, images))
    return made


def _write_georeference(path: Path, content: ExportContent, on_map: Georeference) -> None:
    """Write the georeference of the model and its images; ``content`` gets the notes."""
    centres = np.array([view.cam_in_world for view in content.views])
    names = tuple(view.name for view in content.views)
    write_json(path, {**on_map.as_json(), "cameras": cameras_as_json(on_map, names, centres)})
    content.notes.extend(map(as_fact, on_map.notes))


def _jobs(content: ExportContent, folder: Path, capture: Capture | None) -> Iterator[Job]:
    """The images to write: from their files, then those that come out of a capture."""
    model = content.source.model
    camera_of = {image.name: content.cameras[image.camera_id] for image in map(model.image, model.reg_image_ids())}
    for name, picture in content.pictures.items():
        if not picture.filmed:
            yield Job(target=folder / content.names[name], source=picture.path, undistortion=camera_of[name])
    filmed = {name for name, picture in content.pictures.items() if picture.filmed}
    if capture is not None and filmed:
        for frame in read_frames(capture, only=filmed)[1]:
            yield Job(
                target=folder / content.names[frame.name],
                source=capture.path,
                undistortion=camera_of[frame.name],
                pixels=frame.image,
            )


def _record(made: Exported, content: ExportContent, kind: ExportImages) -> dict[str, object]:
    """The content of ``export.json``."""
    source = content.source
    scale, up, gravity = source.found.scale, source.up_in_world, source.gravity_in_world_m_s2
    return {
        "format": EXPORT_FORMAT,
        "version": __version__,
        "for": made.program,
        "command": made.command,
        "keeps_metres_and_up": made.says,
        "unit": "m" if scale.unit == "m" else NOT_METRES,
        "up_in_world": None if up is None else up.tolist(),
        **({"offset_in_world": content.offset.tolist()} if content.is_recentred and content.offset is not None else {}),
        "gravity_in_world_m_s2": None if gravity is None else gravity.tolist(),
        "scale": {
            "verdict": scale.verdict,
            **with_sentences({"reasons": list(scale.reasons)}),
            "metres_per_unit": scale.metres_per_unit,
            "relative_ci95": None if scale.relative_ci95 is None else list(scale.relative_ci95),
        },
        "model": made.model,
        "images": {"kind": kind, "count": made.images},
        "points": made.points,
        "names": {new: old for old, new in content.names.items()},
        **with_sentences({"notes": list(made.notes)}),
    }


#: What names of folders with masks, or of masks among the images, hold.
_MASKS = re.compile(r"(?i)mask|matte|segmentation|^seg$|^alphas?$")


def _notes_on_masks(out: Path, pictures: Collection[Path], names: Collection[str]) -> list[Fact]:
    """Note for the user on masks beside the folders of the images, or in them; ``names`` are the images' own."""
    beside = {path for folder in {out, *(path.parent for path in pictures)} for path in _contents(folder)}
    masks = {path for path in beside if _MASKS.search(path.name) and _contents(path)}
    for folder in pictures:
        others = (path for path in _contents(folder) if path.name not in names)
        if any(_MASKS.search(path.name) and path.is_file() for path in others):
            masks.add(folder)
    return [Fact("masks-left", folder=str(folder)) for folder in sorted(masks)]


def _contents(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _notes_on(pictures: Mapping[str, Picture], kind: ExportImages) -> list[Fact]:
    """Notes for the user on the images."""
    notes = []
    bent = sum(not picture.agrees for picture in pictures.values())
    if bent:
        notes.append(Fact("pictures-with-shutter", count=bent))
    moved = sum(picture.rectified for picture in pictures.values())
    if moved and kind == "original":
        notes.append(Fact("pictures-rectified", count=moved))
    sharpened = sum(picture.sharpened for picture in pictures.values())
    if sharpened and kind == "original":
        notes.append(Fact("pictures-deblurred", count=sharpened))
    return notes
