"""The file of an IMU's own calibration, several files of one device, and what is remembered of it."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial import calibrate_imu
from colmap_inertial.cli import main, parse
from colmap_inertial.core.errors import FormatError, OutputError
from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.core.types import ImuCalibration, ImuRecording
from colmap_inertial.io.calibration import (
    calibration_kind,
    calibration_prior,
    read_calibration,
    read_calibrations,
    read_imu_calibration,
    write_calibration,
    write_imu_calibration,
)
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.recording import correct_imu, prior_calibration
from colmap_inertial.run.commands import calibrate_imu as device_store
from colmap_inertial.run.commands.calibrate_imu import configuration_folder, read_remembered, remember
from colmap_inertial.run.steps.config import config_as_toml, read_config
from colmap_inertial.tools.simulate import RestOptions, simulate_rests
from tests.helpers.batch_captures import TINY, tiny_capture
from tests.helpers.cases import loop_over
from tests.helpers.json_schemas import find_violations

ROOT = Path(__file__).parents[3]


def known() -> ImuCalibration:
    rng = np.random.default_rng(7)
    root = rng.normal(size=(24, 24)) * 1e-4
    return ImuCalibration(
        accel_gain=np.tril(rng.normal(size=(3, 3)) * 0.01),
        accel_bias_m_s2=np.array([0.1, -0.2, 0.05]),
        gyro_gain=rng.normal(size=(3, 3)) * 0.01,
        gyro_bias_rad_s=np.array([0.01, 0.0, -0.02]),
        cov=root @ root.T,
        gravity_m_s2=9.807,
        device="My phone",
        attitudes=12,
    )


@pytest.fixture
def both(tmp_path: Path) -> tuple[Path, Path]:
    """A calibration of a camera and an IMU, and one of the IMU."""
    write_calibration(tmp_path / "phone.json", calibration_prior())
    write_imu_calibration(tmp_path / "phone_imu.json", known())
    return tmp_path / "phone.json", tmp_path / "phone_imu.json"


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user's configuration folder of our own."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("APPDATA", str(tmp_path / "config"))
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    return tmp_path / "config"


def write_table(path: Path, imu: ImuRecording) -> None:
    columns = np.column_stack([imu.gyro_t_s, imu.gyro_rad_s, imu.accel_m_s2])
    head = "t [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s2],ay [m/s2],az [m/s2]"
    np.savetxt(path, columns, fmt="%.9f", delimiter=",", header=head, comments="")


def run(capsys, *args) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stopped:
        main(list(map(str, args)))
    out, err = capsys.readouterr()
    return stopped.value.code, out, err


# --- the file --------------------------------------------------------------------------------------------------------


def test_the_file_keeps_every_bit(both) -> None:
    back = read_imu_calibration(both[1])
    for name, value in vars(known()).items():
        np.testing.assert_array_equal(getattr(back, name), value)
    assert [calibration_kind(path) for path in both] == ["camera-imu", "imu"]


def test_a_file_without_a_kind_is_one_of_camera_and_imu(both) -> None:
    values = json.loads(both[0].read_text())
    assert values.pop("kind") == "camera-imu"
    both[0].write_text(json.dumps(values))
    assert calibration_kind(both[0]) == "camera-imu"
    read_calibration(both[0])


@loop_over(
    ("change", "said"),
    [
        ({"kind": "camera"}, "holds no calibration of an IMU"),
        ({"cov_parameters": ["x"]}, "order of cov"),
        ({"accel_gain": None}, "accel_gain: expected numbers"),
        ({"accel_gain": [[1, 2], [3, 4]]}, "accel_gain: shape"),
        ({"gyro_gain": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "gyro_gain: its entries are errors"),
        ({"gravity_m_s2": [9.8]}, "gravity_m_s2 must be a single number"),
        ({"gravity_m_s2": 0}, "gravity_m_s2 must be positive"),
        ({"device": 3}, "device: expected a text"),
        ({"attitudes": 1.5}, "attitudes: expected a whole number"),
        ({"temperature_c": "warm"}, "temperature_c: expected numbers"),
        ({"more": 1}, "unknown: more"),
        ({"attitudes": ...}, "missing: attitudes"),
    ],
)
def test_a_wrong_file_is_named_with_what_is_wrong(both, tmp_path, change, said) -> None:
    values = {**json.loads(both[1].read_text()), **change}
    wrong = tmp_path / "phone_imu.json"
    wrong.write_text(json.dumps({key: value for key, value in values.items() if value is not ...}))
    with pytest.raises(FormatError, match=f"phone_imu.json.*{said}"):
        read_imu_calibration(wrong)


def test_each_file_says_what_it_holds_and_two_of_a_kind_are_an_error(both, tmp_path) -> None:
    found = read_calibrations(both)
    assert found.imu is not None and found.imu.device == "My phone"
    assert found.camera_imu is not None
    assert read_calibrations(both[0]).imu is None
    assert read_calibrations(None).camera_imu is None
    again = tmp_path / "again.json"
    again.write_bytes(both[1].read_bytes())
    with pytest.raises(FormatError, match=r"again\.json: and .*phone_imu\.json both give the IMU's own gains"):
        read_calibrations((*both, again))
    again.write_text('{"kind": "lens"}')
    with pytest.raises(FormatError) as refused:
        read_calibrations([again])
    assert refused.value.code == "calibration-kind-unknown"
    with pytest.raises(FormatError) as refused:
        read_calibration(both[1])
    assert refused.value.code == "calibration-of-another-kind"


# --- where it is named -----------------------------------------------------------------------------------------------


def test_a_capture_names_one_file_or_several_and_its_device(both, tmp_path) -> None:
    table = '[imu]\npath = "imu.csv"\n[calibration]\n'
    toml = tmp_path / "capture.toml"
    toml.write_text('device = "My phone"\n' + table + 'file = ["phone.json", "phone_imu.json"]\n')
    capture = load_capture(toml)
    assert (capture.device, capture.imu_calibration.attitudes) == ("My phone", 12)
    # the IMU's own leaves the other keys their place
    toml.write_text(table + 'file = "phone_imu.json"\ngyro_time_offset_s = 0.5\n')
    capture = load_capture(toml)
    assert (capture.calibration.gyro_time_offset_s, capture.imu_calibration.attitudes) == (0.5, 12)
    toml.write_text(table + 'file = ["phone.json", "phone_imu.json"]\ngyro_time_offset_s = 0.5\n')
    with pytest.raises(FormatError, match="leave out the other keys"):
        load_capture(toml)
    for wrong in ("[]", "[3]", '[""]'):
        toml.write_text(table + f"file = {wrong}\n")
        with pytest.raises(FormatError, match=r"line 4: .*file: must be a path in quotes, or a list of them"):
            load_capture(toml)


def test_a_recording_is_corrected_once_by_the_file_or_by_the_capture(both, tmp_path) -> None:
    truth = simulate_rests(RestOptions(attitudes=1), seed=1)
    write_table(tmp_path / "imu.csv", truth.recording)
    toml = tmp_path / "capture.toml"
    toml.write_text('device = "My phone"\n[imu]\npath = "imu.csv"\n[calibration]\nfile = "phone_imu.json"\n')
    capture = load_capture(toml)
    imu = read_imu(toml)
    assert (imu.device, imu.calibration) == ("My phone", None)
    by_capture = correct_imu(capture, imu, ())
    np.testing.assert_allclose(
        by_capture.accel_m_s2, imu.accel_m_s2 @ (np.eye(3) + known().accel_gain).T - known().accel_bias_m_s2
    )
    other = tmp_path / "other.json"
    write_imu_calibration(other, dataclasses.replace(known(), attitudes=20))
    assert correct_imu(capture, imu, other).calibration.attitudes == 20
    assert correct_imu(dataclasses.replace(capture, imu_calibration=None), imu, both[0]) is imu
    # the camera may have been aligned with the gyroscope's own axes, which are askew in the accelerometer's
    prior = prior_calibration(capture, both[1])
    askew = 0.5 * (known().gyro_gain - known().gyro_gain.T)
    assert prior.cov[0, 0] == pytest.approx(
        capture.calibration.cov[0, 0] + askew[0, 1] ** 2 + askew[0, 2] ** 2 + askew[1, 2] ** 2
    )
    np.testing.assert_array_equal(prior.cov[3:], capture.calibration.cov[3:])
    np.testing.assert_allclose(prior_calibration(capture, None).cov, prior.cov)
    assert prior_calibration(dataclasses.replace(capture, imu_calibration=None), None) is capture.calibration


def test_raw_counts_are_read_by_nominal_zeros_and_factors(tmp_path) -> None:
    truth = simulate_rests(RestOptions(attitudes=1), seed=1).recording
    counts = np.column_stack(
        [truth.gyro_t_s, np.round(32768 + 6258 * truth.gyro_rad_s), np.round(32768 + 414 * truth.accel_m_s2)]
    )
    np.savetxt(tmp_path / "raw.csv", counts, fmt="%.6f", delimiter=",", header="t,a,b,c,d,e,f", comments="")
    described = 'file = "raw.csv"\ntime = "t"\ntime_unit = "s"\nzero = 32768\n'
    (tmp_path / "raw.toml").write_text(
        f'[imu.gyro]\n{described}columns = ["a", "b", "c"]\nunit = "rad/s"\ncounts_per_unit = 6258\n'
        f'[imu.accel]\n{described}columns = ["d", "e", "f"]\nunit = "m/s2"\ncounts_per_unit = 414\n'
    )
    imu = read_imu(tmp_path / "raw.toml")
    np.testing.assert_allclose(imu.gyro_rad_s, truth.gyro_rad_s, atol=0.5001 / 6258)
    np.testing.assert_allclose(imu.accel_m_s2, truth.accel_m_s2, atol=0.5001 / 414)


def test_options_take_one_file_or_several_and_keep_them_in_the_configuration(both, tmp_path) -> None:
    assert ReconstructOptions(calibration=both[0]).calibration == (both[0],)
    assert ReconstructOptions(calibration=None).calibration == ()
    options = ReconstructOptions(calibration=both)
    (tmp_path / "config.toml").write_text(config_as_toml(options))
    assert read_config(tmp_path / "config.toml", ReconstructOptions) == options
    (tmp_path / "config.toml").write_text('calibration = "phone.json"\n')
    assert read_config(tmp_path / "config.toml", ReconstructOptions).calibration == (Path("phone.json"),)
    (tmp_path / "config.toml").write_text("calibration = 3\n")
    with pytest.raises(FormatError, match="calibration"):
        read_config(tmp_path / "config.toml", ReconstructOptions)


def test_files_may_stand_anywhere_among_the_words_of_a_command(subtests) -> None:
    for words in (
        "reconstruct in out --calibration a.json --calibration=b.json",
        "reconstruct --calibration a.json --calibration b.json in out",
        "reconstruct in --calibration a.json out --calibration b.json --seed 3",
    ):
        with subtests.test(words=words):
            command = parse(words.split())
            assert (command.capture, command.out) == (Path("in"), Path("out"))
            assert command.options.calibration == (Path("a.json"), Path("b.json"))
            assert parse(["deblur", "--calibration", "phone.cal", "in", "out"]).calibration == (Path("phone.cal"),)


# --- the command, and what it remembers ------------------------------------------------------------------------------


def test_calibrate_imu_writes_a_file_and_a_page_and_remembers(capsys, tmp_path, home) -> None:
    truth = simulate_rests(RestOptions(gravity_m_s2=9.80713), seed=2)
    write_table(tmp_path / "rests.csv", truth.recording)
    out = tmp_path / "phone_imu.json"
    args = ("calibrate-imu", tmp_path / "rests.csv", "--out", out, "--latitude-deg", 47.4, "--height-m", 400)
    code, shown, err = run(capsys, *args, "--remember", "My phone")
    assert code == 0, err
    assert "12 in 12 attitudes" in shown
    assert find_violations("calibration", out) == []
    found = read_imu_calibration(out)
    assert (found.device, found.attitudes) == ("My phone", 12)
    assert found.gravity_m_s2 == pytest.approx(9.807134, abs=1e-6)
    np.testing.assert_allclose(found.accel_gain, truth.accel_gain, atol=1e-3)
    page = out.with_suffix(".html").read_text()
    assert "IMU calibration of My phone" in page and "misalignment zy" in page
    kept = read_remembered(tmp_path / "rests.csv", (), device="my  PHONE")
    assert [kind for _, kind in kept.files] == ["imu"]
    assert kept.paths[0].read_bytes() == out.read_bytes()
    assert run(capsys, *args)[0] == 0  # an earlier result of ours is replaced

    code, _, err = run(capsys, "calibrate-imu", tmp_path / "rests.csv", "--out", tmp_path / "rests.csv")
    assert code == 2 and "is an input" in err
    code, _, err = run(capsys, *args[:4], "--gravity-m-s2", 9.81, "--latitude-deg", 47.4)
    assert code == 2 and "give one of them" in err
    code, _, err = run(capsys, *args[:4], "--height-m", 400)
    assert code == 2 and "--height-m goes with --latitude-deg" in err


def test_too_few_attitudes_end_with_3_and_what_to_do(capsys, tmp_path) -> None:
    write_table(tmp_path / "rests.csv", simulate_rests(RestOptions(attitudes=4), seed=2).recording)
    code, _, err = run(capsys, "calibrate-imu", tmp_path / "rests.csv", "--out", tmp_path / "imu.json")
    assert code == 3
    assert "rested in 4 attitudes" in err and "six sides" in err
    assert not (tmp_path / "imu.json").exists()


def test_reconstruct_uses_it_and_writes_it_down(capsys, tmp_path, home) -> None:
    capture = tiny_capture(tmp_path / "capture")
    (tmp_path / "options.toml").write_text(config_as_toml(dataclasses.replace(TINY, deterministic=False)))
    write_imu_calibration(tmp_path / "imu.json", dataclasses.replace(known(), accel_bias_m_s2=np.zeros(3)))
    kept = remember("My phone", tmp_path / "imu.json")
    args = ("reconstruct", capture, tmp_path / "out", "--config", tmp_path / "options.toml", "--device", "My phone")
    code, shown, err = run(capsys, *args)
    assert code in (0, 3), err
    assert 'My phone: uses the remembered calibration "imu"' in shown
    assert read_config(tmp_path / "out" / "config.toml", ReconstructOptions).calibration == (kept,)
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["calibration_files"] == [{"path": str(kept), "kind": "imu"}]
    assert result["models"][0]["imu_calibration"]["device"] == "My phone"
    assert find_violations("result", result) == []
    # given again, there is nothing to do; by fixed rules, the readings are the sensor's own
    assert "nothing to do" in run(capsys, *args)[1]
    code, shown, err = run(capsys, *args[:2], tmp_path / "fixed", *args[3:], "--deterministic")
    assert "uses the remembered" not in shown
    result = json.loads((tmp_path / "fixed" / "result.json").read_text())
    assert result["calibration_files"] == []
    assert result["models"][0]["imu_calibration"] is None


def test_scale_takes_what_is_remembered_of_its_device_and_says_so(capsys, project, tmp_path, home) -> None:
    files = ["--imu", project.imu, "--frame-times", project.frame_times]
    rests = simulate_rests(RestOptions(gravity_m_s2=9.80665), seed=1, errors=project.recording.truth.imu.errors)
    own = calibrate_imu(rests.recording, gravity_sigma_m_s2=5e-4, device="tablet").calibration
    write_imu_calibration(tmp_path / "imu.json", own)
    code, _, err = run(capsys, "align", project.model, *files, "--out", tmp_path / "cam.json", "--remember", "tablet")
    assert code == 0, err
    remember("tablet", tmp_path / "imu.json")

    def scale(*flags) -> tuple[dict, str]:
        code, out, err = run(capsys, "scale", project.model, *files, "--json", tmp_path / "s.json", *flags)
        assert code == 0, err
        return json.loads((tmp_path / "s.json").read_text()), out

    plain, said = scale()
    assert plain["imu_calibration"] is None and plain["calibration_files"] == []
    assert "remembered" not in said
    used, said = scale("--device", "tablet")
    assert [entry["kind"] for entry in used["calibration_files"]] == ["camera-imu", "imu"]
    assert 'tablet: uses the remembered calibration "imu"' in said
    assert used["imu_calibration"]["attitudes"] == 12
    assert any("corrected by its calibration in 12 attitudes" in note for note in used["notes"])
    assert used["sigma_log"] < plain["sigma_log"]
    given, said = scale("--device", "tablet", "--calibration", tmp_path / "imu.json")
    assert 'calibration "imu"' not in said and 'calibration "camera-imu"' in said
    assert given["metres_per_unit"] == used["metres_per_unit"]
    off, said = scale("--device", "tablet", "--no-remembered")
    assert off["calibration_files"] == [] and "remembered" not in said
    code, _, err = run(
        capsys, "scale", project.model, *files, "--json", tmp_path / "s.json", "--calibration", tmp_path / "imu.json",
        "--calibration", tmp_path / "imu.json",
    )  # fmt: skip
    assert code == 2 and "both give" in err


def test_what_a_capture_says_goes_before_what_is_remembered(both, tmp_path, home) -> None:
    write_table(tmp_path / "imu.csv", simulate_rests(RestOptions(attitudes=1), seed=1).recording)
    for path in both:
        remember("My phone", path)
    toml = tmp_path / "capture.toml"
    head = 'device = "My phone"\n[imu]\npath = "imu.csv"\n'
    for table, kinds in (
        ("", ["camera-imu", "imu"]),
        ('[calibration]\nfile = "phone_imu.json"\n', ["camera-imu"]),
        ("[calibration]\ncam_from_imu_xyzw = [0, 0, 0, 1]\n", ["imu"]),
    ):
        toml.write_text(head + table)
        assert [kind for _, kind in read_remembered(toml, ()).files] == kinds
        assert read_remembered(toml, both).files == ()
    assert read_remembered(tmp_path / "imu.csv", ()).files == ()  # nobody said what it is
    assert read_remembered(tmp_path / "no.csv", ()).files == ()
    with pytest.raises(OutputError, match="needs a name"):
        remember("  ", both[0])


@pytest.mark.parametrize(
    ("platform", "folder"),
    [("linux", "config"), ("darwin", "home/Library/Application Support"), ("win32", "config")],
)
def test_the_folder_is_the_system_s_own(monkeypatch, tmp_path, home, platform, folder) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    assert configuration_folder() == tmp_path / folder / "colmap-inertial"
    monkeypatch.delenv("XDG_CONFIG_HOME")
    if platform == "linux":
        assert configuration_folder() == tmp_path / "home" / ".config" / "colmap-inertial"


@loop_over("name", ["../../etc", "a/b", "C:\\x", "nul", "Телефон", "x" * 500, "."])
def test_any_name_of_a_device_stays_in_the_folder(both, home, name) -> None:
    kept = remember(name, both[1])
    assert kept.parent.parent == configuration_folder() / "devices"
    assert kept != remember(name + "2", both[1])
    assert device_store._folder(name) == kept.parent
