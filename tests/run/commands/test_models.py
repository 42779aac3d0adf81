"""COLMAP's models on their way to metres: which go first, which are left out, what is said, what is made again."""

import shutil
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli import terminal
from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_exp, quat_multiply, quat_rotate
from colmap_inertial.core.types import (
    CameraModel,
    Frame,
    FrameTiming,
    ImuRecording,
    JoinedPart,
    Keypoints,
    ScaleEstimate,
    Similarity,
)
from colmap_inertial.imaging.gate import FrameDecision, RecordingVerdict
from colmap_inertial.imaging.psf import blur_field
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.frames import read_frame_times
from colmap_inertial.io.trajectories import read_tum
from colmap_inertial.model import Model, colmap_camera, num_registered, read_model
from colmap_inertial.model.project import apply_to_project, undo_project
from colmap_inertial.model.readout import Settled
from colmap_inertial.model.similarities import ModelScale, plain_factor, read_similarity
from colmap_inertial.report.words import describe_joined
from colmap_inertial.run.commands import models
from colmap_inertial.run.commands.models import Submodels, run_models, run_validation
from colmap_inertial.run.commands.reconstruct_project import _collect_scales
from colmap_inertial.run.commands.result import ModelResult, ReconstructResult, result_as_json
from colmap_inertial.run.stages import readout
from colmap_inertial.run.stages.deblur import SMOOTHING, DeblurStage, smoothing_for
from colmap_inertial.run.stages.imaging_plan import GyroView, ImagingPlan
from colmap_inertial.run.stages.join import JoinStage
from colmap_inertial.run.stages.metric import MetricStage, calibration_of_rectified, gravity_in_model
from colmap_inertial.run.stages.readout import ReadoutStage
from colmap_inertial.run.stages.rolling_shutter import RollingShutterStage
from colmap_inertial.run.steps.workspace import Workspace
from colmap_inertial.tools.simulate import ImuOptions, MotionOptions, RecordingOptions, SfmOptions, simulate_recording
from colmap_inertial.validate import Validation, parse_target
from tests.helpers.sessions import recording_of, session_in
from tests.helpers.simulated_project import write_project

CAMERA = CameraModel(model="PINHOLE", width=640, height=480, params=(500.0, 500.0, 320.0, 240.0))


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """Twenty seconds in a model of a unit of its own, and their IMU."""
    options = RecordingOptions(
        motion=MotionOptions(duration_s=20.0), sfm=SfmOptions(metres_per_unit=(2.5, 2.5)), imu=ImuOptions()
    )
    simulated = simulate_recording(options, seed=11)
    # a camera's clock that began long ago
    simulated = replace(simulated, trajectory=replace(simulated.trajectory, epoch_ns=5_000_000_000))
    return write_project(tmp_path_factory.mktemp("project"), simulated)


@pytest.fixture(scope="module")
def whole(project):
    """A model of a handheld recording with its times, and what the default stage makes of it."""
    model = Model(
        reconstruction=read_model(project.model), colmap_index=0, timing=read_frame_times(project.frame_times)
    )
    made = MetricStage(imu=project.recording.imu, calibration=None)(model)
    assert made.scale.verdict == "trusted"
    return model, made


@dataclass(frozen=True, kw_only=True)
class Scaled:
    """Gives models of at least and at most so many images the same scale estimate, and refuses it to the others."""

    made: Model = field(compare=False)
    least: int = 0
    most: int = 1000

    def __call__(self, model):
        if not self.least <= model.reconstruction.num_reg_images() <= self.most:
            return replace(model, scale=ScaleEstimate.refused("joint", "not this one"))
        similarity = self.made.similarity
        moved = pycolmap.Reconstruction(model.reconstruction)
        moved.transform(
            pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation_xyzw), similarity.translation_m)
        )
        return replace(model, reconstruction=moved, scale=self.made.scale, similarity=similarity)


@dataclass(frozen=True, kw_only=True)
class Joins:
    """Joins all models into the first, each moved along by its own number of metres."""

    def __call__(self, model):
        return model

    def join_models(self, models):
        parts = tuple(
            JoinedPart(
                **dict.fromkeys(("begin_s", "end_s", "sigma_m", "sigma_deg"), 0.0),
                colmap_index=model.colmap_index,
                images=model.reconstruction.num_reg_images(),
                verdict="trusted",
                sigma_log=0.01,
                similarity=along(model.similarity, model.colmap_index),
            )
            for model in models
        )
        return (replace(models[0], parts=parts),), ()


def along(similarity, metres):
    return replace(similarity, translation_m=similarity.translation_m + np.array([metres, 0.0, 0.0]))


def without_an_image(model):
    """A stage that changes what COLMAP made."""
    changed = pycolmap.Reconstruction(model.reconstruction)
    changed.deregister_frame(changed.image(max(changed.reg_image_ids())).frame_id)
    return replace(model, reconstruction=changed)


@pytest.fixture
def run(project, whole, tmp_path):
    """Runs the model stages on sub-models of so many images each, by number."""
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")
    model, made = whole
    names = sorted(image.name for image in model.reconstruction.images.values())

    def run(sizes, *, doubts=(), least=0, most=1000, then=(), fragments=False, **numbered):
        for number, size in sizes.items():
            folder = workspace.colmap_sparse / str(number)
            if not folder.exists():
                part = pycolmap.Reconstruction(model.reconstruction)
                for name in names[size:]:
                    part.deregister_frame(part.find_image_with_name(name).frame_id)
                folder.mkdir(parents=True)
                part.write_binary(str(folder))
        session = session_in(workspace)
        recording = replace(recording_of(project.recording.imu, model.timing), doubts=doubts)
        found = {number: workspace.colmap_sparse / str(number) for number in sizes}
        run.session = session
        submodels = Submodels(folders=found, after=(), **numbered)
        return run_models(
            session, recording, [Scaled(made=made, least=least, most=most), *then], submodels, fragments=fragments
        )[:2]

    run.workspace = workspace
    return run


def test_the_largest_model_goes_first_and_fragments_are_left_out(run):
    models, fragments = run({0: 40, 1: 4, 2: 90})
    assert [(one.index, one.colmap_index, one.summary["registered_images"]) for one in models] == [
        (0, 2, 90),
        (1, 0, 40),
    ]
    assert [(one.colmap_index, one.registered_images) for one in fragments] == [(1, 4)]
    assert num_registered(models[0].sparse_metric) == 90


def test_fragments_are_treated_where_that_is_asked_for(run):
    models, fragments = run({0: 30, 1: 40, 2: 4}, least=35, fragments=True)
    assert [one.colmap_index for one in models] == [1, 0, 2] and fragments == ()
    models, fragments = run({0: 30, 1: 40, 2: 4}, least=35)
    assert [one.colmap_index for one in models] == [1, 0]
    assert [one.colmap_index for one in fragments] == [2]


def test_the_first_path_has_the_plain_name_and_those_of_models_that_are_gone_go(run):
    run({0: 60, 1: 50, 2: 40})
    assert sorted(path.name for path in run.workspace.root.glob("*.tum")) == [
        "trajectory.tum",
        "trajectory_1.tum",
        "trajectory_2.tum",
    ]
    # the largest one is refused: the next one's path has the plain name
    run({0: 60, 1: 50, 2: 40}, least=45, most=55)
    assert sorted(path.name for path in run.workspace.root.glob("trajectory*")) == [
        "trajectory.tum",
        "trajectory_cov.npz",
        "trajectory_motion.json",
    ]
    assert [path.name for path in run.workspace.sparse.iterdir()] == ["1"]


def test_a_scale_that_is_refused_takes_the_models_in_metres_away(run):
    run({0: 60})
    assert (run.workspace.sparse / "0").is_dir()
    models, _ = run({0: 60}, least=70)
    assert models[0].sparse_metric is None and not run.workspace.sparse.exists()


def test_a_project_s_models_keep_their_numbers(run):
    models, _ = run({0: 40, 2: 90}, numbered=True)
    assert [(one.index, one.colmap_index, one.sparse_metric.name) for one in models] == [(2, 2, "2"), (0, 0, "0")]
    assert [one.trajectory.name for one in models] == ["trajectory.tum", "trajectory_0.tum"]
    assert num_registered(run.workspace.sparse / "2") == 90


def test_models_that_may_be_joined_are_numbered_with_those_that_were_refused(run, project):
    joining = JoinStage(imu=project.recording.imu, calibration=None)
    for sizes in ({0: 90, 1: 1}, {0: 1, 1: 90}):
        models, _ = run(sizes, then=[joining], fragments=True)
        largest = max(sizes, key=sizes.get)
        assert [(one.index, one.colmap_index, one.scale.verdict) for one in models] == [
            (0, largest, "trusted"),
            (1, 1 - largest, "refused"),
        ]
        assert [path.name for path in run.workspace.sparse.iterdir()] == ["0"]
        shutil.rmtree(run.workspace.colmap_sparse)
    models, _ = run({3: 90, 1: 1}, then=[joining], fragments=True, numbered=True)
    assert [(one.index, one.colmap_index) for one in models] == [(3, 3), (1, 1)]
    with pytest.raises(TimingError, match="1 of the model's 1 images"):
        run({1: 1, 6: 1}, then=[joining], fragments=True)


def test_parts_of_a_project_s_joined_model_stand_by_themselves_as_the_stages_made_them(run, whole):
    def made():
        return run({0: 60, 1: 40}, then=[without_an_image, Joins()], numbered=True)[0]

    (one,) = made()
    part = run.workspace.sparse / "1"
    assert num_registered(run.workspace.colmap_sparse / "1") == 40 and num_registered(part) == 39
    name = sorted(image.name for image in read_model(part).images.values())[7]
    there, similarity = whole[0].reconstruction.find_image_with_name(name).projection_center(), one.parts[1].similarity
    moved = similarity.scale * quat_rotate(similarity.rotation_xyzw, there) + similarity.translation_m
    np.testing.assert_allclose(read_model(part).find_image_with_name(name).projection_center(), moved, atol=1e-9)
    assert read_similarity(part / "transform.json").scale == similarity.scale
    # apply --undo must know that it cannot take them apart
    scales = _collect_scales([one], ())
    assert scales[0].joined_of == (0, 1) and scales[1].joined_of == ()
    # a part's folder that is gone is made again
    shutil.rmtree(part)
    made()
    assert run.session.runner.worked == ["metric"] and num_registered(part) == 39
    made()
    assert run.session.runner.worked == []


def test_a_project_that_was_joined_is_not_taken_back(project, tmp_path):
    shutil.copytree(project.model, tmp_path / "project" / "sparse" / "0")
    scale = ModelScale(similarity=plain_factor(2.0), joined_of=(0, 3))
    apply_to_project(tmp_path / "project", tmp_path / "metric", {0: scale})
    with pytest.raises(FormatError, match=r"transform\.json: model 0 was joined from the models 0, 3 and cannot"):
        undo_project(tmp_path / "metric", tmp_path / "back")
    assert not (tmp_path / "back").exists()


def test_a_joined_model_is_described_by_its_parts_and_its_worst_gap():
    gap = {"first": 0, "second": 2, "joined": True, "seconds": 1.0, "sigma_m": None, "sigma_deg": None}
    unknown = {describe_joined([0, 2], gaps) for gaps in ([], [gap])}
    assert len(unknown) == 1 and "2" in unknown.pop()
    assert "3.0 cm, 0.50 degrees" in describe_joined([0, 2], [gap | {"sigma_m": 0.03, "sigma_deg": 0.5}])


def test_no_covariance_is_written_of_a_joined_path(run):
    run({0: 60, 1: 40})
    assert (run.workspace.root / "trajectory_cov.npz").is_file()
    run({0: 60, 1: 40}, then=[Joins()])
    assert sorted(path.name for path in run.workspace.root.glob("trajectory*")) == [
        "trajectory.tum",
        "trajectory_motion.json",
    ]


def test_counts_are_colmap_s_own_but_for_joined_models(run):
    images = {}
    for then in ([without_an_image], [without_an_image, Joins()]):
        (one, *_), _ = run({0: 60, 1: 40}, then=then)
        images[len(one.parts)] = one.summary["registered_images"]
    assert images == {0: 60, 2: 59}
    imu = JoinStage(imu=PANNING, calibration=None)
    (first, *_), _ = run({0: 60, 1: 1}, then=[without_an_image, imu], fragments=True)
    assert first.summary["registered_images"] == 60 and num_registered(first.sparse_metric) == 59


def test_doubts_make_any_stage_s_scale_weak_and_make_the_models_again(run):
    sure, _ = run({0: 40})
    assert sure[0].scale.verdict == "trusted"
    doubts = (Fact("forced-to-go-on", finding=Fact("stabilised", share=0.2)),)
    downgraded, _ = run({0: 40}, doubts=doubts)
    assert downgraded[0].scale.verdict == "weak" and downgraded[0].scale.reasons[:1] == doubts
    assert run.session.runner.worked == ["metric"]
    run({0: 40}, doubts=doubts)
    assert run.session.runner.worked == []


def test_positions_and_covariances_of_a_path_have_the_same_stamps(run, project):
    run({0: 40})
    path = read_tum(run.workspace.root / "trajectory.tum")
    stored = np.load(run.workspace.root / "trajectory_cov.npz")
    np.testing.assert_allclose(stored["t_s"], path.t_s + path.epoch_ns * 1e-9, atol=1e-6, rtol=0)
    assert stored["cov"].shape == (len(path.t_s), 9, 9)
    assert stored["t_s"][0] >= 5


def test_gravity_points_down_in_a_metric_model_and_as_it_was_in_colmap_s(whole, project):
    model, made = whole
    down = gravity_in_model(made)
    np.testing.assert_allclose(down / np.linalg.norm(down), [0, 0, -1], atol=1e-9)
    truth = project.recording.truth.gravity_in_world_m_s2
    in_colmap_s = gravity_in_model(replace(made, similarity=None))
    cosine = in_colmap_s @ truth / np.linalg.norm(in_colmap_s) / np.linalg.norm(truth)
    assert np.degrees(np.arccos(cosine)) < 1
    assert gravity_in_model(model) is None


def test_scaling_leaves_the_model_that_it_was_made_from(whole):
    model, made = whole
    similarity = Similarity(scale=3.0, rotation_xyzw=[0, 0, 0, 1], translation_m=[1, 2, 3], cov=np.zeros((7, 7)))
    image_id = model.reconstruction.reg_image_ids()[0]
    before = np.array(model.reconstruction.image(image_id).projection_center())
    moved = model.scaled(made.scale, similarity)
    np.testing.assert_array_equal(model.reconstruction.image(image_id).projection_center(), before)
    np.testing.assert_allclose(moved.reconstruction.image(image_id).projection_center(), 3 * before + [1, 2, 3])


def test_text_models_count_their_images(whole, tmp_path):
    model, _ = whole
    model.reconstruction.write_text(str(tmp_path))
    assert num_registered(tmp_path) == model.reconstruction.num_reg_images()


def test_only_rectified_models_have_lost_their_readout(whole):
    model, _ = whole
    known = calibration_prior(Declared(readout_s=0.03))
    stage = MetricStage(imu=PANNING, calibration=known)
    assert stage.calibration_of(model) is known
    assert replace(stage, calibration=None).calibration_of(replace(model, rectified=True)) is None
    left = stage.calibration_of(replace(model, rectified=True))
    assert left.readout_s == 0 and 0 < left.sigma("readout_s") < 0.1 * 0.03 + 1e-9
    np.testing.assert_array_equal(left.cam_from_imu_xyzw, known.cam_from_imu_xyzw)
    assert calibration_of_rectified(known).readout_s == 0


def test_velocities_within_the_readout_are_in_the_model_s_unit(whole, project, monkeypatch):
    given = {}

    def settle(reconstruction, shutters, velocity, **more):
        given.update(velocity)
        return reconstruction, Settled(shift_px=0.0, before_px=1.0, after_px=1.0, accepted=False)

    monkeypatch.setattr(readout, "settle_readout", settle)
    model, _ = whole
    imu = project.recording.imu
    ReadoutStage(imu=imu, calibration=None, refine_intrinsics=False)(replace(model, rectified=True))
    truth, names = project.recording.truth, list(given)[100:500:20]
    t_of = dict(zip(model.timing.names, model.timing.pose_t_s(), strict=True))
    shift_s = (model.timing.epoch_ns - project.recording.trajectory.epoch_ns) * 1e-9
    t_s = np.array([t_of[name] for name in names]) + shift_s
    true = (truth.cam_in_model(t_s + 1e-3) - truth.cam_in_model(t_s - 1e-3)) / 2e-3
    found = np.array([given[name] for name in names])
    assert np.linalg.norm(found - true) < 0.1 * np.linalg.norm(true)


def test_the_change_of_the_calibration_is_the_angle_between_both(whole, project, tmp_path):
    model, made = whole
    turned = quat_multiply(quat_exp(np.radians([0.0, 3.0, 0.0])), made.scale.calibration.cam_from_imu_xyzw)
    first = replace(made.scale.calibration, cam_from_imu_xyzw=turned, gyro_time_offset_s=5.0)
    view = GyroView(imu=project.recording.imu, timing=model.timing, calibration=first, camera=CAMERA, source="capture")
    one = ModelResult(index=0, colmap_index=0, scale=made.scale, summary={}, sparse=tmp_path / "sparse")
    result = ReconstructResult(workspace=Workspace(tmp_path), models=(one,), seconds={}, imaging=ImagingPlan(view=view))
    stored = result_as_json(result, Capture(path=tmp_path, calibration=first))["models"][0]["calibration_change"]
    assert stored["rotation_deg"] == pytest.approx(3)
    assert stored["gyro_time_offset_s"] == pytest.approx(made.scale.calibration.gyro_time_offset_s - 5)


def test_the_time_of_a_step_is_that_of_all_models_together(whole, tmp_path):
    _, made = whole
    summary = {"registered_images": 20, "points": 900, "mean_reprojection_error_px": 0.5}
    one = ModelResult(index=0, colmap_index=0, scale=made.scale, summary=summary, sparse=tmp_path / "sparse")
    seconds = {"features": 75.0, "metric_0": 61.0, "metric_1": 120.0, "apply_0": 0.1}
    result = ReconstructResult(workspace=Workspace(tmp_path), models=(one,), seconds=seconds)
    assert dict(terminal._model_lines(one, result))["time"] == "features 1:15, metric 3:01"


# --- stages by the gyroscope -----------------------------------------------------------------------------------------

T_S = np.arange(0.0, 1.0, 0.005)
PANNING = ImuRecording(
    gyro_t_s=T_S,
    gyro_rad_s=np.tile([0.0, 1.0, 0.0], (len(T_S), 1)),
    accel_t_s=T_S,
    accel_m_s2=np.tile([0.0, 0.0, 9.81], (len(T_S), 1)),
)
TIMING = FrameTiming(names=("a.jpg", "late.jpg"), t_s=[0.5, 5.0], exposure_s=[0.01, 0.01], readout_s=0.024)
VIEW = GyroView(
    imu=PANNING,
    timing=TIMING,
    calibration=calibration_prior(Declared(cam_from_imu_xyzw=[0.0, 0.0, 0.0, 1.0], gyro_time_offset_s=0.0)),
    camera=CAMERA,
    source="capture",
)


def test_keypoints_that_were_moved_are_said_to_be_rectified_and_others_are_not():
    stage = RollingShutterStage(view=VIEW)
    xy_px = np.array([[320.0, 0.5], [320.0, 240.5], [320.0, 479.5]])
    moved = stage(Keypoints(name="a.jpg", xy_px=xy_px))
    # half a readout before and after the middle row, the camera looks 0.012 rad to the left and to the right
    turned_px = 500 * np.tan([-0.012, 0.0, 0.012])
    np.testing.assert_allclose(moved.xy_px[:, 0], 320 + turned_px, atol=0.05)
    assert moved.rectified
    left = stage(Keypoints(name="late.jpg", xy_px=xy_px))
    np.testing.assert_array_equal(left.xy_px, xy_px)
    assert not left.rectified


def test_long_blur_is_smoothed_for_features_more_than_short_up_to_a_limit():
    assert smoothing_for(5) < smoothing_for(10) < smoothing_for(30) == smoothing_for(60) == SMOOTHING.most_px


def test_frames_are_dropped_only_by_a_gyroscope_that_the_images_bear_out(subtests):
    for trusted, gone in ((True, True), (None, False)):
        with subtests.test(trusted=trusted, gone=gone):
            decision = FrameDecision(name="a.jpg", blur_px=90.0, action="drop", reason="too much blur")
            verdict = RecordingVerdict(trusted=trusted, support=9.0, extent_factor=1.0, frames=9, reason="")
            stage = DeblurStage(view=VIEW, decisions=(decision,), verdict=verdict, workers=1)
            (frame,) = stage(iter([Frame(name="a.jpg", image=np.zeros((480, 640), np.uint8), t_s=0.5)]))
            assert frame.dropped is gone and str(frame.treatments[-1].reason) == "too much blur"


def panned(length_px):
    """A picture of patches that was moved along its rows."""
    patches = np.random.default_rng(4).uniform(30, 220, (480, 640)).astype(np.float32)
    light = (cv2.resize(patches[:60, :80], (640, 480), interpolation=cv2.INTER_NEAREST) / 255) ** 2.2
    kernel = np.full((1, length_px), 1 / length_px)
    return np.rint(255 * cv2.filter2D(light, -1, kernel) ** (1 / 2.2)).astype(np.uint8)


def test_a_frame_that_would_be_dropped_is_deblurred_where_all_stay(subtests):
    for doubt in ("", "nothing tells the sign"):
        with subtests.test(doubt=doubt):
            decision = FrameDecision(name="a.jpg", blur_px=90.0, action="drop", reason="too much blur")
            verdict = RecordingVerdict(trusted=True, support=9.0, extent_factor=1.0, frames=9, reason="")
            view = replace(
                VIEW, sign_doubt=Fact.stated(doubt) if doubt else None, timing=replace(TIMING, exposure_s=[0.04, 0.04])
            )
            field = blur_field(view.motion(), colmap_camera(view.camera), view.shutter(0))
            image = panned(round(float(np.median(field.extent_px()))))
            stage = DeblurStage(view=view, decisions=(decision,), verdict=verdict, drop=False, workers=1)
            (frame,) = stage(iter([Frame(name="a.jpg", image=image, t_s=0.5)]))
            # the camera pans evenly: the blur is a straight line, the same for both signs
            assert not frame.dropped and frame.treatments[-1].action == "deblurred"
            assert np.abs(np.diff(frame.image.astype(int))).mean() > 1.1 * np.abs(np.diff(image.astype(int))).mean()


def test_a_frame_with_curved_blur_stays_where_nothing_tells_the_sign():
    rate_rad_s = PANNING.gyro_rad_s + np.stack([40 * (T_S - 0.53), 0 * T_S, 0 * T_S], axis=1)
    decision = FrameDecision(name="a.jpg", blur_px=20.0, action="deblur", reason="20 px of blur")
    verdict = RecordingVerdict(trusted=True, support=9.0, extent_factor=1.0, frames=9, reason="")
    timing = replace(TIMING, exposure_s=[0.04, 0.04])
    image = panned(20)
    for doubt in ("", "nothing tells the sign"):
        view = replace(
            VIEW,
            imu=replace(PANNING, gyro_rad_s=rate_rad_s),
            timing=timing,
            sign_doubt=Fact.stated(doubt) if doubt else None,
        )
        stage = DeblurStage(view=view, decisions=(decision,), verdict=verdict, workers=1)
        (frame,) = stage(iter([Frame(name="a.jpg", image=image, t_s=0.5)]))
        assert (frame.treatments[-1].reason.code == "curved-blur-in-doubt") == bool(doubt)
        if doubt:
            np.testing.assert_array_equal(frame.image, image)


# --- a target --------------------------------------------------------------------------------------------------------


def test_pictures_of_a_target_come_back_with_their_model(tmp_path, monkeypatch):
    """Those of a refused model, or without a target, go; the step must not be kept for what it no longer has."""
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "capture.toml")
    target = parse_target("checkerboard:8x6:0.03")
    found = Validation(
        **dict.fromkeys(("tolerance_pct", "rms_px", "corner_noise_px", "pose_noise_px", "metres_per_unit"), 1.0),
        **dict.fromkeys(("views_used", "views_searched", "corners_used", "corners_rejected"), 1),
        **dict.fromkeys(("distances", "corners", "views", "views_rejected", "reasons"), ()),
        **dict.fromkeys(("control", "check", "check_error_pct", "check_ci95_pct", "ci95_pct")),
        target=target,
        unscaled=False,
        scale_error_pct=0.5,
        metres_per_unit_ci95=(0.9, 1.1),
    )
    monkeypatch.setattr(models, "validate_model", lambda *_, **__: found)
    monkeypatch.setattr(models, "write_overlays", lambda found, images, folder: folder.mkdir(parents=True))
    refused = ModelResult(index=0, colmap_index=0, scale=of_refused(), summary={}, sparse=tmp_path / "model")
    accepted = replace(refused, sparse_metric=workspace.sparse / "0")
    pictures, images = workspace.validation / "0", tmp_path / "images"
    images.mkdir()

    def measured(model, target):
        session = session_in(workspace)
        session.runner.run("metric", {}, [], lambda _: None)
        run_validation(session, [model], target, images)
        return "validation_0" in session.runner.worked, pictures.is_dir()

    assert measured(accepted, target) == (True, True)
    assert measured(accepted, target) == (False, True)
    for gone in ((refused, target), (accepted, None)):
        assert measured(*gone) == (False, False)
        assert measured(accepted, target) == (True, True)


def of_refused():
    return ScaleEstimate(
        metres_per_unit=None, sigma_log=None, ci95=None, verdict="refused", method="none", reasons=("it stood still",)
    )
