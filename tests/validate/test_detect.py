"""Corners found in rendered images against their true places, in COLMAP's pixel coordinates."""

import cv2
import numpy as np
import pytest

from colmap_inertial.validate import parse_target
from colmap_inertial.validate.detect import _fit_homography, _project, _refine, detect, find_any_checkerboard
from tests.helpers.validate_scenes import (
    aprilgrid,
    cells,
    charuco,
    checkerboard,
    default_camera,
    ground,
    look_at,
    marker_bits,
    orbit,
    over,
    render,
)
from tests.helpers.versions import version_of

CAMERA = default_camera()


def true_px(target, pose):
    return CAMERA.img_from_cam(target.corners_m @ pose.rotation.T + pose.translation)


def errors_px(target, pose, detections):
    """(n, 2) found minus true, numbered in whichever allowed way fits best."""
    assert len(detections) == 1
    found = detections[0]
    truth = true_px(target, pose)
    candidates = [found.xy_px - truth[numbers[found.corner]] for numbers in target.relabelings]
    return min(candidates, key=lambda e: np.abs(e).sum())


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_checkerboard_corners_are_true_to_a_few_hundredths_of_a_pixel(gamma):
    target = parse_target("checkerboard:8x5:0.035")
    rng = np.random.default_rng(1)
    for pose in orbit(rng, 3):
        error = errors_px(target, pose, detect(render(CAMERA, pose, checkerboard(target), rng, gamma=gamma), target))
        assert len(error) == 40
        assert np.sqrt(np.mean(error**2)) < 0.05
        assert np.abs(error.mean(axis=0)).max() < 0.02  # half a pixel would show here


def test_a_checkerboard_is_found_in_a_large_image_and_refined_in_the_original():
    target = parse_target("checkerboard:8x5:0.035")
    rng = np.random.default_rng(2)
    pose = orbit(rng, 1)[0]
    image = render(CAMERA, pose, checkerboard(target), rng, blur_px=1.2)
    large = cv2.resize(image, None, fx=3.0, fy=3.0, interpolation=cv2.INTER_CUBIC)
    found = detect(large, target)[0]
    small = detect(image, target)[0]
    assert np.abs(found.xy_px / 3 - small.xy_px).max() < 0.1


def test_charuco_corners_are_found_where_part_of_the_board_is_hidden():
    target = parse_target("charuco:7x5:0.04:0.03:DICT_4X4_50")
    rng = np.random.default_rng(3)
    pose = look_at(np.array([0.05, 0.06, -0.45]), roll_rad=0.4)
    image = render(CAMERA, pose, charuco(target), rng, gamma=2.2)
    error = errors_px(target, pose, detect(image, target))
    assert len(error) == 24
    assert np.sqrt(np.mean(error**2)) < 0.05
    image[:, :300] = 128
    part = errors_px(target, pose, detect(image, target))
    assert 4 <= len(part) < 20
    assert np.sqrt(np.mean(part**2)) < 0.05


def test_a_charuco_board_printed_with_the_older_pattern_is_found():
    target = parse_target("charuco:6x4:0.04:0.03:DICT_4X4_50")
    board = cv2.aruco.CharucoBoard((6, 4), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    board.setLegacyPattern(True)
    image = board.generateImage((6 * 80, 4 * 80), marginSize=0, borderBits=1)
    found = detect(cv2.GaussianBlur(cv2.copyMakeBorder(image, *[60] * 4, 0, value=255), (0, 0), 1), target)[0]
    expected = 60 + 80 * np.stack([target.column + 1, target.row + 1], axis=-1)
    assert len(found.corner) == 15
    np.testing.assert_allclose(found.xy_px, expected[found.corner], atol=0.05)


def test_aprilgrid_corners_are_true_and_partial_grids_are_used():
    target = parse_target("aprilgrid:4x4:0.05:0.3")
    rng = np.random.default_rng(4)
    pose = look_at(np.array([0.05, -0.06, 0.5]), roll_rad=2.8)  # Kalibr's z axis points to the viewer
    image = render(CAMERA, pose, aprilgrid(target), rng, gamma=2.2)
    error = errors_px(target, pose, detect(image, target))
    assert len(error) >= 60
    assert np.sqrt(np.mean(error**2)) < 0.06
    image[200:] = 128
    assert 8 <= len(detect(image, target)[0].corner) <= 48


def test_two_aprilgrids_in_view_are_told_apart():
    target = parse_target("aprilgrid:3x2:0.05:0.3")
    rng = np.random.default_rng(5)
    offset = np.array([0.26, 0.0])
    pose = look_at(np.array([0.15, -0.06, 0.7]), target=(0.13, 0, 0))
    image = render(CAMERA, pose, over(aprilgrid(target), aprilgrid(target, centre=offset)), rng)
    found = detect(image, target)
    # OpenCV 4 misses two of the twelve tags here
    assert sorted(len(d.corner) for d in found) == ([24, 24] if version_of("cv2") >= (5,) else [16, 24])
    truth = [
        true_px(target, pose),
        CAMERA.img_from_cam((target.corners_m + np.append(offset, 0)) @ pose.rotation.T + pose.translation),
    ]
    for d in found:
        assert min(np.abs(d.xy_px - t[d.corner]).max() for t in truth) < 0.3


def test_a_single_marker_has_its_true_size_whatever_the_gamma(subtests):
    """A threshold, or the corner refinement of OpenCV's marker detector, makes it 0.4 to 2 % too small here."""
    for gamma in (1.0, 2.2):
        for dictionary in ("DICT_4X4_50", "DICT_APRILTAG_36h11"):
            with subtests.test(gamma=gamma, dictionary=dictionary):
                target = parse_target(f"aruco:{dictionary}:0.1")
                rng = np.random.default_rng(6)
                sizes = []
                for pose in orbit(rng, 4, distance_m=(0.6, 1.0)):
                    texture = cells(marker_bits(dictionary, 7), 0.1, (-0.05, -0.05))
                    found = detect(render(CAMERA, pose, texture, rng, gamma=gamma), target)
                    assert [d.part for d in found] == [7]
                    error = found[0].xy_px - true_px(target, pose)[found[0].corner]
                    assert np.abs(error).max() < 0.15
                    truth = true_px(target, pose)[28:32]
                    centred, true_centred = found[0].xy_px - found[0].xy_px.mean(axis=0), truth - truth.mean(axis=0)
                    sizes.append(np.linalg.norm(centred) / np.linalg.norm(true_centred) - 1)
                assert abs(np.mean(sizes)) < 1e-3


def test_nothing_is_found_where_there_is_nothing():
    rng = np.random.default_rng(7)
    image = render(CAMERA, orbit(rng, 1)[0], ground, rng, noise=8.0)
    for spec in (
        "checkerboard:9x6:0.03",
        "charuco:7x5:0.04:0.03:4X4_50",
        "aprilgrid:6x6:0.088:0.3",
        "aruco:4X4_50:0.1",
    ):
        assert detect(image, parse_target(spec)) == []


def test_a_thorough_search_finds_every_board():
    target = parse_target("checkerboard:5x4:0.03")
    rng = np.random.default_rng(8)
    both = over(checkerboard(target, centre=(-0.12, 0.0)), checkerboard(target, centre=(0.13, 0.02)))
    pose = look_at(np.array([0.02, 0.1, -0.6]))
    found = detect(render(CAMERA, pose, both, rng), target, thorough=True)
    assert [len(d.corner) for d in found] == [20, 20]
    assert abs(found[0].xy_px[:, 0].mean() - found[1].xy_px[:, 0].mean()) > 100


def test_the_size_of_another_checkerboard_is_told():
    target = parse_target("checkerboard:7x5:0.03")
    rng = np.random.default_rng(9)
    image = render(CAMERA, look_at(np.array([0.0, 0.1, -0.5])), checkerboard(target), rng)
    size, xy = find_any_checkerboard(image)
    assert sorted(size) == [5, 7]
    right, *_ = detect(image, target)
    assert np.abs(np.sort(xy, axis=0) - np.sort(right.xy_px, axis=0)).max() < 0.5


def test_a_homography_is_fitted_to_edges_of_which_some_were_seen_elsewhere():
    rng = np.random.default_rng(21)
    first = np.array([[20.0, 3, 200], [-2, 22, 150], [1e-3, 2e-3, 1]])
    change = np.array([[0.1, 0.03, 1.2], [-0.05, 0.08, -0.7], [2e-4, -1e-4, 0]])
    xy = rng.uniform(0, 8, (150, 2))
    normal = np.stack([np.cos(angle := rng.uniform(0, 2 * np.pi, 150)), np.sin(angle)], axis=1)
    # edges look brighter by a common shift, some are those of a shadow
    seen = np.sum((_project(first + change, xy) - _project(first, xy)) * normal, axis=1) + 0.3
    for side in (-4.0, 4.0):
        offset = np.where(np.arange(150) % 40 == 0, seen + side, seen) + 0.01 * rng.standard_normal(150)
        found = _fit_homography(first, xy, normal, offset, np.ones(150, dtype=bool))
        # to first order
        np.testing.assert_allclose(_project(first + found, xy), _project(first + change, xy), atol=0.1)


def test_corners_near_any_border_are_left_out_alike(subtests):
    for half in (3, 8, 11):
        with subtests.test(half=half):
            size, (y, x) = np.array([80, 60]), np.indices((60, 80))
            for near, kept in ((half + 0.5, False), (half + 1.5, True)):
                for axis in (0, 1):
                    for place in (near, size[axis] - 1 - near):
                        corner = np.array([30.5, 30.5])
                        corner[axis] = place
                        image = np.where((x > corner[0]) == (y > corner[1]), 40, 200).astype(np.uint8)
                        xy, good = _refine(image, corner[None], np.array([float(half)]), allowed_px=3.0)
                        assert good.tolist() == [kept], (near, axis, place)
                        assert not kept or xy[0] == pytest.approx(corner, abs=0.05)
