"""The default stages that treat frames by the gyroscope: deblurring, and keypoints without the rolling shutter."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, get_args

import numpy as np

from colmap_inertial.align import on_camera_rate
from colmap_inertial.errors import NotObservableError
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.gate import FrameDecision, GateOptions, RecordingVerdict, deblur_gated
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.parallax import Parallax
from colmap_inertial.imaging.psf import blur_field
from colmap_inertial.imaging.restoration import deepgyro, load_network, require_network
from colmap_inertial.imaging.restoration.shipped import checksum
from colmap_inertial.imaging.rolling_shutter import rectify_keypoints
from colmap_inertial.imaging.wiener import LONGEST_PX, DeblurOptions, deblur
from colmap_inertial.io.calibration import SMALLEST_READOUT_S
from colmap_inertial.model import colmap_camera
from colmap_inertial.options import BlurRemover, DeblurMethod
from colmap_inertial.pipeline.frames import FrameTreatment
from colmap_inertial.threads import frames_at_once, in_order, threads_beside
from colmap_inertial.types import (
    CALIBRATION_PARAMETERS,
    Array,
    CameraImuCalibration,
    CameraModel,
    Frame,
    FrameTiming,
    ImuRecording,
    Projector,
)

#: Share of the readout that acts on poses after rectification.
_LEFT_SHARE = 0.1
_READOUT = CALIBRATION_PARAMETERS.index("readout_s")


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
class GyroView:
    """A recording's gyroscope, camera and frame times, brought together.

    Attributes
    ----------
    imu
        The recording, as it was read.
    timing
        Of all frames.
    calibration
        Rotation, time offset and gyroscope bias.
    clock_rate, clock_middle_s
        Change of the time offset per second, and the camera time at which it holds.
    camera
        Intrinsics.
    source
        Where the calibration comes from: ``"capture"``, ``"model"`` (a small one, made beforehand) or ``"pixels"``.
    notes
        What there is to say about it, in words.
    """

    imu: ImuRecording
    timing: FrameTiming
    calibration: CameraImuCalibration
    clock_rate: float = 0.0
    clock_middle_s: float = 0.0
    camera: CameraModel
    source: str
    notes: tuple[str, ...] = ()

    def recording(self) -> ImuRecording:
        """The recording on a clock that runs as the camera's does; one offset holds for all of it."""
        if self.clock_rate == 0:
            return self.imu
        return on_camera_rate(
            self.imu,
            self.calibration,
            clock_rate=self.clock_rate,
            middle_s=self.clock_middle_s,
            trajectory_epoch_ns=self.timing.epoch_ns,
        )

    def motion(self) -> GyroCamera:
        """The gyroscope on the camera's clock."""
        return GyroCamera.of(self.recording(), self.calibration, camera_epoch_ns=self.timing.epoch_ns)

    def shutter(self, index: int) -> FrameShutter:
        """When the lines of one frame are exposed."""
        return FrameShutter.of(self.timing, index, width=self.camera.width, height=self.camera.height)

    def index(self) -> dict[str, int]:
        """The place of each frame name."""
        return {name: i for i, name in enumerate(self.timing.names)}


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


@dataclass(frozen=True, eq=False, kw_only=True)
class RollingShutterStage:
    """The keypoint stage that moves keypoints to where a global shutter would have seen them.

    The instant is the one that poses hold, mid-exposure of the middle row. Keypoints of frames that the gyroscope does
    not cover stay in place.

    Attributes
    ----------
    view
        Gyroscope, camera and times.
    """

    view: GyroView
    _ready: dict[str, tuple[GyroCamera, Projector, dict[str, int]]] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )

    def __call__(self, name: str, keypoints_px: Array, /) -> Array:
        """Move the keypoints of one image."""
        if not self.covers(name):
            return keypoints_px
        motion, camera, index = self._parts()
        shutter = self.view.shutter(index[name])
        return np.asarray(rectify_keypoints(keypoints_px, motion, camera, shutter), dtype=np.float64)

    def covers(self, name: str) -> bool:
        """Whether the gyroscope recorded the whole readout of a frame."""
        motion, _, index = self._parts()
        return self.view.shutter(index[name]).covered_by(motion, reference=True)

    def _parts(self) -> tuple[GyroCamera, Projector, dict[str, int]]:
        if "parts" not in self._ready:
            self._ready["parts"] = self.view.motion(), colmap_camera(self.view.camera), self.view.index()
        return self._ready["parts"]


def for_rectified(calibration: CameraImuCalibration) -> CameraImuCalibration:
    """The calibration of a camera whose keypoints were rectified: hardly any readout is left.

    Its standard deviation stands for what the camera's translation does within the readout, which stays.
    """
    cov = calibration.cov.copy()
    cov[_READOUT, :] = cov[:, _READOUT] = 0.0
    cov[_READOUT, _READOUT] = max(SMALLEST_READOUT_S, _LEFT_SHARE * calibration.readout_s) ** 2
    return replace(calibration, readout_s=0.0, cov=cov)


__all__ = ["DeblurStage", "GyroView", "RollingShutterStage", "for_rectified", "require_method"]
