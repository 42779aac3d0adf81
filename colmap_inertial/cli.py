"""The command line: arguments, one call each, errors as one line. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Union

import tyro
from tyro.conf import Positional, arg, subcommand

from colmap_inertial import __version__
from colmap_inertial.errors import InertialError
from colmap_inertial.options import ProjectOptions, ReconstructOptions, ScaleOptions, ValidateOptions, WorldAxes

DESCRIPTION = """Metric, gravity-aligned COLMAP models from the gyroscope and accelerometer that filmed along.

Exit codes: 0 done, 1 a check failed, 2 bad input, 3 not observable (scale refused), 4 mapping failed,
5 target not found."""


@dataclass(frozen=True, kw_only=True)
class Reconstruct:
    """Turn images or video with an IMU recording into a COLMAP model in metres, gravity along an axis.

    Writes OUT/sparse (COLMAP's own model), OUT/sparse_metric (the same in metres), OUT/trajectory.tum, OUT/result.json;
    with --dense also OUT/dense_metric. Started again after an interruption, it continues with the last finished stage.

    CAPTURE may be an existing COLMAP project: give --imu, and when its images were taken. Nothing is mapped again, and
    OUT/project_metric is all of the project in metres.

    Example: colmap-inertial reconstruct my_capture/capture.toml out
    """

    capture: Positional[Path]
    """A capture.toml, a folder that holds one, an EuRoC/ASL dataset, or a COLMAP project."""
    out: Positional[Path]
    """A new folder for everything that is made."""
    project: Annotated[ProjectOptions, arg(name="")] = dataclasses.field(default_factory=ProjectOptions)
    options: Annotated[ReconstructOptions, arg(name="")] = dataclasses.field(default_factory=ReconstructOptions)
    config: Path | None = None
    """TOML file with options, as OUT/config.toml of an earlier run; flags given here go before it."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.pipeline import reconstruct
        from colmap_inertial.pipeline.existing import is_project, reconstruct_project
        from colmap_inertial.pipeline.terminal import live_progress, show_result

        with live_progress() as progress:
            if self.project != ProjectOptions() or is_project(self.capture):
                result = reconstruct_project(self.capture, self.out, self.project, self.options, progress=progress)
            else:
                result = reconstruct(self.capture, self.out, self.options, progress=progress)
        show_result(result)
        return result.exit_code()


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Metres per unit of an existing model or trajectory, without mapping.

    SOURCE is a COLMAP model folder (needs --imu and --frame-times), a trajectory in TUM format (needs --imu), or an
    InertialScale folder. Exit code 3 when the recording cannot give a scale; the JSON then says why.

    Example: colmap-inertial scale project/sparse/0 --imu imu.csv --frame-times frames.csv --json scale.json
    """

    source: Positional[Path]
    """COLMAP model folder, TUM trajectory, or InertialScale folder."""
    json: Path
    """Where to write the estimate."""
    imu: Path | None = None
    """IMU recording: a file or folder of a known format, or a capture.toml."""
    frame_times: Path | None = None
    """When the images were taken: a CSV with columns name,t_s, or a capture.toml."""
    calibration: Path | None = None
    """A calibration file of this device, used as a prior."""
    first_s: float | None = None
    """Use only this many seconds from the start of the camera's recording."""
    latitude_deg: float | None = None
    """Latitude of the recording, from which the strength of gravity follows."""
    options: Annotated[ScaleOptions, arg(name="")] = dataclasses.field(default_factory=ScaleOptions)
    config: Path | None = None
    """TOML file as OUT/config.toml of a reconstruction: its [scale] table counts; flags given here go before it."""

    def __post_init__(self) -> None:
        if self.first_s is not None and not self.first_s > 0:
            raise ValueError(f"first_s must be positive, not {self.first_s:g}")
        if self.latitude_deg is not None and not -90 <= self.latitude_deg <= 90:
            raise ValueError(f"latitude_deg must be from -90 to 90, not {self.latitude_deg:g}")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.pipeline.sources import ScaleSource, scale_source
        from colmap_inertial.pipeline.terminal import show_scale

        estimate = scale_source(
            ScaleSource(source=self.source, imu=self.imu, frame_times=self.frame_times, calibration=self.calibration),
            self.options,
            json=self.json,
            first_s=self.first_s,
            latitude_deg=self.latitude_deg,
        )
        show_scale(estimate, self.source)
        return 3 if estimate.verdict == "refused" else 0


@dataclass(frozen=True, kw_only=True)
class Apply:
    """Make a whole COLMAP project metric: sparse models, dense workspaces, point clouds, meshes, database.

    OUT mirrors PROJECT, which is only read; it appears whole or not at all, and OUT/transform.json says what was done.
    Give --scale, --factor or --sim3; or --undo to take back what an earlier run applied. Exit code 3 when every scale
    was refused; a sub-model with a refused scale keeps its own units.

    Example: colmap-inertial apply project project_metric --scale scale.json
    """

    project: Positional[Path]
    """A folder with a COLMAP model, and whatever was made from it."""
    out: Positional[Path]
    """A new folder."""
    scale: tuple[str, ...] = ()
    """What `colmap-inertial scale --json` wrote; with several sub-models one for each, as NUMBER=FILE, or the
    result.json of a reconstruction."""
    factor: float | None = None
    """Lengths times this; axes and origin stay."""
    sim3: Path | None = None
    """JSON with scale, rotation_xyzw, translation_m (and cov, provenance): x' = scale * R x + translation."""
    undo: bool = False
    """PROJECT was written by this command: write it in its old units."""
    world: WorldAxes = "z-up"
    """With --scale, axes of the metric project: z away from the ground, or y towards it."""
    link: bool = False
    """Hard links for files that do not change; an edit of one then changes the original, too."""
    keep: tuple[str, ...] = ()
    """Patterns of paths in PROJECT that are copied as they are, such as "old/*"."""

    def __post_init__(self) -> None:
        given = (bool(self.scale), self.factor is not None, self.sim3 is not None, self.undo)
        if sum(given) != 1:
            raise ValueError("give one of --scale, --factor, --sim3 and --undo")
        if self.undo and self.keep:
            raise ValueError("--undo keeps what was kept before; leave out --keep")
        if self.factor is not None and not 0 < self.factor < float("inf"):
            raise ValueError(f"factor must be positive, not {self.factor:g}")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.model.project import apply_to_project, undo_project
        from colmap_inertial.model.similarities import plain_factor, read_scales, read_similarity
        from colmap_inertial.pipeline.terminal import live_progress, show_applied

        scales: Any
        with live_progress() as progress:

            def files(done: int, total: int) -> None:
                progress("apply", done, total)

            if self.undo:
                applied = undo_project(self.project, self.out, link=self.link, progress=files)
            else:
                if self.sim3 is not None:
                    scales = read_similarity(self.sim3)
                elif self.factor is not None:
                    scales = plain_factor(self.factor)
                else:
                    scales = read_scales(self.scale, world=self.world)
                applied = apply_to_project(
                    self.project, self.out, scales, link=self.link, keep=self.keep, progress=files
                )
        show_applied(applied)
        return 0


@dataclass(frozen=True, kw_only=True)
class Align:
    """Rotation, time offset and gyro bias between the camera and the IMU of one device, from one recording.

    Needs no scale, only a camera that turned. The calibration file serves --calibration for later recordings of the
    same device. Exit code 3 when no time offset is better than the rest.

    Example: colmap-inertial align project/sparse/0 --imu imu.csv --frame-times frames.csv --out phone.json
    """

    source: Positional[Path]
    """COLMAP model folder, TUM trajectory, or InertialScale folder."""
    out: Path
    """Where to write the calibration (JSON)."""
    imu: Path | None = None
    """IMU recording: a file or folder of a known format, or a capture.toml."""
    frame_times: Path | None = None
    """When the images were taken: a CSV with columns name,t_s, or a capture.toml."""
    calibration: Path | None = None
    """An earlier calibration file of this device, used as a prior."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.pipeline.sources import ScaleSource, align_source
        from colmap_inertial.pipeline.terminal import show_calibration

        source = ScaleSource(
            source=self.source, imu=self.imu, frame_times=self.frame_times, calibration=self.calibration
        )
        show_calibration(align_source(source, self.out), self.source)
        return 0


@dataclass(frozen=True, kw_only=True)
class Diagnose:
    """What is wrong with a recording, and what to do, before any reconstruction.

    Exit code 1 when something makes a scale wrong or impossible, 0 when nothing is worse than a warning.

    Example: colmap-inertial diagnose my_capture/capture.toml --json findings.json
    """

    source: Positional[Path]
    """A capture, COLMAP model folder, TUM trajectory, InertialScale folder, or IMU recording."""
    json: Path | None = None
    """Where to write the findings."""
    imu: Path | None = None
    """IMU recording of a model or trajectory: a file or folder of a known format, or a capture.toml."""
    frame_times: Path | None = None
    """When the images were taken: a CSV with columns name,t_s, or a capture.toml."""
    calibration: Path | None = None
    """A calibration file of this device, used as a prior."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.pipeline.preflight import diagnose_source
        from colmap_inertial.pipeline.sources import ScaleSource
        from colmap_inertial.pipeline.terminal import live_progress, show_diagnosis

        source = ScaleSource(
            source=self.source, imu=self.imu, frame_times=self.frame_times, calibration=self.calibration
        )
        with live_progress() as progress:
            found = diagnose_source(source, json=self.json, progress=progress)
        show_diagnosis(found, self.source)
        return 1 if found.worst == "error" else 0


@dataclass(frozen=True, kw_only=True)
class Validate:
    """Compare the size of a model with a target of known size in its images.

    TARGET is checkerboard:COLSxROWS:SQUARE_M (inner corners), charuco:COLSxROWS:SQUARE_M:MARKER_M:DICT (squares),
    aprilgrid:COLSxROWS:TAG_M:GAP (GAP = gap / tag), or aruco:DICT:SIDE_M. Exit code 0 within the tolerance, 1 outside
    it, 5 when the target is not found.

    Example: colmap-inertial validate out/sparse_metric/0 --images out/images --target checkerboard:8x6:0.03
    """

    model: Positional[Path]
    """COLMAP model folder."""
    images: Path
    """Folder with the model's images (the rectified ones where the rolling shutter was undone)."""
    target: str
    """What to look for, as above."""
    json: Path | None = None
    """Where to write the result."""
    pictures: Path | None = None
    """Folder for frames with the corners drawn in and a plot of the distances."""
    tolerance: float = 2.0
    """Largest scale error that passes, in per cent."""
    unscaled: bool = False
    """The model claims no unit: report the factor that makes it metric; always passes."""
    apply: Path | None = None
    """With --unscaled: a new folder for the model in metres, scaled by the control distances alone."""

    def __post_init__(self) -> None:
        if not 0 < self.tolerance < 100:
            raise ValueError(f"tolerance must be from 0 to 100 per cent, not {self.tolerance:g}")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.pipeline.sources import validate_source
        from colmap_inertial.pipeline.terminal import show_validation

        result = validate_source(
            self.model,
            self.images,
            self.target,
            ValidateOptions(tolerance_pct=self.tolerance, unscaled=self.unscaled),
            json=self.json,
            pictures=self.pictures,
            apply=self.apply,
        )
        show_validation(result)
        return 0 if result.within_tolerance else 1


@dataclass(frozen=True, kw_only=True)
class Deblur:
    """Undo the motion blur of images by the gyroscope, without reconstructing anything.

    Writes OUT/images with the frames' names, sizes, formats and metadata, and OUT/result.json with what happened to
    each of them and why. Frames that are sharp, or in which the gyroscope's blur does not show, are copied as they
    are. Exit code 3 where the gyroscope does not belong to the pixels, as in stabilised video.

    Example: colmap-inertial deblur my_capture/capture.toml out --sheet before_after.png
    """

    capture: Positional[Path]
    """A capture.toml, a folder that holds one, or an EuRoC/ASL dataset; it must know the exposure times."""
    out: Positional[Path]
    """A new folder for everything that is made."""
    calibration: Path | None = None
    """A calibration file of this device (from `colmap-inertial align --out`), used as a prior."""
    rectify: bool = False
    """Also write OUT/images_rectified, without the rolling shutter (needs its readout time)."""
    sheet: Path | None = None
    """Write a PNG with parts of the most blurred frames before and after."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.pipeline.deblur import deblur_capture
        from colmap_inertial.pipeline.terminal import live_progress, show_deblurred

        with live_progress() as progress:
            result = deblur_capture(
                self.capture,
                self.out,
                calibration=self.calibration,
                rectify=self.rectify,
                sheet=self.sheet,
                progress=progress,
            )
        show_deblurred(result)
        return 0


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Reconstruct many captures, each in a process of its own; one that fails does not stop the rest.

    MANIFEST is a TOML file with a [[capture]] table for each: path (from the manifest's folder), and optionally name,
    config (a TOML file with options) and options; or a folder in which every folder is a capture. Writes OUT/NAME for
    each capture as reconstruct does, OUT/status/NAME.json with how far it is, OUT/summary.csv and OUT/summary.json.
    Started again, it takes up what has no result yet. Exit code 0 when every capture is done, 1 when one is not.

    Example: colmap-inertial batch captures.toml out
    """

    manifest: Positional[Path]
    """A TOML file that lists captures, or a folder of captures."""
    out: Positional[Path]
    """A new folder, or that of an earlier run."""
    workers: int | None = None
    """Captures in work at once on this machine. Default: what processors and free memory allow."""
    scheduler: str | None = None
    """Address of a Dask scheduler (tcp://host:8786), whose workers do the work instead (needs the extra `cluster`)."""
    attempts: int = 3
    """How often a capture is started in all, where its process or its worker is killed."""
    options: Annotated[ReconstructOptions, arg(name="")] = dataclasses.field(default_factory=ReconstructOptions)
    config: Path | None = None
    """TOML file with options for all; flags given here go before it, and what the manifest says before both."""

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"workers must be at least 1, not {self.workers}")
        if self.workers is not None and self.scheduler is not None:
            raise ValueError("--workers are those of this machine; with --scheduler, the cluster has its own")
        if not 1 <= self.attempts <= 100:
            raise ValueError(f"attempts must be from 1 to 100, not {self.attempts}")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.batch import run_batch
        from colmap_inertial.batch.terminal import live_batch, show_batch

        with live_batch() as watch:
            result = run_batch(
                self.manifest,
                self.out,
                self.options,
                workers=self.workers,
                scheduler=self.scheduler,
                attempts=self.attempts,
                watch=watch,
            )
        show_batch(result)
        return result.exit_code()


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Make a simulated capture with known truth: a desk or room, filmed by a hand, with the IMU that ran along.

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
        from colmap_inertial.pipeline.terminal import live_progress
        from colmap_inertial.simulate.capture import write_capture
        from colmap_inertial.simulate.recipe import load_recipe

        recipe = load_recipe(self.recipe)
        with live_progress() as progress:
            capture = write_capture(
                recipe, self.out, workers=self.workers, progress=lambda done, total: progress("rendering", done, total)
            )
        print(capture)
        return 0


Command = Reconstruct | Scale | Apply | Align | Diagnose | Validate | Deblur | Batch | Simulate
_COMMANDS: dict[str, type[Command]] = {
    "reconstruct": Reconstruct,
    "scale": Scale,
    "apply": Apply,
    "align": Align,
    "diagnose": Diagnose,
    "validate": Validate,
    "deblur": Deblur,
    "batch": Batch,
    "simulate": Simulate,
}


def parse(args: Sequence[str]) -> Command:
    """The command that the arguments describe; exits with code 2 and a message when they describe none.

    Raises
    ------
    FormatError
        For a ``--config`` file that cannot be read.
    """
    choices: list[Any] = []
    for name, cls in _COMMANDS.items():
        default = _default_from_config(cls, args) if list(args[:1]) == [name] else None
        settings = subcommand(name) if default is None else subcommand(name, default=default)
        choices.append(Annotated[cls, settings])
    command: Any = Union[tuple(choices)]  # noqa: UP007 (built at run time)
    config = (tyro.conf.PositionalMetavarFromFieldName,)
    return tyro.cli(command, prog="colmap-inertial", description=DESCRIPTION, args=list(args), config=config)


def _default_from_config(cls: type[Command], args: Sequence[str]) -> Command | None:
    """The command with its options from ``--config``, so that flags go before the file and the file before defaults."""
    from colmap_inertial.pipeline.config import read_config

    path = None
    for i, text in enumerate(args):
        if text == "--config" and i + 1 < len(args):
            path = args[i + 1]
        elif text.startswith("--config="):
            path = text.removeprefix("--config=")
    if path is None or cls not in (Reconstruct, Scale, Batch):
        return None
    fields = {f.name: f for f in dataclasses.fields(cls)}
    options: Any = read_config(Path(path), ReconstructOptions)
    if cls is Scale:
        options = options.scale
    required = {
        name: tyro.MISSING for name, f in fields.items() if f.default is f.default_factory is dataclasses.MISSING
    }
    return cls(options=options, **required)


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of ``colmap-inertial``."""
    args = sys.argv[1:] if args is None else args
    if list(args) == ["--version"]:
        print(__version__)
        return
    try:
        command = parse(args)
    except (InertialError, ValueError) as error:  # options check their own values when they are built
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    try:
        code = command.run()
    except InertialError as error:
        print(f"error: {error}", file=sys.stderr)
        code = error.exit_code
    except KeyboardInterrupt:
        resumes = isinstance(command, Reconstruct | Deblur | Batch)
        again = "; started again with the same arguments, it continues" if resumes else ""
        print(f"interrupted{again}", file=sys.stderr)
        code = 130
    sys.exit(code)
