"""A similarity like no other."""

import numpy as np

from colmap_inertial.core.geometry import quat_exp
from colmap_inertial.core.types import Similarity

SIMILARITY = Similarity(
    scale=0.3721,
    rotation_xyzw=quat_exp(np.array([0.4, -1.1, 0.3])),
    translation_m=np.array([5.0, -2.0, 0.5]),
    cov=np.zeros((7, 7)),
)
