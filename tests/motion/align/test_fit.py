"""Noise of the poses and of the gyroscope in the residuals of an alignment."""

import numpy as np
import pytest

from colmap_inertial.motion.align._fit import _estimate_noise


def test_estimate_noise_poses_and_gyroscope_is_told_apart(subtests):
    for pose_rad, rate_rad_rts in ((2e-3, 4e-3), (1e-3, 2e-3), (4e-4, 8e-3)):
        with subtests.test(pose_rad=pose_rad, rate_rad_rts=rate_rad_rts):
            rng, dt_s = np.random.default_rng(1), np.full(3000, 0.2)
            poses = pose_rad * rng.standard_normal((3001, 3))
            residual = np.diff(poses, axis=0) + rate_rad_rts * np.sqrt(dt_s)[:, None] * rng.standard_normal((3000, 3))
            pose, rate = _estimate_noise(residual, dt_s, np.ones(3000), 1e-12)
            assert np.sqrt(pose) == pytest.approx(pose_rad, rel=0.15)
            assert np.sqrt(rate) == pytest.approx(rate_rad_rts, rel=0.1)
