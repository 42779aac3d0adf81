"""GTSAM as the oracle: the same factors, put together and solved by somebody else."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, V, X

from colmap_inertial.core.geometry import so3_exp, so3_log
from colmap_inertial.inertial.core.preintegration import SensorErrors, preintegrate
from colmap_inertial.inertial.refine import solve as solver
from colmap_inertial.inertial.refine._residuals import imu_rows
from colmap_inertial.inertial.refine.solve import factor_information, solve
from colmap_inertial.inertial.refine.values import N_STATE
from tests.helpers.refine_walk import PINHOLE, nudged, problem_of, tracks_of, walk

#: Seconds of GTSAM's integration steps.
STEP_S = 0.001


@pytest.fixture(scope="module")
def solved():
    options = walk(5.0, points_per_m=40.0, camera=PINHOLE)
    problem, start, _ = problem_of(tracks_of(options), options, refine_intrinsics=False)
    # what GTSAM's factors do not estimate is known
    count = start.columns.count
    problem = replace(problem, prior=replace(problem.prior, mean=start, info=1e14 * np.eye(count)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solver, "SOLVE", replace(solver.SOLVE, settled=1e-6))
        solution = solve(problem, nudged_states(start))
    return problem, solution.estimate


def nudged_states(start):
    rng = np.random.default_rng(5)
    off = nudged(start, rng)
    return start.moved(
        1e-3 * rng.standard_normal((len(start.velocity_m_s), N_STATE)),
        np.zeros(start.columns.count),
        off.points_m - start.points_m,
    )


def pose_of(x, i):
    return gtsam.Pose3(gtsam.Rot3(x.world_from_imu[i]), x.imu_in_world_m[i])


def bias_of(x, i):
    return gtsam.imuBias.ConstantBias(x.accel_bias_m_s2[i], x.gyro_bias_rad_s[i])


def increments(problem, x, i):
    """GTSAM's own integration of the readings between two frames."""
    inertial, noise = problem.inertial, problem.inertial.noise
    params = gtsam.PreintegrationParams(x.gravity_m_s2 * inertial.down)
    params.setGyroscopeCovariance(noise.gyro_density_rad_s_rthz**2 * np.eye(3))
    params.setAccelerometerCovariance(noise.accel_density_m_s2_rthz**2 * np.eye(3))
    params.setIntegrationCovariance(1e-14 * np.eye(3))
    out = gtsam.PreintegratedImuMeasurements(params, bias_of(x, i))
    begin_s, end_s = inertial.nodes_s[i : i + 2]
    steps = round((end_s - begin_s) / STEP_S)
    dt = (end_s - begin_s) / steps
    middle_s = begin_s + dt * (np.arange(steps) + 0.5)
    rate, force = inertial.streams.gyro.at(middle_s)[0], inertial.streams.accel.at(middle_s)[0]
    # GTSAM takes a step's force in the frame where the step begins
    turned = so3_exp(0.5 * dt * (rate - x.gyro_bias_rad_s[i]))
    force = np.einsum("nij,nj->ni", turned, force - x.accel_bias_m_s2[i]) + x.accel_bias_m_s2[i]
    for w, f in zip(rate, force, strict=True):
        out.integrateMeasurement(f, w, dt)
    return out


def graph_of(problem, x):
    graph, inertial, noise = gtsam.NonlinearFactorGraph(), problem.inertial, problem.inertial.noise
    frames = len(x.velocity_m_s)
    for i in range(frames - 1):
        graph.add(gtsam.ImuFactor(X(i), V(i), X(i + 1), V(i + 1), B(i), increments(problem, x, i)))
        root_s = np.sqrt(np.diff(inertial.nodes_s)[i])
        sigmas = np.repeat([noise.accel_walk_m_s3_rthz * root_s, noise.gyro_walk_rad_s2_rthz * root_s], 3)
        between = gtsam.BetweenFactorConstantBias(
            B(i), B(i + 1), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        )
        graph.add(between)
    for i in range(frames):
        graph.add(gtsam.PriorFactorVector(V(i), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 10.0)))
    prior, mean = problem.prior, problem.prior.mean
    sigmas = np.repeat([prior.accel_bias_sigma_m_s2, prior.gyro_bias_sigma_rad_s], 3)
    graph.add(gtsam.PriorFactorConstantBias(B(0), bias_of(mean, 0), gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    down = mean.world_from_imu[0].T @ inertial.down
    info = np.diag([1e-4, 1e-4, 1e-4, 1e10, 1e10, 1e10])
    info[:3, :3] += 1e12 * np.outer(down, down)
    graph.add(gtsam.PriorFactorPose3(X(0), pose_of(mean, 0), gtsam.noiseModel.Gaussian.Information(info)))
    fx, fy, cx, cy = problem.cameras[0].model.params
    lens = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
    imu_from_cam = gtsam.Pose3(gtsam.Rot3(x.cam_from_imu.T), -x.cam_from_imu.T @ x.imu_in_cam_m)
    pixels = gtsam.noiseModel.Isotropic.Sigma(2, problem.sigma_px)
    robust = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(problem.robust_px / problem.sigma_px), pixels
    )
    seen = problem.observations
    for f, p, xy in zip(seen.frame.tolist(), seen.point.tolist(), seen.xy_px, strict=True):
        graph.add(gtsam.GenericProjectionFactorCal3_S2(xy, robust, X(f), L(p), lens, imu_from_cam))
    return graph


def values_of(x):
    values = gtsam.Values()
    for i in range(len(x.velocity_m_s)):
        values.insert(X(i), pose_of(x, i))
        values.insert(V(i), x.velocity_m_s[i])
        values.insert(B(i), bias_of(x, i))
    for p, xyz in enumerate(x.points_m):
        values.insert(L(p), xyz)
    return values


def sigmas_of(problem, x):
    """(F, 15) standard deviations by the refinement's own covariance."""
    found = factor_information(problem, x)
    n = found.solved.shape[0]
    states, _ = found.solve(np.eye(n), np.zeros((x.columns.count, n)))
    columns = N_STATE * found.layout.place[:, None] + np.arange(N_STATE)
    return states, columns, np.sqrt(np.diagonal(states))[columns]


def test_increments_and_their_derivatives_are_gtsam_s(solved):
    problem, x = solved
    errors = SensorErrors(
        gyro_bias_rad_s=x.gyro_bias_rad_s[:-1],
        accel_bias_m_s2=x.accel_bias_m_s2[:-1],
        gyro_gain=np.zeros((3, 3)),
        accel_gain=np.zeros((3, 3)),
    )
    ours = preintegrate(problem.inertial.nodes_s, problem.inertial.streams, errors)
    for i in (0, 7):
        theirs = increments(problem, x, i)
        assert np.abs(so3_log(ours.rotation[i].T @ theirs.deltaRij().matrix())).max() < 1e-5
        assert theirs.deltaVij() == pytest.approx(ours.velocity[i], abs=2e-4)
        assert theirs.deltaPij() == pytest.approx(ours.position[i], abs=5e-5)
        # a small change of the biases
        rate, force = np.array([2e-3, -1e-3, 1.5e-3]), np.array([0.02, 0.03, -0.01])
        bias = gtsam.imuBias.ConstantBias(x.accel_bias_m_s2[i] + force, x.gyro_bias_rad_s[i] + rate)
        began = gtsam.NavState(gtsam.Pose3(), np.zeros(3))
        dt, gravity = ours.dt_s[i], x.gravity_m_s2 * problem.inertial.down
        moved = theirs.predict(began, bias)
        by = ours.by_gyro_bias[i] @ rate + ours.by_accel_bias[i] @ force
        assert so3_exp(by[:3]) @ ours.rotation[i] == pytest.approx(moved.attitude().matrix(), abs=2e-5)
        assert ours.velocity[i] + by[3:6] + gravity * dt == pytest.approx(moved.velocity(), abs=3e-4)
        assert ours.position[i] + by[6:] + 0.5 * gravity * dt**2 == pytest.approx(moved.position(), abs=6e-5)


def test_residuals_of_the_imu_weigh_as_gtsam_s(solved):
    problem, x = solved
    rng = np.random.default_rng(1)
    off = x.moved(1e-3 * rng.standard_normal((len(x.velocity_m_s), N_STATE)), np.zeros(x.columns.count), 0 * x.points_m)
    rows, values = imu_rows(problem, off), values_of(off)
    for i in (0, 5, 9):
        factor = gtsam.ImuFactor(X(i), V(i), X(i + 1), V(i + 1), B(i), increments(problem, off, i))
        assert 2 * factor.error(values) == pytest.approx(float(np.sum(rows.residual[i] ** 2)), rel=0.02)


def test_the_optimum_is_gtsam_s(solved):
    problem, x = solved
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-10)
    params.setAbsoluteErrorTol(1e-10)
    params.setMaxIterations(50)
    found = gtsam.LevenbergMarquardtOptimizer(graph_of(problem, x), values_of(nudged_states(x)), params).optimize()
    _, _, sigma = sigmas_of(problem, x)
    for i in range(len(x.velocity_m_s)):
        pose = found.atPose3(X(i))
        turn = so3_log(x.world_from_imu[i].T @ pose.rotation().matrix())
        assert np.all(np.abs(turn) < 0.1 * sigma[i, :3] + 1e-6)
        assert np.all(np.abs(pose.translation() - x.imu_in_world_m[i]) < 0.1 * sigma[i, 3:6] + 2e-5)
        assert np.all(np.abs(found.atVector(V(i)) - x.velocity_m_s[i]) < 0.1 * sigma[i, 6:9])
        bias = found.atConstantBias(B(i))
        assert np.all(np.abs(bias.gyroscope() - x.gyro_bias_rad_s[i]) < 0.1 * sigma[i, 9:12])
        assert np.all(np.abs(bias.accelerometer() - x.accel_bias_m_s2[i]) < 0.1 * sigma[i, 12:15])


def test_covariances_are_gtsam_s(solved):
    problem, x = solved
    marginals = gtsam.Marginals(graph_of(problem, x), values_of(x))
    states, columns, _ = sigmas_of(problem, x)
    last = len(x.velocity_m_s) - 1
    for i in (last // 2, last):
        mine = states[np.ix_(columns[i], columns[i])]
        pose = marginals.marginalCovariance(X(i))
        rotation = x.world_from_imu[i]
        position = rotation @ pose[3:, 3:] @ rotation.T
        assert np.sqrt(np.diagonal(position)) == pytest.approx(np.sqrt(np.diagonal(mine)[3:6]), rel=0.03)
        assert np.sqrt(np.diagonal(pose)[:3]) == pytest.approx(np.sqrt(np.diagonal(mine)[:3]), rel=0.03)
        speed = np.sqrt(np.diagonal(marginals.marginalCovariance(V(i))))
        assert speed == pytest.approx(np.sqrt(np.diagonal(mine)[6:9]), rel=0.03)
        bias = np.sqrt(np.diagonal(marginals.marginalCovariance(B(i))))
        assert bias[:3] == pytest.approx(np.sqrt(np.diagonal(mine)[12:15]), rel=0.03)
        assert bias[3:] == pytest.approx(np.sqrt(np.diagonal(mine)[9:12]), rel=0.03)
