"""Features, matches and models by an installed COLMAP: a real one, one of today's names and tables, and failures."""

import contextlib
import dataclasses
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_inertial.cli import main
from colmap_inertial.colmap import executable
from colmap_inertial.colmap.executable import read_executable
from colmap_inertial.colmap.settings import read_settings
from colmap_inertial.core.errors import FormatError, InertialError, MappingError
from colmap_inertial.core.options import MappingOptions, ProjectOptions, ReconstructOptions, ReferenceOptions
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.commands.reconstruct_project import reconstruct_project
from colmap_inertial.run.commands.scale_by_reference import reconstruct_by
from tests.colmap.features.test_given_database import is_right, keypoints_of
from tests.helpers.desk_scene import QUICK, copy_scene

COLMAP = shutil.which("colmap")
needs_colmap = pytest.mark.skipif(COLMAP is None, reason="no colmap is installed")

SMALL = [
    word
    for name in ("max_num_features", "first_octave", "max_image_size")
    for word in (f"--mapping.{name.replace('_', '-')}", str(getattr(QUICK.mapping, name)))
]
#: A COLMAP of 4.x: its command line, on pycolmap.
NEWER = f"""#!{sys.executable}
import sys
command, words = sys.argv[1], sys.argv[2:]
if command == "help":
    print("COLMAP 4.2.1 -- Structure-from-Motion and Stereo\\n  (Commit 0 on 2026-01-01 without GPU support)")
    sys.exit()
if words == ["-h"]:
    names = {{
        "database_creator": "database_path",
        "feature_extractor": "database_path image_path image_list_path FeatureExtraction.max_image_size "
        "FeatureExtraction.use_gpu FeatureExtraction.num_threads SiftExtraction.max_num_features "
        "SiftExtraction.first_octave SiftExtraction.peak_threshold",
        "matches_importer": "database_path match_list_path match_type FeatureMatching.use_gpu "
        "FeatureMatching.num_threads FeatureMatching.skip_geometric_verification SiftMatching.max_ratio",
        "mapper": "database_path image_path output_path Mapper.ba_refine_focal_length Mapper.ba_global_frames_ratio",
    }}
    print("Options:", *(f"  --{{name}} arg (=1)" for name in names[command].split()), sep="\\n")
    sys.exit()
import pycolmap
given = dict(zip([w.removeprefix("--") for w in words[::2]], words[1::2]))
database = given["database_path"]
pycolmap.set_random_seed(0)
pycolmap.Database.open(database).close()
if command == "feature_extractor":
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.max_image_size = int(given["FeatureExtraction.max_image_size"])
    options.sift.max_num_features = int(given["SiftExtraction.max_num_features"])
    options.sift.first_octave = int(given["SiftExtraction.first_octave"])
    options.sift.peak_threshold = float(given.get("SiftExtraction.peak_threshold", options.sift.peak_threshold))
    names = open(given["image_list_path"]).read().split()
    pycolmap.extract_features(database, given["image_path"], names, extraction_options=options)
if command == "mapper":
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, 0
    options.ba_refine_focal_length = options.ba_refine_extra_params = given["Mapper.ba_refine_focal_length"] == "True"
    options.ba_global_frames_ratio = float(given["Mapper.ba_global_frames_ratio"])
    tell = lambda: print("Registering image #1", flush=True)
    pycolmap.incremental_mapping(
        database, given["image_path"], given["output_path"], options=options, next_image_callback=tell
    )
if command == "matches_importer":
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = 1
    options.skip_geometric_verification = given["FeatureMatching.skip_geometric_verification"] == "1"
    pairs = pycolmap.ImportedPairingOptions(match_list_path=given["match_list_path"])
    pycolmap.match_image_pairs(database, matching_options=options, pairing_options=pairs)
"""
#: The helps of COLMAP 3.8, with CUDA; then a command that does something else.
OLDER = r"""#!/bin/sh
case "$1 $2" in
"help "*) printf 'COLMAP 3.8 -- Structure-from-Motion\n   (Commit Unknown on Unknown with CUDA)\n'; exit ;;
*" -h") for name in database_path image_path image_list_path match_list_path match_type output_path \
  SiftExtraction.use_gpu Mapper.ba_global_images_ratio \
  SiftExtraction.max_image_size SiftExtraction.max_num_features SiftMatching.use_gpu; do echo "  --$name arg"; done
  exit ;;
esac
"""


def program(path, text):
    path.write_text(text)
    path.chmod(0o755)
    return path


def capture_of(folder, **more):
    """A capture, and the names of its frames."""
    capture = copy_scene(folder / "capture", **more)
    return capture, sorted(file.name for file in (capture / "frames").iterdir())


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """For a real COLMAP."""
    return capture_of(tmp_path_factory.mktemp("filmed"), first=16, half=False)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """For programs that stand for one."""
    return capture_of(tmp_path_factory.mktemp("short"), first=10)


@pytest.fixture(scope="module")
def capture(short):
    return short[0]


def run(capture, out, path, **more):
    return reconstruct(capture, out, dataclasses.replace(QUICK, colmap_executable=Path(path), **more))


@pytest.fixture(scope="module")
def installed(filmed, tmp_path_factory):
    """A run by the COLMAP that is installed."""
    return run(filmed[0], tmp_path_factory.mktemp("installed") / "out", COLMAP)


def tables_of(path):
    with contextlib.closing(sqlite3.connect(f"file:{path}?immutable=1", uri=True)) as opened:
        return {
            name: opened.execute(f"SELECT * FROM {name} ORDER BY 1").fetchall() for name in ("keypoints", "matches")
        }


@needs_colmap
def test_an_installed_colmap_finds_and_matches_features(filmed, installed, tmp_path):
    (capture, names), result, out = filmed, installed, installed.workspace.root
    is_right(result, names)
    assert result.matching.given == 0 and result.matching.device == "cpu"
    assert "Processed file [16/16]" in (out / ".stages/feature_extractor.txt").read_text()
    assert "Elapsed time" in (out / ".stages/matches_importer.txt").read_text()
    assert "Registering image #" in (out / ".stages/mapper.txt").read_text()
    assert sorted(path.name for path in (result.workspace.colmap_sparse / "0").iterdir()) == [
        *("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")
    ]
    assert "COLMAP 3." in (out / "log.txt").read_text()
    assert not [path for path in out.rglob("*") if path.name.startswith(("tmp", "installed"))]
    # a pair without matches has a row, too; features are not those of pycolmap
    own = reconstruct(capture, tmp_path / "own", QUICK)
    found, ours = (tables_of(done.workspace.colmap_database) for done in (result, own))
    assert len(found["matches"]) == result.matching.matched
    assert found["keypoints"] != ours["keypoints"]
    assert run(capture, out, COLMAP).unchanged


@needs_colmap
def test_its_keypoints_are_moved_before_its_matches_are_verified(filmed, installed, tmp_path):
    capture, names = filmed

    def shift(keypoints):
        return dataclasses.replace(keypoints, xy_px=keypoints.xy_px + np.array([3.0, -2.0]))

    options = dataclasses.replace(QUICK, colmap_executable=Path(COLMAP))
    moved = reconstruct(capture, tmp_path / "moved", options, keypoint_stages=[shift])
    for name in (names[0], names[-1]):
        before, after = (keypoints_of(done.workspace.colmap_database, name) for done in (installed, moved))
        np.testing.assert_allclose(after[:, :2] - before[:, :2], [[3, -2]] * len(before), atol=1e-3)


@needs_colmap
def test_frames_without_texture_give_no_model(tmp_path, capsys):
    capture, rng = copy_scene(tmp_path / "noise", first=5), np.random.default_rng(0)
    for path in (capture / "frames").iterdir():
        cv2.imwrite(str(path), rng.integers(0, 255, cv2.imread(str(path)).shape, dtype=np.uint8))
    with pytest.raises(SystemExit) as stopped:
        main(["reconstruct", str(capture), str(tmp_path / "out"), "--colmap-executable", COLMAP, *SMALL])
    assert stopped.value.code == 4
    told = capsys.readouterr().err
    assert "COLMAP found no model" in told and "Traceback" not in told


def stop_before_mapping(stage, done, total):
    if stage == "mapping":
        raise KeyboardInterrupt


def test_options_and_tables_of_todays_colmap_are_used(short, tmp_path):
    capture, names = short
    newer = program(tmp_path / "colmap", NEWER)
    given = (
        "SiftExtraction.peak_threshold=0.004",
        "FeatureExtraction.max_image_size=310",
        "TwoViewGeometry.max_error=3",
    )
    result = run(capture, tmp_path / "out", newer, colmap=given)
    is_right(result, names)
    own = dataclasses.replace(QUICK, deterministic=True, colmap=given)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(capture, tmp_path / "own", own, progress=stop_before_mapping)
    assert tables_of(result.workspace.colmap_database) == tables_of(tmp_path / "own/colmap/database.db")


def test_a_database_of_others_is_matched_by_it(short, tmp_path):
    capture, names = short
    from tests.colmap.features.test_given_database import write_database

    given = write_database(tmp_path / "x.db", capture / "frames", "sift", matched=[(names[0], names[1])])
    newer = program(tmp_path / "colmap", NEWER)
    result = run(capture, tmp_path / "out", newer, database=given)
    is_right(result, names)
    assert result.matching.given == 1
    assert not (tmp_path / "out/.stages/feature_extractor.txt").exists()


def read(path, *, settings=(), deterministic=False, **mapping):
    return read_executable(path, MappingOptions(**mapping), read_settings(settings, None), deterministic=deterministic)


def test_device_and_names_are_those_that_it_has(tmp_path):
    older = program(tmp_path / "colmap", OLDER)
    assert (read(older).version, read(older).device) == ("3.8", "cuda")
    with pytest.raises(InertialError, match="--deterministic works with pycolmap only"):
        read(older, deterministic=True)
    assert read(older, device="cpu").device == "cpu"
    settings = ("FeatureExtraction.max_image_size=99",)
    assert read(older, settings=settings).arguments("feature_extractor", {"use_gpu": 1, "first_octave": 0}) == {
        "SiftExtraction.use_gpu": 1,
        "SiftExtraction.max_image_size": "99",
    }
    with pytest.raises(InertialError, match=r"COLMAP 3\.8 .* has no such option; did you mean SiftExtraction.max_n"):
        read(older, settings=("SiftExtraction.max_num_orientations=1",))
    mapper = read(older).arguments("mapper", {"ba_global_frames_ratio": 1.4, "ba_refine_focal_length": False})
    assert mapper == {"Mapper.ba_global_images_ratio": 1.4}
    assert read(older, settings=("GlobalMapper.ba_ceres_max_num_iterations=9", "TwoViewGeometry.max_error=3"))
    with pytest.raises(InertialError, match=r"Mapper\.init_num_trials=9: COLMAP 3\.8 .* has no such option"):
        read(older, settings=("Mapper.init_num_trials=9",))
    newer = program(tmp_path / "newer", NEWER)
    assert read(newer).device == "cpu"
    with pytest.raises(InertialError, match=r"--mapping.device cuda: .*newer is built without CUDA"):
        read(newer, device="cuda")
    with pytest.raises(InertialError, match="aliked works with pycolmap only"):
        read(newer, features="aliked")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such file: --colmap-executable takes"),
        ("#!/bin/sh\necho hello", "is not COLMAP: `help` prints 'hello'"),
        ("#!/bin/sh\nexit 1", "is not COLMAP: `help` prints 'nothing'"),
        ("#!/bin/sh\nexec yes", "is not COLMAP: `help` prints 'y'"),
        ("#!/bin/sh\nexec head -c 3000000 /dev/urandom", "is not COLMAP"),
        ("#!/no/such/shell\n", "cannot be run: No such file"),
        ("\x7fELF", "cannot be run: Exec format error"),
        ("#!/bin/sh\necho COLMAP 2.0", "COLMAP 2.0: its database_creator has no --database_path"),
    ],
)
def test_another_program_is_refused_before_any_work(capture, tmp_path, text, message):
    path = tmp_path / "colmap"
    if text is not None:
        program(path, text)
    with pytest.raises(FormatError, match=message):
        run(capture, tmp_path / "out", path)
    assert not (tmp_path / "out").exists()


def test_one_that_may_not_be_run_or_hangs_is_refused(capture, tmp_path, monkeypatch):
    path = program(tmp_path / "colmap", OLDER)
    path.chmod(0o644)
    with pytest.raises(FormatError, match=r"is not executable: make it executable \(chmod \+x\)"):
        run(capture, tmp_path / "out", path)
    limits = dataclasses.replace(executable._LIMITS, help_s=0.2)
    monkeypatch.setattr(executable, "_LIMITS", limits)
    with pytest.raises(FormatError, match="is not COLMAP: `help` prints 'nothing'"):
        read(program(path, "#!/bin/sh\nsleep 100 &\nwait"))


@pytest.mark.parametrize(
    ("then", "message"),
    [
        (
            "printf 'one\\n\\033[31mtwo\\n\\nthree\\nfour\\n'; exit 3",
            r"exit code 3: \\x1b\[31mtwo \| three \| four; full",
        ),
        ("kill -9 $$", r"was killed \(signal 9\): it printed nothing"),
        ("exit 0", "the database that it wrote cannot be used: no such file"),
        ('printf garbage > "$3"', "the database that it wrote cannot be used"),
    ],
)
def test_one_that_fails_is_told_with_its_last_lines(capture, tmp_path, capsys, then, message):
    path = program(tmp_path / "colmap", OLDER + then)
    with pytest.raises(MappingError, match=message):
        run(capture, tmp_path / "out", path)
    assert not (tmp_path / "out/colmap/database.db").exists()
    with pytest.raises(SystemExit) as stopped:
        main(["reconstruct", str(capture), str(tmp_path / "out"), "--colmap-executable", str(path)])
    assert stopped.value.code == 4
    told = capsys.readouterr().err
    assert "Traceback" not in told and "\033[31m" not in told


def test_one_whose_matches_cannot_be_read_is_told(capture, tmp_path):
    path = program(
        tmp_path / "colmap",
        NEWER.replace(
            "import pycolmap\n",
            """
if command == "matches_importer":
    import sqlite3
    sqlite3.connect(words[1]).execute("DROP TABLE matches")
    sys.exit()
import pycolmap
""",
        ),
    )
    with pytest.raises(MappingError, match="its database cannot be used here: no such table: matches"):
        run(capture, tmp_path / "out", path)


def test_it_goes_with_captures_and_the_imu_alone(capture, project, tmp_path):
    path = program(tmp_path / "colmap", OLDER)
    options = ReconstructOptions(colmap_executable=path)
    target = ReferenceOptions(target="checkerboard:8x6:0.04")
    with pytest.raises(InertialError, match="--colmap-executable goes with a capture"):
        reconstruct_by(capture, tmp_path / "out", target, options)
    with pytest.raises(InertialError, match="--colmap-executable: an existing model is not mapped again"):
        reconstruct_project(project.model.parents[1], tmp_path / "out", ProjectOptions(), options)


def stop_in_matches(words, by, code, pid):
    """Start a run whose COLMAP says its process when it matches, and waits; stop the run, and see both end."""
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell's background jobs ignore it
    command = [sys.executable, "-m", "colmap_inertial", *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, preexec_fn=heed) as process:
        end_s = time.monotonic() + 120
        while not pid.exists() or not pid.read_text():
            assert process.poll() is None and time.monotonic() < end_s
            time.sleep(0.05)
        child = int(pid.read_text())
        process.send_signal(by)
        told = process.stderr.read().decode()
    assert process.returncode == code and "Traceback" not in told
    for _ in range(100):
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, 0)
            time.sleep(0.05)
            continue
        break
    else:
        pytest.fail("it goes on")
    pid.unlink()


def test_it_ends_with_the_run_which_then_continues(short, tmp_path):
    capture, names = short
    wait = f"import os, time\nif command == 'matches_importer' and not os.path.exists({str(tmp_path / 'go')!r}):\n"
    wait += f"    open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid()))\n    time.sleep(100)\nimport pycolmap\n"
    path = program(tmp_path / "colmap", NEWER.replace("import pycolmap\n", wait))
    words = ["reconstruct", capture, tmp_path / "out", "--colmap-executable", path, *SMALL]
    features = tmp_path / "out/.stages/feature_extractor.txt"
    made_ns = set()
    for by, code in ((signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)):
        stop_in_matches(words, by, code, tmp_path / "pid")
        made_ns.add(features.stat().st_mtime_ns)
    (tmp_path / "go").touch()
    result = run(capture, tmp_path / "out", path)
    is_right(result, names)
    assert made_ns == {features.stat().st_mtime_ns}
    assert not list((tmp_path / "out/.stages").glob("tmp*"))
