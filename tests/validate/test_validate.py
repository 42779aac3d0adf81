"""The validator from images to figures: its accuracy, and a clear outcome for everything that can be wrong."""

import io
import json
import xml.etree.ElementTree as ET

import cv2
import numpy as np
import pycolmap
import pytest
from rich.console import Console

from colmap_inertial.core.errors import FormatError, NotObservableError, TargetNotFoundError
from colmap_inertial.core.geometry import colmap_px_from_opencv
from colmap_inertial.core.options import ValidateOptions
from colmap_inertial.validate import (
    failures,
    parse_target,
    place as search_module,
    validate_model,
    validation_table,
    write_overlays,
)
from colmap_inertial.validate.detect import Detection, detect
from colmap_inertial.validate.views import sight
from tests.helpers.validate_scenes import (
    aprilgrid,
    cells,
    checkerboard,
    default_camera,
    ground,
    look_at,
    marker_bits,
    orbit,
    over,
    reconstruction,
    render,
    write_images,
)

TARGET = parse_target("checkerboard:9x6:0.03")
CAMERA = default_camera()
SMALL = default_camera(480, 360)
SMALL.params = [450.0, 451.0, 241.0, 179.0, -0.1, 0.02, 0.001, -0.0005]


@pytest.fixture(scope="module", autouse=True)
def _searched_once():
    """What OpenCV found of a board in a picture is kept: most of the time is its search, here often the same one."""
    search, found = cv2.findChessboardCornersSB, {}

    def known(image, size, flags):
        key = image.shape, image.tobytes(), size, flags
        if key not in found:
            found[key] = search(image, size, flags=flags)
        seen, corners = found[key]
        return seen, None if corners is None else corners.copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cv2, "findChessboardCornersSB", known)
        yield


class Scene:
    def __init__(self, folder, poses, camera=CAMERA, texture=None, target=TARGET, seed=0, **how):
        self.poses, self.camera, self.target = poses, camera, target
        texture = checkerboard(target) if texture is None else texture
        self.images = write_images(folder, camera, poses, texture, np.random.default_rng(seed), **how)

    def model(self, units_per_m=1.0):
        return reconstruction(self.camera, self.poses, units_per_m=units_per_m)

    def validate(self, units_per_m=1.0, **options):
        return validate_model(self.model(units_per_m), self.images, self.target, ValidateOptions(**options))


@pytest.fixture(scope="module")
def sharp(tmp_path_factory) -> Scene:
    """Six sharp frames with lens distortion, taken at all angles of roll."""
    return Scene(tmp_path_factory.mktemp("sharp"), orbit(np.random.default_rng(1), 6))


@pytest.fixture(scope="module")
def measured(sharp):
    return sharp.validate()


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Scene:
    return Scene(tmp_path_factory.mktemp("small"), orbit(np.random.default_rng(2), 5), SMALL, samples=1)


def test_a_perfect_model_of_sharp_frames_has_the_right_size(measured):
    result = measured
    assert abs(result.scale_error_pct) <= 0.05
    assert abs(result.scale_error_pct) <= 0.02  # what it reaches; the bound above is what is promised
    assert result.ci95_pct[0] <= result.scale_error_pct <= result.ci95_pct[1]
    assert result.views_used == 6
    assert result.corners_used == 6 * 54
    assert result.rms_px < 0.1
    assert result.within_tolerance


def test_a_model_of_the_wrong_size_is_measured_and_fails(sharp):
    result = sharp.validate(units_per_m=1.03)
    assert result.scale_error_pct == pytest.approx(3.0, abs=0.05)
    assert result.metres_per_unit == pytest.approx(1 / 1.03, rel=5e-4)
    assert not result.within_tolerance
    # all lengths are off alike: they contradict the model, not each other
    assert result.doubts == () and result.mismatch.code == "target-or-scale-wrong"
    assert result.mismatch.values["fits_m"] == pytest.approx(1.03 * result.target.length_m, rel=1e-3)
    assert sharp.validate(units_per_m=1.03, tolerance_pct=4.0).within_tolerance
    for distance in result.distances:
        assert distance.residual_m == pytest.approx(0.03 * distance.known_m, abs=2e-4)
    # as validate_scenes.reconstruction moves its world; the board may be numbered from its other end
    world = cv2.Rodrigues(np.array([0.3, -1.1, 0.7]))[0]
    truth = result.target.corners_m @ world.T + [5.0, -3.0, 2.0]
    placed = np.array([corner.in_model for corner in result.corners]) / 1.03
    assert len(placed) == len(truth)
    assert np.linalg.norm(placed[:, None] - truth, axis=2).min(axis=1).max() < 2e-4
    at = {corner.name: corner.in_model for corner in result.corners}
    for distance in result.distances:
        assert np.linalg.norm(at[distance.pair[0]] - at[distance.pair[1]]) == pytest.approx(distance.measured)


def test_a_model_without_a_unit_gets_the_factor_that_makes_it_metric(sharp):
    result = sharp.validate(units_per_m=0.137, unscaled=True)
    assert result.scale_error_pct is None
    assert result.ci95_pct is None
    assert result.within_tolerance
    assert result.metres_per_unit == pytest.approx(1 / 0.137, rel=5e-4)
    low, high = result.metres_per_unit_ci95
    assert low < result.metres_per_unit < high
    # control corners set the scale, the others check it
    assert result.control.metres_per_unit == pytest.approx(1 / 0.137, rel=5e-4)
    assert result.control.corners + result.check.corners == result.corners_used
    assert abs(result.check_error_pct) < 0.05
    assert result.check_ci95_pct[0] < 0 < result.check_ci95_pct[1]
    names = {kind: {n for d in result.distances if d.set == kind for n in d.pair} for kind in ("control", "check")}
    assert names["control"]
    assert names["check"]
    assert not names["control"] & names["check"]
    assert max(abs(d.residual_m) for d in result.distances) < 2e-4  # metres after scaling by the control corners


def test_the_json_has_the_agreed_fields_and_the_table_says_the_same(sharp):
    result = sharp.validate(units_per_m=1.01)
    fields = json.loads(json.dumps(result.as_json()))
    agreed = "scale_error_pct ci95_pct metres_per_unit views_used corners_used rms_px distances reasons"
    assert set(agreed.split()) <= set(fields)
    assert fields["views_used"] == 6
    assert {"pair", "known_m", "measured", "residual_m"} <= set(fields["distances"][0])
    assert [view["name"] for view in fields["views"]] == [f"{i:03}.png" for i in range(6)]
    console = Console(width=120, file=io.StringIO())
    console.print(validation_table(result))
    text = console.file.getvalue()
    assert f"{result.scale_error_pct:+.3f} %" in text
    assert "within 2 %" in text


def test_pictures_show_corners_on_frames_and_a_chart(sharp, measured, tmp_path):
    result = measured
    files = write_overlays(result, sharp.images, tmp_path / "pictures", most_frames=3)
    chart = ET.parse(files[0]).getroot()
    circles = [e for e in chart.iter() if e.tag.endswith("circle")]
    assert len(circles) >= 2 * len(result.distances)
    frames = [cv2.imread(str(path)) for path in files[1:]]
    assert [f.shape for f in frames] == [(480, 640, 3)] * 3
    saturation = frames[0].max(axis=2).astype(int) - frames[0].min(axis=2)
    x, y = np.round(result.views[0].observed_px[10] - 0.5).astype(int)
    assert saturation[y - 5 : y + 6, x - 5 : x + 6].max() > 60  # drawn in colour on a grey frame


def test_a_model_folder_is_read_as_well_as_a_model_in_memory(small, tmp_path):
    small.model().write_text(str(tmp_path))
    from_folder = validate_model(str(tmp_path), small.images, TARGET)
    assert from_folder.scale_error_pct == pytest.approx(small.validate().scale_error_pct, abs=1e-6)
    parent = tmp_path / "sparse"
    (parent / "0").mkdir(parents=True)
    small.model().write_binary(str(parent / "0"))
    with pytest.raises(FormatError, match="holds models in its folders 0"):
        validate_model(parent, small.images, TARGET)


@pytest.mark.parametrize("spec", ["checkerboard:9x6:0.03", "checkerboard:6x6:0.03"])
def test_each_view_is_numbered_so_that_all_agree(small, monkeypatch, spec):
    """However a detector starts to count: at either end of a board, at any corner of a square one."""
    target = parse_target(spec)
    rng = np.random.default_rng(3)
    poses = iter([p for _ in range(2) for p in small.poses])

    def any_start(image, target, *, thorough=False):
        pose = next(poses)
        xy = SMALL.img_from_cam(target.corners_m @ pose.rotation.T + pose.translation) + rng.normal(0, 0.1, (1, 2))
        numbers = rng.choice(target.relabelings)
        return [Detection(part=0, corner=np.argsort(numbers), xy_px=xy)]

    monkeypatch.setattr(search_module, "detect", any_start)
    monkeypatch.setattr(search_module, "_spread_evenly", lambda count: list(range(count)))
    monkeypatch.setattr(search_module.Search, "look_closer", lambda self, which: None)
    monkeypatch.setattr(failures, "find_any_checkerboard", lambda image: None)  # the images show a 9x6 board
    result = validate_model(small.model(), small.images, target)
    assert result.views_used == 5
    assert result.rms_px < 0.5
    assert abs(result.scale_error_pct) < 0.3


def test_a_wrong_board_size_is_not_found_and_the_right_one_is_suggested(small):
    with pytest.raises(TargetNotFoundError, match="9x6 inner corners is in more") as caught:
        validate_model(reconstruction(SMALL, small.poses[:2]), small.images, parse_target("checkerboard:8x6:0.03"))
    assert caught.value.exit_code == 5


@pytest.fixture(scope="module")
def board(tmp_path_factory) -> Scene:
    """Five views of a board with 8x6 inner corners."""
    poses, target = orbit(np.random.default_rng(2), 5), parse_target("checkerboard:8x6:0.04")
    return Scene(tmp_path_factory.mktemp("board"), poses, SMALL, target=target)


@pytest.mark.parametrize(("stated", "visible"), [("8x7", "8x6"), ("9x7", "8x6")])
def test_a_board_with_a_row_or_squares_too_many_is_refused_by_its_likely_size(board, stated, visible):
    """9x7 squares are 8x6 inner corners; patterns beside the board pass for the row that it does not have."""
    with pytest.raises(TargetNotFoundError, match=f"{visible} inner corners (is|was)") as caught:
        validate_model(board.model(), board.images, parse_target(f"checkerboard:{stated}:0.04"))
    assert caught.value.exit_code == 5


@pytest.mark.parametrize(
    ("stated", "words"), [("6x4", "is a part of a board with 8x6"), ("5x5", "with 8x6"), ("10x8", "8x6 inner corners")]
)
def test_a_board_of_quite_another_size_is_refused_by_its_likely_size(board, stated, words):
    """A 6x4 board is found in an 8x6 one, now here and now there: two images that agree by chance gave a scale."""
    with pytest.raises(TargetNotFoundError, match=words):
        validate_model(board.model(), board.images, parse_target(f"checkerboard:{stated}:0.04"))


def test_a_board_that_is_never_visible_is_not_found(tmp_path):
    scene = Scene(tmp_path, orbit(np.random.default_rng(4), 3), SMALL, texture=ground, samples=1)
    for spec in ("checkerboard:9x6:0.03", "aprilgrid:6x6:0.05:0.3", "aruco:4X4_50:0.1"):
        with pytest.raises(TargetNotFoundError, match="not found in any of the 3 images"):
            validate_model(scene.model(), scene.images, parse_target(spec))


def test_one_view_gives_no_length(small, tmp_path):
    rng = np.random.default_rng(5)
    for i in range(3):
        texture = checkerboard(TARGET) if i == 2 else ground
        cv2.imwrite(str(tmp_path / f"{i:03}.png"), render(SMALL, small.poses[i], texture, rng, samples=1))
    with pytest.raises(NotObservableError, match=r"one image only \(002.png\)") as caught:
        validate_model(reconstruction(SMALL, small.poses[:3]), tmp_path, TARGET)
    assert caught.value.exit_code == 3


def test_views_from_one_place_give_no_length(tmp_path, monkeypatch):
    monkeypatch.setattr(failures, "_count_boards", lambda *_: 0)  # takes seconds
    centre = np.array([0.1, 0.1, -0.6])
    poses = [look_at(centre, (x, 0.0, 0.0), roll) for x, roll in ((0.03, 0.3), (-0.03, 1.0))]
    with pytest.raises(NotObservableError, match="from the same direction"):
        Scene(tmp_path, poses, SMALL, samples=1).validate()


@pytest.mark.parametrize(("flip", "words"), [(1, "left to right"), (0, "top to bottom")])
def test_mirrored_images_are_named_as_such(small, tmp_path, flip, words):
    for path in sorted(small.images.iterdir())[:2]:
        cv2.imwrite(str(tmp_path / path.name), cv2.flip(cv2.imread(str(path)), flip))
    with pytest.raises(FormatError, match=f"mirrored {words}"):
        validate_model(reconstruction(SMALL, small.poses[:2]), tmp_path, TARGET)


def test_mirrored_markers_are_named_as_such(tmp_path):
    poses = orbit(np.random.default_rng(6), 3)
    texture = cells(marker_bits("DICT_4X4_50", 7), 0.2, (-0.1, -0.1))
    target = parse_target("aruco:DICT_4X4_50:0.2")
    scene = Scene(tmp_path, poses, SMALL, texture=texture, target=target, samples=1)
    for path in scene.images.iterdir():
        cv2.imwrite(str(path), cv2.flip(cv2.imread(str(path)), 1))
    with pytest.raises(FormatError, match="mirrored left to right"):
        scene.validate()


def test_of_two_boards_the_one_that_most_views_agree_on_is_measured(tmp_path):
    target = parse_target("checkerboard:5x4:0.03")
    texture = over(checkerboard(target, centre=(-0.12, 0.0)), checkerboard(target, centre=(0.13, 0.02)))
    poses = orbit(np.random.default_rng(7), 6, distance_m=(0.65, 0.75), spread=0.4, roll_rad=0.4)
    result = Scene(tmp_path, poses, texture=texture, target=target, samples=1).validate()
    assert abs(result.scale_error_pct) < 0.3
    assert result.views_used >= 5
    assert any("more than one such target" in str(reason) for reason in result.reasons)


def test_a_view_in_which_the_target_stood_elsewhere_is_left_out(small, tmp_path):
    rng = np.random.default_rng(8)
    for i in range(5):
        texture = checkerboard(TARGET, centre=(0.05, 0.02) if i == 3 else (0.0, 0.0))
        cv2.imwrite(str(tmp_path / f"{i:03}.png"), render(SMALL, small.poses[i], texture, rng, samples=1))
    result = validate_model(small.model(), tmp_path, TARGET)
    assert result.views_used == 4
    assert [view.name for view in result.views_rejected] == ["003.png"]
    assert result.views_rejected[0].reason.code == "view-disagrees"
    assert result.views_rejected[0].residual_px > 4
    assert abs(result.scale_error_pct) < 0.3


def test_images_that_are_not_those_of_the_model_are_refused(small, tmp_path):
    with pytest.raises(FormatError, match="none of the model's 5 images"):
        validate_model(small.model(), tmp_path, TARGET)
    with pytest.raises(FormatError, match="not a folder"):
        validate_model(small.model(), tmp_path / "absent", TARGET)
    for path in small.images.iterdir():
        cv2.imwrite(str(tmp_path / path.name), cv2.resize(cv2.imread(str(path)), None, fx=0.5, fy=0.5))
    with pytest.raises(FormatError, match="240x180 and its camera in the model 480x360"):
        validate_model(small.model(), tmp_path, TARGET)


def test_missing_and_unreadable_images_are_listed(small, tmp_path):
    for path in small.images.iterdir():
        if path.name != "001.png":
            (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "004.png").write_bytes(b"not a picture")
    result = validate_model(small.model(), tmp_path, TARGET)
    reasons = {view.name: str(view.reason) for view in result.views_rejected}
    assert reasons.pop("001.png") == "no such file in the image folder"
    assert reasons.pop("004.png").startswith("cannot be decoded") and not reasons
    assert result.views_used == 3
    for path in tmp_path.iterdir():
        path.write_bytes(b"not a picture")
    with pytest.raises(FormatError, match=r"000\.png.*cannot be decoded"):
        validate_model(small.model(), tmp_path, TARGET)


def test_the_search_stops_when_enough_views_are_found(small):
    calls = []
    options = ValidateOptions(max_views=3)
    result = validate_model(small.model(), small.images, TARGET, options, progress=lambda *a: calls.append(a))
    assert result.views_searched == 3
    assert any("2 images were not searched" in str(reason) for reason in result.reasons)
    assert calls[-1] == (5, 5)


def test_single_markers_share_one_scale_and_an_odd_one_is_left_out(tmp_path):
    side = {3: 0.1, 7: 0.1, 11: 0.12}
    texture = over(
        *(cells(marker_bits("DICT_4X4_50", i), s, (-0.25 + 0.2 * k, -0.05)) for k, (i, s) in enumerate(side.items()))
    )
    poses = orbit(np.random.default_rng(9), 5, distance_m=(0.65, 0.8), spread=0.4)
    scene = Scene(tmp_path, poses, texture=texture, target=parse_target("aruco:DICT_4X4_50:0.1"), gamma=2.2, samples=1)
    result = scene.validate()
    assert abs(result.scale_error_pct) < 0.15
    assert any("marker 11 is left out: +20" in str(reason) for reason in result.reasons)
    assert {d.pair[0].split(".")[0] for d in result.distances} == {"marker3", "marker7"}
    assert {round(d.known_m, 6) for d in result.distances} == {0.1, 0.141421}


def test_an_aprilgrid_partly_out_of_view_has_the_right_size(tmp_path):
    target = parse_target("aprilgrid:4x4:0.05:0.3")
    poses = orbit(np.random.default_rng(10), 5, distance_m=(0.35, 0.45), spread=0.5, front=1, target=(0.06, 0.03, 0))
    result = Scene(tmp_path, poses, texture=aprilgrid(target), target=target, samples=1).validate()
    assert abs(result.scale_error_pct) < 0.1
    assert result.corners_used < 5 * 64


def test_every_camera_model_gives_rays_that_project_back(subtests):
    for name in [n for n in pycolmap.CameraModelId.__members__ if n != "INVALID"]:
        with subtests.test(name=name):
            camera = pycolmap.Camera.create_from_model_name(1, name, 500.0, 800, 600)
            distorted = camera.params.copy()
            known = {
                "k": -0.03,
                "k1": -0.03,
                "k2": 0.01,
                "p1": 0.001,
                "omega": 0.5,
                "alpha": 0.4,
                "k0": 0.01,
                "s0": 0.001,
            }
            for i, parameter in enumerate(p.strip() for p in camera.params_info.split(",")):
                distorted[i] = known.get(parameter, distorted[i])
            camera.params = distorted
            target = parse_target("checkerboard:7x5:0.05")
            pose = look_at(np.array([0.1, -0.1, -0.5]), roll_rad=0.5)
            in_cam = target.corners_m @ pose.rotation.T + pose.translation
            px = camera.img_from_cam(in_cam)
            sighting = sight(0, camera, Detection(part=0, corner=np.arange(35), xy_px=px))
            np.testing.assert_array_equal(sighting.corner, np.arange(35))
            np.testing.assert_allclose(sighting.ray, in_cam / np.linalg.norm(in_cam, axis=1, keepdims=True), atol=1e-5)
            # a small turn of the rays moves the pixels as the derivative says
            turned = in_cam + np.cross([0.0004, -0.0003, 0.0005], in_cam)
            change = camera.img_from_cam(turned) - camera.img_from_cam(in_cam)
            predicted = np.einsum(
                "mij,mj->mi", sighting.px_from_tangent, turned / np.linalg.norm(turned, axis=1, keepdims=True)
            )
            np.testing.assert_allclose(predicted, change, atol=2e-3)


def test_pixel_origins_agree_from_file_to_figure(sharp):
    """OpenCV's corner plus half a pixel is COLMAP's: a missing half would show as a common shift of all residuals."""
    pose = sharp.poses[0]
    image = cv2.imread(str(sharp.images / "000.png"), cv2.IMREAD_GRAYSCALE)
    found = detect(image, TARGET)[0]
    truth = CAMERA.img_from_cam(TARGET.corners_m @ pose.rotation.T + pose.translation)
    shift = min((found.xy_px - truth[r[found.corner]] for r in TARGET.relabelings), key=lambda e: np.abs(e).sum())
    assert np.abs(shift.mean(axis=0)).max() < 0.02
    assert colmap_px_from_opencv(np.zeros((1, 2))).tolist() == [[0.5, 0.5]]
