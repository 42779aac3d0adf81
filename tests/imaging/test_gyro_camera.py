"""Exposure and readout of a frame."""

import numpy as np
import pytest

from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera


def test_no_shutter_takes_less_than_no_time(subtests):
    for times in ({"exposure_s": -0.001}, {"readout_s": -0.001}, {"readout_s": np.nan}):
        with subtests.test(times=times), pytest.raises(ValueError, match="must not be negative"):
            FrameShutter(**{"width": 64, "height": 48, "t_s": 0.0, "exposure_s": 0.01, **times})


def test_a_frame_is_covered_where_the_gyroscope_recorded_all_of_it():
    """From the first line's begin to the last line's end: 0.05 s of exposure and 0.03 s of readout."""
    path = GyroPath(np.linspace(0.0, 2.0, 401), np.zeros((401, 3)), np.zeros(3))
    camera = GyroCamera(path=path, cam_from_imu_xyzw=np.array([0.0, 0.0, 0.0, 1.0]), offset_s=10.0)
    for t_s, covered in ((9.99, False), (10.01, True), (11.91, True), (11.93, False), (11.96, False), (12.01, False)):
        shutter = FrameShutter(width=64, height=48, t_s=t_s, exposure_s=0.05, readout_s=0.03)
        assert shutter.covered_by(camera) is covered, t_s
