"""The camera against the gyroscope: do they belong together, at one rate, in one set of axes?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.checks.diagnose.findings import UNIT_FACTORS, Finding, Recorded, Severity
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
    """When the camera and the gyroscope do not belong together."""

    #: Clock rates: phones keep within 1e-4, action cameras within 1 %; the scale is corrected for what is found.
    rate: float = 0.003
    wrong_rate: float = 0.012
    wrong_frame_rate: float = 0.1
    #: Intervals over which rotations are compared, and how strong the axis must be that turns the wrong way.
    interval_s: float = 0.1
    mirror_share: float = 0.03
    #: Rates beyond what an alignment follows, which are tried where it finds nothing; and frame rates that are taken
    #: for one another (24, 25, 30, 50, 60 and half or double of them), as the IMU's seconds per second of frames.
    tried_rates: tuple[float, ...] = (0.02, -0.02, 0.03, -0.03, 0.04, -0.04)
    tried_frame_rates: tuple[float, ...] = (0.8, 1.25, 5 / 6, 1.2, 0.5, 2.0, 0.6, 5 / 3)
    #: Of pictures far apart so many pairs must have been compared for a gyroscope not to belong to them.
    enough_pairs: int = 12
    #: A recording that is shorter may simply not have turned enough.
    enough_s: float = 8.0
    #: The IMU may miss so many frames, and this share of them; below the last, too little is left.
    slack_frames: float = 2.0
    slack_share: float = 0.03
    least_covered: float = 0.25
    #: A camera-IMU rotation known better than the first, and off by more than the second, is declared wrongly.
    known_rotation_rad: float = 0.2
    other_rotation_rad: float = 0.35
    #: Parts whose offsets are compared, how far they may be off, and how sharp a part's best offset must be.
    part_s: float = 3.0
    part_reach_s: float = 0.4
    part_step_s: float = 0.01
    uneven_s: float = 0.05
    part_explained: float = 0.6
    #: Quick rotation in the picture per rotation measured; translation is slow against it, and makes it a little less
    #: (0.92 to 0.95 in rendered orbits about a desk, 1.00 before a far wall). A standard deviation above the third
    #: tells nothing.
    quick_s: float = 0.35
    usual_gain: tuple[float, float] = (0.88, 1.08)
    gain_sigma: float = 0.05
    least_quick_rad_s: float = 0.03
    #: The correlation of visual and inertial acceleration that tells its sign.
    opposite: float = -0.3


_LIMITS = CameraCheckLimits()

#: What is wrong with a gyroscope's own numbers keeps it from fitting the camera: it is named once.
_OF_THE_GYROSCOPE = frozenset({*UNIT_FACTORS, "sensors-exchanged", "dead-sensor", "dead-axis"})


_MIRRORED = Finding(
    code="gyro-mirrored",
    severity="error",
    stops=True,
    evidence="the gyroscope fits the camera's rotation better when it is mirrored",
    advice='give the axes of both sensors in capture.toml, for example axes = "-x,y,z" and mirrored = true under '
    "[imu.gyro] and [imu.accel]",
)


_MAP_AGAIN = (
    "look at these images: repeated texture, blur, or something that moved; leave them out, or map again with more "
    "overlap between images"
)


def check_belonging(recorded: Recorded) -> Iterator[Finding]:
    """Whether at some offset the gyroscope turns as the camera does; if not, whether it would, read otherwise."""
    failed, imu, turning = recorded.aligned, recorded.imu, recorded.turning
    if recorded.likely_convention is not None:
        return
    if isinstance(failed, Alignment) and imu is not None and turning is not None:
        if _is_mirrored(turning, imu, failed):
            yield _MIRRORED
        return
    if not isinstance(failed, NotObservableError) or imu is None or turning is None:
        return
    if isinstance(recorded.consensus, NotObservableError) and recorded.consensus.quantity == "camera rotation":
        return
    if recorded.log is not None and recorded.log.stabilised:
        return
    if any(problem.code in _OF_THE_GYROSCOPE for problem in recorded.implausible):
        return
    if recorded.wrong_unit is not None:
        yield _unit_finding(recorded.wrong_unit)
        return
    if failed.quantity != "time offset":
        yield Finding(
            code="rotation-too-little",
            severity="warning",
            evidence=failed.hint,
            advice="turn the camera about all three axes while recording; clocks and axes cannot be checked without",
        )
        return
    otherwise = _find_better_fit(recorded, imu)
    if otherwise is not None:
        yield otherwise
    elif recorded.stabilisation is None or not recorded.stabilisation.stabilised:
        yield _never_fits(recorded, turning, failed)


def check_cameras(recorded: Recorded) -> Iterator[Finding]:
    """Whether cameras of a reconstruction contradict the gyroscope."""
    found = recorded.consensus
    if isinstance(found, NotObservableError) and found.quantity == "camera rotation":
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
        )


def _never_fits(recorded: Recorded, turning: CameraTrajectory, failed: NotObservableError) -> Finding:
    """A gyroscope that fits the camera at no offset: it belongs to something else, where there is enough to tell."""
    span_s = float(np.ptp(turning.t_s))
    if span_s < _LIMITS.enough_s:
        return Finding(
            code="offset-undecided",
            severity="warning",
            evidence=f"in {span_s:.1f} s no time offset between camera and gyroscope is clearly better than the rest",
            advice="record ten seconds or more, with rotation about all three axes",
            numbers={"seconds": span_s},
        )
    if recorded.trajectory is None and not recorded.is_dense and len(turning) <= _LIMITS.enough_pairs:
        return Finding(
            code="pictures-too-few",
            severity="info",
            evidence=f"only {len(turning) - 1} pictures that follow each other share enough to be compared with the "
            "gyroscope, and it fits them at no offset",
            advice="take pictures closer together, or film; after a reconstruction diagnose its model",
            numbers={"pairs": len(turning) - 1.0},
        )
    return Finding(
        code="imu-does-not-fit",
        severity="error",
        stops=True,
        evidence=failed.hint.split(":")[0],
        advice="check that this IMU recording belongs to these images, and the gyroscope's columns, axes and unit",
        numbers={"seconds": span_s},
    )


def _find_better_fit(recorded: Recorded, imu: ImuRecording) -> Finding | None:
    """What makes the gyroscope turn as the camera does: another sign, rate, frame rate, or offset."""
    if isinstance(recorded.align(replace(imu, gyro_rad_s=-imu.gyro_rad_s)), Alignment):
        return _MIRRORED
    begin_s = imu.gyro_t_s[0]
    for tried in (*(1 + rate for rate in _LIMITS.tried_rates), *_LIMITS.tried_frame_rates):
        # a frame of the same motion lasts longer, so that it turns slower
        slower = replace(imu, gyro_t_s=begin_s + (imu.gyro_t_s - begin_s) * tried, gyro_rad_s=imu.gyro_rad_s / tried)
        found = recorded.align(slower)
        if isinstance(found, Alignment):
            rate = tried * (1 + found.calibration.clock_rate)
            return _rate_finding(rate - 1) if abs(tried - 1) < _LIMITS.wrong_frame_rate else _frame_rate_finding(rate)
    if recorded.max_offset_s is None:
        return None
    found = recorded.align(imu, any_offset=True)
    if not isinstance(found, Alignment):
        return None
    offset_s = found.calibration.clock_offset_s
    return Finding(
        code="clock-offset",
        severity="error",
        stops=True,
        evidence=f"camera and gyroscope fit where their stamps are {offset_s:+.3f} s apart, which one clock does not "
        "allow",
        advice="leave out shared_clock = true under [timing] in capture.toml, or correct the stamps; a known offset "
        "goes under [calibration]",
        numbers={"offset_s": offset_s},
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
        stops=True,
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
            stops=True,
            evidence=likely.found,
            advice=likely.advice,
            numbers={"log_likelihood": likely.log_likelihood} if np.isfinite(likely.log_likelihood) else {},
        )


def _is_mirrored(turning: CameraTrajectory, imu: ImuRecording, aligned: Alignment) -> bool:
    """Whether rates of camera and IMU are related by a mirror: where one axis hardly turns, a rotation nearly fits."""
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


def check_clock_rate(recorded: Recorded) -> Iterator[Finding]:
    """A camera's clock that runs faster or slower than the IMU's."""
    aligned = recorded.aligned
    if isinstance(aligned, Alignment) and aligned.drifts(faster_than=_LIMITS.rate):
        yield _rate_finding(aligned.calibration.clock_rate)


def _rate_finding(rate: float) -> Finding:
    severity: Severity = "error" if abs(rate) > _LIMITS.wrong_rate else "warning"
    return Finding(
        code="clock-rate",
        severity=severity,
        evidence=f"the camera's clock runs {100 * rate:+.2f} % faster than the IMU's, and either may be wrong: lengths "
        "go with the square of time",
        advice="give frame times as the recorder stamped them, not a frame number divided by a nominal rate; then "
        "check the stamps of the IMU; up to 1 % is corrected",
        numbers={"rate": rate},
    )


def _frame_rate_finding(rate: float) -> Finding:
    """Frame times by a wrong frame rate; ``rate`` is how many seconds of frames the IMU's second is."""
    return Finding(
        code="frame-rate",
        severity="error",
        stops=True,
        evidence=f"the frames fit the gyroscope if {rate:.3g} times as many come in a second as are stated: they were "
        "timed by another frame rate than they were filmed with",
        advice="give the video itself as [video], or times as the recorder stamped them",
        numbers={"rate": rate},
    )


def check_coverage(recorded: Recorded) -> Iterator[Finding]:
    """An IMU that was started late or stopped early."""
    imu = recorded.imu
    frames = recorded.timing or recorded.trajectory
    if imu is None or frames is None or len(frames.t_s) < 3:
        return
    sensors = [imu.gyro_t_s, imu.accel_t_s] if imu.has_accel else [imu.gyro_t_s]
    begin_s, end_s = max(t_s[0] for t_s in sensors), min(t_s[-1] for t_s in sensors)
    span_s = float(frames.t_s[-1] - frames.t_s[0])
    slack_s = max(_LIMITS.slack_frames * float(np.median(np.diff(frames.t_s))), _LIMITS.slack_share * span_s)
    shift_s = recorded.offset_s(frames.epoch_ns)
    if shift_s is not None:
        missed_s = max(begin_s + shift_s - frames.t_s[0], 0) + max(frames.t_s[-1] - end_s - shift_s, 0)
    else:
        missed_s = span_s - (end_s - begin_s)
    if missed_s <= slack_s:
        return
    share = float(np.clip(1 - missed_s / span_s, 0, 1))
    yield Finding(
        code="imu-too-short",
        severity="error" if share < _LIMITS.least_covered else "warning",
        evidence=f"the IMU runs along with {100 * share:.0f} % of {span_s:.1f} s of frames",
        advice="start the IMU before the video and stop it after; the scale rests on what both recorded",
        numbers={"share": share, "frames_s": span_s, "imu_s": float(end_s - begin_s)},
    )


def check_stabilisation(recorded: Recorded) -> Iterator[Finding]:
    """A picture that was turned against its lens no longer belongs to the gyroscope."""
    advice = "switch stabilisation off in the camera and record again; the scale of such a video is wrong"
    if recorded.log is not None and recorded.log.stabilised:
        said = recorded.log.stabilisation or "stabilisation was on"
        yield Finding(
            code="stabilised",
            severity="error",
            stops=True,
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
            stops=True,
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


def check_even_times(recorded: Recorded) -> Iterator[Finding]:
    """Frame times that drift to and fro against the gyroscope, as those counted from a frame rate do."""
    aligned, imu, turning = recorded.aligned, recorded.imu, recorded.turning
    if not isinstance(aligned, Alignment) or imu is None or turning is None:
        return
    if float(np.median(np.diff(turning.t_s))) > _LIMITS.part_reach_s / 2:
        return
    motion = GyroCamera.of(imu, aligned.calibration, camera_epoch_ns=turning.epoch_ns)
    middles, offsets = [], []
    count = int(np.ptp(turning.t_s) / _LIMITS.part_s)
    for begin_s in turning.t_s[0] + _LIMITS.part_s * np.arange(count):
        inside = np.flatnonzero((turning.t_s >= begin_s) & (turning.t_s < begin_s + _LIMITS.part_s))
        middle_s = begin_s + 0.5 * _LIMITS.part_s
        drift_s = float(aligned.calibration.drift_s(middle_s))
        found = _part_offset_s(turning.select(inside), motion, drift_s)
        if found is not None:
            middles.append(middle_s)
            offsets.append(found)
    if len(offsets) < 3:
        return
    off = np.array(offsets)
    off -= np.median(off)
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) > _LIMITS.uneven_s:
        yield Finding(
            code="frame-times-uneven",
            severity="error",
            evidence=f"against the gyroscope, frame times wander by {1e3 * np.ptp(off):.0f} ms; worst "
            f"{middles[worst] - turning.t_s[0]:.0f} s after the first frame",
            advice="time frames by the video's presentation stamps or the recorder's own times, never by counting; "
            "frames that were dropped or repeated must not shift the rest",
            numbers={"wander_s": float(np.ptp(off)), "parts": float(len(off))},
        )


def _part_offset_s(part: CameraTrajectory, motion: GyroCamera, drift_s: float) -> float | None:
    """What must be added to a part's offset so that the gyroscope explains it best."""
    if len(part) < 8:
        return None
    visual = part.turn_rad()
    shifts = np.arange(-_LIMITS.part_reach_s, _LIMITS.part_reach_s + 1e-9, _LIMITS.part_step_s)
    left = np.full(len(shifts), np.inf)
    t_s = part.t_s - drift_s - shifts[:, None]
    covered = motion.covers(t_s[:, 0], t_s[:, -1])
    difference = visual - motion.turn_rad(t_s[covered])
    spread = difference - difference.mean(axis=1, keepdims=True)
    left[covered] = np.median(np.sum(spread**2, axis=2), axis=1)
    best = int(np.argmin(left))
    energy = float(np.median(np.sum((visual - visual.mean(axis=0)) ** 2, axis=1)))
    if best in (0, len(left) - 1) or not np.isfinite(left[best - 1 : best + 2]).all():
        return None
    if left[best] > (1 - _LIMITS.part_explained) * energy:
        return None
    return float(shifts[best])


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
    """Where a reconstruction shows how the camera sped up, the accelerometer must show that, not its opposite."""
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
