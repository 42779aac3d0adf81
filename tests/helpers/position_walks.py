"""Walks with positions of a satellite receiver, and their truth."""

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.earth import ecef_from_enu, ecef_of_geodetic, geodetic_of_ecef
from colmap_inertial.core.types import PositionFixes
from colmap_inertial.inertial.georeference import georeference

UP = np.array([0.0, 0.0, 1.0])


def turn(angle_rad):
    s, c = np.sin(angle_rad), np.cos(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def geodetic_of_enu(enu_m, origin):
    ecef = enu_m @ ecef_from_enu(origin[0], origin[1]).T + ecef_of_geodetic(np.array([origin]))[0]
    return geodetic_of_ecef(ecef)


@dataclass(frozen=True, kw_only=True)
class Walk:
    """A path in metres, its true heading and place, and positions with errors."""

    path_m: np.ndarray
    t_s: np.ndarray
    heading_rad: float
    origin: tuple[float, float, float]
    fixes: PositionFixes

    def fitted(self, up=UP):
        return georeference(self.fixes, self.path_m, self.t_s, up)

    def heading_error_deg(self, found):
        matrix = found.enu_from_world @ turn(self.heading_rad).T
        return float(np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0])))

    def place_error_m(self, found):
        true = (turn(self.heading_rad) @ found.middle_in_world_m) @ ecef_from_enu(*self.origin[:2]).T
        apart = found.ecef_m(found.middle_in_world_m[None])[0] - true - ecef_of_geodetic(np.array([self.origin]))[0]
        return apart @ ecef_from_enu(*self.origin[:2])


def walk(seed, *, seconds=60, white_m=3.0, slow_m=0.0, alike_s=60.0, length=1.0, steps=1.2, jumps=0):
    rng = np.random.default_rng(seed)
    t_s = np.arange(float(seconds))
    course = np.cumsum(0.1 * rng.standard_normal(seconds))
    path = np.cumsum(steps * np.stack([np.cos(course), np.sin(course), 0.05 * np.sin(t_s)], axis=1), axis=0)
    error, state = np.zeros((seconds, 3)), rng.standard_normal(3) * slow_m
    for i in range(seconds):
        keep = np.exp(-1 / alike_s)
        state = keep * state + np.sqrt(1 - keep**2) * slow_m * rng.standard_normal(3)
        error[i] = state + white_m * rng.standard_normal(3)
    error[rng.choice(seconds, jumps, replace=False)] += 80.0
    heading = rng.uniform(-np.pi, np.pi)
    origin = (rng.uniform(-80, 80), rng.uniform(-179, 179), 120.0)
    place = geodetic_of_enu(length * path @ turn(heading).T + error, origin)
    fixes = PositionFixes(
        latitude_deg=place[:, 0],
        longitude_deg=place[:, 1],
        height_m=place[:, 2],
        sigma_m=np.full(seconds, np.nan),
        t_ns=(t_s * 1e9).astype(np.int64),
        height_above="ellipsoid",
    )
    return Walk(path_m=path, t_s=t_s, heading_rad=heading, origin=origin, fixes=fixes)
