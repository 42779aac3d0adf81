"""COLMAP's own stages: features, matches, mapping, with progress and nothing left half-written."""

from __future__ import annotations

import contextlib
import itertools
import logging
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from colmap_inertial.colmap.closing import EndsMet, close_gaps
from colmap_inertial.colmap.submaps import LONGEST, map_in_parts, runs
from colmap_inertial.errors import FormatError, InertialError, MappingError, OutputError
from colmap_inertial.model import colmap_camera, find_models
from colmap_inertial.model.binary import check_binary_model
from colmap_inertial.options import MappingOptions
from colmap_inertial.run.context import RunContext
from colmap_inertial.run.progress import Progress
from colmap_inertial.run.workspace import require_room
from colmap_inertial.stages.protocols import KeypointStage
from colmap_inertial.types import Array, CameraModel, Keypoints, Treatment

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: Up to this many images every pair is matched; above it, neighbours in time.
_EXHAUSTIVE_UP_TO = 150
_EXTRACTION_BATCH = 16
#: Where cameras are known, the whole model is adjusted each time it has grown so much, as COLMAP's own settings for
#: videos have it, and at the end; unknown cameras bend a model that is adjusted so seldom.
_GLOBAL_RATIO = 1.4
#: Images within so many times the overlap are neighbours in time.
_NEIGHBOURS = 2
#: Each batch indexes its images' features anew, an image as dear as a pair; the first are small, so that one sees soon
#: how quickly it goes.
_FIRST_MATCHING_BATCH, _MATCHING_BATCH = 100, 1600
#: What a feature takes in the database at most, several orientations and SQLite's log included; likewise a pair.
_FEATURE_BYTES = 500
_PAIR_BYTES = 100_000


@contextlib.contextmanager
def _writing(database: Path) -> Iterator[None]:
    """Turn COLMAP's complaint that it cannot open a database of ours into one that says why that is.

    Raises
    ------
    OutputError
    """
    try:
        yield
    except RuntimeError as error:
        if "database factory" not in str(error):
            raise
        raise OutputError(
            f"{database}: COLMAP cannot write its database here: the disk is full, or a quota, a limit of file sizes "
            "or of open files (ulimit -n) is reached; make room and start again, it continues"
        ) from error


def mapping_device(options: MappingOptions, *, deterministic: bool) -> Literal["cpu", "cuda"]:
    """What features are found and matched on.

    Raises
    ------
    InertialError
        Where CUDA is asked for and pycolmap has none.
    """
    import pycolmap

    if options.device == "auto":
        return "cuda" if pycolmap.has_cuda and not deterministic else "cpu"
    if options.device == "cuda" and not pycolmap.has_cuda:
        raise InertialError("--mapping.device cuda: this pycolmap has none; install pycolmap-cuda12, or leave it out")
    return options.device


def check_pair_names(names: Sequence[str]) -> None:
    """Raise ``FormatError`` for an image name that COLMAP's lists of pairs cannot hold."""
    for name in names:
        if len(name.split()) != 1 or name.startswith("#"):
            raise FormatError(
                Path(name), "COLMAP's lists of pairs cannot hold such a file name; rename it without spaces"
            )


def matches_every_pair(count: int, options: MappingOptions) -> bool:
    """Whether every pair of so many images is matched, and not only neighbours in time."""
    return options.pairing == "exhaustive" or (options.pairing == "auto" and count <= _EXHAUSTIVE_UP_TO)


def image_pairs(names: Sequence[str], options: MappingOptions) -> list[tuple[str, str]]:
    """The pairs to match, by names in order of time."""
    if matches_every_pair(len(names), options):
        return list(itertools.combinations(names, 2))
    steps = set(range(1, options.overlap + 1))
    steps |= {2**k for k in range(len(names).bit_length())}
    return [(names[i], names[i + step]) for i in range(len(names)) for step in sorted(steps) if i + step < len(names)]


def extract_features(
    images: Path,
    cameras: Mapping[str, CameraModel | None],
    database: Path,
    options: MappingOptions,
    *,
    keypoint_stages: Sequence[KeypointStage] = (),
    context: RunContext,
) -> KeypointRecords:
    """SIFT on all images, one COLMAP camera for each distinct set of intrinsics, then the keypoint stages.

    Parameters
    ----------
    images
        Folder with the images.
    cameras
        Intrinsics by image name; ``None`` lets COLMAP guess them (from EXIF, else from the image size).
    database
        A path that does not exist yet.

    Returns
    -------
    What the stages did to the keypoints of each image.
    """
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = context.device == "cuda"
    extraction.num_threads = context.num_threads
    if options.max_image_size is not None:
        extraction.max_image_size = options.max_image_size
    extraction.sift.max_num_features = options.max_num_features
    extraction.sift.first_octave = options.first_octave
    pycolmap.set_random_seed(context.seed)
    groups: dict[CameraModel | None, list[str]] = {}
    for name, camera in cameras.items():
        groups.setdefault(_intern(camera, groups), []).append(name)
    done = 0
    for camera, names in groups.items():
        reader = pycolmap.ImageReaderOptions()
        if camera is not None:
            colmap_camera(camera)  # raises on wrong parameters before any work
            reader.camera_model = camera.model
            reader.camera_params = ",".join(repr(p) for p in camera.params)
        for batch in _batches(sorted(names), _EXTRACTION_BATCH):
            context.progress("features", done, len(cameras))
            require_room(database.parent, len(batch) * options.max_num_features * _FEATURE_BYTES)
            with _writing(database):
                # in their order, and not in that in which threads come to their ends: COLMAP numbers them as they come,
                # and begins its model by the numbers
                pycolmap.Database.open(str(database)).close()
                pycolmap.import_images(
                    str(database),
                    str(images),
                    image_names=batch,
                    camera_mode=pycolmap.CameraMode.SINGLE,
                    options=reader,
                )
                pycolmap.extract_features(
                    str(database),
                    str(images),
                    image_names=batch,
                    camera_mode=pycolmap.CameraMode.SINGLE,
                    reader_options=reader,
                    extraction_options=extraction,
                    device=pycolmap.Device(context.device),
                )
            with _writing(database), pycolmap.Database.open(str(database)) as opened:
                first = opened.read_image_with_name(batch[0])
                if first is None:
                    raise MappingError(f"COLMAP could not read {images / batch[0]}")
                reader.existing_camera_id = first.camera_id
            done += len(batch)
    context.progress("features", done, len(cameras))
    return _through_stages(database, keypoint_stages)


def _intern(camera: CameraModel | None, known: Mapping[CameraModel | None, list[str]]) -> CameraModel | None:
    """The equal camera among the known ones, so that frames of one device share one COLMAP camera."""
    return next((k for k in known if k is not None and camera is not None and vars(k) == vars(camera)), camera)


def _batches(items: Sequence[str], size: int) -> list[list[str]]:
    return [list(items[i : i + size]) for i in range(0, len(items), size)]


def growing_batches(pairs: Sequence[str], *, first: int = _FIRST_MATCHING_BATCH) -> list[list[str]]:
    """Pairs in batches to match, each twice as large as the one before, up to a limit."""
    batches, begin, size = [], 0, first
    while begin < len(pairs):
        batches.append(list(pairs[begin : begin + size]))
        begin, size = begin + size, min(2 * size, _MATCHING_BATCH)
    return batches


@dataclass(frozen=True, kw_only=True)
class KeypointRecord:
    """What the keypoint stages did to one image's keypoints; see :class:`~colmap_inertial.types.Keypoints`."""

    name: str
    rectified: bool = False
    treatments: tuple[Treatment, ...] = ()


@dataclass(frozen=True, kw_only=True)
class KeypointRecords:
    """The same for all images that COLMAP saw, in its order; empty where there were no stages."""

    images: tuple[KeypointRecord, ...] = ()

    def rectified(self) -> frozenset[str]:
        """Names of the images whose keypoints are those of a global shutter."""
        return frozenset(record.name for record in self.images if record.rectified)


def _through_stages(database: Path, stages: Sequence[KeypointStage]) -> KeypointRecords:
    import pycolmap

    if not stages:
        return KeypointRecords()
    records = []
    with _writing(database), pycolmap.Database.open(str(database)) as opened:
        for image in opened.read_all_images():
            stored = np.array(opened.read_keypoints(image.image_id))
            keypoints = Keypoints(name=image.name, xy_px=stored[:, :2].astype(np.float64))
            for stage in stages:
                moved = stage(keypoints)
                if moved.name != keypoints.name or moved.xy_px.shape != keypoints.xy_px.shape:
                    raise ValueError(f"keypoint stage {stage!r} must keep names, number and order of keypoints")
                keypoints = moved
            stored[:, :2] = keypoints.xy_px
            opened.update_keypoints(image.image_id, stored)
            records.append(
                KeypointRecord(name=keypoints.name, rectified=keypoints.rectified, treatments=keypoints.treatments)
            )
    return KeypointRecords(images=tuple(records))


def match_features(
    features: Path,
    database: Path,
    pairs: Sequence[tuple[str, str]],
    context: RunContext,
) -> None:
    """Match and verify the pairs in a copy of the features' database."""
    shutil.copyfile(features, database)
    match_pairs(database, pairs, context)


def verify_again(
    matched: Path,
    database: Path,
    pairs: Sequence[tuple[str, str]],
    keypoint_stages: Sequence[KeypointStage],
    context: RunContext,
) -> None:
    """The same matches of keypoints that stages move, verified anew: descriptors tell what they told before."""
    import pycolmap

    shutil.copyfile(matched, database)
    _through_stages(database, keypoint_stages)
    with _writing(database), pycolmap.Database.open(str(database)) as opened:
        opened.clear_two_view_geometries()
    match_pairs(database, pairs, context)


def match_pairs(
    database: Path, pairs: Sequence[tuple[str, str]], context: RunContext, *, done: int = 0, total: int | None = None
) -> None:
    """Match and verify the pairs in a database that holds features; ``done`` of ``total`` are matched already."""
    import pycolmap

    total = len(pairs) if total is None else total
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = context.device == "cuda"
    matching.num_threads = context.num_threads
    pycolmap.set_random_seed(context.seed)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = context.seed
    lines = [f"{a} {b}" for a, b in pairs]
    with tempfile.TemporaryDirectory() as folder:
        listed = Path(folder) / "pairs.txt"
        # how quickly it goes is seen already where some are matched
        for batch in growing_batches(lines, first=_MATCHING_BATCH if done else _FIRST_MATCHING_BATCH):
            context.progress("matches", done, total)
            require_room(database.parent, len(batch) * _PAIR_BYTES)
            listed.write_text("\n".join(batch) + "\n")
            with _writing(database):
                pycolmap.match_image_pairs(
                    str(database),
                    matching_options=matching,
                    pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(listed)),
                    verification_options=verification,
                    device=pycolmap.Device(context.device),
                )
            done += len(batch)
    context.progress("matches", done, total)


@dataclass(frozen=True, kw_only=True)
class ModelEnds(EndsMet):
    """The same, of one of several models; ``model`` is its number."""

    model: int


@dataclass(frozen=True, kw_only=True)
class MapRecord:
    """How models were made.

    Attributes
    ----------
    mapper
        COLMAP's: ``"incremental"`` or ``"global"``.
    models
        How many.
    parts
        Runs of images that were mapped by themselves; 1 where all were mapped in one go.
    ends
        Of models that were mapped in one go: their ends that met.
    """

    mapper: str
    models: int
    parts: int = 1
    ends: tuple[ModelEnds, ...] = ()


def map_images(
    database: Path,
    images: Path,
    sparse: Path,
    options: MappingOptions,
    *,
    refine_intrinsics: bool,
    num_images: int,
    context: RunContext,
    in_time: Sequence[str] = (),
    judged: bool = True,
) -> MapRecord:
    """Run COLMAP's mapper; models are written to ``sparse/0``, ``sparse/1``, ...

    Parameters
    ----------
    in_time
        The images in order of time, where they are of one recording: ends of a model that met are joined then, and what
        is too long for one go is mapped in parts.
    judged
        Whether somebody looked which pairs far apart in time join copies. Nobody does where every pair is matched.

    Raises
    ------
    MappingError
        When no model comes out.
    """
    import pycolmap

    pycolmap.set_random_seed(context.seed)
    sparse.mkdir(parents=True)
    require_room(sparse, database.stat().st_size)
    context.progress("mapping", 0, num_images)
    every_pair = matches_every_pair(num_images, options)
    nearest = None if judged and not every_pair else _NEIGHBOURS * options.overlap
    if options.mapper == "incremental":
        pipeline = _incremental_options(refine_intrinsics, context.num_threads, context.seed)
        if len(in_time) > LONGEST and not every_pair:
            near = _NEIGHBOURS * options.overlap
            record = _map_in_parts(database, images, sparse, pipeline, in_time, near, judged, context)
        else:
            record = _map_in_one_go(database, images, sparse, pipeline, in_time, nearest, num_images, context)
    else:
        models = pycolmap.global_mapping(
            str(database),
            str(images),
            str(sparse),
            options=_global_options(options, refine_intrinsics, context.num_threads, context.seed),
        )
        record = MapRecord(mapper="global", models=len(models))
    context.progress("mapping", num_images, num_images)
    for folder in sparse.iterdir():
        # COLMAP does not say when it could not write one whole
        find_models(folder)
        check_binary_model(folder)
    if not record.models:
        raise MappingError(
            "COLMAP found no model: too few matches between the frames. Film with more overlap, more texture or less "
            "blur, or try --mapping.pairing exhaustive"
        )
    log.info("mapping: %s", record)
    return record


def _map_in_one_go(
    database: Path,
    images: Path,
    sparse: Path,
    pipeline: pycolmap.IncrementalPipelineOptions,
    in_time: Sequence[str],
    nearest: int | None,
    num_images: int,
    context: RunContext,
) -> MapRecord:
    import pycolmap

    models = pycolmap.incremental_mapping(
        str(database),
        str(images),
        str(sparse),
        options=pipeline,
        next_image_callback=_counter(context.progress, num_images),
    )
    ends = []
    for number, model in models.items() if in_time else ():
        met = close_gaps(database, model, pipeline, in_time, nearest=nearest)
        if met is not None:
            ends.append(ModelEnds(model=number, **vars(met)))
            if met.joined:
                model.write_binary(str(sparse / str(number)))
    return MapRecord(mapper="incremental", models=len(models), ends=tuple(ends))


def _map_in_parts(
    database: Path,
    images: Path,
    sparse: Path,
    pipeline: pycolmap.IncrementalPipelineOptions,
    in_time: Sequence[str],
    near: int,
    loops: bool,
    context: RunContext,
) -> MapRecord:
    # neighbouring parts have some images both
    parts = runs(len(in_time))
    counted = _counter(context.progress, len(in_time), of=sum(end - begin for begin, end in parts))
    models = map_in_parts(
        database, images, context.scratch, pipeline, in_time, parts, near=near, loops=loops, registered=counted
    )
    for number, model in enumerate(models):
        model.extract_colors_for_all_images(str(images))
        (sparse / str(number)).mkdir()
        model.write_binary(str(sparse / str(number)))
    return MapRecord(mapper="incremental", models=len(models), parts=len(parts))


def _counter(progress: Progress, total: int, *, of: int | None = None) -> Callable[[], None]:
    """Counts up to ``total``; where some images come several times, ``of`` so many calls."""
    count = itertools.count(1)

    def registered() -> None:
        progress("mapping", min(next(count) * total // (of or total), total), total)

    return registered


def _incremental_options(refine: bool, num_threads: int, seed: int) -> pycolmap.IncrementalPipelineOptions:
    import pycolmap

    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads = num_threads
    pipeline.random_seed = seed
    pipeline.ba_refine_focal_length = refine
    pipeline.ba_refine_extra_params = refine
    pipeline.mapper.abs_pose_refine_focal_length = refine
    pipeline.mapper.abs_pose_refine_extra_params = refine
    if not refine:
        pipeline.ba_global_frames_ratio = pipeline.ba_global_points_ratio = _GLOBAL_RATIO
    return pipeline


def _global_options(
    options: MappingOptions, refine: bool, num_threads: int, seed: int
) -> pycolmap.GlobalPipelineOptions:
    import pycolmap

    pipeline = pycolmap.GlobalPipelineOptions()
    pipeline.num_threads = num_threads
    pipeline.random_seed = seed
    pipeline.mapper.bundle_adjustment.refine_focal_length = refine
    pipeline.mapper.bundle_adjustment.refine_extra_params = refine
    pipeline.mapper.rotation_averaging.use_gravity = options.gravity_priors
    return pipeline


def write_gravity_priors(database: Path, gravity_in_cam: Mapping[str, Array]) -> None:
    """Give images their gravity direction (down, camera frame) as COLMAP pose priors."""
    import pycolmap

    if not gravity_in_cam:
        return
    with _writing(database), pycolmap.Database.open(str(database)) as opened:
        for image in opened.read_all_images():
            direction = gravity_in_cam.get(image.name)
            if direction is not None:
                prior = pycolmap.PosePrior()
                prior.gravity = direction / np.linalg.norm(direction)
                prior.corr_data_id = image.data_id
                opened.write_pose_prior(prior)
