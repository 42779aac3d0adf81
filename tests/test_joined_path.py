"""Covariances of paths that are joined across gaps, against simulated walks."""

import sys
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.options import JoinOptions

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
import study_join


@pytest.mark.parametrize(("parts", "seeds"), [(2, range(1, 4)), (3, range(21, 23))])
def test_errors_of_joined_paths_are_as_large_as_their_covariances_say(parts, seeds):
    limits = JoinOptions(sigma_m=0.5)
    walks = [study_join.studied(parts, 2.0, seed, "", limits)[0] for seed in seeds]
    for name, most in (("position", 2.0), ("velocity", 1.5), ("rotation", 2.0)):
        assert 0.4 < np.mean([walk[f"nees_{name}"] for walk in walks]) < most, name
