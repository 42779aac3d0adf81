"""Loop closure of COLMAP's models: points that both ends of a loop hold are merged.

COLMAP's incremental mapper grows both ways around a long loop. Where its ends meet they are off by the drift; and where
that is more than a few pixels, no track joins them: each end keeps its own points, and the model stays torn there,
however often it is adjusted. The matches are in the database. So points of matched features are merged, the model is
adjusted, and its points are completed, as COLMAP does at the end.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.colmap.settings import NO_SETTINGS, ColmapSettings
from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.core.arrays import Int64Array
from colmap_inertial.model.submodels.graph import Pair
from colmap_inertial.model.submodels.matches import LIMITS, Submodel, read_matches
from colmap_inertial.model.submodels.merging import merge_points

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


#: COLMAP's own limit: it solves models of more images by conjugate gradients, which along a chain hardly move.
LONGEST = 1000


@dataclass(frozen=True, kw_only=True)
class LoopClosureLimits:
    """Limits for pairs of images that close a loop, and for accepting the closed loop."""

    #: A pair is torn that has so many matches between points: COLMAP asks so many to place an image ...
    torn_matches: int = 30
    #: ... of which hardly any, this share, are one point.
    torn_same_share: float = 0.05
    #: Images that are linked over no more others than this lie as the model has them, and what contradicts that joins
    #: copies; farther on, the model may have drifted. More than neighbours in time that are matched lie apart.
    links: int = 10
    #: A loop is closed by so many pairs at least.
    pairs: int = 3
    #: Merged points stay one in this share of the matches, or the loop is not accepted.
    agreeing_share: float = 0.5
    #: To move ends that are far apart takes more rounds than COLMAP's 50; 500 frames, off by a metre, took 60.
    rounds: int = 200
    #: COLMAP's rounds end by the gradient alone, which grows with the model; of models beyond ``LONGEST`` and of those
    #: that are made of parts, they end where one takes less than this share of what remains.
    least_gain: float = 1e-6
    #: In Ceres's first trust region, of 1e4, a chain bends only a little in each round; in one so much larger, rounds
    #: are those of Gauss and Newton, and few (``scripts.benchmarks.whole --long 500 --density 8.55 --seeds 101``: 7.2
    #: mm after 18 s of processor time with 1e4 and 1e-7, 6.7 mm after 12 s with these two).
    trust_region_radius: float = 1e10


CLOSURE = LoopClosureLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class MappedCapture:
    """A matched capture, from which models are made.

    Attributes
    ----------
    database
        With the matches.
    pipeline
        Options of the mapper.
    names
        Of images, in order of time.
    orientations
        Of the images, by the gyroscope.
    settings
        What the user set of adjustments of a whole model.
    """

    database: Path
    pipeline: pycolmap.IncrementalPipelineOptions
    names: Sequence[str]
    orientations: ImageOrientations = field(default_factory=ImageOrientations)
    settings: ColmapSettings = NO_SETTINGS

    @cached_property
    def cache(self) -> pycolmap.DatabaseCache:
        """The matches that the mapper uses; read once for all adjustments of a join."""
        import pycolmap

        options = pycolmap.DatabaseCacheOptions()
        options.min_num_matches = self.pipeline.min_num_matches
        with pycolmap.Database.open(str(self.database)) as opened:
            return pycolmap.DatabaseCache.create(opened, options)


@dataclass(frozen=True, eq=False, kw_only=True)
class _TornPair:
    """A pair of images that are matched, each with points of its own.

    Attributes
    ----------
    first, second
        The images' names.
    features
        (K, 2) matches that are points in both.
    points
        (K, 2) these points.
    """

    first: str
    second: str
    features: Int64Array
    points: Int64Array


@dataclass(frozen=True, kw_only=True)
class LoopClosure:
    """A loop of a model, or an overlap of two parts, and whether it was closed.

    Attributes
    ----------
    pairs
        Of images that close it.
    images
        The two that have most matches, by name, the earlier one first.
    agree
        Share of their matches that are one point, once points were merged and the model was adjusted.
    joined
        Whether the model keeps the merged points; else it is as it was.
    """

    pairs: int
    images: tuple[str, str]
    agree: float
    joined: bool


@dataclass(frozen=True, kw_only=True)
class SubmapOverlap:
    """Overlaps of parts whose points were merged, by the numbers of the two parts.

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
    capture: MappedCapture, reconstruction: pycolmap.Reconstruction, *, nearest: int | None
) -> LoopClosure | None:
    """Close the loops of a model; ``None`` where there are none.

    Parameters
    ----------
    reconstruction
        Is changed; where the loop was not closed it may be of no further use.
    nearest
        Pairs farther apart in time may join copies, and are not looked at; ``None`` where all may be believed.
    """
    part_of = dict.fromkeys(reconstruction.reg_image_ids(), 0)
    overlap = merge_overlaps(capture, reconstruction, part_of=part_of, nearest={(0, 0): nearest})
    if not overlap.seams:
        return None
    ends = overlap.seams[0, 0]
    joined = ends.joined and overlap.kept == 1
    outcome = "joined" if joined else "left as they are: they do not fit"
    log.info("a model's ends, seen in %d pairs of images, %s (%.0f %% agree)", ends.pairs, outcome, 100 * ends.agree)
    return replace(ends, joined=joined)


def merge_overlaps(
    capture: MappedCapture,
    reconstruction: pycolmap.Reconstruction,
    *,
    part_of: Mapping[int, int],
    nearest: Mapping[Pair, int | None],
) -> SubmapOverlap:
    """Merge points that a model holds twice, adjust it, and judge whether each overlap fits then.

    Parameters
    ----------
    reconstruction
        Is changed.
    part_of
        Of images by number, the parts that they are of.
    nearest
        By the parts of a seam, the smaller number first: pairs farther apart in time are not looked at. Nor is any
        pair of parts that are not named.
    """
    place = {name: at for at, name in enumerate(capture.names)}
    part = {reconstruction.image(number).name: k for number, k in part_of.items()}
    of_seam: dict[Pair, list[_TornPair]] = {}
    for pair in _find_torn_pairs(capture.database, Submodel(reconstruction), place, part, nearest):
        of_seam.setdefault(_seam(part, pair.first, pair.second), []).append(pair)
    of_seam = {seam: pairs for seam, pairs in of_seam.items() if len(pairs) >= CLOSURE.pairs}
    if not of_seam:
        return SubmapOverlap(seams={}, farthest={}, kept=1.0)
    images = reconstruction.num_reg_images()
    torn = sorted(itertools.chain(*of_seam.values()), key=lambda pair: (-len(pair.points), pair.first, pair.second))
    merge_points(reconstruction, (couple for pair in torn for couple in map(tuple, pair.points.tolist())))
    try:
        _adjust(reconstruction, capture, of_parts=len(set(part_of.values())) > 1)
        adjusted = Submodel(reconstruction)
        agree = {seam: _agreeing_share(adjusted, pairs) for seam, pairs in of_seam.items()}
        kept = reconstruction.num_reg_images() / images
    except (ValueError, RuntimeError) as error:  # COLMAP's own checks fail where hardly anything fits
        log.info("COLMAP cannot adjust a model whose ends were merged: %s", error)
        agree, kept = dict.fromkeys(of_seam, 0.0), 0.0
    seams, farthest = {}, {}
    for seam, pairs in of_seam.items():
        most = max(pairs, key=lambda pair: len(pair.points))
        first, second = sorted((most.first, most.second), key=place.__getitem__)
        joined = agree[seam] >= CLOSURE.agreeing_share
        seams[seam] = LoopClosure(pairs=len(pairs), images=(first, second), agree=agree[seam], joined=joined)
        farthest[seam] = max(abs(place[pair.first] - place[pair.second]) for pair in pairs)
    return SubmapOverlap(seams=seams, farthest=farthest, kept=kept)


def _seam(part_of: Mapping[str, int], first: str, second: str) -> Pair:
    a, b = part_of[first], part_of[second]
    return min(a, b), max(a, b)


def _adjust(reconstruction: pycolmap.Reconstruction, capture: MappedCapture, *, of_parts: bool) -> None:
    """Adjust a model whose points were merged, and complete its points in turn, as COLMAP does at the end."""
    import pycolmap

    pipeline = capture.pipeline
    options = _adjustment(pipeline, reconstruction, of_parts=of_parts)
    options.ceres.solver_options.max_num_iterations = CLOSURE.rounds
    pycolmap.bundle_adjustment(reconstruction, capture.settings.apply(options))
    mapper = pycolmap.IncrementalMapper(capture.cache)
    mapper.begin_reconstruction(reconstruction)
    # COLMAP's own loop would answer no signal until its end
    options = capture.settings.apply(_adjustment(pipeline, reconstruction, of_parts=of_parts))
    mapper.complete_and_merge_tracks(pipeline.get_triangulation())
    mapper.retriangulate(pipeline.get_triangulation())
    for _ in range(pipeline.ba_global_max_refinements):
        observations = reconstruction.compute_num_observations()
        pycolmap.bundle_adjustment(reconstruction, options)
        changed = mapper.complete_and_merge_tracks(pipeline.get_triangulation())
        changed += mapper.filter_points(pipeline.get_mapper())
        if changed < pipeline.ba_global_max_refinement_change * observations:
            break
    reconstruction.normalize()
    mapper.filter_frames(pipeline.get_mapper())
    mapper.end_reconstruction(False)


def _agreeing_share(model: Submodel, torn: Sequence[_TornPair]) -> float:
    """Share of the matches that are one point; of an image that the model no longer has, none is."""
    same = []
    for pair in torn:
        same.append(np.zeros(len(pair.features), dtype=np.bool_))
        if pair.first in model.images and pair.second in model.images:
            of_first, of_second = (
                model.points(name)[pair.features[:, k]] for k, name in enumerate((pair.first, pair.second))
            )
            same[-1] = (of_first == of_second) & (of_first >= 0)
    return float(np.mean(np.concatenate(same)))


def _adjustment(
    pipeline: pycolmap.IncrementalPipelineOptions, reconstruction: pycolmap.Reconstruction, *, of_parts: bool
) -> pycolmap.BundleAdjustmentOptions:
    """Options of the adjustment of a whole model: direct, however many images, where few see the same, as along a
    chain.
    """
    adjustment = pipeline.get_global_bundle_adjustment()
    adjustment.print_summary = False
    images = reconstruction.num_reg_images()
    if of_parts or images > LONGEST:
        adjustment.ceres.solver_options.function_tolerance = CLOSURE.least_gain
        adjustment.ceres.solver_options.initial_trust_region_radius = CLOSURE.trust_region_radius
    # no more work than COLMAP takes on itself, where as many images as its limit is all see the same
    if images > LONGEST and _work(reconstruction) <= _work_of(LONGEST):
        adjustment.ceres.max_num_images_direct_sparse_cpu_solver = images
    return adjustment


def _work(reconstruction: pycolmap.Reconstruction) -> float:
    """Work of solving an adjustment directly: the sum of squared rows of its factor, in images; an upper bound.

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
    return images * (images + 1.0) * (2 * images + 1.0) / 6


def _find_torn_pairs(
    database: Path,
    model: Submodel,
    place: Mapping[str, int],
    part_of: Mapping[str, int],
    nearest: Mapping[Pair, int | None],
) -> list[_TornPair]:
    """Find matched pairs that are linked only over many other images."""
    linked: list[tuple[str, str]] = []
    suspects: list[_TornPair] = []
    timed = model.images.keys() & place.keys()
    for first, second, matches in read_matches(database, lambda a, b: a in timed and b in timed):
        points = np.stack([model.points(first)[matches[:, 0]], model.points(second)[matches[:, 1]]], axis=1)
        both = (points >= 0).all(axis=1)
        same = int((both & (points[:, 0] == points[:, 1])).sum())
        if same >= LIMITS.matches:
            linked.append((first, second))
        elif both.sum() >= CLOSURE.torn_matches and same <= CLOSURE.torn_same_share * both.sum():
            limit = nearest.get(_seam(part_of, first, second), -1)
            if limit is None or abs(place[first] - place[second]) <= limit:
                suspects.append(_TornPair(first=first, second=second, features=matches[both], points=points[both]))
    within = _find_linked_images(sorted(timed), linked, {pair.first for pair in suspects})
    return [pair for pair in suspects if pair.second not in within[pair.first]]


def _find_linked_images(
    names: Sequence[str], linked: Sequence[tuple[str, str]], begins: Collection[str]
) -> dict[str, set[str]]:
    """Images that are linked to some over no more others than neighbours are."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra

    at = {name: index for index, name in enumerate(names)}
    ends = np.array([(at[a], at[b]) for a, b in linked], dtype=np.intp).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(at), len(at))).tocsr()
    near = {}
    for name in begins:  # one at a time: in a long capture there are many
        away = dijkstra(graph, directed=False, unweighted=True, indices=[at[name]], limit=CLOSURE.links)[0]
        near[name] = {names[index] for index in np.flatnonzero(np.isfinite(away)).tolist()}
    return near
