"""What stands on the terminal, at two widths and in a pipe: the words that matter."""

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from rich.progress import Progress as Bars

from colmap_inertial.cli import main
from colmap_inertial.cli.screen import Screen, Stage
from colmap_inertial.cli.terminal import show_scale
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import ScaleEstimate
from colmap_inertial.diagnose import Diagnosis, Finding
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording
from tests.helpers.simulated_project import write_project

GLIDES = Finding(
    fact=Fact("no-acceleration", acceleration_rms_m_s2=0.02, turning_rms_rad_s=0.5),
    severity="error",
)
CUT = Finding(
    fact=Fact("saturated", sensor="gyroscope", samples=80, of=4000, axes="x", counts=(80,), share=0.02),
    severity="warning",
)
TOLD = Finding(fact=Fact("pictures-too-few", pairs=3), severity="info")


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
    assert "only 3 pairs" not in said and "Ctrl-C ends the run" in said
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
    assert "no-acceleration" not in err and "it stood still" in err and "Metric scale ..." not in err


@pytest.mark.parametrize("width", [80, 140, None], ids=["80", "140", "piped"])
def test_a_finding_that_stops_the_run_is_left_to_the_error(width):
    stops = Finding(fact=Fact("stabilised", share=0.2), severity="error")
    screen, file = screen_of(width)
    screen.findings(Diagnosis(findings=(stops, CUT)), stops=True)
    said = " ".join(file.getvalue().split())
    assert "saturated" in said and "stabilised" not in said and "Ctrl-C" not in said
    screen, file = screen_of(width)
    screen.findings(Diagnosis(findings=(stops, CUT)))
    assert stops.evidence in " ".join(file.getvalue().split())


def test_a_pipe_has_a_line_for_each_stage_and_few_of_how_far_it_is():
    now = [0.0]
    file = io.StringIO()
    console = Console(file=file, width=80)
    screen = Screen(console, Bars(console=console, disable=True), now=lambda: now[0])
    for step in ("frames", "matches"):
        screen.kept(step)
    screen.began("mapping", [])
    for done in range(101):
        screen("mapping", done, 100)
        now[0] += 1
    screen("metric", 0, 1)
    lines = file.getvalue().splitlines()
    assert lines[:3] == ["kept from the earlier run: frames, matches", "Mapping ...", "Mapping 10/100, 2:31 left"]
    assert lines[-2:] == ["Mapping 100/100, took 1:40", "Metric scale ..."] and len(lines) == 13
    assert not screen.unchanged


def test_the_time_left_is_by_what_this_run_did_and_runs_down():
    stage = Stage(0.0, 40, 100)
    assert stage.ends_in(5.0) == ""  # nothing done yet
    stage.moved(30.0, 50, 100)
    assert stage.left_s(30.0) == pytest.approx(150)
    assert stage.left_s(40.0) == pytest.approx(140) and stage.ends_in(40.0) == "2:20 left"
    stage.moved(60.0, 100, 100)
    assert stage.ends_in(60.0) == ""
    assert Stage(0.0, 0, 0).left_s(9.0) is None


def test_the_speed_is_that_of_the_last_half_without_pauses_and_of_each_model_by_itself():
    stage = Stage(0.0, 0, 200)
    stage.moved(40.0, 10, 200)  # the first steps are slow
    stage.moved(60.0, 40, 200)
    assert stage.left_s(60.0) == pytest.approx(160 * 2 / 3)
    stage.moved(100.0, 40, 80)  # a pause in which the total becomes known
    assert stage.left_s(110.0) == pytest.approx(40 * 2 / 3 - 10)
    stage.moved(130.0, 80, 80)
    stage.moved(130.0, 0, 50)
    assert stage.left_s(140.0) is None
    stage.moved(150.0, 10, 50)
    assert stage.left_s(150.0) == pytest.approx(80)


def test_no_time_is_said_where_a_step_takes_longer_than_all_was_to():
    stage = Stage(0.0, 0, 4)
    stage.moved(10.0, 3, 4)
    assert stage.ends_in(12.0) == "0:01 left" and stage.ends_in(14.0) == ""


def test_a_stage_whose_steps_grow_dearer_ends_when_it_says(subtests):
    """As a mapper's: to the power of 1.2, and an adjustment of all at the end, 12 % of the time."""
    for share in (0.1, 0.2, 0.5, 0.8):
        with subtests.test(share=share):
            stage, total = Stage(0.0, 0, 500, name="mapping"), 500.0
            for done in range(1, round(500 * share) + 1):
                now_s = 0.88 * total * (done / 500) ** 1.2
                stage.moved(now_s, done, 500)
            assert stage.left_s(now_s) == pytest.approx(total - now_s, rel=0.02)
            if share < 0.3:
                assert Stage(0.0, 0, 500).left_s(now_s) is None
                linear = Stage(0.0, 0, 500)
                linear.moved(now_s, done, 500)
                assert linear.left_s(now_s) < 0.65 * (total - now_s)


def test_work_is_shown_as_a_share_and_its_unknown_end_not_at_all():
    stage = Stage(0.0, 0, 0, name="matches")
    stage.moved(5.0, 145, 0)
    assert stage.count() == "" and stage.ends_in(5.0) == ""
    stage.moved(6.0, 145, 580)
    assert stage.count() == "25 %" and stage.ends_in(6.0) == "0:15 left"


def test_before_the_first_step_is_done_the_bytes_written_move(tmp_path):
    database = tmp_path / "database.db"
    stage = Stage(0.0, 0, 990, [database])
    assert stage.count() == "0/990"
    for written, shown in ((900_000, "0/990"), (1_200_000, "0/990 (1 MB)"), (3_000_000, "0/990 (3 MB)")):
        database.write_bytes(bytes(written))
        assert stage.count() == shown
    (tmp_path / "database.db-wal").write_bytes(bytes(9_000_000))
    assert stage.count() == "0/990 (12 MB)"
    stage.moved(1.0, 400, 990)
    assert stage.count() == "400/990"


def estimate(verdict, reasons, notes):
    number = {"metres_per_unit": 2.0, "sigma_log": 0.02, "ci95": (1.9, 2.1)}
    if verdict == "refused":
        number = dict.fromkeys(number)
    return ScaleEstimate(verdict=verdict, method="joint", reasons=reasons, notes=notes, **number)


JUMPS = "poses jump at 40 places; negligible"


def test_only_what_decided_the_verdict_stands_as_reason(subtests, capsys):
    for width in ("80", "140"):
        for verdict in ("trusted", "weak", "refused"):
            with subtests.test(width=width, verdict=verdict), pytest.MonkeyPatch.context() as monkeypatch:
                capsys.readouterr()
                monkeypatch.setenv("COLUMNS", width)
                reasons = () if verdict == "trusted" else ("the clip is short", "its poses are few")
                show_scale(estimate(verdict, reasons, (JUMPS,)), Path("model"))
                out = capsys.readouterr().out
                rows = [line.strip("\u2502 ") for line in out.splitlines()]
                assert [row.split(maxsplit=1)[1] for row in rows if row.startswith("Reason")] == list(reasons[:1])
                assert [row.split(maxsplit=1)[1] for row in rows if row.startswith("Note")] == [JUMPS]
                assert max(map(len, out.splitlines())) <= int(width)


def test_json_goes_to_standard_output_alone(project, capsys):
    args = ["scale", project.model, "--imu", project.imu, "--frame-times", project.frame_times, "--json", "-"]
    code, out, err = run(capsys, *args)
    assert code == 0 and err == ""
    found = json.loads(out)
    assert found["verdict"] in ("trusted", "weak") and found["ci95"]


def test_without_json_a_scale_is_looked_at(project, capsys):
    files = ["--imu", project.imu, "--frame-times", project.frame_times]
    code, out, _ = run(capsys, "scale", project.model, *files)
    assert code == 0 and "m per unit" in out and "Verdict" in out
    code, out, err = run(capsys, "scale", project.model, *files, "--quiet")
    assert (code, out, err) == (0, "", "")


def test_an_error_is_json_too_where_json_was_asked_for(tmp_path, capsys):
    code, out, err = run(capsys, "scale", tmp_path / "nowhere", "--json", "-")
    assert code == 2 and "no such file" in err
    told = json.loads(out)
    assert (told["error"], told["exit_code"]) == (err.removeprefix("error: ").strip(), 2)
    assert told["error_details"]["code"]


def test_quiet_and_verbose_are_not_given_together(subtests, capsys):
    for command in (
        "diagnose x",
        "scale x",
        "apply x y --undo",
        "validate x --images y --target z",
        "export x y",
        "view x",
        "reconstruct x y",
    ):
        with subtests.test(command=command):
            capsys.readouterr()
            code, _, err = run(capsys, *command.split(), "--quiet", "--verbose")
            assert code == 2 and "Mutually exclusive arguments" in err


def test_verbose_prints_the_log_of_a_run_and_json_says_that_nothing_was_done(project, tmp_path, capsys):
    args = ["reconstruct", project.model, tmp_path / "out", "--imu", project.imu, "--frame-times", project.frame_times]
    code, out, err = run(capsys, *args, "--verbose", "--json", "-")
    first = json.loads(out)
    assert code == 0 and (first["unchanged"], first["exit_code"]) == (False, 0)
    assert " INFO metric: started" in err
    code, out, err = run(capsys, *args, "--json", "-")
    again = json.loads(out)
    assert code == 0 and again["unchanged"] and " INFO " not in err
    assert again["models"] == first["models"]
    code, out, err = run(capsys, *args)
    assert code == 0 and out.startswith("nothing to do: kept from the earlier run")
    code, out, err = run(capsys, *args, "--quiet")
    assert (code, out, err) == (0, "", "")


def test_a_scale_says_apart_what_its_recording_has(project, tmp_path, capsys):
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
    said = "camera and IMU clocks do not overlap"
    assert not any(said in reason for reason in found["reasons"]) and any(said in note for note in found["notes"])
    (line,) = (line for line in out.splitlines() if said in line)
    assert "Note" in line


def test_a_batch_says_what_begins_and_what_was_found_in_each_capture_once(capsys):
    from colmap_inertial.tools.batch.task import CaptureStatus
    from colmap_inertial.tools.batch.terminal import live_batch

    found = "error: it hardly moves [at 3 s]; swing it (no-motion)"
    with live_batch() as watch:
        for done in range(3):
            watch(
                CaptureStatus(
                    name="hall", state="running", stage="matches", steps_done=done, steps=9, findings=(found,)
                )
            )
        ended = CaptureStatus(
            name="yard", state="failed", exit_code=3, error="scale: it hardly moves [at 3 s]; swing it"
        )
        watch(replace(ended, findings=(found, "warning: 2 % are cut; use a wider range (saturated)")))
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["started hall", f"hall {found}"] and "".join(lines).count("no-motion") == 1
    assert lines[2] == "yard warning: 2 % are cut; use a wider range (saturated)"
    with live_batch(quiet=True) as watch:
        watch(ended)
    assert capsys.readouterr().err == ""


@pytest.fixture(scope="module")
def made(project, tmp_path_factory):
    """An existing project in metres, and the arguments that made it."""
    out = tmp_path_factory.mktemp("made") / "out"
    args = ["reconstruct", project.model, out, "--imu", project.imu, "--frame-times", project.frame_times]
    with pytest.raises(SystemExit):
        main([*map(str, args), "--quiet"])
    return args


@pytest.mark.parametrize("columns", ["80", "140"])
def test_the_last_screen_begins_with_metres_and_ends_with_the_next_command(made, columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", columns)
    _, out, _ = run(capsys, *made)
    lines = out.splitlines()
    box = [line for line in lines if line.startswith("\u2502")]
    assert re.match(r"\u2502 Metres +lengths of 10 m are accurate to \d+(\.\d)? cm", box[0])
    assert [line.split()[1] for line in box if line.split()[1] in ("Verdict", "Scale", "Images", "Written")] == [
        "Verdict", "Scale", "Images", "Written",
    ]  # fmt: skip
    assert max(map(len, box)) <= int(columns)
    assert lines[-1].startswith("next: ") and lines[-1].endswith(f"colmap-inertial view {made[2]}")


def test_a_refused_scale_ends_with_what_to_look_at(still, tmp_path, capsys):
    args = ["--imu", still.imu, "--frame-times", still.frame_times]
    code, out, err = run(capsys, "reconstruct", still.model, tmp_path / "out", *args, "--force")
    assert code == 3 and "no metres: the recording does not determine the scale" in " ".join(out.split())
    report = tmp_path / "out" / "report.html"
    assert " ".join(out.split()).endswith(f"next: open {report}: cause and remedy")
    assert err.splitlines()[-1] == "error: no scale was accepted, for the reasons above"
    assert err.count("(no-motion)") == 1


def test_nothing_found_says_what_was_not_checked(subtests, capsys):
    for checked, words in (
        (("gyroscope", "accelerometer", "frame times"), "whether camera and gyroscope match"),
        (("gyroscope", "frame times", "pictures"), "gravity and scale (no accelerometer)"),
        (("gyroscope", "accelerometer", "frame times", "pictures"), ""),
    ):
        with subtests.test(checked=checked, words=words):
            capsys.readouterr()
            from colmap_inertial.cli.terminal import show_diagnosis

            for findings in ((), (CUT,)):
                show_diagnosis(Diagnosis(findings=findings, checked=checked), Path("capture"))
                last = capsys.readouterr().out.splitlines()[-1]
                assert last.startswith(f"not checked: {words}") if words else "not checked" not in last
