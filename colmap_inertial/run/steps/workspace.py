"""The output folder: where everything lies, what is finished, and how a step's output appears whole or not at all."""

from __future__ import annotations

import contextlib
import fnmatch
import logging
import os
import re
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from colmap_inertial.core.errors import FormatError, OutputError, OutputExistsError, fact_of
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.disk import full_disk_is_an_error
from colmap_inertial.io.files import locked, read_json, refuse_link, write_json
from colmap_inertial.report.folders import CROPS_FOLDER, DATA_FOLDER

log = logging.getLogger(__name__)

#: Counts changes of the layout: 2 since the folder itself is a project in metres.
_LAYOUT = 2
_TRAJECTORY = re.compile(r"trajectory(_\d+)?(\.tum|_cov(\.partial)?\.npz|_motion\.json)")


class _Inside:
    """A path in the output folder."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, workspace: Workspace, owner: type[Workspace]) -> Path:
        return workspace.root / self._name


@dataclass(frozen=True)
class Workspace:
    """Every path of an output folder, derived from its root."""

    root: Path

    images = _Inside("images")
    """The images that agree with the metric models, and whatever else is made from them."""
    sparse = _Inside("sparse")
    """The models in metres; none where no scale is accepted."""
    dense = _Inside("dense")
    """Dense reconstructions of the metric models."""
    colmap = _Inside("colmap")
    """COLMAP's own project: what it saw and made, untouched, in its arbitrary units."""
    colmap_images = _Inside("colmap/images")
    """The frames that COLMAP sees."""
    colmap_database = _Inside("colmap/database.db")
    """COLMAP's database."""
    colmap_features = _Inside("colmap/features.db")
    """The database before matching; removed at the end of a run."""
    colmap_sparse = _Inside("colmap/sparse")
    """COLMAP's models."""
    selection = _Inside("selection.json")
    """Which frames of a video are used, and why."""
    imaging = _Inside("imaging.json")
    """Calibration from before the reconstruction, and what it means for each frame."""
    frames = _Inside("frames.json")
    """Names, times and treatment of the frames."""
    keypoints = _Inside("keypoints.json")
    """What the keypoint stages did."""
    matches = _Inside(".stages/matches_made.json")
    """Which pairs of images were matched, and why not the rest."""
    orientations = _Inside(".stages/orientations.json")
    """Orientations of the images by the gyroscope, where it agrees with them."""
    mapped = _Inside(".stages/models_made.json")
    """How models were made."""
    validation = _Inside("validation")
    """Pictures of the target in the frames."""
    georeference = _Inside("georeference.json")
    """Where on Earth the metric models and their images stand."""
    diagnosis = _Inside("diagnosis.json")
    """What was found wrong with the recording before the reconstruction."""
    apertures = _Inside("apertures")
    """Disparities and depths of a multi-aperture camera's frames, where they were asked for."""
    report = _Inside("report.html")
    """For reading: everything in one page."""
    report_data = _Inside(DATA_FOLDER)
    """What the report shows beside the results; with it, the report can be made again."""
    crops = _Inside(f"{DATA_FOLDER}/{CROPS_FOLDER}")
    """Parts of some frames before and after the frame stages."""
    result = _Inside("result.json")
    """Written last: its presence means that the run is finished."""
    config = _Inside("config.toml")
    """The resolved configuration, in the form that ``--config`` reads."""
    log = _Inside("log.txt")
    """The run's log."""
    stamps = _Inside(".stages")
    """One JSON for each finished step."""
    stage_names = _Inside(".stages/stage_names.toml")
    """Which stages it is made with, where a batch named them."""
    lock = _Inside(".stages/lock")
    """Held by the run that is at work in the folder."""
    unsmoothed = _Inside(".stages/unsmoothed")
    """Frames as they are, of which COLMAP sees smoothed ones."""
    placed = _Inside(".stages/placed.json")
    """What came into the folder from an existing project."""
    owner = _Inside(".stages/capture.json")
    """Which command on which capture or project the folder is for."""

    def trajectory(self, index: int, *, first: bool) -> Path:
        """The smoothed metric trajectory of a model; the first one has the plain name."""
        return self.root / ("trajectory.tum" if first else f"trajectory_{index}.tum")

    def trajectories(self) -> list[Path]:
        """The trajectories of all models, with their covariances."""
        return [path for path in self.root.glob("trajectory*") if _TRAJECTORY.fullmatch(path.name)]

    @property
    def own_names(self) -> tuple[str, ...]:
        """Names that are the run's own where the folder is an existing project in metres; patterns, as in a shell."""
        report = (self.report, self.report.with_suffix(".json"), self.report_data)
        files = (self.result, self.config, self.log, self.diagnosis, self.georeference, self.frames, *report)
        names = (path.name for path in (*files, self.validation, self.stamps))
        return (*names, "trajectory*.tum", "trajectory*_cov.npz", "trajectory*_motion.json")

    def is_own(self, name: str) -> bool:
        """Whether a name is among them."""
        return any(fnmatch.fnmatchcase(name, pattern) for pattern in self.own_names)

    def open(self, source: Path, command: str = "reconstruct") -> None:
        """Create the folder, or take up a run of the same command on the same capture or project, finished or not.

        Raises
        ------
        OutputExistsError
            When the folder holds another run, or something that is not ours.
        """
        identity = self.prepare(source, command)
        if not self.owner.is_file():
            write_json(self.owner, identity)

    def prepare(self, source: Path, command: str) -> dict[str, str | int]:
        """Make room for the lock, in a folder that is new or ours; nothing else is written before it is held.

        Returns
        -------
        dict
            What the owner's record holds, or is to hold.

        Raises
        ------
        OutputExistsError
            As :meth:`open`.
        """
        if self.root.exists() and not self.root.is_dir():
            raise OutputExistsError(Fact("output-is-a-file", path=str(self.root)))
        if not os.path.lexists(self.owner):  # whose links are none of ours to speak of
            self._require_empty()
        refuse_links(self.root)
        identity: dict[str, str | int] = {"capture": str(source.resolve()), "command": command, "layout": _LAYOUT}
        if self.owner.is_file():
            try:
                known = read_json(self.owner)
            except FormatError as error:
                raise OutputExistsError(Fact("owner-unreadable", found=fact_of(error), out=str(self.root))) from None
            if known.get("layout") != _LAYOUT:
                raise OutputExistsError(Fact("run-of-another-version", out=str(self.root)))
            for what in ("capture", "command"):
                if known.get(what) != identity[what]:
                    raise OutputExistsError(
                        Fact("run-of-another-kind", out=str(self.root), what=what, named=known.get(what))
                    )
        else:
            self._require_empty()
        try:
            self.stamps.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(
                Fact("folder-not-made", out=str(self.root), detail=str(error.strerror or error))
            ) from error
        return identity

    def _require_empty(self) -> None:
        """Raise :class:`OutputExistsError` where a folder that is not ours holds anything."""
        if self.root.is_dir() and any(p.name != self.stamps.name for p in self.root.iterdir()):
            raise OutputExistsError(Fact("output-not-empty", path=str(self.root)))

    def unfinish(self) -> None:
        """Something is made again: what the result says no longer stands."""
        self.result.unlink(missing_ok=True)

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other runs out of the folder.

        Raises
        ------
        OutputExistsError
            While another run is at work in it.
        OutputError
            Where the disk is full.
        """
        busy = Fact("run-at-work", folder=str(self.root))
        with full_disk_is_an_error(self.root), locked(self.lock, busy):
            yield


def refuse_links(root: Path) -> None:
    """Refuse an output folder with links or special files in it: it may be a stranger's, and lead anywhere.

    It may be a link itself. Those of an existing project that came along stay in the folder, and are no harm.

    Raises
    ------
    FormatError
        For the first one.
    """
    workspace, top = Workspace(root), os.path.realpath(root)
    for folder, folders, names in os.walk(root):
        for name in sorted(folders + names):
            path = Path(folder, name)
            try:
                mode = path.lstat().st_mode
            except FileNotFoundError:
                continue  # a run at work took it away
            if stat.S_ISDIR(mode) or stat.S_ISREG(mode):
                continue
            if not stat.S_ISLNK(mode):
                raise FormatError(path, Fact("device-in-output"))
            inside = os.path.commonpath((top, os.path.realpath(path))) == top
            if not inside or not any(path.is_relative_to(place) for place in _places_of_links(workspace)):
                refuse_link(path)


def refuse_links_around(*paths: Path) -> None:
    """:func:`refuse_links` in the output folders that paths, such as those of a model and its images, lie in."""
    for path in paths:
        out = next((folder for folder in (path, *path.absolute().parents) if Workspace(folder).stamps.is_dir()), None)
        if out is not None:
            refuse_links(out)


def _places_of_links(workspace: Workspace) -> list[Path]:
    """Possible places of links of an existing project: its copy, and the copy that a killed run prepared."""
    names: Sequence[object] = ()
    if workspace.placed.is_file() and not workspace.placed.is_symlink():
        names = read_json(workspace.placed).get("paths", ())
    ready = workspace.stamps / "project"
    return [*(workspace.root / str(name) for name in names), *([] if ready.is_symlink() else [ready])]


@dataclass(frozen=True, kw_only=True)
class Places:
    """Places in a finished folder that other commands continue from, the best first; not each of them exists.

    Attributes
    ----------
    images, sparse, dense
        Images that agree with the metric models, those models, dense reconstructions of them.
    seen
        The images that COLMAP saw, with their rolling shutter.
    rectified
        Those without it, where it was undone.
    """

    images: tuple[Path, ...]
    sparse: tuple[Path, ...]
    dense: tuple[Path, ...]
    seen: Path
    rectified: Path


def places_of(root: Path) -> Places:
    """The places of a finished folder, also of one that 0.2 or a version before it made."""
    now, before = Workspace(root), root / "images_rectified"
    return Places(
        images=(before, now.images, root / "project_metric" / "images"),
        sparse=(root / "sparse_metric", now.sparse),
        dense=(now.dense, root / "dense_metric"),
        # colmap/ may have been removed, and then images/ is still what it was; a stranger's project may have its own
        seen=now.colmap_images if now.colmap_images.is_dir() and now.stamps.is_dir() else now.images,
        rectified=before if before.is_dir() else now.images,
    )


def require_apart(out: Path, pictures: Sequence[Path]) -> None:
    """Raise :class:`OutputError` where an output would lie among the images that it is made from.

    They would be taken for images of the capture when the command is given again.
    """
    for folder in pictures:
        if out.resolve().is_relative_to(folder.resolve()):
            raise OutputError(Fact("output-among-pictures", out=str(out), folder=str(folder)))
