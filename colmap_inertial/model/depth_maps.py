"""COLMAP's depth and normal maps: ``width&height&channels&``, then float32 plane by plane."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Float32Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.model.artefacts import check_map


def read_map(path: Path, channels: int = 1) -> Float32Array:
    """Read a map.

    Returns
    -------
    (H, W) depths, 0 where unknown, or (H, W, channels).

    Raises
    ------
    FormatError
        Where it is damaged, or holds another number of channels.
    """
    start = check_map(path, channels)
    data = path.read_bytes()
    width, height = (int(text) for text in data[:start].split(b"&")[:2])
    values = np.frombuffer(data, "<f4", offset=start)
    if len(values) != width * height * channels:
        raise FormatError(path, "was changed while it was read")
    planes = values.reshape(channels, height, width)
    return np.asarray(planes[0] if channels == 1 else np.moveaxis(planes, 0, -1), dtype=np.float32)


def write_map(path: Path, values: Float32Array) -> None:
    """Write (H, W) depths or (H, W, 3) normals; the file appears whole or not at all, its folders are made."""
    planes = values[None] if values.ndim == 2 else np.moveaxis(values, -1, 0)
    channels, height, width = planes.shape
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with open(partial, "wb") as file:
        file.write(b"%d&%d&%d&" % (width, height, channels))
        file.write(np.ascontiguousarray(planes, dtype="<f4").tobytes())
    os.replace(partial, path)
