"""Matching of several apertures' pictures. Results are written in place; threads = 0 takes all processors."""

from colmap_inertial.core.arrays import Array, Float32Array, Int32Array, UInt8Array, UInt16Array

PADDING: int

def matching_costs(
    reference: UInt8Array,
    views: UInt8Array,
    *,
    columns: Int32Array,
    rows: Int32Array,
    cost: UInt8Array,
    share: Int32Array,
    unseen: int,
    radius: int,
    least: int = 0,
    tables: UInt8Array | None = None,
    blend: Int32Array | None = None,
    blend_table: UInt8Array | None = None,
    shown: Int32Array | None = None,
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
    cost: UInt8Array,
    guide: UInt8Array,
    *,
    small: int,
    jump: UInt16Array,
    total: UInt16Array,
    threads: int = 0,
    instruction_set: str = "",
) -> None:
    """Write the sums of `cost` along eight paths into `total` (H, W, D padded to a multiple of `PADDING`)."""

def winners(
    total: UInt16Array,
    *,
    least: UInt16Array,
    index: UInt16Array,
    aside: Float32Array,
    candidates: int,
    threads: int = 0,
) -> None:
    """Write the least total, its candidate, and how far aside a parabola has its least value, -1/2 to 1/2."""

def visibility(
    disparity: Float32Array,
    least: UInt16Array,
    *,
    ratios: Array,
    cx: float,
    cy: float,
    tolerance: float,
    bits: UInt8Array,
    threads: int = 0,
) -> None:
    """Write into `bits` (N, H, W) how the views see what the reference sees with these disparities.

    1: nothing nearer lies before it. 2: what has the least total of all on that pixel of the view has its disparity.
    `ratios` (N, 3): shift along x and y, and shrinking, for each pixel of disparity.
    """

def instruction_sets() -> list[str]:
    """Those that this processor has, the best one last."""
