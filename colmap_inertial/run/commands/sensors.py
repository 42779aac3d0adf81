"""What all sensors of a capture say of a scale, in one table."""

from __future__ import annotations

import dataclasses

from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.progress import Progress, silent
from colmap_inertial.core.types import CameraTrajectory, ScaleEstimate
from colmap_inertial.core.types.evidence import AbsentSensor, ScaleEvidence
from colmap_inertial.evidence.combine import combine, judge_device
from colmap_inertial.evidence.depth import scale_by_depth
from colmap_inertial.evidence.inertial import evidence_of_device, evidence_of_imu
from colmap_inertial.io.device_folders import DeviceFolder
from colmap_inertial.run.stages.sensors import cut_parts, why_absent, with_sensors


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
            absent.append(AbsentSensor(sensor="depth", reasons=(why_absent(error),)))
    if folder.is_metric:
        evidence.append(evidence_of_device())
    if not evidence:
        return by_imu
    combined = combine(evidence, absent)
    if folder.is_metric:
        combined = dataclasses.replace(combined, device=judge_device(combined, trajectory))
    return with_sensors(by_imu, combined)
