"""What users write for a target, and where its corners are."""

import numpy as np
import pytest

from colmap_inertial.validate import TargetSpecError, parse_target
from tests.helpers.cases import loop_over


def distance(target, a, b):
    return np.linalg.norm(target.corners_m[a] - target.corners_m[b])


def test_a_checkerboard_counts_inner_corners_row_by_row():
    target = parse_target("checkerboard:9x6:0.025")
    assert target.corners_m.shape == (54, 3)
    assert distance(target, 0, 1) == pytest.approx(0.025)
    assert distance(target, 0, 53) == pytest.approx(0.025 * np.hypot(8, 5))
    assert target.label(9) == "r1c0"
    np.testing.assert_allclose(target.corners_m.mean(axis=0), 0, atol=1e-12)


def test_a_checkerboard_looks_the_same_after_half_turns_and_a_square_one_after_quarter_turns(subtests):
    for spec, turns in (("checkerboard:9x6:0.025", 2), ("checkerboard:7x7:0.025", 4)):
        with subtests.test(spec=spec, turns=turns):
            target = parse_target(spec)
            assert len(target.relabelings) == turns
            for numbers in target.relabelings:  # each is a turn of the board into itself, never a mirror image
                moved = target.corners_m[numbers][:, :2]
                turn, *_ = np.linalg.lstsq(target.corners_m[:, :2], moved, rcond=None)
                np.testing.assert_allclose(target.corners_m[:, :2] @ turn, moved, atol=1e-12)
                assert np.linalg.det(turn) == pytest.approx(1)


def test_a_charuco_board_counts_squares_and_has_one_numbering():
    target = parse_target("charuco:7x5:0.04:0.03:DICT_4X4_50")
    assert target.corners_m.shape == (24, 3)
    assert distance(target, 0, 5) == pytest.approx(5 * 0.04)
    assert len(target.relabelings) == 1


def test_an_aprilgrid_has_kalibrs_layout():
    target = parse_target("aprilgrid:6x6:0.088:0.3")
    assert target.corners_m.shape == (144, 3)
    assert distance(target, 0, 1) == pytest.approx(0.088)  # side of a tag
    assert distance(target, 1, 4) == pytest.approx(0.3 * 0.088)  # gap to the next tag
    assert distance(target, 0, 24) == pytest.approx(1.3 * 0.088)  # tag 6 stands on tag 0
    assert target.corners_m[24, 1] > target.corners_m[0, 1]
    assert target.label(27) == "tag6.3"


def test_single_markers_are_rigid_parts_of_their_own():
    target = parse_target("aruco:4x4_50:0.1")
    assert target.corners_m.shape == (200, 3)
    assert distance(target, 28, 30) == pytest.approx(0.1 * np.sqrt(2))
    seen = np.isin(target.part, [3, 7])
    pairs = target.pairs(seen)
    assert len(pairs) == 12  # four sides and two diagonals each, none between markers
    assert set(target.part[pairs].ravel()) == {3, 7}


def test_control_and_check_corners_are_disjoint_and_both_measure_lengths(subtests):
    for spec in (
        "checkerboard:9x6:0.025",
        "charuco:7x5:0.04:0.03:4X4_50",
        "aprilgrid:6x6:0.088:0.3",
        "aruco:4X4_50:0.1",
    ):
        with subtests.test(spec=spec):
            target = parse_target(spec)
            seen = np.ones(len(target.part), dtype=bool) if target.kind != "aruco" else np.isin(target.part, [2, 4])
            control = target.control(seen)
            pairs = target.pairs(seen)
            both = control[pairs]
            assert (both.all(axis=1)).sum() > 5
            assert (~both.any(axis=1)).sum() > 5
            assert 0.3 < control[seen].mean() < 0.7


def test_a_lone_marker_gives_one_side_to_each_set():
    target = parse_target("aruco:4X4_50:0.1")
    seen = target.part == 5
    np.testing.assert_array_equal(target.control(seen)[seen], [True, True, False, False])


@loop_over(
    ("spec", "words"),
    [
        ("chessboard:9x6:0.025", 'unknown kind of target "chessboard"'),
        ("checkerboard:9x6", "1 fields after checkerboard, not 2"),
        ("checkerboard:9by6:0.025", "not two whole numbers"),
        ("checkerboard:9x2:0.025", "each must be from 3"),
        ("checkerboard:9x6:25", "lengths are metres, so 25 mm is 0.025"),
        ("checkerboard:9x6:-0.1", "must be positive"),
        ("checkerboard:9x6:nan", "must be positive"),
        ("checkerboard:9x6:small", "not a number"),
        ("charuco:7x5:0.03:0.04:DICT_4X4_50", "must be smaller than the square"),
        ("charuco:7x5:0.04:0.03:DICT_4X4_40", "unknown dictionary"),
        ("charuco:15x15:0.04:0.03:DICT_4X4_50", "needs 112 markers"),
        ("aprilgrid:6x6:0.088:30", "between 0 and 1"),
        ("aprilgrid:30x30:0.088:0.3", "needs 900 markers"),
        ("aruco:0.1:DICT_4X4_50", "unknown dictionary"),
    ],
)
def test_a_wrong_description_says_which_field_is_wrong_and_what_is_expected(spec, words):
    with pytest.raises(TargetSpecError) as caught:
        parse_target(spec)
    message = str(caught.value)
    assert words in message
    assert "expected" in message
    assert caught.value.exit_code == 2
