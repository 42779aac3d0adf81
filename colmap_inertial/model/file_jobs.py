"""The work on each file of a project's copy: copied, or transformed by its kind."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass
from pathlib import Path

from colmap_inertial.core.threads import usable_processors
from colmap_inertial.core.types import Similarity
from colmap_inertial.io.ply import transform_ply
from colmap_inertial.model import model_files, model_formats
from colmap_inertial.model.copying import begin_writing, copy_file
from colmap_inertial.model.layout import WRITERS


@dataclass(frozen=True, kw_only=True)
class Change:
    """Change of one file or model folder: its path in the project, its kind, the change, and the model of its frame."""

    path: str
    kind: str
    changed: tuple[str, ...]
    model: int | None


def copy(source: Path, target: Path, *, link: bool) -> str:
    """Copy a file, and return how."""
    how = copy_file(source, target, link=link)
    if how == "copied":
        begin_writing(target)
    return how


def transform(
    source: Path,
    target: Path,
    kind: str,
    similarity: Similarity,
    place: tuple[str, int | None],
    *,
    doubles: bool | None = None,
) -> Change | str:
    """Transform one file.

    Parameters
    ----------
    source, target, kind, similarity
        What, and how.
    place
        Its path in the project and the sub-model that owns it.
    doubles
        Of points, as of :func:`~colmap_inertial.io.ply.transform_ply`.
    """
    if kind == "ply":
        changed = transform_ply(source, target, similarity, doubles=doubles)
    else:
        changed = WRITERS[kind](source, target, similarity)
    begin_writing(target)
    shutil.copymode(source, target)
    return Change(path=place[0], kind=kind, changed=changed, model=place[1]) if changed else "copied"


def side_by_side(jobs: Sequence[Callable[[], Change | str]]) -> Generator[Change | str, None, None]:
    """Results of the jobs in their order; a few at a time, as disk and processor take turns within one."""
    with ThreadPoolExecutor(max_workers=min(4, usable_processors())) as pool:
        try:
            for future in [pool.submit(copy_context().run, job) for job in jobs]:
                yield future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def files_of_models(project: Path, models: Collection[Path]) -> set[Path]:
    """The files of COLMAP's models, which COLMAP reads and writes itself."""
    return {
        path.relative_to(project)
        for folder in models
        for suffix in model_formats(project / folder)
        for path in model_files(project / folder, suffix)
    }
