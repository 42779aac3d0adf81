"""Batches whose captures take hooks: by name, each process by itself, and a manifest's only where that is allowed."""

import dataclasses
import json
import os
import sys
from pathlib import Path

import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.options import BatchOptions, StageNames
from colmap_inertial.hooks import load_stages
from colmap_inertial.run.steps.config import config_as_toml
from colmap_inertial.tools.batch import BatchCapture, read_manifest, run_batch
from colmap_inertial.tools.batch.task import CaptureStatus
from tests.helpers.batch_captures import TINY, model_bytes, tiny_capture
from tests.helpers.cases import loop_over

MODULE = '''
from dataclasses import dataclass, replace
from types import SimpleNamespace

from colmap_inertial.core.types import Treatment

number = 3


@dataclass(frozen=True)
class Skip:
    """A frame stage: drops the first frames."""

    first: int

    def __call__(self, frames, /):
        for i, frame in enumerate(frames):
            because = Treatment(stage="skip", reason="one of the first", action="changed")
            yield replace(frame, dropped=True, treatments=(because,)) if i < self.first else frame


def seen(model, /):
    """A model stage: leaves its mark."""
    return replace(model, treatments=(*model.treatments, Treatment(stage="seen", reason="by a hook")))


skip_one = Skip(first=1)
shelf = SimpleNamespace(seen=seen)
'''
#: With the first one skipped, as many as a model needs to be refined.
FRAMES = 11
SEEN = StageNames(model=("...", "hooks_of_mine:shelf.seen"))


@pytest.fixture
def hooks(tmp_path, monkeypatch):
    """A module of the user's that this process and its children can import."""
    folder = tmp_path / "code"
    folder.mkdir()
    (folder / "hooks_of_mine.py").write_text(MODULE)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.syspath_prepend(folder)
    yield folder
    for name in ("hooks_of_mine", "broken_hooks"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return tiny_capture(tmp_path_factory.mktemp("captures") / "hall", frames=FRAMES)


def marks(out: Path) -> list[str]:
    """Which stages treated the first model of a result."""
    return [
        treatment["stage"] for treatment in json.loads((out / "result.json").read_text())["models"][0]["treatments"]
    ]


def frames(out: Path) -> list[str]:
    """The pictures that COLMAP saw."""
    return sorted(path.name for path in (out / "images").iterdir())


def write_manifest(folder: Path, text: str) -> Path:
    (folder / "m.toml").write_text(text)
    return folder / "m.toml"


def test_a_manifest_s_stages_run_where_they_are_allowed(capsys, hooks, capture, tmp_path):
    text = f'[[capture]]\npath = "{capture}"\nstages.frame = ["hooks_of_mine:skip_one", "..."]\n'
    manifest, out = write_manifest(tmp_path, text + 'stages.model = ["...", "hooks_of_mine:seen"]\n'), tmp_path / "out"
    (tmp_path / "options.toml").write_text(config_as_toml(TINY))
    command = ["batch", str(manifest), str(out), "--config", str(tmp_path / "options.toml")]
    with pytest.raises(SystemExit) as stopped:
        main(command)
    said = capsys.readouterr().err
    assert stopped.value.code == 2
    assert f"error: {manifest}: [capture, number 1] stages: " in said
    assert "(hooks_of_mine:skip_one, hooks_of_mine:seen)" in said
    assert "--allow-stages" in said
    assert not out.exists()

    with pytest.raises(SystemExit) as stopped:
        main([*command, "--allow-stages"])
    assert stopped.value.code == 0, capsys.readouterr().err
    every = sorted(path.name for path in (capture / "frames").iterdir())
    assert frames(out / "hall") == every[1:]
    assert marks(out / "hall") == ["refine", "seen"]

    # the same again is finished; other stages, or none, do not replace it unasked
    made = model_bytes(out / "hall")
    (again,) = run_batch(manifest, out, TINY, allow_stages=True).captures
    assert (again.state, again.attempts) == ("done", 1)
    (entry,) = read_manifest(manifest, TINY, allow_stages=True)
    for other in (StageNames(), SEEN, SEEN):  # a refusal changes nothing
        (end,) = run_batch([dataclasses.replace(entry, stages=other)], out).captures
        assert (end.state, end.exit_code) == ("failed", 2)
        assert f"{out / 'hall'} holds a finished result, and its step" in end.error and "--overwrite" in end.error
    assert model_bytes(out / "hall") == made
    (again,) = run_batch(manifest, out, TINY, allow_stages=True).captures
    assert (again.state, again.attempts) == ("done", 1), "nothing was written down of the stages that were refused"
    (end,) = run_batch(
        [dataclasses.replace(entry, stages=StageNames())], out, batch=BatchOptions(overwrite=True)
    ).captures
    assert end.state == "done" and marks(out / "hall") == ["refine"]


def test_a_capture_s_own_stages_go_before_those_of_all(hooks, capture, tmp_path):
    entries = [
        BatchCapture(name="all", path=capture, options=TINY),
        BatchCapture(name="own", path=capture, options=TINY, stages=StageNames()),
    ]
    of_all = StageNames(keypoint=("hooks_of_mine:shelf.nothing",))
    theirs, own = run_batch(entries, tmp_path / "out", stages=of_all).captures
    assert (theirs.state, theirs.error) == ("failed", f"stage {of_all.code[0]}: hooks_of_mine has no shelf.nothing")
    assert own.state == "done"
    assert marks(tmp_path / "out" / "own") == ["refine"]  # the default stage alone


def test_a_stage_that_cannot_be_had_fails_its_capture_with_a_sentence(hooks, capture, tmp_path):
    out = tmp_path / "out"
    (out / "photos").mkdir(parents=True)
    (out / "status").mkdir()
    (out / "photos" / "a.jpg").write_bytes(b"precious")
    entries = [
        BatchCapture(name="nowhere", path=capture, options=TINY, stages=StageNames(frame=("no_such_module:mask",))),
        BatchCapture(name="number", path=capture, options=TINY, stages=StageNames(model=("hooks_of_mine:number",))),
        BatchCapture(name="photos", path=capture, options=TINY, stages=SEEN),
    ]
    ends = {end.name: end for end in run_batch(entries, out).captures}
    assert {(end.state, end.exit_code, end.attempts) for end in ends.values()} == {("failed", 2, 1)}
    assert ends["nowhere"].error.startswith("stage no_such_module:mask: there is no module no_such_module; install it")
    assert ends["number"].error.startswith("stage hooks_of_mine:number: is of type int")
    for name in ("nowhere", "number"):
        assert (out / "status" / f"{name}.log").read_text() == f"error: {ends[name].error}\n"
        assert not (out / name).exists()
    # a folder of something else is left alone
    assert "is not empty" in ends["photos"].error
    assert [path.name for path in (out / "photos").iterdir()] == ["a.jpg"]


def test_an_existing_project_takes_model_stages_alone(hooks, project, tmp_path):
    (tmp_path / "imu").symlink_to(project.imu)
    (tmp_path / "frames.csv").symlink_to(project.frame_times)
    manifest = write_manifest(
        tmp_path,
        f'[[capture]]\nname = "desk"\npath = "{project.model.parents[1]}"\n'
        'project.imu = "imu"\nproject.frame_times = "frames.csv"\n',
    )

    def end(stages: StageNames) -> CaptureStatus:
        (found,) = run_batch(manifest, tmp_path / "out", stages=stages).captures
        return found

    refused = end(StageNames(frame=("hooks_of_mine:skip_one",)))
    assert (refused.state, refused.exit_code) == ("failed", 2)
    assert "an existing model is not mapped again" in refused.error
    assert end(SEEN).state == "done"
    assert marks(tmp_path / "out" / "desk")[-1] == "seen"
    assert "step metric would change" in end(StageNames()).error


def test_names_lead_to_functions_instances_and_the_default_stages(hooks):
    stages = load_stages(StageNames(frame=("...", "hooks_of_mine:skip_one"), keypoint=(), model=SEEN.model))
    import hooks_of_mine

    assert stages.frame == (..., hooks_of_mine.skip_one)
    assert stages.keypoint == ()
    assert stages.model == (..., hooks_of_mine.seen)


@loop_over(
    ("name", "words"),
    [
        ("no_such_module:mask", "there is no module no_such_module"),
        ("hooks_of_mine.inner:mask", "there is no module hooks_of_mine.inner"),
        ("hooks_of_mine:mask", "hooks_of_mine has no mask"),
        ("hooks_of_mine:shelf.mask", "hooks_of_mine has no shelf.mask"),
        ("hooks_of_mine:Skip", "is a class; name an instance of it"),
        ("hooks_of_mine:number", "is of type int; name a function"),
        ("broken_hooks:mask", "broken_hooks cannot be imported: ModuleNotFoundError: No module named 'not_there'"),
    ],
)
def test_what_is_wrong_with_a_name_is_one_sentence(hooks, name, words):
    (hooks / "broken_hooks.py").write_text("import not_there\n")
    with pytest.raises(InertialError) as raised:
        load_stages(StageNames(frame=(name,)))
    assert str(raised.value).startswith(f"stage {name}: {words}")


@pytest.mark.parametrize("code", ["def\n", "raise SystemExit(3)\n", "1 / 0\n"])
def test_a_module_that_fails_is_named(hooks, code):
    (hooks / "broken_hooks.py").write_text(code)
    with pytest.raises(InertialError, match=r"broken_hooks cannot be imported: \w+: "):
        load_stages(StageNames(model=("broken_hooks:mask",)))


@loop_over("name", ["", "mask", "mask:", ":mask", "a:b:c", "a b:c", "a.py:", "a..b:c", "/a/b.py:mask", "a:b()"])
def test_a_name_is_that_of_a_module_and_what_is_in_it(name):
    with pytest.raises(ValueError, match="names no stage"):
        StageNames(keypoint=(name,))


def test_a_script_s_own_stages_and_dots_twice_are_refused():
    with pytest.raises(ValueError, match="module of its own"):
        StageNames(model=("__main__:mask",))
    with pytest.raises(ValueError, match="once"):
        StageNames(frame=("...", "a:b", "..."))
    assert StageNames(frame=("...", "a:b.c"), keypoint=(), model=("d:e",)).code == ("a:b.c", "d:e")


@loop_over(
    ("line", "words"),
    [
        ('stages.frame = ["mask"]', "stages: frame: 'mask' names no stage"),
        ('stages.frame = ["...", "..."]', "once"),
        ('stages.frame = "a:b"', "is not a list of strings"),
        ('stages.frames = ["a:b"]', "did you mean frame"),
        ('stages = ["a:b"]', "is a table"),
        ('stages.model = ["a:b"]', "--allow-stages"),
    ],
)
def test_wrong_stages_of_a_manifest_are_named(tmp_path, line, words):
    manifest = write_manifest(tmp_path, f'[[capture]]\npath = "a"\n\n[[capture]]\npath = "b"\n{line}\n')
    with pytest.raises(FormatError, match=r"m.toml: \[capture, number 2\] stages: ") as raised:
        read_manifest(manifest)
    assert words in str(raised.value)


def test_a_manifest_s_stages_are_read_where_they_are_allowed(tmp_path):
    text = '[[capture]]\npath = "a"\n\n[[capture]]\npath = "b"\nstages.model = ["...", "m:f"]\n'
    first, second = read_manifest(write_manifest(tmp_path, text), allow_stages=True)
    assert (first.stages, second.stages) == (None, StageNames(model=("...", "m:f")))
    # default stages alone are nobody's code
    (plain,) = read_manifest(write_manifest(tmp_path, '[[capture]]\npath = "a"\nstages.frame = []\n'))
    assert plain.stages == StageNames(frame=())
