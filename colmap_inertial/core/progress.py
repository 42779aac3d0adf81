"""Receivers of a run's progress."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

Item = TypeVar("Item")

log = logging.getLogger(__name__)


class Progress(Protocol):
    """Receives progress: how many of ``total`` steps of ``stage`` are done. ``total`` is 0 where unknown."""

    def __call__(self, stage: str, done: int, total: int, /) -> None: ...


@runtime_checkable
class HearsSteps(Protocol):
    """A receiver of progress that is also told which steps a run does, and which it keeps."""

    def kept(self, step: str, /) -> None:
        """An earlier run finished this step, and it stands."""

    def began(self, step: str, outputs: Sequence[Path], /) -> None:
        """A step begins, which writes these files and folders."""

    def noted(self, sentence: str, /) -> None:
        """Why something is made again."""


def tell(progress: Progress, sentence: str) -> None:
    """Say why something is made again: in the log, and to a receiver that hears of steps."""
    log.info("%s", sentence)
    if isinstance(progress, HearsSteps):
        progress.noted(sentence)


def silent(stage: str, done: int, total: int, /) -> None:
    """A progress receiver that shows nothing."""


def report_each(items: Iterable[Item], total: int, stage: str, progress: Progress) -> Iterator[Item]:
    """The items; ``progress`` hears of each before it goes on, and of the end."""
    for done, item in enumerate(items):
        progress(stage, done, total)
        yield item
    progress(stage, total, total)


def make_counter(
    progress: Progress, stage: str, total: int, *, begin: int = 0, steps: int | None = None, of: int | None = None
) -> Callable[..., None]:
    """A function that counts items, one at a time or several, from ``begin`` on; ``of`` items are so many ``steps``.

    By default ``total`` items are as many steps.
    """
    count = 0

    def told(items: int = 1) -> None:
        nonlocal count
        count += items
        progress(stage, min(begin + count * (steps or total) // (of or total), total), total)

    return told
