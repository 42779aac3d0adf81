"""COLMAP's own stages before its mapper: features and matches, with progress and nothing left half-written."""

from __future__ import annotations

import contextlib
import itertools
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np

from colmap_inertial.colmap.chunks import CHUNKS_FOLDER
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features.chunks import (
    FindFeatures,
    MatchPairs,
    find_elsewhere,
    is_worth_chunks,
    match_elsewhere,
    state_reader,
)
from colmap_inertial.colmap.installed import InstalledColmap
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError, InertialError, MappingError, OutputError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.progress import make_counter, silent
from colmap_inertial.core.types import CameraModel, Keypoints, Treatment
from colmap_inertial.hooks import KeypointStage
from colmap_inertial.io.disk import remove, require_room
from colmap_inertial.model import colmap_camera

if TYPE_CHECKING:
    import pycolmap

Item = TypeVar("Item")

#: Up to this many images every pair is matched; above it, neighbours in time. Of a video, whose frames are usually less
#: than so far apart, up to fewer: those beside a frame show what it does, and a pair of two places is as good as ten.
_EXHAUSTIVE_UP_TO, _EXHAUSTIVE_OF_VIDEO, _VIDEO_SPACING_S = 150, 60, 0.5
#: Images whose features are found in one go; the first ones are few, so that one sees soon how quickly it goes.
_FIRST_EXTRACTION_BATCH, _EXTRACTION_BATCH = 4, 16
_ALIKED_FILES = ("AlikedExtraction.n16rot_model_path", "AlikedMatching.lightglue_model_path")
#: Each batch indexes its images' features anew, an image as dear as two pairs; the first are small, so that one sees
#: soon how quickly it goes.
_FIRST_MATCHING_BATCH, _MATCHING_BATCH, _PAIRS_OF_AN_INDEX = 40, 1600, 2
#: What a feature takes in the database at most, several orientations and SQLite's log included; likewise a pair.
_FEATURE_BYTES = 500
_PAIR_BYTES = 100_000


@contextlib.contextmanager
def writing_database(database: Path) -> Iterator[None]:
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
        raise OutputError(Fact("database-not-written", database=str(database))) from error


def mapping_device(options: MappingOptions, *, deterministic: bool) -> Literal["cpu", "cuda"]:
    """The device that features are extracted and matched on.

    Raises
    ------
    InertialError
        Where CUDA is asked for and pycolmap has none.
    """
    import pycolmap

    if options.device == "auto":
        return "cuda" if pycolmap.has_cuda and not deterministic else "cpu"
    if options.device == "cuda" and not pycolmap.has_cuda:
        raise InertialError(Fact("pycolmap-without-cuda"))
    return options.device


def require_features(context: RunContext) -> None:
    """Say before any work where the features that are asked for cannot be found.

    Raises
    ------
    InertialError
        Where pycolmap has no ONNX, or the files of the networks are not named: COLMAP would download them.
    """
    import pycolmap

    if context.features == "sift":
        return
    if not hasattr(pycolmap.FeatureExtractionOptions(), "aliked"):
        raise InertialError(Fact("pycolmap-without-onnx"))
    named = dict(text.split("=", 1) for text in context.colmap.settings)
    missing = [name for name in _ALIKED_FILES if not Path(named.get(name, "")).is_file()]
    if missing:
        raise InertialError(Fact("networks-not-named", options=missing))


def check_pair_names(names: Sequence[str]) -> None:
    """Raise ``FormatError`` for an image name that COLMAP's lists of pairs cannot hold."""
    for name in names:
        if len(name.split()) != 1 or name.startswith("#"):
            raise FormatError(Path(name), Fact("name-not-for-pairs"))


def matches_every_pair(count: int, options: MappingOptions, t_s: Array | None = None) -> bool:
    """Whether every pair of so many images, taken at ``t_s``, is matched, and not only neighbours in time."""
    video = t_s is not None and len(t_s) > 1 and float(np.median(np.diff(t_s))) < _VIDEO_SPACING_S
    most = _EXHAUSTIVE_OF_VIDEO if video else _EXHAUSTIVE_UP_TO
    return options.pairing == "exhaustive" or (options.pairing == "auto" and count <= most)


def image_pairs(names: Sequence[str], options: MappingOptions, t_s: Array | None = None) -> list[tuple[str, str]]:
    """The pairs to match, by names in order of time, and times where they are known."""
    if matches_every_pair(len(names), options, t_s):
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
    rig: Sequence[str] = (),
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
    rig
        Folders of images whose cameras are COLMAP cameras of their own, whatever their intrinsics.

    Returns
    -------
    What the stages did to the keypoints of each image.
    """
    works, remote, count = [], context.executor.remote, len(cameras)
    if remote:
        # what others find is there twice until all of it is
        require_room_for_features(database, count, options, copies=2)
    settings = context.colmap.identity("features") if remote else []
    # only what is found here is heard while images are entered
    entering = context.reporting(silent) if remote else context
    for batch, reader in register_images(images, cameras, database, entering, rig):
        if not remote:
            require_room_for_features(database, len(batch), options)
        work = FindFeatures(
            names=tuple(batch),
            reader=state_reader(reader),
            extraction=extraction_options(options, context).todict(),
            device=context.device,
            seed=context.seed,
            settings=settings,
        )
        if remote:
            works.append(work)
        else:
            with writing_database(database):
                work.find(database, images)
    if works:
        context.progress("features", 0, count)
        with writing_database(database):
            told = make_counter(context.progress, "features", count)
            find_elsewhere(works, database, images, context.scratch / CHUNKS_FOLDER, context.executor, told)
        context.progress("features", count, count)
    records = apply_keypoint_stages(database, keypoint_stages)
    if works:
        remove(context.scratch / CHUNKS_FOLDER)
    return records


def require_room_for_features(database: Path, images: int, options: MappingOptions, *, copies: int = 1) -> None:
    """Raise ``OutputError`` where the features of so many images may find no room in a database, or in copies."""
    require_room(database, images * options.max_num_features * _FEATURE_BYTES, copies=copies)


def register_images(
    images: Path,
    cameras: Mapping[str, CameraModel | None],
    database: Path,
    context: RunContext,
    rig: Sequence[str] = (),
) -> Iterator[tuple[list[str], pycolmap.ImageReaderOptions]]:
    """Enter images and their cameras into a database, a batch at a time; each with the options to read its images."""
    import pycolmap

    groups: dict[tuple[str, CameraModel | None], list[str]] = {}
    for name, camera in cameras.items():
        folder = name.partition("/")[0]
        known = _intern(camera, [model for _, model in groups])
        groups.setdefault((folder if folder in rig else "", known), []).append(name)
    done = 0
    for (_, camera), names in groups.items():
        reader = context.colmap.apply(pycolmap.ImageReaderOptions())
        if camera is not None:
            colmap_camera(camera)  # raises on wrong parameters before any work
            reader.camera_model = camera.model
            reader.camera_params = ",".join(repr(p) for p in camera.params)
        for batch in growing_batches(sorted(names), first=_FIRST_EXTRACTION_BATCH, most=_EXTRACTION_BATCH):
            context.progress("features", done, len(cameras))
            require_room(database, len(batch) * _PAIR_BYTES)  # for the images alone
            with writing_database(database):
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
            yield batch, reader
            with writing_database(database), pycolmap.Database.open(str(database)) as opened:
                first = opened.read_image_with_name(batch[0])
                if first is None:
                    raise MappingError(Fact("image-unread", path=str(images / batch[0])))
                reader.existing_camera_id = first.camera_id
            done += len(batch)
    context.progress("features", done, len(cameras))


def extraction_options(options: MappingOptions, context: RunContext) -> pycolmap.FeatureExtractionOptions:
    """COLMAP's options of extraction."""
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = context.device == "cuda"
    extraction.num_threads = context.num_threads
    if options.max_image_size is not None:
        extraction.max_image_size = options.max_image_size
    extraction.sift.max_num_features = options.max_num_features
    extraction.sift.first_octave = options.first_octave
    if context.features == "aliked":
        extraction.type = pycolmap.FeatureExtractorType.ALIKED_N16ROT
    return context.colmap.apply(extraction)


def matching_options(context: RunContext) -> pycolmap.FeatureMatchingOptions:
    """COLMAP's options of matching."""
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = context.device == "cuda"
    matching.num_threads = context.num_threads
    if context.features == "aliked":
        matching.type = pycolmap.FeatureMatcherType.ALIKED_LIGHTGLUE
    return context.colmap.apply(matching)


def verification_options(context: RunContext) -> pycolmap.TwoViewGeometryOptions:
    """COLMAP's options of the verification of matches."""
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = context.seed
    return context.colmap.apply(verification)


def _intern(camera: CameraModel | None, known: Iterable[CameraModel | None]) -> CameraModel | None:
    """The equal camera among the known ones, so that frames of one device share one COLMAP camera."""
    return next((k for k in known if k is not None and camera is not None and vars(k) == vars(camera)), camera)


def growing_batches(
    items: Sequence[Item], *, first: int = _FIRST_MATCHING_BATCH, most: int = _MATCHING_BATCH
) -> list[list[Item]]:
    """Pairs or images in batches, each twice as large as the one before, up to a limit."""
    batches, begin, size = [], 0, first
    while begin < len(items):
        batches.append(list(items[begin : begin + size]))
        begin, size = begin + size, min(2 * size, most)
    return batches


@dataclass(frozen=True, kw_only=True)
class KeypointRecord:
    """Record of what the keypoint stages did to one image; see :class:`~colmap_inertial.core.types.Keypoints`."""

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


def apply_keypoint_stages(database: Path, stages: Sequence[KeypointStage], *, store: bool = True) -> KeypointRecords:
    """Let stages move all keypoints of a database, and record what they did; unless ``store``, only record it."""
    import pycolmap

    if not stages:
        return KeypointRecords()
    records = []
    with writing_database(database), pycolmap.Database.open(str(database)) as opened:
        for image in opened.read_all_images():
            stored = np.array(opened.read_keypoints(image.image_id))
            keypoints = Keypoints(name=image.name, xy_px=stored[:, :2].astype(np.float64))
            for stage in stages:
                moved = stage(keypoints)
                if moved.name != keypoints.name or moved.xy_px.shape != keypoints.xy_px.shape:
                    raise ValueError(f"keypoint stage {stage!r} must keep names, number and order of keypoints")
                keypoints = moved
            stored[:, :2] = keypoints.xy_px
            if store:
                opened.update_keypoints(image.image_id, stored)
            records.append(
                KeypointRecord(name=keypoints.name, rectified=keypoints.rectified, treatments=keypoints.treatments)
            )
    return KeypointRecords(images=tuple(records))


def verify_again(
    matched: Path,
    database: Path,
    pairs: Sequence[tuple[str, str]],
    keypoint_stages: Sequence[KeypointStage],
    context: RunContext,
) -> None:
    """The same matches of keypoints that stages move, verified anew: descriptors do not change."""
    import pycolmap

    shutil.copyfile(matched, database)
    apply_keypoint_stages(database, keypoint_stages)
    with writing_database(database), pycolmap.Database.open(str(database)) as opened:
        opened.clear_two_view_geometries()
    match_pairs(database, pairs, context)


def match_pairs(
    database: Path, pairs: Sequence[tuple[str, str]], context: RunContext, *, done: int = 0, total: int | None = None
) -> int:
    """Match and verify the pairs in a database that holds features.

    Parameters
    ----------
    done, total
        Work before (:func:`matching_work`), and in all, by default that of these pairs.

    Returns
    -------
    The work that is done.
    """
    # how quickly it goes is seen already where some are matched
    batches = growing_batches(pairs, first=_MATCHING_BATCH if done else _FIRST_MATCHING_BATCH)
    own = sum(map(_batch_work, batches))
    total = done + own if total is None else total
    work = MatchPairs(
        pairs=tuple(pairs),
        matching=matching_options(context).todict(),
        verification=verification_options(context).todict(),
        device=context.device,
        seed=context.seed,
        settings=context.colmap.identity("matches"),
        database=database,
    )
    if is_worth_chunks(pairs, context.executor):
        require_room(database, len(pairs) * _PAIR_BYTES, copies=2)
        matched = make_counter(context.progress, "matches", total, begin=done, steps=own, of=len(pairs))
        with writing_database(database):
            match_elsewhere(work, context.scratch / CHUNKS_FOLDER, context.executor, matched)
        batches, done = [], done + own
    with tempfile.TemporaryDirectory(dir=context.scratch) as folder:
        theirs = Path(folder) / "installed.db"
        installed = None
        if context.executable is not None and pairs:
            installed = InstalledColmap(executable=context.executable, scratch=context.scratch)
            installed.copy_features(database, theirs)
        for batch in batches:
            context.progress("matches", done, total)
            require_room(database, len(batch) * _PAIR_BYTES)
            if installed is not None:
                installed.match(database, theirs, batch)
            with writing_database(database):
                replace(work, pairs=tuple(batch)).match(database, Path(folder))
            done += _batch_work(batch)
    context.progress("matches", done, total)
    return done


def matching_work(pairs: Sequence[tuple[str, str]]) -> int:
    """Cost of matching pairs after others, in pairs: to index an image's features for a batch costs as much as two.

    With that, batches of 20 to 570 pairs of the example scene take the same time a unit within 10 %
    (``scripts/studies/progress.py``).
    """
    return sum(map(_batch_work, growing_batches(pairs, first=_MATCHING_BATCH)))


def _batch_work(batch: Sequence[tuple[str, str]]) -> int:
    return len(batch) + _PAIRS_OF_AN_INDEX * len({name for pair in batch for name in pair})


def write_gravity_priors(database: Path, gravity_in_cam: Mapping[str, Array]) -> None:
    """Give images their gravity direction (down, camera frame) as COLMAP pose priors."""
    import pycolmap

    if not gravity_in_cam:
        return
    with writing_database(database), pycolmap.Database.open(str(database)) as opened:
        for image in opened.read_all_images():
            direction = gravity_in_cam.get(image.name)
            if direction is not None:
                prior = pycolmap.PosePrior()
                prior.gravity = direction / np.linalg.norm(direction)
                prior.corr_data_id = image.data_id
                opened.write_pose_prior(prior)


@dataclass(frozen=True, kw_only=True)
class MatchRecord:
    """Pairs that were matched, and why not the rest.

    Attributes
    ----------
    device
        What extracted and matched features: ``"cpu"`` or ``"cuda"``.
    pairing
        ``"exhaustive"`` or ``"sequential"``.
    images, pairs
        How many there are, and pairs by the pairing.
    given
        Pairs that a given database has matches of.
    still
        Frames that show what one before them does, as the camera stood still; they are matched with that one alone.
    far
        Pairs of neighbours far apart in time that were left out, or matched only as candidates for loops: loops are
        sought in their place, where the gyroscope can be used.
    apart
        Pairs that were excluded: by the gyroscope the camera looked elsewhere.
    unlike
        Pairs that were excluded: their largest features show nothing in common.
    loops_compared
        Pairs of frames about a second apart and far apart in time whose largest features were compared, as neither the
        gyroscope nor the relative track excludes them.
    loop_candidates
        Pairs that were matched as they may close a loop.
    loops_refused
        Of these, pairs that COLMAP verified and that were left out: their matches cover too little of both images,
        contradict the gyroscope's rotation, the relative track, or other loops, or no pair beside them agrees.
    loops_closed
        Of these, pairs that stay.
    returns
        Pairs of frames far apart in time of a short video that stay as they look alike, or as one of them shares little
        with its neighbours, and, where the gyroscope and matches enough can tell, turned as it did; no more is known.
    matched, verified
        Pairs that were matched, and those of them whose matches COLMAP verified.
    gyroscope
        How its heading was used, or why not.
    heading_sigma_deg
        Largest standard deviation of the heading between two frames; ``None`` where it was not used.
    """

    device: str
    pairing: str
    images: int
    pairs: int
    given: int = 0
    still: int = 0
    far: int = 0
    apart: int = 0
    unlike: int = 0
    loops_compared: int = 0
    loop_candidates: int = 0
    loops_refused: int = 0
    loops_closed: int = 0
    returns: int = 0
    matched: int
    verified: int
    gyroscope: str
    heading_sigma_deg: float | None = None

    @property
    def judged(self) -> bool:
        """Whether somebody looked which pairs far apart in time join copies."""
        return self.pairing != "exhaustive" and not self.returns
