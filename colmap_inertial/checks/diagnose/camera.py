"""The camera against the gyroscope: do they belong together, at one rate, in one set of axes?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.checks.diagnose.clocks import (
    frame_rate_finding,
    offset_finding,
    rate_finding,
    wrong_time_unit,
)
from colmap_inertial.checks.diagnose.findings import UNIT_FACTORS, Finding, Recorded
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_conjugate, quat_log, quat_multiply
from colmap_inertial.core.sampling import subtract_running_mean
from colmap_inertial.core.types import CameraTrajectory, ImuRecording, RotationConsensus
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.motion.align import Alignment
from colmap_inertial.motion.align.consensus import describe_consensus
from colmap_inertial.motion.align.conventions import quick_accelerations


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
    #: Of pictures far apart so many pairs must have been compared for a gyroscope not to belong to them.
    enough_pairs: int = 12
    #: A recording that is shorter may simply not have turned enough.
    enough_s: float = 8.0
    #: A camera-IMU rotation known better than the first, and off by more than the second, is declared wrongly.
    known_rotation_rad: float = 0.2
    other_rotation_rad: float = 0.35
    #: Quick rotation in the picture per rotation measured; translation is slow against it, and makes it a little less
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
    #: The correlation of visual and inertial acceleration that tells its sign.
    opposite: float = -0.3


_LIMITS = CameraCheckLimits()

#: What is wrong with a gyroscope's own numbers keeps it from fitting the camera: it is named once.
_OF_THE_GYROSCOPE = frozenset({*UNIT_FACTORS, "gyro-unit", "sensors-exchanged", "dead-sensor", "dead-axis"})


_MIRRORED = Finding(
    code="gyro-mirrored",
    severity="error",
    evidence="the gyroscope fits the camera's rotation better when it is mirrored",
    advice='give the axes of both sensors in capture.toml, for example axes = "-x,y,z" and mirrored = true under '
    "[imu.gyro] and [imu.accel]",
)


_MAP_AGAIN = (
    "look at these images: repeated texture, blur, or something that moved; leave them out, or map again with more "
    "overlap between images"
)


def check_belonging(recorded: Recorded) -> Iterator[Finding]:
    """Whether the gyroscope turns as the camera does at some time offset; if not, under which other reading it
    would.
    """
    failed, imu, turning = recorded.aligned, recorded.imu, recorded.turning
    if recorded.lacks_majority or recorded.likely_convention is not None:
        return
    if isinstance(failed, Alignment) and imu is not None and turning is not None:
        if _is_mirrored(turning, imu, failed):
            yield _MIRRORED
        return
    if not isinstance(failed, NotObservableError) or imu is None or turning is None or _is_explained(recorded):
        return
    if recorded.wrong_unit is not None:
        yield _unit_finding(recorded.wrong_unit)
        return
    if failed.quantity != "time offset":
        yield Finding(
            code="rotation-too-little",
            severity="warning",
            evidence=failed.hint.split(":")[0],
            advice="turn the camera about all three axes while recording; clocks and axes cannot be checked without",
        )
        return
    otherwise = _find_better_fit(recorded, imu)
    if otherwise is not None:
        yield otherwise
    elif recorded.stabilisation is None or not recorded.stabilisation.stabilised:
        yield _never_fits(recorded, turning, failed)


def _is_explained(recorded: Recorded) -> bool:
    """Whether another finding says why the gyroscope does not fit."""
    return (
        wrong_time_unit(recorded)
        or (recorded.log is not None and bool(recorded.log.stabilised))
        or any(problem.code in _OF_THE_GYROSCOPE for problem in recorded.implausible)
    )


def check_cameras(recorded: Recorded) -> Iterator[Finding]:
    """Whether cameras of a reconstruction contradict the gyroscope."""
    found = recorded.consensus
    if isinstance(found, NotObservableError) and recorded.lacks_majority:
        yield Finding(code="cameras-turned", severity="error", evidence=found.hint, advice=_MAP_AGAIN)
    if isinstance(found, RotationConsensus) and not found.kept.all():
        yield Finding(
            code="cameras-turned",
            severity="warning",
            evidence="; ".join(describe_consensus(found)),
            advice=_MAP_AGAIN,
            numbers={
                "wrong": float(len(found.wrong)),
                "seams": float(len(found.seams)),
                "left_out": float(np.sum(~found.kept)),
                "judged": float(np.sum(found.judged)),
                "median_deg": float(np.median(found.deviation_deg[found.judged & found.kept])),
            },
            deviations_deg=found.deviations_deg,
        )


def _never_fits(recorded: Recorded, turning: CameraTrajectory, failed: NotObservableError) -> Finding:
    """A gyroscope that fits the camera at no offset: it belongs to something else, where there is enough to tell."""
    span_s = float(np.ptp(turning.t_s))
    if span_s < _LIMITS.enough_s:
        return Finding(
            code="offset-undecided",
            severity="warning",
            evidence=f"no time offset between camera and gyroscope fits clearly better than others in {span_s:.1f} s",
            advice="record ten seconds or more, with rotation about all three axes",
            numbers={"seconds": span_s},
        )
    if recorded.trajectory is None and not recorded.is_dense and len(turning) <= _LIMITS.enough_pairs:
        return Finding(
            code="pictures-too-few",
            severity="info",
            evidence=f"only {len(turning) - 1} pairs of consecutive pictures overlap enough to be compared with the "
            "gyroscope, and no time offset fits them",
            advice="take pictures closer together, or film; after a reconstruction diagnose its model",
            numbers={"pairs": len(turning) - 1.0},
        )
    return Finding(
        code="imu-does-not-fit",
        severity="error",
        evidence=f"{failed.hint.split(':')[0]}; {recorded.clocks}",
        advice="check that this IMU recording belongs to these images, both time stamps and their units, and the "
        "gyroscope's columns, axes and unit",
        numbers={"seconds": span_s},
    )


def _find_better_fit(recorded: Recorded, imu: ImuRecording) -> Finding | None:
    """Find the sign, rate, frame rate or offset with which the gyroscope turns as the camera does."""
    if isinstance(recorded.align(replace(imu, gyro_rad_s=-imu.gyro_rad_s)), Alignment):
        return _MIRRORED
    elsewhere = recorded.align(imu, any_offset=True)
    if isinstance(elsewhere, Alignment):
        return offset_finding(recorded, elsewhere.calibration.clock_offset_s)
    begin_s = imu.gyro_t_s[0]
    for tried in (*(1 + rate for rate in _LIMITS.tried_rates), *_LIMITS.tried_frame_rates):
        # a frame of the same motion lasts longer, so that it turns slower
        slower = replace(imu, gyro_t_s=begin_s + (imu.gyro_t_s - begin_s) * tried, gyro_rad_s=imu.gyro_rad_s / tried)
        found = recorded.align(slower)
        if isinstance(found, Alignment):
            rate = tried * (1 + found.calibration.clock_rate)
            return rate_finding(rate - 1) if abs(tried - 1) < _LIMITS.wrong_frame_rate else frame_rate_finding(rate)
    return None


def check_gyro_gain(recorded: Recorded) -> Iterator[Finding]:
    """A gyroscope that measures far more, or less, than the camera turned: no sensor's gain is that far off."""
    aligned, imu, turning = recorded.aligned, recorded.imu, recorded.turning
    if not isinstance(aligned, Alignment) or imu is None or turning is None:
        return
    # pixels that are followed lack the slow rotation, and guessed intrinsics scale what they show
    if recorded.is_dense or (recorded.trajectory is None and recorded.camera is None):
        return
    motion = GyroCamera.of(imu, aligned.calibration, camera_epoch_ns=turning.epoch_ns)
    poses = turning.select(np.unique(turning.t_s // _LIMITS.gain_interval_s, return_index=True)[1])
    t_s = poses.t_s - aligned.calibration.drift_s(poses.t_s)
    usable = motion.covers(t_s[:-1], t_s[1:])
    inertial, visual = motion.turn_rad(t_s)[usable], poses.turn_rad()[usable]
    common = float(np.sum(inertial * visual))
    if len(visual) < _LIMITS.enough_pairs or common <= 0:
        return
    # noise of the images lowers the first, noise of the gyroscope raises the second
    least, most = common / float(np.sum(visual**2)), float(np.sum(inertial**2)) / common
    if least > _LIMITS.gyro_gain[1] or most < _LIMITS.gyro_gain[0]:
        gain = (least * most) ** 0.5
        yield Finding(
            code="gyro-gain",
            severity="error",
            evidence=f"the gyroscope measures {gain:.2f} times the rotation that the images show; sensors are right to "
            "a few per cent",
            advice="check the gyroscope's unit and counts_per_unit in capture.toml, and the focal length under "
            "[camera]; calibrate-imu measures the gain",
            numbers={"gain": gain},
        )


def _unit_finding(code: str) -> Finding:
    factor = UNIT_FACTORS[code]
    if factor < 1:
        found = "the gyroscope turns as the camera does, but 57.3 times as far: its numbers are in deg/s"
        unit = "deg/s"
    else:
        found = (
            "the gyroscope turns as the camera does, but a 57.3th as far: rad/s were converted as if they were deg/s"
        )
        unit = "rad/s"
    return Finding(
        code=code,
        severity="error",
        evidence=found,
        advice=f'set unit = "{unit}" under [imu.gyro] in capture.toml',
        numbers={"gain": 1 / factor},
    )


def check_pose_convention(recorded: Recorded) -> Iterator[Finding]:
    """Poses that fit the IMU if their table was written by another convention than it was read by."""
    likely = recorded.likely_convention
    if likely is not None:
        yield Finding(
            code="pose-convention",
            severity="error",
            evidence=likely.found,
            advice=likely.advice,
            numbers={"log_likelihood": likely.log_likelihood} if np.isfinite(likely.log_likelihood) else {},
        )


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
    """A picture that was turned against its lens no longer belongs to the gyroscope."""
    advice = "switch stabilisation off in the camera and record again; the scale of such a video is wrong"
    if recorded.log is not None and recorded.log.stabilised:
        said = recorded.log.stabilisation or "stabilisation was on"
        yield Finding(
            code="stabilised",
            severity="error",
            evidence=f"the recorder says that the video was stabilised in the camera ({said})",
            advice=advice,
        )
        return
    told = recorded.stabilisation
    # numbers in another unit look like it
    if told is not None and told.stabilised and told.share is not None and recorded.wrong_unit is None:
        yield Finding(
            code="stabilised",
            severity="error",
            evidence=f"the pictures hold {100 * told.share:.0f} % of the quick rotation that the gyroscope measured: "
            "the video was stabilised in the camera",
            advice=advice,
            numbers={"share": told.share},
        )


def check_declared_rotation(recorded: Recorded) -> Iterator[Finding]:
    """The declared rotation between camera and IMU against the one that the pictures show."""
    aligned, prior = recorded.aligned, recorded.calibration
    if not isinstance(aligned, Alignment) or prior is None:
        return
    sigmas = [c.rotation_sigma_rad for c in (prior, aligned.calibration)]
    if max(sigmas) > _LIMITS.known_rotation_rad:
        return
    turn = quat_multiply(aligned.calibration.cam_from_imu_xyzw, quat_conjugate(prior.cam_from_imu_xyzw))
    angle = float(np.linalg.norm(quat_log(turn)))
    if angle > _LIMITS.other_rotation_rad + 3 * max(sigmas):
        yield Finding(
            code="declared-rotation",
            severity="error",
            evidence=f"camera and IMU are turned by {np.degrees(angle):.0f} deg against what is declared",
            advice="correct cam_from_imu under [calibration]; frames that were turned upright are not in the sensor's "
            "orientation: cut them without (ffmpeg -noautorotate)",
            numbers={"angle_deg": float(np.degrees(angle))},
        )


def check_focal_length(recorded: Recorded) -> Iterator[Finding]:
    """A focal length that is too long makes all rotation in the picture too small, about both of its axes."""
    aligned, rotation, imu, camera = recorded.aligned, recorded.rotation, recorded.imu, recorded.camera
    if not isinstance(aligned, Alignment) or rotation is None or imu is None or camera is None:
        return
    if not recorded.is_dense:
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
        yield Finding(
            code="focal-length",
            severity="error",
            evidence=f"the pictures turn {gain:.2f} times as far as the gyroscope measured: with the declared focal "
            f"length of {camera.params[0]:.0f} px, about {camera.params[0] * gain:.0f} px would fit",
            advice="leave out [camera] to let COLMAP calibrate, or give the intrinsics of this very video mode",
            numbers={"gain": gain, "gain_sigma": sigma},
        )


def check_accelerometer_sign(recorded: Recorded) -> Iterator[Finding]:
    """Compare the accelerometer's sign with the accelerations of a reconstructed path."""
    aligned, imu, poses = recorded.aligned, recorded.imu, recorded.trajectory
    if not isinstance(aligned, Alignment) or imu is None or not imu.has_accel or poses is None:
        return
    if recorded.likely_convention is not None:
        return
    correlation = acceleration_correlation(poses, imu, aligned)
    if correlation is not None and correlation < _LIMITS.opposite:
        yield Finding(
            code="accel-flipped",
            severity="error",
            evidence="the accelerometer measures the opposite of the camera's acceleration (correlation "
            f"{correlation:.2f}): its sign is flipped",
            advice='set axes = "-x,-y,-z" and mirrored = true under [imu.accel] in capture.toml',
            numbers={"correlation": correlation},
        )


def acceleration_correlation(poses: CameraTrajectory, imu: ImuRecording, aligned: Alignment) -> float | None:
    """Correlation of visual and inertial acceleration in the world, without what is slow; ``None`` where sparse."""
    quick = quick_accelerations(poses, imu, aligned.calibration)
    if quick is None:
        return None
    inertial, visual = quick.inertial_m_s2, quick.visual
    return float(np.sum(inertial * visual) / max(np.sqrt(np.sum(inertial**2) * np.sum(visual**2)), 1e-12))
