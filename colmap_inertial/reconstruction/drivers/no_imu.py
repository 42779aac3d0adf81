"""A capture without an IMU: COLMAP maps its pictures, and a target or a known distance gives the metres.

Nothing inertial is claimed of such a run: no frame is deblurred, no rolling shutter undone, and up stays unknown.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path

from colmap_inertial.colmap.mapping import map_images
from colmap_inertial.colmap.sparse import (
    check_pair_names,
    extract_features,
    image_pairs,
    mapping_device,
    match_features,
)
from colmap_inertial.core.errors import FormatError, InertialError, OutputExistsError
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions, ReferenceOptions
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.capture import Capture, ImageFolder, Video, load_capture
from colmap_inertial.io.files import StrPath, path_in, read_json, write_json
from colmap_inertial.io.frames import image_names, read_frames
from colmap_inertial.io.imu import is_capture
from colmap_inertial.io.mp4 import is_mp4
from colmap_inertial.model import find_models, read_model
from colmap_inertial.model.copying import copy_file, new_folder
from colmap_inertial.pipeline.run.context import RunContext
from colmap_inertial.pipeline.run.progress import Progress, counted, silent
from colmap_inertial.pipeline.run.session import keep_colmap_quiet
from colmap_inertial.pipeline.run.workspace import a_record_of_ours, require_apart
from colmap_inertial.pipeline.stages.frame_folder import encode_image, require_frames
from colmap_inertial.reconstruction.drivers.reference import Reference, check_reference, scale_project_by

#: Of a video, so many frames a second, where its capture does not say.
_FRAMES_PER_S = 2.0
#: Says in ``OUT/colmap`` of what it was made.
_MADE_FROM = "made_from.json"


def reconstruct_by(
    capture: StrPath,
    out: StrPath,
    reference: ReferenceOptions,
    options: ReconstructOptions = ReconstructOptions(),
    *,
    progress: Progress = silent,
) -> Reference:
    """Map pictures or a video with COLMAP, and write the model in metres by what is known of its size.

    Parameters
    ----------
    capture
        A capture.toml, a folder of pictures, or a video. What it says of an IMU is not used.
    out
        A folder that does not exist, or one with nothing but ``colmap/`` of an earlier run on the same pictures, whose
        scale was not found: that model is then taken.
    reference
        What is known: a target, or the distance of two markers.
    options
        ``mapping``, ``deterministic`` and ``seed`` count.
    progress
        Called with ``"frames"``, what COLMAP does, ``"validation"`` and ``"apply"``.

    Raises
    ------
    FormatError, MappingError, NotObservableError, OutputExistsError
        For pictures that cannot be read or mapped, and sizes that cannot be found. COLMAP's model is kept then.
    """
    capture, out = Path(capture), Path(out)
    check_reference(reference)
    if any("," in end for end in reference.between or ()):
        raise InertialError(
            "--between with points needs the model that they are of: map first (with a target or two markers), or give "
            "a COLMAP project"
        )
    pictures = _pictures(capture)
    names = _names(pictures)
    made_from = {"capture": str(capture.resolve()), "pictures": len(names), **dataclasses.asdict(options.mapping)}
    if not _is_mapped(out, made_from):
        with new_folder(out) as work:
            left_out = _map(pictures, names, work / "colmap", options, progress)
            write_json(work / "colmap" / _MADE_FROM, {**made_from, "left_out": left_out})
    left_out = read_json(out / "colmap" / _MADE_FROM)["left_out"]
    metric = out / "metric"
    found = scale_project_by(
        out / "colmap", metric, reference, ProjectOptions(link=True, keep=(_MADE_FROM,)), progress=progress
    )
    notes = (*found.notes, "no IMU was used: frames are as they were filmed, with any blur and rolling shutter")
    if left_out:
        notes = (
            *notes,
            f"COLMAP made {len(left_out)} more models, of {', '.join(map(str, left_out))} images: left out",
        )
    found = dataclasses.replace(found, out=out, notes=notes)
    (metric / _MADE_FROM).unlink()
    write_json(metric / "scale.json", found.as_json())
    # the scale last: where it stands, everything does
    for path in sorted(metric.iterdir(), key=lambda path: path.name == "scale.json"):
        path.rename(out / path.name)
    metric.rmdir()
    return found


def _is_mapped(out: Path, made_from: dict[str, object]) -> bool:
    """Whether ``out`` is an earlier run's that mapped these pictures and found no scale."""
    record = out / "colmap" / _MADE_FROM
    if not record.is_file() or (out / "scale.json").exists():
        return False
    shutil.rmtree(out / "metric", ignore_errors=True)
    if {path.name for path in out.iterdir()} != {"colmap"}:
        return False
    with a_record_of_ours(record):
        known = read_json(record)
        list(map(int, known["left_out"]))
    if any(known.get(key) != value for key, value in made_from.items()):
        raise OutputExistsError(f"{out} holds a model of other pictures or options; choose another folder or remove it")
    return True


def _pictures(path: Path) -> Capture:
    """A capture, a folder of pictures, or a video."""
    if not path.exists():
        raise FormatError(path, "no such file or folder")
    frames: ImageFolder | Video
    if path.is_file() and is_mp4(path):
        frames = Video(file=path, frames_per_s=_FRAMES_PER_S)
        return Capture(path=path, frames=frames, calibration=calibration_prior())
    if path.is_dir() and not is_capture(path):
        frames = ImageFolder(folder=path)
        return Capture(path=path, frames=frames, calibration=calibration_prior())
    capture = load_capture(path)
    if capture.frames is None:
        raise FormatError(path, "has no pictures: add [images] or [video]")
    if capture.apertures is not None or capture.exposures is not None:
        raise FormatError(path, "--scale-from target or distance takes plain pictures: fuse them first")
    if isinstance(capture.frames, Video) and capture.frames.frames_per_s is None:
        capture = dataclasses.replace(capture, frames=dataclasses.replace(capture.frames, frames_per_s=_FRAMES_PER_S))
    return capture


def _names(capture: Capture) -> list[str]:
    if isinstance(capture.frames, ImageFolder):
        names = image_names(capture.frames)
    else:
        names = list(read_frames(capture)[0].names)
    require_frames(len(names), of=len(names))
    check_pair_names(names)
    return names


def _map(
    capture: Capture, names: list[str], project: Path, options: ReconstructOptions, progress: Progress
) -> list[int]:
    """Make a COLMAP project of pictures; how many images the models have that are left out, the largest first."""
    keep_colmap_quiet()
    mapping = options.mapping
    if isinstance(capture.frames, ImageFolder):
        require_apart(project, (capture.frames.folder,))
    images, sparse = project / "images", project / "sparse"
    device = mapping_device(mapping, deterministic=options.deterministic)
    context = dataclasses.replace(RunContext.of(options, device=device, progress=progress), scratch=project)
    for _ in counted(_written(capture, names, images), len(names), "frames", progress):
        pass
    features, database = project / "features.db", project / "database.db"
    extract_features(images, dict.fromkeys(names, capture.camera), features, mapping, context=context)
    match_features(features, database, image_pairs(names, mapping), context)
    features.unlink()
    refine = capture.camera is None if mapping.refine_intrinsics is None else mapping.refine_intrinsics
    made = project / "models"
    decided = dataclasses.replace(mapping, refine_intrinsics=refine)
    map_images(database, images, made, decided, context, in_time=names, judged=False)
    sizes = {folder: int(read_model(folder).num_reg_images()) for folder in find_models(made).values()}
    ranked = sorted(sizes, key=lambda folder: -sizes[folder])
    sparse.mkdir()
    ranked[0].rename(sparse / "0")
    shutil.rmtree(made)
    return [sizes[folder] for folder in ranked[1:]]


def _written(capture: Capture, names: list[str], images: Path) -> Iterator[None]:
    """Put every picture into a folder: files as they are, frames of a video as PNG."""
    if isinstance(capture.frames, ImageFolder):
        for name in names:
            target = path_in(images, name)
            target.parent.mkdir(parents=True, exist_ok=True)
            copy_file(path_in(capture.frames.folder, name), target)
            yield
        return
    images.mkdir(parents=True)
    for frame in read_frames(capture)[1]:
        encode_image(path_in(images, frame.name), frame.image)
        yield
