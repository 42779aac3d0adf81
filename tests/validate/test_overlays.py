"""Overlays of a validation."""

from colmap_inertial.validate.overlays import _ticks


def test_ticks_are_the_round_numbers_nearest_to_six():
    assert _ticks(0.0, 10.0) == [0, 2, 4, 6, 8, 10]
    assert _ticks(-0.25, 0.31) == [-0.2, -0.1, 0.0, 0.1, 0.2, 0.3]
