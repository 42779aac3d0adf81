"""Features, matches and models by an installed COLMAP, in a database that it made itself.

COLMAP of an earlier version does not open a database that pycolmap has opened. So there are two, and rows go between
them: what both have in common, with the same numbers of cameras, images and pairs.
"""

from __future__ import annotations

import contextlib
import re
import sqlite3
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_inertial.colmap.executable import ColmapExecutable
from colmap_inertial.core.errors import MappingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.progress import Progress
from colmap_inertial.io.disk import require_room
from colmap_inertial.model.soundness import check_binary_model

if TYPE_CHECKING:
    import pycolmap

#: Tables of images and of their features, in an order in which none refers to a later one; earlier versions have fewer.
_IMAGE_TABLES = ("rigs", "rig_sensors", "cameras", "frames", "frame_data", "images")
_FEATURE_TABLES = (*_IMAGE_TABLES, "keypoints", "descriptors")
_VERIFIED_TABLES = (*_IMAGE_TABLES, "keypoints", "two_view_geometries")
_MATCH_COLUMNS = "pair_id, rows, cols, data"
_PROCESSED = re.compile(r"Processed file \[(\d+)/\d+\]")
_REGISTERED, _NO_MODEL = "Registering image #", "failed to create sparse model"


@dataclass(frozen=True, kw_only=True)
class InstalledColmap:
    """An installed COLMAP at work in a run.

    Attributes
    ----------
    executable
        The program.
    scratch
        A folder for temporary files; the logs of its commands stay there.
    """

    executable: ColmapExecutable
    scratch: Path

    def find_features(
        self, images: Path, names: Sequence[str], database: Path, options: MappingOptions, progress: Progress
    ) -> None:
        """Find the features of images; ``database`` does not exist, and becomes one of its own.

        Raises
        ------
        MappingError
            Where it fails.
        """
        own = {"max_num_features": options.max_num_features, "first_octave": options.first_octave}
        if options.max_image_size is not None:
            own["max_image_size"] = options.max_image_size
        listed = database.with_suffix(".txt")
        listed.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")

        def read_line(line: str) -> None:
            if (processed := _PROCESSED.search(line)) is not None:
                progress("features", min(int(processed[1]), len(names)), len(names))

        progress("features", 0, len(names))
        files = {"database_path": database, "image_path": images, "image_list_path": listed}
        self._run("feature_extractor", files, own, read_line)

    def copy_features(self, database: Path, theirs: Path) -> None:
        """Make a database of its own of images and features of ours, which nobody has open.

        Raises
        ------
        MappingError
            Where its tables cannot be filled.
        """
        self._copy(database, theirs, _FEATURE_TABLES)

    def match(self, database: Path, theirs: Path, pairs: Sequence[tuple[str, str]]) -> None:
        """Match pairs, by names of images, that have no matches yet.

        Parameters
        ----------
        database
            Ours, which nobody has open; it takes the matches, which pycolmap verifies.
        theirs
            By :meth:`copy_features`.

        Raises
        ------
        MappingError
            Where it fails.
        """
        import pycolmap

        with self._both(database, theirs) as (ours, _):
            number = dict(ours.execute("SELECT name, image_id FROM images").fetchall())
            known = {pair for (pair,) in ours.execute("SELECT pair_id FROM matches")}
        named = {pycolmap.image_pair_to_pair_id(number[a], number[b]): (a, b) for a, b in pairs}
        asked = {pair: names for pair, names in named.items() if pair not in known}
        if not asked:
            return
        listed = theirs.with_suffix(".txt")
        listed.write_text("".join(f"{a} {b}\n" for a, b in asked.values()), encoding="utf-8")
        files = {"database_path": theirs, "match_list_path": listed, "match_type": "pairs"}
        self._run("matches_importer", files, {"skip_geometric_verification": 1})
        with self._both(database, theirs) as (ours, matched):
            rows = {row[0]: row for row in matched.execute(f"SELECT {_MATCH_COLUMNS} FROM matches")}
            # pycolmap would match a pair without a row again
            filled = [rows.get(pair, (pair, 0, 2, b"")) for pair in asked]
            ours.executemany(f"INSERT INTO matches ({_MATCH_COLUMNS}) VALUES (?, ?, ?, ?)", filled)
            for table in ("matches", "two_view_geometries"):
                matched.execute(f"DELETE FROM {table}")

    def map(
        self,
        database: Path,
        images: Path,
        sparse: Path,
        options: pycolmap.IncrementalPipelineOptions,
        registered: Callable[[], None],
    ) -> dict[int, pycolmap.Reconstruction]:
        """Map images of a database of ours; models are written to ``sparse/0``, ``sparse/1``, ... as pycolmap has them.

        There are none where it finds none.

        Parameters
        ----------
        options
            Those that differ from COLMAP's defaults here are used, where it has them.
        registered
            Is called for each image that it registers.

        Raises
        ------
        MappingError
            Where it fails.
        """
        import pycolmap

        names = ("ba_refine_focal_length", "ba_refine_extra_params", "ba_global_frames_ratio", "ba_global_points_ratio")
        own = {name: getattr(options, name) for name in (*names, "random_seed")}
        own |= {f"abs_pose_{name[3:]}": getattr(options, name) for name in names[:2]}
        models = {}
        with tempfile.TemporaryDirectory(dir=self.scratch) as folder:
            theirs, made = Path(folder) / "installed.db", Path(folder) / "models"
            self._copy(database, theirs, _VERIFIED_TABLES)
            made.mkdir()
            files = {"database_path": theirs, "image_path": images, "output_path": made}
            without_model: list[str] = []

            def read_line(line: str) -> None:
                if _REGISTERED in line:
                    registered()
                elif _NO_MODEL in line:
                    without_model.append(line)

            try:
                self._run("mapper", files, own, read_line)
            except MappingError:
                if not without_model:
                    raise
            for number in sorted(int(path.name) for path in made.iterdir() if path.name.isdigit()):
                check_binary_model(made / str(number))
                models[number] = pycolmap.Reconstruction(str(made / str(number)))
                (sparse / str(number)).mkdir()
                models[number].write_binary(str(sparse / str(number)))
        return models

    def _run(
        self,
        command: str,
        files: Mapping[str, object],
        own: Mapping[str, object],
        read_line: Callable[[str], None] = lambda _: None,
    ) -> None:
        use_gpu = int(self.executable.device == "cuda")
        named = self.executable.arguments(command, {"use_gpu": use_gpu, **own})
        self.executable.run(command, {**files, **named}, self.scratch / f"{command}.txt", read_line)

    def _copy(self, database: Path, theirs: Path, tables: Sequence[str]) -> None:
        """Make a database of its own, with what it has of some of our tables."""
        require_room(theirs, database.stat().st_size)
        self._run("database_creator", {"database_path": theirs}, {})
        with self._both(database, theirs) as (ours, copy):
            for table in tables:
                known = _columns(ours, table)
                common = [f'"{column}"' for column in _columns(copy, table) if column in known]
                if common:
                    rows = ours.execute(f"SELECT {', '.join(common)} FROM {table}")
                    marks = ", ".join("?" * len(common))
                    copy.executemany(f"INSERT INTO {table} ({', '.join(common)}) VALUES ({marks})", rows)

    @contextlib.contextmanager
    def _both(self, ours: Path, theirs: Path) -> Iterator[tuple[sqlite3.Connection, sqlite3.Connection]]:
        """Both databases, each in a transaction."""
        opened = [contextlib.closing(sqlite3.connect(path)) for path in (ours, theirs)]
        try:
            with opened[0] as first, opened[1] as second, first, second:
                yield first, second
        except sqlite3.Error as error:
            raise MappingError(
                Fact(
                    "database-not-usable-here",
                    program=str(self.executable.path),
                    version=self.executable.version,
                    detail=str(error),
                )
            ) from error


def _columns(database: sqlite3.Connection, table: str) -> list[str]:
    return [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
