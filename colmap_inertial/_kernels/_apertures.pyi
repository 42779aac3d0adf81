"""Matching of several apertures' pictures. Results are written in place; threads = 0 takes all processors."""

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.types import Array

PADDING: int

def matching_costs(
    reference: NDArray[np.uint8],
    views: NDArray[np.uint8],
    *,
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
    cost: NDArray[np.uint8],
    share: NDArray[np.int32],
    unseen: int,
    radius: int,
    least: int = 0,
    tables: NDArray[np.uint8] | None = None,
    blend: NDArray[np.int32] | None = None,
    blend_table: NDArray[np.uint8] | None = None,
    shown: NDArray[np.int32] | None = None,
    threads: int = 0,
    instruction_set: str = "",
) -> None:
    """Write what each candidate costs into `cost` (H, W, D), summed over the views (N, Hv, Wv).

    `columns` (N, D, W) and `rows` (N, D, H): where the reference's columns and rows lie in a view, in 1/16 px. Census
    counts comparisons that differ by `least` codes or more in the reference. `tables` (N, 256, 256): costs by codes of
    reference and view in place of census. `blend` (N + 2): weights of reference and views in 1/256 and a constant,
    whose sum costs what `blend_table` (256) says. `shown` (N, Hv, 2): from and up to which column each row of a view
    shows something; a window of which anything is looked up elsewhere has no say. Positions then must not fall from
    left to right.
    """

def semi_global(
    cost: NDArray[np.uint8],
    guide: NDArray[np.uint8],
    *,
    small: int,
    jump: NDArray[np.uint16],
    total: NDArray[np.uint16],
    threads: int = 0,
    instruction_set: str = "",
) -> None:
    """Write the sums of `cost` along eight paths into `total` (H, W, D padded to a multiple of `PADDING`)."""

def winners(
    total: NDArray[np.uint16],
    *,
    least: NDArray[np.uint16],
    index: NDArray[np.uint16],
    aside: NDArray[np.float32],
    candidates: int,
    threads: int = 0,
) -> None:
    """Write the least total, its candidate, and how far aside a parabola has its least value, -1/2 to 1/2."""

def visibility(
    disparity: NDArray[np.float32],
    least: NDArray[np.uint16],
    *,
    ratios: Array,
    cx: float,
    cy: float,
    tolerance: float,
    bits: NDArray[np.uint8],
    threads: int = 0,
) -> None:
    """Write into `bits` (N, H, W) how the views see what the reference sees with these disparities.

    1: nothing nearer lies before it. 2: what has the least total of all on that pixel of the view has its disparity.
    `ratios` (N, 3): shift along x and y, and shrinking, for each pixel of disparity.
    """

def instruction_sets() -> list[str]:
    """Those that this processor has, the best one last."""
