"""Similarities from an estimated scale, a file, or a factor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import set_fields
from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError
from colmap_inertial.core.facts import Fact, as_fact, read_facts, with_sentences
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_from_matrix
from colmap_inertial.core.options import WorldAxes
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.core.types import ScaleEstimate, Similarity
from colmap_inertial.io.files import StrPath, read_json, reader, reading
from colmap_inertial.model import similarity_as_json
from colmap_inertial.model.identity import ModelIdentity, identity_from_json

#: What an estimate's file says of the model that it is of.
OF_MODEL = "of_model"


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class ModelScale:
    """Similarity of one sub-model.

    Attributes
    ----------
    similarity
        ``None`` where the scale was refused: the sub-model keeps its own units.
    verdict, reasons
        Of the scale estimate; ``None`` and empty where the user gave the similarity.
    joined_of
        The sub-models whose images it holds as well since it was joined of them; empty where it is one by itself.
    left_out
        Images that are not in the metric model, as they contradict the gyroscope.
    identity
        Of which model it is, where that is known.
    of_file
        Whether it was read from a file.
    """

    similarity: Similarity | None
    verdict: str | None = None
    reasons: tuple[Fact, ...] = ()
    joined_of: tuple[int, ...] = ()
    left_out: tuple[str, ...] = ()
    identity: ModelIdentity | None = None
    of_file: bool = False

    def __post_init__(self) -> None:
        set_fields(self, reasons=tuple(map(as_fact, self.reasons)))

    def as_json(self) -> dict[str, object]:
        """The fields in JSON types."""
        similarity = None if self.similarity is None else similarity_as_json(self.similarity)
        joined = {"joined_of": list(self.joined_of)} if self.joined_of else {}
        left_out = {"left_out": list(self.left_out)} if self.left_out else {}
        reasons = with_sentences({"reasons": list(self.reasons)})
        return {"verdict": self.verdict, **reasons, "similarity": similarity, **joined, **left_out}


def similarity_from_json(path: Path, fields: Mapping[str, Any]) -> Similarity:
    """The similarity that :func:`similarity_as_json` wrote; ``path`` is for messages.

    ``scale`` is required. Without ``rotation_xyzw`` nothing turns, without ``translation_m`` the origin stays, without
    ``cov`` the similarity counts as exact.

    Raises
    ------
    FormatError
        For a field that is missing, of another type, or not finite.
    """
    if "scale" not in fields:
        raise FormatError(path, Fact("no-similarity"))
    arrays = {}
    for name, shape, default in (
        ("rotation_xyzw", (4,), [0.0, 0.0, 0.0, 1.0]),
        ("translation_m", (3,), [0.0] * 3),
        ("cov", (7, 7), np.zeros((7, 7))),
    ):
        value = fields.get(name)
        try:
            array = np.array(default if value is None else value)
        except ValueError:
            array = np.array(None)
        if array.dtype.kind not in "fiu" or array.shape != shape:
            raise FormatError(path, Fact("field-not-of-shape", name=name, shape=shape))
        arrays[name] = array.astype(np.float64)
    scale, provenance, undoes = fields["scale"], fields.get("provenance", ""), fields.get("undoes")
    if isinstance(scale, bool) or not isinstance(scale, int | float):
        raise FormatError(path, Fact("scale-not-a-number"))
    if not isinstance(provenance, str):
        raise FormatError(path, Fact("field-not-text", name="provenance"))
    if not isinstance(undoes, str | None):
        raise FormatError(path, Fact("field-not-text", name="undoes"))
    try:
        return Similarity(scale=float(scale), provenance=provenance, undoes=undoes, **arrays)
    except (ValueError, OverflowError) as error:
        raise FormatError(path, Fact("invalid-values", detail=str(error))) from None


@reader("a similarity")
def read_similarity(path: StrPath) -> Similarity:
    """Read a similarity: a JSON object with ``scale``, ``rotation_xyzw``, ``translation_m``, ``cov``, ``provenance``.

    Raises
    ------
    FormatError
        For what is none; see :func:`similarity_from_json`.
    """
    path = Path(path)
    return similarity_from_json(path, read_json(path))


def plain_factor(factor: float) -> Similarity:
    """Lengths times a factor, origin and axes kept.

    Raises
    ------
    ValueError
        When it is not positive.
    """
    if not (math.isfinite(factor) and factor > 0):
        raise ValueError(f"factor must be positive, not {factor:g}")
    return Similarity(
        scale=factor,
        rotation_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
        translation_m=np.zeros(3),
        cov=np.zeros((7, 7)),
        provenance=f"factor {factor:g}, given by the user",
    )


def invert_similarity(similarity: Similarity) -> Similarity:
    """The inverse, to take back what was applied; as it makes no estimate of anything, its covariance is zero."""
    rotation = matrix_from_quat(similarity.rotation_xyzw)
    return Similarity(
        scale=1 / similarity.scale,
        rotation_xyzw=quat_conjugate(similarity.rotation_xyzw),
        translation_m=-(rotation.T @ similarity.translation_m) / similarity.scale,
        cov=np.zeros((7, 7)),
        provenance=f"undoes: {similarity.provenance}",
        undoes=similarity.provenance,
    )


def compose(move: Similarity, before: Similarity) -> Similarity:
    """``move`` after another one, whose provenance it keeps; as an estimate of neither, its covariance is zero."""
    turn = matrix_from_quat(move.rotation_xyzw)
    return Similarity(
        scale=move.scale * before.scale,
        rotation_xyzw=quat_from_matrix(turn @ matrix_from_quat(before.rotation_xyzw)),
        translation_m=move.scale * turn @ before.translation_m + move.translation_m,
        cov=np.zeros((7, 7)),
        provenance=before.provenance,
        undoes=before.undoes,
    )


def require_not_joined(path: Path, parts: Mapping[int, Sequence[int]]) -> None:
    """Raise :class:`FormatError` where a model was joined of several, by number: it cannot be taken apart again."""
    for index, numbers in parts.items():
        if numbers:
            raise FormatError(
                path,
                Fact("joined-of-models", model=index, numbers=tuple(numbers)),
            )


def read_scales(sources: Sequence[str], *, world: WorldAxes = "z-up") -> dict[int | None, ModelScale]:
    """Read scale estimates, by sub-model.

    Parameters
    ----------
    sources
        Files that ``colmap-inertial scale --json`` wrote, as ``FILE`` for a project's only model or ``NUMBER=FILE`` for
        one of several; or the ``result.json`` of a reconstruction, which has a scale for each.
    world
        Where gravity points afterwards.

    Returns
    -------
    dict
        By number; the key is ``None`` for a file that does not say which model it is about.

    Raises
    ------
    FormatError
        For what is no scale estimate.
    InertialError
        When a model has two scales.
    NotObservableError
        When every scale was refused.
    """
    scales: dict[int | None, ModelScale] = {}
    for source in sources:
        for key, scale in _scales_of(source, world):
            if key in scales or (None in scales) != (key is None and bool(scales)):
                raise InertialError(Fact("two-scales-for-one-model", source=source))
            scales[key] = scale
    if scales and all(scale.similarity is None for scale in scales.values()):
        raise NotObservableError(
            "scale",
            Fact("scale-refused", reasons=tuple(reason for scale in scales.values() for reason in scale.reasons)),
        )
    return scales


def _scales_of(source: str, world: WorldAxes) -> list[tuple[int | None, ModelScale]]:
    """Parse ``FILE`` or ``NUMBER=FILE``."""
    number, equals, name = source.partition("=")
    is_numbered = bool(equals) and number.isascii() and number.isdigit() and not Path(source).exists()
    path = Path(name if is_numbered else source)
    with reading(path, Fact("not-readable-as", what="a scale estimate")):
        content = read_json(path)
        if is_numbered or not isinstance(content.get("models"), list):
            return [(int(number) if is_numbered else None, _model_scale(path, content, world))]
        entries = [(_colmap_index(model), model) for model in content["models"]]
        if not all(isinstance(i, int) for i, _ in entries):
            raise FormatError(path, Fact("models-without-index"))
        fragments = _fragments(path, content.get("fragments") or [])
        return [*fragments, *((i, _model_scale(path, model, world)) for i, model in entries)]


def _colmap_index(fields: Any) -> Any:
    """COLMAP's number of a model in a result; version 0.1 had no other."""
    return fields.get("colmap_index", fields.get("index")) if isinstance(fields, dict) else None


def _fragments(path: Path, entries: Any) -> list[tuple[int | None, ModelScale]]:
    """Models that a result left out, which keep their own units."""
    numbers = [_colmap_index(entry) for entry in entries] if isinstance(entries, list) else [None]
    if not all(isinstance(number, int) for number in numbers):
        raise FormatError(path, Fact("fragments-without-index"))
    left_out = ModelScale(similarity=None, verdict="refused", reasons=(Fact("fragment"),))
    return [(number, left_out) for number in numbers]


def _model_scale(path: Path, fields: Any, world: WorldAxes) -> ModelScale:
    if not isinstance(fields, dict) or not {"metres_per_unit", "verdict"} <= fields.keys():
        raise FormatError(path, Fact("not-a-scale-estimate"))
    numbers = ("metres_per_unit", "sigma_log")
    if any(isinstance(fields.get(name), bool | str | list | dict) for name in numbers):
        raise FormatError(path, Fact("fields-not-numbers", names=numbers))
    reasons = fields.get("reasons")
    if not isinstance(reasons, list) or not all(isinstance(reason, str) for reason in reasons):
        raise FormatError(path, Fact("reasons-not-texts"))
    if fields["verdict"] not in ("trusted", "weak", "refused"):
        raise FormatError(path, Fact("verdict-unknown", verdict=fields["verdict"]))
    try:
        estimate = ScaleEstimate(
            metres_per_unit=fields["metres_per_unit"],
            sigma_log=fields.get("sigma_log"),
            ci95=None if fields.get("ci95") is None else tuple(fields["ci95"]),
            verdict=fields["verdict"],
            method=str(fields.get("method", "unknown")),
            reasons=read_facts(fields, "reasons"),
            gravity_in_world_m_s2=fields.get("gravity_in_world_m_s2"),
            cov=fields.get("cov"),
        )
    except (ValueError, TypeError) as error:
        raise FormatError(path, Fact("scale-estimate-invalid", detail=str(error))) from None
    similarity = None
    if estimate.verdict != "refused":
        if estimate.gravity_in_world_m_s2 is None:
            raise FormatError(path, Fact("gravity-of-scale-missing"))
        provenance = f"inertial scale, method {estimate.method}, {estimate.verdict}, from {path.name}"
        similarity = Similarity.from_scale(estimate, world=world, provenance=provenance)
    left_out = () if similarity is None else _read_left_out(path, fields.get("rotations"))
    return ModelScale(
        similarity=similarity,
        verdict=estimate.verdict,
        reasons=estimate.reasons,
        left_out=left_out,
        identity=identity_from_json(path, fields.get(OF_MODEL)),
        of_file=True,
    )


def _read_left_out(path: Path, rotations: Any) -> tuple[str, ...]:
    """Images that an estimate left out, registered again, or joined: in COLMAP's model, they are in the wrong place.

    None where it was made before cameras were compared.
    """
    if rotations is None:
        return ()
    fields = rotations if isinstance(rotations, dict) else {}
    names = [fields.get("left_out"), fields.get("registered_again", []), fields.get("joined", [])]
    if not all(isinstance(some, list) and all(isinstance(name, str) for name in some) for some in names):
        raise FormatError(path, Fact("rotations-not-names"))
    return tuple(name for some in names for name in some)
