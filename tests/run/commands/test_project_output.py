"""The output folder: a project in metres while its scale stands, nothing stale, nobody's own files touched."""

import json
import os
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_inertial.cli.terminal import show_result
from colmap_inertial.colmap.dense.depth_maps import MadeFrom
from colmap_inertial.colmap.loops.closure import LoopClosure
from colmap_inertial.colmap.mapping.mapper import MapRecord, ModelEnds
from colmap_inertial.core.errors import AlreadyMetricError, FormatError, MappingError, OutputError, OutputExistsError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ProjectOptions
from colmap_inertial.core.types import ScaleEstimate
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.capture import Capture
from colmap_inertial.model import read_model, transform_model, write_model
from colmap_inertial.model.project import apply_to_project, undo_project
from colmap_inertial.model.similarities import ModelScale, plain_factor
from colmap_inertial.report.words import describe_mapping, parts_mapped_in_words
from colmap_inertial.run.commands import dense_steps as dense_room, images_alone
from colmap_inertial.run.commands.frames import run_images
from colmap_inertial.run.commands.project_output import (
    list_placed_paths,
    place_project,
    remove_placed,
    remove_stale_dense,
    require_free_names,
)
from colmap_inertial.run.commands.reporting import reporting_stops
from colmap_inertial.run.commands.result import ModelResult, ReconstructResult
from colmap_inertial.run.stages.frame_folder import FrameRecord
from colmap_inertial.run.stages.imaging_plan import ImagingPlan
from colmap_inertial.run.steps.workspace import Workspace, places_of
from tests.helpers.desk_scene import copy_scene
from tests.helpers.model_project import NAMES, write_project
from tests.helpers.sessions import session_in
from tests.helpers.similarities import SIMILARITY

SCALE = ModelScale(similarity=SIMILARITY, verdict="trusted")
REFUSED = ModelScale(similarity=None, verdict="refused", reasons=("the camera stood still",))


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def colmap_project(tmp_path_factory):
    """A project by COLMAP, its model as text and binary. Tests must not change it."""
    root = tmp_path_factory.mktemp("layout") / "project"
    write_project(root)
    return root


@pytest.fixture
def workspace(tmp_path):
    workspace = Workspace(tmp_path / "out")
    workspace.open(tmp_path / "project")
    return workspace


# --- images ----------------------------------------------------------------------------------------------------------


def images_made(workspace, names, moved=(), stages=()):
    session = session_in(workspace)

    def frames(partial):
        partial[0].mkdir()
        for name in names:
            (partial[0] / name).parent.mkdir(exist_ok=True)
            (partial[0] / name).write_text(f"{name} as filmed")

    session.runner.run("frames", {"moved": sorted(moved)}, [workspace.colmap_images], frames)
    records = [FrameRecord(name=name, action="passed") for name in names]
    run_images(session, records, frozenset(moved), stages)
    return session.runner.worked


def test_images_that_nothing_moved_take_no_room_and_outlive_colmap_s(workspace):
    names = ["a.jpg", "left/b.jpg"]
    assert images_made(workspace, names) == ["frames", "images"]
    assert images_made(workspace, names) == []
    assert all((workspace.images / name).samefile(workspace.colmap_images / name) for name in names)
    shutil.rmtree(workspace.colmap)
    assert contents(workspace.images) == {name: f"{name} as filmed".encode() for name in names}


def test_which_images_are_rectified_does_not_hang_on_colmap_s_folder(tmp_path):
    now, before = tmp_path / "now", tmp_path / "before"
    for folder in (now / "images", before / "images", before / "images_rectified"):
        folder.mkdir(parents=True)
    assert (places_of(now).rectified, places_of(now).seen) == (now / "images", now / "images")
    assert (places_of(before).rectified, places_of(before).seen) == (before / "images_rectified", before / "images")
    (now / "colmap" / "images").mkdir(parents=True)
    assert places_of(now).seen == now / "images"  # no run of ours made it
    (now / ".stages").mkdir()
    assert (places_of(now).rectified, places_of(now).seen) == (now / "images", now / "colmap" / "images")


def test_without_hard_links_images_are_copied(workspace, monkeypatch):
    def refuse(*_):
        raise OSError("no such thing here")

    monkeypatch.setattr(os, "link", refuse)
    images_made(workspace, ["a.jpg"])
    assert not (workspace.images / "a.jpg").samefile(workspace.colmap_images / "a.jpg")
    assert contents(workspace.images) == contents(workspace.colmap_images)


def one_moved(inputs):
    """A rolling shutter in one picture."""

    def mover(keypoints):
        return keypoints

    mover.covers = lambda name: name == "000000.jpg"
    mover.move_image = lambda name, image: 255 - image
    return [mover]


def test_deblurred_images_are_rectified_where_that_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(images_alone, "run_plan", lambda *_: ImagingPlan())
    monkeypatch.setattr(images_alone, "default_keypoint_stages", one_moved)
    capture = copy_scene(tmp_path / "capture", first=3)
    filmed = contents(capture / "frames")

    def made(*, rectify):
        done = images_alone.deblur_capture(capture, tmp_path / "out", rectify=rectify, overwrite=True)
        return contents(done.workspace.images), done.workspace.colmap_images

    for _ in range(2):  # there and back
        images, colmap_images = made(rectify=False)
        assert images == filmed and not colmap_images.parent.exists()
        images, colmap_images = made(rectify=True)
        assert contents(colmap_images) == filmed
        assert {name for name in filmed if images[name] != filmed[name]} == {"000000.jpg"}


# --- nothing metric without its model --------------------------------------------------------------------------------


def dense_of(workspace, index, *, maps=False):
    """A dense workspace of ours, as far as it matters here."""
    folder = workspace.dense / str(index)
    (folder / "stereo" / "depth_maps").mkdir(parents=True)
    if maps:
        (folder / "stereo" / "depth_maps" / "a.geometric.bin").write_text("hours")
    (folder / "fused.ply").write_text("points")
    identity = {"model": dense_room.digest_of_model(workspace.sparse / str(index)), "max_image_size": 100}
    (folder / "made_from.json").write_text(json.dumps(identity))
    (workspace.stamps / f"dense_{index}_fused.json").write_text("{}")
    return folder


def metric_model(workspace, colmap_project, factor, index=0):
    shutil.rmtree(workspace.sparse / str(index), ignore_errors=True)
    similarity = plain_factor(factor)
    model = transform_model(read_model(colmap_project / "sparse" / "0"), similarity)
    write_model(model, workspace.sparse / str(index), similarity)
    return {index: workspace.sparse / str(index)}


def test_a_dense_reconstruction_goes_with_its_model(workspace, colmap_project):
    models = metric_model(workspace, colmap_project, 2.0) | metric_model(workspace, colmap_project, 5.0, index=1)
    folder = dense_of(workspace, 0)
    mine = workspace.dense / "1"
    mine.mkdir()
    (mine / "fused.ply").write_text("by somebody else")
    remove_stale_dense(workspace, models)
    assert (folder / "fused.ply").is_file()
    remove_stale_dense(workspace, models | metric_model(workspace, colmap_project, 3.0))
    assert not folder.exists()
    assert not list(workspace.stamps.glob("dense_*"))  # what is gone is made again
    assert contents(mine) == {"fused.ply": b"by somebody else"}
    remove_stale_dense(workspace, {})
    assert contents(workspace.dense) == {"1/fused.ply": b"by somebody else"}


def test_a_dense_reconstruction_that_was_cut_off_early_goes_with_its_model(workspace, colmap_project, monkeypatch):
    models = metric_model(workspace, colmap_project, 2.0)
    session = session_in(workspace)
    session.runner.run("metric", {}, [], lambda _: None)

    def cut_off(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(pycolmap, "undistort_images", cut_off)
    made_from = MadeFrom(model=dense_room.digest_of_model(models[0]), max_image_size=None, maps="plane sweep")
    prepared = dense_room._Prepared(names=(), made_from=made_from, has_maps=False)
    with pytest.raises(KeyboardInterrupt):
        dense_room._undistort_images(session, 0, workspace.images, prepared)
    remove_stale_dense(workspace, models)
    assert (workspace.dense / "0").is_dir()
    (workspace.stamps / "sweep_0").mkdir()
    remove_stale_dense(workspace, {})
    assert not workspace.dense.exists() and not (workspace.stamps / "sweep_0").exists()


def test_a_run_that_stops_leaves_nothing_metric_of_an_earlier_one(workspace, colmap_project, tmp_path):
    metric_model(workspace, colmap_project, 2.0)
    dense_of(workspace, 0)
    kept = [workspace.images, workspace.colmap_sparse]
    for folder in kept:
        folder.mkdir(parents=True)
    for name in ("result.json", "trajectory.tum", "trajectory_1.tum", "trajectory_cov.npz", "trajectory_mine.txt"):
        (workspace.root / name).touch()
    capture = Capture(path=tmp_path, calibration=calibration_prior())

    def stop(session):
        with pytest.raises(MappingError), reporting_stops(session, capture):
            raise MappingError(Fact.stated("COLMAP found no model"))

    before = contents(workspace.root)
    stop(session_in(workspace))  # a finished result stays
    assert contents(workspace.root) == before
    workspace.result.unlink()
    stop(session_in(workspace))
    left = {path.name for path in workspace.root.iterdir()}
    assert left == {"images", "colmap", "trajectory_mine.txt", "report.html", "report.json", workspace.stamps.name}


# --- an existing project ---------------------------------------------------------------------------------------------


@dataclass
class Placing:
    """Puts a project into the folder around metric models, as ``reconstruct_project`` does."""

    workspace: Workspace
    project: Path

    def __call__(self, submodels=("sparse/0",), scales=(SCALE,), **options):
        folders = {i: self.project / folder for i, folder in enumerate(submodels)}
        for index, scale in enumerate(scales):
            place = self.workspace.sparse / str(index)
            if scale.similarity is not None and not place.exists():
                model = transform_model(read_model(folders[index], ".bin"), scale.similarity)
                write_model(model, place, scale.similarity)
        session = session_in(self.workspace)
        source = ProjectOptions(**options)
        found = place_project(session, self.project, source, folders, dict(enumerate(scales)))
        return session.runner.worked, found

    def names(self):
        return {path.name for path in self.workspace.root.iterdir()} - {self.workspace.stamps.name}


@pytest.fixture
def placing(workspace, colmap_project, tmp_path):
    return Placing(workspace, Path(shutil.copytree(colmap_project, tmp_path / "project")))


def test_the_folder_is_the_project_as_apply_would_make_it(placing, tmp_path):
    before = contents(placing.project)
    assert placing() == (["apply"], placing.workspace.root)
    assert placing() == ([], placing.workspace.root)
    assert contents(placing.project) == before
    apply_to_project(placing.project, tmp_path / "applied", SIMILARITY)
    expected, made = contents(tmp_path / "applied"), contents(placing.workspace.root)
    made = {name: data for name, data in made.items() if not name.startswith(placing.workspace.stamps.name)}
    assert made.keys() == expected.keys()
    # the record names what it was made from, and by what; the database is SQLite's
    differing = {name for name in made if made[name] != expected[name]}
    assert differing <= {"transform.json", "dense/sparse/transform.json", "sparse/0/transform.json", "database.db"}


def test_what_is_gone_comes_again_and_nothing_stays_without_a_scale(placing):
    placing()
    before = contents(placing.workspace.images)
    (placing.project / "images" / NAMES[0]).unlink()
    shutil.rmtree(placing.workspace.images)
    assert placing()[0] == ["apply"]
    assert contents(placing.workspace.images).keys() == before.keys() - {NAMES[0]}
    # the project lost a file at the top: so does its copy
    (placing.project / "notes.txt").unlink()
    assert placing()[0] == ["apply"] and "notes.txt" not in placing.names()
    shutil.rmtree(placing.workspace.sparse)
    assert placing(scales=(REFUSED,)) == ([], None)
    assert placing.names() == set() and list_placed_paths(placing.workspace) == []


def test_a_run_killed_while_it_places_leaves_nothing_behind_for_the_next(placing, monkeypatch):
    replace, count = os.replace, [0]

    def killed(source, target):
        if Path(target).parent == placing.workspace.root:
            count[0] += 1
            if count[0] == 3:
                raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        placing()
    monkeypatch.undo()
    (placing.project / "notes.txt").unlink()
    assert placing()[0] == ["apply"]
    assert placing.names() == {"images", "sparse", "dense", "database.db", "project.ini", "transform.json"}
    assert not (placing.workspace.stamps / "project").exists()


def test_a_record_of_what_was_placed_cannot_name_what_lies_elsewhere(subtests, tmp_path):
    """An output folder may come from a stranger; what its record names is removed."""
    for i, name in enumerate((".", "../mine", "a/../../mine", "link/file.txt")):
        with subtests.test(name=name):
            folder = tmp_path / str(i)
            mine = folder / "mine"
            mine.mkdir(parents=True)
            (mine / "file.txt").touch()
            workspace = Workspace(folder / "out")
            workspace.open(folder / "project")
            (workspace.root / "link").symlink_to(mine)
            workspace.placed.write_text(json.dumps({"paths": [name]}))
            with pytest.raises(FormatError, match=r"placed\.json"):
                remove_placed(workspace)
            assert (mine / "file.txt").is_file() and workspace.owner.is_file()


@pytest.mark.parametrize("place", ["", "0", "sparse"])
def test_wherever_the_model_lies_it_comes_to_sparse(workspace, colmap_project, tmp_path, place):
    project = tmp_path / "project"
    shutil.copytree(colmap_project / "sparse" / "0", project / place)
    (project / place / "points.obj").write_text("v 1 2 3\n")
    (project / "notes.txt").write_text("in March")
    placing = Placing(workspace, project)
    placing(submodels=(place,))
    side = set() if place == "" else {"points.obj"}
    assert placing.names() == {"sparse", "notes.txt", "transform.json"} | ({"points.obj"} - side)
    kinds = [
        f"{name}{suffix}" for name in ("cameras", "images", "points3D", "rigs", "frames") for suffix in (".bin", ".txt")
    ]
    assert {path.name for path in (workspace.sparse / "0").iterdir()} == {*kinds, "transform.json"} | side
    assert json.loads((workspace.root / "transform.json").read_text())["models"][0]["folder"] == "sparse/0"
    binary, text = (read_model(workspace.sparse / "0", suffix) for suffix in (".bin", ".txt"))
    for i in binary.point3D_ids():
        np.testing.assert_allclose(text.point3D(i).xyz, binary.point3D(i).xyz, rtol=1e-12)


def test_text_follows_what_a_model_stage_made(placing):
    model = transform_model(read_model(placing.project / "sparse" / "0"), SIMILARITY)
    model.delete_point3D(min(model.point3D_ids()))
    write_model(model, placing.workspace.sparse / "0", SIMILARITY)
    placing()
    for suffix in (".bin", ".txt"):
        assert read_model(placing.workspace.sparse / "0", suffix).num_points3D() == model.num_points3D()


def test_a_refused_sub_model_and_what_was_made_from_it_are_left_out(placing):
    import pycolmap

    moved = read_model(placing.project / "sparse" / "0")
    moved.transform(pycolmap.Sim3d(3.0, pycolmap.Rotation3d(), np.array([9.0, 0.0, 0.0])))
    (placing.project / "sparse" / "1").mkdir()
    moved.write_binary(str(placing.project / "sparse" / "1"))
    (placing.project / "sparse" / "points.txt").write_text("of neither")
    (placing.project / "project.ini").unlink()  # it cannot be told whose depths it limits
    placing(submodels=("sparse/0", "sparse/1"), scales=(REFUSED, SCALE))
    assert sorted(path.name for path in placing.workspace.sparse.iterdir()) == ["1", "points.txt"]
    assert "dense" not in placing.names()  # it was made from the other one
    assert {"images", "database.db", "notes.txt"} <= placing.names()
    record = json.loads((placing.workspace.root / "transform.json").read_text())
    assert [(model["index"], model["folder"]) for model in record["models"]] == [(1, "sparse/1")]


def test_the_whole_project_can_be_taken_back(placing, tmp_path):
    placing()
    root = placing.workspace.root
    for name in ("result.json", "report.html", "trajectory_1.tum", "validation/0/a.png"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("ours")
    with pytest.raises(AlreadyMetricError):
        apply_to_project(root, tmp_path / "twice", plain_factor(2.0))
    undo_project(root, tmp_path / "back")
    assert contents(tmp_path / "back").keys() == contents(placing.project).keys()
    old, new = (read_model(folder / "sparse" / "0") for folder in (placing.project, tmp_path / "back"))
    for i in old.point3D_ids():
        np.testing.assert_allclose(new.point3D(i).xyz, old.point3D(i).xyz, atol=1e-9)


def test_names_that_the_run_needs_are_said_before_any_work(placing):
    require_free_names(placing.project, placing.workspace, dense=False)
    with pytest.raises(OutputError, match=r"dense is already included, in metres: leave out --dense"):
        require_free_names(placing.project, placing.workspace, dense=True)
    for name in ("log.txt", "report.html", "trajectory_2.tum", ".stages"):
        (placing.project / name).touch()
        with pytest.raises(OutputError, match=rf"{name} has a name that the output folder uses"):
            require_free_names(placing.project, placing.workspace, dense=False)
        (placing.project / name).unlink()


def test_what_is_not_of_the_project_is_not_written_over(placing):
    (placing.workspace.root / "notes.txt").write_text("mine")
    with pytest.raises(OutputExistsError, match=r"notes\.txt has the name of the project's"):
        placing()
    assert (placing.workspace.root / "notes.txt").read_text() == "mine"
    assert "images" not in placing.names()


def test_a_project_s_own_dense_folder_goes_with_the_project(placing):
    placing()
    (placing.workspace.dense / "made_from.json").write_text('{"model": "another"}')
    remove_stale_dense(placing.workspace, {})
    assert (placing.workspace.dense / "fused.ply").is_file()


# --- what is said ----------------------------------------------------------------------------------------------------


def test_the_screen_says_the_layout_in_a_line(workspace, capsys):
    summary = {"registered_images": 3, "points": 1, "observations": 3, "mean_reprojection_error_px": 0.5}
    refused = ScaleEstimate.refused("joint", "the camera stood still")
    model = ModelResult(index=0, colmap_index=0, scale=refused, summary=summary, sparse=workspace.colmap_sparse / "0")
    show_result(ReconstructResult(workspace=workspace, models=(model,), seconds={}), Path("capture"))
    said = capsys.readouterr().out.splitlines()[-2]
    assert said == f"no scale was accepted, so nothing here is in metres; COLMAP's own model: {model.sparse}"
    # the workspace of an interrupted dense reconstruction is none
    for folder in (workspace.images, workspace.sparse, workspace.dense / "0"):
        folder.mkdir(parents=True)
    metric = ModelResult(**{**vars(model), "sparse_metric": workspace.sparse / "0"})
    show_result(ReconstructResult(workspace=workspace, models=(metric,), seconds={}), Path("capture"))
    said = capsys.readouterr().out.splitlines()[-2]
    assert said == (
        f"{workspace.root} is a COLMAP project in metres (images, sparse); in COLMAP's units: {workspace.colmap}"
    )
    show_result(
        ReconstructResult(workspace=workspace, models=(metric,), seconds={}, project_metric=workspace.root),
        Path("capture"),
    )
    assert capsys.readouterr().out.splitlines()[-2] == f"{workspace.root} is the whole project in metres"


def test_the_screen_and_the_report_say_how_a_model_was_made(workspace, capsys):
    summary = {"registered_images": 3, "points": 1, "observations": 3, "mean_reprojection_error_px": 0.5}
    refused = ScaleEstimate.refused("joint", "the camera stood still")
    of = {"scale": refused, "summary": summary, "sparse": workspace.colmap_sparse / "0"}
    model = ModelResult(index=0, colmap_index=1, **of)
    joined = ModelEnds(model=1, pairs=12, images=("a.jpg", "b.jpg"), agree=0.97, joined=True)
    apart = ModelEnds(model=1, pairs=9, images=("c.jpg", "d.jpg"), agree=0.31, joined=False)
    other = ModelEnds(model=0, pairs=5, images=("e.jpg", "f.jpg"), agree=0.9, joined=True)
    said = {
        (joined, other): "The loop (a.jpg and b.jpg, 12 pairs of images) was closed.",
        (
            apart,
        ): "The loop (c.jpg and d.jpg, 9 pairs of images) does not fit and stays open (31 % of its matches agree).",
        (): "",
    }
    for ends, expected in said.items():
        record = MapRecord(mapper="incremental", models=2, ends=ends)
        assert " ".join(describe_mapping(asdict(record), 1)) == expected
        show_result(ReconstructResult(workspace=workspace, models=(model,), seconds={}, mapping=record), Path("here"))
        shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert ("Mapping" in shown) == bool(expected) and expected in shown
    in_parts = MapRecord(mapper="incremental", models=1, parts=6)
    assert parts_mapped_in_words(asdict(in_parts)) == ["COLMAP mapped the recording in 6 parts."]
    assert parts_mapped_in_words(asdict(record)) == parts_mapped_in_words(None) == []
    fits = LoopClosure(pairs=40, images=("a.jpg", "b.jpg"), agree=0.99, joined=True)
    bad = LoopClosure(pairs=7, images=("c.jpg", "d.jpg"), agree=0.2, joined=False)
    torn = MapRecord(mapper="incremental", models=2, parts=6, seams=(fits, bad))
    models = (model, replace(model, index=1, colmap_index=0))
    show_result(ReconstructResult(workspace=workspace, models=models, seconds={}, mapping=torn), Path("here"))
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    # of all models together, and once
    assert shown.count("in 6 parts.") == 1 and shown.count("(20 % of the matches agree).") == 1
    assert "c.jpg and d.jpg, 7 pairs" in shown and "a.jpg" not in shown
    assert describe_mapping(None, 0) == []
