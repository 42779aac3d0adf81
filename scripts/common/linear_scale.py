"""Scale by linear least squares on accelerations in the time domain: a baseline for comparison, not a method to use.

In the style of Ham, Lucey and Singh, "Hand waving away scale" (ECCV 2014): the camera's acceleration and the
accelerometer's reading in the camera frame are compared sample by sample; they differ by the scale, by gravity and by a
constant bias. The implementation is ours:

* Positions (a cubic spline between the frames, read at 100 Hz) are smoothed and then differentiated twice; orientation
  is interpolated between the poses; the accelerometer is interpolated to the same 100 Hz and turned into the camera.
* ``R force = scale accel - gravity + R bias`` (R turns camera into world) is one linear system, whose columns all pass
  the smoother of the positions, so that it cancels: a zero-phase Butterworth low-pass with its corner at 1.2 Hz, up to
  where the spectral method compares. The ends are cut off. The equations stand in the world frame, where smoothing is
  the same for all; least squares does not mind the frame.
* Seven unknowns, none of them constrained, not even the strength of gravity, and all samples weigh the same.

Known weaknesses, which are why it serves as the baseline: noise of positions acts on a regressor and shrinks the scale;
orientation comes from vision alone; there is no lever arm, no rolling shutter, no robustness, and no uncertainty.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.signal import butter, sosfiltfilt

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_rotate, slerp
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, ImuRecording

LOW_PASS_HZ, LOW_PASS_ORDER = 1.2, 4
GRID_HZ = 100.0
#: Cut off at either end, where the filter has seen one side only.
EDGE_S = 1.0
SHORTEST_S = 3.0


class LinearScale(NamedTuple):
    """What the linear system gives; gravity in the model's world, the bias in the camera frame, both in m/s2."""

    metres_per_unit: float
    gravity_in_world_m_s2: Array
    accel_bias_in_cam_m_s2: Array


@one_blas_thread()
def estimate_linear(trajectory: CameraTrajectory, imu: ImuRecording, calibration: CameraImuCalibration) -> LinearScale:
    """Metres per unit, gravity and accelerometer bias by one linear least-squares solution.

    Parameters
    ----------
    trajectory
        Video: frames close enough together to differentiate positions twice.
    imu
        Only the accelerometer is used.
    calibration
        Rotation and time offset of the accelerometer.

    Raises
    ------
    NotObservableError
        Where less than three seconds are covered, or the scale comes out negative.
    """
    accel_s = CameraTimedImu.from_recording(imu, calibration, trajectory.epoch_ns).accel_t_s
    begin_s, end_s = max(accel_s[0], trajectory.t_s[0]), min(accel_s[-1], trajectory.t_s[-1])
    if end_s - begin_s < SHORTEST_S or len(trajectory) < 6:
        raise NotObservableError(
            "scale", Fact.stated(f"camera and accelerometer share less than {SHORTEST_S:g} s: record longer")
        )
    t_s = np.arange(begin_s, end_s, 1 / GRID_HZ)
    centre = trajectory.cam_in_world - trajectory.cam_in_world.mean(axis=0)
    world_from_cam = matrix_from_quat(slerp(trajectory.t_s, trajectory.cam_from_world_xyzw, t_s)).transpose(0, 2, 1)
    force = np.stack([np.interp(t_s, accel_s, column) for column in imu.accel_m_s2.T], axis=1)

    columns = np.empty((len(t_s), 3, 8))
    columns[:, :, 0] = make_interp_spline(trajectory.t_s, centre, k=3)(t_s)
    columns[:, :, 1:4] = -np.eye(3)
    columns[:, :, 4:7] = world_from_cam
    columns[:, :, 7] = (world_from_cam @ quat_rotate(calibration.cam_from_imu_xyzw, force)[:, :, None])[:, :, 0]
    # Smoothed before differentiating: the filter's padding would spread the noise of the ends' accelerations
    smooth = sosfiltfilt(butter(LOW_PASS_ORDER, LOW_PASS_HZ, fs=GRID_HZ, output="sos"), columns, axis=0)
    smooth[1:-1, :, 0] = np.diff(smooth[:, :, 0], 2, axis=0) * GRID_HZ**2
    edge = round(EDGE_S * GRID_HZ)
    system = smooth[edge:-edge].reshape(-1, 8)
    solution = np.linalg.lstsq(system[:, :7], system[:, 7], rcond=None)[0]
    if not solution[0] > 0:
        raise NotObservableError(
            "scale", Fact.stated("the accelerometer does not feel the camera's motion: move it more briskly")
        )
    return LinearScale(float(solution[0]), solution[1:4], solution[4:7])
