"""Words of what is found in tables, bags and calibrations."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.core.messages import message


@message(
    advice='state date_order = "dmy" or "mdy" in the table of the sensor',
    example={"path": "log.csv", "example": "3/4/2024"},
)
def date_order_unknown(path: str, example: str) -> str:
    return f"{path}: nothing tells the day from the month in dates such as {example}"


@message(
    advice=lambda reason, hint: f"describe it in a capture.toml, where ? stands for what it does not say:\n{hint}",
    example={"reason": "has no header", "hint": "[imu.gyro]\n..."},
)
def table_unclear(reason: str, hint: str) -> str:
    return reason


def _listed(items: Sequence[str]) -> str:
    return ", ".join(items)
