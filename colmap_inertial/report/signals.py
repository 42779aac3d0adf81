"""Camera against IMU, as the report draws it: rotation rates, accelerations, their spectra.

Both sides go through the same operation, so that what they differ by is error: rotations over the intervals between
frames; second differences of positions, of the camera's own and of the accelerometer's double integral.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu, epoch_shift_s
from colmap_inertial.core.facts import sentences
from colmap_inertial.core.geometry import quat_conjugate, quat_rotate, rotation_between, so3_log
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import (
    CameraTrajectory,
    ImuRecording,
    ScaleEstimate,
)
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.inertial.scale import check_units
from colmap_inertial.motion.smooth import WorldAcceleration, smooth_attitude
from colmap_inertial.report.series import round_values, thin_line


@dataclass(frozen=True, kw_only=True)
class ComparisonSettings:
    """Settings of the comparison of camera and IMU."""

    #: Positions are differentiated over this long: a millimetre of noise becomes 0.06 m/s2.
    reach_s: float = 0.2
    #: A longer pause between frames is a gap in the lines, as is a rotation in one that may be one the other way round.
    longest_pause_s: float = 5.0
    largest_rotation_rad: float = 2.5
    #: Parts that spectra are averaged over.
    part_s: float = 8.0
    #: Samples less even have no spectrum: share of the steps within a fifth of the usual one.
    even_share: float = 0.9
    #: Points of a spectrum.
    bins: int = 120


SETTINGS = ComparisonSettings()

Record = dict[str, Any]


@one_blas_thread()
def signal_record(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    estimate: ScaleEstimate,
    gravity_in_world_m_s2: Array | None,
    *,
    first_frame_s: float | None = None,
) -> Record:
    """The report's data on camera and IMU: at most some thousand numbers, however long the recording.

    Parameters
    ----------
    trajectory
        Poses of the model, in metres where its scale is known, else in the model's units.
    imu
        The IMU recording.
    estimate
        What was found about the two.
    gravity_in_world_m_s2
        (3,) in the trajectory's world; ``None`` where unknown.
    first_frame_s
        When the recording's first frame was taken, on the trajectory's clock; without it, the first pose counts.

    Returns
    -------
    ``first_frame_s``, ``alignment``, ``rotation``, ``acceleration`` and their spectra, as the package
    describes them.
    """
    calibration = estimate.calibration
    start_s = float(trajectory.t_s[0] if first_frame_s is None else first_frame_s)
    record: Record = {
        "duration_s": float(np.ptp(trajectory.t_s)),
        "frames": len(trajectory),
        "first_frame_s": start_s,
        "alignment": "found" if calibration is not None else "failed",
    }
    rates = _Rates(trajectory)
    aligned = None
    if calibration is not None:
        timed = CameraTimedImu.from_recording(imu, calibration, trajectory.epoch_ns)
        imu, aligned = timed.imu, GyroCamera.from_timed(timed)
    record["rotation"] = _compare_rotations(trajectory, imu, rates, aligned, start_s)
    if estimate.rotations is not None:
        consensus = estimate.rotations
        deviation = np.where(consensus.judged, consensus.deviation_deg, np.nan)
        record["rotation"]["deviation_deg"] = thin_line(consensus.t_s - start_s, deviation)
    no_accel = "The recording has no accelerometer."
    if aligned is None or calibration is None:
        why = "Camera and IMU could not be aligned, so their {} cannot be compared."
        # where these stand in the way, nobody tried (scale.estimate_scale)
        problem = "; ".join(sentences(check_units(imu)[:1])) if imu.has_accel else no_accel
        if problem:
            record["alignment"] = "not tried"
            why = "Camera and IMU were not aligned: " + problem[:1].lower() + problem[1:]
        record["rotation_spectrum"] = {"missing": why.format("rotations")}
        why = why.format("accelerations") if imu.has_accel else no_accel
        record["acceleration"] = record["acceleration_spectrum"] = {"missing": why}
        return record
    record["rotation_spectrum"] = _compare_rotation_spectra(rates, aligned)
    if not imu.has_accel:
        record["acceleration"] = record["acceleration_spectrum"] = {"missing": no_accel}
        return record
    both = _Accelerations(trajectory, timed, estimate, gravity_in_world_m_s2)
    record["acceleration"] = both.record(start_s)
    record["acceleration_spectrum"] = both.spectrum()
    return record


class _Rates:
    """The camera's rotation from each frame to the next (K, 3), rad/s, camera frame, at ``middle_s``."""

    def __init__(self, trajectory: CameraTrajectory) -> None:
        t_s, rotation = trajectory.t_s, trajectory.turn_rad()
        rate = rotation / np.diff(t_s)[:, None]
        rate[
            (np.diff(t_s) > SETTINGS.longest_pause_s)
            | (np.linalg.norm(rotation, axis=1) > SETTINGS.largest_rotation_rad)
        ] = np.nan
        self.begin_s, self.end_s, self.rate_rad_s = t_s[:-1], t_s[1:], rate
        self.middle_s = 0.5 * (self.begin_s + self.end_s)
        self.step_s = float(np.median(self.end_s - self.begin_s))

    def by_gyroscope(self, motion: GyroCamera) -> Array:
        """The gyroscope's rotation over the same intervals."""
        first, last = motion.start_from_cam(self.begin_s), motion.start_from_cam(self.end_s)
        rate = so3_log(np.swapaxes(first, 1, 2) @ last) / (self.end_s - self.begin_s)[:, None]
        known = motion.covers(self.begin_s, self.end_s) & np.isfinite(self.rate_rad_s).all(axis=1)
        return np.where(known[:, None], rate, np.nan)


def _compare_rotations(
    trajectory: CameraTrajectory, imu: ImuRecording, rates: _Rates, aligned: GyroCamera | None, start_s: float
) -> Record:
    shift_s = epoch_shift_s(imu, trajectory.epoch_ns)
    gyro_s = imu.gyro_t_s + shift_s
    overlap = gyro_s[0] < trajectory.t_s[-1] and gyro_s[-1] > trajectory.t_s[0]
    # clocks that have nothing in common are drawn from the first sample of each
    gyro_s = gyro_s - start_s if overlap else imu.gyro_t_s - imu.gyro_t_s[0]
    raw_s, raw = _average_windows(gyro_s, imu.gyro_rad_s, max(rates.step_s, 0.02))
    times = rates.middle_s - start_s
    before_s = times if overlap else rates.middle_s - trajectory.t_s[0]
    near = (raw_s >= before_s[0] - 2) & (raw_s <= before_s[-1] + 2)
    record: Record = {
        "same_clock_origin": bool(overlap),
        "deviation_deg": None,
        "before": {
            "camera": [thin_line(before_s, column) for column in rates.rate_rad_s.T],
            "gyroscope": [thin_line(raw_s[near], column[near]) for column in raw.T] if near.sum() > 1 else [],
        },
        "after": None,
    }
    if aligned is None:
        record["before"]["camera_size"] = thin_line(before_s, np.linalg.norm(rates.rate_rad_s, axis=1))
        record["before"]["gyroscope_size"] = thin_line(raw_s[near], np.linalg.norm(raw[near], axis=1))
        return record
    by_gyro = rates.by_gyroscope(aligned)
    both = np.isfinite(by_gyro).all(axis=1)
    if not both.any():
        return record
    difference = (rates.rate_rad_s - by_gyro)[both]
    record["after"] = {
        "camera": [thin_line(times, column) for column in rates.rate_rad_s.T],
        "gyroscope": [thin_line(times, column) for column in by_gyro.T],
        "rms_difference_rad_s": _rms(difference),
        "rms_rate_rad_s": _rms(by_gyro[both]),
    }
    return record


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _average_windows(t_s: Array, values: Array, width_s: float) -> tuple[Array, Array]:
    """Means of samples (N, 3) over windows of equal length."""
    place = np.floor((t_s - t_s[0]) / width_s).astype(np.intp)
    windows, index, count = np.unique(place, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(index, column, len(windows)) for column in values.T], axis=1)
    return t_s[0] + (windows + 0.5) * width_s, sums / count[:, None]


def _compare_rotation_spectra(rates: _Rates, aligned: GyroCamera) -> Record:
    path: GyroPath = aligned.path
    begin_s, end_s = rates.begin_s[0] - aligned.offset_s, rates.end_s[-1] - aligned.offset_s
    during = (path.t_s >= begin_s) & (path.t_s <= end_s)
    return _collect_spectra(
        camera=(rates.middle_s, rates.rate_rad_s),
        imu_at_frames=(rates.middle_s, rates.by_gyroscope(aligned)),
        imu=(path.t_s[during], path.rate_rad_s[during]),
    )


class _Accelerations:
    """Accelerations of the IMU's place by camera (K, 3) and accelerometer (K, 3), gravity-aligned, at ``t_s``."""

    def __init__(
        self,
        trajectory: CameraTrajectory,
        timed: CameraTimedImu,
        estimate: ScaleEstimate,
        gravity: Array | None,
    ) -> None:
        attitude = smooth_attitude(trajectory, timed)
        bias = np.zeros(3) if estimate.accel_bias_m_s2 is None else estimate.accel_bias_m_s2
        inertial = WorldAcceleration.of(timed, attitude, bias_m_s2=bias, gravity_in_world_m_s2=np.zeros(3))
        during = (inertial.t_s >= trajectory.t_s[0]) & (inertial.t_s <= trajectory.t_s[-1])
        weight = inertial.accel_m_s2[during].mean(axis=0) if during.any() else inertial.accel_m_s2.mean(axis=0)
        down = -weight if gravity is None else gravity
        up = rotation_between(-down, np.array([0.0, 0.0, 1.0]))
        inertial = WorldAcceleration.integrated(inertial.t_s, quat_rotate(up, inertial.accel_m_s2 + down))
        path = trajectory.cam_in_world
        metric = trajectory.length_unit == "m"
        if metric:
            calibration = timed.calibration
            lever = quat_rotate(quat_conjugate(calibration.cam_from_imu_xyzw), calibration.imu_in_cam_m)
            path = path + quat_rotate(attitude.world_from_imu_xyzw, lever)
        self._t_s, self._path, self._inertial = trajectory.t_s, quat_rotate(up, path - path.mean(axis=0)), inertial
        self._sums = inertial.sums(trajectory.t_s)[:, 0]
        self._covered = np.concatenate([[0], np.cumsum(~inertial.covers(trajectory.t_s))])
        self._metric, self._step_s = metric, float(np.median(np.diff(trajectory.t_s)))

    def over(self, reach: int) -> tuple[Array, Array, Array]:
        """Times, and accelerations by second differences over so many frames to both sides."""
        t_s = self._t_s
        if len(t_s) <= 2 * reach:
            return np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))
        before, after = t_s[reach:-reach] - t_s[: -2 * reach], t_s[2 * reach :] - t_s[reach:-reach]

        def second_difference(p: Array) -> Array:
            slopes = (p[2 * reach :] - p[reach:-reach]) / after[:, None] - (p[reach:-reach] - p[: -2 * reach]) / (
                before[:, None]
            )
            return 2 * slopes / (before + after)[:, None]

        gaps = self._covered[2 * reach :] != self._covered[: -2 * reach]
        broken = gaps | (np.maximum(before, after) > max(SETTINGS.longest_pause_s, 3 * reach * self._step_s))
        by_camera, by_imu = second_difference(self._path), second_difference(self._sums)
        by_camera[broken] = by_imu[broken] = np.nan
        return t_s[reach:-reach], by_camera, by_imu

    def record(self, start_s: float) -> Record:
        reach = max(1, round(SETTINGS.reach_s / self._step_s))
        t_s, by_camera, by_imu = self.over(reach)
        both = np.isfinite(by_camera).all(axis=1)
        if both.sum() < 3:
            return {"missing": "The accelerometer covers too few frames for a comparison."}
        times = t_s - start_s
        x, y = (a[both] - a[both].mean(axis=0) for a in (by_camera, by_imu))
        power = float(np.sqrt(np.sum(x**2) * np.sum(y**2)))
        return {
            "camera": [thin_line(times, column) for column in by_camera.T],
            "accelerometer": [thin_line(times, column) for column in by_imu.T],
            "camera_unit": "m/s2" if self._metric else "units/s2",
            "averaged_over_s": 2 * reach * self._step_s,
            "correlation": float(np.sum(x * y)) / power if power > 0 else None,
            "rms_camera": _rms(x),
            "rms_accelerometer_m_s2": _rms(y),
        }

    def spectrum(self) -> Record:
        t_s, by_camera, by_imu = self.over(1)
        during = (self._inertial.t_s >= self._t_s[0]) & (self._inertial.t_s <= self._t_s[-1])
        spectra = _collect_spectra(
            camera=(t_s, by_camera),
            imu_at_frames=(t_s, by_imu),
            imu=(self._inertial.t_s[during], self._inertial.accel_m_s2[during]),
        )
        return {**spectra, "camera_unit": "m/s2" if self._metric else "units/s2"}


def _collect_spectra(**signals: tuple[Array, Array]) -> Record:
    spectra = {name: _estimate_spectrum(*signal) for name, signal in signals.items()}
    curves = {name: curve for name, curve in spectra.items() if curve is not None}
    return {"curves": curves} if curves else {"missing": "The recording is too short for a spectrum."}


def _estimate_spectrum(t_s: Array, values: Array) -> Record | None:
    """Amplitude density of a vector (N, 3), unit per root hertz, by Welch's method.

    Returns
    -------
    ``None`` where samples are few or uneven.
    """
    known = np.isfinite(values).all(axis=1)
    if known.sum() < 16:
        return None
    t_s, values = t_s[known], values[known]
    steps = np.diff(t_s)
    step_s = float(np.median(steps))
    if np.mean(np.abs(steps - step_s) < 0.2 * step_s) < SETTINGS.even_share:
        return None
    total: Array | float = 0.0
    count = min(round(SETTINGS.part_s / step_s), int(np.ptp(t_s) / step_s))
    hz = np.zeros(0)
    weights = 0
    for part in np.split(np.arange(len(t_s)), np.flatnonzero(np.diff(t_s) > 5 * step_s) + 1):
        if len(part) < 2 or np.ptp(t_s[part]) < (count - 1) * step_s:
            continue
        grid = np.arange(t_s[part[0]], t_s[part[-1]], step_s)
        if len(grid) < count or count < 8:
            continue
        even = np.stack([np.interp(grid, t_s[part], column[part]) for column in values.T])
        hz, power = _welch(even, step_s, count)
        total = total + len(grid) * power.sum(axis=0)
        weights += len(grid)
    if weights == 0:
        return None
    density = np.sqrt(total / weights)[1:]
    hz = hz[1:]
    edges = np.geomspace(hz[0], hz[-1] * 1.0001, SETTINGS.bins + 1)
    place = np.searchsorted(edges, hz, side="right")
    bins, index, members = np.unique(place, return_inverse=True, return_counts=True)
    mean = np.sqrt(np.bincount(index, density**2, len(bins)) / members)
    return {"hz": round_values(np.bincount(index, hz, len(bins)) / members, 4), "density": round_values(mean, 4)}


def _welch(values: Array, step_s: float, count: int) -> tuple[Array, Array]:
    """Frequencies and one-sided power densities (3, F) of even samples (3, N), over parts of so many that overlap by
    half (Welch 1967); written out, because importing scipy's takes longer than all of this."""
    parts = np.lib.stride_tricks.sliding_window_view(values, count, axis=1)[:, :: count - count // 2]
    window = np.hanning(count + 1)[:-1]
    spectra = np.fft.rfft((parts - parts.mean(axis=2, keepdims=True)) * window, axis=2)
    power = 2 * step_s / np.sum(window**2) * np.mean(np.abs(spectra) ** 2, axis=1)
    return np.asarray(np.fft.rfftfreq(count, step_s), dtype=np.float64), power
