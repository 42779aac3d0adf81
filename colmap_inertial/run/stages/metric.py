"""Model stages that use the IMU: their base, the one for scale and gravity, and the trajectory that it smooths."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_rotate, so3_log
from colmap_inertial.core.options import ScaleOptions, WorldAxes
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import (
    CAL,
    Action,
    CameraImuCalibration,
    CameraMotion,
    CameraTrajectory,
    ImuRecording,
    RotationConsensus,
    ScaleEstimate,
    Similarity,
    SmoothedTrajectory,
    Treatment,
)
from colmap_inertial.hooks import InvertibleStage, find_inverse
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.inertial.refine.motion import ImageDrift, find_drift
from colmap_inertial.inertial.refine.setup import Known, Seen, keypoints_of, read_seen
from colmap_inertial.inertial.refine.shutter import SHUTTER_LIMITS, SeenReadout, find_readout
from colmap_inertial.inertial.scale import estimate_scale, strength_of_gravity
from colmap_inertial.io.calibration import SIGMAS, calibration_prior
from colmap_inertial.io.files import write_record
from colmap_inertial.io.trajectories import write_tum
from colmap_inertial.model import Model, add_doubts, trajectory_from_model
from colmap_inertial.model.deregistration import deregister_images
from colmap_inertial.model.own_place import OwnPlace
from colmap_inertial.model.rigs import has_rigs
from colmap_inertial.model.submodels.registration import register_again
from colmap_inertial.motion.align.consensus import describe_consensus, without_consensus
from colmap_inertial.motion.smooth import smooth_trajectory
from colmap_inertial.run.stages.inputs import StageInputs

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """Limits for the velocities of frames, and for the readout of rectified ones."""

    #: Share of the readout that acts on poses after rectification.
    readout_share: float = 0.1
    #: An angular velocity is the mean over this time, and over so many samples of the gyroscope, on each side of the
    #: instant: one reading has all of its noise, and a hand turns otherwise a few hundredths of a second later.
    rate_half_s: float = 7e-3
    rate_samples: int = 2


_LIMITS = MotionLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class InertialStage:
    """A model stage that uses the IMU.

    Attributes
    ----------
    imu
        The IMU recording.
    calibration
        What is known of the camera and the IMU beforehand.
    options
        Of the scale estimate.
    world
        Where gravity points in the metric model.
    keeps_intrinsics
        Whether the models have declared intrinsics that nothing refined.
    database
        COLMAP's, of the models: its matches register images again, and tie models.
    """

    imu: ImuRecording
    calibration: CameraImuCalibration | None
    options: ScaleOptions = field(default_factory=ScaleOptions)
    world: WorldAxes = "z-up"
    keeps_intrinsics: bool = False
    #: a run with other matches has other models
    database: Path | None = field(default=None, compare=False)

    @classmethod
    def fields_for(cls, inputs: StageInputs) -> dict[str, Any]:
        """The fields that all of these stages have, for a run."""
        recording, options = inputs.recording, inputs.options
        return {
            "imu": recording.imu,
            "calibration": recording.prior,
            "options": replace(options.scale, max_offset_s=recording.max_offset_s),
            "world": options.world,
            # an existing project's models may have others than were declared
            "keeps_intrinsics": recording.capture.camera is not None
            and inputs.made_from is None
            and not cls.refines_intrinsics(inputs),
            "database": inputs.database,
        }

    @staticmethod
    def refines_intrinsics(inputs: StageInputs) -> bool:
        """Whether the cameras may change: as asked for, else where the capture declares none."""
        asked = inputs.options.mapping.refine_intrinsics
        return inputs.recording.capture.camera is None if asked is None else asked

    def calibration_of(self, model: Model) -> CameraImuCalibration | None:
        """Calibration of the camera that a model was mapped for; rectified keypoints leave it hardly any readout."""
        if model.rectified and self.calibration is not None:
            return calibration_of_rectified(self.calibration)
        return self.calibration

    def known_of(self, model: Model, *, refine_intrinsics: bool) -> Known:
        """What a refinement of a metric model starts from."""
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
            refine_intrinsics=refine_intrinsics,
        )

    def estimate_scale(self, model: Model) -> tuple[Model, ScaleEstimate, CameraTrajectory]:
        """The model without cameras that contradict the gyroscope, its scale, and the poses that this rests on.

        Cameras that are wrong by themselves are registered again first, where COLMAP's matches place them; those that
        agree then stay. Where the scale is refused, the model is as it was.
        """
        estimate, trajectory = self._estimate(model)
        consensus = estimate.rotations
        if consensus is not None and not consensus.kept.all() and estimate.verdict != "refused":
            reconstruction, registered = self._register_again(model, consensus)
            if registered:
                again, poses = self._estimate(replace(model, reconstruction=reconstruction))
                if again.rotations is not None and again.verdict != "refused":
                    estimate, trajectory, consensus = again, poses, consensus.updated(again.rotations)
            left_out = set(consensus.left_out)
            trajectory = trajectory.select(np.array([name not in left_out for name in trajectory.names]))
            model = _select_agreeing_images(model, reconstruction, consensus)
        return model, _describe_rotations_of(model, estimate), trajectory

    def _estimate(self, model: Model) -> tuple[ScaleEstimate, CameraTrajectory]:
        """The scale of a model as it is, and its poses; notes name images that have no time."""
        trajectory, notes = trajectory_from_model(model.reconstruction, model.timing)
        estimate = estimate_scale(trajectory, self.imu, calibration=self.calibration_of(model), options=self.options)
        return replace(estimate, notes=(*estimate.notes, *notes)), trajectory

    def _register_again(
        self, model: Model, consensus: RotationConsensus
    ) -> tuple[pycolmap.Reconstruction, tuple[str, ...]]:
        """A model with its wrong cameras where matches place them, and which these are."""
        wrong = {*(camera.name for camera in consensus.wrong), *consensus.moved}
        if not wrong or self.database is None or not self.database.is_file() or has_rigs(model.reconstruction):
            return model.reconstruction, ()
        return register_again(model.reconstruction, wrong, self.database)


def _describe_rotations_of(model: Model, estimate: ScaleEstimate) -> ScaleEstimate:
    """The estimate with what is known of the model's cameras, where more is than the estimate itself found."""
    if model.rotations is None or estimate.rotations is None:
        return estimate
    notes = (*without_consensus(estimate.notes), *describe_consensus(model.rotations))
    return replace(estimate, rotations=model.rotations, notes=notes)


def _select_agreeing_images(
    model: Model, reconstruction: pycolmap.Reconstruction, consensus: RotationConsensus
) -> Model:
    """A model of the images that agree with the gyroscope; some of them may have been registered again."""
    facts = list(describe_consensus(consensus))
    if consensus.registered_again:
        facts.append(Fact("cameras-registered-again", names=consensus.registered_again))
    elif consensus.wrong and has_rigs(reconstruction):
        facts.append(Fact("rigs-not-registered-again"))
    reason = Fact("cameras-judged", facts=facts)
    log.info("model %d: %s", model.colmap_index, reason)
    done = Treatment(
        stage="rotations",
        reason=reason,
        action=Action.LEFT_OUT if consensus.left_out else Action.REGISTERED_AGAIN,
        values={"left_out": consensus.left_out, "registered_again": consensus.registered_again},
    )
    others = (consensus.list_part(number) for number in range(1, len(consensus.ref_from_part_xyzw)))
    return replace(
        model,
        reconstruction=deregister_images(reconstruction, consensus.left_out),
        torn_off=tuple(names for names in others if names),
        rotations=consensus,
        treatments=(*model.treatments, done),
    )


@dataclass(frozen=True, kw_only=True)
class MetricStage(InertialStage):
    """Scale, gravity and accelerometer bias from the IMU; a refused scale leaves the model as it is.

    See :class:`InertialStage` for the other attributes.

    Attributes
    ----------
    shutter
        What rectified the keypoints, where something did.
    """

    shutter: InvertibleStage | None = None

    @classmethod
    def for_run(cls, inputs: StageInputs) -> MetricStage:
        """The stage of a run."""
        return cls(**cls.fields_for(inputs), shutter=find_inverse(inputs.keypoint_stages))

    def __call__(self, model: Model, /) -> Model:
        """Estimate and apply the scale."""
        model, estimate, _ = self.estimate_scale(model)
        estimate = replace(estimate, notes=(*estimate.notes, *self.imu.repairs))
        if estimate.verdict == "refused":
            return model.scaled(estimate, None)
        return self.judge_shutter(model, estimate)

    def judge_shutter(self, model: Model, estimate: ScaleEstimate) -> Model:
        """A model in metres; where its images show a rolling shutter that it ignores, its scale says so.

        A declared readout, and declared intrinsics that were kept, are doubted where the images contradict them.
        """
        metric = self._apply(model, estimate)
        is_settled = model.timing.readout_s == 0 or model.rectified
        shows_readout = not model.rectified or self.shutter is not None
        if estimate.noise is None or not (shows_readout or self.keeps_intrinsics):
            return metric
        try:
            readout = self._find_readout(metric)
        except (NotObservableError, np.linalg.LinAlgError) as error:
            log.info("model %d: its shutter cannot be looked at: %s", model.colmap_index, error)
            readout = None
        if readout is None and is_settled:
            return metric
        if readout is None:
            return self._apply(model, replace(estimate, notes=(*estimate.notes, Fact("rolling-shutter-unknown"))))
        found = []
        contradicted = readout.compared(model.timing) if shows_readout else None
        if not is_settled or (not model.rectified and contradicted is not None):
            estimate = readout.widen(estimate, declared_global=is_settled)
            found += [readout.as_fact(declared_global=is_settled)] if readout.is_found else []
        if estimate.verdict == "refused":
            return model.scaled(estimate, None)
        if contradicted is not None and model.timing.readout_s:
            found.append(contradicted)
            estimate = add_doubts(estimate, found[-1:])
        if self.keeps_intrinsics and readout.focal is not None and readout.focal.contradicts:
            found.append(readout.focal.as_fact())
            estimate = add_doubts(estimate, found[-1:])
        if self.keeps_intrinsics and readout.lens is not None and readout.lens.contradicts:
            found.append(readout.lens.as_fact())
            estimate = add_doubts(estimate, found[-1:])
        metric = self._apply(model, estimate)
        for fact in found:
            done = Treatment(stage="shutter", reason=fact, values=dict(fact.values))
            log.info("model %d: %s", model.colmap_index, done.reason)
            metric = replace(metric, treatments=(*metric.treatments, done))
        return metric

    def _apply(self, model: Model, estimate: ScaleEstimate) -> Model:
        """A model in metres, whose provenance has the verdict with the model's doubts."""
        model = replace(model, scale=estimate)
        assert model.scale is not None
        similarity = Similarity.from_scale(model.scale, world=self.world, provenance=provenance(model.scale))
        return model.scaled(estimate, similarity)

    def _find_readout(self, model: Model) -> SeenReadout | None:
        """The readout of a metric model's images, of those in the middle of a long one."""
        reconstruction, timing = model.reconstruction, model.timing
        t_of = dict(zip(timing.names, timing.pose_t_s().tolist(), strict=True))
        images = [reconstruction.image(i) for i in reconstruction.reg_image_ids()]
        # cameras of a rig have readouts of their own; the scale is that of the reference
        images = [image for image in images if image.name in t_of and image.is_ref_in_frame()]
        images.sort(key=lambda image: t_of[image.name])
        first = max(0, (len(images) - SHUTTER_LIMITS.most_images) // 2)
        chosen = [image.image_id for image in images[first : first + SHUTTER_LIMITS.most_images]]
        if not chosen:
            return None
        known = self.known_of(model, refine_intrinsics=True)
        cov = known.prior.cov.copy()
        # what was declared may be of another recording mode: images tell
        cov[CAL.READOUT, :] = cov[:, CAL.READOUT] = 0.0
        cov[CAL.READOUT, CAL.READOUT] = SIGMAS.unknown_readout_s**2
        known = replace(known, prior=replace(known.prior, cov=cov))
        seen = read_seen(reconstruction, timing, chosen)
        shutter = self.shutter
        exposed_px = None if shutter is None or not model.rectified else partial(exposed_keypoints, model, shutter)
        with one_blas_thread():
            return find_readout(seen, timing, self.imu, known, exposed_px=exposed_px, find_lens=self.keeps_intrinsics)


def exposed_keypoints(model: Model, shutter: InvertibleStage, seen: Seen) -> Array:
    """(M, 2) observations of a model with rectified keypoints, in the images as they were exposed."""
    keypoints = {}
    for image_id, name in zip(seen.image_ids, seen.names, strict=True):
        points = model.reconstruction.image(image_id).points2D
        mapped = model.observed_px.get(name)
        xy_px = np.array([p.xy for p in points]).reshape(-1, 2) if mapped is None else mapped
        keypoints[name] = shutter.as_exposed(name, xy_px)
    return keypoints_of(seen, keypoints)


def provenance(estimate: ScaleEstimate) -> str:
    """Source of an inertial scale, in words."""
    return f"inertial scale, method {estimate.method}, {estimate.verdict}"


def smooth_path(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    estimate: ScaleEstimate,
    gravity_in_world_m_s2: Array,
    *,
    also_at_s: Array | None = None,
) -> SmoothedTrajectory:
    """Smooth a metric path with what the scale estimate says of the IMU; gravity in the path's world.

    ``also_at_s``: instants without a pose, as in :func:`~colmap_inertial.motion.smooth.smooth_trajectory`.
    """
    if estimate.calibration is None:
        raise ValueError("a refused scale says nothing of the IMU")
    return smooth_trajectory(
        trajectory,
        imu,
        estimate.calibration,
        gravity_in_world_m_s2=gravity_in_world_m_s2,
        accel_bias_m_s2=estimate.accel_bias_m_s2,
        also_at_s=also_at_s,
    )


def metric_trajectory(trajectory: CameraTrajectory) -> CameraTrajectory:
    """The trajectory of a model that is in metres, said to be so."""
    return replace(trajectory, length_unit="m")


def gravity_in_model(model: Model) -> Array | None:
    """(3,) gravity in the world of a model as it came out of the model stages; ``None`` where unknown."""
    gravity = None if model.scale is None else model.scale.gravity_in_world_m_s2
    if gravity is None or model.similarity is None:
        return gravity
    return quat_rotate(model.similarity.rotation_xyzw, gravity)


def write_trajectory(
    path: Path, model: Model, trajectory: CameraTrajectory, imu: ImuRecording, place: OwnPlace | None = None
) -> None:
    """Write the metric camera path of a model as TUM text, its covariance and motion beside it.

    It is smoothed by the IMU; where a stage solved for the motion already, it is what that stage found.

    Parameters
    ----------
    path
        ``trajectory*.tum``; the covariance goes to ``trajectory*_cov.npz`` with ``t_s`` (T,), ``cov`` (T, 9, 9) of
        position, velocity and acceleration, of a refined model (K, 6, 6) of position and velocity, at 400 images at
        most; ``rotation_cov`` (T, 3, 3), world, left; and what positions and rotations are ``relative_to``. Velocities
        by frame go to :func:`motion_file`.
    model
        A model that a stage made metric.
    trajectory
        Its poses, in metres.
    imu
        The IMU recording.
    place
        Where the model's coordinates count from, if not from the origin; those in the file do.
    """
    estimate, gravity, place = model.scale, gravity_in_model(model), place or OwnPlace()
    if estimate is None or model.similarity is None or estimate.calibration is None or gravity is None:
        raise ValueError("only a metric model has a metric trajectory")
    target = path.with_name(f"{path.stem}_cov.npz")
    if model.motion is not None:
        # these poses contain the IMU already: smoothing them again would be worse and overconfident
        solved = model.motion.of(trajectory.names, trajectory.cam_in_world)
        write_tum(path, place.leave_path(trajectory))
        with_cov = [i for i, name in enumerate(trajectory.names) if name in solved.cov]
        cov = np.array([solved.cov[trajectory.names[i]] for i in with_cov]).reshape(-1, 9, 9)
        _write_covariance(target, trajectory.t_s[with_cov] + trajectory.epoch_ns * 1e-9, cov[:, :6, :6], cov[:, 6:, 6:])
        unknown = np.full(3, np.nan)
        velocity = np.array([solved.velocity_in_world.get(name, unknown) for name in trajectory.names])
    else:
        smoothed = smooth_path(trajectory, imu, estimate, gravity)
        write_tum(path, place.leave_path(smoothed))
        velocity = smoothed.velocity_in_world
        cov, rotation = _add_drift(model, smoothed, gravity)
        if model.parts and rotation is None:
            # smoothing knows nothing of how surely each part was placed
            log.info("%s: no covariance of a joined path is written; result.json has that of each part", path.name)
            target.unlink(missing_ok=True)
        else:
            _write_covariance(target, smoothed.t_s + smoothed.epoch_ns * 1e-9, cov, rotation)
    write_record(motion_file(path), _motion(model, trajectory, velocity, imu, estimate.calibration))


def _add_drift(model: Model, smoothed: SmoothedTrajectory, gravity: Array) -> tuple[Array, Array | None]:
    """(T, 9, 9) of position against the first image, velocity, acceleration, and (T, 3, 3) of rotation.

    What smoothing leaves is far less than what images bend a path by. Where that is too much work, or images do not
    determine it, the smoother's own covariance, and none of rotations.
    """
    assert model.similarity is not None
    seen = read_seen(model.reconstruction, model.timing)
    timed = np.isfinite(seen.t_s)
    several = has_rigs(model.reconstruction)
    if several:
        log.info("several cameras took the images: the path's covariance is that of its smoothing, without drift")
    drift, similarity_cov = None, model.similarity.cov.copy()
    if model.parts:
        drift = _join_drift(seen, model.joined_covs)
    elif not several:
        drift = find_path_drift(seen, gravity)
    if drift is None or int(timed.sum()) != len(smoothed.t_s):
        return smoothed.cov, None
    velocity = np.zeros_like(seen.cam_in_world)
    local = np.zeros((len(velocity), 3, 3))
    velocity[timed], local[timed] = smoothed.velocity_in_world, smoothed.cov[:, 3:6, 3:6]
    if model.parts:
        # the scales of the parts are in the covariance of positions
        local += similarity_cov[0, 0] * velocity[:, :, None] * velocity[:, None, :]
        similarity_cov[0] = similarity_cov[:, 0] = 0.0
    motion = drift.motion_covs(similarity_cov, velocity, local)[timed]
    cov = np.zeros_like(smoothed.cov)
    cov[:, :6, :6], cov[:, 6:, 6:] = motion[:, :6, :6], smoothed.cov[:, 6:, 6:]
    return cov, motion[:, 6:, 6:]


def find_path_drift(seen: Seen, gravity: Array) -> ImageDrift | None:
    """Drift of a metric path; ``None`` where images do not determine it, or that takes too much work."""
    try:
        return find_drift(seen, gravity / np.linalg.norm(gravity))
    except np.linalg.LinAlgError:
        return None


def _join_drift(seen: Seen, covs: Mapping[str, Array]) -> ImageDrift | None:
    """Covariance of a joined path; ``None`` where that of an image is unknown."""
    if not all(name in covs for name in seen.names):
        return None
    cov = np.array([covs[name] for name in seen.names])
    return ImageDrift(names=seen.names, cam_in_world=seen.cam_in_world, cov=cov)


def _write_covariance(target: Path, t_s: Array, cov: Array, rotation: Array | None) -> None:
    partial = target.with_name(f"{target.stem}.partial.npz")
    values = {"t_s": t_s, "cov": cov, "relative_to": np.array("neighbouring images")}
    if rotation is not None:
        values |= {"rotation_cov": rotation, "relative_to": np.array("first image")}
    np.savez_compressed(partial, allow_pickle=False, **values)
    os.replace(partial, target)


def motion_file(trajectory: Path) -> Path:
    """File of the motion during each frame (``types.CameraMotion``), beside a path."""
    return trajectory.with_name(f"{trajectory.stem}_motion.json")


def _motion(
    model: Model,
    trajectory: CameraTrajectory,
    velocity_in_world: Array,
    imu: ImuRecording,
    calibration: CameraImuCalibration,
) -> CameraMotion:
    """Velocities of a model's frames, but those during which the gyroscope was silent, and those that are nan."""
    timing, solved = model.timing, model.motion
    timed = CameraTimedImu.from_recording(imu, calibration, timing.epoch_ns)
    camera = GyroCamera.from_timed(timed)
    place = {name: i for i, name in enumerate(timing.names)}
    index = np.array([place[name] for name in trajectory.names])
    exposure_s = None if timing.exposure_s is None else timing.exposure_s[index]
    half_s = max(_LIMITS.rate_half_s, _LIMITS.rate_samples * float(np.median(np.diff(timed.imu.gyro_t_s))))
    begin_s, end_s = trajectory.t_s - half_s, trajectory.t_s + half_s
    seen = camera.covers(begin_s, end_s) & np.isfinite(velocity_in_world).all(axis=1)
    before, after = (camera.start_from_cam(t_s[seen]) for t_s in (begin_s, end_s))
    rate = so3_log(np.swapaxes(before, 1, 2) @ after) / (2 * half_s)
    return CameraMotion(
        names=tuple(name for name, kept in zip(trajectory.names, seen, strict=True) if kept),
        t_s=trajectory.t_s[seen],
        velocity_in_world_m_s=velocity_in_world[seen],
        angular_velocity_in_cam_rad_s=rate,
        exposure_s=None if exposure_s is None else exposure_s[seen],
        readout_s=timing.readout_s if solved is None or solved.readout_s is None else solved.readout_s,
        readout_direction=timing.readout_direction,
        epoch_ns=trajectory.epoch_ns,
    )


def calibration_of_rectified(calibration: CameraImuCalibration) -> CameraImuCalibration:
    """The calibration of a camera whose keypoints were rectified: hardly any readout is left.

    Its standard deviation stands for what the camera's translation does within the readout, which stays.
    """
    cov = calibration.cov.copy()
    cov[CAL.READOUT, :] = cov[:, CAL.READOUT] = 0.0
    cov[CAL.READOUT, CAL.READOUT] = max(SIGMAS.smallest_readout_s, _LIMITS.readout_share * calibration.readout_s) ** 2
    return replace(calibration, readout_s=0.0, cov=cov)
