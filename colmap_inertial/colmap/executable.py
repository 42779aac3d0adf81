"""An installed COLMAP: its version, the options that it has, and runs of its commands.

Versions of COLMAP moved options between sections; so its own help is read, and names are looked up there.
"""

from __future__ import annotations

import contextlib
import ctypes
import difflib
import logging
import os
import re
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from colmap_inertial.colmap.settings import ColmapSettings, Step
from colmap_inertial.core.errors import FormatError, InertialError, MappingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.printing import printable
from colmap_inertial.io.fingerprints import fingerprint

_logger = logging.getLogger(__name__)

#: What COLMAP finds and matches features on.
Device = Literal["cpu", "cuda"]


@dataclass(frozen=True, kw_only=True)
class _Command:
    """A command of COLMAP that is run here.

    Attributes
    ----------
    needs
        Options that it must have.
    step
        Settings of the user that it takes.
    sections
        Where its options are, by version.
    """

    needs: tuple[str, ...]
    step: Step | None = None
    sections: tuple[str, ...] = ()


_COMMANDS = {
    "database_creator": _Command(needs=("database_path",)),
    "mapper": _Command(needs=("database_path", "image_path", "output_path"), step="mapping", sections=("Mapper",)),
    "feature_extractor": _Command(
        needs=("database_path", "image_path", "image_list_path"),
        step="features",
        sections=("FeatureExtraction", "SiftExtraction"),
    ),
    "matches_importer": _Command(
        needs=("database_path", "match_list_path", "match_type"),
        step="matches",
        sections=("FeatureMatching", "SiftMatching"),
    ),
}
#: What pycolmap does.
_NOT_TAKEN = ("TwoViewGeometry.", "GlobalMapper.")
_VERSION = re.compile(r"COLMAP (\d[\w.-]*)")
_OPTION = re.compile(r"^\s*--([\w.]+)", re.MULTILINE)


@dataclass(frozen=True, kw_only=True)
class _Limits:
    """Limits of what a program may take and say."""

    #: A help that takes longer or is longer is none of COLMAP's.
    help_s: float = 30.0
    help_bytes: int = 1 << 20
    #: A program that is asked to end is killed after so long.
    end_s: float = 5.0
    #: Of one that failed, so many lines are shown; longer lines are cut.
    shown_lines: int = 3
    line_bytes: int = 4096
    #: Linux's PR_SET_PDEATHSIG: the signal that a process gets when the one that started it ends.
    parent_death_signal: int = 1


_LIMITS = _Limits()


@dataclass(frozen=True, kw_only=True)
class ColmapExecutable:
    """An installed COLMAP.

    Attributes
    ----------
    path
        The program.
    version
        As it says.
    device
        What it finds and matches features on.
    options
        Names of its options, by command.
    settings
        What the user set of them.
    """

    path: Path
    version: str
    device: Device
    options: Mapping[str, frozenset[str]]
    settings: ColmapSettings

    def identity(self) -> list[object]:
        """Values that decide what it makes."""
        return [self.version, self.device, *fingerprint(self.path)]

    def arguments(self, command: str, own: Mapping[str, object]) -> dict[str, object]:
        """Options of a command by their names there: of ours, those that it has; and those that the user set.

        Raises
        ------
        InertialError
            For a setting that this COLMAP does not have.
        """
        step, known = _COMMANDS[command].step, self.options[command]
        named = {there: value for name, value in own.items() if (there := self._find(command, name))}
        for text in self.settings.of(step) if step else ():
            name, _, value = text.partition("=")
            if name.startswith(_NOT_TAKEN):
                continue
            there = name if name in known else self._find(command, name.partition(".")[2])
            if there is None:
                near = difflib.get_close_matches(name, known, n=1)
                raise InertialError(
                    Fact(
                        "not-an-option-of-colmap",
                        setting=text,
                        version=self.version,
                        program=str(self.path),
                        nearest=next(iter(near), None),
                    )
                )
            named[there] = value
        return named

    def _find(self, command: str, option: str) -> str | None:
        """The name of an option in this version; before there were rigs, frames were images."""
        names = [f"{section}.{option}" for section in _COMMANDS[command].sections]
        names += [name.replace("frames", "images") for name in names] + [option]
        return next((name for name in names if name in self.options[command]), None)

    def run(
        self,
        command: str,
        arguments: Mapping[str, object],
        log: Path,
        read_line: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Run a command; it ends with this process, and where this raises.

        Parameters
        ----------
        arguments
            Values by names of options.
        log
            A file that takes what it prints; an earlier one is replaced.
        read_line
            Is called with each line.

        Raises
        ------
        MappingError
            Where it fails or is killed, with its last lines.
        """
        _logger.info("%s %s (COLMAP %s), into %s", self.path, command, self.version, log)
        log.unlink(missing_ok=True)  # it may be a link to an earlier run's
        words = [word for name, value in arguments.items() for word in (f"--{name}", str(value))]
        last: deque[str] = deque(maxlen=_LIMITS.shown_lines)
        with open(log, "w", encoding="utf-8") as file, _start_process([str(self.path), command, *words]) as process:
            for line in _lines(process):
                file.write(line + "\n")
                if line.strip():
                    last.append(line.strip())
                read_line(line)
            code = process.wait()
        if code:
            named = {"program": str(self.path), "command": command, "version": self.version}
            raise MappingError(Fact("colmap-failed", **named, exit_code=code, output=tuple(last), log=str(log)))


def read_executable(
    path: Path, mapping: MappingOptions, settings: ColmapSettings, *, deterministic: bool
) -> ColmapExecutable:
    """Ask an installed COLMAP what it is and which options it has.

    Raises
    ------
    FormatError
        For a file that is missing, cannot be run, or is not COLMAP, and for a COLMAP that lacks what is needed here.
    InertialError
        For options that it does not have, or that go with pycolmap alone.
    """
    path = Path(os.path.abspath(path))
    if not path.is_file():
        raise FormatError(path, Fact("colmap-executable-missing"))
    if not os.access(path, os.X_OK):
        raise FormatError(path, Fact("colmap-executable-not-to-run"))
    if deterministic:
        raise InertialError(Fact("deterministic-without-pycolmap"))
    if mapping.features != "sift":
        raise InertialError(Fact("features-without-pycolmap", features=mapping.features))
    about = _ask(path, "help")
    version = _VERSION.search(about)
    if version is None:
        lines = about.strip().splitlines() or ["nothing"]
        raise FormatError(path, Fact("not-colmap", printed=lines[0][:80]))
    has_cuda = re.search(r"\bwith CUDA\b", about) is not None
    if mapping.device == "cuda" and not has_cuda:
        raise InertialError(Fact("colmap-without-cuda", program=str(path)))
    options = {name: frozenset(_OPTION.findall(_ask(path, name, "-h"))) for name in _COMMANDS}
    for name, command in _COMMANDS.items():
        missing = [f"--{option}" for option in command.needs if option not in options[name]]
        if missing:
            raise FormatError(path, Fact("colmap-lacks-options", version=version[1], command=name, options=missing))
    device: Device = "cuda" if has_cuda and mapping.device != "cpu" else "cpu"
    executable = ColmapExecutable(path=path, version=version[1], device=device, options=options, settings=settings)
    for name in _COMMANDS:
        executable.arguments(name, {})
    return executable


def _ask(path: Path, *words: str) -> str:
    with _start_process([str(path), *words]) as process:
        timer = threading.Timer(_LIMITS.help_s, _end, [process])
        timer.start()
        try:
            assert process.stdout is not None
            text = process.stdout.read(_LIMITS.help_bytes)
        finally:
            timer.cancel()
    return printable(text.decode(errors="replace"))


def _lines(process: subprocess.Popen[bytes]) -> Iterator[str]:
    assert process.stdout is not None
    for line in iter(lambda: process.stdout.readline(_LIMITS.line_bytes), b""):  # type: ignore[union-attr]
        yield printable(line.decode(errors="replace").rstrip())


@contextlib.contextmanager
def _start_process(words: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A process whose output is one pipe; it has ended afterwards."""
    try:
        # a session of its own keeps the terminal's Ctrl-C away
        process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=_end_with_parent(),
        )
    except OSError as error:
        raise FormatError(words[0], Fact("program-not-run", detail=error.strerror)) from error
    with process:
        try:
            yield process
        finally:
            _end(process)


def _end_with_parent() -> Callable[[], object] | None:
    """What a child calls so that the kernel ends it where this process is killed; Linux alone has that."""
    if not sys.platform.startswith("linux"):
        return None
    libc = ctypes.CDLL(None)
    return lambda: libc.prctl(_LIMITS.parent_death_signal, signal.SIGKILL)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process and those that it started."""
    if process.poll() is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(_LIMITS.end_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
