"""The default frame stage that treats frames by the gyroscope: motion blur undone, or frames left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, get_args

import numpy as np

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import BlurRemover, DeblurMethod
from colmap_inertial.core.threads import frames_at_once, map_in_order, one_blas_thread, threads_beside
from colmap_inertial.core.types import Action, Frame, Projector, Treatment
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.gate import (
    GATE_LIMITS,
    Decision,
    FrameDecision,
    GateOptions,
    RecordingVerdict,
    judge_frame,
    keep_sharp,
)
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.parallax import Parallax
from colmap_inertial.imaging.path_filters import LONGEST_PX, DeblurOptions, half_quadratic, path_wiener
from colmap_inertial.imaging.psf import blur_field, blur_path
from colmap_inertial.imaging.restoration import deepgyro, load_network, require_network
from colmap_inertial.imaging.restoration.shipped import checksum
from colmap_inertial.model import colmap_camera
from colmap_inertial.run.stages.imaging_plan import GyroView, ImagingPlan
from colmap_inertial.run.stages.inputs import StageInputs


@dataclass(frozen=True, kw_only=True)
class SmoothingLimits:
    """Smoothing of deblurred frames for COLMAP."""

    #: Standard deviation of the Gaussian, in linear light, as a share of the blur's length, and at most: what a filter
    #: leaves of noise and ringing grows with the blur, and moves cameras; of short blur, it leaves detail that gives
    #: more points than smoothing does.
    share: float = 0.06
    most_px: float = 1.2
    #: A frame of which more than this share stays as it was is not smoothed.
    kept_share: float = 0.5


SMOOTHING = SmoothingLimits()


#: Standard deviations by which a frame must confirm the gyroscope by itself, where others do not. With 4, the filter
#: made some worse; the network, which sees whether the filter's result can be true, is worth using unless a frame
#: speaks against.
_CLEAR_SUPPORT: dict[BlurRemover, float] = {
    "wiener": GATE_LIMITS.clear_support,
    "path": GATE_LIMITS.clear_support,
    "deepgyro": 0.0,
}

#: Undoes the blur of an image along its path.
_Remover = Callable[[Any, BlurPath], Any]


def smoothing_for(blur_px: float, share: float = SMOOTHING.share, most_px: float = SMOOTHING.most_px) -> float:
    """Standard deviation (px) of the Gaussian by which COLMAP sees a frame smoothed that had so much blur."""
    return min(share * blur_px, most_px)


def require_method(method: DeblurMethod | None) -> None:
    """Say before any work where frames cannot be deblurred as they shall be.

    Raises
    ------
    MissingExtraError, FormatError
        Where a network is asked for, and what it runs in or its file is missing.
    """
    if method == "deepgyro":
        require_network("deepgyro")


@dataclass(frozen=True, eq=False, kw_only=True)
class DeblurStage:
    """The frame stage that undoes motion blur where gyroscope and image agree on it, and drops what is beyond help.

    Frames that it does not change pass as they are. Two or more are worked on at once; the order stays, and memory
    does not grow with their number.

    Attributes
    ----------
    view
        Gyroscope, camera and times.
    decisions
        What to do with each frame, by the gyroscope alone (``imaging.gate.decide``).
    verdict
        What some of the frames say about the gyroscope together (``imaging.gate.judge_recording``).
    parallaxes
        By frame name, where the camera's translation is known to blur.
    gate
        Thresholds.
    drop
        Whether frames that are too blurred are left out. Where not, they are deblurred as others are.
    method
        How blur is undone: along its path by a Wiener filter, or a half-quadratic one, or by the network DeepGyro.
    smoothing, most_smoothing_px
        Standard deviation of the Gaussian by which COLMAP sees deblurred frames smoothed, as a share of the blur's
        length, and at most.
    weights
        Checksum of the network; empty where there is none. It decides the frames as the options do.
    workers
        Frames in work at once; as many as the process has processors where absent, but at most four, or 32 million
        pixels in all where a filter undoes the blur.
    """

    view: GyroView
    decisions: tuple[FrameDecision, ...]
    verdict: RecordingVerdict
    parallaxes: Mapping[str, Parallax] = field(default_factory=dict)
    gate: GateOptions = field(default_factory=GateOptions)
    drop: bool = True
    method: BlurRemover = "wiener"
    smoothing: float = SMOOTHING.share
    most_smoothing_px: float = SMOOTHING.most_px
    weights: str = field(default="", init=False)
    workers: int | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if self.method not in get_args(BlurRemover):
            raise ValueError(f"method: {', '.join(get_args(BlurRemover))}, not {self.method}")
        if self.method == "deepgyro":
            object.__setattr__(self, "weights", checksum("deepgyro"))

    @classmethod
    def for_run(cls, inputs: StageInputs) -> DeblurStage | None:
        """The stage of a run, where the plan says that frames are deblurred."""
        return cls.of_plan(inputs.plan, drop=inputs.maps, smoothing=inputs.maps or inputs.matching)

    @classmethod
    def of_plan(cls, plan: ImagingPlan, *, drop: bool = True, smoothing: bool = True) -> DeblurStage | None:
        """The stage of a plan, optionally without dropping frames and without smoothing.

        Where frames must confirm the gyroscope by themselves, they must do so clearly for a filter; for the network
        it is enough that they do not speak against it.
        """
        if plan.view is None or plan.deblur is None:
            return None
        decisions, verdict = plan.deblur
        return cls(
            view=plan.view,
            decisions=decisions,
            verdict=verdict,
            parallaxes=plan.parallaxes,
            gate=GateOptions() if verdict.trusted else GateOptions(min_support=_CLEAR_SUPPORT[plan.method]),
            drop=drop,
            method=plan.method,
            smoothing=SMOOTHING.share if smoothing else 0.0,
            most_smoothing_px=SMOOTHING.most_px,
        )

    def __call__(self, frames: Iterator[Frame], /) -> Iterator[Frame]:
        """Deblur the frames, in order."""
        workers = self.workers or self._frames_at_once()
        remove = self._remover(workers)
        motion, camera, index = self.view.motion(), colmap_camera(self.view.camera), self.view.index()
        decision_of = {decision.name: decision for decision in self.decisions}

        def treat(frame: Frame) -> Frame:
            decision = decision_of.get(frame.name)
            if decision is None or frame.dropped:
                return frame
            return self._treated(frame, decision, motion, camera, self.view.shutter(index[frame.name]), remove)

        # of many small products of matrices, each in one thread
        with one_blas_thread():
            yield from map_in_order(treat, frames, workers=workers)

    def _frames_at_once(self) -> int:
        """Frames to work on at once; a network takes more memory than a filter."""
        camera = self.view.camera
        return frames_at_once(None if self.method == "deepgyro" else 1e-6 * camera.width * camera.height)

    def _remover(self, workers: int) -> _Remover:
        """Undoes the blur of one frame; ``workers`` call it at once."""
        if self.method == "deepgyro":
            network = load_network("deepgyro", threads=threads_beside(workers))
            return lambda image, path: deepgyro.deblur(image, path, network=network)
        restore = half_quadratic if self.method == "path" else path_wiener
        return lambda image, path: restore(image, path, DeblurOptions(threads=1))

    def _treated(
        self,
        frame: Frame,
        decision: FrameDecision,
        motion: GyroCamera,
        camera: Projector,
        shutter: FrameShutter,
        remove: _Remover,
    ) -> Frame:
        """The frame to continue with, and what was decided about it."""

        def said(
            reason: Fact, kept_share: float = 1.0, extent_factor: float = 1.0, action: Action = Action.NOTHING
        ) -> Frame:
            values = {"blur_px": decision.blur_px, "kept_share": kept_share, "extent_factor": extent_factor}
            done = Treatment(stage="deblur", reason=reason, action=action, values=values)
            return replace(frame, treatments=(*frame.treatments, done))

        if decision.action is Decision.KEEP:
            return said(decision.reason)
        if self.verdict.trusted is False:
            return said(self.verdict.reason)
        if decision.action is Decision.DROP and self.drop:
            return replace(said(decision.reason), dropped=bool(self.verdict.trusted))
        parallax = self.parallaxes.get(frame.name)
        try:
            blur = blur_field(motion, camera, shutter, parallax=parallax)
        except NotObservableError as error:
            return said(error.fact)
        if float(np.abs(blur.vector_px).max()) * 1.5 > LONGEST_PX:
            return said(Fact("blur-not-undone", blur_px=decision.blur_px))
        image: Any = frame.image  # either of two types of pixel, which the checker would keep apart
        path = blur_path(motion, camera, shutter, parallax=parallax)
        if self.view.sign_doubt is not None and path.departure_px() > GATE_LIMITS.straight_px:
            return said(Fact("curved-blur-in-doubt", doubt=self.view.sign_doubt))
        factor, reason = judge_frame(image, blur, self.verdict, self.gate, path)
        if factor is None:
            return said(reason)
        if factor != 1.0:
            blur = blur.times(factor)
            path = blur_path(motion, camera, shutter, parallax=parallax, extent_factor=factor)
        out, kept = keep_sharp(image, remove(image, path), blur)
        width_px = smoothing_for(factor * (decision.blur_px or 0.0), self.smoothing, self.most_smoothing_px)
        smoothing_px = width_px if kept < SMOOTHING.kept_share else 0.0
        return replace(said(reason, kept, factor, Action.DEBLURRED), image=out, smoothing_px=smoothing_px)
