"""What going on with a run must not get wrong: keys that know everything, results that stand for what is there."""

import dataclasses
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from colmap_inertial import AlreadyMetricError, Model, OutputExistsError, ScaleEstimate, Similarity, reconstruct
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import FrameTiming
from colmap_inertial.model import add_doubts, read_model
from colmap_inertial.model.similarities import read_scales
from colmap_inertial.run.steps.hashing import as_json_types
from colmap_inertial.run.steps.runner import StepRunner
from colmap_inertial.run.steps.session import Session
from colmap_inertial.run.steps.workspace import Workspace

ESTIMATE = ScaleEstimate(
    metres_per_unit=2.0, sigma_log=0.01, ci95=(1.9, 2.1), verdict="trusted", method="joint",
    gravity_in_world_m_s2=np.array([0.0, 0.0, -9.8]), cov=np.eye(7) * 1e-4,
)  # fmt: skip


def entry(**changes):
    return {
        "metres_per_unit": 2.0, "sigma_log": 0.01, "ci95": [1.9, 2.1], "verdict": "trusted", "reasons": [],
        "gravity_in_world_m_s2": [0, 0, -9.8], **changes,
    }  # fmt: skip


def test_scales_of_a_result_belong_to_colmap_s_numbers(tmp_path):
    path = tmp_path / "result.json"
    models = [entry(index=0, colmap_index=1), entry(index=1, colmap_index=0, metres_per_unit=7.0, ci95=[6.9, 7.1])]
    path.write_text(json.dumps({"models": models, "fragments": [{"colmap_index": 4, "registered_images": 3}]}))
    scales = read_scales([str(path)])
    assert {n: one.similarity and one.similarity.scale for n, one in scales.items()} == {1: 2.0, 0: 7.0, 4: None}
    # a result of version 0.1 has one number only
    path.write_text(json.dumps({"models": [entry(index=3)]}))
    assert list(read_scales([str(path)])) == [3]
    path.write_text(json.dumps({"models": [entry(index=0)], "fragments": [{}]}))
    with pytest.raises(FormatError, match="fragments"):
        read_scales([str(path)])


def test_doubts_lower_a_verdict_that_was_raised_again():
    doubts = (Fact.stated("the video was stabilised"),)
    once = add_doubts(ESTIMATE, doubts)
    raised = dataclasses.replace(once, verdict="trusted")
    assert once.verdict == add_doubts(raised, doubts).verdict == "weak"
    assert add_doubts(raised, doubts).reasons == once.reasons == doubts
    assert add_doubts(ESTIMATE, ()) is ESTIMATE
    # whatever a stage puts before them
    other = Fact.stated("the target is bent")
    assert add_doubts(add_doubts(once, (other,)), doubts).reasons == (other, *doubts)


def test_no_model_of_a_doubted_recording_is_trusted(tmp_path):
    timing = FrameTiming(names=("a", "b"), t_s=[0.0, 1.0])
    model = Model(reconstruction=None, colmap_index=0, timing=timing, doubts=("the video was stabilised",))
    assert model.scale is None
    doubted = dataclasses.replace(model, scale=ESTIMATE)
    assert doubted.scale.verdict == "weak" and [str(fact) for fact in doubted.scale.reasons] == [str(model.doubts[0])]
    assert dataclasses.replace(doubted, rectified=True).scale.reasons == doubted.scale.reasons


def test_a_model_is_scaled_once(project):
    model = Model(reconstruction=read_model(project.model), colmap_index=0, timing=None)
    similarity = Similarity.from_scale(ESTIMATE, provenance="a tape measure")
    scaled = model.scaled(ESTIMATE, similarity)
    assert scaled.similarity is similarity
    with pytest.raises(AlreadyMetricError, match="a tape measure"):
        scaled.scaled(ESTIMATE, similarity)


def test_a_folder_is_for_one_command(tmp_path):
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")
    with pytest.raises(OutputExistsError, match=r"another command \(reconstruct\)"):
        workspace.open(tmp_path / "capture.toml", "deblur")
    # 0.2 and before laid out their folders otherwise
    (workspace.stamps / "capture.json").write_text(json.dumps({"capture": str((tmp_path / "capture.toml").resolve())}))
    before = sorted(workspace.root.rglob("*"))
    with pytest.raises(OutputExistsError, match=r"another version, .* choose another folder, or remove this one"):
        workspace.open(tmp_path / "capture.toml")
    assert sorted(workspace.root.rglob("*")) == before


def test_nothing_to_do_means_that_the_same_would_be_said(tmp_path):
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")

    def session():
        return Session(workspace=workspace, runner=StepRunner(workspace), context=RunContext(scratch=workspace.stamps))

    assert not session().finish({"models": (1, 2), "seconds": {"a": 1.0}})
    assert session().finish({"models": (1, 2), "seconds": {"a": 2.0}})
    assert not session().finish({"models": (1,), "seconds": {"a": 2.0}})
    again = session()
    again.runner.run("a", {}, [tmp_path / "out" / "a"], lambda partial: partial[0].write_text("x"))
    assert not again.finish({"models": (1,), "seconds": {"a": 1.0}})


def test_wrong_hooks_and_names_are_said_before_the_work(tmp_path):
    for hooks in ({"frame_stages": [..., ...]}, {"keypoint_stages": [..., ...]}, {"model_stages": []}):
        with pytest.raises(ValueError, match=r"once|must estimate"):
            reconstruct(tmp_path / "nothing", tmp_path / "out", **hooks)
    assert not (tmp_path / "out").exists()


KEY = """
from colmap_inertial.run.steps.hashing import as_json_types
def stage(frames):
    return [f for f in frames if f.name in {"a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg"}]
print(as_json_types(stage))
"""


def test_the_key_of_a_function_is_the_same_in_every_process():
    said = [
        subprocess.run(
            [sys.executable, "-c", KEY],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        ).stdout
        for seed in ("1", "2", "3")
    ]
    assert len(set(said)) == 1


def test_the_key_of_a_visitor_s_class_knows_its_code():
    def make(by):
        @dataclasses.dataclass(frozen=True)
        class Stage:
            gamma: float = 1.0

            def __call__(self, frames):
                return self.shifted(frames)

            if by == 1:

                def shifted(self, frames):
                    return [frame + 1 for frame in frames]

            else:

                def shifted(self, frames):
                    return [frame + 2 for frame in frames]

        return Stage()

    assert as_json_types(make(1)) == as_json_types(make(1))
    assert as_json_types(make(1)) != as_json_types(make(2))
