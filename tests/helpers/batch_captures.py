"""Small captures for the tests of batches and scripts: the first frames of the example scene."""

from pathlib import Path

from tests.run.commands.test_reconstruct import DETERMINISTIC, copy_scene

#: A capture of them is reconstructed in about three seconds.
TINY = DETERMINISTIC
FRAMES = 12


def tiny_capture(folder: Path, *, frames: int = FRAMES, half: bool = True) -> Path:
    """A capture of a few frames."""
    return copy_scene(folder, first=frames, half=half)


def model_bytes(out: Path) -> dict[str, bytes]:
    """Every file of the models that a reconstruction made."""
    found = [path for name in ("colmap/sparse", "sparse") for path in (out / name).rglob("*") if path.is_file()]
    return {str(path.relative_to(out)): path.read_bytes() for path in sorted(found)}
