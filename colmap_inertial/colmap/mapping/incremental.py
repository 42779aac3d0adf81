"""COLMAP's incremental mapper, begun with two images whose pose is right.

Of two views of what passes as a plane there are two poses, and views in close succession pass as those of a plane,
whatever they show. COLMAP begins a model with the pose by a homography then, and takes it for the parallax that it
wants. A model that begins so hardly ever gets rid of it.
"""

from __future__ import annotations

import logging
import math
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.colmap.views.two_views import (
    Features,
    RelativePose,
    estimate_relative_pose,
    measure_parallax_rad,
    open_features,
)
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_from_matrix, so3_log

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class InitialPairLimits:
    """Limits for the two images that a model begins with."""

    #: COLMAP's pose of two views is wrong that is turned so far from the one that suits their matches best; so is one
    #: of ours that is turned so far from the gyroscope's.
    wrong_rad: float = math.radians(1.5)
    #: Factors of COLMAP's least number of matches and of its least parallax, in the order in which it relaxes them ...
    relaxations: tuple[tuple[float, float], ...] = ((1, 1), (0.5, 1), (0.5, 0.5), (0.25, 0.5), (0.25, 0.25))
    #: ... and in which they are relaxed here: few matches begin a model worse than little parallax.
    #: At last, the one of most parallax is taken.
    own_relaxations: tuple[tuple[float, float], ...] = (
        *((1, 1), (1, 0.5), (1, 0.25), (0.5, 1), (0.5, 0.5), (0.5, 0.25)),
        (1, 0),
    )


_LIMITS = InitialPairLimits()
#: What pycolmap takes for no image.
_ANY = -1


@dataclass(frozen=True, eq=False, kw_only=True)
class _FirstPair:
    """Two images that a model begins with, by COLMAP's numbers, and their pose where COLMAP's own is wrong."""

    numbers: tuple[int, int]
    pose: RelativePose | None


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

    With known cameras and without a rig, a model begins with the pose that suits the matches of its first two images
    best, where COLMAP would begin with a wrong one. Of the images that it leaves, further models are made. A first pair
    that the options name is left to COLMAP.

    Parameters
    ----------
    database
        With verified matches.
    images
        The images' folder, for colours.
    sparse
        A folder that is there and takes the models.
    pipeline
        COLMAP's options.
    registered
        Is called for each image that joins a model.
    orientations
        By the gyroscope, of some images. Where it is unknown, both poses of a plane may suit the matches.
    scratch
        For temporary files.

    Returns
    -------
    The models by number; none where COLMAP finds none.
    """
    making = _Making(
        database=database,
        images=images,
        pipeline=pipeline,
        registered=registered,
        orientations=orientations,
        scratch=scratch,
    )
    asked = making.list_names()
    first = making.make_model(asked, [], least=min(pipeline.min_model_size, len(asked) // 2)) if asked else None
    if first is None:
        return making.run_colmap(sparse, pipeline)
    models, placed = [first], _names_of(first)
    while pipeline.multiple_models and len(models) < pipeline.max_num_models:
        rest = asked - placed
        if len(rest) < pipeline.min_model_size:
            break
        further = making.make_model(rest, making.find_neighbours(rest, placed), least=pipeline.min_model_size)
        if further is None or not _names_of(further) - placed:
            break
        models.append(further)
        placed |= _names_of(further)
    for number, model in enumerate(models):
        (sparse / str(number)).mkdir()
        model.write_binary(str(sparse / str(number)))
    return dict(enumerate(models))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Making:
    """Models of a database, as :func:`map_incrementally` makes them; its arguments."""

    database: Path
    images: Path
    pipeline: pycolmap.IncrementalPipelineOptions
    registered: Callable[[], None]
    orientations: ImageOrientations
    scratch: Path

    def list_names(self) -> set[str]:
        """Images to map; empty where the first pair is COLMAP's affair."""
        pipeline = self.pipeline
        if pipeline.ba_refine_focal_length or not pipeline.init_image_id1 == pipeline.init_image_id2 == _ANY:
            return set()
        with open_features(self.database) as features:
            if any(rig.num_sensors() > 1 for rig in features.database.read_all_rigs()):
                return set()
            return set(pipeline.image_names) or set(features.images)

    def find_neighbours(self, rest: Set[str], placed: Set[str]) -> list[str]:
        """Images of the models, few, that have most matches with those that no model has."""
        import pycolmap

        joined = Counter[str]()
        with open_features(self.database) as features:
            names = {image.image_id: name for name, image in features.images.items()}
            numbers, counts = features.database.read_two_view_geometry_num_inliers()
            for number, count in zip(numbers, counts, strict=True):
                first, second = (names[image] for image in pycolmap.pair_id_to_image_pair(number))
                for one, other in ((first, second), (second, first)):
                    if count >= self.pipeline.min_num_matches and one in placed and other in rest:
                        joined[one] += count
        return sorted(joined, key=lambda name: (-joined[name], name))[: self.pipeline.max_model_overlap]

    def make_model(self, names: Set[str], beside: Sequence[str], *, least: int) -> pycolmap.Reconstruction | None:
        """A model that begins with two images of some names, and may take others in.

        ``None`` where no two are suitable, or fewer images than ``least`` come of it.
        """
        with tempfile.TemporaryDirectory(dir=self.scratch) as folder:
            made, pair = Path(folder) / "made", Path(folder) / "pair"
            options = self.begin_model(names, pair)
            if options is None:
                return None
            options.image_names = sorted([*names, *beside])
            made.mkdir()
            model = self.run_colmap(made, options, pair if pair.is_dir() else None).get(0)
        return model if model is not None and model.num_reg_images() >= least else None

    def run_colmap(
        self, sparse: Path, options: pycolmap.IncrementalPipelineOptions, begun: Path | None = None
    ) -> dict[int, pycolmap.Reconstruction]:
        """COLMAP's mapper, from the beginning or from a model that is begun."""
        import pycolmap

        return dict(
            pycolmap.incremental_mapping(
                str(self.database),
                str(self.images),
                str(sparse),
                options=options,
                input_path="" if begun is None else str(begun),
                next_image_callback=self.registered,
            )
        )

    def begin_model(self, names: Set[str], pair: Path) -> pycolmap.IncrementalPipelineOptions | None:
        """Options for one model, with the first pair where COLMAP finds its pose.

        Else the model of this pair is written to the folder ``pair``. ``None`` where no two images are suitable.
        """
        import pycolmap

        asked = pycolmap.DatabaseCacheOptions()
        asked.min_num_matches, asked.ignore_watermarks = self.pipeline.min_num_matches, self.pipeline.ignore_watermarks
        asked.image_names = set(names)
        with pycolmap.Database.open(str(self.database)) as opened:
            mapper = pycolmap.IncrementalMapper(pycolmap.DatabaseCache.create(opened, asked))
        model = pycolmap.Reconstruction()
        mapper.begin_reconstruction(model)
        limits = self.pipeline.get_mapper()
        options = pycolmap.IncrementalPipelineOptions()
        options.mergedict(self.pipeline.todict())
        options.multiple_models = False
        first = self.choose_first_pair(mapper, limits, names)
        if first is None:
            return None
        if first.pose is None:
            options.init_image_id1, options.init_image_id2 = first.numbers
            options.init_num_trials = 1
            options.mapper.init_min_num_inliers = limits.init_min_num_inliers
            options.mapper.init_min_tri_angle = limits.init_min_tri_angle
            return options
        _reconstruct_pair(mapper, model, self.pipeline, limits, first.numbers, first.pose)
        # as few points as COLMAP places no image by
        if model.num_reg_images() < len(first.numbers) or model.num_points3D() < limits.abs_pose_min_num_inliers:
            return None
        for number in model.reg_image_ids() if self.pipeline.extract_colors else ():
            model.extract_colors_for_image(number, str(self.images))
        pair.mkdir()
        model.write_binary(str(pair))
        return options

    def choose_first_pair(
        self, mapper: pycolmap.IncrementalMapper, limits: pycolmap.IncrementalMapperOptions, names: Set[str]
    ) -> _FirstPair | None:
        """The pair that COLMAP begins with where it finds its pose, or else one of ours; the limits are relaxed."""
        proposed = _propose_pair(mapper, limits)
        if proposed is None:
            return None
        numbers, theirs = proposed
        with open_features(self.database) as features:
            of_number = {image.image_id: name for name, image in features.images.items()}
            first, second = (of_number[number] for number in numbers)
            rotation = self.orientations.find_rotation(first, second)
            pose = estimate_relative_pose(features, first, second, rotation)
            turn = matrix_from_quat(np.array(theirs.rotation.quat))
            if pose is None or not _is_turned(pose.second_from_first, turn):
                return _FirstPair(numbers=numbers, pose=None)
            log.info("%s and %s: COLMAP would begin with another pose", first, second)
            own = self.choose_own_pair(features, self.pipeline.get_mapper(), names)
            return own if own is not None or pose.unique else _FirstPair(numbers=numbers, pose=None)

    def choose_own_pair(
        self, features: Features, limits: pycolmap.IncrementalMapperOptions, names: Set[str]
    ) -> _FirstPair | None:
        """The pair of most matches that has the parallax that COLMAP asks for, or a part of it."""
        import pycolmap

        of_number = {image.image_id: name for name, image in features.images.items()}
        least = min(of_matches for of_matches, _ in _LIMITS.own_relaxations) * limits.init_min_num_inliers
        pairs: list[tuple[int, float, tuple[int, int]]] = []
        numbers, counts = features.database.read_two_view_geometry_num_inliers()
        for number, count in zip(numbers, counts, strict=True):
            pair = pycolmap.pair_id_to_image_pair(number)
            if count >= least and names >= {of_number[image] for image in pair}:
                pairs.append((count, self.find_parallax_rad(features, *(of_number[image] for image in pair)), pair))
        pairs.sort(key=lambda item: (-item[0], item[2]))
        by_parallax = sorted(pairs, key=lambda item: -item[1])
        for of_matches, of_parallax in _LIMITS.own_relaxations:
            least_rad = of_parallax * math.radians(limits.init_min_tri_angle)
            for count, parallax_rad, pair in pairs if of_parallax else by_parallax:
                if count < of_matches * limits.init_min_num_inliers or parallax_rad < least_rad:
                    continue
                first, second = (of_number[image] for image in pair)
                rotation = self.orientations.find_rotation(first, second)
                pose = estimate_relative_pose(features, first, second, rotation)
                if pose is None or not pose.unique:
                    continue
                if rotation is not None and _is_turned(rotation, pose.second_from_first):
                    continue
                if abs(float(pose.translation[2])) < limits.init_max_forward_motion:
                    log.info("mapping begins with %s and %s", first, second)
                    return _FirstPair(numbers=pair, pose=pose)
        return None

    def find_parallax_rad(self, features: Features, first: str, second: str) -> float:
        """Median angle between the rays to a point, by the gyroscope's rotation where it is known."""
        rotation = self.orientations.find_rotation(first, second)
        if rotation is not None:
            return measure_parallax_rad(features, first, second, rotation)
        pose = estimate_relative_pose(features, first, second)
        return 0.0 if pose is None or not pose.unique else pose.parallax_rad


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


def _propose_pair(
    mapper: pycolmap.IncrementalMapper, limits: pycolmap.IncrementalMapperOptions
) -> tuple[tuple[int, int], pycolmap.Rigid3d] | None:
    """The pair that COLMAP would begin with, and its pose ``second_from_first``; the limits are relaxed as it does."""
    least_matches, least_deg = limits.init_min_num_inliers, limits.init_min_tri_angle
    for of_matches, of_parallax in _LIMITS.relaxations:
        limits.init_min_num_inliers = int(least_matches * of_matches)
        limits.init_min_tri_angle = least_deg * of_parallax
        mapper.reset_initialization_stats()
        found = mapper.find_initial_image_pair(limits, _ANY, _ANY)
        if found is not None:
            return found
    return None


def _is_turned(known: Array, found: Array) -> bool:
    """Whether a rotation is surely another one than is known."""
    return float(np.linalg.norm(so3_log(known.T @ found))) > _LIMITS.wrong_rad


def _names_of(model: pycolmap.Reconstruction) -> set[str]:
    return {model.image(number).name for number in model.reg_image_ids()}
