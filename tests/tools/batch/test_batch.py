"""Batches of real, small reconstructions: on this machine, and on a Dask cluster whose workers die."""

import contextlib
import csv
import dataclasses
import errno
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Container
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import cv2
import numpy as np
import psutil
import pycolmap
import pytest

from colmap_inertial.cli import main, parse
from colmap_inertial.colmap import workers
from colmap_inertial.colmap.chunks import Chunk, Processes
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features import chunks as feature_chunks
from colmap_inertial.colmap.features.chunks import ChunkSizes, FindFeatures, find_elsewhere
from colmap_inertial.colmap.features.extraction import extract_features, image_pairs, match_pairs
from colmap_inertial.colmap.mapping import submaps
from colmap_inertial.colmap.mapping.mapper import map_images
from colmap_inertial.colmap.mapping.part_chunks import MapPart
from colmap_inertial.colmap.settings import ColmapSettings
from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.colmap.workers import Cluster, connect, describe_versions, do_for_another, using_workers
from colmap_inertial.core.errors import (
    FormatError,
    InertialError,
    MappingError,
    MissingExtraError,
    OutputError,
    OutputExistsError,
)
from colmap_inertial.core.options import BatchOptions, MappingOptions, ReconstructOptions
from colmap_inertial.core.progress import silent
from colmap_inertial.io.capture import load_capture
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.steps.config import config_as_toml
from colmap_inertial.tools import batch
from colmap_inertial.tools.batch import BatchCapture, needs_gpu, read_manifest, run_batch
from colmap_inertial.tools.batch.pools import available_memory, shares_of_this_machine
from colmap_inertial.tools.batch.task import CaptureStatus, read_status
from tests.helpers.batch_captures import TINY, model_bytes, tiny_capture
from tests.helpers.cases import loop_over
from tests.helpers.json_schemas import find_violations

#: Of fewer than eight there is no scale.
FRAMES = 9


def table(out: Path) -> dict[str, dict[str, str]]:
    with open(out / "summary.csv", newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def processes_of(out: Path) -> list[int]:
    """Running processes that work on a batch."""
    found = []
    for folder in Path("/proc").iterdir():
        try:
            command = (folder / "cmdline").read_bytes()
        except (OSError, ValueError):
            continue
        if folder.name.isdigit() and b"colmap_inertial.tools.batch.process" in command and str(out).encode() in command:
            found.append(int(folder.name))
    return found


def eventually(condition, seconds: float = 180.0):
    """The first true value of ``condition``."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        value = condition()
        if value:
            return value
        time.sleep(0.05)
    raise AssertionError("it never came true")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture, and what ``reconstruct`` makes of it by itself."""
    root = tmp_path_factory.mktemp("captures")
    hall = tiny_capture(root / "hall", frames=FRAMES)
    reconstruct(hall, root / "alone", TINY)
    return hall, model_bytes(root / "alone")


@pytest.fixture
def manifest(capture, tmp_path):
    """A manifest beside a link to the capture; a broken one comes before it."""
    (tmp_path / "hall").symlink_to(capture[0])
    broken = tiny_capture(tmp_path / "broken", frames=FRAMES)
    (broken / "gyro.csv").write_text("t,x,y,z\n0,1\n")
    names = ("broken", "hall")
    (tmp_path / "captures.toml").write_text("".join(f'[[capture]]\npath = "{name}"\n' for name in names))
    return tmp_path / "captures.toml"


def test_a_manifest_gives_each_capture_its_options(tmp_path):
    (tmp_path / "yard.toml").write_text('world = "y-down"\ncalibration = "phone.json"\n[mapping]\noverlap = 4\n')
    (tmp_path / "m.toml").write_text(
        '[[capture]]\npath = "captures/hall"\n\n[[capture]]\nname = "yard-2"\npath = "yard/second.mp4"\n'
        'config = "yard.toml"\noptions.mapping.overlap = 5\n\n[[capture]]\npath = "roof/capture.toml"\n'
    )
    hall, yard, roof = read_manifest(tmp_path / "m.toml", ReconstructOptions(seed=7))
    assert (hall.name, hall.path, hall.options.seed) == ("hall", tmp_path / "captures" / "hall", 7)
    assert (yard.name, yard.path) == ("yard-2", tmp_path / "yard" / "second.mp4")
    assert (yard.options.seed, yard.options.world, yard.options.mapping.overlap) == (7, "y-down", 5)
    assert yard.options.calibration == (tmp_path / "phone.json",)
    assert roof.name == "roof"


def test_an_existing_project_names_its_recording_in_the_manifest(project, tmp_path):
    (tmp_path / "m.toml").write_text(
        f'[[capture]]\nname = "desk"\npath = "{project.model.parents[1]}"\n'
        'project.imu = "imu"\nproject.frame_times = "frames.csv"\nproject.keep = ["old/*"]\n'
    )
    (tmp_path / "imu").symlink_to(project.imu)
    (tmp_path / "frames.csv").symlink_to(project.frame_times)
    (capture,) = read_manifest(tmp_path / "m.toml")
    assert capture.project.keep == ("old/*",)
    for _ in range(2):
        (end,) = run_batch(tmp_path / "m.toml", tmp_path / "out").captures
        assert (end.state, end.models[0]["verdict"]) == ("done", "trusted"), end.error
    assert (tmp_path / "out" / "desk" / "sparse" / "0" / "transform.json").is_file()
    # other options do not replace a result unasked
    made = model_bytes(tmp_path / "out" / "desk")
    other = dataclasses.replace(capture, project=dataclasses.replace(capture.project, link=True))
    (end,) = run_batch([other], tmp_path / "out").captures
    assert end.exit_code == 2 and "step apply would change" in end.error
    assert model_bytes(tmp_path / "out" / "desk") == made != {}


def test_a_folder_of_captures_is_a_manifest(tmp_path):
    for name in ("b", "a", ".hidden"):
        (tmp_path / name).mkdir()
    (tmp_path / "notes.txt").write_text("")
    assert [capture.name for capture in read_manifest(tmp_path)] == ["a", "b"]
    (tmp_path / "capture.toml").write_text("")
    with pytest.raises(FormatError) as refused:
        read_manifest(tmp_path)
    assert refused.value.code == "batch-of-one-capture"


@loop_over(
    ("text", "words"),
    [
        ("", "names no capture"),
        ('[capture]\npath = "a"\n', "two brackets"),
        ('[[capture]]\nname = "a"\n', "path is missing"),
        ('[[capture]]\npath = "a"\npth = "b"\n', "did you mean"),
        ('[[capture]]\npath = "a"\n[[capture]]\npath = "b/A"\n', "two captures are called A"),
        ('[[capture]]\npath = "a"\nname = "../a"\n', "cannot be one"),
        ('[[capture]]\npath = "status"\n', "choose another name"),
        ('[[capture]]\npath = "a"\noptions.mapping.overlp = 2\n', "did you mean mapping.overlap"),
        ('[[capture]]\npath = "a"\noptions.seed = -1\n', "seed must be"),
        ('[[capture]]\npath = "a"\noptions = 3\n', "is a table"),
        ('[[capture]]\npath = "a"\nconfig = "none.toml"\n', "none.toml: no such file"),
        ("[[capture]\n", "not valid TOML"),
    ],
)
def test_a_wrong_manifest_is_named_before_any_work(capsys, tmp_path, text, words):
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(SystemExit) as stopped:
        main(["batch", str(tmp_path / "m.toml"), str(tmp_path / "out")])
    assert stopped.value.code == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_flags_and_a_configuration_reach_every_capture(tmp_path):
    (tmp_path / "c.toml").write_text("seed = 4\n[mapping]\noverlap = 3\n")
    command = parse(["batch", "m", "out", "--config", str(tmp_path / "c.toml"), "--seed", "5", "--workers", "2"])
    assert (command.options.seed, command.options.mapping.overlap, command.batch.workers) == (5, 3, 2)


def test_impossible_values_are_refused(subtests, capsys, tmp_path_factory):
    for flags in (["--workers", "0"], ["--attempts", "0"], ["--workers", "2", "--scheduler", "tcp://nowhere:1"]):
        with subtests.test(flags=flags):
            tmp_path = tmp_path_factory.mktemp("given")
            capsys.readouterr()
            with pytest.raises(SystemExit) as stopped:
                main(["batch", str(tmp_path), str(tmp_path / "out"), *flags])
            assert stopped.value.code == 2


def test_workers_share_the_processors(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)))
    monkeypatch.setattr("colmap_inertial.tools.batch.pools.available_memory", lambda: 64 * 2**30)
    assert shares_of_this_machine(3) == [[0, 3, 6], [1, 4, 7], [2, 5]]
    assert shares_of_this_machine(100) == [[i] for i in range(8)]
    assert len(shares_of_this_machine(100, 2)) == 2
    assert shares_of_this_machine(100, 10)[8:] == [[0], [1]]
    monkeypatch.setattr("colmap_inertial.tools.batch.pools.available_memory", lambda: 7 * 2**30)
    assert shares_of_this_machine(100) == [[0], [1]]
    monkeypatch.setattr("colmap_inertial.tools.batch.pools.available_memory", lambda: 0)
    assert shares_of_this_machine(100) == [[0]]


def test_memory_is_that_of_this_machine():
    assert 2**20 < available_memory() < 2**46


def test_one_broken_capture_does_not_stop_the_rest_and_finished_ones_are_not_run_again(
    capture, manifest, tmp_path, capsys
):
    good, alone = capture
    out, seen = tmp_path / "out", []
    result = run_batch(manifest, out, TINY, watch=seen.append)
    assert [(c.name, c.state, c.exit_code) for c in result.captures] == [
        ("broken", "failed", 2),
        ("hall", "done", 0),
    ]
    assert result.exit_code() == 1
    assert "gyro.csv" in result.captures[0].error
    assert {status.stage for status in seen} & {"features", "matches", "mapping"}
    assert model_bytes(out / "hall") == alone
    rows = table(out)
    assert rows["hall"]["verdict"] == json.loads((out / "hall" / "result.json").read_text())["models"][0]["verdict"]
    assert float(rows["hall"]["ci95_low"]) < float(rows["hall"]["metres_per_unit"]) < float(rows["hall"]["ci95_high"])
    assert (rows["broken"]["state"], rows["broken"]["exit_code"]) == ("failed", "2")
    stored = json.loads((out / "summary.json").read_text())
    assert find_violations("summary", stored) == []
    assert (stored["done"], stored["failed"], stored["interrupted"]) == (1, 1, 0)
    assert read_status(out / "status" / "hall.json") == result.captures[1]
    assert not (out / "status" / "run").exists()

    # again: the broken one, repaired, and nothing else
    before = (out / "hall" / "result.json").stat().st_mtime_ns
    (manifest.parent / "broken" / "gyro.csv").write_bytes((good / "gyro.csv").read_bytes())
    again = run_batch(manifest, out, TINY)
    assert again.exit_code() == 0
    assert model_bytes(out / "broken") == alone
    assert (out / "hall" / "result.json").stat().st_mtime_ns == before


def test_a_killed_process_is_started_again_and_at_last_given_up(capture, tmp_path, monkeypatch):
    path, alone = capture
    monkeypatch.setattr(batch, "BATCH_TIMING", batch.BatchTiming(progress_s=0.05))  # steps take tenths of a second
    hall = BatchCapture(name="hall", path=path, options=TINY)
    killed: list[int] = []

    def kill(stages: Container[str], out: Path):
        def watch(status: CaptureStatus) -> None:
            if status.state == "running" and status.stage in stages and not killed:
                for pid in processes_of(out):
                    os.kill(pid, signal.SIGKILL)
                    killed.append(pid)

        return watch

    stages = ("features", "matches", "mapping")
    (end,) = run_batch([hall], tmp_path / "once", watch=kill(stages, tmp_path / "once")).captures
    assert (end.state, end.attempts) == ("done", 2)
    assert model_bytes(tmp_path / "once" / "hall") == alone
    killed.clear()
    (end,) = run_batch(
        [hall], tmp_path / "ever", batch=BatchOptions(attempts=1), watch=kill(("check",), tmp_path / "ever")
    ).captures
    assert (end.state, end.exit_code) == ("failed", 1)
    assert "killed 1 times" in end.error


def test_ctrl_c_stops_the_process_of_a_capture_and_the_batch_continues_afterwards(tmp_path):
    # long enough to be at work still when it is interrupted
    reconstruct(tiny_capture(tmp_path / "hall", frames=16), tmp_path / "alone", TINY)
    (tmp_path / "options.toml").write_text(config_as_toml(TINY))
    manifest, out = tmp_path / "captures.toml", tmp_path / "out"
    manifest.write_text('[[capture]]\npath = "hall"\n')
    command = [sys.executable, "-m", "colmap_inertial", "batch", manifest, out, "--config", tmp_path / "options.toml"]
    # whoever runs the tests in the background lets their children ignore Ctrl-C
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    batch = subprocess.Popen(list(map(str, command)), stderr=subprocess.PIPE, text=True, preexec_fn=heed)
    eventually(lambda: processes_of(out) and list((out / "hall").glob("frames.json")))
    with pytest.raises(OutputExistsError, match="another batch is at work"):
        run_batch(manifest, out, TINY)
    batch.send_signal(signal.SIGINT)
    _, said = batch.communicate(timeout=30)
    assert batch.returncode == 130
    assert "to continue" in said
    assert processes_of(out) == []
    assert table(out)["hall"]["state"] == "interrupted"
    assert run_batch(manifest, out, TINY).captures[0].state == "done"
    assert model_bytes(out / "hall") == model_bytes(tmp_path / "alone")


def test_processes_end_with_a_batch_that_is_killed(manifest, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "colmap_inertial", "batch", str(manifest), str(out)]
    batch = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    eventually(lambda: processes_of(out))
    batch.kill()
    batch.wait()
    eventually(lambda: not processes_of(out))


def test_a_folder_of_something_else_is_left_alone(manifest, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"precious")
    with pytest.raises(OutputExistsError, match="not the folder of a batch"):
        run_batch(manifest, tmp_path / "photos")
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["a.jpg"]


def test_dense_captures_want_a_gpu_where_colmap_uses_one(subtests):
    for cuda in (False, True):
        with subtests.test(cuda=cuda), pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.setattr(pycolmap, "has_cuda", cuda)
            assert needs_gpu(ReconstructOptions(dense=True)) == cuda
            assert not needs_gpu(ReconstructOptions())


def test_without_dask_the_extra_is_named(monkeypatch, manifest, tmp_path):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"extra `cluster`: pip install 'dask\[distributed\]>="):
        run_batch(manifest, tmp_path / "out", batch=BatchOptions(scheduler="tcp://127.0.0.1:1"))


def dask(*args: object) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "dask", *map(str, args)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def start_worker(address: str, scratch: Path) -> subprocess.Popen[bytes]:
    """A worker of one thread, with a scratch folder of its own."""
    flags = ("--nthreads", 1, "--no-nanny", "--no-dashboard", "--name", scratch.name, "--local-directory", scratch)
    return dask("worker", address, *flags)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A Dask scheduler and two workers of one thread each: (address, worker processes). The last test kills one."""
    distributed = pytest.importorskip("distributed", reason="dask[distributed] is not installed")
    root = tmp_path_factory.mktemp("cluster")
    described = root / "scheduler.json"
    running = [dask("scheduler", "--host", "127.0.0.1", "--port", 0, "--no-dashboard", "--scheduler-file", described)]
    eventually(lambda: described.is_file() and described.read_text().endswith("}"))
    address = json.loads(described.read_text())["address"]
    running += [start_worker(address, root / name) for name in ("one", "two")]
    with distributed.Client(address) as client:
        client.wait_for_workers(2, timeout=60)
    yield address, running[1:]
    for process in running:
        process.kill()
        process.wait()


def tables_of(database: Path) -> dict[str, list[tuple[object, ...]]]:
    with contextlib.closing(sqlite3.connect(f"file:{database}?immutable=1", uri=True)) as opened:
        names = [row[0] for row in opened.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {name: opened.execute(f"SELECT * FROM {name}").fetchall() for name in names if "sqlite" not in name}


def test_one_capture_on_a_cluster_is_that_of_one_machine(capture, cluster, tmp_path, monkeypatch):
    """A worker is killed at its work, and the run that they work for is stopped and begun again."""
    images, (address, _) = capture[0] / "frames", cluster
    names = sorted(path.name for path in images.iterdir())[:8]
    options = MappingOptions(
        max_num_features=300, first_octave=0, overlap=3, pairing="sequential", refine_intrinsics=False
    )
    monkeypatch.setattr(feature_chunks, "SIZES", ChunkSizes(pairs=11, least_pairs=1))
    monkeypatch.setattr(
        submaps, "SIZES", dataclasses.replace(submaps.SIZES, least=2, shortest=6, longest=6, shared=0.5)
    )
    asked, run = [], Cluster.run

    def ask(self, chunks, told):
        asked.append(len(chunks))
        return run(self, chunks, told)

    monkeypatch.setattr(Cluster, "run", ask)

    def reconstruct_in(folder: Path, told=silent):
        folder.mkdir(exist_ok=True)
        context, database = RunContext(scratch=folder, num_threads=1, progress=told), folder / "database.db"
        database.unlink(missing_ok=True)
        if not (folder / "features.db").exists():
            cameras = dict.fromkeys(names, load_capture(capture[0]).camera)
            extract_features(images, cameras, database, options, context=context)
            database.rename(folder / "features.db")
        shutil.copyfile(folder / "features.db", database)
        match_pairs(database, image_pairs(names, options), context)
        record = map_images(database, images, folder / "sparse", options, context, in_time=names)
        models = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.bin")}
        return record.parts, tables_of(database), models

    def stop(at, stage, done, total):
        if stage == at and 0 < done < total:
            raise KeyboardInterrupt

    parts, tables, models = reconstruct_in(tmp_path / "alone")
    assert parts >= 2 and len(tables) >= 10 and models and asked == []
    third = start_worker(address, tmp_path / "three")

    def kill_at_work():
        eventually(psutil.Process(third.pid).children)
        third.kill()

    killer = threading.Thread(target=kill_at_work)
    try:
        with using_workers(scheduler=address):
            client = RunContext().executor.client
            client.wait_for_workers(3)
            monkeypatch.setattr(client, "submit", partial(client.submit, workers="three", allow_other_workers=True))
            killer.start()
            for at in ("features", "matches"):
                with pytest.raises(KeyboardInterrupt):
                    reconstruct_in(tmp_path / "shared", partial(stop, at))
            features, rest, pairs = asked
            found = reconstruct_in(tmp_path / "shared")
    finally:
        killer.join()
        third.kill()
    assert third.wait() == -signal.SIGKILL
    assert found == (parts, tables, models)
    # finished chunks are kept as long as the step of all is not
    assert features >= 2 and rest == features - 1 and asked[3:] == [pairs - 1, parts]
    assert {path.name for path in (tmp_path / "shared").iterdir()} == {"database.db", "features.db", "sparse"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Elsewhere(Processes):
    """Processes that stand for other machines."""

    remote: ClassVar[bool] = True


def test_features_that_others_find_are_those_that_are_found_here(tmp_path, monkeypatch):
    """With an image that cannot be read, one of another size, and a mask that has changed since a run was killed."""
    images, masks, noise = tmp_path / "images", tmp_path / "masks", np.random.default_rng(0)
    images.mkdir()
    masks.mkdir()
    for number in range(5):
        picture = cv2.GaussianBlur(noise.integers(0, 255, (96, 128 if number != 3 else 100), np.uint8), (0, 0), 1.5)
        cv2.imwrite(str(images / f"{number}.png"), picture)
        cv2.imwrite(str(masks / f"{number}.png.png"), np.full_like(picture, 255))
    (images / "1.png").write_bytes(b"no picture")
    options = MappingOptions(max_num_features=100, first_octave=0)
    here = RunContext(scratch=tmp_path, num_threads=1, colmap=ColmapSettings((f"ImageReader.mask_path={masks}",)))
    heard = []
    there = dataclasses.replace(here, executor=Elsewhere(number=1), progress=lambda *told: heard.append(told))

    def extract(context, stages=()):
        database = tmp_path / "features.db"
        database.unlink(missing_ok=True)
        cameras = {path.name: None for path in images.iterdir()}
        extract_features(images, cameras, database, options, context=context, keypoint_stages=stages)
        return tables_of(database)

    def be_killed(keypoints):
        raise KeyboardInterrupt

    found = extract(here)
    assert [row[1] for row in found["images"]] == ["0.png", "2.png", "4.png"]
    with pytest.raises(KeyboardInterrupt):
        extract(there, [be_killed])
    assert heard[0] == ("features", 0, 5) and heard[-1] == ("features", 5, 5)
    assert heard == sorted(heard) and tables_of(tmp_path / "features.db") == found
    cv2.imwrite(str(masks / "2.png.png"), np.zeros((96, 128), np.uint8))
    fewer = extract(there)
    assert fewer == extract(here) != found
    assert not (tmp_path / "chunks").exists()
    room = 5 * 100 * 500  # as much as the database takes at most
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1.5e6 + room))
    extract(here)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1.9 * room))
    with pytest.raises(OutputError, match=rf"may need {2 * room / 1e6:.0f} MB"):
        extract(there)
    assert not (tmp_path / "features.db").exists()


def a_part_without_matches(folder: Path) -> Chunk:
    folder.mkdir()
    pycolmap.Database.open(str(folder / "part.db")).close()
    return Chunk.of(
        MapPart(options={"random_seed": 0}, orientations=ImageOrientations()),
        name="a part",
        folder=folder,
        images=folder,
        size=1,
        reads=0,
    )


def test_a_chunk_of_which_nothing_comes_is_done(cluster, tmp_path):
    part, told = a_part_without_matches(tmp_path / "0"), []
    assert not part.gpu
    with using_workers(scheduler=cluster[0]):
        assert list(RunContext().executor.run([part], told.append)) == [0]
    assert told == [1] and list(tmp_path.iterdir()) == [part.made] and list(part.made.iterdir()) == []


def test_a_chunk_that_a_run_has_begun_anew_is_given_up(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="dask[distributed] is not installed")
    worker = SimpleNamespace(address="tcp://a:1", local_directory=str(tmp_path))
    monkeypatch.setattr(distributed, "get_worker", lambda: worker)
    part = a_part_without_matches(tmp_path / "0")
    (part.folder / "wanted").write_text("by the run that goes on")
    with pytest.raises(MappingError, match="cancelled"):
        do_for_another(part, describe_versions(), "by the run that was killed")
    assert do_for_another(part, describe_versions(), "by the run that goes on") == {}
    killed = [sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"]
    with monkeypatch.context() as patch:
        patch.setattr(workers, "start_process", lambda *_, **__: subprocess.Popen(killed, stdin=subprocess.PIPE))
        with pytest.raises(MappingError, match=r"signal 9\); if memory ran out, give workers more of it"):
            do_for_another(part, describe_versions(), "by the run that goes on")
    shutil.rmtree(part.folder)
    with pytest.raises(InertialError, match=r"worker tcp://a:1 cannot access .*0: .* that all machines share"):
        do_for_another(part, describe_versions(), "by the run that goes on")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_chunks_on_cuda_ask_for_a_gpu(tmp_path, monkeypatch, caplog, device):
    distributed = pytest.importorskip("distributed", reason="dask[distributed] is not installed")
    asked = []

    def wait(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(distributed, "as_completed", wait)
    client = SimpleNamespace(
        loop=None,
        cancel=lambda _: None,
        scheduler_info=lambda **_: {"workers": {"w": {"resources": {}}}},
        submit=lambda *_, resources, **__: asked.append(resources),
    )
    executor = Cluster(address="tcp://a:1", client=client)
    database, image = tmp_path / "features.db", tmp_path / "0.png"
    cv2.imwrite(str(image), np.zeros((8, 8), np.uint8))
    pycolmap.Database.open(str(database)).close()
    pycolmap.import_images(str(database), str(tmp_path))
    work = FindFeatures(names=("0.png",), reader={}, extraction={}, device=device, seed=0)
    with pytest.raises(KeyboardInterrupt):
        find_elsewhere([work], database, tmp_path, tmp_path / "chunks", executor, asked.append)
    assert asked == [{"GPU": 1} if device == "cuda" else None]
    assert ("features and matches wait for one" in caplog.text) == (device == "cuda")


def test_what_keeps_a_cluster_from_helping_is_said_before_the_work(cluster, tmp_path, monkeypatch, capsys):
    here = describe_versions()

    def require(answers):
        Cluster(address="tcp://a:1", client=SimpleNamespace(run=lambda *_, **__: answers)).require(tmp_path)

    with pytest.raises(InertialError, match=r"tcp://a:1 has no worker: start one \(dask worker tcp://a:1\)"):
        require({})
    with pytest.raises(InertialError, match=r"worker w cannot use colmap-inertial .* No module named"):
        require({"w": ModuleNotFoundError("No module named 'colmap_inertial'")})
    with pytest.raises(InertialError, match=r"worker w cannot access .* path that all machines share"):
        require({"w": (here, "")})
    with using_workers(scheduler=cluster[0]):
        executor = RunContext().executor
        executor.require(tmp_path)
        monkeypatch.setattr("colmap_inertial.colmap.workers.describe_versions", lambda: "pycolmap 9")
        with pytest.raises(
            InertialError, match=rf"worker tcp://.* has {here}; here is pycolmap 9: install the same there"
        ):
            executor.require(tmp_path)
        with pytest.raises(InertialError, match="works on this machine only"):
            RunContext.of(ReconstructOptions(colmap_executable=Path("colmap")))
    with pytest.raises(InertialError, match=r"tls://127.0.0.1:1 needs certificates: .*distributed\.comm\.tls"):
        connect("tls://127.0.0.1:1", "")
    assert list(tmp_path.iterdir()) == []
    for flags, said in (
        (["--workers", "2"], "with --scheduler, the cluster has its own"),
        ([], "no Dask scheduler answers"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main(["reconstruct", "capture", str(tmp_path / "out"), "--scheduler", "nonsense://a:1", *flags])
        assert said in " ".join(capsys.readouterr().err.split())


def test_a_cluster_stops_when_the_batch_does(capture, cluster, tmp_path):
    address, _ = cluster
    out = tmp_path / "out"

    def watch(status: CaptureStatus) -> None:
        if status.state == "running" and status.stage:
            raise KeyboardInterrupt

    entries = [BatchCapture(name=name, path=capture[0], options=TINY) for name in ("hall", "yard")]
    with pytest.raises(KeyboardInterrupt):
        run_batch(entries, out, batch=BatchOptions(scheduler=address), watch=watch)
    eventually(lambda: not processes_of(out))
    assert {row["state"] for row in table(out).values()} == {"interrupted"}


@pytest.mark.slow
def test_a_cluster_loses_a_worker_and_no_capture(capture, cluster, tmp_path):
    path, alone = capture
    address, workers = cluster
    broken = tiny_capture(tmp_path / "broken", frames=FRAMES)
    sorted((broken / "frames").iterdir())[5].write_bytes(b"no picture")
    entries = [BatchCapture(name=name, path=of, options=TINY) for name, of in (("broken", broken), ("hall", path))]
    done, killed, out = [], [], tmp_path / "out"

    def watch(status: CaptureStatus) -> None:
        done.extend([status] * status.finished)
        if done and not killed and status.state == "running":
            killed.extend(worker for worker in workers if psutil.Process(worker.pid).children())
            for worker in killed:  # the other one has nothing left to do
                worker.kill()
                worker.wait()

    result = run_batch(entries, out, batch=BatchOptions(scheduler=address), watch=watch)
    assert [worker.returncode for worker in killed] == [-signal.SIGKILL]
    assert [(c.name, c.state) for c in result.captures] == [("broken", "failed"), ("hall", "done")]
    assert sorted(table(out)) == ["broken", "hall"]
    failure, finished = result.captures
    assert failure.exit_code == 2
    assert sorted((broken / "frames").iterdir())[5].name in failure.error
    assert result.exit_code() == 1
    assert finished.attempts == 2
    assert model_bytes(out / "hall") == alone


def test_a_scheduler_that_does_not_answer_is_said(monkeypatch, manifest, tmp_path):
    pytest.importorskip("distributed", reason="dask[distributed] is not installed")
    with pytest.raises(InertialError, match="no Dask scheduler answers"):
        run_batch(manifest, tmp_path / "out", batch=BatchOptions(scheduler="nonsense://127.0.0.1:1"))
    assert threading.active_count() < 20


def test_a_worker_that_does_not_see_the_files_says_so(tmp_path):
    from colmap_inertial.tools.batch.task import CaptureTask, run_capture

    gone = tmp_path / "gone"
    task = CaptureTask(
        name="a", capture=gone, out=gone, config=gone, status=gone, log=gone, run_file=gone, run="", attempts=1
    )
    status = run_capture(task)
    assert status.state == "failed"
    assert "the same files" in status.error


def test_what_ran_out_is_said_in_a_sentence(tmp_path, monkeypatch):
    def refuse(task):
        future = Future()
        future.set_exception(OSError(errno.EMFILE, "Too many open files"))
        return future

    pool = contextlib.nullcontext(refuse)
    monkeypatch.setattr("colmap_inertial.tools.batch.local_pool", lambda shares: pool)
    (tmp_path / "m.toml").write_text('[[capture]]\npath = "none"\n')
    (end,) = run_batch(tmp_path / "m.toml", tmp_path / "out").captures
    said = "no worker could finish it: too many files are open at a time: raise the limit (ulimit -n) and start again"
    assert (end.state, end.error) == ("failed", said)


def test_an_unreadable_manifest_is_named(tmp_path):
    with pytest.raises(FormatError, match="no such file"):
        read_manifest(tmp_path / "none.toml")


def test_what_a_killed_batch_left_half_written_is_removed(tmp_path):
    (tmp_path / "m.toml").write_text('[[capture]]\npath = "none"\n')
    (tmp_path / "out" / "status").mkdir(parents=True)
    left = [tmp_path / "out" / ".summary.csv.1-0a1b2c3d.tmp", tmp_path / "out" / "status" / ".none.json.1-0a1b2c3d.tmp"]
    for path in left:
        path.touch()
    run_batch(tmp_path / "m.toml", tmp_path / "out")
    assert not any(path.exists() for path in left)
