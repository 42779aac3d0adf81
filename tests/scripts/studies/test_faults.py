"""A small part of ``scripts/studies/faults.py``: short commands without disk, memory or files, and killed."""

import os
import random
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from colmap_inertial.cli import main
from scripts.studies import faults as study_faults
from scripts.studies.faults import Taken, commands, faults_of, one, start, watch
from tests.helpers import batch_captures, exposure_scenes

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="limits as Linux has them"),
]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Commands, what an undisturbed run of each takes, and what it makes."""
    root, found = tmp_path_factory.mktemp("faults"), {}
    with pytest.MonkeyPatch.context() as patch:  # inputs of the commands that are not tried here
        patch.setattr(batch_captures, "tiny_capture", lambda *_, **__: None)
        patch.setattr(exposure_scenes, "write_pair_capture", lambda *_: None)
        known = commands(root)
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


#: As many files or as much memory as any command needs to begin with, of which so much is in use already that what is
#: left runs out on the way: the refusal at the door does not see it.
HELD = """
import mmap, os, resource, sys
from colmap_inertial.cli import main
from colmap_inertial.cli import process as limits
from colmap_inertial.core.threads import usable_processors

kind, left = sys.argv[1], int(sys.argv[2])
if kind == "files":
    resource.setrlimit(resource.RLIMIT_NOFILE, (limits.LEAST_FILES, limits.LEAST_FILES))
    used = len(os.listdir("/proc/self/fd")) - 1
    held = [os.open(os.devnull, os.O_RDONLY) for _ in range(limits.LEAST_FILES - used - left)]
else:
    least = limits.LEAST_BYTES + limits.THREAD_BYTES * usable_processors()
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * mmap.PAGESIZE
    held = mmap.mmap(-1, least - used - (left << 20), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, prot=mmap.PROT_READ)
    resource.setrlimit(resource.RLIMIT_AS, (least, least))
main(sys.argv[3:])
"""


@pytest.mark.parametrize(
    ("name", "kind", "lefts", "said"),
    [
        ("apply", "files", (4, 2), "[Tt]oo many|unable to open"),
        ("fuse-apertures", "files", (2, 1), "[Tt]oo many"),
        ("fuse-apertures", "memory", (600, 500), "out of memory"),
    ],
)
def test_what_runs_out_on_the_way_is_a_sentence_and_no_half_result(whole, tmp_path, name, kind, lefts, said):
    command, _, expected = whole[name]
    out, failed = tmp_path / "out", 0
    line = [part.replace("{out}", str(out)) for part in command.line]
    for left in lefts:
        held = [sys.executable, "-c", HELD, kind, str(left), *line]
        done = subprocess.run(held, capture_output=True, text=True)
        if done.returncode == 0:  # it was enough
            assert command.made(out) == expected
            shutil.rmtree(out)
            continue
        failed += 1
        last = done.stderr.strip().splitlines()[-1]
        assert done.returncode == 2 and re.match(f"error: .*({said})", last), done.stderr
        assert faults_of(done.stderr, done.returncode, killed=False) == []
        assert not command.done(out)
        assert [path.name for path in tmp_path.iterdir() if path != out] == []
        if kind == "memory":
            break  # with less, libraries cannot be loaded, and some say so in words of their own
    assert failed
    with pytest.raises(SystemExit, match=r"^0$"):
        main(line)
    assert command.made(out) == expected


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
