"""The default frame stage that treats frames by the gyroscope: motion blur undone, or frames left out."""

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
from colmap_inertial.imaging.wiener import LONGEST_PX, DeblurOptions, deblur
from colmap_inertial.model import colmap_camera
from colmap_inertial.options import BlurRemover, DeblurMethod
from colmap_inertial.restoration import deepgyro, load_network, require_network
from colmap_inertial.restoration.shipped import checksum
from colmap_inertial.stages.gyro_view import GyroView
from colmap_inertial.threads import frames_at_once, in_order, threads_beside
from colmap_inertial.types import (
    Frame,
    Projector,
    Treatment,
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

        def treat(frame: Frame) -> Frame:
            decision = decision_of.get(frame.name)
            if decision is None or frame.dropped:
                return frame
            return self._treated(frame, decision, motion, camera, self.view.shutter(index[frame.name]), remove)

        yield from in_order(treat, frames, workers=workers)

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
    ) -> Frame:
        """The frame to go on with, and what was decided about it."""

        def said(reason: str, kept_share: float = 1.0, extent_factor: float = 1.0, action: str = "") -> Frame:
            values = {"blur_px": decision.blur_px, "kept_share": kept_share, "extent_factor": extent_factor}
            done = Treatment(stage="deblur", reason=reason, action=action, values=values)
            return replace(frame, treatments=(*frame.treatments, done))

        if decision.action == "keep":
            return said(decision.reason)
        if self.verdict.trusted is False:
            return said(self.verdict.reason)
        if decision.action == "drop":
            return replace(said(decision.reason), dropped=bool(self.drop and self.verdict.trusted))
        try:
            blur = blur_field(motion, camera, shutter, parallax=self.parallaxes.get(frame.name))
        except NotObservableError as error:
            return said(error.hint)
        if float(np.abs(blur.vector_px).max()) * 1.5 > LONGEST_PX:
            return said(f"{decision.blur_px:.0f} px of blur are too long to be undone")
        image: Any = frame.image  # either of two types of pixel, which the checker would keep apart
        gated = deblur_gated(image, blur, recording=self.verdict, deblur=remove, options=self.gate)
        done = said(gated.reason, gated.kept_share, gated.extent_factor, "deblurred" if gated.deblurred else "")
        return replace(done, image=gated.image) if gated.deblurred else done
