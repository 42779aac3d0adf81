"""Ends of a model that met and were not joined.

COLMAP's incremental mapper grows both ways around a long loop. Where its ends meet they are off by what has drifted;
and where that is more than a few pixels, nothing that both show becomes one point: each end keeps its own, and the
model stays torn there, however often it is adjusted. The matches are in the database. So what both ends hold twice is
made one, and the model is adjusted and its points completed, as COLMAP does at the end.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Int64Array
from colmap_inertial.model.observed import points_of_features

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


#: Two images hang together by so many points in common: as many matches as COLMAP asks of two views.
_LINKED = 15
#: A pair is torn that has so many matches between points, of which hardly any, this share, are one point. COLMAP asks
#: 30 to place an image.
_LEAST_MATCHES, _SAME_SHARE = 30, 0.05
#: Images that hang together over no more others than this lie as the model has them, and what contradicts that joins
#: copies; farther on, the model may have drifted. More than neighbours in time that are matched lie apart.
_HOPS = 10
#: Ends that meet see each other in so many pairs at least.
_LEAST_PAIRS = 3
#: What was made one stays one in this share of the matches, or the ends do not belong together.
_STAYS = 0.5
#: To move ends that are far apart takes more rounds than COLMAP's 50; a walk of 500 frames, off by a metre, took 60.
_ROUNDS = 200
#: COLMAP's own limit: it solves models of more images by conjugate gradients, which along a chain hardly move.
LONGEST = 1000
#: COLMAP's rounds end by the gradient alone, which grows with the model; of models beyond that limit, they end where
#: one takes less than this share of what is left.
_LEAST_GAIN = 1e-7


@dataclass(frozen=True, eq=False, kw_only=True)
class _Torn:
    """A pair of images that shows the same, and of which each has points of its own.

    Attributes
    ----------
    first, second
        The images' numbers.
    features
        (K, 2) matches that are points in both.
    points
        (K, 2) these points.
    """

    first: int
    second: int
    features: Int64Array
    points: Int64Array


@dataclass(frozen=True, kw_only=True)
class LoopClosure:
    """Ends of a model, or two parts of one, that met, and whether they belong together.

    Attributes
    ----------
    pairs
        Of images, in which they see each other.
    images
        The two that have most matches, by name, the earlier one first.
    agree
        Share of their matches that are one point, once they were made one and the model was adjusted.
    joined
        Whether the model has them as one; else it is as it was.
    """

    pairs: int
    images: tuple[str, str]
    agree: float
    joined: bool


@dataclass(frozen=True, kw_only=True)
class SubmapOverlap:
    """Seams of a model that were made one, each by the numbers of the two parts that it is between.

    Attributes
    ----------
    seams
        Each, and whether it fits.
    farthest
        Of each, how far its images are apart in time at most.
    kept
        Share of the images that the model still has; 0 where it could not be adjusted.
    """

    seams: dict[tuple[int, int], LoopClosure]
    farthest: dict[tuple[int, int], int]
    kept: float


def close_gaps(
    database: Path,
    reconstruction: pycolmap.Reconstruction,
    pipeline: pycolmap.IncrementalPipelineOptions,
    names: Sequence[str],
    *,
    nearest: int | None,
) -> LoopClosure | None:
    """Join the ends of a model that met; ``None`` where there are none.

    Parameters
    ----------
    database
        With the matches that the model was made from.
    reconstruction
        Is changed; where they were not joined it may be of no further use.
    pipeline
        What the model was made with.
    names
        Of images, in order of time.
    nearest
        Pairs farther apart in time may join copies, and are not looked at; ``None`` where all may be believed.
    """
    part_of = dict.fromkeys(reconstruction.reg_image_ids(), 0)
    met = merge_overlaps(database, reconstruction, pipeline, names, part_of=part_of, nearest={(0, 0): nearest})
    if not met.seams:
        return None
    ends = met.seams[0, 0]
    joined = ends.joined and met.kept == 1
    said = "joined" if joined else "left as they are: they do not fit"
    log.info("a model's ends, seen in %d pairs of images, %s (%.0f %% agree)", ends.pairs, said, 100 * ends.agree)
    return replace(ends, joined=joined)


def merge_overlaps(
    database: Path,
    reconstruction: pycolmap.Reconstruction,
    pipeline: pycolmap.IncrementalPipelineOptions,
    names: Sequence[str],
    *,
    part_of: Mapping[int, int],
    nearest: Mapping[tuple[int, int], int | None],
) -> SubmapOverlap:
    """Make one what a model holds twice, and tell of each seam whether it fits then.

    Parameters
    ----------
    database, reconstruction, pipeline, names
        As for :func:`close_gaps`.
    part_of
        Of images by number, the parts that they are of.
    nearest
        By the parts of a seam, the smaller number first: pairs farther apart in time are not looked at. Nor is any
        pair of parts that are not named.
    """
    import pycolmap

    cached = pycolmap.DatabaseCacheOptions()
    cached.min_num_matches = pipeline.min_num_matches
    place = {name: at for at, name in enumerate(names)}
    of_seam: dict[tuple[int, int], list[_Torn]] = {}
    with pycolmap.Database.open(str(database)) as opened:
        for pair in _torn(opened, reconstruction, place, part_of, nearest):
            of_seam.setdefault(_seam(part_of, pair.first, pair.second), []).append(pair)
        of_seam = {seam: pairs for seam, pairs in of_seam.items() if len(pairs) >= _LEAST_PAIRS}
        if not of_seam:
            return SubmapOverlap(seams={}, farthest={}, kept=1.0)
        cache = pycolmap.DatabaseCache.create(opened, cached)
    images = reconstruction.num_reg_images()
    name = {number: reconstruction.image(number).name for number in reconstruction.reg_image_ids()}
    _make_one(reconstruction, [pair for pairs in of_seam.values() for pair in pairs])
    try:
        _adjust(reconstruction, cache, pipeline)
        agree = {seam: _agree(reconstruction, pairs) for seam, pairs in of_seam.items()}
        kept = reconstruction.num_reg_images() / images
    except (ValueError, RuntimeError) as error:  # COLMAP's own checks fail where hardly anything fits
        log.info("COLMAP cannot adjust a model whose ends were made one: %s", error)
        agree, kept = dict.fromkeys(of_seam, 0.0), 0.0
    seams, farthest = {}, {}
    for seam, pairs in of_seam.items():
        most = max(pairs, key=lambda pair: len(pair.points))
        first, second = sorted((name[most.first], name[most.second]), key=place.__getitem__)
        joined = agree[seam] >= _STAYS
        seams[seam] = LoopClosure(pairs=len(pairs), images=(first, second), agree=agree[seam], joined=joined)
        farthest[seam] = max(abs(place[name[pair.first]] - place[name[pair.second]]) for pair in pairs)
    return SubmapOverlap(seams=seams, farthest=farthest, kept=kept)


def _seam(part_of: Mapping[int, int], first: int, second: int) -> tuple[int, int]:
    a, b = part_of[first], part_of[second]
    return min(a, b), max(a, b)


def _adjust(
    reconstruction: pycolmap.Reconstruction,
    cache: pycolmap.DatabaseCache,
    pipeline: pycolmap.IncrementalPipelineOptions,
) -> None:
    """Move what was made one together, and finish the model as COLMAP does."""
    import pycolmap

    options = _adjustment(pipeline, reconstruction)
    options.ceres.solver_options.max_num_iterations = _ROUNDS
    pycolmap.bundle_adjustment(reconstruction, options)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(reconstruction)
    _refine(mapper, reconstruction, pipeline)
    mapper.end_reconstruction(False)


def _agree(reconstruction: pycolmap.Reconstruction, torn: Sequence[_Torn]) -> float:
    """Share of the matches that are one point; of an image that the model no longer has, none is."""
    point = {
        number: points_of_features(reconstruction.image(number))
        for pair in torn
        for number in (pair.first, pair.second)
        if reconstruction.exists_image(number)
    }
    one = [
        (of_first[pair.features[:, 0]] == of_second[pair.features[:, 1]]) & (of_first[pair.features[:, 0]] >= 0)
        if (of_first := point.get(pair.first)) is not None and (of_second := point.get(pair.second)) is not None
        else np.zeros(len(pair.features), dtype=np.bool_)
        for pair in torn
    ]
    return float(np.mean(np.concatenate(one)))


def _adjustment(
    pipeline: pycolmap.IncrementalPipelineOptions, reconstruction: pycolmap.Reconstruction
) -> pycolmap.BundleAdjustmentOptions:
    """Of a whole model; solved directly, however many images it has, where few see the same, as along a chain."""
    adjustment = pipeline.get_global_bundle_adjustment()
    adjustment.print_summary = False
    images = reconstruction.num_reg_images()
    if images > LONGEST:
        adjustment.ceres.solver_options.function_tolerance = _LEAST_GAIN
        # no more work than COLMAP takes on itself, where as many images as its limit is all see the same
        if _work(reconstruction) <= _work_of(LONGEST):
            adjustment.ceres.max_num_images_direct_sparse_cpu_solver = images
    return adjustment


def _work(reconstruction: pycolmap.Reconstruction) -> float:
    """Of solving an adjustment directly: the sum of squared rows of its factor, in images; no less than it takes.

    Two images have an entry in common where they see the same point. In an order in which such images lie close
    together, the factor has none before the first entry of each row.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    at = {number: place for place, number in enumerate(sorted(reconstruction.reg_image_ids()))}
    lengths: list[int] = []
    rows: list[int] = []
    for point in reconstruction.points3D.values():
        seen = {at[element.image_id] for element in point.track.elements}
        lengths.append(len(seen))
        rows += sorted(seen)
    columns = np.repeat(np.arange(len(lengths)), lengths)
    sees = coo_matrix(
        (np.ones(len(rows), dtype=np.float32), (np.array(rows, dtype=np.intp), columns)), shape=(len(at), len(lengths))
    ).tocsr()
    both = (sees @ sees.T).tocsr()
    place = np.argsort(reverse_cuthill_mckee(both, symmetric_mode=True))
    row, column = (place[numbers] for numbers in both.nonzero())
    first = np.arange(len(at))
    np.minimum.at(first, row, column)
    return float(np.sum((np.arange(len(at)) - first + 1.0) ** 2))


def _work_of(images: int) -> float:
    """The same, where so many images all see the same."""
    return float(np.sum(np.arange(1.0, images + 1) ** 2))


def _refine(
    mapper: pycolmap.IncrementalMapper,
    reconstruction: pycolmap.Reconstruction,
    pipeline: pycolmap.IncrementalPipelineOptions,
) -> None:
    """Adjust the model and complete its points in turn; COLMAP's own loop would answer no signal until its end."""
    import pycolmap

    adjustment = _adjustment(pipeline, reconstruction)
    mapper.complete_and_merge_tracks(pipeline.get_triangulation())
    mapper.retriangulate(pipeline.get_triangulation())
    for _ in range(pipeline.ba_global_max_refinements):
        observations = reconstruction.compute_num_observations()
        pycolmap.bundle_adjustment(reconstruction, adjustment)
        changed = mapper.complete_and_merge_tracks(pipeline.get_triangulation())
        changed += mapper.filter_points(pipeline.get_mapper())
        if changed < pipeline.ba_global_max_refinement_change * observations:
            break
    reconstruction.normalize()
    mapper.filter_frames(pipeline.get_mapper())


def _torn(
    opened: pycolmap.Database,
    reconstruction: pycolmap.Reconstruction,
    place: Mapping[str, int],
    part_of: Mapping[int, int],
    nearest: Mapping[tuple[int, int], int | None],
) -> list[_Torn]:
    """Pairs that show the same, and hang together by nothing but a long way round."""
    import pycolmap

    when = {number: place.get(reconstruction.image(number).name) for number in reconstruction.reg_image_ids()}
    point = {number: points_of_features(reconstruction.image(number)) for number, at in when.items() if at is not None}
    linked: list[tuple[int, int]] = []
    suspects: list[_Torn] = []
    for pair, count in zip(*opened.read_two_view_geometry_num_inliers(), strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair)
        if count < _LINKED or first not in point or second not in point:
            continue
        matches = np.array(opened.read_two_view_geometry(first, second).inlier_matches, dtype=np.int64)
        points = np.stack([point[first][matches[:, 0]], point[second][matches[:, 1]]], axis=1)
        both = (points >= 0).all(axis=1)
        same = int((both & (points[:, 0] == points[:, 1])).sum())
        if same >= _LINKED:
            linked.append((first, second))
        elif both.sum() >= _LEAST_MATCHES and same <= _SAME_SHARE * both.sum():
            apart = abs(place[reconstruction.image(first).name] - place[reconstruction.image(second).name])
            seam = _seam(part_of, first, second)
            if seam in nearest and ((limit := nearest[seam]) is None or apart <= limit):
                suspects.append(_Torn(first=first, second=second, features=matches[both], points=points[both]))
    hops = _hops(sorted(point), linked, [(pair.first, pair.second) for pair in suspects])
    return [pair for pair, over in zip(suspects, hops, strict=True) if over > _HOPS]


def _hops(numbers: Sequence[int], linked: Sequence[tuple[int, int]], asked: Sequence[tuple[int, int]]) -> list[float]:
    """Over how many pairs that are linked one comes from one image to the other."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra

    if not asked:
        return []
    at = {number: index for index, number in enumerate(numbers)}
    ends = np.array([(at[a], at[b]) for a, b in linked], dtype=np.intp).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(at), len(at))).tocsr()
    begin, row = np.unique([at[a] for a, _ in asked], return_inverse=True)
    away = dijkstra(graph, directed=False, unweighted=True, indices=begin)
    return [float(away[k, at[b]]) for k, (_, b) in zip(row.tolist(), asked, strict=True)]


def _make_one(reconstruction: pycolmap.Reconstruction, torn: Sequence[_Torn]) -> None:
    """Merge points that matches say are one, unless an image then saw it twice."""
    now: dict[int, int] = {}
    for pair in sorted(torn, key=lambda pair: (-len(pair.points), pair.first, pair.second)):
        for couple in pair.points.tolist():
            first, second = (_latest(now, number) for number in couple)
            if first != second and not _images(reconstruction, first) & _images(reconstruction, second):
                now[first] = now[second] = reconstruction.merge_points3D(first, second)


def _latest(now: Mapping[int, int], number: int) -> int:
    """What became of a point; the new one never has the number of an old one."""
    while number in now:
        number = now[number]
    return number


def _images(reconstruction: pycolmap.Reconstruction, number: int) -> set[int]:
    return {element.image_id for element in reconstruction.point3D(number).track.elements}
