"""A finished folder that is asked for something else: the new result is made beside the earlier one, and replaces it.

The new run works in ``.stages/next``, an output folder of its own that begins with all that the earlier one holds, as
hard links, so that steps that nothing changed are kept. When it is finished, its files take the place of the earlier
ones. A run that fails or is killed leaves the earlier result as it was.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import read_json, write_json
from colmap_inertial.run.steps.config import read_values
from colmap_inertial.run.steps.workspace import Workspace

T = TypeVar("T")

#: Beside the records of steps: the new run's folder, which entries it replaces, and those until they are removed.
_NEXT, _RECORD, _EARLIER = "next", "replacing.json", "replaced"


def is_finished(workspace: Workspace) -> bool:
    """Whether a folder holds a whole result, to be kept until there is another one."""
    try:
        read_json(workspace.result)
    except FormatError:
        return False
    return workspace.config.is_file()


def is_made_of(workspace: Workspace, config: str, inputs: str) -> bool:
    """Whether a folder holds, or will hold, the result of this configuration and these inputs, by their hash."""
    try:
        known = read_json(workspace.inputs).get("inputs")
        return known == inputs and workspace.config.read_bytes() == config.encode()
    except (FormatError, OSError):
        return False


def place_beside(workspace: Workspace, config: str, inputs: str) -> Workspace:
    """Folder beside the result in which a run with other options works: as an earlier one left it, or with links to all
    files.
    """
    beside = Workspace(workspace.stamps / _NEXT)
    if not is_made_of(beside, config, inputs):
        drop_beside(workspace)
        for name in _entries(workspace):
            if workspace.root / name not in (workspace.result, workspace.config, workspace.inputs):
                _link(workspace.root / name, beside.root / name)
    return beside


def drop_beside(workspace: Workspace) -> None:
    """Remove what a run of something else began."""
    remove(workspace.stamps / _NEXT)


def replace_result(workspace: Workspace) -> None:
    """Have a finished run beside take the place of the earlier result; also where a process was killed while it did.

    Meanwhile the folder holds no ``result.json``.
    """
    beside, record = Workspace(workspace.stamps / _NEXT), workspace.stamps / _RECORD
    if not record.is_file():
        if not beside.result.is_file():
            return
        write_json(record, {"earlier": _entries(workspace), "new": _entries(beside)})
    record_now, earlier = read_json(record), workspace.stamps / _EARLIER
    workspace.unfinish()
    for name in sorted({*record_now["earlier"], *record_now["new"]} - {workspace.result.name}):
        here, new, aside = (root / name for root in (workspace.root, beside.root, earlier))
        if os.path.lexists(here) and (os.path.lexists(new) or name not in record_now["new"]):
            remove(aside)
            aside.parent.mkdir(parents=True, exist_ok=True)
            os.replace(here, aside)
        if os.path.lexists(new):
            os.replace(new, here)
    if beside.result.is_file():
        os.replace(beside.result, workspace.result)
    for path in (beside.root, earlier, record):
        remove(path)


def list_changed_options(earlier: Path, config: str) -> list[str]:
    """Describe each option that differs in another configuration, in a few words."""
    with contextlib.suppress(FormatError):
        before, after = _flat(read_values(earlier)), _flat(tomllib.loads(config))
        names = [name for name in sorted({*before, *after}) if before.get(name) != after.get(name)]
        return [f"{name} = {after.get(name, 'not given')} (was {before.get(name, 'not given')})" for name in names]
    return []


def moved(value: T, source: Path, target: Path) -> T:
    """A value with every path in ``source`` at its place in ``target``."""
    changed: Any = value
    if isinstance(value, Path):
        changed = target / value.relative_to(source) if value.is_relative_to(source) else value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}
        new = {name: moved(item, source, target) for name, item in fields.items()}
        if any(new[name] is not item for name, item in fields.items()):
            changed = dataclasses.replace(value, **new)
    elif type(value) is tuple:
        items = tuple(moved(item, source, target) for item in changed)
        changed = items if any(new is not old for new, old in zip(items, changed, strict=True)) else value
    return cast(T, changed)


def _entries(workspace: Workspace) -> list[str]:
    """Content of a folder and of the records of its steps, without the log, the lock, and this module's own files."""
    own = {_NEXT, _RECORD, _EARLIER, workspace.lock.name}
    steps = [f"{workspace.stamps.name}/{path.name}" for path in workspace.stamps.iterdir() if path.name not in own]
    others = {workspace.stamps.name, workspace.log.name}
    return sorted([path.name for path in workspace.root.iterdir() if path.name not in others] + steps)


def _link(source: Path, target: Path) -> None:
    """Files are hard links: steps write new ones. Databases are copies, as COLMAP writes in them where they are."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir() and not source.is_symlink():
        shutil.copytree(source, target, symlinks=True, copy_function=_link_file)
    else:
        _link_file(source, target)


def _link_file(source: str | Path, target: str | Path) -> None:
    if Path(source).suffix != ".db":
        with contextlib.suppress(OSError):  # a file system without links
            os.link(source, target, follow_symlinks=False)
            return
    shutil.copy2(source, target, follow_symlinks=False)


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat
