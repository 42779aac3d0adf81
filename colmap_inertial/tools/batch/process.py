"""One capture of a batch, in a process: ``python -m colmap_inertial.tools.batch.process TASK CORES``."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from colmap_inertial.core.errors import InertialError, OutputExistsError, fact_of
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ProjectOptions, StageNames
from colmap_inertial.core.progress import Progress
from colmap_inertial.diagnose import Diagnosis
from colmap_inertial.hooks import load_stages
from colmap_inertial.io.files import locked, reading_within, write_text
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.commands.reconstruct_project import is_project, reconstruct_project
from colmap_inertial.run.steps.config import config_as_toml, read_config
from colmap_inertial.run.steps.workspace import Workspace
from colmap_inertial.tools.batch.task import (
    CaptureTask,
    Job,
    failed,
    kill_with_children,
    read_end,
    read_status,
    write_status,
)

#: The task's paths, which JSON carries as text.
_PATHS = ("capture", "out", "config", "status", "log", "run_file")


def main() -> None:
    """Reconstruct, and keep the status file up to date."""
    values: dict[str, Any] = json.loads(sys.argv[1])
    cores = [int(core) for core in sys.argv[2].split(",") if core]
    task = CaptureTask(**{**values, **{key: Path(values[key]) for key in _PATHS}})
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    if cores and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)
    known = read_status(task.status)
    if known is None:
        raise SystemExit(f"{task.status} cannot be read")
    status = known
    last, shown = 0.0, ""

    def progress(stage: str, done: int, total: int, /) -> None:
        nonlocal last, shown
        now = time.monotonic()
        if stage != shown or now - last >= 1.0:  # s: a file for every image would be too many
            last, shown = now, stage
            write_status(task.status, dataclasses.replace(status, stage=stage, steps_done=done, steps=total))

    def findings(diagnosis: Diagnosis) -> None:
        nonlocal status
        serious = (f for f in diagnosis.findings if f.severity != "info")
        texts = tuple(f"{f.severity}: {f.evidence}; {f.advice} ({f.code})" for f in serious)
        status = dataclasses.replace(status, findings=texts)
        write_status(task.status, status)

    try:
        _reconstruct(task, progress, findings)
        end = read_end(status, Workspace(task.out).result)
    except InertialError as error:
        print(f"error: {error}", file=sys.stderr)
        end = failed(status, fact_of(error), error.exit_code)
    except Exception as error:
        traceback.print_exc()
        end = failed(status, Fact("unexpected-error", kind=type(error).__name__, detail=str(error), log=str(task.log)))
    write_status(task.status, end)


def _reconstruct(task: CaptureTask, progress: Progress, findings: Callable[[Diagnosis], None]) -> None:
    job = read_config(task.config, Job)
    with reading_within(job.options.limits):
        existing = job.project != ProjectOptions() or is_project(task.capture)
    if existing and job.stages != StageNames(model=job.stages.model):
        raise InertialError(Fact("stages-before-a-model"))
    stages = load_stages(job.stages)
    workspace = Workspace(task.out)
    if task.overwrite or not workspace.result.exists():
        _write_stage_names(workspace, job.stages)
    if existing:
        reconstruct_project(
            task.capture,
            task.out,
            job.project,
            job.options,
            reference=job.reference,
            model_stages=stages.model,
            overwrite=task.overwrite,
            progress=progress,
            findings=findings,
        )
    else:
        reconstruct(
            task.capture,
            task.out,
            job.options,
            reference=job.reference,
            frame_stages=stages.frame,
            keypoint_stages=stages.keypoint,
            model_stages=stages.model,
            overwrite=task.overwrite,
            progress=progress,
            findings=findings,
        )


def _end_with_the_parent() -> None:
    """The pipe from the parent closes when the parent ends, whatever ended it."""
    os.read(sys.stdin.fileno(), 1)  # not through its buffer, whose lock would keep this process from ending in peace
    kill_with_children(os.getpid())


def _write_stage_names(workspace: Workspace, stages: StageNames) -> None:
    """Wait until nobody else is at work in the folder, and write down which stages it is made with.

    Before the work, for a process may be killed at any time; of a finished result, when they are its own. Whoever stays
    in the folder, or whatever else it holds, ``reconstruct`` complains about.
    """
    root = workspace.root
    vacant = not root.exists() or (root.is_dir() and not any(root.iterdir()))
    if workspace.stamps.is_dir() or (vacant and stages != StageNames()):
        with contextlib.suppress(OutputExistsError, OSError):
            workspace.stamps.mkdir(parents=True, exist_ok=True)
            # a worker that was lost may take as long to let go of the folder
            with locked(workspace.lock, Fact("run-at-work", folder=str(workspace.root)), wait_s=60.0):
                write_text(workspace.stage_names, config_as_toml(stages))


if __name__ == "__main__":
    main()
