"""Pose priors of a database against the metres of a model: on the map, and in frames of their own."""

import math

import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.types import Similarity
from colmap_inertial.model.pose_priors import PriorComparison
from colmap_inertial.model.project import apply_to_project, undo_project
from colmap_inertial.model.similarities import plain_factor
from tests.helpers.foreign_models import build, save

#: Of the sphere that touches WGS84's ellipsoid at the place: metres a degree, by the radii of curvature there.
LATITUDE, LONGITUDE = 51.0, 8.0
_SIN = math.sin(math.radians(LATITUDE))
_E2 = 0.00669437999014
NORTH_M = math.radians(1) * 6378137 * (1 - _E2) / (1 - _E2 * _SIN**2) ** 1.5
EAST_M = math.radians(1) * 6378137 / math.sqrt(1 - _E2 * _SIN**2) * math.cos(math.radians(LATITUDE))

UTM = np.array([432_100.0, 5_664_733.0, 120.0])
WGS84, CARTESIAN = pycolmap.PosePriorCoordinateSystem.WGS84, pycolmap.PosePriorCoordinateSystem.CARTESIAN


def on_the_map(enu):
    """Latitude, longitude and height of metres east, north and up of the place."""
    return np.stack([LATITUDE + enu[:, 1] / NORTH_M, LONGITUDE + enu[:, 0] / EAST_M, 100 + enu[:, 2]], axis=1)


def write_priors(path, model, places, system):
    """COLMAP's database with a prior of each image, in the order of their numbers."""
    with pycolmap.Database.open(str(path)) as database:
        for camera in model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            database.write_rig(rig, use_rig_id=True)
        for frame in model.frames.values():
            database.write_frame(frame, use_frame_id=True)
        for number, place in zip(sorted(model.images), places, strict=True):
            image = model.images[number]
            database.write_image(image, use_image_id=True)
            prior = pycolmap.PosePrior(position=place, coordinate_system=system, corr_data_id=image.data_id)
            database.write_pose_prior(prior)


def priors_of(path):
    with pycolmap.Database.open(str(path)) as database:
        return np.array([prior.position for prior in database.read_all_pose_priors()])


@pytest.fixture
def project(tmp_path):
    model = build()
    save(model, tmp_path / "p" / "sparse" / "0")
    centres = np.array([model.images[i].projection_center() for i in sorted(model.images)])
    return tmp_path / "p", model, centres


#: A turn about up: what is east on the map is something else in the model.
HEADING = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("size", "code"), [(2.5, "priors-agree"), (2.8, "priors-contradict"), (1.0, "priors-contradict")]
)
@pytest.mark.parametrize("system", [WGS84, CARTESIAN])
def test_priors_that_stay_are_compared_with_the_metres(project, tmp_path, size, code, system):
    root, model, centres = project
    metres = 40 * size * centres @ HEADING.T
    places = on_the_map(metres) if system == WGS84 else metres + UTM
    write_priors(root / "database.db", model, places, system)
    applied = apply_to_project(root, tmp_path / "out", plain_factor(100.0))
    (note,) = [
        note.values["found"] for note in applied.notes if note.values.get("found", note).code.startswith("priors")
    ]
    assert note.code == code
    assert note.values["ratio"] == pytest.approx(size / 2.5, rel=2e-4)
    assert note.values["count"] == len(places)
    np.testing.assert_array_equal(priors_of(tmp_path / "out" / "database.db"), priors_of(root / "database.db"))
    undone = undo_project(tmp_path / "out", tmp_path / "back")
    assert not any("priors" in note.code for note in undone.notes)
    np.testing.assert_array_equal(priors_of(tmp_path / "back" / "database.db"), places)


def test_priors_that_move_need_no_word(project, tmp_path):
    root, model, centres = project
    write_priors(root / "database.db", model, centres, CARTESIAN)
    applied = apply_to_project(root, tmp_path / "out", plain_factor(100.0))
    assert applied.notes == ()
    np.testing.assert_allclose(priors_of(tmp_path / "out" / "database.db"), 100 * centres, rtol=1e-14)


def test_a_receivers_scatter_counts_once_not_once_an_image(project, tmp_path):
    """Its errors stay alike from image to image."""
    root, model, centres = project
    rng = np.random.default_rng(3)
    metres = 1.08 * 100 * centres + rng.normal(0, 12, centres.shape)
    write_priors(root / "database.db", model, on_the_map(metres), WGS84)
    applied = apply_to_project(root, tmp_path / "out", plain_factor(100.0))
    assert any("agree with its metres" in str(note) for note in applied.notes)


@pytest.mark.parametrize("count", [3, 8])
def test_priors_that_scatter_or_are_few_say_little(project, tmp_path, count):
    root, model, centres = project
    metres = 2.5 * centres + np.random.default_rng(4).normal(0, 5.0, centres.shape) * (count == 8)
    places = on_the_map(metres)
    places[count:] = np.nan
    write_priors(root / "database.db", model, places, WGS84)
    applied = apply_to_project(root, tmp_path / "out", plain_factor(2.5))
    assert any("to compare their metres" in str(note) for note in applied.notes)


def test_priors_without_heights_are_compared_all_the_same(project, tmp_path):
    root, model, centres = project
    flat = centres * [1, 1, 0]
    places = on_the_map(100 * flat)
    places[:, 2] = np.nan
    write_priors(root / "database.db", model, places, WGS84)
    applied = apply_to_project(root, tmp_path / "out", plain_factor(100.0))
    assert any("agree with its metres" in str(note) for note in applied.notes)


def test_the_scales_own_interval_counts(project, tmp_path):
    root, model, centres = project
    write_priors(root / "database.db", model, on_the_map(108.0 * centres), WGS84)
    for sigma, code in ((0.01, "priors-contradict"), (0.05, "priors-agree")):
        cov = np.zeros((7, 7))
        cov[0, 0] = sigma**2
        similarity = Similarity(
            scale=100.0, rotation_xyzw=np.array([0, 0, 0, 1.0]), translation_m=np.zeros(3), cov=cov, provenance="test"
        )
        applied = apply_to_project(root, tmp_path / f"out{sigma}", similarity)
        assert [note.values["found"].code for note in applied.notes] == [code]


def test_cameras_in_one_place_say_nothing():
    found = PriorComparison.of(np.random.default_rng(1).normal(size=(6, 3)), np.zeros((6, 3)))
    assert math.isnan(found.ratio)
