"""Sharp photographs as linear light, divided into those to train on and those to measure with."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np

from colmap_inertial.core.arrays import Float32Array
from colmap_inertial.imaging.transfer import decode_table

#: Every so many-th photograph is never trained on.
_HELD_OUT_ONE_IN = 5


def photographs(folder: Path, *, held_out: bool) -> list[Path]:
    """The photographs of a folder to train on, or those to measure with.

    What a picture is used for depends on its name alone: it stays so when others join the folder.
    """
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
    if not found:
        raise SystemExit(f"{folder} holds no photographs (.jpg, .png)")
    return [p for p in found if is_held_out(p) == held_out]


def is_held_out(path: Path) -> bool:
    """Whether a photograph is never trained on."""
    return int(hashlib.sha256(path.name.encode()).hexdigest()[:8], 16) % _HELD_OUT_ONE_IN == 0


class Album:
    """Photographs in memory, and square pieces of them."""

    def __init__(self, paths: list[Path]) -> None:
        self.pictures = [np.asarray(cv2.imread(str(p), cv2.IMREAD_COLOR_RGB)) for p in paths]

    def piece(self, side: int, rng: np.random.Generator) -> Float32Array:
        """(side, side, 3) linear light: any part of any photograph, turned by right angles, at 1/2 to full size."""
        picture = self.pictures[rng.integers(len(self.pictures))]
        height, width = picture.shape[:2]
        scale = max(rng.uniform(0.5, 1.0), (side + 1) / min(height, width))
        taken = min(int(np.ceil(side / scale)), height, width)
        top, left = rng.integers(height - taken + 1), rng.integers(width - taken + 1)
        part = decode_table(picture.dtype)[picture[top : top + taken, left : left + taken]]
        way = cv2.INTER_AREA if taken >= side else cv2.INTER_CUBIC
        out = np.asarray(cv2.resize(part, (side, side), interpolation=way)).clip(0, None)
        out = np.rot90(out, rng.integers(4))
        return np.ascontiguousarray(out[:, ::-1] if rng.random() < 0.5 else out, dtype=np.float32)
