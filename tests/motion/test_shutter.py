"""The readout of a rolling shutter, from what pictures and the gyroscope tell; from pictures: test_flow_pictures.py."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_exp, quat_multiply
from colmap_inertial.motion.shutter import estimate_readout
from scripts.studies.readout import Film


@pytest.mark.parametrize(
    ("motion", "readout_s", "direction"),
    [("orbit", 0.02, "down"), ("roam", 0.033, "up"), ("roam", 0.0, "down"), ("pure_rotation", 0.01, "left")],
)
def test_the_readout_is_found_and_as_sure_as_it_says(motion, readout_s, direction):
    found = Film(motion=motion, readout_s=readout_s, seed=1, direction=direction).run()
    assert found.direction == direction and found.sigma_s < 1e-3
    assert abs(found.readout_s - readout_s) < 3 * found.sigma_s


@pytest.mark.parametrize("frames_hz", [8.0, 16.0])
def test_axes_off_by_tens_of_degrees_do_not_shorten_it(frames_hz):
    """Where a camera moves as much as it turns, rotations of pairs leave the axes so far off."""
    rotation, motion = Film(motion="roam", readout_s=0.028, seed=3, seconds=10.0, frames_hz=frames_hz).seen()
    turned = quat_multiply(quat_exp(np.radians([-15.0, 4.0, 8.0])), motion.cam_from_imu_xyzw)
    found = estimate_readout(rotation, replace(motion, cam_from_imu_xyzw=turned))
    assert found.sigma_s < 2e-3
    assert abs(found.readout_s - 0.028) < 3 * found.sigma_s
    assert found.readout_s == pytest.approx(estimate_readout(rotation, motion).readout_s, abs=1e-4)


def test_an_unknown_lens_makes_it_less_sure():
    known, unknown = (
        Film(motion="roam", readout_s=0.025, seed=1, seconds=10.0, frames_hz=8.0, distortion=bent).run()
        for bent in (0.0, -0.1)
    )
    assert unknown.sigma_s > known.sigma_s
    assert abs(unknown.readout_s - 0.025) < 3 * unknown.sigma_s


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
