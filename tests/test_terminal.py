"""What stands on the terminal, at two widths and in a pipe: the words that matter."""

import io
import json
from pathlib import Path

import pytest
from conftest import write_project
from rich.console import Console
from rich.progress import Progress as Bars

from colmap_inertial.cli import main
from colmap_inertial.cli.terminal import Screen, show_scale
from colmap_inertial.diagnose import Diagnosis, Finding
from colmap_inertial.simulate import MotionOptions, RecordingOptions, simulate_recording
from colmap_inertial.types import ScaleEstimate

GLIDES = Finding(
    code="no-acceleration",
    severity="error",
    evidence="it turns by 0.50 rad/s, but stays in place or glides [at 3 s]",
    advice="swing it back and forth by 20 cm or more while it sees texture",
)
CUT = Finding(code="saturated", severity="warning", evidence="2 % of readings are cut", advice="use a wider range")
TOLD = Finding(code="device", severity="info", evidence="a phone", advice="nothing")


def run(capsys, *args):
    """Exit code, standard output, standard error of one call."""
    with pytest.raises(SystemExit) as stopped:
        main([str(arg) for arg in args])
    captured = capsys.readouterr()
    return stopped.value.code, captured.out, captured.err


def screen_of(width):
    """A screen of so many columns, or a pipe; and what is written to it."""
    file = io.StringIO()
    console = Console(file=file, width=width or 80, force_terminal=width is not None, color_system=None)
    return Screen(console, Bars(console=console, disable=True)), file


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """A project whose camera stood on a tripod."""
    recording = simulate_recording(RecordingOptions(motion=MotionOptions(kind="static", duration_s=20)), seed=2)
    return write_project(tmp_path_factory.mktemp("still"), recording)


@pytest.mark.parametrize("width", [80, 140, None], ids=["80", "140", "piped"])
def test_errors_and_warnings_of_the_check_beforehand_stand_there_whole(width):
    screen, file = screen_of(width)
    screen.findings(Diagnosis(findings=(GLIDES, CUT, TOLD)))
    text = file.getvalue()
    lines = text.splitlines()
    said = " ".join(text.split())
    for finding in (GLIDES, CUT):
        assert f"{finding.severity}: {finding.evidence}; {finding.advice} ({finding.code})" in said
    assert "a phone" not in said and "Ctrl-C ends the run" in said
    assert len(lines) == 3 if width is None else max(map(len, lines)) <= width


def test_nothing_is_said_where_nothing_was_found():
    screen, file = screen_of(None)
    screen.findings(Diagnosis(findings=(TOLD,)))
    assert file.getvalue() == ""


def test_what_the_check_beforehand_finds_is_said_before_the_work(still, tmp_path, capsys):
    code, _, err = run(
        capsys, "reconstruct", still.model, tmp_path / "out", "--imu", still.imu, "--frame-times", still.frame_times
    )
    assert code == 3
    found, work = err.index("error: "), err.index("Metric scale ...")
    assert found < work and "(no-motion)" in err[found:work]


def estimate(verdict, reasons, notes):
    number = {"metres_per_unit": 2.0, "sigma_log": 0.02, "ci95": (1.9, 2.1)}
    if verdict == "refused":
        number = dict.fromkeys(number)
    return ScaleEstimate(verdict=verdict, method="joint", reasons=reasons, notes=notes, **number)


JUMPS = "poses jump at 40 places, which hardly counts"


@pytest.mark.parametrize("width", ["80", "140"])
@pytest.mark.parametrize("verdict", ["trusted", "weak", "refused"])
def test_only_what_decided_the_verdict_stands_as_reason(verdict, width, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", width)
    reasons = () if verdict == "trusted" else ("the clip is short", "its poses are few")
    show_scale(estimate(verdict, reasons, (JUMPS,)), Path("model"))
    out = capsys.readouterr().out
    rows = [line.strip("\u2502 ") for line in out.splitlines()]
    assert [row.split(maxsplit=1)[1] for row in rows if row.startswith("Reason")] == list(reasons[:1])
    assert [row.split(maxsplit=1)[1] for row in rows if row.startswith("Note")] == [JUMPS]
    assert max(map(len, out.splitlines())) <= int(width)


def test_a_scale_says_apart_what_its_recording_has(project, tmp_path, capsys):
    from dataclasses import replace

    far = replace(
        project.recording, imu=replace(project.recording.imu, epoch_ns=project.recording.imu.epoch_ns + 10**12)
    )
    files = write_project(tmp_path / "far", far)
    code, out, err = run(
        capsys, "scale", files.model, "--imu", files.imu, "--frame-times", files.frame_times,
        "--json", tmp_path / "scale.json",
    )  # fmt: skip
    assert code == 0, err
    found = json.loads((tmp_path / "scale.json").read_text())
    said = "the stamps of camera and IMU have no time in common"
    assert not any(said in reason for reason in found["reasons"]) and any(said in note for note in found["notes"])
    (line,) = (line for line in out.splitlines() if said in line)
    assert "Note" in line
