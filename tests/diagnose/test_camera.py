"""Checks of the camera against the gyroscope."""

from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.diagnose import camera


def test_a_camera_that_turns_in_one_second_of_half_a_minute_turned_too_little():
    t_s = np.arange(0.0, 30.0, 0.1)
    angle = np.where(t_s > 20.0, np.minimum(t_s - 20.0, 1.0), 0.0)
    turning = CameraTrajectory(
        names=tuple(map(str, range(len(t_s)))),
        t_s=t_s,
        cam_from_world_xyzw=Rotation.from_rotvec(angle[:, None] * [0.0, 1.0, 0.0]).as_quat(),
        cam_in_world=np.zeros((len(t_s), 3)),
    )
    open_rad = {name: SimpleNamespace(rotation_sigma_rad=rad) for name, rad in (("known", 0.04), ("open", 0.06))}
    found = {k: list(camera._check_turned(turning, SimpleNamespace(calibration=v))) for k, v in open_rad.items()}
    assert found["known"] == [] and [finding.code for finding in found["open"]] == ["rotation-too-little"]
    assert "fastest at 20 s" in found["open"][0].evidence
