"""The tables of a capture.toml that describe what the device computed or measured beside the frames.

.. code-block:: toml

    [poses]
    path = "8653a2142b"         # an export of an app, with its depth maps; or a path in TUM format, in metres
    up = "y"                    # of TUM: the axis of its world against gravity, where it has one (ARKit, ARCore: y)

    [depth]
    folder = "depth"            # maps that show what the images show, in any size
    pattern = "{stem}.png"      # the map of an image by its name without ending
    unit = "mm"                 # of each step: m, cm or mm; or metres_per_step = 0.0002
    confidence = "confidence"   # a folder of the same names: only what has the highest level counts
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types.depth import DepthMaps, PinholeGrid
from colmap_inertial.io.depth_maps import DepthFiles
from colmap_inertial.io.files import path_in
from colmap_inertial.io.toml_section import Section

DEPTH_KEYS = ("folder", "pattern", "unit", "metres_per_step", "confidence")
POSES_KEYS = ("path", "up")
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_STEM = "{stem}"


@dataclass(frozen=True, kw_only=True)
class DescribedDepth:
    """Depth maps in a folder.

    Attributes
    ----------
    folder, pattern
        The map of an image is the file that the pattern names, with its name's stem in place of ``{stem}``.
    metres
        Metres for each step of a map's numbers.
    confidence
        Folder of maps of confidence, of the same names; ``None`` where there are none.
    """

    folder: Path
    pattern: str
    metres: float
    confidence: Path | None = None

    def maps(self, names: tuple[str, ...], view: PinholeGrid) -> DepthMaps:
        """The maps of images, in their order.

        Parameters
        ----------
        names
            Of the images; those without a map are left out.
        view
            Intrinsics of the images.

        Raises
        ------
        FormatError
            Where the folder is missing.
        """
        for folder in (self.folder, self.confidence):
            if folder is not None and not folder.is_dir():
                raise FormatError(folder, Fact("no-such-file", what="folder of depth maps"))
        stems = {name: self.pattern.replace(_STEM, str(Path(name).with_suffix(""))) for name in names}
        depth = {name: path for name, file in stems.items() if (path := path_in(self.folder, file)).is_file()}
        confidence = {}
        if self.confidence is not None:
            paths = {name: path_in(self.confidence, stems[name]) for name in depth}
            confidence = {name: path for name, path in paths.items() if path.is_file()}
        return DepthFiles(
            depth=depth,
            confidence=confidence,
            view=view,
            metres=self.metres,
            source=str(self.folder),
            is_fused=False,
        ).maps()


def read_depth_table(table: Section) -> DescribedDepth:
    """``[depth]``: maps that nothing else describes."""
    folder = table.require("folder", table.file("folder"))
    pattern = table.text("pattern") or "{stem}.png"
    if _STEM not in pattern or Path(pattern).is_absolute() or ".." in Path(pattern).parts:
        table.fail("pattern", Fact("depth-pattern-without-stem", found=repr(pattern)))
    unit, metres = table.choice("unit", _UNITS), table.positive("metres_per_step")
    if (unit is None) == (metres is None):
        table.fail("unit", Fact("depth-without-unit", units=tuple(_UNITS)))
    if metres is None:
        assert unit is not None
        metres = _UNITS[unit]
    return DescribedDepth(folder=folder, pattern=pattern, metres=metres, confidence=table.file("confidence"))


@dataclass(frozen=True, kw_only=True)
class DevicePoses:
    """Where the path lies that the device computed by itself.

    Attributes
    ----------
    path
        An app's export, which may hold depth maps, too, or a file in TUM format, in metres.
    up_in_world
        (3,) against gravity in the world of a file; exports know it, or do not.
    """

    path: Path
    up_in_world: tuple[float, float, float] | None = None


def read_poses_table(table: Section) -> DevicePoses:
    """``[poses]``: the device's own path."""
    path: Path = table.require("path", table.file("path"))
    up = table.choice("up", _AXES)
    return DevicePoses(path=path, up_in_world=None if up is None else _AXES[up])
