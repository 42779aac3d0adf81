"""Orientations of frames by the gyroscope, and the uncertainty of the rotation between any two of them.

The gyroscope's bias is fitted to matches of neighbouring images, all pairs together. A rotation by two views alone is
poor where they show a wall: a camera that moves sideways looks like one that turns. The gyroscope knows the rotation
but for its bias, which is one for all pairs. Each match then says that the direction of translation lies in a plane;
the bias is the one for which the planes of each pair have a direction in common (L. Kneip, S. Lynen, *Direct
optimization of frame-to-frame rotation*, ICCV 2013).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_from_matrix, so3_exp, so3_log
from colmap_inertial.core.sampling import is_gap
from colmap_inertial.core.threads import one_blas_thread
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
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.align import AlignOptions, align_clocks
from colmap_inertial.motion.epipolar import RayMoments
from colmap_inertial.motion.flow import VisualRotation

#: Optical axes farther apart than this share next to nothing, or than the field of view, where that is wider.
APART_DEG = 90.0


@dataclass(frozen=True, kw_only=True)
class OrientationLimits:
    """Uncertainty of the orientations of an uncalibrated gyroscope."""

    #: A pair is ruled out, and a rotation disagrees, beyond so many standard deviations.
    sure_sigmas: float = 3.0
    #: Errors of a gyroscope's gains and of its axes, as ``align`` allows for.
    gain_sigma: float = 0.01
    axis_sigma: float = 0.005 / math.sqrt(2)
    #: Standard deviation of the rotation of two views far apart, whose matches may be few or on a plane.
    two_views_rad: float = math.radians(1.5)
    #: Pairs are left out whose planes meet worse than so many times the usual pair's.
    outlier: float = 3.0
    #: The bias is less sure than residuals say by this factor: matches of a pair err together.
    looser: float = 3.0
    #: Fewer pairs say too little.
    least_pairs: int = 8
    #: Matches of the usual pair lie about this close to their epipolar lines, or the gyroscope does not suit them: half
    #: a pixel on V1_01; where matches join copies of one thing, two.
    largest_px: float = 1.0
    #: For derivatives: a tenth of a degree in a third of a second.
    step_rad_s: float = 5e-3


_LIMITS = OrientationLimits()


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
        (N, 3, 3), (N, 3, 6) derivatives of the orientations by the bias and by the gains (:class:`GyroPath`).
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
        """Orientations of the frames of ``timing``, with a calibration that fits the recording."""
        motion = GyroCamera.from_timed(CameraTimedImu.from_recording(imu, calibration, timing.epoch_ns))
        t_s = timing.pose_t_s()
        on_gyro_s, path = t_s - motion.offset_s, motion.path
        inside = (on_gyro_s >= path.t_s[0]) & (on_gyro_s <= path.t_s[-1])
        gaps = np.concatenate([[0], np.cumsum(is_gap(path.t_s))])
        place = np.clip(np.searchsorted(path.t_s, on_gyro_s, side="right") - 1, 0, len(path.t_s) - 2)
        in_gap = gaps[place] != gaps[place + 1]
        _, _, bias_lever_s, gain_lever_rad = path.at_with_levers(on_gyro_s)
        return cls(
            t_s=t_s,
            start_from_cam=motion.start_from_cam(t_s),
            part=np.where(inside & ~in_gap, gaps[place], -1),
            bias_lever_s=bias_lever_s,
            gain_lever_rad=gain_lever_rad,
            rate_rad_s=np.linalg.norm(motion.rate_in_cam_rad_s(t_s), axis=1),
            calibration=calibration,
            density_rad_s_rthz=(imu.noise or TYPICAL_NOISE).gyro_density_rad_s_rthz,
            walk_rad_s_rts=JOINT_GYRO_WALK_RAD_S_RTS if imu.noise is None else imu.noise.gyro_walk_rad_s2_rthz,
            apart_rad=max(math.radians(APART_DEG), 0.0 if camera is None else _view_rad(camera)),
        )

    def known(self, i: IndexArray, j: IndexArray) -> BoolArray:
        """(M,) whether the gyroscope measured the rotation between frames i and j, (M,) each."""
        return np.asarray((self.part[i] == self.part[j]) & (self.part[i] >= 0))

    def covariance(self, i: IndexArray, j: IndexArray) -> Array:
        """(M, 3, 3) of the rotation vectors between frames i and j, in the frame that all orientations are in."""
        bias = self.bias_lever_s[j] - self.bias_lever_s[i]
        gain = (self.gain_lever_rad[j] - self.gain_lever_rad[i]) * np.array(
            [*[_LIMITS.gain_sigma] * 3, *[_LIMITS.axis_sigma] * 3]
        )
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
        return np.asarray(self.known(i, j) & (angle - _LIMITS.sure_sigmas * np.sqrt(variance) > self.apart_rad))

    def agree(self, i: IndexArray, j: IndexArray, first_from_second: Array) -> BoolArray:
        """(M,) whether rotations (M, 3, 3) of camera i from j may be true; so where the gyroscope measured nothing."""
        turned = self.start_from_cam[i] @ first_from_second @ np.swapaxes(self.start_from_cam[j], 1, 2)
        off = so3_log(turned)
        covariance = self.covariance(i, j) + _LIMITS.two_views_rad**2 * np.eye(3)
        squared = np.sum(off * np.linalg.solve(covariance, off[..., None])[..., 0], axis=1)
        # three numbers: their squares add up to 3 on average, and to this once in a thousand times
        return np.asarray(~self.known(i, j) | (squared < 16.3))

    def sigma_rad(self, i: IndexArray, j: IndexArray) -> Array:
        """(M,) standard deviation of the rotation between frames i and j, about an axis on average."""
        return np.asarray(np.sqrt(np.trace(self.covariance(i, j), axis1=1, axis2=2) / 3))


@dataclass(frozen=True, kw_only=True)
class ImageOrientations:
    """Orientations of images by the gyroscope, as a record.

    Attributes
    ----------
    part
        By image name; images of one part have no gap of the gyroscope between them.
    start_from_cam_xyzw
        By image name, quaternions.
    """

    part: dict[str, int] = field(default_factory=dict)
    start_from_cam_xyzw: dict[str, tuple[float, float, float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, names: Sequence[str], orientations: GyroOrientations) -> ImageOrientations:
        """Of the images that were taken while the gyroscope was recorded."""
        part, xyzw = {}, {}
        for k, name in enumerate(names):
            if orientations.part[k] >= 0:
                x, y, z, w = quat_from_matrix(orientations.start_from_cam[k]).tolist()
                part[name], xyzw[name] = int(orientations.part[k]), (x, y, z, w)
        return cls(part=part, start_from_cam_xyzw=xyzw)

    def select(self, names: Iterable[str]) -> ImageOrientations:
        """Those of some images."""
        known = [name for name in names if name in self.part]
        xyzw = {name: self.start_from_cam_xyzw[name] for name in known}
        return ImageOrientations(part={name: self.part[name] for name in known}, start_from_cam_xyzw=xyzw)

    def find_rotation(self, first: str, second: str) -> Array | None:
        """(3, 3) ``second_from_first``; ``None`` where the gyroscope did not measure it."""
        if first not in self.part or self.part[first] != self.part.get(second):
            return None
        start_from_first, start_from_second = (
            matrix_from_quat(np.array(self.start_from_cam_xyzw[name])) for name in (first, second)
        )
        return np.asarray(start_from_second.T @ start_from_first)


def _view_rad(camera: CameraModel) -> float:
    """The field of view along the longer side."""
    width, height = camera.width, camera.height
    across = [[0, height / 2], [width, height / 2]] if width >= height else [[width / 2, 0], [width / 2, height]]
    rays = np.asarray(colmap_camera(camera).cam_from_img(np.array(across)))[:, :2]
    return float(np.arctan(np.linalg.norm(rays, axis=1)).sum()) if np.isfinite(rays).all() else math.pi


def estimate_gyro_orientations(
    recording: Recording, turn_rad: Array, pairs: RayPairs, camera: CameraModel | None
) -> GyroOrientations:
    """Estimate the orientations of a recording's frames, by a calibration that fits the gyroscope to the images.

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
    alignment = align_clocks(visual.trajectory(), recording.imu, prior=recording.prior, options=options)
    aligned = alignment.settle_clock_rate()
    motion = GyroCamera.from_timed(CameraTimedImu.from_recording(recording.imu, aligned, timing.epoch_ns))
    t_s = timing.pose_t_s()
    covered = motion.covers(t_s[pairs.first], t_s[pairs.second])
    lever = motion.path.at_with_levers(t_s - motion.offset_s)[2]
    change, covariance = estimate_bias_correction(pairs.only(covered), motion.start_from_cam(t_s), lever)
    cov = np.array(aligned.cov)
    cov[CAL.GYRO_BIAS] = cov[:, CAL.GYRO_BIAS] = 0
    cov[CAL.GYRO_BIAS, CAL.GYRO_BIAS] = covariance
    corrected = replace(aligned, gyro_bias_rad_s=aligned.gyro_bias_rad_s + change, cov=cov)
    return GyroOrientations.of(recording.imu, corrected, timing, camera)


@dataclass(frozen=True, eq=False, kw_only=True)
class RayPairs:
    """Matches of M pairs of images, K of each.

    Attributes
    ----------
    first, second
        (M,) places of the images.
    pixel_rad
        What a pixel spans.
    rays_first, rays_second
        (M, K, 3) unit rays, in each camera's frame.
    """

    first: IndexArray
    second: IndexArray
    pixel_rad: float
    rays_first: Array
    rays_second: Array

    def only(self, which: BoolArray) -> RayPairs:
        """Some of the pairs."""
        return RayPairs(
            first=self.first[which],
            second=self.second[which],
            pixel_rad=self.pixel_rad,
            rays_first=self.rays_first[which],
            rays_second=self.rays_second[which],
        )


@one_blas_thread()
def estimate_bias_correction(pairs: RayPairs, start_from_cam: Array, bias_lever_s: Array) -> tuple[Array, Array]:
    """Correction of the bias that orientations were integrated with, (3,) rad/s, and its covariance (3, 3).

    Parameters
    ----------
    pairs
        Of images close in time.
    start_from_cam, bias_lever_s
        (N, 3, 3) orientations, and what a change of the bias turns them by (``GyroPath.at_with_levers``).

    Raises
    ------
    NotObservableError
        Where there are too few pairs, or no bias suits most of them.
    """
    from scipy.optimize import minimize

    if len(pairs.first) < _LIMITS.least_pairs:
        raise NotObservableError("gyroscope bias", Fact("pairs-too-few", count=len(pairs.first)))
    before, after = start_from_cam[pairs.first], start_from_cam[pairs.second]
    rays_first = pairs.rays_first @ np.swapaxes(before, 1, 2)
    lever = bias_lever_s[pairs.second] - bias_lever_s[pairs.first]
    rays_second = pairs.rays_second @ np.swapaxes(after, 1, 2)

    moments = RayMoments.of(rays_first, rays_second)

    def spread(change: Array) -> Array:
        return moments.measure_spread(so3_exp(-(lever @ change)))

    change = np.zeros(3)
    for _ in range(4):
        usual = max(float(np.median(spread(change))), 1e-12)

        def cost(x: Array, usual: float = usual) -> float:
            ratio = spread(x) / (_LIMITS.outlier * usual)
            return float(np.sum(ratio / (1 + ratio)))

        minimum = minimize(cost, change, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-6, "maxiter": 400})
        moved, change = float(np.abs(minimum.x - change).max()), np.asarray(minimum.x)
        if moved < 1e-5:
            break
    least = spread(change)
    variance = max(float(np.median(least)), 1e-12)
    weight = pairs.rays_first.shape[1] / (1 + least / (_LIMITS.outlier * variance)) ** 2 / variance
    if variance > (_LIMITS.largest_px * pairs.pixel_rad) ** 2:
        raise NotObservableError("gyroscope bias", Fact("matches-suit-no-bias"))
    information = _curvature(lambda x: float(weight @ spread(x)), change)
    values = np.linalg.eigvalsh(information)
    if values[0] <= 0:
        raise NotObservableError("gyroscope bias", Fact("matches-suit-any-bias"))
    return change, np.asarray(_LIMITS.looser**2 * np.linalg.inv(information))


def _curvature(squares: Callable[[Array], float], at: Array) -> Array:
    """Half the second derivative of a sum of squares, (3, 3)."""
    axes = _LIMITS.step_rad_s * np.eye(3)
    middle = squares(at)
    out = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            if a == b:
                out[a, a] = squares(at + axes[a]) - 2 * middle + squares(at - axes[a])
            else:
                p, m = axes[a] + axes[b], axes[a] - axes[b]
                out[a, b] = (squares(at + p) - squares(at + m) - squares(at - m) + squares(at - p)) / 4
    return out / (2 * _LIMITS.step_rad_s**2)
