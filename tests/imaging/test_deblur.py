"""Deconvolution along lines, and where its result counts: blending against numpy, and independent truths."""

import itertools
import threading

import cv2
import numpy as np
import pytest

from colmap_inertial.imaging._cells import Cells
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.path_filters import (
    SATURATED,
    DeblurOptions,
    blend_where_blurred,
    deblur,
    fill_clipped,
    half_quadratic,
    path_wiener,
)
from colmap_inertial.imaging.transfer import linear_from_srgb, srgb_from_linear
from colmap_inertial.tools.simulate.textures import poster
from tests.references.blending import blend_reference, lost_light_reference, share_reference

HEIGHT, WIDTH = 240, 336


def texture(seed: int = 3, height: int = HEIGHT, width: int = WIDTH, brightest: float = 0.95) -> np.ndarray:
    """(H, W, 3) a poster in linear light."""
    light = poster(np.random.default_rng(seed), height, width).astype(np.float64)
    return light * brightest / light.max()


def coded(light: np.ndarray, dtype: type = np.uint8) -> np.ndarray:
    """What a camera writes."""
    return np.round(np.iinfo(dtype).max * srgb_from_linear(light)).astype(dtype)


def turning(height: int, width: int, vector_px: tuple[float, float], rate: float) -> BlurField:
    """A field that turns and stretches by ``rate`` px per px."""
    y, x = np.meshgrid(*(np.arange(n) * 16.0 for n in BlurField.nodes(width, height)), indexing="ij")
    y, x = rate * (y - height / 2), rate * (x - width / 2)
    return BlurField(width=width, height=height, vector_px=np.stack([vector_px[0] + x - y, vector_px[1] + x + y], -1))


def smeared(light: np.ndarray, vector_px: tuple[float, float]) -> np.ndarray:
    """Linear light averaged along a line, in steps of a third of a pixel."""
    height, width = light.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    steps = int(3 * np.hypot(*vector_px)) + 3
    vector_px = np.float32(vector_px[0]), np.float32(vector_px[1])
    offsets = ((np.arange(steps) + 0.5) / steps - 0.5).astype(np.float32)
    source = light.astype(np.float32)
    views = (
        cv2.remap(
            source, x + s * vector_px[0], y + s * vector_px[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101
        )
        for s in offsets
    )
    return np.clip(sum(views) / steps, 0, 1)


def psnr(image: np.ndarray, truth: np.ndarray, peak: float = 255.0) -> float:
    return float(10 * np.log10(peak**2 / np.mean((image.astype(np.float64) - truth) ** 2)))


# Blending ------------------------------------------------------------------------------------------------------------


def test_blending_gives_the_reference_s_codes(subtests):
    light = 1.05 * texture(height=130, width=170, brightest=1)  # some of it saturated
    light[40:43, 60:66, 1] = light[90:92, 100:102] = 1  # and some by lamps
    field = turning(130, 170, (9, 6), 0.08)  # both axes, and down to no blur
    cells = Cells.of(BlurPath.straight(field).field())
    assert 0.1 < cells.along_y.mean() < 0.9
    filtered = np.random.default_rng(8).uniform(-0.1, 1.1, light.shape).astype(np.float32)
    for colour, dtype in itertools.product((False, True), (np.uint8, np.uint16)):
        with subtests.test(colour=colour, dtype=dtype):
            channels = slice(None) if colour else slice(1, 2)
            image, made = coded(light[..., channels], dtype), np.ascontiguousarray(filtered[..., channels])
            image = np.ascontiguousarray(image)
            result = blend_where_blurred(image, made, cells, 2)
            difference = np.abs(result.astype(int) - blend_reference(image, made.astype(np.float64), cells))
            assert 0.02 < (result == image).all(axis=2).mean() < 0.9
            # an 8-bit level is 257 of the 16-bit ones
            assert (difference <= 1).mean() > (0.999 if dtype is np.uint8 else 0.95)
            assert difference.max() <= (1 if dtype is np.uint8 else 8)


def test_what_is_filled_is_what_blending_keeps(subtests):
    light = 0.3 * texture(height=130, width=170)
    light[60:63, 80:84, 1] = light[90:92, 30:32] = 1
    cells = Cells.of(BlurPath.straight(turning(130, 170, (9, 6), 0.01)).field())
    for colour, dtype in itertools.product((False, True), (np.uint8, np.uint16)):
        with subtests.test(colour=colour, dtype=dtype):
            channels = slice(None) if colour else slice(1, 2)
            image = np.ascontiguousarray(coded(light[..., channels], dtype))
            filled = fill_clipped(image, cells, 2)
            # A filter that gives black everywhere shows where blending keeps the image.
            kept = (blend_where_blurred(image, np.zeros(image.shape, np.float32), cells, 1) == image).all(axis=2)
            assert 0.01 < kept.mean() < 0.2
            np.testing.assert_array_equal((filled != image).any(axis=2) & ~kept, np.zeros(kept.shape, bool))
            lamps = image[..., 0 if not colour else 1] >= SATURATED * np.iinfo(dtype).max
            assert lamps[60:92].any() and (filled != image).any(axis=2)[lamps & kept].all() and kept[lamps].all()
            # Nothing is brighter than what is around.
            assert filled.max() <= image[~kept].max()


def test_an_image_without_lamps_is_filled_nowhere():
    image = np.ascontiguousarray(coded(0.02 + 0.98 * np.round(texture()[..., 1:2])))  # black and white
    image = coded(smeared(np.repeat(image / 255, 3, axis=2), (20.0, 5.0)))
    cells = Cells.of(BlurField.uniform(WIDTH, HEIGHT, (20.0, 5.0)))
    assert (image >= 250).any() and fill_clipped(image, cells, 1) is image


# The whole -----------------------------------------------------------------------------------------------------------


def test_the_number_of_threads_does_not_change_the_result():
    image = coded(texture())
    field = turning(HEIGHT, WIDTH, (10, 8), 0.02)
    one = deblur(image, field, DeblurOptions(threads=1))
    for threads in (2, 3, 64):
        np.testing.assert_array_equal(deblur(image, field, DeblurOptions(threads=threads)), one)


def test_python_goes_on_while_an_image_is_deblurred():
    image = np.tile(coded(texture())[..., 1], (5, 6))
    field = BlurField.uniform(image.shape[1], image.shape[0], (30.0, 10.0))
    expected = deblur(image, field, DeblurOptions(threads=1))
    results: dict[int, np.ndarray] = {}
    begun = threading.Barrier(3)

    def work(key: int) -> None:
        begun.wait()
        for _ in range(5):
            results[key] = deblur(image, field, DeblurOptions(threads=1))

    workers = [threading.Thread(target=work, args=(key,)) for key in range(2)]
    for worker in workers:
        worker.start()
    begun.wait()
    turns = 0
    while any(worker.is_alive() for worker in workers):
        turns += 1
    # Had the filter kept the interpreter, this loop would have had about a turn of 5 ms between two calls.
    assert turns > 1000
    for result in results.values():
        np.testing.assert_array_equal(result, expected)


def test_images_of_any_size(subtests):
    for shape in ((1, 1), (1, 37), (37, 1), (7, 5), (16, 16), (17, 33), (2, 2, 3), (40, 3, 1)):
        for vector_px in ((12.0, 3.0), (2.0, -9.0), (0.7, 0.2)):
            with subtests.test(shape=shape, vector_px=vector_px):
                image = np.random.default_rng(1).integers(0, 240, shape, dtype=np.uint8)
                before = image.copy()
                field = BlurField.uniform(shape[1], shape[0], vector_px)
                result = deblur(image, field)
                assert result.shape == image.shape
                assert result.dtype == image.dtype
                np.testing.assert_array_equal(image, before)


def test_no_blur_leaves_every_bit(subtests):
    for dtype in (np.uint8, np.uint16):
        for vector_px in ((0.0, 0.0), (0.3, -0.3)):
            with subtests.test(dtype=dtype, vector_px=vector_px):
                image = np.random.default_rng(2).integers(
                    0, np.iinfo(dtype).max, (50, 70, 3), dtype=dtype, endpoint=True
                )
                np.testing.assert_array_equal(deblur(image, BlurField.uniform(70, 50, vector_px)), image)


def test_a_flat_image_stays_flat(subtests):
    for dtype in (np.uint8, np.uint16):
        with subtests.test(dtype=dtype):
            top = np.iinfo(dtype).max
            for value in (0, top // 100, top // 2, 24 * top // 25):
                image = np.full((40, 60), value, dtype=dtype)
                result = deblur(image, BlurField.uniform(60, 40, (11.0, 5.0)))
                assert np.abs(result.astype(int) - int(value)).max() <= (0 if dtype is np.uint8 else 1)


def test_short_blurs_fade_in_without_a_step():
    image = coded(texture())
    y, x = np.meshgrid(*(np.arange(n) * 16.0 for n in BlurField.nodes(WIDTH, HEIGHT)), indexing="ij")
    field = BlurField(width=WIDTH, height=HEIGHT, vector_px=np.stack([3 * x / WIDTH, 0 * y], -1))
    untouched = int(0.5 / 3 * WIDTH) - 16
    result = deblur(image, field)
    np.testing.assert_array_equal(result[:, :untouched], image[:, :untouched])
    assert (result[:, -16:] != image[:, -16:]).mean() > 0.2
    share = share_reference(np.zeros(image.shape[:2], dtype=bool), Cells.of(field))
    assert share.min() == 0
    assert share.max() == 1
    assert np.abs(np.diff(share, axis=1)).max() < 0.05


def test_a_view_that_is_not_contiguous_is_read_as_it_looks():
    image = coded(texture())
    view = image[::2, ::-2]
    field = BlurField.uniform(view.shape[1], view.shape[0], (9.0, 2.0))
    np.testing.assert_array_equal(deblur(view, field), deblur(view.copy(), field))


def test_blurs_far_longer_than_the_image_work():
    image = coded(texture(height=20, width=30))
    assert deblur(image, BlurField.uniform(30, 20, (150.0, 149.0))).shape == image.shape


def test_a_blurred_and_noisy_picture_comes_closer_to_the_sharp_one(subtests):
    for length_px in (6, 10, 20, 30):
        for angle_deg in (0, 25, 80):
            with subtests.test(length_px=length_px, angle_deg=angle_deg):
                angle = np.deg2rad(angle_deg)
                vector_px = (length_px * np.cos(angle), length_px * np.sin(angle))
                light = texture(brightest=0.8)
                rng = np.random.default_rng(5)
                blurred = smeared(light, vector_px)
                noisy = coded(
                    linear_from_srgb(np.clip(srgb_from_linear(blurred) + 0.01 * rng.standard_normal(light.shape), 0, 1))
                )
                truth = coded(light)
                result = deblur(noisy, BlurField.uniform(WIDTH, HEIGHT, vector_px))
                assert psnr(result, truth) > psnr(noisy, truth) + 0.2


def test_clipped_lights_do_not_ring(subtests):
    light = 0.1 + 0.1 * texture()
    lamp = light.copy()
    lamp[HEIGHT // 2, WIDTH // 2] = 400  # far beyond what the sensor holds
    image, lampless = (coded(np.clip(smeared_by_pixels(scene, 24), 0, 1)) for scene in (lamp, light))
    path = BlurPath.straight(BlurField.uniform(WIDTH, HEIGHT, (24.0, 0.0)))
    x = np.abs(np.arange(WIDTH) - WIDTH // 2)
    for restore, channels in itertools.product((path_wiener, half_quadratic), (slice(1, 2), slice(None))):
        with subtests.test(restore=restore, channels=channels):
            seen, without = (np.ascontiguousarray(codes[..., channels]) for codes in (image, lampless))
            result, undisturbed = (restore(codes, path).astype(int) for codes in (seen, without))
            # Beyond three blur lengths little is left of a lamp 2,000 times as bright as all else.
            assert np.abs(result - undisturbed)[:, x > 72].max() <= 20
            assert np.sqrt(np.mean((result - undisturbed)[:, x > 72] ** 2)) < 1
            # On the lamp's trace the input stays.
            saturated = (seen >= 250).all(axis=2)
            assert saturated.sum() == 24
            np.testing.assert_array_equal(result[saturated], seen[saturated])


def smeared_by_pixels(light: np.ndarray, length_px: int) -> np.ndarray:
    """Linear light (H, W, C) averaged over whole pixels along the rows; nothing is clipped."""
    around = ((0, 0), (length_px // 2, length_px - length_px // 2 - 1), (0, 0))
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(light, around, mode="reflect"), length_px, axis=1)
    return np.asarray(windows.mean(axis=-1))


def test_white_that_the_sensor_just_holds_is_deblurred():
    light = 0.02 + 0.98 * np.round(texture()[..., 1])  # black and white, no lamps
    image = coded(smeared(light, (20.0, 5.0)))
    assert (image >= 250).mean() > 0.02
    field = BlurField.uniform(WIDTH, HEIGHT, (20.0, 5.0))
    cells = Cells.of(field)
    lost = lost_light_reference(linear_from_srgb(image / 255), image >= 250, cells)
    assert not lost.any()
    assert psnr(deblur(image, field), coded(light)) > psnr(image, coded(light)) + 0.2


def test_wrong_images_and_options_are_refused():
    field = BlurField.uniform(30, 20, (5.0, 0.0))
    with pytest.raises(ValueError, match="float64"):
        deblur(np.zeros((20, 30)), field)
    with pytest.raises(ValueError, match=r"\(0, 30\)"):
        deblur(np.zeros((0, 30), dtype=np.uint8), field)
    with pytest.raises(ValueError, match="for 30 x 20 px, the image has 20 x 30"):
        deblur(np.zeros((30, 20), dtype=np.uint8), field)
    with pytest.raises(ValueError, match="900 px long"):
        deblur(np.zeros((20, 30), dtype=np.uint8), BlurField.uniform(30, 20, (5.0, -900.0)))
    with pytest.raises(ValueError, match="noise"):
        DeblurOptions(noise=1.0)
    with pytest.raises(ValueError, match="threads"):
        DeblurOptions(threads=0)


@pytest.mark.parametrize("length_px", [10, 20])
def test_photographs_come_closer_to_the_sharp_ones(shared_data, length_px):
    before, after = [], []
    for path in sorted((shared_data / "sharp_photos").glob("clic_*.jpg"))[::8]:
        sharp = cv2.imread(str(path))[:300, :300]
        vector_px = (length_px * 0.94, length_px * 0.34)
        rng = np.random.default_rng(9)
        blurred = srgb_from_linear(smeared(linear_from_srgb(sharp / 255), vector_px))
        noisy = coded(linear_from_srgb(np.clip(blurred + 0.01 * rng.standard_normal(sharp.shape), 0, 1)))
        result = deblur(noisy, BlurField.uniform(sharp.shape[1], sharp.shape[0], vector_px))
        before.append(psnr(noisy, sharp))
        after.append(psnr(result, sharp))
    assert np.mean(after) > np.mean(before) + 0.2
