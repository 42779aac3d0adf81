"""The default stages that treat frames by the gyroscope: deblurring, and keypoints without the rolling shutter."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, get_args

import numpy as np

from colmap_inertial.errors import NotObservableError
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.gate import FrameDecision, GateOptions, RecordingVerdict, deblur_gated
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.parallax import Parallax
from colmap_inertial.imaging.psf import blur_field
from colmap_inertial.imaging.restoration import deepgyro, load_network, require_network
from colmap_inertial.imaging.restoration.shipped import checksum
from colmap_inertial.imaging.wiener import LONGEST_PX, DeblurOptions, deblur
from colmap_inertial.model import colmap_camera
from colmap_inertial.options import BlurRemover, DeblurMethod
from colmap_inertial.stages.frame_folder import FrameTreatment
from colmap_inertial.stages.gyro_view import GyroView
from colmap_inertial.threads import frames_at_once, in_order, threads_beside
from colmap_inertial.types import (
    Frame,
    Projector,
)


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
        Whether frames that are too blurred are left out.
    method
        How blur is undone: by a Wiener filter along it, or by the network DeepGyro.
    weights
        Checksum of the network; empty where there is none. It decides the frames as the options do.
    workers
        Frames in work at once; as many as the process has processors, up to four, where absent.
    """

    view: GyroView
    decisions: tuple[FrameDecision, ...]
    verdict: RecordingVerdict
    parallaxes: Mapping[str, Parallax] = field(default_factory=dict)
    gate: GateOptions = field(default_factory=GateOptions)
    drop: bool = True
    method: BlurRemover = "wiener"
    weights: str = field(default="", init=False)
    workers: int | None = field(default=None, compare=False)
    _done: dict[str, FrameTreatment] = field(default_factory=dict, init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        if self.method not in get_args(BlurRemover):
            raise ValueError(f"method: wiener or deepgyro, not {self.method}")
        if self.method == "deepgyro":
            object.__setattr__(self, "weights", checksum("deepgyro"))

    def __call__(self, frames: Iterator[Frame], /) -> Iterator[Frame]:
        """Deblur the frames, in order."""
        workers = self.workers or frames_at_once()
        remove = self._remover(workers)
        motion, camera, index = self.view.motion(), colmap_camera(self.view.camera), self.view.index()
        decision_of = {decision.name: decision for decision in self.decisions}

        def treat(frame: Frame) -> tuple[str, Frame | None, FrameTreatment | None]:
            decision = decision_of.get(frame.name)
            if decision is None:
                return frame.name, frame, None
            shutter = self.view.shutter(index[frame.name])
            return frame.name, *self._treated(frame, decision, motion, camera, shutter, remove)

        for name, frame, treatment in in_order(treat, frames, workers=workers):
            if treatment is not None:
                self._done[name] = treatment
            if frame is not None:
                yield frame

    def treatment(self, name: str, /) -> FrameTreatment | None:
        """What was decided about a frame that went through."""
        return self._done.get(name)

    def _remover(self, workers: int) -> Callable[[Any, BlurField], Any]:
        """Undoes the blur of one frame; ``workers`` call it at once."""
        if self.method == "deepgyro":
            return partial(deepgyro.deblur, network=load_network("deepgyro", threads=threads_beside(workers)))
        return partial(deblur, options=DeblurOptions(threads=1))

    def _treated(
        self,
        frame: Frame,
        decision: FrameDecision,
        motion: GyroCamera,
        camera: Projector,
        shutter: FrameShutter,
        remove: Callable[[Any, BlurField], Any],
    ) -> tuple[Frame | None, FrameTreatment]:
        """The frame to go on with (``None`` drops it), and what to say about it."""
        said = FrameTreatment(reason=decision.reason, blur_px=decision.blur_px)
        if decision.action == "keep":
            return frame, said
        if self.verdict.trusted is False:
            return frame, replace(said, reason=self.verdict.reason)
        if decision.action == "drop":
            return (None if self.drop and self.verdict.trusted else frame), said
        try:
            blur = blur_field(motion, camera, shutter, parallax=self.parallaxes.get(frame.name))
        except NotObservableError as error:
            return frame, replace(said, reason=error.hint)
        if float(np.abs(blur.vector_px).max()) * 1.5 > LONGEST_PX:
            return frame, replace(said, reason=f"{decision.blur_px:.0f} px of blur are too long to be undone")
        image: Any = frame.image  # either of two types of pixel, which the checker would keep apart
        gated = deblur_gated(image, blur, recording=self.verdict, deblur=remove, options=self.gate)
        said = replace(
            said,
            reason=gated.reason,
            deblurred=gated.deblurred,
            kept_share=gated.kept_share,
            extent_factor=gated.extent_factor,
        )
        return (replace(frame, image=gated.image) if gated.deblurred else frame), said
