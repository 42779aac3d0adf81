"""The scale without an end of the recording."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.inertial import scale


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
                best, left_out = scale._estimate_without_moved_end(path, None, None, (whole, ()))
                assert set(left_out) == (misplaced if believed else set())
                assert best.cov[0, 0] == pytest.approx(sigma_without**2 if believed else 1.0)
