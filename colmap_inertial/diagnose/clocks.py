"""The stamps of frames against those of the IMU: units, offset, rate, and how much of the frames the IMU covers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.diagnose.diagnosis import Finding, Recorded, Severity
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.motion.align import Alignment


@dataclass(frozen=True, kw_only=True)
class ClockCheckLimits:
    """Limits of the comparison of the clocks of camera and IMU."""

    #: Clock rates: phones keep within 1e-4, action cameras within 1 %; the scale is corrected for what is found.
    rate: float = 0.003
    wrong_rate: float = 0.012
    #: The IMU may miss so many frames, and this share of them; below the last, too little is left.
    slack_frames: float = 2.0
    slack_share: float = 0.03
    least_covered: float = 0.25
    #: Parts whose offsets are compared, how far they may be off, and how sharp a part's best offset must be.
    part_s: float = 3.0
    part_reach_s: float = 0.4
    part_step_s: float = 0.01
    uneven_s: float = 0.03
    part_explained: float = 0.6
    #: Standard deviations of a part's offset that count (five: once in 10,000 recordings of a minute, with room for
    #: errors that are not normal), how well an offset is known at best, in frames, and which share of the offset
    #: another part has: clocks wander, and poses that are wrong for a moment do not.
    uneven_sigmas: float = 5.0
    known_frames: float = 0.1
    another: float = 0.5


_LIMITS = ClockCheckLimits()


def offset_finding(recorded: Recorded, offset_s: float) -> Finding:
    """Clocks that are further apart than was stated."""
    clocks = None if recorded.clocks is None else recorded.clocks.fact
    fact = Fact("clock-offset", offset_s=offset_s, max_offset_s=recorded.max_offset_s, clocks=clocks)
    return Finding(fact=fact, severity="error")


def check_time_unit(recorded: Recorded) -> Iterator[Finding]:
    """Stamps of frames that are a thousand times those of the gyroscope, or a thousandth: another unit."""
    clocks = recorded.clocks
    if clocks is None or not wrong_time_unit(recorded):
        return
    assert clocks.unit_factor is not None
    yield Finding(fact=Fact("time-unit", **asdict(clocks), factor=clocks.unit_factor), severity="error")


def wrong_time_unit(recorded: Recorded) -> bool:
    """Whether the spans tell of another unit, and no alignment contradicts."""
    clocks = recorded.clocks
    return clocks is not None and clocks.unit_factor is not None and not isinstance(recorded.aligned, Alignment)


def check_clock_rate(recorded: Recorded) -> Iterator[Finding]:
    """A camera's clock that runs faster or slower than the IMU's."""
    aligned = recorded.aligned
    if isinstance(aligned, Alignment) and aligned.drifts(faster_than=_LIMITS.rate):
        yield rate_finding(aligned.calibration.clock_rate)


def rate_finding(rate: float) -> Finding:
    severity: Severity = "error" if abs(rate) > _LIMITS.wrong_rate else "warning"
    return Finding(fact=Fact("clock-rate", rate=rate), severity=severity)


def frame_rate_finding(rate: float) -> Finding:
    """Frame times by a wrong frame rate; ``rate`` is how many seconds of frames the IMU's second is."""
    return Finding(fact=Fact("frame-rate", rate=rate), severity="error")


def check_coverage(recorded: Recorded) -> Iterator[Finding]:
    """An IMU that was started late or stopped early."""
    imu = recorded.imu
    # poses may be of a part of the images
    frames = recorded.trajectory or recorded.timing
    if imu is None or frames is None or len(frames.t_s) < 3 or wrong_time_unit(recorded):
        return
    sensors = {"gyroscope": imu.gyro_t_s} | ({"accelerometer": imu.accel_t_s} if imu.has_accel else {})
    span_s = float(frames.t_s[-1] - frames.t_s[0])
    slack_s = max(_LIMITS.slack_frames * float(np.median(np.diff(frames.t_s))), _LIMITS.slack_share * span_s)
    shift_s = recorded.offset_s(frames.epoch_ns)

    def missed_s(begin_s: float, end_s: float) -> float:
        """What of the frames a sensor missed that ran from when to when."""
        if shift_s is None:
            return span_s - (end_s - begin_s)
        return float(max(begin_s + shift_s - frames.t_s[0], 0) + max(frames.t_s[-1] - end_s - shift_s, 0))

    begin_s, end_s = max(t_s[0] for t_s in sensors.values()), min(t_s[-1] for t_s in sensors.values())
    both_s = missed_s(begin_s, end_s)
    if both_s <= slack_s:
        return
    short = [name for name, t_s in sensors.items() if missed_s(t_s[0], t_s[-1]) > slack_s]
    share = float(np.clip(1 - both_s / span_s, 0, 1))
    alone = {"sensor": short[0]} if len(short) == 1 and len(sensors) == 2 else {}
    yield Finding(
        fact=Fact("imu-too-short", share=share, frames_s=span_s, imu_s=end_s - begin_s, **alone),
        severity="error" if share < _LIMITS.least_covered else "warning",
    )


def check_even_times(recorded: Recorded) -> Iterator[Finding]:
    """Frame times that drift to and fro against the gyroscope, as those counted from a frame rate do."""
    aligned, imu, turning = recorded.aligned, recorded.imu, recorded.turning
    if not isinstance(aligned, Alignment) or imu is None or turning is None:
        return
    if float(np.median(np.diff(turning.t_s))) > _LIMITS.part_reach_s / 2:
        return
    motion = GyroCamera.of(imu, aligned.calibration, camera_epoch_ns=turning.epoch_ns)
    parts = []
    count = int(np.ptp(turning.t_s) / _LIMITS.part_s)
    for begin_s in turning.t_s[0] + _LIMITS.part_s * np.arange(count):
        inside = np.flatnonzero((turning.t_s >= begin_s) & (turning.t_s < begin_s + _LIMITS.part_s))
        drift_s = float(aligned.calibration.drift_s(begin_s + 0.5 * _LIMITS.part_s))
        part = _compare_part(turning.select(inside), motion, drift_s)
        if part is not None:
            parts.append(part)
    if len(parts) < 3:
        return
    middle_s = float(np.median([part.offset_s for part in parts]))
    off = np.array([part.offset_s - middle_s for part in parts])
    sigmas = np.array([part.sigmas_from(middle_s) for part in parts])
    counts = wandering(off, sigmas)
    if counts.any():
        worst = int(np.argmax(np.where(counts, np.abs(off), 0.0)))
        fact = Fact(
            "frame-times-uneven",
            wander_s=np.ptp(off),
            worst_s=parts[worst].middle_s - turning.t_s[0],
            parts=len(off),
            sigmas=sigmas[worst],
        )
        yield Finding(fact=fact, severity="error")


def wandering(off_s: Array, sigmas: Array) -> BoolArray:
    """Parts whose offsets differ from the usual one by more than chance and by what matters, and not they alone.

    Parameters
    ----------
    off_s, sigmas
        (N,) differences, and their sizes in standard deviations.
    """
    sizes = np.where(sigmas > _LIMITS.uneven_sigmas, np.abs(off_s), 0.0)
    others = np.sum(sizes > _LIMITS.another * _LIMITS.uneven_s) > 1
    return np.asarray((sizes > _LIMITS.uneven_s) & others)


@dataclass(frozen=True, eq=False, kw_only=True)
class _ComparedPart:
    """A part of the frames against the gyroscope at many corrections of the offset.

    Attributes
    ----------
    middle_s
        When it is.
    shifts_s, squares
        (S,) corrections, and twice the negative log likelihood of each; infinite where the gyroscope does not cover it.
    offset_s, sigma_s
        The best correction, and its standard deviation.
    """

    middle_s: float
    shifts_s: Array
    squares: Array
    offset_s: float
    sigma_s: float

    def sigmas_from(self, shift_s: float) -> float:
        """Standard deviations by which another correction is worse: by its likelihood, which may have other maxima, and
        by its distance.
        """
        known = np.isfinite(self.squares)
        worse = float(np.interp(shift_s, self.shifts_s[known], self.squares[known]) - self.squares.min())
        return min(max(worse, 0.0) ** 0.5, abs(shift_s - self.offset_s) / self.sigma_s)


def _compare_part(part: CameraTrajectory, motion: GyroCamera, drift_s: float) -> _ComparedPart | None:
    """Compare the rotations of a part; ``None`` where the gyroscope explains too little of it to tell."""
    if len(part) < 8:
        return None
    visual = part.turn_rad()
    shifts = np.arange(-_LIMITS.part_reach_s, _LIMITS.part_reach_s + 1e-9, _LIMITS.part_step_s)
    t_s = part.t_s - drift_s - shifts[:, None]
    covered = motion.covers(t_s[:, 0], t_s[:, -1])
    difference = visual - motion.turn_rad(t_s[covered])
    spread = difference - difference.mean(axis=1, keepdims=True)
    squares = np.full(len(shifts), np.inf)
    squares[covered] = np.median(np.sum(spread**2, axis=2), axis=1)
    best = int(np.argmin(squares))
    energy = float(np.median(np.sum((visual - visual.mean(axis=0)) ** 2, axis=1)))
    if best in (0, len(shifts) - 1) or not np.isfinite(squares[best - 1 : best + 2]).all():
        return None
    if squares[best] > (1 - _LIMITS.part_explained) * energy:
        return None
    # Cauchy's likelihood, at the scatter that the best offset leaves; errors of neighbouring frames go together
    scatter = max(squares[best] / _MEDIAN_CHI2, 1e-16)
    left = spread[int(np.flatnonzero(np.flatnonzero(covered) == best)[0])]
    squares[covered] = np.sum(3 * _CAUCHY**2 * np.log1p(np.sum(spread**2, axis=2) / scatter / (3 * _CAUCHY**2)), axis=1)
    squares /= _correlation_time(left)
    best = int(np.argmin(squares))
    if best in (0, len(shifts) - 1) or not np.isfinite(squares[best - 1 : best + 2]).all():
        return None
    before, least, after = squares[best - 1 : best + 2]
    curvature = max(before - 2 * least + after, 1e-9)
    sigma_s = (2 / curvature) ** 0.5 * _LIMITS.part_step_s
    return _ComparedPart(
        middle_s=0.5 * float(part.t_s[0] + part.t_s[-1]),
        shifts_s=shifts,
        squares=squares,
        offset_s=float(shifts[best] + 0.5 * _LIMITS.part_step_s * (before - after) / curvature),
        sigma_s=float(np.hypot(sigma_s, _LIMITS.known_frames * np.median(np.diff(part.t_s)))),
    )


#: Median of a chi-square of three degrees of freedom; standard deviations from which Cauchy's likelihood cuts.
_MEDIAN_CHI2, _CAUCHY = 2.366, 3.0


def _correlation_time(errors: Array) -> float:
    """How many of (N, 3) errors in a row count as one: Geyer's (1992) initial positive sequence; 1 at least."""
    centred = errors - errors.mean(axis=0)
    total = max(float(np.sum(centred**2)), 1e-30)
    out = 1.0
    for lag in range(1, len(centred) // 2):
        correlation = float(np.sum(centred[:-lag] * centred[lag:])) / total
        if correlation <= 0:
            break
        out += 2 * correlation
    return out
