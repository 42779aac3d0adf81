"""Covariances of paths that are joined across gaps, against simulated walks."""

import numpy as np

from colmap_inertial.core.options import JoinOptions
from scripts.studies import join as study_join


def test_errors_of_joined_paths_are_as_large_as_their_covariances_say():
    limits = JoinOptions(sigma_m=0.5)
    walks = [study_join.studied(3, 2.0, seed, "", limits)[0] for seed in (21, 22)]
    for name, most in (("position", 2.0), ("velocity", 1.5), ("rotation", 2.0)):
        assert 0.4 < np.mean([walk[f"nees_{name}"] for walk in walks]) < most, name
