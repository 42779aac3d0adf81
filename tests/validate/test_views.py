"""Views of a model."""

import pycolmap
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.validate.views import load_views


def test_a_model_without_poses_is_refused(tmp_path):
    with pytest.raises(FormatError, match="holds no image with a pose"):
        load_views(pycolmap.Reconstruction(), tmp_path)
