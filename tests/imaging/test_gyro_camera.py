"""Exposure and readout of a frame."""

import numpy as np
import pytest

from colmap_inertial.imaging.gyro_camera import FrameShutter


def test_no_shutter_takes_less_than_no_time(subtests):
    for times in ({"exposure_s": -0.001}, {"readout_s": -0.001}, {"readout_s": np.nan}):
        with subtests.test(times=times), pytest.raises(ValueError, match="must not be negative"):
            FrameShutter(**{"width": 64, "height": 48, "t_s": 0.0, "exposure_s": 0.01, **times})
