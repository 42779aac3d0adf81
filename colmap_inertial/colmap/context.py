"""How the work of a run is done: threads, seed, device, COLMAP's settings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from colmap_inertial.colmap.chunks import Executor
from colmap_inertial.colmap.executable import ColmapExecutable, Device, read_executable
from colmap_inertial.colmap.settings import NO_SETTINGS, ColmapSettings, read_settings
from colmap_inertial.colmap.workers import get_executor
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.core.progress import Progress, silent

Features = Literal["sift", "aliked"]


@dataclass(frozen=True, eq=False, kw_only=True)
class RunContext:
    """Settings of the work: progress, threads, seed, limits.

    Attributes
    ----------
    scratch
        A folder for temporary files; that of a session where there is one.
    num_threads
        Of COLMAP; -1 uses all.
    seed
        Of COLMAP.
    device
        What COLMAP finds and matches features on.
    features
        What COLMAP finds and matches.
    colmap
        What the user set of COLMAP's own options.
    executable
        An installed COLMAP that finds and matches features and maps; ``None`` where pycolmap does.
    executor
        Who maps parts of a long capture; on a cluster, who finds features and matches pairs, too.
    progress
        Hears how far it is.
    """

    scratch: Path = Path()
    num_threads: int = -1
    seed: int = 0
    device: Device = "cpu"
    features: Features = "sift"
    colmap: ColmapSettings = NO_SETTINGS
    executable: ColmapExecutable | None = None
    executor: Executor = field(default_factory=get_executor)
    progress: Progress = silent

    @classmethod
    def of(cls, options: ReconstructOptions, *, device: Device = "cpu", progress: Progress = silent) -> RunContext:
        """Settings from the options of a reconstruction; an ``InertialError`` for options that COLMAP does not have."""
        num_threads = 1 if options.deterministic else -1
        settings = read_settings(options.colmap, options.colmap_project)
        executable = None
        if options.colmap_executable is not None:
            if get_executor().remote:
                raise InertialError(Fact("executable-with-scheduler"))
            executable = read_executable(
                options.colmap_executable, options.mapping, settings, deterministic=options.deterministic
            )
        return cls(
            num_threads=num_threads,
            seed=options.seed,
            device=device,
            features=options.mapping.features,
            colmap=settings,
            executable=executable,
            progress=progress,
        )

    def reporting(self, progress: Progress) -> RunContext:
        """The same, heard by somebody else."""
        return replace(self, progress=progress)

    def identity(self) -> dict[str, object]:
        """Settings that decide a result, without listeners and places."""
        values: dict[str, object] = {
            name: getattr(self, name) for name in ("num_threads", "seed", "device", "features")
        }
        return values if self.executable is None else {**values, "executable": self.executable.identity()}
