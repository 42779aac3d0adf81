"""Walks for the tests of the refinement: the true calibration as what was known before."""

from dataclasses import replace

import numpy as np

from colmap_inertial.core.types import CameraModel, ImuNoise
from colmap_inertial.inertial.refine.setup import Known, Seen, make_problem, read_seen
from colmap_inertial.inertial.refine.values import Estimate, Problem
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.tools.simulate.motion import MotionOptions
from colmap_inertial.tools.simulate.tracks import TrackOptions, Tracks, simulate_tracks

PINHOLE = CameraModel(model="PINHOLE", width=1280, height=960, params=(1000.0, 990.0, 640.0, 480.0))


def walk(seconds: float, *, readout_s: float = 0.0, points_per_m: float = 60.0, **options) -> TrackOptions:
    """A short walk with a phone."""
    motion = MotionOptions(kind="walk", duration_s=seconds, speed_m_s=1.0, vigour=0.6, look_deg=40.0)
    return TrackOptions(motion=motion, readout_s=readout_s, points_per_m=points_per_m, **options)


def tracks_of(options: TrackOptions, seed: int = 1) -> Tracks:
    """The tracks, with a clock that keeps step."""
    return simulate_tracks(replace(options, imu=replace(options.imu, clock_rate_sd=0.0)), seed=seed)


def known_of(tracks: Tracks, options: TrackOptions, *, refine_intrinsics: bool = True) -> Known:
    """What an estimate of the scale would say, without its errors."""
    return Known(
        calibration=tracks.calibration,
        prior=calibration_prior(),
        noise=ImuNoise(
            gyro_density_rad_s_rthz=options.imu.gyro_density_rad_s_rthz,
            accel_density_m_s2_rthz=options.imu.accel_density_m_s2_rthz,
            gyro_walk_rad_s2_rthz=1e-4,
            accel_walk_m_s3_rthz=3e-4,
        ),
        accel_bias_m_s2=tracks.sampled.accel_bias_m_s2.mean(axis=0),
        down=np.array([0.0, 0.0, -1.0]),
        gravity_m_s2=9.80665,
        gravity_sigma_m_s2=5e-4,
        refine_intrinsics=refine_intrinsics,
    )


def problem_of(tracks: Tracks, options: TrackOptions, **known) -> tuple[Problem, Estimate, Seen]:
    """The refinement of the true model by noisy observations."""
    seen = read_seen(tracks.reconstruction(), tracks.timing)
    problem, start = make_problem(
        seen, tracks.timing, tracks.imu, known_of(tracks, options, **known), seen.observations.xy_px
    )
    return replace(problem, sigma_px=options.noise_px), start, seen


def nudged(x: Estimate, rng: np.random.Generator, size: float = 1e-3) -> Estimate:
    """An estimate a little off, in all that it has but the cameras."""
    shared = size * rng.standard_normal(x.columns.count)
    shared[9 : x.columns.seen.stop] = 0.0
    shared[6:9] *= [1.0, 1e-2, 1.0]
    return x.moved(
        size * rng.standard_normal((len(x.velocity_m_s), 15)), shared, 10 * size * rng.standard_normal(x.points_m.shape)
    )
