"""Thirty-five faults in recordings: which ones ``diagnose`` names, and false alarms on clean recordings.

    python -m scripts.studies.diagnose [--seed 0] [--faults NAME ...] [--shared ../shared] [--json study.json]
    python -m scripts.studies.diagnose --good [--before OTHER_PYTHON]

Needs the checkout; where ``../shared`` is missing, all recordings are simulated. Each fault goes into a recording that
the seed draws. It counts as named where its code is among the findings and no error is that neither names it nor
follows from it. Twelve recordings without a fault, of several devices, rates and motions, must give no warning and no
error. Exit code 1 where more than one in thirty is missed, or any clean recording is accused.

``--good`` runs the command on captures that are good instead: the example scenes, EuRoC, GoPro's unstabilised clip, and
ten simulated recordings; with ``--before``, by the Python of another checkout, too. Exit code 1 for an error, for a
warning that was not there before, or for more than 10 s beyond it. GoPro's clip is listed apart: its drone hovers.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import quat_conjugate, quat_from_matrix, so3_exp
from colmap_inertial.core.types import CameraModel, CameraTrajectory, FrameTiming, ImuRecording
from colmap_inertial.diagnose import Diagnosis, Recorded, diagnose
from colmap_inertial.io.pose_convention import ARRAYS, PoseConvention, reread
from colmap_inertial.io.trajectories import read_inertial_scale, write_tum
from colmap_inertial.io.units import STANDARD_GRAVITY_M_S2
from colmap_inertial.motion.flow import VisualRotation
from colmap_inertial.run.commands.diagnose import collect
from colmap_inertial.run.commands.scale import ScaleSource
from colmap_inertial.tools.simulate import IMU_PRESETS, MotionOptions, RecordingOptions, simulate_recording
from scripts.common.bench_report import write_report
from scripts.common.real_imu import read

HERE = Path(__file__).resolve().parents[2]
#: Length of a recording, and how much of it a short one has.
SECONDS, SHORT_S = 32.0, 14.0
LENS = CameraModel(model="PINHOLE", width=1280, height=720, params=(1000.0, 1000.0, 640.0, 360.0))


@dataclass(frozen=True, eq=False)
class Base:
    """A recording without a fault: poses, IMU, and the name of what it is."""

    name: str
    trajectory: CameraTrajectory
    imu: ImuRecording

    def recorded(self, *, poses: bool = True) -> Recorded:
        return Recorded(imu=self.imu, trajectory=self.trajectory if poses else None)

    def with_imu(self, **changes: Array) -> Base:
        return replace(self, imu=replace(self.imu, **changes))


# --- recordings without a fault --------------------------------------------------------------------------------------


def simulated(seed: int, kind: str = "orbit", device: str = "phone", seconds: float = SECONDS, **imu: float) -> Base:
    """Of a preset device; ``vigour`` of the motion, anything else of the IMU."""
    vigour = imu.pop("vigour", 1.0)
    options = RecordingOptions(
        motion=MotionOptions(kind=kind, duration_s=seconds, vigour=vigour), imu=replace(IMU_PRESETS[device], **imu)
    )
    made = simulate_recording(options, seed=seed)
    return Base(f"simulated {device}, {kind}", made.trajectory, made.imu)


def tablet(shared: Path, name: str) -> Base:
    """One of the handheld recordings of a tablet, by its beginning."""
    trajectory, imu = read_inertial_scale(shared / "data/inertial_scale" / name)
    return Base(f"tablet {name}", trajectory.select(trajectory.t_s <= trajectory.t_s[0] + SECONDS), imu)


def with_mocap(shared: Path, name: str) -> Base:
    """A recording of a real IMU with the poses of a motion capture, moved to the camera."""
    motion = read(shared / "data/real_imu", name)
    step_s = np.diff(motion.t_s)
    cuts = np.concatenate([[0], 1 + np.flatnonzero(step_s > 1.5 * np.median(step_s)), [len(motion.t_s)]])
    # the motion capture lost the device now and then: its longest part without
    begin_s = motion.t_s[cuts[np.argmax(np.diff(cuts))]]
    seen = (motion.t_s >= begin_s) & (motion.t_s < begin_s + SECONDS)
    felt = (motion.imu_t_s > begin_s - 2) & (motion.imu_t_s < begin_s + SECONDS + 2)
    noise = np.random.default_rng(0).normal(0, 0.001, (int(seen.sum()), 3))
    poses = quat_from_matrix(motion.world_from_cam[seen] @ so3_exp(noise))
    trajectory = CameraTrajectory(
        names=tuple(f"{i:06}" for i in range(len(poses))),
        t_s=motion.t_s[seen],
        cam_from_world_xyzw=quat_conjugate(poses),
        cam_in_world=motion.cam_in_world_m[seen],
    )
    imu = ImuRecording(
        gyro_t_s=motion.imu_t_s[felt],
        gyro_rad_s=motion.gyro_rad_s[felt],
        accel_t_s=motion.imu_t_s[felt],
        accel_m_s2=motion.accel_m_s2[felt],
    )
    return Base(f"{name} with motion capture", trajectory, imu)


def clean_recordings(shared: Path, seed: int) -> list[Base]:
    """Twelve of them; simulated ones in place of real ones that are not there."""
    found = [
        simulated(seed + 1),
        simulated(seed + 2, "walk", "tablet"),
        # a clock that is 0.3 % off is a fault, which the preset's own 0.2 % (one sigma) would draw now and then
        simulated(seed + 3, "roam", "action_camera", clock_rate_sd=5e-4),
        simulated(seed + 4, "orbit", "phone", gyro_rate_hz=400.0, accel_rate_hz=100.0),
        simulated(seed + 5, "roam", "tablet", 20.0),
        simulated(seed + 6, "walk", "phone", vigour=0.5),
    ]
    if (shared / "data/real_imu").is_dir():
        found += [tablet(shared, name) for name in ("D3", "D7", "D15")]
        found += [with_mocap(shared, name) for name in ("room1", "room5", "V102")]
    else:
        found += [simulated(seed + 10 + i, "orbit", device) for i, device in enumerate(2 * list(IMU_PRESETS))]
    return found


# --- faults ----------------------------------------------------------------------------------------------------------

Rng = np.random.Generator


def pictures(base: Base, rng: Rng, gain: float = 1.0, *, smoothed: int = 1, rate_hz: float = 15.0) -> Recorded:
    """The recording as its pictures show it: rotations between frames, by a camera of that focal gain."""
    t_s = base.trajectory.t_s
    every = max(1, round(1 / rate_hz / float(np.median(np.diff(t_s)))))
    seen = base.trajectory.select(slice(None, None, every))
    turn = seen.turn_rad()
    if smoothed > 1:
        kernel = np.ones(smoothed) / smoothed
        turn = np.stack([np.convolve(column, kernel, "same") for column in turn.T], axis=1)
    turn = turn * [gain, gain, 1.0] + rng.normal(0, 3e-4, turn.shape)
    timing = FrameTiming(names=seen.names, t_s=seen.t_s, exposure_s=None, readout_s=0.0, epoch_ns=seen.epoch_ns)
    rotation = VisualRotation(
        names=seen.names,
        t_s=seen.t_s,
        turn_rad=turn,
        sigma_rad=np.full(len(turn), 3e-4),
        support=np.full(len(turn), 200),
        epoch_ns=seen.epoch_ns,
    )
    return Recorded(imu=base.imu, rotation=rotation, timing=timing, camera=LENS, is_capture=True)


def gyro(base: Base, rng: Rng, change: Callable[[Array], Array], *, poses: bool = False) -> Recorded:
    return base.with_imu(gyro_rad_s=change(base.imu.gyro_rad_s)).recorded(poses=poses)


def accel(base: Base, rng: Rng, change: Callable[[Array], Array], *, poses: bool = False) -> Recorded:
    return base.with_imu(accel_m_s2=change(base.imu.accel_m_s2)).recorded(poses=poses)


def short(base: Base) -> Base:
    """The beginning, of both."""
    begin_s = base.trajectory.t_s[0]
    return replace(base, trajectory=base.trajectory.select(base.trajectory.t_s < begin_s + SHORT_S))


def quarter(rng: Rng) -> Array:
    axis = np.eye(3)[rng.integers(3)]
    return so3_exp(rng.choice([-1, 1]) * 0.5 * np.pi * axis)


def mirror(rng: Rng) -> Array:
    signs = np.ones(3)
    signs[rng.integers(3)] = -1
    return signs


def left_handed(base: Base, rng: Rng) -> Recorded:
    """Both sensors' axes left-handed, as in a file whose writer mirrored an axis."""
    signs, imu = mirror(rng), base.imu
    return base.with_imu(gyro_rad_s=-imu.gyro_rad_s * signs, accel_m_s2=imu.accel_m_s2 * signs).recorded()


def exchanged(base: Base, rng: Rng) -> Recorded:
    imu = base.imu
    return Recorded(
        imu=replace(
            imu, gyro_t_s=imu.accel_t_s, gyro_rad_s=imu.accel_m_s2, accel_t_s=imu.gyro_t_s, accel_m_s2=imu.gyro_rad_s
        )
    )


def low_passed(values: Array, rate_hz: float, hz: float) -> Array:
    from scipy.signal import butter, lfilter

    b, a = butter(2, hz / (0.5 * rate_hz))
    return np.asarray(lfilter(b, a, values - values[0], axis=0)) + values[0]


def without_gravity(base: Base, rng: Rng) -> Recorded:
    imu = base.imu
    rate_hz = 1 / float(np.median(np.diff(imu.accel_t_s)))
    return accel(base, rng, lambda a: a - low_passed(low_passed(a, rate_hz, 0.4)[::-1], rate_hz, 0.4)[::-1])


def gravity_twice(base: Base, rng: Rng) -> Recorded:
    imu = base.imu
    rate_hz = 1 / float(np.median(np.diff(imu.accel_t_s)))
    return accel(base, rng, lambda a: a + low_passed(low_passed(a, rate_hz, 0.4)[::-1], rate_hz, 0.4)[::-1])


def clipped(values: Array) -> Array:
    middle = np.median(values, axis=0)
    limit = np.percentile(np.abs(values - middle), 98)
    return np.clip(values, middle - limit, middle + limit)


def paused(base: Base, rng: Rng) -> Recorded:
    imu, begin_s = base.imu, base.imu.gyro_t_s[0] + rng.uniform(6, 12)
    kept = [(t_s < begin_s) | (t_s > begin_s + 1.5) for t_s in (imu.gyro_t_s, imu.accel_t_s)]
    return _rows(base, *kept).recorded()


def _rows(base: Base, of_gyro: Array, of_accel: Array) -> Base:
    imu = base.imu
    return base.with_imu(
        gyro_t_s=imu.gyro_t_s[of_gyro],
        gyro_rad_s=imu.gyro_rad_s[of_gyro],
        accel_t_s=imu.accel_t_s[of_accel],
        accel_m_s2=imu.accel_m_s2[of_accel],
    )


def seldom(base: Base, rng: Rng) -> Recorded:
    every = [
        slice(None, None, round(0.07 / float(np.median(np.diff(t))))) for t in (base.imu.gyro_t_s, base.imu.accel_t_s)
    ]
    return _rows(base, *every).recorded(poses=False)


def of_another(base: Base, rng: Rng) -> Recorded:
    other = simulated(int(rng.integers(1 << 30)), "walk")
    return replace(base, imu=other.imu).recorded()


def clock_rate(base: Base, rng: Rng) -> Recorded:
    begin_s, rate = base.imu.gyro_t_s[0], 1 + rng.choice([-1, 1]) * rng.uniform(0.015, 0.025)
    imu = base.imu
    return base.with_imu(
        gyro_t_s=begin_s + rate * (imu.gyro_t_s - begin_s), accel_t_s=begin_s + rate * (imu.accel_t_s - begin_s)
    ).recorded()


def retimed(base: Base, t_s: Array) -> Base:
    return replace(base, trajectory=replace(base.trajectory, t_s=t_s))


def frame_rate(base: Base, rng: Rng) -> Recorded:
    t_s, factor = base.trajectory.t_s, rng.choice([30 / 24, 30 / 25, 25 / 30, 24 / 30, 60 / 30])
    return retimed(base, t_s[0] + (t_s - t_s[0]) * factor).recorded()


def uneven(base: Base, rng: Rng) -> Recorded:
    """Frames of a recorder that slowed down now and then, counted evenly."""
    lost = (np.arange(len(base.trajectory)) // 150) % 2 == 0
    kept = base.trajectory.select(~(lost & (np.arange(len(lost)) % 16 == 0)))
    counted = np.linspace(kept.t_s[0], kept.t_s[-1], len(kept))
    return Recorded(imu=base.imu, trajectory=replace(kept, t_s=counted))


def clocks_apart(base: Base, rng: Rng) -> Recorded:
    """Stamps said to be of one clock, which are seconds apart."""
    shift_s = float(rng.uniform(5, 20)) + base.trajectory.t_s[0] - base.imu.gyro_t_s[0]
    shift_s += (base.trajectory.epoch_ns - base.imu.epoch_ns) * 1e-9
    imu = base.imu
    moved = base.with_imu(gyro_t_s=imu.gyro_t_s + shift_s, accel_t_s=imu.accel_t_s + shift_s)
    return replace(moved.recorded(), max_offset_s=1.0)


def accel_late(base: Base, rng: Rng) -> Recorded:
    # less is found, and undone, by the fit alone
    late_s = rng.choice([-1, 1]) * rng.uniform(0.2, 0.35)
    return base.with_imu(accel_t_s=base.imu.accel_t_s + late_s).recorded(poses=False)


def dropped(base: Base, rng: Rng) -> Recorded:
    kept = np.arange(len(base.trajectory)) % 40 > 1
    return Recorded(imu=base.imu, trajectory=base.trajectory.select(kept))


def duplicated(base: Base, rng: Rng) -> Recorded:
    shown = np.arange(len(base.trajectory))
    shown = shown - (shown % 5 == 4)
    poses = replace(
        base.trajectory,
        cam_in_world=base.trajectory.cam_in_world[shown],
        cam_from_world_xyzw=base.trajectory.cam_from_world_xyzw[shown],
    )
    return Recorded(imu=base.imu, trajectory=poses)


def convention(base: Base, **written: str) -> Recorded:
    """Poses read by another convention than they were written by."""
    stated = PoseConvention(**{**vars(ARRAYS), **written})  # type: ignore[arg-type]
    return Recorded(imu=base.imu, trajectory=reread(base.trajectory, stated, ARRAYS))


def imu_too_short(base: Base, rng: Rng) -> Recorded:
    kept = [t_s < t_s[0] + 0.6 * SECONDS for t_s in (base.imu.gyro_t_s, base.imu.accel_t_s)]
    return _rows(base, *kept).recorded()


def in_steps(values: Array) -> Array:
    step = np.ptp(values) / 255
    return np.round(values / step) * step


def wrong_time_unit(base: Base, unit: str, written_in: float) -> Recorded:
    """A table whose stamps are in another unit than the capture says, through the command's own reading."""
    imu = base.imu
    with tempfile.TemporaryDirectory() as folder:
        rate = np.stack([np.interp(imu.accel_t_s, imu.gyro_t_s, column) for column in imu.gyro_rad_s.T], axis=1)
        stamps = np.round((imu.accel_t_s - imu.accel_t_s[0]) * written_in).astype(np.int64)
        lines = ["t,gx,gy,gz,ax,ay,az"]
        lines += [
            f"{t}," + ",".join(f"{v:.6g}" for v in row)
            for t, row in zip(stamps.tolist(), np.concatenate([rate, imu.accel_m_s2], axis=1).tolist(), strict=True)
        ]
        table, capture = Path(folder, "imu.csv"), Path(folder, "capture.toml")
        table.write_text("\n".join(lines))
        sensors = (("gyro", "g", "rad/s"), ("accel", "a", "m/s2"))
        capture.write_text(
            "".join(
                f'[imu.{sensor}]\nfile = "imu.csv"\ntime = "t"\ntime_unit = "{unit}"\n'
                f'columns = ["{c}x", "{c}y", "{c}z"]\nunit = "{si}"\n'
                for sensor, c, si in sensors
            )
        )
        poses = Path(folder, "poses.txt")
        write_tum(poses, base.trajectory)
        return collect(ScaleSource(source=poses, imu=capture), lambda *_: None)


Make = Callable[[Base, Rng], Recorded]


@dataclass(frozen=True)
class Fault:
    """What is put in, the codes that name it, the errors that follow from it, and what it needs of a recording."""

    name: str
    codes: tuple[str, ...]
    make: Make
    follows: tuple[str, ...] = ()
    handheld: bool = False


def _rate(base: Base) -> float:
    return 1 / float(np.median(np.diff(base.imu.accel_t_s)))


FAULTS = (
    Fault("gyro in deg/s, called rad/s", ("gyro-in-deg",), lambda b, r: gyro(b, r, np.degrees)),
    Fault("gyro in rad/s, called deg/s", ("gyro-not-in-deg",), lambda b, r: gyro(b, r, np.radians, poses=True)),
    Fault(
        "gyro in rad/s, called deg/s, no camera",
        ("gyro-not-in-deg",),
        lambda b, r: gyro(b, r, np.radians),
        handheld=True,
    ),
    Fault(
        "slow gyro in deg/s, called rad/s, camera",
        ("gyro-in-deg",),
        lambda b, r: gyro(simulated(int(r.integers(999)), vigour=0.12), r, np.degrees, poses=True),
    ),
    Fault(
        "gyro in rad/s, called deg/s, pictures",
        ("gyro-not-in-deg",),
        lambda b, r: pictures(b.with_imu(gyro_rad_s=np.radians(b.imu.gyro_rad_s)), r),
    ),
    Fault("accelerometer in g", ("accel-in-g",), lambda b, r: accel(b, r, lambda a: a / STANDARD_GRAVITY_M_S2)),
    Fault("m/s2, called g", ("accel-not-in-g",), lambda b, r: accel(b, r, lambda a: a * STANDARD_GRAVITY_M_S2)),
    Fault("gravity missing", ("gravity-removed",), without_gravity, handheld=True),
    Fault("gravity twice", ("gravity-doubled",), gravity_twice, handheld=True),
    Fault("sensors exchanged", ("sensors-exchanged",), exchanged),
    Fault("constant channel", ("dead-axis",), lambda b, r: gyro(b, r, lambda w: w * (mirror(r) > 0))),
    Fault("axes turned", ("axes-turned",), lambda b, r: gyro(b, r, lambda w: w @ quarter(r).T), handheld=True),
    Fault("gyro axis flipped", ("axes-mirrored",), lambda b, r: gyro(b, r, lambda w: w * mirror(r)), handheld=True),
    Fault("both left-handed", ("gyro-mirrored", "accel-flipped"), left_handed, handheld=True),
    Fault(
        "accelerometer flipped", ("accel-flipped",), lambda b, r: accel(b, r, np.negative, poses=True), handheld=True
    ),
    Fault("accelerometer late or early", ("sensors-offset",), accel_late, handheld=True),
    Fault("clocks far apart", ("clock-offset",), clocks_apart),
    Fault("clock of another rate", ("clock-rate",), clock_rate),
    Fault("another frame rate", ("frame-rate",), frame_rate),
    Fault("frame times counted", ("frame-times-uneven",), uneven, handheld=True),
    Fault("pause of the IMU", ("long-gap",), paused),
    Fault("gyro at the end of its range", ("saturated",), lambda b, r: gyro(b, r, clipped)),
    Fault(
        "accelerometer low-passed",
        ("low-passed",),
        lambda b, r: accel(b, r, lambda a: low_passed(a, _rate(b), 2.0)),
        follows=("sensors-offset",),
    ),
    Fault("IMU of another recording", ("imu-does-not-fit",), of_another),
    Fault("frames dropped", ("frames-dropped",), dropped),
    Fault("frames repeated", ("frames-repeated",), duplicated, follows=("frame-times-uneven",)),
    Fault("intrinsics of another mode", ("focal-length",), lambda b, r: pictures(b, r, r.choice([0.75, 1.3]))),
    Fault("pictures stabilised", ("stabilised",), lambda b, r: pictures(b, r, smoothed=15), follows=("focal-length",)),
    Fault("quaternions inverted", ("pose-convention",), lambda b, r: convention(b, rotation="world_from_camera")),
    Fault("quaternions wxyz", ("pose-convention",), lambda b, r: convention(b, order="wxyz")),
    Fault("readings too seldom", ("rate-too-low",), seldom),
    Fault("IMU shorter than the frames", ("imu-too-short",), imu_too_short),
    Fault("8 bit gyro", ("coarse-resolution",), lambda b, r: gyro(b, r, in_steps)),
    Fault("ms called s", ("time-unit",), lambda b, r: wrong_time_unit(b, "s", 1e3)),
    Fault("us called ns", ("time-unit",), lambda b, r: wrong_time_unit(b, "ns", 1e6)),
)


def named(fault: Fault, found: Diagnosis) -> bool:
    """Whether a diagnosis names the fault, and accuses nothing else."""
    other = [f.code for f in found.findings if f.severity == "error" and f.code not in (*fault.codes, *fault.follows)]
    return bool(found.codes & set(fault.codes)) and not other


def good_sources(folder: Path, shared: Path, seed: int) -> Iterator[tuple[str, list[str]]]:
    """Name and arguments of ``diagnose`` for each good capture."""
    for scene in ("desk", "euroc_v101"):
        if scene == "desk" or (shared / "data/euroc_v101").is_dir():
            yield scene, [str(HERE / "example_scenes" / scene)]
    for i in range(10):
        base = simulated(seed + 100 + i, ("orbit", "walk", "roam")[i % 3], ("phone", "tablet")[i % 2])
        imu = base.imu
        for name, t_s, values in (
            ("gyroscope", imu.gyro_t_s, imu.gyro_rad_s),
            ("accelerometer", imu.accel_t_s, imu.accel_m_s2),
        ):
            stamps = imu.epoch_ns + np.rint(1e9 * t_s).astype(np.int64)
            lines = [f"{t} {x:.8f} {y:.8f} {z:.8f}" for t, (x, y, z) in zip(stamps.tolist(), values, strict=True)]
            (folder / str(i)).mkdir(exist_ok=True)
            (folder / str(i) / f"{name}.txt").write_text("\n".join(lines))
        poses = folder / f"{i}.txt"
        write_tum(poses, base.trajectory)
        yield f"{base.name} {i}", [str(poses), "--imu", str(folder / str(i))]
    clip = shared / "data/gopro/karma.mp4"
    if clip.is_file():
        yield "GoPro karma (hovers)", [str(clip)]


def run_diagnose(python: Path, source: list[str], folder: str) -> tuple[set[str], set[str], float]:
    """Codes of errors and of warnings by the command of one Python, and how long it took."""
    begin_s = time.monotonic()
    words = [str(python), "-m", "colmap_inertial", "diagnose", *source, "--json", "-"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=folder)
    seconds = time.monotonic() - begin_s
    findings = json.loads(done.stdout)["findings"]
    of = {severity: {f["code"] for f in findings if f["severity"] == severity} for severity in ("error", "warning")}
    return of["error"], of["warning"], seconds


def compare_good(shared: Path, seed: int, before: Path | None) -> int:
    """Errors, warnings and time on good captures, by this version and an earlier one."""
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        for name, source in good_sources(Path(folder), shared, seed):
            errors, warnings, seconds = run_diagnose(Path(sys.executable), source, folder)
            line = f"{name:28} {seconds:5.1f} s  {', '.join(sorted(errors | warnings)) or '-'}"
            fails = bool(errors)
            if before is not None:
                _, warned, earlier_s = run_diagnose(before, source, folder)
                line += f"  (before: {earlier_s:.1f} s, {', '.join(sorted(warned)) or '-'})"
                fails = fails or bool(warnings - warned) or seconds > earlier_s + 10
            bad += fails and not name.startswith("GoPro")
            print(f"{'ACCUSED' if fails else 'good   '}  {line}", flush=True)
    print(f"{bad} good captures accused")
    return int(bad > 0)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--faults", nargs="*", default=[], help="only those whose name begins like one of these")
    parser.add_argument("--shared", type=Path, default=HERE.parent / "shared")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--good", action="store_true", help="run the command on good captures instead")
    parser.add_argument("--before", type=Path, help="Python of an earlier version, to compare with")
    options = parser.parse_args(arguments)
    if options.good:
        return compare_good(options.shared, options.seed, options.before)
    clean = clean_recordings(options.shared, options.seed)
    rows = []
    for i, fault in enumerate(FAULTS):
        if options.faults and not any(fault.name.startswith(name) for name in options.faults):
            continue
        rng = np.random.default_rng([options.seed, i])
        # flown ones tell nothing of gravity; see io/plausible.py
        fit = [base for base in clean if not fault.handheld or not base.name.startswith(("V", "room"))]
        base = fit[rng.integers(len(fit))]
        found = diagnose(fault.make(base, rng))
        rows.append({"fault": fault.name, "in": base.name, "named": named(fault, found), "codes": codes(found)})
        print(
            f"{'named ' if rows[-1]['named'] else 'MISSED'}  {fault.name:42} {base.name:28} {codes(found)}", flush=True
        )
    accused = []
    if not options.faults:
        for base in clean:
            found = diagnose(base.recorded())
            told = [f.code for f in found.findings if f.severity != "info"]
            accused += [base.name] if told else []
            print(f"{'ACCUSED' if told else 'clean  '}  {base.name:50} {codes(found)}", flush=True)
    count = sum(bool(row["named"]) for row in rows)
    print(f"{count} of {len(rows)} faults named; {len(accused)} of {len(clean)} clean recordings accused")
    if options.json is not None:
        write_report(options.json, {"faults": rows, "accused": accused})
    return int(count < len(rows) - len(rows) // 30 or bool(accused))


def codes(found: Diagnosis) -> str:
    return ", ".join(f"{f.code} ({f.severity})" for f in found.findings) or "-"


if __name__ == "__main__":
    sys.exit(main())
