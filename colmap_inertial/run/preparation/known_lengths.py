"""Checks, before any work, of the known lengths that are given beside a capture or a project."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from colmap_inertial.core.errors import InertialError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ReferenceOptions, ScaleFrom
from colmap_inertial.io.capture import Capture
from colmap_inertial.run.stages.known_lengths import parse_end, parse_length
from colmap_inertial.validate import parse_target


def add_target(reference: ReferenceOptions, capture: Capture) -> ReferenceOptions:
    """Known lengths with the target that a capture describes, where no other one is given."""
    if reference.target is not None or capture.target is None:
        return reference
    return replace(reference, target=capture.target)


def check_reference(reference: ReferenceOptions, scale_from: Sequence[ScaleFrom]) -> None:
    """Refuse, before any work, what is not given or cannot be.

    Raises
    ------
    InertialError
        With all that is missing.
    """
    target = None if reference.target is None else parse_target(reference.target)
    if "target" in scale_from and target is None:
        raise InertialError(Fact("target-not-given"))
    if "distance" not in scale_from and reference.distance is None and reference.between is None:
        return
    if reference.between is None or reference.distance is None:
        raise InertialError(Fact("distance-not-given"))
    parse_length(reference.distance)
    for end in reference.between:
        parse_end(end)
    if reference.has_markers and (target is None or target.kind != "aruco"):
        raise InertialError(Fact("markers-not-given"))
    if reference.between[0] == reference.between[1]:
        raise NotObservableError("scale", Fact("one-place", first=reference.between[0], second=reference.between[1]))


def check_reference_beside_imu(reference: ReferenceOptions, scale_from: Sequence[ScaleFrom]) -> None:
    """The same beside an IMU, whose metres a distance joins only where it is named.

    Raises
    ------
    InertialError
        As :func:`check_reference`; and for a distance that is not named, or from a marker to a point.
    """
    check_reference(reference, scale_from)
    if reference.distance is not None and "distance" not in scale_from:
        raise InertialError(Fact("distance-not-named", sensors=tuple(scale_from)))
    # a point has COLMAP's coordinates, a marker those of the model that the IMU made metric
    if reference.has_points and reference.has_markers:
        raise InertialError(Fact("between-of-one-kind"))
