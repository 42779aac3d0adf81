"""Coverage of intervals as the studies print it."""

import numpy as np
import pytest

from scripts.common.interval_coverage import measure_coverage


def test_intervals_of_shares_are_clopper_and_pearson_s():
    all_hold = measure_coverage({"a": [True] * 20, "b": [True] * 10})
    assert all_hold.interval == pytest.approx((0.025 ** (1 / 30), 1.0))
    assert (all_hold.held, all_hold.count, all_hold.design) == (30, 30, 1.0)
    none_holds = measure_coverage({"a": [False] * 5})
    assert none_holds.interval == pytest.approx((0.0, 1 - 0.025 ** (1 / 5)))
    assert none_holds.p_value < 1e-5
    assert measure_coverage({"a": []}) is None


def test_windows_that_repeat_each_other_count_once():
    """Of 40 recordings two are wrong throughout: 30 windows of each say as much as one, and 95 % stand."""
    held = np.arange(40) >= 2
    once = measure_coverage({str(i): [bool(one)] for i, one in enumerate(held)})
    often = measure_coverage({str(i): [bool(one)] * 30 for i, one in enumerate(held)})
    assert once.design == pytest.approx(40 / 39) and often.design == pytest.approx(30 * 40 / 39)
    assert often.p_value == pytest.approx(once.p_value, abs=0.1) and often.p_value > 0.5
    apart = measure_coverage({str(i): [j >= 4 for j in range(30)] for i in range(40)})
    assert apart.design == 1.0 and apart.p_value < 0.001


def test_the_test_holds_its_level_where_windows_of_a_recording_are_alike():
    rng, rejected = np.random.default_rng(3), 0
    for _ in range(200):
        fails = rng.beta(0.05 * 8, 0.95 * 8, 20)
        rejected += measure_coverage({str(i): list(rng.random(15) > p) for i, p in enumerate(fails)}).p_value < 0.01
    assert rejected <= 8
