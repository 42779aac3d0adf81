"""What the plane sweep chooses and keeps: against loops over pixels, points and views."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.imaging.plane_sweep import (
    DepthView,
    Sights,
    choose_partners,
    confirm_depth,
    depth,
    depth_range,
    estimate_normals,
)
from colmap_inertial.imaging.plane_sweep.tiles import cut_tiles
from tests.helpers.sweep_scenes import camera, depth_view, sights_of
from tests.imaging.plane_sweep.test_plane_sweep import AROUND, REFERENCE


def confirmed(reference, others):
    """Means, shares that agree, and shares that see something behind, pixel by pixel through the world."""
    kept, shares, beyond = np.zeros((3, *reference.depth.shape))

    def ray(view, x, y):
        (fx, fy), (cx, cy) = view.focal_px, view.centre_px
        return np.array([(x - cx) / fx, (y - cy) / fy, 1.0])

    def to_world(view, x, y, z):
        return view.cam_from_world.T @ (ray(view, x, y) * z) + view.cam_in_world

    def to_pixel(view, world):
        at = view.cam_from_world @ (world - view.cam_in_world)
        return (*(view.focal_px * at[:2] / at[2] + view.centre_px), at[2])

    for y, x in np.ndindex(reference.depth.shape):
        z = float(reference.depth[y, x])
        agreeing = [z]
        for other in others if z > 0 else ():
            u, v, w = to_pixel(other.camera, to_world(reference.camera, x, y, z))
            column, row = round(u), round(v)
            if w <= 0 or not (0 <= column < other.camera.width and 0 <= row < other.camera.height):
                continue
            there = float(other.depth[row, column])
            if there <= 0:
                continue
            x_back, y_back, back = to_pixel(reference.camera, to_world(other.camera, u, v, there))
            if np.hypot(x_back - x, y_back - y) <= 1 and abs(back - z) <= 0.02 * z:
                agreeing.append(back)
            elif there / w > 1.02:
                beyond[y, x] += 1 / len(others)
        shares[y, x] = (len(agreeing) - 1) / len(others)
        kept[y, x] = np.mean(agreeing) if len(agreeing) > 1 else 0.0
    return kept, shares, beyond


def test_depths_that_others_confirm_are_those_of_a_loop_over_pixels(subtests):
    for ahead in (False, True):
        with subtests.test(ahead=ahead):
            rng = np.random.default_rng(4)
            small = {"width": 40, "height": 30, "focal": (33.0, 34.0)}
            # from ahead, part of what is seen lies behind the other view, and none of what it sees is far away
            views = [camera((0.1, -0.4, 0.3), **small), camera((0.4, -0.4, 0.3), (0, 4, 0), **small)]
            views.append(
                camera((0.0, 1.2, 0.2), (0, 60, 0), **small) if ahead else camera((0.0, -0.1, 0.1), (2, 2, 3), **small)
            )
            noisy = []
            for view in views:
                one = depth_view(view)
                factor = np.exp(rng.normal(0, 0.01, one.depth.shape)) * np.where(
                    rng.random(one.depth.shape) < 0.1, 0, 1
                )
                noisy.append(replace(one, depth=(one.depth * factor).astype("f4")))
            found, (expected, agreeing, beyond) = confirm_depth(noisy[0], noisy[1:]), confirmed(noisy[0], noisy[1:])
            # single precision decides otherwise at a threshold
            differs = np.abs(found.depth - expected) > 1e-4 * expected
            assert differs.mean() < 2e-3 and (expected > 0).mean() > 0.3
            known = noisy[0].depth > 0
            for share, loop in ((found.agreeing, agreeing), (found.beyond, beyond)):
                assert (np.abs(share - loop) > 1e-6)[known].mean() < 2e-3
                assert loop.max() > 0


def test_the_range_of_depths_by_quantiles():
    view = camera((1.0, 2.0, 3.0), (0, 30, 0))
    depths = np.concatenate([np.linspace(2.0, 12.0, 1001), [-5.0, -1.0, 0.0]])
    across = np.random.default_rng(0).uniform(-3, 3, (len(depths), 2))
    points = view.cam_in_world + np.column_stack([across, depths]) @ view.cam_from_world
    near, far = depth_range(Sights.of([view], points, [np.arange(len(points))]), 0)
    assert near == pytest.approx(0.75 * 2.05) and far == pytest.approx(1.3 * 11.95)
    behind = Sights.of([view], points, [np.array([1001, 1002])])
    assert depth_range(behind, 0) is None


def test_partners_are_chosen_as_by_a_loop():
    rng = np.random.default_rng(7)
    for _ in range(20):
        views = [camera(rng.uniform(-1, 1, 3)) for _ in range(9)]
        scores = np.where(rng.random(9) < 0.2, 0, rng.uniform(1, 10, 9))
        scores[0] = 0
        sights = Sights.of(views, np.zeros((1, 3)), [np.zeros(1, dtype=int)] * 9)
        away = [(v.cam_in_world - views[0].cam_in_world) for v in views]
        left, chosen = {k: s for k, s in enumerate(scores) if s > 0}, []
        while left and len(chosen) < 5:
            best = max(left, key=left.get)
            chosen.append(best)
            del left[best]
            for k in left:
                cosine = away[k] @ away[best] / np.linalg.norm(away[k]) / np.linalg.norm(away[best])
                left[k] *= 1 - 0.5 * cosine**2
        assert choose_partners(sights, 0, scores, 5) == tuple(chosen)


def test_points_by_view_and_views_by_point_are_the_same():
    sights = sights_of((REFERENCE, *AROUND))
    pairs = {(v, p) for v, points in enumerate(sights.of_view) for p in points.tolist()}
    first = sights.first.tolist()
    back = {(int(v), p) for p in range(len(sights.points)) for v in sights.of_point[first[p] : first[p + 1]]}
    assert pairs == back and len(sights.of_point) == len(pairs)


def test_candidates_are_a_step_apart_in_the_partner_s_picture(subtests):
    """Sideways, a point moves by focal times baseline times inverse depth."""
    for baseline in ((0.3, 0.0, 0.0), (0.0, -0.4, 0.0), (0.4, 0.3, 0.0)):
        with subtests.test(baseline=baseline):
            near, far = 1.5, 9.0
            inverse = depth._choose_candidates(REFERENCE, [np.array(baseline), np.zeros(3)], near, far)
            assert inverse[0] == 1 / far and inverse[-1] == 1 / near and np.ptp(np.diff(inverse)) < 1e-12
            step_px = REFERENCE.focal_px.max() * np.linalg.norm(baseline) * np.diff(inverse)[0]
            widest = depth._LIMITS.step_px
            assert step_px <= widest + 1e-9
            # one candidate fewer would be more than a step
            assert step_px * (len(inverse) - 1) / (len(inverse) - 2) > widest
            few = depth._choose_candidates(REFERENCE, [np.array([1e-6, 0, 0])], near, far)
            many = depth._choose_candidates(REFERENCE, [np.array([100.0, 0, 0])], near, far)
            assert (len(few), len(many)) == (depth._LIMITS.least_candidates, depth._LIMITS.most_candidates)


def test_a_turned_view_is_cut_to_what_the_limit_allows(subtests):
    """A wide lens shows far more than the reference sees: the middle of what is shared stays."""
    for shift in (0.0, 25.0):
        with subtests.test(shift=shift):
            wide = camera((0.1, -0.39, 0.3), width=400, height=300, focal=(20.0, 20.0))
            narrow = replace(REFERENCE, centre_px=REFERENCE.centre_px + shift)
            canvas = depth._make_canvas(narrow, wide, (0.02, 6.0))
            baseline = narrow.cam_from_world @ (wide.cam_in_world - narrow.cam_in_world)
            for axis, (start, size) in enumerate(((canvas.left, canvas.width), (canvas.top, canvas.height))):
                whole = (narrow.width, narrow.height)[axis]
                at = np.arange(whole)[:, None] - narrow.centre_px[axis]
                inverse = np.linspace(1 / 6.0, 1 / 0.02, 9)
                shrinks = 1 - inverse * baseline[2]
                shown = (at - narrow.focal_px[axis] * inverse * baseline[axis]) / shrinks + narrow.centre_px[axis]
                low, high = (
                    shown[:, shrinks >= depth._LIMITS.closest].min(),
                    shown[:, shrinks >= depth._LIMITS.closest].max(),
                )
                most = depth._LIMITS.largest * whole
                assert high - low > most + 10
                assert most <= size <= most + 3
                assert start + size / 2 == pytest.approx((low + high) / 2, abs=2)


def test_a_tile_has_the_candidates_of_its_own_half_and_a_margin():
    """One step in an otherwise flat picture: each tile has what it and what it shares show, and six beyond."""
    coarse = np.full((120, 160), 30.0)
    coarse[:, 80:] = 90.5
    for tile in cut_tiles(coarse, (240, 320), 200):
        values = np.unique(
            coarse[tile.rows.start // 2 : -(-tile.rows.stop // 2), tile.columns.start // 2 : -(-tile.columns.stop // 2)]
        )
        first, beyond = int(np.floor(values.min())) - 6, int(np.ceil(values.max())) + 6 + 1
        assert tile.candidates.start <= first and beyond <= tile.candidates.stop
        # sixteen at least, the same on both sides
        more = tile.candidates.stop - tile.candidates.start - (beyond - first)
        assert more <= max(0, 16 - (beyond - first)) + 1
        assert abs((first - tile.candidates.start) - more / 2) <= 1
        for inner, outer, length in ((tile.inner_rows, tile.rows, 240), (tile.inner_columns, tile.columns, 320)):
            assert (outer.start, outer.stop) == (max(0, inner.start - 8), min(length, inner.stop + 8))
            assert inner.stop - inner.start <= 96
    # half of a tile must be known
    for known, whole in ((0.49, True), (0.51, False)):
        sparse = np.full((48, 48), 30.0)
        sparse.ravel()[int(known * sparse.size) :] = np.nan
        (tile,) = cut_tiles(sparse, (96, 96), 200)
        assert (tile.candidates == slice(0, 200)) == whole


def test_a_depth_in_the_plane_of_a_camera_is_confirmed_by_none():
    """A point in the plane of the other centre has no place in its picture."""
    view = camera((0.0, 0.0, 0.0))
    level = depth_view(view)
    beside = camera((0.5, 2.0, 0.0))
    flat = DepthView(depth=np.full_like(level.depth, 2.0), camera=view)
    assert not confirm_depth(flat, [depth_view(beside)]).depth.any()


def plane_normal(depth, view, x, y):
    """By least squares over the window's inverse depths, one pixel by itself."""
    height, width = depth.shape
    inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0)
    if depth[y, x] <= 0:
        return np.zeros(3)
    # the median over 5 x 5, edges repeated, unless it is of another surface
    rows, columns = (np.clip(np.arange(at - 2, at + 3), 0, size - 1) for at, size in ((y, height), (x, width)))
    middle = np.median(inverse[np.ix_(rows, columns)])
    middle = inverse[y, x] if abs(middle - inverse[y, x]) > 0.03 * inverse[y, x] else middle
    (fx, fy), (cx, cy) = view.focal_px, view.centre_px
    table, values = [], []
    for j in range(max(0, y - 3), min(height, y + 4)):
        for i in range(max(0, x - 3), min(width, x + 4)):
            if abs(inverse[j, i] - middle) <= 0.03 * middle:
                # inverse depth is n (ray) / d
                table.append(
                    [(i - view.centre_px[0]) / view.focal_px[0], (j - view.centre_px[1]) / view.focal_px[1], 1]
                )
                values.append(inverse[j, i])
    table = np.array(table).reshape(-1, 3)
    own = np.array([(x - cx) / fx, (y - cy) / fy, 1.0])
    flat = len(values) >= 6 and np.linalg.matrix_rank(table) == 3
    normal = np.linalg.lstsq(table, np.array(values), rcond=None)[0] if flat else own
    return -normal / np.linalg.norm(normal)


def test_normals_are_those_of_least_squares_pixel_by_pixel():
    view = camera((0.1, -0.4, 0.3), (0, 25, 10), width=34, height=26, focal=(33.0, 30.0))
    rng = np.random.default_rng(9)
    shown = depth_view(view).depth
    shown *= np.exp(rng.normal(0, 0.004, shown.shape)).astype("f4")
    # holes, and a step that no plane reaches over
    shown[rng.random(shown.shape) < 0.15] = 0
    shown[:, 20:] *= 1.3
    found = estimate_normals(shown, view)
    expected = np.array([[plane_normal(shown, view, x, y) for x in range(34)] for y in range(26)])
    off = np.linalg.norm(found - expected, axis=-1)
    # single precision decides otherwise about a neighbour at the threshold
    assert np.mean(off < 2e-3) > 0.97
    assert np.array_equal(np.any(found != 0, axis=-1), shown > 0)


def test_alone_a_pixel_faces_the_camera():
    view = camera((0, 0, 0), width=34, height=26, focal=(33.0, 30.0))
    depth = np.zeros((26, 34), dtype="f4")
    depth[4, 30] = 2.0
    ray = np.array([(30 - view.centre_px[0]) / 33.0, (4 - view.centre_px[1]) / 30.0, 1.0])
    np.testing.assert_allclose(estimate_normals(depth, view)[4, 30], -ray / np.linalg.norm(ray), atol=1e-6)
