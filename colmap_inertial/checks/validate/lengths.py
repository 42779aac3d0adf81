"""What a check of lengths says, in the words of those who test by them: errors, how long, in which directions.

Lengths are measured as VDI/VDE 2634 (part 1) has them: each known length against the same one in the model, over as
much of the volume and in as many directions as there are. Accuracy of points is given as ASPRS (2023) has it: root mean
square errors along the axes and in space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from colmap_inertial.checks.validate.limits import FIT
from colmap_inertial.core.arrays import Array

DistanceSet = Literal["control", "check", "mixed"]


@dataclass(frozen=True, kw_only=True)
class Distance:
    """A known distance, measured in the model.

    Attributes
    ----------
    pair
        Names of the two corners.
    known_m
        What the target's description says.
    measured
        Between the two corners, each triangulated on its own; model units.
    residual_m
        Measured minus known. Of a model without a unit, after scaling it by the control distances.
    set
        ``control`` or ``check`` where both corners belong to that set, else ``mixed``.
    """

    pair: tuple[str, str]
    known_m: float
    measured: float
    residual_m: float
    set: DistanceSet


@dataclass(frozen=True, eq=False, kw_only=True)
class Corner:
    """A corner of the target, triangulated on its own.

    Attributes
    ----------
    name
        As in :class:`Distance`.
    in_model
        (3,) its position; model units.
    """

    name: str
    in_model: Array


@dataclass(frozen=True, kw_only=True)
class LengthCheck:
    """Errors of known lengths.

    Attributes
    ----------
    count
        Lengths that were measured.
    rms_m, largest_m
        Root mean square and largest error (measured minus known), the latter with its sign.
    longest_m
        The longest known length.
    diagonal_m
        Of the box that nearly all of the model's points fill; ``None`` where there are none.
    longest_share
        Longest length by diagonal.
    directions
        In how many independent directions there are lengths: 1, 2 or 3.
    proves
        What the check proves, and what it does not, in one sentence.
    """

    count: int
    rms_m: float
    largest_m: float
    longest_m: float
    diagonal_m: float | None
    longest_share: float | None
    directions: int
    proves: str

    @property
    def is_short(self) -> bool:
        """Whether the lengths say little of the whole model."""
        return self.longest_share is not None and self.longest_share < FIT.short_share


def check_lengths(
    distances: Sequence[Distance], corners: Sequence[Corner], diagonal: float | None, to_metres: float
) -> LengthCheck | None:
    """Sum up measured lengths.

    Parameters
    ----------
    distances, corners
        Known distances, and where their ends lie in the model.
    diagonal
        Of the model, in its units (:func:`model_diagonal`).
    to_metres
        Metres per model unit.

    Returns
    -------
    ``None`` where there are no lengths.
    """
    if not distances:
        return None
    errors_m = np.array([distance.residual_m for distance in distances])
    place = {corner.name: corner.in_model for corner in corners}
    ends = [[place[name] for name in distance.pair] for distance in distances if set(distance.pair) <= set(place)]
    longest_m = max(distance.known_m for distance in distances)
    diagonal_m = None if diagonal is None else diagonal * to_metres
    share = None if not diagonal_m else longest_m / diagonal_m
    directions = _count_directions(np.array(ends).reshape(-1, 2, 3))
    return LengthCheck(
        count=len(distances),
        rms_m=float(np.sqrt(np.mean(errors_m**2))),
        largest_m=float(errors_m[np.argmax(np.abs(errors_m))]),
        longest_m=longest_m,
        diagonal_m=diagonal_m,
        longest_share=share,
        directions=directions,
        proves=_describe_proof(longest_m, diagonal_m, share, directions),
    )


def model_diagonal(xyz: Array) -> float | None:
    """Diagonal of the box that nearly all of (N, 3) points fill; ``None`` where there are too few."""
    if len(xyz) < 2:
        return None
    low, high = np.percentile(xyz, [FIT.outside_pct, 100 - FIT.outside_pct], axis=0)
    return float(np.linalg.norm(high - low)) or None


def _count_directions(ends: Array) -> int:
    """In how many directions (K, 2, 3) lengths lie."""
    along = ends[:, 1] - ends[:, 0]
    norm = np.linalg.norm(along, axis=1, keepdims=True)
    along = along[norm[:, 0] > 0] / norm[norm[:, 0] > 0]
    if not len(along):
        return 0
    spread = np.linalg.eigvalsh(along.T @ along / len(along))
    return int((spread > FIT.own_direction * spread[-1]).sum())


def _describe_proof(longest_m: float, diagonal_m: float | None, share: float | None, directions: int) -> str:
    checked = f"lengths up to {longest_m:.3g} m are right to what is said here"
    if share is None or diagonal_m is None:
        return checked
    checked += f", in {'one direction' if directions == 1 else f'{directions} directions'}"
    if share >= FIT.long_share:
        return f"{checked} and over {100 * share:.0f} % of the model's diagonal of {diagonal_m:.3g} m"
    amount = "nothing" if share < FIT.short_share else "little"
    return (
        f"{checked}; they span {100 * share:.2g} % of the model's diagonal of {diagonal_m:.3g} m, which says {amount} "
        "of whether it bends or drifts elsewhere"
    )
