"""Alignment finds what is true on simulated and real recordings, says how well, and refuses what does not belong."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.camera_clock import CameraTimedImu, epoch_shift_s
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_cumulative,
    quat_exp,
    quat_from_matrix,
    quat_log,
    quat_multiply,
    quat_normalize,
)
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraTrajectory, ImuRecording
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.trajectories import read_inertial_scale
from colmap_inertial.motion.align import AlignOptions, _fit as fit, _search, align_camera_imu, align_clocks
from colmap_inertial.motion.align._clock_search import ClockFit
from colmap_inertial.tools.simulate import ImuOptions, MotionOptions, RecordingOptions, SfmOptions, simulate_recording

RECORDINGS = ("D1", "D3", "D5", "D7", "D9", "D11", "D13", "D15")
#: Errors as wide as the estimator states them: gain 1 %, axes 0.5 %.
STATED = ImuOptions(gyro_scale_sd=0.01, gyro_misalignment_sd=0.005, clock_rate_sd=1e-4)


@pytest.fixture(scope="module")
def recordings(shared_data):
    return {name: read_inertial_scale(shared_data / "inertial_scale" / name) for name in RECORDINGS}


def read_euroc(folder):
    """Poses of the sparse model, stamped by the pictures' names, and the IMU."""
    poses = sorted(
        (int(image.name.split("/")[-1].split("_")[0]), image)
        for image in pycolmap.Reconstruction(str(folder / "colmap_sparse")).images.values()
    )
    t_ns = np.array([stamp for stamp, _ in poses], dtype=np.int64)
    trajectory = CameraTrajectory(
        names=tuple(image.name for _, image in poses),
        t_s=(t_ns - t_ns[0]) * 1e-9,
        cam_from_world_xyzw=np.array([image.cam_from_world().rotation.quat for _, image in poses]),
        cam_in_world=np.array([image.projection_center() for _, image in poses]),
        epoch_ns=int(t_ns[0]),
    )
    return trajectory, read_imu(folder / "mav0" / "imu0")


def window(trajectory, begin_s, length_s):
    return trajectory.select((trajectory.t_s >= begin_s) & (trajectory.t_s < begin_s + length_s))


def errors_in_sigmas(calibration, truth):
    """(7,) errors of rotation, gyroscope offset and gyroscope bias over their stated standard deviations."""
    rotation = quat_log(quat_multiply(truth.cam_from_imu_xyzw, quat_conjugate(calibration.cam_from_imu_xyzw)))
    offset = truth.gyro_time_offset_s - calibration.gyro_time_offset_s
    bias = truth.gyro_bias_rad_s - calibration.gyro_bias_rad_s
    sigma = np.sqrt(np.diag(calibration.cov))[[0, 1, 2, 3, 5, 6, 7]]
    return np.concatenate([rotation, [offset], bias]) / sigma


def slow_turns(axes, *, duration_s=40.0, rate_hz=30.0, seed=0, period_s=None):
    """Trajectory and IMU that turn about the given axes only, without noise, 123 s apart; identity rotation."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, duration_s, 1 / 400)
    if period_s is None:
        waves = [(rng.uniform(0.2, 2, 8), rng.uniform(0, 2 * np.pi, 8)) for _ in axes]
        rates = [np.sum(np.sin(2 * np.pi * np.outer(t, f) + p), axis=1) * 0.15 for f, p in waves]
    else:
        rates = [0.5 * np.sin(2 * np.pi * t / period_s + 0.3 * axis) for axis in axes]
    rate = np.zeros((len(t), 3))
    rate[:, axes] = np.stack(rates, axis=1)
    path = GyroPath(t, rate, np.zeros(3))
    frames = np.arange(2.0, duration_s - 2.0, 1 / rate_hz)
    trajectory = CameraTrajectory(
        names=tuple(map(str, range(len(frames)))),
        t_s=frames + 123.0,
        cam_from_world_xyzw=quat_normalize(quat_conjugate(path.at(frames)[0])),
        cam_in_world=np.zeros((len(frames), 3)),
    )
    force = np.zeros_like(rate)
    return trajectory, ImuRecording(gyro_t_s=t, gyro_rad_s=rate, accel_t_s=t, accel_m_s2=force)


# --- the gyroscope's path


def test_gyro_path_follows_a_coning_motion_known_in_closed_form():
    # A body that cones with half-angle a at rate w: q(t) = Rz(wt) Rx(a) Rz(-wt) (Bortz 1971)
    a, w = 0.3, 2.0
    t = np.arange(0, 5, 1 / 400)

    def attitude(t):
        about_z = np.stack([0 * t, 0 * t, w * t], axis=1)
        tilt = np.broadcast_to(quat_exp(np.array([a, 0.0, 0.0])), (len(t), 4))
        return quat_multiply(quat_multiply(quat_exp(about_z), tilt), quat_exp(-about_z))

    rate = w * np.stack([-np.sin(a) * np.sin(w * t), np.sin(a) * np.cos(w * t), np.full_like(t, np.cos(a) - 1)], axis=1)
    bias = np.array([0.02, -0.01, 0.03])
    path = GyroPath(t, rate + bias, bias)
    query = np.linspace(0.01, 4.9, 333)
    expected = quat_multiply(quat_conjugate(attitude(t[:1])), attitude(query))
    error = quat_log(quat_multiply(quat_conjugate(expected), path.at(query)[0]))
    assert np.abs(error).max() < 2e-5


def test_gyro_path_integrates_a_linear_rate_to_the_fourth_order():
    first, last = np.array([1.5, -0.4, 0.8]), np.array([-1.0, 2.0, 0.3])

    def turn(steps):
        t = np.linspace(0, 1, steps + 1)
        return GyroPath(t, first + t[:, None] * (last - first), np.zeros(3)).at(np.ones(1))[0][0]

    # a hundred thousand steps of a constant rate each
    middle = (np.arange(100_000) + 0.5) / 100_000
    truth = quat_cumulative(quat_exp((first + middle[:, None] * (last - first)) / 100_000))[-1]
    coarse, fine = (np.linalg.norm(quat_log(quat_multiply(quat_conjugate(truth), turn(n)))) for n in (10, 20))
    assert coarse < 1e-5
    assert coarse / fine == pytest.approx(16, rel=0.1)


def test_gyro_path_knows_how_a_bias_turns_an_interval():
    rng = np.random.default_rng(3)
    t = np.arange(0, 6, 1 / 200)
    rate = np.stack([np.sin(2 * t + k) for k in range(3)], axis=1)
    ends = np.array([1.003, 4.567])
    base, change = GyroPath(t, rate, np.zeros(3)), 1e-5 * rng.standard_normal(3)
    moved = GyroPath(t, rate, change)

    def turn(path):
        q = path.at(ends)[0]
        return quat_multiply(quat_conjugate(q[0]), q[1])

    actual = quat_log(quat_multiply(quat_conjugate(turn(base)), turn(moved)))
    lever = base.at_with_levers(ends)[2]
    predicted = -matrix_from_quat(quat_conjugate(base.at(ends)[0][1])) @ (lever[1] - lever[0]) @ change
    assert np.allclose(actual, predicted, rtol=1e-3, atol=1e-10)


def test_a_steady_turn_is_rate_times_time():
    t, rate = np.arange(0, 2, 0.01), np.array([0.3, -0.5, 0.2])
    path = GyroPath(t, np.tile(rate + 0.1, (len(t), 1)), np.full(3, 0.1))
    begin_s, end_s = np.array([0.203, 1.0]), np.array([0.907, 1.5])
    assert np.allclose(path.turn_rad(begin_s, end_s), (end_s - begin_s)[:, None] * rate)


def test_gyro_path_knows_its_gaps_and_ends():
    t = np.concatenate([np.arange(0, 2, 0.01), np.arange(3, 5, 0.01)])
    path = GyroPath(t, np.zeros((len(t), 3)), np.zeros(3))
    begin, end = np.array([0.5, 1.5, 2.2, 3.5, -0.1, 4.5]), np.array([1.5, 3.5, 2.5, 4.5, 1.0, 5.5])
    assert path.covers(begin, end).tolist() == [True, False, False, True, False, False]


# --- the fit


def test_derivatives_of_the_residuals_are_those_of_finite_differences():
    t = np.arange(0, 12, 1 / 400)
    rate = np.stack([np.sin((1.1 + 0.4 * k) * t + k) for k in range(3)], axis=1)
    path, offset_s, clock_rate = GyroPath(t, rate, np.zeros(3)), 0.7, 2e-3
    cam_from_imu = quat_exp(np.array([0.5, -1.0, 0.3]))
    t_cam_s = np.linspace(2, 11, 60)
    middle_s = 6.0
    stamps_s = t_cam_s - offset_s - clock_rate * (t_cam_s - middle_s)
    trajectory = CameraTrajectory(
        names=tuple(f"{k}" for k in range(60)),
        t_s=t_cam_s,
        cam_from_world_xyzw=quat_multiply(cam_from_imu, quat_conjugate(path.at(stamps_s)[0])),
        cam_in_world=np.zeros((60, 3)),
    )
    nuisance = np.zeros(fit._N_NUISANCE)
    nuisance[fit._RATE] = clock_rate
    state = fit._State(cam_from_imu, offset_s, np.zeros(3), nuisance)

    def residuals(step):
        moved = state.moved(step)
        return fit._compare_rotations(trajectory, path, moved, moved.bias, middle_s)

    count = fit._N + fit._N_NUISANCE
    residual, jacobian, _ = residuals(np.zeros(count))
    assert len(residual) == 59 and np.abs(residual).max() < 1e-7
    for column in range(count):
        step = np.zeros(count)
        step[column] = 1e-5
        difference = (residuals(step)[0] - residuals(-step)[0]) / 2e-5
        scale = np.abs(difference).max()
        assert scale > 0.01
        np.testing.assert_allclose(jacobian[:, :, column], difference, atol=2e-3 * scale, err_msg=f"column {column}")


# --- simulation: what is true is found


def test_errors_are_as_large_as_stated_over_simulated_recordings():
    z = []
    for seed in range(40):
        readout_s = abs(np.random.default_rng(seed).normal(0, 0.02))
        options = RecordingOptions(
            motion=MotionOptions(duration_s=15.0), imu=STATED, sfm=SfmOptions(readout_s=readout_s)
        )
        simulated = simulate_recording(options, seed=seed)
        z.append(errors_in_sigmas(align_camera_imu(simulated.trajectory, simulated.imu), simulated.truth.calibration))
    inside = np.mean(np.abs(z) < 1.96, axis=0)
    assert inside.min() > 0.86  # 95 % less two and a half standard deviations
    assert np.sqrt(np.mean(np.square(z))) > 0.3  # and not by stating the moon


def test_covariance_is_exact_where_the_noise_is_white_and_the_rest_is_known():
    perfect = replace(
        ImuOptions(),
        gyro_scale_sd=0.0,
        gyro_misalignment_sd=0.0,
        gyro_walk_rad_s2_rthz=0.0,
        clock_rate_sd=0.0,
    )
    options = RecordingOptions(
        motion=MotionOptions(duration_s=20.0), imu=perfect, sfm=SfmOptions(rotation_correlated_rad=0.0)
    )
    z = []
    for seed in range(30):
        simulated = simulate_recording(options, seed=seed)
        prior = calibration_prior(Declared(readout_s=0.0))
        calibration = align_camera_imu(simulated.trajectory, simulated.imu, prior=prior)
        z.append(errors_in_sigmas(calibration, simulated.truth.calibration)[3:])
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.all(rms < 1.35)
    assert np.all(rms[1:] > 0.4)


@pytest.mark.parametrize("every", [1, 7, 45], ids=["30 fps", "4 fps", "a frame in 1.5 s"])
def test_clocks_hundreds_of_seconds_apart_are_found_for_video_and_for_keyframes(every):
    for seed in range(4):
        options = RecordingOptions(imu=replace(STATED, clock_offset_s=(-900.0, 900.0), cam_from_imu_xyzw=None))
        simulated = simulate_recording(options, seed=seed)
        trajectory = simulated.trajectory.select(slice(None, None, every))
        calibration = align_camera_imu(trajectory, simulated.imu)
        assert np.abs(errors_in_sigmas(calibration, simulated.truth.calibration)).max() < 4.5
        truth = simulated.truth.calibration
        assert abs(calibration.gyro_time_offset_s - truth.gyro_time_offset_s) < 0.004


def test_the_imu_may_start_late_or_end_early(subtests):
    for first, last in ((0.0, 35.0), (25.0, 70.0), (20.0, 40.0)):
        with subtests.test(first=first, last=last):
            simulated = simulate_recording(RecordingOptions(imu=STATED), seed=5)
            imu = simulated.imu
            elapsed = imu.gyro_t_s - imu.gyro_t_s[0]
            keep = (elapsed >= first) & (elapsed <= last)
            part = replace(imu, gyro_t_s=imu.gyro_t_s[keep], gyro_rad_s=imu.gyro_rad_s[keep])
            calibration = align_camera_imu(simulated.trajectory, part)
            assert abs(calibration.gyro_time_offset_s - simulated.truth.calibration.gyro_time_offset_s) < 0.004


def test_the_offset_of_drifting_clocks_holds_in_the_middle_of_what_both_recorded():
    simulated = simulate_recording(RecordingOptions(imu=STATED), seed=5)
    trajectory, imu = simulated.trajectory, simulated.imu
    keep = (imu.gyro_t_s > imu.gyro_t_s[0] + 12) & (imu.gyro_t_s < imu.gyro_t_s[-1] - 4)
    part = replace(imu, gyro_t_s=imu.gyro_t_s[keep], gyro_rad_s=imu.gyro_rad_s[keep])
    found = align_clocks(trajectory, part).calibration
    covered_s = part.gyro_t_s + simulated.truth.calibration.gyro_time_offset_s + epoch_shift_s(imu, trajectory.epoch_ns)
    both = (trajectory.t_s > covered_s[0]) & (trajectory.t_s < covered_s[-1])
    assert not both.all()
    shared_s = trajectory.t_s[both]
    assert found.clock_middle_s == pytest.approx(0.5 * (shared_s[0] + shared_s[-1]), abs=0.1)


def test_variances_are_widened_to_those_of_errors_that_are_not_white():
    # a mean of errors that go together over some twenty intervals, and seem to be white
    rng, count, correlation = np.random.default_rng(4), 1200, 0.9
    true, stated = [], []
    for _ in range(60):
        error = np.zeros(count)
        for k, fresh in enumerate(np.sqrt(1 - correlation**2) * rng.standard_normal(count)):
            error[k] = correlation * error[k - 1] + fresh
        residual, jacobian = np.repeat(error[:, None], 3, axis=1), np.tile(np.eye(3), (count, 1, 1))
        residual = residual - residual.mean(axis=0)
        cov = fit._widen_for_correlation(np.eye(3) / count, residual, jacobian, np.ones(count))
        assert np.allclose(cov, cov.T)
        true.append(error.mean() ** 2)
        stated.append(cov[0, 0])
    assert np.mean(stated) == pytest.approx(np.mean(true), rel=0.5)
    assert np.mean(stated) > 8 / count
    white = rng.standard_normal((count, 3))
    cov = fit._widen_for_correlation(np.eye(3) / count, 0.1 * white, jacobian, np.ones(count))
    assert cov == pytest.approx(np.eye(3) / count)


def test_the_offset_is_between_raw_stamps_whatever_the_epochs():
    simulated = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=15.0)), seed=2)
    there = replace(simulated.trajectory, epoch_ns=1_700_000_000_000_000_000)
    calibration = align_camera_imu(there, simulated.imu)
    here = align_camera_imu(simulated.trajectory, simulated.imu)
    # 1.7e9 s leave 2.4e-7 s to a double
    assert calibration.gyro_time_offset_s - here.gyro_time_offset_s == pytest.approx(1.7e9, abs=1e-6)
    assert epoch_shift_s(simulated.imu, there.epoch_ns) == -1.7e9


def test_clocks_that_run_at_different_rates_are_followed(subtests):
    for rate in (-0.01, 0.002, 0.01):
        with subtests.test(rate=rate):
            simulated = simulate_recording(RecordingOptions(imu=replace(STATED, clock_rate_sd=0.0)), seed=3)
            imu = simulated.imu
            drifting = replace(imu, gyro_t_s=imu.gyro_t_s * (1 + rate), accel_t_s=imu.accel_t_s * (1 + rate))
            alignment = align_clocks(simulated.trajectory, drifting)
            assert alignment.calibration.clock_rate == pytest.approx(
                -rate, abs=max(3 * alignment.clock_rate_sigma, 2e-5)
            )
            steady = CameraTimedImu.from_recording(drifting, alignment.calibration, simulated.trajectory.epoch_ns)
            # the true time of each sample on the camera's clock
            true_s = imu.gyro_t_s + simulated.truth.calibration.gyro_time_offset_s
            assert np.abs(steady.gyro_t_s - true_s).max() < 0.004
            assert steady.imu.repairs[-1] == Fact("imu-clock-stretched", clock_rate=alignment.calibration.clock_rate)
            assert alignment.drifts() and alignment.settle_clock_rate() is alignment.calibration


def test_a_clock_rate_that_is_small_or_in_doubt_is_not_corrected():
    simulated = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=15.0)), seed=2)
    alignment = align_clocks(simulated.trajectory, simulated.imu)
    for rate, sigma, certain in ((4e-4, 7e-5, True), (-4e-4, 7e-5, True), (4e-4, 9e-5, False), (2e-4, 1e-6, False)):
        with_rate = replace(
            alignment, calibration=replace(alignment.calibration, clock_rate=rate), clock_rate_sigma=sigma
        )
        assert with_rate.drifts() == certain
        assert with_rate.settle_clock_rate().clock_rate == (rate if certain else 0.0)
        assert with_rate.settle_clock_rate().clock_middle_s == alignment.calibration.clock_middle_s
    steady = replace(alignment.calibration, clock_rate=0.0)
    assert CameraTimedImu.from_recording(simulated.imu, steady, 0).imu is simulated.imu


def test_jumps_of_the_poses_are_outvoted():
    simulated = simulate_recording(RecordingOptions(imu=STATED), seed=8)
    rng = np.random.default_rng(0)
    jump = np.zeros((len(simulated.trajectory), 3))
    jump[rng.choice(len(jump), 12, replace=False)] = 0.2 * rng.standard_normal((12, 3))
    turned = quat_multiply(simulated.trajectory.cam_from_world_xyzw, quat_exp(np.cumsum(jump, axis=0)))
    calibration = align_camera_imu(replace(simulated.trajectory, cam_from_world_xyzw=turned), simulated.imu)
    assert np.abs(errors_in_sigmas(calibration, simulated.truth.calibration)).max() < 4.0


def test_five_poses_are_compared_and_four_are_too_few():
    simulated = simulate_recording(RecordingOptions(imu=STATED), seed=8)
    with pytest.raises(NotObservableError, match="4 poses are too few"):
        align_camera_imu(simulated.trajectory.select(np.arange(4)), simulated.imu)
    with pytest.raises(NotObservableError) as refused:
        align_camera_imu(simulated.trajectory.select(np.arange(5)), simulated.imu)
    assert "poses are too few" not in str(refused.value)


# --- priors and ranges


def test_what_the_rotations_do_not_tell_comes_from_the_prior():
    simulated = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=15.0), imu=STATED), seed=1)
    prior = calibration_prior(Declared(imu_in_cam_m=[0.03, -0.01, 0.0], readout_s=0.018))
    calibration = align_camera_imu(simulated.trajectory, simulated.imu, prior=prior)
    assert np.allclose(calibration.imu_in_cam_m, [0.03, -0.01, 0.0])
    assert calibration.readout_s == 0.018
    assert calibration.sigma("readout_s") == pytest.approx(prior.sigma("readout_s"))
    # the accelerometer's offset follows the gyroscope's, and is known as well as their difference
    assert calibration.accel_time_offset_s == pytest.approx(calibration.gyro_time_offset_s)
    assert calibration.sigma("accel_time_offset_s") == pytest.approx(0.02, rel=0.15)


def test_a_known_offset_is_between_raw_stamps_whatever_the_epochs():
    simulated = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=15.0)), seed=2)
    there = replace(simulated.trajectory, epoch_ns=simulated.trajectory.epoch_ns + 1_000_000_000_000)
    known_s = simulated.truth.calibration.gyro_time_offset_s + 1000 + 0.002
    for sigma_s, pulled_s in ((1e-5, 0.0), (0.5, -0.002)):
        prior = calibration_prior(Declared(gyro_time_offset_s=known_s, time_offset_sigma_s=sigma_s))
        calibration = align_camera_imu(there, simulated.imu, prior=prior)
        assert calibration.gyro_time_offset_s - known_s == pytest.approx(pulled_s, abs=1e-3)


def test_a_known_rotation_aligns_what_turns_about_one_axis_only():
    trajectory, imu = slow_turns([1])
    with pytest.raises(NotObservableError, match="two axes") as caught:
        align_camera_imu(trajectory, imu)
    assert caught.value.quantity == "camera-IMU rotation"
    prior = calibration_prior(Declared(cam_from_imu_xyzw=[0, 0, 0, 1], rotation_sigma_rad=0.01))
    calibration = align_camera_imu(trajectory, imu, prior=prior)
    assert calibration.gyro_time_offset_s == pytest.approx(123.0, abs=0.005)
    assert calibration.sigma("rotation_y_rad") == pytest.approx(0.01, rel=0.1)


def test_a_shared_clock_excludes_other_offsets():
    trajectory, imu = slow_turns([0, 1, 2])
    assert align_camera_imu(trajectory, imu).gyro_time_offset_s == pytest.approx(123.0, abs=0.005)
    for narrow in (
        {"options": AlignOptions(max_offset_s=1.0)},
        {"prior": calibration_prior(shared_clock=True)},
    ):
        with pytest.raises(NotObservableError, match="do not overlap"):
            align_camera_imu(trajectory, imu, **narrow)
    inside = replace(trajectory, t_s=trajectory.t_s - 122.4)
    found = align_camera_imu(inside, imu, options=AlignOptions(max_offset_s=1.0))
    assert found.gyro_time_offset_s == pytest.approx(0.6, abs=0.005)
    wrong = replace(trajectory, t_s=trajectory.t_s - 110.0)
    with pytest.raises(NotObservableError):
        align_camera_imu(wrong, imu, options=AlignOptions(max_offset_s=1.0))


def test_what_is_known_of_an_offset_counts_beside_the_rotations(subtests):
    trajectory, imu = slow_turns([0, 1, 2])
    # a delay of 50 ms against one of 0.7 s that fits a little better, and against one that fits far better
    for likelier, known, offset_s, lead in (
        (32.0, False, 0.7, 2.0),
        (32.0, True, 0.05, 30 - 0.5 * 0.5**2 - (32 - 12)),
        (300.0, True, 0.7, 300 - 12 - (30 - 0.5 * 0.5**2)),
    ):
        with subtests.test(likelier=likelier, known=known):
            prior = calibration_prior(shared_clock=True) if known else calibration_prior()
            # both recordings begin at their epochs
            search = _search(replace(trajectory, t_s=trajectory.t_s - 123), imu, prior, AlignOptions())
            fits = [
                ClockFit(
                    offset_s=at_s,
                    log_likelihood=log_likelihood,
                    explained=1.0,
                    cam_from_imu_xyzw=np.array([0.0, 0, 0, 1]),
                    gyro_bias_rad_s=np.zeros(3),
                )
                for at_s, log_likelihood in ((0.7, likelier), (0.05, 30.0))
            ]
            best, ahead = search._best(fits)
            assert best.offset_s == offset_s and ahead == pytest.approx(lead)
            # where nothing else is likely: unrelated recordings fit best anywhere in the range of 2.1 s
            alone = search._best(fits[1:])[1]
            assert alone == pytest.approx(30 + known * (np.log(2.1 / (0.1 * np.sqrt(2 * np.pi))) - 0.125))


# --- refusals


def test_a_tripod_a_short_clip_and_repeated_motion_are_refused():
    options = RecordingOptions(motion=MotionOptions(kind="static", duration_s=30.0))
    still = simulate_recording(options, seed=0)
    with pytest.raises(NotObservableError, match="turn it about"):
        align_camera_imu(still.trajectory, still.imu)
    moving = simulate_recording(RecordingOptions(imu=STATED), seed=0)
    with pytest.raises(NotObservableError, match="too few"):
        align_camera_imu(moving.trajectory.select(slice(0, 4)), moving.imu)
    with pytest.raises(NotObservableError, match="does not repeat"):
        align_camera_imu(*slow_turns([0, 1, 2], period_s=2.0))


def test_mirrored_axes_are_no_rotation():
    simulated = simulate_recording(RecordingOptions(imu=STATED), seed=4)
    mirrored = replace(simulated.imu, gyro_rad_s=simulated.imu.gyro_rad_s * np.array([1.0, 1.0, -1.0]))
    with pytest.raises(NotObservableError):
        align_camera_imu(simulated.trajectory, mirrored)


@pytest.mark.slow
def test_on_real_recordings_the_own_imu_is_found_and_every_other_is_refused(recordings):
    for name, (trajectory, own) in recordings.items():
        for part in (trajectory, window(trajectory, 0.0, 10.0)):
            calibration = align_camera_imu(part, own)
            # camera and IMU were started together, whatever their stamps say
            assert abs(calibration.gyro_time_offset_s + epoch_shift_s(own, trajectory.epoch_ns)) < 0.1
        for i, (other, (_, imu)) in enumerate(recordings.items()):
            if other != name:
                with pytest.raises(NotObservableError):
                    align_camera_imu(window(trajectory, 0.0, 10.0 if i % 2 else 60.1), imu)


def test_on_real_recordings_five_seconds_suffice_and_agree_with_a_minute(recordings):
    for trajectory, imu in recordings.values():
        whole = align_camera_imu(trajectory, imu)
        for begin_s in (10.0, 40.0):
            short = align_camera_imu(window(trajectory, begin_s, 5.0), imu)
            difference = short.gyro_time_offset_s - whole.gyro_time_offset_s
            assert abs(difference) < 4 * np.hypot(short.sigma("gyro_time_offset_s"), 0.005)


def test_sparse_keyframes_of_a_drone_give_the_factory_s_rotation(shared_data):
    trajectory, imu = read_euroc(shared_data / "euroc_v101")
    calibration = align_camera_imu(trajectory, imu, prior=calibration_prior(Declared(readout_s=0.0)))
    imu_from_cam = np.array(
        [
            [0.0148655429818, -0.999880929698, 0.00414029679422],
            [0.999557249008, 0.0149672133247, 0.025715529948],
            [-0.0257744366974, 0.00375618835797, 0.999660727178],
        ]
    )
    error = quat_log(quat_multiply(quat_from_matrix(imu_from_cam.T), quat_conjugate(calibration.cam_from_imu_xyzw)))
    assert np.all(np.abs(error) < 3 * np.sqrt(np.diag(calibration.cov)[:3]))
    assert np.abs(error).max() < 0.005
    assert abs(calibration.gyro_time_offset_s) < 0.002  # one clock, synchronised in hardware


def test_a_blink_of_a_recording_is_refused_not_tripped_over(subtests):
    for frames in (5, 7, 12, 30):
        with subtests.test(frames=frames):
            recording = simulate_recording(RecordingOptions(), seed=3)
            with pytest.raises(NotObservableError):
                align_camera_imu(recording.trajectory.select(slice(0, frames)), recording.imu)
