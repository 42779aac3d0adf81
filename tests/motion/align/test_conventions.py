"""Gravity in the accelerations that a convention of poses gives."""

import pytest

from colmap_inertial.motion.align.conventions import quick_accelerations
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording


@pytest.fixture(scope="module")
def recording():
    return simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=15.0)), seed=3)


def test_steady_gravity_is_steady(recording):
    trajectory, imu = recording.trajectory, recording.imu
    found = quick_accelerations(trajectory, imu, recording.truth.calibration)
    assert found is not None and 0.98 < found.steadiness <= 1
