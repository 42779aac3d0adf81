"""Frames restored by a network in the pipeline: chosen by name, said in the result, never mixed with other frames."""

import io
import json
import sys
from contextlib import redirect_stdout
from dataclasses import replace

import cv2
import numpy as np
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core import threads
from colmap_inertial.core.errors import FormatError, MissingExtraError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.progress import silent
from colmap_inertial.imaging.restoration import shipped
from colmap_inertial.io.frames import read_frames
from colmap_inertial.report.content import _blur
from colmap_inertial.run.commands.images_alone import deblur_capture
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.preparation import plan as imaging
from colmap_inertial.run.stages import deblur as stages
from colmap_inertial.run.stages.deblur import DeblurStage
from colmap_inertial.run.stages.frame_folder import read_frame_records
from colmap_inertial.run.stages.imaging_plan import read_plan, write_plan
from colmap_inertial.run.steps.hashing import as_json_types
from tests.helpers import small_networks as small
from tests.helpers.corner_scene import CALIBRATED, LENS, CornerScene
from tests.helpers.desk_scene import contents
from tests.run.commands.test_reconstruct_blurred import QUICK, parts, planned

DEEP = replace(QUICK, deblur="deepgyro")


@pytest.fixture(scope="module")
def blurred(tmp_path_factory):
    """Pictures without loss, so that every pixel can be compared; all that are looked at confirm the gyroscope."""
    scene = CornerScene.make(exposure_s=0.03, readout_s=0.0, frames=8, vigour=0.8)
    return scene.write(tmp_path_factory.mktemp("blurred") / "capture", extra=CALIBRATED, suffix=".png")


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """A network in place of the package's that takes what lies halfway between the picture and the filter's result."""
    folder = tmp_path / "weights"
    small.write_weights(folder, deepgyro=small.mixing(0.5))
    monkeypatch.setattr(shipped, "folder", lambda: folder)
    return folder


@pytest.fixture(scope="module")
def by_filter(tmp_path_factory, blurred):
    out = tmp_path_factory.mktemp("by_filter") / "out"
    return deblur_capture(blurred, out, progress=silent)


@pytest.fixture(scope="module")
def deep_plan(tmp_path_factory, blurred):
    """What is decided where the network of ``weights`` is to treat the frames."""
    root = tmp_path_factory.mktemp("deep_plan")
    small.write_weights(root / "weights", deepgyro=small.mixing(0.5))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shipped, "folder", lambda: root / "weights")
        return planned(parts(blurred), root, deblur="deepgyro")


def pictures(folder):
    return {path.name: cv2.imread(str(path)).astype(int) for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def by_network(tmp_path_factory, blurred):
    """What the command makes with the network of ``weights``, and a contact sheet: (folder, what it says)."""
    root, said = tmp_path_factory.mktemp("by_network"), io.StringIO()
    small.write_weights(root / "weights", deepgyro=small.mixing(0.5))
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said), pytest.raises(SystemExit) as stopped:
        patch.setattr(shipped, "folder", lambda: root / "weights")
        sheet = root / "sheet.png"
        main(["deblur", str(blurred), str(root / "out"), "--method", "deepgyro", "--sheet", str(sheet)])
    assert stopped.value.code == 0
    return root, said.getvalue()


def test_the_network_treats_the_frames_that_the_filter_would_and_the_result_says_so(blurred, by_filter, by_network):
    root, said = by_network
    assert "DeepGyro" in said
    stored = json.loads((root / "out" / "result.json").read_text())
    assert stored["imaging"]["deblur_method"] == "deepgyro"
    assert "deblurred by the network DeepGyro" in stored["imaging"]["deblur"]
    before = json.loads(by_filter.workspace.result.read_text())
    assert before["imaging"]["deblur_method"] == "wiener" and "DeepGyro" not in before["imaging"]["deblur"]
    assert "the images confirm the gyroscope's blur" in before["imaging"]["deblur"]
    for new, old in zip(stored["frames"], before["frames"], strict=True):
        assert (new["name"], new["action"]) == (old["name"], old["action"])
        assert new["blur_px"] == pytest.approx(old["blur_px"], rel=0.02)
    filmed, filtered, made = map(pictures, (blurred / "frames", by_filter.workspace.images, root / "out" / "images"))
    deblurred = {frame["name"] for frame in stored["frames"] if frame["sharpened"]}
    assert len(deblurred) >= 6
    for name in filmed:
        if name in deblurred:
            # small models of treated frames tell of the translation: the blur is not quite the same
            assert np.abs(made[name] - (filmed[name] + filtered[name]) / 2).mean() < 1
            assert np.abs(made[name] - filmed[name]).max() > 20
        else:
            np.testing.assert_array_equal(made[name], filmed[name])
    assert cv2.imread(str(root / "sheet.png")).shape[1] > 2 * LENS.width


def test_the_report_says_which_network_it_was(by_network):
    done = json.loads((by_network[0] / "out" / "result.json").read_text())
    frames = {"names": [frame["name"] for frame in done["frames"]], "t_s": list(range(len(done["frames"])))}
    assert "DeepGyro" in str(_blur(done, {"frames": frames}, project=False)["note"])


def stop_at_features(stage, done, total, /):
    if stage == "features":
        raise KeyboardInterrupt


def test_a_resumed_run_does_not_mix_methods_or_networks(tmp_path, blurred, weights):
    out = tmp_path / "out"

    def images(options):
        with pytest.raises(KeyboardInterrupt):
            reconstruct(blurred, out, options, progress=stop_at_features)
        return contents(out / "colmap" / "images")

    def log():
        return (out / "log.txt").read_text()

    deep = images(DEEP)
    assert images(DEEP) == deep and log().count("frames: finished in an earlier run") == 1
    small.write_weights(weights, deepgyro=small.mixing(0.9))
    trained = images(DEEP)
    treated = {record.name for record in read_frame_records(out / "frames.json") if record.sharpened}
    assert len(treated) >= 6 and {name for name in deep if deep[name] != trained[name]} == treated
    by_filter = images(QUICK)
    assert {name for name in deep if trained[name] != by_filter[name]} >= treated
    # treated frames are also what the small models of the plan are made of
    for stage in ("imaging", "frames"):
        assert log().count(f"{stage}: finished in an earlier run") == 1


def test_a_stage_s_key_holds_method_and_network(blurred, deep_plan, weights, tmp_path):
    plan = deep_plan
    stage = DeblurStage.of_plan(plan)
    assert isinstance(stage, DeblurStage) and stage.weights == shipped.checksum("deepgyro")
    by_filter = replace(stage, method="wiener")
    assert by_filter.weights == "" and as_json_types(by_filter) != as_json_types(stage)
    small.write_weights(weights, deepgyro=small.mixing(0.1))
    assert as_json_types(replace(stage)) != as_json_types(stage)
    with pytest.raises(ValueError, match="method"):
        replace(stage, method="deepgiro")
    # the plan of an earlier run says which
    recording = parts(blurred)
    write_plan(tmp_path / "plan.json", plan)
    again = read_plan(tmp_path / "plan.json", recording.imu, recording.timing)
    assert again.method == "deepgyro" and DeblurStage.of_plan(again).method == "deepgyro"


def test_frames_need_not_speak_for_themselves_where_a_network_treats_them(blurred, deep_plan, weights):
    plan = deep_plan
    assert plan.deblur is not None
    decisions, verdict = plan.deblur
    # as in a recording of which only some frames confirm the gyroscope
    plan = replace(plan, deblur=(decisions, replace(verdict, trusted=None)))
    loaded = parts(blurred).capture
    treated = {}
    for method in ("wiener", "path", "deepgyro"):
        stage = DeblurStage.of_plan(replace(plan, method=method), drop=False)
        frames = list(stage(read_frames(loaded)[1]))
        treated[method] = {frame.name for frame in frames if frame.treatments[-1].action == "deblurred"}
    assert treated["wiener"] == treated["path"] < treated["deepgyro"]


def test_workers_share_the_network_and_make_the_same_pixels(blurred, deep_plan, weights, monkeypatch):
    stage = DeblurStage.of_plan(deep_plan)
    loaded = parts(blurred).capture
    one, three, filmed = (
        [frame.image for frame in frames]
        for frames in (
            replace(stage, workers=1)(read_frames(loaded)[1]),
            replace(stage, workers=3)(read_frames(loaded)[1]),
            read_frames(loaded)[1],
        )
    )
    filtered = [frame.image for frame in replace(stage, method="wiener")(read_frames(loaded)[1])]
    np.testing.assert_array_equal(one, three)
    asked = []
    with monkeypatch.context() as context:
        context.setattr(threads, "usable_processors", lambda: 16)
        context.setattr(stages, "load_network", lambda name, **options: asked.append((name, options)))
        list(replace(stage, workers=3)(iter([])))
    assert asked == [("deepgyro", {"threads": 14})]
    # half of whole codes; blur of half a pixel to a pixel fades out in both, and what was sharp stays
    halfway = (np.array(filmed, np.float32) + np.array(filtered, np.float32)) / 2
    off = np.abs(np.array(one) - halfway)
    assert np.mean(off > 1) < 0.01 and np.abs(np.array(filmed) - halfway).max() > 20


@pytest.mark.parametrize("lacking", ["onnxruntime", "network"])
def test_what_is_missing_is_told_before_any_work(tmp_path, blurred, weights, lacking, monkeypatch, capsys):
    if lacking == "onnxruntime":
        monkeypatch.setitem(sys.modules, "onnxruntime", None)
        error, words = MissingExtraError, "pip install 'onnxruntime>="
    else:
        (weights / "deepgyro.onnx").unlink()
        error, words = FormatError, "deepgyro.onnx: is missing"
    out = tmp_path / "out"
    with pytest.raises(error):
        reconstruct(blurred, out, DEEP)
    for args in (["deblur", "--method", "deepgyro"], ["reconstruct", "--deblur", "deepgyro"]):
        with pytest.raises(SystemExit) as stopped:
            main([args[0], str(blurred), str(out), *args[1:]])
        assert stopped.value.code == 2 and words in " ".join(capsys.readouterr().err.split())
    assert not out.exists()
    if lacking == "onnxruntime":  # nobody else needs either
        (weights / "deepgyro.onnx").unlink()
        assert planned(parts(blurred), tmp_path, deblur="wiener")


@pytest.mark.parametrize("method", ["wiener", "path", "deepgyro"])
def test_asked_for_by_name_it_is_an_error_where_gyroscope_and_pixels_do_not_agree(
    tmp_path, blurred, weights, method, monkeypatch
):
    def fails(*args, **kwargs):
        raise NotObservableError("time offset", Fact.stated("so"))

    monkeypatch.setattr(imaging, "estimate_preliminary_calibration", fails)
    with pytest.raises(NotObservableError):
        planned(parts(blurred), tmp_path, deblur=method)
    plan = planned(parts(blurred), tmp_path)
    assert DeblurStage.of_plan(plan) is None and plan.as_json()["deblur_method"] is None
