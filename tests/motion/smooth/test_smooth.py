"""Smoothing agrees with independent solvers, states its errors honestly, and survives what recordings contain."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_from_matrix,
    quat_log,
    quat_multiply,
    quat_rotate,
    slerp,
)
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.imu import read_imu
from colmap_inertial.motion.align import align_camera_imu
from colmap_inertial.motion.smooth import (
    SmoothOptions,
    WorldAcceleration,
    smooth_attitude,
    smooth_positions,
    smooth_trajectory,
)
from colmap_inertial.motion.smooth._positions import Chain, constant_acceleration, white_jerk
from colmap_inertial.tools.simulate import ImuOptions, MotionOptions, RecordingOptions, SfmOptions, simulate_recording

#: Gains and misalignments are not part of the smoother's model (they are priced in roughly): left out for exact tests.
IDEAL_GAINS = replace(
    ImuOptions(),
    gyro_scale_sd=0.0,
    gyro_misalignment_sd=0.0,
    accel_scale_sd=0.0,
    accel_misalignment_sd=0.0,
    clock_rate_sd=0.0,
)


def track(t, centre, **more):
    count = len(t)
    return CameraTrajectory(
        names=tuple(map(str, range(count))),
        t_s=t,
        cam_from_world_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        cam_in_world=centre,
        **more,
    )


def white_jerk_track(rng, t, *, jerk, noise):
    """A random path of the model itself: true states (T, 3, axes) and the measured trajectory."""
    dt = np.diff(t)
    transition, process = constant_acceleration(dt), jerk**2 * white_jerk(dt)
    states = np.zeros((len(t), 3, 3))
    states[0] = rng.standard_normal((3, 3))
    for k in range(len(dt)):
        kick = np.linalg.cholesky(process[k]) @ rng.standard_normal((3, 3))
        states[k + 1] = transition[k] @ states[k] + kick
    return states, track(t, states[:, 0] + noise * rng.standard_normal((len(t), 3)))


def irregular_times(rng, count, mean_s):
    return np.cumsum(mean_s * rng.uniform(0.3, 1.7, count))


def random_chain(rng, count=12, n=3):
    t = irregular_times(rng, count, 0.7)
    dt = np.diff(t)
    return Chain(
        transition=constant_acceleration(dt),
        process_cov=white_jerk(dt) * 2.0,
        drive=rng.standard_normal((count - 1, n, 2)),
        observed=np.array([1.0, 0.0, 0.5]),
        measured=rng.standard_normal((count, 2)),
        measured_var=rng.uniform(0.5, 2.0, count),
        initial_information=np.diag([0.2, 0.3, 0.4]),
    )


def dense_system(chain):
    """Rows of all whitened factors over all states at once: A x = b (one column for each axis)."""
    count, n = len(chain.measured), len(chain.observed)
    rows, right = [], []
    for k in range(count):
        row = np.zeros((1, count * n))
        row[0, k * n : (k + 1) * n] = chain.observed
        rows.append(row / np.sqrt(chain.measured_var[k]))
        right.append(chain.measured[k : k + 1] / np.sqrt(chain.measured_var[k]))
    for k in range(count - 1):
        root = np.linalg.inv(np.linalg.cholesky(chain.process_cov[k]))
        row = np.zeros((n, count * n))
        row[:, (k + 1) * n : (k + 2) * n] = np.eye(n)
        row[:, k * n : (k + 1) * n] = -chain.transition[k]
        rows.append(root @ row)
        right.append(root @ chain.drive[k])
    row = np.zeros((n, count * n))
    row[:, :n] = np.sqrt(chain.initial_information)
    return np.concatenate([*rows, row]), np.concatenate([*right, np.zeros((n, chain.measured.shape[1]))])


# --- the chain


def test_chain_equals_the_dense_joint_gaussian():
    chain = random_chain(np.random.default_rng(0))
    a, b = dense_system(chain)
    cov = np.linalg.inv(a.T @ a)
    states = (cov @ (a.T @ b)).reshape(chain.states.shape)
    assert np.allclose(chain.states, states, atol=1e-10)
    blocks = cov.reshape(12, 3, 12, 3)
    assert np.allclose(chain.cov, np.stack([blocks[k, :, k] for k in range(12)]), atol=1e-10)
    assert chain.energy == pytest.approx(float(np.sum((b - a @ cov @ (a.T @ b)) ** 2)))


def test_chain_likelihood_is_that_of_the_measurements_joint_density():
    def dense(chain):
        """log p(y) by building the covariance of y itself."""
        count, n = len(chain.measured), len(chain.observed)
        a, b = dense_system(chain)
        prior, right = a[count:], b[count:]
        cov = np.linalg.inv(prior.T @ prior)
        mean = (cov @ (prior.T @ right)).reshape(count, n, -1)
        pick = np.kron(np.eye(count), chain.observed)
        spread = pick @ cov @ pick.T + np.diag(chain.measured_var)
        wrong = chain.measured - np.einsum("i,kim->km", chain.observed, mean)
        axes = chain.measured.shape[1]
        return -0.5 * float(np.sum(wrong * np.linalg.solve(spread, wrong)) + axes * np.linalg.slogdet(spread)[1])

    one = random_chain(np.random.default_rng(1))
    other = replace(one, process_cov=one.process_cov * 3.0, measured_var=one.measured_var * 0.5)
    assert other.log_likelihood - one.log_likelihood == pytest.approx(dense(other) - dense(one), abs=1e-6)


def test_chain_equals_the_rauch_tung_striebel_smoother_of_filterpy():
    from filterpy.kalman import KalmanFilter

    rng = np.random.default_rng(2)
    t = irregular_times(rng, 60, 0.1)
    dt = np.diff(t)
    noise, jerk = 0.02, 3.0
    _, measured = white_jerk_track(rng, t, jerk=jerk, noise=noise)
    chain = Chain(
        transition=constant_acceleration(dt),
        process_cov=jerk**2 * white_jerk(dt),
        drive=np.zeros((len(dt), 3, 3)),
        observed=np.array([1.0, 0.0, 0.0]),
        measured=measured.cam_in_world,
        measured_var=np.full(60, noise**2),
        initial_information=np.eye(3) * 1e-4,
    )
    for axis in range(3):
        kalman = KalmanFilter(dim_x=3, dim_z=1)
        kalman.x, kalman.P = np.zeros(3), np.eye(3) * 1e4
        kalman.H, kalman.R = np.array([[1.0, 0.0, 0.0]]), np.array([[noise**2]])
        means, covs = [], []
        for k, z in enumerate(measured.cam_in_world[:, axis]):
            if k:
                kalman.predict(F=chain.transition[k - 1], Q=chain.process_cov[k - 1])
            kalman.update(z)
            means.append(kalman.x.copy())
            covs.append(kalman.P.copy())
        # filterpy takes the matrices of the step that led to each time
        f = np.concatenate([chain.transition[:1], chain.transition])
        q = np.concatenate([chain.process_cov[:1], chain.process_cov])
        smoothed, cov, _, _ = kalman.rts_smoother(np.array(means), np.array(covs), Fs=f, Qs=q)
        assert np.allclose(chain.states[:, :, axis], smoothed, rtol=1e-5, atol=1e-6)
        assert np.allclose(chain.cov, cov, rtol=1e-4, atol=1e-8)


def test_auxiliary_residuals_ignore_their_own_datum():
    rng = np.random.default_rng(3)
    _, measured = white_jerk_track(rng, np.arange(80) * 0.1, jerk=2.0, noise=0.01)
    dt = np.full(79, 0.1)

    def chain(y, var, jump=None):
        process = 4.0 * white_jerk(dt)
        if jump is not None:
            process[jump, 0, 0] += 1e6
        return Chain(
            transition=constant_acceleration(dt),
            process_cov=process,
            drive=np.zeros((79, 3, 3)),
            observed=np.array([1.0, 0.0, 0.0]),
            measured=y,
            measured_var=var,
            initial_information=np.zeros((3, 3)),
        )

    y, var = measured.cam_in_world, np.full(80, 1e-4)
    wrong, jumped = chain(y, var).outlier_statistics()
    # leave pose 40 out: its deviation against the prediction from all others
    without = chain(y, np.where(np.arange(80) == 40, 1e10, var))
    deviation = y[40] - without.states[40, 0]
    assert wrong[40] == pytest.approx(float(np.sum(deviation**2)) / (without.cov[40, 0, 0] + 1e-4), rel=1e-4)
    # free the step from pose 40 to 41: the likelihood that this gains
    freed = chain(y, var, jump=40)
    assert jumped[40] == pytest.approx(chain(y, var).energy - freed.energy, rel=1e-3)


# --- positions alone


def test_positions_are_smoothed_with_noise_of_the_right_size_in_any_unit():
    rng = np.random.default_rng(4)
    ratios = []
    for _ in range(12):
        states, measured = white_jerk_track(rng, irregular_times(rng, 400, 1 / 30), jerk=8.0, noise=0.004)
        smooth = smooth_positions(measured)
        error = np.concatenate(
            [
                smooth.cam_in_world - states[:, 0],
                smooth.velocity_in_world - states[:, 1],
                smooth.accel_in_world - states[:, 2],
            ],
            axis=1,
        )
        ratios.append(np.mean(np.einsum("ti,ti->t", error, np.linalg.solve(smooth.cov, error[..., None])[..., 0])) / 9)
        assert np.std(smooth.cam_in_world - states[:, 0]) < 0.6 * 0.004
    # 400 poses know their noise to some per cent
    assert 0.85 < np.mean(ratios) < 1.2
    other = smooth_positions(replace(measured, cam_in_world=1e4 * measured.cam_in_world + 7.0))
    assert np.allclose(other.accel_in_world, 1e4 * smooth.accel_in_world, rtol=1e-3, atol=1e-3)
    assert np.allclose(other.cov, 1e8 * smooth.cov, rtol=1e-2)


def test_a_lone_pose_and_a_jump_of_all_later_ones_leave_the_motion_alone():
    rng = np.random.default_rng(5)
    states, measured = white_jerk_track(rng, np.arange(600) / 30, jerk=8.0, noise=0.004)
    clean = smooth_positions(measured)
    centre = measured.cam_in_world.copy()
    centre[100] += [0.2, -0.1, 0.05]
    centre[300:] += [0.05, 0.09, -0.03]
    centre[450] -= [0.0, 0.3, 0.0]
    odd = smooth_positions(replace(measured, cam_in_world=centre))
    difference = odd.accel_in_world - clean.accel_in_world
    assert np.sqrt(np.mean(difference**2)) < 0.3 * np.sqrt(np.median(clean.cov[:, 8, 8]))
    # the path follows the poses across the jump
    assert np.allclose(odd.cam_in_world[320] - clean.cam_in_world[320], [0.05, 0.09, -0.03], atol=0.003)
    assert np.allclose(odd.cam_in_world[100], states[100, 0], atol=0.02)


def test_poses_of_less_weight_are_followed_less():
    rng = np.random.default_rng(6)
    t = np.arange(300) / 30
    states, measured = white_jerk_track(rng, t, jerk=5.0, noise=0.002)
    poor = np.arange(300) % 2 == 1
    centre = measured.cam_in_world + 0.03 * rng.standard_normal((300, 3)) * poor[:, None]
    cov = np.tile(np.eye(6), (300, 1, 1)) * np.where(poor, 0.03**2, 0.002**2)[:, None, None]
    blind = smooth_positions(replace(measured, cam_in_world=centre))
    told = smooth_positions(replace(measured, cam_in_world=centre, pose_cov=cov))
    error = [np.std(s.cam_in_world - states[:, 0]) for s in (blind, told)]
    assert error[1] < 0.4 * error[0]


def test_perfect_and_still_poses_are_no_trouble():
    t = np.arange(90) / 30
    parabola = np.stack([t**2, 2 * t, np.zeros_like(t)], axis=1)
    smooth = smooth_positions(track(t, parabola))
    assert np.allclose(smooth.cam_in_world, parabola, atol=1e-6)
    assert np.allclose(smooth.accel_in_world, [2.0, 0.0, 0.0], atol=1e-4)
    still = smooth_positions(track(t, np.tile([1.0, 2.0, 3.0], (90, 1))))
    assert np.allclose(still.accel_in_world, 0.0, atol=1e-9)
    with pytest.raises(NotObservableError, match="5 poses"):
        smooth_positions(track(t[:5], parabola[:5]))


# --- with the IMU


def metric(simulated, every=1):
    truth = simulated.truth
    trajectory = simulated.trajectory.select(slice(None, None, every))
    return replace(
        trajectory, cam_in_world=trajectory.cam_in_world * truth.metres_per_unit, length_unit="m", pose_cov=None
    )


def smooth_simulated(simulated, every=1, **changes):
    truth = simulated.truth
    return smooth_trajectory(
        metric(simulated, every),
        replace(simulated.imu, **changes),
        truth.calibration,
        gravity_in_world_m_s2=truth.gravity_in_world_m_s2,
        accel_bias_m_s2=truth.accel_bias_m_s2,
    )


def errors(smooth, simulated):
    """(T, 9) position, velocity, acceleration; (T, 3) rotation."""
    truth = simulated.truth
    k, turn = truth.motion.at(smooth.t_s), truth.model_from_world_xyzw
    state = np.concatenate(
        [
            smooth.cam_in_world - truth.cam_in_model(smooth.t_s) * truth.metres_per_unit,
            smooth.velocity_in_world - quat_rotate(turn, k.velocity_in_world_m_s),
            smooth.accel_in_world - quat_rotate(turn, k.accel_in_world_m_s2),
        ],
        axis=1,
    )
    true_rotation = truth.cam_from_model_xyzw(smooth.t_s)
    return state, quat_log(quat_multiply(smooth.cam_from_world_xyzw, quat_conjugate(true_rotation)))


def normalised(error, cov):
    return float(np.mean(np.einsum("ti,ti->t", error, np.linalg.solve(cov, error[..., None])[..., 0])) / error.shape[1])


@pytest.mark.parametrize("every", [1, 6, 45], ids=["30 fps", "5 fps", "a frame in 1.5 s"])
@pytest.mark.parametrize("imu", [IDEAL_GAINS, ImuOptions()], ids=["ideal gains", "phone"])
def test_errors_are_as_large_as_stated_for_video_and_for_keyframes(every, imu):
    ratios = []
    for seed in range(6):
        simulated = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=40.0), imu=imu), seed=seed)
        smooth = smooth_simulated(simulated, every)
        error, _ = errors(smooth, simulated)
        ratios.append([normalised(error[:, i : i + 3], smooth.cov[:, i : i + 3, i : i + 3]) for i in (0, 3, 6)])
    position, velocity, acceleration = np.mean(ratios, axis=0)
    assert 0.7 < position < 1.5
    assert 0.35 < acceleration < 1.5
    # the velocity's covariance prices in gains as bad as data sheets allow
    assert 0.1 < velocity < 1.9


def test_an_acceleration_that_is_linear_between_samples_is_integrated_exactly():
    t_s = np.array([0.0, 0.3, 0.5, 1.3, 1.4, 2.6])
    start, growth = np.array([1.0, -2.0, 0.5]), np.array([3.0, 1.0, -2.0])
    inertial = WorldAcceleration.integrated(t_s, start + growth * t_s[:, None])
    at_s = np.array([0.0, 0.2, 0.5, 1.1, 2.6])[:, None]
    expected = [start * at_s**2 / 2 + growth * at_s**3 / 6, start * at_s + growth * at_s**2 / 2]
    assert np.allclose(inertial.sums(at_s[:, 0]), np.stack(expected, axis=1))


def test_each_sensor_is_read_by_its_own_time_offset(subtests):
    for sensor in ("gyro", "accel"):
        with subtests.test(sensor=sensor):
            simulated = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=8.0)), seed=3)
            smooth = smooth_simulated(simulated)
            offset, t_s = f"{sensor}_time_offset_s", f"{sensor}_t_s"
            calibration = simulated.truth.calibration
            late = replace(
                simulated,
                imu=replace(simulated.imu, **{t_s: getattr(simulated.imu, t_s) - 0.25}),
                truth=replace(
                    simulated.truth, calibration=replace(calibration, **{offset: getattr(calibration, offset) + 0.25})
                ),
            )
            again = smooth_simulated(late)
            assert np.allclose(again.cam_in_world, smooth.cam_in_world, atol=1e-6)
            assert np.allclose(again.accel_in_world, smooth.accel_in_world, atol=1e-4)


def test_the_imu_makes_keyframes_a_second_apart_into_a_path():
    simulated = simulate_recording(RecordingOptions(), seed=11)
    smooth = smooth_simulated(simulated, every=30)
    error, _ = errors(smooth, simulated)
    alone = smooth_positions(metric(simulated, 30))
    alone_error, _ = errors(alone, simulated)
    assert np.std(error[:, 3:6]) < 0.01
    assert np.std(error[:, 3:6]) < 0.1 * np.std(alone_error[:, 3:6])


def test_orientation_follows_the_gyroscope_quickly_and_the_camera_slowly():
    sfm = SfmOptions(rotation_white_rad=0.005, rotation_correlated_rad=0.003)
    simulated = simulate_recording(RecordingOptions(imu=IDEAL_GAINS, sfm=sfm), seed=12)
    truth = simulated.truth
    biased = replace(
        truth.calibration,
        gyro_bias_rad_s=truth.calibration.gyro_bias_rad_s + 0.001,
        cov=np.diag([0.0] * 5 + [0.001**2] * 3 + [0.0] * 4),
    )
    attitude = smooth_attitude(
        metric(simulated), CameraTimedImu.from_recording(simulated.imu, biased, simulated.trajectory.epoch_ns)
    )
    true = quat_multiply(quat_conjugate(truth.cam_from_model_xyzw(attitude.t_s)), truth.calibration.cam_from_imu_xyzw)
    error = quat_log(quat_multiply(attitude.world_from_imu_xyzw, quat_conjugate(true)))
    # the bias alone would make 0.06 rad; a frame alone has 0.006
    assert np.std(error) < 0.0018
    assert 0.3 < np.mean(error**2 / attitude.sigma_rad[:, None] ** 2) < 2.0
    between = attitude.t_s[:-1] + 0.013
    there = quat_multiply(quat_conjugate(truth.cam_from_model_xyzw(between)), truth.calibration.cam_from_imu_xyzw)
    error = quat_log(quat_multiply(attitude.at(between)[0], quat_conjugate(there)))
    assert np.std(error) < 0.0018


def test_pauses_of_the_imu_and_frames_without_it_are_bridged():
    simulated = simulate_recording(RecordingOptions(imu=IDEAL_GAINS), seed=13)
    imu, offset = simulated.imu, simulated.truth.calibration.gyro_time_offset_s
    pauses = []
    for t in (imu.gyro_t_s, imu.accel_t_s):
        seconds = t + offset
        pauses.append((seconds > 5) & (seconds < 50) & ~((seconds > 20) & (seconds < 21)))
    smooth = smooth_simulated(
        simulated,
        gyro_t_s=imu.gyro_t_s[pauses[0]],
        gyro_rad_s=imu.gyro_rad_s[pauses[0]],
        accel_t_s=imu.accel_t_s[pauses[1]],
        accel_m_s2=imu.accel_m_s2[pauses[1]],
    )
    error, _ = errors(smooth, simulated)
    inside = (smooth.t_s > 6) & (smooth.t_s < 49) & ~((smooth.t_s > 19) & (smooth.t_s < 22))
    assert np.std(error[inside, 3:6]) < 0.01
    # without IMU: worse, and it says so
    assert np.std(error[~inside, 3:6]) < 0.1
    assert np.median(smooth.cov[~inside, 3, 3]) > 10 * np.median(smooth.cov[inside, 3, 3])
    assert normalised(error[:, 3:6], smooth.cov[:, 3:6, 3:6]) < 2.5


def test_between_and_beyond_poses_the_imu_tells_the_velocity_and_how_well():
    ratios = []
    for seed in range(4):
        simulated = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=30.0)), seed=seed)
        truth, whole = simulated.truth, metric(simulated, 12)
        t_s = whole.t_s
        lost = ((t_s > 10) & (t_s < 12)) | ((t_s > 20) & (t_s < 21)) | (t_s > 28.5)
        kept = whole.select(np.flatnonzero(~lost))
        given = {
            "gravity_in_world_m_s2": truth.gravity_in_world_m_s2,
            "accel_bias_m_s2": truth.accel_bias_m_s2,
        }
        plain = smooth_trajectory(kept, simulated.imu, truth.calibration, **given)
        # asked for at all times: those of poses are not asked for twice, those beyond the IMU are passed over
        asked = np.append(t_s, [t_s[-1] + 1e6])
        dense = smooth_trajectory(kept, simulated.imu, truth.calibration, also_at_s=asked, **given)
        np.testing.assert_array_equal(dense.t_s, t_s)
        np.testing.assert_allclose(dense.velocity_in_world[~lost], plain.velocity_in_world, atol=2e-4)
        np.testing.assert_allclose(dense.cam_in_world[~lost], plain.cam_in_world, atol=2e-4)
        error, turned = errors(dense, simulated)
        assert np.std(error[lost, 3:6]) < 0.06 and np.abs(turned[lost]).max() < 0.01
        assert np.median(dense.cov[lost, 3, 3]) > np.median(dense.cov[~lost, 3, 3])
        ratios.append(normalised(error[lost, 3:6], dense.cov[lost, 3:6, 3:6]))
    assert 0.1 < np.mean(ratios) < 2.5


def test_a_jump_of_the_poses_does_not_move_the_camera():
    simulated = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=20.0), imu=IDEAL_GAINS), seed=14)
    scale = simulated.truth.metres_per_unit
    centre = simulated.trajectory.cam_in_world.copy()
    centre[300:] += np.array([0.06, -0.05, 0.04]) / scale
    centre[150] += np.array([0.0, 0.2, 0.0]) / scale
    moved = replace(simulated, trajectory=replace(simulated.trajectory, cam_in_world=centre))
    error, _ = errors(smooth_simulated(moved), simulated)
    assert np.abs(error[:, 3:6]).max() < 0.02
    assert np.allclose(error[420, :3] - error[200, :3], [0.06, -0.05, 0.04], atol=0.01)


def test_what_cannot_be_smoothed_is_refused():
    simulated = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=5.0)), seed=0)
    truth = simulated.truth
    gravity = truth.gravity_in_world_m_s2
    with pytest.raises(ValueError, match="metric"):
        smooth_trajectory(simulated.trajectory, simulated.imu, truth.calibration, gravity_in_world_m_s2=gravity)
    few = metric(simulated).select(slice(0, 5))
    with pytest.raises(NotObservableError, match="5 poses"):
        smooth_trajectory(few, simulated.imu, truth.calibration, gravity_in_world_m_s2=gravity)
    later = replace(simulated.imu, accel_t_s=simulated.imu.accel_t_s + 100.0)
    with pytest.raises(NotObservableError, match="none of the frame intervals"):
        smooth_trajectory(metric(simulated), later, truth.calibration, gravity_in_world_m_s2=gravity)


def test_outlier_limit_is_an_option():
    rng = np.random.default_rng(8)
    _, measured = white_jerk_track(rng, np.arange(200) / 30, jerk=8.0, noise=0.004)
    centre = measured.cam_in_world.copy()
    centre[100] += [0.1, 0.0, 0.0]
    moved = replace(measured, cam_in_world=centre)
    kept = smooth_positions(moved, SmoothOptions(outlier_chi2=1e9))
    dropped = smooth_positions(moved)
    assert kept.cam_in_world[100, 0] - dropped.cam_in_world[100, 0] > 0.02


# --- a real flight


def test_velocities_between_sparse_keyframes_of_a_drone_agree_with_motion_capture(shared_data):
    folder = shared_data / "euroc_v101"
    rows = np.array(
        [
            [float(x) for x in line.split(",")]
            for line in (folder / "gt" / "V1_01_easy.csv").read_text().splitlines()
            if not line.startswith("#")
        ]
    )
    stamps_ns = np.array(
        [int(line.split(",")[0]) for line in (folder / "gt" / "V1_01_easy.csv").read_text().splitlines()[1:]]
    )
    images = sorted(
        pycolmap.Reconstruction(str(folder / "colmap_sparse")).images.values(), key=lambda image: image.name
    )
    t_ns = np.array([int(image.name.split("/")[-1].split("_")[0]) for image in images])
    imu = read_imu(folder / "mav0" / "imu0")
    truth_s = (stamps_ns - t_ns[0]) * 1e-9
    t_s = (t_ns - t_ns[0]) * 1e-9
    cam_in_imu = np.array([-0.0216401454975, -0.064676986768, 0.00981073058949])
    imu_from_cam = np.array(
        [
            [0.0148655429818, -0.999880929698, 0.00414029679422],
            [0.999557249008, 0.0149672133247, 0.025715529948],
            [-0.0257744366974, 0.00375618835797, 0.999660727178],
        ]
    )
    true_xyzw = slerp(truth_s, rows[:, [5, 6, 7, 4]], t_s)
    at = np.searchsorted(truth_s, t_s - 1e-4)
    true_centre = rows[at, 1:4] + quat_rotate(true_xyzw, cam_in_imu)
    gyro = np.stack(
        [np.interp(t_ns, imu.epoch_ns + imu.gyro_t_s * 1e9, imu.gyro_rad_s[:, k]) for k in range(3)], axis=1
    )
    true_velocity = rows[at, 8:11] + quat_rotate(true_xyzw, np.cross(gyro - rows[at, 11:14], cam_in_imu))

    # the model, put into the metric world of the motion capture by its camera centres (Umeyama 1991)
    centre = np.array([image.projection_center() for image in images])
    x, y = centre - centre.mean(axis=0), true_centre - true_centre.mean(axis=0)
    u, singular, vt = np.linalg.svd(y.T @ x)
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation, scale = u @ np.diag(sign) @ vt, float(singular @ sign) / float(np.sum(x**2))
    model_xyzw = np.array([image.cam_from_world().rotation.quat for image in images])
    trajectory = CameraTrajectory(
        names=tuple(image.name for image in images),
        t_s=t_s,
        cam_from_world_xyzw=quat_multiply(model_xyzw, quat_conjugate(quat_from_matrix(rotation))),
        cam_in_world=scale * x @ rotation.T + true_centre.mean(axis=0),
        length_unit="m",
        epoch_ns=int(t_ns[0]),
    )
    prior = calibration_prior(Declared(readout_s=0.0, imu_in_cam_m=-imu_from_cam.T @ cam_in_imu))
    smooth = smooth_trajectory(
        trajectory,
        imu,
        align_camera_imu(trajectory, imu, prior=prior),
        gravity_in_world_m_s2=np.array([0.0, 0.0, -9.81]),
        accel_bias_m_s2=rows[:, 14:17].mean(axis=0),
    )
    error = smooth.velocity_in_world - true_velocity
    assert np.sqrt(np.mean(error**2)) < 0.015  # at 0.4 m/s; positions alone give 0.1
    assert 0.4 < normalised(error, smooth.cov[:, 3:6, 3:6]) < 2.0
    assert np.all(np.linalg.det(matrix_from_quat(smooth.cam_from_world_xyzw)) > 0.99)
