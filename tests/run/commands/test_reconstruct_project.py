"""``reconstruct`` on an existing COLMAP project: nothing is mapped, all becomes metric, the original is only read."""

import contextlib
import dataclasses
import datetime
import io
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError, TimingError
from colmap_inertial.core.geometry import matrix_from_quat, skew
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions
from colmap_inertial.io import sensor_yaml, video_match
from colmap_inertial.io.exif import stamps_of_exif
from colmap_inertial.io.frame_times import stamps_of_pattern
from colmap_inertial.io.trajectories import read_tum
from colmap_inertial.io.video import decode_grey
from colmap_inertial.io.video_match import match_to_video
from colmap_inertial.model import read_model
from colmap_inertial.model.identity import ModelIdentity
from colmap_inertial.model.project import apply_to_project
from colmap_inertial.model.similarities import read_similarity
from colmap_inertial.run.commands.reconstruct_project import is_project, reconstruct_project
from colmap_inertial.tools.view import load_scene
from tests.helpers.box_project import build, pictures, with_exif, write_model, write_video
from tests.helpers.foreign_models import ply_points, write_ply

#: For tests of what goes in and comes out: the refinement takes a third of a run.
NOT_REFINED = ReconstructOptions(refine="off")
UNREFINED = ("--refine", "off")


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """With few points, as every step reads them. Tests must not change it."""
    return build(tmp_path_factory.mktemp("box"), every=10, points=500)


@pytest.fixture(scope="module")
def video(box):
    """Every other of the recording's frames at another size, through a codec; its clock starts at 2 s."""
    frames = range(0, len(box.recording.trajectory), 2)
    stamps_ms = [2000 + round(1000 * i / 30) for i in frames]
    shown = pictures(box.recording, frames)
    return write_video(box.root.parent / "clip.mp4", shown, stamps_ms=stamps_ms, size=(200, 150))


@pytest.fixture(scope="module")
def finished(box, tmp_path_factory):
    """The command's words, what it made and what it printed. Tests must not change it."""
    before, out, shown = contents(box.root), tmp_path_factory.mktemp("finished") / "out", io.StringIO()
    words = "reconstruct", box.root, out, "--imu", box.imu, "--frame-times", box.frame_times, *UNREFINED
    with contextlib.redirect_stdout(shown), pytest.raises(SystemExit) as stopped:
        main([str(word) for word in words])
    assert stopped.value.code == 0
    assert contents(box.root) == before
    return words, out, shown.getvalue()


def run(capsys, *args):
    """Exit code, standard output, standard error of one call."""
    with pytest.raises(SystemExit) as stopped:
        main([str(arg) for arg in args])
    captured = capsys.readouterr()
    return stopped.value.code, captured.out, captured.err


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def assert_metric(box, out):
    """The result holds the true scale in its interval, and the metric model is as large as the world."""
    (model,) = json.loads((out / "result.json").read_text())["models"]
    truth = box.recording.truth
    low, high = model["ci95"]
    assert low < truth.metres_per_unit < high
    assert model["metres_per_unit"] == pytest.approx(truth.metres_per_unit, rel=0.03)
    return model


def poses_only(box, folder, names):
    """The project without pictures and points, under other names."""
    write_model(box, folder / "sparse" / "0", names, points=0)
    return folder


def test_a_project_with_a_csv_becomes_metric_whole(box, finished, tmp_path, capsys):
    words, out, shown = finished
    model = assert_metric(box, out)
    assert re.search(rf"Images +{len(box.names)} ", shown)
    assert model["sparse"] == str(box.root / "sparse" / "0")
    assert not (out / "colmap").exists()
    assert "poses" in json.loads((out / "diagnosis.json").read_text())["checked"]
    # the metric model, the same as apply makes it, and what carries no length
    apply_to_project(box.root, tmp_path / "applied", read_similarity(out / "sparse" / "0" / "transform.json"))
    metric, whole = (read_model(folder / "sparse" / "0") for folder in (out, tmp_path / "applied"))
    for i in metric.reg_image_ids():
        centre = metric.image(i).projection_center()
        np.testing.assert_array_equal(whole.image(i).projection_center(), centre)
    original = read_model(box.root / "sparse" / "0")
    assert whole.num_points3D() == metric.num_points3D() == original.num_points3D()
    assert (out / "transform.json").is_file()
    for name in ("notes.txt", f"images/{box.names[7]}"):
        assert (out / name).read_bytes() == (box.root / name).read_bytes()
    # gravity is along z, the path as long as the true one
    track = read_tum(out / "trajectory.tum")
    true = box.recording.truth.motion.cam_in_world_m(box.recording.trajectory.t_s[list(box.frames)])
    assert np.ptp(track.cam_in_world[:, 2]) == pytest.approx(np.ptp(true[:, 2]), rel=0.05)
    lengths = [np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)) for path in (track.cam_in_world, true)]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.05)
    # a finished result stays
    before = (out / "result.json").read_bytes()
    again = run(capsys, *words)
    assert again[0] == 0
    assert "nothing to do" in again[1]
    assert (out / "result.json").read_bytes() == before


def test_a_project_is_checked_beforehand_and_force_goes_on(box, tmp_path, capsys):
    # a gyroscope of which one axis was mirrored
    mirrored = tmp_path / "imu"
    shutil.copytree(box.imu, mirrored)
    table = mirrored / "gyroscope.txt"
    rows = [line.split() for line in table.read_text().splitlines()]
    table.write_text("".join(f"{t} {x} {y} {-float(z)}\n" for t, x, y, z in rows))
    flags = ["--imu", mirrored, "--frame-times", box.frame_times, *UNREFINED]
    code, _, err = run(capsys, "reconstruct", box.root, tmp_path / "stopped", *flags)
    assert code == 3 and "--force" in err
    assert not (tmp_path / "stopped" / "result.json").exists()
    run(capsys, "reconstruct", box.root, tmp_path / "forced", *flags, "--force")
    (model,) = json.loads((tmp_path / "forced" / "result.json").read_text())["models"]
    assert model["verdict"] in ("weak", "refused")
    assert "continued by --force" in model["reasons"][0]
    codes = [f["code"] for f in json.loads((tmp_path / "forced" / "diagnosis.json").read_text())["findings"]]
    assert "gyro-mirrored" in codes or "imu-does-not-fit" in codes


def test_a_model_folder_alone_and_times_in_its_names(box, tmp_path, capsys):
    names = [f"cam/cam0_{t}_left.png" for t in box.t_ns()]
    project = poses_only(box, tmp_path / "project", names)
    out = tmp_path / "out"
    flags = ["--imu", box.imu, *UNREFINED, "--name-times"]
    code, _, err = run(capsys, "reconstruct", project / "sparse" / "0", out, *flags, "cam0_{ns}_*", "--world", "y-down")
    assert code == 0, err
    assert_metric(box, out)
    assert (out / "sparse" / "0" / "images.bin").is_file()
    code, _, err = run(capsys, "reconstruct", project, tmp_path / "out2", *flags, "cam1_{ns}_*")
    assert code == 2
    assert "does not fit" in err


def test_names_are_read_as_the_pattern_says(tmp_path):
    def times(pattern, *names):
        return stamps_of_pattern(tmp_path, names, pattern).t_ns.tolist()

    assert times("ns", "a/3_1403715273262142976.png") == [1403715273262142976]
    assert times("s", "1.25.png", "1.5.jpg") == [1_250_000_000, 1_500_000_000]
    assert times("v2_{ms}", "v2_1500.png") == [1_500_000_000]
    assert times("*_{us}_*", "cam7_12_b.png", "cam9_14_c.png") == [12_000, 14_000]
    expected = datetime.datetime(2024, 1, 2, 3, 4, 5, 678000, tzinfo=datetime.UTC).timestamp()
    assert times("PXL_%Y%m%d_%H%M%S%f", "DCIM/PXL_20240102_030405678.jpg") == [round(expected * 1000) * 1_000_000]
    for pattern, words in (
        ("IMG_%Y%m%d_%H%M%S", "fraction of the second"),
        ("%H%M%S%f", "fraction of the second"),
        ("minutes", "give a unit"),
        ("{ns}_{ns}", "give a unit"),
        ("b{ns}", "does not fit"),
        ("%Y%m%d%f", "does not fit"),
    ):
        with pytest.raises(TimingError, match=words):
            times(pattern, "a12.png")


def exif_pictures(box, folder, *, digits=3, offset=None):
    """Pictures of one pixel each with the times of the project's images."""
    folder.mkdir(parents=True)
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes()
    for name, t_ns in zip(box.names, box.t_ns(), strict=True):
        date = datetime.datetime.fromtimestamp(1_700_000_000 + t_ns // 10**9, datetime.UTC)
        fraction = f"{t_ns % 10**9:09d}"[:digits] or None
        (folder / name).write_bytes(with_exif(jpeg, date.strftime("%Y:%m:%d %H:%M:%S"), fraction, offset))
    return folder


def test_exif_with_fractions_times_the_images_and_without_is_refused(box, tmp_path, capsys):
    images = exif_pictures(box, tmp_path / "images", offset="+01:00")
    stamps, digits = stamps_of_exif(images, box.names)
    assert digits == 3
    off_ns = stamps.t_ns - np.array(box.t_ns()) - (1_700_000_000 - 3600) * 10**9
    assert np.abs(off_ns).max() < 1_000_000
    flags = ["--imu", box.imu, *UNREFINED, "--exif-times", "--images"]
    code, _, err = run(capsys, "reconstruct", box.root, tmp_path / "out", *flags, images)
    assert code == 0, err
    assert_metric(box, tmp_path / "out")

    for digits, words in ((0, "whole seconds"), (1, "tenths of a second")):
        coarse = exif_pictures(box, tmp_path / f"coarse{digits}", digits=digits)
        code, _, err = run(capsys, "reconstruct", box.root, tmp_path / f"out{digits}", *flags, coarse)
        assert code == 2
        assert words in err
        assert "00002.jpg" in err
        assert "--frame-times" in err
        assert not (tmp_path / f"out{digits}" / "result.json").exists()
    bare = exif_pictures(box, tmp_path / "bare")
    bare.joinpath(box.names[3]).write_bytes(cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes())
    with pytest.raises(InertialError, match=rf"{box.names[3]}: has no EXIF"):
        stamps_of_exif(bare, box.names)
    shutil.copy(images / box.names[3], bare)
    with pytest.raises(TimingError, match="cannot be compared"):
        stamps_of_exif(bare, box.names)


def test_images_are_found_in_their_video_by_content(box, video, tmp_path, capsys):
    out = tmp_path / "out"
    code, _, err = run(capsys, "reconstruct", box.root, out, "--imu", box.imu, "--video", video, *UNREFINED)
    assert code == 0, err
    model = assert_metric(box, out)
    times = json.loads((out / "frames.json").read_text())["timing"]
    assert len(times["names"]) >= 0.9 * len(box.names)
    t_s = np.array(times["t_s"]) + times["epoch_ns"] * 1e-9
    frames = np.array([int(name[:5]) for name in times["names"]])
    np.testing.assert_allclose(t_s, 2 + frames / 30, atol=0.001)
    truth = box.recording.truth.calibration
    assert model["gyro_time_offset_s"] == pytest.approx(truth.gyro_time_offset_s + 2, abs=0.02)


def test_a_video_is_matched_through_size_codec_and_turn(box, tmp_path, monkeypatch):
    every = list(pictures(box.recording, range(120)))
    video = write_video(tmp_path / "a.mp4", every, stamps_ms=[33 * i for i in range(120)], size=(240, 180))
    shown = every[2::6]
    expected = {f"{i:05}.png": 33_000_000 * i for i in range(2, 120, 6)}

    def turned(path):  # a container that wants its frames upright
        return ((t_ns, 90, grey) for t_ns, _, grey in decode_grey(path))

    for turn, code in ((0, None), (3, cv2.ROTATE_90_CLOCKWISE)):
        folder = tmp_path / str(turn)
        folder.mkdir()
        for name, image in zip(expected, shown, strict=True):
            dim = cv2.convertScaleAbs(cv2.resize(image, (96, 72), interpolation=cv2.INTER_LANCZOS4), alpha=0.8, beta=9)
            cv2.imwrite(str(folder / name), dim if code is None else cv2.rotate(dim, code))
        match = match_to_video(video, folder, list(expected))
        if turn:  # a video that says nothing of a turn has none
            assert not match.t_ns
            with monkeypatch.context() as patched:
                patched.setattr(video_match, "decode_grey", turned)
                match = match_to_video(video, folder, list(expected))
        assert match.quarter_turns == turn
        assert len(match.t_ns) >= 18
        assert match.t_ns.items() <= expected.items()


def test_repeated_frames_and_strangers_have_no_match(box, tmp_path):
    shown = list(pictures(box.recording, range(0, 120, 4)))
    still = [*shown[:10], *[shown[10]] * 3, *shown[11:20]]
    clip = write_video(tmp_path / "a.mp4", still, stamps_ms=[40 * i for i in range(len(still))], crf=28)
    folder = tmp_path / "images"
    folder.mkdir()
    for i, image in enumerate(shown):
        cv2.imwrite(str(folder / f"{i:02}.png"), image)
    shutil.copy(folder / "04.png", folder / "again.png")
    cv2.imwrite(str(folder / "flat.png"), np.full((120, 160), 90, np.uint8))
    names = sorted(path.name for path in folder.iterdir())
    match = match_to_video(clip, folder, names)
    assert "several frames" in str(match.doubtful["10.png"])
    assert "another image" in str(match.doubtful["04.png"])
    assert "another image" in str(match.doubtful["again.png"])
    assert "not a frame" in str(match.doubtful["flat.png"])
    assert all(f"{i}.png" in match.doubtful for i in range(24, 30))
    expected = {f"{i:02}.png": 40_000_000 * (i if i < 10 else i + 2) for i in range(20)}
    assert match.t_ns.items() <= expected.items()
    assert len(match.t_ns) >= 16


def test_a_video_of_something_else_is_refused(box, tmp_path, capsys):
    strange = [cv2.flip(image, 1) for image in pictures(box.recording, range(0, 60, 2))]
    clip = write_video(tmp_path / "a.mp4", strange, stamps_ms=[40 * i for i in range(30)])
    code, _, err = run(capsys, "reconstruct", box.root, tmp_path / "out", "--imu", box.imu, "--video", clip)
    assert code == 2
    assert "give the video that the images were taken from" in err


def test_a_refused_scale_leaves_no_metric_project_and_exits_3(box, tmp_path, capsys):
    imu = tmp_path / "imu"
    imu.mkdir()
    for name in ("gyroscope.txt", "accelerometer.txt"):  # the recording of another take: time runs backwards
        rows = [line.split(" ", 1) for line in (box.imu / name).read_text().splitlines()]
        values = [row[1] for row in reversed(rows)]
        (imu / name).write_text("".join(f"{row[0]} {value}\n" for row, value in zip(rows, values, strict=True)))
    out = tmp_path / "out"
    flags = ["--imu", imu, "--frame-times", box.frame_times]
    code, _, err = run(capsys, "reconstruct", box.root, out, *flags)
    assert code == 3 and "--force" in err and str(out / "report.html") in err
    assert not (out / "result.json").exists()
    code, shown, _ = run(capsys, "reconstruct", box.root, out, *flags, "--force")
    assert code == 3
    assert "refused" in shown
    stored = json.loads((out / "result.json").read_text())
    assert stored["models"][0]["metres_per_unit"] is None
    assert stored["project_metric"] is None
    assert not (out / "sparse").exists() and not (out / "images").exists()
    assert not (out / "transform.json").exists()


def test_a_refused_project_is_named_from_anywhere(box, tmp_path, monkeypatch):
    described = tmp_path / "capture.toml"  # without an accelerometer, there is no scale
    described.write_text(
        f'[images]\nfolder = "{box.root / "images"}"\ntimes = "{box.frame_times}"\n[imu.gyro]\n'
        f'file = "{box.imu / "gyroscope.txt"}"\ntime = 1\ntime_unit = "ns"\ncolumns = [2, 3, 4]\nunit = "rad/s"\n'
    )
    monkeypatch.chdir(box.root.parent)
    out = tmp_path / "out"
    source = ProjectOptions(imu=described, images=Path(box.root.name) / "images")
    with pytest.raises(NotObservableError, match="a gyroscope but no accelerometer"):
        reconstruct_project(Path(box.root.name), tmp_path / "stopped", source)
    result = reconstruct_project(Path(box.root.name), out, source, ReconstructOptions(force=True))
    assert result.models[0].scale.verdict == "refused"
    stored = json.loads((out / "result.json").read_text())
    assert stored["models"][0]["sparse"] == str(box.root / "sparse" / "0")
    assert stored["capture"] == str(box.root)
    assert stored["project"]["images"] == str(box.root / "images")
    monkeypatch.chdir(tmp_path)
    # the folder may be a stranger's, and the path in it lead anywhere
    with pytest.raises(FormatError, match=f"give the project that it is of .{re.escape(str(box.root))}"):
        load_scene(out)
    scene = load_scene(box.root)
    assert len(scene.cameras) == result.models[0].summary["registered_images"]
    assert scene.image_of(0) == box.root / "images" / scene.cameras.names[0]
    page = (out / "report.html").read_text()
    assert "could not be aligned" not in page
    assert "cannot be used as it is" in page


def test_a_target_without_images_to_measure_it_in_is_said(box, tmp_path):
    described = tmp_path / "capture.toml"
    described.write_text(
        f'[images]\nfolder = "{box.root / "images"}"\ntimes = "{box.frame_times}"\n[imu]\npath = "{box.imu}"\n'
        '[target]\nspec = "aruco:DICT_4X4_50:0.1"\n'
    )
    project = poses_only(box, tmp_path / "project", box.names)
    result = reconstruct_project(project, tmp_path / "out", ProjectOptions(imu=described), NOT_REFINED)
    assert any("the target was not measured" in str(note) for note in result.models[0].scale.notes)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert "are missing" in report["models"][0]["validation"]["missing"]


def test_a_capture_toml_gives_imu_times_and_what_is_known_of_the_camera(box, tmp_path):
    described = tmp_path / "capture.toml"
    described.write_text(
        f'[images]\nfolder = "{box.root / "images"}"\ntimes = "{box.frame_times}"\n[timing]\nreadout_s = 0.0\n'
        f'exposure_s = 0.004\n[imu]\npath = "{box.imu}"\n[target]\nspec = "aruco:DICT_4X4_50:0.1"\n'
    )
    result = reconstruct_project(box.root, tmp_path / "out", ProjectOptions(imu=described), NOT_REFINED)
    assert_metric(box, tmp_path / "out")
    # the target is not in the pictures, on which the scale does not rest
    assert result.exit_code() == 0 and isinstance(result.models[0].validation, InertialError)
    times = json.loads((tmp_path / "out" / "frames.json").read_text())["timing"]
    assert times["readout_s"] == 0.0
    assert times["exposure_s"][0] == 0.004


def test_what_is_missing_or_makes_no_sense_is_said_before_any_work(box, video, tmp_path, capsys):
    out = tmp_path / "out"
    csv = ["--imu", box.imu, "--frame-times", box.frame_times]
    cases = [
        ([box.root, out], "give --imu"),
        ([box.root, out, "--imu", box.imu], "--exif-times, or --video"),
        ([box.root, out, *csv, "--name-times", "ns"], "give one of --frame-times"),
        ([box.root, out, *csv, "--deblur", "wiener"], "--deblur"),
        ([box.root, out, *csv, "--rolling-shutter", "rectify"], "--rolling-shutter"),
        ([box.root, out, *csv, "--mapping.max-num-features", "500"], "--mapping.max-num-features"),
        ([box.root, out, *csv, "--exposures.fusion", "mertens"], "--exposures.fusion"),
        ([box.imu, out, *csv], "holds no COLMAP model"),
        ([box.root, box.root / "metric", *csv], "lies within the other"),
        ([box.root, out, "--imu", box.imu, "--frame-times", tmp_path / "no.csv"], "no.csv"),
        ([box.root, out, *csv, "--images", tmp_path / "no"], "--images"),
        ([box.root / "sparse" / "0", out, *csv, "--dense"], "--images"),
        ([box.root / "sparse" / "0", out, "--imu", box.imu, "--video", video], "--images"),
    ]
    before = contents(box.root)
    for args, words in cases:
        code, _, err = run(capsys, "reconstruct", *args)
        assert code == 2, args
        assert words in err
    assert contents(box.root) == before
    assert not (out / "result.json").exists()


def test_a_metric_project_is_not_scaled_again(box, tmp_path, capsys):
    metric = tmp_path / "metric"
    assert run(capsys, "apply", box.root, metric, "--factor", "2")[0] == 0
    flags = ["--imu", box.imu, "--frame-times", box.frame_times]
    code, _, err = run(capsys, "reconstruct", metric, tmp_path / "out", *flags)
    assert code == 2
    assert "already holds a metric scale" in err


def test_each_sub_model_has_its_own_scale(box, tmp_path):
    import pycolmap

    project = shutil.copytree(box.root, tmp_path / "project")
    other = read_model(project / "sparse" / "0")
    other.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(np.array([0.0, 0.6, 0.0, 0.8])), np.array([1.0, 2.0, 3.0])))
    (project / "sparse" / "1").mkdir()
    other.write_binary(str(project / "sparse" / "1"))
    out = tmp_path / "out"
    source = ProjectOptions(imu=box.imu, frame_times=box.frame_times)
    result = reconstruct_project(project, out, source, NOT_REFINED)
    scales = [model.scale.metres_per_unit for model in result.models]
    assert scales[0] / scales[1] == pytest.approx(2, rel=1e-3)
    models = [read_model(out / "sparse" / str(i)) for i in (0, 1)]
    first, last = 1, len(box.names)
    spans = [m.image(first).projection_center() - m.image(last).projection_center() for m in models]
    assert np.linalg.norm(spans[0]) == pytest.approx(np.linalg.norm(spans[1]), rel=1e-3)
    assert (out / "trajectory.tum").is_file()
    assert (out / "trajectory_1.tum").is_file()


#: Metres from the origin, as in UTM.
FAR = np.array([432_100.25, 5_664_733.5, 120.0])


def test_a_project_far_from_the_origin_is_scaled_where_it_stands(box, finished, tmp_path):
    import pycolmap

    project = shutil.copytree(box.root, tmp_path / "project")
    model = read_model(project / "sparse" / "0")
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), FAR))
    model.write_binary(str(project / "sparse" / "0"))
    write_ply(project / "cloud.ply", xyz := np.array([point.xyz for point in model.points3D.values()]))
    (project / "scan.las").write_bytes(b"LASF")
    out = tmp_path / "out"
    source = ProjectOptions(imu=box.imu, frame_times=box.frame_times)
    reconstruct_project(project, out, source, NOT_REFINED)
    near = read_model(finished[1] / "sparse" / "0")
    far = read_model(out / "sparse" / "0")
    similarity = json.loads((out / "sparse" / "0" / "transform.json").read_text())
    scale, turn = similarity["scale"], matrix_from_quat(np.array(similarity["rotation_xyzw"]))
    # what was found is what is found at the origin, and the model stays where it is
    (there,) = json.loads((finished[1] / "result.json").read_text())["models"]
    (here,) = json.loads((out / "result.json").read_text())["models"]
    for name in ("metres_per_unit", "sigma_log", "verdict"):
        assert here[name] == (there[name] if name == "verdict" else pytest.approx(there[name], rel=1e-6))
    # what apply says of other files is said here, too
    assert any("1 .las" in note for note in here["notes"])
    assert here["of_model"]["poses"] == ModelIdentity.of(model).poses
    shift = far.image(1).projection_center() - near.image(1).projection_center()
    for number in far.reg_image_ids():
        centre = far.image(number).projection_center()
        np.testing.assert_allclose(centre, near.image(number).projection_center() + shift, atol=1e-6)
        was = model.image(number).projection_center()
        np.testing.assert_allclose(centre, scale * turn @ was + similarity["translation_m"], atol=1e-7)
        assert np.linalg.norm(centre - was) < 20
    np.testing.assert_allclose(
        read_tum(out / "trajectory.tum").cam_in_world,
        read_tum(finished[1] / "trajectory.tum").cam_in_world + shift,
        atol=1e-6,
    )
    # what is moved along: half a metre of the cloud's single precision is the project's own
    want = scale * ply_points(project / "cloud.ply") @ turn.T + similarity["translation_m"]
    assert np.abs(ply_points(project / "cloud.ply") - xyz).max() < 0.5
    np.testing.assert_allclose(ply_points(out / "cloud.ply"), want, atol=1e-7)
    # errors of scale and up are about the model, not about an origin thousands of kilometres away
    cov, place = np.array(similarity["cov"]), np.mean([i.projection_center() for i in far.images.values()], axis=0)
    arm = place - similarity["translation_m"]
    by = np.concatenate([arm[:, None], -skew(arm), np.eye(3)], axis=1)
    assert np.sqrt(np.diag(by @ cov @ by.T)).max() < 1


def test_a_dense_cloud_far_from_the_origin_is_refused_before_the_work(box, tmp_path, capsys):
    import pycolmap

    project = shutil.copytree(box.root, tmp_path / "project")
    model = read_model(project / "sparse" / "0")
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), FAR))
    model.write_binary(str(project / "sparse" / "0"))
    words = project, tmp_path / "out", "--imu", box.imu, "--frame-times", box.frame_times
    code, _, err = run(capsys, "reconstruct", *words, "--dense")
    assert code == 2
    assert "single precision" in err and "export" in err
    assert not (tmp_path / "out").exists()


def test_a_result_says_of_which_model_each_scale_is(box, finished, tmp_path, capsys):
    result = finished[1] / "result.json"
    code, shown, _ = run(capsys, "apply", box.root, tmp_path / "applied", "--scale", result)
    assert code == 0
    assert "does not name its model" not in shown
    other = read_model(box.root / "sparse" / "0")
    other.deregister_frame(other.image(3).frame_id)
    (tmp_path / "other" / "sparse" / "0").mkdir(parents=True)
    other.write_binary(str(tmp_path / "other" / "sparse" / "0"))
    code, _, err = run(capsys, "apply", tmp_path / "other", tmp_path / "no", "--scale", result)
    assert code == 2
    assert "images instead of" in err
    content = json.loads(result.read_text())
    del content["models"][0]["of_model"]
    (tmp_path / "old.json").write_text(json.dumps(content))
    code, shown, _ = run(capsys, "apply", tmp_path / "other", tmp_path / "yes", "--scale", tmp_path / "old.json")
    assert code == 0
    assert "does not name its model" in shown


def test_an_interrupted_run_continues(box, finished, tmp_path):
    source = ProjectOptions(imu=box.imu, frame_times=box.frame_times)

    class Stopped(Exception):
        pass

    def stop(stage, done, total):
        if stage == "apply":
            raise Stopped

    out = tmp_path / "out"
    with pytest.raises(Stopped):
        reconstruct_project(box.root, out, source, NOT_REFINED, progress=stop)
    assert not (out / "result.json").exists()
    assert not (out / "transform.json").exists() and not (out / "images").exists()
    first = reconstruct_project(box.root, out, source, NOT_REFINED)
    assert "times: finished in an earlier run, kept" in (out / "log.txt").read_text()
    (whole,) = json.loads((finished[1] / "result.json").read_text())["models"]
    assert first.models[0].scale.metres_per_unit == whole["metres_per_unit"]
    assert contents(out / "sparse") == contents(finished[1] / "sparse")
    assert not list(out.rglob("*partial*"))


def test_what_a_project_is(box, tmp_path):
    assert is_project(box.root)
    assert is_project(box.root / "sparse")
    assert is_project(box.root / "sparse" / "0")
    assert not is_project(box.root / "images")
    assert not is_project(tmp_path / "nowhere")
    described = tmp_path / "described"
    shutil.copytree(box.root / "sparse", described / "sparse")
    (described / "capture.toml").write_text("")
    assert not is_project(described)
    dataset = tmp_path / "asl"  # in which somebody ran COLMAP
    shutil.copytree(box.root / "sparse", dataset / "sparse")
    for file in ("cam0/data.csv", "cam0/data/1.png", "imu0/data.csv"):
        (dataset / file).parent.mkdir(parents=True, exist_ok=True)
        (dataset / file).write_text("")
    assert not is_project(dataset)
    with pytest.raises(ValueError, match="give one of"):
        ProjectOptions(exif_times=True, video=tmp_path)


def test_euroc_keyframes_mapped_by_colmap(shared_data, tmp_path, capsys):
    data = shared_data / "euroc_v101"
    out = tmp_path / "out"
    flags = ["--imu", data / "mav0" / "imu0", "--name-times", "ns", "--scale.max-offset-s", "1", *UNREFINED]
    code, _, err = run(capsys, "reconstruct", data / "colmap_sparse", out, *flags)
    assert code == 0, err
    metric = read_model(out / "sparse" / "0")
    # the truth is the IMU's pose; the camera sits beside it
    rows = np.loadtxt(data / "gt" / "V1_01_easy.csv", delimiter=",", comments="#", skiprows=1)
    cam_in_imu = sensor_yaml.read_body_from_sensor(data / "mav0" / "cam0" / "sensor.yaml")[:3, 3]
    turned = matrix_from_quat(rows[:, [5, 6, 7, 4]]) @ cam_in_imu
    images = [metric.image(i) for i in metric.reg_image_ids()]
    t_s = np.array([int(image.name.split("_")[0]) for image in images]) * 1e-9
    inside = (t_s > rows[0, 0] * 1e-9) & (t_s < rows[-1, 0] * 1e-9)
    assert inside.sum() > 90
    found = np.array([image.projection_center() for image in images])[inside]
    path = rows[:, 1:4] + turned
    true = np.stack([np.interp(t_s[inside], rows[:, 0] * 1e-9, path[:, k]) for k in range(3)], axis=1)
    u, singular, vt = np.linalg.svd((true - true.mean(0)).T @ (found - found.mean(0)))
    scale = singular.sum() / np.sum((found - found.mean(0)) ** 2)
    (model,) = json.loads((out / "result.json").read_text())["models"]
    low, high = np.array(model["ci95"]) / model["metres_per_unit"]
    assert low < scale < high
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    assert np.degrees(np.arccos(turn[2, 2])) < 1


def test_options_that_are_left_alone_pass():
    from colmap_inertial.run.commands.reconstruct_project import _check_options

    _check_options(ReconstructOptions(deblur="off", rolling_shutter="off", seed=4, deterministic=True))
    with pytest.raises(InertialError, match=r"--mapping\.first-octave, --deblur"):
        mapping = dataclasses.replace(ReconstructOptions().mapping, first_octave=0)
        _check_options(ReconstructOptions(mapping=mapping, deblur="wiener"))
