"""Camera-IMU alignment: rotation, time offset and gyroscope bias from the gyroscope against visual rotation.

Step 1 of Mustaniemi et al., "Inertial-based scale estimation for structure from motion on mobile devices" (IROS 2017),
with three changes. Every offset at which the two recordings could coincide is searched, because clock origins are
arbitrary. Rotations over intervals between frames are compared instead of differentiated orientations, so that video
and sparse keyframes are treated alike. And a result is refused where no offset is clearly better than the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.align._clock_search import ClockFit, explained_at, intervals_of, search_offsets, spaced_frames
from colmap_inertial.align._fit import refine_alignment
from colmap_inertial.align._prior import UNKNOWN_OFFSET_S, calibration_prior
from colmap_inertial.errors import NotObservableError
from colmap_inertial.gyro import GyroPath
from colmap_inertial.types import CameraImuCalibration, CameraTrajectory, ImuRecording, clock_shift_s

#: Frames closer together than the first have turned by less than the noise of their poses; over the second, the noise
#: of poses is small against the rotation that is to be explained.
_SPACING_S, _CHECK_SPACING_S = 0.1, 0.3


@dataclass(frozen=True, kw_only=True)
class AlignOptions:
    """How the clocks of camera and IMU are brought together."""

    max_offset_s: float | None = None
    """Largest offset between raw stamps to consider; 1 for a shared clock. Without it, every offset is searched."""

    min_overlap: float = 0.25
    """Smallest part of the shorter recording that the other one must cover for an offset to be considered."""

    min_log_likelihood: float = 12.0
    """How much likelier, in nats, the offset must be than the next best one and than no relation at all.

    Where two recordings have nothing in common, the gap between the best offset and the next is distributed roughly
    as an exponential of mean one, so that 12 would be exceeded 6 times in a million.
    """

    min_explained: float = 0.75
    """Smallest part of the camera's rotation over 0.3 s that the gyroscope must explain."""


def align_camera_imu(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    *,
    prior: CameraImuCalibration | None = None,
    options: AlignOptions | None = None,
) -> CameraImuCalibration:
    """Rotation, time offset and gyroscope bias between a camera and an IMU.

    Parameters
    ----------
    trajectory
        At least five poses; only their rotations are used. Video and keyframes seconds apart both serve.
    imu
        Only the gyroscope is used.
    prior
        What is known beforehand (``calibration_prior`` builds one). Its lever arm, readout and accelerometer delay
        pass through; a time offset with a standard deviation below ``UNKNOWN_OFFSET_S`` narrows the search to five
        standard deviations. Where the search cannot find the rotation by itself, a known rotation is held.
    options
        Search range and thresholds.

    Returns
    -------
    A calibration with covariance in the order of ``CALIBRATION_PARAMETERS``. The covariance is that of generalised
    least squares with pose noise (white, per frame) and gyroscope noise (random walk) estimated from the residuals,
    widened per parameter to what the scatter between twelve parts of the recording shows: errors of a real camera
    (rolling shutter above all) are not white. It describes the very rotations that were used here: as a prior of a
    second estimate from the same recording it would count them twice.

    Raises
    ------
    NotObservableError
        Where no offset is clearly better than the rest (another recording's IMU, no rotation, rotation that repeats
        itself), where the recordings cannot overlap, or where turning about one axis only leaves the rotation open.
    """
    options = options or AlignOptions()
    prior = prior or calibration_prior()
    if len(trajectory) < 5:
        raise NotObservableError("time offset", f"{len(trajectory)} poses are too few to compare with the gyroscope")
    start = _search(trajectory, imu, prior, options)
    keep = spaced_frames(trajectory.t_s, _SPACING_S)
    return refine_alignment(trajectory.select(keep), imu, start, prior).calibration


def _search(
    trajectory: CameraTrajectory, imu: ImuRecording, prior: CameraImuCalibration, options: AlignOptions
) -> ClockFit:
    """The coarse fit, or the reason why there is none."""
    shift_s = clock_shift_s(trajectory, imu)
    lowest_s, highest_s = -np.inf, np.inf
    if options.max_offset_s is not None:
        lowest_s, highest_s = shift_s - options.max_offset_s, shift_s + options.max_offset_s
    sigma_s = prior.sigma("gyro_time_offset_s")
    if sigma_s < UNKNOWN_OFFSET_S:
        centre_s = prior.gyro_time_offset_s + shift_s
        lowest_s, highest_s = max(lowest_s, centre_s - 5 * sigma_s), min(highest_s, centre_s + 5 * sigma_s)
    intervals = intervals_of(trajectory, _SPACING_S)
    turned = np.linalg.norm(intervals.turn_rad, axis=1).sum()
    path = GyroPath(imu.gyro_t_s, imu.gyro_rad_s, np.zeros(3))
    rotation_known = max(prior.sigma(f"rotation_{axis}_rad") for axis in "xyz") < 0.2
    for held in (None, prior.cam_from_imu_xyzw) if rotation_known else (None,):
        fits = search_offsets(
            intervals,
            path,
            lowest_s=lowest_s,
            highest_s=highest_s,
            min_overlap=options.min_overlap,
            cam_from_imu_xyzw=held,
        )
        if not fits:
            raise NotObservableError(
                "time offset",
                "camera and IMU do not overlap at any offset that is allowed: check the clocks"
                + (
                    f", or allow more than {options.max_offset_s:g} s between them"
                    if options.max_offset_s is not None
                    else " and the lengths of the recordings"
                ),
            )
        best = fits[0]
        rival = max(0.0, *(fit.log_likelihood for fit in fits[1:])) if len(fits) > 1 else 0.0
        explained = explained_at(intervals_of(trajectory, _CHECK_SPACING_S), path, best.offset_s, held)
        if best.log_likelihood - rival >= options.min_log_likelihood and explained >= options.min_explained:
            return best
    duration_s = float(trajectory.t_s[-1] - trajectory.t_s[0])
    if turned < 0.02 * duration_s + 0.05:
        hint = "the camera hardly rotates: turn it about all three axes while recording"
        raise NotObservableError("camera-IMU rotation", hint)
    within = "" if options.max_offset_s is None else f" within {options.max_offset_s:g} s"
    if best.explained > options.min_explained and rival > 0:
        hint = (
            f"the rotations fit almost as well at another offset{within}: record longer, with rotation that does not "
            "repeat itself"
        )
    else:
        hint = (
            f"at no offset{within} does the gyroscope fit the camera's rotations clearly better than at the rest "
            f"(it explains {100 * max(best.explained, 0):.0f} %): check that this IMU recording belongs to these "
            "images, or record longer with rotation about all three axes"
        )
    raise NotObservableError("time offset", hint)


__all__ = ["UNKNOWN_OFFSET_S", "AlignOptions", "align_camera_imu", "calibration_prior"]
