"""Room on a disk."""

from types import SimpleNamespace

import pytest

from colmap_inertial.core.errors import OutputError
from colmap_inertial.io import disk
from colmap_inertial.io.disk import require_room


def test_a_file_may_fill_its_disk_and_its_limit_and_no_more(tmp_path, monkeypatch):
    file, absent = tmp_path / "made", tmp_path / "absent"
    file.write_bytes(bytes(100))
    monkeypatch.setattr(disk.shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    for copies, most in ((1, 1000), (2, 500)):
        require_room(file, most, copies=copies)
        with pytest.raises(OutputError, match="nearly full"):
            require_room(file, most + 1, copies=copies)
    monkeypatch.setattr(disk, "_largest_file_bytes", lambda: 700)
    for path, most in ((file, 600), (absent, 700)):
        require_room(path, most)
        with pytest.raises(OutputError, match="a file may have"):
            require_room(path, most + 1)
