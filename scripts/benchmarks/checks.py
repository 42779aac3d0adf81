"""What the checks and the verdict make of sound recordings: stopped, weak and why, trusted, inside.

    python -m scripts.benchmarks.checks [--shared ../shared] [--sets tablet rooms ...] [--rows rows.csv] [--table]
    python -m scripts.benchmarks.checks --command 5     # a sample of the same through the command line
    python -m scripts.benchmarks.checks --sets random --command 32

Recordings with known scale, cut as a user cuts them: camera and IMU, the latter to a second before and after the
frames. All windows of 10, 15, 20, 30, 40 and 60 s of tablets' recordings (``inertial_scale``), of handheld and flown
IMUs with motion capture (``real_imu``, ``euroc_v101``: poses with the errors of a reconstruction), of a phone with
LiDAR (``iphone_lidar``) and of a flight that stands still in the end (``euroc_mh01``, frames at 5 and 20 Hz); and 200
simulated recordings of every kind of motion, device, length and frame rate, among them short orbits and ones that
stand still for a part of their time. ``random`` are windows of 12 to 50 s from anywhere in the real ones, of every,
every second or third frame, with 0 to 1 s of the IMU before and after them. And faults of every kind, at sizes from
harmless to gross, in three of them.

Each goes the way of ``scale``: the checks beforehand, then the estimate, also where a check stops it, as ``--force``
would. Rows are kept in a CSV, and those that are there are not run again. ``--table`` prints the tables of a CSV.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact, sentences
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_multiply
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import CameraTrajectory, ImuRecording
from colmap_inertial.diagnose import Recorded, diagnose
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.inertial.scale.verdict import half_width
from colmap_inertial.io.trajectories import read_inertial_scale, write_tum
from colmap_inertial.motion.align import align_camera_imu
from colmap_inertial.tools import simulate
from scripts.common.real_imu import FLOWN, HANDHELD, RECORDINGS, Motion, Window, read, reconstructed
from scripts.studies import model_faults as study_model_faults

HERE = Path(__file__).resolve().parents[2]
LENGTHS_S = (10.0, 15.0, 20.0, 30.0, 40.0, 60.0)
#: IMU before and after the frames.
MARGIN_S = 1.0
#: Errors of the centres of poses from motion capture.
NOISE_M = 0.002
#: ARKit's lengths by LiDAR: lengths of registered depths, and the depths' own scale (one sigma each).
LIDAR, LIDAR_SIGMA = 1.030, float(np.hypot(0.005, 0.01))

Made = tuple[CameraTrajectory, ImuRecording, float]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A sound recording: where it is from, and what makes it; the true metres per unit with their uncertainty."""

    group: str
    name: str
    length_s: float
    begin_s: float
    by_hand: bool
    make: Callable[[], Made]
    truth_sigma: float = 0.0

    @property
    def key(self) -> str:
        return f"{self.group}/{self.name}/{self.length_s:g}/{self.begin_s:.1f}"


# --- real recordings -------------------------------------------------------------------------------------------------


def parts(t_s: Array, lengths_s: Sequence[float] = LENGTHS_S) -> Iterator[tuple[float, float]]:
    """Length and begin of all windows, one after another."""
    for length_s in lengths_s:
        count = int((t_s[-1] - t_s[0] + 0.05) // length_s)
        for k in range(count):
            yield length_s, float(t_s[0] + k * length_s)


def cut(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    offset_s: float,
    begin_s: float,
    length_s: float,
    truth: float,
    *,
    margin_s: float = MARGIN_S,
) -> Made:
    """Frames of a window, and the IMU to a margin around them; ``offset_s`` is camera time less the IMU's."""
    seen = (trajectory.t_s >= begin_s) & (trajectory.t_s <= begin_s + length_s)
    frames = trajectory.select(seen)
    first_s, last_s = frames.t_s[0] - margin_s - offset_s, frames.t_s[-1] + margin_s - offset_s
    gyro, accel = ((t_s >= first_s) & (t_s <= last_s) for t_s in (imu.gyro_t_s, imu.accel_t_s))
    return (
        frames,
        replace(
            imu,
            gyro_t_s=imu.gyro_t_s[gyro],
            gyro_rad_s=imu.gyro_rad_s[gyro],
            accel_t_s=imu.accel_t_s[accel],
            accel_m_s2=imu.accel_m_s2[accel],
        ),
        truth,
    )


def recorded_by_tablet(shared: Path) -> Iterator[tuple[str, CameraTrajectory, ImuRecording, float, float]]:
    """Name, poses, IMU, camera time less the IMU's, and metres per unit."""
    for folder in sorted((shared / "data/inertial_scale").glob("D*"), key=lambda path: (len(path.name), path.name)):
        trajectory, imu = read_inertial_scale(folder)
        shift_s = (imu.epoch_ns - trajectory.epoch_ns) * 1e-9
        offset_s = shift_s + align_camera_imu(trajectory, imu).clock_offset_s
        yield folder.name, trajectory, imu, offset_s, float((folder / "groundtruth.txt").read_text())


def tablets(shared: Path) -> Iterator[Case]:
    for name, trajectory, imu, offset_s, truth in recorded_by_tablet(shared):
        for length_s, begin_s in parts(trajectory.t_s):
            make = partial(cut, trajectory, imu, offset_s, begin_s, length_s, truth)

            yield Case(
                group="tablet",
                name=name,
                length_s=length_s,
                begin_s=begin_s - float(trajectory.t_s[0]),
                by_hand=True,
                make=make,
            )


def windows_of(group: str, name: str, motion: Motion, *, by_hand: bool) -> Iterator[Case]:
    """Windows of a motion, with the errors of a reconstruction; none where the motion capture lost much."""
    usual_s = float(np.median(np.diff(motion.t_s)))
    for k, (length_s, begin_s) in enumerate(parts(motion.t_s)):
        frames = int(np.sum((motion.t_s >= begin_s) & (motion.t_s < begin_s + length_s)))
        if frames < 0.7 * length_s / usual_s:
            continue
        window = Window(
            recording=name,
            length_s=length_s,
            begin_s=begin_s,
            end_s=begin_s + length_s,
            noise_m=NOISE_M,
            correlation_s=(0.1, 0.35, 1.0)[k % 3],
            seed=1000 + k,
        )
        yield Case(
            group=group,
            name=name,
            length_s=length_s,
            begin_s=begin_s - float(motion.t_s[0]),
            by_hand=by_hand,
            make=partial(reconstructed, motion, window, margin_s=MARGIN_S),
        )


def with_mocap(shared: Path, *, by_hand: bool) -> Iterator[Case]:
    for name, (rig, _) in RECORDINGS.items():
        if (rig is HANDHELD) == by_hand:
            motion = read(shared / "data/real_imu", name)
            yield from windows_of("rooms" if by_hand else "flights", name, motion, by_hand=by_hand)


def euroc_imu(folder: Path, origin_ns: int) -> tuple[Array, Array, Array]:
    """Times, rates and accelerations of EuRoC's table."""
    lines = [line for line in (folder / "mav0/imu0/data.csv").read_text().splitlines() if line[0] != "#"]
    stamps = np.array([int(line.partition(",")[0]) for line in lines])
    rows = np.loadtxt(lines, delimiter=",")
    return (stamps - origin_ns) * 1e-9, rows[:, 1:4], rows[:, 4:7]


def vicon_room(shared: Path) -> Motion:
    """EuRoC V1_01: 20 poses a second of its ground truth, moved to the camera."""
    folder = shared / "data/euroc_v101"
    lines = [line for line in (folder / "gt/V1_01_easy.csv").read_text().splitlines() if line[0] != "#"]
    stamps = np.array([int(line.partition(",")[0]) for line in lines])
    rows = np.loadtxt(lines, delimiter=",")
    imu_t_s, gyro, accel = euroc_imu(folder, int(stamps[0]))
    body_from_cam, cam_in_body_m = FLOWN
    world_from_imu = matrix_from_quat(rows[:, [5, 6, 7, 4]] / np.linalg.norm(rows[:, 4:8], axis=1)[:, None])
    return Motion(
        t_s=(stamps - stamps[0]) * 1e-9,
        world_from_cam=world_from_imu @ body_from_cam,
        cam_in_world_m=rows[:, 1:4] + world_from_imu @ cam_in_body_m,
        imu_t_s=imu_t_s,
        gyro_rad_s=gyro,
        accel_m_s2=accel,
    )


def vicon_flight(shared: Path) -> Iterator[Case]:
    yield from windows_of("flights", "V101", vicon_room(shared), by_hand=False)


def machine_hall(shared: Path, every: int) -> Motion:
    """EuRoC MH_01: poses of its camera, 30 s of which it stands still for the last 14; every so many."""
    folder = shared / "data/euroc_mh01"
    lines = [line for line in (folder / "gt/camera.csv").read_text().splitlines() if line and line[0] != "#"]
    stamps = np.array([int(line.partition(".")[0]) for line in lines])
    rows = np.loadtxt(lines, delimiter=",")
    imu_t_s, gyro, accel = euroc_imu(folder, int(stamps[0]))
    t_s = (stamps - stamps[0]) * 1e-9
    return Motion(
        t_s=t_s[::every],
        # the table has camera_from_world
        world_from_cam=matrix_from_quat(rows[:, [5, 6, 7, 4]]).transpose(0, 2, 1)[::every],
        cam_in_world_m=rows[::every, 1:4],
        imu_t_s=imu_t_s,
        gyro_rad_s=gyro,
        accel_m_s2=accel,
    )


def standing_flight(shared: Path) -> Iterator[Case]:
    for every, hz in ((4, 5), (1, 20)):
        motion = machine_hall(shared, every)
        for k, (noise_m, correlation_s) in enumerate([(n, c) for n in (0.002, 0.0035) for c in (0.1, 0.35, 1.0)]):
            for length_s in (20.0, 30.0):
                window = Window(
                    recording="MH01",
                    length_s=length_s,
                    begin_s=0.0,
                    end_s=length_s,
                    noise_m=noise_m,
                    correlation_s=correlation_s,
                    seed=2000 + k,
                )

                yield Case(
                    group="standing",
                    name=f"MH01 {hz} Hz {1000 * noise_m:g} mm {correlation_s:g} s",
                    length_s=length_s,
                    begin_s=0.0,
                    by_hand=False,
                    make=partial(reconstructed, motion, window, margin_s=MARGIN_S),
                )


def phone(shared: Path) -> Iterator[Case]:
    """An iPhone: ARKit's path, whose lengths LiDAR knows, and readings of the other sign; every second of 60 poses."""
    folder = shared / "data/iphone_lidar"
    rows = np.loadtxt(folder / "odometry.csv", delimiter=",", skiprows=1)[::2]
    # camera axes: ARKit's y points up and z back
    cam_from_arkit = np.array([1.0, 0.0, 0.0, 0.0])
    t_s = rows[:, 0] - rows[0, 0]
    trajectory = CameraTrajectory(
        names=tuple(f"{int(i):06}" for i in rows[:, 1]),
        t_s=t_s,
        cam_from_world_xyzw=quat_multiply(cam_from_arkit, quat_conjugate(rows[:, 5:9])),
        cam_in_world=rows[:, 2:5],
    )
    table = np.loadtxt(folder / "imu.csv", delimiter=",", skiprows=1)
    imu_t_s = table[:, 0] - rows[0, 0]
    imu = ImuRecording(gyro_t_s=imu_t_s, gyro_rad_s=table[:, 4:7], accel_t_s=imu_t_s, accel_m_s2=-table[:, 1:4])
    whole_s = float(t_s[-1] - t_s[0])
    for length_s, begin_s in [(10.0, 0.0), (10.0, whole_s - 10.0), (15.0, 0.0)]:
        yield Case(
            group="phone",
            name="iphone",
            length_s=length_s,
            begin_s=begin_s,
            by_hand=True,
            make=partial(cut, trajectory, imu, 0.0, begin_s, length_s, LIDAR),
            truth_sigma=LIDAR_SIGMA,
        )


#: Of windows from anywhere: shortest and longest, the IMU before and after the frames, and which of these are left.
ANYWHERE_S, LEFT_AROUND_S, EVERY = (12.0, 50.0), (0.0, 0.3, 1.0), (1, 2, 3)


def anywhere(shared: Path, each: int = 2, seed: int = 0) -> Iterator[Case]:
    """Windows at random of every real recording whose scale is known to a per mille."""

    def draw(name: str, t_s: Array, by_hand: bool, make: Callable[[float, float, float, int], Made]) -> Iterator[Case]:
        for k in range(each):
            rng = np.random.default_rng([seed, 61, k, *name.encode()])
            length_s = float(min(rng.uniform(*ANYWHERE_S), t_s[-1] - t_s[0]))
            begin_s = float(rng.uniform(t_s[0], t_s[-1] - length_s))
            margin_s, every = float(rng.choice(LEFT_AROUND_S)), int(rng.choice(EVERY))
            yield Case(
                group="random",
                name=f"{name} every {every}, {margin_s:g} s around",
                length_s=length_s,
                begin_s=begin_s - float(t_s[0]),
                by_hand=by_hand,
                make=partial(_thinned, partial(make, begin_s, length_s, margin_s, k), every),
            )

    for name, trajectory, imu, offset_s, truth in recorded_by_tablet(shared):

        def from_tablet(
            begin_s: float,
            length_s: float,
            margin_s: float,
            k: int,
            poses: CameraTrajectory = trajectory,
            imu: ImuRecording = imu,
            offset_s: float = offset_s,
            truth: float = truth,
        ) -> Made:
            return cut(poses, imu, offset_s, begin_s, length_s, truth, margin_s=margin_s)

        yield from draw(name, trajectory.t_s, True, from_tablet)
    motions = {name: read(shared / "data/real_imu", name) for name in RECORDINGS}
    motions |= {"V101": vicon_room(shared), "MH01": machine_hall(shared, 1)}
    for name, motion in motions.items():

        def from_motion(begin_s: float, length_s: float, margin_s: float, k: int, motion: Motion = motion) -> Made:
            window = Window(
                recording="random",
                length_s=length_s,
                begin_s=begin_s,
                end_s=begin_s + length_s,
                noise_m=NOISE_M,
                correlation_s=(0.1, 0.35, 1.0)[k % 3],
                seed=4000 + k,
            )
            return reconstructed(motion, window, margin_s=margin_s)

        by_hand = name in RECORDINGS and RECORDINGS[name][0] is HANDHELD
        yield from draw(name, motion.t_s, by_hand, from_motion)


def _thinned(make: Callable[[], Made], every: int) -> Made:
    """The same with every so many of the frames."""
    trajectory, imu, truth = make()
    return trajectory.select(np.arange(len(trajectory.t_s)) % every == 0), imu, truth


# --- simulated recordings --------------------------------------------------------------------------------------------

KINDS = ("orbit", "walk", "roam")
FRAME_RATES_HZ = (5.0, 10.0, 30.0, 60.0)


def simulated(count: int = 168, seed: int = 0) -> Iterator[Case]:
    """Every kind of motion, device, length, vigour and frame rate, by a seeded draw; orbits of 8 s last."""
    rng = np.random.default_rng([seed, 56])
    for k in range(count):
        kind, device = KINDS[k % 3], list(simulate.IMU_PRESETS)[(k // 3) % 3]
        length_s = LENGTHS_S[(k // 9) % 6]
        rate_hz = float(rng.choice(FRAME_RATES_HZ))
        vigour = float(rng.uniform(0.5, 1.2))
        yield _simulated(
            f"{kind} {device} {rate_hz:g} Hz x{vigour:.2f} #{k}",
            simulate.MotionOptions(kind=kind, duration_s=length_s, vigour=vigour),  # type: ignore[arg-type]
            device,
            rate_hz,
            [seed, 56, k],
        )
    for k in range(8):
        motion = simulate.MotionOptions(
            kind="orbit", duration_s=8.0, radius_m=1.2, arc_deg=60.0, sweep_s=1.2 * np.radians(60) / 0.8
        )
        yield _simulated(f"short orbit #{k}", motion, ("phone", "tablet")[k % 2], 30.0, [seed, 57, k])


def _simulated(
    name: str, motion: simulate.MotionOptions, device: str, rate_hz: float, seed: list[int], group: str = "simulated"
) -> Case:
    options = simulate.RecordingOptions(
        motion=motion,
        imu=replace(simulate.IMU_PRESETS[device], lead_s=(MARGIN_S, MARGIN_S)),
        sfm=simulate.SfmOptions(frame_rate_hz=rate_hz),
    )

    def make() -> Made:
        made = simulate.simulate_recording(options, seed=int(np.random.default_rng(seed).integers(1 << 40)))
        return made.trajectory, replace(made.imu, noise=None), made.truth.metres_per_unit

    return Case(group=group, name=name, length_s=motion.duration_s, begin_s=0.0, by_hand=True, make=make)


#: How a camera that stands still comes to rest and sets off again.
EASE_S = 0.5


def standing(motion: simulate.Motion, rests_s: Sequence[tuple[float, float]], duration_s: float) -> simulate.Motion:
    """The same path, gone along with rests: time on it stands still in them."""
    step_s = 1 / 60
    t_s = np.arange(motion.start_s, duration_s + 3.0, step_s)
    speed = np.ones(len(t_s))
    for begin_s, end_s in rests_s:
        into, out = (np.clip((t_s - at_s) / EASE_S, 0, 1) for at_s in (begin_s, end_s - EASE_S))
        ease = [x**3 * (10 - 15 * x + 6 * x**2) for x in (into, out)]
        speed *= 1 - ease[0] + ease[1]
    along_s = motion.start_s + np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * step_s)])
    along_s = np.clip(along_s, motion.start_s, motion.end_s)
    return simulate.Motion(
        start_s=float(t_s[0]),
        step_s=step_s,
        cam_in_world_m=motion.cam_in_world_m(along_s),
        world_from_cam_xyzw=motion.world_from_cam_xyzw(along_s),
    )


def resting(count: int = 27, seed: int = 0) -> Iterator[Case]:
    """Recordings that stand still for a third, half and most of their time, at the beginning, middle and end."""
    shares, places = (1 / 3, 1 / 2, 0.7), ("beginning", "middle", "end")
    for k in range(count):
        share, place = shares[k % 3], places[(k // 3) % 3]
        kind, device = KINDS[(k // 9) % 3], list(simulate.IMU_PRESETS)[k % 3]
        length_s, rate_hz = (30.0, 20.0, 60.0)[(k // 3 + k) % 3], (5.0, 30.0)[k % 2]
        still_s = share * length_s
        begin_s = {"beginning": -2.9, "middle": 0.5 * (length_s - still_s), "end": length_s - still_s}[place]
        end_s = {"beginning": still_s, "middle": begin_s + still_s, "end": length_s + 2.9 + EASE_S}[place]

        def make(
            kind: str = kind,
            device: str = device,
            length_s: float = length_s,
            rate_hz: float = rate_hz,
            rest_s: tuple[float, float] = (begin_s, end_s),
            k: int = k,
        ) -> Made:
            rngs = [np.random.default_rng([seed, 58, k, i]) for i in range(2)]
            moving = simulate.make_motion(
                simulate.MotionOptions(kind=kind, duration_s=length_s),  # type: ignore[arg-type]
                rngs[0],
            )
            motion = standing(moving, [rest_s], length_s)
            options = replace(simulate.IMU_PRESETS[device], lead_s=(MARGIN_S, MARGIN_S))
            errors = simulate.draw_imu_errors(options, length_s, rngs[1])
            sampled = simulate.sample_imu(motion, errors, options, duration_s=length_s, rng=rngs[1])
            imu = sampled.recording
            t_s = np.arange(int(length_s * rate_hz)) / rate_hz
            poses = motion.at(t_s)
            made = Motion(
                t_s=t_s,
                world_from_cam=matrix_from_quat(poses.world_from_cam_xyzw),
                cam_in_world_m=poses.cam_in_world_m,
                # the device's own readings, on its own clock, are taken below
                imu_t_s=sampled.gyro_t_cam_s,
                gyro_rad_s=imu.gyro_rad_s,
                accel_m_s2=np.zeros_like(imu.gyro_rad_s),
            )
            window = Window(
                recording="resting",
                length_s=length_s,
                begin_s=0.0,
                end_s=length_s,
                noise_m=NOISE_M,
                correlation_s=(0.1, 0.35, 1.0)[k % 3],
                seed=3000 + k,
            )
            trajectory, _, truth = reconstructed(made, window)
            return trajectory, replace(imu, noise=None), truth

        yield Case(
            group="resting",
            name=f"{kind} {device} {rate_hz:g} Hz, {100 * share:.0f} % at the {place} #{k}",
            length_s=length_s,
            begin_s=0.0,
            by_hand=True,
            make=make,
        )


SETS: dict[str, Callable[[Path], Iterator[Case]]] = {
    "tablet": tablets,
    "rooms": lambda shared: with_mocap(shared, by_hand=True),
    "flights": lambda shared: with_mocap(shared, by_hand=False),
    "vicon": vicon_flight,
    "standing": standing_flight,
    "phone": phone,
    "random": anywhere,
    "simulated": lambda shared: simulated(),
    "resting": lambda shared: resting(),
}


# --- faults ----------------------------------------------------------------------------------------------------------

Change = Callable[[CameraTrajectory, ImuRecording, float, float], tuple[CameraTrajectory, ImuRecording]]


@dataclass(frozen=True, kw_only=True)
class Fault:
    """What is put into a sound recording: sizes from harmless to gross, and the codes that name it."""

    sizes: tuple[float, ...]
    named: tuple[str, ...]
    change: Change


def of_model(fault: str) -> Change:
    """A fault of ``scripts/studies/model_faults.py``."""

    def change(
        poses: CameraTrajectory, imu: ImuRecording, truth: float, size: float
    ) -> tuple[CameraTrajectory, ImuRecording]:
        window = Window(recording="", length_s=0, begin_s=0, end_s=0, noise_m=0, correlation_s=0, seed=3)
        return study_model_faults.alter(
            study_model_faults.Altered(window=window, fault=fault, size=size), poses, imu, truth
        )

    return change


def of_accel(change: Callable[[ImuRecording, float], Array]) -> Change:
    return lambda poses, imu, truth, size: (poses, replace(imu, accel_m_s2=change(imu, size)))


def of_gyro(change: Callable[[ImuRecording, float], Array]) -> Change:
    return lambda poses, imu, truth, size: (poses, replace(imu, gyro_rad_s=change(imu, size)))


def low_passed(imu: ImuRecording, hz: float) -> Array:
    """A filter of the first order, as applications have it."""
    out = imu.accel_m_s2.copy()
    for i, step_s in enumerate(np.diff(imu.accel_t_s), start=1):
        out[i] = out[i - 1] + (1 - np.exp(-2 * np.pi * hz * step_s)) * (out[i] - out[i - 1])
    return out


def smoothed(poses: CameraTrajectory, width_s: float) -> CameraTrajectory:
    step_s = float(np.median(np.diff(poses.t_s)))
    reach = max(1, round(3 * width_s / step_s))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step_s / width_s) ** 2)
    padded = np.pad(poses.cam_in_world, ((reach, reach), (0, 0)), mode="edge")
    smooth = [np.convolve(column, kernel / kernel.sum(), mode="valid") for column in padded.T]
    return replace(poses, cam_in_world=np.stack(smooth, axis=1))


def wandering(poses: CameraTrajectory, amplitude_s: float) -> CameraTrajectory:
    return replace(poses, t_s=poses.t_s + amplitude_s * np.sin(2 * np.pi * poses.t_s / 10.0))


def paused(imu: ImuRecording, length_s: float) -> ImuRecording:
    middle_s = 0.5 * (imu.gyro_t_s[0] + imu.gyro_t_s[-1])
    gyro, accel = (np.abs(t_s - middle_s) > 0.5 * length_s for t_s in (imu.gyro_t_s, imu.accel_t_s))
    return replace(
        imu,
        gyro_t_s=imu.gyro_t_s[gyro],
        gyro_rad_s=imu.gyro_rad_s[gyro],
        accel_t_s=imu.accel_t_s[accel],
        accel_m_s2=imu.accel_m_s2[accel],
    )


def saturated(imu: ImuRecording, share: float) -> Array:
    limit = np.quantile(np.abs(imu.accel_m_s2).max(axis=1), 1 - share)
    return np.clip(imu.accel_m_s2, -limit, limit)


def jumping(poses: CameraTrajectory, truth: float, size_m: float, *, last_s: float) -> CameraTrajectory:
    """Nine jumps, in the last seconds."""
    rng = np.random.default_rng(9)
    late = np.flatnonzero(poses.t_s > poses.t_s[-1] - last_s)
    path = poses.cam_in_world.copy()
    for k in np.sort(rng.choice(late, min(9, len(late)), replace=False)):
        path[k:] += size_m / truth * rng.standard_normal(3)
    return replace(poses, cam_in_world=path)


FAULTS: dict[str, Fault] = {
    "accelerometer late, s": Fault(
        sizes=(0.02, 0.06, 0.1, -0.1, 0.2, -0.4),
        named=("sensors-offset", "accel-delay-undone"),
        change=lambda poses, imu, truth, size: (poses, replace(imu, accel_t_s=imu.accel_t_s + size)),
    ),
    "camera's clock fast": Fault(
        sizes=(0.001, 0.003, 0.01, 0.02), named=("clock-rate", "clocks-run-apart"), change=of_model("clock")
    ),
    "frame times wander, s": Fault(
        sizes=(0.01, 0.03, 0.06, 0.12),
        named=("frame-times-uneven",),
        change=lambda poses, imu, truth, size: (wandering(poses, size), imu),
    ),
    "accelerometer's gain": Fault(
        sizes=(0.01, -0.02, 0.03, 0.05, -0.1),
        named=("accel-gain-large", "accel-gain-doubtful", "accel-gain-impossible"),
        change=of_model("gain"),
    ),
    "accelerometer's bias, m/s2": Fault(
        sizes=(0.2, 0.45, 1.0, 2.5),
        named=(
            "accel-gain-large",
            "accel-gain-doubtful",
            "accel-gain-impossible",
            "accel-bias-impossible",
            "spectral-bias-large",
        ),
        change=of_model("bias"),
    ),
    "torn": Fault(
        sizes=(0.01, 0.03, 0.05, 0.1),
        named=("scale-breaks", "scale-grows", "scale-varies", "model-stretched"),
        change=of_model("torn"),
    ),
    "drifting": Fault(
        sizes=(0.01, 0.03, 0.05, 0.1),
        named=("scale-breaks", "scale-grows", "scale-varies", "model-stretched"),
        change=of_model("drift"),
    ),
    "stretched": Fault(
        sizes=(0.01, 0.03, 0.05, 0.1),
        named=("scale-breaks", "scale-grows", "scale-varies", "model-stretched"),
        change=of_model("stretch"),
    ),
    "accelerometer low-passed, Hz": Fault(
        sizes=(20.0, 8.0, 4.0, 2.0),
        named=("accel-low-passed", "path-smoothed", "accel-lags-as-filtered"),
        change=of_accel(low_passed),
    ),
    "path smoothed, s": Fault(
        sizes=(0.02, 0.05, 0.1),
        named=("accel-low-passed", "path-smoothed", "fit-hardly-converged", "accel-contradicts-motion"),
        change=lambda poses, imu, truth, size: (smoothed(poses, size), imu),
    ),
    "pause, s": Fault(
        sizes=(0.05, 0.3, 2.0, 5.0),
        named=("long-gap", "sensor-pauses"),
        change=lambda poses, imu, truth, size: (poses, paused(imu, size)),
    ),
    "accelerometer cut off": Fault(
        sizes=(0.0005, 0.01, 0.05),
        named=("saturated", "readings-cut-off", "sensor-saturated"),
        change=of_accel(saturated),
    ),
    "poses jump in the last .6 s, m": Fault(
        sizes=(0.02, 0.1, 1.0),
        named=("poses-jump",),
        change=lambda poses, imu, truth, size: (jumping(poses, truth, size, last_s=0.6), imu),
    ),
    "accelerometer's sign": Fault(
        sizes=(-1.0,),
        named=("accel-flipped", "axes-turned", "axes-mirrored"),
        change=of_accel(lambda imu, size: size * imu.accel_m_s2),
    ),
    "accelerometer's x mirrored": Fault(
        sizes=(-1.0,),
        named=("axes-mirrored", "axes-turned"),
        change=of_accel(lambda imu, size: imu.accel_m_s2 * [size, 1, 1]),
    ),
    "gyroscope's gain": Fault(
        sizes=(1.02, 1.1, 1.3), named=("gyro-gain",), change=of_gyro(lambda imu, size: size * imu.gyro_rad_s)
    ),
    "gyroscope in steps, rad/s": Fault(
        sizes=(0.002, 0.02, 0.2),
        named=("coarse-resolution",),
        change=of_gyro(lambda imu, size: size * np.round(imu.gyro_rad_s / size)),
    ),
    "accelerometer in steps, m/s2": Fault(
        sizes=(0.01, 0.1, 1.0),
        named=("coarse-resolution",),
        change=of_accel(lambda imu, size: size * np.round(imu.accel_m_s2 / size)),
    ),
    "IMU of another time": Fault(
        sizes=(1.0,),
        named=("imu-does-not-fit", "offset-undecided"),
        change=lambda poses, imu, truth, size: (
            poses,
            replace(imu, gyro_rad_s=imu.gyro_rad_s[::-1].copy(), accel_m_s2=imu.accel_m_s2[::-1].copy()),
        ),
    ),
}


def faulted(shared: Path) -> Iterator[Case]:
    """Each fault of each size in recordings by a tablet, of a room, and of a simulated phone, 20 s of each."""
    bases = [case for case in tablets(shared) if case.key == "tablet/D9/20/0.0"]
    bases += [case for case in with_mocap(shared, by_hand=True) if case.key == "rooms/room3/20/20.0"]
    motion = simulate.MotionOptions(kind="orbit", duration_s=20.0)
    bases.append(_simulated("phone", motion, "phone", 30.0, [0, 59]))
    for name, fault in FAULTS.items():
        for size in fault.sizes:
            for base in bases:
                yield replace(
                    base,
                    group="faults",
                    name=f"{name}: {size:g}, {base.group}",
                    make=partial(_with_fault, base, fault, size),
                )


def _with_fault(base: Case, fault: Fault, size: float) -> Made:
    poses, imu, truth = base.make()
    return (*fault.change(poses, imu, truth, size), truth)


SETS["faults"] = faulted


def print_faults(rows: Sequence[dict[str, str]]) -> None:
    """Each fault and size: outcomes, whether it is named, whether the interval holds the truth."""
    print(
        f"{'':<36}{'stopped':>9}{'refused':>9}{'weak':>6}{'trusted':>9}{'named':>7}{'inside':>10}{'trusted, wrong':>16}"
    )
    names = [row["name"].rpartition(", ")[0] for row in rows]
    for name in dict.fromkeys(names):
        of = [row for row, its in zip(rows, names, strict=True) if its == name]
        outcome = Counter(row["outcome"] for row in of)
        codes = FAULTS[name.rpartition(": ")[0]].named
        said = sum(
            any(
                code in row[key].split()
                for code in codes
                for key in ("errors", "warnings", "infos", "reasons", "notes")
            )
            for row in of
        )
        given = [row for row in of if row["inside"] and row["outcome"] != "stopped"]
        wrong = sum(row["outcome"] == "trusted" and row["inside"] == "0" for row in given)
        print(
            f"{name:<36}{outcome['stopped']:9d}{outcome['refused']:9d}{outcome['weak']:6d}{outcome['trusted']:9d}"
            f"{said:7d}{sum(int(row['inside']) for row in given):5d} of {len(given):<3d}{wrong:12d}"
        )


# --- judging ---------------------------------------------------------------------------------------------------------

FIELDS = (
    *("key", "group", "name", "length_s", "begin_s", "by_hand", "outcome", "errors", "warnings", "infos", "verdict"),
    *("reasons", "notes", "error_pct", "width_pct", "inside", "numbers", "sentences", "check_s", "fit_s"),
)


def codes_of(facts: Iterable[Fact]) -> Iterator[str]:
    """Codes of facts, and of the facts that they speak of."""
    for fact in facts:
        yield fact.code
        yield from codes_of(value for value in fact.values.values() if isinstance(value, Fact))


def judge(case: Case) -> dict[str, object]:
    """A row: what the checks and the estimate say; the estimate also of what is stopped."""
    trajectory, imu, truth = case.make()
    begin_s = time.monotonic()
    diagnosis = diagnose(Recorded(imu=imu, trajectory=trajectory))
    checked_s = time.monotonic()
    estimate = estimate_scale(trajectory, imu)
    fitted_s = time.monotonic()
    of = {
        severity: [f.code for f in diagnosis.findings if f.severity == severity]
        for severity in ("error", "warning", "info")
    }
    outcome = "stopped" if diagnosis.stopping else str(estimate.verdict)
    if outcome == "trusted" and diagnosis.doubting:
        outcome = "weak"
    error = width = inside = None
    if estimate.metres_per_unit is not None and estimate.sigma_log is not None:
        error = float(np.log(estimate.metres_per_unit / truth))
        sigma = float(np.hypot(estimate.sigma_log, case.truth_sigma))
        width, inside = 100 * half_width(estimate.sigma_log), abs(error) <= Z95 * sigma
    return {
        "key": case.key,
        "group": case.group,
        "name": case.name,
        "length_s": f"{case.length_s:g}",
        "begin_s": f"{case.begin_s:.1f}",
        "by_hand": int(case.by_hand),
        "outcome": outcome,
        "errors": " ".join(of["error"]),
        "warnings": " ".join(of["warning"]),
        "infos": " ".join(of["info"]),
        "verdict": estimate.verdict,
        "reasons": " ".join(codes_of(estimate.reasons)),
        "notes": " ".join(codes_of(estimate.notes)),
        "error_pct": "" if error is None else f"{100 * error:.3f}",
        "width_pct": "" if width is None else f"{width:.3f}",
        "inside": "" if inside is None else int(inside),
        "numbers": json.dumps({f.code: dict(f.numbers) for f in diagnosis.findings}),
        "sentences": " | ".join(sentences((*estimate.reasons, *estimate.notes))),
        "check_s": f"{checked_s - begin_s:.2f}",
        "fit_s": f"{fitted_s - checked_s:.2f}",
    }


def run_command(case: Case, folder: Path) -> tuple[str, float | None, float | None]:
    """What the command says of a case: its verdict, or ``stopped``; error and standard deviation of a scale, in %."""
    trajectory, imu, truth = case.make()
    poses, out = folder / "poses.txt", folder / "scale.json"
    write_tum(poses, trajectory)
    for name, t_s, values in (
        ("gyroscope", imu.gyro_t_s, imu.gyro_rad_s),
        ("accelerometer", imu.accel_t_s, imu.accel_m_s2),
    ):
        stamps = imu.epoch_ns + np.rint(1e9 * t_s).astype(np.int64)
        lines = [f"{t} {x:.8f} {y:.8f} {z:.8f}" for t, (x, y, z) in zip(stamps.tolist(), values, strict=True)]
        (folder / f"{name}.txt").write_text("\n".join(lines))
    words = [sys.executable, "-m", "colmap_inertial", "scale", str(poses), "--imu", str(folder), "--json", str(out)]
    subprocess.run(words, capture_output=True, text=True, check=False, cwd=folder)
    found = json.loads(out.read_text())
    if found["metres_per_unit"] is None:
        return "stopped" if found["method"] == "none" else str(found["verdict"]), None, None
    error = 100 * float(np.log(found["metres_per_unit"] / truth))
    return str(found["verdict"]), error, 100 * float(np.hypot(found["sigma_log"], case.truth_sigma))


def run_commands(cases: Sequence[Case], known: dict[str, dict[str, str]]) -> None:
    """Print what the command says of cases, and whether it says the same as a row does."""
    outcomes: Counter[str] = Counter()
    for case in cases:
        with tempfile.TemporaryDirectory() as folder:
            said, error, sigma = run_command(case, Path(folder))
        row = known.get(case.key)
        same = "" if row is None else "same" if said == row["outcome"] else f"OTHER: {row['outcome']}"
        outcomes[said] += 1
        if error is not None and sigma is not None:
            holds = abs(error) <= Z95 * sigma
            outcomes[f"{said} and inside"] += holds
            said += f" {error:6.2f} % +-{Z95 * sigma:.2f} %{'' if holds else ' OUTSIDE'}"
        print(f"{case.key:<60} {said} {same}", flush=True)
    print(", ".join(f"{name}: {count}" for name, count in outcomes.items()))


# --- tables ----------------------------------------------------------------------------------------------------------


def read_rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def figures(rows: Sequence[dict[str, str]]) -> str:
    """One line: number, stopped, refused, weak, trusted, inside of what was given, rms error."""
    outcome = Counter(row["outcome"] for row in rows)
    given = [row for row in rows if row["inside"]]
    trusted = [row for row in given if row["outcome"] == "trusted"]
    inside, right = (sum(int(row["inside"]) for row in of) for of in (given, trusted))
    rms = float(np.sqrt(np.mean([float(row["error_pct"]) ** 2 for row in given]))) if given else float("nan")
    return (
        f"{len(rows):5d}{outcome['stopped']:9d}{outcome['refused']:9d}{outcome['weak']:6d}{outcome['trusted']:9d}"
        f"{100 * outcome['trusted'] / max(len(rows), 1):6.0f} %{inside:7d} of {len(given):<4d}"
        f"{right:5d} of {len(trusted):<4d}{rms:7.2f}"
    )


def print_tables(rows: Sequence[dict[str, str]]) -> None:
    """By set and length; then which checks stopped or warned, and what made windows of 20 s and more weak."""
    head = (
        f"{'n':>5}{'stopped':>9}{'refused':>9}{'weak':>6}{'trusted':>9}{'':>8}{'inside':>10}{'trusted':>15}{'rms %':>8}"
    )
    print(f"{'':<24}{head}")
    for group in dict.fromkeys(row["group"] for row in rows):
        of = [row for row in rows if row["group"] == group]
        print(f"{group:<24}{figures(of)}")
        for length in sorted({row["length_s"] for row in of}, key=float):
            print(f"{f'  {length} s':<24}{figures([row for row in of if row['length_s'] == length])}")
    print(f"{'all':<24}{figures(rows)}")
    long_by_hand = [row for row in rows if float(row["length_s"]) >= 20 and row["by_hand"] == "1"]
    print(f"{'20 s or more, by hand':<24}{figures(long_by_hand)}")
    for name in ("errors", "warnings", "infos"):
        count = Counter(code for row in rows for code in row[name].split())
        print(f"{name}: {', '.join(f'{code} {n}' for code, n in count.most_common()) or 'none'}")
    for what, of in (
        ("reasons, all that are not trusted", [row for row in rows if row["verdict"] != "trusted"]),
        ("reasons, 20 s or more by hand", [row for row in long_by_hand if row["verdict"] != "trusted"]),
    ):
        count = Counter(reason for row in of for reason in row["reasons"].split())
        alone = Counter(row["reasons"] for row in of if " " not in row["reasons"])
        print(f"{what}:")
        for reason, n in count.most_common():
            print(f"  {n:4d}  (alone {alone[reason]:3d})  {reason[:120]}")
    wrong = [row for row in rows if row["inside"] == "0"]
    print(f"outside: {len(wrong)}")
    for row in wrong:
        print(f"  {row['key']:<60} {row['outcome']:8} {row['error_pct']:>7} % +-{row['width_pct']} %  {row['reasons']}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=HERE.parent / "shared")
    usual = [name for name in SETS if name != "random"]
    parser.add_argument("--sets", nargs="+", choices=SETS, default=usual, help="of recordings, and faults")
    parser.add_argument("--rows", type=Path, default=Path("bench_checks.csv"), help="CSV of outcomes, continued")
    parser.add_argument("--keys", default="", help="only cases whose key matches this pattern")
    parser.add_argument("--table", action="store_true", help="print the tables of the CSV, and run nothing")
    parser.add_argument("--command", type=int, default=0, help="run so many of the cases by the command")
    args = parser.parse_args()
    before = read_rows(args.rows)
    if not args.table:
        known = {row["key"]: row for row in before}
        cases = [case for name in args.sets for case in SETS[name](args.shared) if re.search(args.keys, case.key)]
        if args.command:
            run_commands(cases[:: max(1, len(cases) // args.command)][: args.command], known)
            return
        with args.rows.open("a", newline="") as file:
            writer = csv.DictWriter(file, FIELDS)
            if not before:
                writer.writeheader()
            for case in cases:
                if case.key not in known:
                    writer.writerow(judge(case))
                    file.flush()
    rows = read_rows(args.rows)
    print_tables([row for row in rows if row["group"] != "faults"])
    print_faults([row for row in rows if row["group"] == "faults"])


if __name__ == "__main__":
    main()
