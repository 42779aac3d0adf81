"""Scale without an IMU: by a target, a distance, depth maps, positions; of an existing model, or of images alone."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features.extraction import (
    check_pair_names,
    extract_features,
    image_pairs,
    mapping_device,
    match_pairs,
    require_features,
)
from colmap_inertial.colmap.mapping.mapper import map_images
from colmap_inertial.colmap.settings import read_settings
from colmap_inertial.core.errors import (
    FormatError,
    InertialError,
    NotObservableError,
    OutputExistsError,
    TimingError,
    fact_of,
)
from colmap_inertial.core.facts import Fact, with_sentences
from colmap_inertial.core.options import (
    ProjectOptions,
    ReconstructOptions,
    ReferenceOptions,
    ScaleFrom,
    ValidateOptions,
    WorldAxes,
)
from colmap_inertial.core.progress import Progress, report_each, silent
from colmap_inertial.core.types import FrameTiming
from colmap_inertial.core.types.evidence import AbsentSensor, CombinedScale, ScaleEvidence, Sensor
from colmap_inertial.evidence.combine import combine, judge_device
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.device_folders import is_device_folder
from colmap_inertial.io.files import StrPath, a_record_of_ours, path_in, read_json, write_json
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.frame_sources import ImageFolder, Video, image_names
from colmap_inertial.io.frames import read_frame_timing, read_frames
from colmap_inertial.io.imu import is_capture
from colmap_inertial.io.mp4 import is_mp4
from colmap_inertial.messages.sensors import name_of
from colmap_inertial.model import Model, find_models, read_model, trajectory_from_model
from colmap_inertial.model.copying import copy_file, new_folder
from colmap_inertial.model.project import apply_to_project
from colmap_inertial.run.commands.paths import only_model
from colmap_inertial.run.preparation.known_lengths import add_target, check_reference
from colmap_inertial.run.preparation.sensors import find_sensors
from colmap_inertial.run.stages.frame_folder import encode_image, require_frames
from colmap_inertial.run.stages.known_lengths import scale_by_distance, scale_by_target
from colmap_inertial.run.stages.sensors import SensorsOfModel, ask_sensors, turn_up
from colmap_inertial.run.steps.session import keep_colmap_quiet
from colmap_inertial.run.steps.workspace import refuse_links, require_apart
from colmap_inertial.validate import Validation, parse_target, validate_model

#: What the folder keeps beside the project: where its metres come from.
REFERENCE_FILE = "scale.json"


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference:
    """A scale that no IMU gave.

    Attributes
    ----------
    out
        The project in metres.
    sensors
        What each says, and all together.
    made_of
        What it was measured by, in words.
    notes
        What the user should know.
    validation
        The target, where one was measured.
    """

    out: Path
    sensors: CombinedScale
    made_of: str
    notes: tuple[Fact, ...]
    validation: Validation | None = None

    @property
    def scale_from(self) -> tuple[Sensor, ...]:
        """What gave metres."""
        return tuple(one.sensor for one in self.sensors.evidence)

    def as_json(self) -> dict[str, object]:
        """The content of ``scale.json``."""
        return {
            "scale_from": list(self.scale_from),
            "metres_per_unit": self.sensors.metres_per_unit,
            "ci95": list(self.sensors.ci95),
            "verdict": self.sensors.verdict,
            **with_sentences({"made_of": self.made_of, "notes": list(self.notes)}),
            "sensors": self.sensors.as_json(),
            "validation": self.validation and self.validation.as_json(),
        }


def scale_project_by(
    project: StrPath,
    out: StrPath,
    reference: ReferenceOptions,
    source: ProjectOptions | None = None,
    *,
    scale_from: Sequence[ScaleFrom] = (),
    capture: Capture | None = None,
    world: WorldAxes = "z-up",
    progress: Progress = silent,
) -> Reference:
    """Write a whole COLMAP project in metres, by what is known of its size.

    Parameters
    ----------
    project
        A folder with one COLMAP model; it is only read.
    out
        A folder that does not exist; it appears whole or not at all.
    reference
        What lengths are known.
    source
        Where the project's images are, and how files are taken over.
    scale_from
        What counts; all that there is where empty.
    capture
        What describes depth maps, the device's own path and positions; without it, the project and its images.
    world
        Where gravity points, where some sensor tells.
    progress
        Called with ``"validation"``, ``"depth"`` and ``"apply"``.

    Raises
    ------
    InertialError
        For what is not given, cannot be read or cannot be found; see also :func:`validate_model` and
        :func:`apply_to_project`.
    """
    project, out, source = Path(project), Path(out), source or ProjectOptions()
    check_reference(reference, scale_from)
    folder = only_model(project / "sparse" if (project / "sparse").is_dir() else project)
    images = project / "images" if source.images is None else source.images
    validation = None
    if reference.target is not None:
        if not images.is_dir():
            raise FormatError(images, Fact("no-folder-of-pictures"))
        validation = validate_model(
            folder,
            images,
            parse_target(reference.target),
            ValidateOptions(unscaled=True),
            progress=lambda done, total: progress("validation", done, total),
        )
    evidence, absent, made_by = _ask_lengths(reference, validation, scale_from)
    said = _ask_sensors(capture or _describe(project, source), folder, images, scale_from, progress)
    combined = combine([*evidence, *said.evidence], [*absent, *said.absent])
    if said.device is not None:
        combined = dataclasses.replace(combined, device=judge_device(combined, said.device))
    if combined.verdict == "refused":
        raise NotObservableError("scale", Fact("found-together", found=combined.reasons))
    notes = []
    similarity, up = turn_up(combined.metres_per_unit, combined.sigma, said, world)
    made_of = "; ".join([*made_by, *(name_of(one.sensor) for one in said.evidence)])
    similarity = dataclasses.replace(similarity, provenance=made_of)
    notes.append(up)
    if validation is not None:
        notes += [] if validation.lengths is None else [Fact("target-proves", proof=validation.lengths.proves)]
        if validation.check_error_pct is not None:
            notes.append(Fact("check-corners-off", error=validation.check_error_pct / 100))
        notes += (*validation.doubts, *validation.reasons)
    notes += combined.reasons
    by_reference = Reference(out=out, sensors=combined, made_of=made_of, notes=tuple(notes), validation=validation)
    apply_to_project(
        project,
        out,
        similarity,
        link=source.link,
        keep=source.keep,
        follow_links=source.follow_links,
        progress=lambda done, total: progress("apply", done, total),
    )
    write_json(out / REFERENCE_FILE, by_reference.as_json())
    return by_reference


def _ask_lengths(
    reference: ReferenceOptions, validation: Validation | None, scale_from: Sequence[ScaleFrom]
) -> tuple[list[ScaleEvidence], list[AbsentSensor], list[str]]:
    """What the target and the known distance say, which says nothing, and what they were measured by, in words.

    A target that only says what the markers of a distance are does not count.
    """
    evidence, absent, made_of = list[ScaleEvidence](), list[AbsentSensor](), list[str]()
    counts = reference.distance is None if not scale_from else "target" in scale_from
    if validation is not None and counts:
        if validation.doubts:
            absent.append(AbsentSensor(sensor="target", reasons=tuple(validation.doubts)))
        else:
            target, by = scale_by_target(validation)
            evidence.append(target)
            made_of.append(by)
    if reference.distance is not None and (not scale_from or "distance" in scale_from):
        distance, by = scale_by_distance(reference, validation)
        evidence.append(distance)
        made_of.append(by)
    return evidence, absent, made_of


def _describe(project: Path, source: ProjectOptions) -> Capture:
    """What is known of a project's images: what was given beside it, else what lies in it."""
    given = _find_capture(project, source)
    return Capture(path=project, calibration=calibration_prior()) if given is None else given


def _ask_sensors(
    capture: Capture, folder: Path, images: Path, scale_from: Sequence[ScaleFrom], progress: Progress
) -> SensorsOfModel:
    """What depth, the device's path and positions say of a model that no IMU scaled."""
    chosen = [name for name in scale_from if name not in ("target", "distance")]
    if scale_from and not chosen:
        return SensorsOfModel()
    reconstruction = read_model(folder)
    names = sorted(reconstruction.image(i).name for i in reconstruction.reg_image_ids())
    timing = _time_images(capture, names)

    def size_px() -> tuple[int, int]:
        camera = next(iter(reconstruction.cameras.values()))
        return camera.width, camera.height

    sensors = find_sensors(
        capture, names, size_px, timing=timing, chosen=chosen, images=images if images.is_dir() else None
    )
    if not sensors:
        return SensorsOfModel()
    in_order = timing or FrameTiming(names=tuple(names), t_s=np.arange(float(len(names))))
    model = Model(reconstruction=reconstruction, colmap_index=0, timing=in_order)
    path, _ = trajectory_from_model(reconstruction, in_order, covariances=False)
    return ask_sensors(
        sensors, model, path, up_in_world=None, log_scale=None, timed=timing is not None, progress=progress
    )


def _time_images(capture: Capture, names: Sequence[str]) -> FrameTiming | None:
    """When a capture's images were exposed; ``None`` where nobody says."""
    if capture.frames is None:
        return None
    try:
        timing = read_frame_timing(capture)
    except TimingError:
        return None
    return timing if len(set(names) & set(timing.names)) > 1 else None


def has_imu(path: Path, source: ProjectOptions) -> bool:
    """Whether an IMU was recorded with a capture, or is given beside a project."""
    if source.imu is not None and not is_capture(source.imu):
        return True
    capture = _find_capture(path, source)
    return capture is not None and capture.imu is not None


def knows_metres(path: Path, source: ProjectOptions) -> bool:
    """Whether a capture, or what is given beside a project, says where metres come from without an IMU."""
    capture = _find_capture(path, source)
    return capture is not None and any((capture.poses, capture.depth, capture.target))


def _find_capture(path: Path, source: ProjectOptions) -> Capture | None:
    """What describes the images: the capture, or one that is given beside a project; ``None`` where nothing does."""
    beside = (given for given in (source.imu, source.frame_times) if given is not None and is_capture(given))
    try:
        return load_capture(next(beside, path))
    except FormatError:
        return None


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
    """Map images or a video with COLMAP, and write the model in metres by what is known of its size.

    Parameters
    ----------
    capture
        A capture.toml, a folder of images, or a video. What it says of an IMU is not used.
    out
        A folder that does not exist, or one with nothing but ``colmap/`` of an earlier run on the same images, whose
        scale was not found: that model is then taken.
    reference
        What lengths are known: a target, or the distance of two markers.
    options
        ``scale_from``, ``mapping``, ``world``, ``deterministic`` and ``seed`` count.
    progress
        Called with ``"frames"``, what COLMAP does, ``"validation"``, ``"depth"`` and ``"apply"``.

    Raises
    ------
    FormatError, MappingError, NotObservableError, OutputExistsError
        For links in ``out``, images that cannot be read or mapped, and sizes that cannot be found. COLMAP's model is
        kept then.
    """
    capture, out = Path(capture), Path(out)
    pictures = _load_pictures(capture)
    reference = add_target(reference, pictures)
    check_reference(reference, options.scale_from)
    if out.is_dir() and any(out.iterdir()) and not (out / "colmap" / _MADE_FROM).exists():
        raise OutputExistsError(Fact("output-not-empty", path=str(out)))
    refuse_links(out)
    if options.colmap_executable is not None:
        raise InertialError(Fact("for-metres-of-the-imu", option="--colmap-executable"))
    if options.database is not None:
        raise InertialError(Fact("for-metres-of-the-imu", option="--database"))
    if reference.has_points:
        raise InertialError(Fact("points-need-a-model"))
    names = _list_names(pictures)
    made_from = {"capture": str(capture.resolve()), "pictures": len(names), **dataclasses.asdict(options.mapping)}
    if settings := read_settings(options.colmap, options.colmap_project).settings:
        made_from["colmap"] = list(settings)
    if not _is_mapped(out, made_from):
        with new_folder(out) as work:
            left_out = _map_pictures(pictures, names, work / "colmap", options, progress)
            files = _list_contents(work / "colmap")
            write_json(work / "colmap" / _MADE_FROM, {**made_from, "left_out": left_out, "files": files})
    left_out = read_json(out / "colmap" / _MADE_FROM)["left_out"]
    metric = out / "metric"
    scaled = scale_project_by(
        out / "colmap",
        metric,
        reference,
        ProjectOptions(link=True, keep=(_MADE_FROM,)),
        scale_from=options.scale_from,
        capture=pictures,
        world=options.world,
        progress=progress,
    )
    notes = (*scaled.notes, Fact("treatment-without-imu"))
    if left_out:
        notes = (*notes, Fact("more-models-left-out", images=left_out))
    scaled = dataclasses.replace(scaled, out=out, notes=notes)
    (metric / _MADE_FROM).unlink()
    write_json(metric / "scale.json", scaled.as_json())
    # the scale last: where it stands, everything does
    for path in sorted(metric.iterdir(), key=lambda path: path.name == "scale.json"):
        path.rename(out / path.name)
    metric.rmdir()
    return scaled


def _is_mapped(out: Path, made_from: dict[str, object]) -> bool:
    """Whether ``out`` is an earlier run's that mapped these images and found no scale."""
    record = out / "colmap" / _MADE_FROM
    if not record.is_file() or (out / "scale.json").exists():
        return False
    shutil.rmtree(out / "metric", ignore_errors=True)
    if {path.name for path in out.iterdir()} != {"colmap"}:
        return False
    try:
        with a_record_of_ours(record):
            known = read_json(record)
            list(map(int, known["left_out"]))
            kept = dict(known["files"])
    except FormatError as error:
        raise OutputExistsError(Fact("record-unreadable", found=fact_of(error), out=str(out))) from None
    if any(known.get(key) != value for key, value in made_from.items()):
        raise OutputExistsError(Fact("output-of-another-run", path=str(out)))
    contents = _list_contents(record.parent)
    if changed := sorted(name for name in kept | contents if kept.get(name) != contents.get(name)):
        raise OutputExistsError(Fact("output-changed", path=str(record.parent / changed[0]), out=str(out)))
    return True


def _list_contents(project: Path) -> dict[str, list[object]]:
    """Size and digest of a project's files, without the record of what it was made from."""
    rows: Any = fingerprint(project)
    contents = {Path(path).relative_to(project.resolve()).as_posix(): [size, digest] for path, size, _, digest in rows}
    contents.pop(_MADE_FROM, None)
    return contents


def _load_pictures(path: Path) -> Capture:
    """A capture, a folder of images, or a video."""
    if not path.exists():
        raise FormatError(path, Fact("no-such-file", what="file or folder"))
    frames: ImageFolder | Video
    if path.is_file() and is_mp4(path):
        frames = Video(file=path, frames_per_s=_FRAMES_PER_S)
        return Capture(path=path, frames=frames, calibration=calibration_prior())
    if path.is_dir() and not (is_capture(path) or is_device_folder(path)):
        frames = ImageFolder(folder=path)
        return Capture(path=path, frames=frames, calibration=calibration_prior())
    capture = load_capture(path)
    if capture.frames is None:
        raise FormatError(path, Fact("capture-has-no-pictures"))
    if capture.apertures is not None or capture.exposures is not None:
        raise FormatError(path, Fact("scale-from-plain-pictures"))
    if capture.rig:
        raise FormatError(path, Fact("scale-from-one-camera"))
    if isinstance(capture.frames, Video) and capture.frames.frames_per_s is None:
        capture = dataclasses.replace(capture, frames=dataclasses.replace(capture.frames, frames_per_s=_FRAMES_PER_S))
    return capture


def _list_names(capture: Capture) -> list[str]:
    if isinstance(capture.frames, ImageFolder):
        names = image_names(capture.frames)
    else:
        names = list(read_frames(capture)[0].names)
    require_frames(len(names), of=len(names))
    check_pair_names(names)
    return names


def _map_pictures(
    capture: Capture, names: list[str], project: Path, options: ReconstructOptions, progress: Progress
) -> list[int]:
    """Make a COLMAP project of images; how many images the models have that are left out, the largest first."""
    keep_colmap_quiet()
    mapping = options.mapping
    if isinstance(capture.frames, ImageFolder):
        require_apart(project, (capture.frames.folder,))
    images, sparse = project / "images", project / "sparse"
    device = mapping_device(mapping, deterministic=options.deterministic)
    context = dataclasses.replace(RunContext.of(options, device=device, progress=progress), scratch=project)
    require_features(context)
    project.mkdir()
    context.executor.require(project)
    for _ in report_each(_copy_pictures(capture, names, images), len(names), "frames", progress):
        pass
    database = project / "database.db"
    extract_features(images, dict.fromkeys(names, capture.camera), database, mapping, context=context)
    match_pairs(database, image_pairs(names, mapping), context)
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


def _copy_pictures(capture: Capture, names: list[str], images: Path) -> Iterator[None]:
    """Put every image into a folder: files as they are, frames of a video as PNG."""
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
