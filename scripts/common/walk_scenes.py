"""Walks past walls on which the same posters may hang: around a room back to its start, along a corridor or streets.

What a pixel of a frame truly shows is told by `places_m`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, UInt8Array
from colmap_inertial.core.geometry import quat_exp, quat_from_matrix, quat_multiply
from colmap_inertial.core.types import CameraModel
from colmap_inertial.io.files import write_json, write_text
from colmap_inertial.tools.simulate import (
    IMU_PRESETS,
    Board,
    Motion,
    Quad,
    Renderer,
    ShutterCamera,
    World,
    develop,
    draw_imu_errors,
    sample_imu,
    textures,
)
from colmap_inertial.tools.simulate.motion import MARGIN_S
from colmap_inertial.tools.simulate.render import RenderLimits

#: Half the room, and from the walls to the path, whose corners are rounded.
HALF_M, AISLE_M, HEIGHT_M = np.array([5.0, 4.0]), 1.8, 2.6
#: A corridor's length, how far its wall is from who walks along it, and how fast that is.
LENGTH_M, AWAY_M, SPEED_M_S = 40.0, 2.2, 0.6
#: Corners of a path that is walked at one pace.
CORNER_M = 1.2
#: From one copy to the next.
PERIOD_M = 1.25
#: Blocks of houses in each direction, how long they are, how wide the streets between them; how many of the fronts
#: look like others, of so many designs; who walks looks so much to the right.
BLOCKS, BLOCK_M, STREET_M, ALIKE, DESIGNS, ASIDE_DEG = 3, 7.0, 4.0, 0.5, 3, 40.0
#: Who walks back looks so much to where they go, both ways: the same is seen from directions twice as far apart.
AHEAD_DEG = 20.0
#: Knots of the path.
RATE_HZ = 60.0

Kind = Callable[[np.random.Generator, int, int], Float32Array]
Paint = Callable[[Kind, np.random.Generator, int, int], Float32Array]
Scene = Literal["room", "mixed", "copies", "tiled", "corridor", "tiled corridor", "streets"]


@dataclass(frozen=True, kw_only=True)
class Walk:
    """A walk: of how many frames at which rate, past what, how many times around, and how wide its pictures are.

    Where they are not ``drawn``, they are blank: their features come from `walk_features`.

    ``scene``: a ``room`` in which everything is unlike; ``mixed``: in it, every other poster is one of two, of one
    size, on all walls; ``copies``: nothing but one poster at equal distances, on plaster; ``tiled``: the plaster is the
    same from each poster to the next, too; likewise a ``corridor`` with one wall, and nobody turns round. ``streets``:
    a grid of them, half of whose fronts are copies, whole, of one of three; who walks turns at crossings as it comes.

    ``back``: halfway, who walks around a room turns round, and what they saw comes again from the other side.

    ``pace_m_s``: the room is as large as the walk, at this pace, is long. Without one, it is of the usual size; who
    walks is slow in corners, and quick in the middle of walls.
    """

    seed: int
    frames: int = 400
    frame_rate_hz: float = 10.0
    laps: float = 1.08
    scene: Scene = "room"
    width: int = 480
    drawn: bool = True
    back: bool = False
    pace_m_s: float | None = None

    def half_m(self) -> Array:
        """Half the room."""
        if self.pace_m_s is None:
            return HALF_M
        lap_m = self.pace_m_s * self.frames / self.frame_rate_hz / self.laps
        # a lap is as long as the room's walls less what the aisle and the corners take
        return (lap_m + 8 * AISLE_M + (8 - 2 * np.pi) * CORNER_M) / (4 * HALF_M.sum()) * HALF_M

    def path_m(self) -> Array:
        """Half the path, as far from the walls in any room."""
        return self.half_m() - AISLE_M

    def camera(self) -> ShutterCamera:
        """A pinhole of 64 degrees."""
        height = self.width * 3 // 4
        params = (self.width * 19 / 24, self.width * 19 / 24, self.width / 2, height / 2)
        model = CameraModel(model="PINHOLE", width=self.width, height=height, params=params)
        return ShutterCamera(model=model, exposure_s=0.001)


@cache
def world_of(walk: Walk) -> World:
    """All that there is to see on a walk."""
    rng = np.random.default_rng([walk.seed, 1])
    paint = _drawn if walk.drawn else _blank
    if walk.scene in ("copies", "tiled", "corridor", "tiled corridor"):
        return _copies(walk, rng, paint)
    if walk.scene == "streets":
        return _streets(rng, paint)
    designs = [paint(textures.poster, rng, 240, 300) for _ in range(2)]
    quads = []
    corners = walk.half_m() * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    for wall in range(4):
        start, end = (np.array([*corners[(wall + k) % 4], HEIGHT_M]) for k in (0, 1))
        quads += _wall(start, end, rng, paint, designs if walk.scene == "mixed" else [])
    quads.append(_floor(walk.half_m(), rng, paint))
    return World(quads=tuple(quads), board=Board(), board_corners_m=np.zeros((0, 3)))


def _wall(start: Array, end: Array, rng: np.random.Generator, paint: Paint, designs: list[Float32Array]) -> list[Quad]:
    """A wall with posters, and things before it; every other poster is one of the designs, if there are any."""
    up, along = np.array([0.0, 0.0, 1.0]), (end - start) / np.linalg.norm(end - start)
    length = float(np.linalg.norm(end - start))
    inwards = np.cross(along, up)
    plaster = paint(textures.plaster, rng, 260, round(100 * length))
    quads = [Quad(corner_m=start, edge_u_m=end - start, edge_v_m=-HEIGHT_M * up, texture=plaster)]
    for place in range(round(length / 1.2)):
        same = bool(designs) and rng.random() < 0.5
        size = np.array([0.9, 0.75]) if same else rng.uniform([0.5, 0.4], [1.1, 1.0])
        left = (place + rng.uniform(0, 0.15)) * length / round(length / 1.2)
        drawn = (round(300 * size[1]), round(300 * size[0]))
        texture = designs[rng.integers(len(designs))] if same else paint(textures.poster, rng, *drawn)
        corner = start + left * along + rng.uniform(0.02, 0.1) * inwards - rng.uniform(0.4, 0.9) * up
        quads.append(Quad(corner_m=corner, edge_u_m=size[0] * along, edge_v_m=-size[1] * up, texture=texture))
        # something that stands before the wall, here and nowhere else
        width, depth, height = rng.uniform([0.3, 0.2, 0.4], [0.8, 0.6, 1.2])
        front = start + (left + rng.uniform(0, 0.5)) * along + depth * inwards - (HEIGHT_M - height) * up
        for corner, edge in (
            (front, width * along),
            (front - depth * inwards, depth * inwards),
            (front + width * along, -depth * inwards),
        ):
            face = paint(textures.poster, rng, round(300 * height), max(8, round(300 * float(np.linalg.norm(edge)))))
            quads.append(Quad(corner_m=corner, edge_u_m=edge, edge_v_m=-height * up, texture=face))
    return quads


def _floor(half_m: Array, rng: np.random.Generator, paint: Paint) -> Quad:
    x, y = np.array([2 * half_m[0], 0, 0]), np.array([0, 2 * half_m[1], 0])
    floor = paint(textures.carpet, rng, 800, 1000)
    return Quad(corner_m=np.array([-half_m[0], half_m[1], 0]), edge_u_m=x, edge_v_m=-y, texture=floor)


def _streets(rng: np.random.Generator, paint: Paint) -> World:
    """Blocks of houses in a grid of streets, around which there are houses, too; fronts face the streets."""
    start, end = np.array([0.0, 0.0, HEIGHT_M]), np.array([BLOCK_M, 0.0, HEIGHT_M])
    designs = [_wall(start, end, rng, paint, []) for _ in range(DESIGNS)]
    period_m, half_m = BLOCK_M + STREET_M, (BLOCKS * (BLOCK_M + STREET_M) + STREET_M) / 2
    places = [-half_m + STREET_M + period_m * block for block in range(BLOCKS)]
    quarters = [np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    corners = np.array([[0.0, 0.0, 0.0], [BLOCK_M, 0.0, 0.0], [BLOCK_M, BLOCK_M, 0.0], [0.0, BLOCK_M, 0.0]])
    fronts = [
        (np.array([x, y, 0.0]) + corners[side], quarters[side]) for x in places for y in places for side in range(4)
    ]
    # houses beyond the last street; between two of them there is a gap, which a hedge of its own closes
    quads = [_floor(np.array([half_m, half_m]), rng, paint)]
    for turned in quarters:
        fronts += [(turned @ np.array([place, half_m, 0.0]), turned) for place in places]
        for gap in (-half_m, *(place + BLOCK_M for place in places)):
            hedge = _wall(start, np.array([STREET_M, 0.0, HEIGHT_M]), rng, paint, [])
            quads += _placed(hedge, turned @ np.array([gap, half_m, 0.0]), turned)
    for at_m, turned in fronts:
        alike = rng.random() < ALIKE
        front = designs[rng.integers(DESIGNS)] if alike else _wall(start, end, rng, paint, [])
        quads += _placed(front, at_m, turned)
    return World(quads=tuple(quads), board=Board(), board_corners_m=np.zeros((0, 3)))


def _placed(quads: list[Quad], at_m: Array, turned: Array) -> list[Quad]:
    """The same, turned and set elsewhere."""
    return [
        Quad(
            corner_m=turned @ quad.corner_m + at_m,
            edge_u_m=turned @ quad.edge_u_m,
            edge_v_m=turned @ quad.edge_v_m,
            texture=quad.texture,
        )
        for quad in quads
    ]


def _drawn(kind: Kind, rng: np.random.Generator, height: int, width: int) -> Float32Array:
    return kind(rng, height, width)


def _blank(kind: Kind, rng: np.random.Generator, height: int, width: int) -> Float32Array:
    return np.zeros((2, 2, 3), dtype=np.float32)


def _copies(walk: Walk, rng: np.random.Generator, paint: Paint) -> World:
    """Walls with one poster at equal distances, and nothing else."""
    up, design = np.array([0.0, 0.0, 1.0]), paint(textures.poster, rng, 240, 300)
    if "corridor" in walk.scene:
        corners = np.array([[-LENGTH_M / 2, AWAY_M], [LENGTH_M / 2, AWAY_M]])
    else:
        corners = walk.half_m() * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1], [-1, 1]])
    tile = paint(textures.plaster, rng, 260, round(100 * PERIOD_M))
    quads = []
    for start, end in itertools.pairwise(np.column_stack([corners, np.full(len(corners), HEIGHT_M)])):
        along = (end - start) / np.linalg.norm(end - start)
        count = int(np.linalg.norm(end - start) / PERIOD_M)
        for place in range(count):
            left, wide = start + place * PERIOD_M * along, PERIOD_M * along
            plaster = tile if "tiled" in walk.scene else paint(textures.plaster, rng, 260, round(100 * PERIOD_M))
            quads.append(Quad(corner_m=left, edge_u_m=wide, edge_v_m=-HEIGHT_M * up, texture=plaster))
            corner = left + 0.2 * along + 0.02 * np.cross(along, up) - 0.8 * up
            quads.append(Quad(corner_m=corner, edge_u_m=0.9 * along, edge_v_m=-0.75 * up, texture=design))
    return World(quads=tuple(quads), board=Board(), board_corners_m=np.zeros((0, 3)))


def places_m(world: World, from_m: Array, rays: Array) -> Array:
    """(N, 3) what rays (N, 3) from points (N, 3) meet first; NaN where nothing."""
    nearest = np.full(len(rays), np.inf)
    for quad in world.quads:
        with np.errstate(divide="ignore", invalid="ignore"):
            away = (quad.corner_m - from_m) @ quad.normal / (rays @ quad.normal)
        on = from_m + away[:, None] * rays - quad.corner_m
        u, v = (on @ edge / (edge @ edge) for edge in (quad.edge_u_m, quad.edge_v_m))
        hit = (away > 0) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1) & (rays @ quad.normal < 0)
        nearest = np.where(hit & (away < nearest), away, nearest)
    return np.asarray(from_m + np.where(np.isfinite(nearest), nearest, np.nan)[:, None] * rays)


def motion_of(walk: Walk) -> Motion:
    """Along a rounded rectangle or a corridor, looking at the wall and a little ahead, with a hand's sway."""
    rng = np.random.default_rng([walk.seed, 2])
    duration_s = walk.frames / walk.frame_rate_hz
    count = int((duration_s + 2 * MARGIN_S) * RATE_HZ) + 33
    t_s = -MARGIN_S - 16 / RATE_HZ + np.arange(count) / RATE_HZ
    laps, path_m = walk.laps * t_s / duration_s, walk.path_m()
    if walk.back:
        laps = np.minimum(laps, walk.laps - laps)
    phase = 2 * np.pi * laps
    # a superellipse; the camera looks along its normal
    cosine, sine = np.cos(phase), np.sin(phase)
    across = np.stack([np.sign(c) * np.abs(c) ** 0.5 for c in (cosine, sine)], axis=1) * path_m
    out = np.stack([cosine / path_m[0], sine / path_m[1]], axis=1)
    if walk.pace_m_s is not None:
        across, out = _at_one_pace(path_m, laps)
        out = _smooth(out)
    across = _smooth(across)
    if walk.back:
        ahead = np.radians(AHEAD_DEG) * _smooth(np.where(t_s < duration_s / 2, 1.0, -1.0)[:, None])
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        out = np.cos(ahead) * out + np.sin(ahead) * np.stack([-out[:, 1], out[:, 0]], axis=1)
    sway = [sum(a * np.sin(2 * np.pi * f * t_s + p) for a, f, p in _tones(rng)) for _ in range(6)]
    out = np.column_stack([out, 0 * phase])
    if walk.scene == "streets":
        across, heading = _route(walk, t_s)
        aside = _smooth(heading[:, None])[:, 0] - np.radians(ASIDE_DEG)
        out = np.column_stack([np.cos(aside), np.sin(aside), 0 * phase])
    if "corridor" in walk.scene:
        across = np.stack([SPEED_M_S * (t_s - duration_s / 2), 0 * t_s], axis=1)
        out = np.tile([0.3, 1.0, 0.0], (count, 1))
    position = np.stack([across[:, 0], across[:, 1], np.full(count, 1.4)], axis=1) + 0.02 * np.stack(sway[:3], axis=1)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    right = np.stack([out[:, 1], -out[:, 0], 0 * phase], axis=1)
    looking = quat_from_matrix(np.stack([right, np.cross(out, right), out], axis=-1))
    hand = quat_exp(0.06 * np.stack(sway[3:], axis=1))
    return Motion(
        start_s=float(t_s[0]),
        step_s=1 / RATE_HZ,
        cam_in_world_m=position,
        world_from_cam_xyzw=quat_multiply(looking, hand),
    )


def _smooth(values: Array) -> Array:
    """Means of a second."""
    second = np.ones(61) / 61
    return np.stack([np.convolve(np.pad(c, 30, mode="edge"), second, mode="valid") for c in values.T], axis=1)


def _at_one_pace(half_m: Array, laps: Array) -> tuple[Array, Array]:
    """(N, 2) places on a rectangle with round corners, after so many laps (N,), and directions (N, 2) out of it."""
    x, y = half_m - CORNER_M
    turn = np.pi / 2 * CORNER_M
    way_m = np.cumsum([0, y, turn, 2 * x, turn, 2 * y, turn, 2 * x, turn, y])
    middle = np.array([(x, 0), (x, y), (x, y), (-x, y), (-x, y), (-x, -y), (-x, -y), (x, -y), (x, -y), (x, 0)])
    at_m = laps % 1 * way_m[-1]
    angle = np.interp(at_m, way_m, np.pi / 2 * np.array([0, 0, 1, 1, 2, 2, 3, 3, 4, 4]))
    out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.stack([np.interp(at_m, way_m, c) for c in middle.T], axis=1) + CORNER_M * out, out


def _route(walk: Walk, t_s: Array) -> tuple[Array, Array]:
    """(N, 2) places in the middle of streets at one pace, with round corners, and (N,) which way that is, rad."""
    if walk.pace_m_s is None:
        raise ValueError("who walks through streets has a pace")
    rng, period_m = np.random.default_rng([walk.seed, 6]), BLOCK_M + STREET_M
    corner_m, bend_m = STREET_M / 2, np.pi / 4 * STREET_M
    at, ahead = np.array([1, 0]), np.array([0, 1])
    # of the route's pieces, the length and how far it turns: a street between crossings, then a crossing
    pieces: list[tuple[float, float]] = []
    for _ in range(int(np.ptp(t_s) * walk.pace_m_s / (period_m - 2 * corner_m)) + 1):
        pieces.append((period_m - 2 * corner_m, 0.0))
        at = at + ahead
        left = np.array([-ahead[1], ahead[0]])
        possible = [
            (direction, quarter)
            for direction, quarter in ((ahead, 0), (left, 1), (-left, -1))
            if ((at + direction >= 0) & (at + direction <= BLOCKS)).all()
        ]
        ahead, quarter = possible[rng.integers(len(possible))]
        pieces.append((bend_m if quarter else 2 * corner_m, quarter * np.pi / 2))
    lengths, turns = (np.array(column) for column in zip(*pieces, strict=True))
    # integrated in steps of a millimetre, so that the route does not drift out of its streets
    fine_m = np.arange(0, np.ptp(t_s) * walk.pace_m_s + 0.01, 1e-3)
    ends, angles = np.cumsum([0, *lengths]), np.pi / 2 + np.cumsum([0, *turns])
    heading = np.interp(fine_m + 5e-4, ends, angles)
    steps = 1e-3 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    half_m = (BLOCKS * period_m + STREET_M) / 2
    start = np.array([period_m + corner_m, 2 * corner_m]) - half_m
    places = start + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)[:-1]])
    at_m = (t_s - t_s[0]) * walk.pace_m_s
    place = np.stack([np.interp(at_m, fine_m, column) for column in places.T], axis=1)
    return place, np.interp(at_m, ends, angles)


def _tones(rng: np.random.Generator) -> list[tuple[float, float, float]]:
    return [(rng.uniform(0.5, 1.0), f * rng.uniform(0.9, 1.1), rng.uniform(0, 6.3)) for f in (0.3, 0.7, 1.3, 1.9)]


def write_walk(walk: Walk, folder: Path, pictures: Iterator[UInt8Array] | None = None) -> Path:
    """The capture of a walk, unless it is there already; returns its ``capture.toml``.

    ``pictures``: RGB, other ones than those of the walk's scene.
    """
    described = folder / "capture.toml"
    if described.is_file():
        return described
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    motion, duration_s = motion_of(walk), walk.frames / walk.frame_rate_hz
    rng = np.random.default_rng([walk.seed, 3])
    options = IMU_PRESETS["phone"]
    imu = sample_imu(motion, draw_imu_errors(options, duration_s, rng), options, duration_s=duration_s, rng=rng)
    trigger_s = np.arange(walk.frames) / walk.frame_rate_hz
    names = [f"{i:06d}.jpg" for i in range(walk.frames)]
    camera = walk.camera()
    if pictures is None:
        blank = itertools.repeat(np.zeros((camera.model.height, camera.model.width, 3), dtype=np.uint8), len(names))
        pictures = draw_pictures(walk, world_of(walk)) if walk.drawn else blank
    for name, picture in zip(names, pictures, strict=True):
        cv2.imwrite(str(folder / "frames" / name), picture[..., ::-1])
    for sensor, t_s, values in (
        ("gyro", imu.recording.gyro_t_s, imu.recording.gyro_rad_s),
        ("accel", imu.recording.accel_t_s, imu.recording.accel_m_s2),
    ):
        rows = [f"{t:.7f},{x:.6f},{y:.6f},{z:.6f}" for t, (x, y, z) in zip(t_s, values, strict=True)]
        write_text(folder / f"{sensor}.csv", "\n".join(["t,x,y,z", *rows]) + "\n")
    rows = [f"{name},{t:.9f}" for name, t in zip(names, trigger_s, strict=True)]
    write_text(folder / "frames.csv", "\n".join(["name,t_s", *rows]) + "\n")
    middle_s = np.array([camera.middle_s(t) for t in trigger_s.tolist()])
    write_json(
        folder / "truth.json",
        {
            "names": names,
            "cam_in_world_m": motion.cam_in_world_m(middle_s),
            "world_from_cam_xyzw": motion.world_from_cam_xyzw(middle_s),
        },
    )
    model = camera.model
    lines = ["[images]", 'folder = "frames"', 'times = "frames.csv"', "[timing]"]
    lines += [f"exposure_s = {camera.exposure_s!r}", "readout_s = 0.0", "[camera]", f'model = "{model.model}"']
    lines += [f"width = {model.width}", f"height = {model.height}", f"params = {list(model.params)!r}"]
    lines += ['pixel_origin = "corner"']
    for sensor, unit in (("gyro", "rad/s"), ("accel", "m/s2")):
        lines += [f"[imu.{sensor}]", f'file = "{sensor}.csv"', 'time = "t"', 'time_unit = "s"']
        lines += ['columns = ["x", "y", "z"]', f'unit = "{unit}"']
    write_text(described, "\n".join(lines) + "\n")
    return described


def draw_pictures(walk: Walk, world: World) -> Iterator[UInt8Array]:
    """The pictures of a walk past a world, RGB."""
    # a third of the rays: it is features that count here; of small pictures, a quarter of these
    limits = RenderLimits(samples=4) if walk.width > 400 else RenderLimits(samples=2, samples_per_px=0.0)
    renderer, camera, motion = Renderer(world, limits), walk.camera(), motion_of(walk)
    for index, t_s in enumerate((np.arange(walk.frames) / walk.frame_rate_hz).tolist()):
        yield develop(renderer.linear(camera, motion, t_s), camera, np.random.default_rng([walk.seed, 4, index]))
