"""Exact motion blur of picture pieces: which point of a scene every pixel sees at every instant of its exposure.

A piece is a square of a sensor whose rows are exposed one after the other, before a plane that may be slanted. Around
the middle of its exposure the camera has turned by theta(t) and moved by p(t); a pixel with ray r then sees what
``R(theta) r + p / z`` points to. Nothing is linearised but the noncommutativity of rotations within some hundredths of
a radian.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat
from scripts.restoration.handheld import Handheld

#: Instants, evenly over an exposure and the readout of a piece, between which turning and moving are interpolated.
_STEPS = 96
#: Spacing of the pixels for which the mapping is worked out; between them it is bilinear, to 0.01 px.
_NODE_PX = 8
_LEAST_STRETCH = 0.2
#: Motion is known for so much longer before and after, s: for clocks that are wrong.
_SPARE_S = 0.025


@dataclass(frozen=True, eq=False, kw_only=True)
class Shots:
    """B pieces of sensors, each with its motion around the middle of its exposure; tensors on one device.

    Attributes
    ----------
    side
        Of the pieces, px.
    t_s
        (B, T) instants, evenly spaced from the first on.
    turn_rad, moved_m
        (B, T, 3) of the camera since the middle.
    exposure_s
        (B,) of every row.
    row_s
        (B,) from one row to the next.
    focal_px
        (B,)
    corner_px
        (B, 2) of the piece, from the principal point.
    nearness
        (B, 3) inverse depth, 1/m: at the middle, and its change from there to the right and the lower edge.
    """

    side: int
    t_s: Tensor
    turn_rad: Tensor
    moved_m: Tensor
    exposure_s: Tensor
    row_s: Tensor
    focal_px: Tensor
    corner_px: Tensor
    nearness: Tensor

    def turned(self, t_s: Tensor) -> Tensor:
        """(B, h, 3) turning since the middle at (B, h) instants."""
        return self._between(self.turn_rad, t_s)

    def seen(self, x: Tensor, y: Tensor, part: float) -> Tensor:
        """(B, h, w, 2) where on the scene (w,) columns of (h,) rows look, px of a camera at rest.

        ``part`` is the instant within each row's exposure, from -1/2 to 1/2.
        """
        t = (y - 0.5 * self.side) * self.row_s[:, None] + part * self.exposure_s[:, None]
        turn, moved = self._between(self.turn_rad, t), self._between(self.moved_m, t)
        ray = torch.stack(torch.broadcast_tensors(*self._angles(x, y)), dim=-1)
        unit = torch.ones_like(ray[..., :1])
        ray = torch.cat([ray, unit], dim=-1)
        rotation = _rotation(turn)
        seen = torch.einsum("byij,byxj->byxi", rotation, ray)
        u, v = (x / self.side - 0.5)[None, None, :], (y / self.side - 0.5)[None, :, None]
        near = self.nearness
        nearness = near[:, 0, None, None] + near[:, 1, None, None] * 2 * u + near[:, 2, None, None] * 2 * v
        seen = seen + moved[:, :, None, :] * nearness[..., None]
        at = self.focal_px[:, None, None, None] * seen[..., :2] / seen[..., 2:]
        return at - self.corner_px[:, None, None, :]

    def path(self, x: Tensor, y: Tensor, parts: Sequence[float]) -> Tensor:
        """(S, B, h, w, 2) where, in the sharp picture, that stands which pixels see at parts of their exposure; px off.

        To first order in how far that is.
        """
        middle = self.seen(x, y, 0.0)
        # how the picture at mid-exposure follows from the scene, for pixels one to the right and one below
        by_x, by_y = self.seen(x + 1, y, 0.0) - middle, self.seen(x, y + 1, 0.0) - middle
        # a picture that moves with the shutter would be blurred without end
        across = (by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0]).clamp_min(_LEAST_STRETCH)
        out = []
        for part in parts:
            along = self.seen(x, y, part) - middle
            out_x = (along[..., 0] * by_y[..., 1] - along[..., 1] * by_y[..., 0]) / across
            out_y = (along[..., 1] * by_x[..., 0] - along[..., 0] * by_x[..., 1]) / across
            out.append(torch.stack([out_x, out_y], dim=-1))
        return torch.stack(out)

    def blur(self, x: Tensor, y: Tensor) -> Tensor:
        """(B, h, w, 2) the segment that pixels smear along, px."""
        begin, end = self.path(x, y, (-0.5, 0.5))
        return end - begin

    def render(self, scene: Tensor, samples: int, shift_px: Tensor | None = None) -> Tensor:
        """(B, 3, side, side) light of the pieces: the mean over their exposure; one sample is a picture without blur.

        Parameters
        ----------
        scene
            (B, 3, S, S) light, its middle on the middle of the piece.
        shift_px
            (B, 2) by which the scene lies elsewhere.
        """
        nodes = torch.arange(self.side // _NODE_PX + 1, device=scene.device) * float(_NODE_PX) + 0.5
        between = _spread(self.side, len(nodes), scene.device)
        total = torch.zeros(scene.shape[0], 3, self.side, self.side, device=scene.device)
        size = scene.shape[-1]
        for k in range(samples):
            seen = self.seen(nodes, nodes, (k + 0.5) / samples - 0.5)
            if shift_px is not None:
                seen = seen + shift_px[:, None, None, :]
            grid = between @ ((seen - 0.5 * self.side) * (2 / size)).flatten(2)
            grid = between @ grid.unflatten(2, (-1, 2))
            total += functional.grid_sample(
                scene, grid, mode="bilinear", padding_mode="reflection", align_corners=False
            )
        return total / samples

    def _angles(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        u = (x[None, None, :] + self.corner_px[:, 0, None, None]) / self.focal_px[:, None, None]
        v = (y[None, :, None] + self.corner_px[:, 1, None, None]) / self.focal_px[:, None, None]
        return u, v

    def _between(self, values: Tensor, t_s: Tensor) -> Tensor:
        """(B, h, 3) of (B, T, 3) at (B, h) instants, linear."""
        step = self.t_s[:, 1:2] - self.t_s[:, :1]
        at = ((t_s - self.t_s[:, :1]) / step).clamp(0, self.t_s.shape[1] - 1.001)
        low = at.floor().long()
        part = (at - low)[..., None]
        picked = [torch.gather(values, 1, i[..., None].expand(-1, -1, 3)) for i in (low, low + 1)]
        return picked[0] * (1 - part) + picked[1] * part


def _spread(side: int, nodes: int, device: torch.device) -> Tensor:
    """(side, nodes) weights of the nodes for each pixel."""
    at = torch.arange(side, device=device)[:, None] / _NODE_PX
    return (1 - (at - torch.arange(nodes, device=device)[None]).abs()).clamp_min(0)


def _rotation(vector: Tensor) -> Tensor:
    """(..., 3, 3) by rotation vectors, exact."""
    x, y, z = vector.unbind(-1)
    none = torch.zeros_like(x)
    skew = torch.stack([none, -z, y, z, none, -x, -y, x, none], dim=-1).reshape(*vector.shape[:-1], 3, 3)
    square = (vector * vector).sum(-1)[..., None, None]
    # series of sin(a)/a and (1 - cos a)/a^2; angles here are below 0.3
    first = 1 - square / 6 + square * square / 120
    second = 0.5 - square / 24 + square * square / 720
    return torch.eye(3, device=vector.device) + first * skew + second * (skew @ skew)


@dataclass(frozen=True, kw_only=True)
class ShotOptions:
    """What is drawn."""

    side: int = 256
    #: Exposures, s, uniform in their logarithm.
    exposure_s: tuple[float, float] = (4e-3, 6.6e-2)
    #: Sensor widths, px, whose focal lengths are 0.6 to 1.1 of them.
    widths: tuple[int, ...] = (640, 960, 1280, 1920, 2560, 3840)
    longest_readout_s: float = 0.033


def draw_shots(
    motions: list[Handheld],
    blur_px: Array,
    rng: np.random.Generator,
    options: ShotOptions,
    device: str,
    *,
    exposure_s: Array | None = None,
) -> Shots:
    """One shot for each wanted length of blur, px at the middle of the piece.

    The motion is any part of any recording, in any direction, made livelier or calmer until its blur fits.
    """
    side, count = options.side, len(blur_px)
    out: dict[str, list[Array]] = {
        key: [] for key in ("t", "turn", "moved", "exposure", "row", "focal", "corner", "near")
    }
    lengths = np.array([m.t_s[-1] - m.t_s[0] for m in motions])
    for i in range(count):
        width = int(rng.choice([w for w in options.widths if w >= 2 * side] or [2 * side]))
        height = max(9 * width // 16, side)
        focal = rng.uniform(0.6, 1.1) * width
        corner = rng.uniform(0, [width - side, height - side]) - 0.5 * np.array([width, height])
        readout_s = 0.0 if rng.random() < 0.2 else rng.uniform(0.005, options.longest_readout_s)
        row_s = readout_s / height
        exposure = exposure_s[i] if exposure_s is not None else np.exp(rng.uniform(*np.log(options.exposure_s)))
        half_s = 0.5 * exposure + 0.5 * side * row_s + _SPARE_S
        distance = np.exp(rng.uniform(np.log(0.7), np.log(12)))
        near = np.array([1.0, rng.normal(0, 0.15), rng.normal(0, 0.15)]) / distance
        t = np.linspace(-half_s, half_s, _STEPS)
        axes = matrix_from_quat(_random_quat(rng))
        best: tuple[float, Array, Array] | None = None
        for _ in range(6):
            motion = motions[rng.choice(len(motions), p=lengths / lengths.sum())]
            middle = rng.uniform(motion.t_s[0] + half_s, motion.t_s[-1] - half_s)
            rate, velocity = (values @ axes.T for values in motion.at(middle + t))
            speed = _speed_px_s(rate[_STEPS // 2], velocity[_STEPS // 2], focal, corner + 0.5 * side, near[0])
            factor = blur_px[i] / max(speed * exposure, 1e-6)
            if best is None or abs(np.log(factor)) < abs(np.log(best[0])):
                best = factor, rate, velocity
        assert best is not None
        factor, rate, velocity = best
        step = t[1] - t[0]
        for key, values in (("turn", rate), ("moved", velocity)):
            path = np.cumsum(0.5 * (values[1:] + values[:-1]) * step, axis=0) * factor
            path = np.vstack([np.zeros(3), path])
            out[key].append(path - 0.5 * (path[_STEPS // 2 - 1] + path[_STEPS // 2]))
        for key, value in (
            ("t", t),
            ("exposure", exposure),
            ("row", row_s),
            ("focal", focal),
            ("corner", corner),
            ("near", near),
        ):
            out[key].append(np.asarray(value))
    tensors = {key: torch.tensor(np.stack(values), dtype=torch.float32, device=device) for key, values in out.items()}
    return Shots(
        side=side,
        t_s=tensors["t"],
        turn_rad=tensors["turn"],
        moved_m=tensors["moved"],
        exposure_s=tensors["exposure"],
        row_s=tensors["row"],
        focal_px=tensors["focal"],
        corner_px=tensors["corner"],
        nearness=tensors["near"],
    )


def _speed_px_s(rate: Array, velocity: Array, focal_px: float, at_px: Array, nearness: float) -> float:
    """How fast the picture moves at a point, px from the principal point."""
    x, y = at_px / focal_px
    v = velocity * nearness
    ray = np.array([x, y, 1.0])
    seen = np.cross(rate, ray) + v
    return float(focal_px * np.hypot(seen[0] - x * seen[2], seen[1] - y * seen[2]))


def _random_quat(rng: np.random.Generator) -> Array:
    q = rng.standard_normal(4)
    return q / np.linalg.norm(q)
