"""The models of an existing project, what else was made from them, and whether they can be refined."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_inertial.core.errors import AlreadyMetricError, InertialError, OutputError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions
from colmap_inertial.model import is_metric
from colmap_inertial.model.copying import list_tree
from colmap_inertial.model.keeping import Kept
from colmap_inertial.model.layout import Layout, find_made_from, read_layout
from colmap_inertial.model.own_place import OwnPlace
from colmap_inertial.model.rigs import has_rigs

if TYPE_CHECKING:
    import pycolmap


def read_submodels(project: Path, out: Path, source: ProjectOptions) -> Layout:
    """The models of a project; what would stop ``apply`` at the end is said at once.

    Raises
    ------
    OutputError
        Where output folder and project lie within each other.
    AlreadyMetricError
        Where a model carries a similarity of ours.
    FormatError
        As of :func:`~colmap_inertial.model.layout.read_layout`.
    """
    inner, outer = out.resolve(), project.resolve()
    if inner.is_relative_to(outer) or outer.is_relative_to(inner):
        raise OutputError(Fact("folders-within-each-other", folder=str(out), out=str(project)))
    listed = list_tree(project, follow_links=source.follow_links)[0]
    kept = Kept(tuple(source.keep), project)
    folders = [folder for folder in listed if not kept.covers(folder)]
    for folder in (Path(), *folders):
        if is_metric(project / folder):
            raise AlreadyMetricError(Fact("already-metric", folder=str(project / folder)))
    return read_layout(project, folders, one_for_all=False)


def name_made_from(project: Path, layout: Layout, files: Sequence[Path], keep: Sequence[str]) -> str:
    """A file of the project that was made from its models and is not to be kept as it is; empty without one."""
    kept = Kept(tuple(keep), project)
    made = find_made_from(project, layout, [path for path in files if not kept.covers(path)])
    return "" if made is None else str(made)


def require_refinable(
    options: ReconstructOptions, models: Mapping[int, Path], read: Callable[[Path], pycolmap.Reconstruction]
) -> None:
    """Raise :class:`InertialError` where rigs are to be refined; ``auto`` leaves them as they are."""
    rigs = [str(folder) for folder in models.values() if has_rigs(read(folder))] if options.refine == "inertial" else []
    if rigs:
        raise InertialError(Fact("rigs-not-refined", model=rigs[0]))


def require_near(models: Mapping[int, Path], read: Callable[[Path], pycolmap.Reconstruction]) -> None:
    """Raise :class:`InertialError` for a dense cloud, of single precision, far from the origin."""
    for folder in models.values():
        if OwnPlace.of(read(folder)).pivot is not None:
            raise InertialError(Fact("dense-far-away", folder=str(folder)))
