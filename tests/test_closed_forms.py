"""Small rules of several rooms, each against a closed form or a count by hand."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from colmap_inertial.checks.diagnose import camera
from colmap_inertial.checks.diagnose.frames import _readout
from colmap_inertial.checks.diagnose.imu import acceleration_rms_m_s2, scatter_of
from colmap_inertial.checks.report import figure_3d, figures, signals, still, still_3d
from colmap_inertial.checks.report.run_page import _round_to_sigma
from colmap_inertial.checks.validate import measure
from colmap_inertial.checks.validate.measure import _list_remarks
from colmap_inertial.checks.validate.overlays import _ticks
from colmap_inertial.checks.validate.place import _choose_pairs
from colmap_inertial.checks.validate.targets import parse_target
from colmap_inertial.checks.validate.views import load_views
from colmap_inertial.checks.words import digits, fixed, half_width_pct, length, length_error
from colmap_inertial.cli import process
from colmap_inertial.cli.help import Option, _shorten
from colmap_inertial.colmap import dense, rigs, tsdf
from colmap_inertial.colmap.loops import key_frames
from colmap_inertial.colmap.sparse import require_room_for_features
from colmap_inertial.colmap.two_views import _count_matches
from colmap_inertial.core import summary
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError, OutputError, TargetNotFoundError
from colmap_inertial.core.geometry import (
    matrix_from_quat,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_rotate,
)
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.sampling import find_clipped, time_unit_factor
from colmap_inertial.core.types import (
    IMU_CAL,
    IMU_CALIBRATION_PARAMETERS,
    CameraTrajectory,
    FrameTiming,
    ImuRecording,
    PositionFixes,
)
from colmap_inertial.core.types.consensus import RotationConsensus
from colmap_inertial.imaging import gate
from colmap_inertial.imaging.blur_field import check_nodes
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.imaging.multi_aperture._sampling import convert_to_codes
from colmap_inertial.imaging.multi_aperture.disparity import background
from colmap_inertial.imaging.psf import _fill_nodes
from colmap_inertial.inertial import scale
from colmap_inertial.inertial.core.factors import lasting_group, state_group, walk_group
from colmap_inertial.inertial.core.parameters import ACCEL_GAIN, DRIFT, GYRO_GAIN, N_GLOBALS, SCALE, Estimate, Prior
from colmap_inertial.inertial.core.priors import AccelPart, gains_cov
from colmap_inertial.inertial.georeference import _convert_to_enu
from colmap_inertial.inertial.scale import _shape
from colmap_inertial.inertial.scale._fit import _excitation_m_s2, _gain_surprise
from colmap_inertial.inertial.scale._shape import ShapeFault
from colmap_inertial.inertial.scale.joint import estimate_joint, scale_of
from colmap_inertial.io import imu_text, video
from colmap_inertial.io.android import is_opencamera
from colmap_inertial.io.gopro import _labels, _stabilisation
from colmap_inertial.io.phyphox import _column
from colmap_inertial.io.rig_frames import _find_nearest
from colmap_inertial.io.sensor_yaml import CAMERA_MODELS
from colmap_inertial.io.video_match import _Candidates, _distance, _normalise
from colmap_inertial.model.pose_covariances import _pose_information
from colmap_inertial.model.readout import _noise_px
from colmap_inertial.motion.align import _clock_search
from colmap_inertial.motion.align._clock_search import Intervals, _best_rotation, _fit
from colmap_inertial.motion.align._fit import _noise_of
from colmap_inertial.motion.align.conventions import quick_accelerations
from colmap_inertial.motion.flow import FlowOptions, _measure_quick_rotation
from colmap_inertial.motion.smooth import _trajectory
from colmap_inertial.motion.two_view_rotation import _fit_pure_rotation
from colmap_inertial.pipeline.run import workspace
from colmap_inertial.pipeline.run.workspace import require_room
from colmap_inertial.reconstruction.drivers.paths import only_model
from colmap_inertial.reconstruction.preparation import plan
from colmap_inertial.reconstruction.preparation.plan import _most_turned_rad
from colmap_inertial.reconstruction.preparation.selection import _slots
from colmap_inertial.tools.export import transforms
from colmap_inertial.tools.simulate import ImuOptions, RecordingOptions, simulate_recording
from colmap_inertial.tools.simulate.motion import MotionOptions
from colmap_inertial.tools.simulate.rests import RestOptions, _triangular, _Turn, simulate_rests
from colmap_inertial.tools.simulate.tracks import TrackOptions, simulate_tracks
from colmap_inertial.tools.view import scene as view_scene


@pytest.fixture(scope="module")
def recording():
    return simulate_recording(RecordingOptions(), seed=3)


def test_noise_of_poses_and_gyroscope_is_told_apart(subtests):
    for pose_rad, rate_rad_rts in ((2e-3, 4e-3), (1e-3, 2e-3), (4e-4, 8e-3)):
        with subtests.test(pose_rad=pose_rad, rate_rad_rts=rate_rad_rts):
            rng, dt_s = np.random.default_rng(1), np.full(3000, 0.2)
            poses = pose_rad * rng.standard_normal((3001, 3))
            residual = np.diff(poses, axis=0) + rate_rad_rts * np.sqrt(dt_s)[:, None] * rng.standard_normal((3000, 3))
            pose, rate = _noise_of(residual, dt_s, np.ones(3000), 1e-12)
            assert np.sqrt(pose) == pytest.approx(pose_rad, rel=0.15)
            assert np.sqrt(rate) == pytest.approx(rate_rad_rts, rel=0.1)


def test_steady_gravity_is_steady(recording):
    trajectory, imu = recording.trajectory, recording.imu
    found = quick_accelerations(trajectory, imu, recording.truth.calibration)
    assert found is not None and 0.98 < found.steadiness <= 1


def test_key_frames_begin_with_the_first_and_are_a_second_apart():
    assert key_frames(np.arange(0, 5.01, 0.25)).tolist() == [0, 4, 8, 12, 16, 20]
    assert key_frames(np.array([0.0, 0.5, 3.0, 3.4, 3.97])).tolist() == [0, 2, 4]


def test_of_a_quick_video_the_least_blurred_frame_of_each_slot_counts():
    t_s = np.arange(12) / 120  # four frames to a slot, which is about its middle
    blur = np.array([3, 2, 9, 1, 5, np.nan, 7, 8, 0.5, np.nan, np.nan, 4.0])
    assert _slots(t_s, blur).tolist() == [1, 3, 8, 11]
    assert _slots(np.arange(3) / 30, blur[:3]).tolist() == [0, 1, 2]


def test_no_shutter_takes_less_than_no_time(subtests):
    for times in ({"exposure_s": -0.001}, {"readout_s": -0.001}, {"readout_s": np.nan}):
        with subtests.test(times=times), pytest.raises(ValueError, match="must not be negative"):
            FrameShutter(**{"width": 64, "height": 48, "t_s": 0.0, "exposure_s": 0.01, **times})


def test_what_a_gyroscope_felt_just_before_an_uncertain_exposure_counts(recording):
    epoch_ns, prior = recording.trajectory.epoch_ns, replace(recording.truth.calibration, cov=1e-6 * np.eye(12))
    stamps_s = CameraTimedImu.from_recording(recording.imu, prior, epoch_ns).gyro_t_s
    rate = np.zeros_like(recording.imu.gyro_rad_s)
    at = len(stamps_s) // 2
    rate[at, 2] = 2.0
    imu = replace(recording.imu, gyro_rad_s=rate)
    uncertain_s = 3 * prior.clock_sigma_s
    step_s = float(np.median(np.diff(stamps_s)))
    for after_s, felt in ((uncertain_s + 4 * step_s, 0.0), (uncertain_s + 0.5 * step_s, 0.02)):
        timing = SimpleNamespace(t_s=stamps_s[[at]] + after_s, readout_s=0.0, epoch_ns=epoch_ns)
        case = SimpleNamespace(timing=timing, prior=prior, imu=imu)
        assert _most_turned_rad(case, np.array([0.01])) == pytest.approx(felt)
    # and after its last line was exposed, as late as the readout and the clocks let it be
    for readout_s, longest_s in ((0.02, 0.02), (None, plan._LIMITS.longest_readout_s)):
        end_s = longest_s + 0.01 + uncertain_s
        for before_s, felt in ((end_s + 4 * step_s, 0.0), (end_s - 0.5 * step_s, 0.02)):
            timing = SimpleNamespace(t_s=stamps_s[[at]] - before_s, readout_s=readout_s, epoch_ns=epoch_ns)
            case = SimpleNamespace(timing=timing, prior=prior, imu=imu)
            assert _most_turned_rad(case, np.array([0.01])) == pytest.approx(felt)


def test_a_picture_that_turns_seldom_but_far_was_stabilised():
    # rms .006 rad, mean .002
    turn = np.zeros((900, 3))
    turn[::9, 0] = 0.018
    assert _stabilisation({}, quat_exp(turn)[:, [3, 0, 1, 2]]) == (True, "IORI")
    assert _stabilisation({}, quat_exp(0.7 * turn)[:, [3, 0, 1, 2]]) == (False, "")


def test_ticks_are_the_round_numbers_nearest_to_six():
    assert _ticks(0.0, 10.0) == [0, 2, 4, 6, 8, 10]
    assert _ticks(-0.25, 0.31) == [-0.2, -0.1, 0.0, 0.1, 0.2, 0.3]


def test_a_hand_knocks_where_it_takes_and_leaves():
    rng = np.random.default_rng(4)
    options = RestOptions(hand_m_s2=0.0, knock_m_s2=5.0)
    turn = _Turn.draw(np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), options, rng)
    since_s = np.linspace(0, turn.duration_s, 4000)
    felt = np.linalg.norm(turn.handled_m_s2(since_s, rng), axis=1)
    middle = np.abs(since_s - turn.duration_s / 2) < 0.2 * turn.duration_s
    assert np.sqrt(np.mean(felt[middle] ** 2)) == pytest.approx(0.3 * np.sqrt(3), rel=0.1)
    assert felt[:20].mean() > 5 and felt[-20:].mean() > 5


def test_a_turned_device_turns_as_its_gyroscope_says_from_one_rest_to_the_next(subtests):
    for seed in range(3):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            up, up_next = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
            turn = _Turn.draw(up, up_next, RestOptions(tremor_rad=0.2), rng)
            assert 1.5 <= turn.duration_s <= 3.0
            ends = matrix_from_quat(turn.attitude(np.array([0.0, turn.duration_s])))
            assert ends[0] == pytest.approx(np.eye(3), abs=1e-9) and ends[1] @ up_next == pytest.approx(up, abs=1e-9)
            assert turn.rate_rad_s(np.array([0.0, turn.duration_s])) == pytest.approx(np.zeros((2, 3)), abs=1e-9)
            at_s, step_s = np.linspace(0.05, 0.95, 40) * turn.duration_s, 1e-4
            before, after = (turn.attitude(at_s + sign * step_s) for sign in (-1, 1))
            rate = quat_log(quat_multiply(quat_conjugate(before), after)) / (2 * step_s)
            assert np.abs(turn.rate_rad_s(at_s) - rate).max() < 1e-4 * np.abs(rate).max()


def test_readings_at_rest_become_gravity_by_the_true_calibration():
    quiet = {
        name: 0.0
        for name in (
            *("gyro_density_rad_s_rthz", "accel_density_m_s2_rthz", "gyro_walk_rad_s2_rthz", "accel_walk_m_s3_rthz"),
            *("gyro_resolution_rad_s", "accel_resolution_m_s2"),
        )
    }
    device = ImuOptions(gyro_scale_sd=0.02, accel_scale_sd=0.03, accel_misalignment_sd=0.02, **quiet)
    options = RestOptions(attitudes=5, rest_s=2.0, imu=device, gravity_m_s2=9.7)
    made = simulate_rests(options, seed=7)
    imu, begin_s = made.recording, 0.0
    assert len(made.up_in_imu) == 5
    accel = imu.accel_m_s2 @ (np.eye(3) + made.accel_gain).T - made.accel_bias_m_s2
    gyro = imu.gyro_rad_s @ (np.eye(3) + made.gyro_gain).T - made.gyro_bias_rad_s
    still = np.abs(gyro).max(axis=1) < 1e-9
    # each rest is the longest stretch of its attitude
    for k, up in enumerate(made.up_in_imu):
        here = np.linalg.norm(accel - 9.7 * up, axis=1) < 1e-9
        rest_s = imu.accel_t_s[here]
        assert 1.98 <= np.ptp(rest_s) <= 2.02 and rest_s[0] >= begin_s
        assert still[(imu.gyro_t_s > rest_s[0]) & (imu.gyro_t_s < rest_s[-1])].all()
        assert k == 0 or 1.4 < rest_s[0] - begin_s < 3.1
        begin_s = rest_s[-1]
    assert imu.accel_t_s[-1] == pytest.approx(begin_s) and imu.gyro_t_s[-1] == pytest.approx(begin_s, abs=0.02)


def test_a_hand_swings_and_shakes_by_its_acceleration():
    rng = np.random.default_rng(5)
    options = RestOptions(hand_m_s2=20.0, knock_m_s2=0.0, turn_s=(2.0, 2.0))
    turn = _Turn.draw(np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), options, rng)
    since_s = np.linspace(0, 2.0, 4000, endpoint=False)
    felt = turn.handled_m_s2(since_s, rng)
    power = 2 * np.abs(np.fft.rfft(felt, axis=0) / 4000) ** 2
    # once in the turn, and 25 times a second
    assert power[1] == pytest.approx((20 * turn.hand_axes[0]) ** 2 / 2, rel=0.05, abs=0.05)
    assert power[50] == pytest.approx((6 * turn.hand_axes[1]) ** 2 / 2, rel=0.05, abs=0.05)
    rest = np.delete(power, [1, 50], axis=0)
    assert rest.max() < 0.01 and np.sqrt(rest.sum(axis=0)) == pytest.approx([0.3] * 3, rel=0.1)


def test_a_matrix_becomes_lower_triangular_by_a_rotation():
    matrix = np.eye(3) + 0.1 * np.random.default_rng(2).standard_normal((3, 3))
    turned, lower = _triangular(matrix)
    assert turned @ matrix == pytest.approx(lower) and turned @ turned.T == pytest.approx(np.eye(3))
    assert np.triu(lower, 1) == pytest.approx(np.zeros((3, 3)), abs=1e-12)
    assert (np.diagonal(lower) > 0).all() and np.linalg.det(turned) == pytest.approx(1)


def test_models_without_poses_and_folders_of_several_are_refused(tmp_path):
    with pytest.raises(FormatError, match="holds no image with a pose"):
        load_views(pycolmap.Reconstruction(), tmp_path)
    for name in "01":
        (tmp_path / name).mkdir()
        pycolmap.Reconstruction().write_binary(str(tmp_path / name))
    with pytest.raises(FormatError, match="holds 2 models; give one of them"):
        only_model(tmp_path)


def test_pictures_far_apart_tell_no_readout():
    with pytest.raises(NotObservableError, match="far apart"):
        _readout(SimpleNamespace(rotation=object(), aligned=None, imu=None, is_dense=False))


def test_acceleration_is_what_turning_drift_bias_and_lever_arm_leave(subtests):
    for label, amplitude_m_s2, rms_m_s2 in (("turning in place", 0.0, 0.0), ("shaken", 0.4, 0.4 / np.sqrt(2))):
        with subtests.test(label):
            t_s = np.arange(0, 12, 1 / 400)
            # turns back and forth about the upright, with a bias, and with the IMU half a metre beside that axis
            angle, spin = 0.8 * np.cos(np.pi * t_s), -0.8 * np.pi**2 * np.cos(np.pi * t_s)
            rate = -0.8 * np.pi * np.sin(np.pi * t_s)
            zero, lever_m = np.zeros_like(t_s), np.array([0.5, 0.0, 0.1])
            world_from_imu = quat_exp(np.stack([zero, zero, angle], axis=1))
            # gravity changes ever faster, as through a gyroscope that drifts
            world = np.stack([zero, amplitude_m_s2 * np.sin(3 * np.pi * t_s), 9.8 + 0.3 * t_s**2], axis=1)
            off_axis = np.stack([-(rate**2) * lever_m[0], spin * lever_m[0], zero], axis=1)
            accel = quat_rotate(quat_conjugate(world_from_imu), world) + off_axis + [0.1, -0.2, 0.3]
            gyro = np.stack([zero, zero, rate], axis=1)
            found = acceleration_rms_m_s2(ImuRecording(gyro_t_s=t_s, gyro_rad_s=gyro, accel_t_s=t_s, accel_m_s2=accel))
            assert found == pytest.approx(rms_m_s2, rel=0.05, abs=0.01)


def test_errors_that_last_weigh_as_by_the_whole_covariance(subtests):
    for kind in ("lasting", "walk", "lasting, broken", "each by itself"):
        with subtests.test(kind=kind):
            rng, sigma, lasting_s = np.random.default_rng(11), 0.3, 0.6
            t_s = np.cumsum([0.1, 0.05, 0.4, 2.0, 0.2, 0.9])
            values, dt_s = rng.standard_normal((len(t_s), 3)), np.diff(t_s)
            apart_s, first_s = np.abs(t_s[:, None] - t_s), np.minimum(t_s[:, None], t_s)
            variance = 0.5 * lasting_s * sigma**2
            whole = np.ones(len(dt_s), dtype=bool)
            if kind == "lasting":
                cov, group = (
                    variance * np.exp(-apart_s / lasting_s),
                    lasting_group(values, DRIFT, sigma, lasting_s, dt_s, ~whole),
                )
            elif kind == "each by itself":
                cov, group = variance * np.eye(len(t_s)), state_group(values, DRIFT, variance**0.5)
            elif kind == "walk":
                cov, group = sigma**2 * first_s, walk_group(values, DRIFT, sigma, dt_s)
            else:
                whole[2] = False
                cov, group = sigma**2 * first_s, lasting_group(values, DRIFT, sigma, lasting_s, dt_s, ~whole)
                # either side of the break is a walk of its own
                cov[:3, 3:] = cov[3:, :3] = 0.0
            squares = np.sum(values * np.linalg.solve(cov, values))
            starts = {"each by itself": [], "lasting, broken": [0, 3]}.get(kind, [0])
            first = sum(np.sum(values[i] ** 2) / cov[i, i] for i in starts)
            assert np.sum(group.residual**2) + first == pytest.approx(squares, rel=1e-4)


def test_gains_surprise_where_they_are_farther_off_than_chance_has_it():
    rng, sigma = np.random.default_rng(3), 0.005
    start = Estimate.at_start(np.eye(3)[None], np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    info = np.zeros((N_GLOBALS, N_GLOBALS))
    info[ACCEL_GAIN, ACCEL_GAIN] = info[GYRO_GAIN, GYRO_GAIN] = np.eye(9) / sigma**2
    prior = Prior(mean=start, info=info, gravity_m_s2=9.8, gravity_sigma_m_s2=0.02)

    def surprise(times, cov):
        gains = times * sigma * rng.standard_normal((400, 3, 3))
        return np.array([_gain_surprise(prior, replace(start, accel_gain=gain), cov) for gain in gains])

    # all of the gains are known: nine squares are nine on average, and three standard deviations nine times as many
    known = np.zeros((N_GLOBALS, N_GLOBALS))
    usual = surprise(1.0, known)
    assert usual.min() == 1.0 and 0.1 < np.mean(usual > 1) < 0.2
    assert surprise(3.0, known).mean() == pytest.approx(81 / (9 + 18**0.5), rel=0.1)
    # none is: a little says more
    unknown = known.copy()
    unknown[ACCEL_GAIN, ACCEL_GAIN] = sigma**2 * np.eye(9)
    assert surprise(3.0, unknown).mean() > 3 * surprise(3.0, known).mean()


def test_a_fit_that_overstates_the_accelerometer_s_noise_is_corrected_by_its_share(subtests):
    for label, fitted, shift in (
        ("as expected", 1.0, 0.0),
        ("quieter", 0.5, 0.0),
        ("twice", 2.0, 0.75 * 4e-3),
        ("all of it", 30.0, 4e-3),
    ):
        with subtests.test(label):
            cov = np.zeros((N_GLOBALS, N_GLOBALS))
            cov[SCALE, SCALE] = 2e-5
            fit = SimpleNamespace(
                # 300 centres, of which the states take 200
                sums={"centre_m": (90.0, 90.0), "drift_m_rts": (10.0, 10.0)}, cov=cov, freedom=1e6, gain_surprise=2.0,
                expected_accel_m_s2_rthz=1e-3, noise=SimpleNamespace(accel_density_m_s2_rthz=fitted * 1e-3),
                variance_parts={"accel_gain": 1e-6, "motion": 3e-6}, level_variance=0.0,
                estimate=SimpleNamespace(metres_per_unit=0.5),
            )  # fmt: skip
            found = scale_of(fit, np.linspace(0, 1e4, 100), AccelPart(calibrated=True, factor=0.5), clock_rate=1e-3)
            assert found.shift == pytest.approx(shift, rel=0.01, abs=1e-12)
            assert found.metres_per_unit == pytest.approx(0.5 * np.exp(shift), rel=1e-4)
            # the surprise doubles the variance of the gains, and results of the device halve their standard deviation
            assert found.parts["accel_gain"] ** 2 == pytest.approx(0.5 * 1e-6, rel=0.02)
            assert found.parts["motion"] ** 2 == pytest.approx(3e-6, rel=0.02)
            assert found.parts["clocks"] == pytest.approx(2 * 1e-3)
            assert found.sigma_log == pytest.approx(sum(part**2 for part in found.parts.values()) ** 0.5)


def test_an_end_is_left_out_where_the_scale_is_three_times_as_sure_without_it(subtests, monkeypatch):
    count, wrong = 30, 7
    names = tuple(f"{i:02}" for i in range(count))
    path = CameraTrajectory(
        names=names,
        t_s=np.arange(30.0),
        cam_from_world_xyzw=np.tile([0, 0, 0, 1.0], (count, 1)),
        cam_in_world=np.zeros((count, 3)),
    )

    def estimate_of(misplaced, sigma_without, trajectory, timed, options):
        sigma = 1.0 if misplaced & set(trajectory.names) else sigma_without
        return SimpleNamespace(cov=sigma**2 * np.eye(7), verdict="weak")

    for sigma_without, believed in ((0.4, False), (0.2, True)):
        for end, misplaced in (("begin", set(names[:wrong])), ("end", set(names[-wrong:]))):
            with subtests.test(end, sigma_without=sigma_without):
                estimate = partial(estimate_of, misplaced, sigma_without)
                monkeypatch.setattr(scale, "_estimate", estimate)
                whole = estimate(path, None, None)
                best, left_out = scale._estimate_without_end(path, None, None, (whole, ()))
                assert set(left_out) == (misplaced if believed else set())
                assert best.cov[0, 0] == pytest.approx(sigma_without**2 if believed else 1.0)


def turned_intervals(rng, noise_rad, count=240):
    """Intervals of a camera, what a gyroscope says at the right clock offset and at a wrong one, and its rotation."""
    end_s = np.cumsum(rng.uniform(0.2, 0.6, count))
    intervals = Intervals(begin_s=np.append(0, end_s[:-1]), end_s=end_s, turn_rad=np.zeros((count, 3)))
    cam_from_imu = Rotation.random(random_state=5).as_matrix()
    felt = 0.2 * rng.standard_normal((count, 3))
    turn = felt @ cam_from_imu.T + intervals.dt_s[:, None] * [0.03, -0.02, 0.01]
    turn += noise_rad * rng.standard_normal((count, 3))
    return replace(intervals, turn_rad=turn), np.stack([felt, rng.permutation(felt)]), cam_from_imu


def test_what_a_rotation_and_a_rate_leave_is_what_scipy_leaves():
    intervals, inertial, cam_from_imu = turned_intervals(np.random.default_rng(9), 0.02)
    inside = np.random.default_rng(10).random((2, len(intervals))) < 0.8
    energy, left, _ = _fit(intervals, inertial, inside, None, 1.0)
    held = _fit(intervals, inertial, inside, cam_from_imu, 1.0)[1]
    for k in range(2):
        dt_s, *turns = (x[inside[k]] for x in (intervals.dt_s, intervals.turn_rad, inertial[k]))
        # weighed by one over the time, the rate that leaves least is the mean over all of it
        visual, felt = (x - dt_s[:, None] * x.sum(axis=0) / dt_s.sum() for x in turns)
        assert energy[k] == pytest.approx(np.sum(visual**2 / dt_s[:, None]))
        _, root = Rotation.align_vectors(visual, felt, weights=1 / dt_s)
        assert left[k] == pytest.approx(root**2, rel=1e-6)
        assert held[k] == pytest.approx(np.sum((visual - felt @ cam_from_imu.T) ** 2 / dt_s[:, None]))


def test_intervals_that_are_wrong_leave_nothing_where_a_share_is_believed():
    rng, noise_rad = np.random.default_rng(12), 1e-3
    intervals, inertial, cam_from_imu = turned_intervals(rng, noise_rad)
    wrong = rng.random(len(intervals)) < 0.2
    turn = np.where(wrong[:, None], 0.5 * rng.standard_normal((len(wrong), 3)), intervals.turn_rad)
    intervals = replace(intervals, turn_rad=turn)
    inside = np.ones((2, len(wrong)), dtype=bool)
    for held in (None, cam_from_imu):
        energy, left, (cross, *_) = _fit(intervals, inertial, inside, held, 0.7)
        noise = noise_rad**2 * np.sum(3 / intervals.dt_s)
        assert 0.2 * noise < left[0] < 0.8 * noise < 0.01 * energy[0] and left[1] > 0.3 * energy[1]
        assert _best_rotation(cross)[0] == pytest.approx(cam_from_imu, abs=3e-3)


def test_rays_that_do_not_turn_along_hardly_pull():
    rng, reach = np.random.default_rng(13), 1e-3
    b = rng.uniform(-0.5, 0.5, (300, 2))
    rays = np.concatenate([b, np.ones((300, 1))], axis=1)
    a_from_b = Rotation.from_rotvec([0.02, -0.03, 0.05])
    # two fifths of them moved sideways, all alike
    further = np.where(np.arange(300) < 120, 30 * reach, 0.0)[:, None] * [1.0, 0, 0]
    turned = a_from_b.apply(rays) + further
    found, share = _fit_pure_rotation(turned[:, :2] / turned[:, 2:], b, reach)
    assert (Rotation.from_matrix(found).inv() * a_from_b).magnitude() < 0.02 * reach
    assert share == pytest.approx(0.6)


def test_quick_rotation_is_what_is_faster_than_the_running_mean():
    t_s = np.arange(0, 20, 1 / 30)
    slow, quick = 2.0 * np.sin(0.4 * t_s), 0.3 * np.sin(2 * np.pi * 5 * t_s + 0.2)
    rate = np.stack([quick, slow, np.zeros_like(t_s)], axis=1)
    # one that was measured wrongly
    rate[300, 2] = 20.0
    assert _measure_quick_rotation(rate, 6) == pytest.approx(0.3 / np.sqrt(2), rel=0.1)


def test_options_of_the_flow_may_be_as_small_as_it_is_said():
    smallest = {"long_side_px": 64, "min_support": 8, "corners": 8}
    FlowOptions(**smallest)
    for name in smallest:
        with pytest.raises(ValueError, match="long_side_px must be 64 or more"):
            FlowOptions(**{**smallest, name: smallest[name] - 1})


def test_numbers_and_lengths_are_written_as_people_do():
    numbers = (0.123456, 12345.6, 123456789.0, 1e9, -1e9, 1e-7)
    assert [digits(v) for v in numbers] == ["0.1235", "12346", "123456789", "1e+09", "-1e+09", "1e-07"]
    assert [fixed(v) for v in (2.0, 1234.0, 123456.0, 1e9, -1e9)] == [
        *("2.000", "1234", "123456", "1.000e+09", "-1.000e+09"),
    ]
    assert [length(v) for v in (2.5, 0.9996, 0.5, 0.00999, 0.004)] == ["2.5 m", "1 m", "50 cm", "9.99 mm", "4 mm"]
    assert length_error(0.25) == "2.5 cm" and half_width_pct(2.0, (1.9, 2.1)) == pytest.approx(5.0)


def test_a_scale_that_breaks_is_told_by_lengths_and_undone_in_the_part_that_tells_less(subtests):
    for at_s, keeps_after, words in (
        (110.0, True, "+5.0 +- 2.0 % larger before 10 s"),
        (110.0, False, "-4.8 +- 2.0 % larger after 10 s"),
        (150.0, False, "-4.8 +- 2.0 % larger after 50 s"),
    ):
        with subtests.test(at_s=at_s, keeps_after=keeps_after, words=words):
            t_s = np.linspace(100.0, 160.0, 61)
            truth = np.stack([3 * np.sin(0.1 * t_s), 0.05 * t_s, np.cos(0.2 * t_s)], axis=1)
            # metres per unit are 5 % more behind the break, where lengths of the model are that much shorter
            longer = np.where(t_s[1:] <= at_s, 1.0, 1 / 1.05)
            model = np.concatenate([truth[:1], truth[0] + np.cumsum(np.diff(truth, axis=0) * longer[:, None], axis=0)])
            value, cov = np.array([np.log(1.05)]), np.array([[(0.02 / 1.96) ** 2]])
            fault = ShapeFault(
                kind="break", value=value, cov=cov, by_scale=np.zeros(1), at_s=at_s + 0.1, keeps_after=keeps_after
            )
            assert words in fault.sentence(t_s, 1.0)
            # either part is as large as in the one that keeps its metres
            steps = np.diff(fault.undo(t_s, model), axis=0) / np.diff(truth, axis=0)
            assert steps == pytest.approx(np.full_like(steps, longer[-1] if keeps_after else 1.0), rel=1e-9)


def test_a_drift_of_the_scale_is_undone_and_told_from_end_to_end():
    t_s = np.linspace(0.0, 80.0, 81)
    truth = np.stack([np.sin(0.1 * t_s), 0.05 * t_s, np.cos(0.2 * t_s)], axis=1)
    middle_s = 0.5 * (t_s[1:] + t_s[:-1])
    log_scale = 0.08 * (middle_s - 40.0) / 80.0
    model = np.cumsum(np.concatenate([truth[:1], np.diff(truth, axis=0) / np.exp(log_scale)[:, None]]), axis=0)
    cov = np.array([[1e-4]])
    fault = ShapeFault(kind="drift", value=np.array([0.08]), cov=cov, by_scale=np.zeros(1))
    assert fault.undo(t_s, model) == pytest.approx(truth, abs=1e-9)
    # more metres per unit at the end: the model's lengths are smaller there
    assert "lengths are -7.7 +- 2.8 % larger at the end" in fault.sentence(t_s, 2.0)
    tolerated = 0.01
    assert fault.chi2(2.0, tolerated) == pytest.approx(0.08**2 / (2e-4 + tolerated**2))


def test_the_excitation_is_the_acceleration_of_the_camera_and_not_of_its_imu():
    t_s, hz = np.arange(0, 20, 0.05), 0.5
    angle = 0.6 * np.sin(2 * np.pi * 0.8 * t_s)
    world_from_imu = Rotation.from_rotvec(angle[:, None] * [0, 0, 1.0]).as_matrix()
    camera = np.stack([0.3 * np.sin(2 * np.pi * hz * t_s), 2.0 * t_s, np.zeros_like(t_s)], axis=1)
    # half a metre in front of the IMU
    cam_from_imu, imu_in_cam = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix(), np.array([0.0, 0.0, -0.5])
    path = SimpleNamespace(
        imu_in_world_m=camera + world_from_imu @ cam_from_imu.T @ imu_in_cam,
        world_from_imu=world_from_imu, cam_from_imu=cam_from_imu, imu_in_cam_m=imu_in_cam,
    )  # fmt: skip
    found = _excitation_m_s2(SimpleNamespace(t_s=t_s), path)
    assert found == pytest.approx(0.3 * (2 * np.pi * hz) ** 2 / np.sqrt(2), rel=0.02)


def test_noise_is_told_by_what_poses_and_points_do_not_adapt_to(subtests):
    for points, known in ((12, False), (400, True)):
        with subtests.test(points=points, known=known):
            pycolmap.set_random_seed(4)
            options = pycolmap.SyntheticDatasetOptions()
            options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 2 if points == 12 else 8
            options.num_points3D = points
            model = pycolmap.synthesize_dataset(options)
            noise = pycolmap.SyntheticNoiseOptions()
            noise.point2D_stddev = 0.4
            pycolmap.synthesize_noise(noise, model)
            adjusted = pycolmap.BundleAdjustmentOptions()
            adjusted.print_summary = adjusted.refine_focal_length = adjusted.refine_extra_params = False
            if known:
                pycolmap.bundle_adjustment(model, adjusted)
            model.update_point_3d_errors()
            found = _noise_px(model)
            # two images of twelve points have as many numbers as poses and points
            assert found == (pytest.approx(0.4, rel=0.1) if known else None)


def test_the_scatter_of_readings_is_that_of_their_white_noise():
    t_s, rng = np.arange(0, 20, 0.01), np.random.default_rng(17)
    sizes = np.array([0.5, 0.02, 0.001])
    values = sizes * rng.standard_normal((len(t_s), 3)) + np.sin(2 * t_s)[:, None]
    # of the axis in the middle, whatever a few readings say
    values[::50] += 3.0
    assert scatter_of(values) == pytest.approx(0.02, rel=0.15)


def test_a_file_may_fill_its_disk_and_its_limit_and_no_more(tmp_path, monkeypatch):
    file, absent = tmp_path / "made", tmp_path / "absent"
    file.write_bytes(bytes(100))
    monkeypatch.setattr(workspace.shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    for copies, most in ((1, 1000), (2, 500)):
        require_room(file, most, copies=copies)
        with pytest.raises(OutputError, match="nearly full"):
            require_room(file, most + 1, copies=copies)
    monkeypatch.setattr(workspace, "_largest_file_bytes", lambda: 700)
    for path, most in ((file, 600), (absent, 700)):
        require_room(path, most)
        with pytest.raises(OutputError, match="a file may have"):
            require_room(path, most + 1)


def test_a_feature_needs_room_for_its_place_and_its_descriptor(tmp_path, monkeypatch):
    """Six numbers of four bytes and 128 of one, for as many as an image may have; four times that is plenty."""
    options, free = MappingOptions(max_num_features=50), SimpleNamespace(free=0)
    monkeypatch.setattr(workspace.shutil, "disk_usage", lambda _: free)
    free.free = 7 * 50 * (6 * 4 + 128) - 1
    with pytest.raises(OutputError, match="nearly full"):
        require_room_for_features(tmp_path / "database.db", 7, options)
    free.free = 4 * 7 * 50 * (6 * 4 + 128)
    require_room_for_features(tmp_path / "database.db", 7, options)
    with pytest.raises(OutputError, match="nearly full"):
        require_room_for_features(tmp_path / "database.db", 7, options, copies=4)


def test_a_picture_that_varies_by_less_than_a_grey_level_looks_like_nothing():
    one_of_eight = (np.arange(256) % 8 == 0).reshape(16, 16)
    # a step of three levels has a standard deviation of 0.99, one of four 1.32
    assert not _normalise((100 + 3 * one_of_eight).astype(np.uint8)).any()
    telling = _normalise((100 + 4 * one_of_eight).astype(np.uint8))
    assert np.linalg.norm(telling) == pytest.approx(1) and telling.mean() == pytest.approx(0, abs=1e-6)


def test_frames_beyond_the_file_are_those_of_the_video_that_was_listed(monkeypatch):
    """Not those of sound with as many samples, nor of another picture in the file."""

    def track(handler, listed, beyond):
        return SimpleNamespace(handler=handler, size=np.zeros(listed), lost=beyond)

    tracks = [track("soun", 90, 5), track("vide", 1, 1), track("vide", 90, 3)]
    movie = SimpleNamespace(tracks=tracks, beyond=lambda one: np.zeros(one.lost))
    monkeypatch.setattr(video, "read_movie", lambda _: movie)
    assert video._count_lost("a.mp4", "mov,mp4,m4a", 90, 7) == 3
    assert video._count_lost("a.mp4", "mov,mp4,m4a", 40, 7) == 0
    assert video._count_lost("a.mkv", "matroska,webm", 90, 7) == 7
    for whole, lost in ((True, 7), (False, 0)):
        monkeypatch.setattr(video, "_ends_inside_riff", lambda _, whole=whole: whole)
        assert video._count_lost("a.avi", "avi", 90, 7) == lost


def test_images_of_another_camera_are_the_nearest_in_time():
    rng = np.random.default_rng(8)
    own_s, frames_s = np.sort(rng.uniform(0, 10, 60)), np.sort(rng.uniform(-1, 11, 80))
    own = FrameTiming(names=tuple(f"o{k}" for k in range(60)), t_s=own_s - 3, epoch_ns=10**18 + 3 * 10**9)
    timing = FrameTiming(names=tuple(f"f{k}" for k in range(80)), t_s=frames_s + 2, epoch_ns=10**18 - 2 * 10**9)
    nearest, apart_ns = _find_nearest(own, timing)
    away = np.abs(own_s - frames_s[:, None])
    assert np.array_equal(nearest, away.argmin(axis=1))
    assert apart_ns == pytest.approx(1e9 * away.min(axis=1), abs=3)


def seen_from(away, focal_px):
    """A model of which pictures see points from half, from all and from thrice that depth; and its pictures."""
    turn = matrix_from_quat(quat_exp(np.array([0.3, -0.5, 0.2])))
    points, images = {}, {}
    for k, depth in enumerate((0.5 * away, away, 3 * away)):
        seen = []
        for j in range(5):
            # half of the points are nearer, half farther
            in_cam = np.array([0.1 * j, -0.2, depth + 0.1 * depth * (j - 2)])
            points[10 * k + j] = SimpleNamespace(xyz=turn.T @ (in_cam - [1, 2, 3]))
            seen.append(SimpleNamespace(point3D_id=10 * k + j, has_point3D=lambda: True))
        seen.append(SimpleNamespace(point3D_id=-1, has_point3D=lambda: False))
        rotation = SimpleNamespace(matrix=lambda: turn)
        pose = SimpleNamespace(rotation=rotation, translation=np.array([1.0, 2, 3]))
        images[k] = SimpleNamespace(camera_id=1, points2D=seen, cam_from_world=lambda pose=pose: pose)
    camera = SimpleNamespace(mean_focal_length=lambda: focal_px)
    model = SimpleNamespace(
        reg_image_ids=lambda: list(images), image=images.get, camera=lambda _: camera, points3D=points
    )
    return model, images


def test_cells_of_a_surface_are_as_large_as_pixels_on_it(subtests, tmp_path):
    """The widest axis of the points and a tenth more, halved until a cell is no larger than a pixel spans there."""
    places = np.random.default_rng(0).uniform(0, 1, (500, 3)) * [2, 8, 1] + [5, -3, 7]
    places[:2] = [[6, -3, 7], [6, 5, 7]]
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 500\n"
    fields = "".join(f"property float {axis}\n" for axis in "xyz")
    path = tmp_path / "fused.ply"
    path.write_bytes((header + fields + "end_header\n").encode() + places.astype("<f4").tobytes())
    for away, focal_px in ((4.0, 500.0), (1.0, 500.0), (4.0, 2000.0), (0.01, 4000.0), (400.0, 10.0)):
        with subtests.test(away=away, focal_px=focal_px):
            model, images = seen_from(away, focal_px)
            depth, trim = dense._choose_octree(path, model)
            cells = 1.1 * 8 / (away / focal_px)
            expected = min(max(next(n for n in range(40) if 2**n >= cells), dense._LEAST_DEPTH), dense._MOST_DEPTH)
            assert depth == expected and trim == depth - dense._TRIM_LEVELS
            images.clear()
            assert dense._choose_octree(path, model)[0] == dense._MOST_DEPTH


def test_a_picture_between_two_frames_lies_at_its_share_of_the_way(subtests):
    for share in (0.0, 0.2, 0.5):
        with subtests.test(share=share):
            frames = np.random.default_rng(4).integers(0, 255, (2, 16, 16)).astype(np.uint8)
            between = _distance(*(_normalise(frame) for frame in frames))
            candidates = object.__new__(_Candidates)
            candidates._frames, candidates.distance = [frames], np.array([[share * between, (1 - share) * between]])
            assert candidates.fraction_to_next(0) == pytest.approx(share)
            # off the way between them by as much from both
            candidates.distance = np.hypot(candidates.distance, 0.3)
            assert candidates.fraction_to_next(0) == pytest.approx(share)
            candidates.distance[0, 1] = np.inf
            assert candidates.fraction_to_next(0) == 0
            candidates._frames, candidates.distance = [frames[[0, 0]]], np.array([[0.1, 0.1]])
            assert candidates.fraction_to_next(0) == 0.5


def test_nodes_without_a_ray_take_the_vector_of_the_nearest_one():
    rng = np.random.default_rng(9)
    vectors = rng.standard_normal((7, 9, 2))
    bad = rng.random((7, 9)) < 0.4
    vectors[bad, 0] = np.nan
    filled = _fill_nodes(vectors)
    assert np.array_equal(filled[~bad], vectors[~bad]) and np.isfinite(filled).all()
    known = np.argwhere(~bad)
    for node in np.argwhere(bad):
        away = np.hypot(*(known - node).T)
        nearest = known[away < away.min() + 1e-9]
        assert any(np.array_equal(filled[tuple(node)], vectors[tuple(one)]) for one in nearest)
    with pytest.raises(ValueError, match="no pixel"):
        _fill_nodes(np.full((2, 2, 2), np.nan))


def test_a_column_of_phyphox_is_found_by_its_pattern():
    table = SimpleNamespace(path="a.csv", header=("Time (s)", " Gyroscope x (rad/s)"), header_text="Time (s), ...")
    assert _column(table, r"time.*") == 0 and _column(table, r"gyroscope x.*") == 1
    with pytest.raises(FormatError, match="no column like 'accelerometer'"):
        _column(table, "accelerometer")


def test_a_colour_between_two_lies_at_its_share_of_the_way():
    scale = [[0.0, "#000000"], [0.5, "#804020"], [1.0, "#ffffff"]]
    colours = [still._mix(scale, share) for share in (-1.0, 0.25, 0.75, 2.0)]
    assert colours == ["#000000", "#402010", "#c0a090", "#ffffff"]


def test_the_spectrum_of_white_noise_is_its_density_up_to_half_the_rate():
    t_s = np.arange(0.0, 60.0, 0.005)
    noise = 0.1 * np.random.default_rng(4).standard_normal((len(t_s), 3))
    found = signals._estimate_spectrum(t_s, noise)
    hz, density = (np.asarray(found[name], dtype=float) for name in ("hz", "density"))
    # of a vector: of three axes, one-sided
    expected = 0.1 * np.sqrt(3 * 2 * 0.005)
    # 120 bins from the lowest frequency, of parts of 8 s, to half the rate
    assert np.log(hz[-2] / hz[-22]) == pytest.approx(20 * np.log(100 * 8) / 120, rel=0.02)
    np.testing.assert_allclose(density[hz > 10], expected, rtol=0.15)
    assert np.mean(density[hz > 10]) == pytest.approx(expected, rel=0.02)


def test_gains_of_dense_frames_are_those_of_what_overlaps_about_its_mean():
    """By FFT for all offsets at once, and here by sums, one offset after the other."""
    rng, step_s, late = np.random.default_rng(2), _clock_search._GRID_S, 13
    rate = [0.5, -0.2, 0.3] + 0.4 * rng.standard_normal((160, 3))
    path = SimpleNamespace(t_s=step_s * np.arange(161), rate_rad_s=np.zeros((161, 3)))
    # trapezia between samples: the mean of neighbours is the rate of a cell
    for i, of_cell in enumerate(rate):
        path.rate_rad_s[i + 1] = 2 * of_cell - path.rate_rad_s[i]
    visual = rate[late : late + 120] + [0.1, 0.2, -0.1] + 0.1 * rng.standard_normal((120, 3))
    begin_s = step_s * np.arange(120)
    intervals = Intervals(begin_s=begin_s, end_s=begin_s + step_s, turn_rad=visual * step_s)
    offsets_s, gains, per_second = _clock_search._correlate(intervals, path, (-1.0, 1.0), 0.5, np.eye(3))
    assert len(offsets_s) > 30 and offsets_s[np.argmax(gains)] == pytest.approx(-late * step_s)
    for offset_s, gain in zip(offsets_s, gains, strict=True):
        shift = -round(offset_s / step_s)
        cells = np.arange(max(0, -shift), min(120, 160 - shift))
        v, g = (x - x.mean(axis=0) for x in (visual[cells], rate[cells + shift]))
        left = max(np.sum((v - g) ** 2), 1e-3 * np.sum(v**2))
        assert gain == pytest.approx(0.5 * per_second * step_s * len(cells) * np.log(np.sum(v**2) / left), abs=1e-6)


def test_codes_of_16_bit_go_over_the_square_root():
    image = np.array([[0, 2500, 10_000]], dtype=np.uint16)
    np.testing.assert_array_equal(convert_to_codes(np.repeat(image, 2000, axis=0)), [[0, 128, 255]] * 2000)
    np.testing.assert_array_equal(convert_to_codes(np.array([[7]], np.uint8)), [[7]])


def test_one_value_that_is_not_finite_is_enough_to_refuse_nodes():
    values = np.ones((2, 3))
    assert check_nodes("x", values, (2, 3)).dtype == np.float32
    values[1, 2] = np.nan
    with pytest.raises(ValueError, match="x: must be finite"):
        check_nodes("x", values, (2, 3))


def test_deviations_of_cameras_that_were_registered_again_are_the_later_ones():
    def consensus(names, deviation_deg, part):
        return RotationConsensus(
            names=names,
            t_s=np.arange(len(names), dtype=float),
            judged=np.ones(len(names), dtype=bool),
            deviation_deg=np.array(deviation_deg),
            part=np.array(part),
            ref_from_part_xyzw=np.array([[0.0, 0.0, 0.0, 1.0]]),
        )

    before = consensus(("a", "b", "c"), [0.5, 40.0, 90.0], [0, -1, -1])
    after = before.updated(consensus(("b", "a"), [0.25, 0.75], [0, 0]))
    assert after.deviations_deg == {"a": 0.75, "b": 0.25, "c": 90.0}
    assert after.registered_again == ("b",) and [camera.name for camera in after.wrong] == ["c"]


def test_sightings_are_paired_where_their_lines_of_sight_meet():
    views = [SimpleNamespace(cam_from_world=np.eye(3))] * 3
    rays = [Rotation.from_euler("y", deg, degrees=True).apply([0.0, 0.0, 1.0]) for deg in (0.0, 20.0, 40.0)]
    sightings = [SimpleNamespace(view=i, ray=ray[None]) for i, ray in enumerate(rays)]
    assert _choose_pairs(sightings, views, 0) == [(0, 1), (0, 2), (1, 2)]
    assert _choose_pairs([sightings[0], sightings[0]], views, 0) == []  # of one view


def test_few_views_are_remarked_on_below_five():
    search = SimpleNamespace(sightings=[], searched=range(9), views=range(9), target=parse_target("aruco:4X4_50:0.1"))
    fit = SimpleNamespace(noise=SimpleNamespace(pose_ratio=np.zeros(2)))
    said = [_list_remarks(search, None, fit, tuple(range(count))) for count in (4, 5)]
    assert [any("the interval is wide" in line for line in lines) for lines in said] == [True, False]


def test_a_long_text_of_an_option_becomes_its_first_sentence():
    long = "A length in metres. " + "More of it, which few need to know. " * 5
    texts = ("Short. As it is", long, "x" * 200)
    options = [
        Option(
            names=("a",),
            group="",
            field="a",
            value="",
            text=text,
            default="",
            positional=False,
            required=False,
            source=object,
        )
        for text in texts
    ]
    assert [option.text for option in _shorten(options)] == ["Short. As it is", "A length in metres.", "x" * 200 + "."]


def test_a_perfect_model_s_observations_err_by_a_twentieth_of_a_pixel_at_least():
    tracks = simulate_tracks(TrackOptions(motion=MotionOptions(duration_s=3.0), noise_px=0.0), seed=1)
    model = tracks.reconstruction()
    image = next(iter(model.images.values()))
    place = {number: point.xyz for number, point in model.points3D.items()}
    variance_px2 = _pose_information(image.camera, image, image.cam_from_world(), place)[1]
    assert variance_px2 == pytest.approx(0.05**2)


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
    assert "most at 20 s" in found["open"][0].evidence


def test_positions_without_a_height_lie_at_the_median_of_the_others():
    fixes = PositionFixes(
        latitude_deg=np.array([65.0, 65.0, 65.0]),
        longitude_deg=np.array([25.0, 25.0, 25.001]),
        height_m=np.array([20.0, 30.0, np.nan]),
        sigma_m=np.ones(3),
        t_ns=np.arange(3),
    )
    origin, enu, has_height = _convert_to_enu(fixes)
    np.testing.assert_allclose(origin, [65.0, 25.0, 25.0])
    # a thousandth of a degree of longitude at 65 degrees north
    np.testing.assert_allclose(enu, [[0, 0, -5], [0, 0, 5], [47.2, 0, 0]], atol=0.05)
    assert has_height.tolist() == [True, True, False]


def test_the_correlated_error_of_positions_is_stationary():
    frames = 6
    model = _trajectory._Model(
        t_s=np.linspace(0.0, 1.0, frames),
        measured=np.zeros((frames, 3)),
        gained=np.zeros((frames, 2, 3)),
        silent=np.zeros(frames - 1, dtype=bool),
        left_out=np.zeros(frames, dtype=bool),
        jumps=np.zeros(frames - 1, dtype=bool),
        motion_density=1.0,
    )
    chain = model.chain(np.log([1e-4, 4e-4, 1e-2, 1e-2]))
    at_first = 1 / chain.initial_information[3, 3]
    later = chain.transition[:, 3, 3] ** 2 * at_first + chain.process_cov[:, 3, 3]
    assert at_first == pytest.approx(4e-4)
    np.testing.assert_allclose(later, 4e-4)


def test_a_scene_s_box_holds_nearly_all_points_and_the_whole_path():
    xyz = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 5000))
    xyz[:, :3] = 1000.0  # a few far ones
    low, high = figure_3d._box(xyz, np.array([[0.0, 5.0], [0.0, 0.0], [0.0, 0.0]]))
    # with a margin of 6 % of the longest side
    np.testing.assert_allclose(low, [-1.34, -1.34, -1.34], atol=0.04)
    np.testing.assert_allclose(high, [5.38, 1.34, 1.34], atol=0.04)


def test_a_still_scene_fills_its_picture_and_stays_inside():
    corners = np.array([[x, y, z] for x in (-2.0, 3.0) for y in (0.0, 1.0) for z in (0.0, 4.0)])
    trace = {"mode": "lines", "name": "camera path", **dict(zip("xyz", corners.T.tolist(), strict=True))}
    view = still_3d.StillView()
    seen, near = still_3d._Projection(view, [trace])(corners)
    first, last = seen.min(axis=0), seen.max(axis=0)
    margin = np.array([first, [view.width, view.height - 16] - last])
    assert margin.min() >= view.margin - 1e-6
    assert np.isclose(margin, view.margin, atol=2.1).all(axis=0).any()  # the length or the height is full
    # what is nearer to the eye is larger, and what stands up goes up
    assert np.all(seen[1::2, 1] < seen[::2, 1])
    a, e = np.radians([view.azimuth_deg, view.elevation_deg])
    towards = corners @ [np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]
    assert np.array_equal(np.argsort(near.ravel()), np.argsort(towards))


def test_lines_of_a_still_scene_are_half_as_wide_and_a_pixel_at_least():
    widths = [still_3d._look({"line": {"color": "red", "width": width}})["width"] for width in (1, 4)]
    assert widths == [1.0, pytest.approx(2.2)]


def test_a_gap_of_the_path_is_a_step_of_more_than_ten_usual_ones():
    place = np.array([0.0, 1.0, 2.0, 11.5, 12.5, 23.0, 24.0, 25.0])
    cameras = SimpleNamespace(cam_in_world=np.outer(place, [1.0, 0.0, 0.0]))
    pieces, stretch = view_scene._path(SimpleNamespace(trajectory=None), cameras)
    assert stretch is None
    assert [piece[0][0] for piece in pieces] == [0.0, 1.0, 2.0, 11.5, 23.0, 24.0]


def test_gaps_of_disparities_are_filled_from_the_border_s_own_column_too():
    known = np.zeros((3, 5), dtype=bool)
    known[:, 0] = known[:, 4] = True
    disparity_px = np.where(known, np.array([[2.0, 0, 0, 0, 5.0]]), np.nan).astype(np.float32)
    np.testing.assert_array_equal(background(disparity_px, known), np.tile([2.0, 5.0, 5.0, 5.0, 5.0], (3, 1)))
    known[:, 4] = False
    np.testing.assert_array_equal(background(disparity_px, known), np.full((3, 5), 2.0))


def test_a_camera_that_stands_in_its_model_has_no_scale(recording):
    still = replace(recording.trajectory, cam_in_world=np.zeros_like(recording.trajectory.cam_in_world))
    timed = CameraTimedImu.from_recording(recording.imu, recording.truth.calibration, still.epoch_ns)
    refused = estimate_joint(still, timed)
    assert (refused.verdict, refused.metres_per_unit) == ("refused", None)
    assert refused.reasons == ("the camera does not move in the model: move it, do not only turn it",)


def test_a_text_as_long_as_its_room_is_not_cut():
    assert [summary._cut("abcdef", width) for width in (5, 6, 7)] == ["ab...", "abcdef", "abcdef"]


def test_strains_are_orthonormal_without_trace():
    np.testing.assert_allclose(np.einsum("aij,bij->ab", _shape._STRAINS, _shape._STRAINS), np.eye(5), atol=1e-12)
    np.testing.assert_allclose(np.trace(_shape._STRAINS, axis1=1, axis2=2), 0.0, atol=1e-12)
    np.testing.assert_array_equal(_shape._STRAINS, np.swapaxes(_shape._STRAINS, 1, 2))


def test_camera_models_are_colmap_s(subtests):
    known = pycolmap.CameraModelId.__members__
    assert len(known) > 10
    # the lowest pycolmap lacks the latest ones
    for number, (name, (count, principal)) in enumerate((k, v) for k, v in CAMERA_MODELS.items() if k in known):
        with subtests.test(name):
            camera = pycolmap.Camera.create_from_model_name(1, name, 500.0, 640, 480)
            assert int(camera.model) == number
            assert len(camera.params) == count
            assert camera.principal_point_idxs()[0] == principal


def test_a_folder_is_opencamera_s_where_each_gyroscope_s_file_has_bare_rows(tmp_path):
    (tmp_path / "a_gyro.csv").write_text("0.1,0.2,0.3,123\n")
    assert is_opencamera(tmp_path)
    (tmp_path / "b_gyro.csv").write_text("t,x,y,z\n1,2,3,4\n")
    assert not is_opencamera(tmp_path)


def test_residuals_on_the_sensor_are_lines_from_the_middles_of_its_parts():
    sensor = {
        "columns": 2,
        "rows": 2,
        "width": 200,
        "height": 100,
        "mean_x_px": [0.5, 0.0, -0.25, None],
        "mean_y_px": [0.0, 0.5, 0.25, None],
        "rms_px": [0.5, 0.5, 0.4, None],
    }
    figure = figures.residuals_on_sensor(sensor)
    lines = next(trace for trace in figure["data"] if trace["type"] == "scatter")
    # the largest is nine tenths of a part long
    assert lines["x"] == [50.0, 95.0, None, 150.0, 150.0, None, 50.0, 27.5, None]
    assert lines["y"] == [25.0, 25.0, None, 25.0, 70.0, None, 75.0, 97.5, None]


def test_values_are_rounded_to_the_second_digit_of_their_standard_deviation():
    rounded = [_round_to_sigma(1234.56789, sigma) for sigma in (None, 123.0, 1.23, 0.0123)]
    assert rounded == [("1234.57", ""), ("1235", "123"), ("1234.6", "1.2"), ("1234.568", "0.012")]


def test_three_letters_name_the_axes_of_a_gopro():
    np.testing.assert_array_equal(_labels("YxZ") @ [1.0, 2.0, 3.0], [-2.0, 1.0, 3.0])
    for letters in ("XY", "XYZX", ""):
        with pytest.raises(ValueError, match="does not name three axes"):
            _labels(letters)


def test_single_descriptors_are_no_matches():
    one, many = np.full((1, 128), 45, np.uint8), np.eye(128, dtype=np.uint8)[:40] * 255
    assert [_count_matches(*pair) for pair in ((one, many), (many, one), (many[:0], many))] == [0, 0, 0]


def test_readings_are_cut_off_where_their_end_is_common_and_what_is_next_to_it_is_rare():
    spread = np.linspace(-1, 0, 25)
    rare, common = (np.concatenate([np.repeat(spread, times), np.full(8, 5.0)]) for times in (1, 4))
    # the next reading is far from the end: how often it comes counts all the same
    assert find_clipped(np.stack([rare], axis=1))[:, 0].tolist() == [False] * 25 + [True] * 8
    assert not find_clipped(np.stack([common], axis=1)).any()


def test_a_longer_blur_path_errs_by_as_much_more():
    path = BlurPath(width=32, height=32, step_px=32, path_px=np.ones((3, 2, 2, 2)), cov_px2=np.array([1.0, 2.0, 0.5]))
    longer = path.times(3.0)
    np.testing.assert_allclose(longer.path_px, 3 * path.path_px)
    np.testing.assert_allclose(longer.cov_px2, 9 * path.cov_px2)


def test_a_quarter_of_the_known_depths_is_near():
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 64, 48)
    depth = np.arange(10, dtype=np.float32)[None]
    assert tsdf._measure_typical(depth, camera) == pytest.approx((3.0, 0.03))
    assert tsdf._measure_typical(0 * depth, camera) == (0.0, 0.0)


@pytest.mark.parametrize(("images", "agree"), [(10, True), (11, False)])
def test_a_fifth_of_the_images_that_show_a_target_agree_where_it_is(images, agree):
    sightings = [SimpleNamespace(view=i) for i in range(images)]
    search = SimpleNamespace(parts={0: sightings}, sightings=sightings, target=SimpleNamespace(spec="board"))
    placed = {0: SimpleNamespace(chosen=[3, 7])}
    if agree:
        assert measure._require_agreement(search, placed) is None
    else:
        with pytest.raises(TargetNotFoundError, match=rf"found in {images} images, but only 2 of them agree"):
            measure._require_agreement(search, placed)


def test_gains_stay_unknown_as_a_calibration_says_and_by_what_moved_since():
    cov = np.diag(np.arange(1.0, len(IMU_CALIBRATION_PARAMETERS) + 1)) * 1e-6
    of = SimpleNamespace(accel_factor=np.eye(3), cov=cov)
    entries = np.r_[IMU_CAL.ACCEL_GAIN, IMU_CAL.GYRO_GAIN]
    np.testing.assert_allclose(gains_cov(SimpleNamespace(calibration=of)), cov[np.ix_(entries, entries)])
    with pytest.raises(ValueError, match="not corrected by a calibration"):
        gains_cov(SimpleNamespace(calibration=None))


@pytest.mark.parametrize(("sizes", "models"), [([2, 2, 3], 2), ([2, 3, 3, 4], 3), ([3, 2], 2)])
def test_frames_are_surveyed_again_only_while_more_of_them_register(monkeypatch, sizes, models):
    made = iter(sizes)
    asked = []

    def model_of(names, treated):
        asked.append(treated)
        return tuple(f"{i}.jpg" for i in range(next(made)))

    segment = [f"{i}.jpg" for i in range(9)]
    monkeypatch.setattr(plan, "_LIMITS", replace(plan._LIMITS, surveys=5))
    monkeypatch.setattr(plan._Surveyed, "of", lambda registered, view: SimpleNamespace(registered=registered))
    for name, answer in {
        "survey_parts": [segment],
        "_decisions": None,
        "_blurred": True,
        "_select_blurred": segment,
        "_group_by_segment": {0: set(segment)},
        "_merge_parallaxes": {"0.jpg": 1.0},
        "_decided": SimpleNamespace(deblur="yes"),
    }.items():
        monkeypatch.setattr(plan, name, lambda *_, answer=answer: answer)
    treated = plan._deblurring(None, SimpleNamespace(timing=None), None, model_of, lambda _: [], None)
    # the first model is of frames as filmed
    assert asked == [None, *[treated] * (models - 1)]


@pytest.mark.parametrize(
    ("span_s", "other_s", "factor"),
    [
        (2e3, 2.0, 1e3),
        (9.0e6, 3.0, 1e6),
        (2e-9, 1.0, 1e-9),
        (1.0, 1e3, 1e-3),
        (4.0, 1.0, None),
        (4e4, 1.0, None),
        (4.9e3, 1.0, 1e3),
    ],
)
def test_a_clock_in_another_unit_is_off_by_a_power_of_a_thousand(span_s, other_s, factor):
    assert time_unit_factor(span_s, other_s) == (None if factor is None else pytest.approx(factor))


@pytest.mark.parametrize(("support", "mirrored", "clear"), [(2.0, -1.0, True), (2.0, 1.9, False), (0.1, 0.0, False)])
def test_frames_confirm_a_gyroscope_together_but_not_its_mirror_image(support, mirrored, clear):
    scale = gate.GATE_LIMITS.together_support
    together = SimpleNamespace(
        support=support * scale, mirrored_support=mirrored * scale, extent_is_plausible=True, extent_factor=1.0
    )
    telling = [SimpleNamespace(support=9.0, mirrored_support=0.0)] * 9
    assert gate._is_clear_together(telling, together) is clear


def test_ground_that_few_images_see_is_counted_where_any_sees_it():
    images = [[0, 1, 2], [figures.SIZES.fewest_views, 9, 0]]
    assert figures.seldom_seen({"images": images}) == pytest.approx(0.5)
    assert figures.seldom_seen({"images": [[0, 0]]}) == 0.0


@pytest.mark.parametrize("fewer", [False, True])
def test_less_memory_than_libraries_need_is_said(monkeypatch, fewer):
    resource = pytest.importorskip("resource")
    unlimited = (resource.RLIMIT_NOFILE, resource.RLIMIT_FSIZE)
    least = process.LEAST_BYTES + process.THREAD_BYTES
    monkeypatch.setattr("colmap_inertial.core.threads.usable_processors", lambda: 1)
    limits = {resource.RLIMIT_AS: least - fewer} | dict.fromkeys(unlimited, resource.RLIM_INFINITY)
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (limits[kind], limits[kind]))
    if not fewer:
        assert process.require_limits(to_load=False) is None
    else:
        with pytest.raises(InertialError, match="of memory are allowed to a process here"):
            process.require_limits(to_load=False)


def test_what_is_not_one_for_each_is_refused():
    with pytest.raises(ValueError, match="unique, one for each time"):
        FrameTiming(names=("a", "b", "a"), t_s=np.arange(3.0))
    known = {"latitude_deg": np.zeros(2), "longitude_deg": np.zeros(2), "names": ("a", "b")}
    with pytest.raises(ValueError, match="height_m: must be"):
        PositionFixes(**known, height_m=np.array([0.0, np.inf]), sigma_m=np.ones(2))


def test_a_column_that_falls_once_holds_no_times():
    t_s = np.arange(0.0, 1.0, 0.01)
    assert imu_text._time(np.stack([t_s, np.sin(t_s)], axis=1)) == (0, "s")
    t_s[50] -= 0.02
    assert imu_text._time(np.stack([t_s, np.sin(t_s)], axis=1))[0] is None


def test_ninety_five_per_cent_of_a_normal_distribution_lie_within():
    assert norm.cdf(Z95) - norm.cdf(-Z95) == pytest.approx(0.95, abs=1e-12)


def test_poses_of_a_rig_are_known_where_each_is_declared():
    declared, not_declared = (SimpleNamespace(cam_from_reference=pose) for pose in (np.eye(4), None))
    assert rigs.poses_are_known([declared, declared])
    assert not rigs.poses_are_known([declared, not_declared])


def test_a_box_of_cameras_alone_holds_them_all():
    box = transforms._box(np.array([[0.0, 0.0, 0.0], [4.0, 2.0, 1.0]]), np.zeros((0, 3)))
    assert np.allclose(np.array(box["offset"]) + box["scale"] * np.array([2.0, 1.0, 0.5]), 0.5)
    assert 0 < box["scale"] * 4.0 <= box["aabb_scale"]
