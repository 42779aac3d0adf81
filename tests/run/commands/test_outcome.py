"""What a step found, or its error, comes back from a record."""

from dataclasses import dataclass

import pytest

from colmap_inertial.core.errors import NotObservableError, TargetNotFoundError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import read_record, write_record
from colmap_inertial.run.commands.outcome import Outcome


@dataclass(frozen=True)
class Length:
    metres: float


def test_what_was_found_comes_back(tmp_path):
    write_record(tmp_path / "a.json", Outcome(found=Length(2.5)))
    assert read_record(tmp_path / "a.json", Outcome[Length]).result() == Length(2.5)


@pytest.mark.parametrize(
    "error",
    [
        NotObservableError("heading", Fact("pictures-stabilised", share=0.25)),
        TargetNotFoundError(Fact("pictures-stabilised", share=0.25)),
    ],
    ids=["not observable", "not found"],
)
def test_an_error_comes_back_as_it_was(error, tmp_path):
    write_record(tmp_path / "a.json", Outcome[Length].of_error(error))
    back = read_record(tmp_path / "a.json", Outcome[Length]).result()
    assert type(back) is type(error) and back.fact.code == error.fact.code
    assert back.fact.values == error.fact.values and back.exit_code == error.exit_code
    assert getattr(back, "quantity", None) == getattr(error, "quantity", None)
