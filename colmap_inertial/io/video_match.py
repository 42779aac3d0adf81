"""Which frame of a video a picture is, by its content: through another codec, size or brightness, never by counting."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.errors import FormatError
from colmap_inertial.io.images import read_image
from colmap_inertial.io.video import decode_grey

Floats = NDArray[np.float32]

#: Sides of the thumbnails: the small one chooses which frames are looked at closely, the large one decides.
_SMALL, _LARGE = 40, 128
#: A frame is looked at closely for the pictures for which it is among this many most alike so far.
_CANDIDATES = 8
#: Correlation below which a small thumbnail is no candidate, and a large one not the same picture.
_LIKE, _SAME = 0.5, 0.95
#: How far a picture may lie from its frame on the way to the next best one. The change from frame to frame is the
#: measure, so that noise of coding, which has nothing of it, does not count.
_ON_THE_WAY = 0.25
#: Frames nearer to each other than this are the same but for rounding.
_ROUNDING = 0.005


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoMatch:
    """What was found.

    Attributes
    ----------
    t_ns
        Presentation stamp of the frame that each picture is.
    doubtful
        Why there is none, for the other pictures.
    quarter_turns
        How often the pictures are turned by 90 degrees counterclockwise against the frames as stored.
    """

    t_ns: Mapping[str, int]
    doubtful: Mapping[str, str]
    quarter_turns: int


class _Candidates:
    """The two frames that look most like each picture so far."""

    def __init__(self, pictures: NDArray[np.uint8]) -> None:
        self._small = np.array([_normalised(_smaller(picture)) for picture in pictures])
        self._large = np.ascontiguousarray(pictures)
        self._likeness = np.full((len(pictures), _CANDIDATES), _LIKE, dtype=np.float32)
        self.distance = np.full((len(pictures), 2), np.inf)
        self._frames = np.zeros((len(pictures), 2, *pictures.shape[1:]), dtype=np.uint8)
        self.t_ns = np.zeros((len(pictures), 2), dtype=np.int64)

    def offer(self, t_ns: int, grey: NDArray[np.uint8]) -> None:
        """Compare a frame with all pictures."""
        thumbnail = _thumbnail(grey, _LARGE)
        likeness = self._small @ _normalised(_smaller(thumbnail))
        better = np.flatnonzero(likeness > self._likeness.min(axis=1))
        if not len(better):
            return
        frame = _normalised(thumbnail)
        for i in better:
            self._likeness[i, np.argmin(self._likeness[i])] = likeness[i]
            distance = _distance(_normalised(self._large[i]), frame)
            place = 0 if distance < self.distance[i, 0] else 1
            if distance < self.distance[i, place]:
                for kept in (self.distance, self._frames, self.t_ns):
                    kept[i, 1] = kept[i, 0] if place == 0 else kept[i, 1]
                self.distance[i, place], self._frames[i, place], self.t_ns[i, place] = distance, thumbnail, t_ns

    def on_the_way(self, i: int) -> float:
        """Where picture ``i`` lies on the way from its best frame (0) to the next best (1); at most half-way."""
        first, second = self.distance[i]
        if not np.isfinite(second):
            return 0.0
        between = _distance(*(_normalised(frame) for frame in self._frames[i]))
        if between < _ROUNDING:
            return 0.5
        return float(0.5 * (1 - (second**2 - first**2) / between**2))


def match_to_video(
    video: Path, folder: Path, names: Sequence[str], *, progress: Callable[[int], object] = lambda frames: None
) -> VideoMatch:
    """Find the frame of a video that each picture was taken from.

    Thumbnails of the pictures are compared with each frame as it is decoded, once; memory does not grow with the video.
    Correlation is blind to brightness and contrast, and thumbnails to size and coding noise. A picture of which two
    frames are about equally likely has no match: a repeated frame, or a camera that stood still.

    Parameters
    ----------
    video
        Decoded from beginning to end.
    folder, names
        The pictures: the video's frames, whole, in any size, upright or as stored.
    progress
        Called with the number of frames that were looked at.

    Raises
    ------
    FormatError
        For a picture or video that cannot be decoded.
    """
    greys = (_grey(folder / name) for name in names)
    pictures = np.array([_thumbnail(grey, _LARGE) for grey in greys])
    turns: dict[int, _Candidates] = {}
    for seen, (t_ns, angle, grey) in enumerate(decode_grey(video), start=1):
        if not turns:
            # which way round the angle is meant depends on who extracted the frames: let the pictures tell
            possible = {0: (0,), 180: (0, 2)}.get(abs(angle) % 360, (0, 1, 3))
            turns = {turn: _Candidates(np.rot90(pictures, -turn, axes=(1, 2))) for turn in possible}
        for candidates in turns.values():
            candidates.offer(t_ns, grey)
        progress(seen)
    if not turns:
        raise FormatError(video, "holds no video frames")
    nearest = {turn: np.median(np.minimum(c.distance[:, 0], 1.0)) for turn, c in turns.items()}
    turn = min(nearest, key=lambda t: nearest[t])
    found, doubtful = _decided(turns[turn], names)
    return VideoMatch(t_ns=found, doubtful=doubtful, quarter_turns=turn)


def _decided(candidates: _Candidates, names: Sequence[str]) -> tuple[dict[str, int], dict[str, str]]:
    found: dict[str, int] = {}
    doubtful: dict[str, str] = {}
    for i, name in enumerate(names):
        if candidates.distance[i, 0] > np.sqrt(1 - _SAME):
            doubtful[name] = "is no frame of the video"
        elif candidates.on_the_way(i) > _ON_THE_WAY:
            doubtful[name] = "looks like several frames of the video"
        else:
            found[name] = int(candidates.t_ns[i, 0])
    several = {t_ns for t_ns, count in Counter(found.values()).items() if count > 1}
    for name in [name for name, t_ns in found.items() if t_ns in several]:
        del found[name]
        doubtful[name] = "is the same frame as another picture"
    return found, doubtful


def _grey(path: Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    import cv2

    image = read_image(path)
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def _thumbnail(grey: NDArray[np.uint8] | NDArray[np.uint16], side: int) -> NDArray[np.uint8]:
    """(side, side) 8 bit, whatever the aspect; blurred a little, as resizing filters differ."""
    import cv2

    if grey.dtype == np.uint16:
        grey = np.asarray(grey >> 8, dtype=np.uint8)
    shrunk = cv2.resize(grey, (side, side), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(shrunk, (0, 0), 1.0), dtype=np.uint8)


def _smaller(thumbnail: NDArray[np.uint8]) -> NDArray[np.uint8]:
    import cv2

    return np.asarray(cv2.resize(thumbnail, (_SMALL, _SMALL), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _normalised(thumbnail: NDArray[np.uint8]) -> Floats:
    """(N,) zero mean, unit length; zero for a flat picture, which looks like nothing."""
    values = thumbnail.astype(np.float32).ravel()
    values -= values.mean()
    length = float(np.linalg.norm(values))
    return np.asarray(values / length if length > values.size**0.5 else values * 0)


def _distance(a: Floats, b: Floats) -> float:
    """Root of one minus the correlation."""
    return float(np.sqrt(max(0.0, 1 - float(a @ b))))
