"""Steps in order, those that are done already skipped, each output whole or absent."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import functools
import hashlib
import json
import logging
import os
import time
import types
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial import __version__
from colmap_inertial.core.errors import FormatError, InertialError, fact_of
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.progress import HearsSteps, Progress, silent, tell
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import read_record, write_record
from colmap_inertial.io.fingerprints import digest_of_file
from colmap_inertial.run.steps.workspace import Workspace

log = logging.getLogger(__name__)


def canonical(value: object) -> object:
    """A value in JSON types, for hashing: dataclasses by field, paths as text, functions by name, body and closure.

    A field that is declared with ``compare=False`` decides nothing and is left out.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: canonical(getattr(value, f.name)) for f in dataclasses.fields(value) if f.compare}
        kind = type(value)
        return {"type": f"{kind.__module__}.{kind.__qualname__}", "methods": _methods(kind), **fields}
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
        return str(value.resolve())  # however it was spelt
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if value is ...:
        return "..."
    return _canonical_callable(value)


def hash_values(*values: object) -> str:
    """Hash of values."""
    return hashlib.sha256(json.dumps(canonical(values), sort_keys=True).encode()).hexdigest()


def _canonical_callable(value: object) -> object:
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
    constants = [_code(c) if isinstance(c, types.CodeType) else _constant(c) for c in code.co_consts]
    return [code.co_code.hex(), list(code.co_names), constants]


def _constant(value: object) -> object:
    """A constant of a function, the same in every process: the order of a set is not."""
    if isinstance(value, tuple | frozenset):
        parts = [_constant(part) for part in value]
        return parts if isinstance(value, tuple) else sorted(parts, key=repr)
    return repr(value)


def _methods(kind: type) -> dict[str, object]:
    """The code of a visitor's class; our own is known by our version."""
    if kind.__module__.split(".")[0] == __package__.split(".")[0]:
        return {}
    own = {name: value for name, value in vars(kind).items() if name == "__call__" or not name.startswith("__")}
    return {name: canonical(value) for name, value in own.items() if isinstance(value, types.FunctionType)}


@dataclass(frozen=True, kw_only=True)
class _File:
    """A file or folder that a step wrote, as it was then.

    Path in the output folder, size, change of the inode, and what it is: digest of a file, target of a link.
    """

    name: str
    size: int
    changed_ns: int
    digest: str

    @classmethod
    def of(cls, root: Path, path: Path) -> _File:
        stat, name = path.lstat(), path.relative_to(root).as_posix()
        if path.is_symlink():
            digest = f"link to {path.readlink()}"
        elif path.is_dir():
            return cls(name=name, size=0, changed_ns=0, digest="folder")
        else:
            digest = digest_of_file(path, stat)
        return cls(name=name, size=stat.st_size, changed_ns=stat.st_ctime_ns, digest=digest)

    def now(self, root: Path) -> _File | None:
        """The same as it is now; ``None`` where it is missing or damaged.

        Its content is read only where something happened to the inode.
        """
        path = root / self.name
        try:
            stat = path.lstat()
            same = (stat.st_size, stat.st_ctime_ns) == (self.size, self.changed_ns)
            current = self if same else _File.of(root, path)
        except (OSError, FormatError):
            return None
        return current if (current.size, current.digest) == (self.size, self.digest) else None


@dataclass(frozen=True, kw_only=True)
class _Stamp:
    """The record of a finished step: what decided its output, how long it took, and every file that it wrote."""

    key: str
    seconds: float
    inner: dict[str, float]
    files: tuple[_File, ...]

    def lost(self, root: Path) -> str:
        """The first of its files that is missing or damaged; empty where there is none."""
        return next((file.name for file in self.files if file.now(root) is None), "")


def _files_in(root: Path, paths: Iterable[Path]) -> tuple[_File, ...]:
    """Some files and folders, which need not be there, and the files in them."""
    files = {path for path in paths if os.path.lexists(path)}
    for folder in [path for path in files if path.is_dir() and not path.is_symlink()]:
        for here, folders, names in os.walk(folder):
            files |= {Path(here, name) for name in (*folders, *names)}
    return tuple(_File.of(root, path) for path in sorted(files))


def find_loss(workspace: Workspace, steps: Iterable[str], *, but: Iterable[Path] = ()) -> str:
    """The first file of finished steps that is missing or damaged; empty where there is none.

    Folders ``but`` may be gone as a whole.
    """
    gone = tuple(path.relative_to(workspace.root).as_posix() for path in but if not path.exists())
    stamps = filter(None, (_read_stamp(workspace.stamps / f"{step}.json") for step in steps))
    files = (file for stamp in stamps for file in stamp.files if not file.name.startswith(gone))
    return next((file.name for file in files if file.now(workspace.root) is None), "")


@contextlib.contextmanager
def explaining_losses(workspace: Workspace) -> Iterator[None]:
    """Have a complaint about an output folder say what its run would make again."""
    try:
        yield
    except FormatError as error:
        lost = find_loss(workspace, (path.stem for path in workspace.stamps.glob("*.json")))
        if not lost:
            raise
        raise FormatError(workspace.root, Fact("lost-since-its-run", found=fact_of(error), lost=lost)) from None


def find_change(workspace: Workspace, paths: Iterable[Path]) -> Path | None:
    """The first of some files that is not as a step wrote it."""
    stamps = filter(None, map(_read_stamp, workspace.stamps.glob("*.json")))
    known = {file.name: file for stamp in stamps for file in stamp.files}
    root, inside = workspace.root, (path for path in paths if path.is_relative_to(workspace.root))
    pairs = ((path, known.get(path.relative_to(root).as_posix())) for path in inside)
    return next((path for path, file in pairs if file is not None and file.now(root) is None), None)


class StepRunner:
    """Runs steps in order and skips those whose inputs and options are those of an earlier, finished run.

    A step's key hashes its options, its inputs, what it writes and the keys and outputs of the steps that it takes the
    output of, so that a change anywhere makes again what depends on it, and nothing else. A folder's existence proves
    nothing: only a stamp does that has the right key, and whose files are all as the step wrote them.

    Attributes
    ----------
    seconds
        By step, also of those that an earlier run did.
    worked
        The steps that this run did, in order.
    """

    def __init__(self, workspace: Workspace, heard_by: Progress = silent) -> None:
        self._workspace = workspace
        self._progress = heard_by
        self._heard_by = heard_by if isinstance(heard_by, HearsSteps) else None
        self._keys: dict[str, str] = {}
        self.seconds: dict[str, float] = {}
        self.worked: list[str] = []

    def of(self, *steps: str) -> list[str]:
        """Those of the steps that belong to this run."""
        return [step for step in steps if step in self._keys]

    def forget(self, name: str) -> None:
        """Have a step made again: what it made is gone."""
        (self._workspace.stamps / f"{name}.json").unlink(missing_ok=True)

    def record(self, name: str, paths: Iterable[Path]) -> None:
        """Remember files that are made with every result."""
        files = _files_in(self._workspace.root, paths)
        write_record(self._workspace.stamps / f"{name}.json", _Stamp(key="", seconds=0.0, inner={}, files=files))

    def run(
        self,
        name: str,
        depends: Mapping[str, object],
        outputs: Sequence[Path],
        work: Callable[[list[Path]], None],
        *,
        after: Sequence[str] = (),
        beside: Callable[[], Iterable[Path]] = tuple,
    ) -> None:
        """Run ``work`` unless its stamp holds.

        Parameters
        ----------
        name
            The step.
        depends
            Everything that decides its output beside the steps before it.
        outputs
            What it writes. ``work`` gets temporary paths in their places, which are renamed when it returns.
        work
            Writes every temporary path; parent folders exist, the paths themselves do not. It may run a step of its
            own, whose time is not counted twice.
        after
            Steps whose output it takes.
        beside
            What else it has written, by names of its own: files and folders that must stay as they are, too.
        """
        root, stamp = self._workspace.root, self._workspace.stamps / f"{name}.json"
        upstream = [self._keys[step] for step in after]
        written = [path.name for path in outputs]
        text = json.dumps([name, __version__, upstream, canonical(depends), written], sort_keys=True)
        text = text.replace(json.dumps(f"{root.resolve()}{os.sep}")[1:-1], "")  # wherever the folder is
        key = hashlib.sha256(text.encode()).hexdigest()
        done = _read_stamp(stamp)
        if done is not None and done.key == key and self._stands(name, done):
            self.seconds |= {**done.inner, name: done.seconds}
            self._depend_on(name, done)
            log.info("%s: finished in an earlier run, kept", name)
            if self._heard_by is not None:
                self._heard_by.kept(name)
            return
        self._workspace.unfinish()
        self.worked.append(name)
        stamp.unlink(missing_ok=True)
        for path in outputs:
            path.parent.mkdir(parents=True, exist_ok=True)
        partial = [path.with_name(f"{path.stem}.partial{path.suffix}") for path in outputs]
        for path in (*outputs, *partial):
            remove(path)
        log.info("%s: started", name)
        if self._heard_by is not None:
            self._heard_by.began(name, partial)
        start, begun = time.perf_counter(), len(self.worked)
        try:
            work(partial)
        except (InertialError, OSError):
            for path in partial:
                remove(path)
            raise
        for source, target in zip(partial, outputs, strict=True):
            os.replace(source, target)
        inner = {step: self.seconds[step] for step in self.worked[begun:]}
        self.seconds[name] = time.perf_counter() - start - sum(inner.values())
        files = _files_in(root, [*outputs, *beside()])
        done = _Stamp(key=key, seconds=self.seconds[name], inner=inner, files=files)
        write_record(stamp, done)
        self._depend_on(name, done)
        log.info("%s: finished in %.1f s", name, self.seconds[name])

    def settle(self) -> None:
        """Have the records say how files are at the end, as later steps may have linked them or opened a database."""
        for name in self._keys:
            path = self._workspace.stamps / f"{name}.json"
            if (stamp := _read_stamp(path)) is not None:
                files = tuple(file.now(self._workspace.root) or file for file in stamp.files)
                write_record(path, dataclasses.replace(stamp, files=files))

    def _stands(self, name: str, done: _Stamp) -> bool:
        lost = done.lost(self._workspace.root)
        if lost:
            tell(self._progress, f"{name.replace('_', ' ')}: made again, as {lost} is missing or damaged")
        return not lost

    def _depend_on(self, name: str, stamp: _Stamp) -> None:
        """Have later steps depend on what a step wrote."""
        text = json.dumps([stamp.key, [(file.name, file.size, file.digest) for file in stamp.files]])
        self._keys[name] = hashlib.sha256(text.encode()).hexdigest()


def _read_stamp(stamp: Path) -> _Stamp | None:
    try:
        return read_record(stamp, _Stamp)
    except FormatError:
        return None
