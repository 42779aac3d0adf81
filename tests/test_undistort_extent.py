"""How much of a distorted picture a pinhole shows: nothing beyond it, and no less than that allows."""

import numpy as np
import pycolmap
import pytest

from colmap_inertial.tools.export import undistort


@pytest.mark.parametrize("k1", [-0.15, 0.12, 0.0])
@pytest.mark.parametrize("centre", [(320.0, 240.0), (300.0, 255.0)], ids=["centred", "off centre"])
def test_the_pinhole_s_picture_is_filled_and_as_large_as_that_allows(k1, centre):
    camera = pycolmap.Camera(
        camera_id=1, model="OPENCV", width=640, height=480, params=[500.0, 510.0, *centre, k1, 0.0, 0.002, -0.001]
    )
    reach = undistort._half_extent(camera)
    side = np.linspace(-1, 1, 201)
    border = np.concatenate([np.stack(np.broadcast_arrays(side, s), 1) for s in (-1.0, 1.0)])
    border = np.concatenate([border, border[:, ::-1]])

    def outside(share):
        xy_px = camera.img_from_cam(np.c_[border * reach * share, np.ones(len(border))])
        return np.maximum(-xy_px, xy_px - [640, 480])

    # the corners of a barrel's rectangle lie inside, those of a cushion's sides, too
    middles = np.isclose(border, 0.0).any(axis=1)
    assert outside(1.0)[middles].max() < 0.5
    # along each axis, one step further there is nothing to show
    for axis, share in enumerate(([1.01, 1.0], [1.0, 1.01])):
        beyond = camera.img_from_cam(np.c_[border * reach * share, np.ones(len(border))])
        assert max(-beyond[:, axis].min(), beyond[:, axis].max() - (640, 480)[axis]) > 0.5
