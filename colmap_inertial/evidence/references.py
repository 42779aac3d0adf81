"""What a target and a known distance say of the scale, as evidence beside the sensors'."""

from __future__ import annotations

import math

from colmap_inertial.core.types.evidence import ScaleEvidence
from colmap_inertial.evidence.priors import DECLARED

#: Nothing is measured better than this (logarithm).
_EXACT = 1e-6


def evidence_of_target(metres_per_unit: float, sigma_log: float, declared_log: float) -> ScaleEvidence:
    """A target as evidence.

    Parameters
    ----------
    metres_per_unit, sigma_log
        As it was measured in the model.
    declared_log
        How well its size is known, standard deviation of the logarithm.
    """
    random = math.sqrt(max(sigma_log**2 - declared_log**2, _EXACT**2))
    return ScaleEvidence(
        sensor="target", log_scale=math.log(metres_per_unit), random_sigma=random, systematic={DECLARED: declared_log}
    )


def evidence_of_distance(metres: float, sigma_m: float, measured: float, sigma: float) -> ScaleEvidence:
    """A known distance as evidence.

    Parameters
    ----------
    metres, sigma_m
        The distance and its standard deviation.
    measured, sigma
        The same in the model, in its units.
    """
    return ScaleEvidence(
        sensor="distance",
        log_scale=math.log(metres / measured),
        random_sigma=sigma / measured,
        systematic={DECLARED: sigma_m / metres},
    )
