"""Deconvolution along the blur: the compiled filter, its numpy counterpart, and independent truths for both."""

import itertools
import threading

import cv2
import numpy as np
import pytest
from scipy.linalg import solve
from scipy.ndimage import gaussian_filter

from colmap_inertial._kernels import _wiener
from colmap_inertial.imaging import wiener
from colmap_inertial.imaging._cells import Cells
from colmap_inertial.imaging._taps import Prior, TapTable, gaussian_weights, optimal_taps, smoothing_px
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.transfer import linear_from_srgb, srgb_from_linear
from colmap_inertial.imaging.wiener import DeblurOptions, deblur, estimate_noise
from colmap_inertial.tools.simulate.textures import poster
from tests.references.wiener import (
    deblur_reference,
    filter_reference,
    lost_light_reference,
    share_reference,
    wiener_spectrum,
)

HEIGHT, WIDTH = 240, 336
INSTRUCTION_SETS = _wiener.instruction_sets()


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


def only(extent_px: float, prior: Prior, reach: float) -> TapTable:
    """A table for one length of blur."""
    taps = optimal_taps(extent_px, prior, reach).astype(np.float32)
    rows = np.array([len(taps) - 1] * 2, dtype=np.int32)
    return TapTable(first=int(extent_px * 4), weights=np.stack([taps, taps]), reach=rows)


# The filter itself ---------------------------------------------------------------------------------------------------


def test_a_long_filter_equals_the_wiener_filter_in_the_frequency_domain(subtests):
    for vector_px in ((12.0, 0.0), (0.0, 12.0), (11.0, 4.0), (-5.0, 9.0), (8.0, 8.0)):
        with subtests.test(vector_px=vector_px):
            prior = Prior(alpha=0.1, eps=0.01)
            light = gaussian_filter(texture()[128:176, :64, 1], 1.5, mode="wrap")
            extent = max(abs(vector_px[0]), abs(vector_px[1]))
            margin = int(8 * extent) + 2
            periodic = np.pad(light, margin, mode="wrap")
            field = BlurField.uniform(periodic.shape[1], periodic.shape[0], vector_px)
            spatial = filter_reference(periodic, Cells.of(field), only(extent, prior, 8))[
                margin:-margin, margin:-margin
            ]

            fy, fx = np.meshgrid(*map(np.fft.fftfreq, light.shape), indexing="ij")
            along = (fx * vector_px[0] + fy * vector_px[1]) / extent  # cycles per pixel of the major axis
            spectrum = wiener_spectrum(extent, along, prior) / wiener_spectrum(extent, np.zeros(1), prior)
            spectral = np.fft.ifft2(np.fft.fft2(light) * spectrum).real
            assert psnr(spatial, spectral, 1.0) >= 40


def test_the_taps_have_the_least_mean_square_error_of_their_length(subtests):
    for extent_px, sigma in ((3.3, 0.01), (20.0, 0.01), (41.25, 0.0)):
        with subtests.test(extent_px=extent_px, sigma=sigma):
            prior = Prior.for_noise(sigma)
            half = optimal_taps(extent_px, prior)
            reach = len(half) - 1
            assert reach == np.ceil(2 * extent_px) + 1
            assert half[0] + 2 * half[1:].sum() == pytest.approx(1)
            # Least squares in the frequency domain, written out: |W K - 1|^2 S + |W|^2, W a sum of cosines.
            f = (np.arange(8192) + 0.5) / 16384
            basis = np.concatenate(
                [np.ones((len(f), 1)), 2 * np.cos(2 * np.pi * np.outer(f, np.arange(1, reach + 1)))], axis=1
            )
            power = 1 / (prior.eps + prior.alpha * 4 * np.sin(np.pi * f) ** 2)
            transfer = np.sinc(extent_px * f)
            normal = basis.T @ (basis * (power * transfer**2 + 1)[:, None])
            best = solve(normal, basis.T @ (power * transfer), assume_a="pos")
            best /= best[0] + 2 * best[1:].sum()
            np.testing.assert_allclose(half, best, atol=2e-4 * np.abs(best).max())


@pytest.mark.parametrize("vector_px", [(14.0, 5.0), (-6.0, 13.0)])
def test_blur_and_filter_are_their_own_adjoints(vector_px):
    # <A x, y> = <x, A y> for pictures that vanish near the border
    rng = np.random.default_rng(0)
    inside = np.zeros((160, 160))
    inside[60:100, 60:100] = 1
    x, y = rng.random((2, 160, 160)) * inside
    field = BlurField.uniform(160, 160, vector_px)
    cells = Cells.of(field)
    table = only(max(np.abs(vector_px)), Prior.for_noise(0.01), 2)
    for operator in (lambda image: filter_reference(image, cells, table), lambda image: smeared(image, vector_px)):
        assert np.vdot(operator(x), y) == pytest.approx(np.vdot(x, operator(y)), rel=1e-4)


def test_cells_come_close_to_taps_for_every_pixel_and_leave_no_seams():
    light = texture()[..., 1]
    field = turning(HEIGHT, WIDTH, (18, 6), 0.008)
    prior = Prior.for_noise(0.01)
    cells, pixels = Cells.of(field), Cells.of(field, 1)
    table = TapTable.covering(float(pixels.extent_px.min()), float(pixels.extent_px.max()), prior)
    coarse, fine = filter_reference(light, cells, table), filter_reference(light, pixels, table, 1)
    assert psnr(coarse, fine, 1.0) > 40
    # What the seams add to the steps between neighbours is small against the steps that are there.
    step = np.diff(coarse, axis=1)[:, 15::16]
    assert np.std(np.diff(coarse - fine, axis=1)[:, 15::16]) < 0.2 * np.std(step)


def test_the_major_axis_may_change_within_an_image():
    light = gaussian_filter(texture()[..., 1], 1)
    field = turning(HEIGHT, WIDTH, (12, 12), 0.004)
    cells = Cells.of(field)
    assert 0.2 < cells.along_y.mean() < 0.8
    table = TapTable.covering(float(cells.extent_px.min()), float(cells.extent_px.max()), Prior.for_noise(0.01))
    # Where the axes meet, both give the same: swapping x and y swaps the result.
    swapped = BlurField(width=HEIGHT, height=WIDTH, vector_px=field.vector_px.transpose(1, 0, 2)[..., ::-1])
    result = filter_reference(light, cells, table)
    mirrored = filter_reference(light.T, Cells.of(swapped), table)
    np.testing.assert_allclose(result, mirrored.T, atol=1e-9)


# Compiled against numpy ----------------------------------------------------------------------------------------------


def test_every_instruction_set_gives_the_reference_s_light(subtests):
    light = texture(height=100, width=150)[..., 1].astype(np.float32)
    for vector_px, rate in (((17, 4), 0.0), ((3, -9), 0.01), ((9, 9), 0.02), ((0, 0), 0.05)):
        cells = Cells.of(turning(100, 150, vector_px, rate))
        table = wiener._table(cells, 0.01)
        share = share_reference(np.zeros(light.shape, dtype=bool), cells)
        expected = light + share * (filter_reference(light, cells, table) - light)
        for name in INSTRUCTION_SETS:
            with subtests.test(name=name, vector_px=vector_px, rate=rate):
                result, _ = wiener._compiled(light[..., None], cells, table, instruction_set=name)
                np.testing.assert_allclose(result[..., 0], expected, atol=2e-5)


def test_every_instruction_set_gives_the_reference_s_codes(subtests):
    light = 1.05 * texture(height=130, width=170, brightest=1)  # some of it saturated
    light[40:43, 60:66, 1] = light[90:92, 100:102] = 1  # and some by lamps
    field = turning(130, 170, (9, 6), 0.08)  # both axes, and down to no blur
    for colour, dtype in itertools.product((False, True), (np.uint8, np.uint16)):
        image = coded(light, dtype)
        image = image if colour else image[..., 1].copy()
        planes, cells, noise = wiener._prepare(image, field, DeblurOptions())
        expected = deblur_reference(image, field)
        assert (deblur(image, field) != image).any()
        for name in INSTRUCTION_SETS:
            with subtests.test(colour=colour, dtype=dtype, name=name):
                result, _ = wiener._compiled(planes, cells, wiener._table(cells, noise), instruction_set=name)
                difference = np.abs(result.reshape(image.shape).astype(int) - expected)
                # an 8-bit level is 257 of the 16-bit ones
                assert (difference <= 1).mean() > (0.999 if dtype is np.uint8 else 0.95)
                assert difference.max() <= (1 if dtype is np.uint8 else 8)


def test_an_unknown_instruction_set_is_refused():
    cells = Cells.of(BlurField.uniform(8, 8, (3, 0)))
    with pytest.raises(ValueError, match="instruction_set"):
        wiener._compiled(
            np.zeros((8, 8, 1), dtype=np.uint8),
            cells,
            wiener._table(cells, 0.0),
            instruction_set="abacus",
        )


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


# The whole -----------------------------------------------------------------------------------------------------------


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
                assert np.abs(result.astype(int) - deblur_reference(image, field)).max() <= 1


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
    for length_px, gain_db in ((6, 0.4), (10, 1.4), (20, 1.5), (30, 1.5)):
        for angle_deg in (0, 25, 80):
            with subtests.test(length_px=length_px, gain_db=gain_db, angle_deg=angle_deg):
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
                assert psnr(result, truth) > psnr(noisy, truth) + gain_db


def test_clipped_lights_do_not_ring():
    light = 0.1 + 0.1 * texture()[..., 1]
    light[HEIGHT // 2, WIDTH // 2] = 400  # a lamp, far beyond what the sensor holds
    image = coded(np.clip(smeared_lamp(light, 24), 0, 1))
    field = BlurField.uniform(WIDTH, HEIGHT, (24.0, 0.0))
    result = deblur(image, field)
    row = slice(HEIGHT // 2 - 1, HEIGHT // 2 + 2)
    around = np.r_[WIDTH // 2 - 90 : WIDTH // 2 - 20, WIDTH // 2 + 20 : WIDTH // 2 + 90]
    lampless = coded(smeared_lamp(np.minimum(light, 0.2), 24))
    undisturbed = deblur(lampless, field)
    # Beside the lamp's trace the result stays between the input and what it is without the lamp.
    low, high = np.minimum(lampless, undisturbed), np.maximum(lampless, undisturbed)
    assert (result[row][:, around] >= low[row][:, around].astype(int) - 3).all()
    assert (result[row][:, around] <= high[row][:, around].astype(int) + 3).all()
    # Far away the lamp changes nothing; on the trace itself the input stays.
    np.testing.assert_array_equal(result[: HEIGHT // 2 - 20], undisturbed[: HEIGHT // 2 - 20])
    saturated = image >= 250
    assert saturated.sum() == 24
    np.testing.assert_array_equal(result[saturated], image[saturated])


def test_white_that_the_sensor_just_holds_is_deblurred():
    light = 0.02 + 0.98 * np.round(texture()[..., 1])  # black and white, no lamps
    image = coded(smeared(light, (20.0, 5.0)))
    assert (image >= 250).mean() > 0.02
    field = BlurField.uniform(WIDTH, HEIGHT, (20.0, 5.0))
    cells = Cells.of(field)
    lost = lost_light_reference(linear_from_srgb(image / 255), image >= 250, cells)
    assert not lost.any()
    assert psnr(deblur(image, field), coded(light)) > psnr(image, coded(light)) + 1


def smeared_lamp(light: np.ndarray, length_px: int) -> np.ndarray:
    """Linear light averaged over whole pixels along the rows; nothing is clipped."""
    padded = np.pad(light, ((0, 0), (length_px // 2, length_px - length_px // 2 - 1)), mode="reflect")
    return np.lib.stride_tricks.sliding_window_view(padded, length_px, axis=1).mean(axis=2)


def test_sixteen_bits_keep_their_precision():
    light = 0.02 * texture()  # in the dark, where 8 bits are coarse
    field = BlurField.uniform(WIDTH, HEIGHT, (12.0, 4.0))
    image = coded(smeared(light, (12.0, 4.0)), np.uint16)
    options = DeblurOptions(noise=0.0)
    wide = linear_from_srgb(deblur(image, field, options) / 65535)
    narrow = linear_from_srgb(deblur(coded(linear_from_srgb(image / 65535)), field, options) / 255)
    cells = Cells.of(field)
    table = wiener._table(cells, 0.0)
    exact = np.stack([filter_reference(linear_from_srgb(image[..., c] / 65535), cells, table) for c in range(3)], -1)
    exact = np.clip(exact, 0, 1)
    assert np.abs(wide - exact).max() < 2e-5
    assert np.std(wide - exact) < 0.05 * np.std(narrow - exact)


def test_noise_is_estimated_from_a_blurred_image(subtests):
    for sigma in (0.003, 0.01, 0.03):
        for axis in ("x", "y"):
            with subtests.test(sigma=sigma, axis=axis):
                light = 0.1 + 0.6 * smeared(texture(), (15.0, 0.0) if axis == "x" else (0.0, 15.0))
                image = coded(
                    np.clip(light + sigma * np.random.default_rng(7).standard_normal(light.shape), 0, 1), np.uint16
                )
                assert estimate_noise(image, axis) == pytest.approx(sigma, rel=0.2)


def test_the_noise_is_looked_for_along_the_blur(subtests):
    for vector_px in ((15.0, 2.0), (-2.0, 15.0)):
        with subtests.test(vector_px=vector_px):
            # fine texture: across the blur, detail would be taken for noise
            grain = gaussian_filter(np.random.default_rng(6).standard_normal((HEIGHT, WIDTH)), 0.7)
            light = 0.4 + 0.3 * smeared(np.clip(0.5 + grain, 0, 1)[..., None].repeat(3, axis=2), vector_px)
            image = coded(light + 0.004 * np.random.default_rng(7).standard_normal(light.shape))
            field = BlurField.uniform(WIDTH, HEIGHT, vector_px)
            told, found = deblur(image, field, DeblurOptions(noise=0.004)), deblur(image, field)
            assert psnr(found, told.astype(np.float64)) > 45
            assert psnr(found, image.astype(np.float64)) < 33  # it is not left alone


def test_a_gaussian_s_weights_have_its_mass_and_width(subtests):
    for sigma_px in (0.0, 0.5, 0.7, 1.5, 4.0):
        with subtests.test(sigma_px=sigma_px):
            weights = gaussian_weights(sigma_px)
            both = np.concatenate([weights[:0:-1], weights])
            at = np.arange(len(both)) - len(both) // 2
            assert both.sum() == pytest.approx(1) and len(weights) == np.ceil(3 * sigma_px) + 1
            if sigma_px:
                assert weights[1] / weights[0] == pytest.approx(np.exp(-0.5 / sigma_px**2))
            if sigma_px > 0.5:  # else pixels are too coarse for it
                assert (both @ at**2) ** 0.5 == pytest.approx(sigma_px, rel=0.02)


def test_smoothing_grows_with_the_roots_of_noise_and_blur_up_to_its_end():
    assert smoothing_px(0.01, 10.0) == pytest.approx(0.7)
    assert smoothing_px(0.04, 10.0) == smoothing_px(0.01, 40.0) == pytest.approx(1.4)
    assert smoothing_px(0.0025, 10.0) == pytest.approx(0.35) and smoothing_px(0.1, 40.0) == 1.5


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
    assert np.mean(after) > np.mean(before) + 0.8
