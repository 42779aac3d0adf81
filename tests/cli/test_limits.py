"""Too little memory or too few files: a sentence before the work, or where they run out on the way."""

import errno
import os
import subprocess
import sys

import pytest

from colmap_inertial.cli import main, process
from colmap_inertial.cli.scale import Scale
from colmap_inertial.core.threads import usable_processors

LIMITED = """
import resource, sys
kind = getattr(resource, sys.argv[1])
resource.setrlimit(kind, (int(sys.argv[2]), resource.getrlimit(kind)[1]))
from colmap_inertial.cli import main
main(sys.argv[3:])
"""
ARGUMENTS = ("apply", "project", "out", "--factor", "2")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limits")
def test_bytecode_is_not_cut_off_at_the_largest_file(tmp_path):
    (tmp_path / "project").mkdir()
    command = [sys.executable, "-c", LIMITED, "RLIMIT_FSIZE", "2000", *ARGUMENTS]
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": ""}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.stderr.startswith("error: ")
    of_ours = [path for path in (tmp_path / "cache").rglob("*.pyc") if "colmap_inertial/model" in path.as_posix()]
    assert of_ours == []  # what ``main`` imports


@pytest.mark.parametrize(
    ("kind", "least"),
    [
        ("RLIMIT_AS", process.LEAST_BYTES + process.THREAD_BYTES * usable_processors()),
        ("RLIMIT_NOFILE", process.LEAST_FILES),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limits")
def test_a_limit_that_is_too_low_is_said_at_once(tmp_path, kind, least):
    for value, said in ((least - 1, "raise the limit (ulimit -"), (least, "no such folder")):
        command = [sys.executable, "-c", LIMITED, kind, str(value), *ARGUMENTS]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 2 and done.stderr.startswith("error: ") and len(done.stderr.splitlines()) == 1
        assert said in done.stderr
        assert not (tmp_path / "out").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limits")
def test_a_limit_that_numpy_cannot_be_loaded_within_is_said_too(tmp_path):
    command = [sys.executable, "-c", LIMITED, "RLIMIT_AS", str(64 << 20), *ARGUMENTS]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("error: only 0.067 GB of memory are allowed to a process here")


def test_what_runs_out_on_the_way_is_a_sentence(subtests, capsys):
    for error, said in (
        (MemoryError(), "out of memory"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "out of memory"),
        (ImportError("cv2.abi3.so: failed to map segment from shared object"), "out of memory"),
        (OSError(errno.EMFILE, "Too many open files"), "too many files are open"),
    ):
        with subtests.test(error=error), pytest.MonkeyPatch.context() as patch:

            def run(self, error=error):
                raise error

            patch.setattr(Scale, "run", run)
            capsys.readouterr()
            with pytest.raises(SystemExit) as stopped:
                main(["scale", "a", "--json", "b"])
            assert stopped.value.code == 2
            told = capsys.readouterr().err
            assert told.startswith(f"error: {said}") and len(told.splitlines()) == 1


def test_what_it_has_led_to_is_the_same_sentence(monkeypatch, capsys):
    def run(self):
        try:
            raise ImportError("_core.so: failed to map segment from shared object")
        except ImportError as error:
            raise RuntimeError("Cannot import the backend.\nMake sure that you install it") from error

    monkeypatch.setattr(Scale, "run", run)
    with pytest.raises(SystemExit) as stopped:
        main(["scale", "a", "--json", "b"])
    assert stopped.value.code == 2
    assert capsys.readouterr().err.startswith("error: out of memory")


def test_anything_else_keeps_its_traceback(subtests):
    for error in (
        OSError(errno.EIO, "Input/output error"),
        ImportError("no module"),
        KeyError("a"),
        RuntimeError("b"),
    ):
        with subtests.test(error=error), pytest.MonkeyPatch.context() as patch:

            def run(self, error=error):
                raise error

            patch.setattr(Scale, "run", run)
            with pytest.raises(type(error)):
                main(["scale", "a", "--json", "b"])
