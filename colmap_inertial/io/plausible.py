"""Checks of an inertial recording against physics: units, gravity, dead axes, and axes that do not match.

Gyroscope and accelerometer are compared through gravity. Over a few seconds a hand's accelerations average out, and the
specific force, rotated back by the integrated gyroscope, is constant. Where it is far more constant under another
order, sign or unit of the gyroscope's axes, that one is true. Turns about the vertical change nothing here, and on a
drone, whose thrust follows its tilt, gravity seems fixed to the body: then nothing is decided.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import permutations, product
from math import pi
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.axes import Axes
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, quat_multiply
from colmap_inertial.core.sampling import Coverage, integral_at
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.io.units import SENSOR_NAMES, STANDARD_GRAVITY_M_S2, Quantity


@dataclass(frozen=True, kw_only=True)
class ConsistencyLimits:
    """Limits of the comparison of readings.

    On 8 handheld recordings, each with 47 wrong readings of its axes, 366 of 376 are named with the right one and none
    with a wrong one; the best other reading of the 8 clean recordings and of a drone has 0.02 in place of
    ``clear_advantage``.
    """

    #: Length of a window.
    window_s: float = 4.0
    #: Steps in which the gyroscope is integrated.
    step_s: float = 0.1
    #: Length of the means that are compared within a window.
    mean_s: float = 1.0
    #: Enough to decide; few enough to keep hours of recording cheap. With fewer than ``enough_windows`` another reading
    #: must be better by ``few_advantage``: of 92 clips of 20 s of the 8 recordings none is then accused, and of 552
    #: wrong readings 276 are named, all with the right one.
    fewest_windows: int = 5
    enough_windows: int = 6
    few_advantage: float = 1.0
    #: Windows that tell which mirroring it is, where the camera says that the gyroscope is mirrored.
    fewest_mirrored_windows: int = 3
    most_windows: int = 100
    #: Added to variances: below this, differences are sensor errors.
    floor_m2_s4: float = 0.02
    #: How much better another reading must be than the file's own, and than no rotation at all: mean logarithm of the
    #: ratio of variances, and its standard errors.
    clear_advantage: float = 0.5
    clear_standard_errors: float = 3.0


LIMITS = ConsistencyLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Reading:
    """A way to read a gyroscope: ``rate in the accelerometer's frame = factor * matrix @ stated rate``.

    Attributes
    ----------
    matrix
        (3, 3) signed permutation.
    factor
        1, pi/180 or 180/pi.
    """

    matrix: Array
    factor: float = 1.0


def _list_readings() -> tuple[Reading, ...]:
    """The readings as stated, in every other order and sign of the axes, and in other units."""
    matrices = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        matrices.append(matrix)
    units = [Reading(matrix=np.eye(3), factor=factor) for factor in (pi / 180, 180 / pi)]
    return (*(Reading(matrix=matrix) for matrix in matrices), *units)


def better_readings(imu: ImuRecording, *, confirmed: bool = False) -> tuple[Reading, ...]:
    """The readings of the gyroscope that agree with the accelerometer, where they clearly exclude the stated one.

    Each window's specific force is rotated into the gyroscope's frame at the window's start; its variance between
    one-second means is what a reading leaves unexplained. A mirrored reading integrates the opposite rotation, as
    ``M (w x a) = det(M) (M w x M a)``.

    Parameters
    ----------
    confirmed
        Whether a camera turns as the gyroscope says: there is no doubt then that the device turned.

    Returns
    -------
    The best one first, then those that the recording cannot tell from it; empty where the stated reading is fine or the
    recording cannot tell.
    """
    turns, force = _cut_windows(imu)
    if len(turns) < LIMITS.fewest_windows:
        return ()
    readings = _list_readings()
    spread = _measure_spread(turns, force, readings)
    ranked = np.argsort(np.mean(spread, axis=1), kind="stable").tolist()
    best = spread[ranked[0]]
    at_rest = _log_variance(force)
    turned = float((at_rest - best).mean()) > LIMITS.clear_advantage if confirmed else _is_clearly_better(best, at_rest)
    if not (turned and _is_clearly_better(best, spread[0])):
        return ()
    return tuple(readings[i] for i in ranked if not _is_clearly_better(best, spread[i]))


def best_mirrored_reading(imu: ImuRecording) -> Reading | None:
    """The mirrored reading of the gyroscope under which gravity stands still best; ``None`` for a short recording.

    Minus the unit matrix says that both sensors are mirrored alike, or that the gyroscope measures the opposite.
    """
    turns, force = _cut_windows(imu)
    if len(turns) < LIMITS.fewest_mirrored_windows:
        return None
    readings = [reading for reading in _list_readings() if np.linalg.det(reading.matrix) < 0]
    return readings[int(np.argmin(np.mean(_measure_spread(turns, force, readings), axis=1)))]


def _measure_spread(turns: Array, force: Array, readings: Sequence[Reading]) -> list[Array]:
    """Logarithm of the variance (W,) that each reading leaves of the specific force in each window."""
    orientations: dict[float, Array] = {}
    spread = []
    for reading in readings:
        # R(M w) = M R(w) M^T for a rotation M, and M R(-w) M^T for a mirrored one; M in front keeps variances
        signed = reading.factor * float(np.linalg.det(reading.matrix).round())
        if signed not in orientations:
            orientations[signed] = _integrate(signed * turns)
        spread.append(_log_variance(np.einsum("nkij,nkj->nki", orientations[signed], force @ reading.matrix)))
    return spread


def _is_clearly_better(better: Array, worse: Array) -> bool:
    difference = worse - better
    error = float(difference.std(ddof=1)) / len(difference) ** 0.5
    advantage = LIMITS.clear_advantage if len(better) >= LIMITS.enough_windows else LIMITS.few_advantage
    return bool(difference.mean() > max(advantage, LIMITS.clear_standard_errors * error))


def _log_variance(force: Array) -> Array:
    """(W,) of (W, K, 3) specific forces: logarithm of the variance of their means over ``mean_s``."""
    means = force.reshape(len(force), -1, round(LIMITS.mean_s / LIMITS.step_s), 3).mean(axis=2)
    variance = ((means - means.mean(axis=1, keepdims=True)) ** 2).sum(axis=2).mean(axis=1)
    return np.asarray(np.log(variance + LIMITS.floor_m2_s4))


def _integrate(turns: Array) -> Array:
    """(W, K, 3, 3) window_from_body at the middle of each step, of the turns (W, K, 3) within the steps.

    Of order two in the steps of a tenth of a second, for all windows at once; differences of degrees are looked for.
    """
    between = quat_exp(0.5 * np.concatenate([turns[:, :1], turns[:, :-1] + turns[:, 1:]], axis=1))
    orientation = np.empty_like(between)
    orientation[:, 0] = between[:, 0]
    for k in range(1, between.shape[1]):
        orientation[:, k] = quat_multiply(orientation[:, k - 1], between[:, k])
    return matrix_from_quat(orientation)


def _cut_windows(imu: ImuRecording) -> tuple[Array, Array]:
    """Turns (W, K, 3) in rad and mean specific forces (W, K, 3) in m/s2 of each step of each window without a gap."""
    start_s, end_s = max(imu.gyro_t_s[0], imu.accel_t_s[0]), min(imu.gyro_t_s[-1], imu.accel_t_s[-1])
    count = max(0, int((end_s - start_s) / LIMITS.window_s))
    chosen = np.unique(np.linspace(0, count - 1, min(count, LIMITS.most_windows)).astype(np.intp))
    steps_in_window = round(LIMITS.window_s / LIMITS.step_s)
    edges = start_s + chosen[:, None] * LIMITS.window_s + np.arange(steps_in_window + 1) * LIMITS.step_s
    whole = np.ones(len(edges), dtype=bool)
    steps = []
    for t_s, values in ((imu.gyro_t_s, imu.gyro_rad_s), (imu.accel_t_s, imu.accel_m_s2)):
        whole &= Coverage(t_s).covers(edges[:, 0], np.minimum(edges[:, -1], end_s))
        steps.append(np.diff(integral_at(t_s, values, edges), axis=1))
    return steps[0][whole], steps[1][whole] / LIMITS.step_s


@dataclass(frozen=True, kw_only=True)
class PlausibleReadings:
    """Bounds that readings of a working IMU in SI units keep."""

    #: The median of |accelerometer| of a device that is carried or flown stays near gravity: sensors are off by up to 5
    #: %, and shaking raises it. Measured on the recordings this was tried on: 9.36 to 9.81, and 10.4 in strong shaking.
    smallest_gravity_m_s2: float = 7.0
    largest_gravity_m_s2: float = 14.0
    #: The 5th percentile of |accelerometer| over its median: above 0.75 with gravity, below 0.45 without.
    steady_share: float = 0.6
    #: No gyroscope in phones, cameras or drones measures more than 4000 deg/s on an axis.
    largest_rate_rad_s: float = 70.0
    #: Half of a recording faster than a turn in 0.9 s: nobody films like that, but deg/s read as rad/s look like it.
    largest_median_rate_rad_s: float = 7.0


PLAUSIBLE = PlausibleReadings()


def check_readings(imu: ImuRecording) -> ImuRecording:
    """The recording, if its numbers can be rad/s and m/s2 of a working IMU.

    Raises
    ------
    FormatError
        For deg/s, g, exchanged sensors, missing gravity, a dead sensor or axis, axes of one sensor that do not match
        the other's. The message says what was found, what is expected, and what to write in capture.toml.
    """
    for fault in find_faults(imu):
        raise fault
    return imu


def find_faults(imu: ImuRecording) -> Iterator[FormatError]:
    """Everything that :func:`check_readings` would refuse a recording for, each with a code.

    What follows from an earlier fault is not looked for: axes are compared in right units only.
    """
    path, accel_path = imu.source.path, imu.source.path_of("accel")
    sensors, units, axes = [partial(check_alive, imu.gyro_rad_s, "gyro", path)], [], []
    if imu.has_accel:
        sensors += [
            partial(check_alive, imu.accel_m_s2, "accel", accel_path),
            partial(check_exchanged, imu, path),
        ]
        units = [partial(check_gravity, np.linalg.norm(imu.accel_m_s2, axis=1), accel_path)]
        axes = [partial(check_consistent, imu)]
    for checks in (sensors, [*units, partial(check_rates, imu.gyro_rad_s, path)], axes):
        is_faulty = False
        for check in checks:
            try:
                check()
            except FormatError as fault:
                is_faulty = True
                yield fault
        if is_faulty:
            return


def check_exchanged(imu: ImuRecording, path: Path) -> None:
    """Refuse a gyroscope that reads gravity beside an accelerometer that does not."""
    lengths = (np.linalg.norm(values, axis=1) for values in (imu.gyro_rad_s, imu.accel_m_s2))
    (gyro_few, gyro), (accel_few, accel) = (np.percentile(length, [5, 50]).tolist() for length in lengths)
    low, high = PLAUSIBLE.smallest_gravity_m_s2, PLAUSIBLE.largest_gravity_m_s2
    # gravity in g or m/s2 that was read as a rate keeps its length, and rates that were read as force do not
    as_rate = any(low < gyro * unit * g < high for unit in (1.0, 180 / pi) for g in (1.0, STANDARD_GRAVITY_M_S2))
    steady = gyro_few > PLAUSIBLE.steady_share * gyro and accel_few <= PLAUSIBLE.steady_share * accel
    near = low < gyro < high and accel < PLAUSIBLE.largest_median_rate_rad_s
    if not low < accel < high and (near or (as_rate and steady)):
        raise FormatError(path, Fact("sensors-exchanged", gyro_median=gyro, accel_median=accel))


def check_alive(values: Array, quantity: Quantity, path: Path) -> None:
    """Refuse a sensor with an axis that never changes.

    Parameters
    ----------
    values
        (N, 3) samples.
    """
    dead = np.flatnonzero(np.ptp(values, axis=0) == 0)
    if len(dead) == 0:
        return
    name = SENSOR_NAMES[quantity]
    if len(dead) == 3:
        raise FormatError(path, Fact("dead-sensor", sensor=name, table=quantity, reading=values[0]))
    axes = ["xyz"[i] for i in dead]
    raise FormatError(path, Fact("dead-axis", sensor=name, table=quantity, axes=axes, reading=values[0, dead[0]]))


def check_gravity(lengths_m_s2: Array, path: Path) -> None:
    """Refuse an accelerometer whose median length is not near gravity.

    Parameters
    ----------
    lengths_m_s2
        (M,) lengths of the samples.
    """
    low, high = PLAUSIBLE.smallest_gravity_m_s2, PLAUSIBLE.largest_gravity_m_s2
    median, few = (float(value) for value in np.percentile(lengths_m_s2, [50, 5]))
    if low <= median <= high:
        return
    # Gravity keeps the length near its median; what is left without it comes near zero again and again.
    steady = few > PLAUSIBLE.steady_share * median
    if steady and low <= median * STANDARD_GRAVITY_M_S2 <= high:
        code = "accel-in-g"
    elif steady and low <= median / STANDARD_GRAVITY_M_S2 <= high:
        code = "accel-not-in-g"
    elif steady and low <= 0.5 * median <= high:
        code = "gravity-doubled"
    elif not steady:
        code = "gravity-removed"
    else:
        code = "accel-unit"
    raise FormatError(path, Fact(code, median_m_s2=median))


def check_rates(gyro_rad_s: Array, path: Path) -> None:
    """Refuse angular velocities that no hand, drone or sensor reaches."""
    median = float(np.median(np.linalg.norm(gyro_rad_s, axis=1)))
    largest = float(np.abs(gyro_rad_s).max())
    if largest <= PLAUSIBLE.largest_rate_rad_s and median <= PLAUSIBLE.largest_median_rate_rad_s:
        return
    read = {
        "largest_rad_s": largest,
        "median_rad_s": median,
        "sensor_ends_rad_s": PLAUSIBLE.largest_rate_rad_s,
    }
    if pi / 180 * largest > PLAUSIBLE.largest_rate_rad_s or pi / 180 * median > PLAUSIBLE.largest_median_rate_rad_s:
        raise FormatError(path, Fact("gyro-unit", **read))
    raise FormatError(path, Fact("gyro-in-deg", seen_in="rates", **read))


def check_consistent(imu: ImuRecording, *, confirmed: bool = False) -> None:
    """Refuse a gyroscope that clearly fits the accelerometer better with other axes or in another unit.

    Parameters
    ----------
    confirmed
        As of :func:`better_readings`.
    """
    readings, path = better_readings(imu, confirmed=confirmed), imu.source.path
    if not readings:
        return
    best = readings[0]
    if best.factor < 1:
        raise FormatError(path, Fact("gyro-in-deg", seen_in="gravity"))
    if best.factor > 1:
        raise FormatError(path, Fact("gyro-not-in-deg", seen_in="gravity"))
    stated = {"gyro": imu.source.gyro_axes, "accel": imu.source.accel_axes}

    def setting(quantity: Quantity, matrix: Array) -> tuple[str, bool]:
        before = stated[quantity]
        return Axes(matrix=matrix if before is None else matrix @ before.matrix).setting()

    def settings(reading: Reading) -> tuple[tuple[str, bool], ...]:
        gyro = setting("gyro", reading.matrix)
        if np.linalg.det(reading.matrix) < 0:
            return (gyro,)
        # A mirrored accelerometer looks like a rotated gyroscope from here: a' = P a needs the rate det(P) P w. Only
        # the user can tell which; the wrong choice leaves both sensors mirrored against the camera.
        return gyro, setting("accel", -reading.matrix.T)

    gyro, *accel = settings(best)
    others = tuple(settings(other) for other in readings[1:3])
    if not accel:
        raise FormatError(path, Fact("axes-mirrored", gyro=gyro, others=others))
    mirroring = _find_mirrored_axes(-best.matrix.T)
    raise FormatError(path, Fact("axes-turned", gyro=gyro, accel=accel[0], accel_mirroring=mirroring, others=others))


def _find_mirrored_axes(matrix: Array) -> str:
    """The axis of an accelerometer that a signed permutation mirrors back, or the two that it exchanges; else none."""
    kept = np.diag(matrix)
    if np.abs(kept).all() and (kept < 0).sum() == 1:
        return "xyz"[int(np.argmin(kept))]
    return "".join("xyz"[i] for i in np.flatnonzero(kept == 0)) if (matrix >= 0).all() else ""
