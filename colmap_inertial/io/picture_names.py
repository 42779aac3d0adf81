"""Names of a model's images: only names, until an image is looked for."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import name_fault, path_in


def check_image_names(names: Iterable[str], source: Path | str) -> None:
    """Refuse names of images that nothing can hold: empty ones, and such as are no UTF-8 or hold a control character.

    Where a name leads to does not matter while it is only a name; see :func:`picture_in` for when it becomes a path.

    Raises
    ------
    FormatError
        For such a name.
    """
    for name in names:
        fault = name_fault(name.replace("/", ""))
        if fault is not None and fault.code in ("is-empty", "name-unprintable"):
            raise FormatError(source, Fact("unsafe-name", name=name[:80], fault=fault))


def picture_in(folder: Path, name: str, source: Path | str | None = None) -> Path:
    """The path of an image by its name in a model; of one that leads elsewhere, of its last parts that are there.

    Some programs name images by absolute paths, or by such that begin with ``..``: these are only names.

    Raises
    ------
    FormatError
        As of :func:`path_in`.
    """
    parts = [part for part in re.split(r"[/\\]", name) if part not in ("", ".")]
    is_plain = not Path(name).anchor and not re.match(r"[/\\]|[A-Za-z]:[/\\]", name)
    if is_plain and ".." not in parts:
        return path_in(folder, name, source)
    last = len(parts) - 1 - parts[::-1].index("..") if ".." in parts else -1
    tails = ["/".join(parts[i:]) for i in range(last + 1, len(parts))]
    paths = [path_in(folder, tail, source) for tail in tails if name_fault(tail) is None]
    return next((path for path in paths if path.is_file()), paths[-1] if paths else path_in(folder, name, source))
