"""The simulated IMU and poses belong to the motion, and their errors have the declared statistics."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_rotate,
)
from colmap_inertial.tools.simulate import (
    IMU_PRESETS,
    ImuOptions,
    MotionOptions,
    RecordingOptions,
    SfmOptions,
    simulate_recording,
)
from colmap_inertial.tools.simulate.recipe import SceneRecipe
from colmap_inertial.tools.simulate.recording import rolling_shutter_bias_s
from colmap_inertial.tools.simulate.rests import RestOptions
from colmap_inertial.tools.simulate.sensors import draw_imu_errors
from colmap_inertial.tools.simulate.tracks import TrackOptions

NO_ERRORS = ImuOptions(
    gyro_density_rad_s_rthz=0.0,
    accel_density_m_s2_rthz=0.0,
    gyro_walk_rad_s2_rthz=0.0,
    accel_walk_m_s3_rthz=0.0,
    gyro_bias_rad_s_sd=0.0,
    accel_bias_m_s2_sd=0.0,
    gyro_scale_sd=0.0,
    gyro_misalignment_sd=0.0,
    accel_scale_sd=0.0,
    accel_misalignment_sd=0.0,
    clock_rate_sd=0.0,
)
PERFECT_SFM = SfmOptions(
    position_white_m=0.0, position_correlated_m=0.0, rotation_white_rad=0.0, rotation_correlated_rad=0.0
)
STATIC = MotionOptions(kind="static", duration_s=600.0)


def record(imu, *, seed=0, motion=None, sfm=PERFECT_SFM):
    motion = motion or MotionOptions(duration_s=30.0)
    return simulate_recording(RecordingOptions(motion=motion, imu=imu, sfm=sfm), seed=seed)


def integrate_gyro(simulated):
    """Rotation cam_start_from_cam at the last gyroscope sample, from the readings alone (midpoint rule)."""
    imu, truth = simulated.imu, simulated.truth
    rate = imu.gyro_rad_s @ matrix_from_quat(truth.calibration.cam_from_imu_xyzw).T
    steps = quat_exp(0.5 * (rate[1:] + rate[:-1]) * np.diff(imu.gyro_t_s)[:, None])
    while len(steps) > 1:  # products of neighbours, so that numpy does the work
        odd = steps[-1:] if len(steps) % 2 else steps[:0]
        steps = np.concatenate([quat_multiply(steps[: len(steps) // 2 * 2 : 2], steps[1::2]), odd])
    return steps[0]


def rotation_error_rad(simulated):
    t = simulated.truth.imu.gyro_t_cam_s
    start, end = simulated.truth.motion.world_from_cam_xyzw(t[[0, -1]])
    return quat_log(quat_multiply(quat_conjugate(quat_multiply(quat_conjugate(start), end)), integrate_gyro(simulated)))


def test_gyroscope_integrates_to_the_rotation_within_the_modelled_noise():
    assert np.linalg.norm(rotation_error_rad(record(replace(NO_ERRORS, gyro_rate_hz=800.0)))) < 2e-5
    noisy = replace(NO_ERRORS, gyro_rate_hz=400.0, gyro_density_rad_s_rthz=1e-3)
    motion = MotionOptions(duration_s=8.0)
    errors = np.array([rotation_error_rad(record(noisy, seed=s, motion=motion)) for s in range(60)])
    sigma = 1e-3 * np.sqrt(10.1)  # the IMU leads and lags by about 2.1 s in sum
    chi2 = np.sum((errors / sigma) ** 2)
    assert 0.7 < chi2 / errors.size < 1.35


def double_integral_error_m(simulated):
    """Error of the IMU's position at the end, from readings, true orientation and true start."""
    imu, truth = simulated.imu, simulated.truth
    t, lever = truth.imu.accel_t_cam_s, truth.calibration.imu_in_cam_m
    k = truth.motion.at(t)
    imu_in_world = k.cam_in_world_m + quat_rotate(k.world_from_cam_xyzw, lever)
    velocity = k.velocity_in_world_m_s[0] + quat_rotate(
        k.world_from_cam_xyzw[0], np.cross(k.rate_in_cam_rad_s[0], lever)
    )
    world_from_imu = quat_multiply(k.world_from_cam_xyzw, truth.calibration.cam_from_imu_xyzw)
    accel = quat_rotate(world_from_imu, imu.accel_m_s2) - np.array([0, 0, 9.80665])
    dt = np.diff(imu.accel_t_s)[:, None]
    v = velocity + np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (accel[1:] + accel[:-1]) * dt, axis=0)])
    # exact for acceleration that is linear between samples
    steps = v[:-1] * dt + dt**2 * (accel[:-1] / 3 + accel[1:] / 6)
    return imu_in_world[0] + steps.sum(axis=0) - imu_in_world[-1], t[-1] - t[0]


def test_accelerometer_integrates_to_the_position_within_the_modelled_noise():
    motion = MotionOptions(duration_s=6.0)
    error, _ = double_integral_error_m(record(replace(NO_ERRORS, accel_rate_hz=800.0), motion=motion))
    assert np.linalg.norm(error) < 2e-4
    noisy = replace(NO_ERRORS, accel_rate_hz=400.0, accel_density_m_s2_rthz=0.01)
    runs = [double_integral_error_m(record(noisy, seed=s, motion=motion)) for s in range(60)]
    # twice integrated white noise: variance density^2 T^3 / 3
    normalised = np.array([error / (0.01 * np.sqrt(length**3 / 3)) for error, length in runs])
    assert 0.7 < np.mean(normalised**2) < 1.35


def test_lever_arm_adds_exactly_the_centripetal_and_euler_terms():
    with_arm, without = (record(replace(NO_ERRORS, lever_arm_m_sd=arm)) for arm in ((0.1, 0.1, 0.1), (0.0, 0.0, 0.0)))
    truth = with_arm.truth
    t, h = truth.imu.accel_t_cam_s[5:-5], 1e-3

    def imu_position(at):
        k = truth.motion.at(at)
        return quat_rotate(k.world_from_cam_xyzw, truth.calibration.imu_in_cam_m)

    second_difference = (imu_position(t + h) - 2 * imu_position(t) + imu_position(t - h)) / h**2
    world_from_imu = quat_multiply(truth.motion.world_from_cam_xyzw(t), truth.calibration.cam_from_imu_xyzw)
    extra = quat_rotate(world_from_imu, (with_arm.imu.accel_m_s2 - without.imu.accel_m_s2)[5:-5])
    np.testing.assert_allclose(extra, second_difference, atol=2e-3)
    assert extra.std() > 0.1


def test_white_noise_and_bias_walk_have_the_declared_densities():
    options = replace(NO_ERRORS, gyro_density_rad_s_rthz=2e-4, accel_walk_m_s3_rthz=3e-3, accel_rate_hz=100.0)
    simulated = record(options, motion=STATIC)
    gyro = simulated.imu.gyro_rad_s
    # Allan variance of white noise: density^2 / tau
    for samples in (1, 10, 100, 1000):
        means = gyro[: len(gyro) // samples * samples].reshape(-1, samples, 3).mean(axis=1)
        allan = 0.5 * np.mean(np.diff(means, axis=0) ** 2)
        expected = 2e-4**2 / (samples / 200.0)
        assert abs(allan / expected - 1) < 5 / np.sqrt(means.size)
    increments = np.diff(simulated.imu.accel_m_s2, axis=0)
    assert abs(increments.std() / (3e-3 * np.sqrt(0.01)) - 1) < 0.01
    np.testing.assert_allclose(increments, np.diff(simulated.truth.imu.accel_bias_m_s2, axis=0), atol=1e-12)


def test_scale_misalignment_and_bias_enter_as_documented():
    options = replace(
        NO_ERRORS, gyro_scale_sd=0.02, gyro_misalignment_sd=0.01, gyro_bias_rad_s_sd=0.02, accel_bias_m_s2_sd=0.3
    )
    clean, wrong = record(NO_ERRORS), record(options)
    design = np.column_stack([clean.imu.gyro_rad_s, np.ones(len(clean.imu.gyro_t_s))])
    fit = np.linalg.lstsq(design, wrong.imu.gyro_rad_s, rcond=None)[0]
    errors = wrong.truth.imu.errors
    np.testing.assert_allclose(fit[:3].T, np.eye(3) + errors.gyro_matrix, atol=1e-9)
    np.testing.assert_allclose(fit[3], errors.gyro_bias_rad_s, atol=1e-9)
    np.testing.assert_allclose(wrong.truth.calibration.gyro_bias_rad_s, errors.gyro_bias_rad_s, atol=1e-12)
    difference = (wrong.imu.accel_m_s2 - clean.imu.accel_m_s2).mean(axis=0)
    np.testing.assert_allclose(difference, errors.accel_bias_m_s2, atol=1e-9)


def test_stamps_follow_the_clock_offset_its_rate_and_the_accelerometers_delay():
    options = replace(NO_ERRORS, clock_rate_sd=0.01, accel_delay_s=(-0.01, 0.002), clock_offset_s=(300.0, 400.0))
    simulated = record(options, seed=3)
    truth, imu = simulated.truth, simulated.imu
    calibration, rate = truth.calibration, 1 + truth.imu.errors.clock_rate
    assert 300 <= calibration.gyro_time_offset_s <= 400
    assert abs(calibration.accel_time_offset_s - calibration.gyro_time_offset_s + 0.01) < 0.01
    at_middle = np.interp(15.0, truth.imu.gyro_t_cam_s, imu.gyro_t_s)
    np.testing.assert_allclose(at_middle + calibration.gyro_time_offset_s, 15.0, atol=1e-9)
    np.testing.assert_allclose(np.diff(imu.gyro_t_s), 1 / 200, atol=1e-9)
    np.testing.assert_allclose(np.diff(truth.imu.gyro_t_cam_s), 1 / 200 / rate, atol=1e-9)
    assert truth.imu.gyro_t_cam_s[0] < 0 and truth.imu.gyro_t_cam_s[-1] > 30
    assert not np.any(np.isin(imu.gyro_t_s, imu.accel_t_s))


def test_devices_differ_by_the_declared_standard_deviations():
    """The scatter of 600 devices, each parameter by a standard deviation of its own."""
    options = ImuOptions(
        gyro_bias_rad_s_sd=0.01,
        accel_bias_m_s2_sd=0.02,
        gyro_scale_sd=0.03,
        gyro_misalignment_sd=0.04,
        accel_scale_sd=0.05,
        accel_misalignment_sd=0.06,
        mounting_rad_sd=0.07,
        lever_arm_m_sd=(0.08, 0.09, 0.1),
        accel_delay_s=(0.3, 0.12),
        clock_rate_sd=0.13,
        clock_offset_s=(5.0, 7.0),
    )
    rng = np.random.default_rng(0)
    devices = [draw_imu_errors(options, 10.0, rng) for _ in range(600)]

    def drawn(of):
        return np.array([of(one) for one in devices])

    diagonal = np.eye(3, dtype=bool)
    nominal = quat_conjugate(np.array(options.cam_from_imu_xyzw))
    delay_s = drawn(lambda one: one.accel_time_offset_s - one.gyro_time_offset_s)
    for values, sd in (
        (drawn(lambda one: one.gyro_bias_rad_s), 0.01),
        (drawn(lambda one: one.accel_bias_m_s2), 0.02),
        (drawn(lambda one: one.gyro_matrix[diagonal]), 0.03),
        (drawn(lambda one: one.gyro_matrix[~diagonal]), 0.04),
        (drawn(lambda one: one.accel_matrix[diagonal]), 0.05),
        (drawn(lambda one: one.accel_matrix[~diagonal]), 0.06),
        (drawn(lambda one: quat_log(quat_multiply(one.cam_from_imu_xyzw, nominal))), 0.07),
        (drawn(lambda one: one.imu_in_cam_m), np.array([0.08, 0.09, 0.1])),
        (delay_s - 0.3, 0.12),
        (drawn(lambda one: one.clock_rate), 0.13),
    ):
        assert values.std(axis=0) / sd == pytest.approx(np.ones(values.shape[1:]), rel=0.15)
        assert np.abs(values.mean(axis=0) / sd).max() < 0.16
    offset_s = drawn(lambda one: one.gyro_time_offset_s)
    assert 5 <= offset_s.min() < 5.05 and 6.95 < offset_s.max() <= 7
    assert {one.middle_s for one in devices} == {5.0}


def test_what_cannot_be_simulated_is_refused(subtests):
    for kind, values, said in (
        (MotionOptions, {"duration_s": 0.0}, "duration_s"),
        (MotionOptions, {"radius_m": -1.0}, "radius_m"),
        (MotionOptions, {"sweep_s": 0.0}, "sweep_s"),
        (MotionOptions, {"vigour": -0.1}, "vigour"),
        (SceneRecipe, {"frame_rate_hz": 0.0}, "frame_rate_hz"),
        (SceneRecipe, {"quality": 101}, "quality"),
        (SceneRecipe, {"quality": -1}, "quality"),
        (SceneRecipe, {"crf": 52}, "crf"),
        (SceneRecipe, {"crf": -1}, "crf"),
        (RestOptions, {"attitudes": 0}, "attitudes"),
        (RestOptions, {"attitudes": 16}, "from 1 to 15"),
        (TrackOptions, {"frame_rate_hz": 0.0}, "frame_rate_hz"),
        (TrackOptions, {"points_per_m": 0.0}, "points_per_m"),
        (TrackOptions, {"life_s": 0.0}, "life_s"),
        (SfmOptions, {"frame_rate_hz": 0.0}, "frame_rate_hz"),
        (SfmOptions, {"correlation_s": 0.0}, "correlation_s"),
        (SfmOptions, {"metres_per_unit": (0.0, 1.0)}, "metres_per_unit"),
        (ImuOptions, {"gyro_rate_hz": 0.0}, "rates"),
        (ImuOptions, {"accel_rate_hz": 0.0}, "rates"),
        (ImuOptions, {"lead_s": (2.0, 1.0)}, "lead_s"),
        (ImuOptions, {"lead_s": (-3.0, 1.0)}, "lead_s"),
        (ImuOptions, {"lead_s": (0.0, 3.0)}, "lead_s"),
        (ImuOptions, {"gyro_bias_rad_s_sd": -0.1}, "negative"),
        (ImuOptions, {"accel_density_m_s2_rthz": -0.1}, "negative"),
    ):
        with subtests.test(kind=kind.__name__, values=values, said=said), pytest.raises(ValueError, match=said):
            kind(**values)


def test_the_ends_of_what_can_be_simulated_are_allowed():
    for quality, crf in ((0, 0), (100, 51)):
        assert SceneRecipe(quality=quality, crf=crf).quality == quality
    assert RestOptions(attitudes=1).attitudes == 1 and RestOptions(attitudes=15).attitudes == 15
    assert MotionOptions(vigour=0.0).vigour == 0
    assert ImuOptions(lead_s=(-2.9, 2.9), gyro_bias_rad_s_sd=0.0).lead_s == (-2.9, 2.9)
    assert ImuOptions(lead_s=(1.0, 1.0)).lead_s == (1.0, 1.0)


def test_saturation_and_quantisation():
    simulated = record(replace(NO_ERRORS, gyro_range_rad_s=0.5, accel_resolution_m_s2=0.125))
    assert np.abs(simulated.imu.gyro_rad_s).max() == 0.5
    steps = simulated.imu.accel_m_s2 / 0.125
    np.testing.assert_array_equal(steps, np.round(steps))


def test_presets_measure_gravity_at_rest(subtests):
    for preset in sorted(IMU_PRESETS):
        with subtests.test(preset=preset):
            simulated = record(IMU_PRESETS[preset], motion=STATIC)
            magnitude = np.linalg.norm(simulated.imu.accel_m_s2.mean(axis=0))
            assert abs(magnitude - 9.8) < 1.0


def test_perfect_poses_are_the_truth_in_the_model_frame():
    simulated = record(NO_ERRORS)
    trajectory, truth = simulated.trajectory, simulated.truth
    np.testing.assert_allclose(trajectory.cam_in_world, truth.cam_in_model(trajectory.t_s), atol=1e-9)
    np.testing.assert_allclose(
        quat_log(
            quat_multiply(quat_conjugate(trajectory.cam_from_world_xyzw), truth.cam_from_model_xyzw(trajectory.t_s))
        ),
        0,
        atol=1e-9,
    )
    step_m = np.diff(truth.motion.cam_in_world_m(trajectory.t_s), axis=0)
    ratio = np.linalg.norm(step_m, axis=1) / np.linalg.norm(np.diff(trajectory.cam_in_world, axis=0), axis=1)
    np.testing.assert_allclose(ratio, truth.metres_per_unit, rtol=1e-6)
    # at rest the accelerometer would read minus gravity
    up = -quat_rotate(quat_conjugate(truth.model_from_world_xyzw), truth.gravity_in_world_m_s2)
    np.testing.assert_allclose(up, [0, 0, 9.80665], atol=1e-9)


def test_pose_noise_and_drift_have_the_declared_sizes():
    sfm = SfmOptions(frame_rate_hz=10.0, position_white_m=0.004, position_correlated_m=0.003, rotation_white_rad=0.002)
    simulated = record(NO_ERRORS, motion=STATIC, sfm=sfm)
    residual = simulated.truth.metres_per_unit * (
        simulated.trajectory.cam_in_world - simulated.truth.cam_in_model(simulated.trajectory.t_s)
    )
    assert abs(residual.std() / 0.005 - 1) < 0.05
    lagged = np.mean(residual[1:] * residual[:-1])
    assert abs(lagged / (0.003**2 * np.exp(-0.1 / 0.35)) - 1) < 0.25
    drifting = replace(PERFECT_SFM, position_drift_m_rts=0.01, rotation_drift_rad_rts=0.001, frame_rate_hz=5.0)
    motion = MotionOptions(kind="static", duration_s=25.0)
    ends = []
    for seed in range(100):
        run = record(NO_ERRORS, seed=seed, motion=motion, sfm=drifting)
        t = run.trajectory.t_s
        moved = run.trajectory.cam_in_world - run.truth.cam_in_model(t)
        ends.append(run.truth.metres_per_unit * (moved[-1] - moved[0]) / (0.01 * np.sqrt(t[-1])))
    assert 0.75 < np.mean(np.square(ends)) < 1.3


def test_rolling_shutter_bias_is_what_a_global_shutter_fit_to_moved_points_gives():
    from scipy.optimize import least_squares

    readout_s, depth = 0.02, (0.5, 3.0)
    bias_s = rolling_shutter_bias_s(readout_s, depth, np.random.default_rng(5))
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-0.65, 0.65, 300), rng.uniform(-0.5, 0.5, 300)
    points = np.stack([x, y, np.ones(300)], axis=1) * rng.uniform(*depth, 300)[:, None]
    twist = np.array([0.4, -0.3, 0.5, 0.2, 0.3, -0.1])

    def image(motion):  # (n, 6) or (6,) camera displacement, rotation then translation
        moved = quat_rotate(quat_conjugate(quat_exp(motion[..., :3])), points - motion[..., 3:])
        return moved[:, :2] / moved[:, 2:]

    seen = image(readout_s * y[:, None] * twist)
    fit = least_squares(lambda pose: (image(pose) - seen).ravel(), np.zeros(6)).x
    np.testing.assert_allclose(fit, bias_s @ twist, atol=0.05 * np.abs(fit).max())
    assert np.all(rolling_shutter_bias_s(0.0, depth, rng) == 0)


def test_same_seed_same_recording_and_the_parts_draw_independently():
    a, b, c = simulate_recording(seed=7), simulate_recording(seed=7), simulate_recording(seed=8)
    np.testing.assert_array_equal(a.imu.accel_m_s2, b.imu.accel_m_s2)
    np.testing.assert_array_equal(a.trajectory.cam_in_world, b.trajectory.cam_in_world)
    assert a.truth.metres_per_unit != c.truth.metres_per_unit
    d = simulate_recording(RecordingOptions(imu=IMU_PRESETS["tablet"], sfm=PERFECT_SFM), seed=7)
    np.testing.assert_array_equal(a.truth.motion.cam_in_world_m([1.0]), d.truth.motion.cam_in_world_m([1.0]))
