"""Find the frame of a video that an image shows, by its content: through another codec, size or brightness, never by
counting.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Float32Array, UInt8Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.images import grey_8bit, read_image
from colmap_inertial.io.picture_names import picture_in
from colmap_inertial.io.video import decode_grey


@dataclass(frozen=True, kw_only=True)
class _MatchLimits:
    """Limits for an image that is a frame of the video."""

    #: Sides of the thumbnails: the small one chooses which frames are compared closely, the large one decides.
    small_px: int = 40
    #: Sides of the thumbnails: the small one chooses which frames are compared closely, the large one decides.
    large_px: int = 128
    #: A frame is compared closely with the images for which it is among this many most similar ones so far.
    candidates: int = 8
    #: Below which a small thumbnail is no candidate, and a large one not the same image.
    least_correlation: float = 0.5
    #: Below which a small thumbnail is no candidate, and a large one not the same image.
    same_correlation: float = 0.95
    #: How far an image may lie from its frame towards the next best one: the change from frame to frame is the measure,
    #: so that noise of coding, which has nothing of it, does not count.
    largest_fraction: float = 0.25
    #: Frames nearer to each other than this are the same but for rounding.
    rounding: float = 0.005


_LIMITS = _MatchLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoMatch:
    """Result of the search.

    Attributes
    ----------
    t_ns
        Presentation stamp of the frame that each image is.
    doubtful
        Why there is none, for the other images.
    quarter_turns
        How often the images are rotated by 90 degrees counterclockwise against the frames as stored.
    """

    t_ns: Mapping[str, int]
    doubtful: Mapping[str, Fact]
    quarter_turns: int


class _Candidates:
    """The two frames that look most like each image so far."""

    def __init__(self, images: UInt8Array) -> None:
        self._small = np.array([_normalise(_shrink(image)) for image in images])
        self._large = np.ascontiguousarray(images)
        self._correlation = np.full((len(images), _LIMITS.candidates), _LIMITS.least_correlation, dtype=np.float32)
        self.distance = np.full((len(images), 2), np.inf)
        self._frames = np.zeros((len(images), 2, *images.shape[1:]), dtype=np.uint8)
        self.t_ns = np.zeros((len(images), 2), dtype=np.int64)

    def offer(self, t_ns: int, grey: UInt8Array) -> None:
        """Compare a frame with all images."""
        thumbnail = _thumbnail(grey, _LIMITS.large_px)
        correlation = self._small @ _normalise(_shrink(thumbnail))
        better = np.flatnonzero(correlation > self._correlation.min(axis=1))
        if not len(better):
            return
        frame = _normalise(thumbnail)
        for i in better:
            self._correlation[i, np.argmin(self._correlation[i])] = correlation[i]
            distance = _distance(_normalise(self._large[i]), frame)
            place = 0 if distance < self.distance[i, 0] else 1
            if distance < self.distance[i, place]:
                for kept in (self.distance, self._frames, self.t_ns):
                    kept[i, 1] = kept[i, 0] if place == 0 else kept[i, 1]
                self.distance[i, place], self._frames[i, place], self.t_ns[i, place] = distance, thumbnail, t_ns

    def fraction_to_next(self, i: int) -> float:
        """Position of image ``i`` between its best frame (0) and the next best (1); at most half-way."""
        first, second = self.distance[i]
        if not np.isfinite(second):
            return 0.0
        between = _distance(*(_normalise(frame) for frame in self._frames[i]))
        if between < _LIMITS.rounding:
            return 0.5
        return float(0.5 * (1 - (second**2 - first**2) / between**2))


def match_to_video(
    video: Path, folder: Path, names: Sequence[str], *, progress: Callable[[int], object] = lambda frames: None
) -> VideoMatch:
    """Find the frame of a video that each image was taken from.

    Thumbnails of the images are compared with each frame as it is decoded, once; memory does not grow with the video.
    Correlation is blind to brightness and contrast, and thumbnails to size and coding noise. An image of which two
    frames are about equally likely has no match: a repeated frame, or a camera that stood still.

    Parameters
    ----------
    video
        Decoded from beginning to end.
    folder, names
        The images: the video's frames, whole, in any size, upright or as stored.
    progress
        Called with the number of frames that were looked at.

    Raises
    ------
    FormatError
        For an image or video that cannot be decoded.
    """
    images = (grey_8bit(read_image(picture_in(folder, name))) for name in names)
    thumbnails = np.array([_thumbnail(image, _LIMITS.large_px) for image in images])
    turns: dict[int, _Candidates] = {}
    for seen, (t_ns, angle, grey) in enumerate(decode_grey(video), start=1):
        if not turns:
            # which way round the angle is meant depends on who extracted the frames: let the images tell
            possible = {0: (0,), 180: (0, 2)}.get(abs(angle) % 360, (0, 1, 3))
            turns = {turn: _Candidates(np.rot90(thumbnails, -turn, axes=(1, 2))) for turn in possible}
        for candidates in turns.values():
            candidates.offer(t_ns, grey)
        progress(seen)
    if not turns:
        raise FormatError(video, Fact("no-video-frames"))
    nearest = {turn: np.median(np.minimum(c.distance[:, 0], 1.0)) for turn, c in turns.items()}
    turn = min(nearest, key=lambda t: nearest[t])
    time_of, doubtful = _decide(turns[turn], names)
    return VideoMatch(t_ns=time_of, doubtful=doubtful, quarter_turns=turn)


def _decide(candidates: _Candidates, names: Sequence[str]) -> tuple[dict[str, int], dict[str, Fact]]:
    time_of: dict[str, int] = {}
    doubtful: dict[str, Fact] = {}
    for i, name in enumerate(names):
        if candidates.distance[i, 0] > np.sqrt(1 - _LIMITS.same_correlation):
            doubtful[name] = Fact("not-of-video")
        elif candidates.fraction_to_next(i) > _LIMITS.largest_fraction:
            doubtful[name] = Fact("looks-like-several-frames")
        else:
            time_of[name] = int(candidates.t_ns[i, 0])
    several = {t_ns for t_ns, count in Counter(time_of.values()).items() if count > 1}
    for name in [name for name, t_ns in time_of.items() if t_ns in several]:
        del time_of[name]
        doubtful[name] = Fact("same-frame-as-another")
    return time_of, doubtful


def _thumbnail(grey: UInt8Array, side: int) -> UInt8Array:
    """(side, side) 8 bit, whatever the aspect; blurred a little, as resizing filters differ."""
    import cv2

    shrunk = cv2.resize(grey, (side, side), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(shrunk, (0, 0), 1.0), dtype=np.uint8)


def _shrink(thumbnail: UInt8Array) -> UInt8Array:
    import cv2

    size = _LIMITS.small_px, _LIMITS.small_px
    return np.asarray(cv2.resize(thumbnail, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _normalise(thumbnail: UInt8Array) -> Float32Array:
    """(N,) zero mean, unit length; zero for a flat image, which looks like nothing."""
    values = thumbnail.astype(np.float32).ravel()
    values -= values.mean()
    length = float(np.linalg.norm(values))
    return np.asarray(values / length if length > values.size**0.5 else values * 0)


def _distance(a: Float32Array, b: Float32Array) -> float:
    """Root of one minus the correlation."""
    return float(np.sqrt(max(0.0, 1 - float(a @ b))))
