"""Depth maps fused to points by COLMAP."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from colmap_inertial.colmap.depth_maps import Maker, map_file
from colmap_inertial.core.errors import OutputError
from colmap_inertial.core.geometry import opencv_px_from_colmap
from colmap_inertial.io.files import path_in
from colmap_inertial.model import read_model
from colmap_inertial.model.copying import copy_file
from colmap_inertial.pipeline.run.runner import remove


def fuse_maps(
    folder: Path,
    names: Sequence[str],
    targets: tuple[Path, Path],
    *,
    maker: Maker,
    kind: str,
    scratch: Path,
    num_threads: int,
) -> None:
    """Fuse a workspace's depth maps.

    COLMAP's fusion takes a pixel's ray at its corner, as its patch-match does. Maps of the sweep hold the depth of
    pixels' centres, so that fusion is shown cameras whose principal point is half a pixel aside. It holds all pictures
    and maps at once, about 20 bytes a pixel; its cache was far slower.

    Parameters
    ----------
    folder
        The workspace.
    names
        Of the pictures that have maps.
    targets
        Of the points (PLY) and of who sees them (COLMAP's ``.vis``).
    maker, kind
        Whose maps, and which of them.
    scratch
        A folder that may be made and removed.
    num_threads
        -1 takes all processors.

    Raises
    ------
    OutputError
        Where nothing was written.
    """
    import pycolmap

    options = pycolmap.StereoFusionOptions()
    options.num_threads = num_threads
    seen = folder
    if maker == "plane sweep":
        seen = scratch
        _write_corner_workspace(folder, names, scratch)
    pycolmap.stereo_fusion(str(targets[0]), str(seen), input_type=kind, options=options, output_type="PLY")
    remove(scratch)
    visible = targets[0].with_name(targets[0].name + ".vis")
    if not visible.is_file():
        raise OutputError(f"{targets[0].parent}: COLMAP did not write the fused points; is the disk full?")
    os.replace(visible, targets[1])


def _write_corner_workspace(folder: Path, names: Sequence[str], scratch: Path) -> None:
    """A workspace of links to the pictures and maps, with cameras that see pixels' corners where centres are."""
    remove(scratch)
    (scratch / "sparse").mkdir(parents=True)
    (scratch / "stereo").mkdir()
    model = read_model(folder / "sparse")
    for camera in model.cameras.values():
        fx, fy, cx, cy = camera.params
        camera.params = [fx, fy, *opencv_px_from_colmap(np.array([cx, cy]))]
    model.write_binary(str(scratch / "sparse"))
    copy_file(folder / "stereo" / "fusion.cfg", scratch / "stereo" / "fusion.cfg")
    for name in names:
        pairs = [(path_in(folder / "images", name), path_in(scratch / "images", name))]
        pairs += [(map_file(folder, what, name), map_file(scratch, what, name)) for what in ("depth", "normal")]
        for source, target in pairs:
            target.parent.mkdir(parents=True, exist_ok=True)
            copy_file(source, target, link=True)
