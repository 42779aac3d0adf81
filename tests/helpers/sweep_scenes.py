"""A box-shaped room seen by posed cameras: depth and normals in closed form, colour from noise in space."""

import numpy as np

from colmap_inertial.core.geometry import so3_exp
from colmap_inertial.imaging.plane_sweep import DepthView, Partner, Pinhole, Sights
from tests.helpers.box_project import HIGH, LOW, cast

_GRAIN_M = 0.06
_VOLUME = np.random.default_rng(3).uniform(0, 255, (64, 64, 64)).astype("f4")


def camera(centre, turn_deg=(0.0, 0.0, 0.0), *, width=120, height=90, focal=(100.0, 102.0), shift=(1.3, -0.8)):
    """Looks along the world's y axis, upright, before it is turned about its own axes."""
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return Pinhole(
        width=width,
        height=height,
        focal_px=np.array(focal),
        centre_px=np.array([(width - 1) / 2 + shift[0], (height - 1) / 2 + shift[1]]),
        cam_from_world=so3_exp(np.radians(np.array([turn_deg])))[0] @ upright,
        cam_in_world=np.array(centre, dtype=float),
    )


def rays(view):
    """(H, W, 3) directions of the pixels' centres, z = 1."""
    y, x = np.indices((view.height, view.width), dtype=float)
    (fx, fy), (cx, cy) = view.focal_px, view.centre_px
    return np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)


def depth_of(view):
    """(H, W) depths and (H, W, 3) normals towards the camera, in its frame."""
    return cast(view.cam_from_world.T, view.cam_in_world, rays(view))


def picture_of(view):
    """(H, W) grey values: a volume of noise cut by the walls."""
    depth, _ = depth_of(view)
    points = view.cam_in_world + (rays(view) * depth[..., None]) @ view.cam_from_world
    at = points / _GRAIN_M
    low = np.floor(at).astype(int)
    part = at - low
    total = np.zeros(depth.shape)
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, part, 1 - part), axis=-1)
        total += weight * _VOLUME[tuple(np.moveaxis((low + corner) % 64, -1, 0))]
    return np.clip(total, 0, 255).astype(np.uint8)


def partner(view):
    return Partner(codes=picture_of(view), camera=view)


def depth_view(view):
    return DepthView(depth=depth_of(view)[0].astype("f4"), camera=view)


def sights_of(views, points=600, seed=0):
    """Points on the walls, and which views have them in the picture."""
    rng = np.random.default_rng(seed)
    world = rng.uniform(LOW, HIGH, (points, 3))
    axis, side = rng.integers(0, 3, points), rng.integers(0, 2, points)
    world[np.arange(points), axis] = np.where(side, HIGH[axis], LOW[axis])
    observed = []
    for view in views:
        cam = (world - view.cam_in_world) @ view.cam_from_world.T
        px = cam @ view.matrix.T
        px = px[:, :2] / px[:, 2:]
        inside = (px >= 0).all(axis=1) & (px[:, 0] <= view.width - 1) & (px[:, 1] <= view.height - 1)
        observed.append(np.flatnonzero((cam[:, 2] > 0) & inside))
    return Sights.of(views, world, observed)
