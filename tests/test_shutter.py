"""The readout of a rolling shutter, from what pictures and the gyroscope tell; from pictures: test_flow.py."""

import sys
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.motion.shutter import estimate_readout

sys.path.append(str(Path(__file__).parents[1] / "scripts"))

from study_readout import Film


@pytest.mark.parametrize(
    ("motion", "readout_s", "direction"),
    [("orbit", 0.02, "down"), ("roam", 0.033, "up"), ("roam", 0.0, "down"), ("pure_rotation", 0.01, "left")],
)
def test_the_readout_is_found_and_as_sure_as_it_says(motion, readout_s, direction):
    found = Film(motion=motion, readout_s=readout_s, seed=1, direction=direction).run()
    assert found.direction == direction and found.sigma_s < 1e-3
    assert abs(found.readout_s - readout_s) < 3 * found.sigma_s


def test_a_camera_that_hardly_turns_tells_nothing():
    with pytest.raises(NotObservableError, match="to and fro") as told:
        Film(motion="roam", readout_s=0.02, seed=1, vigour=0.02).run()
    assert told.value.quantity == "readout"


def test_a_few_frames_tell_nothing():
    with pytest.raises(NotObservableError, match="two seconds or more"):
        Film(motion="roam", readout_s=0.02, seed=1, seconds=1.2).run()


def test_what_is_no_shutter_of_lines_is_refused():
    rotation, motion = Film(motion="pure_rotation", readout_s=0.02, seed=2).seen()
    # half of the shutter along, half across
    for tracks in rotation.tracks:
        turned = np.stack([tracks.place.sum(axis=2), tracks.place[..., 0] - tracks.place[..., 1]], axis=2) / 2
        tracks.place[...] = turned
    with pytest.raises(NotObservableError, match="neither along nor across"):
        estimate_readout(rotation, motion)
