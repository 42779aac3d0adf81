"""Corners of a target seen by posed cameras, and the residuals they leave. Numpy only.

A residual is an observed corner minus the projected one, in pixels, taken in the plane that touches the unit sphere at
the observed ray and carried to pixels by the camera's local derivative, which makes it independent of the camera model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray


@dataclass(frozen=True, eq=False, kw_only=True)
class Observations:
    """Corners of a target seen by posed cameras, ordered by view.

    Attributes
    ----------
    view
        (M,) index into the cameras, not decreasing.
    corner
        (M,) number of the corner in its target.
    part
        (M,) index of the rigid part, counted from 0 without gaps.
    target_m
        (M, 3) the corner in its part's frame, metres.
    ray
        (M, 3) unit direction in which the camera saw it, camera frame.
    px_from_tangent
        (M, 2, 3) derivative of the pixel with respect to the direction; zero along ``ray``.
    cam_from_world
        (V, 3, 3) rotations.
    cam_from_world_t
        (V, 3) translations, model units.
    """

    view: IndexArray
    corner: IndexArray
    part: IndexArray
    target_m: Array
    ray: Array
    px_from_tangent: Array
    cam_from_world: Array
    cam_from_world_t: Array

    def __len__(self) -> int:
        return len(self.view)

    def select(self, keep: BoolArray) -> Observations:
        """The observations that ``keep`` (M,) picks; cameras and parts keep their numbers."""
        per_corner = ("view", "corner", "part", "target_m", "ray", "px_from_tangent")
        return replace(self, **{name: getattr(self, name)[keep] for name in per_corner})


@dataclass(frozen=True, eq=False, kw_only=True)
class Placement:
    """Poses of a target's parts in the model: ``x_world = scale * rotation @ target_m + centre``.

    Attributes
    ----------
    log_scale
        Logarithm of model units per metre.
    rotation
        (P, 3, 3) world_from_part.
    centre
        (P, 3) the part's origin in the world, model units.
    """

    log_scale: float
    rotation: Array
    centre: Array


def linearise(obs: Observations, at: Placement) -> tuple[Array, Array, Array]:
    """Residuals and their derivatives.

    Parameters
    ----------
    obs
        What was seen.
    at
        Where the target is thought to be.

    Returns
    -------
    residual_px
        (M, 2) observed minus projected; infinite where a corner would lie behind the camera.
    in_cam
        (M, 3) corners in camera frames, model units.
    jacobian
        (M, 2, 3) derivative of the projection with respect to ``in_cam``.
    """
    in_world = np.exp(at.log_scale) * np.einsum("mij,mj->mi", at.rotation[obs.part], obs.target_m) + at.centre[obs.part]
    in_cam = np.einsum("mij,mj->mi", obs.cam_from_world[obs.view], in_world) + obs.cam_from_world_t[obs.view]
    return tangent_residual(obs, in_cam)


def tangent_residual(obs: Observations, in_cam: Array) -> tuple[Array, Array, Array]:
    """:func:`linearise` for corners (M, 3) at any place in the camera frames."""
    depth = np.einsum("mi,mi->m", obs.ray, in_cam)
    behind: BoolArray = np.asarray(depth <= 0)
    depth = np.where(behind, 1.0, depth)
    projected = np.einsum("mij,mj->mi", obs.px_from_tangent, in_cam) / depth[:, None]
    jacobian = (obs.px_from_tangent - projected[:, :, None] * obs.ray[:, None, :]) / depth[:, None, None]
    return np.where(behind[:, None], np.inf, -projected), in_cam, jacobian


def triangulate(obs: Observations, at: Placement) -> tuple[IndexArray, Array, BoolArray]:
    """Corners one by one, from the model's cameras alone; the target's known shape only starts the search.

    Parameters
    ----------
    obs
        What was seen, outliers removed.
    at
        The fitted target.

    Returns
    -------
    corner
        (C,) numbers of the corners, increasing.
    in_world
        (C, 3) their positions, model units.
    determined
        (C,) false where the views that saw the corner look along nearly the same line.
    """
    corner, which = np.unique(obs.corner, return_inverse=True)
    in_world = np.zeros((len(corner), 3))
    guess = np.exp(at.log_scale) * np.einsum("mij,mj->mi", at.rotation[obs.part], obs.target_m) + at.centre[obs.part]
    in_world[which] = guess
    rotation = obs.cam_from_world[obs.view]
    matrix = np.zeros((len(corner), 3, 3))
    for _ in range(5):
        in_cam = np.einsum("mij,mj->mi", rotation, in_world[which]) + obs.cam_from_world_t[obs.view]
        residual, _, jac = tangent_residual(obs, in_cam)
        seen: BoolArray = np.asarray(np.isfinite(residual).all(axis=1))
        jac = np.where(seen[:, None, None], jac @ rotation, 0.0)
        residual = np.where(seen[:, None], residual, 0.0)
        matrix, rhs = np.zeros((len(corner), 3, 3)), np.zeros((len(corner), 3))
        np.add.at(matrix, which, np.swapaxes(jac, 1, 2) @ jac)
        np.add.at(rhs, which, np.einsum("mij,mi->mj", jac, residual))
        in_world += np.einsum("cij,cj->ci", np.linalg.pinv(matrix, rcond=1e-9, hermitian=True), rhs)
    w = np.asarray(np.linalg.eigvalsh(matrix), dtype=np.float64)
    # two views whose lines of sight meet at an angle a give a ratio of about a^2 / 4; half a degree is the least
    return corner, in_world, w[:, 0] > 2e-5 * w[:, 2]
