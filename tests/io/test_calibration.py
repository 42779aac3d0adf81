"""Calibrations: what is known before an estimate, and their file."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.types import CALIBRATION_PARAMETERS, CameraImuCalibration
from colmap_inertial.io.calibration import (
    Declared,
    calibration_prior,
    largest_offset_s,
    read_calibration,
    reset_for_recording,
    write_calibration,
)
from tests.helpers.cases import loop_over
from tests.helpers.json_schemas import find_violations


def known() -> CameraImuCalibration:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(12, 12)) * 1e-3
    return CameraImuCalibration(
        cam_from_imu_xyzw=np.array([0.5, -0.5, 0.5, 0.5]),
        gyro_time_offset_s=12.25,
        accel_time_offset_s=12.24,
        gyro_bias_rad_s=np.array([0.01, 0.02, -0.01]),
        imu_in_cam_m=np.array([0.03, 0.01, 0.0]),
        readout_s=0.021,
        cov=root @ root.T,
    )


def sd_of_delay(calibration: CameraImuCalibration) -> float:
    row = np.zeros(12)
    row[3:5] = -1, 1
    return float(np.sqrt(row @ calibration.cov @ row))


def test_the_file_keeps_every_bit(tmp_path: Path) -> None:
    write_calibration(tmp_path / "c.json", known())
    assert find_violations("calibration", tmp_path / "c.json") == []
    back = read_calibration(tmp_path / "c.json")
    for name, value in vars(known()).items():
        np.testing.assert_array_equal(getattr(back, name), value)
    assert json.loads((tmp_path / "c.json").read_text())["cov_parameters"] == list(CALIBRATION_PARAMETERS)


def test_a_clock_rate_is_kept_and_clocks_that_keep_step_leave_no_trace(tmp_path: Path) -> None:
    drifting = replace(known(), clock_rate=-2e-3, clock_middle_s=17.5)
    write_calibration(tmp_path / "c.json", drifting)
    back = read_calibration(tmp_path / "c.json")
    assert (back.clock_rate, back.clock_middle_s) == (-2e-3, 17.5)
    assert back.drift_s(np.array([17.5, 27.5])).tolist() == [0.0, -0.02]
    assert reset_for_recording(back, shared_clock=True).clock_rate == 0
    write_calibration(tmp_path / "c.json", known())
    assert not {"clock_rate", "clock_middle_s"} & json.loads((tmp_path / "c.json").read_text()).keys()


def test_the_search_for_a_shared_clock_s_offset_is_narrow_unless_asked_otherwise() -> None:
    assert largest_offset_s(True) == 1.0 and largest_offset_s(False) is None
    assert largest_offset_s(True, 5.0) == largest_offset_s(False, 5.0) == 5.0


@loop_over(
    ("change", "said"),
    [
        ({"readout_s": None}, "missing: readout_s"),
        ({"extra": 1}, "unknown: extra"),
        ({"readout_s": "fast"}, "readout_s"),
        ({"readout_s": [1]}, "single number"),
        ({"clock_rate": [1]}, "single number"),
        ({"clock_rate": 1.5}, "clock_rate"),
        ({"cam_from_imu_xyzw": [1, 1, 1, 1]}, "unit norm"),
        ({"gyro_bias_rad_s": [1, 2]}, "gyro_bias_rad_s"),
        ({"cov": [[1.0, 2.0], [3.0]]}, "shape"),
        ({"cov_parameters": ["a"]}, "cov_parameters"),
    ],
)
def test_a_wrong_file_names_the_field(tmp_path: Path, change: dict[str, object], said: str) -> None:
    write_calibration(tmp_path / "c.json", known())
    values = json.loads((tmp_path / "c.json").read_text()) | change
    (tmp_path / "c.json").write_text(json.dumps({key: value for key, value in values.items() if value is not None}))
    with pytest.raises(FormatError, match=said):
        read_calibration(tmp_path / "c.json")


def test_where_nothing_is_known_the_prior_is_wide_but_ties_the_sensors_together() -> None:
    prior = calibration_prior()
    assert prior.sigma("rotation_x_rad") == pytest.approx(np.pi)
    assert prior.sigma("gyro_time_offset_s") == pytest.approx(1e4)
    assert sd_of_delay(prior) == pytest.approx(0.02, rel=0.1)
    assert prior.sigma("imu_in_cam_x_m") == pytest.approx(0.08)
    assert prior.sigma("readout_s") == pytest.approx(0.02)
    np.linalg.cholesky(prior.cov)
    shared = calibration_prior(shared_clock=True)
    assert shared.sigma("gyro_time_offset_s") == pytest.approx(0.1)
    assert sd_of_delay(shared) == pytest.approx(0.02)


def test_what_is_known_is_narrow() -> None:
    prior = calibration_prior(
        Declared(cam_from_imu_xyzw=[0, 0, 0, 1], imu_in_cam_m=[0.1, 0, 0], gyro_time_offset_s=3.0, readout_s=0.0)
    )
    assert prior.sigma("rotation_z_rad") == pytest.approx(0.01)
    assert prior.sigma("imu_in_cam_x_m") == pytest.approx(0.005)
    assert prior.accel_time_offset_s == 3.0
    assert sd_of_delay(prior) == pytest.approx(0.02)
    assert prior.sigma("gyro_time_offset_s") == pytest.approx(0.002)
    np.linalg.cholesky(prior.cov)


def test_the_next_recording_of_a_device_keeps_the_delay_and_opens_the_offset() -> None:
    before = known()
    prior = reset_for_recording(before)
    assert prior.sigma("gyro_time_offset_s") == pytest.approx(1e4)
    assert prior.accel_time_offset_s - prior.gyro_time_offset_s == pytest.approx(-0.01)
    shared = reset_for_recording(before, shared_clock=True)
    assert shared.gyro_time_offset_s == 12.25
    assert sd_of_delay(shared) == pytest.approx(sd_of_delay(before))
    np.testing.assert_allclose(shared.cov[:3, :3], before.cov[:3, :3])
    np.testing.assert_allclose(shared.cov[8:, 8:], before.cov[8:, 8:])
    np.testing.assert_array_equal(prior.imu_in_cam_m, before.imu_in_cam_m)


def test_an_offset_of_one_sensor_carries_the_other_s(subtests) -> None:
    for said, offsets_s, gyro_s, accel_s, delay_s in (
        ({"gyro_time_offset_s": 3.0}, (3.0, 3.0), 0.002, np.hypot(0.002, 0.02), 0.02),
        ({"accel_time_offset_s": 3.0}, (3.0, 3.0), np.hypot(0.002, 0.02), 0.002, 0.02),
        ({"gyro_time_offset_s": 3.0, "accel_time_offset_s": 3.5}, (3.0, 3.5), 0.002, 0.002, 0.002 * 2**0.5),
        ({"gyro_time_offset_s": 3.0, "time_offset_sigma_s": 0.1}, (3.0, 3.0), 0.1, np.hypot(0.1, 0.02), 0.02),
    ):
        with subtests.test(said=said, offsets_s=offsets_s, gyro_s=gyro_s, accel_s=accel_s, delay_s=delay_s):
            prior = calibration_prior(Declared(**said))
            assert (prior.gyro_time_offset_s, prior.accel_time_offset_s) == offsets_s
            assert prior.sigma("gyro_time_offset_s") == pytest.approx(gyro_s)
            assert prior.sigma("accel_time_offset_s") == pytest.approx(accel_s)
            assert sd_of_delay(prior) == pytest.approx(delay_s)


def test_what_is_stated_is_as_sure_as_it_is_said_to_be() -> None:
    said = Declared(
        cam_from_imu_xyzw=[0, 0, 0, 1], rotation_sigma_rad=0.02, imu_in_cam_m=[0.1, 0.2, 0.3],
        imu_in_cam_sigma_m=0.03, gyro_bias_rad_s=[0.01, 0.02, 0.03], gyro_bias_sigma_rad_s=0.004,
    )  # fmt: skip
    prior = calibration_prior(said)
    for axis, lever, bias in zip("xyz", (0.1, 0.2, 0.3), (0.01, 0.02, 0.03), strict=True):
        assert prior.sigma(f"rotation_{axis}_rad") == pytest.approx(0.02)
        assert prior.sigma(f"imu_in_cam_{axis}_m") == pytest.approx(0.03)
        assert prior.sigma(f"gyro_bias_{axis}_rad_s") == pytest.approx(0.004)
        assert prior.imu_in_cam_m["xyz".index(axis)] == lever and prior.gyro_bias_rad_s["xyz".index(axis)] == bias
    # two per cent of a readout, and at least a tenth of a millisecond
    for readout_s, sigma_s in ((0.03, 6e-4), (0.001, 1e-4), (0.0, 1e-4), (None, 0.02)):
        prior = calibration_prior(Declared(readout_s=readout_s))
        assert prior.sigma("readout_s") == pytest.approx(sigma_s) and prior.readout_s == (readout_s or 0.0)


def test_in_the_next_recording_offsets_lie_where_the_delay_has_them() -> None:
    """The scatter of accelerometers' offsets around gyroscopes' is that of before, whatever the gyroscopes' are."""
    before = known()
    root = np.random.default_rng(1).standard_normal((before.cov.shape[0],) * 2)
    before = replace(before, cov=1e-4 * root @ root.T)
    rng = np.random.default_rng(2)
    drawn = rng.multivariate_normal(np.zeros(len(before.cov)), before.cov, 40_000)
    delay = drawn[:, 4] - drawn[:, 3]
    offset = 0.1 * rng.standard_normal(len(delay))  # of a shared clock: to a tenth of a second
    after = reset_for_recording(before, shared_clock=True)
    expected = np.cov(np.stack([offset, offset + delay, *drawn[:, :3].T, *drawn[:, 8:].T]))
    places = [3, 4, 0, 1, 2, *range(8, len(before.cov))]
    sigma = np.sqrt(np.diagonal(expected))
    assert np.abs((after.cov[np.ix_(places, places)] - expected) / np.outer(sigma, sigma)).max() < 0.03
    assert not after.cov[5:8, [0, 1, 2, 3, 4, 8, 9, 10, 11]].any()
