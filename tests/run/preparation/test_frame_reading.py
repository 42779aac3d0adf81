"""Images are decoded once to be looked at in small, and once in full."""

from dataclasses import replace

import av
import cv2
import numpy as np
import pytest

from colmap_inertial.core.types import FrameTiming
from colmap_inertial.diagnose import Recorded
from colmap_inertial.io import video
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.frame_sources import ImageFolder
from colmap_inertial.io.frames import read_frame_timing, read_frames
from colmap_inertial.io.imu import read_unchecked_capture_imu
from colmap_inertial.motion.flow import GreyFrame
from colmap_inertial.run.preparation import frame_reading
from colmap_inertial.run.preparation.frame_reading import COMPARED, FOLLOWED, RANKED, FullFrames, GreyFrames
from colmap_inertial.run.preparation.preflight import add_images
from colmap_inertial.tools.simulate import MotionOptions
from tests.helpers.box_video import film


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Capture:
    """A video of 24 frames."""
    motion = MotionOptions(kind="orbit", duration_s=1.0)
    return load_capture(film(tmp_path_factory.mktemp("clip") / "a", motion, frame_rate_hz=24.0).folder)


@pytest.fixture
def decoded(monkeypatch) -> list[float]:
    """Times of the frames of videos that were decoded, in order."""
    times: list[float] = []
    convert = video._convert_errors

    def watched(path, items):
        for item in convert(path, items):
            if isinstance(item, av.VideoFrame):
                times.append(item.time)
            yield item

    monkeypatch.setattr(video, "_convert_errors", watched)
    return times


def grey_of(frames):
    return {frame.name: frame.grey.tobytes() for frame in frames}


def test_frames_that_are_expected_are_kept_while_others_are_looked_at(clip, decoded, tmp_path):
    timing = read_frame_timing(clip)
    names = timing.names
    plain = {frame.name: GreyFrame.of(frame, 640) for frame in read_frames(clip)[1]}
    decoded.clear()
    frames = GreyFrames(clip, timing, tmp_path)
    frames.expect(FOLLOWED, names[4:12])
    frames.expect(FOLLOWED, names[2:20:3])
    frames.expect(RANKED, names)
    first = list(frames.look(FOLLOWED, names[4:12]))
    assert len(decoded) == 12
    again, ranked = list(frames.look(FOLLOWED, names[2:20:3])), list(frames.look(RANKED, names))
    assert len(decoded) == len(names), "each frame once"
    assert [frame.name for frame in first] == list(names[4:12])
    for frame in (*first, *again):
        assert np.array_equal(frame.grey, plain[frame.name].grey)
        assert (frame.width, frame.height) == (plain[frame.name].width, plain[frame.name].height)
    assert grey_of(ranked) == grey_of(GreyFrames(clip, timing).look(RANKED, names))
    assert frames.guess_camera() is clip.camera
    frames.close()


def test_frames_for_an_unstated_exposure_are_kept_while_they_are_followed(clip, decoded):
    timing = replace(read_frame_timing(clip), exposure_s=None)
    imu = read_unchecked_capture_imu(clip)
    recorded = Recorded(imu=imu, timing=timing, is_capture=True, camera=clip.camera)
    recorded = add_images(recorded, clip, lambda *_: None)
    assert recorded.images is not None
    in_full = grey_of(recorded.images(recorded.in_full))
    assert len(decoded) == len(timing.names), "each frame once"
    plain = {frame.name: GreyFrame.of(frame, clip.camera.width).grey.tobytes() for frame in read_frames(clip)[1]}
    assert in_full == {name: plain[name] for name in recorded.in_full}


def test_what_was_not_kept_is_decoded_again(clip, decoded, tmp_path, monkeypatch):
    timing = read_frame_timing(clip)
    frames = GreyFrames(clip, timing, tmp_path)
    late = grey_of(frames.look(FOLLOWED, timing.names[10:12]))
    assert grey_of(frames.look(FOLLOWED, timing.names[10:12])) == late and len(decoded) == 24
    monkeypatch.setattr(frame_reading, "_LIMITS", frame_reading.ReadingLimits(in_memory=1, in_all=1))
    frames = GreyFrames(clip, timing, tmp_path)
    frames.expect(FOLLOWED, timing.names)
    expected = grey_of(frames.look(FOLLOWED, timing.names))
    decoded.clear()
    assert grey_of(frames.look(FOLLOWED, timing.names)) == expected
    assert decoded, "only the first was kept"


def test_images_of_a_folder_are_read_once(tmp_path, monkeypatch):
    names = tuple(f"{i}.png" for i in range(4))
    for i, name in enumerate(names):
        assert cv2.imwrite(str(tmp_path / name), np.full((300, 800, 3), 40 * i, np.uint8))
    read: list[str] = []
    capture = Capture(path=tmp_path, calibration=calibration_prior(), frames=ImageFolder(folder=tmp_path))
    frames = GreyFrames(capture, FrameTiming(names=names, t_s=np.arange(4.0)))
    open_lazily = frame_reading.read_lazily
    monkeypatch.setattr(
        frame_reading, "read_lazily", lambda path, name: (read.append(name), open_lazily(path, name))[1]
    )
    frames.expect(FOLLOWED, names)
    frames.expect(COMPARED, names[:2])
    assert [frame.grey.shape for frame in frames.look(COMPARED, names[1::-1])] == [(150, 400)] * 2
    levels = [frame.grey.mean() for frame in frames.look(FOLLOWED, names)]
    assert levels == [0, 40, 80, 120] and read == list(names)
    assert frames.guess_camera().width == 800


def test_frames_of_a_video_become_files_once(clip, decoded, tmp_path):
    timing = read_frame_timing(clip)
    plain = {frame.name: frame for frame in read_frames(clip)[1]}
    decoded.clear()
    frames = FullFrames(clip, timing, tmp_path)
    assert frames.files is None
    [some] = frames.decode([timing.names[5]])
    assert len(decoded) == 24 and frames.files == frames.require_files()
    for frame in (some, *frames.decode()):
        assert np.array_equal(frame.image, plain[frame.name].image)
        assert (frame.t_s, frame.exposure_s) == (plain[frame.name].t_s, plain[frame.name].exposure_s)
    assert len(decoded) == 24
    frames.close()
    assert list(tmp_path.iterdir()) == []


def test_frames_of_a_video_that_nobody_needs_beforehand_become_no_files(clip, decoded, tmp_path):
    frames = FullFrames(clip, read_frame_timing(clip), tmp_path)
    assert len(list(frames.decode())) == 24 == len(decoded)
    assert frames.files is None and list(tmp_path.iterdir()) == []


def test_a_folder_of_images_is_its_own_files(tmp_path):
    capture = Capture(path=tmp_path, calibration=calibration_prior(), frames=ImageFolder(folder=tmp_path))
    assert FullFrames(capture, FrameTiming(names=("a.png",), t_s=np.zeros(1)), tmp_path).require_files() == tmp_path
