"""Sparse points as PLY and LAS."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.core.errors import MissingExtraError

if TYPE_CHECKING:
    import pycolmap

    from colmap_inertial.inertial.georeference import Georeference

#: Step of the integers that LAS keeps coordinates in, model units.
_LAS_STEP, _LAS_RANGE = 1e-6, 2**31 - 1


def sparse_points(model: pycolmap.Reconstruction) -> tuple[Array, UInt8Array]:
    """(N, 3) positions and (N, 3) colours of a model's points, in the order of their numbers."""
    points = [model.points3D[i] for i in sorted(model.points3D)]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    return xyz, np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)


def write_ply(path: Path, xyz: Array, rgb: UInt8Array, comments: tuple[str, ...] = ()) -> None:
    """Write points as PLY: binary, little-endian, float positions, 8-bit colours."""
    rows = np.zeros(
        len(xyz), [(name, "<f4") for name in ("x", "y", "z")] + [(name, "u1") for name in ("red", "green", "blue")]
    )
    for i, (place, colour) in enumerate((("x", "red"), ("y", "green"), ("z", "blue"))):
        rows[place], rows[colour] = xyz[:, i], rgb[:, i]
    kinds = ("float x", "float y", "float z", "uchar red", "uchar green", "uchar blue")
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
        raise MissingExtraError("las", "LAS files are written by laspy, and put on the map by pyproj") from None


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
    header.offsets, header.scales = offset, np.full(3, max(_LAS_STEP, reach / _LAS_RANGE))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.red, las.green, las.blue = (rgb.astype(np.uint16) * 257).T
    las.write(str(path))
