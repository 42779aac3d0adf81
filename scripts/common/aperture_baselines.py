"""What multi-aperture fusion is measured by and against: no correction, pairs by themselves, OpenCV, graph cuts."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from colmap_inertial.core.arrays import AnyArray, Array, BoolArray, Float32Array, Int64Array, UInt8Array, UInt16Array
from colmap_inertial.core.options import ApertureOptions
from colmap_inertial.core.types import Aperture, ApertureRig
from colmap_inertial.imaging.multi_aperture import Disparity, Rectified, fuse_apertures, rectify
from colmap_inertial.imaging.multi_aperture.disparity import background
from colmap_inertial.imaging.multi_aperture.fusion import COLOURS, denoise_by_luminance
from colmap_inertial.model import colmap_camera

Planes = list[UInt8Array]


def canvas_of(rig: ApertureRig) -> Rectified:
    """The rig's canvas, with COLMAP's cameras."""
    return rectify(rig, [colmap_camera(aperture.camera) for aperture in rig.apertures])


def direct(planes: Planes, rig: ApertureRig) -> UInt8Array:
    """The colours on each other as they are."""
    roles = [aperture.role for aperture in rig.apertures]
    return np.stack([planes[roles.index(role)] for role in COLOURS], axis=-1)


def pairwise(planes: Planes, rig: ApertureRig, options: ApertureOptions) -> tuple[UInt8Array, list[Float32Array]]:
    """Each view matched with the reference alone, and warped by what that gives; all else as in the package.

    Also the disparities of each pair, in pixels between the reference and its partner.
    """
    found: dict[str, Float32Array] = {rig.reference.role: planes[0].astype(np.float32) / 255}
    maps = []
    partner = rig.apertures[1].cam_in_rig - rig.reference.cam_in_rig
    for plane, aperture in zip(planes[1:], rig.apertures[1:], strict=True):
        ratio = float(np.linalg.norm(aperture.cam_in_rig - rig.reference.cam_in_rig) / np.linalg.norm(partner))
        # the view twice, so that there are three colours: costs and penalties double, the result stays
        trio = [rig.reference, aperture, aperture]
        apertures = tuple(
            Aperture(**{**vars(a), "name": role, "role": role}) for a, role in zip(trio, COLOURS, strict=True)
        )
        limits = options.disparity_px
        of_pair = ApertureOptions(
            cost=options.cost,
            step_px=options.step_px,
            use_luminance=False,
            disparity_px=None if limits is None else (ratio * limits[0], ratio * limits[1]),
        )
        pair = ApertureRig(apertures=apertures)
        fused = fuse_apertures([planes[0], plane, plane], pair, canvas_of(pair), of_pair)
        found[aperture.role] = fused.image[..., 1].astype(np.float32) / 255
        maps.append(fused.disparity_px / ratio)
    colours = np.stack([found[role] for role in COLOURS], axis=-1)
    if options.use_luminance and "luminance" in found:
        colours = denoise_by_luminance(colours, found["luminance"])
    return np.clip(np.rint(255 * colours), 0, 255).astype(np.uint8), maps


def opencv_disparity(left: UInt8Array, right: UInt8Array, low_px: float, high_px: float) -> Float32Array:
    """StereoSGBM with eight paths, at the parameters of OpenCV's own sample; gaps as the package fills them."""
    first = int(np.floor(low_px)) - 1
    count = 16 * int(np.ceil((high_px + 2 - first) / 16))
    side = 5
    matcher = cv2.StereoSGBM_create(
        minDisparity=first,
        numDisparities=count,
        blockSize=side,
        P1=8 * side * side,
        P2=32 * side * side,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    # beyond the border there is nothing to compare: OpenCV leaves a strip as wide as the search
    reach = max(abs(first), abs(first + count)) + side
    padded = [cv2.copyMakeBorder(p, 0, 0, reach, reach, cv2.BORDER_REPLICATE) for p in (left, right)]
    found = matcher.compute(*padded)[:, reach:-reach].astype(np.float32) / 16
    return background(found, found >= first)


def as_disparity(disparity_px: Float32Array, views: int) -> Disparity:
    """Somebody else's disparities, everywhere visible."""
    everywhere = np.ones(disparity_px.shape, dtype=bool)
    return Disparity(disparity_px=disparity_px, measured=everywhere, visible=np.repeat(everywhere[None], views, axis=0))


def expansion_moves(
    cost: UInt8Array, guide: UInt8Array, *, small: int, jump: UInt16Array, cycles: int = 2
) -> Int64Array:
    """Labels by alpha-expansion (Boykov, Veksler, Zabih, PAMI 23(11), 2001) with scipy's maximum flow.

    The energy is that of semi-global matching, on the four neighbours: ``small`` for labels that differ by one,
    ``jump`` of the guide's difference for more. Terms that are not submodular are cut to what is (Rother et al., 2005).
    """
    height, width, labels = cost.shape
    index = np.arange(height * width).reshape(height, width)
    p = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    q = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    codes = guide.ravel().astype(int)
    # two neighbours each way, where the paths have eight: twice the penalty
    limit = 2 * jump[np.abs(codes[p] - codes[q])].astype(np.int64)
    data = cost.reshape(-1, labels).astype(np.int64)

    def pair(a: Int64Array, b: Int64Array) -> Int64Array:
        d = np.abs(a - b)
        return np.where(d == 0, 0, np.where(d == 1, 2 * small, np.maximum(limit, 2 * small)))

    labelling = data.argmin(axis=1)
    source, sink = height * width, height * width + 1
    for _ in range(cycles):
        for alpha in range(labels):
            to = np.full_like(p, alpha)
            keep, first, second = pair(labelling[p], labelling[q]), pair(to, labelling[q]), pair(labelling[p], to)
            keep = np.minimum(keep, first + second)
            # variable 1: takes alpha. E = keep (1-x)(1-y) + first x (1-y) + second (1-x) y
            unary = data[:, alpha] - data[np.arange(len(data)), labelling]
            np.add.at(unary, p, first - keep)
            np.add.at(unary, q, -first)
            edge = first + second - keep
            rows = np.concatenate([p, np.full(len(unary), source), np.arange(len(unary))])
            columns = np.concatenate([q, np.arange(len(unary)), np.full(len(unary), sink)])
            # edge: paid where p keeps its label and q takes alpha
            capacity = np.concatenate([edge, np.maximum(unary, 0), np.maximum(-unary, 0)])
            used = capacity > 0
            graph = coo_array(
                (capacity[used].astype(np.int32), (rows[used], columns[used])), shape=(sink + 1, sink + 1)
            ).tocsr()
            flow = maximum_flow(graph, source, sink).flow
            rest = graph - flow
            rest.data[rest.data < 0] = 0
            rest.eliminate_zeros()
            reached = np.zeros(sink + 1, dtype=bool)
            reached[breadth_first_order(rest, source, return_predecessors=False)] = True
            labelling = np.where(reached[:source], labelling, alpha)
    return labelling.reshape(height, width)


def psnr_db(a: AnyArray, b: AnyArray, mask: BoolArray | None = None) -> float:
    error = (a.astype(float) - b.astype(float)) ** 2
    return float(10 * np.log10(255**2 / (error if mask is None else error[mask]).mean()))


def read_pfm(path: Path) -> Array:
    with open(path, "rb") as file:
        if file.readline().strip() != b"Pf":
            raise ValueError(f"{path}: no grey PFM")
        width, height = map(int, file.readline().split())
        order = "<" if float(file.readline()) < 0 else ">"
        return np.fromfile(file, f"{order}f4").reshape(height, width)[::-1].astype(np.float64)


def warp_view(disparity: Array, dy: float, dx: float, tolerance: float) -> BoolArray:
    """Which pixels the view at (dx, dy) baselines sees, by the true disparity."""
    height, width = disparity.shape
    y, x = np.mgrid[:height, :width]
    u, v = x - dx * disparity, y - dy * disparity
    nearest = np.full(disparity.shape, -np.inf)
    for oy in (0, 1):
        for ox in (0, 1):
            i, j = np.floor(u).astype(int) + ox, np.floor(v).astype(int) + oy
            inside = (i >= 0) & (i < width) & (j >= 0) & (j < height)
            np.maximum.at(nearest, (j[inside], i[inside]), disparity[inside])
    i, j = np.rint(u).astype(int), np.rint(v).astype(int)
    inside = (i >= 0) & (i < width) & (j >= 0) & (j < height)
    seen = np.zeros(disparity.shape, dtype=bool)
    seen[inside] = disparity[inside] >= nearest[j[inside], i[inside]] - tolerance
    return seen
