"""A run from its lock to its log: what every command does around its own steps."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from colmap_inertial import __version__
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.printing import PrintableFormatter
from colmap_inertial.core.progress import Progress
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import (
    convert_to_plain,
    read_json,
    remove_temporaries,
    require_utf8,
    write_json,
    write_text,
)
from colmap_inertial.model import load_pycolmap
from colmap_inertial.run.steps.config import config_as_toml, list_changed_options
from colmap_inertial.run.steps.runner import StepRunner, find_loss
from colmap_inertial.run.steps.workspace import Workspace, require_apart

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class Session:
    """A run at work in its folder, which is its own until the end.

    Attributes
    ----------
    workspace
        The folder: where everything lies.
    runner
        Does the steps, or keeps them from an earlier run.
    context
        How the work is done: threads, seed, progress.
    config
        The options as TOML, for ``config.toml``.
    """

    workspace: Workspace
    runner: StepRunner
    context: RunContext
    config: str = ""

    @property
    def progress(self) -> Progress:
        """Receiver of the progress."""
        return self.context.progress

    def finish(self, content: Mapping[str, Any], write_report: Callable[[], None] = lambda: None) -> bool:
        """Write ``result.json``, whose presence says that the run is finished, after the report.

        Returns
        -------
        Whether there was nothing to do: all that is there is this result already.

        Raises
        ------
        OutputExistsError
            Where a finished result would lose steps.
        """
        known = _read_result(self.workspace)
        self.runner.leave_out(sorted(_list_kinds(known) - _list_kinds(content)))
        same = _without_times(known) == _without_times(convert_to_plain(content))
        unchanged = same and not self.runner.worked and not find_loss(self.workspace, ["report"])
        if not unchanged:
            write_report()
        write_text(self.workspace.config, self.config)
        if not unchanged:
            write_json(self.workspace.result, content)
        log.info("nothing to do" if unchanged else "finished")
        return unchanged


def _list_kinds(content: Mapping[str, Any]) -> set[str]:
    """The kinds of a result's steps, such as ``dense``: who makes the depth maps depends on the machine."""
    return {step.partition("_")[0] for step in content.get("seconds", ())}


def _without_times(content: Mapping[str, Any]) -> dict[str, Any]:
    """A result with the names of its steps alone."""
    return {**content, "seconds": sorted(content.get("seconds", ()))}


def _read_result(workspace: Workspace) -> dict[str, Any]:
    """Content of ``result.json``; empty where there is none, or a damaged one."""
    try:
        return read_json(workspace.result)
    except FormatError:
        return {}


@contextlib.contextmanager
def open_session(
    out: Path,
    source: Path,
    options: object,
    context: RunContext | None = None,
    *,
    pictures: Sequence[Path],
    command: str = "reconstruct",
    overwrite: bool = False,
) -> Iterator[Session]:
    """A session in ``out``: locked, its options written down, its log kept.

    Parameters
    ----------
    out
        A folder that does not exist, or holds a run on the same source, which is then continued.
    source
        The capture or project.
    options
        All that decides the result; a dataclass.
    context
        How the work is done; defaults serve. ``scratch`` becomes a folder in ``out``.
    pictures
        Folders that images are read from; ``out`` may not lie in one.
    command
        What is done; one folder is for one command.
    overwrite
        Make steps of a finished result again where they differ.

    Raises
    ------
    OutputExistsError
        When ``out`` holds something else, or another run is at work in it.
    OutputError
        Where it cannot be written, as on a full disk, or lies among the images.
    """
    require_utf8(out, source)
    require_apart(out, pictures)
    workspace, context, config = Workspace(out), context or RunContext(), config_as_toml(options)
    workspace.prepare(source, command)
    with workspace.locked():
        workspace.open(source, command)
        _remove_leftovers(workspace)
        with logging_to(workspace.log):
            log.info("colmap-inertial %s: %s -> %s", __version__, source, out)
            if not workspace.result.is_file():
                write_text(workspace.config, config)
            changes = list_changed_options(workspace.config, config)
            yield Session(
                workspace=workspace,
                runner=StepRunner(workspace, context.progress, overwrite=overwrite, changes=changes),
                context=replace(context, scratch=workspace.stamps),
                config=config,
            )


def _remove_leftovers(workspace: Workspace) -> None:
    """Remove what a killed run left under temporary names, such as small models."""
    remove_temporaries(workspace.root, workspace.stamps, workspace.report_data)
    for folder in workspace.stamps.glob("tmp*"):
        remove(folder)


@contextlib.contextmanager
def logging_to(path: Path) -> Iterator[None]:
    """Send this package's log to a file, and keep COLMAP's chatter off the terminal."""
    keep_colmap_quiet()
    logger = logging.getLogger("colmap_inertial")
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(PrintableFormatter())
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    except InertialError as error:
        log.error("%s", error)
        raise
    finally:
        logger.setLevel(level)
        logger.removeHandler(handler)
        handler.close()


def keep_colmap_quiet() -> None:
    """Keep COLMAP's chatter off the terminal, from now on."""
    load_pycolmap()
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
