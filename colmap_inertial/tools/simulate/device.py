"""What a phone with a depth sensor computes beside its video: a path of its own in metres, and depth maps.

Errors of the logarithm of lengths, for the accelerometer's gain ``g`` and what one filter puts into both, ``f``::

    path:   g + f + p + walk(t),      depth: f + d

``p`` and ``d`` are drawn once for a recording. Depth maps have noise that neighbouring pixels share, values between
both surfaces at edges, and an end of their range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.tools.simulate.motion import Motion
from colmap_inertial.tools.simulate.recording import SfmOptions, perturb_poses

#: Confidence as ARKit counts it.
LOW, MEDIUM, HIGH = 0, 1, 2
#: Pixels of which one neighbour is farther than the other by this factor lie on an edge.
_EDGE = 1.05


@dataclass(frozen=True, kw_only=True)
class DeviceOptions:
    """A kind of device: how well it knows its path and the depth of surfaces.

    Names ending in ``_sd`` are standard deviations of zero-mean normal draws, those of scales of the logarithm.
    """

    path_scale_sd: float = 0.02
    """Scale of the path at the start."""
    path_scale_walk_rts: float = 0.003
    """Random walk of the logarithm of the path's scale, per root second."""
    path_drift_m_rts: float = 0.003
    """Random walk of the path's position, each axis, per root second."""
    path_noise_m: float = 0.001
    """White noise of each coordinate of the path; a noise of as much again is correlated over a third of a second."""
    path_turn_rad: float = 0.0005
    """The same of its rotations."""
    depth_scale_sd: float = 0.01
    """Scale of all depth maps of a recording."""
    depth_noise: float = 0.004
    """Noise of depth, relative to it."""
    depth_noise_px: float = 3.0
    """Noise of pixels that are nearer than this is alike."""
    depth_range_m: tuple[float, float] = (0.2, 5.0)
    """Nearest and farthest depth; what is out of it reads as its end, with low confidence."""
    edge_seen: float = 0.8
    """Share of pixels at edges whose confidence is not the highest."""
    fusion_sd: float = 0.005
    """Scale error that path and depth share, as one filter makes both."""

    def __post_init__(self) -> None:
        if any(np.min(value) < 0 for value in vars(self).values()):
            raise ValueError("errors and ranges of a device must not be negative")
        if not (self.depth_range_m[0] < self.depth_range_m[1] and self.edge_seen <= 1 and self.depth_noise_px > 0):
            raise ValueError("depth_range_m must grow, edge_seen not exceed 1, depth_noise_px be positive")


@dataclass(frozen=True, kw_only=True)
class DeviceErrors:
    """One device on one day: logarithms of its lengths over true ones.

    Attributes
    ----------
    path_log
        Of its path at the start.
    depth_log
        Of its depth maps.
    """

    path_log: float
    depth_log: float


def draw_device_errors(options: DeviceOptions, accel_gain: float, rng: np.random.Generator) -> DeviceErrors:
    """Draw the device of a recording.

    Parameters
    ----------
    accel_gain
        How much too long its accelerometer reads, as logarithm: the path is as much too long.
    """
    fusion, path, depth = rng.standard_normal(3) * (options.fusion_sd, options.path_scale_sd, options.depth_scale_sd)
    return DeviceErrors(path_log=float(accel_gain + fusion + path), depth_log=float(fusion + depth))


def compute_path(
    motion: Motion, t_s: Array, options: DeviceOptions, errors: DeviceErrors, rng: np.random.Generator
) -> tuple[Array, Array]:
    """(N, 4) world_from_cam_xyzw and (N, 3) centres, in the device's metres, as it computes them at (N,) even times."""
    noise = SfmOptions(
        frame_rate_hz=(len(t_s) - 1) / float(t_s[-1] - t_s[0]),
        position_white_m=options.path_noise_m,
        position_correlated_m=options.path_noise_m,
        rotation_white_rad=options.path_turn_rad,
        rotation_correlated_rad=options.path_turn_rad,
        position_drift_m_rts=options.path_drift_m_rts,
        scale_drift_rts=options.path_scale_walk_rts,
    )
    xyzw, centres = perturb_poses(motion, t_s, noise, rng)
    return xyzw, np.exp(errors.path_log) * centres


def measure_depth(
    true_m: Array, options: DeviceOptions, errors: DeviceErrors, rng: np.random.Generator
) -> tuple[Array, UInt8Array]:
    """(H, W) depth in metres that the sensor gives, and its confidence.

    Parameters
    ----------
    true_m
        (H, W) depth along the optical axis; nan where there is nothing.
    """
    from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

    nearest, farthest = options.depth_range_m
    true_m = np.where(np.isfinite(true_m), true_m, np.inf)
    limited = np.minimum(true_m, farthest)
    # at edges the sensor sees both surfaces, and says something between
    near, far = minimum_filter(limited, 3), maximum_filter(limited, 3)
    edge = far > _EDGE * near
    depth_m = np.where(edge, near + rng.uniform(size=near.shape) * (far - near), limited)
    noise = gaussian_filter(rng.standard_normal(near.shape), options.depth_noise_px, mode="wrap")
    # a filter of this width leaves so much of white noise
    noise *= 2 * np.sqrt(np.pi) * options.depth_noise_px
    depth_m = depth_m * np.exp(errors.depth_log) * (1 + options.depth_noise * noise)
    confidence = np.full(near.shape, HIGH, dtype=np.uint8)
    confidence[edge & (rng.uniform(size=near.shape) < options.edge_seen)] = MEDIUM
    confidence[(true_m >= farthest) | (true_m <= nearest)] = LOW
    return np.clip(depth_m, nearest, farthest), confidence
