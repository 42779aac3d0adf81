"""What reading a model made of oddities in it: told to the user once, or collected by who tells it elsewhere."""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from colmap_inertial.core.facts import Fact

log = logging.getLogger(__name__)

_COLLECTED: ContextVar[list[tuple[Path, Fact]] | None] = ContextVar("notes", default=None)


@contextlib.contextmanager
def collecting_notes() -> Iterator[list[tuple[Path, Fact]]]:
    """Files and what was noted of them inside, in place of log lines; each once."""
    notes: list[tuple[Path, Fact]] = []
    token = _COLLECTED.set(notes)
    try:
        yield notes
    finally:
        _COLLECTED.reset(token)


def take_note(path: Path, fact: Fact) -> None:
    """Note something of a file that was read all the same."""
    notes = _COLLECTED.get()
    if notes is None:
        _log_once(path, str(fact.with_advice))
    elif (path, fact) not in notes:
        notes.append((path, fact))


@functools.lru_cache(maxsize=256)
def _log_once(path: Path, text: str) -> None:
    log.warning("%s: %s", path, text)
