"""The output folder: where everything lies, what is finished, and how a stage's output appears whole or not at all."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import errno
import fcntl
import functools
import hashlib
import json
import logging
import os
import shutil
import time
import types
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial import __version__
from colmap_inertial.errors import FormatError, InertialError, OutputError, OutputExistsError
from colmap_inertial.io.files import read_json, write_json
from colmap_inertial.report.content import CROPS_FOLDER, DATA_FOLDER

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Workspace:
    """Every path of an output folder, derived from its root."""

    root: Path

    @property
    def images(self) -> Path:
        """The frames that COLMAP sees."""
        return self.root / "images"

    @property
    def images_rectified(self) -> Path:
        """The same frames as a global shutter would have taken them, where the rolling shutter was undone."""
        return self.root / "images_rectified"

    @property
    def selection(self) -> Path:
        """Which frames of a video are used, and why."""
        return self.root / "selection.json"

    @property
    def imaging(self) -> Path:
        """Calibration from before the reconstruction, and what it means for each frame."""
        return self.root / "imaging.json"

    @property
    def frames(self) -> Path:
        """Names, times and treatment of the frames."""
        return self.root / "frames.json"

    @property
    def features(self) -> Path:
        """COLMAP's database before matching; removed at the end of a run."""
        return self.root / "features.db"

    @property
    def database(self) -> Path:
        """COLMAP's database."""
        return self.root / "database.db"

    @property
    def sparse(self) -> Path:
        """COLMAP's models, untouched."""
        return self.root / "sparse"

    @property
    def sparse_metric(self) -> Path:
        """The same models in metres."""
        return self.root / "sparse_metric"

    @property
    def project_metric(self) -> Path:
        """The whole project in metres, where an existing one was given."""
        return self.root / "project_metric"

    @property
    def dense_metric(self) -> Path:
        """Dense reconstructions of the metric models."""
        return self.root / "dense_metric"

    @property
    def validation(self) -> Path:
        """Pictures of the target in the frames."""
        return self.root / "validation"

    @property
    def diagnosis(self) -> Path:
        """What was found wrong with the recording before the reconstruction."""
        return self.root / "diagnosis.json"

    @property
    def apertures(self) -> Path:
        """Disparities and depths of a multi-aperture camera's frames, where they were asked for."""
        return self.root / "apertures"

    @property
    def report(self) -> Path:
        """For reading: everything in one page."""
        return self.root / "report.html"

    @property
    def report_data(self) -> Path:
        """What the report shows beside the results; with it, the report can be made again."""
        return self.root / DATA_FOLDER

    @property
    def crops(self) -> Path:
        """Parts of some frames before and after the frame stages."""
        return self.report_data / CROPS_FOLDER

    @property
    def result(self) -> Path:
        """Written last: its presence means that the run is finished."""
        return self.root / "result.json"

    @property
    def config(self) -> Path:
        """The resolved configuration, in the form that ``--config`` reads."""
        return self.root / "config.toml"

    @property
    def log(self) -> Path:
        """The run's log."""
        return self.root / "log.txt"

    @property
    def stamps(self) -> Path:
        """One JSON for each finished stage."""
        return self.root / ".stages"

    def trajectory(self, index: int, *, first: bool) -> Path:
        """The smoothed metric trajectory of a model; the first one has the plain name."""
        return self.root / ("trajectory.tum" if first else f"trajectory_{index}.tum")

    def open(self, capture: Path) -> None:
        """Create the folder, or take up a run of the same capture that is unfinished or waits for depth maps.

        Raises
        ------
        OutputExistsError
            When the folder holds a finished result, another capture's run, or something that is not ours.
        """
        owner = self.stamps / "capture.json"
        if self.result.exists() and not (owner.is_file() and read_json(self.result).get("waiting")):
            raise OutputExistsError(f"{self.root} holds a finished result; choose another folder or remove it")
        if self.root.exists() and not self.root.is_dir():
            raise OutputExistsError(f"{self.root} is a file; choose another output folder")
        identity = {"capture": str(capture.resolve())}
        if owner.is_file():
            if read_json(owner) != identity:
                raise OutputExistsError(
                    f"{self.root} holds an unfinished run of another capture ({read_json(owner).get('capture')}); "
                    "choose another folder or remove it"
                )
        elif self.root.is_dir() and any(p.name != self.stamps.name for p in self.root.iterdir()):
            raise OutputExistsError(f"{self.root} is not empty; choose another output folder")
        try:
            self.stamps.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.root} cannot be made: {error.strerror or error}") from error
        write_json(owner, identity)

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other runs out of the folder.

        Raises
        ------
        OutputExistsError
            While another run is at work in it.
        OutputError
            Where the disk is full.
        """
        with full_disk_is_an_error(self.root), open(self.stamps / "lock", "w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise OutputExistsError(
                    f"another run is at work in {self.root}; wait for it or choose another folder"
                ) from None
            yield


_MAKE_ROOM = "make room and start again, it continues"


@contextlib.contextmanager
def full_disk_is_an_error(root: Path, advice: str = _MAKE_ROOM) -> Iterator[None]:
    """Turn the system's complaint about a full disk (or a quota, or a limit of file sizes) into one of ours."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        raise OutputError(f"the disk of {root} is full ({error.strerror}); {advice}") from error


@contextlib.contextmanager
def a_record_of_ours(path: Path) -> Iterator[None]:
    """While a record of an earlier run is taken apart: what does not fit means that it was changed since."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise FormatError(path, f"was damaged since it was written ({error}); remove it and start again") from None


def require_room(folder: Path, num_bytes: int) -> None:
    """Raise :class:`OutputError` where the disk of ``folder`` has less room left than ``num_bytes``.

    For what COLMAP writes: its threads end the process when a database cannot grow, and its models end early.
    """
    free = shutil.disk_usage(folder).free
    if free < num_bytes:
        raise OutputError(
            f"the disk of {folder} is nearly full: {free / 1e6:.0f} MB are left, COLMAP's next step may need "
            f"{num_bytes / 1e6:.0f} MB; {_MAKE_ROOM}"
        )


def canonical(value: object) -> object:
    """A value in JSON types, for hashing: dataclasses by field, paths as text, functions by name, body and closure.

    A field that is declared with ``compare=False`` decides nothing and is left out.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: canonical(getattr(value, f.name)) for f in dataclasses.fields(value) if f.compare}
        return {"type": f"{type(value).__module__}.{type(value).__qualname__}", **fields}
    if isinstance(value, Mapping):
        return {str(k): canonical(v) for k, v in value.items()}
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, np.ndarray):
        return hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (list, tuple)):
        return [canonical(v) for v in value]
    if isinstance(value, (set, frozenset)):
        return sorted((canonical(v) for v in value), key=repr)
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, functools.partial):
        return ["partial", canonical(value.func), canonical(value.args), canonical(value.keywords)]
    if isinstance(value, types.FunctionType):
        cells = [canonical(cell.cell_contents) for cell in value.__closure__ or ()]
        defaults = canonical([value.__defaults__, value.__kwdefaults__])
        return [f"{value.__module__}.{value.__qualname__}", _code(value.__code__), cells, defaults]
    if isinstance(value, types.MethodType):
        return [canonical(value.__func__), canonical(value.__self__)]
    # Anything else may hide what decides its result: a key of its own, so that nothing made with it is ever kept.
    return f"{type(value).__module__}.{type(value).__qualname__} {uuid.uuid4()}"


def _code(code: types.CodeType) -> list[object]:
    """A function's body, without names of files and numbers of lines."""
    constants = [_code(c) if isinstance(c, types.CodeType) else repr(c) for c in code.co_consts]
    return [code.co_code.hex(), list(code.co_names), constants]


def fingerprint(path: Path) -> list[object]:
    """What identifies an input without reading it whole: names, sizes and modification times."""
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    stats = [(file, file.stat()) for file in files]
    return [[str(file.resolve()), stat.st_size, stat.st_mtime_ns] for file, stat in stats]


class StageRunner:
    """Runs stages in order and skips those whose inputs and options are those of an earlier, finished run.

    A stage's key hashes its options, its inputs and the key of the stage before it, so that a change anywhere reruns
    everything downstream. A folder's existence proves nothing: only a stamp with the right key does.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._upstream = ""
        self.seconds: dict[str, float] = {}

    def run(
        self, name: str, depends: Mapping[str, object], outputs: Sequence[Path], work: Callable[[list[Path]], None]
    ) -> None:
        """Run ``work`` unless its stamp holds.

        Parameters
        ----------
        name
            The stage.
        depends
            Everything that decides its output beside the stages before it.
        outputs
            What it writes. ``work`` gets temporary paths in their places, which are renamed when it returns.
        work
            Writes every temporary path; parent folders exist, the paths themselves do not.
        """
        text = json.dumps([name, __version__, self._upstream, canonical(depends)], sort_keys=True)
        self._upstream = hashlib.sha256(text.encode()).hexdigest()
        stamp = self._workspace.stamps / f"{name}.json"
        done = _read_stamp(stamp)
        if done is not None and done["key"] == self._upstream and all(path.exists() for path in outputs):
            self.seconds[name] = done["seconds"]
            log.info("%s: finished in an earlier run, kept", name)
            return
        stamp.unlink(missing_ok=True)
        for path in outputs:
            path.parent.mkdir(parents=True, exist_ok=True)
        partial = [path.with_name(f"{path.stem}.partial{path.suffix}") for path in outputs]
        for path in (*outputs, *partial):
            remove(path)
        log.info("%s: started", name)
        start = time.perf_counter()
        try:
            work(partial)
        except (InertialError, OSError):
            for path in partial:
                remove(path)
            raise
        for source, target in zip(partial, outputs, strict=True):
            os.replace(source, target)
        self.seconds[name] = time.perf_counter() - start
        write_json(stamp, {"key": self._upstream, "seconds": self.seconds[name]})
        log.info("%s: finished in %.1f s", name, self.seconds[name])


def _read_stamp(stamp: Path) -> dict[str, Any] | None:
    if not stamp.is_file():
        return None
    try:
        return read_json(stamp)
    except FormatError:
        return None


def remove(path: Path) -> None:
    """Remove a file or folder of our own, if it is there, with the side files of an SQLite database."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        for suffix in ("", "-journal", "-wal", "-shm"):
            path.with_name(path.name + suffix).unlink(missing_ok=True)
