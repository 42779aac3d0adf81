"""Motion blur of every pixel from the gyroscope, and where it is known from the camera's translation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraImuCalibration, FrameTiming, ImuRecording, Projector
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath, middles, samples_for
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.parallax import Parallax
from colmap_inertial.imaging.rolling_shutter import rays


@dataclass(frozen=True, kw_only=True)
class PredictionGrid:
    """Grid of the prediction of blur, and exposures at once."""

    #: Nodes at which the blur of a frame is predicted, and frames predicted together.
    predicted_columns: int = 7
    predicted_rows: int = 5
    chunk: int = 512
    #: An image that moves with the shutter would be blurred without end; its blur is taken as finite.
    least_stretch: float = 0.2
    #: By which the camera is turned to find what its errors do.
    small_turn_rad: float = 1e-4


_LIMITS = PredictionGrid()


class Camera(Projector, Protocol):
    """Intrinsics with image sizes; ``pycolmap.Camera`` is one."""

    @property
    def width(self) -> int: ...

    @property
    def height(self) -> int: ...


def frame_blur(
    name: str, imu: ImuRecording, calibration: CameraImuCalibration, timing: FrameTiming, camera: Camera
) -> BlurField:
    """The motion blur of one frame of a recording, which :func:`~colmap_inertial.imaging.path_filters.deblur` undoes.

    For many frames, make the :class:`GyroCamera` once and call :func:`blur_field` for each.

    Parameters
    ----------
    name
        Of the frame, as in ``timing``.
    imu
        Its gyroscope.
    calibration
        Rotation, time offset and gyroscope bias.
    timing
        Of all frames, with exposure times; a readout that is unknown counts as none.
    camera
        Intrinsics (``model.colmap_camera`` makes them of a :class:`~colmap_inertial.core.types.CameraModel`).

    Raises
    ------
    ValueError
        Where ``timing`` holds no such frame.
    NotObservableError
        As :func:`blur_field`.
    """
    if name not in timing.names:
        raise ValueError(f"{name}: no such frame among the {len(timing.names)} of the timing")
    motion = GyroCamera.from_timed(CameraTimedImu.from_recording(imu, calibration, timing.epoch_ns))
    shutter = FrameShutter.of(timing, timing.names.index(name), width=camera.width, height=camera.height)
    return blur_field(motion, camera, shutter)


def blur_field(
    motion: GyroCamera,
    camera: Projector,
    shutter: FrameShutter,
    *,
    parallax: Parallax | None = None,
    step_px: int = 16,
) -> BlurField:
    """The segment that each pixel of a frame smears along, by the camera's motion during the exposure of its line.

    A pixel x of a line exposed around t_m sees, at time t, what it sees at t_m at
    ``project(R(t_m)' R(t) ray(x) + (t - t_m) v / z(x))``, with velocity v and depth z. The vector is the difference of
    that between the end and the beginning of the exposure. The lines of a rolling shutter see that content at times of
    their own; with the shutter's speed d (seconds per pixel, along y) the vector b becomes
    ``b / (1 + b_y d / exposure)``.

    Parameters
    ----------
    motion
        The gyroscope on the camera's clock.
    camera
        Intrinsics with distortion (``pycolmap.Camera`` is one), COLMAP's pixel coordinates.
    shutter
        When the lines of this frame are exposed.
    parallax
        Velocity and depths; without it, the camera only rotates.
    step_px
        Distance of the field's nodes. At 16 px the field errs by some thousandths of a pixel between them.

    Raises
    ------
    NotObservableError
        Where the exposure is unknown, or the gyroscope did not record all of it.
    """
    if shutter.exposure_s is None:
        raise NotObservableError("motion blur", _NO_EXPOSURE)
    if not shutter.covered_by(motion):
        raise NotObservableError("motion blur", _NOT_COVERED)
    x, y = _node_axes(shutter.width, shutter.height, step_px)
    rates = None if parallax is None else parallax.rate_at(x, y)[None]
    exposure = _Exposures(shutter, np.array([shutter.t_s]), np.array([shutter.exposure_s]))
    vectors = _compute_vectors(motion, camera, exposure, x, y, rates)[0]
    return BlurField(
        width=shutter.width,
        height=shutter.height,
        vector_px=_fill_nodes(vectors).astype(np.float32),
        step_px=step_px,
        cov_px2=_fill_nodes(_compute_vector_cov(motion, camera, shutter, x, y)).astype(np.float32),
    )


def blur_path(
    motion: GyroCamera,
    camera: Projector,
    shutter: FrameShutter,
    *,
    parallax: Parallax | None = None,
    extent_factor: float = 1.0,
    step_px: int = 64,
) -> BlurPath:
    """The curve that each pixel of a frame smears along, of which :func:`blur_field` gives the chord.

    Light that reaches pixel x of a line exposed around t_m at time t comes from what stands, at t_m, at
    ``x + u = project(R(t_m)' R(t) ray(x) + (t - t_m) v / z(x))``. The sharp image of a rolling shutter has it on
    another line, exposed d u later (d seconds per pixel), when it has moved on by ``-u' d (x + q - x)``, u' the path's
    own speed in the middle of the exposure: ``q = u - u' (d u) / (1 + d u')``.

    Parameters
    ----------
    motion, camera, shutter, parallax
        As for :func:`blur_field`.
    extent_factor
        By which the exposure is longer than the shutter says, around the same middle.
    step_px
        Distance of the nodes.

    Raises
    ------
    NotObservableError
        As :func:`blur_field`.
    """
    field = blur_field(motion, camera, shutter, parallax=parallax, step_px=step_px).times(extent_factor)
    assert shutter.exposure_s is not None
    exposure_s = extent_factor * shutter.exposure_s
    since_s = exposure_s * middles(samples_for(float(field.extent_px().max())))
    x, y = _node_axes(shutter.width, shutter.height, step_px)
    grid = _Grid.of(camera, shutter, x, y)
    middle_s = shutter.middle_s(grid.lines_px)
    turn = np.swapaxes(motion.start_from_cam(middle_s), -1, -2) @ motion.start_from_cam(middle_s + since_s[:, None])
    seen = grid.turned(turn)
    if parallax is not None:
        seen = seen + since_s[:, None, None, None] * parallax.rate_at(x, y)
    path = _project(camera, seen) - grid.nodes_px
    step_s = np.array(shutter.line_step_s)
    if exposure_s > 0 and step_s.any():
        before, after = (len(since_s) - 1) // 2 - 1, len(since_s) // 2 + 1
        speed = (path[after] - path[before]) / (since_s[after] - since_s[before])
        stretch = np.maximum(1 + speed @ step_s, _LIMITS.least_stretch)
        path = path - ((path @ step_s) / stretch)[..., None] * speed
    filled = _fill_nodes(np.moveaxis(path, 0, 2).reshape(len(y), len(x), -1)).reshape(len(y), len(x), -1, 2)
    return BlurPath(
        width=shutter.width,
        height=shutter.height,
        path_px=np.moveaxis(filled, 2, 0).astype(np.float32),
        step_px=step_px,
        cov_px2=field.cov_px2,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class PredictedBlur:
    """Blur of the frames of a recording, before any is decoded.

    Attributes
    ----------
    names
        (F,) of the frames.
    px
        (F,) 90th percentile of the blur's length over the image, px of the image as it is; NaN where unknown.
    reasons
        (F,) why it is unknown; ``None`` where it is known.
    """

    names: tuple[str, ...]
    px: Array
    reasons: tuple[Fact | None, ...]


def predict_blur_px(
    motion: GyroCamera,
    camera: Projector,
    timing: FrameTiming,
    *,
    width: int,
    height: int,
    parallaxes: Mapping[str, Parallax] | None = None,
) -> PredictedBlur:
    """The blur of every frame before it is decoded: to rank frames, and to choose what is deblurred.

    Parameters
    ----------
    motion
        The gyroscope on the camera's clock.
    camera
        As in :func:`blur_field`.
    timing
        Of all frames.
    width, height
        Size of the images.
    parallaxes
        By frame name, where they are known.
    """
    parallaxes = parallaxes or {}
    count = len(timing.t_s)
    px = np.full(count, np.nan)
    reasons: list[Fact | None] = [_NO_EXPOSURE] * count
    if timing.exposure_s is not None:
        readout_s = timing.readout_s or 0.0
        covered = motion.covers(timing.t_s, timing.t_s + timing.exposure_s + readout_s)
        reasons = [None if inside else _NOT_COVERED for inside in covered]
        x = (np.arange(_LIMITS.predicted_columns) + 0.5) * width / _LIMITS.predicted_columns
        y = (np.arange(_LIMITS.predicted_rows) + 0.5) * height / _LIMITS.predicted_rows
        known = np.flatnonzero(covered)
        for part in np.split(known, range(_LIMITS.chunk, len(known), _LIMITS.chunk)):
            if len(part):
                shutter = FrameShutter.of(timing, int(part[0]), width=width, height=height)
                rates = np.zeros((len(part), len(y), len(x), 3))
                for rate, i in zip(rates, part, strict=True):
                    if timing.names[i] in parallaxes:
                        rate[:] = parallaxes[timing.names[i]].rate_at(x, y)
                exposures = _Exposures(shutter, timing.t_s[part], timing.exposure_s[part])
                vectors = _compute_vectors(motion, camera, exposures, x, y, rates)
                lengths = np.hypot(vectors[..., 0], vectors[..., 1]).reshape(len(part), -1)
                px[part] = np.nanpercentile(lengths, 90, axis=1)
    return PredictedBlur(names=timing.names, px=px, reasons=tuple(reasons))


_NO_EXPOSURE = Fact("exposure-unknown")
_NOT_COVERED = Fact("exposure-not-covered")


@dataclass(frozen=True, eq=False)
class _Grid:
    """Nodes of a grid over an image, the rays through them, and the lines of the shutter that they lie on.

    Attributes
    ----------
    nodes_px
        (Y, X, 2) COLMAP's pixel coordinates.
    directions
        (Y, X, 3) rays in the camera frame, z = 1.
    by_column
        Whether lines are columns: what belongs to a line varies along x.
    lines_px
        (L, 2) a node of each line.
    """

    nodes_px: Array
    directions: Array
    by_column: bool
    lines_px: Array

    @classmethod
    def of(cls, camera: Projector, shutter: FrameShutter, x: Array, y: Array) -> _Grid:
        nodes = np.stack(np.meshgrid(x, y), axis=-1)
        by_column = shutter.readout_direction in ("right", "left")
        directions = rays(camera, nodes.reshape(-1, 2)).reshape(*nodes.shape[:2], 3)
        return cls(nodes, directions, by_column, nodes[0] if by_column else nodes[:, 0])

    def turned(self, turn: Array) -> Array:
        """(F, Y, X, 3) the rays after (F, L, 3, 3) rotations of their lines."""
        # a product of matrices for each line
        lines = np.swapaxes(self.directions, 0, 1) if self.by_column else self.directions
        turned = lines @ np.swapaxes(turn, -1, -2)
        return np.swapaxes(turned, 1, 2) if self.by_column else turned


def _project(camera: Projector, points: Array) -> Array:
    """(..., 2) pixels of (..., 3) points in the camera frame."""
    return np.asarray(camera.img_from_cam(points.reshape(-1, 3))).reshape(*points.shape[:-1], 2)


def _node_axes(width: int, height: int, step_px: int) -> tuple[Array, Array]:
    """Columns and rows of a field's nodes, COLMAP's pixel coordinates."""
    rows, columns = BlurField.nodes(width, height, step_px)
    return step_px * np.arange(float(columns)) + 0.5, step_px * np.arange(float(rows)) + 0.5


@dataclass(frozen=True, eq=False)
class _Exposures:
    """Frames that have ``shutter``'s readout: (F,) when they begin to expose, and for how long."""

    shutter: FrameShutter
    t_s: Array
    exposure_s: Array


def _compute_vectors(
    motion: GyroCamera, camera: Projector, frames: _Exposures, x: Array, y: Array, rates: Array | None
) -> Array:
    """(F, len(y), len(x), 2) blur vectors of F frames, at the nodes of a grid.

    ``rates``: (F, len(y), len(x), 3) velocity times inverse depth, 1/s.
    """
    shutter, exposure_s = frames.shutter, frames.exposure_s
    grid = _Grid.of(camera, shutter, x, y)
    step_x, step_y = shutter.line_step_s
    # mid-exposure of each node's line against the start of its frame
    delay_s = shutter.middle_s(grid.lines_px) - shutter.t_s - 0.5 * (shutter.exposure_s or 0.0)
    middle_s = frames.t_s[:, None] + 0.5 * exposure_s[:, None] + delay_s
    half_s = 0.5 * exposure_s[:, None]
    middle = np.swapaxes(motion.start_from_cam(middle_s), -1, -2)
    ends = []
    for sign in (-1, 1):
        turn = middle @ motion.start_from_cam(middle_s + sign * half_s)
        seen = grid.turned(turn)
        if rates is not None:
            seen = seen + sign * half_s[:, None, :, None] * rates
        ends.append(_project(camera, seen))
    vector = ends[1] - ends[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        per_s = vector / exposure_s[:, None, None, None]
    stretch = 1 + np.nan_to_num(per_s[..., 0]) * step_x + np.nan_to_num(per_s[..., 1]) * step_y
    return np.asarray(vector / np.maximum(stretch, _LIMITS.least_stretch)[..., None])


def _compute_vector_cov(motion: GyroCamera, camera: Projector, shutter: FrameShutter, x: Array, y: Array) -> Array:
    """(len(y), len(x), 3) covariance xx, xy, yy of blur vectors at the nodes of a grid, by the errors of the turn."""
    grid = _Grid.of(camera, shutter, x, y)
    lever = np.empty((*grid.nodes_px.shape, 3))
    for axis in range(3):
        turned = grid.directions + _LIMITS.small_turn_rad * np.cross(np.eye(3)[axis], grid.directions)
        lever[..., axis] = (_project(camera, turned) - grid.nodes_px) / _LIMITS.small_turn_rad
    turn = motion.turn_cov_rad2(shutter.middle_s(grid.lines_px), shutter.exposure_s or 0.0)
    weighed = np.einsum("xij,yxkj->yxki" if grid.by_column else "yij,yxkj->yxki", turn, lever)
    return np.stack(
        [(lever[..., i, :] * weighed[..., j, :]).sum(axis=-1) for i, j in ((0, 0), (0, 1), (1, 1))], axis=-1
    )


def _fill_nodes(vectors: Array) -> Array:
    """Nodes beyond the image's edge that no ray meets take the vector of the nearest one that some ray does."""
    bad = ~np.isfinite(vectors).all(axis=-1)
    if not bad.any():
        return vectors
    if bad.all():
        raise ValueError("the camera's intrinsics map no pixel to a ray")
    known, unknown = np.argwhere(~bad), np.argwhere(bad)
    out = vectors.copy()
    for node in unknown:
        nearest = known[np.argmin(np.sum((known - node) ** 2, axis=1))]
        out[tuple(node)] = vectors[tuple(nearest)]
    return out
