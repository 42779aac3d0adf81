"""A camera of several apertures: what each sees, and from where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.types.recorded import CameraModel, LengthUnit
from colmap_inertial.core.validation import check_fields, set_fields

#: What an aperture's filter passes; ``other`` (near infrared, say) takes part in matching and in no colour.
SpectralRole = Literal["red", "green", "blue", "luminance", "other"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Aperture:
    """One camera unit of a multi-aperture camera.

    Attributes
    ----------
    name
        Unique in its rig.
    role
        What its filter passes.
    camera
        Intrinsics.
    cam_from_rig_xyzw
        (4,) rotation.
    cam_in_rig
        (3,) camera centre, in the rig's ``length_unit``.
    """

    name: str
    role: SpectralRole
    camera: CameraModel
    cam_from_rig_xyzw: Array
    cam_in_rig: Array

    def __post_init__(self) -> None:
        check_fields(self, cam_from_rig_xyzw=(4,), cam_in_rig=(3,))


@dataclass(frozen=True, eq=False, kw_only=True)
class ApertureRig:
    """The camera units of a multi-aperture camera.

    Attributes
    ----------
    apertures
        Two or more, at different places. The first one is the reference, through which the fused picture is seen; the
        second one is its partner, and disparities are shifts between these two.
    length_unit
        ``"m"``, or ``"model"`` where the calibration has no scale.
    """

    apertures: tuple[Aperture, ...]
    length_unit: LengthUnit = "m"

    def __post_init__(self) -> None:
        set_fields(self, apertures=tuple(self.apertures))
        if len(self.apertures) < 2:
            raise ValueError("a rig needs at least two apertures")
        if len(set(self.names)) != len(self.apertures):
            raise ValueError("apertures must have different names")
        centres = np.stack([aperture.cam_in_rig for aperture in self.apertures])
        if not np.linalg.norm(centres[1] - centres[0]) > 0:
            raise ValueError(f"{self.names[0]} and {self.names[1]} are at the same place: no parallax, no disparity")

    @property
    def names(self) -> tuple[str, ...]:
        """Of the apertures, in order."""
        return tuple(aperture.name for aperture in self.apertures)

    @property
    def reference(self) -> Aperture:
        """The aperture through which the fused picture is seen."""
        return self.apertures[0]
