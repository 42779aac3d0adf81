"""Where a satellite receiver says that a camera was."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray, Int64Array
from colmap_inertial.core.validation import check_fields, set_fields

#: What heights count from: WGS84's ellipsoid, the sea, or what nobody said.
HeightDatum = Literal["ellipsoid", "sea", "unknown"]


@dataclass(frozen=True, eq=False, kw_only=True)
class PositionFixes:
    """Positions of a satellite receiver, WGS84.

    Attributes
    ----------
    latitude_deg, longitude_deg
        (N,) north and east positive.
    height_m
        (N,) nan where it is not known.
    sigma_m
        (N,) standard deviation of each horizontal coordinate as the receiver states it; nan where it does not.
    t_ns
        (N,) when, on the clock of the video that holds them; ``None`` where ``names`` says it.
    names
        (N,) of the pictures that hold them; ``None`` where ``t_ns`` says it.
    height_above
        What heights count from.
    source
        Where they were read, in words.
    """

    latitude_deg: Array
    longitude_deg: Array
    height_m: Array
    sigma_m: Array
    t_ns: Int64Array | None = None
    names: tuple[str, ...] | None = None
    height_above: HeightDatum = "unknown"
    source: str = ""

    def __post_init__(self) -> None:
        check_fields(self, latitude_deg=("N",), longitude_deg=("N",))
        n = len(self.latitude_deg)
        if (self.t_ns is None) == (self.names is None):
            raise ValueError("either times or names")
        if self.names is not None and len(self.names) != n:
            raise ValueError("one name for each position")
        if np.abs(self.latitude_deg).max(initial=0) > 90 or np.abs(self.longitude_deg).max(initial=0) > 360:
            raise ValueError("latitudes reach from -90 to 90 degrees, longitudes from -180 to 180")
        for name in ("height_m", "sigma_m"):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != (n,) or np.isinf(values).any():
                raise ValueError(f"{name}: must be ({n},), finite or nan")
            values.setflags(write=False)
            set_fields(self, **{name: values})
        if self.t_ns is not None:
            set_fields(self, t_ns=np.asarray(self.t_ns, dtype=np.int64))

    def select(self, index: IndexArray | BoolArray) -> PositionFixes:
        """Some of them."""
        names = None if self.names is None else tuple(np.array(self.names, dtype=object)[index])
        arrays = ("latitude_deg", "longitude_deg", "height_m", "sigma_m")
        t_ns = None if self.t_ns is None else self.t_ns[index]
        return replace(self, **{name: getattr(self, name)[index] for name in arrays}, t_ns=t_ns, names=names)
