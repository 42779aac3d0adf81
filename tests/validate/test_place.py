"""The place of a target."""

from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from colmap_inertial.validate.place import _choose_pairs


def test_sightings_are_paired_where_their_lines_of_sight_meet():
    views = [SimpleNamespace(cam_from_world=np.eye(3))] * 3
    rays = [Rotation.from_euler("y", deg, degrees=True).apply([0.0, 0.0, 1.0]) for deg in (0.0, 20.0, 40.0)]
    sightings = [SimpleNamespace(view=i, ray=ray[None]) for i, ray in enumerate(rays)]
    assert _choose_pairs(sightings, views, 0) == [(0, 1), (0, 2), (1, 2)]
    assert _choose_pairs([sightings[0], sightings[0]], views, 0) == []  # of one view
