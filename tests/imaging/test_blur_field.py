"""Nodes of a blur field."""

import numpy as np
import pytest

from colmap_inertial.imaging.blur_field import check_nodes


def test_one_value_that_is_not_finite_is_enough_to_refuse_nodes():
    values = np.ones((2, 3))
    assert check_nodes("x", values, (2, 3)).dtype == np.float32
    values[1, 2] = np.nan
    with pytest.raises(ValueError, match="x: must be finite"):
        check_nodes("x", values, (2, 3))
