"""The frames by themselves: their times, repeats, exposures, readout, and the video they were cut from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from colmap_inertial.checks.diagnose.findings import Finding, Recorded, Severity
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.motion.align import Alignment
from colmap_inertial.motion.shutter import ReadoutEstimate, estimate_readout


@dataclass(frozen=True, kw_only=True)
class FrameCheckLimits:
    """Limits for frames, their times and exposures."""

    #: Frames come evenly where this share of their intervals is the usual one to within this; keyframes do not.
    even_share: float = 0.8
    even: float = 0.1
    #: A single frame now and then is lost in most recordings.
    dropped: int = 2
    dropped_share: float = 0.002
    #: A pair of frames turned by less than this is one frame twice; more of them than the share shift the times.
    same_rad: float = 1e-7
    repeated: int = 2
    repeated_share: float = 0.05
    #: Blur, as a share of the picture's long side, beyond which features suffer; and the frames that may have it.
    blur_share: float = 0.004
    blurred_frames: float = 0.5
    #: COLMAP's guess of a focal length in long sides, where none is declared.
    guessed_focal: float = 1.2
    #: Times of cut frames against the video's own: below the first is rounding; and how near a video's start is meant.
    wander_s: float = 0.003
    start_s: float = 0.002


_LIMITS = FrameCheckLimits()


def check_dropped(recorded: Recorded) -> Iterator[Finding]:
    """Report intervals of at least twice the usual length."""
    frames = recorded.timing or recorded.trajectory
    if frames is None or len(frames.t_s) < 20:
        return
    step_s = np.diff(frames.t_s)
    usual_s = float(np.median(step_s))
    if np.mean(np.abs(step_s / usual_s - 1) < _LIMITS.even) < _LIMITS.even_share:
        return
    lost = int(np.sum(np.round(step_s / usual_s) - 1))
    if lost > max(_LIMITS.dropped, _LIMITS.dropped_share * len(step_s)):
        yield Finding(
            code="frames-dropped",
            severity="warning",
            evidence=f"{lost} frames are missing between {len(frames.t_s)} that come every {1e3 * usual_s:.1f} ms; "
            f"the longest pause is {step_s.max():.2f} s",
            numbers={"lost": float(lost), "longest_s": float(step_s.max())},
        )


def check_repeated(recorded: Recorded) -> Iterator[Finding]:
    """Frames that are the one before, at a time of their own."""
    if recorded.rotation is not None:
        turn = recorded.rotation.turn_rad
        same = np.linalg.norm(turn[np.isfinite(turn).all(axis=1)], axis=1) < _LIMITS.same_rad
    elif recorded.trajectory is not None:
        poses = recorded.trajectory
        same = (np.diff(poses.cam_in_world, axis=0) == 0).all(axis=1)
        same &= (np.diff(poses.cam_from_world_xyzw, axis=0) == 0).all(axis=1)
    else:
        return
    count = int(np.sum(same))
    if count > _LIMITS.repeated:
        severity: Severity = "error" if count > _LIMITS.repeated_share * len(same) else "warning"
        yield Finding(
            code="frames-repeated",
            severity=severity,
            evidence=f"{count} of {len(same)} frames repeat the one before them",
            numbers={"repeated": float(count), "looked_at": float(len(same))},
        )


def check_exposure(recorded: Recorded) -> Iterator[Finding]:
    """Exposures in which the gyroscope says that the picture smeared."""
    timing, imu = recorded.timing, recorded.imu
    if timing is None or timing.exposure_s is None or imu is None:
        return
    # rates in another unit tell no blur
    if recorded.implausible or recorded.wrong_unit is not None:
        return
    rate = np.linalg.norm(imu.gyro_rad_s - np.median(imu.gyro_rad_s, axis=0), axis=1)
    shift_s = recorded.offset_s(timing.epoch_ns)
    if shift_s is not None:
        turning = np.interp(timing.t_s, imu.gyro_t_s + shift_s, rate)
    else:
        turning = np.full(len(timing.t_s), np.median(rate))
    focal = _LIMITS.guessed_focal
    if recorded.camera is not None:
        focal = recorded.camera.params[0] / max(recorded.camera.width, recorded.camera.height)
    # two of three axes smear the middle of the picture
    blur = focal * turning * timing.exposure_s * (2 / 3) ** 0.5
    share = float(np.mean(blur > _LIMITS.blur_share))
    if share > _LIMITS.blurred_frames:
        yield Finding(
            code="exposure-too-long",
            severity="warning",
            evidence=f"{100 * share:.0f} % of the frames are blurred by more than {100 * _LIMITS.blur_share:g} % of "
            f"the picture's long side (median {100 * np.median(blur):.2f} %, exposure "
            f"{1e3 * np.median(timing.exposure_s):.1f} ms)",
            numbers={"share": share, "median_blur_of_long_side": float(np.median(blur))},
        )


def check_readout(recorded: Recorded) -> Iterator[Finding]:
    """A capture that does not say how its shutter runs; where the pictures show it, how long it takes."""
    if not recorded.is_capture or recorded.timing is None or recorded.timing.readout_s is not None:
        return
    evidence = "nothing says whether the camera has a rolling shutter, as nearly all phones do"
    try:
        readout = _readout(recorded)
    except NotObservableError as error:
        yield Finding(
            code="readout-unknown",
            severity="warning",
            evidence=f"{evidence}; {error.hint.split(':')[0]}",
        )
        return
    lines = f"readout_s = {readout.readout_s:.4f}"
    if readout.direction != "down":
        lines += f' and readout_direction = "{readout.direction}"'
    yield Finding(
        code="readout-unknown",
        severity="warning",
        evidence=f"{evidence}; by the pictures and the gyroscope, reading a frame takes {readout}"
        + ("" if readout.readout_s else ", as a global shutter"),
        advice=f"write {lines} under [timing] in capture.toml, so that it is undone",
        numbers={"readout_s": readout.readout_s, "readout_sigma_s": readout.sigma_s, "pairs": float(readout.pairs)},
    )


def _readout(recorded: Recorded) -> ReadoutEstimate:
    """Estimate the readout from tracked corners and the aligned gyroscope."""
    rotation, aligned, imu = recorded.rotation, recorded.aligned, recorded.imu
    if rotation is not None and not recorded.is_dense:
        raise NotObservableError("readout", "pictures that are this far apart in time do not tell it; a video does")
    if rotation is None or imu is None or not isinstance(aligned, Alignment):
        raise NotObservableError("readout", "a video and its gyroscope would tell, where they fit each other")
    if recorded.stabilisation is not None and recorded.stabilisation.stabilised:
        raise NotObservableError("readout", "a stabilised video tells nothing of it")
    timed = CameraTimedImu.from_recording(imu, aligned.settled(), rotation.epoch_ns)
    return estimate_readout(rotation, GyroCamera.from_timed(timed))


def check_cut_from_video(recorded: Recorded) -> Iterator[Finding]:
    """Times and orientation of pictures against the video that they were cut from."""
    cut = recorded.in_video
    if cut is None:
        return
    if cut.doubtful:
        yield Finding(
            code="frames-not-in-video",
            severity="info",
            evidence=f"{cut.doubtful} of {cut.doubtful + len(cut.found_ns)} pictures look like no frame of the video, "
            "or like several",
            numbers={"pictures": float(cut.doubtful)},
        )
    if cut.quarter_turns:
        yield Finding(
            code="frames-turned",
            severity="error" if _refers_to_rows(recorded) else "info",
            evidence=f"the pictures are turned by {90 * cut.quarter_turns} deg against the sensor's rows",
            numbers={"angle_deg": 90.0 * cut.quarter_turns},
        )
    elif cut.container_turn_deg % 360:
        yield Finding(
            code="rotation-ignored",
            severity="info",
            evidence=f"the video asks players to turn it by {cut.container_turn_deg} deg; the pictures are as the "
            "sensor saw them",
            numbers={"angle_deg": float(cut.container_turn_deg)},
        )
    if len(cut.found_ns) < 3:
        return
    off_s = (cut.stated_ns - cut.found_ns) * 1e-9
    middle_s = float(np.median(off_s))
    wander_s = float(np.ptp(off_s))
    start_s = cut.video_start_ns * 1e-9
    if wander_s > _LIMITS.wander_s:
        yield Finding(
            code="frame-times-counted",
            severity="error",
            evidence=f"the pictures' times wander by {1e3 * wander_s:.0f} ms against the presentation stamps of the "
            "video's frames that they are, as times counted from a frame rate do",
            numbers={"wander_s": wander_s},
        )
    elif abs(start_s) > _LIMITS.start_s and abs(middle_s + start_s) < _LIMITS.start_s:
        yield Finding(
            code="container-start-ignored",
            severity="error",
            evidence=f"the pictures' times lack the {1e3 * start_s:+.0f} ms at which the video's container starts",
            numbers={"start_s": start_s},
        )


def _refers_to_rows(recorded: Recorded) -> bool:
    """Whether anything is declared that pictures in another orientation would belie."""
    readout_s = None if recorded.timing is None else recorded.timing.readout_s
    prior = recorded.calibration
    calibrated = prior is not None and prior.rotation_sigma_rad < 1
    return bool(readout_s) or calibrated or recorded.camera is not None
