"""Metres per model unit from inertial data."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu, epoch_shift_s
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.sampling import PAUSE_STEPS, is_gap, time_unit_factor
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import (
    CAL,
    CameraImuCalibration,
    CameraTrajectory,
    ImuCalibration,
    ImuRecording,
    ScaleEstimate,
)
from colmap_inertial.inertial.core.priors import PRIORS
from colmap_inertial.inertial.scale._ends import jumping_ends
from colmap_inertial.inertial.scale._inputs import align_recording, gravity_at_latitude_m_s2, strength_of_gravity
from colmap_inertial.inertial.scale._sampling import describe_sampling
from colmap_inertial.inertial.scale.verdict import verdict_of
from colmap_inertial.io.plausible import PLAUSIBLE
from colmap_inertial.io.pose_convention import ARRAYS, PoseConvention
from colmap_inertial.io.units import STANDARD_GRAVITY_M_S2
from colmap_inertial.motion.align import AlignOptions
from colmap_inertial.motion.align.consensus import describe_consensus
from colmap_inertial.motion.align.conventions import likely_convention

#: Shorter pauses are not worth a sentence.
_PAUSE_S = 0.02
#: Nor is less than this, in which gains change by less than a calibration is sure of them.
_WARMER_K = 10.0


@dataclass(frozen=True, kw_only=True)
class MovedLimits:
    """Limits for cameras in the wrong place alone, among keyframes; a video outvotes them."""

    #: So many of them, or this share, may be ...
    most: int = 3
    share: float = 0.1
    #: ... or a block of up to this share at an end, which is sought where the scale is known no better (standard
    #: deviation), and believed where this is less than so much of it without the block, and grows no more than this
    #: with the nearer part of it: cameras that COLMAP put before the copy of a wall
    #: (``scripts/studies/wrong_cameras.py``: a hundredth).
    most_share: float = 0.34
    poor_log: float = 0.05
    shrinks_much: float = 0.33
    grows: float = 1.5
    #: Without them the scale's standard deviation is less than this share of what it was.
    shrinks: float = 0.9


_MOVED = MovedLimits()


@dataclass(frozen=True, kw_only=True)
class LearnedLimits:
    """Uncertainty of a recording's lever arm for other recordings of the device.

    Against the known arms of six recordings of real sensors, those of the fit are wrong by 2.9 times its standard
    deviations in recordings of two minutes (rms), and 1.2 times in 20 s; by 3 mm where these are .5 mm.
    """

    sigmas: float = 2.0
    least_m: float = 0.003


_LEARNED = LearnedLimits()


def learn_lever_arm(calibration: CameraImuCalibration, estimate: ScaleEstimate) -> CameraImuCalibration:
    """A calibration with the lever arm that a scale estimate found, for other recordings of the device.

    Parameters
    ----------
    calibration
        Its other entries stay, without correlations with the lever arm.
    estimate
        Of any recording; one that was refused says nothing.
    """
    refined, at = estimate.calibration, CAL.LEVER_ARM
    if estimate.verdict == "refused" or estimate.method != "joint" or refined is None:
        return calibration
    cov = calibration.cov.copy()
    cov[at, :] = cov[:, at] = 0.0
    cov[at, at] = _LEARNED.sigmas**2 * refined.cov[at, at] + _LEARNED.least_m**2 * np.eye(3)
    return replace(calibration, imu_in_cam_m=refined.imu_in_cam_m, cov=cov)


def find_remarks(trajectory: CameraTrajectory, timed: CameraTimedImu) -> tuple[Fact, ...]:
    """What to know of clocks far apart, pauses of the sensors, frames without IMU, and another warmth than calibrated.

    Parameters
    ----------
    trajectory, timed
        Camera and IMU.
    """
    gyro_s, accel_s = timed.gyro_t_s, timed.accel_t_s
    covered = (max(gyro_s[0], accel_s[0]), min(gyro_s[-1], accel_s[-1]))
    remarks = (
        _note_separate_clocks(trajectory, timed),
        _note_pauses("gyroscope", gyro_s, trajectory),
        _note_pauses("accelerometer", accel_s, trajectory),
        _note_uncovered_frames(trajectory, covered),
        _note_warmth(timed.imu),
    )
    return tuple(remark for remark in remarks if remark is not None)


def _note_separate_clocks(trajectory: CameraTrajectory, timed: CameraTimedImu) -> Fact | None:
    shift_s = epoch_shift_s(timed.imu, trajectory.epoch_ns)
    begin_s, end_s = timed.imu.gyro_t_s[0] + shift_s, timed.imu.gyro_t_s[-1] + shift_s
    if begin_s < trajectory.t_s[-1] and end_s > trajectory.t_s[0]:
        return None
    return Fact("clocks-without-common-time", offset_s=timed.calibration.clock_offset_s)


def _note_pauses(sensor: str, t_s: Array, trajectory: CameraTrajectory) -> Fact | None:
    step_s = np.diff(t_s)
    inside = (t_s[1:] > trajectory.t_s[0]) & (t_s[:-1] < trajectory.t_s[-1])
    long_s = step_s[inside & is_gap(t_s, _PAUSE_S, steps=PAUSE_STEPS)]
    if len(long_s) == 0:
        return None
    return Fact("sensor-pauses", sensor=sensor, count=len(long_s), total_s=long_s.sum(), longest_s=long_s.max())


def _note_uncovered_frames(trajectory: CameraTrajectory, covered_s: tuple[float, float]) -> Fact | None:
    # A frame or so at either end is nothing to speak of.
    slack_s = 2 * float(np.median(np.diff(trajectory.t_s)))
    if covered_s[0] <= trajectory.t_s[0] + slack_s and covered_s[1] >= trajectory.t_s[-1] - slack_s:
        return None
    count = int(np.sum((trajectory.t_s >= covered_s[0]) & (trajectory.t_s <= covered_s[1])))
    return Fact("frames-without-imu", covered=count, frames=len(trajectory))


def _note_warmth(imu: ImuRecording) -> Fact | None:
    if imu.calibration is None or imu.warmer_k is None or abs(imu.warmer_k) < _WARMER_K:
        return None
    return Fact(
        "imu-warmer",
        calibrated_c=imu.calibration.temperature_c,
        recorded_c=imu.temperature_c,
        gain_change=PRIORS.calibrated_gain_per_k * abs(imu.warmer_k),
    )


def first_seconds(trajectory: CameraTrajectory, seconds: float, *, start_s: float | None = None) -> CameraTrajectory:
    """The frames of the first ``seconds`` of a recording; nothing of later ones remains.

    Parameters
    ----------
    start_s
        When the recording began, on the trajectory's clock; without it, at the first pose.
    """
    begin_s = trajectory.t_s[0] if start_s is None else start_s
    return trajectory.select(trajectory.t_s <= begin_s + seconds)


def check_units(imu: ImuRecording) -> list[Fact]:
    """Reasons why an IMU recording's numbers are implausible as rad/s and m/s2; empty where there are none.

    Readers of files raise their own errors before; this guards arrays that come from elsewhere.
    """
    out = []
    accel = float(np.median(np.linalg.norm(imu.accel_m_s2, axis=1))) if imu.has_accel else np.nan
    low, high = PLAUSIBLE.smallest_gravity_m_s2, PLAUSIBLE.largest_gravity_m_s2
    if imu.has_accel and not low <= accel <= high:
        likely = "without gravity"
        if low <= STANDARD_GRAVITY_M_S2 * accel <= high:
            likely = "g"
        elif accel > 500:
            likely = "counts"
        out.append(Fact("accel-implausible", accel_m_s2=accel, likely=likely))
    gyro = float(np.median(np.linalg.norm(imu.gyro_rad_s, axis=1)))
    if gyro > PLAUSIBLE.largest_median_rate_rad_s:
        out.append(Fact("gyro-in-degrees", rate_rad_s=gyro))
    return out


def check_time_unit(trajectory: CameraTrajectory, imu: ImuRecording) -> list[Fact]:
    """The reason why the poses' times are in no seconds; empty where they may be.

    Without it, the offset of the clocks would be searched over hours in which there is nothing to find.
    """
    if min(len(trajectory), len(imu.gyro_t_s)) < 2:
        return []
    poses_s, imu_s = float(np.ptp(trajectory.t_s)), float(np.ptp(imu.gyro_t_s))
    factor = time_unit_factor(poses_s, imu_s) or 1.0
    if factor < 1e3:
        return []
    return [Fact("poses-not-in-seconds", poses_s=poses_s, imu_s=imu_s, factor=factor)]


def estimate_scale(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    *,
    calibration: CameraImuCalibration | None = None,
    imu_calibration: ImuCalibration | None = None,
    options: ScaleOptions | None = None,
    read_as: PoseConvention = ARRAYS,
) -> ScaleEstimate:
    """Metres per unit of a camera trajectory, from the IMU that was recorded along.

    Parameters
    ----------
    trajectory
        Poses of a reconstruction with their times.
    imu
        Recording of the same device; its clock may differ by any offset.
    calibration
        What is known of the device (``io.calibration.calibration_prior``); unknown entries wide.
    imu_calibration
        The IMU's own, by which its readings are corrected. A recording that was corrected before brings its own.
    options
        Method, gravity, range of clock offsets.
    read_as
        Convention of the table that the poses were read from, for the words of a refusal.

    Returns
    -------
    The estimate with a verdict. Data that cannot give a scale give the verdict ``"refused"`` with reasons, not an
    exception.
    """
    options = options or ScaleOptions()
    other_unit = check_time_unit(trajectory, imu)
    if other_unit:
        return ScaleEstimate.refused(options.method, *other_unit)
    begin_s = time.perf_counter()
    if imu_calibration is not None:
        imu = imu_calibration.corrected(imu)
        calibration = None if calibration is None else imu_calibration.loosened(calibration)
    with one_blas_thread():
        estimate = _estimate_or_refuse(trajectory, imu, calibration, options)
        search = AlignOptions(max_offset_s=options.max_offset_s)
        sampling = describe_sampling(trajectory, imu)
        if estimate.verdict == "refused":  # which may be due to it
            estimate = replace(estimate, reasons=(*sampling, *estimate.reasons))
        else:
            estimate = replace(estimate, notes=(*estimate.notes, *sampling))
        likely = likely_convention(trajectory, imu, read_as=read_as, prior=calibration, options=search)
    if likely is not None:
        reasons = (likely.reason, *estimate.reasons)
        estimate = ScaleEstimate.refused(options.method, *reasons, calibration=estimate.calibration)
    return replace(estimate, imu_calibration=imu.calibration, runtime_s=time.perf_counter() - begin_s)


def _estimate_or_refuse(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    calibration: CameraImuCalibration | None,
    options: ScaleOptions,
) -> ScaleEstimate:
    if not imu.has_accel:
        return ScaleEstimate.refused(options.method, Fact("scale-without-accelerometer"))
    problems = check_units(imu)
    if problems:
        return ScaleEstimate.refused(options.method, *problems)
    try:
        timed, consensus = align_recording(trajectory, imu, calibration, options)
        trajectory = trajectory.select(consensus.kept)
        stretched = timed.imu.repairs[len(imu.repairs) :]
        estimate, moved = _estimate_without_moved_cameras(trajectory, timed, options)
        consensus = replace(consensus, moved=moved)
        return replace(
            estimate,
            # also where there is no scale: it says what was found of camera and IMU
            calibration=timed.calibration if estimate.calibration is None else estimate.calibration,
            rotations=consensus,
            notes=(*estimate.notes, *stretched, *describe_consensus(consensus), *find_remarks(trajectory, timed)),
        )
    except NotObservableError as error:
        return ScaleEstimate.refused(options.method, Fact("not-observable", quantity=error.quantity, why=error.fact))


def _estimate_without_moved_cameras(
    trajectory: CameraTrajectory, timed: CameraTimedImu, options: ScaleOptions
) -> tuple[ScaleEstimate, tuple[str, ...]]:
    """The scale, and what it does without.

    The ends of a video at which its poses jump, and keyframes without which it is known better: the largest errors
    first hide others.
    """
    beyond = jumping_ends(trajectory)
    moved = tuple(name for name, cut in zip(trajectory.names, beyond.tolist(), strict=True) if cut)
    trajectory = trajectory.select(~beyond)
    estimate = _estimate(trajectory, timed, options)
    at_once = int(max(_MOVED.most, _MOVED.share * len(trajectory)))
    while estimate.cov is not None and estimate.jumped and len(moved) < at_once:
        names = (*moved, *estimate.jumped[: at_once - len(moved)])
        without = _estimate(trajectory.select(~np.isin(trajectory.names, names)), timed, options)
        if without.cov is None or without.cov[0, 0] > _MOVED.shrinks**2 * estimate.cov[0, 0]:
            break
        estimate, moved = without, names
    if estimate.cov is not None and (estimate.verdict == "refused" or estimate.cov[0, 0] > _MOVED.poor_log**2):
        return _estimate_without_moved_end(trajectory, timed, options, (estimate, moved))
    return estimate, moved


def _estimate_without_moved_end(
    trajectory: CameraTrajectory,
    timed: CameraTimedImu,
    options: ScaleOptions,
    estimated: tuple[ScaleEstimate, tuple[str, ...]],
) -> tuple[ScaleEstimate, tuple[str, ...]]:
    """The scale without the first or last cameras, as few as it takes, where it is far better known."""
    best, moved = estimated
    assert best.cov is not None
    limit = _MOVED.shrinks_much**2 * float(best.cov[0, 0])
    sound, number = ~np.isin(trajectory.names, moved), np.arange(len(trajectory))
    left_out = moved
    for from_end in (number, number[::-1]):
        few, many = 0, int(_MOVED.most_share * len(trajectory))
        without = _estimate(trajectory.select(sound & (from_end >= many)), timed, options)
        if not _is_known_within(without, limit):
            continue
        assert without.cov is not None
        limit = min(limit, _MOVED.grows**2 * float(without.cov[0, 0]))
        # the fewest that it takes, by halving
        while many - few > 1:
            between = (few + many) // 2
            trial = _estimate(trajectory.select(sound & (from_end >= between)), timed, options)
            if _is_known_within(trial, limit):
                many, without = between, trial
            else:
                few = between
        best, kept = without, sound & (from_end >= many)
        left_out = (
            *(name for name in moved if name not in trajectory.names),
            *(name for name, is_kept in zip(trajectory.names, kept.tolist(), strict=True) if not is_kept),
        )
    return best, left_out


def _is_known_within(estimate: ScaleEstimate, variance: float) -> bool:
    """Whether a scale is given, and its logarithm has no larger variance."""
    return estimate.cov is not None and estimate.verdict != "refused" and not estimate.cov[0, 0] > variance


def _estimate(trajectory: CameraTrajectory, timed: CameraTimedImu, options: ScaleOptions) -> ScaleEstimate:
    gravity_m_s2, sigma_m_s2 = strength_of_gravity(options)
    if options.method == "spectral":
        from colmap_inertial.inertial.scale.spectral import SpectralOptions, estimate_spectral

        return estimate_spectral(trajectory, timed, SpectralOptions(gravity_m_s2=gravity_m_s2))
    from colmap_inertial.inertial.scale.joint import JointOptions, estimate_joint

    known = JointOptions(gravity_m_s2=gravity_m_s2, gravity_sigma_m_s2=sigma_m_s2)
    return estimate_joint(trajectory, timed, known)


__all__ = [
    "check_units",
    "estimate_scale",
    "first_seconds",
    "gravity_at_latitude_m_s2",
    "learn_lever_arm",
    "strength_of_gravity",
    "verdict_of",
]
