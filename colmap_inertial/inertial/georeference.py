"""Heading and place of a metric model on Earth, from positions of a satellite receiver; never the scale.

A path in metres with gravity along an axis fits to positions by four numbers: a turn about the vertical and a shift.
Errors of such positions are white in part, and in part alike over minutes; how much of each is not known beforehand.
Both are taken from the recording: every pair of sizes and every length of time on a grid counts with its restricted
likelihood (H. D. Patterson and R. Thompson, "Recovery of inter-block information when block sizes are unequal",
Biometrika 1971) times a prior, and the result is the mean over all of them. So a short path does not pass for sure
because its errors all point one way.

A receiver's positions lag. By how much is one more number that the mean is taken over, with a prior: where the path
turns or changes its pace it is found; on a straight walk its prior is part of the place's uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, ComplexArray, check_array
from colmap_inertial.core.earth import ecef_from_enu, ecef_of_geodetic, geodetic_of_ecef
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact, read_facts, with_sentences
from colmap_inertial.core.geometry import matrix_from_quat, rotation_between
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import HeightDatum, PositionFixes


@dataclass(frozen=True, kw_only=True)
class GeoreferenceLimits:
    """Limits of the fit to a receiver's positions."""

    #: Sizes of the errors on the grid (standard deviation of each horizontal coordinate), and how long they are alike.
    white_m: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0)
    slow_m: tuple[float, ...] = (0.02, 0.1, 0.25, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0)
    #: In steps of 10^(1/4): with steps of 10^(1/2), the mean over them gives errors alike over 5 s half-widths of up to
    #: 3.5 times the rms in place of 2.9 (scripts/studies/georeference.py).
    alike_s: tuple[float, ...] = (1.0, 1.8, 3.2, 5.6, 10.0, 18.0, 32.0, 56.0, 100.0, 180.0, 320.0, 560.0, 1000.0)
    #: Prior of the slow errors: log-normal about what the receiver states, by this factor. A wider one makes intervals
    #: too wide for errors alike over 5 to 60 s, as their short pieces look like pieces of larger and slower ones. Where
    #: nothing is stated: about this size (m), by this factor; by 1.4, intervals hold in .63 for errors of 6 m
    #: (python -m scripts.studies.georeference --unstated).
    slow_factor: float = 1.4
    unstated_slow: tuple[float, float] = (3.0, 2.5)
    #: The positions show over how long errors are alike where this much of the probability is within this factor of the
    #: most probable value.
    shown: float = 0.9
    shown_within: float = 3.3
    #: Prior of the delay of positions: flight controllers assume .11 to .22 s (ArduPilot's u-blox driver, PX4's
    #: EKF2_GPS_DELAY); a GoPro has .49 s (Race Technology); phones, which smooth, up to a second.
    usual_delay_s: float = 0.3
    delay_sigma_s: float = 0.3
    #: Delays tried first, in standard deviations of the prior; then about the best, in its own standard deviations.
    delay_span: tuple[float, float] = (-3.0, 5.0)
    delays: int = 33
    closer: float = 5.0
    closer_delays: int = 17
    vertical: float = 1.5  #: How much larger errors of heights are.
    most: int = 240  #: More positions are thinned out evenly: their errors are alike anyway.
    #: Positions farther off than so many times the usual distance, and than so many metres, are left out.
    outlier_m: float = 3.0
    outlier: float = 5.0
    rounds: int = 4
    #: A heading less certain than this says nothing.
    least_certain_deg: float = 30.0
    #: Lengths of path and positions differ where their ratio is off by so many standard deviations, and by so much.
    ratio_sigmas: float = 3.0
    least_ratio: float = 0.03
    #: By so much, and the positions are of another path, or stood still.
    largest_ratio: float = 0.5
    fewest: int = 4


_LIMITS = GeoreferenceLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Georeference:
    """Pose of a metric model on Earth.

    East, north and up count from a point at ``latitude_deg``, ``longitude_deg``, ``height_m`` in its tangential plane:
    ``enu = enu_from_world (3, 3) @ world + shift_m``.

    Attributes
    ----------
    latitude_deg, longitude_deg, height_m
        The point that east, north and up count from, WGS84.
    height_above
        What heights count from, as the positions have it; ``None`` where they hold no heights, and up then counts from
        the model's own origin.
    enu_from_world
        (3, 3) rotation.
    shift_m
        (3,) east, north, up of the model's origin.
    middle_in_world_m
        (3,) the point of the model that ``cov`` holds for: the middle of the positions used.
    cov
        (4, 4) of the turn about the vertical (radians, anticlockwise from above) and of east, north and up (metres) of
        ``middle_in_world_m``.
    used, left_out
        How many positions it rests on, and how many disagree with the rest.
    residual_rms_m
        Root mean square of each horizontal coordinate's residual.
    white_m, slow_m
        Sizes of the positions' errors from one to the next, and of those that are alike over ``alike_s``.
    alike_s, alike_assumed
        Over how long errors are alike, and whether that is an assumption: the mean of what the positions leave open.
    length_ratio, length_ratio_sigma
        Lengths by the positions over lengths of the model: a check, never a correction.
    delay_s, delay_sigma_s
        By how much positions lag, and its standard deviation, at most that of the prior; ``None`` where there is no
        path to compare with beside the instants of the positions.
    notes
        What the user should know.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    height_above: HeightDatum | None
    enu_from_world: Array
    shift_m: Array
    middle_in_world_m: Array
    cov: Array
    used: int
    left_out: int
    residual_rms_m: float
    white_m: float
    slow_m: float
    alike_s: float
    length_ratio: float
    length_ratio_sigma: float
    delay_s: float | None = None
    delay_sigma_s: float | None = None
    source: str = ""
    notes: tuple[Fact, ...] = ()
    alike_assumed: bool = False

    def __post_init__(self) -> None:
        at = (self.latitude_deg, self.longitude_deg, self.height_m)
        if not (np.isfinite(at).all() and abs(at[0]) <= 90 and abs(at[1]) <= 360):
            raise ValueError(f"latitude, longitude and height of {at} are no place on Earth")

    @property
    def heading_sigma_deg(self) -> float:
        """Standard deviation of the turn about the vertical."""
        return float(np.degrees(np.sqrt(self.cov[0, 0])))

    @property
    def position_sigma_m(self) -> float:
        """Standard deviation of each horizontal coordinate of the middle."""
        return float(np.sqrt(0.5 * (self.cov[1, 1] + self.cov[2, 2])))

    def enu_m(self, world_m: Array) -> Array:
        """(N, 3) east, north and up of points of the model."""
        return np.asarray(world_m @ self.enu_from_world.T + self.shift_m)

    def geodetic(self, world_m: Array) -> Array:
        """(N, 3) latitude and longitude in degrees, and height in metres, of points of the model."""
        return geodetic_of_ecef(self.ecef_m(world_m))

    def ecef_m(self, world_m: Array) -> Array:
        """(N, 3) earth-centred coordinates of points of the model."""
        at = np.array([self.latitude_deg, self.longitude_deg, self.height_m])
        return np.asarray(self.enu_m(world_m) @ ecef_from_enu(at[0], at[1]).T + ecef_of_geodetic(at[None])[0])

    def as_json(self) -> dict[str, object]:
        """Plain values, for ``result.json`` and ``georeference.json``."""
        return {
            "crs": "east, north, up in metres in the tangential plane of WGS84 (EPSG:4979) at the origin",
            "origin": {
                "latitude_deg": self.latitude_deg,
                "longitude_deg": self.longitude_deg,
                "height_m": self.height_m,
                "height_above": self.height_above,
            },
            "enu_from_world": self.enu_from_world.tolist(),
            "shift_m": self.shift_m.tolist(),
            "middle_in_world_m": self.middle_in_world_m.tolist(),
            "cov": self.cov.tolist(),
            "heading_ci95_deg": Z95 * self.heading_sigma_deg,
            "position_ci95_m": Z95 * self.position_sigma_m,
            "positions": {"used": self.used, "left_out": self.left_out, "source": self.source},
            "residual_rms_m": self.residual_rms_m,
            "errors": {
                "white_m": self.white_m,
                "slow_m": self.slow_m,
                "alike_s": self.alike_s,
                "alike_assumed": self.alike_assumed,
            },
            "delay": None
            if self.delay_s is None or self.delay_sigma_s is None
            else {"seconds": self.delay_s, "ci95_s": Z95 * self.delay_sigma_s},
            "length_ratio": self.length_ratio,
            "length_ratio_sigma": self.length_ratio_sigma,
            **with_sentences({"notes": list(self.notes)}),
        }


def georeference_of_json(values: Mapping[str, Any]) -> Georeference:
    """The value that :meth:`Georeference.as_json` came from; a missing or wrong entry raises as Python has it."""
    origin, positions, errors = values["origin"], values["positions"], values["errors"]
    delay = values.get("delay")  # version 0.1 has none
    return Georeference(
        latitude_deg=float(origin["latitude_deg"]),
        longitude_deg=float(origin["longitude_deg"]),
        height_m=float(origin["height_m"]),
        height_above=origin["height_above"],
        enu_from_world=check_array("enu_from_world", values["enu_from_world"], (3, 3)),
        shift_m=check_array("shift_m", values["shift_m"], (3,)),
        middle_in_world_m=check_array("middle_in_world_m", values["middle_in_world_m"], (3,)),
        cov=check_array("cov", values["cov"], (4, 4)),
        used=int(positions["used"]),
        left_out=int(positions["left_out"]),
        source=str(positions["source"]),
        residual_rms_m=float(values["residual_rms_m"]),
        white_m=float(errors["white_m"]),
        slow_m=float(errors["slow_m"]),
        alike_s=float(errors["alike_s"]),
        length_ratio=float(values["length_ratio"]),
        length_ratio_sigma=float(values["length_ratio_sigma"]),
        delay_s=None if delay is None else float(delay["seconds"]),
        delay_sigma_s=None if delay is None else float(delay["ci95_s"]) / Z95,
        notes=read_facts(values, "notes"),
        alike_assumed=bool(errors.get("alike_assumed", False)),  # earlier versions did not say
    )


def georeference(
    fixes: PositionFixes,
    cam_in_world_m: Array,
    t_s: Array,
    up_in_world: Array,
    *,
    path_at: Callable[[Array], Array] | None = None,
) -> Georeference:
    """Turn and shift that bring a metric path to positions of a satellite receiver.

    Parameters
    ----------
    fixes
        N positions.
    cam_in_world_m
        (N, 3) where the camera was at each of them, in the world of the metric model.
    t_s
        (N,) when, on any clock: errors are alike for a time.
    up_in_world
        (3,) unit vector against gravity.
    path_at
        Where the camera was at other instants (T,) of that clock, (T, 3): positions may then lag. Without, they do not.

    Raises
    ------
    NotObservableError
        Where the positions are too few, or leave the heading open.
    """
    if len(fixes.latitude_deg) < _LIMITS.fewest:
        few = Fact("positions-too-few", count=len(fixes.latitude_deg), needed=_LIMITS.fewest)
        raise NotObservableError("heading", few)
    chosen = np.argsort(t_s, kind="stable")
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, _LIMITS.most).round().astype(np.intp))]
    fixes, path_m, t_s = fixes.select(chosen), np.asarray(cam_in_world_m)[chosen], np.asarray(t_s)[chosen]
    origin, enu, heights = convert_to_enu(fixes)
    level_from_world = turn_upright(up_in_world)
    target = enu[:, 0] + 1j * enu[:, 1]

    def level_at(delay_s: float) -> Array:
        return np.asarray((path_m if path_at is None else path_at(t_s - delay_s)) @ level_from_world.T)

    fit, good = _fit_inliers(level_at, target, t_s, fixes.sigma_m, lags=path_at is not None)
    level = level_at(fit.delay_s)
    flat = level[good, 0] + 1j * level[good, 1]
    _require_heading(fit, flat)
    _require_same_path(fit)
    middle_level = np.array([fit.middle.real, fit.middle.imag, float(level[good, 2].mean())])
    counted = good & heights
    up_m = float(np.mean(enu[counted, 2] - level[counted, 2])) if counted.any() else 0.0
    turned = np.array([[np.cos(fit.turn), -np.sin(fit.turn), 0], [np.sin(fit.turn), np.cos(fit.turn), 0], [0, 0, 1.0]])
    at = np.array([fit.at.real, fit.at.imag, middle_level[2] + up_m])
    enu_from_world = turned @ level_from_world
    residual = target[good] - np.exp(1j * fit.turn) * (flat - fit.middle) - fit.at
    height_above = fixes.height_above if counted.any() else None
    stated = bool((fixes.sigma_m[good] > 0).any())
    return Georeference(
        latitude_deg=float(origin[0]),
        longitude_deg=float(origin[1]),
        height_m=float(origin[2]),
        height_above=height_above,
        enu_from_world=enu_from_world,
        shift_m=at - turned @ middle_level,
        middle_in_world_m=level_from_world.T @ middle_level,
        cov=_add_height(fit.cov, known=bool(counted.any())),
        used=int(good.sum()),
        left_out=int((~good).sum()),
        residual_rms_m=float(np.sqrt(np.mean(np.abs(residual) ** 2) / 2)),
        white_m=fit.white_m,
        slow_m=fit.slow_m,
        alike_s=fit.alike_s,
        length_ratio=fit.ratio,
        length_ratio_sigma=fit.ratio_sigma,
        delay_s=None if path_at is None else fit.delay_s,
        delay_sigma_s=None if path_at is None else fit.delay_sigma_s,
        source=fixes.source,
        alike_assumed=fit.alike_assumed,
        notes=tuple(_describe_fit(fit, stated, fixes.height_above if counted.any() else "ellipsoid")),
    )


def _add_height(cov: Array, *, known: bool) -> Array:
    """(4, 4) with the variance of the height, from (3, 3) of turn, east and north."""
    whole = np.zeros((4, 4))
    whole[:3, :3] = cov
    whole[3, 3] = _LIMITS.vertical**2 * max(cov[1, 1], cov[2, 2]) if known else 0.0
    return whole


def convert_to_enu(fixes: PositionFixes) -> tuple[Array, Array, BoolArray]:
    """Origin (latitude, longitude, height), east, north and up of the positions (N, 3), and which have a height."""
    heights = np.isfinite(fixes.height_m)
    place = np.stack([fixes.latitude_deg, fixes.longitude_deg, np.where(heights, fixes.height_m, 0.0)], axis=1)
    origin = np.array([np.median(place[:, 0]), place[0, 1], np.median(place[heights, 2]) if heights.any() else 0.0])
    place[~heights, 2] = origin[2]
    enu = (ecef_of_geodetic(place) - ecef_of_geodetic(origin[None])[0]) @ ecef_from_enu(origin[0], origin[1])
    return origin, enu, heights


def _require_heading(fit: _Fit, path: ComplexArray) -> None:
    """Refuse a path too short against the errors of the positions."""
    sigma = math.sqrt(fit.cov[0, 0])
    reach_m = float(np.sqrt(np.mean(np.abs(path - path.mean()) ** 2)))
    if np.degrees(sigma) > _LIMITS.least_certain_deg:
        half_width_deg, error_m = np.degrees(Z95 * min(sigma, np.pi)), math.hypot(fit.white_m, fit.slow_m)
        unsure = Fact("heading-unsure", half_width_deg=half_width_deg, reach_m=reach_m, error_m=error_m)
        raise NotObservableError("heading", unsure)


def _require_same_path(fit: _Fit) -> None:
    """Refuse positions whose distances are far from the model's."""
    if fit.ratio_error > _LIMITS.largest_ratio:
        raise NotObservableError("heading", Fact("positions-of-another-path", ratio=fit.ratio))


def _describe_fit(fit: _Fit, stated: bool, height_above: HeightDatum | None) -> Iterator[Fact]:
    """Notes on lengths that differ, on sizes of errors that are assumed, and on heights' zero."""
    if fit.ratio_error > _LIMITS.least_ratio:
        yield Fact("positions-of-another-scale", ratio=fit.ratio, half_width=Z95 * fit.ratio_sigma)
    if not stated:
        size_m, factor = _LIMITS.unstated_slow
        yield Fact("accuracy-assumed", slow_m=size_m, factor=factor)
    if height_above != "ellipsoid":
        yield Fact("heights-not-of-ellipsoid", height_above=height_above)


def turn_upright(up_in_world: Array) -> Array:
    """(3, 3) the shortest turn that brings up to z."""
    return np.asarray(matrix_from_quat(rotation_between(up_in_world, np.array([0.0, 0.0, 1.0]))))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Fit:
    """Turn about the vertical, where the point ``middle`` is (``at``), their covariance, errors' sizes, the delay."""

    turn: float
    middle: complex
    at: complex
    cov: Array
    white_m: float
    slow_m: float
    alike_s: float
    alike_assumed: bool
    ratio: float
    ratio_sigma: float
    delay_s: float
    delay_sigma_s: float

    @property
    def ratio_error(self) -> float:
        """Relative difference of the lengths; zero where chance explains it."""
        error = abs(self.ratio - 1)
        return error if error > _LIMITS.ratio_sigmas * self.ratio_sigma else 0.0


def _fit_inliers(
    level_at: Callable[[float], Array], target: ComplexArray, t_s: Array, sigma_m: Array, *, lags: bool
) -> tuple[_Fit, BoolArray]:
    """The fit without outliers, and which positions these are not."""
    good = np.ones(len(target), dtype=bool)
    for _ in range(_LIMITS.rounds):
        kept = good

        def paths(delays_s: Array, kept: BoolArray = kept) -> ComplexArray:
            levels = [level_at(delay_s)[kept] for delay_s in delays_s]
            return np.array([level[:, 0] + 1j * level[:, 1] for level in levels])

        fit = _fit_delay(paths, target[good], t_s[good], sigma_m[good], lags=lags)
        level = level_at(fit.delay_s)
        flat = level[:, 0] + 1j * level[:, 1]
        off = np.abs(target - np.exp(1j * fit.turn) * (flat - fit.middle) - fit.at)
        keep = off < max(_LIMITS.outlier * float(np.median(off)), _LIMITS.outlier_m)
        if (keep == good).all() or keep.sum() < _LIMITS.fewest:
            break
        good = keep
    return fit, good


def _fit_delay(
    paths: Callable[[Array], ComplexArray], target: ComplexArray, t_s: Array, stated_m: Array, *, lags: bool
) -> _Fit:
    """The mean over sizes of errors and delays; ``paths`` gives the path (T, N) by each of T delays."""
    if not lags:
        return _average_fits(paths(np.zeros(1)), np.zeros(1), target, t_s, stated_m)
    delays_s = _LIMITS.usual_delay_s + _LIMITS.delay_sigma_s * np.linspace(*_LIMITS.delay_span, _LIMITS.delays)
    for _ in range(_LIMITS.rounds):
        fit = _average_fits(paths(delays_s), delays_s, target, t_s, stated_m)
        step_s = float(delays_s[1] - delays_s[0])
        if fit.delay_sigma_s >= step_s:
            break
        half_s = max(_LIMITS.closer * fit.delay_sigma_s, step_s)
        delays_s = np.linspace(fit.delay_s - half_s, fit.delay_s + half_s, _LIMITS.closer_delays)
    return fit


def _average_fits(paths: ComplexArray, delays_s: Array, target: ComplexArray, t_s: Array, stated_m: Array) -> _Fit:
    """The mean over all sizes of errors and the delays given; plane points as complex numbers."""
    middle = complex(paths.mean())
    white_m, slow_m = (sizes.ravel() for sizes in np.meshgrid(_LIMITS.white_m, _LIMITS.slow_m))
    fits = _fit_by_errors(paths - middle, target, t_s, stated_m, (white_m, slow_m))
    log_prior_of_delay = -0.5 * ((delays_s - _LIMITS.usual_delay_s) / _LIMITS.delay_sigma_s) ** 2
    logs = fits.log_probability + log_prior_of_delay[:, None]
    share = np.exp(logs - logs.max())
    share /= share.sum()
    turn, at, cov = _average_placement(fits, share)
    ratio = float(np.sum(share * fits.ratio))
    share_of_delay = share.sum(axis=(0, 2))
    delay_s = float(share_of_delay @ delays_s)
    best = int(np.argmax(logs.max(axis=(0, 1))))
    alike_s, alike_assumed = _judge_correlation(share.sum(axis=(1, 2)))
    return _Fit(
        turn=turn,
        middle=middle,
        at=at,
        cov=cov,
        white_m=float(white_m[best]),
        slow_m=float(slow_m[best]),
        alike_s=alike_s,
        alike_assumed=alike_assumed,
        ratio=ratio,
        ratio_sigma=math.sqrt(float(np.sum(share * (1 / fits.turn_info + (fits.ratio - ratio) ** 2)))),
        delay_s=delay_s,
        delay_sigma_s=math.sqrt(float(share_of_delay @ (delays_s - delay_s) ** 2)),
    )


def _fit_by_errors(
    paths: ComplexArray, target: ComplexArray, t_s: Array, stated_m: Array, sizes: tuple[Array, Array]
) -> _Fits:
    """Placements of a path by each time over which slow errors are alike, by T delays and K sizes of errors: (A, T, K).

    ``stated_m`` (N,): the receiver's own standard deviations; NaN or 0 where it states none. ``sizes`` (K,), (K,): of
    white and of slow errors.
    """
    stated = stated_m[np.isfinite(stated_m) & (stated_m > 0)]
    usual_m, factor = (float(np.median(stated)), _LIMITS.slow_factor) if len(stated) else _LIMITS.unstated_slow
    # a receiver that is less sure of some positions than of others is right about that
    relative = np.where(np.isfinite(stated_m) & (stated_m > 0), stated_m / usual_m, 1.0)
    apart_s = np.abs(t_s[:, None] - t_s[None, :])
    log_prior = -0.5 * (np.log(sizes[1] / usual_m) / math.log(factor)) ** 2
    by_correlation = [
        _fit_given_errors(paths / relative, target / relative, 1 / relative, apart_s / alike_s, sizes, log_prior)
        for alike_s in _LIMITS.alike_s
    ]
    return _Fits(
        **{field.name: np.array([getattr(one, field.name) for one in by_correlation]) for field in fields(_Fits)}
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Fits:
    """Placements of a path on the ground by T delays and K sizes of errors, (T, K) each.

    Attributes
    ----------
    log_probability
        Of the errors' sizes, by their prior and the positions.
    turn, at
        Turn about the vertical, as a complex number of length one, and where the path's middle is.
    turn_info, at_info
        One over the variance of the turn, and of either coordinate of the middle at a given turn.
    at_by_turn
        Change of the middle with one standard deviation of the turn.
    ratio
        Length of the positions' path over that of the model's.
    """

    log_probability: Array
    turn: ComplexArray
    at: ComplexArray
    turn_info: Array
    at_info: Array
    at_by_turn: ComplexArray
    ratio: Array


def _fit_given_errors(
    path: ComplexArray, target: ComplexArray, ones: Array, apart: Array, sizes: tuple[Array, Array], log_prior: Array
) -> _Fits:
    """The placement of a path (T, N) on positions (N,) of which errors are known, by T delays and K sizes of errors.

    Parameters
    ----------
    path, target, ones
        In units of each position's own error; ``ones`` (N,) is what the placement of the path adds to it.
    apart
        (N, N) times between positions, over that in which slow errors are alike.
    sizes
        (K,), (K,) standard deviations of white and of slow errors.
    log_prior
        (K,) of these.
    """
    # in axes in which errors of all sizes are independent
    eigenvalues, axes = np.linalg.eigh(np.exp(-apart))
    one, z, p = axes.T @ ones, axes.T @ target, path @ axes
    white, slow = sizes
    variance = white**2 + slow**2 * np.maximum(eigenvalues, 0.0)[:, None]
    weight = 1 / variance
    at_info = one**2 @ weight
    middle_p, middle_z = (p * one) @ weight / at_info, (z * one) @ weight / at_info
    turn_info = np.maximum(np.abs(p) ** 2 @ weight - at_info * np.abs(middle_p) ** 2, 1e-12)
    along = (np.conj(p) * z) @ weight - at_info * np.conj(middle_p) * middle_z
    turn = np.where(np.abs(along) > 0, along / np.maximum(np.abs(along), 1e-300), 1.0)
    chi2 = np.abs(z) ** 2 @ weight - at_info * np.abs(middle_z) ** 2 + turn_info - 2 * np.abs(along)
    log_det = np.sum(np.log(variance), axis=0)
    log_probability = log_prior - log_det - 0.5 * chi2 - np.log(at_info) - 0.5 * np.log(turn_info)
    return _Fits(
        log_probability=log_probability,
        turn=turn,
        at=middle_z - turn * middle_p,
        turn_info=turn_info,
        at_info=np.broadcast_to(at_info, turn_info.shape),
        at_by_turn=-1j * turn * middle_p / np.sqrt(turn_info),
        ratio=np.abs(along) / turn_info,
    )


def _average_placement(fits: _Fits, share: Array) -> tuple[float, complex, Array]:
    """Mean turn and place by shares (A, T, K) of fits; (3, 3) their covariance, within the fits and between them."""
    turn, at = float(np.angle(np.sum(share * fits.turn))), complex(np.sum(share * fits.at))
    turned = np.angle(fits.turn * np.exp(-1j * turn))
    apart = np.stack([turned, (fits.at - at).real, (fits.at - at).imag])
    by_turn = np.stack([1 / np.sqrt(fits.turn_info), fits.at_by_turn.real, fits.at_by_turn.imag])
    cov = sum(np.einsum("atk,iatk,jatk->ij", share, errors, errors) for errors in (by_turn, apart))
    cov = cov + np.diag([0.0, 1.0, 1.0]) * float(np.sum(share / fits.at_info))
    return turn, at, np.asarray(0.5 * (cov + cov.T))


def _judge_correlation(probability: Array) -> tuple[float, bool]:
    """The mean time over which errors are alike, by its probability (K,); whether the positions leave it open."""
    log_alike = np.log(_LIMITS.alike_s)
    near = np.abs(log_alike - log_alike[int(np.argmax(probability))]) < math.log(_LIMITS.shown_within)
    return float(np.exp(np.sum(probability * log_alike))), bool(np.sum(probability[near]) < _LIMITS.shown)
