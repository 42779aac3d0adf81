"""A COLMAP project made by COLMAP: model, database, dense workspace, fused cloud, meshes. Depth is cast in closed form.

A ball of radius 1 at the origin, seen by six cameras on an arc.
"""

import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from colmap_inertial.model.artefacts import write_map

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
NAMES = [f"{i:03}.png" for i in range(6)]


def camera_poses():
    """Rotation (cam from world) and centre of each camera."""
    for i in range(len(NAMES)):
        centre = np.array([3.0 * np.cos(0.25 * i), 3.0 * np.sin(0.25 * i), 2.0])
        z = -centre / np.linalg.norm(centre)
        x = np.cross([0.0, 0.0, 1.0], z)
        x /= np.linalg.norm(x)
        yield np.stack([x, np.cross(z, x), z]), centre


def cast(rotation, centre):
    """(H, W) z-depth of the ball, 0 beside it, and (3, H, W) normals in the camera frame."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], axis=-1) @ rotation
    a, b, c = np.sum(rays**2, -1), rays @ centre, centre @ centre - 1
    root = b**2 - a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
    normals = (centre + depth[..., None] * rays) @ rotation.T * (depth > 0)[..., None]
    return depth.astype("f4"), np.moveaxis(normals, -1, 0).astype("f4")


def sparse_model(rng):
    """A model with points on the ball and noisy observations."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, 80, 60])
    model.add_camera_with_trivial_rig(camera)
    world = rng.standard_normal((600, 3))
    world /= np.linalg.norm(world, axis=1)[:, None]
    pixels, seen = [], []
    for rotation, centre in camera_poses():
        cam = (world - centre) @ rotation.T
        px = FOCAL * cam[:, :2] / cam[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        facing = np.sum((centre - world) * world, axis=1) > 0
        seen.append(facing & (px > 1).all(1) & (px[:, 0] < WIDTH - 1) & (px[:, 1] < HEIGHT - 1))
        pixels.append(px + rng.normal(0, 0.3, px.shape))
    seen = np.array(seen)
    seen[:, seen.sum(0) < 2] = False
    for i, (rotation, centre) in enumerate(camera_poses()):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
        points = [pycolmap.Point2D(pixels[i][k]) for k in np.flatnonzero(seen[i])]
        image = pycolmap.Image(name=NAMES[i], camera_id=1, image_id=i + 1, points2D=points)
        model.add_image_with_trivial_frame(image, pose)
    rank = np.cumsum(seen, axis=1) - 1
    for k in np.flatnonzero(seen.any(0)):
        track = pycolmap.Track()
        for i in np.flatnonzero(seen[:, k]):
            track.add_element(int(i) + 1, int(rank[i, k]))
        model.add_point3D(world[k], track, rng.integers(0, 255, 3, dtype=np.uint8))
    model.update_point_3d_errors()
    return model


def write_database(path, model):
    """COLMAP's database of the model, with a prior at each camera; the last one in degrees."""
    database = pycolmap.Database.open(str(path))
    for camera in model.cameras.values():
        database.write_camera(camera, use_camera_id=True)
    for rig in model.rigs.values():
        database.write_rig(rig, use_rig_id=True)
    for frame in model.frames.values():
        database.write_frame(frame, use_frame_id=True)
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        database.write_image(image, use_image_id=True)
        degrees = image_id == len(NAMES)
        prior = pycolmap.PosePrior(
            position=[65.0, 25.4, 12.0] if degrees else image.projection_center() + 0.01,
            position_covariance=np.diag([0.01, 0.02, 0.04]) + 0.001,
            coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84
            if degrees
            else pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            corr_data_id=image.data_id,
            gravity=[0.0, 1.0, 0.0],
        )
        database.write_pose_prior(prior)
    database.close()


def write_project(root: Path) -> None:
    """Write the whole project."""
    rng = np.random.default_rng(4)
    pycolmap.set_random_seed(4)
    model = sparse_model(rng)
    (root / "images").mkdir(parents=True)
    for name in NAMES:
        cv2.imwrite(str(root / "images" / name), rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    sparse, dense = root / "sparse" / "0", root / "dense"
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    model.write_text(str(sparse))
    write_database(root / "database.db", model)
    pycolmap.undistort_images(str(dense), str(sparse), str(root / "images"))
    for name, pose in zip(NAMES, camera_poses(), strict=True):
        depth, normals = cast(*pose)
        for kind in ("photometric", "geometric"):
            file = dense / "stereo" / "depth_maps" / f"{name}.{kind}.bin"
            pycolmap.DepthMap.from_array(depth, 0.1, 100).write(str(file))
            file = dense / "stereo" / "normal_maps" / f"{name}.{kind}.bin"
            file.write_bytes(b"%d&%d&3&" % (WIDTH, HEIGHT) + normals.astype("<f4").tobytes())
        write_map(dense / "stereo" / "depth_maps" / f"{name}.sigma.bin", 0.01 * depth.astype("f4"))
    (dense / "stereo" / "consistency_graphs" / f"{NAMES[0]}.geometric.bin").write_bytes(b"160&120&1&" + bytes(12))
    fuse(dense, dense / "fused.ply")
    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.trim, options.num_threads = 5, 0, 1
    pycolmap.poisson_meshing(str(dense / "fused.ply"), str(dense / "meshed-poisson.ply"), options)
    corners = (2 * rng.random((8, 1, 3)) - 1).astype("f4")
    vertices = [" ".join(f"{value:.9g}" for value in corner) for corner in corners[:, 0]]
    faces = ((0, 1, 2), (3, 4, 5), (5, 6, 7))
    obj = [*(f"v {v}" for v in vertices), *(f"f {a + 1} {b + 1} {c + 1} " for a, b, c in faces)]
    (dense / "textured.obj").write_text("\n".join(["o Point_Cloud", *obj]) + "\n")
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n{properties}element face {len(faces)}\n"
    rows = [*vertices, *(f"3 {a} {b} {c}" for a, b, c in faces)]
    (dense / "ascii.ply").write_text(
        f"{head}property list uchar int vertex_indices\nend_header\n" + "\n".join(rows) + "\n"
    )
    (root / "project.ini").write_text("[PatchMatchStereo]\r\ndepth_min=0.25 \r\ndepth_max = -1\r\nwindow_radius=5\r\n")
    (root / "notes.txt").write_text("taken in March\n")


def fuse(workspace: Path, target: Path) -> None:
    """COLMAP's fusion of the workspace's depth maps."""
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels, options.check_num_images, options.num_threads = 2, 6, 1
    pycolmap.stereo_fusion(str(target), str(workspace), input_type="geometric", options=options, output_type="PLY")


def prior_rows(path: Path) -> list[tuple]:
    """Priors as SQLite has them: position, covariance, gravity, system."""
    with sqlite3.connect(path) as database:
        query = (
            "SELECT position, position_covariance, gravity, coordinate_system FROM pose_priors ORDER BY pose_prior_id"
        )
        rows = database.execute(query).fetchall()
    database.close()
    return [(*(np.frombuffer(blob, "<f8") for blob in row[:3]), row[3]) for row in rows]
