"""Many captures: each reconstructed in a process of its own, on this machine or on a Dask cluster.

In OUT, each capture has a folder of its own, as ``reconstruct`` makes it. ``status/NAME.json`` says how far it is or
how it ended, ``status/NAME.log`` what its process said; ``summary.csv`` and ``summary.json`` have all captures in one
table. Started again, a batch continues: captures that ended with a result are left alone, all others are taken up where
they were.
"""

from __future__ import annotations

import contextlib
import csv
import io
import itertools
import os
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_inertial.core.choices import check_kind
from colmap_inertial.core.errors import OutputError, OutputExistsError, describe_environment_fault
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import BatchOptions, ReconstructOptions, StageNames
from colmap_inertial.core.printing import cell
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.io.files import StrPath, locked, remove_temporaries, write_json, write_text
from colmap_inertial.run.steps.config import config_as_toml
from colmap_inertial.run.steps.workspace import refuse_links
from colmap_inertial.tools.batch.manifest import BatchCapture, check_unique, read_manifest
from colmap_inertial.tools.batch.pools import Pending, dask_pool, local_pool, shares_of_this_machine
from colmap_inertial.tools.batch.task import (
    CaptureStatus,
    CaptureTask,
    Job,
    failed,
    find_earlier_end,
    read_status,
    write_status,
)


@dataclass(frozen=True, kw_only=True)
class BatchTiming:
    """Intervals at which a batch checks its captures."""

    progress_s: float = 0.5
    """How often progress is shown."""
    done_s: float = 0.05
    """How often finished captures are looked for: a batch ends soon after its last one."""
    stop_s: float = 10.0
    """After a stop, how long workers may take to notice."""
    next_captures: int = 64
    """Captures are begun in their order: status files of so many waiting ones are read."""


BATCH_TIMING = BatchTiming()
Watch = Callable[[CaptureStatus], None]


@prints_in_lines
@dataclass(frozen=True, kw_only=True)
class BatchResult:
    """Result of a batch; the same as ``summary.json``.

    Attributes
    ----------
    out
        The batch's folder.
    captures
        Every capture, in the manifest's order.
    unchanged
        Whether there was nothing to do: every capture had its end already.
    """

    out: Path
    captures: tuple[CaptureStatus, ...]
    unchanged: bool = False

    def exit_code(self) -> int:
        """0 where every capture is done, else 1."""
        return 0 if all(capture.state == "done" for capture in self.captures) else 1


def ignore_status(status: CaptureStatus, /) -> None:
    """The default watcher: does nothing."""


def needs_gpu(options: ReconstructOptions) -> bool:
    """Whether a capture is to have a GPU to itself: where COLMAP makes its depth maps there."""
    if not options.dense:
        return False
    import pycolmap

    return bool(pycolmap.has_cuda)


def run_batch(
    captures: StrPath | Sequence[BatchCapture],
    out: StrPath,
    options: ReconstructOptions = ReconstructOptions(),
    *,
    stages: StageNames = StageNames(),
    batch: BatchOptions = BatchOptions(),
    watch: Watch = ignore_status,
    allow_stages: bool = False,
) -> BatchResult:
    """Reconstruct many captures; one that fails does not stop the rest.

    Parameters
    ----------
    captures
        What :func:`read_manifest` takes, or its result.
    out
        A new folder, or that of an earlier run, which is then continued.
    options
        For captures that state none of their own in the manifest.
    stages
        The hooks of captures that have none of their own, by name: each capture's process imports them.
    batch
        Who does the work. Captures on this machine share its processors among them. The workers of a Dask scheduler
        need this package, and must see captures and output under the same paths; captures that want a GPU go to those
        that offer one as a resource (``dask worker --resources GPU=1``).
    watch
        Called with the status of a capture whenever that changed.
    allow_stages
        As of :func:`read_manifest`.

    Raises
    ------
    FormatError
        For a manifest that cannot be read, or that names stages without leave. What is wrong with one capture is in
        its status instead.
    OutputExistsError
        When another batch is at work in ``out``, or it is not a batch's folder.
    MissingExtraError
        For a scheduler without Dask.
    """
    check_kind("options", options, ReconstructOptions, batch=BatchOptions, stages=StageNames)
    check_kind("batch", batch, BatchOptions, options=ReconstructOptions)
    out = Path(out)
    if isinstance(captures, str | os.PathLike):
        captures = read_manifest(captures, options, allow_stages=allow_stages)
    entries = list(captures)
    for i, entry in enumerate(entries):
        check_kind(f"captures[{i}]", entry, BatchCapture)
    check_unique(entries, out)
    out = out.resolve()
    with _own_folder(out) as run:
        at_work = _Batch([_task(entry, stages, out, run, batch) for entry in entries], watch)
        waiting = at_work.begin()
        if batch.scheduler is not None:
            pool = dask_pool(batch.scheduler)
        else:
            pool = local_pool(shares_of_this_machine(max(1, len(waiting)), batch.workers))
        try:
            if waiting:
                with pool as submit:
                    try:
                        at_work.follow({task.name: submit(task) for task in waiting})
                    except BaseException:
                        # workers anywhere find their run's file gone, and stop, too
                        (out / "status" / "run").unlink(missing_ok=True)
                        raise
        except BaseException:
            at_work.stop()
            raise
        finally:
            result = BatchResult(out=out, captures=at_work.statuses(), unchanged=not waiting)
            write_summary(result)
    return result


@contextlib.contextmanager
def _own_folder(out: Path) -> Iterator[str]:
    """Keep other batches out of the folder; yields the name of this run, which stands in a file as long as it goes on.

    Raises
    ------
    OutputExistsError, OutputError
    """
    status = out / "status"
    if out.exists() and not (out.is_dir() and (status.is_dir() or not any(out.iterdir()))):
        raise OutputExistsError(Fact("not-a-batch", out=str(out)))
    refuse_links(out)
    busy = Fact("batch-at-work", folder=str(out))
    with contextlib.ExitStack() as held:
        try:
            status.mkdir(parents=True, exist_ok=True)
            held.enter_context(locked(status / "lock", busy))
        except OSError as error:
            raise OutputError(Fact("folder-not-made", out=str(out), detail=str(error.strerror or error))) from error
        run = uuid.uuid4().hex
        write_text(status / "run", run)
        try:
            yield run
        finally:
            (status / "run").unlink(missing_ok=True)
            remove_temporaries(out, status)


def _task(entry: BatchCapture, of_all: StageNames, out: Path, run: str, batch: BatchOptions) -> CaptureTask:
    status = out / "status"
    config = status / f"{entry.name}.toml"
    stages = of_all if entry.stages is None else entry.stages
    job = Job(options=entry.options, project=entry.project, reference=entry.reference, stages=stages)
    write_text(config, config_as_toml(job))
    return CaptureTask(
        name=entry.name,
        capture=entry.path.resolve(),
        out=out / entry.name,
        config=config,
        status=status / f"{entry.name}.json",
        log=status / f"{entry.name}.log",
        run_file=status / "run",
        run=run,
        attempts=batch.attempts,
        gpu=needs_gpu(entry.options),
        overwrite=batch.overwrite,
    )


class _Batch:
    """The captures' statuses, as far as they are known here."""

    def __init__(self, tasks: Sequence[CaptureTask], watch: Watch) -> None:
        self._tasks = {task.name: task for task in tasks}
        self._known = {task.name: CaptureStatus(name=task.name, run=task.run) for task in tasks}
        self._watch = watch

    def begin(self) -> list[CaptureTask]:
        """The captures to work on: those without a result."""
        waiting = []
        for task in self._tasks.values():
            status = find_earlier_end(task) or self._known[task.name]
            write_status(task.status, status)
            self._set(status)
            if not status.finished:
                waiting.append(task)
        return waiting

    def follow(self, pending: dict[str, Pending]) -> None:
        """Wait until all are done, and tell what becomes of them."""
        while pending:
            for name in [name for name, future in pending.items() if future.done()]:
                self._end(name, pending.pop(name))
            # the running ones, and the next to run: reading thousands of files takes its time
            running = [name for name in pending if self._known[name].state == "running"]
            waiting = (name for name in pending if self._known[name].state == "waiting")
            for name in [*running, *itertools.islice(waiting, BATCH_TIMING.next_captures)]:
                status = read_status(self._tasks[name].status)
                if status is not None and status.state == "running":
                    self._set(status)
            until = time.monotonic() + BATCH_TIMING.progress_s
            while pending and time.monotonic() < until and not any(future.done() for future in pending.values()):
                time.sleep(BATCH_TIMING.done_s)

    def _end(self, name: str, pending: Pending) -> None:
        task = self._tasks[name]
        try:
            self._set(pending.result())
        except Exception as error:  # the worker was lost too often, or cannot run it, or the scheduler is gone
            known = read_status(task.status) or self._known[name]
            fault = describe_environment_fault(error)
            text = f"{type(error).__name__}: {error}".partition("\n")[0] if fault is None else fault.with_advice
            self._set(failed(known, Fact("no-worker-finished", detail=text)))
            write_status(task.status, self._known[name])

    def stop(self) -> None:
        """Mark what was neither finished nor stopped by its worker in time."""
        until = time.monotonic() + BATCH_TIMING.stop_s
        while time.monotonic() < until and any(map(_is_running, self._tasks.values())):
            time.sleep(BATCH_TIMING.progress_s)
        for task in self._tasks.values():
            status = read_status(task.status) or self._known[task.name]
            if not status.finished:
                status = replace(status, state="interrupted", stage="")
                write_status(task.status, status)
            self._set(status)

    def _set(self, status: CaptureStatus) -> None:
        if status != self._known[status.name]:
            self._known[status.name] = status
            self._watch(status)

    def statuses(self) -> tuple[CaptureStatus, ...]:
        """All, in the manifest's order."""
        return tuple(self._known.values())


def _is_running(task: CaptureTask) -> bool:
    status = read_status(task.status)
    return status is not None and status.state == "running"


def write_summary(result: BatchResult) -> None:
    """Write ``summary.json`` and ``summary.csv``: one row a capture, with the model that holds the most images."""
    counts = {state: sum(c.state == state for c in result.captures) for state in ("done", "failed", "interrupted")}
    write_json(result.out / "summary.json", {**counts, "captures": result.captures})
    text = io.StringIO()
    table = csv.DictWriter(text, _row(CaptureStatus(name="")), lineterminator="\n")
    table.writeheader()
    for row in map(_row, result.captures):
        table.writerow({key: cell(value) if isinstance(value, str) else value for key, value in row.items()})
    write_text(result.out / "summary.csv", text.getvalue())


def _row(capture: CaptureStatus) -> dict[str, object]:
    best = max(capture.models, key=lambda model: model["registered_images"], default={})
    low, high = best.get("ci95") or (None, None)
    return {
        "name": capture.name,
        "state": capture.state,
        "exit_code": capture.exit_code,
        **{name: best.get(name) for name in ("verdict", "metres_per_unit")},
        "ci95_low": low,
        "ci95_high": high,
        "registered_images": best.get("registered_images"),
        "frames": capture.frames,
        "models": len(capture.models),
        "scale_error_pct": best.get("scale_error_pct"),
        "seconds": round(capture.seconds, 1),
        **{name: getattr(capture, name) for name in ("attempts", "host", "error")},
    }


__all__ = [
    "BatchCapture",
    "BatchResult",
    "CaptureStatus",
    "needs_gpu",
    "read_manifest",
    "run_batch",
    "write_summary",
]
