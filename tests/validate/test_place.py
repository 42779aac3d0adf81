"""Where two views say that a target is."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from colmap_inertial.core.geometry import so3_exp
from colmap_inertial.validate import parse_target, place
from colmap_inertial.validate.place import _choose_pairs
from colmap_inertial.validate.views import Sighting, View

TARGET = parse_target("checkerboard:5x4:0.05")


def seen_from(view, rotation, centre, corners, world):
    """A view at ``centre`` with (3, 3) cam_from_world, and the exact directions of corners."""
    in_cam = (world[corners] - centre) @ rotation.T
    ray = in_cam / np.linalg.norm(in_cam, axis=1, keepdims=True)
    sighting = Sighting(
        view=view,
        part=0,
        corner=corners,
        xy_px=500 * in_cam[:, :2] / in_cam[:, 2:],
        ray=ray,
        px_from_tangent=np.zeros((len(corners), 2, 3)),
    )
    pose = View(
        name=f"{view}.jpg",
        path=Path(f"{view}.jpg"),
        camera=None,
        cam_from_world=rotation,
        cam_from_world_t=-rotation @ centre,
    )
    return sighting, pose


def test_exact_rays_of_two_views_place_the_target_exactly(subtests):
    """By the rays alone: the fit that follows would hide an error of the start."""
    for seed in range(4):
        with subtests.test(seed=seed), pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.setattr(place, "settle", lambda obs, at, **_: at)
            monkeypatch.setattr(place, "observe", lambda *_: None)
            rng = np.random.default_rng(seed)
            scale, rotation, centre = 2.5, so3_exp(rng.uniform(-1, 1, 3)), rng.uniform(-1, 1, 3)
            world = scale * TARGET.corners_m @ rotation.T + centre
            middle = world.mean(axis=0)
            sightings, views = [], []
            for view in range(2):
                turn = so3_exp(rng.uniform(-2, 2, 3))
                # it looks at the target from some metres away, a little past its middle
                away = turn.T @ np.array([0.1, -0.05, 2.0 + view])
                corners = np.sort(rng.permutation(len(world))[:10])
                sighting, pose = seen_from(view, turn, middle - away, corners, world)
                sightings.append(sighting)
                views.append(pose)
            assert len(np.intersect1d(sightings[0].corner, sightings[1].corner)) >= 4
            found = place._place_by_pair(*sightings, 0, TARGET, views)
            assert found is not None
            assert np.exp(found.log_scale) == pytest.approx(scale, rel=1e-9)
            assert found.rotation.reshape(3, 3) == pytest.approx(rotation, abs=1e-9)
            assert found.centre.reshape(3) == pytest.approx(centre, abs=1e-9)


def test_rays_that_meet_behind_the_views_place_nothing():
    world = TARGET.corners_m
    behind = [
        seen_from(view, so3_exp(np.array([0.0, np.pi + 0.1 * view, 0.0])), np.array([view, 0.0, -2.0]), corners, world)
        for view, corners in enumerate([np.arange(12), np.arange(12)])
    ]
    flipped = [Sighting(**{**vars(sighting), "ray": -sighting.ray}) for sighting, _ in behind]
    assert place._place_by_pair(*flipped, 0, TARGET, [pose for _, pose in behind]) is None


def test_sightings_are_paired_where_their_lines_of_sight_meet():
    views = [SimpleNamespace(cam_from_world=np.eye(3))] * 3
    rays = [Rotation.from_euler("y", deg, degrees=True).apply([0.0, 0.0, 1.0]) for deg in (0.0, 20.0, 40.0)]
    sightings = [SimpleNamespace(view=i, ray=ray[None]) for i, ray in enumerate(rays)]
    assert _choose_pairs(sightings, views, 0) == [(0, 1), (0, 2), (1, 2)]
    assert _choose_pairs([sightings[0], sightings[0]], views, 0) == []  # of one view
