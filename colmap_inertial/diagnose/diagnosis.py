"""The values of a diagnosis: what was recorded, what was found in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Int64Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError
from colmap_inertial.core.facts import Fact, with_sentences
from colmap_inertial.core.sampling import time_unit_factor
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.core.types import (
    CameraImuCalibration,
    CameraModel,
    CameraTrajectory,
    FrameLog,
    FrameTiming,
    ImuRecording,
    RotationConsensus,
)
from colmap_inertial.diagnose.declared import Contradicted, compare_declared, leave_out
from colmap_inertial.io.calibration import reset_for_recording
from colmap_inertial.io.plausible import find_faults
from colmap_inertial.io.pose_convention import ARRAYS, PoseConvention
from colmap_inertial.motion.align import Alignment, AlignOptions, align_clocks, searched_around_s
from colmap_inertial.motion.align.consensus import NO_MAJORITY, align_by_consensus
from colmap_inertial.motion.align.conventions import LikelyConvention, likely_convention
from colmap_inertial.motion.flow import GreyFrame, Stabilisation, VisualRotation, find_stabilisation

Severity = Literal["info", "warning", "error"]
SEVERITIES: tuple[Severity, ...] = ("info", "warning", "error")
#: Codes of errors that stop nothing: readings that are missing or coarse, which the fit counts as what they are.
DOUBTS = frozenset({"short-gap", "long-gap", "saturated", "coarse-resolution"})


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that a recording has.

    Attributes
    ----------
    fact
        What was seen, and what to do.
    severity
        ``"error"`` makes a scale wrong or impossible, ``"warning"`` makes it worse, ``"info"`` is worth knowing.
    deviations_deg
        By image, how far its camera is turned against those around it; empty in findings about anything else.
    """

    fact: Fact
    severity: Severity
    deviations_deg: Mapping[str, float] = field(default_factory=dict)

    @property
    def code(self) -> str:
        """Stable name of what was found."""
        return self.fact.code

    @property
    def evidence(self) -> str:
        """What was seen, in a sentence."""
        return str(self.fact)

    @property
    def advice(self) -> str:
        """What to do."""
        return self.fact.advice

    @property
    def numbers(self) -> dict[str, float]:
        """The numbers of what was seen; units are in the names."""
        return {
            name: value
            for name, value in self.fact.values.items()
            if isinstance(value, int | float) and not isinstance(value, bool)
        }

    @property
    def reason(self) -> Fact:
        """The finding as a reason not to trust a scale: message, advice and code."""
        return Fact("found-beforehand", finding=self.fact)

    @property
    def sentence(self) -> str:
        """Message, advice and code."""
        return str(self.reason)

    def as_json(self) -> dict[str, object]:
        deviations = {"deviations_deg": dict(self.deviations_deg)} if self.deviations_deg else {}
        return {
            "code": self.code,
            "severity": self.severity,
            **with_sentences({"evidence": self.fact}),
            "numbers": self.numbers,
            "advice": self.advice,
            **deviations,
        }


@prints_in_lines
@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Everything that was found, worst first.

    Attributes
    ----------
    findings
        Empty where nothing is wrong.
    checked
        What there was to check.
    """

    findings: tuple[Finding, ...]
    checked: tuple[str, ...] = ()

    @property
    def worst(self) -> Severity | None:
        return self.findings[0].severity if self.findings else None

    @property
    def stopping(self) -> tuple[Finding, ...]:
        """Those that stop a reconstruction: errors that make a scale wrong or impossible."""
        return tuple(one for one in self.findings if one.severity == "error" and one.code not in DOUBTS)

    @property
    def doubting(self) -> tuple[Finding, ...]:
        """Errors that a scale can be given with, weak at most: what they take from it is in its interval."""
        return tuple(one for one in self.findings if one.severity == "error" and one.code in DOUBTS)

    @property
    def codes(self) -> frozenset[str]:
        return frozenset(finding.code for finding in self.findings)

    def as_json(self) -> dict[str, object]:
        """Plain values; ``version`` counts changes of this layout."""
        return {
            "version": 1,
            "worst": self.worst,
            "checked": list(self.checked),
            "findings": [finding.as_json() for finding in self.findings],
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class FramesInVideo:
    """Places of images in the video that they were taken from.

    Attributes
    ----------
    stated_ns, found_ns
        (K,) times that the images have, and presentation stamps of the video's frames that they are.
    video_start_ns
        Presentation stamp of the video's first frame.
    quarter_turns
        How often the images are turned by 90 degrees against the frames as stored.
    container_turn_deg
        The turn that the video's container asks players for.
    doubtful
        Images that could not be found, or are of several frames.
    """

    stated_ns: Int64Array
    found_ns: Int64Array
    video_start_ns: int
    quarter_turns: int
    container_turn_deg: int
    doubtful: int


@dataclass(frozen=True, kw_only=True)
class Clocks:
    """Durations and rates of frames and gyroscope by their own stamps."""

    frames_s: float
    frame_hz: float
    imu_s: float
    imu_hz: float

    @property
    def fact(self) -> Fact:
        """Spans and rates, as a message has them."""
        return Fact("spans-and-rates", **asdict(self))

    def __str__(self) -> str:
        return str(self.fact)

    @property
    def unit_factor(self) -> float | None:
        """Power of 1000 by which the frames' span is too long (or short) for the gyroscope's; ``None`` for none."""
        return time_unit_factor(self.frames_s, self.imu_s)


@dataclass(frozen=True, eq=False, kw_only=True)
class Recorded:
    """The data of a recording. Each check uses the parts it needs and reports nothing where they are missing.

    Attributes
    ----------
    refused
        What could not be read, and why.
    imu
        Before any check of plausibility.
    timing, log
        Of the frames.
    is_capture
        Whether the frames are those of a capture, which can be described better; poses alone cannot.
    rotation
        Between consecutive frames, by their pixels.
    looked_at, blank
        How many images were looked at, and the names of those without any feature.
    trajectory, read_as
        Poses of a reconstruction; the convention that they were read by.
    camera
        Intrinsics, as declared.
    calibration, max_offset_s
        What is known of camera and IMU, and the largest offset between their clocks.
    in_video
        Where images were found in the video they were taken from.
    images
        Frames in grey and in full by their names, in order of time; ``None`` where there are none.
    in_full
        Names of those that it has without another decode of a video, in order of time.
    """

    refused: Sequence[InertialError] = ()
    imu: ImuRecording | None = None
    timing: FrameTiming | None = None
    log: FrameLog | None = None
    is_capture: bool = False
    rotation: VisualRotation | None = None
    looked_at: int = 0
    blank: Sequence[str] = ()
    trajectory: CameraTrajectory | None = None
    read_as: PoseConvention = ARRAYS
    camera: CameraModel | None = None
    calibration: CameraImuCalibration | None = None
    max_offset_s: float | None = None
    in_video: FramesInVideo | None = None
    images: Callable[[Sequence[str]], Iterable[GreyFrame]] | None = None
    in_full: Sequence[str] = ()

    @cached_property
    def implausible(self) -> tuple[FormatError, ...]:
        """Reasons why a reader would refuse the inertial samples."""
        return () if self.imu is None else tuple(find_faults(self.imu))

    @property
    def is_dense(self) -> bool:
        """Whether images were followed closely enough that what is quick shows in them."""
        return self.rotation is not None and len(self.rotation.t_s) > 1 and self.rotation.step_s <= FOLLOWED_S

    @cached_property
    def contradicted(self) -> Contradicted:
        """The declared rotation and time offset against an alignment without them; nothing where that is not possible.

        Images alone tell them worse.
        """
        prior, imu = self.calibration, self.imu
        if prior is None or imu is None or (self.trajectory is None and self.rotation is None):
            return Contradicted()
        opened = leave_out(prior)
        if opened is prior:
            return Contradicted()
        try:
            if self.trajectory is not None:
                options = AlignOptions(max_offset_s=self.max_offset_s)
                found = align_by_consensus(self.trajectory, imu, prior=opened, options=options)[0]
            else:
                assert self.rotation is not None
                options = AlignOptions(max_offset_s=self.max_offset_s, min_explained=PIXELS_EXPLAINED)
                found = align_clocks(self.rotation.trajectory(), imu, prior=opened, options=options)
        except NotObservableError:
            return Contradicted()
        return compare_declared(prior, found.calibration, by_poses=self.trajectory is not None)

    @cached_property
    def believed(self) -> CameraImuCalibration | None:
        """What is known of camera and IMU beforehand, without what the recording contradicts."""
        wrong = self.contradicted
        if self.calibration is None or not wrong.facts:
            return self.calibration
        return leave_out(
            self.calibration, rotation=wrong.rotation is not None, time_offset=wrong.time_offset is not None
        )

    @cached_property
    def together(self) -> Alignment | NotObservableError | None:
        """All cameras of a reconstruction and the IMU brought together; ``None`` where either is missing."""
        if self.imu is None or self.trajectory is None:
            return None
        return self._align(self.trajectory, self.imu, self.believed, self.max_offset_s)

    @cached_property
    def consensus(self) -> RotationConsensus | NotObservableError | None:
        """Agreement of a reconstruction's cameras with the gyroscope; ``None`` where either is missing."""
        if self.imu is None or self.trajectory is None:
            return None
        if self._too_long is not None:
            return self._too_long
        options = AlignOptions(max_offset_s=self.max_offset_s)
        try:
            return align_by_consensus(
                self.trajectory, self.imu, prior=self.believed, options=options, together=self.together
            )[1]
        except NotObservableError as error:
            return error

    @property
    def lacks_majority(self) -> bool:
        """Whether it is open which cameras of a reconstruction are right."""
        return isinstance(self.consensus, NotObservableError) and self.consensus.code in NO_MAJORITY

    @cached_property
    def turning(self) -> CameraTrajectory | None:
        """The camera's rotation: of the reconstruction, else of the pixels.

        Where its cameras cannot be aligned all together, of those that agree with the gyroscope.
        """
        consensus, imu, poses = self.consensus, self.imu, self.trajectory
        if (
            imu is not None
            and poses is not None
            and isinstance(consensus, RotationConsensus)
            and not consensus.kept.all()
        ):
            return poses if isinstance(self.together, Alignment) else poses.select(consensus.kept)
        if self.trajectory is not None or self.rotation is None:
            return self.trajectory
        try:
            return self.rotation.trajectory()
        except NotObservableError:
            return None

    @cached_property
    def aligned(self) -> Alignment | NotObservableError | None:
        """Camera and IMU brought together; ``None`` where one of them is missing."""
        if self.imu is None:
            return None
        return self.together if self.turning is self.trajectory is not None else self.align(self.imu)

    @property
    def is_offset_limited(self) -> bool:
        """Whether less than every offset of the clocks is searched."""
        known = self.believed is not None and bool(np.isfinite(searched_around_s(self.believed)))
        return known or self.max_offset_s is not None

    @cached_property
    def stabilisation(self) -> Stabilisation | None:
        """Signs of stabilisation in the images; ``None`` without images."""
        if self.rotation is None or self.imu is None:
            return None
        return find_stabilisation(self.rotation, self.imu, offset_s=self.offset_s(self.rotation.epoch_ns))

    @cached_property
    def wrong_unit(self) -> str | None:
        """The code of the unit in which the gyroscope would turn as the camera does; ``None`` where none is needed."""
        if self.imu is None or not isinstance(self.aligned, NotObservableError):
            return None
        for code, factor in UNIT_FACTORS.items():
            if isinstance(self.align(replace(self.imu, gyro_rad_s=factor * self.imu.gyro_rad_s)), Alignment):
                return code
        return None

    @cached_property
    def clocks(self) -> Clocks | None:
        """Spans and rates of frames and gyroscope; ``None`` where one of them is missing."""
        frames = self.timing or self.trajectory
        if self.imu is None or frames is None or len(frames.t_s) < 3:
            return None
        return Clocks(
            frames_s=float(np.ptp(frames.t_s)),
            frame_hz=float(1 / np.median(np.diff(frames.t_s))),
            imu_s=float(np.ptp(self.imu.gyro_t_s)),
            imu_hz=float(1 / np.median(np.diff(self.imu.gyro_t_s))),
        )

    @cached_property
    def likely_convention(self) -> LikelyConvention | None:
        """The other convention under which the poses fit the IMU; ``None`` where they fit as read, or under none."""
        if self.imu is None or self.trajectory is None or self.turning is None:
            return None
        options = AlignOptions(max_offset_s=self.max_offset_s)
        return likely_convention(self.turning, self.imu, read_as=self.read_as, prior=self.believed, options=options)

    def offset_s(self, camera_epoch_ns: int) -> float | None:
        """Camera time since that epoch = gyroscope time since its own + this; ``None`` where it was not found."""
        if self.imu is None or not isinstance(self.aligned, Alignment):
            return None
        timed = CameraTimedImu(imu=self.imu, calibration=self.aligned.calibration, camera_epoch_ns=camera_epoch_ns)
        return timed.gyro_offset_s

    def align(self, imu: ImuRecording, *, any_offset: bool = False) -> Alignment | NotObservableError | None:
        """The same with another reading of the gyroscope, or at any offset of the clocks."""
        if self.turning is None:
            return None
        prior = self.believed
        if any_offset and prior is not None:
            prior = reset_for_recording(prior)
        return self._align(self.turning, imu, prior, None if any_offset else self.max_offset_s)

    @property
    def _too_long(self) -> NotObservableError | None:
        """Why no offset is searched: there are hours of them, for frames that mostly have no gyroscope beside them."""
        if self.clocks is None or (self.clocks.unit_factor or 0) <= 1:
            return None
        return NotObservableError("time offset", self.clocks.fact)

    def _align(
        self,
        turning: CameraTrajectory,
        imu: ImuRecording,
        prior: CameraImuCalibration | None,
        max_offset_s: float | None,
    ) -> Alignment | NotObservableError:
        if self._too_long is not None:
            return self._too_long
        options = AlignOptions(max_offset_s=max_offset_s)
        if self.trajectory is None:
            # the camera's translation is in the pixels' motion, and no gyroscope explains it
            options = replace(options, min_explained=PIXELS_EXPLAINED)
        try:
            return align_clocks(turning, imu, prior=prior, options=options)
        except NotObservableError as error:
            return error


#: What a gyroscope must explain of the rotation that pixels show, where no reconstruction tells it from translation.
PIXELS_EXPLAINED = 0.5
#: Numbers of a gyroscope times this are rad/s, where they were in the other unit than they were declared in.
UNIT_FACTORS = {"gyro-in-deg": np.pi / 180, "gyro-not-in-deg": 180 / np.pi}
#: Images closer together than this (median) are followed; those further apart are compared two by two.
FOLLOWED_S = 0.15
