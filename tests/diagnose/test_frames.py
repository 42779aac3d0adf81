"""Checks of the frames."""

from types import SimpleNamespace

import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.diagnose.frames import _estimate_readout


def test_pictures_far_apart_tell_no_readout():
    with pytest.raises(NotObservableError, match="far apart"):
        _estimate_readout(SimpleNamespace(rotation=object(), aligned=None, imu=None, is_dense=False))
