"""A recording's gyroscope with its camera and frame times, and the plan of what is done to its frames by it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.facts import Fact, with_sentences
from colmap_inertial.core.options import BlurRemover
from colmap_inertial.core.types import CameraImuCalibration, CameraModel, FrameTiming, ImuRecording
from colmap_inertial.imaging.gate import FrameDecision, RecordingVerdict
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.parallax import Parallax
from colmap_inertial.io.files import a_record_of_ours, read_json, structured, without_sentences, write_json


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
        Rotation, time offset with its clock rate, and gyroscope bias.
    camera
        Intrinsics.
    source
        Where the calibration comes from: ``"capture"``, ``"model"`` (a small one, made beforehand) or ``"pixels"``.
    notes
        What there is to say about it.
    sign_doubt
        Why the pixels do not show that the gyroscope has the right sign; ``None`` where they do.
    """

    imu: ImuRecording
    timing: FrameTiming
    calibration: CameraImuCalibration
    camera: CameraModel
    source: str
    notes: tuple[Fact, ...] = ()
    sign_doubt: Fact | None = None

    def timed(self) -> CameraTimedImu:
        """The recording on the camera's clock."""
        return CameraTimedImu.from_recording(self.imu, self.calibration, self.timing.epoch_ns)

    def motion(self) -> GyroCamera:
        """The gyroscope on the camera's clock."""
        return GyroCamera.from_timed(self.timed())

    def shutter(self, index: int) -> FrameShutter:
        """Exposure of the lines of one frame."""
        return FrameShutter.of(self.timing, index, width=self.camera.width, height=self.camera.height)

    def index(self) -> dict[str, int]:
        """The place of each frame name."""
        return {name: i for i, name in enumerate(self.timing.names)}


@dataclass(frozen=True, eq=False, kw_only=True)
class ImagingPlan:
    """Treatment of frames and keypoints, with its reasons.

    Attributes
    ----------
    view
        Gyroscope, camera and times; ``None`` where nothing is to be done.
    deblur
        Decisions and verdict for :class:`DeblurStage`; ``None`` where no frame is to be deblurred.
    method
        How blur is undone.
    parallaxes
        By frame name, where the camera's translation is known to blur.
    rectify
        Whether the rolling shutter is undone.
    deblur_note, rolling_shutter_note
        What is done, or why not; ``None`` where nothing was planned.
    """

    view: GyroView | None = None
    deblur: tuple[tuple[FrameDecision, ...], RecordingVerdict] | None = None
    method: BlurRemover = "wiener"
    parallaxes: Mapping[str, Parallax] = field(default_factory=dict)
    rectify: bool = False
    deblur_note: Fact | None = None
    rolling_shutter_note: Fact | None = None

    def as_json(self) -> dict[str, object]:
        """As JSON types, without the recording."""
        view = self.view
        return {
            **note_as_json("deblur", self.deblur_note),
            "deblur_method": None if self.deblur is None else self.method,
            **note_as_json("rolling_shutter", self.rolling_shutter_note),
            "rectify": self.rectify,
            "calibration": None
            if view is None
            else {
                **asdict(view.calibration),
                "source": view.source,
                **with_sentences({"notes": list(view.notes)}),
            },
            **with_sentences({"sign_doubt": None if view is None else view.sign_doubt}),
            "camera": None if view is None else asdict(view.camera),
            "verdict": None if self.deblur is None else with_sentences(vars(self.deblur[1])),
            "decisions": None if self.deblur is None else [with_sentences(vars(d)) for d in self.deblur[0]],
            "parallaxes": {name: parallax.as_json() for name, parallax in self.parallaxes.items()},
        }


def note_as_json(key: str, note: Fact | None) -> dict[str, object]:
    """A note under its key, with its code and values beside it; empty where there is none."""
    return with_sentences({key: "" if note is None else note})


def write_plan(path: Path, plan: ImagingPlan) -> None:
    """Write a plan for :func:`read_plan`."""
    write_json(path, plan.as_json(), indent=None)


def read_plan(path: Path, imu: ImuRecording, timing: FrameTiming) -> ImagingPlan:
    """The plan that :func:`write_plan` wrote for the same recording."""
    values: dict[str, Any] = without_sentences(read_json(path))
    with a_record_of_ours(path):
        view = None
        if values["calibration"] is not None:
            calibration = dict(values["calibration"])
            camera = values["camera"]
            view = GyroView(
                imu=imu,
                timing=timing,
                source=calibration.pop("source"),
                notes=structured(tuple[Fact, ...], calibration.pop("notes")),
                sign_doubt=_read_note(values["sign_doubt"]),
                calibration=CameraImuCalibration(**calibration),
                camera=CameraModel(**{**camera, "params": tuple(camera["params"])}),
            )
        deblur = None
        if values["decisions"] is not None:
            decisions = structured(tuple[FrameDecision, ...], values["decisions"])
            deblur = decisions, structured(RecordingVerdict, values["verdict"])
        return ImagingPlan(
            view=view,
            deblur=deblur,
            method=values["deblur_method"] or "wiener",
            parallaxes={name: Parallax.from_json(parallax) for name, parallax in values["parallaxes"].items()},
            rectify=values["rectify"],
            deblur_note=_read_note(values["deblur"]),
            rolling_shutter_note=_read_note(values["rolling_shutter"]),
        )


def _read_note(value: Any) -> Fact | None:
    return structured(Fact, value) if value else None
