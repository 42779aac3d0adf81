"""The relative track and the loops on it: exact data give it exactly; decisions are those of loops over pairs."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.colmap.loops import search as loops
from colmap_inertial.colmap.loops.search import LoopSearch, candidates, key_frames
from colmap_inertial.colmap.views import relative_track
from colmap_inertial.colmap.views.relative_track import (
    DRIFT,
    LoopPose,
    Observations,
    RelativeTrack,
    estimate_relative_track,
    link_observations,
)
from colmap_inertial.colmap.views.two_views import TwoViews
from colmap_inertial.core.geometry import so3_exp
from tests.colmap.matching.test_pairing import circle, headings_of, sightings_along, way_along


def similarity(found, true):
    """Scale and offset by which true places become those found, least squares."""
    a, b = true - true.mean(axis=0), found - found.mean(axis=0)
    scale = np.sum(a * b) / np.sum(a**2)
    return scale, found.mean(axis=0) - scale * true.mean(axis=0)


def test_exact_rays_give_places_and_points_exactly(subtests):
    for path in ("circle", "line", "stops"):
        with subtests.test(path=path):
            count = 40
            along = np.linspace(0, 6, count)
            centre = {
                "circle": circle(count),
                "line": np.stack([along, 0.1 * along, 0 * along], axis=1),
                "stops": np.stack(
                    [np.interp(along, [0, 2, 3, 5, 6], [0, 2, 2, 4, 3.5]), 0.3 * np.sin(along), 0 * along], axis=1
                ),
            }[path]
            headings = headings_of(np.linspace(0, 360 if path == "circle" else 20, count), 0.5 * np.arange(count))
            rng = np.random.default_rng(3)
            points = centre[rng.integers(count, size=1500)] + rng.uniform(-1, 1, (1500, 3)) * [3, 3, 1]
            seen = sightings_along(centre, headings.start_from_cam, np.random.default_rng(3), noise_rad=0.0)
            way = estimate_relative_track(seen, count)
            assert (way.part == 0).all()
            scale, offset = similarity(way.centre, centre)
            np.testing.assert_allclose(way.centre, scale * centre + offset, atol=1e-6 * scale)
            known = np.isfinite(way.points[:, 0])
            assert known.mean() > 0.15
            np.testing.assert_allclose(
                way.points[known], scale * points[: len(way.points)][known] + offset, atol=1e-4 * scale
            )
            # the first is the origin, and the length of the first step with parallax is one
            assert not way.centre[0].any()
            assert np.abs(np.linalg.norm(way.centre[1:9], axis=1) - 1).min() < 1e-12
            # points lie where they are seen, not behind
            away = way.points[seen.point] - way.centre[seen.frame]
            good = np.isfinite(away[:, 0])
            assert (np.sum(away[good] * seen.rays[good], axis=1) > 0).all()


def test_false_matches_hardly_move_the_track():
    count = 40
    headings = headings_of(np.linspace(0, 360, count), 0.5 * np.arange(count))
    rng = np.random.default_rng(5)
    seen = sightings_along(circle(count), headings.start_from_cam, rng, noise_rad=5e-4)
    rays = seen.rays.copy()
    false = rng.random(len(rays)) < 0.15
    turned = np.einsum("nij,nj->ni", so3_exp(rng.uniform(-0.3, 0.3, (false.sum(), 3))), rays[false])
    rays[false] = turned
    way = estimate_relative_track(replace(seen, rays=rays), count)
    assert (way.part == 0).all()
    scale, offset = similarity(way.centre, circle(count))
    assert np.linalg.norm(way.centre - scale * circle(count) - offset, axis=1).max() < 0.08 * scale


def test_what_is_seen_and_how_far_away_it_is():
    rng = np.random.default_rng(2)
    frame = np.sort(rng.integers(0, 6, 80))
    point, feature = rng.integers(0, 30, 80), rng.integers(0, 500, 80)
    points = rng.standard_normal((30, 3))
    points[::4] = np.nan
    observations = Observations(frame=frame, point=point, feature=feature, rays=np.zeros((80, 3)))
    way = RelativeTrack(
        part=np.zeros(7, int), centre=rng.standard_normal((7, 3)), points=points, observations=observations
    )
    for k in range(7):
        rows = [m for m in range(80) if frame[m] == k and point[m] % 4]
        features, at = way.seen(k)
        assert features.tolist() == [feature[m] for m in rows]
        assert np.array_equal(at, points[[point[m] for m in rows]].reshape(-1, 3))
        far = [np.linalg.norm(points[point[m]] - way.centre[k]) for m in rows]
        assert way.depth(k) == pytest.approx(np.median(far)) if rows else np.isnan(way.depth(k))


def test_covariances_of_the_track_are_the_scatter_of_tracks_whose_length_walks(subtests):
    """Each step is as long as the one before but for a chance factor; a heading's error is there all the way."""
    for span in ((0, 30), (7, 25), (12, 13), (9, 9)):
        with subtests.test(span=span):
            i, j = span
            rng = np.random.default_rng(0)
            centre = np.cumsum(rng.standard_normal((31, 3)) + np.array([0.5, 0, 0]), axis=0)
            steps = np.diff(centre[i : j + 1], axis=0)
            way = way_along(centre)
            found = way.covariance(np.array([i]), np.array([j]), np.zeros(1))[0]
            factors = np.cumsum(DRIFT * rng.standard_normal((60_000, len(steps))), axis=1)
            off = factors @ steps
            np.testing.assert_allclose(found, off.T @ off / 60_000, atol=0.03 * np.trace(found) + 1e-12)
            # by so much is what is left at each frame turned, in any direction
            left = centre[j] - centre[i : j + 1]
            turned = way.covariance(np.array([i]), np.array([j]), np.array([0.3]))[0] - found
            np.testing.assert_allclose(turned, 0.3**2 * np.mean(np.sum(left**2, axis=1)) * np.eye(3), atol=1e-10)


def test_points_of_matches_are_those_of_a_search_through_all_of_them(subtests):
    for most in (800, 3):
        with subtests.test(most=most), pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.setattr(relative_track, "_LIMITS", relative_track.TrackLimits(most_observations=most))
            rng = np.random.default_rng(9)
            # feature of 60 things in each of 6 frames; some matches of neighbours are false
            features = [60, 61, 62, 63, 64, 65]
            feature_of = [rng.permutation(count)[:60] for count in features]
            seen = rng.random((6, 60)) < 0.7
            matches = []
            for i in range(6):
                for j in range(i + 1, 6):
                    both = np.flatnonzero(seen[i] & seen[j] & (rng.random(60) < 0.6))
                    pairs = np.stack([feature_of[i][both], feature_of[j][both]], axis=1)
                    matches.append((i, j, np.concatenate([pairs, rng.integers(0, 60, (int(j == i + 1), 2))])))
            group = {(k, f): {(k, f)} for k in range(6) for f in range(features[k])}
            for i, j, pairs in matches:
                for a, b in pairs.tolist():
                    both = group[i, a] | group[j, b]
                    for member in both:
                        group[member] = both
            groups = {frozenset(one) for one in group.values()}
            expected = {one for one in groups if len(one) >= 3 and len({k for k, _ in one}) == len(one)}
            frame, feature, point = link_observations(features, matches)
            assert np.all(np.diff(frame) >= 0) and set(point.tolist()) == set(range(int(point.max()) + 1))
            of_point = [np.flatnonzero(point == p) for p in range(int(point.max()) + 1)]
            found = {frozenset(zip(frame[mine].tolist(), feature[mine].tolist(), strict=True)) for mine in of_point}
            every = -(-sum(map(len, expected)) // (most * 6))
            assert found <= expected and len(found) == -(-len(expected) // max(1, every))
            assert len(expected) > 5 and (most > 3 or len(frame) < sum(map(len, expected)))


def test_key_frames_and_candidates_are_those_of_a_loop():
    rng = np.random.default_rng(1)
    for spacing_s in (0.3, 0.97, 5.0):
        t_s = np.cumsum(rng.uniform(0.5, 1.5, 300) * spacing_s)
        kept = [0]
        for i in range(1, 300):
            if t_s[i] - t_s[kept[-1]] >= 0.95:
                kept.append(i)
        assert key_frames(t_s).tolist() == kept
    i, j = np.triu_indices(12, 1)
    votes = rng.permutation(len(i))
    best = set()
    for frame in range(12):
        mine = sorted((m for m in range(len(i)) if frame in (i[m], j[m])), key=lambda m: -votes[m])
        best |= set(mine[:3])
    assert set(np.flatnonzero(candidates(votes, i, j)).tolist()) == {m for m in best if votes[m] >= 6}


def test_pairs_beside_a_pair_are_its_neighbours_in_both():
    assert LoopSearch(None, range(100), None, None, None, 10)._pairs_beside((10, 30), 2) == {
        (8, 28), (8, 30), (8, 32), (10, 28), (10, 32), (12, 28), (12, 30), (12, 32)
    }  # fmt: skip
    assert LoopSearch(None, range(13), None, None, None, 11)._pairs_beside((0, 11), 1) == {(0, 12), (1, 12)}


def test_frames_are_surely_apart_where_the_way_between_them_is_longer_than_what_they_see(monkeypatch):
    """Each frame sees one point a metre away; at two metres and three standard deviations nothing is in common."""
    count = 300
    centre = np.stack([np.linspace(0, 8, count), np.zeros(count), np.zeros(count)], axis=1)
    one = np.arange(count)
    observations = Observations(frame=one, point=one, feature=one, rays=np.zeros((count, 3)))
    points = centre + np.array([0.0, 0.6, 0.8])
    way = RelativeTrack(part=np.zeros(count, dtype=int), centre=centre, points=points, observations=observations)
    headings = headings_of(np.linspace(0, 5, count), 0.1 * np.arange(count))
    i, j = np.triu_indices(count, 1)
    apart = LoopSearch(None, (), headings, way, None, 10)._surely_apart(i, j)
    cov = way.covariance(i, j, headings.sigma_rad(i, j))
    margin = np.abs(centre[j, 0] - centre[i, 0]) - 2.0 - 3 * np.sqrt(np.einsum("maa->m", cov))
    assert np.array_equal(apart, margin > 0) and 0.1 < apart.mean() < 0.9
    keys = one[::3]
    first, second = keys[np.stack(np.triu_indices(len(keys), 1))]
    kept = (second - first >= 10) & ~apart.reshape(-1)[
        np.ravel(first * (2 * count - first - 1) // 2 + second - first - 1)
    ]
    for at_once in (1, 700, 50_000):
        monkeypatch.setattr(loops, "_LIMITS", replace(loops._LIMITS, pairs_at_once=at_once))
        found = LoopSearch(None, (), headings, way, None, 10)._possible_loops(keys)
        assert np.array_equal(found, np.stack([first, second])[:, kept]) and found.shape[1] > 100
    # of another part nothing is known
    split = replace(way, part=(one > count // 2).astype(int))
    other = (i <= count // 2) & (j > count // 2)
    assert not LoopSearch(None, (), headings, split, None, 10)._surely_apart(i[other], j[other]).any()


def test_loops_are_judged_as_one_by_one(monkeypatch):
    """Place against the track, length against its walk, rotation against the gyroscope."""
    rng = np.random.default_rng(21)
    headings, way = headings_of(np.linspace(0, 360, 40), np.arange(40.0)), way_along(circle())
    pairs = [(i, j) for i in range(10) for j in range(25, 40)]
    told, expected = {}, set()
    search = LoopSearch(None, [f"{k}" for k in range(40)], headings, way, None, 10)
    for i, j in pairs:
        _, cov = search._displacements(np.array([i]), np.array([j]))
        depth, wrong = float(rng.uniform(0.3, 2.0)), rng.choice(["place", "length", "rotation", "", "", ""])
        sideways = rng.standard_normal(3)
        root = np.linalg.cholesky(cov[0] + (0.1 * depth) ** 2 * np.eye(3))
        off = (14 if wrong == "place" else 0.5) * root @ (sideways / np.linalg.norm(sideways))
        longer = (6 if wrong == "length" else 0.5) * np.sqrt(DRIFT**2 * (j - i) + 0.1**2) * rng.choice([-1, 1])
        turned = so3_exp(np.array([0.0, 0.6 if wrong == "rotation" else 0.0, 0.0]))
        told[i, j] = LoopPose(
            step=way.centre[j] - way.centre[i] - off,
            start_from_second=headings.start_from_cam[j] @ turned,
            ratio=float(np.exp(longer)),
            depth=depth,
            matches=50,
        )
        if not wrong:
            expected.add((i, j))
    # COLMAP verified all but every seventh; every fifth covers too little
    verified = np.arange(len(pairs)) % 7 > 0
    covered = np.where(np.arange(len(pairs)) % 5 > 0, 0.5, 0.49)
    i, j = np.array(pairs).T
    rotations = np.swapaxes(headings.start_from_cam[i], 1, 2) @ headings.start_from_cam[j]
    rotations[~verified] = np.nan
    views = TwoViews(first_from_second=rotations, covered=covered)
    monkeypatch.setattr(loops, "compare", lambda database, names: views)
    monkeypatch.setattr(loops, "localise_frames", lambda database, names, some, way: [told[pair] for pair in some])
    sound, _, found = search._judge(pairs)
    assert sound == {pair for pair, good in zip(pairs, verified, strict=True) if good}
    looked_at = {pair for pair, good in zip(pairs, verified & (covered >= 0.5), strict=True) if good}
    assert set(found) == expected & looked_at and len(found) > 20 and len(looked_at - expected) > 20


def sighted(centres, points, rng, *, noise_rad=0.0):
    """Observations of all points by all frames, so noisy."""
    frame, point = np.divmod(np.arange(len(centres) * len(points)), len(points))
    rays = points[point] - centres[frame]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    rays += noise_rad * rng.standard_normal(rays.shape)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    return Observations(frame=frame, point=point, feature=point, rays=rays), np.arange(len(centres) + 1) * len(points)


def test_the_first_step_is_to_the_first_frame_with_parallax_and_leads_where_it_is(subtests):
    for sign in (1, -1):
        for noise_rad, most_rad in ((0.0, 1e-9), (5e-4, 0.02)):
            with subtests.test(sign=sign, noise_rad=noise_rad, most_rad=most_rad):
                rng = np.random.default_rng(31)
                points = np.column_stack([rng.uniform(-1, 1, (120, 2)), rng.uniform(1.5, 3, 120)])
                true = sign * np.array([0.8, 0.36, 0.48])
                centres = 0.03 * np.arange(12)[:, None] * true
                seen, bounds = sighted(centres, points, rng, noise_rad=noise_rad)
                other, direction = relative_track._find_beginning(seen, bounds, 0)
                first = seen.rays[: len(points)]
                apart = [
                    np.median(np.linalg.norm(np.cross(first, seen.rays[bounds[j] : bounds[j + 1]]), axis=1))
                    for j in range(9)
                ]
                assert other == next(j for j in range(1, 9) if apart[j] >= 0.04) and 2 <= other < 8
                assert (
                    np.linalg.norm(direction) == pytest.approx(1)
                    and np.arccos(min(1.0, direction @ true)) <= most_rad + 1e-7
                )


def test_without_parallax_or_with_few_points_nothing_begins():
    rng = np.random.default_rng(32)
    points = np.column_stack([rng.uniform(-1, 1, (40, 2)), rng.uniform(1.5, 3, 40)])
    still, bounds = sighted(0.002 * np.arange(20)[:, None] * [1.0, 0, 0], points, rng)
    assert relative_track._find_beginning(still, bounds, 0) is None
    moving = 0.1 * np.arange(4)[:, None] * [1.0, 0, 0]
    for count, begins in ((15, False), (16, True)):
        assert (relative_track._find_beginning(*sighted(moving, points[:count], rng), 0) is not None) == begins


def test_a_frame_is_located_by_most_of_what_it_sees(subtests):
    for wrong, located in ((0.0, True), (0.4, True), (0.9, False)):
        with subtests.test(wrong=wrong, located=located):
            rng = np.random.default_rng(33)
            points = np.column_stack([rng.uniform(-1, 1, (200, 2)), rng.uniform(1.5, 3, 200)])
            true = np.array([0.1, -0.05, 0.02])
            rays = points - true
            bad = rng.permutation(200) < 200 * wrong
            rays[bad] += rng.uniform(-1, 1, (int(bad.sum()), 3))
            rays /= np.linalg.norm(rays, axis=1)[:, None]
            off = np.linalg.norm(
                np.cross((points - true) / np.linalg.norm(points - true, axis=1)[:, None], rays), axis=1
            )
            unknown = np.arange(200) % 10 == 0
            known = np.where(unknown[:, None], np.nan, points)
            found = relative_track._locate_frame(
                known, rays, true + 0.01 * np.array([3, 2, -2]), np.array([0.05, 0, 0])
            )
            assert (found is not None) == located
            if found is not None:
                centre, trusted = found
                assert np.linalg.norm(centre - true) < (1e-3 if wrong else 1e-9)
                # what is off by three times an error's size triangulates nothing; of new points nobody knows
                clear = unknown | (np.abs(off - 0.012) > 2e-3)
                assert np.array_equal(trusted[clear], (unknown | (off < 0.012))[clear])
            few = relative_track._locate_frame(known[:8], rays[:8], true, np.array([0.05, 0, 0]))
            assert few is None  # one of the eight is unknown
