"""Frames of a video are chosen where they are sharpest, as often as the motion needs."""

import itertools
import json
import re
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
import pytest

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_conjugate, quat_log, quat_multiply
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.options import FrameOptions, MappingOptions, ReconstructOptions
from colmap_inertial.core.types import CameraModel, FrameTiming
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.imaging.psf import predict_blur_px
from colmap_inertial.imaging.selection import Ranked, WindowLimits, choose_frames
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.frames import read_frame_timing, read_frames
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.flow import VisualRotation
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.preparation import selection as choosing
from colmap_inertial.run.preparation.selection import (
    Selection,
    _Clocks,
    everything,
    part_of,
    read_selection,
    run_selection,
    select_frames,
    use_all,
    write_selection,
)
from colmap_inertial.run.steps.runner import StepRunner
from colmap_inertial.run.steps.session import Session
from colmap_inertial.run.steps.workspace import Workspace
from colmap_inertial.tools.simulate import MotionOptions
from colmap_inertial.tools.simulate.recipe import SceneRecipe
from colmap_inertial.tools.simulate.scene import make_scene
from colmap_inertial.tools.simulate.sensors import IMU_PRESETS
from tests.helpers.box_video import BoxVideo, film
from tests.helpers.frame_readers import readers


def silent(*_: object) -> None:
    pass


def selected(video: BoxVideo, **options: float) -> Selection:
    capture = load_capture(video.folder)
    timing = read_frame_timing(capture)
    imu = read_capture_imu(capture)
    return chosen(capture, imu, timing, **options)


def chosen(capture, imu, timing, **options: float) -> Selection:
    recording = Recording.of(capture, imu, timing, capture.calibration)
    return select_frames(recording, FrameOptions(use="auto", **options), readers(recording)[0], silent)


def places(selection: Selection) -> np.ndarray:
    return np.array([window.place for window in selection.windows])


def share_of_windows_mean(video: BoxVideo, selection: Selection) -> float:
    """Blur of the chosen frames by truth, against the mean of what each was chosen from; median."""
    smear = np.array([video.smear_px(i) for i in range(len(video.t_s))])
    shares = [smear[w.place] / smear[w.first : w.last + 1].mean() for w in selection.windows if w.last > w.first]
    return float(np.median(shares))


_followed: dict[tuple[object, ...], VisualRotation] = {}


@pytest.fixture(scope="module", autouse=True)
def _followed_once():
    """Pixels of a video that are asked for again are not followed again: the answer is the same, and takes seconds."""
    follow = choosing.measure_sampled_rotation

    def known(frames, camera, indices, progress, *, stage="motion"):
        key = (frames, camera.params, frames.timing.pose_t_s().tobytes(), tuple(indices))
        if key not in _followed:
            _followed[key] = follow(frames, camera, indices, progress, stage=stage)
        return _followed[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(choosing, "measure_sampled_rotation", known)
        yield


@pytest.fixture(scope="module")
def orbiting(tmp_path_factory) -> BoxVideo:
    """Handheld around the middle of the box, looking at it, 16 ms of exposure."""
    motion = MotionOptions(kind="orbit", duration_s=5.0)
    return film(tmp_path_factory.mktemp("orbit") / "a", motion, frame_rate_hz=24.0)


@pytest.fixture(scope="module")
def of_turning(turning) -> Selection:
    """With the default options."""
    return selected(turning)


@pytest.fixture(scope="module")
def turning(tmp_path_factory) -> BoxVideo:
    """About the optical centre alone."""
    return film(
        tmp_path_factory.mktemp("turn") / "a",
        MotionOptions(kind="pure_rotation", duration_s=4.5, vigour=0.6),
        exposure_s=0.025,
        frame_rate_hz=24.0,
    )


def test_the_gyroscope_s_choice_is_the_sharpest_by_truth_and_by_picture(turning, of_turning):
    selection = of_turning
    assert {window.ranked_by for window in selection.windows} == {"blur"}
    capture = load_capture(turning.folder)
    pictures = [cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY) for frame in read_frames(capture)[1]]
    smear = np.array([turning.smear_px(i) for i in range(len(pictures))])
    detail = np.array([cv2.Laplacian(picture, cv2.CV_64F).var() for picture in pictures])
    by_truth, by_picture = [], []
    for window in selection.windows:
        of = slice(window.first, window.last + 1)
        assert window.first <= window.place <= window.last
        if smear[of].max() > 1.5 * smear[of].min() and smear[of].max() > 1.0:
            by_truth.append(smear[window.place] <= 1.1 * smear[of].min() + 0.1)
            by_picture.append(detail[window.place] >= 0.9 * detail[of].max())
    assert len(by_truth) >= 5
    assert np.mean(by_truth) >= 0.95
    assert np.mean(by_picture) >= 0.85
    assert share_of_windows_mean(turning, selection) < 0.95


def test_the_offset_between_the_clocks_is_found_and_stated(turning, of_turning):
    selection = of_turning
    true_s = turning.scene.imu.errors.gyro_time_offset_s
    assert selection.offset_from == "pixels"
    assert abs(selection.offset_s - true_s) < 0.003
    assert "ms" in str(selection.note)


@pytest.fixture(scope="module")
def of_orbiting(orbiting) -> Selection:
    """With the default options."""
    return selected(orbiting)


def test_frames_keep_their_distance_and_their_overlap(orbiting, turning, of_orbiting, of_turning):
    for video, selection in ((orbiting, of_orbiting), (turning, of_turning)):
        steps = np.diff(video.t_s[places(selection)])
        assert steps.min() > 0.1 - 1e-6
        # a window ends before the longest interval is over, unless nothing moved
        assert steps.max() < 0.25 + 1e-6
        for window in selection.windows[1:]:
            assert window.motion < 0.3 and window.closed_by != "still"


def test_baseline_is_what_translation_moves(orbiting, of_orbiting, of_turning):
    selection = of_orbiting
    found = np.array([window.baseline for window in selection.windows[1:]])
    chosen = places(selection)
    true = np.array([orbiting.parallax(a, b) for a, b in itertools.pairwise(chosen)])
    assert true.max() > 0.02
    assert np.corrcoef(found, true)[0, 1] > 0.85
    assert np.median(np.abs(found - true)) < 0.006
    still = np.array([window.baseline for window in of_turning.windows[1:]])
    assert still.max() < 0.01


def test_more_baseline_makes_more_frames(tmp_path):
    slow = film(tmp_path / "slow", MotionOptions(kind="constant_velocity", duration_s=1.5, speed_m_s=0.1, vigour=0.0))
    quick = film(tmp_path / "quick", MotionOptions(kind="constant_velocity", duration_s=1.5, speed_m_s=1.6, vigour=0.0))
    few, many = selected(slow, min_fps=2.0), selected(quick, min_fps=2.0)
    assert len(many.windows) > 1.5 * len(few.windows)
    assert Counter(window.closed_by for window in many.windows).most_common(1)[0][0] in ("baseline", "motion")
    # nothing turns: the gyroscope cannot be brought together with the pictures, and they decide
    assert few.offset_from is None and few.offset_s is None
    assert {window.ranked_by for window in few.windows} == {"sharpness"}


def test_a_tripod_gives_few_frames(tmp_path):
    video = film(tmp_path / "a", MotionOptions(kind="static", duration_s=2.5))
    selection = selected(video)
    assert 3 <= len(selection.windows) <= 8
    assert Counter(window.closed_by for window in selection.windows)["still"] >= 2


def test_without_exposure_times_frames_are_ranked_by_angular_speed(turning, tmp_path):
    capture = load_capture(turning.folder)
    unknown = replace(capture, exposure_s=None)
    timing = read_frame_timing(unknown)
    assert timing.exposure_s is None
    imu = read_capture_imu(unknown)
    selection = chosen(unknown, imu, timing)
    assert {window.ranked_by for window in selection.windows} == {"speed"}
    assert share_of_windows_mean(turning, selection) < 0.95


#: Of the camera in the recording of several minutes.
_PINHOLE = CameraModel(model="SIMPLE_PINHOLE", width=1920, height=1080, params=(1500.0, 960.0, 540.0))
_LONG_S = 300.0


def of_a_long_recording(
    capture: Capture, monkeypatch: pytest.MonkeyPatch, *, clock_rate: float, followed_s: float, noise_rad: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, _Clocks]:
    """Five minutes of turning: what the followed pixels tell is simulated.

    Predicted blur, the true one, by how much the clocks are off for each frame, and what is known of them.
    """
    errors_off = dict.fromkeys(("gyro_scale_sd", "gyro_misalignment_sd", "gyro_bias_rad_s_sd", "clock_rate_sd"), 0.0)
    recipe = SceneRecipe(
        motion=MotionOptions(kind="pure_rotation", duration_s=_LONG_S),
        imu=replace(IMU_PRESETS["phone"], clock_offset_s=(200.0, 200.0), **errors_off),
        frame_rate_hz=10.0,
        format="h264",
    )
    scene = make_scene(recipe)
    true = scene.imu.errors
    assert true.clock_rate == 0
    # stamps of a clock that runs at another rate; in the middle of the recording it shows the same
    recording = scene.imu.recording
    fixed_s = true.middle_s - true.gyro_time_offset_s
    stretched = {
        key: fixed_s + (getattr(recording, key) - fixed_s) * (1 + clock_rate) for key in ("gyro_t_s", "accel_t_s")
    }
    imu = replace(recording, **stretched)
    timing = FrameTiming(
        names=scene.names, t_s=scene.trigger_s, exposure_s=np.full(len(scene.names), 0.02), readout_s=0.0, epoch_ns=0
    )
    pose_t_s = timing.pose_t_s()
    at = np.flatnonzero(pose_t_s < followed_s)
    looking = scene.motion.world_from_cam_xyzw(pose_t_s[at])
    turns = quat_log(quat_multiply(quat_conjugate(looking[:-1]), looking[1:]))
    rotation = VisualRotation(
        names=tuple(timing.names[i] for i in at),
        t_s=pose_t_s[at],
        turn_rad=turns + noise_rad * np.random.default_rng(2).standard_normal(turns.shape),
        sigma_rad=np.full(len(turns), noise_rad),
        support=np.full(len(turns), 100),
    )
    monkeypatch.setattr(choosing, "measure_sampled_rotation", lambda *_, **__: rotation)
    stretching = Recording.of(replace(capture, camera=_PINHOLE), imu, timing, calibration_prior())
    clocks = choosing._clocks(replace(stretching, max_offset_s=None), readers(stretching)[0], silent)
    predicted, kind = choosing._predicted(clocks, timing)
    assert kind == "blur"
    exact = GyroCamera(
        path=GyroPath(recording.gyro_t_s, recording.gyro_rad_s, np.zeros(3)),
        cam_from_imu_xyzw=true.cam_from_imu_xyzw,
        offset_s=true.gyro_time_offset_s + recording.epoch_ns * 1e-9,
    )
    blur = predict_blur_px(exact, colmap_camera(_PINHOLE), timing, width=1920, height=1080).px
    # a gyroscope sample is found at the time that the recording without a rate has for it
    found_s = clocks.motion.path.t_s + clocks.motion.offset_s
    true_s = recording.gyro_t_s + exact.offset_s
    return predicted, blur, np.interp(pose_t_s, true_s, found_s - true_s), clocks


@pytest.mark.parametrize("clock_rate", [1e-3, -1e-3])
def test_a_clock_of_another_rate_ranks_all_of_a_long_recording(turning, monkeypatch, clock_rate):
    """One part in a thousand is 0.3 s after five minutes."""
    capture = load_capture(turning.folder)
    predicted, true, late_s, clocks = of_a_long_recording(
        capture, monkeypatch, clock_rate=clock_rate, followed_s=20.0, noise_rad=1e-4
    )
    assert np.isfinite(predicted).mean() > 0.98
    assert np.abs(late_s).max() < 0.01
    known = np.isfinite(predicted)
    assert np.median(np.abs(predicted - true)[known]) < 0.05 * np.median(true)
    # the camera's clock against the IMU's
    said = re.search(r"rates differ by ([+-]\d+) ppm \(to (\d+) ppm", str(clocks.note))
    assert abs(int(said[1]) + 1e6 * clock_rate) < 4 * int(said[2]) + 1


def test_where_the_clock_rate_leaves_the_offset_open_the_pictures_decide(turning, monkeypatch):
    capture = load_capture(turning.folder)
    predicted, true, late_s, clocks = of_a_long_recording(
        capture, monkeypatch, clock_rate=1e-3, followed_s=12.0, noise_rad=4e-3
    )
    known = np.isfinite(predicted)
    assert known[:100].all() and not known[-300:].any()
    # unknown from some time on, and within what is claimed until then
    assert (np.diff(known.astype(int)) <= 0).all()
    assert np.abs(late_s[known]).max() < 3 * 0.01
    assert np.isfinite(true).all() and clocks.offset_sigma_s < 0.01


def test_what_one_clock_stamped_keeps_step_all_along(turning, monkeypatch):
    capture = replace(load_capture(turning.folder), shared_clock=True)
    predicted, true, late_s, clocks = of_a_long_recording(
        capture, monkeypatch, clock_rate=0.0, followed_s=12.0, noise_rad=4e-3
    )
    known = np.isfinite(predicted)
    assert known.mean() > 0.98 and np.abs(late_s).max() < 0.01 and "ppm" not in str(clocks.note)
    assert np.median(np.abs(predicted - true)[known]) < 0.1 * np.median(true)


def test_an_imu_that_ends_early_leaves_the_rest_to_the_pictures(turning):
    capture = load_capture(turning.folder)
    timing = read_frame_timing(capture)
    imu = read_capture_imu(capture)
    end_s = imu.gyro_t_s[0] + 0.75 * (imu.gyro_t_s[-1] - imu.gyro_t_s[0])
    keep, keep_accel = imu.gyro_t_s < end_s, imu.accel_t_s < end_s
    short = replace(
        imu,
        gyro_t_s=imu.gyro_t_s[keep],
        gyro_rad_s=imu.gyro_rad_s[keep],
        accel_t_s=imu.accel_t_s[keep_accel],
        accel_m_s2=imu.accel_m_s2[keep_accel],
    )
    selection = chosen(capture, short, timing)
    ways = [window.ranked_by for window in selection.windows]
    assert ways[0] == "blur" and ways[-1] == "sharpness"


def test_a_selection_is_the_same_twice_and_comes_back_from_its_file(turning, of_turning, tmp_path):
    _followed.clear()
    first, second = of_turning, selected(turning)
    for selection in (first, second):
        write_selection(tmp_path / "a.json", selection)
        again = read_selection(tmp_path / "a.json")
        assert again.names == first.names and again.note == first.note
        assert json.dumps(again.as_json()) == json.dumps(first.as_json())
    said = first.as_json()
    left_out = [i for a, b in said["left_out"] for i in range(a, b + 1)]
    assert sorted([*left_out, *said["windows"]["place"]]) == list(range(said["frames"]))
    assert set(said["windows"]["ranked_by"]) == {"blur"} and said["offset_from"] == "pixels"


def test_a_finished_selection_is_kept_and_another_option_makes_a_new_one(turning, tmp_path):
    capture = load_capture(turning.folder)
    timing, imu = read_frame_timing(capture), read_capture_imu(capture)
    workspace = Workspace(tmp_path / "out")
    workspace.open(capture.path)
    runs = []

    def run(options: ReconstructOptions) -> Selection:
        def progress(stage: str, done: int, total: int) -> None:
            if stage == "selection" and done == total:
                runs.append(total)

        context = RunContext(scratch=workspace.stamps, progress=progress)
        session = Session(workspace=workspace, runner=StepRunner(workspace), context=context)
        recording = Recording.of(capture, imu, timing, capture.calibration)
        return run_selection(session, recording, options.frames, readers(recording)[0])

    first = run(ReconstructOptions())
    assert run(ReconstructOptions()).names == first.names and len(runs) == 1
    fewer = run(ReconstructOptions(frames=FrameOptions(min_fps=1.0, max_fps=3.0)))
    assert len(fewer.names) < len(first.names) and len(runs) == 2
    whole = run(ReconstructOptions(frames=FrameOptions(use="all")))
    assert whole.names == timing.names and whole.as_json()["left_out"] == [] and not workspace.selection.exists()


def test_folders_and_thinned_videos_are_used_as_they_are(turning, tmp_path):
    capture = load_capture(turning.folder)
    assert use_all(capture, FrameOptions()) is None
    assert use_all(capture, FrameOptions(use="all")).code == "all-frames-asked"
    thinned = replace(capture, frames=replace(capture.frames, frames_per_s=3.0))
    assert use_all(thinned, FrameOptions()).code == "frames-as-capture-says"
    assert use_all(thinned, FrameOptions(use="auto")) is None
    timing = read_frame_timing(capture)
    assert everything(timing, Fact.stated("x")).timing(timing).names == timing.names
    part = part_of(timing, timing.names[3:9:2])
    np.testing.assert_array_equal(part.t_s, timing.t_s[3:9:2])
    assert [frame.name for frame in read_frames(capture, only=part.names)[1]] == list(part.names)
    with pytest.raises(ValueError, match="min_fps"):
        FrameOptions(min_fps=5.0, max_fps=2.0)


def test_a_quick_camera_s_frames_are_ranked_before_they_are_decoded():
    """At 240 frames a second, the least blurred of each thirtieth is looked at."""
    from colmap_inertial.run.preparation.selection import _slots

    t_s = np.arange(480) / 240
    blur = np.random.default_rng(0).uniform(1, 9, 480)
    looked = _slots(t_s, blur)
    assert len(looked) <= 62 and (np.diff(looked) > 0).all()
    for i in looked[1:-1]:
        near = np.abs(t_s - t_s[i]) < 1 / 481
        assert blur[i] <= blur[near].min()
    assert len(_slots(np.arange(60) / 30, blur[:60])) == 60


def test_a_picture_without_texture_gives_frames_at_the_longest_interval():
    camera = colmap_camera(CameraModel(model="SIMPLE_PINHOLE", width=320, height=240, params=(300, 160, 120)))
    t_s = np.arange(90) / 30
    ranked = Ranked(t_s=t_s, blur=np.full(90, np.nan), ranking="speed", start_from_cam=np.full((90, 3, 3), np.nan))
    grey = [np.full((240, 320), 128, np.uint8)] * 90
    chosen = list(
        choose_frames(grey, ranked, WindowLimits(shortest_s=0.1, longest_s=0.25), camera, width=320, height=240)
    )
    assert np.diff(t_s[[c.place for c in chosen]]).max() < 0.25 + 1e-6
    assert all(np.isnan(c.baseline) for c in chosen)


def test_a_gyroscope_of_another_recording_does_not_rank(turning):
    capture = load_capture(turning.folder)
    imu = read_capture_imu(capture)
    other = replace(imu, gyro_rad_s=imu.gyro_rad_s[::-1] * [1.0, -1.0, 1.0])
    timing = read_frame_timing(capture)
    selection = chosen(capture, other, timing)
    assert selection.offset_from is None and {w.ranked_by for w in selection.windows} == {"sharpness"}
    assert selection.note.values["clocks"].code == "offset-unknown-beforehand"
    # the pictures alone do well, too
    assert share_of_windows_mean(turning, selection) < 0.95


def test_a_video_is_reconstructed_from_the_chosen_frames(orbiting, of_orbiting, tmp_path):
    mapping = MappingOptions(max_num_features=400, first_octave=0, pairing="sequential", overlap=3)
    options = ReconstructOptions(deblur="off", refine="off", mapping=mapping)
    result = reconstruct(orbiting.folder, tmp_path / "out", options)
    stored = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result.selection.names == of_orbiting.names
    assert stored["selection"] == of_orbiting.as_json()
    assert [frame["name"] for frame in stored["frames"]] == list(of_orbiting.names)
    assert sorted(path.name for path in (tmp_path / "out" / "images").iterdir()) == list(of_orbiting.names)
    assert stored["models"][0]["registered_images"] >= 0.9 * len(of_orbiting.names)
    assert stored["models"][0]["metres_per_unit"] is not None
