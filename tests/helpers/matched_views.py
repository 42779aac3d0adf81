"""Databases of features and matches that a camera truly sees on its way."""

import numpy as np
import pycolmap

from colmap_inertial.core.geometry import so3_exp

CAMERA = pycolmap.Camera(model="PINHOLE", width=752, height=480, params=[458, 458, 376, 240])
CAMERA.has_prior_focal_length = True


def see_room(rng):
    """Points of a floor and two walls."""
    floor = np.column_stack([rng.uniform(-3, 3, 4000), np.full(4000, 1.2), rng.uniform(0.5, 6, 4000)])
    back = np.column_stack([rng.uniform(-3, 3, 2000), rng.uniform(-2, 1.2, 2000), np.full(2000, 6)])
    left = np.column_stack([np.full(1500, -3), rng.uniform(-2, 1.2, 1500), rng.uniform(0.5, 6, 1500)])
    return np.concatenate([floor, back, left])


def see_wall(rng):
    """Points of a wall."""
    return np.column_stack([rng.uniform(-4, 4, 4000), rng.uniform(-3, 3, 4000), np.full(4000, 2.0)])


def see_slope(relief_m):
    """Points of a slope, half of them up to so much off it."""

    def see(rng):
        points = np.column_stack([rng.uniform(-4, 4, 6000), rng.uniform(-3, 3, 6000), np.zeros(6000)])
        points[:, 2] = relief_m * rng.random(6000) * (rng.random(6000) < 0.5)
        return points @ so3_exp(np.array([1.0, 0, 0])).T + [0, 0, 3]

    return see


def match_views(path, world_from_cam, centre, pairs, noise_px=0.3, see=see_room, most=200):
    """A database of features with noise, and of matches, a twentieth of them wrong, as COLMAP verifies them.

    A pair has so many matches at most.
    """
    rng = np.random.default_rng(4)
    points = see(rng)
    names = tuple(f"{k:04}.png" for k in range(len(centre)))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    seen = []
    with pycolmap.Database.open(str(path)) as database:
        camera = database.write_camera(CAMERA)
        images = [database.write_image(pycolmap.Image(name=name, camera_id=camera)) for name in names]
        for image, rotation, at in zip(images, world_from_cam, centre, strict=True):
            there = (points - at) @ rotation
            before = np.flatnonzero(there[:, 2] > 0.3)
            xy_px = CAMERA.img_from_cam(there[before])
            kept = ((xy_px > 0) & (xy_px < [CAMERA.width, CAMERA.height])).all(axis=1) & (rng.random(len(xy_px)) < 0.7)
            xy_px = xy_px[kept] + noise_px * rng.standard_normal((int(kept.sum()), 2))
            database.write_keypoints(image, xy_px.astype(np.float32))
            seen.append((before[kept], xy_px))
        for i, j in pairs:
            _, first, second = np.intersect1d(seen[i][0], seen[j][0], return_indices=True)
            some = rng.permutation(len(first))[:most]
            matches = np.column_stack([first, second])[some].astype(np.uint32)
            wrong = rng.random(len(matches)) < 0.05
            matches[wrong, 1] = rng.integers(0, len(seen[j][0]), int(wrong.sum()))
            views = pycolmap.estimate_calibrated_two_view_geometry(
                CAMERA, seen[i][1], CAMERA, seen[j][1], matches, options
            )
            database.write_two_view_geometry(images[i], images[j], views)
    return names
