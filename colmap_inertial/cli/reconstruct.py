"""Arguments of ``colmap-inertial reconstruct``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from colmap_inertial.cli.command import ConfiguredCommand, DeviceCommand
from colmap_inertial.cli.terminal import show_reference, show_result
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.options import ProjectOptions, ReferenceOptions
from colmap_inertial.core.printing import say


@dataclass(frozen=True, kw_only=True)
class Reconstruct(DeviceCommand, ConfiguredCommand):
    """Turn images or video with an IMU recording into a COLMAP model in metres, gravity along an axis.

    OUT is a COLMAP project in metres: OUT/images, OUT/sparse, and with --dense OUT/dense; beside it are
    OUT/trajectory.tum, OUT/report.html and OUT/result.json. What COLMAP saw and made, in its own units, is in
    OUT/colmap. Without an accepted scale there is no OUT/sparse. Started again, it does what is missing, such as the
    dense reconstruction with --dense. Options that change a finished result need another OUT, or --overwrite.

    CAPTURE may be an existing COLMAP project: give --imu, and when its images were taken. Nothing is mapped again, and
    OUT is all of the project in metres. Without an IMU, depth maps, positions (GPS), a target or a known distance give
    metres (--scale-from): of a folder of images, a video, a capture, an app's export, or a project (OUT/colmap of a run
    whose scale was refused).

    Example: colmap-inertial reconstruct my_capture/capture.toml out
    """

    common: ClassVar = ("dense", "calibration", "deblur", "rolling_shutter", "world", "config", "force", "overwrite")
    resumes: ClassVar = True

    capture: Positional[Path]
    """A capture.toml or a folder that holds one; a video or a recorder's folder with the IMU in it (GoPro, phones); an
    EuRoC/ASL dataset; an app's export with depth maps; or a COLMAP project. With --scale-from also images or a video
    without IMU."""
    out: Positional[Path]
    """A new folder for the results, or that of an earlier run on the same capture, which is continued."""
    project: Annotated[ProjectOptions, arg(name="")] = dataclasses.field(default_factory=ProjectOptions)
    reference: Annotated[ReferenceOptions, arg(name="")] = dataclasses.field(default_factory=ReferenceOptions)
    workers: int | None = None
    """Processes that map the parts of a long capture (default: one per processor). Their number does not change
    the result."""
    overwrite: bool = False
    """If OUT holds a finished result of other options, or of a recording that was changed since, make again in place
    what depends on that, and keep the rest."""
    scheduler: str | None = None
    """Address of a Dask scheduler (tcp://host:8786), whose workers find features, match pairs and map parts (needs the
    extra `cluster`, and OUT under the same path everywhere). With --deterministic they do not change the result."""

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"workers must be at least 1, not {self.workers}")
        if self.workers is not None and self.scheduler is not None:
            raise ValueError("--workers are those of this machine; with --scheduler, the cluster has its own")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.colmap.workers import using_workers

        with using_workers(self.workers, scheduler=self.scheduler):
            return self._scale_by_imu() if self._uses_imu() else self._scale_without_imu()

    def _uses_imu(self) -> bool:
        """Whether the IMU's metres count, or its clock and gravity; lengths alone need none."""
        from colmap_inertial.run.commands.scale_by_reference import has_imu, knows_metres

        chosen, lengths = set(self.options.scale_from), {"target", "distance"}
        given = any(getattr(self.reference, f.name) is not None for f in dataclasses.fields(self.reference))
        if chosen and chosen <= lengths:
            return False
        if "imu" in chosen or has_imu(self.capture, self.project):
            return True
        return not (chosen or given or knows_metres(self.capture, self.project))

    def _scale_by_imu(self) -> int:
        from colmap_inertial.diagnose import Diagnosis
        from colmap_inertial.run.commands.reconstruct import reconstruct
        from colmap_inertial.run.commands.reconstruct_project import is_project, reconstruct_project

        self.check_json(self.capture, self.project.imu, self.project.frame_times)
        options = self.options
        if not options.deterministic:
            calibration = self.add_remembered(options.calibration, self.project.imu or self.capture)
            options = dataclasses.replace(options, calibration=calibration)
        with self.progress() as screen:

            def findings(diagnosis: Diagnosis) -> None:
                screen.findings(diagnosis, stops=not options.force)

            if self.project != ProjectOptions() or is_project(self.capture):
                result = reconstruct_project(
                    self.capture,
                    self.out,
                    self.project,
                    options,
                    reference=self.reference,
                    overwrite=self.overwrite,
                    progress=screen,
                    findings=findings,
                )
            else:
                result = reconstruct(
                    self.capture,
                    self.out,
                    options,
                    reference=self.reference,
                    overwrite=self.overwrite,
                    progress=screen,
                    findings=findings,
                )
        code, stopped = 0, None
        try:
            code = result.exit_code()
        except InertialError as error:
            code, stopped = error.exit_code, str(error)
        self.tell(
            lambda: show_result(result, self.capture),
            result.workspace.result,
            {"out": self.out, "unchanged": result.unchanged, "exit_code": code, "error": stopped},
        )
        if stopped is not None:
            shown_above = self.talks and code == 3
            say(f"error: {'no scale was accepted, for the reasons above' if shown_above else stopped}", error=True)
        return code

    def _scale_without_imu(self) -> int:
        self.check_json(self.capture, self.project.imu, self.project.frame_times)
        from colmap_inertial.run.commands.reconstruct_project import is_project
        from colmap_inertial.run.commands.scale_by_reference import reconstruct_by, scale_project_by

        with self.progress() as screen:
            if is_project(self.capture):
                reference = scale_project_by(
                    self.capture,
                    self.out,
                    self.reference,
                    self.project,
                    scale_from=self.options.scale_from,
                    world=self.options.world,
                    progress=screen,
                )
            else:
                reference = reconstruct_by(self.capture, self.out, self.reference, self.options, progress=screen)
        self.tell(lambda: show_reference(reference), reference.as_json(), {"out": reference.out, "exit_code": 0})
        return 0
