"""Axes of a sensor in another order, or with other signs."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact


@dataclass(frozen=True, eq=False, kw_only=True)
class Axes:
    """File axes of x, y and z: ``"y,-x,z"`` means x = the file's y, y = minus the file's x, z = its z.

    Attributes
    ----------
    matrix
        (3, 3) signed permutation: ``v_imu = matrix @ v_file``.
    """

    matrix: Array

    @classmethod
    def parse(cls, text: str) -> Axes:
        """The mapping that ``text`` spells.

        Raises
        ------
        ValueError
            When it does not name x, y and z once each.
        """
        parts = [part.strip().lower() for part in text.split(",")]
        matrix = np.zeros((3, 3))
        for row, part in enumerate(parts[:3]):
            match = re.fullmatch(r"([+-]?)([xyz])", part)
            if match:
                matrix[row, "xyz".index(match[2])] = -1.0 if match[1] == "-" else 1.0
        if len(parts) != 3 or not np.array_equal(np.abs(matrix).sum(axis=0), np.ones(3)):
            raise ValueError(Fact("not-axes", text=text))
        return cls(matrix=matrix)

    @classmethod
    def of_letters(cls, text: str) -> Axes:
        """The mapping that three letters spell, of which a small one is the opposite: ``"YxZ"`` is ``"y,-x,z"``."""
        return cls.parse(",".join(("-" if letter.islower() else "") + letter for letter in text))

    @property
    def is_mirrored(self) -> bool:
        """Whether the mapping turns a right-handed frame into a left-handed one."""
        return bool(np.linalg.det(self.matrix) < 0)

    def setting(self) -> tuple[str, bool]:
        """As capture.toml has it: the axes, and whether they are mirrored."""
        return str(self), self.is_mirrored

    def apply(self, values: Array) -> Array:
        """(N, 3) samples in the IMU frame from (N, 3) samples in the file's order."""
        # a missing or damaged value stays one: 0 * inf is no news
        with np.errstate(invalid="ignore"):
            return values @ self.matrix.T

    def __str__(self) -> str:
        index = np.argmax(np.abs(self.matrix), axis=1)
        return ",".join(("-" if self.matrix[row, i] < 0 else "") + "xyz"[i] for row, i in enumerate(index))
