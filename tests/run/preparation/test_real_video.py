"""Real video that the check before a reconstruction must not stop."""

import shutil
from pathlib import Path

import pytest

from colmap_inertial import ScaleSource, diagnose_source

ROOM = Path(__file__).parents[4] / "shared" / "data" / "handheld_room"


@pytest.mark.skipif(not ROOM.is_dir(), reason="the recordings are not there")
@pytest.mark.parametrize("part", [slice(0, 62), slice(93, None), slice(0, None, 2)], ids=["begin", "end", "half"])
def test_parts_of_a_room_that_is_walked_through_are_not_stopped(tmp_path, part):
    """In the second half the camera moves ahead: frames that are followed take its parallax for rotation."""
    head, *rows = (ROOM / "frames.csv").read_text().splitlines()
    for path in ROOM.iterdir():
        if path.is_file():
            shutil.copyfile(path, tmp_path / path.name)
    (tmp_path / "frames.csv").write_text("\n".join([head, *rows[part]]) + "\n")
    names = {row.partition(",")[0] for row in rows[part]}
    (tmp_path / "frames").mkdir()
    for name in names:
        shutil.copyfile(ROOM / "frames" / name, tmp_path / "frames" / name)
    found = diagnose_source(ScaleSource(source=tmp_path))
    assert [finding.code for finding in found.findings if finding.severity == "error"] == []
    assert not {"imu-does-not-fit", "offset-undecided"} & {finding.code for finding in found.findings}
