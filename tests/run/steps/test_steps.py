"""What is made again and what is kept, step by step; what steps are given, and what they leave behind."""

import contextlib
import json
import os
import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli import main
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features.extraction import (
    KeypointRecords,
    MatchRecord,
    extract_features,
    image_pairs,
    write_gravity_priors,
)
from colmap_inertial.colmap.mapping.mapper import MapRecord, map_images
from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.core.errors import FormatError, NotObservableError, OutputExistsError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import MappingOptions, ProjectOptions, ReconstructOptions
from colmap_inertial.core.progress import silent
from colmap_inertial.core.threads import map_in_order
from colmap_inertial.core.types import CALIBRATION_PARAMETERS, CameraModel, FrameTiming, ImuRecording, Treatment
from colmap_inertial.diagnose import Recorded, diagnose
from colmap_inertial.imaging.gate import RecordingVerdict
from colmap_inertial.io.calibration import Declared, calibration_prior, write_calibration
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.capture_images import LongExposures, SubImages
from colmap_inertial.io.files import write_json
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.frame_sources import ImageFolder
from colmap_inertial.io.recording import Recording, prior_calibration
from colmap_inertial.io.video_match import VideoMatch
from colmap_inertial.model import TRANSFORM_FILE
from colmap_inertial.model.similarities import ModelScale, plain_factor
from colmap_inertial.run.commands import (
    colmap_steps as steps,
    frames as framing,
    project_output,
    project_sources as existing,
)
from colmap_inertial.run.commands.frames import run_frames, run_images
from colmap_inertial.run.commands.paths import check_output
from colmap_inertial.run.preparation import calibrate, plan as imaging, sampling
from colmap_inertial.run.preparation.blur_check import Looked, judge_each_frame, judge_sky
from colmap_inertial.run.preparation.plan import Treatments, plan_imaging, run_plan
from colmap_inertial.run.preparation.preflight import stop_or_doubt
from colmap_inertial.run.preparation.selection import part_of
from colmap_inertial.run.stages.defaults import default_keypoint_stages
from colmap_inertial.run.stages.exposures import ExposureStage
from colmap_inertial.run.stages.frame_folder import FramePaths, FrameRecord, write_frames, write_images
from colmap_inertial.run.stages.imaging_plan import GyroView
from colmap_inertial.run.stages.inputs import Fuser, StageInputs
from colmap_inertial.run.stages.rolling_shutter import RollingShutterStage
from colmap_inertial.run.steps.runner import StepRunner
from colmap_inertial.run.steps.session import Session, open_session
from colmap_inertial.run.steps.workspace import Workspace, refuse_links
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording
from tests.helpers.desk_scene import contents
from tests.helpers.frame_readers import readers
from tests.helpers.sessions import frames_of, recording_of, session_in

NAMES = tuple(f"{i}.jpg" for i in range(6))
TIMING = FrameTiming(names=NAMES, t_s=np.arange(6.0), exposure_s=[0.01, 0.02, 0.03, 0.04, 0.05, 0.06])
T_S = np.arange(0.0, 6.0, 0.01)
IMU = ImuRecording(
    gyro_t_s=T_S,
    gyro_rad_s=np.tile([0.0, 3.0, 0.0], (len(T_S), 1)),
    accel_t_s=T_S,
    accel_m_s2=np.tile([0.0, 0.0, 9.81], (len(T_S), 1)),
)
OFF = Treatments(deblur="off", rolling_shutter="off")
CAMERA = CameraModel(model="PINHOLE", width=64, height=48, params=(60.0, 60.0, 32.0, 24.0))


def workspace_in(folder):
    workspace = Workspace(folder / "out")
    workspace.open(folder / "capture.toml")
    return workspace


@pytest.fixture
def workspace(tmp_path):
    return workspace_in(tmp_path)


def recording(**changes):
    return replace(recording_of(IMU, TIMING), **changes)


# --- what decides ----------------------------------------------------------------------------------------------------


def test_all_that_decides_a_plan_makes_it_again(subtests, tmp_path_factory):
    def made(workspace, *, asked=OFF, seed=0, **changes):
        context = RunContext(scratch=workspace.stamps, seed=seed)
        session = Session(workspace=workspace, runner=StepRunner(workspace), context=context)
        filmed = recording(**changes)
        run_plan(session, filmed, *readers(filmed, workspace.stamps), asked)
        return session.runner.worked

    for label, change in (
        ("calibration", {"prior": calibration_prior(Declared(gyro_time_offset_s=1.0))}),
        ("gyroscope", {"imu": replace(IMU, gyro_rad_s=2 * IMU.gyro_rad_s)}),
        ("readout", {"timing": replace(TIMING, readout_s=0.02)}),
        ("all frames", {"every": replace(TIMING, t_s=2 * TIMING.t_s)}),
        ("largest offset", {"max_offset_s": 0.5}),
        ("seed", {"seed": 1}),
        ("treatment", {"asked": replace(OFF, pairs=True)}),
    ):
        with subtests.test(label):
            workspace = workspace_in(tmp_path_factory.mktemp("given"))
            worked = [made(workspace), made(workspace), made(workspace, **change), made(workspace, **change)]
            assert worked == [["imaging"], [], ["imaging"], []]


def test_another_network_makes_the_plan_again(workspace, monkeypatch):
    def made(checksum):
        monkeypatch.setattr(imaging, "checksum", lambda name: f"{name} {checksum}")
        session = session_in(workspace)
        filmed = recording(timing=replace(TIMING, exposure_s=None))
        run_plan(session, filmed, *readers(filmed, workspace.stamps), replace(OFF, deblur="deepgyro"))
        return session.runner.worked

    assert [made("a"), made("a"), made("b")] == [["imaging"], [], ["imaging"]]


def test_a_picture_that_was_edited_makes_the_frames_again(workspace, tmp_path):
    timing, _ = frames_of(tmp_path / "in")
    capture = Capture(path=tmp_path, calibration=calibration_prior(), frames=ImageFolder(folder=tmp_path / "in"))
    filmed = Recording.of(capture, IMU, timing, capture.calibration)

    def made():
        session = session_in(workspace)
        run_frames(session, filmed, readers(filmed, tmp_path)[1], [], workspace.images)
        return session.runner.worked

    assert [made(), made()] == [["frames"], []]
    edited = tmp_path / "in" / "3.jpg"
    data = bytearray(edited.read_bytes())
    data[-10] ^= 1
    edited.write_bytes(data)
    assert made() == ["frames"]
    assert (workspace.images / "3.jpg").read_bytes() == data


def test_an_input_is_another_one_when_it_was_written_again(tmp_path):
    path = tmp_path / "gyro.csv"
    path.write_text("1.5")
    os.utime(path, ns=(10**18, 10**18))
    before = fingerprint(path)
    assert fingerprint(path) == before
    path.write_text("2.5")
    os.utime(path, ns=(10**18, 10**18 + 10**6))
    assert fingerprint(path) != before


def test_an_input_is_another_one_when_it_was_changed_with_size_and_time_kept(subtests, tmp_path_factory):
    for size, at in ((3, 1), (4 << 20, 3_000_000), (20 << 20, 5), (20 << 20, (20 << 20) - 5)):
        with subtests.test(size=size, at=at):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "frame.png"
            path.write_bytes(bytes(size))
            os.utime(path, ns=(10**18, 10**18))
            before = fingerprint(path)
            (tmp_path / "link.png").hardlink_to(path)
            path.chmod(0o600)
            assert fingerprint(path) == before
            with open(path, "r+b") as file:
                file.seek(at)
                file.write(b"x")
            os.utime(path, ns=(10**18, 10**18))
            assert fingerprint(path) != before


def test_nothing_is_written_into_the_folder_of_a_run_that_is_at_work(tmp_path):
    out = tmp_path / "out"
    workspace = Workspace(out)
    workspace.stamps.mkdir(parents=True)
    with workspace.locked():
        before = sorted(out.rglob("*"))
        options = ReconstructOptions()
        with (
            pytest.raises(OutputExistsError, match="another run is at work"),
            open_session(out, tmp_path / "capture.toml", options, pictures=()),
        ):
            pass
        assert sorted(out.rglob("*")) == before
    # another one had begun to make it meanwhile
    workspace.open(tmp_path / "other.toml")
    with (
        pytest.raises(OutputExistsError, match="another capture"),
        open_session(out, tmp_path / "capture.toml", options, pictures=()),
    ):
        pass
    assert not workspace.log.exists()


def test_a_calibration_of_another_recording_leaves_clocks_and_bias_open(tmp_path):
    stated = Declared(gyro_time_offset_s=7.0, gyro_bias_rad_s=[0.1, 0.0, 0.0], cam_from_imu_xyzw=[0.0, 0.0, 1.0, 0.0])
    write_calibration(tmp_path / "calibration.json", calibration_prior(stated))
    capture = recording().capture
    found = prior_calibration(capture, tmp_path / "calibration.json")
    np.testing.assert_array_equal(found.cam_from_imu_xyzw, [0, 0, 1, 0])
    assert found.rotation_sigma_rad < 0.1
    assert found.sigma("gyro_time_offset_s") > 1e3 and found.sigma("gyro_bias_x_rad_s") > 0.05
    assert prior_calibration(capture, None) is capture.calibration


def test_some_frames_keep_their_own_times_and_exposures():
    part = part_of(TIMING, ["4.jpg", "1.jpg"])
    assert part.names == ("1.jpg", "4.jpg")
    np.testing.assert_array_equal(part.t_s, [1.0, 4.0])
    np.testing.assert_array_equal(part.exposure_s, [0.02, 0.05])
    assert part_of(replace(TIMING, exposure_s=None), ["4.jpg"]).exposure_s is None


# --- what steps leave behind -----------------------------------------------------------------------------------------


def test_a_finished_result_is_added_to_and_repaired_and_replaced_only_when_asked(workspace):
    changed = Fact("option-changed", option="option", now=2, before=1)

    def run(step, option, **asked):
        target, runner = workspace.root / f"{step}.txt", StepRunner(workspace, **asked)
        runner.run(step, {"option": option}, [target], lambda partial: partial[0].write_text(f"{option}"))
        return runner.worked, workspace.result.is_file()

    assert run("a", 1) == (["a"], False)
    workspace.result.write_text("{}")
    assert run("a", 1) == ([], True)
    assert run("b", 1, changes=[changed]) == (["b"], True), "a step more leaves what there is as it is"
    with pytest.raises(OutputExistsError, match=r"step a would change: option = 2 \(was 1\); .*--overwrite"):
        run("a", 2, changes=[changed])
    assert (workspace.root / "a.txt").read_text() == "1" and workspace.result.is_file()
    (workspace.root / "a.txt").unlink()
    with pytest.raises(OutputExistsError, match="finished result"):
        run("a", 1, changes=[changed])
    assert run("a", 1) == (["a"], False), "while something is made again, there is no result"
    assert run("a", 2) == (["a"], False), "of an unfinished run, what changed is made again"
    workspace.result.write_text("{}")
    assert run("a", 3, overwrite=True) == (["a"], False)
    assert (workspace.root / "b.txt").read_text() == "1"


def test_what_a_run_does_not_make_goes_but_not_from_a_finished_result(workspace):
    def runner(**asked):
        return StepRunner(workspace, **asked)

    workspace.validation.mkdir()
    runner().discard(workspace.validation, workspace.georeference)
    assert not workspace.validation.exists()
    workspace.validation.mkdir()
    workspace.result.write_text("{}")
    runner().discard(workspace.georeference)
    runner().leave_out([])
    for ask in (lambda runner: runner.discard(workspace.validation), lambda runner: runner.leave_out(["dense"])):
        with pytest.raises(OutputExistsError, match="finished result"):
            ask(runner())
    assert workspace.validation.is_dir() and workspace.result.is_file()
    runner(overwrite=True).leave_out(["dense"])
    runner(overwrite=True).discard(workspace.validation)
    assert not workspace.validation.exists() and not workspace.result.exists()


def test_a_step_without_files_that_was_interrupted_is_not_finished(workspace):
    made = []

    def run(option, *, stopped=False):
        def work(partial):
            made.append(option)
            if stopped:
                raise KeyboardInterrupt

        with contextlib.suppress(KeyboardInterrupt):
            StepRunner(workspace).run("depth", {"option": option}, [], work)

    run(1)
    run(2, stopped=True)
    run(1)
    assert made == [1, 2, 1], "what the second one began may have replaced what the first one made"


def test_a_step_that_writes_something_more_makes_again_what_follows(workspace):
    """As after an update: what follows would be of what was there before."""

    def made(*names):
        runner = StepRunner(workspace)
        outputs = [workspace.root / name for name in names]
        runner.run("first", {}, outputs, lambda partial: [path.write_text("") for path in partial])
        runner.run("second", {}, [], lambda partial: None, after=["first"])
        return runner.worked

    assert [made("a"), made("a"), made("a", "b")] == [["first", "second"], [], ["first", "second"]]


@pytest.mark.parametrize("damage", ["delete", "cut", "overwrite"])
def test_a_lost_file_makes_its_step_again_and_what_depends_on_it_where_it_comes_out_otherwise(workspace, damage):
    texts = {"a": "a text", "c": "a text of its own"}

    def made():
        runner = StepRunner(workspace)
        folder, aside = workspace.root / "folder", workspace.root / "c.txt"

        def first(partial):
            partial[0].mkdir()
            (partial[0] / "a.txt").write_text(texts["a"])
            aside.write_text(texts["c"])

        runner.run("first", {}, [folder], first, beside=lambda: [aside])
        read = workspace.root / "b.txt"
        runner.run(
            "second",
            {},
            [read],
            lambda partial: partial[0].write_text((folder / "a.txt").read_text()),
            after=["first"],
        )
        runner.run("third", {}, [], lambda partial: None)
        return runner.worked

    def lose(name):
        path = workspace.root / name
        if damage == "delete":
            path.unlink()
        else:
            path.write_text("a t" if damage == "cut" else path.read_text().upper())

    assert [made(), made()] == [["first", "second", "third"], []]
    for name, again in (("folder/a.txt", "first"), ("c.txt", "first"), ("b.txt", "second")):
        lose(name)
        assert [made(), made()] == [[again], []]
    lose("folder/a.txt")
    texts["a"] = "no text"
    assert made() == ["first", "second"]
    assert (workspace.root / "b.txt").read_text() == "no text"


def test_links_and_copies_of_what_a_step_wrote_are_no_damage(workspace, tmp_path):
    def made():
        runner = StepRunner(workspace)
        runner.run("a", {}, [workspace.root / "a.txt"], lambda partial: partial[0].write_text("x"))
        return runner.worked

    assert made() == ["a"]
    (tmp_path / "link").hardlink_to(workspace.root / "a.txt")
    assert made() == []
    shutil.copytree(workspace.root, tmp_path / "copy")
    shutil.rmtree(workspace.root)
    shutil.copytree(tmp_path / "copy", workspace.root)
    assert made() == []


def test_how_often_a_database_was_opened_is_no_damage(tmp_path):
    with contextlib.closing(pycolmap.Database.open(str(tmp_path / "database.db"))):
        pass
    before = [str(path) for path in fingerprint(tmp_path)[0][3:]]
    with contextlib.closing(pycolmap.Database.open(str(tmp_path / "database.db"))):
        pass
    assert [str(path) for path in fingerprint(tmp_path)[0][3:]] == before


def test_a_folder_with_a_link_in_it_is_not_gone_on_with(subtests, tmp_path_factory):
    for name in ("colmap", "log.txt", ".stages/lock", "images/1.jpg"):
        with subtests.test(name=name):
            tmp_path = tmp_path_factory.mktemp("given")
            workspace = workspace_in(tmp_path)
            outside = tmp_path / "outside"
            outside.mkdir()
            (workspace.root / name).parent.mkdir(exist_ok=True)
            (workspace.root / name).symlink_to(outside)
            with (
                pytest.raises(FormatError, match=r"is a link to .*outside; links in an output folder are not followed"),
                open_session(workspace.root, tmp_path / "capture.toml", ReconstructOptions(), pictures=()),
            ):
                pass
            assert not any(outside.iterdir())
            (workspace.root / name).unlink()
            os.mkfifo(workspace.root / "pipe")
            with pytest.raises(FormatError, match=r"a device, a pipe or a socket"):
                refuse_links(workspace.root)


@pytest.mark.parametrize("name", ["sparse", "sparse/0/images.bin", "log.txt"])
def test_commands_that_read_a_model_in_such_a_folder_refuse_it(workspace, tmp_path, capsys, name):
    outside = tmp_path / "outside"
    outside.write_text("")
    for folder in ("sparse/0", "images", ".stages"):
        (workspace.root / folder).mkdir(parents=True, exist_ok=True)
    if name == "sparse":
        (workspace.root / "sparse").rename(outside := tmp_path / "model")
    (workspace.root / name).symlink_to(outside)
    model, images = (str(workspace.root / folder) for folder in ("sparse/0", "images"))
    for line in (
        ("validate", model, "--images", images, "--target", "checkerboard:8x6:0.04"),
        ("validate", str(tmp_path), "--images", images, "--target", "checkerboard:8x6:0.04"),
        ("scale", model, "--imu", images, "--frame-times", images),
        ("align", model, "--imu", images, "--frame-times", images, "--out", str(tmp_path / "calibration.json")),
    ):
        with pytest.raises(SystemExit, match="2"):
            main([*line])
        said = " ".join(capsys.readouterr().err.split())
        assert "is a link to" in said and "links in an output folder are not followed" in said, line


def test_links_of_a_project_may_stay_and_the_folder_itself_may_be_one(workspace, tmp_path):
    (workspace.root / "mesh").mkdir()
    (workspace.root / "mesh" / "latest.ply").symlink_to("fused.ply")
    with pytest.raises(FormatError, match="is a link"):
        refuse_links(workspace.root)
    workspace.placed.write_text(json.dumps({"paths": ["mesh"]}))
    (tmp_path / "link").symlink_to(workspace.root)
    ready = workspace.stamps / "project" / "mesh"  # of a run that was killed
    ready.mkdir(parents=True)
    (ready / "latest.ply").symlink_to("fused.ply")
    refuse_links(tmp_path / "link")
    (workspace.root / "mesh" / "other.ply").symlink_to(tmp_path)
    with pytest.raises(FormatError, match="is a link"):
        refuse_links(tmp_path / "link")


def test_what_says_whose_folder_it_is_was_damaged(workspace, tmp_path):
    workspace.owner.write_text("{")
    with pytest.raises(OutputExistsError, match="choose another folder, or remove this one"):
        workspace.prepare(tmp_path / "capture.toml", "reconstruct")


def test_small_models_of_a_killed_run_go_with_the_next_one(workspace, tmp_path):
    (workspace.stamps / "tmpx1y2z3ab" / "0").mkdir(parents=True)
    with open_session(workspace.root, tmp_path / "capture.toml", ReconstructOptions(), pictures=()):
        assert not list(workspace.stamps.glob("tmp*"))


def test_however_a_capture_is_spelt_its_steps_are_kept(workspace, tmp_path, monkeypatch):
    timing, _ = frames_of(tmp_path / "in")

    def made(folder):
        capture = Capture(path=folder, calibration=calibration_prior(), frames=ImageFolder(folder=folder / "in"))
        filmed = Recording.of(capture, IMU, timing, capture.calibration)
        session = session_in(workspace)
        run_frames(session, filmed, readers(filmed, tmp_path)[1], [], workspace.images)
        return session.runner.worked

    assert made(tmp_path) == ["frames"]
    for folder in ("in", ".stages"):
        monkeypatch.chdir(tmp_path / folder if folder == "in" else workspace.stamps)
        assert made(Path(os.path.relpath(tmp_path))) == []


def test_a_session_is_alone_in_its_folder_and_writes_its_options_with_its_result(tmp_path):
    def session(seed=0, **asked):
        options = replace(ReconstructOptions(), seed=seed)
        return open_session(tmp_path / "out", tmp_path / "capture.toml", options, pictures=(), **asked)

    def write(session, text, step="frames"):
        target = session.workspace.root / step
        session.runner.run(step, {"text": text}, [target], lambda partial: partial[0].write_text(text))
        return {"seconds": session.runner.seconds}

    with session() as first:
        with pytest.raises(OutputExistsError, match="another run is at work"), session():
            pass
        assert b"seed = 0" in first.workspace.config.read_bytes()
        assert not first.finish(write(first, "old"))
    with session() as again:
        assert again.finish(write(again, "old"))
    finished = contents(tmp_path / "out")
    with pytest.raises(OutputExistsError, match=r"step frames .* seed = 1 \(was 0\)"), session(seed=1) as other:
        write(other, "new")
    with pytest.raises(OutputExistsError, match=r"step frames .* seed = 1 \(was 0\)"), session(seed=1) as other:
        other.finish({})
    found = contents(tmp_path / "out")
    assert {name for name in found if found[name] != finished.get(name)} == {"log.txt"}
    with pytest.raises(KeyboardInterrupt), session(seed=1) as more:
        write(more, "old"), write(more, "dense", "dense")
        raise KeyboardInterrupt
    assert all(contents(tmp_path / "out")[name] == finished[name] for name in ("result.json", "config.toml", "frames"))
    with session(seed=1) as more:
        write(more, "old")
        assert not more.finish(write(more, "dense", "dense")) and more.runner.worked == []
    assert b"seed = 1" in (tmp_path / "out" / "config.toml").read_bytes()
    with session(seed=2, overwrite=True) as other:
        assert not other.finish(write(other, "new"))
    out = Workspace(tmp_path / "out")
    assert (out.root / "frames").read_text() == "new" and b"seed = 2" in out.config.read_bytes()
    assert {path.name for path in out.stamps.iterdir()} - {"lock"} == {"capture.json", "frames.json", "dense.json"}


def test_dropped_frames_are_not_written_and_say_why(tmp_path):
    timing, frames = frames_of(tmp_path / "in")

    def drop_the_second(stream):
        for frame in stream:
            said = tuple(Treatment(stage=stage, reason=f"{stage} said so") for stage in ("first", "last"))
            yield replace(frame, dropped=frame.name == "1.jpg", treatments=said)

    paths = FramePaths(source=tmp_path / "in", images=tmp_path / "out", records=tmp_path / "frames.json")
    write_frames(frames, timing.names, [drop_the_second], paths, silent)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [n for n in timing.names if n != "1.jpg"]
    records = framing.read_frame_records(tmp_path / "frames.json")
    assert [record.name for record in records if not record.used] == ["1.jpg"]
    assert {str(record.reason) for record in records} == {"last said so"}


def test_colmap_sees_a_frame_smoothed_and_everybody_else_as_it_is(tmp_path):
    timing, frames = frames_of(tmp_path / "in")
    rng = np.random.default_rng(2)

    def restored(stream):
        for frame in stream:
            image = rng.integers(0, 256, frame.image.shape).astype(np.uint8)
            yield replace(frame, image=image, smoothing_px=2.0) if frame.name in ("1.jpg", "2.jpg") else frame

    seen, kept = tmp_path / "seen", tmp_path / "kept"
    records = tmp_path / "frames.json"
    paths = FramePaths(source=tmp_path / "in", images=seen, records=records, unsmoothed=kept)
    write_frames(frames, timing.names, [restored], paths, silent)
    assert sorted(path.name for path in kept.iterdir()) == ["1.jpg", "2.jpg"]
    assert [record.action for record in framing.read_frame_records(records)].count("changed") == 2
    write_images(
        [lambda name, image: 255 - image], timing.names, {"2.jpg"}, seen, tmp_path / "out", silent, unsmoothed=kept
    )
    spread = {
        name: [float(cv2.imread(str(tmp_path / folder / name)).std()) for folder in ("seen", "kept", "out")]
        for name in ("1.jpg", "2.jpg")
    }
    assert all(smooth < 0.5 * itself and abs(out - itself) < 0.05 * itself for smooth, itself, out in spread.values())
    assert (tmp_path / "out" / "1.jpg").samefile(kept / "1.jpg")
    assert (tmp_path / "out" / "0.jpg").read_bytes() == (tmp_path / "in" / "0.jpg").read_bytes()
    with pytest.raises(ValueError, match="smoothing_px"):
        replace(next(frames_of(tmp_path / "more")[1]), smoothing_px=-1.0)


def test_pictures_whose_keypoints_stayed_are_copied(tmp_path):
    timing, _ = frames_of(tmp_path / "in")
    write_images([lambda name, image: 255 - image], timing.names, {"2.jpg"}, tmp_path / "in", tmp_path / "out", silent)
    for name in timing.names:
        same = (tmp_path / "out" / name).read_bytes() == (tmp_path / "in" / name).read_bytes()
        assert same == (name != "2.jpg")


def test_rectified_pictures_follow_the_frames(workspace, tmp_path):
    frames_of(tmp_path / "in")
    records = [FrameRecord(name=name, action="passed") for name in NAMES]

    def mover(keypoints):
        return keypoints

    mover.move_image = lambda name, image: 255 - image

    def made(option):
        session = session_in(workspace)

        def frames(partial):
            partial[0].mkdir()
            for name in NAMES:
                cv2.imwrite(str(partial[0] / name), np.full((8, 8), option, np.uint8))

        session.runner.run("frames", {"option": option}, [workspace.colmap_images], frames)
        run_images(session, records, {"2.jpg"}, [mover])
        return session.runner.worked

    assert [made(10), made(10), made(90)] == [["frames", "images"], [], ["frames", "images"]]
    assert cv2.imread(str(workspace.images / "2.jpg"))[0, 0, 0] == pytest.approx(165, abs=2)


def test_an_earlier_result_that_is_an_input_is_not_written_over(tmp_path):
    inputs = tmp_path / "inputs"
    inputs.mkdir()
    known = inputs / "calibration.json"
    write_calibration(known, calibration_prior())
    with pytest.raises(OutputExistsError, match="is an input"):
        check_output(known, [inputs / ".." / "inputs" / "calibration.json"])
    check_output(known, [inputs / "other.json"])  # an earlier result may be made again


# --- COLMAP's steps --------------------------------------------------------------------------------------------------


@pytest.fixture
def colmap(workspace, monkeypatch):
    """COLMAP's steps without COLMAP: what they were given, and which of them worked."""
    given = {}

    def extract(images, cameras, database, options, *, keypoint_stages, context, rig):
        given["images"] = list(cameras)
        database.write_text("features")
        return KeypointRecords()

    def match(features, database, recording, camera, options, context):
        given["matched"] = list(recording.timing.names)
        database.write_text("matches")
        counts = {"images": 2, "pairs": 1, "matched": 1, "verified": 1}
        return MatchRecord(device="cpu", pairing="exhaustive", gyroscope="", **counts), turned

    turned = ImageOrientations(part={"0.jpg": 0}, start_from_cam_xyzw={"0.jpg": (0.0, 0.6, 0.0, 0.8)})

    def map_them(database, images, target, *rest, orientations, **more):
        assert orientations == turned
        target.mkdir()
        return MapRecord(mapper="incremental", models=1)

    monkeypatch.setattr(steps, "extract_features", extract)
    monkeypatch.setattr(steps, "match_capture", match)
    monkeypatch.setattr(steps, "map_images", map_them)
    monkeypatch.setattr(steps, "write_gravity_priors", lambda database, gravity: given.update(gravity=gravity))

    def run(records, *, gravity=None, overlap=10, frames=0):
        session = session_in(workspace)
        session.runner.run("frames", {"option": frames}, [workspace.images], lambda partial: partial[0].mkdir())
        options = replace(ReconstructOptions(), mapping=MappingOptions(overlap=overlap))
        names = tuple(record.name for record in records if record.used)
        timing, capture = FrameTiming(names=names, t_s=np.arange(len(names)) * 0.1), SimpleNamespace(rig=())
        seen = SimpleNamespace(capture=capture, timing=timing, imu=None, prior=None, max_offset_s=None)
        steps.run_colmap(session, seen, records, [], gravity or {}, options)
        return session.runner.worked

    run.given = given
    return run


def used(*names, dropped=()):
    return [FrameRecord(name=n, action="dropped" if n in dropped else "passed", camera=CAMERA) for n in names]


def test_colmap_is_given_the_frames_that_are_used(colmap):
    colmap(used(*NAMES, dropped=("2.jpg",)))
    kept = [name for name in NAMES if name != "2.jpg"]
    assert colmap.given["images"] == kept
    assert colmap.given["matched"] == kept


def test_every_image_of_a_long_recording_is_matched_with_its_neighbours():
    names = [f"{i:03}" for i in range(300)]
    pairs = set(image_pairs(names, MappingOptions(overlap=3)))
    assert {(names[i], names[i + step]) for step in (1, 2, 3) for i in range(300 - step)} <= pairs
    assert all(a < b for a, b in pairs)


def test_whatever_changes_matches_makes_a_new_model(colmap):
    down = {"0.jpg": np.array([0.0, 1.0, 0.0])}
    every = ["features", "matches", "mapping"]
    # features are made inside of matches, and stay only until those are there
    assert sorted(colmap(used(*NAMES))) == ["features", "frames", "mapping", "matches"]
    assert colmap(used(*NAMES)) == []
    assert sorted(colmap(used(*NAMES), overlap=3)) == ["mapping", "matches"]  # features do not depend on pairs
    assert sorted(colmap(used(*NAMES), overlap=3, gravity=down)) == sorted(every)
    assert colmap.given["gravity"] is down
    assert sorted(colmap(used(*NAMES), overlap=3, gravity=down, frames=1)) == sorted([*every, "frames"])


@pytest.fixture(scope="module")
def features(tmp_path_factory):
    """Two textured pictures through extraction, of which a stage rectifies one."""
    folder = tmp_path_factory.mktemp("features")
    rng = np.random.default_rng(0)
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(folder / name), cv2.GaussianBlur(rng.integers(0, 255, (96, 128), np.uint8), (0, 0), 1.5))

    def rectify_a(keypoints):
        return replace(keypoints, rectified=keypoints.name == "a.png", xy_px=keypoints.xy_px + 1)

    found = extract_features(
        folder,
        {"a.png": None, "b.png": None},
        folder / "features.db",
        MappingOptions(first_octave=0, max_num_features=50),
        keypoint_stages=[rectify_a],
        context=RunContext(scratch=folder, num_threads=1),
    )
    return folder / "features.db", found


def test_colmap_numbers_images_by_name_whichever_thread_comes_to_an_end_first(tmp_path):
    rng = np.random.default_rng(0)
    names = [f"{i}.png" for i in range(6)]
    for i, name in enumerate(names):  # the first take longest
        picture = np.full((400, 400), 128, np.uint8)
        seen = picture[:, : 400 if i < 2 else 40]
        seen[:] = cv2.GaussianBlur(rng.integers(0, 255, seen.shape, np.uint8), (0, 0), 1.5)
        cv2.imwrite(str(tmp_path / name), picture)
    context = RunContext(scratch=tmp_path, num_threads=6)
    cameras = dict.fromkeys(reversed(names))
    extract_features(tmp_path, cameras, tmp_path / "x.db", MappingOptions(max_num_features=200), context=context)
    with pycolmap.Database.open(str(tmp_path / "x.db")) as database:
        found = {image.image_id: image.name for image in database.read_all_images()}
        assert [found[i] for i in sorted(found)] == names
        assert all(len(database.read_keypoints(i)) for i in found)
        assert len({image.camera_id for image in database.read_all_images()}) == len(database.read_all_cameras())


def test_it_is_recorded_whose_keypoints_are_those_of_a_global_shutter(features):
    _, found = features
    assert found.rectified() == {"a.png"} and len(found.images) == 2


def test_gravity_priors_point_down_in_the_camera(features, tmp_path):
    database, _ = features
    write_gravity_priors(database, {"b.png": np.array([0.0, 9.81, 0.0])})
    with pycolmap.Database.open(str(database)) as opened:
        (prior,) = opened.read_all_pose_priors()
        image = opened.read_image_with_name("b.png")
        assert prior.corr_data_id.id == image.image_id
    np.testing.assert_allclose(np.ravel(prior.gravity), [0.0, 1.0, 0.0])


@pytest.mark.parametrize("refine", [True, False])
def test_intrinsics_are_refined_where_that_is_asked_for(features, tmp_path, monkeypatch, refine):
    asked = []

    def mapping(database, images, target, options, **more):
        asked.append(options)
        return {0: None}

    monkeypatch.setattr(pycolmap, "incremental_mapping", mapping)
    map_images(
        features[0],
        tmp_path,
        tmp_path / "sparse",
        MappingOptions(refine_intrinsics=refine),
        context=RunContext(scratch=tmp_path),
    )
    (options,) = asked
    assert options.ba_refine_focal_length == options.ba_refine_extra_params == refine
    assert options.mapper.abs_pose_refine_focal_length == options.mapper.abs_pose_refine_extra_params == refine
    # unknown cameras are adjusted as often as COLMAP does
    usual = pycolmap.IncrementalPipelineOptions().ba_global_frames_ratio
    assert options.ba_global_frames_ratio == options.ba_global_points_ratio == (usual if refine else 1.4)


# --- before the reconstruction ---------------------------------------------------------------------------------------


def test_the_longest_exposure_tells_whether_anything_may_be_blurred(tmp_path, monkeypatch):
    def none(*_):
        raise NotObservableError("the pixels' motion", Fact.stated("looked at"))

    monkeypatch.setattr(imaging, "estimate_preliminary_calibration", none)
    capture = replace(recording().capture, camera=CAMERA)

    def note(exposure_s):
        timing = replace(TIMING, exposure_s=exposure_s)
        filmed = Recording.of(capture, IMU, timing, capture.calibration)
        return str(
            plan_imaging(
                filmed, *readers(filmed, tmp_path), RunContext(scratch=tmp_path), replace(OFF, deblur=None)
            ).deblur_note
        )

    # 3 rad/s and 60 px of focal length: 0.2 px in 1 ms, and 9 px in 50 ms
    assert "no frame has more than" in note([0.001] * 6)
    assert "looked at" in note([0.001] * 5 + [0.05])


def test_a_quick_turn_counts_where_a_frame_may_have_been_taken(subtests, tmp_path_factory, monkeypatch):
    def none(*_):
        raise NotObservableError("the pixels' motion", Fact.stated("looked at"))

    monkeypatch.setattr(imaging, "estimate_preliminary_calibration", none)
    for label, offset_sigma_s, turned_at_s, looked_at in (
        ("between frames", 0.001, 0.95, False),
        ("clocks are not known so well", 0.1, 0.95, True),
        ("while exposed", 0.001, 1.005, True),
        ("while read out", 0.001, 1.03, True),
        ("clocks are not known", None, 0.95, True),
    ):
        with subtests.test(label):
            t_s = np.arange(-1.0, 8.0, 0.005)
            rate = np.zeros((len(t_s), 3))
            rate[np.abs(t_s - turned_at_s) < 0.006] = [0, 9.0, 0]
            # stamps that are 300 s off, in another epoch
            imu = replace(
                IMU, gyro_t_s=t_s + 2 - 300.0, gyro_rad_s=rate, accel_t_s=t_s, accel_m_s2=np.ones((len(t_s), 3)),
                epoch_ns=TIMING.epoch_ns - 2_000_000_000,
            )  # fmt: skip
            known = calibration_prior(Declared(gyro_time_offset_s=300.0) if offset_sigma_s else None)
            cov = np.array(known.cov)
            at = CALIBRATION_PARAMETERS.index("gyro_time_offset_s")
            if offset_sigma_s:
                cov[at, at] = offset_sigma_s**2
            timing = replace(TIMING, t_s=np.arange(6.0), exposure_s=np.full(6, 0.01), readout_s=None)
            filmed = Recording.of(replace(recording().capture, camera=CAMERA), imu, timing, replace(known, cov=cov))
            scratch = tmp_path_factory.mktemp("given")
            context = RunContext(scratch=scratch)
            note = plan_imaging(filmed, *readers(filmed, scratch), context, replace(OFF, deblur=None)).deblur_note
            assert (note.code == "frames-untreated") == looked_at and (note.code == "blur-nowhere") != looked_at


@pytest.mark.parametrize("exposure_s", [None, TIMING.exposure_s], ids=["unknown", "known"])
def test_pairs_are_aligned_by_the_gyroscope_only_where_exposures_are_known(tmp_path, exposure_s):
    long = LongExposures(source=SubImages(folder=tmp_path / "long"), delay_s=0.02, exposure_s=0.1)
    capture = replace(recording().capture, frames=ImageFolder(folder=tmp_path), exposures=long)
    filmed = recording(capture=capture, timing=replace(TIMING, exposure_s=exposure_s))
    view = GyroView(imu=IMU, timing=filmed.timing, calibration=calibration_prior(), camera=CAMERA, source="capture")
    fuser = Fuser(fuse=lambda *pair: pair[0], identity="first")
    stage = ExposureStage.for_run(StageInputs(recording=filmed, plan=imaging.ImagingPlan(view=view), fuser=fuser))
    assert stage.view is (None if exposure_s is None else view)
    np.testing.assert_allclose(stage.long.t_s, TIMING.t_s + 0.02)


def test_a_mirrored_gyroscope_stops_a_reconstruction():
    simulated = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=20.0)), seed=5)
    imu = simulated.imu
    exchanged = replace(imu, gyro_rad_s=imu.gyro_rad_s[:, [1, 0, 2]], accel_m_s2=imu.accel_m_s2[:, [1, 0, 2]])
    assert stop_or_doubt(diagnose(Recorded(imu=imu, trajectory=simulated.trajectory)), force=False) == ()
    told = diagnose(Recorded(imu=exchanged, trajectory=simulated.trajectory))
    assert "gyro-mirrored" in told.codes
    # the finding alone: whatever else such a recording shows
    told = replace(told, findings=tuple(one for one in told.findings if one.code == "gyro-mirrored"))
    with pytest.raises(NotObservableError, match="--force continues"):
        stop_or_doubt(told, force=False)
    (doubt,) = stop_or_doubt(told, force=True)
    assert doubt.code == "forced-to-go-on"


def test_what_was_not_to_be_rectified_is_not():
    plan = imaging.ImagingPlan(view=object())
    assert default_keypoint_stages(StageInputs(recording=recording(), plan=plan)) == []
    rectifying = StageInputs(recording=recording(), plan=replace(plan, rectify=True))
    assert [type(stage) for stage in default_keypoint_stages(rectifying)] == [RollingShutterStage]


def test_no_frame_is_dropped_where_nothing_bridges_the_gap():
    actions = ["drop", "keep", "drop", "deblur", "drop", "drop"]
    decisions = tuple(
        imaging.FrameDecision(name=str(i), blur_px=9.0, action=action, reason="") for i, action in enumerate(actions)
    )
    kept = [decision.action for decision in imaging._keeping_ends(decisions)]
    assert kept == ["deblur", "keep", "drop", "deblur", "deblur", "deblur"]


class Shown:
    """What a frame says of the gyroscope's blur."""

    enough = extent_is_plausible = True
    tiles = 100.0

    def __init__(self, support, other=0.0, standing=90.0):
        self.support = support
        self.standing = SimpleNamespace(tiles=standing)
        self.sigmas = np.full((19, 12), other)


def test_a_gyroscope_is_trusted_for_all_frames_where_nearly_all_bear_it_out(subtests):
    for clear, trusted in ((20, True), (10, None), (1, None)):
        with subtests.test(clear=clear, trusted=trusted):
            verdict = RecordingVerdict(trusted=True, support=9.0, extent_factor=1.0, frames=20, reason="")
            clearly, hardly = Looked(Shown(20.0), 0.8, 20.0), Looked(Shown(-1.0), 0.2, 20.0)
            assert judge_each_frame(verdict, [clearly] * clear + [hardly] * (20 - clear)).trusted is trusted
            # a faint dip is none of a wrong gyroscope where detail lacks along the blur and no other dips
            faintly, elsewhere = Looked(Shown(1.0), 0.5, 20.0), Looked(Shown(1.0, other=6.0), 0.5, 20.0)
            assert judge_each_frame(verdict, [clearly] * clear + [faintly] * (20 - clear)).trusted is True
            assert judge_each_frame(verdict, [clearly] * clear + [elsewhere] * (20 - clear)).trusted is trusted
            # of a sky, what stands below it must show the gyroscope's direction, not the mirrored one
            below, neither = (
                Looked(Shown(1.0, other=6.0, standing=40.0), 0.5, 20.0, mirrored) for mirrored in (0.1, 0.4)
            )
            assert judge_each_frame(verdict, [clearly] * clear + [below] * (20 - clear)).trusted is True
            assert judge_each_frame(verdict, [clearly] * clear + [neither] * (20 - clear)).trusted is trusted
            # short blur tells nothing
            assert (
                judge_each_frame(verdict, [clearly] * clear + [replace(hardly, blur_px=5.0)] * (20 - clear)).trusted
                is True
            )


def test_a_gyroscope_that_few_dips_show_is_borne_out_by_what_stands_below_the_sky():
    refused = RecordingVerdict(trusted=False, support=1.0, extent_factor=1.0, frames=10, reason="")
    rng = np.random.default_rng(0)

    def looked(share, mirrored, standing=40.0, count=10):
        draws = rng.normal([share, mirrored], 0.1, (count, 2))
        return [Looked(Shown(1.0, standing=standing), a, 6.0, b) for a, b in draws]

    assert judge_sky(refused, looked(0.6, 0.0)).trusted is True
    wrong = [looked(0.0, 0.6), looked(0.0, 0.0), looked(0.6, 0.6), looked(0.6, 0.0, standing=90.0)]
    for one in (*wrong, looked(0.6, 0.0, count=4), looked(0.6, 0.0)[:5] + looked(-0.6, 0.0)[:5]):
        assert judge_sky(refused, one) is refused
    assert judge_sky(replace(refused, trusted=None), looked(0.6, 0.0)).trusted is None


def test_the_middle_of_a_recording_stands_for_it():
    timing = FrameTiming(names=tuple(map(str, range(1000))), t_s=np.arange(1000) / 10)
    chosen = timing.t_s[sampling.sample_middle(timing, 0.5, 60)]
    assert len(chosen) == 60 and np.diff(chosen).min() >= 0.5 - 1e-9
    assert 0.5 * (chosen[0] + chosen[-1]) == pytest.approx(50, abs=1)


def test_the_largest_of_the_small_models_goes_first(tmp_path, monkeypatch):
    def models(database, images, target, *rest, **more):
        for number, frames in enumerate((3, 7, 5)):
            options = pycolmap.SyntheticDatasetOptions()
            options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, frames, 20
            (target / str(number)).mkdir(parents=True)
            pycolmap.synthesize_dataset(options).write_binary(str(target / str(number)))

    monkeypatch.setattr(calibrate, "extract_features", lambda *args, **more: None)
    monkeypatch.setattr(calibrate, "match_pairs", lambda *args, **more: None)
    monkeypatch.setattr(calibrate, "map_images", models)
    found = calibrate._small_models(
        recording().capture, tmp_path, NAMES, tmp_path / "work", None, RunContext(scratch=tmp_path)
    )
    assert [model.num_reg_images() for model in found] == [7, 5, 3]


# --- an existing project ---------------------------------------------------------------------------------------------


def test_the_readout_turns_with_the_pictures(subtests, tmp_path_factory, monkeypatch):
    """Pictures of a video whose rows are read downwards, turned counterclockwise so many times."""
    stamps_ns = np.arange(4) * 10**8
    every = FrameTiming(names=tuple("abcd"), t_s=stamps_ns / 1e9, readout_s=0.02)
    monkeypatch.setattr(existing, "video_stamps_ns", lambda video: stamps_ns)
    monkeypatch.setattr(existing, "read_frame_timing", lambda capture: every)
    for turns in range(4):
        with subtests.test(turns=turns):
            tmp_path = tmp_path_factory.mktemp("given")
            match = VideoMatch(
                t_ns={f"{i}.png": int(t) for i, t in enumerate(stamps_ns)}, doubtful={}, quarter_turns=turns
            )
            monkeypatch.setattr(existing, "match_to_video", lambda *args, match=match, **more: match)
            capture = recording().capture
            timing, _ = existing._read_video_times(capture, tmp_path / "a.mp4", tmp_path, list(match.t_ns), silent)
            read_at = np.rot90(np.repeat(np.arange(5.0)[:, None], 5, axis=1), turns)
            down, right = read_at[-1, 2] - read_at[0, 2], read_at[2, -1] - read_at[2, 0]
            expected = {(4, 0): "down", (-4, 0): "up", (0, 4): "right", (0, -4): "left"}[int(down), int(right)]
            assert timing.readout_direction == expected


def test_another_scale_makes_the_project_again(workspace, tmp_path, monkeypatch):
    project = tmp_path / "project"
    project.mkdir()

    class Done:
        notes, models = (), {}

    def apply(project, out, scales, **more):
        out.mkdir()
        (out / "scale").write_text(str(scales[0].similarity.scale))
        write_json(out / TRANSFORM_FILE, {"models": [], "files": []})
        return Done

    monkeypatch.setattr(project_output, "apply_to_project", apply)

    def made(scale):
        session = session_in(workspace)
        scales = {0: ModelScale(similarity=scale and plain_factor(scale))}
        found = project_output.place_project(session, project, ProjectOptions(), {0: project}, scales)
        return session.runner.worked, found and (found / "scale").read_text()

    assert made(2.0) == (["apply"], "2.0")
    assert made(2.0) == ([], "2.0")
    assert made(3.0) == (["apply"], "3.0")
    # what is gone comes again, and goes where no scale is accepted any more
    (workspace.root / "scale").unlink()
    assert made(3.0) == (["apply"], "3.0")
    assert made(None) == ([], None)
    assert [path.name for path in workspace.root.iterdir()] == [workspace.stamps.name]
    assert made(3.0) == (["apply"], "3.0")


def test_work_that_is_let_go_of_in_one_of_its_own_threads_ends(monkeypatch):
    """As the garbage collector does after a failure, a full disk for one."""
    ignored = []
    monkeypatch.setattr("sys.unraisablehook", ignored.append)
    holder, ended = {}, threading.Event()

    def work(item):
        if item == 1:
            ended.wait(10)
            holder.pop("stream").close()
            ended.clear()
        return item

    holder["stream"] = map_in_order(work, range(5), workers=1)
    assert next(holder["stream"]) == 0
    ended.set()
    until = time.monotonic() + 10
    while ended.is_set() and time.monotonic() < until:
        time.sleep(0.01)
    assert not ended.is_set() and not ignored


def test_what_a_killed_writer_left_is_removed_and_nothing_else(tmp_path):
    out = tmp_path / "out"
    options = ReconstructOptions()
    with open_session(out, tmp_path / "capture.toml", options, pictures=()) as session:
        stamps = session.workspace.stamps
    left = [out / ".result.json.123-0a1b2c3d.tmp", stamps / ".frames.json.9-deadbeef.tmp"]
    other = [out / ".mine.tmp", out / "a.123-0a1b2c3d.tmp"]
    for path in (*left, *other):
        path.touch()
    with open_session(out, tmp_path / "capture.toml", options, pictures=()):
        assert not any(path.exists() for path in left) and all(path.exists() for path in other)
