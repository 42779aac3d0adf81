"""The model stage that lets all sensors of a capture say what they know of the scale, and takes them together."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import InertialError, NotObservableError, fact_of
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_rotate, rotation_between
from colmap_inertial.core.options import ValidateOptions, WorldAxes
from colmap_inertial.core.progress import Progress, silent
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import DOWN_IN_WORLD, CameraTrajectory, ScaleEstimate, Similarity
from colmap_inertial.core.types.evidence import AbsentSensor, CombinedScale, ScaleEvidence, ScalePart, Sensor
from colmap_inertial.evidence.combine import combine, judge_device
from colmap_inertial.evidence.depth_points import scale_by_points
from colmap_inertial.evidence.device_path import DevicePath, place_device_path, up_by_device
from colmap_inertial.evidence.inertial import evidence_of_imu
from colmap_inertial.evidence.positions import scale_by_positions
from colmap_inertial.inertial.scale.verdict import half_width
from colmap_inertial.io.units import STANDARD_GRAVITY_M_S2
from colmap_inertial.model import Model, add_doubts, trajectory_from_model
from colmap_inertial.model.seen_points import seen_points
from colmap_inertial.run.stages.capture_sensors import CaptureSensors, SeenTarget
from colmap_inertial.run.stages.inputs import StageInputs
from colmap_inertial.run.stages.known_lengths import scale_by_distance, scale_by_target
from colmap_inertial.validate import Validation, parse_target, validate_model

log = logging.getLogger(__name__)

#: Parts of a path by which sensors are compared, so long, or as many as there are.
_PART_S, _MOST_PARTS = 4.0, 16
#: A sensor that leaves more of the scale open than this (half-width) says nothing worth weighing.
_TELLS = 0.30
#: Standard deviation of the vertical of a device's own world (rad): ARKit keeps it by the accelerometer.
_DEVICE_TILT_RAD = math.radians(1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorsOfModel:
    """What the sensors of a capture say of one model.

    Attributes
    ----------
    evidence
        Of each that says something; in the model's units.
    absent
        Why the others say nothing.
    device
        The device's own path, where it fits the model's.
    up_in_world
        (3,) against gravity in the model's world, where some sensor tells, and its standard deviation (rad).
    tilt_rad
        Its standard deviation.
    up_from
        Which one tells.
    """

    evidence: tuple[ScaleEvidence, ...] = ()
    absent: tuple[AbsentSensor, ...] = ()
    device: CameraTrajectory | None = None
    up_in_world: Array | None = None
    tilt_rad: float = 0.0
    up_from: Sensor | None = None


def ask_sensors(
    sensors: CaptureSensors,
    model: Model,
    path: CameraTrajectory,
    *,
    up_in_world: Array | None,
    log_scale: float | None,
    timed: bool = True,
    progress: Progress = silent,
) -> SensorsOfModel:
    """What depth, the device's own path, positions, a target and a known distance say of a model.

    Parameters
    ----------
    sensors
        Of the capture.
    model, path
        The model and its cameras, in its units.
    up_in_world
        (3,) against gravity, where the IMU tells.
    log_scale
        About what the logarithm of the scale is, where the IMU tells.
    timed
        Whether the path's times are true.
    progress
        Called with ``"depth"`` and ``"validation"``.
    """
    evidence: list[ScaleEvidence] = []
    absent = list(sensors.absent)
    parts = cut_parts(path) if timed else ()

    def attempt(sensor: Sensor, ask: Callable[[], ScaleEvidence]) -> None:
        try:
            said = ask()
        except InertialError as error:
            absent.append(AbsentSensor(sensor=sensor, reasons=(why_absent(error),)))
            return
        if (width := half_width(said.sigma)) > _TELLS:
            absent.append(AbsentSensor(sensor=sensor, reasons=(Fact("sensor-tells-little", half_width=width),)))
        else:
            evidence.append(said)

    if (maps := sensors.depth) is not None:

        def ask_depth() -> ScaleEvidence:
            times = dict(zip(path.names, path.t_s.tolist(), strict=True))
            having = set(maps.names) & times.keys()
            seen = seen_points(model.reconstruction, times, having)
            return scale_by_points(maps, seen, progress=progress).evidence(parts)

        attempt("depth", ask_depth)
    placed: list[DevicePath] = []
    tilt_rad = 0.0
    up_from: Sensor | None = None
    if (device := sensors.device) is not None:

        def ask_device() -> ScaleEvidence:
            placed.append(place_device_path(device, path, up_in_device=sensors.up_in_device, parts=parts))
            return placed[0].evidence

        attempt("device", ask_device)
    if up_in_world is None and placed and sensors.up_in_device is not None:
        up_in_world, tilt_rad, up_from = up_by_device(placed[0], sensors.up_in_device), _DEVICE_TILT_RAD, "device"
    if (fixes := sensors.fixes) is not None:
        about = log_scale if log_scale is not None else next((one.log_scale for one in evidence), None)
        found_up: list[tuple[Array, float]] = []

        def ask_positions() -> ScaleEvidence:
            found = scale_by_positions(fixes, path, up_in_world=up_in_world, log_scale=about, timed=timed)
            found_up.append((found.up_in_world, found.tilt_rad))
            return found.evidence

        attempt("positions", ask_positions)
        if up_in_world is None and found_up:
            (up_in_world, tilt_rad), up_from = found_up[0], "positions"

    @cache
    def measure(seen: SeenTarget) -> Validation:
        target, options = parse_target(seen.spec), ValidateOptions(unscaled=True)
        report = partial(progress, "validation")
        return validate_model(model.reconstruction, seen.images, target, options, progress=report)

    if (seen := sensors.target) is not None:

        def ask_target() -> ScaleEvidence:
            validation = measure(seen)
            if validation.doubts:
                raise NotObservableError("scale", Fact("found-together", found=validation.doubts))
            return scale_by_target(validation)[0]

        attempt("target", ask_target)
    if (known := sensors.distance) is not None:

        def ask_distance() -> ScaleEvidence:
            if known.lengths.has_points and model.parts:
                raise NotObservableError("distance", Fact("points-of-another-model"))
            if known.markers is not None:
                markers = measure(known.markers)
                return replace(scale_by_distance(known.lengths, markers)[0], reasons=markers.doubts)
            # points are those of COLMAP's model
            unit = 0.0 if model.similarity is None else math.log(model.similarity.scale)
            return _in_units(scale_by_distance(known.lengths, None)[0], -unit)

        attempt("distance", ask_distance)
    return SensorsOfModel(
        evidence=tuple(evidence),
        absent=tuple(absent),
        device=sensors.device if placed else None,
        up_in_world=up_in_world,
        tilt_rad=tilt_rad,
        up_from=up_from,
    )


def why_absent(error: InertialError) -> Fact:
    """Why a sensor says nothing."""
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
    return replace(
        by_imu,
        metres_per_unit=None if refused else combined.metres_per_unit,
        sigma_log=None if refused else combined.sigma,
        ci95=None if refused else combined.ci95,
        verdict=combined.verdict,
        reasons=combined.reasons,
        cov=cov,
        sensors=combined,
    )


@dataclass(frozen=True, kw_only=True)
class SensorStage:
    """Takes the IMU's scale of a model together with what the capture's other sensors say of it.

    The last of the stages: what the IMU decides (joining, refinement) is done. A model whose scale the IMU left open
    becomes metric where others know it.

    Attributes
    ----------
    sensors
        Of the capture.
    imu
        Whether the IMU's scale counts.
    world
        Where gravity points in the metric model.
    """

    sensors: CaptureSensors
    imu: bool = True
    world: WorldAxes = "z-up"

    @classmethod
    def for_run(cls, inputs: StageInputs) -> SensorStage | None:
        """The stage of a run, where the capture has other sensors that count."""
        if inputs.sensors is None or not inputs.sensors:
            return None
        chosen = inputs.options.scale_from
        return cls(
            sensors=inputs.sensors,
            imu=not chosen or "imu" in chosen,
            world=inputs.options.world,
        )

    def __call__(self, model: Model, /) -> Model:
        """The model by all sensors."""
        by_imu = model.scale
        if by_imu is None:
            raise ValueError("sensors are asked after the stage that estimates the scale")
        path, _ = trajectory_from_model(model.reconstruction, model.timing, covariances=False)
        # what is measured in the model counts in its units; the estimate, in those of COLMAP
        unit = 0.0 if model.similarity is None else math.log(model.similarity.scale)
        up = None if model.similarity is None else -_down(by_imu, model.similarity)
        said = ask_sensors(
            self.sensors,
            model,
            path,
            up_in_world=up,
            log_scale=None if model.similarity is None else 0.0,
        )
        evidence, absent = [_in_units(one, unit) for one in said.evidence], list(said.absent)
        if by_imu.verdict == "refused":
            absent.insert(0, AbsentSensor(sensor="imu", reasons=by_imu.reasons))
        elif self.imu:
            evidence.insert(0, evidence_of_imu(by_imu, (float(path.t_s[0]), float(path.t_s[-1]))))
        else:
            absent.insert(0, AbsentSensor(sensor="imu", reasons=(Fact("sensor-not-asked"),)))
        if not evidence:
            return model
        combined = combine(evidence, absent)
        if said.device is not None:
            combined = replace(combined, device=judge_device(combined, said.device))
        log.info(
            "model %d: %.5g m per unit by %s",
            model.colmap_index,
            combined.metres_per_unit,
            ", ".join(one.sensor for one in combined.evidence),
        )
        if by_imu.verdict == "refused":
            return self._make_metric(model, with_sensors(by_imu, combined), said)
        if len(evidence) == 1 and self.imu:
            # nobody else says anything: the scale is as it was, and the result says why
            return replace(model, scale=replace(by_imu, sensors=combined))
        if combined.verdict == "refused":
            # so far apart that no interval holds both: the IMU's metres stay, in doubt
            return replace(model, scale=add_doubts(replace(by_imu, sensors=combined), combined.reasons))
        assert model.similarity is not None
        return model.rescaled(with_sensors(by_imu, combined), combined.metres_per_unit / model.similarity.scale)

    def _make_metric(self, model: Model, estimate: ScaleEstimate, said: SensorsOfModel) -> Model:
        """A model that the IMU gave no scale, in metres by the others."""
        if estimate.metres_per_unit is None or estimate.sigma_log is None:
            return replace(model, scale=estimate)
        similarity, note = turn_up(estimate.metres_per_unit, estimate.sigma_log, said, self.world)
        gravity = None if said.up_in_world is None else -STANDARD_GRAVITY_M_S2 * said.up_in_world
        estimate = replace(estimate, gravity_in_world_m_s2=gravity, notes=(*estimate.notes, note))
        return model.scaled(estimate, similarity)


def turn_up(
    metres_per_unit: float, sigma_log: float, said: SensorsOfModel, world: WorldAxes
) -> tuple[Similarity, Fact]:
    """The similarity that makes a model metric by sensors beside the IMU, and what is known of its vertical."""
    cov = np.zeros((7, 7))
    cov[0, 0] = sigma_log**2
    names = ", ".join(one.sensor for one in said.evidence)
    rotation, note = np.array([0.0, 0.0, 0.0, 1.0]), Fact("up-unknown-without-imu")
    if said.up_in_world is not None:
        down = DOWN_IN_WORLD[world]
        rotation = rotation_between(-said.up_in_world, down)
        cov[1:4, 1:4] = said.tilt_rad**2 * (np.eye(3) - np.outer(down, down))
        note = Fact("up-by-sensor", sensor=said.up_from, half_width_deg=math.degrees(Z95 * said.tilt_rad))
    return (
        Similarity(
            scale=metres_per_unit,
            rotation_xyzw=rotation,
            translation_m=np.zeros(3),
            cov=cov,
            provenance=f"scale by {names}",
        ),
        note,
    )


def _down(estimate: ScaleEstimate, similarity: Similarity) -> Array:
    """(3,) unit vector along gravity in the world of a metric model."""
    assert estimate.gravity_in_world_m_s2 is not None
    gravity = quat_rotate(similarity.rotation_xyzw, estimate.gravity_in_world_m_s2)
    return np.asarray(gravity / np.linalg.norm(gravity))


def _in_units(one: ScaleEvidence, unit: float) -> ScaleEvidence:
    """Evidence of a model of another unit, whose logarithm in units of that model is ``unit``."""
    parts: Sequence[ScalePart] = [replace(part, log_scale=part.log_scale + unit) for part in one.parts]
    return replace(one, log_scale=one.log_scale + unit, parts=tuple(parts))
