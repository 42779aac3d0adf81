"""The process that reconstructs one capture of a batch: ``python -m colmap_inertial.batch.process TASK CORES``."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import Any

from colmap_inertial.batch.task import CaptureTask, Job, failed, read_status, with_result, write_status
from colmap_inertial.drivers.capture import reconstruct
from colmap_inertial.drivers.project import is_project, reconstruct_project
from colmap_inertial.errors import InertialError
from colmap_inertial.options import ProjectOptions
from colmap_inertial.run.config import read_config
from colmap_inertial.run.workspace import Workspace

#: The task's paths, which JSON carries as text.
_PATHS = ("capture", "out", "config", "status", "log", "run_file")
#: Progress is written no more often than this.
_PROGRESS_S = 1.0
#: A worker that was lost may still be letting go of the folder for this long.
_LOCK_S = 60.0


def main() -> None:
    """Reconstruct, and keep the status file up to date."""
    values: dict[str, Any] = json.loads(sys.argv[1])
    cores = [int(core) for core in sys.argv[2].split(",") if core]
    task = CaptureTask(**{**values, **{key: Path(values[key]) for key in _PATHS}})
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    if cores:
        os.sched_setaffinity(0, cores)
    status = read_status(task.status)
    if status is None:
        raise SystemExit(f"{task.status} cannot be read")
    last = 0.0

    def progress(stage: str, done: int, total: int, /) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= _PROGRESS_S:
            last = now
            write_status(task.status, dataclasses.replace(status, stage=stage, steps_done=done, steps=total))

    workspace = Workspace(task.out)
    try:
        _wait_for(workspace)
        job = read_config(task.config, Job)
        if job.project != ProjectOptions() or is_project(task.capture):
            reconstruct_project(task.capture, task.out, job.project, job.options, progress=progress)
        else:
            reconstruct(task.capture, task.out, job.options, progress=progress)
        end = with_result(status, workspace.result)
    except InertialError as error:
        print(f"error: {error}", file=sys.stderr)
        end = failed(status, str(error), error.exit_code)
    except Exception as error:
        traceback.print_exc()
        end = failed(status, f"{type(error).__name__}: {error} (see {task.log})")
    write_status(task.status, end)


def _end_with_the_parent() -> None:
    """The pipe from the parent closes when the parent ends, whatever ended it."""
    sys.stdin.buffer.read()
    os.killpg(os.getpgid(0), signal.SIGKILL)


def _wait_for(workspace: Workspace) -> None:
    """Wait until nobody else is at work in the folder; ``reconstruct`` complains if somebody stays."""
    lock = workspace.stamps / "lock"
    until = time.monotonic() + _LOCK_S
    while lock.exists() and time.monotonic() < until:
        with open(lock) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                time.sleep(0.5)


if __name__ == "__main__":
    main()
