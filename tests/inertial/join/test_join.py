"""Sub-models of one recording in one world, by what the IMU felt between them."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from colmap_inertial import export_model, read_model, reconstruct_project
from colmap_inertial.cli.terminal import show_result
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, quat_rotate, so3_exp, so3_log
from colmap_inertial.core.options import JoinOptions, ProjectOptions, ReconstructOptions, ScaleOptions
from colmap_inertial.inertial.join.evidence import Evidence, find_links, find_shared
from colmap_inertial.inertial.join.grouping import join_submodels
from colmap_inertial.inertial.join.placement import FittedSubmodel, ImuLink, Problem, place_submodels
from colmap_inertial.inertial.join.relative_poses import end_images, tie_cov, worst_sigmas
from colmap_inertial.inertial.scale.posterior import CLOCK_RATE, DELAY, FittedPath
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.model import Model, trajectory_from_model, transform_model
from colmap_inertial.model.submodels.graph import PLACEMENT
from colmap_inertial.model.submodels.merging import merge_models
from colmap_inertial.run.stages.join import JoinStage
from colmap_inertial.run.stages.metric import MetricStage
from colmap_inertial.run.stages.refine import RefineStage
from colmap_inertial.tools.simulate.tracks import simulate_tracks
from colmap_inertial.tools.view.sources import find_source
from tests.helpers.json_schemas import find_violations
from tests.helpers.refine_walk import walk

UNKNOWN = calibration_prior()
LIMITS = JoinOptions()


def cut(tracks, spans, *, seed=0, noise_m=2e-3, noise_rad=5e-4):
    """The models of parts of a walk, each in a world and in units of its own, their poses a little off."""
    rng, t_s = np.random.default_rng(seed), tracks.timing.pose_t_s()
    out = []
    for begin_s, end_s in spans:
        model = tracks.reconstruction()
        for image_id in list(model.reg_image_ids()):
            image = model.image(image_id)
            if not begin_s <= t_s[image_id - 1] <= end_s:
                model.deregister_frame(image.frame_id)
                continue
            pose = image.cam_from_world()
            rotation = matrix_from_quat(quat_exp(noise_rad * rng.standard_normal(3))) @ pose.rotation.matrix()
            centre = image.projection_center() + noise_m * rng.standard_normal(3)
            moved = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
            model.frame(image.frame_id).set_cam_from_world(image.camera_id, moved)
        for point_id in list(model.point3D_ids()):
            if model.points3D[point_id].track.length() < 2:
                model.delete_point3D(point_id)
        turn = pycolmap.Rotation3d(quat_exp(rng.standard_normal(3)))
        model.transform(pycolmap.Sim3d(float(rng.uniform(0.3, 3.0)), turn, rng.standard_normal(3)))
        out.append(model)
    return out


@pytest.fixture(scope="module")
def walked():
    """A walk of 18 m with a phone."""
    return simulate_tracks(walk(18.0, points_per_m=30.0, vibration_m_s2=0.2), seed=3)


def project_of(tracks, models, folder):
    """A COLMAP project of models, and what was recorded along."""
    for i, model in enumerate(models):
        (folder / "sparse" / str(i)).mkdir(parents=True)
        model.write_binary(str(folder / "sparse" / str(i)))
    rows = [f"{name},{t_s:.9f}" for name, t_s in zip(tracks.timing.names, tracks.timing.t_s.tolist(), strict=True)]
    times, imu = folder.with_name("times.csv"), folder.with_name("imu")
    times.write_text("name,t_s\n" + "\n".join(rows) + "\n")
    imu.mkdir()
    for name, t_s, values in (
        ("gyroscope.txt", tracks.imu.gyro_t_s, tracks.imu.gyro_rad_s),
        ("accelerometer.txt", tracks.imu.accel_t_s, tracks.imu.accel_m_s2),
    ):
        stamps = np.rint((t_s + 1000) * 1e9).astype(np.int64)
        lines = [f"{t} {x:.8f} {y:.8f} {z:.8f}" for t, (x, y, z) in zip(stamps.tolist(), values, strict=True)]
        (imu / name).write_text("\n".join(lines) + "\n")
    return ProjectOptions(imu=imu, frame_times=times)


@pytest.fixture(scope="module")
def halves(walked):
    """The walk without a second in the middle: two metric models, and what the stage makes parts of them."""
    metric = MetricStage(imu=walked.imu, calibration=UNKNOWN)
    models = [
        metric(Model(reconstruction=model, colmap_index=i, timing=walked.timing))
        for i, model in enumerate(cut(walked, [(0.0, 9.2), (10.2, 18.0)]))
    ]
    stage = JoinStage(imu=walked.imu, calibration=UNKNOWN)
    return models, [stage.part(model) for model in models]


def across(tracks, parts, placed, link):
    """Error and covariance of the first image after a gap as seen from the last one before it: rotation, position."""
    poses = []
    for k, image in zip((link.first, link.second), end_images(parts, link), strict=True):
        part = parts[k]
        at = placed.points(k, part.trajectory.cam_in_world[image : image + 1])[0]
        poses.append((placed.places.rotation[k] @ part.world_from_cam[image], at, part.trajectory.t_s[image]))
    state = tracks.motion.at(np.array([t_s for _, _, t_s in poses]))
    true = matrix_from_quat(state.world_from_cam_xyzw)
    turn = poses[0][0].T @ poses[1][0] @ (true[0].T @ true[1]).T
    away = poses[0][0].T @ (poses[1][1] - poses[0][1]) - true[0].T @ np.diff(state.cam_in_world_m, axis=0)[0]
    return np.concatenate([poses[0][0] @ so3_log(turn), poses[0][0] @ away]), tie_cov(parts, placed, link)


def test_the_imu_places_one_part_in_the_world_of_the_other(walked, halves):
    _, parts = halves
    joined = join_submodels(parts, walked.imu, LIMITS)
    (gap,), (group,) = joined.gaps, joined.groups
    assert (gap.first, gap.second, gap.joined, gap.shared_images, gap.dof) == (0, 1, True, 0, 5)
    assert group.members == (0, 1)
    assert gap.seconds == pytest.approx(1.25, abs=0.01)
    error, cov = across(walked, parts, group.placed, find_links(parts)[0])
    assert np.linalg.norm(error[3:]) < 0.03 and np.degrees(np.linalg.norm(error[:3])) < 0.3
    for part in (slice(0, 3), slice(3, 6)):
        assert error[part] @ np.linalg.solve(cov[part, part], error[part]) < 11.3  # one in a hundred by chance
    assert group.placed.inflation == pytest.approx(max(1.0, gap.chi2 / gap.dof), rel=0.5)
    assert worst_sigmas(cov) == pytest.approx((gap.sigma_m, np.radians(gap.sigma_deg)), rel=1e-6)
    assert 0.002 < gap.sigma_m < 0.05
    # both were upright already, as well as each knew by itself
    held, other = group.placed.places.rotation
    assert np.array_equal(held, np.eye(3))
    assert np.degrees(np.arccos(other[2, 2])) < 1.5


def test_three_parts_become_one_across_one_and_two_seconds():
    tracks = simulate_tracks(walk(27.0, points_per_m=30.0, vibration_m_s2=0.2), seed=6)
    parts = []
    for k, model in enumerate(cut(tracks, [(0.0, 8.2), (9.2, 17.2), (19.2, 27.0)], seed=2)):
        trajectory, _ = trajectory_from_model(model, tracks.timing)
        path = FittedPath.of(trajectory, tracks.imu, None, ScaleOptions())
        parts.append(FittedSubmodel(number=k, trajectory=trajectory, path=path))
    joined = join_submodels(parts, tracks.imu, LIMITS)
    assert [(gap.first, gap.second, gap.joined) for gap in joined.gaps] == [(0, 1, True), (1, 2, True)]
    (group,) = joined.groups
    assert group.members == (0, 1, 2)
    for link, most_m in zip(find_links(parts), (0.04, 0.07), strict=True):
        error, cov = across(tracks, parts, group.placed, link)
        assert np.linalg.norm(error[3:]) < most_m and np.degrees(np.linalg.norm(error[:3])) < 0.4
        for part in (slice(0, 3), slice(3, 6)):
            assert error[part] @ np.linalg.solve(cov[part, part], error[part]) < 11.3


def test_whose_world_it_is_does_not_matter(walked, halves):
    _, parts = halves
    evidence = Evidence.of(parts, walked.imu)
    problems = [Problem(parts, evidence.streams, evidence.links, held=held) for held in (0, 1)]
    errors = [across(walked, parts, place_submodels(problem), evidence.links[0]) for problem in problems]
    # along the axes of either world
    for part in (slice(0, 3), slice(3, 6)):
        one, other = (float(np.linalg.norm(error[part])) for error, _ in errors)
        assert one == pytest.approx(other, abs=3e-4)
        one, other = (np.linalg.eigvalsh(cov[part, part]) ** 0.5 for _, cov in errors)
        assert one == pytest.approx(other, rel=0.03)


def test_the_equations_are_the_derivatives_of_their_squares(walked, halves):
    _, parts = halves
    evidence = Evidence.of(parts, walked.imu)
    problem = Problem(parts, evidence.streams, evidence.links)
    start = np.zeros(problem.size)
    start[PLACEMENT + 1 : 2 * PLACEMENT] = 0, 0, 0, 0.02, -0.03, 0.01
    state = replace(problem.start().moved(start), change=np.zeros(problem.size))
    equations = problem.equations(state, by_imu=True)
    clocks = [problem.own(k) + i for k in (0, 1) for i in (DELAY, CLOCK_RATE)]
    for column in range(problem.size):
        if column in range(1, PLACEMENT):
            continue  # the held part stays where it is
        step = np.zeros(problem.size)
        step[column] = 0.02 / equations.matrix[column, column] ** 0.5
        sides = [problem.equations(state.moved(sign * step), by_imu=True).squares for sign in (-1, 1)]
        slope, expected = 0.5 * (sides[1] - sides[0]), 2 * equations.gradient @ step
        # vibration makes differences by the stamps what they are
        assert expected == pytest.approx(slope, rel=0.1 if column in clocks else 0.02, abs=5e-3), column


def test_what_is_not_known_to_the_limits_stays_apart(subtests, walked, halves):
    for limits in (JoinOptions(sigma_m=1e-3), JoinOptions(sigma_deg=1e-3)):
        with subtests.test(limits=limits):
            joined = join_submodels(halves[1], walked.imu, limits)
            (gap,) = joined.gaps
            assert not joined.groups and not gap.joined
            assert "limit" in str(gap.reason) and ("cm" in str(gap.reason)) == (limits.sigma_m < 0.1)


def in_the_gap(imu, t_s):
    """Which stamps lie within the gap; the clocks of these walks are alike to some tens of milliseconds."""
    middle_s = 0.5 * (t_s[0] + t_s[-1]) + 0.8
    return np.abs(t_s - middle_s) < 0.2


def test_a_silent_imu_joins_nothing(walked, halves):
    imu = walked.imu
    kept = ~in_the_gap(imu, imu.gyro_t_s)
    silent = replace(imu, gyro_t_s=imu.gyro_t_s[kept], gyro_rad_s=imu.gyro_rad_s[kept])
    (gap,) = join_submodels(halves[1], silent, LIMITS).gaps
    assert not gap.joined and gap.sigma_m is None
    assert "the IMU recorded nothing for 0.3" in str(gap.reason)


def test_motion_that_the_imu_contradicts_stays_apart(subtests, walked, halves):
    for sensor in ("gyro", "accel"):
        with subtests.test(sensor=sensor):
            imu = walked.imu
            if sensor == "gyro":
                rates = imu.gyro_rad_s.copy()
                rates[in_the_gap(imu, imu.gyro_t_s)] += [0.3, 0.3, 0.0]
                other = replace(imu, gyro_rad_s=rates)
            else:
                forces = imu.accel_m_s2.copy()
                forces[in_the_gap(imu, imu.accel_t_s)] += [2.0, 1.0, 0.0]
                other = replace(imu, accel_m_s2=forces)
            (gap,) = join_submodels(halves[1], other, LIMITS).gaps
            assert not gap.joined
            assert "contradicts the motion before and after it" in str(gap.reason)
            assert gap.chi2 > 100 * gap.dof


@pytest.mark.parametrize("lost_s", [0.2, 0.02])
def test_a_clock_that_changes_in_the_gap_is_seen(walked, halves, lost_s):
    models, parts = halves
    imu = walked.imu
    middle_s = 0.5 * (imu.gyro_t_s[0] + imu.gyro_t_s[-1]) + 0.8

    def squeezed(t_s):
        # stamps lose the time little by little: no hole tells of it
        return t_s - 0.5 * np.clip(t_s - middle_s + 0.5 * lost_s, 0, 2 * lost_s)

    jumped = replace(imu, gyro_t_s=squeezed(imu.gyro_t_s), accel_t_s=squeezed(imu.accel_t_s))
    later = JoinStage(imu=jumped, calibration=UNKNOWN).part(models[1])
    (gap,) = join_submodels([parts[0], later], jumped, LIMITS).gaps
    assert not gap.joined
    assert "on the IMU's biases" in str(gap.reason) and "clock, which changed" in str(gap.reason)


def test_the_stage_makes_one_model_of_two(walked, halves):
    models, _ = halves
    stage = JoinStage(imu=walked.imu, calibration=UNKNOWN)
    (whole,), (gap,) = stage.join_models(models)
    assert gap.joined and stage(models[0]) is models[0]
    assert (whole.colmap_index, [part.colmap_index for part in whole.parts]) == (0, [0, 1])
    assert whole.reconstruction.num_reg_images() == sum(m.reconstruction.num_reg_images() for m in models)
    assert whole.treatments[-1].action == "joined"
    # in metres and upright: every centre where the truth has it, but for heading and place
    images = sorted((whole.reconstruction.image(i) for i in whole.reconstruction.reg_image_ids()), key=lambda i: i.name)
    centres = np.array([image.projection_center() for image in images])
    t_of = dict(zip(walked.timing.names, walked.timing.pose_t_s(), strict=True))
    truth = walked.motion.cam_in_world_m(np.array([t_of[image.name] for image in images]))
    a, b = centres - centres.mean(axis=0), truth - truth.mean(axis=0)
    heading = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a[:, :2] * b[:, :2]))
    turned = a @ so3_exp(np.array([0, 0, heading])).T
    assert np.sqrt(np.mean(np.sum((turned - b) ** 2, axis=1))) < 0.1
    # each part is COLMAP's model, moved by its similarity
    for part, model in zip(whole.parts, models, strict=True):
        inverse = pycolmap.Sim3d(
            model.similarity.scale, pycolmap.Rotation3d(model.similarity.rotation_xyzw), model.similarity.translation_m
        ).inverse()
        own = pycolmap.Reconstruction(model.reconstruction)
        own.transform(inverse)
        moved = transform_model(own, part.similarity)
        for image_id in list(moved.reg_image_ids())[::9]:
            name = moved.image(image_id).name
            there = whole.reconstruction.find_image_with_name(name).projection_center()
            assert moved.image(image_id).projection_center() == pytest.approx(there, abs=1e-6)
        # scale and up are no surer than those of the world
        assert part.similarity.cov[0, 0] ** 0.5 == pytest.approx(part.sigma_log, rel=1e-6)
        assert np.linalg.eigvalsh(part.similarity.cov[1:4, 1:4] - whole.similarity.cov[1:4, 1:4])[0] > -1e-12
    first, last = whole.parts
    assert (first.sigma_m, first.sigma_deg) == (0.0, 0.0)
    assert last.sigma_m > gap.sigma_m * 0.5 and last.begin_s - first.end_s == pytest.approx(gap.seconds)
    assert whole.scale.sigma_log <= models[0].scale.sigma_log * 1.001
    assert whole.scale.metres_per_unit == whole.similarity.scale
    assert np.linalg.norm(whole.scale.gravity_in_world_m_s2) == pytest.approx(9.8, abs=0.05)
    down = quat_rotate(whole.similarity.rotation_xyzw, whole.scale.gravity_in_world_m_s2)
    assert np.abs(down[:2]).max() < 1e-6 and down[2] < 0
    # and the refinement takes it as any other model
    refined = RefineStage(imu=walked.imu, calibration=UNKNOWN, refine_intrinsics=False)(whole)
    assert refined.treatments[-1].stage == "refine" and refined.treatments[-1].values["chi2"] < 3


def test_a_refused_model_stays_apart_and_so_does_one_alone(walked, halves):
    models, _ = halves
    stage = JoinStage(imu=walked.imu, calibration=UNKNOWN)
    refused = replace(models[1], similarity=None)
    kept, (gap,) = stage.join_models([models[0], refused])
    assert kept == (models[0], refused)
    assert not gap.joined and str(gap.reason) == "the scale of model 1 was refused"
    assert stage.join_models(models[:1]) == ((models[0],), ())
    none = [replace(model, similarity=None) for model in models]
    assert stage.join_models(none)[0] == tuple(none) and len(stage.join_models(none)[1]) == 1


def group_of(parts, tracks):
    (group,) = join_submodels(parts, tracks.imu, LIMITS).groups
    return group.placed


def test_images_that_both_have_tie_two_models(walked):
    spans = [(0.0, 10.6), (9.6, 18.0)]
    metric = MetricStage(imu=walked.imu, calibration=UNKNOWN)
    models = [
        metric(Model(reconstruction=model, colmap_index=i, timing=walked.timing))
        for i, model in enumerate(cut(walked, spans, seed=4))
    ]
    stage = JoinStage(imu=walked.imu, calibration=UNKNOWN)
    parts = [stage.part(model) for model in models]
    (shared,) = find_shared(parts)
    assert len(shared.images) == 4 and shared.equations <= 6 * 4
    # one that contradicts the others is left out
    wrong = parts[1].trajectory.cam_in_world.copy()
    wrong[shared.images[1, 1]] += 3.0
    spoiled = replace(parts[1], trajectory=replace(parts[1].trajectory, cam_in_world=wrong))
    assert len(find_shared([parts[0], spoiled])[0].images) == 3
    (whole,), (gap,) = stage.join_models(models)
    # both parts' fits have the readings of the overlap: they count once
    assert group_of(parts, walked).inflation >= (10.6 + 8.4 - 0.5) / 18.0
    assert gap.joined and gap.shared_images == 4 and gap.seconds < 0
    assert "4 shared images" in str(gap.reason)
    assert gap.sigma_m < 0.02
    assert whole.reconstruction.num_reg_images() == sum(m.reconstruction.num_reg_images() for m in models) - 4


def test_links_are_where_one_part_s_node_follows_another_s():
    def part(t_s):
        return SimpleNamespace(path=SimpleNamespace(nodes_s=np.array(t_s, dtype=float)))

    # a part in a hole of another one is tied at both ends
    around, inside = part([0, 1, 2, 8, 9]), part([4, 5, 6])
    assert find_links([around, inside]) == [
        ImuLink(first=0, second=1, from_node=2, to_node=0),
        ImuLink(first=1, second=0, from_node=2, to_node=3),
    ]
    # of frames that take turns, only the four shortest steps
    assert len(find_links([part(np.arange(0, 10, 1)), part(np.arange(0.3, 10, 1))])) == 4


def small_models():
    tracks = simulate_tracks(walk(3.0, points_per_m=20.0), seed=1)
    return cut(tracks, [(0.0, 1.6), (1.1, 3.0)], noise_m=0.0, noise_rad=0.0)


def same_images(first, second):
    names = [{one.image(i).name for i in one.reg_image_ids()} for one in (first, second)]
    return {(0, 1): names[0] & names[1]}


def test_models_become_one_with_every_observation_once():
    first, second = small_models()
    second.camera(1).params = first.camera(1).params * 1.001
    whole, points = merge_models([first, second], agreeing=same_images(first, second))
    names = {one.image(i).name for one in (first, second) for i in one.reg_image_ids()}
    assert {whole.image(i).name for i in whole.reg_image_ids()} == names
    # numbers are the database's, cameras that were refined apart stay apart
    for model in (first, second):
        for image_id in model.reg_image_ids():
            assert whole.image(image_id).name == model.image(image_id).name
    assert sorted(whole.cameras) == [1, 2]
    new = [i for i in second.reg_image_ids() if i not in set(first.reg_image_ids())]
    assert {whole.image(i).camera_id for i in new} == {2}
    assert np.array_equal(whole.camera(2).params, second.camera(1).params)
    # first's points and poses are untouched, and what is seen is seen once, both ways
    for point_id in first.point3D_ids():
        assert np.array_equal(whole.points3D[points[0][point_id]].xyz, first.points3D[point_id].xyz)
    assert whole.num_points3D() > first.num_points3D()
    elements = [(e.image_id, e.point2D_idx) for p in whole.points3D.values() for e in p.track.elements]
    assert len(set(elements)) == len(elements)
    for point_id, point in whole.points3D.items():
        for element in point.track.elements:
            assert whole.image(element.image_id).points2D[element.point2D_idx].point3D_id == point_id


def test_of_an_image_whose_poses_differ_only_the_first_one_s_observations_stay():
    first, second = small_models()
    (both,) = same_images(first, second).values()
    wrong = sorted(both)[1]
    whole, _ = merge_models([first, second], agreeing={(0, 1): both - {wrong}})
    every, _ = merge_models([first, second], agreeing={(0, 1): both})
    image_id = first.find_image_with_name(wrong).image_id
    assert whole.image(image_id).num_points3D == first.image(image_id).num_points3D
    assert every.image(image_id).num_points3D > first.image(image_id).num_points3D
    # keypoints that are elsewhere, along either side, are others
    for axis in (0, 1):
        _, moved = small_models()
        for point in moved.image(image_id).points2D:
            point.xy = point.xy + 5 * np.eye(2)[axis]
        apart, _ = merge_models([first, moved], agreeing={(0, 1): both})
        assert apart.image(image_id).num_points3D == first.image(image_id).num_points3D
    # a third model's owner is the one whose pose stayed
    other, _ = merge_models([first, second, second], agreeing={(0, 1): both, (1, 2): both})
    assert other.num_points3D() == every.num_points3D()


def test_numbers_that_clash_become_new_ones(tmp_path):
    first, second = small_models()
    for image_id in second.reg_image_ids():
        second.image(image_id).name = f"other-{second.image(image_id).name}"
    whole, _ = merge_models([first, second], agreeing={})
    assert whole.num_reg_images() == first.num_reg_images() + second.num_reg_images()
    assert whole.num_points3D() == first.num_points3D() + second.num_points3D()
    whole.write_binary(str(tmp_path))
    again = read_model(tmp_path)
    assert again.num_reg_images() == whole.num_reg_images()
    assert len(again.cameras) == 1


def test_limits_are_positive(subtests):
    for wrong in ({"sigma_m": 0.0}, {"sigma_deg": -1.0}):
        with subtests.test(wrong=wrong), pytest.raises(ValueError, match="must be positive"):
            JoinOptions(**wrong)


def test_a_project_of_two_models_becomes_one(walked, tmp_path, capsys):
    models = cut(walked, [(0.0, 9.2), (10.2, 18.0)])
    source = project_of(walked, models, tmp_path / "project")
    out = tmp_path / "out"
    result = reconstruct_project(tmp_path / "project", out, source, ReconstructOptions())
    (gap,), (one,) = result.gaps, result.models
    assert gap.joined and str(gap.reason) == "joined by the IMU"
    whole = read_model(out / "sparse" / "0")
    assert whole.num_reg_images() == sum(model.num_reg_images() for model in models) == one.summary["registered_images"]
    # the parts by themselves stand where the project's numbers have them, in the same world
    part = read_model(out / "sparse" / "1")
    for image_id in list(part.reg_image_ids())[::7]:
        there = whole.find_image_with_name(part.image(image_id).name).projection_center()
        assert part.image(image_id).projection_center() == pytest.approx(there, abs=1e-6)
    said = json.loads((out / "result.json").read_text())
    assert [part["colmap_index"] for part in said["models"][0]["joined_of"]] == [0, 1]
    for name in ("result", "report"):
        assert find_violations(name, out / f"{name}.json") == []
    assert said["gaps"][0]["joined"] and said["gaps"][0]["sigma_m"] == gap.sigma_m
    path = (out / "trajectory.tum").read_text().splitlines()
    assert len([line for line in path if not line.startswith("#")]) == whole.num_reg_images()
    assert "Gaps between COLMAP" in (out / "report.html").read_text()
    show_result(result, tmp_path / "project")
    assert "COLMAP's models 0, 1; 1 sigma across: 1." in " ".join(capsys.readouterr().out.split())
    # what is by itself in the project, too, keeps its shape
    assert "not refined: the project also holds its parts" in said["models"][0]["treatments"][-1]["reason"]
    # what reads models reads this one
    assert find_source(out).index == 0
    made = export_model(out, tmp_path / "path", "tum")
    assert (made.model, made.unit) == (0, "m")
    # asked not to, they stay apart
    apart = reconstruct_project(
        tmp_path / "project", out, source, ReconstructOptions(join="off", refine="off"), overwrite=True
    )
    assert [model.colmap_index for model in apart.models] == [0, 1] and apart.gaps == ()
    assert read_model(out / "sparse" / "0").num_reg_images() == models[0].num_reg_images()
