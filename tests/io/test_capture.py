"""capture.toml: every key does what its description says, and every mistake is named."""

import re
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp
from colmap_inertial.io.calibration import Declared, calibration_prior, write_calibration
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.capture_tables import ImuPath, ImuTables
from colmap_inertial.io.frame_sources import ImageFolder, Video
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.sensor_yaml import CAMERA_MODELS
from colmap_inertial.io.toml_section import parse_toml
from tests.helpers.asl_imu import HEADER, handheld, rows, write_csv
from tests.helpers.cases import loop_over

IMU = '[imu]\npath = "imu.csv"\n'


def write(folder: Path, text: str) -> Path:
    (folder / "capture.toml").write_text(text)
    return folder / "capture.toml"


#: Every table and key, also those that exclude each other.
EVERYTHING = """\
[images]                        # a folder of pictures ...
folder = "frames"
pattern = "*_0.jpg"             # default: every picture in the folder
times = "name"                  # the number in each file name is its time; or a CSV file: "frames.csv"
time_unit = "ns"                # s, ms, us, ns; for a CSV only where its header does not say
video = "clip.mp4"              # optional: the frames were cut from it; "diagnose" finds them there

[video]                         # ... or a video; its own presentation stamps time the frames. A video with an IMU
file = "clip.mp4"               # inside (GoPro, CAMM) needs no more than: video = "GX010001.MP4"
frame_times = "clip_times.csv"  # optional: the recorder's own time of each frame, in place of the stamps
time_unit = "ns"                # of frame_times, where its header does not say
frames_per_s = 5                # optional: use about this many

[timing]
exposure_s = 0.004              # one exposure for all frames, where known
readout_s = 0.021               # first to last row (rolling shutter); 0 = global shutter; leave out if unknown
readout_direction = "down"      # down, up, right, left in the stored picture
shared_clock = false            # true: frame times and IMU stamps come from one clock

[camera]                        # leave out to let COLMAP calibrate
model = "OPENCV"                # a COLMAP model
width = 1920
height = 1080
params = [1500.0, 1500.0, 960.0, 540.0, 0.0, 0.0, 0.0, 0.0]
pixel_origin = "corner"         # corner: COLMAP (top-left pixel's centre is 0.5, 0.5); center: OpenCV, Kalibr
# or: sensor_yaml = "mav0/cam0/sensor.yaml"   (EuRoC; its T_BS also gives the calibration)

[imu]
path = "mav0/imu0"              # whatever read_imu knows, found by content
format = "auto"

[imu.gyro]                      # or, without path: any table, described
file = "imu.csv"
time = "t"                      # a name in the header, or a column number counted from 1
time_unit = "s"
columns = ["gx", "gy", "gz"]
unit = "rad/s"                  # rad/s, deg/s
axes = "y,-x,z"                 # x = the file's y, y = minus its x, z = its z
mirrored = false                # true allows axes that change handedness (a left-handed file)

[imu.accel]                     # may be missing: then no scale and no gravity, but deblurring
file = "imu.csv"
time = "t"
time_unit = "s"
columns = ["ax", "ay", "az"]
unit = "m/s2"                   # m/s2, g

[imu.noise]                     # data sheet, where known
gyro_density_rad_s_rthz = 3e-4
accel_density_m_s2_rthz = 2e-3
gyro_walk_rad_s2_rthz = 2e-5
accel_walk_m_s3_rthz = 3e-3

[calibration]                   # all optional; what is missing is estimated
file = "phone_calibration.json" # from "colmap-inertial align" of the same device; or:
cam_from_imu = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]   # 3x3, or 4x4 with the lever arm; or cam_from_imu_xyzw
rotation_sigma_rad = 0.01
imu_in_cam_m = [0.03, 0.01, 0.0]
imu_in_cam_sigma_m = 0.005
gyro_time_offset_s = 0.0        # t_cam = t_stamp + offset
accel_time_offset_s = 0.0
time_offset_sigma_s = 0.002
gyro_bias_rad_s = [0.0, 0.0, 0.0]
gyro_bias_sigma_rad_s = 0.002

[target]
spec = "checkerboard:8x6:0.03"  # validated at the end of a reconstruction
"""


def test_every_key_is_read(tmp_path: Path) -> None:
    text = EVERYTHING
    write_calibration(tmp_path / "phone_calibration.json", calibration_prior())
    with pytest.raises(FormatError, match="not both"):
        load_capture(write(tmp_path, text))
    text = re.sub(r"\[video\].*?(?=\[timing\])", "", text, flags=re.S)
    tables = re.sub(r'\npath = "mav0/imu0".*?format = "auto"', "", text, flags=re.S)
    with pytest.raises(FormatError, match=r"\[calibration\] file"):
        load_capture(write(tmp_path, tables))
    tables = re.sub(r'\nfile = "phone_calibration.json".*?\n', "\n", tables)
    capture = load_capture(write(tmp_path, tables))
    assert isinstance(capture.imu, ImuTables)
    assert capture.frames == ImageFolder(
        folder=tmp_path / "frames", pattern="*_0.jpg", times="name", time_unit="ns", video=tmp_path / "clip.mp4"
    )
    assert capture.exposure_s == 0.004 and capture.readout_s == 0.021 and not capture.shared_clock
    assert capture.camera is not None and capture.camera.params[:4] == (1500, 1500, 960, 540)
    assert capture.target == "checkerboard:8x6:0.03"
    assert str(capture.imu.gyro_axes) == "y,-x,z"
    assert capture.imu.noise is not None and capture.imu.noise.gyro_density_rad_s_rthz == 3e-4


def test_a_video_capture(tmp_path: Path) -> None:
    text = '[video]\nfile = "a.mp4"\nframe_times = "a.txt"\ntime_unit = "ns"\nframes_per_s = 5\n'
    capture = load_capture(write(tmp_path, text))
    assert capture.frames == Video(
        file=tmp_path / "a.mp4", frame_times=tmp_path / "a.txt", time_unit="ns", frames_per_s=5
    )
    assert capture.imu is None and capture.camera is None


@loop_over(
    ("text", "said"),
    [
        ('[images]\nfolder = "a"\nfodler = "b"\n', r'line 3: \[images\] fodler: unknown key; did you mean "folder"'),
        ('[image]\nfolder = "a"\n', r'line 1: .*image: unknown key; did you mean "images"'),
        ("[images]\n", r"line 1: \[images\]: folder is missing"),
        ('[images]\nfolder = "a"\ntimes = "name"\n', r"line 3: \[images\] times: .*time_unit"),
        ('[images]\nfolder = "a"\ntimes = "name"\ntime_unit = "min"\n', r"line 4: .*'s', 'ms', 'us', 'ns'.*'min'"),
        ('[images]\nfolder = "a"\npattern = "../*"\n', r"line 3: .*stay inside"),
        ("[images]\nfolder = 3\n", r"line 2: .*string in quotes"),
        ('[video]\nfile = "a"\nframes_per_s = 0\n', r"line 3: .*above 0"),
        (IMU + "[timing]\nreadout_s = 25\n", r"line 4: \[timing\] readout_s: must be from 0 to 0.5"),
        (IMU + "[timing]\nexposure_s = nan\n", r"line 4: .*finite"),
        (IMU + '[timing]\nshared_clock = "yes"\n', r"line 4: .*true or false"),
        (IMU + '[timing]\nreadout_direction = "sideways"\n', r"line 4: .*'down', 'up'"),
        (IMU + "[timing\n", r"line 3: not valid TOML"),
        ("[timing]\nreadout_s = 0.0\n", "neither frames"),
        ("imu = 3\n", r"line 1: .*must be a table"),
        (IMU + '[camera]\nmodel = "OPENCV"\n', r"line 3: \[camera\]: width is missing"),
        (
            IMU + '[camera]\nmodel = "PINHOLE"\nwidth = 4\nheight = 4\nparams = [1, 1, 2]\npixel_origin = "corner"\n',
            "line 7: .*PINHOLE has 4 parameters, found 3",
        ),
        (
            IMU + '[camera]\nmodel = "PINHOLE"\nwidth = 4\nheight = 4\nparams = [1, 1, 2, 2]\n',
            "line 3: .*pixel_origin is missing",
        ),
        (IMU + '[camera]\nsensor_yaml = "s.yaml"\nwidth = 4\n', "line 4: .*leave out"),
        (IMU + '[camera]\nsensor_yaml = "s.yaml"\n', "s.yaml: no such file"),
        ("[imu]\n", r"line 1: \[imu\]: needs path, or"),
        ('[imu]\nformat = "csv"\n', r"line 2: .*needs path"),
        ('[imu]\npath = "other/capture.toml"\n', "line 2: .*not another capture"),
        (IMU + '[imu.gyro]\nfile = "a"\n', r"line 4: \[imu.gyro\] file: .*leave one out"),
        (IMU + '[imu.gyro]\nunit = "m/s2"\n', r"line 4: .*'rad/s', 'deg/s'"),
        (IMU + '[imu.gyro]\naxes = "y,x,z"\n', "line 4: .*left-handed.*mirrored = true"),
        (IMU + '[imu.gyro]\naxes = "y,y,z"\n', "line 4: .*x, y and z once each"),
        (IMU + '[imu.gyro]\naxes = "y,-x"\n', "line 4: .*x, y and z once each"),
        (IMU + '[imu.gyro]\naxes = "x,y,z"\nmirrored = true\n', "line 5: .*handedness"),
        (IMU + "[imu.noise]\ngyro_density_rad_s_rthz = 1e-4\n", r"line 3: .*accel_density_m_s2_rthz is missing"),
        (IMU + "[calibration]\ncam_from_imu = [[1, 0], [0, 1]]\n", "line 4: .*3x3 or 4x4"),
        (IMU + "[calibration]\ncam_from_imu = [[1,0,0],[0,1,0],[0,0,-1]]\n", "line 4: .*right-handed"),
        (IMU + "[calibration]\ncam_from_imu_xyzw = [0, 0, 0, 2]\n", "line 4: .*length 1"),
        (IMU + "[calibration]\nimu_in_cam_m = [0, 0]\n", "line 4: .*3 numbers"),
        (IMU + '[calibration]\nfile = "c.json"\nrotation_sigma_rad = 1\n', "line 4: .*leave out"),
        (IMU + '[calibration]\nfile = "c.json"\n', "c.json: no such file"),
        (IMU + "[target]\n", r"line 3: \[target\]: spec is missing"),
    ],
)
def test_a_mistake_names_file_line_table_and_key(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(FormatError, match=said) as caught:
        load_capture(write(tmp_path, text))
    assert str(tmp_path) in str(caught.value)


def test_a_pose_is_a_matrix_with_or_without_a_place_or_a_quaternion(tmp_path: Path) -> None:
    turned = quat_exp(np.array([0.3, -0.4, 1.2]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = matrix_from_quat(turned), [0.01, -0.02, 0.03]
    lever = "imu_in_cam_m = [0.01, -0.02, 0.03]\n"
    for said in (
        f"cam_from_imu = {pose.tolist()}\n",
        f"cam_from_imu = {pose[:3, :3].tolist()}\n{lever}",
        f"cam_from_imu_xyzw = {turned.tolist()}\n{lever}",
    ):
        known = load_capture(write(tmp_path, IMU + "[calibration]\n" + said)).calibration
        assert known is not None
        assert np.abs(known.cam_from_imu_xyzw @ turned) == pytest.approx(1, abs=1e-12)
        assert known.imu_in_cam_m == pytest.approx(np.array([0.01, -0.02, 0.03]))
    for said, complaint in (
        (f"cam_from_imu = {pose.tolist()}\n{lever}", "give the same value; leave one out"),
        (f"cam_from_imu = {pose[:3, :3].tolist()}\ncam_from_imu_xyzw = {turned.tolist()}\n", "leave one out"),
        (f"cam_from_imu = {np.vstack([pose[:3], [0, 0, 0.1, 1]]).tolist()}\n", "last row"),
        (f"cam_from_imu = {pose[:3].tolist()}\n", "found 3x4"),
    ):
        with pytest.raises(FormatError, match=complaint):
            load_capture(write(tmp_path, IMU + "[calibration]\n" + said))


def test_intrinsics_count_from_the_corner_or_the_centre_of_the_first_pixel(tmp_path: Path) -> None:
    def camera(params: str, origin: str, model: str = "PINHOLE") -> tuple[float, ...]:
        said = f'[camera]\nmodel = "{model}"\nwidth = 40\nheight = 30\nparams = {params}\npixel_origin = "{origin}"\n'
        known = load_capture(write(tmp_path, IMU + said)).camera
        assert known is not None and (known.model, known.width, known.height) == (model, 40, 30)
        return known.params

    assert camera("[50, 51, 20, 15]", "corner") == (50, 51, 20, 15)
    assert camera("[50, 51, 20, 15]", "center") == (50, 51, 20.5, 15.5)
    assert camera("[50, 20, 15]", "center", "SIMPLE_PINHOLE") == (50, 20.5, 15.5)
    for params in ("[0, 51, 20, 15]", "[50, -1, 20, 15]"):
        with pytest.raises(FormatError, match="focal lengths must be above 0"):
            camera(params, "corner")
    assert camera("[50, 51, 0, -2]", "corner") == (50, 51, 0, -2)


@loop_over(
    ("gyro", "said"),
    [
        ('columns = ["gx", "gy"]', "three names"),
        ("columns = [1, 2, 3]", "none of them the time"),
        ("columns = [0, 2, 3]", "counted from 1"),
        ("columns = [2, 3, 40]", "column 40 does not exist"),
        ('columns = ["gx", "gy", "gz"]', 'has no column "gx"; the header is'),
    ],
)
def test_a_described_table_names_what_is_wrong(tmp_path: Path, gyro: str, said: str) -> None:
    write_csv(tmp_path / "imu.csv", rows(*handheld()))
    common = 'file = "imu.csv"\ntime = 1\ntime_unit = "ns"\n'
    text = f'[imu.gyro]\n{common}unit = "rad/s"\n{gyro}\n[imu.accel]\n{common}columns = [5, 6, 7]\nunit = "m/s2"\n'
    with pytest.raises(FormatError, match=said):
        read_imu(write(tmp_path, text))


def test_described_tables_give_units_axes_and_separate_times(tmp_path: Path) -> None:
    t_ns, gyro, accel = handheld()
    with open(tmp_path / "g.txt", "w") as file:
        for t, row in zip(t_ns, np.degrees(gyro), strict=True):
            print(*map(repr, row.tolist()), f"{int(t) // 10**9}.{int(t) % 10**9:09d}", file=file)
    with open(tmp_path / "a.txt", "w") as file:
        for t, row in zip(t_ns[::2] + 7, accel[::2] / 9.80665, strict=True):
            print(int(t), *map(repr, row.tolist()), sep=";", file=file)
    imu = read_imu(
        write(
            tmp_path,
            """
            [imu.gyro]
            file = "g.txt"
            time = 4
            time_unit = "s"
            columns = [1, 2, 3]
            unit = "deg/s"
            axes = "y,-x,z"
            [imu.accel]
            file = "a.txt"
            time = 1
            time_unit = "ns"
            columns = [2, 3, 4]
            unit = "g"
            axes = "y, -x, z"
            """,
        )
    )
    np.testing.assert_allclose(imu.gyro_rad_s, np.stack([gyro[:, 1], -gyro[:, 0], gyro[:, 2]], axis=1), rtol=1e-12)
    expected = np.stack([accel[::2, 1], -accel[::2, 0], accel[::2, 2]], axis=1)
    np.testing.assert_allclose(imu.accel_m_s2, expected, rtol=1e-12)
    assert [imu.epoch_ns + round(t * 1e9) for t in imu.gyro_t_s] == t_ns.tolist()
    assert [imu.epoch_ns + round(t * 1e9) for t in imu.accel_t_s] == (t_ns[::2] + 7).tolist()


def test_a_gyroscope_alone_is_read(tmp_path: Path) -> None:
    (tmp_path / "gyro.csv").write_text("".join(f"{0.01 * i:.2f},{i % 7},{i % 5},{i % 3}\n" for i in range(200)))
    table = 'file = "gyro.csv"\ntime = 1\ntime_unit = "s"\ncolumns = [2, 3, 4]\nunit = "deg/s"\naxes = "y,-x,z"\n'
    imu = read_imu(write(tmp_path, f"[imu.gyro]\n{table}"))
    assert not imu.has_accel
    np.testing.assert_allclose(imu.gyro_rad_s[:3], np.radians([[0, 0, 0], [1, -1, 1], [2, -2, 2]]))


def test_a_stated_unit_and_axes_correct_a_file_that_is_wrong(tmp_path: Path) -> None:
    t_ns, gyro, accel = handheld()
    write_csv(tmp_path / "imu.csv", rows(t_ns, np.degrees(gyro), accel * [-1, 1, 1] / 9.80665))
    with pytest.raises(FormatError, match=r'unit = "g" under \[imu.accel\]'):
        read_imu(tmp_path / "imu.csv")
    accel_table = '[imu.accel]\nunit = "g"\naxes = "-x,y,z"\nmirrored = true\n'
    imu = read_imu(write(tmp_path, IMU + '[imu.gyro]\nunit = "deg/s"\n' + accel_table))
    np.testing.assert_allclose(imu.gyro_rad_s, gyro, rtol=1e-12)
    np.testing.assert_allclose(imu.accel_m_s2, accel, rtol=1e-12)


def test_opencvs_principal_point_moves_by_half_a_pixel_in_every_model(tmp_path: Path) -> None:
    import pycolmap

    assert "OPENCV" in CAMERA_MODELS
    for model, (count, centre) in CAMERA_MODELS.items():
        if model not in pycolmap.CameraModelId.__members__:
            continue  # the last five came with COLMAP 4.2
        camera = pycolmap.Camera.create_from_model_name(1, model, 100.0, 64, 48)
        assert len(camera.params) == count
        assert list(camera.principal_point_idxs()) == [centre, centre + 1]
        params = [50.0 + i for i in range(count)]
        text = f'[camera]\nmodel = "{model}"\nwidth = 64\nheight = 48\nparams = {params}\npixel_origin = "center"\n'
        loaded = load_capture(write(tmp_path, IMU + text)).camera
        assert loaded is not None
        moved = np.array(loaded.params) - params
        assert moved.tolist() == [0.5 if centre <= i < centre + 2 else 0.0 for i in range(count)]


def test_calibration_matrix_gives_rotation_and_lever_arm(tmp_path: Path) -> None:
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec([0.3, -1.0, 2.0])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), [0.1, 0.2, 0.3]
    text = f"[calibration]\ncam_from_imu = {matrix.tolist()}\nrotation_sigma_rad = 0.003\n"
    calibration = load_capture(write(tmp_path, IMU + text)).calibration
    assert abs(calibration.cam_from_imu_xyzw @ rotation.as_quat()) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(calibration.imu_in_cam_m, [0.1, 0.2, 0.3])
    assert calibration.sigma("rotation_x_rad") == pytest.approx(0.003)
    assert calibration.sigma("imu_in_cam_x_m") == pytest.approx(0.005)
    alone = load_capture(write(tmp_path, IMU + f"[calibration]\ncam_from_imu = {matrix[:3, :3].tolist()}\n"))
    assert alone.calibration.sigma("imu_in_cam_x_m") == pytest.approx(0.08)


def test_a_calibration_file_is_a_prior_for_this_recording(tmp_path: Path) -> None:
    write_calibration(
        tmp_path / "c.json",
        calibration_prior(Declared(cam_from_imu_xyzw=[1, 0, 0, 0], gyro_time_offset_s=5.0, readout_s=0.02)),
    )
    calibration = load_capture(write(tmp_path, IMU + '[calibration]\nfile = "c.json"\n')).calibration
    assert calibration.cam_from_imu_xyzw.tolist() == [1, 0, 0, 0] and calibration.readout_s == 0.02
    assert calibration.sigma("gyro_time_offset_s") > 1e3


def test_euroc_sheets_give_camera_and_calibration(shared_data: Path, tmp_path: Path) -> None:
    root = shared_data / "euroc_v101"
    text = f"""
        [images]
        folder = "{root}/keyframes"
        pattern = "*_0.jpg"
        times = "name"
        time_unit = "ns"
        [timing]
        readout_s = 0.0
        shared_clock = true
        [camera]
        sensor_yaml = "{root}/mav0/cam0/sensor.yaml"
        [imu]
        path = "{root}"
        """
    capture = load_capture(write(tmp_path, text))
    assert capture.camera is not None and capture.camera.model == "OPENCV"
    np.testing.assert_allclose(capture.camera.params[:4], [458.654, 457.296, 367.715, 248.875])
    # T_BS = body_from_cam from the sheet; the IMU is the body
    np.testing.assert_allclose(
        capture.calibration.imu_in_cam_m,
        -np.array(
            [
                [0.0148655429818, 0.999557249008, -0.0257744366974],
                [-0.999880929698, 0.0149672133247, 0.00375618835797],
                [0.00414029679422, 0.025715529948, 0.999660727178],
            ]
        )
        @ [-0.0216401454975, -0.064676986768, 0.00981073058949],
        atol=1e-9,
    )
    assert capture.calibration.sigma("gyro_time_offset_s") == pytest.approx(0.1)
    assert isinstance(capture.imu, ImuPath) and read_imu(tmp_path).noise is not None


def test_dataset_folders_are_captures_where_that_is_unambiguous(shared_data: Path, tmp_path: Path) -> None:
    scene = load_capture(shared_data / "inertial_scale/D1")
    assert scene.frames is None and scene.imu is not None
    with pytest.raises(FormatError, match=r"describe it in a capture\.toml"):
        load_capture(shared_data / "euroc_v101")
    source = shared_data / "euroc_v101/mav0"
    for sensor in ("cam0", "imu0"):
        (tmp_path / "mav0" / sensor).mkdir(parents=True)
        sheet = (source / sensor / "sensor.yaml").read_bytes()
        (tmp_path / "mav0" / sensor / "sensor.yaml").write_bytes(sheet)
    (tmp_path / "mav0/cam0/data").mkdir()
    (tmp_path / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename\n")
    write_csv(tmp_path / "mav0/imu0/data.csv", rows(*handheld()), HEADER)
    capture = load_capture(tmp_path)
    assert capture.shared_clock and capture.camera is not None
    assert capture.calibration.sigma("rotation_x_rad") == pytest.approx(0.01)
    with pytest.raises(FormatError, match="no such file or folder"):
        load_capture(tmp_path / "absent")
    with pytest.raises(FormatError, match="toml"):
        load_capture(tmp_path / "mav0/imu0/data.csv")


@loop_over(
    ("change", "said"),
    [
        (("pinhole", "omni"), "camera_model 'omni'"),
        (("radial-tangential", "fov"), "distortion_model 'fov'"),
        (("458.654", "wide"), "intrinsics"),
        (("[752, 480]", "[752]"), "resolution"),
        (("0.0148655429818", "0.5"), "no rotation"),
        (("T_BS", "T_CB"), "no T_BS"),
        (("intrinsics: [", "intrinsics: [["), "not valid YAML"),
    ],
)
def test_a_wrong_sensor_sheet_names_the_entry(
    shared_data: Path, tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    sheet = (shared_data / "euroc_v101/mav0/cam0/sensor.yaml").read_text()
    assert change[0] in sheet
    (tmp_path / "sensor.yaml").write_text(sheet.replace(*change))
    with pytest.raises(FormatError, match=said):
        load_capture(write(tmp_path, IMU + '[camera]\nsensor_yaml = "sensor.yaml"\n'))


def test_equidistant_sheet_is_colmaps_fisheye(shared_data: Path, tmp_path: Path) -> None:
    sheet = (shared_data / "euroc_v101/mav0/cam0/sensor.yaml").read_text().replace("radial-tangential", "equidistant")
    (tmp_path / "sensor.yaml").write_text(sheet)
    camera = load_capture(write(tmp_path, IMU + '[camera]\nsensor_yaml = "sensor.yaml"\n')).camera
    assert camera is not None and camera.model == "OPENCV_FISHEYE"


def test_a_folder_with_a_recipe_names_the_command_that_renders_it():
    with pytest.raises(FormatError, match=r"simulate recipe\.toml"):
        load_capture(Path(__file__).parents[2] / "example_scenes" / "hopeless")


def test_a_key_of_many_parts_is_refused_and_a_text_with_many_dots_is_none(tmp_path: Path) -> None:
    deep = ".".join("a" * 32)
    assert parse_toml(tmp_path, f"{deep} = 1")["a"]["a"]
    for text in (f"{deep}.b = 1", f"[{deep}.b]", f'{deep}."b" = 1', f"x = {{ {deep} . b = 1 }}"):
        with pytest.raises(FormatError, match="more than 32 dotted parts"):
            parse_toml(tmp_path, text)
    dots = "." * 99
    for text in (f'x = "{dots}"', f"x = '{dots}'", f'x = """\n{dots}"""', f"x = '''{dots}'''"):
        assert parse_toml(tmp_path, f"{text} # {dots}") == {"x": dots}
    with pytest.raises(FormatError, match=r"line 2: not valid TOML"):
        parse_toml(tmp_path, "x = 1\ny = = 2")
