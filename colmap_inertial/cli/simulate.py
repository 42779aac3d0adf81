"""Arguments of ``colmap-inertial simulate``."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from colmap_inertial.cli.command import ReadingCommand
from colmap_inertial.core.printing import say


@dataclass(frozen=True, kw_only=True)
class Simulate(ReadingCommand):
    """Make a simulated capture with known truth: a desk or a room.

    It is filmed by hand, with the IMU recorded with it.

    Example: colmap-inertial simulate example_scenes/rolling_shutter/recipe.toml my_scene
    """

    recipe: Positional[Path]
    """A recipe (TOML): world, motion, IMU, camera, checkerboard; keys in docs/dev/simulation.md,
    examples in example_scenes/."""
    out: Positional[Path]
    """A new folder for images or video, IMU files, capture.toml and truth.json; or for what Stray Scanner writes."""
    workers: int = os.cpu_count() or 1
    """Processes that render; a frame of 640 x 480 takes one to three seconds of one core, more where it is blurred."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.tools.simulate.capture import write_capture
        from colmap_inertial.tools.simulate.recipe import load_recipe

        self.check_json(self.recipe)
        recipe = load_recipe(self.recipe)
        with self.progress() as progress:
            capture = write_capture(
                recipe, self.out, workers=self.workers, progress=lambda done, total: progress("rendering", done, total)
            )
        self.tell(lambda: say(capture), {"out": self.out, "capture": capture})
        return 0
