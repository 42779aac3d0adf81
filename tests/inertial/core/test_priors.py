"""Priors of the IMU's gains."""

from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.types import IMU_CAL, IMU_CALIBRATION_PARAMETERS
from colmap_inertial.inertial.core.priors import gains_cov


def test_gains_stay_unknown_as_a_calibration_says_and_by_what_moved_since():
    cov = np.diag(np.arange(1.0, len(IMU_CALIBRATION_PARAMETERS) + 1)) * 1e-6
    of = SimpleNamespace(accel_factor=np.eye(3), cov=cov)
    entries = np.r_[IMU_CAL.ACCEL_GAIN, IMU_CAL.GYRO_GAIN]
    np.testing.assert_allclose(gains_cov(SimpleNamespace(calibration=of)), cov[np.ix_(entries, entries)])
    with pytest.raises(ValueError, match="not corrected by a calibration"):
        gains_cov(SimpleNamespace(calibration=None))
