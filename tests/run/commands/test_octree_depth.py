"""Depth of the octree of a surface."""

from types import SimpleNamespace

import numpy as np

from colmap_inertial.core.geometry import matrix_from_quat, quat_exp
from colmap_inertial.run.commands import dense_steps as dense


def seen_from(away, focal_px):
    """A model of which pictures see points from half, from all and from thrice that depth; and its pictures."""
    turn = matrix_from_quat(quat_exp(np.array([0.3, -0.5, 0.2])))
    points, images = {}, {}
    for k, depth in enumerate((0.5 * away, away, 3 * away)):
        seen = []
        for j in range(5):
            # half of the points are nearer, half farther
            in_cam = np.array([0.1 * j, -0.2, depth + 0.1 * depth * (j - 2)])
            points[10 * k + j] = SimpleNamespace(xyz=turn.T @ (in_cam - [1, 2, 3]))
            seen.append(SimpleNamespace(point3D_id=10 * k + j, has_point3D=lambda: True))
        seen.append(SimpleNamespace(point3D_id=-1, has_point3D=lambda: False))
        rotation = SimpleNamespace(matrix=lambda: turn)
        pose = SimpleNamespace(rotation=rotation, translation=np.array([1.0, 2, 3]))
        images[k] = SimpleNamespace(camera_id=1, points2D=seen, cam_from_world=lambda pose=pose: pose)
    camera = SimpleNamespace(mean_focal_length=lambda: focal_px)
    model = SimpleNamespace(
        reg_image_ids=lambda: list(images), image=images.get, camera=lambda _: camera, points3D=points
    )
    return model, images


def test_cells_of_a_surface_are_as_large_as_pixels_on_it(subtests, tmp_path):
    """The widest axis of the points and a tenth more, halved until a cell is no larger than a pixel spans there."""
    places = np.random.default_rng(0).uniform(0, 1, (500, 3)) * [2, 8, 1] + [5, -3, 7]
    places[:2] = [[6, -3, 7], [6, 5, 7]]
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 500\n"
    fields = "".join(f"property float {axis}\n" for axis in "xyz")
    path = tmp_path / "fused.ply"
    path.write_bytes((header + fields + "end_header\n").encode() + places.astype("<f4").tobytes())
    for away, focal_px in ((4.0, 500.0), (1.0, 500.0), (4.0, 2000.0), (0.01, 4000.0), (400.0, 10.0)):
        with subtests.test(away=away, focal_px=focal_px):
            model, images = seen_from(away, focal_px)
            depth, trim = dense._choose_octree(path, model)
            cells = 1.1 * 8 / (away / focal_px)
            expected = min(max(next(n for n in range(40) if 2**n >= cells), dense._LEAST_DEPTH), dense._MOST_DEPTH)
            assert depth == expected and trim == depth - dense._TRIM_LEVELS
            images.clear()
            assert dense._choose_octree(path, model)[0] == dense._MOST_DEPTH
