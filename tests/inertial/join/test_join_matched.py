"""Sub-models that see the same places: matches across a gap place them beside the IMU."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.options import JoinOptions
from colmap_inertial.inertial.join import grouping
from colmap_inertial.inertial.join.evidence import find_links, find_matched
from colmap_inertial.inertial.join.grouping import join_submodels
from colmap_inertial.model import Model
from colmap_inertial.model.submodels.matches import PlacedImages, place_images
from colmap_inertial.run.stages.join import JoinStage
from colmap_inertial.run.stages.metric import MetricStage
from colmap_inertial.tools.simulate.motion import MotionOptions
from colmap_inertial.tools.simulate.tracks import TrackOptions, simulate_tracks
from tests.helpers.refine_walk import walk
from tests.inertial.join.test_grouping import T_S, part_of
from tests.inertial.join.test_join import UNKNOWN, across, cut

LIMITS = JoinOptions()


@pytest.fixture(scope="module")
def returned(tmp_path_factory):
    """Around a third of a ring and back past the same: two metric models, four seconds apart, and the database."""
    motion = MotionOptions(kind="orbit", duration_s=24.0, vigour=0.6, radius_m=4.0, arc_deg=120.0, sweep_s=12.0)
    tracks = simulate_tracks(
        TrackOptions(motion=motion, vibration_m_s2=0.2, frame_rate_hz=3.0, points_per_m=20.0, life_s=1e3), seed=4
    )
    metric = MetricStage(imu=tracks.imu, calibration=UNKNOWN)
    models = [
        metric(Model(reconstruction=model, colmap_index=i, timing=tracks.timing))
        for i, model in enumerate(cut(tracks, [(0.0, 10.0), (14.0, 24.0)]))
    ]
    database = tmp_path_factory.mktemp("matched") / "database.db"
    tracks.write_database(database)
    return tracks, models, database


@pytest.fixture(scope="module")
def stage(returned):
    tracks, _, database = returned
    return JoinStage(imu=tracks.imu, calibration=UNKNOWN, database=database)


@pytest.fixture(scope="module")
def parts(returned, stage):
    return [stage.part(model) for model in returned[1]]


@pytest.fixture(scope="module")
def found(returned, stage):
    return stage._found(returned[1])


def error_m(tracks, parts, placed):
    return float(np.linalg.norm(across(tracks, parts, placed, find_links(parts)[0])[0][3:]))


def test_images_of_one_model_lie_in_the_other_as_in_truth(returned, found):
    tracks, models, _ = returned
    assert {(one.first, one.second) for one in found} == {(0, 1), (1, 0)}
    t_of = dict(zip(tracks.timing.names, tracks.timing.pose_t_s().tolist(), strict=True))
    for one in found:
        # the true places in the model's own world, by its own images
        images = [models[one.first].reconstruction.image(i) for i in models[one.first].reconstruction.reg_image_ids()]
        lie = np.array([image.projection_center() for image in images])
        true = tracks.motion.cam_in_world_m(np.array([t_of[image.name] for image in images]))
        expected = _similarity(true, lie)(tracks.motion.cam_in_world_m(np.array([t_of[name] for name in one.names])))
        assert np.median(np.linalg.norm(one.cam_in_world - expected, axis=1)) < 0.02
        assert len(one.names) > 10 and set(one.names).isdisjoint({image.name for image in images})


def _similarity(source, target):
    """A similarity by least squares (Umeyama)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(d) @ sign) / np.sum(a**2)
    return lambda points: scale * (points - source.mean(0)) @ (u @ sign @ vt).T + target.mean(0)


def test_matches_place_a_part_better_than_the_imu_alone(returned, parts, found):
    tracks, _, _ = returned
    alone, both = (join_submodels(parts, tracks.imu, LIMITS, one) for one in ((), found))
    assert alone.gaps[0].matched_images == 0 and alone.gaps[0].joined
    (gap,), (group,) = both.gaps, both.groups
    assert gap.joined and gap.matched_images > 10 and gap.shared_images == 0
    assert "matched images, and the IMU" in str(gap.reason)
    assert gap.sigma_m < 0.6 * alone.gaps[0].sigma_m
    assert group.matched == {(0, 1)} and alone.groups[0].matched == frozenset()
    placed = error_m(tracks, parts, group.placed)
    assert placed < 0.02 and placed < error_m(tracks, parts, alone.groups[0].placed)
    error, cov = across(tracks, parts, group.placed, find_links(parts)[0])
    assert error[3:] @ np.linalg.solve(cov[3:, 3:], error[3:]) < 11.3


def test_matches_that_contradict_the_imu_are_left_out(returned, parts, found):
    tracks, _, _ = returned
    # copies of what the first part saw, a metre farther on: the poses agree with each other
    false = [
        replace(one, cam_in_world=one.cam_in_world + (1.0 if one.first == 0 else -1.0) * np.array([1.0, 0.0, 0.0]))
        for one in found
    ]
    assert all(len(one.images) > 10 for one in find_matched(parts, false))
    joined, alone = (join_submodels(parts, tracks.imu, LIMITS, one) for one in (false, ()))
    assert joined.gaps[0].joined and joined.gaps[0].matched_images == 0
    assert "contradicting matches between the two are left out" in str(joined.gaps[0].reason)
    assert joined.gaps[0].sigma_m == pytest.approx(alone.gaps[0].sigma_m)
    assert joined.groups[0].matched == frozenset()


def test_where_the_imu_contradicts_itself_matches_are_not_blamed(returned, parts, found):
    imu = returned[0].imu
    forces = imu.accel_m_s2.copy()
    forces[np.abs(imu.accel_t_s - imu.accel_t_s.mean()) < 0.5] += [3.0, 0.0, 0.0]
    false = replace(imu, accel_m_s2=forces)
    alone, both = (join_submodels(parts, false, LIMITS, one).gaps[0] for one in ((), found))
    assert not alone.joined and not both.joined
    assert both.reason == alone.reason and "left out" not in str(both.reason)


@pytest.fixture(scope="module")
def three():
    """Three parts of a walk, a second between each two; who recorded the IMU, and who is found where."""
    tracks = simulate_tracks(walk(30.0, points_per_m=2.0, vibration_m_s2=0.2), seed=3)
    parts = [part_of(tracks, T_S[np.abs(T_S - 4.5 - 10 * k) < 4.5], k) for k in range(3)]

    def found(first, second, shift_m=0.0):
        """Every fourth image of one part in another one, as it lies there."""
        there, own = parts[first], parts[second].trajectory
        state = tracks.motion.at(there.trajectory.t_s)
        turn = there.world_from_cam[0] @ matrix_from_quat(state.world_from_cam_xyzw)[0].T
        shift = (there.trajectory.cam_in_world - state.cam_in_world_m @ turn.T).mean(axis=0)
        shift[0] += shift_m
        state = tracks.motion.at(own.t_s[::4])
        return PlacedImages(
            first=first,
            second=second,
            names=own.names[::4],
            beside=there.trajectory.names[: len(own.names[::4])],
            world_from_cam=turn @ matrix_from_quat(state.world_from_cam_xyzw),
            cam_in_world=state.cam_in_world_m @ turn.T + shift,
            matches=np.zeros((0, 2), dtype=np.int64),
        )

    return parts, tracks.imu, found


def said_of(joined):
    """By pairs whose gaps were judged: whether matches count, and whether they are said to be left out."""
    return {(gap.first, gap.second): (gap.matched_images > 0, "left out" in str(gap.reason)) for gap in joined.gaps}


def test_of_a_group_s_matches_those_of_one_pair_are_left_out(three):
    parts, imu, found = three
    true = [found(0, 1), found(2, 1)]
    # no link is between the first and the last part: nobody tried them by themselves
    for false, matched in ((0.0, {(0, 1), (0, 2), (1, 2)}), (1.0, {(0, 1), (1, 2)})):
        joined = join_submodels(parts, imu, LIMITS, [found(0, 2, false), *true])
        (group,) = joined.groups
        assert group.members == (0, 1, 2) and group.matched == matched
        assert said_of(joined) == {(0, 1): (True, False), (1, 2): (True, False)}


def test_what_is_said_of_matches_is_what_became_of_them_in_the_group(three, monkeypatch):
    parts, imu, found = three

    def tried(evidence, members, matched=()):
        trial = grouping_tried(evidence, members, matched)
        of_pair = any({one.first, one.second} == {1, 2} for one in matched)
        return replace(trial, contradiction="it is so") if of_pair and len(members) == 3 else trial

    grouping_tried = grouping._try
    every = [found(0, 1), found(2, 1)]
    monkeypatch.setattr(grouping, "_try", tried)
    joined = join_submodels(parts, imu, LIMITS, every)
    assert joined.groups[0].matched == {(0, 1)}
    assert said_of(joined) == {(0, 1): (True, False), (1, 2): (False, True)}


def test_a_gap_that_the_imu_leaves_too_wide_is_closed_by_matches(returned, parts, found):
    tracks, _, _ = returned
    alone, both = (join_submodels(parts, tracks.imu, LIMITS, one).gaps[0] for one in ((), found))
    limits = JoinOptions(sigma_m=0.5 * (alone.sigma_m + both.sigma_m))
    assert not join_submodels(parts, tracks.imu, limits).gaps[0].joined
    assert join_submodels(parts, tracks.imu, limits, found).gaps[0].joined


def test_points_that_both_saw_are_one_in_the_joined_model(returned, stage):
    tracks, models, _ = returned
    (whole,), _ = stage.join_models(models)
    (apart,), _ = replace(stage, database=None).join_models(models)
    fewer = apart.reconstruction.num_points3D() - whole.reconstruction.num_points3D()
    assert fewer > 50
    assert whole.reconstruction.compute_num_observations() == apart.reconstruction.compute_num_observations()
    # what became one is one point of the walk: its keypoints' own numbers say so
    true, mixed = {}, 0
    for i in range(len(tracks.timing.names)):
        for place, point in enumerate(tracks.point[tracks.frame == i].tolist()):
            true[i + 1, place] = point
    for point in whole.reconstruction.points3D.values():
        mixed += len({true[e.image_id, e.point2D_idx] for e in point.track.elements}) > 1
    assert mixed == 0
    assert whole.reconstruction.compute_mean_reprojection_error() < 2.0


def test_without_matches_nothing_is_found(returned, tmp_path):
    tracks, models, _ = returned
    empty = tmp_path / "database.db"
    tracks.write_database(empty, fewest=10**9)
    reconstructions = [model.reconstruction for model in models]
    assert place_images(empty, reconstructions, [0, 1]) == []
    # models of one database that share images need no matches between these
    assert place_images(returned[2], [reconstructions[0], reconstructions[0]], [0, 1]) == []


def test_a_database_that_is_gone_is_said(returned, stage, tmp_path, caplog):
    _, models, _ = returned
    (whole,), (gap,) = replace(stage, database=tmp_path / "none.db").join_models(models)
    _, (asked,) = replace(stage, database=None).join_models(models)
    assert whole.parts and gap.reason == Fact("gap-without-database", reason=asked.reason)
    assert "none.db is gone" in caplog.text
    assert not (tmp_path / "none.db").exists()


def test_a_database_that_cannot_be_read_is_said_in_a_sentence(subtests, returned, stage, tmp_path_factory):
    for kept in (0.0, 0.5):
        with subtests.test(kept=kept):
            tmp_path = tmp_path_factory.mktemp("given")
            _, models, database = returned
            data = database.read_bytes()
            broken = tmp_path / "database.db"
            broken.write_bytes(data[: int(kept * len(data))] or b"no database" * 99)
            with pytest.raises(FormatError, match="restore it"):
                replace(stage, database=broken).join_models(models)
