"""What all sensors of a capture say of a scale, in one table."""

from __future__ import annotations

import dataclasses
import math

from colmap_inertial.core.errors import InertialError, NotObservableError, fact_of
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.progress import Progress, silent
from colmap_inertial.core.types import CameraTrajectory, ScaleEstimate
from colmap_inertial.core.types.evidence import AbsentSensor, CombinedScale, ScaleEvidence
from colmap_inertial.evidence.combine import combine, judge_device
from colmap_inertial.evidence.depth import scale_by_depth
from colmap_inertial.evidence.inertial import evidence_of_device, evidence_of_imu
from colmap_inertial.io.device_folders import DeviceFolder

#: Parts of a path by which sensors are compared, so long, or as many as there are.
_PART_S, _MOST_PARTS = 4.0, 16


def scale_by_sensors(
    by_imu: ScaleEstimate, trajectory: CameraTrajectory, folder: DeviceFolder, *, progress: Progress = silent
) -> ScaleEstimate:
    """The scale of a device's own path by all that its export holds.

    Parameters
    ----------
    by_imu
        What the IMU says of it, also where it was refused.
    trajectory
        The device's path, or the part of it that counts.
    folder
        The export.
    progress
        Called with ``"depth"``.
    """
    evidence: list[ScaleEvidence] = []
    absent: list[AbsentSensor] = []
    span_s = float(trajectory.t_s[0]), float(trajectory.t_s[-1])
    if by_imu.verdict == "refused":
        absent.append(AbsentSensor(sensor="imu", reasons=by_imu.reasons))
    else:
        evidence.append(evidence_of_imu(by_imu, span_s))
    if folder.depth is not None:
        try:
            start = 0.0 if folder.is_metric else None
            found = scale_by_depth(folder.depth, trajectory, log_scale=start, progress=progress)
            evidence.append(found.evidence(cut_parts(trajectory)))
        except InertialError as error:
            absent.append(AbsentSensor(sensor="depth", reasons=(_why(error),)))
    if folder.is_metric:
        evidence.append(evidence_of_device())
    if not evidence:
        return by_imu
    combined = combine(evidence, absent)
    if folder.is_metric:
        combined = dataclasses.replace(combined, device=judge_device(combined, trajectory))
    return with_sensors(by_imu, combined)


def _why(error: InertialError) -> Fact:
    if isinstance(error, NotObservableError):
        return Fact("not-observable", quantity=error.quantity, why=error.fact)
    return fact_of(error)


def cut_parts(trajectory: CameraTrajectory) -> tuple[tuple[float, float], ...]:
    """Parts of a path, of equal length."""
    begin_s, end_s = float(trajectory.t_s[0]), float(trajectory.t_s[-1])
    count = min(_MOST_PARTS, max(1, math.floor((end_s - begin_s) / _PART_S)))
    step_s = (end_s - begin_s) / count
    return tuple((begin_s + k * step_s, begin_s + (k + 1) * step_s) for k in range(count))


def with_sensors(by_imu: ScaleEstimate, combined: CombinedScale) -> ScaleEstimate:
    """An estimate whose scale is that of all sensors; what else the IMU told stays."""
    cov = None
    if by_imu.cov is not None and by_imu.cov[0, 0] > 0:
        # what goes along with the scale does so in proportion
        factor = combined.sigma / math.sqrt(by_imu.cov[0, 0])
        cov = by_imu.cov.copy()
        cov[0, :] *= factor
        cov[:, 0] *= factor
    refused = combined.verdict == "refused"
    return dataclasses.replace(
        by_imu,
        metres_per_unit=None if refused else combined.metres_per_unit,
        sigma_log=None if refused else combined.sigma,
        ci95=None if refused else combined.ci95,
        verdict=combined.verdict,
        reasons=combined.reasons,
        cov=cov,
        sensors=combined,
    )
