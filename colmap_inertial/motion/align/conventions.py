"""Poses written by another convention than they were read by: recognised by trying all, named, never applied.

The gyroscope tells which way the rotations turn, and no more: reading a quaternion's four numbers in the other order is
the same as inverting it, up to a constant rotation of the world and one of the camera (both are reflections of the
sphere of quaternions). The accelerometer tells the rest: turned into the world by the right rotations, gravity is
steady and what is quick is the acceleration of the right centres. Both kinds of evidence are log-likelihoods, and a
convention is named only where it beats the one that was read as clearly as an alignment must beat its rivals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu, epoch_shift_s
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_multiply, quat_rotate
from colmap_inertial.core.sampling import subtract_running_mean
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, ImuRecording
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.pose_convention import ARRAYS, PoseConvention, reread
from colmap_inertial.motion.align import AlignOptions, coarse_fit
from colmap_inertial.motion.align._clock_search import ClockFit

#: Window of the quadratics whose second derivative is the visual acceleration.
ACCELERATION_S = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class QuickAccelerations:
    """Accelerations of N instants of the poses, averaged over two windows.

    Attributes
    ----------
    inertial_m_s2
        (N, 3) specific force.
    visual
        (N, 3) second derivative of the camera's centre, its unit per s2.
    arm_per_s2
        (N, 3, 3) second derivative of ``world_from_imu``: times a lever arm in metres, what that adds to the former.
    steadiness
        Length of the mean specific force over the mean of its lengths, both of windows: one where gravity is steady in
        the world and accelerations cancel.
    seconds
        How long the instants last.
    """

    inertial_m_s2: Array
    visual: Array
    arm_per_s2: Array
    steadiness: float
    seconds: float


def quick_accelerations(
    poses: CameraTrajectory, imu: ImuRecording, calibration: CameraImuCalibration
) -> QuickAccelerations | None:
    """Both accelerations at the poses' instants; ``None`` where frames are too sparse or too few."""
    step_s = float(np.median(np.diff(poses.t_s)))
    half = round(0.5 * ACCELERATION_S / step_s)
    if half < 3 or len(poses) < 40 * half:
        return None
    timed = CameraTimedImu(imu=imu, calibration=calibration, camera_epoch_ns=poses.epoch_ns)
    t_s = poses.t_s - calibration.drift_s(poses.t_s) - timed.accel_offset_s
    time = step_s * np.arange(-half, half + 1)
    basis = np.stack([np.ones(len(time)), time, time**2], axis=1)
    second = 2 * np.linalg.pinv(basis)[2][::-1]
    mean = np.ones(len(time)) / len(time)
    force = np.stack([np.interp(t_s, imu.accel_t_s, column) for column in imu.accel_m_s2.T], axis=1)
    world_from_imu = quat_multiply(quat_conjugate(poses.cam_from_world_xyzw), calibration.cam_from_imu_xyzw)
    inertial = _filter_axes(quat_rotate(world_from_imu, force), mean)
    visual = _filter_axes(poses.cam_in_world, second)
    arm = _filter_axes(matrix_from_quat(world_from_imu).reshape(-1, 9), second)
    even = np.abs(poses.t_s[2 * half :] - poses.t_s[: -2 * half] - 2 * half * step_s) < 0.1 * step_s
    even &= (t_s[half:-half] > imu.accel_t_s[0]) & (t_s[half:-half] < imu.accel_t_s[-1])
    width = 4 * half
    if even.sum() < 2 * width - 1:
        return None
    quick = [subtract_running_mean(values[even], width) for values in (inertial, visual, arm)]
    lengths = np.linalg.norm(inertial[even], axis=1)
    return QuickAccelerations(
        inertial_m_s2=quick[0],
        visual=quick[1],
        arm_per_s2=quick[2].reshape(-1, 3, 3),
        steadiness=float(np.linalg.norm(inertial[even].mean(axis=0)) / max(float(lengths.mean()), 1e-12)),
        seconds=len(quick[0]) * step_s,
    )


def _filter_axes(values: Array, kernel: Array) -> Array:
    return np.stack([np.convolve(column, kernel, "valid") for column in values.T], axis=1)


#: Standard deviation of the IMU's distance from the camera along each axis: what it adds is no sign of other poses.
_ARM_M = 0.1
#: Gravity is less steady in the world where rotations are wrong, or the accelerometer's axes.
_STEADY = 0.975
#: Share of the quick acceleration that the right centres explain at least. Measured: 0.26 and more; wrong ones 0.11.
_EXPLAINED = 0.15
#: Centres that explain this share are right, and so is the accelerometer, however unsteady gravity is.
_BEYOND_DOUBT = 0.4
#: Keeps a path of no length from being divided by.
_NOTHING = 1e-9


@dataclass(frozen=True, kw_only=True)
class LikelyConvention:
    """Most likely convention of a table of poses, other than the one it was read in.

    Attributes
    ----------
    read_as
        What it was read as.
    written_as
        What fits instead; several where nothing tells them apart.
    log_likelihood
        How much likelier, in nats, than what was read; infinite where that does not fit at all.
    """

    read_as: PoseConvention
    written_as: tuple[PoseConvention, ...]
    log_likelihood: float

    @property
    def fact(self) -> Fact:
        """The convention that fits, and what to do about it."""
        ahead = {"log_likelihood": self.log_likelihood} if np.isfinite(self.log_likelihood) else {}
        written_as = tuple(astuple(convention) for convention in self.written_as)
        return Fact("pose-convention", read_as=astuple(self.read_as), written_as=written_as, **ahead)

    @property
    def reason(self) -> Fact:
        """The same as a reason against a scale, whose sentence has the advice in it."""
        return Fact("poses-of-another-convention", found=self.fact)

    @property
    def sentence(self) -> str:
        """The convention that fits, and the advice."""
        return self.fact.with_advice


@dataclass(frozen=True, eq=False, kw_only=True)
class _Candidate:
    """One convention with its evidence: of the rotations; of acceleration by centres and lever arm, and by this alone.

    ``explained`` is the share of the acceleration that the centres explain.
    """

    convention: PoseConvention
    rotation: float
    acceleration: float = 0.0
    still: float = 0.0
    steadiness: float = 1.0
    explained: float = 0.0

    @property
    def fits(self) -> bool:
        """Whether the centres explain the acceleration beyond doubt, and gravity is steady."""
        return self.explained >= _BEYOND_DOUBT and self.steadiness >= _STEADY

    @property
    def evidence(self) -> float:
        return self.rotation + self.acceleration


@one_blas_thread()
def likely_convention(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    *,
    read_as: PoseConvention = ARRAYS,
    prior: CameraImuCalibration | None = None,
    options: AlignOptions | None = None,
) -> LikelyConvention | None:
    """Whether poses fit the IMU under another convention of their table better than as read.

    Parameters
    ----------
    trajectory
        Poses as they were read.
    imu
        The gyroscope tells inverted quaternions; with dense frames and an accelerometer, their order and what the
        positions are, too.
    read_as
        Convention of the table that they were read from.
    prior, options
        As of ``align_clocks``.

    Returns
    -------
    ``None`` where they fit as they were read, where no other convention fits clearly better, or where the
    gyroscope fits as well when it is mirrored, which is then more likely.
    """
    options = options or AlignOptions()
    prior = prior or calibration_prior()
    margin = options.min_log_likelihood

    def fit(read: CameraTrajectory, by: ImuRecording) -> ClockFit | None:
        searched = coarse_fit(read, by, prior=prior, options=options)
        return searched if isinstance(searched, ClockFit) else None

    candidates = _evaluate_conventions(trajectory, imu, read_as, prior, fit)
    if not candidates:
        return None
    best = max(candidates, key=lambda candidate: candidate.evidence)
    as_read = next((candidate for candidate in candidates if candidate.convention == read_as), None)
    ahead = np.inf if as_read is None else best.evidence - as_read.evidence
    if ahead < margin or (best.steadiness < _STEADY and best.explained < _BEYOND_DOUBT):
        return None
    if _inverts(read_as, best.convention):
        mirrored = fit(trajectory, replace(imu, gyro_rad_s=-imu.gyro_rad_s))
        lead = np.inf if mirrored is None else best.rotation - mirrored.log_likelihood
        explains = best.acceleration - best.still >= margin
        if lead < -margin or (lead < margin and not explains):
            return None
    equal = tuple(candidate.convention for candidate in candidates if best.evidence - candidate.evidence < margin)
    as_positions = tuple(candidate for candidate in equal if candidate.position == read_as.position)
    return LikelyConvention(read_as=read_as, written_as=as_positions or equal, log_likelihood=float(ahead))


def _evaluate_conventions(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    read_as: PoseConvention,
    prior: CameraImuCalibration,
    fit: Callable[[CameraTrajectory, ImuRecording], ClockFit | None],
) -> list[_Candidate]:
    """Evidence for each convention whose rotations fit; empty where the one that was read fits beyond doubt."""
    fits: dict[tuple[str, str], ClockFit | None] = {}
    candidates: list[_Candidate] = []
    for convention in (read_as, *read_as.others()):
        read = reread(trajectory, read_as, convention)
        rotation = (convention.rotation, convention.order)
        if rotation not in fits:
            fits[rotation] = fit(read, imu)
        clock_fit = fits[rotation]
        if clock_fit is not None:
            candidates.append(
                _evaluate_candidate(convention, read, imu, clock_fit, prior, as_read=convention == read_as)
            )
            if convention == read_as and candidates[0].fits:
                return []
    return candidates


def _inverts(read_as: PoseConvention, written_as: PoseConvention) -> bool:
    """Whether the rotations of a table, read in one convention instead of the other, turn the wrong way to a
    gyroscope.
    """
    return (read_as.rotation != written_as.rotation) != (read_as.order != written_as.order)


def _evaluate_candidate(
    convention: PoseConvention,
    read: CameraTrajectory,
    imu: ImuRecording,
    fit: ClockFit,
    prior: CameraImuCalibration,
    *,
    as_read: bool,
) -> _Candidate:
    quick = None
    if imu.has_accel:
        quick = quick_accelerations(read, imu, fit.apply_to(prior, epoch_shift_s(imu, read.epoch_ns)))
    if quick is None:
        return _Candidate(convention=convention, rotation=fit.log_likelihood)
    # one independent vector in each window
    components = 3 * quick.seconds / ACCELERATION_S
    still, moving, positive = _fit_residual_accelerations(quick)
    explains = moving < (1 - _EXPLAINED) * still
    # the accelerometer may be flipped; other poses than those that were read must not rest on that
    if not as_read and not (positive and explains):
        moving = still
    return _Candidate(
        convention=convention,
        rotation=fit.log_likelihood,
        acceleration=-0.5 * components * float(np.log(moving)),
        still=-0.5 * components * float(np.log(still)),
        steadiness=quick.steadiness,
        explained=1 - moving / still if positive else 0.0,
    )


def _fit_residual_accelerations(quick: QuickAccelerations) -> tuple[float, float, bool]:
    """Mean square acceleration (m2/s4) that a lever arm leaves, and that it leaves along with the visual acceleration.

    Also whether the factor of the latter is positive.
    """
    y = quick.inertial_m_s2.ravel()
    repeated = ACCELERATION_S / quick.seconds * len(y) / 3
    arm = quick.arm_per_s2.reshape(-1, 3)
    visual = quick.visual.reshape(-1, 1)
    visual = visual / max(float(np.sqrt(np.mean(visual**2))), _NOTHING)
    left = []
    for columns in (arm, np.concatenate([arm, visual], axis=1)):
        variance = float(np.mean(y**2))
        precision = np.zeros(columns.shape[1])
        for _ in range(4):
            precision[:3] = variance * repeated / _ARM_M**2
            normal = columns.T @ columns + np.diag(precision)
            solution = np.linalg.lstsq(normal, columns.T @ y, rcond=None)[0]
            rest = y - columns @ solution
            variance = float((np.sum(rest**2) + np.sum(precision * solution**2)) / len(y))
        left.append(variance)
    still, moving = left
    return still, min(moving, still), bool(solution[-1] > 0)
