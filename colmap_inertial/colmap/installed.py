"""Features and matches by an installed COLMAP, in a database that it made itself.

COLMAP of an earlier version does not open a database that pycolmap has opened. So there are two, and rows go between
them: what both have in common, with the same numbers of cameras, images and pairs.
"""

from __future__ import annotations

import contextlib
import re
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from colmap_inertial.core.errors import MappingError
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.pipeline.run.context import RunContext
from colmap_inertial.pipeline.run.executable import ColmapExecutable

#: Tables of images and features, in an order in which none refers to a later one. Earlier versions have fewer.
_FEATURE_TABLES = ("rigs", "rig_sensors", "cameras", "frames", "frame_data", "images", "keypoints", "descriptors")
_MATCH_COLUMNS = "pair_id, rows, cols, data"
_PROCESSED = re.compile(r"Processed file \[(\d+)/\d+\]")


@dataclass(frozen=True, eq=False, kw_only=True)
class InstalledColmap:
    """An installed COLMAP at work in a run.

    Attributes
    ----------
    executable
        The program.
    context
        How the work is done; the logs of its commands are kept in ``scratch``.
    """

    executable: ColmapExecutable
    context: RunContext

    def find_features(self, images: Path, names: Sequence[str], database: Path, options: MappingOptions) -> None:
        """Find the features of images.

        Parameters
        ----------
        images, names
            Folder, and names in it.
        database
            A path that does not exist; this COLMAP's own database.

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
        progress = self.context.progress

        def tell(line: str) -> None:
            if (found := _PROCESSED.search(line)) is not None:
                progress("features", min(int(found[1]), len(names)), len(names))

        progress("features", 0, len(names))
        files = {"database_path": database, "image_path": images, "image_list_path": listed}
        self._run("feature_extractor", files, own, tell)

    def copy_features(self, database: Path, theirs: Path) -> None:
        """Make a database of this COLMAP's own with the images and features of ours, which nobody has open.

        Raises
        ------
        MappingError
            Where its tables cannot be filled.
        """
        self._run("database_creator", {"database_path": theirs}, {})
        with self._both(database, theirs) as (ours, copy):
            for table in _FEATURE_TABLES:
                known = _columns(ours, table)
                common = [f'"{column}"' for column in _columns(copy, table) if column in known]
                if common:
                    rows = ours.execute(f"SELECT {', '.join(common)} FROM {table}")
                    marks = ", ".join("?" * len(common))
                    copy.executemany(f"INSERT INTO {table} ({', '.join(common)}) VALUES ({marks})", rows)

    def match(self, database: Path, theirs: Path, pairs: Sequence[tuple[str, str]]) -> None:
        """Match pairs that have no matches yet, for verification.

        Parameters
        ----------
        database
            Ours, which nobody has open; it takes the matches.
        theirs
            By :meth:`copy_features`.
        pairs
            Names of images.

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
        # pycolmap verifies them, with its options
        self._run("matches_importer", files, {"skip_geometric_verification": 1})
        with self._both(database, theirs) as (ours, found):
            rows = {row[0]: row for row in found.execute(f"SELECT {_MATCH_COLUMNS} FROM matches")}
            # pycolmap would match a pair without a row again
            filled = [rows.get(pair, (pair, 0, 2, b"")) for pair in asked]
            ours.executemany(f"INSERT INTO matches ({_MATCH_COLUMNS}) VALUES (?, ?, ?, ?)", filled)
            for table in ("matches", "two_view_geometries"):
                found.execute(f"DELETE FROM {table}")

    def _run(
        self,
        command: str,
        files: Mapping[str, object],
        own: Mapping[str, object],
        heard: Callable[[str], None] = lambda _: None,
    ) -> None:
        work = {"use_gpu": int(self.executable.device == "cuda"), "num_threads": self.context.num_threads}
        named = self.executable.arguments(command, {**work, **own}, self.context.colmap)
        self.executable.run(command, {**files, **named}, self.context.scratch / f"{command}.txt", heard)

    @contextlib.contextmanager
    def _both(self, ours: Path, theirs: Path) -> Iterator[tuple[sqlite3.Connection, sqlite3.Connection]]:
        """Both databases, open in one transaction each."""
        try:
            with (
                contextlib.closing(sqlite3.connect(ours)) as first,
                contextlib.closing(sqlite3.connect(theirs)) as second,
                first,
                second,
            ):
                yield first, second
        except sqlite3.Error as error:
            raise MappingError(
                f"{self.executable.path} (COLMAP {self.executable.version}): its database cannot be used here: {error}"
            ) from error


def _columns(database: sqlite3.Connection, table: str) -> list[str]:
    return [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
