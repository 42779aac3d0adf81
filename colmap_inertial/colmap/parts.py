"""Databases of parts of a capture: no more than some images' keypoints, and pairs of these images.

A process gets one of its own, which is quicker to read, and which nobody else has open.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Sequence
from pathlib import Path

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
