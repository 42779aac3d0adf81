"""What functions return is compared with what they returned before: what is noticed, and what is not."""

import enum
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import returned_values
from conftest import RETURNED
from returned_values import Recorder, differences, summarise, versions
from scipy.spatial.transform import Rotation

from colmap_inertial.core.geometry import matrix_from_quat, quat_exp
from colmap_inertial.io.files import write_json

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
import record_values
from record_values import agreed, read, renewed

TWICE = "test_what_runs_disagree_in_is_not_kept"

TURN = np.array([0.3, -0.2, 0.1])
#: A hundred thousand rows are compared by some.
MANY = np.random.default_rng(1).normal(size=(100_000, 3))
VALUES = np.random.default_rng(0).normal(size=(40, 3, 3))


class Colour(enum.Enum):
    RED = "red"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        pytest.param(VALUES, -VALUES, id="sign"),
        pytest.param(VALUES, VALUES.mT, id="transpose"),
        pytest.param(VALUES, VALUES[::-1], id="order"),
        pytest.param(VALUES, VALUES * 1.003, id="factor"),
        pytest.param(VALUES, VALUES[:-1], id="one fewer"),
        pytest.param(VALUES, np.where(VALUES > 2, np.nan, VALUES), id="not a number"),
        pytest.param(VALUES > 0, VALUES > 1, id="mask"),
        pytest.param(VALUES[:, 0], VALUES[:, 0] + np.eye(3)[0] * 0.02, id="bias"),
        pytest.param(1j * VALUES, VALUES, id="phase"),
        pytest.param({"a": [1.0, 2.0]}, {"a": [1.0, 2.01]}, id="in a table"),
        pytest.param({"a": 1.0}, {"b": 1.0}, id="key"),
        pytest.param(["x", 1], ["y", 1], id="text"),
        pytest.param("it lasted 3.5 s", "it lasted 3.6 s", id="number in a text"),
        pytest.param(b"abc", b"abd", id="bytes"),
        pytest.param(True, False, id="truth"),
        pytest.param(None, 0, id="nothing"),
        pytest.param(Rotation.from_rotvec(TURN), Rotation.from_rotvec(-TURN), id="rotation"),
        pytest.param(Colour.RED, "red", id="kind"),
        pytest.param((), (1,), id="length"),
        pytest.param({"a", "b"}, {"a", "c"}, id="set"),
        pytest.param(MANY, MANY * [1, 1, -7], id="one column of many"),
    ],
)
def test_another_value_is_noticed(before, after):
    kept = {"f": summarise([before])}
    assert differences({"f": summarise([before])}, kept) == []
    assert differences({"f": summarise([after])}, kept) != []


@pytest.mark.parametrize(
    ("before", "after"),
    [
        pytest.param(VALUES, VALUES * (1 + 1e-5), id="last digits"),
        pytest.param(Path("/tmp/a/b.jpg"), Path("/home/x/b.jpg"), id="folder"),
        pytest.param("cannot read /tmp/a/b.jpg", "cannot read /home/user/b.jpg", id="folder in a text"),
    ],
)
def test_what_depends_on_the_machine_is_not(before, after):
    assert differences({"f": summarise([after])}, {"f": summarise([before])}) == []


def test_results_of_the_package_are_noted_and_nothing_else(tmp_path):
    with Recorder() as recorder:
        for _ in range(9):
            matrix = matrix_from_quat(quat_exp(TURN))
            np.linalg.inv(matrix)
        write_json(tmp_path / "x.json", {"a": 5})
    seen = recorder.summaries()
    assert all(":" in name and name.partition(":")[0] in ("core/geometry", "io/files") for name in seen)
    # of the first calls only
    assert seen["core/geometry:matrix_from_quat"] == summarise([matrix] * 4)
    assert differences(seen, {"core/geometry:quat_exp": summarise([quat_exp(-TURN)] * 4)}) != []
    # a function that returns nothing has arguments
    assert seen["io/files:write_json"][".value.a"][2] == 5
    matrix_from_quat(quat_exp(TURN))
    assert recorder.summaries() == seen


def test_a_function_that_is_called_no_more_is_noticed():
    (line,) = differences({}, {"core/geometry:quat_exp": summarise([1.0])})
    assert line.startswith("core/geometry:quat_exp")


def test_tests_with_kept_values_exist():
    assert [test for test in RETURNED if not record_values.exists(test)] == []
    assert len(RETURNED) > 100


TESTS = """
import pytest
from colmap_inertial.core.geometry import quat_exp

def test_turn():
    quat_exp([0.3, -0.2, 0.1])

@pytest.mark.parametrize("size", [1, 2])
def test_others(size):
    quat_exp([0.3 * size, -0.2, 0.1])

def test_error():
    quat_exp([0.0, -0.2, 0.1])
    assert False, "its own"

def test_skipped():
    pytest.skip("not here")

def test_nothing_is_noted_between_tests():
    import sys
    assert sys.getprofile() is None
"""


def test_a_test_fails_where_a_function_returns_something_else(tmp_path):
    tests = Path(__file__).parent
    for name in ("conftest.py", "returned_values.py", "quick.txt", "slow.txt"):
        shutil.copy(tests / name, tmp_path)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "test_some.py").write_text(TESTS)
    here = summarise([quat_exp([0.3, -0.2, 0.1])])
    kept = {f"test_some.py::{name}": {"core/geometry:quat_exp": here} for name in ("test_turn", "test_others[1]")}
    kept |= {f"test_some.py::{name}": {"core/geometry:quat_exp": here} for name in ("test_others[2]", "test_error")}
    kept["test_some.py::test_skipped"] = {"core/geometry:quat_exp": here}
    (tmp_path / "references").mkdir()
    file = tmp_path / "references" / "returned_values.json"
    file.write_text(json.dumps({"versions": versions() | {"numpy": "1.0"}, "tests": kept}))
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-rs"]
    env = os.environ | {"PYTHONPATH": str(tests.parent)}
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert "2 failed, 3 passed, 1 skipped" in done.stdout, done.stdout
    assert "numpy is" in done.stdout and "was 1.0" in done.stdout
    assert "core/geometry:quat_exp" in done.stdout and "AssertionError: its own" in done.stdout
    # what is written is what was kept
    seen = tmp_path / "seen"
    subprocess.run([*command, f"--write-returned={seen}"], cwd=tmp_path, env=env, capture_output=True)
    written = read(seen)
    assert sorted(written) == [f"test_some.py::test_{name}" for name in ("others[1]", "others[2]", "turn")]
    assert differences(written["test_some.py::test_turn"][1], kept["test_some.py::test_turn"]) == []


def test_an_error_in_what_is_noted_is_no_error_of_the_package(monkeypatch):
    monkeypatch.setattr(returned_values, "_leaves", lambda *_: 1 / 0)
    with Recorder() as recorder:
        assert quat_exp(TURN).shape == (4,)
    with pytest.raises(ZeroDivisionError):
        recorder.summaries()


def _seen(**functions):
    return {name: summarise([value]) for name, value in functions.items()}


def test_what_runs_disagree_in_is_not_kept():
    one = {"t": (0.1, _seen(f=1.0, g=2.0)), "alone": (0.1, _seen(f=1.0))}
    other = {"t": (0.2, _seen(f=1.0, g=2.001))}
    assert agreed([one, other]) == {"t": (0.1, _seen(f=1.0))}


def test_values_are_renewed_for_the_same_tests_functions_and_places():
    test, skipped = (f"tests/test_returned_values.py::{name}" for name in ("test_another_value_is_noticed[x]", TWICE))
    before = {
        test: _seen(f={"a": 1.0}, g=1.0, gone=1.0),
        skipped: _seen(f=1.0),
        "tests/test_returned_values.py::test_that_was_removed": _seen(f=1.0),
    }
    now = {test: (0.1, _seen(f={"a": 2.0, "b": 3.0}, g=[1.0, 2.0], new=1.0))}
    after = renewed(before, [now, now])
    assert after == {test: _seen(f={"a": 2.0}, g=[1.0, 2.0]), skipped: _seen(f=1.0)}


def test_of_each_line_a_quick_test_is_chosen_or_two(monkeypatch, tmp_path):
    (tmp_path / "m.py").write_text("class A:\n    def f(self):\n        a = 1\n        return a\n")
    monkeypatch.setattr(record_values, "PACKAGE", tmp_path)
    assert list(record_values.functions_of("m.py")) == [("m:A.f", range(3, 5))]
    of = {"m:A.f": summarise([1.0])}
    seen = {"slow": (9.0, of), "quick": (0.1, of), "second": (0.2, of), "third": (0.3, of), "other": (0.7, of)}
    lines = {"m.py": {"3": ["slow", "quick", "second", "third"], "4": ["slow", "other"]}}
    assert sorted(record_values.choose(seen, lines)) == ["other", "quick", "second"]
    lines["m.py"]["4"].append("unseen")
    del seen["other"]
    assert sorted(record_values.choose(seen, lines)) == ["quick", "second"]
    assert sorted(record_values.choose({"slow": seen["slow"]}, lines)) == ["slow"]


def test_nothing_is_kept_of_what_waits_for_processes(monkeypatch, tmp_path):
    monkeypatch.setattr(record_values, "PACKAGE", tmp_path)
    lines = {}
    tests = ["tests/test_batch.py::test_a", "tests/test_batch_stages.py::test_a"]
    for module in ("m.py", "tools/batch/m.py"):
        (tmp_path / module).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / module).write_text("def f():\n    return 1\n")
        lines[module] = {"2": tests}
    returned = {"m:f": summarise([1]), "tools/batch/m:f": summarise([1])}
    kept = record_values.choose(dict.fromkeys(tests, (0.1, returned)), lines)
    assert kept == {tests[1]: {"m:f": summarise([1])}}
