"""Depth and normal maps in files: COLMAP reads and fuses what the sweep writes; cut off, it goes on."""

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.dense import sweep_stereo
from colmap_inertial.colmap.dense.depth_maps import MadeFrom, choose_maker, coverage, find_maps, fuse_maps, map_file
from colmap_inertial.colmap.dense.sweep_stereo import SweptWorkspace
from colmap_inertial.core.errors import FormatError
from colmap_inertial.model.artefacts import read_map, write_map
from tests.helpers.box_project import off_the_walls
from tests.helpers.sweep_scenes import camera, depth_of, picture_of, sights_of
from tests.run.commands.test_dense_steps import vertices

VIEWS = [camera((x, -0.6 + z, 0.3 + z), (5 * z, -6 * x, 20 * x)) for x in (-0.5, -0.2, 0.2, 0.5) for z in (-0.15, 0.15)]
#: One in a folder; the last one sees nothing that others see.
NAMES = ["a/first.png", *(f"{i}.png" for i in range(1, len(VIEWS))), "z_alone.png"]
ALONE = camera((0, 0, 0.3), (0, 180, 0))


@pytest.fixture
def workspace(tmp_path):
    """A dense workspace of the room, without maps."""
    folder = tmp_path / "workspace"
    views = [*VIEWS, ALONE]
    sights = sights_of(views, points=1500)
    model = pycolmap.Reconstruction()
    first = VIEWS[0]
    fx, fy, cx, cy = *first.focal_px, *(first.centre_px + 0.5)
    params = [fx, fy, cx, cy]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=first.width, height=first.height, params=params)
    )
    for i, (name, view) in enumerate(zip(NAMES, views, strict=True)):
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / "images" / name), picture_of(view))
        points = [pycolmap.Point2D([1.0, 1.0]) for _ in sights.of_view[i]]
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1, points2D=points)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(view.cam_from_world), -view.cam_from_world @ view.cam_in_world)
        model.add_image_with_trivial_frame(image, pose)
    for number, point in enumerate(sights.points):
        track = pycolmap.Track()
        for i, seen in enumerate(sights.of_view):
            for j in np.flatnonzero(seen == number):
                track.add_element(i + 1, int(j))
        if track.length() > 1:
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    for name in ("sparse", "stereo/depth_maps", "stereo/normal_maps", "stereo/consistency_graphs"):
        (folder / name).mkdir(parents=True)
    model.write_binary(str(folder / "sparse"))
    (folder / "stereo" / "fusion.cfg").write_text("\n".join(NAMES) + "\n")
    return folder


def sweep(folder, raw, identity="same", progress=lambda: None):
    made = SweptWorkspace(folder, raw)
    made_from = MadeFrom(model=identity, max_image_size=None, maps="plane sweep")
    made.begin({"made_from": made_from, "images": [("a", 1)]})
    made.sweep(1, progress)
    return made


def test_maps_are_what_colmap_reads(tmp_path):
    rng = np.random.default_rng(0)
    depth, normals = rng.uniform(1, 2, (5, 7)).astype("f4"), rng.normal(size=(5, 7, 3)).astype("f4")
    write_map(tmp_path / "new" / "d.bin", depth)
    write_map(tmp_path / "n.bin", normals)
    theirs = pycolmap.DepthMap()
    theirs.read(str(tmp_path / "new" / "d.bin"))
    np.testing.assert_array_equal(theirs.to_array(), depth)
    theirs = pycolmap.NormalMap()
    theirs.read(str(tmp_path / "n.bin"))
    # its array is the planes one after the other, whatever its shape says
    np.testing.assert_array_equal(theirs.to_array().ravel(), np.moveaxis(normals, -1, 0).ravel())
    np.testing.assert_array_equal(read_map(tmp_path / "new" / "d.bin"), depth)
    np.testing.assert_array_equal(read_map(tmp_path / "n.bin", 3), normals)
    with pytest.raises(FormatError, match="channels"):
        read_map(tmp_path / "n.bin")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["d.bin"]


def test_a_workspace_gets_maps_that_colmap_fuses(workspace, tmp_path):
    heard = []
    made = sweep(workspace, tmp_path / "raw", progress=lambda: heard.append(1))
    assert len(heard) == 2 * len(NAMES)
    kind, mapped = find_maps(workspace, NAMES)
    assert (kind, mapped) == ("geometric", NAMES[:-1])
    assert 0.7 < coverage(workspace, mapped, kind) <= 1
    for name, view in zip(made.names, made.sights.views, strict=True):
        if name in mapped:
            truth, facing = depth_of(view)
            depth = read_map(map_file(workspace, "depth", name))
            normals = read_map(map_file(workspace, "normal", name), 3)
            known = depth > 0
            assert np.median(np.abs(depth / truth - 1)[known]) < 0.01
            # standard deviations stand beside depths, in a format that COLMAP reads
            theirs = pycolmap.DepthMap()
            theirs.read(str(map_file(workspace, "depth", name, "sigma")))
            sigma = theirs.to_array()
            assert sigma.dtype == np.float32 and np.array_equal(sigma > 0, known)
            assert np.mean((np.abs(depth - truth) <= 2 * sigma)[known]) > 0.8
            angle = np.degrees(np.arccos(np.clip(np.sum(normals * facing, axis=-1)[known], -1, 1)))
            assert np.median(angle) < 15
    options = pycolmap.StereoFusionOptions()
    options.num_threads, options.min_num_pixels, options.max_normal_error = 1, 3, 40
    fused = pycolmap.stereo_fusion(
        str(tmp_path / "fused.ply"), str(workspace), input_type="geometric", options=options, output_type="PLY"
    )
    points = np.array([point.xyz for point in fused.points3D.values()])
    assert len(points) > 2000
    assert np.median(off_the_walls(points)) < 0.03


def test_exact_depths_of_pixel_centres_are_fused_exactly(workspace, tmp_path):
    for name, view in zip(NAMES, VIEWS, strict=False):
        depth, normals = depth_of(view)
        write_map(map_file(workspace, "depth", name), depth.astype("f4"))
        write_map(map_file(workspace, "normal", name), normals.astype("f4"))
    away = {}
    for maker in ("plane sweep", "patch-match"):
        cloud = tmp_path / f"{maker}.ply"
        fuse_maps(
            workspace, NAMES[:-1], (cloud, tmp_path / "fused.ply.vis"), maker=maker, kind="geometric",
            scratch=tmp_path / "scratch", context=RunContext(num_threads=1),
        )  # fmt: skip
        away[maker] = np.percentile(off_the_walls(vertices(cloud)), 90)
    assert away["plane sweep"] < 1e-4 < 1e-3 < away["patch-match"]
    assert not (tmp_path / "scratch").exists()


def test_a_sweep_that_was_cut_off_goes_on(workspace, tmp_path, monkeypatch):
    raw, calls, matched = tmp_path / "raw", [], sweep_stereo.sweep_depth
    monkeypatch.setattr(sweep_stereo, "sweep_depth", lambda *a, **k: calls.append(1) or matched(*a, **k))

    class Killed(BaseException):
        pass

    def stop_after(number):
        heard = []

        def progress():
            heard.append(1)
            if len(heard) == number:
                raise Killed

        return progress

    for number, done in ((3, 3), (len(NAMES) + 2, len(VIEWS))):
        with pytest.raises(Killed):
            sweep(workspace, raw, progress=stop_after(number))
        assert len(calls) == done
    assert 0 < len(find_maps(workspace, NAMES)[1]) < len(VIEWS)
    sweep(workspace, raw)
    assert len(calls) == len(VIEWS)
    whole = {name: map_file(workspace, "depth", name).read_bytes() for name in NAMES[:-1]}
    # one map that is missing is written again, the same
    sigma = map_file(workspace, "depth", NAMES[1], "sigma")
    content = sigma.read_bytes()
    sigma.unlink()
    sweep(workspace, raw)
    assert sigma.read_bytes() == content and len(calls) == len(VIEWS)
    # in one go it is the same; of something else, all of it is made again
    sweep(workspace, raw, identity="other")
    assert len(calls) == 2 * len(VIEWS)
    assert {name: map_file(workspace, "depth", name).read_bytes() for name in NAMES[:-1]} == whole


@pytest.mark.parametrize("cuda", [False, True])
def test_whoever_began_the_maps_goes_on(workspace, monkeypatch, cuda):
    monkeypatch.setattr(pycolmap, "has_cuda", cuda)
    made_from, has_maps = choose_maker(workspace, "model", None)
    assert (made_from.maps, made_from.max_image_size) == (("patch-match", None) if cuda else ("plane sweep", 1200))
    assert not has_maps
    write_map(map_file(workspace, "depth", NAMES[0]), np.ones((4, 4), dtype="f4"))
    made_from.write(workspace)
    monkeypatch.setattr(pycolmap, "has_cuda", not cuda)
    assert choose_maker(workspace, "model", None) == (made_from, True)
