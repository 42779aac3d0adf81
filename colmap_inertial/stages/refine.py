"""The model stage that fits pictures, rolling shutter and IMU together: a metric model's shape, without its drift."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.errors import NotObservableError
from colmap_inertial.geometry import quat_from_matrix
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.model import Model, has_rigs
from colmap_inertial.options import ScaleOptions
from colmap_inertial.refine.judge import Judged, refine, size_of
from colmap_inertial.refine.setup import (
    Known,
    Seen,
    at_middle_lines,
    keypoints_of,
    make_problem,
    read_seen,
    written_back,
)
from colmap_inertial.refine.values import LEVER, OFFSET, READOUT, ROTATION, Estimate, Problem
from colmap_inertial.scale import strength_of_gravity
from colmap_inertial.stages.metric import gravity_in_model
from colmap_inertial.stages.rolling_shutter import RollingShutterStage
from colmap_inertial.threads import one_blas_thread
from colmap_inertial.types import CAL, Array, CameraImuCalibration, ImuRecording, SolvedMotion, Treatment

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

_FEWEST_IMAGES, _FEWEST_POINTS = 10, 50
#: One camera comes back to settings that it had before in fewer of its images than this.
_MOST_RETURNS = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class RefineStage:
    """Refines a metric model by all of its observations, each at its own line's instant, and the IMU between frames.

    Comes after the scale. The overall size and the direction of gravity stay what the scale estimate made them; the
    shape changes: paths bend less, and their scale drifts less. The model stays as it is where the refined one
    predicts observations that were held out no better, or where the IMU contradicts the pictures.

    Attributes
    ----------
    imu
        The recording that ran along.
    calibration
        What is known of the camera and the IMU beforehand.
    options
        Of the scale estimate: strength of gravity.
    refine_intrinsics
        Whether the cameras may change.
    shutter
        What rectified the keypoints, where something did.
    """

    imu: ImuRecording
    calibration: CameraImuCalibration | None
    options: ScaleOptions = field(default_factory=ScaleOptions)
    refine_intrinsics: bool
    shutter: RollingShutterStage | None = None

    def __call__(self, model: Model, /) -> Model:
        """Refine the model."""
        begin_s = time.perf_counter()
        why_not = self._why_not(model)
        if why_not:
            return _said(model, f"left as it is: {why_not}")
        try:
            with one_blas_thread():
                refined = self._refined(model)
        except (NotObservableError, np.linalg.LinAlgError) as error:
            hint = error.hint if isinstance(error, NotObservableError) else "camera and IMU do not determine its shape"
            return _said(model, f"left as it is: {hint}")
        log.info("model %d: refined in %.1f s", model.colmap_index, time.perf_counter() - begin_s)
        return refined

    def _why_not(self, model: Model) -> str:
        """Why a model cannot be refined; empty where it can."""
        estimate, reconstruction = model.scale, model.reconstruction
        if model.similarity is None or estimate is None or estimate.calibration is None:
            return "it has no scale"
        if estimate.noise is None or estimate.accel_bias_m_s2 is None or gravity_in_model(model) is None:
            return "its scale says nothing of the IMU's noise; the joint method does"
        if reconstruction.num_reg_images() < _FEWEST_IMAGES:
            return f"it has fewer than {_FEWEST_IMAGES} images"
        if reconstruction.num_points3D() < _FEWEST_POINTS:
            return f"it has fewer than {_FEWEST_POINTS} points"
        if has_rigs(reconstruction) or _alternate(model):
            return "several cameras took its images, and each has its own place beside the IMU"
        if model.timing.readout_s and not model.rectified:
            return "its images still have the rolling shutter, and would not agree with the refined poses"
        if estimate.parts is not None and estimate.parts.get("accel_faults"):
            return "the accelerometer has faults, which its scale undid and the refinement would not"
        if model.rectified and self.shutter is None:
            return "its keypoints were moved by a stage that cannot say from where"
        return ""

    def _refined(self, model: Model) -> Model:
        seen = read_seen(model.reconstruction, model.timing)
        problem, start = make_problem(seen, model.timing, self.imu, self._known(model), self._exposed_px(model, seen))
        declared = model.timing.readout_s is not None
        judged = refine(problem, start, seen.observations.xy_px, seen.t_s, readout_declared=declared)
        figures = {
            name: getattr(judged, name)
            for name in ("accepted", "held_out", "before_px", "after_px", "change", "change_sigma", "chi2", "sigma_px")
        }
        if judged.readout is not None:
            figures |= dict(zip(("readout_s", "readout_sigma_s"), judged.readout, strict=True))
        heard = (
            f"{judged.held_out} observations that were held out: {judged.before_px:.4f} -> {judged.after_px:.4f} px; "
            f"the IMU costs {judged.chi2:.2f} of what its noise explains"
        )
        if not judged.accepted:
            return _said(model, f"left as it is: {judged.reason} ({heard})", **figures)
        x = judged.estimate
        after = at_middle_lines(problem, x).cam_in_world
        about, scale = after.mean(axis=0), size_of(seen.cam_in_world) / size_of(after)
        figures |= {"size_before": scale, "drift": [asdict(part) for part in judged.drift]}
        figures |= _calibration_figures(judged)
        reconstruction = written_back(model.reconstruction, seen, problem, x, about=about, scale=scale)
        assert model.scale is not None and model.scale.calibration is not None
        calibration = _refined_calibration(model.scale.calibration, problem, judged)
        refined = replace(model.scale, calibration=calibration, accel_bias_m_s2=x.accel_bias_m_s2.mean(axis=0))
        readout_s = x.readout_s if model.timing.readout_s else None
        motion = _motion(reconstruction, seen, judged, scale, readout_s=readout_s)
        done = replace(model, reconstruction=reconstruction, scale=refined, observed_px={}, motion=motion)
        return _said(done, f"refined by the IMU ({heard})", action="refined", **figures)

    def _exposed_px(self, model: Model, seen: Seen) -> Array:
        """(M, 2) observations in the pictures as they were exposed."""
        if not model.rectified or self.shutter is None:
            return seen.observations.xy_px
        keypoints = {}
        for image_id, name in zip(seen.image_ids, seen.names, strict=True):
            points = model.reconstruction.image(image_id).points2D
            mapped = model.observed_px.get(name)
            xy_px = np.array([p.xy for p in points]).reshape(-1, 2) if mapped is None else mapped
            keypoints[name] = self.shutter.as_exposed(name, xy_px)
        return keypoints_of(seen, keypoints)

    def _known(self, model: Model) -> Known:
        estimate, gravity = model.scale, gravity_in_model(model)
        assert estimate is not None and estimate.calibration is not None and estimate.noise is not None
        assert estimate.accel_bias_m_s2 is not None and gravity is not None
        strength, sigma = strength_of_gravity(self.options)
        return Known(
            calibration=estimate.calibration,
            prior=calibration_prior() if self.calibration is None else self.calibration,
            noise=estimate.noise,
            accel_bias_m_s2=estimate.accel_bias_m_s2,
            down=gravity / np.linalg.norm(gravity),
            gravity_m_s2=strength,
            gravity_sigma_m_s2=sigma,
            refine_intrinsics=self.refine_intrinsics,
        )


def _alternate(model: Model) -> bool:
    """Whether cameras take turns: two devices, or a rig that nobody declared; not one that zoomed, and back."""
    t_of = dict(zip(model.timing.names, model.timing.pose_t_s().tolist(), strict=True))
    images = [model.reconstruction.image(image_id) for image_id in model.reconstruction.reg_image_ids()]
    used = [one.camera_id for one in sorted((i for i in images if i.name in t_of), key=lambda i: t_of[i.name])]
    met = set(used[:1])
    returns = 0
    for before, camera_id in pairwise(used):
        returns += camera_id != before and camera_id in met
        met.add(camera_id)
    return returns > _MOST_RETURNS * len(used)


def _said(model: Model, reason: str, *, action: str = "", **values: object) -> Model:
    """The model with what was decided; a note beside its scale says it on the terminal and in the report."""
    log.info("model %d: %s", model.colmap_index, reason)
    done = Treatment(stage="refine", reason=reason, action=action, values=values)
    scale = model.scale
    if scale is not None and model.similarity is not None:
        scale = replace(scale, notes=(*scale.notes, f"the model was {reason}"))
    return replace(model, treatments=(*model.treatments, done), scale=scale)


def _motion(
    written: pycolmap.Reconstruction, seen: Seen, judged: Judged, scale: float, *, readout_s: float | None
) -> SolvedMotion:
    """The camera's motion in the model that is written, which is stretched."""
    velocity = scale * judged.velocity_m_s
    images = (written.image(image_id) for image_id in seen.image_ids)
    return SolvedMotion(
        cam_in_world={image.name: image.projection_center() for image in images},
        velocity_in_world={seen.names[i]: velocity[i] for i in np.flatnonzero(np.isfinite(velocity).all(axis=1))},
        cov={seen.names[i]: scale**2 * cov for i, cov in judged.motion_covs.items()},
        readout_s=readout_s,
    )


def _calibration_figures(judged: Judged) -> dict[str, object]:
    """What was estimated of the device, with standard deviations."""
    x, cov = judged.estimate, judged.shared_cov
    assert cov is not None
    sigma = np.sqrt(np.diagonal(cov))
    return {
        "readout_s": x.readout_s,
        "readout_sigma_s": float(sigma[READOUT]),
        "imu_in_cam_m": x.imu_in_cam_m.tolist(),
        "imu_in_cam_sigma_m": sigma[LEVER].tolist(),
        "intrinsics": x.intrinsics.tolist(),
        "gyro_gain": x.gyro_gain.tolist(),
        "accel_gain": x.accel_gain.tolist(),
    }


def _refined_calibration(before: CameraImuCalibration, problem: Problem, judged: Judged) -> CameraImuCalibration:
    """The calibration with what the refinement says of it, and its covariance."""
    x, shared, inertial = judged.estimate, judged.shared_cov, problem.inertial
    assert shared is not None and inertial is not None
    at = x.columns
    jacobian = np.zeros((CAL.COUNT, at.count))
    jacobian[CAL.ROTATION, ROTATION] = np.eye(3)
    jacobian[CAL.TIME_OFFSETS, OFFSET] = 1.0
    jacobian[CAL.ACCEL_TIME_OFFSET, at.accel_delay] = 1.0
    jacobian[CAL.LEVER_ARM, LEVER] = np.eye(3)
    cov = jacobian @ shared @ jacobian.T
    for part in (CAL.GYRO_BIAS, slice(CAL.READOUT, CAL.READOUT + 1)):
        cov[part, part] = before.cov[part, part]
    later_s = before.clock_rate * (inertial.middle_s - before.clock_middle_s) + x.offset_s
    return replace(
        before,
        cam_from_imu_xyzw=quat_from_matrix(x.cam_from_imu),
        gyro_time_offset_s=before.gyro_time_offset_s + later_s,
        accel_time_offset_s=before.accel_time_offset_s + later_s + x.accel_delay_s,
        gyro_bias_rad_s=_mean_bias(x),
        imu_in_cam_m=x.imu_in_cam_m,
        cov=0.5 * (cov + cov.T),
        clock_rate=before.clock_rate + x.clock_rate,
        clock_middle_s=inertial.middle_s,
    )


def _mean_bias(x: Estimate) -> Array:
    return np.asarray(x.gyro_bias_rad_s.mean(axis=0))
