"""Worlds with real motion and a real IMU, synthetic only in their images: for ``scripts/studies/refine_real.py``.

Truth is motion capture smoothed with the same recording's IMU. Fast noise of the IMU is partly in it: errors slower
than a second are judged. Points lie on the walls of a room around the path, a third of them before the walls; a camera
on the path sees them with noise, outliers and missed sightings, and loses them for good after a second or two. COLMAP's
bundle adjustment makes the model of what it saw.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_from_matrix, slerp, so3_exp, so3_log
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraTrajectory, FrameTiming, ImuRecording
from colmap_inertial.inertial.scale import estimate_scale
from scripts.common.real_imu import MARGIN_S, RECORDINGS, Motion, read

#: Picture, focal length, radial term; their errors at the start.
SIZE_PX, FOCAL_PX, RADIAL = (752, 480), 460.0, -0.05
FOCAL_SHARE, RADIAL_OFF = 0.003, 0.004
#: Walls stand so far beyond the path (m), this share of points up to so far before them.
WALLS_M, BEFORE_SHARE, BEFORE_M = 2.0, 0.3, 0.8
#: How long a point is followed on average; share of sightings that are missed; of false ones, and their scale.
LIFE_S, MISSED, FALSE, FALSE_PX = 1.5, 0.2, 0.05, 5.0
#: Errors of the start: growth of the scale along the path, position, rotation.
START_DRIFT, START_M, START_RAD = 0.01, 0.003, 0.002
#: Rounds of adjusting, and what an observation may miss afterwards.
ROUNDS, FILTER_PX = 3, 4.0
#: Path in the motion capture is smoothed beyond a window by this much.
BEYOND_S = 2.0
#: Windows in which the motion capture pauses longer are left out.
MOST_PAUSE_S = 0.2


#: Of the fusion: one pose every so often, how it errs, and the IMU (data sheets, per root hertz).
NODE_S, POSE_RAD, POSE_M = 0.025, 4e-3, 1.5e-3
GYRO_DENSITY, ACCEL_DENSITY, GYRO_WALK, ACCEL_WALK = 2e-4, 3e-3, 2e-5, 3e-3


@dataclass(frozen=True, kw_only=True)
class World:
    """A window of a recording, and how it is filmed."""

    recording: str
    begin_s: float
    length_s: float = 30.0
    seed: int = 0
    frame_rate_hz: float = 4.0
    per_frame: int = 90
    noise_px: float = 0.7
    readout_s: float = 0.0
    loops: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class Truth:
    """A camera's true path: ``world_from_cam`` as quaternions, centres, velocities, and unit gravity in that world.

    ``recording_log`` is the error of the scale's logarithm that the IMU has by the true poses.
    """

    t_s: Array
    quat: Array
    centre_m: Array
    velocity_m_s: Array
    down: Array
    recording_log: float

    def at(self, t_s: Array) -> tuple[Array, Array, Array]:
        """(N, 3, 3) rotations, (N, 3) centres and velocities: spherical and Hermite between samples."""
        t_s = np.asarray(t_s, dtype=np.float64)
        i = np.clip(np.searchsorted(self.t_s, t_s) - 1, 0, len(self.t_s) - 2)
        step = self.t_s[i + 1] - self.t_s[i]
        u = (t_s - self.t_s[i]) / step
        rotation = matrix_from_quat(slerp(self.t_s, self.quat, t_s))
        u, step = u[:, None], step[:, None]
        a, b, va, vb = self.centre_m[i], self.centre_m[i + 1], self.velocity_m_s[i], self.velocity_m_s[i + 1]
        centre = (1 + 2 * u) * (1 - u) ** 2 * a + u * (1 - u) ** 2 * step * va
        centre += u**2 * (3 - 2 * u) * b + u**2 * (u - 1) * step * vb
        return rotation, centre, va + u * (vb - va)


@dataclass(frozen=True, eq=False, kw_only=True)
class Filmed:
    """What is given to the stages, and what is true of it: of each frame, at its middle row."""

    model: pycolmap.Reconstruction
    timing: FrameTiming
    imu: ImuRecording
    world_from_cam: Array
    centre_m: Array
    velocity_m_s: Array
    down: Array
    imu_in_cam_m: Array
    recording_log: float


def worlds(folder: Path, length_s: float, most: int, **options: object) -> list[World]:
    """Disjoint windows, the recordings in turn; of motion capture without gaps."""
    found: list[list[World]] = []
    for name in RECORDINGS:
        t_s = read(folder, name, whole=True).t_s
        found.append([])
        for begin_s in np.arange(t_s[0] + BEYOND_S, t_s[-1] - length_s - BEYOND_S, length_s):
            inside = t_s[(t_s > begin_s - BEYOND_S) & (t_s < begin_s + length_s + BEYOND_S)]
            if np.diff(inside, prepend=begin_s - BEYOND_S, append=begin_s + length_s + BEYOND_S).max() < MOST_PAUSE_S:
                found[-1].append(World(recording=name, begin_s=float(begin_s), length_s=length_s, **options))  # type: ignore[arg-type]
    turns = max(map(len, found))
    return [of[i] for i in range(turns) for of in found if i < len(of)][:most]


def recording_of(motion: Motion, begin_s: float, end_s: float) -> ImuRecording:
    """The readings between two instants."""
    near = (motion.imu_t_s >= begin_s) & (motion.imu_t_s <= end_s)
    t_s = motion.imu_t_s[near]
    gyro, accel = motion.gyro_rad_s[near], motion.accel_m_s2[near]
    return ImuRecording(gyro_t_s=t_s, gyro_rad_s=gyro, accel_t_s=t_s, accel_m_s2=accel)


@functools.lru_cache(maxsize=2)
def truth_of(folder: Path, recording: str, begin_s: float, length_s: float) -> Truth:
    """Motion capture smoothed with the IMU."""
    motion, (body_from_cam, cam_in_body_m) = read(folder, recording, whole=True), RECORDINGS[recording][0]
    first_s, last_s = begin_s - BEYOND_S, begin_s + length_s + BEYOND_S
    mine = (motion.t_s >= first_s) & (motion.t_s <= last_s)
    path = CameraTrajectory(
        names=tuple(map(str, range(int(mine.sum())))),
        t_s=motion.t_s[mine],
        cam_from_world_xyzw=quat_from_matrix(motion.world_from_cam[mine].transpose(0, 2, 1)),
        cam_in_world=motion.cam_in_world_m[mine],
        length_unit="m",
    )
    imu = recording_of(motion, first_s - MARGIN_S, last_s + MARGIN_S)
    found = estimate_scale(replace(path, length_unit="model"), imu)
    assert found.calibration is not None and found.gravity_in_world_m_s2 is not None
    assert found.accel_bias_m_s2 is not None
    world_from_imu = motion.world_from_cam[mine] @ body_from_cam.T
    imu_in_world_m = motion.cam_in_world_m[mine] - world_from_imu @ cam_in_body_m
    imu = replace(imu, gyro_rad_s=calibrated_gyro(path.t_s, world_from_imu, imu))
    kept = np.searchsorted(path.t_s, np.arange(first_s, last_s - NODE_S, NODE_S))
    kept = np.unique(kept)
    poses = (path.t_s[kept], world_from_imu[kept], imu_in_world_m[kept])
    t_s, rotation, centre, velocity, rate = fused(*poses, imu, found.gravity_in_world_m_s2, found.accel_bias_m_s2)
    return Truth(
        t_s=t_s,
        quat=quat_from_matrix(rotation @ body_from_cam),
        centre_m=centre + rotation @ cam_in_body_m,
        velocity_m_s=velocity + np.einsum("nij,nj->ni", rotation, np.cross(rate, cam_in_body_m)),
        down=found.gravity_in_world_m_s2 / np.linalg.norm(found.gravity_in_world_m_s2),
        recording_log=float(np.log(found.accepted.metres_per_unit)),
    )


def calibrated_gyro(t_s: Array, world_from_imu: Array, imu: ImuRecording) -> Array:
    """(N, 3) readings whose turns over a quarter of a second are those of the motion capture: gains, axes and bias."""
    path = GyroPath(imu.gyro_t_s, imu.gyro_rad_s, np.zeros(3))
    step = max(1, round(0.25 / float(np.median(np.diff(t_s)))))
    some = np.arange(0, len(t_s), step)
    some = some[(t_s[some] > imu.gyro_t_s[0]) & (t_s[some] < imu.gyro_t_s[-1])]
    turned = so3_log(world_from_imu[some[:-1]].transpose(0, 2, 1) @ world_from_imu[some[1:]])
    read_rad = path.turn_rad(t_s[some[:-1]], t_s[some[1:]])
    factors = np.concatenate([read_rad, np.diff(t_s[some])[:, None]], axis=1)
    kept = np.ones(len(turned), dtype=np.bool_)
    for _ in range(3):
        gain = np.linalg.lstsq(factors[kept], turned[kept], rcond=None)[0]
        left = np.linalg.norm(turned - factors @ gain, axis=1)
        kept = left < 4 * np.median(left)
    return np.asarray(imu.gyro_rad_s @ gain[:3] + gain[3])


def fused(
    t_s: Array, world_from_imu: Array, imu_in_world_m: Array, imu: ImuRecording, gravity: Array, accel_bias: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Instants of the IMU, (N, 3, 3) rotations, positions, velocities and rates of poses and IMU fused by GTSAM."""
    import gtsam
    from gtsam.symbol_shorthand import B, V, X

    def robust(sigmas: Array) -> gtsam.noiseModel.Robust:
        huber = gtsam.noiseModel.mEstimator.Huber.Create(1.345)
        return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Diagonal.Sigmas(sigmas))

    params = gtsam.PreintegrationCombinedParams(gravity)
    params.setGyroscopeCovariance(GYRO_DENSITY**2 * np.eye(3))
    params.setAccelerometerCovariance(ACCEL_DENSITY**2 * np.eye(3))
    params.setIntegrationCovariance(1e-10 * np.eye(3))
    params.setBiasOmegaCovariance(GYRO_WALK**2 * np.eye(3))
    params.setBiasAccCovariance(ACCEL_WALK**2 * np.eye(3))
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    bias = gtsam.imuBias.ConstantBias(accel_bias, np.zeros(3))
    seen = robust(np.r_[np.full(3, POSE_RAD), np.full(3, POSE_M)])
    speed = np.gradient(imu_in_world_m, t_s, axis=0)
    at = np.searchsorted(imu.gyro_t_s, t_s)
    for i in range(len(t_s)):
        pose = gtsam.Pose3(gtsam.Rot3(world_from_imu[i]), imu_in_world_m[i])
        start.insert(X(i), pose)
        start.insert(V(i), speed[i])
        start.insert(B(i), bias)
        graph.add(gtsam.PriorFactorPose3(X(i), pose, seen))
        if i == 0:
            continue
        between = gtsam.PreintegratedCombinedMeasurements(params, bias)
        knots = np.r_[t_s[i - 1], imu.gyro_t_s[at[i - 1] : at[i]], t_s[i]]
        for j, step_s in enumerate(np.diff(knots)):
            if step_s > 1e-9:
                reading = min(at[i - 1] + j, len(imu.gyro_t_s) - 1)
                before = max(reading - 1, 0)
                accel = 0.5 * (imu.accel_m_s2[before] + imu.accel_m_s2[reading])
                gyro = 0.5 * (imu.gyro_rad_s[before] + imu.gyro_rad_s[reading])
                between.integrateMeasurement(accel, gyro, float(step_s))
        graph.add(gtsam.CombinedImuFactor(X(i - 1), V(i - 1), X(i), V(i), B(i - 1), B(i), between))
    sigmas = np.r_[np.full(3, 0.3), np.full(3, 0.01)]
    graph.add(gtsam.PriorFactorConstantBias(B(0), bias, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    poses = [found.atPose3(X(i)) for i in range(len(t_s))]
    velocity = np.array([found.atVector(V(i)) for i in range(len(t_s))])
    rate = np.stack([np.interp(t_s, imu.gyro_t_s, axis) for axis in imu.gyro_rad_s.T], axis=1)
    rotation = np.array([pose.rotation().matrix() for pose in poses])
    return t_s, rotation, np.array([pose.translation() for pose in poses]), velocity, rate


def camera(focal_px: float, radial: float) -> pycolmap.Camera:
    """One radial term, centre of the picture."""
    width, height = SIZE_PX
    params = [focal_px, width / 2, height / 2, radial]
    return pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=width, height=height, params=params)


def draw_points(rng: np.random.Generator, rotation: Array, centre: Array, frame: Array) -> Array:
    """(N, 3) points on the walls where random pixels of (N,) frames look, some of them before the walls."""
    count = len(frame)
    pixel = rng.uniform([0, 0], SIZE_PX, (count, 2)) - np.array(SIZE_PX) / 2
    ray = np.concatenate([pixel / FOCAL_PX, np.ones((count, 1))], axis=1)
    ray = np.einsum("nij,nj->ni", rotation[frame], ray / np.linalg.norm(ray, axis=1)[:, None])
    low, high = centre.min(axis=0) - WALLS_M, centre.max(axis=0) + WALLS_M
    with np.errstate(divide="ignore"):
        reach = np.where(ray > 0, high - centre[frame], low - centre[frame]) / ray
    before = np.where(rng.random(count) < BEFORE_SHARE, rng.uniform(0, BEFORE_M, count), 0.0)
    return np.asarray(centre[frame] + ray * (reach.min(axis=1) - before)[:, None])


def seen_at(seeing: pycolmap.Camera, truth: Truth, t_s: Array, point: Array, readout_s: float) -> tuple[Array, Array]:
    """(N, 2) pixels, each at its own row's instant, and which are within the picture."""
    row = np.zeros(len(t_s))
    xy = np.zeros((len(t_s), 2))
    for _ in range(4 if readout_s else 1):
        rotation, centre, _ = truth.at(t_s + row * readout_s)
        in_cam = np.einsum("nji,nj->ni", rotation, point - centre)
        ahead = in_cam[:, 2] > 0.2
        xy = np.asarray(seeing.img_from_cam(np.where(ahead[:, None], in_cam, [0, 0, 1.0])))
        row = np.clip(xy[:, 1] / SIZE_PX[1], 0, 1) - 0.5
    return xy, ahead & np.all((xy > 2) & (xy < np.array(SIZE_PX) - 2), axis=1)


def film(folder: Path, world: World) -> Filmed:
    """A window's model, recording and truth."""
    truth = truth_of(folder, world.recording, world.begin_s, world.length_s)
    rng = np.random.default_rng([11, world.seed, int(10 * world.begin_s), *map(ord, world.recording)])
    t_s = np.arange(world.begin_s + 0.1, world.begin_s + world.length_s - 0.1, 1 / world.frame_rate_hz)
    rotation, centre, velocity = truth.at(t_s)
    frame, point, points, xy = _sightings(rng, world, truth, t_s, rotation, centre)
    start_rotation, start_centre, start_points = _start(rng, rotation, centre, points, frame, point)
    focal, radial = FOCAL_PX * (1 + FOCAL_SHARE * rng.choice([-1, 1])), RADIAL + RADIAL_OFF * rng.choice([-1, 1])
    size, turn = float(np.exp(rng.uniform(-2, 2))), so3_exp(2 * rng.standard_normal(3))
    names = tuple(f"{i:05d}.jpg" for i in range(len(t_s)))
    model = _built(
        camera(focal, radial),
        names,
        turn @ start_rotation,
        size * start_centre @ turn.T,
        size * start_points @ turn.T,
        (frame, point, xy),
    )
    for _ in range(ROUNDS):
        adjust(model)
        pycolmap.ObservationManager(model).filter_all_points3D(FILTER_PX, 0.0)
    offset_s = float(rng.uniform(-1, 1))
    motion = read(folder, world.recording, whole=True)
    imu = recording_of(motion, world.begin_s - MARGIN_S, world.begin_s + world.length_s + MARGIN_S)
    imu = replace(imu, gyro_t_s=imu.gyro_t_s - offset_s, accel_t_s=imu.accel_t_s - offset_s)
    body_from_cam, cam_in_body_m = RECORDINGS[world.recording][0]
    return Filmed(
        model=model,
        # of no exposure: the instant of a frame is that of its middle row
        timing=FrameTiming(names=names, t_s=t_s, readout_s=None),
        imu=imu,
        world_from_cam=rotation,
        centre_m=centre,
        velocity_m_s=velocity,
        down=truth.down,
        recording_log=truth.recording_log,
        imu_in_cam_m=-body_from_cam.T @ cam_in_body_m,
    )


def _sightings(
    rng: np.random.Generator, world: World, truth: Truth, t_s: Array, rotation: Array, centre: Array
) -> tuple[Array, Array, Array, Array]:
    """(M,) frames and points, (P, 3) points, (M, 2) pixels; sorted by point."""
    frames, seeing = len(t_s), camera(FOCAL_PX, RADIAL)
    births = 3.0 * world.per_frame / (1 + LIFE_S * world.frame_rate_hz * (1 - MISSED))
    for _ in range(4):
        state = np.random.default_rng(rng.integers(2**32))
        born = np.sort(state.integers(-8, frames, int(births * frames)))
        points = draw_points(state, rotation, centre, np.clip(born, 0, frames - 1))
        life = np.inf if world.loops else state.exponential(LIFE_S * world.frame_rate_hz, len(born))
        first, last = (np.zeros(len(born)), np.full(len(born), frames - 1)) if world.loops else (born, born + life)
        age = np.arange(frames)
        alive = (age >= np.ceil(first)[:, None]) & (age <= np.floor(last)[:, None])
        alive &= state.random(alive.shape) > MISSED
        point, frame = np.nonzero(alive)
        xy, inside = seen_at(seeing, truth, t_s[frame], points[point], world.readout_s)
        frame, point, xy = frame[inside], point[inside], xy[inside]
        often = np.bincount(point, minlength=len(points)) > 1
        keep = often[point]
        frame, point, xy = frame[keep], point[keep], xy[keep]
        births *= world.per_frame * frames / max(1, len(frame))
        if abs(len(frame) / (world.per_frame * frames) - 1) < 0.05:
            break
    kept, point = np.unique(point, return_inverse=True)
    xy = xy + world.noise_px * state.standard_normal(xy.shape)
    false = state.random(len(xy)) < FALSE
    xy[false] += FALSE_PX * state.standard_cauchy((int(false.sum()), 2))
    return frame, point, points[kept], np.clip(xy, -1e4, 1e4)


def _start(
    rng: np.random.Generator, rotation: Array, centre: Array, points: Array, frame: Array, point: Array
) -> tuple[Array, Array, Array]:
    """Poses and points whose scale grows along the path, with errors of their own."""
    size = 1 + START_DRIFT * np.linspace(-0.5, 0.5, len(centre))
    steps = np.diff(centre, axis=0, prepend=centre[:1])
    drifted = centre[0] + np.cumsum(size[:, None] * steps, axis=0)
    first = frame[np.searchsorted(point, np.arange(len(points)))]
    moved = drifted[first] + size[first, None] * (points - centre[first])
    turned = rotation @ so3_exp(START_RAD * rng.standard_normal(centre.shape))
    return turned, drifted + START_M * rng.standard_normal(centre.shape), moved


def _built(
    seeing: pycolmap.Camera,
    names: tuple[str, ...],
    world_from_cam: Array,
    centre: Array,
    points: Array,
    seen: tuple[Array, Array, Array],
) -> pycolmap.Reconstruction:
    frame, point, xy = seen
    built = pycolmap.Reconstruction()
    built.add_camera_with_trivial_rig(seeing)
    place = np.zeros(len(frame), dtype=np.int64)
    for i, name in enumerate(names):
        mine = np.flatnonzero(frame == i)
        place[mine] = np.arange(len(mine))
        image = pycolmap.Image(name=name, keypoints=xy[mine], camera_id=1, image_id=i + 1)
        turn = world_from_cam[i].T
        built.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ centre[i]))
    first = np.searchsorted(point, np.arange(len(points) + 1))
    for p, xyz in enumerate(points):
        track = pycolmap.Track()
        for o in range(first[p], first[p + 1]):
            track.add_element(int(frame[o]) + 1, int(place[o]))
        built.add_point3D(xyz, track)
    return built


def adjust(model: pycolmap.Reconstruction) -> None:
    """COLMAP's bundle adjustment of all that there is."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False
    solver = getattr(options, "ceres", options)
    solver.solver_options.num_threads = 1
    solver.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
