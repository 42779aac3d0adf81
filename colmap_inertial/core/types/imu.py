"""An IMU: how it stands to the camera, what it recorded, how it reads what is true, and how noisy it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Array, check_fields, set_fields
from colmap_inertial.core.axes import Axes
from colmap_inertial.core.facts import Fact, as_fact
from colmap_inertial.core.summary import prints_in_lines

#: Order of the parameters in ``CameraImuCalibration.cov``. The rotation error is in the camera frame, on the left:
#: true = exp(error) * estimate.
CALIBRATION_PARAMETERS = (
    *("rotation_x_rad", "rotation_y_rad", "rotation_z_rad"),
    *("gyro_time_offset_s", "accel_time_offset_s"),
    *("gyro_bias_x_rad_s", "gyro_bias_y_rad_s", "gyro_bias_z_rad_s"),
    *("imu_in_cam_x_m", "imu_in_cam_y_m", "imu_in_cam_z_m"),
    "readout_s",
)


class CAL:
    """Indices and slices of ``CALIBRATION_PARAMETERS``."""

    ROTATION = slice(0, 3)
    GYRO_TIME_OFFSET, ACCEL_TIME_OFFSET = 3, 4
    TIME_OFFSETS = slice(3, 5)
    GYRO_BIAS = slice(5, 8)
    LEVER_ARM = slice(8, 11)
    READOUT = 11
    COUNT = 12


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class CameraImuCalibration:
    """Relation of the camera and the IMU of one device.

    Attributes
    ----------
    cam_from_imu_xyzw
        (4,) rotation.
    gyro_time_offset_s, accel_time_offset_s
        ``t_cam = t_stamp + offset`` between raw stamps (each clock's reading in seconds, epoch included).
    gyro_bias_rad_s
        (3,) IMU frame; the true rate is the reading minus this.
    imu_in_cam_m
        (3,) lever arm: the IMU's position in the camera frame.
    readout_s
        Rolling-shutter readout; 0 for a global shutter.
    cov
        (12, 12) in the order of ``CALIBRATION_PARAMETERS``. Wide where nothing is known.
    clock_rate, clock_middle_s
        Growth of the time offsets per second of the camera's clock (0 where the clocks keep step), and the camera
        time, since the epoch of the frame times, at which the offsets hold. ``CameraTimedImu`` holds a
        recording for which they hold throughout.
    """

    cam_from_imu_xyzw: Array
    gyro_time_offset_s: float
    accel_time_offset_s: float
    gyro_bias_rad_s: Array
    imu_in_cam_m: Array
    readout_s: float
    cov: Array
    clock_rate: float = 0.0
    clock_middle_s: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self, cam_from_imu_xyzw=(4,), gyro_bias_rad_s=(3,), imu_in_cam_m=(3,), cov=(CAL.COUNT, CAL.COUNT))
        if not (abs(self.clock_rate) < 1 and math.isfinite(self.clock_middle_s)):
            raise ValueError("clock_rate must lie between -1 and 1, clock_middle_s must be finite")

    def sigma(self, parameter: str) -> float:
        """Standard deviation of one of ``CALIBRATION_PARAMETERS``."""
        i = CALIBRATION_PARAMETERS.index(parameter)
        return float(np.sqrt(self.cov[i, i]))

    @property
    def rotation_sigma_rad(self) -> float:
        """Standard deviation of the rotation about the camera axis about which it is known worst."""
        return float(np.sqrt(np.diagonal(self.cov)[CAL.ROTATION].max()))

    @property
    def clock_offset_s(self) -> float:
        """Camera time less a stamp of the gyroscope."""
        return self.gyro_time_offset_s

    @property
    def clock_offsets_s(self) -> tuple[float, float]:
        """Camera time less a stamp of the gyroscope, and of the accelerometer."""
        return self.gyro_time_offset_s, self.accel_time_offset_s

    @property
    def accel_delay_s(self) -> float:
        """Time offset of the accelerometer minus that of the gyroscope."""
        return self.accel_time_offset_s - self.gyro_time_offset_s

    @property
    def clock_sigma_s(self) -> float:
        """Standard deviation of the clock offset."""
        return self.sigma("gyro_time_offset_s")

    def replace_clock_offset(self, offset_s: float, accel_delay_s: float = 0.0) -> CameraImuCalibration:
        """The calibration with another time offset, the accelerometer's larger by a delay; ``cov`` stays."""
        return replace(self, gyro_time_offset_s=offset_s, accel_time_offset_s=offset_s + accel_delay_s)

    def shift_clock_offsets(self, by_s: float, accel_by_s: float) -> CameraImuCalibration:
        """The calibration with both time offsets larger, the accelerometer's by the second as well; ``cov`` stays."""
        return replace(
            self,
            gyro_time_offset_s=self.gyro_time_offset_s + by_s,
            accel_time_offset_s=self.accel_time_offset_s + by_s + accel_by_s,
        )

    def drift_s(self, t_cam_s: Array) -> Array:
        """Growth of the time offsets since ``clock_middle_s``, at camera times of any shape."""
        return np.asarray(self.clock_rate * (t_cam_s - self.clock_middle_s))


@dataclass(frozen=True, eq=False, kw_only=True)
class ImuNoise:
    """White-noise densities and bias walks of an IMU, as data sheets give them.

    Attributes
    ----------
    gyro_density_rad_s_rthz, accel_density_m_s2_rthz
        White noise, per square root of hertz.
    gyro_walk_rad_s2_rthz, accel_walk_m_s3_rthz
        Random walk of the biases.
    """

    gyro_density_rad_s_rthz: float
    accel_density_m_s2_rthz: float
    gyro_walk_rad_s2_rthz: float
    accel_walk_m_s3_rthz: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{name}: must be finite and not negative")


#: A phone's IMU where no data sheet is at hand: gyroscopes have 1e-4 to 1e-3 rad/s/sqrt(Hz). The accelerometer's white
#: noise is ten times the data sheets' of consumer MEMS, as sensors in use show (vibration, bandwidth, jitter).
TYPICAL_NOISE = ImuNoise(
    gyro_density_rad_s_rthz=3e-4, accel_density_m_s2_rthz=5e-3, gyro_walk_rad_s2_rthz=3e-4, accel_walk_m_s3_rthz=3e-4
)
#: Walk of the gyroscope's bias where its gains and axis errors are estimated along, as the joint fit does: without what
#: those errors add to it as the device turns.
JOINT_GYRO_WALK_RAD_S_RTS = 1e-4


#: Samples of an IMU that are further apart are stamped in another unit than seconds.
SLOWEST_S = 3.0

_ENTRIES = tuple(f"{row}{column}" for row in "xyz" for column in "xyz")

#: Order of the parameters in ``ImuCalibration.cov``; matrices row by row.
IMU_CALIBRATION_PARAMETERS = (
    *(f"accel_gain_{entry}" for entry in _ENTRIES),
    *(f"accel_bias_{axis}_m_s2" for axis in "xyz"),
    *(f"gyro_gain_{entry}" for entry in _ENTRIES),
    *(f"gyro_bias_{axis}_rad_s" for axis in "xyz"),
)


class IMU_CAL:
    """Slices of ``IMU_CALIBRATION_PARAMETERS``."""

    ACCEL_GAIN, ACCEL_BIAS = slice(0, 9), slice(9, 12)
    GYRO_GAIN, GYRO_BIAS = slice(12, 21), slice(21, 24)
    COUNT = 24


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class ImuCalibration:
    """Corrections of an IMU's readings, estimated from rests in several attitudes.

    The true specific force is ``(I + accel_gain) reading - accel_bias_m_s2``, the true rate
    ``(I + gyro_gain) reading - gyro_bias_rad_s``, both in one frame: x along the accelerometer's x axis, y in the plane
    of its x and y axes. ``accel_gain`` has three gains and three misalignments (nothing above its diagonal), and
    ``gyro_gain`` three gains, and six entries that say how its axes stand in that frame.

    Attributes
    ----------
    accel_gain, gyro_gain
        (3, 3) errors of gain and alignment.
    accel_bias_m_s2, gyro_bias_rad_s
        (3,) what is left to subtract. Biases change from one day to the next; gains hardly do.
    cov
        (24, 24) in the order of ``IMU_CALIBRATION_PARAMETERS``. What was not determined keeps its prior.
    gravity_m_s2
        The strength of gravity that the gains refer to.
    temperature_c
        Of the sensor, where it was logged.
    device
        What was calibrated; empty where unknown.
    attitudes
        In how many it lay still; 0 where targets were compared instead.
    compared
        How many results were compared with targets.
    accel_factor
        On the accelerometer's part of a scale's interval, by such results; ``None`` without.
    """

    accel_gain: Array
    accel_bias_m_s2: Array
    gyro_gain: Array
    gyro_bias_rad_s: Array
    cov: Array
    gravity_m_s2: float
    temperature_c: float | None = None
    device: str = ""
    attitudes: int
    compared: int = 0
    accel_factor: float | None = None

    def __post_init__(self) -> None:
        gains, biases = {"accel_gain": (3, 3), "gyro_gain": (3, 3)}, {"accel_bias_m_s2": (3,), "gyro_bias_rad_s": (3,)}
        check_fields(self, **gains, **biases, cov=(IMU_CAL.COUNT, IMU_CAL.COUNT))
        for name in ("accel_gain", "gyro_gain"):
            if np.abs(getattr(self, name)).max() > 0.5:
                raise ValueError(f"{name}: its entries are errors, a few per cent at most; these are no errors of gain")
        if not (math.isfinite(self.gravity_m_s2) and self.gravity_m_s2 > 0):
            raise ValueError("gravity_m_s2 must be positive and finite")
        if self.temperature_c is not None and not math.isfinite(self.temperature_c):
            raise ValueError("temperature_c must be finite")
        if self.attitudes < 0:
            raise ValueError("attitudes must not be negative")
        if self.accel_factor is not None and not (0 < self.accel_factor < math.inf and self.compared > 0):
            raise ValueError("accel_factor must be positive, and be that of compared results")

    def sigma(self, parameter: str) -> float:
        """Standard deviation of one of ``IMU_CALIBRATION_PARAMETERS``."""
        i = IMU_CALIBRATION_PARAMETERS.index(parameter)
        return float(np.sqrt(self.cov[i, i]))

    @property
    def gain_sigma(self) -> float:
        """Standard deviation of the accelerometer's gain along the direction in which it is known worst."""
        along = np.einsum("ni,nj->nij", _DIRECTIONS, _DIRECTIONS).reshape(-1, 9)
        block = self.cov[IMU_CAL.ACCEL_GAIN, IMU_CAL.ACCEL_GAIN]
        return float(np.sqrt(np.einsum("ni,ij,nj->n", along, block, along).max()))

    def loosened(self, calibration: CameraImuCalibration) -> CameraImuCalibration:
        """The calibration of camera and IMU with its rotation widened by the gyroscope's misalignment to the
        accelerometer.

        It may have been found with readings that were not corrected, whose axes are the gyroscope's own.
        """
        askew = 0.5 * (self.gyro_gain - self.gyro_gain.T)
        cov = calibration.cov.copy()
        cov[:3, :3] += 0.5 * float(np.sum(askew**2)) * np.eye(3)
        return replace(calibration, cov=cov)

    def summary(self) -> dict[str, object]:
        """Summary for a result, in JSON types."""
        return {
            "device": self.device,
            "attitudes": self.attitudes,
            "accel_gain": self.accel_gain.tolist(),
            "gyro_gain": self.gyro_gain.tolist(),
            "gain_sigma": self.gain_sigma,
            "gravity_m_s2": self.gravity_m_s2,
            "temperature_c": self.temperature_c,
            "compared": self.compared,
            "accel_factor": self.accel_factor,
        }

    def corrected(self, imu: ImuRecording) -> ImuRecording:
        """A recording of the same device with true readings, as far as they are known; it carries this calibration.

        Raises
        ------
        ValueError
            Where it was corrected before.
        """
        if imu.calibration is not None:
            raise ValueError("the recording was corrected by a calibration before")
        repair = Fact("imu-corrected", attitudes=self.attitudes)
        if self.accel_factor is not None:
            repair = self.comparison()
        return replace(
            imu,
            gyro_rad_s=imu.gyro_rad_s @ (np.eye(3) + self.gyro_gain).T - self.gyro_bias_rad_s,
            accel_m_s2=imu.accel_m_s2 @ (np.eye(3) + self.accel_gain).T - self.accel_bias_m_s2,
            calibration=self,
            repairs=(*imu.repairs, repair),
        )

    def comparison(self) -> Fact:
        """What results that were compared with targets say."""
        return Fact("imu-compared", accel_factor=self.accel_factor, compared=self.compared)

    def uncorrected(self, gyro_rad_s: Array, accel_m_s2: Array) -> tuple[Array, Array]:
        """(N, 3), (M, 3) what the sensors read where these are the true values."""
        undo_gyro, undo_accel = (np.linalg.inv(np.eye(3) + gain).T for gain in (self.gyro_gain, self.accel_gain))
        gyro, accel = gyro_rad_s + self.gyro_bias_rad_s, accel_m_s2 + self.accel_bias_m_s2
        return np.asarray(gyro @ undo_gyro), np.asarray(accel @ undo_accel)


@dataclass(frozen=True, eq=False, kw_only=True)
class ImuSource:
    """Where readings come from, for messages.

    Attributes
    ----------
    path
        File or folder.
    accel_path
        Where the accelerometer's come from, if not from there.
    gyro_axes, accel_axes
        Mappings of axes that were applied, so that a message can name the ones to write in their place.
    """

    path: Path = Path("IMU")
    accel_path: Path | None = None
    gyro_axes: Axes | None = None
    accel_axes: Axes | None = None

    def path_of(self, quantity: Literal["gyro", "accel"]) -> Path:
        """Where a sensor's readings come from."""
        return self.accel_path if quantity == "accel" and self.accel_path is not None else self.path


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class ImuRecording:
    """Gyroscope and accelerometer samples of one recording.

    Attributes
    ----------
    gyro_t_s, accel_t_s
        (N,), (M,) stamps in seconds since ``epoch_ns`` on the IMU's clock, strictly increasing. Two time bases: a
        gyroscope sample never belongs to an accelerometer sample by index.
    gyro_rad_s
        (N, 3) angular velocity in the IMU frame.
    accel_m_s2
        (M, 3) specific force in the IMU frame, gravity included. A gyroscope alone has no samples here (M = 0).
    epoch_ns
        The clock's reading, in nanoseconds, where both time bases are zero.
    repairs
        What the reader had to sort, merge or drop, and what was corrected since.
    device
        What recorded it, where known.
    noise
        The data sheet's noise, where the recording comes with one.
    calibration
        What the readings were corrected by (``ImuCalibration.corrected``); ``None`` where they are the sensor's own.
    temperature_c
        How warm the sensors were (median), degrees Celsius, where it was logged.
    source
        Where it comes from, for messages; nothing is decided by it.
    """

    gyro_t_s: Array
    gyro_rad_s: Array
    accel_t_s: Array
    accel_m_s2: Array
    epoch_ns: int = 0
    repairs: tuple[Fact, ...] = ()
    device: str = ""
    noise: ImuNoise | None = None
    calibration: ImuCalibration | None = None
    temperature_c: float | None = None
    source: ImuSource = field(default=ImuSource(), compare=False, repr=False)

    def __post_init__(self) -> None:
        check_fields(self, gyro_t_s=("N",), accel_t_s=("M",), gyro_rad_s=("N", 3), accel_m_s2=("M", 3))
        set_fields(self, repairs=tuple(map(as_fact, self.repairs)))
        if len(self.gyro_t_s) < 2 or len(self.accel_t_s) == 1:
            raise ValueError("an ImuRecording needs at least two samples of each sensor (or none of the accelerometer)")
        for name in ("gyro_t_s", "accel_t_s"):
            step_s = float(np.median(np.diff(getattr(self, name)))) if len(getattr(self, name)) else 0.0
            if step_s > SLOWEST_S:
                raise ValueError(f"{name}: samples lie {step_s:.3g} s apart, which no IMU does; give seconds")
        if self.temperature_c is not None and not np.isfinite(self.temperature_c):
            raise ValueError("temperature_c must be finite")

    @property
    def has_accel(self) -> bool:
        """Whether the accelerometer was recorded; without it there is no scale and no gravity."""
        return len(self.accel_t_s) > 0

    @property
    def warmer_k(self) -> float | None:
        """Temperature above that of the calibration; ``None`` where either was not logged."""
        then = None if self.calibration is None else self.calibration.temperature_c
        return None if then is None or self.temperature_c is None else self.temperature_c - then


def _directions(count: int) -> Array:
    """(count, 3) unit vectors evenly over half the sphere (Fibonacci's spiral)."""
    up = (np.arange(count) + 0.5) / count
    around = np.pi * (1 + 5**0.5) * np.arange(count)
    level = np.sqrt(1 - up**2)
    return np.stack([level * np.cos(around), level * np.sin(around), up], axis=1)


_DIRECTIONS = _directions(400)
