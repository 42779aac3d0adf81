"""Shift of keypoints by the camera's translation within a readout, once depths and velocities are known.

Keypoints that a gyroscope rectified lack the camera's turning, but each is still seen from where the camera was when
its line was exposed. A model gives the depth of each point, and with the camera's velocity where it would have been
seen at the instant that the pose holds; bundle adjustment of those gives the model of a global shutter.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.model.rigs import has_rigs

if TYPE_CHECKING:
    import pycolmap


#: Smaller shifts are not worth a bundle adjustment (median over the frames of the 90th percentile within).
_LEAST_SHIFT_PX = 0.05


@dataclass(frozen=True, kw_only=True)
class Settled:
    """Outcome for one model.

    Attributes
    ----------
    shift_px
        By how much observations move: median over the images of the 90th percentile within each.
    before_px, after_px
        Mean reprojection error.
    accepted
        Whether the model was changed: only where the shifts matter and bring it closer to its observations.
    """

    shift_px: float
    before_px: float
    after_px: float
    accepted: bool


def settle_readout(
    reconstruction: pycolmap.Reconstruction,
    shutters: Mapping[str, FrameShutter],
    velocity_in_world: Mapping[str, Array],
    *,
    refine_intrinsics: bool,
    num_threads: int = -1,
) -> tuple[pycolmap.Reconstruction, Settled]:
    """Take the camera's translation within the readout out of a model's observations, and adjust it to them.

    Parameters
    ----------
    reconstruction
        Mapped from keypoints without the camera's rotation within the readout; not changed.
    shutters
        By image name, when its lines were exposed; images without one stay as they are.
    velocity_in_world
        By image name, (3,) of the camera at the instant its pose holds, model units per second.
    refine_intrinsics
        Whether bundle adjustment may change the cameras.
    num_threads
        Of bundle adjustment; all where negative.

    Returns
    -------
    A new model, whose observations lie where a global shutter would have seen them (to first order in the readout
    time), and what it is worth; the given model where it is worth nothing.
    """
    import pycolmap

    before_px = float(reconstruction.compute_mean_reprojection_error())
    settled = pycolmap.Reconstruction(reconstruction)
    shifts = [
        _shift(settled, settled.image(i), shutters[name], velocity_in_world[name])
        for i in settled.reg_image_ids()
        if (name := settled.image(i).name) in shutters and name in velocity_in_world
    ]
    shift_px = float(np.median([float(np.percentile(s, 90)) for s in shifts if len(s)] or [0.0]))
    if shift_px < _LEAST_SHIFT_PX:
        return reconstruction, Settled(shift_px=shift_px, before_px=before_px, after_px=before_px, accepted=False)
    options, config = _prepare_adjustment(settled.reg_image_ids(), refine_intrinsics=refine_intrinsics)
    solver: Any = getattr(options, "ceres", options)  # COLMAP 4.2 keeps the solver apart
    solver.solver_options.num_threads = num_threads
    # pycolmap.bundle_adjustment would switch COLMAP's log back on
    pycolmap.create_default_bundle_adjuster(options, config, settled).solve()
    settled.update_point_3d_errors()
    after_px = float(settled.compute_mean_reprojection_error())
    accepted = after_px < before_px
    what = Settled(shift_px=shift_px, before_px=before_px, after_px=after_px, accepted=accepted)
    return settled if accepted else reconstruction, what


def _shift(
    reconstruction: pycolmap.Reconstruction, image: pycolmap.Image, shutter: FrameShutter, velocity: Array
) -> Array:
    """Move an image's observations of points; (N,) by how many px."""
    camera, pose = reconstruction.camera(image.camera_id), image.cam_from_world()
    points = image.points2D
    seen = [i for i in range(len(points)) if points[i].has_point3D()]
    if not seen:
        return np.zeros(0)
    rotation = pose.rotation.matrix()
    world = np.array([reconstruction.points3D[points[i].point3D_id].xyz for i in seen])
    at = np.array([points[i].xy for i in seen])
    late_s = shutter.middle_s(at) - shutter.reference_s()
    now = world @ rotation.T + pose.translation
    then = now - late_s[:, None] * (rotation @ velocity)
    shift = np.asarray(camera.img_from_cam(now)) - np.asarray(camera.img_from_cam(then))
    good = np.isfinite(shift).all(axis=1)
    for i, xy in zip(np.array(seen)[good], (at + shift)[good], strict=True):
        points[i].xy = xy
    return np.asarray(np.linalg.norm(shift[good], axis=1))


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
    points are unknowns beside them (COLMAP's covariance of a bundle adjustment). Empty for very large models, for rigs,
    which COLMAP's covariance does not take, and where the covariance does not exist.
    """
    import pycolmap

    image_ids = sorted(reconstruction.reg_image_ids())
    if not 3 <= len(image_ids) <= _MOST_IMAGES or has_rigs(reconstruction):
        return {}
    noise_px = _noise_px(reconstruction)
    if noise_px is None:
        return {}
    model = pycolmap.Reconstruction(reconstruction)
    options, config = _prepare_adjustment(image_ids, refine_intrinsics=True)
    wanted = pycolmap.BACovarianceOptions()
    wanted.params = pycolmap.BACovarianceOptionsParams.ALL
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    covariance = pycolmap.estimate_ba_covariance(wanted, model, adjuster)
    if covariance is None:
        return {}
    sigma_of = {}
    for number in {model.image(i).camera_id for i in image_ids}:
        camera = model.camera(number)
        block = covariance.get_other_params_cov(camera.params)
        free = np.ones(len(camera.params), dtype=bool)
        free[list(camera.principal_point_idxs())] = False
        if block is None or len(block) != free.sum():
            continue
        sigma = np.full(len(free), np.nan)
        sigma[free] = noise_px * np.sqrt(np.diag(block))
        sigma_of[number] = sigma
    return sigma_of


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


def _prepare_adjustment(
    image_ids: Iterable[int], *, refine_intrinsics: bool
) -> tuple[pycolmap.BundleAdjustmentOptions, pycolmap.BundleAdjustmentConfig]:
    """Options and images of a bundle adjustment; the principal point is held."""
    import pycolmap

    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.refine_focal_length = options.refine_extra_params = refine_intrinsics
    options.refine_principal_point = options.print_summary = False
    for image_id in image_ids:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return options, config
