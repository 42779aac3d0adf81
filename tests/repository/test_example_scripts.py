"""The worked scripts, run as their readers would run them."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from colmap_inertial.model import read_model
from colmap_inertial.run.steps.config import config_as_toml
from tests.helpers.batch_captures import TINY, tiny_capture
from tests.run.commands.test_reconstruct import copy_scene

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"
MODULES = sorted(".".join(p.relative_to(ROOT).with_suffix("").parts) for p in SCRIPTS.rglob("[!_]*.py"))


@pytest.fixture
def config(tmp_path):
    (tmp_path / "options.toml").write_text(config_as_toml(TINY))
    return tmp_path / "options.toml"


def run(script: str, *args: object, code: int = 0) -> str:
    """What a script prints."""
    command = [sys.executable, "-W", "error", SCRIPTS / script, *args]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    return done.stdout


def test_a_frame_hook_of_one_s_own(config, tmp_path):
    capture = copy_scene(tmp_path / "capture", first=16, half=False)  # a scale that is trusted
    said = run("example_frame_hook.py", capture, tmp_path / "out", "--below", 1000, "--config", config)
    assert "16 of 16 frames changed" in said
    assert "trusted" in said
    name = json.loads((tmp_path / "out" / "frames.json").read_text())["frames"][0]["name"]
    assert (tmp_path / "out" / "images" / name).read_bytes() != (capture / "frames" / name).read_bytes()


def test_an_existing_project(project, tmp_path):
    flags = ["--imu", project.imu, "--frame-times", project.frame_times]
    root = project.model.parents[1]
    said = run("example_existing_project.py", root, tmp_path / "metric", *flags)
    assert "trusted" in said
    transform = json.loads((tmp_path / "metric" / "sparse" / "0" / "transform.json").read_text())
    assert transform["scale"] == pytest.approx(project.recording.truth.metres_per_unit, rel=0.05)
    before, after = read_model(project.model), read_model(tmp_path / "metric" / "sparse" / "0")
    assert after.num_reg_images() == before.num_reg_images()

    refused = run("example_existing_project.py", root, tmp_path / "own", *flags, "--worst-percent", 0.0, code=1)
    assert "m per unit" in refused
    assert not (tmp_path / "own").exists()


def test_a_batch_over_a_folder(config, tmp_path):
    tiny_capture(tmp_path / "captures" / "hall")
    broken = tiny_capture(tmp_path / "captures" / "yard")
    (broken / "accel.csv").unlink()
    said = run("example_batch.py", tmp_path / "captures", tmp_path / "out", "--config", config, code=1)
    assert "hall: done" in said
    assert "yard: failed" in said
    assert "accel.csv" in said
    assert "hall model 0" in said


# --- all scripts -----------------------------------------------------------------------------------------------------

#: Where a script that is of use to somebody is named.
PLACES = ("*.md", "docs/**/*.md", ".github/**/*.yml", "scripts/**/*.*", "tests/**/*.py", "colmap_inertial/**/*.md")


def test_every_script_is_named_by_a_page_a_test_or_another_script():
    texts = {path: path.read_text() for place in PLACES for path in ROOT.glob(place) if path.suffix != ".pyc"}
    for script in MODULES:
        *folders, name = script.split(".")
        place = re.escape("/".join([*folders, name])) + r"\.py"
        imported = rf"from {re.escape('.'.join(folders))} import [^)]*?\b{name}\b"
        named = re.compile(rf"{place}|{re.escape(script)}\b|{imported}")
        assert any(
            named.search(text) for path, text in texts.items() if path != ROOT / f"{script.replace('.', '/')}.py"
        ), script


def test_every_script_can_be_imported():
    names = [name for name in MODULES if not name.startswith("scripts.restoration.")]  # these need torch
    code = f"import importlib, sys; sys.argv = ['script']; [importlib.import_module(name) for name in {names}]"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
