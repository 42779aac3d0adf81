"""The scene of the viewer."""

from types import SimpleNamespace

import numpy as np

from colmap_inertial.model.own_place import OwnPlace
from colmap_inertial.tools.view import scene as view_scene


def test_a_gap_of_the_path_is_a_step_of_more_than_ten_usual_ones():
    place = np.array([0.0, 1.0, 2.0, 11.5, 12.5, 23.0, 24.0, 25.0])
    cameras = SimpleNamespace(cam_in_world=np.outer(place, [1.0, 0.0, 0.0]))
    pieces, stretch = view_scene._path(SimpleNamespace(trajectory=None), cameras, OwnPlace(pivot=None))
    assert stretch is None
    assert [piece[0][0] for piece in pieces] == [0.0, 1.0, 2.0, 11.5, 23.0, 24.0]
