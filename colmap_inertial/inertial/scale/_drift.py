"""Whether a reconstruction keeps its scale: the scales of parts of the recording against each other.

Each part gets a scale of its own, to first order about the joint fit; all other parameters follow. A deviation of a
part's scale stretches the visual path within that part and shifts all that comes after.
"""

from __future__ import annotations

import math

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.types import ScaleDrift
from colmap_inertial.inertial.core import parameters as par
from colmap_inertial.inertial.core.arrow import Inverse
from colmap_inertial.inertial.core.factors import Direct, Group
from colmap_inertial.inertial.core.parameters import Estimate, Noise
from colmap_inertial.inertial.scale._grouping import Data

#: Length of a part, and how many there are at most.
_PART_S, _MOST_PARTS = 10.0, 12


def chi2_tail(chi2: float, dof: int) -> float:
    """Probability that a chi-squared variable is larger: the finite sum for an integer number of degrees of freedom."""
    half = 0.5 * chi2
    term, total = (math.exp(-half), 0.0) if dof % 2 == 0 else (0.0, math.erfc(math.sqrt(half)))
    if dof % 2:
        term = 2 * math.exp(-half) * math.sqrt(half / math.pi)
    for order in range(2 + dof % 2, dof + 1, 2):
        total += term
        term *= 2 * half / order
    return total


def scale_drift(
    data: Data,
    x: Estimate,
    noise: Noise,
    centre: Group | Direct,
    solution: tuple[Inverse, Array, Array],
    *,
    inflation: float,
    tolerated_log: float,
) -> ScaleDrift:
    """Scales of the parts, and a test of whether they are the same.

    Parameters
    ----------
    data, x, noise
        The joint fit.
    centre
        Residuals of the visual centres at ``x``.
    solution
        The inverse of the normal equations with the right-hand sides (K, m, 1), (n, 1) of the step to the optimum.
    inflation
        By how much variances are larger than the noise levels say.
    tolerated_log
        Standard deviation of the parts' scales that is no drift to speak of.
    """
    inverse, rhs, rhs_z = solution
    span_s = float(data.t_s[-1] - data.t_s[0])
    parts = int(np.clip(round(span_s / _PART_S), 2, _MOST_PARTS))
    edges_s = np.linspace(data.t_s[0], data.t_s[-1], parts + 1)
    # The fitted path, not the measured one, whose noise would be mistaken for a smaller scale
    path = x.imu_in_world_m - x.world_from_imu @ (x.cam_from_imu.T @ x.imu_in_cam_m)
    nodes = np.searchsorted(data.t_s, edges_s[:-1]), np.searchsorted(data.t_s, edges_s[1:])
    columns = np.zeros((*path.shape, parts))
    for i, (first, last) in enumerate(zip(*nodes, strict=True)):
        columns[first:last, :, i] = path[first] - path[first:last]
        columns[last:, :, i] = path[first] - path[last]
    weight = np.ones(len(path)) if centre.weight is None else centre.weight
    columns = (data.centre_shape / noise.centre_m * np.sqrt(weight)[:, None, None]) @ columns

    pulled, pulled_z = np.zeros((len(path), par.N_STATE, parts)), np.zeros((par.N_GLOBALS, parts))
    centre.pull_back(columns, pulled, pulled_z)
    states, z = inverse.solve(np.concatenate([rhs, pulled], axis=2), np.concatenate([rhs_z, pulled_z], axis=1))
    follow = centre.apply(states, z)
    residual = centre.residual + follow[:, :, 0]
    information = np.einsum("kiw,kiv->wv", columns, columns - follow[:, :, 1:])
    score = np.einsum("kiw,ki->w", columns, residual)

    # All parts together are the scale itself, so that only contrasts between parts are known
    contrasts = np.linalg.qr(np.column_stack([np.ones(parts), np.eye(parts)[:, 1:]]))[0][:, 1:]
    cov = np.linalg.inv(contrasts.T @ information @ contrasts) * inflation
    # The columns are those of u, the inverse of the metres per unit
    log_ratio = (cov / inflation) @ (contrasts.T @ score)
    tested = np.linalg.inv(cov + tolerated_log**2 * np.eye(parts - 1))
    chi2 = float(log_ratio @ tested @ log_ratio)
    middle_s = 0.5 * (edges_s[1:] + edges_s[:-1])
    slope = contrasts.T @ (middle_s - middle_s.mean())
    trend_information = float(slope @ tested @ slope)
    return ScaleDrift(
        begin_s=edges_s[:-1],
        end_s=edges_s[1:],
        log_ratio=contrasts @ log_ratio,
        sigma_log=np.sqrt(np.diagonal(contrasts @ cov @ contrasts.T)),
        chi2=chi2,
        dof=parts - 1,
        p_value=chi2_tail(chi2, parts - 1),
        trend_log_per_s=float(slope @ tested @ log_ratio) / trend_information,
        trend_sigma_log_per_s=trend_information**-0.5,
    )
