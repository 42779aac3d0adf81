"""The default model stage: scale and gravity from the IMU; and the smoothed trajectory of what it made."""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.align import on_camera_rate
from colmap_inertial.geometry import quat_rotate
from colmap_inertial.io.trajectories import write_tum
from colmap_inertial.model import Model, apply_similarity, read_model, trajectory_from_model
from colmap_inertial.options import ScaleOptions, WorldAxes
from colmap_inertial.scale import estimate_scale
from colmap_inertial.smooth import smooth_trajectory
from colmap_inertial.types import (
    Array,
    CameraImuCalibration,
    CameraTrajectory,
    ImuRecording,
    ScaleEstimate,
    Similarity,
    SmoothedTrajectory,
)


@dataclass(frozen=True, kw_only=True)
class MetricStage:
    """Scale, gravity and accelerometer bias from the IMU; a refused scale leaves the model as it is.

    Attributes
    ----------
    imu
        The recording that ran along.
    calibration
        What is known of the camera and the IMU beforehand.
    options
        Of the scale estimate.
    world
        Where gravity points in the metric model.
    doubts
        What was found wrong with the recording beforehand; with any of them, no scale is trusted.
    """

    imu: ImuRecording
    calibration: CameraImuCalibration | None
    options: ScaleOptions
    world: WorldAxes
    doubts: tuple[str, ...] = ()

    def __call__(self, model: Model, /) -> Model:
        """Estimate and apply the scale."""
        trajectory, notes = trajectory_from_model(read_model(model.folder), model.timing)
        estimate = estimate_scale(trajectory, self.imu, calibration=self.calibration, options=self.options)
        estimate = dataclasses.replace(estimate, reasons=(*self.doubts, *estimate.reasons, *self.imu.repairs, *notes))
        if self.doubts and estimate.verdict == "trusted":
            estimate = dataclasses.replace(estimate, verdict="weak")
        if estimate.verdict == "refused":
            return dataclasses.replace(model, scale=estimate)
        similarity = Similarity.from_scale(
            estimate, world=self.world, provenance=f"inertial scale, method {estimate.method}, {estimate.verdict}"
        )
        metric = model.folder.with_name(model.folder.name + "_metric")
        apply_similarity(model.folder, metric, similarity)
        return dataclasses.replace(model, folder=metric, scale=estimate, similarity=similarity)


def smoothed_path(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    estimate: ScaleEstimate,
    gravity_in_world_m_s2: Array,
    *,
    also_at_s: Array | None = None,
) -> SmoothedTrajectory:
    """Smooth a metric path with what the scale estimate says of the IMU; gravity in the path's world.

    ``also_at_s``: instants without a pose, as in :func:`~colmap_inertial.smooth.smooth_trajectory`.
    """
    if estimate.calibration is None:
        raise ValueError("a refused scale says nothing of the IMU")
    if estimate.clock_rate != 0:
        imu = on_camera_rate(
            imu,
            estimate.calibration,
            clock_rate=estimate.clock_rate,
            middle_s=estimate.clock_middle_s,
            trajectory_epoch_ns=trajectory.epoch_ns,
        )
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
    return dataclasses.replace(trajectory, length_unit="m")


def gravity_in_model(model: Model) -> Array | None:
    """(3,) gravity in the world of a model as it came out of the model stages; ``None`` where unknown."""
    gravity = None if model.scale is None else model.scale.gravity_in_world_m_s2
    if gravity is None or model.similarity is None:
        return gravity
    return quat_rotate(model.similarity.rotation_xyzw, gravity)


def write_trajectory(path: Path, model: Model, trajectory: CameraTrajectory, imu: ImuRecording) -> None:
    """Write the smoothed metric camera path of a model as TUM text, and its covariance beside it.

    Parameters
    ----------
    path
        ``trajectory*.tum``; the covariance goes to ``trajectory*_cov.npz`` with ``t_s`` (T,) and ``cov`` (T, 9, 9) of
        position, velocity and acceleration.
    model
        A model that a stage made metric.
    trajectory
        Its poses, in metres.
    imu
        The recording that ran along.
    """
    estimate, gravity = model.scale, gravity_in_model(model)
    if estimate is None or model.similarity is None or estimate.calibration is None or gravity is None:
        raise ValueError("only a metric model has a metric trajectory")
    smoothed = smoothed_path(trajectory, imu, estimate, gravity)
    write_tum(path, smoothed)
    target = path.with_name(f"{path.stem}_cov.npz")
    partial = target.with_name(f"{path.stem}_cov.partial.npz")
    np.savez_compressed(partial, t_s=smoothed.t_s + smoothed.epoch_ns * 1e-9, cov=smoothed.cov)
    os.replace(partial, target)
