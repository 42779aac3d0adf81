"""Frames that are in no model have the reason that COLMAP's database shows."""

import sqlite3
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Action
from colmap_inertial.run.commands import unplaced
from colmap_inertial.run.stages.frame_folder import FrameRecord

#: Images by number, with their features.
FEATURES = {"a": 900, "b": 800, "black": 3, "alone": 700, "weak": 600, "other": 500, "dropped": 0}
#: Pairs that agree, with their matches.
PAIRS = {("a", "b"): 300, ("b", "weak"): 17, ("a", "weak"): 12, ("alone", "other"): 90, ("black", "alone"): 0}


@pytest.fixture
def database(tmp_path: Path) -> Path:
    path = tmp_path / "database.db"
    number = {name: i + 1 for i, name in enumerate(FEATURES)}
    with closing(sqlite3.connect(path)) as rows:
        rows.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
        rows.execute("CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER)")
        rows.execute("CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER)")
        rows.executemany("INSERT INTO images VALUES (?, ?)", [(i, name) for name, i in number.items()])
        rows.executemany("INSERT INTO keypoints VALUES (?, ?)", [(number[name], n) for name, n in FEATURES.items()])
        for pair, count in PAIRS.items():
            first, second = sorted(number[name] for name in pair)
            rows.execute("INSERT INTO two_view_geometries VALUES (?, ?)", (first * 2147483647 + second, count))
        rows.commit()
    return path


def test_frames_in_no_model_have_a_reason(database: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = {name: SimpleNamespace(name=name, has_pose=name in "ab") for name in ("a", "b", "weak")}
    monkeypatch.setattr(unplaced, "read_model", lambda folder: SimpleNamespace(images=images))
    records = [
        FrameRecord(name=name, action=Action.DROPPED if name == "dropped" else Action.PASSED) for name in FEATURES
    ]
    noted = unplaced.note_unplaced(records, [database.parent], database)
    assert {record.name: record.reason for record in noted} == {
        "a": None,
        "b": None,
        "black": Fact("image-without-features", features=3),
        "alone": Fact("image-without-matches", features=700),
        "weak": Fact("image-not-placed", images=2, matches=17),
        "other": Fact("image-without-matches", features=500),
        "dropped": None,
    }
    assert all(record.action == before.action for record, before in zip(noted, records, strict=True))
    # a database that is gone says nothing
    assert unplaced.note_unplaced(records, [database.parent], database.with_name("gone.db")) == tuple(records)
