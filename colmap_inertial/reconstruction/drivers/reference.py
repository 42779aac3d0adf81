"""Metres without an IMU: an existing project scaled by a target of known size, or by one known distance."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.checks.validate import Validation, parse_target, validate_model
from colmap_inertial.checks.validate.markers import marker_centres
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError
from colmap_inertial.core.options import ProjectOptions, ReferenceOptions, ValidateOptions
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.io.files import StrPath, write_json
from colmap_inertial.model.project import apply_to_project
from colmap_inertial.pipeline.run.progress import Progress, silent
from colmap_inertial.reconstruction.drivers.sources import only_model, scaling

#: What the folder keeps beside the project: where its metres come from.
REFERENCE_FILE = "scale.json"
_NO_TARGET = "--scale-from target needs the target: --target checkerboard:COLSxROWS:SQUARE_M or another"
_NO_DISTANCE = (
    "--scale-from distance needs --between A B (two marker numbers, or two points as x,y,z of the model) and "
    "--distance METRES+-SIGMA"
)
_NO_MARKERS = "--between with markers needs what they are: --target aruco:DICT:SIDE_M"


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference:
    """A scale that no IMU gave.

    Attributes
    ----------
    out
        The project in metres.
    scale_from
        ``"target"`` or ``"distance"``.
    metres_per_unit, ci95
        The scale and its 95 % interval.
    made_of
        What it was measured by, in words.
    notes
        What the user should know.
    validation
        The target, where one was measured.
    """

    out: Path
    scale_from: str
    metres_per_unit: float
    ci95: tuple[float, float]
    made_of: str
    notes: tuple[str, ...]
    validation: Validation | None = None

    def as_json(self) -> dict[str, object]:
        """The content of ``scale.json``."""
        kept = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in ("validation", "out")}
        return {**kept, "validation": self.validation and self.validation.as_json()}


def scale_project_by(
    project: StrPath,
    out: StrPath,
    reference: ReferenceOptions,
    source: ProjectOptions | None = None,
    *,
    progress: Progress = silent,
) -> Reference:
    """Write a whole COLMAP project in metres, by what is known of its size.

    Parameters
    ----------
    project
        A folder with one COLMAP model; it is only read.
    out
        A folder that does not exist; it appears whole or not at all.
    reference
        What is known.
    source
        Where the project's pictures are, and how files are taken over.
    progress
        Called with ``"validation"`` and ``"apply"``.

    Raises
    ------
    InertialError
        For what is not given, cannot be read or cannot be found; see also :func:`validate_model` and
        :func:`apply_to_project`.
    """
    project, out, source = Path(project), Path(out), source or ProjectOptions()
    model = only_model(project / "sparse" if (project / "sparse").is_dir() else project)
    validation = None
    if reference.target is not None:
        images = project / "images" if source.images is None else source.images
        if not images.is_dir():
            raise FormatError(images, "no such folder of pictures; give the project's images with --images DIR")
        validation = validate_model(
            model,
            images,
            parse_target(reference.target),
            ValidateOptions(unscaled=True),
            progress=lambda done, total: progress("validation", done, total),
        )
    if reference.scale_from == "distance":
        scale, sigma_log, made_of = _by_distance(reference, validation)
    else:
        scale, sigma_log, made_of = _by_target(validation)
    half = Z95 * sigma_log
    notes = ["which way is up is not known: no IMU was used"]
    if validation is not None:
        notes += [] if validation.lengths is None else [f"this proves that {validation.lengths.proves}"]
        if validation.check_error_pct is not None:
            notes.append(f"corners that the scale does not rest on are {validation.check_error_pct:+.2g} % off")
        notes += validation.reasons
    found = Reference(
        out=out,
        scale_from=reference.scale_from,
        metres_per_unit=scale,
        ci95=(scale * float(np.exp(-half)), scale * float(np.exp(half))),
        made_of=made_of,
        notes=tuple(notes),
        validation=validation,
    )
    apply_to_project(
        project,
        out,
        scaling(scale, sigma_log, made_of),
        link=source.link,
        keep=source.keep,
        follow_links=source.follow_links,
        progress=lambda done, total: progress("apply", done, total),
    )
    write_json(out / REFERENCE_FILE, found.as_json())
    return found


def check_reference(reference: ReferenceOptions) -> None:
    """Refuse, before any work, what is not given or cannot be.

    Raises
    ------
    InertialError
        With all that is missing.
    """
    if reference.scale_from == "target" and reference.target is None:
        raise InertialError(_NO_TARGET)
    if reference.scale_from == "distance":
        if reference.between is None or reference.distance is None:
            raise InertialError(_NO_DISTANCE)
        _length(reference.distance)
        if reference.target is None and not all("," in end for end in reference.between):
            raise InertialError(_NO_MARKERS)
    if reference.target is not None:
        parse_target(reference.target)


def _by_target(validation: Validation | None) -> tuple[float, float, str]:
    if validation is None:
        raise InertialError(_NO_TARGET)
    # by half of its corners, so that the others can tell how right that is
    control = validation.control
    scale = validation.metres_per_unit if control is None else control.metres_per_unit
    low, high = validation.metres_per_unit_ci95 if control is None else control.ci95
    made_of = f"target {validation.target.spec} in {validation.views_used} images"
    return scale, float(np.log(high / low)) / (2 * Z95), made_of


def _by_distance(reference: ReferenceOptions, validation: Validation | None) -> tuple[float, float, str]:
    between, distance = reference.between, reference.distance
    if between is None or distance is None:
        raise InertialError(_NO_DISTANCE)
    metres, sigma_m = _length(distance)
    places, noise = zip(*(_place(text, validation) for text in between), strict=True)
    measured = float(np.linalg.norm(places[0] - places[1]))
    if not measured > 0:
        raise NotObservableError("scale", f"{between[0]} and {between[1]} are the same place")
    sigma_log = float(np.hypot(sigma_m / metres, np.hypot(*noise) / measured))
    return metres / measured, sigma_log, f"distance of {distance} m between {between[0]} and {between[1]}"


def _length(text: str) -> tuple[float, float]:
    try:
        metres, sigma_m = (float(part) for part in text.split("+-"))
    except ValueError:
        metres = sigma_m = float("nan")
    if not (0 < sigma_m < metres < float("inf")):
        raise InertialError(f'--distance "{text}": write metres and how well they are known, as in 4.20+-0.01')
    return metres, sigma_m


def _place(text: str, validation: Validation | None) -> tuple[Array, float]:
    """(3,) a marker's centre or a point, and its standard deviation; model units."""
    parts = text.split(",")
    if len(parts) == 3:
        try:
            place = np.array([float(part) for part in parts])
        except ValueError:
            place = np.full(3, np.nan)
        if not np.isfinite(place).all():
            raise InertialError(f'--between "{text}": a point is x,y,z in the units of the model')
        return place, 0.0
    if not text.isdecimal() or len(text) > 9:
        raise InertialError(f'--between "{text}": write the number of a marker, or a point as x,y,z')
    if validation is None or validation.target.kind != "aruco":
        raise InertialError(_NO_MARKERS)
    centres = marker_centres(validation)
    if int(text) not in centres:
        seen = ", ".join(map(str, sorted(centres))) or "none"
        raise NotObservableError("distance", f"marker {text} was not measured in the model; measured: {seen}")
    return centres[int(text)], _noise(validation, int(text))


def _noise(validation: Validation, marker: int) -> float:
    """Standard deviation of a marker's centre along a line: from how far its corners are from a square's."""
    corners: Sequence[Array] = [c.in_model for c in validation.corners if c.name.startswith(f"marker{marker}.")]
    found, square = np.array(corners), validation.target.corners_m[:4] / validation.metres_per_unit
    found = found - found.mean(axis=0)
    u, _, vt = np.linalg.svd(square.T @ found)
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    residual = found - square @ turn
    # 12 coordinates less 6 of place and turn; the centre is the mean of four corners
    return float(np.sqrt(np.sum(residual**2) / 6) / 2)
