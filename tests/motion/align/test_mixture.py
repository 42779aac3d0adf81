"""Wrong rotations among sound ones, as those of two views are, neither hide an offset between clocks nor make one."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_conjugate, quat_cumulative, quat_exp, quat_log, quat_multiply
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.motion.align import align_clocks
from colmap_inertial.motion.align._robust import fit_mixture
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording


def recorded(seed, duration_s=24.0):
    return simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=duration_s)), seed=seed)


def two_views(trajectory, seed, *, wrong, still=False, every=6, sigma_deg=0.1):
    """Rotations chained from one frame to the next, a share of them wrong by half a degree to nine; the second half
    may stand still, as the gyroscope then has to (:func:`at_rest`)."""
    rng = np.random.default_rng(seed)
    part = trajectory.select(slice(None, None, every))
    pose = part.cam_from_world_xyzw
    turn = quat_log(quat_multiply(pose[:-1], quat_conjugate(pose[1:])))
    turn = turn + np.radians(sigma_deg) * rng.standard_normal(turn.shape)
    if still:
        later = part.t_s[:-1] >= middle_s(trajectory)
        turn[later] = np.radians(0.01) * rng.standard_normal((int(later.sum()), 3))
    which = rng.random(len(turn)) < wrong
    axis = rng.standard_normal((len(turn), 3))
    axis *= np.radians(rng.uniform(0.5, 9, len(turn)))[:, None] / np.linalg.norm(axis, axis=1)[:, None]
    chained = quat_cumulative(quat_exp(turn + which[:, None] * axis))
    return CameraTrajectory(
        names=part.names,
        t_s=part.t_s,
        cam_from_world_xyzw=quat_conjugate(chained),
        cam_in_world=np.zeros((len(part), 3)),
        epoch_ns=part.epoch_ns,
    )


def middle_s(trajectory):
    return 0.5 * float(trajectory.t_s[0] + trajectory.t_s[-1])


def at_rest(recording):
    """The gyroscope of a camera that is put down halfway."""
    imu, offset_s = recording.imu, recording.truth.calibration.gyro_time_offset_s
    shift_s = (imu.epoch_ns - recording.trajectory.epoch_ns) * 1e-9
    moving = imu.gyro_t_s + offset_s + shift_s < middle_s(recording.trajectory)
    rate, bias = imu.gyro_rad_s, recording.truth.calibration.gyro_bias_rad_s
    return replace(
        imu, gyro_rad_s=np.where(moving[:, None], rate, bias + 1e-3 * np.sin(np.arange(rate.size)).reshape(-1, 3))
    )


@pytest.mark.parametrize("still", [False, True], ids=["moving", "half at rest"])
@pytest.mark.parametrize("wrong", [0.05, 0.15, 0.3])
def test_clocks_are_aligned_by_the_rotations_that_are_sound(wrong, still):
    for seed in range(2):
        recording = recorded(seed)
        imu = at_rest(recording) if still else recording.imu
        found = align_clocks(two_views(recording.trajectory, seed, wrong=wrong, still=still), imu).calibration
        true = recording.truth.calibration
        off = quat_log(quat_multiply(found.cam_from_imu_xyzw, quat_conjugate(true.cam_from_imu_xyzw)))
        assert abs(found.gyro_time_offset_s - true.gyro_time_offset_s) < 0.01
        assert np.degrees(np.linalg.norm(off)) < 1.5


@pytest.mark.parametrize("still", [False, True], ids=["moving", "half at rest"])
def test_what_does_not_belong_is_refused_with_wrong_rotations_too(still):
    recording, other = recorded(0), recorded(7)
    imu, stranger = (at_rest(one) if still else one.imu for one in (recording, other))
    poses = two_views(recording.trajectory, 0, wrong=0.15, still=still)
    align_clocks(poses, imu)
    late = replace(poses, t_s=poses.t_s + 6.0)  # beyond the reach of ten standard deviations
    offset_s = recording.truth.calibration.gyro_time_offset_s
    near = calibration_prior(Declared(gyro_time_offset_s=offset_s, time_offset_sigma_s=0.5))
    align_clocks(poses, imu, prior=near)
    for kind, (seen, felt, prior) in {
        "stranger": (poses, stranger, None),
        "mirrored": (poses, replace(imu, gyro_rad_s=imu.gyro_rad_s * [1.0, 1.0, -1.0]), None),
        "degrees": (poses, replace(imu, gyro_rad_s=np.degrees(imu.gyro_rad_s)), None),
        "half as fast": (poses, replace(imu, gyro_rad_s=0.45 * imu.gyro_rad_s), None),
        "another clock": (late, imu, near),
    }.items():
        with pytest.raises(NotObservableError):
            align_clocks(seen, felt, prior=prior)
            pytest.fail(kind)


def mixture_of(turn, felt, dt_s):
    """Of rotations that are those of the gyroscope, without a rotation between the two nor a bias."""
    nothing = np.zeros((1, 3))
    return fit_mixture(
        turn,
        felt[None],
        dt_s,
        np.ones((1, len(turn)), dtype=np.bool_),
        moments=lambda weight: (np.eye(3)[None], nothing, nothing),
        best_rotation=lambda cross: cross,
    )


def test_the_share_of_wrong_rotations_is_found():
    rng = np.random.default_rng(1)
    felt = 0.1 * rng.standard_normal((4000, 3))
    for share in (0.1, 0.3, 0.45):
        wrong = rng.random(4000) < share
        turn = felt + 0.005 * rng.standard_normal(felt.shape)
        turn[wrong] = 0.1 * rng.standard_normal((int(wrong.sum()), 3))
        found = mixture_of(turn, felt, np.full(4000, 0.2))
        assert found.sound[0] == pytest.approx(1 - share, abs=0.03)
        assert found.gain[0] == pytest.approx(1, abs=0.01)
        # nothing but what agrees is evidence, however far the rest is off
        further = np.where(wrong[:, None], 20 * turn, turn)
        assert mixture_of(further, felt, np.full(4000, 0.2)).log_likelihood[0] == pytest.approx(
            found.log_likelihood[0], rel=0.1
        )


def test_rest_is_no_evidence():
    rng = np.random.default_rng(2)
    moving, still = 0.1 * rng.standard_normal((100, 3)), 1e-4 * rng.standard_normal((4000, 3))
    felt = np.concatenate([moving, still])
    elsewhere = np.concatenate([0.1 * rng.standard_normal((100, 3)), still])
    assert mixture_of(elsewhere, felt, np.full(4100, 0.2)).log_likelihood[0] < 12
    assert mixture_of(felt, felt, np.full(4100, 0.2)).log_likelihood[0] > 300
