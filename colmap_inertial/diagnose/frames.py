"""The frames by themselves: their times, repeats, exposures, readout, and the video they were cut from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraModel, FrameTiming
from colmap_inertial.diagnose.diagnosis import Finding, Recorded, Severity
from colmap_inertial.imaging.exposure import (
    ExposureEstimate,
    compare_exposures,
    estimate_exposure,
    exposures_to_compare,
)
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.psf import predict_blur_px
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.align import Alignment
from colmap_inertial.motion.shutter import ReadoutEstimate, compare_readout, estimate_readout


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
    #: Images that show less than this share of what the gyroscope turned, so many pairs in a row, where it turned by
    #: more than this and than so many standard deviations of what images show.
    frozen_share: float = 0.1
    frozen_pairs: int = 3
    frozen_rad: float = 2e-3
    frozen_sigmas: float = 5.0
    #: A declared readout that is off by more than this, and so many standard deviations of what images show.
    readout_s: float = 4e-3
    readout_sigmas: float = 5.0
    #: More images without any feature leave too few.
    blank_share: float = 0.5
    #: Blur, as a share of the image's long side, beyond which features suffer; and the frames that may have it.
    blur_share: float = 0.004
    blurred_frames: float = 0.5
    #: COLMAP's guess of a focal length in long sides, where none is declared.
    guessed_focal: float = 1.2
    #: Frames by which an exposure is estimated: so many of the slowest share, and of the fastest; and the exposure for
    #: which their speed is predicted.
    slow_frames: int = 10
    slow_share: float = 0.35
    fast_frames: int = 20
    fast_share: float = 0.4
    brief_s: float = 0.01
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
        fact = Fact("frames-dropped", lost=lost, frames=len(frames.t_s), step_s=usual_s, longest_s=step_s.max())
        yield Finding(fact=fact, severity="warning")


def check_repeated(recorded: Recorded) -> Iterator[Finding]:
    """Frames that are the one before, at a time of their own."""
    if recorded.rotation is not None:
        turn = recorded.rotation.turn_rad
        same = np.linalg.norm(turn, axis=1) < _LIMITS.same_rad
        same = (same | _are_frozen(recorded))[np.isfinite(turn).all(axis=1)]
    elif recorded.trajectory is not None:
        poses = recorded.trajectory
        same = (np.diff(poses.cam_in_world, axis=0) == 0).all(axis=1)
        same &= (np.diff(poses.cam_from_world_xyzw, axis=0) == 0).all(axis=1)
    else:
        return
    count = int(np.sum(same))
    if count > _LIMITS.repeated:
        severity: Severity = "error" if count > _LIMITS.repeated_share * len(same) else "warning"
        yield Finding(fact=Fact("frames-repeated", repeated=count, looked_at=len(same)), severity=severity)


def _are_frozen(recorded: Recorded) -> BoolArray:
    """Between which images nothing turned while the gyroscope did: one image again, coded anew."""
    rotation, aligned, imu = recorded.rotation, recorded.aligned, recorded.imu
    assert rotation is not None
    none = np.zeros(len(rotation.turn_rad), dtype=np.bool_)
    stabilised = recorded.stabilisation is not None and recorded.stabilisation.stabilised
    if imu is None or not isinstance(aligned, Alignment) or not recorded.is_dense or stabilised:
        return none
    motion = GyroCamera.of(imu, aligned.calibration, camera_epoch_ns=rotation.epoch_ns)
    covered = motion.covers(rotation.t_s[:-1], rotation.t_s[1:])
    turn_rad, step_s = motion.turn_rad(rotation.t_s), np.diff(rotation.t_s)[:, None]
    shown = np.linalg.norm(rotation.turn_rad, axis=1)
    least_rad = np.maximum(_LIMITS.frozen_rad, _LIMITS.frozen_sigmas * rotation.sigma_rad)

    def stand_still(turn_rad: Array) -> BoolArray:
        turned = np.linalg.norm(turn_rad, axis=1)
        with np.errstate(invalid="ignore"):
            return covered & (turned > least_rad) & (shown < _LIMITS.frozen_share * turned)

    still = stand_still(turn_rad)
    if still.any():
        # what the gyroscope reads in all of them alike is its bias, which pixels tell poorly where the camera slides
        still = stand_still(turn_rad - np.median(turn_rad[still] / step_s[still], axis=0) * step_s)
    # by chance where both turn back, once; not in a row
    runs = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]])))
    for begin, end in zip(runs[::2].tolist(), runs[1::2].tolist(), strict=True):
        none[begin:end] = end - begin >= _LIMITS.frozen_pairs
    return none


def check_blank(recorded: Recorded) -> Iterator[Finding]:
    """Pictures that are black or show nothing: no features, no pose."""
    count = len(recorded.blank)
    if count == 0:
        return
    fact = Fact("frames-blank", blank=count, looked_at=recorded.looked_at, example=recorded.blank[0])
    most = count > _LIMITS.blank_share * recorded.looked_at
    yield Finding(fact=fact, severity="error" if most else "warning")


def check_exposure(recorded: Recorded) -> Iterator[Finding]:
    """Exposures in which the gyroscope says that the image smeared."""
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
    # two of three axes smear the middle of the image
    blur = focal * turning * timing.exposure_s * (2 / 3) ** 0.5
    share = float(np.mean(blur > _LIMITS.blur_share))
    if share > _LIMITS.blurred_frames:
        fact = Fact(
            "exposure-too-long",
            share=share,
            blur_limit_of_long_side=_LIMITS.blur_share,
            median_blur_of_long_side=np.median(blur),
            exposure_s=np.median(timing.exposure_s),
        )
        yield Finding(fact=fact, severity="warning")


def check_unstated_exposure(recorded: Recorded) -> Iterator[Finding]:
    """An exposure that nobody states, by the blur of frames that turn quickly and slowly."""
    timing = recorded.timing
    if not recorded.is_capture or timing is None or timing.exposure_s is not None or recorded.camera is None:
        return
    try:
        found, fastest_px_s = estimate_unstated_exposure(recorded)
    except NotObservableError:
        return
    fact = Fact(
        "exposure-unstated",
        exposure_s=found.exposure_s,
        exposure_sigma_s=found.sigma_s,
        most_s=found.most_s,
        most_px=fastest_px_s * (found.exposure_s or found.most_s),
        frames=found.frames,
    )
    yield Finding(fact=fact, severity="info")


def estimate_unstated_exposure(recorded: Recorded) -> tuple[ExposureEstimate, float]:
    """Estimate the exposure of frames by their blur, with the gyroscope as it was aligned.

    Returns
    -------
    The estimate, from some of the frames that there are in full; and the speed of the fastest of all frames, px/s.

    Raises
    ------
    NotObservableError
        Where images or an alignment are missing, or frames do not tell.
    """
    timing, camera = recorded.timing, recorded.camera
    if timing is None or camera is None or recorded.images is None:
        raise NotObservableError("exposure", Fact("exposure-without-images"))
    stabilised = recorded.stabilisation is not None and recorded.stabilisation.stabilised
    if not isinstance(recorded.aligned, Alignment) or stabilised:
        raise NotObservableError("exposure", Fact("exposure-without-gyroscope"))
    speed_px_s = _predict_speed(recorded, timing, camera)
    places = {name: i for i, name in enumerate(timing.names)}
    at_hand = np.array([places[name] for name in recorded.in_full], dtype=np.intp)
    known = at_hand[np.isfinite(speed_px_s[at_hand])]
    slowest_first = known[np.argsort(speed_px_s[known], kind="stable")]
    shares = np.concatenate(
        [
            np.linspace(0, _LIMITS.slow_share, _LIMITS.slow_frames),
            np.linspace(1 - _LIMITS.fast_share, 1, _LIMITS.fast_frames),
        ]
    )
    chosen = slowest_first[np.unique(np.rint(shares * max(len(known) - 1, 0)).astype(np.intp))] if len(known) else known
    motion, pinhole = _gyro_camera(recorded, timing), colmap_camera(camera)
    exposures_s = exposures_to_compare(float(np.median(np.diff(timing.t_s))))
    compared = []
    for frame in recorded.images([timing.names[i] for i in sorted(chosen.tolist())]):
        shutter = FrameShutter.of(timing, places[frame.name], width=camera.width, height=camera.height)
        one = compare_exposures(frame.grey, motion, pinhole, shutter, exposures_s)
        if one is not None:
            compared.append(one)
    return estimate_exposure(compared, exposures_s), float(np.nanmax(speed_px_s))


def _gyro_camera(recorded: Recorded, timing: FrameTiming) -> GyroCamera:
    assert recorded.imu is not None and isinstance(recorded.aligned, Alignment)
    return GyroCamera.from_timed(
        CameraTimedImu.from_recording(recorded.imu, recorded.aligned.settle_clock_rate(), timing.epoch_ns)
    )


def _predict_speed(recorded: Recorded, timing: FrameTiming, camera: CameraModel) -> Array:
    """(F,) px/s by which the camera's turning moves the image (90th percentile); NaN without gyroscope."""
    brief_s = _LIMITS.brief_s
    brief = replace(timing, exposure_s=np.full(len(timing.t_s), brief_s), t_s=timing.t_s - 0.5 * brief_s)
    predicted = predict_blur_px(
        _gyro_camera(recorded, timing), colmap_camera(camera), brief, width=camera.width, height=camera.height
    )
    return predicted.px / brief_s


def check_readout(recorded: Recorded) -> Iterator[Finding]:
    """A capture that does not say how its shutter runs, or otherwise than its images show."""
    if not recorded.is_capture or recorded.timing is None:
        return
    timing = recorded.timing
    if timing.readout_s is not None:
        yield from _compare_readout(recorded, timing)
        return
    try:
        readout = _estimate_readout(recorded)
    except NotObservableError as error:
        yield Finding(fact=Fact("readout-unknown", why=error.fact), severity="warning")
        return
    fact = Fact(
        "readout-unknown",
        readout_s=readout.readout_s,
        readout_sigma_s=readout.sigma_s,
        direction=readout.direction,
        pairs=readout.pairs,
    )
    yield Finding(fact=fact, severity="warning")


def _compare_readout(recorded: Recorded, timing: FrameTiming) -> Iterator[Finding]:
    """A declared readout against one that is estimated without it."""
    try:
        found = _estimate_readout(recorded)
    except NotObservableError:
        return
    fact = compare_readout(
        timing,
        found.readout_s,
        found.sigma_s,
        found.direction,
        least_s=_LIMITS.readout_s,
        sigmas=_LIMITS.readout_sigmas,
    )
    if fact is not None:
        yield Finding(fact=fact, severity="warning")


def _estimate_readout(recorded: Recorded) -> ReadoutEstimate:
    """Estimate the readout from tracked corners and the aligned gyroscope."""
    rotation, aligned, imu = recorded.rotation, recorded.aligned, recorded.imu
    if rotation is not None and not recorded.is_dense:
        raise NotObservableError("readout", Fact("readout-of-sparse-pictures"))
    if rotation is None or imu is None or not isinstance(aligned, Alignment):
        raise NotObservableError("readout", Fact("readout-without-gyroscope"))
    if recorded.stabilisation is not None and recorded.stabilisation.stabilised:
        raise NotObservableError("readout", Fact("readout-of-stabilised-video"))
    timed = CameraTimedImu.from_recording(imu, aligned.settle_clock_rate(), rotation.epoch_ns)
    return estimate_readout(rotation, GyroCamera.from_timed(timed))


def check_cut_from_video(recorded: Recorded) -> Iterator[Finding]:
    """Times and orientation of images against the video that they were cut from."""
    cut = recorded.in_video
    if cut is None:
        return
    if cut.doubtful:
        looked_for = cut.doubtful + len(cut.found_ns)
        yield Finding(fact=Fact("frames-not-in-video", pictures=cut.doubtful, looked_for=looked_for), severity="info")
    if cut.quarter_turns:
        yield Finding(
            fact=Fact("frames-turned", angle_deg=90 * cut.quarter_turns),
            severity="error" if _refers_to_rows(recorded) else "info",
        )
    elif cut.container_turn_deg % 360:
        yield Finding(fact=Fact("rotation-ignored", angle_deg=cut.container_turn_deg), severity="info")
    if len(cut.found_ns) < 3:
        return
    off_s = (cut.stated_ns - cut.found_ns) * 1e-9
    middle_s = float(np.median(off_s))
    wander_s = float(np.ptp(off_s))
    start_s = cut.video_start_ns * 1e-9
    if wander_s > _LIMITS.wander_s:
        yield Finding(fact=Fact("frame-times-counted", wander_s=wander_s), severity="error")
    elif abs(start_s) > _LIMITS.start_s and abs(middle_s + start_s) < _LIMITS.start_s:
        yield Finding(fact=Fact("container-start-ignored", start_s=start_s), severity="error")


def _refers_to_rows(recorded: Recorded) -> bool:
    """Whether anything is declared that images in another orientation would belie."""
    readout_s = None if recorded.timing is None else recorded.timing.readout_s
    prior = recorded.calibration
    calibrated = prior is not None and prior.rotation_sigma_rad < 1
    return bool(readout_s) or calibrated or recorded.camera is not None
