"""Plan the treatment of a capture's frames before COLMAP reads them; decided once and stored."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.settings import NO_SETTINGS
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import InertialError, NotObservableError, fact_of
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import BlurRemover, DeblurMethod, ReconstructOptions, RollingShutterMethod
from colmap_inertial.core.progress import Progress
from colmap_inertial.core.types import CameraModel, FrameTiming
from colmap_inertial.imaging.gate import Decision, FrameDecision, GateOptions, decide
from colmap_inertial.imaging.parallax import Parallax
from colmap_inertial.imaging.psf import predict_blur_px
from colmap_inertial.imaging.restoration.shipped import checksum
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.exif import read_exposures_s
from colmap_inertial.io.files import path_in
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import colmap_camera
from colmap_inertial.run.preparation.blur_check import judge_frames
from colmap_inertial.run.preparation.calibrate import (
    estimate_preliminary_calibration,
    expect_calibration,
    survey,
    survey_parts,
)
from colmap_inertial.run.preparation.frame_reading import FullFrames, GreyFrames
from colmap_inertial.run.preparation.translation import (
    find_parallaxes,
    most_by_sliding_px,
    translating_segments,
)
from colmap_inertial.run.stages.deblur import DeblurStage
from colmap_inertial.run.stages.imaging_plan import GyroView, ImagingPlan, read_plan, write_plan
from colmap_inertial.run.steps.session import Session

if TYPE_CHECKING:
    import pycolmap


log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class PlanLimits:
    """Limits for frames that are considered for deblurring."""

    #: Blur below this cannot be told from the texture: where no frame has more, nothing is deblurred.
    telling_px: float = 4.0
    #: How often small models are made, at most, for more of the blurred frames.
    surveys: int = 4
    #: While a frame may have been taken: by how many standard deviations of the clocks' offset sooner or later, and
    #: how long a readout is at most that nobody declared.
    sure_sigmas: float = 4.0
    longest_readout_s: float = 0.04
    #: Frames by which the gyroscope is judged.
    judged_frames: int = 14


_LIMITS = PlanLimits()


def add_stated_exposures(capture: Capture, timing: FrameTiming) -> FrameTiming:
    """The timing with exposure times from the pictures' EXIF, where nothing else gives them."""
    source = capture.image_folder
    if timing.exposure_s is not None or source is None:
        return timing
    stated = read_exposures_s([path_in(source, name) for name in timing.names])
    return timing if stated is None else replace(timing, exposure_s=stated)


@dataclass(frozen=True, kw_only=True)
class Treatments:
    """Treatments of frames and keypoints.

    Attributes
    ----------
    deblur, rolling_shutter
        ``None`` does what the recording allows; what is asked for by name and not possible is an error.
    pairs
        Whether frames are fused of short and long exposures, and not deblurred.
    frames_by_others, keypoints_by_others
        Whether the default frame or keypoint stages do not run, so that nothing is to be decided for them.
    """

    deblur: DeblurMethod | None = None
    rolling_shutter: RollingShutterMethod | None = None
    pairs: bool = False
    frames_by_others: bool = False
    keypoints_by_others: bool = False

    def by_name(self, *, deblur: bool, rectify: bool) -> bool:
        """Whether one of these treatments was asked for by name: it is an error where it cannot be done."""
        named_deblur, named_rectify = self.deblur in get_args(BlurRemover), self.rolling_shutter == "rectify"
        return (named_deblur and deblur) or (named_rectify and rectify)


def ask_for_plan(
    options: ReconstructOptions, frame_stages: Sequence[object], keypoint_stages: Sequence[object], *, pairs: bool
) -> Treatments:
    """Treatments that the options ask for, as far as the default stages do them."""
    return Treatments(
        deblur=options.deblur,
        rolling_shutter=options.rolling_shutter,
        pairs=pairs,
        frames_by_others=... not in frame_stages,
        keypoints_by_others=... not in keypoint_stages,
    )


def expect_plan(frames: GreyFrames, recording: Recording, asked: Treatments) -> None:
    """Have frames kept that pass before they are looked at for a plan, where it may look at some."""
    deblurs = asked.deblur != "off" and recording.timing.exposure_s is not None and not asked.frames_by_others
    if deblurs or asked.pairs or _no_rectifying(recording, asked) is None:
        expect_calibration(frames, recording)


def run_plan(
    session: Session, recording: Recording, grey: GreyFrames, full: FullFrames, asked: Treatments
) -> ImagingPlan:
    """Plan the treatment of frames and keypoints; nothing is looked at where nothing is asked for."""

    # the user's settings are for the whole capture, not for small models of parts of it
    plain = replace(session.context, features="sift", colmap=NO_SETTINGS)

    def work(partial: Sequence[Path]) -> None:
        write_plan(partial[0], plan_imaging(recording, grey, full, plain, asked))

    depends = {
        **recording.identity(),
        **session.context.identity(),
        "asked": asked,
        "weights": checksum("deepgyro") if asked.deblur == "deepgyro" else "",
    }
    imaging = session.workspace.imaging
    session.runner.run("imaging", depends, [imaging], work)
    plan = read_plan(imaging, recording.imu, recording.timing)
    log.info("deblurring: %s", plan.deblur_note)
    log.info("rolling shutter: %s", plan.rolling_shutter_note)
    return plan


def plan_imaging(
    recording: Recording, grey: GreyFrames, full: FullFrames, context: RunContext, asked: Treatments
) -> ImagingPlan:
    """Decide what is done to frames and keypoints.

    Parameters
    ----------
    recording
        See :func:`add_stated_exposures`.
    grey, full
        All images of the capture, and those to use.
    context
        ``progress`` is called with ``"motion"``, ``"calibration"``, ``"survey"`` and ``"blur"``.
    asked
        What is to be done.

    Raises
    ------
    NotObservableError
        Where deblurring or rectifying was asked for by name, and the gyroscope does not belong to the pixels.
    InertialError
        Where rectifying was asked for and the readout is unknown.
    """
    capture, timing = recording.capture, recording.timing
    if asked.rolling_shutter == "rectify" and timing.readout_s is None:
        raise InertialError(Fact("readout-needed", path=str(capture.path)))
    why_not = _no_deblurring(recording, grey, asked, context.progress)
    no_rectifying = _no_rectifying(recording, asked)
    plan = ImagingPlan(
        method="wiener" if asked.deblur is None or asked.deblur == "off" else asked.deblur,
        rectify=no_rectifying is None,
        deblur_note=why_not,
        rolling_shutter_note=no_rectifying or _describe_rectification(capture, timing),
    )
    if why_not is not None and not plan.rectify and not asked.pairs:
        return plan
    no_gyro = _no_gyro_for_pairs(recording) if asked.pairs else None
    if not plan.rectify and no_gyro is not None:
        return replace(plan, deblur_note=Fact("exposures-aligned", no_gyro=no_gyro))
    try:
        calibration = estimate_preliminary_calibration(recording, grey, full, context)
    except NotObservableError as error:
        if asked.by_name(deblur=why_not is None, rectify=plan.rectify):
            raise
        why = fact_of(error)
        untreated = Fact("frames-untreated", why=why)
        return ImagingPlan(
            deblur_note=Fact("exposures-aligned", no_gyro=why) if asked.pairs else why_not or untreated,
            rolling_shutter_note=untreated if plan.rectify else plan.rolling_shutter_note,
        )
    plan = replace(plan, view=calibration.view)
    if asked.pairs:
        return replace(plan, deblur_note=Fact("exposures-aligned", no_gyro=no_gyro))
    if why_not is not None:
        return plan

    def models(names: Sequence[str], plan: ImagingPlan | None) -> tuple[pycolmap.Reconstruction, ...]:
        if plan is None and calibration.models:
            return calibration.models
        stage = None if plan is None else DeblurStage.of_plan(plan, drop=False)
        return survey(full, calibration.view, names, [] if stage is None else [stage], context)

    def sliding(parts: Sequence[Sequence[str]]) -> list[bool]:
        camera = calibration.view.camera
        return translating_segments(
            recording, grey, camera, parts, _limit_px(camera), context.progress, motion=calibration.view.motion()
        )

    return _deblurring(plan, calibration.view, full, models, sliding, context.progress)


def _no_rectifying(recording: Recording, asked: Treatments) -> Fact | None:
    """Why keypoints are not rectified; ``None`` where they are."""
    timing = recording.timing
    if asked.keypoints_by_others:
        return Fact("left-to-keypoint-stages")
    if asked.rolling_shutter == "off":
        return Fact("not-asked-for")
    if recording.capture.rig:
        return Fact("rig-not-rectified")
    if timing.readout_s is None:
        return Fact("rectifying-without-readout")
    return None if timing.readout_s else Fact("global-shutter")


def _describe_rectification(capture: Capture, timing: FrameTiming) -> Fact:
    return Fact("keypoints-rectified", readout_s=timing.readout_s or 0.0, source=capture.readout_source or "")


def _limit_px(camera: CameraModel) -> float:
    """Blur of which a frame must have more to be looked at and treated, px of the image as it is."""
    return max(_LIMITS.telling_px, GateOptions().skip_below_px * max(camera.width, camera.height) / 1920)


def _no_deblurring(recording: Recording, grey: GreyFrames, asked: Treatments, progress: Progress) -> Fact | None:
    """Why no frame of a recording can be deblurred; ``None`` where some may be."""
    timing = recording.timing
    if asked.frames_by_others:
        return Fact("left-to-frame-stages")
    if asked.deblur == "off" or asked.pairs:
        return Fact("not-asked-for")
    if recording.capture.rig:
        return Fact("rig-not-deblurred")
    if timing.exposure_s is None:
        return Fact("no-exposures-to-deblur")
    camera = grey.guess_camera()
    most_px = _most_turned_rad(recording, timing.exposure_s) * 1.2 * colmap_camera(camera).mean_focal_length()
    limit_px = _limit_px(camera)
    if most_px >= limit_px:
        return None
    if most_by_sliding_px(timing, camera) < limit_px:
        return Fact("blur-nowhere", most_px=most_px, by_sliding=False)
    if any(translating_segments(recording, grey, camera, survey_parts(timing), limit_px, progress)):
        return None
    return Fact("blur-nowhere", most_px=most_px, by_sliding=True)


def _most_turned_rad(recording: Recording, exposure_s: Array) -> float:
    """Largest rotation of the camera during an exposure, over all times when the frame may have been exposed."""
    timing, prior = recording.timing, recording.prior
    timed = CameraTimedImu.from_recording(recording.imu, prior, timing.epoch_ns)
    rate_rad_s, stamps_s = np.linalg.norm(timed.imu.gyro_rad_s, axis=1), timed.gyro_t_s
    margin_s = _LIMITS.sure_sigmas * prior.clock_sigma_s
    longest_s = _LIMITS.longest_readout_s if timing.readout_s is None else timing.readout_s
    # a sample more on each side
    first = np.searchsorted(stamps_s, timing.t_s - margin_s) - 1
    last = np.searchsorted(stamps_s, timing.t_s + longest_s + exposure_s + margin_s, side="right") + 1
    within = [
        rate_rad_s[a:b].max() if a >= 0 and b <= len(rate_rad_s) else rate_rad_s.max()
        for a, b in zip(first.tolist(), last.tolist(), strict=True)
    ]
    return float(np.max(np.array(within) * exposure_s))


def _no_gyro_for_pairs(recording: Recording) -> Fact | None:
    """Why a gyroscope cannot align pairs of exposures; ``None`` where it may."""
    exposures, timing = recording.capture.exposures, recording.timing
    if timing.exposure_s is None:
        return Fact("short-exposure-unknown")
    if exposures is None or exposures.timing(timing) is None:
        return Fact("long-exposure-unknown")
    return None


def _deblurring(
    plan: ImagingPlan,
    view: GyroView,
    frames: FullFrames,
    models: Callable[[Sequence[str], ImagingPlan | None], tuple[pycolmap.Reconstruction, ...]],
    sliding: Callable[[Sequence[Sequence[str]]], Sequence[bool]],
    progress: Progress,
) -> ImagingPlan:
    """The plan with what is to be deblurred, by the gyroscope and by what small models tell of the translation.

    ``models`` makes them of some frames as filmed, or as a plan has them. Where frames were too blurred for a model,
    those around them, and the IMU beyond, tell how to deblur them for the next one. ``sliding`` says in which segments
    frames are blurred although the camera does not turn: of these small models are made, too.
    """
    decisions = _decisions(view, {})
    segments = survey_parts(view.timing)
    turning = set(_group_by_segment(_select_blurred(decisions), segments, view)) if _blurred(decisions) else set()
    others = [i for i in range(len(segments)) if i not in turning]
    pending = turning.union(itertools.compress(others, sliding([segments[i] for i in others])))
    if not pending:
        return _decided(plan, view, frames, {}, progress)
    surveys: dict[int, _Surveyed] = {}
    treated = None
    for _ in range(_LIMITS.surveys):
        better = False
        for i in sorted(pending):
            new = _Surveyed.of(models(segments[i], treated), view)
            if i not in surveys or len(new.registered) > len(surveys[i].registered):
                surveys[i], better = new, True
        if not better:
            break
        parallaxes = _merge_parallaxes(surveys, segments, view)
        treated = _decided(plan, view, frames, parallaxes, progress)
        blurred = _group_by_segment(_select_blurred(_decisions(view, parallaxes)), segments, view)
        registered = {name for surveyed in surveys.values() for name in surveyed.registered}
        pending = {i for i, names in blurred.items() if names & set(segments[i]) - registered}
        if not parallaxes or not pending or treated.deblur is None:
            break
    assert treated is not None
    return treated


def _group_by_segment(names: Iterable[str], segments: Sequence[Sequence[str]], view: GyroView) -> dict[int, set[str]]:
    """Names of frames by the index of the segment whose time they lie in."""
    place, t_s = view.index(), view.timing.t_s
    begins_s = t_s[[place[segment[0]] for segment in segments]]
    out: dict[int, set[str]] = {}
    for name in names:
        out.setdefault(int(np.searchsorted(begins_s, t_s[place[name]], side="right")) - 1, set()).add(name)
    return out


def _merge_parallaxes(
    surveys: Mapping[int, _Surveyed], segments: Sequence[Sequence[str]], view: GyroView
) -> dict[str, Parallax]:
    """Parallaxes by frame name; of two segments that have one for a frame, its own goes first."""
    merged = {name: parallax for surveyed in surveys.values() for name, parallax in surveyed.parallaxes.items()}
    own = _group_by_segment(merged, segments, view)
    for i, surveyed in surveys.items():
        merged |= {name: surveyed.parallaxes[name] for name in own.get(i, ()) if name in surveyed.parallaxes}
    return merged


@dataclass(frozen=True, eq=False)
class _Surveyed:
    """Results of the small models of a part of a recording."""

    parallaxes: Mapping[str, Parallax]
    registered: frozenset[str]

    @classmethod
    def of(cls, models: Sequence[pycolmap.Reconstruction], view: GyroView) -> _Surveyed:
        registered = frozenset(model.image(i).name for model in models for i in model.reg_image_ids())
        return cls(parallaxes=find_parallaxes(models, view), registered=registered)


def _select_blurred(decisions: Sequence[FrameDecision]) -> set[str]:
    return {decision.name for decision in decisions if decision.action is Decision.DEBLUR}


def _decisions(view: GyroView, parallaxes: Mapping[str, Parallax]) -> tuple[FrameDecision, ...]:
    """Decision on each frame, before any is looked at."""
    width, height = view.camera.width, view.camera.height
    motion, camera = view.motion(), colmap_camera(view.camera)
    predicted = predict_blur_px(motion, camera, view.timing, width=width, height=height, parallaxes=parallaxes)
    return _keeping_ends(decide(predicted, view.timing.t_s, width=width, height=height, motion=motion))


def _blurred(decisions: Sequence[FrameDecision]) -> list[FrameDecision]:
    """The frames by which to judge, the most blurred first."""
    telling = [d for d in decisions if d.action is Decision.DEBLUR and (d.blur_px or 0) >= _LIMITS.telling_px]
    return sorted(telling, key=lambda d: -(d.blur_px or 0))[: _LIMITS.judged_frames]


def _decided(
    plan: ImagingPlan, view: GyroView, frames: FullFrames, parallaxes: Mapping[str, Parallax], progress: Progress
) -> ImagingPlan:
    decisions = _decisions(view, parallaxes)
    chosen = _blurred(decisions)
    if not chosen:
        known = [d.blur_px for d in decisions if d.blur_px is not None]
        return replace(plan, deblur_note=Fact("blur-predicted-nowhere", most_px=max(known) if known else None))
    verdict = judge_frames(view, frames, chosen, parallaxes, progress)
    used = {name: parallaxes[name] for name in sorted(_select_blurred(decisions)) if name in parallaxes}
    note = Fact(
        "frames-blurred",
        blurred=len(_select_blurred(decisions)),
        frames=len(decisions),
        verdict=verdict.reason,
        with_translation=len(used),
        sign_doubt=view.sign_doubt,
        method=None if verdict.trusted is False else plan.method,
    )
    return replace(plan, deblur=(decisions, verdict), parallaxes=used, deblur_note=note)


def _keeping_ends(decisions: tuple[FrameDecision, ...]) -> tuple[FrameDecision, ...]:
    """No frame is dropped before the first or after the last one that stays: nothing would bridge the gap."""
    stay = [i for i, decision in enumerate(decisions) if decision.action is not Decision.DROP]
    first, last = (stay[0], stay[-1]) if stay else (len(decisions), -1)
    return tuple(
        replace(d, action=Decision.DEBLUR, reason=Fact("blur-at-end", blur_px=d.blur_px))
        if d.action is Decision.DROP and not first < i < last
        else d
        for i, d in enumerate(decisions)
    )
