"""Deconvolution of motion blur: a Wiener filter along the blur of every pixel.

A blur along a line is undone by a filter along that line: one-dimensional, so that its cost grows with the length of
the blur and not with its square, and free to change from place to place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.choices import CheckedOptions
from colmap_inertial.imaging._cells import Cells
from colmap_inertial.imaging._taps import STEPS_PER_PX, Prior, TapTable, smoothing_px
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.transfer import decode_table, encode_table

Code = TypeVar("Code", np.uint8, np.uint16)
Sample = TypeVar("Sample", np.uint8, np.uint16, np.float32)

#: Pixels as bright as this share of the largest code may have been clipped.
SATURATED = 250 / 255
#: Longer blurs leave nothing to restore; filters for them would take seconds to work out.
LONGEST_PX = 500.0


@dataclass(frozen=True, kw_only=True)
class DeblurOptions(CheckedOptions):
    """Options of the deconvolution."""

    noise: float | None = None
    """Standard deviation of the image noise in linear light, full scale = 1; estimated from each image where absent."""

    threads: int | None = None
    """Threads for one image; as many as the process may use where absent."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.noise is not None and not 0 <= self.noise < 1:
            raise ValueError("noise must be at least 0 and below 1")
        if self.threads is not None and self.threads < 1:
            raise ValueError("threads must be at least 1")


def deblur(image: NDArray[Code], blur: BlurField, options: DeblurOptions | None = None) -> NDArray[Code]:
    """Undo the motion blur of an image.

    Parameters
    ----------
    image
        (H, W) or (H, W, channels), uint8 or uint16, sRGB.
    blur
        Along which line every pixel smears; of the image's size.
    options
        Defaults serve.

    Returns
    -------
    A new image of the same shape and type. Pixels whose blur is below half a pixel, and those from which the filter
    would reach a clipped lamp or glint (two blur lengths), are the input's, bit for bit.

    Notes
    -----
    ``out(x, y) = sum_j w_j g(x + j, y + j slope)`` in linear light, ``w`` the optimal finite filter (`optimal_taps`)
    for the blur at the centre of a 16 px cell, ``g`` the image, smoothed a little (`smoothing_px`). Compiled; other
    Python threads go on while it runs. The plain version that it is tested against is `tests/references/wiener.py`.

    Raises
    ------
    ValueError
        Where the image is of another type, the blur of another size, or longer than `LONGEST_PX` along x or y.
    """
    options = options or DeblurOptions()
    planes, cells, noise = _prepare(image, blur, options)
    result, _ = _compiled(planes, cells, _table(cells, noise), threads=options.threads)
    return result.reshape(image.shape)


def estimate_noise(image: NDArray[Code], axis: Literal["x", "y"]) -> float:
    """Standard deviation of the noise in linear light, full scale = 1, from an image that is blurred along an axis.

    Along its blur an image has hardly any detail as fine as a pixel; what remains of the fourth difference there is
    noise (its median absolute value, so that edges and specks do not count). Where the blur is below a few pixels, or
    the camera smoothed its noise away, the estimate is too high or too low. It is rounded to quarter octaves: it is no
    better than that, and filters can be kept for the next image.
    """
    plane = image if image.ndim == 2 else image[..., image.shape[2] // 2]
    lines = plane if axis == "x" else plane.T
    if lines.shape[1] < 5:
        return 0.0
    light = decode_table(image.dtype)[lines[:: max(1, lines.shape[0] // 24)]]
    difference = light[:, :-4] - 4 * light[:, 1:-3] + 6 * light[:, 2:-2] - 4 * light[:, 3:-1] + light[:, 4:]
    sigma = 1.4826 * float(np.median(np.abs(difference))) / 70**0.5
    return 0.0 if sigma == 0 else 2 ** (round(4 * np.log2(sigma)) / 4)


def _prepare(image: NDArray[Code], blur: BlurField, options: DeblurOptions) -> tuple[NDArray[Code], Cells, float]:
    """The image as (H, W, channels), its cells, and its noise."""
    cells = Cells.of(blur)
    planes = require_planes(image, blur, "blur", float(cells.extent_px.max()))
    noise = options.noise
    if noise is None:
        noise = estimate_noise(image, "y" if cells.along_y.mean() > 0.5 else "x")
    return planes, cells, noise


def require_planes(image: NDArray[Code], blur: BlurField | BlurPath, name: str, extent_px: float) -> NDArray[Code]:
    """The image as (H, W, channels); ``ValueError`` where it or its blur (``name``) is not one that can be undone."""
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3) or 0 in image.shape:
        raise ValueError(f"image: (H, W) or (H, W, channels) of uint8 or uint16, not {image.shape} of {image.dtype}")
    height, width = image.shape[:2]
    if (height, width) != (blur.height, blur.width):
        raise ValueError(f"{name}: for {blur.width} x {blur.height} px, the image has {width} x {height}")
    if extent_px > LONGEST_PX:
        raise ValueError(f"{name}: {extent_px:.0f} px long; at most {LONGEST_PX:.0f} can be undone")
    return np.ascontiguousarray(image).reshape(height, width, -1)


def _table(cells: Cells, noise: float) -> TapTable:
    shortest, longest = float(cells.extent_px.min()), float(cells.extent_px.max())
    return TapTable.covering(shortest, longest, Prior.for_noise(noise), smoothing_px(noise, cells.typical_px))


def _compiled(
    planes: NDArray[Sample],
    cells: Cells,
    table: TapTable,
    *,
    threads: int | None = None,
    instruction_set: str = "",
) -> tuple[NDArray[Sample], tuple[float, float]]:
    """The compiled filter on (H, W, channels); also the processor time of decoding and of filtering, s.

    float32 is taken as linear light, of which nothing is saturated. The instruction set is the processor's best one,
    or the one of that name.
    """
    from colmap_inertial._kernels import _wiener

    dtype = planes.dtype
    coded = dtype != np.float32
    none = np.empty(0, dtype=np.float32)
    result = np.empty_like(planes)
    seconds = _wiener.deblur(
        planes,
        result,
        extent_px=cells.extent_px,
        slope=cells.slope,
        along_y=cells.along_y,
        fade=cells.fade,
        weights=table.weights,
        reach=table.reach,
        first=table.first,
        steps=STEPS_PER_PX,
        smoothing=table.smoothing,
        decode=decode_table(dtype) if coded else none,
        encode=encode_table(dtype) if coded else none,
        saturated=lowest_saturated_code(dtype) if coded else 0,
        threads=threads or 0,
        instruction_set=instruction_set,
    )
    return result, seconds


def lowest_saturated_code(dtype: np.dtype[Any]) -> int:
    """The first code of an image type that may have been clipped."""
    return int(np.ceil(SATURATED * np.iinfo(dtype).max))
