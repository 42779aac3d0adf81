"""Short and long exposures brought together, against pairs whose gain, geometry and blur are known."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.exposure_pairs import (
    PairGyro,
    _registration as registration,
    blur_seen_from_short,
    brightened,
    bring_together,
    darken_fused,
    fuse_mertens,
    gyro_shift,
    match_brightness,
    replace_departures,
)
from colmap_inertial.imaging.exposure_pairs.pair import _weigh_median_gain
from colmap_inertial.imaging.psf import blur_field
from colmap_inertial.imaging.transfer import linear_from_srgb, srgb_from_linear
from colmap_inertial.model import colmap_camera
from tests.helpers.exposure_scenes import COLOURS, GAIN, STEP_PX, codes, make_scene, psnr_db

SEEDS = (0, 5, 8)


@cache
def made(seed):
    """A scene, whose wall takes a second to draw."""
    return make_scene(seed)


@pytest.fixture(scope="module", params=SEEDS)
def scene(request):
    return made(request.param)


@pytest.fixture(scope="module")
def pair(scene):
    return scene.short_codes(), scene.long_codes()


@pytest.fixture(scope="module")
def together(scene, pair):
    """With a good gyroscope."""
    return bring_together(*pair, gyro=gyro_of(scene))


@pytest.fixture(scope="module")
def stranger(scene):
    """A pair of another place, and its long exposure."""
    other = made(SEEDS[SEEDS.index(scene.seed) - 2])
    return other, other.long_codes()


def nodes_of(scene):
    rows, columns = BlurField.nodes(scene.camera.width, scene.camera.height)
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    return STEP_PX * grid.reshape(-1, 2) + 0.5


def gyro_of(scene, *, offset_s=0.0, camera=None):
    camera = camera or colmap_camera(scene.camera)
    return PairGyro(motion=scene.gyro(offset_s=offset_s), camera=camera, short=scene.short, long=scene.long)


def errors_px(scene, found):
    """Distances of a shift from the truth, where the long exposure has the point."""
    nodes = nodes_of(scene)
    true = scene.true_shift(nodes)
    seen = ((nodes + true > 0) & (nodes + true < [scene.camera.width, scene.camera.height])).all(axis=1)
    return np.linalg.norm(found.reshape(-1, 2) - true, axis=1)[seen]


def test_the_gain_is_found_from_noisy_and_blurred_pictures(pair):
    found = match_brightness(*pair)
    # before they are aligned
    assert found.gain == pytest.approx(GAIN, rel=0.05) and found.stated is None
    assert found.colours == pytest.approx(COLOURS, rel=0.04)


def test_what_is_stated_counts_while_the_pixels_bear_it_out(pair):
    stated = match_brightness(*pair, stated=1.1 * GAIN)
    assert stated.gain == 1.1 * GAIN and not stated.contradicts
    wrong = match_brightness(*pair, stated=2 * GAIN)
    assert wrong.gain == wrong.measured and wrong.contradicts and wrong.stated == 2 * GAIN


def test_lamps_and_darkness_do_not_sway_the_gain():
    rng = np.random.default_rng(1)
    light = cv2.resize(
        rng.uniform(0.02, 0.5, (12, 16, 3)).astype(np.float32), (480, 320), interpolation=cv2.INTER_CUBIC
    )
    light[:, :200] = 0.0
    light[40:120, 300:400] = 30.0
    noise = 0.001 * rng.standard_normal(light.shape)
    found = match_brightness(codes(light / 15 + noise), codes(light))
    assert found.gain == pytest.approx(15, rel=0.02)
    assert found.colours == pytest.approx((1, 1, 1), rel=0.02)


def test_squares_that_are_shifted_against_each_other_sway_no_gain():
    """A shift makes as many squares too bright as too dark; whichever image counts more would prefer its own."""
    light = np.exp(0.8 * np.random.default_rng(3).standard_normal(20_000))
    shifted = np.roll(light, 1)
    assert _weigh_median_gain(light, 8 * shifted) == pytest.approx(8, rel=0.05)
    assert _weigh_median_gain(8 * shifted, light) == pytest.approx(1 / 8, rel=0.05)
    # bright squares count more than dark ones
    dark = np.array([0.01] * 600 + [1.0] * 300)
    assert _weigh_median_gain(dark, dark * np.where(dark < 0.1, 3.0, 5.0)) == pytest.approx(5)


def test_colours_differ_within_limits_only():
    rng = np.random.default_rng(2)
    light = cv2.resize(
        rng.uniform(0.05, 0.5, (12, 16, 3)).astype(np.float32), (480, 320), interpolation=cv2.INTER_CUBIC
    )
    found = match_brightness(codes(light / [10, 10, 60]), codes(light))
    assert found.gain == pytest.approx(10, rel=0.02)
    assert found.colours == pytest.approx((1, 1, 2), rel=0.02)


def test_a_gain_that_nothing_tells_is_refused():
    black, white = np.zeros((64, 96, 3), np.uint8), np.full((64, 96, 3), 255, np.uint8)
    with pytest.raises(NotObservableError, match="give the exposure times"):
        match_brightness(black, white)
    assert match_brightness(black, white, stated=7.0).gain == 7.0
    with pytest.raises(ValueError, match="shape"):
        match_brightness(black, white[:32])


def test_brightening_multiplies_linear_light(subtests):
    for dtype in (np.uint8, np.uint16):
        with subtests.test(dtype=dtype):
            short = np.random.default_rng(3).integers(0, np.iinfo(dtype).max, (20, 30, 3)).astype(dtype)
            brightness = replace(match_brightness(short, short, stated=3.0), gain=3.0, colours=(1.0, 0.5, 1.2))
            found = brightened(short, brightness)
            light = linear_from_srgb(short / np.iinfo(dtype).max) * 3.0 * np.array([1.0, 0.5, 1.2])
            assert found.dtype == np.float32
            assert np.allclose(linear_from_srgb(found.astype(float)), np.minimum(light, 1), atol=1e-5)


def test_the_gyroscope_tells_where_the_long_exposure_shows_what_the_short_one_does(scene):
    gyro = gyro_of(scene)
    found = gyro_shift(gyro.motion, gyro.camera, gyro.short, gyro.long)
    true = scene.true_shift(nodes_of(scene))
    assert np.median(np.linalg.norm(true, axis=1)) > 8
    assert np.linalg.norm(found.reshape(-1, 2) - true, axis=1).max() < 0.1


def test_a_global_shutter_shifts_by_one_rotation():
    scene = made(5)
    at_once = {name: replace(getattr(scene, name), readout_s=0.0) for name in ("short", "long")}
    scene = replace(scene, **at_once)
    gyro = gyro_of(scene)
    found = gyro_shift(gyro.motion, gyro.camera, gyro.short, gyro.long)
    assert errors_px(scene, found).max() < 0.1


def test_the_long_exposure_s_blur_is_known_in_the_short_one_s_geometry(scene):
    gyro = gyro_of(scene)
    shift = gyro_shift(gyro.motion, gyro.camera, gyro.short, gyro.long)
    own = blur_field(gyro.motion, gyro.camera, gyro.long)
    nodes, true = nodes_of(scene), scene.true_blur(nodes_of(scene))
    inside = ((nodes + shift.reshape(-1, 2)) > 0).all(axis=1)
    inside &= (nodes + shift.reshape(-1, 2) < [scene.camera.width, scene.camera.height]).all(axis=1)

    def off(field):
        found = field.vector_px.reshape(-1, 2)
        return np.minimum(*(np.linalg.norm(found - sign * true, axis=1) for sign in (1, -1)))[inside]

    assert np.median(np.linalg.norm(true, axis=1)) > 10
    assert np.median(off(blur_seen_from_short(own, shift))) < 0.05
    assert off(blur_seen_from_short(own, shift)).max() < 0.5
    assert np.median(off(own)) > 3 * np.median(off(blur_seen_from_short(own, shift)))


def test_a_blur_turns_with_the_picture():
    own = BlurField.uniform(320, 240, (10.0, 0.0))
    rows, columns = own.vector_px.shape[:2]
    nodes = 16.0 * np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    angle = 0.2
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    seen = blur_seen_from_short(own, nodes @ (1.1 * turn).T - nodes)
    assert np.allclose(seen.vector_px, [10 * np.cos(angle) / 1.1, -10 * np.sin(angle) / 1.1], atol=1e-4)


def test_pairs_come_together_by_a_good_gyroscope_alone(scene, together):
    registered = together.registered
    assert registered.by_gyro and registered.alike and not together.gyro_note
    assert np.median(errors_px(scene, registered.shift_px)) < 0.1
    assert registered.agreement > registered.untouched + 0.3
    assert together.blur is not None
    assert np.percentile(together.blur.extent_px(), 90) == pytest.approx(
        np.percentile(np.linalg.norm(scene.true_blur(nodes_of(scene)), axis=1), 90), rel=0.03
    )
    assert together.brightness.gain == pytest.approx(GAIN, rel=0.01)
    assert together.brightness.colours == pytest.approx(COLOURS, rel=0.01)


def test_pixels_mend_what_the_gyroscope_s_clock_does_wrong(scene, pair):
    late = gyro_of(scene, offset_s=0.01)
    before = errors_px(scene, gyro_shift(late.motion, late.camera, late.short, late.long))
    together = bring_together(*pair, gyro=late)
    assert together.registered.by_gyro and together.registered.by_pixels and together.blur is not None
    assert np.median(errors_px(scene, together.registered.shift_px)) < min(0.6, 0.5 * np.median(before))


def test_pixels_alone_bring_pairs_together(scene, pair):
    together = bring_together(*pair)
    assert together.registered.by_pixels and not together.registered.by_gyro and together.blur is None
    # half the blur's unevenness through time: its centre is not mid-exposure
    assert np.median(errors_px(scene, together.registered.shift_px)) < 1.0
    assert together.gyro_note.code == "no-gyroscope"


def test_a_gyroscope_of_another_recording_is_left_out(scene, pair, stranger):
    other = gyro_of(stranger[0])
    wrong = PairGyro(motion=other.motion, camera=other.camera, short=scene.short, long=scene.long)
    together = bring_together(*pair, gyro=wrong)
    assert not together.registered.by_gyro and together.blur is None
    assert together.gyro_note.code == "pair-rotation-not-confirmed"
    assert np.median(errors_px(scene, together.registered.shift_px)) < 1.0


def test_an_unrecorded_exposure_leaves_the_pixels(scene, pair):
    gone = replace(gyro_of(scene), long=replace(scene.long, t_s=scene.motion_s + 5))
    together = bring_together(*pair, gyro=gone)
    assert together.gyro_note.code == "pair-not-covered" and together.registered.by_pixels and together.blur is None


def test_the_aligned_long_exposure_agrees_with_its_true_picture(scene, pair, together):
    sharp = scene.sharp()
    inner = (slice(20, -20), slice(20, -20))
    good = together.covered[inner] & ~together.clipped[inner]
    blurred = cv2.GaussianBlur(sharp, (0, 0), 4)[inner][good]
    aligned, as_it_is = (255 * together.long)[inner][good], pair[1][inner][good]
    assert psnr_db(aligned, blurred) > psnr_db(as_it_is, blurred) + 2
    assert together.short.shape == together.long.shape == sharp.shape
    assert together.short.dtype == together.long.dtype == np.float32
    # what the long exposure does not cover is the short one's
    assert np.array_equal(together.long[~together.covered], together.short[~together.covered])
    assert 0.005 < (~together.covered).mean() < 0.3
    # lamps
    assert 0 < together.clipped.mean() < 0.1
    assert np.median(together.long[together.clipped].max(axis=1)) > 0.98


def test_grey_pictures_of_16_bit_come_together_too():
    scene = made(5)
    short, long = (picture[..., 1] for picture in (scene.short_codes(dtype=np.uint16), scene.long_codes(np.uint16)))
    together = bring_together(short, long, gyro=gyro_of(scene))
    assert together.short.shape == together.long.shape == short.shape
    assert together.brightness.gain == pytest.approx(GAIN, rel=0.02) and len(together.brightness.colours) == 1
    assert np.median(errors_px(scene, together.registered.shift_px)) < 0.1


def test_pictures_that_agree_already_are_not_moved():
    scene = made(5)
    sharp = scene.sharp()
    short = codes(linear_from_srgb(sharp / 255) / 8 + 0.001 * np.random.default_rng(4).standard_normal(sharp.shape))
    together = bring_together(short, sharp)
    assert not together.registered.by_pixels and not together.registered.by_gyro
    assert not together.registered.shift_px.any() and together.covered.all()


def test_pictures_of_different_views_are_told(pair, stranger):
    together = bring_together(*(picture[:240, :320] for picture in (pair[0], stranger[1])))
    assert not together.registered.alike
    # a wall without any detail contradicts nothing
    rng = np.random.default_rng(5)
    flat = np.full((120, 160, 3), 0.3)
    assert bring_together(
        codes(flat / 10 + 0.002 * rng.standard_normal(flat.shape)),
        codes(flat + 0.001 * rng.standard_normal(flat.shape)),
    ).registered.alike


def test_exposure_fusion_is_opencv_s_and_brings_lamps_back():
    rng = np.random.default_rng(6)
    light = np.full((120, 160, 3), 0.2, np.float32) * rng.uniform(0.5, 1.0, (120, 160, 1)).astype(np.float32)
    light[30:60, 40:80] = 2.0 + 3.0 * rng.uniform(size=(30, 40, 1))
    short, long = codes(light / 8), codes(light)
    found = fuse_mertens([short.astype(np.float32) / 255, long.astype(np.float32) / 255])
    theirs = cv2.createMergeMertens(1.0, 1.0, 1.0).process([short, long])
    assert np.abs(found - np.clip(theirs, 0, 1)).max() < 1e-5
    assert long[30:60, 40:80].std() == 0 and found[34:56, 44:76].std() > 0.02
    assert fuse_mertens([found[..., 0], found[..., 1]]).shape == (120, 160)
    with pytest.raises(ValueError, match="two or more"):
        fuse_mertens([found])
    with pytest.raises(ValueError, match="one shape"):
        fuse_mertens([found, found[:50]])


def test_exposure_fusion_takes_lamps_of_the_short_exposure_and_none_of_its_noise(subtests):
    for channels in (1, 3):
        with subtests.test(channels=channels):
            gain, shape = 8.0, (120, 160, channels)
            truth = np.broadcast_to(np.linspace(0.1, 0.6, 160)[:, None], shape).copy()
            truth[40:70, 60:90] = 3.0  # a lamp, with something written on it
            truth[52:58, 70:80] = 1.5
            noise = 0.01 * np.random.default_rng(5).standard_normal(shape)
            long = srgb_from_linear(truth).astype(np.float32).squeeze()
            dark = srgb_from_linear(truth / gain + noise).astype(np.float32).squeeze()
            clipped = truth[..., 0] > 1
            found = darken_fused(long, dark, clipped, gain)
            np.testing.assert_allclose(found[clipped], dark[clipped], atol=0.002)
            wall = (slice(90, 120), slice(None))
            np.testing.assert_allclose(found[wall], srgb_from_linear(truth / gain).squeeze()[wall], atol=1e-5)
            blended = fuse_mertens([found, long])
            assert (blended >= 0.98).mean() < 0.5 * (long >= 0.98).mean()
            of_noisy, of_clean = (np.diff(fuse_mertens([one, long])[wall], axis=0).std() for one in (dark, found))
            assert of_clean < 0.05 * of_noisy


def test_a_fused_image_that_departs_from_the_short_one_gives_way_to_it():
    """A ghost on the left is replaced; the denoised right stays, also where the short exposure is off by an offset."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:96, :160].astype(np.float32)
    truth = np.repeat((0.5 + 0.2 * np.sin(x / 9) * np.cos(y / 7))[..., None], 3, axis=2)
    short = np.clip(truth + 0.03 * rng.standard_normal(truth.shape), 0, 1).astype(np.float32)
    short += 0.08
    fused = truth.astype(np.float32).copy()
    fused[:, :60] = np.roll(truth, 12, axis=1)[:, :60]
    found = replace_departures(fused, short)

    def error(image, part):
        return float(np.mean((image[:, part] - truth[:, part]) ** 2))

    ghost, clean = slice(14, 46), slice(80, None)
    assert error(fused, ghost) > 2 * error(short, ghost)
    assert error(found, ghost) < 1.3 * error(short, ghost)
    np.testing.assert_array_equal(found[:, clean], fused[:, clean])
    np.testing.assert_array_equal(replace_departures(fused[..., 0], short[..., 0])[:, clean], fused[:, clean, 0])


def test_without_noise_departures_are_measured_by_the_rounding_to_8_bits(subtests):
    """Whose variance is a twelfth of a code's square: up to twice that stays, from three times on is replaced."""
    for times, share in ((1.9, 0.0), (2.5, 0.5), (3.1, 1.0)):
        with subtests.test(times=times, share=share):
            short = np.full((60, 80, 3), 0.4, np.float32)
            pattern = (-1.0) ** np.add.outer(np.arange(60), np.arange(80))
            departed = short + (np.sqrt(times / 12) / 255 * pattern[..., None]).astype(np.float32)
            found = replace_departures(departed, short)
            inner = (slice(13, -13), slice(13, -13))
            assert np.abs(found - departed - share * (short - departed))[inner].max() < 2e-5


def registered_at(shift_px, *, by_gyro=False, agreement=0.5):
    return registration.Registered(
        shift_px=shift_px, by_gyro=by_gyro, by_pixels=False, agreement=agreement, untouched=0.0
    )


def test_a_mapping_moves_what_was_shifted_before(subtests):
    for by_gyro in (False, True):
        with subtests.test(by_gyro=by_gyro):
            step_px, rows, columns = 10, 13, 17
            x, y = step_px * np.arange(columns), step_px * np.arange(rows)[:, None]
            before = np.stack(np.broadcast_arrays(0.01 * x + 0.5, -0.02 * y), axis=-1)
            start = registered_at(before, by_gyro=by_gyro)
            turn, move = 0.01, np.array([3.0, -2.0])
            mapping = np.array([[1, -turn, move[0]], [turn, 1, move[1]], [0, 0, 1.0]])
            found = registration._apply_mapping(mapping, start, step_px)
            x, y = np.broadcast_arrays(x, y)
            to_x, to_y = x - turn * y + move[0], y + turn * x + move[1]
            # beyond the grid, what was shifted at its edge
            inside = (to_x >= 0) & (to_x <= 160) & (to_y >= 0) & (to_y <= 120)
            expected = np.stack([to_x - x + 0.01 * to_x + 0.5, to_y - y - 0.02 * to_y], axis=-1)
            assert np.abs(found - expected)[inside].max() < 1e-9 and inside.mean() > 0.7
            assert (
                registration._apply_mapping(np.array([[1, 0, 0], [0, 1, 0], [0.01, 0, -1.0]]), start, step_px) is None
            )


def test_a_mapping_that_leads_far_is_none_and_a_gyroscope_allows_less():
    limits, side = registration._LIMITS, 170
    free, held = (registered_at(np.zeros((13, 17, 2)), by_gyro=by_gyro) for by_gyro in (False, True))
    for start, share in ((free, limits.farthest), (held, limits.farthest_from_gyro)):
        for times, allowed in ((0.99, True), (1.01, False)):
            mapping = np.eye(3)
            mapping[1, 2] = -times * share * side
            assert (registration._apply_mapping(mapping, start, 10) is not None) == allowed


def test_a_more_general_mapping_must_be_worth_it(monkeypatch):
    start = registered_at(np.zeros((2, 2, 2)), agreement=0.5)
    worth = registration._LIMITS.worth
    for agreements, best in (
        ([0.5 + 0.9 * worth], 0),
        ([0.5 + 1.1 * worth], 1),
        ([0.5 + 1.1 * worth, 0.5 + 1.9 * worth], 1),
        ([0.5 + 1.1 * worth, None, 0.5 + 2.2 * worth], 3),
        ([0.4, 0.3], 0),
    ):
        monkeypatch.setattr(registration, "_generalise_mapping", lambda *_, said=agreements: iter(enumerate(said, 1)))
        monkeypatch.setattr(
            registration, "_apply_mapping", lambda mapping, *_: None if mapping[1] is None else np.array(mapping)
        )
        level = SimpleNamespace(step_px=10, agreement=lambda shift: float(shift[1]))
        found = registration._refine(start, None, [level])
        if best == 0:
            assert found is start
        else:
            assert found.shift_px[0] == best and found.agreement == agreements[best - 1] and found.by_pixels
