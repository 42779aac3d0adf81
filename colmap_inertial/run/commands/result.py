"""Results of a reconstruction, as values and as ``result.json``."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial import __version__
from colmap_inertial.colmap.dense.depth_maps import DenseResult
from colmap_inertial.colmap.features.extraction import KeypointRecords, MatchRecord
from colmap_inertial.colmap.mapping.mapper import MapRecord
from colmap_inertial.core.errors import InertialError, NotObservableError
from colmap_inertial.core.facts import DETAILS, Fact, with_sentences
from colmap_inertial.core.geometry import quat_conjugate, quat_log, quat_multiply
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.core.types import Action, CameraImuCalibration, Gap, JoinedPart, ScaleEstimate, Treatment
from colmap_inertial.inertial.georeference import Georeference
from colmap_inertial.io.capture import Capture
from colmap_inertial.model import similarity_as_json
from colmap_inertial.model.identity import ModelIdentity
from colmap_inertial.model.rigs import RigSensor
from colmap_inertial.model.similarities import OF_MODEL
from colmap_inertial.run.preparation.selection import Selection
from colmap_inertial.run.stages.frame_folder import FrameRecord
from colmap_inertial.run.stages.imaging_plan import ImagingPlan, note_as_json
from colmap_inertial.run.steps.workspace import Workspace
from colmap_inertial.validate import Validation


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaledModel:
    """Result of the model stages for one of COLMAP's models; paths are ``None`` where the scale was refused.

    Attributes
    ----------
    index
        Its number in ``sparse/``: the models count from the one with the most images; those of an existing project
        keep COLMAP's numbers.
    colmap_index
        COLMAP's number, that of its folder in ``colmap/sparse/`` or in the project.
    scale
        Metres per unit, interval and verdict.
    summary
        ``registered_images``, ``points``, ``observations``, ``mean_reprojection_error_px``.
    sparse, sparse_metric
        COLMAP's model in ``colmap/sparse/`` or in the project, and the same in metres, in ``sparse/``.
    trajectory
        The camera's path, smoothed by the IMU or refined.
    treatments
        What the stages said.
    parts
        What it was joined of; empty where it is one of COLMAP's models.
    rig
        Where the cameras of rigs are, in metres; empty without rigs.
    identity
        Of COLMAP's model that the scale is of; ``None`` where it is of a part of one.
    """

    index: int
    colmap_index: int
    scale: ScaleEstimate
    summary: dict[str, int | float]
    sparse: Path
    sparse_metric: Path | None = None
    trajectory: Path | None = None
    treatments: tuple[Treatment, ...] = ()
    parts: tuple[JoinedPart, ...] = ()
    rig: tuple[RigSensor, ...] = ()
    identity: ModelIdentity | None = None


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class ModelResult(ScaledModel):
    """Outcome for one of COLMAP's models.

    Attributes
    ----------
    validation
        Against the capture's target, where it names one; an error says why the target could not be measured.
    georeference
        Where on Earth it stands, where that was asked for; an error says why that stays open.
    dense
        Where it was asked for.
    """

    validation: Validation | InertialError | None = None
    georeference: Georeference | InertialError | None = None
    dense: DenseResult | None = None

    @classmethod
    def of(cls, model: ScaledModel, root: Path) -> ModelResult:
        """A model of the record, whose paths count from ``root``, before it is measured."""
        values = {f.name: getattr(model, f.name) for f in fields(model)}
        paths = {name: root / value for name, value in values.items() if isinstance(value, Path)}
        return cls(**{**values, **paths})


@prints_in_lines
@dataclass(frozen=True, kw_only=True)
class Fragment:
    """A model of COLMAP's that is too small to be made metric.

    Attributes
    ----------
    colmap_index
        COLMAP's number.
    registered_images
        How many images it holds.
    sparse
        Its folder.
    """

    colmap_index: int
    registered_images: int
    sparse: Path


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class ReconstructResult:
    """Result of ``reconstruct``; the same as ``result.json``.

    Attributes
    ----------
    workspace
        The output folder.
    models
        The one with the most images first.
    fragments
        What was left out.
    gaps
        What lies between COLMAP's models, and whether they were joined across it.
    frames, keypoints
        What happened to each frame, and to the keypoints of each image.
    matching
        Which pairs of images were matched, and why not the rest; ``None`` for an existing project.
    mapping
        In how many parts COLMAP's models were made, and which of their ends met; ``None`` for an existing project.
    seconds
        By step.
    imaging
        What was decided beforehand about frames and keypoints, and why.
    selection
        Which frames were used, and why; ``None`` for an existing project.
    project_metric
        The whole project in metres, which is the output folder itself, where an existing one was given and not every
        scale was refused.
    report
        The page for reading; ``None`` where it failed, for which ``log.txt`` has the reason.
    unchanged
        Whether there was nothing to do: the folder held this result already.
    """

    workspace: Workspace
    models: tuple[ModelResult, ...]
    fragments: tuple[Fragment, ...] = ()
    gaps: tuple[Gap, ...] = ()
    frames: tuple[FrameRecord, ...] = ()
    keypoints: KeypointRecords = field(default_factory=KeypointRecords)
    matching: MatchRecord | None = None
    mapping: MapRecord | None = None
    seconds: dict[str, float]
    imaging: ImagingPlan = field(default_factory=ImagingPlan)
    selection: Selection | None = None
    project_metric: Path | None = None
    report: Path | None = None
    unchanged: bool = False

    @property
    def waiting(self) -> tuple[Fact, ...]:
        """Steps that the dense reconstructions wait for; empty where nothing is left to do."""
        return tuple(model.dense.waiting for model in self.models if model.dense is not None and model.dense.waiting)

    def exit_code(self) -> int:
        """0, also where a target could not be measured, as the scale does not rest on it; 1 where one is outside its
        tolerance.

        Raises
        ------
        NotObservableError
            When every model's scale was refused.
        InertialError
            When a dense reconstruction was asked for and waits for depth maps.
        """
        if all(model.sparse_metric is None for model in self.models):
            reasons = tuple(model.scale.reasons for model in self.models)
            if len(reasons) == 1:
                raise NotObservableError("scale", Fact("scale-refused", reasons=reasons[0]))
            models = tuple(model.index for model in self.models)
            raise NotObservableError("scale", Fact("scales-refused", models=models, reasons=reasons))
        if self.waiting:
            raise InertialError(Fact("found-together", found=self.waiting))
        checked = [model.validation for model in self.models]
        return int(any(not check.within_tolerance for check in checked if isinstance(check, Validation)))


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class DeblurResult:
    """Result of ``deblur_capture``; the same as ``result.json``.

    Attributes
    ----------
    workspace
        ``images/``; with ``rectify`` also ``colmap/images/``, what they were rectified from.
    frames
        What happened to each frame.
    imaging
        What was decided beforehand, and why.
    sheet
        The contact sheet; ``None`` where none was asked for or no frame was deblurred.
    unchanged
        Whether there was nothing to do: the folder held this result already.
    rectified
        Names of the images that were rectified, too.
    """

    workspace: Workspace
    frames: tuple[FrameRecord, ...]
    imaging: ImagingPlan
    sheet: Path | None = None
    unchanged: bool = False
    rectified: frozenset[str] = frozenset()


def imaging_as_json(plan: ImagingPlan, rectified: Collection[str]) -> dict[str, object]:
    """Treatment of frames and its reasons, without single frames; and whether any was rectified."""
    values = {
        key: value
        for key, value in plan.as_json().items()
        if key.removesuffix(DETAILS) not in ("decisions", "parallaxes", "sign_doubt", "rolling_shutter")
    }
    values |= {"rectify": bool(rectified), **note_as_json("rolling_shutter", describe_shutter(plan, rectified))}
    return {**values, "frames_with_translation": len(plan.parallaxes)}


def describe_shutter(plan: ImagingPlan, rectified: Collection[str]) -> Fact | None:
    """Describe the treatment of a rolling shutter, from the images whose keypoints were rectified."""
    if rectified and not plan.rectify:
        return Fact("keypoints-rectified-by-stages", planned=plan.rolling_shutter_note, count=len(rectified))
    if plan.rectify and not rectified:
        return Fact("keypoints-not-covered")
    return plan.rolling_shutter_note


def frame_as_json(record: FrameRecord, plan: ImagingPlan, rectified: Collection[str]) -> dict[str, object]:
    """Treatment of one frame."""
    reason = record.reason
    if reason is None:
        passed = record.action is Action.PASSED
        reason = plan.deblur_note if passed else Fact("by-a-stage", action=record.action.value)
    return {
        "name": record.name,
        "action": record.action,
        **note_as_json("reason", reason),
        **{key: record.value(key) for key in ("blur_px", "kept_share", "extent_factor")},
        "sharpened": record.sharpened,
        "rectified": record.name in rectified,
    }


def _compare_calibrations(
    first: CameraImuCalibration, refined: CameraImuCalibration | None
) -> dict[str, object] | None:
    """Change of the calibration by the scale estimate, against the one that frames were treated with."""
    if refined is None:
        return None
    turn = quat_log(quat_multiply(refined.cam_from_imu_xyzw, quat_conjugate(first.cam_from_imu_xyzw)))
    return {
        "rotation_deg": float(np.degrees(np.linalg.norm(turn))),
        "gyro_time_offset_s": refined.gyro_time_offset_s - first.gyro_time_offset_s,
        "gyro_bias_rad_s": (refined.gyro_bias_rad_s - first.gyro_bias_rad_s).tolist(),
    }


def measurement_as_json(measurement: Validation | Georeference | InertialError | None) -> dict[str, Any] | None:
    """Measurement in a model, or the reason why there is none."""
    if measurement is None:
        return None
    return error_as_json(measurement) if isinstance(measurement, InertialError) else measurement.as_json()


def error_as_json(error: InertialError) -> dict[str, Any]:
    """What an error says, and its code and values."""
    return {"error": str(error), "error" + DETAILS: error.fact.as_json()}


def _record_as_json(record: Treatment | Gap) -> dict[str, object]:
    """A record's fields, its reason in words and as a code."""
    return with_sentences({field.name: getattr(record, field.name) for field in fields(record)})


def _part_as_json(part: JoinedPart) -> dict[str, object]:
    values = {f.name: getattr(part, f.name) for f in fields(part)}
    return {**values, "similarity": similarity_as_json(part.similarity)}


def result_as_json(result: ReconstructResult, capture: Capture) -> dict[str, object]:
    """The content of ``result.json``."""
    import pycolmap

    root, plan, rectified = result.workspace.root, result.imaging, result.keypoints.rectified()

    def relative(path: Path | None) -> str | None:
        if path is None:
            return None
        # elsewhere, as an existing project's model: whatever folder one looks from
        return str(path.relative_to(root) if path.is_relative_to(root) else path.resolve())

    return {
        "versions": {"colmap_inertial": __version__, "pycolmap": pycolmap.__version__},
        "capture": str(capture.path.resolve()),
        "models": [
            {
                "index": model.index,
                "colmap_index": model.colmap_index,
                **model.summary,
                "sparse": relative(model.sparse),
                "sparse_metric": relative(model.sparse_metric),
                "trajectory": relative(model.trajectory),
                **model.scale.as_json(),
                **({} if model.identity is None else {OF_MODEL: model.identity.as_json()}),
                "calibration_change": None
                if plan.view is None
                else _compare_calibrations(plan.view.calibration, model.scale.calibration),
                "validation": measurement_as_json(model.validation),
                "georeference": measurement_as_json(model.georeference),
                "readout_translation": next((t.values for t in model.treatments if t.stage == "readout"), None),
                "joined_of": [_part_as_json(part) for part in model.parts],
                "rig": [asdict(sensor) for sensor in model.rig],
                "treatments": [_record_as_json(treatment) for treatment in model.treatments],
                "dense": model.dense and model.dense.as_json(root),
            }
            for model in result.models
        ],
        "fragments": [{**asdict(fragment), "sparse": relative(fragment.sparse)} for fragment in result.fragments],
        "gaps": [_record_as_json(gap) for gap in result.gaps],
        "project_metric": relative(result.project_metric),
        "waiting": bool(result.waiting),
        "selection": result.selection and result.selection.as_json(),
        "imaging": imaging_as_json(plan, rectified),
        "matching": result.matching and asdict(result.matching),
        "mapping": result.mapping and asdict(result.mapping),
        "frames": [frame_as_json(record, plan, rectified) for record in result.frames],
        "seconds": result.seconds,
    }
