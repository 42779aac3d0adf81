"""Who hears how far a run is."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Receives progress: how many of ``total`` steps of ``stage`` are done. ``total`` is 0 where unknown."""

    def __call__(self, stage: str, done: int, total: int, /) -> None: ...


def silent(stage: str, done: int, total: int, /) -> None:
    """A progress receiver that shows nothing."""
