"""Which pairs of images are matched: headings by the gyroscope, its bias by matches, votes, loops."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features import extraction as sparse
from colmap_inertial.colmap.features.extraction import mapping_device
from colmap_inertial.colmap.loops import search as loops
from colmap_inertial.colmap.loops.pose_graph import select_loops
from colmap_inertial.colmap.loops.search import LoopSearch, candidates, key_frames
from colmap_inertial.colmap.matching import pairing
from colmap_inertial.colmap.matching.pairing import match_capture
from colmap_inertial.colmap.views import relative_track
from colmap_inertial.colmap.views.gyro_orientations import (
    GyroOrientations,
    RayPairs,
    _curvature,
    estimate_bias_correction,
    estimate_gyro_orientations,
)
from colmap_inertial.colmap.views.relative_track import (
    LoopPose,
    Observations,
    RelativeTrack,
    estimate_relative_track,
    link_observations,
)
from colmap_inertial.colmap.views.two_views import (
    Covisibility,
    TwoViews,
    compare,
    count_shared,
    count_verified,
    delete_matches,
    localise_frames,
    read_observations,
    read_ray_pairs,
    read_verified_pairs,
)
from colmap_inertial.core.errors import InertialError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_from_matrix, so3_exp
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.types import CAL, CameraModel, FrameTiming, ImuRecording
from colmap_inertial.io.calibration import Declared, calibration_prior

CAMERA = CameraModel(model="PINHOLE", width=480, height=360, params=(400.0, 400.0, 240.0, 180.0))
BIAS = np.array([0.004, -0.01, 0.02])


def imu_of(t_s, rate_rad_s):
    """A gyroscope that turns about the camera's y axis, with a bias."""
    still = np.tile([0.0, 0.0, 9.8], (len(t_s), 1))
    return ImuRecording(gyro_t_s=t_s, gyro_rad_s=rate_rad_s + BIAS, accel_t_s=t_s, accel_m_s2=still)


def calibration_of(bias_sigma=1e-3):
    known = calibration_prior(
        Declared(cam_from_imu_xyzw=[0, 0, 0, 1.0], imu_in_cam_m=[0, 0, 0.0], gyro_time_offset_s=0.0)
    )
    cov = np.array(known.cov)
    cov[CAL.GYRO_BIAS, CAL.GYRO_BIAS] = bias_sigma**2 * np.eye(3)
    return replace(known, gyro_bias_rad_s=BIAS, cov=cov)


def headings_of(angle_deg, t_s, bias_sigma=1e-3, bias=BIAS):
    """Of frames that look along angles about the vertical, (N,)."""
    fine_s = np.arange(t_s[0] - 1, t_s[-1] + 1, 0.005)
    angle = np.interp(fine_s, t_s, np.radians(angle_deg))
    rate = np.zeros((len(fine_s), 3))
    rate[:, 1] = np.gradient(angle, fine_s)
    timing = FrameTiming(names=tuple(f"{i:04}" for i in range(len(t_s))), t_s=t_s, readout_s=0.0)
    calibration = replace(calibration_of(bias_sigma), gyro_bias_rad_s=bias)
    return GyroOrientations.of(imu_of(fine_s, rate), calibration, timing, CAMERA)


def pair(i, j):
    return np.array([i]), np.array([j])


def test_frames_that_look_apart_are_told_from_those_that_may_share_something():
    headings = headings_of([0.0, 60.0, 120.0, 180.0], np.array([0.0, 5.0, 10.0, 15.0]))
    assert [bool(headings.see_nothing_in_common(*pair(0, k))[0]) for k in (1, 2, 3)] == [False, True, True]


def test_a_heading_that_is_unsure_rules_nothing_out():
    t_s = np.array([0.0, 5.0, 100.0])
    assert headings_of([0.0, 10.0, 150.0], t_s).see_nothing_in_common(*pair(0, 2))[0]
    unsure = headings_of([0.0, 10.0, 150.0], t_s, bias_sigma=0.02)
    assert not unsure.see_nothing_in_common(*pair(0, 2))[0]
    assert unsure.sigma_rad(*pair(0, 2))[0] > np.radians(60) > unsure.sigma_rad(*pair(0, 1))[0]


def test_across_a_gap_of_the_gyroscope_nothing_is_known():
    t_s = np.array([0.0, 5.0])
    known = headings_of([0.0, 150.0], t_s)
    apart = replace(known, part=np.array([0, 1]))
    assert known.see_nothing_in_common(*pair(0, 1))[0]
    assert not apart.see_nothing_in_common(*pair(0, 1))[0]
    assert apart.agree(*pair(0, 1), np.eye(3)[None])[0]


def test_frames_outside_of_the_recording_and_in_its_gaps_belong_to_no_part():
    fine_s = np.arange(0, 8, 0.01)
    fine_s = fine_s[(fine_s < 3) | (fine_s > 4)]
    t_s = np.array([-1.0, -0.5, 0.5, 2.0, 3.5, 5.0, 7.0, 9.0])
    timing = FrameTiming(names=tuple(f"{i}" for i in range(8)), t_s=t_s, readout_s=0.0)
    found = GyroOrientations.of(imu_of(fine_s, np.zeros((len(fine_s), 3))), calibration_of(), timing, CAMERA)
    assert found.part.tolist() == [-1, -1, 0, 0, -1, 1, 1, -1]
    i, j = np.triu_indices(8, 1)
    together = {(a, b) for a, b, known in zip(i.tolist(), j.tolist(), found.known(i, j).tolist(), strict=True) if known}
    assert together == {(2, 3), (5, 6)}


def test_what_a_change_of_the_bias_does_to_headings_is_what_their_covariance_says():
    t_s = np.array([0.0, 20.0])
    change = np.array([2e-3, 0, 0])
    before, after = headings_of([0.0, 40.0], t_s), headings_of([0.0, 40.0], t_s, bias=BIAS + change)
    lever = before.bias_lever_s[1] - before.bias_lever_s[0]
    moved = after.start_from_cam[0].T @ after.start_from_cam[1]
    expected = before.start_from_cam[0].T @ so3_exp(-(lever @ change)) @ before.start_from_cam[1]
    assert moved == pytest.approx(expected, abs=2e-4)


def unsure_by(headings, *, cov=None, density=0.0, walk=0.0, **changes):
    """Headings that are unsure by these errors alone, and by gains."""
    calibration = replace(headings.calibration, cov=np.zeros((CAL.COUNT, CAL.COUNT)) if cov is None else cov)
    return replace(
        headings, calibration=calibration, density_rad_s_rthz=density, walk_rad_s_rts=walk, **changes
    ).covariance(*pair(0, 1))[0]


def test_noise_turns_headings_as_far_as_they_are_unsure():
    """The scatter of 4000 recordings of a camera at rest."""
    still = headings_of([0.0, 0.0], np.array([0.0, 20.0]))
    rng, step_s = np.random.default_rng(0), 0.2
    white = 3e-3 / np.sqrt(step_s) * rng.standard_normal((4000, 100))
    walked = np.cumsum(2e-4 * np.sqrt(step_s) * rng.standard_normal((4000, 100)), axis=1)
    for rate, values in ((white, {"density": 3e-3}), (walked, {"walk": 2e-4}), (white + walked, None)):
        known = {"density": 3e-3, "walk": 2e-4} if values is None else values
        variance = float(np.var(rate.sum(axis=1) * step_s))
        assert unsure_by(still, **known) == pytest.approx(variance * np.eye(3), rel=0.1, abs=1e-9)


def test_a_wrong_calibration_turns_headings_as_far_as_they_are_unsure():
    still = headings_of([0.0, 0.0], np.array([0.0, 20.0]))
    cov = np.zeros((3, CAL.COUNT, CAL.COUNT))
    cov[0, CAL.GYRO_BIAS, CAL.GYRO_BIAS] = np.diag([1e-3, 2e-3, 3e-3]) ** 2
    cov[1, CAL.GYRO_TIME_OFFSET, CAL.GYRO_TIME_OFFSET] = 0.01**2
    cov[2, CAL.ROTATION, CAL.ROTATION] = 0.02**2 * np.eye(3)
    assert unsure_by(still, cov=cov[0]) == pytest.approx(np.diag([0.02, 0.04, 0.06]) ** 2, abs=1e-9)
    moving = replace(still, rate_rad_s=np.array([0.3, 0.4]))
    assert unsure_by(moving, cov=cov[1]) == pytest.approx(0.005**2 * np.eye(3), abs=1e-9)
    assert unsure_by(still, cov=cov[2]) == pytest.approx(0.04**2 * np.eye(3), rel=0.01)
    # about y by 60 degrees: a hundredth too far, and by what is crossed between the axes towards x and z
    turned, angle = headings_of([0.0, 60.0], np.array([0.0, 20.0])), np.radians(60)
    sine, versine = np.sin(angle), 1 - np.cos(angle)
    crossed = 0.005**2 / 2 * np.array([sine**2 + versine**2, 0, sine**2 + versine**2])
    expected = np.diag(crossed + np.array([0, (0.01 * angle) ** 2, 0]))
    assert unsure_by(turned) == pytest.approx(expected, abs=3e-7)


def test_what_bends_a_sum_of_squares_is_its_matrix():
    root = np.random.default_rng(3).standard_normal((3, 3))
    at = np.array([0.01, -0.02, 0.03])
    found = _curvature(lambda x: float(np.sum((root @ (x - at)) ** 2)) + 7.0, at + 1e-3 * np.array([2, 1, -1]))
    assert found == pytest.approx(root.T @ root, rel=1e-6)


def test_a_rotation_that_the_gyroscope_contradicts_is_told():
    headings = headings_of([0.0, 30.0], np.array([0.0, 5.0]))
    true = headings.start_from_cam[0].T @ headings.start_from_cam[1]
    assert headings.agree(*pair(0, 1), true[None])[0]
    assert not headings.agree(*pair(0, 1), (true @ so3_exp(np.radians([0, 12.0, 0])))[None])[0]


def test_a_wide_lens_sees_more_in_common():
    t_s = np.array([0.0, 5.0])
    wide = CameraModel(model="PINHOLE", width=800, height=600, params=(200.0, 200.0, 400.0, 300.0))
    timing = FrameTiming(names=("a", "b"), t_s=t_s, readout_s=0.0)
    imu = imu_of(np.arange(-1, 7, 0.01), np.zeros((800, 3)))
    assert GyroOrientations.of(imu, calibration_of(), timing, wide).apart_rad == pytest.approx(2 * np.arctan(2))
    assert GyroOrientations.of(imu, calibration_of(), timing, CAMERA).apart_rad == pytest.approx(np.pi / 2)
    assert GyroOrientations.of(imu, calibration_of(), timing, None).apart_rad == pytest.approx(np.pi / 2)


# --- the gyroscope's bias --------------------------------------------------------------------------------------------


def ray_pairs_of(headings, rng, *, noise_px=0.5, wall=False):
    """Matches of neighbours in a scene of some depth, or of a plain wall, seen by a camera that moves sideways."""
    count = len(headings.t_s)
    depth = np.full(100, 2.0) if wall else rng.uniform(1.5, 4.0, 100)
    first, second, rays = [], [], []
    for i in range(count - 2):
        for j in (i + 1, i + 2):
            seen = np.column_stack([rng.uniform(-0.5, 0.5, (100, 2)), np.ones(100)]) * depth[:, None]
            there = (seen - [0.1 * (j - i), 0, 0]) @ (headings.start_from_cam[i].T @ headings.start_from_cam[j])
            both = np.stack([seen / seen[:, 2:], there / there[:, 2:]])
            both[..., :2] += rng.normal(0, noise_px / 400, (2, 100, 2))
            first.append(i)
            second.append(j)
            rays.append(both / np.linalg.norm(both, axis=-1, keepdims=True))
    stacked = np.array(rays)
    places = np.array(first), np.array(second)
    return RayPairs(
        first=places[0], second=places[1], pixel_rad=1 / 400, rays_first=stacked[:, 0], rays_second=stacked[:, 1]
    )


def test_the_bias_is_found_by_matches_of_neighbours_also_before_a_wall(subtests):
    for wall in (False, True):
        with subtests.test(wall=wall):
            t_s = np.arange(40) * 0.3
            true = headings_of(30 * np.sin(t_s), t_s)
            wrong = headings_of(30 * np.sin(t_s), t_s, bias=BIAS + np.array([0.01, -0.03, 0.02]))
            pairs = ray_pairs_of(true, np.random.default_rng(0), wall=wall)
            change, cov = estimate_bias_correction(pairs, wrong.start_from_cam, wrong.bias_lever_s)
            off = change - [-0.01, 0.03, -0.02]
            assert np.abs(off).max() < (0.01 if wall else 2e-3)
            assert off @ np.linalg.solve(cov, off) < 16


def test_matches_that_suit_no_bias_are_refused():
    t_s = np.arange(40) * 0.3
    headings = headings_of(30 * np.sin(t_s), t_s)
    pairs = ray_pairs_of(headings, np.random.default_rng(0), noise_px=5)
    with pytest.raises(NotObservableError, match="fit no gyroscope bias"):
        estimate_bias_correction(pairs, headings.start_from_cam, headings.bias_lever_s)
    with pytest.raises(NotObservableError, match="too few"):
        estimate_bias_correction(
            pairs.only(np.arange(len(pairs.first)) < 3), headings.start_from_cam, headings.bias_lever_s
        )


# --- votes and loops -------------------------------------------------------------------------------------------------


def described(rng, count=600):
    """Descriptors as COLMAP stores them."""
    vectors = np.abs(rng.normal(size=(count, 128)))
    return np.round(512 * vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.uint8)


@pytest.fixture
def database(tmp_path):
    """Three images with features: the first two share descriptors."""
    rng = np.random.default_rng(1)
    path = tmp_path / "database.db"
    shared, places = described(rng), rng.uniform(0, 360, (600, 2))
    with pycolmap.Database.open(str(path)) as opened:
        camera = pycolmap.Camera(model="PINHOLE", width=480, height=360, params=CAMERA.params)
        identifier = opened.write_camera(camera)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, identifier))
        opened.write_rig(rig)
        for name, own in (("a", shared), ("b", shared[::-1]), ("c", described(rng))):
            image = opened.write_image(pycolmap.Image(name=name, camera_id=identifier))
            keypoints = np.zeros((len(own), 6), dtype=np.float32)
            keypoints[:, :2] = {"a": places, "b": places[::-1] + 20}.get(name, rng.uniform(0, 360, places.shape))
            keypoints[:, 2] = keypoints[:, 5] = np.linspace(*((5, 1) if name == "b" else (1, 5)), len(own))
            opened.write_keypoints(image, keypoints)
            opened.write_descriptors(
                image, pycolmap.FeatureDescriptors(type=pycolmap.FeatureExtractorType.SIFT, data=own)
            )
    return path


def test_images_that_share_features_have_votes(database):
    voters = Covisibility.of(database, ["a", "b", "c"])
    votes = voters.count(np.array([0, 0]), np.array([1, 2]))
    assert voters.plenty.all() and len(voters.descriptors[0]) == 500
    assert votes[0] > 400 and votes[1] < 4


def test_few_features_do_not_rule_a_pair_out(database):
    voters = Covisibility.of(database, ["a", "b"])
    few = replace(voters, descriptors=(voters.descriptors[0], voters.descriptors[1][:30]))
    assert few.plenty.tolist() == [True, False]


def test_frames_a_second_apart_are_looked_at_however_long_the_capture():
    assert np.diff(key_frames(np.arange(100) * 0.25)).tolist() == [4] * 24
    assert len(key_frames(np.arange(5000) * 1.0)) == 5000


def test_candidates_are_the_best_of_a_frame():
    i, j = np.array([0, 0, 0, 0, 0, 1]), np.array([20, 21, 22, 23, 24, 24])
    votes = np.array([30, 20, 8, 10, 9, 2])
    assert candidates(votes, i, j).tolist() == [True, True, True, True, True, False]
    i, j = np.zeros(5, dtype=np.intp), np.full(5, 20)
    assert candidates(np.array([30, 20, 8, 10, 9]), i, j).tolist() == [True, True, False, True, False]
    # of equally many matches, the earlier pairs
    assert candidates(np.full(5, 9), i, j).tolist() == [True, True, True, False, False]
    assert candidates(i[:0], i[:0], j[:0]).tolist() == []


def way_along(centre):
    """A way through centres (N, 3), with one point before each frame."""
    none = np.zeros(0, dtype=np.intp)
    sightings = Observations(frame=none, point=none, feature=none, rays=np.zeros((0, 3)))
    return RelativeTrack(
        part=np.zeros(len(centre), dtype=np.intp), centre=centre, points=np.zeros((0, 3)), observations=sightings
    )


def circle(count=40):
    """Around, and back to the start."""
    angle = np.linspace(0, 2 * np.pi, count)
    return 2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def search_of(headings, way, names=(), covisibility=None):
    """Loops of frames at least ten apart."""
    return LoopSearch(
        database=None, names=names, orientations=headings, track=way, covisibility=covisibility, nearest=10
    )


def closing(monkeypatch, seen, votes, *, centre=None, said=None, also=(), given=()):
    """Close loops among 40 frames a second apart, of which ``seen`` gives rotation and coverage of verified pairs.

    What the matches say of where the second frame is: ``said``, or as it is on the way through ``centre``.
    """
    t_s = np.arange(40.0)
    way = way_along(circle() if centre is None else centre)
    headings = headings_of(np.linspace(0, 360, 40), t_s)
    names = [f"{i:04}" for i in range(40)]
    forgotten, matched = [], []

    def compared(database, pairs):
        turned, covered = np.full((len(pairs), 3, 3), np.nan), np.zeros(len(pairs))
        for place, (a, b) in enumerate(pairs):
            known = seen(int(a), int(b))
            if known is not None:
                off, covered[place] = known
                true = headings.start_from_cam[int(a)].T @ headings.start_from_cam[int(b)]
                turned[place] = true @ so3_exp(np.radians(off) * np.array([0, 1.0, 0]))
        return TwoViews(first_from_second=turned, covered=covered)

    class Counted:
        def count(self, i, j):
            return np.array([votes(a, b) for a, b in zip(i.tolist(), j.tolist(), strict=True)])

    def returned(database, names, pairs, way):
        told = []
        for i, j in pairs:
            step = way.centre[j] - way.centre[i] if said is None else said(i, j)
            turned = headings.start_from_cam[j]
            told.append(LoopPose(step=step, start_from_second=turned, ratio=1.0, depth=2.0, matches=100))
        return told

    monkeypatch.setattr(loops, "compare", compared)
    monkeypatch.setattr(loops, "localise_frames", returned)
    monkeypatch.setattr(loops, "delete_matches", lambda database, pairs: forgotten.extend(pairs))
    search = search_of(headings, way, names, Counted())
    found = search.close_loops(matched.extend, doubtful=also, given=given)
    assert len(set(matched)) == len(matched) == found.candidates
    return found, forgotten


def test_a_place_that_is_seen_again_closes_a_loop(monkeypatch):
    again = {(a, b) for a in range(3) for b in range(37, 40)}
    found, _ = closing(monkeypatch, lambda a, b: (0, 0.9) if (a, b) in again else None, lambda a, b: 20 * (b - a > 36))
    assert set(found.closed) <= again and len(found.closed) >= 6


def test_loops_of_others_need_no_votes_and_are_judged(monkeypatch):
    again = [(a, b) for a in range(3) for b in range(37, 40)]
    copies = [(a, b) for a in (5, 6) for b in (25, 26)]
    found, forgotten = closing(
        monkeypatch, lambda a, b: (0 if b > 30 else 60, 0.9), lambda a, b: 0, given=[*again, *copies]
    )
    assert set(again) <= set(found.closed) and not set(copies) & set(found.closed)
    assert {(f"{a:04}", f"{b:04}") for a, b in copies} <= set(forgotten)
    # one alone is not believed where nothing beside it can be matched
    found, forgotten = closing(
        monkeypatch, lambda a, b: (0, 0.9) if (a, b) == (0, 39) else None, lambda a, b: 0, given=[(0, 39)]
    )
    assert found.closed == () and ("0000", "0039") in forgotten


def test_neighbours_that_may_be_copies_stay_where_they_pass_as_loops(monkeypatch):
    also = [(i, i + 10) for i in range(30)]
    # what is twenty apart shows nothing, but has the most votes
    found, forgotten = closing(
        monkeypatch,
        lambda a, b: (0 if a < 14 else 40, 0.9) if b - a == 10 else None,
        lambda a, b: {20: 30, 10: 6}.get(b - a, 0) if a != 20 else 0,
        also=also,
    )
    assert list(found.closed) == also[:14] and found.refused == 30 - 14 - 1
    assert {(f"{a:04}", f"{b:04}") for a, b in also[14:] if a != 20} <= set(forgotten)


@pytest.mark.parametrize(
    "seen",
    [
        lambda a, b: (40, 0.9) if b - a > 36 else None,
        lambda a, b: (0, 0.3) if b - a > 36 else None,
        lambda a, b: (0, 0.9) if (a, b) == (0, 39) else None,
    ],
    ids=["turned otherwise", "covers little", "alone"],
)
def test_what_looks_alike_and_is_not_the_same_closes_none(monkeypatch, seen):
    found, forgotten = closing(monkeypatch, seen, lambda a, b: 20 * (b - a > 36))
    assert found.closed == () and len(forgotten) == found.candidates > 0 and found.refused > 0


def test_what_the_way_leads_past_closes_no_loop(monkeypatch):
    """Along a corridor, each door looks like the one before."""
    ahead = np.stack([np.linspace(0, 8, 40), np.zeros(40), np.zeros(40)], axis=1)
    found, _ = closing(
        monkeypatch, lambda a, b: (0, 0.9), lambda a, b: 20, centre=ahead, said=lambda i, j: np.array([0.1, 0, 0])
    )
    assert found.candidates > 0 and found.closed == ()


def test_of_loops_that_contradict_each_other_only_those_with_by_far_the_most_matches_stay():
    t_s = np.arange(40.0)
    headings, way = headings_of(np.linspace(0, 360, 40), t_s), way_along(circle())

    def said(pairs, matches, off=0.0):
        return {
            (i, j): LoopPose(
                step=way.centre[j] - way.centre[i] + [off, 0, 0],
                start_from_second=headings.start_from_cam[j],
                ratio=1.0,
                depth=1.0,
                matches=matches,
            )
            for i, j in pairs
        }

    true, shifted = [(0, 37), (1, 38), (2, 39)], [(0, 38), (1, 39)]
    assert select_loops(way, headings, {}) == set()
    assert select_loops(way, headings, said(true, 100)) == set(true)
    both = {**said(true, 100), **said(shifted, 60, off=1.5)}
    assert select_loops(way, headings, both) == set(true)
    both = {**said(true, 100), **said(shifted, 150, off=1.5)}
    assert select_loops(way, headings, both) == set()


def sightings_along(centre, start_from_cam, rng, *, noise_rad=1e-3, reach=2.5):
    """What frames that look ahead (z) see of points within reach of theirs, each for a few frames."""
    frame, point, rays = [], [], []
    points = centre[rng.integers(len(centre), size=1500)] + rng.uniform(-1, 1, (1500, 3)) * [3, 3, 1]
    for k, at in enumerate(centre):
        away = (points - at) @ start_from_cam[k]
        mine = np.flatnonzero((away[:, 2] > 0.5) & (np.linalg.norm(away, axis=1) < reach) & (rng.random(1500) < 0.7))
        ray = points[mine] - at + noise_rad * rng.standard_normal((len(mine), 3))
        frame.append(np.full(len(mine), k))
        point.append(mine)
        rays.append(ray / np.linalg.norm(ray, axis=1)[:, None])
    which = np.concatenate(point)
    return Observations(frame=np.concatenate(frame), point=which, feature=which, rays=np.concatenate(rays))


def test_the_way_is_found_up_to_its_length_and_is_as_sure_as_it_says():
    count = 60
    centre = circle(count)
    headings = headings_of(np.linspace(0, 360, count), 0.5 * np.arange(count))
    way = estimate_relative_track(sightings_along(centre, headings.start_from_cam, np.random.default_rng(3)), count)
    assert (way.part == 0).all()
    scale = np.linalg.norm(way.centre[10] - way.centre[0]) / np.linalg.norm(centre[10] - centre[0])
    i, j = np.zeros(5, dtype=np.intp), np.array([10, 20, 30, 45, 59])
    off = way.centre[j] - way.centre[i] - scale * (centre[j] - centre[i])
    covariance = way.covariance(i, j, np.full(5, 0.01)) + (0.02 * scale) ** 2 * np.eye(3)
    assert np.linalg.norm(off, axis=1).max() < 0.5 * scale
    assert (np.sum(off * np.linalg.solve(covariance, off[..., None])[..., 0], axis=1) < 16.3).all()
    # all of the way was left at its first frame
    rest = way.centre[20] - way.centre[:21]
    assert way.covariance(i[:1], np.array([20]), np.zeros(1))[0] == pytest.approx(
        relative_track.DRIFT**2 * rest.T @ rest
    )


def test_a_way_that_nothing_leads_across_has_two_parts():
    count = 30
    headings = headings_of(np.linspace(0, 180, count), 0.5 * np.arange(count))
    found = sightings_along(circle(count), headings.start_from_cam, np.random.default_rng(0))
    split = replace(found, point=np.where(found.frame < 15, found.point, found.point + 1500))
    way = estimate_relative_track(split, count)
    assert way.known(np.array([0, 20]), np.array([10, 29])).all()
    assert not way.known(np.array([10]), np.array([20]))[0]


def test_matches_that_join_two_features_of_one_frame_make_no_point():
    pairs = [(0, 1, np.array([[0, 0], [1, 1]])), (1, 2, np.array([[0, 0], [1, 1]])), (0, 2, np.array([[2, 1]]))]
    frame, feature, point = link_observations([3, 2, 2], pairs)
    assert frame.tolist() == [0, 1, 2] and feature.tolist() == [0, 0, 0] and point.tolist() == [0, 0, 0]


def test_where_the_gyroscope_looked_elsewhere_no_loop_is_sought(monkeypatch):
    found, _ = closing(monkeypatch, lambda a, b: None, lambda a, b: 20)
    assert 0 < found.compared < 30 * 31 / 2


# --- the whole -------------------------------------------------------------------------------------------------------


def none_stands(monkeypatch, count):
    """Nothing is read of features; no frame shows what the one before does, and all share enough with others."""
    moving = SimpleNamespace(find_standing=lambda: np.arange(count))
    monkeypatch.setattr(pairing.Covisibility, "of", lambda *_: moving)
    monkeypatch.setattr(pairing, "count_shared", lambda *_: np.full(count, pairing._LEAST_SHARED))
    monkeypatch.setattr(pairing, "read_verified_pairs", lambda *_: set())


def test_pairs_without_a_gyroscope_are_those_of_before(database, tmp_path, monkeypatch):
    matched = []
    monkeypatch.setattr(pairing, "match_pairs", lambda db, pairs, context, **_: matched.extend(pairs) or 0)

    def refused(*_):
        raise NotObservableError("time offset", Fact.stated("no"))

    monkeypatch.setattr(pairing, "estimate_gyro_orientations", refused)
    timing = FrameTiming(names=("a", "b", "c"), t_s=np.arange(3.0))
    recording = type("Recording", (), {"timing": timing})()
    record, _ = match_capture(
        database, tmp_path / "out.db", recording, CAMERA, MappingOptions(), RunContext(scratch=tmp_path)
    )
    assert sorted(matched) == [("a", "b"), ("a", "c"), ("b", "c")]
    assert record.matched == record.pairs == 3 and record.apart == record.unlike == 0
    assert "not used" in record.gyroscope and record.heading_sigma_deg is None


def test_without_a_gyroscope_a_long_capture_matches_neighbours_only(database, tmp_path, monkeypatch):
    matched = []
    monkeypatch.setattr(pairing, "match_pairs", lambda db, pairs, context, **_: matched.extend(pairs) or 0)

    def refused(*_):
        raise NotObservableError("time offset", Fact.stated("no"))

    monkeypatch.setattr(pairing, "read_rotations_rad", refused)
    none_stands(monkeypatch, 40)
    names = tuple(f"{i:03}" for i in range(40))
    recording = type("Recording", (), {"timing": FrameTiming(names=names, t_s=np.arange(40.0))})()
    options = MappingOptions(pairing="sequential", overlap=3)
    record, _ = match_capture(database, tmp_path / "out.db", recording, CAMERA, options, RunContext(scratch=tmp_path))
    steps = sorted({int(b) - int(a) for a, b in matched})
    assert steps == [1, 2, 3, 4] and record.far == (40 - 8) + (40 - 16) + (40 - 32)
    assert record.matched == len(matched) == record.pairs - record.far and record.loops_closed == 0


def test_loops_are_sought_farther_apart_than_twice_the_overlap(database, tmp_path, monkeypatch):
    matched, sought = [], []

    class Search:
        def __init__(self, database, names, orientations, track, covisibility, nearest, *, lenient):
            assert not lenient
            sought.append(nearest)

        def close_loops(self, match, *, doubtful, given):
            sought.append({j - i for i, j in doubtful})
            return loops.Loops(compared=7, candidates=5, refused=3, closed=((0, 39),))

    headings = headings_of(np.zeros(40), np.arange(40.0))
    monkeypatch.setattr(pairing, "delete_matches", lambda *_: None)
    monkeypatch.setattr(pairing, "match_pairs", lambda db, pairs, context, **_: matched.extend(pairs) or 0)
    monkeypatch.setattr(pairing, "_estimate_orientations", lambda *_: headings)
    none_stands(monkeypatch, 40)
    monkeypatch.setattr(pairing, "_estimate_track", lambda *_: None)
    monkeypatch.setattr(pairing, "LoopSearch", Search)
    names = tuple(f"{i:03}" for i in range(40))
    recording = type("Recording", (), {"timing": FrameTiming(names=names, t_s=np.arange(40.0))})()
    options = MappingOptions(pairing="sequential", overlap=3)
    record, _ = match_capture(database, tmp_path / "out.db", recording, CAMERA, options, RunContext(scratch=tmp_path))
    nearest, doubtful = sought
    # within twice the overlap nothing is a loop; pairs up to four times the overlap apart may be one
    assert {int(b) - int(a) for a, b in matched} == {1, 2, 3, 4} and nearest == 2 * 3 + 1
    assert doubtful == {8} and record.matched == len(matched) == len(set(matched))
    assert (record.loops_compared, record.loop_candidates, record.loops_refused, record.loops_closed) == (7, 5, 3, 1)
    assert record.apart == record.unlike == 0 and record.gyroscope == "the frames turn as the gyroscope does"


def test_rotations_and_coverage_of_two_views_are_those_of_the_scene(tmp_path):
    """What both see has matches, or its right half; the second camera is turned to the right and moved."""
    rng = np.random.default_rng(3)
    turned = so3_exp(np.array([0.0, 0.3, 0.05]))  # first_from_second
    camera = pycolmap.Camera(model="PINHOLE", width=480, height=360, params=CAMERA.params)
    first_px = rng.uniform(0, [480, 360], (4000, 2))
    points = np.column_stack([camera.cam_from_img(first_px), np.ones(4000)]) * rng.uniform(2, 6, (4000, 1))
    second_px = camera.img_from_cam((points - [0.4, 0.0, 0.0]) @ turned)
    seen = np.flatnonzero(((second_px >= 0) & (second_px < [480, 360])).all(axis=1))
    features_px = np.concatenate([second_px[seen], rng.uniform(0, [480, 360], (2000, 2))])
    right = first_px[seen, 0] > np.median(first_px[seen, 0])
    for name, matched, share in (("all.db", seen, 1.0), ("half.db", seen[right], 0.5)):
        with pycolmap.Database.open(str(tmp_path / name)) as opened:
            identifier = opened.write_camera(camera)
            images = [opened.write_image(pycolmap.Image(name=name, camera_id=identifier)) for name in "ab"]
            opened.write_keypoints(images[0], first_px.astype(np.float32))
            opened.write_keypoints(images[1], features_px.astype(np.float32))
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            matches = np.column_stack([matched, np.searchsorted(seen, matched)]).astype(np.uint32)
            geometry.inlier_matches = matches
            geometry.E = np.cross(np.eye(3), turned.T @ [-0.4, 0.0, 0.0]).T @ turned.T
            opened.write_two_view_geometry(*images, geometry)
        views = compare(tmp_path / name, [("a", "b")])
        np.testing.assert_allclose(views.first_from_second[0], turned, atol=1e-3)
        assert views.covered[0] == pytest.approx(share, abs=0.1)


def test_features_are_shared_that_are_joined_to_two_others(tmp_path):
    xy = {name: np.random.default_rng(6).uniform(10, 350, (50, 2)) for name in "abcd"}
    chain = {(0, 1): np.arange(50), (1, 2): np.arange(40)[::-1], (0, 2): np.arange(5), (0, 3): np.arange(7)}
    path = written(tmp_path / "database.db", xy, chain)
    assert count_shared(path, list("abcd"), np.arange(4)).tolist() == [7, 40, 5, 0]
    # matches with an image that is not named do not count
    assert count_shared(path, list("abc"), np.array([2, 0])).tolist() == [5, 5]
    assert read_verified_pairs(path, list("bca")) == {(0, 1), (0, 2), (1, 2)}


def poor_frames_matched(monkeypatch, gain, *, short, axis_deg=None, count=40):
    """Pairs that are matched of frame 5, which shares ``gain`` more features each time; others share enough."""
    rounds, deleted, asked = [], [], []

    def shared(database, names, frames):
        asked.append(len(frames))
        return np.where(frames == 5, sum(gain[: len(asked)]), pairing._LEAST_SHARED)

    monkeypatch.setattr(pairing, "count_shared", shared)
    monkeypatch.setattr(pairing, "read_matched_pairs", lambda *_: set())
    monkeypatch.setattr(pairing, "read_verified_pairs", lambda *_: {pair for more in rounds for pair in more})
    monkeypatch.setattr(pairing, "compare", lambda db, named: SimpleNamespace(first_from_second=views(named)))
    monkeypatch.setattr(pairing, "delete_matches", lambda db, named: deleted.extend(named))

    def views(named):
        # of frames 5 and 12, a rotation that nothing bears out
        turned = {("5", "12"): so3_exp(np.array([0, 0.7, 0]))}
        return np.array([turned.get(pair, np.eye(3)) for pair in named]).reshape(-1, 3, 3)

    i, j = np.array([(a, b) for a in range(count) for b in range(a + 1, count) if b - a in (1, 2, 3, 4, 8)]).T
    pairs = pairing._Pairs(i=i, j=j, given=set(), only_given=False, every=False, short=short, near=8)
    headings = None if axis_deg is None else headings_of(axis_deg, np.arange(count) * 0.1, bias_sigma=1e-4)
    names = [str(k) for k in range(count)]
    kept = pairing._match_poor_frames(Path("x"), names, pairs, rounds.append, headings)
    return rounds, deleted, kept


def test_frames_that_share_little_are_matched_with_more():
    # COLMAP's mapper must be able to place an image by what two others show
    assert pycolmap.IncrementalMapperOptions().abs_pose_min_num_inliers < pairing._LEAST_SHARED


@pytest.mark.parametrize(
    ("gain", "short", "farthest"),
    [([60], True, 0), ([20, 10, 30], True, 16), ([20, 0], True, 7), ([20, 1, 1, 1, 1], True, 34), ([9, 9], False, 7)],
)
def test_others_are_farther_apart_as_long_as_that_helps(monkeypatch, gain, short, farthest):
    rounds, _, kept = poor_frames_matched(monkeypatch, gain, short=short)
    found = [pair for more in rounds for pair in more]
    assert len(found) == len(set(found)) and kept == set(found) and all(5 in pair for pair in found)
    apart = {abs(i - j) for i, j in found}
    assert max(apart, default=0) == farthest and apart.isdisjoint((1, 2, 3, 4, 8))


def test_the_gyroscope_tells_which_others_may_show_the_same(monkeypatch):
    turned_deg = np.where(np.arange(40) < 20, 0.0, 150.0)
    rounds, deleted, _ = poor_frames_matched(monkeypatch, [20, 1, 1, 1, 1], short=True, axis_deg=turned_deg)
    assert max(j for more in rounds for _, j in more) < 20 and deleted == [("5", "12")]


def test_a_track_is_made_of_frames_next_to_each_other(monkeypatch):
    asked = []
    monkeypatch.setattr(pairing, "read_observations", lambda database, names, pairs, rotations: asked.append(pairs))
    monkeypatch.setattr(pairing, "estimate_relative_track", lambda observations, count: count)
    close = [(0, 1), (1, 2), (5, 6), (5, 7), (5, 8), (5, 20)]
    orientations = SimpleNamespace(start_from_cam=None)
    assert pairing._estimate_track(Path("x"), ["a"] * 30, close, orientations) == 30
    assert asked == [[(0, 1), (1, 2), (5, 6), (5, 7)]]


def test_matches_are_verified_counted_and_forgotten(database, tmp_path):
    context = RunContext(scratch=tmp_path, num_threads=1)
    sparse.match_pairs(database, [("a", "b"), ("a", "c")], context)
    assert count_verified(database) == 1
    views = compare(database, [("a", "b"), ("a", "c")])
    assert np.isfinite(views.first_from_second).all(axis=(1, 2)).tolist() == [True, False]
    assert views.covered[0] > 0.9 and views.covered[1] == 0
    delete_matches(database, [("a", "b")])
    assert count_verified(database) == 0
    with pycolmap.Database.open(str(database)) as opened:
        assert not opened.exists_matches(1, 2) and opened.exists_matches(1, 3)


def test_cuda_is_used_where_it_is_and_asked_for_only_there(monkeypatch):
    monkeypatch.setattr(pycolmap, "has_cuda", False)
    assert mapping_device(MappingOptions(), deterministic=False) == "cpu"
    with pytest.raises(InertialError, match="is built without CUDA"):
        mapping_device(MappingOptions(device="cuda"), deterministic=False)
    monkeypatch.setattr(pycolmap, "has_cuda", True)
    assert mapping_device(MappingOptions(), deterministic=False) == "cuda"
    assert mapping_device(MappingOptions(), deterministic=True) == "cpu"
    assert mapping_device(MappingOptions(device="cpu"), deterministic=False) == "cpu"


def test_headings_are_found_by_the_turns_of_the_pictures():
    t_s = np.arange(60) * 0.3
    angles = 40 * np.sin(0.9 * t_s) + 5 * t_s
    true = headings_of(angles, t_s)
    fine_s = np.arange(-1, 20, 0.005)
    rate = np.zeros((len(fine_s), 3))
    rate[:, 1] = np.gradient(np.radians(np.interp(fine_s, t_s, angles)), fine_s)
    turned = np.swapaxes(true.start_from_cam[:-1], 1, 2) @ true.start_from_cam[1:]
    turn = np.array([[0, np.arctan2(r[0, 2], r[0, 0]), 0] for r in turned])
    timing = FrameTiming(names=tuple(map(str, range(60))), t_s=t_s, readout_s=0.0)
    prior = calibration_prior(
        Declared(cam_from_imu_xyzw=quat_from_matrix(np.eye(3)), gyro_time_offset_s=0.0, time_offset_sigma_s=0.01)
    )
    recording = type(
        "Recording", (), {"timing": timing, "imu": imu_of(fine_s, rate), "prior": prior, "max_offset_s": 1.0}
    )()
    found = estimate_gyro_orientations(recording, turn, ray_pairs_of(true, np.random.default_rng(0)), CAMERA)
    assert found.calibration.gyro_bias_rad_s == pytest.approx(BIAS, abs=3e-3)


def test_a_capture_too_short_for_loops_has_none(monkeypatch):
    headings = headings_of([0.0, 5.0, 10.0], np.arange(3.0))
    monkeypatch.setattr(loops, "delete_matches", lambda database, pairs: None)
    empty = TwoViews(first_from_second=np.zeros((0, 3, 3)), covered=np.zeros(0))
    monkeypatch.setattr(loops, "compare", lambda database, pairs: empty)
    voters = Covisibility(descriptors=(), xy_px=(), long_side_px=np.zeros(0))
    search = search_of(headings, way_along(circle(3)), ["a", "b", "c"], voters)
    found = search.close_loops(len, doubtful=[])
    assert found.compared == found.candidates == found.refused == 0 and found.closed == ()


def written(path, xy_px, matched):
    """A database of images' keypoints by name, and of verified matches: feature k of one with which of the other."""
    with pycolmap.Database.open(str(path)) as opened:
        camera = opened.write_camera(pycolmap.Camera(model="PINHOLE", width=480, height=360, params=CAMERA.params))
        rig = pycolmap.Rig()
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera))
        opened.write_rig(rig)
        images = [opened.write_image(pycolmap.Image(name=name, camera_id=camera)) for name in xy_px]
        for image, at in zip(images, xy_px.values(), strict=True):
            opened.write_keypoints(image, np.pad(at, ((0, 0), (0, 4))).astype(np.float32))
        for (i, j), other in matched.items():
            views = pycolmap.TwoViewGeometry()
            views.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            views.inlier_matches = np.stack([np.arange(len(other)), other], axis=1).astype(np.uint32)
            opened.write_two_view_geometry(images[i], images[j], views)
    return path


def test_points_are_those_that_three_frames_saw_and_rays_are_turned(tmp_path):
    rng = np.random.default_rng(5)
    xy = {name: rng.uniform(10, 350, (50, 2)) for name in "abc"}
    path = written(tmp_path / "database.db", xy, {(0, 1): np.arange(50), (1, 2): np.arange(40)[::-1]})
    turned = so3_exp(np.array([[0, 0, 0], [0, 0.2, 0], [0.1, 0, 0]]))
    found = read_observations(path, list("abc"), [(0, 1), (1, 2)], turned)
    assert found.frame.tolist() == [0] * 40 + [1] * 40 + [2] * 40
    of_c = found.feature[found.frame == 2][np.argsort(found.point[found.frame == 2])]
    of_a = found.feature[found.frame == 0][np.argsort(found.point[found.frame == 0])]
    assert (of_a + of_c == 39).all()
    there = np.column_stack([(xy["c"][found.feature[80:]] - [240, 180]) / 400, np.ones(40)]) @ turned[2].T
    assert found.rays[80:] == pytest.approx(there / np.linalg.norm(there, axis=1)[:, None], abs=1e-6)


def test_rays_of_pairs_are_those_of_their_matches_and_of_none_that_cannot_be_seen(tmp_path):
    rng = np.random.default_rng(6)
    xy = {name: rng.uniform(10, 350, (80, 2)) for name in "abcd"}
    xy["d"][::3] = np.nan
    matched = {(0, 1): rng.permutation(80), (1, 2): np.arange(5), (0, 3): np.arange(80)}
    path = written(tmp_path / "database.db", xy, matched)
    found = read_ray_pairs(path, list("abcd"), [(0, 1), (1, 2), (0, 3)])
    # few matches, and features that no ray meets
    assert found.first.tolist() == [0] and found.second.tolist() == [1] and found.pixel_rad == pytest.approx(1 / 400)
    rays = [np.column_stack([(xy[name] - [240, 180]) / 400, np.ones(80)]) for name in "ab"]
    first, second = (one / np.linalg.norm(one, axis=1)[:, None] for one in rays)
    for ray, other in zip(found.rays_first[0], found.rays_second[0], strict=True):
        k = np.argmax(first @ ray)
        assert ray == pytest.approx(first[k], abs=1e-6) and other == pytest.approx(second[matched[0, 1][k]], abs=1e-6)


def test_a_frame_is_placed_by_points_that_another_one_knew(tmp_path):
    """The way is twice as long at the first frame as at the second; a fifth of the matches joins what it should not."""
    rng = np.random.default_rng(4)
    points = rng.uniform([-1, -1, 3], [1, 1, 5], (60, 3))
    turned, centre = so3_exp(np.array([0, 0.1, 0.02])), np.array([0.4, -0.1, 0.2])
    seen = (points - centre) @ turned
    xy = [400 * p[:, :2] / p[:, 2:] + [240, 180] for p in (points, seen)]
    second = np.arange(60)
    second[:12] = np.roll(second[:12], 5)
    path = written(tmp_path / "database.db", dict(zip("ab", xy, strict=True)), {(0, 1): second})
    half = 0.5 * (points - centre) + [7, 7, 7]
    sightings = Observations(
        frame=np.repeat([0, 1], 60),
        point=np.arange(120),
        feature=np.tile(np.arange(60), 2),
        rays=np.zeros((120, 3)),
    )
    way = RelativeTrack(
        part=np.zeros(2, dtype=np.intp),
        centre=np.array([[0, 0, 0], [7.0, 7, 7]]),
        points=np.concatenate([points, half]),
        observations=sightings,
    )
    told = localise_frames(path, ["a", "b"], [(0, 1)], way)[0]
    assert told is not None and told.matches == 48
    assert told.step == pytest.approx(centre, abs=1e-3)
    assert told.start_from_second == pytest.approx(turned, abs=1e-3)
    assert told.ratio == pytest.approx(2.0, rel=1e-2)
    few = replace(way, points=np.where(np.arange(120)[:, None] < 50, np.nan, way.points))
    assert localise_frames(path, ["a", "b"], [(0, 1)], few) == [None]


def test_batches_of_pairs_grow_and_hold_every_pair_once():
    pairs = [f"{i} {i + 1}" for i in range(5000)]
    found = sparse.growing_batches(pairs)
    assert [len(batch) for batch in found] == [40, 80, 160, 320, 640, 1280, 1600, 880]
    assert [pair for batch in found for pair in batch] == pairs and sparse.growing_batches([]) == []
    assert [len(batch) for batch in sparse.growing_batches(pairs, first=1600)] == [1600, 1600, 1600, 200]


def test_once_some_are_matched_batches_are_large(database, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(pycolmap, "match_image_pairs", lambda *_, **__: None)
    context = RunContext(scratch=tmp_path, progress=lambda _, done, total: told.append((done, total)))
    pairs = [("a", "b")] * 700
    # a batch costs its pairs, and to index its two images as much as four more
    done = sparse.match_pairs(database, pairs, context, total=0)
    assert sparse.match_pairs(database, pairs, context, done=done) == 720 + sparse.matching_work(pairs) == 1424
    assert told == [(0, 0), (44, 0), (128, 0), (292, 0), (616, 0), (720, 0), (720, 1424), (1424, 1424)]
    assert [len(b) for b in sparse.growing_batches(range(45), first=4, most=16)] == [4, 8, 16, 16, 1]


# --- the same matches, verified anew ---------------------------------------------------------------------------------


def test_matches_of_moved_keypoints_are_those_of_features_found_anew(tmp_path):
    desk = sorted((Path(__file__).parents[3] / "example_scenes" / "desk" / "frames").iterdir())[:3]
    names = [path.name for path in desk]
    options = MappingOptions(max_num_features=1500, first_octave=0, max_image_size=480)
    context, cameras = RunContext(scratch=tmp_path, num_threads=1), dict.fromkeys(names)
    pairs = sparse.image_pairs(names, options)

    def stage(keypoints):
        """Shifts a third of the features of one picture far away."""
        xy_px = keypoints.xy_px.copy()
        if keypoints.name == names[1]:
            xy_px[::3, 1] += 150
        return replace(keypoints, xy_px=xy_px)

    def found(stages, kind):
        database = tmp_path / f"{kind}.db"
        sparse.extract_features(desk[0].parent, cameras, database, options, keypoint_stages=stages, context=context)
        sparse.match_pairs(database, pairs, context)
        return database

    def read(database):
        with pycolmap.Database.open(str(database)) as opened:
            images = {image.name: image.image_id for image in opened.read_all_images()}
            views = [opened.read_two_view_geometry(images[a], images[b]) for a, b in pairs]
            return [np.array(opened.read_keypoints(images[name])) for name in names], [
                np.array(view.inlier_matches) for view in views
            ]

    plain, anew = found([], "plain"), found([stage], "anew")
    again = tmp_path / "again.db"
    sparse.verify_again(plain, again, pairs, [stage], context)
    for one, other in zip(read(again)[0], read(anew)[0], strict=True):
        assert np.array_equal(one, other)
    for one, other in zip(read(again)[1], read(anew)[1], strict=True):
        assert np.array_equal(one, other) and len(one) > 30
    # what moved is no longer believed
    assert len(read(again)[1][0]) < len(read(plain)[1][0])
