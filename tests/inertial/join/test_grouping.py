"""Parts that must stay apart: poses, motion or mounting of which contradict each other."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_exp, quat_multiply, quat_rotate
from colmap_inertial.core.options import JoinOptions, ScaleOptions
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.inertial.join.evidence import find_links
from colmap_inertial.inertial.join.grouping import join_submodels
from colmap_inertial.inertial.join.joined_model import _sigma_log
from colmap_inertial.inertial.join.placement import FittedSubmodel
from colmap_inertial.inertial.join.relative_poses import tie_cov, worst_sigmas
from colmap_inertial.inertial.scale.posterior import FittedPath
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.run.stages.join import _cameras
from colmap_inertial.tools.simulate.tracks import simulate_tracks
from tests.helpers.refine_walk import walk

LIMITS = JoinOptions()
T_S = 0.3 + np.arange(29 * 15) / 15


@pytest.fixture(scope="module")
def walked():
    """A walk of 30 m with a phone, hardly anything seen of it."""
    return simulate_tracks(walk(30.0, points_per_m=2.0, vibration_m_s2=0.2), seed=3)


def part_of(tracks, t_s, number, *, shifted=None, shift_m=(0.0, 0.0, 0.0), mounted_m=(0.0, 0.0, 0.0)):
    """The true poses with a little noise in a world of its own, some of them shifted; the camera mounted elsewhere."""
    rng = np.random.default_rng(number)
    state = tracks.motion.at(t_s)
    centre = state.cam_in_world_m + matrix_from_quat(state.world_from_cam_xyzw) @ np.array(mounted_m)
    if shifted is not None:
        centre[shifted] += shift_m
    cam_from_world = quat_conjugate(np.asarray(state.world_from_cam_xyzw))
    cam_from_world = quat_multiply(quat_exp(5e-4 * rng.standard_normal((len(t_s), 3))), cam_from_world)
    turn = quat_exp(rng.standard_normal(3))
    path = CameraTrajectory(
        names=tuple(f"{t:.4f}" for t in t_s),
        t_s=t_s,
        cam_from_world_xyzw=quat_multiply(cam_from_world, quat_conjugate(turn)),
        cam_in_world=quat_rotate(turn, centre + 2e-3 * rng.standard_normal((len(t_s), 3))),
        epoch_ns=tracks.timing.epoch_ns,
        length_unit="m",
    )
    fitted = FittedPath.of(path, tracks.imu, calibration_prior(), ScaleOptions())
    return FittedSubmodel(number=number, trajectory=path, path=fitted)


@pytest.fixture(scope="module")
def inside(walked):
    """What lies in the hole of another part."""
    return part_of(walked, T_S[(T_S > 10) & (T_S < 18)], 1)


@pytest.mark.parametrize("shift_m", [0.0, 0.3])
def test_a_part_in_a_hole_is_held_to_the_poses_on_both_sides(walked, inside, shift_m):
    t_s = np.concatenate([T_S[T_S < 9], T_S[T_S > 19]])
    around = part_of(walked, t_s, 0, shifted=t_s > 15, shift_m=(shift_m, 0, 0))
    joined = join_submodels([around, inside], walked.imu, LIMITS)
    (gap,) = joined.gaps
    assert 1.0 < gap.seconds < 1.2
    assert gap.joined == (shift_m == 0)
    if shift_m:
        assert "the poses before and after the gap contradict" in str(gap.reason)
    else:
        (group,) = joined.groups
        parts = [around, inside]
        sigmas = [worst_sigmas(tie_cov(parts, group.placed, link))[0] for link in find_links(parts)]
        assert gap.sigma_m == pytest.approx(max(sigmas))


@pytest.mark.parametrize("shift_m", [0.0, 1.0])
def test_parts_that_two_by_two_agree_are_joined_only_where_all_agree(walked, inside, shift_m):
    t_s = np.concatenate([T_S[(T_S > 3.5) & (T_S < 8.5)], T_S[T_S > 19]])
    last = part_of(walked, t_s, 2, shifted=t_s < 10, shift_m=(shift_m, 0, 0))
    parts = [part_of(walked, T_S[T_S < 9], 0), inside, last]
    joined = join_submodels(parts, walked.imu, LIMITS)
    assert [group.members for group in joined.groups] == ([(0, 1, 2)] if not shift_m else [(0, 2)])


def test_an_error_of_the_imu_within_the_gap_does_not_become_one_of_the_scale(walked):
    parts = [part_of(walked, T_S[T_S < 8], 0), part_of(walked, T_S[(T_S > 9) & (T_S < 13.5)], 1)]
    ends = [parts[0].path.stamps_s(np.array([len(parts[0].path.nodes_s) - 1])), parts[1].path.stamps_s(np.array([0]))]
    middle_s = 0.5 * float(ends[0][0] + ends[1][0])
    for wrong in (0.3, -0.3):
        forces = walked.imu.accel_m_s2.copy()
        forces[np.abs(walked.imu.accel_t_s - middle_s) < 0.2] += [wrong, 0, 0]
        (gap,) = join_submodels(parts, replace(walked.imu, accel_m_s2=forces), LIMITS).gaps
        assert not gap.joined and "contradicts the motion" in str(gap.reason)


def test_two_cameras_are_not_one_device(subtests, walked):
    for mounted_m in (0.0, 0.11):
        with subtests.test(mounted_m=mounted_m):
            first = part_of(walked, T_S[T_S < 8.5], 0)
            other = part_of(walked, T_S[(T_S > 9.5) & (T_S < 17)], 1, mounted_m=(mounted_m, 0, 0))
            (gap,) = join_submodels([first, other], walked.imu, LIMITS).gaps
            assert gap.joined == (mounted_m == 0)
            assert gap.joined or "mounted differently on the IMU" in str(gap.reason)


def test_ties_that_are_off_never_widen_a_scale_beyond_its_own():
    model = SimpleNamespace(scale=SimpleNamespace(sigma_log=0.01))
    part = SimpleNamespace(path=SimpleNamespace(scale=(1.0, 6e-5)))
    for inflation, sigma_log in ((50.0, 0.01), (1.0, 6e-5**0.5)):
        placed = SimpleNamespace(inflation=inflation, cov=2e-5 * np.eye(14))
        assert _sigma_log(model, part, placed, 1) == pytest.approx(sigma_log)


def test_frames_by_turns_are_no_surer_than_all_of_them(walked):
    t_s = T_S[T_S < 17]
    halves = [part_of(walked, t_s[k::2], k) for k in (0, 1)]
    joined = join_submodels(halves, walked.imu, LIMITS)
    (group,) = joined.groups
    placed = group.placed
    assert placed.inflation > 1.9
    own = part_of(walked, t_s, 2).path.scale[1]
    for k in (0, 1):
        assert min(placed.inflation * placed.cov[7 * k, 7 * k], halves[k].path.scale[1]) > 0.8 * own


def test_pictures_of_two_cameras_stay_apart(walked):
    first = part_of(walked, T_S[T_S < 8.5], 0)
    other = part_of(walked, T_S[(T_S > 9.5) & (T_S < 17)], 1)
    for cameras, joined in (((), True), (("1", "2"), True), (("2",), False)):
        parts = [replace(first, cameras=frozenset({"1"})), replace(other, cameras=frozenset(cameras))]
        (gap,) = join_submodels(parts, walked.imu, LIMITS).gaps
        assert gap.joined == joined
        assert joined or "different cameras" in str(gap.reason)


def test_images_that_lie_otherwise_in_either_part_keep_them_apart(walked):
    first = part_of(walked, T_S[T_S < 9.5], 0)
    t_s = T_S[(T_S > 8.5) & (T_S < 17)]
    other = part_of(walked, t_s, 1)
    both = int((t_s < 9.5).sum())
    # a third of them turned, a third elsewhere
    third = both // 3 + 1
    cam_from_world, centres = other.trajectory.cam_from_world_xyzw.copy(), other.trajectory.cam_in_world.copy()
    cam_from_world[:third] = quat_multiply(quat_exp(np.array([0, 0.2, 0])), cam_from_world[:third])
    centres[third : 2 * third] += [0.5, 0, 0]
    moved = replace(other.trajectory, cam_from_world_xyzw=cam_from_world, cam_in_world=centres)
    other = replace(other, trajectory=moved)
    (gap,) = join_submodels([first, other], walked.imu, LIMITS).gaps
    assert not gap.joined
    assert str(gap.reason) == f"the {both} images in both models have different relative poses in the two"


def test_two_models_of_one_piece_are_not_joined(walked):
    parts = [part_of(walked, T_S[T_S < 9.5], 0), part_of(walked, T_S[T_S < 8.5], 1)]
    (gap,) = join_submodels(parts, walked.imu, LIMITS).gaps
    assert not gap.joined and "two models of the same part" in str(gap.reason)


def test_cameras_are_told_apart_by_number_and_by_folder():
    def names_of(images):
        at = dict(enumerate(images))
        model = SimpleNamespace(
            reg_image_ids=lambda: list(at), image=lambda i: SimpleNamespace(camera_id=at[i][0], name=at[i][1])
        )
        return _cameras(model)

    assert names_of([(1, "a.jpg"), (1, "b.jpg"), (2, "c.jpg"), (1, "d.jpg")]) == {"1", "2"}
    # one to an image: they say nothing, folders do
    assert names_of([(1, "left/a.jpg"), (2, "left/b.jpg"), (3, "left/c.jpg")]) == {"left/"}
    assert names_of([(7, "a.jpg")]) == {"7"}
