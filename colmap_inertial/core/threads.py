"""Number of threads, work shared by threads, and threads of linear algebra."""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import Future

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class FrameLimits:
    """Number of frames in work at once."""

    #: Enough for a desk computer's cores, few enough for its memory;
    most: int = 4
    #: of small ones, more: so many million pixels in all. A filter takes some 60 bytes for each pixel in colour.
    megapixels: float = 32.0


FRAME_LIMITS = FrameLimits()


def usable_processors() -> int:
    """Number of processors that this process may use."""
    if hasattr(os, "process_cpu_count"):  # Python 3.13
        return os.process_cpu_count() or 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def usable_cores() -> list[int]:
    """Their numbers, counted from 0 where the system does not say."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(usable_processors()))


def threads_beside(workers: int) -> int:
    """Number of threads of each worker's pool, where workers compute along with their pools.

    Then no processor is idle, and none has two.
    """
    return max(1, usable_processors() - workers + 1)


def frames_at_once(megapixels: float | None = None) -> int:
    """Number of frames, of this size where it is known, to work on at once: one for each processor, but few."""
    most = (
        FRAME_LIMITS.most if megapixels is None else max(FRAME_LIMITS.most, int(FRAME_LIMITS.megapixels / megapixels))
    )
    return min(most, usable_processors())


def map_in_order(work: Callable[[Item], Result], items: Iterable[Item], *, workers: int) -> Iterator[Result]:
    """Apply a function to items with ``workers`` threads; results come in order, and few are held at a time.

    What holds for the caller (a context variable) holds for the work.

    Where the caller stops early or an item fails, those that have not begun are given up.
    """
    from concurrent.futures import ThreadPoolExecutor

    pool, stopped = ThreadPoolExecutor(workers), False
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(copy_context().run, work, item))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    except GeneratorExit:
        stopped = True
        raise
    finally:
        # A caller that failed lets go of this, and the garbage collector ends it in whichever thread it runs: one of
        # the pool's own cannot wait for itself.
        pool.shutdown(wait=not stopped, cancel_futures=True)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep BLAS to one thread, as context or decorator.

    The estimators multiply many small matrices: there, threads within one product cost more than they save (three
    times the time on two cores).
    """
    _BLAS.enter()
    try:
        yield
    finally:
        _BLAS.leave()


class _LimitedBlas:
    """BLAS, which the whole process shares: limited as long as any thread is inside."""

    def __init__(self) -> None:
        self._lock, self._inside, self._modules = Lock(), 0, 0
        self._limits: list[Any] = []

    def enter(self) -> None:
        # SciPy brings a BLAS of its own, and only libraries that are loaded can be limited
        import scipy.linalg  # noqa: F401
        from threadpoolctl import threadpool_limits

        with self._lock:
            # to look for libraries takes milliseconds: only where something was loaded since
            if not self._inside or self._modules != len(sys.modules):
                self._limits.append(threadpool_limits(limits=1, user_api="blas"))
                self._modules = len(sys.modules)
            self._inside += 1

    def leave(self) -> None:
        with self._lock:
            self._inside -= 1
            while self._limits and not self._inside:
                self._limits.pop().restore_original_limits()


_BLAS = _LimitedBlas()
