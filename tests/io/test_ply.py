"""PLY files: positions and normals move, every other byte stays; damage is found."""

import zlib

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import Similarity
from colmap_inertial.io import ply
from colmap_inertial.io.ply import transform_ply
from tests.helpers.cases import loop_over
from tests.helpers.damage import mutated
from tests.helpers.files import write_anew
from tests.helpers.similarities import SIMILARITY

IDENTITY = Similarity(scale=1.0, rotation_xyzw=[0, 0, 0, 1], translation_m=[0, 0, 0], cov=np.zeros((7, 7)))
HEADER = """ply
format {format} 1.0
comment x y z are not here
obj_info made by hand
element camera 2
property float x
property double focal
element vertex 40
property uchar flags
property double x
property float confidence
property double y
property float ny
property double z
property short quality
property float nx
property float nz
property uint id
element face 6
property uchar label
property list uchar int vertex_indices
property list ushort float texcoord
element tail 3
property int8 a
end_header
"""
FIELDS = [
    ("flags", "u1"), ("x", "f8"), ("confidence", "f4"), ("y", "f8"), ("ny", "f4"), ("z", "f8"), ("quality", "i2"),
    ("nx", "f4"), ("nz", "f4"), ("id", "u4"),
]  # fmt: skip
FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": None}


def odd_ply(kind, *, rows=None):
    """A file with everything that the format allows around the positions: its bytes, and its vertices' place in it."""
    rng = np.random.default_rng(1)
    header = HEADER.format(format=kind).encode()
    order = FORMATS[kind]
    cameras = [(1.5, 500.25), (2.5, 480.0)]
    faces = [(7, (0, 1, 2), (0.5, 0.25)), (8, (3, 4, 5), (0.5, 1.0)), (9, (3, 4, 5, 39), ()), (1, (), ()),
             (2, (1, 2, 3), (0.5,)), (3, (5, 6, 7), (1.5,))]  # fmt: skip
    if rows is None:
        rows = np.zeros(40, [(name, kind) for name, kind in FIELDS])
        for name, _ in FIELDS:
            rows[name] = rng.integers(0, 200, 40) if rows[name].dtype.kind in "iu" else rng.standard_normal(40)
    if order is None:
        lines = [" ".join(str(v) for v in camera) for camera in cameras]
        lines += ["  ".join(str(v) for v in row) for row in rows]  # two spaces: white space stays, too
        lines += [
            " ".join(str(v) for v in (label, len(indices), *indices, len(uv), *uv)) for label, indices, uv in faces
        ]
        return header + ("\n".join([*lines, "1", "-2", "3"]) + "\n").encode(), rows
    body = np.array(cameras, [("x", f"{order}f4"), ("focal", f"{order}f8")]).tobytes()
    body += rows.astype([(name, order + kind) for name, kind in FIELDS]).tobytes()
    for label, indices, uv in faces:
        body += np.uint8(label).tobytes() + np.uint8(len(indices)).tobytes()
        body += np.array(indices, f"{order}i4").tobytes()
        body += np.array(len(uv), f"{order}u2").tobytes() + np.array(uv, f"{order}f4").tobytes()
    return header + body + bytes([1, 254, 3]), rows


def moved_rows(rows):
    rotation = matrix_from_quat(SIMILARITY.rotation_xyzw)
    after = rows.copy()
    xyz = np.stack([rows[n] for n in ("x", "y", "z")], -1) @ (SIMILARITY.scale * rotation).T + SIMILARITY.translation_m
    normal = np.stack([rows[n].astype(float) for n in ("nx", "ny", "nz")], -1) @ rotation.T
    for i in range(3):
        after["xyz"[i]] = xyz[:, i]
        after[("nx", "ny", "nz")[i]] = normal[:, i]
    return after


def test_positions_and_normals_move_and_every_other_byte_stays(subtests, tmp_path_factory):
    for chunk in (4 << 20, 256):
        for kind in FORMATS:
            with subtests.test(chunk=chunk, kind=kind), pytest.MonkeyPatch.context() as monkeypatch:
                tmp_path = tmp_path_factory.mktemp("given")
                monkeypatch.setattr(ply, "_CHUNK_BYTES", chunk)
                source, target = tmp_path / "a.ply", tmp_path / "b.ply"
                data, rows = odd_ply(kind)
                source.write_bytes(data)
                assert transform_ply(source, target, SIMILARITY) == ("positions", "normals")
                assert source.read_bytes() == data
                got = target.read_bytes()
                expected, _ = odd_ply(kind, rows=moved_rows(rows))
                if kind == "ascii":
                    # The last digit may differ from that of this test's own product; all else is the same text
                    before, after, wanted = (text.split(b"\n") for text in (data, got, expected))
                    assert len(before) == len(after) == len(wanted)
                    for old, new, want in zip(before, after, wanted, strict=True):
                        if len(old.split(b"  ")) != len(FIELDS):
                            assert old == new
                            continue
                        old, new, want = (line.split(b"  ") for line in (old, new, want))
                        for (name, _), o, n, w in zip(FIELDS, old, new, want, strict=True):
                            if name in ("x", "y", "z", "nx", "ny", "nz"):
                                assert float(n) == pytest.approx(float(w), abs=1e-6 if name[0] == "n" else 1e-13)
                            else:
                                assert o == n
                else:
                    start, order = data.index(b"end_header\n") + 11 + 24, FORMATS[kind]
                    dtype = np.dtype([(name, order + kind) for name, kind in FIELDS])
                    end = start + 40 * dtype.itemsize
                    assert (got[:start], got[end:]) == (data[:start], data[end:])
                    after, wanted = np.frombuffer(got[start:end], dtype), np.frombuffer(expected[start:end], dtype)
                    for name, _ in FIELDS:
                        if name in ("x", "y", "z", "nx", "ny", "nz"):
                            np.testing.assert_allclose(
                                after[name], wanted[name], atol=1e-6 if name[0] == "n" else 1e-13
                            )
                        else:
                            assert after[name].tobytes() == wanted[name].tobytes()


def test_the_identity_changes_no_byte(subtests, tmp_path_factory):
    for kind in FORMATS:
        with subtests.test(kind=kind):
            tmp_path = tmp_path_factory.mktemp("given")
            data, _ = odd_ply(kind)
            (tmp_path / "a.ply").write_bytes(data)
            transform_ply(tmp_path / "a.ply", tmp_path / "b.ply", IDENTITY)
            assert (tmp_path / "b.ply").read_bytes() == data


def test_a_windows_header_and_points_that_are_not_a_number_pass(tmp_path):
    header = b"ply\r\nformat binary_little_endian 1.0\r\nelement vertex 2\r\n"
    header += b"".join(b"property float %s\r\n" % name for name in (b"x", b"y", b"z")) + b"end_header\r\n"
    data = np.array([[np.nan] * 3, [1, 2, 3]], "<f4").tobytes()
    (tmp_path / "a.ply").write_bytes(header + data)
    assert transform_ply(tmp_path / "a.ply", tmp_path / "b.ply", SIMILARITY) == ("positions",)
    got = (tmp_path / "b.ply").read_bytes()
    assert got.startswith(header)
    points = np.frombuffer(got[len(header) :], "<f4").reshape(2, 3)
    assert np.isnan(points[0]).all()
    wanted = SIMILARITY.scale * matrix_from_quat(SIMILARITY.rotation_xyzw) @ [1, 2, 3] + SIMILARITY.translation_m
    np.testing.assert_allclose(points[1], wanted, atol=1e-6)


@loop_over(
    ("old", "new", "words"),
    [
        (b"ply\n", b"pl\n", "not a PLY file"),
        (b"format", b"fromat", "line 2: not a line of a PLY header"),
        (b"property double z\n", b"", "only x y"),
        (b"property double z", b"property int z", "not a floating-point number"),
        (b"property double z", b"property list uchar float z", "not a floating-point number"),
        (b"property float confidence", b"property float x", "declared twice"),
        (b"property uint id", b"property list uchar uint id", "list property cannot be transformed"),
        (b"element vertex 40", b"element vertex 400000000000", "truncated"),
        (b"element vertex 40", b"element vertex 39", "damaged|truncated|none of the 39 vertices"),
        (b"int8 a", b"int128 a", "'int128' is no PLY type"),
        (b"end_header\n", b"end_heade\n", "not a line of a PLY header"),
    ],
)
def test_damage_and_what_cannot_be_transformed_are_named(tmp_path, old, new, words):
    data, _ = odd_ply("binary_little_endian")
    assert data.count(old) == 1
    path = tmp_path / "a.ply"
    path.write_bytes(data.replace(old, new))
    with pytest.raises(FormatError, match=words) as caught:
        transform_ply(path, tmp_path / "b.ply", SIMILARITY)
    assert str(path) in str(caught.value)


def test_splats_are_refused_rather_than_half_transformed(tmp_path):
    names = ("x", "y", "z", "scale_0", "rot_0")
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    (tmp_path / "a.ply").write_bytes(header.encode() + bytes(20))
    with pytest.raises(FormatError, match="Gaussian splats"):
        transform_ply(tmp_path / "a.ply", tmp_path / "b.ply", SIMILARITY)


def test_a_file_cut_anywhere_is_refused(subtests, tmp_path_factory):
    for kind in FORMATS:
        with subtests.test(kind=kind):
            tmp_path = tmp_path_factory.mktemp("given")
            data, _ = odd_ply(kind)
            path = tmp_path / "a.ply"
            for n in np.random.default_rng(3).integers(0, len(data) - (2 if kind == "ascii" else 0), 150):
                write_anew(path, data[:n])
                with pytest.raises(FormatError):
                    transform_ply(path, tmp_path / "b.ply", SIMILARITY)
            if kind != "ascii":
                path.write_bytes(data + b"\0")
                with pytest.raises(FormatError, match="1 bytes follow"):
                    transform_ply(path, tmp_path / "b.ply", SIMILARITY)


def test_only_errors_of_our_own_escape(subtests, tmp_path_factory):
    for kind in FORMATS:
        with subtests.test(kind=kind):
            tmp_path = tmp_path_factory.mktemp("given")
            data, _ = odd_ply(kind)
            path = tmp_path / "a.ply"
            rng = np.random.default_rng(zlib.crc32(kind.encode()))
            refused = 0
            for i in range(150):
                damaged = mutated(data, rng)
                write_anew(path, damaged)
                try:
                    transform_ply(path, tmp_path / "b.ply", SIMILARITY)
                except InertialError as error:
                    refused += 1
                    assert str(path) in str(error)
                except Exception as error:
                    error.add_note(f"mutation {i}: {damaged[:300]!r}")
                    raise
                else:
                    # What passes has the length that its header says: nothing was dropped on the way
                    if kind != "ascii":
                        assert len(damaged) == (tmp_path / "b.ply").stat().st_size
            assert refused > 60


def test_meshes_of_open3d_are_read_by_open3d_afterwards(tmp_path):
    try:
        import open3d
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d cannot be loaded: {error}")
    mesh = open3d.geometry.TriangleMesh.create_torus(radial_resolution=12, tubular_resolution=9)
    mesh.compute_vertex_normals()
    mesh.vertex_colors = open3d.utility.Vector3dVector(np.random.default_rng(0).random((len(mesh.vertices), 3)))
    rotation = matrix_from_quat(SIMILARITY.rotation_xyzw)
    for ascii_text in (False, True):
        source, target = tmp_path / "a.ply", tmp_path / "b.ply"
        open3d.io.write_triangle_mesh(str(source), mesh, write_ascii=ascii_text)
        assert transform_ply(source, target, SIMILARITY) == ("positions", "normals")
        before, after = (open3d.io.read_triangle_mesh(str(path)) for path in (source, target))
        wanted = np.asarray(before.vertices) @ (SIMILARITY.scale * rotation).T + SIMILARITY.translation_m
        np.testing.assert_allclose(np.asarray(after.vertices), wanted, atol=1e-12)
        np.testing.assert_allclose(
            np.asarray(after.vertex_normals), np.asarray(before.vertex_normals) @ rotation.T, atol=1e-12
        )
        assert np.array_equal(np.asarray(after.triangles), np.asarray(before.triangles))
        assert np.array_equal(np.asarray(after.vertex_colors), np.asarray(before.vertex_colors))


def small_ply(form, body, *, count="uchar", vertices=2, faces=1, end="end_header\n"):
    header = f"ply\nformat {form} 1.0\nelement vertex {vertices}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "property uchar label\n"
    header += f"element face {faces}\nproperty list {count} int vertex_indices\n" if faces else ""
    return header.encode() + end.encode() + body


def test_each_line_of_a_text_file_has_the_values_that_it_should(subtests, tmp_path_factory):
    for body, words in (
        ("0 0 0 1\n1 2 3 255\n3 0 1 1\n", None),
        ("0 0 0 1\n1 2 3 2.0\n0\n\n", None),
        ("0 0 0 1\n1 2 3 2\n3 0 1 1\nmore\n", "line 14: damaged: text follows the last element"),
        ("0 0 0 1\n1 2 3 2 9\n3 0 1 1\n", "line 12: 5 values where element vertex has 4"),
        ("0 0 0 1\n1 2 3\n3 0 1 1\n", "line 12: too few values for element vertex"),
        ("0 0 0 1\n\n3 0 1 1\n", "line 12: truncated within element vertex"),
        ("0 0 0 1\n1 2 3 2\n", "line 13: truncated within element face"),
        ("0 0 0 1\n1 2 3 256\n3 0 1 1\n", "line 12: .*256 does not fit into 8 bits"),
        ("0 0 0 1\n1 2 3 -1\n3 0 1 1\n", "line 12: .*-1 does not fit into 8 bits"),
        ("0 0 0 1\n1 2 3 1.5\n3 0 1 1\n", "line 12: .*1.5 does not fit into 8 bits"),
        ("0 0 0 1\n1 2 3 1_0\n3 0 1 1\n", "line 12: .*1_0 does not fit into 8 bits"),
        ("0 0 0 1\n1 2_0 3 1\n3 0 1 1\n", "line 12: not a value of element vertex: .*2_0"),
        ("0 0 0 1\n1 two 3 1\n3 0 1 1\n", "line 12: not a value of element vertex: .*two"),
        ("0 0 0 1\n1 2 3 2\n3 0 1\n", "line 13: too few values for element face"),
        ("0 0 0 1\n1 2 3 2\n3 0 1 2\n", "line 13: a face refers to none of the 2 vertices"),
        ("0 0 0 1\n1 2 3 2\n3 0 1 -1\n", "line 13: a face refers to none of the 2 vertices"),
        ("0 0 0 1\n1 2 3 2\n2 0 1 1\n", "line 13: 4 values where element face has 3"),
    ):
        with subtests.test(body=body, words=words):
            tmp_path = tmp_path_factory.mktemp("given")
            path, out = tmp_path / "a.ply", tmp_path / "b.ply"
            path.write_bytes(small_ply("ascii", body.encode()))
            if words is None:
                transform_ply(path, out, SIMILARITY)
                assert out.read_bytes().endswith(body.partition("\n")[2].partition("\n")[2].encode())
                continue
            with pytest.raises(FormatError, match=words):
                transform_ply(path, out, SIMILARITY)


def test_a_list_of_fewer_values_than_none_is_refused(tmp_path):
    path, out = tmp_path / "a.ply", tmp_path / "b.ply"
    path.write_bytes(small_ply("ascii", b"-1\n", count="char", vertices=0))
    with pytest.raises(FormatError, match="too few values for element face"):
        transform_ply(path, out, SIMILARITY)


VERTICES = np.zeros(2, [("xyz", "<f4", 3), ("label", "u1")]).tobytes()


def test_a_binary_file_has_the_bytes_that_it_should(subtests, tmp_path_factory):
    for data, words in (
        (small_ply("binary_little_endian", VERTICES + bytes([1, 0, 0, 0, 0])), None),
        (small_ply("binary_little_endian", VERTICES, faces=0, end=""), "does not end"),
        (small_ply("binary_little_endian", VERTICES, faces=0, end="comment" + "x" * 100_000), "does not end"),
        (small_ply("binary_little_endian", VERTICES, faces=0, vertices=3), "3 rows of vertex do not fit"),
        (small_ply("binary_little_endian", VERTICES + bytes([1, 0, 0])), "truncated within element face"),
        (small_ply("binary_little_endian", VERTICES + bytes([200, 0, 0, 0, 0])), "truncated within element face"),
        (small_ply("binary_little_endian", VERTICES + bytes([255]), count="char"), "a list of -1 values in element"),
        (small_ply("binary_little_endian", VERTICES + bytes([1, 2, 0, 0, 0])), "none of the 2 vertices"),
        (small_ply("binary_little_endian", VERTICES + bytes([1, 0, 0, 0, 0, 7])), "1 bytes follow"),
    ):
        with subtests.test(bytes=len(data), words=words):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "a.ply"
            path.write_bytes(data)
            if words is None:
                transform_ply(path, tmp_path / "b.ply", SIMILARITY)
                assert len((tmp_path / "b.ply").read_bytes()) == len(data)
                continue
            with pytest.raises(FormatError, match=words):
                transform_ply(path, tmp_path / "b.ply", SIMILARITY)
