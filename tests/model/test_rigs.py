"""Two cameras that are fixed to each other: a COLMAP project with a rig, its times as they were recorded, and truth."""

import dataclasses
import json
import logging
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import InertialError, TimingError
from colmap_inertial.core.geometry import matrix_from_quat, quat_rotate
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.io.frame_times import stamps_of_pattern
from colmap_inertial.io.frames import read_frame_times
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.trajectories import read_tum
from colmap_inertial.model import read_model, trajectory_from_model
from colmap_inertial.model.rigs import frames_of_rigs, list_posed_frames, rig_sensors
from colmap_inertial.run.commands.reconstruct_project import reconstruct_project
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, SfmOptions, simulate_recording
from tests.helpers.box_project import FOCAL, HEIGHT, HIGH, LOW, WIDTH
from tests.helpers.simulated_project import write_project

#: Second camera against the first, in metres.
TURN, SHIFT_M = pycolmap.Rotation3d(np.array([0.0, 0.06, 0.02])), np.array([-0.11, 0.004, 0.01])
POINTS = 400


@dataclasses.dataclass(frozen=True)
class RigProject:
    root: Path
    imu: Path
    frame_times: Path
    recording: object

    def source(self, **more):
        return ProjectOptions(imu=self.imu, **({"frame_times": self.frame_times} | more))


def write_rig_model(recording, folder, *, skip=(), turn=TURN, shift_m=SHIFT_M):
    """COLMAP's model of frames of two cameras, ``cam0`` and ``cam1``; without some images by name."""
    rng = np.random.default_rng(3)
    truth, trajectory = recording.truth, recording.trajectory
    axis, side = rng.integers(0, 3, POINTS), rng.integers(0, 2, POINTS)
    world = rng.uniform(LOW, HIGH, (POINTS, 3))
    world[np.arange(POINTS), axis] = np.where(side, HIGH[axis], LOW[axis])
    placed = quat_rotate(truth.model_from_world_xyzw, world) / truth.metres_per_unit + truth.world_in_model
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    cam_from_rig = pycolmap.Rigid3d(turn, shift_m / truth.metres_per_unit)
    for number in (1, 2):
        params = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
        camera = pycolmap.Camera(camera_id=number, model="PINHOLE", width=WIDTH, height=HEIGHT, params=params)
        model.add_camera(camera)
        if number == 1:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, cam_from_rig)
    model.add_rig(rig)
    tracks = [pycolmap.Track() for _ in range(POINTS)]
    images = 0
    for i in range(len(trajectory)):
        rotation = pycolmap.Rotation3d(trajectory.cam_from_world_xyzw[i])
        rig_from_world = pycolmap.Rigid3d(rotation, -(rotation.matrix() @ trajectory.cam_in_world[i]))
        frame = pycolmap.Frame(frame_id=i + 1, rig_id=1)
        members = []
        for number, name in ((1, f"cam0/f{i:05}.jpg"), (2, f"cam1/f{i:05}.jpg")):
            if name in skip:
                continue
            images += 1
            t = trajectory.t_s[i : i + 1]
            cam = (world - truth.motion.cam_in_world_m(t)) @ matrix_from_quat(truth.motion.world_from_cam_xyzw(t))[0]
            if number == 2:
                cam = cam @ turn.matrix().T + shift_m
            with np.errstate(divide="ignore", invalid="ignore"):
                px = FOCAL * cam[:, :2] / cam[:, 2:] + [WIDTH / 2, HEIGHT / 2]
            seen = np.flatnonzero((cam[:, 2] > 0.1) & (px > 1).all(1) & (px < [WIDTH - 1, HEIGHT - 1]).all(1))
            for place, k in enumerate(seen):
                tracks[k].add_element(images, place)
            observed = px[seen] + rng.normal(0, 0.3, (len(seen), 2))
            points = [pycolmap.Point2D(xy) for xy in observed]
            image = pycolmap.Image(name=name, camera_id=number, image_id=images, frame_id=i + 1, points2D=points)
            frame.add_data_id(image.data_id)
            members.append(image)
        frame.rig_from_world = rig_from_world
        model.add_frame(frame)
        for image in members:
            model.add_image(image)
        model.register_frame(i + 1)
    for xyz, track in zip(placed, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(xyz, track, np.array([200, 180, 160], dtype=np.uint8))
    folder.mkdir(parents=True)
    model.write_binary(str(folder))


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """20 s by hand, 5 frames a second of both cameras; a frame without the first one's image. Tests change nothing."""
    root = tmp_path_factory.mktemp("rig")
    sfm = SfmOptions(frame_rate_hz=5, position_white_m=0.0005, position_correlated_m=0.0005)
    recording = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=20), sfm=sfm), seed=4)
    given = write_project(root / "given", recording)
    write_rig_model(recording, root / "project" / "sparse" / "0", skip={"cam0/f00007.jpg"})
    rows = given.frame_times.read_text().splitlines()
    both = [f"{camera}/f{row}" for row in rows[1:] for camera in ("cam1", "cam0")]
    times = root / "both.csv"
    times.write_text("\n".join([rows[0], *both]) + "\n")
    return RigProject(root / "project", given.imu, times, recording)


@pytest.fixture(scope="module")
def metric(rig, tmp_path_factory):
    out = tmp_path_factory.mktemp("metric") / "out"
    return reconstruct_project(rig.root, out, rig.source())


def test_a_synchronised_rig_becomes_metric_without_a_hand_on_its_times(rig, metric):
    (model,) = metric.models
    assert model.scale.verdict == "trusted", model.scale.reasons
    # as surely as its interval says, and as one camera by itself
    truth = rig.recording.truth.metres_per_unit
    assert model.scale.ci95[0] < truth < model.scale.ci95[1]
    one = trajectory_from_model(
        without_second(read_model(model.sparse)),
        read_frame_times(rig.frame_times, frames_of_rigs([read_model(model.sparse)])),
    )[0]
    alone = estimate_scale(one, read_imu(rig.imu)).metres_per_unit
    assert abs(np.log(model.scale.metres_per_unit / alone)) < 2e-3
    assert abs(np.log(model.scale.metres_per_unit / truth)) < abs(np.log(alone / truth)) + 1e-3
    assert not [note for note in model.scale.notes if "no frame time" in str(note)]


def test_the_cameras_are_placed_in_metres_in_result_and_model(rig, metric):
    off = metric.models[0].scale.metres_per_unit / rig.recording.truth.metres_per_unit
    said = json.loads(metric.workspace.result.read_text())["models"][0]["rig"]
    written = rig_sensors(read_model(metric.models[0].sparse_metric))
    for sensor in (*said, *(dataclasses.asdict(one) for one in written)):
        assert (sensor["camera_id"], sensor["reference_id"]) == (2, 1)
        assert sensor["baseline_m"] == pytest.approx(off * np.linalg.norm(SHIFT_M), rel=1e-9)
        np.testing.assert_allclose(sensor["translation_m"], off * SHIFT_M, rtol=1e-9)
        np.testing.assert_allclose(sensor["cam_from_reference_xyzw"], TURN.quat, atol=1e-9)
    page = metric.report.read_text().replace("\N{NO-BREAK SPACE}", " ")
    assert f"camera 2 is {1000 * said[0]['baseline_m']:.1f} mm from camera 1" in page


def test_virtual_cameras_of_a_panorama_have_one_centre(rig, tmp_path):
    """As COLMAP's example of panoramas makes them: views in several directions from one place."""
    across = pycolmap.Rotation3d(np.array([0.0, np.pi / 2, 0.0]))
    sparse = tmp_path / "project" / "sparse" / "0"
    write_rig_model(rig.recording, sparse, turn=across, shift_m=np.zeros(3))
    made = reconstruct_project(tmp_path / "project", tmp_path / "out", rig.source())
    (model,) = made.models
    assert model.scale.verdict == "trusted", model.scale.reasons
    assert model.scale.ci95[0] < rig.recording.truth.metres_per_unit < model.scale.ci95[1]
    (sensor,) = rig_sensors(read_model(model.sparse_metric))
    assert sensor.baseline_m == 0
    np.testing.assert_allclose(sensor.cam_from_reference_xyzw, across.quat, atol=1e-9)
    assert "camera 2 is 0 mm from camera 1" in made.report.read_text().replace("\N{NO-BREAK SPACE}", " ")


def test_a_wrong_frame_is_left_out_with_the_words_that_it_is_not_registered_again(rig, tmp_path, caplog):
    model = read_model(rig.root / "sparse" / "0")
    frame = model.frame(21)
    off = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.5, 0.0])), np.zeros(3))
    frame.rig_from_world = off * frame.rig_from_world
    sparse = tmp_path / "project" / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    with caplog.at_level(logging.INFO):
        made = reconstruct_project(tmp_path / "project", tmp_path / "out", rig.source())
    (said,) = [done for done in made.models[0].treatments if done.stage == "rotations"]
    assert said.action == "left out" and "images of several cameras are not registered again" in str(said.reason)
    kept = {image.name for image in read_model(made.models[0].sparse_metric).images.values()}
    assert kept == {image.name for image in model.images.values()} - {"cam0/f00020.jpg", "cam1/f00020.jpg"}
    assert "the path's covariance is that of its smoothing, without drift" in caplog.text


def test_the_path_is_that_of_the_reference_camera_also_where_it_took_no_image(rig, metric):
    path = read_tum(metric.models[0].trajectory)
    assert len(path) == len(rig.recording.trajectory)
    truth = rig.recording.truth.motion.cam_in_world_m(rig.recording.trajectory.t_s)
    steps = np.linalg.norm(np.diff(path.cam_in_world, axis=0), axis=1)
    np.testing.assert_allclose(steps, np.linalg.norm(np.diff(truth, axis=0), axis=1), atol=4e-3)


def test_refinement_says_that_it_does_not_take_rigs(rig, metric, tmp_path):
    (said,) = [t for t in metric.models[0].treatments if t.stage == "refine"]
    assert str(said.reason).startswith("not refined: its images are of several cameras") and not said.action
    asked = ReconstructOptions(refine="inertial")
    with pytest.raises(InertialError, match="models with rigs cannot be refined"):
        reconstruct_project(rig.root, tmp_path / "out", rig.source(), asked)
    assert not (tmp_path / "out").exists()


def test_in_two_steps_it_is_the_same(rig, metric, tmp_path, capsys):
    scale = tmp_path / "scale.json"
    words = ["--imu", str(rig.imu), "--frame-times", str(rig.frame_times), "--json", str(scale)]
    with pytest.raises(SystemExit) as stop:
        main(["scale", str(rig.root / "sparse" / "0"), *words])
    assert stop.value.code == 0, capsys.readouterr()
    assert json.loads(scale.read_text())["metres_per_unit"] == pytest.approx(
        metric.models[0].scale.metres_per_unit, rel=1e-9
    )
    with pytest.raises(SystemExit) as stop:
        main(["apply", str(rig.root), str(tmp_path / "applied"), "--scale", str(scale)])
    assert stop.value.code == 0, capsys.readouterr()
    (sensor,) = rig_sensors(read_model(tmp_path / "applied" / "sparse" / "0"))
    assert sensor.baseline_m == pytest.approx(metric.models[0].rig[0].baseline_m, rel=1e-9)


def test_both_cameras_tell_of_a_pose(rig):
    model = read_model(rig.root / "sparse" / "0")
    timing = read_frame_times(rig.frame_times, frames_of_rigs([model]))
    both, _ = trajectory_from_model(model, timing)
    assert both.names[7] == "cam1/f00007.jpg" and both.names[8] == "cam0/f00008.jpg"
    alone = trajectory_from_model(without_second(model), timing)[0]
    kept = [both.names.index(name) for name in alone.names]
    np.testing.assert_allclose(both.cam_in_world[kept], alone.cam_in_world, atol=1e-9)
    sigma = [np.sqrt(np.trace(one.pose_cov[k][3:, 3:])) for one, k in ((both, kept[20]), (alone, 20))]
    assert 0.5 < sigma[0] / sigma[1] < 0.85


def without_second(model):
    """The first camera's images alone, without a rig."""
    alone = pycolmap.Reconstruction()
    alone.add_camera_with_trivial_rig(model.camera(1))
    place = {}
    for frame in list_posed_frames(model):
        first = frame.images[0]
        if first.camera_id == 1:
            points = [pycolmap.Point2D(point.xy) for point in first.points2D]
            image = pycolmap.Image(name=first.name, camera_id=1, image_id=first.image_id, points2D=points)
            alone.add_image_with_trivial_frame(image, frame.pose)
            place[first.image_id] = first
    for point in model.points3D.values():
        track = pycolmap.Track()
        for element in point.track.elements:
            if element.image_id in place:
                track.add_element(element.image_id, element.point2D_idx)
        if track.length():
            alone.add_point3D(point.xyz, track, point.color)
    return alone


def test_times_in_names_with_folders(rig, tmp_path):
    first_of = frames_of_rigs([read_model(rig.root / "sparse" / "0")])
    names = sorted(first_of)
    for pattern in ("*/f{ms}.jpg", "cam[01]/f{ms}", "ms"):
        stamps = stamps_of_pattern(Path(), names, pattern)
        assert len(stamps.names) == len(names)
        frames = stamps.one_per_frame(first_of)
        assert len(frames.names) == len(set(first_of.values()))
    timing = stamps_of_pattern(Path(), names, "cam0/f{ms}.jpg").one_per_frame(first_of).timing()
    assert {Path(name).parts[0] for name in timing.names} == {"cam0"}
    with pytest.raises(TimingError, match="no image lies in a folder 'left'"):
        stamps_of_pattern(Path(), names, "left/f{ms}")
    with pytest.raises(TimingError, match=r"have the same time.*as a rig"):
        stamps_of_pattern(Path(), names, "ms").timing()


def test_cameras_that_are_not_synchronised_are_refused_in_words(rig, tmp_path):
    rows = rig.frame_times.read_text().splitlines()
    times = tmp_path / "late.csv"

    def delay(by_ns):
        cells = [row.split(",") for row in rows[1:]]
        late = [f"{name},{int(t_ns) + by_ns * name.startswith('cam1')}" for name, t_ns in cells]
        times.write_text("\n".join([rows[0], *late]) + "\n")

    delay(1_500_000)
    with pytest.raises(TimingError, match=r"of one frame of a rig, but their times are 1\.5 ms apart"):
        reconstruct_project(rig.root, tmp_path / "out", rig.source(frame_times=times))
    # half a millisecond is one moment, and the reference camera's
    delay(500_000)
    first_of = frames_of_rigs([read_model(rig.root / "sparse" / "0")])
    late, exact = (read_frame_times(path, first_of) for path in (times, rig.frame_times))
    assert late.names == exact.names
    moved = np.flatnonzero(late.t_s != exact.t_s)
    assert [late.names[k] for k in moved] == ["cam1/f00007.jpg"]


def test_the_times_of_one_camera_are_enough(rig, tmp_path):
    rows = rig.frame_times.read_text().splitlines()
    times = tmp_path / "one.csv"
    times.write_text("\n".join([rows[0], *(row for row in rows[1:] if row.startswith("cam1"))]) + "\n")
    model = read_model(rig.root / "sparse" / "0")
    timing = read_frame_times(times, frames_of_rigs([model]))
    one, notes = trajectory_from_model(model, timing)
    both, _ = trajectory_from_model(model, read_frame_times(rig.frame_times, frames_of_rigs([model])))
    assert notes == () and len(one) == len(both)
    np.testing.assert_array_equal(one.cam_in_world, both.cam_in_world)


def test_two_cameras_without_a_rig_are_told_what_to_do(rig, project, tmp_path):
    times = tmp_path / "frames.csv"
    text = project.frame_times.read_text().splitlines()
    times.write_text("\n".join([*text, text[5].replace("0000", "other", 1)]) + "\n")
    (tmp_path / "project" / "sparse").mkdir(parents=True)
    shutil.copytree(project.model, tmp_path / "project" / "sparse" / "0")
    with pytest.raises(TimingError, match="holds the cameras as a rig; else give the times of one camera's images"):
        reconstruct_project(tmp_path / "project", tmp_path / "out", ProjectOptions(imu=project.imu, frame_times=times))
