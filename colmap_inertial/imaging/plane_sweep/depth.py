"""Depth of one image: partners are turned to its orientation, where a plane's depth moves and shrinks them.

Coarse to fine: depths at half the size say which candidates each part of the image needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, Int32Array, UInt8Array
from colmap_inertial.core.threads import map_in_order, usable_processors
from colmap_inertial.imaging.plane_sweep.pinhole import Pinhole
from colmap_inertial.imaging.plane_sweep.tiles import Tile, cut_tiles
from colmap_inertial.imaging.semi_global import Views, match_candidates


@dataclass(frozen=True, kw_only=True)
class SweepLimits:
    """Candidates and comparisons of a plane sweep."""

    #: Between two candidates a thing moves by this much in the partner where it moves most.
    step_px: float = 1.0
    #: Candidates, at least,
    least_candidates: int = 16
    #: and at most.
    most_candidates: int = 512
    #: Census passes over comparisons of codes that differ by less: noise and JPEG decide them.
    least_codes: int = 2
    #: A turned view is at most so much larger than the reference: beyond, it is stretched more than it shows.
    largest: float = 1.6
    #: A partner that stands this close to a plane, as a share of its depth, does not see it well.
    closest: float = 0.2
    #: With fewer candidates than these, to look at half the size first saves nothing.
    many_candidates: int = 64
    #: Points of a side of the grid by which the part of a view that is needed is found.
    grid: int = 33


_LIMITS = SweepLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Partner:
    """Another image that sees some of the same.

    Attributes
    ----------
    codes
        (H, W) grey values.
    camera
        What took it.
    """

    codes: UInt8Array
    camera: Pinhole


@dataclass(frozen=True, eq=False, kw_only=True)
class _Canvas:
    """A partner's view turned to the reference's orientation: pixel (u, v) of it is (u + left, v + top) there."""

    left: int
    top: int
    width: int
    height: int
    canvas_from_view: Array
    baseline: Array


def sweep_depth(
    codes: UInt8Array, camera: Pinhole, partners: Sequence[Partner], depths: tuple[float, float], *, threads: int
) -> Float32Array:
    """Find what depth each pixel has.

    Parameters
    ----------
    codes
        (H, W) grey values of the reference.
    camera
        What took it.
    partners
        Images to compare with, at least one.
    depths
        Nearest and farthest, in the model's unit.
    threads
        0 takes all processors.

    Returns
    -------
    (H, W) depths; 0 where the best candidate is one of the ends: it may lie beyond.

    Notes
    -----
    Planes parallel to the image, equally spaced in inverse depth (Collins, CVPR 1996). Once a partner is turned to
    the reference's orientation, a plane moves and shrinks its image, so that columns and rows are looked up apart.
    Costs (census) are summed over the partners that see all of a window, and the depths found by semi-global matching.
    Of many candidates, each tile of the image is matched with those that its depths at half the size leave.
    """
    sweep = _Sweep.of(codes, camera, partners, depths)
    if sweep is None:
        return np.zeros(codes.shape, dtype=np.float32)
    if len(sweep.inverse) < _LIMITS.many_candidates:
        return sweep.depth(threads)
    halves = [Partner(codes=_halve_codes(p.codes), camera=_halve_camera(p.camera)) for p in partners]
    half = _Sweep.of(_halve_codes(codes), _halve_camera(camera), halves, depths)
    if half is None:
        return sweep.depth(threads)
    coarse = half.depth(threads)
    with np.errstate(divide="ignore"):
        place = (1 / coarse.astype(np.float64) - sweep.inverse[0]) / (sweep.inverse[1] - sweep.inverse[0])
    tiles = list(cut_tiles(np.where(coarse > 0, place, np.nan), (camera.height, camera.width), len(sweep.inverse)))
    inverse = np.empty(codes.shape, dtype=np.float32)
    parts = map_in_order(sweep.of_tile, tiles, workers=threads or usable_processors())
    for tile, part in zip(tiles, parts, strict=True):
        inverse[tile.inner_rows, tile.inner_columns] = part[tile.kept]
    return inverse


@dataclass(frozen=True, eq=False, kw_only=True)
class _Sweep:
    """All that is compared: views, and where the reference's columns and rows lie in them for each candidate."""

    views: Views
    inverse: Array
    columns: Int32Array
    rows: Int32Array

    @classmethod
    def of(
        cls, codes: UInt8Array, camera: Pinhole, partners: Sequence[Partner], depths: tuple[float, float]
    ) -> _Sweep | None:
        """``None`` where no partner shows anything of it."""
        near, far = depths
        turned = [(canvas, p) for p in partners if (canvas := _make_canvas(camera, p.camera, depths)) is not None]
        if not turned:
            return None
        inverse = _choose_candidates(camera, [canvas.baseline for canvas, _ in turned], near, far)
        shape = max(canvas.height for canvas, _ in turned), max(canvas.width for canvas, _ in turned)
        others = np.zeros((len(turned), *shape), dtype=np.uint8)
        shown = np.zeros((len(turned), shape[0], 2), dtype=np.int32)
        columns = np.empty((len(turned), len(inverse), camera.width), dtype=np.int32)
        rows = np.empty((len(turned), len(inverse), camera.height), dtype=np.int32)
        for k, (canvas, partner) in enumerate(turned):
            others[k, : canvas.height, : canvas.width] = _turn_view(partner.codes, canvas)
            shown[k, : canvas.height] = _find_shown_columns(partner.codes.shape, canvas)
            columns[k] = _sample_positions(camera, canvas, inverse, 0)
            rows[k] = _sample_positions(camera, canvas, inverse, 1)
        views = Views(reference=codes, others=others, least=_LIMITS.least_codes, shown=shown)
        return cls(views=views, inverse=inverse, columns=columns, rows=rows)

    def depth(self, threads: int) -> Float32Array:
        """(H, W) of all candidates."""
        best, _ = match_candidates(self.views, self.columns, self.rows, threads=threads)
        return self._of(best, slice(0, len(self.inverse)))

    def of_tile(self, tile: Tile) -> Float32Array:
        """Depth of a tile and its margins, from its own candidates."""
        part = np.ascontiguousarray(self.views.reference[tile.rows, tile.columns])
        columns = np.ascontiguousarray(self.columns[:, tile.candidates, tile.columns])
        rows = np.ascontiguousarray(self.rows[:, tile.candidates, tile.rows])
        best, _ = match_candidates(replace(self.views, reference=part), columns, rows, threads=1)
        return self._of(best, tile.candidates)

    def _of(self, best: Float32Array, candidates: slice) -> Float32Array:
        """Depths of candidates, counted from the first of some; the best one at an end may lie beyond."""
        known = (best > 0) & (best < candidates.stop - candidates.start - 1)
        step = self.inverse[1] - self.inverse[0]
        inverse = self.inverse[0] + step * (best.astype(np.float64) + candidates.start)
        return np.where(known, 1 / inverse, 0).astype(np.float32)


def _halve_codes(codes: UInt8Array) -> UInt8Array:
    """An image at half its size."""
    import cv2

    height, width = codes.shape
    return np.asarray(cv2.resize(codes, (width // 2, height // 2), interpolation=cv2.INTER_AREA))


def _halve_camera(camera: Pinhole) -> Pinhole:
    """The camera of the image at half its size."""
    by = np.array([(camera.width // 2) / camera.width, (camera.height // 2) / camera.height])
    return replace(
        camera,
        width=camera.width // 2,
        height=camera.height // 2,
        focal_px=camera.focal_px * by,
        centre_px=(camera.centre_px + 0.5) * by - 0.5,
    )


def _choose_candidates(camera: Pinhole, baselines: Sequence[Array], near: float, far: float) -> Array:
    """(D,) inverse depths, the farthest first."""
    moves = [np.hypot(b[0], b[1]) + 0.5 * abs(b[2]) for b in baselines]
    count = float(camera.focal_px.max()) * max(moves) * (1 / near - 1 / far) / _LIMITS.step_px + 1
    return np.linspace(
        1 / far, 1 / near, int(np.clip(np.ceil(count), _LIMITS.least_candidates, _LIMITS.most_candidates))
    )


def _place_planes(camera: Pinhole, baseline: Array, inverse: Array, axis: int) -> tuple[Array, Array]:
    """(D, n) where columns (axis 0) or rows (1) of the reference lie in a turned view; (D, 1) how they shrink."""
    at = np.arange((camera.width, camera.height)[axis], dtype=np.float64)
    focal, centre = camera.focal_px[axis], camera.centre_px[axis]
    shrinks = 1 - inverse[:, None] * baseline[2]
    moved = at - centre - focal * inverse[:, None] * baseline[axis]
    return moved / np.maximum(shrinks, _LIMITS.closest) + centre, shrinks


def _make_canvas(camera: Pinhole, view: Pinhole, depths: tuple[float, float]) -> _Canvas | None:
    """Part of a view that shows what the reference sees between two depths; ``None`` where there is none."""
    baseline = camera.cam_from_world @ (view.cam_in_world - camera.cam_in_world)
    turn = camera.cam_from_world @ view.cam_from_world.T
    canvas_from_view = camera.matrix @ turn @ np.linalg.inv(view.matrix)
    inverse = np.linspace(1 / depths[1], 1 / depths[0], 9)
    ranges = []
    for axis in (0, 1):
        place, shrinks = _place_planes(camera, baseline, inverse, axis)
        place = place[shrinks[:, 0] >= _LIMITS.closest]
        if not place.size:
            return None
        ranges.append(np.linspace(place.min(), place.max(), _LIMITS.grid))
    # which of that the view has
    grid = (
        np.stack([*np.meshgrid(*ranges), np.ones((_LIMITS.grid, _LIMITS.grid))], axis=-1)
        @ np.linalg.inv(canvas_from_view).T
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = grid[..., 0] / grid[..., 2], grid[..., 1] / grid[..., 2]
    inside = (grid[..., 2] > 0) & (x >= 0) & (x <= view.width - 1) & (y >= 0) & (y <= view.height - 1)
    limits = []
    for axis, most in ((0, camera.width), (1, camera.height)):
        hit = np.flatnonzero(inside.any(axis=axis))
        if not len(hit):
            return None
        # a cell more on each side, as the border lies somewhere within
        low, high = ranges[axis][max(0, hit[0] - 1)], ranges[axis][min(_LIMITS.grid - 1, hit[-1] + 1)]
        excess = max(0.0, high - low - _LIMITS.largest * most) / 2
        limits.append((int(np.floor(low + excess)), int(np.ceil(high - excess))))
    (left, right), (top, bottom) = limits
    return _Canvas(
        left=left,
        top=top,
        width=right - left + 1,
        height=bottom - top + 1,
        canvas_from_view=np.array([[1.0, 0, -left], [0, 1, -top], [0, 0, 1]]) @ canvas_from_view,
        baseline=baseline,
    )


def _sample_positions(camera: Pinhole, canvas: _Canvas, inverse: Array, axis: int) -> Int32Array:
    """(D, n) columns or rows of the canvas in 1/16 px, outside of it where it has none."""
    start, size = ((canvas.left, canvas.width), (canvas.top, canvas.height))[axis]
    place, shrinks = _place_planes(camera, canvas.baseline, inverse, axis)
    # what a window reaches beyond the canvas is on its own side
    sixteenths = np.rint(16 * np.clip(place - start, -1, size))
    return np.where(shrinks >= _LIMITS.closest, sixteenths, -1).astype(np.int32)


def _turn_view(codes: UInt8Array, canvas: _Canvas) -> UInt8Array:
    import cv2

    size = (canvas.width, canvas.height)
    return np.asarray(cv2.warpPerspective(codes, canvas.canvas_from_view, size, flags=cv2.INTER_LINEAR))


def _find_shown_columns(shape: tuple[int, ...], canvas: _Canvas) -> Int32Array:
    """(H, 2) from and up to which column a canvas shows the view: turned, it is a quadrilateral there."""
    import cv2

    size = (canvas.width, canvas.height)
    # whole where all pixels count that a value lies between
    inside = cv2.warpPerspective(np.full(shape, 255, np.uint8), canvas.canvas_from_view, size, flags=cv2.INTER_LINEAR)
    inside = inside == 255
    begin, beyond = inside.argmax(axis=1), inside[:, ::-1].argmax(axis=1)
    return np.stack([begin, np.where(inside.any(axis=1), canvas.width - beyond, 0)], axis=1).astype(np.int32)
