"""Are these numbers an IMU's, in the units that were declared? Physics that no honest recording can break."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.io.consistency import better_readings
from colmap_inertial.io.units import SENSOR_NAMES, STANDARD_GRAVITY_M_S2, Axes, Quantity


@dataclass(frozen=True, kw_only=True)
class PlausibleReadings:
    """Bounds that readings of a working IMU in SI units keep."""

    #: The median of |accelerometer| of a device that is carried or flown stays near gravity: sensors are off by up to 5
    #: %, and shaking raises it. Measured on the recordings this was tried on: 9.36 to 9.81, and 10.4 in strong shaking.
    smallest_gravity_m_s2: float = 7.0
    #: The median of |accelerometer| of a device that is carried or flown stays near gravity: sensors are off by up to 5
    #: %, and shaking raises it. Measured on the recordings this was tried on: 9.36 to 9.81, and 10.4 in strong shaking.
    largest_gravity_m_s2: float = 14.0
    #: The 5th percentile of |accelerometer| over its median: above 0.75 with gravity, below 0.45 without.
    steady_share: float = 0.6
    #: No gyroscope in phones, cameras or drones measures more than 4000 deg/s on an axis.
    largest_rate_rad_s: float = 70.0
    #: Half of a recording faster than a turn in 0.9 s: nobody films like that, but deg/s read as rad/s look like it.
    largest_median_rate_rad_s: float = 7.0


PLAUSIBLE = PlausibleReadings()


def check_plausible(
    imu: ImuRecording,
    path: Path,
    *,
    accel_path: Path | None = None,
    gyro_axes: Axes | None = None,
    accel_axes: Axes | None = None,
) -> None:
    """Refuse a recording whose numbers cannot be rad/s and m/s2 of a working IMU.

    Parameters
    ----------
    imu
        The recording as read.
    path
        Where it came from, for the message.
    accel_path
        Where the accelerometer came from; faults of it alone name this file. By default it is ``path`` too.
    gyro_axes, accel_axes
        Mappings of axes that were applied already, so that the message can name the ones to write in their place.

    Raises
    ------
    FormatError
        For deg/s, g, exchanged sensors, missing gravity, a dead sensor or axis, axes of one sensor that do not match
        the other's. The message says what was found, what is expected, and what to write in capture.toml.
    """
    accel_path = path if accel_path is None else accel_path
    for problem in find_implausible(imu, path, accel_path=accel_path, gyro_axes=gyro_axes, accel_axes=accel_axes):
        raise problem


def find_implausible(
    imu: ImuRecording,
    path: Path,
    *,
    accel_path: Path | None = None,
    gyro_axes: Axes | None = None,
    accel_axes: Axes | None = None,
) -> Iterator[FormatError]:
    """Everything that :func:`check_plausible` would refuse a recording for, each with a code; parameters as there.

    What follows from a fault that was found already is not looked for: axes are compared in right units only.
    """
    accel_path = path if accel_path is None else accel_path
    lengths = np.linalg.norm(imu.accel_m_s2, axis=1)
    sensors, units, axes = [partial(check_alive, imu.gyro_rad_s, "gyro", path)], [], []
    if imu.has_accel:
        sensors += [partial(check_alive, imu.accel_m_s2, "accel", accel_path), partial(check_exchanged, imu, path)]
        units = [partial(check_gravity, lengths, accel_path)]
        axes = [partial(check_consistent, imu, path, gyro_axes=gyro_axes, accel_axes=accel_axes)]
    for checks in (sensors, [*units, partial(check_rates, imu.gyro_rad_s, path)], axes):
        found = False
        for check in checks:
            try:
                check()
            except FormatError as problem:
                found = True
                yield problem
        if found:
            return


def check_exchanged(imu: ImuRecording, path: Path) -> None:
    """Refuse a gyroscope that reads gravity beside an accelerometer that does not."""
    gyro = float(np.median(np.linalg.norm(imu.gyro_rad_s, axis=1)))
    accel = float(np.median(np.linalg.norm(imu.accel_m_s2, axis=1)))
    low, high = PLAUSIBLE.smallest_gravity_m_s2, PLAUSIBLE.largest_gravity_m_s2
    if low < gyro < high and not low < accel < high and accel < PLAUSIBLE.largest_median_rate_rad_s:
        raise FormatError(
            path,
            f"the gyroscope's median length is {gyro:.2f} and the accelerometer's {accel:.2f}: the two sensors are "
            "exchanged; exchange the columns or files of [imu.gyro] and [imu.accel] in capture.toml",
            code="sensors-exchanged",
        )


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
        raise FormatError(
            path,
            f"the {name} never changes (it reads {np.array2string(values[0], precision=4)} throughout): the sensor is "
            f"dead or was not recorded; record again, or give another file in [imu.{quantity}]",
            code="dead-sensor",
        )
    axes = " and ".join("xyz"[i] for i in dead)
    raise FormatError(
        path,
        f"the {name}'s {axes} axis never changes (it reads {values[0, dead[0]]:.6g} throughout): the axis is dead or "
        f"the wrong column; check columns of [imu.{quantity}] in capture.toml",
        code="dead-axis",
    )


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
    found = f"the accelerometer's median length is {median:.4g} where gravity gives about 9.8 m/s2"
    # Gravity keeps the length near its median; what is left without it comes near zero again and again.
    steady = few > PLAUSIBLE.steady_share * median
    if steady and low <= median * STANDARD_GRAVITY_M_S2 <= high:
        raise FormatError(
            path, f'{found}: the numbers are in g; set unit = "g" under [imu.accel] in capture.toml', code="accel-in-g"
        )
    if steady and low <= median / STANDARD_GRAVITY_M_S2 <= high:
        raise FormatError(
            path,
            f'{found}: m/s2 were converted as if they were g; set unit = "m/s2" under [imu.accel] in capture.toml',
            code="accel-not-in-g",
        )
    if steady and low <= 0.5 * median <= high:
        raise FormatError(
            path,
            f"{found}: gravity was added twice, or the readings are doubled; give the accelerometer as it was logged",
            code="gravity-doubled",
        )
    if not steady:
        raise FormatError(
            path,
            f"{found}: gravity was taken out (a phone's linear acceleration); give the accelerometer with gravity in "
            "[imu.accel]",
            code="gravity-removed",
        )
    raise FormatError(
        path,
        f"{found}: the unit is wrong, or these are raw counts; set unit under [imu.accel]",
        code="accel-unit",
    )


def check_rates(gyro_rad_s: Array, path: Path) -> None:
    """Refuse angular velocities that no hand, drone or sensor reaches."""
    median = float(np.median(np.linalg.norm(gyro_rad_s, axis=1)))
    largest = float(np.abs(gyro_rad_s).max())
    if largest <= PLAUSIBLE.largest_rate_rad_s and median <= PLAUSIBLE.largest_median_rate_rad_s:
        return
    raise FormatError(
        path,
        f"the gyroscope reads up to {largest:.4g} rad/s, half of the time above {median:.3g} (a hand reaches about 5, "
        f"a sensor ends at {PLAUSIBLE.largest_rate_rad_s:g}): the numbers are in deg/s; "
        'set unit = "deg/s" under [imu.gyro] in capture.toml',
        code="gyro-in-deg",
    )


def check_consistent(
    imu: ImuRecording, path: Path, *, gyro_axes: Axes | None = None, accel_axes: Axes | None = None
) -> None:
    """Refuse a gyroscope that clearly fits the accelerometer better with other axes or in another unit."""
    readings = better_readings(imu)
    if not readings:
        return
    best = readings[0]
    found = "seen from the turning gyroscope gravity does not stand still, but would"
    if best.factor < 1:
        raise FormatError(
            path,
            f'{found} if the gyroscope\'s numbers were in deg/s: set unit = "deg/s" under [imu.gyro] in capture.toml',
            code="gyro-in-deg",
        )
    if best.factor > 1:
        raise FormatError(
            path,
            f'{found} at 57.3 times the rate: rad/s were converted as if they were deg/s; set unit = "rad/s" under '
            "[imu.gyro] in capture.toml",
            code="gyro-not-in-deg",
        )
    stated = {"gyro": gyro_axes, "accel": accel_axes}

    def setting(quantity: Quantity, matrix: Array) -> str:
        before = stated[quantity]
        axes = Axes(matrix=matrix if before is None else matrix @ before.matrix)
        return f'axes = "{axes}"{" and mirrored = true" if axes.is_mirrored else ""} under [imu.{quantity}]'

    what = "mirrored" if np.linalg.det(best.matrix) < 0 else "turned against the accelerometer's"
    hint = f"set {setting('gyro', best.matrix)} in capture.toml"
    if what != "mirrored":
        # A mirrored accelerometer looks like a rotated gyroscope from here: a' = P a needs the rate det(P) P w. Only
        # the user can tell which; the wrong choice leaves both sensors mirrored against the camera.
        accel = -best.matrix.T
        hint += f", or, if {_mirroring(accel)}, set instead {setting('accel', accel)}"
    for other in readings[1:3]:
        hint += f"; hardly less likely: {setting('gyro', other.matrix)}"
        if np.linalg.det(other.matrix) > 0:
            hint += f", or {setting('accel', -other.matrix.T)}"
    raise FormatError(
        path,
        f"{found} if the gyroscope's axes are {what}: {hint}",
        code="axes-mirrored" if what == "mirrored" else "axes-turned",
    )


def _mirroring(matrix: Array) -> str:
    """What is wrong with an accelerometer that a mirrored signed permutation puts right."""
    kept = np.diag(matrix)
    if np.abs(kept).all() and (kept < 0).sum() == 1:
        return f"it is the accelerometer's {'xyz'[int(np.argmin(kept))]} axis that is mirrored"
    if (matrix >= 0).all():
        first, second = ("xyz"[i] for i in np.flatnonzero(kept == 0))
        return f"it is the accelerometer's {first} and {second} columns that are exchanged"
    return "it is the accelerometer's axes that are mirrored"
