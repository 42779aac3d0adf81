"""Records of COLMAP's databases that would have COLMAP read or allocate beyond what is there."""

import contextlib
import dataclasses
import shutil
import sqlite3
import time

import numpy as np
import pycolmap
import pytest

from colmap_inertial.colmap.features.given_database import read_given
from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.sqlite import BOUNDS, open_foreign
from colmap_inertial.model.database import PlacedModel, check_records, copy_database, transform_database
from colmap_inertial.model.similarities import plain_factor
from colmap_inertial.model.submodels.matches import read_matches

#: A camera that a pair stores: 25 bytes, the number of its parameters, these.
COUNT = "substr(camera1, 1, 25) || x'ff' || substr(camera1, 27)"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("database") / "database.db"
    with pycolmap.Database.open(str(path)) as database:
        camera = pycolmap.Camera(model="OPENCV", width=640, height=480, params=[500, 501, 320, 240, 0.1, 0.2, 0, 0])
        camera.camera_id = database.write_camera(camera)
        first, second = (
            database.write_image(pycolmap.Image(name=name, camera_id=camera.camera_id)) for name in ("a.jpg", "b.jpg")
        )
        database.write_keypoints(first, np.ones((30, 2), np.float32))
        pair = pycolmap.TwoViewGeometry()
        pair.inlier_matches, pair.config = np.array([[i, i] for i in range(30)], np.uint32), 2
        pair.camera1 = pair.camera2 = camera
        database.write_two_view_geometry(first, second, pair)
    return path


def test_what_colmap_writes_is_whole(whole):
    check_records(whole)
    ((first, second, features),) = read_matches(whole, lambda *_: True)
    assert (first, second) == ("a.jpg", "b.jpg") and features.tolist() == [[i, i] for i in range(30)]


def test_only_a_whole_database_is_copied(subtests, whole, tmp_path):
    data, source, target = whole.read_bytes(), tmp_path / "a.db", tmp_path / "b.db"
    for text, words in (
        (data, None),
        (b"", None),
        (b"x" * len(data), "not an SQLite database"),
        (data[:99], "not an SQLite database"),
        (data[:-1], f"truncated: {len(data) - 1} bytes instead of"),
    ):
        with subtests.test(words):
            source.write_bytes(text)
            target.unlink(missing_ok=True)
            if words is None:
                copy_database(source, target)
                assert target.read_bytes() == text
            else:
                with pytest.raises(FormatError, match=words):
                    copy_database(source, target)
                assert not target.exists()


def test_records_of_another_size_are_refused_with_their_table(subtests, whole, tmp_path_factory):
    for table, change in (
        ("keypoints", "cols = 4"),
        ("keypoints", "rows = -30"),
        ("keypoints", "data = NULL"),
        ("cameras", "params = x'00'"),
        ("two_view_geometries", "rows = 31"),
        ("two_view_geometries", "rows = 'thirty'"),
        ("two_view_geometries", "F = x'00'"),
        ("two_view_geometries", "camera2 = 'text'"),
        ("two_view_geometries", "camera1 = x'00'"),
        ("two_view_geometries", f"camera1 = CAST({COUNT} AS BLOB)"),
        ("two_view_geometries", "camera1 = CAST(substr(camera1, 1, 40) AS BLOB)"),
    ):
        with subtests.test(table=table, change=change):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "database.db"
            shutil.copyfile(whole, path)
            with contextlib.closing(sqlite3.connect(path)) as database, database:
                database.execute(f"UPDATE {table} SET {change}")
            with pytest.raises(FormatError, match=f"a record of {table} has another size"):
                check_records(path)


#: A million million rows, from nothing.
ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n LIMIT 1000000000000) SELECT"
CODE = {
    "view": f"""DROP TABLE keypoints;
        CREATE VIEW keypoints AS {ENDLESS} x AS image_id, x - x + 1 AS rows, 2 AS cols, zeroblob(8) AS data FROM n""",
    "trigger": f"""INSERT INTO pose_priors VALUES (1, 1, 1, 0, zeroblob(24), NULL, NULL, 1);
        CREATE TRIGGER slow AFTER UPDATE ON pose_priors BEGIN
        SELECT count(*) FROM images a, images b WHERE a.image_id + b.image_id > ({ENDLESS} count(*) FROM n); END""",
    "virtual table": "DROP TABLE matches; CREATE VIRTUAL TABLE matches USING fts5(pair_id, rows, cols, data)",
}


@pytest.fixture(params=CODE)
def with_code(whole, tmp_path, request):
    path = tmp_path / "database.db"
    shutil.copyfile(whole, path)
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.executescript(CODE[request.param])
    return path, request.param


def test_code_in_a_database_is_refused_before_it_runs(with_code, tmp_path):
    path, kind = with_code
    where = PlacedModel(index=0, centres={"a.jpg": np.zeros(3)}, sensors={})
    for read in (
        check_records,
        read_given,
        lambda path: transform_database(path, tmp_path / "copy.db", [where], {0: plain_factor(2.0)}),
        lambda path: list(read_matches(path, lambda *_: True)),
    ):
        with pytest.raises(FormatError, match=f"it holds the {kind} .*, which is not run; drop it"):
            read(path)


def test_values_that_columns_make_up_are_bounded(whole, tmp_path):
    path = tmp_path / "database.db"
    shutil.copyfile(whole, path)
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.executescript("""
            DROP TABLE keypoints;
            CREATE TABLE keypoints (image_id, rows, cols, data AS (zeroblob(2 * 400000000)));
            INSERT INTO keypoints VALUES (1, 30, 2)""")
    with pytest.raises(FormatError, match="too big"):
        check_records(path)


def test_what_takes_longer_than_its_size_explains_is_ended(whole, monkeypatch):
    monkeypatch.setattr("colmap_inertial.io.sqlite.BOUNDS", dataclasses.replace(BOUNDS, seconds=0.2))
    start_s = time.thread_time()
    with pytest.raises(FormatError, match="takes longer than its size explains"), open_foreign(whole) as database:
        database.execute(f"{ENDLESS} count(*) FROM n").fetchone()
    assert time.thread_time() - start_s < 2.0


def test_time_is_allowed_by_size(whole, tmp_path, monkeypatch):
    path = tmp_path / "large.db"
    shutil.copyfile(whole, path)
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE more AS SELECT zeroblob(30000000) AS data")
    monkeypatch.setattr("colmap_inertial.io.sqlite.BOUNDS", dataclasses.replace(BOUNDS, seconds=-1.0))
    check_records(path)
    with pytest.raises(FormatError, match="takes longer"), open_foreign(whole) as database:
        database.execute(f"{ENDLESS} count(*) FROM n").fetchone()
