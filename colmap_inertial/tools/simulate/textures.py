"""Procedural textures: linear-light RGB, rich in features at many scales, never twice the same.

Every function takes a random generator and a size in texels and returns a (height, width, 3) float32 array of
reflectances between 0 and 1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from colmap_inertial.core.arrays import Float32Array


def clouds(
    rng: np.random.Generator, height: int, width: int, *, coarsest_px: float, octaves: int, stretch: float = 1.0
) -> Float32Array:
    """(height, width) sum of smooth random fields of halving size, zero mean, unit standard deviation.

    Parameters
    ----------
    coarsest_px
        Grain of the first octave.
    stretch
        Grain along a row relative to that along a column.
    """
    import cv2

    out = np.zeros((height, width), dtype=np.float32)
    for octave in range(octaves):
        grain = max(coarsest_px / 2**octave, 1.0)
        rows, columns = int(height / grain) + 3, int(width / (grain * stretch)) + 3
        field = rng.standard_normal((rows, columns)).astype(np.float32)
        out += 0.65**octave * cv2.resize(field, (width, height), interpolation=cv2.INTER_CUBIC)
    return (out - out.mean()) / max(float(out.std()), 1e-6)


def _colour(rng: np.random.Generator, low: float = 0.03, high: float = 0.85) -> Float32Array:
    """A random reflectance: brightness uniform in perceived lightness, some saturation."""
    lightness = rng.uniform(low**0.45, high**0.45) ** (1 / 0.45)
    tint = np.exp(rng.normal(0, 0.35, 3))
    return np.minimum(np.maximum(lightness * tint / tint.mean(), 0.02), 0.92).astype(np.float32)


def _mix(a: Float32Array, b: Float32Array, weight: Float32Array) -> Float32Array:
    w = np.clip(weight, 0, 1)[..., None]
    out = a * (1 - w)
    out += b * w
    return np.asarray(out, dtype=np.float32)


def _shapes(rng: np.random.Generator, image: Float32Array, count: int, smallest_px: float, largest_px: float) -> None:
    """Draw random polygons, ellipses and strokes, sizes uniform in their logarithm, large ones first."""
    import cv2

    height, width = image.shape[:2]
    for size in np.sort(np.exp(rng.uniform(np.log(smallest_px), np.log(largest_px), count)))[::-1]:
        centre = rng.uniform([0, 0], [width, height])
        colour = [float(c) for c in _colour(rng)]
        kind = rng.integers(4)
        if kind < 2:
            n = int(rng.integers(3, 7))
            angle = np.sort(rng.uniform(0, 2 * np.pi, n))
            radius = size * rng.uniform(0.4, 1.0, n)
            points = centre + np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
            cv2.fillPoly(image, [np.round(points * 16).astype(np.int32)], colour, cv2.LINE_8, 4)
        elif kind == 2:
            axes = np.maximum(size * rng.uniform(0.3, 1.0, 2), 1).round().astype(int)
            c = centre.round().astype(int)
            turn, thickness = float(rng.uniform(0, 180)), -1 if rng.random() < 0.6 else max(1, int(size / 5))
            cv2.ellipse(image, (int(c[0]), int(c[1])), (int(axes[0]), int(axes[1])), turn, 0, 360, colour, thickness)
        else:
            end = centre + rng.normal(0, 2 * size, 2)
            a, b = centre.round().astype(int), end.round().astype(int)
            cv2.line(image, (int(a[0]), int(a[1])), (int(b[0]), int(b[1])), colour, max(1, int(size / 6)))


def _draw_letters(rng: np.random.Generator, image: Float32Array, size_px: float) -> None:
    """A line of made-up letters: a few strokes each, between the points of a 3 x 4 grid."""
    import cv2

    height, width = image.shape[:2]
    colour = [float(c) for c in _colour(rng)]
    at = np.array([rng.uniform(-0.1, 0.7) * width, rng.uniform(0.0, 1.0) * height])
    for _ in range(int(rng.integers(4, 16))):
        nodes = at + rng.integers(0, [3, 4], (int(rng.integers(3, 6)), 2)) * np.array([0.25, 0.33]) * size_px
        stroke = [np.round(nodes * 16).astype(np.int32)]
        cv2.polylines(image, stroke, bool(rng.random() < 0.3), colour, max(1, int(size_px / 8)), cv2.LINE_8, 4)
        at = at + np.array([0.75 * size_px, 0.0])


def poster(rng: np.random.Generator, height: int, width: int) -> Float32Array:
    """Printed paper: shapes of all sizes and lines of letters."""
    image = _mix(
        _colour(rng, 0.2), _colour(rng, 0.2), 0.5 + 0.3 * clouds(rng, height, width, coarsest_px=width / 2, octaves=3)
    )
    _shapes(rng, image, int(40 + height * width / 1500), 3, max(3.0, min(height, width) / 4))
    for _ in range(int(2 + height / 60)):
        _draw_letters(rng, image, size_px=float(np.exp(rng.uniform(np.log(8), np.log(max(10, height / 9))))))
    return image


def terrazzo(rng: np.random.Generator, height: int, width: int) -> Float32Array:
    """Stone chips in cement."""
    base = _colour(rng, 0.15, 0.6)
    image = _mix(
        base * 0.8, np.minimum(base * 1.2, 0.95), 0.5 + 0.25 * clouds(rng, height, width, coarsest_px=40, octaves=6)
    )
    _shapes(rng, image, int(height * width / 250), 2, 16)
    return image


def wood(rng: np.random.Generator, height: int, width: int) -> Float32Array:
    """Grain along the rows, with rings, knots, scratches and stains."""
    dark = np.array([0.13, 0.06, 0.03], dtype=np.float32) * np.float32(rng.uniform(0.7, 1.6))
    light = np.array([0.50, 0.30, 0.16], dtype=np.float32) * np.float32(rng.uniform(0.8, 1.3))
    warp = clouds(rng, height, width, coarsest_px=height / 3, octaves=4, stretch=4.0)
    rings = np.sin(np.arange(height, dtype=np.float32)[:, None] / height * 60 + 5 * warp)
    fibre = clouds(rng, height, width, coarsest_px=6, octaves=3, stretch=12.0)
    blotch = clouds(rng, height, width, coarsest_px=24, octaves=5)
    image = _mix(dark, light, 0.5 + 0.18 * rings + 0.15 * fibre + 0.15 * blotch)
    _shapes(rng, image, int(height * width / 6000), 2, 10)
    return np.clip(image, 0.02, 0.92)


def fabric(rng: np.random.Generator, height: int, width: int) -> Float32Array:
    """A tartan of threads of random widths, worn and stained."""

    def threads(n: int) -> Float32Array:
        widths = rng.integers(2, 24, n)
        colours = np.stack([_colour(rng) for _ in range(n)])
        return np.repeat(colours, widths, axis=0)[:n].astype(np.float32)

    image = 0.5 * (threads(width)[None] + threads(height)[:, None])
    image *= np.exp(0.25 * clouds(rng, height, width, coarsest_px=60, octaves=7))[..., None]
    return np.clip(image, 0.02, 0.92).astype(np.float32)


def marble(rng: np.random.Generator, height: int, width: int) -> Float32Array:
    """Veins through a warped field."""
    warp = clouds(rng, height, width, coarsest_px=max(height, width) / 4, octaves=7)
    veins = np.exp(-6 * np.abs(np.sin(2.5 * warp + clouds(rng, height, width, coarsest_px=80, octaves=5))))
    image = _mix(_colour(rng, 0.3, 0.85), _colour(rng, 0.03, 0.3), 0.85 * veins.astype(np.float32))
    image *= np.exp(0.12 * clouds(rng, height, width, coarsest_px=20, octaves=4))[..., None]
    return np.clip(image, 0.02, 0.92).astype(np.float32)


def plaster(rng: np.random.Generator, height: int, width: int) -> Float32Array:
    """A wall: faint blotches at all scales, specks, a few cracks."""
    image = np.ones((height, width, 3), dtype=np.float32) * _colour(rng, 0.3, 0.7)
    image *= np.exp(0.18 * clouds(rng, height, width, coarsest_px=200, octaves=8))[..., None]
    _shapes(rng, image, int(height * width / 5000), 1.5, 8)
    return np.clip(image, 0.02, 0.92)


def carpet(rng: np.random.Generator, height: int, width: int) -> Float32Array:
    """Blotches of a few colours with a fine pile."""
    image = np.broadcast_to(_colour(rng, 0.08, 0.3), (height, width, 3)).astype(np.float32)
    for _ in range(4):
        image = _mix(image, _colour(rng), 3 * clouds(rng, height, width, coarsest_px=70, octaves=5) - 2)
    image *= np.exp(0.25 * clouds(rng, height, width, coarsest_px=5, octaves=3))[..., None]
    return np.clip(image, 0.02, 0.92)


def checkerboard(columns: int, rows: int, square_px: int, margin_px: int) -> Float32Array:
    """A board of ``columns`` x ``rows`` inner corners with a white margin; its edges lie between texels."""
    v, u = np.indices(((rows + 1) * square_px, (columns + 1) * square_px)) // square_px
    board = np.where((u + v) % 2 == 0, 0.07, 0.8)
    image = np.pad(board, margin_px, constant_values=0.8)
    return np.repeat(image[..., None], 3, axis=2).astype(np.float32)


MATERIALS: tuple[Callable[[np.random.Generator, int, int], Float32Array], ...] = (
    poster,
    terrazzo,
    wood,
    fabric,
    marble,
    carpet,
)
