"""Declared rotation, time offset and lever arm against recordings that show others: which is named, and what it is."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_exp, quat_multiply
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.types import CameraImuCalibration, ImuCalibration, ScaleEstimate
from colmap_inertial.core.types.imu import IMU_CAL
from colmap_inertial.diagnose import Diagnosis, Recorded, diagnose
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.run.commands.scale import ScaleSource, scale_source
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, SimulatedRecording, simulate_recording

#: No rotation by half a turn or none, which are their own inverses.
TURNED = quat_exp(np.array([0.9, -0.7, 1.4]))


@dataclass(frozen=True)
class Device:
    """A recording whose IMU's axes and clock are turned and moved, and what is true of them."""

    made: SimulatedRecording
    recorded: Recorded
    rotation: np.ndarray
    offset_s: float
    arm_m: np.ndarray

    def diagnosed(self, declared: Declared) -> Diagnosis:
        return diagnose(replace(self.recorded, calibration=calibration_prior(declared)))


@pytest.fixture(scope="module", params=["orbit", "roam"])
def device(request: pytest.FixtureRequest) -> Device:
    made = simulate_recording(RecordingOptions(motion=MotionOptions(kind=request.param, duration_s=25.0)), seed=21)
    true, turn = made.truth.calibration, matrix_from_quat(TURNED)
    imu = replace(
        made.imu,
        gyro_rad_s=made.imu.gyro_rad_s @ turn,
        accel_m_s2=made.imu.accel_m_s2 @ turn,
        gyro_t_s=made.imu.gyro_t_s + true.gyro_time_offset_s - 0.08,
        accel_t_s=made.imu.accel_t_s + true.gyro_time_offset_s - 0.08,
        noise=None,
    )
    return Device(
        made=made,
        recorded=Recorded(imu=imu, trajectory=made.trajectory),
        rotation=quat_multiply(true.cam_from_imu_xyzw, TURNED),
        offset_s=0.08,
        arm_m=true.imu_in_cam_m,
    )


def named(told: Diagnosis, code: str) -> tuple[str, str] | None:
    """Severity and likely mistake of a finding; ``None`` where it is not there."""
    found = [(one.severity, str(one.fact.values["likely"])) for one in told.findings if one.code == code]
    assert len(found) < 2
    return found[0] if found else None


def test_what_is_declared_rightly_is_not_contradicted(device: Device) -> None:
    told = device.diagnosed(Declared(cam_from_imu_xyzw=device.rotation, gyro_time_offset_s=device.offset_s))
    assert told.findings == ()


@pytest.mark.parametrize("likely", ["inverse", "order", "axes", ""])
def test_a_wrong_rotation_is_named_first_with_what_it_is(device: Device, likely: str) -> None:
    wrong = {
        "inverse": quat_conjugate(device.rotation),
        "order": np.roll(device.rotation, 1),
        "axes": quat_multiply(np.array([1.0, 0.0, 0.0, 0.0]), device.rotation),
        "": quat_multiply(quat_exp(np.array([0.3, -0.9, 0.4])), device.rotation),
    }[likely]
    told = device.diagnosed(Declared(cam_from_imu_xyzw=wrong, gyro_time_offset_s=device.offset_s))
    assert named(told, "declared-rotation") == ("error", likely)
    # and nothing else is accused
    assert [one.code for one in told.findings] == ["declared-rotation"]


@pytest.mark.parametrize(
    ("declared_s", "likely", "severity"),
    [(-0.08, "sign", "error"), (80.0, "milliseconds", "error"), (0.3, "", "error"), (0.11, "", "warning")],
)
def test_a_wrong_time_offset_is_named_with_what_it_is(
    device: Device, declared_s: float, likely: str, severity: str
) -> None:
    told = device.diagnosed(Declared(cam_from_imu_xyzw=device.rotation, gyro_time_offset_s=declared_s))
    assert named(told, "declared-offset") == (severity, likely)
    (found,) = told.findings
    assert found.numbers["found_s"] == pytest.approx(device.offset_s, abs=4 * found.numbers["sigma_s"])


def test_a_rotation_that_is_off_by_some_degrees_is_a_warning(device: Device) -> None:
    askew = quat_multiply(quat_exp(np.array([0.0, 0.1, 0.0])), device.rotation)
    told = device.diagnosed(Declared(cam_from_imu_xyzw=askew))
    assert named(told, "declared-rotation") == ("warning", "")
    (found,) = told.findings
    assert found.numbers["angle_deg"] == pytest.approx(np.degrees(0.1), abs=1.0)


# --- lever arms ------------------------------------------------------------------------------------------------------


def with_arm(device: Device, arm_m: np.ndarray) -> tuple[CameraImuCalibration, ScaleEstimate]:
    prior = calibration_prior(Declared(cam_from_imu_xyzw=device.rotation, imu_in_cam_m=arm_m))
    assert device.recorded.trajectory is not None and device.recorded.imu is not None
    return prior, estimate_scale(device.recorded.trajectory, device.recorded.imu, calibration=prior)


def test_a_wrong_lever_arm_is_named_and_left_out(device: Device) -> None:
    assert device.recorded.trajectory is not None and device.recorded.imu is not None
    alone = estimate_scale(device.recorded.trajectory, device.recorded.imu)
    _, right = with_arm(device, device.arm_m)
    assert "declared-lever-arm" not in {reason.code for reason in right.reasons}
    _, wrong = with_arm(device, device.arm_m + np.array([0.12, -0.1, 0.08]))
    (reason,) = (reason for reason in wrong.reasons if reason.code == "declared-lever-arm")
    assert wrong.verdict == "weak"
    assert np.array(reason.values["found_m"]) == pytest.approx(device.arm_m, abs=3 * reason.values["sigma_m"])
    assert wrong.metres_per_unit == pytest.approx(alone.metres_per_unit, rel=1e-3)
    truth = device.made.truth.metres_per_unit
    assert abs(np.log(wrong.metres_per_unit / truth)) < 1.96 * wrong.sigma_log


@pytest.mark.parametrize("likely", ["inverse", "sign", "millimetres", ""])
def test_a_wrong_lever_arm_is_named_by_what_it_is(device: Device, likely: str) -> None:
    arm_m = {
        "inverse": -matrix_from_quat(device.rotation).T @ device.arm_m,
        "sign": -device.arm_m,
        "millimetres": 1e3 * device.arm_m,
        "": np.array([0.3, -0.9, 0.2]),
    }[likely]
    _, wrong = with_arm(device, arm_m)
    (reason,) = (reason for reason in wrong.reasons if reason.code == "declared-lever-arm")
    assert reason.values["likely"] == likely and wrong.reasons[0] == reason
    assert np.array(reason.values["found_m"]) == pytest.approx(device.arm_m, abs=3 * reason.values["sigma_m"])
    truth = device.made.truth.metres_per_unit
    assert wrong.verdict == "weak" and abs(np.log(wrong.metres_per_unit / truth)) < 1.96 * wrong.sigma_log


def test_gains_of_another_imu_are_named(device: Device) -> None:
    assert device.recorded.trajectory is not None and device.recorded.imu is not None
    other = ImuCalibration(
        accel_gain=np.diag([0.04, 0.04, 0.04]),
        accel_bias_m_s2=np.zeros(3),
        gyro_gain=np.zeros((3, 3)),
        gyro_bias_rad_s=np.zeros(3),
        cov=1e-6 * np.eye(IMU_CAL.COUNT),
        gravity_m_s2=9.80665,
        attitudes=12,
    )
    estimate = estimate_scale(device.recorded.trajectory, device.recorded.imu, imu_calibration=other)
    assert estimate.verdict == "weak"
    (reason,) = (reason for reason in estimate.reasons if reason.code == "calibrated-gain-contradicted")
    # what it makes too long
    assert np.mean(reason.values["gains"]) == pytest.approx(0.04, abs=0.015)


# --- pasted from other programs --------------------------------------------------------------------------------------

PASTED = Path(__file__).parents[3] / "shared/cases/recordings/c20_kalibr_vins_yaml"


@pytest.mark.skipif(not PASTED.is_dir(), reason="needs the shared cases")
@pytest.mark.parametrize(
    ("declared", "code", "likely"),
    [
        ("right", None, None),
        ("inverse", "declared-rotation", "inverse"),
        ("sign", "declared-offset", "sign"),
        ("sign10", "declared-offset", "sign"),
        ("lever", "declared-lever-arm", "inverse"),
    ],
)
def test_what_is_pasted_from_kalibr_is_named_by_its_cause(declared: str, code: str | None, likely: str | None) -> None:
    source = ScaleSource(source=PASTED / "traj.tum", imu=PASTED / f"{declared}.toml")
    estimate = scale_source(source, ScaleOptions())
    stated = [fact for fact in (*estimate.reasons, *estimate.notes) if fact.code != "force-goes-on"]
    facts = [fact.values.get("finding", fact) for fact in stated]
    named = [fact for fact in facts if fact.code.startswith("declared")]
    assert [fact.code for fact in named] == ([code] if code else [])
    assert [fact.values["likely"] for fact in named] == ([likely] if likely else [])
    # named first, and no wrong number
    assert not named or facts[0] == named[0]
    if declared in ("inverse", "sign"):
        assert estimate.metres_per_unit is None and estimate.reasons[-1].code == "force-goes-on"
        return
    assert estimate.metres_per_unit is not None and estimate.sigma_log is not None
    # by the data set's ground truth
    assert abs(np.log(estimate.metres_per_unit / 0.02572)) < 1.96 * estimate.sigma_log < 0.03
