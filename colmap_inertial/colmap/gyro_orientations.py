"""Where a camera looked, by its gyroscope, and how sure that is between any two frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.colmap.gyro_bias import RayPairs, bias_correction
from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.geometry import so3_log
from colmap_inertial.core.sampling import is_gap
from colmap_inertial.core.types import (
    CAL,
    JOINT_GYRO_WALK_RAD_S_RTS,
    TYPICAL_NOISE,
    CameraImuCalibration,
    CameraModel,
    FrameTiming,
    ImuRecording,
)
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.align import AlignOptions, align_clocks
from colmap_inertial.motion.flow import VisualRotation
from colmap_inertial.pipeline.run.context import Recording

#: Optical axes farther apart than this share next to nothing, or than the field of view, where that is wider.
APART_DEG = 90.0
#: A pair is ruled out, and a rotation disagrees, beyond so many standard deviations.
_SURE_SIGMAS = 3.0
#: Errors of a gyroscope's gains and of its axes, as ``align`` allows for.
_GAIN_SIGMA, _AXIS_SIGMA = 0.01, 0.005 / math.sqrt(2)
#: Standard deviation of the rotation of two views far apart, whose matches may be few or on a plane.
_TWO_VIEWS_RAD = math.radians(1.5)


@dataclass(frozen=True, eq=False, kw_only=True)
class GyroOrientations:
    """Orientations of frames by the gyroscope, with all that makes two of them unsure against each other.

    Attributes
    ----------
    t_s
        (N,) the instants, camera clock.
    start_from_cam
        (N, 3, 3) orientations.
    part
        (N,) frames of one part have no gap of the gyroscope between them; -1 outside its recording.
    bias_lever_s, gain_lever_rad
        (N, 3, 3), (N, 3, 6) what a change of the bias and of the gains turns the way here by (:class:`GyroPath`).
    rate_rad_s
        (N,) angular speed.
    calibration
        Its covariance counts.
    density_rad_s_rthz, walk_rad_s_rts
        White noise of the gyroscope, and the walk of its bias.
    apart_rad
        Optical axes farther apart see nothing in common.
    """

    t_s: Array
    start_from_cam: Array
    part: IndexArray
    bias_lever_s: Array
    gain_lever_rad: Array
    rate_rad_s: Array
    calibration: CameraImuCalibration
    density_rad_s_rthz: float
    walk_rad_s_rts: float
    apart_rad: float

    @classmethod
    def of(
        cls,
        imu: ImuRecording,
        calibration: CameraImuCalibration,
        timing: FrameTiming,
        camera: CameraModel | None,
    ) -> GyroOrientations:
        """Of the frames of ``timing``, by a calibration that fits the recording."""
        motion = GyroCamera.from_timed(CameraTimedImu.from_recording(imu, calibration, timing.epoch_ns))
        t_s = timing.pose_t_s()
        on_gyro_s, path = t_s - motion.offset_s, motion.path
        inside = (on_gyro_s >= path.t_s[0]) & (on_gyro_s <= path.t_s[-1])
        gaps = np.concatenate([[0], np.cumsum(is_gap(path.t_s))])
        place = np.clip(np.searchsorted(path.t_s, on_gyro_s, side="right") - 1, 0, len(path.t_s) - 2)
        in_gap = gaps[place] != gaps[place + 1]
        return cls(
            t_s=t_s,
            start_from_cam=motion.start_from_cam(t_s),
            part=np.where(inside & ~in_gap, gaps[place], -1),
            bias_lever_s=path.bias_lever(on_gyro_s),
            gain_lever_rad=path.gain_lever(on_gyro_s),
            rate_rad_s=np.linalg.norm(motion.rate_in_cam_rad_s(t_s), axis=1),
            calibration=calibration,
            density_rad_s_rthz=(imu.noise or TYPICAL_NOISE).gyro_density_rad_s_rthz,
            walk_rad_s_rts=JOINT_GYRO_WALK_RAD_S_RTS if imu.noise is None else imu.noise.gyro_walk_rad_s2_rthz,
            apart_rad=max(math.radians(APART_DEG), 0.0 if camera is None else _view_rad(camera)),
        )

    def known(self, i: IndexArray, j: IndexArray) -> BoolArray:
        """(M,) whether the gyroscope tells of the rotation between frames i and j, (M,) each."""
        return np.asarray((self.part[i] == self.part[j]) & (self.part[i] >= 0))

    def covariance(self, i: IndexArray, j: IndexArray) -> Array:
        """(M, 3, 3) of the rotation vectors between frames i and j, in the frame that all orientations are in."""
        bias = self.bias_lever_s[j] - self.bias_lever_s[i]
        gain = (self.gain_lever_rad[j] - self.gain_lever_rad[i]) * np.array([*[_GAIN_SIGMA] * 3, *[_AXIS_SIGMA] * 3])
        dt_s = np.abs(self.t_s[j] - self.t_s[i])
        offset_rad = self.calibration.clock_sigma_s * np.hypot(self.rate_rad_s[i], self.rate_rad_s[j])
        noise = self.density_rad_s_rthz**2 * dt_s + self.walk_rad_s_rts**2 * dt_s**3 / 3 + offset_rad**2
        # an error of the rotation between the sensors acts on both frames; at most twice where they look apart
        noise = noise + (2 * self.calibration.rotation_sigma_rad) ** 2
        of_bias = bias @ self.calibration.cov[CAL.GYRO_BIAS, CAL.GYRO_BIAS] @ np.swapaxes(bias, 1, 2)
        return np.asarray(of_bias + gain @ np.swapaxes(gain, 1, 2) + noise[:, None, None] * np.eye(3))

    def see_nothing_in_common(self, i: IndexArray, j: IndexArray) -> BoolArray:
        """(M,) whether the optical axes of frames i and j are surely too far apart; never where it is not known."""
        axis_i, axis_j = self.start_from_cam[i, :, 2], self.start_from_cam[j, :, 2]
        across = np.cross(axis_i, axis_j)
        sine = np.linalg.norm(across, axis=1)
        angle = np.arctan2(sine, np.sum(axis_i * axis_j, axis=1))
        covariance = self.covariance(i, j)
        about = across / np.maximum(sine, 1e-9)[:, None]
        variance = np.einsum("ma,mab,mb->m", about, covariance, about)
        # close to opposite, the axis about which they would come together is any
        variance = np.where(sine < 0.1, np.trace(covariance, axis1=1, axis2=2), variance)
        return np.asarray(self.known(i, j) & (angle - _SURE_SIGMAS * np.sqrt(variance) > self.apart_rad))

    def agree(self, i: IndexArray, j: IndexArray, first_from_second: Array) -> BoolArray:
        """(M,) whether rotations (M, 3, 3) of camera i from j may be true; so where the gyroscope tells nothing."""
        turned = self.start_from_cam[i] @ first_from_second @ np.swapaxes(self.start_from_cam[j], 1, 2)
        off = so3_log(turned)
        covariance = self.covariance(i, j) + _TWO_VIEWS_RAD**2 * np.eye(3)
        squared = np.sum(off * np.linalg.solve(covariance, off[..., None])[..., 0], axis=1)
        # three numbers: their squares add up to 3 on average, and to this once in a thousand times
        return np.asarray(~self.known(i, j) | (squared < 16.3))

    def sigma_rad(self, i: IndexArray, j: IndexArray) -> Array:
        """(M,) standard deviation of the rotation between frames i and j, about an axis on average."""
        return np.asarray(np.sqrt(np.trace(self.covariance(i, j), axis1=1, axis2=2) / 3))


def _view_rad(camera: CameraModel) -> float:
    """The field of view along the longer side."""
    width, height = camera.width, camera.height
    across = [[0, height / 2], [width, height / 2]] if width >= height else [[width / 2, 0], [width / 2, height]]
    rays = np.asarray(colmap_camera(camera).cam_from_img(np.array(across)))[:, :2]
    return float(np.arctan(np.linalg.norm(rays, axis=1)).sum()) if np.isfinite(rays).all() else math.pi


def estimate_gyro_orientations(
    recording: Recording, turn_rad: Array, pairs: RayPairs, camera: CameraModel | None
) -> GyroOrientations:
    """Headings of a recording's frames, by a calibration that makes the gyroscope turn as the pictures do.

    Parameters
    ----------
    recording
        Gyroscope, times of N frames, and what is known of the calibration beforehand.
    turn_rad
        (N - 1, 3) rotation vectors ``earlier_from_later`` between consecutive frames, by their matches; NaN where
        unknown.
    pairs
        Matches of frames close in time.
    camera
        For the field of view, where it is known.

    Raises
    ------
    NotObservableError
        Where the frames do not turn as the gyroscope does, or too few hang together.
    """
    timing = recording.timing
    visual = VisualRotation(
        names=timing.names,
        t_s=timing.pose_t_s(),
        turn_rad=turn_rad,
        sigma_rad=np.full(len(turn_rad), np.nan),
        support=np.zeros(len(turn_rad), dtype=np.intp),
        epoch_ns=timing.epoch_ns,
    )
    options = AlignOptions(max_offset_s=recording.max_offset_s)
    found = align_clocks(visual.trajectory(), recording.imu, prior=recording.prior, options=options).settled()
    motion = GyroCamera.from_timed(CameraTimedImu.from_recording(recording.imu, found, timing.epoch_ns))
    t_s = timing.pose_t_s()
    covered = motion.covers(t_s[pairs.first], t_s[pairs.second])
    lever = motion.path.bias_lever(t_s - motion.offset_s)
    change, covariance = bias_correction(pairs.only(covered), motion.start_from_cam(t_s), lever)
    cov = np.array(found.cov)
    cov[CAL.GYRO_BIAS] = cov[:, CAL.GYRO_BIAS] = 0
    cov[CAL.GYRO_BIAS, CAL.GYRO_BIAS] = covariance
    better = replace(found, gyro_bias_rad_s=found.gyro_bias_rad_s + change, cov=cov)
    return GyroOrientations.of(recording.imu, better, timing, camera)
