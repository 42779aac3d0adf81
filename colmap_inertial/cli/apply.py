"""Arguments of ``colmap-inertial apply``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from tyro.conf import Positional

from colmap_inertial.cli.command import ReadingCommand
from colmap_inertial.cli.terminal import show_applied
from colmap_inertial.core.options import WorldAxes


@dataclass(frozen=True, kw_only=True)
class Apply(ReadingCommand):
    """Make a whole COLMAP project metric: sparse models, dense workspaces, point clouds, meshes, database.

    OUT mirrors PROJECT, which is only read; it appears whole or not at all, and OUT/transform.json says what was done.
    Give --scale, --factor or --sim3; or --undo to take back what an earlier run applied. Exit code 3 when every scale
    was refused; a sub-model with a refused scale keeps its own units.

    Example: colmap-inertial apply project project_metric --scale scale.json
    """

    common: ClassVar = ("scale", "factor", "sim3", "undo", "world")

    project: Positional[Path]
    """A folder with a COLMAP model, and whatever was made from it."""
    out: Positional[Path]
    """A new folder."""
    scale: tuple[str, ...] = ()
    """What `colmap-inertial scale --json` wrote; with several sub-models one for each, as NUMBER=FILE, or the
    result.json of a reconstruction."""
    factor: float | None = None
    """Multiply lengths by this; axes and origin stay."""
    sim3: Path | None = None
    """JSON with scale, rotation_xyzw, translation_m (and cov, provenance): x' = scale * R x + translation."""
    undo: bool = False
    """PROJECT was written by this command: write it in its old units."""
    world: WorldAxes = "z-up"
    """With --scale, axes of the metric project: z away from the ground, or y towards it."""
    link: bool = False
    """Hard links for files that do not change; an edit of one then changes the original, too."""
    keep: tuple[str, ...] = ()
    """Patterns of names or paths in PROJECT that are copied as they are, such as "old/*" or "*.bak"."""
    follow_links: bool = False
    """Copy what symbolic links out of PROJECT point to; otherwise such links are refused."""
    any_model: bool = False
    """Apply a scale that was estimated for another model; otherwise it is refused."""

    def __post_init__(self) -> None:
        given = (bool(self.scale), self.factor is not None, self.sim3 is not None, self.undo)
        if sum(given) != 1:
            raise ValueError("give one of --scale, --factor, --sim3 and --undo")
        if self.undo and self.keep:
            raise ValueError("--undo keeps what was kept before; leave out --keep")
        if self.factor is not None and not 0 < self.factor < float("inf"):
            raise ValueError(f"factor must be positive, not {self.factor:g}")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.model.project import apply_to_project, undo_project

        self.check_json(self.sim3)
        with self.progress() as screen:
            how: Any = {
                "link": self.link,
                "follow_links": self.follow_links,
                "progress": lambda done, total: screen("apply", done, total),
            }
            if self.undo:
                applied = undo_project(self.project, self.out, **how)
            else:
                applied = apply_to_project(
                    self.project,
                    self.out,
                    self._read_scales(),
                    keep=self.keep,
                    about_origin=self.sim3 is not None,
                    any_model=self.any_model,
                    **how,
                )
        self.tell(lambda: show_applied(applied), applied.as_json())
        return 0

    def _read_scales(self) -> Any:
        from colmap_inertial.model.similarities import plain_factor, read_scales, read_similarity

        if self.sim3 is not None:
            return read_similarity(self.sim3)
        if self.factor is not None:
            return plain_factor(self.factor)
        return read_scales(self.scale, world=self.world)
