"""Sound recordings are not stopped, and what their checks find has an honest size (scripts/benchmarks/checks.py)."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.diagnose import Diagnosis, Finding, Recorded, diagnose
from colmap_inertial.diagnose.camera import correlate_accelerations
from colmap_inertial.diagnose.clocks import check_even_times, wandering
from colmap_inertial.diagnose.imu import check_motion_content, check_pauses, find_accel_delay
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.motion.align.conventions import QuickAccelerations
from colmap_inertial.tools.simulate import (
    IMU_PRESETS,
    MotionOptions,
    RecordingOptions,
    SfmOptions,
    SimulatedRecording,
    simulate_recording,
)
from scripts.benchmarks import checks as bench
from scripts.studies import diagnose as study

#: Of the bench: the short orbit, one of each kind of motion, and rests of each length and place.
SEEDED = ("short orbit #0", "#18/20", "#19/20", "#20/20", "beginning #1/", "middle #4/", "end #8/")


@pytest.fixture(scope="module")
def recording() -> SimulatedRecording:
    return simulate_recording(RecordingOptions(motion=MotionOptions(kind="roam", duration_s=20.0)), seed=7)


def cases() -> list[bench.Case]:
    every = [*bench.simulated(), *bench.resting()]
    return [next(case for case in every if part in case.key) for part in SEEDED]


@pytest.mark.parametrize("case", [pytest.param(case, id=part) for case, part in zip(cases(), SEEDED, strict=True)])
def test_a_sound_recording_is_not_stopped_and_its_interval_holds_the_truth(case: bench.Case) -> None:
    row = bench.judge(case)
    assert row["outcome"] in ("trusted", "weak") and row["errors"] == ""
    assert row["inside"] == 1
    # what makes it weak is the width of its interval, and no check
    assert row["outcome"] == "trusted" or float(row["width_pct"]) > 3.0


# --- the accelerometer's delay ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay_s", [0.02, -0.1, 0.3])
def test_a_delay_of_the_accelerometer_does_not_change_the_scale(recording: SimulatedRecording, delay_s: float) -> None:
    imu = recording.imu
    sound = estimate_scale(recording.trajectory, imu)
    late = estimate_scale(recording.trajectory, replace(imu, accel_t_s=imu.accel_t_s + delay_s))
    assert late.verdict == sound.verdict == "trusted"
    # its own noise apart: the readings are interpolated elsewhere
    assert late.metres_per_unit == pytest.approx(sound.metres_per_unit, rel=1e-3)
    assert late.calibration.accel_delay_s == pytest.approx(sound.calibration.accel_delay_s - delay_s, abs=2e-3)
    said = [note for note in late.notes if note.code == "accel-delay-undone"]
    assert len(said) == (abs(delay_s) > 0.06)


def test_what_gravity_tells_of_the_delay_is_within_its_standard_deviation(subtests: pytest.Subtests) -> None:
    for seed in range(12):
        with subtests.test(seed=seed):
            kind, device = ("orbit", "walk", "roam")[seed % 3], list(IMU_PRESETS)[seed % 2]
            made = simulate_recording(
                RecordingOptions(
                    motion=MotionOptions(kind=kind, duration_s=(15.0, 30.0, 60.0)[seed % 3]), imu=IMU_PRESETS[device]
                ),
                seed=seed,
            )
            truth_s = -made.truth.calibration.accel_delay_s
            for late_s in (0.0, 0.3):
                found = find_accel_delay(replace(made.imu, accel_t_s=made.imu.accel_t_s + late_s))
                if found is not None:
                    assert abs(found.delay_s - truth_s - late_s) < 4 * found.sigma_s
                    assert not (found.counts and late_s == 0.0)


# --- frame times -----------------------------------------------------------------------------------------------------


def test_one_part_that_is_off_is_no_clock_that_wanders() -> None:
    sure = np.full(6, 8.0)
    alone = np.array([0.0, 0.002, 0.08, -0.004, 0.001, 0.0])
    assert not wandering(alone, sure).any()
    two = np.array([0.0, 0.02, 0.08, -0.004, 0.001, 0.0])
    assert wandering(two, sure).tolist() == [False, False, True, False, False, False]
    # by chance
    assert not wandering(two, np.full(6, 4.0)).any()
    # of no size that matters
    assert not wandering(0.3 * two, 100 * sure).any()


def test_frames_timed_by_counting_are_found_and_evenly_timed_ones_are_not() -> None:
    for seed, kind in enumerate(("orbit", "walk", "roam")):
        base = study.simulated(seed, kind)
        assert not list(check_even_times(base.recorded()))
        (found,) = check_even_times(study.uneven(base, np.random.default_rng(0)))
        assert found.numbers["sigmas"] > 5 and found.numbers["wander_s"] == pytest.approx(0.13, abs=0.05)


# --- motion, pauses, signs -------------------------------------------------------------------------------------------


def test_a_rest_of_most_of_the_time_is_no_lack_of_motion_and_a_tripod_is() -> None:
    case = next(case for case in bench.resting() if "70 % at the end" in case.name)
    trajectory, imu, _ = case.make()
    assert not list(check_motion_content(Recorded(imu=imu, trajectory=trajectory)))
    options = RecordingOptions(motion=MotionOptions(kind="static", duration_s=20.0))
    assert [one.code for one in check_motion_content(Recorded(imu=simulate_recording(options, seed=1).imu))] == [
        "no-motion"
    ]


def test_pauses_count_while_frames_come_only(recording: SimulatedRecording) -> None:
    imu, trajectory = recording.imu, recording.trajectory
    short = trajectory.select((trajectory.t_s > 8.0) & (trajectory.t_s < 18.0))
    begin_s = imu.gyro_t_s[0]
    kept = (imu.gyro_t_s < begin_s + 1.0) | (imu.gyro_t_s > begin_s + 5.0)
    paused = replace(imu, gyro_t_s=imu.gyro_t_s[kept], gyro_rad_s=imu.gyro_rad_s[kept])
    assert not list(check_pauses(Recorded(imu=paused, trajectory=short)))
    (found,) = check_pauses(Recorded(imu=paused, trajectory=trajectory))
    assert found.code == "long-gap" and found.numbers["longest_s"] == pytest.approx(4.0, abs=0.02)


def test_errors_that_the_interval_counts_stop_nothing() -> None:
    cut = Fact("saturated", sensor="gyroscope", samples=80, of=4000, axes="x", counts=(80,), share=0.02)
    of = {fact.code: Finding(fact=fact, severity="error") for fact in (cut, Fact("no-accelerometer"))}
    told = Diagnosis(findings=tuple(of.values()))
    assert told.stopping == (of["no-accelerometer"],) and told.doubting == (of["saturated"],)
    pause = Fact("long-gap", sensor="gyroscope", pauses=1, longest_s=1.5, total_s=1.5, step_s=0.01, share=0.05)
    warned = Finding(fact=pause, severity="warning")
    assert Diagnosis(findings=(warned,)).doubting == ()


def test_chance_correlations_of_accelerations_have_their_standard_deviation() -> None:
    rng = np.random.default_rng(4)
    count, seconds = 40, 20.0
    drawn = []
    for _ in range(400):
        inertial, visual = rng.standard_normal((2, count, 3))
        quick = QuickAccelerations(
            inertial_m_s2=inertial,
            visual=visual,
            arm_per_s2=np.zeros((count, 3, 3)),
            steadiness=1.0,
            seconds=seconds,
        )
        correlation, sigma = correlate_accelerations(quick)
        drawn.append(correlation / sigma)
    # 400 draws know a standard deviation to 3.5 %
    assert np.std(drawn) == pytest.approx(1.0, abs=0.15)


# --- the estimate ----------------------------------------------------------------------------------------------------


def test_an_end_at_which_poses_jump_is_cut_off_and_said() -> None:
    made = simulate_recording(
        RecordingOptions(motion=MotionOptions(kind="walk", duration_s=24.0), sfm=SfmOptions(frame_rate_hz=30.0)), seed=4
    )
    truth = made.truth.metres_per_unit
    jumping = bench.jumping(made.trajectory, truth, 0.5, last_s=0.6)
    assert not diagnose(Recorded(imu=made.imu, trajectory=jumping)).stopping
    estimate = estimate_scale(jumping, made.imu)
    sound = estimate_scale(made.trajectory, made.imu)
    assert estimate.verdict == "trusted" and sound.rotations.moved == ()
    assert estimate.metres_per_unit == pytest.approx(sound.metres_per_unit, rel=2e-3)
    last = set(made.trajectory.names[-18:])
    assert estimate.rotations.moved and set(estimate.rotations.moved) <= last
    assert any("left out" in str(note) for note in estimate.notes)


@pytest.mark.parametrize("size", [0.03, 0.08])
@pytest.mark.parametrize("fault", ["torn", "stretch"])
def test_what_is_undone_of_a_model_s_shape_moves_the_scale_within_the_interval(
    monkeypatch: pytest.MonkeyPatch, fault: str, size: float
) -> None:
    from colmap_inertial.inertial.scale import joint

    made = simulate_recording(RecordingOptions(motion=MotionOptions(kind="orbit", duration_s=40.0)), seed=11)
    poses, imu = bench.of_model(fault)(made.trajectory, made.imu, made.truth.metres_per_unit, size)
    mended = estimate_scale(poses, imu)
    monkeypatch.setattr(joint, "SHAPE_LIMITS", replace(joint.SHAPE_LIMITS, most=0))
    left = estimate_scale(poses, imu)
    assert abs(np.log(mended.metres_per_unit / left.metres_per_unit)) <= Z95 * mended.sigma_log
    assert abs(np.log(mended.metres_per_unit / made.truth.metres_per_unit)) <= Z95 * mended.sigma_log
