"""Choice of frames."""

import numpy as np

from colmap_inertial.run.preparation.selection import _slots


def test_of_a_quick_video_the_least_blurred_frame_of_each_slot_counts():
    t_s = np.arange(12) / 120  # four frames to a slot, which is about its middle
    blur = np.array([3, 2, 9, 1, 5, np.nan, 7, 8, 0.5, np.nan, np.nan, 4.0])
    assert _slots(t_s, blur).tolist() == [1, 3, 8, 11]
    assert _slots(np.arange(3) / 30, blur[:3]).tolist() == [0, 1, 2]
