"""The images of all apertures, warped onto the reference's and put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import AnyArray, BoolArray, Float32Array
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ApertureOptions
from colmap_inertial.core.types import ApertureRig, SpectralRole
from colmap_inertial.imaging.multi_aperture._fill import fill_hidden
from colmap_inertial.imaging.multi_aperture._geometry import Rectified
from colmap_inertial.imaging.multi_aperture._noise import measure_noise
from colmap_inertial.imaging.multi_aperture._sampling import places
from colmap_inertial.imaging.multi_aperture.disparity import Disparity, estimate_disparity

COLOURS: tuple[SpectralRole, ...] = ("red", "green", "blue")
#: Side of the windows in which colours go with luminance.
_WINDOW_PX = 7
#: Windows must show this many times the noise's variance to be taken for texture.
_TEXTURE = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class Fused:
    """One exposure of all apertures, as the reference sees it.

    Attributes
    ----------
    image
        (H, W, 3) RGB, of the images' type.
    disparity_px
        (H, W) shift between the reference and its partner; no gaps.
    depth
        (H, W) along the reference's optical axis, in the rig's unit; infinite where the disparity is not above zero,
        nan where it was not measured.
    measured
        (H, W) whether another aperture sees the pixel and agrees on its disparity.
    hidden
        (H, W) whether a colour was seen by none of its apertures, and taken from its neighbourhood.
    """

    image: AnyArray
    disparity_px: Float32Array
    depth: Float32Array
    measured: BoolArray
    hidden: BoolArray


def plane_of(image: AnyArray, role: SpectralRole) -> AnyArray:
    """The plane (H, W) of an aperture, from a file of one or three channels.

    A colour is taken from its own channel of an RGB image, luminance (and ``other``) from ITU-R BT.601's sum.
    """
    if image.ndim == 2:
        return image
    if role in COLOURS:
        return np.ascontiguousarray(image[..., COLOURS.index(role)])
    luma = image @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
    return np.asarray(np.rint(luma), dtype=image.dtype)


def require_colours(rig: ApertureRig) -> None:
    """Raise ``InertialError`` where a rig cannot give RGB."""
    roles = [aperture.role for aperture in rig.apertures]
    missing = [role for role in COLOURS if role not in roles]
    if missing:
        raise InertialError(
            Fact("colours-missing", missing=missing, apertures=tuple(f"{a.name} ({a.role})" for a in rig.apertures))
        )


def fuse_apertures(
    planes: Sequence[AnyArray], rig: ApertureRig, canvas: Rectified, options: ApertureOptions | None = None
) -> Fused:
    """One RGB image, as the reference sees it, from one exposure of all apertures.

    Parameters
    ----------
    planes
        (H, W) images of the apertures, uint8 or uint16 alike, in the rig's order; see :func:`plane_of`.
    canvas
        From :func:`rectify`.

    Raises
    ------
    InertialError
        Where red, green or blue is missing.
    ValueError
        Where an image is not of its camera's size, or they differ in type.
    """
    options = options or ApertureOptions()
    check_planes(planes, rig)
    roles = [aperture.role for aperture in rig.apertures]
    return fuse_with(planes, rig, canvas, estimate_disparity(planes, canvas, options, roles=roles), options)


def check_planes(planes: Sequence[AnyArray], rig: ApertureRig) -> None:
    """Raise ``ValueError`` where images do not belong to a rig."""
    if len(planes) != len(rig.apertures):
        raise ValueError(f"{len(planes)} pictures for {len(rig.apertures)} apertures")
    for plane, aperture in zip(planes, rig.apertures, strict=True):
        camera = aperture.camera
        if plane.dtype != planes[0].dtype or plane.dtype not in (np.uint8, np.uint16):
            raise ValueError(f"{aperture.name}: pictures must all be uint8, or all uint16")
        if plane.shape != (camera.height, camera.width):
            raise ValueError(f"{aperture.name}: {plane.shape} is not the camera's {camera.height} x {camera.width}")


def fuse_with(
    planes: Sequence[AnyArray],
    rig: ApertureRig,
    canvas: Rectified,
    disparity: Disparity,
    options: ApertureOptions | None = None,
) -> Fused:
    """:func:`fuse_apertures` with disparities that are known already.

    Notes
    -----
    Each colour is the mean of its apertures that see the pixel, bicubic; where none does it is filled by
    :func:`fill_hidden`. Where there is a luminance aperture, colours are brought towards what they are as a linear
    function of luminance in a small window (the guided filter's model, He, Sun, Tang 2013), as far as they differ from
    it by no more than noise (Lee, PAMI 2(2), 1980): what luminance shows with less noise keeps its detail.
    """
    require_colours(rig)
    options = options or ApertureOptions()
    top = np.float32(np.iinfo(planes[0].dtype).max)
    reference = rig.apertures[0]
    shape = (reference.camera.height, reference.camera.width)
    grid = _Grid(canvas, shape, disparity)
    guide = planes[0].astype(np.float32) / top
    hidden = np.zeros(shape, dtype=bool)
    roles: dict[SpectralRole, Float32Array] = {}
    wanted = [*COLOURS, "luminance"] if options.use_luminance else [*COLOURS]
    for role in wanted:
        total, count = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
        last = None
        for i, aperture in enumerate(rig.apertures):
            if aperture.role != role:
                continue
            values, seen = (guide, np.ones(shape, dtype=bool)) if i == 0 else grid.warped(planes[i], i, top)
            total += values * seen
            count += seen
            last = values
        if last is None:
            continue
        missing = count == 0
        values = np.where(missing, last, total / np.maximum(count, 1))
        roles[role] = fill_hidden(values.astype(np.float32), ~missing, guide, grid.disparity_px)
        if role in COLOURS:
            hidden |= missing
    colours = np.stack([roles[role] for role in COLOURS], axis=-1)
    if "luminance" in roles:
        colours = denoise_by_luminance(colours, roles["luminance"])
    image = np.clip(np.rint(top * colours), 0, top).astype(planes[0].dtype)
    return Fused(
        image=image,
        disparity_px=grid.disparity_px,
        depth=grid.depth(),
        measured=grid.measured,
        hidden=hidden,
    )


class _Grid:
    """The reference's pixels, with disparities, and where they lie in the other images."""

    def __init__(self, canvas: Rectified, shape: tuple[int, int], disparity: Disparity) -> None:
        self.canvas, self.found = canvas, disparity
        height, width = shape
        if canvas.canvas_from_reference is None:
            x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in (width, height)))
        else:
            x, y = np.moveaxis(canvas.canvas_from_reference, -1, 0)
        self.x, self.y = x, y
        self.disparity_px: Float32Array = self._nearest(disparity.disparity_px)
        self.measured: BoolArray = self._nearest(disparity.measured)

    def _nearest(self, values: AnyArray) -> AnyArray:
        if self.canvas.canvas_from_reference is None:
            return values
        row = np.clip(np.rint(self.y), 0, self.canvas.height - 1).astype(np.intp)
        column = np.clip(np.rint(self.x), 0, self.canvas.width - 1).astype(np.intp)
        return np.asarray(values[row, column])

    def depth(self) -> Float32Array:
        d = self.disparity_px
        scale = np.float32(self.canvas.focal_px * self.canvas.baseline)
        depth = np.where(d > 0, scale / np.maximum(d, np.float32(1e-6)), np.float32(np.inf))
        if self.canvas.depth_factor is not None:
            depth = depth * self.canvas.depth_factor
        return np.where(self.measured, depth, np.float32(np.nan)).astype(np.float32)

    def warped(self, plane: AnyArray, index: int, top: np.float32) -> tuple[Float32Array, BoolArray]:
        """An aperture's image as the reference sees it, full scale 1, and where it sees it."""
        import cv2

        u, v = places(self.canvas, index, self.disparity_px, self.x, self.y)
        to_image = self.canvas.image_from_canvas[index]
        if to_image is not None:
            at = cv2.remap(to_image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(-1e4, -1e4))
            u, v = at[..., 0], at[..., 1]
        height, width = plane.shape
        inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
        values = cv2.remap(plane.astype(np.float32) / top, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.clip(values, 0, 1), inside & self._nearest(self.found.visible[index - 1])


def denoise_by_luminance(colours: Float32Array, luminance: Float32Array) -> Float32Array:
    """Colours with the noise of luminance instead of their own, as far as they go with it."""
    import cv2

    def mean(values: Float32Array) -> Float32Array:
        size = (_WINDOW_PX, _WINDOW_PX)
        return np.asarray(cv2.blur(values, size, borderType=cv2.BORDER_REFLECT_101))

    noise_light = measure_noise(255 * luminance) / 255
    of_light = mean(luminance)
    spread = np.maximum(mean(luminance * luminance) - of_light**2, 0)
    texture = np.maximum(spread - np.float32(noise_light**2), 0) + np.float32(_TEXTURE)
    result = np.empty_like(colours)
    for c in range(colours.shape[2]):
        colour = colours[..., c]
        noise = measure_noise(255 * colour) / 255
        of_colour = mean(colour)
        slope = (mean(luminance * colour) - of_light * of_colour) / (texture + np.float32(noise_light**2))
        model = mean(slope) * luminance + mean(of_colour - slope * of_light)
        rest = colour - model
        variance = mean(rest * rest)
        result[..., c] = model + rest * np.maximum(1 - np.float32(noise**2) / np.maximum(variance, 1e-12), 0)
    return result
