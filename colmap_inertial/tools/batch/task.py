"""One capture of a batch, on whatever machine: a process of its own, watched, started again when it was killed.

A task carries paths and nothing else. What becomes of it stands in its status file, which the process at work keeps up
to date, so that progress shows wherever the files are seen.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from colmap_inertial.core.errors import FormatError, InertialError, OutputError, fact_of
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions, ReferenceOptions, StageNames
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.io.files import read_json, write_json
from colmap_inertial.run.steps.config import read_config
from colmap_inertial.run.steps.runner import find_loss
from colmap_inertial.run.steps.workspace import Workspace

State = Literal["waiting", "running", "done", "failed", "interrupted"]


@dataclass(frozen=True, kw_only=True)
class Job:
    """Options of a capture's reconstruction, as in its task's configuration file.

    Attributes
    ----------
    options
        As for ``reconstruct``.
    project
        For an existing COLMAP project: the IMU recording, and when its images were taken.
    reference
        Known lengths.
    stages
        The hooks.
    """

    options: ReconstructOptions = field(default_factory=ReconstructOptions)
    project: ProjectOptions = field(default_factory=ProjectOptions)
    reference: ReferenceOptions = field(default_factory=ReferenceOptions)
    stages: StageNames = field(default_factory=StageNames)


@dataclass(frozen=True, kw_only=True)
class CaptureTask:
    """Task of a worker; every path is absolute and the same on all machines.

    Attributes
    ----------
    name
        The capture's.
    capture, out
        What ``reconstruct`` takes.
    config
        A :class:`Job`, as TOML.
    status, log
        Where to write what becomes of it, and what its process says.
    run_file, run
        A file that holds ``run`` as long as this run of the batch goes on.
    attempts
        How often to start it in all, where its process or worker is killed.
    gpu
        Whether it is to have a GPU to itself.
    overwrite
        Whether steps of a finished result may be made again.
    """

    name: str
    capture: Path
    out: Path
    config: Path
    status: Path
    log: Path
    run_file: Path
    run: str
    attempts: int
    gpu: bool = False
    overwrite: bool = False


@prints_in_lines
@dataclass(frozen=True, kw_only=True)
class CaptureStatus:
    """Outcome of one capture; the same as its status file.

    Attributes
    ----------
    name
        The capture's.
    state
        ``"done"``: its exit code is 0. ``"failed"``: any other end. ``"interrupted"``: stopped with the batch.
    exit_code
        That of ``reconstruct``: 0 done, 1 target outside its tolerance or an error in the program, 2 bad input,
        3 scale refused, 4 mapping failed, 5 target not found.
    error
        One sentence, where it failed.
    attempts
        How often its process was started in this run.
    seconds
        From the first of these starts to the end.
    stage, steps_done, steps
        What it is at, while it runs.
    host
        Where.
    models
        From ``result.json``: for each model its number, verdict, metres per unit with interval, images and checks.
    frames
        Frames of the capture.
    findings
        Errors and warnings of the check beforehand, in words.
    run
        Which run of the batch wrote this.
    """

    name: str
    state: State = "waiting"
    exit_code: int | None = None
    error: str | None = None
    attempts: int = 0
    seconds: float = 0.0
    stage: str = ""
    steps_done: int = 0
    steps: int = 0
    host: str = ""
    models: tuple[Mapping[str, Any], ...] = ()
    frames: int | None = None
    findings: tuple[str, ...] = ()
    run: str = field(default="", compare=False)

    @property
    def finished(self) -> bool:
        """Whether it ended by itself."""
        return self.state in ("done", "failed")


def read_status(path: Path) -> CaptureStatus | None:
    """The status in a file; ``None`` where there is none."""
    try:
        values = read_json(path)
        lists = {key: tuple(values.get(key, ())) for key in ("models", "findings")}
        return CaptureStatus(**{**values, **lists})
    except (FormatError, TypeError):
        return None


def write_status(path: Path, status: CaptureStatus) -> None:
    """Write it, if that is possible: a full disk shall not hide what is to be said."""
    with contextlib.suppress(OutputError):
        write_json(path, status)


def failed(status: CaptureStatus, why: Fact, exit_code: int = 1) -> CaptureStatus:
    """The status of a capture that ended with an error."""
    return dataclasses.replace(status, state="failed", exit_code=exit_code, error=why.with_advice, stage="")


def find_earlier_end(task: CaptureTask) -> CaptureStatus | None:
    """The end of a capture that has one already; ``None`` where there is work to do, or other options are given.

    What ``reconstruct`` does then with a finished result, it decides itself.
    """
    workspace, known = Workspace(task.out), read_status(task.status)
    if not workspace.result.exists():
        return None
    status = CaptureStatus(name=task.name) if known is None else known
    try:
        job = read_config(task.config, Job)
    except FormatError as error:
        return failed(status, fact_of(error), error.exit_code)
    try:
        result, may_go = read_json(workspace.result), (workspace.images, workspace.colmap)
        made_from = Path(str(read_json(workspace.owner).get("capture")))
        same = (
            (made_from == task.capture or task.capture in made_from.parents)
            and read_config(workspace.config, ReconstructOptions) == job.options
            and result.get("project", _plain(ProjectOptions())) == _plain(job.project)
            and result.get("reference", _plain(ReferenceOptions())) == _plain(job.reference)
            and read_stage_names(workspace) == job.stages
        )
        lost = find_loss(workspace, [*result.get("seconds", ()), "report"], but=may_go)
        return None if result.get("waiting") or lost or not same else read_end(status, workspace.result)
    except FormatError:
        return None  # damaged: the run makes it again, or says what to do


def read_stage_names(workspace: Workspace) -> StageNames:
    """The stages that a folder is made with, as the process at work wrote them down."""
    return read_config(workspace.stage_names, StageNames) if workspace.stage_names.is_file() else StageNames()


def _plain(options: ProjectOptions | ReferenceOptions) -> object:
    return json.loads(json.dumps(dataclasses.asdict(options), default=str))


def read_end(status: CaptureStatus, result: Path) -> CaptureStatus:
    """The status of a capture whose ``result.json`` is there, by the rules of ``ReconstructResult.exit_code``."""
    values = read_json(result)
    try:
        models = tuple(_model(model) for model in values["models"])
        frames = len(values["frames"]) or None  # an existing project counts none
    except (KeyError, TypeError, AttributeError):
        raise FormatError(result, Fact("not-a-result")) from None
    code, error = _verdict(models)
    state: State = "failed" if code else "done"
    return dataclasses.replace(
        status, state=state, exit_code=code, error=error, models=models, frames=frames, stage="", steps_done=0, steps=0
    )


def _model(values: Mapping[str, Any]) -> dict[str, Any]:
    kept = ("index", "verdict", "metres_per_unit", "ci95", "reasons", "registered_images", "points", "sparse_metric")
    check = values["validation"]
    return {
        **{key: values[key] for key in kept},
        "waiting": (values.get("dense") or {}).get("waiting"),
        "scale_error_pct": None if check is None else check.get("scale_error_pct"),
        "within_tolerance": None if check is None else check.get("within_tolerance"),
        "validation_error": None if check is None else check.get("error"),
    }


def _verdict(models: Sequence[Mapping[str, Any]]) -> tuple[int, str | None]:
    if all(model["sparse_metric"] is None for model in models):
        return 3, "scale refused: " + "; ".join(reason for model in models for reason in model["reasons"])
    waiting = [model["waiting"] for model in models if model["waiting"]]
    if waiting:
        return InertialError.exit_code, "; ".join(waiting)
    outside = [model for model in models if model["within_tolerance"] is False]
    if outside:
        return 1, f"the target is outside its tolerance: scale error {outside[0]['scale_error_pct']:+.2f} %"
    # a target that could not be measured leaves a scale as good as it was: the summary says so
    return 0, None


def run_capture(task: CaptureTask, cores: Sequence[int] = ()) -> CaptureStatus:
    """Reconstruct one capture in a process of its own; also what a worker of a cluster calls.

    Never raises for what goes wrong in the capture. The process ends with this one, however that ends.

    Parameters
    ----------
    task
        The capture.
    cores
        Processors that the process may use; all that this process may use, where empty.
    """
    host = socket.gethostname()
    status = CaptureStatus(name=task.name, host=host, run=task.run)
    if not task.config.is_file():
        return failed(status, Fact("worker-sees-no-files", worker=host, path=str(task.config)), 2)
    earlier = find_earlier_end(task)
    if earlier is not None:
        write_status(task.status, earlier)
        return earlier
    known = read_status(task.status)
    if known is not None and known.run == task.run:
        status = dataclasses.replace(known, host=host)  # another worker had it and was lost
    start = time.monotonic() - status.seconds
    while True:
        if status.attempts >= task.attempts:
            status = failed(status, Fact("capture-killed", times=status.attempts, log=str(task.log)))
            break
        status = dataclasses.replace(status, state="running", attempts=status.attempts + 1, stage="")
        write_status(task.status, status)
        code = _attend(task, cores)
        known = read_status(task.status)
        if known is not None and known.run == task.run:
            status = known
        status = dataclasses.replace(status, seconds=time.monotonic() - start)
        if code is None:
            status = dataclasses.replace(status, state="interrupted", stage="")
            break
        if status.finished:
            break
        if code >= 0:
            status = failed(status, Fact("capture-process-ended", exit_code=code, log=str(task.log)))
            break
    write_status(task.status, status)
    return status


def is_wanted(task: CaptureTask) -> bool:
    """Whether this run of the batch still wants the capture."""
    try:
        return task.run_file.read_text(encoding="utf-8") == task.run
    except OSError:
        return False


def kill_with_children(pid: int) -> None:
    """Kill a process that :func:`run_capture` started and all that it started; where there are no groups, it alone."""
    if hasattr(os, "killpg"):
        os.killpg(pid, signal.SIGKILL)
    else:
        os.kill(pid, signal.SIGTERM)


def _attend(task: CaptureTask, cores: Sequence[int]) -> int | None:
    """Start the process and wait for it: its return code, or ``None`` where the batch was stopped meanwhile."""
    argument = json.dumps(dataclasses.asdict(task), default=str)
    environment = dict(os.environ)
    if cores:
        environment |= {"OMP_NUM_THREADS": str(len(cores)), "OPENBLAS_NUM_THREADS": str(len(cores))}
    command = [sys.executable, "-m", "colmap_inertial.tools.batch.process", argument, ",".join(map(str, cores))]
    with open(task.log, "ab") as log:
        # A session of its own keeps the terminal's Ctrl-C away from it; the open pipe tells it that we are alive.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
        )
    try:
        while True:
            try:
                return process.wait(timeout=0.25)
            except subprocess.TimeoutExpired:
                if not is_wanted(task):
                    return None
    finally:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            kill_with_children(process.pid)
        process.wait()
        if process.stdin is not None:
            process.stdin.close()
