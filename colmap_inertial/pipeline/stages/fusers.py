"""What makes one picture of a short and a long exposure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from colmap_inertial.core.arrays import Float32Array
from colmap_inertial.core.options import ExposureOptions
from colmap_inertial.core.threads import frames_at_once, threads_beside
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.restoration import load_network, lsd2, shipped

#: Makes one picture of a short exposure as bright as the long one, the long one in its geometry, and the long one's
#: blur: all float32 sRGB 0 to 1, of one shape.
Fuse = Callable[[Float32Array, Float32Array, BlurField | None], Float32Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class Fuser:
    """What makes one picture of two.

    Attributes
    ----------
    fuse
        Does it, in any number of threads at once.
    identity
        What decides its result: pairs are fused again where it changes.
    """

    fuse: Fuse = field(compare=False)
    identity: str


def lsd2_fuser(options: ExposureOptions | None = None) -> Fuser:
    """The network that comes with the package.

    Raises
    ------
    MissingExtraError, FormatError, InertialError
        As ``restoration.load_network``.
    """
    options = options or ExposureOptions()
    network = load_network("lsd2", device=options.device, threads=threads_beside(frames_at_once()))

    def fuse(short: Float32Array, long: Float32Array, blur: BlurField | None) -> Float32Array:
        return lsd2.fuse(short, long, blur=blur, network=network)

    return Fuser(fuse=fuse, identity=f"lsd2 {shipped.checksum('lsd2')}")
