"""Whole reconstructions of small simulated scenes by every way to undo blur, for ``benchmarks.path --colmap``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args
from unittest.mock import patch

import numpy as np
from rich.console import Console

from colmap_inertial.core.options import DeblurMethod, ReconstructOptions
from colmap_inertial.tools.simulate import SceneRecipe, capture
from scripts.common import imaging_colmap
from scripts.common.recorded_orbits import hands, orbit

HELD_OUT = "room5"
BLURS_PX = (10.0, 20.0)
_FIRST_SEED = 20


def scenes(count: int) -> dict[str, tuple[SceneRecipe, float]]:
    """Desks about which a lively hand carries a camera with 20 ms readout, each with either blur."""
    out = {}
    for i in range(count):
        seed, blur_px = _FIRST_SEED + i // len(BLURS_PX), BLURS_PX[i % len(BLURS_PX)]
        out[f"scene {seed}, {blur_px:g} px"] = replace(imaging_colmap.lively_desk(quick=True), seed=seed), blur_px
    return out


def held_by(motion: Path | None, recipe: SceneRecipe) -> AbstractContextManager[object]:
    """While it lasts, the recipe's camera is in the hand of a recording, another stretch for each seed."""
    if motion is None:
        return nullcontext()
    found = hands(motion, HELD_OUT, recipe.motion.duration_s)
    hand = found[(recipe.seed - _FIRST_SEED) % len(found)]
    return patch.object(capture, "make_motion", partial(orbit, hand=hand))


def measure(
    report: dict[str, Any],
    methods: Sequence[str],
    count: int,
    widths_px: Sequence[float],
    *,
    motion: Path | None = None,
    console: Console,
    keep: Callable[[], None],
) -> None:
    """Adds ``colmap``: figures of each scene as they come, then what is wanted of their medians."""
    known = [name for name in methods if name in get_args(DeblurMethod)]
    ways = {
        "as filmed": ReconstructOptions(deblur="off", rolling_shutter="off"),
        "rectified": ReconstructOptions(deblur="off"),
        **{name: ReconstructOptions(deblur=name) for name in known},
    }
    others = {f"{name}, {width:g} px": (name, width) for name in known for width in widths_px}
    ways |= {way: ReconstructOptions(deblur=name) for way, (name, _) in others.items()}
    widths = {way: width for way, (_, width) in others.items()}
    found: dict[str, Any] = {}
    report["colmap"] = {"scenes": found, "wanted": []}
    for name, (recipe, blur_px) in scenes(count).items():
        with console.status(f"COLMAP, {name}"):

            def said(way: str, one: dict[str, Any], name: str = name) -> None:
                figures = ", ".join(f"{key} {value}" for key, value in one.items() if key != "deblurring")
                console.print(f"{name}, {way}: {figures}", highlight=False, soft_wrap=True)

            with held_by(motion, recipe):
                found[name] = imaging_colmap.reconstructed(recipe, blur_px, ways, widths, said)
        report["colmap"]["wanted"] = [line for way in (*known, *others) for line in wanted(found, way)]
        keep()


def wanted(found: dict[str, Any], way: str) -> list[tuple[str, float, float, bool]]:
    """Label, value, what is wanted, and whether at least."""
    rows = [row["ways"] for row in found.values()]

    def ratio(key: str, to: str) -> float:
        return float(np.nanmedian([row[way][key] / max(row[to][key], 1e-9) for row in rows]))

    # where half of the images are found untreated, all must be
    shares = [
        row["ways"][way]["registered"] / row["images"]
        for row in found.values()
        if row["ways"]["rectified"]["registered"] >= 0.5 * row["images"]
    ]
    spans = [row["ways"][way].get("scale_ci95_pct") for row in found.values()]
    held = [low <= 0 <= high for low, high in filter(None, spans)]
    return [
        (f"{way}: camera error / as filmed", ratio("centre_error_pct", "as filmed"), 1 / 12, False),
        (f"{way}: camera error / rectified", ratio("centre_error_pct", "rectified"), 0.8, False),
        (f"{way}: points / rectified", ratio("points", "rectified"), 1.5, True),
        (f"{way}: least share of images registered", min(shares, default=float("nan")), 1.0, True),
        (f"{way}: share of {len(held)} scales inside their intervals", float(np.mean(held or [np.nan])), 0.9, True),
    ]
