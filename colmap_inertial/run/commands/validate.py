"""``validate``: a target measured in a model, what else is known of the scene, and what is written of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.errors import InertialError, OutputExistsError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ValidateOptions
from colmap_inertial.core.types import Similarity
from colmap_inertial.io.files import write_json
from colmap_inertial.model import apply_similarity
from colmap_inertial.run.commands.paths import check_output, only_model
from colmap_inertial.run.steps.workspace import refuse_links_around
from colmap_inertial.validate import (
    Target,
    Validation,
    add_bars,
    add_check_points,
    add_other_target,
    parse_target,
    validate_model,
    write_overlays,
)


@dataclass(frozen=True, kw_only=True)
class ValidationOutputs:
    """Output files of a validation.

    Attributes
    ----------
    json, pictures
        The result, and frames with the corners drawn in.
    apply
        The model in metres, scaled by the control distances; for a model without a unit only.
    """

    json: Path | None = None
    pictures: Path | None = None
    apply: Path | None = None

    def check(self, model: Path, *, unscaled: bool) -> None:
        """Refuse, before any work, what would replace something; raises :class:`InertialError`."""
        if self.json is not None:
            check_output(self.json, [model])
        folder = self.pictures
        if folder is not None and folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
            raise OutputExistsError(Fact("pictures-exist", path=str(folder)))
        if self.apply is not None and self.apply.exists():
            raise OutputExistsError(Fact("metric-model-exists", path=str(self.apply)))
        if self.apply is not None and not unscaled:
            raise InertialError(Fact("apply-needs-unscaled"))


@dataclass(frozen=True, kw_only=True)
class KnownLengths:
    """Known lengths in a scene beside the target.

    Attributes
    ----------
    bars, check_points
        Tables of distances between markers, and of their coordinates.
    other
        Specification of a second target in the scene, and the metres between the middles of both, as ``4.03`` or
        ``4.03+-0.002`` with how well they are known.
    """

    bars: Path | None = None
    check_points: Path | None = None
    other: tuple[str, str] | None = None

    def second_target(self, first: Target) -> tuple[Target, float, float | None] | None:
        """The second target, metres between both, and their standard deviation; ``None`` without one.

        Raises
        ------
        InertialError
            Where the kinds of the targets do not go with what is known.
        """
        if (self.bars is not None or self.check_points is not None) and first.kind != "aruco":
            raise InertialError(Fact("markers-needed"))
        if self.other is None:
            return None
        second = parse_target(self.other[0])
        metres, sigma_m = _metres_apart(self.other[1])
        if "aruco" in (first.kind, second.kind):
            raise InertialError(Fact("other-target-of-markers"))
        if second.spec == first.spec:
            raise InertialError(Fact("other-target-the-same"))
        return second, metres, sigma_m


def validate_source(
    model: Path,
    images: Path,
    target: str,
    options: ValidateOptions,
    outputs: ValidationOutputs = ValidationOutputs(),
    known: KnownLengths = KnownLengths(),
) -> Validation:
    """Measure a target in a model and write what was found.

    Parameters
    ----------
    model, images, target
        COLMAP model folder, folder of its images, specification of the target.
    options
        Of the validation.
    outputs
        Where to write it.
    known
        What else is known of the scene.

    Raises
    ------
    InertialError
        When ``apply`` is asked for and cannot be done; see also :func:`validate_model`.
    """
    parsed = parse_target(target)
    refuse_links_around(model, images)
    outputs.check(model, unscaled=options.unscaled)
    folder = only_model(model)
    second = known.second_target(parsed)
    result = validate_model(folder, images, parsed, options)
    if second is not None:
        result = add_other_target(result, validate_model(folder, images, second[0], options), second[1], second[2])
    if known.bars is not None:
        result = add_bars(result, known.bars)
    if known.check_points is not None:
        result = add_check_points(result, known.check_points)
    if outputs.apply is not None:
        if result.control is None:
            raise InertialError(Fact("corners-too-few-to-keep-apart"))
        low, high = result.control.ci95
        sigma_log = np.log(high / low) / (2 * 1.96)
        provenance = f"control distances of {parsed.spec}"
        apply_similarity(folder, outputs.apply, scaling(result.control.metres_per_unit, sigma_log, provenance))
    if outputs.json is not None:
        write_json(outputs.json, result.as_json())
    if outputs.pictures is not None:
        write_overlays(result, images, outputs.pictures)
    return result


def scaling(metres_per_unit: float, sigma_log: float, provenance: str) -> Similarity:
    """A similarity that only scales."""
    cov = np.zeros((7, 7))
    cov[0, 0] = sigma_log**2
    rotation = np.array([0.0, 0.0, 0.0, 1.0])
    return Similarity(
        scale=metres_per_unit, rotation_xyzw=rotation, translation_m=np.zeros(3), cov=cov, provenance=provenance
    )


def _metres_apart(text: str) -> tuple[float, float | None]:
    """A length, and its standard deviation where that is said."""
    length, length_m, sigma = text.partition("+-")
    try:
        metres, sigma_m = float(length), float(sigma) if length_m else None
    except ValueError:
        metres, sigma_m = float("nan"), None
    if not 0 < metres < float("inf") or (sigma_m is not None and not 0 < sigma_m < metres):
        raise InertialError(Fact("other-target-length", text=text))
    return metres, sigma_m
