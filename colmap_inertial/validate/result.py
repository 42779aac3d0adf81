"""Results of a validation as values, JSON and a table.

Lengths are measured as VDI/VDE 2634 (part 1) has them: each known length against the same one in the model, over as
much of the volume and in as many directions as there are. Accuracy of points is given as ASPRS (2023) has it: root mean
square errors along the axes and in space.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray
from colmap_inertial.core.facts import Fact, with_sentences
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.io.files import convert_to_plain
from colmap_inertial.report.words import target_facts
from colmap_inertial.validate.contradictions import find_contradictions
from colmap_inertial.validate.fit import FIT
from colmap_inertial.validate.targets import Target

if TYPE_CHECKING:
    from rich.console import Group

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
        What the check proves, and what it does not.
    """

    count: int
    rms_m: float
    largest_m: float
    longest_m: float
    diagonal_m: float | None
    longest_share: float | None
    directions: int
    proves: Fact

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
    """Number of distinct directions of the lengths (K, 2, 3)."""
    along = ends[:, 1] - ends[:, 0]
    norm = np.linalg.norm(along, axis=1, keepdims=True)
    along = along[norm[:, 0] > 0] / norm[norm[:, 0] > 0]
    if not len(along):
        return 0
    spread = np.linalg.eigvalsh(along.T @ along / len(along))
    return int((spread > FIT.own_direction * spread[-1]).sum())


def _describe_proof(longest_m: float, diagonal_m: float | None, share: float | None, directions: int) -> Fact:
    elsewhere = None
    if share is not None and share < FIT.long_share:
        elsewhere = "nothing" if share < FIT.short_share else "little"
    return Fact(
        "lengths-agree",
        longest_m=longest_m,
        diagonal_m=diagonal_m,
        longest_share=share,
        directions=directions,
        shows_elsewhere=elsewhere,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewResiduals:
    """The target in one image.

    Attributes
    ----------
    name
        The image's name in the model.
    corner
        (n,) numbers of the corners that were used.
    observed_px, projected_px
        (n, 2) where they were seen and where the model's camera sees the fitted target; COLMAP's pixel coordinates.
    rejected_px
        (m, 2) corners that were seen and not used.
    rms_px
        Root mean square distance between the two.
    """

    name: str
    corner: IndexArray
    observed_px: Array
    projected_px: Array
    rejected_px: Array
    rms_px: float


@dataclass(frozen=True, kw_only=True)
class RejectedView:
    """An image that was looked at and not used.

    Attributes
    ----------
    name, reason
        Which, and why.
    residual_px
        Median distance of its corners from where they should be; ``None`` where none were found.
    """

    name: str
    reason: Fact
    residual_px: float | None = None


@dataclass(frozen=True, kw_only=True)
class SetScale:
    """The scale from one of the two disjoint sets of corners.

    Attributes
    ----------
    metres_per_unit, ci95
        Known length divided by the length in the model, and its 95 % interval.
    corners
        Number of corner observations.
    """

    metres_per_unit: float
    ci95: tuple[float, float]
    corners: int


@dataclass(frozen=True, kw_only=True)
class ScaleBar:
    """A known distance between the centres of two markers.

    Attributes
    ----------
    markers
        Their numbers.
    known_m, sigma_m
        The length, and how well it is known (standard deviation), where that was said.
    measured
        In the model; model units.
    residual_m
        Measured minus known, as of :class:`Distance`.
    """

    markers: tuple[int, int]
    known_m: float
    sigma_m: float | None
    measured: float
    residual_m: float


@dataclass(frozen=True, kw_only=True)
class TargetDistance:
    """A known distance between the middles of two targets in one scene.

    Attributes
    ----------
    other
        The second target's specification.
    known_m, sigma_m, measured, residual_m
        As of :class:`ScaleBar`.
    """

    other: str
    known_m: float
    sigma_m: float | None
    measured: float
    residual_m: float


@dataclass(frozen=True, eq=False, kw_only=True)
class CheckPoint:
    """A marker whose coordinates are known: its number, and (3,) model minus known, along the known axes."""

    marker: int
    residual_m: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class CheckPoints:
    """Markers with known coordinates, onto which the model was moved and turned.

    Attributes
    ----------
    points
        Each of them.
    rmse_m
        (3,) root mean square error along each axis.
    rmse_horizontal_m, rmse_vertical_m
        Over x and y, and along z, with the points' own accuracy in it where it is known (ASPRS 2023).
    sigma_m
        The points' own accuracy: standard deviation of a coordinate.
    """

    points: tuple[CheckPoint, ...]
    rmse_m: Array
    rmse_horizontal_m: float
    rmse_vertical_m: float
    sigma_m: float | None


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class Validation:
    """Size of a reconstruction against a target of known size.

    Attributes
    ----------
    target
        The target.
    unscaled
        Whether the model claims no unit.
    tolerance_pct
        The largest ``scale_error_pct`` that passes.
    scale_error_pct, ci95_pct
        100 (length in the model / known length - 1), and its 95 % interval; ``None`` for a model without a unit.
    metres_per_unit, metres_per_unit_ci95
        Known length divided by the length in the model. For a model without a unit, the factor that makes it metric.
    views_used, views_searched
        Number of images that the result rests on, and that were looked at.
    corners_used, corners_rejected
        Number of corner observations that the result rests on, and of those left out within these images.
    rms_px
        Root mean square distance of corners from the fitted target, with the model's own poses.
    corner_noise_px
        The part of it that is independent from corner to corner: standard deviation of one coordinate.
    pose_noise_px
        The part that all corners of a view share: root mean square movement of corners by each view's pose error.
    distances
        Known distances, measured.
    corners
        The ends of these distances.
    views
        Residuals by view.
    views_rejected
        Images that were looked at and not used.
    control, check
        The scale from two disjoint sets of corners: ``control`` to scale a model by, ``check`` to judge the result.
        ``None`` where a set is too small.
    check_error_pct, check_ci95_pct
        Scale error that the check corners show after scaling by the control corners.
    reasons
        What limits the result.
    lengths
        Errors of the known distances, how long they are and what they prove.
    bars, check_points, apart
        Distances between markers, coordinates of markers and the distance to another target, where those were given.
    """

    target: Target
    unscaled: bool
    tolerance_pct: float
    scale_error_pct: float | None
    ci95_pct: tuple[float, float] | None
    metres_per_unit: float
    metres_per_unit_ci95: tuple[float, float]
    views_used: int
    views_searched: int
    corners_used: int
    corners_rejected: int
    rms_px: float
    corner_noise_px: float
    pose_noise_px: float
    control: SetScale | None
    check: SetScale | None
    check_error_pct: float | None
    check_ci95_pct: tuple[float, float] | None
    distances: tuple[Distance, ...]
    corners: tuple[Corner, ...]
    views: tuple[ViewResiduals, ...]
    views_rejected: tuple[RejectedView, ...]
    reasons: tuple[Fact, ...]
    lengths: LengthCheck | None = None
    bars: tuple[ScaleBar, ...] = ()
    check_points: CheckPoints | None = None
    apart: TargetDistance | None = None

    @property
    def within_tolerance(self) -> bool:
        """Whether the scale error is within the tolerance (a model without a unit has none) and nothing casts doubt on
        it.
        """
        off = self.scale_error_pct is not None and abs(self.scale_error_pct) > self.tolerance_pct
        return not off and not self.doubts

    @property
    def doubts(self) -> tuple[Fact, ...]:
        """Why the target may not be the stated one: few images agree, or its lengths contradict each other."""
        doubts = []
        if self.views_used < FIT.enough_views:
            doubts.append(Fact("target-size-not-proved", used=self.views_used, searched=self.views_searched))
        # a factor that all lengths share is no contradiction between them
        distances = [self._scaled(distance) for distance in self.distances]
        largest_m = max((distance.residual_m for distance in distances), key=abs, default=0.0)
        longest_m = max((distance.known_m for distance in distances), default=0.0)
        if abs(largest_m) > self.tolerance_pct / 100 * longest_m:
            doubts.append(
                Fact(
                    "target-lengths-disagree",
                    largest_m=largest_m,
                    tolerance_share=self.tolerance_pct / 100,
                    longest_m=longest_m,
                )
            )
        found = find_contradictions(self.target, distances, self.views, self.tolerance_pct)
        return (*doubts, *(Fact("noted-with-advice", found=fact) for fact in found))

    @property
    def mismatch(self) -> Fact | None:
        """The size of the target that would fit a model whose lengths are all off alike; ``None`` where none is."""
        error_pct = self.scale_error_pct
        if error_pct is None or abs(error_pct) <= self.tolerance_pct or self.doubts:
            return None
        stated_m = self.target.length_m
        fits_m = stated_m * (1 + error_pct / 100)
        return Fact("target-or-scale-wrong", kind=self.target.kind, stated_m=stated_m, fits_m=fits_m)

    def _scaled(self, distance: Distance) -> Distance:
        """A distance as it is once the model has the scale of the target."""
        return replace(distance, residual_m=distance.measured * self.metres_per_unit - distance.known_m)

    def as_json(self) -> dict[str, Any]:
        """Everything but pixel coordinates, ready for ``json.dump``."""

        values: dict[str, Any] = {}
        for field in fields(self):
            values[field.name] = getattr(self, field.name)
            if field.name == "tolerance_pct":
                values["within_tolerance"] = self.within_tolerance
        values["target"] = self.target.spec
        values["reasons"] = (*self.doubts, *filter(None, [self.mismatch]), *self.reasons)
        values["doubts"] = self.doubts
        values["views"] = [{"name": v.name, "corners": len(v.corner), "rms_px": v.rms_px} for v in self.views]
        json: dict[str, Any] = convert_to_plain(with_sentences(values))
        return json


def validation_table(result: Validation) -> Group:
    """The result for a terminal: figures, distances by length, views left out by reason, remarks."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    figures = Table(title=f"Size against {result.target.spec}", show_header=False, title_justify="left")
    figures.add_column(justify="right")
    figures.add_column()
    colours = {"scale error": "bold green" if result.within_tolerance else "bold red"}
    for label, value in target_facts(result.as_json()):
        if label != "target":
            figures.add_row(label, Text(value, colours.get(label, "")))
    parts: list[Table | Text] = [figures]
    if result.distances:
        parts.append(_distance_table(result))
    if result.views_rejected:
        rejected = Table(title="Images left out", title_justify="left")
        rejected.add_column("images", justify="right")
        rejected.add_column("reason")
        for reason, count in Counter(view.reason for view in result.views_rejected).most_common():
            rejected.add_row(str(count), str(reason))
        parts.append(rejected)
    proved = [] if result.lengths is None else [f"the check proves that {result.lengths.proves}"]
    parts += [Text(f"- {text}", "bold red") for text in (*result.doubts, *filter(None, [result.mismatch]))]
    parts += [Text(f"- {text}") for text in (*proved, *result.reasons)]
    return Group(*parts)


def _distance_table(result: Validation) -> Any:
    from rich.table import Table

    table = Table(title="Known distances, each corner triangulated on its own", title_justify="left")
    for name in ("known, mm", "count", "mean residual, mm", "rms, mm", "largest, mm"):
        table.add_column(name, justify="right")
    length_10um = np.array([round(distance.known_m * 1e5) for distance in result.distances])
    residual_mm = np.array([1000 * distance.residual_m for distance in result.distances])
    for length in np.unique(length_10um):
        values = residual_mm[length_10um == length]
        largest = values[np.argmax(np.abs(values))]
        rms = np.sqrt(np.mean(values**2))
        table.add_row(f"{length / 100:.2f}", str(len(values)), f"{values.mean():+.3f}", f"{rms:.3f}", f"{largest:+.3f}")
    return table
