"""Options of the command line, ``config.toml`` and Python. Plain values: loading them costs nothing."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from colmap_inertial.core.choices import CheckedOptions

#: How blur is undone.
BlurRemover = Literal["wiener", "path", "deepgyro"]
#: Who the deblurred images are for: people, or feature extraction, for which they are smoothed.
DeblurPurpose = Literal["viewing", "matching"]
DeblurMethod = Literal["off", "wiener", "path", "deepgyro"]
RollingShutterMethod = Literal["off", "rectify"]
RefineMethod = Literal["off", "auto", "inertial"]
JoinMethod = Literal["off", "inertial"]
WorldAxes = Literal["z-up", "y-down"]
#: What knows of metres: sensors, and known lengths.
ScaleFrom = Literal["imu", "depth", "device", "positions", "target", "distance"]
#: What an export is for: a program, or a format.
ExportProgram = Literal[
    "3dgs",
    "gsplat",
    "nerfstudio",
    "brush",
    "opensplat",
    "instant-ngp",
    "3dgs-deblur",
    "metashape",
    "bundler",
    "ply",
    "las",
    "tum",
    "csv",
    "gltf",
]
ExportImages = Literal["rectified", "original"]


def _check(
    name: str, value: float | None, low: float | None = None, high: float | None = None, *, hint: str = ""
) -> None:
    """Raise ``ValueError`` where a number is not within limits, or not positive where none are given."""
    if value is None:
        return
    if low is None and not value > 0:
        raise ValueError(f"{name} must be positive, not {value:g}")
    if low is not None and high is None and not value >= low:
        raise ValueError(f"{name} must be at least {low}, not {value:g}")
    if low is not None and high is not None and not low <= value <= high:
        raise ValueError(f"{name} must be from {low} to {high}{hint}, not {value:g}")


@dataclass(frozen=True, kw_only=True)
class ReadLimits(CheckedOptions):
    """Limits on the size of files: above those of any camera or recorder, below what exhausts the memory."""

    megapixels: float = 250
    """Images with more pixels (millions) are not decoded."""
    table_columns: int = 10_000
    """Tables with more columns are not read."""
    file_gib: float = 4
    """Larger text, table and image files (GiB) are not read."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for f in fields(self):
            _check(f"limits.{f.name}", getattr(self, f.name))
        if self.megapixels > 1073:
            raise ValueError(f"limits.megapixels: OpenCV decodes no more than 1073, not {self.megapixels:g}")


@dataclass(frozen=True, kw_only=True)
class MappingOptions(CheckedOptions):
    """Options of COLMAP's mapping."""

    pairing: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which images are matched: every pair, neighbours in time and returns, or `auto`: every pair up to 150 images, or
    60 of a video."""
    overlap: int = 4
    """Sequential pairing: match each frame with this many next ones, and with the 1, 2, 4, 8, ... th after it."""
    max_image_size: int | None = None
    """Longer side in pixels above which images are shrunk for feature extraction (COLMAP's default: 3200)."""
    max_num_features: int = 8192
    """SIFT features per image."""
    first_octave: int = -1
    """SIFT: -1 starts at twice the image size (COLMAP's default), 0 at the image size (three times faster)."""
    features: Literal["sift", "aliked"] = "sift"
    """Features to find and match. aliked (experimental): learned features with LightGlue, where pycolmap is built with
    ONNX; other features come by --database."""
    mapper: Literal["incremental", "global"] = "incremental"
    """COLMAP's mapper."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where features are extracted and matched; auto: CUDA where pycolmap has it, except in deterministic runs."""
    gravity_priors: bool = False
    """Global mapper only: start it from each frame's gravity direction, by the IMU (needs a calibration)."""
    refine_intrinsics: bool | None = None
    """Let bundle adjustment change the camera. Not given: only where the capture declares none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check("mapping.overlap", self.overlap, 1)
        _check("mapping.max_image_size", self.max_image_size, 64)
        _check("mapping.max_num_features", self.max_num_features, 50)
        _check("mapping.first_octave", self.first_octave, -1, 2)


@dataclass(frozen=True, kw_only=True)
class GravityOptions(CheckedOptions):
    """Strength of gravity where the recording was made: a number, or the place; else an interval that spans the
    Earth.
    """

    gravity_m_s2: float | None = None
    """Strength of gravity at the place, known to four digits or better; 9.80665 and 9.81 are nominal, not local."""
    latitude_deg: float | None = None
    """Latitude of the place, from which the strength of gravity follows to 0.005 %."""
    height_m: float | None = None
    """Height above sea level, with --latitude-deg; 1000 m change gravity by 0.03 %."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check("gravity_m_s2", self.gravity_m_s2, 9.7, 9.9, hint=" (it is 9.76 to 9.84 on Earth)")
        if self.gravity_m_s2 is not None and self.latitude_deg is not None:
            raise ValueError("--gravity-m-s2 and --latitude-deg both set the strength of gravity; give one of them")
        _check("latitude_deg", self.latitude_deg, -90, 90)
        if self.height_m is not None and self.latitude_deg is None:
            raise ValueError("--height-m goes with --latitude-deg")
        _check("height_m", self.height_m, -1000, 10000)


@dataclass(frozen=True, kw_only=True)
class ScaleOptions(GravityOptions):
    """Options of the scale estimate."""

    method: Literal["joint", "spectral"] = "joint"
    """joint fits all measurements at once, video or keyframes; spectral compares spectra of accelerations, for
    video."""

    max_offset_s: float | None = None
    """Largest offset between the clocks of camera and IMU; 1 for a shared clock. Without it, all are searched."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check("max_offset_s", self.max_offset_s)


@dataclass(frozen=True, kw_only=True)
class JoinOptions(CheckedOptions):
    """Up to where separate models are joined by the IMU: standard deviations, along the worst direction."""

    sigma_m: float = 0.1
    """Largest standard deviation of the position after a gap, as seen from before it (m)."""
    sigma_deg: float = 1.0
    """Largest standard deviation of the orientation after a gap (degrees)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for f in fields(self):
            _check(f"join_options.{f.name}", getattr(self, f.name))


@dataclass(frozen=True, kw_only=True)
class ValidateOptions(CheckedOptions):
    """Options of the validation of a model."""

    unscaled: bool = False
    """The model claims no unit: report the factor that makes it metric instead of a scale error."""
    tolerance_pct: float = 2.0
    """Largest scale error that passes, in per cent."""
    max_views: int = 100
    """Stop searching when the target was found in this many images; they are taken evenly over the names."""
    max_residual_px: float = 4.0
    """A view belongs to the result when at least half of its corners agree with the other views to this many pixels
    (the limit that COLMAP sets to its own points)."""
    seed: int = 0
    """Seed of the search for views that agree."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check("tolerance_pct", self.tolerance_pct)
        _check("max_views", self.max_views, 2)
        _check("max_residual_px", self.max_residual_px)


@dataclass(frozen=True, kw_only=True)
class DenseOptions(CheckedOptions):
    """Options of the dense reconstruction."""

    max_image_size: int | None = None
    """Longer side in pixels of the undistorted images and their depth maps (default: as the images are with CUDA, at
    most 1200 without)."""
    mesh: Literal["poisson", "tsdf", "none"] = "poisson"
    """poisson: surface of the fused points, by COLMAP. tsdf: of the depth maps, by Open3D (the extra "mesh"); finer and
    five times as fast, open where little was seen."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check("dense_options.max_image_size", self.max_image_size, 64)


@dataclass(frozen=True, kw_only=True)
class FrameOptions(CheckedOptions):
    """Options of the choice of frames."""

    use: Literal["auto", "all"] | None = None
    """auto: as many frames as the motion needs, each the sharpest of its neighbours. Not given: auto for a video, all
    images of a folder."""
    min_fps: float = 4.0
    """Lowest number of frames per second, while the image moves. The scale's error does not grow down to 4; at 2 it
    doubles, at 1 it is three times as large."""
    max_fps: float = 10.0
    """Highest number of frames per second."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.min_fps <= self.max_fps:
            raise ValueError(
                f"frames.min_fps must be above 0 and not above frames.max_fps, not {self.min_fps:g} and "
                f"{self.max_fps:g}"
            )


@dataclass(frozen=True, kw_only=True)
class ProjectOptions(CheckedOptions):
    """An existing COLMAP project in place of a capture: the IMU recording, and when images were taken."""

    imu: Path | None = None
    """IMU recording: a file or folder of a known format, or a capture.toml."""
    frame_times: Path | None = None
    """When the images were taken: a CSV with columns name,t_s, or a capture.toml; with --video, the time of each of its
    frames."""
    name_times: str | None = None
    """Times are in the file names: the unit (s, ms, us, ns) of the longest number, its place as in
    cam0_{ns}_*, or a date as in PXL_%Y%m%d_%H%M%S%f."""
    exif_times: bool = False
    """Times are in the images' EXIF, with fractions of a second."""
    video: Path | None = None
    """The images are frames of this video, and are found in it by their content."""
    images: Path | None = None
    """Folder of the project's images (default: images in the project)."""
    keep: tuple[str, ...] = ()
    """Patterns of paths in the project that are copied as they are, such as "old/*"."""
    link: bool = False
    """Hard links for files that do not change; an edit of one then changes the original, too."""
    follow_links: bool = False
    """Copy the targets of symbolic links that lead out of the project into OUT; without, such links are refused."""

    def __post_init__(self) -> None:
        super().__post_init__()
        ways = (self.frame_times is not None and self.video is None, self.name_times is not None, self.exif_times)
        if sum((*ways, self.video is not None)) > 1:
            raise ValueError(
                "give one of --frame-times, --name-times, --exif-times and --video (--frame-times may go with --video)"
            )


@dataclass(frozen=True, kw_only=True)
class ReferenceOptions(CheckedOptions):
    """Known lengths, which give metres without an IMU, or together with it."""

    target: str | None = None
    """A target of known size in the images, as of `validate --target`; of a distance between markers, what they are.
    Beside an IMU, it checks the metres unless --scale-from names it."""
    between: tuple[str, str] | None = None
    """With --distance: the numbers of two markers, or of a project also two points as x,y,z in the units of its
    model."""
    distance: str | None = None
    """Metres between them and how well they are known (standard deviation), as in 4.20+-0.01. Beside an IMU, with
    --scale-from imu --scale-from distance."""

    @property
    def has_points(self) -> bool:
        """Whether an end of the distance is a point."""
        return any("," in end for end in self.between or ())

    @property
    def has_markers(self) -> bool:
        """Whether an end of the distance is a marker."""
        return any("," not in end for end in self.between or ())


@dataclass(frozen=True, kw_only=True)
class ApertureOptions(CheckedOptions):
    """Options of the fusion of a multi-aperture camera's images."""

    cost: Literal["census", "mutual-information"] = "census"
    """How pixels of different colour are compared: by the order of brightness around them, or by the joint
    statistics of brightness over the whole image."""
    disparity_px: tuple[float, float] | None = None
    """Least and largest shift between the reference and its partner to search, in pixels, below zero for what lies
    behind infinity (default: found for each exposure in a smaller image)."""
    step_px: float = 0.5
    """Spacing of the shifts that are tried; between them a parabola is fitted."""
    luminance_cost: bool = True
    """Also compare the luminance aperture with the sum of the colours, where all four are there."""
    use_luminance: bool = True
    """Reduce the noise of the colours by an aperture without colour filter."""
    depth: bool = False
    """Also keep disparities (pixels) and depths (metres) as NumPy files; nan where they were not measured."""
    threads: int | None = None
    """Threads for one exposure; as many as the process may use where absent."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.disparity_px is not None and not self.disparity_px[0] < self.disparity_px[1]:
            raise ValueError(f"disparity_px: must be a lower and a higher limit, not {self.disparity_px}")
        _check("step_px", self.step_px, 0.1, 2)
        _check("threads", self.threads, 1)


@dataclass(frozen=True, kw_only=True)
class ExposureOptions(CheckedOptions):
    """Options of the fusion of a short and a long exposure."""

    fuse: bool = True
    """Fuse them; otherwise the short ones are used as they were filmed."""
    fusion: Literal["none", "mertens"] = "none"
    """Blend the fused image with the short exposure, which shows what clips in the long one."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """What the network runs on; auto: CUDA where onnxruntime has it."""


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions(CheckedOptions):
    """Everything that decides the result of a reconstruction, beside the capture itself.

    Each field is the option of ``colmap-inertial reconstruct`` of the same name; ``reconstruct --help-all`` explains
    them with their defaults.

    Attributes
    ----------
    frames, deblur, rolling_shutter
        Which frames are used, and how blur and rolling shutter are removed.
    apertures, exposures
        Of special cameras.
    mapping, colmap, colmap_project, colmap_executable, database, database_images
        How COLMAP builds the model.
    scale_from, scale, world, georeference
        Where metres come from, the scale by the IMU, the axes of the metric model, and its position on Earth.
    join, join_options, refine, fragments
        Which models are joined, refined and scaled.
    dense, dense_options
        The dense reconstruction.
    calibration
        Calibration files of the device.
    deterministic, seed
        For runs that can be repeated bit by bit.
    force, limits
        What stops a run.
    """

    frames: FrameOptions = field(default_factory=FrameOptions)
    """Which frames are used."""
    apertures: ApertureOptions = field(default_factory=ApertureOptions)
    """How the sub-images of a multi-aperture camera become frames."""
    exposures: ExposureOptions = field(default_factory=ExposureOptions)
    """How pairs of a short and a long exposure become frames."""
    deblur: DeblurMethod | None = None
    """Undo motion blur by the gyroscope before COLMAP sees a frame. Not given: wiener, where exposure times are known
    and the images confirm the blur that the gyroscope predicts. path: along the same path by a filter that expects few
    and strong edges (slower). deepgyro: by a network (slower; needs the extra `restore`)."""
    rolling_shutter: RollingShutterMethod | None = None
    """Undo the rolling shutter by the gyroscope. Not given: rectify, where the readout time is known."""
    mapping: MappingOptions = field(default_factory=MappingOptions)
    """How COLMAP builds the model."""
    colmap: tuple[str, ...] = ()
    """Options of COLMAP's own, each as SECTION.option=value, such as Mapper.init_num_trials=100."""
    colmap_project: Path | None = None
    """A project.ini of COLMAP: its values that differ from COLMAP's defaults are used; --colmap overrides it."""
    colmap_executable: Path | None = None
    """An installed COLMAP (3.8 or newer), such as one with CUDA, which finds and matches features and maps. pycolmap
    verifies matches, and maps long captures (in parts) and with --mapping.mapper global."""
    database: Path | None = None
    """A COLMAP database of the capture's images, which is used as far as it goes: keypoints of any kind, matches,
    verified pairs. It is only read."""
    database_images: Literal["filmed", "rectified"] | None = None
    """With --database, where the rolling shutter is corrected: whether its keypoints are those of images as filmed
    (deblurred or not), or of images that `deblur --rectify` wrote."""
    scale_from: tuple[ScaleFrom, ...] = ()
    """Where metres come from, each by its name. Not given: from all that the capture has of IMU, depth maps, the
    device's own path (ARKit, ARCore) and positions (GPS); without an IMU, also from a target and a known distance. With
    an IMU, these must be named; a target that is not checks the metres. All are taken together by how sure they are;
    those that contradict each other are named."""
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    """How metres come from the IMU."""
    join: JoinMethod = "inertial"
    """inertial: where COLMAP made several models of one recording, join those whose relative pose the IMU determines
    well enough (see --join-options); off: keep them apart."""
    join_options: JoinOptions = field(default_factory=JoinOptions)
    """Limits up to which they are joined."""
    refine: RefineMethod = "auto"
    """inertial: fit image observations, rolling shutter and IMU together, which reduces bending and drift of the metric
    model; kept only where it predicts observations better. auto: where that is expected to bring the path closer with
    95 % probability, and takes at most a quarter of the time of features, matching and mapping; off: never."""
    world: WorldAxes = "z-up"
    """Axes of the metric model: z away from the ground, or y towards it, as COLMAP's own cameras have it."""
    georeference: bool = False
    """Find the model's position on Earth by the positions (GPS) in the video's telemetry or the images'
    EXIF: heading and place, never the scale."""
    dense: bool = False
    """Also compute depth maps (faster with CUDA), a fused point cloud and a mesh, in metres."""
    dense_options: DenseOptions = field(default_factory=DenseOptions)
    """How the dense reconstruction is made."""
    deterministic: bool = False
    """Fixed seed and one thread in each process: the same input gives the same model, bit for bit. Slower."""
    seed: int = 0
    """Seed of COLMAP's random sampling."""
    calibration: tuple[Path, ...] = ()
    """Calibration files of this device: how camera and IMU relate (from `align --out`, used as a prior), the IMU's own
    gains (from `calibrate-imu --out`), or both; each says what it holds."""
    fragments: bool = False
    """Also scale fragments: models of fewer than 5 images, or of less than 1 % of the images of the largest one."""
    force: bool = False
    """Continue where the check of the recording finds an error that makes metres meaningless; the verdict is then at
    most weak."""
    limits: ReadLimits = field(default_factory=ReadLimits)
    """Limits on files that are read."""

    def __post_init__(self) -> None:
        given: Any = self.calibration
        if given is None:
            object.__setattr__(self, "calibration", ())
        super().__post_init__()
        _check("seed", self.seed, 0, 2**31 - 1)


#: How a list of stage names spells ``...``, the default stages.
DEFAULT_STAGES = "..."


@dataclass(frozen=True, kw_only=True)
class StageNames(CheckedOptions):
    """The hooks of a reconstruction by name, for processes that import them themselves.

    A name ``package.module:name`` (the second part may be dotted) is that of a stage itself: a function, or an
    instance that can be called, no class. ``"..."`` stands for the default stages.
    """

    frame: tuple[str, ...] = (DEFAULT_STAGES,)
    """Frame stages."""
    keypoint: tuple[str, ...] = (DEFAULT_STAGES,)
    """Keypoint stages."""
    model: tuple[str, ...] = (DEFAULT_STAGES,)
    """Model stages."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for f in fields(self):
            names: tuple[str, ...] = getattr(self, f.name)
            for name in names:
                _check_stage_name(f.name, name)
            if names.count(DEFAULT_STAGES) > 1:
                raise ValueError(f'{f.name}: the default stages ("...") can stand in a list of stages once')

    @property
    def code(self) -> tuple[str, ...]:
        """The names of code that is imported and run; empty where there are default stages alone."""
        return tuple(n for n in (*self.frame, *self.keypoint, *self.model) if n != DEFAULT_STAGES)


def _check_stage_name(kind: str, name: str) -> None:
    module, _, path = name.partition(":")
    if name != DEFAULT_STAGES and not all(part.isidentifier() for part in (*module.split("."), *path.split("."))):
        raise ValueError(f'{kind}: {name!r} names no stage: write "module:name", or "..." for the default stages')
    if module == "__main__":
        raise ValueError(f"{kind}: {name!r} is found in this process only; put the stage into a module of its own")


@dataclass(frozen=True, kw_only=True)
class BatchOptions(CheckedOptions):
    """Workers of a batch."""

    workers: int | None = None
    """Captures processed at once on this machine (default: as many as processors and free memory allow)."""
    scheduler: str | None = None
    """Address of a Dask scheduler (tcp://host:8786), whose workers do the work instead (needs the extra `cluster`)."""
    attempts: int = 3
    """How many times a capture is started in all, if its process or its worker is killed."""
    overwrite: bool = False
    """If a finished capture is given other options, or was changed, make again what depends on that."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check("workers", self.workers, 1)
        if self.workers is not None and self.scheduler is not None:
            raise ValueError("--workers are those of this machine; with --scheduler, the cluster has its own")
        _check("attempts", self.attempts, 1, 100)


@dataclass(frozen=True, kw_only=True)
class FuseAperturesOptions(CheckedOptions):
    """Outputs of the fusion of a multi-aperture camera's images."""

    fusion: ApertureOptions = field(default_factory=ApertureOptions)
    """How they are fused."""
    refocus: float | None = None
    """Also write images that are sharp at this depth only, in metres (or in the calibration's own unit)."""
    lens_width: float = 1.0
    """Width of the lens that refocused images show, in distances between the reference and its partner."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check("refocus", self.refocus)
        _check("lens_width", self.lens_width)
