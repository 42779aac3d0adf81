"""``scale`` of a device's own export: one table by all its sensors."""

import numpy as np
import pytest

from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.run.commands.scale import ScaleSource, scale_source
from tests.helpers.json_schemas import find_violations
from tests.io.test_depth_maps import write_polycam


def test_a_real_iphone_s_imu_and_lidar_agree_and_arkit_is_short(shared_data, tmp_path):
    out = tmp_path / "scale.json"
    estimate = scale_source(ScaleSource(source=shared_data / "iphone_lidar"), ScaleOptions(), json=out)
    combined = estimate.sensors
    assert combined is not None and combined.device is not None
    imu, depth = combined.of("imu"), combined.of("depth")
    assert imu is not None and depth is not None
    assert abs(imu.log_scale - depth.log_scale) < 1.96 * np.hypot(imu.sigma, depth.sigma)
    # by depth of frames registered to each other elsewhere: 1.030 +- .005, one standard deviation
    assert abs(depth.log_scale - np.log(1.030)) < 2 * np.hypot(depth.random_sigma, 0.005)
    assert combined.device.log_error + 1.96 * combined.device.sigma < 0
    assert combined.verdict == "trusted" and estimate.metres_per_unit == combined.metres_per_unit
    assert find_violations("scale", out) == []


def test_an_export_without_imu_or_enough_depth_says_so_and_has_the_device_s_metres(tmp_path):
    write_polycam(tmp_path / "export")
    estimate = scale_source(ScaleSource(source=tmp_path / "export"), ScaleOptions())
    assert estimate.sensors is not None
    assert {one.sensor for one in estimate.sensors.absent} == {"imu", "depth"}
    assert estimate.sensors.metres_per_unit == pytest.approx(1.0)
    assert estimate.verdict == "weak" and estimate.sensors.device is None
