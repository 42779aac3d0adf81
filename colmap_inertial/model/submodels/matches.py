"""Constraints by images of two submodels: features that both have, and verified matches between images of either.

A chain of images breaks where COLMAP cannot go on, and what comes later may see again what was seen before: the
database has these matches, and neither submodel uses them. Points of both give a similarity, whatever the units; where
both are metric, images of one are placed by points of the other, as COLMAP places any image, which is more precise.
"""

from __future__ import annotations

import itertools
import logging
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.io.files import reading
from colmap_inertial.model import points_of_features
from colmap_inertial.model.database import UNREADABLE, open_read_only
from colmap_inertial.model.submodels.graph import Pair, SimilarityConstraint

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: Names of two images, and (M, 2) their features that show the same.
View = tuple[str, str, Int64Array]


@dataclass(frozen=True, kw_only=True)
class MatchLimits:
    """Limits for matches between images of two submodels."""

    #: Matches of a pair of images, and points of a pair of submodels: as many as COLMAP asks of two views.
    matches: int = 15
    #: Places of a point in two submodels differ by this share of how far away it is from the camera, or it is not the
    #: same.
    same_share: float = 0.1
    #: Of a pair of submodels, so many points are plenty to place them by: each pair counts alike.
    plenty: int = 500
    #: Matches of an image to points of another submodel, as COLMAP asks for where it places images ...
    placed: int = 30
    #: ... the share of them that agrees with one pose ...
    placed_share: float = 0.25
    #: ... and to so many pixels.
    placed_px: float = 12.0


LIMITS = MatchLimits()


class Submodel:
    """A model's images by name, or some of them, and what they see."""

    def __init__(self, model: pycolmap.Reconstruction, names: Collection[str] | None = None) -> None:
        self.model = model
        images = map(model.image, model.reg_image_ids())
        self.images = {image.name: image for image in images if names is None or image.name in names}
        self._points: dict[str, Int64Array] = {}

    def points(self, name: str) -> Int64Array:
        """Point numbers of an image's features; -1 without a point."""
        if name not in self._points:
            self._points[name] = points_of_features(self.images[name])
        return self._points[name]

    def xyz(self, numbers: Int64Array) -> Array:
        """(N, 3) of points by number."""
        return np.array([self.model.point3D(number).xyz for number in numbers.tolist()]).reshape(-1, 3)


def read_matches(database: Path, wanted: Callable[[str, str], bool]) -> Iterator[View]:
    """Verified matches of pairs of images, by name.

    Raises
    ------
    FormatError
        Where the database is none, or damaged.
    """
    import pycolmap

    with reading(database, UNREADABLE), open_read_only(database) as opened:
        name = dict(opened.execute("SELECT image_id, name FROM images"))
        enough = "SELECT pair_id FROM two_view_geometries WHERE rows >= ? ORDER BY pair_id"
        for (pair,) in opened.execute(enough, (LIMITS.matches,)).fetchall():
            first, second = (name.get(number) for number in pycolmap.pair_id_to_image_pair(pair))
            if first is not None and second is not None and wanted(first, second):
                rows, data = opened.execute(
                    "SELECT rows, data FROM two_view_geometries WHERE pair_id = ?", (pair,)
                ).fetchone()
                yield first, second, np.frombuffer(data, dtype="<u4").reshape(rows, 2).astype(np.int64)


def matches_between(
    database: Path, submodels: Sequence[Submodel], wanted: Callable[[str, str], bool] | None = None
) -> dict[Pair, list[View]]:
    """Matches between images that are in one of two submodels alone, by pair of submodels."""
    holders: dict[str, set[int]] = defaultdict(set)
    for k, submodel in enumerate(submodels):
        for name in submodel.images:
            holders[name].add(k)

    def apart(first: str, second: str) -> bool:
        in_models = first in holders and second in holders and holders[first] != holders[second]
        return in_models and (wanted is None or wanted(first, second))

    out: dict[Pair, list[View]] = defaultdict(list)
    for first, second, features in read_matches(database, apart):
        for a in holders[first] - holders[second]:
            for b in holders[second] - holders[first]:
                out[min(a, b), max(a, b)].append(
                    (first, second, features) if a < b else (second, first, features[:, ::-1])
                )
    return out


def find_common_features(submodels: Sequence[Submodel]) -> dict[Pair, list[View]]:
    """Features of images that two submodels share, by pair of submodels."""
    out: dict[Pair, list[View]] = {}
    for (a, first), (b, second) in itertools.combinations(enumerate(submodels), 2):
        if both := sorted(first.images.keys() & second.images.keys()):
            out[a, b] = [(name, name, np.tile(np.arange(len(first.points(name)))[:, None], 2)) for name in both]
    return out


def constrain_by_points(
    submodels: Sequence[Submodel], pair: Pair, views: Sequence[View]
) -> SimilarityConstraint | None:
    """The similarity by points that two submodels have both, errors as shares of how far away they are.

    Points that contradict the others do not count; ``None`` where these are too few.
    """
    import pycolmap

    first, second = (submodels[k] for k in pair)
    points = [np.stack([first.points(a)[f[:, 0]], second.points(b)[f[:, 1]]], axis=1) for a, b, f in views]
    points = [of_view[(of_view >= 0).all(axis=1)] for of_view in points]
    view = np.repeat(np.arange(len(views)), [len(of_view) for of_view in points])
    pairs, at = np.unique(np.concatenate(points), axis=0, return_index=True)
    if len(pairs) < LIMITS.matches:
        return None
    centres = np.array([first.images[name].projection_center() for name, _, _ in views])
    in_first, in_second = first.xyz(pairs[:, 0]), second.xyz(pairs[:, 1])
    away = np.linalg.norm(in_first - centres[view[at]], axis=1)
    ransac = pycolmap.RANSACOptions()
    ransac.random_seed = 0
    ransac.max_error = LIMITS.same_share * float(np.median(away))
    estimate: Any = pycolmap.estimate_sim3d_robust(in_second, in_first, ransac)  # a dict, whatever its stub says
    if estimate is None:
        return None
    similarity: pycolmap.Sim3d = estimate["tgt_from_src"]
    agree = np.linalg.norm(in_first - similarity * in_second, axis=1) < LIMITS.same_share * away
    if agree.sum() < max(LIMITS.matches, len(pairs) / 2):
        return None
    log.info("submodels %d and %d: %d of %d points agree", *pair, agree.sum(), len(pairs))
    return SimilarityConstraint.fitted(
        *pair,
        (in_first[agree], in_second[agree]),
        away[agree] * max(1.0, float(agree.sum()) / LIMITS.plenty) ** 0.5,
        start=(float(similarity.scale), similarity.rotation.matrix()),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedImages:
    """Images of one submodel that matches place in another one, as that one lies.

    Attributes
    ----------
    first, second
        COLMAP's number of the submodel in which they were found, and of their own.
    names
        Of the images.
    beside
        The other submodel's images that each of them matches best.
    world_from_cam, cam_in_world
        (n, 3, 3), (n, 3) poses in the other submodel.
    matches
        (m, 2) pairs of points that these matches say are one, by their numbers in the two submodels.
    """

    first: int
    second: int
    names: tuple[str, ...]
    beside: tuple[str, ...]
    world_from_cam: Array
    cam_in_world: Array
    matches: Int64Array


def place_images(
    database: Path, models: Sequence[pycolmap.Reconstruction], numbers: Sequence[int]
) -> list[PlacedImages]:
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
    submodels = [Submodel(model) for model in models]
    between = matches_between(database, submodels)
    out = []
    for a, b in itertools.permutations(range(len(models)), 2):
        views = between.get((min(a, b), max(a, b)), [])
        if a > b:
            views = [(second, first, features[:, ::-1]) for first, second, features in views]
        if placed := localise(submodels[a], submodels[b], views):
            names, beside, poses, seen = zip(*placed, strict=True)
            points = []
            for name, agree in zip(names, seen, strict=True):
                of_own = submodels[b].points(name)[agree[:, 0]]
                points.append(np.stack([agree[:, 1], of_own], axis=1)[of_own >= 0])
            out.append(
                PlacedImages(
                    first=numbers[a],
                    second=numbers[b],
                    names=names,
                    beside=beside,
                    world_from_cam=np.array([pose.rotation.matrix().T for pose in poses]),
                    cam_in_world=np.array([pose.inverse().translation for pose in poses]),
                    matches=np.unique(np.concatenate(points), axis=0),
                )
            )
    return out


def localise(
    there: Submodel, own: Submodel, views: Sequence[View]
) -> list[tuple[str, str, pycolmap.Rigid3d, Int64Array]]:
    """Localise images of ``own``: name, best matching image, pose, and the keypoints with points of ``there`` that
    agree.

    ``views`` are matches of images, ``there`` first.
    """
    seen: dict[str, list[Int64Array]] = defaultdict(list)
    best: dict[str, Counter[str]] = defaultdict(Counter)
    for other, name, features in views:
        points = there.points(other)
        # keypoints that the database has and the model does not
        inside = features[(features[:, 0] < len(points)) & (features[:, 1] < len(own.points(name)))]
        couples = np.stack([inside[:, 1], points[inside[:, 0]]], axis=1)
        seen[name].append(couples[couples[:, 1] >= 0])
        best[name][other] += len(seen[name][-1])
    out = []
    for name, of_views in sorted(seen.items()):
        couples, order = np.unique(np.concatenate(of_views), axis=0, return_index=True)
        couples = couples[np.argsort(order)]  # as they were read: RANSAC draws by their order
        pose, agree = _estimate_pose(there, own, name, couples)
        if pose is not None:
            out.append((name, best[name].most_common(1)[0][0], pose, agree))
    return out


def _estimate_pose(
    there: Submodel, own: Submodel, name: str, couples: Int64Array
) -> tuple[pycolmap.Rigid3d | None, Int64Array]:
    """The pose of an image by (K, 2) keypoints and points of another model, and those that agree; none where few do."""
    import pycolmap

    image = own.images[name]
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = LIMITS.placed_px, 0
    if len(couples) >= LIMITS.placed:
        xy_px = np.array([image.points2D[i].xy for i in couples[:, 0].tolist()])
        camera = own.model.camera(image.camera_id)
        answer = pycolmap.estimate_and_refine_absolute_pose(xy_px, there.xyz(couples[:, 1]), camera, options)
        if answer is not None:
            agree = couples[np.asarray(answer["inlier_mask"], dtype=np.bool_)]
            if len(agree) >= max(LIMITS.placed, LIMITS.placed_share * len(couples)):
                return answer["cam_from_world"], agree
    return None, couples[:0]
