"""Models that other programs wrote or changed: read rightly, or refused with what is wrong and what to do."""

import struct

import numpy as np
import pycolmap
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.model import num_registered, read_model
from colmap_inertial.model.lenses import find_fold
from colmap_inertial.model.notes import collecting_notes
from colmap_inertial.model.pose_covariances import pose_covariances
from colmap_inertial.model.project import apply_to_project
from colmap_inertial.model.rigs import list_posed_frames
from colmap_inertial.model.similarities import plain_factor
from tests.helpers.foreign_models import build, centres, points, save, write_points


def read(folder, **how):
    with collecting_notes() as notes:
        model = read_model(folder, **how)
    return model, [fact.code for _, fact in notes]


def use(model):
    """What commands do with a model; each of it needs sound references."""
    pose_covariances(model, list_posed_frames(model))
    pycolmap.Reconstruction(model).transform(pycolmap.Sim3d())
    model.update_point_3d_errors()


NAMES = {
    "blanks": [f"A-DJI map-plan ({i}).jpg" for i in range(8)],
    "hash": [f"#{i} left.jpg" for i in range(8)],
    "commas": [f"a, {i},5.jpg" for i in range(8)],
    "parents": [f"../images/cam/{i}.jpg" for i in range(8)],
    "absolute": [f"/data/x/images/{i}.jpg" for i in range(8)],
    "numbers": [f"{1000 + i}" for i in range(8)],
    "numbers apart": [f"1 2 {1000 + i}" for i in range(8)],
    "umlauts": [f"Höhe {i}.jpg" for i in range(8)],
}


@pytest.mark.parametrize("kind", NAMES)
@pytest.mark.parametrize("text", [True, False])
def test_names_stay_as_they_are(tmp_path, kind, text):
    names = NAMES[kind]
    save(build(names), tmp_path / "p" / "sparse" / "0", text=text)
    model, notes = read(tmp_path / "p" / "sparse" / "0")
    assert sorted(image.name for image in model.images.values()) == sorted(names)
    assert notes == []
    apply_to_project(tmp_path / "p", tmp_path / "out", plain_factor(2.0))
    again, _ = read(tmp_path / "out" / "sparse" / "0")
    assert sorted(image.name for image in again.images.values()) == sorted(names)
    assert again.num_points3D() == model.num_points3D()


def lines_of(folder):
    return (folder / "images.txt").read_text().splitlines()


def without_comments(lines):
    return [line for line in lines if not line.startswith("#")]


def test_text_is_read_as_colmap_reads_it(tmp_path):
    for old in (True, False):
        folder = save(build(), tmp_path / f"{old}", text=True, old=old)
        ours, _ = read(folder)
        theirs = pycolmap.Reconstruction()
        theirs.read_text(str(folder))
        for number, image in theirs.images.items():
            assert np.array_equal(
                ours.image(number).cam_from_world().rotation.quat, image.cam_from_world().rotation.quat
            )
            assert np.array_equal(ours.image(number).cam_from_world().translation, image.cam_from_world().translation)
            assert [p.point3D_id for p in ours.image(number).points2D] == [p.point3D_id for p in image.points2D]
            assert all(
                np.array_equal(a.xy, b.xy) for a, b in zip(ours.image(number).points2D, image.points2D, strict=True)
            )
        assert set(ours.points3D) == set(theirs.points3D)
        for number, point in theirs.points3D.items():
            mine = ours.points3D[number]
            assert np.array_equal(mine.xyz, point.xyz) and mine.error == point.error
            assert mine.track.length() == point.track.length()


EDITS = {
    "empty lines are missing": (lambda lines: without_comments(lines)[::2], {"images-without-second-line"}),
    "the last line is missing": (lambda lines: [*lines[:-1], ""], set()),
    "the last line break is missing": (lambda lines: without_comments(lines)[:-1], {"lost-observations"}),
    "one empty line is missing": (
        lambda lines: (kept := without_comments(lines))[:2] + kept[2:3] + kept[4:],
        {"images-without-second-line"},
    ),
    "decimal commas": (
        lambda lines: [line.replace(".", ",").replace(",png", ".png") for line in without_comments(lines)],
        {"decimal-commas"},
    ),
    "commas between numbers": (
        lambda lines: [
            ", ".join(line.split()) if i % 2 == 0 else line for i, line in enumerate(without_comments(lines))
        ],
        {"decimal-commas"},
    ),
    "comments between": (lambda lines: [line for a, b in pairs(lines) for line in (a, "# seen", b)], set()),
    "a head that states more": (
        lambda lines: ["# Number of images: 99, mean observations per image: 3", *without_comments(lines)],
        {"other-count"},
    ),
}


def pairs(lines):
    kept = without_comments(lines)
    return list(zip(kept[::2], kept[1::2], strict=True))


@pytest.mark.parametrize("edit", EDITS)
def test_edited_lists_keep_all_their_images(tmp_path, edit):
    folder = save(build(), tmp_path / "m", text=True)
    before, _ = read(folder)
    change, wanted = EDITS[edit]
    (folder / "images.txt").write_text("\n".join(change(lines_of(folder))) + "\n")
    after, notes = read(folder)
    assert num_registered(folder) == len(before.images)
    assert {i.name for i in after.images.values()} == {i.name for i in before.images.values()}
    for number, image in before.images.items():
        np.testing.assert_allclose(after.image(number).projection_center(), image.projection_center(), atol=1e-12)
    assert wanted <= set(notes)
    use(after)


@pytest.mark.parametrize("coding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_text_of_any_editor_is_read(tmp_path, coding, ending):
    folder = save(build(), tmp_path / "m", text=True)
    before, _ = read(folder)
    for path in folder.iterdir():
        path.write_bytes(ending.join(path.read_text().splitlines()).encode(coding))
    after, notes = read(folder)
    assert len(after.images) == len(before.images) and after.num_points3D() == before.num_points3D()
    assert notes == []


@pytest.mark.parametrize(
    ("name", "line", "match"),
    [
        ("cameras", "1 PINHOLE 160 120 140 140 80", r"cameras\.txt, line 1: expected CAMERA_ID MODEL"),
        ("cameras", "1 BROWN 160 120 140 80 60", r"cameras\.txt, line 1: expected CAMERA_ID MODEL"),
        ("images", "1;0.1;0.2", r"images\.txt, line 1: expected IMAGE_ID QW"),
        ("points3D", "1 0 0 0", r"points3D\.txt, line 1: expected POINT3D_ID X Y Z"),
    ],
)
def test_lines_that_are_none_are_named(tmp_path, name, line, match):
    folder = save(build(), tmp_path / "m", text=True)
    (folder / f"{name}.txt").write_text(line + "\n")
    with pytest.raises(FormatError, match=match):
        read_model(folder)


@pytest.mark.parametrize("text", [False, True])
def test_key_points_whose_points_are_gone_see_none(tmp_path, text):
    model = build()
    folder = save(model, tmp_path / "m", text=text)
    gone = sorted(model.points3D)[3]
    if text:
        path = folder / "points3D.txt"
        kept = [line for line in path.read_text().splitlines() if line.split()[0] != str(gone)]
        path.write_text("\n".join(line for line in kept if not line.startswith("#")))
    else:
        write_points(folder / "points3D.bin", model, [number for number in model.points3D if number != gone])
    after, notes = read(folder)
    assert notes == ["lost-points"]
    seen = {p.point3D_id for image in after.images.values() for p in image.points2D if p.has_point3D()}
    assert seen == set(model.points3D) - {gone}
    use(after)


def test_a_replaced_cloud_has_no_tracks_of_the_one_before(tmp_path):
    model = build()
    folder = save(model, tmp_path / "m")
    write_points(folder / "points3D.bin", model, list(model.points3D)[:20], moved=50.0, tracks=False)
    after, notes = read(folder)
    assert "lost-points" in notes and after.num_points3D() == 20
    assert not any(image.num_points3D for image in after.images.values())
    use(after)


def test_points_without_tracks_are_given_those_that_the_images_state(tmp_path):
    model = build()
    folder = save(model, tmp_path / "m")
    write_points(folder / "points3D.bin", model, list(model.points3D), tracks=False)
    after, notes = read(folder)
    assert notes == ["tracks-from-images"]
    assert {i: p.track.length() for i, p in after.points3D.items()} == {
        i: p.track.length() for i, p in model.points3D.items()
    }


def test_tracks_of_images_that_are_gone_are_shortened(tmp_path):
    """In files with frames, too, which name the image as well."""
    for old in (True, False):
        model = build()
        folder = save(model, tmp_path / f"{old}", text=True, old=old)
        kept = [line for pair in pairs(lines_of(folder)) if not pair[0].startswith("3 ") for line in pair]
        (folder / "images.txt").write_text("\n".join(kept))
        after, notes = read(folder)
        assert len(after.images) == len(model.images) - 1
        assert "lost-observations" in notes
        assert all(e.image_id != 3 for p in after.points3D.values() for e in p.track.elements)
        use(after)


def test_key_points_beyond_an_image_are_left_out_of_tracks(tmp_path):
    model = build()
    folder = save(model, tmp_path / "m")
    data = bytearray((folder / "points3D.bin").read_bytes())
    struct.pack_into("<I", data, 8 + 51 + 4, 10_000)
    (folder / "points3D.bin").write_bytes(data)
    after, notes = read(folder)
    assert set(notes) == {"lost-points", "lost-observations"}
    use(after)


def test_what_is_there_twice_is_refused(tmp_path):
    model = build(["same.png", "same.png", *(f"{i}.png" for i in range(6))])
    folder = save(model, tmp_path / "p" / "sparse" / "0")
    with pytest.raises(FormatError, match=r"images\.bin: 2 images have the name 'same\.png'"):
        read_model(folder)
    applied = apply_to_project(tmp_path / "p", tmp_path / "out", plain_factor(2.0))
    assert any("2 images have the name" in note for note in map(str, applied.notes))
    for name, what in (("images", "image 1"), ("points3D", "point"), ("cameras", "camera 1")):
        again = save(build(), tmp_path / name, text=True)
        path = again / f"{name}.txt"
        first = without_comments(path.read_text().splitlines())
        path.write_text("\n".join([*first, *first[: 2 if name == "images" else 1]]) + "\n")
        with pytest.raises(FormatError, match=f"{what}.* appears twice"):
            read_model(again)


def test_images_of_a_camera_that_is_gone_are_refused_by_name(tmp_path):
    folder = save(build(), tmp_path / "m", text=True)
    (folder / "cameras.txt").write_text("7 PINHOLE 160 120 140 140 80 60\n")
    with pytest.raises(FormatError, match=r"its image '000\.png' is of camera 1, which the model lacks"):
        read_model(folder)


@pytest.mark.parametrize(
    ("name", "params", "folds"),
    [
        ("SIMPLE_RADIAL", [100, 80, 60, -0.25], True),
        ("SIMPLE_RADIAL", [100, 80, 60, 0.05], False),
        ("OPENCV", [100, 100, 80, 60, -0.3, 0.0, 0.0, 0.0], True),
        ("PINHOLE", [100, 100, 80, 60], False),
        ("OPENCV_FISHEYE", [60, 60, 80, 60, 0.0, 0.0, 0.0, 0.0], False),
    ],
)
def test_lenses_that_fold_within_the_picture_are_told(tmp_path, name, params, folds):
    camera = pycolmap.Camera(camera_id=1, model=name, width=160, height=120, params=params)
    _, notes = read(save(build(camera=camera), tmp_path / "m"))
    assert ("folded-lens" in notes) == folds
    fold = find_fold(camera)
    if name == "SIMPLE_RADIAL" and folds:  # r (1 + k r^2) grows up to r^2 = -1 / (3 k)
        assert fold.tangent == pytest.approx(np.sqrt(1 / (3 * 0.25)), rel=2e-3)


def test_a_camera_of_another_size_is_told(tmp_path):
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=160, height=120, params=[280, 280, 320, 240])
    assert "odd-principal-point" in read(save(build(camera=camera), tmp_path / "m"))[1]


def test_sound_models_are_read_without_a_word(tmp_path):
    model = build()
    for i, text in enumerate((False, True)):
        folder = save(model, tmp_path / f"{i}", text=text, old=False)
        again, notes = read(folder)
        assert notes == [] and again.num_points3D() == model.num_points3D()
    found = centres(tmp_path / "0")
    assert all(np.allclose(found[i.name], i.projection_center(), atol=1e-12) for i in model.images.values())
    assert set(points(tmp_path / "0")) == set(model.points3D)
