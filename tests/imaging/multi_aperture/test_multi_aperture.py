"""Fusion of several apertures: kernels against numpy, geometry against projection, scenes whose disparity is known."""

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial._kernels import _apertures
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.geometry import quat_exp, quat_rotate
from colmap_inertial.core.options import ApertureOptions
from colmap_inertial.core.types import Aperture, ApertureRig, CameraModel
from colmap_inertial.imaging import semi_global
from colmap_inertial.imaging.multi_aperture import (
    _volume as volume,
    estimate_disparity,
    fuse_apertures,
    plane_of,
    rectify,
    refocus,
)
from colmap_inertial.imaging.multi_aperture._fill import _fit_neighbours, fill_hidden
from colmap_inertial.imaging.multi_aperture._geometry import transfer, trifocal_tensor
from colmap_inertial.imaging.multi_aperture._information import cost_tables
from colmap_inertial.imaging.multi_aperture._light import adds_up, light_cost
from colmap_inertial.imaging.multi_aperture._noise import measure_noise, smoothing
from colmap_inertial.imaging.multi_aperture.disparity import background
from tests.helpers.aperture_scenes import FLAT, four_apertures, plane_views, projectors, psnr_db, read_pfm, texture
from tests.references.semi_global import matching_costs_reference, semi_global_reference

INSTRUCTION_SETS = _apertures.instruction_sets()
#: Height, width, candidates, views, radius of the census window.
SIDES = [(1, 1, 1, 1, 2), (1, 19, 3, 2, 2), (23, 1, 5, 1, 1), (13, 37, 7, 3, 2), (18, 70, 33, 3, 3), (9, 131, 64, 2, 2)]


def random_problem(height, width, candidates, views, seed=0):
    rng = np.random.default_rng(seed)
    reference = rng.integers(0, 256, (height, width), dtype=np.uint8)
    others = rng.integers(0, 256, (views, height, width), dtype=np.uint8)
    start = rng.integers(-60, 60, (2, views, candidates, 1))
    slope = rng.uniform(-0.3, 0.3, (views, candidates, 1))
    columns = (16 * np.arange(width) + start[0] + (np.arange(width) * slope).astype(int)).astype(np.int32)
    rows = (16 * np.arange(height) + start[1]).astype(np.int32)
    return (
        reference,
        others,
        {"columns": columns, "rows": rows, "share": semi_global.shares(views), "unseen": 6 * views},
    )


def test_compiled_costs_are_the_reference_s_bit_for_bit(subtests):
    for instruction_set in INSTRUCTION_SETS:
        for sides in SIDES:
            with subtests.test(instruction_set=instruction_set, sides=sides):
                *sizes, radius = sides
                reference, others, where = random_problem(*sizes)
                rng = np.random.default_rng(1)
                views = len(others)
                tables = rng.integers(0, 60, (views, 256, 256), dtype=np.uint8)
                blend = rng.integers(-300, 300, views + 2).astype(np.int32)
                light = {"blend": blend, "blend_table": np.arange(256, dtype=np.uint8)}
                ends = rng.integers(0, sizes[1] // 4 + 1, (views, sizes[0], 2), dtype=np.int32)
                shown = {"shown": np.stack([ends[..., 0], sizes[1] - ends[..., 1]], axis=-1).astype(np.int32)}
                nothing = {"shown": np.repeat(ends[..., :1], 2, axis=-1)}
                ways = ({}, {"least": 9}, {"tables": tables}, light, {"tables": tables, **light})
                for more in (*ways, shown, {**shown, **light}, {**shown, "tables": tables}, nothing):
                    wanted = matching_costs_reference(reference, others, radius=radius, **where, **more)
                    for threads in (1, 2, 3):
                        cost = np.full(wanted.shape, 77, dtype=np.uint8)
                        _apertures.matching_costs(
                            reference,
                            others,
                            cost=cost,
                            radius=radius,
                            threads=threads,
                            instruction_set=instruction_set,
                            **where,
                            **more,
                        )
                        assert np.array_equal(cost, wanted)


def test_compiled_semi_global_matching_is_the_reference_s_bit_for_bit(subtests):
    for instruction_set in INSTRUCTION_SETS:
        for sides in SIDES:
            with subtests.test(instruction_set=instruction_set, sides=sides):
                height, width, candidates = sides[:3]
                rng = np.random.default_rng(2)
                cost = rng.integers(0, 256, (height, width, candidates), dtype=np.uint8)
                guide = rng.integers(0, 256, (height, width), dtype=np.uint8)
                for small, jump in (semi_global.jump_table(3), (4000, np.full(256, 4000, dtype=np.uint16))):
                    wanted = semi_global_reference(cost, guide, small=small, jump=jump)
                    padded = -(-candidates // _apertures.PADDING) * _apertures.PADDING
                    for threads in (1, 2):
                        total = np.empty((height, width, padded), dtype=np.uint16)
                        _apertures.semi_global(
                            cost,
                            guide,
                            small=small,
                            jump=jump,
                            total=total,
                            threads=threads,
                            instruction_set=instruction_set,
                        )
                        assert np.array_equal(total[..., :candidates], wanted)
                    least, index = np.empty((2, height, width), dtype=np.uint16)
                    aside = np.empty((height, width), dtype=np.float32)
                    _apertures.winners(total, least=least, index=index, aside=aside, candidates=candidates)
                    assert np.array_equal(index, wanted.argmin(axis=-1))
                    assert np.array_equal(least, wanted.min(axis=-1))
                    assert np.abs(aside).max() <= 0.5


def test_kernels_refuse_arrays_that_do_not_fit():
    reference, others, where = random_problem(8, 9, 4, 2)
    cost = np.empty((8, 9, 4), dtype=np.uint8)
    with pytest.raises(ValueError, match="columns, rows"):
        _apertures.matching_costs(reference, others, cost=cost[..., :3].copy(), radius=2, **where)
    with pytest.raises(ValueError, match="instruction_set"):
        _apertures.matching_costs(reference, others, cost=cost, radius=2, instruction_set="none", **where)
    for shown in (
        np.zeros((2, 7, 2), np.int32),
        np.array([[[3, 2]] * 8] * 2, np.int32),
        np.full((2, 8, 2), 10, np.int32),
    ):
        with pytest.raises(ValueError, match="shown"):
            _apertures.matching_costs(reference, others, cost=cost, radius=2, shown=shown, **where)
    with pytest.raises(ValueError, match="jump"):
        jump = np.full(256, 5000, dtype=np.uint16)
        _apertures.semi_global(cost, reference, small=1, jump=jump, total=np.empty((8, 9, 32), dtype=np.uint16))


# --- geometry -------------------------------------------------------------------------------------------------------


def test_trifocal_tensor_takes_points_where_they_project():
    rng = np.random.default_rng(3)
    second, third = rng.normal(size=(2, 3, 4))
    points = np.column_stack([rng.normal(size=(20, 3)), np.ones(20)])
    first = points[:, :3]
    in_second, in_third = points @ second.T, points @ third.T
    lines = np.cross(in_second, rng.normal(size=(20, 3)))  # any line through the point
    moved = transfer(trifocal_tensor(second, third), first, lines)
    assert np.allclose(np.cross(moved, in_third) / np.linalg.norm(in_third, axis=1)[:, None] ** 2, 0, atol=1e-9)


def bent_rig():
    """Apertures that are turned against each other, one of them nearer to the scene, with distortion."""
    camera = CameraModel(
        model="OPENCV", width=320, height=240, params=(300.0, 302.0, 161.0, 119.0, 0.05, -0.03, 1e-3, -5e-4)
    )
    rng = np.random.default_rng(4)
    places = ((0, 0, 0), (0.02, 0.001, 0.003), (0.001, 0.02, -0.002), (0.02, 0.02, 0.004))
    apertures = [
        Aperture(
            name=role,
            role=role,
            camera=camera,
            cam_from_rig_xyzw=quat_exp(0.02 * rng.normal(size=3)),
            cam_in_rig=np.array(place, dtype=float),
        )
        for role, place in zip(("green", "red", "blue", "luminance"), places, strict=True)
    ]
    return ApertureRig(apertures=tuple(apertures))


def test_candidates_lie_where_points_of_their_depth_project():
    rig = bent_rig()
    cameras = projectors(rig)
    canvas = rectify(rig, cameras)
    assert canvas.baselines[0, 2] == pytest.approx(0, abs=1e-12)
    depths = np.array([0.4, 0.8, 2.0])
    disparities = np.array([canvas.disparity(depth) for depth in depths])
    sizes, offsets = canvas.transfers(disparities)
    pixels = np.array([[30.0, 40.0], [160.0, 120.0], [290.0, 200.0]])
    for d, depth in enumerate(depths):
        rays = np.column_stack([(pixels - canvas.centre_px) / canvas.focal_px, np.ones(3)]) * depth
        in_reference = rays @ canvas.rect_from_reference
        reference = rig.reference
        in_rig = quat_rotate(reference.cam_from_rig_xyzw * [-1, -1, -1, 1], in_reference) + reference.cam_in_rig
        for k, aperture in enumerate(rig.apertures[1:]):
            in_cam = quat_rotate(aperture.cam_from_rig_xyzw, in_rig - aperture.cam_in_rig)
            wanted = cameras[k + 1].img_from_cam(in_cam) - 0.5
            at = sizes[k, d] * pixels + offsets[k, d]
            got = np.array([bilinear(canvas.image_from_canvas[k + 1], *xy) for xy in at])
            assert np.abs(got - wanted).max() < 0.01


def bilinear(values, x, y):
    i, j = int(y), int(x)
    s, t = y - i, x - j
    return (1 - s) * ((1 - t) * values[i, j] + t * values[i, j + 1]) + s * (
        (1 - t) * values[i + 1, j] + t * values[i + 1, j + 1]
    )


def test_apertures_side_by_side_need_no_resampling():
    rig = four_apertures(64, 48)
    canvas = rectify(rig, projectors(rig))
    assert (canvas.width, canvas.height) == (64, 48)
    assert canvas.image_from_canvas == (None,) * 4
    assert np.allclose(canvas.ratios, [[1, 0, 0], [0, 1, 0], [1, 1, 0]])


def test_apertures_behind_each_other_are_refused():
    camera = CameraModel(model="PINHOLE", width=64, height=48, params=(60.0, 60.0, 32.0, 24.0))
    pair = [
        Aperture(name=str(i), role="other", camera=camera, cam_from_rig_xyzw=FLAT, cam_in_rig=np.array([0, 0, 0.1 * i]))
        for i in range(2)
    ]
    rig = ApertureRig(apertures=tuple(pair))
    with pytest.raises(ValueError, match="before or behind"):
        rectify(rig, projectors(rig))
    with pytest.raises(ValueError, match="same place"):
        ApertureRig(apertures=(pair[0], Aperture(**{**vars(pair[0]), "name": "b"})))
    with pytest.raises(ValueError, match="at least two"):
        ApertureRig(apertures=(pair[0],))


# --- scenes of known disparity --------------------------------------------------------------------------------------

PLANE = ApertureOptions(threads=1, disparity_px=(-4.0, 12.0))


def test_planes_are_found_to_a_fraction_of_a_pixel(subtests):
    for slope in ((0.0, 0.0), (0.02, 0.0), (-0.01, 0.015)):
        for middle_px in (-2.3, 5.0):
            with subtests.test(slope=slope, middle_px=middle_px):
                planes, truth, rig = plane_views(160, 120, middle_px, slope)
                found = estimate_disparity(planes, rectify(rig, projectors(rig)), PLANE)
                inner = (slice(16, -16), slice(16, -16))
                error = np.abs(found.disparity_px - truth)[inner]
                assert np.median(error) < 0.2  # candidates are half a pixel apart
                assert (error > 0.5).mean() < 0.01
                assert found.measured[inner].mean() > 0.98


def test_apertures_that_are_turned_bent_and_set_back_see_a_wall_where_it_is():
    rig = bent_rig()
    cameras = projectors(rig)
    depth_m = 0.8
    pattern = texture(1200, 900, seed=12)
    import cv2

    reference, planes = rig.reference, []
    for aperture, camera in zip(rig.apertures, cameras, strict=True):
        x, y = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
        rays = np.column_stack([camera.cam_from_img(np.column_stack([x.ravel(), y.ravel()])), np.ones(x.size)])
        back = [-1, -1, -1, 1]
        in_rig = quat_rotate(aperture.cam_from_rig_xyzw * back, rays)
        ray = quat_rotate(reference.cam_from_rig_xyzw, in_rig)
        start = quat_rotate(reference.cam_from_rig_xyzw, aperture.cam_in_rig - reference.cam_in_rig)
        hit = start + ray * ((depth_m - start[2]) / ray[:, 2])[:, None]
        at = (hit[:, :2] * 900 + [600, 450]).reshape(240, 320, 2).astype(np.float32)
        planes.append(np.rint(cv2.remap(pattern, at, None, cv2.INTER_LINEAR)).astype(np.uint8))
    canvas = rectify(rig, cameras)
    assert all(m is not None for m in canvas.image_from_canvas)
    fused = fuse_apertures(planes, rig, canvas, ApertureOptions(threads=1))
    inner = (slice(24, -24), slice(24, -24))
    assert fused.measured[inner].mean() > 0.97
    assert np.nanmedian(np.abs(fused.depth[inner] / depth_m - 1)) < 0.01
    wanted = np.repeat(planes[0][..., None], 3, axis=-1)
    assert psnr_db(fused.image[inner], wanted[inner]) > 33
    assert psnr_db(np.stack(planes[:3], axis=-1)[inner], wanted[inner]) < 20


def test_two_apertures_are_enough_for_disparity_and_not_for_colour():
    planes, truth, rig = plane_views(160, 120, 4.0, (0.0, 0.01))
    pair = ApertureRig(apertures=rig.apertures[:2])
    canvas = rectify(pair, projectors(pair))
    found = estimate_disparity(planes[:2], canvas, PLANE)
    assert np.median(np.abs(found.disparity_px - truth)[16:-16, 16:-16]) < 0.1
    with pytest.raises(InertialError, match="blue is missing"):
        fuse_apertures(planes[:2], pair, canvas, PLANE)


def test_the_range_of_disparities_is_found():
    planes, truth, rig = plane_views(256, 192, 9.0, (0.03, 0.0))
    canvas = rectify(rig, projectors(rig))
    found = estimate_disparity(planes, canvas, ApertureOptions(threads=1))
    assert (np.abs(found.disparity_px - truth)[20:-20, 20:-20] > 0.5).mean() < 0.01


def test_census_does_not_mind_a_monotone_change_of_brightness():
    planes, _, rig = plane_views(120, 90, 3.0, (0.0, 0.0))
    canvas = rectify(rig, projectors(rig))
    views = np.stack(planes[1:])
    spaced = volume.candidates(-4, 12, 1.0)
    half = (views // 2).astype(np.uint8) * 2  # distances between codes survive the curve below
    curve = np.clip(np.sort(np.random.default_rng(5).choice(200, 128, replace=False)), 0, 255).astype(np.uint8)
    columns, rows = canvas.sample_positions(np.rint(spaced))
    arguments = {"columns": columns, "rows": rows, "share": semi_global.shares(3), "unseen": 0, "radius": 2}
    reference = (planes[0] // 2) * 2
    before = matching_costs_reference(reference, half, **arguments)
    after = matching_costs_reference(curve[reference // 2], curve[half // 2], **arguments)
    assert np.array_equal(before, after)


def test_mutual_information_does_not_mind_any_change_of_brightness():
    planes, truth, rig = plane_views(160, 120, 5.0, (0.01, 0.0))
    canvas = rectify(rig, projectors(rig))
    disparity = truth.astype(np.float32)
    folded = [planes[0], *(255 - plane for plane in planes[1:])]  # a negative: no order of brightness survives
    straight, mirrored = (
        cost_tables(views[0], np.stack(views[1:]), canvas, disparity, 24).astype(int) for views in (planes, folded)
    )
    assert np.abs(straight[:, :, ::-1] - mirrored).mean() < 0.3
    options = ApertureOptions(cost="mutual-information", threads=1, disparity_px=(0.0, 10.0))
    found = estimate_disparity(folded, canvas, options)
    assert (np.abs(found.disparity_px - truth)[16:-16, 16:-16] > 1).mean() < 0.05


def test_the_order_of_the_other_views_does_not_matter():
    planes, _, rig = plane_views(120, 90, 4.0, (0.01, 0.01))
    swapped = ApertureRig(apertures=tuple(rig.apertures[i] for i in (0, 1, 3, 2)))
    first = estimate_disparity(planes, rectify(rig, projectors(rig)), PLANE)
    second = estimate_disparity([planes[i] for i in (0, 1, 3, 2)], rectify(swapped, projectors(swapped)), PLANE)
    assert np.array_equal(first.disparity_px, second.disparity_px)


def test_strips_give_what_the_whole_gives(monkeypatch):
    planes, _truth, rig = plane_views(96, 400, 4.0, (0.0, 0.005))
    canvas = rectify(rig, projectors(rig))
    whole = estimate_disparity(planes, canvas, PLANE)
    limits = replace(semi_global.MATCHING, memory_bytes=96 * (36 + 2 * 64) * 180)
    monkeypatch.setattr(semi_global, "MATCHING", limits)
    assert len(semi_global.strips(400, 96 * (36 + 2 * 64))) > 3
    in_strips = estimate_disparity(planes, canvas, PLANE)
    assert (np.abs(whole.disparity_px - in_strips.disparity_px) > 0.1).mean() < 0.01


def test_memory_is_bounded():
    for height, width, candidates in ((3000, 4000, 128), (200, 100, 20), (9000, 12000, 256)):
        row = width * (candidates + 2 * candidates)
        parts = semi_global.strips(height, row)
        assert [p[0] for p in parts] == [0, *[p[1] for p in parts[:-1]]]
        assert parts[-1][1] == height
        assert max(last - first for *_, first, last in parts) * row <= max(semi_global.MATCHING.memory_bytes, 98 * row)


def test_tiny_pictures_are_fused(subtests):
    for shape in ((1, 40), (40, 1), (1, 1), (5, 7)):
        with subtests.test(shape=shape):
            height, width = shape
            rig = four_apertures(width, height)
            rng = np.random.default_rng(6)
            planes = [rng.integers(0, 256, shape, dtype=np.uint8) for _ in range(4)]
            fused = fuse_apertures(planes, rig, rectify(rig, projectors(rig)), ApertureOptions(threads=1))
            assert fused.image.shape == (*shape, 3)
            assert np.isfinite(fused.disparity_px).all()


def test_an_even_picture_has_no_measured_disparity():
    rig = four_apertures(64, 48)
    planes = [np.full((48, 64), 10 * i, dtype=np.uint8) for i in range(4)]
    fused = fuse_apertures(planes, rig, rectify(rig, projectors(rig)), ApertureOptions(threads=1))
    assert not fused.measured.any()
    assert np.isnan(fused.depth).all()
    assert [np.unique(fused.image[..., c]).tolist() for c in range(3)] == [[10], [0], [20]]


def test_pictures_that_do_not_belong_to_the_rig_are_refused():
    rig = four_apertures(64, 48)
    canvas = rectify(rig, projectors(rig))
    planes = [np.zeros((48, 64), dtype=np.uint8)] * 4
    with pytest.raises(ValueError, match="3 pictures for 4 apertures"):
        fuse_apertures(planes[:3], rig, canvas)
    with pytest.raises(ValueError, match="not the camera's 48 x 64"):
        fuse_apertures([*planes[:3], np.zeros((48, 60), dtype=np.uint8)], rig, canvas)
    with pytest.raises(ValueError, match="all be uint8"):
        fuse_apertures([*planes[:3], np.zeros((48, 64), dtype=np.uint16)], rig, canvas)


# --- fusion ---------------------------------------------------------------------------------------------------------


def test_fused_colours_are_those_of_the_reference(subtests):
    for dtype in (np.uint8, np.uint16):
        with subtests.test(dtype=dtype):
            base = texture(240, 200, seed=0)
            colours = [base, 0.6 * base + 0.4 * texture(240, 200, seed=1), 0.7 * base + 0.3 * texture(240, 200, seed=2)]
            planes, truth, rig = plane_views(160, 120, 5.0, (0.02, 0.01), colours=colours)
            scale = np.iinfo(dtype).max // 255
            planes = [plane.astype(dtype) * dtype(scale) for plane in planes]
            canvas = rectify(rig, projectors(rig))
            options = ApertureOptions(threads=1, disparity_px=(0.0, 10.0), use_luminance=False)
            fused = fuse_apertures(planes, rig, canvas, options)
            assert fused.image.dtype == dtype
            assert np.array_equal(fused.image[..., 1], planes[0])
            wanted = plane_views(160, 120, 0.0, (0.0, 0.0), colours=colours)[0]  # green, red, blue from one place
            inner = (slice(16, -16), slice(16, -16))
            got = fused.image[..., [1, 0, 2]] / scale
            assert psnr_db(got[inner], np.stack(wanted[:3], axis=-1)[inner]) > 38
            depth = canvas.focal_px * 0.01 / truth
            assert np.nanmedian(np.abs(fused.depth / depth - 1)[inner]) < 0.02


def test_hidden_pixels_continue_the_background():
    # A near square before a wall: beside it each aperture sees what the reference does not, and the other way round.
    shape, near, far = (120, 160), 8.0, 2.0
    wall, square = (np.asarray(texture(260, 220, seed=s), dtype=np.uint8) for s in (8, 9))
    rig = four_apertures(160, 120)
    y, x = np.mgrid[: shape[0], : shape[1]]
    planes = []
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        before = wall[y + dy * int(far) + 20, x + dx * int(far) + 20]
        inside = (np.abs(x + dx * near - 80) < 25) & (np.abs(y + dy * near - 60) < 25)
        planes.append(
            np.where(inside, square[y + dy * int(near) + 20, x + dx * int(near) + 20], before).astype(np.uint8)
        )
    truth = np.where((np.abs(x - 80) < 25) & (np.abs(y - 60) < 25), near, far)
    canvas = rectify(rig, projectors(rig))
    found = estimate_disparity(planes, canvas, ApertureOptions(threads=1, disparity_px=(0.0, 10.0)))
    assert (np.abs(found.disparity_px - truth)[8:-8, 8:-8] > 1).mean() < 0.02
    hidden = ~found.visible[0]
    beside = (x >= 100) & (x < 104) & (np.abs(y - 60) < 20)  # the wall there is behind the square for the partner
    other_side = (x < 54) & (x > 40) & (np.abs(y - 60) < 20)
    assert hidden[other_side | beside].any()
    fused = fuse_apertures(planes, rig, canvas, ApertureOptions(threads=1, disparity_px=(0.0, 10.0)))
    assert psnr_db(fused.image[8:-8, 8:-8], np.repeat(planes[0][..., None], 3, axis=-1)[8:-8, 8:-8]) > 27


def test_gaps_are_filled_from_behind():
    disparity = np.full((9, 30), 2.0, dtype=np.float32)
    disparity[:, 15:] = 9.0
    known = np.ones(disparity.shape, dtype=bool)
    known[2:7, 10:18] = False
    filled = background(np.where(known, disparity, np.float32(99)), known)
    assert (filled[known] == disparity[known]).all()
    assert (filled[:, :15] == 2).all()
    nothing = background(disparity, np.zeros_like(known))
    assert np.array_equal(nothing, disparity)


def test_hidden_colours_follow_the_reference_nearby():
    guide = texture(120, 90, seed=1).astype(np.float32)[:90, :120] / 255
    values = 0.3 + 0.5 * guide
    seen = np.ones(guide.shape, dtype=bool)
    seen[30:40, 50:60] = False
    seen[:, 100:] = False  # wider than the nearest neighbours
    filled = fill_hidden(np.where(seen, values, 0).astype(np.float32), seen, guide, np.zeros_like(guide))
    assert np.abs(filled - values).max() < 0.03
    blind = fill_hidden(values, np.zeros_like(seen), guide, np.zeros_like(guide))
    assert np.array_equal(blind, guide)


def test_neighbours_weigh_by_distance_likeness_and_depth():
    """Each by a closed form: two spacings away, a twentieth of full scale lighter, a pixel of disparity apart."""
    shape, y, x = (21, 21), np.array([10]), np.array([10])
    flat, one = np.full(shape, 0.5, np.float32), np.zeros(shape, np.float32)
    one[10, 16] = 1
    seen = np.ones(shape, dtype=bool)
    steps = np.arange(-3, 4)
    everything = np.exp(-(steps[:, None] ** 2 + steps**2) / 8).sum()
    value, total = _fit_neighbours(one, seen, flat, flat, y, x, 3)
    assert total[0] == pytest.approx(everything) and value[0] == pytest.approx(np.exp(-0.5) / everything)
    for guide, disparity, less in (
        (flat + 0.05 * one, flat, np.exp(-0.5)),
        (flat, flat + one, np.exp(-1)),
        (flat, flat - one, np.exp(-1)),
    ):
        _, total = _fit_neighbours(one, seen, guide, disparity, y, x, 3)
        assert total[0] == pytest.approx(everything - np.exp(-0.5) * (1 - less), rel=1e-5)
    _, total = _fit_neighbours(one, one == 0, flat, flat, y, x, 3)
    assert total[0] == pytest.approx(everything - np.exp(-0.5), rel=1e-5)
    # in the corner a quarter is there
    _, total = _fit_neighbours(one, seen, flat, flat, y - 10, x - 10, 3)
    assert total[0] == pytest.approx(np.exp(-(np.arange(4)[:, None] ** 2 + np.arange(4) ** 2) / 8).sum())


def test_luminance_lends_its_lower_noise():
    colours = [texture(200, 160, seed=0)] * 3
    planes, _, rig = plane_views(160, 120, 4.0, (0.0, 0.0), colours=colours)
    rng = np.random.default_rng(10)
    noisy = [
        np.clip(plane + rng.normal(0, 8 if i < 3 else 1, plane.shape), 0, 255).astype(np.uint8)
        for i, plane in enumerate(planes)
    ]
    canvas = rectify(rig, projectors(rig))
    inner = (slice(16, -16), slice(16, -16))
    wanted = np.repeat(planes[0][..., None], 3, axis=-1)[inner]
    with_it, without = (
        psnr_db(
            fuse_apertures(
                noisy, rig, canvas, ApertureOptions(threads=1, disparity_px=(0.0, 8.0), use_luminance=use)
            ).image[inner],
            wanted,
        )
        for use in (True, False)
    )
    assert with_it > without + 4


def test_the_luminance_cost_knows_what_the_colours_add_up_to():
    base = texture(240, 200, seed=0)
    colours = [base, 0.6 * base + 0.4 * texture(240, 200, seed=1), 0.7 * base + 0.3 * texture(240, 200, seed=2)]
    planes, truth, rig = plane_views(160, 120, 5.0, (0.02, 0.01), colours=colours)
    canvas = rectify(rig, projectors(rig))
    roles = [aperture.role for aperture in rig.apertures]
    assert adds_up(roles) and not adds_up(roles[:3])
    found = light_cost(np.stack(planes), canvas, truth.astype(np.float32), roles, 24)
    assert found is not None
    assert np.allclose(found.blend[:3] / 256, 1 / 3, atol=0.02)
    assert found.blend[3] == -256
    assert found.table[0] == 0 and found.table[-1] == 24
    with_it, without = (
        estimate_disparity(
            planes,
            canvas,
            ApertureOptions(threads=1, disparity_px=(0.0, 10.0), luminance_cost=use),
            roles=roles,
        )
        for use in (True, False)
    )
    inner = (slice(16, -16), slice(16, -16))
    errors = [np.abs(d.disparity_px - truth)[inner].mean() for d in (with_it, without)]
    assert errors[0] < errors[1]


def test_noise_is_measured_and_clean_pictures_are_left_alone():
    rng = np.random.default_rng(11)
    clean = np.tile(np.linspace(40, 200, 256), (200, 1))
    for sigma in (2.0, 6.0):
        noisy = np.clip(clean + rng.normal(0, sigma, clean.shape), 0, 255).astype(np.uint8)
        assert measure_noise(noisy) == pytest.approx(sigma, rel=0.15)
    even, rich = np.full((60, 80), 90, dtype=np.uint8), texture(80, 60, seed=0).astype(np.uint8)
    assert smoothing(even, 0.3) == (0.0, 0)
    assert smoothing(even, 5.0)[0] > 1
    assert smoothing(rich, 5.0) == (0.0, 5)
    assert measure_noise(np.zeros((4, 4), dtype=np.uint8)) == 0


def test_smoothing_leaves_differences_that_noise_hardly_makes(subtests):
    for noise in (4.0, 9.0):
        with subtests.test(noise=noise):
            rng = np.random.default_rng(12)
            white = noise * rng.standard_normal((300, 400)).astype(np.float32)
            width_px, tells = smoothing(np.clip(np.rint(128 + white), 0, 255).astype(np.uint8), noise)
            assert width_px == pytest.approx(smoothing(np.full((300, 400), 128, np.uint8), 4 * noise)[0] / 2)
            smoothed = cv2.GaussianBlur(white, (0, 0), width_px)
            # a difference of two pixels, one and a half of its standard deviations
            assert tells == pytest.approx(1.5 * np.sqrt(2) * smoothed.std(), abs=0.6)


def test_nothing_is_smoothed_where_texture_stands_out_of_the_noise(subtests):
    """By half again as much as the noise."""
    for times, smooths in ((1.3, True), (1.75, False)):
        with subtests.test(times=times, smooths=smooths):
            rng, noise = np.random.default_rng(13), 8.0
            codes = np.clip(np.rint(128 + noise * np.hypot(1, times) * rng.standard_normal((200, 300))), 0, 255)
            assert (smoothing(codes.astype(np.uint8), noise)[0] > 0) == smooths


def test_refocusing_leaves_what_is_in_focus_and_blurs_the_rest():
    picture = np.repeat(texture(120, 90, seed=3)[:90, :120, None], 3, axis=-1).astype(np.uint8)
    disparity = np.full((90, 120), 2.0, dtype=np.float32)
    disparity[:, 60:] = 14.0
    result = refocus(picture, disparity, 2.0).astype(float)
    assert np.abs(result[:, :40] - picture[:, :40]).max() <= 1
    assert np.diff(result[:, 80:], axis=1).std() < 0.3 * np.diff(picture[:, 80:].astype(float), axis=1).std()
    both = refocus(picture, np.full_like(disparity, 2.0), 2.0)
    assert np.abs(both.astype(int) - picture).max() <= 1


def test_a_point_out_of_focus_is_a_disc_as_wide_as_its_disparity_and_no_wider_than_the_limit():
    picture = np.zeros((201, 201, 3), dtype=np.uint8)
    picture[100, 100] = 255
    for disparity, wide in ((10.0, 10), (30.0, 30), (90.0, 60)):
        lit = refocus(picture, np.full((201, 201), disparity, dtype=np.float32), 0.0)[..., 0] > 0
        across = np.flatnonzero(lit.any(axis=0))
        if lit.any():  # a bright point spread over 60 px is darker than a grey level
            assert across[-1] - across[0] + 1 == pytest.approx(wide, abs=2), disparity
        flat = refocus(
            np.where(np.arange(201)[None, :, None] < 100, 0, picture | 255).astype(np.uint8),
            np.full((201, 201), disparity, dtype=np.float32),
            0.0,
        )[100, :, 0].astype(float)
        edge = np.flatnonzero((flat > 2) & (flat < 253))
        assert edge[-1] - edge[0] + 1 == pytest.approx(wide, abs=6), disparity


def test_planes_of_colour_pictures():
    picture = np.zeros((2, 2, 3), dtype=np.uint16)
    picture[..., 0], picture[..., 1], picture[..., 2] = 1000, 2000, 3000
    assert plane_of(picture, "green").max() == 2000
    assert plane_of(picture, "luminance").max() == (299 + 1174 + 342)
    assert plane_of(picture[..., 2], "red").max() == 3000


# --- a light field with known disparity -----------------------------------------------------------------------------


def test_a_light_field_is_fused_as_its_true_disparity_allows(shared_data):
    import cv2

    folder = shared_data / "multi_aperture" / "antinous"
    if not folder.is_dir():
        pytest.skip("the antinous light field is not beside this checkout")
    step = 2
    places = ((0, 0), (0, step), (step, 0), (step, step))
    pictures = [cv2.imread(str(folder / f"input_Cam{9 * (4 + r) + 4 + c:03d}.png"))[..., ::-1] for r, c in places]
    rig = four_apertures(512, 512, roles=("red", "green", "blue", "luminance"))
    planes = [plane_of(picture, a.role) for picture, a in zip(pictures, rig.apertures, strict=True)]
    truth = step * read_pfm(folder / "gt_disp_lowres.pfm")
    fused = fuse_apertures(planes, rig, rectify(rig, projectors(rig)), ApertureOptions(threads=1))
    direct = np.stack(planes[:3], axis=-1)
    assert psnr_db(fused.image, pictures[0]) > psnr_db(direct, pictures[0]) + 14
    assert (np.abs(fused.disparity_px - truth) > 1).mean() < 0.02


def test_projectors_are_pycolmap_s():
    assert isinstance(projectors(four_apertures(8, 8))[0], pycolmap.Camera)
