"""The covariance of a joined model's camera path: drift of its parts, their scales, and the gaps between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, skew
from colmap_inertial.inertial.join.placement import FittedSubmodel
from colmap_inertial.inertial.join.relative_poses import JoinedGroup, relative_cov
from colmap_inertial.inertial.refine.motion import ImageDrift
from colmap_inertial.inertial.refine.setup import read_seen
from colmap_inertial.model import Model
from colmap_inertial.run.stages.metric import find_path_drift, gravity_in_model


def find_joined_covs(
    whole: Model, models: Sequence[Model], submodels: Sequence[FittedSubmodel], group: JoinedGroup
) -> dict[str, Array]:
    """(6, 6) covariances of images' positions and rotations against the first image of a joined model.

    Along the world's axes, rotations from the left, with the first image's heading and the right up. Drift of a part
    goes on from the end of the one before it, and swings what follows; the scales and the gaps are those of the places.

    Parameters
    ----------
    whole
        The joined model, a part of it for each member of the group.
    models, submodels
        All that were judged, in the order that the group's members are places of.
    group
        The members as they were placed.

    Returns
    -------
    dict
        By name; empty where images do not determine the shape of a part, or that takes too much work.
    """
    members, fitted = [models[k] for k in group.members], [submodels[k] for k in group.members]
    turns = [
        matrix_from_quat(part.similarity.rotation_xyzw) @ matrix_from_quat(model.similarity.rotation_xyzw).T
        for part, model in zip(whole.parts, members, strict=True)
        if model.similarity is not None
    ]
    drifts = [_drift_of(model) for model in members]
    order = sorted(range(len(members)), key=lambda k: float(fitted[k].trajectory.t_s[0]))
    # of placed axes, which are those of the part that was held
    world, placed = turns[0], group.placed
    down = placed.gravity_m_s2 / np.linalg.norm(placed.gravity_m_s2)
    first = fitted[order[0]].trajectory.cam_in_world[0]
    out: dict[str, Array] = {}
    carried, end = np.zeros((6, 6)), world @ placed.points(order[0], first[None])[0]
    for k in order:
        drift = drifts[k]
        if drift is None:
            return {}
        at = placed.points(k, drift.cam_in_world) @ world.T
        by, turn = np.eye(6), np.kron(np.eye(2), turns[k])
        for i, name in enumerate(drift.names):
            by[:3, 3:] = -skew(at[i] - end)
            bent = by @ carried @ by.T + turn @ drift.cov[i] @ turn.T
            points = first, drift.cam_in_world[i]
            beside = relative_cov(fitted, placed, points, (order[0], k), swung=np.outer(down, down))
            axes = np.zeros((6, 6))
            axes[:3, 3:] = axes[3:, :3] = world
            out[name] = bent + axes @ beside @ axes.T
        carried, end = bent, at[-1]
    return out


def _drift_of(model: Model) -> ImageDrift | None:
    gravity = gravity_in_model(model)
    assert gravity is not None
    return find_path_drift(read_seen(model.reconstruction, model.timing), gravity)
