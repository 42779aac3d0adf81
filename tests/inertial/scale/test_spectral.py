"""The spectral scale estimate: right on simulated and real recordings, honest, and silent where it must be."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_exp, quat_multiply, so3_exp
from colmap_inertial.inertial.scale import spectral as spectral_module
from colmap_inertial.inertial.scale._spectra import Signals
from colmap_inertial.inertial.scale.spectral import SpectralOptions, estimate_spectral, fit_spectra
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.trajectories import read_inertial_scale
from colmap_inertial.motion.align import align_camera_imu
from colmap_inertial.tools.simulate import (
    IMU_PRESETS,
    MotionOptions,
    RecordingOptions,
    SfmOptions,
    simulate_recording,
)

RECORDINGS = ("D1", "D3", "D5", "D7", "D9", "D11", "D13", "D15")


def timed(trajectory, imu, calibration):
    return CameraTimedImu.from_recording(imu, calibration, trajectory.epoch_ns)


def spectral(trajectory, imu, calibration, options=None):
    """``estimate_spectral`` of a recording as it was read."""
    return estimate_spectral(trajectory, timed(trajectory, imu, calibration), options)


def known(simulated, **changes):
    """The true calibration as if it had been measured with the usual uncertainty."""
    truth = simulated.truth.calibration
    return replace(truth, cov=calibration_prior(Declared(cam_from_imu_xyzw=truth.cam_from_imu_xyzw)).cov, **changes)


def log_error(estimate, simulated):
    return float(np.log(estimate.metres_per_unit / simulated.truth.metres_per_unit))


@pytest.fixture(scope="module")
def handheld():
    return simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=30.0)), seed=1)


# --- simulation


@pytest.mark.parametrize("device", ["phone", "tablet"])
def test_intervals_cover_the_truth_and_nothing_pulls_the_scale(device):
    errors, sigmas, gravity, bias = [], [], [], []
    for seed in range(14):
        sfm = SfmOptions(readout_s=0.02 if device == "tablet" else 0.0)
        options = RecordingOptions(motion=MotionOptions(duration_s=25.0), imu=IMU_PRESETS[device], sfm=sfm)
        simulated = simulate_recording(options, seed=100 + seed)
        calibration = align_camera_imu(simulated.trajectory, simulated.imu)
        estimate = spectral(simulated.trajectory, simulated.imu, calibration)
        assert estimate.verdict in ("trusted", "weak")
        errors.append(log_error(estimate, simulated))
        sigmas.append(estimate.sigma_log)
        off = estimate.accel_bias_m_s2 - simulated.truth.accel_bias_m_s2
        bias.append(off @ np.linalg.solve(estimate.cov[4:, 4:], off) / 3)
        g = simulated.truth.gravity_in_world_m_s2
        across = np.cross(estimate.gravity_in_world_m_s2, g) / 9.80665**2
        gravity.append(np.degrees(np.linalg.norm(across)))
        assert np.linalg.norm(estimate.gravity_in_world_m_s2) == pytest.approx(9.80665)
    errors, sigmas = np.array(errors), np.array(sigmas)
    assert np.sum(np.abs(errors) < 1.96 * sigmas) >= 11  # fewer of 14 once in two hundred studies
    assert 0.4 < np.sqrt(np.mean((errors / sigmas) ** 2)) < 1.4
    assert abs(errors.mean()) < 2.5 * errors.std() / np.sqrt(len(errors)) + 0.001
    assert np.sqrt(np.mean(errors**2)) < 0.01
    assert np.max(gravity) < 0.6
    assert np.mean(bias) < 2.0


def test_the_unit_of_the_model_does_not_matter(handheld):
    here = spectral(handheld.trajectory, handheld.imu, known(handheld))
    centre = 1000 * handheld.trajectory.cam_in_world + np.array([5e4, 0.0, -3e4])
    there = spectral(replace(handheld.trajectory, cam_in_world=centre), handheld.imu, known(handheld))
    assert 1000 * there.metres_per_unit == pytest.approx(here.metres_per_unit, rel=1e-4)
    assert there.sigma_log == pytest.approx(here.sigma_log, rel=0.02)
    assert there.verdict == here.verdict == "trusted"


def test_a_turned_model_turns_gravity_and_nothing_else(handheld):
    here = spectral(handheld.trajectory, handheld.imu, known(handheld))
    turn = np.array([0.4, -1.1, 0.7])
    turned = replace(
        handheld.trajectory,
        cam_in_world=handheld.trajectory.cam_in_world @ so3_exp(turn).T,
        cam_from_world_xyzw=quat_multiply(handheld.trajectory.cam_from_world_xyzw, quat_exp(-turn)),
    )
    there = spectral(turned, handheld.imu, known(handheld))
    assert there.metres_per_unit == pytest.approx(here.metres_per_unit, rel=1e-5)
    assert np.allclose(there.gravity_in_world_m_s2, so3_exp(turn) @ here.gravity_in_world_m_s2, atol=1e-4)
    assert np.allclose(there.accel_bias_m_s2, here.accel_bias_m_s2, atol=1e-4)


def test_magnitudes_hardly_mind_a_wrong_time_offset(handheld):
    right = known(handheld)
    for late_s, limit in ((0.02, 0.01), (0.04, 0.03)):
        late = replace(right, accel_time_offset_s=right.accel_time_offset_s + late_s)
        estimate = spectral(handheld.trajectory, handheld.imu, late)
        assert abs(log_error(estimate, handheld)) < min(limit, 2 * estimate.sigma_log)


def test_noise_of_the_positions_does_not_shrink_the_scale():
    errors = []
    for seed in range(10):
        noisy = SfmOptions(position_white_m=0.01, position_correlated_m=0.0)
        options = RecordingOptions(motion=MotionOptions(duration_s=40.0), sfm=noisy)
        simulated = simulate_recording(options, seed=200 + seed)
        estimate = spectral(simulated.trajectory, simulated.imu, known(simulated))
        errors.append(log_error(estimate, simulated))
    assert abs(np.mean(errors)) < 0.007


def test_noise_of_the_positions_has_the_spectrum_that_is_stated():
    """White noise through the smoother and its second derivative, against the formula, to 2.5 Hz."""
    sfm = SfmOptions(position_white_m=0.02, position_correlated_m=0.0)
    simulated = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=60.0), sfm=sfm), seed=3)
    signals = Signals.of(simulated.trajectory, timed(simulated.trajectory, simulated.imu, known(simulated)))
    rng, pieces, power = np.random.default_rng(0), signals.pieces.copy(), []
    for _ in range(20):
        noise = signals.smoother.noise_sigma * rng.normal(size=(len(signals.t_s), 3))
        pieces[:, 0] = signals.smoother.accelerations_of(noise)
        spectra = replace(signals, pieces=pieces).spectra(2.5)
        power.append(np.mean(np.abs(spectra.visual) ** 2, axis=1))
    for low_hz in (0.5, 1.0, 1.5, 2.0):
        band = (spectra.frequency_hz > low_hz) & (spectra.frequency_hz < low_hz + 0.5)
        assert np.mean(power, axis=0)[band].sum() == pytest.approx(spectra.visual_noise[band].sum(), rel=0.1)


def test_gravity_s_strength_is_held_at_what_was_given(handheld):
    estimate = spectral(handheld.trajectory, handheld.imu, known(handheld), SpectralOptions(gravity_m_s2=9.78))
    assert np.linalg.norm(estimate.gravity_in_world_m_s2) == pytest.approx(9.78)


def test_a_jump_of_the_poses_and_missing_frames_are_survived(handheld):
    trajectory = handheld.trajectory
    centre = trajectory.cam_in_world.copy()
    centre[300:] += np.array([0.1, 0.05, -0.08]) / handheld.truth.metres_per_unit
    broken = replace(trajectory, cam_in_world=centre).select(
        np.flatnonzero((trajectory.t_s < 17.0) | (trajectory.t_s > 18.5))
    )
    estimate = spectral(broken, handheld.imu, known(handheld))
    assert abs(log_error(estimate, handheld)) < 3 * estimate.sigma_log
    assert estimate.verdict in ("trusted", "weak")


def test_derivatives_of_the_magnitudes_are_right(handheld):
    signals = Signals.of(handheld.trajectory, timed(handheld.trajectory, handheld.imu, known(handheld)))
    data = signals.spectra(1.2)
    prior = spectral_module._make_prior(known(handheld))
    state, noise = spectral_module._linear_start(data, prior, 9.80665)
    residual, jacobian = spectral_module._compare_magnitudes(data, noise, prior, state)
    for i, size in enumerate([1e-6, *[1e-6] * 6, 1e-7, 1e-7]):
        step = np.zeros(9)
        step[i] = size
        ahead, _ = spectral_module._compare_magnitudes(data, noise, prior, state.moved(step))
        behind, _ = spectral_module._compare_magnitudes(data, noise, prior, state.moved(-step))
        numeric = (ahead - behind) / (2 * size)
        assert np.allclose(jacobian[:, i], numeric, rtol=1e-3, atol=1e-3 * np.abs(jacobian[:, i]).max())
    assert len(residual) == 3 * len(data.frequency_hz) + 6


# --- refusals


@pytest.mark.parametrize("kind", ["static", "pure_rotation", "constant_velocity"])
def test_motion_without_acceleration_gives_no_number(kind):
    for seed in range(4):
        options = RecordingOptions(motion=MotionOptions(kind=kind, duration_s=10.0))
        simulated = simulate_recording(options, seed=seed)
        estimate = spectral(simulated.trajectory, simulated.imu, known(simulated))
        assert estimate.verdict == "refused"
        assert estimate.metres_per_unit is None
        assert any("record" in str(reason) or "swing" in str(reason) for reason in estimate.reasons)


def test_a_spoilt_accelerometer_gives_no_number(subtests, handheld):
    for label, spoil, reason in (
        ("sign", lambda accel: -accel, "not visible in|bias"),
        ("axes", lambda accel: accel[:, [1, 0, 2]], "not visible in|bias"),
        ("mirror", lambda accel: accel * [1, 1, -1], "not visible in|bias"),
        ("gravity removed", lambda accel: accel - accel.mean(axis=0), "bias"),
    ):
        with subtests.test(label):
            imu = replace(handheld.imu, accel_m_s2=spoil(handheld.imu.accel_m_s2))
            estimate = spectral(handheld.trajectory, imu, known(handheld))
            assert estimate.verdict == "refused"
            assert re.search(reason, " ".join(map(str, estimate.reasons)))


def test_what_cannot_be_differentiated_is_refused(handheld):
    calibration = known(handheld)
    sparse = handheld.trajectory.select(slice(None, None, 10))
    assert "joint" in str(spectral(sparse, handheld.imu, calibration).reasons[0])
    short = handheld.trajectory.select(slice(0, 60))
    assert "record longer" in str(spectral(short, handheld.imu, calibration).reasons[0])
    later = replace(handheld.imu, accel_t_s=handheld.imu.accel_t_s + 29.0)
    assert spectral(handheld.trajectory, later, calibration).verdict == "refused"
    frozen = replace(handheld.trajectory, cam_in_world=np.zeros_like(handheld.trajectory.cam_in_world))
    assert "does not move" in str(spectral(frozen, handheld.imu, calibration).reasons[0])
    # two frequencies of three axes tell less than nine numbers twice over
    with pytest.raises(NotObservableError, match="at least five seconds"):
        fit_spectra(SimpleNamespace(frequency_hz=np.array([0.5, 1.0])), calibration, 9.8)


# --- real recordings


@pytest.fixture(scope="module")
def recordings(shared_data):
    out = []
    for name in RECORDINGS:
        folder = shared_data / "inertial_scale" / name
        trajectory, imu = read_inertial_scale(folder)
        out.append((trajectory, imu, float((folder / "groundtruth.txt").read_text())))
    return out


@pytest.mark.parametrize(("seconds", "mean_pct"), [(60.1, 1.6), (10.0, 3.5)])
def test_real_recordings_have_the_published_accuracy_or_better(recordings, seconds, mean_pct):
    errors, inside = [], []
    for trajectory, imu, truth in recordings:
        part = trajectory.select(trajectory.t_s < trajectory.t_s[0] + seconds)
        estimate = spectral(part, imu, align_camera_imu(part, imu))
        assert estimate.verdict in ("trusted", "weak")
        errors.append(100 * abs(estimate.metres_per_unit / truth - 1))
        low, high = estimate.ci95
        inside.append(low < truth < high)
    assert np.mean(errors) < mean_pct
    assert np.sum(inside) >= 6


def test_another_recording_s_accelerometer_is_not_trusted(recordings):
    # even where somebody hands over an alignment for it
    trajectory, _, _ = recordings[0]
    own_trajectory, own_imu, _ = recordings[4]
    calibration = align_camera_imu(own_trajectory, own_imu)
    estimate = spectral(trajectory, own_imu, calibration)
    assert estimate.verdict != "trusted"
