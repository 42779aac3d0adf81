"""Choose frames of a video: the least blurred of each stretch with enough baseline.

A video is looked at in small grey images. Corners are followed from image to image; what they moved beyond the
camera's rotation is the baseline. From the last chosen frame on, a window closes when the baseline is enough, when the
image has moved so far that matching would suffer, or when it has lasted long enough; the least blurred frame of its
second half is the next one chosen.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array, UInt8Array
from colmap_inertial.core.geometry import skew, so3_exp
from colmap_inertial.core.types import Projector
from colmap_inertial.imaging.rolling_shutter import append_unit_depth
from colmap_inertial.imaging.tracking import reduce_image, track_points

#: Why a window was closed. start: the first frames; still: it lasted, and nothing moved; end: the last frames.
Closing = Literal["start", "baseline", "motion", "interval", "still", "end"]
#: By what the frames of a window were ranked: the blur or angular speed that the gyroscope predicts, or the image.
Ranking = Literal["blur", "speed", "sharpness"]


@dataclass(frozen=True, kw_only=True)
class FollowerLimits:
    """Limits of tracking corners from image to image."""

    #: Images are followed at this size.
    followed_px: int = 480
    #: Corners that are followed;
    corners: int = 200
    #: how far from there and back they may end, px of the reduced image.
    round_trip_px: float = 0.7
    #: New corners are looked for when fewer than this share are left;
    refill_share: float = 0.7
    #: fewer corners than this tell nothing.
    fewest: int = 12
    #: Rounds of reweighted least squares for a rotation.
    rotation_rounds: int = 6


_LIMITS = FollowerLimits()


@dataclass(frozen=True, kw_only=True)
class WindowLimits:
    """Limits of a window. Lengths are shares of the image's longer side, as medians over the image.

    Attributes
    ----------
    shortest_s, longest_s
        Interval between chosen frames; the longest one as far as the video's frame rate allows.
    baseline
        Motion that rotation does not explain.
    motion, overlap
        All motion, and the share of corners that must stay in view.
    still, still_s
        An image that moved less than this waits so long.
    """

    shortest_s: float
    longest_s: float
    baseline: float = 0.06
    motion: float = 0.2
    overlap: float = 0.6
    still: float = 0.005
    still_s: float = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Ranked:
    """Ranking of the frames before any is decoded.

    Attributes
    ----------
    t_s
        (L,) times, increasing.
    blur
        (L,) what the frames are ranked by, the less the better; NaN where it is unknown: there, images are ranked.
    ranking
        What ``blur`` is.
    sharp_below
        Below this, frames are equally sharp, and the last one is taken, which makes for fewer.
    start_from_cam
        (L, 3, 3) orientations by the gyroscope; NaN where unknown: there, a rotation is fitted to the motion.
    """

    t_s: Array
    blur: Array
    ranking: Ranking = "blur"
    sharp_below: float = 0.0
    start_from_cam: Array


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """A chosen frame, and why.

    Attributes
    ----------
    place
        Among the frames that were looked at.
    closed_by, ranked_by
        See :data:`Closing` and :data:`Ranking`.
    blur
        By which it was ranked; NaN for images.
    first, last
        The frames that it was chosen from.
    baseline, motion
        Since the frame chosen before, shares of the image's longer side; NaN where unknown.
    """

    place: int
    closed_by: Closing
    ranked_by: Ranking
    blur: float
    first: int
    last: int
    baseline: float
    motion: float


@dataclass(frozen=True, eq=False)
class _FollowedImage:
    """An image that was looked at: its corners by number, in shares of the longer side, and its sharpness."""

    place: int
    ids: Int64Array
    xy: Array
    sharpness: float


def choose_frames(
    images: Iterable[UInt8Array], ranked: Ranked, limits: WindowLimits, camera: Projector, *, width: int, height: int
) -> Iterator[Chosen]:
    """Choose frames while looking at them; memory holds one window.

    Parameters
    ----------
    images
        Grey images of the frames to look at, in order, each as large as cheap.
    ranked
        What is known of them beforehand.
    limits
        When a window closes.
    camera
        Intrinsics, COLMAP's pixel coordinates; a guess will do.
    width, height
        Of the frames themselves, px.
    """
    follower = _Follower()
    compare = _Compare(ranked.start_from_cam, camera, width, height)
    seen: list[_FollowedImage] = []
    anchored, checked = False, 1  # how many of ``seen`` are settled
    for place, image in enumerate(images):
        seen.append(follower.step(place, image))
        if not anchored:
            if ranked.t_s[place] - ranked.t_s[0] < limits.shortest_s - 1e-6:
                continue
            chosen = _choose_best(seen, ranked, "start")
            yield chosen
            seen, anchored = [s for s in seen if s.place >= chosen.place], True
        while checked < len(seen):
            closing = _find_closing(seen[0], seen[checked], ranked, limits, compare)
            checked += 1
            if closing is not None:
                chosen = _choose_next(seen[:checked], ranked, limits, compare, closing)
                yield chosen
                # what follows the chosen frame belongs to the next window
                seen, checked = [s for s in seen if s.place >= chosen.place], 1
    if seen and not anchored:
        yield _choose_best(seen, ranked, "start")
    elif seen and ranked.t_s[seen[-1].place] - ranked.t_s[seen[0].place] >= limits.shortest_s - 1e-6:
        yield _choose_next(seen, ranked, limits, compare, "end")


def _find_closing(
    anchor: _FollowedImage, now: _FollowedImage, ranked: Ranked, limits: WindowLimits, compare: _Compare
) -> Closing | None:
    since_s = float(ranked.t_s[now.place] - ranked.t_s[anchor.place])
    if since_s < limits.shortest_s - 1e-6:
        return None
    baseline, motion, overlap = compare(anchor, now)
    if baseline >= limits.baseline:
        return "baseline"
    if motion >= limits.motion or overlap < limits.overlap:
        return "motion"
    still = motion < limits.still
    # the next image would be too late
    after = min(now.place + 1, len(ranked.t_s) - 1)
    if ranked.t_s[after] - ranked.t_s[anchor.place] > (limits.still_s if still else limits.longest_s) + 1e-6:
        return "still" if still else "interval"
    return None


def _choose_next(
    seen: list[_FollowedImage], ranked: Ranked, limits: WindowLimits, compare: _Compare, closing: Closing
) -> Chosen:
    """The best frame of the second half of a window that begins with a chosen one."""
    begin_s, end_s = ranked.t_s[seen[0].place], ranked.t_s[seen[-1].place]
    from_s = begin_s + max(limits.shortest_s, 0.5 * (end_s - begin_s)) - 1e-6
    chosen = _choose_best([s for s in seen[1:] if ranked.t_s[s.place] >= from_s], ranked, closing)
    baseline, motion, _ = compare(seen[0], next(s for s in seen if s.place == chosen.place))
    return replace(chosen, baseline=baseline, motion=motion)


def _choose_best(seen: list[_FollowedImage], ranked: Ranked, closing: Closing) -> Chosen:
    places = np.array([s.place for s in seen])
    blur = ranked.blur[places]
    known = bool(np.isfinite(blur).all())
    # either way, the least is the best; of equals, the last one
    loss = blur if known else -np.array([s.sharpness for s in seen])
    enough = max(float(loss.min()), ranked.sharp_below) if known else float(loss.min())
    at = int(np.flatnonzero(loss <= enough)[-1])
    return Chosen(
        place=int(places[at]),
        closed_by=closing,
        ranked_by=ranked.ranking if known else "sharpness",
        blur=float(blur[at]) if known else np.nan,
        first=int(places[0]),
        last=int(places[-1]),
        baseline=np.nan,
        motion=np.nan,
    )


class _Follower:
    """Follows corners from image to image by pyramidal Lucas-Kanade, and adds new ones where they got few."""

    def __init__(self) -> None:
        self._before: UInt8Array | None = None
        self._xy = np.zeros((0, 2), np.float32)
        self._ids = np.zeros(0, np.int64)
        self._next_id = 0

    def step(self, place: int, image: UInt8Array) -> _FollowedImage:
        import cv2

        sharpness = float(np.mean(np.square(cv2.Laplacian(image, cv2.CV_32F))))
        now = reduce_image(image, _LIMITS.followed_px)
        if self._before is not None and self._before.shape != now.shape:
            self._xy, self._ids = self._xy[:0], self._ids[:0]
        elif self._before is not None and len(self._xy):
            self._follow(self._before, now)
        if len(self._xy) < _LIMITS.refill_share * _LIMITS.corners:
            self._refill(now)
        self._before = now
        xy = (self._xy.astype(np.float64) + 0.5) / max(now.shape)
        return _FollowedImage(place, self._ids.copy(), xy, sharpness)

    def _follow(self, before: UInt8Array, now: UInt8Array) -> None:
        xy, tracked = track_points(before, now, self._xy, window_px=15, round_trip_px=_LIMITS.round_trip_px)
        good = tracked & ((xy >= 0) & (xy <= np.array(now.shape[::-1]) - 1)).all(axis=1)
        self._xy, self._ids = xy[good], self._ids[good]

    def _refill(self, now: UInt8Array) -> None:
        import cv2

        distance = max(4.0, 0.5 * float(np.sqrt(now.size / _LIMITS.corners)))
        free = np.full(now.shape, 255, np.uint8)
        for x, y in np.rint(self._xy).astype(int).tolist():
            cv2.circle(free, (x, y), int(distance), 0, -1)
        wanted = _LIMITS.corners - len(self._xy)
        corners = cv2.goodFeaturesToTrack(now, wanted, 0.01, distance, mask=free)
        if corners is None:
            return
        self._xy = np.concatenate([self._xy, np.asarray(corners, np.float32).reshape(-1, 2)])
        fresh = self._next_id + np.arange(len(corners), dtype=np.int64)
        self._ids = np.concatenate([self._ids, fresh])
        self._next_id += len(corners)


class _Compare:
    """Motion between two images by the corners that both show."""

    def __init__(self, start_from_cam: Array, camera: Projector, width: int, height: int) -> None:
        self._start_from_cam = start_from_cam
        self._camera = camera
        self._long_px = float(max(width, height))

    def __call__(self, before: _FollowedImage, now: _FollowedImage) -> tuple[float, float, float]:
        """Baseline, motion (NaN where an image shows too few corners) and share of corners that stayed."""
        if len(before.ids) < _LIMITS.fewest:
            return np.nan, np.nan, 1.0
        _, i, j = np.intersect1d(before.ids, now.ids, assume_unique=True, return_indices=True)
        overlap = len(i) / len(before.ids)
        if len(i) < _LIMITS.fewest:
            return np.nan, np.nan, overlap
        motion = float(np.median(np.linalg.norm(now.xy[j] - before.xy[i], axis=1)))
        rays = [
            np.asarray(self._camera.cam_from_img(s[k] * self._long_px))[:, :2] for s, k in ((before.xy, i), (now.xy, j))
        ]
        known = np.isfinite(rays[0]).all(axis=1) & np.isfinite(rays[1]).all(axis=1)
        if known.sum() < _LIMITS.fewest:
            return np.nan, motion, overlap
        first, second = (append_unit_depth(r[known]) for r in rays)
        now_from_before = self._start_from_cam[now.place].T @ self._start_from_cam[before.place]
        if not np.isfinite(now_from_before).all():
            now_from_before = _fit_rotation(first, second)
        rotated = np.asarray(self._camera.img_from_cam(first @ now_from_before.T)) / self._long_px
        return float(np.nanmedian(np.linalg.norm(now.xy[j][known] - rotated, axis=1))), motion, overlap


def _fit_rotation(first: Array, second: Array) -> Array:
    """(3, 3) the rotation that takes most rays (N, 3) to where they were seen next, by reweighted least squares."""
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (first, second))
    rotation = np.eye(3)
    for _ in range(_LIMITS.rotation_rounds):
        rotated = a @ rotation.T
        residual = b - rotated
        square = np.sum(residual**2, axis=1)
        weight = 1 / (1 + square / max(float(np.median(square)), 1e-12)) ** 2
        jacobian = -skew(rotated)
        normal = np.einsum("n,nki,nkj->ij", weight, jacobian, jacobian) + 1e-12 * np.eye(3)
        step = np.linalg.solve(normal, np.einsum("n,nki,nk->i", weight, jacobian, residual))
        rotation = so3_exp(step) @ rotation
        if float(np.linalg.norm(step)) < 1e-7:
            break
    return rotation
