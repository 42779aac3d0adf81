"""What a file or a name holds reaches a person as signs: no control characters in terminal, log, table and page."""

import io
import logging
import os
import subprocess
import sys

import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.printing import PrintableFormatter, cell, open_console, printable, printable_values
from colmap_inertial.io.files import check_names, require_utf8
from colmap_inertial.report import write_report
from tests.helpers.cases import loop_over
from tests.helpers.report_runs import write_run

TITLE = "\x1b]0;gone\x07\x1b[2J"
SHOWN = "\\x1b]0;gone\\x07\\x1b[2J"


@loop_over(
    ("text", "shown"),
    [
        ("größe\n\tµT", "größe\n\tµT"),
        ("a\u3000b\N{NO-BREAK SPACE}c", "a\u3000b\N{NO-BREAK SPACE}c"),
        (TITLE, SHOWN),
        ("a\rb\x7f\x9b", "a\\rb\\x7f\\x9b"),
        ("\u202eexe\udcff", "\\u202eexe\\udcff"),
    ],
)
def test_signs_stay_and_all_else_is_named(text, shown):
    assert printable(text) == shown
    assert printable_values({text: [text, 1, None, (text,)]}) == {shown: [shown, 1, None, [shown]]}
    stream = io.StringIO()
    open_console(file=stream, width=200).print(text, markup=False, highlight=False)
    assert printable(stream.getvalue()) == stream.getvalue()
    line = PrintableFormatter().format(logging.LogRecord("a", logging.INFO, "a", 1, "%s", (text,), None))
    assert line.endswith(f"INFO {shown}")


@loop_over(
    ("text", "written"),
    [
        ("=1+1|A1.jpg", "'=1+1|A1.jpg"),
        ("@a", "'@a"),
        ("a=1", "a=1"),
        ("-1.jpg", "'-1.jpg"),
        ("\t=1", "'\t=1"),
        ("\uff1d1", "'\uff1d1"),
    ],
)
def test_a_cell_is_no_formula(text, written):
    assert cell(text) == written


@loop_over("name", [f"{TITLE}.jpg", "a\nb", "a\tb", "a\0b", "a\udcff", "a/\x7f/b"])
def test_such_names_are_not_followed(name):
    with pytest.raises(FormatError, match="which is not UTF-8, or holds a control character"):
        check_names([name], "a model")


def test_a_message_on_the_terminal(tmp_path, capsys):
    path = tmp_path / "imu.csv"
    path.write_text(f"t_s,gx [{TITLE}],gy,gz\n0,1,2,3\n1,2,3,4\n")
    with pytest.raises(SystemExit) as stopped:
        main(["diagnose", str(path)])
    told = capsys.readouterr()
    assert stopped.value.code == 2 and SHOWN in told.err and "\x1b" not in told.out + told.err


def test_a_folder_whose_name_is_no_utf_8(subtests, tmp_path_factory):
    for at in ("capture", "out", "json"):
        with subtests.test(at=at):
            tmp_path = tmp_path_factory.mktemp("given")
            name = os.fsdecode(os.fsencode(tmp_path) + b"/n\xff")
            os.mkdir(name)
            args = {"capture": [name, str(tmp_path / "out")], "out": [str(tmp_path), f"{name}/out"]}
            words = args.get(at, [str(tmp_path), str(tmp_path / "out"), "--json", f"{name}/a.json"])
            command = [sys.executable, "-m", "colmap_inertial", "reconstruct", *words]
            done = subprocess.run(command, capture_output=True, text=True)
            assert (
                done.returncode == 2
                and done.stderr.startswith("error: ")
                and "is not UTF-8 or holds a control" in done.stderr
            )
            with pytest.raises(FormatError, match="rename it"):
                require_utf8(tmp_path, name)


def test_a_report(tmp_path):
    write_run(tmp_path / "run", points=40, duration_s=8.0)
    result = tmp_path / "run" / "result.json"
    text = result.read_text(encoding="utf-8")
    assert '"capture": "' in text
    result.write_text(text.replace('"capture": "', '"capture": "\\u001b[2J\\u202e', 1), encoding="utf-8")
    page = write_report(tmp_path / "run")
    for path in (page, page.with_suffix(".json")):
        written = path.read_text(encoding="utf-8")
        assert "x1b[2J" in written and "u202e" in written
        assert not {"\x1b", "\u202e", "\\u001b"} & set(written) and "\\u001b" not in written
