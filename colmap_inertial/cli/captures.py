"""Commands that begin with a capture: images or video, and the IMU recorded with it."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from colmap_inertial.cli.screen import Screen
from colmap_inertial.cli.speech import ConfiguredCommand, DeviceCommand, Reader
from colmap_inertial.cli.terminal import show_deblurred, show_fused, show_reference, show_result
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.options import (
    ApertureOptions,
    BatchOptions,
    BlurRemover,
    DeblurPurpose,
    ExposureOptions,
    FuseAperturesOptions,
    ProjectOptions,
    ReferenceOptions,
)
from colmap_inertial.core.printing import say


@dataclass(frozen=True, kw_only=True)
class Reconstruct(DeviceCommand, ConfiguredCommand):
    """Turn images or video with an IMU recording into a COLMAP model in metres, gravity along an axis.

    OUT is a COLMAP project in metres: OUT/images, OUT/sparse, and with --dense OUT/dense; beside it are
    OUT/trajectory.tum, OUT/report.html and OUT/result.json. What COLMAP saw and made, in its own units, is in
    OUT/colmap. Without an accepted scale there is no OUT/sparse. Started again, it does what is missing, such as the
    dense reconstruction with --dense. Options that change a finished result need another OUT, or --overwrite.

    CAPTURE may be an existing COLMAP project: give --imu, and when its images were taken. Nothing is mapped again, and
    OUT is all of the project in metres. Without an IMU --scale-from takes the metres from a target or a known distance:
    of a folder of pictures, a video, a capture, or a project (OUT/colmap of a run whose scale was refused).

    Example: colmap-inertial reconstruct my_capture/capture.toml out
    """

    capture: Positional[Path]
    """A capture.toml or a folder that holds one; a video or a recorder's folder with the IMU in it (GoPro, phones); an
    EuRoC/ASL dataset; or a COLMAP project. With --scale-from target or distance also images or a video without
    IMU."""
    out: Positional[Path]
    """A new folder for the results, or that of an earlier run on the same capture, which is continued."""
    project: Annotated[ProjectOptions, arg(name="")] = dataclasses.field(default_factory=ProjectOptions)
    reference: Annotated[ReferenceOptions, arg(name="")] = dataclasses.field(default_factory=ReferenceOptions)
    workers: int | None = None
    """Processes that map the parts of a long capture; by default one for each processor. Their number does not change
    the result."""
    overwrite: bool = False
    """Where OUT holds a finished result of other options, or of a recording that was changed since: make again in place
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
            return self._by_reference() if self.reference.scale_from != "imu" else self._by_imu()

    def _by_imu(self) -> int:
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
                    overwrite=self.overwrite,
                    progress=screen,
                    findings=findings,
                )
            else:
                result = reconstruct(
                    self.capture, self.out, options, overwrite=self.overwrite, progress=screen, findings=findings
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

    def _by_reference(self) -> int:
        self.check_json(self.capture, self.project.imu, self.project.frame_times)
        from colmap_inertial.run.commands.reconstruct_project import is_project
        from colmap_inertial.run.commands.scale_by_reference import reconstruct_by, scale_project_by

        with self.progress() as screen:
            if is_project(self.capture):
                reference = scale_project_by(self.capture, self.out, self.reference, self.project, progress=screen)
            else:
                reference = reconstruct_by(self.capture, self.out, self.reference, self.options, progress=screen)
        self.tell(lambda: show_reference(reference), reference.as_json(), {"out": reference.out, "exit_code": 0})
        return 0


@dataclass(frozen=True, kw_only=True)
class Deblur(Reader):
    """Undo the motion blur of images by the gyroscope.

    Writes OUT/images with the frames' names, sizes, formats and metadata, and OUT/result.json with what happened to
    each of them and why. Frames that are sharp, or in which the gyroscope's blur does not show, are copied as they
    are. Exit code 3 where the gyroscope does not belong to the pixels, as in stabilised video.

    Example: colmap-inertial deblur my_capture/capture.toml out --sheet before_after.png
    """

    capture: Positional[Path]
    """A capture.toml, a folder that holds one, or an EuRoC/ASL dataset; with exposure times."""
    out: Positional[Path]
    """A new folder for the results, or that of an earlier run on the same capture, which is continued."""
    method: BlurRemover = "wiener"
    """wiener: a Wiener filter along the path of each pixel. path: along the same path, a filter that expects few and
    strong edges (slower). deepgyro: a network, which also sees what a filter makes of the picture (slower;
    needs the extra `restore`)."""
    purpose: Annotated[DeblurPurpose, arg(name="for")] = "viewing"
    """viewing: as sharp as the method makes them. matching: smoothed a little, as `reconstruct` shows them to
    COLMAP."""
    calibration: tuple[Path, ...] = ()
    """Calibration files of this device: from `align --out`, from `calibrate-imu --out`, or both."""
    rectify: bool = False
    """Undo the rolling shutter, too (needs its readout time); OUT/colmap/images are those with it."""
    sheet: Path | None = None
    """Write a PNG with parts of the most blurred frames before and after."""
    overwrite: bool = False
    """Where OUT holds a finished result of other options: make it again."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.images_alone import deblur_capture

        self.check_json(self.capture)
        with self.progress() as progress:
            result = deblur_capture(
                self.capture,
                self.out,
                method=self.method,
                purpose=self.purpose,
                calibration=self.calibration,
                rectify=self.rectify,
                sheet=self.sheet,
                overwrite=self.overwrite,
                progress=progress,
            )
        self.tell(
            lambda: show_deblurred(result), result.workspace.result, {"out": self.out, "unchanged": result.unchanged}
        )
        return 0


class Fuser(Reader):
    """Options shared by the commands that fuse several pictures into one."""

    out: Path

    def tell_fused(self, lines: Sequence[str], screen: Screen) -> None:
        """Say what became of the pictures."""
        from colmap_inertial.run.steps.workspace import Workspace

        result = Workspace(self.out).result
        self.tell(lambda: show_fused(lines, screen), result, {"out": self.out, "unchanged": screen.unchanged})


@dataclass(frozen=True, kw_only=True)
class FuseApertures(Fuser):
    """Make RGB pictures of a multi-aperture camera's sub-images.

    One disparity map from all apertures takes their parallax out. Writes OUT/images, seen through the first aperture,
    with the names of its pictures; with --refocus OUT/refocused; with --depth OUT/disparity and OUT/depth.

    Example: colmap-inertial fuse-apertures my_capture/capture.toml out --refocus 0.8
    """

    capture: Positional[Path]
    """A capture.toml with [images] and [apertures], or a folder that holds one; no IMU is needed."""
    out: Positional[Path]
    """A new folder, or that of an earlier run on the same capture, which is continued."""
    refocus: float | None = None
    """Also write pictures that are sharp at this depth only, in metres."""
    lens_width: float = 1.0
    """Width of the lens that refocused pictures show, in distances between the first two apertures."""
    fusion: Annotated[ApertureOptions, arg(name="")] = dataclasses.field(default_factory=ApertureOptions)
    overwrite: bool = False
    """Where OUT holds a finished result of other options: make it again."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.images_alone import fuse_captured

        options = FuseAperturesOptions(fusion=self.fusion, refocus=self.refocus, lens_width=self.lens_width)
        self.check_json(self.capture)
        with self.progress() as screen:
            written = fuse_captured(self.capture, self.out, options, overwrite=self.overwrite, progress=screen)
        self.tell_fused([f"{len(written)} pictures in {self.out / 'images'}"], screen)
        return 0


@dataclass(frozen=True, kw_only=True)
class FuseExposures(Fuser):
    """Make one clean, sharp picture of each short and long exposure.

    The long one is brought to the short one's geometry, by the gyroscope where there is one and by the pixels; a
    network makes one picture of the two (needs the extra `restore`). Writes OUT/images with the short ones' names,
    sizes, formats and metadata, as bright as the long ones, and OUT/result.json with what was done to each.

    Example: colmap-inertial fuse-exposures my_capture/capture.toml out --fusion mertens
    """

    capture: Positional[Path]
    """A capture.toml with [images] and [exposures], or a folder that holds one; times and an IMU are welcome."""
    out: Positional[Path]
    """A new folder, or that of an earlier run on the same capture, which is continued."""
    fusion: Literal["none", "mertens"] = "none"
    """Blend the fused picture with the short exposure, which shows what clips in the long one."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """What the network runs on; auto: CUDA where onnxruntime has it."""
    calibration: tuple[Path, ...] = ()
    """Calibration files of this device: from `align --out`, from `calibrate-imu --out`, or both."""
    overwrite: bool = False
    """Where OUT holds a finished result of other options: make it again."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.images_alone import fuse_exposures_captured

        options = ExposureOptions(fusion=self.fusion, device=self.device)
        self.check_json(self.capture)
        with self.progress() as screen:
            pairs = fuse_exposures_captured(
                self.capture,
                self.out,
                options,
                calibration=self.calibration,
                overwrite=self.overwrite,
                progress=screen,
            )
        fused = sum(pair.fused for pair in pairs)
        lines = [f"{fused} of {len(pairs)} pairs fused in {self.out / 'images'}"]
        self.tell_fused([*lines, *(f"{pair.name} {pair.reason}" for pair in pairs if not pair.fused)], screen)
        return 0


@dataclass(frozen=True, kw_only=True)
class Batch(ConfiguredCommand):
    """Reconstruct many captures, each in a process of its own; one that fails does not stop the rest.

    MANIFEST is a TOML file with a [[capture]] table for each: path (from the manifest's folder), and optionally name,
    config (a TOML file with options), options and stages (with --allow-stages); or a folder in which every folder is a
    capture. Writes OUT/NAME for each capture as reconstruct does, OUT/status/NAME.json with how far it is,
    OUT/summary.csv and OUT/summary.json. Started again, it takes up what has no result yet. Exit code 0 when every
    capture is done, 1 when one is not.

    Example: colmap-inertial batch captures.toml out
    """

    manifest: Positional[Path]
    """A TOML file that lists captures, or a folder of captures."""
    out: Positional[Path]
    """A new folder, or that of an earlier run."""
    batch: Annotated[BatchOptions, arg(name="")] = dataclasses.field(default_factory=BatchOptions)
    allow_stages: bool = False
    """Import and run the stages that the manifest names: they are code that its author chose."""
    config: Path | None = None
    """TOML file with options for all captures; options given here override it, the manifest's override both."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.tools.batch import run_batch
        from colmap_inertial.tools.batch.terminal import live_batch, show_batch

        self.check_json(self.manifest)
        with live_batch(quiet=self.quiet) as watch:
            result = run_batch(
                self.manifest, self.out, self.options, batch=self.batch, watch=watch, allow_stages=self.allow_stages
            )
        code, file = result.exit_code(), self.out / "summary.json"
        self.tell(lambda: show_batch(result), file, {"out": self.out, "unchanged": result.unchanged, "exit_code": code})
        return code


@dataclass(frozen=True, kw_only=True)
class Simulate(Reader):
    """Make a simulated capture with known truth: a desk or a room.

    It is filmed by hand, with the IMU recorded with it.

    Example: colmap-inertial simulate example_scenes/rolling_shutter/recipe.toml my_scene
    """

    recipe: Positional[Path]
    """A recipe (TOML): world, motion, IMU, camera, checkerboard; see example_scenes/."""
    out: Positional[Path]
    """A new folder for pictures or video, IMU files, capture.toml and truth.json."""
    workers: int = os.cpu_count() or 1
    """Processes that render; a frame of 640 x 480 takes one to three seconds of one core, more where it is blurred."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.tools.simulate.capture import write_capture
        from colmap_inertial.tools.simulate.recipe import load_recipe

        self.check_json(self.recipe)
        recipe = load_recipe(self.recipe)
        with self.progress() as progress:
            capture = write_capture(
                recipe, self.out, workers=self.workers, progress=lambda done, total: progress("rendering", done, total)
            )
        self.tell(lambda: say(capture), {"out": self.out, "capture": capture})
        return 0
