"""Fit the standard deviations of swept depths on photographic worlds.

    python -m scripts.studies.fit_depth_sigma FOLDER [--fit 0 2] [--judge 1 3] [--widths 640]

FOLDER takes the worlds (``photo_world.py``) and their sweeps; what is there already is used. Printed: the factors of
``SigmaModel`` (``imaging/plane_sweep/confidence.py``) and, by the standard deviations that the package has, those of
``PlaneModel`` (``smoothing.py``); and for the worlds that judge the share of depths within twice their standard
deviation, by decile of it. At last, of the worlds that fit and of each that judges: the same of the depths that the
package keeps, as shares of their depth.

The factors are the 95 % quantile of the logarithm of errors, by iteratively reweighted least squares. Two standard
deviations are meant to hold 95 % of the errors; errors are far from Gaussian.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from colmap_inertial.colmap.dense.sweep_stereo import SweptWorkspace
from colmap_inertial.core.arrays import Array
from colmap_inertial.imaging.plane_sweep import (
    MEASURES,
    PLANE_MEASURES,
    estimate_sigma,
    keep_certain,
    measure_pixels,
    measure_planes,
    smooth_depth,
)
from scripts.benchmarks.dense import NEARER_M
from scripts.common.photo_world import PhotoWorld

QUANTILE, ROUNDS = 0.95, 60
#: Added to errors before the logarithm: smaller ones are the poses'.
FLOOR_PX = 0.02
#: Every so many pixels are used.
EVERY = 5


def swept_world(folder: Path, seed: int, width: int) -> tuple[SweptWorkspace, dict[str, Array]]:
    """A world that is rendered and swept, and its true depths by name."""
    path = folder / f"{seed}_{width}"
    if not (path / "truth.npz").is_file():
        depths = PhotoWorld.of(seed, width).write_workspace(path)
        np.savez(path / "truth.npz", allow_pickle=False, **depths)
    swept = SweptWorkspace(path, path / "raw")
    swept.begin(None)
    swept.sweep(1, lambda: None)
    with np.load(path / "truth.npz") as truth:
        return swept, {name: truth[name] for name in swept.names}


def collect(folder: Path, seeds: Sequence[int], widths: Sequence[int], *, planes: bool) -> tuple[Array, Array]:
    """(N, F) measures of pixels, and (N,) errors in pixels of the partners: of own depths where known, or of planes."""
    measures, errors = [], []
    for seed, width in itertools.product(seeds, widths):
        swept, truth = swept_world(folder, seed, width)
        for view, name in enumerate(swept.names):
            agreement, camera, partners = swept.compare(view), swept.sights.views[view], swept.partners(view)
            known = truth[name] < NEARER_M
            if planes:
                sigma = estimate_sigma(agreement, camera, partners)
                found, inverse, motion_px = measure_planes(
                    agreement.depth, sigma, swept.picture(view), camera, partners
                )
            else:
                found, motion_px = measure_pixels(agreement, camera, partners)
                inverse = 1 / np.where(agreement.depth > 0, agreement.depth, np.inf)
            some = np.flatnonzero(known & (inverse > 0))[::EVERY]
            measures.append(found.reshape(len(found), -1)[:, some].T.astype(np.float64))
            errors.append(np.abs(inverse.ravel()[some] - 1 / truth[name].ravel()[some]) * motion_px.ravel()[some])
    return np.concatenate(measures), np.concatenate(errors)


def print_kept(folder: Path, seeds: Sequence[int], widths: Sequence[int]) -> None:
    """Of the depths that are kept, by decile of their standard deviation: how many are within two of it."""
    shares, ratios = [], []
    for seed, width in itertools.product(seeds, widths):
        swept, truth = swept_world(folder, seed, width)
        for view, name in enumerate(swept.names):
            agreement, camera, partners = swept.compare(view), swept.sights.views[view], swept.partners(view)
            own = agreement.depth, estimate_sigma(agreement, camera, partners)
            depth, sigma = keep_certain(*smooth_depth(*own, swept.picture(view), camera, partners))
            kept = (truth[name] < NEARER_M) & (depth > 0)
            shares.append((sigma[kept] / depth[kept])[::EVERY])
            ratios.append((np.abs(depth - truth[name])[kept] / sigma[kept])[::EVERY])
    share, ratio = np.concatenate(shares), np.concatenate(ratios)
    deciles = " ".join(f"{(ratio[one] <= 2).mean():.3f}" for one in np.array_split(np.argsort(share), 10))
    print(f"seeds {seeds}: {deciles}, all {(ratio <= 2).mean():.3f}")


def fit_quantile(measures: Array, values: Array, quantile: float) -> Array:
    """(F,) factors for which this share of the values lies below ``measures @ factors``."""
    factors = np.linalg.lstsq(measures, values, rcond=None)[0]
    for _ in range(ROUNDS):
        away = values - measures @ factors
        weights = np.where(away > 0, quantile, 1 - quantile) / np.maximum(np.abs(away), 0.02)
        weighted = measures * weights[:, None]
        factors = np.linalg.solve(weighted.T @ measures, weighted.T @ values)
    return np.asarray(factors)


def main() -> None:
    """Print factors and deciles."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--fit", nargs="+", type=int, default=[0, 2])
    parser.add_argument("--judge", nargs="+", type=int, default=[1, 3])
    parser.add_argument("--widths", nargs="+", type=int, default=[640])
    arguments = parser.parse_args()
    for names, planes in ((MEASURES, False), (PLANE_MEASURES, True)):
        measures, errors = collect(arguments.folder, arguments.fit, arguments.widths, planes=planes)
        factors = fit_quantile(measures, np.log(errors + FLOOR_PX), QUANTILE)
        for name, factor in zip(names, factors, strict=True):
            print(f"    {name}: float = {factor:.3f}")
        measures, errors = collect(arguments.folder, arguments.judge, arguments.widths, planes=planes)
        twice_px = np.exp(measures @ factors)
        for decile in np.array_split(np.argsort(twice_px), 10):
            print(f"{twice_px[decile].mean():8.3f} px: {(errors[decile] <= twice_px[decile]).mean():.3f} within")
    for seeds in (arguments.fit, *([seed] for seed in arguments.judge)):
        print_kept(arguments.folder, seeds, arguments.widths)


if __name__ == "__main__":
    main()
