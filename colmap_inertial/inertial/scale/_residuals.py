"""All residuals of the joint fit: of the images, the IMU, and what is expected of states."""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import skew, so3_log
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.factors import (
    Direct,
    Group,
    imu_group,
    lasting_group,
    rotate,
    state_group,
    walk_group,
)
from colmap_inertial.inertial.core.parameters import Estimate, Noise, Prior
from colmap_inertial.inertial.core.preintegration import Preintegrated, SensorErrors, preintegrate
from colmap_inertial.inertial.scale._setup import Measurements

#: Cauchy scale of the visual residuals, in standard deviations: a normal error loses 4 % of its weight on average.
ROBUST_SIGMAS = 4.0


def integrate(data: Measurements, x: Estimate) -> Preintegrated:
    """Preintegration between the nodes at the biases, gains and delays of ``x``."""
    errors = SensorErrors(
        gyro_bias_rad_s=x.gyro_bias_rad_s[:-1],
        accel_bias_m_s2=x.accel_biases_m_s2[:-1],
        gyro_gain=x.gyro_gain,
        accel_gain=x.accel_gain,
        accel_delay_s=x.accel_delay_s,
    )
    return preintegrate(node_stamps(data, x), data.streams, errors)


def node_stamps(data: Measurements, x: Estimate) -> Array:
    """(K,) times of the nodes on the clock of the streams."""
    return np.asarray(data.t_s - x.delay_s - x.clock_rate * (data.t_s - par.middle_s(data.t_s)))


def visual_groups(
    data: Measurements, noise: Noise, x: Estimate, rate_rad_s: Array, *, robust: bool
) -> tuple[Group, Group]:
    """Rotations, and centres given the rotations.

    An image determines a camera's rotation and its centre together: what turns the camera and moves it so that the
    scene stays in place hardly changes the image. The errors of the two are therefore strongly correlated (by 0.6
    to 0.9 in real recordings), and the centre is much better known once the gyroscope has told the rotation. So the
    error of the centre is modelled as coupling times error of the rotation plus a rest; the coupling is estimated.
    """
    camera = x.world_from_imu @ x.cam_from_imu.T  # world_from_cam
    cam_from_world = camera.transpose(0, 2, 1)
    # Mean rate of the group's frames: what row times and a delay act on
    mean_rate_rad_s = data.groups.rate_rad_s @ (np.eye(3) + x.gyro_gain).T - x.gyro_bias_rad_s
    rate = mean_rate_rad_s @ x.cam_from_imu.T
    velocity = rotate(cam_from_world, x.velocity_m_s)
    rotation_by_rate, rotation_by_velocity, centre_by_rate, centre_by_velocity = x.shutter

    rotation, rotation_here, rotation_z = _rotation_residuals(data, x, rate_rad_s, rate)
    smear = rate @ centre_by_rate.T + velocity @ centre_by_velocity.T
    centre, centre_here, centre_z = _centre_residuals(data, x, rate_rad_s, smear)

    # Before the shutter's part: that one, too, is mostly along the direction in which an image changes little
    carried = camera @ (x.coupling_m + x.metres_per_unit * data.coupling)
    centre = centre - rotate(carried, rotation)
    centre_here -= carried @ rotation_here
    centre_z -= carried @ rotation_z
    unsmeared = rotation
    rotation = rotation - rate @ rotation_by_rate.T - velocity @ rotation_by_velocity.T
    rotation_here[:, :, par.VELOCITY] = -rotation_by_velocity @ cam_from_world
    for i in range(3):
        # Entries of the four shutter matrices and of the coupling, row by row
        at = [par.SHUTTER.start + 9 * j + 3 * i for j in range(4)] + [par.COUPLING.start + 3 * i]
        rotation_z[:, i, at[0] : at[0] + 3] = -rate
        rotation_z[:, i, at[1] : at[1] + 3] = -velocity
        column = -camera[:, :, i, None]
        centre_z[:, :, at[2] : at[2] + 3] = column * rate[:, None, :]
        centre_z[:, :, at[3] : at[3] + 3] = column * velocity[:, None, :]
        centre_z[:, :, at[4] : at[4] + 3] = column * unsmeared[:, None, :]

    rotation_root = data.rotation_shape / (noise.rotation_rad * noise.rotation_excess)
    columns = par.VISUAL_GLOBALS
    return (
        _weight_group(rotation, rotation_here, rotation_z[:, :, columns], rotation_root, columns, robust=robust),
        _weight_group(
            centre, centre_here, centre_z, data.centre_shape / noise.centre_m, slice(0, par.N_GLOBALS), robust=robust
        ),
    )


def _rotation_residuals(data: Measurements, x: Estimate, rate_rad_s: Array, rate: Array) -> tuple[Array, Array, Array]:
    """``r_theta`` of ``docs/dev/scale.md#visual-factors`` (K, 3), camera frame, with derivatives by states and globals.

    ``rate_rad_s`` (IMU frame) at the nodes, ``rate`` (camera frame) the mean of each node's frames.
    """
    k = len(data.t_s)
    camera = x.world_from_imu @ x.cam_from_imu.T
    rotation = so3_log(data.groups.world_from_cam.transpose(0, 2, 1) @ camera)
    # The frames were moved to their mean instant with the first guess of the delay
    rotation = rotation + (rate_rad_s @ x.cam_from_imu.T - rate) * x.delay_s
    rotation_here = np.zeros((k, 3, par.N_STATE))
    rotation_here[:, :, par.THETA] = x.cam_from_imu
    since_middle = (data.t_s - par.middle_s(data.t_s))[:, None]
    rotation_z = np.zeros((k, 3, par.N_GLOBALS))
    rotation_z[:, :, par.ROTATION] = -np.eye(3)
    rotation_z[:, :, par.DELAY] = -rate
    rotation_z[:, :, par.CLOCK_RATE] = -rate * since_middle

    return rotation, rotation_here, rotation_z


def _centre_residuals(data: Measurements, x: Estimate, rate_rad_s: Array, smear: Array) -> tuple[Array, Array, Array]:
    """``s c - y - d`` of ``docs/dev/scale.md#visual-factors`` (K, 3), world frame, with derivatives as above.

    ``smear`` (K, 3): what the rolling shutter moves centres by, camera frame.
    """
    k = len(data.t_s)
    camera = x.world_from_imu @ x.cam_from_imu.T
    since_middle = (data.t_s - par.middle_s(data.t_s))[:, None]
    lever_body = x.cam_from_imu.T @ x.imu_in_cam_m
    half_spread_s2 = 0.5 * data.groups.spread_s2[:, None]
    displacement = data.groups.displacement_m - half_spread_s2 * x.accel_biases_m_s2
    displacement = displacement - rotate(data.groups.rotation_since - np.eye(3), np.broadcast_to(lever_body, (k, 3)))
    predicted = x.imu_in_world_m + rotate(camera, smear - x.imu_in_cam_m)
    predicted = predicted + half_spread_s2 * x.gravity_m_s2 + rotate(x.world_from_imu, displacement)
    camera_velocity = x.velocity_m_s - rotate(x.world_from_imu, np.cross(rate_rad_s, lever_body))
    centre = data.groups.centre * x.metres_per_unit - predicted - x.drift_m
    centre_here = np.zeros((k, 3, par.N_STATE))
    centre_here[:, :, par.POSITION] = -np.eye(3)
    centre_here[:, :, par.DRIFT] = -np.eye(3)
    centre_here[:, :, par.THETA] = x.world_from_imu @ skew(displacement - lever_body)
    centre_here[:, :, par.ACCEL_WALK] = centre_here[:, :, par.ACCEL_SLOW] = (
        half_spread_s2[:, :, None] * x.world_from_imu
    )
    centre_here[:, :, par.VELOCITY] = -camera @ x.shutter[3] @ camera.transpose(0, 2, 1)
    centre_z = np.zeros((k, 3, par.N_GLOBALS))
    # The noise sits on the visual centre, so a change of log u scales the prediction: total least squares
    centre_z[:, :, par.SCALE] = -predicted
    centre_z[:, :, par.ROTATION] = camera @ skew(x.imu_in_cam_m)
    centre_z[:, :, par.GRAVITY] = -half_spread_s2[:, :, None] * np.eye(3)
    centre_z[:, :, par.ACCEL_BIAS] = half_spread_s2[:, :, None] * x.world_from_imu
    centre_z[:, :, par.LEVER] = x.world_from_imu @ data.groups.rotation_since @ x.cam_from_imu.T
    centre_z[:, :, par.DELAY] = camera_velocity
    centre_z[:, :, par.CLOCK_RATE] = camera_velocity * since_middle
    return centre, centre_here, centre_z


def _weight_group(
    residual: Array, here: Array, by_globals: Array, root: Array, columns: slice, *, robust: bool
) -> Group:
    """Whitened residuals; with ``robust``, by the weights of Cauchy's loss."""
    whitened = rotate(root, residual)
    weight = np.ones(len(residual))
    if robust:
        weight = 1 / (1 + np.sum(whitened**2, axis=1) / (3 * ROBUST_SIGMAS**2))
    root_weight = np.sqrt(weight)[:, None, None]
    root = root * root_weight
    return Group(
        residual=whitened * root_weight[:, :, 0],
        here=root @ here,
        by_globals=root @ by_globals,
        columns=columns,
        weight=weight,
    )


#: Which cause of the scale's variance (``verdict.CAUSES``) the groups of :func:`all_groups` belong to.
CAUSE_OF_GROUP = {
    "imu": "gyro",
    "gyro_walk": "gyro",
    "gyro_bias": "gyro",
    "accel_walk": "accel_bias",
    "accel_slow": "accel_noise",
    "accel_slow_zero": "accel_noise",
    "accel_zero": "accel_bias",
    "rotation": "camera_path",
    "centre": "camera_path",
    "drift": "camera_path",
    "drift_zero": "camera_path",
    "speed": "camera_path",
}


def all_groups(
    data: Measurements, noise: Noise, prior: Prior, x: Estimate, pre: Preintegrated, *, robust: bool
) -> dict[str, Group | Direct]:
    """Everything but the priors of the globals."""
    rotation, centre = visual_groups(data, noise, x, pre.rate_rad_s, robust=robust)
    middle = int(np.argmin(np.abs(data.t_s - par.middle_s(data.t_s))))
    return {
        "imu": imu_group(noise, x, pre),
        "rotation": rotation,
        "centre": centre,
        "gyro_walk": walk_group(x.gyro_bias_rad_s, par.GYRO_BIAS, noise.gyro_walk_rad_s2_rthz, pre.dt_s),
        "accel_walk": walk_group(x.accel_walk_m_s2, par.ACCEL_WALK, noise.accel_walk_m_s3_rthz, pre.dt_s),
        "drift": lasting_group(x.drift_m, par.DRIFT, noise.drift_m_rts, par.DRIFT_S, pre.dt_s, data.broken),
        "accel_slow": lasting_group(
            x.accel_slow_m_s2,
            par.ACCEL_SLOW,
            noise.accel_slow_m_s2_rts,
            par.ACCEL_SLOW_S,
            pre.dt_s,
            np.zeros_like(data.broken),
        ),
        # Anchors of what only differences determine
        "gyro_bias": state_group(
            x.gyro_bias_rad_s[:1] - prior.mean.gyro_bias_rad_s[:1], par.GYRO_BIAS, prior.gyro_bias_sigma_rad_s
        ),
        "accel_zero": state_group(x.accel_walk_m_s2[middle : middle + 1], par.ACCEL_WALK, 1e-4, middle),
        "drift_zero": state_group(x.drift_m[:1], par.DRIFT, noise.drift_m),
        "accel_slow_zero": state_group(x.accel_slow_m_s2[:1], par.ACCEL_SLOW, noise.accel_slow_m_s2),
        "speed": state_group(x.velocity_m_s, par.VELOCITY, prior.speed_sigma_m_s),
    }


def rotation_groups(
    data: Measurements, noise: Noise, prior: Prior, x: Estimate, pre: Preintegrated
) -> dict[str, Group | Direct]:
    """Residuals of rotations alone; all else is held."""
    k = len(data.t_s)
    rotation, _ = visual_groups(data, noise, x, pre.rate_rad_s, robust=True)
    held = {
        str(columns): state_group(np.zeros((k, 3)), columns, 1.0)
        for columns in (par.POSITION, par.VELOCITY, par.ACCEL_WALK, par.DRIFT, par.ACCEL_SLOW)
    }
    return {
        "imu": imu_group(noise, x, pre, rotation_only=True),
        "rotation": rotation,
        "gyro_walk": walk_group(x.gyro_bias_rad_s, par.GYRO_BIAS, noise.gyro_walk_rad_s2_rthz, pre.dt_s),
        "gyro_bias": state_group(
            x.gyro_bias_rad_s[:1] - prior.mean.gyro_bias_rad_s[:1], par.GYRO_BIAS, prior.gyro_bias_sigma_rad_s
        ),
        **held,
    }
