"""Key frames of the search for loops."""

import numpy as np

from colmap_inertial.colmap.loops.search import key_frames


def test_key_frames_begin_with_the_first_and_are_a_second_apart():
    assert key_frames(np.arange(0, 5.01, 0.25)).tolist() == [0, 4, 8, 12, 16, 20]
    assert key_frames(np.array([0.0, 0.5, 3.0, 3.4, 3.97])).tolist() == [0, 2, 4]
