"""Inputs of every estimator of the scale: the strength of gravity, and a recording on the camera's clock."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.options import GravityOptions, ScaleOptions
from colmap_inertial.core.types import (
    CameraImuCalibration,
    CameraTrajectory,
    ImuRecording,
    RotationConsensus,
)
from colmap_inertial.inertial.core.priors import PRIORS
from colmap_inertial.io.units import STANDARD_GRAVITY_M_S2
from colmap_inertial.motion.align import AlignOptions
from colmap_inertial.motion.align.consensus import align_by_consensus


def gravity_at_latitude_m_s2(latitude_deg: float, height_m: float = 0.0) -> float:
    """Normal gravity of the WGS 84 ellipsoid, on it and above it (NIMA TR8350.2, sections 4.1 and 4.3).

    Somigliana's closed formula, and its continuation upwards to the second order in the height, whose own error stays
    below 1e-6 m/s2 up to 10 km. What lies under the ground is not in it: gravity differs from it by 0.0003 m/s2 (rms)
    and by up to 0.003 m/s2 near high mountains and deep trenches, that is by 0.003 % to 0.03 %.

    Parameters
    ----------
    latitude_deg
        Geodetic, from -90 to 90.
    height_m
        Above the ellipsoid; that above the sea differs by 100 m at most, which is 0.0003 m/s2.
    """
    if not -90 <= latitude_deg <= 90:
        raise ValueError(f"latitude_deg must be from -90 to 90, not {latitude_deg}")
    if not -1000 <= height_m <= 10000:
        raise ValueError(f"height_m must be from -1000 to 10000, not {height_m}")
    sine_squared = np.sin(np.radians(latitude_deg)) ** 2
    numerator = 9.7803253359 * (1 + 0.00193185265241 * sine_squared)
    on_ellipsoid = float(numerator / np.sqrt(1 - 0.00669437999014 * sine_squared))
    # semi-major axis, flattening, and the ratio m of centrifugal force to gravity at the equator
    a, f, m = 6378137.0, 1 / 298.257223563, 0.00344978650684
    h = height_m / a
    return float(on_ellipsoid * (1 - 2 * (1 + f + m - 2 * f * sine_squared) * h + 3 * h**2))


def strength_of_gravity(options: GravityOptions) -> tuple[float, float]:
    """Gravity and its standard deviation, m/s2, by what is known of the place.

    Standard gravity, or a number of two decimals (9.81), says nothing of the place.
    """
    given = options.gravity_m_s2
    if given is not None and given != STANDARD_GRAVITY_M_S2:
        return given, PRIORS.gravity_m_s2 if round(given, 2) == given else PRIORS.known_gravity_m_s2
    if options.latitude_deg is not None:
        return gravity_at_latitude_m_s2(options.latitude_deg, options.height_m or 0.0), PRIORS.known_gravity_m_s2
    return STANDARD_GRAVITY_M_S2, PRIORS.gravity_m_s2


def align_recording(
    trajectory: CameraTrajectory, imu: ImuRecording, calibration: CameraImuCalibration | None, options: ScaleOptions
) -> tuple[CameraTimedImu, RotationConsensus]:
    """Align a recording with the camera, from a calibration that may be wide; and which cameras agree with it."""
    alignment, consensus = align_by_consensus(
        trajectory, imu, prior=calibration, options=AlignOptions(max_offset_s=options.max_offset_s)
    )
    return CameraTimedImu.from_recording(imu, alignment.settle_clock_rate(), trajectory.epoch_ns), consensus
