"""A recording's gyroscope with its camera and frame times, and the plan of what is done to its frames by it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.options import BlurRemover
from colmap_inertial.core.types import CameraImuCalibration, CameraModel, FrameTiming, ImuRecording
from colmap_inertial.imaging.gate import FrameDecision, RecordingVerdict
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.parallax import Parallax
from colmap_inertial.io.files import read_json, write_json
from colmap_inertial.pipeline.run.workspace import a_record_of_ours


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
        What there is to say about it, in words.
    sign_doubt
        Why the pixels do not show that the gyroscope has the right sign; empty where they do.
    """

    imu: ImuRecording
    timing: FrameTiming
    calibration: CameraImuCalibration
    camera: CameraModel
    source: str
    notes: tuple[str, ...] = ()
    sign_doubt: str = ""

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
        What is done, or why not, in words.
    """

    view: GyroView | None = None
    deblur: tuple[tuple[FrameDecision, ...], RecordingVerdict] | None = None
    method: BlurRemover = "wiener"
    parallaxes: Mapping[str, Parallax] = field(default_factory=dict)
    rectify: bool = False
    deblur_note: str = ""
    rolling_shutter_note: str = ""

    def as_json(self) -> dict[str, object]:
        """As JSON types, without the recording."""
        view = self.view
        return {
            "deblur": self.deblur_note,
            "deblur_method": None if self.deblur is None else self.method,
            "rolling_shutter": self.rolling_shutter_note,
            "rectify": self.rectify,
            "calibration": None
            if view is None
            else {
                **asdict(view.calibration),
                "source": view.source,
                "notes": list(view.notes),
            },
            "sign_doubt": None if view is None else view.sign_doubt,
            "camera": None if view is None else asdict(view.camera),
            "verdict": None if self.deblur is None else asdict(self.deblur[1]),
            "decisions": None if self.deblur is None else [asdict(decision) for decision in self.deblur[0]],
            "parallaxes": {name: parallax.as_json() for name, parallax in self.parallaxes.items()},
        }


def write_plan(path: Path, plan: ImagingPlan) -> None:
    """Write a plan for :func:`read_plan`."""
    write_json(path, plan.as_json(), indent=None)


def read_plan(path: Path, imu: ImuRecording, timing: FrameTiming) -> ImagingPlan:
    """The plan that :func:`write_plan` wrote for the same recording."""
    values: dict[str, Any] = read_json(path)
    with a_record_of_ours(path):
        view = None
        if values["calibration"] is not None:
            calibration = dict(values["calibration"])
            camera = values["camera"]
            view = GyroView(
                imu=imu,
                timing=timing,
                source=calibration.pop("source"),
                notes=tuple(calibration.pop("notes")),
                sign_doubt=values["sign_doubt"],
                calibration=CameraImuCalibration(**calibration),
                camera=CameraModel(**{**camera, "params": tuple(camera["params"])}),
            )
        deblur = None
        if values["decisions"] is not None:
            decisions = tuple(FrameDecision(**decision) for decision in values["decisions"])
            deblur = decisions, RecordingVerdict(**values["verdict"])
        return ImagingPlan(
            view=view,
            deblur=deblur,
            method=values["deblur_method"] or "wiener",
            parallaxes={name: Parallax.from_json(parallax) for name, parallax in values["parallaxes"].items()},
            rectify=values["rectify"],
            deblur_note=values["deblur"],
            rolling_shutter_note=values["rolling_shutter"],
        )
