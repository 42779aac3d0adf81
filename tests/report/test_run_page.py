"""Numbers on the page of a run."""

from colmap_inertial.report.run_page import _round_to_sigma


def test_values_are_rounded_to_the_second_digit_of_their_standard_deviation():
    rounded = [_round_to_sigma(1234.56789, sigma) for sigma in (None, 123.0, 1.23, 0.0123)]
    assert rounded == [("1234.57", ""), ("1235", "123"), ("1234.6", "1.2"), ("1234.568", "0.012")]
