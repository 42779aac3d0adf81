"""Accelerations of camera and IMU as spectra in the IMU frame: what the spectral scale estimate compares."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, ComplexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.motion.smooth import PositionSmoother, WorldAcceleration, smooth_attitude

#: Frames further apart than this sample motion of 1.2 Hz too thinly to differentiate it twice.
SPARSEST_S = 0.2
#: A pause of the frames this long ends a segment; shorter segments than the other say nothing below 1.2 Hz.
_PAUSE_S, SHORTEST_S = 0.5, 3.0
#: Smoothed accelerations are uncertain at the ends: this many time constants are cut off.
_EDGE = 3.0
#: Segments fade in and out over this long (or over half of themselves), so that their ends do not leak.
_FADE_S = 2.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Spectra:
    """Linear pieces of ``scale visual + lever_by l = inertial - bias_by b + gravity_by g`` at F frequencies.

    All in the IMU frame, after the same smoothing. A white signal of variance one has a spectrum of variance one.

    Attributes
    ----------
    frequency_hz
        (F,) from all segments.
    visual
        (F, 3) acceleration of the camera, model units per second squared.
    inertial
        (F, 3) readings of the accelerometer, m/s2.
    lever_by, bias_by, gravity_by
        (F, 3, 3) complex derivatives: by the IMU's position in the camera frame (m), by the accelerometer's bias
        (m/s2), by gravity in the world (m/s2).
    visual_noise
        (F,) expected power that the white noise of positions leaves in ``visual``.
    """

    frequency_hz: Array
    visual: ComplexArray
    inertial: ComplexArray
    lever_by: ComplexArray
    bias_by: ComplexArray
    gravity_by: ComplexArray
    visual_noise: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class Signals:
    """The same pieces over time: smoothed accelerations at the frames, in the IMU frame.

    Attributes
    ----------
    t_s
        (T,) frame times.
    pieces
        (T, 11, 3): visual, inertial, by lever arm (3), by bias (3), by gravity (3).
    segments
        First and last time of each stretch without a pause, its uncertain ends cut off.
    step_s
        Usual interval between frames.
    smoother
        What they went through.
    """

    t_s: Array
    pieces: Array
    segments: tuple[tuple[float, float], ...]
    step_s: float
    smoother: PositionSmoother

    @classmethod
    def of(cls, trajectory: CameraTrajectory, timed: CameraTimedImu) -> Signals:
        """Smooth, differentiate, turn into the IMU frame.

        The accelerometer is integrated twice along the camera's path and goes through the very smoother that the
        positions go through, as do the effects of bias and lever arm: what smoothing costs, it costs all of them.

        Raises
        ------
        NotObservableError
            Where frames are too sparse to differentiate, or nothing long enough is covered by both sensors.
        """
        imu, calibration, stamps_s = timed.imu, timed.calibration, timed.accel_t_s
        attitude = smooth_attitude(trajectory, timed)
        world_from_imu = matrix_from_quat(attitude.at(stamps_s)[0])
        force = np.einsum("kij,kj->ki", world_from_imu, imu.accel_m_s2)
        weight = force.mean(axis=0)  # taken out while integrating, for the sake of digits
        inertial = WorldAcceleration.integrated(stamps_s, force - weight)

        seen = trajectory.select((trajectory.t_s >= stamps_s[0]) & (trajectory.t_s <= stamps_s[-1]))
        if len(seen) < 6:
            raise NotObservableError("scale", Fact("frames-too-few"))
        step_s = float(np.median(np.diff(seen.t_s)))
        if step_s > SPARSEST_S:
            raise NotObservableError("scale", Fact("frames-too-sparse-to-differentiate", step_s=step_s))
        smoother = PositionSmoother.of(seen)
        at_frames = matrix_from_quat(attitude.at(seen.t_s)[0])
        lever = at_frames @ matrix_from_quat(quat_conjugate(calibration.cam_from_imu_xyzw))
        signals = [inertial.sums(seen.t_s)[:, 0], *np.moveaxis(lever, 2, 0)]
        signals += [
            WorldAcceleration.integrated(stamps_s, world_from_imu[:, :, axis]).sums(seen.t_s)[:, 0] for axis in range(3)
        ]
        accel = smoother.accelerations_of(np.concatenate(signals, axis=1)).reshape(len(seen), 7, 3)
        gravity = np.broadcast_to(np.eye(3), (len(seen), 3, 3))
        in_world = np.concatenate([smoother.smoothed().accel_in_world[:, None], accel, gravity], axis=1)
        in_world[:, 1] += weight
        edge_s = _EDGE * smoother.time_constant_s
        stretches = _stretches(seen.t_s, inertial.covers(seen.t_s))
        segments = tuple((first + edge_s, last - edge_s) for first, last in stretches)
        return cls(
            t_s=seen.t_s,
            pieces=np.einsum("kji,kmj->kmi", at_frames, in_world),
            segments=tuple((begin, end) for begin, end in segments if end - begin >= SHORTEST_S),
            step_s=step_s,
            smoother=smoother,
        )

    @property
    def duration_s(self) -> float:
        """Duration of all segments."""
        return sum(end - begin for begin, end in self.segments)

    @property
    def excitation(self) -> float:
        """Standard deviation of the camera's acceleration, model units per second squared."""
        return float(np.sqrt(np.mean(np.var(self.smoother.smoothed().accel_in_world, axis=0))))

    def half(self, which: int) -> Signals:
        """The first or the second half of every segment."""
        halves = tuple(
            ((begin, 0.5 * (begin + end)), (0.5 * (begin + end), end))[which] for begin, end in self.segments
        )
        return replace(self, segments=halves)

    def spectra(self, highest_hz: float) -> Spectra:
        """Transform all segments."""
        frequency, spectra = [], []
        for begin_s, end_s in self.segments:
            grid = np.arange(begin_s, end_s, self.step_s)
            columns = self.pieces.reshape(len(self.t_s), -1).T
            sampled = np.stack([np.interp(grid, self.t_s, column) for column in columns], axis=1)
            window = _window(len(grid), self.step_s)
            cycles = np.fft.rfftfreq(len(grid), self.step_s)
            low = cycles <= highest_hz
            spectra.append((np.fft.rfft(sampled * window[:, None], axis=0) / np.sqrt(len(grid)))[low])
            frequency.append(cycles[low])
        hz: Array = np.concatenate([*frequency, np.zeros(0)]).astype(np.float64)
        pieces = np.concatenate([*spectra, np.zeros((0, 33))]).reshape(len(hz), 11, 3)
        passed = 1 / (1 + (2 * np.pi * hz * self.smoother.time_constant_s) ** 6)
        by = pieces.transpose(0, 2, 1)
        return Spectra(
            frequency_hz=hz,
            visual=pieces[:, 0],
            inertial=pieces[:, 1],
            lever_by=by[:, :, 2:5],
            bias_by=by[:, :, 5:8],
            gravity_by=by[:, :, 8:11],
            visual_noise=(2 * np.pi * hz) ** 4 * passed**2 * self.smoother.noise_sigma**2,
        )


def _stretches(t_s: Array, covered: BoolArray) -> list[tuple[float, float]]:
    """First and last time of each stretch without a pause."""
    broken = np.flatnonzero(~covered | (np.diff(t_s) > _PAUSE_S))
    first = np.concatenate([[0], broken + 1])
    last = np.concatenate([broken, [len(t_s) - 1]])
    return [(float(t_s[i]), float(t_s[j])) for i, j in zip(first, last, strict=True)]


def _window(count: int, step_s: float) -> Array:
    """A Tukey window with a mean square of one."""
    fade = min(int(_FADE_S / step_s), count // 2)
    ramp = 0.5 - 0.5 * np.cos(np.pi * (np.arange(fade) + 0.5) / max(fade, 1))
    window = np.ones(count)
    window[:fade], window[count - fade :] = ramp, ramp[::-1]
    return window / np.sqrt(np.mean(window**2))
