"""Mapping of a capture's parts in processes of their own, each of which is kept until all are made.

COLMAP's incremental mapper gains nothing from threads, and a model comes out alike in any process that maps it with one
thread. A process gets a database that holds no more than its images' keypoints and verified pairs, and writes models
to a folder that is named by the hash of what the process reads: a run that was killed finds those that it finished.
``python -m colmap_inertial.colmap.parts DATABASE IMAGES MODELS`` is such a process: its standard input brings COLMAP's
options, and ends where the process that started it does.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import pickle
import queue
import sqlite3
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_inertial.core.errors import FormatError, MappingError
from colmap_inertial.model.soundness import check_binary_model
from colmap_inertial.pipeline.run.runner import remove

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: Tables that a part's database has whole, and those of which it has its own images' rows.
_WHOLE = ("cameras", "rigs", "rig_sensors")
_OWN = {
    "images": "image_id IN own",
    "frame_data": "data_id IN own",
    "frames": "frame_id IN (SELECT frame_id FROM main.frame_data)",
    "pose_priors": "corr_data_id IN own",
    "keypoints": "image_id IN own",
}
#: COLMAP's number of a pair is 2147483647 times the smaller number of an image, plus the larger one. The rows of an
#: image lie next to each other, and no others are read.
_OWN_PAIRS = """
INSERT INTO main.two_view_geometries SELECT pairs.* FROM own CROSS JOIN whole.two_view_geometries AS pairs
ON pairs.pair_id BETWEEN own.image_id * 2147483647 AND own.image_id * 2147483647 + 2147483646
WHERE pairs.pair_id % 2147483647 IN own
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class PartJob:
    """A part to map.

    Attributes
    ----------
    folder
        Folder of the work: ``part.db``, ``log.txt``.
    options
        COLMAP's.
    models
        Folder that takes the models. It is there as a whole, or not yet.
    """

    folder: Path
    options: pycolmap.IncrementalPipelineOptions
    models: Path

    @classmethod
    def prepare(cls, database: Path, options: pycolmap.IncrementalPipelineOptions, folder: Path) -> PartJob:
        """Write the database of the images that the options name, into a new ``folder``; models go beside it."""
        import pycolmap

        folder.mkdir(parents=True)
        write_part_database(database, options.image_names, folder / "part.db")
        with open(folder / "part.db", "rb") as file:
            key = hashlib.file_digest(file, "sha256")
        key.update(f"{pycolmap.__version__} {options.todict()!r}".encode())
        return cls(folder=folder, options=options, models=folder.with_name(key.hexdigest()[:32]))

    def is_made(self) -> bool:
        """Whether an earlier run made the models; remove what is damaged."""
        try:
            for path in self.models.iterdir():
                check_binary_model(path)
        except FileNotFoundError:
            return False
        except FormatError as error:
            log.info("a part is mapped again: %s", error)
            remove(self.models)
            return False
        return True

    def read(self) -> dict[int, pycolmap.Reconstruction]:
        """The models by number."""
        import pycolmap

        numbers = sorted(int(path.name) for path in self.models.iterdir())
        return {number: pycolmap.Reconstruction(str(self.models / str(number))) for number in numbers}


def write_part_database(database: Path, names: Sequence[str], part: Path) -> None:
    """Write what the mapper reads of some images, with their numbers, to a database of its own.

    Parameters
    ----------
    database
        With verified pairs; nobody else has it open.
    names
        Of the images.
    part
        A file that does not exist.
    """
    uri = f"{part.absolute().as_uri()}?mode=rwc"
    with contextlib.closing(sqlite3.connect(uri, uri=True)) as made, made:
        made.execute("ATTACH ? AS whole", (f"{database.absolute().as_uri()}?immutable=1",))
        for (definition,) in made.execute(
            "SELECT sql FROM whole.sqlite_master WHERE sql IS NOT NULL AND name NOT LIKE 'sqlite_%'"
            " ORDER BY type = 'index'"
        ).fetchall():
            made.execute(definition)
        (version,) = made.execute("PRAGMA whole.user_version").fetchone()
        made.execute(f"PRAGMA user_version = {int(version)}")
        made.execute("CREATE TEMP TABLE own (image_id INTEGER PRIMARY KEY)")
        number = "INSERT INTO own SELECT image_id FROM whole.images WHERE name = ?"
        made.executemany(number, ((name,) for name in names))
        for table, rows in {**dict.fromkeys(_WHOLE, "TRUE"), **_OWN}.items():
            made.execute(f"INSERT INTO main.{table} SELECT * FROM whole.{table} WHERE {rows}")
        made.execute(_OWN_PAIRS)


def map_parts(
    jobs: Sequence[PartJob], images: Path, *, workers: int, registered: Callable[[], None]
) -> Iterator[dict[int, pycolmap.Reconstruction]]:
    """Map parts, some at a time, and yield their models in order; those that are made already are kept.

    Parameters
    ----------
    jobs
        The parts.
    images
        Folder of the images.
    workers
        Processes at a time.
    registered
        Is called in this thread for each image that a part places.

    Raises
    ------
    MappingError
        Where a process fails or is killed. Parts that were finished before stay.
    """
    events: queue.SimpleQueue[int | None] = queue.SimpleQueue()
    running: dict[int, subprocess.Popen[bytes]] = {}
    watches: dict[int, threading.Thread] = {}
    made = {k for k, job in enumerate(jobs) if job.is_made()}
    waiting, reported = deque(k for k in range(len(jobs)) if k not in made), 0
    for k in sorted(made):
        log.info("part %d of %d: finished in an earlier run, kept", k + 1, len(jobs))
        remove(jobs[k].folder)
        for _ in jobs[k].options.image_names:
            registered()
    try:
        while reported < len(jobs):
            if reported in made:
                yield jobs[reported].read()
                reported += 1
                continue
            while waiting and len(running) < workers:
                k = waiting.popleft()
                running[k] = start_part(jobs[k], images)
                watches[k] = threading.Thread(target=_watch, args=(running[k], k, events), daemon=True)
                watches[k].start()
            event = events.get()
            if event is None:
                registered()
                continue
            _require_success(running.pop(event), jobs[event].folder, event)
            os.replace(jobs[event].folder / "models", jobs[event].models)
            remove(jobs[event].folder)
            made.add(event)
    finally:
        for k, process in running.items():
            process.kill()
            _end(process)
            watches[k].join()


def start_part(job: PartJob, images: Path) -> subprocess.Popen[bytes]:
    """Start the process of a part."""
    folder = job.folder
    (folder / "models").mkdir()
    arguments = [str(path.absolute()) for path in (folder / "part.db", images, folder / "models")]
    with open(folder / "log.txt", "wb") as log:
        # a session of its own keeps the terminal's Ctrl-C away; the open pipe tells that this process is alive
        process = subprocess.Popen(
            [sys.executable, "-m", __name__, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            start_new_session=True,
        )
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):  # its end says why
        process.stdin.write(pickle.dumps(job.options.todict()))
        process.stdin.flush()
    return process


def _watch(process: subprocess.Popen[bytes], number: int, events: queue.SimpleQueue[int | None]) -> None:
    assert process.stdout is not None
    with process.stdout:
        while process.stdout.read(1):
            events.put(None)
    events.put(number)


def _require_success(process: subprocess.Popen[bytes], folder: Path, number: int) -> None:
    code = _end(process)
    if code < 0:
        raise MappingError(
            f"the process that mapped part {number + 1} was killed (signal {-code}); where memory is short, give "
            "fewer --workers"
        )
    if code:
        lines = (folder / "log.txt").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise MappingError(f"part {number + 1} cannot be mapped: {lines[-1] if lines else f'exit code {code}'}")


def _end(process: subprocess.Popen[bytes]) -> int:
    code = process.wait()
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.close()
    return code


def main() -> None:
    """Map one part; a byte on standard output stands for each image."""
    import pycolmap

    # from the process that started this one
    values = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    options = pycolmap.IncrementalPipelineOptions()
    options.mergedict(values)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(options.random_seed)
    database, images, models = sys.argv[1:]
    pycolmap.incremental_mapping(database, images, models, options=options, next_image_callback=_tell)


def _tell() -> None:
    os.write(sys.stdout.fileno(), b".")


def _end_with_the_parent() -> None:
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    main()
