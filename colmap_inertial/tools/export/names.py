"""Names of pictures that every trainer takes."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import PurePosixPath

#: Endings of pictures that stay JPEG; all others become PNG.
_JPEG = (".jpg", ".jpeg")
#: Longest stem, so that a number still fits in front of the ending.
_LONGEST = 100


def flat_names(names: Iterable[str]) -> dict[str, str]:
    """A file name for each image: no folder, no dot but the ending's, unique without regard to case.

    Some trainers cut a name at its first dot, some look at its last part alone, and some file systems take ``A.jpg``
    and ``a.jpg`` for the same file.

    Parameters
    ----------
    names
        Image names as COLMAP has them; each once.

    Returns
    -------
    dict
        The new name of each, in the order of the names.
    """
    found: dict[str, str] = {}
    taken: set[str] = set()
    tried: dict[str, int] = {}
    for name in sorted(names):
        path = PurePosixPath(name.replace("\\", "/"))
        suffix = ".jpg" if path.suffix.lower() in _JPEG else ".png"
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", "_".join((*path.parts[:-1], path.stem)))[-_LONGEST:]
        # those of one stem go on counting where the one before stopped
        candidate, number = stem, tried.get(stem.lower(), 1)
        while candidate.lower() in taken:
            number += 1
            candidate = f"{stem}_{number}"
        tried[stem.lower()] = number
        taken.add(candidate.lower())
        found[name] = candidate + suffix
    return found
