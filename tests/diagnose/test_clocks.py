"""Checks of the frames' times against the IMU's."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraTrajectory, FrameTiming, ImuRecording
from colmap_inertial.diagnose.clocks import _compare_part, check_coverage, rate_finding
from colmap_inertial.imaging.gyro_camera import GyroCamera


def test_an_imu_that_misses_frames_at_either_end_is_reported(subtests):
    """Frames of 0 to 20 s; camera time is IMU time plus 5 s; up to 3 % of the frames may be missing."""
    timing = FrameTiming(names=tuple(map(str, range(201))), t_s=np.linspace(0.0, 20.0, 201))
    for begin_s, end_s, share, severity in (
        (-1.0, 21.0, None, None),
        (0.5, 20.0, None, None),
        (3.0, 21.0, 0.85, "warning"),
        (-1.0, 18.0, 0.9, "warning"),
        (2.0, 16.0, 0.7, "warning"),
        (10.0, 14.0, 0.2, "error"),
        (30.0, 40.0, 0.0, "error"),
    ):
        with subtests.test(begin_s=begin_s, end_s=end_s):
            t_s = np.linspace(begin_s, end_s, 500) - 5.0
            nothing = np.zeros((500, 3))
            imu = ImuRecording(gyro_t_s=t_s, gyro_rad_s=nothing, accel_t_s=t_s, accel_m_s2=nothing)
            recorded = SimpleNamespace(imu=imu, timing=timing, trajectory=None, clocks=None, offset_s=lambda _: 5.0)
            found = list(check_coverage(recorded))
            if share is None:
                assert found == []
            else:
                (finding,) = found
                assert (finding.code, finding.severity) == ("imu-too-short", severity)
                assert finding.numbers["share"] == pytest.approx(share)


@pytest.mark.parametrize("short", ["gyroscope", "accelerometer", ""])
def test_the_sensor_that_alone_is_short_is_named(short):
    timing = FrameTiming(names=tuple(map(str, range(201))), t_s=np.linspace(0.0, 20.0, 201))
    whole_s, part_s = np.linspace(-1.0, 21.0, 500), np.linspace(-1.0, 12.0, 300)
    gyro_s, accel_s = (part_s if short in (name, "") else whole_s for name in ("gyroscope", "accelerometer"))
    imu = ImuRecording(
        gyro_t_s=gyro_s,
        gyro_rad_s=np.zeros((len(gyro_s), 3)),
        accel_t_s=accel_s,
        accel_m_s2=np.zeros((len(accel_s), 3)),
    )
    recorded = SimpleNamespace(imu=imu, timing=timing, trajectory=None, clocks=None, offset_s=lambda _: 0.0)
    (finding,) = check_coverage(recorded)
    assert finding.fact.values.get("sensor", "") == short
    assert finding.numbers["share"] == pytest.approx(0.6) and (short or "IMU") in finding.evidence


def test_frames_that_are_stamped_late_need_a_later_offset(subtests):
    """The camera is the IMU: rates of a sum of sines, attitudes multiplied by SciPy."""
    step_s = 0.005
    t_s = step_s * np.arange(2001)
    rate = np.stack([0.8 * np.sin(2 * np.pi * hz * t_s + hz) for hz in (0.7, 1.1, 1.6)], axis=1)
    attitude = [Rotation.identity()]
    for mean in 0.5 * (rate[1:] + rate[:-1]):
        attitude.append(attitude[-1] * Rotation.from_rotvec(step_s * mean))
    path = GyroPath(t_s, rate, np.zeros(3))
    motion = GyroCamera(path=path, cam_from_imu_xyzw=np.array([0.0, 0.0, 0.0, 1.0]), offset_s=0.0)
    frames = np.arange(600, 1200, 7)
    for late_s in (-0.12, 0.0, 0.2):
        with subtests.test(late_s=late_s):
            part = CameraTrajectory(
                names=tuple(map(str, frames)),
                t_s=t_s[frames] + late_s,
                cam_from_world_xyzw=np.stack([attitude[i].inv().as_quat() for i in frames]),
                cam_in_world=np.zeros((len(frames), 3)),
            )
            assert _compare_part(part, motion, 0.0).offset_s == pytest.approx(late_s, abs=2e-3)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(frames), 1))
    part = CameraTrajectory(
        names=tuple(map(str, frames)),
        t_s=t_s[frames],
        cam_from_world_xyzw=still,
        cam_in_world=np.zeros((len(frames), 3)),
    )
    assert _compare_part(part, motion, 0.0) is None  # the gyroscope explains nothing of it


def test_a_clock_that_is_more_than_a_percent_off_is_an_error():
    assert [rate_finding(rate).severity for rate in (0.005, -0.01, 0.02, -0.02)] == ["warning"] * 2 + ["error"] * 2
    assert "runs -2.00 % faster" in rate_finding(-0.02).evidence
