"""Rigs: cameras that are fixed to each other, whose images of one moment have one pose."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array

if TYPE_CHECKING:
    import pycolmap


def has_rigs(reconstruction: pycolmap.Reconstruction) -> bool:
    """Whether any of the registered frames is of a rig of several cameras."""
    frames = map(reconstruction.frame, reconstruction.reg_frame_ids())
    return any(reconstruction.rig(number).num_sensors() > 1 for number in {frame.rig_id for frame in frames})


@dataclass(frozen=True, kw_only=True)
class RigSensor:
    """A camera of a rig, against the rig's reference camera; by COLMAP's numbers of cameras.

    Attributes
    ----------
    cam_from_reference_xyzw, translation_m
        The transform ``cam_from_reference``.
    baseline_m
        Distance between both.
    """

    camera_id: int
    reference_id: int
    cam_from_reference_xyzw: tuple[float, ...]
    translation_m: tuple[float, ...]
    baseline_m: float


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedFrame:
    """Images of one moment: one, or one of each camera of a rig.

    Attributes
    ----------
    images
        The reference camera's first, where there is one; then by name.
    pose
        ``cam_from_world`` of the reference camera, also where it took no image.
    """

    images: tuple[pycolmap.Image, ...]
    pose: pycolmap.Rigid3d

    def centre(self) -> Array:
        """(3,) where the reference camera is."""
        image = self.images[0]
        return np.asarray(image.projection_center() if image.is_ref_in_frame() else self.pose.inverse().translation)


def list_posed_frames(reconstruction: pycolmap.Reconstruction) -> list[PosedFrame]:
    """The registered frames of a model."""
    if not has_rigs(reconstruction):
        images = [reconstruction.image(number) for number in reconstruction.reg_image_ids()]
        return [PosedFrame(images=(image,), pose=image.cam_from_world()) for image in images]
    frames = []
    for number in reconstruction.reg_frame_ids():
        frame = reconstruction.frame(number)
        images = [reconstruction.image(data.id) for data in frame.image_ids if reconstruction.exists_image(data.id)]
        images.sort(key=lambda image: (not image.is_ref_in_frame(), image.name))
        pose = frame.rig_from_world
        if images and pose is not None:
            frames.append(PosedFrame(images=tuple(images), pose=pose))
    return frames


def frames_of_rigs(reconstructions: Iterable[pycolmap.Reconstruction]) -> dict[str, str]:
    """First image of each image's rig frame, by name; empty where no model has rigs."""
    return {
        image.name: frame.images[0].name
        for reconstruction in reconstructions
        if has_rigs(reconstruction)
        for frame in list_posed_frames(reconstruction)
        for image in frame.images
    }


def rig_sensors(reconstruction: pycolmap.Reconstruction) -> tuple[RigSensor, ...]:
    """The cameras of a metric model's rigs, as far as rigs have registered frames."""
    sensors = []
    for number in sorted({reconstruction.frame(number).rig_id for number in reconstruction.reg_frame_ids()}):
        rig = reconstruction.rig(number)
        for sensor, pose in sorted(rig.non_ref_sensors.items(), key=lambda item: item[0].id):
            if pose is not None:
                sensors.append(
                    RigSensor(
                        camera_id=sensor.id,
                        reference_id=rig.ref_sensor_id.id,
                        cam_from_reference_xyzw=tuple(np.array(pose.rotation.quat).tolist()),
                        translation_m=tuple(np.array(pose.translation).tolist()),
                        baseline_m=float(np.linalg.norm(pose.translation)),
                    )
                )
    return tuple(sensors)
