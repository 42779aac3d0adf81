"""Numbers that no IMU can give are refused with the setting that corrects them; honest ones never are."""

import re
from dataclasses import replace
from itertools import pairwise, permutations, product
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from colmap_inertial.core.axes import Axes
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.types import ImuRecording, ImuSource
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.plausible import best_mirrored_reading, check_consistent, check_rates, check_readings
from colmap_inertial.tools.simulate.motion import MotionKind, MotionOptions
from colmap_inertial.tools.simulate.recording import RecordingOptions, simulate_recording
from colmap_inertial.tools.simulate.sensors import IMU_PRESETS

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


def test_every_altered_recording_is_refused_with_what_to_set(
    subtests: pytest.Subtests, recordings: dict[str, ImuRecording]
) -> None:
    for name in RECORDINGS:
        for said in ALTERATIONS:
            with subtests.test(name=name, said=said), pytest.raises(FormatError, match=said):
                check_readings(ALTERATIONS[said](recordings[name]))


def test_no_part_of_a_clean_recording_is_refused(
    subtests: pytest.Subtests, recordings: dict[str, ImuRecording]
) -> None:
    for seconds in (60.0, 25.0, 5.0, 1.0):
        with subtests.test(seconds=seconds):
            for imu in recordings.values():
                for part in pieces(imu, seconds):
                    check_readings(part)


HANDHELD = RECORDINGS[:-1]
SIGNED_PERMUTATIONS = [
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
]


def settings(message: str) -> dict[str, Axes]:
    """The axes that a message says to set, by sensor."""
    named: dict[str, Axes] = {}
    for text, mirrored, sensor in re.findall(
        r'axes = "([-xyz,]+)"( and mirrored = true)? under \[imu\.(\w+)\]', message
    ):
        axes = Axes.parse(text)
        assert axes.is_mirrored == bool(mirrored)
        named.setdefault(sensor, axes)
    return named


def test_nearly_every_wrong_axis_of_a_gyroscope_is_noticed_and_named_rightly(
    subtests: pytest.Subtests, recordings: dict[str, ImuRecording]
) -> None:
    for name in HANDHELD[::2]:
        with subtests.test(name=name):
            imu = recordings[name]
            noticed = 0
            for wrong in SIGNED_PERMUTATIONS[1:]:
                altered = replace(imu, gyro_rad_s=imu.gyro_rad_s @ wrong.T)
                try:
                    check_readings(altered)
                except FormatError as error:
                    noticed += 1
                    np.testing.assert_array_equal(settings(str(error))["gyro"].matrix @ wrong, np.eye(3))
            assert noticed >= 45  # of 47; turns about the horizontal axis that the hand nods about look alike


def test_a_mirrored_accelerometer_is_noticed_and_named(recordings: dict[str, ImuRecording]) -> None:
    noticed = {}
    for axis in range(3):
        mirror = np.ones(3)
        mirror[axis] = -1
        noticed[axis] = 0
        for name in HANDHELD:
            imu = recordings[name]
            try:
                check_readings(replace(imu, accel_m_s2=imu.accel_m_s2 * mirror))
            except FormatError as error:
                noticed[axis] += 1
                np.testing.assert_array_equal(settings(str(error))["accel"].matrix, np.diag(mirror))
    # These hands nod about y, which hides half a turn about it in six recordings.
    assert noticed == {0: 8, 1: 2, 2: 8}


MIRRORED = [matrix for matrix in SIGNED_PERMUTATIONS if np.linalg.det(matrix) < 0]


@pytest.mark.parametrize("name", HANDHELD[1::2])
def test_the_advice_for_an_accelerometer_of_any_mirrored_axes_restores_it(
    recordings: dict[str, ImuRecording], name: str
) -> None:
    imu = recordings[name]
    restored = 0
    for wrong in MIRRORED:
        altered = replace(imu, accel_m_s2=imu.accel_m_s2 @ wrong.T)
        try:
            check_readings(altered)
        except FormatError as error:
            axes = settings(str(error))["accel"]
            corrected = replace(altered, accel_m_s2=axes.apply(altered.accel_m_s2))
            np.testing.assert_allclose(corrected.accel_m_s2, imu.accel_m_s2)
            check_readings(replace(corrected, source=ImuSource(accel_axes=axes)))
            restored += 1
    assert restored >= 22  # of 24; see the test of the gyroscope's axes


def test_exchanged_accelerometer_columns_are_named_and_corrected_through_a_capture(
    subtests: pytest.Subtests,
    recordings: dict[str, ImuRecording],
    shared_data: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    for first, second in ((0, 1), (0, 2), (1, 2)):
        with subtests.test(first=first, second=second):
            tmp_path = tmp_path_factory.mktemp("given")
            folder = shared_data / "inertial_scale/D3"
            columns = [2, 3, 4]
            columns[first], columns[second] = columns[second], columns[first]
            text = "".join(
                f'[imu.{sensor}]\nfile = "{folder / name}"\ntime = 1\ntime_unit = "ns"\n'
                f'columns = {chosen}\nunit = "{unit}"\n'
                for sensor, name, chosen, unit in (
                    ("gyro", "gyroscope.txt", [2, 3, 4], "rad/s"),
                    ("accel", "accelerometer.txt", columns, "m/s2"),
                )
            )
            capture = tmp_path / "capture.toml"
            capture.write_text(text)
            said = f"accelerometer's {'xyz'[first]} and {'xyz'[second]} columns that are exchanged"
            with pytest.raises(FormatError, match=said) as caught:
                read_imu(capture)
            assert {"gyro", "accel"} == set(settings(str(caught.value)))
            axes = settings(str(caught.value))["accel"]
            capture.write_text(text + f'axes = "{axes}"\nmirrored = true\n')
            np.testing.assert_array_equal(read_imu(capture).accel_m_s2, recordings["inertial_scale/D3"].accel_m_s2)


def test_a_mirrored_gyroscope_is_told_by_gravity(recordings: dict[str, ImuRecording]) -> None:
    right = 0
    for name, order in product(HANDHELD, ([1, 0, 2], [2, 1, 0])):
        imu = recordings[name]
        reading = best_mirrored_reading(replace(imu, gyro_rad_s=imu.gyro_rad_s[:, order]))
        assert reading is not None and np.linalg.det(reading.matrix) < 0
        right += np.array_equal(reading.matrix, np.eye(3)[order])
    assert right >= 0.9 * 2 * len(HANDHELD)


def test_axes_to_set_replace_those_that_were_set(recordings: dict[str, ImuRecording]) -> None:
    imu = recordings["inertial_scale/D1"]
    wrong = Axes.parse("-z,y,x")
    altered = replace(imu, gyro_rad_s=wrong.apply(imu.gyro_rad_s))
    with pytest.raises(FormatError) as caught:
        check_readings(replace(altered, source=ImuSource(gyro_axes=wrong)))
    assert str(settings(str(caught.value))["gyro"]) == "x,y,z"
    wrong = Axes.parse("y,z,-x")
    assert wrong.is_mirrored
    altered = replace(imu, accel_m_s2=wrong.apply(imu.accel_m_s2))
    with pytest.raises(FormatError) as caught:
        check_readings(replace(altered, source=ImuSource(accel_axes=wrong)))
    assert str(settings(str(caught.value))["accel"]) == "x,y,z"


def test_axes_to_set_are_those_of_the_file_s_columns(
    subtests: pytest.Subtests, recordings: dict[str, ImuRecording]
) -> None:
    for stated, true in (("-z,y,x", "y,-x,z"), ("y,z,x", "-z,y,x"), ("x,y,z", "y,z,x")):
        with subtests.test(stated=stated, true=true):
            imu = recordings["inertial_scale/D1"]
            columns = imu.gyro_rad_s @ Axes.parse(true).matrix
            np.testing.assert_array_equal(Axes.parse(true).apply(columns), imu.gyro_rad_s)
            altered = replace(imu, gyro_rad_s=Axes.parse(stated).apply(columns))
            with pytest.raises(FormatError) as caught:
                check_readings(replace(altered, source=ImuSource(gyro_axes=Axes.parse(stated))))
            assert str(settings(str(caught.value))["gyro"]) == true


def test_a_wrong_unit_of_a_slow_gyroscope_is_noticed_by_gravity(
    subtests: pytest.Subtests, recordings: dict[str, ImuRecording]
) -> None:
    for name in HANDHELD:
        with subtests.test(name=name):
            imu = recordings[name]
            for factor, unit in ((180 / np.pi, "deg/s"), (np.pi / 180, "rad/s")):
                with pytest.raises(FormatError, match=f'unit = "{unit}" under'):
                    check_consistent(replace(imu, gyro_rad_s=imu.gyro_rad_s * factor))


def test_a_gyroscope_in_a_moving_car_and_one_in_strong_shake_are_accepted(shared_data: Path) -> None:
    car = np.loadtxt(shared_data / "gyrostab/20200109_145447/gyro.txt", delimiter=",", usecols=(0, 1, 2))
    check_rates(car, Path("x"))
    rows = np.loadtxt(shared_data / "deepgyro/raw/imu/imu.txt")
    gyro, accel = rows[rows[:, 0] == 4], rows[rows[:, 0] == 1]
    imu = ImuRecording(
        gyro_t_s=gyro[:, 1] / 1e9, gyro_rad_s=gyro[:, 2:], accel_t_s=accel[:, 1] / 1e9, accel_m_s2=accel[:, 2:]
    )
    check_readings(imu)


def test_no_simulated_recording_is_refused() -> None:
    kinds = get_args(MotionKind)
    for seed in range(6 * len(kinds)):
        motion = MotionOptions(kind=kinds[seed % len(kinds)], duration_s=(60, 30, 20)[seed % 3])
        imu = list(IMU_PRESETS.values())[seed // len(kinds) % len(IMU_PRESETS)]
        check_readings(simulate_recording(RecordingOptions(motion=motion, imu=imu), seed=seed).imu)


def test_a_still_camera_is_accepted() -> None:
    rng = np.random.default_rng(0)
    t_s = np.arange(1000) / 100
    still = ImuRecording(
        gyro_t_s=t_s,
        gyro_rad_s=rng.normal(0.01, 1e-3, (1000, 3)),
        accel_t_s=t_s,
        accel_m_s2=rng.normal([0.2, 9.6, 0.5], 0.02, (1000, 3)),
    )
    check_readings(still)
