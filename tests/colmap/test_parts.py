"""Parts of a capture that are mapped in processes of their own."""

from __future__ import annotations

import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

from colmap_inertial.cli import main
from colmap_inertial.cli.reconstruct import Reconstruct
from colmap_inertial.colmap.chunks import Processes, start_process
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.mapping.part_chunks import map_parts, prepare_part
from colmap_inertial.colmap.parts import write_part_database
from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.colmap.workers import using_workers
from colmap_inertial.core.errors import MappingError
from colmap_inertial.core.threads import usable_processors
from tests.colmap.loops.test_closure import NAMES, make

PARTS = [(0, 18), (12, 30), (24, 42)]


@pytest.fixture(scope="module")
def ring(tmp_path_factory):
    return make(tmp_path_factory.mktemp("ring"), drift=1.0, wider=1.0, true_focal_px=200.0)


def options_of(ring, begin, end):
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.mergedict(ring.capture().pipeline.todict())
    options.num_threads, options.random_seed, options.extract_colors = 1, 3, False
    options.image_names = NAMES[begin:end]
    return options


def parts_in(folder: Path, ring):
    return [
        prepare_part(
            ring.database, folder, options_of(ring, begin, end), folder / str(number), number, ImageOrientations()
        )
        for number, (begin, end) in enumerate(PARTS)
    ]


def files(folder: Path):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.bin")}


def test_a_part_s_database_holds_its_own_images_and_pairs(ring, tmp_path):
    import pycolmap

    write_part_database(ring.database, NAMES[5:15], tmp_path / "part.db")
    with sqlite3.connect(ring.database) as opened:
        numbers = dict(opened.execute("SELECT name, image_id FROM images"))
    own = {numbers[name] for name in NAMES[5:15]}
    with pycolmap.Database.open(str(ring.database)) as whole, pycolmap.Database.open(str(tmp_path / "part.db")) as part:
        images = [image.todict() for image in whole.read_all_images() if image.image_id in own]
        assert [image.todict() for image in part.read_all_images()] == images
        frames = [frame.todict() for frame in whole.read_all_frames() if {d.id for d in frame.data_ids} <= own]
        assert [frame.todict() for frame in part.read_all_frames()] == frames and len(frames) == len(own)
        assert {k for k in numbers.values() if part.num_keypoints_for_image(k)} == own
        kept = dict(zip(*part.read_two_view_geometry_num_inliers(), strict=True))
        all_pairs = dict(zip(*whole.read_two_view_geometry_num_inliers(), strict=True))
        inside = {pair: n for pair, n in all_pairs.items() if set(pycolmap.pair_id_to_image_pair(pair)) <= own}
        assert kept == inside and 0 < len(inside) < len(all_pairs)
        pair = pycolmap.pair_id_to_image_pair(next(iter(kept)))
        matches = [database.read_two_view_geometry(*pair).inlier_matches.tolist() for database in (part, whole)]
        assert matches[0] == matches[1]


def test_models_are_those_of_the_whole_database_in_this_process_for_any_number_of_workers(ring, tmp_path):
    """The reference is COLMAP's mapper on the whole database."""
    import pycolmap

    expected = []
    for number, (begin, end) in enumerate(PARTS):
        out = tmp_path / "here" / str(number)
        out.mkdir(parents=True)
        pycolmap.set_random_seed(3)
        pycolmap.incremental_mapping(str(ring.database), str(tmp_path), str(out), options=options_of(ring, begin, end))
        expected.append(files(out))
    assert all(expected)
    for workers in (1, 2):
        parts, told = parts_in(tmp_path / f"workers{workers}", ring), []
        models = list(map_parts(parts, Processes(number=workers), told.append))
        assert [files(part.made) for part in parts] == expected
        assert [{k: model.num_reg_images() for k, model in found.items()} for found in models] == [
            {0: end - begin} for begin, end in PARTS
        ]
        assert sum(told) >= sum(end - begin - 2 for begin, end in PARTS)  # the first pair comes together


def test_a_part_that_fails_or_is_killed_is_an_error_in_a_sentence(ring, tmp_path, monkeypatch):
    broken = parts_in(tmp_path / "broken", ring)
    (broken[1].folder / "part.db").write_bytes(b"no database")
    with pytest.raises(MappingError, match="mapping part 2 failed: "):
        list(map_parts(broken, Processes(number=2), registered=lambda _: None))
    started, popen = [], subprocess.Popen

    def start(*args, **more):
        started.append(popen(*args, **more))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", start)

    def kill_the_second(_):
        if len(started) > 1:
            started[1].kill()

    with pytest.raises(MappingError, match=r"part 2: the process was killed \(signal 9\); .* --workers"):
        list(map_parts(parts_in(tmp_path / "killed", ring), Processes(number=2), registered=kill_the_second))
    assert all(process.poll() is not None for process in started)


def test_a_part_is_kept_unless_what_it_reads_changed_or_it_is_damaged(ring, tmp_path, monkeypatch):
    import pycolmap

    def prepare(number: int, database=ring.database, seed: int = 3, names=NAMES[0:18]):
        options = options_of(ring, 0, 18)
        options.image_names, options.random_seed = names, seed
        return prepare_part(database, tmp_path, options, tmp_path / str(number), number, ImageOrientations())

    (made,) = map_parts([prepare(0)], Processes(number=1), registered=lambda _: None)
    assert made[0].num_reg_images() == 18
    again, told = prepare(1), []
    assert again.is_made() and not prepare(2, seed=4).is_made() and not prepare(3, names=NAMES[1:18]).is_made()
    outside, inside = tmp_path / "outside.db", tmp_path / "inside.db"
    for path, pair in ((outside, (30, 31)), (inside, (2, 3))):
        path.write_bytes(ring.database.read_bytes())
        with pycolmap.Database.open(str(path)) as opened:
            opened.delete_two_view_geometry(*pair)
    assert prepare(4, outside).is_made() and not prepare(5, inside).is_made()
    monkeypatch.setattr("colmap_inertial.colmap.chunks.start_process", None)  # nothing is started
    (kept,) = map_parts([again], Processes(number=1), told.append)
    assert told == [18] and kept[0].num_reg_images() == 18 and not again.folder.exists()
    points = again.made / "0" / "points3D.bin"
    points.write_bytes(points.read_bytes()[:-9])
    assert not again.is_made() and not again.made.exists()


#: Maps the ring in short parts, one after the other; prints how many there are, and how many were started.
_MAP = """
import sys
from dataclasses import replace
from pathlib import Path
from colmap_inertial.colmap import chunks
from colmap_inertial.colmap.mapping import mapper as mapping, submaps
from colmap_inertial.core.options import MappingOptions

from colmap_inertial.colmap.context import RunContext

submaps.SIZES = replace(submaps.SIZES, least=2, shortest=12, longest=12, shared=1 / 3)
started, start = [], chunks.start_process
chunks.start_process = lambda *args: (started.append(1), start(*args))[1]
database, folder = Path(sys.argv[1]), Path(sys.argv[2])
names = [f"{k:03d}.jpg" for k in range(48)]
options = MappingOptions(overlap=3, pairing="sequential", refine_intrinsics=False)
context = RunContext(scratch=folder, num_threads=1, executor=chunks.Processes(number=1))
record = mapping.map_images(database, folder, folder / "sparse", options, context, in_time=names)
print(record.parts, len(started))
"""


def test_a_run_that_was_killed_makes_only_the_missing_parts_again(ring, tmp_path):
    def finished(folder):
        return [path for path in folder.glob("chunks/*") if len(path.name) == 32]

    def start(folder):
        folder.mkdir(exist_ok=True)
        command = [sys.executable, "-c", _MAP, ring.database, folder]
        return subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True)

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    parts, started = map(int, start(whole).communicate()[0].split())
    assert started == parts >= 5 and not (whole / "chunks").exists()
    process = start(killed)
    while len(finished(killed)) < 2 and process.poll() is None:
        time.sleep(0.02)
    process.kill()
    process.communicate()
    kept = len(finished(killed))
    assert 2 <= kept < parts
    shutil.rmtree(killed / "sparse")  # as a step's runner does
    assert start(killed).communicate()[0].split() == [str(parts), str(parts - kept)]
    assert files(killed / "sparse") == files(whole / "sparse") != {}


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="no SIGSTOP here")
def test_a_process_ends_with_the_one_that_started_it(ring, tmp_path):
    """Its standard input ends then, as the kernel closes it."""
    part = parts_in(tmp_path, ring)[0]
    process = start_process(part)
    with process.stdout:
        assert process.stdout.read(1) == b"."  # at work
        process.send_signal(signal.SIGSTOP)
        process.stdin.close()
        process.send_signal(signal.SIGCONT)
        assert process.wait(timeout=60) == 1
    assert not (part.folder / "made" / "0").exists() and not part.made.exists()


def test_the_number_of_workers_is_that_of_the_command_and_no_option_of_the_result(monkeypatch):
    given = []
    monkeypatch.setattr(Reconstruct, "_scale_by_imu", lambda self: given.append(RunContext().executor.number) or 0)
    for argv in (["--workers", "3"], []):
        with pytest.raises(SystemExit, match="0"):
            main(["reconstruct", "capture", "out", *argv])
    assert given == [3, usable_processors()] and RunContext().identity().keys().isdisjoint({"executor"})
    with pytest.raises(ValueError, match="at least 1"), using_workers(0):
        pass
    with pytest.raises(SystemExit, match="2"):
        main(["reconstruct", "capture", "out", "--workers", "0"])
