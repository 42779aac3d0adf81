"""Columns of phyphox exports."""

from types import SimpleNamespace

import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.phyphox import _column


def test_a_column_of_phyphox_is_found_by_its_pattern():
    table = SimpleNamespace(path="a.csv", header=("Time (s)", " Gyroscope x (rad/s)"), header_text="Time (s), ...")
    assert _column(table, r"time.*") == 0 and _column(table, r"gyroscope x.*") == 1
    with pytest.raises(FormatError, match="no column like 'accelerometer'"):
        _column(table, "accelerometer")
