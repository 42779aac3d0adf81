"""A whole COLMAP project under one similarity: sparse, dense, meshes, database. All of it, or nothing."""

from __future__ import annotations

import contextlib
import fnmatch
import functools
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from colmap_inertial import __version__
from colmap_inertial.core.errors import AlreadyMetricError, FormatError, OutputError
from colmap_inertial.core.facts import Fact, with_sentences
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import Similarity
from colmap_inertial.io.files import StrPath, read_json, write_json
from colmap_inertial.model import (
    TRANSFORM_FILE,
    is_metric,
    model_files,
    model_formats,
    read_model,
    require_format,
    similarity_as_json,
    transform_model,
    write_files,
)
from colmap_inertial.model.assigning import assign_scales, compare_models, put_about_places, require_free_records
from colmap_inertial.model.copying import copy_file, list_tree, new_folder
from colmap_inertial.model.database import SHARED_MEMORY, SIDE_FILES, is_database, transform_database
from colmap_inertial.model.deregistration import deregister_images
from colmap_inertial.model.file_jobs import Change, copy, files_of_models, side_by_side, transform
from colmap_inertial.model.inventory import Inventory, Unmoved, lengths_of
from colmap_inertial.model.keeping import Kept
from colmap_inertial.model.layout import CAMERA_KINDS, Layout, kind_to_move, read_layout
from colmap_inertial.model.notes import collecting_notes
from colmap_inertial.model.places import Place
from colmap_inertial.model.pose_priors import compare_priors
from colmap_inertial.model.similarities import ModelScale, invert_similarity, require_not_joined, similarity_from_json
from colmap_inertial.model.soundness import check_binary_model
from colmap_inertial.model.worlds import Worlds


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class Applied:
    """Result of :func:`apply_to_project` or :func:`undo_project`, in the folder ``out``.

    Attributes
    ----------
    models
        Each sub-model's folder and what was applied to it, by number.
    changes
        What carries length.
    unchanged
        Number of other files, by how they came over: ``copied``, ``reflinked``, ``linked``, ``link``.
    notes
        What the user should know.
    unmoved
        Other files that have lengths, or may have, by kind.
    """

    out: Path
    models: Mapping[int, tuple[str, ModelScale]]
    changes: tuple[Change, ...]
    unchanged: Mapping[str, int]
    notes: tuple[Fact, ...]
    unmoved: tuple[Unmoved, ...] = ()

    def as_json(self) -> dict[str, object]:
        """The same for programs."""
        models = [
            {
                "index": index,
                "folder": folder,
                "scale": None if scale.similarity is None else scale.similarity.scale,
                "verdict": scale.verdict,
                **with_sentences({"reasons": list(scale.reasons)}),
            }
            for index, (folder, scale) in self.models.items()
        ]
        return {
            "out": self.out,
            "models": models,
            "changes": self.changes,
            "files_kept": self.unchanged,
            "unmoved": self.unmoved,
            **with_sentences({"notes": list(self.notes)}),
        }


def apply_to_project(
    project: StrPath,
    out: StrPath,
    scales: Similarity | Mapping[int | None, ModelScale],
    *,
    link: bool = False,
    keep: Sequence[str] = (),
    follow_links: bool = False,
    only_metric: bool = False,
    about_origin: bool = True,
    any_model: bool = False,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> Applied:
    """Write a copy of a COLMAP project in which everything that carries length is transformed.

    Sparse models (binary, text; with rigs and frames), dense workspaces with depth maps, point clouds and meshes (PLY,
    OBJ), depth ranges in option files, and the pose priors and rigs of the database. Other files are copied, blocks
    shared with the original where the file system can. The project itself is only read.

    Parameters
    ----------
    project
        A folder with a COLMAP model, in any layout that COLMAP's own commands make.
    out
        A folder that does not exist; it appears whole or not at all. ``transform.json`` in it says what was done.
    scales
        One similarity for everything, or what :func:`read_scales` returns: one for each sub-model and all that was
        made from it.
    link
        Make hard links of files that do not change. A later edit then reaches the original, too.
    keep
        Patterns, as in a shell, of paths in the project that are copied as they are.
    follow_links
        Copy what symbolic links out of the project lead to; without, they are refused.
    only_metric
        Leave out sub-models with a refused scale and what was made from them; without, they keep their own units.
    about_origin
        Whether similarities act about the origin, as they say, also on models that lie far from it; else about a point
        in their middle, which stays.
    any_model
        Whether scales of other models are taken, too.
    progress
        Called with the number of files done and of all.

    Raises
    ------
    AlreadyMetricError
        When the project already carries a similarity of ours.
    NotObservableError
        When every scale was refused.
    FormatError
        For an artefact that cannot be read, where it cannot be told which sub-model something belongs to, and for a
        link out of the project.
    OutputError
        When ``out`` exists or cannot be written.
    """
    project, out = Path(project), Path(out)
    with collecting_notes() as read:
        work = _Work(project, out, keep, follow_links, read)
        for folder in (Path(), *work.folders):
            if not work.is_kept(folder / TRANSFORM_FILE) and is_metric(project / folder):
                provenance = read_json(project / folder / TRANSFORM_FILE).get("provenance", "unknown")
                raise AlreadyMetricError(
                    Fact("metric-already-in-project", folder=str(project / folder), provenance=provenance)
                )
        common = scales if isinstance(scales, Similarity) else None
        layout = read_layout(project, work.open_folders(), one_for_all=common is not None)
        require_free_records(project, layout)
        by_model = assign_scales(project, layout, scales)
        work.note(compare_models(layout, by_model, any_model=any_model))
        by_model, facts = put_about_places(layout, by_model, about_origin=about_origin, one_for_all=common is not None)
        work.note(facts)
        common = None if common is None else next(iter(by_model.values())).similarity
        left_out = [index for index, scale in by_model.items() if only_metric and scale.similarity is None]
        work.leave_out(layout, left_out)
        plan = _Plan(layout=layout, by_model=by_model, one_for_all=common, left_out=left_out, link=link)
        return work.run(plan, progress)


def undo_project(
    project: StrPath,
    out: StrPath,
    *,
    link: bool = False,
    follow_links: bool = False,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> Applied:
    """Write a copy of what :func:`apply_to_project` made in the units that it had before.

    Raises
    ------
    FormatError
        When the project holds no ``transform.json`` of ours, or a joined model.
    OutputError
        When ``out`` exists or cannot be written.
    """
    project, out = Path(project), Path(out)
    path = project / TRANSFORM_FILE
    if project.is_dir() and not path.exists():
        raise FormatError(project, Fact("nothing-to-undo"))
    record = read_json(path)
    try:
        keep = [str(pattern) for pattern in record["keep"]]
        models = [(int(m["index"]), m["similarity"]) for m in record["models"]]
        databases = {name: (list(d["prior_models"]), list(d["rig_models"])) for name, d in record["databases"].items()}
        beside = [str(pattern) for pattern in record.get("beside", [])]
        require_not_joined(path, {int(m["index"]): [int(i) for i in m.get("joined_of", [])] for m in record["models"]})
    except (KeyError, TypeError, ValueError, AttributeError):
        raise FormatError(path, Fact("not-a-record-of-apply")) from None
    by_model = {
        index: ModelScale(similarity=None if fields is None else invert_similarity(similarity_from_json(path, fields)))
        for index, fields in models
    }
    with collecting_notes() as read:
        work = _Work(project, out, keep, follow_links, read, beside)
        common = invert_similarity(similarity_from_json(path, record)) if record.get("one_for_all") is True else None
        layout = read_layout(project, work.open_folders(), one_for_all=common is not None)
        if layout.submodels.keys() != by_model.keys():
            raise FormatError(path, Fact("models-not-as-recorded"))
        plan = _Plan(layout=layout, by_model=by_model, one_for_all=common, databases=databases, link=link, is_undo=True)
        return work.run(plan, progress)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Plan:
    """Plan of a copy of a project.

    Attributes
    ----------
    layout
        The models of the project.
    by_model
        What is applied to each sub-model and what was made from it.
    one_for_all
        The similarity of everything, in place of these.
    left_out
        Sub-models that are not copied.
    databases
        By path, the models whose priors and rigs it holds, where that is recorded.
    link
        Make hard links of files that do not change.
    is_undo
        Whether it takes back what was applied, and leaves no record.
    """

    layout: Layout
    by_model: Mapping[int, ModelScale]
    one_for_all: Similarity | None
    left_out: Collection[int] = ()
    databases: Mapping[str, tuple[Collection[int], Collection[int]]] = field(default_factory=dict)
    link: bool = False
    is_undo: bool = False

    def in_doubles(self, owner: int | None, move: Similarity) -> bool | None:
        """Whether points of a model come to lie too far off for single precision, as of ``transform_ply``."""
        if self.is_undo:
            return False
        models = [model for model in self.layout.placed if owner is None or model.index == owner]
        places = [Place.of(model.shown()) for model in models]
        return any(place is not None and place.moved(move).is_far for place in places) or None

    @property
    def similarities(self) -> dict[int, Similarity | None]:
        """Similarities by sub-model."""
        return {index: scale.similarity for index, scale in self.by_model.items()}


class _Work:
    """One copy of a project, file by file."""

    def __init__(
        self,
        project: Path,
        out: Path,
        keep: Sequence[str],
        follow_links: bool,
        read: Sequence[tuple[Path, Fact]],
        beside: Sequence[str] = (),
    ) -> None:
        if project.is_file():
            require_format(project)  # says what it is
        if not project.is_dir():
            raise FormatError(project, Fact("no-such-folder"))
        inner, outer = out.resolve(), project.resolve()
        if inner.is_relative_to(outer) or outer.is_relative_to(inner):
            raise OutputError(Fact("folders-within-each-other", folder=str(out), out=str(project)))
        self._project, self._out, self._keep, self._read = project, out, Kept(tuple(keep), project), read
        tree = list_tree(project, follow_links=follow_links)
        self.folders, self._files, self._links = (
            [p for p in paths if not any(fnmatch.fnmatch(p.parts[0], pattern) for pattern in beside)] for paths in tree
        )
        self._changes: list[Change] = []
        self._databases: dict[str, dict[str, Any]] = {}
        self._notes: list[Fact] = []
        self._inventory = Inventory()
        self.note(self._keep.idle_patterns((*self.folders, *self._files, *self._links)))

    def is_kept(self, path: Path) -> bool:
        """Whether a path, or a folder above it, is to be copied as it is."""
        return self._keep.covers(path)

    def note(self, facts: Iterable[Fact]) -> None:
        """Tell the user."""
        self._notes += [Fact("noted-with-advice", found=fact) for fact in facts]

    def open_folders(self) -> list[Path]:
        """Folders that are not kept as they are."""
        return [folder for folder in self.folders if not self.is_kept(folder)]

    def leave_out(self, layout: Layout, indices: Collection[int]) -> None:
        """Leave out some of the sub-models, and what was made from them."""
        gone = {folder for folder, index in (*layout.owners.items(), *layout.workspaces.items()) if index in indices}

        def staying(paths: Sequence[Path]) -> list[Path]:
            return [path for path in paths if not gone.intersection((path, *path.parents))]

        self.folders, self._files, self._links = map(staying, (self.folders, self._files, self._links))
        for index in indices:
            self._notes.append(Fact("model-left-out", folder=str(layout.submodels[index])))

    @one_blas_thread()
    def run(self, plan: _Plan, progress: Callable[[int, int], object]) -> Applied:
        """Write everything but the sub-models that are left out, then give it its name."""
        unchanged: Counter[str] = Counter()
        with new_folder(self._out) as partial:
            for folder in self.folders:
                (partial / folder).mkdir()
            for path in self._links:
                (partial / path).symlink_to((self._project / path).readlink())
                unchanged["link"] += 1
            for folder, index in plan.layout.owners.items():
                if index not in plan.left_out:
                    self._write_model(folder, partial, index, plan)
            databases, jobs = self._sort_files(plan, partial)
            done, total = 0, len(databases) + len(jobs)
            for path in databases:
                if not self._write_database(path, partial, plan):
                    unchanged["copied"] += 1
                progress(done := done + 1, total)
            with contextlib.closing(side_by_side(jobs)) as outcomes:
                for outcome in outcomes:
                    if isinstance(outcome, Change):
                        self._changes.append(outcome)
                    else:
                        unchanged[outcome] += 1
                    progress(done := done + 1, total)
            for folder in reversed(self.folders):
                shutil.copymode(self._project / folder, partial / folder)
            self._note_what_stays(plan)
            submodels = plan.layout.submodels
            for index, scale in plan.by_model.items():
                if scale.left_out and scale.similarity is not None:
                    where, names = str(submodels[index]), scale.left_out
                    self._notes.append(Fact("contradicting-images-left-out", folder=where, names=names))
            applied = Applied(
                out=self._out,
                models={i: (str(submodels[i]), s) for i, s in plan.by_model.items() if i not in plan.left_out},
                changes=tuple(self._changes),
                unchanged=dict(unchanged),
                notes=tuple(dict.fromkeys(self._notes)),
                unmoved=self._inventory.unmoved,
            )
            if not plan.is_undo:
                write_json(partial / TRANSFORM_FILE, self._record(applied, plan.one_for_all))
        return applied

    def _note_what_stays(self, plan: _Plan) -> None:
        """Tell of files that may have lengths and stay, and of what was odd in the models."""
        scales = [s.similarity.scale for s in plan.by_model.values() if s.similarity is not None]
        self.note(self._inventory.notes(scales))
        of_files = ((str(self._in_project(path)), fact) for path, fact in self._read)
        self._notes += [Fact("read-all-the-same", file=file, found=fact) for file, fact in of_files]

    def _sort_files(self, plan: _Plan, partial: Path) -> tuple[list[Path], list[Callable[[], Change | str]]]:
        """The databases, and the work on every other file that COLMAP does not write itself."""
        skipped = files_of_models(self._project, plan.layout.owners)
        if plan.is_undo:
            skipped |= {folder / TRANSFORM_FILE for folder in (Path(), *plan.layout.owners)}
        similarities = plan.similarities
        databases: list[Path] = []
        jobs: list[Callable[[], Change | str]] = []
        files = [path for path in self._files if path not in skipped and not self._is_side_file(path)]
        worlds = Worlds(
            self._project,
            plan.layout.placed,
            [path for path in files if not self.is_kept(path)],
            lambda fact: self.note([fact]),
        )
        for path in files:
            source, target = self._project / path, partial / path
            kind = None if self.is_kept(path) else kind_to_move(source, path)
            if kind == "database":
                databases.append(path)
                continue
            fitting: list[int] = []
            if kind in CAMERA_KINDS and not (fitting := worlds.owners_of(path, str(kind))):
                kind = None
            owner = None if plan.one_for_all is not None or kind is None else self._owner(plan.layout, path, fitting)
            similarity = plan.one_for_all if owner is None else similarities[owner]
            if kind is None and not self.is_kept(path) and path not in worlds.counted:
                self._inventory.add(path, lengths_of(source, path, worlds.depths))
            move = None
            if kind is not None and similarity is not None:
                move = worlds.similarity_of(path, kind, owner, similarity)
            if kind is None or move is None:
                jobs.append(functools.partial(copy, source, target, link=plan.link))
            else:
                doubles, place = plan.in_doubles(owner, move), (str(path), owner)
                jobs.append(functools.partial(transform, source, target, kind, move, place, doubles=doubles))
        return databases, jobs

    def _in_project(self, path: Path) -> Path:
        """A path as it is in the project, also of what was read from the copy."""
        return path.relative_to(self._project) if path.is_relative_to(self._project) else path

    def _owner(self, layout: Layout, path: Path, fitting: Sequence[int]) -> int:
        """The sub-model in whose units a file is: by its folder, else the only one whose cameras it has."""
        owner = layout.owner(path)
        if owner is None and len(fitting) == 1:
            owner = fitting[0]
        if owner is None:
            raise FormatError(
                self._project / path,
                Fact("owner-unknown"),
            )
        return owner

    def _is_side_file(self, path: Path) -> bool:
        """Whether a file is a companion of a SQLite database, which is copied with it."""
        for suffix in (*SIDE_FILES, SHARED_MEMORY):
            base = path.with_name(path.name.removesuffix(suffix))
            if base != path and (self._project / base).is_file() and is_database(self._project / base):
                return not self.is_kept(base)
        return False

    def _write_model(self, folder: Path, partial: Path, index: int, plan: _Plan) -> None:
        source, target = self._project / folder, partial / folder
        similarity = plan.one_for_all or plan.by_model[index].similarity
        for suffix in model_formats(source):
            model = read_model(source, suffix, unique_names=False)
            left_out = plan.by_model[index].left_out
            if left_out and similarity is not None:
                model = deregister_images(model, left_out)
            if similarity is None:
                for path in model_files(source, suffix):
                    copy_file(path, target / path.name)
                continue
            counts = model.num_reg_images(), model.num_points3D()
            # COLMAP does not notice a disk that is full
            try:
                write_files(transform_model(model, similarity), target, suffix)
                if suffix == ".bin":
                    check_binary_model(target)
                else:
                    again = read_model(target, suffix, unique_names=False)
                    if (again.num_reg_images(), again.num_points3D()) != counts:
                        raise FormatError(target, Fact("truncated"))
            except (FormatError, ValueError, RuntimeError) as error:
                raise OutputError(Fact("model-not-whole", folder=str(self._out / folder), detail=str(error))) from error
            self._changes.append(
                Change(path=str(folder), kind=f"model {suffix}", changed=("cameras", "points", "rigs"), model=index)
            )
        if similarity is not None and not plan.is_undo and folder != Path():
            write_json(target / TRANSFORM_FILE, similarity_as_json(similarity))

    def _write_database(self, path: Path, partial: Path, plan: _Plan) -> bool:
        """Whether anything in it changed."""
        priors, rigs = plan.databases.get(str(path), (None, None))
        done = transform_database(
            self._project / path,
            partial / path,
            plan.layout.placed,
            plan.similarities,
            prior_models=priors,
            rig_models=rigs,
        )
        self._databases[str(path)] = asdict(done)
        changed: list[str] = []
        for what, moved, kept in (
            ("pose priors", done.priors_moved, done.priors_kept),
            ("rig sensors", done.rigs_moved, done.rigs_kept),
        ):
            if moved:
                changed.append(f"{moved} {what}")
            if kept:
                self._notes.append(Fact("not-in-model-frame", file=str(path), count=kept, kind=what))
        if not plan.is_undo:
            models, by_model = plan.layout.placed, plan.similarities
            self.note(compare_priors(self._project / path, str(path), models, by_model, moved=done.prior_models))
        (shutil.copymode if changed else shutil.copystat)(self._project / path, partial / path)
        if changed:
            self._changes.append(Change(path=str(path), kind="database", changed=tuple(changed), model=None))
        return bool(changed)

    def _record(self, applied: Applied, common: Similarity | None) -> dict[str, object]:
        """The content of ``transform.json``."""
        given = [scale.similarity for _, scale in applied.models.values() if scale.similarity is not None]
        same = common or (given[0] if len(applied.models) == 1 else None)
        whole = {"provenance": "; ".join(s.provenance for s in given)} if same is None else similarity_as_json(same)
        return {
            **whole,
            "one_for_all": common is not None,
            "source": str(self._project.resolve()),
            "version": __version__,
            "keep": list(self._keep.patterns),
            "models": [
                {"index": index, "folder": folder, **scale.as_json()}
                for index, (folder, scale) in applied.models.items()
            ],
            "databases": self._databases,
            "files": [asdict(change) for change in applied.changes],
            "unchanged": applied.unchanged,
            "unmoved": self._inventory.as_json(),
            **with_sentences({"notes": list(applied.notes)}),
        }
