"""Sub-models of one recording that were joined, and the gaps between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from colmap_inertial.core.types.estimated import Similarity, Verdict


@dataclass(frozen=True, kw_only=True)
class Gap:
    """What lies between two sub-models, and whether they were joined across it.

    Attributes
    ----------
    first, second
        COLMAP's numbers, the earlier one first.
    seconds
        From the last image before it to the first one after it; below zero where the two overlap in time.
    shared_images
        How many images of both say where one lies in the other.
    matched_images
        How many images of one matches place in the other, in agreement with the IMU.
    sigma_m, sigma_deg
        Standard deviations of position and direction of the first image after it as seen from the last one before it,
        along the direction that is known worst; ``None`` where they were not found.
    chi2, dof
        How the IMU and shared images contradict the velocities, directions of gravity and scales of the two: sum of
        squares over variances, and what chance makes of it.
    joined, reason
        Whether they are one model, and why not; in words.
    """

    first: int
    second: int
    seconds: float
    shared_images: int = 0
    matched_images: int = 0
    sigma_m: float | None = None
    sigma_deg: float | None = None
    chi2: float | None = None
    dof: int | None = None
    joined: bool
    reason: str

    def __post_init__(self) -> None:
        if not math.isfinite(self.seconds):
            raise ValueError("a gap's length must be finite")
        if self.joined and (self.sigma_m is None or self.sigma_deg is None):
            raise ValueError("what is joined has standard deviations")


@dataclass(frozen=True, eq=False, kw_only=True)
class JoinedPart:
    """A sub-model within a joined one.

    Attributes
    ----------
    colmap_index
        COLMAP's number.
    images
        How many it has.
    begin_s, end_s
        First and last image, camera clock.
    verdict, sigma_log
        Of its own scale, and the standard deviation of the logarithm of its scale once joined.
    similarity
        From COLMAP's sub-model to the joined one.
    sigma_m, sigma_deg
        Of its middle against the largest part, along the direction that is known worst: gaps, and what its own scale
        and direction leave open; 0 for the largest part itself.
    """

    colmap_index: int
    images: int
    begin_s: float
    end_s: float
    verdict: Verdict
    sigma_log: float
    similarity: Similarity
    sigma_m: float
    sigma_deg: float
