"""Files in an output folder that hold data for the report alone."""

from __future__ import annotations

from pathlib import Path

DATA_FOLDER = "report_data"
CROPS_FOLDER = "crops"


def recording_file(out: Path) -> Path:
    """File of the report's data on the recording."""
    return out / DATA_FOLDER / "recording.json"


def model_file(out: Path, index: int) -> Path:
    """File of the report's data on one model."""
    return out / DATA_FOLDER / f"model_{index}.json"
