"""Motion of a camera in a hand: smooth functions of time with exact derivatives.

A :class:`Motion` is a quintic spline with uniform knots through camera positions and (unnormalised) quaternions, so
position, velocity, acceleration, orientation, angular velocity and angular acceleration are closed-form functions of
time that belong to one another exactly. The band-limited part of the motion has the spectra measured in
motion-capture recordings of people who carried a camera through a room (the constants below).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Array, IndexArray
from colmap_inertial.core.geometry import quat_exp, quat_from_matrix, quat_multiply, quat_normalize

MotionKind = Literal["orbit", "walk", "roam", "constant_velocity", "pure_rotation", "static"]

Spectrum = tuple[float, ...]
#: Lowest and highest corner of a room.
Walls = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, kw_only=True)
class HandheldSpectra:
    """One-sided power spectral densities of handheld motion, and the band that is simulated.

    The densities are the mean of the motion-capture ground truth of TUM-VI room1, room3 and room5 (Schubert et al.
    2018, CC BY 4.0), after subtracting the capture system's noise floor (0.1 mm and 1 mrad per sample at 120 Hz).
    ``scripts/studies/compare_motion.py`` recomputes and compares them.
    """

    frequency_hz: Spectrum = (0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0)
    """Where the densities hold."""
    horizontal_m2_s2_hz: Spectrum = (
        *(0.18, 3.3, 0.63, 0.76, 0.33, 0.115, 0.0122, 3.3e-3, 3.9e-4, 7.3e-5, 1.5e-5, 5.6e-6, 2.7e-6, 1.7e-6),
    )
    """Velocity of the camera along each horizontal axis of the world."""
    vertical_m2_s2_hz: Spectrum = (
        *(3.4e-3, 6.4e-3, 0.017, 0.092, 0.45, 0.38, 0.045, 8.3e-3, 7.6e-4, 1.6e-4, 2.3e-5, 4.7e-6, 2.1e-6, 1.8e-6),
    )
    """Velocity of the camera along the world's vertical axis."""
    rotation_rad2_s2_hz: Spectrum = (
        *(0.79, 0.38, 0.38, 1.18, 1.43, 0.74, 0.26, 0.096, 0.024, 8.1e-3, 2.0e-3, 5.4e-4, 2.4e-4, 1.35e-4),
    )
    """Angular velocity, mean of the three body axes."""
    band_limit_hz: float = 15.0
    """Nothing moves above this; well below half the knot rate."""
    knot_rate_hz: float = 60.0
    """Of the spline."""


HANDHELD = HandheldSpectra()
#: The motion continues this long before time 0 and after the duration, for an IMU that outlasts the video.
MARGIN_S = 3.0
#: How far a walk in a room keeps from the walls, without the hand; the hand then reaches less far.
_CLEARANCE_M, _REACH_M = 0.6, 0.5
#: Nobody walks in a smaller circle.
_SMALLEST_CIRCLE_M = 0.4

# value of the six quintic B-splines over one knot interval as polynomials: row = power of the fraction, column = spline
_QUINTIC = (
    np.array(
        [
            [1, 26, 66, 26, 1, 0],
            [-5, -50, 0, 50, 5, 0],
            [10, 20, -60, 20, 10, 0],
            [-10, 20, 0, -20, 10, 0],
            [5, -20, 30, -20, 5, 0],
            [-1, 5, -10, 10, -5, 1],
        ],
        dtype=np.float64,
    )
    / 120
)


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """Kind, duration and intensity of a motion."""

    kind: MotionKind = "orbit"
    """orbit: around a subject at the origin, looking at it; walk: forwards, with a gait, in a circle to the left where
    the room is too small to go straight on; roam: about a room, spectrum as measured at all frequencies;
    constant_velocity: straight, hand rotation only; pure_rotation: about the optical centre; static: a tripod."""
    duration_s: float = 60.0
    """Length of the camera's recording."""
    vigour: float = 1.0
    """Factor on the hand's positions and rotations; 1 is as measured (lively: 0.5 m/s and 1 rad/s rms)."""
    speed_m_s: float = 0.8
    """Speed of walk and constant_velocity."""
    radius_m: float = 1.2
    """Horizontal distance from the subject, for orbit."""
    height_m: float = 0.5
    """Height above the subject, for orbit."""
    arc_deg: float = 150.0
    """Azimuth swept by orbit."""
    sweep_s: float = 20.0
    """Time for one sweep of the arc, forth or back."""
    heading_deg: float | None = None
    """Azimuth of the direction of motion; for orbit, of the middle of the arc. Drawn by default."""
    look_deg: float = 0.0
    """Direction of view, to the left of the direction of motion; orbit looks at its subject."""
    start_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the camera at time 0, without the hand's motion; for orbit, of the subject."""

    def __post_init__(self) -> None:
        for name in ("duration_s", "radius_m", "sweep_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive")
        if self.vigour < 0:
            raise ValueError("vigour must not be negative")


@dataclass(frozen=True, eq=False, kw_only=True)
class Kinematics:
    """The state of the camera at N instants. World: metres, z up.

    Attributes
    ----------
    cam_in_world_m, velocity_in_world_m_s, accel_in_world_m_s2
        (N, 3) of the optical centre; without gravity.
    world_from_cam_xyzw
        (N, 4).
    rate_in_cam_rad_s, rate_dot_in_cam_rad_s2
        (N, 3) angular velocity and its derivative, in the camera frame:
        ``d/dt world_from_cam = world_from_cam [rate]x``.
    """

    t_s: Array
    cam_in_world_m: Array
    velocity_in_world_m_s: Array
    accel_in_world_m_s2: Array
    world_from_cam_xyzw: Array
    rate_in_cam_rad_s: Array
    rate_dot_in_cam_rad_s2: Array


class Motion:
    """A camera's path as a function of time; see the module's docstring.

    Parameters
    ----------
    start_s
        Time of the first sample.
    step_s
        Spacing of the samples.
    cam_in_world_m
        (K, 3) camera centres that the spline passes through.
    world_from_cam_xyzw
        (K, 4) orientations that the spline passes through (neighbours less than half a turn apart).
    """

    def __init__(self, *, start_s: float, step_s: float, cam_in_world_m: Array, world_from_cam_xyzw: Array) -> None:
        from scipy.ndimage import spline_filter1d

        q = np.array(quat_normalize(world_from_cam_xyzw))
        # q and -q are one rotation: take the sign that continues the track
        q[1:] *= np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0))[:, None]
        samples = np.concatenate([cam_in_world_m, q], axis=1)
        if len(samples) < 12 or not np.isfinite(samples).all():
            raise ValueError("a motion needs at least 12 finite samples")
        knots = spline_filter1d(samples, order=5, axis=0, mode="mirror", output=np.float64)
        windows = np.lib.stride_tricks.sliding_window_view(knots, 6, axis=0)
        polynomials = np.einsum("pk,ick->pic", _QUINTIC, windows)
        self._position, self._quaternion = polynomials[..., :3].copy(), polynomials[..., 3:].copy()
        self._step_s = step_s
        # the first complete window belongs to the interval that starts at the third sample
        self._first_s = start_s + 2 * step_s
        self.start_s, self.end_s = self._first_s, self._first_s + len(windows) * step_s

    def _locate(self, t_s: Array) -> tuple[IndexArray, Array]:
        t = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        if t.ndim != 1:
            raise ValueError("times must be a scalar or one-dimensional")
        if len(t) and not (t.min() >= self.start_s - 1e-9 and t.max() <= self.end_s + 1e-9):
            raise ValueError(f"times must lie between {self.start_s:.3f} and {self.end_s:.3f} s")
        u = (t - self._first_s) / self._step_s
        index = np.clip(np.floor(u).astype(np.intp), 0, self._position.shape[1] - 1)
        return index, u - index

    def _evaluate(self, polynomials: Array, index: IndexArray, fraction: Array, order: int) -> Array:
        """The ``order``-th derivative of the piecewise polynomials."""
        f = fraction[:, None]
        factors = [float(np.prod(np.arange(p - order + 1, p + 1))) for p in range(6)]
        out = factors[5] * polynomials[5][index]
        for power in range(4, order - 1, -1):
            out = out * f + factors[power] * polynomials[power][index]
        return np.asarray(out / self._step_s**order)

    def cam_in_world_m(self, t_s: Array) -> Array:
        """(N, 3) camera centres at (N,) times."""
        return self._evaluate(self._position, *self._locate(t_s), 0)

    def world_from_cam_xyzw(self, t_s: Array) -> Array:
        """(N, 4) orientations at (N,) times."""
        u = self._evaluate(self._quaternion, *self._locate(t_s), 0)
        return np.asarray(u / np.linalg.norm(u, axis=1, keepdims=True))

    def rate_in_cam_rad_s(self, t_s: Array) -> Array:
        """(N, 3) angular velocity in the camera frame at (N,) times."""
        index, fraction = self._locate(t_s)
        u = self._evaluate(self._quaternion, index, fraction, 0)
        du = self._evaluate(self._quaternion, index, fraction, 1)
        return 2 * _conjugate_product_vector(u, du) / np.sum(u * u, axis=1, keepdims=True)

    def at(self, t_s: Array) -> Kinematics:
        """Everything at (N,) times."""
        index, fraction = self._locate(t_s)
        position, velocity, accel = (self._evaluate(self._position, index, fraction, k) for k in range(3))
        u, du, ddu = (self._evaluate(self._quaternion, index, fraction, k) for k in range(3))
        # With q = u / |u|: q* q' = u* u' / |u|^2 up to its real part, which vanishes for the normalised track.
        square = np.sum(u * u, axis=1, keepdims=True)
        rate = 2 * _conjugate_product_vector(u, du) / square
        rate_dot = 2 * _conjugate_product_vector(u, ddu) / square
        rate_dot -= 2 * np.sum(u * du, axis=1, keepdims=True) / square * rate
        return Kinematics(
            t_s=np.atleast_1d(np.asarray(t_s, dtype=np.float64)),
            cam_in_world_m=position,
            velocity_in_world_m_s=velocity,
            accel_in_world_m_s2=accel,
            world_from_cam_xyzw=u / np.sqrt(square),
            rate_in_cam_rad_s=rate,
            rate_dot_in_cam_rad_s2=rate_dot,
        )


def _conjugate_product_vector(a: Array, b: Array) -> Array:
    """Vector part of ``conj(a) * b`` (quaternions xyzw), written out because ``np.cross`` is slow."""
    ax, ay, az, aw = a.T
    bx, by, bz, bw = b.T
    return np.stack(
        [
            aw * bx - bw * ax - ay * bz + az * by,
            aw * by - bw * ay - az * bx + ax * bz,
            aw * bz - bw * az - ax * by + ay * bx,
        ],
        axis=1,
    )


def _random_process(density: Spectrum, low_hz: float, high_hz: float, n: int, rng: np.random.Generator) -> Array:
    """(n, 1) samples at the knot rate of the integral of a Gaussian process with this one-sided density."""
    from scipy.fft import irfft, next_fast_len, rfftfreq

    size = next_fast_len(n + int(HANDHELD.knot_rate_hz), real=True)
    frequency = rfftfreq(size, 1 / HANDHELD.knot_rate_hz)
    inside = (frequency >= max(low_hz, frequency[1])) & (frequency < high_hz)
    f = frequency[inside]
    measured_hz, limit_hz = HANDHELD.frequency_hz, HANDHELD.band_limit_hz
    level = np.exp(np.interp(np.log(f), np.log(measured_hz), np.log(density)))
    taper = np.clip((limit_hz - f) / (limit_hz - measured_hz[-1]), 0, 1)
    # cosine and sine of a bin of width df each have variance S df, so that together they carry the power S df
    sigma = np.sqrt(level * taper * frequency[1])
    spectrum = np.zeros(len(frequency), dtype=np.complex128)
    noise = rng.standard_normal((2, len(f)))
    spectrum[inside] = size / 2 * sigma * (noise[0] + 1j * noise[1]) / (2j * np.pi * f)
    return np.asarray(irfft(spectrum, size)[:n, None])


def _draw_hand(n: int, rng: np.random.Generator, *, low_hz: float, vigour: float) -> tuple[Array, Array]:
    """Position (m, world) and rotation vector (rad, camera) of the hand, (n, 3) each."""
    axes = (HANDHELD.horizontal_m2_s2_hz, HANDHELD.horizontal_m2_s2_hz, HANDHELD.vertical_m2_s2_hz)
    position = [_random_process(density, low_hz, HANDHELD.band_limit_hz, n, rng) for density in axes]
    low_hz = max(low_hz, 0.2)
    rotation = [_random_process(HANDHELD.rotation_rad2_s2_hz, low_hz, HANDHELD.band_limit_hz, n, rng) for _ in range(3)]
    return vigour * np.concatenate(position, axis=1), vigour * np.concatenate(rotation, axis=1)


def _orient_along(direction: Array) -> Array:
    """(N, 4) world_from_cam of a level camera (x right, y down, z forward) that looks along (N, 3) directions."""
    forward = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    right = np.stack([forward[:, 1], -forward[:, 0], np.zeros(len(forward))], axis=1)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return quat_from_matrix(np.stack([right, np.cross(forward, right), forward], axis=-1))


def _along_and_side(azimuth: NDArray[np.floating[Any]] | float) -> tuple[Array, Array]:
    """(..., 3) horizontal directions of (...) azimuths, and those to their left."""
    cos, sin, level = np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)
    return np.stack([cos, sin, level], axis=-1), np.stack([-sin, cos, level], axis=-1)


def _circle_within(walls_m: Walls, options: MotionOptions, along: Array, side: Array) -> float | None:
    """Radius of the largest circle to the left that a walk fits into; ``None`` where it can, or must, go straight.

    The circle's centre is ``start + radius * side``, so that its ends along each horizontal axis are linear in radius.
    """
    along, side = along[:2], side[:2]
    start = np.array(options.start_m)[:2]
    low, high = (np.array(corner)[:2] for corner in walls_m)
    low, high = low + _CLEARANCE_M, high - _CLEARANCE_M
    end = start + options.speed_m_s * options.duration_s * along
    if np.all((low <= [start, end]) & ([start, end] <= high)):
        return None
    with np.errstate(divide="ignore", invalid="ignore"):  # a wall to the side, which the circle only leaves
        radius_m = float(np.nanmin([(high - start) / (1 + side), (start - low) / (1 - side)]))
    return radius_m if radius_m >= _SMALLEST_CIRCLE_M else None


def make_motion(options: MotionOptions, rng: np.random.Generator, walls_m: Walls | None = None) -> Motion:
    """Draw a motion. It is defined from ``-MARGIN_S`` to ``duration_s + MARGIN_S``.

    The world's z axis points up; ``orbit`` circles its start, the others begin near it.

    Parameters
    ----------
    walls_m
        Lowest and highest corner of the room, in which a walk is to stay.
    """
    step_s = 1 / HANDHELD.knot_rate_hz
    guard = 16  # samples beyond the margin, where the spline's boundary condition has an effect
    n = int(np.ceil((options.duration_s + 2 * MARGIN_S) * HANDHELD.knot_rate_hz)) + 2 * guard + 1
    start_s = -MARGIN_S - guard * step_s
    t = start_s + step_s * np.arange(n)
    heading = rng.uniform(0, 2 * np.pi)
    if options.heading_deg is not None:
        heading = np.deg2rad(options.heading_deg)
    along, side = _along_and_side(heading)
    position = np.zeros((n, 3))
    low_hz = {"orbit": 0.5, "walk": 0.35}.get(options.kind, HANDHELD.frequency_hz[0])
    shake, turn = _draw_hand(n, rng, low_hz=low_hz, vigour=options.vigour)
    if options.kind == "orbit":
        phase = np.pi * t / options.sweep_s
        azimuth = heading - np.deg2rad(options.arc_deg) / 2 * np.cos(phase)
        height = options.height_m * (1 + 0.2 * np.sin(1.7 * phase))
        radius = options.radius_m * (1 + 0.1 * np.sin(2.3 * phase))
        position = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)
        reach = 0.4 * options.radius_m  # the hand's deliberate swings must not reach the subject
        position = position + reach * np.tanh(shake / reach)
        looking = _orient_along(-position)
    else:
        radius_m, azimuth = None, np.full(1, heading)
        if options.kind == "walk" and walls_m is not None:
            shake = _REACH_M * np.tanh(shake / _REACH_M)
            radius_m = _circle_within(walls_m, options, along, side)
        if radius_m is not None:
            azimuth = heading + options.speed_m_s / radius_m * t
            centre, (_, side) = radius_m * side, _along_and_side(azimuth)
            position = centre - radius_m * side
        elif options.kind in ("walk", "constant_velocity"):
            position = position + options.speed_m_s * t[:, None] * along
        look, _ = _along_and_side(azimuth + np.deg2rad(options.look_deg))
        looking = np.broadcast_to(_orient_along(look), (n, 4))
        if options.kind == "walk":
            step_hz = rng.uniform(1.7, 2.1)
            bob = rng.uniform(0.01, 0.02, size=2)
            position = position + bob[0] * np.cos(2 * np.pi * step_hz * t)[:, None] * np.array([0.0, 0.0, 1.0])
            position = position + bob[1] * np.sin(np.pi * step_hz * t)[:, None] * side
        if options.kind == "roam":
            yaw = options.vigour * _random_process(HANDHELD.rotation_rad2_s2_hz, 0.0, 0.2, n, rng)
            looking = quat_multiply(quat_exp(yaw * np.array([0.0, 0.0, 1.0])), looking)
        if options.kind in ("walk", "roam"):
            position = position + shake
    if options.kind == "static":
        turn = np.zeros_like(turn)
    return Motion(
        start_s=start_s,
        step_s=step_s,
        cam_in_world_m=position + np.array(options.start_m),
        world_from_cam_xyzw=quat_multiply(looking, quat_exp(turn)),
    )
