"""Codes of images of more than 8 bit."""

import numpy as np

from colmap_inertial.imaging.multi_aperture._sampling import convert_to_codes


def test_codes_of_16_bit_go_over_the_square_root():
    image = np.array([[0, 2500, 10_000]], dtype=np.uint16)
    np.testing.assert_array_equal(convert_to_codes(np.repeat(image, 2000, axis=0)), [[0, 128, 255]] * 2000)
    np.testing.assert_array_equal(convert_to_codes(np.array([[7]], np.uint8)), [[7]])
