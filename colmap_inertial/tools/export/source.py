"""Source of an export: the model, its unit and up, its images and cameras, and the camera's motion."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.core.errors import FormatError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ExportImages
from colmap_inertial.core.types import DOWN_IN_WORLD, Action, CameraMotion, CameraTrajectory
from colmap_inertial.evidence.positions import georeference_path
from colmap_inertial.inertial.georeference import Georeference
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import a_record_of_ours, read_json, read_record
from colmap_inertial.io.frames import read_frame_timing
from colmap_inertial.io.picture_names import picture_in
from colmap_inertial.io.positions import positions_in_pictures
from colmap_inertial.model import read_model, transform_model
from colmap_inertial.model.nerf import NEVER_SCALED, NO_SCALE, NO_UP
from colmap_inertial.model.places import Place, translation
from colmap_inertial.run.preparation.geolocation import positions_of, read_georeference
from colmap_inertial.run.stages.metric import motion_file
from colmap_inertial.run.steps.runner import explaining_losses, find_change
from colmap_inertial.run.steps.workspace import Workspace, places_of
from colmap_inertial.tools.export.formats import sparse_points
from colmap_inertial.tools.export.transforms import View
from colmap_inertial.tools.export.undistort import Undistortion, list_needed_cameras
from colmap_inertial.tools.view.sources import ViewSource, find_source

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class Picture:
    """An image of the model, and the file that is exported for it.

    Attributes
    ----------
    path
        Of the file; of one that comes out of the capture, the capture.
    rectified
        Whether the rolling shutter was undone in it.
    sharpened
        Whether its blur was undone in it.
    filmed
        Whether it comes out of the capture.
    agrees
        Whether it shows things where the model has them; an image with its rolling shutter does not, where the model
        was made without.
    """

    path: Path
    rectified: bool = False
    sharpened: bool = False
    filmed: bool = False
    agrees: bool = True


@dataclass(frozen=True, kw_only=True)
class TreatedFrame:
    """What a run did to a frame.

    Attributes
    ----------
    changed
        Whether COLMAP did not see the file or pixels as they were.
    sharpened
        Whether its blur was undone.
    rectified
        Whether its keypoints were rectified.
    """

    changed: bool = False
    sharpened: bool = False
    rectified: bool = False

    @classmethod
    def of(cls, frame: Mapping[str, Any]) -> TreatedFrame:
        """By the run's ``result.json``; earlier versions said by the action alone whether it was sharpened."""
        sharpened = bool(frame.get("sharpened", frame["action"] == Action.DEBLURRED))
        changed = frame["action"] != Action.PASSED
        return cls(changed=changed, sharpened=sharpened, rectified=bool(frame["rectified"]))


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportSource:
    """A model to export.

    Attributes
    ----------
    found
        Where the model is; unit, verdict, places of images.
    model
        The model itself.
    up_in_world
        (3,) unit vector, ``None`` where unknown.
    gravity_in_world_m_s2
        (3,) points down; ``None`` where unknown.
    motion
        During each frame; ``None`` where it was not kept.
    treated
        By image name, what a run did to its frames.
    """

    found: ViewSource
    model: pycolmap.Reconstruction
    up_in_world: Array | None
    gravity_in_world_m_s2: Array | None
    motion: CameraMotion | None
    treated: Mapping[str, TreatedFrame]

    def pictures(
        self, out: Path, names: list[str], kind: ExportImages, capture: Capture | None = None
    ) -> dict[str, Picture]:
        """The file of each image; of those that a run changed, the image of the capture where one is given.

        Raises
        ------
        FormatError
            Where one is missing, or is not as the run wrote it.
        """
        places = places_of(out)
        folders = self.found.images if kind == "rectified" else (places.seen, *self.found.images)
        changed = [name for name in names if self.treated.get(name, TreatedFrame()).changed]
        filmed = {}
        if capture is not None:
            if capture.apertures is not None or capture.exposures is not None:
                raise FormatError(capture.path, Fact("frames-of-several-pictures"))
            known = set(read_frame_timing(capture).names) if capture.frames is not None else set()
            lost = next((name for name in changed if name not in known), None)
            if lost is not None:
                raise FormatError(capture.path, Fact("frame-not-in-capture", frame=lost))
            for name in changed:
                bent = self.treated[name].rectified
                filmed[name] = Picture(path=capture.path, filmed=True, agrees=not bent)
        picture_of = {name: filmed.get(name) or self._picture(places.rectified, folders, name) for name in names}
        changed_since = find_change(Workspace(out), (picture.path for picture in picture_of.values()))
        if changed_since is not None:
            raise FormatError(
                changed_since,
                Fact("changed-since-its-run"),
            )
        return picture_of

    def _picture(self, rectified: Path, folders: tuple[Path, ...], name: str) -> Picture:
        paths = (picture_in(folder, name, self.found.folder) for folder in folders if folder.is_dir())
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            looked = tuple(str(folder) for folder in folders if folder.is_dir())
            raise FormatError(
                self.found.folder,
                Fact("picture-missing", image=name, folders=looked),
            )
        treated = self.treated.get(name, TreatedFrame())
        moved = treated.rectified and path.resolve().is_relative_to(rectified.resolve())
        return Picture(path=path, rectified=moved, sharpened=treated.sharpened, agrees=moved or not treated.rectified)


def read_source(
    out: Path, *, model: int | None = None, image_folder: Path | None = None, unscaled: bool = False
) -> ExportSource:
    """Read the source from a finished run, or from a project.

    Parameters
    ----------
    out
        What ``reconstruct`` or ``apply`` wrote, or a folder with a COLMAP model.
    model
        Its number; ``None`` takes the largest.
    image_folder
        Where its images are, where they are not beside it.
    unscaled
        Whether a model without a scale will do.

    Raises
    ------
    FormatError
        Where there is no such model, or the run is not finished.
    NotObservableError
        Where the model has no scale.
    """
    with explaining_losses(Workspace(out)):
        source = find_source(out, model, images=image_folder)
        if source.scale.unit != "m" and not unscaled:
            raise NotObservableError(
                "scale", Fact("export-without-scale", reasons=source.scale.reasons or (Fact("never-scaled"),))
            )
        reconstruction = read_model(source.folder)
        down, motion = source.down_in_world, None
        if source.scale.unit == "m" and source.trajectory is not None and motion_file(source.trajectory).is_file():
            motion = read_record(motion_file(source.trajectory), CameraMotion)
        return ExportSource(
            found=source,
            model=reconstruction,
            up_in_world=_up(source, reconstruction),
            gravity_in_world_m_s2=down,
            motion=motion,
            treated=_read_treated_frames(Workspace(out)),
        )


def find_georeference(out: Path, source: ExportSource, capture: Capture | None) -> Georeference:
    """Georeference of a model: from its run, else from positions of the capture or of its images.

    Raises
    ------
    FormatError
        Where there are no positions.
    NotObservableError
        Where they leave the heading open, or the model is not metric.
    """
    if source.found.scale.unit != "m" or source.up_in_world is None:
        raise NotObservableError("heading", Fact("nowhere-on-earth"))
    known = read_georeference(Workspace(out).georeference, source.found.index)
    if known is not None:
        return known
    path = _path(source)
    folder = next((folder for folder in source.found.images if folder.is_dir()), None)
    if capture is not None:
        fixes = positions_of(capture, path.names)
    elif folder is not None:
        fixes = positions_in_pictures(folder, path.names)
    else:
        raise FormatError(source.found.folder, Fact("pictures-not-beside"))
    if fixes.names is None and source.motion is None:
        raise FormatError(source.found.folder, Fact("times-of-images-lost"))
    return georeference_path(fixes, path, source.up_in_world, timed=bool(_times(source)))


def _path(source: ExportSource) -> CameraTrajectory:
    """The images in order of time; where their times were not kept, in order of their names, a second apart."""
    images = {image.name: image for image in map(source.model.image, source.model.reg_image_ids())}
    motion, rows = source.motion, _times(source) or list(enumerate(sorted(images)))
    poses = [images[name].cam_from_world() for _, name in rows]
    return CameraTrajectory(
        names=tuple(name for _, name in rows),
        t_s=np.array([t for t, _ in rows], dtype=np.float64),
        epoch_ns=0 if motion is None else motion.epoch_ns,
        cam_from_world_xyzw=np.array([pose.rotation.quat for pose in poses]),
        cam_in_world=np.array([images[name].projection_center() for _, name in rows]),
    )


def _times(source: ExportSource) -> list[tuple[float, str]]:
    """Times of the images by name; empty where they were not stored."""
    if source.motion is None:
        return []
    names = {source.model.image(i).name for i in source.model.reg_image_ids()}
    return [(t, name) for t, name in zip(source.motion.t_s.tolist(), source.motion.names, strict=True) if name in names]


def _up(source: ViewSource, model: pycolmap.Reconstruction) -> Array | None:
    """Against gravity; of an axis that gravity lies on, the one that the pictures' upper edges point along."""
    if source.down_in_world is not None:
        return 0.0 - source.down_in_world / np.linalg.norm(source.down_in_world)  # no -0.0
    if not source.gravity_on_axis:
        return None
    rotations = [model.image(i).cam_from_world().rotation.matrix() for i in model.reg_image_ids()]
    edges = -np.mean(rotations, axis=0)[1]
    return max((0.0 - down for down in DOWN_IN_WORLD.values()), key=lambda up: float(up @ edges))


def _read_treated_frames(workspace: Workspace) -> dict[str, TreatedFrame]:
    if not workspace.result.is_file():
        return {}
    with a_record_of_ours(workspace.result):
        frames = read_json(workspace.result).get("frames", [])
        return {str(frame["name"]): TreatedFrame.of(frame) for frame in frames}


#: Endings of images that stay JPEG; all others become PNG.
_JPEG = (".jpg", ".jpeg")
#: Longest stem, so that a number still fits in front of the ending.
_LONGEST = 100


def flat_names(names: Iterable[str]) -> dict[str, str]:
    """A file name for each image: no folder, no dot but the ending's, unique without regard to case.

    Some trainers cut a name at its first dot, some look at its last part alone, and some file systems take ``A.jpg``
    and ``a.jpg`` for the same file.

    Parameters
    ----------
    names
        Image names as COLMAP has them; each once.

    Returns
    -------
    dict
        The new name of each, in the order of the names.
    """
    name_of: dict[str, str] = {}
    taken: set[str] = set()
    tried: dict[str, int] = {}
    for name in sorted(names):
        path = PurePosixPath(name.replace("\\", "/"))
        suffix = ".jpg" if path.suffix.lower() in _JPEG else ".png"
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", "_".join((*path.parts[:-1], path.stem)))[-_LONGEST:]
        # those of one stem go on counting where the one before stopped
        candidate, number = stem, tried.get(stem.lower(), 1)
        while candidate.lower() in taken:
            number += 1
            candidate = f"{stem}_{number}"
        tried[stem.lower()] = number
        taken.add(candidate.lower())
        name_of[name] = candidate + suffix
    return name_of


#: What says up where gravity is unknown: z, as trainers' viewers have it.
_Z_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportContent:
    """Content of an export.

    Attributes
    ----------
    source
        The model that is exported.
    names
        The new name of each image.
    cameras
        What becomes of each camera, by its number.
    views
        The images, in the order of their new names.
    xyz, rgb
        (N, 3) points and colours.
    on_map
        Where on Earth the model stands, where that was asked for.
    pictures
        By image name, the file that is exported; empty where none are.
    notes
        What the user should know; writers add to it.
    is_recentred
        Whether ``offset`` was taken off everything.
    offset
        (3,) of a model that lies far from the origin, a point in its middle: single precision cannot hold it as it is.
    """

    source: ExportSource
    names: Mapping[str, str]
    cameras: Mapping[int, Undistortion]
    views: list[View]
    xyz: Array
    rgb: UInt8Array
    on_map: Georeference | None = None
    pictures: Mapping[str, Picture] = field(default_factory=dict)
    notes: list[Fact]
    is_recentred: bool = False
    offset: Array | None = None

    @classmethod
    def of(cls, source: ExportSource, on_map: Georeference | None, *, square: bool) -> ExportContent:
        """All but the images; cameras with ``square`` pixels where that is needed."""
        model, where = source.model, source.found.folder
        names = flat_names(model.image(i).name for i in model.reg_image_ids())
        cameras = {i: Undistortion.of(model.camera(i), where, square=square) for i in list_needed_cameras(model)}
        views = [
            View(
                name=names[image.name],
                camera=cameras[image.camera_id].pinhole,
                cam_from_world_xyzw=np.array(image.cam_from_world().rotation.quat),
                cam_in_world=np.array(image.projection_center()),
            )
            for image in map(model.image, model.reg_image_ids())
        ]
        xyz, rgb = sparse_points(model)
        return cls(
            source=source,
            names=names,
            cameras=cameras,
            views=sorted(views, key=lambda view: view.name),
            xyz=xyz,
            rgb=rgb,
            on_map=on_map,
            notes=_notes_on_model(source),
            offset=_offset(views, xyz),
        )

    def recentred(self) -> ExportContent:
        """The same about the offset; the user is told."""
        assert self.offset is not None
        offset = self.offset
        self.notes.append(Fact("recentred", offset=offset))
        model = transform_model(self.source.model, translation(-offset))
        return replace(
            self,
            source=replace(self.source, model=model),
            views=[replace(view, cam_in_world=view.cam_in_world - offset) for view in self.views],
            xyz=self.xyz - offset,
            is_recentred=True,
        )

    @property
    def is_metric(self) -> bool:
        """Whether the model is in metres."""
        return self.source.found.scale.unit == "m"

    @property
    def up_in_world(self) -> Array:
        """(3,) unit vector; z where gravity is unknown."""
        return _Z_UP if self.source.up_in_world is None else self.source.up_in_world


def _offset(views: list[View], xyz: Array) -> Array | None:
    """(3,) a point in the middle of a model that lies far from the origin."""
    place = Place.of(np.concatenate([np.array([view.cam_in_world for view in views]).reshape(-1, 3), xyz]))
    return place.pivot() if place is not None and place.is_far else None


def _notes_on_model(source: ExportSource) -> list[Fact]:
    """Notes for the user on the model."""
    notes: list[Fact] = []
    if source.found.scale.unit != "m":
        notes.append(NO_SCALE if source.found.scale.verdict == "refused" else NEVER_SCALED)
    if source.up_in_world is None:
        notes.append(NO_UP)
    elif float(source.up_in_world @ _Z_UP) < 0.9:
        notes.append(Fact("up-is-not-z"))
    return notes
