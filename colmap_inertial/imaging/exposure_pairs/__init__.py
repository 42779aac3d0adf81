"""Pairs of a short and a long exposure of one scene: brought together, or blended without any network.

:func:`bring_together` matches their brightness and geometry for what makes one image of both
(:mod:`colmap_inertial.imaging.restoration.lsd2`); :func:`fuse_mertens` blends exposures as they are.
"""

from colmap_inertial.imaging.exposure_pairs.alone import Alone as Alone, better_alone as better_alone
from colmap_inertial.imaging.exposure_pairs.departure import replace_departures as replace_departures
from colmap_inertial.imaging.exposure_pairs.mertens import darken_fused as darken_fused, fuse_mertens as fuse_mertens
from colmap_inertial.imaging.exposure_pairs.pair import (
    Brightness as Brightness,
    ExposurePair as ExposurePair,
    PairGyro as PairGyro,
    blur_seen_from_short as blur_seen_from_short,
    brightened as brightened,
    bring_together as bring_together,
    first_brightness as first_brightness,
    gyro_shift as gyro_shift,
    match_brightness as match_brightness,
)
