"""Outputs beside the result: an existing project in metres, and dense reconstructions."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from colmap_inertial.colmap.dense.depth_maps import digest_of_model, model_of
from colmap_inertial.core.errors import OutputError, OutputExistsError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ProjectOptions
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import check_names, path_in, read_json, read_record, write_json, write_record
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.model import TRANSFORM_FILE, model_files, model_format, model_formats, read_model, write_files
from colmap_inertial.model.project import apply_to_project
from colmap_inertial.model.similarities import ModelScale
from colmap_inertial.run.steps.session import Session
from colmap_inertial.run.steps.workspace import Workspace

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class _PlacedPaths:
    """Paths in the output folder that came from the project."""

    paths: tuple[str, ...]


def require_free_names(project: Path, workspace: Workspace, *, dense: bool) -> None:
    """Raise :class:`OutputError` where something of a project would lie where the run writes, too."""
    for path in sorted(project.iterdir()):
        if workspace.is_own(path.name):
            raise OutputError(Fact("name-needed-by-output", path=str(path)))
    if dense and (project / workspace.dense.name).exists():
        raise OutputError(Fact("dense-comes-along", folder=str(project / workspace.dense.name)))


def place_project(
    session: Session,
    project: Path,
    source: ProjectOptions,
    submodels: Mapping[int, Path],
    scales: Mapping[int | None, ModelScale],
) -> Path | None:
    """The whole project in metres around the metric models, which are there; ``None`` where every scale was refused.

    Everything keeps its path in the project, but the sub-models lie in ``sparse/`` by COLMAP's numbers. What has a
    refused scale is left out, with all that was made from it.

    Raises
    ------
    OutputExistsError
        Where something of the run's own stands in the way.
    """
    workspace = session.workspace
    scratch = workspace.stamps / "project"
    remove(scratch)  # of a run that was killed
    if all(scale.similarity is None for scale in scales.values()):
        remove_placed(workspace)
        return None

    def work(_: object) -> None:
        applied = apply_to_project(
            project,
            scratch,
            scales,
            link=source.link,
            keep=source.keep,
            follow_links=source.follow_links,
            only_metric=True,
            progress=lambda done, total: session.progress("apply", done, total),
        )
        for note in applied.notes:
            log.info("%s", note)
        folders = {index: submodels[index].relative_to(project) for index in applied.models}
        _correct_record(scratch / TRANSFORM_FILE, workspace, folders)
        moves = _plan_moves(workspace, scratch, folders)
        remove_placed(workspace)
        for target in moves:
            if os.path.lexists(target):
                raise OutputExistsError(Fact("place-taken", path=str(target)))
        paths = [target.relative_to(workspace.root).as_posix() for target in moves]
        write_record(workspace.placed, _PlacedPaths(paths=tuple(paths)))
        for target, moved in moves.items():
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(moved, target)
        remove(scratch)

    depends = {
        "scales": {str(index): scale.similarity for index, scale in scales.items()},
        "project": fingerprint(project),
        "source": source,
    }
    session.runner.run("apply", depends, [], work, beside=lambda: [workspace.placed, *list_placed_paths(workspace)])
    return workspace.root


def list_placed_paths(workspace: Workspace) -> list[Path]:
    """Paths in the folder that came from the project; a killed run may have left part of it."""
    if not workspace.placed.is_file():
        return []
    names = read_record(workspace.placed, _PlacedPaths).paths
    check_names(names, workspace.placed)
    for folder in {PurePosixPath(name).parent.as_posix() for name in names} - {"."}:
        path_in(workspace.root, folder, workspace.placed)
    return [workspace.root / name for name in names]


def remove_placed(workspace: Workspace) -> None:
    """Take away what came from the project."""
    for path in list_placed_paths(workspace):
        remove(path)
    workspace.placed.unlink(missing_ok=True)


def _correct_record(path: Path, workspace: Workspace, folders: Mapping[int, Path]) -> None:
    """Have the project's record say where the sub-models lie here, and what in the folder is not of the project."""
    record = read_json(path)
    here = {str(folder): f"{workspace.sparse.name}/{index}" for index, folder in folders.items()}
    for model in record["models"]:
        model["folder"] = here[model["folder"]]
    for change in record["files"]:
        if change["kind"].startswith("model"):
            change["path"] = here.get(change["path"], change["path"])
    write_json(path, {**record, "beside": list(workspace.own_names)})


def _plan_moves(workspace: Workspace, scratch: Path, folders: Mapping[int, Path]) -> dict[Path, Path]:
    """Destination of each part of the transformed project, without the metric models.

    A model that is there in the other format, too, is written again: a model stage may have changed it.
    """
    moves: dict[Path, Path] = {}
    done = {scratch / folder for folder in folders.values()}
    for index, folder in folders.items():
        place, inside = workspace.sparse / str(index), scratch / folder
        own, others = model_format(place), model_formats(inside)
        for suffix in others:
            if suffix == own:
                for file in model_files(inside, suffix):
                    remove(file)
            else:
                write_files(read_model(place), inside, suffix)
                if inside == scratch:
                    moves |= {place / file.name: file for file in model_files(inside, suffix)}
        if inside != scratch:
            moves |= {place / path.name: path for path in inside.iterdir() if path.name != TRANSFORM_FILE}
    for path in scratch.iterdir():
        if path in done or path in moves.values():
            continue
        if path.name == workspace.sparse.name:
            moves |= {workspace.sparse / inner.name: inner for inner in path.iterdir() if inner not in done}
        else:
            moves[workspace.root / path.name] = path
    return moves


def withdraw(workspace: Workspace) -> None:
    """Take away everything metric: there is no accepted scale, or none any more."""
    remove_stale_dense(workspace, {})
    remove_placed(workspace)
    for path in (workspace.sparse, *workspace.trajectories()):
        remove(path)


def remove_stale_dense(workspace: Workspace, models: Mapping[int, Path]) -> None:
    """Remove each dense reconstruction of ours that was made from another model than the one that is there.

    Parameters
    ----------
    workspace
        The output folder.
    models
        The metric models that are there, by their numbers.
    """
    if workspace.dense in list_placed_paths(workspace):  # the project's own goes with its models
        return
    digests = {str(index): digest_of_model(model) for index, model in models.items()}
    for folder in sorted(workspace.dense.glob("*")):
        made_from = model_of(folder)
        if made_from is not None and made_from != digests.get(folder.name):
            steps = workspace.stamps.glob(f"dense_{folder.name}_*.json")
            for path in (*steps, workspace.stamps / f"sweep_{folder.name}", folder):
                remove(path)
    if workspace.dense.is_dir() and not any(workspace.dense.iterdir()):
        workspace.dense.rmdir()
