"""Gaussian splats and NeRF cameras under a similarity: what is rendered of them moves with the model, and comes back.

Colours are evaluated by formulas of this file, those of the trainer's own rasteriser, and covariances from sizes and
quaternions as it builds them.
"""

import json

import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.io.files import write_json
from colmap_inertial.io.ply import transform_ply
from colmap_inertial.io.splats import sh_basis, sh_rotation
from colmap_inertial.model import read_model, similarity_as_json
from colmap_inertial.model.project import apply_to_project, undo_project
from colmap_inertial.model.similarities import plain_factor, read_similarity
from tests.helpers.model_project import NAMES, sparse_model
from tests.helpers.similarities import SIMILARITY

C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
      1.445305721320277, -0.5900435899266435)  # fmt: skip
COUNT = 50


def colour(dc, rest, d):
    """(N, 3) as the rasteriser evaluates it: (N, 3), (N, 3, K) and (N, 3) unit directions from the camera."""
    x, y, z = d.T[:, :, None]
    out = 0.28209479177387814 * dc
    if rest.shape[2] >= 3:
        out = out - C1 * y * rest[:, :, 0] + C1 * z * rest[:, :, 1] - C1 * x * rest[:, :, 2]
    if rest.shape[2] >= 8:
        terms = (x * y, y * z, 2 * z * z - x * x - y * y, x * z, x * x - y * y)
        out = out + sum(c * t * rest[:, :, 3 + i] for i, (c, t) in enumerate(zip(C2, terms, strict=True)))
    if rest.shape[2] >= 15:
        terms = (
            y * (3 * x * x - y * y), x * y * z, y * (4 * z * z - x * x - y * y),
            z * (2 * z * z - 3 * x * x - 3 * y * y),
            x * (4 * z * z - x * x - y * y), z * (x * x - y * y), x * (x * x - 3 * y * y),
        )  # fmt: skip
        out = out + sum(c * t * rest[:, :, 8 + i] for i, (c, t) in enumerate(zip(C3, terms, strict=True)))
    return out


def covariances(rows):
    """(N, 3, 3) R S S R', quaternions normalised first."""
    q = np.stack([rows[f"rot_{i}"] for i in range(4)], -1).astype(float)
    rotation = matrix_from_quat(q[:, [1, 2, 3, 0]])
    size = np.exp(np.stack([rows[f"scale_{i}"] for i in range(3)], -1).astype(float))
    return np.einsum("nij,nj,nkj->nik", rotation, size**2, rotation)


def columns(rows, *names):
    return np.stack([rows[name] for name in names], -1).astype(float)


def harmonics(rows):
    rest = sorted((name for name in rows.dtype.names if name.startswith("f_rest_")), key=lambda name: int(name[7:]))
    values = columns(rows, *rest) if rest else np.zeros((len(rows), 0))
    return columns(rows, "f_dc_0", "f_dc_1", "f_dc_2"), values.reshape(len(rows), 3, -1)


def write_splats(path, degree, *, kind="f8", text=False, drop=()):
    """As the trainer writes them, in double precision where not told otherwise."""
    rng = np.random.default_rng(degree)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", *(f"rot_{i}" for i in range(4))]
    names = [name for name in names if name not in drop]
    rows = np.zeros(COUNT, [(name, f"<{kind}") for name in names])
    for name in names:
        rows[name] = rng.standard_normal(COUNT)
    form = "ascii" if text else "binary_little_endian"
    of_type = {"f8": "double", "f4": "float"}[kind]
    head = f"ply\nformat {form} 1.0\nelement vertex {COUNT}\n" + "".join(f"property {of_type} {n}\n" for n in names)
    body = rows.tobytes()
    if text:
        body = "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in rows.tolist()).encode()
    path.write_bytes(head.encode() + b"end_header\n" + body)
    return rows


def read_splats(path, like):
    data = path.read_bytes().partition(b"end_header\n")[2]
    if path.read_bytes().startswith(b"ply\nformat ascii"):
        return np.array([tuple(map(float, line.split())) for line in data.decode().splitlines()], like.dtype)
    return np.frombuffer(data, like.dtype)


def assert_moved(before, after, similarity, atol=1e-6):
    rotation = matrix_from_quat(similarity.rotation_xyzw)
    xyz = columns(before, "x", "y", "z")
    np.testing.assert_allclose(
        columns(after, "x", "y", "z"), similarity.scale * xyz @ rotation.T + similarity.translation_m, atol=atol
    )
    wanted = similarity.scale**2 * rotation @ covariances(before) @ rotation.T
    np.testing.assert_allclose(covariances(after), wanted, atol=atol, rtol=atol)
    rng = np.random.default_rng(3)
    directions = rng.standard_normal((COUNT, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    np.testing.assert_allclose(
        colour(*harmonics(after), directions @ rotation.T), colour(*harmonics(before), directions), atol=atol
    )
    np.testing.assert_array_equal(after["opacity"], before["opacity"])
    if "nx" in before.dtype.names:
        normals = columns(before, "nx", "ny", "nz") @ rotation.T
        np.testing.assert_allclose(columns(after, "nx", "ny", "nz"), normals, atol=atol)


def test_positions_covariances_and_colours_of_splats_move_with_the_model(subtests, tmp_path_factory):
    for degree in range(4):
        with subtests.test(degree=degree):
            tmp_path = tmp_path_factory.mktemp("given")
            rows = write_splats(tmp_path / "a.ply", degree)
            changed = transform_ply(tmp_path / "a.ply", tmp_path / "b.ply", SIMILARITY)
            assert changed == ("positions", "normals", "sizes", "rotations", *(["colours"] if degree else []))
            assert_moved(rows, read_splats(tmp_path / "b.ply", rows), SIMILARITY)


def test_splats_in_text_and_without_normals_move_too(tmp_path):
    rows = write_splats(tmp_path / "a.ply", 3, text=True, drop=("nx", "ny", "nz"))
    transform_ply(tmp_path / "a.ply", tmp_path / "b.ply", SIMILARITY)
    assert_moved(rows, read_splats(tmp_path / "b.ply", rows), SIMILARITY)


def test_rotations_of_harmonics_are_orthogonal_and_compose(subtests):
    for degree in range(4):
        with subtests.test(degree=degree):
            rng = np.random.default_rng(0)
            a, b = (matrix_from_quat(rng.standard_normal(4)) for _ in range(2))
            one, two, both = (sh_rotation(r, degree) for r in (a, b, a @ b))
            np.testing.assert_allclose(one @ one.T, np.eye(2 * degree + 1), atol=1e-12)
            np.testing.assert_allclose(one @ two, both, atol=1e-12)
            # the bands are orthonormal over the sphere
            z, weights = np.polynomial.legendre.leggauss(8)
            turn = np.arange(16) * np.pi / 8
            d = np.stack([np.outer(np.sqrt(1 - z**2), np.cos(turn)), np.outer(np.sqrt(1 - z**2), np.sin(turn)),
                          np.outer(z, np.ones(16))], -1).reshape(-1, 3)  # fmt: skip
            basis = sh_basis(d, degree)
            gram = np.einsum("n,ni,nj->ij", np.repeat(weights, 16) * np.pi / 8, basis, basis)
            np.testing.assert_allclose(gram, np.eye(2 * degree + 1), atol=1e-12)


def test_splats_that_are_not_whole_are_refused(subtests, tmp_path_factory):
    for drop, said in ((("rot_3",), "lack rot_3"), (("f_rest_4",), "23 fields f_rest"), (("opacity",), "lack opacity")):
        with subtests.test(drop=drop, said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            write_splats(tmp_path / "a.ply", 2, drop=drop)
            with pytest.raises(FormatError, match=said):
                transform_ply(tmp_path / "a.ply", tmp_path / "b.ply", SIMILARITY)


def test_packed_splats_are_refused(tmp_path):
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty uint packed_position\nend_header\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + bytes(4))
    with pytest.raises(FormatError, match="--keep"):
        transform_ply(tmp_path / "a.ply", tmp_path / "b.ply", SIMILARITY)


# --- in projects -----------------------------------------------------------------------------------------------------

FLIP = np.diag([1.0, -1, -1, 1])
#: What nerfstudio does to COLMAP's world before it writes.
SWAPPED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
#: Two axes change places, and hands with them; all of it moves.
MIRRORED = np.array([[1.0, 0, 0, 2], [0, 0, 1, 0], [0, 1, 0, -1], [0, 0, 0, 1]])
WORLDS = {"ours": np.eye(4), "swapped": SWAPPED, "mirrored": MIRRORED}


def cameras_of(model, applied):
    """By name, matrices of a transforms.json."""
    found = {}
    for image in model.images.values():
        to_world = np.eye(4)
        to_world[:3] = image.cam_from_world().inverse().matrix()
        found[image.name] = applied @ to_world @ FLIP
    return found


def write_trained(root):
    """A project with what trainers made of it."""
    model = sparse_model(np.random.default_rng(4))
    (root / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(root / "sparse" / "0"))
    (root / "splat").mkdir()
    rows = write_splats(root / "splat" / "point_cloud.ply", 3, kind="f4")
    for name, applied in WORLDS.items():
        frames = [
            {
                "file_path": f"images/{n}",
                "transform_matrix": m.tolist(),
                "transform_matrix_start": m.tolist(),
                "camera_linear_velocity": [1.0, 2.0, 3.0],
                "camera_angular_velocity": [0.1, 0.2, 0.3],
            }
            for n, m in cameras_of(model, applied).items()
        ]
        content = {"fl_x": 150.0, "scale": 0.5, "offset": [0.5, 0.4, 0.3], "up": [0, 0, 1.0], "frames": frames}
        (root / name).mkdir()
        write_json(root / name / "transforms.json", {**content, "applied_transform": applied[:3].tolist()})
    # scaled and moved by a program that does not say so
    lost = [
        {"file_path": n, "transform_matrix": (np.diag([3.0, 3, 3, 1]) @ m).tolist()}
        for n, m in cameras_of(model, np.eye(4)).items()
    ]
    (root / "lost").mkdir()
    write_json(root / "lost" / "transforms.json", {"frames": lost})
    (root / "splat" / "web.splat").write_bytes(b"1")
    (root / "transforms_of_mine.json").write_text("[1, 2")
    return rows


@pytest.mark.parametrize("how", ["factor", "sim3"])
def test_splats_and_cameras_of_a_project_move_and_come_back(tmp_path, how):
    root, out, back = tmp_path / "project", tmp_path / "out", tmp_path / "back"
    rows = write_trained(root)
    if how == "factor":
        similarity = plain_factor(0.37)
    else:
        write_json(tmp_path / "sim3.json", similarity_as_json(SIMILARITY))
        similarity = read_similarity(tmp_path / "sim3.json")
    steps: list[tuple[int, int]] = []
    applied = apply_to_project(root, out, similarity, progress=lambda *step: steps.append(step))
    kinds = {change.path: change.changed for change in applied.changes}
    assert kinds["splat/point_cloud.ply"] == ("positions", "normals", "sizes", "rotations", "colours")
    for name in WORLDS:
        assert kinds[f"{name}/transforms.json"] == ("cameras", "velocities", "up", "box")
    assert steps == [(i + 1, len(steps)) for i in range(len(steps))]
    assert any("lost/transforms.json" in str(note) for note in applied.notes)
    assert any(".splat" in str(note) for note in applied.notes)
    assert (out / "transforms_of_mine.json").read_text() == "[1, 2"
    assert (out / "lost" / "transforms.json").read_bytes() == (root / "lost" / "transforms.json").read_bytes()
    assert_moved(rows, read_splats(out / "splat" / "point_cloud.ply", rows), similarity, atol=5e-6)

    moved = read_model(out / "sparse" / "0")
    for name, world in WORLDS.items():
        before = json.loads((root / name / "transforms.json").read_text())
        content = json.loads((out / name / "transforms.json").read_text())
        wanted = cameras_of(moved, world)
        for frame in content["frames"]:
            matrix = wanted[frame["file_path"].removeprefix("images/")]
            np.testing.assert_allclose(frame["transform_matrix"], matrix, atol=1e-9)
            np.testing.assert_allclose(frame["transform_matrix_start"], matrix, atol=1e-9)
            np.testing.assert_allclose(frame["camera_linear_velocity"], similarity.scale * np.array([1, 2, 3]))
            assert frame["camera_angular_velocity"] == [0.1, 0.2, 0.3]
        # the same things are in the middle of the box, as large as before
        middle = (0.5 - np.array(before["offset"])) / before["scale"]
        rotation = matrix_from_quat(similarity.rotation_xyzw)
        in_model = world[:3, :3].T @ (middle - world[:3, 3])
        there = world[:3, :3] @ (similarity.scale * rotation @ in_model + similarity.translation_m) + world[:3, 3]
        np.testing.assert_allclose(content["scale"] * there + content["offset"], [0.5] * 3, atol=1e-9)
        assert content["scale"] == pytest.approx(0.5 / similarity.scale)

    undo_project(out, back)
    found = read_splats(back / "splat" / "point_cloud.ply", rows)
    for name in rows.dtype.names:
        np.testing.assert_allclose(found[name], rows[name], atol=2e-5)
    for name in WORLDS:
        content, before = (json.loads((r / name / "transforms.json").read_text()) for r in (back, root))
        for frame, old in zip(content["frames"], before["frames"], strict=True):
            np.testing.assert_allclose(frame["transform_matrix"], old["transform_matrix"], atol=1e-9)
        np.testing.assert_allclose(content["offset"], before["offset"], atol=1e-9)
    assert len(NAMES) == pycolmap.Reconstruction(str(back / "sparse" / "0")).num_reg_images()
