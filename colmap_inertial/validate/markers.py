"""Ends of known lengths and points with known coordinates: scale bars and check points of markers; two targets."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import read_text
from colmap_inertial.validate.fit import FIT
from colmap_inertial.validate.result import CheckPoint, CheckPoints, ScaleBar, TargetDistance, Validation


def marker_centres(validation: Validation) -> dict[int, Array]:
    """(3,) centre of each marker of which all four corners were measured, in the model, by its number."""
    corners: dict[int, list[Array]] = {}
    for corner in validation.corners:
        if corner.name.startswith("marker"):
            corners.setdefault(int(corner.name[6:].partition(".")[0]), []).append(corner.in_model)
    return {number: np.mean(four, axis=0) for number, four in corners.items() if len(four) == 4}


def add_bars(validation: Validation, path: Path) -> Validation:
    """A validation with the scale bars of a table: ``marker_a,marker_b,length_m`` and, where known, ``sigma_m``.

    Raises
    ------
    FormatError
        For a table that cannot be read, or a marker that was not measured.
    """
    centres, to_metres = marker_centres(validation), _get_metres_per_unit(validation)
    bars = []
    for line, row in _read_rows(path, ("marker_a", "marker_b", "length_m")):
        a, b = (_find_marker(centres, row[key], path, line) for key in ("marker_a", "marker_b"))
        known_m = _read_number(row, "length_m", path, line)
        if not known_m > 0:
            raise FormatError(path, Fact("bar-not-positive", length_m=known_m), line=line)
        measured = float(np.linalg.norm(centres[a] - centres[b]))
        sigma_m = _read_number(row, "sigma_m", path, line) if row.get("sigma_m") else None
        error_m = measured * to_metres - known_m
        bars.append(ScaleBar(markers=(a, b), known_m=known_m, sigma_m=sigma_m, measured=measured, residual_m=error_m))
    return replace(validation, bars=tuple(bars))


def add_check_points(validation: Validation, path: Path) -> Validation:
    """A validation with the check points of a table: ``marker,x,y,z`` in metres and, where known, ``sigma_m``.

    The model is moved and turned onto them, not scaled: what is left is its own error, and that of the points.

    Raises
    ------
    FormatError
        For a table that cannot be read, or a marker that was not measured.
    NotObservableError
        For too few points.
    """
    centres, to_metres = marker_centres(validation), _get_metres_per_unit(validation)
    names, stated, measured, sigmas = [], [], [], []
    for line, row in _read_rows(path, ("marker", "x", "y", "z")):
        marker = _find_marker(centres, row["marker"], path, line)
        names.append(marker)
        stated.append([_read_number(row, axis, path, line) for axis in "xyz"])
        measured.append(centres[marker] * to_metres)
        if row.get("sigma_m"):
            sigmas.append(_read_number(row, "sigma_m", path, line))
    if len(names) < FIT.least_points:
        raise NotObservableError(
            "accuracy of points",
            Fact("check-points-too-few", path=str(path), count=len(names), needed=FIT.least_points),
        )
    residual = _move_onto(np.array(measured), np.array(stated)) - np.array(stated)
    sigma_m = float(np.sqrt(np.mean(np.square(sigmas)))) if len(sigmas) == len(names) else None
    rmse = np.sqrt(np.mean(residual**2, axis=0))
    both = 0.0 if sigma_m is None else sigma_m
    check_points = CheckPoints(
        points=tuple(CheckPoint(marker=n, residual_m=r) for n, r in zip(names, residual, strict=True)),
        rmse_m=rmse,
        rmse_horizontal_m=float(np.hypot(np.hypot(rmse[0], rmse[1]), np.sqrt(2) * both)),
        rmse_vertical_m=float(np.hypot(rmse[2], both)),
        sigma_m=sigma_m,
    )
    return replace(validation, check_points=check_points)


def add_other_target(
    validation: Validation, other: Validation, known_m: float, sigma_m: float | None = None
) -> Validation:
    """A validation with the distance between the middles of its target and of another one in the same model.

    Parameters
    ----------
    validation, other
        Of two different targets in one model.
    known_m, sigma_m
        The distance, and how well it is known (standard deviation).
    """
    measured = float(np.linalg.norm(middle_of(validation) - middle_of(other)))
    apart = TargetDistance(
        other=other.target.spec,
        known_m=known_m,
        sigma_m=sigma_m,
        measured=measured,
        residual_m=measured * _get_metres_per_unit(validation) - known_m,
    )
    return replace(validation, apart=apart)


def middle_of(validation: Validation) -> Array:
    """(3,) middle of a board in the model: where its drawing, laid on the corners that were measured, has it.

    Raises
    ------
    NotObservableError
        Where too few corners were measured, or all on one line.
    """
    target = validation.target
    places = {target.label(corner): place for corner, place in enumerate(target.corners_m)}
    drawn = np.array([places[corner.name] for corner in validation.corners]).reshape(-1, 3)
    seen = np.array([corner.in_model for corner in validation.corners]).reshape(-1, 3)
    if len(drawn) < FIT.least_points or np.linalg.matrix_rank(drawn - drawn.mean(axis=0), tol=1e-9) < 2:
        raise NotObservableError("distance", Fact("corners-of-target-too-few", target=target.spec))
    units = float(np.sqrt(np.sum((seen - seen.mean(axis=0)) ** 2) / np.sum((drawn - drawn.mean(axis=0)) ** 2)))
    return _move_onto(np.vstack([drawn * units, np.zeros((1, 3))]), seen)[-1]


def distance_between(validation: Validation, a: int, b: int) -> float:
    """Between the centres of two markers; model units.

    Raises
    ------
    NotObservableError
        Where one of them was not measured.
    """
    centres = marker_centres(validation)
    for marker in (a, b):
        if marker not in centres:
            raise NotObservableError(
                "distance", Fact("marker-of-distance-not-measured", marker=marker, measured=sorted(centres))
            )
    return float(np.linalg.norm(centres[a] - centres[b]))


def _move_onto(source: Array, target: Array) -> Array:
    """(N, 3) points, of which the first (M, 3) are turned and moved onto others, by least squares (Kabsch 1976)."""
    fitted = source[: len(target)]
    about, onto = fitted.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((fitted - about).T @ (target - onto))
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return (source - about) @ u @ turn @ vt + onto


def _get_metres_per_unit(validation: Validation) -> float:
    if not validation.unscaled:
        return 1.0
    return validation.metres_per_unit if validation.control is None else validation.control.metres_per_unit


def _read_rows(path: Path, needed: Sequence[str]) -> list[tuple[int, dict[str, str]]]:
    reader = csv.DictReader(read_text(path).splitlines(), skipinitialspace=True)
    missing = [name for name in needed if name not in (reader.fieldnames or ())]
    if missing:
        raise FormatError(path, Fact("column-of-table-missing", column=missing[0], needed=needed))
    return [(reader.line_num, {k: v or "" for k, v in row.items() if isinstance(k, str)}) for row in reader]


def _read_number(row: Mapping[str, str], key: str, path: Path, line: int) -> float:
    try:
        value = float(row[key])
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise FormatError(path, Fact("cell-of-table-not-a-number", column=key, text=row[key]), line=line)
    return value


def _find_marker(centres: Mapping[int, Array], text: str, path: Path, line: int) -> int:
    if not text.isdecimal() or int(text) not in centres:
        raise FormatError(path, Fact("marker-of-table-not-measured", marker=text, measured=sorted(centres)), line=line)
    return int(text)
