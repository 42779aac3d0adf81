"""The command as a user calls it: exit codes, messages, files."""

import contextlib
import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli import COMMANDS, main, parse
from colmap_inertial.cli.help import list_options
from tests.helpers.cases import loop_over


def run(capsys, *args):
    """Exit code, standard output, standard error of one call."""
    with pytest.raises(SystemExit) as stopped:
        main([str(arg) for arg in args])
    captured = capsys.readouterr()
    return stopped.value.code, captured.out, captured.err


@loop_over(
    "command",
    [
        [],
        ["reconstruct"],
        ["scale"],
        ["align"],
        ["validate"],
        ["view"],
        ["deblur"],
        ["fuse-apertures"],
        ["batch"],
        ["simulate"],
    ],
)
def test_help_teaches(capsys, command):
    code, out, _ = run(capsys, *command, "--help-all" if command else "--help")
    assert code == 0
    assert "usage: colmap-inertial" in out
    if command:
        assert "Example: colmap-inertial" in out


def test_help_is_for_those_who_ask_for_it(capsys):
    for args, code in (([], 2), (["--help"], 0), (["-h"], 0)):
        found, out, _ = run(capsys, *args)
        assert found == code and "usage: colmap-inertial" in out
    # also behind a source, and not where something is missing
    assert run(capsys, "scale", "x", "--help")[0] == run(capsys, "scale", "--imu", "y", "-h")[0] == 0
    for args in (["scale"], ["apply", "x"]):
        code, out, err = run(capsys, *args)
        assert code == 2 and out == "" and "required" in err.lower()
    code, out, err = run(capsys, "--json", "x", "scale")
    assert code == 2 and out == "" and "--json" in err


@loop_over(
    ("words", "files"),
    [
        ("reconstruct --calibration a.json x y", ["a.json"]),
        ("reconstruct x --calibration a.json y --calibration b.json", ["a.json", "b.json"]),
        ("reconstruct x y --calibration=a.json --quiet", ["a.json"]),
    ],
)
def test_what_may_be_given_several_times_swallows_no_path(words, files):
    made = parse(words.split())
    assert (str(made.capture), str(made.out)) == ("x", "y") and list(map(str, made.options.calibration)) == files


@loop_over(
    "words", ["--calibration", "--colmap", "--calibration --json z", "--colmap A.b=1 C.d=2", "--quiet --verbose"]
)
def test_options_that_miss_a_value_or_have_one_too_many_or_exclude_each_other_are_refused(capsys, words):
    code, out, err = run(capsys, "reconstruct", "x", "y", *words.split())
    assert code == 2 and out == "" and words.split()[-1].partition("z")[0] in err


def test_a_wrong_flag_exits_2_and_names_it(capsys):
    code, _, err = run(capsys, "scale", "x", "--json", "y", "--metod", "joint")
    assert code == 2
    assert "--metod" in err


@loop_over(
    ("args", "meant"),
    [
        (["scal", "x"], "diagnose, reconstruct, batch, view"),
        (["scale", "x", "--frame-time", "y"], "--frame-times PATH"),
        (["reconstruct", "x", "y", "--rolling-shuter=off"], "--rolling-shutter {off,rectify}"),
        (["reconstruct", "x", "y", "--overlap", "3"], "--mapping.overlap INT"),
        (["diagnose", "x", "--jsn", "y"], "--json PATH"),
    ],
)
def test_what_is_mistyped_is_named_with_what_there_is(capsys, monkeypatch, args, meant):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, err = run(capsys, *args)
    assert code == 2 and out == "" and meant in err
    assert max(map(len, err.splitlines())) <= 80


@loop_over("command", COMMANDS)
def test_every_option_of_the_help_is_known(capsys, command):
    options = list(list_options(COMMANDS[command]))
    values = {"PATH": "x", "INT": "1", "FLOAT": "1", "TEXT": "x"}
    words = ["x" for option in options if option.positional]
    for option in options:
        name, _, value = option.label.replace(", ", ",").partition(" ")
        if not option.positional and option.field not in ("config", "verbose"):  # a file, and what --quiet excludes
            words += [name.partition(",")[0], *(values.get(v) or v.strip("{}").split(",")[0] for v in value.split())]
    for more, unknown in (((), False), (("--no-such-option",), True)):
        with contextlib.suppress(SystemExit, ValueError):  # values that exclude each other
            parse([command, *words, *more])
        assert ("Unrecognized options" in capsys.readouterr().err) == unknown


def test_options_are_known_by_both_spellings(capsys):
    code, _, err = run(capsys, "fuse_apertures", "no_capture", "out", "--lens_width", "2")
    assert code == 2 and "no_capture" in err and "option" not in err


@pytest.mark.parametrize("columns", ["80", "140"])
def test_help_mentions_version_and_completion_and_no_none_to_type(capsys, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", columns)
    _, out, _ = run(capsys, "--help")
    assert "--version" in out and "--tyro-print-completion" in out
    for command in COMMANDS:
        _, out, _ = run(capsys, command, "--help-all")
        assert "{None}" not in out and "Default:" not in out and "default: None" not in out
        assert max(map(len, out.splitlines())) <= int(columns)


def test_common_options_come_first_and_those_of_all_commands_are_the_same(capsys):
    _, out, _ = run(capsys, "reconstruct", "--help-all")
    places = [out.index(f"\n  {option}") for option in ("--dense", "--imu", "--mapping.pairing", "--join", "--json")]
    assert places == sorted(places)
    for command in COMMANDS:
        _, out, _ = run(capsys, command, "-h")
        assert all(f"\n  {option}" in out for option in ("--json PATH", "--quiet", "--verbose"))


def test_an_option_of_a_group_is_spelled_with_it():
    assert parse(["scale", "x", "--latitude-deg", "47"]).options.latitude_deg == 47
    assert parse(["calibrate-imu", "x", "--out", "y", "--latitude-deg", "47"]).gravity.latitude_deg == 47
    options = parse(["reconstruct", "x", "y", "--scale.latitude-deg=47", "--mapping.no-refine-intrinsics"]).options
    assert options.scale.latitude_deg == 47 and options.mapping.refine_intrinsics is False


def test_the_group_of_an_option_is_named_where_it_is_missing(capsys):
    code, _, err = run(capsys, "reconstruct", "x", "y", "--max-image-size", "900")
    assert code == 2 and "--mapping.max-image-size INT" in err and "--dense-options.max-image-size INT" in err


def test_a_video_without_an_imu_and_one_that_is_none_say_so(subtests, capsys, tmp_path_factory):
    for command in ("reconstruct", "diagnose"):
        with subtests.test(command=command):
            tmp_path = tmp_path_factory.mktemp("given")
            capsys.readouterr()
            from tests.helpers.imu_files import video_track, write_mp4

            video = tmp_path / "clip.mp4"
            write_mp4(video, [video_track(3)])
            out = [tmp_path / "out"] if command == "reconstruct" else []
            code, _, err = run(capsys, command, video, *out)
            assert code == 2 and "clip.mp4" in err and "[video] and [imu]" in err
            video.write_text("hello, I am a text\n")
            code, _, err = run(capsys, command, video, *out)
            assert code == 2 and "begins with text" in err


def test_the_installed_command_runs():
    done = subprocess.run(
        [sys.executable, "-m", "colmap_inertial", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "0.2.0"


@pytest.mark.parametrize("method", ["joint", "spectral"])
def test_scale_of_a_colmap_model(capsys, project, tmp_path, method):
    target = tmp_path / "scale.json"
    before = {p: p.read_bytes() for p in project.model.iterdir()}
    code, out, err = run(
        capsys, "scale", project.model, "--imu", project.imu, "--frame-times", project.frame_times, "--json", target,
        "--method", method,
    )  # fmt: skip
    assert code == 0, err
    assert "m per unit" in out
    found = json.loads(target.read_text())
    truth = project.recording.truth
    assert found["method"] == method
    assert found["verdict"] in ("trusted", "weak")
    assert found["metres_per_unit"] == pytest.approx(truth.metres_per_unit, rel=0.05)
    low, high = found["ci95"]
    assert low < found["metres_per_unit"] < high
    assert found["gyro_time_offset_s"] == pytest.approx(truth.calibration.gyro_time_offset_s, abs=0.02)
    np.testing.assert_allclose(found["gyro_bias_rad_s"], truth.calibration.gyro_bias_rad_s, atol=0.01)
    assert abs(np.dot(found["cam_from_imu_xyzw"], truth.calibration.cam_from_imu_xyzw)) > 0.999
    assert np.linalg.norm(found["gravity_in_world_m_s2"]) == pytest.approx(9.8, abs=0.1)
    assert found["runtime_s"] > 0
    assert {p: p.read_bytes() for p in project.model.iterdir()} == before


def test_scale_uses_no_later_frame_than_it_was_given(capsys, project, tmp_path):
    whole, cut = tmp_path / "whole.json", tmp_path / "cut.json"
    flags = ["--imu", project.imu, "--frame-times", project.frame_times, "--first-s", 15]
    assert run(capsys, "scale", project.model, *flags, "--json", whole)[0] in (0, 3)
    rows = project.frame_times.read_text().splitlines()
    stamps = [int(row.split(",")[1]) for row in rows[1:]]
    short = tmp_path / "frames.csv"
    short.write_text("\n".join([rows[0], *(r for r, t in zip(rows[1:], stamps, strict=True) if t <= stamps[0] + 15e9)]))
    flags[3] = short
    assert run(capsys, "scale", project.model, *flags, "--json", cut)[0] in (0, 3)
    a, b = json.loads(whole.read_text()), json.loads(cut.read_text())
    assert a["metres_per_unit"] == pytest.approx(b["metres_per_unit"], rel=1e-9)


@pytest.mark.parametrize("after", [[], ["--json", "x.json"]], ids=["last", "before-an-option"])
def test_a_calibration_without_a_file_is_an_error(capsys, project, after):
    code, _, err = run(capsys, "scale", project.model, "--calibration", *after)
    assert code == 2 and "Missing value for argument '--calibration'" in err


def test_align_writes_a_calibration_that_scale_takes_as_a_prior(capsys, project, tmp_path):
    files = ["--imu", project.imu, "--frame-times", project.frame_times]
    calibration = tmp_path / "phone.json"
    code, out, err = run(capsys, "align", project.model, *files, "--out", calibration)
    assert code == 0, err
    assert "Time offset" in out
    found, truth = json.loads(calibration.read_text()), project.recording.truth.calibration
    assert found["gyro_time_offset_s"] == pytest.approx(truth.gyro_time_offset_s, abs=0.01)
    assert abs(np.dot(found["cam_from_imu_xyzw"], truth.cam_from_imu_xyzw)) > 0.9995

    target = tmp_path / "scale.json"
    code, _, err = run(capsys, "scale", project.model, *files, "--calibration", calibration, "--json", target)
    assert code == 0, err
    scale = json.loads(target.read_text())["metres_per_unit"]
    assert scale == pytest.approx(project.recording.truth.metres_per_unit, rel=0.05)


def test_a_refusal_writes_its_reasons_and_exits_3(capsys, project, tmp_path):
    from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording
    from tests.helpers.simulated_project import write_project

    still = simulate_recording(RecordingOptions(motion=MotionOptions(kind="static", duration_s=20)), seed=2)
    files = write_project(tmp_path / "still", still)
    target = tmp_path / "scale.json"
    code, out, _ = run(
        capsys, "scale", files.model, "--imu", files.imu, "--frame-times", files.frame_times, "--json", target
    )
    assert code == 3
    assert "refused" in out
    found = json.loads(target.read_text())
    assert found["metres_per_unit"] is None
    assert found["ci95"] is None
    assert found["reasons"]


def test_the_imu_of_another_recording_is_refused(capsys, project, tmp_path):
    from colmap_inertial.tools.simulate import RecordingOptions, simulate_recording
    from tests.helpers.simulated_project import write_project

    other = write_project(tmp_path / "other", simulate_recording(RecordingOptions(), seed=77))
    target = tmp_path / "scale.json"
    code, _, _ = run(
        capsys, "scale", project.model, "--imu", other.imu, "--frame-times", project.frame_times, "--json", target
    )
    assert code == 3
    assert "offset" in " ".join(json.loads(target.read_text())["reasons"])


def test_times_in_the_names_of_images_are_those_of_a_table(capsys, project, tmp_path):
    rows = [row.split(",") for row in project.frame_times.read_text().split()]
    assert rows[0] == ["name", "t_ns"]
    model = pycolmap.Reconstruction(project.model)
    for name, t_ns in rows[1:]:
        model.find_image_with_name(name).name = f"cam0_{t_ns}_7.jpg"
    named = tmp_path / "named"
    named.mkdir()
    model.write(named)
    found = []
    for source, times in (
        (project.model, ["--frame-times", project.frame_times]),
        (named, ["--name-times", "cam0_{ns}_*"]),
    ):
        target = tmp_path / f"{source.name}.json"
        code, _, err = run(capsys, "scale", source, "--imu", project.imu, *times, "--json", target)
        assert code == 0, err
        found.append(json.loads(target.read_text()))
    assert [one["metres_per_unit"] for one in found] == [found[0]["metres_per_unit"]] * 2
    both = ["--frame-times", project.frame_times, "--name-times", "ns"]
    code, _, err = run(capsys, "scale", named, "--imu", project.imu, *both)
    assert code == 2 and "--name-times" in err


def test_missing_pieces_are_asked_for_by_flag(capsys, project, tmp_path):
    target = tmp_path / "scale.json"
    code, _, err = run(capsys, "scale", project.model, "--json", target)
    assert (code, "--imu" in err) == (2, True)
    code, _, err = run(capsys, "scale", project.model, "--imu", project.imu, "--json", target)
    assert (code, "--frame-times" in err) == (2, True)
    code, _, err = run(capsys, "scale", tmp_path / "nowhere", "--imu", project.imu, "--json", target)
    assert (code, "no such file" in err) == (2, True)
    code, _, err = run(
        capsys, "scale", project.model, "--imu", project.imu, "--frame-times", project.frame_times,
        "--json", tmp_path / "no" / "scale.json",
    )  # fmt: skip
    assert (code, "create it first" in err) == (2, True)
    assert not target.exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda gyro, accel: (gyro * 57.29578, accel), "deg/s"),
        (lambda gyro, accel: (gyro, accel / 9.80665), "g"),
        (lambda gyro, accel: (accel, gyro), "exchanged"),
    ],
    ids=["deg/s for rad/s", "g for m/s2", "columns exchanged"],
)
def test_wrong_units_are_an_error_that_names_the_setting(capsys, project, tmp_path, change, words):
    imu = tmp_path / "imu"
    shutil.copytree(project.imu, imu)
    tables = {name: np.loadtxt(imu / f"{name}.txt") for name in ("gyroscope", "accelerometer")}
    rows = min(map(len, tables.values()))
    values = change(tables["gyroscope"][:rows, 1:], tables["accelerometer"][:rows, 1:])
    for name, columns in zip(tables, values, strict=True):
        lines = [f"{int(t)} {x} {y} {z}" for t, (x, y, z) in zip(tables[name][:rows, 0], columns, strict=True)]
        (imu / f"{name}.txt").write_text("\n".join(lines) + "\n")
    target = tmp_path / "scale.json"
    code, _, err = run(
        capsys, "scale", project.model, "--imu", imu, "--frame-times", project.frame_times, "--json", target
    )
    assert code == 2
    assert words in err
    assert "imu" in err
    assert not target.exists()


def test_a_configuration_file_goes_between_flags_and_defaults(tmp_path):
    config = tmp_path / "c.toml"
    config.write_text("seed = 4\n[mapping]\noverlap = 3\nmax_num_features = 500\n")
    args = ["reconstruct", "a", "b", "--config", str(config), "--mapping.overlap", "6"]
    options = parse(args).options
    assert (options.seed, options.mapping.overlap, options.mapping.max_num_features) == (4, 6, 500)
    assert options.mapping.pairing == "auto"


def test_a_broken_configuration_exits_2(capsys, tmp_path):
    config = tmp_path / "c.toml"
    config.write_text("sead = 4\n")
    code, _, err = run(capsys, "reconstruct", "a", "b", "--config", config)
    assert code == 2
    assert "did you mean seed" in err


@loop_over(
    ("flags", "words"),
    [
        (["--latitude-deg", "100"], "latitude_deg must be from -90 to 90"),
        (["--gravity-m-s2", "-9.8"], "gravity_m_s2 must be from 9.7 to 9.9"),
        (["--gravity-m-s2", "nan"], "gravity_m_s2 must be"),
        (["--first-s", "-3"], "first_s must be positive"),
        (["--max-offset-s", "-1"], "max_offset_s must be positive"),
        (["--gravity-m-s2", "9.81", "--latitude-deg", "60"], "give one of them"),
    ],
)
def test_impossible_values_are_refused_before_any_work(capsys, project, tmp_path, flags, words):
    target = tmp_path / "scale.json"
    files = ["--imu", project.imu, "--frame-times", project.frame_times, "--json", target]
    code, _, err = run(capsys, "scale", project.model, *files, *flags)
    assert code == 2
    assert words in err
    assert not target.exists()


def test_impossible_options_of_a_reconstruction_leave_no_folder(subtests, capsys, tmp_path_factory):
    for flags in (["--seed", "-1"], ["--mapping.overlap", "0"], ["--mapping.max-num-features", "-5"]):
        with subtests.test(flags=flags):
            tmp_path = tmp_path_factory.mktemp("given")
            capsys.readouterr()
            code, _, err = run(capsys, "reconstruct", tmp_path / "capture.toml", tmp_path / "out", *flags)
            assert code == 2
            assert "must be" in err
            assert not (tmp_path / "out").exists()


def test_outputs_never_replace_what_is_not_an_earlier_result(capsys, project, tmp_path):
    imu, times = tmp_path / "imu", tmp_path / "frames.csv"
    shutil.copytree(project.imu, imu)
    shutil.copyfile(project.frame_times, times)
    files = ["--imu", imu, "--frame-times", times]
    thesis = tmp_path / "thesis.json"
    thesis.write_text('{"years": 4}')
    for target, words in (
        (times, "is an input"),
        (thesis, "is not an earlier result"),
        (imu / "gyroscope.txt", "is not an earlier result"),
        (imu, "is a folder"),
    ):
        before = None if target.is_dir() else target.read_bytes()
        for command, flag in (("scale", "--json"), ("align", "--out")):
            code, _, err = run(capsys, command, project.model, *files, flag, target)
            assert (code, words in err) == (2, True), err
        assert target.is_dir() or target.read_bytes() == before
    earlier = tmp_path / "scale.json"
    for _ in range(2):
        assert run(capsys, "scale", project.model, *files, "--first-s", 20, "--json", earlier)[0] in (0, 3)


def test_an_output_folder_that_cannot_be_made_is_an_error(capsys, tmp_path):
    from tests.helpers.desk_scene import SCENE

    (tmp_path / "file").write_text("")
    code, _, err = run(capsys, "reconstruct", SCENE, tmp_path / "file" / "out")
    assert code == 2
    assert "cannot be created" in err


def test_an_imu_shorter_than_the_recording_is_mentioned(capsys, project, tmp_path):
    imu = tmp_path / "imu"
    shutil.copytree(project.imu, imu)
    for path in imu.iterdir():
        rows = path.read_text().splitlines()
        path.write_text("\n".join(rows[: len(rows) // 2]) + "\n")
    target = tmp_path / "scale.json"
    code, _, _ = run(
        capsys, "scale", project.model, "--imu", imu, "--frame-times", project.frame_times, "--json", target
    )
    assert code in (0, 3)
    assert "IMU data cover" in " ".join(json.loads(target.read_text())["notes"])


def test_validate_does_not_write_into_a_folder_of_pictures(capsys, project, tmp_path):
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "00000.jpg").write_bytes(b"precious")
    code, _, err = run(
        capsys, "validate", project.model, "--images", tmp_path / "frames", "--target", "checkerboard:8x6:0.04",
        "--pictures", tmp_path / "frames",
    )  # fmt: skip
    assert (code, "name a new folder" in err) == (2, True)
    assert (tmp_path / "frames" / "00000.jpg").read_bytes() == b"precious"
    code, _, err = run(
        capsys, "validate", project.model, "--images", tmp_path / "frames", "--target", "checkerboard:8x6:0.04",
        "--tolerance", -3,
    )  # fmt: skip
    assert (code, "tolerance must be" in err) == (2, True)


@loop_over(
    "command, library, mend",
    [
        ("diagnose", "libSM.so.6", "on Debian: apt install libsm6"),
        ("view", "libcudart.so.12", "pip install --force-reinstall pycolmap"),
    ],
)
def test_a_pycolmap_that_lacks_a_library_is_one_sentence(tmp_path, command, library, mend):
    """What pycolmap-cuda12 4.2.1 raises on a machine without the libraries of X or of CUDA."""
    model = tmp_path / "model"
    model.mkdir(exist_ok=True)
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.txt").write_text("")
    broken = tmp_path / "pycolmap" / "__init__.py"
    broken.parent.mkdir(exist_ok=True)
    broken.write_text(
        "why = ImportError('" + library + ": cannot open shared object file: No such file or directory',\n"
        "    name='_core', path=__file__.replace('__init__.py', '_core.so'))\n"
        "raise RuntimeError('\\nCannot import the C++ backend\\n') from why\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "colmap_inertial", command, model],
        env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"},
        capture_output=True,
        text=True,
    )
    said = f"error: pycolmap cannot be loaded ({library}: cannot open shared object file: No such file or directory); "
    assert done.returncode == 2
    assert done.stderr.strip().startswith(said + mend) and len(done.stderr.splitlines()) == 1
