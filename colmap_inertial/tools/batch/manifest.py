"""Captures of a batch: a TOML file, or a folder of captures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from colmap_inertial.core.choices import CheckedOptions
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions, ReferenceOptions, StageNames
from colmap_inertial.core.summary import prints_in_lines
from colmap_inertial.io.files import StrPath, check_names, reader
from colmap_inertial.io.imu import is_capture
from colmap_inertial.io.toml_section import Section, read_toml
from colmap_inertial.run.steps.config import override_options, read_values

#: What the batch itself writes into its output folder.
_RESERVED = ("status", "summary.csv", "summary.json")


@prints_in_lines
@dataclass(frozen=True, kw_only=True)
class BatchCapture(CheckedOptions):
    """One capture of a batch.

    Attributes
    ----------
    name
        Its folder in the output; unique.
    path
        What ``reconstruct`` takes.
    options
        How it is reconstructed.
    project
        For an existing COLMAP project: the IMU recording, and when its images were taken.
    reference
        Known lengths: a target, and the distance of two markers or of two points of a project.
    stages
        Its hooks; ``None`` for those of all captures.
    """

    name: str
    path: Path
    options: ReconstructOptions = field(default_factory=ReconstructOptions)
    project: ProjectOptions = field(default_factory=ProjectOptions)
    reference: ReferenceOptions = field(default_factory=ReferenceOptions)
    stages: StageNames | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.name.isprintable() or "/" in self.name or self.name.startswith(".") or not self.name.strip():
            raise ValueError(f"a capture's name is that of its folder: {self.name!r} cannot be one")
        try:
            check_names((f"{self.name}.json",), "a capture's name")
        except FormatError as error:
            raise ValueError(str(error)) from None
        if self.name in _RESERVED:
            raise ValueError(f"{self.name!r} is what the batch itself writes; choose another name")


@reader("the manifest of a batch")
def read_manifest(
    path: StrPath, options: ReconstructOptions = ReconstructOptions(), *, allow_stages: bool = False
) -> list[BatchCapture]:
    """The captures of a batch.

    Parameters
    ----------
    path
        A TOML file with a ``[[capture]]`` table for each capture::

            [[capture]]
            path = "captures/hall"      # relative paths count from the manifest's folder

            [[capture]]
            name = "yard-2"             # its folder in the output; the last part of the path where left out
            path = "captures/yard/second.mp4"
            config = "yard.toml"        # options of this capture, as OUT/config.toml has them
            options.world = "y-down"    # and one by one
            stages.frame = ["masks:people", "..."]  # hooks, as StageNames has them: code that is run

            [[capture]]
            path = "old/bridge"         # an existing COLMAP project: with the flags that reconstruct takes for one
            project.imu = "old/bridge_imu.csv"
            project.frame_times = "old/bridge_frames.csv"
            options.scale_from = ["imu", "distance"]
            reference.between = ["-1.2,0.4,3.1", "2.5,0.3,2.9"]  # or two markers of reference.target
            reference.distance = "4.20+-0.01"

        Or a folder: every folder in it is a capture.
    options
        Those of all captures; what the manifest states of one goes before them, ``options`` before ``config``.
    allow_stages
        Take a manifest that names stages: they are code of the manifest's author, and that the batch runs.

    Raises
    ------
    FormatError
        For a file that is not such a manifest, two captures of one name, a wrong option, or stages without
        ``allow_stages``.
    """
    path = Path(path)
    if path.is_dir() and is_capture(path):
        raise FormatError(path, Fact("batch-of-one-capture"))
    captures = _list_captures(path, options) if path.is_dir() else _read_captures(path, options)
    if not allow_stages:
        _refuse_stages(captures, path)
    if not captures:
        raise FormatError(path, Fact("no-folder-with-capture") if path.is_dir() else Fact("manifest-without-capture"))
    check_unique(captures, path)
    return captures


def check_unique(captures: Sequence[BatchCapture], path: Path) -> None:
    """Raise :class:`FormatError` where two captures have one name (some file systems do not tell A from a)."""
    seen: dict[str, BatchCapture] = {}
    for capture in captures:
        other = seen.setdefault(capture.name.casefold(), capture)
        if other is not capture:
            raise FormatError(
                path, Fact("captures-of-one-name", name=capture.name, first=str(other.path), second=str(capture.path))
            )


def _refuse_stages(captures: Sequence[BatchCapture], path: Path) -> None:
    for i, capture in enumerate(captures, start=1):
        if capture.stages is not None and capture.stages.code:
            raise FormatError(
                path,
                Fact("batch-names-code", number=i, code=capture.stages.code),
            )


def _list_captures(folder: Path, options: ReconstructOptions) -> list[BatchCapture]:
    folders = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    return [BatchCapture(name=path.name, path=path, options=options) for path in folders]


def _read_captures(path: Path, options: ReconstructOptions) -> list[BatchCapture]:
    root = read_toml(path)
    tables = root.raw("capture")
    root.finish()
    if tables is None:
        return []
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        root.fail("capture", Fact("capture-not-in-tables"))
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    return [
        _capture(path, Section(path, f"capture, number {i}", table, text), options)
        for i, table in enumerate(tables, start=1)
    ]


def _capture(manifest: Path, table: Section, options: ReconstructOptions) -> BatchCapture:
    source: Path = table.require("path", table.file("path"))
    name = table.text("name")
    config = table.file("config")
    values = _table(table, "options")
    project = override_options(ProjectOptions(), _table(table, "project"), manifest)
    reference = override_options(ReferenceOptions(), _table(table, "reference"), manifest)
    stages = _stages(table)
    table.finish()
    if config is not None:
        options = override_options(options, read_values(config), config)
    options = override_options(options, values, manifest)
    if name is None:
        resolved = source.resolve()
        name = resolved.parent.name if resolved.name == "capture.toml" else resolved.stem
    try:
        return BatchCapture(
            name=name, path=source, options=options, project=project, reference=reference, stages=stages
        )
    except ValueError as error:
        table.fail("name", Fact("invalid-values", detail=str(error)))


def _stages(table: Section) -> StageNames | None:
    values = _table(table, "stages")
    try:
        return override_options(StageNames(), values, table.path) if "stages" in table else None
    except FormatError as error:
        table.fail("stages", error.fact)


def _table(table: Section, key: str) -> dict[str, Any]:
    values = table.raw(key)
    if values is not None and not isinstance(values, dict):
        table.fail(key, Fact("key-is-a-table", key=key))
    return values or {}
