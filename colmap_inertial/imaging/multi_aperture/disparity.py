"""One disparity map from all apertures at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import AnyArray, BoolArray, Float32Array, UInt8Array, UInt16Array
from colmap_inertial.core.options import ApertureOptions
from colmap_inertial.core.types import SpectralRole
from colmap_inertial.imaging.multi_aperture._geometry import Rectified
from colmap_inertial.imaging.multi_aperture._information import cost_tables
from colmap_inertial.imaging.multi_aperture._light import adds_up, light_cost
from colmap_inertial.imaging.multi_aperture._noise import measure_noise, smoothing
from colmap_inertial.imaging.multi_aperture._sampling import convert_to_codes, shrunk, warp_to_canvas
from colmap_inertial.imaging.multi_aperture._volume import candidates, match
from colmap_inertial.imaging.semi_global import MOST, Views

#: Disparities that differ by no more are of one surface.
SAME_PX = 0.75


@dataclass(frozen=True, kw_only=True)
class RangeLimits:
    """Limits of the search for the range of disparities, and of the first ones for mutual information."""

    #: The image is matched this many times smaller to find the range of its disparities,
    shrink: int = 4
    #: between these shares of its width,
    shares: tuple[float, float] = (-1 / 32, 1 / 8)
    #: leaving out the shares of its pixels that are likeliest to be wrong,
    outliers: float = 0.002
    #: and adding so much to each end.
    margin_px: float = 2.0
    #: How much smaller the image is at first for mutual information,
    first_shrink: int = 16
    #: and its narrowest side there.
    narrowest_px: int = 24


_LIMITS = RangeLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Disparity:
    """Shifts between the reference and its partner, on the canvas.

    Attributes
    ----------
    disparity_px
        (H, W), nearer things have more. No gaps: what no other aperture sees continues the surface behind.
    measured
        (H, W) whether another aperture sees the pixel and agrees on its disparity.
    visible
        (N - 1, H, W) whether each other aperture sees it: nothing nearer is in the way.
    """

    disparity_px: Float32Array
    measured: BoolArray
    visible: BoolArray


def estimate_disparity(
    planes: Sequence[AnyArray],
    canvas: Rectified,
    options: ApertureOptions | None = None,
    *,
    roles: Sequence[SpectralRole] = (),
) -> Disparity:
    """Match all apertures at once.

    Parameters
    ----------
    planes
        (H, W) images of the apertures, uint8 or uint16, in the rig's order.
    canvas
        From :func:`rectify`.
    options
        Defaults serve.
    roles
        Of the apertures; needed for the luminance cost.

    Notes
    -----
    Every candidate disparity of a pixel of the reference is taken to the other views by trifocal tensors, and the
    costs of all of them are summed (Mustaniemi, Kannala, Heikkilae, Parallax correction via disparity estimation in a
    multi-aperture camera, Machine Vision and Applications 27, 2016): Census (Zabih, Woodfill, ECCV 1994) or mutual
    information, by which views of different colour can be compared. Semi-global matching (Hirschmueller, PAMI 30(2),
    2008) then finds the disparities. Where two pixels of the reference fall on one pixel of a view, the one that
    matches better keeps it; a pixel that keeps none was not measured, and takes the disparity of what lies behind,
    the second least of its neighbours in four directions. Noisy images are smoothed, and census passes over
    comparisons that noise decides.
    """
    options = options or ApertureOptions()
    threads = options.threads or 0  # 0: all processors
    codes, least = _prepare_codes(planes, canvas)
    reference, others = codes[0], codes[1:]
    low, high = options.disparity_px or _estimate_range_px(reference, others, canvas, threads)
    tables = None
    if options.cost == "mutual-information":
        tables = _make_cost_tables(reference, others, canvas, low, high, threads)
    light = None
    if options.luminance_cost and adds_up(roles):
        rough = _match_roughly(reference, others, canvas, low, high, threads)
        light = light_cost(codes, canvas, rough, roles, MOST)
    views = Views(reference=reference, others=others, tables=tables, least=least, light=light)
    disparity, total = match(views, canvas, candidates(low, high, options.step_px), threads=threads)
    return _check_disparities(disparity, total, canvas, threads, even=bool(np.ptp(reference) == 0))


def _prepare_codes(planes: Sequence[AnyArray], canvas: Rectified) -> tuple[UInt8Array, int]:
    """(N, H, W) codes to compare, on the canvas, and the least difference of them that tells."""
    import cv2

    codes, least = [], 0
    for i, plane in enumerate(planes):
        of_plane = convert_to_codes(plane)
        width_px, telling = smoothing(of_plane, measure_noise(of_plane))
        least = telling if i == 0 else least
        if width_px > 0:
            of_plane = np.asarray(cv2.GaussianBlur(of_plane, (0, 0), width_px))
        codes.append(warp_to_canvas(of_plane, canvas, i))
    return np.stack(codes), least


def _check_disparities(
    disparity: Float32Array, least: UInt16Array, canvas: Rectified, threads: int, *, even: bool
) -> Disparity:
    """The disparities without what is wrong, and what the views see of them."""
    import cv2

    bits = _find_visibility(disparity, least, canvas, threads)
    measured = (bits == 3).any(axis=0)
    filled = background(disparity, measured)
    smooth = np.asarray(cv2.medianBlur(filled, 3))
    visible = (_find_visibility(smooth, least, canvas, threads) & 1).astype(bool)
    return Disparity(disparity_px=smooth, measured=measured & (not even), visible=visible)


def _find_visibility(disparity_px: Float32Array, least: UInt16Array, canvas: Rectified, threads: int) -> UInt8Array:
    from colmap_inertial._kernels import _apertures

    ratios = canvas.ratios
    bits = np.empty((len(ratios), *disparity_px.shape), dtype=np.uint8)
    cx, cy = canvas.centre_px.tolist()
    _apertures.visibility(
        disparity_px, least, ratios=ratios, cx=cx, cy=cy, tolerance=SAME_PX, bits=bits, threads=threads
    )
    return bits


def background(disparity_px: Float32Array, known: BoolArray) -> Float32Array:
    """Disparities with gaps filled from behind: by the second least of the next known ones in four directions.

    Hirschmueller (2008), section 2.5.3, who takes eight; the least itself may be an outlier.
    """
    if known.all() or not known.any():
        return disparity_px
    near = []
    for axis in (0, 1):
        at = np.arange(known.shape[axis])
        place = at[:, None] if axis == 0 else at[None]
        for flip in (slice(None), slice(None, None, -1)):
            turn = (flip, slice(None)) if axis == 0 else (slice(None), flip)
            order = place[turn] if flip.step is None else place
            last = np.maximum.accumulate(np.where(known[turn], order, -1), axis=axis)
            values = np.take_along_axis(disparity_px[turn], np.maximum(last, 0), axis=axis)
            near.append(np.where(last >= 0, values, np.inf)[turn])
    first, second = np.sort(np.stack(near), axis=0)[:2]
    behind = np.where(np.isfinite(second), second, first)
    return np.where(known | ~np.isfinite(behind), disparity_px, behind).astype(np.float32)


def _estimate_range_px(
    reference: UInt8Array, others: UInt8Array, canvas: Rectified, threads: int
) -> tuple[float, float]:
    """Limits of the disparities, by matching smaller images over a wide range."""
    by = _choose_shrink(reference)
    small = canvas.shrunk(by)
    low, high = (share * canvas.width / by for share in _LIMITS.shares)
    disparity, least = match(_shrink_views(reference, others, by), small, candidates(low, high, 0.5), threads=threads)
    measured = (_find_visibility(disparity, least, small, threads) == 3).any(axis=0)
    used = disparity[measured] if measured.any() else disparity
    limits = by * np.quantile(used, (_LIMITS.outliers, 1 - _LIMITS.outliers))
    return float(limits[0] - _LIMITS.margin_px), float(limits[1] + _LIMITS.margin_px)


def _choose_shrink(reference: UInt8Array) -> int:
    return max(1, min(_LIMITS.shrink, min(reference.shape) // _LIMITS.narrowest_px))


def _shrink_views(reference: UInt8Array, others: UInt8Array, by: int) -> Views:
    return Views(reference=shrunk(reference, by), others=np.stack([shrunk(view, by) for view in others]))


def _match_roughly(
    reference: UInt8Array, others: UInt8Array, canvas: Rectified, low_px: float, high_px: float, threads: int
) -> Float32Array:
    """Disparities by matching smaller images."""
    import cv2

    by = _choose_shrink(reference)
    spaced = candidates(low_px / by, high_px / by, 0.5)
    disparity, _ = match(_shrink_views(reference, others, by), canvas.shrunk(by), spaced, threads=threads)
    return np.asarray(by * cv2.resize(disparity, reference.shape[::-1], interpolation=cv2.INTER_LINEAR))


def _make_cost_tables(
    reference: UInt8Array, others: UInt8Array, canvas: Rectified, low_px: float, high_px: float, threads: int
) -> UInt8Array:
    """Cost tables by mutual information, from small images to large ones (Hirschmueller 2008, section 2.1).

    The first disparities are drawn at random, and the first size is gone through three times.
    """
    import cv2

    levels = [
        by for by in (16, 8, 4, 2) if by <= _LIMITS.first_shrink and min(reference.shape) // by >= _LIMITS.narrowest_px
    ]
    disparity: Float32Array | None = None
    for by in [*levels[:1], *levels[:1], *levels]:
        small = canvas.shrunk(by)
        views = _shrink_views(reference, others, by)
        shape = views.reference.shape
        if disparity is None:
            drawn = np.random.default_rng(0).uniform(low_px, high_px, shape)
            disparity = np.asarray(drawn / by, dtype=np.float32)
        elif disparity.shape != shape:
            disparity = 2 * cv2.resize(disparity, shape[::-1], interpolation=cv2.INTER_LINEAR)
        tables = cost_tables(views.reference, views.others, small, disparity, MOST)
        disparity, _ = match(
            replace(views, tables=tables), small, candidates(low_px / by, high_px / by, 0.5), threads=threads
        )
    if disparity is None:
        disparity = np.full(reference.shape, 0.5 * (low_px + high_px), dtype=np.float32)
    else:
        disparity = 2 * cv2.resize(disparity, reference.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return cost_tables(reference, others, canvas, np.asarray(disparity), MOST)
