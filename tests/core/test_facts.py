"""Facts: codes with values, their words, and their way through JSON."""

import ast
import math
import pickle
from dataclasses import dataclass
from pathlib import Path

import pytest

import colmap_inertial
from colmap_inertial import messages
from colmap_inertial.core import errors
from colmap_inertial.core.errors import (
    FormatError,
    MappingError,
    MissingExtraError,
    NotObservableError,
    TimingError,
    fact_of,
)
from colmap_inertial.core.facts import Fact, as_fact, with_sentences
from colmap_inertial.core.types import Action, Treatment
from colmap_inertial.io.files import read_json, read_record, write_record

PACKAGE = Path(colmap_inertial.__file__).parent
ERRORS = {name for name, one in vars(errors).items() if isinstance(one, type) and issubclass(one, errors.InertialError)}


@pytest.fixture(autouse=True)
def _test_message(monkeypatch):
    """A message of the tests' own, which is gone after them."""
    messages.all_messages()
    monkeypatch.setattr(messages, "_MESSAGES", dict(messages._MESSAGES))

    @messages.message(advice=lambda count, names: f"look at {names[0]}", example={"count": 2, "names": ("a", "b")})
    def tested_cameras(count: int, names: tuple[str, ...]) -> str:
        return f"{count} cameras are wrong: {', '.join(names)}"


def a_fact() -> Fact:
    return Fact("tested-cameras", count=2, names=["a.jpg", "b.jpg"])


def test_a_fact_is_said_by_its_message():
    fact = a_fact()
    assert str(fact) == "2 cameras are wrong: a.jpg, b.jpg"
    assert fact.with_advice == "2 cameras are wrong: a.jpg, b.jpg; look at a.jpg"
    assert fact.values == {"count": 2, "names": ("a.jpg", "b.jpg")}
    assert fact == Fact("tested-cameras", count=2, names=("a.jpg", "b.jpg"))
    assert fact != Fact("tested-cameras", count=3, names=("a.jpg", "b.jpg"))


def test_a_code_without_a_message_and_values_that_do_not_fit_fail_when_the_fact_is_made():
    with pytest.raises(LookupError, match="no message has the code nobody-wrote-this"):
        Fact("nobody-wrote-this")
    with pytest.raises(TypeError, match="tested-cameras: missing a required argument: 'names'"):
        Fact("tested-cameras", count=2)


def test_two_messages_cannot_have_one_code():
    with pytest.raises(ValueError, match="two messages have the code stated"):
        messages.state("stated", "something else")


def test_every_message_shows_its_example():
    for code, message in messages.all_messages().items():
        fact = Fact(code, **message.example)
        assert str(fact), code
        assert isinstance(fact.advice, str), code


def test_every_code_that_the_package_names_has_a_message_that_takes_its_values():
    known, wrong = messages.all_messages(), []
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Fact" and node.args:
                code = node.args[0]
                if not isinstance(code, ast.Constant):
                    continue
                place = f"{path.relative_to(PACKAGE)}:{node.lineno} {code.value}"
                values = {keyword.arg: None for keyword in node.keywords}
                if code.value not in known:
                    wrong.append(place)
                elif None not in values:
                    try:
                        known[code.value].signature.bind(**values)
                    except TypeError as error:
                        wrong.append(f"{place}: {error}")
    assert wrong == []


def test_no_error_of_the_package_is_raised_with_words():
    worded = []
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ERRORS:
                # FormatError's path and NotObservableError's quantity come before what is wrong
                of = 1 if node.func.id in ("FormatError", "NotObservableError", "MissingExtraError") else 0
                if len(node.args) > of and isinstance(node.args[of], ast.Constant | ast.JoinedStr):
                    worded.append(f"{path.relative_to(PACKAGE)}:{node.lineno}")
    assert worded == []


def test_words_of_a_user_s_format_are_an_error_s_fact():
    error = FormatError("imu.csv", "is not mine", line=2)
    assert str(error) == "imu.csv, line 2: is not mine"
    assert (error.code, error.fact) == ("stated", Fact.stated("is not mine"))


def test_every_message_is_said_somewhere():
    said = "".join(path.read_text() for path in PACKAGE.rglob("*.py") if path.parent.name != "messages")
    assert [code for code in messages.all_messages() if f'"{code}"' not in said and code != "tested-cameras"] == []


@dataclass(frozen=True, kw_only=True)
class Kept:
    reason: Fact
    notes: tuple[Fact, ...]
    treatments: tuple[Treatment, ...]


def test_records_keep_sentences_for_people_and_codes_for_programs(tmp_path):
    treatment = Treatment(stage="deblur", reason=a_fact(), action=Action.DEBLURRED, values={"blur_px": 3.0})
    kept = Kept(reason=a_fact(), notes=(a_fact(), Fact.stated("from outside")), treatments=(treatment,))
    write_record(tmp_path / "kept.json", kept)
    values = read_json(tmp_path / "kept.json")
    assert values["notes"] == ["2 cameras are wrong: a.jpg, b.jpg", "from outside"]
    assert values["notes_details"][0] == {"code": "tested-cameras", "values": {"count": 2, "names": ["a.jpg", "b.jpg"]}}
    assert values["treatments"][0]["action"] == "deblurred"
    assert values["treatments"][0]["reason"] == "2 cameras are wrong: a.jpg, b.jpg"
    assert read_record(tmp_path / "kept.json", Kept) == kept


def test_records_of_versions_without_codes_are_read(tmp_path):
    write_record(tmp_path / "kept.json", {"reason": "because", "notes": ["a", "b"], "treatments": []})
    assert read_record(tmp_path / "kept.json", Kept).notes == (Fact.stated("a"), Fact.stated("b"))


def test_numbers_that_json_lacks_are_named(tmp_path):
    fact = Fact("not-in-range", low=-math.inf, high=1.0, found="7")
    assert str(fact) == "must be from -inf to 1, found 7"
    write_record(tmp_path / "fact.json", {"fact": fact})
    assert read_json(tmp_path / "fact.json")["fact"]["values"] == {"low": "-inf", "high": 1.0, "found": "7"}


def test_fields_without_facts_stay():
    assert with_sentences({"count": 3, "names": ["a"], "notes": []}) == {"count": 3, "names": ["a"], "notes": []}


def test_errors_take_code_and_words_from_a_fact():
    error = FormatError("imu.csv", a_fact(), line=7)
    assert (error.code, error.reason) == ("tested-cameras", a_fact().with_advice)
    assert str(error) == f"imu.csv, line 7: {a_fact().with_advice}"
    assert error.fact == a_fact()
    refused = NotObservableError("scale", a_fact(), sigma=0.5)
    assert (refused.fact, refused.code) == (a_fact(), "tested-cameras")
    assert "standard deviation 50.0 %" in str(refused)


def test_errors_come_whole_from_another_process():
    errors = [
        MappingError(a_fact()),
        FormatError("imu.csv", a_fact(), line=7),
        NotObservableError("scale", a_fact(), sigma=0.5),
        MissingExtraError("mesh", a_fact()),
        TimingError(a_fact(), shown=str(a_fact())),
    ]
    for error in errors:
        again = pickle.loads(pickle.dumps(error))
        assert (type(again), str(again), vars(again)) == (type(error), str(error), vars(error))


def test_an_error_as_a_fact_says_what_the_error_says():
    for error in (
        MappingError(a_fact()),
        FormatError("imu.csv", a_fact(), line=7),
        FormatError("imu.csv", a_fact()),
        NotObservableError("scale", a_fact(), sigma=0.5),
        TimingError(a_fact(), shown=str(a_fact())),
    ):
        assert str(fact_of(error)) == str(error)


def test_a_stage_of_a_user_says_words_and_no_action_of_its_own():
    assert Treatment(stage="mine", reason="as requested").reason == as_fact("as requested")
    with pytest.raises(ValueError, match="brightened"):
        Treatment(stage="mine", reason="as requested", action="brightened")
