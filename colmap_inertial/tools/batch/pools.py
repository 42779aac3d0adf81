"""Where captures are worked on: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import logging
import queue
import re
import threading
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

from colmap_inertial.core.errors import InertialError, MissingExtraError
from colmap_inertial.core.threads import usable_cores
from colmap_inertial.tools.batch.task import CaptureStatus, CaptureTask, run_capture

log = logging.getLogger(__name__)

#: What a thread needs: 2.4 GB were measured for a picture of 12 megapixels with COLMAP's defaults.
_MEMORY_PER_THREAD = 3 * 2**30


#: Bytes that are taken to be free where the system does not say.
_ASSUMED_MEMORY = 8 * 2**30


class Pending(Protocol):
    """A capture that was handed over."""

    def done(self) -> bool:
        """Whether there is a result."""
        ...

    def result(self) -> CaptureStatus:
        """The capture's status; raises where its worker could not give one."""
        ...


class Pool(Protocol):
    """Somebody who works on captures."""

    def submit(self, task: CaptureTask, /) -> Pending:
        """Hand a capture over."""
        ...


def available_memory() -> int:
    """Bytes that processes may still take on this machine, within the limits of its container."""
    try:
        free = int(re.findall(r"MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text())[0]) * 1024
    except OSError:  # no Linux
        free = _ASSUMED_MEMORY
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
        cores = cores[: max(1, available_memory() // _MEMORY_PER_THREAD)]
        workers = min(len(cores), captures)
    return [cores[i::workers] or [cores[i % len(cores)]] for i in range(workers)]


def number_of_gpus() -> int:
    """CUDA devices of this machine."""
    return sum(re.fullmatch(r"nvidia\d+", path.name) is not None for path in Path("/dev").glob("nvidia*"))


class _Local:
    def __init__(self, shares: list[list[int]]) -> None:
        self._threads = ThreadPoolExecutor(len(shares), thread_name_prefix="capture")
        self._shares: queue.SimpleQueue[list[int]] = queue.SimpleQueue()
        for share in shares:
            self._shares.put(share)
        gpus = number_of_gpus()
        self._gpus = threading.Semaphore(gpus) if gpus else None

    def submit(self, task: CaptureTask, /) -> Pending:
        return self._threads.submit(self._run, task)

    def _run(self, task: CaptureTask) -> CaptureStatus:
        share = self._shares.get()
        try:
            with self._gpus if task.gpu and self._gpus is not None else contextlib.nullcontext():
                return run_capture(task, share)
        finally:
            self._shares.put(share)

    def close(self) -> None:
        self._threads.shutdown(cancel_futures=True)


@contextlib.contextmanager
def local_pool(shares: list[list[int]]) -> Iterator[Pool]:
    """Threads that each watch one process at a time; captures that want a GPU take turns at those there are."""
    pool = _Local(shares)
    try:
        yield pool
    finally:
        pool.close()


class _Dask:
    def __init__(self, client: Any) -> None:
        self._client = client
        self._pending: list[Any] = []
        self._gpu_checked = False

    def submit(self, task: CaptureTask, /) -> Pending:
        if task.gpu and not self._gpu_checked:
            self._gpu_checked = True
            if not any("GPU" in worker.get("resources", {}) for worker in self._workers()):
                log.warning("no worker offers a GPU yet (dask worker --resources GPU=1): dense captures wait for one")
        future: Pending = self._client.submit(
            run_capture,
            task,
            key=f"colmap-inertial-{task.name}-{uuid.uuid4().hex}",
            pure=False,
            resources={"GPU": 1} if task.gpu else None,
        )
        self._pending.append(future)
        return future

    def _workers(self) -> list[dict[str, Any]]:
        try:
            found = self._client.scheduler_info(n_workers=-1)
        except TypeError:  # before 2025.2 it tells of all without being asked
            found = self._client.scheduler_info()
        return list(found["workers"].values())

    def close(self) -> None:
        with contextlib.suppress(Exception):  # the scheduler may be gone
            self._client.cancel([future for future in self._pending if not future.done()])


@contextlib.contextmanager
def dask_pool(address: str) -> Iterator[Pool]:
    """The workers of a Dask cluster. A capture whose worker is lost goes to another one.

    Raises
    ------
    MissingExtraError
        Where Dask is not installed.
    InertialError
        Where no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtraError("cluster", "--scheduler hands captures to a Dask cluster") from None
    try:
        client = Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InertialError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        pool = _Dask(client)
        try:
            yield pool
        finally:
            pool.close()
