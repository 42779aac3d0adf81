"""Readings that are cut off, and units of time."""

import numpy as np
import pytest

from colmap_inertial.core.sampling import find_clipped, time_unit_factor


def test_readings_are_cut_off_where_their_end_is_common_and_what_is_next_to_it_is_rare():
    spread = np.linspace(-1, 0, 25)
    rare, common = (np.concatenate([np.repeat(spread, times), np.full(8, 5.0)]) for times in (1, 4))
    # the next reading is far from the end: how often it comes counts all the same
    assert find_clipped(np.stack([rare], axis=1))[:, 0].tolist() == [False] * 25 + [True] * 8
    assert not find_clipped(np.stack([common], axis=1)).any()


@pytest.mark.parametrize(
    ("span_s", "other_s", "factor"),
    [
        (2e3, 2.0, 1e3),
        (9.0e6, 3.0, 1e6),
        (2e-9, 1.0, 1e-9),
        (1.0, 1e3, 1e-3),
        (4.0, 1.0, None),
        (4e4, 1.0, None),
        (4.9e3, 1.0, 1e3),
    ],
)
def test_a_clock_in_another_unit_is_off_by_a_power_of_a_thousand(span_s, other_s, factor):
    assert time_unit_factor(span_s, other_s) == (None if factor is None else pytest.approx(factor))
