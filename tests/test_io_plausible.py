"""Numbers that no IMU can give are refused with the setting that corrects them; honest ones never are."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.errors import FormatError
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.plausible import check_plausible, check_rates
from colmap_inertial.types import ImuRecording

RECORDINGS = [*(f"inertial_scale/D{i}" for i in (1, 3, 5, 7, 9, 11, 13, 15)), "euroc_v101"]


@pytest.fixture(scope="module")
def recordings(shared_data: Path) -> dict[str, ImuRecording]:
    return {name: read_imu(shared_data / name) for name in RECORDINGS}


def pieces(imu: ImuRecording, seconds: float) -> list[ImuRecording]:
    """The recording cut into equal parts of at least this length."""
    count = int((imu.gyro_t_s[-1] - imu.gyro_t_s[0]) / seconds)
    edges = np.linspace(imu.gyro_t_s[0], imu.gyro_t_s[-1] + 1e-6, count + 1)
    cut = []
    for start, end in pairwise(edges):
        g = (imu.gyro_t_s >= start) & (imu.gyro_t_s < end)
        a = (imu.accel_t_s >= start) & (imu.accel_t_s < end)
        cut.append(
            replace(
                imu,
                gyro_t_s=imu.gyro_t_s[g],
                gyro_rad_s=imu.gyro_rad_s[g],
                accel_t_s=imu.accel_t_s[a],
                accel_m_s2=imu.accel_m_s2[a],
            )
        )
    return cut


def without_gravity(imu: ImuRecording) -> ImuRecording:
    kernel = np.ones(201) / 201
    slow = np.stack([np.convolve(np.pad(a, 100, mode="edge"), kernel, "valid") for a in imu.accel_m_s2.T], axis=1)
    return replace(imu, accel_m_s2=imu.accel_m_s2 - slow)


ALTERATIONS = {
    'unit = "deg/s" under \\[imu.gyro\\]': lambda imu: replace(imu, gyro_rad_s=np.degrees(imu.gyro_rad_s)),
    'in g; set unit = "g" under \\[imu.accel\\]': lambda imu: replace(imu, accel_m_s2=imu.accel_m_s2 / 9.81),
    'set unit = "m/s2" under \\[imu.accel\\]': lambda imu: replace(imu, accel_m_s2=imu.accel_m_s2 * 9.81),
    "raw counts": lambda imu: replace(imu, accel_m_s2=imu.accel_m_s2 * 1670),
    "exchanged": lambda imu: replace(
        imu,
        gyro_t_s=imu.accel_t_s,
        gyro_rad_s=imu.accel_m_s2,
        accel_t_s=imu.gyro_t_s,
        accel_m_s2=imu.gyro_rad_s,
    ),
    "gravity was taken out": without_gravity,
    "gyroscope's y axis never changes": lambda imu: replace(imu, gyro_rad_s=imu.gyro_rad_s * [1, 0, 1]),
    "accelerometer's x axis never changes": lambda imu: replace(
        imu, accel_m_s2=np.column_stack([np.full(len(imu.accel_t_s), 0.1), imu.accel_m_s2[:, 1:]])
    ),
    "gyroscope never changes": lambda imu: replace(imu, gyro_rad_s=np.zeros_like(imu.gyro_rad_s)),
    "accelerometer never changes": lambda imu: replace(imu, accel_m_s2=0 * imu.accel_m_s2 + 9.8),
}


@pytest.mark.parametrize("name", RECORDINGS)
@pytest.mark.parametrize("said", ALTERATIONS)
def test_every_altered_recording_is_refused_with_what_to_set(
    recordings: dict[str, ImuRecording], name: str, said: str
) -> None:
    with pytest.raises(FormatError, match=said):
        check_plausible(ALTERATIONS[said](recordings[name]), Path("x"))


@pytest.mark.parametrize("seconds", [60.0, 5.0, 1.0])
def test_no_part_of_a_clean_recording_is_refused(recordings: dict[str, ImuRecording], seconds: float) -> None:
    for imu in recordings.values():
        for part in pieces(imu, seconds):
            check_plausible(part, Path("x"))


def test_a_gyroscope_in_a_moving_car_and_one_in_strong_shake_are_accepted(shared_data: Path) -> None:
    car = np.loadtxt(shared_data / "gyrostab/20200109_145447/gyro.txt", delimiter=",", usecols=(0, 1, 2))
    check_rates(car, Path("x"))
    rows = np.loadtxt(shared_data / "deepgyro/raw/imu/imu.txt")
    gyro, accel = rows[rows[:, 0] == 4], rows[rows[:, 0] == 1]
    check_plausible(
        ImuRecording(
            gyro_t_s=gyro[:, 1] / 1e9, gyro_rad_s=gyro[:, 2:], accel_t_s=accel[:, 1] / 1e9, accel_m_s2=accel[:, 2:]
        ),
        Path("x"),
    )


def test_a_still_camera_is_accepted() -> None:
    rng = np.random.default_rng(0)
    t_s = np.arange(1000) / 100
    still = ImuRecording(
        gyro_t_s=t_s,
        gyro_rad_s=rng.normal(0.01, 1e-3, (1000, 3)),
        accel_t_s=t_s,
        accel_m_s2=rng.normal([0.2, 9.6, 0.5], 0.02, (1000, 3)),
    )
    check_plausible(still, Path("x"))
