"""Damage that used to end in a traceback is a sentence that names the file."""

import json
import subprocess
import sys

import cv2
import numpy as np
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.io.ply import transform_ply
from colmap_inertial.model.database import transform_database
from colmap_inertial.model.nerf import transform_transforms
from colmap_inertial.model.similarities import plain_factor
from colmap_inertial.report import write_report
from colmap_inertial.run.steps.config import read_config
from colmap_inertial.tools.batch import read_manifest
from tests.helpers import model_project
from tests.helpers.cases import loop_over
from tests.helpers.report_runs import write_run


@loop_over("count", ["1e999", "inf", "-inf", "nan", "1e300", "-1", "300", "1_0"])
def test_a_list_s_length_out_of_range(tmp_path, count):
    path = tmp_path / "a.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n{count} 0 0 0\n"
    )
    with pytest.raises(FormatError, match=r"a\.ply, line 11: (not a value|too few values)"):
        transform_ply(path, tmp_path / "b.ply", plain_factor(2))


def test_a_nested_config(subtests, tmp_path_factory, capsys):
    for text in ("a = " + 5000 * "[" + 5000 * "]", "[" + ".".join(["a"] * 20000) + "]", "a = \0"):
        with subtests.test(text=text):
            tmp_path = tmp_path_factory.mktemp("given")
            capsys.readouterr()
            path = tmp_path / "config.toml"
            path.write_text(text)
            with pytest.raises(FormatError, match=r"config\.toml"):
                read_config(path, ReconstructOptions)
            with pytest.raises(SystemExit) as stopped:
                main(["reconstruct", "a", "b", "--config", str(path)])
            assert stopped.value.code == 2
            assert capsys.readouterr().err.startswith(f"error: {path}")


def test_a_nul_in_the_path_of_a_config():
    with pytest.raises(FormatError, match="cannot be read"):
        read_config("a\0b.toml", ReconstructOptions)


def test_a_nul_in_a_manifest(subtests, tmp_path_factory):
    for line in (
        'path = "a\\u0000"',
        'config = "a\\u0000"',
        'options.calibration = "a\\u0000"',
        'project.imu = "a\\u0000"',
    ):
        with subtests.test(line=line):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "batch.toml"
            path.write_text("[[capture]]\n" + ("" if line.startswith("path") else 'path = "a"\n') + line)
            with pytest.raises(FormatError, match=r"batch\.toml.*NUL character"):
                read_manifest(path)


def test_text_of_a_database_that_is_no_utf_8(subtests, tmp_path_factory):
    for old, new in ((b"CREATE TABLE", b"CREATE \xffABLE"), (b"000.png", b"\xff\xfe0.png"), (b"priors", b"prior\xff")):
        with subtests.test(old=old, new=new):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "database.db"
            model_project.write_database(path, model_project.sparse_model(np.random.default_rng(4)))
            path.write_bytes(path.read_bytes().replace(old, new))
            with pytest.raises(FormatError, match=r"database\.db: SQLite cannot read it"):
                transform_database(path, tmp_path / "copy.db", [], {})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "out"
    write_run(out)
    return out


DAMAGE = [
    ("result.json", {}),
    ("result.json", {"models": 3, "frames": [], "seconds": {}, "versions": {}}),
    ("result.json", {"models": [{}], "frames": [], "seconds": {}, "versions": {}}),
    ("diagnosis.json", {"checked": 1}),
    ("report_data/model_0.json", {"scene": {}, "signals": {}}),
    ("report_data/model_0.json", {"scene": 3}),
    ("report_data/recording.json", {"imu": None, "frames": {"names": 1}}),
]


@loop_over(("name", "content"), DAMAGE)
def test_a_report_of_damaged_files(run, name, content):
    whole = (run / name).read_bytes()
    try:
        (run / name).write_text(json.dumps(content))
        with pytest.raises(FormatError, match="changed since it was written"):
            write_report(run)
    finally:
        (run / name).write_bytes(whole)


def test_a_reader_that_has_enough():
    command = f"{sys.executable} -m colmap_inertial reconstruct --help | head -n 1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.returncode in (0, 141)  # 0 where the pipe took it all
    code = (
        "import colmap_inertial.cli as cli\n"
        "def forever(args):\n    while True: print('x' * 1000)\n"
        "cli._main = forever\ncli.main([])"
    )
    done = subprocess.run(
        ["bash", "-c", f'{sys.executable} -c "$1" | head -n 1; exit ${{PIPESTATUS[0]}}', "_", code],
        capture_output=True,
        text=True,
    )
    assert (done.stderr, done.returncode) == ("", 141)


LIMITED = """
import resource, sys
from pathlib import Path
from colmap_inertial.colmap.features.extraction import extract_features
from colmap_inertial.core.errors import OutputError
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.colmap.context import RunContext
folder = Path(sys.argv[1])
sys.dont_write_bytecode = True  # it would be cut off, for good
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
context = RunContext(scratch=folder, num_threads=1)
try:
    extract_features(folder, {"a.png": None}, folder / "x.db", MappingOptions(max_num_features=100), context=context)
except OutputError as error:
    sys.exit(str(error))
"""


def test_a_database_that_cannot_grow(subtests, tmp_path_factory):
    for limit in ("0", "4096", "40000", "90000"):
        with subtests.test(limit=limit):
            tmp_path = tmp_path_factory.mktemp("given")
            assert cv2.imwrite(
                str(tmp_path / "a.png"), np.random.default_rng(0).integers(0, 255, (64, 64), dtype=np.uint8)
            )
            done = subprocess.run([sys.executable, "-c", LIMITED, str(tmp_path), limit], capture_output=True, text=True)
            assert done.stderr.splitlines()[-1].startswith(f"{tmp_path / 'x.db'}: COLMAP cannot write")
            assert done.returncode == 1


def test_the_scale_of_a_transforms_file_that_is_no_number(subtests, tmp_path_factory):
    for scale in ('"a"', "{}", "0", "-1", "true"):
        with subtests.test(scale=scale):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "transforms.json"
            frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
            path.write_text(f'{{"frames": {json.dumps(frames)}, "scale": {scale}, "offset": [0, 0, 0]}}')
            with pytest.raises(FormatError, match="not a number"):
                transform_transforms(path, tmp_path / "out.json", plain_factor(2.0))
