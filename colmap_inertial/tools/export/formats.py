"""Points as PLY and LAS; the camera's path as TUM text, CSV and glTF."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, UInt8Array, UInt16Array
from colmap_inertial.core.errors import FormatError, MissingExtraError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_from_matrix, rotation_between
from colmap_inertial.core.printing import cell
from colmap_inertial.core.types import CameraMotion, CameraTrajectory
from colmap_inertial.io.files import write_text
from colmap_inertial.io.trajectories import read_tum
from colmap_inertial.tools.export.transforms import OPENGL_FROM_CAM, View

if TYPE_CHECKING:
    import pycolmap
    from pygltflib import GLTF2

    from colmap_inertial.inertial.georeference import Georeference


_COLUMNS = (
    *("name", "t_s", "x", "y", "z", "qx", "qy", "qz", "qw"),
    *("vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s"),
)
_PLACE = ("latitude_deg", "longitude_deg", "height_m")
_GLTF_UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, kw_only=True)
class LasLimits:
    """Resolution and range of LAS coordinates."""

    #: Where a drawn camera begins to see, metres.
    near_m: float = 0.01
    #: Step of the integers that LAS keeps coordinates in, model units.
    las_step: float = 1e-6
    las_range: int = 2**31 - 1


_LIMITS = LasLimits()


def smooth_path(trajectory: Path | None, model: Path) -> CameraTrajectory:
    """The smoothed path of a model.

    Raises
    ------
    FormatError
        Where there is none.
    """
    if trajectory is None or not trajectory.is_file():
        raise FormatError(model, Fact("no-smoothed-path"))
    return read_tum(trajectory)


def write_cameras(
    path: Path,
    views: list[View],
    motion: CameraMotion | None,
    originals: dict[str, str],
    on_map: Georeference | None = None,
) -> None:
    """Write a row for each image: its time, pose and velocities, where they are known.

    Columns: image name; seconds on the camera's clock; camera centre; rotation world_from_camera (x right, y down, z
    forward); velocity in the world; angular velocity in the camera's axes; with ``on_map`` latitude, longitude and
    height (WGS84).
    """
    place = {} if motion is None else {name: i for i, name in enumerate(motion.names)}
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(_COLUMNS if on_map is None else (*_COLUMNS, *_PLACE))
    for view in views:
        name = originals[view.name]
        pose = (*view.cam_in_world, *quat_conjugate(view.cam_from_world_xyzw))
        index = place.get(name)
        time, moving = "", [""] * 6
        if motion is not None and index is not None:
            total_ns = motion.epoch_ns + round(float(motion.t_s[index]) * 1e9)
            time = f"{'-' if total_ns < 0 else ''}{abs(total_ns) // 10**9}.{abs(total_ns) % 10**9:09d}"
            both = (*motion.velocity_in_world_m_s[index], *motion.angular_velocity_in_cam_rad_s[index])
            moving = [f"{value:.9g}" for value in both]
        place_on_map = [] if on_map is None else on_map.geodetic(view.cam_in_world[None])[0].tolist()
        lengths = [[f"{value:.12g}" for value in values] for values in (pose, place_on_map)]
        rows.writerow([cell(name), time, *lengths[0], *moving, *lengths[1]])
    write_text(path, text.getvalue())


def require_pygltflib() -> None:
    """Raise :class:`MissingExtraError` where pygltflib is not installed."""
    try:
        import pygltflib  # noqa: F401
    except ImportError:
        raise MissingExtraError("gltf", Fact("needs-pygltflib")) from None


def write_gltf(
    path: Path,
    views: list[View],
    trajectory: CameraTrajectory | None,
    xyz: Array,
    rgb: UInt8Array,
    up_in_world: Array,
    offset: Array | None = None,
) -> None:
    """Write cameras, points, the path as a line and as an animated camera: glTF 2.0, binary, metres, y up.

    Colours of points are linear, as the standard has them.

    Parameters
    ----------
    views
        A camera each.
    trajectory
        The smoothed path; ``None`` where there is none.
    xyz, rgb
        (N, 3) points and colours.
    up_in_world
        (3,) becomes +y by the node that all others hang from.
    offset
        (3,) the place of a node that all others hang from, too: what buffers hold in single precision is about it.

    Raises
    ------
    MissingExtraError
        Without pygltflib.
    """
    require_pygltflib()
    import pygltflib as gl

    made, place = _Gltf(gl), np.zeros(3) if offset is None else offset
    children = [made.node(name="points", mesh=made.points(xyz - place, rgb))] if len(xyz) else []
    centres = np.array([view.cam_in_world for view in views]) if trajectory is None else trajectory.cam_in_world
    centres = centres - place
    if len(centres) > 1:
        children.append(made.node(name="path", mesh=made.line(centres)))
    seen: dict[tuple[object, ...], int] = {}
    for view in views:
        camera = view.camera
        key = (camera.width, camera.height, camera.params)
        if key not in seen:
            seen[key] = made.camera(camera.width / camera.params[0], camera.height / camera.params[1])
        pose = {
            "translation": (view.cam_in_world - place).tolist(),
            "rotation": _opengl(view.cam_from_world_xyzw[None])[0].tolist(),
        }
        children.append(made.node(name=view.name.rpartition(".")[0], camera=seen[key], **pose))
    if trajectory is not None:
        moving = made.node(name="moving camera", camera=next(iter(seen.values())))
        made.animate(moving, trajectory.t_s, centres, _opengl(trajectory.cam_from_world_xyzw))
        children.append(moving)
    if offset is not None:
        children = [made.node(name="place", translation=offset.tolist(), children=children)]
    root = made.node(name="world", rotation=rotation_between(up_in_world, _GLTF_UP).tolist(), children=children)
    made.write(path, root)


def _opengl(cam_from_world_xyzw: Array) -> Array:
    """(N, 4) world from camera with the axes that glTF's cameras have."""
    return quat_from_matrix(matrix_from_quat(quat_conjugate(cam_from_world_xyzw)) @ OPENGL_FROM_CAM)


def _linear(rgb: UInt8Array) -> UInt16Array:
    """(N, 3) linear values of 16 bit of colours as images have them (sRGB, IEC 61966-2-1)."""
    share = rgb / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.round(65535 * linear).astype(np.uint16)


class _Gltf:
    """A glTF with one buffer, part by part."""

    def __init__(self, gl: Any) -> None:
        self._gl = gl
        self._gltf: GLTF2 = gl.GLTF2(asset=gl.Asset(version="2.0", generator="colmap-inertial"))
        self._data = bytearray()

    def node(self, **fields: Any) -> int:
        self._gltf.nodes.append(self._gl.Node(**fields))
        return len(self._gltf.nodes) - 1

    def camera(self, width: float, height: float) -> int:
        """One that sees so far to both sides together, at a distance of 1."""
        lens = self._gl.Perspective(
            yfov=float(2 * np.arctan(0.5 * height)), aspectRatio=float(width / height), znear=_LIMITS.near_m
        )
        self._gltf.cameras.append(self._gl.Camera(type="perspective", perspective=lens))
        return len(self._gltf.cameras) - 1

    def points(self, xyz: Array, rgb: UInt8Array) -> int:
        colours = np.concatenate([_linear(rgb), np.full((len(rgb), 1), 65535, np.uint16)], axis=1)
        attributes = self._gl.Attributes(
            POSITION=self._accessor(xyz, "VEC3", bounds=True), COLOR_0=self._accessor(colours, "VEC4")
        )
        return self._mesh(attributes, self._gl.POINTS)

    def line(self, xyz: Array) -> int:
        return self._mesh(self._gl.Attributes(POSITION=self._accessor(xyz, "VEC3", bounds=True)), self._gl.LINE_STRIP)

    def animate(self, node: int, t_s: Array, places: Array, rotations: Array) -> None:
        gl, since = self._gl, self._accessor((t_s - t_s[0])[:, None], "SCALAR", bounds=True)
        animation = gl.Animation(name="camera path", samplers=[], channels=[])
        for what, values, kind in (("translation", places, "VEC3"), ("rotation", rotations, "VEC4")):
            animation.samplers.append(gl.AnimationSampler(input=since, output=self._accessor(values, kind)))
            target = gl.AnimationChannelTarget(node=node, path=what)
            animation.channels.append(gl.AnimationChannel(sampler=len(animation.samplers) - 1, target=target))
        self._gltf.animations.append(animation)

    def write(self, path: Path, root: int) -> None:
        self._gltf.scenes, self._gltf.scene = [self._gl.Scene(nodes=[root])], 0
        self._gltf.buffers = [self._gl.Buffer(byteLength=len(self._data))]
        self._gltf.set_binary_blob(bytes(self._data))
        path.write_bytes(b"".join(self._gltf.save_to_bytes()))

    def _mesh(self, attributes: Any, mode: int) -> int:
        self._gltf.meshes.append(self._gl.Mesh(primitives=[self._gl.Primitive(attributes=attributes, mode=mode)]))
        return len(self._gltf.meshes) - 1

    def _accessor(self, values: AnyArray, kind: str, *, bounds: bool = False) -> int:
        """Values (N, K) into the buffer: whole numbers of 16 bit as they are (normalised), all else as float."""
        gl, is_whole = self._gl, values.dtype == np.uint16
        stored = values.astype("<u2" if is_whole else "<f4")
        self._gltf.bufferViews.append(gl.BufferView(buffer=0, byteOffset=len(self._data), byteLength=stored.nbytes))
        self._data += stored.tobytes()
        self._gltf.accessors.append(
            gl.Accessor(
                bufferView=len(self._gltf.bufferViews) - 1,
                componentType=gl.UNSIGNED_SHORT if is_whole else gl.FLOAT,
                normalized=is_whole,
                count=len(stored),
                type=kind,
                min=stored.min(axis=0).tolist() if bounds else None,
                max=stored.max(axis=0).tolist() if bounds else None,
            )
        )
        return len(self._gltf.accessors) - 1


def sparse_points(model: pycolmap.Reconstruction) -> tuple[Array, UInt8Array]:
    """(N, 3) positions and (N, 3) colours of a model's points, in the order of their numbers."""
    points = [model.points3D[i] for i in sorted(model.points3D)]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    return xyz, np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)


def write_ply(
    path: Path, xyz: Array, rgb: UInt8Array, comments: tuple[str, ...] = (), *, doubles: bool = False
) -> None:
    """Write points as PLY: binary, little-endian, positions of single or double precision, 8-bit colours."""
    kind, stored = ("double", "<f8") if doubles else ("float", "<f4")
    rows = np.zeros(
        len(xyz), [(name, stored) for name in ("x", "y", "z")] + [(name, "u1") for name in ("red", "green", "blue")]
    )
    for i, (place, colour) in enumerate((("x", "red"), ("y", "green"), ("z", "blue"))):
        rows[place], rows[colour] = xyz[:, i], rgb[:, i]
    kinds = (f"{kind} x", f"{kind} y", f"{kind} z", "uchar red", "uchar green", "uchar blue")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(rows)}",
        *(f"property {kind}" for kind in kinds),
        "end_header",
    ]
    path.write_bytes(("\n".join(header) + "\n").encode("ascii") + rows.tobytes())


def require_laspy() -> None:
    """Raise :class:`MissingExtraError` where laspy is not installed."""
    try:
        import laspy  # noqa: F401
        import pyproj  # noqa: F401
    except ImportError:
        raise MissingExtraError("las", Fact("needs-laspy")) from None


def utm_epsg(latitude_deg: float, longitude_deg: float) -> int:
    """EPSG's number of the UTM zone (WGS84) of a place, without the exceptions around Norway."""
    zone = int((longitude_deg + 180) // 6) % 60 + 1
    return (32600 if latitude_deg >= 0 else 32700) + zone


def write_las(path: Path, xyz: Array, rgb: UInt8Array, on_map: Georeference | None = None) -> None:
    """Write points as LAS 1.2, point format 2: coordinates to a micrometre where they allow it, 16-bit colours.

    With ``on_map`` in UTM (WGS84) of the zone that the model lies in, and the file says so; else in the model's world.

    Raises
    ------
    MissingExtraError
        Without laspy.
    """
    require_laspy()
    import laspy

    header = laspy.LasHeader(point_format=2, version="1.2")
    if on_map is not None:
        import pyproj

        crs = pyproj.CRS.from_epsg(utm_epsg(on_map.latitude_deg, on_map.longitude_deg))
        header.add_crs(crs)
        latitude, longitude, height = on_map.geodetic(xyz).T
        east, north = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(longitude, latitude)
        xyz = np.stack([east, north, height], axis=1)
    # 32-bit integers: the step grows with what is far away
    offset = np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
    reach = float(np.abs(xyz - offset).max(initial=0.0))
    header.offsets, header.scales = offset, np.full(3, max(_LIMITS.las_step, reach / _LIMITS.las_range))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.red, las.green, las.blue = (rgb.astype(np.uint16) * 257).T
    las.write(str(path))
