"""Commands that begin with what exists: a model, a trajectory, a recording."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from colmap_inertial.cli.speech import DeviceCommand, Reader
from colmap_inertial.cli.terminal import (
    show_applied,
    show_calibration,
    show_compared,
    show_diagnosis,
    show_exported,
    show_imu_calibration,
    show_scale,
    show_table,
    show_validation,
    show_view,
)
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.facts import Fact, with_sentences
from colmap_inertial.core.options import (
    ExportImages,
    ExportProgram,
    GravityOptions,
    ScaleOptions,
    ValidateOptions,
    WorldAxes,
)

if TYPE_CHECKING:
    from colmap_inertial.model.project import Applied
    from colmap_inertial.run.commands.scale import ScaleSource


@dataclass(frozen=True, kw_only=True)
class SourceReader(Reader):
    """Options shared by the commands that read camera poses and the IMU recorded with them."""

    source: Positional[Path]
    """COLMAP model folder, trajectory in TUM format (a text file of t x y z qx qy qz qw), or InertialScale folder (text
    files of camera and IMU)."""
    imu: Path | None = None
    """IMU recording: a file or folder of a known format, or a capture.toml."""
    frame_times: Path | None = None
    """When the images were taken: a CSV with columns name,t_s, or a capture.toml."""
    calibration: tuple[Path, ...] = ()
    """Calibration files of this device: from `align --out`, from `calibrate-imu --out`, or both."""

    def read_from(self, calibration: tuple[Path, ...] | None = None) -> ScaleSource:
        """Source of poses and IMU, with these calibrations or the given ones."""
        from colmap_inertial.run.commands.scale import ScaleSource

        files = self.calibration if calibration is None else calibration
        return ScaleSource(source=self.source, imu=self.imu, frame_times=self.frame_times, calibration=files)


@dataclass(frozen=True, kw_only=True)
class Scale(DeviceCommand, SourceReader):
    """Metres per unit of an existing model or trajectory.

    SOURCE is a COLMAP model folder (needs --imu and --frame-times), a trajectory in TUM format (needs --imu), or an
    InertialScale folder. Exit code 3 when the recording does not determine the scale; the reasons say why.

    Example: colmap-inertial scale project/sparse/0 --imu imu.csv --frame-times frames.csv --json scale.json
    """

    first_s: float | None = None
    """Use only this many seconds from the start of the camera's recording, and the IMU's samples around them."""
    force: bool = False
    """Go on where `diagnose` finds an error; the scale is weak at most."""
    options: Annotated[ScaleOptions, arg(name="")] = dataclasses.field(default_factory=ScaleOptions)
    config: Path | None = None
    """TOML file as OUT/config.toml of a reconstruction: its [scale] table counts; options given here override it."""

    def __post_init__(self) -> None:
        if self.first_s is not None and not self.first_s > 0:
            raise ValueError(f"first_s must be positive, not {self.first_s:g}")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.scale import scale_as_json, scale_source

        calibration = self.add_remembered(self.calibration, self.imu or self.source)
        source = self.read_from(calibration)
        estimate = scale_source(source, self.options, json=self.json_file, first_s=self.first_s, force=self.force)
        self.tell(
            lambda: show_scale(estimate, self.source), scale_as_json(estimate, calibration, self.source), written=True
        )
        return 3 if estimate.verdict == "refused" else 0


@dataclass(frozen=True, kw_only=True)
class Apply(Reader):
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
    """Patterns of names or paths in PROJECT that are copied as they are, such as "old/*" or "*.bak"."""
    follow_links: bool = False
    """Take what symbolic links out of PROJECT lead to into the copy; without, they are refused."""
    any_model: bool = False
    """Take a scale that was measured on another model; without, it is refused."""

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

        scales: Any
        self.check_json(self.sim3)
        with self.progress() as progress:

            def files(done: int, total: int) -> None:
                progress("apply", done, total)

            if self.undo:
                applied = undo_project(
                    self.project, self.out, link=self.link, follow_links=self.follow_links, progress=files
                )
            else:
                if self.sim3 is not None:
                    scales = read_similarity(self.sim3)
                elif self.factor is not None:
                    scales = plain_factor(self.factor)
                else:
                    scales = read_scales(self.scale, world=self.world)
                applied = apply_to_project(
                    self.project,
                    self.out,
                    scales,
                    link=self.link,
                    keep=self.keep,
                    follow_links=self.follow_links,
                    about_origin=self.sim3 is not None,
                    any_model=self.any_model,
                    progress=files,
                )
        self.tell(lambda: show_applied(applied), _describe_applied(applied))
        return 0


def _describe_applied(applied: Applied) -> dict[str, Any]:
    models = [
        {
            "index": index,
            "folder": folder,
            "scale": None if scale.similarity is None else scale.similarity.scale,
            "verdict": scale.verdict,
            **with_sentences({"reasons": list(scale.reasons)}),
        }
        for index, (folder, scale) in applied.models.items()
    ]
    return {
        "out": applied.out,
        "models": models,
        "changes": applied.changes,
        "files_kept": applied.unchanged,
        "unmoved": applied.unmoved,
        **with_sentences({"notes": list(applied.notes)}),
    }


@dataclass(frozen=True, kw_only=True)
class Align(SourceReader):
    """Rotation, time offset and gyro bias between the camera and the IMU of one device, from one recording.

    Needs no scale, only a camera that turned. The calibration file serves --calibration for later recordings of the
    same device. Exit code 3 when no time offset stands out.

    Example: colmap-inertial align project/sparse/0 --imu imu.csv --frame-times frames.csv --out phone.json
    """

    out: Path
    """Where to write the calibration (JSON)."""
    remember: str | None = None
    """Keep the calibration under this name of the device: `reconstruct` and `scale` then use it by themselves."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.calibrate_imu import remember
        from colmap_inertial.run.commands.scale import align_source

        self.check_json(self.source, self.imu, self.frame_times, self.out)
        calibration = align_source(self.read_from(), self.out)
        kept = None if self.remember is None else remember(self.remember, self.out)
        self.tell(lambda: show_calibration(calibration, self.source, kept), self.out, {"out": self.out, "kept": kept})
        return 0


@dataclass(frozen=True, kw_only=True)
class CalibrateImu(Reader):
    """Gains, misalignments and biases of an IMU, from a recording in which it lay still in twelve attitudes or more.

    Start the recording, lay the device still on its six sides, then leaning on six of its edges (a box or a book
    helps), five seconds each, and turn it over in between; no tools, no right angles. The rests are found by
    themselves. From nine attitudes on everything is determined; with six to eight, the misalignments are not; with
    fewer, exit code 3. Give the latitude: the gains are no better than the strength of gravity is known.

    The calibration file serves --calibration for recordings of the same device, beside that of align; a scale's
    interval then no longer has to allow for an unknown gain of the accelerometer. A page with the residuals of each
    rest is written beside it. Calibrate again after a year, or where the device is much warmer or colder.

    Without such a recording, results that contain a target do as well: give their output folders, each of another
    recording of the device. The less their scales and the target differ, the narrower are later intervals.

    Example: colmap-inertial calibrate-imu rests.csv --latitude-deg 47.4 --height-m 400 --out phone_imu.json
    """

    recording: Positional[tuple[Path, ...]]
    """IMU recording (a file or folder of a known format, or a capture.toml), or output folders of `reconstruct`. These
    must be of captures with a [target] whose size is stated with its standard deviation (+-)."""
    out: Path
    """Where to write the calibration (JSON); of a recording, a page of the same name, ending in .html, is put beside
    it."""
    gravity: Annotated[GravityOptions, arg(name="")] = dataclasses.field(default_factory=GravityOptions)
    remember: str | None = None
    """Keep the calibration under this name of the device: `reconstruct` and `scale` then use it by themselves."""

    def __post_init__(self) -> None:
        if not self.recording:
            raise ValueError("name the recording, or results that have a target")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.calibrate_imu import (
            calibrate_from_results,
            calibrate_source,
            remember,
        )

        self.check_json(*self.recording, self.out)
        first, *others = self.recording
        compared = bool(others) or (first / "result.json").is_file()
        if compared and self.gravity != GravityOptions():
            raise InertialError(Fact("gravity-is-of-rests"))
        if compared:
            by_targets = calibrate_from_results(self.recording, self.out, device=self.remember or "")
        else:
            by_rests = calibrate_source(first, self.out, self.gravity, device=self.remember)
        kept = None if self.remember is None else remember(self.remember, self.out)
        more: dict[str, Any] = {"out": self.out, "kept": kept}
        if compared:
            self.tell(lambda: show_compared(by_targets, self.out, kept), self.out, more)
        else:
            more |= {"verdict": by_rests.verdict}
            self.tell(lambda: show_imu_calibration(by_rests, first, self.out, kept), self.out, more)
        return 0


#: Errors that a description of the table answers.
_TABLE_CODES = ("table-unclear", "table-open")


@dataclass(frozen=True, kw_only=True)
class Diagnose(SourceReader):
    """Find problems of a recording, before any reconstruction.

    Each finding says what to do. Exit code 1 when something makes a scale wrong or impossible, 0 when nothing is worse
    than a warning.

    Example: colmap-inertial diagnose my_capture/capture.toml --json findings.json
    """

    source: Positional[Path]
    """What would be reconstructed: a capture.toml, a video or a recorder's folder. Or an IMU recording alone; or a
    COLMAP model folder, TUM trajectory or InertialScale folder."""
    capture: Path | None = None
    """Of a table of samples: write the capture.toml that describes it; what it does not say stays "?"."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.diagnose import describe_table, diagnose_source

        report = describe_table(self.read_from(), self.capture) if self.imu is None else None
        if report is not None and self.talks:
            show_table(report, self.capture)
        try:
            with self.progress() as progress:
                diagnosis = diagnose_source(self.read_from(), json=self.json_file, progress=progress)
        except InertialError as error:
            if report is None or not self.talks or error.code not in _TABLE_CODES:
                raise
            raise InertialError(Fact("table-described-above", source=self.source, found=error.fact)) from None
        self.tell(lambda: show_diagnosis(diagnosis, self.source), diagnosis.as_json(), written=True)
        return 1 if diagnosis.worst == "error" else 0


@dataclass(frozen=True, kw_only=True)
class Validate(Reader):
    """Compare the size of a model with a known target in its images.

    TARGET is checkerboard:COLSxROWS:SQUARE_M (inner corners), charuco:COLSxROWS:SQUARE_M:MARKER_M:DICT (squares),
    aprilgrid:COLSxROWS:TAG_M:GAP (GAP = gap / tag), or aruco:DICT:SIDE_M; +- after the length says how well it is known
    (standard deviation), as in checkerboard:8x6:0.03+-0.0001. Exit code 0 within the tolerance, 1 outside
    it, 5 when the target is not found.

    Example: colmap-inertial validate out/sparse/0 --images out/images --target checkerboard:8x6:0.03
    """

    model: Positional[Path]
    """COLMAP model folder."""
    images: Path
    """Folder with the model's images (OUT/images of a reconstruction)."""
    target: str
    """What to look for, as above."""
    pictures: Path | None = None
    """Folder for frames with the corners drawn in and a plot of the distances."""
    tolerance: float = 2.0
    """Largest scale error that passes, in per cent."""
    unscaled: bool = False
    """The model is not in metres: report the factor that makes it metric. Passes where enough images and all
    lengths agree."""
    apply: Path | None = None
    """With --unscaled: a new folder for the model in metres, scaled by the control distances alone."""
    bars: Path | None = None
    """Scale bars: a CSV with marker_a,marker_b,length_m of single markers and, where known, sigma_m."""
    check_points: Path | None = None
    """Check points: a CSV with marker,x,y,z of single markers in metres and, where known, sigma_m."""
    other_target: tuple[str, str] | None = None
    """A second board in the scene, as of --target, and the metres between the middles of both, as in 4.03+-0.002."""

    def __post_init__(self) -> None:
        if not 0 < self.tolerance < 100:
            raise ValueError(f"tolerance must be from 0 to 100 per cent, not {self.tolerance:g}")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.run.commands.validate import KnownLengths, ValidationOutputs, validate_source

        result = validate_source(
            self.model,
            self.images,
            self.target,
            ValidateOptions(tolerance_pct=self.tolerance, unscaled=self.unscaled),
            ValidationOutputs(json=self.json_file, pictures=self.pictures, apply=self.apply),
            KnownLengths(bars=self.bars, check_points=self.check_points, other=self.other_target),
        )
        self.tell(lambda: show_validation(result), result.as_json(), written=True)
        return 0 if result.within_tolerance else 1


@dataclass(frozen=True, kw_only=True)
class Export(Reader):
    """Export a finished model to other programs, in metres and with gravity kept.

    Without --for, DIR is one folder for all splatting and NeRF trainers: images/ (undistorted, the principal point in
    the middle), sparse/0 (COLMAP), sparse_pc.ply, transforms.json, export.json. With --for, also the command line with
    which that program keeps metres and up. 3dgs-deblur gets velocities, instant-ngp poses of first and last rows. Other
    formats: metashape and bundler (cameras and undistorted images), ply and las (sparse points), tum, csv and gltf (the
    camera's path). las and gltf need the extra packages [las] and [gltf].

    A refused scale is refused here, too (exit code 3), unless --unscaled is given.

    Example: colmap-inertial export out/hall hall_splat --for gsplat
    """

    out: Positional[Path]
    """What reconstruct or apply wrote, or a COLMAP model folder; it is only read."""
    dir: Positional[Path]
    """A new or empty folder outside of OUT; it appears whole or not at all."""
    program: Annotated[ExportProgram | None, arg(name="for")] = None
    """The program or format; all trainers without it."""
    images: ExportImages = "rectified"
    """rectified: those that agree with the model; original: those with their rolling shutter, as COLMAP saw them."""
    model: int | None = None
    """Number of the model, where there are several; the largest otherwise."""
    image_folder: Path | None = None
    """Folder with the model's images, where they are not beside the model."""
    capture: Path | None = None
    """The capture that the run was made of: with --images original for frames that it deblurred or changed, with
    --georeference for its positions."""
    georeference: bool = False
    """Also say where on Earth everything is (georeference.json, columns of cameras.csv, LAS points in UTM): as the run
    found it, else by the positions (GPS) of the capture or in the pictures' EXIF."""
    unscaled: bool = False
    """Export a model without a scale, too: its units are not metres."""

    def __post_init__(self) -> None:
        if self.capture is not None and self.images != "original" and not self.georeference:
            raise ValueError("--capture goes with --images original or --georeference")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.tools.export.whole import export_model

        self.check_json(self.out, self.dir)
        with self.progress() as progress:
            made = export_model(
                self.out,
                self.dir,
                self.program,
                images=self.images,
                model=self.model,
                image_folder=self.image_folder,
                capture=self.capture,
                georeference=self.georeference,
                unscaled=self.unscaled,
                progress=progress,
            )
        self.tell(lambda: show_exported(made), made.folder / "export.json", {"folder": made.folder})
        return 0


@dataclass(frozen=True, kw_only=True)
class View(Reader):
    """Show a reconstruction in the browser, and measure in it.

    Points, cameras, gravity, a scale bar and the target are shown. OUT is what reconstruct or apply wrote, or a COLMAP
    model folder. A model without a scale is shown in its own units, without a grid in metres. Prints an address to
    open; Ctrl-C ends it. Needs the extra package [view].

    Example: colmap-inertial view out
    """

    out: Positional[Path]
    """What reconstruct or apply wrote, or a COLMAP model folder."""
    model: int | None = None
    """Number of the model, where there are several; the largest otherwise."""
    images: Path | None = None
    """Folder with the model's images, where they are not beside the model."""
    max_points: int = 400_000
    """Show no more points than this, evenly chosen."""
    port: int = 8080
    """Port to listen at; one that is taken makes way for the next free one, 0 takes any."""
    host: str = "127.0.0.1"
    """Address to listen at: this machine alone, or 0.0.0.0 for everybody on the network who knows the address shown."""

    def __post_init__(self) -> None:
        if self.max_points < 1:
            raise ValueError(f"max_points must be positive, not {self.max_points}")
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port must be from 0 to 65535, not {self.port}")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.tools.view.scene import load_scene
        from colmap_inertial.tools.view.server import require_viser, serve

        require_viser()
        scene = load_scene(self.out, model=self.model, images=self.images, max_points=self.max_points)
        serve(
            scene,
            host=self.host,
            port=self.port,
            ready=lambda url: self.tell(lambda: show_view(self.out, url, self.host), {"out": self.out, "url": url}),
        )
        return 0
