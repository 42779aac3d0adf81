"""Blur vectors at nodes."""

import numpy as np
import pytest

from colmap_inertial.imaging.psf import _fill_nodes


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
