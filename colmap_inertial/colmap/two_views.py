"""What COLMAP's database knows of pairs of images: how the camera turned, how much of what both show was matched."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.colmap.gyro_bias import RayPairs
from colmap_inertial.colmap.relative_track import RelativeTrack, Sightings, joined
from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.geometry import matrix_from_quat, so3_log

if TYPE_CHECKING:
    import pycolmap


#: A rotation of fewer matches is not believed.
_LEAST_MATCHES = 30
#: Matches of a pair that the gyroscope's bias is sought by.
_RAYS = 100
#: Points of the way by which a frame is placed, how far off they may lie, and how many of those matched must not.
_LEAST_PLACED, _PLACED_PX, _PLACED_SHARE = 12, 8.0, 0.7
#: A picture in cells, and the features that a cell must have for it to count.
_COLUMNS, _ROWS, _LEAST_FEATURES = 8, 6, 3


@dataclass(frozen=True, eq=False, kw_only=True)
class TwoViews:
    """Of M pairs of images, by their verified matches.

    Attributes
    ----------
    first_from_second
        (M, 3, 3) rotations; NaN where there are too few matches.
    covered
        (M,) share of the first or the second picture that is matched, whichever is less: of its cells with features
        that the other one shows, too, had it turned and not moved.
    """

    first_from_second: Array
    covered: Array


def compare(database: Path, pairs: Sequence[tuple[str, str]]) -> TwoViews:
    """What the verified matches of pairs tell."""
    import pycolmap

    turned, covered = np.full((len(pairs), 3, 3), np.nan), np.zeros(len(pairs))
    with pycolmap.Database.open(str(database)) as opened:
        images = {image.name: image for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        points: dict[str, Array] = {}
        for place, pair in enumerate(pairs):
            both = [images[name] for name in pair]
            views = opened.read_two_view_geometry(both[0].image_id, both[1].image_id)
            if len(views.inlier_matches) < _LEAST_MATCHES:
                continue
            for image in both:
                if image.name not in points:
                    stored = np.array(opened.read_keypoints(image.image_id))
                    points[image.name] = stored[:, :2].astype(np.float64)
            seen = [(cameras[image.camera_id], points[image.name]) for image in both]
            if pycolmap.estimate_two_view_geometry_pose(*seen[0], *seen[1], views) and views.cam2_from_cam1 is not None:
                second_from_first = matrix_from_quat(np.array(views.cam2_from_cam1.rotation.quat))
                turned[place] = second_from_first.T
                matches = np.array(views.inlier_matches)
                covered[place] = min(
                    _covered(*seen[0], matches[:, 0], seen[1][0], second_from_first),
                    _covered(*seen[1], matches[:, 1], seen[0][0], second_from_first.T),
                )
    return TwoViews(first_from_second=turned, covered=covered)


def _covered(
    camera: pycolmap.Camera, xy_px: Array, matched: NDArray[np.uint32], other: pycolmap.Camera, other_from_this: Array
) -> float:
    """Share of the picture's cells with features, as far as the other one shows them, that have a match."""
    scale = np.array([_COLUMNS / camera.width, _ROWS / camera.height])
    cell = np.clip(np.floor(xy_px * scale), 0, [_COLUMNS - 1, _ROWS - 1]).astype(np.intp) @ np.array([1, _COLUMNS])
    count = np.bincount(cell, minlength=_COLUMNS * _ROWS)
    again = np.bincount(cell[matched], minlength=_COLUMNS * _ROWS)
    row, column = np.divmod(np.arange(_COLUMNS * _ROWS), _COLUMNS)
    middle = (np.stack([column, row], axis=1) + 0.5) / scale
    asked = (count >= _LEAST_FEATURES) & _shown(middle, camera, other, other_from_this)
    return int((asked & (again > 0)).sum()) / max(int(asked.sum()), 1)


def _shown(xy_px: Array, camera: pycolmap.Camera, other: pycolmap.Camera, other_from_this: Array) -> BoolArray:
    """(N,) which points of a picture, infinitely far away, the other one shows."""
    rays = np.asarray(camera.cam_from_img(xy_px))[:, :2]
    there = np.column_stack([rays, np.ones(len(rays))]) @ other_from_this.T
    before = np.isfinite(there).all(axis=1) & (there[:, 2] > 0.05)
    seen = np.full((len(rays), 2), np.nan)
    seen[before] = np.asarray(other.img_from_cam(there[before]))[:, :2]
    inside = (seen >= 0).all(axis=1) & (seen[:, 0] <= other.width) & (seen[:, 1] <= other.height)
    return np.asarray(inside, dtype=np.bool_)


def turns_rad(database: Path, names: Sequence[str]) -> Array:
    """(N - 1, 3) rotation vectors ``earlier_from_later`` of consecutive images; NaN where their matches tell none."""
    turned = compare(database, list(itertools.pairwise(names))).first_from_second
    known = np.isfinite(turned).all(axis=(1, 2))
    turn = np.full((len(turned), 3), np.nan)
    turn[known] = so3_log(turned[known])
    return turn


def ray_pairs(database: Path, names: Sequence[str], pairs: Sequence[tuple[int, int]]) -> RayPairs:
    """Rays of some matches of those pairs of images that have enough of them."""
    import pycolmap

    rays: dict[int, Array] = {}
    kept, found = [], []
    with pycolmap.Database.open(str(database)) as opened:
        images = {image.name: image for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        for pair in pairs:
            both = [images[names[index]] for index in pair]
            matches = np.array(opened.read_two_view_geometry(both[0].image_id, both[1].image_id).inlier_matches)
            if len(matches) < _LEAST_MATCHES:
                continue
            for index, image in zip(pair, both, strict=True):
                if index not in rays:
                    xy_px = np.array(opened.read_keypoints(image.image_id))[:, :2].astype(np.float64)
                    seen = np.asarray(cameras[image.camera_id].cam_from_img(xy_px))[:, :2]
                    ray = np.column_stack([seen, np.ones(len(seen))])
                    rays[index] = ray / np.linalg.norm(ray, axis=1, keepdims=True)
            some = matches[np.linspace(0, len(matches) - 1, _RAYS).astype(np.intp)]
            of_both = np.stack([rays[pair[0]][some[:, 0]], rays[pair[1]][some[:, 1]]])
            if np.isfinite(of_both).all():
                kept.append(pair)
                found.append(of_both)
        focal_px = float(np.median([camera.mean_focal_length() for camera in cameras.values()]))
    places, stacked = np.array(kept, dtype=np.intp).reshape(-1, 2), np.array(found).reshape(-1, 2, _RAYS, 3)
    return RayPairs(
        first=places[:, 0],
        second=places[:, 1],
        pixel_rad=1 / focal_px,
        rays_first=stacked[:, 0],
        rays_second=stacked[:, 1],
    )


def sightings_of(
    database: Path, names: Sequence[str], pairs: Sequence[tuple[int, int]], start_from_cam: Array
) -> Sightings:
    """What the verified matches of pairs of frames say of points, with (N, 3, 3) orientations of the frames."""
    import pycolmap

    matches = []
    with pycolmap.Database.open(str(database)) as opened:
        images = {image.name: image for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        counts = [opened.num_keypoints_for_image(images[name].image_id) for name in names]
        for i, j in pairs:
            found = opened.read_two_view_geometry(images[names[i]].image_id, images[names[j]].image_id).inlier_matches
            if len(found) >= _LEAST_MATCHES:
                matches.append((i, j, np.array(found, dtype=np.intp)))
        frame, feature, point = joined(counts, matches)
        rays = np.zeros((len(frame), 3))
        bounds = np.searchsorted(frame, np.arange(len(names) + 1))
        for k, name in enumerate(names):
            mine, image = slice(bounds[k], bounds[k + 1]), images[name]
            if bounds[k] == bounds[k + 1]:
                continue
            xy_px = np.array(opened.read_keypoints(image.image_id))[feature[mine], :2]
            seen = np.asarray(cameras[image.camera_id].cam_from_img(xy_px.astype(np.float64)))[:, :2]
            ray = np.column_stack([seen, np.ones(len(seen))]) @ start_from_cam[k].T
            rays[mine] = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    return Sightings(frame=frame, point=point, feature=feature, rays=rays)


@dataclass(frozen=True, eq=False, kw_only=True)
class Return:
    """Where a frame is by points that another one, long before or after, had seen.

    Attributes
    ----------
    step
        (3,) from the first frame to the second, in the length of the way at the first.
    start_from_second
        (3, 3) orientation of the second.
    ratio
        Length of the way at the first frame over that at the second.
    depth
        How far away the points are.
    matches
        How many points there are.
    """

    step: Array
    start_from_second: Array
    ratio: float
    depth: float
    matches: int


def returns(
    database: Path, names: Sequence[str], pairs: Sequence[tuple[int, int]], way: RelativeTrack
) -> list[Return | None]:
    """What the verified matches of pairs say; ``None`` where too few of them are points of the way that fit."""
    import pycolmap

    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = _PLACED_PX, 0
    said: list[Return | None] = []
    with pycolmap.Database.open(str(database)) as opened:
        images = {image.name: image for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        for i, j in pairs:
            said.append(None)
            one, two = images[names[i]], images[names[j]]
            matches = np.array(opened.read_two_view_geometry(one.image_id, two.image_id).inlier_matches, dtype=np.intp)
            (of_one, at_one), (of_two, at_two) = way.seen(i), way.seen(j)
            _, mine, place = np.intersect1d(matches[:, 0], of_one, return_indices=True)
            if len(mine) < _LEAST_PLACED:
                continue
            xy_px = np.array(opened.read_keypoints(two.image_id))[matches[mine, 1], :2].astype(np.float64)
            points = at_one[place]
            found = pycolmap.estimate_and_refine_absolute_pose(
                xy_px, points, cameras[two.camera_id], estimation_options=options
            )
            if found is None or found["num_inliers"] < max(_LEAST_PLACED, _PLACED_SHARE * len(mine)):
                continue
            second_from_start = found["cam_from_world"]
            centre = -second_from_start.rotation.matrix().T @ second_from_start.translation
            fit = np.array(found["inlier_mask"])
            away = np.linalg.norm(points - centre, axis=1)
            _, both, other = np.intersect1d(matches[mine, 1], of_two, return_indices=True)
            usable = fit[both]
            if usable.sum() < _LEAST_PLACED // 2:
                continue
            there = np.linalg.norm(at_two[other[usable]] - way.centre[j], axis=1)
            said[-1] = Return(
                step=centre - way.centre[i],
                start_from_second=second_from_start.rotation.matrix().T,
                ratio=float(np.median(away[both[usable]] / there)),
                depth=float(np.median(away[fit])),
                matches=int(fit.sum()),
            )
    return said


def count_verified(database: Path) -> int:
    """Pairs whose matches COLMAP verified."""
    import pycolmap

    with pycolmap.Database.open(str(database)) as opened:
        _, inliers = opened.read_two_view_geometry_num_inliers()
    return int(np.count_nonzero(np.array(inliers)))


def forget(database: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Take the matches of pairs out of a database."""
    import pycolmap

    with pycolmap.Database.open(str(database)) as opened:
        images = {image.name: image.image_id for image in opened.read_all_images()}
        for first, second in pairs:
            opened.delete_matches(images[first], images[second])
            opened.delete_two_view_geometry(images[first], images[second])
