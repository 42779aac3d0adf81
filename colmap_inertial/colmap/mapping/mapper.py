"""COLMAP's mapper: models of what was matched, in one go or in parts, and a record of how they were made."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_inertial.colmap.chunks import CHUNKS_FOLDER
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.installed import InstalledColmap
from colmap_inertial.colmap.loops.closure import LoopClosure, MappedCapture, close_gaps
from colmap_inertial.colmap.mapping.incremental import map_incrementally
from colmap_inertial.colmap.mapping.submaps import join_runs, map_runs, split_capture
from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.core.errors import MappingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.progress import make_counter
from colmap_inertial.io.disk import remove, require_room
from colmap_inertial.io.sqlite import open_foreign
from colmap_inertial.model import find_models
from colmap_inertial.model.soundness import check_binary_model

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: Where cameras are known, the whole model is adjusted each time it has grown so much, as COLMAP's own settings for
#: videos have it, and at the end; unknown cameras bend a model that is adjusted so seldom.
_GLOBAL_RATIO = 1.4
#: Images within so many times the overlap are neighbours in time.
_NEIGHBOURS = 2
_UNKNOWN = ImageOrientations()


@dataclass(frozen=True, kw_only=True)
class ModelEnds(LoopClosure):
    """The loop closure of one of several models; ``model`` is its number."""

    model: int


@dataclass(frozen=True, kw_only=True)
class MapRecord:
    """Record of how models were mapped.

    Attributes
    ----------
    mapper
        COLMAP's: ``"incremental"`` or ``"global"``.
    models
        How many.
    parts
        Runs of images that were mapped by themselves; 1 where all were mapped in one go.
    ends
        Loop closures of models that were mapped in one go.
    seams
        Overlaps of parts, also those that do not fit and whose matches were left out.
    """

    mapper: str
    models: int
    parts: int = 1
    ends: tuple[ModelEnds, ...] = ()
    seams: tuple[LoopClosure, ...] = ()


def map_images(
    database: Path,
    images: Path,
    sparse: Path,
    options: MappingOptions,
    context: RunContext,
    *,
    in_time: Sequence[str] = (),
    judged: bool = True,
    orientations: ImageOrientations = _UNKNOWN,
) -> MapRecord:
    """Run COLMAP's mapper; models are written to ``sparse/0``, ``sparse/1``, ...

    Parameters
    ----------
    options
        Here ``refine_intrinsics`` must be given.
    in_time
        The images in order of time, where they are of one recording: loops of a model are closed then, and what is too
        long for one go is mapped in parts.
    judged
        Whether somebody looked which pairs far apart in time join copies (``MatchRecord.judged``). Nobody does where
        every pair is matched.
    orientations
        Of the images, by the gyroscope: it knows which pose of the first two images is right.

    Raises
    ------
    MappingError
        When no model comes out.
    """
    import pycolmap

    if options.refine_intrinsics is None:
        raise ValueError("whoever knows the cameras decides whether they are refined")
    pycolmap.set_random_seed(context.seed)
    sparse.mkdir(parents=True)
    require_room(sparse / "points3D.bin", database.stat().st_size)
    # COLMAP's own reader would write to the file
    with open_foreign(database) as opened:
        (num_images,) = opened.execute("SELECT COUNT(name) FROM images").fetchone()
    context.progress("mapping", 0, num_images)
    every_pair = options.pairing == "exhaustive"
    near = _NEIGHBOURS * options.overlap
    if options.mapper == "incremental":
        pipeline = incremental_options(options.refine_intrinsics, context)
        capture = MappedCapture(
            database=database, pipeline=pipeline, names=in_time, orientations=orientations, settings=context.colmap
        )
        parts = [] if every_pair else split_capture(capture)
        if len(parts) > 1:
            record = _map_in_parts(capture, images, sparse, context, parts, near=near, loops=judged)
        else:
            nearest = None if judged and not every_pair else near
            counted = make_counter(context.progress, "mapping", num_images)
            if context.executable is None:
                models = map_incrementally(
                    database, images, sparse, pipeline, counted, orientations=orientations, scratch=context.scratch
                )
            else:
                installed = InstalledColmap(executable=context.executable, scratch=context.scratch)
                models = installed.map(database, images, sparse, pipeline, counted)
            record = _close_models(capture, models, sparse, nearest=nearest)
    else:
        models = pycolmap.global_mapping(
            str(database), str(images), str(sparse), options=global_options(options, context)
        )
        record = MapRecord(mapper="global", models=len(models))
    context.progress("mapping", num_images, num_images)
    for folder in sparse.iterdir():
        # COLMAP does not say when it could not write one whole
        find_models(folder)
        check_binary_model(folder)
    if not record.models:
        raise MappingError(Fact("no-model-found"))
    remove(context.scratch / CHUNKS_FOLDER)
    log.info("mapping: %s", record)
    return record


def _close_models(
    capture: MappedCapture, models: Mapping[int, pycolmap.Reconstruction], sparse: Path, *, nearest: int | None
) -> MapRecord:
    ends = []
    for number, model in models.items() if capture.names else ():
        closure = close_gaps(capture, model, nearest=nearest)
        if closure is not None:
            ends.append(ModelEnds(model=number, **vars(closure)))
            if closure.joined:
                model.write_binary(str(sparse / str(number)))
    return MapRecord(mapper="incremental", models=len(models), ends=tuple(ends))


def _map_in_parts(
    capture: MappedCapture,
    images: Path,
    sparse: Path,
    context: RunContext,
    parts: Sequence[tuple[int, int]],
    *,
    near: int,
    loops: bool,
) -> MapRecord:
    # neighbouring parts have some images both
    several = sum(end - begin for begin, end in parts)
    counted = make_counter(context.progress, "mapping", len(capture.names), of=several)
    scratch = context.scratch / CHUNKS_FOLDER
    made = map_runs(capture, images, scratch, parts, executor=context.executor, registered=counted)
    models, seams = join_runs(capture, made, near=near, loops=loops) if made else ([], [])
    for number, model in enumerate(models):
        model.extract_colors_for_all_images(str(images))
        (sparse / str(number)).mkdir()
        model.write_binary(str(sparse / str(number)))
    return MapRecord(mapper="incremental", models=len(models), parts=len(parts), seams=tuple(seams))


def incremental_options(refine: bool, context: RunContext) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's options of its incremental mapper; whether it refines the cameras."""
    import pycolmap

    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads, pipeline.random_seed = context.num_threads, context.seed
    pipeline.ba_refine_focal_length = refine
    pipeline.ba_refine_extra_params = refine
    pipeline.mapper.abs_pose_refine_focal_length = refine
    pipeline.mapper.abs_pose_refine_extra_params = refine
    if not refine:
        pipeline.ba_global_frames_ratio = pipeline.ba_global_points_ratio = _GLOBAL_RATIO
    return context.colmap.apply(pipeline)


def global_options(options: MappingOptions, context: RunContext) -> pycolmap.GlobalPipelineOptions:
    """COLMAP's options of its global mapper."""
    import pycolmap

    pipeline = pycolmap.GlobalPipelineOptions()
    pipeline.num_threads, pipeline.random_seed = context.num_threads, context.seed
    pipeline.mapper.bundle_adjustment.refine_focal_length = bool(options.refine_intrinsics)
    pipeline.mapper.bundle_adjustment.refine_extra_params = bool(options.refine_intrinsics)
    pipeline.mapper.rotation_averaging.use_gravity = options.gravity_priors
    return context.colmap.apply(pipeline)
