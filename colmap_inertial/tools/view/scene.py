"""The scene as plain values, independent of a browser."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_conjugate, quat_rotate
from colmap_inertial.core.types import DOWN_IN_WORLD
from colmap_inertial.io.picture_names import picture_in
from colmap_inertial.io.trajectories import read_tum
from colmap_inertial.model import read_model
from colmap_inertial.model.own_place import OwnPlace
from colmap_inertial.run.steps.runner import explaining_losses
from colmap_inertial.run.steps.workspace import Workspace
from colmap_inertial.tools.view.clouds import Cloud, Mesh, centre_and_reach, dense_cloud, read_mesh, sparse_cloud
from colmap_inertial.tools.view.measure import round_length
from colmap_inertial.tools.view.sources import KnownDistance, ScaleFacts, TargetFacts, ViewSource, find_source

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class SceneLimits:
    """Sizes of a drawing, and the first view."""

    pieces: int = 4000
    """Of the path, at most."""
    faces: int = 1_500_000
    """Larger meshes are not shown."""
    gap: float = 10.0
    """A step of the path this many times longer than usual is a gap."""
    start_fov_rad: float = 0.87
    """Angle of view at the beginning, from top to bottom."""
    aspect: float = 1.2
    """The view is at least this much wider than high."""
    filled: float = 0.92
    """Share of the view that the scene takes at the beginning."""
    labels: int = 3
    """Distances of the target that get a label."""
    label_distance: float = 0.2
    """How far apart labels are, as a share of the longest distance."""


LIMITS = SceneLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Cameras:
    """Cameras in the order of their images' names.

    Attributes
    ----------
    names
        Of the images.
    cam_in_world
        (F, 3) centres.
    world_from_cam_xyzw
        (F, 4) rotations.
    vertical_fov_rad, aspect
        (F,) angle of view from the top to the bottom of the image, without distortion; width over height.
    """

    names: tuple[str, ...]
    cam_in_world: Array
    world_from_cam_xyzw: Array
    vertical_fov_rad: Array
    aspect: Array

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False, kw_only=True)
class Ground:
    """A grid below the scene, in metres, and a scale bar on it.

    Attributes
    ----------
    origin
        (3,) the grid's middle.
    along, across
        (3,) horizontal unit vectors: the directions of its lines.
    step_m, cells
        Side of a cell, and number of cells along each side (even).
    bar
        (2, 3) ends of the scale bar, ``bar_m`` apart.
    """

    origin: Array
    along: Array
    across: Array
    step_m: float
    cells: int
    bar: Array
    bar_m: float

    @property
    def side_m(self) -> float:
        """Length of the grid's sides."""
        return self.step_m * self.cells


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """All that is shown of one model, in the model's own world; lengths in ``scale.unit``.

    Attributes
    ----------
    out, source
        The folder that was asked for, and what was found in it.
    cloud, mesh
        Points, and the surface where there is one.
    mesh_note
        Why there is no mesh, where a file is there; else ``None``.
    cameras
        All of them.
    path, path_percent
        (S, 2, 3) pieces of the camera's path; (S, 2) by how much a refinement stretched it there, ``None`` without one.
    up_in_world
        (3,) unit vector.
    gravity_known
        Whether it is against gravity; otherwise the mean direction of the images' upper edges.
    centre, reach
        (3,) middle of the scene, and how far around it nearly everything is.
    ground
        ``None`` for a model without a scale.
    start
        (3,) where one looks at the scene from in the beginning.
    target_lines, labelled
        Of the validator's target: (K, 2, 3) lines between neighbouring corners; distances that get a label.
    offset_in_world
        (3,) the point of the model's world that all coordinates here count from: its origin, unless that is far away.
    """

    out: Path
    source: ViewSource
    cloud: Cloud
    mesh: Mesh | None
    mesh_note: Fact | None
    cameras: Cameras
    path: Array
    path_percent: Array | None
    up_in_world: Array
    gravity_known: bool
    centre: Array
    reach: float
    ground: Ground | None
    start: Array
    target_lines: Array
    labelled: tuple[KnownDistance, ...]
    offset_in_world: Array

    @property
    def scale(self) -> ScaleFacts:
        """Facts on the model's scale."""
        return self.source.scale

    @property
    def target(self) -> TargetFacts | None:
        """The validator's target."""
        return self.source.target

    def image_of(self, camera: int) -> Path | None:
        """The file of a camera's image; ``None`` where none of the folders has it."""
        name = self.cameras.names[camera]
        paths = (picture_in(folder, name, self.source.folder) for folder in self.source.images if folder.is_dir())
        return next((path for path in paths if path.is_file()), None)

    def pickable(self) -> Array:
        """(N, 3) points that one can measure between: the cloud's, and the target's corners."""
        corners = list(self.target.corners.values()) if self.target is not None else []
        return np.concatenate([self.cloud.xyz.astype(np.float64), np.array(corners).reshape(-1, 3)])


def load_scene(out: Path, *, model: int | None = None, images: Path | None = None, max_points: int = 400_000) -> Scene:
    """Load what is shown.

    Parameters
    ----------
    out
        What ``reconstruct`` or ``apply`` wrote, or any folder with a COLMAP model.
    model
        Number of the model; ``None`` takes the largest.
    images
        Folder with the model's images, where they are not beside it.
    max_points
        Show no more points than this, evenly chosen.

    Raises
    ------
    FormatError
        Where there is nothing to show, or something is damaged or unfinished.
    """
    if max_points < 1:
        raise ValueError(f"max_points must be positive, not {max_points}")
    with explaining_losses(Workspace(Path(out))):
        source = find_source(Path(out), model, images=images)
        reconstruction = read_model(source.folder)
    # browsers draw in single precision
    place = OwnPlace.of(reconstruction)
    reconstruction, source = place.enter(reconstruction), _about(source, place)
    cameras = _cameras(reconstruction)
    if source.fused is not None and source.fused.is_file():
        cloud = dense_cloud(source.fused, max_points, place.pivot)
    else:
        cloud = sparse_cloud(reconstruction, max_points)
    mesh, mesh_note = None, None
    if source.mesh is not None and source.mesh.is_file():
        mesh = read_mesh(source.mesh, LIMITS.faces, place.pivot)
        mesh_note = None if mesh is not None else Fact("mesh-not-shown", most_faces=LIMITS.faces)
    up, gravity_known = _find_up(source, cameras)
    centre, reach = centre_and_reach(cloud.xyz.astype(np.float64), cameras.cam_in_world)
    side = _side(centre, reach, up, cameras)
    ground = _ground(cloud, cameras, centre, reach, up, side) if source.scale.unit == "m" else None
    near = cameras.cam_in_world[np.linalg.norm(cameras.cam_in_world - centre, axis=1) <= 1.001 * reach]
    seen = near if ground is None else np.concatenate([near, ground.bar])
    start = centre + _distance(side, reach, up, seen - centre) * side
    lines, labelled = _target_parts(source.target)
    path, path_percent = _path(source, cameras, place)
    return Scene(
        out=Path(out),
        source=source,
        cloud=cloud,
        mesh=mesh,
        mesh_note=mesh_note,
        cameras=cameras,
        path=path,
        path_percent=path_percent,
        up_in_world=up,
        gravity_known=gravity_known,
        centre=centre,
        reach=reach,
        ground=ground,
        start=start,
        target_lines=lines,
        labelled=labelled,
        offset_in_world=np.zeros(3) if place.pivot is None else place.pivot,
    )


def _about(source: ViewSource, place: OwnPlace) -> ViewSource:
    """What is shown, its target where the model is."""
    if place.pivot is None or source.target is None:
        return source
    corners = {name: xyz - place.pivot for name, xyz in source.target.corners.items()}
    return replace(source, target=replace(source.target, corners=corners))


def _cameras(reconstruction: pycolmap.Reconstruction) -> Cameras:
    images = sorted((reconstruction.image(i) for i in reconstruction.reg_image_ids()), key=lambda image: image.name)
    intrinsics = [reconstruction.camera(image.camera_id) for image in images]
    poses = np.array([image.cam_from_world().rotation.quat for image in images])
    height = np.array([camera.height for camera in intrinsics], dtype=np.float64)
    focal = np.array([camera.mean_focal_length() for camera in intrinsics])
    focal = np.where(focal > 0, focal, height)  # those that see all around have none
    return Cameras(
        names=tuple(image.name for image in images),
        cam_in_world=np.array([image.projection_center() for image in images]),
        world_from_cam_xyzw=quat_conjugate(poses),
        vertical_fov_rad=2 * np.arctan(0.5 * height / focal),
        aspect=np.array([camera.width for camera in intrinsics]) / height,
    )


def _find_up(source: ViewSource, cameras: Cameras) -> tuple[Array, bool]:
    """The direction against gravity, and whether it is known; otherwise that of the images' upper edges."""
    if source.down_in_world is not None:
        return -source.down_in_world / np.linalg.norm(source.down_in_world), True
    edges = quat_rotate(cameras.world_from_cam_xyzw, np.array([0.0, -1.0, 0.0])).mean(axis=0)
    if source.gravity_on_axis:
        return max((-down for down in DOWN_IN_WORLD.values()), key=lambda up: float(up @ edges)), True
    length = float(np.linalg.norm(edges))
    return (edges / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])), False


def _path(source: ViewSource, cameras: Cameras, place: OwnPlace) -> tuple[Array, Array | None]:
    """Pieces of the smoothed path where there is one, else between cameras in the order of their names; its stretch."""
    places, percent = cameras.cam_in_world, None
    if source.trajectory is not None and source.trajectory.is_file():
        trajectory = read_tum(source.trajectory)
        places = trajectory.cam_in_world - (0 if place.pivot is None else place.pivot)
        if source.stretched:
            # both begin with the first image
            middles_s = [0.5 * (part.begin_s + part.end_s) - source.stretched[0].begin_s for part in source.stretched]
            percent = np.interp(trajectory.t_s, middles_s, [part.percent for part in source.stretched])
    every = -(-len(places) // LIMITS.pieces)
    pieces = _pieces(places[::every])
    length = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1)
    shown = length <= LIMITS.gap * np.median(length) if len(pieces) else np.zeros(0, dtype=np.bool_)
    return pieces[shown], None if percent is None else _pieces(percent[::every])[shown]


def _pieces(values: Array) -> Array:
    return np.stack([values[:-1], values[1:]], axis=1)


def _side(centre: Array, reach: float, up: Array, cameras: Cameras) -> Array:
    """(3,) unit vector from the scene to where it is looked at from: the side of the cameras, a little above."""
    towards = cameras.cam_in_world.mean(axis=0) - centre
    level = towards - (towards @ up) * up
    if np.linalg.norm(level) < 0.05 * reach:  # cameras all around, or above
        level = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    level = level / np.linalg.norm(level)
    across = np.cross(up, level)
    # a little from the side: depth is seen better than from straight behind
    side: Array = np.cos(0.5) * (np.cos(0.45) * level + np.sin(0.45) * across) + np.sin(0.5) * up
    return side


def _distance(side: Array, reach: float, up: Array, must_be_seen: Array) -> float:
    """Distance from which all of these points (N, 3) are visible, from the scene's middle."""
    right = np.cross(up, side)
    right /= np.linalg.norm(right)
    above = np.cross(side, right)
    beside = np.maximum(np.abs(must_be_seen @ right) / LIMITS.aspect, np.abs(must_be_seen @ above))
    needed = beside / np.tan(0.5 * LIMITS.start_fov_rad * LIMITS.filled) + must_be_seen @ side
    return float(np.clip(needed.max(initial=0.0), 1.5 * reach, 6 * reach))


def _ground(cloud: Cloud, cameras: Cameras, centre: Array, reach: float, up: Array, side: Array) -> Ground:
    xyz = cloud.xyz.astype(np.float64)
    near = xyz[np.linalg.norm(xyz - centre, axis=1) < 1.5 * reach]
    height = float(np.percentile((near if len(near) else cameras.cam_in_world) @ up, 2))
    # along one of the world's axes, so that lines of the grid are lines of equal coordinates
    axis = np.eye(3)[np.argmin(np.abs(up))]
    along = axis - (axis @ up) * up
    along /= np.linalg.norm(along)
    across = np.cross(up, along)
    step = round_length(reach / 5)
    half = int(np.ceil(reach / step))

    def on_lines(direction: Array) -> float:
        return step * round(float(centre @ direction) / step)

    origin = on_lines(along) * along + on_lines(across) * across + height * up
    # the bar lies along the side of the grid that faces the viewer
    outward = max((s * v for s in (1, -1) for v in (along, across)), key=lambda v: float(v @ side))
    bar_m = round_length(0.6 * reach)
    beside = np.cross(up, outward)
    middle = origin + (half * step + 0.06 * reach) * outward
    bar = middle + np.array([[-0.5], [0.5]]) * bar_m * beside
    return Ground(origin=origin, along=along, across=across, step_m=step, cells=2 * half, bar=bar, bar_m=bar_m)


def _target_parts(target: TargetFacts | None) -> tuple[Array, tuple[KnownDistance, ...]]:
    """Lines between neighbouring corners, and a few long distances whose labels do not hide each other."""
    if target is None or not target.corners or not target.distances:
        return np.zeros((0, 2, 3)), ()
    placed = [d for d in target.distances if set(d.pair) <= target.corners.keys()]
    shortest = min((d.known_m for d in placed), default=0.0)

    def ends(distance: KnownDistance) -> Array:
        return np.array([target.corners[name] for name in distance.pair])

    neighbours = [ends(d) for d in placed if d.known_m < 1.01 * shortest]
    labelled: list[KnownDistance] = []
    for distance in sorted(placed, key=lambda d: -d.known_m):
        middle = ends(distance).mean(axis=0)
        longest = labelled[0].known_m if labelled else 0.0
        apart = [float(np.linalg.norm(ends(other).mean(axis=0) - middle)) for other in labelled]
        if all(a > LIMITS.label_distance * longest for a in apart):
            labelled.append(distance)
        if len(labelled) == LIMITS.labels:
            break
    return np.array(neighbours).reshape(-1, 2, 3), tuple(labelled)
