"""Ctrl-C and SIGTERM: answered at once also within compiled code, the second one at once, nothing half left behind."""

import contextlib
import os
import signal
import subprocess
import sys
import textwrap
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import model_project

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")

#: The work is one call that holds Python's handlers off, as COLMAP's do; sqlite3 lets other threads run meanwhile.
BUSY = textwrap.dedent("""
    import sqlite3, sys
    from colmap_inertial.cli.process import answering_signals
    with answering_signals():
        print("ready", flush=True)
        sqlite3.connect(":memory:").execute(
            "with recursive n(i) as (select 1 union all select i + 1 from n limit 60000000) select max(i) from n"
        ).fetchone()
        print("done", flush=True)
""")


@contextlib.contextmanager
def started(*command):
    # a job in the background of a shell is deaf to Ctrl-C, and so is what it starts
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(
        [sys.executable, *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=heed,
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


def test_ctrl_c_is_answered_while_compiled_code_runs_and_the_second_one_ends_it():
    with started("-c", BUSY) as process:
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.3)
        begun = time.monotonic()
        process.send_signal(signal.SIGINT)
        assert process.stderr.readline() == "\n"
        assert "stopping" in process.stderr.readline()
        assert time.monotonic() - begun < 1 and process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.wait(5) == 130
        assert process.stdout.read() == ""


RECIPE = """
seed = 5
world = "desk"
frame_rate_hz = 5.0
format = "jpeg"
[motion]
kind = "orbit"
duration_s = 60.0
[imu]
preset = "tablet"
[camera]
exposure_s = 0.004
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, (143, -15)), (signal.SIGINT, (130,))])
def test_a_simulation_that_is_ended_leaves_nothing_and_no_trace(tmp_path, number, code):
    (tmp_path / "recipe.toml").write_text(RECIPE)
    out = tmp_path / "made" / "scene"
    command = ["-m", "colmap_inertial", "simulate", tmp_path / "recipe.toml", out, "--workers", "1"]
    with started(*map(str, command)) as process:
        until = time.monotonic() + 60
        while not list(Path(tmp_path).glob("made/.*/frames")) and time.monotonic() < until:
            time.sleep(0.1)
        assert list(Path(tmp_path).glob("made/.*/frames"))
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
        assert process.returncode in code
        assert "stopping" in said and "Traceback" not in said and "***" not in said and " @ " not in said
        assert list((tmp_path / "made").iterdir()) == []


def test_who_has_read_a_model_ends_without_a_trace(tmp_path):
    """As ``view`` and ``scale`` do; COLMAP's logging library answers by a trace of its own."""
    model_project.sparse_model(np.random.default_rng(4)).write_binary(str(tmp_path))
    code = "import sys, time; from colmap_inertial.model import read_model; read_model(sys.argv[1]); "
    with started("-c", code + "print('ready', flush=True); time.sleep(60)", str(tmp_path)) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGTERM)
        assert process.communicate(timeout=30) == ("", "")
        assert process.returncode == -signal.SIGTERM
