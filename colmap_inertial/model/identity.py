"""Of which model a scale is: number of images and points, and a digest of names and poses."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.model.database import PlacedModel

if TYPE_CHECKING:
    import pycolmap

#: Cameras of the same model agree to this share of its size, whatever wrote it.
_SAME = 1e-6


@dataclass(frozen=True, kw_only=True)
class ModelIdentity:
    """What tells a model from others.

    Attributes
    ----------
    images, points
        How many; points may be cleaned since.
    names
        Digest of the images' names.
    poses
        Digest of names and camera centres, to a millionth of the model's size.
    thirds
        (3, 3) means of the camera centres of each third of the images, by name: model units.
    size
        Root mean square distance of the cameras from their mean.
    """

    images: int
    points: int
    names: str
    poses: str
    thirds: tuple[tuple[float, ...], ...]
    size: float

    def difference(self, model: PlacedModel) -> str | None:
        """What differs in another model, in words; ``None`` where it is the same."""
        other = _identify(model.centres, self.points)
        if other.images != self.images:
            return f"{self.images} images instead of {other.images}"
        if other.names != self.names:
            return "its images have other names"
        own, there = np.array(self.thirds), np.array(other.thirds)
        near = max(self.size, other.size) * _SAME + np.abs(own).max() * 1e-12
        if abs(self.size - other.size) > near or not np.abs(own - there).max() <= near:
            return "its cameras stand elsewhere"
        return None

    def as_json(self) -> dict[str, object]:
        """The fields in JSON types."""
        return asdict(self)

    @classmethod
    def of(cls, model: pycolmap.Reconstruction) -> ModelIdentity:
        """Of a model."""
        images = [model.image(number) for number in model.reg_image_ids()]
        return _identify({image.name: image.projection_center() for image in images}, model.num_points3D())


def identity_from_json(path: Path, fields: Any) -> ModelIdentity | None:
    """What :meth:`ModelIdentity.as_json` wrote; ``None`` where there is none.

    Raises
    ------
    FormatError
        For anything else.
    """
    if fields is None:
        return None
    try:
        return ModelIdentity(
            images=int(fields["images"]),
            points=int(fields["points"]),
            names=str(fields["names"]),
            poses=str(fields["poses"]),
            thirds=tuple(tuple(float(value) for value in row) for row in fields["thirds"]),
            size=float(fields["size"]),
        )
    except (KeyError, TypeError, ValueError):
        raise FormatError(path, Fact("of-model-unreadable")) from None


def _identify(centres: Mapping[str, Array], points: int) -> ModelIdentity:
    names = sorted(centres)
    xyz = np.array([centres[name] for name in names]).reshape(-1, 3)
    middle = xyz.mean(axis=0) if len(xyz) else np.zeros(3)
    size = float(np.sqrt(np.mean(np.sum((xyz - middle) ** 2, axis=1)))) if len(xyz) else 0.0
    steps = np.round(xyz / (_SAME * size)) if size > 0 else np.zeros_like(xyz)
    rows = "\n".join(f"{name}\0{x:.0f} {y:.0f} {z:.0f}" for name, (x, y, z) in zip(names, steps.tolist(), strict=True))
    parts = [part for part in np.array_split(xyz, 3) if len(part)]
    thirds = [part.mean(axis=0) for part in parts] + [middle] * (3 - len(parts))
    return ModelIdentity(
        images=len(names),
        points=points,
        names=_digest("\0".join(names)),
        poses=_digest(rows.replace("-0 ", "0 ")),
        thirds=tuple(tuple(third.tolist()) for third in thirds),
        size=size,
    )


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:32]
