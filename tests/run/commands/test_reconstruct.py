"""``reconstruct`` on the committed example scene: real pictures, real COLMAP, known truth."""

import dataclasses
import json
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError, OutputExistsError
from colmap_inertial.core.facts import sentences
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate
from colmap_inertial.core.options import MappingOptions, ReconstructOptions
from colmap_inertial.io.trajectories import read_tum
from colmap_inertial.model import read_model
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.tools.simulate.truth import read_truth, true_metres_per_unit

SCENE = Path(__file__).parents[3] / "example_scenes" / "desk"
#: Enough for an accurate model of this scene, and many times faster than COLMAP's defaults.
FINE = ReconstructOptions(mapping=MappingOptions(max_num_features=600, first_octave=0, max_image_size=400))
#: Enough for a model and a scale of its first frames; three times faster again.
QUICK = ReconstructOptions(mapping=MappingOptions(max_num_features=600, first_octave=0, max_image_size=320))
DETERMINISTIC = dataclasses.replace(
    QUICK, deterministic=True, mapping=dataclasses.replace(QUICK.mapping, max_image_size=240)
)


@cache
def _half_size() -> dict[str, bytes]:
    """The example scene's pictures, half as wide and high, by name."""
    pictures = {path.name: cv2.imread(str(path)) for path in sorted((SCENE / "frames").iterdir())}
    halved = {name: cv2.resize(of, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for name, of in pictures.items()}
    return {name: cv2.imencode(".jpg", of, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes() for name, of in halved.items()}


def copy_scene(folder: Path, *, first: int | None = None, target: bool = False, half: bool = True) -> Path:
    """A copy of the example scene, or of its first frames.

    With its target, a run measures that in seconds more. It is found in pictures of full size alone; most options of
    these tests let COLMAP see at most half of that.
    """
    half = half and not target
    shutil.copytree(SCENE, folder, ignore=lambda _, names: {"frames"} & {*names} if half else ())
    text = (folder / "capture.toml").read_text()
    if half:
        (folder / "frames").mkdir()
        for name, data in _half_size().items():
            (folder / "frames" / name).write_bytes(data)
        for before, after in (
            ("width = 640", "width = 320"),
            ("height = 480", "height = 240"),
            ("[520.0, 520.0, 320.0, 240.0,", "[260.0, 260.0, 160.0, 120.0,"),
        ):
            assert before in text
            text = text.replace(before, after)
    if not target:
        text = text[: text.index("[target]")]
    (folder / "capture.toml").write_text(text)
    if first is not None:
        table = folder / "frames.csv"
        rows = table.read_text().splitlines()
        table.write_text("\n".join(rows[: first + 1]) + "\n")
        for row in rows[first + 1 :]:
            (folder / "frames" / row.split(",")[0]).unlink()
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Seven seconds of the scene, reconstructed once: (capture, out, result). Tests must not change it."""
    root = tmp_path_factory.mktemp("desk")
    capture = copy_scene(root / "capture", first=20, target=True)
    before = contents(capture)
    steps = []
    result = reconstruct(capture, root / "out", FINE, progress=lambda *step: steps.append(step))
    assert contents(capture) == before
    stages = list(dict.fromkeys(stage for stage, _, _ in steps))
    assert stages == ["check", "frames", "features", "matches", "mapping", "images", "metric", "validation"]
    # how much there is to match is said from the start, and hardly changes
    totals = [total for stage, _, total in steps if stage == "matches"]
    assert max(totals) / totals[-1] < 1.5 and totals[-1] / min(totals) < 1.5
    return capture, root / "out", result


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The first frames, reconstructed undisturbed: (capture, out, result). Tests must not change it."""
    root = tmp_path_factory.mktemp("whole")
    capture = copy_scene(root / "capture", first=10)
    return capture, root / "out", reconstruct(capture, root / "out", DETERMINISTIC)


@pytest.fixture(scope="module")
def truth():
    return read_truth(SCENE / "truth.json")


def centres(folder):
    model = read_model(folder)
    images = [model.image(i) for i in model.reg_image_ids()]
    return tuple(image.name for image in images), np.array([image.projection_center() for image in images])


def test_the_model_is_metric_within_its_own_interval(finished, truth):
    capture, _, result = finished
    (model,) = result.models
    names, found = centres(model.sparse_metric)
    assert len(names) == len(list((capture / "frames").iterdir()))
    error = 1 / true_metres_per_unit(names, found, truth.trajectory) - 1
    low, high = np.array(model.scale.ci95) / model.scale.metres_per_unit - 1
    assert abs(error) < 0.02
    assert low < -error < high
    assert result.exit_code() == 0
    assert abs(model.validation.scale_error_pct / 100 - error) < 0.003


def test_z_points_up(finished, truth):
    _, _, result = finished
    names, found = centres(result.models[0].sparse_metric)
    order = [truth.trajectory.names.index(name) for name in names]
    true = truth.trajectory.cam_in_world[order]
    u, _, vt = np.linalg.svd((true - true.mean(0)).T @ (found - found.mean(0)))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    assert np.degrees(np.arccos(rotation[2, 2])) < 1.0


def test_the_metric_model_is_colmap_s_model_scaled(finished):
    _, out, result = finished
    assert not (out / "colmap" / "sparse" / "0" / "transform.json").exists()
    transform = json.loads((out / "sparse" / "0" / "transform.json").read_text())
    names, before = centres(out / "colmap" / "sparse" / "0")
    after_names, after = centres(out / "sparse" / "0")
    assert names == after_names
    expected = transform["scale"] * before @ matrix_from_quat(np.array(transform["rotation_xyzw"])).T
    np.testing.assert_allclose(after, expected, atol=1e-9)
    assert transform["scale"] == result.models[0].scale.metres_per_unit


def test_the_trajectory_is_smooth_metric_and_says_how_well_it_is_known(finished, truth):
    _, out, _ = finished
    track = read_tum(out / "trajectory.tum")
    model_names, found = centres(out / "sparse" / "0")
    assert len(track) == len(model_names)
    by_name = dict(zip(model_names, found, strict=True))
    ordered = np.array([by_name[name] for name in sorted(by_name)])
    # the smoothed path lies within a centimetre of the metric model's own cameras
    assert np.sqrt(np.mean(np.sum((track.cam_in_world - ordered) ** 2, axis=1))) < 0.01
    stored = np.load(out / "trajectory_cov.npz")
    assert stored["cov"].shape == (len(track), 9, 9)
    np.testing.assert_allclose(stored["t_s"], track.t_s + track.epoch_ns * 1e-9, atol=1e-6)
    sigma_m = np.sqrt(np.diagonal(stored["cov"], axis1=1, axis2=2)[:, :3])
    assert 1e-5 < np.median(sigma_m) < 0.02
    # rotations are those of the cameras
    q = quat_conjugate(track.cam_from_world_xyzw)
    first = read_model(out / "sparse" / "0").find_image_with_name(sorted(by_name)[0])
    assert abs(np.dot(q[0], first.cam_from_world().rotation.inverse().quat)) > 0.9999


def test_the_result_file_says_everything(finished):
    capture, out, result = finished
    stored = json.loads((out / "result.json").read_text())
    (model,) = stored["models"]
    for key in ("metres_per_unit", "ci95", "verdict", "reasons", "gravity_in_world_m_s2", "accel_bias_m_s2"):
        assert key in model
    assert model["index"] == 0
    assert model["verdict"] == result.models[0].scale.verdict
    assert model["validation"]["within_tolerance"]
    assert {frame["action"] for frame in stored["frames"]} == {"passed"}
    assert "features: finished" in (out / "log.txt").read_text()
    assert " ERROR " not in (out / "log.txt").read_text()
    assert result.report == out / "report.html"
    assert "max_num_features = 600" in (out / "config.toml").read_text()
    assert not (out / "features.db").exists()
    for name in json.loads((out / "frames.json").read_text())["frames"]:
        original = capture / "frames" / name["name"]
        assert (out / "images" / name["name"]).read_bytes() == original.read_bytes()


def test_a_model_without_a_unit_is_scaled_by_the_target(finished, truth, tmp_path, capsys):
    _, out, _ = finished
    for folder, step in (("some", 3), ("few", 7)):  # so many pictures tell enough
        (tmp_path / folder).mkdir()
        for picture in sorted((out / "images").iterdir())[::step]:
            shutil.copy(picture, tmp_path / folder)
    command = ["validate", str(out / "colmap" / "sparse" / "0"), "--images", str(tmp_path / "some")]
    target, metric = tmp_path / "v.json", tmp_path / "metric"
    pictures = tmp_path / "pictures"
    flags = ["--unscaled", "--apply", str(metric), "--json", str(target), "--pictures", str(pictures)]
    with pytest.raises(SystemExit) as stopped:
        main([*command, "--target", "checkerboard:8x6:0.04", *flags])
    assert stopped.value.code == 0
    found = json.loads(target.read_text())
    assert found["scale_error_pct"] is None
    scale = true_metres_per_unit(*centres(out / "colmap" / "sparse" / "0"), truth.trajectory)
    assert found["metres_per_unit"] == pytest.approx(scale, rel=0.003)
    assert true_metres_per_unit(*centres(metric), truth.trajectory) == pytest.approx(1, rel=0.003)
    assert found["control"]["corners"] + found["check"]["corners"] == found["corners_used"]
    assert abs(found["check_error_pct"]) < 0.3
    assert (pictures / "distances.svg").is_file()

    # the metric copy passes, another square size does not, another target is not there
    command[1], command[3] = str(metric), str(tmp_path / "few")
    for spec, code in (("8x6:0.04", 0), ("8x6:0.05", 1), ("5x4:0.04", 5)):
        with pytest.raises(SystemExit) as stopped:
            main([*command, "--target", f"checkerboard:{spec}"])
        assert stopped.value.code == code
    with pytest.raises(SystemExit) as stopped:
        main([*command, "--target", "checkerboard:8x6:0.04", "--apply", str(tmp_path / "again")])
    assert stopped.value.code == 2
    assert "--unscaled" in capsys.readouterr().err


def test_a_finished_result_is_not_overwritten(finished, capsys):
    capture, out, _ = finished
    before = contents(out)
    again = reconstruct(capture, out, FINE)
    assert again.unchanged and [m.scale.metres_per_unit for m in again.models] == [
        m.scale.metres_per_unit for m in finished[2].models
    ]
    assert again.models[0].validation.as_json() == finished[2].models[0].validation.as_json()
    flags = ["--mapping.max-num-features", "600", "--mapping.first-octave", "0", "--mapping.max-image-size", "400"]
    with pytest.raises(SystemExit) as stopped:
        main(["reconstruct", str(capture), str(out), *flags])
    assert stopped.value.code == 0
    assert "nothing to do" in capsys.readouterr().out
    after = contents(out)
    assert {name for name in after if after[name] != before.get(name)} == {"log.txt"}
    assert set(after) == set(before)
    # somebody else's capture is not continued
    other = copy_scene(out.parent / "other", first=4)
    with pytest.raises(OutputExistsError, match="another capture"):
        reconstruct(other, out, FINE)


def test_a_refused_scale_keeps_colmap_s_model_and_exits_3(whole, tmp_path, capsys):
    capture, out, _ = whole
    unfinished = tmp_path / "out"
    shutil.copytree(out, unfinished)
    (unfinished / "result.json").unlink()
    gyro, accel = (capture / "gyro.csv").read_text(), (capture / "accel.csv").read_text()
    try:  # in place, because an unfinished run knows its capture by its path
        # the recording of another take: time runs backwards
        for name, text in (("gyro", gyro), ("accel", accel)):
            header, *rows = text.splitlines()
            stamps = [row.split(",", 1)[0] for row in rows]
            values = [row.split(",", 1)[1] for row in reversed(rows)]
            lines = [f"{t},{v}" for t, v in zip(stamps, values, strict=True)]
            (capture / f"{name}.csv").write_text("\n".join([header, *lines]) + "\n")
        result = reconstruct(capture, unfinished, DETERMINISTIC)
    finally:
        (capture / "gyro.csv").write_text(gyro)
        (capture / "accel.csv").write_text(accel)
    assert result.models[0].scale.verdict == "refused"
    with pytest.raises(NotObservableError, match="offset"):
        result.exit_code()
    stored = json.loads((unfinished / "result.json").read_text())
    assert stored["models"][0]["metres_per_unit"] is None
    assert (unfinished / "colmap" / "sparse" / "0").is_dir()
    assert not (unfinished / "sparse").exists()
    assert not list(unfinished.glob("trajectory*"))


#: Kills a run at each stage in turn. Each run is a process of its own that has the imports of this one.
KILLED = """
import os, signal, sys
from pathlib import Path
import cv2, pycolmap, scipy.optimize
from tests.run.commands.test_reconstruct import DETERMINISTIC
from colmap_inertial.run.commands.reconstruct import reconstruct

def run(at):
    def progress(stage, done, total):
        if stage == at and (done > 0 or total == 1):
            os.kill(os.getpid(), signal.SIGKILL)

    reconstruct(Path(sys.argv[1]), Path(sys.argv[2]), DETERMINISTIC, progress=progress)

for stage in sys.argv[4:]:
    child = os.fork()
    if child == 0:
        try:
            run(stage)
        finally:
            os._exit(1)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print(stage, code, (Path(sys.argv[2]) / "result.json").exists())
"""


def test_killed_at_every_stage_it_ends_as_if_undisturbed(whole, tmp_path):
    capture, out, undisturbed = whole
    killed = tmp_path / "killed"
    stages = ("frames", "features", "matches", "mapping", "images", "metric")
    command = [sys.executable, "-c", KILLED, str(capture), str(killed), str(Path(__file__).parents[3]), *stages]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout.splitlines() == [f"{stage} -9 False" for stage in stages], done.stderr
    resumed = reconstruct(capture, killed, DETERMINISTIC)
    kept = (killed / "log.txt").read_text().count("finished in an earlier run, kept")
    assert kept >= 4
    for folder in ("images", "sparse", "colmap/images", "colmap/sparse"):
        assert contents(out / folder) == contents(killed / folder), folder
    assert [m.scale.metres_per_unit for m in undisturbed.models] == [m.scale.metres_per_unit for m in resumed.models]
    assert not list(killed.rglob("*.partial*"))


def test_hooks_see_every_frame_keypoint_and_model(tmp_path):
    capture = copy_scene(tmp_path / "capture", first=14)
    seen, models = {}, []

    def every_frame_but_the_last(frames):
        kept = None
        for frame in frames:
            if kept is not None:
                yield dataclasses.replace(kept, image=kept.image // 2 + 60)
            kept = frame

    def shift(keypoints):
        seen[keypoints.name] = keypoints.xy_px + np.array([0.25, 0.0])
        return dataclasses.replace(keypoints, xy_px=seen[keypoints.name])

    def refuse(model):
        from colmap_inertial.core.types import ScaleEstimate

        models.append((model.colmap_index, model.reconstruction.num_reg_images()))
        estimate = ScaleEstimate(
            metres_per_unit=None, sigma_log=None, ci95=None, verdict="refused", method="joint", reasons=("mine",)
        )
        return dataclasses.replace(model, scale=estimate)

    result = reconstruct(
        capture,
        tmp_path / "out",
        QUICK,
        frame_stages=[every_frame_but_the_last],
        keypoint_stages=[shift],
        model_stages=[refuse],
    )
    assert [record.action for record in result.frames] == ["changed"] * 13 + ["dropped"]
    assert sorted(seen) == [record.name for record in result.frames[:-1]]
    assert len(list((tmp_path / "out" / "images").iterdir())) == 13
    assert models
    assert models[0][0] == 0
    assert sentences(result.models[0].scale.reasons) == ("mine",)
    with pycolmap.Database.open(str(tmp_path / "out" / "colmap" / "database.db")) as database:
        for image in database.read_all_images():
            stored = np.array(database.read_keypoints(image.image_id))
            np.testing.assert_allclose(stored[:, :2], seen[image.name], atol=1e-4)


def test_an_unreadable_picture_is_named_and_nothing_is_left_half_done(tmp_path, capsys):
    capture = copy_scene(tmp_path / "capture", first=6)
    broken = sorted((capture / "frames").iterdir())[3]
    broken.write_bytes(broken.read_bytes()[:200])
    with pytest.raises(SystemExit) as stopped:
        main(["reconstruct", str(capture), str(tmp_path / "out")])
    assert stopped.value.code == 2
    assert broken.name in capsys.readouterr().err
    assert not (tmp_path / "out" / "images").exists()
    assert not (tmp_path / "out" / "result.json").exists()


def test_too_few_frames_and_pictures_that_do_not_match_are_said(tmp_path, capsys):
    two = copy_scene(tmp_path / "two", first=2)
    with pytest.raises(InertialError, match="needs at least three"):
        reconstruct(two, tmp_path / "out", QUICK)

    noise = copy_scene(tmp_path / "noise", first=5)
    rng = np.random.default_rng(0)
    for path in (noise / "frames").iterdir():
        cv2.imwrite(str(path), rng.integers(0, 256, cv2.imread(str(path)).shape, dtype=np.uint8))
    with pytest.raises(SystemExit) as stopped:
        main(["reconstruct", str(noise), str(tmp_path / "out2")])
    assert stopped.value.code == 4
    told = capsys.readouterr().err
    assert "COLMAP found no model" in told
    assert f"findings and remedies: {tmp_path / 'out2' / 'report.html'}" in told


def test_a_missing_capture_is_said(tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["reconstruct", str(tmp_path / "nothing.toml"), str(tmp_path / "out")])
    assert stopped.value.code == 2
    assert "nothing.toml" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_gravity_priors_need_a_calibration_and_the_global_mapper(tmp_path):
    priors = MappingOptions(gravity_priors=True)
    with pytest.raises(InertialError, match=r"--mapping\.mapper global"):
        reconstruct(SCENE, tmp_path / "out", ReconstructOptions(mapping=priors))
    with pytest.raises(InertialError, match=r"\[calibration\]"):
        options = ReconstructOptions(mapping=dataclasses.replace(priors, mapper="global"))
        reconstruct(SCENE, tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


def test_gravity_priors_turn_the_global_mapper_s_world(tmp_path, truth):
    capture = copy_scene(tmp_path / "capture", first=14)
    calibration = truth.calibration
    with open(capture / "capture.toml", "a") as file:
        file.write(
            f"\n[calibration]\ncam_from_imu_xyzw = {calibration.cam_from_imu_xyzw.tolist()}\n"
            f"gyro_time_offset_s = {calibration.gyro_time_offset_s}\n"
            f"accel_time_offset_s = {calibration.accel_time_offset_s}\n"
        )
    mapping = dataclasses.replace(QUICK.mapping, mapper="global", gravity_priors=True)
    result = reconstruct(capture, tmp_path / "out", dataclasses.replace(QUICK, mapping=mapping))
    model = read_model(result.models[0].sparse)
    names = [model.image(i).name for i in model.reg_image_ids()]
    index = {name: i for i, name in enumerate(truth.trajectory.names)}
    down = []
    for image_id, name in zip(model.reg_image_ids(), names, strict=True):
        cam_from_world = matrix_from_quat(truth.trajectory.cam_from_world_xyzw[index[name]])
        down.append(model.image(image_id).cam_from_world().rotation.inverse().matrix() @ cam_from_world @ [0, 0, -1])
    assert np.degrees(np.arccos(np.mean(down, axis=0)[1])) < 5


def test_reading_a_capture_without_frames_is_an_error(tmp_path):
    capture = copy_scene(tmp_path / "capture")
    text = (capture / "capture.toml").read_text()
    start, end = text.index("[images]"), text.index("[timing]")
    (capture / "capture.toml").write_text(text[:start] + text[end:])
    with pytest.raises(FormatError, match=r"\[images\] or \[video\]"):
        reconstruct(capture, tmp_path / "out")


@pytest.mark.parametrize("command", ["reconstruct", "deblur"])
def test_a_recording_without_frames_is_said_before_any_work(tmp_path, command, capsys):
    (tmp_path / "imu.csv").write_text("t_ns,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n0,0,0,0,0,0,9.8\n")
    capture = tmp_path / "capture.toml"
    capture.write_text('[imu]\npath = "imu.csv"\n')
    with pytest.raises(SystemExit, match="2"):
        main([command, str(capture), str(tmp_path / "out")])
    assert "has no frames: add [images] or [video]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
