"""Which pairs of a model are torn, and what an adjustment costs: against loops."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from colmap_inertial.colmap.loops import closure as loop_closure
from colmap_inertial.model.submodels.matches import LIMITS
from tests.helpers.cases import loop_over

NAMES = [f"{k:02d}" for k in range(16)]


def torn(monkeypatch, matches, *, nearest=None, parts=None, links=range(15)):
    """Torn pairs of images in a row, each linked with the next one; ``matches``: pair to same and different points."""
    linked = {(NAMES[k], NAMES[k + 1]): (LIMITS.matches, 0) for k in links}
    numbers = {name: [] for name in NAMES}
    found = []
    for (a, b), (same, different) in {**linked, **matches}.items():
        rows = []
        for k in range(same + different):
            # a point of its own for each match, the same in both images or another one
            number = 1000 * len(found) + 2 * k
            rows.append([len(numbers[a]), len(numbers[b])])
            numbers[a].append(number)
            numbers[b].append(number + (k >= same))
        # a match of features that are of no point
        rows.append([len(numbers[a]), len(numbers[b])])
        numbers[a].append(-1)
        numbers[b].append(number)
        found.append((a, b, np.array(rows)))
    monkeypatch.setattr(loop_closure, "read_matches", lambda *_: iter(found))
    model = SimpleNamespace(images=dict.fromkeys(NAMES), points=lambda name: np.array(numbers[name]))
    part_of = dict.fromkeys(NAMES, 0) if parts is None else parts
    place = {name: k for k, name in enumerate(NAMES)}
    return loop_closure._find_torn_pairs(None, model, place, part_of, {(0, 0): nearest})


@loop_over(
    ("same", "different", "is_torn"),
    # thirty matches at least, and one in twenty is one point at most
    [(0, 30, True), (0, 29, False), (1, 29, True), (2, 38, True), (2, 37, False), (4, 76, True), (5, 76, False)],
)
def test_a_pair_is_torn_where_hardly_a_match_is_one_point(monkeypatch, same, different, is_torn):
    found = torn(monkeypatch, {("00", "15"): (same, different)})
    assert bool(found) == is_torn
    for pair in found:
        assert (pair.first, pair.second) == ("00", "15")
        assert len(pair.features) == len(pair.points) == same + different
        assert np.count_nonzero(pair.points[:, 0] == pair.points[:, 1]) == same


@loop_over(
    ("last", "nearest", "links", "is_torn"),
    [
        ("11", None, range(15), True),
        ("10", None, range(15), False),
        ("11", 11, range(15), True),
        ("11", 10, range(15), False),
        # nothing leads there: as far as can be
        ("05", None, [0, 1, 3, 4], True),
    ],
)
def test_a_pair_is_torn_where_only_a_long_way_leads_from_one_to_the_other(monkeypatch, last, nearest, links, is_torn):
    assert bool(torn(monkeypatch, {("00", last): (0, 40)}, nearest=nearest, links=links)) == is_torn


def test_parts_that_are_not_named_are_not_looked_at(monkeypatch):
    parts = {name: int(name > "07") for name in NAMES}
    assert torn(monkeypatch, {("00", "15"): (0, 40)}, parts=parts) == []


def test_links_are_counted_as_by_a_search_in_breadth(monkeypatch):
    monkeypatch.setattr(loop_closure, "CLOSURE", replace(loop_closure.CLOSURE, links=3))
    rng = np.random.default_rng(2)
    names = [f"{k}" for k in range(25)]
    linked = [(names[a], names[b]) for a, b in rng.integers(0, 25, (24, 2)).tolist() if a != b]
    asked = [(a, b) for a in names for b in names if a < b]
    expected = []
    for a, b in asked:
        reached, rounds = {a}, 0
        while b not in reached:
            more = {y for x, y in linked if x in reached} | {x for x, y in linked if y in reached}
            if more <= reached:
                rounds = np.inf
                break
            reached, rounds = reached | more, rounds + 1
        expected.append(rounds)
    within = loop_closure._find_linked_images(names, linked, names)
    assert [b in within[a] for a, b in asked] == [rounds <= 3 for rounds in expected]
    assert {rounds <= 3 for rounds in expected if np.isfinite(rounds)} == {True, False}


def test_where_all_see_the_same_the_work_is_the_sum_of_squares():
    assert [loop_closure._work_of(n) for n in (1, 2, 7)] == [1, 5, sum(k**2 for k in range(8))]


@loop_over("share", [0.0, 0.4, 0.5, 1.0])
def test_matches_that_agree_are_counted(share):
    points = {"a": np.arange(10), "b": np.where(np.arange(10) < 10 * share, np.arange(10), 99), "c": np.full(10, -1)}
    model = SimpleNamespace(images={"a": 1, "b": 1, "c": 1}, points=points.__getitem__)
    features = np.stack([np.arange(10)] * 2, axis=1)

    def pair(first, second):
        return loop_closure._TornPair(first=first, second=second, features=features, points=features)

    assert loop_closure._agreeing_share(model, [pair("a", "b")]) == share
    # an image that is gone, and features that lost their points, agree in nothing
    assert loop_closure._agreeing_share(model, [pair("a", "b"), pair("a", "gone")]) == share / 2
    assert loop_closure._agreeing_share(model, [pair("c", "c")]) == 0
