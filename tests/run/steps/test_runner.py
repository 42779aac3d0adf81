"""The pipeline's bookkeeping: stages that appear whole or not at all, configuration, pairs, frames through stages."""

import dataclasses
import functools
import itertools
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli.terminal import show_applied
from colmap_inertial.colmap.features.extraction import check_pair_names, image_pairs
from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError, OutputExistsError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import MappingOptions, ReconstructOptions
from colmap_inertial.core.progress import silent
from colmap_inertial.io.frames import read_frame_times
from colmap_inertial.io.imu import read_imu
from colmap_inertial.model import read_model
from colmap_inertial.model.project import Applied
from colmap_inertial.run.commands.models import Submodels, run_models
from colmap_inertial.run.commands.reporting import report_result
from colmap_inertial.run.commands.result import ReconstructResult
from colmap_inertial.run.stages.frame_folder import FramePaths, read_frame_records, write_frames
from colmap_inertial.run.stages.metric import MetricStage
from colmap_inertial.run.steps.config import config_as_toml, list_changed_options, read_config
from colmap_inertial.run.steps.hashing import as_json_types
from colmap_inertial.run.steps.runner import StepRunner
from colmap_inertial.run.steps.workspace import Workspace
from tests.helpers.cases import loop_over
from tests.helpers.sessions import CAMERA, frames_of, recording_of, session_in


def test_a_stage_runs_once_and_again_when_anything_before_it_changes(tmp_path):
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")
    calls = []

    def run(first_option):
        runner = StepRunner(workspace)
        for name, option, after in (("first", first_option, []), ("second", 7, ["first"]), ("aside", 7, [])):
            target = workspace.root / f"{name}.txt"

            def work(partial, name=name):
                calls.append(name)
                partial[0].write_text(name)

            runner.run(name, {"option": option}, [target], work, after=after)
        return runner.worked

    assert run(1) == calls == ["first", "second", "aside"]
    assert run(1) == []
    # what does not depend on the change is kept
    assert run(2) == ["first", "second"]
    (workspace.root / "second.txt").unlink()
    assert run(2) == ["second"]


def test_an_interrupted_stage_leaves_nothing_that_counts_as_finished(tmp_path):
    workspace = Workspace(tmp_path)
    workspace.open(tmp_path / "capture.toml")
    target = tmp_path / "model"

    def half(partial):
        partial[0].mkdir()
        (partial[0] / "a").write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        StepRunner(workspace).run("mapping", {}, [target], half)
    assert not target.exists()

    def whole(partial):
        partial[0].mkdir()
        (partial[0] / "b").write_text("whole")

    StepRunner(workspace).run("mapping", {}, [target], whole)
    assert [p.name for p in target.iterdir()] == ["b"]
    assert not list(tmp_path.glob("*.partial*"))


def test_a_damaged_stamp_is_no_stamp(tmp_path):
    workspace = Workspace(tmp_path)
    workspace.open(tmp_path / "capture.toml")
    calls = []
    for _ in range(2):
        StepRunner(workspace).run("a", {}, [tmp_path / "a"], lambda p: (calls.append(1), p[0].write_text("x")))
        (workspace.stamps / "a.json").write_text('{"key": "')
    assert len(calls) == 2


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputExistsError, match="not empty"):
        Workspace(tmp_path).open(tmp_path / "capture.toml")
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(OutputExistsError, match="is a file"):
        Workspace(tmp_path / "thesis.tex").open(tmp_path / "capture.toml")

    other = Workspace(tmp_path / "out")
    other.open(tmp_path / "a" / "capture.toml")
    other.open(tmp_path / "a" / "capture.toml")
    with pytest.raises(OutputExistsError, match="another capture"):
        other.open(tmp_path / "b" / "capture.toml")
    other.result.write_text("{}")
    other.open(tmp_path / "a" / "capture.toml")  # a finished run can be continued
    assert other.result.is_file()
    with pytest.raises(OutputExistsError, match="another capture"):
        other.open(tmp_path / "b" / "capture.toml")


def test_the_resolved_configuration_reads_back_as_it_was(tmp_path):
    options = dataclasses.replace(
        ReconstructOptions(), seed=5, world="y-down", mapping=MappingOptions(overlap=3, refine_intrinsics=False)
    )
    path = tmp_path / "config.toml"
    path.write_text(config_as_toml(options))
    assert read_config(path, ReconstructOptions) == options


@loop_over(
    ("text", "words"),
    [
        ("sede = 3", "unknown option sede; did you mean seed"),
        ("[mapping]\noverlapp = 3", "unknown option mapping.overlapp; did you mean mapping.overlap"),
        ("[mapping]\noverlap = 'three'", "mapping.overlap: 'three' is not a whole number"),
        ("world = 'x-up'", "world: 'x-up' is not one of 'z-up', 'y-down'"),
        ("mapping = 3", "mapping is a table"),
        ("seed = ", "not valid TOML"),
    ],
)
def test_a_wrong_configuration_names_the_key(tmp_path, text, words):
    path = tmp_path / "config.toml"
    path.write_text(text)
    with pytest.raises(FormatError, match=words):
        read_config(path, ReconstructOptions)


def test_few_images_are_matched_with_each_other_and_many_with_their_neighbours():
    few = [f"{i:03}" for i in range(20)]
    assert image_pairs(few, MappingOptions()) == list(itertools.combinations(few, 2))
    many = [f"{i:03}" for i in range(400)]
    pairs = image_pairs(many, MappingOptions(overlap=4))
    assert len(pairs) == len(set(pairs))
    assert {int(b) - int(a) for a, b in pairs} == {1, 2, 3, 4, 8, 16, 32, 64, 128, 256}


def test_frames_that_no_stage_changed_are_copied_byte_for_byte(tmp_path):
    timing, frames = frames_of(tmp_path / "in")

    def invert_the_third_and_drop_the_fourth(stream):
        for frame in stream:
            if frame.name == "2.jpg":
                yield dataclasses.replace(frame, image=255 - frame.image)
            elif frame.name == "4.jpg":
                yield dataclasses.replace(frame, image=frame.image[:12])
            elif frame.name != "3.jpg":
                yield dataclasses.replace(frame, exposure_s=0.01)

    write_frames(
        frames,
        timing.names,
        [invert_the_third_and_drop_the_fourth],
        FramePaths(source=tmp_path / "in", images=tmp_path / "out", records=tmp_path / "frames.json"),
        silent,
    )
    records = read_frame_records(tmp_path / "frames.json")
    assert [r.action for r in records] == ["passed", "passed", "changed", "dropped", "changed", "passed"]
    assert records[0].camera.params == CAMERA.params
    for name in ("0.jpg", "1.jpg", "5.jpg"):
        assert (tmp_path / "in" / name).read_bytes() == (tmp_path / "out" / name).read_bytes()
    inverted = cv2.imread(str(tmp_path / "out" / "2.jpg"), cv2.IMREAD_UNCHANGED)
    original = cv2.imread(str(tmp_path / "in" / "2.jpg"), cv2.IMREAD_UNCHANGED)
    assert np.abs(255 - original.astype(int) - inverted).mean() < 2
    assert cv2.imread(str(tmp_path / "out" / "4.jpg")).shape[0] == 12
    assert not (tmp_path / "out" / "3.jpg").exists()


def test_stages_cannot_rename_or_repeat_frames(tmp_path):
    def run(stage, count):
        timing, frames = frames_of(tmp_path / f"in{count}", count)
        paths = FramePaths(source=None, images=tmp_path / f"out{count}", records=tmp_path / "r")
        write_frames(frames, timing.names, [stage], paths, silent)

    with pytest.raises(ValueError, match=r"'x\.jpg', which is no frame"):
        run(lambda stream: (dataclasses.replace(f, name="x.jpg") for f in stream), 4)
    with pytest.raises(ValueError, match="came twice"):
        run(lambda stream: (f for f in stream for _ in range(2)), 5)
    with pytest.raises(InertialError, match="2 frames are left of 6"):
        run(lambda stream: itertools.islice(stream, 2), 6)


def test_pixels_in_a_frame_cannot_be_changed_in_place(tmp_path):
    _, frames = frames_of(tmp_path / "in")
    with pytest.raises(ValueError, match="read-only"):
        next(frames).image[0] = 1


def test_each_sub_model_gets_its_own_scale_and_verdict(project, tmp_path):
    """Three sub-models in units of their own: two halves of a recording, and one too short to give a scale."""
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")
    whole = read_model(project.model)
    names = sorted(image.name for image in whole.images.values())
    factors = {0: 2.0, 1: 0.5, 3: 1.0}
    parts = {0: names[: len(names) // 2], 1: names[len(names) // 2 :], 3: names[:12]}
    for index, part in parts.items():
        model = pycolmap.Reconstruction(whole)
        for name in set(names) - set(part):
            model.deregister_frame(model.find_image_with_name(name).frame_id)
        model.transform(pycolmap.Sim3d(factors[index], pycolmap.Rotation3d(), np.zeros(3)))
        (workspace.colmap_sparse / str(index)).mkdir(parents=True)
        model.write_binary(str(workspace.colmap_sparse / str(index)))
    before = {p: p.read_bytes() for p in workspace.colmap_sparse.rglob("*.bin")}
    imu = read_imu(project.imu)
    timing = read_frame_times(project.frame_times)
    results, fragments, _ = run_models(
        session_in(workspace), recording_of(imu, timing), [MetricStage(imu=imu, calibration=None)], Submodels(after=())
    )

    assert [(result.index, result.colmap_index) for result in results] == [(0, 0), (1, 1), (2, 3)]
    assert fragments == ()
    truth = project.recording.truth.metres_per_unit
    for result in results[:2]:
        expected = truth / factors[result.colmap_index]
        assert result.scale.metres_per_unit == pytest.approx(expected, rel=0.05)
        assert result.sparse_metric == workspace.sparse / str(result.index)
    assert results[2].scale.verdict == "refused"
    assert results[2].sparse_metric is None
    assert sorted(p.name for p in workspace.sparse.iterdir()) == ["0", "1"]
    assert sorted(p.name for p in workspace.root.glob("trajectory*")) == [
        "trajectory.tum",
        "trajectory_1.tum",
        "trajectory_1_cov.npz",
        "trajectory_1_motion.json",
        "trajectory_cov.npz",
        "trajectory_motion.json",
    ]
    assert {p: p.read_bytes() for p in workspace.colmap_sparse.rglob("*.bin")} == before
    outcome = ReconstructResult(workspace=workspace, models=results, frames=(), seconds={})
    assert outcome.exit_code() == 0
    refused = dataclasses.replace(outcome, models=results[2:])
    with pytest.raises(NotObservableError):
        refused.exit_code()


def sub_models(project, workspace, parts):
    """Sub-models of the project's model, by COLMAP's number, of so many images each."""
    whole = read_model(project.model)
    names = sorted(image.name for image in whole.images.values())
    for number, count in parts.items():
        model = pycolmap.Reconstruction(whole)
        for name in names[count:]:
            model.deregister_frame(model.find_image_with_name(name).frame_id)
        (workspace.colmap_sparse / str(number)).mkdir(parents=True)
        model.write_binary(str(workspace.colmap_sparse / str(number)))


def test_the_largest_model_comes_first_and_fragments_are_left_out_and_named(project, tmp_path):
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")
    sub_models(project, workspace, {0: 3, 1: 500, 2: 60, 4: 4})
    imu, timing = read_imu(project.imu), read_frame_times(project.frame_times)
    session, recording = session_in(workspace), recording_of(imu, timing)
    models, fragments, _ = run_models(session, recording, [MetricStage(imu=imu, calibration=None)], Submodels(after=()))
    assert [(m.index, m.colmap_index, m.summary["registered_images"]) for m in models] == [(0, 1, 500), (1, 2, 60)]
    assert models[0].sparse == workspace.colmap_sparse / "1"
    assert models[0].sparse_metric == workspace.sparse / "0"
    assert models[0].trajectory == workspace.root / "trajectory.tum"
    assert [(f.colmap_index, f.registered_images, f.sparse) for f in fragments] == [
        (4, 4, workspace.colmap_sparse / "4"),
        (0, 3, workspace.colmap_sparse / "0"),
    ]
    result = ReconstructResult(workspace=workspace, models=models, fragments=fragments, seconds={})
    report_result(session, result, recording.capture)
    said = json.loads(workspace.result.read_text())
    assert [model["colmap_index"] for model in said["models"]] == [1, 2]
    assert [(f["colmap_index"], f["sparse"]) for f in said["fragments"]] == [
        (4, "colmap/sparse/4"),
        (0, "colmap/sparse/0"),
    ]
    # a second look finds the same without making it again, another one with the fragments makes it again
    session = session_in(workspace)
    again, *_ = run_models(session, recording, [MetricStage(imu=imu, calibration=None)], Submodels(after=()))
    assert session.runner.worked == [] and [m.scale.ci95 for m in again] == [m.scale.ci95 for m in models]
    workspace.unfinish()
    every, none, _ = run_models(
        session_in(workspace), recording, [MetricStage(imu=imu, calibration=None)], Submodels(after=()), fragments=True
    )
    assert [m.colmap_index for m in every] == [1, 2, 4, 0] and none == ()


def test_metric_models_that_are_gone_are_made_again(project, tmp_path):
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")
    sub_models(project, workspace, {0: 1000})
    imu, timing = read_imu(project.imu), read_frame_times(project.frame_times)
    recording, stages = recording_of(imu, timing), [MetricStage(imu=imu, calibration=None)]
    run_models(session_in(workspace), recording, stages, Submodels(after=()))
    shutil.rmtree(workspace.sparse)
    session = session_in(workspace)
    run_models(session, recording, stages, Submodels(after=()))
    assert session.runner.worked == ["metric"] and (workspace.sparse / "0").is_dir()


def test_a_sub_model_with_one_timed_image_is_refused_and_the_others_go_on(project, tmp_path):
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")
    whole = read_model(project.model)
    shutil.copytree(project.model, workspace.colmap_sparse / "0")
    names = sorted(image.name for image in whole.images.values())
    lonely = pycolmap.Reconstruction(whole)
    for name in names[1:]:
        lonely.deregister_frame(lonely.find_image_with_name(name).frame_id)
    (workspace.colmap_sparse / "1").mkdir()
    lonely.write_binary(str(workspace.colmap_sparse / "1"))
    imu, timing = read_imu(project.imu), read_frame_times(project.frame_times)
    session, recording = session_in(workspace), recording_of(imu, timing)
    stages = [MetricStage(imu=imu, calibration=None)]
    (metric, refused), *_ = run_models(session, recording, stages, Submodels(after=()), fragments=True)
    assert metric.scale.verdict == "trusted"
    assert refused.scale.verdict == "refused" and "1 of the model's 1 images" in str(refused.scale.reasons[0])
    assert refused.summary["registered_images"] == 1
    result = ReconstructResult(workspace=workspace, models=(metric, refused), frames=(), seconds={})
    assert report_result(session, result, recording.capture).report is not None
    assert result.exit_code() == 0
    shutil.rmtree(workspace.colmap_sparse / "0")
    workspace.unfinish()
    with pytest.raises(TimingError, match="1 of the model's 1 images"):
        run_models(session_in(workspace), recording, stages, Submodels(after=()), fragments=True)


def test_the_key_of_a_hook_knows_its_parameters_and_its_body():
    def make(strength):
        def stage(frames):
            return (f for f in frames if strength > 0)

        return stage

    key = as_json_types
    assert key(make(1)) == key(make(1))
    assert key(make(1)) != key(make(2))
    assert key(functools.partial(max, 1)) != key(functools.partial(max, 2))
    assert key(lambda frames: frames) != key(lambda frames: reversed(frames))

    class Opaque:
        def __call__(self, frames):
            return frames

    opaque = Opaque()
    assert key(opaque) != key(opaque), "what cannot be looked into must never count as unchanged"


def test_two_runs_do_not_work_in_one_folder(tmp_path):
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")
    with workspace.locked(), pytest.raises(OutputExistsError, match="another run is at work"), workspace.locked():
        pass
    with workspace.locked():
        pass


def test_a_stage_that_fails_for_a_reason_leaves_nothing_behind(tmp_path):
    workspace = Workspace(tmp_path)
    workspace.open(tmp_path / "capture.toml")

    def fail(partial):
        partial[0].mkdir()
        raise InertialError(Fact.stated("too few"))

    with pytest.raises(InertialError, match="too few"):
        StepRunner(workspace).run("frames", {}, [tmp_path / "images"], fail)
    assert [p.name for p in tmp_path.iterdir()] == [".stages"]


def test_names_that_colmap_s_pair_lists_cannot_hold_are_refused():
    check_pair_names(["IMG_1.jpg", "ü#1.png"])
    with pytest.raises(FormatError, match="without spaces"):
        check_pair_names(["IMG_1.jpg", "IMG 2.jpg"])


def test_square_brackets_of_notes_and_paths_reach_the_terminal(capsys):
    applied = Applied(out=Path("out [new]"), models={}, changes=(), unchanged={}, notes=("give it under [timing]",))
    show_applied(applied)
    shown = capsys.readouterr().out
    assert "[timing]" in shown and "out [new]" in shown


def test_what_an_earlier_configuration_does_not_name_is_no_change_where_it_is_empty(tmp_path):
    earlier = tmp_path / "config.toml"
    text = config_as_toml(ReconstructOptions(world="y-down"))
    earlier.write_text("\n".join(line for line in text.splitlines() if not line.endswith("= []")))
    assert list_changed_options(earlier, text) == ()
    changed = list_changed_options(earlier, config_as_toml(ReconstructOptions()))
    assert changed == (Fact("option-changed", option="world", now="z-up", before="y-down"),)
