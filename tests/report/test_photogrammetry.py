"""What the report says as photogrammetrists know it."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from jsonschema import Draft202012Validator

from colmap_inertial.model.readout import intrinsics_sigma
from colmap_inertial.report import write_report
from colmap_inertial.report.photogrammetry import photogrammetry_record
from colmap_inertial.report.run_page import intrinsics_rows
from tests.helpers.report_runs import write_run

ROOT = Path(__file__).parents[2]
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def synthetic():
    """A model with 0.5 px of noise in its keypoints, and a lens that bends."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 8
    options.num_points3D = 400
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [1280.0, 512.0, 384.0, 0.1]
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.5
    pycolmap.synthesize_noise(noise, model)
    return model


@pytest.fixture(scope="module")
def record(synthetic):
    return photogrammetry_record(synthetic, UPRIGHT, unit="m")


def test_residuals_are_those_of_the_noise(synthetic, record):
    rms = [image["rms_px"] for image in record["images"]]
    assert len(rms) == 8 and np.mean(rms) == pytest.approx(0.5 * np.sqrt(2), rel=0.1)
    sensor = record["sensor"]
    assert sum(sensor["count"]) == sum(image["observations"] for image in record["images"])
    weights = np.array(sensor["count"], dtype=float)
    squares = np.array([0 if v is None else v for v in sensor["rms_px"]]) ** 2
    assert np.sqrt((weights * squares).sum() / weights.sum()) == pytest.approx(0.5 * np.sqrt(2), rel=0.1)


def test_the_field_of_view_is_that_of_a_pinhole_with_the_focal_length(synthetic, record):
    (camera,) = record["cameras"]
    width, height = camera["width"], camera["height"]
    expected = [2 * np.degrees(np.arctan2(side / 2, 1280.0)) for side in (width, height)]
    assert camera["field_of_view_deg"] == pytest.approx(expected, abs=0.5)
    # a radial term of 0.1: points lie farther out than a pinhole has them, by 0.1 times the third power
    at, shift = np.array(camera["distortion"]["at_px"]), np.array(camera["distortion"]["shift_px"])
    away = (at - shift - [512.0, 384.0]) / 1280.0
    assert shift == pytest.approx(1280.0 * 0.1 * np.sum(away**2, axis=1, keepdims=True) * away, abs=0.01)


def test_tracks_and_overlap_count_images(synthetic, record):
    tracks = record["tracks"]
    assert sum(tracks["counts"]) == synthetic.num_points3D()
    assert tracks["mean"] == pytest.approx(synthetic.compute_mean_track_length())
    seen = [value for row in record["ground"]["images"] for value in row]
    assert 0 < max(seen) <= 8


def test_the_uncertainty_of_intrinsics_is_their_scatter_over_models(synthetic):
    found, sigma = [], []
    for seed in range(12):
        model = pycolmap.Reconstruction(synthetic)
        noise = pycolmap.SyntheticNoiseOptions()
        noise.point2D_stddev = 0.5
        pycolmap.set_random_seed(seed)
        pycolmap.synthesize_noise(noise, model)
        options = pycolmap.BundleAdjustmentOptions()
        options.print_summary = False
        pycolmap.bundle_adjustment(model, options)
        model.update_point_3d_errors()
        (camera,) = model.cameras.values()
        before = camera.params.copy()
        (one,) = intrinsics_sigma(model).values()
        np.testing.assert_array_equal(next(iter(model.cameras.values())).params, before)
        assert np.isfinite(one).tolist() == [True, False, False, True]
        found.append(before[[0, 3]])
        sigma.append(one[[0, 3]])
    scatter, told = np.std(found, axis=0, ddof=1), np.mean(sigma, axis=0)
    # half of the variance, the noise that the model had before, is the same in all
    ratio = 2**0.5 * scatter / told
    assert ((ratio > 0.6) & (ratio < 1.6)).all(), ratio


def test_intrinsics_that_were_kept_have_no_standard_deviation(synthetic, record):
    assert set(record["cameras"][0]["sigma"]) == {"f", "k"}
    kept = photogrammetry_record(synthetic, UPRIGHT, unit="m", keeps_intrinsics=True)
    assert kept["cameras"][0]["sigma"] == {}
    assert intrinsics_rows(kept["cameras"][0])[0][2:] == ("1280", "")


def test_the_ground_sampling_distance_is_depth_over_focal_length(synthetic, record):
    image = next(synthetic.image(i) for i in synthetic.reg_image_ids() if synthetic.image(i).name)
    found = next(one["gsd"] for one in record["images"] if one["name"] == image.name)
    pose = image.cam_from_world()
    depths = [(pose * synthetic.point3D(p.point3D_id).xyz)[2] for p in image.get_observation_points2D()]
    assert found == pytest.approx(np.median(depths) / 1280, rel=1e-9)


def test_the_camera_is_there_with_its_distortion(record):
    (camera,) = record["cameras"]
    assert camera["params"]["f"] == 1280 and camera["images"] == 8
    at, shift = np.array(camera["distortion"]["at_px"]), np.array(camera["distortion"]["shift_px"])
    outward = ((at - [512, 384]) * shift).sum(axis=1)
    corner = np.argmax(np.linalg.norm(at - [512, 384], axis=1))
    assert (outward >= -1e-6).all() and np.linalg.norm(shift[corner]) > 10  # a positive radial term moves points out


def with_survey(out, record):
    """A finished run whose report has all sections."""
    write_run(out)
    file = out / "report_data" / "model_0.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "photogrammetry": record}))
    return write_report(out)


def test_the_content_keeps_to_its_schema(tmp_path, record):
    with_survey(tmp_path / "run", record)
    content = json.loads((tmp_path / "run" / "report.json").read_text())
    schema = json.loads((ROOT / "docs" / "schemas" / "report.schema.json").read_text())
    of_model = schema["properties"]["models"]["items"]["properties"]["photogrammetry"]
    Draft202012Validator({**of_model, "$defs": schema["$defs"]}).validate(content["models"][0]["photogrammetry"])
    assert set(content) == set(schema["properties"]) == set(schema["required"])
    page = (tmp_path / "run" / "report.html").read_text()
    for words in ("Camera calibration", "Reprojection residuals", "Overlap, from above", "ground sampling distance"):
        assert words in page
