"""Orbits around a desk with the hand of a recording in place of the simulator's, for ``benchmarks.path --colmap``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from colmap_inertial.core.arrays import Array
from colmap_inertial.tools.simulate import Motion, MotionOptions, make_motion
from colmap_inertial.tools.simulate.motion import MARGIN_S
from scripts.common.turning_world import BODY_FROM_CAM, Turning
from scripts.restoration.handheld import Handheld, recorded

#: Slower than this a hand follows its subject, which the orbit does already; the simulator's begins there, too.
_HAND_FROM_HZ = 0.5
_SLOW_S = float(np.sqrt(np.log(2)) / (2 * np.pi * _HAND_FROM_HZ))
#: Samples of a motion, and how many lie beyond its margins, where the spline's boundary condition has an effect.
_STEP_S, _GUARD = 1 / 60, 16
#: Stretches in which a hand holds stiller would need exposures beyond 80 ms for 20 px: root of the mean square of its
#: swings' rate.
_LEAST_RAD_S = 0.45
#: As in the simulator: the hand's swings must not reach the subject, as a share of the distance.
_REACH = 0.4


def hands(folder: Path, name: str, duration_s: float) -> list[Handheld]:
    """Stretches of a recording, none over another, that last for an orbit and its margins; in which the hand swings."""
    wanted_s = duration_s + 2 * (MARGIN_S + (_GUARD + 1) * _STEP_S)
    out = []
    for piece in recorded(folder, name):
        for k in range(int((piece.t_s[-1] - piece.t_s[0]) / wanted_s)):
            begin_s = piece.t_s[0] + k * wanted_s
            inside = (piece.t_s >= begin_s) & (piece.t_s <= begin_s + wanted_s)
            hand = Handheld(
                t_s=piece.t_s[inside] - begin_s,
                rate_rad_s=piece.rate_rad_s[inside],
                velocity_m_s=piece.velocity_m_s[inside],
            )
            turn, _ = swings(hand, np.arange(0.0, wanted_s, _STEP_S))
            filmed = turn[len(turn) // 2 - round(0.5 * duration_s / _STEP_S) :][: round(duration_s / _STEP_S)]
            if np.sqrt((np.diff(filmed, axis=0) ** 2).sum(axis=1).mean()) / _STEP_S > _LEAST_RAD_S:
                out.append(hand)
    if not out:
        raise SystemExit(f"{folder} holds no {wanted_s:.0f} s of {name} without a gap in which a hand swings")
    return out


def orbit(options: MotionOptions, rng: np.random.Generator, hand: Handheld) -> Motion:
    """The simulator's orbit, and on it what a hand turned and moved faster than it follows, as recorded."""
    still = make_motion(MotionOptions(**{**vars(options), "vigour": 0.0}), rng)
    start_s = -MARGIN_S - _GUARD * _STEP_S
    count = int(np.ceil((options.duration_s + 2 * MARGIN_S) / _STEP_S)) + 2 * _GUARD + 1
    t_s = start_s + _STEP_S * np.arange(count)
    turn, shift_m = swings(hand, t_s - start_s)
    # the spline of the orbit ends a few samples before its last one
    inside_s = np.clip(t_s, still.start_s, still.end_s)
    looking = Rotation.from_quat(still.world_from_cam_xyzw(inside_s))
    reach_m = _REACH * options.radius_m
    shift_m = reach_m * np.tanh(shift_m / reach_m)
    return Motion(
        start_s=start_s,
        step_s=_STEP_S,
        cam_in_world_m=still.cam_in_world_m(inside_s) + looking.apply(shift_m),
        world_from_cam_xyzw=(looking * Rotation.from_rotvec(turn)).as_quat(),
    )


def swings(hand: Handheld, t_s: Array) -> tuple[Array, Array]:
    """(N, 3) rotation vectors and (N, 3) metres by which a camera in this hand is off its own slow motion, in the axes
    that it would have by that."""
    u, _, vt = np.linalg.svd(BODY_FROM_CAM)
    rate, velocity = hand.rate_rad_s @ (u @ vt), hand.velocity_m_s @ (u @ vt)
    world_from_cam = Turning(t_s=hand.t_s, rate_rad_s=rate).world_from_cam(np.clip(t_s, hand.t_s[0], hand.t_s[-1]))
    turned = Rotation.from_matrix(world_from_cam)
    quats = turned.as_quat()
    quats[1:] *= np.cumprod(np.where((quats[1:] * quats[:-1]).sum(axis=1) < 0, -1.0, 1.0))[:, None]
    sigma = _SLOW_S / float(t_s[1] - t_s[0])
    slow = Rotation.from_quat(gaussian_filter1d(quats, sigma, axis=0))
    moving = turned.apply(np.stack([np.interp(t_s, hand.t_s, v) for v in velocity.T], axis=1))
    place_m = np.cumsum(moving, axis=0) * (t_s[1] - t_s[0])
    place_m -= gaussian_filter1d(place_m, sigma, axis=0)
    return (slow.inv() * turned).as_rotvec(), slow.inv().apply(place_m)
