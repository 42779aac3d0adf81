"""The joint estimator over many simulated recordings, and the bound that it is measured against."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.tools.simulate import (
    ImuOptions,
    Motion,
    MotionOptions,
    RecordingOptions,
    SfmOptions,
    draw_imu_errors,
    simulate_recording,
)
from scripts.common import scale_bound as bound
from scripts.studies import scale as study

SWING_M, SWING_HZ = 0.2, 0.5
NO_NOISE = {
    f"{sensor}_{kind}": 0.0
    for sensor, kind in (
        ("gyro", "density_rad_s_rthz"),
        ("gyro", "walk_rad_s2_rthz"),
        ("accel", "density_m_s2_rthz"),
        ("accel", "walk_m_s3_rthz"),
    )
}
PERFECT_IMU = ImuOptions(**NO_NOISE, lever_arm_m_sd=(0.0, 0.0, 0.0))


def swing() -> Motion:
    """Back and forth along x, 8 s, without turning."""
    step_s = 1 / 60
    t_s = np.arange(-1.0, 9.0, step_s)
    position = np.zeros((len(t_s), 3))
    position[:, 0] = SWING_M * np.sin(2 * np.pi * SWING_HZ * t_s)
    turned = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    return Motion(start_s=-1.0, step_s=step_s, cam_in_world_m=position, world_from_cam_xyzw=turned)


def options(imu: ImuOptions, **sfm) -> RecordingOptions:
    quiet = {"position_correlated_m": 0.0, "rotation_correlated_rad": 0.0, "rotation_white_rad": 1e-6}
    return RecordingOptions(
        motion=MotionOptions(duration_s=8.0), imu=imu, sfm=SfmOptions(**{**quiet, "position_white_m": 1e-6, **sfm})
    )


def all_known(bound):
    """Priors under which nothing is open but the scale and where the path begins, and how fast."""
    names = {name: 0.0 for name in vars(bound.BoundPriors())}
    opened = {"log_scale": 10.0, "position_m": 100.0, "velocity_m_s": 100.0, "imu_in_cam_m": (0.0, 0.0, 0.0)}
    return bound.BoundPriors(**{**names, **opened})


def no_errors():
    return draw_imu_errors(replace(PERFECT_IMU, mounting_rad_sd=0.0), 8.0, np.random.default_rng(0))


def test_the_bound_is_that_of_a_regression_where_the_imu_is_perfect():
    motion, noise_m = swing(), 0.01
    what = options(PERFECT_IMU, position_white_m=noise_m)
    path = motion.cam_in_world_m(np.arange(240) / 30)
    # The origin of the model is open, so the path's mean says nothing
    expected = noise_m / np.sqrt(np.sum((path - path.mean(axis=0)) ** 2))
    priors = replace(all_known(bound), velocity_m_s=0.0)
    assert bound.scale_bound(motion, no_errors(), what, priors) == pytest.approx(expected, rel=1e-3)


def test_the_bound_is_that_of_the_accelerometer_where_the_poses_are_perfect():
    density = 0.01
    imu = replace(PERFECT_IMU, accel_density_m_s2_rthz=density)
    # Density over the root of the energy of the acceleration
    amplitude = SWING_M * (2 * np.pi * SWING_HZ) ** 2
    expected = density / np.sqrt(0.5 * amplitude**2 * 8.0)
    sigma = bound.scale_bound(swing(), no_errors(), options(imu), all_known(bound))
    assert sigma == pytest.approx(expected, rel=0.02)
    gain = replace(all_known(bound), accel_gain=0.005)
    # A gain is a scale: it adds in full
    assert bound.scale_bound(swing(), no_errors(), options(imu), gain) == pytest.approx(
        np.hypot(expected, 0.005), rel=0.02
    )


def test_more_noise_and_less_knowledge_raise_the_bound_and_more_motion_lowers_it():
    base = RecordingOptions(motion=MotionOptions(duration_s=10.0, vigour=0.5))
    recording = simulate_recording(base, seed=3)
    reference = bound.bound_of(recording, base)
    for part, name in (
        ("imu", "accel_density_m_s2_rthz"),
        ("imu", "gyro_density_rad_s_rthz"),
        ("imu", "accel_walk_m_s3_rthz"),
        ("sfm", "position_white_m"),
        ("sfm", "position_correlated_m"),
        ("sfm", "rotation_white_rad"),
    ):
        changed = replace(getattr(base, part), **{name: 5 * getattr(getattr(base, part), name)})
        assert bound.bound_of(recording, replace(base, **{part: changed})) > reference, name
    drifting = replace(base, sfm=replace(base.sfm, position_drift_m_rts=0.01))
    assert bound.bound_of(recording, drifting) > reference
    assert bound.bound_of(recording, base, bound.BoundPriors(accel_gain=0.02, model_scale=0.005)) > reference
    longer = replace(base, motion=replace(base.motion, duration_s=12.0))
    assert bound.bound_of(recording, longer) < reference
    # Priors that are meant to say nothing do not
    wide = bound.BoundPriors(log_scale=3.0, position_m=30.0, velocity_m_s=30.0, time_offset_s=0.3, attitude_rad=0.3)
    assert bound.bound_of(recording, base, wide) == pytest.approx(reference, rel=1e-3)
    with pytest.raises(ValueError, match="rolling shutter"):
        bound.bound_of(recording, replace(base, sfm=replace(base.sfm, readout_s=0.02)))


def test_a_seed_alone_reproduces_a_run():
    seed = study.seeds(0, (0, 1, 0, 0))[0]
    first, again = study.run(seed), study.run(seed)
    assert replace(first, seconds=0.0) == replace(again, seconds=0.0)
    assert first.part == "short" and 10 <= first.duration_s <= 30


def test_short_recordings_are_covered_and_close_to_the_bound():
    runs = [study.run(seed) for seed in study.seeds(100, (0, 16, 0, 0))]
    figures = study.summary(runs)
    given = figures["runs"] - figures["refused"]
    assert figures["refused"] <= 1
    # 95 % less three standard deviations
    assert figures["coverage"] >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / given)
    assert abs(figures["bias_sigmas"]) < 3 / np.sqrt(given)
    assert figures["rms_over_bound"] < 1.5
    assert 0.7 < figures["rms_sigma"] / figures["rms_bound"] < 1.4


def test_recordings_that_cannot_give_a_scale_are_refused():
    seconds = {seed: study.drawn(seed)[0].motion.duration_s for seed in study.seeds(0, (0, 0, 0, 120))}
    by_kind = {kind: list(seconds)[i :: len(study.FUTILE)] for i, kind in enumerate(study.FUTILE)}
    # of each kind the shortest of twenty, but not of those that are too short anyway
    runs = [
        study.run(some[0] if kind == "too_short" else min(some, key=seconds.__getitem__))
        for kind, some in by_kind.items()
    ]
    assert {r.kind for r in runs} == set(study.FUTILE)
    assert [(r.seed, r.kind) for r in runs if r.verdict != "refused"] == []
    assert all(r.error is None and r.reasons for r in runs)
