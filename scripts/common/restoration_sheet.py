"""A picture to look at: crops of rendered scenes as filmed, restored, and as they truly are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from colmap_inertial.core.arrays import Float32Array, UInt8Array
from colmap_inertial.imaging import path_filters
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.restoration import Network
from colmap_inertial.imaging.restoration.lsd2 import fuse
from scripts.common.imaging_scenes import make_pairs
from scripts.common.restoration_deblur import usual_errors
from scripts.common.restoration_exposures import codes, expose

CROP_PX, GAP_PX, TITLE_PX = 320, 6, 26
BLURS_PX = (8.0, 14.0, 22.0, 30.0)
#: Blur of the long exposure, px, its time as a multiple of the short one's, and noise as in ``restoration_exposures``.
PAIRS = ((12.0, 8.0, 0.06), (20.0, 11.0, 0.1), (25.0, 16.0, 0.06))
#: So many walls make every row another scene.
SCENES = len(BLURS_PX) + len(PAIRS)


def write_sheet(
    file: Path,
    walls: Sequence[Float32Array],
    deblur: Callable[[UInt8Array, BlurField], UInt8Array] | None,
    lsd2: Network | None,
    *,
    size: tuple[int, int],
    seed: int,
) -> None:
    """A row for each scene; gyroscopes have the usual errors. What there is no network for is left out."""
    rows: list[tuple[list[str], list[UInt8Array]]] = []
    errors = usual_errors(SCENES, seed)
    for i, blur_px in enumerate(BLURS_PX if deblur else ()):
        pair = make_pairs([walls[i % len(walls)]], blur_px, size=size, seed=seed + 100 + i)[0]
        image, blur, truth = pair.frame(0), pair.blur(0, errors[i]), pair.sharp(0)
        assert deblur is not None
        pictures = [image, path_filters.deblur(image, blur), deblur(image, blur), truth]
        rows.append(([f"blurred, {blur_px:g} px", "Wiener", "DeepGyro", "truth"], _crops(pictures, pair.blur(0))))
    for i, (blur_px, ratio, noise) in enumerate(PAIRS if lsd2 else ()):
        k = i + len(BLURS_PX)
        scene = expose(walls[k % len(walls)], blur_px, ratio, noise, errors[k], size=size, seed=seed + 200 + i)
        joined = scene.together()
        assert lsd2 is not None
        fused = codes(fuse(joined.short, joined.long, blur=joined.blur, network=lsd2))
        pictures = [codes(joined.short), codes(joined.long), fused, scene.truth]
        titles = [f"short, 1/{ratio:g} of the light", f"long, {blur_px:g} px", "LSD2", "truth"]
        rows.append((titles, _crops(pictures, scene.true_blur())))
    sheet = np.vstack([_row(*row) for row in rows])
    if not cv2.imwrite(str(file), sheet[..., ::-1]):
        raise SystemExit(f"--sheet: cannot write {file}")


def _crops(pictures: Sequence[UInt8Array], blur: BlurField) -> list[UInt8Array]:
    """The same part of all, where there is most detail (by the last one) and blur."""
    truth, length = pictures[-1], blur.per_pixel()
    detail = np.abs(cv2.Laplacian(cv2.cvtColor(truth, cv2.COLOR_RGB2GRAY), cv2.CV_32F))
    worth = cv2.blur(np.minimum(detail, 60) * np.hypot(length[..., 0], length[..., 1]), (CROP_PX, CROP_PX))
    half = CROP_PX // 2
    inside = worth[half:-half, half:-half]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return [np.ascontiguousarray(p[top : top + CROP_PX, left : left + CROP_PX]) for p in pictures]


def _row(titles: Sequence[str], crops: Sequence[UInt8Array]) -> UInt8Array:
    tiles = []
    for title, crop in zip(titles, crops, strict=True):
        tile = np.full((CROP_PX + TITLE_PX + GAP_PX, CROP_PX + GAP_PX, 3), 255, dtype=np.uint8)
        tile[TITLE_PX : TITLE_PX + CROP_PX, :CROP_PX] = crop
        cv2.putText(tile, title, (2, TITLE_PX - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        tiles.append(tile)
    return np.hstack(tiles)
