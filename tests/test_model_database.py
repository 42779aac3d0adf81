"""Records of COLMAP's databases that would have COLMAP read or allocate beyond what is there."""

import contextlib
import shutil
import sqlite3

import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.model.database import check_records
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


@pytest.mark.parametrize(
    ("table", "change"),
    [
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
    ],
)
def test_records_of_another_size_are_refused_with_their_table(whole, tmp_path, table, change):
    path = tmp_path / "database.db"
    shutil.copyfile(whole, path)
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute(f"UPDATE {table} SET {change}")
    with pytest.raises(FormatError, match=f"a record of {table} has another size"):
        check_records(path)
