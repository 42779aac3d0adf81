"""A disk that fills up on the way: a sentence, an untouched capture, and a run that continues once there is room."""

import shutil
import subprocess
import sys
from collections import namedtuple

import pytest

from colmap_inertial.core.errors import OutputError
from colmap_inertial.run.commands.reconstruct import reconstruct
from tests.helpers.batch_captures import TINY, model_bytes, tiny_capture

LIMITED = """
import resource, sys
from colmap_inertial.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
main(["reconstruct", *sys.argv[2:]])
"""
#: Of fewer than eight there is no scale.
FRAMES = 9
Usage = namedtuple("Usage", "total used free")


def contents(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_images_that_cannot_be_written_are_an_error(tmp_path):
    capture = tiny_capture(tmp_path / "capture", frames=FRAMES)
    before = contents(capture)
    args = [sys.executable, "-c", LIMITED, "5000", str(capture), str(tmp_path / "out")]
    done = subprocess.run(args, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"error: {tmp_path / 'out'}: a file in it would exceed") and "(ulimit -f)" in last
    assert not list((tmp_path / "out").rglob("*.partial*"))
    assert contents(capture) == before


@pytest.mark.parametrize("step", ["features", "matches"])
def test_colmap_is_not_started_on_a_disk_that_is_nearly_full(tmp_path, monkeypatch, step):
    capture = tiny_capture(tmp_path / "capture", frames=FRAMES)
    room, at = shutil.disk_usage, []
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: Usage(1, 1, 0) if step in at else room(path))
        with pytest.raises(OutputError, match="nearly full: 0 MB are left"):
            reconstruct(capture, tmp_path / "out", TINY, progress=lambda stage, done, total: at.append(stage))
    assert not list((tmp_path / "out").rglob("*.partial*"))
    assert not (tmp_path / "out" / "result.json").exists()
    resumed = reconstruct(capture, tmp_path / "out", TINY)
    assert resumed.models
    if step == "features":
        reconstruct(capture, tmp_path / "whole", TINY)
        assert model_bytes(tmp_path / "out") == model_bytes(tmp_path / "whole")
