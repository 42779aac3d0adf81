"""Scale of a model from depth maps: depths of its points against what the maps have at their keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.progress import Progress, silent
from colmap_inertial.core.types.depth import DepthMaps
from colmap_inertial.core.types.seen_points import SeenPoints
from colmap_inertial.evidence._surface import Surface, fit_surface
from colmap_inertial.evidence.depth import DepthScale, robust_mean


@dataclass(frozen=True, kw_only=True)
class PointLimits:
    """Which images and points are compared, and how few are too few."""

    #: Images along the recording that are compared.
    images: int = 150
    #: Points of an image, and images.
    points: int = 8
    fewest: int = 4
    #: Shapes of image and map differ by this at most: the rounding of a map's size.
    shape: float = 0.02


_LIMITS = PointLimits()


def scale_by_points(
    maps: DepthMaps, seen: Sequence[SeenPoints], *, limits: PointLimits = _LIMITS, progress: Progress = silent
) -> DepthScale:
    """Metres per unit of a model.

    Maps show what the images show, in other pixels. Keypoints at edges and where a map does not measure do not count.

    Parameters
    ----------
    maps
        Joined with the images by their names.
    seen
        Points by image, in the order of time.

    Raises
    ------
    NotObservableError
        Where too few images have maps that measure enough of their points, or maps are cut or turned otherwise than
        the images.
    """
    named = set(maps.names)
    having = [one for one in seen if one.name in named]
    if not having:
        raise NotObservableError("scale", Fact("depth-without-images", maps=len(maps), images=len(seen)))
    chosen = np.unique(np.linspace(0, len(having) - 1, limits.images).round().astype(np.intp)).tolist()
    rows = []
    for done, k in enumerate(chosen):
        one = having[k]
        surface = fit_surface(maps.read(one.name))
        view = surface.source.view
        if abs(one.width * view.height / (one.height * view.width) - 1) > limits.shape:
            shapes = {"width": view.width, "height": view.height, "of_width": one.width, "of_height": one.height}
            raise NotObservableError("scale", Fact("depth-of-other-images", name=one.name, **shapes))
        found = _scale_of_image(surface, one, limits)
        if found is not None:
            rows.append((one.t_s, *found))
        progress("depth", done + 1, len(chosen))
    if len(rows) < limits.fewest:
        raise NotObservableError("scale", Fact("depth-images-too-few", count=len(rows), needed=limits.fewest))
    table = np.array(rows)
    return DepthScale(t_s=table[:, 0], log_scale=table[:, 1], sigma=table[:, 2], is_fused=maps.is_fused)


def _scale_of_image(surface: Surface, seen: SeenPoints, limits: PointLimits) -> tuple[float, float] | None:
    """Logarithm of metres per unit by one image, and its standard deviation; ``None`` where few points tell."""
    view = surface.source.view
    u, v = (seen.xy_px * (view.width / seen.width, view.height / seen.height)).T
    column, row = np.floor(u).astype(np.intp), np.floor(v).astype(np.intp)
    inside = (column >= 0) & (column < view.width) & (row >= 0) & (row < view.height)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    slope = surface.slope[row, column]
    inverse = surface.inverse[row, column] + slope[:, 0] * (u - column - 0.5) + slope[:, 1] * (v - row - 0.5)
    told = inside & surface.smooth[row, column] & (inverse > 0)
    if told.sum() < limits.points:
        return None
    logs = -np.log(inverse[told]) - np.log(seen.depth[told])
    # what the map scatters by about its planes is in each point, as well as what the images leave open
    sigmas = np.hypot(seen.sigma_log[told], surface.noise[row, column][told] / inverse[told])
    mean = robust_mean(logs, sigmas)
    spread = 1.4826 * float(np.median(np.abs(logs - mean)))
    least = float(1 / np.sqrt(np.sum(1 / sigmas**2)))
    return mean, max(least, spread / np.sqrt(told.sum()))
