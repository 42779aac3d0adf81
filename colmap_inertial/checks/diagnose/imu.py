"""What the inertial samples tell by themselves: units, axes, stamps, range, resolution, and whether both keep step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from colmap_inertial.checks.diagnose.findings import Finding, Recorded, Severity
from colmap_inertial.checks.diagnose.motion import acceleration_rms_m_s2
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.sampling import MUCH_CUT, PAUSE_STEPS, at_ceiling, integral_at, is_gap
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.motion.align import Alignment


@dataclass(frozen=True, kw_only=True)
class ImuCheckLimits:
    """When inertial samples are not good enough."""

    #: Pauses longer than this are findings (shorter ones cost nothing); over the second, much can happen in them.
    pause_s: float = 0.03
    long_pause_s: float = 0.5
    #: Pauses that take up more than this share of a recording leave too little.
    most_paused: float = 0.2
    rounding_share: float = 0.1
    #: Gyroscope and accelerometer must run together for this share of the shorter one.
    together: float = 0.5
    #: Search of the delay between the sensors: grid, smoothing, reach, and what counts. Measured: up to 0.04 s of bias
    #: by the hand's accelerations in clean recordings, correlations of 0.66 to 0.90 handheld, up to 0.51 where they
    #: tell nothing (a drone, an action camera on one).
    grid_hz: float = 50.0
    smooth_cells: int = 25
    reach_s: float = 0.5
    delay_s: float = 0.055
    delay_correlation: float = 0.6
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

_UNITS = {"gyroscope": "rad/s", "accelerometer": "m/s2"}


def check_plausibility(recorded: Recorded) -> Iterator[Finding]:
    """Units, gravity, dead axes, exchanged sensors, axes that do not match: what a reader would refuse first."""
    for problem in recorded.implausible:
        yield refusal(problem)


#: Refusals (``io.plausible``) that make a reconstruction in metres meaningless.
_STOPPING_REFUSALS = ("gravity-removed", "gyro-in-deg", "gyro-not-in-deg")


def refusal(error: FormatError) -> Finding:
    """A reader's refusal, whose sentence gives what was found, then what to do."""
    evidence, _, advice = error.reason.partition(": ")
    return Finding(
        code=error.code,
        severity="error",
        stops=error.code in _STOPPING_REFUSALS,
        evidence=evidence,
        advice=advice or "correct it in the file or in capture.toml",
    )


def check_accelerometer(recorded: Recorded) -> Iterator[Finding]:
    """Without one there are no metres."""
    if recorded.imu is not None and not recorded.imu.has_accel:
        yield Finding(
            code="no-accelerometer",
            severity="error",
            evidence="the recording holds a gyroscope alone",
            advice="record the accelerometer too, gravity included; without it there is deblurring, but no scale",
        )


def check_repairs(recorded: Recorded) -> Iterator[Finding]:
    """What the reader sorted, merged and dropped."""
    if recorded.imu is None:
        return
    by_code: dict[str, list[str]] = {}
    for repair in recorded.imu.repairs:
        by_code.setdefault(getattr(repair, "code", "repaired"), []).append(str(repair))
    for code, said in by_code.items():
        yield Finding(
            code=code,
            severity="info" if code in ("empty-cells", "repaired") else "warning",
            evidence="; ".join(said),
            advice="nothing: it was repaired while reading; if there is much of it, look at the logger",
            numbers={"repairs": len(said)},
        )


def check_pauses(recorded: Recorded) -> Iterator[Finding]:
    """Pauses of either sensor."""
    for sensor, t_s, _ in _sensors(recorded.imu):
        step_s = np.diff(t_s)
        usual_s = float(np.median(step_s))
        pauses = step_s[is_gap(t_s, _LIMITS.pause_s, steps=PAUSE_STEPS)]
        share = float(pauses.sum() / (t_s[-1] - t_s[0]))
        for code, some in (
            ("short-gap", pauses[pauses < _LIMITS.long_pause_s]),
            ("long-gap", pauses[pauses >= _LIMITS.long_pause_s]),
        ):
            if len(some) == 0:
                continue
            yield Finding(
                code=code,
                severity="error" if share > _LIMITS.most_paused else "warning",
                evidence=f"the {sensor} pauses {len(some)} times, {some.max():.3f} s at the longest, "
                f"{some.sum():.2f} s in all; it samples every {1e3 * usual_s:.1f} ms",
                advice="the scale bridges it, less surely; close other apps, or log to a faster card, and record again",
                numbers={"pauses": len(some), "longest_s": float(some.max()), "share": share},
            )


def check_rate(recorded: Recorded) -> Iterator[Finding]:
    """Readings that come too seldom for a hand's motion."""
    for sensor, t_s, _ in _sensors(recorded.imu):
        rate_hz = 1 / float(np.median(np.diff(t_s)))
        if rate_hz < _LIMITS.slow_hz:
            yield Finding(
                code="rate-too-low",
                severity="error" if rate_hz < _LIMITS.too_slow_hz else "warning",
                evidence=f"the {sensor} reads {rate_hz:.3g} times a second; a hand shakes ten times a second",
                advice="log at 100 Hz or more, at the app's or sensor's highest rate",
                numbers={"rate_hz": rate_hz},
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
        yield Finding(
            code="gyro-in-deg",
            severity="warning",
            evidence=f"half of the time the gyroscope turns faster than {usual:.2g} rad/s, as nobody films: the "
            "numbers are probably in deg/s",
            advice='set unit = "deg/s" under [imu.gyro] in capture.toml, if they are',
            numbers={"median_rad_s": usual},
        )
    for sensor, _, values in _sensors(imu):
        scatter = scatter_of(values)
        if not 0 < scatter < _SCATTER[sensor]:
            continue
        if alone and sensor == "gyroscope" and turning < _LIMITS.hardly_rad_s and scatter < _LIMITS.silent_rad_s:
            yield Finding(
                code="gyro-not-in-deg",
                severity="warning",
                evidence=f"the gyroscope turns by {turning:.2g} rad/s and scatters by {scatter:.1g} rad/s from sample "
                "to sample, less than sensors do: rad/s were probably converted as if they were deg/s",
                advice='set unit = "rad/s" under [imu.gyro] in capture.toml, if the camera was in a hand',
                numbers={"turning_rad_s": turning, "scatter_rad_s": scatter},
            )
            continue
        moving = turning if sensor == "gyroscope" else acceleration_rms_m_s2(imu) or 0.0
        if moving > _MOVING[sensor]:
            yield Finding(
                code="low-passed",
                severity="warning",
                evidence=f"the {sensor} hardly scatters from sample to sample ({scatter:.1g} {_UNITS[sensor]}), though "
                "the device moves: its readings were smoothed",
                advice="record the raw sensor, without the app's or the device's smoothing or fusion",
                numbers={"scatter": scatter, "moving": moving},
            )


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
        yield Finding(
            code="sensors-apart",
            severity="error",
            evidence=f"gyroscope and accelerometer run together for {max(both_s, 0):.1f} s of {shorter_s:.1f} s",
            advice="give two files of one recording, stamped by one clock",
            numbers={"together_s": float(both_s), "shorter_s": float(shorter_s)},
        )


def check_cut_off(recorded: Recorded) -> Iterator[Finding]:
    """Readings that end at a ceiling: the motion was faster than the sensor's range."""
    for sensor, _, values in _sensors(recorded.imu):
        counts = dict(zip("xyz", at_ceiling(values).sum(axis=0).tolist(), strict=True))
        cut = {axis: count for axis, count in counts.items() if count}
        if cut:
            share = sum(cut.values()) / len(values)
            yield Finding(
                code="saturated",
                severity="error" if share > MUCH_CUT else "warning",
                evidence=f"{sum(cut.values())} of {len(values)} {sensor} samples stand at the end of the range "
                f"({', '.join(f'{axis}: {count}' for axis, count in cut.items())})",
                advice="move less violently, or give the sensor a wider range",
                numbers={"samples": float(sum(cut.values())), "share": share},
            )


def check_resolution(recorded: Recorded) -> Iterator[Finding]:
    """Readings that were rounded to a few bits."""
    for sensor, _, values in _sensors(recorded.imu):
        step = max(_resolution(values[:, axis]) for axis in range(3))
        if step <= _COARSE[sensor]:
            continue
        changing = values - np.median(values, axis=0)
        share = float(step / 12**0.5 / max(np.sqrt(np.mean(changing**2)), 1e-12))
        severity: Severity = "error" if share > _LIMITS.rounding_share else "warning"
        yield Finding(
            code="coarse-resolution",
            severity=severity,
            evidence=f"the {sensor} reads in steps of {step:.3g} {_UNITS[sensor]} "
            f"({len(np.unique(values[:, 0]))} different values on x)",
            advice="log the sensor's full resolution; write more digits into the file",
            numbers={"step": step, "rounding_share_of_signal": share},
        )


def _resolution(values: Array) -> float:
    """The step that most neighbouring readings are apart by; 0 where there is none."""
    levels = np.unique(values)
    if len(levels) < 2 or len(levels) > len(values) // 4:
        return 0.0
    return float(np.median(np.diff(levels)))


def check_delay(recorded: Recorded) -> Iterator[Finding]:
    """Gyroscope against accelerometer: as the device turns, gravity turns the other way in it, at the same time."""
    imu = recorded.imu
    if imu is None or not imu.has_accel or recorded.implausible:
        return
    delay_s, correlation = accel_delay_s(imu)
    if abs(delay_s) > _LIMITS.delay_s and correlation > _LIMITS.delay_correlation:
        yield Finding(
            code="sensors-offset",
            severity="error",
            evidence=f"the accelerometer's stamps are {1e3 * delay_s:+.0f} ms off the gyroscope's: there, gravity "
            f"turns against the gyroscope with a correlation of {correlation:.2f}",
            advice="stamp both sensors by one clock, when they were sampled and not when they were written",
            numbers={"delay_s": delay_s, "correlation": correlation},
        )


def accel_delay_s(imu: ImuRecording) -> tuple[float, float]:
    """How late the accelerometer's stamps are, and the correlation there (0 where nothing can be told).

    Slow changes of the specific force a are those of gravity: its derivative is ``a x w``. The delay is where the two
    correlate best.
    """
    begin_s, end_s = max(imu.gyro_t_s[0], imu.accel_t_s[0]), min(imu.gyro_t_s[-1], imu.accel_t_s[-1])
    edges = np.arange(begin_s, end_s, 1 / _LIMITS.grid_hz)
    reach = round(_LIMITS.reach_s * _LIMITS.grid_hz)
    margin = 2 * _LIMITS.smooth_cells + reach
    if len(edges) < 6 * margin:
        return 0.0, 0.0
    rate, force = (
        np.diff(integral_at(t_s, values, edges), axis=0) * _LIMITS.grid_hz
        for t_s, values in ((imu.gyro_t_s, imu.gyro_rad_s), (imu.accel_t_s, imu.accel_m_s2))
    )
    slow = _smooth(force)
    change = np.gradient(slow, 1 / _LIMITS.grid_hz, axis=0)[margin:-margin]
    delays = np.arange(-reach, reach + 1)
    correlations = np.array(
        [_correlation(change, _smooth(np.cross(slow, np.roll(rate, k, axis=0)))[margin:-margin]) for k in delays]
    )
    k = int(np.argmax(correlations))
    if k in (0, len(delays) - 1):
        return 0.0, 0.0
    before, best, after = correlations[k - 1 : k + 2]
    peak = delays[k] + 0.5 * (before - after) / (before - 2 * best + after)
    return float(peak / _LIMITS.grid_hz), float(best)


def _correlation(a: Array, b: Array) -> float:
    return float(np.sum(a * b) / max(np.sqrt(np.sum(a * a) * np.sum(b * b)), 1e-12))


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
