"""The plane sweep, part by part, against a room whose depths and normals are closed forms."""

import numpy as np
import pytest

from colmap_inertial._kernels import _apertures
from colmap_inertial.imaging.plane_sweep import (
    DepthView,
    Sights,
    agreement,
    choose_partners,
    confirm_depth,
    depth,
    depth_range,
    estimate_normals,
    normals,
    score_partners,
    sweep_depth,
)
from colmap_inertial.imaging.plane_sweep.depth import _find_shown_columns, _make_canvas, _sample_positions
from colmap_inertial.imaging.plane_sweep.tiles import cut_tiles
from colmap_inertial.imaging.semi_global import shares
from tests.helpers.sweep_scenes import camera, depth_of, depth_view, partner, picture_of, rays, sights_of

REFERENCE = camera((0.1, -0.4, 0.3))
#: On different sides; turned, also about their own axis; nearer and farther; another lens.
AROUND = (
    camera((0.4, -0.4, 0.3), (0, 4, 0)),
    camera((-0.2, -0.5, 0.35), (3, -5, 12)),
    camera((0.15, -0.4, 0.55), (-4, 0, -25), width=100, height=110, focal=(80.0, 80.0)),
    camera((0.0, -0.1, 0.1), (2, 2, 3)),
)


def test_a_point_of_one_camera_is_found_in_another():
    one, other = REFERENCE, AROUND[2]
    matrix, offset = other.seen_from(one)
    pixel, depth = np.array([31.0, 57.0, 1.0]), 2.3
    world = one.cam_from_world.T @ (np.linalg.inv(one.matrix) @ pixel * depth) + one.cam_in_world
    seen = other.cam_from_world @ (world - other.cam_in_world)
    u = other.focal_px * seen[:2] / seen[2] + other.centre_px
    found = matrix @ pixel * depth + offset
    np.testing.assert_allclose([*found[:2] / found[2], found[2]], [*u, seen[2]], rtol=1e-12)


def test_partners_are_weighed_as_by_loops_over_points():
    views = (REFERENCE, *AROUND, camera((0.1, -0.4, 0.3), (0, 60, 0)), camera((0.1, -0.4, 0.31)))
    sights = sights_of(views)
    scores = score_partners(sights, 0)
    for k in range(1, len(views)):
        shared = set(sights.of_view[0].tolist()) & set(sights.of_view[k].tolist())
        total = 0.0
        for point in shared:
            a, b = (sights.points[point] - views[i].cam_in_world for i in (0, k))
            angle = np.degrees(np.arccos(min(1.0, a @ b / np.linalg.norm(a) / np.linalg.norm(b))))
            total += np.exp(-0.5 * ((angle - 8) / (4 if angle < 8 else 8)) ** 2)
        turned = views[k].cam_from_world[2] @ views[0].cam_from_world[2] < np.cos(np.radians(50))
        assert scores[k] == pytest.approx(0 if turned or len(shared) < 20 else total, rel=1e-6), k
    assert scores[0] == 0
    assert scores[5] == 0, "looks elsewhere"
    assert 0 < scores[6] < scores[1], "too near to measure depth"


def test_views_that_share_few_points_are_no_partners():
    sights = sights_of((REFERENCE, AROUND[0]), points=600)
    few = np.intersect1d(*sights.of_view)[:19]
    less = Sights.of(sights.views, sights.points, [sights.of_view[0], few])
    assert score_partners(sights, 0)[1] > 0 == score_partners(less, 0)[1]
    assert choose_partners(less, 0, score_partners(less, 0), 4) == ()


def test_partners_on_other_sides_go_before_more_of_the_same():
    views = [REFERENCE, *(camera((0.1 + x, -0.4, 0.3 + z)) for x, z in ((0.4, 0), (0.41, 0), (0.39, 0), (0, 0.4)))]
    sights = sights_of(views)
    scores = np.array([0, 10.0, 9.9, 9.8, 6.0])
    assert choose_partners(sights, 0, scores, 2) == (1, 4)
    assert set(choose_partners(sights, 0, scores, 9)) == {1, 2, 3, 4}


def test_the_range_of_depths_holds_what_is_seen():
    sights = sights_of((REFERENCE,), points=4000)
    near, far = depth_range(sights, 0)
    depth, _ = depth_of(REFERENCE)
    assert near < depth.min() and depth.max() < far < 1.6 * depth.max()
    assert depth_range(Sights.of([REFERENCE], sights.points, [np.zeros(0, dtype=int)]), 0) is None


def test_a_candidate_leads_where_the_partner_sees_the_point(subtests):
    for view in AROUND:
        with subtests.test(view=view):
            depths = (0.6, 6.0)
            canvas = _make_canvas(REFERENCE, view, depths)
            inverse = np.linspace(1 / depths[1], 1 / depths[0], 7)
            columns, rows = (_sample_positions(REFERENCE, canvas, inverse, axis) for axis in (0, 1))
            matrix, offset = view.seen_from(REFERENCE)
            compared = 0
            for d, q in enumerate(inverse):
                for x, y in ((0, 0), (60, 40), (119, 3), (17, 89)):
                    seen = matrix @ np.array([x, y, 1.0]) / q + offset
                    px = seen[:2] / seen[2]
                    inside = seen[2] > 0 and (px >= 1).all() and px[0] <= view.width - 2 and px[1] <= view.height - 2
                    at = np.array([columns[d, x], rows[d, y]])
                    if inside:
                        turned = canvas.canvas_from_view @ [*px, 1.0]
                        np.testing.assert_allclose(at / 16, turned[:2] / turned[2], atol=1 / 31)
                        compared += 1
            assert compared > 8


def test_depths_of_a_room_are_found():
    truth, _ = depth_of(REFERENCE)
    near, far = 0.7 * truth.min(), 1.3 * truth.max()
    found = sweep_depth(picture_of(REFERENCE), REFERENCE, [partner(v) for v in AROUND], (near, far), threads=1)
    assert found.shape == truth.shape
    inner = np.s_[4:-4, 4:-4]
    error = np.abs(found - truth)[inner] / truth[inner]
    # a baseline moves things by 12 px at most: 1 % of the depth is an eighth of a pixel
    assert np.mean(error < 0.01) > 0.9
    assert np.mean(error < 0.02) > 0.98
    assert np.median(error) < 0.007
    # threads change nothing
    twice = sweep_depth(picture_of(REFERENCE), REFERENCE, [partner(v) for v in AROUND], (near, far), threads=2)
    assert np.array_equal(found, twice)


def test_beyond_the_edges_of_a_turned_picture_nothing_is_compared():
    rolled = camera((0.4, -0.4, 0.3), (0, 4, 45))
    others = (rolled, *(camera(centre) for centre in ((-0.2, -0.5, 0.3), (0.1, -0.1, 0.3), (0.1, -0.4, 0.1))))
    canvas = _make_canvas(REFERENCE, rolled, (0.6, 6.0))
    begin, end = _find_shown_columns((rolled.height, rolled.width), canvas).T
    y, x = np.indices((canvas.height, canvas.width))
    shown = (x >= begin[:, None]) & (x < end[:, None])
    seen = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(canvas.canvas_from_view).T
    at = seen[..., :2] / seen[..., 2:]
    inside = np.minimum(at, [rolled.width - 1, rolled.height - 1] - at).min(axis=-1)
    assert 0.2 < shown.mean() < 0.8
    inner = np.s_[4:-4, 4:-4]  # what goes on beyond the canvas is not looked up
    # the pixels that a value lies between are all there; OpenCV places them to 1/32
    assert inside[inner][shown[inner]].min() > -1 / 32
    assert inside[inner][~shown[inner]].max() < 1.5
    truth, _ = depth_of(REFERENCE)
    near, far = 0.7 * truth.min(), 1.3 * truth.max()
    found = sweep_depth(picture_of(REFERENCE), REFERENCE, [partner(view) for view in others], (near, far), threads=1)
    right = np.abs(found - truth) < 0.02 * truth
    border = np.ones(truth.shape, dtype=bool)
    border[10:-10, 10:-10] = False
    assert np.mean(right[border]) > 0.885  # 0.85 where the blackness around the turned picture is compared


#: As the views around, three times as many pixels to a side.
WIDE = {"width": 360, "height": 270, "focal": (300.0, 306.0)}
WIDE_REFERENCE = camera((0.1, -0.4, 0.3), **WIDE)
WIDE_AROUND = (
    camera((0.5, -0.4, 0.3), (0, 4, 0), **WIDE),
    camera((-0.3, -0.5, 0.35), (3, -5, 12), **WIDE),
    camera((0.15, -0.4, 0.65), (-4, 0, -25), **WIDE),
    camera((0.0, -0.0, 0.0), (2, 2, 3), **WIDE),
)


def test_coarse_to_fine_finds_what_all_candidates_find_with_less_work(monkeypatch):
    truth, _ = depth_of(WIDE_REFERENCE)
    depths = (0.35 * truth.min(), 1.5 * truth.max())
    pictures = [partner(view) for view in WIDE_AROUND]
    codes, work, matched = picture_of(WIDE_REFERENCE), [], depth.match_candidates

    def counted(views, columns, rows, *, threads):
        work.append(views.reference.size * columns.shape[1])
        return matched(views, columns, rows, threads=threads)

    monkeypatch.setattr(depth, "match_candidates", counted)
    whole = depth._Sweep.of(codes, WIDE_REFERENCE, pictures, depths)
    full, all_of_it = whole.depth(1), work.pop()
    assert len(whole.inverse) > 100
    found = sweep_depth(codes, WIDE_REFERENCE, pictures, depths, threads=1)
    assert sum(work) < 0.6 * all_of_it
    share = {}
    for name, one in (("full", full), ("found", found)):
        error = np.abs(one - truth) / truth
        share[name] = np.array([np.mean(error < limit) for limit in (0.005, 0.01, 0.02)])
    assert share["full"][1] > 0.95
    assert (share["found"] > share["full"] - 0.003).all()
    assert np.mean(np.abs(found - full) < 0.01 * truth) > 0.98
    # threads change nothing
    assert np.array_equal(sweep_depth(codes, WIDE_REFERENCE, pictures, depths, threads=3), found)


def test_half_a_picture_is_taken_by_half_the_camera():
    odd = camera((0, 0, 0), width=121, height=91)
    codes = np.zeros((91, 121), np.uint8)
    codes[38:44, 70:76] = 255  # about (72.5, 40.5)
    small, by = depth._halve_codes(codes), depth._halve_camera(odd)
    assert small.shape == (by.height, by.width) == (45, 60)
    y, x = (np.average(np.indices(small.shape)[k], weights=small) for k in (0, 1))
    rays = (np.array([x, y]) - by.centre_px) / by.focal_px
    np.testing.assert_allclose(rays * odd.focal_px + odd.centre_px, [72.5, 40.5], atol=0.05)


def test_tiles_hold_each_pixel_once_and_the_candidates_that_are_there():
    rng = np.random.default_rng(4)
    y, x = np.indices((200, 310))
    true = 40 + 30 * np.sin(x / 60) + 50 * (y > 140) + rng.uniform(-2, 2, (200, 310))
    coarse = true.reshape(100, 2, 155, 2).mean(axis=(1, 3))
    coarse[:, 116:] = np.nan
    times, sizes = np.zeros((200, 310), int), []
    for tile in cut_tiles(coarse, (200, 310), 160):
        times[tile.inner_rows, tile.inner_columns] += 1
        inside = true[tile.inner_rows, tile.inner_columns]
        assert tile.candidates.start < inside.min() and inside.max() < tile.candidates.stop - 1
        assert np.array_equal(true[tile.rows, tile.columns][tile.kept], inside)
        sizes.append(tile.candidates.stop - tile.candidates.start)
        if tile.columns.stop == 310:
            assert tile.candidates == slice(0, 160)
    assert (times == 1).all()
    assert min(sizes) >= 16 and np.mean(sizes) < 120
    # at either end
    for value in (0.0, 159.0):
        for tile in cut_tiles(np.full((50, 50), value), (100, 100), 160):
            assert 16 <= tile.candidates.stop - tile.candidates.start < 30
            assert 0 <= tile.candidates.start <= value < tile.candidates.stop <= 160


def test_a_window_counts_where_the_partner_shows_all_of_it(subtests):
    """Nearer than the reference, a partner shows the same window over more pixels; farther, over fewer."""
    for ahead in (1.2, 0.0, -0.8):
        with subtests.test(ahead=ahead):
            rolled = camera((0.15, -0.4 + ahead, 0.3), (0, 0, 30))
            depths = (2.0, 2.6)
            canvas = _make_canvas(REFERENCE, rolled, depths)
            inverse = np.linspace(1 / depths[1], 1 / depths[0], 3)
            columns, rows = (_sample_positions(REFERENCE, canvas, inverse, axis)[None] for axis in (0, 1))
            # a cost of 255 says that no view shows the window
            y, x = np.indices((90, 120))
            reference = (np.abs(x % 8 - 4) + np.abs(y % 8 - 4)).astype(np.uint8) * 20
            blank = np.zeros((1, canvas.height, canvas.width), np.uint8)
            cost = np.empty((90, 120, 3), dtype=np.uint8)
            shown = _find_shown_columns((rolled.height, rolled.width), canvas)[None]
            _apertures.matching_costs(
                reference, blank, columns=columns, rows=rows, cost=cost, share=shares(1), unseen=255, radius=2,
                shown=shown, least=0,
            )  # fmt: skip
            used, compared = cost != 255, 0
            matrix, offset = rolled.seen_from(REFERENCE)
            corners = np.array([(i, j) for i in (-2, 2) for j in (-2, 2)])
            for d, q in enumerate(inverse):
                at = np.stack([x, y], axis=-1)[2:-2, 2:-2, None] + corners
                seen = np.concatenate([at, np.ones((*at.shape[:-1], 1))], axis=-1) @ matrix.T / q + offset
                px = seen[..., :2] / seen[..., 2:]
                room = np.minimum(px, [rolled.width - 1, rolled.height - 1] - px).min(axis=(-1, -2))
                mine = used[2:-2, 2:-2, d]
                assert not mine[room < -0.1].any()
                # the pixels between which a value lies are to be there, too: one more on each side
                assert mine[room > 2.0].all()
                compared += int((np.abs(room) < 4).sum())
            assert compared > 500


def test_what_lies_outside_of_the_range_is_not_known():
    truth, _ = depth_of(REFERENCE)
    beyond = (1.2 * truth.max(), 2 * truth.max())
    found = sweep_depth(picture_of(REFERENCE), REFERENCE, [partner(v) for v in AROUND], beyond, threads=1)
    assert np.mean(found == 0) > 0.9
    behind = camera((0.1, -0.4, 0.3), (0, 180, 0))
    nothing = sweep_depth(picture_of(REFERENCE), REFERENCE, [partner(behind)], (1, 5), threads=1)
    assert not nothing.any()


def test_depths_stay_where_another_view_agrees():
    exact = depth_view(REFERENCE)
    others = [depth_view(v) for v in AROUND]
    kept = confirm_depth(exact, others).depth
    assert np.mean(kept > 0) > 0.9
    error = np.abs(kept / exact.depth - 1)[kept > 0]
    # depths are looked up at the nearest pixel: it may be the other side of an edge
    assert np.mean(error < 0.004) > 0.97
    assert error.max() < 0.02
    # wrong where nobody says so
    wrong = exact.depth.copy()
    wrong[20:50, 30:70] *= 1.2
    judged = confirm_depth(DepthView(depth=wrong, camera=REFERENCE), others).depth
    assert not judged[22:48, 32:68].any()
    assert np.array_equal(judged[60:, 80:], kept[60:, 80:])
    # unknown here or there
    hole = exact.depth.copy()
    hole[:45] = 0
    assert not confirm_depth(DepthView(depth=hole, camera=REFERENCE), others).depth[:45].any()
    blind = [DepthView(depth=np.zeros_like(other.depth), camera=other.camera) for other in others]
    assert not confirm_depth(exact, blind).depth.any()
    assert not confirm_depth(exact, []).depth.any()


def test_it_makes_no_difference_how_many_rows_are_worked_on_at_once(monkeypatch):
    exact, others = depth_view(REFERENCE), [depth_view(v) for v in AROUND]
    found = []
    for rows in (7, 10_000):
        monkeypatch.setattr(agreement, "ROWS_AT_ONCE", rows)
        monkeypatch.setattr(normals, "ROWS_AT_ONCE", rows)
        depth = confirm_depth(exact, others).depth
        found.append((depth, estimate_normals(depth, REFERENCE)))
    for few, all_of_them in zip(*found, strict=True):
        assert np.array_equal(few, all_of_them)


def test_agreeing_depths_are_averaged():
    exact, other = depth_view(REFERENCE), depth_view(AROUND[0])
    off = DepthView(depth=exact.depth * np.float32(1.006), camera=REFERENCE)
    kept = confirm_depth(off, [other]).depth
    ratio = (kept / exact.depth)[kept > 0]
    assert np.median(ratio) == pytest.approx(1.003, abs=7e-4)


def test_normals_of_a_room():
    depth, truth = depth_of(REFERENCE)
    normals = estimate_normals(depth.astype("f4"), REFERENCE)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    assert (np.sum(normals * rays(REFERENCE), axis=-1) < 0).all()
    angle = np.degrees(np.arccos(np.clip(np.sum(normals * truth, axis=-1), -1, 1)))
    assert np.median(angle) < 0.1
    # edges of the room take part in few windows
    assert np.mean(angle < 2) > 0.9
    noisy = depth * (1 + np.random.default_rng(2).normal(0, 0.002, depth.shape))
    angle = np.degrees(
        np.arccos(np.clip(np.sum(estimate_normals(noisy.astype("f4"), REFERENCE) * truth, axis=-1), -1, 1))
    )
    assert np.median(angle) < 8


def test_normals_do_not_reach_over_steps_and_gaps():
    flat = camera((0, 0, 0), shift=(0, 0))
    depth = np.full((90, 120), 2.0, dtype="f4")
    depth[:, 60:] = 3.0
    depth[40:50] = 0
    normals = estimate_normals(depth, flat)
    np.testing.assert_allclose(normals[depth > 0], np.tile([0, 0, -1.0], (int((depth > 0).sum()), 1)), atol=1e-4)
    assert not normals[40:50].any()
    alone = np.zeros_like(depth)
    alone[5, 7] = 1.0
    ray = rays(flat)[5, 7]
    np.testing.assert_allclose(estimate_normals(alone, flat)[5, 7], -ray / np.linalg.norm(ray), atol=1e-6)
