"""Readout time of a camera from its images and the gyroscope, where it was not measured.

A corner is seen in two frames, each time when its own line is exposed. How far the camera turned between these two
instants depends on the readout where the turning changes from frame to frame. All corners of all pairs are fitted at
once: the time that lines take down and across the image, what is uncertain in the gyroscope's calibration, and for
each pair a translation. Of a corner whose depth is unknown, only what lies across the translation's flow counts.
The line delay has been calibrated so with targets (Oth et al., "Rolling Shutter Camera Calibration", CVPR 2013) and
without (Karpenko et al., "Digital Video Stabilization and Rolling Shutter Correction using Gyroscopes", 2011).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import cross, quat_exp, quat_multiply
from colmap_inertial.core.types import FrameTiming, ReadoutDirection
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.imaging.rolling_shutter import append_unit_depth
from colmap_inertial.motion.flow import VisualRotation


@dataclass(frozen=True, kw_only=True)
class ReadoutLimits:
    """Limits for the readout of a rolling shutter."""

    #: Pairs of frames, at least.
    least_pairs: int = 24
    #: Corners, at least.
    least_corners: int = 1500
    #: More pairs tell nothing that these do not.
    most_pairs: int = 150
    #: Parts of the recording whose scatter widens the result,
    parts: int = 12
    #: and pairs in each, at least.
    pairs_of_part: int = 3
    #: What is known beforehand, standard deviations, each far wider than what it says, so that the images decide:
    #: readout along and across,
    readout_sigma_s: float = 0.1
    #: clock offset,
    offset_sigma_s: float = 0.05
    #: axes: where cameras move as much as they turn, rotations of pairs align them to ten degrees only,
    axes_sigma_rad: float = 0.3
    #: bias,
    bias_sigma_rad_s: float = 0.02
    #: focal length,
    focal_sigma_log: float = 0.2
    #: and the translation of a pair in mean depths.
    translation_sigma: float = 1.0
    #: Inverse depths scatter by so many times their mean.
    depth_scatter: float = 3.0
    #: Least scatter of a corner, as an angle.
    least_scatter_rad: float = 2e-5
    #: The rate must change from frame to frame by so much (root mean square),
    least_change_rad_s: float = 0.03
    #: and by so many standard deviations of a reading.
    change_by_noise: float = 8.0
    #: Rounds of least squares, at most.
    most_rounds: int = 25
    #: Change of the readout, and of the axes, at which they end.
    settled_s: float = 1e-5
    settled_rad: float = 1e-4
    #: A readout is told where it is known to this, a tenth of a slow one,
    most_sigma_s: float = 0.003
    #: and clear of nothing by so many standard deviations;
    clear_sigmas: float = 3.0
    #: one that is seen the other way, too, must be clear and this share of it.
    beside_share: float = 0.2
    #: Added to what scatter shows (``scripts/studies/readout.py``): seconds,
    floor_s: float = 2e-4
    #: and the share of a readout by which it comes out too short where depths are of all sizes.
    floor_share: float = 0.02


_LIMITS = ReadoutLimits()


@dataclass(frozen=True, kw_only=True)
class ReadoutEstimate:
    """The readout of a rolling shutter.

    Attributes
    ----------
    readout_s
        From the first line to one past the last; 0 where none is seen.
    sigma_s
        Its standard deviation.
    direction
        Where the exposed line moves in the stored image.
    pairs
        Of frames that were compared.
    """

    readout_s: float
    sigma_s: float
    direction: ReadoutDirection
    pairs: int

    def __str__(self) -> str:
        return f"{1e3 * self.readout_s:.1f} +- {1e3 * self.sigma_s:.1f} ms"


def compare_readout(
    declared: FrameTiming,
    readout_s: float,
    sigma_s: float,
    direction: ReadoutDirection,
    *,
    least_s: float,
    sigmas: float,
) -> Fact | None:
    """A declared readout that is not the one which was found without it; ``None`` where it agrees, or none is.

    Parameters
    ----------
    declared
        Readout and direction of the frames.
    readout_s, sigma_s, direction
        What was found, and its standard deviation.
    least_s, sigmas
        They are at least so far apart, and by so many standard deviations.
    """
    stated_s, towards = declared.readout_s, declared.readout_direction
    if stated_s is None:
        return None
    opposite = {towards, direction} in ({"down", "up"}, {"right", "left"})
    across = not opposite and towards != direction
    along_s = -readout_s if opposite else readout_s
    off_s = max(stated_s, readout_s) if across else abs(stated_s - along_s)
    if off_s <= max(least_s, sigmas * sigma_s):
        return None
    return Fact(
        "declared-readout",
        declared_s=stated_s,
        declared_direction=towards,
        readout_s=readout_s,
        sigma_s=sigma_s,
        direction=direction,
    )


def estimate_readout(rotation: VisualRotation, motion: GyroCamera) -> ReadoutEstimate:
    """The readout of a camera, from corners that were followed from frame to frame.

    Parameters
    ----------
    rotation
        With its tracks, measured without any readout.
    motion
        The gyroscope on the camera's clock; its rotation and offset may be off by what an alignment leaves.

    Raises
    ------
    NotObservableError
        Where too little was seen, the camera turned too evenly, or what was seen is no shutter of lines.
    """
    seen = _collect_corners(rotation, motion)
    _require_change(seen, motion)
    params, cov = _fit_readout(seen, motion)
    sigma = np.sqrt(np.diagonal(cov)[:2] + _LIMITS.floor_s**2 + (_LIMITS.floor_share * params[:2]) ** 2)
    along, beside = (0, 1) if abs(params[0]) >= abs(params[1]) else (1, 0)
    # no shutter takes time along its lines: what is seen there, a lens' or the depths' doing, is in both
    unmodelled = max(0.0, float(params[beside] ** 2 - sigma[beside] ** 2))
    readout_s, sigma_s = float(params[along]), float(np.hypot(sigma[along], unmodelled**0.5))
    if abs(readout_s) < _LIMITS.clear_sigmas * sigma_s:
        # of a shutter that is not seen nobody knows how its lines run
        readout_s, sigma_s, along, beside = 0.0, float(sigma.max()), 0, 1
    if not sigma_s < _LIMITS.most_sigma_s:
        raise NotObservableError("readout", Fact("readout-too-loose", readout_sigma_s=sigma_s))
    if abs(params[beside]) > max(_LIMITS.clear_sigmas * sigma[beside], _LIMITS.beside_share * abs(readout_s)):
        raise NotObservableError("readout", Fact("readout-not-of-lines"))
    directions: tuple[tuple[ReadoutDirection, ReadoutDirection], ...] = (("down", "up"), ("right", "left"))
    return ReadoutEstimate(
        readout_s=abs(readout_s),
        sigma_s=sigma_s,
        direction=directions[along][int(readout_s < 0)],
        pairs=len(seen.begins),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Corners:
    """Corners of all pairs, one pair after another.

    Attributes
    ----------
    begins
        (K,) where each pair begins.
    pair
        (N,) of each corner.
    t_s
        (N, 2) instants of the two frames, camera clock.
    place
        (N, 2, 2) in the two images, down and across, from -0.5 to 0.5.
    rays
        (N, 2, 2) of the two images, z = 1.
    dt_s
        (K,) between the frames.
    """

    begins: IndexArray
    pair: IndexArray
    t_s: Array
    place: Array
    rays: Array
    dt_s: Array

    def sums(self, values: Array) -> Array:
        """Sums over the corners of each pair."""
        return np.add.reduceat(values, self.begins, axis=0)


def _collect_corners(rotation: VisualRotation, motion: GyroCamera) -> _Corners:
    slack_s = 0.05
    inside = motion.covers(rotation.t_s[:-1] - slack_s, rotation.t_s[1:] + slack_s)
    used = [i for i, tracks in enumerate(rotation.tracks) if inside[i] and len(tracks.rays)]
    first = max(0, (len(used) - _LIMITS.most_pairs) // 2)
    used = used[first : first + _LIMITS.most_pairs]
    counts = [len(rotation.tracks[i].rays) for i in used]
    if len(used) < _LIMITS.least_pairs or sum(counts) < _LIMITS.least_corners:
        raise NotObservableError("readout", Fact("readout-of-few-corners", corners=sum(counts), pairs=len(used)))
    pair = np.repeat(np.arange(len(used)), counts)
    ends_s = np.column_stack([rotation.t_s[:-1][used], rotation.t_s[1:][used]])
    return _Corners(
        begins=np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.intp),
        pair=pair,
        t_s=ends_s[pair],
        place=np.concatenate([rotation.tracks[i].place for i in used]),
        rays=np.concatenate([rotation.tracks[i].rays for i in used]),
        dt_s=ends_s[:, 1] - ends_s[:, 0],
    )


def _require_change(seen: _Corners, motion: GyroCamera) -> None:
    """Refuse a camera whose rate hardly changes from frame to frame: noise in the change makes readouts too short."""
    ends = np.array([motion.rate_in_cam_rad_s(seen.t_s[seen.begins, k]) for k in range(2)])
    change = float(np.sqrt(np.mean(np.sum((ends[1] - ends[0]) ** 2, axis=1))))
    noise = motion.path.noise_rad_s_rthz / float(np.sqrt(np.median(np.diff(motion.path.t_s))))
    if change < max(_LIMITS.least_change_rad_s, _LIMITS.change_by_noise * noise):
        raise NotObservableError("readout", Fact("readout-of-even-rotation", change_rad_s=change))


def _fit_readout(seen: _Corners, motion: GyroCamera) -> tuple[Array, Array]:
    """(10,) readout down and across, clock offset, axes, bias and logarithm of the focal length; their covariance."""
    sigmas = np.array(
        [
            _LIMITS.readout_sigma_s,
            _LIMITS.readout_sigma_s,
            _LIMITS.offset_sigma_s,
            *(3 * [_LIMITS.axes_sigma_rad]),
            *(3 * [_LIMITS.bias_sigma_rad_s]),
            _LIMITS.focal_sigma_log,
        ]
    )
    prior = np.diag(sigmas**-2.0)
    params = np.zeros(len(sigmas))
    moved = np.zeros((len(seen.begins), 3))
    for _ in range(_LIMITS.most_rounds):
        off, by_params, by_moved = _compute_residuals(seen, motion, params, moved)
        inverse, robust = _weigh_corners(off, by_moved, moved, seen)
        # what a corner's depth is, as far as it shows: the flow of a pair's translation is that much stronger
        flow = np.einsum("nij,nj->ni", by_moved, moved[seen.pair])
        depth = np.clip(
            1 + _LIMITS.depth_scatter**2 * np.einsum("ni,nij,nj->n", flow, inverse, off),
            0,
            1 + _LIMITS.depth_scatter,
        )
        slope = depth[:, None, None] * by_moved
        weighed = robust[:, None, None] * inverse
        square = seen.sums(np.swapaxes(slope, 1, 2) @ weighed @ slope) + _LIMITS.translation_sigma**-2 * np.eye(3)
        mixed = seen.sums(np.swapaxes(slope, 1, 2) @ weighed @ by_params)
        own = seen.sums(np.einsum("nij,nik,nk->nj", slope, weighed, off)) - _LIMITS.translation_sigma**-2 * moved
        shared = seen.sums(np.einsum("nij,nik,nk->nj", by_params, weighed, off))
        shared_square = np.einsum("nij,nik,nkl->jl", by_params, weighed, by_params)
        gain = np.swapaxes(np.linalg.solve(square, mixed), 1, 2)
        information = shared_square - np.einsum("kij,kjl->il", gain, mixed) + prior
        scores = shared - np.einsum("kij,kj->ki", gain, own)
        step = np.linalg.solve(information, scores.sum(axis=0) - prior @ params)
        moved = moved + np.linalg.solve(square, (own - mixed @ step)[..., None])[..., 0]
        params = params + step
        # axes may be off by more than what is linear: the gyroscope is turned, and the next step starts from there
        motion = replace(motion, cam_from_imu_xyzw=quat_multiply(quat_exp(step[3:6]), motion.cam_from_imu_xyzw))
        if np.abs(step[:2]).max() < _LIMITS.settled_s and np.abs(step[3:6]).max() < _LIMITS.settled_rad:
            break
    cov = np.linalg.inv(information)
    parts = min(_LIMITS.parts, len(scores) // _LIMITS.pairs_of_part)
    sums = np.array([part.sum(axis=0) for part in np.array_split(scores, parts)])
    scatter = cov @ (sums.T @ sums) @ cov * parts / (parts - 1)
    return params, np.maximum(np.diagonal(cov), np.diagonal(scatter)) * np.eye(len(cov))


def _compute_residuals(seen: _Corners, motion: GyroCamera, params: Array, moved: Array) -> tuple[Array, Array, Array]:
    """(N, 2) what the second ray is off, its change with the parameters (N, 2, 10) and the translation (N, 2, 3).

    ``motion`` has the axes of ``params``.
    """
    lines, offset_s, bias, focal = params[:2], params[2], params[6:9], np.exp(params[9])
    since_s = seen.place @ lines
    at_s = seen.t_s + since_s - offset_s
    looking = motion.start_from_cam(at_s)
    now_from_before = np.swapaxes(looking[:, 1], 1, 2) @ looking[:, 0]
    rate = motion.rate_in_cam_rad_s(at_s.ravel()).reshape(*at_s.shape, 3)
    span_s = np.diff(at_s, axis=1)
    middle_rate = rate.mean(axis=1)
    rays = seen.rays * focal
    ahead = append_unit_depth(rays[:, 0])
    turned = np.einsum("nij,nj->ni", now_from_before, ahead)
    # a little bias turns it further; the axes are in the motion
    turned = turned + cross(span_s * bias, turned)
    seen_at = turned[:, :2] / turned[:, 2:]
    now, before = rate[:, 1], np.einsum("nij,nj->ni", now_from_before, rate[:, 0])
    turns = np.zeros((len(rays), 3, 9))
    for k in range(2):
        turns[:, :, k] = -(seen.place[:, 1, k, None] * now - seen.place[:, 0, k, None] * before)
    turns[:, :, 2] = now - before
    for k in range(3):
        axis = np.broadcast_to(np.eye(3)[k], now.shape)
        turns[:, :, 3 + k] = -span_s * cross(axis, middle_rate)
        turns[:, :, 6 + k] = span_s * axis
    swept = np.stack([cross(turns[:, :, k], turned) for k in range(9)], axis=2)
    by_focal = np.einsum("nij,nj->ni", now_from_before[:, :, :2], rays[:, 0])
    shown = _project_changes(turned, np.concatenate([swept, by_focal[:, :, None]], axis=2))
    # all of it in the image's own unit: with the focal length it would shrink
    shown[:, :, 9] -= seen_at
    shown /= focal
    flow = np.zeros((len(rays), 2, 3))
    flow[:, 0, 0] = flow[:, 1, 1] = 1 / focal
    flow[:, :, 2] = -seen_at / focal
    # lines that are read later saw a translation that had changed
    changed = _differentiate_translation(seen, moved)[seen.pair]
    by_line = np.einsum("nij,nj->ni", flow, changed)
    shown[:, :, :2] += by_line[:, :, None] * seen.place[:, None, 1]
    translation = moved[seen.pair] + since_s[:, 1, None] * changed
    off = seen.rays[:, 1] - seen_at / focal - np.einsum("nij,nj->ni", flow, translation)
    return off, shown, flow


def _differentiate_translation(seen: _Corners, moved: Array) -> Array:
    """(K, 3) by how much a pair's translation grows a second later."""
    speed = moved / seen.dt_s[:, None]
    at = 0.5 * (speed[1:] + speed[:-1])
    ends = np.concatenate([speed[:1], at, speed[-1:]])
    return np.diff(ends, axis=0)


def _project_changes(point: Array, change: Array) -> Array:
    """(N, 2, P) how changes (N, 3, P) of points show in the image at z = 1."""
    return np.asarray((change[:, :2] - (point[:, :2] / point[:, 2:])[:, :, None] * change[:, 2:]) / point[:, 2:, None])


def _weigh_corners(off: Array, flow_of: Array, moved: Array, seen: _Corners) -> tuple[Array, Array]:
    """(N, 2, 2) inverse covariances, with unknown depths; (N,) how far each corner is believed."""
    flow = np.einsum("nij,nj->ni", flow_of, moved[seen.pair])
    length = np.linalg.norm(flow, axis=1)
    along = flow / np.maximum(length, 1e-12)[:, None]
    across = np.abs(off[:, 0] * -along[:, 1] + off[:, 1] * along[:, 0])
    across = np.where(length > 1e-12, across, np.abs(off[:, 1]))
    usual = np.array([float(np.median(part)) for part in np.split(across, seen.begins[1:])])
    sigma = np.maximum(usual / 0.6745, _LIMITS.least_scatter_rad)[seen.pair]
    share = _LIMITS.depth_scatter**2 / (sigma**2 + _LIMITS.depth_scatter**2 * length**2)
    inverse = (np.eye(2) - share[:, None, None] * flow[:, :, None] * flow[:, None]) / sigma[:, None, None] ** 2
    square = np.einsum("ni,nij,nj->n", off, inverse, off)
    return inverse, 1 / (1 + square / 2.4**2) ** 2
