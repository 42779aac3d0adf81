"""Checks of the inertial samples alone: units, axes, stamps, range, resolution, and whether both sensors keep step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, skew
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.sampling import MUCH_CUT, PAUSE_STEPS, find_clipped, integral_at, is_gap
from colmap_inertial.core.types import CameraTrajectory, ImuRecording
from colmap_inertial.diagnose.diagnosis import Finding, Recorded, Severity
from colmap_inertial.io.plausible import check_consistent
from colmap_inertial.motion.align import Alignment


@dataclass(frozen=True, kw_only=True)
class MotionCheckLimits:
    """Limits below which the motion gives no scale."""

    #: Specific force is compared with itself over windows this long, in means over steps this long.
    window_s: float = 2.0
    step_s: float = 0.05
    #: Below this (rms), nothing but sensor errors and the hand's tremor is left of the acceleration; errors of the axes
    #: leave some of gravity in it where the camera turns, in m/s2 per rad/s. Measured: 0.22 and more in clean
    #: recordings that turn by 0.3 rad/s, 0.11 and less in simulated ones on the spot that turn by 1.5.
    least_accel_m_s2: float = 0.08
    accel_per_turn_m_s: float = 0.05
    #: So many windows in which the camera accelerates are motion, however long it rests.
    lively: int = 3
    #: A camera that turns slower than this (rms) stands on something.
    rotated_rad_s: float = 0.02
    #: A path is straight where it is this many times longer than its points lie off a steady glide.
    straight: float = 20.0


_MOTION_LIMITS = MotionCheckLimits()


def check_motion_content(recorded: Recorded) -> Iterator[Finding]:
    """Report motion without acceleration, which gives no scale: rest, rotation on the spot, constant velocity."""
    imu = recorded.imu
    # in wrong units the motion cannot be judged
    if imu is None or not imu.has_accel or recorded.implausible or recorded.wrong_unit is not None:
        return
    accel = acceleration_rms_m_s2(imu)
    rate = imu.gyro_rad_s - np.median(imu.gyro_rad_s, axis=0)
    rotated = float(np.sqrt(np.mean(np.sum(rate**2, axis=1))))
    if accel is None or accel > _MOTION_LIMITS.least_accel_m_s2 + _MOTION_LIMITS.accel_per_turn_m_s * rotated:
        return
    if recorded.trajectory is not None and _glides(recorded.trajectory):
        code = "constant-velocity"
    elif rotated < _MOTION_LIMITS.rotated_rad_s:
        code = "no-motion"
    elif recorded.trajectory is not None:
        code = "pure-rotation"
    else:
        code = "no-acceleration"
    yield Finding(fact=Fact(code, acceleration_rms_m_s2=accel, turning_rms_rad_s=rotated), severity="error")


def acceleration_rms_m_s2(imu: ImuRecording) -> float | None:
    """Rms of the acceleration that is left once gravity, drift, bias and a lever arm are out; ``None`` where short.

    That of the median window, or of the third where fewer are lively.

    The specific force, turned by the integrated gyroscope, is gravity plus acceleration. In each window what is
    constant or changes evenly is taken out, as gravity and the gyroscope's drift do; over all of them, what a bias and
    a lever arm between the IMU and the centre of rotation explain.
    """
    path = GyroPath(imu.gyro_t_s, imu.gyro_rad_s, np.median(imu.gyro_rad_s, axis=0))
    begin_s, end_s = max(imu.gyro_t_s[0], imu.accel_t_s[0]), min(imu.gyro_t_s[-1], imu.accel_t_s[-1])
    steps = round(_MOTION_LIMITS.window_s / _MOTION_LIMITS.step_s)
    starts = np.arange(begin_s, end_s - _MOTION_LIMITS.window_s, _MOTION_LIMITS.window_s)
    starts = starts[path.covers(starts, starts + _MOTION_LIMITS.window_s)]
    if len(starts) < 2:
        return None
    edges = starts[:, None] + _MOTION_LIMITS.step_s * np.arange(steps + 1)
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    force = np.diff(integral_at(imu.accel_t_s, imu.accel_m_s2, edges), axis=1) / _MOTION_LIMITS.step_s
    rate = np.diff(integral_at(imu.gyro_t_s, imu.gyro_rad_s, edges), axis=1) / _MOTION_LIMITS.step_s
    turn = matrix_from_quat(path.at(middle.ravel())[0]).reshape(*middle.shape, 3, 3)
    swept = skew(rate)
    lever = skew(np.gradient(rate, _MOTION_LIMITS.step_s, axis=1)) + swept @ swept
    columns = np.concatenate([(turn @ force[..., None]), turn @ lever, turn], axis=-1)
    time = np.linspace(-1, 1, steps)
    even, _ = np.linalg.qr(np.stack([np.ones(steps), time, time**2], axis=1))
    residual = columns - np.einsum("kp,lp,wlij->wkij", even, even, columns)
    y, x = residual[..., 0].ravel(), residual[..., 1:].reshape(-1, 6)
    rest = y - x @ np.linalg.lstsq(x, y, rcond=1e-6)[0]
    energy = np.sort(np.sum(rest.reshape(len(starts), -1) ** 2, axis=1) / steps)
    # a moment of lifting the camera does not make a recording lively; a rest does not make it still
    return float(np.sqrt(max(np.median(energy), energy[-min(_MOTION_LIMITS.lively, len(energy))])))


def _glides(trajectory: CameraTrajectory) -> bool:
    """Whether the path is a straight line at constant speed, and longer than its noise."""
    basis = np.stack([np.ones(len(trajectory)), trajectory.t_s - trajectory.t_s.mean()], axis=1)
    fit = np.linalg.lstsq(basis, trajectory.cam_in_world, rcond=None)[0]
    off = np.sqrt(np.mean(np.sum((trajectory.cam_in_world - basis @ fit) ** 2, axis=1)))
    length = float(np.linalg.norm(fit[1])) * float(np.ptp(trajectory.t_s))
    return bool(length > _MOTION_LIMITS.straight * off)


@dataclass(frozen=True, kw_only=True)
class ImuCheckLimits:
    """Limits for inertial samples."""

    #: Pauses longer than this are findings (shorter ones cost nothing); over the second, much can happen in them.
    pause_s: float = 0.03
    long_pause_s: float = 0.5
    #: Pauses that take up more than this share of a recording leave too little.
    most_paused: float = 0.2
    rounding_share: float = 0.1
    #: Gyroscope and accelerometer must run together for this share of the shorter one.
    together: float = 0.5
    #: Search of the delay between the sensors: grid, smoothing, reach, and what counts. Measured: correlations of 0.66
    #: to 0.90 handheld, up to 0.51 where they tell nothing (a drone, an action camera on one).
    grid_hz: float = 50.0
    smooth_cells: int = 25
    reach_s: float = 0.5
    delay_s: float = 0.055
    delay_correlation: float = 0.6
    #: The hand's own acceleration turns with the hand, and moves what is found by 66 ms (rms) in 10 s of clean
    #: recordings, 38 in 30, 27 in 60: a random error that lasts for seconds, in seconds times the root of a second.
    hand_s_rts: float = 0.21
    #: Blocks of the jackknife, and how many standard deviations count: once in 10,000 recordings by chance.
    block_s: float = 2.0
    fewest_blocks: int = 4
    delay_sigmas: float = 4.0
    #: Hands shake up to 12 times a second. Below the first rate that is lost in part, below the second all of it.
    slow_hz: float = 45.0
    too_slow_hz: float = 18.0
    #: A camera that turns (rms) by less than the first, with less scatter than the second, in rad/s: a hand's turning
    #: divided by 57.3, and what a sensor's scatter becomes. And half of a recording faster than the third is no
    #: filming.
    hardly_rad_s: float = 0.05
    silent_rad_s: float = 0.0002
    whirling_rad_s: float = 3.0


_LIMITS = ImuCheckLimits()

#: Steps between readings, far coarser than any of today's sensors (12 bit over +-2 g: 0.01 m/s2; 16 bit over 2000
#: deg/s: 0.001 rad/s); and the share of the signal that their rounding may take.
_COARSE = {"gyroscope": 0.003, "accelerometer": 0.03}

#: Sensors scatter from sample to sample (rad/s, m/s2). Measured in eleven recordings of seven devices: 0.0013 and more,
#: 0.019 and more; low-passed at 2 Hz and at 5 Hz: 0.0003 and 0.001, 0.001 and 0.006 at most.
_SCATTER = {"gyroscope": 0.0004, "accelerometer": 0.005}
#: Motion that leaves no doubt that readings without scatter are smoothed ones.
_MOVING = {"gyroscope": 0.1, "accelerometer": 0.2}


def check_plausibility(recorded: Recorded) -> Iterator[Finding]:
    """Units, gravity, dead axes, exchanged sensors, axes that do not match: what a reader would refuse first."""
    for problem in recorded.implausible:
        yield Finding(fact=problem.fact, severity="error")


def check_axes(recorded: Recorded) -> Iterator[Finding]:
    """Axes of the sensors against each other once more, where a camera confirms the gyroscope's turning."""
    imu = recorded.imu
    if imu is None or not imu.has_accel or recorded.implausible or not isinstance(recorded.aligned, Alignment):
        return
    try:
        check_consistent(imu, confirmed=True)
    except FormatError as error:
        yield Finding(fact=error.fact, severity="error")


def check_accelerometer(recorded: Recorded) -> Iterator[Finding]:
    """Report a missing accelerometer: there is no scale without one."""
    if recorded.imu is not None and not recorded.imu.has_accel:
        yield Finding(fact=Fact("no-accelerometer"), severity="error")


#: The finding that a reader's repair belongs to; the others are ``"repaired"``.
_FINDING_OF_REPAIR = {
    "rows-without-sample": "empty-cells",
    "rows-without-value": "samples-missing",
    "rows-sorted": "stamps-reordered",
    "rows-merged": "stamps-repeated",
    "rows-averaged": "stamps-repeated",
}


def check_repairs(recorded: Recorded) -> Iterator[Finding]:
    """Report samples that the reader sorted, merged or dropped."""
    if recorded.imu is None:
        return
    by_code: dict[str, list[Fact]] = {}
    for repair in recorded.imu.repairs:
        by_code.setdefault(_FINDING_OF_REPAIR.get(repair.code, "repaired"), []).append(repair)
    for code, repairs in by_code.items():
        yield Finding(
            fact=Fact(code, repairs=len(repairs), each=repairs),
            severity="info" if code in ("empty-cells", "repaired") else "warning",
        )


def check_pauses(recorded: Recorded) -> Iterator[Finding]:
    """Pauses of either sensor while frames came, where it is known when they did."""
    begin_s, end_s = _find_filmed_span(recorded)
    for sensor, t_s, _ in _sensors(recorded.imu):
        step_s = np.diff(t_s)
        usual_s = float(np.median(step_s))
        inside = (t_s[1:] > begin_s) & (t_s[:-1] < end_s)
        pauses = step_s[inside & is_gap(t_s, _LIMITS.pause_s, steps=PAUSE_STEPS)]
        share = float(pauses.sum() / (t_s[-1] - t_s[0]))
        for code, some in (
            ("short-gap", pauses[pauses < _LIMITS.long_pause_s]),
            ("long-gap", pauses[pauses >= _LIMITS.long_pause_s]),
        ):
            if len(some) == 0:
                continue
            fact = Fact(
                code,
                sensor=sensor,
                pauses=len(some),
                longest_s=some.max(),
                total_s=some.sum(),
                step_s=usual_s,
                share=share,
            )
            yield Finding(fact=fact, severity="error" if share > _LIMITS.most_paused else "warning")


def _find_filmed_span(recorded: Recorded) -> tuple[float, float]:
    """First and last frame on the IMU's clock; without limits where it is not known."""
    frames = recorded.trajectory or recorded.timing
    shift_s = None if frames is None else recorded.offset_s(frames.epoch_ns)
    if frames is None or shift_s is None:
        return -np.inf, np.inf
    return float(frames.t_s[0]) - shift_s, float(frames.t_s[-1]) - shift_s


def check_rate(recorded: Recorded) -> Iterator[Finding]:
    """Readings that come too seldom for a hand's motion."""
    for sensor, t_s, _ in _sensors(recorded.imu):
        rate_hz = 1 / float(np.median(np.diff(t_s)))
        if rate_hz < _LIMITS.slow_hz:
            yield Finding(
                fact=Fact("rate-too-low", sensor=sensor, rate_hz=rate_hz),
                severity="error" if rate_hz < _LIMITS.too_slow_hz else "warning",
            )


def check_scatter(recorded: Recorded) -> Iterator[Finding]:
    """Readings without the scatter that every sensor has were smoothed, or are in another unit."""
    imu = recorded.imu
    if imu is None or recorded.implausible:
        return
    lengths = np.linalg.norm(imu.gyro_rad_s - np.median(imu.gyro_rad_s, axis=0), axis=1)
    turning, usual = float(np.sqrt(np.mean(lengths**2))), float(np.median(lengths))
    # the camera tells units better, where there is one
    alone = not isinstance(recorded.aligned, Alignment)
    if alone and usual > _LIMITS.whirling_rad_s:
        yield Finding(fact=Fact("gyro-in-deg", seen_in="usual", median_rad_s=usual), severity="warning")
    for sensor, _, values in _sensors(imu):
        scatter = scatter_of(values)
        if not 0 < scatter < _SCATTER[sensor]:
            continue
        if alone and sensor == "gyroscope" and turning < _LIMITS.hardly_rad_s and scatter < _LIMITS.silent_rad_s:
            fact = Fact("gyro-not-in-deg", seen_in="scatter", turning_rad_s=turning, scatter_rad_s=scatter)
            yield Finding(fact=fact, severity="warning")
            continue
        moving = turning if sensor == "gyroscope" else acceleration_rms_m_s2(imu) or 0.0
        if moving > _MOVING[sensor]:
            fact = Fact("low-passed", sensor=sensor, scatter=scatter, moving=moving)
            yield Finding(fact=fact, severity="warning")


def scatter_of(values: Array) -> float:
    """Standard deviation of what is white in (N, 3) readings, by their second differences; robust, the middle axis."""
    second = np.diff(values, 2, axis=0) / 6**0.5
    return float(np.median(np.median(np.abs(second), axis=0))) / 0.6745


def check_together(recorded: Recorded) -> Iterator[Finding]:
    """Gyroscope and accelerometer must have run at the same time."""
    imu = recorded.imu
    if imu is None or not imu.has_accel:
        return
    both_s = min(imu.gyro_t_s[-1], imu.accel_t_s[-1]) - max(imu.gyro_t_s[0], imu.accel_t_s[0])
    shorter_s = min(np.ptp(imu.gyro_t_s), np.ptp(imu.accel_t_s))
    if both_s < _LIMITS.together * shorter_s:
        yield Finding(fact=Fact("sensors-apart", together_s=both_s, shorter_s=shorter_s), severity="error")


def check_cut_off(recorded: Recorded) -> Iterator[Finding]:
    """Readings that end at a ceiling: the motion was faster than the sensor's range."""
    for sensor, _, values in _sensors(recorded.imu):
        counts = dict(zip("xyz", find_clipped(values).sum(axis=0).tolist(), strict=True))
        cut = {axis: count for axis, count in counts.items() if count}
        if cut:
            share = sum(cut.values()) / len(values)
            fact = Fact(
                "saturated",
                sensor=sensor,
                samples=sum(cut.values()),
                of=len(values),
                axes="".join(cut),
                counts=tuple(cut.values()),
                share=share,
            )
            yield Finding(fact=fact, severity="error" if share > MUCH_CUT else "warning")


def check_resolution(recorded: Recorded) -> Iterator[Finding]:
    """Readings that were rounded to a few bits."""
    for sensor, _, values in _sensors(recorded.imu):
        step = max(_resolution(values[:, axis]) for axis in range(3))
        if step <= _COARSE[sensor]:
            continue
        changing = values - np.median(values, axis=0)
        share = float(step / 12**0.5 / max(np.sqrt(np.mean(changing**2)), 1e-12))
        severity: Severity = "error" if share > _LIMITS.rounding_share else "warning"
        fact = Fact(
            "coarse-resolution",
            sensor=sensor,
            step=step,
            different_on_x=len(np.unique(values[:, 0])),
            rounding_share_of_signal=share,
        )
        yield Finding(fact=fact, severity=severity)


def _resolution(values: Array) -> float:
    """The step that most neighbouring readings are apart by; 0 where there is none."""
    levels = np.unique(values)
    if len(levels) < 2 or len(levels) > len(values) // 4:
        return 0.0
    return float(np.median(np.diff(levels)))


def check_delay(recorded: Recorded) -> Iterator[Finding]:
    """Gyroscope against accelerometer: as the device turns, gravity turns the other way in it, at the same time.

    A warning: the fit of camera and IMU finds the delay far better, and corrects it.
    """
    imu = recorded.imu
    if imu is None or not imu.has_accel or recorded.implausible:
        return
    delay = find_accel_delay(imu)
    if delay is not None and delay.counts:
        fact = Fact("sensors-offset", delay_s=delay.delay_s, delay_sigma_s=delay.sigma_s, correlation=delay.correlation)
        yield Finding(fact=fact, severity="warning")


@dataclass(frozen=True, kw_only=True)
class AccelDelay:
    """Delay of the accelerometer's stamps to the gyroscope's, its standard deviation, and the correlation there."""

    delay_s: float
    sigma_s: float
    correlation: float

    @property
    def counts(self) -> bool:
        """Whether it is larger than what matters, and than chance makes it."""
        least_s = max(_LIMITS.delay_s, _LIMITS.delay_sigmas * self.sigma_s)
        return self.correlation > _LIMITS.delay_correlation and abs(self.delay_s) > least_s


def find_accel_delay(imu: ImuRecording) -> AccelDelay | None:
    """Delay of the accelerometer's stamps; ``None`` where it cannot be estimated.

    Slow changes of the specific force a are those of gravity: its derivative is ``a x w``. The delay is where the two
    correlate best. Its standard deviation is that of the jackknife over blocks (Efron 1982), and what the hand's
    acceleration leaves.
    """
    begin_s, end_s = max(imu.gyro_t_s[0], imu.accel_t_s[0]), min(imu.gyro_t_s[-1], imu.accel_t_s[-1])
    edges = np.arange(begin_s, end_s, 1 / _LIMITS.grid_hz)
    reach = round(_LIMITS.reach_s * _LIMITS.grid_hz)
    margin = 2 * _LIMITS.smooth_cells + reach
    if len(edges) < 6 * margin:
        return None
    rate, force = (
        np.diff(integral_at(t_s, values, edges), axis=0) * _LIMITS.grid_hz
        for t_s, values in ((imu.gyro_t_s, imu.gyro_rad_s), (imu.accel_t_s, imu.accel_m_s2))
    )
    slow = _smooth(force)
    change = np.gradient(slow, 1 / _LIMITS.grid_hz, axis=0)[margin:-margin]
    delays = np.arange(-reach, reach + 1)
    turned = np.stack([_smooth(np.cross(slow, np.roll(rate, k, axis=0)))[margin:-margin] for k in delays])
    span_s = len(change) / _LIMITS.grid_hz
    blocks = max(_LIMITS.fewest_blocks, int(span_s / _LIMITS.block_s))
    block = np.arange(len(change)) * blocks // len(change)
    sums = [
        np.stack([np.bincount(block, row, blocks) for row in products.sum(axis=2)])
        for products in (turned * change, turned * turned, (change * change)[None])
    ]
    whole = _best_delay(*(part.sum(axis=1) for part in sums))
    without = [_best_delay(*(part.sum(axis=1) - part[:, i] for part in sums)) for i in range(blocks)]
    if whole is None or any(one is None for one in without):
        return None
    left = np.array([one[0] for one in without if one is not None])
    scatter_s2 = (blocks - 1) / blocks * float(np.sum((left - left.mean()) ** 2))
    return AccelDelay(
        delay_s=whole[0], sigma_s=(scatter_s2 + _LIMITS.hand_s_rts**2 / span_s) ** 0.5, correlation=whole[1]
    )


def _best_delay(together: Array, of_turned: Array, of_change: Array) -> tuple[float, float] | None:
    """Delay of the best correlation, and that; ``None`` where it lies at an end."""
    correlations = together / np.maximum(np.sqrt(of_turned * of_change), 1e-12)
    reach, k = len(correlations) // 2, int(np.argmax(correlations))
    if k in (0, len(correlations) - 1):
        return None
    before, best, after = correlations[k - 1 : k + 2]
    peak = k - reach + 0.5 * (before - after) / (before - 2 * best + after)
    return float(peak / _LIMITS.grid_hz), float(best)


def _smooth(values: Array) -> Array:
    kernel = np.ones(_LIMITS.smooth_cells) / _LIMITS.smooth_cells
    kernel = np.convolve(kernel, kernel)
    return np.stack([np.convolve(column, kernel, mode="same") for column in values.T], axis=1)


def _sensors(imu: ImuRecording | None) -> list[tuple[str, Array, Array]]:
    """Name, stamps and readings of the sensors that there are."""
    if imu is None:
        return []
    sensors = [("gyroscope", imu.gyro_t_s, imu.gyro_rad_s)]
    if imu.has_accel:
        sensors.append(("accelerometer", imu.accel_t_s, imu.accel_m_s2))
    return sensors
