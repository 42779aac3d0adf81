"""Databases that others filled: OpenCV's features with and without matches, COLMAP's own of an earlier version."""

import contextlib
import dataclasses
import itertools
import os
import shutil
import sqlite3
import subprocess
from functools import cache

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_inertial.colmap.features import given_database
from colmap_inertial.colmap.features.given_database import read_given, read_matched_pairs
from colmap_inertial.colmap.matching import pairing
from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.options import ReconstructOptions, ReferenceOptions
from colmap_inertial.hooks import KeypointStage
from colmap_inertial.model import read_model
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.commands.scale_by_reference import reconstruct_by
from colmap_inertial.tools.simulate.truth import read_truth, true_metres_per_unit
from tests.helpers.desk_scene import QUICK, SCENE, centres, copy_scene

FIRST = 12
FEATURES = 500
#: The example scene's camera, as somebody else may know it.
OPENCV = [260.0, 260.0, 160.0, 120.0, 0.08, -0.12, 0.0005, -0.0003]
SIMPLE = [265.0, 160.0, 120.0, 0.0]


@cache
def features_of(kind, file):
    """Height and width of a picture, (K, 2) keypoints, and descriptors as OpenCV makes them. ``file``: its bytes."""
    picture = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE)
    finder = cv2.xfeatures2d.AKAZE_create(threshold=1e-4) if kind == "akaze" else cv2.SIFT_create()
    points = sorted(finder.detect(picture), key=lambda point: -point.response)[:FEATURES]
    points, descriptors = finder.compute(picture, points)
    # COLMAP counts from the corner of the first pixel
    return picture.shape, np.array([p.pt for p in points], np.float32) + 0.5, descriptors


def stored(descriptors):
    """Bytes of descriptors, as databases keep them; SIFT as COLMAP has it, root of the share and 512 for 1."""
    if descriptors.shape[1] == 128:
        share = descriptors / descriptors.sum(axis=1, keepdims=True)
        return np.clip(np.round(512 * np.sqrt(share)), 0, 255).astype(np.uint8)
    return descriptors.view(np.uint8)


def match(kind, first, second):
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING if kind == "akaze" else cv2.NORM_L2).knnMatch(first, second, k=2)
    return np.array([(m.queryIdx, m.trainIdx) for m, n in pairs if m.distance < 0.8 * n.distance], np.uint32)


def write_database(path, frames, kind, *, raw=False, matched=(), params=OPENCV, names=None, camera_each=False):
    """A database of OpenCV's features; ``raw`` keeps descriptors as OpenCV has them."""
    model = "OPENCV" if len(params) == 8 else "SIMPLE_RADIAL"
    found = {}
    with pycolmap.Database.open(str(path)) as database:
        camera = None
        for file in sorted(frames.iterdir())[::-1]:  # other numbers than ours
            name = file.name if names is None else names[file.name]
            (height, width), xy_px, descriptors = features_of(kind, file.read_bytes())
            if camera is None or camera_each:
                camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
                camera.camera_id = database.write_camera(camera)
            number = database.write_image(pycolmap.Image(name=name, camera_id=camera.camera_id))
            found[name] = number, descriptors
            database.write_keypoints(number, xy_px)
            if descriptors is not None and raw is not None:
                data = np.ascontiguousarray(descriptors).view(np.uint8) if raw else stored(descriptors)
                database.write_descriptors(
                    number, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, data)
                )
        for a, b in matched:
            database.write_matches(found[a][0], found[b][0], match(kind, found[a][1], found[b][1]))
    return path


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return copy_scene(tmp_path_factory.mktemp("given") / "capture", first=FIRST)


@pytest.fixture(scope="module")
def names(capture):
    return sorted(file.name for file in (capture / "frames").iterdir())


@pytest.fixture(scope="module")
def akaze(capture, names):
    """Binary descriptors, which COLMAP does not match, and matches of all pairs."""
    path = capture.parent / "akaze.db"
    return write_database(path, capture / "frames", "akaze", matched=itertools.combinations(names, 2))


def run(capture, out, database):
    return reconstruct(capture, out, dataclasses.replace(QUICK, database=database), overwrite=True)


@pytest.fixture(scope="module")
def matched(capture, akaze, tmp_path_factory):
    """A run on binary features with matches, and the database's bytes before it. Tests must not change it."""
    before = akaze.read_bytes()
    return run(capture, tmp_path_factory.mktemp("matched") / "out", akaze), before


def is_right(result, names):
    (model,) = result.models
    truth = read_truth(SCENE / "truth.json").trajectory
    seen, places = centres(result.workspace.colmap_sparse / "0")
    assert set(seen) == set(names)
    assert model.scale.metres_per_unit / true_metres_per_unit(seen, places, truth) == pytest.approx(1, abs=0.03)


def keypoints_of(database, name):
    query = "SELECT k.cols, k.data FROM keypoints k JOIN images USING (image_id) WHERE name = ?"
    with contextlib.closing(sqlite3.connect(f"file:{database}?immutable=1", uri=True)) as opened:
        columns, data = opened.execute(query, (name,)).fetchone()
    return np.frombuffer(data, np.float32).reshape(-1, columns)


def test_binary_features_with_matches_go_on_to_metres(capture, names, akaze, matched, tmp_path):
    result, before = matched
    is_right(result, names)
    assert result.matching.given == len(names) * (len(names) - 1) // 2 >= result.matching.matched
    assert akaze.read_bytes() == before and not akaze.with_name("akaze.db-wal").exists()
    own = result.workspace.colmap_database
    np.testing.assert_array_equal(keypoints_of(own, names[0]), keypoints_of(akaze, names[0]))
    # the same again does nothing, another database all
    shutil.copytree(result.workspace.root, tmp_path / "out")
    assert run(capture, tmp_path / "out", akaze).unchanged
    other = tmp_path / "other.db"
    shutil.copyfile(akaze, other)
    os.utime(other, (1, 1))
    begun = []

    def stop(stage, done, total):
        begun.append(stage)
        if stage == "mapping":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(
            capture, tmp_path / "out", dataclasses.replace(QUICK, database=other), overwrite=True, progress=stop
        )
    assert "matches" in begun


def test_sift_of_opencv_without_matches_is_matched_and_a_known_camera_goes_before_its_own(tmp_path):
    # of fewer frames, some models begin with the wrong one of a plane's two poses
    capture = copy_scene(tmp_path / "capture", first=16)
    names = [file.name for file in (capture / "frames").iterdir()]
    given = write_database(tmp_path / "x.db", capture / "frames", "sift", params=SIMPLE, camera_each=True)
    result = run(capture, tmp_path / "out", given)
    is_right(result, names)
    assert result.matching.given == 0 and result.matching.matched > 50
    model = read_model(result.workspace.colmap_sparse / "0")
    (camera,) = model.cameras.values()
    assert camera.model.name == "OPENCV" and camera.params.tolist() == OPENCV


def test_float_features_some_frames_and_a_camera_that_only_the_database_knows(capture, names, tmp_path):
    taken = names[1:11]
    other = copy_scene(tmp_path / "capture", first=FIRST)
    text = (other / "capture.toml").read_text()
    (other / "capture.toml").write_text(text[: text.index("[camera]")] + text[text.index("[imu.gyro]") :])
    frames = tmp_path / "some"
    frames.mkdir()
    for name in taken:
        shutil.copyfile(other / "frames" / name, frames / name)
    pairs = [(a, b) for a, b in itertools.combinations(taken, 2) if taken.index(b) - taken.index(a) <= 4]
    given = write_database(tmp_path / "x.db", frames, "sift", raw=True, matched=pairs)
    with pycolmap.Database.open(str(given)) as database:
        assert database.read_descriptors(1).data.shape[1] == 512
    result = run(other, tmp_path / "out", given)
    is_right(result, taken)
    assert result.matching.given == len(pairs)
    model = read_model(result.workspace.colmap_sparse / "0")
    assert model.cameras[1].model.name == "OPENCV"


def test_what_cannot_be_gone_on_with_is_refused_in_words(capture, names, akaze, tmp_path):
    def refused(path, said):
        with pytest.raises(FormatError, match=said):
            run(capture, tmp_path / "out", path)
        assert not (tmp_path / "out").exists()

    strange = {name: f"other_{name}" for name in names}
    refused(
        write_database(tmp_path / "names.db", capture / "frames", "sift", names=strange),
        rf"{FIRST} of its {FIRST} images are not the capture's \(other_.*give a database of the capture's images",
    )
    small = tmp_path / "small"
    small.mkdir()
    for name in names:
        cv2.imwrite(str(small / name), cv2.resize(cv2.imread(str(capture / "frames" / name)), (160, 120)))
    refused(write_database(tmp_path / "small.db", small, "sift"), "is 160x120 there and 320x240 in the capture")
    refused(
        write_database(tmp_path / "unmatched.db", capture / "frames", "akaze"),
        r"holds no matches, and descriptors that pycolmap cannot match",
    )
    refused(tmp_path / "none.db", "no such file")
    text = tmp_path / "text.db"
    text.write_text("no database " * 500)
    refused(text, "SQLite cannot read it: file is not a database")
    torn = tmp_path / "torn.db"
    torn.write_bytes(akaze.read_bytes()[: akaze.stat().st_size // 2])
    refused(torn, "damaged|SQLite cannot read it")
    with contextlib.closing(sqlite3.connect(tmp_path / "other.db")) as database, database:
        database.execute("CREATE TABLE images (x INTEGER)")
    refused(tmp_path / "other.db", "is no COLMAP database: it has no table cameras")


def test_damage_is_said_before_colmap_ends_the_process(subtests, akaze, tmp_path_factory):
    for change, said in (
        (
            "UPDATE keypoints SET data = x'00' WHERE image_id = 3",
            "1 rows of keypoints do not have their stated length",
        ),
        ("UPDATE keypoints SET cols = 3", "rows of keypoints do not have their stated length"),
        ("UPDATE matches SET rows = rows + 1", "rows of matches do not have their stated length"),
        ("UPDATE descriptors SET cols = 60", "rows of descriptors do not have their stated length"),
        ("DELETE FROM cameras", "an image has no camera"),
        ("UPDATE images SET name = '../x.jpg' WHERE image_id = 1", r"\.\./x\.jpg"),
        ("DELETE FROM keypoints", "holds no keypoints"),
    ):
        with subtests.test(change=change, said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            torn = tmp_path / "torn.db"
            shutil.copyfile(akaze, torn)
            with contextlib.closing(sqlite3.connect(torn)) as database, database:
                database.execute(change)
            with pytest.raises(FormatError, match=said):
                read_given(torn)


def test_matches_of_keypoints_that_there_are_not_are_refused(capture, names, akaze, tmp_path):
    torn = tmp_path / "torn.db"
    shutil.copyfile(akaze, torn)
    far = np.full((20, 2), 100_000, np.uint32).tobytes()
    with contextlib.closing(sqlite3.connect(torn)) as database, database:
        database.execute(
            "UPDATE matches SET rows = 20, data = ? WHERE pair_id = (SELECT MIN(pair_id) FROM matches)", (far,)
        )
    with pytest.raises(FormatError, match="name keypoints that do not exist"):
        run(capture, tmp_path / "out", torn)


def test_a_database_that_is_being_written_is_refused(akaze, tmp_path):
    path = tmp_path / "open.db"
    shutil.copyfile(akaze, path)
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("DELETE FROM matches WHERE rowid = (SELECT MIN(rowid) FROM matches)")
        database.commit()
        with pytest.raises(FormatError, match="another program has it open"):
            read_given(path)
    assert read_given(path)


class Shift(KeypointStage):
    def __call__(self, keypoints):
        return dataclasses.replace(keypoints, rectified=True, xy_px=keypoints.xy_px + 0.25)


@pytest.mark.parametrize("of", ["filmed", "rectified"])
def test_keypoints_are_corrected_once(names, tmp_path, of):
    capture, names = copy_scene(tmp_path / "capture", first=6), names[:6]
    pairs = itertools.combinations(names, 2)
    akaze = write_database(tmp_path / "akaze.db", capture / "frames", "akaze", matched=pairs)
    stages = {"keypoint_stages": [Shift()], "frame_stages": []}
    options = dataclasses.replace(QUICK, database=akaze)
    with pytest.raises(InertialError) as refused:
        reconstruct(capture, tmp_path / "out", options, **stages)
    assert refused.value.code == "database-of-which-images"
    options = dataclasses.replace(options, database_images=of)
    result = reconstruct(capture, tmp_path / "out", options, **stages)
    moved = keypoints_of(result.workspace.colmap_database, names[0]) - keypoints_of(akaze, names[0])
    np.testing.assert_allclose(moved[:, :2], 0.25 if of == "filmed" else 0, atol=1e-4)
    assert result.keypoints.rectified() == set(names)


def test_verified_pairs_are_kept_where_nothing_moves(capture, names, matched, tmp_path, monkeypatch):
    first, _ = matched
    verified = tmp_path / "verified.db"
    shutil.copyfile(first.workspace.colmap_database, verified)
    with contextlib.closing(sqlite3.connect(verified)) as database, database:
        database.execute("DELETE FROM matches")  # some programs write verified pairs alone
    seen = []
    kept = given_database.read_matched_pairs

    def looked(database, images):
        with pycolmap.Database.open(str(database)) as opened:
            seen.append(opened.num_verified_image_pairs())
        return kept(database, images)

    monkeypatch.setattr(pairing, "read_matched_pairs", looked)
    second = run(capture, tmp_path / "second", verified)
    is_right(second, names)
    assert seen == [first.matching.verified]
    assert read_matched_pairs(second.workspace.colmap_database, names)


@pytest.mark.skipif(shutil.which("colmap") is None, reason="no colmap is installed")
def test_a_database_of_an_installed_colmap_goes_on(tmp_path):
    # in half the size, one of its models in five begins with the wrong one of a plane's two poses
    capture = copy_scene(tmp_path / "capture", first=16, half=False)
    path, quiet = tmp_path / "installed.db", {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    for words in (
        f"feature_extractor --image_path {capture / 'frames'} --SiftExtraction.max_num_features 400 "
        "--SiftExtraction.use_gpu 0 --SiftExtraction.num_threads 1",
        "exhaustive_matcher --SiftMatching.use_gpu 0 --SiftMatching.num_threads 1",
    ):
        subprocess.run(["colmap", *words.split(), "--database_path", path], env=quiet, check=True, capture_output=True)
    before = path.read_bytes()
    result = run(capture, tmp_path / "out", path)
    is_right(result, [file.name for file in (capture / "frames").iterdir()])
    assert path.read_bytes() == before
    assert result.matching.given > 60


def test_a_target_in_place_of_an_imu_takes_none(capture, akaze, tmp_path):
    target = ReferenceOptions(target="checkerboard:8x6:0.04")
    with pytest.raises(InertialError, match="--database goes with a capture"):
        reconstruct_by(capture, tmp_path / "out", target, ReconstructOptions(database=akaze))
