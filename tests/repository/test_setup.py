"""What sets the checks up: skips that count as failures, and the extras that a set-up remembers."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from colmap_inertial.cli import parse

ROOT = Path(__file__).parents[2]
TESTS = """
import pytest

def test_passes():
    pass

@pytest.mark.skip(reason="no browser")
def test_marked():
    pass

def test_inside():
    pytest.importorskip("no_such_module")

@pytest.mark.xfail(reason="known")
def test_known():
    raise AssertionError
"""


@pytest.mark.parametrize(("switch", "outcome"), [([], "1 passed, 3 skipped, 1 xfailed"), (["--no-skips"], "")])
def test_skips_are_failures_where_that_is_asked_for(tmp_path, switch, outcome):
    for name in ("conftest.py", "quick.txt", "slow.txt"):
        shutil.copy(ROOT / "tests" / name, tmp_path)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "test_some.py").write_text(TESTS)
    (tmp_path / "test_whole.py").write_text('import pytest\npytest.importorskip("no_such_module")\n')
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *switch]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
    if not switch:
        assert done.returncode == 0 and outcome in done.stdout, done.stdout
        return
    assert done.returncode != 0
    assert "1 error" in done.stdout and "skipped, which --no-skips does not allow" in done.stdout
    whole = [*command, "test_some.py"]
    done = subprocess.run(whole, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 1 and "1 failed, 1 passed, 1 xfailed, 1 error" in done.stdout, done.stdout
    assert "skipped, which --no-skips does not allow: Skipped: no browser" in done.stdout


def test_the_lists_name_files_that_are_there(subtests):
    for name in ("quick.txt", "slow.txt"):
        with subtests.test(name=name):
            listed = (ROOT / "tests" / name).read_text().split()
            assert len(set(listed)) == len(listed)
            assert [file for file in listed if not (ROOT / "tests" / file).is_file()] == []


#: A project of which an extra takes another, with a version and a marker.
PROJECT = """
[project]
name = "own"
dependencies = ["one>=1.0,<2"]
[project.optional-dependencies]
view = ["two; python_version < '4'"]
mesh = ["four"]
dev = ["own[view]", "three"]
complete = ["own[dev,mesh]"]
"""


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout whose ``pip`` writes down what it is asked for. Python is itself, not a shim that looks for it."""
    root, tools = tmp_path / "checkout", tmp_path / "python"
    tools.mkdir()
    (tools / "python3.11").symlink_to(os.path.realpath(sys.executable))
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    (root / "scripts").mkdir(parents=True)
    shutil.copy(ROOT / "scripts" / "setup.sh", root / "scripts")
    kernels = root / "colmap_inertial" / "_kernels"
    kernels.mkdir(parents=True)
    for name in ("CMakeLists.txt", "a.cpp", "a.h"):
        (kernels / name).touch()
    (root / "pyproject.toml").write_text(PROJECT)
    python = root / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text('#!/bin/sh\nshift 2\n[ "$1" = --version ] || echo "$*" >>asked.txt\n')
    python.chmod(0o755)
    return root


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler here")
def test_the_set_up_knows_which_extras_are_there(checkout):
    def asked(*extras):
        (checkout / "asked.txt").unlink(missing_ok=True)
        subprocess.run(["bash", "scripts/setup.sh", *extras], cwd=checkout, check=True, capture_output=True)
        path = checkout / "asked.txt"
        if not path.exists():
            return None
        own, others = sorted(line.partition("--no-compile ")[2] for line in path.read_text().splitlines())
        assert own == "--no-deps --editable ."
        return others

    view, dev = "two; python_version < '4'", "three"
    assert asked() == "one>=1.0,<2"  # the demo needs no extra
    assert asked() is None
    assert asked("mesh") == "one>=1.0,<2 four"
    assert asked("dev") == f"one>=1.0,<2 {view} {dev} four"
    assert asked() is None and asked("dev") is None
    assert asked("view") == f"one>=1.0,<2 {view} {dev} four"
    os.utime(checkout / "pyproject.toml", (2**31, 2**31))
    assert asked("dev") == f"one>=1.0,<2 {view} {dev} four"


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler here")
@pytest.mark.parametrize("fails", ["--editable", "three"])
def test_a_set_up_of_which_a_half_fails_is_done_again(checkout, fails):
    python = checkout / ".venv" / "bin" / "python"
    text = python.read_text()
    python.write_text(text + f'case "$*" in *{fails}*) exit 7;; esac\n')
    command = ["bash", "scripts/setup.sh", "dev"]
    assert subprocess.run(command, cwd=checkout, capture_output=True).returncode == 7
    python.write_text(text)
    assert subprocess.run(command, cwd=checkout, capture_output=True).returncode == 0
    assert len((checkout / "asked.txt").read_text().splitlines()) == 4
    done = subprocess.run([*command, "nothing"], cwd=checkout, capture_output=True, text=True)
    assert done.returncode == 1 and "no extra nothing" in done.stderr


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler here")
@pytest.mark.parametrize("extra", ["complete", "mesh", "dev"])
def test_the_set_up_installs_what_open3d_takes_from_the_system(checkout, tmp_path, extra):
    tools = tmp_path / "tools"
    tools.mkdir()
    written = {
        "python3.11": f'case "$*" in *libGL.so.1*|*libX11.so.6*) exit 1;; esac\nexec {sys.executable} "$@"\n',
        "apt-get": f'echo "$*" >>{tmp_path}/apt.txt\n',
        "sudo": 'shift\nexec "$@"\n',
    }
    for name, text in written.items():
        (tools / name).write_text("#!/bin/sh\n" + text)
        (tools / name).chmod(0o755)
    env = os.environ | {"PATH": f"{tools}:{os.environ['PATH']}"}
    subprocess.run(["bash", "scripts/setup.sh", extra], cwd=checkout, env=env, check=True, capture_output=True)
    asked = (tmp_path / "apt.txt").read_text() if (tmp_path / "apt.txt").exists() else ""
    assert ("libgl1" in asked.split() and "libx11-6" in asked.split()) == (extra != "dev")


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler here")
@pytest.mark.parametrize("works", [True, False])
def test_the_browser_comes_along_and_only_tests_of_it_need_it(checkout, tmp_path, works):
    tools, asked = tmp_path / "tools", tmp_path / "apt.txt"
    tools.mkdir()
    needed = ("bash", "sh", "cat", "dirname", "find", "g++", "getconf", "grep", "id", "paste", "sed", "sort")
    for name in needed:  # and no browser
        (tools / name).symlink_to(shutil.which(name))
    (tools / "python3.11").symlink_to(os.path.realpath(sys.executable))
    for name, text in (("apt-get", f'echo "$*" >>{asked}\nexit {int(not works)}\n'), ("sudo", 'shift\nexec "$@"\n')):
        (tools / name).write_text("#!/bin/sh\n" + text)
        (tools / name).chmod(0o755)
    command = ["bash", "scripts/setup.sh", "--browser", "dev"]
    env = os.environ | {"PATH": str(tools)}
    done = subprocess.run(command, cwd=checkout, env=env, check=True, capture_output=True, text=True)
    assert ("not tested in a browser" in done.stderr) == (not works), done.stderr
    assert ("chromium chromium-driver" in asked.read_text()) == works
    assert len((checkout / "asked.txt").read_text().splitlines()) == 2
    for name in ("chromium", "chromedriver"):
        (tools / name).symlink_to("/bin/true")
    asked.unlink()
    subprocess.run(command, cwd=checkout, env=env, check=True, capture_output=True)
    assert not asked.exists()


def test_the_demo_ends_with_commands_that_there_are():
    text = (ROOT / "scripts" / "demo.sh").read_text()
    templates = re.findall(r"printf '  %s (.*?)\\n'", text)
    assert len(templates) == 2
    for template in templates:
        parse(template.replace("%q", "out").split())
