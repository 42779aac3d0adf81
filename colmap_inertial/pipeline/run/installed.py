"""Packages that overwrite each other: several distributions bring the same module, and the last one installed wins."""

from __future__ import annotations

import importlib.metadata
import logging
from collections.abc import Mapping

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


def conflicts() -> list[str]:
    """A sentence for each module that several installed distributions bring, on what to do."""
    found = []
    for module, names in _PROVIDERS.items():
        there = [f"{name} {version}" for name in names if (version := _version(name)) is not None]
        if len(there) > 1:
            kept = there[-1].split()[0] if module == "pycolmap" else there[0].split()[0]
            every = " ".join(one.split()[0] for one in there)
            found.append(
                f"{' and '.join(there)} are installed, and each brings the module {module}: the files of the last one "
                f"overwrote the others'; keep one of them: pip uninstall {every}; pip install {kept}"
            )
    return found


def warn_of_conflicts() -> None:
    """Say them, before a run fails in a way that does not tell."""
    for sentence in conflicts():
        log.warning("%s", sentence)


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
