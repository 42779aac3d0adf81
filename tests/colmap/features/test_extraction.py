"""Room for features."""

from types import SimpleNamespace

import pytest

from colmap_inertial.colmap.features.extraction import require_room_for_features
from colmap_inertial.core.errors import OutputError
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.io import disk


def test_a_feature_needs_room_for_its_place_and_its_descriptor(tmp_path, monkeypatch):
    """Six numbers of four bytes and 128 of one, for as many as an image may have; four times that is plenty."""
    options, free = MappingOptions(max_num_features=50), SimpleNamespace(free=0)
    monkeypatch.setattr(disk.shutil, "disk_usage", lambda _: free)
    free.free = 7 * 50 * (6 * 4 + 128) - 1
    with pytest.raises(OutputError, match="nearly full"):
        require_room_for_features(tmp_path / "database.db", 7, options)
    free.free = 4 * 7 * 50 * (6 * 4 + 128)
    require_room_for_features(tmp_path / "database.db", 7, options)
    with pytest.raises(OutputError, match="nearly full"):
        require_room_for_features(tmp_path / "database.db", 7, options, copies=4)
