"""A short and a long exposure of one scene, brought together: brightness, geometry, and the long one's blur.

The short one is sharp, dark and noisy, the long one clean and blurred. Whatever makes one image of them needs both at
one brightness and in one geometry; the short one's geometry stays, because it is the one that is sharp.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, BoolArray, Float32Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import colmap_px_from_opencv
from colmap_inertial.core.types import Projector
from colmap_inertial.imaging._bilinear import interpolate_nodes
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.exposure_pairs._registration import Registered, register
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.psf import blur_field
from colmap_inertial.imaging.rolling_shutter import grid_nodes, project_by_lines, rays, sampling_maps
from colmap_inertial.imaging.transfer import decode_table, srgb_from_linear


@dataclass(frozen=True, kw_only=True)
class BrightnessLimits:
    """Limits of the measurement of the gain between two exposures."""

    #: Pixels as bright as this share of the largest code may have been clipped.
    clipped: float = 250 / 255
    #: Squares along the longer side: large enough that blur and a shift between the images hardly count.
    cells_along: int = 40
    #: Least side of a square.
    least_cell_px: int = 12
    #: Squares with a larger share of clipped pixels tell nothing.
    most_clipped: float = 0.01
    #: Nor do those with a larger share of black ones: where noise takes a tenth of the pixels below black, what is left
    #: is too bright by 4 %.
    most_black: float = 0.1
    #: Fewer squares tell too little.
    least_cells: int = 12
    #: Where fewer are left, those with the least black serve, as long as a larger share of their pixels is not black.
    blackest: float = 0.5
    #: Of squares that are compared by rank alone, those with more clipped pixels are the brightest.
    clipped_square: float = 0.2
    #: What is stated is believed while the pixels agree to this factor,
    agree_factor: float = 1.25
    #: and before they are aligned, to this one.
    agree_unaligned_factor: float = 2.0
    #: Colours differ between exposures by no more than this factor (phones at night reach 1.5): more would be a
    #: mistake.
    most_colour: float = 2.0
    #: A gain beyond this shows nothing but noise.
    most_gain: float = 1000.0


BRIGHTNESS_LIMITS = BrightnessLimits()

_STEP_PX = 16


@dataclass(frozen=True, kw_only=True)
class Brightness:
    """Gain that makes the short exposure as bright as the long one.

    Attributes
    ----------
    gain
        Over all channels.
    colours
        For each channel, what its own gain is of ``gain``.
    measured
        The gain by the pixels; ``None`` where too few tell.
    stated
        The gain by exposure times and sensitivities; ``None`` where unknown.
    """

    gain: float
    colours: tuple[float, ...]
    measured: float | None
    stated: float | None

    @property
    def contradicts(self) -> bool:
        """Whether the pixels disagree with what was stated."""
        if self.measured is None or self.stated is None:
            return False
        return abs(np.log(self.measured / self.stated)) > np.log(BRIGHTNESS_LIMITS.agree_factor)


def match_brightness(short: AnyArray, long: AnyArray, *, stated: float | None = None) -> Brightness:
    """The gain between two exposures, in linear light.

    The images are compared in squares: the median over those that neither clip nor sink into black, weighted by their
    light. What is stated is taken where the pixels confirm it or tell too little, and the pixels' own gain otherwise:
    it is the images that have to agree.

    Parameters
    ----------
    short, long
        (H, W) or (H, W, C) sRGB codes, uint8 or uint16, of about the same view.
    stated
        Exposure time times sensitivity of the long one over that of the short one.

    Raises
    ------
    NotObservableError
        Where nothing is stated and the pixels tell too little.
    """
    if short.shape != long.shape:
        raise ValueError(f"the short exposure has shape {short.shape}, the long one {long.shape}")
    if stated is not None and not stated > 0:
        raise ValueError(f"stated must be above 0, not {stated}")
    gains, middle = _measure_channel_gains(short, long, _measure_aligned_gain)
    measured = None if middle is None else float(np.exp(middle))
    gain = _choose_gain(stated, measured, BRIGHTNESS_LIMITS.agree_factor)
    if gain is None:
        raise NotObservableError("the gain between short and long exposure", Fact("pair-gain-unknown"))
    limit = np.log(BRIGHTNESS_LIMITS.most_colour)
    colours = [0.0 if g is None or middle is None else np.clip(np.log(g) - middle, -limit, limit) for g in gains]
    return Brightness(
        gain=_clip_gain(gain), colours=tuple(float(np.exp(c)) for c in colours), measured=measured, stated=stated
    )


def first_brightness(short: AnyArray, long: AnyArray, *, stated: float | None = None) -> Brightness:
    """The gain between two exposures that may lie far from each other.

    Not what lies in one place is compared, but what is equally bright among all squares of each image. What is stated
    is taken where that agrees to a factor of two or tells nothing. Parameters and errors are those of
    :func:`match_brightness`, which is exact where the images are aligned.
    """
    gains, middle = _measure_channel_gains(short, long, _measure_ranked_gain)
    measured = None if middle is None else float(np.exp(middle))
    gain = _choose_gain(stated, measured, BRIGHTNESS_LIMITS.agree_unaligned_factor)
    if gain is None:
        return match_brightness(short, long, stated=stated)
    return Brightness(gain=_clip_gain(gain), colours=(1.0,) * len(gains), measured=measured, stated=stated)


def brightened(short: AnyArray, brightness: Brightness) -> Float32Array:
    """The short exposure as bright as the long one: float32 sRGB 0 to 1, clipped, of the same shape."""
    light = decode_table(short.dtype).astype(np.float64)
    planes = short.reshape(*short.shape[:2], -1)
    out = np.empty(planes.shape, dtype=np.float32)
    for c, colour in enumerate(brightness.colours):
        out[..., c] = srgb_from_linear(brightness.gain * colour * light).astype(np.float32)[planes[..., c]]
    return out.reshape(short.shape)


def gyro_shift(
    motion: GyroCamera, camera: Projector, short: FrameShutter, long: FrameShutter, *, step_px: int = _STEP_PX
) -> Array:
    """Shift of the long exposure against the short one by the camera's rotation between them.

    What a pixel of the short exposure sees in the middle of its own line's exposure is looked for in the long one, each
    of whose lines has a middle of its own: by fixed-point iteration.

    Parameters
    ----------
    motion, camera
        As for ``psf.blur_field``.
    short, long
        When the lines of both are exposed.
    step_px
        Distance of the nodes.

    Returns
    -------
    (Gy, Gx, 2) what to add to a pixel of the short exposure to get to the long one's, px, at the nodes of a
    :class:`BlurField`; nan where the camera model sees nothing.

    Raises
    ------
    NotObservableError
        Where an exposure time is unknown or the gyroscope did not record all from the first to the last line.
    """
    if short.exposure_s is None or long.exposure_s is None:
        raise NotObservableError("the rotation between short and long exposure", Fact("pair-exposure-unknown"))
    ends = [(s.t_s, s.t_s + (s.exposure_s or 0.0) + s.readout_s) for s in (short, long)]
    begin_s, end_s = min(e[0] for e in ends), max(e[1] for e in ends)
    if not motion.covers(np.array([begin_s]), np.array([end_s]))[0]:
        raise NotObservableError("the rotation between short and long exposure", Fact("pair-not-covered"))
    nodes = step_px * grid_nodes(*BlurField.nodes(short.width, short.height, step_px))
    source = colmap_px_from_opencv(nodes.reshape(-1, 2))
    directions = np.einsum("nij,nj->ni", motion.start_from_cam(short.middle_s(source)), rays(camera, source))
    target = project_by_lines(directions, source, motion, camera, long)
    return np.asarray(target - source).reshape(nodes.shape)


def blur_seen_from_short(blur: BlurField, shift_px: Array) -> BlurField:
    """The long exposure's blur in the short one's geometry.

    Parameters
    ----------
    blur
        Of the long exposure, in its own geometry.
    shift_px
        (Gy, Gx, 2) as :func:`gyro_shift`, at the nodes of ``blur``.
    """
    nodes = grid_nodes(*blur.vector_px.shape[:2])
    shift = np.where(np.isfinite(shift_px), shift_px, 0.0)
    vectors = interpolate_nodes(blur.vector_px.astype(np.float64), nodes + shift / blur.step_px)
    # a short line in the short exposure is this matrix times that in the long one
    by_y, by_x = np.gradient(shift / blur.step_px, axis=(0, 1))
    derivative = np.eye(2) + np.stack([by_x, by_y], axis=-1)
    seen = np.linalg.solve(derivative, vectors[..., None])[..., 0]
    return BlurField(width=blur.width, height=blur.height, vector_px=seen.astype(np.float32), step_px=blur.step_px)


@dataclass(frozen=True, eq=False, kw_only=True)
class PairGyro:
    """The gyroscope's part in bringing a pair together.

    Attributes
    ----------
    motion, camera
        As for ``psf.blur_field``.
    short, long
        When the lines of both are exposed.
    """

    motion: GyroCamera
    camera: Projector
    short: FrameShutter
    long: FrameShutter


@dataclass(frozen=True, eq=False, kw_only=True)
class ExposurePair:
    """Two exposures at one brightness, in the short one's geometry.

    Attributes
    ----------
    short
        (H, W) or (H, W, 3) float32, sRGB 0 to 1: the short exposure as bright as the long one.
    long
        Likewise: the long exposure seen as the short one. What it does not cover holds the short one's pixels.
    covered
        (H, W) what the long exposure covers.
    clipped
        (H, W) where it may have clipped: there only the short one tells.
    blur
        Of the long exposure in this geometry; ``None`` where unknown.
    brightness
        How the brightness was matched.
    registered
        How the geometry was.
    gyro_note
        Why the gyroscope had no part in it; ``None`` where it had.
    """

    short: Float32Array
    long: Float32Array
    covered: BoolArray
    clipped: BoolArray
    blur: BlurField | None
    brightness: Brightness
    registered: Registered
    gyro_note: Fact | None = None


def bring_together(
    short: AnyArray, long: AnyArray, *, gyro: PairGyro | None = None, stated_gain: float | None = None
) -> ExposurePair:
    """Match the brightness of a short exposure to the long one's, and the long one's geometry to the short one's.

    The gyroscope's rotation comes first; then the pixels, which also know of an error of the gyroscope's clock or
    calibration, and of the camera's translation as far as a plane goes. They are followed only where the images agree
    better after it.

    Parameters
    ----------
    short, long
        (H, W) or (H, W, 3) sRGB codes, uint8 or uint16, of one shape.
    gyro
        Where there is one, with both exposure times.
    stated_gain
        As for :func:`match_brightness`.

    Raises
    ------
    NotObservableError
        Where the gain is unknown.
    """
    import cv2

    brightness = first_brightness(short, long, stated=stated_gain)
    shift = None
    note: Fact | None = None
    if gyro is None:
        note = Fact("no-gyroscope")
    else:
        try:
            shift = gyro_shift(gyro.motion, gyro.camera, gyro.short, gyro.long)
        except NotObservableError as error:
            note = error.fact
    height, width = short.shape[:2]
    top = np.iinfo(long.dtype).max
    clipped = long >= np.ceil(BRIGHTNESS_LIMITS.clipped * top)
    clipped = clipped if clipped.ndim == 2 else clipped.any(axis=2)
    bright = np.asarray(long.astype(np.float32) / np.float32(top))
    registered = register(
        average_channels(brightened(short, brightness)),
        average_channels(bright),
        clipped,
        start_px=shift,
        step_px=_STEP_PX,
    )
    blur = None
    if gyro is not None and shift is not None:
        if registered.by_gyro:
            # the exposure is known and recorded: else there were no shift
            blur = blur_seen_from_short(blur_field(gyro.motion, gyro.camera, gyro.long), registered.shift_px)
        else:
            note = Fact("pair-rotation-not-confirmed")
    map_x, map_y = sampling_maps(registered.shift_px, width, height, _STEP_PX)
    covered = (map_x >= 0) & (map_x <= width - 1) & (map_y >= 0) & (map_y <= height - 1)
    seen = cv2.remap(long, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    lost = cv2.remap(clipped.astype(np.uint8), map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) > 0
    # exactly, of what they have in common, if that is enough
    if registered.alike:
        with contextlib.suppress(NotObservableError):
            brightness = match_brightness(short, np.where(_match_channels(covered, seen), seen, 0), stated=stated_gain)
    matched = brightened(short, brightness)
    aligned = np.where(_match_channels(covered, seen), seen.astype(np.float32) / np.float32(top), matched)
    return ExposurePair(
        short=matched,
        long=aligned,
        covered=covered,
        clipped=lost & covered,
        blur=blur,
        brightness=brightness,
        registered=registered,
        gyro_note=note,
    )


def _choose_gain(stated: float | None, measured: float | None, factor: float) -> float | None:
    """The stated gain where the pixels agree to a factor or show nothing; else the measured one."""
    if stated is not None and (measured is None or abs(np.log(measured / stated)) <= np.log(factor)):
        return stated
    return measured


def _clip_gain(gain: float) -> float:
    return float(np.clip(gain, 1 / BRIGHTNESS_LIMITS.most_gain, BRIGHTNESS_LIMITS.most_gain))


#: Mean light of one channel's squares, and which share of them clips and is black.
_Squares = tuple[Array, Array, Array]


def _measure_channel_gains(
    short: AnyArray, long: AnyArray, gain_of: Callable[[_Squares, _Squares], float | None]
) -> tuple[list[float | None], float | None]:
    """The gain of each channel, ``None`` where too few squares tell, and the logarithm of their median."""
    cell = max(BRIGHTNESS_LIMITS.least_cell_px, max(short.shape[:2]) // BRIGHTNESS_LIMITS.cells_along)
    dark, bright = (image.reshape(*image.shape[:2], -1) for image in (short, long))
    gains = [
        gain_of(_measure_squares(dark[..., c], cell), _measure_squares(bright[..., c], cell))
        for c in range(dark.shape[2])
    ]
    telling = [np.log(gain) for gain in gains if gain is not None]
    return gains, float(np.median(telling)) if telling else None


def _measure_aligned_gain(short: _Squares, long: _Squares) -> float | None:
    """Weighted median over squares of one channel that neither clip nor sink into black."""
    (dark, *of_short), (bright, *of_long) = short, long
    clipped, black = zip(of_short, of_long, strict=True)
    good = (np.maximum(*clipped) <= BRIGHTNESS_LIMITS.most_clipped) & (dark > 0) & (bright > 0)
    blackness = np.maximum(*black)
    ranked = np.sort(blackness[good])[: 2 * BRIGHTNESS_LIMITS.least_cells]
    blackest = min(ranked[-1], BRIGHTNESS_LIMITS.blackest) if len(ranked) else 0.0
    good &= blackness <= max(BRIGHTNESS_LIMITS.most_black, blackest)
    return _weigh_median_gain(dark[good], bright[good])


def _measure_ranked_gain(short: _Squares, long: _Squares) -> float | None:
    """Likewise of squares of the same rank in brightness, between those that are black and those that clip."""
    (dark, *of_short), (bright, *of_long) = short, long
    clipped, black = (
        max(float((of_one[k] > most).mean()) for of_one in (of_short, of_long))
        for k, most in ((0, BRIGHTNESS_LIMITS.clipped_square), (1, BRIGHTNESS_LIMITS.blackest))
    )
    inner = slice(int(np.ceil(black * dark.size)), int((1 - clipped) * dark.size))
    a, b = np.sort(dark.ravel())[inner], np.sort(bright.ravel())[inner]
    good = (a > 0) & (b > 0)
    return _weigh_median_gain(a[good], b[good])


def _weigh_median_gain(dark: Array, bright: Array) -> float | None:
    """The median ratio, weighted by the light of both: that of one alone would prefer squares in which a shift between
    the images makes it the brighter; ``None`` of too few squares."""
    if len(dark) < BRIGHTNESS_LIMITS.least_cells:
        return None
    ratios, weights = np.log(bright / dark), np.sqrt(bright * dark)
    order = np.argsort(ratios)
    below = np.cumsum(weights[order])
    return float(np.exp(ratios[order][np.searchsorted(below, 0.5 * below[-1])]))


def _measure_squares(image: AnyArray, cell: int) -> _Squares:
    import cv2

    height, width = image.shape
    size = (max(1, width // cell), max(1, height // cell))
    top = np.iinfo(image.dtype).max

    def mean(values: AnyArray) -> Array:
        return np.asarray(cv2.resize(values.astype(np.float32), size, interpolation=cv2.INTER_AREA), dtype=np.float64)

    # codes below the first of 8 bits: what noise takes below black is lost, and what is left is too bright
    return (
        mean(decode_table(image.dtype)[image]),
        mean(image >= np.ceil(BRIGHTNESS_LIMITS.clipped * top)),
        mean(image <= top // 256),
    )


def average_channels(image: Float32Array) -> Float32Array:
    """(H, W) mean of the channels."""
    return image if image.ndim == 2 else np.asarray(image.mean(axis=2), dtype=np.float32)


def _match_channels(mask: BoolArray, image: AnyArray) -> BoolArray:
    return mask if image.ndim == 2 else mask[..., None]
