"""Parts of a capture that are mapped in processes of their own."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
from pathlib import Path

import pytest
from test_closing import NAMES, make

from colmap_inertial.cli import main
from colmap_inertial.cli.captures import Reconstruct
from colmap_inertial.colmap.parts import map_parts, start_part, write_part_database
from colmap_inertial.core.errors import MappingError
from colmap_inertial.core.threads import usable_processors, using_workers
from colmap_inertial.pipeline.run.context import RunContext

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


def jobs_in(folder: Path, ring):
    jobs = []
    for number, (begin, end) in enumerate(PARTS):
        own = folder / str(number)
        own.mkdir(parents=True)
        write_part_database(ring.database, NAMES[begin:end], own / "part.db")
        jobs.append((own, options_of(ring, begin, end)))
    return jobs


def files(folder: Path):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.bin")}


def test_a_part_s_database_holds_its_own_images_and_pairs(ring, tmp_path):
    import pycolmap

    write_part_database(ring.database, NAMES[5:15], tmp_path / "part.db")
    with sqlite3.connect(ring.database) as opened:
        numbers = dict(opened.execute("SELECT name, image_id FROM images"))
    own = {numbers[name] for name in NAMES[5:15]}
    with pycolmap.Database.open(str(ring.database)) as whole, pycolmap.Database.open(str(tmp_path / "part.db")) as part:
        assert [image.todict() for image in part.read_all_images()] == [i.todict() for i in whole.read_all_images()]
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
        jobs, told = jobs_in(tmp_path / f"workers{workers}", ring), []
        models = list(map_parts(jobs, tmp_path, workers=workers, registered=lambda told=told: told.append(1)))
        assert [files(folder / "models") for folder, _ in jobs] == expected
        assert [{k: model.num_reg_images() for k, model in found.items()} for found in models] == [
            {0: end - begin} for begin, end in PARTS
        ]
        assert len(told) >= sum(end - begin - 2 for begin, end in PARTS)  # the first pair comes together


def test_a_part_that_fails_or_is_killed_is_an_error_in_a_sentence(ring, tmp_path, monkeypatch):
    broken = jobs_in(tmp_path / "broken", ring)
    (broken[1][0] / "part.db").write_bytes(b"no database")
    with pytest.raises(MappingError, match="part 2 cannot be mapped"):
        list(map_parts(broken, tmp_path, workers=2, registered=lambda: None))
    started, popen = [], subprocess.Popen

    def start(*args, **more):
        started.append(popen(*args, **more))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", start)

    def kill_the_second():
        if len(started) > 1:
            started[1].kill()

    with pytest.raises(MappingError, match=r"part 2 was killed \(signal 9\); .* --workers"):
        list(map_parts(jobs_in(tmp_path / "killed", ring), tmp_path, workers=2, registered=kill_the_second))
    assert all(process.poll() is not None for process in started)


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="no SIGSTOP here")
def test_a_process_ends_with_the_one_that_started_it(ring, tmp_path):
    """Its standard input ends then, as the kernel closes it."""
    folder, options = jobs_in(tmp_path, ring)[0]
    process = start_part(folder, options, tmp_path)
    with process.stdout:
        assert process.stdout.read(1) == b"."  # at work
        process.send_signal(signal.SIGSTOP)
        process.stdin.close()
        process.send_signal(signal.SIGCONT)
        assert process.wait(timeout=60) == 1
    assert not (folder / "models" / "0").exists()


def test_the_number_of_workers_is_that_of_the_command_and_no_option_of_the_result(monkeypatch):
    given = []
    monkeypatch.setattr(Reconstruct, "_by_imu", lambda self: given.append(RunContext().workers) or 0)
    for argv in (["--workers", "3"], []):
        with pytest.raises(SystemExit, match="0"):
            main(["reconstruct", "capture", "out", *argv])
    assert given == [3, usable_processors()] and RunContext().identity().keys().isdisjoint({"workers"})
    with pytest.raises(ValueError, match="at least 1"), using_workers(0):
        pass
    with pytest.raises(SystemExit, match="2"):
        main(["reconstruct", "capture", "out", "--workers", "0"])
