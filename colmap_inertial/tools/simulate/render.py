"""Pictures of a :class:`World`, exact in geometry and time: distortion, exposure, rolling shutter, depth.

Every pixel of every sample has its own ray and every line of the image its own pose, so a rolling shutter and motion
blur are not approximated but sampled. A ray meets a flat piece where a homography says: with ``A = [u v c]``, the
piece's unit axes and corner in the camera frame, ``inv(A) (x, y, 1)`` is ``(U, V, 1) / depth``. The nearest hit wins
(z-buffer); colours come from a pyramid of each texture, bilinear. A pixel is the mean of samples spread over its
area and its exposure, in linear light.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Array, BoolArray, Float32Array, IndexArray, Int64Array, UInt8Array
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import CameraModel, ReadoutDirection
from colmap_inertial.model import colmap_camera
from colmap_inertial.tools.simulate.motion import Motion
from colmap_inertial.tools.simulate.world import World


@dataclass(frozen=True, kw_only=True)
class RenderLimits:
    """Sampling of pixels.

    Against 256 samples the error is then about one grey level rms, from no blur to 60 px of it; more only where black
    meets white all over the image.
    """

    near_m: float = 0.02
    """What is nearer is not seen."""
    samples: int = 12
    """Samples of a pixel without blur."""
    samples_per_px: float = 2.5
    """More samples for each pixel of blur."""
    most_samples: int = 128
    """Samples of a pixel at most."""
    chunk_px: int = 16384
    """Pixels whose colours are looked up together: few enough to stay in the processor's cache."""


@dataclass(frozen=True, kw_only=True)
class ShutterCamera:
    """A camera on the moving body: optics, shutter, sensor. The motion describes the body, which may be a camera."""

    model: CameraModel
    """Any COLMAP camera model."""
    exposure_s: float = 0.004
    """Exposure time of every line."""
    readout_s: float = 0.0
    """From the start of the first line's exposure to one past the last; 0 is a global shutter."""
    readout_direction: ReadoutDirection = "down"
    """Direction in which the exposed line moves in the stored image."""
    body_from_cam_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Orientation on the body."""
    cam_in_body_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position on the body."""
    delay_s: float = 0.0
    """Starts exposing this long after the body's first camera."""
    gain: float = 1.0
    """Brightness of the image relative to the world's linear light."""
    white_electrons: float = 8000.0
    """Electrons at full white: shot noise."""
    read_noise_electrons: float = 8.0
    """Noise without light."""

    def line_start_s(self, t_s: float) -> Array:
        """(H,) or (W,) start of exposure of each row (down, up) or column (right, left) of a frame triggered at t."""
        n = self.model.height if self.readout_direction in ("down", "up") else self.model.width
        order = np.arange(n) if self.readout_direction in ("down", "right") else np.arange(n)[::-1]
        return np.asarray(t_s + self.delay_s + self.readout_s * order / n)

    def middle_s(self, t_s: float) -> float:
        """Mid-exposure of the middle line of a frame triggered at ``t_s``."""
        return t_s + self.delay_s + 0.5 * (self.exposure_s + self.readout_s)


class _Atlas:
    """All textures and their pyramids (in steps of the square root of two) in one long list of texels."""

    def __init__(self, world: World) -> None:
        import cv2

        self.levels = 17
        shapes = np.array([_pyramid_shapes(quad.texture, self.levels) for quad in world.quads], dtype=np.int64)
        self.height, self.width = shapes.reshape(-1, 2).T.copy()
        # one more row and column, so that the right and lower neighbours always exist
        sizes = (self.height + 1) * (self.width + 1)
        self.start = np.cumsum(sizes) - sizes
        self.texels = np.empty((int(sizes.sum()), 3), dtype=np.float32)
        for i, quad in enumerate(world.quads):
            pyramid = [quad.texture]
            for level in range(self.levels):
                at = i * self.levels + level
                height, width = int(self.height[at]), int(self.width[at])
                if level:
                    source = pyramid[max(level - 2, 0)]
                    pyramid.append(cv2.resize(source, (width, height), interpolation=cv2.INTER_AREA))
                place = self.texels[self.start[at] : self.start[at] + sizes[at]].reshape(height + 1, width + 1, 3)
                place[:-1, :-1] = pyramid[-1].reshape(height, width, 3)
                place[-1, :-1] = place[-2, :-1]
                place[:, -1] = place[:, -2]
        lengths = [np.linalg.norm(q.edge_u_m) / q.texture.shape[1] for q in world.quads]
        self.texel_m = np.array(lengths, dtype=np.float32)

    def look_up(self, quad: IndexArray, s: Float32Array, t: Float32Array, footprint_m: Float32Array) -> Float32Array:
        """(N, 3) colours at fractions (s, t) of the edges, averaged over about ``footprint_m``."""
        detail = 2 * np.log2(np.maximum(footprint_m / self.texel_m[quad], np.float32(1)))
        level = np.minimum(np.rint(detail).astype(np.int64), self.levels - 1)
        return self._bilinear(quad * self.levels + level, s, t)

    def _bilinear(self, index: Int64Array, s: Float32Array, t: Float32Array) -> Float32Array:
        width, height = self.width[index], self.height[index]
        u = np.clip(s * width - np.float32(0.5), 0, width - 1).astype(np.float32)
        v = np.clip(t * height - np.float32(0.5), 0, height - 1).astype(np.float32)
        u0, v0 = u.astype(np.int64), v.astype(np.int64)
        fu, fv = (u - u0.astype(np.float32))[:, None], (v - v0.astype(np.float32))[:, None]
        top = self.start[index] + v0 * (width + 1) + u0
        bottom = top + width + 1
        take = self.texels.take
        upper, lower = take(top, axis=0), take(bottom, axis=0)
        upper += fu * (take(top + 1, axis=0) - upper)
        lower += fu * (take(bottom + 1, axis=0) - lower)
        upper += fv * (lower - upper)
        return np.asarray(upper)


def _pyramid_shapes(texture: Float32Array, levels: int) -> list[tuple[int, int]]:
    """(height, width) of each level: of the second by the square root of two, of each other by two from two before."""
    shapes = [(texture.shape[0], texture.shape[1])]
    for level in range(1, levels):
        source, ratio = (shapes[-2], 2.0) if level > 1 else (shapes[-1], np.sqrt(2))
        shapes.append((max(1, int(np.ceil(source[0] / ratio))), max(1, int(np.ceil(source[1] / ratio)))))
    return shapes


@cache
def _offsets(samples: int) -> Array:
    """(samples, 2) offsets inside a pixel, within +-0.5, in order of time.

    A Latin hypercube over time and the pixel's two sides: each of ``samples`` slices of each of them is met once.
    Of many drawn, the one that fills the cube most evenly (least centred L2 discrepancy, Hickernell 1998), since any
    correlation between time and offset would shift what moves.
    """
    rng = np.random.default_rng(samples)
    centre = (np.arange(samples) + 0.5) / samples
    best, least = np.zeros((samples, 2)), np.inf
    for _ in range(300):
        cube = np.stack([centre, rng.permutation(centre), rng.permutation(centre)], axis=1) - 0.5
        d = np.abs(cube)
        apart = np.abs(cube[:, None] - cube)
        one = np.prod(1 + d / 2 - d**2 / 2, axis=1).mean()
        two = np.prod(1 + d[:, None] / 2 + d / 2 - apart / 2, axis=2).mean()
        if two - 2 * one < least:
            best, least = cube[:, 1:], two - 2 * one
    return best


class Renderer:
    """Renders one world through any number of cameras.

    Parameters
    ----------
    world
        What to film.
    limits
        How finely pixels are sampled.
    """

    def __init__(self, world: World, limits: RenderLimits = RenderLimits()) -> None:
        self.world, self._limits = world, limits
        self._atlas = _Atlas(world)
        quads = world.quads
        self._corner = np.stack([q.corner_m for q in quads])
        self._size = np.array([[np.linalg.norm(q.edge_u_m), np.linalg.norm(q.edge_v_m)] for q in quads])
        self._u = np.stack([q.edge_u_m for q in quads]) / self._size[:, :1]
        self._v = np.stack([q.edge_v_m for q in quads]) / self._size[:, 1:]
        self._rays: dict[CameraModel, tuple[Array, Array]] = {}

    def linear(self, camera: ShutterCamera, motion: Motion, t_s: float) -> Float32Array:
        """(H, W, 3) light that falls on each pixel during a frame triggered at ``t_s``, before noise."""
        starts = camera.line_start_s(t_s)
        samples = self._samples_needed(camera, motion, t_s)
        total = np.zeros((camera.model.height, camera.model.width, 3), dtype=np.float32)
        for j, offset in enumerate(_offsets(samples)):
            instants = starts + camera.exposure_s * (j + 0.5) / samples
            total += self._sample(camera, motion, instants, offset, samples)
        return total * np.float32(camera.gain / samples)

    def depth_m(self, camera: ShutterCamera, motion: Motion, t_s: float) -> Array:
        """(H, W) depth along the optical axis of what each pixel's centre sees, all lines at the instant ``t_s``."""
        rays, _ = self._rays_of(camera.model)
        _, _, _, inverse = self._trace(camera, motion, np.array([t_s]), rays[..., 0], rays[..., 1])
        return 1 / np.where(inverse > 0, inverse, np.nan)

    def _rays_of(self, model: CameraModel) -> tuple[Array, Array]:
        """(H, W, 2) normalised coordinates of pixel centres; (H, W, 2, 2) their derivative by pixel coordinates."""
        if model not in self._rays:
            camera = colmap_camera(model)
            x, y = np.meshgrid(np.arange(model.width) + 0.5, np.arange(model.height) + 0.5)
            pixels = np.stack([x, y], axis=-1).reshape(-1, 2)

            def back(shift: tuple[float, float]) -> Array:
                rays = np.asarray(camera.cam_from_img(pixels + np.array(shift)))
                return np.asarray(rays[:, :2]).reshape(model.height, model.width, 2)

            slope = [back((0.5, 0)) - back((-0.5, 0)), back((0, 0.5)) - back((0, -0.5))]
            self._rays[model] = (back((0, 0)), np.stack(slope, axis=-1))
        return self._rays[model]

    def _poses(self, camera: ShutterCamera, motion: Motion, t_s: Array) -> tuple[Array, Array]:
        """(L, 3, 3) cam_from_world and (L, 3) camera centres."""
        world_from_body = matrix_from_quat(motion.world_from_cam_xyzw(t_s))
        centre = motion.cam_in_world_m(t_s) + world_from_body @ np.array(camera.cam_in_body_m)
        world_from_cam = world_from_body @ matrix_from_quat(np.array(camera.body_from_cam_xyzw))
        return np.swapaxes(world_from_cam, 1, 2), centre

    def _samples_needed(self, camera: ShutterCamera, motion: Motion, t_s: float) -> int:
        """Enough samples that neighbours along the blur of any object overlap."""
        rays, slope = self._rays_of(camera.model)
        coarse = (slice(None, None, max(1, rays.shape[0] // 9)), slice(None, None, max(1, rays.shape[1] // 9)))
        x, y = rays[coarse][..., 0], rays[coarse][..., 1]
        pixel = np.sqrt(np.abs(np.linalg.det(slope[coarse])))
        longest = 0.0
        for start in camera.line_start_s(t_s)[[0, -1]]:
            instants = np.array([start, start + camera.exposure_s])
            depth = 1 / np.maximum(self._trace(camera, motion, instants[:1], x, y)[3], 1e-3)
            rotation, centre = self._poses(camera, motion, instants)
            points = np.stack([x, y, np.ones_like(x)], axis=-1) * depth[..., None] @ rotation[0] + centre[0]
            moved = (points - centre[1]) @ rotation[1].T
            shift = np.hypot(moved[..., 0] / moved[..., 2] - x, moved[..., 1] / moved[..., 2] - y)
            longest = max(longest, float(np.max(shift / pixel)))
        more = int(np.ceil(self._limits.samples_per_px * max(longest, 1.0)))
        return min(self._limits.most_samples, self._limits.samples + more)

    def _sample(
        self, camera: ShutterCamera, motion: Motion, instants: Array, offset: Array, samples: int
    ) -> Float32Array:
        rays, slope = self._rays_of(camera.model)
        shifted = rays + slope @ offset
        lines = instants if camera.readout_s > 0 else instants[:1]
        x, y = shifted[..., 0].astype(np.float32), shifted[..., 1].astype(np.float32)
        quad, u, v, inverse = self._trace(camera, motion, lines, x, y)
        # A pixel covers depth^3 / (distance of the plane) times its solid angle on the surface.
        _, centre = self._poses(camera, motion, lines[len(lines) // 2 :][:1])
        normals = np.cross(self._v, self._u)
        distance = np.abs(np.einsum("qi,qi->q", normals, centre - self._corner)).astype(np.float32)
        rows, columns = (n // 2 for n in x.shape)
        solid = np.float32(abs(np.linalg.det(slope[rows, columns])))
        per_depth = solid / np.maximum(distance, np.float32(1e-4))
        size = self._size.astype(np.float32)
        out = np.zeros((quad.size, 3), dtype=np.float32)
        seen = np.flatnonzero(quad >= 0)
        for i in range(0, len(seen), self._limits.chunk_px):
            part = seen[i : i + self._limits.chunk_px]
            which, z_inverse = quad.ravel()[part], inverse.ravel()[part]
            s, t = u.ravel()[part] / (z_inverse * size[which, 0]), v.ravel()[part] / (z_inverse * size[which, 1])
            out[part] = self._atlas.look_up(which, s, t, np.sqrt(per_depth[which] / z_inverse**3))
        return out.reshape(*quad.shape, 3)

    def _trace(
        self, camera: ShutterCamera, motion: Motion, instants: Array, x: NDArray[np.floating], y: NDArray[np.floating]
    ) -> tuple[IndexArray, NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
        """Intersections of rays (x, y, 1): the piece (-1 is none), its (U, V) / depth in metres, 1 / depth.

        ``instants`` holds one time for all rays, or one for each row or column.
        """
        rotation, centre = self._poses(camera, motion, instants)
        by_column = camera.readout_direction in ("right", "left")
        a = np.einsum("lij,qj->qli", rotation, self._u)
        b = np.einsum("lij,qj->qli", rotation, self._v)
        c = np.einsum("lij,qlj->qli", rotation, self._corner[:, None] - centre)
        normal = np.cross(a, b)
        distance = np.einsum("qli,qli->ql", normal, c)
        # u right and v down as seen, so a x b points away from the viewer: visible pieces have a positive distance
        visible = np.flatnonzero((distance > 1e-6).any(axis=1))
        with np.errstate(divide="ignore", invalid="ignore"):
            homography = np.stack([np.cross(b, c), np.cross(c, a), normal], axis=2) / distance[:, :, None, None]
        homography = homography.astype(x.dtype)
        extent = self._extent(a, b, c, x, y)

        best = np.zeros(x.shape, dtype=x.dtype)
        best_u, best_v = np.zeros_like(best), np.zeros_like(best)
        winner = np.full(x.shape, -1, dtype=np.intp)
        for q in visible:
            rows, columns = extent[q]
            if rows.start >= rows.stop or columns.start >= columns.stop:
                continue
            part = (rows, columns)
            h = homography[q]
            if len(instants) > 1:
                h = h[columns] if by_column else h[rows]
                h = np.where(distance[q, columns if by_column else rows][:, None, None] > 1e-6, h, 0)
            lines = [h[:, i, j][None, :] if by_column else h[:, i, j][:, None] for i in range(3) for j in range(3)]
            px, py = x[part], y[part]
            w = lines[6] * px + lines[7] * py + lines[8]
            nearer = (w > best[part]) & (w < 1 / self._limits.near_m)
            if not nearer.any():
                continue
            u = lines[0] * px + lines[1] * py + lines[2]
            v = lines[3] * px + lines[4] * py + lines[5]
            nearer &= (u >= 0) & (v >= 0) & (u <= w * x.dtype.type(self._size[q, 0]))
            nearer &= v <= w * x.dtype.type(self._size[q, 1])
            np.copyto(best[part], w, where=nearer)
            np.copyto(best_u[part], u, where=nearer)
            np.copyto(best_v[part], v, where=nearer)
            np.copyto(winner[part], q, where=nearer)
        return winner, best_u, best_v, best

    def _extent(
        self, a: Array, b: Array, c: Array, x: NDArray[np.floating], y: NDArray[np.floating]
    ) -> list[tuple[slice, slice]]:
        """Rows and columns outside of which no ray meets a piece, for each piece (over all poses given)."""
        some = np.unique(np.linspace(0, a.shape[1] - 1, 9).round().astype(int))
        side_u = a[:, some] * self._size[:, None, :1]
        side_v = b[:, some] * self._size[:, None, 1:]
        corners = c[:, some, None] + np.stack([0 * side_u, side_u, side_v, side_u + side_v], axis=2)
        near = corners[..., 2] < self._limits.near_m
        behind, gone = near.any(axis=(1, 2)), near.all(axis=(1, 2))
        image = corners[..., :2] / np.maximum(corners[..., 2:], self._limits.near_m)
        margin = 0.01  # for what happens between the poses looked at
        low, high = image.min(axis=(1, 2)) - margin, image.max(axis=(1, 2)) + margin
        low[behind], high[behind] = -np.inf, np.inf
        low[gone] = np.inf
        rows = _spans((y.max(axis=1) >= low[:, 1:]) & (y.min(axis=1) <= high[:, 1:]))
        columns = _spans((x.max(axis=0) >= low[:, :1]) & (x.min(axis=0) <= high[:, :1]))
        return list(zip(rows, columns, strict=True))


def _spans(inside: BoolArray) -> list[slice]:
    """First to last true place of each row of (Q, N)."""
    first, last = inside.argmax(axis=1), inside.shape[1] - inside[:, ::-1].argmax(axis=1)
    return [slice(a, b) for a, b in zip(first.tolist(), np.where(inside.any(axis=1), last, 0).tolist(), strict=True)]


def develop(linear: Float32Array, camera: ShutterCamera, rng: np.random.Generator | None) -> UInt8Array:
    """(H, W, 3) 8-bit sRGB image of linear light, with shot and read noise (none with ``rng`` None)."""
    light: NDArray[np.floating] = np.asarray(linear, dtype=np.float32)
    if rng is not None:
        # electrons: variance = mean + read noise squared
        sigma = np.sqrt(
            np.maximum(light, 0) / camera.white_electrons + (camera.read_noise_electrons / camera.white_electrons) ** 2
        )
        light = light + sigma * rng.standard_normal(light.shape, dtype=np.float32)
    light = np.clip(light, 0, 1)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** np.float32(1 / 2.4) - 0.055)
    return np.asarray(np.round(255 * srgb), dtype=np.uint8)
