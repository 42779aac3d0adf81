"""Information of a pose."""

import pytest

from colmap_inertial.model.pose_covariances import _pose_information
from colmap_inertial.tools.simulate.motion import MotionOptions
from colmap_inertial.tools.simulate.tracks import TrackOptions, simulate_tracks


def test_a_perfect_model_s_observations_err_by_a_twentieth_of_a_pixel_at_least():
    tracks = simulate_tracks(TrackOptions(motion=MotionOptions(duration_s=3.0), noise_px=0.0), seed=1)
    model = tracks.reconstruction()
    image = next(iter(model.images.values()))
    place = {number: point.xyz for number, point in model.points3D.items()}
    variance_px2 = _pose_information(image.camera, image, image.cam_from_world(), place)[1]
    assert variance_px2 == pytest.approx(0.05**2)
