"""Networks from files other than the package's own, for a benchmark while they are trained."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from colmap_inertial.imaging.restoration import shipped

_NAMES = ("deepgyro", "lsd2")


def use_weights(files: Sequence[Path], folder: Path) -> None:
    """From now on in this process, networks are those of ``files``, ``NAME.onnx`` each, before the package's.

    Parameters
    ----------
    files
        Those to be used; the package's serve for the others.
    folder
        Empty; what will be loaded is copied there.
    """
    packaged = [file for name in _NAMES if (file := Path(str(shipped.model_file(name)))).exists()]
    for file in [*packaged, *files]:
        if file.stem not in _NAMES:
            raise SystemExit(f"--weights {file}: must be named {' or '.join(f'{name}.onnx' for name in _NAMES)}")
        (folder / file.name).write_bytes(file.read_bytes())
    sums = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.glob("*.onnx")}
    (folder / "checksums.json").write_text(json.dumps(sums))
    shipped.folder = lambda: folder


def checksums() -> dict[str, str]:
    """First digits of the checksum of every network there is."""
    found = {name: Path(str(shipped.model_file(name))) for name in _NAMES}
    return {name: hashlib.sha256(f.read_bytes()).hexdigest()[:12] for name, f in found.items() if f.exists()}
