"""Calibrations of other programs: direction of transforms, sign of the clock's shift, origin of pixels."""

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.io.calibration import calibration_kind, read_calibration, read_for_recording
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.device_yaml import read_device_yaml

C, S = np.cos(0.3), np.sin(0.3)
CAM_FROM_IMU = np.array([[0, -C, S, 0.02], [-1, 0, 0, -0.03], [0, -S, -C, 0.05], [0, 0, 0, 1.0]])
IMU_FROM_CAM = np.linalg.inv(CAM_FROM_IMU)
SHIFT_S = 0.013


def rows(matrix):
    return "".join(f"\n  - {row.tolist()}" for row in matrix)


def opencv(matrix):
    r, c = matrix.shape
    return f"!!opencv-matrix\n   rows: {r}\n   cols: {c}\n   dt: d\n   data: {matrix.ravel().tolist()}"


LENS = "camera_model: pinhole\n  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]\n  distortion_model: radtan"
LENS += "\n  intrinsics: [500.0, 501.0, 319.5, 239.5]\n  resolution: [640, 480]"
VINS_LENS = """model_type: PINHOLE
camera_name: camera
image_width: 640
image_height: 480
distortion_parameters: {k1: 0.1, k2: -0.2, p1: 0.001, p2: 0.002}
projection_parameters: {fx: 500.0, fy: 501.0, cx: 319.5, cy: 239.5}
"""
SHEETS = {
    "kalibr": f"cam0:\n  T_cam_imu:{rows(CAM_FROM_IMU)}\n  {LENS}\n  timeshift_cam_imu: {SHIFT_S}\n",
    "openvins": f"%YAML:1.0\n\ncam0:\n  T_imu_cam: # from camera{rows(IMU_FROM_CAM)}\n  {LENS}\n"
    f"  timeshift_cam_imu: {SHIFT_S}\n",
    "vins-mono": f"%YAML:1.0\n\n{VINS_LENS}estimate_extrinsic: 0\nextrinsicRotation: {opencv(IMU_FROM_CAM[:3, :3])}\n"
    f"extrinsicTranslation: {opencv(IMU_FROM_CAM[:3, 3:])}\ntd: {SHIFT_S}\n",
    "vins-fusion": f"%YAML:1.0\n\n{VINS_LENS}estimate_extrinsic: 1\n"
    f"body_T_cam0: {opencv(IMU_FROM_CAM)}\ntd: {SHIFT_S}\n",
}


@pytest.mark.parametrize("program", SHEETS)
def test_each_program_s_sheet_is_the_same_calibration(tmp_path, program):
    path = tmp_path / "sheet.yaml"
    path.write_text(SHEETS[program])
    assert calibration_kind(path) == "camera-imu"
    for calibration in (read_calibration(path), read_for_recording(path).camera_imu):
        np.testing.assert_allclose(matrix_from_quat(calibration.cam_from_imu_xyzw), CAM_FROM_IMU[:3, :3], atol=1e-9)
        np.testing.assert_allclose(calibration.imu_in_cam_m, CAM_FROM_IMU[:3, 3], atol=1e-9)
        assert calibration.gyro_time_offset_s == -SHIFT_S
    camera = read_device_yaml(path).camera()
    assert camera.model == "OPENCV" and camera.params == (500.0, 501.0, 320.0, 240.0, 0.1, -0.2, 0.001, 0.002)
    (tmp_path / "imu.csv").write_text("t [s],gx [rad/s]\n")
    (tmp_path / "capture.toml").write_text('[camera]\nsensor_yaml = "sheet.yaml"\n[imu]\npath = "imu.csv"\n')
    prior = load_capture(tmp_path).calibration
    np.testing.assert_allclose(prior.imu_in_cam_m, CAM_FROM_IMU[:3, 3], atol=1e-9)
    assert prior.gyro_time_offset_s == -SHIFT_S


def test_a_pose_to_refine_is_less_sure(tmp_path):
    variances = []
    for name in ("vins-mono", "vins-fusion"):
        path = tmp_path / f"{name}.yaml"
        path.write_text(SHEETS[name])
        variances.append(np.trace(read_calibration(path).cov[:3, :3]))
    assert variances[1] > 10 * variances[0]
    path.write_text(SHEETS["vins-fusion"].replace("estimate_extrinsic: 1", "estimate_extrinsic: 2"))
    assert np.trace(read_calibration(path).cov[:3, :3]) > 10


def test_of_several_cameras_one_is_named(tmp_path):
    path = tmp_path / "chain.yaml"
    second = f"cam1:\n  T_cn_cnm1:{rows(np.eye(4))}\n  {LENS.replace('500.0', '600.0')}\n"
    path.write_text(SHEETS["kalibr"] + second)
    with pytest.raises(FormatError, match=r"several cameras \(cam0, cam1\)"):
        read_calibration(path)
    camera = read_device_yaml(path, "cam1")
    np.testing.assert_allclose(camera.cam_from_imu, CAM_FROM_IMU)
    (tmp_path / "imu.csv").write_text("")
    text = '[camera]\nsensor_yaml = "chain.yaml"\ncamera = "cam1"\n[imu]\npath = "imu.csv"\n'
    (tmp_path / "capture.toml").write_text(text)
    assert load_capture(tmp_path).camera.params[0] == 600.0


def test_camera_info_is_the_camera_alone(tmp_path):
    path = tmp_path / "ost.yaml"
    path.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: c\n"
        "camera_matrix:\n  rows: 3\n  cols: 3\n  data: [500.0, 0, 319.5, 0, 501.0, 239.5, 0, 0, 1]\n"
        "distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.1, 0.2, 0, 0, 0.3]\n"
    )
    camera = read_device_yaml(path).camera()
    assert camera.model == "FULL_OPENCV" and camera.params[2:4] == (320.0, 240.0) and camera.params[8] == 0.3
    with pytest.raises(FormatError) as refused:
        read_calibration(path)
    assert refused.value.code == "calibration-without-imu"


@pytest.mark.parametrize(
    "text", ["a: 1\n", "- 1\n", "cam0: {intrinsics: [1]}\n", "cam0:\n  T_cam_imu: [1, 2]\n", "%YAML:1.0\n"]
)
def test_other_sheets_are_refused(tmp_path, text):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(FormatError):
        read_calibration(path)


def test_messages_one_after_another_are_one_sheet(tmp_path):
    info = "width: 640\nheight: 480\ndistortion_model: plumb_bob\nd: [0.1, 0.2, 0.0, 0.0, 0.0]\n"
    info += "k: [500.0, 0.0, 319.5, 0.0, 501.0, 239.5, 0.0, 0.0, 1.0]\n---\n"
    path = tmp_path / "echo.yaml"
    path.write_text(f"header: {{frame_id: a, stamp: 1}}\n{info}header: {{frame_id: a, stamp: 2}}\n{info}")
    assert read_device_yaml(path).camera().params[:4] == (500.0, 501.0, 320.0, 240.0)
    path.write_text(info + info.replace("500.0", "510.0"))
    with pytest.raises(FormatError, match="2 documents differ"):
        read_device_yaml(path)


def test_a_report_is_no_calibration(tmp_path):
    path = tmp_path / "results-imucam.txt"
    path.write_text("Calibration results\n===================\nT_ci:  (imu0 to cam0):\n[[ 0.0 -1.0 0.0 0.03]\n")
    with pytest.raises(FormatError) as caught:
        read_calibration(path)
    assert caught.value.fact.code == "calibration-unknown"
