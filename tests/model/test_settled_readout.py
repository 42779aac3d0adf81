"""The camera's translation within the readout, taken out of a model: against exact rolling-shutter projections."""

import numpy as np
import pycolmap
import pytest

from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.model.readout import settle_readout

WIDTH, HEIGHT, READOUT_S = 640, 480, 0.03
SPEED = 1.5


@pytest.fixture(scope="module")
def truth():
    """A model of a global shutter: cameras on an arc around points, each with a velocity."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 12
    options.num_points3D = 300
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = pycolmap.CameraModelId.PINHOLE
    options.camera_params = [500.0, 500.0, WIDTH / 2, HEIGHT / 2]
    pycolmap.set_random_seed(3)
    return pycolmap.synthesize_dataset(options)


def velocities(model):
    rng = np.random.default_rng(1)
    names = sorted(model.image(i).name for i in model.reg_image_ids())
    directions = rng.standard_normal((len(names), 3))
    return dict(zip(names, SPEED * directions / np.linalg.norm(directions, axis=1)[:, None], strict=True))


def shutters(model, readout_s=READOUT_S, direction="down"):
    return {
        model.image(i).name: FrameShutter(
            width=WIDTH, height=HEIGHT, t_s=10.0, exposure_s=0.004, readout_s=readout_s, readout_direction=direction
        )
        for i in model.reg_image_ids()
    }


def filmed(model, velocity, direction="down", noise_px=0.0):
    """The model with its observations where moving cameras saw them, and poses and points adjusted to those."""
    model = pycolmap.Reconstruction(model)
    rng = np.random.default_rng(2)
    for i in model.reg_image_ids():
        image = model.image(i)
        pose = image.cam_from_world()
        rotation, centre = pose.rotation.matrix(), image.projection_center()
        points = image.points2D
        for k in range(len(points)):
            if not points[k].has_point3D():
                continue
            world = model.points3D[points[k].point3D_id].xyz
            xy = np.asarray(points[k].xy)
            for _ in range(20):  # the line that sees the point decides where the camera is
                along = {"down": xy[1] / HEIGHT, "left": 1 - xy[0] / WIDTH}[direction]
                at = centre + (along - 0.5) * READOUT_S * velocity[image.name]
                ray = rotation @ (world - at)
                xy = 500.0 * ray[:2] / ray[2] + [WIDTH / 2, HEIGHT / 2]
            points[k].xy = xy + noise_px * rng.standard_normal(2)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = False
    pycolmap.bundle_adjustment(model, options)
    return model


def centre_error(model, truth):
    """Rms distance of camera centres after the best similarity, as a share of their extent."""
    centres = np.array([model.image(i).projection_center() for i in model.reg_image_ids()])
    true = np.array([truth.image(i).projection_center() for i in model.reg_image_ids()])
    a, b = centres - centres.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    left = b - (s * sign).sum() / (a**2).sum() * a @ (u * sign @ vt).T
    return float(np.sqrt((left**2).sum(axis=1).mean()) / np.ptp(true, axis=0).max())


@pytest.mark.parametrize("direction", ["down", "left"])
def test_the_model_becomes_that_of_a_global_shutter(truth, direction):
    velocity = velocities(truth)
    model = filmed(truth, velocity, direction)
    before = centre_error(model, truth)
    kept = model.image(1).points2D[0].xy.copy()
    settled, what = settle_readout(model, shutters(model, direction=direction), velocity, refine_intrinsics=False)
    assert what.accepted
    assert what.shift_px > 0.3
    assert what.after_px < 0.1 * what.before_px
    assert before > 1e-3
    assert centre_error(settled, truth) < 0.02 * before
    np.testing.assert_array_equal(model.image(1).points2D[0].xy, kept)  # the given model is left alone


def test_noise_does_not_hide_it(truth):
    velocity = velocities(truth)
    model = filmed(truth, velocity, noise_px=0.3)
    settled, what = settle_readout(model, shutters(model), velocity, refine_intrinsics=False)
    floor = centre_error(filmed(truth, {name: np.zeros(3) for name in velocity}, noise_px=0.3), truth)
    assert what.accepted
    assert centre_error(settled, truth) < 1.5 * floor
    assert centre_error(model, truth) > 2 * floor


def test_velocities_that_the_pictures_contradict_change_nothing(truth):
    velocity = velocities(truth)
    model = filmed(truth, velocity)
    same, what = settle_readout(
        model, shutters(model), {name: -v for name, v in velocity.items()}, refine_intrinsics=False
    )
    assert same is model
    assert not what.accepted
    assert what.after_px > what.before_px


def test_a_global_shutter_or_a_camera_at_rest_leaves_the_model_alone(truth):
    still = {name: np.zeros(3) for name in velocities(truth)}
    for lines, moving in ((shutters(truth, 0.0), velocities(truth)), (shutters(truth), still), ({}, {})):
        same, what = settle_readout(truth, lines, moving, refine_intrinsics=False)
        assert same is truth
        assert what.shift_px == 0
        assert not what.accepted
