"""Models that begin with the right pose of their first two images."""

import numpy as np
import pycolmap
import pytest

from colmap_inertial.colmap.mapping.incremental import map_incrementally
from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.colmap.views.two_views import estimate_relative_pose, open_features
from colmap_inertial.core.geometry import quat_from_matrix, so3_exp, so3_log
from scripts.studies.check_euroc import similarity
from tests.helpers.matched_views import match_views, see_room, see_slope, see_wall

UNKNOWN = ImageOrientations()


def go(forward_m, aside_m, count):
    """Orientations ``world_from_cam`` and centres of a camera that goes straight on and looks to and fro."""
    place = np.arange(count)[:, None]
    turn = 0.05 * np.sin(0.3 * place + np.array([0.0, 1.0, 2.0]))
    return so3_exp(turn), place * np.array([aside_m, 0.3 * aside_m, forward_m])


def match_way(path, way, see, apart=(1, 2, 3, 4, 6), halves=False):
    """Images so many places apart are matched; of two halves, none of one with any of the other."""
    count = len(way[1])
    pairs = [(i, i + step) for i in range(count) for step in apart if i + step < count]
    if halves:
        pairs = [(i, j) for i, j in pairs if (i < count // 2) == (j < count // 2)]
    return match_views(path, *way, pairs, noise_px=0.4, see=see, most=500)


def measured(names, way):
    """Orientations as the gyroscope has them, in a frame of its own."""
    start_from_world = so3_exp(np.array([0.4, -1.0, 0.7]))
    xyzw = quat_from_matrix(start_from_world @ way[0]).tolist()
    return ImageOrientations(
        part=dict.fromkeys(names, 0), start_from_cam_xyzw=dict(zip(names, map(tuple, xyzw), strict=True))
    )


def ask(**given):
    """COLMAP's options; cameras are known."""
    options = pycolmap.IncrementalPipelineOptions()
    known = {"ba_refine_focal_length": False, "ba_refine_extra_params": False}
    options.mergedict({"num_threads": 1, "random_seed": 0, "extract_colors": False, **known, **given})
    return options


def map_way(folder, options, orientations=UNKNOWN):
    made = folder / "made"
    made.mkdir()
    return map_incrementally(
        folder / "d.db", folder, made, options, lambda: None, orientations=orientations, scratch=folder
    )


def map_by_colmap(folder, options):
    (folder / "theirs").mkdir()
    return pycolmap.incremental_mapping(str(folder / "d.db"), ".", str(folder / "theirs"), options=options)


def off_m(model, way):
    """Rms distance of the centres from the truth, after a similarity."""
    images = [model.image(number) for number in model.reg_image_ids()]
    found = np.array([image.projection_center() for image in images])
    true = way[1][[int(image.name[:4]) for image in images]]
    scale, rotation, translation = similarity(found, true)
    return np.sqrt(np.mean(np.sum((scale * found @ rotation.T + translation - true) ** 2, axis=1)))


@pytest.mark.parametrize("count", [9, 24])
def test_a_way_along_a_slope_begins_with_the_right_of_two_poses(tmp_path, count):
    """COLMAP begins with the other one here, and is centimetres off."""
    way = go(0.03, 0.03, count)
    match_way(tmp_path / "d.db", way, see_slope(0.2))
    models = map_way(tmp_path, ask())
    assert [model.num_reg_images() for model in models.values()] == [count]
    assert off_m(models[0], way) < 0.003
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d.db", "made"]
    written = pycolmap.Reconstruction(str(tmp_path / "made" / "0"))
    assert written.num_points3D() == models[0].num_points3D() > 100


def test_of_poses_that_suit_the_matches_alike_the_gyroscope_knows_the_right_one(tmp_path):
    """Of a wall seen aslant there are two: by the matches alone, one in four or so is the wrong one."""
    rng = np.random.default_rng(3)
    count = 40
    axis = rng.standard_normal((2, count, 3))
    axis /= np.linalg.norm(axis, axis=2, keepdims=True)
    way = so3_exp(0.1 * axis[0] + [0.0, 0.5, 0]), 0.2 * axis[1]
    names = match_way(tmp_path / "d.db", way, see_wall, apart=(1,))
    known = measured(names, way)
    off = {"known": [], "unknown": []}
    with open_features(tmp_path / "d.db") as features:
        for k in range(count - 1):
            true = way[0][k + 1].T @ way[0][k]
            assert np.allclose(known.find_rotation(names[k], names[k + 1]), true)
            for who, rotation in (("known", true), ("unknown", None)):
                pose = estimate_relative_pose(features, names[k], names[k + 1], rotation)
                move = (way[1][k] - way[1][k + 1]) @ way[0][k + 1]
                off[who].append(
                    [np.linalg.norm(so3_log(true.T @ pose.second_from_first)), move @ pose.translation > 0.9 * 0.2]
                )
    wrong = {who: np.mean(np.array(found)[:, 0] > np.radians(1.5)) for who, found in off.items()}
    assert wrong["known"] < 0.05 < 0.1 < wrong["unknown"]
    assert np.mean(np.array(off["known"])[:, 1]) > 0.8


def test_the_gyroscope_says_nothing_across_a_gap_nor_of_images_without_it():
    turned = ImageOrientations(
        part={"a": 0, "b": 0, "c": 1}, start_from_cam_xyzw=dict.fromkeys("abc", (0.0, 0.0, 0.0, 1.0))
    )
    assert np.allclose(turned.find_rotation("a", "b"), np.eye(3))
    assert turned.find_rotation("a", "c") is turned.find_rotation("a", "d") is turned.find_rotation("d", "a") is None
    assert turned.select(["b", "c", "d"]).part == {"b": 0, "c": 1}


def test_a_model_begins_as_the_gyroscope_turned(tmp_path):
    way = go(0.03, 0.01, 24)
    names = match_way(tmp_path / "d.db", way, see_slope(0.3), apart=(1, 2, 3, 4, 6, 8))
    models = map_way(tmp_path, ask(), measured(names, way))
    assert off_m(models[0], way) < 0.005


def test_where_colmap_begins_with_the_right_pose_the_model_is_colmap_s(tmp_path):
    """To the last bit: it is COLMAP that begins with this pair."""
    match_way(tmp_path / "d.db", go(0.02, 0.08, 16), see_room)
    map_by_colmap(tmp_path, ask())
    models = map_way(tmp_path, ask())
    assert [model.num_reg_images() for model in models.values()] == [16]
    for name in ("images.bin", "points3D.bin", "cameras.bin"):
        assert (tmp_path / "made" / "0" / name).read_bytes() == (tmp_path / "theirs" / "0" / name).read_bytes()


def test_images_that_the_first_model_leaves_make_others(tmp_path):
    way = go(0.02, 0.08, 28)
    match_way(tmp_path / "d.db", way, see_room, halves=True)
    models = map_way(tmp_path, ask())
    halves = [{int(model.image(n).name[:4]) // 14 for n in model.reg_image_ids()} for model in models.values()]
    assert sorted(halves, key=min) == [{0}, {1}]
    assert sum(model.num_reg_images() for model in models.values()) == 28
    assert all(off_m(model, way) < 0.003 for model in models.values())
    assert {path.name for path in (tmp_path / "made").iterdir()} == {"0", "1"}


@pytest.mark.parametrize("given", [{"ba_refine_focal_length": True}, {"init_image_id1": 2, "init_image_id2": 8}])
def test_cameras_that_are_refined_and_a_pair_that_was_asked_for_are_left_to_colmap(tmp_path, given):
    """Of the slope, COLMAP makes another model than would be made otherwise."""
    match_way(tmp_path / "d.db", go(0.03, 0.03, 12), see_slope(0.2))
    options = ask(**given, multiple_models=False, init_num_trials=1)
    map_by_colmap(tmp_path, options)
    map_way(tmp_path, options)
    theirs, ours = (
        {path.name: path.read_bytes() for path in (tmp_path / name).rglob("*.bin")} for name in ("theirs", "made")
    )
    assert theirs == ours


def test_images_without_matches_make_no_model(tmp_path):
    match_way(tmp_path / "d.db", go(0.02, 0.08, 3), see_room, apart=())
    assert map_way(tmp_path, ask()) == {}
