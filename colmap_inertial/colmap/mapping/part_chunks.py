"""Mapping of a capture's parts, each of which is a chunk of work.

COLMAP's incremental mapper gains nothing from threads, and a model comes out alike in any process that maps it with one
thread.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_inertial.colmap.chunks import Chunk, Executor, do_chunks
from colmap_inertial.colmap.mapping.incremental import map_incrementally
from colmap_inertial.colmap.parts import write_part_database
from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.model.soundness import check_binary_model

if TYPE_CHECKING:
    import pycolmap


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
