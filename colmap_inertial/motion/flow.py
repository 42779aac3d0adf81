"""Rotation of a camera from frame to frame, from its pixels: before any reconstruction exists.

Corners are tracked from each frame to the next on a reduced image; frames too far apart for tracking are matched by
features. One angular velocity is fitted to the rays of each pair, robustly, each ray at the time of its own line, so
that a rolling shutter does not bend the result. Chained, the rotations are what ``align_camera_imu`` needs.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from colmap_inertial.core.arrays import Array, Float32Array, IndexArray, UInt8Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import (
    cross,
    quat_conjugate,
    quat_cumulative,
    quat_exp,
    so3_exp,
    so3_log,
)
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.sampling import fit_robust_slope, subtract_running_mean
from colmap_inertial.core.types import CameraTrajectory, Frame, FrameTiming, ImuRecording, Projector
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.rolling_shutter import append_unit_depth
from colmap_inertial.imaging.tracking import convert_to_grey, reduce_image, track_points

#: Longer side of frames in which corners are followed.
FOLLOWED_PX = 640


@dataclass(frozen=True, kw_only=True)
class FlowOptions:
    """Options of the measurement of rotations between frames."""

    corners: int = 400
    """Corners tracked from each frame to the next."""

    min_support: int = 25
    """Fewest tracks that must agree on a rotation; below, the pair is left out."""

    def __post_init__(self) -> None:
        if self.min_support < 8 or self.corners < self.min_support:
            raise ValueError("min_support must be 8 or more, corners at least min_support")


@dataclass(frozen=True, kw_only=True)
class FlowLimits:
    """Limits for rotations from pixels, beside the options."""

    #: Corners of a pair of frames that are kept.
    most_tracks: int = 80
    #: Share of the rotation between frames that the gyroscope must explain.
    least_explained: float = 0.5
    #: An axis counts where the camera rotated about it by more than this many times the noise.
    rotated_sigmas: float = 3.0
    #: Rotation slower than this is what a stabiliser lets pass.
    quick_s: float = 0.4
    #: A stabiliser leaves a smaller share of quick rotation.
    stabilised_share: float = 0.6
    #: Quick rotation must exceed the noise of images by this factor.
    clear_sigmas: float = 3.0
    #: Tracks must come back to where they began within this, px of the reduced image.
    round_trip_px: float = 0.7
    #: A track agrees with a rotation within this, px of the reduced image: so much translation may show.
    inlier_px: float = 3.0
    #: Least scatter of tracks, px of the reduced image.
    scatter_floor_px: float = 0.05
    #: Draws of two rays.
    draws: int = 100
    #: Rounds of reweighted least squares, at most.
    most_rounds: int = 15


_LIMITS = FlowLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class GreyFrame:
    """A frame reduced for looking at it.

    Attributes
    ----------
    name
        Of the frame.
    grey
        (H, W) its brightness in 8 bit.
    width, height
        Of the frame itself, px.
    """

    name: str
    grey: UInt8Array
    width: int
    height: int

    @classmethod
    def of(cls, frame: Frame, long_side_px: int) -> GreyFrame:
        """A frame, shrunk by area where its longer side is longer than this."""
        grey = reduce_image(convert_to_grey(frame.image), long_side_px)
        height, width = frame.image.shape[:2]
        return cls(
            name=frame.name,
            grey=np.asarray(grey if grey.dtype == np.uint8 else grey >> 8, dtype=np.uint8),
            width=width,
            height=height,
        )


def reduce_frames(frames: Iterable[Frame], long_side_px: int = FOLLOWED_PX) -> Iterator[GreyFrame]:
    """Reduce frames one by one; by default to the size in which corners are followed."""
    for frame in frames:
        yield GreyFrame.of(frame, long_side_px)


@dataclass(frozen=True, eq=False, kw_only=True)
class Tracks:
    """Some of the corners that were seen in two frames: 80 at most, strong and weak ones alike.

    Attributes
    ----------
    place
        (N, 2, 2) where in the first and the second image: down and across, as shares of the image from its middle.
    rays
        (N, 2, 2) their rays, z = 1.
    """

    place: Array
    rays: Array


class _PairRotation(NamedTuple):
    """Rotation vector of ``earlier_from_later``, its standard deviation, how many tracks agree, and all of them."""

    turn_rad: Array
    sigma_rad: float
    support: int
    tracks: Tracks


#: Of a pair of frames that shares too little.
_UNKNOWN = _PairRotation(np.full(3, np.nan), np.nan, 0, Tracks(place=np.zeros((0, 2, 2)), rays=np.zeros((0, 2, 2))))


@dataclass(frozen=True, eq=False, kw_only=True)
class VisualRotation:
    """Rotations between consecutive frames.

    Attributes
    ----------
    names
        (F,) of the frames.
    t_s
        (F,) the instants between which the rotations are: mid-exposure of the middle line, camera clock.
    turn_rad
        (F - 1, 3) rotation vectors of ``earlier_from_later``, camera frame; NaN where a pair told nothing.
    sigma_rad
        (F - 1,) standard deviation of each by the scatter of its tracks; the camera's translation adds to it.
    support
        (F - 1,) tracks that agree.
    tracks
        (F - 1) what was followed in each pair; empty where images were not followed.
    """

    names: tuple[str, ...]
    t_s: Array
    turn_rad: Array
    sigma_rad: Array
    support: IndexArray
    tracks: tuple[Tracks, ...] = ()
    epoch_ns: int = 0

    @property
    def step_s(self) -> float:
        """The usual time between frames."""
        return float(np.median(np.diff(self.t_s)))

    def trajectory(self) -> CameraTrajectory:
        """The longest unbroken run of frames, as orientations chained from its first frame; positions are zero.

        Raises
        ------
        NotObservableError
            Where no five frames hang together.
        """
        known = np.isfinite(self.turn_rad).all(axis=1)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
        runs = edges.reshape(-1, 2)
        longest = runs[np.argmax(runs[:, 1] - runs[:, 0])] if len(runs) else np.zeros(2, dtype=np.intp)
        begin, end = int(longest[0]), int(longest[1])
        if end - begin < 4:
            raise NotObservableError("camera rotation", Fact("too-few-corners-shared"))
        first_from_cam = quat_cumulative(quat_exp(self.turn_rad[begin:end]))
        return CameraTrajectory(
            names=self.names[begin : end + 1],
            t_s=self.t_s[begin : end + 1],
            cam_from_world_xyzw=quat_conjugate(first_from_cam),
            cam_in_world=np.zeros((end - begin + 1, 3)),
            epoch_ns=self.epoch_ns,
        )


def measure_rotation(
    frames: Iterable[GreyFrame], camera: Projector, timing: FrameTiming, options: FlowOptions | None = None
) -> VisualRotation:
    """Rotations of the camera between consecutive frames.

    Parameters
    ----------
    frames
        As of :func:`reduce_frames`, in order of time, all of one size; two are held at a time.
    camera
        Intrinsics with distortion, COLMAP's pixel coordinates. Without a calibration, a guess serves to find the clock
        offset and the axes: a wrong focal length scales all rotations equally.
    timing
        Holds every frame; its readout, where known, gives each line a time of its own.
    options
        Number of corners.
    """
    options = options or FlowOptions()
    index = {name: i for i, name in enumerate(timing.names)}
    pose_t_s = timing.pose_t_s()
    names: list[str] = []
    pairs: list[_PairRotation] = []
    before: tuple[UInt8Array, FrameShutter] | None = None
    for frame in frames:
        now = frame.grey, FrameShutter.of(timing, index[frame.name], width=frame.width, height=frame.height)
        if before is not None:
            pairs.append(_estimate_pair_rotation(before, now, camera, options))
        names.append(frame.name)
        before = now
    return VisualRotation(
        names=tuple(names),
        t_s=pose_t_s[[index[name] for name in names]],
        turn_rad=np.array([pair.turn_rad for pair in pairs]).reshape(-1, 3),
        sigma_rad=np.array([pair.sigma_rad for pair in pairs]),
        support=np.array([pair.support for pair in pairs], dtype=np.intp),
        tracks=tuple(pair.tracks for pair in pairs),
        epoch_ns=timing.epoch_ns,
    )


@dataclass(frozen=True, kw_only=True)
class Stabilisation:
    """Whether the image turns as the gyroscope says.

    Attributes
    ----------
    share
        Quick rotation in the image as a share of the gyroscope's (root mean square above about 1 Hz): about one
        where the image is as filmed, far less where it was stabilised. ``None`` where the hand was too still to say.
    stabilised
        ``None`` where that cannot be told.
    reason
        Why.
    """

    share: float | None = None
    stabilised: bool | None = None
    reason: Fact


@dataclass(frozen=True, kw_only=True)
class MotionCheck:
    """Whether the camera turned as its gyroscope and calibration say.

    Attributes
    ----------
    explained
        Share of the rotation in the images that the gyroscope explains: one is all of it, below zero is worse than
        no gyroscope. ``None`` where too few frames, or too little rotation, could be compared.
    gain
        (3,) rotation in the images per rotation measured, about each camera axis; negative means a flipped axis, NaN
        one about which the camera hardly turned. A common factor above or below one points at the focal length.
    agrees
        ``None`` where that cannot be told.
    reason
        Why.
    """

    explained: float | None = None
    gain: tuple[float, float, float] = (float("nan"), float("nan"), float("nan"))
    agrees: bool | None = None
    reason: Fact


def check_motion(rotation: VisualRotation, motion: GyroCamera) -> MotionCheck:
    """Compare the rotation between frames with the gyroscope's, axis by axis.

    Blur looks the same whichever way the camera turned; the way from frame to frame does not. So this tells a wrong
    sign, exchanged axes and a wrong clock offset from the right ones.

    Parameters
    ----------
    rotation
        From :func:`measure_rotation`.
    motion
        The gyroscope with the calibration to check, on the same clock.
    """
    known = np.isfinite(rotation.turn_rad).all(axis=1) & motion.covers(rotation.t_s[:-1], rotation.t_s[1:])
    if known.sum() < 3:
        return MotionCheck(reason=Fact("too-few-pairs-of-frames"))
    inertial = motion.turn_rad(rotation.t_s)[known]
    visual, sigma = rotation.turn_rad[known], float(np.median(rotation.sigma_rad[known]))
    size = np.sqrt(np.mean(visual**2))
    if size < _LIMITS.rotated_sigmas * sigma:
        return MotionCheck(reason=Fact("camera-hardly-turned"))
    # the median copes with pairs that were measured wrongly
    left, all_of_it = (float(np.median(np.sum(v**2, axis=1))) for v in (visual - inertial, visual))
    explained = 1 - left / max(all_of_it, 1e-12)
    gain = []
    for axis in range(3):
        x, y = inertial[:, axis], visual[:, axis]
        gain.append(fit_robust_slope(x, y) if np.sqrt(np.mean(x**2)) > _LIMITS.rotated_sigmas * sigma else float("nan"))
    flipped = ["xyz"[axis] for axis in range(3) if gain[axis] < -0.3]
    reason = Fact("rotation-explained", explained=explained, flipped=flipped)
    agrees = explained >= _LIMITS.least_explained and not flipped
    return MotionCheck(explained=explained, gain=(gain[0], gain[1], gain[2]), agrees=agrees, reason=reason)


def find_stabilisation(rotation: VisualRotation, imu: ImuRecording, *, offset_s: float | None = None) -> Stabilisation:
    """Tell electronic (or strong optical) stabilisation: the gyroscope turned, the image did not follow.

    What a stabiliser removes is quick; so rotations over frame intervals are compared without their running mean over
    0.4 s, by their size alone, which needs neither axes nor, over a whole recording, the clock offset.

    Parameters
    ----------
    rotation
        From :func:`measure_rotation`.
    imu
        Gyroscope of the same recording.
    offset_s
        Camera time = gyroscope time + this (both since their epochs), where known; otherwise the whole gyroscope
        recording is compared.
    """
    known = np.isfinite(rotation.turn_rad).all(axis=1)
    dt_s = np.diff(rotation.t_s)
    step_s = float(np.median(dt_s)) if len(dt_s) else np.inf
    if known.sum() < 20 or step_s > _LIMITS.quick_s / 3:
        return Stabilisation(reason=Fact("frames-too-sparse"))
    path = GyroPath(imu.gyro_t_s, imu.gyro_rad_s, np.median(imu.gyro_rad_s, axis=0))
    if offset_s is None:
        begin_s = np.arange(imu.gyro_t_s[0], imu.gyro_t_s[-1] - step_s, step_s)
        end_s = begin_s + step_s
    else:
        begin_s, end_s = rotation.t_s[:-1][known] - offset_s, rotation.t_s[1:][known] - offset_s
    inside = path.covers(begin_s, end_s)
    if inside.sum() < 20:
        return Stabilisation(reason=Fact("gyroscope-elsewhere"))
    inertial = path.turn_rad(begin_s[inside], end_s[inside]) / (end_s - begin_s)[inside, None]
    visual = rotation.turn_rad[known] / dt_s[known, None]
    noise = float(np.median(rotation.sigma_rad[known])) / step_s
    width = max(3, round(_LIMITS.quick_s / step_s))
    quick_inertial, quick_visual = _measure_quick_rotation(inertial, width), _measure_quick_rotation(visual, width)
    if quick_inertial < _LIMITS.clear_sigmas * noise or quick_inertial < 0.02:
        return Stabilisation(reason=Fact("camera-held-still"))
    share = quick_visual / quick_inertial
    stabilised = share < _LIMITS.stabilised_share
    reason = Fact("pictures-stabilised" if stabilised else "quick-rotation-shown", share=share)
    return Stabilisation(share=share, stabilised=stabilised, reason=reason)


def _measure_quick_rotation(rate: Array, width: int) -> float:
    """Robust size of what changes faster than the running mean over ``width`` samples."""
    quick = np.linalg.norm(subtract_running_mean(rate, width), axis=1)
    return float(np.sqrt(np.mean(np.sort(quick**2)[: max(1, int(0.98 * len(quick)))])))


def _estimate_pair_rotation(
    before: tuple[UInt8Array, FrameShutter],
    now: tuple[UInt8Array, FrameShutter],
    camera: Projector,
    options: FlowOptions,
) -> _PairRotation:
    shutters = before[1], now[1]
    dt_s = shutters[1].reference_s() - shutters[0].reference_s()
    size = np.array([shutters[1].width, shutters[1].height])
    for points in follow_points(before[0], now[0], shutters[1], options):
        rays = [np.asarray(camera.cam_from_img(p))[:, :2] for p in points]
        ok = np.isfinite(rays[0]).all(axis=1) & np.isfinite(rays[1]).all(axis=1)
        if ok.sum() < options.min_support:
            continue
        first, second = (append_unit_depth(r[ok]) for r in rays)
        span_s = shutters[1].middle_s(points[1][ok]) - shutters[0].middle_s(points[0][ok])
        # one pixel of the reduced image as an angle, in the middle of the image
        centre = 0.5 * size[None]
        beside = np.asarray(camera.cam_from_img(np.concatenate([centre, centre + size / now[0].shape[::-1]])))[:, :2]
        pixel_rad = float(np.linalg.norm(np.diff(beside, axis=0))) / np.sqrt(2)
        fitted = _fit_rate(first, second, span_s, pixel_rad)
        if fitted is not None and fitted[2] >= options.min_support:
            rate, sigma_rad_s, count = fitted
            place = np.stack([(p[ok] / size - 0.5)[:, ::-1] for p in points], axis=1)
            some = np.unique(np.linspace(0, len(place) - 1, min(len(place), _LIMITS.most_tracks)).astype(np.intp))
            tracks = Tracks(place=place[some], rays=np.stack([first[some, :2], second[some, :2]], axis=1))
            return _PairRotation(rate * dt_s, sigma_rad_s * abs(dt_s), count, tracks)
    return _UNKNOWN


def follow_points(
    before: UInt8Array, now: UInt8Array, shutter: FrameShutter, options: FlowOptions
) -> Iterator[tuple[Array, Array]]:
    """(N, 2) points that were followed from one reduced image to the other, px of the image as it is.

    Corners that were tracked come first, then features that were matched; ways that tell too little are left out.
    """
    if before.shape != now.shape:
        return
    to_full = np.array([shutter.width, shutter.height]) / now.shape[::-1]
    for matched in (_track_corners, _match_features):
        first, second = ((p.astype(np.float64) + 0.5) * to_full for p in matched(before, now, options))
        if len(first) >= options.min_support:
            yield first, second


def _track_corners(before: UInt8Array, now: UInt8Array, options: FlowOptions) -> tuple[Float32Array, Float32Array]:
    """Corners followed by pyramidal Lucas-Kanade, and back again; spread over the image."""
    import cv2

    distance = max(4.0, 0.5 * np.sqrt(before.size / options.corners))
    corners = cv2.goodFeaturesToTrack(before, options.corners, 0.01, distance)
    if corners is None or len(corners) < options.min_support:
        return np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32)
    points = corners.reshape(-1, 2)
    there, good = track_points(before, now, points, window_px=21, round_trip_px=_LIMITS.round_trip_px)
    return points[good], there[good]


def _match_features(before: UInt8Array, now: UInt8Array, options: FlowOptions) -> tuple[Float32Array, Float32Array]:
    """Features that are each other's best match: for frames too far apart to be tracked."""
    import cv2

    detector = cv2.SIFT.create(4 * options.corners)
    (points_a, a), (points_b, b) = (detector.detectAndCompute(image, None) for image in (before, now))
    if a is None or b is None or min(len(a), len(b)) < options.min_support:
        return np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32)
    matches = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(a, b)
    return (
        np.array([points_a[m.queryIdx].pt for m in matches], dtype=np.float32),
        np.array([points_b[m.trainIdx].pt for m in matches], dtype=np.float32),
    )


def _fit_rate(first: Array, second: Array, span_s: Array, pixel_rad: float) -> tuple[Array, float, int] | None:
    """One angular velocity (rad/s, camera frame) that turns the rays of one frame into those of the next.

    A ray seen at one time is seen ``span_s`` later rotated by ``exp(-rate span_s)``. Draws of two rays, then
    iteratively reweighted least squares with the weights of Geman and McClure; what translation moves counts as noise.

    Returns
    -------
    The rate, its standard deviation (per axis, the worst), and the rays within reach of it.
    """
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (first, second))
    mean_s = float(np.mean(span_s))
    if mean_s <= 0:
        return None
    reach = _LIMITS.inlier_px * pixel_rad
    draws = np.random.default_rng(0).integers(0, len(a), (_LIMITS.draws, 2))
    rotations = _solve_two_rays(a[draws], b[draws])
    # of unit vectors: the cosines of all rays after all draws, as one product
    cosines = rotations.reshape(-1, 9) @ (b[:, :, None] * a[:, None, :]).reshape(-1, 9).T
    counts = np.sum(2 - 2 * cosines < reach**2, axis=1)
    if counts.max(initial=-1) < 3:
        return None
    rate, scatter = -so3_log(rotations[np.argmax(counts)]) / mean_s, reach
    # of a global shutter, all rays turn for as long
    spans = span_s[:1] if np.ptp(span_s) == 0 else span_s
    for _ in range(_LIMITS.most_rounds):
        turn = so3_exp(-rate * spans[:, None])
        rotated = a @ turn[0].T if len(turn) == 1 else np.einsum("nij,nj->ni", turn, a)
        residual = b - rotated
        square = np.sum(residual**2, axis=1)
        near = square < (2 * reach) ** 2
        if near.sum() < 3:
            return None
        scatter = max(float(np.sqrt(np.median(square[near]))) / 1.18, _LIMITS.scatter_floor_px * pixel_rad)
        weight = 1 / (1 + square / (2.4 * scatter) ** 2) ** 2
        # d(exp(-rate s) a) = s [rotated]x d(rate), to first order; of a unit vector, [r]x' [r]x = 1 - r r'
        lever = weight * span_s**2
        information = float(lever.sum()) * np.eye(3) - rotated.T @ (lever[:, None] * rotated)
        if np.linalg.cond(information) > 1e8:
            return None
        step = np.linalg.solve(information, (weight * span_s) @ cross(residual, rotated))
        rate = rate + step
        if np.linalg.norm(step) * mean_s < 1e-7:
            break
    sigma = scatter * float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(information))[-1]))
    return rate, sigma, int(np.sum(square < reach**2))


def _solve_two_rays(a: Array, b: Array) -> Array:
    """Rotations that take two directions to two others, as well as can be; draws of nearly the same are left out.

    Parameters
    ----------
    a, b
        (N, 2, 3) draws of two directions.

    Returns
    -------
    (M, 3, 3) of M draws, in their order.
    """
    normals = [cross(pair[:, 0], pair[:, 1]) for pair in (a, b)]
    lengths = [np.linalg.norm(normal, axis=1, keepdims=True) for normal in normals]
    apart = np.all([length[:, 0] >= 0.02 for length in lengths], axis=0)
    frames = []
    for pair, normal, length in zip((a, b), normals, lengths, strict=True):
        middle = pair[apart, 0] + pair[apart, 1]
        middle = middle / np.linalg.norm(middle, axis=1, keepdims=True)
        up = normal[apart] / length[apart]
        frames.append(np.stack([middle, up, cross(middle, up)], axis=2))
    return np.asarray(frames[1] @ np.swapaxes(frames[0], 1, 2))
