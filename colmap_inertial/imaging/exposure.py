"""The exposure time that nobody states, from the blur of frames that turn quickly and slowly.

A camera that turns by ``w`` smears its frames along a direction that the gyroscope gives, over a length that grows with
the exposure. Textures, lens and codec have directions of their own, too, but alike in frames that turn slowly. So the
falls of detail of all frames (:mod:`colmap_inertial.imaging.evidence`) are fitted by those of one exposure, and of one
smear of constant length along the predicted direction, of either sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, UInt8Array, UInt16Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Projector
from colmap_inertial.imaging.evidence import (
    _LIMITS as _EVIDENCE,
    _compute_falls,
    _compute_log_power,
    _cut_tiles,
    _hold_texture,
    _linearise,
    _weigh_tiles,
)
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.psf import blur_path
from colmap_inertial.imaging.tracking import reduce_image


@dataclass(frozen=True, kw_only=True)
class ExposureLimits:
    """Limits and settings of the estimate of an exposure."""

    #: Exposures that are compared: from, to, and so many for a factor of two.
    shortest_s: float = 1e-3
    longest_s: float = 0.08
    per_octave: int = 3
    #: Side of the tiles, and how many there are of a frame at most.
    tile_px: int = 128
    tiles: int = 60
    #: Images are reduced to half their size, a quarter and so on, until this exposure smears no more than such a share
    #: of a tile.
    usual_s: float = 0.03
    usual_share: float = 0.7
    #: Length of the smear that is alike in all frames; how much of it there is, is fitted.
    constant_px: float = 2.0
    #: Fewer frames do not tell.
    fewest_frames: int = 8
    #: Exposures that fit worse by more than this many standard deviations, by the scatter of the frames, are excluded.
    excluded_sigmas: float = 2.0
    #: Standard deviation, as a share, beyond which an exposure counts as bounded only: blur that is known no better is
    #: not undone.
    most_unsure: float = 0.25


_LIMITS = ExposureLimits()


@dataclass(frozen=True, kw_only=True)
class ExposureEstimate:
    """An exposure time by the blur of frames.

    Attributes
    ----------
    exposure_s
        ``None`` where frames do not surely show a blur that grows with the turning: then only ``most_s`` is known.
    sigma_s
        Its standard deviation; ``None`` with it.
    most_s
        Longer exposures are excluded (two standard deviations).
    frames
        How many were compared.
    """

    exposure_s: float | None
    sigma_s: float | None
    most_s: float
    frames: int


def exposures_to_compare(longest_s: float) -> Array:
    """(C,) exposure times up to a longest one, evenly spaced in their logarithm."""
    octaves = np.log2(max(min(longest_s, _LIMITS.longest_s) / _LIMITS.shortest_s, 2.0))
    return np.asarray(_LIMITS.shortest_s * 2 ** np.linspace(0, octaves, int(octaves * _LIMITS.per_octave) + 1))


def compare_exposures(
    image: UInt8Array | UInt16Array,
    motion: GyroCamera,
    camera: Projector,
    shutter: FrameShutter,
    exposures_s: Array,
) -> Array | None:
    """Compare the falls of detail of a frame with those that exposures predict.

    Parameters
    ----------
    image
        (H, W) or (H, W, 3), sRGB.
    motion, camera
        Gyroscope and intrinsics.
    shutter
        Of the frame; its exposure is not looked at, and its time is that of mid-exposure.
    exposures_s
        (C,).

    Returns
    -------
    (C, 5) products of the fall as seen with that of the exposure, of the exposure's with itself, of the seen one with
    that of a constant smear, of the latter with itself, and of both; ``None`` where there is too little texture, or the
    gyroscope did not record the longest exposure.
    """
    light = _linearise(image)
    longest_s = float(exposures_s[-1])
    if not _exposed(shutter, longest_s).covered_by(motion):
        return None
    fields = [blur_path(motion, camera, _exposed(shutter, exposure_s)) for exposure_s in exposures_s.tolist()]
    speed_px_s = float(np.percentile(fields[0].field().extent_px(), 90)) / float(exposures_s[0])
    reduced = 1
    while speed_px_s * _LIMITS.usual_s > _LIMITS.usual_share * _LIMITS.tile_px * reduced:
        reduced *= 2
    light = reduce_image(light, max(light.shape) // reduced)
    if min(light.shape) < _LIMITS.tile_px:
        return None
    windows, starts = _cut_tiles(light, _LIMITS.tile_px, _LIMITS.tiles)
    usable = _hold_texture(windows)
    if usable.sum() < _EVIDENCE.fewest_tiles:
        return None
    logarithm = _compute_log_power(windows[usable])
    weight = _weigh_tiles(logarithm)
    middles = [(start + _LIMITS.tile_px / 2) * reduced for start in starts]
    paths = [field.at(*middles).reshape(len(usable), -1, 2)[usable] / reduced for field in fields]
    along = paths[0][:, -1] - paths[0][:, 0]
    along = along / np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-12)[:, None]
    steps = np.linspace(-0.5, 0.5, 17) * _LIMITS.constant_px / reduced
    seen, constant, counts = _compute_falls(logarithm, along, along[:, None] * steps[:, None])

    def product(a: Array, b: Array) -> float:
        return float(weight @ _multiply_falls(a, b, counts))

    rows = []
    for path in paths:
        _, fall, _ = _compute_falls(logarithm, along, path)
        rows.append([product(seen, fall), product(fall, fall), product(constant, fall)])
    with_fall, fall_square, both = np.array(rows).T
    with_constant, square = product(seen, constant), product(constant, constant)
    every = np.ones(len(exposures_s))
    return np.stack([with_fall, fall_square, with_constant * every, square * every, both], axis=1)


def _exposed(shutter: FrameShutter, exposure_s: float) -> FrameShutter:
    """The shutter with an exposure around its time."""
    return replace(shutter, exposure_s=exposure_s, t_s=shutter.t_s - 0.5 * exposure_s)


def _multiply_falls(a: Array, b: Array, counts: BoolArray) -> Array:
    """(N,) sums of products over frequencies, of which a texture's own direction is alike at all of them."""
    frequencies = np.maximum(counts.sum(1), 1)
    return np.asarray((a * b).sum(1) - _EVIDENCE.own_direction * a.sum(1) * b.sum(1) / frequencies)


def estimate_exposure(compared: Sequence[Array], exposures_s: Array) -> ExposureEstimate:
    """One exposure time for frames that turn quickly and slowly.

    Least squares over all tiles, with the share of the constant smear fitted for each exposure. How surely one exposure
    fits better than another is by the scatter over frames of by how much it does: textures err alike within a frame.

    Parameters
    ----------
    compared
        (C, 5) of each frame: :func:`compare_exposures`.
    exposures_s
        (C,) that were compared.

    Raises
    ------
    NotObservableError
        Where there are too few frames, or no exposure is excluded.
    """
    if len(compared) < _LIMITS.fewest_frames:
        raise NotObservableError("exposure", Fact("exposure-of-few-frames", frames=len(compared)))
    # no exposure at all comes first
    sums = np.stack(compared)
    none = np.concatenate([np.zeros((len(sums), 1, 2)), sums[:, :1, 2:4], np.zeros((len(sums), 1, 1))], axis=2)
    gain = _measure_gain(np.concatenate([none, sums], axis=1))
    best = int(np.argmax(gain.sum(axis=0)))
    excess = gain[:, [best]] - gain
    with np.errstate(invalid="ignore"):
        sigmas = np.nan_to_num(excess.sum(axis=0) / np.sqrt((excess**2).sum(axis=0)))
    kept = np.flatnonzero(sigmas < _LIMITS.excluded_sigmas)
    first, last = int(kept[0]), int(kept[-1])
    if last == len(exposures_s):
        raise NotObservableError("exposure", Fact("exposure-not-bounded", longest_s=float(exposures_s[-1])))
    most_s = float(exposures_s[last])
    if first == 0:
        return ExposureEstimate(exposure_s=None, sigma_s=None, most_s=most_s, frames=len(compared))
    logarithm = np.log(exposures_s)
    step = float(logarithm[1] - logarithm[0])
    peak = logarithm[best - 1] + step * _find_peak(gain.sum(axis=0), best)
    # both ends are as many standard deviations away; what lies between two that were compared is not told apart
    sigma = max(float(logarithm[last - 1] - logarithm[first - 1]), step) / (2 * _LIMITS.excluded_sigmas)
    if sigma > _LIMITS.most_unsure:
        return ExposureEstimate(exposure_s=None, sigma_s=None, most_s=most_s, frames=len(compared))
    exposure_s = float(np.exp(peak))
    return ExposureEstimate(exposure_s=exposure_s, sigma_s=sigma * exposure_s, most_s=most_s, frames=len(compared))


def _measure_gain(sums: Array) -> Array:
    """(F, C) by how much the squares of the falls fall by each exposure and the share of the smear that fits best."""
    with_fall, fall_square, with_constant, square, both = np.moveaxis(sums, -1, 0)
    share = (with_constant - both).sum(axis=0) / np.maximum(square.sum(axis=0), 1e-12)
    return np.asarray(2 * with_fall - fall_square + 2 * share * (with_constant - both) - share**2 * square)


def _find_peak(values: Array, best: int) -> float:
    """Where between its neighbours a parabola through a maximum is highest, in steps."""
    if best + 1 >= len(values):
        return 0.0
    before, here, after = values[best - 1 : best + 2]
    bend = before - 2 * here + after
    return 0.0 if bend >= 0 else float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))
