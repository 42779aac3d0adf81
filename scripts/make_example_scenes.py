#!/usr/bin/env python3
"""Make a simulated capture from the recipe of an example scene.

    python scripts/make_example_scenes.py blurred                 # into example_scenes/blurred/generated/
    python scripts/make_example_scenes.py my.toml --out my_scene  # a recipe of one's own

A rendered frame of 640 x 480 takes 1 to 3 s of one core where it is sharp, and more the longer its blur.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

from colmap_inertial.errors import InertialError
from colmap_inertial.simulate.capture import write_capture
from colmap_inertial.simulate.recipe import load_recipe

SCENES = Path(__file__).resolve().parents[1] / "example_scenes"


def main() -> None:
    """Read the arguments; make the scene."""
    names = sorted(path.parent.name for path in SCENES.glob("*/recipe.toml"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help=f"one of {', '.join(names)}, or a recipe file")
    parser.add_argument("--out", type=Path, help="a new folder (default: generated/ beside the recipe)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes that render")
    arguments = parser.parse_args()
    recipe = SCENES / arguments.scene / "recipe.toml" if arguments.scene in names else Path(arguments.scene)
    out = arguments.out or recipe.parent / "generated"
    start = time.perf_counter()

    def progress(done: int, total: int) -> None:
        print(f"\r{done} of {total} frames, {time.perf_counter() - start:.0f} s", end="", file=sys.stderr, flush=True)

    try:
        capture = write_capture(load_recipe(recipe), out, workers=arguments.workers, progress=progress)
    except InertialError as error:
        sys.exit(f"{error}")
    print(f"\n{capture}")


if __name__ == "__main__":
    main()
