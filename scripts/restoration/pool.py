"""Training samples on disk, made in parallel, each batch from its own seed: an unfinished pool is taken up again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from colmap_inertial.core.arrays import IndexArray
from scripts.restoration.photographs import photographs
from scripts.restoration.samples import BLUR_CHANNELS, MARGIN, SIDE, Maker, Material, Samples

#: Samples that are made together: they have much the same blur, and as many instants are rendered for each.
BATCH = 16
_ARRAYS = ("picture", "aid", "truth", "blur")
#: Modules whose code decides what samples look like.
_MAKING = ("camera", "handheld", "optics", "photographs", "samples")


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Where samples come from: folders of photographs and of recorded motion, and whether those to measure with."""

    photos: Path
    motion: Path | None
    held_out: bool = False


class Pool:
    """``count`` samples in a folder of NumPy files, opened for reading."""

    def __init__(self, folder: Path) -> None:
        self.arrays: dict[str, NDArray[np.generic]] = {
            name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in _ARRAYS
        }

    def __len__(self) -> int:
        return len(self.arrays["picture"])

    def batch(self, which: Sequence[int] | IndexArray) -> Samples:
        """Some of them."""
        order = np.sort(np.asarray(which))
        return Samples(**{name: np.asarray(array[order]) for name, array in self.arrays.items()})


def make_pool(
    folder: Path, maker: Maker, sources: Sources, count: int, *, seed: int, device: str, workers: int
) -> Pool:
    """Make the samples that are not there yet.

    Parameters
    ----------
    folder
        Created where absent; one that holds samples made otherwise is an error.
    maker
        ``deepgyro_samples`` or ``lsd2_samples``.
    count
        Rounded up to whole batches.
    device
        ``cuda`` makes them in this process; with ``cpu``, ``workers`` processes share the work.
    """
    batches = -(-count // BATCH)
    side = SIDE - 2 * MARGIN
    made = {"maker": maker.__name__, "batches": batches, "seed": seed, "recipe": _recipe(sources)}
    folder.mkdir(parents=True, exist_ok=True)
    about = folder / "pool.json"
    if about.exists() and json.loads(about.read_text()) != made:
        raise SystemExit(f"{folder} holds other samples ({about.read_text().strip()}): name another folder")
    if not about.exists():
        for name in _ARRAYS:
            shape = (batches * BATCH, side, side, 3)
            if name == "blur":
                shape = (batches * BATCH, side // 2, side // 2, BLUR_CHANNELS[maker.__name__])
            kind = np.float16 if name == "blur" else np.uint8
            np.lib.format.open_memmap(folder / f"{name}.npy", mode="w+", dtype=kind, shape=shape).flush()
        about.write_text(json.dumps(made) + "\n")
    done = {int(p.stem) for p in folder.glob("*.done")}
    todo = [i for i in range(batches) if i not in done]
    if device == "cpu" and len(todo) > 1 and workers > 1:
        with ProcessPoolExecutor(workers, initializer=_begin, initargs=(maker, sources, folder, seed, device)) as pool:
            for _ in track(pool.map(_make, todo), f"samples in {folder}", total=len(todo)):
                pass
    elif todo:
        _begin(maker, sources, folder, seed, device)
        for i in track(todo, f"samples in {folder}"):
            _make(i)
    return Pool(folder)


def _recipe(sources: Sources) -> str:
    """What decides samples beside their seed: the code that makes them, and what it makes them of."""
    code = [Path(__file__).with_name(f"{name}.py") for name in _MAKING]
    used = [*photographs(sources.photos, held_out=sources.held_out)]
    used += [] if sources.motion is None else sorted(sources.motion.glob("*.csv.xz"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in code))
    digest.update("\n".join(f"{path.name} {path.stat().st_size}" for path in used).encode())
    return digest.hexdigest()[:16]


_work: tuple[Maker, Material, Path, int, str] | None = None


def _begin(maker: Maker, sources: Sources, folder: Path, seed: int, device: str) -> None:
    """Load what a process needs to make samples."""
    global _work
    if device == "cpu":
        torch.set_num_threads(1)
    material = Material.load(sources.photos, sources.motion, held_out=sources.held_out)
    _work = maker, material, folder, seed, device


def _make(index: int) -> None:
    """Make one batch and write it to its place."""
    assert _work is not None
    maker, material, folder, seed, device = _work
    samples = maker(material, BATCH, np.random.default_rng([seed, index]), device)
    place = slice(BATCH * index, BATCH * (index + 1))
    for name in _ARRAYS:
        np.load(folder / f"{name}.npy", mmap_mode="r+")[place] = getattr(samples, name)
    (folder / f"{index}.done").touch()
