"""A textured world of flat pieces: a desk full of things in a room, or the room itself. Metres, z up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array
from colmap_inertial.tools.simulate import textures
from colmap_inertial.tools.simulate.motion import Walls

WorldKind = Literal["desk", "room"]

#: Lowest and highest corner of the room around each world.
WALLS_M: dict[WorldKind, Walls] = {
    "desk": ((-2.5, -2.5, -0.8), (2.5, 2.5, 1.7)),
    "room": ((-3.2, -2.8, -1.4), (3.2, 2.8, 1.3)),
}
_Material = Callable[[np.random.Generator, int, int], Float32Array]

#: Direction to the lamp, and how much light comes from everywhere.
_TO_LAMP = np.array([0.35, -0.25, 0.9]) / np.linalg.norm([0.35, -0.25, 0.9])
_AMBIENT = 0.45
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class Quad:
    """A textured rectangle, seen from one side only: where ``edge_u_m`` points right and ``edge_v_m`` down.

    Attributes
    ----------
    corner_m
        (3,) upper left corner.
    edge_u_m, edge_v_m
        (3,) perpendicular; the texture's columns and rows run along them.
    texture
        (height, width, 3) linear light that the surface sends out.
    """

    corner_m: Array
    edge_u_m: Array
    edge_v_m: Array
    texture: Float32Array

    @cached_property
    def normal(self) -> Array:
        """(3,) unit normal, towards those who see it."""
        n = np.cross(self.edge_v_m, self.edge_u_m)
        return np.asarray(n / np.linalg.norm(n))


@dataclass(frozen=True, kw_only=True)
class Board:
    """A checkerboard to validate against."""

    columns: int = 8
    """Inner corners along a row."""
    rows: int = 6
    """Inner corners along a column."""
    square_m: float = 0.04
    """Side of a square."""

    def spec(self) -> str:
        """Description for the validator."""
        return f"checkerboard:{self.columns}x{self.rows}:{self.square_m:g}"


@dataclass(frozen=True, eq=False, kw_only=True)
class World:
    """Everything there is to see.

    Attributes
    ----------
    quads
        In no particular order.
    board
        The calibration target.
    board_corners_m
        (rows * columns, 3) its inner corners, row by row from the upper left.
    """

    quads: tuple[Quad, ...]
    board: Board
    board_corners_m: Array


class _Builder:
    """Collects quads; draws their textures from one stream."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.quads: list[Quad] = []

    def material(self) -> _Material:
        return textures.MATERIALS[self.rng.integers(len(textures.MATERIALS))]

    def quad(
        self, corner: Array, u: Array, v: Array, material: _Material | Float32Array, texel_m: float = 0.001
    ) -> None:
        """Add a rectangle, lit by the lamp; ``u`` right and ``v`` down as seen."""
        if callable(material):
            height, width = (max(8, round(float(np.linalg.norm(edge)) / texel_m)) for edge in (v, u))
            texture = material(self.rng, height, width)
        else:
            texture = material
        normal = np.cross(v, u)
        lit = max(0.0, float(normal @ _TO_LAMP) / float(np.linalg.norm(normal)))
        light = np.float32(_AMBIENT + (1 - _AMBIENT) * lit)
        self.quads.append(Quad(corner_m=corner, edge_u_m=u, edge_v_m=v, texture=texture * light))

    def box(self, base: Array, size: Array, yaw: float, material: _Material, texel_m: float = 0.001) -> None:
        """Add a box whose underside (left out) is centred on ``base``."""
        c, s = np.cos(yaw), np.sin(yaw)
        x, y, z = size[0] * np.array([c, s, 0.0]), size[1] * np.array([-s, c, 0.0]), size[2] * _UP
        low = base - (x + y) / 2
        self.quad(low + y + z, x, -y, material, texel_m)
        for corner, edge in ((low, x), (low + x, y), (low + x + y, -x), (low + y, -y)):
            self.quad(corner + z, edge, -z, material, texel_m)

    def tin(self, base: Array, radius: float, height: float, material: _Material, sides: int = 12) -> None:
        """Add an upright prism with one texture around it."""
        angle = 2 * np.pi * (np.arange(sides + 1) / sides + self.rng.uniform())
        ring = base + height * _UP + radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        columns = max(4, round(1000 * 2 * np.pi * radius / sides))
        around = material(self.rng, max(8, round(1000 * height)), columns * sides)
        for i in range(sides):
            strip = np.ascontiguousarray(around[:, i * columns : (i + 1) * columns])
            self.quad(ring[i], ring[i + 1] - ring[i], -height * _UP, strip)
        # the lid: bands between opposite sides cover the polygon; a tenth of a millimetre keeps them apart
        for i in range(sides // 2):
            edge, across = ring[i + 1] - ring[i], ring[i + sides // 2 + 1] - ring[i]
            self.quad(ring[i] + across + 1e-4 * (i - sides) * _UP, edge, -across, material)

    def board(self, board: Board, centre: Array, right: Array, down: Array) -> Array:
        """Add the checkerboard with a white margin of one square; returns its inner corners."""
        square_px = 40
        texture = textures.checkerboard(board.columns, board.rows, square_px, square_px)
        size = board.square_m * np.array([board.columns + 3, board.rows + 3])
        corner = centre - right * size[0] / 2 - down * size[1] / 2
        self.quad(corner, right * size[0], down * size[1], texture)
        self.quad(corner + right * size[0], -right * size[0], down * size[1], textures.plaster, 0.004)  # its back
        rows, columns = np.indices((board.rows, board.columns)).reshape(2, -1, 1)
        return np.asarray(corner + board.square_m * ((columns + 2) * right + (rows + 2) * down))

    def room(self, low: Array, high: Array, texel_m: float) -> None:
        """Floor, ceiling and four walls, seen from inside."""
        span = high - low
        x, y, z = np.diag(span)
        top = np.array([low[0], low[1], high[2]])
        self.quad(low + y, x, -y, textures.carpet, texel_m)
        self.quad(top, x, y, textures.plaster, 2 * texel_m)
        for corner, edge in ((top + y, x), (top + x + y, -y), (top + x, -x), (top, y)):
            self.quad(corner, edge, -z, textures.plaster, texel_m)

    def posters(self, low: Array, high: Array, count: int, texel_m: float) -> None:
        """Posters that hang a little off the walls, each in a place of its own along its wall."""
        slots = -(-count // 4)
        for i in range(count):
            wall, slot = i % 4, i // 4
            right = [(1.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (0.0, 1.0)][wall]
            start = [(low[0], high[1]), (high[0], high[1]), (high[0], low[1]), (low[0], low[1])][wall]
            along = np.array([*right, 0.0])
            inwards = np.cross(along, _UP)
            length = (high - low)[0 if wall % 2 == 0 else 1] / slots
            width, height = self.rng.uniform(0.45, 0.85) * length, self.rng.uniform(0.4, 0.9)
            left = np.array([*start, 0.0]) + along * (length * slot + self.rng.uniform(0.05, 0.95) * (length - width))
            top = (low[2] + high[2]) / 2 + self.rng.uniform(-0.5, 0.4) + height / 2
            gap = self.rng.uniform(0.01, 0.12)
            corner = left + inwards * gap + top * _UP
            self.quad(corner, along * width, -height * _UP, textures.poster, texel_m)


def _shadow(texture: Float32Array, footprints: list[Array], texel_m: float) -> Float32Array:
    """Darken a table top softly where things stand; footprints are polygons in metres from its upper left."""
    import cv2

    mask = np.zeros(texture.shape[:2], dtype=np.float32)
    for polygon in footprints:
        cv2.fillPoly(mask, [np.round(polygon / texel_m * 16).astype(np.int32)], 1.0, cv2.LINE_8, 4)
    mask = cv2.GaussianBlur(mask, (0, 0), 0.02 / texel_m)
    return np.asarray(texture * (1 - 0.5 * mask[..., None]), dtype=np.float32)


def _desk(builder: _Builder, board: Board) -> Array:
    rng = builder.rng
    low, high = map(np.array, WALLS_M["desk"])
    builder.room(low, high, 0.004)
    builder.posters(low, high, 12, 0.003)
    for i in range(10):  # furniture along the walls
        angle = 2 * np.pi * (i + rng.uniform(-0.3, 0.3)) / 10
        size = rng.uniform([0.4, 0.3, 0.3], [0.8, 0.6, 1.3])
        base = np.array([2.1 * np.cos(angle), 2.1 * np.sin(angle), low[2]])
        builder.box(base, size, angle + np.pi / 2, builder.material(), 0.003)

    top_z, half = -0.06, np.array([0.8, 0.55])
    tilt = np.deg2rad(30)
    board_centre = np.array([0.0, 0.1, top_z + 0.02 + np.sin(tilt) * board.square_m * (board.rows + 3) / 2])
    right, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, -np.cos(tilt), -np.sin(tilt)])
    corners = builder.board(board, board_centre, right, down)

    placed: list[tuple[float, float, float]] = [(0.0, 0.02, 0.62 * board.square_m * (board.columns + 3))]
    footprints: list[Array] = []
    for i in range(200):
        if len(placed) > 24:
            break
        size = rng.uniform([0.05, 0.05, 0.03], [0.17, 0.14, 0.22])
        at = rng.uniform(-half + 0.09, half - 0.09)
        if at[1] < -0.15:
            size[2] *= 0.3  # low in front, so that the board stays in view
        radius = 0.5 * float(np.hypot(size[0], size[1]))
        if any(np.hypot(at[0] - x, at[1] - y) < radius + r for x, y, r in placed):
            continue
        placed.append((at[0], at[1], radius))
        base, yaw = np.array([*at, top_z]), rng.uniform(0, np.pi)
        if i % 4 == 0:
            builder.tin(base, 0.4 * radius + 0.015, size[2] * 0.8 + 0.02, builder.material())
        else:
            builder.box(base, size, yaw, builder.material())
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [np.sin(yaw), -np.cos(yaw)]])
        outline = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size[:2] / 2
        footprints.append((at - np.array([-half[0], half[1]])) * np.array([1, -1]) + outline @ turn.T)
    for i in range(6):  # sheets of paper lying about
        yaw, at = rng.uniform(0, 2 * np.pi), rng.uniform(-half + 0.15, half - 0.15)
        c, s = np.cos(yaw), np.sin(yaw)
        u, v = 0.21 * np.array([c, s, 0.0]), 0.297 * np.array([s, -c, 0.0])
        builder.quad(np.array([*at, top_z + 5e-4 * (i + 1)]) - (u + v) / 2, u, v, textures.poster)
    texel_m = 0.001
    table = textures.wood(rng, round(2 * half[1] / texel_m), round(2 * half[0] / texel_m))
    x, y = np.array([2 * half[0], 0, 0]), np.array([0, 2 * half[1], 0])
    builder.quad(np.array([-half[0], half[1], top_z]), x, -y, _shadow(table, footprints, texel_m))
    builder.box(np.array([0.0, 0.0, low[2]]), np.array([1.2, 0.7, top_z - 0.03 - low[2]]), 0.0, textures.wood, 0.002)
    for edge, start in ((x, (-1, -1)), (y, (1, -1)), (-x, (1, 1)), (-y, (-1, 1))):
        corner = np.array([start[0] * half[0], start[1] * half[1], top_z])
        builder.quad(corner, edge, -0.04 * _UP, textures.wood)
    return corners


def _room(builder: _Builder, board: Board) -> Array:
    rng = builder.rng
    low, high = map(np.array, WALLS_M["room"])
    builder.room(low, high, 0.004)
    builder.posters(low, high, 20, 0.003)
    for i in range(14):
        angle = 2 * np.pi * (i + rng.uniform(-0.3, 0.3)) / 14
        size = rng.uniform([0.4, 0.3, 0.3], [0.9, 0.6, 1.6])
        base = np.array([2.75 * np.cos(angle), 2.4 * np.sin(angle), low[2]])
        builder.box(base, size, angle + np.pi / 2, builder.material(), 0.002)
        if i % 2:  # something on top
            top = base + size[2] * _UP
            builder.box(top, rng.uniform(0.1, 0.25, 3), rng.uniform(0, np.pi), builder.material())
    right, down = np.array([1.0, 0.0, 0.0]), -_UP
    return builder.board(board, np.array([0.0, 1.9, 0.0]), right, down)


def make_world(kind: WorldKind, seed: int, board: Board | None = None) -> World:
    """Build a world.

    Parameters
    ----------
    kind
        desk: a table of 1.6 x 1.1 m around the origin with about 30 things on it, in a room of 5 x 5 m; made for an
        orbit of 1 to 1.5 m radius. room: 6.4 x 5.6 m, empty in the middle, the origin at eye height.
    seed
        Same kind, seed and board, same world.
    board
        ``None`` is 8 x 6 corners of 40 mm (desk) or 80 mm (room).
    """
    builder = _Builder(np.random.default_rng(seed))
    board = board or Board(square_m=0.04 if kind == "desk" else 0.08)
    corners = {"desk": _desk, "room": _room}[kind](builder, board)
    return World(quads=tuple(builder.quads), board=board, board_corners_m=corners)
