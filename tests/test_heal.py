"""Output folders that lost something, or got a link to elsewhere, by random draws of ``scripts/study_heal.py``."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

import study_heal


@pytest.mark.slow
def test_a_damaged_folder_heals_or_says_what_to_do(capsys):
    arguments = ["--trials", "16", "--seed", "7", "--commands", "reconstruct", "project", "deblur", "export"]
    assert study_heal.main(arguments) == 0, capsys.readouterr().out
