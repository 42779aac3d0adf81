"""Tests that loop over cases run all of them and name what failed."""

import os
import re

import pytest

from tests.helpers.cases import loop_over


def test_every_case_runs_and_those_that_fail_are_named(tmp_path, monkeypatch):
    seen = []

    @loop_over("divisor, word", [(1, "first"), (0, "second"), (2, "third"), (5, "fourth")])
    def divide(divisor, word, tmp_path, monkeypatch):
        assert not list(tmp_path.iterdir()) and "CASE" not in os.environ
        (tmp_path / "file").touch()
        monkeypatch.setenv("CASE", word)
        seen.append(word)
        if divisor == 5:
            with pytest.raises(KeyError):
                pass
        assert 1 / divisor >= 1

    with pytest.raises(BaseExceptionGroup, match="3 of 4 cases failed") as group:
        divide(tmp_path=tmp_path, monkeypatch=monkeypatch)
    assert seen == ["first", "second", "third", "fourth"]
    failed = [(error.__notes__, type(error)) for error in group.value.exceptions]
    assert failed == [
        (["case 0, second"], ZeroDivisionError),
        (["case 2, third"], AssertionError),
        (["case 5, fourth"], pytest.fail.Exception),
    ]


@loop_over("letter", "ab", ids=str.upper)
@loop_over("number", [1, 2])
def test_loops_nest(letter, number, tmp_path):
    assert re.fullmatch(r"[ab][12]", f"{letter}{number}") and tmp_path.is_dir()
