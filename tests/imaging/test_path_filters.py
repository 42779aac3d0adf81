"""The compiled filters along paths against the plain ones."""

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest

from colmap_inertial._kernels import _light, _path
from colmap_inertial.imaging import path_filters
from colmap_inertial.imaging._chroma import join_colours, split_colours
from colmap_inertial.imaging._tiles import TiledPaths, Tiling
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath, middles
from colmap_inertial.imaging.path_filters import (
    DeblurOptions,
    Noise,
    filter_along,
    half_quadratic,
    noise_along,
    path_wiener,
    smoothed,
)
from colmap_inertial.imaging.transfer import decode_table, srgb_from_linear
from tests.references.path_filters import filter_reference, noise_reference, shares_of, sources_of

SETS = _path.instruction_sets()


def bent(width, height, extent=(14.0, -6.0), bend=3.0):
    """A path that changes from place to place."""
    straight = BlurPath.straight(BlurField.uniform(width, height, extent, step_px=64))
    s = middles(len(straight.path_px))[:, None, None, None]
    growing = 1 + 0.2 * np.linspace(-1, 1, straight.path_px.shape[2])[:, None]
    path = straight.path_px * growing + bend * (4 * s**2) * np.array([0.3, 1.0])
    return BlurPath(width=width, height=height, path_px=path.astype(np.float32))


def light_of(width, height, channels=1, seed=3):
    """Blocks and a slope, with noise."""
    rng = np.random.default_rng(seed)
    coarse = rng.random((height // 12 + 2, width // 12 + 2, channels))
    blocks = coarse.repeat(12, axis=0).repeat(12, axis=1)[:height, :width]
    slope = np.linspace(0.1, 1, width)[:, None]
    return (blocks * slope + 0.01 * rng.standard_normal((height, width, channels))).astype(np.float32)


def test_a_tile_s_transform_is_numpy_s_and_comes_back(subtests):
    for instruction_set in SETS:
        for side in (32, 64, 256, 512):
            with subtests.test(instruction_set=instruction_set, side=side):
                tile = np.random.default_rng(side).standard_normal((side, side)).astype(np.float32)
                spectrum, back = np.empty((side, side // 2 + 1, 2), np.float32), np.empty_like(tile)
                _path.transform(tile, spectrum, back, instruction_set)
                expected = np.fft.fft(np.fft.rfft(tile, axis=0), axis=1).T
                np.testing.assert_allclose(spectrum[..., 0] + 1j * spectrum[..., 1], expected, atol=2e-6 * side)
                np.testing.assert_allclose(back / side**2, tile, atol=3e-6)


def test_both_filters_are_the_plain_ones(subtests):
    doubts = {"certain": (0.0, 0.0, 0.0), "doubtful": (2.0, -0.5, 0.7)}
    filters = {"wiener": (), "half-quadratic": path_filters.FILTER_MODEL.splitting}
    for doubt, kind, instruction_set in itertools.product(doubts, filters, SETS):
        with subtests.test(doubt=doubt, kind=kind, instruction_set=instruction_set):
            cov_px2, splitting = doubts[doubt], filters[kind]
            width, height = 330, 210
            path, light = replace(bent(width, height), cov_px2=cov_px2), light_of(width, height)
            tiling = Tiling.covering(width, height, path.extent_px())
            paths, noise = tiling.paths(path), Noise(2e-5, 1e-4)
            spreads = tiling.spreads(path)
            found = filter_along(
                light,
                tiling,
                TiledPaths(paths, spreads),
                [noise],
                splitting,
                threads=2,
                instruction_set=instruction_set,
            )
            expected = filter_reference(light[..., 0], tiling, paths, spreads, noise, splitting)
            assert np.abs(found[..., 0] - light[..., 0]).max() > 0.1
            # a gradient at the threshold may fall on either side of it
            off = np.abs(found[..., 0] - expected)
            assert np.quantile(off, 0.998) < 2e-4 and off.max() < (0.02 if splitting else 2e-4)


def test_noise_is_what_the_plain_version_sees():
    width, height = 330, 210
    path, light = bent(width, height, (24.0, 5.0)), light_of(width, height)
    tiling = Tiling.covering(width, height, path.extent_px())
    paths = tiling.paths(path)
    expected = noise_reference(light[..., 0], tiling, paths)
    found = np.reshape(
        _path.noise(
            light,
            paths=paths,
            window_in=tiling.window_in(),
            hop=tiling.hop,
            before=tiling.before,
            above=path_filters.FILTER_MODEL.noise_above_per_px,
            share=path_filters.FILTER_MODEL.noise_share,
            every=1,
        ),
        (-1, 3),
    )
    np.testing.assert_allclose(found, expected, rtol=0.02)


def test_noise_is_found_as_it_grows_with_light_also_among_edges():
    width, height = 900, 700
    rng = np.random.default_rng(1)
    light = np.broadcast_to(np.linspace(0.02, 0.9, width), (height, width)).copy()
    light += np.sqrt(1e-5 + 2e-4 * light) * rng.standard_normal(light.shape)
    light[300:340, 200:600] = 0.9  # sharp, as no blurred picture is
    light = light[..., None].astype(np.float32)
    path = bent(width, height, (24.0, 5.0))
    tiling = Tiling.covering(width, height, path.extent_px())
    (noise,) = noise_along(light, tiling, tiling.paths(path))
    np.testing.assert_allclose(noise.dark + 0.5 * noise.by_light, 1.1e-4, rtol=0.15)
    assert noise.by_light > 1e-4
    assert Noise.fitted(np.zeros((0, 2))).dark > 0


def test_threads_change_no_bit_and_colours_do_not_mix():
    width, height = 700, 400
    path, light = bent(width, height), light_of(width, height, channels=3)
    tiling = Tiling.covering(width, height, path.extent_px())
    paths, noise = tiling.paths(path), [Noise(1e-4, 0.0)] * 3
    one, many = (
        filter_along(light, tiling, TiledPaths(paths, tiling.spreads(path)), noise, (8.0,), threads=n) for n in (1, 3)
    )
    np.testing.assert_array_equal(one, many)
    for c in range(3):
        one_plane = np.ascontiguousarray(light[..., c : c + 1])
        alone = filter_along(one_plane, tiling, TiledPaths(paths, tiling.spreads(path)), noise[:1], (8.0,))
        np.testing.assert_allclose(one[..., c], alone[..., 0], atol=1e-6)


def test_tiles_add_up_to_one_wherever_there_is_image(subtests):
    for extent_px in (3.0, 20.0, 21.0, 60.0, 200.0):
        with subtests.test(extent_px=extent_px):
            tiling = Tiling.covering(1000, 333, extent_px)
            assert tiling.margin >= min(0.6 * extent_px, 0.15 * tiling.side) and tiling.hop > tiling.ramp
            rows, columns = tiling.count
            for count, size in ((rows, 333), (columns, 1000)):
                assert (count - 1) * tiling.hop + tiling.ramp < size or count == 1  # none too many
                total = np.zeros((count - 1) * tiling.hop + tiling.side)
                for k in range(count):
                    total[k * tiling.hop : k * tiling.hop + tiling.side] += shares_of(tiling, k, count)
                np.testing.assert_allclose(total[tiling.before : tiling.before + size], 1, atol=1e-6)
            # no seam: what is near a tile's edge counts little there
            for window in (tiling.window_in(), tiling.window_out()):
                assert (np.diff(window[: tiling.side // 2]) >= 0).all() and np.array_equal(window, window[::-1])
                assert window[0] < 0.01 and window[tiling.side // 2] == 1
            rows, columns = sources_of(tiling)
            np.testing.assert_array_equal(rows[tiling.before - 2 : tiling.before + 335], [2, 1, *range(333), 331, 330])


def test_a_tile_has_the_path_of_its_middle():
    width, height = 600, 400
    path = bent(width, height)
    tiling = Tiling.covering(width, height, path.extent_px())
    rows, columns = tiling.count
    paths = tiling.paths(path)
    assert paths.shape == (rows, columns, len(path.path_px), 2)
    middle = 2 * tiling.hop - tiling.before + tiling.side / 2 - 0.5
    np.testing.assert_allclose(
        paths[1, 2], path.at(np.array([tiling.hop + middle - 2 * tiling.hop]), np.array([middle]))[0, 0]
    )


def test_how_uncertain_a_changing_path_is_follows_the_chord_s_slopes():
    """A chord that is linear in x and in y: over a tile's middle it changes by slope times side, evenly spread."""
    width, height, step_px = 1000, 700, 10
    rows, columns = BlurField.nodes(width, height, step_px)
    y, x = np.meshgrid(step_px * np.arange(rows), step_px * np.arange(columns), indexing="ij")
    chord = np.stack([8 + 0.006 * x + 2e-5 * x * y, 3 - 0.004 * y + 1e-5 * x * y], axis=-1)
    field = BlurField(width=width, height=height, step_px=step_px, vector_px=chord, cov_px2=(0.5, 0.1, 0.2))
    path = BlurPath.straight(field)
    tiling = Tiling.covering(width, height, 20.0)
    across = tiling.side - 2 * tiling.margin
    inside = 0
    for row, down in zip(tiling.spreads(path), tiling._middles()[0].ravel(), strict=True):
        for found, right in zip(row, tiling._middles()[1].ravel(), strict=True):
            if not (across / 2 < down < height - 1 - across / 2 and across / 2 < right < width - 1 - across / 2):
                continue
            inside += 1
            along_x, along_y = (
                np.array([0.006 + 2e-5 * down, 1e-5 * down]),
                np.array([2e-5 * right, -0.004 + 1e-5 * right]),
            )
            cov = np.array([[0.5, 0.1], [0.1, 0.2]])
            cov = cov + across**2 / 12 * (np.outer(along_x, along_x) + np.outer(along_y, along_y))
            assert found == pytest.approx(cov[[0, 0, 1], [0, 1, 1]], rel=1e-3)
    assert inside > 4


def test_a_path_that_changes_within_a_tile_is_as_uncertain_there():
    width, height, roll_rad = 1025, 1025, 0.02
    y, x = np.mgrid[0:17, 0:17] * 64.0 - 512
    chords = np.stack([30 - roll_rad * y, 10 + roll_rad * x], axis=-1).astype(np.float32)
    path = BlurPath.straight(BlurField(width=width, height=height, vector_px=chords, step_px=64))
    tiling = Tiling.covering(width, height, path.extent_px())
    inner = tiling.side - 2 * tiling.margin
    middle = tuple(n // 2 for n in tiling.count)
    np.testing.assert_allclose(
        tiling.spreads(path)[middle], np.array([1, 0, 1]) * (roll_rad * inner) ** 2 / 12, atol=1e-4
    )
    assert not tiling.spreads(BlurPath.straight(BlurField.uniform(width, height, (30.0, 10.0), step_px=64))).any()


def test_pixels_without_blur_and_around_what_is_clipped_stay(subtests):
    for restore in (path_wiener, half_quadratic):
        with subtests.test(restore=restore):
            width, height = 400, 300
            light = light_of(width, height)[..., 0]
            image = np.clip(40 + 150 * light, 0, 240).astype(np.uint8)
            image[140:160, 190:210] = 255
            still = BlurPath(width=width, height=height, path_px=np.zeros((17, 6, 8, 2)))
            np.testing.assert_array_equal(restore(image, still), image)
            path = bent(width, height, (9.0, 0.0), bend=0.0)
            out = restore(image, path)
            np.testing.assert_array_equal(out[140:160, 175:225], image[140:160, 175:225])
            assert (out[:100] != image[:100]).mean() > 0.5
            deep = restore(image.astype(np.uint16) * 257, path)
            assert deep.dtype == np.uint16 and np.abs(deep / 257 - out).max() < 1.5
            colours = restore(np.stack([image] * 3, axis=-1), path, DeblurOptions(threads=2))
            np.testing.assert_array_equal(colours, np.stack([out] * 3, axis=-1))


def test_what_does_not_fit_is_refused():
    path = BlurPath.straight(BlurField.uniform(64, 48, (9.0, 0.0)))
    with pytest.raises(ValueError, match="blur: for 64 x 48 px"):
        path_wiener(np.zeros((40, 64), np.uint8), path)
    with pytest.raises(ValueError, match="uint8 or uint16"):
        path_wiener(np.zeros((48, 64), np.float32), path)
    with pytest.raises(ValueError, match="600 px long"):
        half_quadratic(np.zeros((48, 64), np.uint8), BlurPath.straight(BlurField.uniform(64, 48, (600.0, 0.0))))


def test_smoothing_is_in_linear_light_and_keeps_the_type():
    image = np.zeros((41, 41), np.uint8)
    image[20, 20] = 255
    for codes in (image, image.astype(np.uint16) * 257):
        table = decode_table(codes.dtype)
        out = table[smoothed(codes, 1.2)]
        at = np.arange(-4, 5)
        weights = np.exp(-0.5 * (at / 1.2) ** 2)
        np.testing.assert_allclose(out[20, 16:25], weights / weights.sum() ** 2, atol=0.003)
    flat = np.full((30, 30, 3), 77, np.uint8)
    np.testing.assert_array_equal(smoothed(flat, 1.2), flat)


def test_colours_come_back_from_luma_and_half_chroma(subtests):
    for size in ((640, 400), (641, 401)):
        with subtests.test(size=size):
            width, height = size
            rng = np.random.default_rng(2)
            coarse = cv2.resize(
                rng.random((13, 20, 3), dtype=np.float32), (width, height), interpolation=cv2.INTER_CUBIC
            )
            image = np.clip(30 + 190 * coarse, 0, 255).astype(np.uint8)
            luma, chroma = split_colours(image, 1)
            assert luma.shape == (height, width) and chroma.shape == (2, -(-height // 2), -(-width // 2))
            light = decode_table(image.dtype)[image]
            np.testing.assert_allclose(luma, light @ [0.2126, 0.7152, 0.0722], atol=1e-5)
            one, many = (join_colours(luma, chroma, threads) for threads in (1, 3))
            np.testing.assert_array_equal(one, many)
            # between pixels of half the size, lines are interpolated as OpenCV does
            lines = rng.random((4, *chroma.shape[1:]), dtype=np.float32)
            planes = [cv2.resize(p, (2 * p.shape[1], 2 * p.shape[0]))[:height, :width] for p in lines]
            r, b = (planes[i] * luma + planes[i + 1] for i in (0, 2))
            _light.join(luma, lines, joined := np.empty_like(one), red=0.3, blue=0.2)
            green = luma - 0.3 * r - 0.2 * b
            np.testing.assert_allclose(joined, np.stack([green + r, green, green + b], axis=-1), atol=1e-5)
            # what is coarser than the window comes back, and a place stays where it was
            assert np.abs(one - light).mean() < 2e-3
            shifted = np.roll(one, 1, axis=1)
            assert np.abs(shifted - light)[:, 4:-4].mean() > 2 * np.abs(one - light)[:, 4:-4].mean()


def test_colours_are_as_near_to_the_sharp_picture_as_channels_filtered_one_by_one(subtests):
    for restore in (path_wiener, half_quadratic):
        with subtests.test(restore=restore):
            width, height = 640, 400
            rng = np.random.default_rng(4)
            # patches, light and dark, of colours as mixed as those of photographs
            tints = rng.uniform(0.1, 0.7, (height // 25, width // 25 + 1, 1)) * rng.uniform(
                0.6, 1.4, (height // 25, 26, 3)
            )
            patches = tints.repeat(25, axis=0).repeat(25, axis=1)[:height, :width]
            length, encode = 15, lambda light: np.rint(255 * srgb_from_linear(np.clip(light, 0, 1))).astype(np.uint8)
            kernel = np.full((1, length), 1 / length)
            blurred = cv2.filter2D(patches, -1, kernel, borderType=cv2.BORDER_REFLECT_101)
            blurred = encode(0.9 * blurred + 0.005 * rng.standard_normal(blurred.shape))
            sharp = encode(0.9 * patches).astype(float)
            path = BlurPath.straight(BlurField.uniform(width, height, (float(length), 0.0)))
            each = np.stack([restore(np.ascontiguousarray(blurred[..., c]), path) for c in range(3)], axis=-1)
            before, together, alone = (np.mean((p - sharp) ** 2) for p in (blurred, restore(blurred, path), each))
            # such patches suit sparse gradients in every channel better than photographs do
            assert together < 0.6 * before and together < (1.1 if restore is path_wiener else 1.25) * alone
