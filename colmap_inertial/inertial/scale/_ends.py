"""Ends of a video at which its poses jump about, as where tracking was lost: what lies beyond is left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray
from colmap_inertial.core.types import CameraTrajectory


@dataclass(frozen=True, kw_only=True)
class EndLimits:
    """Limits of what is cut off at an end of a video."""

    #: So much at most, of a video that is so many times as long.
    most_s: float = 0.75
    times: float = 10.0
    #: Frames lie no further apart.
    dense_s: float = 0.1
    #: A step is a jump where it is this many times as far off its neighbours as steps usually are, altogether and among
    #: the nearest: of eight recordings no step is more than six times.
    jump: float = 9.0
    beside: int = 3
    near: int = 10


_LIMITS = EndLimits()


def jumping_ends(trajectory: CameraTrajectory) -> BoolArray:
    """(N,) mask of frames that lie beyond a jump near the beginning or the end of a video."""
    t_s, out = trajectory.t_s, np.zeros(len(trajectory), dtype=np.bool_)
    span_s = float(t_s[-1] - t_s[0])
    if len(t_s) < 4 * _LIMITS.near or np.median(np.diff(t_s)) > _LIMITS.dense_s:
        return out
    if span_s < _LIMITS.times * _LIMITS.most_s:
        return out
    at = np.flatnonzero(find_jumps(t_s, trajectory.cam_in_world))
    late = at[t_s[at] >= t_s[-1] - _LIMITS.most_s]
    early = at[t_s[at + 1] <= t_s[0] + _LIMITS.most_s]
    if len(late):
        out[late[0] + 1 :] = True
    if len(early):
        out[: early[-1] + 1] = True
    return out


def find_jumps(t_s: Array, centre: Array) -> BoolArray:
    """(N - 1,) which steps between frames (N,), (N, 3) are far from what those around them are.

    As :func:`_setup.find_breaks`, but for frames, and right up to the ends: there, those on one side count.
    """
    dt_s = np.diff(t_s)
    velocity = np.diff(centre, axis=0) / dt_s[:, None]
    around = _stack_neighbours(velocity, _LIMITS.beside)
    around[_LIMITS.beside] = np.nan
    surprise = np.linalg.norm(velocity - np.nanmedian(around, axis=0), axis=1) * dt_s
    nearby = np.nanmedian(_stack_neighbours(surprise[:, None], _LIMITS.near)[:, :, 0], axis=0)
    return np.asarray(surprise > _LIMITS.jump * np.maximum(nearby, np.median(surprise)))


def _stack_neighbours(values: Array, reach: int) -> Array:
    """(2 reach + 1, N, q) the rows (N, q) and those around them; not a number beyond the ends."""
    padded = np.pad(values, ((reach, reach), (0, 0)), constant_values=np.nan)
    return np.stack([padded[k : k + len(values)] for k in range(2 * reach + 1)])
