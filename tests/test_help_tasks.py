"""Ten tasks that a newcomer solves by --help alone: the page names the option, in words that one would look for."""

import re

import pytest
from cases import loop_over
from test_cli import run

TASKS = [
    ("see whether a recording is any good before mapping", "", "diagnose", ["before any"]),
    ("make a model in metres of a video with its IMU", "", "reconstruct", ["IMU", "in metres"]),
    ("use an existing COLMAP project", "reconstruct", "--imu", ["IMU recording"]),
    ("say when its images were taken", "reconstruct", "--frame-times", ["When the images were taken"]),
    ("get a dense point cloud and mesh", "reconstruct", "--dense", ["mesh"]),
    ("get metres without an IMU", "reconstruct", "--scale-from", ["target", "known distance"]),
    ("have the result for a script", "scale", "--json", ["standard output"]),
    ("check the size by a printed board", "validate", "--target", ["look for"]),
    ("take the model into a splatting trainer", "export", "--for", ["program"]),
    ("make a device's next recordings better", "align", "--remember", ["by themselves"]),
    ("raise how large a picture may be", "deblur", "--limits.megapixels", ["Pictures of more pixels"]),
]


@loop_over(("task", "command", "name", "words"), TASKS, ids=[task for task, *_ in TASKS])
def test_the_help_solves_it(task, command, name, words, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = run(capsys, *([command, "--help-all"] if command else ["--help"]))
    assert code == 0
    found = re.search(rf"^  {re.escape(name)}(?![\w.-])", out, re.MULTILINE)
    assert found is not None
    said = " ".join(out[found.start() :][:600].split())
    assert all(word in said for word in words), said


def test_each_page_begins_with_what_it_does_and_an_example(capsys):
    from colmap_inertial.cli import _COMMANDS

    for command in _COMMANDS:
        _, out, _ = run(capsys, command, "--help-all")
        paragraphs = out.split("\n\n")
        assert paragraphs[0].startswith(f"usage: colmap-inertial {command}")
        assert paragraphs[1].endswith(".") and "Example: colmap-inertial" in out
        assert out.index("Arguments:") < out.index("Of every command:")


@pytest.mark.parametrize(
    "command", ["reconstruct", "batch", "scale", "validate", "diagnose", "deblur", "export", "view"]
)
def test_the_common_options_fit_one_screen(command, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = run(capsys, command, "--help")
    assert code == 0 and len(out.splitlines()) <= 45
    assert "--help-all" in out and "--limits" not in out
