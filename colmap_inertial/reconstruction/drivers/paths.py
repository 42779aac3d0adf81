"""Paths that a command is given: the one model in a folder, and an output that replaces nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from colmap_inertial.core.errors import FormatError, OutputError, OutputExistsError
from colmap_inertial.io.files import read_json
from colmap_inertial.model import find_models


def only_model(path: Path) -> Path:
    """The one model in a folder.

    Raises
    ------
    FormatError
        Where there are several, or none; of a project, with the place of its models.
    """
    try:
        models = find_models(path)
    except FormatError:
        if not (path / "sparse").is_dir():
            raise
        inside = next(iter(find_models(path / "sparse").values()))
        raise FormatError(path, f"is a whole project: give one of its models, {inside}") from None
    if len(models) > 1:
        raise FormatError(
            path, f"holds {len(models)} models; give one of them, for example {next(iter(models.values()))}"
        )
    return next(iter(models.values()))


#: One of these is in every JSON file that a command writes.
_OURS = frozenset({"metres_per_unit", "cam_from_imu_xyzw", "accel_gain", "findings", "out", "exit_code"})


def check_output(path: Path, inputs: Sequence[Path | None]) -> None:
    """Refuse, before any work, an output that would replace anything but an earlier result of ours.

    Raises
    ------
    OutputError
    """
    if not path.parent.is_dir():
        raise OutputError(f"{path.parent} is no folder; create it first")
    if path.is_dir():
        raise OutputError(f"{path} is a folder; name a file in it")
    target = path.resolve()
    for known in inputs:
        if known is not None and target == known.resolve():
            raise OutputExistsError(f"{path} is an input; choose another name for the result")
    if path.exists():
        try:
            keys = set(read_json(path))
        except FormatError:
            keys = set()
        if not keys & _OURS:
            raise OutputExistsError(f"{path} exists and is no earlier result; choose another name or remove it")
