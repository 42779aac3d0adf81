"""Markers at known places in a model, as a validation found them."""

import numpy as np

from colmap_inertial.core.geometry import quat_exp, quat_rotate
from colmap_inertial.validate import Corner, Validation, parse_target

SIDE_M = 0.1
PLACES = {0: (0, 0, 0), 1: (2, 0, 0), 2: (0, 3, 0.5), 3: (2, 3, 1), 7: (1, 1, 2)}


def validated(scale=1.0, error_m=0.0, *, unscaled=False):
    """Markers at known places in a model whose unit is 1/scale metres, turned and moved; marker 3 is off by error_m."""
    target = parse_target(f"aruco:DICT_4X4_50:{SIDE_M}")
    turn = quat_exp(np.array([0.3, -0.2, 0.5]))
    corners = []
    for number, place in PLACES.items():
        for k in range(4):
            at = np.array(place) + target.corners_m[k] + (np.array([0, 0, error_m]) if number == 3 else 0)
            corners.append(
                Corner(name=f"marker{number}.{k}", in_model=quat_rotate(turn, at[None])[0] / scale + [5, 6, 7])
            )
    numbers = dict.fromkeys(("views_used", "views_searched", "corners_used", "corners_rejected"), 5)
    return Validation(
        target=target, unscaled=unscaled, tolerance_pct=2.0, scale_error_pct=0.0, ci95_pct=(-1, 1),
        metres_per_unit=scale, metres_per_unit_ci95=(scale, scale), **numbers, rms_px=0.1, corner_noise_px=0.1,
        pose_noise_px=0.1, distances=(), corners=tuple(corners), views=(), views_rejected=(), control=None, check=None,
        check_error_pct=None, check_ci95_pct=None, reasons=(),
    )  # fmt: skip
