"""An installed COLMAP: its version, the options that it has, and runs of its commands.

Versions of COLMAP moved options between sections; so its own help is read, and names are looked up there.
"""

from __future__ import annotations

import contextlib
import ctypes
import difflib
import os
import re
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from colmap_inertial.core.errors import FormatError, InertialError, MappingError
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.printing import printable
from colmap_inertial.pipeline.run.colmap_settings import ColmapSettings, Step
from colmap_inertial.pipeline.run.runner import fingerprint

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
#: Matches are verified by pycolmap, with its options.
_NOT_TAKEN = "TwoViewGeometry."
_VERSION = re.compile(r"COLMAP (\d[\w.-]*)")
_OPTION = re.compile(r"^\s*--([\w.]+)", re.MULTILINE)
#: A help that takes longer or is longer is none of COLMAP's.
_HELP_S, _HELP_BYTES = 30.0, 1 << 20
#: A command that is asked to end is killed after so long.
_END_S = 5.0
#: Of a command that failed, so many lines are told; and of its lines, so many bytes.
_TOLD_LINES, _LINE_BYTES = 3, 4096
#: Linux's PR_SET_PDEATHSIG: the signal that a process gets when the one that started it ends.
_PARENT_DEATH_SIGNAL = 1


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
    """

    path: Path
    version: str
    device: Device
    options: Mapping[str, frozenset[str]]

    def identity(self) -> list[object]:
        """Values that decide what it makes."""
        return [self.version, self.device, *fingerprint(self.path)]

    def arguments(self, command: str, own: Mapping[str, object], settings: ColmapSettings) -> dict[str, object]:
        """Options of a command by their names there: of ours, those that it has; and those that the user set.

        Raises
        ------
        InertialError
            For a setting that this COLMAP does not have.
        """
        step, known = _COMMANDS[command].step, self.options[command]
        named = {found: value for name, value in own.items() if (found := self._find(command, name))}
        for text in settings.of(step) if step else ():
            name, _, value = text.partition("=")
            if name.startswith(_NOT_TAKEN):
                continue
            found = name if name in known else self._find(command, name.partition(".")[2])
            if found is None:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"; did you mean {near[0]}?" if near else ""
                raise InertialError(f"--colmap {text}: COLMAP {self.version} ({self.path}) has no such option{hint}")
            named[found] = value
        return named

    def _find(self, command: str, option: str) -> str | None:
        names = [f"{section}.{option}" for section in _COMMANDS[command].sections]
        return next((name for name in names if name in self.options[command]), None)

    def run(
        self,
        command: str,
        arguments: Mapping[str, object],
        log: Path,
        heard: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Run a command; it ends with this process, and where this raises.

        Parameters
        ----------
        arguments
            Values by names of options.
        log
            A file that takes what it prints; an earlier one is replaced.
        heard
            Is called with each line.

        Raises
        ------
        MappingError
            Where it fails or is killed, with its last lines.
        """
        log.unlink(missing_ok=True)  # it may be a link to an earlier run's
        words = [word for name, value in arguments.items() for word in (f"--{name}", str(value))]
        last: deque[str] = deque(maxlen=_TOLD_LINES)
        with open(log, "w", encoding="utf-8") as file, _started([str(self.path), command, *words]) as process:
            for line in _lines(process):
                file.write(line + "\n")
                if line.strip():
                    last.append(line.strip())
                heard(line)
            code = process.wait()
        if code:
            what = f"was killed (signal {-code})" if code < 0 else f"failed with exit code {code}"
            said = " | ".join(last) or "it printed nothing"
            raise MappingError(f"{self.path} {command} (COLMAP {self.version}) {what}: {said}; all of it is in {log}")


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
        raise FormatError(path, "no such file: --colmap-executable takes the path of COLMAP's program (`which colmap`)")
    if not os.access(path, os.X_OK):
        raise FormatError(path, "may not be run: make it executable (chmod +x), or give COLMAP's program")
    if deterministic:
        raise InertialError(
            "--deterministic goes with pycolmap alone: an installed COLMAP may find other features and matches each "
            "time (3.8 does); leave --colmap-executable out"
        )
    if mapping.features != "sift":
        raise InertialError(
            f"--mapping.features {mapping.features} goes with pycolmap alone: leave --colmap-executable out, or find "
            "and match features with it yourself, and give its database with --database"
        )
    about = _ask(path, "help")
    version = _VERSION.search(about)
    if version is None:
        said = about.strip().splitlines()
        raise FormatError(path, f"is not COLMAP: `help` prints {said[0][:80]!r}" if said else "is not COLMAP: no help")
    has_cuda = re.search(r"\bwith CUDA\b", about) is not None
    if mapping.device == "cuda" and not has_cuda:
        raise InertialError(f"--mapping.device cuda: {path} is built without CUDA; leave it out")
    options = {name: frozenset(_OPTION.findall(_ask(path, name, "-h"))) for name in _COMMANDS}
    for name, command in _COMMANDS.items():
        missing = [f"--{option}" for option in command.needs if option not in options[name]]
        if missing:
            raise FormatError(path, f"COLMAP {version[1]}: its {name} has no {', '.join(missing)}, needed here")
    device: Device = "cuda" if has_cuda and mapping.device != "cpu" else "cpu"
    executable = ColmapExecutable(path=path, version=version[1], device=device, options=options)
    for name in _COMMANDS:
        executable.arguments(name, {}, settings)
    return executable


def _ask(path: Path, *words: str) -> str:
    with _started([str(path), *words]) as process:
        timer = threading.Timer(_HELP_S, _end, [process])
        timer.start()
        try:
            assert process.stdout is not None
            text = process.stdout.read(_HELP_BYTES)
        finally:
            timer.cancel()
    return printable(text.decode(errors="replace"))


def _lines(process: subprocess.Popen[bytes]) -> Iterator[str]:
    assert process.stdout is not None
    for line in iter(lambda: process.stdout.readline(_LINE_BYTES), b""):  # type: ignore[union-attr]
        yield printable(line.decode(errors="replace").rstrip())


@contextlib.contextmanager
def _started(words: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A process whose output is one pipe; it has ended afterwards."""
    libc = ctypes.CDLL(None)
    try:
        # a session of its own keeps the terminal's Ctrl-C away; the kernel ends it where this process is killed
        process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=lambda: libc.prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL),
        )
    except OSError as error:
        raise FormatError(words[0], f"cannot be run: {error.strerror}; give COLMAP's program") from error
    with process:
        try:
            yield process
        finally:
            _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process and those that it started."""
    if process.poll() is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
