"""What a capture holds beside the IMU that knows of metres."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.options import ReferenceOptions
from colmap_inertial.core.types import CameraTrajectory, PositionFixes
from colmap_inertial.core.types.depth import DepthMaps
from colmap_inertial.core.types.evidence import AbsentSensor


@dataclass(frozen=True, kw_only=True)
class SeenTarget:
    """A target of known size: its specification, and the folder of the images that agree with the model."""

    spec: str
    images: Path


@dataclass(frozen=True, kw_only=True)
class KnownDistance:
    """A distance that is known, and between what.

    Attributes
    ----------
    lengths
        As they were given.
    markers
        The markers at its ends; ``None`` where both are points.
    """

    lengths: ReferenceOptions
    markers: SeenTarget | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureSensors:
    """What a capture holds beside the IMU that knows of metres, joined with its images by name.

    Attributes
    ----------
    depth
        Depth maps.
    device
        The path that the device computed by itself, in its metres.
    up_in_device
        (3,) against gravity in its world, where that is known.
    fixes
        Positions of a satellite receiver.
    target
        A target of known size that gives metres, too.
    distance
        A known distance that gives metres, too.
    absent
        What is there and cannot be used.
    files
        Identity of the files behind.
    """

    depth: DepthMaps | None = None
    device: CameraTrajectory | None = None
    up_in_device: Array | None = None
    fixes: PositionFixes | None = None
    target: SeenTarget | None = None
    distance: KnownDistance | None = None
    absent: tuple[AbsentSensor, ...] = ()
    files: tuple[object, ...] = ()

    def __bool__(self) -> bool:
        there = (self.depth, self.device, self.fixes, self.target, self.distance)
        return any(one is not None for one in there) or bool(self.absent)

    @property
    def seen_in(self) -> Path | None:
        """The images in which a target or markers are searched; ``None`` where none are."""
        seen = self.target or (None if self.distance is None else self.distance.markers)
        return None if seen is None else seen.images
