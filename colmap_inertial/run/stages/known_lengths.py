"""What a target and a known distance say of a model's scale."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import InertialError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ReferenceOptions
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types.evidence import ScaleEvidence
from colmap_inertial.evidence.references import evidence_of_distance, evidence_of_target
from colmap_inertial.validate import Validation
from colmap_inertial.validate.markers import marker_centres


def scale_by_target(validation: Validation) -> tuple[ScaleEvidence, str]:
    """A target as evidence, and what was measured, in words."""
    # by half of its corners, so that the others can tell how right that is
    control = validation.control
    scale = validation.metres_per_unit if control is None else control.metres_per_unit
    low, high = validation.metres_per_unit_ci95 if control is None else control.ci95
    target = validation.target
    declared_log = 0.0 if target.sigma_m is None else target.sigma_m / target.length_m
    evidence = evidence_of_target(scale, float(np.log(high / low)) / (2 * Z95), declared_log)
    return evidence, f"target {target.spec} in {validation.views_used} images"


def scale_by_distance(reference: ReferenceOptions, validation: Validation | None) -> tuple[ScaleEvidence, str]:
    """A known distance as evidence, and what was measured, in words.

    Parameters
    ----------
    reference
        The distance, and between what.
    validation
        The markers as they were measured in the model; ``None`` where both ends are points.

    Raises
    ------
    NotObservableError
        Where an end was not measured, or both are one place.
    """
    between, distance = reference.between, reference.distance
    if between is None or distance is None:
        raise InertialError(Fact("distance-not-given"))
    metres, sigma_m = parse_length(distance)
    places, noise = zip(*(_find_place(text, validation) for text in between), strict=True)
    measured = float(np.linalg.norm(places[0] - places[1]))
    if not measured > 0:
        raise NotObservableError("scale", Fact("one-place", first=between[0], second=between[1]))
    evidence = evidence_of_distance(metres, sigma_m, measured, float(np.hypot(*noise)))
    return evidence, f"distance of {distance} m between {between[0]} and {between[1]}"


def parse_length(text: str) -> tuple[float, float]:
    """Metres and their standard deviation, of a text such as ``4.20+-0.01``.

    Raises
    ------
    InertialError
        For anything else.
    """
    try:
        metres, sigma_m = (float(part) for part in text.split("+-"))
    except ValueError:
        metres = sigma_m = float("nan")
    if not (0 < sigma_m < metres < float("inf")):
        raise InertialError(Fact("distance-unreadable", text=text))
    return metres, sigma_m


def parse_end(text: str) -> Array | int:
    """(3,) a point in the units of COLMAP's model, of a text such as ``1,2.5,0``; else the number of a marker.

    Raises
    ------
    InertialError
        For anything else.
    """
    parts = text.split(",")
    if len(parts) == 3:
        try:
            place = np.array([float(part) for part in parts])
        except ValueError:
            place = np.full(3, np.nan)
        if not np.isfinite(place).all():
            raise InertialError(Fact("point-unreadable", text=text))
        return place
    if not text.isdecimal() or len(text) > 9:
        raise InertialError(Fact("marker-unreadable", text=text))
    return int(text)


def _find_place(text: str, validation: Validation | None) -> tuple[Array, float]:
    """(3,) a marker's centre or a point, and its standard deviation; model units."""
    end = parse_end(text)
    if not isinstance(end, int):
        return end, 0.0
    if validation is None or validation.target.kind != "aruco":
        raise InertialError(Fact("markers-not-given"))
    centres = marker_centres(validation)
    if end not in centres:
        raise NotObservableError("distance", Fact("marker-not-measured", marker=text, measured=sorted(centres)))
    return centres[end], _estimate_marker_noise(validation, end)


def _estimate_marker_noise(validation: Validation, marker: int) -> float:
    """Standard deviation of a marker's centre along a line: from how far its corners are from a square's."""
    corners: Sequence[Array] = [c.in_model for c in validation.corners if c.name.startswith(f"marker{marker}.")]
    measured, square = np.array(corners), validation.target.corners_m[:4] / validation.metres_per_unit
    measured = measured - measured.mean(axis=0)
    u, _, vt = np.linalg.svd(square.T @ measured)
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    residual = measured - square @ turn
    # 12 coordinates less 6 of place and turn; the centre is the mean of four corners
    return float(np.sqrt(np.sum(residual**2) / 6) / 2)
