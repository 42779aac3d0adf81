"""Gains of an accelerometer by motion capture: for ``scripts.studies.scale_real --calibrated``.

Nothing of the package's estimator is in it. Newton's law is multiplied by bumps of a second and integrated by parts
twice, so that positions are never differentiated: ``int bump'' p = int bump (R ((I + gain) f - bias) + g)`` is linear
in the gain (nine entries), the tilt of gravity and a bias for every ten seconds.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.types import IMU_CALIBRATION_PARAMETERS, ImuCalibration
from scripts.common.real_imu import RECORDINGS, Motion, read

#: Length of a bump, of a bias, and the strength of gravity in Munich (latitude 48.26 degrees, 480 m).
BUMP_S, BIAS_S, GRAVITY_M_S2 = 1.0, 10.0, 9.8073
#: Longest pause of the motion capture within a bump.
PAUSE_S = 0.03
#: How far the recordings of a rig agree on a gain or misalignment.
GAIN_SIGMA = 0.001
#: Standard deviations beforehand: gains, tilt of gravity and biases in m/s2.
GAIN, TILT_M_S2, BIAS_M_S2 = 0.02, 0.5, 0.3


def _equations(motion: Motion, rig: tuple[Array, Array]) -> tuple[Array, Array]:
    """Rows (N, U) and right side (N,) of the unknowns: gain (9, by rows), tilt (2), biases (3 each)."""
    body_from_cam, cam_in_body_m = rig
    t_s = motion.t_s
    world_from_imu = motion.world_from_cam @ body_from_cam.T
    imu_in_world_m = motion.cam_in_world_m - world_from_imu @ cam_in_body_m
    turn = Slerp(t_s, Rotation.from_matrix(world_from_imu))
    biases = int((t_s[-1] - t_s[0]) // BIAS_S) + 1
    rows, right = [], []
    for middle_s in np.arange(t_s[0] + BUMP_S, t_s[-1] - BUMP_S, BUMP_S / 2):
        seen = np.abs(t_s - middle_s) < BUMP_S / 2
        felt = np.abs(motion.imu_t_s - middle_s) < BUMP_S / 2
        if seen.sum() < 3 or np.diff(t_s[seen]).max() > PAUSE_S or np.ptp(t_s[seen]) < BUMP_S - 2 * PAUSE_S:
            continue  # the motion capture lost the rig
        cos2 = np.cos(np.pi * (t_s[seen] - middle_s) / BUMP_S) ** 2
        curvature = (12 * cos2 * (1 - cos2) - 4 * cos2**2) * (np.pi / BUMP_S) ** 2 * np.gradient(t_s[seen])
        bump = np.cos(np.pi * (motion.imu_t_s[felt] - middle_s) / BUMP_S) ** 4 * np.gradient(motion.imu_t_s[felt])
        rotation, reading = turn(motion.imu_t_s[felt]).as_matrix(), motion.accel_m_s2[felt]
        row = np.zeros((3, 11 + 3 * biases))
        row[:, :9] = np.einsum("n,nij,nk->ijk", bump, rotation, reading).reshape(3, 9)
        row[:2, 9:11] = bump.sum() * np.eye(2)
        at = 11 + 3 * int((middle_s - t_s[0]) // BIAS_S)
        row[:, at : at + 3] = -np.einsum("n,nij->ij", bump, rotation)
        position = imu_in_world_m[seen] - imu_in_world_m[seen].mean(axis=0)
        force = np.einsum("n,nij,nj->i", bump, rotation, reading)
        rows.append(row)
        right.append(curvature @ position - force + np.array([0.0, 0.0, bump.sum() * GRAVITY_M_S2]))
    return np.concatenate(rows), np.concatenate(right)


@cache
def fitted_gain(folder: Path, name: str) -> Array:
    """(3, 3) errors of gain and alignment of a recording's accelerometer against its motion capture."""
    rows, right = _equations(read(folder, name, whole=True), RECORDINGS[name][0])
    before = np.diag(1 / np.repeat([GAIN, TILT_M_S2, BIAS_M_S2], [9, 2, rows.shape[1] - 11]) ** 2)
    weight, sigma = np.ones(len(right)), 1.0
    for _ in range(6):  # Cauchy's weights
        weighted = rows * (weight / sigma**2)[:, None]
        found = np.linalg.solve(weighted.T @ rows + before, weighted.T @ right)
        residual = np.abs(right - rows @ found)
        sigma = float(1.4826 * np.median(residual))
        weight = 1 / (1 + (residual / (3 * sigma)) ** 2)
    return found[:9].reshape(3, 3)


def calibration_by(folder: Path, names: tuple[str, ...]) -> ImuCalibration:
    """The accelerometer's calibration by the mean over recordings; the gyroscope's is left as unknown as any."""
    gain = np.mean([fitted_gain(folder, name) for name in names], axis=0)
    lower = np.tril(gain) + np.triu(gain, 1).T  # what turns all axes together is not the accelerometer's
    sigma = {"accel_gain": GAIN_SIGMA, "accel_bias": 0.2, "gyro_gain": 0.01, "gyro_bias": 0.05}
    cov = np.diag([sigma["_".join(name.split("_")[:2])] ** 2 for name in IMU_CALIBRATION_PARAMETERS])
    return ImuCalibration(
        accel_gain=lower,
        accel_bias_m_s2=np.zeros(3),
        gyro_gain=np.zeros((3, 3)),
        gyro_bias_rad_s=np.zeros(3),
        cov=cov,
        gravity_m_s2=GRAVITY_M_S2,
        attitudes=0,
    )
