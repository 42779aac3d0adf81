"""Pairs of a video: neighbours and returns, few beside all pairs; frames at a standstill are matched with one."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features.extraction import MatchRecord, image_pairs, matches_every_pair
from colmap_inertial.colmap.loops.search import find_returns
from colmap_inertial.colmap.matching.pairing import match_capture
from colmap_inertial.colmap.views.two_views import Covisibility
from colmap_inertial.core.options import MappingOptions
from scripts.benchmarks import whole as bench

FRAMES = 96


@pytest.fixture(scope="module")
def loop(tmp_path_factory):
    """A walk around a room and a little further, and its features; the truth is the simulator's."""
    folder = tmp_path_factory.mktemp("loop")
    walk = bench.Walk(seed=100, frames=FRAMES, frame_rate_hz=FRAMES / 40, drawn=False)
    bench.write_walk(walk, folder)
    recording = bench.recorded(folder)
    bench.write_features(walk, recording.timing.names, folder / "features.db", density=0.5)
    return walk, folder, recording


def matched(loop, tmp_path, recording):
    """The record of matching, and of verified pairs far apart the share of matches that are right."""
    walk, folder, _ = loop
    options, database = MappingOptions(refine_intrinsics=False), tmp_path / "database.db"
    context = RunContext(scratch=tmp_path, num_threads=1)
    record, _ = match_capture(folder / "features.db", database, recording, walk.camera().model, options, context)
    names = recording.timing.names
    return record, bench.true_shares(walk, names, *bench.true_poses(folder), database, apart=FRAMES // 2)


def test_a_loop_is_closed_without_all_pairs(loop, tmp_path):
    record, shares = matched(loop, tmp_path, loop[2])
    assert record.pairing == "sequential" and record.still == 0
    assert record.heading_sigma_deg is not None and record.heading_sigma_deg < 3
    assert record.matched < 0.2 * FRAMES * (FRAMES - 1) / 2
    assert record.loops_closed + record.returns >= 6 and record.judged == (not record.returns)
    assert np.mean([share > 0.5 for share in shares.values()]) > 0.9


def test_returns_are_found_without_a_gyroscope(loop, tmp_path):
    recording = loop[2]
    silent = np.zeros_like(recording.imu.gyro_rad_s)
    record, shares = matched(loop, tmp_path, replace(recording, imu=replace(recording.imu, gyro_rad_s=silent)))
    assert record.gyroscope.startswith("not used") and record.returns > 0 and not record.judged
    assert record.matched < 0.2 * FRAMES * (FRAMES - 1) / 2
    assert sum(share > 0.5 for share in shares.values()) >= 3


@pytest.mark.parametrize(
    ("count", "spacing_s", "pairing", "every"),
    [
        (60, 0.2, "auto", True),
        (61, 0.2, "auto", False),
        (61, 0.2, "exhaustive", True),
        (150, 1.0, "auto", True),
        (151, 1.0, "auto", False),
        (20, 1.0, "sequential", False),
    ],
)
def test_every_pair_is_matched_of_few_frames_and_of_photographs(count, spacing_s, pairing, every):
    options, t_s = MappingOptions(pairing=pairing, overlap=2), spacing_s * np.arange(count)
    assert matches_every_pair(count, options, t_s) == every
    pairs = image_pairs([f"{k:03}" for k in range(count)], options, t_s)
    assert (len(pairs) == count * (count - 1) // 2) == every


def seen(rng, places, anew=()):
    """The same features at places (N,) px from where they were, with some of another scene."""
    described, xy = described_by(rng), rng.uniform(50, 400, (500, 2))
    other = described_by(rng)
    descriptors = [other if k in anew else described for k in range(len(places))]
    at = [xy + [place, 0] + 0.2 * rng.standard_normal(xy.shape) for place in places]
    return Covisibility(descriptors=tuple(descriptors), xy_px=tuple(at), long_side_px=np.full(len(places), 750.0))


def described_by(rng):
    vectors = np.abs(rng.normal(size=(500, 128)))
    return np.round(512 * vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.uint8)


def test_frames_of_a_camera_that_stands_still_belong_to_the_first_of_them():
    rng = np.random.default_rng(4)
    stands = seen(rng, [0, 9, 9, 9, 9.1, 20, 30, 30], anew=(7,))
    assert stands.find_standing().tolist() == [0, 1, 1, 1, 1, 5, 6, 7]
    # a slow move adds up
    assert seen(rng, [0, 0.3, 0.6, 1.4, 1.7, 5]).find_standing().tolist() == [0, 0, 0, 3, 3, 5]
    # another place, however alike its features lie; and too few of them
    few = seen(rng, [0, 0, 0])
    assert replace(few, descriptors=tuple(one[:40] for one in few.descriptors)).find_standing().tolist() == [0, 1, 2]


def test_returns_lie_far_apart_and_look_alike():
    rng = np.random.default_rng(5)
    covisibility = seen(rng, np.zeros(40), anew=range(10, 30))
    found = find_returns(covisibility, 0.5 * np.arange(40), 12)
    assert found and all((j - i >= 12) and ((10 <= i < 30) == (10 <= j < 30)) for i, j in found)


def test_a_record_says_whether_pairs_far_apart_were_judged():
    record = MatchRecord(device="cpu", pairing="sequential", images=2, pairs=1, matched=1, verified=1, gyroscope="")
    assert record.judged
    assert not replace(record, returns=3).judged and not replace(record, pairing="exhaustive").judged
