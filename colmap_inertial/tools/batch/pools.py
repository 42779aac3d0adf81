"""Workers of a batch: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import contextlib
import functools
import queue
import re
import threading
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from colmap_inertial.colmap.workers import connect, warn_without_gpu
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.threads import usable_cores
from colmap_inertial.tools.batch.task import CaptureStatus, CaptureTask, run_capture


@dataclass(frozen=True, kw_only=True)
class MemoryLimits:
    """Memory of a worker, which limits their number."""

    per_thread_bytes: int = 3 * 2**30
    """What a thread needs: 2.4 GB were measured for an image of 12 megapixels with COLMAP's defaults."""
    assumed_free_bytes: int = 8 * 2**30
    """Taken to be free where the system does not say."""


MEMORY_LIMITS = MemoryLimits()


class Pending(Protocol):
    """A capture that was handed over."""

    def done(self) -> bool:
        """Whether there is a result."""
        ...

    def result(self) -> CaptureStatus:
        """The capture's status; raises where its worker could not give one."""
        ...


#: Hands a capture over to a worker.
Submit = Callable[[CaptureTask], Pending]


def available_memory() -> int:
    """Memory available to processes on this machine, within the limits of its container, in bytes."""
    try:
        free = int(re.findall(r"MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text())[0]) * 1024
    except OSError:  # no Linux
        free = MEMORY_LIMITS.assumed_free_bytes
    for folder in ("/sys/fs/cgroup", "/sys/fs/cgroup/memory"):
        for limit, used in (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")):
            with contextlib.suppress(OSError, ValueError):
                left = int(Path(folder, limit).read_text()) - int(Path(folder, used).read_text())
                free = min(free, max(left, 0))
    return free


def shares_of_this_machine(captures: int, workers: int | None = None) -> list[list[int]]:
    """The processors for each worker: as many workers as processors and memory allow, and no processor twice.

    Parameters
    ----------
    captures
        How many there are to work on.
    workers
        How many to work on at once, where that is decided already.
    """
    cores = usable_cores()
    if workers is None:
        cores = cores[: max(1, available_memory() // MEMORY_LIMITS.per_thread_bytes)]
        workers = min(len(cores), captures)
    return [cores[i::workers] or [cores[i % len(cores)]] for i in range(workers)]


def number_of_gpus() -> int:
    """CUDA devices of this machine."""
    return sum(re.fullmatch(r"nvidia\d+", path.name) is not None for path in Path("/dev").glob("nvidia*"))


@contextlib.contextmanager
def local_pool(shares: list[list[int]]) -> Iterator[Submit]:
    """Threads that each watch one process at a time; captures that need a GPU take turns at those there are."""
    free_shares: queue.SimpleQueue[list[int]] = queue.SimpleQueue()
    for share in shares:
        free_shares.put(share)
    gpus = number_of_gpus()
    gpu = threading.Semaphore(gpus) if gpus else contextlib.nullcontext()

    def run(task: CaptureTask) -> CaptureStatus:
        share = free_shares.get()
        try:
            with gpu if task.gpu else contextlib.nullcontext():
                return run_capture(task, share)
        finally:
            free_shares.put(share)

    threads = ThreadPoolExecutor(len(shares), thread_name_prefix="capture")
    try:
        yield lambda task: threads.submit(run, task)
    finally:
        threads.shutdown(cancel_futures=True)


@contextlib.contextmanager
def dask_pool(address: str) -> Iterator[Submit]:
    """The workers of a Dask cluster. A capture whose worker is lost goes to another one.

    Errors are those of :func:`~colmap_inertial.colmap.workers.connect`.
    """
    client = connect(address, Fact("captures-need-dask"))
    submitted: list[Any] = []
    warn_once = functools.cache(lambda: warn_without_gpu(client, "dense captures"))

    def submit(task: CaptureTask) -> Pending:
        if task.gpu:
            warn_once()
        key, resources = f"colmap-inertial-{task.name}-{uuid.uuid4().hex}", {"GPU": 1} if task.gpu else None
        future: Pending = client.submit(run_capture, task, key=key, pure=False, resources=resources)
        submitted.append(future)
        return future

    with client:
        try:
            yield submit
        finally:
            with contextlib.suppress(Exception):  # the scheduler may be gone
                client.cancel([future for future in submitted if not future.done()])
