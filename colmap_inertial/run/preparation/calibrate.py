"""Camera and IMU brought together before the reconstruction: what deblurring and the rolling shutter need.

The rotation between frames comes from a small model that COLMAP makes of some of the frames at reduced size; it tells
rotation from translation, which pixels followed from frame to frame cannot. Where there is no such model (a camera
that only turns), the followed pixels serve; in a video they also tell whether it was stabilised.
"""

from __future__ import annotations

import itertools
import logging
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.colmap.chunks import Processes
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features.extraction import extract_features, image_pairs, match_pairs, verify_again
from colmap_inertial.colmap.mapping.mapper import map_images
from colmap_inertial.core.errors import FormatError, MappingError, NotObservableError, fact_of
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.progress import Progress
from colmap_inertial.core.types import (
    CameraImuCalibration,
    CameraModel,
    CameraTrajectory,
    Frame,
    FrameTiming,
)
from colmap_inertial.hooks import FrameStage
from colmap_inertial.io.files import path_in
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import find_models, read_model, trajectory_from_model
from colmap_inertial.motion.align import AlignOptions, align_clocks
from colmap_inertial.motion.align.consensus import align_by_consensus
from colmap_inertial.motion.flow import VisualRotation, check_motion, find_stabilisation
from colmap_inertial.motion.sign import check_sign
from colmap_inertial.run.preparation.frame_reading import FOLLOWED, FullFrames, GreyFrames
from colmap_inertial.run.preparation.sampling import (
    measure_sampled_rotation,
    names_at,
    sample_middle,
    sample_spaced,
)
from colmap_inertial.run.stages.frame_folder import encode_image, smooth_for_colmap
from colmap_inertial.run.stages.imaging_plan import GyroView
from colmap_inertial.run.stages.rolling_shutter import RollingShutterStage

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class PreliminaryLimits:
    """Limits for a calibration before the reconstruction."""

    #: Frames of the small model: at most so many, at least so far apart.
    model_frames: int = 60
    model_spacing_s: float = 0.24
    #: Frames of one small model, where they are to cover a recording: the cost stays linear in its length.
    segment_frames: int = 240
    #: Frames that are followed by their pixels: at most so many, not closer than this.
    flow_frames: int = 300
    flow_spacing_s: float = 0.06
    #: Of images, as many tell a wrong sign.
    sign_frames: int = 40
    #: Frames of a video are closer than this.
    video_step_s: float = 0.13
    #: A declared calibration that is as good as this needs no search.
    good_rotation_rad: float = 0.03
    good_offset_s: float = 0.005
    #: What is estimated must be as good as this.
    usable_rotation_rad: float = 0.1
    usable_offset_s: float = 0.01


_LIMITS = PreliminaryLimits()


_SMALL = MappingOptions(
    pairing="sequential", overlap=6, max_num_features=1500, first_octave=0, max_image_size=800, refine_intrinsics=None
)


@dataclass(frozen=True, eq=False, kw_only=True)
class PreliminaryCalibration:
    """Calibration before the reconstruction.

    Attributes
    ----------
    view
        Gyroscope, camera and times, brought together.
    models
        COLMAP's models of frames all along the recording, of keypoints without the rolling shutter; empty where none
        were needed.
    """

    view: GyroView
    models: tuple[pycolmap.Reconstruction, ...] = ()


def expect_calibration(frames: GreyFrames, recording: Recording) -> None:
    """Have frames kept that pass before they are followed to calibrate camera and IMU."""
    every = frames.timing
    if _is_video(every):
        frames.expect(FOLLOWED, names_at(every, _list_followed(every)))
    elif _is_declared(recording.prior):
        frames.expect(FOLLOWED, names_at(every, _list_for_sign(every)))


def _is_video(every: FrameTiming) -> bool:
    return len(every.t_s) > 1 and float(np.median(np.diff(every.t_s))) <= _LIMITS.video_step_s


def _is_declared(calibration: CameraImuCalibration) -> bool:
    """Whether a declared calibration needs no search."""
    rotation_rad, offset_s = _sigmas(calibration)
    return rotation_rad <= _LIMITS.good_rotation_rad and offset_s <= _LIMITS.good_offset_s


def _list_followed(every: FrameTiming) -> list[int]:
    """Indices of the frames that are followed by their pixels."""
    return sample_middle(every, _LIMITS.flow_spacing_s, _LIMITS.flow_frames)


def _list_for_sign(every: FrameTiming) -> list[int]:
    """Indices of the frames that tell a wrong sign."""
    return sample_middle(every, _LIMITS.flow_spacing_s, _LIMITS.sign_frames)


def estimate_preliminary_calibration(
    recording: Recording, grey: GreyFrames, full: FullFrames, context: RunContext
) -> PreliminaryCalibration:
    """Find the calibration that the treatment of frames needs.

    Parameters
    ----------
    recording
        What is known beforehand is used as it stands where that is enough. Pixels are followed through all frames of a
        video.
    grey, full
        All images of the capture, and those to use.
    context
        ``progress`` is called with ``"motion"`` and ``"calibration"``.

    Raises
    ------
    NotObservableError
        Where the frames do not turn as the gyroscope does, or were stabilised.
    """
    capture, timing, progress = recording.capture, recording.timing, context.progress
    camera, along = grey.guess_camera(), _list_followed(grey.timing)
    rotation = measure_sampled_rotation(grey, camera, along, progress) if _is_video(grey.timing) else None
    view: GyroView | NotObservableError
    models: tuple[pycolmap.Reconstruction, ...] = ()
    if _is_declared(recording.prior):
        notes = () if capture.camera is not None else (Fact("focal-length-guessed", focal_px=camera.params[0]),)
        view = GyroView(
            imu=recording.imu, timing=timing, calibration=recording.prior, camera=camera, source="capture", notes=notes
        )
    else:
        view, models = _calibrate_by_model(recording, full, context)
        if isinstance(view, NotObservableError):
            rotation = rotation or measure_sampled_rotation(grey, camera, along, progress)
            view = _calibrate_by_pixels(rotation, recording, camera, view)
    if rotation is not None:
        known_s = None if isinstance(view, NotObservableError) else view.motion().offset_s
        stabilised = find_stabilisation(rotation, recording.imu, offset_s=known_s)
        if stabilised.stabilised:
            raise NotObservableError("the pixels' motion", stabilised.reason)
        if not isinstance(view, NotObservableError):
            agreement = check_motion(rotation, view.motion())
            if agreement.agrees is False:
                raise NotObservableError("the pixels' motion", agreement.reason)
    if isinstance(view, NotObservableError):
        raise view
    return PreliminaryCalibration(view=_check_declared_sign(view, grey, rotation, progress), models=models)


def _check_declared_sign(
    view: GyroView, grey: GreyFrames, rotation: VisualRotation | None, progress: Progress
) -> GyroView:
    """The view, with what there is to say about its sign; what was estimated has the right one.

    Raises
    ------
    NotObservableError
        Where the images turn the other way.
    """
    if view.source != "capture":
        return view
    if rotation is None:
        rotation = measure_sampled_rotation(grey, view.camera, _list_for_sign(grey.timing), progress)
    sign = check_sign(rotation, view.motion())
    if sign.right is False:
        raise NotObservableError("the pixels' motion", sign.reason)
    return view if sign.right else replace(view, sign_doubt=sign.reason)


def survey_parts(timing: FrameTiming) -> list[list[str]]:
    """Frames all along a recording, not too close together, in parts for small models of their own."""
    names = [timing.names[i] for i in sample_spaced(timing, _LIMITS.model_spacing_s)]
    segments = np.array_split(np.array(names, dtype=object), -(-len(names) // _LIMITS.segment_frames))
    return [segment.tolist() for segment in segments]


def survey(
    frames: FullFrames, view: GyroView, names: Sequence[str], stages: Sequence[FrameStage], context: RunContext
) -> tuple[pycolmap.Reconstruction, ...]:
    """COLMAP's small models of some frames; empty where it makes none.

    Parameters
    ----------
    frames
        The images.
    view
        By which keypoints are rectified.
    names
        Of the frames, as :func:`survey_parts` has them.
    stages
        That they go through.
    context
        ``progress`` is called with ``"survey"``.
    """
    steps = itertools.count()

    def step(stage: str, done: int, total: int, /) -> None:
        context.progress("survey", min(next(steps), 10 * len(names)), 10 * len(names))

    with tempfile.TemporaryDirectory(dir=context.scratch) as folder:
        work = Path(folder)
        images = frames.require_files() if not stages else _write_staged(frames.decode(names), work / "images", stages)
        try:
            models = _small_models(frames.camera, images, names, work / "0", view, context.reporting(step))
        except (MappingError, FormatError) as error:
            log.info("no survey: %s", error)
            models = ()
    context.progress("survey", 1, 1)
    return models


def _sigmas(calibration: CameraImuCalibration) -> tuple[float, float]:
    """Standard deviations of rotation (rad) and of the gyroscope's time offset (s)."""
    rotation = calibration.rotation_sigma_rad
    return rotation, calibration.clock_sigma_s


def _calibrate_by_pixels(
    rotation: VisualRotation, recording: Recording, camera: CameraModel, instead_of: NotObservableError
) -> GyroView | NotObservableError:
    try:
        view = _aligned(rotation.trajectory(), recording, camera, "pixels")
    except NotObservableError as error:
        why = Fact(
            "neither-by-pixels-nor-model", by_pixels=error.fact, quantity=instead_of.quantity, by_model=instead_of.fact
        )
        return NotObservableError(error.quantity, why)
    # what translation does to pixels looks like a bias of the gyroscope
    return replace(view, calibration=replace(view.calibration, gyro_bias_rad_s=recording.prior.gyro_bias_rad_s))


def _aligned(trajectory: CameraTrajectory, recording: Recording, camera: CameraModel, source: str) -> GyroView:
    options = AlignOptions(max_offset_s=recording.max_offset_s)
    if source == "pixels":
        alignment = align_clocks(trajectory, recording.imu, prior=recording.prior, options=options)
    else:
        alignment, _ = align_by_consensus(trajectory, recording.imu, prior=recording.prior, options=options)
    rotation_rad, offset_s = _sigmas(alignment.calibration)
    if rotation_rad > _LIMITS.usable_rotation_rad or offset_s > _LIMITS.usable_offset_s:
        raise NotObservableError(
            "camera-IMU calibration",
            Fact("calibration-too-loose", rotation_sigma_rad=rotation_rad, offset_sigma_s=offset_s),
        )
    return GyroView(
        imu=recording.imu,
        timing=recording.timing,
        calibration=alignment.settle_clock_rate(),
        camera=camera,
        source=source,
    )


def _calibrate_by_model(
    recording: Recording, frames: FullFrames, context: RunContext
) -> tuple[GyroView | NotObservableError, tuple[pycolmap.Reconstruction, ...]]:
    """The calibration by a small model; with a rolling shutter, by a second one of rectified keypoints.

    Also the models, where they are of all the recording.
    """
    timing = recording.timing
    indices = sample_middle(timing, _LIMITS.model_spacing_s, _LIMITS.model_frames)
    whole = len(indices) == len(sample_spaced(timing, _LIMITS.model_spacing_s))
    names = [timing.names[i] for i in indices]
    rounds = 2 if timing.readout_s else 1
    steps = itertools.count()

    def step(stage: str, done: int, total: int, /) -> None:
        context.progress("calibration", min(next(steps), 10 * len(names) * rounds), 10 * len(names) * rounds)

    models: tuple[pycolmap.Reconstruction, ...] = ()
    with tempfile.TemporaryDirectory(dir=context.scratch) as folder:
        work = Path(folder)
        images = frames.require_files()
        view: GyroView | None = None
        try:
            for i in range(rounds):
                matched = work / "0" if i else None
                hears = context.reporting(step)
                models = _small_models(frames.camera, images, names, work / str(i), view, hears, matched)
                trajectory, _ = trajectory_from_model(models[0], timing, covariances=False)
                view = _aligned(trajectory, recording, _camera_of(models[0]), "model")
        except (MappingError, FormatError) as error:
            return view or NotObservableError("camera-IMU calibration", fact_of(error)), ()
        except NotObservableError as error:
            return view or error, ()
    assert view is not None
    context.progress("calibration", 1, 1)
    return view, models if whole else ()


def _write_staged(frames: Iterator[Frame], images: Path, stages: Sequence[FrameStage]) -> Path:
    """Write frames to a folder as stages have them; returns it."""
    for stage in stages:
        frames = stage(frames)
    for frame in frames:
        target = path_in(images, frame.name)
        target.parent.mkdir(parents=True, exist_ok=True)
        encode_image(target, smooth_for_colmap(frame))
    return images


def _small_models(
    camera: CameraModel | None,
    images: Path,
    names: Sequence[str],
    work: Path,
    view: GyroView | None,
    context: RunContext,
    matched: Path | None = None,
) -> tuple[pycolmap.Reconstruction, ...]:
    """COLMAP's models of some frames, the largest first; with a view, of rectified keypoints.

    ``matched``: where models of the same frames were made before, of keypoints as they are: what has been moved already
    would be moved twice.
    """
    work.mkdir()
    database, sparse = work / "database.db", work / "sparse"
    cameras = {name: camera for name in names}
    stages = [] if view is None else [RollingShutterStage(view=view)]
    pairs = image_pairs(names, _SMALL)
    # what is small, and of images that others may not see, is done here
    context = replace(context, executor=Processes(number=1))
    # COLMAP's matcher and mapper differ from run to run with several threads, and the rest of a run would follow them
    alone = replace(context, num_threads=1, executable=None)
    if matched is None:
        extract_features(images, cameras, database, _SMALL, keypoint_stages=stages, context=context)
        match_pairs(database, pairs, alone)
    else:
        verify_again(matched / "database.db", database, pairs, stages, alone)
    map_images(database, images, sparse, replace(_SMALL, refine_intrinsics=camera is None), alone)
    models = [read_model(folder) for folder in find_models(sparse).values()]
    return tuple(sorted(models, key=lambda model: -int(model.num_reg_images())))


def _camera_of(model: pycolmap.Reconstruction) -> CameraModel:
    used = next(iter(model.cameras.values()))
    params = tuple(float(value) for value in used.params)
    return CameraModel(model=used.model.name, width=used.width, height=used.height, params=params)
