"""What is seeded into clean recordings is found by its code, which is absent from the clean ones."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_conjugate, quat_exp, quat_multiply, quat_rotate, so3_exp
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel, CameraTrajectory, Frame, FrameLog, FrameTiming, ImuRecording
from colmap_inertial.diagnose import Diagnosis, FramesInVideo, Recorded, diagnose
from colmap_inertial.diagnose.frames import check_repeated
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frames import read_frame_times
from colmap_inertial.io.imu import read_capture_imu, read_imu
from colmap_inertial.io.trajectories import read_inertial_scale
from colmap_inertial.model import Model, read_model
from colmap_inertial.motion.align import Alignment
from colmap_inertial.motion.flow import VisualRotation, measure_rotation, reduce_frames
from colmap_inertial.run.preparation.preflight import stop_or_doubt
from colmap_inertial.run.stages.metric import MetricStage
from colmap_inertial.tools.simulate.motion import MotionKind, MotionOptions
from colmap_inertial.tools.simulate.recording import RecordingOptions, SimulatedRecording, simulate_recording
from colmap_inertial.tools.simulate.render import colmap_camera
from tests.helpers.far_scene import CAM_FROM_IMU, FarScene
from tests.helpers.simulated_project import Project

HANDHELD = [f"D{i}" for i in (1, 3, 5, 7, 9, 11, 13, 15)]
#: Those whose camera is altered, and how much of them.
ALTERED, SECONDS = ("D3", "D15"), 22.0
Recording = tuple[CameraTrajectory, ImuRecording]


def first(recording: Recording, seconds: float) -> Recording:
    trajectory, imu = recording
    return trajectory.select(trajectory.t_s <= trajectory.t_s[0] + seconds), imu


def found(diagnosis: Diagnosis, code: str) -> str | None:
    """The severity of a code, or ``None`` where it was not found."""
    return next((finding.severity for finding in diagnosis.findings if finding.code == code), None)


# --- the inertial samples by themselves ------------------------------------------------------------------------------


def gyro(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[ImuRecording], ImuRecording]:
    return lambda imu: replace(imu, gyro_rad_s=change(imu.gyro_rad_s))


def accel(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[ImuRecording], ImuRecording]:
    return lambda imu: replace(imu, accel_m_s2=change(imu.accel_m_s2))


def weightless(imu: ImuRecording) -> ImuRecording:
    kernel = np.ones(201) / 201
    slow = np.stack([np.convolve(np.pad(a, 100, mode="edge"), kernel, "valid") for a in imu.accel_m_s2.T], axis=1)
    return replace(imu, accel_m_s2=imu.accel_m_s2 - slow)


def exchanged(imu: ImuRecording) -> ImuRecording:
    return replace(
        imu, gyro_t_s=imu.accel_t_s, gyro_rad_s=imu.accel_m_s2, accel_t_s=imu.gyro_t_s, accel_m_s2=imu.gyro_rad_s
    )


def paused(length_s: float) -> Callable[[ImuRecording], ImuRecording]:
    def alter(imu: ImuRecording) -> ImuRecording:
        begin_s = imu.gyro_t_s[0] + 8
        g = (imu.gyro_t_s < begin_s) | (imu.gyro_t_s > begin_s + length_s)
        a = (imu.accel_t_s < begin_s) | (imu.accel_t_s > begin_s + length_s)
        return replace(
            imu,
            gyro_t_s=imu.gyro_t_s[g],
            gyro_rad_s=imu.gyro_rad_s[g],
            accel_t_s=imu.accel_t_s[a],
            accel_m_s2=imu.accel_m_s2[a],
        )

    return alter


def clipped(values: np.ndarray) -> np.ndarray:
    middle = np.median(values, axis=0)
    limit = np.percentile(np.abs(values - middle), 99)
    return np.clip(values, middle - limit, middle + limit)


def in_8_bit(values: np.ndarray) -> np.ndarray:
    step = np.ptp(values) / 255
    return np.round(values / step) * step


def later(delay_s: float) -> Callable[[ImuRecording], ImuRecording]:
    return lambda imu: replace(imu, accel_t_s=imu.accel_t_s + delay_s)


IMU_ALTERATIONS: list[tuple[str, str, str, Callable[[ImuRecording], ImuRecording]]] = [
    ("gyro in deg/s", "gyro-in-deg", "error", gyro(np.degrees)),
    ("accelerometer in g", "accel-in-g", "error", accel(lambda a: a / 9.80665)),
    ("gravity removed", "gravity-removed", "error", weightless),
    ("gyro turned", "axes-turned", "error", gyro(lambda w: w @ so3_exp(np.array([0, 0, np.pi / 2])).T)),
    ("gyro mirrored", "axes-mirrored", "error", gyro(lambda w: w * [-1, 1, 1])),
    ("accelerometer mirrored", "axes-turned", "error", accel(lambda a: a * [-1, 1, 1])),
    ("dead gyro axis", "dead-axis", "error", gyro(lambda w: w * [1, 0, 1])),
    ("dead accelerometer axis", "dead-axis", "error", accel(lambda a: a * [0, 1, 1])),
    ("dead gyro", "dead-sensor", "error", gyro(lambda w: w * 0)),
    ("exchanged", "sensors-exchanged", "error", exchanged),
    ("gap of 50 ms", "short-gap", "warning", paused(0.05)),
    ("gap of 1 s", "long-gap", "warning", paused(1.0)),
    ("gyro saturated", "saturated", "error", gyro(clipped)),
    ("accelerometer saturated", "saturated", "error", accel(clipped)),
    ("gyro in 8 bit", "coarse-resolution", "warning", gyro(in_8_bit)),
    ("accelerometer in 8 bit", "coarse-resolution", "warning", accel(in_8_bit)),
    ("accelerometer 250 ms late", "sensors-offset", "warning", later(0.25)),
    ("accelerometer 250 ms early", "sensors-offset", "warning", later(-0.25)),
    ("sensors 1000 s apart", "sensors-apart", "error", later(1000.0)),
]


@pytest.fixture(scope="module")
def clean(shared_data: Path) -> dict[str, Recording]:
    return {name: read_inertial_scale(shared_data / "inertial_scale" / name) for name in HANDHELD}


@pytest.fixture(scope="module")
def simulated() -> SimulatedRecording:
    return simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=30)), seed=5)


def test_nothing_is_found_in_clean_recordings(
    clean: dict[str, Recording], simulated: SimulatedRecording, shared_data: Path
) -> None:
    whole = ("D1", "D9", "D13")
    for name, (trajectory, imu) in clean.items():
        assert diagnose(Recorded(imu=imu, trajectory=trajectory if name in whole else None)).findings == (), name
    for trajectory, imu in [*(first(clean[name], SECONDS) for name in ALTERED), (simulated.trajectory, simulated.imu)]:
        assert diagnose(Recorded(imu=imu, trajectory=trajectory)).findings == ()
    assert diagnose(Recorded(imu=read_imu(shared_data / "euroc_v101"))).findings == ()


def test_what_is_wrong_with_an_imu_is_found(
    subtests: pytest.Subtests, clean: dict[str, Recording], simulated: SimulatedRecording
) -> None:
    recordings = {**{name: clean[name][1] for name in HANDHELD[::2]}, "simulated": simulated.imu}
    for wrong, code, severity, alter in IMU_ALTERATIONS:
        with subtests.test(wrong):
            missed = {name: found(diagnose(Recorded(imu=alter(imu))), code) for name, imu in recordings.items()}
            assert set(missed.values()) == {severity}, missed


# --- the camera against the inertial samples -------------------------------------------------------------------------


def faster(factor: float) -> Callable[[Recording], Recording]:
    def alter(recording: Recording) -> Recording:
        trajectory, imu = recording
        begin_s = imu.gyro_t_s[0]
        g, a = (begin_s + factor * (t_s - begin_s) for t_s in (imu.gyro_t_s, imu.accel_t_s))
        return trajectory, replace(imu, gyro_t_s=g, accel_t_s=a)

    return alter


def both_mirrored(recording: Recording) -> Recording:
    trajectory, imu = recording
    mirror = np.array([1, -1, 1])
    # the rates of a mirrored device turn the other way: gyroscope and accelerometer still belong together
    return trajectory, replace(imu, gyro_rad_s=-imu.gyro_rad_s * mirror, accel_m_s2=imu.accel_m_s2 * mirror)


def columns_exchanged(recording: Recording) -> Recording:
    trajectory, imu = recording
    return trajectory, replace(imu, gyro_rad_s=imu.gyro_rad_s[:, [1, 0, 2]], accel_m_s2=imu.accel_m_s2[:, [1, 0, 2]])


def flipped(recording: Recording) -> Recording:
    trajectory, imu = recording
    return trajectory, replace(imu, accel_m_s2=-imu.accel_m_s2)


def short_imu(recording: Recording) -> Recording:
    trajectory, imu = recording
    g, a = (t_s < t_s[0] + 20 for t_s in (imu.gyro_t_s, imu.accel_t_s))
    return trajectory, replace(
        imu,
        gyro_t_s=imu.gyro_t_s[g],
        gyro_rad_s=imu.gyro_rad_s[g],
        accel_t_s=imu.accel_t_s[a],
        accel_m_s2=imu.accel_m_s2[a],
    )


def dropped(recording: Recording) -> Recording:
    trajectory, imu = recording
    return trajectory.select(np.arange(len(trajectory)) % 40 > 1), imu


def repeated(recording: Recording) -> Recording:
    """Every fifth frame shows the picture before it."""
    trajectory, imu = recording
    shown = np.arange(len(trajectory)) - (np.arange(len(trajectory)) % 5 == 4)
    return replace(
        trajectory,
        cam_in_world=trajectory.cam_in_world[shown],
        cam_from_world_xyzw=trajectory.cam_from_world_xyzw[shown],
    ), imu


def counted(recording: Recording) -> Recording:
    """Frames of a recorder that slowed down for a while, timed by their mean rate."""
    trajectory, imu = recording
    slow = (np.arange(len(trajectory)) // 150) % 2 == 0
    kept = trajectory.select(~(slow & (np.arange(len(trajectory)) % 24 == 0)))
    return replace(kept, t_s=np.linspace(kept.t_s[0], kept.t_s[-1], len(kept))), imu


CAMERA_ALTERATIONS: list[tuple[str, str, str, Callable[[Recording], Recording]]] = [
    ("rate 2 % high", "clock-rate", "error", faster(1.02)),
    ("rate 2 % low", "clock-rate", "error", faster(0.98)),
    ("IMU mirrored", "accel-flipped", "error", both_mirrored),
    ("columns exchanged", "gyro-mirrored", "error", columns_exchanged),
    ("accelerometer flipped", "accel-flipped", "error", flipped),
    ("IMU shorter than the video", "imu-too-short", "warning", short_imu),
    ("dropped frames", "frames-dropped", "warning", dropped),
    ("repeated frames", "frames-repeated", "error", repeated),
    ("frame times by counting", "frame-times-uneven", "error", counted),
]


@pytest.mark.parametrize(
    ("code", "severity", "alter"), [pytest.param(*row[1:], id=row[0]) for row in CAMERA_ALTERATIONS]
)
def test_what_is_wrong_between_camera_and_imu_is_found(
    clean: dict[str, Recording],
    simulated: SimulatedRecording,
    code: str,
    severity: str,
    alter: Callable[[Recording], Recording],
) -> None:
    recordings = {name: first(clean[name], SECONDS) for name in ALTERED}
    recordings["simulated"] = (simulated.trajectory, simulated.imu)
    severities = {}
    for name, recording in recordings.items():
        trajectory, imu = alter(recording)
        severities[name] = found(diagnose(Recorded(imu=imu, trajectory=trajectory)), code)
    assert set(severities.values()) == {severity}, severities


def test_the_imu_of_another_recording_is_found(clean: dict[str, Recording]) -> None:
    for name, other in (("D11", "D5"), ("D3", "D9")):
        trajectory, _ = first(clean[name], SECONDS)
        assert found(diagnose(Recorded(imu=clean[other][1], trajectory=trajectory)), "imu-does-not-fit") == "error"


@pytest.mark.parametrize(
    ("kind", "code", "alone"),
    [
        ("static", "no-motion", "no-motion"),
        ("pure_rotation", "pure-rotation", "no-acceleration"),
        ("constant_velocity", "constant-velocity", "no-acceleration"),
    ],
)
def test_motion_without_acceleration_is_found(kind: MotionKind, code: str, alone: str) -> None:
    for seed in range(3):
        motion = MotionOptions(kind=kind, duration_s=12)
        recording = simulate_recording(RecordingOptions(motion=motion), seed=seed)
        with_poses = diagnose(Recorded(imu=recording.imu, trajectory=recording.trajectory))
        assert found(with_poses, code) == "error", with_poses
        assert found(diagnose(Recorded(imu=recording.imu)), alone) == "error"


# --- files that readers refuse or repair -----------------------------------------------------------------------------


def rows(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    """Rows of a sensor's table in another order or number."""
    return lambda table: table[change(np.arange(len(table)))]


def in_milliseconds(table: np.ndarray) -> np.ndarray:
    # 1 ns in the file stands for what was 1000 times as long, as where ms are read as s
    return np.column_stack([table[0, 0] + 1000 * (table[:, 0] - table[0, 0]), table[:, 1:]])


STAMP_ALTERATIONS: list[tuple[str, str, str, Callable[[np.ndarray], np.ndarray]]] = [
    ("duplicated", "stamps-repeated", "warning", rows(lambda i: np.repeat(i, np.where(i % 50 == 7, 2, 1)))),
    ("reordered", "stamps-reordered", "warning", rows(lambda i: np.where(i % 40 == 8, i - 1, i + (i % 40 == 7)))),
    ("reversed", "stamps-reversed", "error", rows(lambda i: i[::-1])),
    ("set back", "stamps-jump-back", "error", rows(lambda i: np.roll(i, 300))),
    ("ms read as s", "time-unit", "error", in_milliseconds),
]


def run(*args: str | Path) -> int:
    with pytest.raises(SystemExit) as stopped:
        main([str(arg) for arg in args])
    return int(stopped.value.code or 0)


def written(folder: Path, source: Path, alter: Callable[[np.ndarray], np.ndarray] = lambda table: table) -> Path:
    """An InertialScale folder with 20 s of poses, with altered rows of its sensors."""
    folder.mkdir()
    poses = np.loadtxt(source / "poses.txt")
    np.savetxt(folder / "poses.txt", poses[: 20 * 30], fmt=["%d"] + ["%.9g"] * 7)
    for name in ("gyroscope.txt", "accelerometer.txt"):
        table = alter(np.loadtxt(source / name))
        np.savetxt(folder / name, table, fmt=["%d", "%.9g", "%.9g", "%.9g"])
    return folder


@pytest.mark.parametrize(
    ("code", "severity", "alter"), [pytest.param(*row[1:], id=row[0]) for row in STAMP_ALTERATIONS]
)
def test_what_is_wrong_with_stamps_is_found_through_the_command(
    shared_data: Path, tmp_path: Path, code: str, severity: str, alter: Callable[[np.ndarray], np.ndarray]
) -> None:
    source = shared_data / "inertial_scale/D11"
    assert run("diagnose", written(tmp_path / "altered", source, alter), "--json", tmp_path / "found.json") == (
        severity == "error"
    )
    told = json.loads((tmp_path / "found.json").read_text())
    assert {f["code"]: f["severity"] for f in told["findings"]}[code] == severity
    assert "poses" in told["checked"]  # what can still be read is read
    assert all(f["evidence"] and f["advice"] for f in told["findings"])


def test_nothing_is_found_in_the_same_files_unaltered(shared_data: Path, tmp_path: Path) -> None:
    folder = written(tmp_path / "clean", shared_data / "inertial_scale/D11")
    assert run("diagnose", folder, "--json", tmp_path / "clean.json") == 0
    assert json.loads((tmp_path / "clean.json").read_text())["findings"] == []


def test_an_imu_file_alone_is_diagnosed_and_what_is_none_is_bad_input(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = shared_data / "euroc_v101/mav0/imu0/data.csv"
    assert run("diagnose", table) == 0
    assert "(checked: gyroscope, accelerometer): nothing found" in " ".join(capsys.readouterr().out.split())
    poem = tmp_path / "poem.txt"
    poem.write_text("Shall I compare thee to a summer's day?\n")
    assert run("diagnose", poem) == 2
    assert run("diagnose", tmp_path / "nowhere") == 2


# --- pictures --------------------------------------------------------------------------------------------------------

LENS = CameraModel(model="PINHOLE", width=240, height=180, params=(187.5, 187.5, 120, 90))
RATE_HZ = 10.0


@dataclass(frozen=True, eq=False)
class Film:
    """Pictures of a turning camera, and its IMU on another clock."""

    frames: list[Frame]
    timing: FrameTiming
    imu: ImuRecording

    def recorded(self, camera: CameraModel = LENS) -> Recorded:
        rotation = measure_rotation(reduce_frames(self.frames), colmap_camera(camera), self.timing)
        return Recorded(rotation=rotation, imu=self.imu, timing=self.timing, camera=camera, is_capture=True)


def imu_of(scene: FarScene, *, seconds: float) -> ImuRecording:
    """With an accelerometer that swings enough to tell metres."""
    path = scene.gyro(end_s=seconds).path
    rng = np.random.default_rng(1)
    rate = path.rate_rad_s + 0.002 * rng.standard_normal(path.rate_rad_s.shape)
    upright = quat_rotate(quat_conjugate(path.start_from_imu_xyzw), np.array([0.0, 0.0, 9.81]))
    upright = upright + 0.02 * rng.standard_normal(upright.shape)
    swing = 1.5 * np.sin(2 * np.pi * 0.9 * path.t_s)[:, None] * [1.0, 0.3, 0.0]
    return ImuRecording(gyro_t_s=path.t_s, gyro_rad_s=rate, accel_t_s=path.t_s, accel_m_s2=upright + swing)


@pytest.fixture(scope="module")
def film() -> Film:
    scene = FarScene.make(duration_s=12.0)
    t_s = np.arange(0.3, 11.3, 1 / RATE_HZ)
    timing = FrameTiming(
        names=tuple(f"{i:03}.png" for i in range(len(t_s))),
        t_s=t_s,
        exposure_s=np.full(len(t_s), 0.002),
        readout_s=0.0,
    )
    frames = [
        Frame(
            name=name,
            image=scene.picture(LENS, FrameShutter.of(timing, i, width=LENS.width, height=LENS.height)),
            t_s=t_s[i],
        )
        for i, name in enumerate(timing.names)
    ]
    return Film(frames=frames, timing=timing, imu=imu_of(scene, seconds=12.0))


@pytest.fixture(scope="module")
def filmed(film: Film) -> Recorded:
    return film.recorded()


def test_what_is_wrong_with_pictures_is_found(film: Film, filmed: Recorded) -> None:
    clean = filmed
    assert diagnose(clean).findings == ()
    assert clean.rotation is not None
    wider = replace(LENS, params=(225.0, 225.0, 120.0, 90.0))
    assert found(diagnose(film.recorded(wider)), "focal-length") == "error"

    kernel = np.ones(15) / 15
    steady = np.stack([np.convolve(column, kernel, mode="same") for column in clean.rotation.turn_rad.T], axis=1)
    assert found(diagnose(replace(clean, rotation=replace(clean.rotation, turn_rad=steady))), "stabilised") == "error"
    said = FrameLog(t_s=np.zeros(0), stabilised=True, stabilisation="EIS on")
    assert found(diagnose(replace(clean, log=said)), "stabilised") == "error"

    long = replace(film.timing, exposure_s=np.full(len(film.timing.t_s), 0.04))
    assert found(diagnose(replace(clean, timing=long)), "exposure-too-long") == "warning"
    undeclared = replace(film.timing, readout_s=None)
    told = diagnose(replace(clean, timing=undeclared))
    assert found(told, "readout-unknown") == "warning"
    measured = next(finding for finding in told.findings if finding.code == "readout-unknown")
    assert "readout_s = 0.0000 under" in measured.advice and measured.numbers["readout_sigma_s"] < 0.002

    rolling = diagnose(replace(clean, timing=replace(film.timing, readout_s=0.02)))
    assert found(rolling, "declared-readout") == "warning"
    measured = next(finding for finding in rolling.findings if finding.code == "declared-readout")
    assert measured.numbers["readout_s"] == 0 and "0.0 ms" in measured.evidence

    other = imu_of(FarScene.make(seed=8, duration_s=12.0, texture=np.zeros((2, 2, 3), np.float32)), seconds=12.0)
    assert found(diagnose(replace(clean, imu=other)), "imu-does-not-fit") == "error"
    faster = replace(film.imu, gyro_t_s=1.02 * film.imu.gyro_t_s, accel_t_s=1.02 * film.imu.accel_t_s)
    assert found(diagnose(replace(clean, imu=faster)), "clock-rate") == "error"
    twice = [replace(f, image=film.frames[i - (i % 3 == 2)].image) for i, f in enumerate(film.frames[:30])]
    assert found(diagnose(replace(film, frames=twice).recorded()), "frames-repeated") == "error"
    # one picture for a while, coded anew each time
    noise = np.random.default_rng(3)
    frozen = list(film.frames)
    for i in range(40, 60):
        anew = film.frames[40].image.astype(float) + noise.normal(0, 1.0, film.frames[40].image.shape)
        frozen[i] = replace(frozen[i], image=np.clip(np.rint(anew), 0, 255).astype(np.uint8))
    told = diagnose(replace(film, frames=frozen).recorded())
    assert found(told, "frames-repeated") in ("warning", "error")
    (repeated,) = (finding for finding in told.findings if finding.code == "frames-repeated")
    assert repeated.numbers["repeated"] == pytest.approx(19, abs=3)
    for blank, severity in ((2, "warning"), (200, "error")):
        few = replace(clean, looked_at=300, blank=tuple(f"{i:03}.png" for i in range(blank)))
        assert found(diagnose(few), "frames-blank") == severity


def test_a_camera_that_rests_after_sliding_past_close_things_repeats_no_frame() -> None:
    rng = np.random.default_rng(5)
    gyro_s, moving_s = np.arange(0.0, 24.0, 0.005), 16.0
    # a hand's turning, then none
    white = rng.standard_normal((len(gyro_s), 3))
    rate = np.stack([np.convolve(column, np.hanning(120), mode="same") for column in white.T], axis=1)
    rate *= 0.4 / rate.std() * np.clip((moving_s - gyro_s[:, None]) / 0.3, 0, 1)
    path = GyroPath(gyro_s, rate, np.zeros(3))
    t_s = np.concatenate([np.arange(0.5, moving_s, 0.05), np.arange(moving_s, 23.5, 0.2)])
    turn = path.turn_rad(t_s[:-1], t_s[1:])
    # to pixels, sliding past close things looks like turning
    turn[t_s[1:] < moving_s] += 0.05 * np.array([-0.02, 0.03, 0.01])
    turn += 3e-5 * rng.standard_normal(turn.shape)
    rotation = VisualRotation(
        names=tuple(f"{i}.png" for i in range(len(t_s))),
        t_s=t_s,
        turn_rad=turn,
        sigma_rad=np.full(len(turn), 1e-4),
        support=np.full(len(turn), 200, dtype=np.intp),
    )
    imu = ImuRecording(
        gyro_t_s=gyro_s,
        gyro_rad_s=rate + [0.005, 0.03, 0.08] + 0.001 * rng.standard_normal(rate.shape),
        accel_t_s=gyro_s,
        accel_m_s2=np.tile([0.0, 0.0, 9.81], (len(gyro_s), 1)),
    )
    recorded = Recorded(rotation=rotation, imu=imu)
    aligned = recorded.aligned
    assert isinstance(aligned, Alignment)
    bias = aligned.calibration.gyro_bias_rad_s - [0.005, 0.03, 0.08]
    assert np.linalg.norm(bias) > 0.01
    assert not list(check_repeated(recorded))


def test_a_calibration_that_turns_the_camera_is_found(filmed: Recorded) -> None:
    right = calibration_prior(Declared(cam_from_imu_xyzw=CAM_FROM_IMU))
    assert diagnose(replace(filmed, calibration=right)).findings == ()
    quarter = quat_multiply(quat_exp(np.array([0, 0, np.pi / 2])), CAM_FROM_IMU)
    wrong = calibration_prior(Declared(cam_from_imu_xyzw=quarter))
    assert found(diagnose(replace(filmed, calibration=wrong)), "declared-rotation") == "error"


@pytest.fixture(scope="module")
def cut_video(film: Film, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A video, its pictures as files, and their times: a recorder slows down for a while, the container starts late."""
    folder = tmp_path_factory.mktemp("cut")
    pictures = [frame.image for frame in film.frames[:60:2]]
    stamps_ms = 100 + np.cumsum(np.where(np.arange(len(pictures)) // 8 % 2 == 0, 33, 50))
    with av.open(str(folder / "clip.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "15", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = LENS.width, LENS.height, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for image, stamp in zip(pictures, stamps_ms.tolist(), strict=True):
            picture = av.VideoFrame.from_ndarray(image, format="rgb24")
            picture.pts, picture.time_base = stamp, Fraction(1, 1000)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    (folder / "frames").mkdir()
    for i, image in enumerate(pictures):
        cv2.imwrite(str(folder / "frames" / f"{i:03}.png"), image[..., ::-1])
    return folder, stamps_ms / 1000


@pytest.mark.parametrize(
    ("fault", "code"),
    [("", ""), ("counted", "frame-times-counted"), ("no start", "container-start-ignored")],
)
def test_pictures_cut_wrongly_from_a_video_are_found(
    cut_video: tuple[Path, np.ndarray], tmp_path: Path, fault: str, code: str
) -> None:
    folder, t_s = cut_video
    if fault == "counted":
        t_s = np.linspace(t_s[0], t_s[-1], len(t_s))
    if fault == "no start":
        t_s = t_s - t_s[0]
    lines = ["name,t_s", *(f"{i:03}.png,{t:.6f}" for i, t in enumerate(t_s))]
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    (folder / "capture.toml").write_text(
        '[images]\nfolder = "frames"\ntimes = "frames.csv"\nvideo = "clip.mp4"\n[timing]\nreadout_s = 0.0\n'
    )
    code_ = run("diagnose", folder / "capture.toml", "--json", tmp_path / "found.json")
    codes = {f["code"] for f in json.loads((tmp_path / "found.json").read_text())["findings"]}
    wrong = {"frame-times-counted", "container-start-ignored"}
    assert codes & wrong == ({code} if code else set())
    assert code_ == (1 if code else 0)


def test_pictures_that_were_turned_upright_belie_what_refers_to_the_sensor_s_rows(film: Film) -> None:
    stamps_ns = np.arange(10, dtype=np.int64) * 33_000_000
    upright = FramesInVideo(
        stated_ns=stamps_ns, found_ns=stamps_ns, video_start_ns=0, quarter_turns=1, container_turn_deg=90, doubtful=0
    )
    assert found(diagnose(Recorded(in_video=upright)), "frames-turned") == "info"
    assert found(diagnose(Recorded(in_video=upright, camera=LENS)), "frames-turned") == "error"
    stored = replace(upright, quarter_turns=0)
    assert found(diagnose(Recorded(in_video=stored)), "rotation-ignored") == "info"
    assert diagnose(Recorded(in_video=replace(stored, container_turn_deg=0))).findings == ()


# --- before a reconstruction -----------------------------------------------------------------------------------------


def test_a_stabilised_gopro_stops_a_reconstruction_with_the_reason_and_one_that_is_not_goes_on(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("reconstruct", shared_data / "gopro/max-heromode.mp4", tmp_path / "out") == 3
    assert "stabilised in the camera (EISE=Y" in " ".join(capsys.readouterr().err.split())
    for name, codes in (("max-heromode", {"stabilised"}), ("karma", set())):
        capture = load_capture(shared_data / f"gopro/{name}.mp4")
        told = diagnose(Recorded(imu=read_capture_imu(capture), log=capture.frame_log, is_capture=True))
        assert told.codes == codes
        if codes:
            with pytest.raises(NotObservableError, match="stabilised"):
                stop_or_doubt(told, force=False)
        doubts = stop_or_doubt(told, force=True)
        assert [doubt.values["finding"].code for doubt in doubts] == ["stabilised"] * bool(codes)


def test_gravity_that_was_removed_stops_a_reconstruction_unless_forced(clean: dict[str, Recording]) -> None:
    told = diagnose(Recorded(imu=weightless(clean["D3"][1])))
    with pytest.raises(NotObservableError, match="gravity was taken out"):
        stop_or_doubt(told, force=False)
    assert stop_or_doubt(told, force=True)


def test_a_forced_scale_is_at_most_weak(project: Project, tmp_path: Path) -> None:
    timing, model = read_frame_times(project.frame_times), read_model(project.model)
    verdicts = {}
    for doubts in ((), (Fact("stabilised", share=0.2),)):
        stage = MetricStage(imu=project.recording.imu, calibration=None)
        scale = stage(Model(reconstruction=model, colmap_index=0, timing=timing, doubts=doubts)).scale
        assert scale is not None and scale.reasons[: len(doubts)] == doubts
        verdicts[doubts] = scale.verdict
    assert list(verdicts.values()) == ["trusted", "weak"]
