"""The path that a device computed by itself, against the cameras of a model: their scales, and their shapes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray, Int64Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, so3_log
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.core.types.evidence import ScaleEvidence, ScalePart
from colmap_inertial.evidence.inertial import evidence_of_device
from colmap_inertial.inertial.scale.verdict import student_factor


@dataclass(frozen=True, kw_only=True)
class DevicePathLimits:
    """How the two are compared, and what counts as a break or a bend."""

    fewest: int = 8
    #: The recording is cut into so many blocks, which are left out in turn.
    blocks: int = 6
    #: Paths within this share of their length are all one place.
    least_reach: float = 1e-6
    #: A break: over this time one moves against the other by so many standard deviations of what it usually does, and
    #: by so much.
    break_s: float = 1.0
    break_sigmas: float = 8.0
    break_m: float = 0.1
    break_deg: float = 3.0
    #: A bend: the axes of the last fifth against the first, where one is carried over to the other. ARKit keeps the
    #: vertical by the accelerometer, but its heading drifts.
    bend_share: float = 0.2
    bend_deg: float = 5.0
    tilt_deg: float = 3.0


_LIMITS = DevicePathLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class DevicePath:
    """A device's path placed on a model's.

    Attributes
    ----------
    evidence
        The model's scale by the device's metres, in doubt where the shapes differ.
    device_from_model
        (3, 3) rotation of the worlds.
    """

    evidence: ScaleEvidence
    device_from_model: Array


def place_device_path(
    device: CameraTrajectory,
    path: CameraTrajectory,
    *,
    up_in_device: Array | None = None,
    parts: tuple[tuple[float, float], ...] = (),
    limits: DevicePathLimits = _LIMITS,
) -> DevicePath:
    """Place a device's own path on the cameras of a model.

    Parameters
    ----------
    device
        In the device's metres; joined with the path by names.
    path
        The model's cameras, in its units.
    up_in_device
        (3,) against gravity, where the device's world knows it: a bend then counts by its tilt.
    parts
        Parts of the recording to tell the scale of.

    Raises
    ------
    NotObservableError
        Where both have too few images in common, or do not move.
    """
    both = _Both.of(device, path)
    if len(both.t_s) < limits.fewest:
        raise NotObservableError("scale", Fact("device-poses-too-few", count=len(both.t_s), needed=limits.fewest))
    reach = np.array([_reach(both.device), _reach(both.model)])
    whole = np.array([np.abs(both.device).max(), np.abs(both.model).max()])
    if not (reach > limits.least_reach * np.maximum(whole, 1e-12)).all():
        raise NotObservableError("scale", Fact("device-stands-still"))
    log_scale, turn = _fit(both)
    breaks = _find_breaks(both, log_scale, limits)
    if breaks:
        # pieces between breaks tell the scale, each about its own middle
        at_s = [moment.at_s for moment in breaks]
        both = replace(both, piece=np.searchsorted(at_s, both.t_s))
        log_scale, turn = _fit(both)
        breaks = _find_breaks(both, log_scale, limits) or breaks
    number = np.arange(len(both.t_s)) * limits.blocks // len(both.t_s)
    without = np.array([_fit(both.select(number != k))[0] for k in range(limits.blocks)])
    by_blocks = math.sqrt((limits.blocks - 1) / limits.blocks * float(np.sum((without - without.mean()) ** 2)))
    sigma = max(by_blocks * student_factor(limits.blocks - 1), 1e-6)
    evidence = evidence_of_device(
        log_scale,
        sigma,
        span_s=(float(both.t_s[0]), float(both.t_s[-1])),
        parts=tuple(part for span in parts if (part := _fit_part(both, span, limits)) is not None),
        reasons=(
            *(moment.as_fact() for moment in breaks[:_MOST_NAMED]),
            *_find_bend(both, up_in_device, limits),
        ),
    )
    return DevicePath(evidence=evidence, device_from_model=turn)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Both:
    """Images that both have: times, centres (N, 3), ``cam_from_world`` (N, 3, 3), numbers of pieces (N,)."""

    t_s: Array
    device: Array
    model: Array
    cam_from_device: Array
    cam_from_model: Array
    piece: IndexArray

    @classmethod
    def of(cls, device: CameraTrajectory, path: CameraTrajectory) -> _Both:
        place = {name: i for i, name in enumerate(device.names)}
        common = [(place[name], k) for k, name in enumerate(path.names) if name in place]
        of_device, of_path = np.array(common, dtype=np.intp).reshape(-1, 2).T
        return cls(
            t_s=path.t_s[of_path],
            device=device.cam_in_world[of_device],
            model=path.cam_in_world[of_path],
            cam_from_device=matrix_from_quat(device.cam_from_world_xyzw[of_device]),
            cam_from_model=matrix_from_quat(path.cam_from_world_xyzw[of_path]),
            piece=np.zeros(len(common), dtype=np.intp),
        )

    def select(self, kept: BoolArray) -> _Both:
        return _Both(
            t_s=self.t_s[kept],
            device=self.device[kept],
            model=self.model[kept],
            cam_from_device=self.cam_from_device[kept],
            cam_from_model=self.cam_from_model[kept],
            piece=self.piece[kept],
        )

    def centred(self, points: Array) -> Array:
        """(N, 3) points about the middle of those of their piece."""
        out = points.copy()
        for number in np.unique(self.piece):
            out[self.piece == number] -= points[self.piece == number].mean(axis=0)
        return out

    def turns(self) -> Array:
        """(N, 3, 3) rotation ``device_from_model`` by each image's attitude."""
        return np.asarray(np.swapaxes(self.cam_from_device, 1, 2) @ self.cam_from_model)


def _reach(points: Array) -> float:
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))


def _fit(both: _Both) -> tuple[float, Array]:
    """Logarithm of the device's metres per unit of the model, and the rotation (3, 3) of the worlds.

    The rotation is that of positions and of attitudes: a straight path has no turn about itself. Errors of both paths
    are alike, so that the scale is the ratio of their reaches along each other, either way.
    """
    device, model = both.centred(both.device), both.centred(both.model)
    size = float(np.sqrt(np.sum(device**2) * np.sum(model**2)))
    if not size > 0:
        raise NotObservableError("scale", Fact("device-stands-still"))
    turn = _nearest_rotation(device.T @ model / size + both.turns().mean(axis=0))
    along = float(np.sum(device * (model @ turn.T)))
    # least squares of either on the other, and their geometric mean
    forth, back = along / float(np.sum(model**2)), float(np.sum(device**2)) / along if along > 0 else math.nan
    if not (forth > 0 and math.isfinite(back)):
        raise NotObservableError("scale", Fact("device-path-of-other-shape"))
    return 0.5 * math.log(forth * back), turn


def _nearest_rotation(matrix: Array) -> Array:
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt)


def _fit_part(both: _Both, span: tuple[float, float], limits: DevicePathLimits) -> ScalePart | None:
    """The scale in a part, with the standard deviation that its halves show; ``None`` where too little is there."""
    inside = (both.t_s >= span[0]) & (both.t_s <= span[1])
    if inside.sum() < limits.fewest:
        return None
    part = both.select(inside)
    half = np.arange(len(part.t_s)) < len(part.t_s) // 2
    try:
        log_scale, _ = _fit(part)
        first, second = (_fit(part.select(half == one))[0] for one in (True, False))
    except NotObservableError:
        return None
    sigma = abs(first - second) / 2 * student_factor(1)
    return ScalePart(begin_s=span[0], end_s=span[1], log_scale=log_scale, sigma=max(sigma, 1e-6))


@dataclass(frozen=True, kw_only=True)
class _Break:
    """When one path jumps against the other, and by how much within a moment."""

    at_s: float
    jump_m: float
    turn_deg: float

    def as_fact(self) -> Fact:
        return Fact("device-path-breaks", at_s=self.at_s, jump_m=self.jump_m, turn_deg=self.turn_deg)


#: So many breaks are named, the rest counts all the same.
_MOST_NAMED = 3


def _find_breaks(both: _Both, log_scale: float, limits: DevicePathLimits) -> list[_Break]:
    """Where one path jumps against the other: the motion over a moment, seen from the camera, compared."""
    later = np.searchsorted(both.t_s, both.t_s + limits.break_s)
    first = np.flatnonzero(later < len(both.t_s))
    later = later[first]
    if len(first) < limits.fewest:
        return []
    by_device = _moved(both.device, both.cam_from_device, first, later)
    by_model = math.exp(log_scale) * _moved(both.model, both.cam_from_model, first, later)
    off_m = np.linalg.norm(by_device - by_model, axis=1)
    turns = both.turns()
    off_deg = np.degrees(np.linalg.norm(so3_log(turns[later] @ np.swapaxes(turns[first], 1, 2)), axis=1))
    jumps = off_m > max(limits.break_sigmas * float(np.median(off_m)), limits.break_m)
    twists = off_deg > max(limits.break_sigmas * float(np.median(off_deg)), limits.break_deg)
    found = []
    # one break is in all moments that it lies in
    at = np.flatnonzero(jumps | twists)
    for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if len(at) else ():
        middle_s = 0.25 * float(both.t_s[first[run[[0, -1]]]].sum() + both.t_s[later[run[[0, -1]]]].sum())
        found.append(_Break(at_s=middle_s, jump_m=float(off_m[run].max()), turn_deg=float(off_deg[run].max())))
    return found


def _moved(centres: Array, cam_from_world: Array, first: IndexArray, later: IndexArray) -> Array:
    """(K, 3) from one image's camera to another's, in the axes of the first."""
    return np.asarray(np.einsum("kij,kj->ki", cam_from_world[first], centres[later] - centres[first]))


def _find_bend(both: _Both, up_in_device: Array | None, limits: DevicePathLimits) -> list[Fact]:
    """Whether one is bent against the other: the rotation between the worlds at the end against the beginning."""
    count = max(1, round(limits.bend_share * len(both.t_s)))
    turns = both.turns()
    begin, end = (_nearest_rotation(some.mean(axis=0)) for some in (turns[:count], turns[-count:]))
    bend_deg = float(np.degrees(np.linalg.norm(so3_log(end @ begin.T))))
    tilt_deg = None
    if up_in_device is not None:
        up = np.array([turn.T @ up_in_device for turn in (begin, end)])
        tilt_deg = float(np.degrees(np.arctan2(np.linalg.norm(np.cross(*up)), up[0] @ up[1])))
    bent = bend_deg > limits.bend_deg or (tilt_deg is not None and tilt_deg > limits.tilt_deg)
    return [Fact("device-path-bends", turn_deg=bend_deg, tilt_deg=tilt_deg)] if bent else []


def up_by_device(placed: DevicePath, up_in_device: Array) -> Array:
    """(3,) against gravity, in the world of the model."""
    return np.asarray(placed.device_from_model.T @ up_in_device)


def join_by_time(path: CameraTrajectory, names: Sequence[str], t_ns: Int64Array, *, within_s: float) -> dict[str, str]:
    """The name of the pose that each image was taken at; images without one, and all but one of a pose, are left out.

    Parameters
    ----------
    path
        The device's.
    names, t_ns
        (N,) images in the order of time, and when they were exposed, on the device's clock.
    within_s
        How far a pose may be from its image.
    """
    at_s = (t_ns - path.epoch_ns) * 1e-9
    after = np.clip(np.searchsorted(path.t_s, at_s), 1, len(path.t_s) - 1)
    nearest = np.where(path.t_s[after] - at_s < at_s - path.t_s[after - 1], after, after - 1)
    kept = np.abs(path.t_s[nearest] - at_s) <= within_s
    kept[1:] &= np.diff(nearest) > 0
    return {name: path.names[k] for name, k, is_kept in zip(names, nearest.tolist(), kept, strict=True) if is_kept}
