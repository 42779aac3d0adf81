"""Metres without an IMU: from a target, from the distance of two markers, from the distance of two points."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli.terminal import show_reference
from colmap_inertial.colmap.chunks import Processes
from colmap_inertial.core.errors import InertialError, NotObservableError, TargetNotFoundError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ReferenceOptions
from colmap_inertial.evidence.combine import combine
from colmap_inertial.evidence.references import evidence_of_target
from colmap_inertial.run.commands import scale_by_reference as rooms
from colmap_inertial.run.commands.scale_by_reference import Reference, scale_project_by
from colmap_inertial.validate.result import LengthCheck
from tests.cli.test_commands import run
from tests.helpers.cases import loop_over
from tests.helpers.markers_in_model import validated


@pytest.fixture
def bare(project, tmp_path):
    """A project of COLMAP's alone."""
    shutil.copytree(project.model, tmp_path / "bare" / "sparse" / "0")
    (tmp_path / "bare" / "images").mkdir()
    return tmp_path / "bare"


def test_a_known_distance_of_two_points_makes_a_project_metric(bare, tmp_path, capsys):
    before = pycolmap.Reconstruction(str(bare / "sparse" / "0"))
    images = sorted(before.reg_image_ids())
    ends = [before.image(i).projection_center() for i in (images[0], images[-1])]
    between = [",".join(f"{v:.12g}" for v in end) for end in ends]
    out = tmp_path / "out"
    args = ["--scale-from", "distance", "--between", *between, "--distance", "2.5+-0.01"]
    code, said, err = run(capsys, "reconstruct", bare, out, *args)
    assert code == 0, err
    assert "lengths of 10 m are accurate to 7.8 cm" in said and said.splitlines()[-1].endswith(
        f"colmap-inertial view {out}"
    )
    after = pycolmap.Reconstruction(str(out / "sparse" / "0"))
    a, b = (after.image(i).projection_center() for i in (images[0], images[-1]))
    assert np.linalg.norm(a - b) == pytest.approx(2.5)
    found = json.loads((out / "scale.json").read_text())
    assert found["scale_from"] == ["distance"] and "2.5+-0.01 m" in found["made_of"]
    low, high = found["ci95"]
    assert np.log(high / low) == pytest.approx(2 * 1.96 * 0.004, rel=1e-3)
    assert "which way is up is not known" in found["notes"][0]
    provenance = json.loads((out / "transform.json").read_text())
    assert "distance of 2.5+-0.01 m" in json.dumps(provenance)
    code, said, _ = run(capsys, "reconstruct", bare, tmp_path / "again", *args, "--json", "-")
    assert code == 0 and json.loads(said)["metres_per_unit"] == pytest.approx(found["metres_per_unit"])


def test_markers_and_targets_give_their_scale(bare, tmp_path, monkeypatch):
    monkeypatch.setattr(rooms, "validate_model", lambda *_, **__: validated(0.5, unscaled=True))
    markers = {"target": "aruco:DICT_4X4_50:0.1"}
    known = ReferenceOptions(**markers, between=("0", "1"), distance="2.1+-0.001")
    found = scale_project_by(bare, tmp_path / "markers", known)
    assert found.sensors.metres_per_unit == pytest.approx(2.1 / 4)
    assert found.validation is not None
    target = scale_project_by(bare, tmp_path / "target", ReferenceOptions(target="aruco:DICT_4X4_50:0.1"))
    assert target.sensors.metres_per_unit == pytest.approx(0.5) and target.made_of.startswith("target aruco")
    doubted = dataclasses.replace(validated(0.5, unscaled=True), views_used=2)
    monkeypatch.setattr(rooms, "validate_model", lambda *_, **__: doubted)
    with pytest.raises(NotObservableError, match="only 2 of 5 images agree on the target, too few to prove its size"):
        scale_project_by(bare, tmp_path / "no", ReferenceOptions(target="aruco:DICT_4X4_50:0.1"))
    found = scale_project_by(bare, tmp_path / "doubted", known)
    assert any("only 2 of 5 images agree" in str(note) for note in found.notes)
    with pytest.raises(NotObservableError, match="marker 9 was not measured in the model; measured: 0, 1, 2, 3, 7"):
        scale_project_by(bare, tmp_path / "no", ReferenceOptions(**markers, between=("0", "9"), distance="2.1+-0.001"))
    assert not (tmp_path / "no").exists()


@loop_over(
    ("options", "words"),
    [
        ({"scale_from": ("target",)}, "--scale-from target needs the target"),
        ({"scale_from": ("distance",)}, "needs --between A B"),
        ({"between": ("1,2,3", "4,5,6"), "distance": "2.5"}, "how well they are known"),
        ({"between": ("1,2,3", "4,5,6"), "distance": "0+-1"}, "how well they are known"),
        ({"between": ("1,2,3", "3"), "distance": "2+-0.1"}, "needs what they are: --target"),
        ({"between": ("a,b,c", "1,2,3"), "distance": "2+-0.1"}, "a point is x,y,z"),
        ({"between": ("1,2,nan", "3,4,5"), "distance": "2+-0.1"}, "a point is x,y,z"),
        ({"between": ("1,2,3", "1e999,0,0"), "distance": "2+-0.1"}, "a point is x,y,z"),
        ({"between": ("1,2,3", "1,2,3"), "distance": "2+-0.1"}, "are the same place"),
    ],
)
def test_what_is_missing_is_named(bare, tmp_path, options, words):
    with pytest.raises(InertialError, match=words):
        scale_from = options.pop("scale_from", ())
        scale_project_by(bare, tmp_path / "out", ReferenceOptions(**options), scale_from=scale_from)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def pictures(tmp_path, project, monkeypatch):
    """A folder of pictures, which COLMAP is not asked to map: it gives the project's model, and a smaller one."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    for i in range(4):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((8, 8), i, np.uint8))
    mapped = []

    def map_images(database, images, sparse, *_, in_time, judged, **__):
        mapped.append(sorted(path.name for path in images.iterdir()))
        # no gyroscope said which pairs far apart in time join copies
        assert in_time == mapped[-1] and not judged
        for number in "01":
            shutil.copytree(project.model, sparse / number)

    def written(path):
        path.write_bytes(b"")

    monkeypatch.setattr(rooms, "extract_features", lambda images, cameras, database, *_, **__: written(database))
    monkeypatch.setattr(rooms, "match_pairs", lambda database, *_: None)
    monkeypatch.setattr(rooms, "map_images", map_images)
    return folder, mapped


def test_pictures_alone_are_mapped_and_scaled(pictures, tmp_path, monkeypatch, capsys):
    folder, mapped = pictures
    out = tmp_path / "out"
    args = ["reconstruct", folder, out, "--scale-from", "target", "--target", "aruco:DICT_4X4_50:0.1"]

    def cannot(self, folder):
        assert list(folder.iterdir()) == []  # no picture is copied before
        raise InertialError(Fact.stated("no worker sees it"))

    with monkeypatch.context() as patch:
        patch.setattr(Processes, "require", cannot)
        code, _, err = run(capsys, *args)
        assert code and "no worker sees it" in err and not out.exists()

    def nothing_found(*_, **__):
        raise TargetNotFoundError(Fact.stated("no marker was found"))

    monkeypatch.setattr(rooms, "validate_model", nothing_found)
    code, _, err = run(capsys, *args)
    assert code == 5 and "no marker was found" in err
    assert [path.name for path in out.iterdir()] == ["colmap"] and len(mapped) == 1
    monkeypatch.setattr(rooms, "validate_model", lambda *_, **__: validated(0.5, unscaled=True))
    code, said, err = run(capsys, *args)
    assert code == 0, err
    assert "lengths of 10 m are accurate to" in said
    assert mapped == [["0.png", "1.png", "2.png", "3.png"]]  # not a second time
    assert sorted(path.name for path in out.iterdir()) == [
        *("colmap", "database.db", "images", "scale.json", "sparse", "transform.json")
    ]
    found = json.loads((out / "scale.json").read_text())
    assert found["scale_from"] == ["target"] and found["metres_per_unit"] == pytest.approx(0.5)
    told = " ".join(found["notes"])
    assert "which way is up is not known" in told and "no IMU was used" in told and "1 more models" in told
    assert [path.name for path in (out / "sparse").iterdir()] == ["0"]
    before, after = (pycolmap.Reconstruction(str(path / "sparse" / "0")) for path in (out / "colmap", out))
    i = before.reg_image_ids()[0]
    ratio = np.linalg.norm(after.image(i).projection_center()) / np.linalg.norm(before.image(i).projection_center())
    assert ratio == pytest.approx(0.5)
    code, _, err = run(capsys, *args)
    assert code == 2 and "exists" in err
    assert sorted(path.name for path in folder.iterdir()) == ["0.png", "1.png", "2.png", "3.png"]


def test_a_model_that_a_link_leads_to_is_not_gone_on_with(pictures, tmp_path, capsys, monkeypatch):
    folder, mapped = pictures
    args = ["reconstruct", folder, tmp_path / "out", "--scale-from", "target", "--target", "aruco:DICT_4X4_50:0.1"]
    monkeypatch.setattr(rooms, "validate_model", lambda *_, **__: validated(0.5, unscaled=True))
    assert run(capsys, *args)[0] == 0
    (tmp_path / "out" / "colmap").rename(tmp_path / "elsewhere")
    shutil.rmtree(tmp_path / "out")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "colmap").symlink_to(tmp_path / "elsewhere")
    code, _, err = run(capsys, *args)
    assert code == 2 and "colmap: is a link to" in " ".join(err.split())
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["colmap"] and len(mapped) == 1


@pytest.mark.parametrize("change", ["delete", "write", "add"])
def test_a_mapping_that_was_changed_since_is_not_gone_on_with(pictures, tmp_path, capsys, monkeypatch, change):
    folder, mapped = pictures
    args = ["reconstruct", folder, tmp_path / "out", "--scale-from", "target", "--target", "aruco:DICT_4X4_50:0.1"]

    def nothing_found(*_, **__):
        raise TargetNotFoundError(Fact.stated("no marker was found"))

    monkeypatch.setattr(rooms, "validate_model", nothing_found)
    assert run(capsys, *args)[0] == 5
    monkeypatch.setattr(rooms, "validate_model", lambda *_, **__: validated(0.5, unscaled=True))
    picture = tmp_path / "out" / "colmap" / "images" / ("9.png" if change == "add" else "2.png")
    picture.unlink(missing_ok=True)
    if change != "delete":
        picture.write_bytes(b"other")
    code, _, err = run(capsys, *args)
    said = " ".join(err.split())
    assert code == 2 and f"{picture.name} is missing or was changed since it was made; remove " in said
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["colmap"] and len(mapped) == 1


@loop_over("content", ["[]", "{}", "3", '{"left_out": ["x"]}', '{"left_out": 3}'])
def test_a_changed_record_of_the_mapping_is_named(pictures, tmp_path, capsys, content):
    folder, _ = pictures
    (tmp_path / "out" / "colmap").mkdir(parents=True)
    (tmp_path / "out" / "colmap" / "made_from.json").write_text(content)
    args = ["--scale-from", "target", "--target", "aruco:DICT_4X4_50:0.1"]
    code, _, err = run(capsys, "reconstruct", folder, tmp_path / "out", *args)
    assert code == 2 and "made_from.json: " in " ".join(err.split())


def test_a_picture_that_a_link_leads_out_is_not_taken_along(pictures, tmp_path, capsys):
    folder, mapped = pictures
    (tmp_path / "secret").write_bytes(b"secret")
    (folder / "4.png").symlink_to(tmp_path / "secret")
    args = ["--scale-from", "target", "--target", "aruco:DICT_4X4_50:0.1"]
    code, _, err = run(capsys, "reconstruct", folder, tmp_path / "out", *args)
    assert code == 2 and "4.png" in err and "links are not followed" in " ".join(err.split())
    assert mapped == [] and not (tmp_path / "out").exists()


def test_what_pictures_alone_cannot_give_is_refused_before_the_mapping(pictures, tmp_path, capsys):
    folder, mapped = pictures
    points = ["--scale-from", "distance", "--between", "1,2,3", "4,5,6", "--distance", "2+-0.1"]
    code, _, err = run(capsys, "reconstruct", folder, tmp_path / "out", *points)
    assert code == 2 and "--between with points needs" in err
    code, _, err = run(capsys, "reconstruct", folder, tmp_path / "out", "--scale-from", "target")
    assert code == 2 and "needs the target" in err
    assert mapped == [] and not (tmp_path / "out").exists()


def test_options_without_their_way_are_refused(tmp_path, capsys):
    code, _, err = run(capsys, "reconstruct", tmp_path, tmp_path / "out", "--scale-from", "target", "--target", "x")
    assert code == 2 and "target" in err
    code, _, err = run(capsys, "reconstruct", tmp_path, tmp_path / "out", "--distance", "2+-0.1")
    assert code == 2 and "needs --between A B" in " ".join(err.split())


def test_a_small_target_vouches_for_no_more_than_its_own_place(capsys):
    for share, said in ((0.05, True), (0.7, False)):
        lengths = LengthCheck(
            count=9,
            rms_m=0.0,
            largest_m=0.0,
            longest_m=0.3,
            diagonal_m=6.0,
            longest_share=share,
            directions=2,
            proves=Fact("views-disagree"),
        )
        validation = dataclasses.replace(validated(0.5, unscaled=True), lengths=lengths)
        show_reference(
            Reference(
                out=Path("out"),
                sensors=combine([evidence_of_target(0.5, 0.001, 0.0)]),
                made_of="a target",
                notes=(),
                validation=validation,
            )
        )
        words = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert ("as far as the target reaches" in words) is said
