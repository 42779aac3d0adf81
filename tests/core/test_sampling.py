"""Samples over time: gaps and integrals."""

import numpy as np
import pytest

from colmap_inertial.core.sampling import (
    Coverage,
    find_clipped,
    integral_at,
    is_gap,
    subtract_running_mean,
    time_unit_factor,
)


def test_a_gap_is_longer_than_asked_in_seconds_and_in_usual_steps():
    t_s = np.cumsum([0.0, 0.01, 0.01, 0.04, 0.01, 0.2, 0.01])
    assert is_gap(t_s).tolist() == [False, False, False, False, True, False]
    assert is_gap(t_s, 0.02).tolist() == [False, False, True, False, True, False]
    assert is_gap(t_s, 0.02, steps=5.0).tolist() == [False, False, False, False, True, False]
    assert not is_gap(np.array([3.0])).any()


def test_what_lies_inside_and_has_no_gap_is_covered(subtests):
    for begin_s, end_s, covered in (
        (0.0, 1.0, True),
        (0.5, 1.005, True),
        (0.5, 1.05, False),
        (1.05, 1.1, False),
        (1.2, 2.0, True),
        (1.9, 2.01, False),
        (-0.01, 0.5, False),
    ):
        with subtests.test(begin_s=begin_s, end_s=end_s, covered=covered):
            t_s = np.concatenate([np.arange(0, 101) / 100, 1.01 + np.arange(1) / 100, 1.2 + np.arange(81) / 100])
            assert Coverage(t_s).covers(np.array([begin_s]), np.array([end_s])).tolist() == [covered]


def test_an_integral_is_that_of_straight_lines_between_samples():
    t_s = np.array([0.0, 0.5, 2.0])
    values = np.array([[0.0, 1.0, 2.0], [1.0, 1.0, 0.0], [1.0, 1.0, 3.0]])
    np.testing.assert_allclose(integral_at(t_s, values, np.array([[0.0, 0.5], [1.25, 2.0]])), [
        [[0, 0, 0], [0.25, 0.5, 0.5]], [[1.0, 1.25, 1.625], [1.75, 2.0, 2.75]]
    ])  # fmt: skip


def test_what_is_slow_is_taken_out_and_what_is_quick_stays():
    t_s = np.arange(200) / 100
    slow, quick = 3.0 + 2.0 * t_s, np.where(np.arange(200) % 2, 1.0, -1.0)
    left = subtract_running_mean(np.stack([slow, slow + quick], axis=1), 21)
    assert left.shape == (180, 2)
    assert np.abs(left[:, 0]).max() < 1e-12
    assert np.abs(left[:, 1] - quick[10:190]).max() < 0.05


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
