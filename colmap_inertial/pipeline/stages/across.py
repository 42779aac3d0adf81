"""Matches between images of two models: where images of one lie in the other, and which points are one.

A chain of images breaks where COLMAP cannot go on, and what comes later may see again what was seen before: the
database has these matches, and neither model uses them. Images of one are placed by points of the other, as COLMAP
places any image.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Int64Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.inertial.join.values import Found
from colmap_inertial.model.observed import points_of_features

if TYPE_CHECKING:
    import pycolmap


#: Matches that a pair of images has at least, and an image to points of another model: as many as COLMAP asks for.
_LEAST_MATCHES, _LEAST_PLACED = 15, 30
#: Of these, so many must agree with one pose, to so many pixels, as COLMAP asks where it places images.
_LEAST_SHARE, _OFF_PX = 0.25, 12.0
#: What COLMAP's complaints about a database have in them: where it cannot be opened, and where it ends too early.
_OF_DATABASE = ("database factory", "SQLite")
#: Two points become one where every image sees it so close, as COLMAP filters points.
_ONE_PX = 4.0


def images_in_others(database: Path, models: Sequence[pycolmap.Reconstruction], numbers: Sequence[int]) -> list[Found]:
    """Images of each model that matches with another one's images place in it.

    Parameters
    ----------
    database
        COLMAP's.
    models, numbers
        The models, each as it lies, and COLMAP's numbers of them.

    Raises
    ------
    FormatError
        Where the database is none, or damaged.
    """
    import pycolmap

    with _opened(database) as opened:
        named = {image.image_id: image.name for image in opened.read_all_images()}
        ids: dict[tuple[str, str], tuple[int, int]] = {}
        for pair, count in zip(*opened.read_two_view_geometry_num_inliers(), strict=True):
            both = pycolmap.pair_id_to_image_pair(pair)
            if count >= _LEAST_MATCHES and all(number in named for number in both):
                ids[named[both[0]], named[both[1]]] = both
        held = [_Held(model) for model in models]
        found = []
        for a, b in permutations(range(len(models)), 2):
            between = {
                names: np.array(opened.read_two_view_geometry(*both).inlier_matches, dtype=np.int64)
                for names, both in ids.items()
                if _between(names, held[a], held[b])
            }
            placed = _placed(held[a], held[b], between)
            if placed:
                names = sorted(placed)
                found.append(
                    Found(
                        first=numbers[a],
                        second=numbers[b],
                        names=tuple(names),
                        beside=tuple(placed[name][0] for name in names),
                        world_from_cam=np.array([placed[name][1].rotation.matrix().T for name in names]),
                        cam_in_world=np.array([placed[name][1].inverse().translation for name in names]),
                        matches=np.unique(np.concatenate([placed[name][2] for name in names]), axis=0),
                    )
                )
    return found


@contextmanager
def _opened(database: Path) -> Iterator[pycolmap.Database]:
    """A database of COLMAP, of which what COLMAP cannot read is said in a sentence."""
    import pycolmap

    try:
        with pycolmap.Database.open(str(database)) as opened:
            yield opened
    except RuntimeError as error:
        if not any(of_database in str(error) for of_database in _OF_DATABASE):
            raise
        raise FormatError(
            database, "COLMAP cannot read its database; put it back as it was, or begin anew in another folder"
        ) from error


class _Held:
    """A model's images by name, and what they see."""

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        self.model = model
        self.images = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
        self._points: dict[str, Int64Array] = {}

    def points(self, name: str) -> Int64Array:
        """Of an image's keypoints, the numbers of their points; -1 without one."""
        if name not in self._points:
            self._points[name] = points_of_features(self.images[name])
        return self._points[name]


def _between(names: tuple[str, str], held: _Held, other: _Held) -> bool:
    """Whether one of two images is in one model alone, and the other image in the other model."""
    where = {(name in held.images, name in other.images) for name in names}
    return where == {(True, False), (False, True)}


def _placed(
    there: _Held, own: _Held, between: Mapping[tuple[str, str], Int64Array]
) -> dict[str, tuple[str, pycolmap.Rigid3d, Int64Array]]:
    """By name of images of ``own``: the image that it matches best, its pose, and points (there, own) that are one."""
    seen: dict[str, dict[tuple[int, int], None]] = defaultdict(dict)
    best: dict[str, Counter[str]] = defaultdict(Counter)
    for (first, second), pairs in between.items():
        name, other, mine, theirs = (
            (second, first, pairs[:, 1], pairs[:, 0]) if second in own.images else (first, second, *pairs.T)
        )
        points = there.points(other)
        # keypoints that the database has and the model does not
        inside = (theirs < len(points)) & (mine < len(own.points(name)))
        mine, at = mine[inside], points[theirs[inside]]
        for keypoint, point in zip(mine[at >= 0].tolist(), at[at >= 0].tolist(), strict=True):
            seen[name][keypoint, point] = None
        best[name][other] += int((at >= 0).sum())
    out = {}
    for name, couples in seen.items():
        if len(couples) < _LEAST_PLACED:
            continue
        pose, inliers = _pose(there, own, name, np.array(list(couples), dtype=np.int64))
        if pose is None:
            continue
        own_points = own.points(name)[inliers[:, 0]]
        joint = np.stack([inliers[:, 1], own_points], axis=1)
        out[name] = best[name].most_common(1)[0][0], pose, joint[own_points >= 0]
    return out


def _pose(there: _Held, own: _Held, name: str, couples: Int64Array) -> tuple[pycolmap.Rigid3d | None, Int64Array]:
    """The pose of an image by (K, 2) keypoints and points of another model, and those that agree; none where few do."""
    import pycolmap

    image = own.images[name]
    xy_px = np.array([image.points2D[int(i)].xy for i in couples[:, 0]])
    points = np.array([there.model.points3D[int(i)].xyz for i in couples[:, 1]])
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = _OFF_PX, 0
    answer = pycolmap.estimate_and_refine_absolute_pose(xy_px, points, own.model.camera(image.camera_id), options)
    if answer is None:
        return None, couples[:0]
    agree = np.asarray(answer["inlier_mask"], dtype=np.bool_)
    if agree.sum() < max(_LEAST_PLACED, _LEAST_SHARE * len(couples)):
        return None, couples[:0]
    return answer["cam_from_world"], couples[agree]


def one_points(
    whole: pycolmap.Reconstruction, models: Mapping[int, pycolmap.Reconstruction], found: Sequence[Found]
) -> int:
    """Make one of what matches say is one point of two models; how many were.

    Only where every image then sees it where it did, and no image has seen both.

    Parameters
    ----------
    whole
        The models in one; changed.
    models
        Each as it was, by COLMAP's number.
    found
        Matches that helped to place them.
    """
    now: dict[tuple[int, int], int] = {}
    by_name = {whole.image(i).name: whole.image(i) for i in whole.reg_image_ids()}

    def number(model: int, point: int) -> int:
        """A model's point in the whole; -1 where it is not there."""
        if (model, point) not in now:
            for element in models[model].points3D[point].track.elements:
                seen = by_name[models[model].image(element.image_id).name].points2D[element.point2D_idx]
                if seen.has_point3D():
                    now[model, point] = int(seen.point3D_id)
                    break
            else:
                now[model, point] = -1
        return now[model, point]

    latest: dict[int, int] = {}
    count = 0
    for one in found:
        for couple in one.matches.tolist():
            first, second = (number(model, point) for model, point in zip((one.first, one.second), couple, strict=True))
            while first in latest:
                first = latest[first]
            while second in latest:
                second = latest[second]
            if min(first, second) < 0 or first == second or not _is_one(whole, first, second):
                continue
            latest[first] = latest[second] = int(whole.merge_points3D(first, second))
            count += 1
    return count


def _is_one(whole: pycolmap.Reconstruction, first: int, second: int) -> bool:
    """Whether two points can be one: all images see it where they see either, and none sees both."""
    points = [whole.point3D(number) for number in (first, second)]
    tracks = [point.track.elements for point in points]
    if {e.image_id for e in tracks[0]} & {e.image_id for e in tracks[1]}:
        return False
    lengths = [len(track) for track in tracks]
    middle = (lengths[0] * points[0].xyz + lengths[1] * points[1].xyz) / sum(lengths)
    for element in (*tracks[0], *tracks[1]):
        image = whole.image(element.image_id)
        xy_px = image.project_point(middle)
        if xy_px is None or float(np.linalg.norm(xy_px - image.point2D(element.point2D_idx).xy)) > _ONE_PX:
            return False
    return True
