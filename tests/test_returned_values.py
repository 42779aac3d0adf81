"""What functions return is compared with what they returned before: what is noticed, and what is not."""

import enum
from pathlib import Path

import numpy as np
import pytest
from conftest import RETURNED
from returned_values import Recorder, differences, summarise
from scipy.spatial.transform import Rotation

from colmap_inertial.core.geometry import matrix_from_quat, quat_exp
from colmap_inertial.io.files import write_json

TURN = np.array([0.3, -0.2, 0.1])
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
    for test in RETURNED:
        file, name = test.partition("[")[0].split("::")
        assert f"def {name}(" in (Path(__file__).parents[1] / file).read_text(), test
    assert len(RETURNED) > 100
