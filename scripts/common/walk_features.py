"""Features of a walk without pictures: points on its walls, their descriptors, where each frame sees them.

A thousand times quicker than to draw pictures and look for features in them. Copies of one texture have the same
descriptors, but for noise; so what hangs many times looks the same as it can.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.model import colmap_camera
from colmap_inertial.tools.simulate import Quad, World
from scripts.common.walk_scenes import Walk, motion_of, places_m, world_of

#: Features for each square metre of a poster, and of a wall or floor.
POSTER_PER_M2, WALL_PER_M2 = 90.0, 25.0
#: A feature is found this often; noise of its place and of its descriptor, of which two then lie .3 rad apart.
FOUND, NOISE_PX, NOISE = 0.75, 0.5, 0.25
#: Farther away, nothing is found.
FARTHEST_M = 6.0


def points_of(world: World, rng: np.random.Generator, density: float) -> tuple[Array, Array]:
    """(P, 3) points on all pieces, (P, 128) their descriptors of length one: equal where textures are the same."""
    known: dict[int, tuple[Array, Array]] = {}
    points, descriptors = [], []
    for quad in world.quads:
        size = [float(np.linalg.norm(edge)) for edge in (quad.edge_u_m, quad.edge_v_m)]
        if id(quad.texture) not in known:
            per_m2 = POSTER_PER_M2 if size[1] < 1.3 else WALL_PER_M2
            count = int(density * per_m2 * size[0] * size[1])
            drawn = rng.gamma(0.5, size=(count, 128))
            known[id(quad.texture)] = rng.uniform(0, 1, (count, 2)), drawn / np.linalg.norm(drawn, axis=1)[:, None]
        uv, described = known[id(quad.texture)]
        points.append(quad.corner_m + uv @ np.stack([quad.edge_u_m, quad.edge_v_m]))
        descriptors.append(described)
    return np.concatenate(points), np.concatenate(descriptors)


def seen(walk: Walk, world: World, points: Array, names: Sequence[str]) -> Iterator[tuple[Array, Array]]:
    """Of each frame: which points it sees, and where (K, 2)."""
    motion, camera = motion_of(walk), walk.camera()
    model = colmap_camera(camera.model)
    size = np.array([camera.model.width, camera.model.height])
    for index in range(len(names)):
        at_s = camera.middle_s(index / walk.frame_rate_hz)
        centre = motion.cam_in_world_m(np.array([at_s]))[0]
        world_from_cam = matrix_from_quat(motion.world_from_cam_xyzw(np.array([at_s])))[0]
        in_cam = (points - centre) @ world_from_cam
        before = np.flatnonzero((in_cam[:, 2] > 0.3) & (np.linalg.norm(in_cam, axis=1) < FARTHEST_M))
        xy = np.asarray(model.img_from_cam(in_cam[before]))[:, :2]
        inside = ((xy > 4) & (xy < size - 4)).all(axis=1)
        before, xy = before[inside], xy[inside]
        met = places_m(_around(world, centre), np.tile(centre, (len(before), 1)), points[before] - centre)
        shown = np.linalg.norm(met - points[before], axis=1) < 1e-3
        yield before[shown], xy[shown]


def _around(world: World, centre: Array) -> World:
    """What may hide anything that is near enough to be found."""

    def near(quad: Quad) -> bool:
        across = quad.edge_u_m + quad.edge_v_m
        away = float(np.linalg.norm(quad.corner_m + across / 2 - centre))
        return away < FARTHEST_M + float(np.linalg.norm(across)) / 2

    return dataclasses.replace(world, quads=tuple(filter(near, world.quads)))


def write_features(walk: Walk, names: Sequence[str], database: Path, *, density: float = 1.0) -> None:
    """COLMAP's database of a walk: camera, images, keypoints, descriptors."""
    import pycolmap

    rng = np.random.default_rng([walk.seed, 5])
    world = world_of(walk)
    points, descriptors = points_of(world, rng, density)
    database.unlink(missing_ok=True)
    with pycolmap.Database.open(str(database)) as opened:
        known = colmap_camera(walk.camera().model)
        known.has_prior_focal_length = True  # as COLMAP notes where it is told a camera; else it changes it
        camera = opened.write_camera(known)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera))
        rig_id = opened.write_rig(rig)
        for number, (name, (which, xy)) in enumerate(zip(names, seen(walk, world, points, names), strict=True), 1):
            found = rng.random(len(which)) < FOUND
            which, xy = which[found], xy[found] + NOISE_PX * rng.standard_normal((int(found.sum()), 2))
            image = opened.write_image(pycolmap.Image(name=name, camera_id=camera))
            frame = pycolmap.Frame(frame_id=number, rig_id=rig_id)
            frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera), image))
            opened.write_frame(frame)
            keypoints = np.zeros((len(which), 6), dtype=np.float32)
            keypoints[:, :2] = xy
            keypoints[:, 2] = keypoints[:, 5] = 2 + 5 * rng.random(len(which)) ** 3
            opened.write_keypoints(image, keypoints)
            own = np.maximum(descriptors[which] + NOISE / 128**0.5 * rng.standard_normal((len(which), 128)), 0)
            stored = np.round(512 * own / np.linalg.norm(own, axis=1)[:, None]).clip(0, 255).astype(np.uint8)
            opened.write_descriptors(
                image, pycolmap.FeatureDescriptors(type=pycolmap.FeatureExtractorType.SIFT, data=stored)
            )
