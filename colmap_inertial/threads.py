"""How many threads there are, and how many linear algebra may use."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


def usable_processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0))


def threads_beside(workers: int) -> int:
    """How many threads a pool should count that workers share, each of which computes along with it as one of them.

    Then no processor is idle, and none has two.
    """
    return max(1, usable_processors() - workers + 1)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep BLAS to one thread, as context or decorator.

    The estimators multiply many small matrices: there, threads within one product cost more than they save (three
    times the time on two cores).
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
