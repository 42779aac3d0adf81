"""The stage that refines a metric model, and when it does not."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from jsonschema import Draft202012Validator

from colmap_inertial import read_model, reconstruct_project
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, so3_log
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions, ScaleOptions
from colmap_inertial.core.types import CameraModel, CameraMotion, Similarity
from colmap_inertial.inertial.core.priors import PRIORS, model_scale_sigma
from colmap_inertial.inertial.refine import motion, refinement
from colmap_inertial.inertial.refine.shutter import SeenReadout
from colmap_inertial.inertial.refine.solve import evaluate_held_out, solve
from colmap_inertial.inertial.refine.values import ROTATION
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import read_record
from colmap_inertial.io.recording import Recording
from colmap_inertial.io.trajectories import read_tum
from colmap_inertial.model import Model, transform_model
from colmap_inertial.model.layout import find_made_from, read_layout
from colmap_inertial.run.commands import frames
from colmap_inertial.run.commands.frames import stages_of_refined
from colmap_inertial.run.commands.scale import ScaleSource, scale_source
from colmap_inertial.run.stages import refine as refine_stage
from colmap_inertial.run.stages.defaults import default_model_stages
from colmap_inertial.run.stages.imaging_plan import GyroView
from colmap_inertial.run.stages.inputs import StageInputs
from colmap_inertial.run.stages.join import JoinStage
from colmap_inertial.run.stages.metric import MetricStage, gravity_in_model
from colmap_inertial.run.stages.readout import ReadoutStage
from colmap_inertial.run.stages.refine import RefineStage, axes_by
from colmap_inertial.run.stages.rolling_shutter import RollingShutterStage
from colmap_inertial.run.steps.hashing import as_json_types
from colmap_inertial.tools.simulate.tracks import TrackOptions
from tests.helpers.json_schemas import read_schema
from tests.helpers.refine_walk import problem_of, tracks_of, walk

UNKNOWN = calibration_prior()


def adjusted(model, *, keeps_intrinsics=False):
    """COLMAP's bundle adjustment."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_principal_point = False
    options.refine_focal_length = options.refine_extra_params = not keeps_intrinsics
    getattr(options, "ceres", options).solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    return model


def centres_of(model):
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    return np.array([image.projection_center() for image in images])


def names_of(model):
    return {model.image(i).name for i in model.reg_image_ids()}


def error_of(centres, truth):
    """Root mean square after a similarity."""
    return float(np.sqrt(np.mean(np.sum(fitted(centres, truth)[1] ** 2, axis=1))))


def fitted(centres, truth):
    """Scale (Umeyama), and (N, 3) what is left."""
    a, b = centres - centres.mean(0), truth - truth.mean(0)
    turned = a @ umeyama(centres, truth).T
    scale = np.sum(turned * b) / np.sum(a**2)
    return scale, scale * turned - b


def umeyama(centres, truth):
    """(3, 3) rotation that takes centres to the truth."""
    u, _, vt = np.linalg.svd((truth - truth.mean(0)).T @ (centres - centres.mean(0)))
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt


def two_cameras(model, second):
    """A model of which some images are those of a second camera."""
    built = pycolmap.Reconstruction()
    for camera_id in (1, 2):
        built.add_camera_with_trivial_rig(pycolmap.Camera(**{**model.camera(1).todict(), "camera_id": camera_id}))
    image_ids = sorted(model.reg_image_ids())
    of_second = set(image_ids[second])
    for image_id in image_ids:
        old = model.image(image_id)
        keypoints = np.array([point.xy for point in old.points2D])
        camera_id = 2 if image_id in of_second else 1
        image = pycolmap.Image(name=old.name, keypoints=keypoints, camera_id=camera_id, image_id=image_id)
        built.add_image_with_trivial_frame(image, old.cam_from_world())
    for point in model.points3D.values():
        built.add_point3D(point.xyz, point.track)
    return built


def focused(times):
    """The walks' camera with another focal length."""
    return {"params": np.array(TrackOptions().camera.params) * np.array([times, times, 1, 1, 1, 1, 1, 1])}


def camera_for_each(model, camera_of, name_of):
    """A model in which each image has a camera of its own, and its timing; by the images' places in time."""
    old, built, names = model.reconstruction, pycolmap.Reconstruction(), {}
    for i, image_id in enumerate(sorted(old.reg_image_ids())):
        image = old.image(image_id)
        numbers = {**old.camera(1).todict(), **camera_of(i), "camera_id": i + 1}
        built.add_camera_with_trivial_rig(pycolmap.Camera(**numbers))
        keypoints = np.array([point.xy for point in image.points2D])
        names[image.name] = name_of(i)
        one = pycolmap.Image(name=names[image.name], keypoints=keypoints, camera_id=i + 1, image_id=image_id)
        built.add_image_with_trivial_frame(one, image.cam_from_world())
    for point in old.points3D.values():
        built.add_point3D(point.xyz, point.track)
    return built, replace(model.timing, names=tuple(names.get(name, name) for name in model.timing.names))


@pytest.fixture(scope="module")
def mapped():
    """A walk of 25 m, and COLMAP's model of it. Tests must not change it."""
    tracks = tracks_of(walk(25.0, points_per_m=50.0))
    return tracks, adjusted(tracks.reconstruction())


@pytest.fixture(scope="module")
def walked(mapped):
    """The walk, and its model in metres."""
    tracks, reconstruction = mapped
    model = Model(reconstruction=reconstruction, colmap_index=0, timing=tracks.timing)
    return tracks, MetricStage(imu=tracks.imu, calibration=UNKNOWN)(model)


@pytest.fixture(scope="module")
def rolled():
    """A walk of 16 m with a rolling shutter, keypoints rectified, and COLMAP's model of it in metres."""
    tracks = tracks_of(walk(16.0, readout_s=0.025, points_per_m=80.0))
    known = calibration_prior(Declared(readout_s=0.025))
    view = GyroView(
        imu=tracks.imu, timing=tracks.timing, calibration=tracks.calibration, camera=tracks.camera, source="capture"
    )
    shutter, xy_px = RollingShutterStage(view=view), tracks.xy_px.copy()
    for i, name in enumerate(tracks.timing.names):
        xy_px[tracks.frame == i] = shutter.moved(name, xy_px[tracks.frame == i])
    model = Model(
        reconstruction=adjusted(tracks.reconstruction(xy_px)), colmap_index=0, timing=tracks.timing, rectified=True
    )
    model = ReadoutStage(imu=tracks.imu, calibration=known, refine_intrinsics=False, num_threads=1)(model)
    return tracks, shutter, known, MetricStage(imu=tracks.imu, calibration=known)(model)


@pytest.fixture(scope="module")
def bent(rolled):
    """COLMAP's model of keypoints that keep their rolling shutter. Tests must not change it."""
    return adjusted(rolled[0].reconstruction())


def refined_by(imu, model, **fields):
    stage = RefineStage(**{"imu": imu, "calibration": UNKNOWN, "refine_intrinsics": False, **fields})
    made = stage(model)
    return made, made.treatments[-1]


@pytest.fixture(scope="module")
def refined(walked):
    tracks, model = walked
    return refined_by(tracks.imu, model)


def test_a_walk_bends_less(walked, refined):
    tracks, model = walked
    made, said = refined
    truth = tracks.motion.cam_in_world_m(tracks.timing.pose_t_s())
    before, after = centres_of(model.reconstruction), centres_of(made.reconstruction)
    assert said.action == "refined"
    assert error_of(after, truth) < 0.9 * error_of(before, truth)
    assert said.values["after_px"] < said.values["before_px"]
    assert said.values["chi2"] < 1.5
    assert len(said.values["drift"]) == 2
    form = Draft202012Validator(read_schema("result").schema["$defs"]["refine"])
    assert [error.message for error in form.iter_errors(json.loads(json.dumps(said.values)))] == []
    assert str(made.scale.notes[-1]) == f"the model was {said.reason}"
    json.dumps(said.values)
    # the model is as whole as before
    assert made.reconstruction.compute_num_observations() == model.reconstruction.compute_num_observations()
    assert made.reconstruction.compute_mean_reprojection_error() < 0.7
    # up stays nearly where it was, as each camera sees it
    old, new = (
        np.array([image.cam_from_world().rotation.matrix()[:, 2] for _, image in sorted(one.images.items())])
        for one in (model.reconstruction, made.reconstruction)
    )
    assert np.degrees(np.linalg.norm(new - old, axis=1)).max() < 1
    assert np.degrees(np.linalg.norm((new - old).mean(axis=0))) < 0.3


def test_the_calibration_is_the_refined_one(walked, refined):
    tracks, _ = walked
    made, _ = refined
    found, true = made.scale.calibration, tracks.calibration
    assert found.gyro_time_offset_s == pytest.approx(true.gyro_time_offset_s, abs=3e-4)
    assert np.abs(found.imu_in_cam_m - true.imu_in_cam_m).max() < 4 * max(
        found.sigma(f"imu_in_cam_{axis}_m") for axis in "xyz"
    )


@pytest.mark.parametrize("factor", [1.0, 1.01, 0.9])
def test_a_refined_model_has_the_scale_and_up_of_the_refinement(walked, factor):
    """Whatever those were that it started from; one beyond what it started from is weak, and says why."""
    tracks, model = walked
    first = model.scale.accepted
    wrong = Similarity(
        scale=factor,
        rotation_xyzw=quat_exp(np.array([0.01, 0.0, 0.0])),
        translation_m=np.zeros(3),
        cov=np.zeros((7, 7)),
    )
    scale = replace(
        model.scale,
        metres_per_unit=factor * first.metres_per_unit,
        ci95=(factor * first.ci95[0], factor * first.ci95[1]),
        reasons=("a doubt",) if factor == 1.01 else (),
    )
    # gravity stands where it stood, the model does not
    start = replace(model, reconstruction=transform_model(model.reconstruction, wrong), scale=scale)
    start = replace(start, similarity=replace(model.similarity, scale=scale.metres_per_unit))
    made, said = refined_by(tracks.imu, start)
    estimate, truth = made.scale, tracks.motion.cam_in_world_m(tracks.timing.pose_t_s())
    centres = centres_of(made.reconstruction)
    size, _ = fitted(centres, truth)
    assert abs(np.log(size)) < 3 * estimate.sigma_log < 0.03
    assert said.values["size_before"] == pytest.approx(scale.metres_per_unit / estimate.metres_per_unit)
    assert estimate.metres_per_unit == made.similarity.scale
    assert estimate.ci95[0] < estimate.metres_per_unit < estimate.ci95[1]
    assert sum(sigma**2 for sigma in estimate.parts.values()) == pytest.approx(estimate.sigma_log**2)
    assert estimate.cov[0, 0] == pytest.approx(estimate.sigma_log**2) == made.similarity.cov[0, 0]
    # up, as the walk has it; uncertainty cannot be determined, by its noise
    turn = umeyama(centres, truth)
    down = gravity_in_model(made) / np.linalg.norm(gravity_in_model(made))
    tilt_rad = np.linalg.norm(np.cross(turn @ down, [0, 0, -1]))
    sigma_rad = np.sqrt(np.trace(made.similarity.cov[1:4, 1:4]))
    assert tilt_rad < 4 * sigma_rad < 0.02
    left = [reason for reason in estimate.reasons if reason.code == "refined-scale-differs"]
    assert bool(left) == (factor == 0.9)
    assert estimate.verdict == ("trusted" if factor == 1.0 else "weak")
    assert (Fact.stated("a doubt") in estimate.reasons) == (factor == 1.01)


def test_a_sensor_s_own_axes_are_surer_than_the_imu_s(walked, refined):
    tracks, _ = walked
    made, said = refined
    rotation, gyro, accel = (np.array(said.values[f"{n}_sigma_deg"]) for n in ("rotation", "gyro_axes", "accel_axes"))
    # axis errors that both sensors share turn the IMU: their priors, of both sensors together
    shared_deg = np.degrees((2 / PRIORS.gyro_gain**2 + 2 / PRIORS.accel_gain**2) ** -0.5)
    assert rotation == pytest.approx(np.full(3, shared_deg), rel=0.1)
    assert np.all(gyro < 0.1 * rotation) and np.all(gyro < accel) and np.all(accel < 0.5 * rotation)
    gains = [np.array(said.values[f"{sensor}_gain"]) for sensor in ("gyro", "accel")]
    found, true = made.scale.calibration, tracks.calibration
    for gain, matrix, sigma_deg in (
        (gains[0], tracks.sampled.errors.gyro_matrix, gyro),
        (gains[1], tracks.sampled.errors.accel_matrix, accel),
    ):
        turns = []
        for calibration, errors in ((found, np.eye(3) + gain), (true, np.linalg.inv(np.eye(3) + matrix))):
            u, _, vt = np.linalg.svd(matrix_from_quat(calibration.cam_from_imu_xyzw) @ errors)
            turns.append(u @ vt)
        assert np.all(np.abs(np.degrees(so3_log(turns[0] @ turns[1].T))) < 4 * sigma_deg)


def test_derivatives_of_a_sensor_s_axes_are_those_of_finite_differences(walked):
    tracks, _ = walked
    x = problem_of(tracks, walk(25.0, points_per_m=50.0))[1]
    rng = np.random.default_rng(5)
    for sensor in ("gyro_gain", "accel_gain"):
        columns = getattr(x.columns, sensor)
        step = np.zeros(x.columns.count)
        step[ROTATION], step[columns] = 1e-5 * rng.standard_normal(3), 1e-5 * rng.standard_normal(9)
        ends = []
        for sign in (1, -1):
            moved = x.moved(np.zeros((len(x.velocity_m_s), 15)), sign * step, np.zeros_like(x.points_m))
            u, _, vt = np.linalg.svd(moved.cam_from_imu @ (np.eye(3) + getattr(moved, sensor)))
            ends.append(u @ vt)
        turned = 0.5 * so3_log(ends[0] @ ends[1].T)
        assert axes_by(x, columns) @ step == pytest.approx(turned, rel=1e-6, abs=1e-12)


def test_a_run_goes_on_from_no_older_layout(walked):
    tracks, _ = walked
    stage = RefineStage(imu=tracks.imu, calibration=UNKNOWN, refine_intrinsics=False)
    assert as_json_types(replace(stage)) == as_json_types(stage)
    older = replace(stage)
    object.__setattr__(older, "_writes", stage._writes - 1)
    assert as_json_types(older) != as_json_types(stage)


def test_a_rolling_shutter_is_part_of_it(rolled):
    tracks, shutter, known, model = rolled
    made, said = refined_by(tracks.imu, model, calibration=known, shutter=shutter)
    truth = tracks.motion.cam_in_world_m(tracks.timing.pose_t_s())
    assert said.action == "refined"
    # an image that lies far off is left out with the scale
    kept = [name in names_of(made.reconstruction) for name in tracks.timing.names]
    before, after = (error_of(centres_of(m.reconstruction), truth[kept]) for m in (model, made))
    assert sum(kept) >= len(kept) - 1 and after < min(0.006, 1.1 * before)
    assert said.values["readout_s"] == pytest.approx(0.025, rel=0.03)
    assert made.motion.readout_s == said.values["readout_s"] != made.timing.readout_s
    assert not made.observed_px


@pytest.mark.parametrize("declared", [True, False])
def test_a_readout_is_refined_with_where_images_keep_their_rolling_shutter(rolled, bent, declared):
    """Known or found; keypoints stay as they are."""
    tracks, _, known, _ = rolled
    timing = replace(tracks.timing, readout_s=0.025 if declared else None)
    start = Model(reconstruction=bent, colmap_index=0, timing=timing)
    calibration = known if declared else UNKNOWN
    model = MetricStage(imu=tracks.imu, calibration=calibration)(start)
    # without the refinement, nothing rests on a model that is bent
    doubt = model.treatments[-1]
    assert (doubt.stage, doubt.values["direction"]) == ("shutter", "down")
    assert abs(doubt.values["readout_s"] - 0.025) < 3 * doubt.values["sigma_s"] < 0.006
    assert model.scale.verdict == "weak" and doubt.reason in model.scale.reasons
    assert model.similarity.cov[0, 0] == pytest.approx(sum(part**2 for part in model.scale.parts.values()))
    made, said = refined_by(tracks.imu, model, calibration=calibration)
    assert said.action == "refined" and doubt.reason not in made.scale.reasons
    assert "rolling_shutter" not in made.scale.parts
    assert said.values["readout_s"] == pytest.approx(0.025, rel=0.03)
    assert "images and keypoints keep their rolling shutter of 2" in str(said.reason)
    assert made.motion.readout_s == said.values["readout_s"]
    truth = tracks.motion.cam_in_world_m(tracks.timing.pose_t_s())
    assert error_of(centres_of(made.reconstruction), truth) < 0.5 * error_of(centres_of(start.reconstruction), truth)
    for image_id in made.reconstruction.reg_image_ids():
        before, after = (
            np.array([p.xy for p in one.image(image_id).points2D])
            for one in (start.reconstruction, made.reconstruction)
        )
        assert np.array_equal(before, after)


@pytest.mark.parametrize("readout_s", [None, 0.025])
def test_lines_that_run_otherwise_than_assumed_stay_a_doubt(rolled, bent, readout_s):
    """The refinement takes them to run as declared, and finds no such readout."""
    tracks, _, _, _ = rolled
    timing = replace(tracks.timing, readout_s=readout_s, readout_direction="right")
    start = Model(reconstruction=bent, colmap_index=0, timing=timing)
    model = MetricStage(imu=tracks.imu, calibration=UNKNOWN)(start)
    made, _ = refined_by(tracks.imu, model)
    assert model.treatments[-1].values["direction"] == "down"
    assert made.scale.verdict == "weak" and model.treatments[-1].reason in made.scale.reasons


def test_a_global_shutter_that_nobody_declared_costs_no_trust(walked):
    tracks, model = walked
    assert tracks.timing.readout_s is None and model.scale.verdict == "trusted" and model.treatments == ()
    assert 0 < model.scale.parts["rolling_shutter"] < 1e-3
    # a declared one is believed where nothing contradicts it
    start = Model(reconstruction=model.reconstruction, colmap_index=0, timing=replace(tracks.timing, readout_s=0.0))
    judged = MetricStage(imu=tracks.imu, calibration=UNKNOWN).judge_shutter(start, model.scale)
    assert judged.scale is model.scale


def test_a_declared_global_shutter_that_the_images_contradict_is_named(rolled, bent):
    tracks, _, _, _ = rolled
    start = Model(reconstruction=bent, colmap_index=0, timing=replace(tracks.timing, readout_s=0.0))
    model = MetricStage(imu=tracks.imu, calibration=calibration_prior(Declared(readout_s=0.0)))(start)
    assert model.scale.verdict == "weak"
    (found,) = (reason for reason in model.scale.reasons if reason.code == "rolling-shutter-ignored")
    assert found.values["declared_global"] and found.values["readout_s"] == pytest.approx(0.025, rel=0.2)
    assert model.treatments[-1].reason == found


@pytest.mark.parametrize("times", [1.0, 0.5, 1.6])
def test_a_declared_readout_that_rectified_keypoints_contradict_is_named(rolled, times):
    tracks = rolled[0]
    declared_s = times * 0.025
    timing, known = replace(tracks.timing, readout_s=declared_s), calibration_prior(Declared(readout_s=declared_s))
    view = GyroView(
        imu=tracks.imu, timing=timing, calibration=tracks.calibration, camera=tracks.camera, source="capture"
    )
    shutter, xy_px = RollingShutterStage(view=view), tracks.xy_px.copy()
    for i, name in enumerate(timing.names):
        xy_px[tracks.frame == i] = shutter.moved(name, xy_px[tracks.frame == i])
    start = Model(reconstruction=adjusted(tracks.reconstruction(xy_px)), colmap_index=0, timing=timing, rectified=True)
    start = ReadoutStage(imu=tracks.imu, calibration=known, refine_intrinsics=False, num_threads=1)(start)
    model = MetricStage(imu=tracks.imu, calibration=known, shutter=shutter)(start)
    found = [reason for reason in model.scale.reasons if reason.code == "declared-readout"]
    assert bool(found) == (times != 1.0)
    if found:
        assert model.scale.verdict == "weak" and model.scale.reasons[0] == found[0]
        assert found[0].values["declared_s"] == declared_s and found[0].values["direction"] == "down"
        assert abs(found[0].values["readout_s"] - 0.025) < 3 * found[0].values["sigma_s"] < 0.006


@pytest.mark.parametrize("factor", [1.0, 0.9, 1.35])
def test_a_declared_focal_length_is_compared_with_what_the_images_show(factor):
    tracks = tracks_of(walk(16.0, points_per_m=50.0))
    reconstruction = tracks.reconstruction()
    true_px = {}
    for camera in reconstruction.cameras.values():
        for i in camera.focal_length_idxs():
            true_px[i] = camera.params[i]
            camera.params[i] *= factor
    start = Model(
        reconstruction=adjusted(reconstruction, keeps_intrinsics=True),
        colmap_index=0,
        timing=replace(tracks.timing, readout_s=0.0),
    )
    model = MetricStage(imu=tracks.imu, calibration=UNKNOWN, keeps_intrinsics=True)(start)
    found = [reason for reason in model.scale.reasons if reason.code == "declared-focal-length"]
    assert bool(found) == (factor != 1.0)
    if found:
        assert model.scale.verdict != "trusted" and model.scale.reasons[0] == found[0]
        values, true_px = found[0].values, float(np.mean(list(true_px.values())))
        assert values["declared_px"] == pytest.approx(factor * true_px)
        # a few steps go most of the way
        assert abs(values["found_px"] - true_px) < 0.5 * abs(values["declared_px"] - true_px)
    # where the intrinsics were refined, they are COLMAP's
    refined = MetricStage(imu=tracks.imu, calibration=UNKNOWN)(start)
    assert "declared-focal-length" not in {reason.code for reason in refined.scale.reasons}


@pytest.mark.parametrize(("distorted", "declares"), [(True, False), (True, True), (False, False)])
def test_a_declared_camera_without_distortion_is_compared_with_what_the_images_show(distorted, declares):
    lens = (-0.05, 0.02, 0.0, 0.0) if distorted else (0.0, 0.0, 0.0, 0.0)
    true = CameraModel(model="OPENCV", width=1280, height=960, params=(1000.0, 990.0, 640.0, 480.0, *lens))
    tracks = tracks_of(replace(walk(16.0, points_per_m=50.0), camera=true))
    reconstruction = tracks.reconstruction()
    if not declares:
        for camera in reconstruction.cameras.values():
            camera.model, camera.params = pycolmap.CameraModelId.PINHOLE, true.params[:4]
    start = Model(
        reconstruction=adjusted(reconstruction, keeps_intrinsics=True),
        colmap_index=0,
        timing=replace(tracks.timing, readout_s=0.0),
    )
    model = MetricStage(imu=tracks.imu, calibration=UNKNOWN, keeps_intrinsics=True)(start)
    found = [reason for reason in model.scale.reasons if reason.code == "declared-distortion"]
    assert bool(found) == (distorted and not declares)
    if found:
        assert model.scale.verdict != "trusted"
        values = found[0].values
        assert (values["declared"], values["found"]) == ("PINHOLE", "OPENCV")
        assert values["distortion"][:2] == pytest.approx(lens[:2], abs=0.01)
        # where the distortion moves the picture by 16 px at a corner
        assert 3 < values["shift_px"] < 16
        assert found[0] in [treatment.reason for treatment in model.treatments]
    # where the intrinsics were refined, they are COLMAP's
    refined = MetricStage(imu=tracks.imu, calibration=UNKNOWN)(start)
    assert "declared-distortion" not in {reason.code for reason in refined.scale.reasons}


def test_an_imu_that_contradicts_the_pictures_beyond_any_noise_makes_a_scale_weak(walked):
    _, model = walked
    for chi2, verdict in ((5.0, "trusted"), (548.0, "weak")):
        reason = Fact("imu-contradicts-images", chi2=chi2)
        doubted = refine_stage._doubt_contradicted(model, SimpleNamespace(reason=reason, chi2=chi2))
        assert doubted.scale.verdict == verdict and (reason in doubted.scale.reasons) == (verdict == "weak")
    other = SimpleNamespace(reason=Fact("refinement-no-better"), chi2=548.0)
    assert refine_stage._doubt_contradicted(model, other) is model


def test_a_shutter_that_may_roll_is_in_the_interval(walked):
    _, model = walked
    known = SeenReadout(readout_s=0.0, sigma_s=0.01, direction="down", rate_hz=5.0).widen(model.scale)
    assert known.sigma_log == pytest.approx(np.hypot(model.scale.sigma_log, 0.05)) and known.verdict == "weak"
    assert known.parts["rolling_shutter"] == pytest.approx(0.05)
    # beyond 30 % nothing is known
    unknown = SeenReadout(readout_s=0.0, sigma_s=0.02, direction="down", rate_hz=8.0).widen(model.scale)
    assert unknown.verdict == "refused" and unknown.metres_per_unit is None
    assert "of up to 40 ms" in str(unknown.reasons[0]) and "declare readout_s" in str(unknown.reasons[0])
    # one that was found is for the refinement to take in
    found = SeenReadout(readout_s=0.03, sigma_s=0.001, direction="down", rate_hz=8.0).widen(model.scale)
    assert found.verdict == "weak" and found.reasons == (
        SeenReadout(readout_s=0.03, sigma_s=0.001, direction="down", rate_hz=8.0).as_fact(),
    )


def test_auto_refines_where_drift_exceeds_what_is_left(walked, monkeypatch):
    tracks, model = walked
    made, said = refined_by(tracks.imu, model, auto=True)
    worth = said.values["expected"]
    assert said.action == "refined" and worth["risk"] < 0.05 and worth["share"] < 0.25
    assert "expected error" in str(said.reason) and "mm by images alone" in str(made.scale.notes[-1])
    # as far off as it was expected to be, by the truth; frames that see next to nothing are farther
    truth = tracks.motion.cam_in_world_m(tracks.timing.pose_t_s())
    before, after = (error_of(centres_of(one.reconstruction), truth) for one in (model, made))
    assert 0.3 < before / worth["alone_m"] < 5 and 0.3 < after / worth["refined_m"] < 5
    for name, value, why in (
        ("share", 1e-6, "of the time that features and mapping take"),
        ("most_bytes", 1, "of the time"),
        ("least_drift", 1.0, "the images alone fix the shape"),
        ("most_risk", 0.0, "of such paths become worse"),
    ):
        monkeypatch.setattr(motion, "_LIMITS", motion.DriftLimits(**{name: value}))
        same, said = refined_by(tracks.imu, model, auto=True)
        assert why in str(said.reason) and same.reconstruction is model.reconstruction
        # the reason is on the screen and in the report, too
        assert str(same.scale.notes[-1]) == f"the model was {said.reason}"


def test_auto_leaves_a_model_that_loops_hold():
    options = walk(24.0, points_per_m=15.0, life_s=1e3)
    around = replace(options.motion, kind="orbit", radius_m=6.0, arc_deg=330.0, sweep_s=12.0)
    tracks = tracks_of(replace(options, motion=around))
    model = Model(reconstruction=adjusted(tracks.reconstruction()), colmap_index=0, timing=tracks.timing)
    model = MetricStage(imu=tracks.imu, calibration=UNKNOWN)(model)
    same, said = refined_by(tracks.imu, model, auto=True)
    assert "the images alone fix the shape" in str(said.reason) and same.reconstruction is model.reconstruction
    truth = tracks.motion.cam_in_world_m(tracks.timing.pose_t_s())
    expected_m = said.values["expected"]["alone_m"]
    assert 0.5 < error_of(centres_of(model.reconstruction), truth) / expected_m < 2


def test_the_risk_is_that_of_one_normal_error_that_is_taken_away(subtests):
    for times in (1.2, 2.0, 4.0):
        with subtests.test(times=times):
            # along one direction, what is removed over what is left is distributed as Cauchy's
            along = np.array([0.0, 2.0, 0.0, -1.0, 0.0, 2.0]) / 3
            left = np.outer(along, along)
            removed, nearer = (times**2 - 1) ** 0.5, 1 / 1.05
            expected = np.arctan((nearer - 1) / removed) - np.arctan((-nearer - 1) / removed)
            assert motion._risk(times**2 * left, left) == pytest.approx(expected / np.pi, abs=0.02)


def test_auto_leaves_a_project_from_which_more_was_made(walked, tmp_path):
    tracks, model = walked
    same, said = refined_by(tracks.imu, model, auto=True, made_from="dense/fused.ply")
    assert str(said.reason).startswith("not refined: dense/fused.ply was made from it")
    assert same.reconstruction is model.reconstruction
    assert refined_by(tracks.imu, model, made_from="dense/fused.ply")[1].action == "refined"
    sparse, others = tmp_path / "sparse" / "0", tmp_path / "dense" / "sparse"
    for folder in (sparse, others):
        folder.mkdir(parents=True)
        model.reconstruction.write_binary(str(folder))
    files = [Path("sparse/0/images.bin"), Path("images/a.jpg"), Path("mesh.obj"), Path("dense/sparse/images.bin")]
    for name in ("images/a.jpg", "mesh.obj"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("v 0 0 0\n")
    layout = read_layout(
        tmp_path, [Path("sparse"), Path("sparse/0"), Path("dense"), Path("dense/sparse")], one_for_all=False
    )
    assert find_made_from(tmp_path, layout, files[:2]) is None
    assert find_made_from(tmp_path, layout, files[:3]) == Path("mesh.obj")
    assert find_made_from(tmp_path, layout, files) == Path("dense/sparse/images.bin")


@pytest.mark.parametrize("found", [(1.5e-3, 0.49e-3), (0.9e-3, 1e-5), (-5e-3, 2e-3)])
def test_a_readout_that_predicts_nothing_better_is_none(walked, monkeypatch, found):
    tracks, model = walked
    monkeypatch.setattr(refinement, "_estimate_readout", lambda *_: found)
    _, said = refined_by(tracks.imu, model)
    assert said.action == "refined" and said.values["readout_s"] == 0 and "rolling" not in str(said.reason)


def test_a_global_shutter_needs_no_declaration(walked, refined):
    tracks, model = walked
    assert model.timing.readout_s is None
    made, said = refined
    assert said.action == "refined"
    assert said.values["readout_s"] == 0
    # what fewer than two images see is no part of it
    lonely = pycolmap.Reconstruction(model.reconstruction)
    point_id = min(lonely.point3D_ids())
    places = [(element.image_id, element.point2D_idx) for element in lonely.points3D[point_id].track.elements]
    for image_id, place in places[1:]:
        lonely.points3D[point_id].track.delete_element(image_id, place)
        lonely.image(image_id).reset_point3D_for_point2D(place)
    made, said = refined_by(tracks.imu, replace(model, reconstruction=lonely))
    assert said.action == "refined" and point_id not in made.reconstruction.points3D


def test_keypoints_go_back_to_where_the_shutter_had_them(rolled):
    tracks, shutter, _, _ = rolled
    name = tracks.timing.names[7]
    exposed = tracks.xy_px[tracks.frame == 7]
    assert shutter.as_exposed(name, shutter.moved(name, exposed)) == pytest.approx(exposed, abs=5e-3)
    assert np.array_equal(shutter.as_exposed("another.jpg", exposed), exposed)


def test_the_readout_s_stage_remembers_where_keypoints_were(rolled):
    tracks, shutter, _, model = rolled
    name = tracks.timing.names[7]
    assert "readout" in [one.stage for one in model.treatments if one.action]
    assert model.observed_px[name] == pytest.approx(shutter.moved(name, tracks.xy_px[tracks.frame == 7]), abs=1e-6)


def test_images_are_rectified_as_the_refined_model_has_the_shutter(rolled):
    tracks, shutter, known, model = rolled
    off = replace(tracks.calibration, gyro_time_offset_s=tracks.calibration.gyro_time_offset_s + 2e-3)
    narrow = replace(tracks.camera, params=(1020.0, 1020.0, *tracks.camera.params[2:]))
    wrong = shutter.refined(off, 0.0235, narrow)
    made, _ = refined_by(tracks.imu, model, calibration=known, shutter=shutter)
    result = SimpleNamespace(treatments=made.treatments, scale=made.scale, sparse_metric="of the model")
    left = SimpleNamespace(treatments=(), scale=made.scale, sparse_metric="of another")
    assert stages_of_refined([wrong], [left]) == [wrong]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frames, "read_model", lambda folder: made.reconstruction)
        (refined,) = stages_of_refined([wrong], [left, result])
    away = []
    for stage in (wrong, refined):
        moved = [stage.moved(tracks.timing.names[i], tracks.xy_px[tracks.frame == i]) for i in range(0, 60, 6)]
        true = [shutter.moved(tracks.timing.names[i], tracks.xy_px[tracks.frame == i]) for i in range(0, 60, 6)]
        away.append(np.median(np.linalg.norm(np.concatenate(moved) - np.concatenate(true), axis=1)))
    assert away[1] < 0.2 * away[0] and away[1] < 0.1


def test_images_without_a_time_hang_on_the_pictures(walked):
    tracks, model = walked
    keep = np.arange(len(model.timing.names)) % 7 != 3
    names = tuple(name for name, kept in zip(model.timing.names, keep, strict=True) if kept)
    timing = replace(model.timing, names=names, t_s=model.timing.t_s[keep])
    made, said = refined_by(tracks.imu, replace(model, timing=timing))
    truth = tracks.motion.cam_in_world_m(tracks.timing.pose_t_s())
    assert said.action == "refined"
    assert error_of(centres_of(made.reconstruction), truth) < error_of(centres_of(model.reconstruction), truth)


def test_images_beyond_the_recording_have_no_covariance_of_motion(walked):
    tracks, model = walked
    until_s = tracks.imu.gyro_t_s[0] + 0.7 * (tracks.imu.gyro_t_s[-1] - tracks.imu.gyro_t_s[0])
    gyro, accel = tracks.imu.gyro_t_s < until_s, tracks.imu.accel_t_s < until_s
    short = replace(
        tracks.imu,
        gyro_t_s=tracks.imu.gyro_t_s[gyro],
        gyro_rad_s=tracks.imu.gyro_rad_s[gyro],
        accel_t_s=tracks.imu.accel_t_s[accel],
        accel_m_s2=tracks.imu.accel_m_s2[accel],
    )
    made, said = refined_by(short, model)
    assert said.action == "refined"
    names = np.array(tracks.timing.names)
    felt = tracks.timing.pose_t_s() - tracks.calibration.gyro_time_offset_s < until_s
    assert set(made.motion.cov) == set(made.motion.velocity_in_world) <= set(names[felt])
    assert len(made.motion.cov) >= felt.sum() - 2
    assert set(made.motion.cam_in_world) == set(names)
    # what a stage moves afterwards is not what was solved
    centres = centres_of(made.reconstruction)
    assert made.motion.of(tuple(names), centres).cov.keys() == made.motion.cov.keys()
    centres[5:] += 1e-3
    assert set(made.motion.of(tuple(names), centres).cov) == set(names[:5])
    assert set(made.motion.of(tuple(names), centres).velocity_in_world) == set(names[:5])


def test_an_imu_that_contradicts_the_pictures_leaves_the_model_as_it_is(walked):
    tracks, model = walked
    imu = replace(tracks.imu, accel_m_s2=tracks.imu.accel_m_s2[:, [1, 0, 2]] * [1.0, 1.0, 1.0])
    made, said = refined_by(imu, model)
    assert said.action == ""
    assert str(said.reason).startswith("not refined, refinement discarded: ")
    assert made.reconstruction is model.reconstruction


def test_what_predicts_worse_is_not_believed(walked, monkeypatch):
    tracks, model = walked
    # as if the refined model predicted what the other one does, and the other way round
    monkeypatch.setattr(
        refinement, "evaluate_held_out", lambda problem, x, seen: evaluate_held_out(problem, x, seen) * _sign(problem)
    )
    made, said = refined_by(tracks.imu, model)
    assert "did not improve the held-out observations" in str(said.reason)
    assert not said.values["accepted"]
    assert made.reconstruction is model.reconstruction


def test_what_takes_too_much_memory_is_left_as_it_is(walked, monkeypatch):
    tracks, model = walked
    monkeypatch.setattr(refinement, "LIMITS", refinement.RefineLimits(most_bytes=100_000))
    made, said = refined_by(tracks.imu, model)
    assert "GB" in str(said.reason)
    assert made.reconstruction is model.reconstruction


def test_what_does_not_converge_is_not_believed(walked, monkeypatch):
    tracks, model = walked
    # images alone, the refinement, without a readout, with the noise measured, and with all observations
    whys = ("images alone", *3 * ("the refinement does not",), "with all observations")
    for restless, why in enumerate(whys):
        count = iter(range(len(whys)))

        def solved(problem, start, restless=restless, count=count):
            one = solve(problem, start)
            return replace(one, converged=next(count) != restless)

        monkeypatch.setattr(refinement, "solve", solved)
        made, said = refined_by(tracks.imu, model)
        assert why in str(said.reason)
        assert "converge" in str(said.reason)
        assert made.reconstruction is model.reconstruction


def test_what_nothing_is_known_about_is_not_believed(walked, monkeypatch):
    tracks, model = walked

    def failed(problem, x):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(refinement, "factor_information", failed)
    made, said = refined_by(tracks.imu, model)
    assert "uncertainty cannot be determined" in str(said.reason)
    assert said.values["chi2"] < 1.5
    assert made.reconstruction is model.reconstruction


def _sign(problem):
    return 0.5 if problem.inertial is None else 1.0


@pytest.mark.parametrize("spoil", ["late", "gain"])
def test_a_false_imu_does_no_harm(walked, spoil):
    tracks, model = walked
    imu = tracks.imu
    if spoil == "late":
        imu = replace(imu, gyro_t_s=imu.gyro_t_s + 0.03, accel_t_s=imu.accel_t_s + 0.03)
    else:
        imu = replace(imu, accel_m_s2=imu.accel_m_s2 * 1.05)
    made, _ = refined_by(imu, model)
    truth = tracks.motion.cam_in_world_m(tracks.timing.pose_t_s())
    assert error_of(centres_of(made.reconstruction), truth) < 1.05 * error_of(centres_of(model.reconstruction), truth)


def test_what_cannot_be_refined_is_said(walked):
    tracks, model = walked
    for other, why in (
        (replace(model, similarity=None), "it has no scale"),
        (replace(model, scale=replace(model.scale, noise=None)), "not estimated by the joint method"),
        (replace(model, rectified=True), "cannot be inverted"),
        (replace(model, scale=replace(model.scale, parts={"accel_faults": 1e-3})), "has faults"),
        (replace(model, timing=replace(model.timing, t_s=model.timing.t_s + 1e4)), "less than half"),
    ):
        made, said = refined_by(tracks.imu, other)
        assert why in str(said.reason)
        assert made.reconstruction is model.reconstruction
    # a second camera, which took every other image, in a part of a joined model, too; one camera may be set anew, zoom
    # and come back, or take one picture with other settings
    several = "refine-several-cameras"
    for second, code in (
        (slice(1, None, 2), several),
        (slice(1, 40, 2), several),
        (slice(50, None), None),
        (slice(40, 60), None),
        (slice(30, 31), None),
    ):
        stage = RefineStage(imu=tracks.imu, calibration=UNKNOWN, refine_intrinsics=False)
        why_not = stage._find_obstacle(replace(model, reconstruction=two_cameras(model.reconstruction, second)))
        assert (None if why_not is None else why_not.code) == code
    # where each image has a camera of its own, devices differ by folder, size or focus, and one that zooms is one
    for camera_of, name_of, code in (
        (lambda i: focused(1.0 + 0.5 * (i % 2)), str, several),
        (lambda i: {"width": 1280 + i % 2}, str, several),
        (lambda i: {}, lambda i: f"{'ab'[i % 2]}/{i}", several),
        (lambda i: focused(1.0 + 0.01 * i), str, None),
        (lambda i: focused(1.0 + 0.5 * (i == 30)), str, None),
    ):
        stage = RefineStage(imu=tracks.imu, calibration=UNKNOWN, refine_intrinsics=False)
        each, timing = camera_for_each(model, camera_of, name_of)
        why_not = stage._find_obstacle(replace(model, reconstruction=each, timing=timing))
        assert (None if why_not is None else why_not.code) == code
    empty = pycolmap.Reconstruction(model.reconstruction)
    for point_id in list(empty.point3D_ids()):
        empty.delete_point3D(point_id)
    assert "points" in str(refined_by(tracks.imu, replace(model, reconstruction=empty))[1].reason)


def test_without_the_option_the_model_is_what_it_was(walked):
    tracks, model = walked
    mapped = pycolmap.Reconstruction(model.reconstruction)
    similarity = model.similarity
    rotation = pycolmap.Rotation3d(similarity.rotation_xyzw)
    mapped.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation_m).inverse())
    model = MetricStage(imu=tracks.imu, calibration=UNKNOWN)(replace(model, reconstruction=mapped, similarity=None))
    recording = Recording.of(Capture(path="none", calibration=UNKNOWN), tracks.imu, tracks.timing, UNKNOWN)
    off = ReconstructOptions(join="off", refine="off")
    stages = default_model_stages(StageInputs(recording=recording, options=off))
    assert [type(stage) for stage in stages] == [ReadoutStage, MetricStage]
    usual = default_model_stages(StageInputs(recording=recording))
    assert [type(stage) for stage in usual] == [ReadoutStage, MetricStage, JoinStage, RefineStage]
    assert usual[-1].auto
    made = Model(reconstruction=mapped, colmap_index=0, timing=tracks.timing)
    for stage in stages:
        made = stage(made)
    # the very model that the scale alone makes, nothing said of a refinement
    assert np.array_equal(centres_of(made.reconstruction), centres_of(model.reconstruction))
    points, same = ({i: p.xyz for i, p in one.reconstruction.points3D.items()} for one in (made, model))
    assert points.keys() == same.keys() and all(np.array_equal(points[i], same[i]) for i in points)
    assert [one.stage for one in made.treatments if one.stage == "refine"] == []
    assert made.scale.metres_per_unit == model.scale.metres_per_unit
    stages = default_model_stages(StageInputs(recording=recording, options=ReconstructOptions(refine="inertial")))
    assert [type(stage) for stage in stages] == [ReadoutStage, MetricStage, JoinStage, RefineStage]
    assert not stages[-1].auto


def test_an_existing_project_is_refined(mapped, tmp_path):
    tracks, reconstruction = mapped
    project = tmp_path / "project"
    (project / "sparse" / "0").mkdir(parents=True)
    reconstruction.write_binary(str(project / "sparse" / "0"))
    rows = [f"{name},{t_s:.9f}" for name, t_s in zip(tracks.timing.names, tracks.timing.t_s.tolist(), strict=True)]
    times, imu = tmp_path / "times.csv", tmp_path / "imu"
    times.write_text("name,t_s\n" + "\n".join(rows) + "\n")
    imu.mkdir()
    for name, t_s, values in (
        ("gyroscope.txt", tracks.imu.gyro_t_s, tracks.imu.gyro_rad_s),
        ("accelerometer.txt", tracks.imu.accel_t_s, tracks.imu.accel_m_s2),
    ):
        stamps = np.rint((t_s + 1000) * 1e9).astype(np.int64)
        lines = [f"{t} {x:.8f} {y:.8f} {z:.8f}" for t, (x, y, z) in zip(stamps.tolist(), values, strict=True)]
        (imu / name).write_text("\n".join(lines) + "\n")
    alone = scale_source(ScaleSource(source=project / "sparse" / "0", imu=imu, frame_times=times), ScaleOptions())
    assert alone.verdict == "trusted" and 0 < alone.parts["rolling_shutter"] < 1e-3
    source = ProjectOptions(imu=imu, frame_times=times)
    result = reconstruct_project(project, tmp_path / "out", source, ReconstructOptions(refine="inertial"))
    said = json.loads((tmp_path / "out" / "result.json").read_text())["models"][0]["treatments"][-1]
    assert (said["stage"], said["action"]) == ("refine", "refined")
    truth = tracks.motion.cam_in_world_m(tracks.timing.pose_t_s())
    made, mapped = read_model(tmp_path / "out" / "sparse" / "0"), read_model(project / "sparse" / "0")
    assert error_of(centres_of(made), truth) < error_of(centres_of(mapped), truth)
    assert result.models[0].trajectory is not None
    # smoothed once more, the IMU would count twice: poses, velocities and covariance are the refinement's own
    path = read_tum(tmp_path / "out" / "trajectory.tum")
    assert path.cam_in_world == pytest.approx(centres_of(made), abs=1e-9)
    stored = np.load(tmp_path / "out" / "trajectory_cov.npz")
    assert stored["cov"].shape == (len(tracks.timing.names), 6, 6)
    assert stored["t_s"] - stored["t_s"][0] == pytest.approx(tracks.timing.t_s - tracks.timing.t_s[0], abs=1e-6)
    sigma_m = np.sqrt(np.trace(stored["cov"][:, :3, :3], axis1=1, axis2=2))
    assert sigma_m[0] < 1e-3 < 10 * sigma_m[-1] and sigma_m[-1] > 2 * sigma_m[10]
    last = said["values"]["drift"][-1]["end_sigma_m"]
    # with what a lens and an accelerometer that nobody calibrated leave of any scale
    along = model_scale_sigma() * (path.cam_in_world[-1] - path.cam_in_world[0])
    assert np.diagonal(stored["cov"][-1])[:3] == pytest.approx(np.array(last) ** 2 + along**2, rel=1e-6)
    assert stored["rotation_cov"].shape == (len(tracks.timing.names), 3, 3)
    assert str(stored["relative_to"]) == "first image"
    motion = read_record(tmp_path / "out" / "trajectory_motion.json", CameraMotion)
    assert motion.names == tracks.timing.names
    speed, true = (
        np.linalg.norm(one, axis=1)
        for one in (motion.velocity_in_world_m_s, tracks.motion.at(tracks.timing.pose_t_s()).velocity_in_world_m_s)
    )
    # and the velocities are as sure as they say
    off = speed - true
    sigma_m_s = np.sqrt(np.trace(stored["cov"][:, 3:, 3:], axis1=1, axis2=2) / 3)
    assert np.sqrt(np.mean(off**2)) < 5e-3
    assert 0.4 < np.sqrt(np.mean((off / sigma_m_s) ** 2)) < 1.5
