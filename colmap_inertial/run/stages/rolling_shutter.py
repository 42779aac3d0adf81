"""The default keypoint stage: keypoints without the rolling shutter."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Action, CameraImuCalibration, CameraModel, Keypoints, Projector, Treatment
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.imaging.rolling_shutter import project_by_lines, rays, rectify_image, rectify_keypoints
from colmap_inertial.model import colmap_camera
from colmap_inertial.run.stages.imaging_plan import GyroView
from colmap_inertial.run.stages.inputs import StageInputs


@dataclass(frozen=True, eq=False, kw_only=True)
class RollingShutterStage:
    """The keypoint stage that moves keypoints to where a global shutter would have seen them.

    The instant is the one that poses hold, mid-exposure of the middle row. Keypoints of frames that the gyroscope does
    not cover stay in place.

    Attributes
    ----------
    view
        Gyroscope, camera and times.
    """

    view: GyroView
    _ready: dict[str, tuple[GyroCamera, Projector, dict[str, int]]] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )

    @classmethod
    def for_run(cls, inputs: StageInputs) -> RollingShutterStage | None:
        """The stage of a run, where the plan says that keypoints are rectified."""
        view = inputs.plan.view
        return cls(view=view) if view is not None and inputs.plan.rectify else None

    def __call__(self, keypoints: Keypoints, /) -> Keypoints:
        """Move the keypoints of one image."""
        name = keypoints.name
        if not self.covers(name):
            treatment = Treatment(stage="rolling_shutter", reason=Fact("readout-not-covered"))
            return replace(keypoints, treatments=(*keypoints.treatments, treatment))
        treatment = Treatment(stage="rolling_shutter", reason=Fact("shutter-undone"), action=Action.RECTIFIED)
        return replace(
            keypoints,
            xy_px=self.moved(name, keypoints.xy_px),
            rectified=True,
            treatments=(*keypoints.treatments, treatment),
        )

    def moved(self, name: str, xy_px: Array) -> Array:
        """(N, 2) where a global shutter would have seen points of an image that the gyroscope covers."""
        motion, camera, index = self._parts()
        return np.asarray(rectify_keypoints(xy_px, motion, camera, self.view.shutter(index[name])), dtype=np.float64)

    def as_exposed(self, name: str, xy_px: Array) -> Array:
        """The inverse of :meth:`moved`: where the shutter had points (N, 2); as they are where it did not move them."""
        motion, camera, index = self._parts()
        if name not in index or not self.covers(name):
            return xy_px
        shutter = self.view.shutter(index[name])
        reference = motion.start_from_cam(np.array(shutter.reference_s()))
        exposed_px = project_by_lines(rays(camera, xy_px) @ reference.T, xy_px, motion, camera, shutter)
        return np.where(np.isfinite(exposed_px), exposed_px, xy_px)

    def move_image(self, name: str, image: Any, /) -> Any:
        """The pixels of one image as a global shutter would have taken them."""
        if not self.covers(name):
            return image
        motion, camera, index = self._parts()
        return rectify_image(image, motion, camera, self.view.shutter(index[name]))[0]

    def covers(self, name: str) -> bool:
        """Whether the gyroscope recorded the whole readout of a frame."""
        motion, _, index = self._parts()
        return self.view.shutter(index[name]).covered_by(motion, reference=True)

    def refined(self, calibration: CameraImuCalibration, readout_s: float, camera: CameraModel) -> RollingShutterStage:
        """The stage with another calibration, readout and camera."""
        timing = replace(self.view.timing, readout_s=readout_s)
        return RollingShutterStage(view=replace(self.view, calibration=calibration, timing=timing, camera=camera))

    def _parts(self) -> tuple[GyroCamera, Projector, dict[str, int]]:
        if "parts" not in self._ready:
            self._ready["parts"] = self.view.motion(), colmap_camera(self.view.camera), self.view.index()
        return self._ready["parts"]
