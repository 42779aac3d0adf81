"""Images of the cameras, made small enough to be sent to a browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import UInt8Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.images import read_image


def read_preview(path: Path | None, width_px: int) -> tuple[UInt8Array | None, str]:
    """An image (H, W, 3) that is no wider than this, or ``None`` and why there is none."""
    import cv2

    if path is None:
        return None, "Its image is not beside the model; --images FOLDER says where it is."
    try:
        image = read_image(path)
    except FormatError as error:
        return None, f"Its image: {error.reason}"
    shown = np.asarray(image // 257 if image.dtype == np.uint16 else image, dtype=np.uint8)
    if shown.ndim == 2:
        shown = np.repeat(shown[:, :, None], 3, axis=2)
    height, width = shown.shape[:2]
    if width > width_px:
        size = (width_px, max(1, round(height * width_px / width)))
        shown = np.asarray(cv2.resize(shown, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return shown, ""
