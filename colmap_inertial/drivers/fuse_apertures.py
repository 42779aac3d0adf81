"""``fuse-apertures``: the images of a multi-aperture camera alone."""

from __future__ import annotations

from pathlib import Path

from colmap_inertial.errors import FormatError, OutputExistsError
from colmap_inertial.imaging.multi_aperture import (
    refocus,
    require_colours,
)
from colmap_inertial.io.capture import ImageFolder, load_capture
from colmap_inertial.io.frames import image_names
from colmap_inertial.io.images import read_image
from colmap_inertial.options import FuseAperturesOptions
from colmap_inertial.run.progress import Progress
from colmap_inertial.stages.apertures import ApertureStage, write_maps
from colmap_inertial.stages.frame_folder import encode_image


def fuse_captured(
    capture: Path, out: Path, options: FuseAperturesOptions | None = None, *, progress: Progress
) -> tuple[Path, ...]:
    """Fuse every exposure of a capture, for images alone: no times and no IMU are needed.

    Parameters
    ----------
    capture
        A ``capture.toml`` with ``[images]`` and ``[apertures]``, or its folder.
    out
        A folder that does not exist: ``images/``, and where asked for ``refocused/``, ``disparity/``, ``depth/``.
    options
        Defaults serve.
    progress
        Called with stage, exposures done and exposures in all.

    Returns
    -------
    The fused pictures.

    Raises
    ------
    FormatError, InertialError
        For what cannot be read or does not fit together.
    OutputExistsError
        Where ``out`` exists.
    """
    options = options or FuseAperturesOptions()
    loaded = load_capture(capture)
    if loaded.apertures is None or not isinstance(loaded.frames, ImageFolder):
        raise FormatError(loaded.path, "describes no multi-aperture camera: add [images] and [apertures]")
    if out.exists():
        raise OutputExistsError(f"{out} exists already; name a new folder")
    names = image_names(loaded.frames)
    stage = ApertureStage(pictures=loaded.apertures, options=options.fusion)
    require_colours(loaded.apertures.rig)
    canvas = stage.canvas()
    written = []
    for done, name in enumerate(names, start=1):
        source = loaded.frames.folder / name
        fused = stage.fused(name, read_image(source))
        target = out / "images" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        encode_image(target, fused.image, source)
        written.append(target)
        if options.fusion.depth:
            write_maps(out, name, fused)
        if options.refocus is not None:
            picture = refocus(
                fused.image, fused.disparity_px, canvas.disparity(options.refocus), strength=options.lens_width
            )
            target = out / "refocused" / name
            target.parent.mkdir(parents=True, exist_ok=True)
            encode_image(target, picture, source)
        progress("fusing", done, len(names))
    return tuple(written)
