"""Lengths of a target are held against their own length: a wrong ratio of its parts is named, not averaged."""

import numpy as np
import pytest

from colmap_inertial.validate.contradictions import find_contradictions
from colmap_inertial.validate.result import Distance, ViewResiduals
from colmap_inertial.validate.targets import parse_target

PX_PER_M = 1500.0


def measured(stated, actual, *, noise_m=2e-5, scale=1.0, seed=1):
    """Distances of the stated target as the actual one has them, after the scale that fits best; and a view of it."""
    rng = np.random.default_rng(seed)
    place = actual.corners_m + rng.normal(0, noise_m, actual.corners_m.shape)
    pairs = stated.pairs(np.ones(len(stated.part), bool)).tolist()
    known = np.array([np.linalg.norm(stated.corners_m[a] - stated.corners_m[b]) for a, b in pairs])
    found = np.array([np.linalg.norm(place[a] - place[b]) for a, b in pairs])
    factor = scale * float(known @ found / (found @ found))
    distances = [
        Distance(
            pair=(stated.label(a), stated.label(b)), known_m=k, measured=f, residual_m=factor * f - k, set="control"
        )
        for (a, b), k, f in zip(pairs, known, found, strict=True)
    ]
    px = PX_PER_M * actual.corners_m[:, :2]
    view = ViewResiduals(
        name="a.png",
        corner=np.arange(len(stated.part)),
        observed_px=px,
        projected_px=px,
        rejected_px=np.empty((0, 2)),
        rms_px=0.1,
    )
    return distances, [view]


@pytest.mark.parametrize("gap", [0.2, 0.25, 0.4, 0.35])
def test_a_wrong_gap_is_named_with_the_right_one(gap):
    stated, actual = parse_target(f"aprilgrid:6x4:0.04:{gap}"), parse_target("aprilgrid:6x4:0.04:0.3")
    (fact,) = find_contradictions(stated, *measured(stated, actual), 1.0)
    assert fact.code == "lengths-contradict"
    assert fact.values["likely_gap"] == pytest.approx(0.3, abs=0.01)
    assert fact.values["lengths_mm"][0] == pytest.approx(40 * gap)
    assert "the images show 0.3" in fact.advice


def test_a_board_that_was_printed_stretched_is_named():
    board = parse_target("checkerboard:8x6:0.03")
    stretched = parse_target("checkerboard:8x6:0.03")
    object.__setattr__(stretched, "corners_m", board.corners_m * [1.04, 1.0, 1.0])
    (fact,) = find_contradictions(board, *measured(board, stretched), 1.0)
    assert set(fact.values["along"]) <= {"row", "column"} and "printed" in fact.advice


@pytest.mark.parametrize(
    "spec",
    ["aprilgrid:6x4:0.04:0.3", "checkerboard:8x6:0.03", "charuco:7x5:0.04:0.03:DICT_4X4_50", "aprilgrid:6x6:0.088:0.3"],
)
@pytest.mark.parametrize("noise_m", [2e-5, 3e-4])
def test_right_boards_are_not_accused(spec, noise_m):
    board = parse_target(spec)
    for seed in range(10):
        assert find_contradictions(board, *measured(board, board, noise_m=noise_m, seed=seed), 1.0) == []


def test_ink_that_spreads_is_no_contradiction():
    """Black tags a third of a pixel too large at every edge: gaps look shorter, all alike."""
    board, inked = (parse_target("aprilgrid:6x4:0.04:0.3") for _ in range(2))
    tags = board.corners_m.reshape(-1, 4, 3)
    middle = tags.mean(axis=1, keepdims=True)
    larger = middle + (tags - middle) * (1 + 2 * 0.2 / PX_PER_M / 0.04)
    object.__setattr__(inked, "corners_m", larger.reshape(-1, 3))
    assert find_contradictions(board, *measured(board, inked), 1.0) == []
