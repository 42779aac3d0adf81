"""Positions in a local frame."""

import numpy as np

from colmap_inertial.core.types import PositionFixes
from colmap_inertial.inertial.georeference import convert_to_enu


def test_positions_without_a_height_lie_at_the_median_of_the_others():
    fixes = PositionFixes(
        latitude_deg=np.array([65.0, 65.0, 65.0]),
        longitude_deg=np.array([25.0, 25.0, 25.001]),
        height_m=np.array([20.0, 30.0, np.nan]),
        sigma_m=np.ones(3),
        t_ns=np.arange(3),
    )
    origin, enu, has_height = convert_to_enu(fixes)
    np.testing.assert_allclose(origin, [65.0, 25.0, 25.0])
    # a thousandth of a degree of longitude at 65 degrees north
    np.testing.assert_allclose(enu, [[0, 0, -5], [0, 0, 5], [47.2, 0, 0]], atol=0.05)
    assert has_height.tolist() == [True, True, False]
