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
from collections.abc import Callable, Iterator
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
class _Beginning:
    """Numbers of two images to begin with, the second one's pose in the first one's frame, and their parallax."""

    pair: tuple[int, int]
    pose: pycolmap.Rigid3d
    parallax_rad: float

    @classmethod
    def of(cls, pair: tuple[int, int], pose: RelativePose) -> _Beginning:
        import pycolmap

        turn = pycolmap.Rotation3d(quat_from_matrix(pose.second_from_first))
        second_from_first = pycolmap.Rigid3d(turn, pose.translation)
        return cls(pair=pair, pose=second_from_first, parallax_rad=pose.parallax_rad)


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
    import pycolmap

    own = None
    if not pipeline.ba_refine_focal_length and pipeline.init_image_id1 == pipeline.init_image_id2 == _ANY:
        own = _map_from_own_pair(database, images, pipeline, registered, orientations, scratch)
    if own is None:
        return dict(
            pycolmap.incremental_mapping(
                str(database), str(images), str(sparse), options=pipeline, next_image_callback=registered
            )
        )
    models = [own]
    rest = _find_rest(database, pipeline, own)
    if pipeline.multiple_models and pipeline.max_num_models > 1 and len(rest) >= pipeline.min_model_size:
        further = pycolmap.IncrementalPipelineOptions()
        further.mergedict(pipeline.todict())
        further.image_names, further.max_num_models = rest, pipeline.max_num_models - 1
        with tempfile.TemporaryDirectory(dir=scratch) as folder:
            models += map_incrementally(
                database, images, Path(folder), further, registered, orientations=orientations, scratch=scratch
            ).values()
    for number, model in enumerate(models):
        (sparse / str(number)).mkdir()
        model.write_binary(str(sparse / str(number)))
    return dict(enumerate(models))


def _map_from_own_pair(
    database: Path,
    images: Path,
    pipeline: pycolmap.IncrementalPipelineOptions,
    registered: Callable[[], None],
    orientations: ImageOrientations,
    scratch: Path,
) -> pycolmap.Reconstruction | None:
    """A model that begins with a pose of ours; ``None`` where COLMAP's own is right, or nothing comes of ours."""
    import pycolmap

    begun = _reconstruct_first_pair(database, pipeline, orientations)
    if begun is None:
        return None
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        pair, made = Path(folder) / "pair", Path(folder) / "made"
        pair.mkdir()
        made.mkdir()
        for number in begun.reg_image_ids():
            if pipeline.extract_colors:
                begun.extract_colors_for_image(number, str(images))
            registered()
        begun.write_binary(str(pair))
        model = pycolmap.incremental_mapping(
            str(database),
            str(images),
            str(made),
            options=pipeline,
            input_path=str(pair),
            next_image_callback=registered,
        ).get(0)
    return model if model is not None and model.num_reg_images() >= pipeline.min_model_size else None


def _reconstruct_first_pair(
    database: Path, pipeline: pycolmap.IncrementalPipelineOptions, orientations: ImageOrientations
) -> pycolmap.Reconstruction | None:
    """Two images and their points; ``None`` where COLMAP begins with the right pose, or no better one is found."""
    import pycolmap

    asked = pycolmap.DatabaseCacheOptions()
    asked.min_num_matches, asked.image_names = pipeline.min_num_matches, set(pipeline.image_names)
    with pycolmap.Database.open(str(database)) as opened:
        mapper = pycolmap.IncrementalMapper(pycolmap.DatabaseCache.create(opened, asked))
    model = pycolmap.Reconstruction()
    mapper.begin_reconstruction(model)
    options = pipeline.get_mapper()
    pose = None
    with open_features(database) as features:
        names = {image.image_id: name for name, image in features.images.items()}
        best: _Beginning | None = None
        for pair, theirs in _propose_pairs(mapper, options):
            first, second = (names[image] for image in pair)
            pose = estimate_relative_pose(features, first, second, orientations.find_rotation(first, second))
            if pose is None or not _is_wrong(theirs, pose):
                best = _Beginning(pair=pair, pose=theirs, parallax_rad=math.inf)
                break
            own = _Beginning.of(pair, pose)
            if best is None or own.parallax_rad > best.parallax_rad:
                best = own
            if own.parallax_rad >= math.radians(options.init_min_tri_angle):
                break
    if best is None:
        return None
    log.info("mapping begins with %s and %s", *(names[image] for image in best.pair))
    mapper.register_initial_image_pair(options, *best.pair, best.pose)
    for image in best.pair:
        mapper.triangulate_image(pipeline.get_triangulation(), image)
    mapper.adjust_global_bundle(options, pipeline.get_global_bundle_adjustment())
    model.normalize()
    mapper.filter_points(options)
    mapper.filter_frames(options)
    mapper.end_reconstruction(False)
    return model if model.num_reg_images() and model.num_points3D() else None


def _propose_pairs(
    mapper: pycolmap.IncrementalMapper, options: pycolmap.IncrementalMapperOptions
) -> Iterator[tuple[tuple[int, int], pycolmap.Rigid3d]]:
    """Pairs that COLMAP would begin with, and its poses ``second_from_first``; limits in the options become looser."""
    least_matches, least_deg = options.init_min_num_inliers, options.init_min_tri_angle
    for of_matches, of_parallax in _LIMITS.relaxations:
        options.init_min_num_inliers = int(least_matches * of_matches)
        options.init_min_tri_angle = least_deg * of_parallax
        mapper.reset_initialization_stats()
        # each call leaves out what those before have found
        while (found := mapper.find_initial_image_pair(options, _ANY, _ANY)) is not None:
            yield found


def _is_wrong(theirs: pycolmap.Rigid3d, pose: RelativePose) -> bool:
    """Whether COLMAP's pose is turned otherwise than the one that suits the matches best."""
    turned = pose.second_from_first.T @ matrix_from_quat(np.array(theirs.rotation.quat))
    return float(np.linalg.norm(so3_log(turned))) > _LIMITS.wrong_rad


def _find_rest(
    database: Path, pipeline: pycolmap.IncrementalPipelineOptions, model: pycolmap.Reconstruction
) -> list[str]:
    """Images that a model leaves, and those of its own, few, that have most matches with them."""
    import pycolmap

    placed = {model.image(number).name for number in model.reg_image_ids()}
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
    shared = sorted(joined, key=lambda name: (-joined[name], name))[: pipeline.max_model_overlap]
    return sorted([*rest, *shared]) if rest else []
