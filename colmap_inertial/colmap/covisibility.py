"""Whether two images show the same, by their largest features alone: a hundredth of the work of matching them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray, UInt8Array
from colmap_inertial.core.threads import one_blas_thread

#: Features of each image that vote.
_VOTERS = 500
#: A vote: the nearest descriptor is nearer than this share of the next one's angle, and than this angle (COLMAP's).
_RATIO, _FARTHEST_RAD = 0.7, 0.7
#: COLMAP stores descriptors of this length.
_LENGTH = 512.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Covisibility:
    """The largest features of each image.

    Attributes
    ----------
    descriptors
        Of each image (K, 128), as COLMAP stores them.
    xy_px
        Of each image (K, 2).
    """

    descriptors: tuple[UInt8Array, ...]
    xy_px: tuple[Array, ...]

    @classmethod
    def of(cls, database: Path, names: Sequence[str]) -> Covisibility:
        """Of images, from a database that holds their features."""
        import pycolmap

        descriptors, places = [], []
        with pycolmap.Database.open(str(database)) as opened:
            images = {image.name: image.image_id for image in opened.read_all_images()}
            for name in names:
                keypoints = np.array(opened.read_keypoints(images[name]), dtype=np.float64).reshape(-1, 6)
                size = np.hypot(keypoints[:, 2], keypoints[:, 4])
                largest = np.argsort(-size, kind="stable")[:_VOTERS]
                stored = np.array(opened.read_descriptors(images[name]).data, dtype=np.uint8).reshape(-1, 128)
                descriptors.append(stored[largest])
                places.append(keypoints[largest, :2])
        return cls(descriptors=tuple(descriptors), xy_px=tuple(places))

    @property
    def plenty(self) -> BoolArray:
        """(N,) which images have features enough for few votes to mean something."""
        return np.array([len(own) == _VOTERS for own in self.descriptors], dtype=np.bool_)

    def count(self, i: IndexArray, j: IndexArray) -> IndexArray:
        """(M,) votes that images i and j, (M,) each, show the same."""
        counted = np.zeros(len(i), dtype=np.intp)
        with one_blas_thread():
            for place in range(len(i)):
                counted[place] = _votes(self.descriptors[i[place]], self.descriptors[j[place]])
        return counted


def _votes(first: UInt8Array, second: UInt8Array) -> int:
    """Mutually nearest descriptors that are clearly nearer than the next."""
    if len(first) < 2 or len(second) < 2:
        return 0
    cosine = first.astype(np.float32) @ second.astype(np.float32).T / np.float32(_LENGTH**2)
    row = np.arange(len(first))
    nearest = cosine.argmax(axis=1)
    best = cosine[row, nearest]
    mutual = cosine.argmax(axis=0)[nearest] == row
    cosine[row, nearest] = -1
    near = np.flatnonzero(mutual & (best > np.cos(_FARTHEST_RAD)))
    angle, next_angle = (np.arccos(np.clip(c, -1, 1)) for c in (best[near], cosine[near].max(axis=1, initial=-1)))
    return int(np.count_nonzero(angle < _RATIO * next_angle))
