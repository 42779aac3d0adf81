"""What a reconstruction made, and ``result.json``, which says the same."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from colmap_inertial import __version__
from colmap_inertial.colmap.dense import DenseResult
from colmap_inertial.errors import InertialError, NotObservableError
from colmap_inertial.geometry import quat_conjugate, quat_log, quat_multiply
from colmap_inertial.io.capture import Capture
from colmap_inertial.model.readout import Settled
from colmap_inertial.precalibrate.plan import ImagingPlan
from colmap_inertial.precalibrate.selection import Selection
from colmap_inertial.run.workspace import Workspace
from colmap_inertial.stages.frame_folder import FrameRecord
from colmap_inertial.types import CameraImuCalibration, ScaleEstimate
from colmap_inertial.validate import Validation


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelResult:
    """What became of one of COLMAP's models; paths are ``None`` where the scale was refused."""

    index: int
    scale: ScaleEstimate
    summary: dict[str, int | float]
    sparse: Path
    sparse_metric: Path | None = None
    trajectory: Path | None = None
    validation: Validation | InertialError | None = None
    """Against the capture's target, where it names one; an error says why the target could not be measured."""
    dense: DenseResult | None = None
    """Where it was asked for."""
    readout: Settled | None = None
    """What the camera's translation within a rolling shutter's readout did to the model, where it was looked at."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReconstructResult:
    """What ``reconstruct`` made; the same as ``result.json``."""

    workspace: Workspace
    models: tuple[ModelResult, ...]
    frames: tuple[FrameRecord, ...]
    seconds: dict[str, float]
    imaging: ImagingPlan = field(default_factory=ImagingPlan)
    """What was done to frames and keypoints beforehand, and why."""
    selection: Selection | None = None
    """Which frames were used, and why; ``None`` for an existing project."""
    project_metric: Path | None = None
    """The whole project in metres, where an existing one was given and not every scale was refused."""
    report: Path | None = None
    """The page for reading; ``None`` where it failed, for which ``log.txt`` has the reason."""

    @property
    def waiting(self) -> tuple[str, ...]:
        """What the user has to do for the dense reconstructions to go on; empty where nothing is left to do."""
        return tuple(model.dense.waiting for model in self.models if model.dense is not None and model.dense.waiting)

    def exit_code(self) -> int:
        """0; 1 where a validation is outside its tolerance; its error's code where the target could not be measured.

        Raises
        ------
        NotObservableError
            When every model's scale was refused.
        InertialError
            When a dense reconstruction was asked for and waits for depth maps.
        """
        if all(model.sparse_metric is None for model in self.models):
            reasons = {model.index: "; ".join(model.scale.reasons) for model in self.models}
            raise NotObservableError(
                "scale",
                next(iter(reasons.values()))
                if len(reasons) == 1
                else "; ".join(f"model {i}: {text}" for i, text in reasons.items()),
            )
        if self.waiting:
            raise InertialError("; ".join(self.waiting))
        checked = [model.validation for model in self.models if model.validation is not None]
        failures = [check.exit_code for check in checked if isinstance(check, InertialError)]
        outside = any(not check.within_tolerance for check in checked if isinstance(check, Validation))
        if outside:
            return 1
        return failures[0] if len(failures) == len(checked) > 0 else 0


def imaging_as_json(plan: ImagingPlan) -> dict[str, object]:
    """What was done beforehand and why, without what concerns single frames."""
    values = {key: value for key, value in plan.as_json().items() if key not in ("decisions", "parallaxes")}
    return {**values, "frames_with_translation": len(plan.parallaxes)}


def frame_as_json(record: FrameRecord, plan: ImagingPlan) -> dict[str, object]:
    """What happened to one frame."""
    treatment = record.treatment
    rectified = record.action != "dropped" and any(stage.covers(record.name) for stage in plan.keypoint_stages())
    return {
        "name": record.name,
        "action": record.action,
        "reason": plan.deblur_note if treatment is None else treatment.reason,
        "blur_px": None if treatment is None else treatment.blur_px,
        "kept_share": None if treatment is None else treatment.kept_share,
        "extent_factor": None if treatment is None else treatment.extent_factor,
        "rectified": rectified,
    }


def _change(first: CameraImuCalibration, refined: CameraImuCalibration | None) -> dict[str, object] | None:
    """How far the scale estimate moved the calibration that the frames were treated with."""
    if refined is None:
        return None
    turn = quat_log(quat_multiply(refined.cam_from_imu_xyzw, quat_conjugate(first.cam_from_imu_xyzw)))
    return {
        "rotation_deg": float(np.degrees(np.linalg.norm(turn))),
        "gyro_time_offset_s": refined.gyro_time_offset_s - first.gyro_time_offset_s,
        "gyro_bias_rad_s": (refined.gyro_bias_rad_s - first.gyro_bias_rad_s).tolist(),
    }


def _validation_as_json(check: Validation | InertialError | None) -> object:
    return {"error": str(check)} if isinstance(check, InertialError) else check and check.as_json()


def result_as_json(result: ReconstructResult, capture: Capture) -> dict[str, object]:
    """The content of ``result.json``."""
    import pycolmap

    root, plan = result.workspace.root, result.imaging

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
                **model.summary,
                "sparse": relative(model.sparse),
                "sparse_metric": relative(model.sparse_metric),
                "trajectory": relative(model.trajectory),
                **model.scale.as_json(),
                "calibration_change": None
                if plan.view is None
                else _change(plan.view.calibration, model.scale.calibration),
                "validation": _validation_as_json(model.validation),
                "readout_translation": None if model.readout is None else asdict(model.readout),
                "dense": model.dense and model.dense.as_json(root),
            }
            for model in result.models
        ],
        "project_metric": relative(result.project_metric),
        "waiting": bool(result.waiting),
        "selection": result.selection and result.selection.as_json(),
        "imaging": imaging_as_json(plan),
        "frames": [frame_as_json(record, plan) for record in result.frames],
        "seconds": result.seconds,
    }
