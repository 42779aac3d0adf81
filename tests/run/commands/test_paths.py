"""Folders that hold models."""

import pycolmap
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.run.commands.paths import only_model


def test_a_folder_of_several_models_is_refused(tmp_path):
    for name in "01":
        (tmp_path / name).mkdir()
        pycolmap.Reconstruction().write_binary(str(tmp_path / name))
    with pytest.raises(FormatError, match="holds 2 models; give one of them"):
        only_model(tmp_path)
