"""Models that begin with the right pose of their first two images."""

import numpy as np
import pycolmap
import pytest

from colmap_inertial.colmap.incremental import map_incrementally
from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from scripts.studies.check_euroc import similarity
from tests.helpers.matched_views import match_views, see_room, see_slope

UNKNOWN = ImageOrientations()


def go(forward_m, aside_m, count):
    """Centres of a camera that goes straight on and does not turn."""
    return np.arange(count)[:, None] * np.array([aside_m, 0.3 * aside_m, forward_m])


def match_way(path, centre, see, apart=(1, 2, 3, 4, 6)):
    """Images so many places apart are matched."""
    count = len(centre)
    pairs = [(i, i + step) for i in range(count) for step in apart if i + step < count]
    return match_views(path, np.tile(np.eye(3), (count, 1, 1)), centre, pairs, noise_px=0.4, see=see, most=500)


def ask(**given):
    """COLMAP's options; cameras are known."""
    options = pycolmap.IncrementalPipelineOptions()
    options.mergedict({"num_threads": 1, "random_seed": 0, "extract_colors": False, **given})
    if "ba_refine_focal_length" not in given:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
    return options


def map_way(folder, name, options, orientations=UNKNOWN):
    made = folder / name
    made.mkdir()
    return map_incrementally(
        folder / "d.db", folder, made, options, lambda: None, orientations=orientations, scratch=folder
    )


def off_m(model, centre):
    """Rms distance of the centres from the truth, after a similarity."""
    images = [model.image(number) for number in model.reg_image_ids()]
    found = np.array([image.projection_center() for image in images])
    true = centre[[int(image.name[:4]) for image in images]]
    scale, rotation, translation = similarity(found, true)
    return np.sqrt(np.mean(np.sum((scale * found @ rotation.T + translation - true) ** 2, axis=1)))


def test_a_way_along_a_slope_begins_with_the_right_of_two_poses(tmp_path):
    """COLMAP begins with the other one here, and is 7 cm off."""
    centre = go(0.03, 0.03, 24)
    match_way(tmp_path / "d.db", centre, see_slope(0.2))
    models = map_way(tmp_path, "made", ask())
    assert [model.num_reg_images() for model in models.values()] == [24]
    assert off_m(models[0], centre) < 0.003
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d.db", "made"]
    written = pycolmap.Reconstruction(str(tmp_path / "made" / "0"))
    assert written.num_points3D() == models[0].num_points3D() > 100


def test_of_poses_that_suit_the_matches_alike_the_gyroscope_knows_the_right_one(tmp_path):
    centre = go(0.03, 0.01, 24)
    names = match_way(tmp_path / "d.db", centre, see_slope(0.3), apart=(1, 2, 3, 4, 6, 8))
    known = ImageOrientations(part=dict.fromkeys(names, 0), start_from_cam_xyzw=dict.fromkeys(names, (0.0, 0, 0, 1)))
    models = map_way(tmp_path, "made", ask(), known)
    assert off_m(models[0], centre) < 0.005


def test_where_colmap_begins_with_the_right_pose_the_model_is_colmap_s(tmp_path):
    centre = go(0.02, 0.08, 16)
    match_way(tmp_path / "d.db", centre, see_room)
    (tmp_path / "theirs").mkdir()
    theirs = pycolmap.incremental_mapping(str(tmp_path / "d.db"), ".", str(tmp_path / "theirs"), options=ask())
    ours = map_way(tmp_path, "made", ask())
    numbers = sorted(theirs[0].reg_image_ids())
    assert len(ours) == len(theirs) == 1 and sorted(ours[0].reg_image_ids()) == numbers
    first, second = (
        np.array([model.image(number).projection_center() for number in numbers]) for model in (ours[0], theirs[0])
    )
    scale, rotation, translation = similarity(first, second)
    assert np.allclose(scale * first @ rotation.T + translation, second, atol=1e-3 * np.ptp(second))


def test_images_that_the_first_model_leaves_make_others(tmp_path):
    """Of a way in two halves, which no match connects."""
    centre = go(0.02, 0.08, 28)
    pairs = [(i, i + k) for i in range(28) for k in (1, 2, 3, 4, 6) if i + k < 28 and (i < 14) == (i + k < 14)]
    match_views(tmp_path / "d.db", np.tile(np.eye(3), (28, 1, 1)), centre, pairs, see=see_room, most=500)
    models = map_way(tmp_path, "made", ask())
    halves = [{int(model.image(n).name[:4]) // 14 for n in model.reg_image_ids()} for model in models.values()]
    assert sorted(halves, key=min) == [{0}, {1}]
    assert sum(model.num_reg_images() for model in models.values()) == 28
    assert {path.name for path in (tmp_path / "made").iterdir()} == {"0", "1"}


@pytest.mark.parametrize("given", [{"ba_refine_focal_length": True}, {"init_image_id1": 2, "init_image_id2": 8}])
def test_cameras_that_are_refined_and_a_pair_that_was_asked_for_are_left_to_colmap(tmp_path, given):
    match_way(tmp_path / "d.db", go(0.02, 0.08, 16), see_room)
    options = ask(**given, multiple_models=False)
    (tmp_path / "theirs").mkdir()
    pycolmap.incremental_mapping(str(tmp_path / "d.db"), ".", str(tmp_path / "theirs"), options=options)
    map_way(tmp_path, "made", options)
    theirs, ours = ((tmp_path / name / "0" / "images.bin").read_bytes() for name in ("theirs", "made"))
    assert theirs == ours


def test_images_without_matches_make_no_model(tmp_path):
    match_way(tmp_path / "d.db", go(0.02, 0.08, 3), see_room, apart=())
    assert map_way(tmp_path, "made", ask()) == {}
