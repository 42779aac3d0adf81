"""Rotation of a camera between images seconds apart: photographs, keyframes, frames cut once a second.

There the camera has moved, too, and the pixels' motion is no rotation. Features are matched, the geometry of two views
with unknown translation is fitted (the five-point method of Nister, 2004, and RANSAC) and refined (``epipolar``). A
rotation is kept only where it agrees with those to the image after: around a triangle of three images rotations must
close.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, IndexArray
from colmap_inertial.core.geometry import so3_log
from colmap_inertial.core.types import FrameTiming, Projector
from colmap_inertial.imaging.rolling_shutter import append_unit_depth
from colmap_inertial.motion.epipolar import refine_poses
from colmap_inertial.motion.flow import GreyFrame, VisualRotation

#: Longer side of images that are compared (the 45 of the desk: 6.2 CPU-s, 10.8 at 640 px; rotations differ by .07
#: degrees).
COMPARED_PX = 400


@dataclass(frozen=True, kw_only=True)
class TwoViewLimits:
    """Limits for the rotation between two views."""

    #: Features of an image.
    features: int = 1000
    #: Matches of two images that must agree.
    least_matches: int = 40
    #: How far a match may lie off, px of the reduced image.
    off_px: float = 1.5
    #: Matches weigh less in the rotation of a camera that did not move beyond so much, px of the reduced image.
    turned_px: float = 3.0
    #: Matches of a pair that its pose is refined by.
    refined_matches: int = 200
    #: A match is clear where the second best is this much further away.
    ratio: float = 0.8
    #: Three rotations around a triangle close to within this.
    closed_rad: float = 0.05


_LIMITS = TwoViewLimits()


@dataclass(frozen=True, eq=False)
class _Features:
    """The features of one image: pixels, rays (z = 1), descriptors."""

    rays: Array
    descriptors: Float32Array
    pixel_rad: float


def measure_two_view_rotations(frames: Iterable[GreyFrame], camera: Projector, timing: FrameTiming) -> VisualRotation:
    """Rotations of the camera between images that follow each other.

    Parameters
    ----------
    frames
        Reduced to about :data:`COMPARED_PX`, in order of time, all of one size; the features of three are held at a
        time.
    camera
        Intrinsics with distortion; a guess of the focal length serves to tell whether a gyroscope belongs to them.
    timing
        Holds every frame.

    Returns
    -------
    As of ``flow.measure_rotation``, NaN where no triangle of images closes.
    """
    index = {name: i for i, name in enumerate(timing.names)}
    names: list[str] = []
    seen: list[_Features] = []
    next_one: list[tuple[Array, int] | None] = []
    after_next: list[tuple[Array, int] | None] = []
    for frame in frames:
        seen.append(_detect_features(frame, camera))
        names.append(frame.name)
        if len(seen) > 1:
            next_one.append(_estimate_rotation(seen[-2], seen[-1]))
        if len(seen) > 2:
            after_next.append(_estimate_rotation(seen[-3], seen[-1]))
            del seen[0]
    turns = np.full((max(len(names) - 1, 0), 3), np.nan)
    off = np.full(len(turns), np.inf)
    support = np.zeros(len(turns), dtype=np.intp)
    for i, across in enumerate(after_next):
        first, second = next_one[i], next_one[i + 1]
        if across is None or first is None or second is None:
            continue
        open_rad = float(np.linalg.norm(so3_log(first[0] @ second[0] @ across[0].T)))
        for k, (rotation, count) in ((i, first), (i + 1, second)):
            if open_rad < min(_LIMITS.closed_rad, off[k]):
                turns[k], off[k], support[k] = so3_log(rotation), open_rad, count
    return VisualRotation(
        names=tuple(names),
        t_s=timing.pose_t_s()[[index[name] for name in names]],
        turn_rad=turns,
        sigma_rad=np.where(np.isfinite(off), np.maximum(off, 1e-3), np.nan),
        support=support,
        epoch_ns=timing.epoch_ns,
    )


def _detect_features(frame: GreyFrame, camera: Projector) -> _Features:
    import cv2

    grey = frame.grey
    points, descriptors = cv2.SIFT.create(_LIMITS.features).detectAndCompute(grey, None)
    to_full = np.array([frame.width / grey.shape[1], frame.height / grey.shape[0]])
    centre = np.array([[frame.width / 2, frame.height / 2]])
    xy_px = (np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2) + 0.5) * to_full
    rays = np.asarray(camera.cam_from_img(np.concatenate([xy_px, centre, centre + to_full])))[:, :2]
    ok = np.isfinite(rays[:-2]).all(axis=1)
    known = np.zeros((0, 128), np.float32) if descriptors is None else descriptors
    return _Features(
        rays=rays[:-2][ok],
        descriptors=known[ok],
        pixel_rad=float(np.linalg.norm(rays[-1] - rays[-2])) / 2**0.5,
    )


def _estimate_rotation(first: _Features, second: _Features) -> tuple[Array, int] | None:
    """(3, 3) ``first_from_second`` and the matches that agree; ``None`` where too few do."""
    import cv2

    if min(len(first.rays), len(second.rays)) < _LIMITS.least_matches:
        return None
    pairs = _match_descriptors(first.descriptors, second.descriptors)
    if len(pairs) < _LIMITS.least_matches:
        return None
    a, b = first.rays[pairs[:, 0]], second.rays[pairs[:, 1]]
    reach = _LIMITS.off_px * first.pixel_rad
    essential, inside = cv2.findEssentialMat(
        a, b, np.eye(3), method=cv2.USAC_FAST, prob=0.999, threshold=reach, maxIters=1000
    )
    if essential is None or essential.shape != (3, 3) or np.count_nonzero(inside) < _LIMITS.least_matches:
        return None
    kept = inside.ravel() > 0
    a, b = a[kept], b[kept]
    a, b = (_unit_rays(rays) for rays in (a, b))
    pure = _fit_pure_rotation(a, b, _LIMITS.turned_px * first.pixel_rad).T
    *twins, move = cv2.decomposeEssentialMat(essential)
    # half a turn about the translation apart
    nearest = min(twins, key=lambda turn: float(np.linalg.norm(so3_log(pure.T @ turn))))
    some = np.linspace(0, len(a) - 1, _LIMITS.refined_matches).astype(np.intp)
    rays = np.stack([a[some], b[some]])[:, None].repeat(2, axis=1)
    # of a camera that hardly moved, the essential matrix is poor
    found = refine_poses(np.stack([nearest, pure]), np.stack([move.ravel()] * 2), *rays)
    return found.second_from_first[int(np.argmin(found.usual_rad))].T, len(a)


def _unit_rays(rays: Array) -> Array:
    rays = append_unit_depth(rays)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _match_descriptors(first: Float32Array, second: Float32Array) -> IndexArray:
    """(M, 2) pairs of descriptors that are clearly nearest: all distances at once, in half the time of cv2.BFMatcher.

    SIFT's values are whole numbers, of which float32 holds the squares exactly.
    """
    off = np.sum(first**2, axis=1)[:, None] + np.sum(second**2, axis=1) - 2 * (first @ second.T)
    nearest, two = np.argmin(off, axis=1), np.partition(off, 1, axis=1)[:, :2]
    clear = np.flatnonzero(two[:, 0] < _LIMITS.ratio**2 * two[:, 1])
    return np.stack([clear, nearest[clear]], axis=1)


def _fit_pure_rotation(a: Array, b: Array, reach: float) -> Array:
    """The rotation ``a_from_b`` that turns most unit rays into each other."""
    weight = np.ones(len(a))
    for _ in range(10):
        u, _, vt = np.linalg.svd((a * weight[:, None]).T @ b)
        rotation = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
        off = np.linalg.norm(a - b @ rotation.T, axis=1)
        weight = 1 / (1 + (off / reach) ** 2) ** 2
    return np.asarray(rotation)
