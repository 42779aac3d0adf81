"""Whole runs against plain COLMAP: processor time, registered images, camera error, loops.

    python -m scripts.benchmarks.whole FOLDER [--euroc DATASET] [--walk FRAMES] [--loop FRAMES] [--laps LAPS] [--back]
        [--repeated SCENES] [--drawn] [--long FRAMES ...] [--streets] [--density D] [--seeds SEED ...] [--workers N]
        [--json FILE] [--mappers {incremental,one,global,bare} ...]

FOLDER takes captures and reconstructions. ``--euroc``: the 100 keyframes of V1_01_easy (DATASET has ``keyframes/``,
``mav0/`` and ``gt/``), bare COLMAP matching every pair. ``--walk``: a simulated walk around a room back to its start
(``walk_scenes.py``), bare COLMAP matching sequentially without loop detection. Both find the same features (COLMAP's
defaults), in processes of their own, one thread each; processor time is that of the whole process.

Camera error: rms distance of the camera centres from the truth after a similarity. Loop error: of frames at the end,
how far they lie from the frame at the start that is truly nearest, against the truth (rms). The loop's offset is the
part of it that these frames have in common, by which the ends do not meet; what is left are the single frames' own
errors, as large between one frame and the next (neighbours' error) and beyond what closing a loop can mend.

``--loop``: the loop's error of a walk around a room, with its loops closed, and of the same features matched
sequentially with a linear overlap (``quadratic_overlap`` off, no loops), both mapped alike; features are synthesised
(``walk_features.py``). ``--laps``: of the walk; ``--back``: who walks turns round halfway, so that loops' ends see the
same from other sides, 40 degrees apart. Of the loops, how many are false, as below.

``--repeated``: walks of 160 frames past posters that hang many times (``SCENES`` below, a seed each). A pair that
closes a loop is false where less than half of its matches join what is the same place in truth (within 15 cm). A frame
that comes back to where an earlier one was (half a metre, 20 degrees) is missed where no true loop is within four
frames of it. Features are synthesised, so that copies look the same as they can; ``--drawn``: found in drawn pictures.

``--long``: what mapping a walk of so many frames around a room takes, which is as large as the walk is long: processor
time, memory beyond that of what is loaded, error. ``incremental`` is ours, in parts where it is long; ``one`` the same
in one go; ``global`` COLMAP's; ``bare`` COLMAP's incremental one with its own settings, in one go. Features are
synthesised, 132 a frame for each 1 of ``--density``. Parts are mapped by ``--workers`` processes; the longest chain is
this process's own time and that of as many parts, of equal length, as one worker maps: the time on as many idle
processors. Memory is that of this process. ``--streets``: these walks go through a grid of streets, half of whose
fronts are copies; of the loops, how many are false.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml

from colmap_inertial.colmap.chunks import Processes
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features.extraction import extract_features
from colmap_inertial.colmap.mapping.mapper import map_images
from colmap_inertial.colmap.matching.pairing import match_capture
from colmap_inertial.colmap.views.gyro_orientations import ImageOrientations
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import matrix_from_quat, quat_rotate, slerp
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.files import read_json, read_record, write_json, write_record
from colmap_inertial.io.frames import read_frames
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import find_models, read_model
from colmap_inertial.run.steps.session import keep_colmap_quiet
from scripts.common.bench_report import write_report
from scripts.common.walk_features import write_features
from scripts.common.walk_scenes import Scene, Walk, places_m, world_of, write_walk
from scripts.studies.check_euroc import similarity

if TYPE_CHECKING:
    import pycolmap

Figures = dict[str, float]
#: Of a walk, frames at the start and at the end between which the loop's error is measured.
ENDS = 0.06
#: What walks of ``--repeated`` go past, by their seeds; further ones begin again.
SCENES: tuple[Scene, ...] = (
    *("mixed", "mixed", "mixed", "copies", "copies", "copies", "tiled", "corridor", "corridor", "tiled corridor"),
)
#: Neighbours that are matched; farther apart than twice as many frames, a pair is a loop.
OVERLAP = 4
#: Likewise for the loop's error.
LOOP_OVERLAP = 5
#: Matches join the same place within this; a frame is back within this and looking this way, or a loop is near it.
SAME_M, BACK_M, BACK_DEG, BESIDE = 0.15, 0.5, 20.0, 4
#: Synthesised features: for the loop's error and long walks, and for repeated texture.
LOOP_DENSITY, REPEATED_DENSITY = 1.2, 1.5
#: Of long walks.
PACE_M_S = 0.8
#: Ours, ours in one go, COLMAP's global one as we call it, and COLMAP's incremental one with its own settings.
MAPPERS = ("incremental", "one", "global", "bare")


def bare(capture: Path, out: Path, *, sequential: bool) -> None:
    """COLMAP by itself: what the other process of this script does."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    described = load_capture(capture)
    camera, images = described.camera, described.frames.folder
    shutil.rmtree(out, ignore_errors=True)
    (out / "sparse").mkdir(parents=True)
    database = str(out / "database.db")
    reader = pycolmap.ImageReaderOptions(camera_model=camera.model, camera_params=",".join(map(repr, camera.params)))
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.sift.max_num_features = MappingOptions().max_num_features
    for options in (extraction, matching):
        options.use_gpu, options.num_threads = False, 1
    pycolmap.set_random_seed(0)
    shared = {"camera_mode": pycolmap.CameraMode.SINGLE, "reader_options": reader, "device": pycolmap.Device.cpu}
    pycolmap.extract_features(database, str(images), extraction_options=extraction, **shared)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    match = pycolmap.match_sequential if sequential else pycolmap.match_exhaustive
    match(database, matching_options=matching, verification_options=verification, device=pycolmap.Device.cpu)
    pycolmap.incremental_mapping(database, str(images), str(out / "sparse"), options=bare_pipeline())


def bare_pipeline() -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's own settings, one thread, the camera known."""
    import pycolmap

    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads, pipeline.random_seed = 1, 0
    pipeline.ba_refine_focal_length = pipeline.ba_refine_extra_params = False
    pipeline.mapper.abs_pose_refine_focal_length = pipeline.mapper.abs_pose_refine_extra_params = False
    return pipeline


def processor_s(command: list[object]) -> float:
    """Processor time of a process."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(list(map(str, command)), check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def both(capture: Path, out: Path, truth: dict[str, Array], *, sequential: bool) -> dict[str, Figures]:
    """Figures of bare COLMAP and of ours."""
    own = out / "ours"
    shutil.rmtree(own, ignore_errors=True)
    kind = ["--bare-sequential"] if sequential else ["--bare-exhaustive"]
    seconds = {
        "bare": processor_s([sys.executable, "-m", "scripts.benchmarks.whole", out / "bare", *kind, capture]),
        "ours": processor_s(
            [sys.executable, "-m", "colmap_inertial", "reconstruct", capture, own, "--deterministic"]
            + (["--mapping.pairing", "sequential"] if sequential else [])
        ),
    }
    found = {}
    for name, models in (("bare", out / "bare" / "sparse"), ("ours", own / "colmap" / "sparse")):
        found[name] = {"processor_s": seconds[name], **judged(models, truth, walk=sequential)}
    found["ours"] |= {"ratio": seconds["ours"] / seconds["bare"], **read_json(own / "result.json")["matching"]}
    return found


def judged(models: Path, truth: dict[str, Array], *, walk: bool) -> Figures:
    """Registered images and errors of the largest model."""
    read = [read_model(folder) for folder in find_models(models).values()]
    model = max(read, key=lambda one: int(one.num_reg_images()))
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    centres = np.array([image.projection_center() for image in images if image.name in truth])
    true = np.array([truth[image.name] for image in images if image.name in truth])
    scale, rotation, translation = similarity(centres, true)
    placed = scale * centres @ rotation.T + translation
    figures: Figures = {"models": len(read), "registered": len(images)}
    figures["camera_error_m"] = float(np.sqrt(np.mean(np.sum((placed - true) ** 2, axis=1))))
    if walk:
        few = max(2, round(ENDS * len(true)))
        nearest = [int(np.argmin(np.linalg.norm(true[:few] - at, axis=1))) for at in true[-few:]]
        off = (placed[-few:] - placed[nearest]) - (true[-few:] - true[nearest])
        figures["loop_error_m"] = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
        figures["loop_offset_m"] = float(np.linalg.norm(off.mean(axis=0)))
        steps = np.diff(placed, axis=0) - np.diff(true, axis=0)
        figures["neighbours_error_m"] = float(np.sqrt(np.mean(np.sum(steps**2, axis=1))))
    return figures


def euroc_capture(dataset: Path, folder: Path) -> tuple[Path, dict[str, Array]]:
    """The keyframes of the left camera as a capture, and where they truly were."""
    names = sorted(path.name for path in (dataset / "keyframes").glob("*_0.jpg"))
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    for name in names:
        shutil.copyfile(dataset / "keyframes" / name, folder / "frames" / name)
    rows = [f"{name},{name.split('_')[0]}" for name in names]
    (folder / "frames.csv").write_text("\n".join(["name,t_ns", *rows]) + "\n")
    sheet = dataset.resolve() / "mav0" / "cam0" / "sensor.yaml"
    lines = [
        "[images]",
        'folder = "frames"',
        'times = "frames.csv"',
        "[timing]",
        "readout_s = 0",
        "shared_clock = true",
    ]
    lines += ["[camera]", f'sensor_yaml = "{sheet}"', "[imu]", f'path = "{dataset.resolve() / "mav0" / "imu0"}"']
    (folder / "capture.toml").write_text("\n".join(lines) + "\n")
    rows_ns = np.loadtxt(dataset / "gt" / "V1_01_easy.csv", delimiter=",", skiprows=1, usecols=0, dtype=np.int64)
    values = np.loadtxt(dataset / "gt" / "V1_01_easy.csv", delimiter=",", skiprows=1)
    t_s = (rows_ns - rows_ns[0]) * 1e-9
    query_s = np.array([(int(name.split("_")[0]) - rows_ns[0]) * 1e-9 for name in names])
    cam = yaml.safe_load(sheet.read_text().replace("%YAML:1.0", ""))["T_BS"]["data"]
    cam_in_imu = np.array(cam).reshape(4, 4)[:3, 3]
    centre = np.stack([np.interp(query_s, t_s, values[:, 1 + k]) for k in range(3)], axis=1)
    centre += quat_rotate(slerp(t_s, values[:, [5, 6, 7, 4]], query_s), cam_in_imu)
    inside = (query_s >= 0) & (query_s <= t_s[-1])
    truth = {name: at for name, at, known in zip(names, centre, inside, strict=True) if known}
    return folder / "capture.toml", truth


def true_centres(folder: Path) -> dict[str, Array]:
    truth = read_json(folder / "truth.json")
    return dict(zip(truth["names"], np.array(truth["cam_in_world_m"]), strict=True))


def true_poses(folder: Path) -> tuple[Array, Array]:
    """(N, 3) centres of the frames' cameras, (N, 3, 3) rotations from them to the world."""
    truth = read_json(folder / "truth.json")
    return np.array(truth["cam_in_world_m"]), matrix_from_quat(np.array(truth["world_from_cam_xyzw"]))


def recorded(folder: Path) -> Recording:
    """A capture, read."""
    capture = load_capture(folder)
    timing, _ = read_frames(capture)
    return Recording.of(capture, read_capture_imu(capture), timing, capture.calibration)


def false_loops(walk: Walk, folder: Path) -> Figures:
    """Of the loops that matching closes, how many are false, and what it misses."""
    keep_colmap_quiet()
    write_walk(walk, folder)
    recording, context = recorded(folder), RunContext(scratch=folder, num_threads=1)
    camera, names = recording.capture.camera, recording.timing.names
    options = MappingOptions(pairing="sequential", overlap=OVERLAP)
    features, database = folder / "features.db", folder / "database.db"
    if not features.is_file() and walk.drawn:
        extract_features(folder / "frames", dict.fromkeys(names, camera), features, options, context=context)
    elif not features.is_file():
        write_features(walk, names, features, density=REPEATED_DENSITY)
    for left in folder.glob(f"{database.name}*"):
        left.unlink()
    begun_s = time.process_time()
    record, _ = match_capture(features, database, recording, camera, options, context)
    processor_s = time.process_time() - begun_s
    centre, turned = true_poses(folder)
    right = {pair: share >= 0.5 for pair, share in true_shares(walk, names, centre, turned, database).items()}
    loops = {pair: true for pair, true in right.items() if pair[1] - pair[0] > 2 * OVERLAP}
    apart_m = np.linalg.norm(centre[:, None] - centre, axis=2)
    apart_deg = np.degrees(np.arccos(np.clip(turned[..., 2] @ turned[..., 2].T, -1, 1)))
    later = np.arange(len(names)) - np.arange(len(names))[:, None] > 2 * OVERLAP
    back = np.flatnonzero(((apart_m < BACK_M) & (apart_deg < BACK_DEG) & later).any(axis=0))
    closing = np.array([pair[1] for pair, true in loops.items() if true])
    found = np.array([bool((np.abs(closing - j) <= BESIDE).any()) for j in back], dtype=np.bool_)
    return {
        "processor_s": processor_s,
        "candidates": record.loop_candidates,
        "refused": record.loops_refused,
        "closed": len(loops),
        "false": sum(not true for true in loops.values()),
        "false_neighbours": sum(not true for pair, true in right.items() if pair not in loops),
        "back": len(back),
        "missed": int((~found).sum()),
        "heading": record.heading_sigma_deg if record.heading_sigma_deg is not None else float("nan"),
    }


def true_shares(
    walk: Walk, names: Sequence[str], centre: Array, turned: Array, database: Path, apart: int = 0
) -> dict[tuple[int, int], float]:
    """Of verified pairs of frames so far apart, the share of matches that join what is the same place in truth."""
    import pycolmap

    world, place = world_of(walk), {name: i for i, name in enumerate(names)}
    shares = {}
    with pycolmap.Database.open(str(database)) as opened:
        images = {image.name: image for image in opened.read_all_images()}
        camera = opened.read_all_cameras()[0]
        for pair in verified_pairs(database):
            both = sorted(pair)
            if place[both[1]] - place[both[0]] < apart:
                continue
            matches = opened.read_two_view_geometry(*(images[name].image_id for name in both)).inlier_matches
            some = np.array(matches)[np.linspace(0, len(matches) - 1, min(60, len(matches))).astype(int)]
            met = []
            for name, mine in zip(both, some.T, strict=True):
                xy_px = np.array(opened.read_keypoints(images[name].image_id))[mine, :2].astype(np.float64)
                seen = np.asarray(camera.cam_from_img(xy_px))[:, :2]
                rays = np.column_stack([seen, np.ones(len(seen))]) @ turned[place[name]].T
                met.append(places_m(world, np.tile(centre[place[name]], (len(rays), 1)), rays))
            off_m = np.linalg.norm(met[0] - met[1], axis=1)
            shares[place[both[0]], place[both[1]]] = float(np.mean(off_m < SAME_M))
    return shares


def matched_in_line(features: Path, database: Path, overlap: int) -> Figures:
    """Match each frame with the next ones, and no others, in a copy of the features."""
    import pycolmap

    shutil.copyfile(features, database)
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads = False, 1
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pairing = pycolmap.SequentialPairingOptions(overlap=overlap, quadratic_overlap=False)
    pycolmap.match_sequential(
        str(database),
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )
    return {"loops_closed": 0, "verified": len(verified_pairs(database))}


def loop_errors(walk: Walk, folder: Path) -> dict[str, Figures]:
    """The loop's error where it is closed, and where it is not."""
    keep_colmap_quiet()
    write_walk(walk, folder)
    recording, context = recorded(folder), RunContext(scratch=folder, num_threads=1)
    camera, names = recording.capture.camera, recording.timing.names
    options = MappingOptions(pairing="sequential", overlap=LOOP_OVERLAP)
    truth, features = true_centres(folder), folder / "features.db"
    if not features.is_file():
        write_features(walk, names, features, density=LOOP_DENSITY)
    found: dict[str, Figures] = {}
    for kind in ("open", "closed"):
        database, models = folder / f"{kind}.db", folder / kind
        shutil.rmtree(models, ignore_errors=True)
        for left in folder.glob(f"{database.name}*"):
            left.unlink()
        begun_s, orientations = time.process_time(), ImageOrientations()
        if kind == "open":
            told = matched_in_line(features, database, options.overlap)
        else:
            record, orientations = match_capture(features, database, recording, camera, options, context)
            told = {"loops_closed": record.loops_closed, "verified": record.verified}
            shares = true_shares(walk, names, *true_poses(folder), database)
            told["false"] = sum(share < 0.5 for (i, j), share in shares.items() if j - i > 2 * LOOP_OVERLAP)
        matched_s = time.process_time()
        map_images(
            database,
            folder / "frames",
            models,
            dataclasses.replace(options, refine_intrinsics=False),
            context=context,
            in_time=names,
            orientations=orientations,
        )
        told |= {"matching_s": matched_s - begun_s, "mapping_s": time.process_time() - matched_s}
        told["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        found[kind] = told | judged(models, truth, walk=True)
        print(json.dumps({kind: found[kind]}), flush=True)
    for measure in ("error", "offset"):
        name = f"loop_{measure}_m"
        found["closed"][f"{measure}_of_open"] = found["closed"][name] / found["open"][name]
    return found


def long_walk(walk: Walk, density: float, folder: Path, mappers: Sequence[str], workers: int) -> dict[str, Figures]:
    """What matching and each mapper take for a walk: processor time and memory."""
    keep_colmap_quiet()
    write_walk(walk, folder)
    write_json(folder / "walk.json", dataclasses.asdict(walk))
    if not (folder / "features.db").is_file():
        write_features(walk, recorded(folder).timing.names, folder / "features.db", density=density)
    found: dict[str, Figures] = {}
    for step in ("matching", *mappers):
        told = subprocess.run(
            [sys.executable, "-m", "scripts.benchmarks.whole", "--step", step, "--workers", str(workers), folder],
            check=True,
            stdout=subprocess.PIPE,
            text=True,
        ).stdout
        found[step] = json.loads(told.splitlines()[-1])
        print(json.dumps({step: found[step]}), flush=True)
    return found


def match_walk(folder: Path) -> Figures:
    """Match a walk whose features are there: what another process of this script does."""
    keep_colmap_quiet()
    recording, context = recorded(folder), RunContext(scratch=folder, num_threads=1)
    for left in folder.glob("database.db*"):
        left.unlink()
    before_mib, begun_s = peak_mib(), time.process_time()
    record, orientations = match_capture(
        folder / "features.db",
        folder / "database.db",
        recording,
        recording.capture.camera,
        MappingOptions(pairing="sequential"),
        context,
    )
    write_record(folder / "orientations.json", orientations)
    return {
        "processor_s": time.process_time() - begun_s,
        "mib_a_frame": (peak_mib() - before_mib) / record.images,
        "compared": record.loops_compared,
        "verified": record.verified,
        "loops_closed": record.loops_closed,
        **judged_loops(folder, recording.timing.names),
    }


def judged_loops(folder: Path, names: Sequence[str]) -> Figures:
    """Of streets, how many pairs are of frames more than five seconds apart, and how many of these are false."""
    walk = Walk(**read_json(folder / "walk.json"))
    if walk.scene != "streets":
        return {}
    shares = true_shares(walk, names, *true_poses(folder), folder / "database.db", apart=5 * round(walk.frame_rate_hz))
    return {"loops": len(shares), "false": sum(share < 0.5 for share in shares.values())}


def peak_mib() -> float:
    """The most memory that this process had; what ``getrusage`` says counts its parent's, too."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def map_by(mapper: str, folder: Path, workers: int) -> Figures:
    """Map a walk that is matched: what another process of this script does."""
    import pycolmap

    keep_colmap_quiet()
    models, truth = folder / mapper, true_centres(folder)
    shutil.rmtree(models, ignore_errors=True)
    before_mib, begun_s = peak_mib(), time.process_time()
    path_m = np.linalg.norm(np.diff(list(truth.values()), axis=0), axis=1).sum()
    told: Figures = {"path_m": float(path_m)}
    if mapper == "bare":
        models.mkdir()
        pycolmap.incremental_mapping(
            str(folder / "database.db"), str(folder / "frames"), str(models), options=bare_pipeline()
        )
    else:
        record = map_images(
            folder / "database.db",
            folder / "frames",
            models,
            MappingOptions(mapper="global" if mapper == "global" else "incremental", refine_intrinsics=False),
            context=RunContext(scratch=folder, num_threads=1, executor=Processes(number=workers)),
            in_time=[] if mapper == "one" else list(truth),
            orientations=read_record(folder / "orientations.json", ImageOrientations),
        )
        told |= {"parts": record.parts, "ends_joined": sum(met.joined for met in record.ends)}
    own_s, children = time.process_time() - begun_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    parts_s = children.ru_utime + children.ru_stime
    if told.get("parts", 1) > 1:
        each_s = parts_s / told["parts"]
        told |= {"parts_s": parts_s, "longest_chain_s": own_s + each_s * math.ceil(told["parts"] / workers)}
    processor_s = own_s + parts_s
    mib = peak_mib() - before_mib
    each = {"ms_a_frame": 1e3 * processor_s / len(truth), "mib_a_frame": mib / len(truth)}
    largest = max((read_model(one) for one in find_models(models).values()), key=lambda one: int(one.num_reg_images()))
    told |= {"observations": int(largest.compute_num_observations())}
    return {"processor_s": processor_s, "mib": mib, **each, **told, **judged(models, truth, walk=True)}


def verified_pairs(database: Path) -> list[tuple[str, str]]:
    """Names of all pairs whose matches COLMAP verified."""
    import pycolmap

    with pycolmap.Database.open(str(database)) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        pairs, counts = opened.read_two_view_geometry_num_inliers()
    found = [pycolmap.pair_id_to_image_pair(pair) for pair, count in zip(pairs, counts, strict=True) if count]
    return [(names[a], names[b]) for a, b in found]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--euroc", type=Path, help="folder of the data set")
    parser.add_argument("--walk", type=int, default=0, help="frames")
    parser.add_argument("--loop", type=int, default=0, help="frames")
    parser.add_argument("--laps", type=float, default=1.08, help="of --loop")
    parser.add_argument("--back", action="store_true", help="turn round halfway in --loop")
    parser.add_argument("--repeated", type=int, default=0, help="scenes")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene")
    parser.add_argument("--drawn", action="store_true", help="find the scenes' features in drawn pictures")
    parser.add_argument("--long", type=int, nargs="*", default=[], help="frames")
    parser.add_argument("--streets", action="store_true", help="long walks go through streets")
    parser.add_argument("--density", type=float, default=LOOP_DENSITY, help="of long walks' features")
    parser.add_argument("--seeds", type=int, nargs="*", default=[100], help="of long walks")
    parser.add_argument("--json", type=Path)
    parser.add_argument(
        "--mappers", nargs="*", choices=MAPPERS, default=["incremental", "global"], help="of long walks"
    )
    parser.add_argument("--workers", type=int, default=4, help="processes that map the parts of long walks")
    parser.add_argument("--step", choices=("matching", *MAPPERS), help=argparse.SUPPRESS)
    parser.add_argument("--bare-sequential", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--bare-exhaustive", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.bare_sequential or args.bare_exhaustive:
        bare(args.bare_sequential or args.bare_exhaustive, args.folder, sequential=bool(args.bare_sequential))
        return
    if args.step:
        done = match_walk(args.folder) if args.step == "matching" else map_by(args.step, args.folder, args.workers)
        print(json.dumps(done))
        return
    found: dict[str, object] = {}
    if args.euroc:
        capture, truth = euroc_capture(args.euroc, args.folder / "euroc")
        found["euroc"] = both(capture, args.folder / "euroc", truth, sequential=False)
        print(json.dumps({"euroc": found["euroc"]}, indent=1), flush=True)
    if args.walk:
        folder = args.folder / f"walk{args.walk}"
        capture = write_walk(Walk(seed=100, frames=args.walk, frame_rate_hz=args.walk / 37.5), folder)
        found["walk"] = both(capture, folder, true_centres(folder), sequential=True)
        print(json.dumps({"walk": found["walk"]}, indent=1), flush=True)
    if args.loop:
        seconds = 40 * args.laps / 1.08
        walk = Walk(
            seed=100, frames=args.loop, frame_rate_hz=args.loop / seconds, laps=args.laps, drawn=False, back=args.back
        )
        name = f"loop{args.loop}_laps{args.laps:g}{'_back' if args.back else ''}"
        found["loop"] = loop_errors(walk, args.folder / name)
        print(json.dumps({"loop": found["loop"]}, indent=1), flush=True)
    for seed in range(args.first, args.first + args.repeated):
        folder = args.folder / f"{'drawn' if args.drawn else 'repeated'}{seed}"
        scene, wide = SCENES[seed % len(SCENES)], 320 if args.drawn else 480
        walk = Walk(seed=seed, frames=160, frame_rate_hz=3.2, laps=1.15, scene=scene, width=wide, drawn=args.drawn)
        found[folder.name] = {"scene": scene, **false_loops(walk, folder)}
        print(json.dumps({folder.name: found[folder.name]}), flush=True)
    for frames, seed in itertools.product(args.long, args.seeds):
        scene: Scene = "streets" if args.streets else "room"
        folder = args.folder / f"{'streets' if args.streets else 'long'}{frames}_seed{seed}_density{args.density:g}"
        walk = Walk(seed=seed, frames=frames, frame_rate_hz=8.0, scene=scene, drawn=False, pace_m_s=PACE_M_S)
        found[folder.name] = long_walk(walk, args.density, folder, args.mappers, args.workers)
        print(json.dumps({folder.name: found[folder.name]}, indent=1), flush=True)
    write_report(args.json, found)


if __name__ == "__main__":
    main()
