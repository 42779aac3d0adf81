"""Georeferencing with correlated position errors: coverage and width of the intervals.

    python -m scripts.studies.georeference [--walks 40] [--sizes 1 3 6] [--alike-s 1 5 20 60 200 300] [--unstated]
        [--seed 0] [--json study.json]

Each walk lasts 90 s, with a position a second. Its errors are white (0.5 m) plus slow ones of the given size, which are
alike over the given time, and it lags by a draw of 0 to 1 s. The receiver states the size of its errors, or nothing
with ``--unstated``. For place, heading and delay a row has the share of 95 % intervals that hold the truth, and the
median half-width over the rms error; then how often the correlation was assumed. Exit code 1 where less than 0.9 of
the intervals for place or heading hold, or half-widths are more than 3 times the rms.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.earth import ecef_from_enu, ecef_of_geodetic, geodetic_of_ecef
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import PositionFixes
from colmap_inertial.inertial.georeference import Georeference, georeference
from scripts.common.bench_report import write_report

SECONDS, FINE_S, WHITE_M, LONGEST_DELAY_S = 90, 0.1, 0.5, 1.0
#: Shares of intervals that hold, and half-widths over the rms error, that pass.
LEAST_COVERED, WIDEST = 0.9, 3.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Walk:
    """A walk, the positions that a receiver gave, and the truth of both."""

    path_at: Callable[[Array], Array]
    t_s: Array
    fixes: PositionFixes
    origin: Array
    heading_rad: float
    delay_s: float

    def errors(self, found: Georeference) -> tuple[Array, float, float]:
        """Errors of the place (east and north, m), heading (rad) and delay (s)."""
        c, s = math.cos(self.heading_rad), math.sin(self.heading_rad)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        apart = found.ecef_m(found.middle_in_world_m[None])[0] - ecef_of_geodetic(self.origin[None])[0]
        enu = apart @ ecef_from_enu(self.origin[0], self.origin[1])
        place_m = enu - turn @ found.middle_in_world_m
        turned = found.enu_from_world @ turn.T
        assert found.delay_s is not None
        return place_m[:2], math.atan2(turned[1, 0], turned[0, 0]), found.delay_s - self.delay_s


def simulate_walk(rng: np.random.Generator, slow_m: float, alike_s: float, *, stated: bool) -> Walk:
    """A person's walk with turns, and positions that lag and err."""
    fine_s = np.arange(-5.0, SECONDS + 5.0, FINE_S)
    course = np.cumsum(0.1 * math.sqrt(FINE_S) * rng.standard_normal(len(fine_s)))
    pace_m_s = 1.2 + 0.3 * np.sin(2 * np.pi * (fine_s / rng.uniform(8, 40) + rng.random()))
    step = FINE_S * pace_m_s * np.stack([np.cos(course), np.sin(course), np.zeros_like(course)])
    path = np.cumsum(step, axis=1)

    def path_at(t_s: Array) -> Array:
        return np.stack([np.interp(t_s, fine_s, axis) for axis in path], axis=1)

    t_s = np.arange(float(SECONDS))
    kept = math.exp(-1 / alike_s)
    slow = slow_m * rng.standard_normal((SECONDS, 3))
    for i in range(1, SECONDS):
        slow[i] = kept * slow[i - 1] + math.sqrt(1 - kept**2) * slow[i]
    heading_rad, delay_s = rng.uniform(-np.pi, np.pi), rng.uniform(0, LONGEST_DELAY_S)
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    enu = path_at(t_s - delay_s) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    enu += slow + WHITE_M * rng.standard_normal((SECONDS, 3))
    origin = np.array([rng.uniform(-70, 70), rng.uniform(-179, 179), 50.0])
    ecef = ecef_of_geodetic(origin[None]) + enu @ ecef_from_enu(origin[0], origin[1]).T
    place = geodetic_of_ecef(ecef)
    fixes = PositionFixes(
        latitude_deg=place[:, 0],
        longitude_deg=place[:, 1],
        height_m=place[:, 2],
        sigma_m=np.full(SECONDS, math.hypot(slow_m, WHITE_M) if stated else np.nan),
        t_ns=(t_s * 1e9).astype(np.int64),
        height_above="ellipsoid",
    )
    return Walk(path_at=path_at, t_s=t_s, fixes=fixes, origin=origin, heading_rad=heading_rad, delay_s=delay_s)


def measure(slow_m: float, alike_s: float, *, walks: int, stated: bool, seed: int = 0) -> dict[str, float]:
    """Coverage and relative half-width of place, heading and delay over many walks."""
    errors: dict[str, list[Array]] = {"place": [], "heading": [], "delay": []}
    sigmas: dict[str, list[Array]] = {"place": [], "heading": [], "delay": []}
    refused = assumed = 0
    for i in range(walks):
        walk = simulate_walk(np.random.default_rng([seed, i]), slow_m, alike_s, stated=stated)
        try:
            up = np.array([0.0, 0.0, 1.0])
            found = georeference(walk.fixes, walk.path_at(walk.t_s), walk.t_s, up, path_at=walk.path_at)
        except NotObservableError:
            refused += 1
            continue
        assumed += found.alike_assumed
        sigma = (np.sqrt(np.diag(found.cov)[1:3]), found.cov[0, 0] ** 0.5, found.delay_sigma_s)
        for name, error, one in zip(errors, walk.errors(found), sigma, strict=True):
            errors[name].append(np.atleast_1d(error))
            sigmas[name].append(np.atleast_1d(one))
    row = {"slow_m": slow_m, "alike_s": alike_s, "refused": refused, "assumed": assumed}
    for name in errors:
        error, half = np.array(errors[name]), Z95 * np.array(sigmas[name])
        row[f"{name}_covered"] = float(np.mean(np.abs(error) < half))
        row[f"{name}_ratio"] = float(np.median(half) / np.sqrt(np.mean(error**2)))
    return row


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walks", type=int, default=40)
    parser.add_argument("--sizes", type=float, nargs="*", default=[1.0, 3.0, 6.0])
    parser.add_argument("--alike-s", type=float, nargs="*", default=[1.0, 5.0, 20.0, 60.0, 200.0, 300.0])
    parser.add_argument("--unstated", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    rows = []
    print("slow m  alike s   place         heading       delay         assumed  refused")
    for slow_m in options.sizes:
        for alike_s in options.alike_s:
            row = measure(slow_m, alike_s, walks=options.walks, stated=not options.unstated, seed=options.seed)
            rows.append(row)
            parts = "".join(
                f"{row[f'{name}_covered']:.2f} x{row[f'{name}_ratio']:<6.1f}  "
                for name in ("place", "heading", "delay")
            )
            print(f"{slow_m:6g}  {alike_s:7g}   {parts}{row['assumed']:7.0f}  {row['refused']:7.0f}", flush=True)
    bad = [row for row in rows for name in ("place", "heading") if not passes(row, name)]
    print(f"{len(bad)} of {2 * len(rows)} do not hold, or are too wide")
    if options.json is not None:
        write_report(options.json, {"rows": rows})
    return int(bool(bad))


def passes(row: dict[str, float], name: str) -> bool:
    """Whether the intervals of a row hold and are not too wide."""
    return row[f"{name}_covered"] >= LEAST_COVERED and row[f"{name}_ratio"] <= WIDEST


if __name__ == "__main__":
    sys.exit(main())
