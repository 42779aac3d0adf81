"""Ten tasks that a newcomer solves by --help alone: the page names the option, in words that one would look for."""

import re

import pytest

from colmap_inertial.cli import COMMANDS
from colmap_inertial.cli.help import list_options
from tests.cli.test_commands import run
from tests.helpers.cases import loop_over

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
    ("make a device's next recordings better", "align", "--remember", ["device name"]),
    ("repeat a run bit for bit", "reconstruct", "--deterministic", ["same model, bit for bit"]),
    ("keep the depths of a multi-aperture camera", "fuse-apertures", "--depth", ["depths (metres)"]),
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
    for command in COMMANDS:
        _, out, _ = run(capsys, command, "--help-all")
        paragraphs = out.split("\n\n")
        assert paragraphs[0].startswith(f"usage: colmap-inertial {command}")
        assert paragraphs[1].endswith(".") and "Example: colmap-inertial" in out
        assert out.index("Arguments:") < out.index("Options of every command:")


def test_the_common_options_come_first(subtests, capsys):
    for command in ("", *COMMANDS):
        with subtests.test(command=command), pytest.MonkeyPatch.context() as monkeypatch:
            capsys.readouterr()
            monkeypatch.setenv("COLUMNS", "80")
            code, out, _ = run(capsys, *filter(None, [command]), "--help")
            assert code == 0
            assert "--help-all" in out or not command
            assert ("--limits.megapixels FLOAT" in out) == (not command)


@loop_over("command", list(COMMANDS))
def test_all_options_are_there_by_topic_but_for_special_cameras_and_limits(command, capsys):
    _, out, _ = run(capsys, command, "--help-all")
    known = {name for option in list_options(COMMANDS[command]) for name in re.findall(r"--[\w.-]+", option.label)}
    rows = re.findall(r"^  (--[a-z].*?)(?:  |$)", out, re.MULTILINE)
    shown = {name for row in rows for name in re.findall(r"--[\w.-]+", row)} - {"--help-all"}
    left_out = {name for name in known if name.startswith(("--limits.", "--apertures.", "--exposures."))}
    assert shown == known - left_out and len(left_out) >= 3
    assert ("[apertures] as of `fuse-apertures`, [exposures] as of" in " ".join(out.split())) == (len(left_out) > 3)
    assert command != "reconstruct" or "\nLess common:" not in out


def test_the_overview_is_the_same_for_all_that_ask_for_help(capsys):
    pages = [run(capsys, word)[:2] for word in ("-h", "--help", "--help-all")]
    assert pages[0][0] == 0 and pages[0] == pages[1] == pages[2]
