"""Mapping of a capture's parts, each of which is a chunk of work.

COLMAP's incremental mapper gains nothing from threads, and a model comes out alike in any process that maps it with one
thread. A process gets a database that holds no more than its images' keypoints and verified pairs.
"""

from __future__ import annotations

import contextlib
import hashlib
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_inertial.colmap.chunks import Chunk, Executor, do_chunks
from colmap_inertial.colmap.incremental import map_incrementally
from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.model.soundness import check_binary_model

if TYPE_CHECKING:
    import pycolmap

#: Tables that a part's database has whole, and those of which it has its own images' rows.
_WHOLE = ("cameras", "rigs", "rig_sensors")
_OWN = {
    "images": "image_id IN own",
    "frame_data": "data_id IN own",
    "frames": "frame_id IN (SELECT frame_id FROM main.frame_data)",
    "pose_priors": "corr_data_id IN own",
    "keypoints": "image_id IN own",
}
#: What the matcher needs beside.
_TO_MATCH = {"descriptors": "image_id IN own"}
#: COLMAP's number of a pair is 2147483647 times the smaller number of an image, plus the larger one. The rows of an
#: image lie next to each other, and no others are read.
_OWN_PAIRS = """
INSERT INTO main.{table} SELECT pairs.* FROM own CROSS JOIN whole.{table} AS pairs
ON pairs.pair_id BETWEEN own.image_id * 2147483647 AND own.image_id * 2147483647 + 2147483646
WHERE pairs.pair_id % 2147483647 IN own
"""


@dataclass(frozen=True, kw_only=True)
class MapPart:
    """Maps the images of ``part.db``; makes a folder for each model.

    Attributes
    ----------
    options
        COLMAP's, as a dictionary.
    orientations
        Of the images, by the gyroscope.
    """

    options: dict[str, Any]
    orientations: ImageOrientations

    def __call__(self, folder: Path, images: Path, made: Path, told: Callable[[], None]) -> None:
        """As of :class:`~colmap_inertial.colmap.chunks.Work`."""
        import pycolmap

        options = pycolmap.IncrementalPipelineOptions()
        options.mergedict(self.options)
        pycolmap.set_random_seed(options.random_seed)
        map_incrementally(
            folder / "part.db", images, made, options, told, orientations=self.orientations, scratch=folder
        )

    def check(self, made: Path) -> None:
        """As of :class:`~colmap_inertial.colmap.chunks.Work`."""
        for path in made.iterdir():
            check_binary_model(path)


def prepare_part(
    database: Path,
    images: Path,
    options: pycolmap.IncrementalPipelineOptions,
    folder: Path,
    number: int,
    orientations: ImageOrientations,
) -> Chunk:
    """The chunk of a part: the images that the options name, whose database is written into a new ``folder``."""
    folder.mkdir(parents=True)
    write_part_database(database, options.image_names, folder / "part.db")
    with open(folder / "part.db", "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    work = MapPart(options=options.todict(), orientations=orientations.select(options.image_names))
    size = len(options.image_names)
    return Chunk.of(work, name=f"mapping part {number + 1}", folder=folder, images=images, size=size, reads=digest)


def write_part_database(database: Path, names: Sequence[str], part: Path, *, to_match: bool = False) -> None:
    """Write what the mapper reads of some images, with their numbers, to a database of its own.

    Parameters
    ----------
    database
        With verified pairs; nobody else has it open to write.
    names
        Of the images.
    part
        A file that does not exist.
    to_match
        Write what the matcher reads.
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
        for table, rows in {**dict.fromkeys(_WHOLE, "TRUE"), **_OWN, **(_TO_MATCH if to_match else {})}.items():
            made.execute(f"INSERT INTO main.{table} SELECT * FROM whole.{table} WHERE {rows}")
        for table in ("matches", "two_view_geometries") if to_match else ("two_view_geometries",):
            made.execute(_OWN_PAIRS.format(table=table))


def map_parts(
    parts: Sequence[Chunk], executor: Executor, registered: Callable[[int], None]
) -> Iterator[dict[int, pycolmap.Reconstruction]]:
    """Map parts, some at a time, and yield their models by number, in order; those that are made already are kept.

    Parameters
    ----------
    parts
        Of :func:`prepare_part`.
    executor
        Who maps them.
    registered
        Is called in this thread with numbers of images that were placed.
    """
    import pycolmap

    for part in do_chunks(parts, executor, registered):
        numbers = sorted(int(path.name) for path in part.made.iterdir())
        yield {number: pycolmap.Reconstruction(str(part.made / str(number))) for number in numbers}
