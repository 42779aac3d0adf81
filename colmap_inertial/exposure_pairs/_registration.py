"""Registration of a blurred image to a noisy one, by their pixels: reduced, without their finest and coarsest detail.

Noise is as fine as a pixel, blur takes the fine detail of one image alone, and light falls off towards the corners;
what lies between is the same in both. It is compared by its correlation, maximised over homographies by OpenCV's ECC
(G. Evangelidis, E. Psarakis, Parametric image alignment using enhanced correlation coefficient maximization, 2008).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.imaging._bilinear import between_nodes
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.rolling_shutter import grid_nodes, sampling_maps
from colmap_inertial.types import Array

Light = NDArray[np.float32]

#: Longer sides of the reduced images, px; the last one also judges.
_SIDES_PX = (120, 240, 480)
#: Detail that is compared lies between these standard deviations, px of the reduced image.
_FINE_PX, _COARSE_PX = 1.5, 16.0
#: Of ECC.
_ROUNDS, _STOP = 60, 1e-5
#: The correlation must rise by this for a more general mapping: less also comes of fitting noise.
_WORTH = 0.003
#: For leaving the gyroscope, by this: a blur that is not even through time has its centre beside mid-exposure, and
#: drew pixels away from a true shift by 0.6 px for up to 0.007.
_WORTH_FROM_GYRO = 0.01
#: Farthest that the pixels may move an image from where it was thought to be, in its longer side.
_FARTHEST, _FARTHEST_FROM_GYRO = 0.15, 0.03
#: A correlation below the first shows nothing; one below the second, where the long image has detail of the third
#: (standard deviation), that these are no images of one view.
_LEAST_AGREEMENT, _UNLIKE, _DETAIL = 0.2, 0.1, 0.015


@dataclass(frozen=True, eq=False, kw_only=True)
class Registered:
    """Where the long exposure shows what the short one does.

    Attributes
    ----------
    shift_px
        (Gy, Gx, 2) what to add to a pixel of the short exposure, at the nodes of a :class:`BlurField`.
    by_gyro, by_pixels
        What it rests on; nothing where both are false.
    agreement
        Correlation of the images' detail.
    untouched
        What it would be without any shift.
    alike
        Whether the images may show one view at all.
    """

    shift_px: Array
    by_gyro: bool
    by_pixels: bool
    agreement: float
    untouched: float
    alike: bool = True


def register(
    short: Light, long: Light, clipped: NDArray[np.bool_], *, start_px: Array | None = None, step_px: int = 16
) -> Registered:
    """Find the shift between two images of about the same brightness.

    Parameters
    ----------
    short, long
        (H, W) float32, sRGB 0 to 1.
    clipped
        (H, W) pixels of ``long`` that tell nothing.
    start_px
        (Gy, Gx, 2) the shift by the gyroscope, where there is one.
    step_px
        Distance of the nodes.
    """
    height, width = short.shape
    zero = np.zeros((*BlurField.nodes(width, height, step_px), 2))
    levels = [_Level.of(short, long, clipped, side) for side in _SIDES_PX if side <= 1.5 * max(width, height)]
    levels = levels or [_Level.of(short, long, clipped, max(width, height))]
    untouched = levels[-1].agreement(zero, step_px)
    found = Registered(shift_px=zero, by_gyro=False, by_pixels=False, agreement=untouched, untouched=untouched)
    starts = [found]
    if start_px is not None:
        gyro = np.where(np.isfinite(start_px), start_px, 0.0)
        starts.append(replace(found, shift_px=gyro, by_gyro=True, agreement=levels[-1].agreement(gyro, step_px)))
        # the gyroscope is believed unless the images clearly say otherwise
        found = starts[-1]
    refined = [_refined(start, levels, step_px) for start in starts]
    worth = _WORTH if start_px is None else _WORTH_FROM_GYRO
    best = max(one.agreement for one in (found, *refined[1:]))
    if refined[0].agreement >= best + worth:
        found = refined[0]
    elif refined[-1].agreement >= found.agreement + worth:
        found = refined[-1]
    unlike = found.agreement < _UNLIKE and levels[-1].detail() > _DETAIL
    return replace(found, alike=not unlike)


@dataclass(frozen=True, eq=False)
class _Level:
    """Both images at one size: their detail, and where it tells."""

    short: Light
    long: Light
    tells: NDArray[np.uint8]
    scale: float

    @classmethod
    def of(cls, short: Light, long: Light, clipped: NDArray[np.bool_], side_px: int) -> _Level:
        import cv2

        height, width = short.shape
        scale = min(1.0, side_px / max(width, height))
        size = (max(16, round(scale * width)), max(16, round(scale * height)))
        small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (short, long)]
        lost = cv2.resize(clipped.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
        # what is clipped spoils as much around it as the detail is fine
        reach = 2 * int(np.ceil(_FINE_PX)) + 1
        tells = 1 - cv2.dilate(lost.astype(np.uint8), np.ones((reach, reach), np.uint8))
        # light that clips in the one image must not outweigh the rest in the other
        fine, coarse = ([cv2.GaussianBlur(image, (0, 0), sigma) for image in small] for sigma in (_FINE_PX, _COARSE_PX))
        short_detail, long_detail = (np.asarray(f - c, dtype=np.float32) for f, c in zip(fine, coarse, strict=True))
        return cls(short_detail, long_detail, np.asarray(tells, dtype=np.uint8), size[0] / width)

    def moved(self, shift_px: Array, step_px: int) -> tuple[Light, NDArray[np.uint8]]:
        """The long image's detail shifted, and where it tells."""
        import cv2

        height, width = self.short.shape
        map_x, map_y = sampling_maps(self.scale * shift_px, width, height, step_px * self.scale)
        moved = cv2.remap(self.long, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        tells = cv2.remap(self.tells, map_x, map_y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
        return np.asarray(moved, dtype=np.float32), np.asarray(tells, dtype=np.uint8)

    def detail(self) -> float:
        """Standard deviation of the long image's detail where it tells."""
        telling = self.long[self.tells > 0]
        return float(telling.std()) if telling.size else 0.0

    def agreement(self, shift_px: Array, step_px: int) -> float:
        """Correlation of the details where the long image's tells; 0 where too little does."""
        moved, tells = self.moved(shift_px, step_px)
        good = tells > 0
        if np.count_nonzero(good) < 0.1 * good.size:
            return 0.0
        a, b = self.short[good].astype(np.float64), moved[good].astype(np.float64)
        a, b = a - a.mean(), b - b.mean()
        norm = float(np.sqrt((a @ a) * (b @ b)))
        return float(a @ b) / norm if norm > 0 else 0.0


def _refined(start: Registered, levels: list[_Level], step_px: int) -> Registered:
    """The best of ever more general mappings, from coarse to fine; the start, where none is better."""
    best = start
    rows, columns = start.shift_px.shape[:2]
    nodes = step_px * grid_nodes(rows, columns)
    for mapping in _mappings(start, levels, step_px):
        moved = np.concatenate([nodes, np.ones((rows, columns, 1))], axis=-1) @ mapping.T
        with np.errstate(divide="ignore", invalid="ignore"):
            target = moved[..., :2] / moved[..., 2:]
        if not np.isfinite(target).all() or (moved[..., 2] <= 0).any():
            continue
        step = target - nodes
        farthest = (_FARTHEST_FROM_GYRO if start.by_gyro else _FARTHEST) * step_px * max(rows, columns)
        if np.hypot(step[..., 0], step[..., 1]).max() > farthest:
            continue
        shift = step + between_nodes(start.shift_px, target / step_px)
        agreement = levels[-1].agreement(shift, step_px)
        # a more general mapping must be worth it
        if agreement >= max(best.agreement + _WORTH, _LEAST_AGREEMENT):
            best = replace(start, shift_px=shift, by_pixels=True, agreement=agreement)
    return best


def _mappings(start: Registered, levels: list[_Level], step_px: int) -> Iterator[Array]:
    """(3, 3) from pixels of the short image to those of the shifted long one: shift, turn, homography."""
    import cv2

    coarse = levels[0]
    moved, tells = coarse.moved(start.shift_px, step_px)
    window = cv2.createHanningWindow(coarse.short.shape[::-1], cv2.CV_32F)
    (dx, dy), _ = cv2.phaseCorrelate(coarse.short, moved * (tells > 0), window)
    guesses = [np.eye(3), np.array([[1, 0, dx / coarse.scale], [0, 1, dy / coarse.scale], [0, 0, 1.0]])]
    kinds = [cv2.MOTION_TRANSLATION, cv2.MOTION_EUCLIDEAN, cv2.MOTION_HOMOGRAPHY]
    for guess in guesses[:1] if start.by_gyro else guesses:
        mapping = guess
        # the simplest at every size, from coarse to fine; what is more general only where it can be told
        steps = [(level, kinds[0]) for level in levels] + [(levels[-1], kind) for kind in kinds[1:]]
        for level, kind in steps:
            found = _maximised(level, start, mapping, kind, step_px)
            if found is None:
                break
            mapping = found
            if level is levels[-1]:
                yield mapping


def _maximised(level: _Level, start: Registered, mapping: Array, kind: int, step_px: int) -> Array | None:
    """ECC from a mapping, both in px of the full image; ``None`` where it does not converge."""
    import cv2

    moved, tells = level.moved(start.shift_px, step_px)
    scale = _centred_scale(level.scale)
    small = scale @ mapping @ np.linalg.inv(scale)
    size = 3 if kind == cv2.MOTION_HOMOGRAPHY else 2
    warp = np.ascontiguousarray((small / small[2, 2])[:size], dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _ROUNDS, _STOP)
    try:
        _, warp = cv2.findTransformECC(level.short, moved, warp, kind, criteria, tells, 1)
    except cv2.error:
        return None
    full = np.eye(3)
    full[:size] = warp
    return np.asarray(np.linalg.inv(scale) @ full @ scale)


def _centred_scale(scale: float) -> Array:
    """From OpenCV's pixels of an image to those of one reduced by area: corners stay, not centres of pixels."""
    offset = 0.5 * scale - 0.5
    return np.array([[scale, 0, offset], [0, scale, offset], [0, 0, 1.0]])
