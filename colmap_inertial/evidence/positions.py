"""Positions of a satellite receiver met with a path: where they place it, and what they say of its scale."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraTrajectory, PositionFixes
from colmap_inertial.core.types.evidence import ScaleEvidence
from colmap_inertial.inertial.georeference import Georeference, convert_to_enu, georeference, turn_upright

#: A position between two images that are farther apart than this has no place on the path.
_FARTHEST_S = 2.0
#: By images so far apart the pace before the first and after the last one is known: nearer, noise makes much of it.
_PACE_S = 0.3


def located(fixes: PositionFixes, path: CameraTrajectory) -> tuple[PositionFixes, Array, Array]:
    """The positions that belong to a path, where the camera was at each (N, 3), and when (N,) seconds."""
    if fixes.names is not None:
        place = {name: i for i, name in enumerate(path.names)}
        here = np.array([name in place for name in fixes.names], dtype=bool)
        fixes = fixes.select(here)
        at = np.array([place[name] for name in fixes.names or ()], dtype=np.intp)
        return fixes, path.cam_in_world[at], path.t_s[at]
    assert fixes.t_ns is not None
    t_s = (fixes.t_ns - path.epoch_ns) * 1e-9
    after = np.clip(np.searchsorted(path.t_s, t_s), 1, len(path.t_s) - 1)
    near = path.t_s[after] - path.t_s[after - 1] <= _FARTHEST_S
    here = near & (t_s >= path.t_s[0]) & (t_s <= path.t_s[-1])
    t_s = t_s[here]
    centres = np.stack([np.interp(t_s, path.t_s, path.cam_in_world[:, k]) for k in range(3)], axis=1)
    return fixes.select(here), centres, t_s


def georeference_path(
    fixes: PositionFixes, path: CameraTrajectory, up_in_world: Array, *, timed: bool = True
) -> Georeference:
    """Georeference a metric path; raises :class:`NotObservableError` where the positions leave it open.

    ``timed``: whether the path's times are true; without, nothing tells where the camera was a moment before.
    """
    here, centres, t_s = located(fixes, path)
    return georeference(here, centres, t_s, up_in_world, path_at=path_at(path) if timed else None)


def path_at(path: CameraTrajectory) -> Callable[[Array], Array]:
    """Positions (T, 3) of a camera at any instants (T,), linear between its images and beyond them."""

    def at(t_s: Array) -> Array:
        within = np.clip(t_s, path.t_s[0], path.t_s[-1])
        centres = np.stack([np.interp(within, path.t_s, path.cam_in_world[:, k]) for k in range(3)], axis=1)
        for end, inner in ((0, _after(path, 0)), (-1, _after(path, -1))):
            pace = (path.cam_in_world[inner] - path.cam_in_world[end]) / (path.t_s[inner] - path.t_s[end])
            beyond_s = np.maximum(t_s - within, 0) if end else np.minimum(t_s - within, 0)
            centres += beyond_s[:, None] * pace
        return centres

    return at


def _after(path: CameraTrajectory, end: int) -> int:
    """The image nearest to an end of the path that is so far from it that the two tell the pace there."""
    far = np.abs(path.t_s - path.t_s[end]) >= min(_PACE_S, path.t_s[-1] - path.t_s[0])
    return int(np.flatnonzero(far)[0 if end == 0 else -1])


@dataclass(frozen=True, eq=False, kw_only=True)
class PositionScale:
    """What positions say of a path of any unit.

    Attributes
    ----------
    evidence
        Of its scale.
    up_in_world
        (3,) against gravity in the path's world, as it was given or found.
    tilt_rad
        Standard deviation of that direction, where the positions gave it; else zero.
    """

    evidence: ScaleEvidence
    up_in_world: Array
    tilt_rad: float


def scale_by_positions(
    fixes: PositionFixes,
    path: CameraTrajectory,
    *,
    up_in_world: Array | None = None,
    log_scale: float | None = None,
    timed: bool = True,
) -> PositionScale:
    """Metres per unit of a path.

    Parameters
    ----------
    fixes
        Positions; those that do not belong to the path do not count.
    path
        In its units.
    up_in_world
        (3,) unit vector against gravity; ``None`` where it is to be found, which takes heights and a path that is wide.
    log_scale
        About what the logarithm of the scale is; ``None`` where nothing is known.
    timed
        Whether the path's times are true.

    Raises
    ------
    NotObservableError
        Where the positions are too few, or leave length or vertical open.
    """
    here, centres, _ = located(fixes, path)
    tilt_rad = 0.0
    if up_in_world is None or log_scale is None:
        if len(here.latitude_deg) < _FEWEST:
            raise NotObservableError("scale", Fact("positions-too-few", count=len(here.latitude_deg), needed=_FEWEST))
        _, enu_m, heights = convert_to_enu(here)
        if up_in_world is None:
            if not heights.any():
                raise NotObservableError("scale", Fact("positions-without-heights"))
            rough = place_roughly(enu_m[heights], centres[heights])
            up_in_world, log_scale, tilt_rad = rough.up_in_world, math.log(rough.scale), rough.tilt_rad
        else:
            log_scale = math.log(_level_scale(enu_m, centres @ turn_upright(up_in_world).T))
    metric = replace(path, cam_in_world=math.exp(log_scale) * path.cam_in_world)
    found = georeference_path(fixes, metric, up_in_world, timed=timed)
    span_s = (float(path.t_s[0]), float(path.t_s[-1])) if timed else None
    evidence = evidence_of_positions(found, log_scale, tilt_rad=tilt_rad, span_s=span_s)
    return PositionScale(evidence=evidence, up_in_world=up_in_world, tilt_rad=tilt_rad)


#: Positions that place a path of unknown unit.
_FEWEST = 6


def _level_scale(enu_m: Array, level: Array) -> float:
    """About how many metres a unit has: plane positions against the path seen from above."""
    to, of = (points[:, 0] + 1j * points[:, 1] for points in (enu_m, level))
    to, of = to - np.median(to.real) - 1j * np.median(to.imag), of - of.mean()
    square = float(np.sum(np.abs(of) ** 2))
    along = float(np.abs(np.sum(np.conj(of) * to)))
    if not (square > 0 and along > 0):
        raise NotObservableError("scale", Fact("positions-stand-still"))
    return along / square


def evidence_of_positions(
    found: Georeference, log_scale: float, *, tilt_rad: float = 0.0, span_s: tuple[float, float] | None = None
) -> ScaleEvidence:
    """Satellite positions as evidence: lengths by them over lengths of a path.

    Parameters
    ----------
    found
        Of a path.
    log_scale
        Logarithm of that path's metres per unit of the model in question.
    tilt_rad
        Standard deviation of the path's vertical: seen from above, a tilted path is shorter.
    span_s
        When it holds.

    Raises
    ------
    NotObservableError
        Where the positions leave the length open.
    """
    ratio, sigma = found.length_ratio, found.length_ratio_sigma
    if not (ratio > 0 and sigma < ratio):
        raise NotObservableError("scale", Fact("positions-say-no-length", ratio=ratio, sigma=sigma))
    return ScaleEvidence(
        sensor="positions",
        log_scale=log_scale + math.log(ratio),
        # a tilt by t makes lengths shorter by t^2 / 2; 95 % of these squares are below 3.84 times their mean
        random_sigma=math.hypot(sigma / ratio, tilt_rad**2),
        begin_s=None if span_s is None else span_s[0],
        end_s=None if span_s is None else span_s[1],
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class RoughPlace:
    """A path of any unit and attitude, brought to positions by least squares.

    Attributes
    ----------
    scale
        Metres per unit.
    up_in_world
        (3,) against gravity in the path's world.
    tilt_rad
        Standard deviation of that direction.
    """

    scale: float
    up_in_world: Array
    tilt_rad: float


#: Positions farther off than so many times the median do not count, in so many rounds.
_OUTLIER, _ROUNDS = 4.0, 5
#: A vertical less certain than this is none (rad).
_LEAST_SURE_TILT = 0.2


def place_roughly(enu_m: Array, centres: Array, *, alike: float = 10.0) -> RoughPlace:
    """Bring a path of unknown unit and attitude to positions.

    Parameters
    ----------
    enu_m
        (N, 3) east, north and up of positions.
    centres
        (N, 3) the camera's centre at each.
    alike
        So many neighbouring positions err alike: they count as one.

    Raises
    ------
    NotObservableError
        Where the path is straight, or positions leave open which way is up.
    """
    kept = np.ones(len(enu_m), dtype=bool)
    for _ in range(_ROUNDS):
        to, of = enu_m[kept], centres[kept]
        middle_to, middle_of = to.mean(axis=0), of.mean(axis=0)
        u, sizes, vt = np.linalg.svd((to - middle_to).T @ (of - middle_of))
        turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
        spread = float(np.sum((of - middle_of) ** 2))
        if not (spread > 0 and sizes[0] > 0):
            raise NotObservableError("scale", Fact("positions-stand-still"))
        scale = float(np.sum((to - middle_to) * ((of - middle_of) @ turn.T))) / spread
        off = np.linalg.norm(enu_m - middle_to - scale * (centres - middle_of) @ turn.T, axis=1)
        now = off <= _OUTLIER * max(float(np.median(off)), 1e-9)
        if (now == kept).all() or now.sum() < 4:
            break
        kept = now
    # the vertical turns about the long axis of the path, as far as its second one is wide against the errors
    across = float(np.sqrt(np.linalg.eigvalsh((of - middle_of).T @ (of - middle_of) / len(of))[1])) * max(scale, 0.0)
    error_m = float(np.sqrt(np.mean(off[kept] ** 2) / 3))
    count = max(1.0, kept.sum() / alike)
    tilt_rad = error_m / (across * math.sqrt(count)) if across > 0 else math.inf
    if not (scale > 0 and tilt_rad < _LEAST_SURE_TILT):
        raise NotObservableError("scale", Fact("positions-leave-up-open", across_m=across, error_m=error_m))
    return RoughPlace(scale=scale, up_in_world=turn.T @ np.array([0.0, 0.0, 1.0]), tilt_rad=tilt_rad)
