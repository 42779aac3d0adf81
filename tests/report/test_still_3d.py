"""Still pictures of scenes."""

import numpy as np
import pytest

from colmap_inertial.report import still_3d


def test_a_still_scene_fills_its_picture_and_stays_inside():
    corners = np.array([[x, y, z] for x in (-2.0, 3.0) for y in (0.0, 1.0) for z in (0.0, 4.0)])
    trace = {"mode": "lines", "name": "camera path", **dict(zip("xyz", corners.T.tolist(), strict=True))}
    view = still_3d.StillView()
    seen, near = still_3d._Projection(view, [trace])(corners)
    first, last = seen.min(axis=0), seen.max(axis=0)
    margin = np.array([first, [view.width, view.height - 16] - last])
    assert margin.min() >= view.margin - 1e-6
    assert np.isclose(margin, view.margin, atol=2.1).all(axis=0).any()  # the length or the height is full
    # what is nearer to the eye is larger, and what stands up goes up
    assert np.all(seen[1::2, 1] < seen[::2, 1])
    a, e = np.radians([view.azimuth_deg, view.elevation_deg])
    towards = corners @ [np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]
    assert np.array_equal(np.argsort(near.ravel()), np.argsort(towards))


def test_lines_of_a_still_scene_are_half_as_wide_and_a_pixel_at_least():
    widths = [still_3d._look({"line": {"color": "red", "width": width}})["width"] for width in (1, 4)]
    assert widths == [1.0, pytest.approx(2.2)]
