"""Lengths of a target that contradict each other, from lengths that are computed."""

from dataclasses import dataclass

import numpy as np
import pytest

from colmap_inertial.validate import parse_target
from colmap_inertial.validate.contradictions import find_contradictions


@dataclass(frozen=True)
class Length:
    pair: tuple[str, str]
    known_m: float
    measured: float
    residual_m: float


@dataclass(frozen=True)
class View:
    corner: np.ndarray
    observed_px: np.ndarray


def lengths_of(target, printed, noise_m=1e-5):
    """All lengths along rows and columns of a board whose corners are at ``printed`` (N, 3), in its best scale."""
    rng = np.random.default_rng(5)
    known, real = [], []
    pairs = []
    for a in range(len(printed)):
        for b in range(a):
            if (target.row[a] == target.row[b]) != (target.column[a] == target.column[b]):
                pairs.append((target.label(a), target.label(b)))
                known.append(np.linalg.norm(target.corners_m[a] - target.corners_m[b]))
                real.append(np.linalg.norm(printed[a] - printed[b]) + rng.normal(0, noise_m))
    known, real = np.array(known), np.array(real)
    scale = known @ known / (known @ real)
    return [Length(p, k, r, scale * r - k) for p, k, r in zip(pairs, known.tolist(), real.tolist(), strict=True)]


def found(target, printed, **more):
    views = [View(np.arange(len(printed)), 1000 * printed[:, :2])]
    return find_contradictions(target, lengths_of(target, printed, **more), views, 2.0)


BOARD = parse_target("checkerboard:9x6:0.03")


@pytest.mark.parametrize(("by", "told"), [(1.0, False), (1.005, False), (1.03, True), (0.96, True), (1.1, True)])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_board_that_was_printed_stretched_is_told(by, told, axis):
    printed = BOARD.corners_m.copy()
    printed[:, axis] *= by
    facts = found(BOARD, printed)
    assert bool(facts) == told
    if told:
        (fact,) = facts
        signs = dict(zip(fact.values["along"], np.sign(fact.values["off_pct"]), strict=False))
        assert signs.get("row" if axis == 0 else "column", np.sign(by - 1)) == np.sign(by - 1)
        assert "printed" in fact.advice


def test_edges_beside_where_they_are_stretch_nothing():
    """All lengths longer by the same, as ink spreads: more in one direction than in the other."""
    lengths = lengths_of(BOARD, BOARD.corners_m)
    index = {BOARD.label(i): i for i in range(len(BOARD.part))}
    moved = []
    for length in lengths:
        a, b = (index[name] for name in length.pair)
        more = 2e-4 if BOARD.row[a] == BOARD.row[b] else -2e-4
        moved.append(Length(length.pair, length.known_m, length.measured + more, length.residual_m + more))
    views = [View(np.arange(len(BOARD.part)), 1000 * BOARD.corners_m[:, :2])]
    assert find_contradictions(BOARD, moved, views, 2.0) == []


def test_scatter_is_no_stretch():
    assert found(BOARD, BOARD.corners_m, noise_m=2e-3) == []
