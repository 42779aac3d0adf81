"""Mapping of long captures in overlapping parts, which are then merged to one model.

COLMAP adjusts the whole model again and again while it grows, so that the time for each image grows with the model, and
from 1000 images on by conjugate gradients, which along a chain of images hardly move. Parts take as long for each image
in a capture of any length, and are mapped at the same time.
Points that two parts have both, in shared images and in matches between them, constrain the similarity between the two;
together with the loops that matching closed, these place all parts. Then their points are merged, and the whole is
adjusted. A constraint that does not fit then is left out, the worst first, and the rest is placed and adjusted again.
"""

from __future__ import annotations

import copy
import itertools
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.colmap.chunks import Executor
from colmap_inertial.colmap.loops.closure import LONGEST, LoopClosure, MappedCapture, SubmapOverlap, merge_overlaps
from colmap_inertial.colmap.mapping.part_chunks import map_parts, prepare_part
from colmap_inertial.io.disk import remove
from colmap_inertial.model.submodels.graph import (
    Convergence,
    Equations,
    Pair,
    Placements,
    SimilarityConstraint,
    among,
    chain_placements,
    columns_of,
    find_connected,
    minimise_placements,
)
from colmap_inertial.model.submodels.matches import Submodel, constrain_by_points, find_common_features, matches_between
from colmap_inertial.model.submodels.merging import merge_models

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class PartSizes:
    """Sizes of parts, in images.

    Measured by ``python -m scripts.benchmarks.whole --long 500 --density 8.55`` and ``--long 1000``.
    """

    #: A capture of fewer images is mapped in one go.
    least: int = 300
    #: Where cameras are refined, parts bend: up to COLMAP's own limit there is one, and parts are long.
    least_refined: int = LONGEST + 1
    longest_refined: int = 400
    #: A part has so many observations: the mapper's time grows faster than their number.
    observations: int = 110_000
    #: Images of a part, whatever the observations: ends and adjustments count for more in shorter ones, while the time
    #: that parts take does not fall any more ...
    shortest: int = 100
    #: ... and longer ones leave processors idle.
    longest: int = 200
    #: Share of its images that the next part has, too.
    shared: float = 0.2
    #: Images that the next part has at most.
    most_shared: int = 40


SIZES = PartSizes()
#: The merged model keeps so much of the images, or parts stay apart: what only its part's seam held may go.
LEAST_KEPT_SHARE = 0.99
#: Squares are of shares of points' distances: the adjustment that follows corrects far more than this.
_CONVERGENCE = Convergence(rounds=50, step=1e-7, squares=0.0, squares_share=1e-9)


#: A part's models, by number.
_Models = dict[int, "pycolmap.Reconstruction"]


@dataclass(frozen=True, kw_only=True)
class RemappingLimits:
    """Limits for mapping a part again, with another random seed.

    Of two views of a plane there are two poses, and a model that begins with the wrong one never gets rid of it. Where
    cameras are known, models begin with the right one (``mapping.incremental``); where they are not, COLMAP decides.
    It did so for one of 13 parts of ``scripts.benchmarks.whole --long 2000 --streets``: 1.12 px, and 2 m off.
    """

    #: Its mean residual is larger than so many times that of the usual part, of so many at least.
    worse: float = 1.4
    least_parts: int = 3
    #: So often at most; the new models must have this share of the images.
    times: int = 2
    kept: float = 0.95


_AGAIN = RemappingLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class MappedRun:
    """A model of a run of the images, or of some of it; a part of the whole.

    Attributes
    ----------
    model
        COLMAP's.
    begin, end
        The images that it was made from, by their places in time: the first one, and the first one beyond.
    """

    model: pycolmap.Reconstruction
    begin: int
    end: int


def runs(count: int, *, longest: int, shared: int) -> list[tuple[int, int]]:
    """Begins and ends of few runs, about equally long, that hold so many images; neighbours share some."""
    parts = max(1, -(-(count - shared) // (longest - shared)))
    begins = np.round(np.arange(parts + 1) * (count - shared) / parts).astype(int).tolist()
    return [(begin, min(count, end + shared)) for begin, end in itertools.pairwise(begins)]


def split_capture(capture: MappedCapture) -> list[tuple[int, int]]:
    """Begins and ends of the parts that a capture is mapped in, by its observations; one where it is short."""
    count, refined = len(capture.names), capture.pipeline.ba_refine_focal_length
    if count < (SIZES.least_refined if refined else SIZES.least):
        return [(0, count)]
    longest = SIZES.longest_refined
    if not refined:
        graph = capture.cache.correspondence_graph
        observations = sum(graph.num_observations_for_image(number) for number in capture.cache.images)
        longest = int(np.clip(SIZES.observations * count / max(observations, 1), SIZES.shortest, SIZES.longest))
    return runs(count, longest=longest, shared=min(round(SIZES.shared * longest), SIZES.most_shared))


def map_runs(
    capture: MappedCapture,
    images: Path,
    scratch: Path,
    parts: Sequence[tuple[int, int]],
    *,
    executor: Executor,
    registered: Callable[[int], None],
) -> list[MappedRun]:
    """Run COLMAP's incremental mapper on runs of the images; twice or more where a model began with a wrong pose.

    Parameters
    ----------
    scratch
        Models of the runs are kept there; those that an earlier call has left are not made again.
    parts
        Begins and ends, as :func:`runs` has them.
    executor
        Who maps the parts, each in one thread.
    registered
        Is called with numbers of images that parts place.
    """

    def map_these(numbers: Sequence[int], seed: int, told: Callable[[int], None]) -> dict[int, _Models]:
        chunks = []
        for number in numbers:
            begin, end = parts[number]
            own = copy.copy(capture.pipeline)
            own.extract_colors, own.num_threads, own.random_seed = False, 1, seed
            own.image_names = list(capture.names[begin:end])
            folder = scratch / f"{number}_{seed}"
            remove(folder)  # of a run that was killed
            chunks.append(prepare_part(capture.database, images, own, folder, number, capture.orientations))
        return dict(zip(numbers, map_parts(chunks, executor, told), strict=True))

    seed = capture.pipeline.random_seed
    made = map_these(range(len(parts)), seed, registered)
    for further in range(1, 1 + _AGAIN.times):
        worse = _find_worse_parts(made)
        if not worse:
            break
        log.info("mapped again, as residuals are larger than in other parts: %s", [k + 1 for k in worse])
        other = map_these(worse, seed + further, lambda _: None)
        made |= {k: models for k, models in other.items() if _is_better(models, made[k])}
    return [
        MappedRun(model=model, begin=begin, end=end)
        for k, (begin, end) in enumerate(parts)
        for model in made[k].values()
    ]


def _is_better(models: _Models, than: _Models) -> bool:
    """Whether models of a part have smaller residuals, and about as many images or more."""
    images, others = (sum(int(model.num_reg_images()) for model in either.values()) for either in (models, than))
    return images >= _AGAIN.kept * others and _error_px(models) < _error_px(than)


def _error_px(models: _Models) -> float:
    """Mean residual of the largest model."""
    largest = max(models.values(), key=lambda model: int(model.num_reg_images()), default=None)
    return float("inf") if largest is None else float(largest.compute_mean_reprojection_error())


def _find_worse_parts(made: Mapping[int, _Models]) -> list[int]:
    """Parts whose residuals are much larger than those of the usual part: COLMAP began them with a wrong pose."""
    error_px = {k: _error_px(models) for k, models in made.items() if models}
    if len(error_px) < _AGAIN.least_parts:
        return []
    limit_px = _AGAIN.worse * float(np.median(list(error_px.values())))
    return [k for k, error in error_px.items() if error > limit_px]


def join_runs(
    capture: MappedCapture, parts: Sequence[MappedRun], *, near: int, loops: bool
) -> tuple[list[pycolmap.Reconstruction], list[LoopClosure]]:
    """Join overlapping parts to one model, the largest first; the seams between them, those that did not fit, too.

    Of a seam that does not fit, first the loops are left out, then all its matches: it constrains no part then, and
    merges no points. Each round leaves one out, so that the loop ends; at worst, parts stay as they are.

    Parameters
    ----------
    near
        Images no farther apart in time are neighbours.
    loops
        Whether matches of others may be believed; else they may join copies, and are not looked at.
    """
    farthest = None if loops else near
    ties = find_ties(capture, parts, nearest=farthest)
    nearby: dict[Pair, SimilarityConstraint] | None = None
    nearest: dict[Pair, int | None] = dict.fromkeys([*ties, *((k, k) for k in range(len(parts)))], farthest)
    joined: list[pycolmap.Reconstruction] = []
    seams: list[LoopClosure] = []
    waiting = find_connected(range(len(parts)), ties)
    while waiting:
        members = waiting.pop(0)
        if len(members) == 1:
            joined.append(parts[members[0]].model)
            continue
        own = among(ties.values(), members)
        placed = place_parts(len(members), own)
        whole, part_of = merge_parts([parts[k] for k in members], placed, capture.names)
        of_group = {number: members[k] for number, k in part_of.items()}
        overlap = merge_overlaps(capture, whole, part_of=of_group, nearest=nearest)
        fitting = [pair for pair, seam in overlap.seams.items() if seam.joined]
        all_fit = len(fitting) == len(overlap.seams) and len(find_connected(members, fitting)) == 1
        if all_fit and overlap.kept >= LEAST_KEPT_SHARE:
            joined.append(whole)
            seams += overlap.seams.values()
            continue
        worst = _worst(overlap, {(members[tie.first], members[tie.second]): tie.misfit(placed) for tie in own})
        if worst in overlap.seams:
            seams.append(replace(overlap.seams[worst], joined=False))
        log.info("parts %d and %d do not fit", *worst)
        ties.pop(worst, None)
        if nearest.pop(worst) is None and overlap.farthest.get(worst, 0) > near:
            if nearby is None:
                nearby = find_ties(capture, parts, nearest=near)
            if worst in nearby:
                ties[worst] = nearby[worst]
            if worst in nearby or worst[0] == worst[1]:
                nearest[worst] = near
        waiting = find_connected(members, ties) + waiting
    return sorted(joined, key=lambda model: -int(model.num_reg_images())), seams


def _worst(overlap: SubmapOverlap, misfit: dict[Pair, float]) -> Pair:
    """The seam that fits worst after the adjustment; where all fit, the constraint that fits worst."""
    if all(seam.joined for seam in overlap.seams.values()) and (unseen := misfit.keys() - overlap.seams.keys()):
        return max(unseen, key=lambda pair: (misfit[pair], pair))
    return min(overlap.seams, key=lambda pair: (overlap.seams[pair].agree, -misfit.get(pair, 0.0), pair))


def find_ties(
    capture: MappedCapture, parts: Sequence[MappedRun], *, nearest: int | None
) -> dict[Pair, SimilarityConstraint]:
    """Constraints by points that parts have both: in images that both have, or else in images that are matched.

    Parameters
    ----------
    nearest
        Matches of images farther apart in time do not count; ``None`` where all do.
    """
    place = {name: at for at, name in enumerate(capture.names)}
    submodels = [Submodel(part.model) for part in parts]
    shared = find_common_features(submodels)

    def near(first: str, second: str) -> bool:
        return nearest is None or abs(place[first] - place[second]) <= nearest

    views = matches_between(capture.database, submodels, near) | shared
    ties = {pair: constrain_by_points(submodels, pair, views[pair]) for pair in sorted(views)}
    return {pair: tie for pair, tie in ties.items() if tie is not None}


def place_parts(count: int, ties: Sequence[SimilarityConstraint]) -> Placements:
    """Place connected parts in the first one's world, by all constraints at once."""
    order = sorted(ties, key=lambda tie: -float(np.trace(tie.info)))
    start = chain_placements(
        Placements.at_origin(np.ones(count)), 0, order, lambda state, tie, new: tie.attach(state, new, scaled=True)
    )

    def equations(state: Placements) -> Equations:
        out = Equations(len(state.change))
        for tie in ties:
            tie.add_to(out, state)
        out.hold(columns_of(0))
        return out

    try:
        return minimise_placements(start, equations, _CONVERGENCE)[0]
    except np.linalg.LinAlgError as error:
        log.info("parts lie one after the other: %s", error)
        return start


def merge_parts(
    group: Sequence[MappedRun], placed: Placements, names: Sequence[str]
) -> tuple[pycolmap.Reconstruction, dict[int, int]]:
    """One model of parts, and by number of an image whose it is: of several, that has most images on both sides."""
    import pycolmap

    place = {name: at for at, name in enumerate(names)}
    owner: dict[str, tuple[int, int]] = {}
    # each part refined its own cameras, where they are refined: those of the part that sees most count
    cameras: dict[int, pycolmap.Camera] = {}
    for part in sorted(group, key=lambda part: int(part.model.compute_num_observations())):
        cameras |= part.model.cameras
    moved = []
    for k, part in enumerate(group):
        model = pycolmap.Reconstruction(part.model)
        model.transform(placed.similarity(k))
        for number in model.cameras:
            model.camera(number).params = list(cameras[number].params)
        moved.append(model)
        for number in model.reg_image_ids():
            name = model.image(number).name
            inside = min(place[name] - part.begin, part.end - 1 - place[name])
            if name not in owner or inside > owner[name][0]:
                owner[name] = (inside, k)
    of_images = {name: k for name, (_, k) in owner.items()}
    whole, _ = merge_models(moved, owner=of_images)
    return whole, {number: of_images[whole.image(number).name] for number in whole.reg_image_ids()}
