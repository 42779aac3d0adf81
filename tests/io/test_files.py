"""Atomic files and JSON."""

import importlib
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, OutputError, OutputExistsError, describe_environment_fault
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import locked, read_json, reading, write_json, write_text
from tests.helpers.cases import loop_over


@dataclass(frozen=True)
class Point:
    xy: tuple[float, float]
    path: Path


def test_values_arrive_as_plain_json(tmp_path: Path) -> None:
    value = {
        "matrix": np.array([[1.5, 2.0], [3.0, 4.0]]),
        "count": np.int64(7),
        "flag": np.bool_(True),
        "float": np.float32(0.5),
        "point": Point((1.0, 2.0), Path("a/b")),
        "none": None,
        "text": "µm",
    }
    write_json(tmp_path / "a.json", value)
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == {
        "matrix": [[1.5, 2.0], [3.0, 4.0]],
        "count": 7,
        "flag": True,
        "float": 0.5,
        "point": {"xy": [1.0, 2.0], "path": "a/b"},
        "none": None,
        "text": "µm",
    }
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_numbers_survive_to_the_last_bit(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=100) * 10.0 ** np.arange(-50, 50)
    write_json(tmp_path / "a.json", {"v": values})
    np.testing.assert_array_equal(read_json(tmp_path / "a.json")["v"], values)


def test_a_number_that_json_has_not_is_named_and_the_old_file_stays(
    subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory
) -> None:
    for bad in (float("nan"), np.array([1.0, np.inf]), np.float64("nan")):
        with subtests.test(bad=bad):
            tmp_path = tmp_path_factory.mktemp("given")
            write_json(tmp_path / "a.json", {"v": 1})
            with pytest.raises(ValueError, match=r"\$\.deep\[1\]"):
                write_json(tmp_path / "a.json", {"deep": [0, bad]})
            assert read_json(tmp_path / "a.json") == {"v": 1}


def test_a_value_of_another_type_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\$\.a: set"):
        write_json(tmp_path / "a.json", {"a": {1}})
    with pytest.raises(ValueError, match="keys"):
        write_json(tmp_path / "a.json", {1: 2})


def test_a_failed_write_leaves_no_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_text(tmp_path / "a.txt", "old")

    def fail(source: object, target: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OutputError, match="disk full"):
        write_text(tmp_path / "a.txt", "new")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]


def test_a_file_is_on_the_disk_before_it_takes_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done, rename = [], os.replace
    monkeypatch.setattr(os, "fsync", lambda _: done.append("flushed"))
    monkeypatch.setattr(os, "replace", lambda *names: (done.append("named"), rename(*names)))
    write_text(tmp_path / "a.txt", "1")
    assert done == ["flushed", "named"]


@loop_over(
    ("text", "said"),
    [('{"a": 1,\n"b" 2}', "line 2"), ("[1]", "object"), ('{"a": NaN}', "NaN"), ("", "line 1"), ("[" * 100000, "JSON")],
)
def test_what_is_no_json_object_is_a_format_error(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(FormatError, match=said):
        read_json(tmp_path / "a.json")


@loop_over(
    "error, said",
    [
        (
            ImportError("libX11.so.6: cannot open shared object file", path="/a/site-packages/scipy/linalg/_f.so"),
            "scipy cannot be loaded (libX11.so.6: cannot open shared object file); on Debian: apt install libx11-6",
        ),
        (
            ImportError("undefined symbol: x", path="/a/site-packages/numpy/_core/_m.so"),
            "numpy cannot be loaded (undefined symbol: x); pip install --force-reinstall numpy",
        ),
        (
            ImportError("libm.so.9: cannot open it", path="/a/colmap_inertial/_kernels/_path.so"),
            "libm.so.9: cannot open it: install that package, or colmap-inertial again with its dependencies",
        ),
        (
            ModuleNotFoundError("No module named 'yaml'", name="yaml"),
            "No module named 'yaml': install that package, or colmap-inertial again with its dependencies",
        ),
        (ModuleNotFoundError("No module named 'colmap_inertial.x'", name="colmap_inertial.x"), None),
        (ImportError("cannot import name 'x' from 'numpy'", name="numpy", path="/a/numpy/__init__.py"), None),
        (ValueError("no"), None),
    ],
)
def test_what_cannot_be_loaded_is_one_sentence(error: Exception, said: str | None) -> None:
    outer = RuntimeError("wrapped")
    outer.__cause__ = error
    found = describe_environment_fault(outer)
    assert (None if found is None else found.with_advice) == said


def test_a_package_that_is_missing_is_not_a_damaged_file(tmp_path: Path) -> None:
    with pytest.raises(ImportError, match="no_such"), reading(tmp_path):
        importlib.import_module("no_such_package")
    with pytest.raises(FormatError, match=r"is damaged \(KeyError: 'no'\)"), reading(tmp_path):
        {}["no"]


def test_a_missing_file_is_a_format_error(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_json(tmp_path / "a.json")
    with pytest.raises(FormatError, match="cannot be read"):
        read_json(tmp_path)


HOLD = """
import sys, time
from pathlib import Path
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import locked
with locked(Path(sys.argv[1]), Fact.stated("busy")):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_lock_is_held_by_one_and_let_go_of_when_its_holder_is_killed(tmp_path):
    lock = tmp_path / "lock"
    with locked(lock, Fact.stated("mine")):
        with pytest.raises(OutputExistsError, match=r"^still mine$"), locked(lock, Fact.stated("still mine")):
            pass
        with pytest.raises(OutputExistsError, match=r"^waited$"), locked(lock, Fact.stated("waited"), wait_s=0.1):
            pass
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(lock)], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    with holder.stdout:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(OutputExistsError, match="of a process"), locked(lock, Fact.stated("of a process")):
            pass
        holder.kill()
        holder.wait()
    with locked(lock, Fact.stated("free")):
        pass
