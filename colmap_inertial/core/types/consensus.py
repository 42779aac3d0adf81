"""Agreement of a reconstruction's cameras with the gyroscope."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray, check_fields, set_fields


@dataclass(frozen=True, kw_only=True)
class WrongCamera:
    """A camera whose rotation contradicts the gyroscope.

    Attributes
    ----------
    name
        Of its image.
    deviation_deg
        How far it is turned against the cameras around it.
    """

    name: str
    deviation_deg: float


@dataclass(frozen=True, kw_only=True)
class Seam:
    """A place where all later cameras are rotated against the earlier ones by the same angle.

    Attributes
    ----------
    before, name
        The images on either side.
    turn_deg
        By how much.
    """

    before: str
    name: str
    turn_deg: float


@dataclass(frozen=True, eq=False, kw_only=True)
class RotationConsensus:
    """Rotations of a reconstruction against the gyroscope's.

    Attributes
    ----------
    names
        (F,) images.
    t_s
        (F,) their times, camera clock.
    judged
        (F,) those that the gyroscope recorded.
    deviation_deg
        (F,) how far each camera is turned against those around it; 0 where it was not judged.
    part
        (F,) which cameras form one rigid model: 0 is the largest part, -1 a wrong camera.
    ref_from_part_xyzw
        (P, 4) rotations of the world that bring parts into agreement with the largest.
    moved
        Cameras whose rotations agree and whose positions the accelerometer contradicts.
    registered_again
        Cameras that were wrong, and are kept where matches place them: they agree.
    joined
        Cameras of smaller parts that the IMU joined to the largest one.
    """

    names: tuple[str, ...]
    t_s: Array
    judged: BoolArray
    deviation_deg: Array
    part: IndexArray
    ref_from_part_xyzw: Array
    moved: tuple[str, ...] = ()
    registered_again: tuple[str, ...] = ()
    joined: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self, t_s=("F",), deviation_deg=("F",), ref_from_part_xyzw=("P", 4))
        set_fields(self, names=tuple(self.names), part=np.asarray(self.part), judged=np.asarray(self.judged))
        if not len(self.names) == len(self.judged) == len(self.t_s) == len(self.part):
            raise ValueError("one deviation and one part for each camera")

    @property
    def kept(self) -> BoolArray:
        """(F,) cameras of the largest part that were not moved."""
        return np.asarray((self.part == 0) & ~np.isin(self.names, self.moved))

    @property
    def left_out(self) -> tuple[str, ...]:
        """Images of all other cameras that were not joined."""
        joined = set(self.joined)
        return tuple(name for name, kept in zip(self.names, self.kept, strict=True) if not kept and name not in joined)

    @property
    def deviations_deg(self) -> dict[str, float]:
        """Rotation of each judged camera against its neighbours, by image name."""
        each = zip(self.names, self.deviation_deg.tolist(), self.judged, strict=True)
        return {name: deg for name, deg, judged in each if judged}

    @property
    def wrong(self) -> tuple[WrongCamera, ...]:
        """Cameras that contradict the gyroscope by themselves."""
        return tuple(
            WrongCamera(name=self.names[i], deviation_deg=float(self.deviation_deg[i]))
            for i in np.flatnonzero(self.part < 0)
        )

    @property
    def seams(self) -> tuple[Seam, ...]:
        """Seams between the parts."""
        placed = np.flatnonzero(self.part >= 0)
        out = []
        for i, j in pairwise(placed.tolist()):
            if self.part[i] != self.part[j]:
                a, b = (self.ref_from_part_xyzw[self.part[k]] for k in (i, j))
                turn_deg = 2 * np.degrees(np.arccos(min(1.0, abs(float(a @ b)))))
                out.append(Seam(before=self.names[i], name=self.names[j], turn_deg=float(turn_deg)))
        return tuple(out)

    def list_part(self, number: int) -> tuple[str, ...]:
        """Images of a part that were not moved."""
        mine = (self.part == number) & ~np.isin(self.names, self.moved)
        return tuple(self.names[i] for i in np.flatnonzero(mine))

    def updated(self, later: RotationConsensus) -> RotationConsensus:
        """The consensus after some cameras were registered again; the others stay wrong."""
        place = {name: i for i, name in enumerate(later.names)}
        at = np.array([place.get(name, -1) for name in self.names])
        before = (*(camera.name for camera in self.wrong), *self.moved)
        again = (name for name in before if name in place and later.kept[place[name]])
        return RotationConsensus(
            names=self.names,
            t_s=self.t_s,
            judged=np.where(at >= 0, later.judged[at], self.judged),
            deviation_deg=np.where(at >= 0, later.deviation_deg[at], self.deviation_deg),
            part=np.where(at >= 0, later.part[at], self.part),
            ref_from_part_xyzw=later.ref_from_part_xyzw,
            moved=(*(name for name in self.moved if name not in place), *later.moved),
            registered_again=(*self.registered_again, *again),
        )

    def as_json(self) -> dict[str, object]:
        """The findings in JSON types."""
        judged = self.deviation_deg[self.judged & self.kept]
        return {
            "judged": int(self.judged.sum()),
            "unjudged": int((~self.judged).sum()),
            "median_deg": float(np.median(judged)) if len(judged) else None,
            "wrong": [{"name": one.name, "deg": one.deviation_deg} for one in self.wrong],
            "seams": [{"before": one.before, "name": one.name, "deg": one.turn_deg} for one in self.seams],
            "moved": list(self.moved),
            "left_out": list(self.left_out),
            "registered_again": list(self.registered_again),
            "joined": list(self.joined),
            "deviations_deg": self.deviations_deg,
        }
