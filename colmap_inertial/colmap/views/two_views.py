"""Read pairs of images from COLMAP's database: rotations, matched overlap, shared features."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.colmap.views.gyro_orientations import RayPairs
from colmap_inertial.colmap.views.relative_track import (
    FramePair,
    LoopPose,
    Observations,
    RelativeTrack,
    link_observations,
)
from colmap_inertial.core.arrays import Array, BoolArray, IndexArray, UInt8Array
from colmap_inertial.core.geometry import cross, matrix_from_quat, so3_exp, so3_log
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.io.files import reading
from colmap_inertial.model.database import UNREADABLE, check_records
from colmap_inertial.motion.epipolar import refine_poses
from colmap_inertial.motion.rotation_averaging import average_rotations

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class TwoViewLimits:
    """Limits for matches that confirm the place of a pair's images."""

    #: A rotation of fewer matches is not believed.
    least_matches: int = 30
    #: Matches of a pair that the gyroscope's bias is sought by.
    rays: int = 100
    #: Matches of a pair that its pose is refined by, and pairs that are refined together.
    refined_matches: int = 200
    at_once: int = 100
    #: Poses suit the matches alike up to this factor; shares of points in front are alike up to this difference.
    alike: float = 1.2
    as_many: float = 0.1
    #: A pose is surely the right one where all others suit the matches worse by this factor: medians of 200 distances
    #: scatter by a tenth. Poses that turn alike to so much are one.
    sure: float = 1.4
    one_rad: float = math.radians(1.0)
    #: A frame is localised by so many points of the track at least.
    least_placed: int = 12
    #: How far off they may lie.
    placed_px: float = 8.0
    #: The share of those matched that must not be farther off.
    placed_share: float = 0.7
    #: An image in cells, and the features that a cell must have for it to count.
    columns: int = 8
    rows: int = 6
    least_features: int = 3
    #: Features of each image in the quick comparison, the largest ones.
    compared_features: int = 500
    #: A quick match: the nearest descriptor is nearer than this share of the next one's angle, as in COLMAP.
    ratio: float = 0.7
    #: And nearer than this angle, as in COLMAP.
    farthest_rad: float = 0.7
    #: COLMAP stores descriptors of this length.
    length: float = 512.0
    #: A camera stands still where so many quick matches of two images, this share of them, lie less than this part of
    #: the longer side apart: a pixel of 750.
    least_still: int = 50
    still_share: float = 0.75
    still_part: float = 1 / 750


_LIMITS = TwoViewLimits()


class Features:
    """An open database of features and matches, by names of images."""

    def __init__(self, database: pycolmap.Database) -> None:
        self.database = database
        self.images = {image.name: image for image in database.read_all_images()}
        self.cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}

    def camera(self, name: str) -> pycolmap.Camera:
        """An image's camera."""
        return self.cameras[self.images[name].camera_id]

    def xy_px(self, name: str) -> Array:
        """(K, 2) an image's keypoints."""
        return np.array(self.database.read_keypoints(self.images[name].image_id))[:, :2].astype(np.float64)

    def rays(self, name: str, which: IndexArray | slice = slice(None)) -> Array:
        """(K, 3) directions to some of an image's keypoints, camera frame; their length is arbitrary."""
        seen = np.asarray(self.camera(name).cam_from_img(self.xy_px(name)[which]))[:, :2]
        return np.column_stack([seen, np.ones(len(seen))])

    def find_places(self, pair_ids: Iterable[int], names: Sequence[str]) -> set[FramePair]:
        """Places in time of pairs by COLMAP's numbers; pairs with images that are not among the names are left out."""
        import pycolmap

        at = {self.images[name].image_id: k for k, name in enumerate(names) if name in self.images}
        numbers = [pycolmap.pair_id_to_image_pair(pair) for pair in pair_ids]
        return {(min(at[a], at[b]), max(at[a], at[b])) for a, b in numbers if a in at and b in at}

    def geometry(self, first: str, second: str) -> pycolmap.TwoViewGeometry:
        """The verified matches of two images."""
        return self.database.read_two_view_geometry(self.images[first].image_id, self.images[second].image_id)

    def matches(self, first: str, second: str) -> IndexArray:
        """(K, 2) features that verified matches of two images join."""
        return np.array(self.geometry(first, second).inlier_matches, dtype=np.intp)


@contextlib.contextmanager
def open_features(database: Path) -> Iterator[Features]:
    """Open COLMAP's database; what is done with its features within is part of reading it.

    Raises
    ------
    FormatError
        Where the database is none, or damaged.
    """
    import pycolmap

    check_records(database)
    with reading(database, UNREADABLE), pycolmap.Database.open(str(database)) as opened:
        yield Features(opened)


@dataclass(frozen=True, eq=False, kw_only=True)
class TwoViews:
    """M pairs of images with their verified matches.

    Attributes
    ----------
    first_from_second
        (M, 3, 3) rotations; NaN where there are too few matches.
    covered
        (M,) share of the first or the second image that is matched, whichever is less: of its cells with features
        that the other one shows, too, had it turned and not moved.
    """

    first_from_second: Array
    covered: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class RelativePose:
    """The relative pose of two views, by their verified matches.

    Attributes
    ----------
    second_from_first
        (3, 3) rotation.
    translation
        (3,) unit vector, frame of the second view.
    parallax_rad
        Median angle between the two rays to a point.
    unique
        Whether all other poses suit the matches clearly worse, or the gyroscope knows which is right.
    """

    second_from_first: Array
    translation: Array
    parallax_rad: float
    unique: bool


def compare(database: Path, pairs: Sequence[tuple[str, str]]) -> TwoViews:
    """Rotation and matched overlap of pairs of images, by their verified matches.

    Views close in time pass as those of a plane, or of a camera that only turned, whatever they show. The pose that
    COLMAP takes from their homography is off by tenths of a degree, and of a homography's two solutions the wrong one
    often has all points before both cameras, too. So each solution is refined by the matches, and the one that suits
    them best is taken. Both suit those of a plane; the points before the cameras decide there.
    """
    rotations, covered = np.full((len(pairs), 3, 3), np.nan), np.zeros(len(pairs))
    with open_features(database) as features:
        points: dict[str, Array] = {}
        for begin in range(0, len(pairs), _LIMITS.at_once):
            some = [_MatchedViews.read(features, pair, points) for pair in pairs[begin : begin + _LIMITS.at_once]]
            solved = [(begin + k, views) for k, views in enumerate(some) if views is not None and views.poses]
            for (place, views), (turn, *_) in zip(solved, _refine_poses([of for _, of in solved]), strict=True):
                rotations[place], covered[place] = turn.T, views.measure_coverage(turn)
    return TwoViews(first_from_second=rotations, covered=covered)


def estimate_relative_pose(
    features: Features, first: str, second: str, rotation: Array | None = None
) -> RelativePose | None:
    """The pose of two views, as :func:`compare` has its rotation; ``None`` where they have too few matches.

    Parameters
    ----------
    rotation
        (3, 3) ``second_from_first`` by the gyroscope, where it is known: of poses that suit the matches alike, the one
        that is turned so is right.
    """
    views = _MatchedViews.read(features, (first, second), {})
    if views is None or not views.poses:
        return None
    ((turn, move, unique),) = _refine_poses([views], [rotation])
    parallax_rad = _measure_parallax_rad(views.rays[0], views.rays[1], turn)
    return RelativePose(second_from_first=turn, translation=move, parallax_rad=parallax_rad, unique=unique)


def measure_parallax_rad(features: Features, first: str, second: str, second_from_first: Array) -> float:
    """Median angle between the two rays to a point, of all verified matches of two views whose rotation is known."""
    matches = features.matches(first, second)
    rays_first, rays_second = (
        _unit_rays(features.camera(name), features.xy_px(name)[matches[:, k]]) for k, name in enumerate((first, second))
    )
    return _measure_parallax_rad(rays_first, rays_second, second_from_first)


def _measure_parallax_rad(rays_first: Array, rays_second: Array, second_from_first: Array) -> float:
    turned = rays_first @ second_from_first.T
    sine = np.linalg.norm(cross(turned, rays_second), axis=1)
    return float(np.nanmedian(np.arctan2(sine, np.sum(turned * rays_second, axis=1))))


@dataclass(frozen=True, eq=False, kw_only=True)
class _MatchedViews:
    """Two images, their verified matches, and poses that these allow.

    Attributes
    ----------
    first, second
        The camera and the (K, 2) keypoints of each, pixels.
    matches
        (L, 2) places of matched keypoints.
    rays
        (2, R, 3) unit rays of some of the matches.
    poses
        Rotations ``second_from_first`` and unit translations.
    """

    first: tuple[pycolmap.Camera, Array]
    second: tuple[pycolmap.Camera, Array]
    matches: IndexArray
    rays: Array
    poses: list[tuple[Array, Array]]

    @classmethod
    def read(cls, features: Features, pair: tuple[str, str], points: dict[str, Array]) -> _MatchedViews | None:
        """Of a pair with matches enough; ``points`` keeps the keypoints of images that were read."""
        views = features.geometry(*pair)
        matches = np.array(views.inlier_matches, dtype=np.intp)
        if len(matches) < _LIMITS.least_matches:
            return None
        for name in pair:
            if name not in points:
                points[name] = features.xy_px(name)
        first, second = ((features.camera(name), points[name]) for name in pair)
        rays = np.stack(
            [_unit_rays(first[0], first[1][matches[:, 0]]), _unit_rays(second[0], second[1][matches[:, 1]])]
        )
        visible = np.flatnonzero(np.isfinite(rays).all(axis=(0, 2)))
        if len(visible) < _LIMITS.least_matches:
            return None
        rays = rays[:, visible[np.linspace(0, len(visible) - 1, _LIMITS.refined_matches).astype(np.intp)]]
        poses = _solve_pose(first, second, views, rays)
        return cls(first=first, second=second, matches=matches, rays=rays, poses=poses)

    def measure_coverage(self, second_from_first: Array) -> float:
        """Share of the first or the second image that is matched, whichever is less."""
        return min(
            _coverage(*self.first, self.matches[:, 0], self.second[0], second_from_first),
            _coverage(*self.second, self.matches[:, 1], self.first[0], second_from_first.T),
        )


def _refine_poses(
    pairs: Sequence[_MatchedViews], rotations: Sequence[Array | None] | None = None
) -> list[tuple[Array, Array, bool]]:
    """Each pair's ``second_from_first`` and unit translation that suit its matches best once refined; whether no others
    do alike.

    Of those that do, the one counts that is turned as known beforehand, where rotations are given.
    """
    if not pairs:
        return []
    rays = np.array([views.rays for views in pairs for _ in views.poses])
    turns, moves = (np.array(of) for of in zip(*(pose for views in pairs for pose in views.poses), strict=True))
    refined = refine_poses(turns, moves, rays[:, 0], rays[:, 1])
    best, begin = [], 0
    for views, known in zip(pairs, rotations or [None] * len(pairs), strict=True):
        own = slice(begin, begin + len(views.poses))
        if known is None:
            chosen = begin + _choose_pose(refined.usual_rad[own], refined.in_front[own])
        else:
            turned_rad = np.linalg.norm(so3_log(known.T @ refined.second_from_first[own]), axis=1)
            chosen = begin + int(np.argmin(np.where(_are_alike(refined.usual_rad[own]), turned_rad, np.inf)))
        others = refined.second_from_first[own][_are_alike(refined.usual_rad[own], _LIMITS.sure)]
        apart_rad = np.linalg.norm(so3_log(refined.second_from_first[chosen].T @ others), axis=1)
        unique = known is not None or bool(apart_rad.max() < _LIMITS.one_rad)
        best.append((refined.second_from_first[chosen], refined.translation[chosen], unique))
        begin = own.stop
    return best


def _choose_pose(usual_rad: Array, in_front: Array) -> int:
    """The pose that suits the matches best; of those alike, as both of a plane are, one with its points in front."""
    alike = _are_alike(usual_rad)
    alike &= in_front >= in_front[alike].max() - _LIMITS.as_many
    return int(np.argmin(np.where(alike, usual_rad, np.inf)))


def _are_alike(usual_rad: Array, factor: float = _LIMITS.alike) -> BoolArray:
    """Which poses suit the matches about as well as the best one."""
    return np.asarray(usual_rad <= factor * usual_rad.min())


def _solve_pose(
    first: tuple[pycolmap.Camera, Array],
    second: tuple[pycolmap.Camera, Array],
    views: pycolmap.TwoViewGeometry,
    rays: Array,
) -> list[tuple[Array, Array]]:
    """Rotations ``second_from_first`` and unit translations that COLMAP's matrices of two views allow."""
    import cv2
    import pycolmap

    kinds = pycolmap.TwoViewGeometryConfiguration
    poses = []
    of_plane = views.config in (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)
    if of_plane and views.H is not None and np.linalg.det(views.H):
        intrinsic_first, intrinsic_second = first[0].calibration_matrix(), second[0].calibration_matrix()
        homography = np.linalg.solve(intrinsic_second, views.H @ intrinsic_first)
        homography *= np.sign(np.linalg.det(homography))  # keeps points before the camera there
        _, turns, moves, _ = cv2.decomposeHomographyMat(homography, np.eye(3))
        solutions = zip(turns[::2], moves[::2], strict=True)  # of one sign
        poses = [(turn, _unit(move.ravel())) for turn, move in solutions if np.isfinite([*turn, move.ravel()]).all()]
    if views.E is not None and np.any(views.E):
        views.config = kinds.CALIBRATED  # it has a rotation where another matrix suits more matches, too
    elif views.F is None or not np.any(views.F):
        return poses
    if pycolmap.estimate_two_view_geometry_pose(*first, *second, views) and views.cam2_from_cam1 is not None:
        turn = matrix_from_quat(np.array(views.cam2_from_cam1.rotation.quat))
        move = _unit(np.array(views.cam2_from_cam1.translation))
        poses.append((_with_less_parallax(turn, move, rays) if of_plane else turn, move))
    return poses


def _unit(translation: Array) -> Array:
    """Of a camera that only turned, it is any direction."""
    length = np.linalg.norm(translation)
    return np.asarray(translation / length) if length > 1e-9 else np.array([0.0, 0.0, 1.0])


def _with_less_parallax(turn: Array, move: Array, rays: Array) -> Array:
    """A rotation, or the other one of its essential matrix, half a turn about the translation apart.

    Points tell them apart by their depth, but not those of a camera that hardly moved.
    """
    rotations = (turn, so3_exp(np.pi * move) @ turn)
    return max(rotations, key=lambda rotation: float(np.sum(rays[1] * (rays[0] @ rotation.T))))


def _unit_rays(camera: pycolmap.Camera, xy_px: Array) -> Array:
    """(K, 3) unit rays to (K, 2) pixels, camera frame."""
    seen = np.asarray(camera.cam_from_img(xy_px))[:, :2]
    rays = np.column_stack([seen, np.ones(len(seen))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _coverage(
    camera: pycolmap.Camera, xy_px: Array, matched: IndexArray, other: pycolmap.Camera, other_from_this: Array
) -> float:
    """Share of the image's cells with features, as far as the other one shows them, that have a match."""
    columns, rows = _LIMITS.columns, _LIMITS.rows
    scale = np.array([columns / camera.width, rows / camera.height])
    cell = np.clip(np.floor(xy_px * scale), 0, [columns - 1, rows - 1]).astype(np.intp) @ np.array([1, columns])
    count = np.bincount(cell, minlength=columns * rows)
    again = np.bincount(cell[matched], minlength=columns * rows)
    row, column = np.divmod(np.arange(columns * rows), columns)
    middle = (np.stack([column, row], axis=1) + 0.5) / scale
    asked = (count >= _LIMITS.least_features) & _is_visible(middle, camera, other, other_from_this)
    return int((asked & (again > 0)).sum()) / max(int(asked.sum()), 1)


def _is_visible(xy_px: Array, camera: pycolmap.Camera, other: pycolmap.Camera, other_from_this: Array) -> BoolArray:
    """(N,) which points of an image, infinitely far away, are visible in the other one."""
    rays = np.asarray(camera.cam_from_img(xy_px))[:, :2]
    there = np.column_stack([rays, np.ones(len(rays))]) @ other_from_this.T
    before = np.isfinite(there).all(axis=1) & (there[:, 2] > 0.05)
    seen = np.full((len(rays), 2), np.nan)
    seen[before] = np.asarray(other.img_from_cam(there[before]))[:, :2]
    inside = (seen >= 0).all(axis=1) & (seen[:, 0] <= other.width) & (seen[:, 1] <= other.height)
    return np.asarray(inside, dtype=np.bool_)


def read_rotations_rad(database: Path, names: Sequence[str], pairs: Sequence[FramePair]) -> Array:
    """(N - 1, 3) rotation vectors ``earlier_from_later`` of consecutive images, by all of some pairs of images.

    Those of single pairs may be wrong: of frames that follow each other quickly, most are poor. NaN where too few
    matches connect two images.
    """
    rotations = compare(database, [(names[i], names[j]) for i, j in pairs]).first_from_second
    measured = np.isfinite(rotations).all(axis=(1, 2))
    first, second = np.array(pairs, dtype=np.intp).reshape(-1, 2)[measured].T
    return average_rotations(len(names), first, second, rotations[measured])


def read_ray_pairs(database: Path, names: Sequence[str], pairs: Sequence[FramePair]) -> RayPairs:
    """Rays of some matches of those pairs of images that have enough of them."""
    rays: dict[int, Array] = {}
    kept, rays_of_pairs = [], []
    with open_features(database) as features:
        for pair in pairs:
            matches = features.matches(names[pair[0]], names[pair[1]])
            if len(matches) < _LIMITS.least_matches:
                continue
            for index in pair:
                if index not in rays:
                    ray = features.rays(names[index])
                    rays[index] = ray / np.linalg.norm(ray, axis=1, keepdims=True)
            some = matches[np.linspace(0, len(matches) - 1, _LIMITS.rays).astype(np.intp)]
            of_both = np.stack([rays[pair[0]][some[:, 0]], rays[pair[1]][some[:, 1]]])
            if np.isfinite(of_both).all():
                kept.append(pair)
                rays_of_pairs.append(of_both)
        focal_px = float(np.median([camera.mean_focal_length() for camera in features.cameras.values()]))
    places, stacked = (
        np.array(kept, dtype=np.intp).reshape(-1, 2),
        np.array(rays_of_pairs).reshape(-1, 2, _LIMITS.rays, 3),
    )
    return RayPairs(
        first=places[:, 0],
        second=places[:, 1],
        pixel_rad=1 / focal_px,
        rays_first=stacked[:, 0],
        rays_second=stacked[:, 1],
    )


def read_observations(
    database: Path, names: Sequence[str], pairs: Sequence[FramePair], start_from_cam: Array
) -> Observations:
    """Observations of points by the verified matches of pairs of frames, with (N, 3, 3) orientations of the frames."""
    with open_features(database) as features:
        counts = [features.database.num_keypoints_for_image(features.images[name].image_id) for name in names]
        matches = [(i, j, features.matches(names[i], names[j])) for i, j in pairs]
        frame, feature, point = link_observations(counts, [of for of in matches if len(of[2]) >= _LIMITS.least_matches])
        rays = np.zeros((len(frame), 3))
        bounds = np.searchsorted(frame, np.arange(len(names) + 1))
        for k, name in enumerate(names):
            own = slice(bounds[k], bounds[k + 1])
            if bounds[k] < bounds[k + 1]:
                ray = features.rays(name, feature[own]) @ start_from_cam[k].T
                rays[own] = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    return Observations(frame=frame, point=point, feature=feature, rays=rays)


def localise_frames(
    database: Path, names: Sequence[str], pairs: Sequence[FramePair], track: RelativeTrack
) -> list[LoopPose | None]:
    """Localise the second frame of each pair by the first one's points; ``None`` where too few of them agree."""
    import pycolmap

    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = _LIMITS.placed_px, 0
    poses: list[LoopPose | None] = []
    with open_features(database) as features:
        for i, j in pairs:
            poses.append(None)
            matches = features.matches(names[i], names[j])
            (of_first, at_first), (of_second, at_second) = track.seen(i), track.seen(j)
            _, seen, place = np.intersect1d(matches[:, 0], of_first, return_indices=True)
            if len(seen) < _LIMITS.least_placed:
                continue
            xy_px, points = features.xy_px(names[j])[matches[seen, 1]], at_first[place]
            estimate = pycolmap.estimate_and_refine_absolute_pose(
                xy_px, points, features.camera(names[j]), estimation_options=options
            )
            if estimate is None or estimate["num_inliers"] < max(
                _LIMITS.least_placed, _LIMITS.placed_share * len(seen)
            ):
                continue
            second_from_start = estimate["cam_from_world"]
            centre = -second_from_start.rotation.matrix().T @ second_from_start.translation
            fit = np.array(estimate["inlier_mask"])
            away = np.linalg.norm(points - centre, axis=1)
            _, both, other = np.intersect1d(matches[seen, 1], of_second, return_indices=True)
            usable = fit[both]
            if usable.sum() < _LIMITS.least_placed // 2:
                continue
            there = np.linalg.norm(at_second[other[usable]] - track.centre[j], axis=1)
            ratio, depth = float(np.median(away[both[usable]] / there)), float(np.median(away[fit]))
            if not (0 < ratio < np.inf and 0 < depth < np.inf):  # a point at the camera's very place
                continue
            poses[-1] = LoopPose(
                step=centre - track.centre[i],
                start_from_second=second_from_start.rotation.matrix().T,
                ratio=ratio,
                depth=depth,
                matches=int(fit.sum()),
            )
    return poses


def count_verified(database: Path) -> int:
    """Pairs whose matches COLMAP verified."""
    with open_features(database) as features:
        return int(np.count_nonzero(features.database.read_two_view_geometry_num_inliers()[1]))


def count_shared(database: Path, names: Sequence[str], frames: IndexArray) -> IndexArray:
    """(K,) features of some frames that verified matches join to two others: points that others show without them.

    Parameters
    ----------
    names
        (N,) of images; matches with others do not count.
    frames
        (K,) places of those that are asked for.
    """
    verified, asked = sorted(read_verified_pairs(database, names)), frames.tolist()
    with open_features(database) as features:
        counts = {k: features.database.num_keypoints_for_image(features.images[names[k]].image_id) for k in asked}
        others = {k: np.zeros(count, dtype=np.uint8) for k, count in counts.items()}
        for pair in verified:
            if others.keys().isdisjoint(pair):
                continue
            for k, own in zip(pair, features.matches(names[pair[0]], names[pair[1]]).T, strict=True):
                if k in others:
                    others[k][own] = np.minimum(others[k][own] + 1, 2)
    return np.array([np.count_nonzero(others[k] >= 2) for k in asked], dtype=np.intp)


def read_verified_pairs(database: Path, names: Sequence[str]) -> set[FramePair]:
    """Places in time of pairs whose matches COLMAP verified."""
    with open_features(database) as features:
        pairs, inliers = features.database.read_two_view_geometry_num_inliers()
        return features.find_places(itertools.compress(pairs, inliers), names)


def delete_matches(database: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Remove the matches of pairs from a database."""
    with open_features(database) as features:
        for pair in pairs:
            numbers = [features.images[name].image_id for name in pair]
            features.database.delete_matches(*numbers)
            features.database.delete_two_view_geometry(*numbers)


@dataclass(frozen=True, eq=False, kw_only=True)
class Covisibility:
    """The largest features of each image.

    Attributes
    ----------
    descriptors
        Of each image (K, 128), as COLMAP stores them.
    xy_px
        Of each image (K, 2).
    long_side_px
        (N,) of the images.
    """

    descriptors: tuple[UInt8Array, ...]
    xy_px: tuple[Array, ...]
    long_side_px: Array

    @classmethod
    def of(cls, database: Path, names: Sequence[str]) -> Covisibility:
        """Read the features of images from a database."""
        descriptors, places, sides = [], [], []
        with open_features(database) as features:
            for name in names:
                number = features.images[name].image_id
                keypoints = np.array(features.database.read_keypoints(number), dtype=np.float64)
                stored = np.array(features.database.read_descriptors(number).data, dtype=np.uint8)
                if stored.shape != (len(keypoints), 128):  # others' descriptors are not compared
                    keypoints, stored = keypoints[:0], stored[:0].reshape(0, 128)
                # COLMAP keeps an affine shape; others may keep a scale, or nothing beside the place
                size = np.linalg.norm(keypoints[:, 2::2], axis=1)
                largest = np.argsort(-size, kind="stable")[: _LIMITS.compared_features]
                descriptors.append(stored[largest])
                places.append(keypoints[largest, :2])
                sides.append(max(features.camera(name).width, features.camera(name).height))
        return cls(descriptors=tuple(descriptors), xy_px=tuple(places), long_side_px=np.array(sides, dtype=np.float64))

    def find_standing(self) -> IndexArray:
        """(N,) of each image, in order of time, which one before it shows the same, seen from the same place.

        Of a camera that stands still it is the first one; of any other, the image itself.
        """
        anchor = np.arange(len(self.descriptors))
        with one_blas_thread():
            for k in range(1, len(anchor)):
                before = int(anchor[k - 1])
                first, second = match_quickly(self.descriptors[before], self.descriptors[k])
                if len(first) < _LIMITS.least_still:
                    continue
                moved_px = np.linalg.norm(self.xy_px[before][first] - self.xy_px[k][second], axis=1)
                if np.mean(moved_px < _LIMITS.still_part * self.long_side_px[k]) > _LIMITS.still_share:
                    anchor[k] = before
        return anchor

    def only(self, index: IndexArray) -> Covisibility:
        """Of some of the images."""
        return Covisibility(
            descriptors=tuple(self.descriptors[i] for i in index.tolist()),
            xy_px=tuple(self.xy_px[i] for i in index.tolist()),
            long_side_px=self.long_side_px[index],
        )

    def are_unlike(self, i: IndexArray, j: IndexArray, least: int) -> BoolArray:
        """(M,) whether images i and j, both with features enough, have fewer quick matches than this."""
        return np.asarray((self.count(i, j) < least) & self.plenty[i] & self.plenty[j])

    @property
    def plenty(self) -> BoolArray:
        """(N,) which images have features enough for few matches to mean something."""
        return np.array([len(own) == _LIMITS.compared_features for own in self.descriptors], dtype=np.bool_)

    def count(self, i: IndexArray, j: IndexArray) -> IndexArray:
        """(M,) quick matches of images i and j, (M,) each."""
        counted = np.zeros(len(i), dtype=np.intp)
        with one_blas_thread():
            for place in range(len(i)):
                counted[place] = len(match_quickly(self.descriptors[i[place]], self.descriptors[j[place]])[0])
        return counted


def match_quickly(first: UInt8Array, second: UInt8Array) -> tuple[IndexArray, IndexArray]:
    """Places (K,) and (K,) of mutually nearest descriptors that are clearly nearer than the next."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    cosine = first.astype(np.float32) @ second.astype(np.float32).T / np.float32(_LIMITS.length**2)
    row = np.arange(len(first))
    nearest = cosine.argmax(axis=1)
    best = cosine[row, nearest]
    mutual = cosine.argmax(axis=0)[nearest] == row
    cosine[row, nearest] = -1
    near = np.flatnonzero(mutual & (best > np.cos(_LIMITS.farthest_rad)))
    angle, next_angle = (np.arccos(np.clip(c, -1, 1)) for c in (best[near], cosine[near].max(axis=1, initial=-1)))
    near = near[angle < _LIMITS.ratio * next_angle]
    return near, nearest[near]
