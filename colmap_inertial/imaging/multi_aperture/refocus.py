"""An image with little depth of field, from one with much and its disparities."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Float32Array
from colmap_inertial.imaging.transfer import decode_table, srgb_from_linear

#: Layers of disparity that are blurred one by one; more make no visible difference.
_MOST_LAYERS = 48
#: Layers no further apart in blur than this.
_LAYER_PX = 0.5


def refocus(
    image: AnyArray, disparity_px: Float32Array, focus_px: float, *, strength: float = 1.0, largest_px: float = 60.0
) -> AnyArray:
    """Blur what does not have the disparity in focus, as a lens as wide as the baseline would.

    A thing whose disparity differs by ``d`` from the one in focus becomes a disc ``d`` pixels wide: that is what the
    views between two apertures a baseline apart add up to. In linear light, in layers from the back to the front; each
    covers those behind by its own blurred extent.

    Parameters
    ----------
    image
        (H, W, 3) sRGB, uint8 or uint16.
    disparity_px
        (H, W).
    focus_px
        Disparity of what is in focus, ``Rectified.disparity(depth)``.
    strength
        Width of the lens in baselines.
    largest_px
        Discs are no wider.
    """
    import cv2

    light = decode_table(image.dtype)[image].astype(np.float32)
    width_px = np.clip(strength * (disparity_px - np.float32(focus_px)), -largest_px, largest_px)
    low, high = float(width_px.min()), float(width_px.max())
    count = int(np.clip(np.ceil((high - low) / _LAYER_PX), 1, _MOST_LAYERS))
    edges = np.linspace(low, high, count + 1)
    layer = np.clip(np.searchsorted(edges, width_px, side="right") - 1, 0, count - 1)
    result = np.zeros_like(light)
    covered = np.zeros(image.shape[:2], dtype=np.float32)
    for i in range(count):  # less disparity is further away
        mask = (layer == i).astype(np.float32)
        if not mask.any():
            continue
        disc = _disc(abs(edges[i] + edges[i + 1]) / 2)
        share = np.asarray(cv2.filter2D(mask, -1, disc, borderType=cv2.BORDER_REFLECT))
        blurred = np.asarray(cv2.filter2D(light * mask[..., None], -1, disc, borderType=cv2.BORDER_REFLECT))
        share = np.clip(share, 0, 1)
        result = blurred + (1 - share)[..., None] * result
        covered = share + (1 - share) * covered
    result /= np.maximum(covered, np.float32(1e-3))[..., None]
    top = np.iinfo(image.dtype).max
    return np.asarray(np.rint(top * srgb_from_linear(np.clip(result, 0, 1))), dtype=image.dtype)


def _disc(width_px: float) -> Float32Array:
    """A disc that adds up to one, its rim in shares of pixels."""
    reach = int(np.ceil(width_px / 2))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = np.clip(width_px / 2 + 0.5 - np.hypot(x, y), 0, 1)
    return np.asarray(disc / disc.sum(), dtype=np.float32)
