"""A run from its lock to its log: what every driver does around its own steps."""

from __future__ import annotations

import contextlib
import importlib.metadata
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from colmap_inertial import __version__
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.printing import PrintableFormatter
from colmap_inertial.core.progress import Progress, tell
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
from colmap_inertial.run.steps.config import config_as_toml
from colmap_inertial.run.steps.replacing import (
    drop_beside,
    is_finished,
    is_made_of,
    list_changed_options,
    moved,
    place_beside,
    replace_result,
)
from colmap_inertial.run.steps.runner import StepRunner, find_loss, hash_values
from colmap_inertial.run.steps.workspace import Workspace, require_apart

log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True, eq=False, kw_only=True)
class Session:
    """A run at work in its folder, which is its own until the end.

    Attributes
    ----------
    workspace
        The folder.
    runner
        Does the steps, or keeps them from an earlier run.
    context
        How the work is done.
    out
        The folder that was asked for, where that is another one until the end.
    """

    workspace: Workspace
    runner: StepRunner
    context: RunContext
    out: Path | None = None

    def in_place(self, value: T) -> T:
        """The result of a run, with its paths after the end."""
        return value if self.out is None else moved(value, self.workspace.root, self.out)

    @property
    def progress(self) -> Progress:
        """Receiver of the progress."""
        return self.context.progress

    def stands(self, content: Mapping[str, object]) -> bool:
        """Whether an earlier run's ``result.json`` holds this result already, and nothing had to be made again."""
        if self.runner.worked or find_loss(self.workspace, ["report"]):
            return False
        try:
            known = read_json(self.workspace.result)
        except FormatError:
            return False
        return {**known, "seconds": {}} == convert_to_plain({**content, "seconds": {}})

    def finish(self, content: Mapping[str, object]) -> bool:
        """Write ``result.json``, whose presence says that the run is finished; returns whether it stood already."""
        unchanged = self.stands(content)
        if not unchanged:
            self.runner.settle()
            write_json(self.workspace.result, content)
        log.info("nothing to do" if unchanged else "finished")
        return unchanged


@contextlib.contextmanager
def open_session(
    out: Path,
    source: Path,
    options: object,
    context: RunContext | None = None,
    *,
    pictures: Sequence[Path],
    decides: object = None,
    command: str = "reconstruct",
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
        Folders that pictures are read from; ``out`` may not lie in one.
    decides
        What decides the result beside the options: the recording, and stages that were given.
    command
        What is done; one folder is for one command.

    Raises
    ------
    OutputExistsError
        When ``out`` holds something else, or another run is at work in it.
    OutputError
        Where it cannot be written, as on a full disk, or lies among the pictures.
    """
    require_utf8(out, source)
    require_apart(out, pictures)
    workspace = Workspace(out)
    workspace.prepare(source, command)
    with contextlib.ExitStack() as stack:
        stack.enter_context(workspace.locked())
        workspace.open(source, command)
        remove_temporaries(workspace.root, workspace.stamps, workspace.report_data)
        replace_result(workspace)
        for steps in workspace.stamps, workspace.stamps / "next" / workspace.stamps.name:
            for folder in steps.glob("tmp*"):  # small models of a run that was killed
                remove(folder)
        stack.enter_context(logging_to(workspace.log))
        log.info("colmap-inertial %s: %s -> %s", __version__, source, out)
        context, config, inputs = context or RunContext(), config_as_toml(options), hash_values(decides)
        beside = workspace
        if is_finished(workspace) and not is_made_of(workspace, config, inputs):
            stack.enter_context(_earlier_result_stays(out))
            changes = (
                "; ".join(list_changed_options(workspace.config, config))
                or "the recording or what is made of it changed"
            )
            tell(context.progress, f"{changes}: the result in {out} stays until the new one is whole")
            beside = place_beside(workspace, config, inputs)
            beside.open(source, command)
        else:
            drop_beside(workspace)
        if not is_made_of(beside, config, inputs):
            beside.unfinish()
            write_text(beside.config, config)
            write_json(beside.inputs, {"inputs": inputs})
        runner = StepRunner(beside, context.progress)
        yield Session(
            workspace=beside,
            runner=runner,
            context=replace(context, scratch=beside.stamps),
            out=None if beside is workspace else out,
        )
        replace_result(workspace)


@contextlib.contextmanager
def _earlier_result_stays(out: Path) -> Iterator[None]:
    try:
        yield
    except InertialError as error:
        error.add_note(str(Fact("earlier-result-stays", out=str(out))))
        raise


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


#: By module, the distributions that bring it.
_PROVIDERS: Mapping[str, tuple[str, ...]] = {
    "pycolmap": ("pycolmap", "pycolmap-cuda12", "pycolmap-cuda11", "pycolmap-cuda"),
    "cv2": (
        "opencv-contrib-python-headless",
        "opencv-contrib-python",
        "opencv-python-headless",
        "opencv-python",
    ),
}


def conflicts() -> list[str]:
    """A sentence for each module that several installed distributions bring, on what to do."""
    clashes = []
    for module, names in _PROVIDERS.items():
        there = [f"{name} {version}" for name in names if (version := _version(name)) is not None]
        if len(there) > 1:
            kept = there[-1].split()[0] if module == "pycolmap" else there[0].split()[0]
            every = " ".join(word.split()[0] for word in there)
            clashes.append(
                f"{' and '.join(there)} are installed, and each brings the module {module}: the files of the last one "
                f"overwrote the others'; keep one of them: pip uninstall {every}; pip install {kept}"
            )
    return clashes


def warn_of_conflicts() -> None:
    """Log conflicts of installed packages, before they cause failures that do not name them."""
    for sentence in conflicts():
        log.warning("%s", sentence)


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
