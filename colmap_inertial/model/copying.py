"""A folder that appears whole or not at all, and copies that share their blocks with the original where they can."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import stat
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

from colmap_inertial.core.errors import FormatError, OutputError, OutputExistsError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import advise, locked
from colmap_inertial.model import load_pycolmap

#: Linux: share the blocks of another file (Btrfs, XFS, bcachefs, ...).
_FICLONE = 0x40049409
_FULL = {errno.ENOSPC: "copy-disk-full", errno.EDQUOT: "copy-quota-used", errno.EFBIG: "copy-file-too-large"}
#: What a file system answers that cannot copy within the kernel.
_NO_OFFLOAD = {errno.EXDEV, errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.ETXTBSY, errno.EPERM, errno.EIO}


#: Windows has no SIGHUP.
_ENDINGS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]


class _Terminated(BaseException):
    pass


@contextlib.contextmanager
def new_folder(target: Path, *, into_empty: bool = False) -> Iterator[Path]:
    """A temporary folder beside ``target`` that takes its name at the end; after a failure nothing is left of it.

    With ``into_empty``, the target may be a folder that is there and holds nothing.

    SIGTERM and SIGHUP count as failures, too: the process cleans up before it ends by them. What a killed process left
    behind is removed by the next one.

    Raises
    ------
    OutputExistsError
        When the target exists, or another process is writing it.
    OutputError
        When it cannot be written; says so when the disk is full.
    """
    if _is_taken(target, into_empty):
        raise OutputExistsError(Fact("target-exists", path=str(target)))
    partial = target.with_name(f".{target.name}.colmap-inertial-partial")
    lock = target.with_name(f".{target.name}.colmap-inertial-lock")
    with _ending_by_signal(), _convert_os_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        with locked(lock, Fact("written-by-another", path=str(target))):
            try:
                if partial.exists():
                    shutil.rmtree(partial)
                partial.mkdir()
                yield partial
                _flush(partial)
                if _is_taken(target, into_empty):
                    raise OutputExistsError(Fact("target-appeared", path=str(target)))
                if os.path.lexists(target):
                    target.rmdir()
                os.rename(partial, target)
            except BaseException:
                _remove(partial)
                raise
            finally:
                with contextlib.suppress(OSError):  # Windows removes it with the last one who holds it
                    lock.unlink()


def _is_taken(target: Path, into_empty: bool) -> bool:
    """Whether something is there that would be lost."""
    if into_empty and target.is_dir() and not target.is_symlink():
        return any(target.iterdir())
    return os.path.lexists(target)


def _remove(folder: Path) -> None:
    """Remove a folder as far as can be, one open at a time: ``shutil.rmtree`` holds all above it, too."""
    for parent, folders, names in os.walk(folder, topdown=False):
        for path in (os.path.join(parent, name) for name in (*folders, *names)):
            with contextlib.suppress(OSError):
                (os.rmdir if os.path.isdir(path) and not os.path.islink(path) else os.unlink)(path)
    with contextlib.suppress(OSError):
        folder.rmdir()


def _flush(folder: Path) -> None:
    """Have the disk hold what was written before the rename says that it is whole.

    File by file: to flush the file system is to wait for what everybody else wrote, too. Windows, which flushes
    neither folders nor files that are open for reading, is left to itself.
    """
    if os.name != "posix":
        return
    for parent, _, names in os.walk(folder, topdown=False):
        for path in (*(os.path.join(parent, name) for name in names), parent):
            if not os.path.islink(path):
                handle = os.open(path, os.O_RDONLY)
                try:
                    os.fsync(handle)
                finally:
                    os.close(handle)


@contextlib.contextmanager
def _convert_os_errors(target: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        code = _FULL.get(error.errno or 0)
        why = Fact.stated(error.strerror or str(error)) if code is None else Fact(code)
        raise OutputError(
            Fact("copy-not-written", path=str(target), why=why, name=str(error.filename) if error.filename else None)
        ) from error


@contextlib.contextmanager
def _ending_by_signal() -> Iterator[None]:
    """Turn SIGTERM and SIGHUP into an exception inside the block, and end by the signal after it."""
    load_pycolmap()  # now: within the block it would take the signal away
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []

    def stop(number: int, _frame: FrameType | None) -> None:
        caught.append(number)
        if len(caught) == 1:  # a second one must not interrupt the cleaning up
            raise _Terminated

    before = {number: signal.signal(number, stop) for number in _ENDINGS}
    try:
        yield
    except _Terminated:
        pass
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if caught or handler is None else handler)
    if caught:
        signal.raise_signal(caught[0])


def copy_file(source: Path, target: Path, *, link: bool = False) -> str:
    """Copy a file with mode and times.

    Parameters
    ----------
    source, target
        The target does not exist.
    link
        Make a hard link where the file system can.

    Returns
    -------
    str
        ``"linked"``, ``"reflinked"`` (blocks shared until one of them changes) or ``"copied"``.
    """
    if link:
        with contextlib.suppress(OSError):
            os.link(source, target)
            return "linked"
    how = "copied"
    with open(source, "rb", buffering=0) as src, open(target, "xb", buffering=0) as dst:
        try:
            import fcntl

            fcntl.ioctl(dst.fileno(), _FICLONE, src.fileno())
            how = "reflinked"
        except (ImportError, OSError):
            _copy_bytes(src.fileno(), dst.fileno(), os.fstat(src.fileno()).st_size)
    shutil.copystat(source, target)
    return how


def begin_writing(path: Path) -> None:
    """Have the disk start on a finished file, so that it works while the next ones are made."""
    handle = os.open(path, os.O_RDONLY)
    try:
        advise(handle, "DONTNEED")
    finally:
        os.close(handle)


def _copy_bytes(source: int, target: int, size: int) -> None:
    done = 0
    while done < size and hasattr(os, "copy_file_range"):
        try:
            n = os.copy_file_range(source, target, min(size - done, 1 << 28))
        except OSError as error:
            if error.errno not in _NO_OFFLOAD:
                raise
            break
        if n == 0:
            break
        done += n
    while data := os.read(source, 1 << 20):  # the rest, where the kernel could not do it
        view = memoryview(data)
        while view:
            view = view[os.write(target, view) :]


def list_tree(root: Path, *, follow_links: bool = False) -> tuple[list[Path], list[Path], list[Path]]:
    """Folders, files and symbolic links below ``root``, as paths relative to it, in order.

    A relative link that stays below ``root`` is listed as a link; any other is followed, so that what it leads to is
    listed as a folder or file. A broken link is listed as a link.

    Parameters
    ----------
    root
        A folder.
    follow_links
        Follow links that lead out of it, too.

    Raises
    ------
    FormatError
        For a link that leads out of ``root`` without ``follow_links``, one that leads back to where it is found, and
        for what is neither file, folder nor link.
    """
    inside = root.resolve()
    folders: list[Path] = []
    files: list[Path] = []
    links: list[Path] = []

    def visit(folder: Path, above: frozenset[Path]) -> None:
        real = (root / folder).resolve()
        if real in above:
            raise FormatError(root / folder, Fact("link-leads-back"))
        try:
            entries = sorted(os.scandir(root / folder), key=lambda entry: entry.name)
        except OSError as error:
            raise FormatError(root / folder, Fact("file-not-readable", detail=str(error.strerror))) from None
        for entry in entries:
            path = folder / entry.name
            if entry.is_symlink() and _is_kept(root, path):
                links.append(path)
                continue
            if entry.is_symlink() and not follow_links:
                real_target = (root / path).resolve()
                if not real_target.is_relative_to(inside):
                    raise FormatError(
                        root / path,
                        Fact("link-out-not-followed", target=str(real_target)),
                    )
            if entry.is_dir():
                folders.append(path)
                visit(path, above | {real})
            elif entry.is_file():
                files.append(path)
            else:
                raise FormatError(root / path, Fact("neither-file-nor-folder"))

    visit(Path(), frozenset())
    return folders, files, links


def _is_kept(root: Path, path: Path) -> bool:
    """Whether a link means the same in a copy of the whole tree."""
    link = root / path
    try:
        mode = link.stat().st_mode
    except OSError:
        return True
    text = os.readlink(link)
    inside = Path(os.path.normpath(path.parent / text))
    stays = not os.path.isabs(text) and inside.parts[:1] != ("..",)
    # Below a followed link, ".." leads to where that link's target lies
    stays = stays and (root / inside).resolve() == link.resolve()
    return stays and (stat.S_ISDIR(mode) or stat.S_ISREG(mode))
