"""COLMAP's incremental mapper, begun with two images whose pose is right.

Of two views of what passes as a plane there are two poses, and views in close succession pass as those of a plane,
whatever they show. COLMAP begins a model with the pose by a homography then, and takes it for the parallax that it
wants: of EuRoC MH_01 at 20 Hz it is off by 5 to 20 degrees for most pairs that COLMAP tries. A model that begins so
never gets rid of it.
"""

from __future__ import annotations

import logging
import math
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.colmap.views.two_views import RelativePose, estimate_relative_pose, open_features
from colmap_inertial.core.geometry import matrix_from_quat, quat_from_matrix, so3_log

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class InitialPairLimits:
    """Limits for the two images that a model begins with."""

    #: COLMAP's pose of two views is wrong that is turned so far from the one that suits their matches best: right ones
    #: are off by .1 to .5 degrees.
    wrong_rad: float = math.radians(1.5)
    #: Factors of COLMAP's least number of matches and of its least parallax, in the order in which it relaxes them.
    relaxations: tuple[tuple[float, float], ...] = ((1, 1), (0.5, 1), (0.5, 0.5), (0.25, 0.5), (0.25, 0.25))


_LIMITS = InitialPairLimits()
#: What pycolmap takes for no image.
_ANY = -1


@dataclass(frozen=True, eq=False, kw_only=True)
class _FirstPair:
    """Two images that a model begins with.

    Attributes
    ----------
    numbers
        COLMAP's.
    pose
        Of ours; ``None`` where COLMAP finds the right one.
    """

    numbers: tuple[int, int]
    pose: RelativePose | None


@dataclass(frozen=True, eq=False, kw_only=True)
class _Work:
    """Arguments of :func:`map_incrementally`."""

    database: Path
    images: Path
    registered: Callable[[], None]
    orientations: ImageOrientations
    scratch: Path


def map_incrementally(
    database: Path,
    images: Path,
    sparse: Path,
    pipeline: pycolmap.IncrementalPipelineOptions,
    registered: Callable[[], None],
    *,
    orientations: ImageOrientations,
    scratch: Path,
) -> dict[int, pycolmap.Reconstruction]:
    """Run COLMAP's incremental mapper; models are written to ``sparse/0``, ``sparse/1``, ...

    Where cameras are known and COLMAP would begin with a wrong pose, a model begins with the pose that suits the
    matches best. Of the images that it leaves, further models are made.

    Parameters
    ----------
    pipeline
        COLMAP's options.
    registered
        Is called for each image that is placed.
    orientations
        Of the images, by the gyroscope; of those that it does not know, both poses may suit the matches.
    scratch
        For temporary files.
    """
    work = _Work(database=database, images=images, registered=registered, orientations=orientations, scratch=scratch)
    known = not pipeline.ba_refine_focal_length and pipeline.init_image_id1 == pipeline.init_image_id2 == _ANY
    own = _map_from_first_pair(work, pipeline) if known else None
    if own is None:
        return _run_colmap(work, sparse, pipeline)
    models, placed = [own], _names_of(own)
    while pipeline.multiple_models and len(models) < pipeline.max_num_models:
        asked = _copy(pipeline)
        asked.image_names = _find_rest(database, pipeline, placed)
        if len(asked.image_names) < pipeline.min_model_size:
            break
        further = _map_from_first_pair(work, asked)
        with tempfile.TemporaryDirectory(dir=scratch) as folder:
            found = [further] if further is not None else list(_run_colmap(work, Path(folder), asked).values())
        # images that models have both may make another by themselves
        new = [model for model in found if _names_of(model) - placed]
        models += new
        placed = placed.union(*map(_names_of, new))
        if further is None or not new:
            break
    for number, model in enumerate(models):
        (sparse / str(number)).mkdir()
        model.write_binary(str(sparse / str(number)))
    return dict(enumerate(models))


def _run_colmap(
    work: _Work, sparse: Path, pipeline: pycolmap.IncrementalPipelineOptions, begun: Path | None = None
) -> dict[int, pycolmap.Reconstruction]:
    """COLMAP's mapper as it is, or from a model that is begun."""
    import pycolmap

    return dict(
        pycolmap.incremental_mapping(
            str(work.database),
            str(work.images),
            str(sparse),
            options=pipeline,
            input_path="" if begun is None else str(begun),
            next_image_callback=work.registered,
        )
    )


def _map_from_first_pair(work: _Work, pipeline: pycolmap.IncrementalPipelineOptions) -> pycolmap.Reconstruction | None:
    """A model that begins with the right pose of two images; ``None`` where none is found, or nothing comes of it."""
    with tempfile.TemporaryDirectory(dir=work.scratch) as folder:
        made, pair = Path(folder) / "made", Path(folder) / "pair"
        options = _begin_model(work, pipeline, pair)
        if options is None:
            return None
        made.mkdir()
        model = _run_colmap(work, made, options, pair if pair.is_dir() else None).get(0)
    return model if model is not None and model.num_reg_images() >= pipeline.min_model_size else None


def _begin_model(
    work: _Work, pipeline: pycolmap.IncrementalPipelineOptions, pair: Path
) -> pycolmap.IncrementalPipelineOptions | None:
    """Options with the first pair, if COLMAP finds its pose, or a model of this pair, written to the folder ``pair``.

    ``None`` where no two images are suitable.
    """
    import pycolmap

    asked = pycolmap.DatabaseCacheOptions()
    asked.min_num_matches, asked.image_names = pipeline.min_num_matches, set(pipeline.image_names)
    with pycolmap.Database.open(str(work.database)) as opened:
        mapper = pycolmap.IncrementalMapper(pycolmap.DatabaseCache.create(opened, asked))
    model = pycolmap.Reconstruction()
    mapper.begin_reconstruction(model)
    limits = pipeline.get_mapper()
    first = _choose_first_pair(work, mapper, limits)
    if first is None:
        return None
    options = _copy(pipeline)
    options.multiple_models = False
    if first.pose is None:
        options.init_image_id1, options.init_image_id2 = first.numbers
        options.mapper.init_min_num_inliers = limits.init_min_num_inliers
        options.mapper.init_min_tri_angle = limits.init_min_tri_angle
        return options
    _reconstruct_pair(mapper, model, pipeline, limits, first.numbers, first.pose)
    for number in model.reg_image_ids():
        if pipeline.extract_colors:
            model.extract_colors_for_image(number, str(work.images))
        work.registered()
    pair.mkdir()
    model.write_binary(str(pair))
    return options


def _choose_first_pair(
    work: _Work, mapper: pycolmap.IncrementalMapper, limits: pycolmap.IncrementalMapperOptions
) -> _FirstPair | None:
    """The first pair that COLMAP proposes whose pose it finds, or that has the parallax that it asks for.

    Where there is none, the one of most parallax. The limits become as loose as COLMAP makes them.
    """
    best: _FirstPair | None = None
    largest_rad = 0.0
    with open_features(work.database) as features:
        names = {image.image_id: name for name, image in features.images.items()}
        for numbers, theirs in _propose_pairs(mapper, limits):
            first, second = (names[number] for number in numbers)
            pose = estimate_relative_pose(features, first, second, work.orientations.find_rotation(first, second))
            if pose is None or not _is_wrong(theirs, pose):
                best = _FirstPair(numbers=numbers, pose=None)
                break
            log.info("%s and %s: COLMAP begins with a wrong pose", first, second)
            if pose.parallax_rad > largest_rad:
                best, largest_rad = _FirstPair(numbers=numbers, pose=pose), pose.parallax_rad
            if largest_rad >= math.radians(limits.init_min_tri_angle):
                break
    return best


def _reconstruct_pair(
    mapper: pycolmap.IncrementalMapper,
    model: pycolmap.Reconstruction,
    pipeline: pycolmap.IncrementalPipelineOptions,
    limits: pycolmap.IncrementalMapperOptions,
    numbers: tuple[int, int],
    pose: RelativePose,
) -> None:
    """Two images and their points, as COLMAP begins a model."""
    import pycolmap

    turn = pycolmap.Rotation3d(quat_from_matrix(pose.second_from_first))
    mapper.register_initial_image_pair(limits, *numbers, pycolmap.Rigid3d(turn, pose.translation))
    for number in numbers:
        mapper.triangulate_image(pipeline.get_triangulation(), number)
    mapper.adjust_global_bundle(limits, pipeline.get_global_bundle_adjustment())
    model.normalize()
    mapper.filter_points(limits)
    mapper.filter_frames(limits)
    mapper.end_reconstruction(False)


def _propose_pairs(
    mapper: pycolmap.IncrementalMapper, limits: pycolmap.IncrementalMapperOptions
) -> Iterator[tuple[tuple[int, int], pycolmap.Rigid3d]]:
    """Pairs that COLMAP would begin with, and its poses ``second_from_first``; the limits become looser."""
    least_matches, least_deg = limits.init_min_num_inliers, limits.init_min_tri_angle
    for of_matches, of_parallax in _LIMITS.relaxations:
        limits.init_min_num_inliers = int(least_matches * of_matches)
        limits.init_min_tri_angle = least_deg * of_parallax
        mapper.reset_initialization_stats()
        # each call leaves out what those before have found
        while (found := mapper.find_initial_image_pair(limits, _ANY, _ANY)) is not None:
            yield found


def _is_wrong(theirs: pycolmap.Rigid3d, pose: RelativePose) -> bool:
    """Whether COLMAP's pose is turned otherwise than the one that suits the matches best."""
    turned = pose.second_from_first.T @ matrix_from_quat(np.array(theirs.rotation.quat))
    return float(np.linalg.norm(so3_log(turned))) > _LIMITS.wrong_rad


def _copy(pipeline: pycolmap.IncrementalPipelineOptions) -> pycolmap.IncrementalPipelineOptions:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.mergedict(pipeline.todict())
    return options


def _names_of(model: pycolmap.Reconstruction) -> set[str]:
    return {model.image(number).name for number in model.reg_image_ids()}


def _find_rest(database: Path, pipeline: pycolmap.IncrementalPipelineOptions, placed: Set[str]) -> list[str]:
    """Images that no model has, and those of the models, few, that have most matches with them."""
    import pycolmap

    with open_features(database) as features:
        names = {image.image_id: name for name, image in features.images.items()}
        asked = set(pipeline.image_names) or set(names.values())
        rest, joined = asked - placed, Counter[str]()
        numbers, counts = features.database.read_two_view_geometry_num_inliers()
        for number, count in zip(numbers, counts, strict=True):
            first, second = (names[image] for image in pycolmap.pair_id_to_image_pair(number))
            if count >= pipeline.min_num_matches and {first, second} <= asked:
                for one, other in ((first, second), (second, first)):
                    if one in placed and other in rest:
                        joined[one] += count
    if len(rest) < pipeline.min_model_size:
        return []
    return sorted([*rest, *sorted(joined, key=lambda name: (-joined[name], name))[: pipeline.max_model_overlap]])
