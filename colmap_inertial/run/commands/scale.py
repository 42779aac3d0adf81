"""``scale`` and ``align`` without mapping: what the user has, turned into a trajectory and an IMU recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import FormatError, NotObservableError, TimingError
from colmap_inertial.core.facts import Fact, as_fact
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, FrameTiming, ImuRecording, ScaleEstimate
from colmap_inertial.diagnose import Recorded, diagnose
from colmap_inertial.inertial.scale import estimate_scale, first_seconds, learn_lever_arm
from colmap_inertial.io.calibration import (
    CalibrationFiles,
    Calibrations,
    describe_files,
    largest_offset_s,
    list_paths,
    read_for_recording,
    write_calibration,
)
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.device_folders import is_device_folder, read_device_folder
from colmap_inertial.io.files import write_json
from colmap_inertial.io.frame_times import NO_RIGS, stamps_of_pattern
from colmap_inertial.io.frames import read_frame_times
from colmap_inertial.io.imu import is_capture, read_unchecked_imu
from colmap_inertial.io.imu_text import is_inertial_scale
from colmap_inertial.io.plausible import check_readings
from colmap_inertial.io.pose_convention import COLMAP, INERTIAL_SCALE, TUM
from colmap_inertial.io.trajectories import read_inertial_scale_poses, read_tum
from colmap_inertial.model import (
    Model,
    add_doubts,
    is_metric,
    read_model,
    trajectory_from_model,
)
from colmap_inertial.model.identity import ModelIdentity
from colmap_inertial.model.rigs import frames_of_rigs
from colmap_inertial.model.similarities import OF_MODEL
from colmap_inertial.motion.align import AlignOptions
from colmap_inertial.motion.align.consensus import align_by_consensus
from colmap_inertial.motion.align.conventions import likely_convention
from colmap_inertial.run.commands.paths import check_output, only_model
from colmap_inertial.run.commands.sensors import scale_by_sensors
from colmap_inertial.run.preparation.preflight import TolerantReader
from colmap_inertial.run.stages.metric import MetricStage
from colmap_inertial.run.steps.workspace import refuse_links_around

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class ScaleSource:
    """Source of a trajectory and its IMU recording.

    Attributes
    ----------
    source
        COLMAP model folder, TUM trajectory, or InertialScale folder.
    imu
        What ``read_imu`` accepts; an InertialScale folder has its own.
    frame_times
        For a COLMAP model: CSV or capture.toml; where ``imu`` is a capture.toml, its frame times serve.
    name_times
        For a COLMAP model, in place of ``frame_times``: how its images' names hold their times
        (:func:`stamps_of_pattern`).
    calibration
        Calibration files; where ``imu`` is a capture.toml, its calibration serves.
    """

    source: Path
    imu: Path | None = None
    frame_times: Path | None = None
    name_times: str | None = None
    calibration: CalibrationFiles = None


@dataclass(frozen=True, eq=False, kw_only=True)
class TimedPoses:
    """A trajectory with its IMU recording.

    ``recorded`` is what the check beforehand looks at; ``imu`` is corrected by its own calibration, where there is one.
    """

    recorded: Recorded
    imu: ImuRecording
    capture: Capture | None
    shared_clock: bool
    notes: Sequence[Fact] = ()

    @property
    def trajectory(self) -> CameraTrajectory:
        assert self.recorded.trajectory is not None
        return self.recorded.trajectory

    @property
    def calibration(self) -> CameraImuCalibration | None:
        return self.recorded.calibration


def brings_imu(source: ScaleSource) -> bool:
    """Whether poses and IMU lie in one folder, as InertialScale writes them.

    Raises
    ------
    FormatError
        Where there is no source, or it lies among links.
    """
    path = source.source
    if not path.exists():
        raise FormatError(path, Fact("no-such-file", what="file or folder"))
    refuse_links_around(path)
    if not path.is_dir():
        return False
    return is_inertial_scale(path) or (is_device_folder(path) and read_device_folder(path).imu is not None)


def load_source(source: ScaleSource) -> TimedPoses:
    """Read a trajectory and the IMU recording that ran along.

    Raises
    ------
    FormatError, TimingError
        For what is missing or cannot be read, naming the flag to give.
    """
    if not brings_imu(source):
        _require_all(source)
    recorded, capture, notes = read_source(source)
    for error in recorded.refused:
        raise error
    imu = recorded.imu
    assert imu is not None
    check_readings(imu)
    files, shared_clock = _read_calibrations(source)
    return TimedPoses(
        recorded=recorded,
        imu=imu if files.imu is None else files.imu.corrected(imu),
        capture=capture,
        shared_clock=shared_clock,
        notes=notes,
    )


def read_source(source: ScaleSource) -> tuple[Recorded, Capture | None, Sequence[Fact]]:
    """Read what there is of poses and the IMU recorded along; what cannot be read is among the refused.

    Beside it come the capture that describes a model's images, where there is one, and notes.

    Raises
    ------
    FormatError
        Where a folder is not one model, or nothing gives its times.
    """
    path, reader = source.source, TolerantReader()
    trajectory = timing = capture = None
    notes: Sequence[Fact] = ()
    if path.is_dir() and is_device_folder(path):
        read_as = TUM
        trajectory = reader.attempt(lambda: read_device_folder(path).trajectory)
    elif brings_imu(source):
        read_as = INERTIAL_SCALE
        trajectory = reader.attempt(lambda: read_inertial_scale_poses(path))
    elif path.is_dir():
        read_as = COLMAP
        folder = only_model(path)
        if not _has_times(source):
            raise FormatError(path, Fact("model-without-times"))
        capture = next(iter(_captures(source)), None)
        model = reader.attempt(lambda: read_model(folder))
        timing = reader.attempt(lambda: _read_times(source, model))
        if model is not None and timing is not None:
            placed, known = model, timing
            trajectory, left_out = reader.attempt(lambda: trajectory_from_model(placed, known)) or (None, ())
            notes = tuple(map(as_fact, left_out))
        if is_metric(folder):
            notes = (*notes, Fact("model-metric-already"))
    else:
        read_as = TUM
        trajectory = reader.attempt(lambda: read_tum(path))
    imu = reader.attempt(lambda: read_unchecked_imu(path if source.imu is None else source.imu))
    files, shared_clock = _read_calibrations(source)
    prior = files.camera_imu
    recorded = Recorded(
        refused=tuple(reader.refused),
        imu=imu,
        timing=timing,
        log=None if capture is None else capture.frame_log,
        is_capture=capture is not None and trajectory is None,
        trajectory=trajectory,
        read_as=read_as,
        camera=None if capture is None else capture.camera,
        calibration=prior if prior is None or files.imu is None else files.imu.loosened(prior),
        max_offset_s=largest_offset_s(shared_clock),
    )
    return recorded, capture, notes


def _captures(source: ScaleSource) -> list[Capture]:
    """The captures that a source names."""
    paths = (source.imu, source.frame_times, source.source)
    return [load_capture(path) for path in paths if path is not None and is_capture(path)]


def _read_calibrations(source: ScaleSource) -> tuple[Calibrations, bool]:
    """Calibrations of a device, of the given files or else the first capture; whether camera and IMU share a clock."""
    captures = _captures(source)
    shared_clock = any(capture.shared_clock for capture in captures) or is_device_folder(source.source)
    files = read_for_recording(source.calibration, shared_clock=shared_clock)
    for capture in captures[:1]:
        of_device = files.camera_imu or capture.calibration
        files = dataclasses.replace(files, camera_imu=of_device, imu=files.imu or capture.imu_calibration)
    return files, shared_clock


def _find_times(source: ScaleSource) -> Path | None:
    """What gives the times of a model's images: what was given, else the IMU's capture, where it has frames."""
    imu = source.imu
    if source.frame_times is not None or imu is None:
        return source.frame_times
    return imu if is_capture(imu) and load_capture(imu).frames is not None else None


def _has_times(source: ScaleSource) -> bool:
    return source.name_times is not None or _find_times(source) is not None


def _read_times(source: ScaleSource, model: pycolmap.Reconstruction | None) -> FrameTiming:
    """Times of a model's images; of a model that cannot be read, those that do not come from its names."""
    rigs = NO_RIGS if model is None else frames_of_rigs([model])
    if source.name_times is None:
        times = _find_times(source)
        assert times is not None
        return read_frame_times(times, rigs)
    if model is None:
        raise TimingError(Fact("model-without-times"))
    names = sorted(model.image(i).name for i in model.reg_image_ids())
    return stamps_of_pattern(source.source, names, source.name_times).one_per_frame(rigs).timing()


def _require_all(source: ScaleSource) -> None:
    """Refuse a model or trajectory without its recording or times, naming all that is missing at once."""
    path, missing = source.source, list[Fact]()
    if path.is_dir():
        only_model(path)
    if source.imu is None:
        missing.append(Fact("imu-missing"))
    if path.is_dir() and not _has_times(source):
        missing.append(Fact("times-missing"))
    if missing:
        raise FormatError(path, Fact("inputs-missing", missing=missing))


def align_source(source: ScaleSource, out: Path) -> CameraImuCalibration:
    """Align camera and IMU of an existing model or trajectory, and write the calibration.

    Where the recording gives a scale, the lever arm is the one that came with it, for other recordings of the device.

    Raises
    ------
    NotObservableError
        Where no offset between the clocks is better than the rest, the camera hardly turned, or most cameras do not
        agree with the gyroscope. Poses that fit by another convention are named, also where their rotations alone
        would do.
    """
    check_output(out, [source.source, source.imu, source.frame_times])
    recording = load_source(source)
    options = AlignOptions(max_offset_s=largest_offset_s(recording.shared_clock))
    try:
        aligned, _ = align_by_consensus(
            recording.trajectory, recording.imu, prior=recording.calibration, options=options
        )
    except NotObservableError as error:
        _refuse_another_convention(recording, options, error.quantity)
        raise
    _refuse_another_convention(recording, options, "rotation")
    calibration = dataclasses.replace(aligned.calibration, clock_rate=0.0, clock_middle_s=0.0)
    scale = ScaleOptions(max_offset_s=options.max_offset_s)
    estimate = estimate_scale(recording.trajectory, recording.imu, calibration=recording.calibration, options=scale)
    calibration = learn_lever_arm(calibration, estimate)
    write_calibration(out, calibration)
    return calibration


def _refuse_another_convention(recording: TimedPoses, options: AlignOptions, quantity: str) -> None:
    likely = likely_convention(
        recording.trajectory,
        recording.imu,
        read_as=recording.recorded.read_as,
        prior=recording.calibration,
        options=options,
    )
    if likely is not None:
        raise NotObservableError(quantity, likely.reason)


def scale_source(
    source: ScaleSource,
    options: ScaleOptions,
    *,
    json: Path | None = None,
    first_s: float | None = None,
    force: bool = False,
) -> ScaleEstimate:
    """Estimate the scale of an existing model or trajectory.

    Parameters
    ----------
    source
        Where the data lie.
    options
        Of the estimate.
    json
        Where to write it, also when the scale is refused.
    first_s
        Use only the first seconds of the camera's recording, for the alignment too; of the IMU's, a second more on
        either side.
    force
        Estimate it also where ``diagnose`` finds an error; it is weak at most.
    """
    if json is not None:
        check_output(json, [source.source, source.imu, source.frame_times, *list_paths(source.calibration)])
    if is_device_folder(source.source):
        estimate = scale_device(source, options, first_s=first_s, force=force)
    else:
        estimate = _scale_by_imu(source, options, first_s=first_s, force=force)
    if json is not None:
        write_json(json, scale_as_json(estimate, source.calibration, source.source))
    return estimate


def scale_device(
    source: ScaleSource, options: ScaleOptions, *, first_s: float | None = None, force: bool = False
) -> ScaleEstimate:
    """How much longer the true path is than a device's own, by all sensors that its export holds.

    Raises
    ------
    FormatError, TimingError
        For what is missing or cannot be read.
    """
    brings_imu(source)
    folder = read_device_folder(source.source)
    if folder.imu is not None or source.imu is not None:
        by_imu = _scale_by_imu(source, options, first_s=first_s, force=force)
    else:
        by_imu = ScaleEstimate.refused("none", Fact("scale-without-accelerometer"))
    trajectory = folder.trajectory
    if first_s is not None:
        trajectory = first_seconds(trajectory, first_s)
    return scale_by_sensors(by_imu, trajectory, folder)


def _scale_by_imu(source: ScaleSource, options: ScaleOptions, *, first_s: float | None, force: bool) -> ScaleEstimate:
    recording = load_source(source)
    limit_s = largest_offset_s(recording.shared_clock, options.max_offset_s)
    options = dataclasses.replace(options, max_offset_s=limit_s)
    if first_s is not None:
        recording = _begin_of(recording, first_s, limit_s)
    recorded = dataclasses.replace(recording.recorded, max_offset_s=limit_s)
    diagnosis = diagnose(recorded)
    stops = tuple(finding.reason for finding in diagnosis.stopping)
    left_out: tuple[Fact, ...] = ()
    if stops and not force:
        estimate = ScaleEstimate.refused("none", *stops, Fact("force-goes-on"))
    else:
        # what is declared says less than what was recorded
        believed = dataclasses.replace(recorded, calibration=recorded.believed)
        recording = dataclasses.replace(recording, recorded=believed)
        left_out = tuple(
            Fact("declared-left-out", finding=fact)
            for fact in recorded.contradicted.facts
            if fact not in [finding.fact for finding in diagnosis.stopping]
        )
        doubts = (*stops, *(finding.reason for finding in diagnosis.doubting))
        estimate = estimate_scale(
            recording.trajectory,
            recording.imu,
            calibration=recording.calibration,
            options=options,
            read_as=recorded.read_as,
        )
        estimate = add_doubts(_judge_shutter(source.source, recording, options, estimate), doubts)
    notes = (*left_out, *estimate.notes, *recording.imu.repairs, *recording.notes)
    return dataclasses.replace(estimate, notes=notes)


#: What is kept of the IMU before and after frames that are cut.
_AROUND_S = 1.0


def _begin_of(recording: TimedPoses, first_s: float, max_offset_s: float | None) -> TimedPoses:
    """The first seconds of a recording; where the clocks cannot be aligned, with the whole of its IMU."""
    recorded, timing = recording.recorded, recording.recorded.timing
    start_s = None if timing is None else float(timing.pose_t_s()[0])
    trajectory = first_seconds(recording.trajectory, first_s, start_s=start_s)
    recorded = dataclasses.replace(recorded, trajectory=trajectory)
    try:
        options = AlignOptions(max_offset_s=max_offset_s)
        aligned, _ = align_by_consensus(trajectory, recording.imu, prior=recording.calibration, options=options)
    except NotObservableError:
        return dataclasses.replace(recording, recorded=recorded)
    timed = CameraTimedImu(imu=recording.imu, calibration=aligned.calibration, camera_epoch_ns=trajectory.epoch_ns)
    around_s = trajectory.t_s[0] - _AROUND_S, trajectory.t_s[-1] + _AROUND_S
    if recorded.imu is not None:
        whole = dataclasses.replace(timed, imu=recorded.imu)
        recorded = dataclasses.replace(recorded, imu=whole.between(*around_s))
    return dataclasses.replace(recording, imu=timed.between(*around_s), recorded=recorded)


def _judge_shutter(
    folder: Path, recording: TimedPoses, options: ScaleOptions, estimate: ScaleEstimate
) -> ScaleEstimate:
    """The scale of a model; where its images show a rolling shutter that it ignores, it says so."""
    timing, capture = recording.recorded.timing, recording.capture
    if recording.recorded.read_as != COLMAP or timing is None or estimate.verdict == "refused":
        return estimate
    if timing.readout_s is None and capture is not None:
        timing = dataclasses.replace(timing, readout_s=capture.readout_s, readout_direction=capture.readout_direction)
    model = Model(reconstruction=read_model(only_model(folder)), colmap_index=0, timing=timing)
    stage = MetricStage(imu=recording.imu, calibration=recording.calibration, options=options)
    judged = stage.judge_shutter(model, estimate).scale
    assert judged is not None
    return judged


def scale_as_json(
    estimate: ScaleEstimate, calibration: CalibrationFiles = None, source: Path | None = None
) -> dict[str, object]:
    """Output of ``scale --json``: the estimate, the calibration files that it used, and of which model it is."""
    known = {} if source is None or (model := _identify(source)) is None else {OF_MODEL: model.as_json()}
    return {**estimate.as_json(), **known, "calibration_files": describe_files(calibration)}


def _identify(source: Path) -> ModelIdentity | None:
    """The model in a folder; ``None`` for poses of any other kind."""
    if not source.is_dir() or is_inertial_scale(source) or is_device_folder(source):
        return None
    return ModelIdentity.of(read_model(only_model(source)))
