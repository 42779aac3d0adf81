"""Mistakes that people make are named before the work, with advice that helps (scripts/studies/mistakes.py)."""

import shutil

import pytest

from scripts.studies import mistakes as study_mistakes
from scripts.studies.mistakes import MISTAKES, try_mistake

#: Of the study, what takes under a minute together.
QUICK = (
    "raw counts of the gyroscope",
    "frame times in ms, called s",
    "gyroscope turned against the accelerometer",
    "clocks 565 s apart, called shared",
    "raw counts in columns named *_raw",
    "target checkerboard:8x6:40",
    "folder of images misspelt",
    "--method joynt",
    "Python: world='zup'",
    "stamps of the gyroscope in ns",
)


@pytest.fixture(scope="module", autouse=True)
def _fewer_pictures(tmp_path_factory):
    """The first 25 pictures of the scene: to compare them is most of the work."""
    desk = shutil.copytree(study_mistakes.DESK, tmp_path_factory.mktemp("short") / "desk")
    lines = (desk / "frames.csv").read_text().splitlines()
    (desk / "frames.csv").write_text("\n".join(lines[:26]) + "\n")
    for line in lines[26:]:
        (desk / "frames" / line.partition(",")[0]).unlink()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_mistakes, "DESK", desk)
        yield


@pytest.mark.parametrize("name", QUICK)
def test_a_mistake_is_named_before_features_are_extracted_and_its_advice_helps(name, tmp_path):
    mistake = next(mistake for mistake in MISTAKES if mistake.name == name)
    found = try_mistake(mistake, tmp_path, seed=0)
    assert found.caught, found.message
    assert found.mended, found.then


def test_there_are_forty_mistakes_five_at_least_of_each_kind():
    kinds = [mistake.kind for mistake in MISTAKES]
    assert len(kinds) >= 40
    assert min(kinds.count(kind) for kind in kinds) >= 5


def test_every_mistake_has_a_name_of_its_own():
    assert len({mistake.name for mistake in MISTAKES}) == len(MISTAKES)
