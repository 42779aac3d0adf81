"""What sensors say of a model's scale, each by itself and all together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from colmap_inertial.core.arrays import set_fields
from colmap_inertial.core.facts import Fact, with_sentences
from colmap_inertial.core.options import ScaleFrom
from colmap_inertial.core.quantiles import Z95

Verdict = Literal["trusted", "weak", "refused"]
#: ``device``: poses that the device itself computed (ARKit, ARCore); ``positions``: of a satellite receiver.
Sensor = ScaleFrom


@dataclass(frozen=True, kw_only=True)
class ScalePart:
    """Scale in a part of the recording.

    Attributes
    ----------
    begin_s, end_s
        The part, camera clock, seconds since the trajectory's epoch.
    log_scale, sigma
        Logarithm of metres per unit, and the standard deviation of what is random in it.
    """

    begin_s: float
    end_s: float
    log_scale: float
    sigma: float

    def as_json(self) -> dict[str, float]:
        """The fields."""
        return {
            "begin_s": self.begin_s,
            "end_s": self.end_s,
            "metres_per_unit": math.exp(self.log_scale),
            "sigma_log": self.sigma,
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaleEvidence:
    """What one sensor says of the scale.

    Attributes
    ----------
    sensor
        Which one.
    log_scale
        Logarithm of metres per unit.
    random_sigma
        Standard deviation of what another recording, or a longer one, would average out.
    systematic
        By cause, standard deviation of what it would not: the sensor's own. A cause that several sensors have is one
        error, which is in all of them.
    begin_s, end_s
        When it holds, camera clock, seconds since the trajectory's epoch; ``None``: throughout.
    parts
        The scale by parts of the recording.
    reasons
        Why it is in doubt by itself.
    """

    sensor: Sensor
    log_scale: float
    random_sigma: float
    systematic: Mapping[str, float] = field(default_factory=dict)
    begin_s: float | None = None
    end_s: float | None = None
    parts: tuple[ScalePart, ...] = ()
    reasons: tuple[Fact, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.log_scale, self.random_sigma, *self.systematic.values())
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError("evidence of scale must be finite")
        if min(numbers[1:]) < 0 or not self.sigma > 0:
            raise ValueError("standard deviations must not be negative, and not all of them zero")
        set_fields(self, systematic=MappingProxyType(dict(self.systematic)), parts=tuple(self.parts))

    @property
    def systematic_sigma(self) -> float:
        """Standard deviation of all that is the sensor's own."""
        return math.sqrt(sum(sigma**2 for sigma in self.systematic.values()))

    @property
    def sigma(self) -> float:
        """Standard deviation of the logarithm of the scale."""
        return math.hypot(self.random_sigma, self.systematic_sigma)

    @property
    def metres_per_unit(self) -> float:
        """The scale."""
        return math.exp(self.log_scale)

    @property
    def ci95(self) -> tuple[float, float]:
        """Its 95 % interval."""
        return interval(self.log_scale, self.sigma)

    def as_json(self) -> dict[str, object]:
        """The fields in JSON types."""
        return {
            "sensor": self.sensor,
            "metres_per_unit": self.metres_per_unit,
            "ci95": list(self.ci95),
            "sigma_log": self.sigma,
            "random_sigma_log": self.random_sigma,
            "systematic_sigma_log": dict(self.systematic),
            "begin_s": self.begin_s,
            "end_s": self.end_s,
            "parts": [part.as_json() for part in self.parts],
            **with_sentences({"reasons": list(self.reasons)}),
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class AbsentSensor:
    """A sensor that was there and gave no scale.

    Attributes
    ----------
    sensor, reasons
        Which one, and why.
    """

    sensor: Sensor
    reasons: tuple[Fact, ...]

    def as_json(self) -> dict[str, object]:
        """The fields in JSON types."""
        return {"sensor": self.sensor, **with_sentences({"reasons": list(self.reasons)})}


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviceDrift:
    """How wrong the metres of the device's own path are, against all other sensors.

    Attributes
    ----------
    log_error, sigma
        Logarithm of its metres over true ones, negative where it is short, and the standard deviation.
    length_m, error_m
        Length of the path by the others, and how much longer the device has it.
    parts
        The same by parts of the recording, where the others tell: ``log_scale`` is the error.
    """

    log_error: float
    sigma: float
    length_m: float
    error_m: float
    parts: tuple[ScalePart, ...] = ()

    def as_json(self) -> dict[str, object]:
        """The fields in JSON types; ``length_ratio`` is the device's metres over true ones."""
        return {
            "length_ratio": math.exp(self.log_error),
            "ci95": list(interval(self.log_error, self.sigma)),
            "length_m": self.length_m,
            "error_m": self.error_m,
            "parts": [
                {
                    "begin_s": part.begin_s,
                    "end_s": part.end_s,
                    "length_ratio": math.exp(part.log_scale),
                    "sigma_log": part.sigma,
                }
                for part in self.parts
            ],
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class CombinedScale:
    """The scale by all sensors.

    Attributes
    ----------
    evidence
        Of each sensor.
    absent
        Sensors that gave none.
    log_scale, sigma
        Of all together, as normal distribution.
    shares
        (N,) how much each counts; they add up to one.
    p_value
        How probable it would be by chance that they are as far apart; one where there is a single one.
    faulty
        (N,) probability that each is wrong by more than its interval allows.
    verdict, reasons
        What to make of it.
    device
        How wrong the device's own metres are; ``None`` where it gives none, or nothing judges them.
    """

    evidence: tuple[ScaleEvidence, ...]
    absent: tuple[AbsentSensor, ...] = ()
    log_scale: float
    sigma: float
    shares: tuple[float, ...]
    p_value: float
    faulty: tuple[float, ...]
    verdict: Verdict
    reasons: tuple[Fact, ...] = ()
    device: DeviceDrift | None = None

    @property
    def metres_per_unit(self) -> float:
        """The scale."""
        return math.exp(self.log_scale)

    @property
    def ci95(self) -> tuple[float, float]:
        """Its 95 % interval."""
        return interval(self.log_scale, self.sigma)

    def of(self, sensor: Sensor) -> ScaleEvidence | None:
        """What a sensor says; ``None`` where it says nothing."""
        return next((one for one in self.evidence if one.sensor == sensor), None)

    def as_json(self) -> dict[str, object]:
        """The fields in JSON types."""
        rows = zip(self.evidence, self.shares, self.faulty, strict=True)
        return {
            "evidence": [{**one.as_json(), "share": share, "fault_probability": faulty} for one, share, faulty in rows],
            "absent": [one.as_json() for one in self.absent],
            "metres_per_unit": self.metres_per_unit,
            "ci95": list(self.ci95),
            "sigma_log": self.sigma,
            "p_value": self.p_value,
            "verdict": self.verdict,
            **with_sentences({"reasons": list(self.reasons)}),
            "device": None if self.device is None else self.device.as_json(),
        }


def interval(log_scale: float, sigma: float) -> tuple[float, float]:
    """95 % interval of a scale by its logarithm."""
    return math.exp(log_scale - Z95 * sigma), math.exp(log_scale + Z95 * sigma)
