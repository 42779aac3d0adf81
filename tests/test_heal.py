"""Output folders that lost something, or got a link to elsewhere, by random draws of ``scripts/study_heal.py``."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

import study_heal


@pytest.mark.slow
@pytest.mark.parametrize(("name", "trials"), [("reconstruct", 6), ("project", 4), ("deblur", 4), ("export", 4)])
def test_a_damaged_folder_heals_or_says_what_to_do(name, trials, capsys):
    assert study_heal.main(["--trials", str(trials), "--seed", "7", "--commands", name]) == 0, capsys.readouterr().out
