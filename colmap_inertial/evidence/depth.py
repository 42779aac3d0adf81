"""Scale of a path from depth maps along it: each is registered to later ones that see the same surfaces."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_conjugate, quat_log, quat_multiply
from colmap_inertial.core.progress import Progress, silent
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.core.types.depth import DepthMaps
from colmap_inertial.core.types.evidence import ScaleEvidence, ScalePart
from colmap_inertial.evidence._surface import Surface, fit_surface
from colmap_inertial.evidence.depth_pairs import register_pair, relative_pose
from colmap_inertial.evidence.priors import DEPTH_SCALE, DEVICE_FUSION, PRIORS
from colmap_inertial.inertial.scale.verdict import student_factor

#: A view by its number.
_Surfaces = Callable[[int], Surface]


@dataclass(frozen=True, kw_only=True)
class DepthLimits:
    """Which views are compared, and how few are too few."""

    #: Views along the path that are compared with each other.
    views: int = 100
    #: Distance of both by the depth that the first shows, and the largest turn between them.
    apart: tuple[float, ...] = (0.1, 0.2, 0.3)
    most_turn_rad: float = 0.6
    #: Pairs that say less than this (standard deviation) by themselves say nothing: walls that slide along themselves.
    least_sure: float = 0.15
    #: Partners that were chosen by a scale this near to the one they give are the right ones.
    near: float = 0.1
    fewest: int = 6
    #: The path is cut into so many blocks, which are taken as independent.
    blocks: int = 6
    #: Overlapping views of the same surfaces agree better than they are right.
    pair_sigma: float = 0.01
    #: The coarse search for a path of unknown unit: steps of the logarithm, and to either side.
    search_step: float = 0.1
    search_span: float = 7.0
    search_pairs: int = 8


_LIMITS = DepthLimits()
#: Values beyond so many standard deviations do not count; of normal ones 95 % of the information remains.
_TUKEY = 4.685
#: Half of a normal distribution lies within so many standard deviations.
_HALF_NORMAL = 0.6745


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthScale:
    """Scale of a path by depth maps, pair by pair, or of a model, image by image.

    Attributes
    ----------
    t_s
        (P,) middle of each pair, or of each image, of the trajectory's clock.
    log_scale, sigma
        (P,) logarithm of metres per unit, and its standard deviation by the registration, or by the image's points.
    is_fused
        As of :class:`DepthMaps`.
    """

    t_s: Array
    log_scale: Array
    sigma: Array
    is_fused: bool

    def between(self, begin_s: float, end_s: float) -> ScalePart | None:
        """The scale of a part; ``None`` where too few pairs lie in it."""
        inside = (self.t_s >= begin_s) & (self.t_s <= end_s)
        if inside.sum() < _LIMITS.fewest:
            return None
        mean, sigma = combine_blocks(self.t_s[inside], self.log_scale[inside], self.sigma[inside])
        return ScalePart(begin_s=begin_s, end_s=end_s, log_scale=mean, sigma=sigma)

    def evidence(self, parts: tuple[tuple[float, float], ...] = ()) -> ScaleEvidence:
        """What the maps say of the whole path, and of parts."""
        mean, sigma = combine_blocks(self.t_s, self.log_scale, self.sigma)
        own = {DEPTH_SCALE: PRIORS.depth_scale}
        if self.is_fused:
            own[DEVICE_FUSION] = PRIORS.device_fusion
        by_part = [self.between(*part) for part in parts]
        return ScaleEvidence(
            sensor="depth",
            log_scale=mean,
            random_sigma=sigma,
            systematic=own,
            begin_s=float(self.t_s[0]),
            end_s=float(self.t_s[-1]),
            parts=tuple(part for part in by_part if part is not None),
        )


def scale_by_depth(
    maps: DepthMaps,
    trajectory: CameraTrajectory,
    *,
    log_scale: float | None = 0.0,
    limits: DepthLimits = _LIMITS,
    progress: Progress = silent,
) -> DepthScale:
    """Metres per unit of a path, from depth maps at its poses.

    Parameters
    ----------
    maps
        Joined with the poses by their names.
    trajectory
        The path.
    log_scale
        About what it is; ``None`` where nothing is known: it is searched.

    Raises
    ------
    NotObservableError
        Where too few views show the same surfaces from different places.
    """
    place = {name: i for i, name in enumerate(trajectory.names)}
    names = [name for name in maps.names if name in place]
    if len(names) < 2:
        raise NotObservableError("scale", Fact("depth-without-poses", maps=len(maps), poses=len(trajectory)))
    names = [names[k] for k in np.unique(np.linspace(0, len(names) - 1, limits.views).round().astype(np.intp))]
    at = np.array([place[name] for name in names])
    surfaces: dict[int, Surface] = {}

    def surface(k: int) -> Surface:
        if k not in surfaces:
            surfaces[k] = fit_surface(maps.read(names[k]))
        return surfaces[k]

    poses, centres = trajectory.cam_from_world_xyzw[at], trajectory.cam_in_world[at]
    t_s = trajectory.t_s[at]
    start = _search(surface, poses, centres, limits) if log_scale is None else log_scale
    for _ in range(_ROUNDS):
        rows = _pairs(surface, (poses, centres, t_s), start, limits, progress)
        if len(rows) < limits.fewest:
            raise NotObservableError("scale", Fact("depth-pairs-too-few", count=len(rows), needed=limits.fewest))
        table = np.array(sorted(rows))
        found = DepthScale(t_s=table[:, 0], log_scale=table[:, 1], sigma=table[:, 2], is_fused=maps.is_fused)
        mean, _ = combine_blocks(found.t_s, found.log_scale, found.sigma)
        # views that are too near or too far by a start that was off
        if abs(mean - start) < limits.near:
            break
        start = mean
    return found


#: So often are partners chosen anew.
_ROUNDS = 3


def _pairs(
    surface: _Surfaces, path: tuple[Array, Array, Array], log_scale: float, limits: DepthLimits, progress: Progress
) -> list[tuple[float, float, float]]:
    """Time, logarithm of the scale and standard deviation of all pairs that tell."""
    poses, centres, t_s = path
    rows = []
    for first in range(len(poses)):
        of = surface(first)
        if of.smooth.any():
            reach = float(np.median(1 / of.inverse[of.smooth])) * math.exp(-log_scale)
            for other in _partners(poses, centres, first, reach, limits):
                pair = _both_ways(surface, poses, centres, (first, other), log_scale)
                if pair is not None and pair[1] < limits.least_sure:
                    rows.append((0.5 * float(t_s[first] + t_s[other]), *pair))
        progress("depth", first + 1, len(poses))
    return rows


def _partners(poses: Array, centres: Array, first: int, reach: float, limits: DepthLimits) -> list[int]:
    """Later views of about the wanted distances that look the same way."""
    later = np.arange(first + 1, len(poses))
    if len(later) == 0:
        return []
    apart = np.linalg.norm(centres[later] - centres[first], axis=1) / reach
    turn = np.linalg.norm(quat_log(quat_multiply(poses[later], quat_conjugate(poses[[first]]))), axis=1)
    found = []
    for wanted in limits.apart:
        fits = np.flatnonzero((apart > 0.8 * wanted) & (apart < 1.6 * wanted) & (turn < limits.most_turn_rad))
        if len(fits):
            found.append(int(later[fits[0]]))
    return list(dict.fromkeys(found))


def _both_ways(
    surface: _Surfaces, poses: Array, centres: Array, pair: tuple[int, int], log_scale: float
) -> tuple[float, float] | None:
    """Logarithm of the scale by a pair, the mean of both directions, and its standard deviation."""
    first, other = pair
    both = [
        register_pair(surface(a), surface(b), relative_pose(poses, centres, a, b), log_scale)
        for a, b in ((first, other), (other, first))
    ]
    found = [one for one in both if one is not None]
    if len(found) < 2:
        return None
    apart = abs(found[0].log_scale - found[1].log_scale)
    sigma = math.sqrt(0.5 * (found[0].sigma ** 2 + found[1].sigma ** 2))
    return 0.5 * (found[0].log_scale + found[1].log_scale), math.hypot(sigma, 0.5 * apart)


def combine_blocks(t_s: Array, log_scale: Array, sigma: Array, limits: DepthLimits = _LIMITS) -> tuple[float, float]:
    """Mean of pairs, and its standard deviation by blocks of time.

    Pairs weigh by their own standard deviation and by how far all scatter; outliers count less. Neighbouring pairs see
    the same surfaces with the same errors, so that blocks of them, not pairs, are left out in turn (jackknife).

    Parameters
    ----------
    t_s, log_scale, sigma
        (P,) of each pair, or of each image.
    """
    order = np.argsort(t_s, kind="stable")
    values, sigmas = log_scale[order], np.hypot(sigma[order], limits.pair_sigma)
    whole = robust_mean(values, sigmas)
    count = min(limits.blocks, len(values) // 2)
    if count < 2:
        return whole, float(np.max(sigmas))
    number = np.arange(len(values)) * count // len(values)
    without = np.array([robust_mean(values[number != k], sigmas[number != k]) for k in range(count)])
    by_blocks = math.sqrt((count - 1) / count * float(np.sum((without - without.mean()) ** 2)))
    least = float(1 / np.sqrt(np.sum(1 / sigmas**2)))
    return whole, max(by_blocks, least) * student_factor(count - 1)


def robust_mean(values: Array, sigmas: Array) -> float:
    """Mean with Tukey's weights; all have a scatter beyond their own standard deviations, found along the way."""
    mean, beyond = float(np.median(values)), 0.0
    for _ in range(50):
        apart = np.abs(values - mean)
        spread = np.hypot(sigmas, beyond)
        z = apart / spread
        robust = np.maximum(1 - (z / _TUKEY) ** 2, 0.0) ** 2
        weight = robust / spread**2
        new = float(weight @ values / weight.sum())
        # the scatter at which half of the values lie within half of a normal distribution
        square = float(np.median(apart**2 / _HALF_NORMAL**2 - sigmas**2))
        wider = math.sqrt(max(square, 0.0))
        if abs(new - mean) + abs(wider - beyond) < 1e-7:
            break
        mean, beyond = new, 0.5 * (beyond + wider)
    return new


def _search(surface: _Surfaces, poses: Array, centres: Array, limits: DepthLimits) -> float:
    """About what the scale of a path of unknown unit is: where depth of views agrees best, over a wide grid."""
    from colmap_inertial.evidence.depth_pairs import disagreement

    # the unit of the grid: depth against the length of steps
    count = len(poses)
    middle = [k for k in np.linspace(0, count - 1, 9).round().astype(int).tolist() if surface(k).smooth.any()]
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    if not middle or not (steps > 0).any():
        raise NotObservableError("scale", Fact("depth-pairs-too-few", count=0, needed=limits.fewest))
    depth_m = float(np.median([np.median(1 / surface(k).inverse[surface(k).smooth]) for k in middle]))
    origin = math.log(0.2 * depth_m / (float(np.mean(steps)) * count / limits.search_pairs))
    grid = origin + np.arange(-limits.search_span, limits.search_span, limits.search_step)
    firsts = np.unique(np.linspace(0, count - 2, limits.search_pairs).astype(np.intp)).tolist()
    cost = np.zeros(len(grid))
    for first in firsts:
        for gap in (1, 2, 4, 8):
            if first + gap < count:
                pair = relative_pose(poses, centres, first, first + gap)
                cost += disagreement(surface(first), surface(first + gap), pair, grid)
    return float(grid[int(np.argmin(cost))])
