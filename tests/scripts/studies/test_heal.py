"""Output folders that lost something, or got a link to elsewhere, by random draws of ``scripts/studies/heal.py``."""

import pytest

from scripts.studies import heal as study_heal
from tests.helpers.batch_captures import tiny_capture


@pytest.mark.slow
def test_a_damaged_folder_heals_or_says_what_to_do(capsys, monkeypatch):
    # no board is looked for; a model of ten frames is refined, one of nine is not
    monkeypatch.setattr(study_heal, "FRAMES", 10)
    monkeypatch.setattr(study_heal, "tiny_capture", lambda folder, *, frames, half: tiny_capture(folder, frames=frames))
    arguments = ["--trials", "13", "--seed", "7", "--commands", "reconstruct", "project", "deblur", "export"]
    assert study_heal.main(arguments) == 0, capsys.readouterr().out
