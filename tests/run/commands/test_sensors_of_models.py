"""``reconstruct`` with all that a capture holds: IMU, depth, the device's path, positions; each wrong, each alone."""

import json
import shutil

import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.errors import InertialError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions, ReferenceOptions
from colmap_inertial.core.types import ScaleEstimate
from colmap_inertial.io.capture import load_capture
from colmap_inertial.run.commands.reconstruct_project import reconstruct_project
from colmap_inertial.run.commands.scale_by_reference import has_imu, knows_metres, scale_project_by
from colmap_inertial.run.stages import sensors
from tests.helpers.box_project import build
from tests.helpers.box_sensors import DepthErrors, PathErrors, write_capture
from tests.helpers.json_schemas import find_violations
from tests.helpers.markers_in_model import validated
from tests.helpers.position_walks import geodetic_of_enu, turn
from tests.run.commands.test_georeference import ORIGIN, with_position


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """Tests must not change it."""
    return build(tmp_path_factory.mktemp("box"), every=10, points=1500)


@pytest.fixture(scope="module")
def by_imu(box, tmp_path_factory):
    """The result by the IMU alone."""
    return run(box, tmp_path_factory.mktemp("imu"))


def run(box, root, *, scale_from=(), **errors):
    toml = write_capture(box, root / "capture", **errors)
    source = ProjectOptions(imu=toml, frame_times=toml)
    return reconstruct_project(box.root, root / "out", source, ReconstructOptions(refine="off", scale_from=scale_from))


def of(result, sensor):
    (model,) = result.models
    found = model.scale.sensors.of(sensor)
    assert found is not None
    return found


def centres(folder, names):
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    return np.array([model.find_image_with_name(name).projection_center() for name in names])


def test_a_capture_with_an_imu_alone_has_no_table(by_imu):
    (model,) = by_imu.models
    assert model.scale.sensors is None and model.scale.verdict == "trusted"


def test_all_sensors_are_in_one_table_and_the_model_has_their_metres(box, by_imu, tmp_path):
    result = run(box, tmp_path, depth=DepthErrors(factor=1.01), path=PathErrors(factor=0.97))
    (model,) = result.models
    true = box.recording.truth.metres_per_unit
    combined = model.scale.sensors
    assert [one.sensor for one in combined.evidence] == ["imu", "depth", "device"]
    imu = by_imu.models[0].scale
    assert of(result, "imu").metres_per_unit == pytest.approx(imu.metres_per_unit, rel=1e-9)
    depth = of(result, "depth")
    assert np.log(depth.metres_per_unit / true / 1.01) == pytest.approx(0, abs=2.6 * depth.random_sigma)
    assert combined.ci95[0] < true < combined.ci95[1] and model.scale.verdict == "trusted"
    # the device's path is too short by 3 %
    error, sigma = combined.device.log_error, combined.device.sigma
    assert error == pytest.approx(np.log(0.97), abs=1.96 * sigma) and error + 1.96 * sigma < 0
    assert len(combined.device.parts) > 2
    # models, paths and similarities are larger by just what the scale is
    longer = model.scale.metres_per_unit / imu.metres_per_unit
    before, after = (centres(one.workspace.root, box.names) for one in (by_imu, result))
    np.testing.assert_allclose(after, longer * before, rtol=1e-9, atol=1e-9)
    similarity = json.loads((result.workspace.root / "transform.json").read_text())
    assert json.dumps(model.scale.metres_per_unit)[:10] in json.dumps(similarity)
    paths = [np.loadtxt(one.workspace.root / "trajectory.tum")[:, 1:4] for one in (by_imu, result)]
    assert np.linalg.norm(paths[1] - longer * paths[0], axis=1).max() < 0.01
    written = json.loads((result.workspace.root / "result.json").read_text())["models"][0]["sensors"]
    assert [one["sensor"] for one in written["evidence"]] == ["imu", "depth", "device"]
    assert find_violations("result", result.workspace.root / "result.json") == []
    assert find_violations("report", result.workspace.root / "report.json") == []


def test_a_depth_sensor_that_is_wrong_is_named(box, tmp_path):
    result = run(box, tmp_path, depth=DepthErrors(factor=1.12))
    (model,) = result.models
    (fact,) = [reason for reason in model.scale.reasons if reason.code == "sensors-contradict"]
    assert {fact.values["first"], fact.values["second"]} == {"imu", "depth"}
    assert model.scale.verdict == "weak"


def test_depth_of_another_unit_does_not_take_the_imu_s_metres_away(box, by_imu, tmp_path):
    result = run(box, tmp_path, depth=DepthErrors(factor=1.6))
    (model,) = result.models
    assert model.scale.metres_per_unit == pytest.approx(by_imu.models[0].scale.metres_per_unit, rel=1e-9)
    assert model.scale.verdict == "weak" and "sensors-contradict" in [one.code for one in model.scale.reasons]


def test_a_jump_of_the_device_s_path_is_a_finding(box, tmp_path):
    result = run(box, tmp_path, path=PathErrors(jump_m=0.4))
    (model,) = result.models
    why = [reason.values["why"] for reason in model.scale.reasons if reason.code == "sensor-in-doubt"]
    assert [fact.code for fact in why] == ["device-path-breaks"] and model.scale.verdict == "weak"
    half_s = 0.5 * float(np.ptp(box.recording.trajectory.t_s))
    assert why[0].values["at_s"] == pytest.approx(half_s, abs=1.0)


def test_sensors_can_be_chosen(box, by_imu, tmp_path):
    result = run(box, tmp_path, scale_from=("depth",), depth=DepthErrors(), path=PathErrors())
    (model,) = result.models
    assert [one.sensor for one in model.scale.sensors.evidence] == ["depth"]
    assert [one.sensor for one in model.scale.sensors.absent] == ["imu"]
    assert model.scale.metres_per_unit == model.scale.sensors.metres_per_unit
    # up is the IMU's all the same
    np.testing.assert_allclose(
        model.scale.gravity_in_world_m_s2, by_imu.models[0].scale.gravity_in_world_m_s2, rtol=1e-9
    )
    with pytest.raises(InertialError) as error:
        run(box, tmp_path / "none", scale_from=("imu", "device"))
    assert error.value.fact.code == "sensor-not-there"


def test_where_the_imu_s_scale_is_refused_the_others_give_it_and_which_way_is_up(box, tmp_path, monkeypatch):
    refused = ScaleEstimate.refused("none", Fact("camera-still"))
    monkeypatch.setattr("colmap_inertial.run.stages.metric.estimate_scale", lambda *_, **__: refused)
    result = run(box, tmp_path, depth=DepthErrors(), path=PathErrors(factor=0.99))
    (model,) = result.models
    low, high = model.scale.ci95
    assert low < box.recording.truth.metres_per_unit < high and model.sparse_metric is not None
    assert [one.sensor for one in model.scale.sensors.evidence] == ["depth", "device"]
    assert [one.sensor for one in model.scale.sensors.absent] == ["imu"]
    assert "up-by-sensor" in [note.code for note in model.scale.notes]
    assert up_in(tmp_path / "out", box)[2] > np.cos(np.radians(1.5))
    assert result.report is not None and find_violations("result", tmp_path / "out" / "result.json") == []


def test_a_target_that_is_named_gives_metres_and_else_checks_them(box, tmp_path, monkeypatch):
    """The board is found by a stand-in, which says what it would measure in a model of COLMAP's units."""
    true = box.recording.truth.metres_per_unit
    asked = []

    def measured(model, images, target, options=None, *, progress=None):
        asked.append((model.num_reg_images(), images, target.spec))
        assert options is not None and options.unscaled
        # in the metres of the IMU
        return validated(true / by_imu_scale[0], unscaled=True)

    by_imu_scale = [0.0]
    monkeypatch.setattr(sensors, "validate_model", measured)
    original = sensors.SensorStage.__call__

    def noted(self, model):
        by_imu_scale[0] = model.similarity.scale
        return original(self, model)

    monkeypatch.setattr(sensors.SensorStage, "__call__", noted)
    toml = write_capture(box, tmp_path / "capture")
    toml.write_text(toml.read_text() + '[target]\nspec = "aruco:DICT_4X4_50:0.1"\n')
    source = ProjectOptions(imu=toml, frame_times=toml)
    options = ReconstructOptions(refine="off", scale_from=("imu", "target"))
    monkeypatch.setattr(
        "colmap_inertial.run.commands.reconstruct_project.run_validation", lambda _, models, *__: models
    )
    result = reconstruct_project(box.root, tmp_path / "out", source, options)
    target = of(result, "target")
    assert target.metres_per_unit == pytest.approx(true, rel=1e-6)
    assert asked == [(len(box.names), box.root / "images", "aruco:DICT_4X4_50:0.1")]
    assert abs(np.log(result.models[0].scale.metres_per_unit / true)) < abs(
        np.log(of(result, "imu").metres_per_unit / true)
    )
    asked.clear()
    plain = reconstruct_project(box.root, tmp_path / "plain", source, ReconstructOptions(refine="off"))
    assert asked == [] and plain.models[0].scale.sensors is None


# --- without an IMU --------------------------------------------------------------------------------------------------


def without_imu(box, root, project=None, **sensors):
    source = ProjectOptions()
    if sensors:
        toml = write_capture(box, root / "capture", imu=False, **sensors)
        source = ProjectOptions(frame_times=toml)
    return scale_project_by(project or box.root, root / "out", ReferenceOptions(), source)


def up_in(folder, box):
    """The true direction against gravity in a model."""
    motion, t_s = box.recording.truth.motion, box.recording.trajectory.t_s[list(box.frames)]
    of_model, true = (
        points - points.mean(axis=0) for points in (centres(folder, box.names), motion.cam_in_world_m(t_s))
    )
    u, _, vt = np.linalg.svd(of_model.T @ true)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt @ (0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("sensors", "named"),
    [
        ({"depth": DepthErrors(factor=0.99)}, ("depth",)),
        ({"path": PathErrors(factor=1.02)}, ("device",)),
        ({"depth": DepthErrors(), "path": PathErrors(factor=0.99)}, ("depth", "device")),
    ],
)
def test_what_there_is_gives_metres_and_up(box, tmp_path, sensors, named):
    found = without_imu(box, tmp_path, **sensors)
    true = box.recording.truth.metres_per_unit
    assert found.scale_from == named
    low, high = found.sensors.ci95
    assert low < true < high and high / low < 1.12
    written = json.loads((tmp_path / "out" / "scale.json").read_text())
    assert written["metres_per_unit"] == found.sensors.metres_per_unit
    codes = [note["code"] for note in written["notes_details"]]
    if "device" in named:
        assert "up-by-sensor" in codes and up_in(tmp_path / "out", box)[2] > np.cos(np.radians(1.5))
    else:
        assert "up-unknown-without-imu" in codes


def test_positions_alone_give_metres_and_up(box, tmp_path):
    shutil.copytree(box.root, tmp_path / "project")
    motion, t_s = box.recording.truth.motion, box.recording.trajectory.t_s[list(box.frames)]
    enu = motion.cam_in_world_m(t_s) @ turn(0.7).T
    enu += 0.03 * np.random.default_rng(1).standard_normal(enu.shape)
    for name, place in zip(box.names, geodetic_of_enu(enu, ORIGIN), strict=True):
        with_position(tmp_path / "project" / "images" / name, *place)
    found = without_imu(box, tmp_path, tmp_path / "project")
    low, high = found.sensors.ci95
    assert found.scale_from == ("positions",) and low < box.recording.truth.metres_per_unit < high
    assert up_in(tmp_path / "out", box)[2] > np.cos(np.radians(5))


def test_without_anything_nothing_is_said(box, tmp_path):
    with pytest.raises(NotObservableError) as error:
        without_imu(box, tmp_path)
    assert error.value.fact.code == "no-sensor-gives-scale" and not (tmp_path / "out").exists()


def test_a_capture_says_what_it_holds(box, tmp_path):
    with_imu = write_capture(box, tmp_path / "imu")
    with_depth = write_capture(box, tmp_path / "depth", imu=False, depth=DepthErrors(), path=PathErrors())
    nothing = write_capture(box, tmp_path / "nothing", imu=False)
    assert has_imu(with_imu, ProjectOptions()) and not has_imu(with_depth, ProjectOptions())
    assert has_imu(box.root, ProjectOptions(imu=with_imu)) and not has_imu(box.root, ProjectOptions())
    assert knows_metres(with_depth, ProjectOptions()) and not knows_metres(nothing, ProjectOptions())
    capture = load_capture(with_depth)
    assert capture.depth is not None and capture.depth.metres == 1e-3
    assert capture.poses is not None and capture.poses.up_in_world == (0.0, 1.0, 0.0)
