"""How large files may be that are read, for as long as somebody says so: readers are called from everywhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from colmap_inertial.core.options import ReadLimits

_USUAL = ReadLimits()
_LIMITS: ContextVar[ReadLimits] = ContextVar("limits", default=_USUAL)


def read_limits() -> ReadLimits:
    """Those that hold here."""
    return _LIMITS.get()


@contextmanager
def reading_within(limits: ReadLimits) -> Iterator[None]:
    """Let these limits hold for all readers that are called inside, as context or decorator.

    ``reconstruct`` and ``reconstruct_project`` take theirs from their options, and ``run_batch`` from those of each
    capture.
    """
    token = _LIMITS.set(limits)
    try:
        yield
    finally:
        _LIMITS.reset(token)
