"""Scale of a path of any unit by positions of a receiver, against known paths with errors that are alike for a time."""

import math

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import so3_exp
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.evidence.positions import scale_by_positions
from tests.helpers.position_walks import UP, walk

UNIT_M = 0.3


def turn(seed):
    return so3_exp(np.random.default_rng(900 + seed).uniform(-1.8, 1.8, 3))


def path_of(taken, seed):
    """The path of a walk in a world of its own."""
    count = len(taken.t_s)
    return CameraTrajectory(
        names=tuple(map(str, range(count))),
        t_s=taken.t_s,
        epoch_ns=0,
        cam_from_world_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        cam_in_world=taken.path_m @ turn(seed).T / UNIT_M,
    )


@pytest.mark.parametrize("knows_up", [True, False])
def test_the_interval_of_the_scale_holds(knows_up):
    z, tilts = [], []
    for seed in range(30):
        taken = walk(seed, seconds=90, white_m=0.5, slow_m=1.0)
        up = turn(seed) @ UP
        try:
            found = scale_by_positions(taken.fixes, path_of(taken, seed), up_in_world=up if knows_up else None)
        except NotObservableError as error:
            assert error.fact.code == "positions-leave-up-open" and not knows_up
            continue
        z.append((found.evidence.log_scale - math.log(UNIT_M)) / found.evidence.sigma)
        tilts.append(math.acos(min(found.up_in_world @ up, 1.0)))
        assert tilts[-1] <= 4 * found.tilt_rad + 1e-6
    assert len(z) > 20
    assert np.mean(np.abs(z) < 1.96) > 0.95 - 3 * math.sqrt(0.95 * 0.05 / len(z))


def refused(fixes, path, **known):
    with pytest.raises(NotObservableError) as error:
        scale_by_positions(fixes, path, **known)
    return error.value.fact.code


def test_what_positions_leave_open_is_said():
    taken = walk(3)
    path = path_of(taken, 3)
    assert refused(taken.fixes.select(np.arange(60) < 3), path) == "positions-too-few"
    short = walk(4, seconds=60, white_m=3.0, steps=0.004)
    assert refused(short.fixes, path_of(short, 4)) == "positions-leave-up-open"
    assert refused(short.fixes, path_of(short, 4), up_in_world=turn(4) @ UP) == "heading-unsure"
