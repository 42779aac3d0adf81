"""Words of images that are not read, and of what their EXIF lacks."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import message, state

_ANEW = "copy it again from its source, or take it out of the folder"

state("picture-without-end", "is cut off (no end of image)", advice=_ANEW)
state("picture-without-data", "is cut off (no image data)", advice=_ANEW)
state("jpeg-segment-damaged", "is damaged (a JPEG segment does not start with a marker)", advice=_ANEW)
state("png-checksum-wrong", "is damaged (a PNG checksum is wrong)", advice=_ANEW)
# what the images of a model that cannot be read are listed with, whole
state("picture-not-decoded", "cannot be decoded: damaged, cut off or not an image; take it out of the folder")


@message(example={"width": 30000, "height": 20000, "most_megapixels": 500.0})
def picture_too_large(width: int, height: int, most_megapixels: float) -> str:
    return (
        f"has {width} x {height} pixels; more than {most_megapixels:.3g} million are not decoded: make it smaller, "
        "take it out of the folder, or raise --limits.megapixels"
    )


@message(example={"dtype": "float32"})
def picture_depth(dtype: str) -> str:
    return f"holds {dtype} pixels; 8 or 16 bit are needed"


state(
    "no-positions-in-telemetry",
    "its telemetry holds no positions (GPS5 or GPS9 of GoPro with a fix, or CAMM): nothing to georeference by",
)


@message(example={"count": 100})
def no_positions_in_exif(count: int) -> str:
    return f"none of its {count} images has a position in its EXIF: nothing to georeference by"


@message(example={"pattern": "*.png", "endings": (".jpg", ".png")})
def no_pictures(pattern: str | None, endings: Sequence[str]) -> str:
    which = "" if pattern is None else f" that match {pattern!r}"
    return f"holds no images{which} (endings: {', '.join(endings)})"
