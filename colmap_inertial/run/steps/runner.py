"""Steps of a run: each is done once, its output is whole or absent, and a finished result is not replaced unasked."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from colmap_inertial import __version__
from colmap_inertial.core.errors import FormatError, InertialError, OutputExistsError, fact_of
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.progress import HearsSteps, Progress, silent, tell
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import read_record, write_record
from colmap_inertial.io.fingerprints import digest_of_file
from colmap_inertial.run.steps.hashing import as_json_types
from colmap_inertial.run.steps.workspace import Workspace

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class _File:
    """A file or folder that a step wrote, as it was then.

    Attributes
    ----------
    name
        Its path in the output folder.
    size, modified_ns
        Of a file.
    digest
        Of a file's content; ``"folder"``, or the target of a link.
    """

    name: str
    size: int
    modified_ns: int
    digest: str

    @classmethod
    def of(cls, root: Path, path: Path) -> _File:
        stat, name = path.lstat(), path.relative_to(root).as_posix()
        if path.is_symlink():
            digest = f"link to {path.readlink()}"
        elif path.is_dir():
            return cls(name=name, size=0, modified_ns=0, digest="folder")
        else:
            digest = digest_of_file(path, stat)
        return cls(name=name, size=stat.st_size, modified_ns=stat.st_mtime_ns, digest=digest)

    def is_unchanged(self, root: Path) -> bool:
        """Whether it is there and the same; read only where its size is, and its time is not."""
        path = root / self.name
        try:
            stat = path.lstat()
            if (stat.st_size, stat.st_mtime_ns) == (self.size, self.modified_ns):
                return True
            now = _File.of(root, path)
        except (OSError, FormatError):
            return False
        return (now.size, now.digest) == (self.size, self.digest)


@dataclass(frozen=True, kw_only=True)
class _Stamp:
    """The record of a finished step: what decided its output, how long it took, and every file that it wrote."""

    key: str
    seconds: float
    inner: dict[str, float]
    files: tuple[_File, ...]

    def find_loss(self, root: Path) -> str:
        """The first of its files that is missing or damaged; empty where there is none."""
        return next((file.name for file in self.files if not file.is_unchanged(root)), "")


def _read_stamp(path: Path) -> _Stamp | None:
    try:
        return read_record(path, _Stamp)
    except FormatError:
        return None


def _list_files(root: Path, paths: Iterable[Path]) -> tuple[_File, ...]:
    """Some files and folders, which need not be there, and the files in them."""
    files = {path for path in paths if os.path.lexists(path)}
    for folder in [path for path in files if path.is_dir() and not path.is_symlink()]:
        for here, folders, names in os.walk(folder):
            files |= {Path(here, name) for name in (*folders, *names)}
    return tuple(_File.of(root, path) for path in sorted(files))


class StepRunner:
    """Runs steps in order, and keeps those whose record still holds.

    A step's key hashes what decides its output: options, inputs, and the output of the steps before it. Its record
    (``.stages/STEP.json``) holds the key and every file that it wrote, and holds as long as both are the same.

    A finished result (there is a ``result.json``) may be added to and repaired. A step of it whose key is another one
    now is made again only where that was asked for.

    Parameters
    ----------
    workspace
        The output folder.
    progress
        Hears of steps.
    overwrite
        Make steps of a finished result again.
    changes
        Options that differ from those of the finished result.

    Attributes
    ----------
    seconds
        By step, also of those that an earlier run did.
    worked
        The steps that this run did, in order.
    """

    def __init__(
        self,
        workspace: Workspace,
        progress: Progress = silent,
        *,
        overwrite: bool = False,
        changes: Sequence[Fact] = (),
    ) -> None:
        self._workspace = workspace
        self._progress = progress
        self._heard_by = progress if isinstance(progress, HearsSteps) else None
        self._overwrite = overwrite
        self._changes = tuple(changes)
        self._outputs: dict[str, str] = {}
        self.seconds: dict[str, float] = {}
        self.worked: list[str] = []

    @property
    def keeps_result(self) -> bool:
        """Whether there is a finished result that this run may not replace."""
        return self._workspace.result.is_file() and not self._overwrite

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
        """Run a step, unless its record holds.

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

        Raises
        ------
        OutputExistsError
            Where that would replace a finished result.
        """
        key, record = self._hash(name, depends, outputs, after), self._record(name)
        stamp = _read_stamp(record)
        if stamp is not None and stamp.key == key:
            lost = stamp.find_loss(self._workspace.root)
            if not lost:
                self._keep(name, stamp)
                return
            self._require_repairable(name)
            tell(self._progress, f"{name.replace('_', ' ')}: made again, as {lost} is missing or damaged")
        elif stamp is not None:
            self._require_replaceable(name)
        if stamp is not None or any(map(os.path.lexists, outputs)):
            self._workspace.unfinish()
        record.unlink(missing_ok=True)
        files, inner = self._work(name, outputs, work, beside)
        stamp = _Stamp(key=key, seconds=self.seconds[name], inner=inner, files=files)
        write_record(record, stamp)
        self._outputs[name] = _hash_output(stamp)
        log.info("%s: finished in %.1f s", name, self.seconds[name])

    def list_own(self, *steps: str) -> list[str]:
        """Those of the steps that belong to this run."""
        return [step for step in steps if step in self._outputs]

    def forget(self, name: str) -> None:
        """Have a step made again: what it made is gone."""
        self._record(name).unlink(missing_ok=True)

    def discard(self, *paths: Path) -> None:
        """Remove what an earlier run made and this one does not.

        Raises
        ------
        OutputExistsError
            Where it belongs to a finished result.
        """
        for path in filter(os.path.lexists, paths):
            self._require_replaceable(path.name)
            self._workspace.unfinish()
            remove(path)

    def leave_out(self, steps: Iterable[str]) -> None:
        """Raise :class:`OutputExistsError` where steps that this run does not have belong to a finished result."""
        for step in steps:
            self._require_replaceable(step)

    def record_files(self, name: str, paths: Iterable[Path]) -> None:
        """Write down files that are made with every result."""
        files = _list_files(self._workspace.root, paths)
        write_record(self._record(name), _Stamp(key="", seconds=0.0, inner={}, files=files))

    def _record(self, name: str) -> Path:
        return self._workspace.stamps / f"{name}.json"

    def _hash(self, name: str, depends: Mapping[str, object], outputs: Sequence[Path], after: Sequence[str]) -> str:
        """The key of a step; the same wherever the output folder is."""
        before = [self._outputs[step] for step in after]
        written = [path.name for path in outputs]
        text = json.dumps([name, __version__, before, as_json_types(depends), written], sort_keys=True)
        root = json.dumps(f"{self._workspace.root.resolve()}{os.sep}")[1:-1]
        return hashlib.sha256(text.replace(root, "").encode()).hexdigest()

    def _keep(self, name: str, stamp: _Stamp) -> None:
        self.seconds |= {**stamp.inner, name: stamp.seconds}
        self._outputs[name] = _hash_output(stamp)
        log.info("%s: finished in an earlier run, kept", name)
        if self._heard_by is not None:
            self._heard_by.kept(name)

    def _require_repairable(self, name: str) -> None:
        """What was lost of a finished result comes again with the options that it was made with."""
        if self._changes:
            self._require_replaceable(name)

    def _require_replaceable(self, name: str) -> None:
        if self.keeps_result:
            out = str(self._workspace.root)
            raise OutputExistsError(Fact("result-is-finished", out=out, step=name, changes=self._changes))

    def _work(
        self,
        name: str,
        outputs: Sequence[Path],
        work: Callable[[list[Path]], None],
        beside: Callable[[], Iterable[Path]],
    ) -> tuple[tuple[_File, ...], dict[str, float]]:
        """Do a step, under temporary names until it is done: the files it wrote, and the seconds of steps in it."""
        partial = [path.with_name(f"{path.stem}.partial{path.suffix}") for path in outputs]
        for path in (*outputs, *partial):
            path.parent.mkdir(parents=True, exist_ok=True)
            remove(path)
        self.worked.append(name)
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
        return _list_files(self._workspace.root, [*outputs, *beside()]), inner


def _hash_output(stamp: _Stamp) -> str:
    """What later steps depend on: how a step was made, and what came of it."""
    text = json.dumps([stamp.key, [(file.name, file.size, file.digest) for file in stamp.files]])
    return hashlib.sha256(text.encode()).hexdigest()


# --- questions about an output folder ---------------------------------------------------------------------------------


def find_loss(workspace: Workspace, steps: Iterable[str], *, but: Iterable[Path] = ()) -> str:
    """The first file of finished steps that is missing or damaged; empty where there is none.

    Folders ``but`` may be gone as a whole.
    """
    gone = tuple(path.relative_to(workspace.root).as_posix() for path in but if not path.exists())
    stamps = filter(None, (_read_stamp(workspace.stamps / f"{step}.json") for step in steps))
    files = (file for stamp in stamps for file in stamp.files if not file.name.startswith(gone))
    return next((file.name for file in files if not file.is_unchanged(workspace.root)), "")


def find_change(workspace: Workspace, paths: Iterable[Path]) -> Path | None:
    """The first of some files that is not as a step wrote it."""
    stamps = filter(None, map(_read_stamp, workspace.stamps.glob("*.json")))
    known = {file.name: file for stamp in stamps for file in stamp.files}
    root, inside = workspace.root, (path for path in paths if path.is_relative_to(workspace.root))
    pairs = ((path, known.get(path.relative_to(root).as_posix())) for path in inside)
    return next((path for path, file in pairs if file is not None and not file.is_unchanged(root)), None)


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
