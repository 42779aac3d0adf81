"""Inputs of the default stages of a run, and the network that fuses pairs of exposures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from colmap_inertial.core.arrays import Float32Array
from colmap_inertial.core.options import ExposureOptions, ReconstructOptions
from colmap_inertial.core.threads import frames_at_once, threads_beside
from colmap_inertial.hooks import KeypointStage
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.exposure_pairs import replace_departures
from colmap_inertial.imaging.restoration import load_network, lsd2, shipped
from colmap_inertial.io.recording import Recording
from colmap_inertial.run.stages.capture_sensors import CaptureSensors
from colmap_inertial.run.stages.imaging_plan import ImagingPlan

#: Makes one image of a short exposure as bright as the long one, the long one in its geometry, and the long one's
#: blur: all float32 sRGB 0 to 1, of one shape.
Fuse = Callable[[Float32Array, Float32Array, BlurField | None], Float32Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class Fuser:
    """Function that fuses two images into one.

    Attributes
    ----------
    fuse
        Does it, in any number of threads at once.
    identity
        What decides its result: pairs are fused again where it changes.
    """

    fuse: Fuse = field(compare=False)
    identity: str


def lsd2_fuser(options: ExposureOptions | None = None) -> Fuser:
    """The network that comes with the package, and the short exposure where its result departs too far from it.

    Raises
    ------
    MissingExtraError, FormatError, InertialError
        As ``restoration.load_network``.
    """
    options = options or ExposureOptions()
    network = load_network("lsd2", device=options.device, threads=threads_beside(frames_at_once()))

    def fuse(short: Float32Array, long: Float32Array, blur: BlurField | None) -> Float32Array:
        return replace_departures(lsd2.fuse(short, long, blur=blur, network=network), short)

    return Fuser(fuse=fuse, identity=f"lsd2 {shipped.checksum('lsd2')}, short where departing")


@dataclass(frozen=True, eq=False, kw_only=True)
class StageInputs:
    """Inputs of the default stages of a run.

    Attributes
    ----------
    recording
        Capture, IMU, times of the frames, and what is known of the calibration beforehand.
    options
        Of the run.
    plan
        What was decided of frames and keypoints.
    fuser
        What makes one frame of a pair of exposures; ``None`` where none are fused.
    maps
        Feed COLMAP: leave out frames that are too blurred, and show it deblurred ones smoothed.
    matching
        Without ``maps``: smooth deblurred frames as COLMAP would see them, all the same.
    apertures
        Folder for disparities and depths of a multi-aperture camera.
    keypoint_stages
        For model stages: what keypoints went through.
    database
        For model stages: COLMAP's, of the models.
    made_from
        For model stages: a file of an existing project that was made from its models; empty without one, ``None`` of a
        capture.
    sensors
        For model stages: what the capture holds beside the IMU that knows of metres.
    """

    recording: Recording
    options: ReconstructOptions = field(default_factory=ReconstructOptions)
    plan: ImagingPlan = field(default_factory=ImagingPlan)
    fuser: Fuser | None = None
    maps: bool = True
    matching: bool = False
    apertures: Path | None = None
    keypoint_stages: Sequence[KeypointStage] = ()
    database: Path | None = None
    made_from: str | None = None
    sensors: CaptureSensors | None = None
