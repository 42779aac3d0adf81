from .colmap.features.extraction import KeypointRecord as KeypointRecord
from .colmap.workers import using_workers as using_workers
from .core.errors import (
    AlreadyMetricError as AlreadyMetricError,
    FormatError as FormatError,
    InertialError as InertialError,
    MappingError as MappingError,
    MissingExtraError as MissingExtraError,
    NotObservableError as NotObservableError,
    OutputError as OutputError,
    OutputExistsError as OutputExistsError,
    TargetNotFoundError as TargetNotFoundError,
    TimingError as TimingError,
)
from .core.facts import Fact as Fact
from .core.options import (
    BatchOptions as BatchOptions,
    ExposureOptions as ExposureOptions,
    FuseAperturesOptions as FuseAperturesOptions,
    MappingOptions as MappingOptions,
    ProjectOptions as ProjectOptions,
    ReadLimits as ReadLimits,
    ReconstructOptions as ReconstructOptions,
    ReferenceOptions as ReferenceOptions,
    ScaleOptions as ScaleOptions,
    StageNames as StageNames,
    ValidateOptions as ValidateOptions,
)
from .core.progress import Progress as Progress
from .core.types import (
    AcceptedScale as AcceptedScale,
    Action as Action,
    CameraImuCalibration as CameraImuCalibration,
    CameraModel as CameraModel,
    CameraTrajectory as CameraTrajectory,
    Frame as Frame,
    FrameLog as FrameLog,
    FrameTiming as FrameTiming,
    Gap as Gap,
    ImuCalibration as ImuCalibration,
    ImuNoise as ImuNoise,
    ImuRecording as ImuRecording,
    JoinedPart as JoinedPart,
    Keypoints as Keypoints,
    ScaleEstimate as ScaleEstimate,
    Similarity as Similarity,
    SmoothedTrajectory as SmoothedTrajectory,
    Treatment as Treatment,
)
from .diagnose import Diagnosis as Diagnosis, Finding as Finding
from .hooks import (
    FrameStage as FrameStage,
    KeypointStage as KeypointStage,
    ModelStage as ModelStage,
)
from .imaging.blur_field import BlurField as BlurField
from .imaging.gyro_camera import FrameShutter as FrameShutter, GyroCamera as GyroCamera
from .imaging.path_filters import DeblurOptions as DeblurOptions, deblur as deblur
from .imaging.psf import blur_field as blur_field, frame_blur as frame_blur
from .inertial.scale import estimate_scale as estimate_scale, gravity_at_latitude_m_s2 as gravity_at_latitude_m_s2
from .inertial.static_calibration import RestCalibration as RestCalibration, calibrate_imu as calibrate_imu
from .io.calibration import (
    read_calibration as read_calibration,
    read_imu_calibration as read_imu_calibration,
    write_calibration as write_calibration,
    write_imu_calibration as write_imu_calibration,
)
from .io.capture import Capture as Capture, load_capture as load_capture
from .io.files import reading_within as reading_within
from .io.frames import read_frame_times as read_frame_times, read_frames as read_frames
from .io.imu import read_frame_log as read_frame_log, read_imu as read_imu
from .io.imu_formats import ImuFormat as ImuFormat
from .io.pose_convention import PoseConvention as PoseConvention
from .model import (
    Model as Model,
    apply_similarity as apply_similarity,
    colmap_camera as colmap_camera,
    find_models as find_models,
    read_model as read_model,
    trajectory_from_model as trajectory_from_model,
)
from .model.project import apply_to_project as apply_to_project, undo_project as undo_project
from .model.similarities import ModelScale as ModelScale, read_scales as read_scales, read_similarity as read_similarity
from .motion.align import AlignOptions as AlignOptions, align_camera_imu as align_camera_imu
from .motion.align.conventions import LikelyConvention as LikelyConvention, likely_convention as likely_convention
from .motion.smooth import smooth_trajectory as smooth_trajectory
from .report import write_report as write_report
from .run.commands.diagnose import diagnose_source as diagnose_source
from .run.commands.images_alone import (
    deblur_capture as deblur_capture,
    fuse_aperture_capture as fuse_aperture_capture,
    fuse_exposure_capture as fuse_exposure_capture,
)
from .run.commands.reconstruct import reconstruct as reconstruct
from .run.commands.reconstruct_project import reconstruct_project as reconstruct_project
from .run.commands.result import (
    DeblurResult as DeblurResult,
    Fragment as Fragment,
    ModelResult as ModelResult,
    ReconstructResult as ReconstructResult,
)
from .run.commands.scale import ScaleSource as ScaleSource
from .run.stages.apertures import ApertureStage as ApertureStage
from .run.stages.deblur import DeblurStage as DeblurStage
from .run.stages.exposures import ExposureStage as ExposureStage, FusedPair as FusedPair
from .run.stages.frame_folder import FrameRecord as FrameRecord
from .run.stages.join import JoinStage as JoinStage
from .run.stages.metric import MetricStage as MetricStage
from .run.stages.readout import ReadoutStage as ReadoutStage
from .run.stages.refine import RefineStage as RefineStage
from .run.stages.rolling_shutter import RollingShutterStage as RollingShutterStage
from .run.steps.config import read_config as read_config
from .tools.batch import (
    BatchCapture as BatchCapture,
    BatchResult as BatchResult,
    CaptureStatus as CaptureStatus,
    read_manifest as read_manifest,
    run_batch as run_batch,
)
from .tools.export.whole import Exported as Exported, export_model as export_model
from .tools.simulate.capture import write_capture as write_capture
from .tools.simulate.recipe import SceneRecipe as SceneRecipe, load_recipe as load_recipe
from .validate import (
    Target as Target,
    Validation as Validation,
    parse_target as parse_target,
    validate_model as validate_model,
)

__version__: str
