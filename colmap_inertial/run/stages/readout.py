"""The model stage that finishes what rectified keypoints begin: translation within the readout of a rolling shutter."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Action, Treatment
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.model import Model
from colmap_inertial.model.readout import settle_readout
from colmap_inertial.run.stages.inputs import StageInputs
from colmap_inertial.run.stages.metric import InertialStage, smooth_path

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ReadoutStage(InertialStage):
    """Moves observations to where they would be without the camera's translation within the readout.

    The gyroscope undoes the camera's turning before mapping. Its translation shows in things that are near, and takes
    a model to tell: depths are the model's, velocities those of the path smoothed with the accelerometer. The model
    is changed only where this brings it closer to its observations, and left alone where the scale is refused or the
    keypoints were not rectified.

    Attributes
    ----------
    refine_intrinsics
        Whether the cameras may change.
    num_threads
        Of bundle adjustment; all where negative.
    """

    refine_intrinsics: bool
    num_threads: int = -1

    @classmethod
    def for_run(cls, inputs: StageInputs) -> ReadoutStage:
        """The stage of a run."""
        return cls(
            **cls.fields_for(inputs),
            refine_intrinsics=cls.refines_intrinsics(inputs),
            num_threads=1 if inputs.options.deterministic else -1,
        )

    def __call__(self, model: Model, /) -> Model:
        """Adjust the model."""
        if not model.rectified:
            return model
        model, estimate, trajectory = self.estimate_scale(model)
        reconstruction = model.reconstruction
        if estimate.metres_per_unit is None or estimate.gravity_in_world_m_s2 is None:
            return model
        metric = replace(
            trajectory,
            cam_in_world=trajectory.cam_in_world * estimate.metres_per_unit,
            length_unit="m",
            pose_cov=None,
        )
        try:
            path = smooth_path(metric, self.imu, estimate, estimate.gravity_in_world_m_s2)
        except NotObservableError as error:
            log.info("model %d: readout left as it is: %s", model.colmap_index, error)
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
        reason = Fact(
            "readout-settled",
            shift_px=what.shift_px,
            before_px=what.before_px,
            after_px=what.after_px,
            accepted=what.accepted,
        )
        log.info("model %d: %s", model.colmap_index, reason)
        done = Treatment(
            stage="readout",
            reason=reason,
            action=Action.ADJUSTED if what.accepted else Action.NOTHING,
            values=asdict(what),
        )
        return replace(
            model,
            reconstruction=settled if what.accepted else reconstruction,
            treatments=(*model.treatments, done),
            observed_px=_keypoints_of(reconstruction) if what.accepted else {},
        )


def _keypoints_of(reconstruction: pycolmap.Reconstruction) -> dict[str, Array]:
    """Positions (N, 2) of a model's keypoints, by image name."""
    images = (reconstruction.image(i) for i in reconstruction.reg_image_ids())
    return {image.name: np.array([point.xy for point in image.points2D]).reshape(-1, 2) for image in images}
