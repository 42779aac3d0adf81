"""Work of a run in chunks, each done by a process of its own and kept until all are done.

A chunk reads images, files in a folder of its own, and what its work says. What it makes goes to a folder that is named
by the hash of what it reads: a run that was killed finds the chunks that were finished.
``python -m colmap_inertial.colmap.chunks FOLDER IMAGES MADE`` is such a process: its standard input brings the
work, and ends where the process that started it does.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

from colmap_inertial.core.errors import FormatError, InertialError, MappingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.disk import remove

log = logging.getLogger(__name__)

#: Where a run's scratch folder has its chunks.
CHUNKS_FOLDER = "chunks"


class Work(Protocol):
    """What is done to a chunk; it can be pickled, and its ``repr`` says all that decides what it makes."""

    def __call__(self, folder: Path, images: Path, made: Path, told: Callable[[], None]) -> None:
        """Read files in ``folder`` and images, write to ``made``, and call ``told`` for each item that is done."""
        ...

    def check(self, made: Path) -> None:
        """Raise ``FormatError`` where what was made is damaged."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Chunk:
    """A chunk of work.

    Attributes
    ----------
    name
        What is done, for messages.
    work
        That.
    folder
        Of files that the work reads; of its log.
    images
        Folder of the images.
    made
        Folder that takes what the work makes. It is there as a whole, or not yet.
    size
        Number of items, for progress.
    gpu
        Whether it is done on a GPU.
    """

    name: str
    work: Work
    folder: Path
    images: Path
    made: Path
    size: int
    gpu: bool = False

    @classmethod
    def of(
        cls, work: Work, *, name: str, folder: Path, images: Path, size: int, reads: object, gpu: bool = False
    ) -> Chunk:
        """A chunk whose result goes beside its ``folder``; ``reads`` is the identity of the files that it reads."""
        import pycolmap

        key = hashlib.sha256(f"{pycolmap.__version__} {reads!r} {work!r}".encode()).hexdigest()
        folder, images = folder.absolute(), images.absolute()
        made = folder.with_name(key[:32])
        return cls(name=name, work=work, folder=folder, images=images, made=made, size=size, gpu=gpu)

    def is_made(self) -> bool:
        """Whether an earlier run made the result; remove one that is damaged."""
        if not self.made.is_dir():
            return False
        try:
            self.work.check(self.made)
        except FormatError as error:
            log.info("%s again: %s", self.name, error)
            remove(self.made)
            return False
        return True

    def keep(self) -> None:
        """Put what was made in its place."""
        os.replace(self.folder / "made", self.made)
        remove(self.folder)


class Executor(Protocol):
    """Who does chunks."""

    @property
    def remote(self) -> bool:
        """Whether they are done on other machines, so that features and matches are worth chunks, too."""
        ...

    def run(self, chunks: Sequence[Chunk], told: Callable[[int], None]) -> Generator[int, None, None]:
        """Do chunks, some at a time; yields the number of each that is kept.

        ``told`` is called in this thread with numbers of items that are done.

        Raises
        ------
        MappingError
            Where one fails.
        """
        ...

    def require(self, folder: Path) -> None:
        """Raise ``InertialError`` where workers cannot do chunks in this folder."""
        ...


def do_chunks(chunks: Sequence[Chunk], executor: Executor, told: Callable[[int], None]) -> Iterator[Chunk]:
    """Let chunks be done, and yield them in order; those that are made already are kept.

    Raises
    ------
    MappingError
        Where one fails. Those that were finished before stay.
    """
    made = {number for number, chunk in enumerate(chunks) if chunk.is_made()}
    for number in sorted(made):
        log.info("%s (%d of %d): finished in an earlier run, kept", chunks[number].name, number + 1, len(chunks))
        remove(chunks[number].folder)
        told(chunks[number].size)
    missing = [number for number in range(len(chunks)) if number not in made]
    done = executor.run([chunks[number] for number in missing], told)
    with contextlib.closing(done):
        for number, chunk in enumerate(chunks):
            while number not in made:
                made.add(missing[next(done)])
            yield chunk


@dataclass(frozen=True, kw_only=True)
class Processes:
    """Processes of this machine, so many at a time."""

    remote: ClassVar[bool] = False
    number: int

    def run(self, chunks: Sequence[Chunk], told: Callable[[int], None]) -> Generator[int, None, None]:
        """As of :class:`Executor`."""
        events: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        running: dict[int, subprocess.Popen[bytes]] = {}
        watches: dict[int, threading.Thread] = {}
        waiting = deque(range(len(chunks)))
        try:
            while waiting or running:
                while waiting and len(running) < self.number:
                    k = waiting.popleft()
                    running[k] = start_process(chunks[k])
                    watches[k] = threading.Thread(target=_watch, args=(running[k], k, events), daemon=True)
                    watches[k].start()
                event = events.get()
                if event is None:
                    told(1)
                    continue
                require_success(running.pop(event), chunks[event])
                chunks[event].keep()
                yield event
        finally:
            for k, process in running.items():
                process.kill()
                end_process(process)
                watches[k].join()

    def require(self, folder: Path) -> None:
        """This machine can."""


def start_process(chunk: Chunk, *, heard: bool = True) -> subprocess.Popen[bytes]:
    """Start the process of a chunk, which makes ``made`` in its folder; its output is a byte for each item."""
    (chunk.folder / "made").mkdir()
    arguments = [str(path) for path in (chunk.folder, chunk.images, chunk.folder / "made")]
    with open(chunk.folder / "log.txt", "wb") as file:
        # a session of its own keeps the terminal's Ctrl-C away; the open pipe tells that this process is alive
        process = subprocess.Popen(
            [sys.executable, "-m", __name__, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE if heard else subprocess.DEVNULL,
            stderr=file,
            start_new_session=True,
        )
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):  # its end says why
        process.stdin.write(pickle.dumps(chunk.work))
        process.stdin.flush()
    return process


def _watch(process: subprocess.Popen[bytes], number: int, events: queue.SimpleQueue[int | None]) -> None:
    assert process.stdout is not None
    with process.stdout:
        while process.stdout.read(1):
            events.put(None)
    events.put(number)


def require_success(process: subprocess.Popen[bytes], chunk: Chunk, *, on_worker: bool = False) -> None:
    """Wait for the end of a chunk's process; a ``MappingError`` where it failed or was killed.

    ``on_worker`` says whether it ran on a worker of Dask, which decides what to do where memory is short.
    """
    code = end_process(process)
    if code < 0:
        raise MappingError(Fact("process-killed", work=chunk.name, signal=-code, on_worker=on_worker))
    if code:
        lines = (chunk.folder / "log.txt").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise MappingError(Fact("process-failed", work=chunk.name, exit_code=code, detail=lines[-1] if lines else None))


def end_process(process: subprocess.Popen[bytes]) -> int:
    """Wait for the end of a process and let go of it; returns its exit code."""
    code = process.wait()
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.close()
    return code


def main() -> None:
    """Do one chunk."""
    import pycolmap

    # from the process that started this one
    work: Work = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        folder, images, made = map(Path, sys.argv[1:])
        work(folder, images, made, _tell)
    except InertialError as error:
        sys.exit(str(error))


def _tell() -> None:
    os.write(sys.stdout.fileno(), b".")


def _end_with_the_parent() -> None:
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    main()
