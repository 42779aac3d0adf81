"""Real recordings with a wrong clock, gain, convention or model: a seeded part of ``study_model_faults.py``."""

import importlib
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.fixture(scope="module")
def study():
    """The script as a module; it imports its neighbours as it does on the command line."""
    sys.path.insert(0, str(SCRIPTS))
    try:
        return importlib.import_module("study_model_faults")
    finally:
        sys.path.remove(str(SCRIPTS))


@pytest.fixture(scope="module")
def outcomes(study, shared_data):
    """What comes of a fault in clips of the recordings."""
    folder = shared_data / "real_imu"

    def of(fault, *, length_s, most, first=7000):
        clips = study.windows(folder, (length_s,), (study.NOISE_M,), most=most, first=first)
        altered = [study.Altered(window=w, fault=fault, size=size) for size in study.FAULTS[fault][0] for w in clips]
        return [study.run((folder, one)) for one in altered]

    return of


@pytest.mark.parametrize("fault", ["clock", "gain"])
def test_a_wrong_clock_or_gain_is_named_and_counted(study, outcomes, fault):
    found = study.summary(outcomes(fault, length_s=20.0, most=1))
    assert found["n"] == 12 == found["named"]
    assert found["trusted"] == 0
    assert found["inside"] >= found["given"] - 2


def test_arrays_in_another_convention_are_refused_by_name(study, outcomes):
    found = outcomes("wxyz", length_s=20.0, most=1)
    assert all(o.verdict == "refused" and "in the order w x y z" in o.said[0] for o in found)
