"""``truth.json``: what a simulated capture's images and samples were made from, and checks against it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.types import CAL, CameraImuCalibration, CameraTrajectory
from colmap_inertial.io.files import read_json, reader


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneTruth:
    """The truth about a simulated capture.

    Attributes
    ----------
    trajectory
        True poses at the frames' middle instants, metres, world z up.
    calibration
        True camera-IMU calibration; its ``cov`` is zero.
    accel_bias_m_s2
        (3,) mean over the recording, IMU frame.
    target, target_corners_m
        The checkerboard's specification; (N, 3) its inner corners in the world.
    """

    trajectory: CameraTrajectory
    calibration: CameraImuCalibration
    accel_bias_m_s2: Array
    target: str
    target_corners_m: Array


@reader("the truth of a simulated capture")
def read_truth(path: Path) -> SceneTruth:
    """Read a ``truth.json``.

    Raises
    ------
    FormatError
        Where it is missing, or not one of ours.
    """
    values = read_json(path)
    frames: list[dict[str, Any]] = values["frames"]
    calibration = values["calibration"]
    return SceneTruth(
        trajectory=CameraTrajectory(
            names=tuple(frame["name"] for frame in frames),
            t_s=np.array([frame["t_middle_s"] for frame in frames]),
            cam_from_world_xyzw=np.array([frame["cam_from_world_xyzw"] for frame in frames]),
            cam_in_world=np.array([frame["cam_in_world_m"] for frame in frames]),
            length_unit="m",
        ),
        calibration=CameraImuCalibration(**calibration, cov=np.zeros((CAL.COUNT, CAL.COUNT))),
        accel_bias_m_s2=np.array(values["accel_bias_m_s2"], dtype=np.float64),
        target=values["target"]["spec"],
        target_corners_m=np.array(values["target"]["corners_in_world_m"], dtype=np.float64),
    )


def true_metres_per_unit(names: tuple[str, ...], cam_in_world: Array, truth: CameraTrajectory) -> float:
    """The scale factor that fits a model's camera centres to the true ones best (Umeyama 1991).

    Parameters
    ----------
    names
        (F,) image names of the model; those without truth are left out.
    cam_in_world
        (F, 3) camera centres in the model's unit.
    truth
        True trajectory in metres.

    Raises
    ------
    ValueError
        With fewer than three cameras in common.
    """
    index = {name: i for i, name in enumerate(truth.names)}
    known = [(i, index[name]) for i, name in enumerate(names) if name in index]
    if len(known) < 3:
        raise ValueError(f"{len(known)} of the model's images have a true pose; at least three are needed")
    i, j = np.array(known).T
    model, true = cam_in_world[i] - cam_in_world[i].mean(axis=0), truth.cam_in_world[j]
    true = true - true.mean(axis=0)
    u, singular, vt = np.linalg.svd(true.T @ model)
    singular[2] *= np.sign(np.linalg.det(u @ vt))
    return float(singular.sum() / np.sum(model**2))
