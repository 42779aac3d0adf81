"""Pairs of a short and a long exposure of one scene: brought together, or blended without any network.

:func:`bring_together` matches their brightness and geometry for what makes one image of both
(:mod:`colmap_inertial.imaging.restoration.lsd2`); :func:`fuse_mertens` blends exposures as they are.
"""

from colmap_inertial.imaging.exposure_pairs.alone import Alone, better_alone
from colmap_inertial.imaging.exposure_pairs.mertens import fuse_mertens
from colmap_inertial.imaging.exposure_pairs.pair import (
    Brightness,
    ExposurePair,
    PairGyro,
    blur_seen_from_short,
    brightened,
    bring_together,
    first_brightness,
    gyro_shift,
    match_brightness,
)

__all__ = [
    "Alone",
    "Brightness",
    "ExposurePair",
    "PairGyro",
    "better_alone",
    "blur_seen_from_short",
    "brightened",
    "bring_together",
    "first_brightness",
    "fuse_mertens",
    "gyro_shift",
    "match_brightness",
]
