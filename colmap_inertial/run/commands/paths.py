"""Paths that a command is given: the one model in a folder, and an output that replaces nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from colmap_inertial.core.errors import FormatError, OutputError, OutputExistsError
from colmap_inertial.core.facts import Fact
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
        raise FormatError(path, Fact("is-a-project", model=str(inside))) from None
    if len(models) > 1:
        raise FormatError(path, Fact("holds-several-models", count=len(models), model=str(next(iter(models.values())))))
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
        raise OutputError(Fact("no-parent-folder", folder=str(path.parent)))
    if path.is_dir():
        raise OutputError(Fact("output-is-a-folder", path=str(path)))
    target = path.resolve()
    for known in inputs:
        if known is not None and target == known.resolve():
            raise OutputExistsError(Fact("output-is-an-input", path=str(path)))
    if path.exists():
        try:
            keys = set(read_json(path))
        except FormatError:
            keys = set()
        if not keys & _OURS:
            raise OutputExistsError(Fact("output-is-foreign", path=str(path)))
