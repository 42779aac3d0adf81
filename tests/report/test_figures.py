"""Figures of the report."""

import pytest

from colmap_inertial.report import figures


def test_residuals_on_the_sensor_are_lines_from_the_middles_of_its_parts():
    sensor = {
        "columns": 2,
        "rows": 2,
        "width": 200,
        "height": 100,
        "mean_x_px": [0.5, 0.0, -0.25, None],
        "mean_y_px": [0.0, 0.5, 0.25, None],
        "rms_px": [0.5, 0.5, 0.4, None],
    }
    figure = figures.residuals_on_sensor(sensor)
    lines = next(trace for trace in figure["data"] if trace["type"] == "scatter")
    # the largest is nine tenths of a part long
    assert lines["x"] == [50.0, 95.0, None, 150.0, 150.0, None, 50.0, 27.5, None]
    assert lines["y"] == [25.0, 25.0, None, 25.0, 70.0, None, 75.0, 97.5, None]


def test_ground_that_few_images_see_is_counted_where_any_sees_it():
    images = [[0, 1, 2], [figures.SIZES.fewest_views, 9, 0]]
    assert figures.seldom_seen({"images": images}) == pytest.approx(0.5)
    assert figures.seldom_seen({"images": [[0, 0]]}) == 0.0
