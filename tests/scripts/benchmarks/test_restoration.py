"""The parts of the restoration benchmark that its figures stand on."""

from functools import cache

import cv2
import numpy as np
import pytest

from colmap_inertial.imaging.path_filters import deblur
from colmap_inertial.imaging.transfer import decode_table
from scripts.common import (
    imaging_metrics as metrics,
    imaging_scenes as scenes,
    restoration_deblur,
    restoration_exposures as exposures,
)
from scripts.common.restoration_sheet import CROP_PX, write_sheet

SIZE = (640, 480)
NOISE, RATIO, BLUR_PX = 0.06, 10.0, 12.0
ERRORS = restoration_deblur.usual_errors(1, 4)[0]


@cache
def wall():
    grey = scenes.drawn_walls(1, 3)[0][:900, :1200]
    # the colours are not those of grey, and no lamp is among them
    return np.stack([0.7 * grey, 0.6 * grey[::-1], 0.5 * grey[:, ::-1]], axis=-1).astype(np.float32)


@cache
def scene():
    return exposures.expose(wall(), BLUR_PX, RATIO, NOISE, ERRORS, size=SIZE, seed=4)


def test_a_wall_in_colour_gives_the_frames_of_its_channels():
    pair = scenes.make_pairs([wall()], 8.0, size=SIZE, seed=1)[0]
    assert pair.sharp(0).shape == (480, 640, 3)
    for channel in range(3):
        alone = scenes.make_pairs([np.ascontiguousarray(wall()[..., channel])], 8.0, size=SIZE, seed=1)[0]
        assert np.array_equal(alone.sharp(0), pair.sharp(0)[..., channel])


def test_errors_of_the_gyroscope_are_those_asked_for():
    pair = scenes.make_pairs([wall()], 8.0, size=SIZE, seed=1)[0]
    exact = pair.blur(0, restoration_deblur.PERFECT).vector_px
    turned = pair.blur(0, scenes.GyroErrors(noise_rad_s=0.0, extent=1.3, angle_rad=0.2)).vector_px
    factor = (turned[..., 0] + 1j * turned[..., 1]) / (exact[..., 0] + 1j * exact[..., 1])
    assert np.abs(factor - 1.3 * np.exp(0.2j)).max() < 1e-4
    drawn = restoration_deblur.usual_errors(4, 9)
    for values, expected in (
        ([e.late_s for e in drawn], 0.003),
        ([np.log(e.extent) for e in drawn], 0.1),
        ([e.angle_rad for e in drawn], np.radians(3)),
    ):
        assert np.std(values) == pytest.approx(expected) and len(set(values)) == 4
        assert np.mean(values) == pytest.approx(0, abs=1e-12)


def test_exposures_have_the_light_noise_and_blur_asked_for():
    one = scene()
    light = decode_table(np.dtype(np.uint8))
    truth = light[one.truth]
    middling = (truth > 0.4) & (truth < 0.6)
    # as bright as the long one; three colours that differ by some percent
    gained = RATIO * light[one.short]
    tint = np.array([np.median(gained[..., c] / np.maximum(truth[..., c], 0.05)) for c in range(3)])
    assert np.abs(tint - 1).max() < 0.15
    rest = (gained / tint - truth)[middling]
    assert 1.4826 * np.median(np.abs(rest - np.median(rest))) == pytest.approx(NOISE, rel=0.25)
    assert np.percentile(one.true_blur().extent_px(), 90) == pytest.approx(BLUR_PX, rel=0.15)
    # blur takes more from changes along it than from those across
    along, across = (
        _change(one.long, one.true_blur(), turn) / _change(one.truth, one.true_blur(), turn) for turn in (1, 1j)
    )
    assert along < 0.75 and along < 0.9 * across
    again = exposures.expose(wall(), BLUR_PX, RATIO, NOISE, ERRORS, size=SIZE, seed=4)
    assert np.array_equal(again.short, one.short) and np.array_equal(again.long, one.long)


def _change(image, blur, turn):
    """Mean change from pixel to pixel in the direction of the blur, times ``turn``."""
    mean = blur.vector_px.reshape(-1, 2).mean(axis=0)
    direction = complex(*mean) / abs(complex(*mean)) * turn
    smooth = cv2.GaussianBlur(image, (0, 0), 1.5).astype(np.float32)
    by_x, by_y = (cv2.Scharr(smooth, -1, *order) for order in ((1, 0), (0, 1)))
    return np.abs(direction.real * by_x + direction.imag * by_y).mean()


def test_true_blur_undoes_the_long_exposure_and_denoising_the_short_one():
    one = scene()
    pair = one.together()
    short, long = exposures.codes(pair.short), exposures.codes(pair.long)
    assert metrics.psnr_db(deblur(long, one.true_blur()), one.truth) > metrics.psnr_db(long, one.truth) + 0.5
    strength = exposures.best_strength([short], [one.truth])
    assert metrics.psnr_db(exposures.denoised(short, strength), one.truth) > metrics.psnr_db(short, one.truth) + 0.5
    correct, found = metrics.correct_matches(one.pair, metrics.extract(one.truth, 0), metrics.extract(one.view, 0))
    assert correct > 30 and correct > 0.8 * found


def test_the_sheet_has_a_row_for_every_scene(tmp_path):
    file = tmp_path / "sheet.png"
    write_sheet(file, [wall()], deblur, None, size=SIZE, seed=0)
    sheet = cv2.imread(str(file))
    assert sheet.shape[1] > 4 * CROP_PX and sheet.shape[0] > 4 * CROP_PX
