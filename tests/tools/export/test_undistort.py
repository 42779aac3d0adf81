"""How much of a distorted picture a pinhole shows: nothing beyond it, and no less than that allows."""

from itertools import product

import numpy as np
import pycolmap

from colmap_inertial.tools.export import undistort


def test_the_pinhole_s_picture_is_filled_and_as_large_as_that_allows(subtests):
    side = np.linspace(-1, 1, 201)
    border = np.concatenate([np.stack(np.broadcast_arrays(side, s), 1) for s in (-1.0, 1.0)])
    border = np.concatenate([border, border[:, ::-1]])
    # the corners of a barrel's rectangle lie inside, those of a cushion's sides, too
    middles = np.isclose(border, 0.0).any(axis=1)

    def shown_px(camera, share):
        return camera.img_from_cam(np.c_[border * undistort._half_extent(camera) * share, np.ones(len(border))])

    for centre, k1 in product(((320.0, 240.0), (300.0, 255.0)), (-0.15, 0.12, 0.0)):
        with subtests.test(centre=centre, k1=k1):
            params = [500.0, 510.0, *centre, k1, 0.0, 0.002, -0.001]
            camera = pycolmap.Camera(camera_id=1, model="OPENCV", width=640, height=480, params=params)
            xy_px = shown_px(camera, 1.0)
            assert np.maximum(-xy_px, xy_px - [640, 480])[middles].max() < 0.5
            # along each axis, one step further there is nothing to show
            for axis, share in enumerate(([1.01, 1.0], [1.0, 1.01])):
                beyond = shown_px(camera, share)
                assert max(-beyond[:, axis].min(), beyond[:, axis].max() - (640, 480)[axis]) > 0.5
