"""Deconvolution of motion blur along curved paths, in tiles by Fourier transforms.

Two filters: Wiener's with the spectrum of natural images, and one that expects gradients to be few and strong
(half-quadratic splitting with a hyper-Laplacian prior; Krishnan and Fergus, "Fast image deconvolution using
hyper-Laplacian priors", 2009).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Array, BoolArray, Float32Array
from colmap_inertial.core.choices import CheckedOptions
from colmap_inertial.core.threads import usable_processors
from colmap_inertial.imaging._cells import Cells
from colmap_inertial.imaging._chroma import join_colours, split_colours
from colmap_inertial.imaging._tiles import TILING, TiledPaths, Tiling
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.transfer import decode_table, encode_table, linearise, srgb_from_linear

Code = TypeVar("Code", np.uint8, np.uint16)

#: Pixels as bright as this share of the largest code may have been clipped.
SATURATED = 250 / 255
#: Longer blurs leave nothing to restore.
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


@dataclass(frozen=True, kw_only=True)
class PathFilterModel:
    """Model of images and their noise in the filters along paths."""

    #: Noise counts so many times: for JPEG's errors, and for paths that change within a tile.
    noise_factor: float = 8.0
    #: Cycles per pixel below which the spectrum of natural images, 1 / f^2, is flat,
    flat_below_per_px: float = 0.01
    #: and between which it is fitted.
    fitted_per_px: tuple[float, float] = (0.02, 0.3)
    #: Least share of the noise that a tile's spectrum has at one cycle per pixel.
    least_signal: float = 0.002
    #: Least noise, of full scale.
    least_noise: float = 1e-3
    #: A tile shows its noise at frequencies above this,
    noise_above_per_px: float = 0.2
    #: of which the blur leaves no more than this share;
    noise_share: float = 0.08
    #: so many must do so.
    noise_count: int = 200
    #: Of many tiles, about so many of the shortest side are looked at; of longer ones, which show more, fewer.
    noise_tiles: int = 20
    #: of chroma, fewer: its noise is taken as the same in all of the image.
    chroma_noise_tiles: int = 8
    #: Weight of the data against gradients to the power 2/3 where noise is 1 % of full scale.
    data_weight: float = 1000.0
    #: Weights of the splitting, one for each round.
    splitting: tuple[float, ...] = (8.0, 32.0, 128.0)


FILTER_MODEL = PathFilterModel()


def deblur(image: NDArray[Code], blur: BlurField, options: DeblurOptions | None = None) -> NDArray[Code]:
    """Undo motion blur along straight lines that are centred on each pixel: :func:`path_wiener` along them.

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
    A new image of the same shape and type. Pixels whose blur is below half a pixel, and those near a clipped lamp or
    glint (two blur lengths), are the input's, bit for bit.

    Raises
    ------
    ValueError
        Where the image is of another type, the blur of another size, or longer than `LONGEST_PX`.
    """
    return path_wiener(image, BlurPath.straight(blur), options)


def path_wiener(image: NDArray[Code], path: BlurPath, options: DeblurOptions | None = None) -> NDArray[Code]:
    """Undo motion blur along a path by Wiener's filter; of three channels, luma in full and chroma at half the size.

    Parameters
    ----------
    image
        (H, W) or (H, W, channels), uint8 or uint16, sRGB.
    path
        Of the image's size.
    options
        Defaults serve.

    Returns
    -------
    A new image of the same shape and type. Pixels whose blur is below half a pixel, and those near a clipped lamp or
    glint (two blur lengths), are the input's, bit for bit.

    Notes
    -----
    In linear light, in tiles of 256 px or more that overlap: ``W = conj(K) S / (|K|^2 S + c n)``, K the mean of
    ``exp(2 pi i f q)`` over the path q in the middle of the tile, ``S = A / (f^2 + .01^2)`` the spectrum of natural
    images, A fitted to the tile, n the variance of the noise at the tile's light, c `PathFilterModel.noise_factor`.
    Compiled; other Python threads go on while it runs. The plain version is `tests/references/path_filters.py`.

    Raises
    ------
    ValueError
        Where the image is of another type, the path of another size, or longer than `LONGEST_PX`.
    """
    return _filter_image(image, path, options or DeblurOptions(), ())


def half_quadratic(image: NDArray[Code], path: BlurPath, options: DeblurOptions | None = None) -> NDArray[Code]:
    """Undo motion blur along a path, expecting few and strong gradients; all else as :func:`path_wiener`.

    Wiener's result is the first guess. In turn, what its gradients w should be is found by minimising
    ``|w|^(2/3) + b / 2 (w - gradient)^2``, and the image that has these gradients and, blurred, is the one seen;
    b grows (`FILTER_MODEL.splitting`). Chroma keeps Wiener's result.
    """
    return _filter_image(image, path, options or DeblurOptions(), FILTER_MODEL.splitting)


def smoothed(image: NDArray[Code], sigma_px: float) -> NDArray[Code]:
    """An image smoothed by a Gaussian in linear light, as feature extraction likes it after a filter."""
    import cv2

    from colmap_inertial._kernels import _light

    light = np.asarray(cv2.GaussianBlur(linearise(image), (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT_101))
    if image.dtype == np.uint8:  # the table is fine enough for 256 codes
        codes = np.empty(light.size, dtype=np.uint8)
        _light.encode(light.reshape(-1), codes, encode=encode_table(image.dtype))
        return np.asarray(codes.reshape(image.shape), dtype=image.dtype)
    exact = np.iinfo(image.dtype).max * srgb_from_linear(light.astype(np.float64)).astype(np.float32)
    return np.rint(exact).astype(image.dtype)


@dataclass(frozen=True)
class Noise:
    """Variance of an image's noise in linear light, full scale = 1, as a line over the light."""

    dark: float
    by_light: float

    @classmethod
    def fitted(cls, measured: Array) -> Noise:
        """Fit the model to the light and the variance of (N, 2) tiles, some of which show more than noise, by least
        distances.
        """
        if not len(measured):
            return cls(FILTER_MODEL.least_noise**2, 0.0)
        light, variance = measured.T
        weight = np.ones(len(measured))
        dark, by_light = 0.0, 0.0
        for _ in range(10):
            mean_light, mean_variance = np.average(light, weights=weight), np.average(variance, weights=weight)
            spread = np.average((light - mean_light) ** 2, weights=weight)
            slope = np.average((light - mean_light) * (variance - mean_variance), weights=weight) / max(spread, 1e-12)
            by_light = float(np.clip(slope, 0, mean_variance / max(mean_light, 1e-12)))
            dark = float(mean_variance - by_light * mean_light)
            weight = 1 / np.maximum(np.abs(variance - dark - by_light * light), 0.1 * mean_variance + 1e-12)
        return cls(dark, by_light)


def noise_along(
    light: Float32Array, tiling: Tiling, paths: Float32Array, threads: int = 0, *, chroma: bool = False
) -> tuple[Noise, ...]:
    """Noise of each channel of (H, W, C) linear light, from frequencies that the blur removes.

    So the errors of compression count, and those of the path. Of chroma, which has no light to grow with, one variance.
    """
    from colmap_inertial._kernels import _path

    most_tiles = FILTER_MODEL.chroma_noise_tiles if chroma else FILTER_MODEL.noise_tiles
    measured = _path.noise(
        light,
        paths=paths,
        window_in=tiling.window_in(),
        hop=tiling.hop,
        before=tiling.before,
        above=FILTER_MODEL.noise_above_per_px,
        share=FILTER_MODEL.noise_share,
        every=max(
            1,
            round((tiling.count[0] * tiling.count[1] * tiling.side / TILING.shortest_side_px / most_tiles) ** 0.5),
        ),
        threads=threads,
    )
    channels = np.reshape(measured, (light.shape[2], -1, 3))
    if chroma:
        channels[..., 0] = 0
    return tuple(Noise.fitted(tiles[tiles[:, 2] >= FILTER_MODEL.noise_count, :2]) for tiles in channels)


def filter_along(
    light: Float32Array,
    tiling: Tiling,
    paths: TiledPaths,
    noise: Sequence[Noise],
    splitting: Sequence[float],
    *,
    threads: int = 0,
    instruction_set: str = "",
) -> Float32Array:
    """(H, W, C) linear light without blur; without splitting, by Wiener's filter."""
    from colmap_inertial._kernels import _path

    result = np.empty_like(light)
    _path.filter(
        light,
        result,
        paths=paths.px,
        spread=paths.cov_px2,
        window_in=tiling.window_in(),
        window_out=tiling.window_out(),
        hop=tiling.hop,
        before=tiling.before,
        noise=np.array([[n.dark, n.by_light] for n in noise], dtype=np.float32),
        least_noise=FILTER_MODEL.least_noise,
        noise_factor=FILTER_MODEL.noise_factor,
        flat_below=FILTER_MODEL.flat_below_per_px,
        fitted_from=FILTER_MODEL.fitted_per_px[0],
        fitted_to=FILTER_MODEL.fitted_per_px[1],
        least_signal=FILTER_MODEL.least_signal,
        data_weight=FILTER_MODEL.data_weight,
        splitting=np.array(splitting, dtype=np.float32),
        threads=threads,
        instruction_set=instruction_set,
    )
    return result


def _filter_light(
    light: Float32Array,
    path: BlurPath,
    options: DeblurOptions,
    splitting: Sequence[float],
    threads: int,
    *,
    chroma: bool = False,
) -> Float32Array:
    """(H, W, C) linear light without blur."""
    tiling = Tiling.covering(path.width, path.height, path.extent_px(), coarse=chroma)
    paths = tiling.paths(path)
    if options.noise is None:
        noise = noise_along(light, tiling, paths, threads, chroma=chroma)
    else:
        # chroma is the difference of two channels, each of them the mean of four pixels
        variance = options.noise**2 * (0.5 if chroma else 1.0)
        noise = (Noise(variance, 0.0),) * light.shape[2]
    return filter_along(light, tiling, TiledPaths(paths, tiling.spreads(path)), noise, splitting, threads=threads)


def _filter_image(
    image: NDArray[Code], path: BlurPath, options: DeblurOptions, splitting: Sequence[float]
) -> NDArray[Code]:
    planes = _require_planes(image, path)
    threads = options.threads or usable_processors()
    cells = Cells.of(path.field())
    # A clipped lamp is no image of the scene blurred along the path: the filter would answer it with rings.
    scene = fill_clipped(planes, cells, threads)
    if planes.shape[2] == 3:
        luma, chroma = split_colours(scene, threads)
        sharp_luma = _filter_light(luma[..., None], path, options, splitting, threads)
        halved = path.halved()
        sharp_chroma = [_filter_light(c[..., None], halved, options, (), threads, chroma=True)[..., 0] for c in chroma]
        sharp = join_colours(sharp_luma[..., 0], np.stack(sharp_chroma), threads)
    else:
        light = linearise(scene).reshape(planes.shape)
        sharp = _filter_light(light, path, options, splitting, threads)
    return blend_where_blurred(planes, sharp, cells, threads).reshape(image.shape)


def _require_planes(image: NDArray[Code], path: BlurPath) -> NDArray[Code]:
    """The image as (H, W, channels); ``ValueError`` where it or its blur is not one that can be undone."""
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3) or 0 in image.shape:
        raise ValueError(f"image: (H, W) or (H, W, channels) of uint8 or uint16, not {image.shape} of {image.dtype}")
    height, width = image.shape[:2]
    if (height, width) != (path.height, path.width):
        raise ValueError(f"blur: for {path.width} x {path.height} px, the image has {width} x {height}")
    if path.extent_px() > LONGEST_PX:
        raise ValueError(f"blur: {path.extent_px():.0f} px long; at most {LONGEST_PX:.0f} can be undone")
    return np.ascontiguousarray(image).reshape(height, width, -1)


def fill_clipped(planes: NDArray[Code], cells: Cells, threads: int) -> NDArray[Code]:
    """An image (H, W, C) whose pixels within two blur lengths of a clipped lamp or glint are filled from around them.

    :func:`blend_where_blurred` keeps the input there. Images without such pixels are returned themselves.
    """
    from colmap_inertial._kernels import _light

    spoilt = np.zeros(planes.shape[:2], dtype=np.uint8)
    any_spoilt = _light.find_spoilt(
        planes,
        spoilt,
        extent_px=cells.extent_px,
        slope=cells.slope,
        along_y=cells.along_y,
        decode=decode_table(planes.dtype),
        saturated=_lowest_saturated_code(planes.dtype),
        threads=threads,
    )
    if not any_spoilt:
        return planes
    codes = np.rint(_fill_unknown(planes.astype(np.float32), spoilt == 0))
    return np.where(spoilt[..., None] == 1, codes.astype(planes.dtype), planes)


def _fill_unknown(image: Float32Array, known: BoolArray) -> Float32Array:
    """(H, W, C) image whose unknown pixels are the nearest known means of 2 x 2, 4 x 4, ... pixels, interpolated."""
    import cv2

    height, width = known.shape
    if known.all() or max(height, width) == 1:
        return image
    half = ((width + 1) // 2, (height + 1) // 2)
    weight = known.astype(np.float32)
    share = cv2.resize(weight, half, interpolation=cv2.INTER_AREA)
    total = cv2.resize(image * weight[..., None], half, interpolation=cv2.INTER_AREA)
    mean = total.reshape(half[1], half[0], -1) / np.maximum(share, np.finfo(np.float32).tiny)[..., None]
    coarse = _fill_unknown(mean, share > 0)
    between = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR).reshape(image.shape)
    return np.where(known[..., None], image, between)


def blend_where_blurred(planes: NDArray[Code], sharp: Float32Array, cells: Cells, threads: int) -> NDArray[Code]:
    """Put filtered light into an image (H, W, C), without what is saturated or hardly blurred; in the image's codes."""
    from colmap_inertial._kernels import _light

    result = np.empty_like(planes)
    _light.blend(
        planes,
        sharp,
        result,
        extent_px=cells.extent_px,
        slope=cells.slope,
        along_y=cells.along_y,
        fade=cells.fade,
        decode=decode_table(planes.dtype),
        encode=encode_table(planes.dtype),
        saturated=_lowest_saturated_code(planes.dtype),
        threads=threads,
    )
    return result


def _lowest_saturated_code(dtype: np.dtype[Any]) -> int:
    """The first code of an image type that may have been clipped."""
    return int(np.ceil(SATURATED * np.iinfo(dtype).max))
