"""Gaussian splats under a similarity: positions, sizes, rotations, and colours that depend on the direction of view.

The fields are those that 3D Gaussian Splatting writes into its PLY files: logarithms of sizes, quaternions w x y z of
any length, real spherical harmonics by colour channel.
"""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_multiply
from colmap_inertial.core.types import Similarity

_POSITION, _NORMAL, _ROTATION = ("x", "y", "z"), ("nx", "ny", "nz"), tuple(f"rot_{i}" for i in range(4))
#: Fields by which a vertex is a splat; lengths that some programs add.
SPLAT = {"opacity", "f_dc_0", "f_dc_1", "f_dc_2", "scale_0", *_ROTATION}
_LENGTHS = ("filter_3D",)
#: Number of ``f_rest`` fields by degree of the harmonics.
_REST = {0: 0, 9: 1, 24: 2, 45: 3}
#: Directions that tell the rotation of a band: more than it has coefficients, all around.
_DIRECTIONS = 32


def sh_basis(direction: Array, degree: int) -> Array:
    """(N, 2 degree + 1) real spherical harmonics of one band, in the order and with the signs of the splats' files.

    Parameters
    ----------
    direction
        (N, 3) unit vectors.
    degree
        0 to 3.
    """
    x, y, z = np.moveaxis(direction, -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    bands = {
        0: lambda: [np.full_like(x, math.sqrt(1 / (4 * math.pi)))],
        1: lambda: [
            -math.sqrt(3 / (4 * math.pi)) * y,
            math.sqrt(3 / (4 * math.pi)) * z,
            -math.sqrt(3 / (4 * math.pi)) * x,
        ],
        2: lambda: [
            0.5 * math.sqrt(15 / math.pi) * x * y,
            -0.5 * math.sqrt(15 / math.pi) * y * z,
            0.25 * math.sqrt(5 / math.pi) * (2 * zz - xx - yy),
            -0.5 * math.sqrt(15 / math.pi) * x * z,
            0.25 * math.sqrt(15 / math.pi) * (xx - yy),
        ],
        3: lambda: [
            -0.25 * math.sqrt(35 / (2 * math.pi)) * y * (3 * xx - yy),
            0.5 * math.sqrt(105 / math.pi) * x * y * z,
            -0.25 * math.sqrt(21 / (2 * math.pi)) * y * (4 * zz - xx - yy),
            0.25 * math.sqrt(7 / math.pi) * z * (2 * zz - 3 * xx - 3 * yy),
            -0.25 * math.sqrt(21 / (2 * math.pi)) * x * (4 * zz - xx - yy),
            0.25 * math.sqrt(105 / math.pi) * z * (xx - yy),
            -0.25 * math.sqrt(35 / (2 * math.pi)) * x * (xx - 3 * yy),
        ],
    }
    return np.stack(bands[degree](), axis=-1)


def sh_rotation(rotation: Array, degree: int) -> Array:
    """(2 degree + 1, 2 degree + 1) what takes coefficients of a band to those of the function turned by ``rotation``.

    A band is closed under rotation, so what the turned function is in as many directions as it has coefficients, and
    more, determines them: there is nothing to approximate.
    """
    index = np.arange(_DIRECTIONS) + 0.5
    z = 1 - 2 * index / _DIRECTIONS
    turn = math.pi * (1 + math.sqrt(5)) * index
    around = np.sqrt(1 - z * z)
    before = np.stack([around * np.cos(turn), around * np.sin(turn), z], axis=-1)
    rotation_of_sh, *_ = np.linalg.lstsq(sh_basis(before @ rotation.T, degree), sh_basis(before, degree), rcond=None)
    return np.asarray(rotation_of_sh)


def fault_of_splats(names: set[str]) -> Fact | None:
    """Why the splats of a file with these fields cannot be moved; ``None`` where they can."""
    rest = _num_rest(names)
    if not names.issuperset(SPLAT):
        return Fact("splats-lack-fields", names=sorted(SPLAT - names))
    if not names.issuperset(_POSITION):
        return Fact("splats-without-position")
    if rest not in _REST or not names.issuperset(f"f_rest_{i}" for i in range(rest)):
        return Fact("splats-without-harmonics", count=rest)
    return None


def list_changed_fields(names: set[str]) -> list[str]:
    """The fields of splats that change."""
    sizes = sorted(name for name in names if re.fullmatch(r"scale_\d+", name))
    rest = [f"f_rest_{i}" for i in range(_num_rest(names))]
    normal = _NORMAL if names.issuperset(_NORMAL) else ()
    return [*_POSITION, *normal, *sizes, *(name for name in _LENGTHS if name in names), *_ROTATION, *rest]


def _num_rest(names: set[str]) -> int:
    return sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)


class SplatMover:
    """Moves the fields of splats in place; ``names`` are those that change."""

    def __init__(self, similarity: Similarity, names: set[str]) -> None:
        self._similarity = similarity
        self._rotation = matrix_from_quat(similarity.rotation_xyzw)
        self.names = list_changed_fields(names)
        self._bands = [sh_rotation(self._rotation, degree) for degree in range(1, _REST[_num_rest(names)] + 1)]
        self._rest = [name for name in self.names if name.startswith("f_rest_")]
        self._sizes = [name for name in self.names if name.startswith("scale_")]
        self._lengths = [name for name in self.names if name in _LENGTHS]
        self._normal = [name for name in self.names if name in _NORMAL]

    def __call__(self, rows: NDArray[np.void]) -> None:
        """Move them."""
        scale = self._similarity.scale
        with np.errstate(over="ignore", invalid="ignore"):
            _put_columns(
                rows, _POSITION, scale * _get(rows, _POSITION) @ self._rotation.T + self._similarity.translation_m
            )
            if self._normal:
                _put_columns(rows, self._normal, _get(rows, self._normal) @ self._rotation.T)
            _put_columns(rows, self._sizes, _get(rows, self._sizes) + math.log(scale))
            _put_columns(rows, self._lengths, scale * _get(rows, self._lengths))
            turned = quat_multiply(self._similarity.rotation_xyzw, _get(rows, _ROTATION)[:, [1, 2, 3, 0]])
            _put_columns(rows, _ROTATION, turned[:, [3, 0, 1, 2]])
            if self._rest:
                # by channel, then by coefficient
                values = _get(rows, self._rest).reshape(len(rows), 3, -1)
                first = 0
                for band in self._bands:
                    part = slice(first, first + len(band))
                    values[:, :, part] = values[:, :, part] @ band.T
                    first += len(band)
                _put_columns(rows, self._rest, values.reshape(len(rows), -1))


def _get(rows: NDArray[np.void], names: tuple[str, ...] | list[str]) -> Array:
    values = np.empty((len(rows), len(names)))
    for i, name in enumerate(names):
        values[:, i] = rows[name]
    return values


def _put_columns(rows: NDArray[np.void], names: tuple[str, ...] | list[str], values: Array) -> None:
    for i, name in enumerate(names):
        rows[name] = values[:, i]
