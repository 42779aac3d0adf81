"""``scale`` and ``align`` without mapping: what the user has, turned into a trajectory and an IMU recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.checks.diagnose import Recorded, diagnose
from colmap_inertial.checks.validate import (
    Target,
    Validation,
    add_bars,
    add_check_points,
    add_other_target,
    parse_target,
    validate_model,
    write_overlays,
)
from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError, OutputError, OutputExistsError
from colmap_inertial.core.options import ScaleOptions, ValidateOptions
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, ImuRecording, ScaleEstimate, Similarity
from colmap_inertial.inertial.scale import estimate_scale, first_seconds, learn_lever_arm
from colmap_inertial.io.calibration import (
    CalibrationFiles,
    describe_files,
    largest_offset_s,
    list_paths,
    read_for_recording,
    write_calibration,
)
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.files import read_json, write_json
from colmap_inertial.io.frames import read_frame_times
from colmap_inertial.io.imu import is_capture, read_raw_imu
from colmap_inertial.io.imu_text import is_inertial_scale
from colmap_inertial.io.pose_convention import COLMAP, INERTIAL_SCALE, TUM, PoseConvention
from colmap_inertial.io.trajectories import read_inertial_scale, read_tum
from colmap_inertial.io.units import Axes
from colmap_inertial.model import (
    apply_similarity,
    downgraded,
    find_models,
    is_metric,
    read_model,
    trajectory_from_model,
)
from colmap_inertial.model.rigs import frames_of_rigs
from colmap_inertial.motion.align import AlignOptions
from colmap_inertial.motion.align.consensus import align_by_consensus
from colmap_inertial.motion.align.conventions import likely_convention


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
    calibration
        Calibration files; where ``imu`` is a capture.toml, its calibration serves.
    """

    source: Path
    imu: Path | None = None
    frame_times: Path | None = None
    calibration: CalibrationFiles = None


@dataclass(frozen=True, eq=False, kw_only=True)
class TimedPoses:
    """A trajectory with its IMU recording; ``start_s`` is when the camera began, where frame times tell.

    ``read_as`` is the convention that the poses were read by; ``gyro_axes`` and ``accel_axes`` are mappings of axes
    that a ``capture.toml`` applied.
    """

    trajectory: CameraTrajectory
    read_as: PoseConvention
    imu: ImuRecording
    calibration: CameraImuCalibration | None
    shared_clock: bool
    start_s: float | None = None
    notes: Sequence[str] = ()
    gyro_axes: Axes | None = None
    accel_axes: Axes | None = None


def load_source(source: ScaleSource) -> TimedPoses:
    """Read a trajectory and the IMU recording that ran along.

    Raises
    ------
    FormatError, TimingError
        For what is missing or cannot be read, naming the flag to give.
    """
    path = source.source
    if not path.exists():
        raise FormatError(path, "no such file or folder")
    inertial_scale = path.is_dir() and is_inertial_scale(path)
    if not inertial_scale:
        _require_all(source)
    notes: Sequence[str] = ()
    start_s = gyro_axes = accel_axes = None
    read_as = TUM
    if inertial_scale:
        trajectory, imu = read_inertial_scale(path)
        read_as = INERTIAL_SCALE
    elif path.is_dir():
        times = source.frame_times or source.imu
        assert times is not None
        folder = only_model(path)
        model = read_model(folder)
        timing = read_frame_times(times, frames_of_rigs([model]))
        trajectory, notes = trajectory_from_model(model, timing)
        read_as = COLMAP
        start_s = float(timing.pose_t_s()[0])
        if is_metric(folder):
            notes = (*notes, "this model is metric already: a scale of 1 says that it is right")
    else:
        trajectory = read_tum(path)
    if source.imu is not None:
        raw = read_raw_imu(source.imu)
        raw.check()
        imu, gyro_axes, accel_axes = raw.imu, raw.gyro_axes, raw.accel_axes
    captures = [load_capture(p) for p in (source.imu, source.frame_times, path) if p is not None and is_capture(p)]
    shared = any(capture.shared_clock for capture in captures)
    calibration = captures[0].calibration if captures else None
    of_imu = captures[0].imu_calibration if captures else None
    files = read_for_recording(source.calibration, shared_clock=shared)
    calibration, of_imu = files.camera_imu or calibration, files.imu or of_imu
    if of_imu is not None:
        imu = of_imu.corrected(imu)
        calibration = None if calibration is None else of_imu.loosened(calibration)
    return TimedPoses(
        trajectory=trajectory,
        read_as=read_as,
        imu=imu,
        calibration=calibration,
        shared_clock=shared,
        start_s=start_s,
        notes=notes,
        gyro_axes=gyro_axes,
        accel_axes=accel_axes,
    )


def _require_all(source: ScaleSource) -> None:
    """Refuse a model or trajectory without its recording or times, naming all that is missing at once."""
    path, missing = source.source, []
    if path.is_dir():
        only_model(path)
    if source.imu is None:
        missing.append("the IMU recording: give --imu PATH")
    if path.is_dir() and source.frame_times is None and not (source.imu is not None and is_capture(source.imu)):
        missing.append("the times of its images: give --frame-times, a CSV with name,t_s")
    if missing:
        raise FormatError(path, f"needs {'; and '.join(missing)}")


def only_model(path: Path) -> Path:
    """The one model in a folder.

    Raises
    ------
    FormatError
        Where there are several, or none; of a project, with the place of its models.
    """
    try:
        models = find_models(path)
    except FormatError:
        if not (path / "sparse").is_dir():
            raise
        inside = next(iter(find_models(path / "sparse").values()))
        raise FormatError(path, f"is a whole project: give one of its models, {inside}") from None
    if len(models) > 1:
        raise FormatError(
            path, f"holds {len(models)} models; give one of them, for example {next(iter(models.values()))}"
        )
    return next(iter(models.values()))


#: One of these is in every JSON file that a command writes.
_OURS = frozenset({"metres_per_unit", "cam_from_imu_xyzw", "accel_gain", "findings", "out", "exit_code"})


def check_output(path: Path, inputs: Sequence[Path | None]) -> None:
    """Refuse, before any work, an output that would replace anything but an earlier result of ours.

    Raises
    ------
    OutputError
    """
    if not path.parent.is_dir():
        raise OutputError(f"{path.parent} is no folder; create it first")
    if path.is_dir():
        raise OutputError(f"{path} is a folder; name a file in it")
    target = path.resolve()
    for known in inputs:
        if known is not None and target == known.resolve():
            raise OutputExistsError(f"{path} is an input; choose another name for the result")
    if path.exists():
        try:
            keys = set(read_json(path))
        except FormatError:
            keys = set()
        if not keys & _OURS:
            raise OutputExistsError(f"{path} exists and is no earlier result; choose another name or remove it")


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
        recording.trajectory, recording.imu, read_as=recording.read_as, prior=recording.calibration, options=options
    )
    if likely is not None:
        raise NotObservableError(quantity, likely.sentence)


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
        Use only the first seconds of the camera's recording, for the alignment too.
    force
        Estimate it also where ``diagnose`` finds an error; it is weak at most.
    """
    if json is not None:
        check_output(json, [source.source, source.imu, source.frame_times, *list_paths(source.calibration)])
    recording = load_source(source)
    trajectory = recording.trajectory
    if first_s is not None:
        trajectory = first_seconds(trajectory, first_s, start_s=recording.start_s)
    limit_s = largest_offset_s(recording.shared_clock, options.max_offset_s)
    options = dataclasses.replace(options, max_offset_s=limit_s)
    diagnosis = diagnose(
        Recorded(
            imu=recording.imu,
            gyro_axes=recording.gyro_axes,
            accel_axes=recording.accel_axes,
            trajectory=trajectory,
            read_as=recording.read_as,
            calibration=recording.calibration,
            max_offset_s=limit_s,
        )
    )
    doubts = tuple(finding.sentence for finding in diagnosis.stopping)
    if doubts and not force:
        estimate = ScaleEstimate.refused("none", *doubts)
    else:
        estimate = estimate_scale(
            trajectory, recording.imu, calibration=recording.calibration, options=options, read_as=recording.read_as
        )
        estimate = downgraded(estimate, doubts)
    notes = (*estimate.notes, *recording.imu.repairs, *recording.notes)
    estimate = dataclasses.replace(estimate, notes=notes)
    if json is not None:
        write_json(json, scale_as_json(estimate, source.calibration))
    return estimate


def scale_as_json(estimate: ScaleEstimate, calibration: CalibrationFiles = None) -> dict[str, object]:
    """Output of ``scale --json``: the estimate, and the calibration files that it used."""
    return {**estimate.as_json(), "calibration_files": describe_files(calibration)}


@dataclass(frozen=True, kw_only=True)
class ValidationOutputs:
    """Output files of a validation.

    Attributes
    ----------
    json, pictures
        The result, and frames with the corners drawn in.
    apply
        The model in metres, scaled by the control distances; for a model without a unit only.
    """

    json: Path | None = None
    pictures: Path | None = None
    apply: Path | None = None

    def check(self, model: Path, *, unscaled: bool) -> None:
        """Refuse, before any work, what would replace something; raises :class:`InertialError`."""
        if self.json is not None:
            check_output(self.json, [model])
        folder = self.pictures
        if folder is not None and folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
            raise OutputExistsError(f"{folder} exists; name a new folder for the pictures")
        if self.apply is not None and self.apply.exists():
            raise OutputExistsError(f"{self.apply} exists; name a new folder for the metric model")
        if self.apply is not None and not unscaled:
            raise InertialError("--apply scales a model that claims no unit: add --unscaled")


@dataclass(frozen=True, kw_only=True)
class KnownLengths:
    """Known lengths in a scene beside the target.

    Attributes
    ----------
    bars, check_points
        Tables of distances between markers, and of their coordinates.
    other
        Specification of a second target in the scene, and the metres between the middles of both, as ``4.03`` or
        ``4.03+-0.002`` with how well they are known.
    """

    bars: Path | None = None
    check_points: Path | None = None
    other: tuple[str, str] | None = None

    def second_target(self, first: Target) -> tuple[Target, float, float | None] | None:
        """The second target, metres between both, and their standard deviation; ``None`` without one.

        Raises
        ------
        InertialError
            Where the kinds of the targets do not go with what is known.
        """
        if (self.bars is not None or self.check_points is not None) and first.kind != "aruco":
            raise InertialError(
                "--bars and --check-points name markers: give a target of markers, as aruco:DICT:SIDE_M"
            )
        if self.other is None:
            return None
        second = parse_target(self.other[0])
        metres, sigma_m = _metres_apart(self.other[1])
        if "aruco" in (first.kind, second.kind):
            raise InertialError("--other-target is for two boards; distances between single markers go into --bars")
        if second.spec == first.spec:
            raise InertialError("--other-target must be another board than --target: nobody could tell them apart")
        return second, metres, sigma_m


def validate_source(
    model: Path,
    images: Path,
    target: str,
    options: ValidateOptions,
    outputs: ValidationOutputs = ValidationOutputs(),
    known: KnownLengths = KnownLengths(),
) -> Validation:
    """Measure a target in a model and write what was found.

    Parameters
    ----------
    model, images, target
        COLMAP model folder, folder of its images, specification of the target.
    options
        Of the validation.
    outputs
        Where to write it.
    known
        What else is known of the scene.

    Raises
    ------
    InertialError
        When ``apply`` is asked for and cannot be done; see also :func:`validate_model`.
    """
    parsed = parse_target(target)
    outputs.check(model, unscaled=options.unscaled)
    folder = only_model(model)
    second = known.second_target(parsed)
    result = validate_model(folder, images, parsed, options)
    if second is not None:
        result = add_other_target(result, validate_model(folder, images, second[0], options), second[1], second[2])
    if known.bars is not None:
        result = add_bars(result, known.bars)
    if known.check_points is not None:
        result = add_check_points(result, known.check_points)
    if outputs.apply is not None:
        if result.control is None:
            raise InertialError("too few corners to keep control and check distances apart; --apply needs more views")
        low, high = result.control.ci95
        sigma_log = np.log(high / low) / (2 * 1.96)
        provenance = f"control distances of {parsed.spec}"
        apply_similarity(folder, outputs.apply, scaling(result.control.metres_per_unit, sigma_log, provenance))
    if outputs.json is not None:
        write_json(outputs.json, result.as_json())
    if outputs.pictures is not None:
        write_overlays(result, images, outputs.pictures)
    return result


def scaling(metres_per_unit: float, sigma_log: float, provenance: str) -> Similarity:
    """A similarity that only scales."""
    cov = np.zeros((7, 7))
    cov[0, 0] = sigma_log**2
    rotation = np.array([0.0, 0.0, 0.0, 1.0])
    return Similarity(
        scale=metres_per_unit, rotation_xyzw=rotation, translation_m=np.zeros(3), cov=cov, provenance=provenance
    )


def _metres_apart(text: str) -> tuple[float, float | None]:
    """A length, and its standard deviation where that is said."""
    length, length_m, sigma = text.partition("+-")
    try:
        metres, sigma_m = float(length), float(sigma) if length_m else None
    except ValueError:
        metres, sigma_m = float("nan"), None
    if not 0 < metres < float("inf") or (sigma_m is not None and not 0 < sigma_m < metres):
        raise InertialError(f'--other-target ... "{text}": write metres between the two middles, as in 4.03+-0.002')
    return metres, sigma_m
