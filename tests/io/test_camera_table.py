"""Readout times by camera and mode: where a video names a camera of the table, and nobody said another time."""

import math
from pathlib import Path

import av
import numpy as np
import pytest

from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.video import read_published_readouts, readout_of_video


def film(path: Path, *, model: str = "iPhone 3GS", rate: int = 30, size: tuple[int, int] = (640, 480)) -> Path:
    """A QuickTime video whose metadata name a camera."""
    options = {"movflags": "use_metadata_tags"}
    with av.open(str(path), "w", options=options) as container:
        container.metadata["com.apple.quicktime.make"] = "Apple"
        container.metadata["com.apple.quicktime.model"] = model
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        for i in range(4):
            frame = av.VideoFrame.from_ndarray(np.full((size[1], size[0], 3), 40 * i, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_every_figure_of_the_table_has_a_source_and_can_be() -> None:
    table = read_published_readouts()
    for one in table:
        assert one.source and one.make and one.model
        assert 0.002 < one.readout_s < 1.05 / one.rate_hz
        assert 0 < one.sigma_s < 0.1 * one.readout_s
    assert len({(one.model, one.width, one.rate_hz) for one in table}) == len(table)


def test_a_video_that_names_its_camera_gets_the_published_readout(tmp_path: Path) -> None:
    video = film(tmp_path / "a.mov")
    known = readout_of_video(video)
    assert known is not None and math.isclose(known.readout_s, 0.03092) and "Oth et al." in str(known)
    path = tmp_path / "capture.toml"
    path.write_text('video = "a.mov"\n[imu]\npath = "imu.csv"\n')
    capture = load_capture(path)
    assert capture.readout_s == known.readout_s
    assert capture.readout_source.startswith("from the table: Apple iPhone 3GS at 640x480, 30 a second, +-0.05 ms")
    path.write_text('video = "a.mov"\n[timing]\nreadout_s = 0.02\n[imu]\npath = "imu.csv"\n')
    capture = load_capture(path)
    assert (capture.readout_s, capture.readout_source) == (0.02, "")


def test_another_camera_or_mode_has_none(subtests: pytest.Subtests, tmp_path_factory: pytest.TempPathFactory) -> None:
    for other in ({"model": "iPhone 30"}, {"rate": 60}, {"size": (320, 240)}):
        with subtests.test(other=other):
            tmp_path = tmp_path_factory.mktemp("given")
            assert readout_of_video(film(tmp_path / "a.mov", **other)) is None  # type: ignore[arg-type]


def test_what_is_no_video_has_none(tmp_path: Path) -> None:
    (tmp_path / "a.mov").write_text("no video")
    assert readout_of_video(tmp_path / "a.mov") is None
    assert readout_of_video(tmp_path / "missing.mov") is None
