"""Deblurring and rolling shutter in the pipeline: better models, nothing lost, everything said."""

import json
import os
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_inertial.cli import main
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.core.errors import InertialError, NotObservableError
from colmap_inertial.core.options import MappingOptions, ReconstructOptions
from colmap_inertial.core.progress import silent
from colmap_inertial.imaging.psf import blur_field
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.exif import carry_metadata, read_exposures_s
from colmap_inertial.io.frames import read_frames
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.io.recording import Recording, prior_calibration
from colmap_inertial.model import colmap_camera, read_model
from colmap_inertial.run.commands.images_alone import deblur_capture
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.preparation import calibrate as first_look, plan as imaging
from colmap_inertial.run.preparation.plan import Treatments, add_stated_exposures, plan_imaging
from colmap_inertial.run.preparation.selection import part_of
from colmap_inertial.run.preparation.translation import find_parallaxes
from colmap_inertial.run.stages.deblur import DeblurStage
from colmap_inertial.run.stages.imaging_plan import read_plan, write_plan
from colmap_inertial.tools.simulate import MotionOptions, make_motion
from tests.helpers.corner_scene import CALIBRATED, LENS, CornerScene
from tests.helpers.desk_scene import contents
from tests.helpers.frame_readers import readers

QUICK = ReconstructOptions(mapping=MappingOptions(max_num_features=700, first_octave=0), deterministic=True)
OFF = replace(QUICK, deblur="off", rolling_shutter="off")


def exif(exposure=(1, 25)):
    """A TIFF structure that states an exposure time, as EXIF holds it."""
    directory = struct.pack("<HHHIII", 1, 0x8769, 4, 1, 26, 0)
    inner = struct.pack("<HHHIII", 1, 0x829A, 5, 1, 44, 0)
    return b"II*\0" + struct.pack("<I", 8) + directory + inner + struct.pack("<II", *exposure)


def with_exif(jpeg):
    body = b"Exif\0\0" + exif()
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


def edges(image):
    """Power of what is finer than a few pixels and coarser than noise."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    return float((cv2.GaussianBlur(grey, (0, 0), 1.5) - cv2.GaussianBlur(grey, (0, 0), 3)).var())


def centre_error_m(folder, scene):
    """Root mean square distance of a model's cameras from the truth after the best similarity."""
    model = read_model(folder)
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    found = np.array([image.projection_center() for image in images])
    true = scene.centres()[[int(image.name[:4]) for image in images]]
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, size, vt = np.linalg.svd(b.T @ a)
    size[2] *= np.sign(np.linalg.det(u @ vt))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.sqrt(np.mean(np.sum((b - size.sum() / np.sum(a**2) * a @ rotation.T) ** 2, axis=1))))


@pytest.fixture(scope="module")
def rolling(tmp_path_factory):
    """A capture with 30 ms of readout, reconstructed without and with treatment."""
    root = tmp_path_factory.mktemp("rolling")
    scene = CornerScene.make(exposure_s=0.002, readout_s=0.03, frames=9, vigour=1.4)
    capture = scene.write(root / "capture")
    before = contents(capture)
    results = [reconstruct(capture, root / name, options) for name, options in (("off", OFF), ("on", QUICK))]
    assert contents(capture) == before
    return scene, root, results


def test_without_the_rolling_shutter_cameras_are_several_times_more_accurate(rolling):
    scene, _, (off, on) = rolling
    assert off.models[0].summary["registered_images"] == on.models[0].summary["registered_images"] == scene.frames
    assert centre_error_m(on.models[0].sparse, scene) < 0.3 * centre_error_m(off.models[0].sparse, scene)
    assert on.models[0].summary["mean_reprojection_error_px"] < off.models[0].summary["mean_reprojection_error_px"]


def test_the_metric_model_lacks_the_camera_s_translation_within_the_readout_too(rolling):
    scene, root, (_, on) = rolling
    metric, sparse = on.models[0].sparse_metric, on.models[0].sparse
    assert centre_error_m(metric, scene) < 0.8 * centre_error_m(sparse, scene)
    assert "translation within the readout" in (root / "on" / "log.txt").read_text()


def test_images_and_model_agree_where_keypoints_were_rectified(rolling):
    _, root, _ = rolling
    names = {path.name for path in (root / "on" / "colmap" / "images").iterdir()}
    assert {path.name for path in (root / "on" / "images").iterdir()} == names
    before, after = (cv2.imread(str(root / "on" / folder / "0007.jpg")) for folder in ("colmap/images", "images"))
    assert before.shape == after.shape and np.abs(before.astype(int) - after).mean() > 2
    # what COLMAP saw are the very files of the capture
    for name in names:
        assert (root / "on" / "colmap" / "images" / name).read_bytes() == (
            root / "capture" / "frames" / name
        ).read_bytes()


def test_the_result_shows_the_calibration_from_before_and_after(rolling):
    _, root, (off, _) = rolling
    stored = json.loads((root / "on" / "result.json").read_text())
    assert stored["imaging"]["calibration"]["source"] == "model"
    assert stored["imaging"]["calibration"]["gyro_time_offset_s"] == pytest.approx(-11.0, abs=2e-3)
    assert stored["models"][0]["calibration_change"]["rotation_deg"] < 1
    assert abs(stored["models"][0]["calibration_change"]["gyro_time_offset_s"]) < 2e-3
    assert all(frame["rectified"] and frame["action"] == "passed" for frame in stored["frames"])
    assert "readout 30.0 ms" in stored["imaging"]["rolling_shutter"]
    assert off.imaging.view is None and off.imaging.deblur_note.code == "not-asked-for"
    assert contents(root / "off" / "images") == contents(root / "off" / "colmap" / "images")


@pytest.fixture(scope="module")
def scene():
    return CornerScene.make(exposure_s=0.03, readout_s=0.0, frames=18)


@pytest.fixture(scope="module")
def long(tmp_path_factory, scene):
    """Dim light, and a camera that knows its IMU; every picture has EXIF."""
    return scene.write(tmp_path_factory.mktemp("long") / "capture", metadata=with_exif, extra=CALIBRATED)


@pytest.fixture(scope="module")
def blurred(tmp_path_factory, long):
    """Its first ten frames, which are enough for most tests."""
    capture = tmp_path_factory.mktemp("blurred") / "capture"
    shutil.copytree(long, capture)
    header, *rows = (capture / "frames.csv").read_text().splitlines()
    (capture / "frames.csv").write_text("\n".join([header, *rows[:10]]) + "\n")
    for row in rows[10:]:
        (capture / "frames" / row.split(",")[0]).unlink()
    return capture


@pytest.fixture(scope="module")
def deblurred(tmp_path_factory, blurred):
    out = tmp_path_factory.mktemp("deblurred")
    return deblur_capture(blurred, out / "out", sheet=out / "sheet.png", progress=silent)


def stop(stage, done, total, /):
    if stage == "features":
        raise KeyboardInterrupt


@pytest.fixture(scope="module")
def stopped(tmp_path_factory, blurred):
    """A run that was stopped when its pictures were made. Tests must not change it."""
    out = tmp_path_factory.mktemp("stopped") / "out"
    with pytest.raises(KeyboardInterrupt):
        reconstruct(blurred, out, QUICK, progress=stop)
    return out


def test_deblurred_images_see_more_of_the_scene(tmp_path, scene, blurred, stopped):
    shutil.copytree(stopped, tmp_path / "on")
    off, on = (reconstruct(blurred, tmp_path / name, o) for name, o in (("off", OFF), ("on", QUICK)))
    before, after = off.models[0].summary, on.models[0].summary
    assert after["registered_images"] >= before["registered_images"]
    assert after["observations"] > 1.1 * before["observations"]
    assert centre_error_m(on.models[0].sparse, scene) < centre_error_m(off.models[0].sparse, scene)
    assert on.imaging.view.source == "capture"
    low, high = on.models[0].scale.ci95
    assert low < high and on.models[0].scale.verdict != "refused"
    # COLMAP saw the deblurred frames smoothed; who goes on from the model does not
    for record in on.frames:
        seen, made = (tmp_path / "on" / folder / record.name for folder in ("colmap/images", "images"))
        if record.sharpened:
            sharper = edges(cv2.imread(str(made))) / edges(cv2.imread(str(seen)))
            # of short blur, hardly
            assert sharper > (1.1 if record.value("blur_px") > 12 else 1)
            assert exif() in seen.read_bytes() and exif() in made.read_bytes()
        else:
            assert seen.read_bytes() == made.read_bytes()
    assert contents(tmp_path / "off" / "images") == contents(tmp_path / "off" / "colmap" / "images")


def test_deblur_keeps_names_sizes_metadata_and_says_what_it_did(blurred, deblurred):
    out = deblurred.workspace
    stored = json.loads(out.result.read_text())
    names = sorted(path.name for path in (blurred / "frames").iterdir())
    assert sorted(path.name for path in out.images.iterdir()) == names == [f["name"] for f in stored["frames"]]
    actions, crisper = [frame["action"] for frame in stored["frames"]], []
    assert actions.count("deblurred") >= 8 and set(actions) <= {"deblurred", "passed"}
    for frame in stored["frames"]:
        original, new = (folder / frame["name"] for folder in (blurred / "frames", out.images))
        assert frame["blur_px"] > 0 and frame["reason"]
        if frame["action"] == "passed":
            assert new.read_bytes() == original.read_bytes() and frame["kept_share"] == 1
        else:
            assert exif() in new.read_bytes() and new.read_bytes() != original.read_bytes()
            before, after = (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in (original, new))
            assert before.shape == after.shape and before.dtype == after.dtype
            crisper.append(edges(after) / edges(before))
    assert np.median(crisper) > 1.2
    sheet = cv2.imread(str(deblurred.sheet))
    assert sheet is not None and sheet.shape[1] > 2 * LENS.width
    # a line of words on white says first what the red lines are; each row begins with one, too
    for line in (sheet[:22], sheet[22:44]):
        assert np.median(line) == 255 and line.min() < 128


#: Deblurs for matching, on one processor where they can be chosen.
AGAIN = """
import os, sys
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from colmap_inertial.cli import main
main(["deblur", sys.argv[1], sys.argv[2], "--for", "matching", "--quiet"])
"""


@pytest.fixture(scope="module")
def alone(tmp_path_factory, blurred):
    """What one processor makes for matching, in a process of its own."""
    out = tmp_path_factory.mktemp("alone") / "out"
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    arguments = [sys.executable, "-c", AGAIN, str(blurred), str(out)]
    done = subprocess.run(arguments, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processors cannot be chosen here")
def test_deblurring_for_matching_on_one_processor_makes_what_colmap_saw_of_several(alone, stopped):
    assert contents(alone / "images") == contents(stopped / "colmap" / "images")


def test_images_for_matching_are_not_those_for_viewing(deblurred, alone):
    frames = json.loads((alone / "result.json").read_text())["frames"]
    treated = [frame["name"] for frame in frames if frame["sharpened"]]
    assert len(treated) >= 8
    for name in treated:
        assert (alone / "images" / name).read_bytes() != (deblurred.workspace.images / name).read_bytes()


def test_a_finished_folder_is_not_touched_again(blurred, deblurred):
    before = contents(deblurred.workspace.root)
    assert deblur_capture(blurred, deblurred.workspace.root, progress=silent).unchanged
    after = contents(deblurred.workspace.root)
    assert {name for name in before if before[name] != after[name]} <= {"log.txt"}


def test_a_stopped_run_does_not_deblur_again(tmp_path, blurred, stopped):
    shutil.copytree(stopped, tmp_path / "out")
    before = contents(stopped / "colmap" / "images")
    stages = []
    with pytest.raises(KeyboardInterrupt):
        reconstruct(
            blurred, tmp_path / "out", QUICK, progress=lambda s, d, t, /: (stages.append(s), stop(s, d, t))
        )  # fmt: skip
    assert set(stages) == {"features"} and contents(tmp_path / "out" / "colmap" / "images") == before
    log = (tmp_path / "out" / "log.txt").read_text()
    assert "imaging: finished in an earlier run" in log and "frames: finished in an earlier run" in log
    # another decision makes the frames again
    with pytest.raises(KeyboardInterrupt):
        reconstruct(blurred, tmp_path / "out", replace(QUICK, deblur="off"), progress=stop)
    assert contents(tmp_path / "out" / "colmap" / "images") == contents(blurred / "frames")


def parts(capture):
    loaded = load_capture(capture)
    timing, _ = read_frames(loaded)
    timing = add_stated_exposures(loaded, timing)
    return Recording.of(loaded, read_capture_imu(loaded), timing, prior_calibration(loaded, None))


def planned(recording, scratch, **asked):
    return plan_imaging(recording, *readers(recording, scratch), RunContext(scratch=scratch), Treatments(**asked))


@pytest.fixture(scope="module")
def plan(deblurred):
    return deblurred.imaging


def blur_errors(scene, plan):
    """Median distances from the true blur, px: by turning alone, and with the translation."""
    motion, camera = plan.view.motion(), colmap_camera(plan.view.camera)
    at = np.stack(np.meshgrid(np.arange(2, 24, 3), np.arange(2, 18, 3)), axis=-1).reshape(-1, 2)
    off = {"turning": [], "both": []}
    for i, name in enumerate(plan.view.timing.names):
        true = scene.true_blur(i, 16 * at + 0.5)
        for kind, parallax in (("turning", None), ("both", plan.parallaxes.get(name))):
            field = blur_field(motion, camera, plan.view.shutter(i), parallax=parallax)
            off[kind].append(np.linalg.norm(field.vector_px[at[:, 1], at[:, 0]] - true, axis=1))
    return np.median(off["turning"]), np.median(off["both"])


def test_blur_by_translation_is_known_to_a_fraction_of_a_pixel(scene, plan):
    assert set(plan.parallaxes) == set(plan.view.timing.names) and plan.deblur_note.values["with_translation"]
    turning, both = blur_errors(scene, plan)
    assert both < 0.4 and both < 0.15 * turning


def test_a_long_recording_is_surveyed_in_parts(tmp_path, monkeypatch, scene, long):
    limits = replace(first_look._LIMITS, segment_frames=9, model_frames=9)
    monkeypatch.setattr(first_look, "_LIMITS", limits)
    plan = planned(parts(long), tmp_path)
    assert len(plan.parallaxes) >= 12  # three seconds hardly give a scale
    turning, both = blur_errors(scene, plan)
    assert both < 0.6 * turning


def test_frames_too_blurred_for_a_small_model_are_deblurred_for_the_next(tmp_path, monkeypatch):
    # so much blur that a small model of blurred frames lacks many of them
    scene = CornerScene.make(exposure_s=0.08, readout_s=0.0, frames=14, vigour=1.4)
    capture = scene.write(tmp_path / "capture", extra=CALIBRATED)
    registered = []

    def watched(models, view):
        registered.append(sum(model.num_reg_images() for model in models))
        return find_parallaxes(models, view)

    monkeypatch.setattr(imaging, "find_parallaxes", watched)
    plan = planned(parts(capture), tmp_path)
    assert registered[0] < 0.9 * scene.frames and registered[-1] > 1.1 * registered[0]
    assert len(plan.parallaxes) >= 12
    turning, both = blur_errors(scene, plan)
    assert both < 0.35 * turning


def test_the_plan_reads_back_and_the_stage_keeps_order_and_memory(tmp_path, blurred, plan):
    recording = parts(blurred)
    loaded, imu, timing = recording.capture, recording.imu, recording.timing
    write_plan(tmp_path / "plan.json", plan)
    again = read_plan(tmp_path / "plan.json", imu, timing)
    write_plan(tmp_path / "again.json", again)
    assert (tmp_path / "again.json").read_text() == (tmp_path / "plan.json").read_text()
    assert again.deblur == plan.deblur and set(again.parallaxes) == set(plan.parallaxes)
    stage = replace(DeblurStage.of_plan(plan), workers=3)
    taken = []

    def frames():
        for frame in read_frames(loaded)[1]:
            taken.append(frame.name)
            yield frame

    for i, frame in enumerate(stage(frames())):
        assert frame.name == timing.names[i] and len(taken) <= i + 5
        assert [said.stage for said in frame.treatments] == ["deblur"] and frame.treatments[0].reason


@pytest.mark.parametrize("said_s", [0.015, 0.06])
def test_exposure_times_that_are_wrong_by_a_common_factor_are_corrected_and_said(tmp_path, blurred, said_s):
    capture = tmp_path / "capture"
    shutil.copytree(blurred, capture)
    text = (capture / "capture.toml").read_text()
    (capture / "capture.toml").write_text(text.replace("exposure_s = 0.03\n", f"exposure_s = {said_s}\n"))
    plan = planned(parts(capture), tmp_path)
    assert plan.deblur is not None
    verdict = plan.deblur[1]
    assert verdict.trusted is True and verdict.extent_factor == pytest.approx(0.03 / said_s, rel=0.15)
    assert plan.deblur_note.values["verdict"].code == "exposures-off-by-factor"


def test_unknown_exposure_leaves_every_frame_and_says_why(tmp_path, blurred):
    capture = tmp_path / "capture"
    shutil.copytree(blurred, capture)
    text = (capture / "capture.toml").read_text()
    (capture / "capture.toml").write_text(text.replace("exposure_s = 0.03\n", ""))
    loaded = parts(capture).capture
    timing = add_stated_exposures(loaded, read_frames(loaded)[0])
    np.testing.assert_allclose(timing.exposure_s, 0.04)  # by EXIF
    for path in (capture / "frames").iterdir():
        path.write_bytes(path.read_bytes().replace(exif(), exif((0, 1))))
    result = deblur_capture(capture, tmp_path / "out", progress=silent)
    assert contents(tmp_path / "out" / "images") == contents(capture / "frames")
    stored = json.loads((tmp_path / "out" / "result.json").read_text())
    assert all("exposure time is unknown" in frame["reason"] for frame in stored["frames"])
    assert result.imaging.view is None


def test_a_stabilised_video_is_refused_where_asked_and_left_alone_otherwise(tmp_path, capsys):
    scene = CornerScene.make(exposure_s=0.03, readout_s=0.02, frames=3)
    capture = scene.write(tmp_path / "capture", extra=CALIBRATED)
    lively = make_motion(MotionOptions(kind="pure_rotation", duration_s=4.0, vigour=1.0), np.random.default_rng(2))
    t_s = np.arange(0.0, 4.0, 0.005)
    rows = np.column_stack([t_s + 11.0, lively.rate_in_cam_rad_s(t_s)])
    np.savetxt(capture / "gyro.csv", rows, delimiter=",", header="t,x,y,z", comments="")
    rows[:, 1:] = [0.0, 0.0, 9.81]
    np.savetxt(capture / "accel.csv", rows + 0.01 * np.random.default_rng(1).standard_normal(rows.shape) * [0, 1, 1, 1],
               delimiter=",", header="t,x,y,z", comments="")  # fmt: skip
    shutil.rmtree(capture / "frames")
    (capture / "frames").mkdir()
    table = ["name,t_ns"]
    wide = np.round(255 * scene.textures[0] ** 0.45).astype(np.uint8)
    for i in range(50):
        cv2.imwrite(str(capture / "frames" / f"{i:04}.jpg"), wide[100:400, 100 + i : 500 + i])
        table.append(f"{i:04}.jpg,{200_000_000 + round(i * 1e9 / 15)}")
    (capture / "frames.csv").write_text("\n".join(table) + "\n")
    with pytest.raises(SystemExit) as stopped:
        main(["deblur", str(capture), str(tmp_path / "out")])
    assert stopped.value.code == 3
    assert "stabilised in the camera" in capsys.readouterr().err
    assert not (tmp_path / "out" / "result.json").exists() and not (tmp_path / "out" / "images").exists()
    recording = parts(capture)
    with pytest.raises(NotObservableError, match="stabilised"):
        planned(recording, tmp_path, deblur="off", rolling_shutter="rectify")
    plan = planned(recording, tmp_path)
    assert plan.view is plan.deblur is None and not plan.rectify
    assert DeblurStage.of_plan(plan) is None
    assert "stabilised" in str(plan.deblur_note) and "stabilised" in str(plan.rolling_shutter_note)
    # where a few frames were chosen from the video, all of them are followed
    few = recording.using(part_of(recording.timing, recording.timing.names[::7]))
    with pytest.raises(NotObservableError, match="stabilised"):
        planned(few, tmp_path, rolling_shutter="rectify")


def test_rectifying_needs_a_readout(tmp_path, blurred):
    recording = parts(blurred)
    unknown = recording.using(replace(recording.timing, readout_s=None))
    with pytest.raises(InertialError, match="readout_s"):
        planned(unknown, tmp_path, rolling_shutter="rectify")


def test_metadata_of_png_and_jpeg_is_carried_over(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    jpeg, png = (cv2.imencode(suffix, image)[1].tobytes() for suffix in (".jpg", ".png"))
    chunk = b"eXIf" + exif()
    import zlib

    whole = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    with_chunk = png[:33] + whole + png[33:]
    for original, encoded, suffix in ((with_exif(jpeg), jpeg, ".jpg"), (with_chunk, png, ".png")):
        carried = carry_metadata(original, encoded)
        assert exif() in carried
        np.testing.assert_array_equal(
            cv2.imdecode(np.frombuffer(carried, np.uint8), cv2.IMREAD_UNCHANGED),
            cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED),
        )
        path = tmp_path / f"a{suffix}"
        path.write_bytes(carried)
        np.testing.assert_allclose(read_exposures_s([path, path]), 0.04)
        path.write_bytes(encoded)
        assert read_exposures_s([path]) is None
    assert carry_metadata(b"BM...", b"BM....") == b"BM...."
    (tmp_path / "a.tif").write_bytes(exif())
    assert read_exposures_s([Path(tmp_path / "a.tif")]) is not None
