"""Checks of the frames."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_rotate
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel, FrameTiming, ImuRecording
from colmap_inertial.diagnose import Recorded
from colmap_inertial.diagnose.frames import _estimate_readout, check_unstated_exposure
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.motion.flow import GreyFrame, VisualRotation
from tests.helpers.far_scene import CAM_FROM_IMU, FarScene


def test_pictures_far_apart_tell_no_readout():
    with pytest.raises(NotObservableError, match="far apart"):
        _estimate_readout(SimpleNamespace(rotation=object(), aligned=None, imu=None, is_dense=False))


def test_an_exposure_that_nobody_states_is_said_with_its_blur() -> None:
    scene, exposure_s = FarScene.make(6, vigour=1.5, size=2000), 0.02
    camera = CameraModel(model="PINHOLE", width=640, height=480, params=(520.0, 520.0, 320.0, 240.0))
    # stamps are of mid-exposure: nobody knows when it begins
    t_s = np.linspace(0.4, 5.6, 40)
    timing = FrameTiming(names=tuple(f"{i:02}.png" for i in range(len(t_s))), t_s=t_s, readout_s=0.0)

    asked: list[str] = []

    def images(names: Sequence[str]) -> Iterator[GreyFrame]:
        asked.extend(names)
        for i in map(timing.names.index, names):
            shutter = FrameShutter(width=640, height=480, t_s=t_s[i] - 0.5 * exposure_s, exposure_s=exposure_s)
            image = scene.picture(camera, shutter, samples=20, noise=0.004, seed=i)
            yield GreyFrame(name=timing.names[i], grey=image, width=640, height=480)

    gyro = scene.gyro(end_s=6.0)
    path = GyroPath(gyro.path.t_s + gyro.offset_s, gyro.path.rate_rad_s, np.zeros(3))
    turn = quat_rotate(CAM_FROM_IMU, path.turn_rad(t_s[:-1], t_s[1:]))
    rotation = VisualRotation(
        names=timing.names,
        t_s=t_s,
        turn_rad=turn,
        sigma_rad=np.full(len(turn), 1e-4),
        support=np.full(len(turn), 200, dtype=np.intp),
    )
    imu = ImuRecording(
        gyro_t_s=path.t_s,
        gyro_rad_s=path.rate_rad_s,
        accel_t_s=path.t_s,
        accel_m_s2=np.tile([0.0, 0.0, 9.81], (len(path.t_s), 1)),
    )
    recorded = Recorded(
        imu=imu,
        timing=timing,
        rotation=rotation,
        camera=camera,
        is_capture=True,
        images=images,
        in_full=timing.names[4:],
    )
    (finding,) = check_unstated_exposure(recorded)
    assert set(asked) <= set(timing.names[4:]), "no frame is decoded for it"
    values = finding.fact.values
    assert finding.code == "exposure-unstated"
    assert abs(values["exposure_s"] - exposure_s) < 3 * values["exposure_sigma_s"]
    fastest_px_s = 520.0 * np.linalg.norm(gyro.rate_in_cam_rad_s(t_s), axis=1).max()
    assert values["most_px"] == pytest.approx(fastest_px_s * values["exposure_s"], rel=0.5)
    # a stated one is not asked for, and without images nothing is said
    stated = replace(timing, exposure_s=np.full(len(t_s), exposure_s))
    assert not list(check_unstated_exposure(replace(recorded, timing=stated)))
    assert not list(check_unstated_exposure(replace(recorded, images=None)))
