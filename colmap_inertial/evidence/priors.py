"""What is known beforehand of the sensors of phones: their own errors of scale, which no recording averages out."""

from __future__ import annotations

from dataclasses import dataclass

from colmap_inertial.core.types.evidence import Sensor

#: Errors that several sensors may share, and those of one alone; keys of ``ScaleEvidence.systematic``.
ACCEL_GAIN = "accel_gain"
LENS = "lens"
DEPTH_SCALE = "depth_scale"
DEVICE_FUSION = "device_fusion"
DEVICE_WANDER = "device_wander"
DECLARED = "declared"


@dataclass(frozen=True, kw_only=True)
class SensorPriors:
    """Standard deviations of the logarithm of the scale, by cause."""

    depth_scale: float = 0.01
    """A phone's LiDAR: about a centimetre over one to three metres (docs/dev/sensors.md)."""
    device_wander: float = 0.025
    """The path of a phone (ARKit, ARCore), whose scale wanders: 1 to 5 % within minutes."""
    device_fusion: float = 0.005
    """What a device's path and its fused depth have in common: one filter makes both."""


PRIORS = SensorPriors()

#: Share of recordings in which a sensor is wrong by more than its interval says; an accelerometer's as where the IMU is
#: judged by itself.
FAULTS: dict[Sensor, float] = {
    "imu": 0.1,
    "depth": 0.1,
    "device": 0.3,
    "positions": 0.1,
    "target": 0.05,
    "distance": 0.05,
}
#: Standard deviation of the logarithm of the scale of one that is: mostly a few per cent, and more where it shows.
FAULT_SIGMA = 0.04
#: Of those that are wrong, the share that is so by any factor: another unit, a board of another size, a foreign path.
GROSS_SHARE, GROSS_SIGMA = 0.05, 0.7
