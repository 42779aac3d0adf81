"""A small part of ``scripts/studies/diagnose.py``: a few faults in simulated recordings, and some of the clean ones."""

import numpy as np
import pytest

from colmap_inertial.diagnose import diagnose
from scripts.studies import diagnose as study

#: What the other tests of ``diagnose`` do not put in.
SEEDED = (
    "gyro in rad/s, called deg/s, pictures",
    "slow gyro in deg/s, called rad/s, camera",
    "gravity twice",
    "another frame rate",
    "accelerometer low-passed",
    "readings too seldom",
)


@pytest.fixture(scope="module")
def clean() -> list[study.Base]:
    return [study.simulated(1), study.simulated(3, "roam", "action_camera"), study.simulated(6, "walk", vigour=0.5)]


def test_the_study_has_its_faults_and_knows_those_here() -> None:
    names = [fault.name for fault in study.FAULTS]
    assert len(set(names)) == len(names) >= 30
    assert set(SEEDED) <= set(names)


@pytest.mark.parametrize("name", SEEDED)
def test_a_seeded_fault_is_named(clean: list[study.Base], name: str) -> None:
    fault = next(fault for fault in study.FAULTS if fault.name == name)
    found = diagnose(fault.make(clean[len(name) % 3], np.random.default_rng(0)))
    assert study.named(fault, found), study.codes(found)


def test_no_clean_recording_is_accused(clean: list[study.Base]) -> None:
    for base in clean:
        assert not diagnose(base.recorded()).findings, base.name
