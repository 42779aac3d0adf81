"""A small part of ``scripts/study_faults.py``: short commands without disk, memory or files, and killed."""

import os
import random
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

import study_faults
from study_faults import Taken, commands, faults_of, one, start, watch

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="limits as Linux has them"),
]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Commands, what an undisturbed run of each takes, and what it makes."""
    root = tmp_path_factory.mktemp("faults")
    known, found = commands(root), {}
    for name in ("apply", "fuse-apertures"):
        command, out = known[name], root / "whole" / name
        out.parent.mkdir(exist_ok=True)
        process = start(command, out, root / "said.txt")
        taken = watch(process)
        assert process.returncode == 0, (root / "said.txt").read_text()
        sizes = [path.stat().st_size for path in out.rglob("*") if path.is_file()]
        taken.largest_bytes, taken.all_bytes = max(sizes), sum(sizes)
        found[name] = command, taken, command.made(out)
    return found


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("apply", "quota"),
        ("apply", "kill"),
        ("apply", "memory"),
        ("fuse-apertures", "quota"),
        ("fuse-apertures", "kill"),
        ("fuse-apertures", "files"),
    ],
)
def test_a_fault_leaves_no_half_result_and_is_told_in_a_sentence(whole, tmp_path, name, kind):
    command, taken, expected = whole[name]
    told, wrong = one(command, kind, random.Random(3), taken, expected, tmp_path)
    assert not wrong, f"{told}\n{wrong}"


def test_what_is_wrong_is_seen(monkeypatch, tmp_path):
    assert faults_of("3 pictures in out\n", 0, killed=False) == []
    assert faults_of("error: a: is no folder; name another\n", 2, killed=False) == []
    assert faults_of("", -9, killed=True) == []
    for text, code in (
        ("Traceback (most recent call last):\nKeyError: 1\n", 1),
        ("", -11),
        ("Features ...\n", 1),
        ("OpenBLAS error: Memory allocation still failed after 10 retries, giving up.\nerror: it ended there\n", 1),
    ):
        assert faults_of(text, code, killed=False)

    class Ended:
        pid = os.getpid()

        def wait(self, timeout=None):
            (tmp_path / "place" / "out").mkdir(parents=True, exist_ok=True)
            return 0

    monkeypatch.setattr(study_faults, "start", lambda *args, **limits: (tmp_path / "said.txt").touch() or Ended())
    command = study_faults.Command(("apply",), study_faults.files_of(), Path.is_dir)
    _, wrong = one(command, "quota", random.Random(0), Taken(largest_bytes=9000), {"a": b"1"}, tmp_path)
    assert wrong == ["it came through with another result"]
