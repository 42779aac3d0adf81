"""Coordinates on WGS84's ellipsoid: geodetic, earth-centred, and the axes east, north and up of a place."""

from __future__ import annotations

import math

import numpy as np

from colmap_inertial.core.arrays import Array

#: WGS84: semi-major axis and flattening.
SEMI_MAJOR_M, FLATTENING = 6378137.0, 1 / 298.257223563
_ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)


def ecef_of_geodetic(geodetic: Array) -> Array:
    """(N, 3) earth-centred metres of latitude and longitude (degrees) and height above WGS84's ellipsoid (N, 3)."""
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    vertical = SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    across = (vertical + geodetic[:, 2]) * np.cos(latitude)
    up = (vertical * (1 - _ECCENTRICITY2) + geodetic[:, 2]) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), up], axis=1)


def ecef_from_enu(latitude_deg: float, longitude_deg: float) -> Array:
    """(3, 3) whose columns are east, north and up in earth-centred axes."""
    s, c = math.sin(math.radians(latitude_deg)), math.cos(math.radians(latitude_deg))
    t, k = math.sin(math.radians(longitude_deg)), math.cos(math.radians(longitude_deg))
    return np.array([[-t, -s * k, c * k], [k, -s * t, c * t], [0.0, c, s]])


def geodetic_of_ecef(ecef_m: Array) -> Array:
    """(N, 3) latitude, longitude, height of earth-centred coordinates (Bowring's iteration)."""
    x, y, z = ecef_m.T
    across = np.hypot(x, y)
    latitude = np.arctan2(z, across * (1 - _ECCENTRICITY2))
    for _ in range(6):
        sine = np.sin(latitude)
        vertical = SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY2 * sine**2)
        latitude = np.arctan2(z + _ECCENTRICITY2 * vertical * sine, across)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    vertical = SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY2 * sine**2)
    # along the normal of the ellipsoid, good at the poles, too
    height = across * cosine + z * sine - SEMI_MAJOR_M**2 / vertical
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height], axis=1)
