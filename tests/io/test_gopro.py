"""GoPro metadata: stabilisation and axes."""

import numpy as np
import pytest

from colmap_inertial.core.geometry import quat_exp
from colmap_inertial.io.gopro import _labels, _stabilisation


def test_a_picture_that_turns_seldom_but_far_was_stabilised():
    # rms .006 rad, mean .002
    turn = np.zeros((900, 3))
    turn[::9, 0] = 0.018
    assert _stabilisation({}, quat_exp(turn)[:, [3, 0, 1, 2]]) == (True, "IORI")
    assert _stabilisation({}, quat_exp(0.7 * turn)[:, [3, 0, 1, 2]]) == (False, "")


def test_three_letters_name_the_axes_of_a_gopro():
    np.testing.assert_array_equal(_labels("YxZ") @ [1.0, 2.0, 3.0], [-2.0, 1.0, 3.0])
    for letters in ("XY", "XYZX", ""):
        with pytest.raises(ValueError, match="does not name three axes"):
            _labels(letters)
