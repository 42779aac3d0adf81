"""Numbers and lengths in text."""

import pytest

from colmap_inertial.report.words import digits, fixed, half_width_pct, length, length_error


def test_numbers_and_lengths_are_written_as_people_do():
    numbers = (0.123456, 12345.6, 123456789.0, 1e9, -1e9, 1e-7)
    assert [digits(v) for v in numbers] == ["0.1235", "12346", "123456789", "1e+09", "-1e+09", "1e-07"]
    assert [fixed(v) for v in (2.0, 1234.0, 123456.0, 1e9, -1e9)] == [
        *("2.000", "1234", "123456", "1.000e+09", "-1.000e+09"),
    ]
    assert [length(v) for v in (2.5, 0.9996, 0.5, 0.00999, 0.004)] == ["2.5 m", "1 m", "50 cm", "9.99 mm", "4 mm"]
    assert length_error(0.25) == "2.5 cm" and half_width_pct(2.0, (1.9, 2.1)) == pytest.approx(5.0)
