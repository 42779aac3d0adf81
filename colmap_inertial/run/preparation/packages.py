"""Installed packages that overwrite each other's files, named before they cause failures that do not name them."""

from __future__ import annotations

import importlib.metadata
import logging
from collections.abc import Mapping

from colmap_inertial.core.facts import Fact

log = logging.getLogger(__name__)

#: By module, the distributions that bring it.
_PROVIDERS: Mapping[str, tuple[str, ...]] = {
    "pycolmap": ("pycolmap", "pycolmap-cuda12", "pycolmap-cuda11", "pycolmap-cuda"),
    "cv2": (
        "opencv-contrib-python-headless",
        "opencv-contrib-python",
        "opencv-python-headless",
        "opencv-python",
    ),
}


def find_conflicts() -> list[Fact]:
    """Each module that several installed distributions bring, and which of these to keep."""
    found = []
    for module, names in _PROVIDERS.items():
        installed = {name: version for name in names if (version := _find_version(name)) is not None}
        if len(installed) > 1:
            # of pycolmap the one with CUDA, of OpenCV the one with more modules
            keep = [*installed][-1 if module == "pycolmap" else 0]
            found.append(Fact("packages-of-one-module", module=module, installed=installed, keep=keep))
    return found


def warn_of_conflicts() -> None:
    """Log conflicts of installed packages."""
    for conflict in find_conflicts():
        log.warning("%s", conflict.with_advice)


def _find_version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
