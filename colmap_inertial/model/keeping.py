"""Paths that are copied as they are, by patterns as a shell has them."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from colmap_inertial.core.facts import Fact


@dataclass(frozen=True)
class Kept:
    """Patterns of paths in a project.

    A pattern without a slash is a name, of a file or folder wherever it is; one with a slash, a path in the project,
    which may begin with that of the project itself. ``**/`` at the begin is any folder, or none.
    """

    patterns: tuple[str, ...]
    project: Path

    def covers(self, path: Path) -> bool:
        """Whether a path, or a folder above it, is kept."""
        return any(self._fits(part, pattern) for pattern in self.patterns for part in (path, *path.parents[:-1]))

    def _fits(self, path: Path, pattern: str) -> bool:
        text = path.as_posix()
        plain = pattern.replace("\\", "/").removeprefix("./").rstrip("/")
        plain = plain.removeprefix(f"{self.project.as_posix().removeprefix('./')}/")
        plain = plain.removeprefix(f"{self.project.absolute().as_posix()}/")
        if fnmatch.fnmatchcase(text, pattern) or fnmatch.fnmatchcase(text, plain):
            return True
        if plain.startswith("**/"):
            return self._fits(path, plain[3:])
        return "/" not in plain and fnmatch.fnmatchcase(path.name, plain)

    def idle_patterns(self, paths: Sequence[Path]) -> Iterable[Fact]:
        """What the user is told of patterns that fit nothing."""
        for pattern in self.patterns:
            if not any(self._fits(path, pattern) for path in paths):
                yield Fact("idle-pattern", pattern=pattern)
