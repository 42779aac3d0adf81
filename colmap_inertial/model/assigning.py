"""Which scale each sub-model of a project is given, and about which point it acts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Similarity
from colmap_inertial.model import TRANSFORM_FILE
from colmap_inertial.model.layout import Layout
from colmap_inertial.model.places import Place, about
from colmap_inertial.model.similarities import ModelScale


def assign_scales(
    project: Path, layout: Layout, scales: Similarity | Mapping[int | None, ModelScale]
) -> dict[int, ModelScale]:
    """The scale of each sub-model.

    Raises
    ------
    InertialError
        Where they are not those of the project's sub-models.
    NotObservableError
        Where every one was refused.
    """
    if isinstance(scales, Similarity):
        return {index: ModelScale(similarity=scales) for index in layout.submodels}
    if None in scales:
        if len(layout.submodels) > 1:
            raise InertialError(Fact("scale-for-each-submodel", project=str(project), numbers=tuple(layout.submodels)))
        scales = {next(iter(layout.submodels)): scales[None]}
    if all(scale.similarity is None for scale in scales.values()):
        raise NotObservableError(
            "scale",
            Fact("scale-refused", reasons=tuple(reason for scale in scales.values() for reason in scale.reasons)),
        )
    missing = [index for index in layout.submodels if index not in scales]
    if missing or len(scales) > len(layout.submodels):
        raise InertialError(
            Fact(
                "scales-of-other-submodels", project=str(project), numbers=tuple(layout.submodels), given=tuple(scales)
            )
        )
    return {index: scales[index] for index in layout.submodels}


def require_free_records(project: Path, layout: Layout) -> None:
    """Raise :class:`FormatError` for another program's files by the names of our records."""
    for folder in (Path(), *layout.owners):
        if (path := project / folder / TRANSFORM_FILE).is_file():
            raise FormatError(path, Fact("foreign-record"))


def compare_models(layout: Layout, by_model: Mapping[int, ModelScale], *, any_model: bool) -> list[Fact]:
    """Refuse scales of other models, unless ``any_model``; what the user is told of them, and of nameless ones.

    Raises
    ------
    InertialError
        For the scale of another model.
    """
    placed, facts = {model.index: model for model in layout.placed}, []
    for index, scale in by_model.items():
        if scale.similarity is None or not scale.of_file:
            continue
        if scale.identity is None:
            facts.append(Fact("scale-without-identity"))
            continue
        other = scale.identity.difference(placed[index])
        if other is not None and not any_model:
            raise InertialError(Fact("scale-of-another-model", folder=str(layout.submodels[index]), difference=other))
        if other is not None:
            facts.append(Fact("scale-taken-all-the-same", difference=other))
    return facts


def put_about_places(
    layout: Layout, by_model: Mapping[int, ModelScale], *, about_origin: bool, one_for_all: bool
) -> tuple[dict[int, ModelScale], list[Fact]]:
    """Have similarities of models that lie far from the origin act about a point in their middle, which stays.

    Parameters
    ----------
    layout, by_model
        The models, and what is applied to each.
    about_origin
        Leave them as they are, and only tell of models that they move away.
    one_for_all
        Take the same point for all.

    Returns
    -------
    dict, list of Fact
        The scales, and what the user is told.
    """
    scales, facts = dict(by_model), []
    pivot: Array | None = None
    for model in layout.placed:
        place, similarity = Place.of(model.shown()), scales[model.index].similarity
        if place is None or similarity is None or not place.is_far:
            continue
        folder = str(layout.submodels[model.index])
        if about_origin:
            away = place.moved(similarity)
            distance = float(np.linalg.norm(away.middle - place.middle))
            if distance > away.size:
                facts.append(Fact("moved-away", folder=folder, distance=distance))
            continue
        pivot = pivot if one_for_all and pivot is not None else place.pivot()
        scales[model.index] = replace(scales[model.index], similarity=about(similarity, pivot))
        facts.append(Fact("about-place", folder=folder, pivot=pivot.tolist()))
    if one_for_all and pivot is not None:  # also of models that lie near it
        moved = next(scale.similarity for i, scale in scales.items() if scale is not by_model[i])
        scales = {index: replace(scale, similarity=moved) for index, scale in scales.items()}
    return scales, facts
