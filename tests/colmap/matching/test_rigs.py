"""Poses of a rig."""

from types import SimpleNamespace

import numpy as np

from colmap_inertial.colmap.matching import rigs


def test_poses_of_a_rig_are_known_where_each_is_declared():
    declared, not_declared = (SimpleNamespace(cam_from_reference=pose) for pose in (np.eye(4), None))
    assert rigs.poses_are_known([declared, declared])
    assert not rigs.poses_are_known([declared, not_declared])
