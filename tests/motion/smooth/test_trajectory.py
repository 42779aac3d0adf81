"""The motion model of the smoothed trajectory."""

import numpy as np
import pytest

from colmap_inertial.motion.smooth import _trajectory


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
