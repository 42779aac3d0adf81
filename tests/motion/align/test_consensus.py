"""Cameras that contradict the gyroscope are named and left out; what remains is right, or is refused."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_conjugate, quat_exp, quat_log, quat_multiply
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import RotationConsensus
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.io.files import read_record, write_record
from colmap_inertial.motion.align import align_clocks
from colmap_inertial.motion.align.consensus import align_by_consensus, describe_consensus
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording
from scripts.studies import consensus as study


@pytest.fixture(scope="module")
def walk():
    """Half a minute at 15 frames a second; the truth is the simulator's."""
    return simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=30.0)), seed=3)


def keyframes(recording, *, step, count=30):
    return recording.trajectory.select(slice(0, step * count, step))


def turned(trajectory, which, deg, axis=(0.3, -0.8, 0.5)):
    """Cameras turned about an axis of their own."""
    pose = trajectory.cam_from_world_xyzw.copy()
    axis = np.array(axis) / np.linalg.norm(axis)
    pose[which] = quat_multiply(quat_exp(np.radians(deg) * axis), pose[which])
    return replace(trajectory, cam_from_world_xyzw=pose)


def torn(trajectory, which, deg, axis=(0.3, -0.8, 0.5)):
    """A block of cameras turned as one in the world."""
    pose = trajectory.cam_from_world_xyzw.copy()
    axis = np.array(axis) / np.linalg.norm(axis)
    pose[which] = quat_multiply(pose[which], quat_exp(np.radians(deg) * axis))
    return replace(trajectory, cam_from_world_xyzw=pose)


def error_deg(alignment, truth):
    between = quat_multiply(alignment.calibration.cam_from_imu_xyzw, quat_conjugate(truth.cam_from_imu_xyzw))
    return np.degrees(np.linalg.norm(quat_log(between)))


def test_sound_cameras_are_all_kept_and_aligned_as_ever(walk):
    aligned, consensus = align_by_consensus(walk.trajectory, walk.imu)
    assert consensus.kept.all()
    assert consensus.judged.all()
    assert not consensus.wrong and not consensus.seams and not describe_consensus(consensus)
    assert consensus.deviation_deg.max() < 1
    plain = align_clocks(walk.trajectory, walk.imu)
    assert np.array_equal(aligned.calibration.cov, plain.calibration.cov)


def test_wrong_keyframes_are_named_with_their_degrees(subtests, walk):
    for deg in (12, 54, 175):
        for wrong in ([0], [17], [29], [4, 5, 21]):
            with subtests.test(deg=deg, wrong=wrong):
                trajectory = turned(
                    keyframes(walk, step=round(0.5 / np.median(np.diff(walk.trajectory.t_s)))), wrong, deg
                )
                aligned, consensus = align_by_consensus(trajectory, walk.imu)
                assert [one.name for one in consensus.wrong] == [trajectory.names[i] for i in wrong]
                assert [one.deviation_deg for one in consensus.wrong] == pytest.approx([deg] * len(wrong), abs=1.5)
                assert not consensus.seams
                assert error_deg(aligned, walk.truth.calibration) < 1.0


def test_a_seam_is_placed_and_the_largest_part_is_kept(subtests, walk):
    for first, last in ((0, 9), (10, 19), (20, 30)):
        with subtests.test(first=first, last=last):
            trajectory = keyframes(walk, step=round(0.5 / np.median(np.diff(walk.trajectory.t_s))))
            aligned, consensus = align_by_consensus(torn(trajectory, slice(first, last), 25), walk.imu)
            assert not consensus.wrong
            assert [seam.name for seam in consensus.seams] == [trajectory.names[i] for i in (first, last) if 0 < i < 30]
            assert [seam.turn_deg for seam in consensus.seams] == pytest.approx([25] * len(consensus.seams), abs=1.5)
            assert np.flatnonzero(~consensus.kept).tolist() == list(range(first, last))
            assert error_deg(aligned, walk.truth.calibration) < 1.0


def test_one_frame_of_a_video_goes_and_the_scale_holds(walk):
    clean = estimate_scale(walk.trajectory, walk.imu)
    trajectory = turned(walk.trajectory, [100], 30)
    centre = trajectory.cam_in_world.copy()
    centre[100] += 2.0
    estimate = estimate_scale(replace(trajectory, cam_in_world=centre), walk.imu)
    assert [one.name for one in estimate.rotations.wrong] == [trajectory.names[100]]
    assert any(trajectory.names[100] in str(note) and "contradict" in str(note) for note in estimate.notes)
    assert estimate.metres_per_unit == pytest.approx(clean.metres_per_unit, rel=1e-3)
    assert estimate.ci95[0] < walk.truth.metres_per_unit < estimate.ci95[1]


def test_cameras_outside_the_recording_are_not_judged(walk):
    begin_s, end_s = walk.imu.gyro_t_s[0], walk.imu.gyro_t_s[-1]
    keep = (walk.imu.gyro_t_s > begin_s + 8) & (walk.imu.gyro_t_s < end_s - 8)
    accel = (walk.imu.accel_t_s > begin_s + 8) & (walk.imu.accel_t_s < end_s - 8)
    imu = replace(
        walk.imu,
        gyro_t_s=walk.imu.gyro_t_s[keep],
        gyro_rad_s=walk.imu.gyro_rad_s[keep],
        accel_t_s=walk.imu.accel_t_s[accel],
        accel_m_s2=walk.imu.accel_m_s2[accel],
    )
    _, consensus = align_by_consensus(turned(walk.trajectory, [200], 40), imu)
    assert [one.name for one in consensus.wrong] == [walk.trajectory.names[200]]
    assert not consensus.judged[0] and not consensus.judged[-1]
    assert consensus.kept[0] and consensus.kept[-1]
    assert consensus.as_json()["unjudged"] == int((~consensus.judged).sum()) > 50


def test_no_half_is_taken_for_the_right_one(walk):
    step = round(0.5 / np.median(np.diff(walk.trajectory.t_s)))
    trajectory = keyframes(walk, step=step)
    rng = np.random.default_rng(0)
    for i in range(0, 30, 2):
        trajectory = turned(trajectory, [i], 60, rng.standard_normal(3))
    with pytest.raises(NotObservableError):
        align_by_consensus(trajectory, walk.imu)


def test_few_cameras_are_no_majority(walk):
    trajectory = walk.trajectory.select(slice(0, 7 * 15, 15))
    align_by_consensus(trajectory, walk.imu)
    with pytest.raises(NotObservableError):
        align_by_consensus(turned(trajectory, [3], 50), walk.imu)


def test_another_recording_s_gyroscope_is_refused(walk):
    other = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=30.0)), seed=4)
    for trajectory in (walk.trajectory, keyframes(walk, step=8)):
        with pytest.raises(NotObservableError):
            align_by_consensus(trajectory, other.imu)


def test_a_consensus_is_read_as_it_was_written(walk, tmp_path):
    _, consensus = align_by_consensus(turned(walk.trajectory, [7], 40), walk.imu)
    write_record(tmp_path / "consensus.json", consensus)
    again = read_record(tmp_path / "consensus.json", RotationConsensus)
    assert again.as_json() == consensus.as_json()
    assert np.array_equal(again.part, consensus.part)


def test_real_recordings_with_wrong_cameras_keep_their_scale(shared_data):
    # the truth is that of the motion capture; room3 and V102, keyframes three times a second, and 20 s of video
    tasks = study.tasks_of(shared_data / "real_imu", ["K3", "V20"], ["one", "three", "block"], 1)
    outcomes = [study.run(task) for task in tasks if task.window.recording in ("room3", "V102")]
    assert len(outcomes) == 12
    assert all(study.found(outcome) for outcome in outcomes)
    assert all(outcome.error is not None for outcome in outcomes)
    assert sum(abs(outcome.error) < 1.96 * outcome.sigma for outcome in outcomes) >= 11


def test_real_keyframes_in_another_place_are_named_and_the_scale_is_as_sure_as_without(shared_data):
    tasks = study.tasks_of(shared_data / "real_imu", ["K2"], ["moved", "clean"], 1)
    outcomes = [study.run(task) for task in tasks]
    moved, clean = ([o for o in outcomes if o.case == case] for case in ("moved", "clean"))
    assert sum(map(study.found, moved)) >= 5 and all(study.found(outcome) for outcome in clean)
    given = [o for o in moved if o.error is not None]
    assert len(given) >= 5 and sum(abs(o.error) < 1.96 * o.sigma for o in given) >= len(given) - 1
    assert np.median([o.sigma for o in given]) < 1.5 * np.median([o.sigma for o in clean])


def test_real_recordings_refuse_each_other_s_imu(shared_data):
    tasks = study.tasks_of(shared_data / "real_imu", ["K3", "V20"], ["foreign"], 1)
    assert {study.run(task).verdict for task in tasks[::2]} == {"refused"}


@pytest.mark.parametrize(("block", "away_m"), [(slice(25, 30), 1.0), (slice(0, 7), 3.0)])
def test_a_block_before_the_copy_of_a_wall_is_left_out(block, away_m):
    """More cameras of 30 than leave one by one lie in another place, turned rightly."""
    motion = MotionOptions(kind="roam", duration_s=20.0, vigour=0.35)
    walk = simulate_recording(RecordingOptions(motion=motion), seed=3)
    trajectory = keyframes(walk, step=round(0.5 / np.median(np.diff(walk.trajectory.t_s))))
    sound = estimate_scale(trajectory, walk.imu)
    assert not sound.rotations.moved
    centre = trajectory.cam_in_world.copy()
    centre[block] += away_m * np.array([0.85, -0.4, 0.3]) / walk.truth.metres_per_unit
    estimate = estimate_scale(replace(trajectory, cam_in_world=centre), walk.imu)
    assert estimate.rotations.moved == trajectory.names[block]
    error = np.log(estimate.accepted.metres_per_unit / walk.truth.metres_per_unit)
    assert abs(error) < Z95 * estimate.sigma_log
    assert estimate.sigma_log < 2 * sound.sigma_log
