"""Find the place of a target in a model, the detections that belong together, and how each view numbers its corners.

Two views that see a part of the target from different places give its corners in space, and with them a similarity,
scale included. Every other view then says whether it agrees. The pair on which most views agree wins, so false
detections, wrong poses and a second board lose, and of the numberings that a symmetric board allows each view gets the
one that fits.

:class:`Search` goes through the images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ValidateOptions
from colmap_inertial.validate.detect import DETECTION, detect
from colmap_inertial.validate.fit import settle
from colmap_inertial.validate.observations import Observations, Placement, linearise
from colmap_inertial.validate.targets import Target
from colmap_inertial.validate.views import Sighting, View, sight


@dataclass(frozen=True, kw_only=True)
class PlacementLimits:
    """Limits of placing a target in a model."""

    #: Images with the target after which checkerboards are no longer searched thoroughly, and images searched so.
    enough_views: int = 10
    most_thorough_views: int = 60
    #: Smallest share of the images with sightings that must agree. Two boards in view leave half of them.
    smallest_agreement: float = 0.2
    #: Pairs of sightings that a place is computed from, and rounds of refining the best.
    most_pairs: int = 80
    refinements: int = 5
    #: Two sightings give a place where their lines of sight meet at this angle.
    least_parallax_deg: float = 0.5


PLACEMENT = PlacementLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class PartPlacement:
    """One rigid part of a target, placed in the model.

    Attributes
    ----------
    placement
        Where it is; one part.
    chosen
        Indices of the sightings that agree, at most one per view, in the order of the views.
    numbering
        Row of ``Target.relabelings`` for each of them.
    """

    placement: Placement
    chosen: tuple[int, ...]
    numbering: tuple[int, ...]


def observe(
    sightings: list[Sighting], numbering: list[int], parts: list[int], target: Target, views: list[View]
) -> Observations:
    """Observations of these sightings, ordered by view.

    Parameters
    ----------
    sightings
        What was seen.
    numbering
        Row of ``Target.relabelings`` for each.
    parts
        Index to give to the part of each, from 0 without gaps.
    target, views
        What they refer to.
    """
    order = sorted(range(len(sightings)), key=lambda i: sightings[i].view)
    corner = [target.relabelings[numbering[i]][sightings[i].corner] for i in order]
    length = [len(c) for c in corner]
    all_corners = np.concatenate(corner)
    return Observations(
        view=np.repeat([sightings[i].view for i in order], length),
        corner=all_corners,
        part=np.repeat([parts[i] for i in order], length),
        target_m=target.corners_m[all_corners],
        ray=np.concatenate([sightings[i].ray for i in order]),
        px_from_tangent=np.concatenate([sightings[i].px_from_tangent for i in order]),
        cam_from_world=np.array([view.cam_from_world for view in views]),
        cam_from_world_t=np.array([view.cam_from_world_t for view in views]),
    )


def place_part(
    sightings: list[Sighting], target: Target, views: list[View], *, max_residual_px: float, seed: int = 0
) -> PartPlacement | None:
    """Find where one rigid part is.

    Parameters
    ----------
    sightings
        All of this part, several per view where the detector is not sure or the part exists twice.
    target, views
        What they refer to.
    max_residual_px
        A view agrees when at least half of its corners are this close to where they should be.
    seed
        Of the choice of pairs, when there are too many to try all.

    Returns
    -------
    The placement on which most views agree; ``None`` when no two do.

    Raises
    ------
    NotObservableError
        When all views lie in one direction from the target.
    """
    usable = [i for i, s in enumerate(sightings) if len(s.corner) >= DETECTION.least_corners]
    pairs = _choose_pairs([sightings[i] for i in usable], views, seed)
    if not pairs:
        return None
    judge = _Judge([sightings[i] for i in usable], target, views, max_residual_px)
    best: tuple[float, Placement] | None = None
    for a, b in pairs:
        for numbering in range(len(target.relabelings)):
            placement = _place_by_pair(judge.sightings[a], judge.sightings[b], numbering, target, views)
            if placement is None:
                continue
            cost = judge.cost(placement)[0].sum()
            if best is None or cost < best[0]:
                best = (cost, placement)
    if best is None:
        return None
    placement = best[1]
    for _ in range(PLACEMENT.refinements):
        chosen, numbering_of = judge.choose(placement)
        if len(chosen) < 2:
            return None
        obs = observe([judge.sightings[i] for i in chosen], numbering_of, [0] * len(chosen), target, views)
        residual = linearise(obs, placement)[0]
        obs = obs.select(np.sum(residual**2, axis=1) < max_residual_px**2)
        try:
            refined = settle(obs, placement)
        except NotObservableError:
            break
        improved = judge.cost(refined)[0].sum() < judge.cost(placement)[0].sum() - 1e-9
        if not improved:
            break
        placement = refined
    chosen, numbering_of = judge.choose(placement)
    if len(chosen) < 2:
        return None
    return PartPlacement(placement=placement, chosen=tuple(usable[i] for i in chosen), numbering=tuple(numbering_of))


def _choose_pairs(sightings: list[Sighting], views: list[View], seed: int) -> list[tuple[int, int]]:
    """Pairs of sightings whose lines of sight meet at an angle; of many, some of the larger half.

    Raises
    ------
    NotObservableError
        When all views lie in one direction from the target.
    """
    direction = np.array([_direction(sighting, views) for sighting in sightings]).reshape(-1, 3)
    view = np.array([sighting.view for sighting in sightings], dtype=np.intp)
    first, second = np.triu_indices(len(sightings), 1)
    pick = view[first] != view[second]
    first, second = first[pick], second[pick]
    if len(first) == 0:
        return []
    angle = np.arccos(np.clip(np.sum(direction[first] * direction[second], axis=1), -1.0, 1.0))
    apart = angle >= np.deg2rad(PLACEMENT.least_parallax_deg)
    if not apart.any():
        raise NotObservableError(
            "scale",
            Fact("target-along-one-line", largest_angle_rad=angle.max()),
        )
    first, second, angle = first[apart], second[apart], angle[apart]
    if len(first) > PLACEMENT.most_pairs:
        order = np.argsort(-angle, kind="stable")[: max(PLACEMENT.most_pairs, len(angle) // 2)]
        pick = np.random.default_rng(seed).choice(order, PLACEMENT.most_pairs, replace=False)
        first, second = first[pick], second[pick]
    return list(zip(first.tolist(), second.tolist(), strict=True))


def median_residual_px(sighting: Sighting, placement: Placement, target: Target, views: list[View]) -> float:
    """Median distance of a sighting's corners from where they should be, numbered as fits best."""
    rows = len(target.relabelings)
    obs = observe([sighting] * rows, list(range(rows)), [0] * rows, target, views)
    residual = np.linalg.norm(linearise(obs, placement)[0], axis=1).reshape(rows, -1)
    return float(np.median(residual, axis=1).min())


def _direction(sighting: Sighting, views: list[View]) -> Array:
    """(3,) unit direction of the middle of a sighting, in the world."""
    mean = views[sighting.view].cam_from_world.T @ sighting.ray.mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


class _Judge:
    """Says how well every sighting fits a placement, under every numbering."""

    def __init__(self, sightings: list[Sighting], target: Target, views: list[View], max_residual_px: float) -> None:
        self.sightings = sightings
        self._limit2 = max_residual_px**2
        rows = len(target.relabelings)
        many = [s for s in sightings for _ in range(rows)]
        index = np.arange(len(many))
        self._order = np.argsort([s.view for s in many], kind="stable")
        self._obs = observe(many, [i % rows for i in range(len(many))], [0] * len(many), target, views)
        length = np.array([len(s.corner) for s in many])[self._order]
        self._first = np.concatenate([[0], np.cumsum(length)[:-1]])
        self._length = length
        self._rows = rows
        self._back = np.empty(len(many), dtype=np.intp)
        self._back[self._order] = index
        self._views, self._view_of = np.unique([s.view for s in sightings], return_inverse=True)

    def _table(self, placement: Placement) -> tuple[Array, Array]:
        """Mean truncated squared residual, and share of close corners, of each sighting and numbering (S, K)."""
        square = np.sum(linearise(self._obs, placement)[0] ** 2, axis=1) / self._limit2
        cost = np.add.reduceat(np.minimum(square, 1.0), self._first) / self._length
        close = np.add.reduceat((square < 1.0).astype(float), self._first) / self._length
        return cost[self._back].reshape(-1, self._rows), close[self._back].reshape(-1, self._rows)

    def cost(self, placement: Placement) -> tuple[Array, Array]:
        """(W,) cost of each view, from 0 (perfect) to 1 (does not agree), and the views' indices."""
        cost, close = self._table(placement)
        cost = np.where(close > 0.5, cost, 1.0).min(axis=1)
        out = np.ones(len(self._views))
        np.minimum.at(out, self._view_of, cost)
        return out, self._views

    def choose(self, placement: Placement) -> tuple[list[int], list[int]]:
        """Indices of the sightings that agree, the best of each view, with their numberings."""
        cost, close = self._table(placement)
        cost = np.where(close > 0.5, cost, np.inf)
        chosen, numbering = [], []
        for v in range(len(self._views)):
            mine = np.flatnonzero(self._view_of == v)
            i, k = np.unravel_index(np.argmin(cost[mine]), (len(mine), self._rows))
            if np.isfinite(cost[mine][i, k]):
                chosen.append(int(mine[i]))
                numbering.append(int(k))
        return chosen, numbering


def _place_by_pair(a: Sighting, b: Sighting, numbering: int, target: Target, views: list[View]) -> Placement | None:
    """The placement that two views give, the second numbered in this way; ``None`` when their rays do not meet."""
    _, ia, ib = np.intersect1d(a.corner, target.relabelings[numbering][b.corner], return_indices=True)
    if len(ia) < DETECTION.least_corners:
        return None
    va, vb = views[a.view], views[b.view]
    da, db = a.ray[ia] @ va.cam_from_world, b.ray[ib] @ vb.cam_from_world
    ca, cb = -va.cam_from_world.T @ va.cam_from_world_t, -vb.cam_from_world.T @ vb.cam_from_world_t
    # midpoint of the shortest line between two rays
    dot, base = np.sum(da * db, axis=1), cb - ca
    sine2 = np.maximum(1 - dot**2, 1e-12)
    along_a = (da @ base - dot * (db @ base)) / sine2
    along_b = (dot * (da @ base) - db @ base) / sine2
    if np.mean((along_a > 0) & (along_b > 0)) < 0.9:
        return None
    points = 0.5 * (ca + along_a[:, None] * da + cb + along_b[:, None] * db)
    placement = _fit_similarity(target.corners_m[a.corner[ia]], points)
    if placement is None:
        return None
    obs = observe([a, b], [0, numbering], [0, 0], target, views)
    try:
        return settle(obs, placement, most_iterations=10)
    except NotObservableError:
        return None


def _fit_similarity(source: Array, target: Array) -> Placement | None:
    """Least-squares similarity between points (Umeyama 1991); ``None`` when they have no extent."""
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    s, t = source - mean_s, target - mean_t
    u, d, vt = np.linalg.svd(t.T @ s)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ (sign[:, None] * vt)
    spread = float(np.sum(s**2))
    scale = float(d @ sign) / spread if spread > 0 else 0.0
    if not (np.isfinite(scale) and scale > 0):
        return None
    return Placement(
        log_scale=float(np.log(scale)),
        rotation=rotation[None],
        centre=(mean_t - scale * rotation @ mean_s)[None],
    )


Progress = Callable[[int, int], None]


class Search:
    """Looks for the target in the images, and for its place in the model."""

    def __init__(self, views: list[View], target: Target, options: ValidateOptions, progress: Progress | None) -> None:
        self.views, self.target, self.options = views, target, options
        self.sightings: list[Sighting] = []
        self.searched: list[int] = []
        self.unreadable: dict[int, Fact] = {}
        self.parts: dict[int, list[Sighting]] = {}
        self.one_line: NotObservableError | None = None
        self._progress = progress

    def run(self, images: Path) -> None:
        with_target = 0
        for done, v in enumerate(_spread_evenly(len(self.views))):
            if self._progress is not None:
                self._progress(done, len(self.views))
            self.searched.append(v)
            with_target += self._search_view(v, thorough=False)
            if with_target >= self.options.max_views:
                break
        if self._progress is not None:
            self._progress(len(self.views), len(self.views))
        if len(self.unreadable) == len(self.searched):
            first = min(self.unreadable)
            raise FormatError(images / self.views[first].name, self.unreadable[first])

    def look_closer(self, which: list[int]) -> None:
        """Search these views again, thoroughly; what was found there before is forgotten."""
        self.sightings = [s for s in self.sightings if s.view not in which]
        for v in which:
            self._search_view(v, thorough=True)

    def _search_view(self, v: int, *, thorough: bool) -> bool:
        image = self.views[v].read()
        if isinstance(image, Fact):
            self.unreadable[v] = image
            return False
        sightings = [sight(v, self.views[v].camera, d) for d in detect(image, self.target, thorough=thorough)]
        sightings = [s for s in sightings if len(s.corner) >= DETECTION.least_corners]
        self.sightings += sightings
        return bool(sightings)

    def place(self) -> dict[int, PartPlacement]:
        """Pose of each part of the target; parts on which no two views agree are left out."""
        self.parts, self.one_line = {}, None
        for s in self.sightings:
            self.parts.setdefault(s.part, []).append(s)
        out = {}
        for part, sightings in sorted(self.parts.items()):
            try:
                placed = place_part(
                    sightings,
                    self.target,
                    self.views,
                    max_residual_px=self.options.max_residual_px,
                    seed=self.options.seed,
                )
            except NotObservableError as error:
                self.one_line = error
                continue
            if placed is not None:
                out[part] = placed
        return out


def _spread_evenly(count: int) -> list[int]:
    """0..count-1 in an order that covers the range evenly however early it is cut off (van der Corput)."""
    bits = max(count - 1, 1).bit_length()
    reverse = [int(f"{i:0{bits}b}"[::-1], 2) for i in range(2**bits)]
    return [i for i in reverse if i < count]
