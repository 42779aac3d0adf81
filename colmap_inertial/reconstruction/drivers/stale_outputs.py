"""What is metric stands in an output folder only while its model does."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from pathlib import Path

from colmap_inertial.colmap.dense import digest
from colmap_inertial.colmap.depth_maps import has_depth_maps, model_of
from colmap_inertial.pipeline.run.runner import remove
from colmap_inertial.pipeline.run.workspace import Workspace
from colmap_inertial.reconstruction.drivers.project_output import placed_paths, remove_placed

log = logging.getLogger(__name__)

#: In a reconstruction that is set aside: which of its steps are finished.
_STEPS = ".stages"


def withdraw(workspace: Workspace) -> None:
    """Take away everything metric: there is no accepted scale, or none any more."""
    remove_stale_dense(workspace, {})
    remove_placed(workspace)
    for path in (workspace.sparse, *workspace.trajectories()):
        remove(path)


def remove_stale_dense(workspace: Workspace, models: Mapping[int, Path]) -> None:
    """Leave no dense reconstruction beside a model that it was not made from.

    One with depth maps, which may have taken hours, is kept in ``earlier/``, and comes back when its model does (as
    with ``--world`` to and fro); any other of ours is removed. What somebody else made there is left alone.

    Parameters
    ----------
    workspace
        The output folder.
    models
        The metric models that are there, by their numbers.
    """
    places = [place for place in (workspace.dense, workspace.earlier) if place.is_dir()]
    if not places or workspace.dense in placed_paths(workspace):  # the project's own goes with its models
        return
    of = {index: digest(model) for index, model in models.items()}
    for folder in sorted(workspace.dense.glob("*")):
        known, index = model_of(folder), int(folder.name) if folder.name.isdecimal() and folder.name.isascii() else -1
        if known is None or known == of.get(index):
            continue
        steps = list(workspace.stamps.glob(f"dense_{folder.name}_*.json"))
        if has_depth_maps(folder):
            (folder / _STEPS).mkdir(exist_ok=True)
            for step in steps:
                os.replace(step, folder / _STEPS / step.name)
            aside = _free_name(workspace.earlier / workspace.dense.name / folder.name)
            aside.parent.mkdir(parents=True, exist_ok=True)
            os.replace(folder, aside)
            log.warning("the depth maps in %s are not of the model that is there now: kept in %s", folder, aside)
        else:
            for path in (*steps, workspace.stamps / f"sweep_{folder.name}", folder):
                remove(path)
    for index, known in of.items():
        place = workspace.dense / str(index)
        back = (path for path in sorted(workspace.earlier.glob("*/*")) if model_of(path) == known)
        if not place.exists() and (found := next(back, None)) is not None:
            place.parent.mkdir(exist_ok=True)
            os.replace(found, place)
            log.info("the dense reconstruction in %s is of the model that is there now: %s", found, place)
        if (place / _STEPS).is_dir() and model_of(place) == known:
            for step in (place / _STEPS).glob(f"dense_{index}_*.json"):
                os.replace(step, workspace.stamps / step.name)
            remove(place / _STEPS)
    for folder in (workspace.earlier / workspace.dense.name, workspace.earlier, workspace.dense):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def _free_name(path: Path) -> Path:
    """The path, or the first of it with a number behind that is free."""
    count = 1
    while (named := path if count == 1 else path.with_name(f"{path.name}-{count}")).exists():
        count += 1
    return named
