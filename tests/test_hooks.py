"""The hooks are equal doors: what a result says happened is what the stages did, whoever wrote them."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial import (
    Frame,
    InertialError,
    Keypoints,
    Model,
    ReconstructOptions,
    Treatment,
    reconstruct,
    write_calibration,
)
from colmap_inertial.core.errors import OutputExistsError
from colmap_inertial.hooks import insert_defaults
from tests.helpers.desk_scene import DETERMINISTIC, contents, copy_scene


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """The first frames of the desk, said to have a rolling shutter."""
    folder = copy_scene(tmp_path_factory.mktemp("hooks") / "capture", first=10)
    file = folder / "capture.toml"
    text = file.read_text()
    assert "readout_s = 0.0" in text
    file.write_text(text.replace("readout_s = 0.0", "readout_s = 0.015", 1))
    return folder


def stored(out: Path) -> dict:
    return json.loads((out / "result.json").read_text())


@pytest.fixture(scope="module")
def bare(capture, tmp_path_factory):
    """No stage at all before COLMAP."""
    out, stages = tmp_path_factory.mktemp("bare") / "out", []
    options = DETERMINISTIC
    result = reconstruct(
        capture, out, options, frame_stages=[], keypoint_stages=[], progress=lambda stage, *_: stages.append(stage)
    )
    return out, result, stages


def test_without_keypoint_stages_nothing_is_said_to_be_rectified(bare):
    out, result, stages = bare
    said = stored(out)
    assert not any(frame["rectified"] for frame in said["frames"])
    assert said["imaging"]["rectify"] is False
    assert "rectified" not in said["imaging"]["rolling_shutter"]
    names = [frame["name"] for frame in said["frames"]]
    assert all((out / "images" / name).samefile(out / "colmap" / "images" / name) for name in names)
    assert result.keypoints.rectified() == frozenset()
    # and nothing was prepared that no stage needs
    assert not {"calibration", "survey", "motion", "blur"} & set(stages)
    assert said["models"][0]["readout_translation"] is None


def test_a_stage_beside_the_defaults_and_one_that_drops_with_a_reason(tmp_path):
    capture = copy_scene(tmp_path / "capture", first=9)
    names = sorted(path.name for path in (capture / "frames").iterdir())

    def without_two(frames):
        for frame in frames:
            if frame.name == names[3]:
                why = Treatment(stage="mine", reason="somebody walks by", values={"people": 1})
                yield dataclasses.replace(frame, dropped=True, treatments=(*frame.treatments, why))
            elif frame.name != names[5]:
                yield frame

    result = reconstruct(capture, tmp_path / "out", DETERMINISTIC, frame_stages=[without_two, ...])
    actions = {record.name: record.action for record in result.frames}
    assert [name for name in names if actions[name] == "dropped"] == [names[3], names[5]]
    assert sorted(path.name for path in (tmp_path / "out" / "images").iterdir()) == [
        name for name in names if name not in (names[3], names[5])
    ]
    said = {frame["name"]: frame for frame in stored(tmp_path / "out")["frames"]}
    assert said[names[3]]["reason"] == "somebody walks by"
    (why,) = result.frames[3].treatments
    assert why.values == {"people": 1}


def test_dots_stand_for_the_defaults_once():
    assert insert_defaults([1, ..., 2], [7, 8]) == [1, 7, 8, 2]
    assert insert_defaults([], [7]) == [] and insert_defaults([...], [7]) == [7]
    with pytest.raises(ValueError, match="once"):
        insert_defaults([..., ...], [7])


class Joining:
    """Joins nothing."""

    def __call__(self, model: Model, /) -> Model:
        return model

    def join_models(self, models):
        return tuple(models), ()


class JoiningInstead(Joining):
    replaces = (Joining,)


def test_one_stage_joins_models_and_may_stand_in_for_the_default_one():
    default, own = Joining(), JoiningInstead()
    with pytest.raises(InertialError, match="two model stages join models"):
        insert_defaults([..., Joining()], [default])
    assert insert_defaults([..., own], [7, default]) == [7, own]


def test_two_joining_stages_are_refused_before_any_work(capture, tmp_path):
    with pytest.raises(InertialError, match="JoinStage and Joining"):
        reconstruct(capture, tmp_path / "out", DETERMINISTIC, model_stages=[..., Joining()])
    assert not (tmp_path / "out").exists()


def test_what_a_visitor_s_keypoint_stage_did_is_what_the_result_says(capture, tmp_path):
    moved = []

    class Rectify:
        def __call__(self, keypoints: Keypoints, /) -> Keypoints:
            said = Treatment(stage="mine", reason="by hand", action="rectified")
            return dataclasses.replace(
                keypoints, xy_px=keypoints.xy_px, rectified=True, treatments=(*keypoints.treatments, said)
            )

        def move_image(self, name, image):
            moved.append(name)
            return 255 - image

    models = []

    def look(model: Model) -> Model:
        models.append(model)
        return model

    out = tmp_path / "out"
    result = reconstruct(
        capture, out, DETERMINISTIC, frame_stages=[], keypoint_stages=[Rectify()], model_stages=[look, ...]
    )
    assert all(frame["rectified"] for frame in stored(out)["frames"])
    assert len(moved) == 10 and len(list((out / "images").iterdir())) == 10
    assert contents(out / "images") != contents(out / "colmap" / "images")
    # the default model stages see a model of rectified keypoints, and finish what the keypoints began
    assert models[0].rectified and not models[0].doubts
    assert [treatment.stage for treatment in result.models[0].treatments] == ["readout", "refine"]
    assert stored(out)["models"][0]["readout_translation"] is not None


def test_doubts_are_enforced_after_the_stages_whoever_wrote_them(capture, bare, tmp_path, monkeypatch):
    from colmap_inertial.run.preparation import preflight

    monkeypatch.setattr(preflight, "stop_or_doubt", lambda diagnosis, force: ("the video was stabilised",))
    _, plain, _ = bare
    trusted = dataclasses.replace(plain.models[0].scale, verdict="trusted")
    seen = []

    def mine(model: Model) -> Model:
        seen.append(model.doubts)
        return dataclasses.replace(model, scale=trusted)

    options = ReconstructOptions(mapping=DETERMINISTIC.mapping, force=True)
    out = tmp_path / "out"  # mapped once
    for stages in ([mine], [..., mine], [...]):
        result = reconstruct(
            capture, out, options, frame_stages=[], keypoint_stages=[], model_stages=stages, overwrite=True
        )
        (model,) = result.models
        assert model.scale.verdict == "weak" and str(model.scale.reasons[0]) == "the video was stabilised"
        assert stored(out)["models"][0]["verdict"] == "weak"
    transform = json.loads((out / "sparse" / "0" / "transform.json").read_text())
    assert transform["provenance"].endswith("weak")
    assert [tuple(map(str, doubts)) for doubts in seen] == [("the video was stabilised",)] * 2


def test_with_overwrite_what_depends_on_an_option_is_made_again_and_the_rest_kept(capture, bare):
    out, first, _ = bare
    before = contents(out)
    log = (out / "log.txt").read_text()
    options = dataclasses.replace(DETERMINISTIC, world="y-down")
    with pytest.raises(OutputExistsError, match=r"step metric .* world = y-down \(was z-up\)"):
        reconstruct(capture, out, options, frame_stages=[], keypoint_stages=[])
    found = contents(out)
    assert {name for name in found if found[name] != before.get(name)} == {"log.txt"}
    log = (out / "log.txt").read_text()
    second = reconstruct(capture, out, options, frame_stages=[], keypoint_stages=[], overwrite=True)
    assert not second.unchanged
    new = (out / "log.txt").read_text()[len(log) :]
    for step in ("frames", "matches", "mapping"):
        assert f"{step}: finished in an earlier run, kept" in new
    assert "metric: started" in new and "features: started" not in new
    after = contents(out)
    kept = [name for name in before if name.startswith(("images/", "colmap/"))]
    assert len(kept) > 10 and all(before[name] == after[name] for name in kept)
    assert before["sparse/0/images.bin"] != after["sparse/0/images.bin"]
    assert second.models[0].scale.metres_per_unit == first.models[0].scale.metres_per_unit
    # as if it had been asked for at once
    again = reconstruct(capture, out, options, frame_stages=[], keypoint_stages=[])
    assert again.unchanged
    np.testing.assert_array_equal(again.models[0].scale.cov, second.models[0].scale.cov)
    # and back
    back = reconstruct(capture, out, DETERMINISTIC, frame_stages=[], keypoint_stages=[], overwrite=True)
    assert not back.unchanged
    assert contents(out)["sparse/0/images.bin"] == before["sparse/0/images.bin"]


def test_a_calibration_given_later_maps_nothing_again(capture, bare, tmp_path):
    first, out = bare[1], shutil.copytree(bare[0], tmp_path / "out")
    known = first.models[0].scale.calibration
    write_calibration(tmp_path / "device.json", dataclasses.replace(known, cov=known.cov / 100))
    before, log = contents(out), (out / "log.txt").read_text()
    options = dataclasses.replace(DETERMINISTIC, calibration=tmp_path / "device.json")
    second = reconstruct(capture, out, options, frame_stages=[], keypoint_stages=[], overwrite=True)
    new = (out / "log.txt").read_text()[len(log) :]
    assert all(f"{step}: finished in an earlier run, kept" in new for step in ("frames", "matches", "mapping"))
    assert "metric: started" in new and not second.unchanged
    kept = [name for name in before if name.startswith(("images/", "colmap/"))]
    assert all(before[name] == contents(out)[name] for name in kept)
    spread = [model.scale.calibration.rotation_sigma_rad for model in (*first.models, *second.models)]
    assert spread[1] < spread[0] / 2


def test_a_run_reads_each_model_from_disk_twice_at_most(tmp_path, monkeypatch):
    import pycolmap

    from colmap_inertial import model

    read, reads = model._read_from, []

    def counted(folder, *rest):
        reads.append(folder)
        return read(folder, *rest)

    monkeypatch.setattr(model, "_read_from", counted)
    measured, out = copy_scene(tmp_path / "capture", first=10, target=True), tmp_path / "out"
    reconstruct(measured, out, DETERMINISTIC, frame_stages=[], keypoint_stages=[])
    counts = {folder: reads.count(folder) for folder in set(reads)}
    assert set(counts) == {out / "colmap" / "sparse" / "0", out / "sparse" / "0"} and max(counts.values()) <= 2
    assert isinstance(read(out / "colmap" / "sparse" / "0"), pycolmap.Reconstruction)


def test_a_recording_that_changed_does_not_replace_a_finished_result(capture, bare, tmp_path):
    recording, out = shutil.copytree(capture, tmp_path / "capture"), tmp_path / "out"
    reconstruct(recording, out, DETERMINISTIC, frame_stages=[], keypoint_stages=[])
    before = contents(out)
    rows = (recording / "gyro.csv").read_text().splitlines(keepends=True)
    (recording / "gyro.csv").write_text("".join(rows[:-1]))
    with pytest.raises(OutputExistsError, match="step check would change: the recording"):
        reconstruct(recording, out, DETERMINISTIC, frame_stages=[], keypoint_stages=[])
    found = contents(out)
    assert {name for name in found if found[name] != before.get(name)} == {"log.txt"}


def test_a_frame_cannot_be_both_dropped_and_seen():
    frame = Frame(name="a.jpg", image=np.zeros((4, 4), np.uint8), t_s=0.0)
    assert not frame.dropped and frame.treatments == ()
    assert dataclasses.replace(frame, dropped=True).dropped
