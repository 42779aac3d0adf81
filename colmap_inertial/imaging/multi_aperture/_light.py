"""The luminance cost: colours that lie on each other rightly add up to what the luminance aperture sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from colmap_inertial.core.arrays import Float32Array, UInt8Array
from colmap_inertial.core.types import SpectralRole
from colmap_inertial.imaging.multi_aperture._geometry import Rectified
from colmap_inertial.imaging.multi_aperture._sampling import warp_view
from colmap_inertial.imaging.semi_global import LightCost

#: A residual of this many times the usual one costs 63 % of the most.
_WIDE = 3.0
#: Rounds of least squares, each without what the one before left furthest off.
_ROUNDS = 3
#: Rows and columns of the image that are fitted to: thousands of pixels are enough for four numbers.
_EVERY = 3


_NEEDED: tuple[SpectralRole, ...] = ("red", "green", "blue", "luminance")


def adds_up(roles: Sequence[SpectralRole]) -> bool:
    """Whether there are all colours, and luminance to compare them with."""
    return set(_NEEDED) <= set(roles)


def light_cost(
    codes: UInt8Array, canvas: Rectified, disparity_px: Float32Array, roles: Sequence[SpectralRole], most: int
) -> LightCost | None:
    """Luminance as a function of the colours, from images that are roughly aligned.

    ``luminance = a red + b green + c blue + d``, fitted, so that neither the filters' curves nor exposures need be
    known. ``None`` where too few pixels are seen by all.

    Parameters
    ----------
    codes
        (N, H, W), the reference first.
    disparity_px
        (H, W).
    most
        What a residual costs at most.
    """
    first = codes[0][::_EVERY, ::_EVERY]
    aligned, inside = [first.astype(np.float64)], np.ones(first.shape, dtype=bool)
    for k in range(1, len(codes)):
        warped, there = warp_view(codes[k], canvas, k, disparity_px, _EVERY)
        aligned.append(warped.astype(np.float64))
        inside &= there
    means = {role: [i for i, other in enumerate(roles) if other == role] for role in _NEEDED}
    of_role = [np.mean([aligned[i][inside] for i in means[role]], axis=0) for role in _NEEDED]
    unknown = np.column_stack([*of_role[:3], np.ones(len(of_role[0]))])
    wanted, used = of_role[3], np.ones(len(of_role[0]), dtype=bool)
    if len(wanted) < 100:
        return None
    for _ in range(_ROUNDS):
        light = np.linalg.lstsq(unknown[used], wanted[used])[0]
        residual = np.abs(unknown @ light - wanted)
        scale = max(1.0, 1.4826 * float(np.median(residual)))
        used = residual < 3 * scale
    blend = np.zeros(len(codes) + 1)
    for role, weight in zip(_NEEDED, (*light[:3], -1.0), strict=True):
        blend[means[role]] += weight / len(means[role])
    blend[-1] = light[3]
    table = most * (1 - np.exp(-((np.arange(256) / (_WIDE * scale)) ** 2)))
    return LightCost(blend=np.rint(256 * blend).astype(np.int32), table=np.asarray(np.rint(table), dtype=np.uint8))
