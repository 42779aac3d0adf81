"""Set the problem up from a metric COLMAP model and a recording, and turn its solution back into a model."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CAL, CameraImuCalibration, CameraModel, FrameTiming, ImuNoise, ImuRecording
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.inertial.core.preintegration import SensorErrors, SensorStreams, preintegrate
from colmap_inertial.inertial.core.priors import PRIORS, gains_cov
from colmap_inertial.inertial.refine._residuals import cameras_of, poses_at, project, turning_around
from colmap_inertial.inertial.refine.values import (
    CLOCK_RATE,
    FIRST_INTRINSIC,
    LEVER,
    OFFSET,
    READOUT,
    ROTATION,
    Distances,
    Estimate,
    FreeCamera,
    Inertial,
    Observations,
    Prior,
    Problem,
)

if TYPE_CHECKING:
    import pycolmap

#: Standard deviations of what the first guess leaves of the rotation, the offset and a camera's numbers: wide.
_ROTATION_RAD, _OFFSET_S, _INTRINSIC_SHARE = 0.05, 0.02, 0.1
#: Of a readout that is none.
NO_READOUT_S = 1e-9
#: Readings are looked up as far beyond the readout around a node; one that is not declared is hardly longer than this.
_MARGIN_S, _LONGEST_READOUT_S = 0.01, 0.04
#: Cameras more than this are not estimated: each image has its own.
_MOST_FREE_CAMERAS = 4
#: Frames farther apart say nothing of each other through the IMU.
_LONGEST_STEP_S = 10.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """Content of a COLMAP model, in arrays.

    Attributes
    ----------
    image_ids
        (F,) in order of time, those without a time last.
    names
        Of the images.
    t_s
        (F,) when the middle line was exposed; nan without a time.
    cam_from_world, cam_in_world
        (F, 3, 3), (F, 3).
    point_ids, points
        (P,), (P, 3) with two observations or more, in order of the first one's time.
    observations
        Where COLMAP has them.
    place
        (M,) of each observation among its image's keypoints.
    cameras, camera_ids, camera_of
        The cameras, their numbers, and (F,) that of each frame.
    """

    image_ids: tuple[int, ...]
    names: tuple[str, ...]
    t_s: Array
    cam_from_world: Array
    cam_in_world: Array
    point_ids: tuple[int, ...]
    points: Array
    observations: Observations
    place: Int64Array
    cameras: tuple[CameraModel, ...]
    camera_ids: tuple[int, ...]
    camera_of: Int64Array


def read_seen(
    reconstruction: pycolmap.Reconstruction, timing: FrameTiming, image_ids: Collection[int] | None = None
) -> Seen:
    """Read a model, or some of its images, into arrays; its observations are at the middle line."""
    t_of = dict(zip(timing.names, timing.pose_t_s().tolist(), strict=True))
    image_ids = reconstruction.reg_image_ids() if image_ids is None else image_ids
    images = sorted(map(reconstruction.image, image_ids), key=lambda image: (t_of.get(image.name, np.inf), image.name))
    number = {image.image_id: i for i, image in enumerate(images)}
    keypoints = [np.array([p.xy for p in image.points2D]).reshape(-1, 2) for image in images]
    tracks = _read_tracks(reconstruction, number)
    seen = [element for *_, elements, _ in tracks for element in elements]
    frames, places = np.array(seen, dtype=np.int64).reshape(-1, 2).T
    first = np.cumsum([0, *(len(k) for k in keypoints)])
    every = np.concatenate(keypoints)
    camera_ids = tuple(sorted({image.camera_id for image in images}))
    poses = [image.cam_from_world() for image in images]
    return Seen(
        image_ids=tuple(image.image_id for image in images),
        names=tuple(image.name for image in images),
        t_s=np.array([t_of.get(image.name, np.nan) for image in images]),
        cam_from_world=np.array([pose.rotation.matrix() for pose in poses]),
        cam_in_world=np.array([image.projection_center() for image in images]),
        point_ids=tuple(point_id for _, point_id, _, _ in tracks),
        points=np.array([point_m for *_, point_m in tracks]).reshape(-1, 3),
        observations=Observations(
            frame=frames,
            point=np.repeat(np.arange(len(tracks)), [len(elements) for *_, elements, _ in tracks]),
            xy_px=every[first[frames] + places],
            line=np.zeros(len(frames)),
        ),
        place=places,
        cameras=tuple(_read_camera(reconstruction.camera(i)) for i in camera_ids),
        camera_ids=camera_ids,
        camera_of=np.array([camera_ids.index(image.camera_id) for image in images], dtype=np.int64),
    )


def _read_camera(camera: pycolmap.Camera) -> CameraModel:
    return CameraModel(model=camera.model.name, width=camera.width, height=camera.height, params=tuple(camera.params))


def _read_tracks(
    reconstruction: pycolmap.Reconstruction, number: Mapping[int, int]
) -> list[tuple[int, int, list[tuple[int, int]], Array]]:
    """First frame, number, elements (frame, place among keypoints) and position of points seen twice or more.

    By time: what is worked on one after the other then lies side by side in memory.
    """
    tracks = []
    for point_id, point in reconstruction.points3D.items():
        elements = sorted((number[e.image_id], e.point2D_idx) for e in point.track.elements if e.image_id in number)
        if len(elements) > 1:
            tracks.append((elements[0][0], int(point_id), elements, point.xyz))
    return sorted(tracks, key=lambda track: track[:2])


def lines_of(seen: Seen, timing: FrameTiming, xy_px: Array) -> Array:
    """(M,) how much later than the middle line each observation was exposed, in readouts."""
    out = np.zeros(len(xy_px))
    if timing.readout_s == 0:
        return out
    index = {name: i for i, name in enumerate(timing.names)}
    long_readout = replace(timing, readout_s=0.5)  # of any length: shares are asked for
    for i, camera in enumerate(seen.cameras):
        mine = seen.camera_of[seen.observations.frame] == i
        shutter = FrameShutter.of(long_readout, next(iter(index.values())), width=camera.width, height=camera.height)
        out[mine] = (shutter.middle_s(xy_px[mine]) - shutter.reference_s()) / 0.5
    return out


def keypoints_of(seen: Seen, keypoints_px: Mapping[str, Array]) -> Array:
    """(M, 2) observations by image names' keypoints (N, 2); as the model has them where there are none."""
    out = seen.observations.xy_px.copy()
    for name, mine in zip(seen.names, _group_by_frame(seen), strict=True):
        if name in keypoints_px:
            out[mine] = keypoints_px[name][seen.place[mine]]
    return out


def _group_by_frame(seen: Seen) -> list[Int64Array]:
    """Indices of the observations of each frame."""
    frames = seen.observations.frame
    order = np.argsort(frames, kind="stable")
    return np.split(order, np.searchsorted(frames[order], np.arange(1, len(seen.names))))


@dataclass(frozen=True, eq=False, kw_only=True)
class Known:
    """Values that were known or estimated before.

    Attributes
    ----------
    calibration
        The camera-IMU calibration that the scale estimate refined: the start.
    prior
        What was declared of it.
    noise
        Of the IMU, as the scale estimate found it.
    accel_bias_m_s2
        (3,) start.
    down
        (3,) unit vector of gravity in the model's world.
    gravity_m_s2, gravity_sigma_m_s2
        Its strength.
    refine_intrinsics
        Whether the cameras' numbers are estimated.
    """

    calibration: CameraImuCalibration
    prior: CameraImuCalibration
    noise: ImuNoise
    accel_bias_m_s2: Array
    down: Array
    gravity_m_s2: float
    gravity_sigma_m_s2: float
    refine_intrinsics: bool


def make_problem(
    seen: Seen, timing: FrameTiming, imu: ImuRecording, known: Known, raw_px: Array
) -> tuple[Problem, Estimate]:
    """The problem, and where to start.

    Raises
    ------
    NotObservableError
        Where the IMU recorded hardly any of the frames, or these see nothing.
    """
    # what is estimated of the accelerometer's delay counts from the calibration's
    streams = SensorStreams.from_camera(CameraTimedImu.from_recording(imu, known.calibration, timing.epoch_ns))
    if not len(seen.observations.frame):
        raise NotObservableError("refinement", Fact("refine-no-common-points"))
    timed = np.isfinite(seen.t_s)
    begin_s = max(streams.gyro.t_s[0], streams.accel.t_s[0])
    end_s = min(streams.gyro.t_s[-1], streams.accel.t_s[-1])
    half_s = 0.5 * (_LONGEST_READOUT_S if timing.readout_s is None else timing.readout_s) + _MARGIN_S
    with np.errstate(invalid="ignore"):
        inside = timed & (seen.t_s > begin_s + half_s) & (seen.t_s < end_s - half_s)
    nodes_s = np.where(timed, seen.t_s, 0.0)
    path = GyroPath(streams.gyro.t_s, streams.gyro.value, np.zeros(3))
    inside &= path.covers(nodes_s - half_s, nodes_s + half_s)
    untimed = np.flatnonzero(~timed)
    nodes_s[untimed] = nodes_s[timed].max() + 1.0 + np.arange(len(untimed))
    linked = inside[:-1] & inside[1:] & (np.diff(nodes_s) < _LONGEST_STEP_S) & path.covers(nodes_s[:-1], nodes_s[1:])
    if linked.sum() < max(5, 0.5 * (len(nodes_s) - 1)):
        raise NotObservableError("refinement", Fact("refine-imu-missing"))
    inertial = Inertial(
        nodes_s=nodes_s,
        linked=linked,
        streams=streams,
        noise=known.noise,
        turning=turning_around(np.where(inside, nodes_s, nodes_s[inside][0]), streams, half_s),
        down=known.down,
    )
    lines = lines_of(seen, timing, raw_px)
    observations = replace(seen.observations, xy_px=raw_px, line=np.where(inside[seen.observations.frame], lines, 0.0))
    cameras = free_cameras(seen, known.refine_intrinsics)
    start = _start(seen, cameras, inertial, known, timing)
    problem = Problem(
        observations=observations,
        cameras=cameras,
        camera_of=seen.camera_of,
        inertial=inertial,
        prior=Prior(
            mean=_put_declared_back(start, known),
            info=_information(start, known, imu, timing),
            gyro_bias_sigma_rad_s=0.1,
            accel_bias_sigma_m_s2=PRIORS.accel_bias_m_s2,
        ),
        sigma_px=1.0,
        distances=_measure_distances(seen),
    )
    return problem, start


def _measure_distances(seen: Seen) -> Distances:
    """How far points are from the first camera that sees each, in the model."""
    camera = seen.cam_in_world[seen.observations.frame[seen.observations.first[:-1]]]
    return Distances(camera_in_world_m=camera, distance_m=np.linalg.norm(seen.points - camera, axis=1))


def _put_declared_back(start: Estimate, known: Known) -> Estimate:
    """The start, with what was declared beforehand in place of what was estimated since."""
    declared, refined = known.prior, known.calibration
    delay_s = declared.accel_delay_s - refined.accel_delay_s
    return replace(start, imu_in_cam_m=declared.imu_in_cam_m, accel_delay_s=delay_s)


def free_cameras(seen: Seen, free: bool) -> tuple[FreeCamera, ...]:
    """The cameras, of which few may be estimated where that is asked for."""
    free = free and len(seen.cameras) <= _MOST_FREE_CAMERAS
    return tuple(FreeCamera(model=c, free=_free_numbers(c) if free else ()) for c in seen.cameras)


def intrinsics_of(cameras: tuple[FreeCamera, ...]) -> tuple[Array, Array]:
    """(n,) free numbers of the cameras, and how far they may be off."""
    numbers = np.array([camera.model.params[i] for camera in cameras for i in camera.free])
    return numbers, _INTRINSIC_SHARE * np.maximum(np.abs(numbers), 1.0)


def _free_numbers(camera: CameraModel) -> tuple[int, ...]:
    """Focal lengths and the lens's numbers; the principal point stays, as COLMAP's own bundle adjustment has it."""
    from colmap_inertial.model import colmap_camera

    built = colmap_camera(camera)
    return (*built.focal_length_idxs(), *built.extra_params_idxs())


def _start(
    seen: Seen, cameras: tuple[FreeCamera, ...], inertial: Inertial, known: Known, timing: FrameTiming
) -> Estimate:
    calibration = known.calibration
    cam_from_imu = matrix_from_quat(calibration.cam_from_imu_xyzw)
    world_from_cam = seen.cam_from_world.transpose(0, 2, 1)
    world_from_imu = world_from_cam @ cam_from_imu
    position = seen.cam_in_world + world_from_cam @ calibration.imu_in_cam_m
    count = len(position)
    gyro_bias = np.tile(calibration.gyro_bias_rad_s, (count, 1))
    accel_bias = np.tile(known.accel_bias_m_s2, (count, 1))
    none = np.zeros((3, 3))
    errors = SensorErrors(
        gyro_bias_rad_s=gyro_bias[1:], accel_bias_m_s2=accel_bias[1:], gyro_gain=none, accel_gain=none
    )
    pre = preintegrate(inertial.nodes_s, inertial.streams, errors)
    dt = pre.dt_s[:, None]
    gravity = known.gravity_m_s2 * known.down
    carried = np.einsum("nij,nj->ni", world_from_imu[:-1], pre.position)
    velocity = np.zeros((count, 3))
    velocity[:-1] = np.diff(position, axis=0) / dt - 0.5 * gravity * dt - carried / dt
    velocity[:-1][~inertial.linked] = 0.0
    ends = np.flatnonzero(np.append(~inertial.linked, True) & np.append(False, inertial.linked))
    gained = np.einsum("nij,nj->ni", world_from_imu[ends - 1], pre.velocity[ends - 1])
    velocity[ends] = velocity[ends - 1] + gravity * dt[ends - 1] + gained
    return Estimate(
        world_from_imu=world_from_imu,
        imu_in_world_m=position,
        velocity_m_s=velocity,
        gyro_bias_rad_s=gyro_bias,
        accel_bias_m_s2=accel_bias,
        points_m=seen.points,
        cam_from_imu=cam_from_imu,
        imu_in_cam_m=calibration.imu_in_cam_m,
        offset_s=0.0,
        clock_rate=0.0,
        readout_s=timing.readout_s or 0.0,
        intrinsics=intrinsics_of(cameras)[0],
        accel_delay_s=0.0,
        gyro_gain=none,
        accel_gain=none,
        gravity_m_s2=known.gravity_m_s2,
    )


def _information(start: Estimate, known: Known, imu: ImuRecording, timing: FrameTiming) -> Array:
    """Prior information of the shared numbers: as the joint estimator has it."""
    cov = known.prior.cov
    variance, at = np.diagonal(cov), start.columns
    gyro, accel = CAL.GYRO_TIME_OFFSET, CAL.ACCEL_TIME_OFFSET
    sigma = np.empty(at.count)
    sigma[ROTATION], sigma[OFFSET] = _ROTATION_RAD, _OFFSET_S
    sigma[LEVER] = np.maximum(np.sqrt(variance[CAL.LEVER_ARM]), 1e-6)
    sigma[CLOCK_RATE] = PRIORS.clock_rate
    sigma[READOUT] = np.sqrt(variance[CAL.READOUT]) if timing.readout_s != 0 else NO_READOUT_S
    sigma[FIRST_INTRINSIC : at.seen.stop] = _INTRINSIC_SHARE * np.maximum(np.abs(start.intrinsics), 1.0)
    sigma[at.accel_delay] = np.sqrt(max(variance[gyro] + variance[accel] - 2 * cov[gyro, accel], 1e-8))
    sigma[at.gyro_gain], sigma[at.accel_gain] = PRIORS.gyro_gain, PRIORS.accel_gain
    sigma[at.gravity] = known.gravity_sigma_m_s2
    info = np.diag(sigma**-2)
    if imu.calibration is not None:
        here = np.r_[at.accel_gain, at.gyro_gain]
        info[np.ix_(here, here)] = np.linalg.inv(gains_cov(imu))
    return info


@dataclass(frozen=True, eq=False, kw_only=True)
class Written:
    """A solution in COLMAP's terms, all lines exposed at once.

    Attributes
    ----------
    cam_from_world, cam_in_world
        (F, 3, 3), (F, 3) when the middle line was exposed.
    xy_px
        (M, 2) where each observation would have been.
    """

    cam_from_world: Array
    cam_in_world: Array
    xy_px: Array


def move_to_middle_lines(problem: Problem, x: Estimate) -> Written:
    """Move observations to where a camera without a rolling shutter would have them."""
    frames = np.arange(len(x.velocity_m_s))
    poses = poses_at(problem, x, frames, np.zeros(len(frames)))
    cam_from_world = x.cam_from_imu @ poses.world_from_imu.transpose(0, 2, 1)
    centre = poses.imu_in_world_m - np.einsum("nji,j->ni", cam_from_world, x.imu_in_cam_m)
    observations = problem.observations
    moved = observations.xy_px
    if np.any(observations.line != 0):
        at_once = replace(observations, line=np.zeros(len(moved)))
        here, there = project(problem, x, observations), project(problem, x, at_once)
        both = (here.seen & there.seen)[:, None]
        # residuals are predicted less measured
        moved = moved + np.where(both, there.residual - here.residual, 0.0)
    return Written(cam_from_world=cam_from_world, cam_in_world=centre, xy_px=moved)


def write_back(
    reconstruction: pycolmap.Reconstruction, seen: Seen, problem: Problem, x: Estimate, *, rectified: bool = True
) -> pycolmap.Reconstruction:
    """A copy of a model with the poses, points, observations and cameras of a solution.

    Observations are as a global shutter would have made them; as they were, where images are not ``rectified``.

    Points that fewer than two of its images see were no part of it, and go.
    """
    import pycolmap

    written = move_to_middle_lines(problem, x)
    copy = pycolmap.Reconstruction(reconstruction)
    for i, (image_id, mine) in enumerate(zip(seen.image_ids, _group_by_frame(seen), strict=True)):
        rotation = written.cam_from_world[i]
        image = copy.image(image_id)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ written.cam_in_world[i])
        copy.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)
        points2D = image.points2D
        for o in mine if rectified else ():
            points2D[int(seen.place[o])].xy = written.xy_px[o]
    for point_id in set(copy.point3D_ids()) - set(seen.point_ids):
        copy.delete_point3D(point_id)
    for point_id, xyz in zip(seen.point_ids, x.points_m, strict=True):
        copy.points3D[point_id].xyz = xyz
    for camera_id, camera in zip(seen.camera_ids, cameras_of(problem, x), strict=True):
        copy.camera(camera_id).params = camera.params
    copy.update_point_3d_errors()
    return copy
