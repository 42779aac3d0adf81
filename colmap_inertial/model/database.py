"""Lengths in COLMAP's database: pose priors and rigs. Through SQLite, on a copy.

pycolmap migrates every database that it opens, and no older COLMAP opens it afterwards; so it is not asked.
"""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import Similarity
from colmap_inertial.io.files import reading
from colmap_inertial.io.sqlite import open_foreign
from colmap_inertial.io.stand_ins import refuse_stand_in

SIDE_FILES = ("-wal", "-journal")
_MATRIX = (
    "typeof(rows) = 'integer' AND typeof(cols) = 'integer' AND rows BETWEEN 0 AND 1e9 AND cols BETWEEN 0 AND 1e6 AND "
)
_HELD = "coalesce(length(data), 0)"
#: What holds of each record of COLMAP's tables, in SQL: as many bytes as its rows and columns, and as its type, have.
_RECORDS = {
    "keypoints": f"{_MATRIX} {_HELD} = 4 * rows * cols",
    "descriptors": f"{_MATRIX} {_HELD} IN (rows * cols, 4 * rows * cols)",
    "matches": f"{_MATRIX} {_HELD} = 4 * rows * cols",
    "two_view_geometries": f"{_MATRIX} {_HELD} = 4 * rows * cols"
    + "".join(
        f" AND coalesce(length({name}), 0) IN (0, {size})"
        for name, size in (("F", 72), ("E", 72), ("H", 72), ("qvec", 32), ("tvec", 24))
    ),
    "cameras": "coalesce(length(params), 0) % 8 = 0",
}
#: COLMAP 4 also stores the cameras of a pair: 33 bytes, then the parameters, whose count is the last of these numbers.
_PAIR_CAMERAS = "".join(
    f" AND ({name} IS NULL OR typeof({name}) = 'blob' AND length({name}) BETWEEN 33 AND 2000 AND "
    f"hex(substr({name}, 26, 8)) = printf('%02X00000000000000', (length({name}) - 33) / 8))"
    for name in ("camera1", "camera2")
)
#: What is said of a database that COLMAP cannot read.
UNREADABLE = Fact("database-unreadable")
#: Rebuilt by SQLite; a copy must not have it.
SHARED_MEMORY = "-shm"

#: COLMAP's numbers of a coordinate system and of a kind of sensor.
_WGS84, _CAMERA = 0, 0
#: Two models are in one frame when the cameras they share stand closer together than this share of their extent.
_SAME_CENTRE = 0.01
#: Priors and rigs of a database count as the model's when they differ from it by less than this share of its size.
_SAME_FRAME = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedModel:
    """Positions of a model's cameras, and its transform.

    Attributes
    ----------
    index
        Its number among the sub-models.
    centres
        (3,) camera centre of each image, by name, before the similarity.
    sensors
        (3,) translation of ``sensor_from_rig``, by sensor type and id.
    points
        (N, 3) some of its points.
    """

    index: int
    centres: Mapping[str, Array]
    sensors: Mapping[tuple[int, int], Array]
    points: Array = field(default_factory=lambda: np.empty((0, 3)))

    def shown(self) -> Array:
        """(N, 3) where its cameras and points are."""
        return np.concatenate([np.array(list(self.centres.values())).reshape(-1, 3), self.points])

    def extent(self) -> float:
        """Diagonal of the box around the cameras."""
        centres = np.array(list(self.centres.values()))
        return float(np.linalg.norm(np.ptp(centres, axis=0)))

    def has_cameras_at(self, pairs: Sequence[tuple[Array, Array]]) -> bool:
        """Whether centres of its cameras, each with its position elsewhere, are at the same positions."""
        return are_near(pairs, max(_SAME_CENTRE * self.extent(), 1e-9))


def are_near(pairs: Sequence[tuple[Array, Array]], largest: float) -> bool:
    """Whether the median distance between the places of pairs is at most ``largest``."""
    return float(np.median([np.linalg.norm(a - b) for a, b in pairs])) <= largest


@dataclass(frozen=True, kw_only=True)
class DatabaseChange:
    """Changes of a database: numbers of rows, and the models whose priors and rigs it has."""

    priors_moved: int = 0
    priors_kept: int = 0
    rigs_moved: int = 0
    rigs_kept: int = 0
    prior_models: tuple[int, ...] = ()
    rig_models: tuple[int, ...] = ()


def is_database(path: Path) -> bool:
    """Whether this is an SQLite file, or has the name of COLMAP's."""
    with open(path, "rb") as file:
        return path.name == "database.db" or file.read(16) == b"SQLite format 3\0"


@contextlib.contextmanager
def open_read_only(database: Path) -> Iterator[sqlite3.Connection]:
    """Open a database and leave no trace beside it, as SQLite does where the last writer kept a log ahead of writing.

    One whose log still holds something is read from a copy.
    """
    with contextlib.ExitStack() as stack:
        path = database
        if any(database.with_name(database.name + suffix).exists() for suffix in SIDE_FILES):
            path = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="colmap-inertial-"))) / database.name
            copy_database(database, path)
        mode: Literal["mode=ro", "immutable=1"] = "immutable=1" if path == database else "mode=ro"
        yield stack.enter_context(open_foreign(path, mode=mode, source=database, fault=UNREADABLE))


def find_database(project: Path, files: Sequence[Path]) -> Path | None:
    """The database of a project that holds matches: the one in its root, or its only one; ``None`` without.

    ``files`` are those of the project, relative to it.
    """
    named = sorted((path for path in files if path.suffix == ".db"), key=lambda path: len(path.parts))
    databases = [project / path for path in named if _has_pairs(project / path)]
    return databases[0] if len(databases) == 1 or (databases and databases[0].parent == project) else None


def _has_pairs(path: Path) -> bool:
    try:
        with open_read_only(path) as opened:
            return opened.execute("SELECT 1 FROM two_view_geometries LIMIT 1").fetchone() is not None
    except FormatError:
        return False  # no database, or one of another program


def check_records(database: Path) -> None:
    """Refuse records of another size than they state: COLMAP would read or write beyond their end.

    Raises
    ------
    FormatError
        That names the table; also as of :func:`~colmap_inertial.io.sqlite.open_foreign`.
    """
    with reading(database, UNREADABLE), open_read_only(database) as opened:
        columns = {row[1] for row in opened.execute("PRAGMA table_info(two_view_geometries)")}
        for table, holds in _RECORDS.items():
            if table == "two_view_geometries" and {"camera1", "camera2"} <= columns:
                holds += _PAIR_CAMERAS
            if opened.execute(f"SELECT 1 FROM {table} WHERE NOT ({holds}) LIMIT 1").fetchone() is not None:
                raise FormatError(database, Fact("record-of-other-size", table=table))


def copy_database(source: Path, target: Path) -> None:
    """Copy a database with what SQLite has beside it; no hard link, as SQLite writes in place.

    Raises
    ------
    FormatError
        When it is shorter than it says.
    """
    with open(source, "rb") as file:
        head = file.read(100)
    size = source.stat().st_size
    alone = not any(source.with_name(source.name + suffix).exists() for suffix in SIDE_FILES)
    refuse_stand_in(source, head)
    if size and (len(head) < 100 or not head.startswith(b"SQLite format 3\0")):
        raise FormatError(source, Fact("not-sqlite"))
    page = int.from_bytes(head[16:18], "big")
    pages = int.from_bytes(head[28:32], "big")
    if size and alone and head[24:28] == head[92:96] and pages * (65536 if page == 1 else page) > size:
        raise FormatError(source, Fact("database-truncated", size_bytes=size, pages=pages, page_bytes=page))
    for suffix in ("", *SIDE_FILES):
        beside = source.with_name(source.name + suffix)
        if beside.exists():
            shutil.copyfile(beside, target.with_name(target.name + suffix))


def transform_database(
    source: Path,
    target: Path,
    models: Sequence[PlacedModel],
    similarities: Mapping[int, Similarity | None],
    *,
    prior_models: Collection[int] | None = None,
    rig_models: Collection[int] | None = None,
) -> DatabaseChange:
    """Copy a database with the pose priors and rigs moved that are in a model's frame.

    Priors in degrees (WGS84) stay, and so do Cartesian ones and rigs that do not lie where the model has them: they
    are in a frame of their own. Gravity is a direction in the camera's frame and stays.

    Parameters
    ----------
    source, target
        Databases; the source is not opened.
    models, similarities
        The sub-models and, by number, what is applied to them (``None``: left alone).
    prior_models, rig_models
        The models whose priors and rigs are in the database, where it is known; otherwise their positions tell.

    Raises
    ------
    FormatError
        For a damaged database; also as of :func:`~colmap_inertial.io.sqlite.open_foreign`.
    """
    copy_database(source, target)
    try:
        with open_foreign(target, mode="mode=rw", source=source) as database, database:
            return _transform(database, source, models, similarities, prior_models, rig_models)
    finally:
        target.with_name(target.name + SHARED_MEMORY).unlink(missing_ok=True)


def _transform(
    database: sqlite3.Connection,
    path: Path,
    models: Sequence[PlacedModel],
    similarities: Mapping[int, Similarity | None],
    prior_models: Collection[int] | None,
    rig_models: Collection[int] | None,
) -> DatabaseChange:
    # The pages of the tables that matter; a check of the whole takes minutes on a large database
    tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    for table in tables & {"pose_priors", "rig_sensors", "images"}:
        answer = database.execute(f"PRAGMA quick_check({table})").fetchone()[0]
        if answer != "ok":
            raise FormatError(path, Fact("database-check-failed", detail=answer))
    priors = list(_priors(database, path)) if {"pose_priors", "images"} <= tables else []
    priors = [prior for prior in priors if not prior.in_degrees]
    rigs = list(_rigs(database, path)) if "rig_sensors" in tables else []
    moved_priors: set[int] = set()
    moved_rigs: set[int] = set()
    used_priors, used_rigs = [], []
    for model in models:
        similarity = similarities[model.index]
        own_priors = [p for p in priors if p.key in model.centres and p.rowid not in moved_priors]
        if _are_in_frame(own_priors, model.centres, model.extent(), model.index, prior_models) and similarity:
            moved_priors |= _move(database, "pose_priors", own_priors, similarity)
            used_priors.append(model.index)
        own_rigs = [r for r in rigs if r.key in model.sensors and r.rowid not in moved_rigs]
        size = max((float(np.linalg.norm(model.sensors[r.key])) for r in own_rigs), default=0.0)
        if _are_in_frame(own_rigs, model.sensors, size, model.index, rig_models) and similarity:
            moved_rigs |= _move(database, "rig_sensors", own_rigs, similarity)
            used_rigs.append(model.index)
    return DatabaseChange(
        priors_moved=len(moved_priors),
        priors_kept=len(priors) - len(moved_priors),
        rigs_moved=len(moved_rigs),
        rigs_kept=len(rigs) - len(moved_rigs),
        prior_models=tuple(used_priors),
        rig_models=tuple(used_rigs),
    )


@dataclass(frozen=True, eq=False)
class _Prior:
    """A pose prior of the image ``key``, at (3,) ``place``: latitude, longitude, height where it is ``in_degrees``."""

    rowid: int
    key: str
    place: Array
    covariance: Array | None
    in_degrees: bool

    def moved(self, similarity: Similarity) -> dict[str, Array]:
        """The columns that change."""
        rotation = matrix_from_quat(similarity.rotation_xyzw)
        columns = {"position": similarity.scale * rotation @ self.place + similarity.translation_m}
        if self.covariance is not None:
            columns["position_covariance"] = similarity.scale**2 * rotation @ self.covariance @ rotation.T
        return columns


@dataclass(frozen=True, eq=False)
class _Rig:
    """A sensor of a rig by type and id, at (3,) ``place`` of ``sensor_from_rig``."""

    rowid: int
    key: tuple[int, int]
    rotation: Array
    place: Array

    def moved(self, similarity: Similarity) -> dict[str, Array]:
        """The columns that change."""
        return {"sensor_from_rig": np.append(self.rotation, similarity.scale * self.place)}


def _move(database: sqlite3.Connection, table: str, rows: Sequence[_Prior | _Rig], similarity: Similarity) -> set[int]:
    """Move rows of a table; their numbers."""
    for row in rows:
        for column, values in row.moved(similarity).items():
            database.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (values.tobytes(), row.rowid))
    return {row.rowid for row in rows}


def _are_in_frame(
    rows: Sequence[_Prior | _Rig],
    places: Mapping[Any, Array],
    size: float,
    model: int,
    decided: Collection[int] | None,
) -> bool:
    """Whether there are rows and they are in the frame of a model of this size, by an earlier decision or by their
    positions.
    """
    if not rows or decided is not None:
        return bool(rows) and decided is not None and model in decided
    return are_near([(row.place, places[row.key]) for row in rows], _SAME_FRAME * size)


def _doubles(path: Path, what: str, blob: object, count: int) -> Array | None:
    if blob is None:
        return None
    if not isinstance(blob, bytes) or len(blob) != 8 * count:
        raise FormatError(path, Fact("blob-of-other-length", what=what, count=count))
    return np.frombuffer(blob, "<f8")


def _priors(database: sqlite3.Connection, path: Path) -> Iterator[_Prior]:
    """Priors of images; COLMAP 3 keeps them by image, 4 by sensor and datum."""
    columns = {row[1] for row in database.execute("PRAGMA table_info(pose_priors)")}
    join = "p.image_id = i.image_id"
    if "corr_data_id" in columns:
        join = f"p.corr_data_id = i.image_id AND p.corr_sensor_type = {_CAMERA}"
    covariance = "p.position_covariance" if "position_covariance" in columns else "NULL"
    query = (
        f"SELECT p.rowid, i.name, p.position, {covariance}, p.coordinate_system "
        f"FROM pose_priors p JOIN images i ON {join} ORDER BY p.rowid"
    )
    for rowid, name, blob, cov, system in database.execute(query):
        position = _doubles(path, "prior's position", blob, 3)
        spread = _doubles(path, "prior's covariance", cov, 9)
        if position is None or not np.isfinite(position[: 2 if system == _WGS84 else 3]).all():
            continue
        yield _Prior(rowid, name, position, None if spread is None else spread.reshape(3, 3), system == _WGS84)


def read_priors(database: Path) -> dict[bool, dict[str, Array]]:
    """(3,) pose priors by image; those in degrees (latitude, longitude, height) under ``True``, others under ``False``.

    Raises
    ------
    FormatError
        For a damaged database.
    """
    with open_read_only(database) as opened:
        tables = {row[0] for row in opened.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        priors = list(_priors(opened, database)) if {"pose_priors", "images"} <= tables else []
    return {kind: {p.key: p.place for p in priors if p.in_degrees == kind} for kind in (True, False)}


def _rigs(database: sqlite3.Connection, path: Path) -> Iterator[_Rig]:
    for rowid, kind, sensor, blob in database.execute(
        "SELECT rowid, sensor_type, sensor_id, sensor_from_rig FROM rig_sensors ORDER BY rowid"
    ):
        pose = _doubles(path, "pose of a sensor in its rig", blob, 7)
        if pose is not None:
            yield _Rig(rowid, (kind, sensor), pose[:4], pose[4:])
