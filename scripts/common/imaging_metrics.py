"""What a picture is worth to structure from motion: features, matches, and the usual measures of both.

Repeatability and localisation error as in Mustaniemi et al., "Fast Motion Deblurring for Feature Detection and Matching
Using Inertial Measurements" (ICPR 2018), who follow Mikolajczyk et al. (IJCV 2005), here by points: of the keypoints of
both frames that lie in the part that both see, those that have one of the other frame, mutually the nearest, within
3 px of where the true motion puts them, as a share of the smaller number of keypoints; and the mean distance of those.
The strongest 1000 keypoints of each frame count (by scale, then as COLMAP orders them): with thousands of them, chance
alone would put some near.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from colmap_inertial.core.arrays import Array, BoolArray, Float32Array, IndexArray, UInt8Array
from scripts.common.imaging_scenes import Pair

CORRECT_PX = 3.0
STRONGEST = 1000
#: Keypoints so close to the border are left out: filters know nothing of what lies beyond.
BORDER_PX = 10.0


@dataclass(frozen=True, eq=False)
class Features:
    """(N, 2) keypoints, COLMAP's pixel coordinates; (N,) scales; (N, 128) float32 descriptors of length 1."""

    points_px: Array
    scale_px: Array
    descriptors: Float32Array


_first_octave = -1


def set_first_octave(octave: int) -> None:
    """For all that follows: -1 is COLMAP's default, 0 leaves out the octave at twice the image's size."""
    global _first_octave
    _first_octave = octave


@lru_cache
def _extractor(first_octave: int) -> Any:
    import zlib  # noqa: F401  (before pycolmap: both bring a copy)

    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = 1
    options.sift.first_octave = first_octave
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return pycolmap.Sift(options, pycolmap.Device.cpu)


def extract(image: UInt8Array, first_octave: int | None = None) -> Features:
    """COLMAP's SIFT at its defaults, but for the first octave (`set_first_octave`); of pictures in colour, of grey."""
    if image.ndim == 3:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    keypoints, descriptors = _extractor(_first_octave if first_octave is None else first_octave).extract(image)
    points = np.asarray(keypoints[:, :2], dtype=np.float64)
    size = np.array(image.shape[::-1])
    inside = ((points > BORDER_PX) & (points < size - BORDER_PX)).all(axis=1)
    return Features(points[inside], np.asarray(keypoints[inside, 2]), np.asarray(descriptors[inside], np.float32))


def match(a: Features, b: Features) -> IndexArray:
    """(M, 2) mutual nearest neighbours that pass the ratio test, as COLMAP does by default (0.8, at most 0.7 rad)."""
    if min(len(a.points_px), len(b.points_px)) < 2:
        return np.zeros((0, 2), dtype=np.intp)
    (there, good), (back, good_back) = _nearest(a.descriptors, b.descriptors), _nearest(b.descriptors, a.descriptors)
    index = np.flatnonzero(good & (back[there] == np.arange(len(there))) & good_back[there])
    return np.stack([index, there[index]], axis=1)


def _nearest(a: Float32Array, b: Float32Array) -> tuple[IndexArray, BoolArray]:
    """(N,) the nearest of ``b`` for each of ``a``, and whether it passes the ratio test."""
    best, cosine = np.empty(len(a), dtype=np.intp), np.empty((2, len(a)), dtype=np.float32)
    for i in range(0, len(a), 256):  # few enough to stay in the cache
        table = a[i : i + 256] @ b.T
        part, every = slice(i, i + len(table)), np.arange(len(table))
        best[part] = table.argmax(axis=1)
        cosine[0, part] = table[every, best[part]]
        table[every, best[part]] = -1
        cosine[1, part] = table.max(axis=1)
    first, second = np.arccos(np.clip(cosine, -1, 1))
    return best, (first < 0.8 * second) & (first < 0.7)


def correct_matches(pair: Pair, a: Features, b: Features) -> tuple[int, int]:
    """How many matches are correct, and how many there are."""
    found = match(a, b)
    if not len(found):
        return 0, 0
    truth = pair.transferred(a.points_px[found[:, 0]])
    with np.errstate(invalid="ignore"):
        right = np.linalg.norm(truth - b.points_px[found[:, 1]], axis=1) < CORRECT_PX
    return int(right.sum()), len(found)


def repeatability(pair: Pair, a: Features, b: Features) -> tuple[float, float]:
    """Repeatability, 0 to 1, and mean localisation error, px; see the module's docstring."""
    a_there, b_there = pair.transferred(a.points_px), pair.transferred(b.points_px, source=1)
    a_seen, b_seen = (np.flatnonzero(np.isfinite(x).all(axis=1)) for x in (a_there, b_there))
    a_seen, b_seen = (
        seen[np.argsort(-one.scale_px[seen], kind="stable")[:STRONGEST]] for seen, one in ((a_seen, a), (b_seen, b))
    )
    if not (len(a_seen) and len(b_seen)):
        return 0.0, float("nan")
    tree_a, tree_b = cKDTree(a_there[a_seen]), cKDTree(b.points_px[b_seen])
    distance, there = tree_b.query(a_there[a_seen])
    _, back = tree_a.query(b.points_px[b_seen])
    repeated = (back[there] == np.arange(len(a_seen))) & (distance < CORRECT_PX)
    share = repeated.sum() / min(len(a_seen), len(b_seen))
    return float(share), float(distance[repeated].mean()) if repeated.any() else float("nan")


def psnr_db(image: UInt8Array, truth: UInt8Array, margin: int = 30) -> float:
    """Peak signal to noise ratio, without a margin."""
    inside = (slice(margin, -margin),) * 2
    return float(10 * np.log10(255**2 / np.mean((image[inside].astype(np.float32) - truth[inside]) ** 2)))


def ssim(image: UInt8Array, truth: UInt8Array, margin: int = 30) -> float:
    """Structural similarity (Wang et al. 2004): Gaussian window of 1.5 px, K1 = 0.01, K2 = 0.03."""
    a, b = (i[margin:-margin, margin:-margin].astype(np.float32) / 255 for i in (image, truth))

    def mean(x: Float32Array) -> Float32Array:
        return np.asarray(cv2.GaussianBlur(x, (11, 11), 1.5))

    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b, cov = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2, mean(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    likeness = (2 * mean_a * mean_b + c1) * (2 * cov + c2) / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    return float(likeness.mean())
