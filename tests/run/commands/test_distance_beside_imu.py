"""A known distance beside an IMU: one more sensor where it is named, between markers or between points of a project."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions, ReferenceOptions
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.commands.reconstruct_project import reconstruct_project
from colmap_inertial.run.commands.scale_by_reference import scale_project_by
from colmap_inertial.tools.batch import run_batch
from colmap_inertial.tools.batch.manifest import read_manifest
from tests.cli.test_commands import run
from tests.helpers.box_project import FOCAL, HEIGHT, LOW, WIDTH, BoxProject, build, cast, rays
from tests.helpers.box_sensors import write_capture
from tests.helpers.cases import loop_over
from tests.helpers.json_schemas import find_violations
from tests.helpers.validate_scenes import marker_bits

SIDE_M, FINER = 0.6, 4
#: Middles of markers on the floor.
ON_FLOOR = {3: (-1.2, 0.7), 17: (-0.5, -0.4)}
MARKERS = f"aruco:DICT_4X4_50:{SIDE_M}"
APART_M = float(np.hypot(0.7, 1.1))
BETWEEN_MARKERS = ReferenceOptions(target=MARKERS, between=("3", "17"), distance=f"{APART_M}+-0.005")
NAMED = ("imu", "distance")


def paint_markers(box: BoxProject) -> None:
    """Lay the markers into the images, each pixel the mean of finer ones."""
    motion, t_s = box.recording.truth.motion, box.recording.trajectory.t_s
    params = (FINER * FOCAL, FINER * FOCAL, FINER * WIDTH / 2, FINER * HEIGHT / 2)
    directions = rays(FINER * WIDTH, FINER * HEIGHT, params)
    for i, name in zip(box.frames, box.names, strict=True):
        turn = matrix_from_quat(motion.world_from_cam_xyzw(t_s[i : i + 1]))[0]
        centre = motion.cam_in_world_m(t_s[i : i + 1])[0]
        depth, _ = cast(turn, centre, directions)
        seen = centre + depth[..., None] * (directions @ turn.T)
        path = str(box.root / "images" / name)
        image = cv2.resize(cv2.imread(path), None, fx=FINER, fy=FINER, interpolation=cv2.INTER_CUBIC)
        for number, (x, y) in ON_FLOOR.items():
            bits = marker_bits("DICT_4X4_50", number)
            # seen from above: columns along x, rows against y; around it one cell of white
            column, row = (np.floor((v / SIDE_M + 0.5) * len(bits)) for v in (seen[..., 0] - x, y - seen[..., 1]))
            on_floor = np.abs(seen[..., 2] - LOW[2]) < 1e-6
            paper = on_floor & (np.minimum(column, row) >= -1) & (np.maximum(column, row) <= len(bits))
            bits = np.pad(bits, 1, constant_values=True)
            image[paper] = np.where(bits[row[paper].astype(int) + 1, column[paper].astype(int) + 1], 230, 20)[:, None]
        image = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
        cv2.imwrite(path, image, [cv2.IMWRITE_JPEG_QUALITY, 95])


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """Tests must not change it."""
    box = build(tmp_path_factory.mktemp("box"), every=10, points=1500)
    paint_markers(box)
    return box


def options(*scale_from, refine="off"):
    return ReconstructOptions(refine=refine, scale_from=scale_from)


def with_imu(box, out, reference, chosen):
    source = ProjectOptions(imu=box.imu, frame_times=box.frame_times)
    return reconstruct_project(box.root, out, source, chosen, reference=reference)


def between_images(box, error=1.0, sigma_m=0.004):
    """The true distance of the two cameras farthest apart, as a user would give it, and what it is in the model."""
    motion, t_s = box.recording.truth.motion, box.recording.trajectory.t_s[list(box.frames)]
    true = motion.cam_in_world_m(t_s)
    apart = np.linalg.norm(true[:, None] - true, axis=-1)
    ends = np.unravel_index(np.argmax(apart), apart.shape)
    model = pycolmap.Reconstruction(str(box.root / "sparse" / "0"))
    a, b = (model.find_image_with_name(box.names[k]).projection_center() for k in ends)
    texts = tuple(",".join(f"{value:.15g}" for value in end) for end in (a, b))
    given = ReferenceOptions(between=texts, distance=f"{error * apart[ends]:.9g}+-{sigma_m}")
    return given, error * apart[ends] / np.linalg.norm(a - b)


def log_off(box, found):
    return np.log(found.metres_per_unit / box.recording.truth.metres_per_unit)


def test_a_distance_of_points_joins_the_imu(box, tmp_path, capsys):
    given, true_by_points = between_images(box)
    result = with_imu(box, tmp_path / "out", given, options(*NAMED))
    (model,) = result.models
    combined = model.scale.sensors
    assert [one.sensor for one in combined.evidence] == list(NAMED) and combined.absent == ()
    imu, distance = combined.evidence
    # the points are COLMAP's, though it is measured in the model that the IMU made metric
    assert distance.metres_per_unit == pytest.approx(true_by_points, rel=1e-9)
    assert combined.sigma <= min(imu.sigma, distance.sigma) and model.scale.verdict == "trusted"
    assert combined.ci95[0] < box.recording.truth.metres_per_unit < combined.ci95[1]
    assert find_violations("result", tmp_path / "out" / "result.json") == []
    # without the IMU it says the same
    alone = scale_project_by(box.root, tmp_path / "alone", given, scale_from=("distance",))
    assert alone.sensors.metres_per_unit == pytest.approx(distance.metres_per_unit, rel=1e-9)
    args = ["--imu", box.imu, "--frame-times", box.frame_times, "--refine", "off", "--json", "-"]
    args += ["--scale-from", "imu", "--scale-from", "distance", "--distance", given.distance]
    code, said, err = run(capsys, "reconstruct", box.root, tmp_path / "again", *args, "--between", *given.between)
    assert code == 0, err
    (again,) = json.loads(said)["models"]
    assert again["metres_per_unit"] == pytest.approx(model.scale.metres_per_unit, rel=1e-9)


def test_a_batch_takes_a_distance_from_its_manifest(box, tmp_path):
    given, true_by_points = between_images(box)
    manifest = tmp_path / "m.toml"
    project = f'project.imu = "{box.imu}"\nproject.frame_times = "{box.frame_times}"\n'
    lengths = f'reference.between = {json.dumps(given.between)}\nreference.distance = "{given.distance}"\n'
    named = 'options.refine = "off"\noptions.scale_from = ["imu", "distance"]\n'
    manifest.write_text(f'[[capture]]\nname = "box"\npath = "{box.root}"\n{project}{named}{lengths}')
    (capture,) = read_manifest(manifest)
    assert capture.reference == given
    batch = run_batch(manifest, tmp_path / "out")
    assert batch.captures[0].state == "done", batch.captures[0].error
    file = tmp_path / "out" / "box" / "result.json"
    (model,) = json.loads(file.read_text())["models"]
    (distance,) = [one for one in model["sensors"]["evidence"] if one["sensor"] == "distance"]
    assert distance["metres_per_unit"] == pytest.approx(true_by_points, rel=1e-9)
    assert find_violations("result", file) == []
    assert run_batch(manifest, tmp_path / "out").unchanged
    # another length does not pass for the earlier one
    other = dataclasses.replace(capture, reference=dataclasses.replace(given, distance="2+-0.01"))
    (end,) = run_batch([other], tmp_path / "out").captures
    assert end.exit_code == 2


def test_a_distance_of_markers_joins_the_imu_and_a_target_beside(box, tmp_path):
    result = with_imu(box, tmp_path / "out", BETWEEN_MARKERS, options(*NAMED, "target"))
    (model,) = result.models
    combined = model.scale.sensors
    assert [one.sensor for one in combined.evidence] == ["imu", "target", "distance"]
    distance = combined.of("distance")
    assert abs(log_off(box, distance)) < 2.6 * distance.sigma and distance.sigma < 0.01
    assert abs(log_off(box, combined)) < 2.6 * combined.sigma


def test_the_markers_of_a_distance_check_the_metres_where_no_target_is_named(box, tmp_path):
    result = with_imu(box, tmp_path / "out", BETWEEN_MARKERS, options(*NAMED))
    (model,) = result.models
    assert [one.sensor for one in model.scale.sensors.evidence] == list(NAMED)
    assert model.validation.target.spec == MARKERS


def test_a_distance_that_is_wrong_is_named(box, tmp_path):
    given, _ = between_images(box, error=1.2)
    result = with_imu(box, tmp_path / "out", given, options(*NAMED))
    (model,) = result.models
    (fact,) = [reason for reason in model.scale.reasons if reason.code == "sensors-contradict"]
    assert {fact.values["first"], fact.values["second"]} == set(NAMED) and model.scale.verdict == "weak"


def test_a_marker_that_was_not_measured_is_said_and_the_imu_s_metres_stay(box, tmp_path):
    given = ReferenceOptions(target=MARKERS, between=("3", "40"), distance="2+-0.01")
    result = with_imu(box, tmp_path / "out", given, options(*NAMED))
    (model,) = result.models
    (absent,) = model.scale.sensors.absent
    assert absent.sensor == "distance" and absent.reasons[0].values["why"].code == "marker-not-measured"
    assert [one.sensor for one in model.scale.sensors.evidence] == ["imu"] and model.scale.verdict == "trusted"


@loop_over(
    ("given", "scale_from", "refine", "code"),
    [
        ({"between": ("1,2,3", "4,5,6"), "distance": "2+-0.1"}, (), "off", "distance-not-named"),
        ({"between": ("1,2,3", "4,5,6"), "distance": "2+-0.1"}, ("imu",), "off", "distance-not-named"),
        ({"between": ("1,2,3", "4,5,6"), "distance": "2+-0.1"}, NAMED, "auto", "points-of-another-model"),
        ({"between": ("1,2,3", "4,5,x"), "distance": "2+-0.1"}, NAMED, "off", "point-unreadable"),
        ({"between": ("3", "17"), "distance": "2+-0.1"}, NAMED, "off", "markers-not-given"),
        ({"between": ("3", "x"), "distance": "2+-0.1", "target": MARKERS}, NAMED, "off", "marker-unreadable"),
        ({"between": ("3", "3"), "distance": "2+-0.1", "target": MARKERS}, NAMED, "off", "one-place"),
        (
            {"between": ("3", "7"), "distance": "2+-0.1", "target": "checkerboard:8x6:0.04"},
            *(NAMED, "off", "markers-not-given"),
        ),
        ({"between": ("3", "1,2,3"), "distance": "2+-0.1", "target": MARKERS}, NAMED, "off", "between-of-one-kind"),
        ({"between": ("3", "17")}, NAMED, "off", "distance-not-given"),
        ({}, NAMED, "off", "distance-not-given"),
        ({}, ("imu", "target"), "off", "target-not-given"),
    ],
)
def test_what_cannot_be_is_said_before_any_work(box, tmp_path, given, scale_from, refine, code):
    with pytest.raises(InertialError) as error:
        with_imu(box, tmp_path / "out", ReferenceOptions(**given), options(*scale_from, refine=refine))
    assert error.value.code == code and not (tmp_path / "out").exists()


def test_points_belong_to_one_model(box, tmp_path):
    project = tmp_path / "project"
    shutil.copytree(box.root, project)
    shutil.copytree(project / "sparse" / "0", project / "sparse" / "1")
    given, _ = between_images(box)
    source = ProjectOptions(imu=box.imu, frame_times=box.frame_times)
    with pytest.raises(InertialError) as error:
        reconstruct_project(project, tmp_path / "out", source, options(*NAMED), reference=given)
    assert error.value.code == "points-of-another-model" and not (tmp_path / "out").exists()


def test_a_capture_has_no_points_yet_and_its_distance_must_be_named(box, tmp_path):
    capture: Path = write_capture(box, tmp_path / "capture")
    points, _ = between_images(box)
    for given, chosen, code in (
        (points, options(*NAMED), "points-need-a-model"),
        (BETWEEN_MARKERS, options(), "distance-not-named"),
    ):
        with pytest.raises(InertialError) as error:
            reconstruct(capture, tmp_path / "out", chosen, reference=given)
        assert error.value.code == code and not (tmp_path / "out").exists()
