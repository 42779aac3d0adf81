"""Walks without images: points along a path, where a camera would see them, and the IMU that was carried along.

Tracks are drawn, not found in rendered images: what a mapper makes of them drifts as real models do, and hundreds of
frames take seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import CameraImuCalibration, CameraModel, FrameTiming, ImuRecording
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.model import colmap_camera
from colmap_inertial.tools.simulate.motion import Motion, MotionOptions
from colmap_inertial.tools.simulate.sensors import ImuOptions, SampledImu, simulate_imu

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """A walk, what is seen on it, and by what."""

    motion: MotionOptions = field(
        default_factory=lambda: MotionOptions(kind="walk", duration_s=100.0, speed_m_s=1.0, vigour=0.6, look_deg=40.0)
    )
    """How the camera is carried."""
    imu: ImuOptions = field(default_factory=ImuOptions)
    """The device."""
    vibration_m_s2: float = 0.0
    """Amplitude of the accelerometer's vibration between 20 and 80 Hz, each axis."""
    frame_rate_hz: float = 4.0
    """Frames a second."""
    readout_s: float = 0.0
    """Of the rolling shutter."""
    camera: CameraModel = field(
        default_factory=lambda: CameraModel(
            model="OPENCV", width=1280, height=960, params=(1000.0, 1000.0, 640.0, 480.0, -0.05, 0.01, 0.0005, -0.0003)
        )
    )
    """Intrinsics."""
    noise_px: float = 0.5
    """Standard deviation of an observation, each coordinate."""
    points_per_m: float = 250.0
    """Along the way."""
    life_s: float = 1.5
    """How long a point is followed, on average."""

    def __post_init__(self) -> None:
        if not (self.frame_rate_hz > 0 and self.points_per_m > 0 and self.life_s > 0):
            raise ValueError("frame_rate_hz, points_per_m and life_s must be positive")


@dataclass(frozen=True, eq=False, kw_only=True)
class Tracks:
    """Observations of points by a camera, and the truth.

    Attributes
    ----------
    timing
        Of the frames.
    point_m
        (P, 3) in the world, z up.
    frame, point
        (M,) which frame saw which point, point by point.
    xy_px
        (M, 2) where.
    imu
        The IMU recording.
    motion, sampled
        The path; the samples without vibration, and the device they came from.
    """

    timing: FrameTiming
    camera: CameraModel
    point_m: Array
    frame: Int64Array
    point: Int64Array
    xy_px: Array
    imu: ImuRecording
    motion: Motion
    sampled: SampledImu

    @property
    def calibration(self) -> CameraImuCalibration:
        """The true one."""
        return self.sampled.calibration(self.timing.readout_s or 0.0)

    def reconstruction(self, xy_px: Array | None = None) -> pycolmap.Reconstruction:
        """A COLMAP model of the true poses and points, with these observations or others in their place."""
        import pycolmap

        xy_px = self.xy_px if xy_px is None else xy_px
        built = pycolmap.Reconstruction()
        built.add_camera_with_trivial_rig(colmap_camera(self.camera))
        state = self.motion.at(self.timing.pose_t_s())
        cam_from_world = matrix_from_quat(state.world_from_cam_xyzw).transpose(0, 2, 1)
        place = np.zeros(len(self.frame), dtype=np.int64)
        for i, name in enumerate(self.timing.names):
            mine = np.flatnonzero(self.frame == i)
            place[mine] = np.arange(len(mine))
            image = pycolmap.Image(name=name, keypoints=xy_px[mine], camera_id=1, image_id=i + 1)
            shift = -cam_from_world[i] @ state.cam_in_world_m[i]
            built.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(cam_from_world[i]), shift))
        first = np.searchsorted(self.point, np.arange(len(self.point_m) + 1))
        for p, xyz in enumerate(self.point_m):
            track = pycolmap.Track()
            for o in range(first[p], first[p + 1]):
                track.add_element(int(self.frame[o]) + 1, int(place[o]))
            built.add_point3D(xyz, track)
        return built

    def write_database(self, path: Path, xy_px: Array | None = None, *, fewest: int = 15) -> None:
        """COLMAP's database of what was seen: all pairs of frames that see enough of the same, every match true.

        Numbers of images and keypoints are those of :meth:`reconstruction`.
        """
        import pycolmap

        xy_px = self.xy_px if xy_px is None else xy_px
        path.unlink(missing_ok=True)
        order = np.argsort(self.frame, kind="stable")
        of_frame = np.split(order, np.searchsorted(self.frame[order], np.arange(1, len(self.timing.names))))
        with pycolmap.Database.open(str(path)) as opened:
            camera = opened.write_camera(colmap_camera(self.camera))
            rig = pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera))
            rig_id = opened.write_rig(rig)
            for number, (name, mine) in enumerate(zip(self.timing.names, of_frame, strict=True), start=1):
                image = opened.write_image(pycolmap.Image(name=name, camera_id=camera))
                frame = pycolmap.Frame(frame_id=number, rig_id=rig_id)
                frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera), image))
                opened.write_frame(frame)
                keypoints = np.zeros((len(mine), 6), dtype=np.float32)
                keypoints[:, :2], keypoints[:, 2], keypoints[:, 5] = xy_px[mine], 1.0, 1.0
                opened.write_keypoints(image, keypoints)
            for first, second in np.argwhere(np.triu(self._in_common(), 1) >= fewest).tolist():
                _, at_first, at_second = np.intersect1d(
                    self.point[of_frame[first]], self.point[of_frame[second]], return_indices=True
                )
                matches = np.stack([at_first, at_second], axis=1).astype(np.uint32)
                opened.write_matches(first + 1, second + 1, matches)
                geometry = pycolmap.TwoViewGeometry(
                    config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED, inlier_matches=matches
                )
                opened.write_two_view_geometry(first + 1, second + 1, geometry)

    def _in_common(self) -> Int64Array:
        """(F, F) how many points two frames both see."""
        from scipy.sparse import coo_array, csr_array

        shape = (len(self.timing.names), len(self.point_m))
        sees = csr_array(coo_array((np.ones(len(self.frame), dtype=np.int64), (self.frame, self.point)), shape=shape))
        return np.asarray((sees @ sees.T).toarray())


def simulate_tracks(options: TrackOptions, *, seed: int) -> Tracks:
    """Draw a walk.

    Parameters
    ----------
    options
        What kind.
    seed
        Same options and seed, same tracks.
    """
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)]
    motion, sampled = simulate_imu(options.motion, options.imu, streams)
    imu = _add_vibration(sampled.recording, options.vibration_m_s2, streams[3])
    # the first line of the last frame still lies within the camera's recording
    t_s = np.arange(0.05, options.motion.duration_s - 0.1, 1 / options.frame_rate_hz)
    timing = FrameTiming(
        names=tuple(f"{i:05d}.jpg" for i in range(len(t_s))), t_s=t_s, readout_s=options.readout_s or None
    )
    points = _draw_points(motion, options, streams[2])
    frame, point, xy_px = _observe(motion, timing, points, options, streams[2])
    kept, point = np.unique(point, return_inverse=True)
    return Tracks(
        timing=timing,
        camera=options.camera,
        point_m=points[kept],
        frame=frame,
        point=point,
        xy_px=xy_px,
        imu=imu,
        motion=motion,
        sampled=sampled,
    )


def _add_vibration(imu: ImuRecording, amplitude: float, rng: np.random.Generator) -> ImuRecording:
    """Add vibrations of the accelerometer, whose sampling folds them into lower frequencies."""
    if amplitude == 0:
        return imu
    since_s = imu.accel_t_s - imu.accel_t_s[0]
    shake = np.zeros_like(imu.accel_m_s2)
    for _ in range(12):
        rate_hz, phase = rng.uniform(20, 80), rng.uniform(0, 2 * np.pi, 3)
        # comes and goes with steps
        level = 1 + 0.8 * np.sin(2 * np.pi * rng.uniform(0.5, 2.0) * since_s + rng.uniform(0, 2 * np.pi))
        shake += (level * np.sin(2 * np.pi * rate_hz * since_s))[:, None] * np.cos(phase)
    return replace(imu, accel_m_s2=imu.accel_m_s2 + amplitude / 12**0.5 * shake)


def _draw_points(motion: Motion, options: TrackOptions, rng: np.random.Generator) -> Array:
    """Points beside, below and above the way, up to seven metres off."""
    steps = motion.cam_in_world_m(np.arange(0.0, options.motion.duration_s, 0.5))
    length_m = float(np.linalg.norm(np.diff(steps, axis=0), axis=1).sum())
    count = int(options.points_per_m * length_m)
    at = motion.cam_in_world_m(rng.uniform(0, options.motion.duration_s, count))
    azimuth, distance = rng.uniform(0, 2 * np.pi, count), rng.uniform(2.0, 7.0, count)
    offset = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(-1.6, 1.6, count)], axis=1)
    return at + offset


def _observe(
    motion: Motion, timing: FrameTiming, points: Array, options: TrackOptions, rng: np.random.Generator
) -> tuple[Int64Array, Int64Array, Array]:
    """Observations of points by frames, each line at its own instant; points with at least three frames."""
    camera, pose_s = colmap_camera(options.camera), timing.pose_t_s()
    width, height = options.camera.width, options.camera.height
    centre = motion.cam_in_world_m(pose_s)
    frames, numbers, places = [], [], []
    begin_s = rng.uniform(0, 1, len(points))
    life_s = rng.exponential(options.life_s, len(points))
    for i, t_s in enumerate(pose_s):
        near = np.flatnonzero(np.linalg.norm(points - centre[i], axis=1) < 9.0)
        shutter = FrameShutter.of(timing, i, width=width, height=height)
        xy = np.full((len(near), 2), [width / 2, height / 2])
        # after six rounds a point's line and the instant of that line agree
        for _ in range(6 if options.readout_s else 1):
            line_s = shutter.middle_s(np.clip(np.nan_to_num(xy), 0, [width, height]))
            line_s = np.full(len(near), t_s) if not options.readout_s else line_s
            state = motion.at(line_s)
            away = points[near] - state.cam_in_world_m
            in_cam = np.einsum("nji,nj->ni", matrix_from_quat(state.world_from_cam_xyzw), away)
            front = in_cam[:, 2] > 0.5
            xy = np.full((len(near), 2), -1e3)
            xy[front] = camera.img_from_cam(in_cam[front])
        inside = front & (xy > 5).all(axis=1) & (xy < [width - 5, height - 5]).all(axis=1)
        # the lens's polynomial folds what lies far outside back into the image
        inside &= (np.abs(in_cam[:, :2]) < 0.8 * in_cam[:, 2:]).all(axis=1)
        frames.append(np.full(int(inside.sum()), i))
        numbers.append(near[inside])
        places.append(xy[inside])
    frame, point, xy_px = np.concatenate(frames), np.concatenate(numbers), np.concatenate(places)
    order = np.lexsort((frame, point))
    frame, point, xy_px = frame[order], point[order], xy_px[order]
    first = np.searchsorted(point, np.arange(len(points)))
    last = np.searchsorted(point, np.arange(len(points)), side="right") - 1
    # followed for a while, somewhere within the time that it is in view
    span_s = pose_s[frame[np.maximum(last, 0)]] - pose_s[frame[np.minimum(first, len(frame) - 1)]]
    start_s = pose_s[frame[np.minimum(first, len(frame) - 1)]] + begin_s * np.maximum(span_s - life_s, 0)
    now_s = pose_s[frame]
    kept = (now_s >= start_s[point]) & (now_s <= (start_s + life_s)[point])
    frame, point, xy_px = frame[kept], point[kept], xy_px[kept]
    often = np.bincount(point, minlength=len(points))[point] >= 3
    xy_px = xy_px[often] + options.noise_px * rng.standard_normal((int(often.sum()), 2))
    return frame[often], point[often], xy_px
