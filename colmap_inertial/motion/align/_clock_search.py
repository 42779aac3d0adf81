"""Search of the time offset between a camera's rotations and a gyroscope over every offset at which they coincide.

An offset is judged by how well one rotation and one bias, fitted in closed form, turn the gyroscope's rotation over
each interval between frames into the camera's. With ``E`` the energy of the camera's interval rotations, ``S`` what
the fit leaves of it and ``n`` the effective number of independent components, ``n/2 log(E / S)`` is the log-likelihood
gained over two recordings that have nothing to do with each other. It is negative for most wrong offsets, because the
gyroscope's gain is known to be one; and it grows with the overlap, so that short chance overlaps do not win.

Poses that are wrong would spoil least squares. Least trimmed squares (Rousseeuw and Van Driessen 2006) fit the share of
the intervals that fits best, and judge an offset by this share alone; a mixture of sound and wrong rotations
(``_robust.py``) finds the share itself, and judges by what the sound ones say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, ComplexArray, IndexArray
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_from_matrix, quat_log, quat_multiply
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory
from colmap_inertial.motion.align._robust import MIXTURE, Mixture, fit_mixture

#: Frames this close together sample the rotation densely enough to be correlated on a grid.
DENSE_S = 0.25
#: Steps between offsets of the two coarse searches. Hand motion decorrelates within some 0.3 s.
_GRID_S, _SCAN_S = 0.05, 0.04
#: Most and fewest intervals that the coarse search of sparse frames uses, its budget of intervals times offsets, and
#: the intervals that compare the candidates.
_SCAN_INTERVALS, _SCAN_FEWEST, _SCAN_BUDGET, _COMPARED_INTERVALS = 128, 40, 2_000_000, 2000
#: Peaks of the coarse search that are compared closely, and how far apart two of them are at least.
_PEAKS, _PEAK_DISTANCE_S = 4, 0.5
#: Longest rotation of one interval that still has a reliable rotation vector (the sign flips at pi).
_MAX_TURN_RAD = 2.6


@dataclass(frozen=True, kw_only=True)
class TrimmedLimits:
    """Least trimmed squares, where all intervals together fail."""

    #: Shares of the intervals that are believed, one after the other.
    shares: tuple[float, ...] = (0.85, 0.7)
    #: Least length of an interval: in a shorter one, the noise of poses hides what is wrong.
    spacing_s: float = 0.25
    #: Concentration steps: each refits the intervals that fitted best.
    concentrations: int = 4


TRIMMED = TrimmedLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Intervals:
    """Rotations of the camera between pairs of frames.

    Attributes
    ----------
    begin_s, end_s
        (K,) camera clock.
    turn_rad
        (K, 3) rotation vector of ``begin_from_end``, camera frame.
    """

    begin_s: Array
    end_s: Array
    turn_rad: Array

    @property
    def dt_s(self) -> Array:
        return np.asarray(self.end_s - self.begin_s)

    def __len__(self) -> int:
        return len(self.begin_s)

    def select(self, index: IndexArray | BoolArray) -> Intervals:
        return Intervals(begin_s=self.begin_s[index], end_s=self.end_s[index], turn_rad=self.turn_rad[index])


@dataclass(frozen=True, eq=False, kw_only=True)
class ClockFit:
    """The fit at one offset.

    Attributes
    ----------
    offset_s
        ``trajectory`` time = ``imu`` time + this (both since their own epochs).
    log_likelihood
        Gain over recordings that have nothing to do with each other.
    explained
        Fraction of the camera's rotation that the gyroscope explains; of a mixture, the share of sound rotations.
    gain
        How far sound rotations turn for what the gyroscope turns, by a mixture.
    mirrored
        Log-likelihood that a mixture gains with the gyroscope's mirror image.
    cam_from_imu_xyzw, gyro_bias_rad_s
        The fitted rotation and bias.
    """

    offset_s: float
    log_likelihood: float
    explained: float
    cam_from_imu_xyzw: Array
    gyro_bias_rad_s: Array
    gain: float = 1.0
    mirrored: float = -np.inf

    def apply_to(self, prior: CameraImuCalibration, shift_s: float) -> CameraImuCalibration:
        """A calibration with what was fitted; ``shift_s`` is that of the two epochs (``epoch_shift_s``)."""
        return replace(
            prior.replace_clock_offset(self.offset_s - shift_s),
            cam_from_imu_xyzw=self.cam_from_imu_xyzw,
            gyro_bias_rad_s=self.gyro_bias_rad_s,
        )


def select_spaced_frames(t_s: Array, spacing_s: float) -> IndexArray:
    """Indices of frames at least ``spacing_s`` apart (to within half a frame interval); sparse frames all stay."""
    if len(t_s) < 2:
        return np.arange(len(t_s))
    slack_s = 0.5 * min(float(np.median(np.diff(t_s))), spacing_s)
    keep = [0]
    while True:
        i = int(np.searchsorted(t_s, t_s[keep[-1]] + spacing_s - slack_s))
        if i >= len(t_s):
            return np.array(keep)
        keep.append(max(i, keep[-1] + 1))


def intervals_of(trajectory: CameraTrajectory, spacing_s: float) -> Intervals:
    """Consecutive intervals of frames at least ``spacing_s`` apart."""
    keep = select_spaced_frames(trajectory.t_s, spacing_s)
    t_s, pose = trajectory.t_s[keep], trajectory.cam_from_world_xyzw[keep]
    turn = quat_log(quat_multiply(pose[:-1], quat_conjugate(pose[1:])))
    return Intervals(begin_s=t_s[:-1], end_s=t_s[1:], turn_rad=turn)


def search_offsets(
    intervals: Intervals,
    path: GyroPath,
    offsets_s: tuple[float, float],
    *,
    min_overlap: float,
    cam_from_imu_xyzw: Array | None = None,
    share: float | None = 1.0,
) -> list[ClockFit]:
    """The best fit and its competitors: peaks of the log-likelihood over the offset, best first.

    Parameters
    ----------
    intervals
        The camera's rotations.
    path
        The gyroscope, without any bias taken out.
    offsets_s
        Lowest and highest offset, between times since each recording's epoch.
    min_overlap
        Smallest overlap as a fraction of the shorter recording.
    cam_from_imu_xyzw
        Fixes the rotation; without it, it is fitted anew at each offset.
    share
        Of the intervals that are fitted at each offset, by least trimmed squares; ``None`` for those that a mixture
        finds sound.

    Returns
    -------
    Up to four fits; none where the recordings cannot overlap within the range.
    """
    rotation = None if cam_from_imu_xyzw is None else matrix_from_quat(cam_from_imu_xyzw)
    intervals = _remove_jumps(intervals, path)
    dense = intervals.dt_s <= DENSE_S
    if share == 1 and dense.any() and intervals.dt_s[dense].sum() > 0.5 * intervals.dt_s.sum():
        intervals, step_s = intervals.select(dense), _GRID_S
        offset_s, gain, per_second = _correlate_rates(intervals, path, offsets_s, min_overlap, rotation)
    else:
        step_s = _SCAN_S
        offset_s, gain, per_second = _scan_offsets(intervals, path, offsets_s, min_overlap, rotation, share)
    known = np.isfinite(gain)
    offset_s, gain = offset_s[known], gain[known]
    compared = intervals.select(_sample_evenly(len(intervals), _COMPARED_INTERVALS))
    fits = []
    for peak in _find_peaks(offset_s, gain):
        nearby = np.clip(offset_s[peak] + step_s * np.linspace(-1, 1, 9), *offsets_s)
        fits.append(_fit_nearby(compared, path, nearby, per_second * intervals.dt_s.sum(), rotation, share))
    return sorted(fits, key=lambda fit: -fit.log_likelihood)


def measure_explained_share(
    intervals: Intervals, path: GyroPath, offset_s: float, cam_from_imu_xyzw: Array | None, share: float = 1.0
) -> float:
    """Fraction of the camera's rotation that the gyroscope explains at one offset."""
    rotation = None if cam_from_imu_xyzw is None else matrix_from_quat(cam_from_imu_xyzw)
    return _fit_nearby(_remove_jumps(intervals, path), path, np.array([offset_s]), 1.0, rotation, share).explained


def _sample_evenly(count: int, wanted: int) -> IndexArray:
    if count <= wanted:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, wanted).astype(np.intp))


def _remove_jumps(intervals: Intervals, path: GyroPath) -> Intervals:
    """Rotations faster than the gyroscope ever turned are jumps of the poses: shorten them to what it did."""
    fastest = 1.2 * path.fastest_rad_s
    angle = np.linalg.norm(intervals.turn_rad, axis=1)
    shrink = np.minimum(1.0, fastest * intervals.dt_s / np.maximum(angle, 1e-12))
    turn = intervals.turn_rad * shrink[:, None]
    short = Intervals(begin_s=intervals.begin_s, end_s=intervals.end_s, turn_rad=turn)
    return short.select(np.linalg.norm(turn, axis=1) < _MAX_TURN_RAD)


def _maximise_trace(cross: Array, rotation: Array | None) -> Array:
    """``max_C tr(C^T M)`` over rotations, or for the one given; ``M`` (L, 3, 3) is camera times IMU."""
    if rotation is not None:
        return np.einsum("ij,lij->l", rotation, cross)
    singular = np.linalg.svd(cross, compute_uv=False)
    return singular[:, 0] + singular[:, 1] + np.sign(np.linalg.det(cross)) * singular[:, 2]


def _log_likelihood_gain(energy: Array, left: Array, effective: Array) -> Array:
    """``n/2 ln(E / S)``: log likelihood gained over unrelated recordings (``docs/dev/alignment.md#search``).

    What is left is at least a thousandth, which no real camera and gyroscope reach.
    """
    left = np.maximum(left, 1e-3 * energy)
    return 0.5 * effective * np.log(np.maximum(energy, 1e-15) / np.maximum(left, 1e-15))


def _correlate_rates(
    intervals: Intervals,
    path: GyroPath,
    offsets_s: tuple[float, float],
    min_overlap: float,
    rotation: Array | None,
) -> tuple[Array, Array, float]:
    """Gain at a range of offsets, for dense frames, by FFT of the angular velocities with their gaps masked."""
    swept = 0.5 * (path.rate_rad_s[1:] + path.rate_rad_s[:-1]) * np.diff(path.t_s)[:, None]
    visual, visual_ok, begin_s = _resample_on_grid(intervals.begin_s, intervals.end_s, intervals.turn_rad)
    inertial, inertial_ok, imu_begin_s = _resample_on_grid(path.t_s[:-1], path.t_s[1:], swept)
    size = _fft_length(len(visual) + len(inertial))

    def spectrum(x: Array) -> ComplexArray:
        return np.asarray(np.fft.rfft(x, size, axis=0), dtype=np.complex128)

    def correlate(a: ComplexArray, b: ComplexArray) -> Array:
        return np.asarray(np.fft.irfft(np.conj(a) * b, size, axis=0), dtype=np.float64)

    v, g = spectrum(visual), spectrum(inertial)
    v_ok, g_ok = spectrum(visual_ok.astype(float))[:, None], spectrum(inertial_ok.astype(float))[:, None]
    cells = np.maximum(np.round(correlate(v_ok, g_ok)), 0.0)
    lag = np.arange(size)
    lag[lag >= len(inertial)] -= size
    offset_s = np.asarray(begin_s - imu_begin_s - lag * _GRID_S, dtype=np.float64)
    enough = cells[:, 0] >= max(1.0, min_overlap * min(visual_ok.sum(), inertial_ok.sum()))
    kept = np.argsort(-lag)
    kept = kept[(enough & _select_offsets(offset_s, offsets_s, _GRID_S))[kept]]
    count, sum_v, sum_g = cells[kept], correlate(v, g_ok)[kept], correlate(v_ok, g)[kept]
    energy_v = correlate(spectrum(np.sum(visual**2, axis=1))[:, None], g_ok)[kept, 0]
    energy_g = correlate(v_ok, spectrum(np.sum(inertial**2, axis=1))[:, None])[kept, 0]
    cross = np.stack([correlate(v[:, [i]], g)[kept] for i in range(3)], axis=1)
    energy_v -= np.sum(sum_v**2, axis=1) / count[:, 0]
    energy_g -= np.sum(sum_g**2, axis=1) / count[:, 0]
    cross -= sum_v[:, :, None] * sum_g[:, None, :] / count[:, :, None]
    left = energy_v + energy_g - 2 * _maximise_trace(cross, rotation)
    per_second = 3 / (_GRID_S * _count_repeated_cells(visual[visual_ok], inertial[inertial_ok]))
    return offset_s[kept], _log_likelihood_gain(energy_v, left, per_second * _GRID_S * count[:, 0]), per_second


def _select_offsets(offset_s: Array, offsets_s: tuple[float, float], step_s: float) -> BoolArray:
    return (offset_s >= offsets_s[0] - step_s) & (offset_s <= offsets_s[1] + step_s)


def _fft_length(at_least: int) -> int:
    """A power of two: numpy's FFT, as scipy's takes longer to import than the whole search."""
    return 1 << max(at_least - 1, 1).bit_length()


def _resample_on_grid(begin_s: Array, end_s: Array, turn_rad: Array) -> tuple[Array, BoolArray, float]:
    """Mean rates in the cells of a grid, which cells are covered by intervals without gaps, and the grid's start."""
    start_s = float(begin_s[0])
    edges = start_s + _GRID_S * np.arange(max(int((end_s[-1] - start_s) / _GRID_S), 1) + 1)
    gap = begin_s[1:] - end_s[:-1] > DENSE_S
    long = end_s - begin_s > DENSE_S
    knots = np.append(begin_s, end_s[-1])
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(turn_rad, axis=0)])
    rate = np.stack([np.diff(np.interp(edges, knots, angle[:, k])) for k in range(3)], axis=1) / _GRID_S
    uncovered = np.zeros(len(edges) + 1)
    holes = np.concatenate([np.stack([end_s[:-1], begin_s[1:]], axis=1)[gap], np.stack([begin_s, end_s], axis=1)[long]])
    first = np.searchsorted(edges, holes[:, 0], side="right") - 1
    last = np.searchsorted(edges, holes[:, 1], side="left")
    np.add.at(uncovered, np.clip(first, 0, len(edges)), 1)
    np.add.at(uncovered, np.clip(last, 0, len(edges)), -1)
    covered = np.cumsum(uncovered)[: len(rate)] == 0
    return np.where(covered[:, None], rate, 0.0), covered, start_s


def _count_repeated_cells(visual: Array, inertial: Array) -> float:
    """Cells per independent cell: Bartlett's sum over the products of the two autocorrelations."""

    def autocorrelation(x: Array) -> Array:
        x = x - x.mean(axis=0)
        size = _fft_length(2 * len(x))
        power = np.sum(np.abs(np.fft.rfft(x, size, axis=0)) ** 2, axis=1)
        out = np.asarray(np.fft.irfft(power, size)[: len(x)])
        return out / max(out[0], 1e-15)

    a, b = autocorrelation(visual), autocorrelation(inertial)
    reach = min(len(a), len(b), int(20 / _GRID_S))
    return max(1.0, float(1 + 2 * np.sum(a[1:reach] * b[1:reach])))


def _scan_offsets(
    intervals: Intervals,
    path: GyroPath,
    offsets_s: tuple[float, float],
    min_overlap: float,
    rotation: Array | None,
    share: float | None,
) -> tuple[Array, Array, float]:
    """Gain at a range of offsets, for sparse frames, from the rotations over the very intervals."""
    grid = np.arange(path.t_s[0], path.t_s[-1], _SCAN_S)
    offsets = len(grid) + (intervals.end_s[-1] - intervals.begin_s[0]) / _SCAN_S
    wanted = int(np.clip(_SCAN_BUDGET / offsets, _SCAN_FEWEST, _SCAN_INTERVALS))
    some = intervals.select(_sample_evenly(len(intervals), wanted))
    begin_s, end_s = some.begin_s[0], some.end_s[-1]
    attitude = path.at(grid)[0]
    start = np.round((some.begin_s - begin_s) / _SCAN_S).astype(np.intp)
    end = np.round((some.end_s - begin_s) / _SCAN_S).astype(np.intp)
    lag = np.arange(-end[-1], len(grid))
    offset_s = begin_s - grid[0] - lag * _SCAN_S
    needed_s = min_overlap * min(float(end_s - begin_s), float(path.t_s[-1] - path.t_s[0])) * some.dt_s.sum()
    needed_s /= float(end_s - begin_s)
    allowed = _select_offsets(offset_s, offsets_s, _SCAN_S)
    offset_s, lag = offset_s[allowed], lag[allowed]
    effective = _count_independent_intervals(some)
    gain = np.full(len(lag), np.nan)
    for chunk in range(0, len(lag), 256):
        at = slice(chunk, chunk + 256)
        i, j = start + lag[at, None], end + lag[at, None]
        inside = (i >= 0) & (j < len(grid))
        inside &= path.covers(grid[np.clip(i, 0, len(grid) - 1)], grid[np.clip(j, 0, len(grid) - 1)])
        covered_s = np.sum(inside * some.dt_s, axis=1)
        enough = np.flatnonzero((covered_s >= needed_s) & (covered_s > 0))
        i, j, inside, covered_s = i[enough], j[enough], inside[enough], covered_s[enough]
        i, j = np.clip(i, 0, len(grid) - 1), np.clip(j, 0, len(grid) - 1)
        inertial = quat_log(quat_multiply(quat_conjugate(attitude[i]), attitude[j]))
        if share is None:
            mixture = _fit_mixture(some, inertial, inside, rotation, rounds=MIXTURE.choosing)
            value = mixture.log_likelihood * min(effective / len(some), 1.0)
        else:
            energy, left, _ = _fit_offsets(some, inertial, inside, rotation, share)
            value = _log_likelihood_gain(energy, left, 3 * effective * share * covered_s / some.dt_s.sum())
        gain[chunk + enough] = value
    return offset_s, gain, float(3 * _count_independent_intervals(intervals) / intervals.dt_s.sum())


def _count_independent_intervals(intervals: Intervals) -> float:
    """Number of independent intervals: long ones weigh more, and neighbours with correlated rotations repeat each
    other.
    """
    dt_s = intervals.dt_s
    scaled = intervals.turn_rad / np.sqrt(dt_s)[:, None]
    energy = max(float(np.mean(np.sum(scaled**2, axis=1))), 1e-15)
    reach = min(6, len(dt_s) // 4 + 1)
    correlations = [float(np.mean(np.sum(scaled[k:] * scaled[:-k], axis=1))) / energy for k in range(1, reach)]
    return float(dt_s.sum() ** 2 / np.sum(dt_s**2) / (1 + 2 * np.sum(np.square(correlations))))


def _fit_offsets(
    intervals: Intervals, inertial_rad: Array, inside: BoolArray, rotation: Array | None, share: float
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Energy of the intervals (L,) and what the best rotation and common rate leave of it, for L offsets.

    Of a share of the intervals, the energy is that of the smallest rotations: what any fit could leave at most. Also
    returns what :func:`_sum_moments` does of those that were fitted: cross moments and common rates.
    """
    if share == 1:
        cross, energy, energy_g, (rate_v, rate_g) = _sum_moments(intervals, inertial_rad, inside)
        return energy, energy + energy_g - 2 * _maximise_trace(cross, rotation), (cross, rate_v, rate_g)
    dt_s = intervals.dt_s
    wanted = np.maximum(np.round(share * inside.sum(axis=1)), 1).astype(np.intp)

    def smallest(squares: Array) -> tuple[BoolArray, Array]:
        squares = np.where(inside, squares / dt_s, np.inf)
        ordered = np.sort(squares, axis=1)
        kept = inside & (squares <= np.take_along_axis(ordered, wanted[:, None] - 1, axis=1))
        return kept, np.sum(np.where(kept, squares, 0.0), axis=1)

    usual = np.median(intervals.turn_rad / dt_s[:, None], axis=0)
    energy = smallest(np.sum((intervals.turn_rad - dt_s[:, None] * usual) ** 2, axis=1)[None])[1]
    # lengths of the rotations tell which intervals can fit, whatever the rotation between camera and IMU
    lengths = np.linalg.norm(intervals.turn_rad, axis=1) - np.linalg.norm(inertial_rad, axis=2)
    kept, left = smallest(lengths**2)
    for _ in range(TRIMMED.concentrations):
        cross, _, _, (rate_v, rate_g) = _sum_moments(intervals, inertial_rad, kept)
        fitted = _find_rotation(cross) if rotation is None else rotation[None]
        visual = intervals.turn_rad - dt_s[:, None] * rate_v[:, None, :]
        inertial = (inertial_rad - dt_s[:, None] * rate_g[:, None, :]) @ np.swapaxes(fitted, 1, 2)
        kept, left = smallest(np.sum((visual - inertial) ** 2, axis=2))
    return energy, left, (cross, rate_v, rate_g)


def _fit_mixture(
    intervals: Intervals,
    inertial_rad: Array,
    inside: BoolArray,
    rotation: Array | None,
    *,
    mirrored: bool = False,
    rounds: int = MIXTURE.rounds,
) -> Mixture:
    free = _find_reflection if mirrored else _find_rotation
    dt_s = intervals.dt_s
    products = (intervals.turn_rad / dt_s[:, None])[:, :, None] * inertial_rad[:, :, None, :]
    products = products.reshape(*inertial_rad.shape[:2], 9)

    def moments(weight: Array) -> tuple[Array, Array, Array]:
        total = np.maximum(weight @ dt_s, 1e-12)[:, None]
        rate_v = (weight @ intervals.turn_rad) / total
        rate_g = (weight[:, None] @ inertial_rad)[:, 0] / total
        cross = (weight[:, None] @ products).reshape(-1, 3, 3)
        return cross - (total * rate_v)[:, :, None] * rate_g[:, None, :], rate_v, rate_g

    return fit_mixture(
        intervals.turn_rad,
        inertial_rad,
        dt_s,
        inside,
        moments=moments,
        best_rotation=free if rotation is None else lambda _: rotation[None],
        rounds=rounds,
    )


def _find_reflection(cross: Array) -> Array:
    """(L, 3, 3) reflections of the largest ``tr(R' cross)``."""
    return -_find_rotation(-cross)


def _find_rotation(cross: Array) -> Array:
    """(L, 3, 3) rotations ``R`` of the largest ``tr(R' cross)``."""
    u, _, vt = np.linalg.svd(cross)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return np.asarray(u @ vt)


def _sum_moments(
    intervals: Intervals, inertial_rad: Array, inside: BoolArray | Array
) -> tuple[Array, Array, Array, tuple[Array, Array]]:
    """``M`` (L, 3, 3), ``E`` and ``G`` (L,) of ``docs/dev/alignment.md#search``, after a common rate is taken out.

    ``inertial_rad`` (L, K, 3) and ``inside`` (L, K), or weights, for L offsets. Intervals weigh by 1 / dt, as for a
    random walk. Also returns the two common rates (L, 3), camera and IMU.
    """
    dt_s = intervals.dt_s
    weight = inside / dt_s
    total = np.maximum(np.sum(inside * dt_s, axis=1), 1e-12)[:, None]
    rate_v = (inside @ intervals.turn_rad) / total
    rate_g = np.einsum("lk,lki->li", inside, inertial_rad) / total
    visual = intervals.turn_rad - dt_s[:, None] * rate_v[:, None, :]
    inertial = inertial_rad - dt_s[:, None] * rate_g[:, None, :]
    weighted = visual * weight[:, :, None]
    cross = weighted.transpose(0, 2, 1) @ inertial
    return (
        cross,
        np.sum(weighted * visual, axis=(1, 2)),
        np.sum(inertial * inertial * weight[:, :, None], axis=(1, 2)),
        (rate_v, rate_g),
    )


def _find_peaks(offset_s: Array, gain: Array) -> list[int]:
    """The highest local maxima, each at least half a second from any higher one."""
    if not len(gain):
        return []
    padded = np.concatenate([[-np.inf], gain, [-np.inf]])
    peak = np.flatnonzero((gain >= padded[:-2]) & (gain >= padded[2:]))
    chosen: list[int] = []
    for i in peak[np.argsort(-gain[peak])]:
        if all(abs(offset_s[i] - offset_s[j]) > _PEAK_DISTANCE_S for j in chosen):
            chosen.append(int(i))
        if len(chosen) == _PEAKS:
            break
    return chosen


def _fit_nearby(
    intervals: Intervals, path: GyroPath, offset_s: Array, effective: float, rotation: Array | None, share: float | None
) -> ClockFit:
    """The best of a few neighbouring offsets, with its rotation and bias."""
    # an interval begins where the one before ends
    instants_s, place = np.unique(np.concatenate([intervals.begin_s, intervals.end_s]), return_inverse=True)
    attitude = path.at((instants_s - offset_s[:, None]).ravel())[0].reshape(len(offset_s), -1, 4)
    first, last = attitude[:, place[: len(intervals)]], attitude[:, place[len(intervals) :]]
    inertial = quat_log(quat_multiply(quat_conjugate(first), last))
    mask = path.covers(intervals.begin_s - offset_s[:, None], intervals.end_s - offset_s[:, None])
    turned, mirrored = np.ones(len(offset_s)), -np.inf
    if share is None:
        mixture = _fit_mixture(intervals, inertial, mask, rotation)
        independent = min(effective / (3 * len(intervals)), 1.0)
        gain, explained, turned = independent * mixture.log_likelihood, mixture.sound, mixture.gain
        cross, rate_v, rate_g = mixture.cross, mixture.rate_v, mixture.rate_g
        if rotation is None:
            at = np.array([np.argmax(gain)])
            reflected = _fit_mixture(intervals, inertial[at], mask[at], None, mirrored=True)
            mirrored = independent * float(reflected.log_likelihood[0])
    else:
        energy, left, (cross, rate_v, rate_g) = _fit_offsets(intervals, inertial, mask, rotation, share)
        covered = np.sum(mask * intervals.dt_s, axis=1) / intervals.dt_s.sum()
        gain, explained = (
            _log_likelihood_gain(energy, left, effective * share * covered),
            1 - left / np.maximum(energy, 1e-15),
        )
    best = int(np.argmax(gain))
    if rotation is None:
        rotation = _find_rotation(cross[best : best + 1])[0]
    return ClockFit(
        offset_s=float(offset_s[best]),
        log_likelihood=float(gain[best]),
        explained=float(explained[best]),
        cam_from_imu_xyzw=quat_from_matrix(rotation),
        gyro_bias_rad_s=rate_g[best] - rotation.T @ rate_v[best],
        gain=float(turned[best]),
        mirrored=mirrored,
    )
