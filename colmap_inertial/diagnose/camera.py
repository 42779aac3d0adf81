"""The camera against the gyroscope: do they belong together, at one rate, in one set of axes?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.axes import Axes
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact, as_fact
from colmap_inertial.core.sampling import subtract_running_mean
from colmap_inertial.core.types import CameraTrajectory, ImuRecording, RotationConsensus
from colmap_inertial.diagnose.clocks import (
    frame_rate_finding,
    offset_finding,
    rate_finding,
    wrong_time_unit,
)
from colmap_inertial.diagnose.diagnosis import UNIT_FACTORS, Finding, Recorded
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.io.plausible import best_mirrored_reading
from colmap_inertial.motion.align import Alignment
from colmap_inertial.motion.align.consensus import describe_consensus
from colmap_inertial.motion.align.conventions import ACCELERATION_S, QuickAccelerations, quick_accelerations


@dataclass(frozen=True, kw_only=True)
class CameraCheckLimits:
    """Limits of the check that camera and gyroscope belong together."""

    #: Intervals over which rotations are compared, and how strong the axis must be that turns the wrong way.
    interval_s: float = 0.1
    mirror_share: float = 0.03
    #: Rates beyond what an alignment follows, which are tried where it finds nothing; and frame rates that are taken
    #: for one another (24, 25, 30, 50, 60 and half or double of them), as the IMU's seconds per second of frames.
    tried_rates: tuple[float, ...] = (0.02, -0.02, 0.03, -0.03, 0.04, -0.04)
    tried_frame_rates: tuple[float, ...] = (0.8, 1.25, 5 / 6, 1.2, 0.5, 2.0, 0.6, 5 / 3)
    #: A rate that is further off is that of another frame rate.
    wrong_frame_rate: float = 0.1
    #: Of images far apart so many pairs must have been compared for a gyroscope not to belong to them.
    enough_pairs: int = 12
    #: A recording that is shorter may simply not have turned enough.
    enough_s: float = 8.0
    #: A camera-IMU rotation that is open by more (0.006 in clean recordings, 0.12 of a drone that hovers and turns in
    #: its last second), of a camera whose median rate over such intervals is lower (0.014 there, 0.21 and more in
    #: clean ones), has too little to rest on; in so many intervals at least.
    open_rotation_rad: float = 0.05
    still_rad_s: float = 0.02
    turned_within_s: float = 1.0
    fewest_seconds: int = 5
    #: Quick rotation in the image per rotation measured; translation is slow against it, and makes it a little less
    #: (0.92 to 0.95 in rendered orbits about a desk, 1.00 before a far wall). A standard deviation above the third
    #: tells nothing.
    quick_s: float = 0.35
    usual_gain: tuple[float, float] = (0.88, 1.08)
    gain_sigma: float = 0.05
    least_quick_rad_s: float = 0.03
    #: What a gyroscope measures per rotation of the camera: consumer sensors keep within 3 %, a focal length of another
    #: video mode or a wrong factor does not.
    gyro_gain: tuple[float, float] = (0.85, 1.15)
    gain_interval_s: float = 0.5
    #: Rotations that correlate less tell no gain; quick ones are those against the mean of so many intervals.
    gain_correlation: float = 0.7
    quick_intervals: int = 9
    #: The correlation of visual and inertial acceleration that tells its sign, and the standard deviations of chance.
    opposite: float = -0.3
    opposite_sigmas: float = 4.0


_LIMITS = CameraCheckLimits()

#: What is wrong with a gyroscope's own numbers keeps it from fitting the camera: it is named once.
_OF_THE_GYROSCOPE = frozenset({*UNIT_FACTORS, "gyro-unit", "sensors-exchanged", "dead-sensor", "dead-axis"})
#: Why camera and gyroscope cannot be aligned at any offset of their clocks.
TOO_LITTLE_ROTATION = frozenset({"camera-hardly-rotates", "rotation-axis-open"})


def _find_mirroring(recorded: Recorded, imu: ImuRecording) -> Finding:
    """A mirrored gyroscope; where the accelerometer tells that it is the only one, with its right axes."""
    reading = best_mirrored_reading(imu) if imu.has_accel else None
    if reading is None or np.array_equal(reading.matrix, -np.eye(3)):
        return Finding(fact=Fact("gyro-mirrored"), severity="error")
    before = np.eye(3) if imu.source.gyro_axes is None else imu.source.gyro_axes.matrix
    axes = Axes(matrix=reading.matrix @ before)
    return Finding(fact=Fact("gyro-mirrored", gyro=axes.setting()), severity="error")


def check_belonging(recorded: Recorded) -> Iterator[Finding]:
    """Whether the gyroscope turns as the camera does at some time offset; if not, under which other reading it
    would.
    """
    failed, imu, turning = recorded.aligned, recorded.imu, recorded.turning
    if recorded.lacks_majority or recorded.likely_convention is not None:
        return
    if isinstance(failed, Alignment) and imu is not None and turning is not None:
        if _is_mirrored(turning, imu, failed):
            yield _find_mirroring(recorded, imu)
        yield from _check_turned(turning, failed)
        return
    if not isinstance(failed, NotObservableError) or imu is None or turning is None or _is_explained(recorded):
        return
    if recorded.wrong_unit is not None:
        yield _unit_finding(recorded.wrong_unit)
        return
    if failed.code in TOO_LITTLE_ROTATION:
        yield Finding(fact=Fact("rotation-too-little", why=failed.fact), severity="error")
        return
    otherwise = _find_better_fit(recorded, imu)
    if otherwise is not None:
        yield otherwise
    elif recorded.stabilisation is None or not recorded.stabilisation.stabilised:
        yield _never_fits(recorded, turning, failed)


def _check_turned(turning: CameraTrajectory, aligned: Alignment) -> Iterator[Finding]:
    """A camera that turned in a moment only, and otherwise stood: too little for the axes of camera and gyroscope."""
    sigma_rad = aligned.calibration.rotation_sigma_rad
    if sigma_rad < _LIMITS.open_rotation_rad:
        return
    each_s = turning.select(np.unique(turning.t_s // _LIMITS.turned_within_s, return_index=True)[1])
    rate = np.linalg.norm(each_s.turn_rad(), axis=1) / np.diff(each_s.t_s)
    usual = float(np.median(rate))
    if len(rate) >= _LIMITS.fewest_seconds and usual < _LIMITS.still_rad_s:
        fact = Fact(
            "rotation-too-little",
            median_rad_s=usual,
            fastest_s=each_s.t_s[int(np.argmax(rate))] - turning.t_s[0],
            rotation_sigma_rad=sigma_rad,
        )
        yield Finding(fact=fact, severity="error")


def _is_explained(recorded: Recorded) -> bool:
    """Whether another finding says why the gyroscope does not fit."""
    return (
        wrong_time_unit(recorded)
        or (recorded.log is not None and bool(recorded.log.stabilised))
        or any(problem.code in _OF_THE_GYROSCOPE for problem in recorded.implausible)
    )


def check_cameras(recorded: Recorded) -> Iterator[Finding]:
    """Whether cameras of a reconstruction contradict the gyroscope."""
    consensus = recorded.consensus
    if isinstance(consensus, NotObservableError) and recorded.lacks_majority:
        yield Finding(fact=Fact("cameras-turned", why=(consensus.fact,)), severity="error")
    if isinstance(consensus, RotationConsensus) and not consensus.kept.all():
        fact = Fact(
            "cameras-turned",
            why=tuple(map(as_fact, describe_consensus(consensus))),
            wrong=len(consensus.wrong),
            seams=len(consensus.seams),
            left_out=np.sum(~consensus.kept),
            judged=np.sum(consensus.judged),
            median_deg=np.median(consensus.deviation_deg[consensus.judged & consensus.kept]),
        )
        yield Finding(fact=fact, severity="warning", deviations_deg=consensus.deviations_deg)


def _never_fits(recorded: Recorded, turning: CameraTrajectory, failed: NotObservableError) -> Finding:
    """A gyroscope that fits the camera at no offset: it belongs to something else, where there is enough to tell."""
    span_s = float(np.ptp(turning.t_s))
    if span_s < _LIMITS.enough_s:
        return Finding(fact=Fact("offset-undecided", seconds=span_s), severity="warning")
    if recorded.trajectory is None and not recorded.is_dense and len(turning) <= _LIMITS.enough_pairs:
        return Finding(fact=Fact("pictures-too-few", pairs=len(turning) - 1), severity="info")
    clocks = None if recorded.clocks is None else recorded.clocks.fact
    return Finding(fact=Fact("imu-does-not-fit", seconds=span_s, why=failed.fact, clocks=clocks), severity="error")


def _find_better_fit(recorded: Recorded, imu: ImuRecording) -> Finding | None:
    """Find the sign, rate, frame rate or offset with which the gyroscope turns as the camera does."""
    if isinstance(recorded.align(replace(imu, gyro_rad_s=-imu.gyro_rad_s)), Alignment):
        return _find_mirroring(recorded, imu)
    elsewhere = recorded.align(imu, any_offset=True) if recorded.is_offset_limited else None
    if isinstance(elsewhere, Alignment):
        return offset_finding(recorded, elsewhere.calibration.clock_offset_s)
    begin_s = imu.gyro_t_s[0]
    for tried in (*(1 + rate for rate in _LIMITS.tried_rates), *_LIMITS.tried_frame_rates):
        # a frame of the same motion lasts longer, so that it turns slower
        slower = replace(imu, gyro_t_s=begin_s + (imu.gyro_t_s - begin_s) * tried, gyro_rad_s=imu.gyro_rad_s / tried)
        alignment = recorded.align(slower)
        if isinstance(alignment, Alignment):
            rate = tried * (1 + alignment.calibration.clock_rate)
            return rate_finding(rate - 1) if abs(tried - 1) < _LIMITS.wrong_frame_rate else frame_rate_finding(rate)
    return None


def check_gyro_gain(recorded: Recorded) -> Iterator[Finding]:
    """A gyroscope that measures far more, or less, than the camera turned: no sensor's gain is that far off."""
    bounds = _bound_gain(recorded)
    if bounds is None:
        return
    least, most = bounds
    if least > _LIMITS.gyro_gain[1] or most < _LIMITS.gyro_gain[0]:
        yield Finding(fact=Fact("gyro-gain", gain=(least * most) ** 0.5), severity="error")


def _bound_gain(recorded: Recorded) -> tuple[float, float] | None:
    """Least and most rotation by the gyroscope per rotation in the images; ``None`` where they do not tell.

    Intrinsics that are guessed scale what the images show, except about the optical axis. Pixels that are followed lack
    the slow rotation.
    """
    aligned, imu, turning = recorded.aligned, recorded.imu, recorded.turning
    if not isinstance(aligned, Alignment) or imu is None or turning is None:
        return None
    motion = GyroCamera.of(imu, aligned.calibration, camera_epoch_ns=turning.epoch_ns)
    followed = recorded.trajectory is None and recorded.is_dense
    spacing_s = _LIMITS.quick_s / 3 if followed else _LIMITS.gain_interval_s
    poses = turning.select(np.unique(turning.t_s // spacing_s, return_index=True)[1])
    t_s = poses.t_s - aligned.calibration.drift_s(poses.t_s)
    usable = motion.covers(t_s[:-1], t_s[1:])
    inertial, visual = motion.turn_rad(t_s)[usable], poses.turn_rad()[usable]
    if len(visual) < _LIMITS.enough_pairs:
        return None
    if followed:
        inertial, visual = (subtract_running_mean(turn, _LIMITS.quick_intervals) for turn in (inertial, visual))
    if followed or (recorded.trajectory is None and recorded.camera is None):
        inertial, visual = inertial[:, 2:], visual[:, 2:]
    common, of_visual = float(np.sum(inertial * visual)), float(np.sum(visual**2))
    correlation = common / max((of_visual * float(np.sum(inertial**2))) ** 0.5, 1e-12)
    if correlation < _LIMITS.gain_correlation:
        return None
    # noise of the images lowers the first, noise of the gyroscope raises the second
    return common / of_visual, float(np.sum(inertial**2)) / common


def _unit_finding(code: str) -> Finding:
    return Finding(fact=Fact(code, seen_in="camera", gain=1 / UNIT_FACTORS[code]), severity="error")


def check_pose_convention(recorded: Recorded) -> Iterator[Finding]:
    """Poses that fit the IMU if their table was written by another convention than it was read by."""
    likely = recorded.likely_convention
    if likely is not None:
        yield Finding(fact=likely.fact, severity="error")


def _is_mirrored(turning: CameraTrajectory, imu: ImuRecording, aligned: Alignment) -> bool:
    """Whether a mirror relates the rates of camera and IMU: where one axis hardly turns, a rotation nearly fits."""
    motion = GyroCamera.of(imu, aligned.calibration, camera_epoch_ns=turning.epoch_ns)
    step = max(1, round(_LIMITS.interval_s / float(np.median(np.diff(turning.t_s)))))
    poses = turning.select(slice(None, None, step))
    t_s = poses.t_s - aligned.calibration.drift_s(poses.t_s)
    visual, inertial = poses.turn_rad(), motion.turn_rad(t_s)
    usable = motion.covers(t_s[:-1], t_s[1:]) & (np.diff(t_s) < 5 * _LIMITS.interval_s)
    if usable.sum() < 20:
        return False
    cross = visual[usable].T @ inertial[usable]
    singular = np.linalg.svd(cross, compute_uv=False)
    return bool(np.linalg.det(cross) < 0 and singular[2] > _LIMITS.mirror_share * singular[0])


def check_stabilisation(recorded: Recorded) -> Iterator[Finding]:
    """An image that was turned against its lens no longer belongs to the gyroscope."""
    if recorded.log is not None and recorded.log.stabilised:
        noted = recorded.log.stabilisation or "stabilisation was on"
        yield Finding(fact=Fact("stabilised", recorder_notes=noted), severity="error")
        return
    stabilisation = recorded.stabilisation
    # numbers in another unit look like it
    if (
        stabilisation is not None
        and stabilisation.stabilised
        and stabilisation.share is not None
        and recorded.wrong_unit is None
    ):
        yield Finding(fact=Fact("stabilised", share=stabilisation.share), severity="error")


def check_declared(recorded: Recorded) -> Iterator[Finding]:
    """The declared rotation and time offset of camera and IMU against what the recording shows without them."""
    wrong = recorded.contradicted
    if wrong.rotation is not None:
        yield Finding(fact=wrong.rotation, severity="error" if wrong.is_wrong_rotation else "warning")
    if wrong.time_offset is not None:
        yield Finding(fact=wrong.time_offset, severity="error" if wrong.is_wrong_offset else "warning")


def check_focal_length(recorded: Recorded) -> Iterator[Finding]:
    """A focal length that is too long makes all rotation in the image too small, about both of its axes."""
    aligned, rotation, imu, camera = recorded.aligned, recorded.rotation, recorded.imu, recorded.camera
    if not isinstance(aligned, Alignment) or rotation is None or imu is None or camera is None:
        return
    if not recorded.is_dense or next(check_gyro_gain(recorded), None) is not None:
        return
    motion = GyroCamera.of(imu, aligned.calibration, camera_epoch_ns=rotation.epoch_ns)
    known = np.isfinite(rotation.turn_rad).all(axis=1) & motion.covers(rotation.t_s[:-1], rotation.t_s[1:])
    dt_s = np.diff(rotation.t_s)
    width = max(3, round(_LIMITS.quick_s / float(np.median(dt_s))))
    if known.sum() < 10 * width:
        return
    inertial = (motion.turn_rad(rotation.t_s) / dt_s[:, None])[known]
    visual = (rotation.turn_rad / dt_s[:, None])[known]
    quick_inertial, quick_visual = (subtract_running_mean(turn, width)[:, :2] for turn in (inertial, visual))
    energy = float(np.sum(quick_inertial**2))
    if np.sqrt(energy / len(quick_inertial)) < _LIMITS.least_quick_rad_s:
        return
    gain = float(np.sum(quick_visual * quick_inertial)) / energy
    rest = quick_visual - gain * quick_inertial
    sigma = float(np.sqrt(np.mean(rest**2) * width / energy))
    if sigma < _LIMITS.gain_sigma and not _LIMITS.usual_gain[0] - sigma < gain < _LIMITS.usual_gain[1] + sigma:
        fact = Fact("focal-length", gain=gain, gain_sigma=sigma, focal_px=camera.params[0])
        yield Finding(fact=fact, severity="error")


def check_accelerometer_sign(recorded: Recorded) -> Iterator[Finding]:
    """Compare the accelerometer's sign with the accelerations of a reconstructed path."""
    aligned, imu, poses = recorded.aligned, recorded.imu, recorded.trajectory
    if not isinstance(aligned, Alignment) or imu is None or not imu.has_accel or poses is None:
        return
    if recorded.likely_convention is not None:
        return
    quick = quick_accelerations(poses, imu, aligned.calibration)
    if quick is None:
        return
    correlation, sigma = correlate_accelerations(quick)
    if correlation < min(_LIMITS.opposite, -_LIMITS.opposite_sigmas * sigma):
        fact = Fact("accel-flipped", correlation=correlation, correlation_sigma=sigma)
        yield Finding(fact=fact, severity="error")


def correlate_accelerations(quick: QuickAccelerations) -> tuple[float, float]:
    """Correlation of visual and inertial acceleration in the world, without what is slow, and that of chance.

    The latter is its standard deviation where the two have nothing in common: one independent vector in each window.
    """
    inertial, visual = quick.inertial_m_s2, quick.visual
    size = max(float(np.sqrt(np.sum(inertial**2) * np.sum(visual**2))), 1e-12)
    return float(np.sum(inertial * visual)) / size, (3 * quick.seconds / ACCELERATION_S) ** -0.5
