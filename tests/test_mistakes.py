"""Mistakes that people make are named before the work, with advice that helps (scripts/study_mistakes.py)."""

import dataclasses
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from study_mistakes import MISTAKES, try_mistake

#: Of the study, what takes a few seconds together.
QUICK = (
    "raw counts of the gyroscope",
    "gyroscope with a wrong factor",
    "frame times in ms, called s",
    "gyroscope's x and y exchanged",
    "clocks 565 s apart, called shared",
)


@pytest.mark.parametrize("name", QUICK)
def test_a_mistake_is_named_before_features_are_extracted(name, tmp_path):
    mistake = next(mistake for mistake in MISTAKES if mistake.name == name)
    found = try_mistake(dataclasses.replace(mistake, mend=None), tmp_path, seed=0)
    assert found.caught, found.message


def test_a_mistake_is_mended_as_the_message_advises(tmp_path):
    mistake = next(mistake for mistake in MISTAKES if mistake.name == "frame times in ms, called s")
    assert try_mistake(mistake, tmp_path, seed=0).mended


def test_every_mistake_has_a_name_of_its_own():
    assert len({mistake.name for mistake in MISTAKES}) == len(MISTAKES)
