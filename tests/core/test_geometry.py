"""Rotations against scipy's, conventions against their definitions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from colmap_inertial.core import geometry as g

RNG = np.random.default_rng(1)
VECTORS = np.concatenate([RNG.normal(size=(200, 3)), 1e-10 * RNG.normal(size=(5, 3)), np.zeros((1, 3))])
QUATS = Rotation.random(300, random_state=2).as_quat()


def test_exp_and_log_agree_with_scipy():
    np.testing.assert_allclose(g.so3_exp(VECTORS), Rotation.from_rotvec(VECTORS).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(g.matrix_from_quat(g.quat_exp(VECTORS)), g.so3_exp(VECTORS), atol=1e-14)
    rotations = Rotation.from_quat(QUATS)
    np.testing.assert_allclose(g.quat_log(QUATS), rotations.as_rotvec(), atol=1e-12)
    np.testing.assert_allclose(g.so3_log(rotations.as_matrix()), rotations.as_rotvec(), atol=1e-7)


def test_quaternion_products_agree_with_scipy():
    a, b = QUATS[:150], QUATS[150:]
    expected = (Rotation.from_quat(a) * Rotation.from_quat(b)).as_matrix()
    np.testing.assert_allclose(g.matrix_from_quat(g.quat_multiply(a, b)), expected, atol=1e-14)
    v = RNG.normal(size=(150, 3))
    np.testing.assert_allclose(g.quat_rotate(a, v), Rotation.from_quat(a).apply(v), atol=1e-14)
    np.testing.assert_allclose(g.quat_multiply(a, g.quat_conjugate(a))[:, :3], 0, atol=1e-15)


def test_quat_from_matrix_survives_half_turns():
    axes = np.concatenate([np.eye(3), RNG.normal(size=(50, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    matrices = 2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    np.testing.assert_allclose(g.matrix_from_quat(g.quat_from_matrix(matrices)), matrices, atol=1e-14)


def test_slerp_agrees_with_scipy_inside_and_continues_outside():
    t = np.cumsum(RNG.uniform(0.1, 1, 300))
    inside = np.linspace(t[0], t[-1], 977)
    expected = Slerp(t, Rotation.from_quat(QUATS))(inside).as_matrix()
    np.testing.assert_allclose(g.matrix_from_quat(g.slerp(t, QUATS, inside)), expected, atol=1e-12)
    turn = g.quat_exp(np.array([[0, 0, 0.0], [0, 0, 0.1]]))
    np.testing.assert_allclose(
        g.quat_log(g.slerp(np.array([0.0, 1]), turn, np.array([2.0]))), [[0, 0, 0.2]], atol=1e-12
    )


def test_running_products_agree_with_a_loop(subtests):
    for count in (0, 1, 7, 300):
        with subtests.test(count=count):
            expected = [Rotation.identity()]
            for q in QUATS[:count]:
                expected.append(expected[-1] * Rotation.from_quat(q))
            matrices = np.array([rotation.as_matrix() for rotation in expected])
            np.testing.assert_allclose(g.matrix_from_quat(g.quat_cumulative(QUATS[:count])), matrices, atol=1e-12)


def test_rotation_between_takes_one_direction_to_the_other(subtests):
    for b in ([0, 0, -2.0], [0, 3.0, 0], [1.0, 1, 1], [0, 0, 5.0]):
        with subtests.test(b=b):
            a = np.array([0, 0, 1.0])
            np.testing.assert_allclose(
                g.quat_rotate(g.rotation_between(a, np.array(b)), a), b / np.linalg.norm(b), atol=1e-9
            )


def test_pixel_origin_matches_colmap():
    pycolmap = pytest.importorskip("pycolmap")
    # COLMAP puts the principal point of an even-sized image on the corner between its four middle pixels
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 100.0, 4, 2)
    opencv_centre = np.array([1.5, 0.5])
    principal_point = np.array([camera.principal_point_x, camera.principal_point_y])
    np.testing.assert_array_equal(g.colmap_px_from_opencv(opencv_centre), principal_point)
    np.testing.assert_array_equal(g.opencv_px_from_colmap(principal_point), opencv_centre)
