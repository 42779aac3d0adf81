"""The model stage that fits images, rolling shutter and IMU together: a metric model's shape, without its drift."""

from __future__ import annotations

import logging
import time
from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_from_matrix
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import (
    CAL,
    Action,
    CameraImuCalibration,
    JoinedPart,
    ScaleEstimate,
    Similarity,
    SolvedMotion,
    Treatment,
)
from colmap_inertial.hooks import InvertibleStage, find_inverse
from colmap_inertial.inertial.core.priors import AccelPart, accel_part, model_scale_sigma
from colmap_inertial.inertial.refine.motion import Worth, add_scale, expect_worth
from colmap_inertial.inertial.refine.pictures import remove_extremes
from colmap_inertial.inertial.refine.refinement import Judged, refine
from colmap_inertial.inertial.refine.setup import (
    Seen,
    Written,
    make_problem,
    move_to_middle_lines,
    read_seen,
    write_back,
)
from colmap_inertial.inertial.refine.shutter import SHUTTER_IGNORED
from colmap_inertial.inertial.refine.values import FIRST_INTRINSIC, LEVER, OFFSET, READOUT, ROTATION, Estimate, Problem
from colmap_inertial.inertial.refine.world import size_of, state_scale
from colmap_inertial.model import Model, add_doubts
from colmap_inertial.model.rigs import has_rigs
from colmap_inertial.model.similarities import compose
from colmap_inertial.run.stages.inputs import StageInputs
from colmap_inertial.run.stages.metric import InertialStage, exposed_keypoints, gravity_in_model

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: What is written of a refined model, as a number: raised with its layout, so that a run goes on from no older one.
#: 3: the refinement's own scale; covariances of rotations. 4: noise of the gyroscope, errors that observations share.
_WRITES = 4
_FEWEST_IMAGES, _FEWEST_POINTS = 10, 50
#: Squares of what the IMU and the images disagree by, over those that its noise explains, from which on one of them
#: is wrong: five standard deviations between all images.
_GROSS_CHI2 = 25.0
#: One camera comes back to settings that it had before in fewer of its images than this.
_MOST_RETURNS = 0.1
#: Where each image has a camera of its own: between focal lengths of two devices, no other lies within this share.
_FOCAL_GAP = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class RefineStage(InertialStage):
    """Refines a metric model by all of its observations, each at its own line's instant, and the IMU between frames.

    Comes after the scale. Paths bend less, and their scale drifts less; size and up become those of the refinement,
    with their covariance. The model stays as it is where the refined one predicts observations that were held out no
    better, or where the IMU contradicts the images.

    Attributes
    ----------
    refine_intrinsics
        Whether the cameras may change.
    shutter
        What rectified the keypoints, where something did.
    auto
        Whether a model stays as it is where the refinement promises little, or takes long.
    made_from
        Of an existing project, a file that was made from its models and keeps their shape: ``auto`` leaves these as
        they are then; empty without one, ``None`` of a capture.
    """

    refine_intrinsics: bool
    shutter: InvertibleStage | None = None
    auto: bool = False
    made_from: str | None = None
    _writes: int = field(default=_WRITES, init=False, repr=False)

    @classmethod
    def for_run(cls, inputs: StageInputs) -> RefineStage | None:
        """The stage of a run, where models are to be refined."""
        if inputs.options.refine == "off":
            return None
        return cls(
            **cls.fields_for(inputs),
            refine_intrinsics=cls.refines_intrinsics(inputs),
            shutter=find_inverse(inputs.keypoint_stages),
            auto=inputs.options.refine == "auto",
            made_from=inputs.made_from,
        )

    @property
    def changes_images(self) -> bool:
        """Whether rectified images agree with the refined model only once they are made again."""
        return self.shutter is not None

    def __call__(self, model: Model, /) -> Model:
        """Refine the model."""
        begin_s = time.perf_counter()
        why_not = self._find_obstacle(model)
        if why_not is not None:
            return _record(model, Fact("not-refined", why=why_not))
        try:
            with one_blas_thread():
                refined = self._refine(model)
        except (NotObservableError, np.linalg.LinAlgError) as error:
            why_not = error.fact if isinstance(error, NotObservableError) else Fact("refine-not-determined")
            return _record(model, Fact("not-refined", why=why_not))
        log.info("model %d: the refinement took %.1f s", model.colmap_index, time.perf_counter() - begin_s)
        return refined

    def _find_obstacle(self, model: Model) -> Fact | None:
        """Why a model cannot be refined; ``None`` where it can."""
        estimate, reconstruction = model.scale, model.reconstruction
        if model.similarity is None or estimate is None or estimate.calibration is None:
            return Fact("refine-without-scale")
        if estimate.noise is None or estimate.accel_bias_m_s2 is None or gravity_in_model(model) is None:
            return Fact("refine-without-noise")
        if reconstruction.num_reg_images() < _FEWEST_IMAGES:
            return Fact("refine-images-few", needed=_FEWEST_IMAGES)
        if reconstruction.num_points3D() < _FEWEST_POINTS:
            return Fact("refine-points-few", needed=_FEWEST_POINTS)
        if has_rigs(reconstruction) or _takes_turns(model):
            return Fact("refine-several-cameras")
        if estimate.parts is not None and estimate.parts.get("accel_faults"):
            return Fact("refine-accel-faults")
        if model.rectified and self.shutter is None:
            return Fact("refine-keypoints-moved")
        if self.auto and (self.made_from or (self.made_from is not None and model.parts)):
            return Fact("refine-shape-in-use", made_from=self.made_from)
        return None

    def _refine(self, model: Model) -> Model:
        """The refined model, or the model with the reason why it stays as it was."""
        seen = remove_extremes(read_seen(model.reconstruction, model.timing))
        known = self.known_of(model, refine_intrinsics=self.refine_intrinsics)
        problem, start = make_problem(seen, model.timing, self.imu, known, self._expose_keypoints(model, seen))
        worth = expect_worth(seen, problem, start, bent=_ignores_shutter(model)) if self.auto else None
        if worth is not None and worth.reason is not None:
            return _record(model, Fact("not-refined", why=worth.reason), **_worth_figures(worth))
        declared = model.timing.readout_s is not None
        judged = refine(problem, start, seen.observations.xy_px, seen.t_s, readout_declared=declared)
        evidence = _state_evidence(judged, worth)
        figures = _state_figures(judged) | _worth_figures(worth)
        if not judged.accepted:
            model = _doubt_contradicted(model, judged)
            return _record(model, Fact("refinement-rejected", why=judged.reason, evidence=evidence), **figures)
        figures |= {"drift": [asdict(part) for part in judged.drift]} | _calibration_figures(judged)
        return self._apply_refinement(model, seen, problem, judged, evidence, figures)

    def _apply_refinement(
        self, model: Model, seen: Seen, problem: Problem, judged: Judged, evidence: Fact, figures: dict[str, Any]
    ) -> Model:
        """The model as an accepted refinement has it, in metres of its own; as it was where these are refused."""
        assert model.scale is not None and model.scale.calibration is not None
        assert model.similarity is not None and judged.world is not None
        x, accel = judged.estimate, accel_part(self.imu)
        middle_lines = move_to_middle_lines(problem, x)
        refined_from_before = _find_similarity(seen, middle_lines)
        scale, similarity = state_scale(
            _forget_ignored_shutter(model.scale, model, judged),
            model.similarity,
            refined_from_before,
            problem,
            x,
            judged.world,
            accel=accel,
        )
        if scale.verdict == "refused":
            return _record(model, Fact("refined-scale-refused", reasons=scale.reasons, evidence=evidence), **figures)
        figures = figures | {"size_before": 1 / refined_from_before.scale}
        has_readout = _has_readout(model, judged)
        rolling = has_readout and not model.rectified
        # a motion's readout has the direction that was declared
        readout_s = x.readout_s if model.timing.readout_s or (judged.readout and x.readout_s > 0) else None
        refined_model = replace(
            model,
            reconstruction=write_back(model.reconstruction, seen, problem, x, rectified=not rolling),
            scale=replace(scale, calibration=_make_refined_calibration(model.scale.calibration, problem, judged)),
            similarity=similarity,
            parts=tuple(_move_part(part, refined_from_before) for part in model.parts),
            observed_px={},
            motion=_make_motion(seen, middle_lines.cam_in_world, judged, accel=accel, readout_s=readout_s),
        )
        done = Fact("refined", evidence=evidence, rolling_readout_s=x.readout_s if rolling else None)
        return _record(refined_model, done, action=Action.REFINED, **figures)

    def _expose_keypoints(self, model: Model, seen: Seen) -> Array:
        """(M, 2) observations in the images as they were exposed."""
        if not model.rectified or self.shutter is None:
            return seen.observations.xy_px
        return exposed_keypoints(model, self.shutter, seen)


def _doubt_contradicted(model: Model, judged: Judged) -> Model:
    """The model with a doubt about its scale where the IMU contradicts its images beyond any noise."""
    reason, scale = judged.reason, model.scale
    if reason is None or reason.code != "imu-contradicts-images" or judged.chi2 <= _GROSS_CHI2 or scale is None:
        return model
    # what is contradicted by itself, as declared intrinsics are, is likelier its cause, and comes before
    doubted = add_doubts(scale, (reason,))
    return replace(model, scale=replace(doubted, reasons=(*scale.reasons, reason)))


def _has_readout(model: Model, judged: Judged) -> bool:
    """Whether a readout was declared or found."""
    return bool(model.timing.readout_s or judged.readout)


def _forget_ignored_shutter(scale: ScaleEstimate, model: Model, judged: Judged) -> ScaleEstimate:
    """The scale without the reason that the shutter is ignored, where the refinement does not."""
    if not _has_readout(model, judged):
        return scale
    return replace(scale, reasons=tuple(reason for reason in scale.reasons if reason.code != SHUTTER_IGNORED))


def _ignores_shutter(model: Model) -> bool:
    """Whether a model's images were found to have a rolling shutter that it ignores."""
    return any(treatment.reason.code == SHUTTER_IGNORED for treatment in model.treatments)


def _takes_turns(model: Model) -> bool:
    """Whether cameras take turns, as two devices or an undeclared rig do; not a camera that zoomed, and back."""
    t_of = dict(zip(model.timing.names, model.timing.pose_t_s().tolist(), strict=True))
    images = [model.reconstruction.image(image_id) for image_id in model.reconstruction.reg_image_ids()]
    timed = sorted((image for image in images if image.name in t_of), key=lambda image: t_of[image.name])
    used = _find_devices(model.reconstruction, timed)
    met = set(used[:1])
    returns = 0
    for before, device in pairwise(used):
        returns += device != before and device in met
        met.add(device)
    return returns > _MOST_RETURNS * len(used)


def _find_devices(reconstruction: pycolmap.Reconstruction, images: Sequence[pycolmap.Image]) -> list[Hashable]:
    """Device of each image: its camera; where nearly each image has its own camera, those with the same folder, size
    and focus.
    """
    cameras = [reconstruction.camera(image.camera_id) for image in images]
    if len({camera.camera_id for camera in cameras}) <= max(1, len(images) // 2):
        return [camera.camera_id for camera in cameras]
    focal = np.log([max(camera.mean_focal_length(), 1e-9) for camera in cameras])
    order = np.argsort(focal, kind="stable")
    group = np.empty(len(focal), dtype=np.int64)
    group[order] = np.cumsum(np.diff(focal[order], prepend=focal[order[:1]]) > np.log1p(_FOCAL_GAP))
    return [
        (image.name.rpartition("/")[0], camera.width, camera.height, number)
        for image, camera, number in zip(images, cameras, group.tolist(), strict=True)
    ]


def _record(model: Model, outcome: Fact, *, action: Action = Action.NOTHING, **values: object) -> Model:
    """The model with what was decided; a note beside its scale says it on the terminal and in the report."""
    log.info("model %d: %s", model.colmap_index, outcome)
    treatment = Treatment(stage="refine", reason=outcome, action=action, values=values)
    scale = model.scale
    if scale is not None and model.similarity is not None:
        scale = replace(scale, notes=(*scale.notes, Fact("model-was", done=outcome)))
    return replace(model, treatments=(*model.treatments, treatment), scale=scale)


def _worth_figures(worth: Worth | None) -> dict[str, Any]:
    """What a refinement was expected to bring; empty where it was asked for."""
    if worth is None:
        return {}
    return {"expected": {f.name: getattr(worth, f.name) for f in fields(worth) if f.name != "reason"}}


def _state_evidence(judged: Judged, worth: Worth | None) -> Fact:
    """What speaks for or against a refinement."""
    return Fact(
        "refinement-evidence",
        held_out=judged.held_out,
        before_px=judged.before_px,
        after_px=judged.after_px,
        chi2=judged.chi2,
        alone_m=None if worth is None else worth.alone_m,
        refined_m=None if worth is None else worth.refined_m,
    )


def _make_motion(
    seen: Seen, centres: Array, judged: Judged, *, accel: AccelPart, readout_s: float | None
) -> SolvedMotion:
    """The camera's motion in the model that is written; with what lens and accelerometer leave of its scale."""
    velocity, with_cov = judged.velocity_m_s, np.array(list(judged.motion_covs), dtype=np.int64)
    covs = add_scale(
        np.array(list(judged.motion_covs.values())).reshape(-1, 9, 9),
        model_scale_sigma(accel) ** 2,
        centres[with_cov] - centres[0],
        velocity[with_cov],
    )
    return SolvedMotion(
        cam_in_world=dict(zip(seen.names, centres, strict=True)),
        velocity_in_world={seen.names[i]: velocity[i] for i in np.flatnonzero(np.isfinite(velocity).all(axis=1))},
        cov={seen.names[i]: cov for i, cov in zip(with_cov.tolist(), covs, strict=True)},
        readout_s=readout_s,
    )


def _find_similarity(seen: Seen, after: Written) -> Similarity:
    """Similarity from the model before to the refined one: sizes, mean orientation and middles agree."""
    turns = after.cam_from_world.transpose(0, 2, 1) @ seen.cam_from_world
    u, _, vt = np.linalg.svd(turns.sum(axis=0))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    scale = size_of(after.cam_in_world) / size_of(seen.cam_in_world)
    return Similarity(
        scale=scale,
        rotation_xyzw=quat_from_matrix(turn),
        translation_m=after.cam_in_world.mean(axis=0) - scale * turn @ seen.cam_in_world.mean(axis=0),
        cov=np.zeros((7, 7)),
    )


def _move_part(part: JoinedPart, move: Similarity) -> JoinedPart:
    """A part of a joined model where the refinement moved it; how surely it was placed stays."""
    return replace(part, similarity=replace(compose(move, part.similarity), cov=part.similarity.cov))


def _state_figures(judged: Judged) -> dict[str, Any]:
    """What a refinement is judged by."""
    names = ("accepted", "held_out", "before_px", "after_px", "change", "change_sigma", "chi2", "sigma_px")
    noise = ("shared_errors", "accel_noise_m_s2_rthz", "gyro_noise_rad_s_rthz")
    out = {name: getattr(judged, name) for name in (*names, *noise)}
    if judged.readout is not None:
        out |= dict(zip(("readout_s", "readout_sigma_s"), judged.readout, strict=True))
    return out


def _calibration_figures(judged: Judged) -> dict[str, object]:
    """Estimates of the device, with standard deviations."""
    x, cov = judged.estimate, judged.shared_cov
    assert cov is not None
    sigma = np.sqrt(np.diagonal(cov))
    return {
        "readout_s": x.readout_s,
        "readout_sigma_s": float(sigma[READOUT]),
        "imu_in_cam_m": x.imu_in_cam_m.tolist(),
        "imu_in_cam_sigma_m": sigma[LEVER].tolist(),
        "rotation_sigma_deg": np.degrees(sigma[ROTATION]).tolist(),
        "gyro_axes_sigma_deg": _axes_sigma_deg(x, cov, x.columns.gyro_gain),
        "accel_axes_sigma_deg": _axes_sigma_deg(x, cov, x.columns.accel_gain),
        "intrinsics": x.intrinsics.tolist(),
        "intrinsics_sigma": sigma[FIRST_INTRINSIC : x.columns.seen.stop].tolist(),
        "gyro_gain": x.gyro_gain.tolist(),
        "gyro_gain_sigma": sigma[x.columns.gyro_gain].reshape(3, 3).tolist(),
        "accel_gain": x.accel_gain.tolist(),
        "accel_gain_sigma": sigma[x.columns.accel_gain].reshape(3, 3).tolist(),
    }


def axes_by(x: Estimate, gain: slice) -> Array:
    """(3, Q) derivatives of how a sensor's own axes lie in the camera, by what is shared; its errors are at ``gain``.

    They lie as the rotation nearest to ``cam_from_imu`` times one plus the errors. Errors of axes that both sensors
    share are a rotation of the IMU, and nothing in a recording tells them apart: ``cam_from_imu`` is as uncertain as
    the priors of these errors are. In a sensor's own axes they cancel.
    """
    by = np.zeros((3, x.columns.count))
    by[:, ROTATION] = np.eye(3)
    # of a matrix near one, the nearest rotation is that of its antisymmetric part
    turn = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        turn[i, k, j], turn[i, j, k] = 0.5, -0.5
    by[:, gain] = x.cam_from_imu @ turn.reshape(3, 9)
    return by


def _axes_sigma_deg(estimate: Estimate, cov: Array, gain: slice) -> list[float]:
    by = axes_by(estimate, gain)
    return [float(sigma) for sigma in np.degrees(np.sqrt(np.einsum("ij,jk,ik->i", by, cov, by)))]


def _make_refined_calibration(before: CameraImuCalibration, problem: Problem, judged: Judged) -> CameraImuCalibration:
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
        before.shift_clock_offsets(later_s, x.accel_delay_s),
        cam_from_imu_xyzw=quat_from_matrix(x.cam_from_imu),
        gyro_bias_rad_s=_mean_bias(x),
        imu_in_cam_m=x.imu_in_cam_m,
        cov=0.5 * (cov + cov.T),
        clock_rate=before.clock_rate + x.clock_rate,
        clock_middle_s=inertial.middle_s,
    )


def _mean_bias(x: Estimate) -> Array:
    return np.asarray(x.gyro_bias_rad_s.mean(axis=0))
