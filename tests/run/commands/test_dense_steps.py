"""The dense stage: undistortion, fusion and meshing by COLMAP; depth maps by our sweep, or cast for patch-match's."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
import time

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.dense import depth_maps
from colmap_inertial.colmap.dense.tsdf import require_mesh_maker, tsdf_mesh
from colmap_inertial.colmap.settings import ColmapSettings
from colmap_inertial.core.errors import InertialError, OutputError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.options import DenseOptions, ProjectOptions, ReconstructOptions
from colmap_inertial.io.ply import read_ply_header
from colmap_inertial.model import read_model
from colmap_inertial.model.artefacts import read_map, write_map
from colmap_inertial.run.commands import dense_steps as dense_stage
from colmap_inertial.run.commands.reconstruct_project import reconstruct_project
from tests.helpers.box_project import HIGH, LOW, build, cast, off_the_walls, rays
from tests.run.commands.test_reconstruct_project import contents, run

QUICK = ReconstructOptions(dense=True, dense_options=DenseOptions(max_image_size=96), refine="off", deterministic=True)
SPARSE = ["--deterministic", "--refine", "off"]
FLAGS = ["--dense", "--dense-options.max-image-size", "96", *SPARSE]


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """With few points, as every step reads them. Tests must not change it."""
    return build(tmp_path_factory.mktemp("box"), every=8, points=500)


@pytest.fixture(scope="module")
def waiting(box, tmp_path_factory):
    """Everything but the depth maps, which patch-match is to make. Tests must not change it."""
    out = tmp_path_factory.mktemp("dense") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pycolmap, "has_cuda", True)
        patch.setattr(dense_stage, "patch_match", lambda *_: None)
        result = reconstruct_project(box.root, out, source(box), QUICK)
    return out, result


@pytest.fixture
def unfinished(waiting, tmp_path):
    """A copy to change, in which patch-match has not run."""
    out = shutil.copytree(waiting[0], tmp_path / "out")
    (out / ".stages" / "dense_0_depth.json").unlink()
    return out


def source(box):
    return ProjectOptions(imu=box.imu, frame_times=box.frame_times)


def world_from_metric(box, out):
    """Scale, rotation and shift from the metric model to the true world."""
    transform = json.loads((out / "sparse" / "0" / "transform.json").read_text())
    truth = box.recording.truth
    world_from_model = matrix_from_quat(truth.model_from_world_xyzw).T
    model_from_metric = matrix_from_quat(np.array(transform["rotation_xyzw"])).T
    ratio = truth.metres_per_unit / transform["scale"]
    return (
        ratio,
        world_from_model @ model_from_metric,
        -truth.metres_per_unit * (world_from_model @ truth.world_in_model),
    )


def cast_depth_maps(box, out, *, kind="geometric", only=None):
    """What patch-match would find for the workspace's images, in the model's own unit."""
    folder = out / "dense" / "0"
    ratio, rotation, shift = world_from_metric(box, out)
    model = read_model(folder / "sparse")
    for i in list(model.reg_image_ids())[:only]:
        image = model.image(i)
        camera = model.camera(image.camera_id)
        centre = ratio * rotation @ image.projection_center() + shift
        world_from_cam = rotation @ image.cam_from_world().rotation.inverse().matrix()
        # COLMAP's fusion takes a pixel's ray at its corner, not at its centre
        fx, fy, cx, cy = camera.params
        corners = rays(camera.width, camera.height, (fx, fy, cx + 0.5, cy + 0.5))
        depth, normals = cast(world_from_cam, centre, corners)
        maps = folder / "stereo"
        (maps / "depth_maps").mkdir(exist_ok=True)
        pycolmap.DepthMap.from_array((depth / ratio).astype("f4"), 0.1, 100).write(
            str(maps / "depth_maps" / f"{image.name}.{kind}.bin")
        )
        planar = np.moveaxis(normals, -1, 0).astype("<f4").tobytes()
        header = b"%d&%d&3&" % (camera.width, camera.height)
        (maps / "normal_maps" / f"{image.name}.{kind}.bin").write_bytes(header + planar)


def vertices(path):
    with open(path, "rb") as file:
        header = read_ply_header(path, file)
        element = header.elements[0]
        rows = np.frombuffer(file.read(), element.dtype("<"), element.rows)
    return np.stack([rows[axis].astype(float) for axis in "xyz"], axis=1)


def test_where_patch_match_finds_nothing_all_but_the_depth_maps_is_made(waiting, box):
    out, result = waiting
    dense = result.models[0].dense
    assert (dense.images, dense.depth_maps, dense.fused) == (len(box.names), 0, None)
    assert "no depth maps" in str(dense.waiting)
    folder = out / "dense" / "0"
    assert len(list((folder / "images").iterdir())) == len(box.names)
    metric, undistorted = read_model(out / "sparse" / "0"), read_model(folder / "sparse")
    for i in metric.reg_image_ids():
        np.testing.assert_allclose(undistorted.image(i).projection_center(), metric.image(i).projection_center())
    assert (folder / "sparse" / "transform.json").is_file()
    assert (folder / "stereo" / "patch-match.cfg").is_file()
    assert json.loads((out / "result.json").read_text())["waiting"] is True
    assert json.loads((folder / "made_from.json").read_text())["maps"] == "patch-match"
    assert (out / "transform.json").is_file() and (out / "images").is_dir()


def test_depth_maps_that_come_later_become_points_and_a_mesh_in_metres(unfinished, box, capsys):
    out = unfinished
    flags = ["--imu", box.imu, "--frame-times", box.frame_times, *FLAGS]
    before = contents(box.root)
    cast_depth_maps(box, out)
    code, shown, err = run(capsys, "reconstruct", box.root, out, *flags)
    assert code == 0, err
    assert f"{len(box.names)} depth maps" in shown
    log = (out / "log.txt").read_text()
    assert log.count("dense_0_undistorted: finished in an earlier run, kept") == 1

    (model,) = json.loads((out / "result.json").read_text())["models"]
    dense = model["dense"]
    assert dense["waiting"] is None
    assert dense["maps"] == "patch-match"
    assert dense["coverage"] == 1
    assert dense["mesh"] == "dense/0/meshed-poisson.ply"
    points, mesh = vertices(out / dense["fused"]), vertices(out / dense["mesh"])
    assert len(points) == dense["points"] > 5000
    assert dense["faces"] > 5000
    ratio, rotation, shift = world_from_metric(box, out)
    # up is up: what remains is a turn about the vertical
    assert np.degrees(np.arccos(rotation[2, 2])) < 1
    # metres are metres: as they stand, no scale applied, points lie on the walls within the scale's own interval
    half_width = 0.5 * (model["ci95"][1] - model["ci95"][0]) / model["metres_per_unit"]
    middle = points.mean(axis=0)
    in_metres = (points - middle) @ rotation.T + ratio * rotation @ middle + shift
    assert np.percentile(off_the_walls(in_metres), 95) < half_width * np.linalg.norm(HIGH - LOW)
    # and but for the scale's error exactly so
    true = ratio * points @ rotation.T + shift
    assert np.percentile(off_the_walls(true), 99) < 1e-4
    surface = ratio * mesh @ rotation.T + shift
    assert np.percentile(off_the_walls(surface), 90) < 0.02
    assert (out / "dense" / "0" / "fused.ply.vis").is_file()
    assert contents(box.root) == before
    code, said, _ = run(capsys, "reconstruct", box.root, out, *flags)
    assert code == 0
    assert "nothing to do" in said


def test_a_finished_project_is_gone_on_with_by_the_sweep(tmp_path, capsys):
    """Without CUDA: exit code 0, a cloud and a mesh in metres, and what was measured of them."""
    box = build(tmp_path / "box", every=24)
    count = len(box.names)
    out, flags = tmp_path / "out", ["--imu", box.imu, "--frame-times", box.frame_times]
    code, _, err = run(capsys, "reconstruct", box.root, out, *flags, *SPARSE)
    assert code == 0, err
    before = contents(out / "sparse")
    log = (out / "log.txt").read_text()
    code, shown, err = run(capsys, "reconstruct", box.root, out, *flags, *FLAGS)
    assert code == 0, err
    assert f"depth maps of {count} images" in shown
    new = (out / "log.txt").read_text()[len(log) :]
    assert "metric: finished in an earlier run, kept" in new and "apply: finished in an earlier run, kept" in new
    assert contents(out / "sparse") == before
    (model,) = json.loads((out / "result.json").read_text())["models"]
    dense = model["dense"]
    assert (dense["images"], dense["maps"], dense["waiting"]) == (count, "plane sweep", None)
    assert dense["depth_maps"] > 0.9 * count
    # in images of 96 px, a third of a pixel is more than 3 % of many depths
    assert dense["coverage"] > 0.35
    assert dense["points"] > 2000 and dense["faces"] > 2000
    ratio, rotation, shift = world_from_metric(box, out)
    away = off_the_walls(ratio * vertices(out / dense["fused"]) @ rotation.T + shift)
    assert np.median(away) < 0.03, np.quantile(away, (0.25, 0.5, 0.75, 0.9))
    away = off_the_walls(ratio * vertices(out / dense["mesh"]) @ rotation.T + shift)
    assert np.median(away) < 0.03, np.quantile(away, (0.25, 0.5, 0.75, 0.9))
    assert not list((out / ".stages").glob("sweep_*"))
    # those of other options are replaced where that is asked for
    stereo = out / "dense" / "0" / "stereo"
    maps = sorted(path.name for path in (stereo / "depth_maps").iterdir())
    small = [*flags, *FLAGS, "--dense-options.max-image-size", "64", "--dense-options.mesh", "none"]
    before = contents(out / "dense")
    code, _, err = run(capsys, "reconstruct", box.root, out, *small)
    assert code == 2 and "step dense 0 undistorted would change: dense_options.max_image_size = 64" in err
    assert contents(out / "dense") == before
    code, _, err = run(capsys, "reconstruct", box.root, out, *small, "--overwrite")
    assert code == 0, err
    assert read_map(stereo / "depth_maps" / maps[0]).shape == (48, 64)
    # maps that somebody removed are made again; maps of the other maker are not mixed with them
    (stereo / "depth_maps" / maps[0]).rename(tmp_path / "kept.bin")
    code, _, err = run(capsys, "reconstruct", box.root, out, *small)
    assert code == 0, err
    assert (stereo / "depth_maps" / maps[0]).read_bytes() == (tmp_path / "kept.bin").read_bytes()
    (stereo / "depth_maps" / maps[0].replace("geometric", "photometric")).write_bytes(b"")
    code, _, err = run(capsys, "reconstruct", box.root, out, *small)
    assert code == 2
    assert "the plane sweep made them" in err


def test_with_cuda_it_goes_through_in_one_run(box, tmp_path, monkeypatch):
    out, calls, images = tmp_path / "out", [], len(box.names)

    def patch_match(workspace, max_image_size, settings, count):
        calls.append(max_image_size)
        for there in (15, 75, 30, 200):  # of 150; those of an earlier attempt may have gone
            count(there)
        # the result file is not there yet, but the scale is in the model
        estimate = json.loads((out / "sparse" / "0" / "transform.json").read_text())["scale"]
        (out / "result.json").write_text(json.dumps({"models": [{"metres_per_unit": estimate}]}))
        cast_depth_maps(box, out, only=50)
        (out / "result.json").unlink()

    monkeypatch.setattr(pycolmap, "has_cuda", True)
    monkeypatch.setattr(dense_stage, "patch_match", patch_match)
    options = dataclasses.replace(QUICK, dense_options=DenseOptions(max_image_size=96, mesh="none"))
    seen = []
    result = reconstruct_project(
        box.root, out, source(box), options, progress=lambda stage, done, total: seen.append((stage, done, total))
    )
    dense = result.models[0].dense
    assert calls == [96]
    assert result.exit_code() == 0
    assert (dense.depth_maps, dense.images, dense.mesh, dense.waiting) == (50, images, None, None)
    assert dense.points > 2000
    assert max(camera.width for camera in read_model(dense.folder / "sparse").cameras.values()) == 96
    # 1 for undistortion, 46 for depth maps, 11 for fusion: times on two recordings
    depth = [images + 46 * images * there // (2 * images) for there in (15, 75, 150, 150)]
    assert [done for stage, done, _ in seen if stage == "dense"] == [images, *depth, 58 * images, 58 * images]
    assert not [stage for stage, *_ in seen if stage == "mesh"]
    assert "no depth map of" in (out / "log.txt").read_text()


def test_half_written_depth_maps_are_made_again(unfinished, box, monkeypatch):
    name = f"dense/0/stereo/depth_maps/{box.names[0]}.geometric.bin"
    (unfinished / name).write_bytes(b"96&72&1&" + bytes(100))

    def run_colmap(code, *arguments, watch):
        assert not (unfinished / name).exists()
        cast_depth_maps(box, unfinished)
        watch()
        return subprocess.CompletedProcess(code, 0, "", "")

    monkeypatch.setattr(pycolmap, "has_cuda", True)
    monkeypatch.setattr(depth_maps, "_run_apart", run_colmap)
    no_mesh = dataclasses.replace(QUICK, dense_options=DenseOptions(max_image_size=96, mesh="none"))
    assert reconstruct_project(box.root, unfinished, source(box), no_mesh).exit_code() == 0


def test_colmap_apart_is_watched_and_ends_with_its_watcher(tmp_path):
    number, watched = tmp_path / "number", []
    code = "import os, time; open(sys.argv[1], 'w').write(str(os.getpid())); time.sleep(float(sys.argv[2]))"
    done = depth_maps._run_apart(code, number, 1.5, watch=lambda: watched.append(1))
    assert done.returncode == 0 and watched

    def give_up():
        if number.exists():
            raise RuntimeError("enough")

    number.unlink()
    begin_s = time.monotonic()
    with pytest.raises(RuntimeError, match="enough"):
        depth_maps._run_apart(code, number, 60, watch=give_up)
    assert time.monotonic() - begin_s < 45
    with pytest.raises(ProcessLookupError):
        os.kill(int(number.read_text()), 0)


def test_a_patch_match_that_fails_is_said(unfinished, box, monkeypatch):
    monkeypatch.setattr(pycolmap, "has_cuda", True)  # which it has not
    with pytest.raises(InertialError, match=r"patch-match ended with code 1: ValueError.* CUDA"):
        reconstruct_project(box.root, unfinished, source(box), QUICK)
    assert (unfinished / "sparse" / "0").is_dir()


def test_a_mesh_of_points_is_made_apart_by_threads_that_sleep_while_they_wait(tmp_path, monkeypatch):
    """A ball of 4,000 points; what the user sets of COLMAP's options counts."""
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rows = np.zeros(4000, dtype=[*((axis, "<f4") for axis in ("x", "y", "z", "nx", "ny", "nz")), ("colour", "u1", 3)])
    for i, axis in enumerate("xyz"):
        rows[axis], rows[f"n{axis}"] = 2 * directions[:, i], directions[:, i]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 4000"]
    header += [f"property float {axis}" for axis in ("x", "y", "z", "nx", "ny", "nz")]
    header += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    points, mesh = tmp_path / "points.ply", tmp_path / "mesh.ply"
    points.write_bytes("\n".join([*header, "end_header\n"]).encode() + rows.tobytes())
    ran, begun = subprocess.Popen, []
    monkeypatch.setattr(depth_maps.subprocess, "Popen", lambda *a, **k: begun.append(k) or ran(*a, **k))
    depth_maps.mesh_points(points, mesh, depth=6, trim=0, context=RunContext(num_threads=1))
    assert begun[0]["env"]["OMP_WAIT_POLICY"] == "passive"
    found = vertices(mesh)
    assert len(found) > 1000
    assert np.abs(np.linalg.norm(found, axis=1) - 2).max() < 0.05
    # denser than anything there is
    trimmed = RunContext(num_threads=1, colmap=ColmapSettings(("PoissonMeshing.trim=12",)))
    depth_maps.mesh_points(points, mesh, depth=6, trim=0, context=trimmed)
    assert len(vertices(mesh)) == 0


def test_a_mesh_that_fails_is_said(tmp_path):
    with pytest.raises(OutputError, match="no mesh"):
        depth_maps.mesh_points(
            tmp_path / "missing.ply", tmp_path / "mesh.ply", depth=6, trim=0, context=RunContext(num_threads=1)
        )


def need_open3d():
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d cannot be loaded: {error}")


def test_a_mesh_by_distances_takes_pixels_where_their_maker_does(subtests, tmp_path_factory):
    """A slanted plane seen from one place: half a pixel would move it by 10 mm."""
    for maker, at in (("plane sweep", 0.5), ("patch-match", 0.0)):
        with subtests.test(maker=maker, at=at):
            tmp_path = tmp_path_factory.mktemp("given")
            need_open3d()
            camera = pycolmap.Camera(
                camera_id=1, model="PINHOLE", width=200, height=150, params=[180.0, 180.0, 100.0, 75.0]
            )  # fmt: skip
            model, normal, distance = pycolmap.Reconstruction(), np.array([-0.8, 0.0, -0.6]), -1.5
            model.add_camera_with_trivial_rig(camera)
            pixel_y, pixel_x = np.indices((150, 200)) + at
            rays_of = np.stack([(pixel_x - 100) / 180, (pixel_y - 75) / 180, np.ones((150, 200))], axis=-1)
            depth = distance / (rays_of @ normal)
            for i in range(1, 5):
                image = pycolmap.Image(name=f"{i}.png", camera_id=1, image_id=i)
                model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
                write_map(tmp_path / "stereo" / "depth_maps" / f"{i}.png.geometric.bin", depth.astype(np.float32))
                (tmp_path / "images").mkdir(exist_ok=True)
                cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), np.full((150, 200, 3), 128, np.uint8))
            (tmp_path / "sparse").mkdir()
            model.write_binary(str(tmp_path / "sparse"))
            tsdf_mesh(tmp_path, [f"{i}.png" for i in range(1, 5)], tmp_path / "mesh.ply", maker=maker, kind="geometric")
            found = vertices(tmp_path / "mesh.ply")
            assert len(found) > 1000
            assert abs(np.mean(found @ normal - distance)) < 0.002


def test_a_mesh_by_distances_lies_on_the_walls_and_replaces_the_other(unfinished, box, capsys):
    need_open3d()
    cast_depth_maps(box, unfinished)
    other = unfinished / "dense" / "0" / "meshed-poisson.ply"
    other.write_bytes(b"of an earlier run")
    flags = ["--imu", box.imu, "--frame-times", box.frame_times, *FLAGS]
    code, _, err = run(capsys, "reconstruct", box.root, unfinished, *flags, "--dense-options.mesh", "tsdf")
    assert code == 0, err
    (model,) = json.loads((unfinished / "result.json").read_text())["models"]
    assert model["dense"]["mesh"] == "dense/0/meshed-tsdf.ply"
    assert not other.exists()
    ratio, rotation, shift = world_from_metric(box, unfinished)
    mesh = vertices(unfinished / "dense" / "0" / "meshed-tsdf.ply")
    assert model["dense"]["faces"] > 5000
    surface = ratio * mesh @ rotation.T + shift
    # a pixel of these pictures covers about 25 mm
    away = off_the_walls(surface)
    assert np.median(away) < 0.02 and np.percentile(away, 90) < 0.04, np.quantile(away, (0.5, 0.9))
    # from wall to wall
    assert np.all(surface.max(axis=0) - surface.min(axis=0) > 0.9 * (HIGH - LOW))


def test_a_mesh_that_nothing_can_make_is_said_before_the_work(box, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    flags = ["--imu", box.imu, "--frame-times", box.frame_times, *FLAGS]
    code, _, err = run(capsys, "reconstruct", box.root, tmp_path / "out", *flags, "--dense-options.mesh", "tsdf")
    assert code == 2
    assert "extra `mesh`: pip install 'open3d>=" in err and not (tmp_path / "out").exists()


def test_a_mesh_maker_that_lacks_a_library_is_said_and_not_loaded(tmp_path, monkeypatch):
    (tmp_path / "open3d.py").write_text("raise OSError('libusb-1.0.so.0: cannot open shared object file')")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    options = dataclasses.replace(QUICK, dense_options=DenseOptions(mesh="tsdf"))
    assert options.dense
    with pytest.raises(InertialError, match=r"libusb-1\.0\.so\.0: cannot open.*apt install libusb"):
        require_mesh_maker(options)
    for library, mend in (
        ("libGL.so.1", "apt install libgl1,"),
        ("libtbb.so.12", "pip install --force-reinstall open3d"),
    ):
        (tmp_path / "open3d.py").write_text(f"raise OSError('{library}: cannot open shared object file')")
        with pytest.raises(InertialError, match=re.escape(mend)) as caught:
            require_mesh_maker(options)
        assert "libusb" not in str(caught.value)
    assert "open3d" not in sys.modules
    (tmp_path / "open3d.py").write_text("")
    require_mesh_maker(options)
    assert "open3d" not in sys.modules


def test_damaged_depth_maps_and_those_of_other_options_are_named(unfinished, box, capsys):
    cast_depth_maps(box, unfinished, kind="photometric", only=5)
    flags = ["--imu", box.imu, "--frame-times", box.frame_times, *FLAGS]
    code, _, err = run(
        capsys, "reconstruct", box.root, unfinished, *flags, "--dense-options.max-image-size", "80"
    )  # fmt: skip
    assert code == 2
    assert "depth maps of another model or other options" in err
    broken = next((unfinished / "dense" / "0" / "stereo" / "normal_maps").glob("*.bin"))
    broken.write_bytes(broken.read_bytes()[:-8])
    code, _, err = run(capsys, "reconstruct", box.root, unfinished, *flags)
    assert code == 2
    assert broken.name in err
    assert "truncated" in err


def test_images_that_are_not_the_model_s_are_named(box, tmp_path, capsys):
    flags = ["--imu", box.imu, "--frame-times", box.frame_times, *FLAGS, "--images"]
    some = shutil.copytree(box.root / "images", tmp_path / "some")
    (some / box.names[4]).unlink()
    code, _, err = run(capsys, "reconstruct", box.root, tmp_path / "out", *flags, some)
    assert code == 2
    assert box.names[4] in err
    import cv2

    image = cv2.imread(str(some / box.names[0]))
    cv2.imwrite(str(some / box.names[0]), image[::2, ::2])
    shutil.copy(some / box.names[3], some / box.names[4])
    code, _, err = run(capsys, "reconstruct", box.root, tmp_path / "out", *flags, some)
    assert code == 2
    assert "80x60" in err
