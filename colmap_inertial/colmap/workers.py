"""Who does the chunks of a run: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shutil
import subprocess
import tempfile
import uuid
from collections.abc import Callable, Generator, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from colmap_inertial import __version__
from colmap_inertial.colmap.chunks import (
    Chunk,
    Executor,
    Processes,
    end_process,
    require_success,
    start_process,
)
from colmap_inertial.core.errors import InertialError, MappingError, MissingExtraError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.threads import usable_processors
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import write_text

log = logging.getLogger(__name__)

_EXECUTOR: ContextVar[Executor | None] = ContextVar("executor", default=None)
#: How often a worker looks whether its chunk is still wanted, in seconds.
_WANTED_S = 0.25
#: In the folder of a chunk: who wants it. A run that goes on has the same folder anew.
_WANTED = "wanted"


@contextlib.contextmanager
def using_workers(workers: int | None = None, *, scheduler: str | None = None) -> Iterator[None]:
    """Let reconstructions within it be helped by so many processes, or by the workers of a Dask scheduler.

    Parts of long captures are mapped by as many processes at a time, by default one for each processor. Workers of a
    scheduler (``tcp://host:8786``) also find and match features; they need the same versions of this package and of
    pycolmap, and must see the output under the same path. The number of processes does not change a result, nor do a
    scheduler's workers where it is ``deterministic``.

    Raises
    ------
    MissingExtraError
        For a scheduler without Dask.
    InertialError
        Where no scheduler answers.
    """
    if workers is not None and workers < 1:
        raise ValueError(f"workers must be at least 1, not {workers}")
    if workers is not None and scheduler is not None:
        raise ValueError("--workers are those of this machine; with --scheduler, the cluster has its own")
    with contextlib.ExitStack() as stack:
        executor: Executor = Processes(number=workers or usable_processors())
        if scheduler is not None:
            client = stack.enter_context(connect(scheduler, Fact("work-needs-dask")))
            executor = Cluster(address=scheduler, client=client)
        token = _EXECUTOR.set(executor)
        try:
            yield
        finally:
            _EXECUTOR.reset(token)


def get_executor() -> Executor:
    """That of :func:`using_workers`."""
    executor = _EXECUTOR.get()
    return Processes(number=usable_processors()) if executor is None else executor


def connect(address: str, what: Fact) -> Any:
    """A Dask client; closes where its context ends.

    Raises
    ------
    MissingExtraError
        Where Dask is not installed, which ``what`` needs.
    InertialError
        Where no scheduler answers, or TLS has no certificates.
    """
    try:
        from distributed import Client, Security
    except ImportError:
        raise MissingExtraError("cluster", what) from None
    try:
        if address.startswith("tls:") and Security().get_connection_args("client")["ssl_context"] is None:
            raise InertialError(Fact("scheduler-needs-certificates", address=address))
        return Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InertialError(Fact("no-scheduler-answers", address=address, detail=str(error))) from error


def warn_without_gpu(client: Any, what: str) -> None:
    """Say where no worker of a Dask client offers a GPU, for which ``what`` waits."""
    try:
        workers = client.scheduler_info(n_workers=-1)["workers"]
    except TypeError:  # before 2025.2 it lists all workers without being asked
        workers = client.scheduler_info()["workers"]
    if not any("GPU" in worker.get("resources", {}) for worker in workers.values()):
        log.warning("no worker offers a GPU yet (dask worker --resources GPU=1): %s wait for one", what)


@dataclass(frozen=True, eq=False, kw_only=True)
class Cluster:
    """The workers of a Dask cluster. A chunk whose worker is lost goes to another one.

    Attributes
    ----------
    address
        Of the scheduler.
    client
        Dask's.
    """

    remote: ClassVar[bool] = True
    address: str
    client: Any

    def run(self, chunks: Sequence[Chunk], told: Callable[[int], None]) -> Generator[int, None, None]:
        """As of :class:`~colmap_inertial.colmap.chunks.Executor`."""
        from distributed import as_completed

        if any(chunk.gpu for chunk in chunks):
            warn_without_gpu(self.client, "features and matches")
        wanted: dict[Any, int] = {}
        for number, chunk in enumerate(chunks):
            key = f"colmap-inertial-{uuid.uuid4().hex}"
            write_text(chunk.folder / _WANTED, key)
            resources, versions = {"GPU": 1} if chunk.gpu else None, describe_versions()
            future = self.client.submit(do_for_another, chunk, versions, key, key=key, pure=False, resources=resources)
            wanted[future] = number
        try:
            for future in as_completed(list(wanted), loop=self.client.loop):
                chunk = chunks[wanted[future]]
                files, made = _result(future, chunk), chunk.folder / "made"
                made.mkdir()  # also for no file
                for name, content in files.items():
                    path = made / name
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(content)
                chunk.keep()
                future.release()
                told(chunk.size)
                yield wanted.pop(future)
        finally:
            with contextlib.suppress(Exception):  # the scheduler may be gone
                self.client.cancel(list(wanted))
            for number in wanted.values():
                remove(chunks[number].folder)  # a worker that is at it stops

    def require(self, folder: Path) -> None:
        """Raise ``InertialError`` where there is no worker, or one has other versions or does not see a folder."""
        probe, token = folder.absolute() / "seen_by_workers", uuid.uuid4().hex
        write_text(probe, token)
        try:
            answers = self.client.run(describe_worker, probe, on_error="return")
        finally:
            remove(probe)
        if not answers:
            raise InertialError(Fact("scheduler-without-worker", address=self.address))
        for worker, answer in answers.items():
            if isinstance(answer, BaseException):
                raise InertialError(Fact("worker-without-us", worker=worker, version=__version__, detail=str(answer)))
            versions, seen = answer
            _require_versions(worker, versions, describe_versions())
            if seen != token:
                raise _make_unseen_folder_error(worker, folder)


def _result(future: Any, chunk: Chunk) -> dict[str, bytes]:
    try:
        files: dict[str, bytes] = future.result()
    except InertialError:
        raise
    except (Exception, asyncio.CancelledError) as error:  # its workers were lost too often, or the scheduler is
        text = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise MappingError(Fact("work-not-finished", work=chunk.name, detail=text)) from error
    return files


def describe_versions() -> str:
    """What must be the same everywhere."""
    import pycolmap

    return f"colmap-inertial {__version__}, pycolmap {pycolmap.__version__}{' with CUDA' if pycolmap.has_cuda else ''}"


def describe_worker(probe: Path) -> tuple[str, str]:
    """The versions of this worker, and what it sees in a file; empty where it sees none."""
    try:
        return describe_versions(), probe.read_text(encoding="utf-8")
    except OSError:
        return describe_versions(), ""


def _require_versions(worker: str, versions: str, wanted: str) -> None:
    if versions != wanted:
        raise InertialError(Fact("worker-of-another-version", worker=worker, versions=versions, wanted=wanted))


def _make_unseen_folder_error(worker: str, folder: Path) -> InertialError:
    return InertialError(Fact("worker-sees-no-output", worker=worker, folder=str(folder)))


def _is_wanted(chunk: Chunk, by: str) -> bool:
    try:
        return (chunk.folder / _WANTED).read_text(encoding="utf-8") == by
    except OSError:
        return False


def do_for_another(chunk: Chunk, versions: str, by: str) -> dict[str, bytes]:
    """Do another machine's chunk in this worker's scratch folder; returns the files that were made, by name.

    ``by`` is who wants it: what the chunk's folder says as long as that is so.
    """
    from distributed import get_worker

    worker = get_worker()
    _require_versions(worker.address, describe_versions(), versions)
    if not chunk.folder.is_dir():
        raise _make_unseen_folder_error(worker.address, chunk.folder)
    with tempfile.TemporaryDirectory(dir=worker.local_directory) as scratch:
        own = replace(chunk, folder=Path(scratch) / "chunk")
        shutil.copytree(chunk.folder, own.folder)
        process = start_process(own, heard=False)
        try:
            while process.poll() is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=_WANTED_S)
                if not _is_wanted(chunk, by):
                    raise MappingError(Fact("work-not-wanted", work=chunk.name))
            require_success(process, own, on_worker=True)
        finally:
            process.kill()
            end_process(process)
        made = own.folder / "made"
        return {str(path.relative_to(made)): path.read_bytes() for path in made.rglob("*") if path.is_file()}
