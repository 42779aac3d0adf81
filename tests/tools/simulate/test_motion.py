"""The motion's derivatives are exact and its spectrum is that of real hands."""

import numpy as np
import pytest
from scipy.signal import welch

from colmap_inertial.core.geometry import quat_conjugate, quat_exp, quat_log, quat_multiply, quat_rotate
from colmap_inertial.tools.simulate import Motion, MotionOptions, make_motion
from colmap_inertial.tools.simulate.motion import HANDHELD, _draw_hand
from scripts.studies.compare_motion import compare

KINDS = ("orbit", "walk", "roam", "constant_velocity", "pure_rotation", "static")


def motion_of(kind, seed=0, **options):
    return make_motion(MotionOptions(kind=kind, **options), np.random.default_rng(seed))


def test_derivatives_agree_with_central_differences(subtests):
    for kind in KINDS:
        with subtests.test(kind=kind):
            motion, h = motion_of(kind, duration_s=20.0), 1e-4
            t = np.random.default_rng(1).uniform(0, 20, 200)
            before, at, after = motion.at(t - h), motion.at(t), motion.at(t + h)
            for value, derivative in (
                ("cam_in_world_m", "velocity_in_world_m_s"),
                ("velocity_in_world_m_s", "accel_in_world_m_s2"),
                ("rate_in_cam_rad_s", "rate_dot_in_cam_rad_s2"),
            ):
                difference = (getattr(after, value) - getattr(before, value)) / (2 * h)
                np.testing.assert_allclose(difference, getattr(at, derivative), atol=2e-4, rtol=1e-5)
            turn = quat_log(quat_multiply(quat_conjugate(before.world_from_cam_xyzw), after.world_from_cam_xyzw))
            np.testing.assert_allclose(turn / (2 * h), at.rate_in_cam_rad_s, atol=2e-5)
            np.testing.assert_array_equal(motion.rate_in_cam_rad_s(t), at.rate_in_cam_rad_s)
            np.testing.assert_array_equal(motion.cam_in_world_m(t), at.cam_in_world_m)


def test_a_motion_passes_through_its_samples_and_follows_a_known_curve():
    t = np.arange(200) / 50
    turn = np.stack([0.3 * np.sin(2 * t), 0.2 * np.cos(3 * t), 0.5 * t], axis=1)
    path = np.stack([np.sin(2 * t), np.cos(3 * t), t], axis=1)
    motion = Motion(start_s=0.0, step_s=1 / 50, cam_in_world_m=path, world_from_cam_xyzw=quat_exp(turn))
    inner = t[20:-20]
    np.testing.assert_allclose(motion.cam_in_world_m(inner), path[20:-20], atol=1e-9)
    np.testing.assert_allclose(
        quat_log(quat_multiply(quat_conjugate(motion.world_from_cam_xyzw(inner)), quat_exp(turn[20:-20]))), 0, atol=1e-8
    )
    between = inner[:-1] + 0.007
    accel = motion.at(between).accel_in_world_m_s2
    expected = np.stack([-4 * np.sin(2 * between), -9 * np.cos(3 * between), np.zeros_like(between)], axis=1)
    np.testing.assert_allclose(accel, expected, atol=1e-4)
    with pytest.raises(ValueError, match="between"):
        motion.at(np.array([5.0]))


def test_kinds_are_what_their_names_say():
    t = np.linspace(0, 30, 500)
    still = motion_of("static", duration_s=30.0).at(t)
    assert np.ptp(still.cam_in_world_m, axis=0).max() < 1e-12 and np.abs(still.rate_in_cam_rad_s).max() < 1e-12
    turning = motion_of("pure_rotation", duration_s=30.0).at(t)
    assert np.ptp(turning.cam_in_world_m, axis=0).max() < 1e-12 and turning.rate_in_cam_rad_s.std() > 0.3
    straight = motion_of("constant_velocity", duration_s=30.0, speed_m_s=0.6).at(t)
    np.testing.assert_allclose(np.linalg.norm(straight.velocity_in_world_m_s, axis=1), 0.6, atol=1e-9)
    assert np.abs(straight.accel_in_world_m_s2).max() < 1e-8
    walking = motion_of("walk", duration_s=30.0, vigour=0.0, speed_m_s=1.0).at(t)
    np.testing.assert_allclose(walking.velocity_in_world_m_s.mean(axis=0) @ [0, 0, 1], 0, atol=0.05)
    assert 0.5 < walking.accel_in_world_m_s2[:, 2].std() < 3.0  # the bob of the gait
    orbit = motion_of("orbit", duration_s=30.0, vigour=0.5)
    k = orbit.at(t)
    to_subject = -k.cam_in_world_m / np.linalg.norm(k.cam_in_world_m, axis=1, keepdims=True)
    optical_axis = quat_rotate(k.world_from_cam_xyzw, np.array([0.0, 0.0, 1.0]))
    angle = np.arccos(np.sum(optical_axis * to_subject, axis=1))
    assert np.rad2deg(angle).max() < 30
    assert k.cam_in_world_m[:, 2].min() > 0


def test_vigour_scales_the_hand_and_bad_options_are_rejected():
    t = np.linspace(0, 60, 3000)
    loud, soft = (motion_of("roam", vigour=v).at(t).cam_in_world_m for v in (1.0, 0.5))
    np.testing.assert_allclose(soft, 0.5 * loud, atol=1e-9)
    with pytest.raises(ValueError, match="duration_s"):
        MotionOptions(duration_s=0.0)


def test_the_hand_has_the_spectra_that_are_tabulated(subtests):
    """Power of velocities by Welch's method, the mean of ten hands; the table is interpolated in its logarithms."""
    for vigour in (1.0, 0.5):
        with subtests.test(vigour=vigour):
            hands = [_draw_hand(60 * 200, np.random.default_rng(s), low_hz=0.05, vigour=vigour) for s in range(10)]
            velocity = np.diff([np.concatenate(hand, axis=1) for hand in hands], axis=1) * 60
            frequency, power = welch(velocity, 60, nperseg=60 * 25, axis=1)
            power = power.mean(axis=0) / vigour**2
            # what a difference over a step leaves of a sine
            power /= np.sinc(frequency / 60)[:, None] ** 2
            inside = (frequency > 0.4) & (frequency < 9)
            tables = (
                [HANDHELD.horizontal_m2_s2_hz] * 2 + [HANDHELD.vertical_m2_s2_hz] + [HANDHELD.rotation_rad2_s2_hz] * 3
            )
            for column, table in enumerate(tables):
                log = np.interp(np.log(frequency[inside]), np.log(HANDHELD.frequency_hz), np.log(table))
                ratio = power[inside, column] / np.exp(log)
                assert np.exp(np.log(ratio).mean()) == pytest.approx(1, rel=0.1) and 0.3 < ratio.min() < ratio.max() < 3
            beyond = frequency > 16
            assert power[beyond].max() < 1e-3 * power[inside].min()


def test_without_a_hand_an_orbit_sweeps_its_arc_around_its_start():
    start, arc_deg, sweep_s = (1.0, -2.0, 0.5), 80.0, 5.0
    motion = motion_of(
        "orbit", vigour=0.0, duration_s=60.0, radius_m=2.0, height_m=0.6, arc_deg=arc_deg, sweep_s=sweep_s,
        heading_deg=30.0, start_m=start,
    )  # fmt: skip
    k = motion.at(np.linspace(0, 60, 2000))
    away = k.cam_in_world_m - start
    across = np.hypot(away[:, 0], away[:, 1])
    assert (across.min(), across.max()) == (pytest.approx(1.8, abs=0.01), pytest.approx(2.2, abs=0.01))
    assert (away[:, 2].min(), away[:, 2].max()) == (pytest.approx(0.48, abs=0.01), pytest.approx(0.72, abs=0.01))
    azimuth_deg = np.rad2deg(np.arctan2(away[:, 1], away[:, 0])) - 30
    assert (azimuth_deg.min(), azimuth_deg.max()) == (pytest.approx(-40, abs=0.1), pytest.approx(40, abs=0.1))
    # from one end to the other in a sweep
    ends = motion.at(np.array([0.0, sweep_s, 2 * sweep_s])).cam_in_world_m - start
    assert np.rad2deg(np.arctan2(ends[:, 1], ends[:, 0])) - 30 == pytest.approx([-40, 40, -40], abs=0.1)
    axes = quat_rotate(k.world_from_cam_xyzw[:, None, :], np.eye(3))
    assert (
        np.linalg.norm(np.cross(axes[:, 2], away), axis=1).max() < 1e-3
        and (np.sum(axes[:, 2] * away, axis=1) < 0).all()
    )
    assert np.abs(axes[:, 0, 2]).max() < 1e-3 and (axes[:, 1, 2] < 0).all()  # level, and not upside down


def test_spectrum_matches_the_motion_capture_recordings(shared_data):
    rows = compare(shared_data / "tumvi_mocap")
    assert len(rows) >= 14
    for row in rows:
        # the three rooms differ among themselves by up to a factor of two
        assert 0.6 < row.simulated / row.real < 1.6, row
