"""How well a model's points know the intrinsics of its cameras."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array

if TYPE_CHECKING:
    import pycolmap

#: Images up to which the covariance of all poses is inverted at once: its memory grows with their square.
_MOST_IMAGES = 400


def intrinsics_sigma(reconstruction: pycolmap.Reconstruction) -> dict[int, Array]:
    """Standard deviations of the cameras' parameters, by a camera's number.

    Parameters
    ----------
    reconstruction
        Stays as it is. Its residuals say how well keypoints are measured: their noise is taken as white, and equal in
        all images.

    Returns
    -------
    (P,) in the order of the camera's parameters, NaN for the principal point, which is held, as COLMAP does. Poses and
    points are unknowns beside them (COLMAP's covariance of a bundle adjustment). Empty for very large models, and where
    the covariance does not exist.
    """
    import pycolmap

    image_ids = sorted(reconstruction.reg_image_ids())
    if not 3 <= len(image_ids) <= _MOST_IMAGES:
        return {}
    noise_px = _noise_px(reconstruction)
    if noise_px is None:
        return {}
    model = pycolmap.Reconstruction(reconstruction)
    config = pycolmap.BundleAdjustmentConfig()
    for i in image_ids:
        config.add_image(i)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = True
    options.refine_principal_point = options.print_summary = False
    wanted = pycolmap.BACovarianceOptions()
    wanted.params = pycolmap.BACovarianceOptionsParams.ALL
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    covariance = pycolmap.estimate_ba_covariance(wanted, model, adjuster)
    if covariance is None:
        return {}
    found = {}
    for number in {model.image(i).camera_id for i in image_ids}:
        camera = model.camera(number)
        block = covariance.get_other_params_cov(camera.params)
        free = np.ones(len(camera.params), dtype=bool)
        free[list(camera.principal_point_idxs())] = False
        if block is None or len(block) != free.sum():
            continue
        sigma = np.full(len(free), np.nan)
        sigma[free] = noise_px * np.sqrt(np.diag(block))
        found[number] = sigma
    return found


def _noise_px(reconstruction: pycolmap.Reconstruction) -> float | None:
    """Standard deviation of a keypoint's coordinate by the residuals, less what poses and points adapt to."""
    points = [p for p in reconstruction.points3D.values() if p.has_error()]
    observations = sum(p.track.length() for p in points)
    free = 2 * observations - 3 * len(points) - 6 * reconstruction.num_reg_images()
    if free <= 0:
        return None
    # a point's error is the mean length of its residuals, whose square is 4 / pi times smaller than their mean square
    squares = sum(p.track.length() * p.error**2 for p in points) * 4 / np.pi
    return float(np.sqrt(squares / free))
