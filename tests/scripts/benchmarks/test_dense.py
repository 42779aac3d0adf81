"""The dense benchmark's figures on a small scene with true poses, and on answers that are known."""

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.dense.depth_maps import fuse_maps
from colmap_inertial.colmap.dense.sweep_stereo import SweptWorkspace
from colmap_inertial.core.geometry import matrix_from_quat, so3_exp
from colmap_inertial.core.types import CameraModel
from colmap_inertial.io.files import write_json
from colmap_inertial.model.artefacts import write_map
from colmap_inertial.tools.simulate import MotionOptions, SceneRecipe, ShutterCamera, develop, make_scene
from colmap_inertial.tools.simulate.capture import _truth
from scripts.benchmarks import dense as bench
from scripts.common import photo_world

CAMERA = ShutterCamera(
    model=CameraModel(model="PINHOLE", width=256, height=192, params=(208.0, 208.0, 128.0, 96.0)), exposure_s=0.0005
)
RECIPE = SceneRecipe(
    seed=5,
    frame_rate_hz=3.0,
    motion=MotionOptions(kind="orbit", duration_s=3.3, arc_deg=60.0, sweep_s=8.0, vigour=0.3),
    camera=CAMERA,
)
#: The model's unit and frame against the world's.
UNIT_M, TURN, SHIFT_M = 0.4, so3_exp(np.array([[0.3, -0.2, 1.0]]))[0], np.array([0.5, 2.0, -1.0])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A dense workspace made from the truth, swept; the truth; the pictures' names."""
    root = tmp_path_factory.mktemp("bench")
    folder, made = root / "workspace", make_scene(RECIPE)
    renderer, rng = made.renderer(), np.random.default_rng(1)
    middle_s = np.array([CAMERA.middle_s(float(t)) for t in made.trigger_s])
    xyzw, centres = made.camera_pose(CAMERA, middle_s)
    turns = matrix_from_quat(xyzw)
    depths = [renderer.depth_m(CAMERA, made.motion, t) for t in middle_s]
    fx, fy, cx, cy = CAMERA.model.params
    points = []
    for turn, centre, depth in zip(turns, centres, depths, strict=True):
        x, y = rng.integers(0, 256, 60), rng.integers(0, 192, 60)
        rays = np.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, np.ones(60)], axis=1)
        points.append(rays * depth[y, x][:, None] @ turn + centre)
    world = np.concatenate(points)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=256, height=192, params=CAMERA.model.params)
    )
    tracks = [pycolmap.Track() for _ in world]
    (folder / "images").mkdir(parents=True)
    for i, name in enumerate(made.names):
        cam = (world - centres[i]) @ turns[i].T
        x, y = (np.floor(f * cam[:, k] / cam[:, 2] + c).astype(int) for k, (f, c) in enumerate(((fx, cx), (fy, cy))))
        inside = (cam[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < 256) & (y < 192)
        x, y = np.where(inside, x, 0), np.where(inside, y, 0)
        seen = np.flatnonzero(inside & (np.abs(depths[i][y, x] - cam[:, 2]) < 0.02))
        for j, number in enumerate(seen):
            tracks[number].add_element(i + 1, j)
        rotation = turns[i] @ TURN.T
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ (TURN @ centres[i] + SHIFT_M) / UNIT_M)
        observed = [pycolmap.Point2D(np.array([x[n], y[n]]) + 0.5) for n in seen]
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1, points2D=observed)
        model.add_image_with_trivial_frame(image, pose)
        light = renderer.linear(CAMERA, made.motion, float(made.trigger_s[i]))
        cv2.imwrite(str(folder / "images" / name), develop(light, CAMERA, rng)[..., ::-1])
    for point, track in zip(world, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D((TURN @ point + SHIFT_M) / UNIT_M, track, np.zeros(3, np.uint8))
    for name in ("sparse", "stereo"):
        (folder / name).mkdir()
    model.write_binary(str(folder / "sparse"))
    (folder / "stereo" / "fusion.cfg").write_text("\n".join(made.names) + "\n")
    swept = SweptWorkspace(folder, root / "raw")
    swept.begin(None)
    swept.sweep(1, lambda: None)
    write_json(root / "truth.json", _truth(made))
    return folder, bench.truth_of(folder, RECIPE, root / "truth.json"), made.names


def test_depths_of_a_simulated_scene(scene):
    folder, truth, names = scene
    assert truth.metres_per_unit == pytest.approx(UNIT_M, rel=1e-9)
    np.testing.assert_allclose(truth.world_from_model, TURN.T, atol=1e-9)
    figures = bench.depth_figures(folder, truth)
    # with a focal length of 208 px: 1 % of the depth is a fraction of a pixel
    print(figures)
    assert figures.of_all[0] > 0.58
    assert figures.of_kept[0] > 0.74
    assert figures.of_kept[2] > 0.93
    fused = folder / "fused.ply"
    fuse_maps(
        folder, names, (fused, folder / "fused.ply.vis"), maker="plane sweep", kind="geometric",
        scratch=folder / "scratch", context=RunContext(num_threads=1),
    )  # fmt: skip
    surface = bench.surface_figures(bench.points_of(fused), truth)
    print(surface)
    assert surface.precision[1] > 0.8
    assert surface.median_m < 0.006
    # the truth itself is without fault
    perfect = bench.surface_figures((truth.surface_m @ TURN.T + SHIFT_M) / UNIT_M, truth)
    assert perfect.f == pytest.approx((1, 1), abs=1e-3)  # points on the region's border may fall out of it
    half = truth.surface_m[truth.surface_m[:, 0] < np.median(truth.surface_m[:, 0])]
    figures = bench.surface_figures((half @ TURN.T + SHIFT_M) / UNIT_M, truth)
    assert figures.precision == pytest.approx((1, 1), abs=1e-3)
    assert figures.recall[0] == pytest.approx(0.5, abs=0.03)


def test_shares_of_depths_are_counted(scene, tmp_path):
    _, truth, names = scene
    for i, name in enumerate(names):
        off = truth.depth_m[name] * (1 + (0.015 if i % 2 else 0)) / UNIT_M
        off[:96] = 0
        write_map(tmp_path / "stereo" / "depth_maps" / f"{name}.geometric.bin", off.astype("f4"))
    figures = bench.depth_figures(tmp_path, truth)
    near = [np.sum(d[96:] < 2) for d in truth.depth_m.values()]
    every = sum(np.sum(d < 2) for d in truth.depth_m.values())
    assert figures.has == pytest.approx(sum(near) / every)
    assert figures.of_all == pytest.approx((sum(near[::2]) / every, sum(near) / every, sum(near) / every))
    assert figures.of_kept == pytest.approx((sum(near[::2]) / sum(near), 1, 1))


def test_standard_deviations_hold_errors_by_decile(scene, tmp_path):
    folder, truth, names = scene
    # another renderer than the one that they were fitted with
    assert min(bench.sigma_coverage(folder, truth)) > 0.8
    rng = np.random.default_rng(0)
    for name in names:
        true = truth.depth_m[name] / UNIT_M
        sigma = np.where(np.isfinite(true), true, 1) * rng.uniform(0.001, 0.02, true.shape)
        # in the upper half of the deviations, one error in four is too large
        share = sigma / true
        off = np.where((share > 0.0105) & (rng.random(true.shape) < 0.25), 2.5, 1.5) * sigma
        for kind, values in (("geometric", true + off), ("sigma", sigma)):
            file = tmp_path / "stereo" / "depth_maps" / f"{name}.{kind}.bin"
            write_map(file, np.where(np.isfinite(values), values, 0).astype("f4"))
    assert bench.sigma_coverage(tmp_path, truth) == pytest.approx([1] * 5 + [0.75] * 5, abs=0.02)


def test_photographic_things_are_hit_where_they_are():
    texels = np.random.default_rng(0).uniform(0, 255, (8, 8, 3))
    cover = photo_world.Cover(texels=texels, texel_m=0.01)
    ball = photo_world.Sphere(middle=np.array([0.1, 0.0, 0.2]), radius_m=0.1, cover=cover)
    pillar = photo_world.Cylinder(foot=np.array([0.1, 0.0, 0.0]), radius_m=0.1, height_m=0.3, cover=cover)
    sides = np.array([[1.0, 0, 0], [0, 0, 1.0]])
    waves = photo_world.Sheet(corner=np.array([-0.5, 0.5, 0.0]), sides=sides, cover=cover, wave_m=0.03)
    centre = np.array([0.05, -1.0, 0.5])
    rng = np.random.default_rng(1)
    rays = np.array([0.0, 1, -0.2]) + rng.uniform(-0.25, 0.25, (2000, 3)) * [1, 0, 1]
    for thing in (ball, pillar, waves):
        depth, along, normals = thing.hit(centre, rays)
        hit = np.isfinite(depth)
        assert 100 < hit.sum() < 2000
        at = centre + rays[hit] * depth[hit][:, None]
        if thing is ball:
            off = np.linalg.norm(at - ball.middle, axis=1) - ball.radius_m
        elif thing is pillar:
            side = np.hypot(*(at - pillar.foot)[:, :2].T) - pillar.radius_m
            off = np.where(np.abs(at[:, 2] - 0.3) < 1e-9, 0, side)
            assert ((at[:, 2] >= -1e-9) & (at[:, 2] <= 0.3 + 1e-9)).all()
        else:
            a, b = at[:, 0] + 0.5, at[:, 2]
            k = 2 * np.pi / waves.period_m
            # its normal is -y
            off = 0.5 - at[:, 1] - 0.03 * np.sin(k * a) * np.cos(0.6 * k * b)
        np.testing.assert_allclose(off, 0, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(normals[hit], axis=1), 1)
        if thing is not waves:
            # the first of two crossings faces the camera
            assert (np.sum(normals[hit] * rays[hit], axis=1) <= 1e-9).all()
        assert along.shape == (2, 2000)
        assert ((thing.cover.colours(along[:, hit]) >= 0) & (thing.cover.colours(along[:, hit]) <= 255)).all()


@pytest.mark.skipif(not photo_world.PHOTOS.is_dir(), reason="needs ../shared/data/sharp_photos")
def test_a_photographic_world_is_measured(tmp_path, monkeypatch):
    world = photo_world.PhotoWorld.of(1, 160, images=4)
    rendered = [world.render(i) for i in range(4)]
    monkeypatch.setattr(photo_world.PhotoWorld, "render", lambda _, i: rendered[i])
    figures = bench.measure_photo(world, tmp_path / "world")
    assert figures["depth"]["has"] > 0.3
    assert figures["depth"]["of_kept"][2] > 0.75
    truth = bench.photo_truth(world, {f"{i:03d}.jpg": depth for i, (_, depth) in enumerate(rendered)})
    assert bench.surface_figures(truth.surface_m, truth).f == pytest.approx((1, 1), abs=1e-3)
