"""A desk of curved and plain things covered with photographs, ray-cast: depth in closed form, noise, JPEG.

Even seeds take one half of the photographs, odd seeds the other: what is chosen with even seeds is judged with odd
ones.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from colmap_inertial.core.arrays import Array, BoolArray, UInt8Array
from colmap_inertial.core.geometry import so3_exp

PHOTOS = Path(__file__).resolve().parents[3] / "shared" / "data" / "sharp_photos"
IMAGES = 21
#: Large things take photographs of which at least this share deviates, within 5 x 5 pixels, by so many codes.
LIVELY_SHARE, LIVELY_CODES = 0.75, 3.0
#: Subsamples across a pixel on the outlines of things.
SUBSAMPLES = 3
#: Errors of poses as mapping leaves them, and of the sparse points' pixels.
POSE_RAD, POSE_M, POINT_PX = 0.0003, 0.0003, 0.3
#: Noise of a pixel in codes, dark and bright; JPEG quality.
NOISE_CODES, JPEG_QUALITY = (1.5, 2.5), 90
LIGHT = np.array([-0.4, -0.6, 0.7]) / np.linalg.norm([-0.4, -0.6, 0.7])

#: Depth along rays whose z is 1 (inf: missed), (2, ...) metres along the surface, and unit normals.
Hit = tuple[Array, Array, Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class Cover:
    """A photograph on a surface, mirrored where it ends.

    Attributes
    ----------
    texels
        (H, W, 3) codes.
    texel_m
        Size of a texel.
    contrast
        Times the difference from the mean: small makes a plain surface.
    """

    texels: Array
    texel_m: float
    contrast: float = 1.0

    def colours(self, along: Array) -> Array:
        """(N, 3) codes at (2, N) metres."""
        high, wide = self.texels.shape[:2]
        at = [_mirror(along[k] / self.texel_m, size - 1).astype("f4") for k, size in ((0, wide), (1, high))]
        # remap takes no more than 32767 columns
        shape = (-1, 1024)
        room = -len(at[0]) % 1024
        x, y = (np.pad(a, (0, room)).reshape(shape) for a in at)
        found = cv2.remap(self.texels.astype("f4"), x, y, cv2.INTER_LINEAR).reshape(-1, 3)[: len(at[0])]
        return np.asarray(self._mean + self.contrast * (found - self._mean))

    @functools.cached_property
    def _mean(self) -> Array:
        return np.asarray(self.texels.mean(axis=(0, 1)))


def _lively_share(photo: Path) -> float:
    grey = cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE).astype("f4")  # type: ignore[union-attr]
    variance = cv2.blur(grey * grey, (5, 5)) - cv2.blur(grey, (5, 5)) ** 2
    return float((variance > LIVELY_CODES**2).mean())


def _mirror(at: Array, size: int) -> Array:
    return size - np.abs(np.mod(at, 2 * size) - size)


@dataclass(frozen=True, eq=False, kw_only=True)
class Sheet:
    """A parallelogram, flat or with waves along its normal."""

    corner: Array
    sides: Array  # (2, 3), at right angles
    cover: Cover
    wave_m: float = 0.0
    period_m: float = 0.25

    def hit(self, centre: Array, rays: Array) -> Hit:
        """Where rays (N, 3) meet it first; waves by steps through their slab and bisection."""
        lengths = np.linalg.norm(self.sides, axis=1)
        axes = self.sides / lengths[:, None]
        normal = np.cross(axes[0], axes[1])
        start, slope = normal @ (centre - self.corner), rays @ normal
        along_start, along_slope = axes @ (centre - self.corner), axes @ rays.T

        def above(t: Array) -> Array:
            a, b = along_start[:, None] + along_slope * t
            return start + slope * t - self._wave(a, b)[0]

        with np.errstate(divide="ignore", invalid="ignore"):
            if self.wave_m:
                ends = np.sort(np.stack([(s * self.wave_m - start) / slope for s in (-1, 1)]), axis=0)
                low, high = ends[0], ends[0].copy()
                open_ = np.ones(len(rays), dtype=bool)
                first = np.sign(above(low))
                for share in np.linspace(0, 1, 25)[1:]:
                    t = ends[0] + share * (ends[1] - ends[0])
                    same = np.sign(above(t)) == first
                    low, high = np.where(open_ & same, t, low), np.where(open_, t, high)
                    open_ &= same
                for _ in range(30):
                    t = (low + high) / 2
                    same = np.sign(above(t)) == first
                    low, high = np.where(same, t, low), np.where(same, high, t)
                t = np.where(open_, np.inf, high)
            else:
                t = -start / slope
            t = np.where(np.isfinite(t) & (t > 0.05), t, np.inf)
            along = along_start[:, None] + along_slope * np.where(np.isfinite(t), t, 0)
        inside = ((along >= 0) & (along <= lengths[:, None])).all(axis=0)
        _, by_a, by_b = self._wave(*along)
        normals = normal - by_a[:, None] * axes[0] - by_b[:, None] * axes[1]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return np.where(inside, t, np.inf), along, normals

    def _wave(self, a: Array, b: Array) -> tuple[Array, Array, Array]:
        """Height above the plane, and its slopes."""
        k = 2 * np.pi / self.period_m
        sine, cosine, lift = np.sin(k * a), np.cos(k * a), np.cos(0.6 * k * b)
        slope_b = -0.6 * k * self.wave_m * sine * np.sin(0.6 * k * b)
        return self.wave_m * sine * lift, self.wave_m * k * cosine * lift, slope_b


@dataclass(frozen=True, eq=False, kw_only=True)
class Sphere:
    """A ball, or seen from within a backdrop."""

    middle: Array
    radius_m: float
    cover: Cover

    def hit(self, centre: Array, rays: Array) -> Hit:
        """Where rays (N, 3) meet it first."""
        away = centre - self.middle
        t = _first_root((rays**2).sum(axis=1), rays @ away, away @ away - self.radius_m**2)
        normals = (away + rays * np.where(np.isfinite(t), t, 0)[:, None]) / self.radius_m
        height = np.arcsin(np.clip(normals[:, 2], -1, 1))
        return t, self.radius_m * np.stack([np.arctan2(normals[:, 1], normals[:, 0]) + 4, height + 2]), normals


@dataclass(frozen=True, eq=False, kw_only=True)
class Cylinder:
    """Upright, with a flat top."""

    foot: Array
    radius_m: float
    height_m: float
    cover: Cover

    def hit(self, centre: Array, rays: Array) -> Hit:
        """Where rays (N, 3) meet it first."""
        away = centre - self.foot
        t = _first_root((rays[:, :2] ** 2).sum(axis=1), rays[:, :2] @ away[:2], away[:2] @ away[:2] - self.radius_m**2)
        at = away + rays * np.where(np.isfinite(t), t, 0)[:, None]
        t = np.where((at[:, 2] >= 0) & (at[:, 2] <= self.height_m), t, np.inf)
        angle = np.arctan2(at[:, 1], at[:, 0])
        along = np.stack([self.radius_m * (angle + 4), at[:, 2]])
        normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            lid = (self.height_m - away[2]) / rays[:, 2]
        flat = away[:2] + rays[:, :2] * lid[:, None]
        on = (lid > 0) & ((flat**2).sum(axis=1) <= self.radius_m**2) & (lid < t)
        along = np.where(on, flat.T + 1, along)
        return np.where(on, lid, t), along, np.where(on[:, None], [0.0, 0, 1], normals)


def _first_root(a: Array, b: Array, c: float) -> Array:
    """The least t > 0 of a t^2 + 2 b t + c; inf without."""
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(b * b - a * c)
        near, far = (-b - root) / a, (-b + root) / a
    t = np.where(near > 0, near, far)
    return np.where(t > 0, t, np.inf)


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotoWorld:
    """Things, and the cameras that look at them.

    Attributes
    ----------
    width, height, focal_px
        Of the pictures; the principal point is the middle.
    cam_from_world, cam_in_world
        (N, 3, 3) and (N, 3).
    """

    seed: int
    width: int
    things: Sequence[Sheet | Sphere | Cylinder]
    cam_from_world: Array
    cam_in_world: Array
    height: int = field(init=False)
    focal_px: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "height", self.width * 3 // 4)
        object.__setattr__(self, "focal_px", 0.85 * self.width)

    @classmethod
    def of(cls, seed: int, width: int, images: int = IMAGES) -> PhotoWorld:
        """A world of its own for each seed."""
        rng = np.random.default_rng(seed)
        photos = sorted(PHOTOS.glob("*.jpg"))[seed % 2 :: 2]
        large = [path for path in photos if path.name.startswith("clic") and _lively_share(path) >= LIVELY_SHARE]
        # texels about as large as pixels at a metre, in either width
        texel_m = 1 / (0.85 * min(width, 900))

        def cover(contrast: float = 1.0, of: Sequence[Path] = photos) -> Cover:
            texels = cv2.imread(str(of[rng.integers(len(of))]), cv2.IMREAD_COLOR)
            assert texels is not None, PHOTOS
            return Cover(texels=texels, texel_m=texel_m * rng.uniform(0.8, 1.4), contrast=contrast)

        def sheet(corner: Sequence[float], along: Sequence[float], up: Sequence[float], **more: object) -> Sheet:
            return Sheet(corner=np.array(corner), sides=np.array([along, up], dtype=float), **more)  # type: ignore[arg-type]

        places = rng.permutation([[-0.5, -0.2], [-0.2, 0.1], [0.1, -0.25], [0.4, 0.05], [0.62, -0.3], [-0.1, -0.4]])
        places = places + rng.uniform(-0.04, 0.04, places.shape)
        things: list[Sheet | Sphere | Cylinder] = [
            sheet([-0.8, -0.55, 0], [1.6, 0, 0], [0, 1.1, 0], cover=cover(of=large)),
            sheet([-2.5, 1.0, -1], [5, 0, 0], [0, 0, 4], cover=cover(contrast=0.05)),
            sheet([-2.5, -2, -0.75], [5, 0, 0], [0, 3, 0], cover=cover(of=large)),
            sheet(
                [-0.75, 0.42, 0], [1.5, 0, 0], [0, 0, 0.4], cover=cover(of=large),
                wave_m=rng.uniform(0.015, 0.04), period_m=rng.uniform(0.2, 0.4),
            ),
            Sphere(middle=np.zeros(3), radius_m=5.0, cover=cover(of=large)),
        ]  # fmt: skip
        for i, (x, y) in enumerate(places):
            contrast = 0.1 if i == 0 else 1.0
            radius = rng.uniform(0.06, 0.11)
            if i % 3 == 2:
                turn = rng.uniform(-0.6, 0.6)
                side = 0.2 * np.array([np.cos(turn), np.sin(turn), 0])
                lean = np.array([-np.sin(turn) * 0.1, np.cos(turn) * 0.1, 0.25])
                things.append(sheet([x - side[0] / 2, y - side[1] / 2, 0], side, lean, cover=cover()))
            elif i % 3:
                foot, height = np.array([x, y, 0.0]), rng.uniform(0.12, 0.3)
                things.append(Cylinder(foot=foot, radius_m=radius, height_m=height, cover=cover()))
            else:
                things.append(Sphere(middle=np.array([x, y, radius]), radius_m=radius, cover=cover(contrast)))
        return cls(seed=seed, width=width, things=things, **_orbit(rng, images))

    @property
    def camera(self) -> pycolmap.Camera:
        """The cameras of all images, in COLMAP's convention."""
        params = [self.focal_px, self.focal_px, self.width / 2, self.height / 2]
        return pycolmap.Camera(camera_id=1, model="PINHOLE", width=self.width, height=self.height, params=params)

    def rays(self, x: Array, y: Array) -> Array:
        """(N, 3) directions of pixels, z = 1; the first pixel's middle is 0.5."""
        return np.stack(
            [(x - self.width / 2) / self.focal_px, (y - self.height / 2) / self.focal_px, np.ones_like(x)], axis=-1
        )

    def render(self, image: int) -> tuple[UInt8Array, Array]:
        """(H, W, 3) codes, BGR, and (H, W) depth at pixels' middles."""
        shape = self.height, self.width
        y, x = (axis.ravel() + 0.5 for axis in np.indices(shape).astype(float))
        colours, depth, which = self._cast(image, x, y)
        edge = _outline(which.reshape(shape)).ravel()
        offsets = (np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES - 0.5
        parts = [self._cast(image, x[edge] + dx, y[edge] + dy)[0] for dy in offsets for dx in offsets]
        colours[edge] = np.mean(parts, axis=0)
        rng = np.random.default_rng((self.seed, image))
        light = cv2.GaussianBlur(colours.reshape(*shape, 3), (0, 0), 0.5) * rng.uniform(0.96, 1.04)
        level = np.clip(light / 255, 0, 1)
        light += rng.normal(size=light.shape) * (NOISE_CODES[0] + (NOISE_CODES[1] - NOISE_CODES[0]) * np.sqrt(level))
        return np.clip(np.rint(light), 0, 255).astype(np.uint8), depth.reshape(shape)

    def _cast(self, image: int, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Codes, depth and number of the thing that each ray meets first."""
        rays = self.rays(x, y) @ self.cam_from_world[image]
        hits = [thing.hit(self.cam_in_world[image], rays) for thing in self.things]
        depths = np.array([t for t, _, _ in hits])
        which = np.argmin(depths, axis=0)
        colours = np.empty((len(x), 3))
        for i, (thing, (_, along, normals)) in enumerate(zip(self.things, hits, strict=True)):
            mine = which == i
            if mine.any():
                facing = np.abs(normals[mine] @ LIGHT)[:, None]
                colours[mine] = thing.cover.colours(along[:, mine]) * (0.65 + 0.35 * facing)
        return colours, depths[which, np.arange(len(x))], which

    def write_workspace(self, folder: Path, points: int = 150) -> dict[str, Array]:
        """A dense workspace of COLMAP's with pictures and model, without maps; returns true depths by name."""
        (folder / "images").mkdir(parents=True)
        (folder / "stereo").mkdir()
        rng = np.random.default_rng((self.seed, self.width))
        names = [f"{i:03d}.jpg" for i in range(len(self.cam_in_world))]
        depths, world = {}, []
        for i, name in enumerate(names):
            picture, depths[name] = self.render(i)
            cv2.imwrite(str(folder / "images" / name), picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            corners = cv2.goodFeaturesToTrack(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), points, 0.01, 5)
            x, y = np.asarray(corners).reshape(-1, 2).astype(int).T
            world.append(
                self.rays(x + 0.5, y + 0.5) * depths[name][y, x][:, None] @ self.cam_from_world[i]
                + self.cam_in_world[i]
            )
        model = self._model(names, np.concatenate(world), depths, rng)
        (folder / "sparse").mkdir()
        model.write_binary(str(folder / "sparse"))
        (folder / "stereo" / "fusion.cfg").write_text("\n".join(names) + "\n")
        return depths

    def _model(
        self, names: Sequence[str], world: Array, depths: dict[str, Array], rng: np.random.Generator
    ) -> pycolmap.Reconstruction:
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(self.camera)
        tracks = [pycolmap.Track() for _ in world]
        for i, name in enumerate(names):
            cam = (world - self.cam_in_world[i]) @ self.cam_from_world[i].T
            px = self.focal_px * cam[:, :2] / cam[:, 2:] + [self.width / 2, self.height / 2]
            inside = (cam[:, 2] > 0) & (px >= 0).all(axis=1) & (px[:, 0] < self.width) & (px[:, 1] < self.height)
            x, y = np.where(inside[:, None], px, 0).astype(int).T
            seen = np.flatnonzero(inside & (np.abs(depths[name][y, x] / np.maximum(cam[:, 2], 0.01) - 1) < 0.01))
            for j, number in enumerate(seen):
                tracks[number].add_element(i + 1, j)
            turn = so3_exp(rng.normal(size=(1, 3)) * POSE_RAD)[0] @ self.cam_from_world[i]
            centre = self.cam_in_world[i] + rng.normal(size=3) * POSE_M
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ centre)
            observed = [pycolmap.Point2D(px[n] + rng.normal(size=2) * POINT_PX) for n in seen]
            image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1, points2D=observed)
            model.add_image_with_trivial_frame(image, pose)
        for point, track in zip(world, tracks, strict=True):
            if track.length() > 2:
                model.add_point3D(point, track, np.zeros(3, np.uint8))
        return model


def _orbit(rng: np.random.Generator, images: int) -> dict[str, Array]:
    """Cameras on an arc before the table that look at it, not quite level."""
    turns, centres = [], []
    for angle in np.radians(np.linspace(-40, 40, images)):
        centre = np.array([1.15 * np.sin(angle), -1.15 * np.cos(angle), 0.5]) + rng.uniform(-0.08, 0.08, 3)
        forward = np.array([0, 0.05, 0.08]) + rng.uniform(-0.06, 0.06, 3) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        upright = np.array([right, np.cross(forward, right), forward])
        turns.append(so3_exp(rng.normal(size=(1, 3)) * 0.03)[0] @ upright)
        centres.append(centre)
    return {"cam_from_world": np.array(turns), "cam_in_world": np.array(centres)}


def _outline(which: Array) -> BoolArray:
    """Pixels whose neighbours show another thing."""
    small = which.astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(small, kernel) != cv2.erode(small, kernel))
