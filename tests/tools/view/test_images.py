"""Previews of images for the viewer."""

from itertools import product

import cv2
import numpy as np
import pytest

from colmap_inertial.tools.view.images import read_preview


def test_a_preview_has_three_channels_of_eight_bits_and_keeps_its_shape(subtests, tmp_path):
    for colour, depth in product((False, True), (8, 16)):
        with subtests.test("colour" if colour else "grey", depth=depth):
            path = tmp_path / f"{colour}{depth}.png"
            ramp = np.tile(np.linspace(0, 255, 90), (60, 1)).round()
            image = np.stack([ramp, 255 - ramp, 0 * ramp], axis=2) if colour else ramp
            image = (image * 257).astype(np.uint16) if depth == 16 else image.astype(np.uint8)
            cv2.imwrite(str(path), image)
            expected = (
                np.repeat(ramp[:, :, None], 3, axis=2) if not colour else np.stack([0 * ramp, 255 - ramp, ramp], axis=2)
            )
            for most_px, shape in ((90, (60, 90, 3)), (200, (60, 90, 3)), (30, (20, 30, 3)), (1, (1, 1, 3))):
                shown, why = read_preview(path, most_px)
                assert why == "" and shown.shape == shape and shown.dtype == np.uint8
                assert shown.mean(axis=(0, 1)) == pytest.approx(expected.mean(axis=(0, 1)), abs=1.5)
            # red first
            assert np.array_equal(read_preview(path, 90)[0], expected)
