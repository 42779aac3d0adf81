"""Frames that a damaged video lacks."""

from types import SimpleNamespace

import numpy as np

from colmap_inertial.io import video


def test_frames_beyond_the_file_are_those_of_the_video_that_was_listed(monkeypatch):
    """Not those of sound with as many samples, nor of another picture in the file."""

    def track(handler, listed, beyond):
        return SimpleNamespace(handler=handler, size=np.zeros(listed), lost=beyond)

    tracks = [track("soun", 90, 5), track("vide", 1, 1), track("vide", 90, 3)]
    movie = SimpleNamespace(tracks=tracks, beyond=lambda one: np.zeros(one.lost))
    monkeypatch.setattr(video, "read_movie", lambda _: movie)
    assert video._count_lost("a.mp4", "mov,mp4,m4a", 90, 7) == 3
    assert video._count_lost("a.mp4", "mov,mp4,m4a", 40, 7) == 0
    assert video._count_lost("a.mkv", "matroska,webm", 90, 7) == 7
    for whole, lost in ((True, 7), (False, 0)):
        monkeypatch.setattr(video, "_ends_inside_riff", lambda _, whole=whole: whole)
        assert video._count_lost("a.avi", "avi", 90, 7) == lost
