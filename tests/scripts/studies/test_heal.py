"""Output folders that lost something, or got a link to elsewhere, by random draws of ``scripts/study_heal.py``."""

import sys
from pathlib import Path

import pytest

from tests.helpers.batch_captures import tiny_capture

sys.path.insert(0, str(Path(__file__).parents[3] / "scripts"))

import study_heal


@pytest.mark.slow
def test_a_damaged_folder_heals_or_says_what_to_do(capsys, monkeypatch):
    # no board is looked for; a model of ten frames is refined, one of nine is not
    monkeypatch.setattr(study_heal, "FRAMES", 10)
    monkeypatch.setattr(study_heal, "tiny_capture", lambda folder, *, frames, half: tiny_capture(folder, frames=frames))
    arguments = ["--trials", "13", "--seed", "7", "--commands", "reconstruct", "project", "deblur", "export"]
    assert study_heal.main(arguments) == 0, capsys.readouterr().out
