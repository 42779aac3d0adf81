"""The model stage that finishes what rectified keypoints begin: translation within the readout of a rolling shutter."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass, field

from colmap_inertial.errors import NotObservableError
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.model import Model, read_model, trajectory_from_model
from colmap_inertial.model.readout import Settled, settle_readout
from colmap_inertial.options import ScaleOptions
from colmap_inertial.scale import estimate_scale
from colmap_inertial.stages.metric import smoothed_path
from colmap_inertial.types import CameraImuCalibration, ImuRecording

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ReadoutStage:
    """Moves observations to where they would be without the camera's translation within the readout.

    The gyroscope undoes the camera's turning before mapping. Its translation shows in things that are near, and takes
    a model to tell: depths are the model's, velocities those of the path smoothed with the accelerometer. The model
    is changed only where this brings it closer to its observations, and left alone where the scale is refused.

    Attributes
    ----------
    imu
        The recording that ran along.
    calibration
        What is known of the camera and the IMU beforehand; of rectified keypoints.
    options
        Of the scale estimate.
    refine_intrinsics
        Whether the cameras may change.
    num_threads
        Of bundle adjustment; all where negative.
    """

    imu: ImuRecording
    calibration: CameraImuCalibration | None
    options: ScaleOptions
    refine_intrinsics: bool
    num_threads: int = -1
    _done: dict[int, Settled] = field(default_factory=dict, init=False, compare=False, repr=False)

    def settled(self, index: int, /) -> Settled | None:
        """What became of a model that went through; ``None`` where there was no scale to go by."""
        return self._done.get(index)

    def __call__(self, model: Model, /) -> Model:
        """Adjust the model."""
        reconstruction = read_model(model.folder)
        trajectory, _ = trajectory_from_model(reconstruction, model.timing)
        estimate = estimate_scale(trajectory, self.imu, calibration=self.calibration, options=self.options)
        if estimate.metres_per_unit is None or estimate.gravity_in_world_m_s2 is None:
            return model
        metric = dataclasses.replace(
            trajectory,
            cam_in_world=trajectory.cam_in_world * estimate.metres_per_unit,
            length_unit="m",
            pose_cov=None,
        )
        try:
            path = smoothed_path(metric, self.imu, estimate, estimate.gravity_in_world_m_s2)
        except NotObservableError as error:
            log.info("model %d: readout left as it is: %s", model.index, error)
            return model
        velocity = dict(zip(trajectory.names, path.velocity_in_world / estimate.metres_per_unit, strict=True))
        place = {name: i for i, name in enumerate(model.timing.names)}
        shutters = {}
        for name in velocity:
            image = reconstruction.find_image_with_name(name)
            camera = reconstruction.camera(image.camera_id)
            shutters[name] = FrameShutter.of(model.timing, place[name], width=camera.width, height=camera.height)
        settled, what = settle_readout(
            reconstruction,
            shutters,
            velocity,
            refine_intrinsics=self.refine_intrinsics,
            num_threads=self.num_threads,
        )
        self._done[model.index] = what
        log.info(
            "model %d: translation within the readout moves points by %.2f px; reprojection error %.3f -> %.3f px%s",
            model.index,
            what.shift_px,
            what.before_px,
            what.after_px,
            "" if what.accepted else ": left as it is",
        )
        if not what.accepted:
            return model
        folder = model.folder.with_name(model.folder.name + "_settled")
        folder.mkdir()
        settled.write(str(folder))
        return dataclasses.replace(model, folder=folder)
