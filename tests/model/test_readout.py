"""Noise of a model's observations."""

import pycolmap
import pytest

from colmap_inertial.model.readout import _noise_px


def test_noise_is_told_by_what_poses_and_points_do_not_adapt_to(subtests):
    for points, known in ((12, False), (400, True)):
        with subtests.test(points=points, known=known):
            pycolmap.set_random_seed(4)
            options = pycolmap.SyntheticDatasetOptions()
            options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 2 if points == 12 else 8
            options.num_points3D = points
            model = pycolmap.synthesize_dataset(options)
            noise = pycolmap.SyntheticNoiseOptions()
            noise.point2D_stddev = 0.4
            pycolmap.synthesize_noise(noise, model)
            adjusted = pycolmap.BundleAdjustmentOptions()
            adjusted.print_summary = adjusted.refine_focal_length = adjusted.refine_extra_params = False
            if known:
                pycolmap.bundle_adjustment(model, adjusted)
            model.update_point_3d_errors()
            found = _noise_px(model)
            # two images of twelve points have as many numbers as poses and points
            assert found == (pytest.approx(0.4, rel=0.1) if known else None)
