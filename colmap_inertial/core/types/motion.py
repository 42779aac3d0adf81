"""How a camera moved: what is written beside its path, and what a stage solved for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.types.recorded import ReadoutDirection
from colmap_inertial.core.validation import check_fields, checked_field, set_fields

#: An image stands where it stood within this part of its distance from the origin, and of one unit.
_UNMOVED = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraMotion:
    """How a camera moved while each of its frames was exposed, and how long its shutter took.

    Attributes
    ----------
    names
        (F,) image names, in order of time.
    t_s
        (F,) the instants that poses hold, mid-exposure of the middle row: camera clock, seconds since ``epoch_ns``.
    velocity_in_world_m_s
        (F, 3) of the camera's centre, in the world of the metric model.
    angular_velocity_in_cam_rad_s
        (F, 3) camera axes (x right, y down, z forward).
    exposure_s
        (F,) exposure times, or ``None`` where unknown.
    readout_s, readout_direction
        Of the pictures as they were filmed, as in :class:`FrameTiming`.
    """

    names: tuple[str, ...]
    t_s: Array
    velocity_in_world_m_s: Array
    angular_velocity_in_cam_rad_s: Array
    exposure_s: Array | None = None
    readout_s: float | None = None
    readout_direction: ReadoutDirection = "down"
    epoch_ns: int = 0

    def __post_init__(self) -> None:
        velocities = ("velocity_in_world_m_s", "angular_velocity_in_cam_rad_s")
        # without any frame, JSON keeps no shape
        set_fields(self, **{name: np.reshape(getattr(self, name), (-1, 3)) for name in velocities})
        check_fields(self, t_s=("F",), **dict.fromkeys(velocities, ("F", 3)), exposure_s=("F",))
        if len(self.names) != len(self.t_s):
            raise ValueError("one name for each instant")
        set_fields(self, names=tuple(self.names))


@dataclass(frozen=True, eq=False, kw_only=True)
class SolvedMotion:
    """How a camera moved, where a stage solved for poses and velocities together.

    Attributes
    ----------
    cam_in_world
        By image name, (3,) where the camera's centre was, in the model's world and units; what is said of an image
        holds as long as it stands there.
    velocity_in_world
        By image name, (3,) of the camera's centre, in units a second; of images whose velocity is known.
    cov
        By image name, (6, 6) covariance of its position against the first one's, and of its velocity: of all images, or
        of some.
    readout_s
        Of the pictures as they were filmed; ``None`` where it was not solved for.
    """

    cam_in_world: Mapping[str, Array]
    velocity_in_world: Mapping[str, Array]
    cov: Mapping[str, Array]
    readout_s: float | None = None

    def __post_init__(self) -> None:
        for field, shape in (("cam_in_world", (3,)), ("velocity_in_world", (3,)), ("cov", (6, 6))):
            values = {n: checked_field(f"{n}: {field}", v, shape) for n, v in getattr(self, field).items()}
            set_fields(self, **{field: values})

    def of(self, names: Sequence[str], cam_in_world: Array) -> SolvedMotion:
        """What holds of these images: of those that still stand where they stood when this was solved.

        Parameters
        ----------
        names
            (F,) images.
        cam_in_world
            (F, 3) their centres now.
        """
        unmoved = set()
        for name, centre in zip(names, cam_in_world, strict=True):
            solved = self.cam_in_world.get(name)
            if solved is not None and np.linalg.norm(centre - solved) <= _UNMOVED * (1 + np.linalg.norm(solved)):
                unmoved.add(name)
        velocity, cov = ({n: v for n, v in of.items() if n in unmoved} for of in (self.velocity_in_world, self.cov))
        return replace(self, velocity_in_world=velocity, cov=cov)
