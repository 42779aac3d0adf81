"""Finds calibration targets in images: corners with their numbers, in COLMAP's pixel coordinates.

Corners where black fields meet diagonally (checkerboard, ChArUco, AprilGrid) are refined to the point from which all
grey-value gradients around look sideways (Foerstner & Guelch 1987, as OpenCV's ``cornerSubPix``): blur and gamma shift
both edges alike there, and the point stays. On sharp rendered boards this is several times closer to the truth than
the sector-based detector's own corners, which serve to find and number them.

The corner of a lone black square has white on three sides: a blurred image recorded with a gamma curve shifts both of
its edges outwards or inwards, and the marker measures up to a few per cent too small or too large. So single markers
are measured by all black-white edges of their code, which run both ways: one homography and one common shift of all
edges towards white are fitted (:func:`refine_marker`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, Float32Array, IndexArray, UInt8Array
from colmap_inertial.core.geometry import colmap_px_from_opencv
from colmap_inertial.validate.targets import Target


@dataclass(frozen=True, kw_only=True)
class DetectionLimits:
    """Limits of the detection of targets in an image."""

    #: Checkerboards are searched in images whose longer side is at most this long, and refined in the original.
    search_size_px: int = 1600
    #: Boards that are looked for in one image.
    most_boards: int = 3
    smallest_marker_px: float = 12.0
    #: A pose needs three corners; a fourth one checks it.
    least_corners: int = 4
    #: Edges of a lone marker: profiles across them, sampled this finely, at least for cells of this size.
    profile_step_px: float = 0.25
    least_cell_px: float = 3.0
    edge_iterations: int = 4
    #: Grey values that an edge must rise by.
    least_contrast: float = 8.0
    #: Half step of the numeric derivative of the projection, as an angle.
    derivative_step_rad: float = 1e-4
    #: A corner whose ray is projected further off than this cannot be used.
    round_trip_px: float = 0.05


DETECTION = DetectionLimits()

_ALONG = np.array([0.2, 0.35, 0.5, 0.65, 0.8])


def refine_marker(image: UInt8Array, corners_px: Array, bits: BoolArray) -> Array | None:
    """The four outer corners of a marker.

    Parameters
    ----------
    image
        (H, W) grey values.
    corners_px
        (4, 2) first guess, OpenCV's pixels, clockwise from the marker's upper left, within about half a cell.
    bits
        (n, n) the marker's cells, black border included; true is white.

    Returns
    -------
    (4, 2) corners, OpenCV's pixels; ``None`` where cells are smaller than 3 pixels or edges too weak.
    """
    import cv2

    n = len(bits)
    square = np.array([[0, 0], [n, 0], [n, n], [0, n]], dtype=np.float64)
    start, white = _sample_cell_edges(bits)
    homography = cv2.getPerspectiveTransform(square.astype(np.float32), corners_px.astype(np.float32))
    homography = np.asarray(homography, dtype=np.float64)
    grey = image.astype(np.float32)
    for _ in range(DETECTION.edge_iterations):
        at = _project(homography, start)
        ahead = _project(homography, start + 0.5 * white) - _project(homography, start - 0.5 * white)
        along = np.stack([white[:, 1], -white[:, 0]], axis=1)
        tangent = _project(homography, start + 0.05 * along) - _project(homography, start - 0.05 * along)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal *= np.sign(np.sum(normal * ahead, axis=1, keepdims=True))
        cell_px = np.abs(np.sum(normal * ahead, axis=1))
        if np.median(cell_px) < DETECTION.least_cell_px:
            return None
        reach = float(np.clip(0.5 * np.median(cell_px), 1.5, 4.0))
        offset, contrast = _measure_offsets(grey, at, normal, reach)
        good = contrast > max(0.3 * float(np.median(contrast)), DETECTION.least_contrast)
        if good.sum() < 8 * 5:
            return None
        step = _fit_homography(homography, start, normal, offset, good)
        if step is None:
            return None
        homography = homography + step
    return _project(homography, square)


def _project(homography: Array, xy: Array) -> Array:
    p = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ homography.T
    return p[:, :2] / p[:, 2:]


def _sample_cell_edges(bits: BoolArray) -> tuple[Array, Array]:
    """Sample points (m, 2) on the borders between unlike cells, and unit directions (m, 2) towards white."""
    padded = np.pad(bits, 1, constant_values=True).astype(int)
    points, towards = [], []
    for axis in (0, 1):  # 0: neighbours above and below, edges run along x
        step = np.diff(padded, axis=axis)
        for i, j in np.argwhere(step != 0):
            sign = float(step[i, j])
            for t in _ALONG:
                points.append((j - 1 + t, i) if axis == 0 else (j, i - 1 + t))
                towards.append((0.0, sign) if axis == 0 else (sign, 0.0))
    return np.array(points, dtype=np.float64), np.array(towards)


def _measure_offsets(image: Float32Array, at: Array, normal: Array, reach: float) -> tuple[Array, Array]:
    """Distance (m,) from each point along its normal to the centre of the brightening there, and its height (m,)."""
    import cv2

    along = np.arange(-reach, reach + 0.5 * DETECTION.profile_step_px, DETECTION.profile_step_px)
    xy = at[:, None, :] + along[:, None] * normal[:, None, :]
    profile = cv2.remap(
        image,
        xy[..., 0].astype(np.float32),
        xy[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float64)
    rise = np.maximum(np.diff(profile, axis=1), 0.0)
    height = rise.sum(axis=1)
    middle = 0.5 * (along[1:] + along[:-1])
    return (rise @ middle) / np.maximum(height, 1e-9), height


def _fit_homography(homography: Array, xy: Array, normal: Array, offset: Array, good: BoolArray) -> Array | None:
    """Change (3, 3) of the homography that takes the edges to where they were seen, up to one common shift."""
    p = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    q = p @ homography.T
    u = q[:, :2] / q[:, 2:]
    rows = np.zeros((len(xy), 9))
    rows[:, :3] = normal[:, :1] * p / q[:, 2:]
    rows[:, 3:6] = normal[:, 1:] * p / q[:, 2:]
    rows[:, 6:8] = -np.sum(normal * u, axis=1, keepdims=True) * p[:, :2] / q[:, 2:]
    rows[:, 8] = 1.0  # the common shift towards white; the homography's last entry stays as it is
    for _ in range(2):
        solution, _, rank, _ = np.linalg.lstsq(rows[good], offset[good], rcond=1e-12)
        if rank < 9:
            return None
        residual = np.abs(offset - rows @ solution)
        good = good & (residual < 4 * max(1.4826 * float(np.median(residual[good])), 0.02))
        if good.sum() < 20:
            return None
    return np.append(solution[:8], 0.0).reshape(3, 3)


@dataclass(frozen=True, eq=False, kw_only=True)
class Detection:
    """One target, or a part of one, found in an image.

    Attributes
    ----------
    part
        The rigid part (see :class:`~colmap_inertial.validate.targets.Target`).
    corner
        (n,) numbers of the corners that were found, no number twice.
    xy_px
        (n, 2) where, COLMAP's pixel coordinates.
    """

    part: int
    corner: IndexArray
    xy_px: Array


def detect(image: UInt8Array, target: Target, *, thorough: bool = False) -> list[Detection]:
    """Find a target in an image.

    Parameters
    ----------
    image
        (H, W) grey values.
    target
        What to look for.
    thorough
        For checkerboards: when the quick search finds nothing, search exhaustively and then with OpenCV's classic
        detector; when it finds one, look for further boards. Slow where there is no board.

    Returns
    -------
    Every board or marker that was found. A checkerboard's numbering may start at the corner that
    ``Target.relabelings`` lists instead of the true one; two detections may show the same object only in a target of
    single markers or where the image holds several copies of a board.
    """
    if target.kind == "checkerboard":
        return list(_detect_checkerboards(image, target, thorough))
    if target.kind == "charuco":
        return _detect_charuco(image, target)
    if target.kind == "aprilgrid":
        return _detect_aprilgrid(image, target)
    return _detect_markers(image, target)


def find_any_checkerboard(image: UInt8Array) -> tuple[tuple[int, int], Array] | None:
    """The largest checkerboard in an image, whatever its size, to help with a wrong description.

    Parameters
    ----------
    image
        (H, W) grey values.

    Returns
    -------
    size
        Inner corners, columns and rows.
    xy_px
        (n, 2) the corners, COLMAP's pixel coordinates.
    """
    import cv2

    small, factor = _shrink(image)
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), cv2.CALIB_CB_LARGER)
    if not found or meta is None:
        return None
    xy = (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / factor - 0.5
    return (int(meta.shape[1]), int(meta.shape[0])), colmap_px_from_opencv(xy)


def _detect_checkerboards(image: UInt8Array, target: Target, thorough: bool) -> Iterator[Detection]:
    import cv2

    small, factor = _shrink(image)
    small = small.copy()
    for number in range(DETECTION.most_boards if thorough else 1):
        corners = _find_checkerboard(small, target, fallback=thorough and number == 0)
        if corners is None:
            return
        xy = (corners.astype(np.float64) + 0.5) / factor - 0.5
        grid = xy.reshape(target.rows, target.columns, 2)
        refined, good = _refine(image, xy, 0.4 * _spacing_px(grid).ravel(), allowed_px=1.0 / factor)
        if good.sum() >= 6:
            yield _make_detection(np.arange(len(xy)), refined, good)
        # paint over what was found, squares outside the inner corners included, and look again
        hull = cv2.convexHull(corners.reshape(-1, 1, 2)).reshape(-1, 2)
        centre = hull.mean(axis=0)
        grown = centre + (hull - centre) * (1 + 2.5 / (min(target.columns, target.rows) - 1))
        cv2.fillConvexPoly(small, np.round(grown).astype(np.int32), float(np.median(small)))


def _make_detection(corner: IndexArray, xy: Array, good: BoolArray) -> Detection:
    return Detection(part=0, corner=corner[good], xy_px=colmap_px_from_opencv(xy[good]))


def _shrink(image: UInt8Array) -> tuple[UInt8Array, float]:
    import cv2

    factor = min(1.0, DETECTION.search_size_px / max(image.shape))
    if factor == 1.0:
        return image, 1.0
    size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA), size[0] / image.shape[1]


def _find_checkerboard(image: UInt8Array, target: Target, *, fallback: bool) -> Float32Array | None:
    """(N, 2) corners in OpenCV's pixels, row by row; ``None`` when there is no board."""
    import cv2

    size = (target.columns, target.rows)
    if min(image.shape) < 2 * min(size):
        return None
    found, corners = cv2.findChessboardCornersSB(image, size, flags=0)
    if not found and fallback:
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
    if not found and fallback:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        found, corners = cv2.findChessboardCorners(image, size, flags=flags)
    # OpenCV 4 gives (N, 1, 2), OpenCV 5 (N, 2)
    return np.asarray(corners, dtype=np.float32).reshape(-1, 2) if found else None


def _spacing_px(grid: Array) -> Array:
    """Distance of each corner of a grid (R, C, 2) to its nearest neighbour along the lines; nan where missing."""
    out = np.full(grid.shape[:2], np.inf)
    for view, steps in ((out, grid), (out.T, grid.swapaxes(0, 1))):
        step = np.nan_to_num(np.linalg.norm(np.diff(steps, axis=0), axis=2), nan=np.inf, posinf=np.inf)
        for side in (view[:-1], view[1:]):
            np.minimum(side, step, out=side)
    return out


def _refine(image: UInt8Array, xy: Array, half_px: Array, *, allowed_px: float) -> tuple[Array, BoolArray]:
    """Corners (n, 2) in OpenCV's pixels refined within windows of these half sizes, and which of them are good.

    Good are those that stay within ``allowed_px`` of the first guess, and within their window.
    """
    import cv2

    half = np.clip(np.nan_to_num(half_px, posinf=4.0), 2, 12).astype(int)
    # a corner on which the search gives up is put back to exactly where it began: begin beside every fixed point
    start = xy.astype(np.float32) + np.float32(1 / 32)
    out = start.copy()
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    height, width = image.shape
    inside = ((xy > half[:, None] + 1) & (xy < np.array([width, height]) - half[:, None] - 2)).all(axis=1)
    for size in np.unique(half[inside]):
        pick = inside & (half == size)
        done = cv2.cornerSubPix(image, start[pick].reshape(-1, 1, 2), (int(size), int(size)), (-1, -1), criteria)
        out[pick] = np.asarray(done).reshape(-1, 2)
    moved = np.abs(out - start).max(axis=1)
    return out.astype(np.float64), inside & (moved > 0) & (moved <= np.minimum(allowed_px, half))


def _detector(target: Target, border_bits: int, image: UInt8Array) -> Any:
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    # OpenCV's limit is a share of the image's size; markers of a dozen pixels can be read in large images too
    rate = 4 * DETECTION.smallest_marker_px / max(image.shape)
    parameters.minMarkerPerimeterRate = min(parameters.minMarkerPerimeterRate, rate)
    return cv2.aruco.ArucoDetector(_dictionary(target), parameters)


def _dictionary(target: Target) -> Any:
    import cv2

    # OpenCV writes the families of AprilTags and of MIP with a small h
    name = target.dictionary.replace("36H", "36h").replace("25H", "25h").replace("16H", "16h")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def _find_markers(image: UInt8Array, target: Target, border_bits: int, count: int) -> tuple[Array, IndexArray]:
    """Corners (n, 4, 2) in OpenCV's pixels and numbers (n,) of the markers below ``count``."""
    quads, numbers, _ = _detector(target, border_bits, image).detectMarkers(image)
    if numbers is None or len(numbers) == 0:
        return np.zeros((0, 4, 2)), np.zeros(0, dtype=np.intp)
    corners, number = np.array(quads, dtype=np.float64).reshape(-1, 4, 2), np.asarray(numbers).ravel().astype(np.intp)
    keep = (number < count) & (_side_px(corners) >= DETECTION.smallest_marker_px)
    return corners[keep], number[keep]


def _side_px(corners: Array) -> Array:
    """(n,) shortest sides of quadrilaterals (n, 4, 2)."""
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(axis=1)


def _split_copies(corners: Array, number: IndexArray, layout_m: Array) -> list[IndexArray]:
    """Indices of the markers of each copy of a board, where an image shows several.

    Markers are gathered by growing from one to its neighbours on the board: the homography of those gathered says
    where the next should be.

    Parameters
    ----------
    corners
        (n, 4, 2) markers in the image.
    number
        (n,) their numbers; without repetition all belong to one board.
    layout_m
        (K, 4, 2) corners of each marker on the board.
    """
    import cv2

    if len(np.unique(number)) == len(number):
        return [np.arange(len(number))] if len(number) else []
    centre_m = layout_m.mean(axis=1)
    reach = 3 * np.median(np.linalg.norm(layout_m[:, 1] - layout_m[:, 0], axis=1))
    remaining, out = set(range(len(number))), []
    while remaining:
        group = [min(remaining)]
        remaining -= set(group)
        while True:
            source, image = layout_m[number[group]].reshape(-1, 2), corners[group].reshape(-1, 2)
            homography = cv2.findHomography(source, image)[0]
            best: tuple[float, int] | None = None
            for i in remaining:
                near = np.linalg.norm(centre_m[number[group]] - centre_m[number[i]], axis=1).min()
                if homography is None or number[i] in number[group] or near > reach:
                    continue
                expected = cv2.perspectiveTransform(layout_m[number[i]][None], homography)[0]
                miss = float(np.abs(expected - corners[i]).max()) / _side_px(corners[i : i + 1])[0]
                if miss < 0.5 and (best is None or near * (1 + miss) < best[0]):
                    best = (near * (1 + miss), i)
            if best is None:
                break
            group.append(best[1])
            remaining.discard(best[1])
        out.append(np.array(group))
    return out


def _detect_aprilgrid(image: UInt8Array, target: Target) -> list[Detection]:
    corners, number = _find_markers(image, target, 2, target.columns * target.rows)
    # OpenCV numbers a tag's corners clockwise from its upper left, and reads Kalibr's tags turned by 90 degrees
    corners = corners[:, [1, 0, 3, 2]]
    layout_m = target.corners_m[:, :2].reshape(-1, 4, 2)
    out = []
    for pick in _split_copies(corners, number, layout_m):
        # the nearest other corners: the tag's code (two of its ten cells away) and the far side of the black square
        half = np.repeat(0.9 * min(0.2, target.gap) * _side_px(corners[pick]), 4)
        xy, good = _refine(image, corners[pick].reshape(-1, 2), half, allowed_px=np.inf)
        which = (4 * number[pick][:, None] + np.arange(4)).ravel()
        if good.sum() >= 4:
            out.append(_make_detection(which, xy, good))
    return out


def _detect_charuco(image: UInt8Array, target: Target) -> list[Detection]:
    import cv2

    markers = target.columns * target.rows // 2
    corners, number = _find_markers(image, target, 1, markers)
    out = []
    for legacy in (False, True):
        board = cv2.aruco.CharucoBoard(
            (target.columns, target.rows), target.length_m, target.marker_m, _dictionary(target)
        )
        # boards with an even number of rows made before OpenCV 4.6 begin with a white square
        board.setLegacyPattern(legacy)
        detector = cv2.aruco.CharucoDetector(board)
        layout_m = np.array(board.getObjPoints(), dtype=np.float64)[:, :, :2]
        for pick in _split_copies(corners, number, layout_m):
            quads = [corners[i].astype(np.float32).reshape(1, 4, 2) for i in pick]
            xy, numbers, _, _ = detector.detectBoard(
                image, markerCorners=quads, markerIds=number[pick].astype(np.int32).reshape(-1, 1)
            )
            if numbers is None or len(numbers) < 4:
                continue
            which = np.asarray(numbers).ravel().astype(np.intp)
            start = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
            grid = np.full((target.rows - 1, target.columns - 1, 2), np.nan)
            grid.reshape(-1, 2)[which] = start
            spacing = _spacing_px(grid).ravel()[which]
            # the window must stay clear of the markers inside the white squares
            half = spacing * min(0.4, 0.45 * (1 - target.marker_m / target.length_m))
            refined, good = _refine(image, start, half, allowed_px=2.0)
            if good.sum() >= 4:
                out.append(_make_detection(which, refined, good))
        if out or target.rows % 2:
            break
    return out


def _detect_markers(image: UInt8Array, target: Target) -> list[Detection]:
    corners, number = _find_markers(image, target, 1, len(target.part) // 4)
    dictionary = _dictionary(target)
    out = []
    for quad, marker in zip(corners, number.tolist(), strict=True):
        bits = dictionary.generateImageMarker(marker, dictionary.markerSize + 2) > 127
        refined = refine_marker(image, quad, bits)
        if refined is not None:
            out.append(Detection(part=marker, corner=4 * marker + np.arange(4), xy_px=colmap_px_from_opencv(refined)))
    return out
