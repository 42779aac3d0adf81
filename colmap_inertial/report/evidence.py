"""What sensors say of the scale, in words and as rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from colmap_inertial.messages.sensors import name_of


@dataclass(frozen=True, kw_only=True)
class EvidenceRow:
    """One sensor, or all together.

    Attributes
    ----------
    sensor
        What it is called.
    metres_per_unit, ci95
        Its scale; ``None`` where it gave none.
    text
        In words.
    """

    sensor: str
    metres_per_unit: float | None
    ci95: tuple[float, float] | None
    text: str


#: Sensors in the order in which they are shown.
_ORDER = ("imu", "depth", "positions", "target", "distance", "device")


def evidence_rows(sensors: Mapping[str, Any]) -> tuple[EvidenceRow, ...]:
    """Rows of the table of sensors, of ``CombinedScale.as_json``."""
    rows = [_row(one) for one in sorted(sensors["evidence"], key=lambda one: _ORDER.index(one["sensor"]))]
    rows += [
        EvidenceRow(
            sensor=name_of(one["sensor"]), metres_per_unit=None, ci95=None, text=f"none: {'; '.join(one['reasons'])}"
        )
        for one in sensors["absent"]
    ]
    scale, ci95 = float(sensors["metres_per_unit"]), (float(sensors["ci95"][0]), float(sensors["ci95"][1]))
    rows.append(EvidenceRow(sensor="combined", metres_per_unit=scale, ci95=ci95, text=_in_words(scale, ci95)))
    return tuple(rows)


def _row(one: Mapping[str, Any]) -> EvidenceRow:
    scale, ci95 = float(one["metres_per_unit"]), (float(one["ci95"][0]), float(one["ci95"][1]))
    own = sum(float(sigma) ** 2 for sigma in one["systematic_sigma_log"].values()) ** 0.5
    made_of = f"random {196 * one['random_sigma_log']:.2g} %, systematic {196 * own:.2g} %"
    text = f"{_in_words(scale, ci95)}; {made_of}; weight {100 * one['share']:.0f} %"
    return EvidenceRow(sensor=name_of(one["sensor"]), metres_per_unit=scale, ci95=ci95, text=text)


def _in_words(scale: float, ci95: Sequence[float]) -> str:
    return f"{scale:.5g} ({ci95[0]:.5g} to {ci95[1]:.5g})"


def device_in_words(device: Mapping[str, Any]) -> str:
    """How wrong the device's own metres are."""
    percent = 100 * (device["length_ratio"] - 1)
    half = 50 * (device["ci95"][1] - device["ci95"][0])
    way = "short" if percent < 0 else "long"
    return (
        f"{abs(percent):.1f} % too {way} (+-{half:.1f} % points), {abs(device['error_m']):.2g} m over a path of "
        f"{device['length_m']:.3g} m"
    )


def evidence_facts(sensors: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The rows as labelled texts."""
    return [(row.sensor, row.text) for row in evidence_rows(sensors)]
