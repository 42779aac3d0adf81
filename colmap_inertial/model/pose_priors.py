"""Pose priors of a database against a model that is in metres now: how far apart both have the same images."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.earth import ecef_from_enu, ecef_of_geodetic
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Similarity
from colmap_inertial.model.database import PlacedModel, read_priors

#: So many images tell at least.
_FEWEST = 4
#: Positions that scatter by more than this share of how far they reach say little.
_SCATTERED = 0.3
#: What is as large within this share is alike, whatever the scatter: models bend by as much.
_ALIKE = 0.01


@dataclass(frozen=True, kw_only=True)
class PriorComparison:
    """How many times as far apart priors are as a model's cameras, and its standard deviation; ``nan`` where unknown.

    Errors of receivers stay alike from image to image: as many of them are no surer than one.
    """

    ratio: float
    sigma: float

    @classmethod
    def of(cls, places: Array, centres: Array) -> PriorComparison:
        """Of (N, 3) priors and (N, 3) centres, by the similarity between both (Umeyama 1991)."""
        nothing = cls(ratio=float("nan"), sigma=float("nan"))
        if len(places) < _FEWEST:
            return nothing
        p, c = places - places.mean(axis=0), centres - centres.mean(axis=0)
        u, values, vt = np.linalg.svd(p.T @ c)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        square = float(np.sum(c**2))
        ratio = float(values @ sign) / square if square > 0 else 0.0
        if not ratio > 0:
            return nothing
        off = p - ratio * c @ (u @ np.diag(sign) @ vt).T
        share = float(np.sqrt(np.sum(off**2) / square)) / ratio
        return cls(ratio=ratio, sigma=ratio * share) if share < _SCATTERED else nothing


def compare_priors(
    database: Path,
    name: str,
    models: Sequence[PlacedModel],
    similarities: Mapping[int, Similarity | None],
    *,
    moved: Collection[int],
) -> list[Fact]:
    """What the user is told of priors that stay: in degrees, and in a frame of their own.

    Parameters
    ----------
    database, name
        Before anything moved in it, and what it is called.
    models, similarities
        The sub-models before theirs, and what was applied to each by number.
    moved
        Numbers of the models whose priors, but those in degrees, moved with them.
    """
    facts = []
    for in_degrees, priors in read_priors(database).items():
        for model in models:
            similarity = similarities[model.index]
            shared = sorted(priors.keys() & model.centres.keys())
            if similarity is None or not shared or (model.index in moved and not in_degrees):
                continue
            places = np.array([priors[image] for image in shared])
            centres = similarity.scale * np.array([model.centres[image] for image in shared])
            found = PriorComparison.of(_east_north_up(places) if in_degrees else places, centres)
            facts.append(_describe(found, name, len(shared), similarity, in_degrees=in_degrees))
    return facts


def _describe(found: PriorComparison, name: str, count: int, similarity: Similarity, *, in_degrees: bool) -> Fact:
    kind = "in degrees (WGS84)" if in_degrees else "in a frame of their own"
    if np.isnan(found.ratio):
        return Fact("priors-say-little", file=name, count=count, kind=kind)
    sigma = float(np.hypot(found.sigma, found.ratio * similarity.cov[0, 0] ** 0.5))
    code = "priors-agree" if abs(found.ratio - 1) <= max(2 * sigma, _ALIKE) else "priors-contradict"
    return Fact(code, file=name, count=count, kind=kind, ratio=found.ratio, sigma=sigma)


def _east_north_up(geodetic: Array) -> Array:
    """(N, 3) metres from the first of (N, 3) latitude, longitude and height; without heights, all are alike."""
    geodetic = np.where(np.isfinite(geodetic), geodetic, 0.0)
    ecef = ecef_of_geodetic(geodetic)
    return np.asarray((ecef - ecef[0]) @ ecef_from_enu(*geodetic[0, :2].tolist()))
