"""Measures a target of known size in a COLMAP model: the check that a reconstruction has the right size."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.errors import NotObservableError, TargetNotFoundError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ValidateOptions
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.io.files import StrPath
from colmap_inertial.model import read_model
from colmap_inertial.validate.detect import DETECTION
from colmap_inertial.validate.failures import (
    explain_failure,
    require_no_larger_board,
    require_no_likelier_board,
)
from colmap_inertial.validate.fit import FIT, ScaleFit, fit_scale
from colmap_inertial.validate.observations import Observations, Placement, triangulate
from colmap_inertial.validate.place import (
    PLACEMENT,
    PartPlacement,
    Progress,
    Search,
    median_residual_px,
    observe,
)
from colmap_inertial.validate.result import (
    Corner,
    Distance,
    DistanceSet,
    RejectedView,
    SetScale,
    Validation,
    ViewResiduals,
    check_lengths,
    model_diagonal,
)
from colmap_inertial.validate.targets import Target
from colmap_inertial.validate.views import Sighting, load_views

if TYPE_CHECKING:
    import pycolmap


@one_blas_thread()
def validate_model(
    model: StrPath | pycolmap.Reconstruction,
    images: StrPath,
    target: Target,
    options: ValidateOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Validation:
    """Find a target in a model's images, triangulate it with the model's own cameras, and compare sizes.

    Parameters
    ----------
    model
        Folder of a COLMAP model, or one in memory.
    images
        Folder that the images' names are relative to. Where keypoints were rectified for the rolling shutter, the
        rectified images.
    target
        What to look for (:func:`~colmap_inertial.validate.targets.parse_target`).
    options
        See :class:`ValidateOptions`.
    progress
        Called with the number of images searched and to search.

    Returns
    -------
    The scale with a 95 % interval (noise model and method: :mod:`~colmap_inertial.validate.fit`) and all
    residuals.
    The interval covers detection noise and errors of the model's poses that differ from view to view; it cannot cover
    an error of the target itself, or a bend of the model that all views share.

    Raises
    ------
    FormatError
        When model or images cannot be read, do not belong together, or the images are mirrored.
    TargetNotFoundError
        When the target is in no image, or no two images agree on where it is.
    NotObservableError
        When it is in one image only, or all views of it lie along one line.
    """
    images = Path(images)
    model = Path(model) if isinstance(model, str | os.PathLike) else model
    options = ValidateOptions() if options is None else options
    views, missing = load_views(model, images)
    search = Search(views, target, options, progress)
    search.run(images)
    placed = search.place()
    require_no_larger_board(search)
    count = sum(len(p.chosen) for p in placed.values())
    if count < min(PLACEMENT.enough_views, 0.5 * len(search.searched)):
        require_no_likelier_board(search, count)
    if count < PLACEMENT.enough_views and target.kind == "checkerboard":
        seen = {s.view for s in search.sightings}
        search.look_closer([v for v in search.searched if v not in seen][: PLACEMENT.most_thorough_views])
        placed = search.place()
    if not placed:
        raise explain_failure(search, images)
    used = {search.parts[p][i].view for p, part in placed.items() for i in part.chosen}
    outside = [v for v in sorted({s.view for s in search.sightings}) if v not in used]
    if outside and target.kind == "checkerboard":  # perhaps the detector took another board there
        search.look_closer(outside)
        placed = search.place()
    _require_agreement(search, placed)
    return _measure(search, placed, missing, _measure_diagonal(model))


def _require_agreement(search: Search, placed: dict[int, PartPlacement]) -> None:
    """Refuse a place on which a few of many sightings agree: chance does that, a wrong board size above all.

    Raises
    ------
    TargetNotFoundError
    """
    used = {search.parts[p][i].view for p, part in placed.items() for i in part.chosen}
    seen = {s.view for s in search.sightings}
    if len(used) < PLACEMENT.smallest_agreement * len(seen):
        raise TargetNotFoundError(
            Fact("target-seldom-agrees", spec=search.target.spec, found=len(seen), agreeing=len(used))
        )


def _reject_outliers(search: Search, placed: dict[int, PartPlacement]) -> tuple[dict[int, PartPlacement], list[Fact]]:
    """Single markers whose size differs from the others' by more than 5 % are not what the description says."""
    logs = {p: part.placement.log_scale for p, part in placed.items()}
    order = sorted(logs, key=lambda p: logs[p])
    running = np.cumsum([len(placed[p].chosen) for p in order])
    middle = logs[order[int(np.searchsorted(running, 0.5 * running[-1]))]]
    outlying = [p for p in placed if abs(logs[p] - middle) > FIT.outlying_marker_log]
    reasons = [
        Fact("marker-of-other-size", part=search.target.part_name(p), difference=float(np.exp(logs[p] - middle) - 1))
        for p in outlying
    ]
    return {p: part for p, part in placed.items() if p not in outlying}, reasons


def _measure_diagonal(model: Path | pycolmap.Reconstruction) -> float | None:
    reconstruction = read_model(model) if isinstance(model, Path) else model
    return model_diagonal(np.array([point.xyz for point in reconstruction.points3D.values()]).reshape(-1, 3))


def _measure(
    search: Search, placed: dict[int, PartPlacement], missing: dict[str, Fact], diagonal: float | None
) -> Validation:
    """The size of a target that was placed; ``missing``: why images of the model are not there, by name."""
    target, options = search.target, search.options
    placed, reasons = _reject_outliers(search, placed)
    sightings = [
        (search.parts[part][i], numbering, index)
        for index, part in enumerate(sorted(placed))
        for i, numbering in zip(placed[part].chosen, placed[part].numbering, strict=True)
    ]
    everything, start = _observe_parts(search, placed, sightings)
    obs, fit, dropped = fit_without_outliers(everything, start)
    of_target = 0.0 if target.sigma_m is None else Z95 * target.sigma_m / target.length_m
    log_scale, half = fit.placement.log_scale, _widen(_require_narrow(obs, fit), of_target)
    seen = np.zeros(len(target.part), dtype=bool)
    seen[obs.corner] = True
    control_corner = target.control(seen)
    sets = [_fit_set(obs, fit, pick[obs.corner]) for pick in (control_corner, ~control_corner)]
    control, check = (_make_set_scale(markers, of_target) for markers in sets)
    check_error, check_ci = _compare_sets(*sets)
    if check_error is None:
        reasons.append(Fact("target-without-check-set"))
    to_metres = 1.0
    if options.unscaled:
        to_metres = float(np.exp(-log_scale)) if control is None else control.metres_per_unit
    view_results = _collect_views(search, sightings, obs, fit, everything)
    position = _triangulate_corners(target, obs, fit)
    distances = _measure_distances(target, position, control_corner, to_metres)
    measured = np.flatnonzero(np.isfinite(position[:, 0])).tolist()
    origin = search.views[0].origin_in_model
    corners = tuple(Corner(name=target.label(i), in_model=position[i] + origin) for i in measured)
    return Validation(
        target=target,
        unscaled=options.unscaled,
        tolerance_pct=options.tolerance_pct,
        scale_error_pct=None if options.unscaled else _percent_of_log(log_scale),
        ci95_pct=None if options.unscaled else (_percent_of_log(log_scale - half), _percent_of_log(log_scale + half)),
        metres_per_unit=float(np.exp(-log_scale)),
        metres_per_unit_ci95=(float(np.exp(-log_scale - half)), float(np.exp(-log_scale + half))),
        views_used=len(view_results),
        views_searched=len(search.searched),
        corners_used=len(obs),
        corners_rejected=sum(len(v.rejected_px) for v in view_results),
        rms_px=_rms(fit.residual_px),
        corner_noise_px=fit.noise.corner_px,
        pose_noise_px=_rms(fit.residual_px - fit.corner_residual_px),
        distances=distances,
        corners=corners,
        views=view_results,
        views_rejected=_collect_rejected(search, placed, obs, dropped, missing),
        control=control,
        check=check,
        check_error_pct=check_error,
        check_ci95_pct=check_ci,
        reasons=tuple(reasons + _list_remarks(search, obs, fit, view_results)),
        lengths=check_lengths(distances, corners, diagonal, to_metres),
    )


def _require_narrow(obs: Observations, fit: ScaleFit) -> float:
    """Half the 95 % interval of the scale's logarithm, where that is narrow enough for a result.

    Raises
    ------
    NotObservableError
    """
    half = fit.half_width_log()
    if not half < np.log(FIT.widest_factor):
        raise NotObservableError(
            "scale",
            Fact("target-views-too-close", views=len(np.unique(obs.view))),
            sigma=min(fit.sigma_log, 9.99),
        )
    return half


def _widen(half: float, of_target: float) -> float:
    """The half width with that of the target's own length in it."""
    return float(np.hypot(half, of_target)) if of_target else half


def _observe_parts(
    search: Search, placed: dict[int, PartPlacement], sightings: list[tuple[Sighting, int, int]]
) -> tuple[Observations, Placement]:
    """The observations of all parts, and where the fit of their common scale starts."""
    seen, numbering, parts = (list(column) for column in zip(*sightings, strict=True))
    at = [placed[part].placement for part in sorted(placed)]
    start = Placement(
        log_scale=float(np.median([placement.log_scale for placement in at])),
        rotation=np.concatenate([placement.rotation for placement in at]),
        centre=np.concatenate([placement.centre for placement in at]),
    )
    return observe(seen, numbering, parts, search.target, search.views), start


def _compare_sets(
    control: tuple[ScaleFit, int] | None, check: tuple[ScaleFit, int] | None
) -> tuple[float | None, tuple[float, float] | None]:
    """Scale error of the check corners after scaling by the control corners, per cent, and its 95 % interval."""
    if control is None or check is None:
        return None, None
    difference = check[0].placement.log_scale - control[0].placement.log_scale
    # the two share the poses' errors, which this counts twice
    both = float(np.hypot(check[0].half_width_log(), control[0].half_width_log()))
    return _percent_of_log(difference), (_percent_of_log(difference - both), _percent_of_log(difference + both))


def _percent_of_log(log: float) -> float:
    return 100 * float(np.expm1(log))


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def fit_without_outliers(obs: Observations, start: Placement) -> tuple[Observations, ScaleFit, dict[int, Fact]]:
    """Fit, leave out views and corners that do not belong, and fit again until none is left."""
    dropped: dict[int, Fact] = {}
    while True:
        fit = fit_scale(obs, start)
        start = fit.placement
        keep = np.ones(len(obs), dtype=bool)
        noise = np.abs(fit.corner_residual_px)
        typical = 1.4826 * float(np.median(noise))
        rms = {}
        for v in np.unique(obs.view):
            mine = obs.view == v
            rms[int(v)] = _rms(fit.residual_px[mine])
            sigma = max(typical, 1.4826 * float(np.median(noise[mine])), 1e-6)
            keep[mine] = np.linalg.norm(fit.corner_residual_px[mine], axis=1) < FIT.outlier_sigma * sigma
            if keep[mine].sum() < DETECTION.least_corners:
                keep[mine] = False
                dropped[int(v)] = Fact("view-corners-disagree")
        if keep.all():  # corners first: a few wrong ones can make a good view look bad
            limit = FIT.outlier_view_ratio * float(np.median(list(rms.values())))
            for v, value in rms.items():
                if value > limit and len(rms) > 2:
                    keep[obs.view == v] = False
                    dropped[v] = Fact("view-corners-far-off")
        if keep.all():
            return obs, fit, dropped
        obs = obs.select(keep)
        if len(np.unique(obs.view)) < 2:
            raise TargetNotFoundError(Fact("views-disagree"))
        obs, start = _compact(obs, start)


def _compact(obs: Observations, at: Placement) -> tuple[Observations, Placement]:
    """Renumber the parts that are left from 0 without gaps."""
    parts, part = np.unique(obs.part, return_inverse=True)
    if len(parts) == len(at.rotation):
        return obs, at
    return replace(obs, part=part), replace(at, rotation=at.rotation[parts], centre=at.centre[parts])


def _fit_set(obs: Observations, fit: ScaleFit, pick: BoolArray) -> tuple[ScaleFit, int] | None:
    """The scale from some of the corners, weighed as all of them were; ``None`` when they cannot give one."""
    part, start = _compact(obs.select(pick), fit.placement)
    views, count = np.unique(part.view, return_counts=True)
    good = np.isin(part.view, views[count >= 2])
    part, start = _compact(part.select(good), start)
    if len(np.unique(part.view)) < 2 or len(np.unique(part.corner)) < 2:
        return None
    try:
        out = fit_scale(part, start, noise=fit.noise)
    except NotObservableError:
        return None
    return (out, len(part)) if out.half_width_log() < np.log(FIT.widest_factor) else None


def _make_set_scale(of: tuple[ScaleFit, int] | None, of_target: float) -> SetScale | None:
    if of is None:
        return None
    fit, corners = of
    log, half = fit.placement.log_scale, _widen(fit.half_width_log(), of_target)
    return SetScale(
        metres_per_unit=float(np.exp(-log)),
        ci95=(float(np.exp(-log - half)), float(np.exp(-log + half))),
        corners=corners,
    )


def _triangulate_corners(target: Target, obs: Observations, fit: ScaleFit) -> Array:
    """(N, 3) each corner triangulated on its own; not a number where its views do not determine it."""
    corner, in_world, determined = triangulate(obs, fit.placement)
    position = np.full((len(target.part), 3), np.nan)
    position[corner[determined]] = in_world[determined]
    return position


def _measure_distances(target: Target, position: Array, control: BoolArray, to_metres: float) -> tuple[Distance, ...]:
    out = []
    for a, b in target.pairs(np.isfinite(position[:, 0])).tolist():
        stated_m = float(np.linalg.norm(target.corners_m[a] - target.corners_m[b]))
        measured = float(np.linalg.norm(position[a] - position[b]))
        belongs: DistanceSet = "mixed"
        if control[a] == control[b]:
            belongs = "control" if control[a] else "check"
        out.append(
            Distance(
                pair=(target.label(a), target.label(b)),
                known_m=stated_m,
                measured=measured,
                residual_m=measured * to_metres - stated_m,
                set=belongs,
            )
        )
    return tuple(out)


def _collect_views(
    search: Search,
    sightings: list[tuple[Sighting, int, int]],
    obs: Observations,
    fit: ScaleFit,
    everything: Observations,
) -> tuple[ViewResiduals, ...]:
    """Residuals of each view that was used, with the pixel coordinates of its corners."""
    out = []
    for v in np.unique(obs.view):
        mine = obs.view == v
        residual = fit.residual_px[mine]
        seen: dict[int, Array] = {}
        for s, numbering, _ in sightings:
            if s.view == v:
                seen.update(zip(search.target.relabelings[numbering][s.corner].tolist(), s.xy_px, strict=True))
        observed = np.array([seen[c] for c in obs.corner[mine].tolist()])
        unused = [seen[c] for c in everything.corner[everything.view == v].tolist() if c not in obs.corner[mine]]
        out.append(
            ViewResiduals(
                name=search.views[int(v)].name,
                corner=obs.corner[mine],
                observed_px=observed,
                projected_px=observed - residual,
                rejected_px=np.array(unused).reshape(-1, 2),
                rms_px=_rms(residual),
            )
        )
    return tuple(out)


def _collect_rejected(
    search: Search,
    placed: dict[int, PartPlacement],
    obs: Observations,
    dropped: dict[int, Fact],
    missing: dict[str, Fact],
) -> tuple[RejectedView, ...]:
    used = set(obs.view.tolist())
    reason = dict(missing)
    residual_px: dict[str, float | None] = {}
    for v in search.searched:
        if v in used:
            continue
        name = search.views[v].name
        mine = [s for s in search.sightings if s.view == v]
        if v in search.unreadable:
            reason[name] = search.unreadable[v]
        elif v in dropped:
            reason[name] = dropped[v]
        elif not mine:
            reason[name] = Fact("view-target-not-found")
        else:
            off = [
                median_residual_px(s, placed[s.part].placement, search.target, search.views)
                for s in mine
                if s.part in placed
            ]
            reason[name] = Fact("view-disagrees" if off else "view-markers-unconfirmed")
            residual_px[name] = min(off, default=None)
    return tuple(
        RejectedView(name=name, reason=reason[name], residual_px=residual_px.get(name)) for name in sorted(reason)
    )


def _list_remarks(search: Search, obs: Observations, fit: ScaleFit, views: tuple[ViewResiduals, ...]) -> list[Fact]:
    out = []
    if len(views) < 5:
        out.append(Fact("target-in-few-views", views=len(views)))
    copies = Counter((s.view, s.part) for s in search.sightings)
    several = len({view for (view, _), count in copies.items() if count > 1})
    if several:
        out.append(Fact("several-targets", images=several))
    if fit.noise.pose_ratio.any():
        shared = _rms(fit.residual_px - fit.corner_residual_px)
        out.append(Fact("target-moved-by-poses", shift_px=shared))
    sigma_m, length_m = search.target.sigma_m, search.target.length_m
    if sigma_m is None:
        out.append(Fact("target-sigma-unknown"))
    else:
        out.append(Fact("target-sigma-included", sigma_share=sigma_m / length_m))
    if len(search.searched) < len(search.views):
        out.append(Fact("images-not-searched", images=len(search.views) - len(search.searched)))
    return out
