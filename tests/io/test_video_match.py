"""Pictures compared with the frames of a video."""

import numpy as np
import pytest

from colmap_inertial.io.video_match import _Candidates, _distance, _normalise


def test_a_picture_that_varies_by_less_than_a_grey_level_looks_like_nothing():
    one_of_eight = (np.arange(256) % 8 == 0).reshape(16, 16)
    # a step of three levels has a standard deviation of 0.99, one of four 1.32
    assert not _normalise((100 + 3 * one_of_eight).astype(np.uint8)).any()
    telling = _normalise((100 + 4 * one_of_eight).astype(np.uint8))
    assert np.linalg.norm(telling) == pytest.approx(1) and telling.mean() == pytest.approx(0, abs=1e-6)


def test_a_picture_between_two_frames_lies_at_its_share_of_the_way(subtests):
    for share in (0.0, 0.2, 0.5):
        with subtests.test(share=share):
            frames = np.random.default_rng(4).integers(0, 255, (2, 16, 16)).astype(np.uint8)
            between = _distance(*(_normalise(frame) for frame in frames))
            candidates = object.__new__(_Candidates)
            candidates._frames, candidates.distance = [frames], np.array([[share * between, (1 - share) * between]])
            assert candidates.fraction_to_next(0) == pytest.approx(share)
            # off the way between them by as much from both
            candidates.distance = np.hypot(candidates.distance, 0.3)
            assert candidates.fraction_to_next(0) == pytest.approx(share)
            candidates.distance[0, 1] = np.inf
            assert candidates.fraction_to_next(0) == 0
            candidates._frames, candidates.distance = [frames[[0, 0]]], np.array([[0.1, 0.1]])
            assert candidates.fraction_to_next(0) == 0.5
