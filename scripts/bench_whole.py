"""The whole run against bare COLMAP: processor time, registered images, camera error, loops.

    python scripts/bench_whole.py FOLDER [--euroc DATASET] [--walk FRAMES] [--repeated SCENES] [--json FILE]

FOLDER takes captures and reconstructions. ``--euroc``: the 100 keyframes of V1_01_easy (DATASET has ``keyframes/``,
``mav0/`` and ``gt/``), bare COLMAP matching every pair. ``--walk``: a simulated walk around a room back to its start
(``walk_scenes.py``), bare COLMAP matching sequentially without loop detection. Both find the same features (COLMAP's
defaults), in processes of their own, one thread each; processor time is that of the whole process.

Camera error: rms distance of the camera centres from the truth after a similarity. Loop error: of frames at the end,
how far they lie from the frame at the start that is truly nearest, against the truth.

``--repeated``: walks of 100 frames past posters that hang many times; of the pairs that close loops, those whose
cameras are in truth more than 2 m apart or look more than 60 degrees apart are false.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import yaml
from check_euroc import similarity
from walk_scenes import Walk, write_walk

from colmap_inertial.geometry import matrix_from_quat, quat_rotate, slerp
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.files import read_json
from colmap_inertial.model import find_models, read_model
from colmap_inertial.options import MappingOptions
from colmap_inertial.types import Array

Figures = dict[str, float]
#: Of a walk, frames at the start and at the end between which the loop's error is measured.
ENDS = 0.06
NEAR_M, SAME_DEG = 2.0, 60.0


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
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads, pipeline.random_seed = 1, 0
    pipeline.ba_refine_focal_length = pipeline.ba_refine_extra_params = False
    pipeline.mapper.abs_pose_refine_focal_length = pipeline.mapper.abs_pose_refine_extra_params = False
    pycolmap.incremental_mapping(database, str(images), str(out / "sparse"), options=pipeline)


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
        "bare": processor_s([sys.executable, __file__, out / "bare", *kind, capture]),
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


def false_loops(folder: Path) -> Figures:
    """Of the loops that matching closes, how many are false."""
    from colmap_inertial.colmap import pairing
    from colmap_inertial.colmap.sparse import extract_features
    from colmap_inertial.io.frames import read_frames
    from colmap_inertial.io.imu import read_capture_imu
    from colmap_inertial.run.context import Recording, RunContext
    from colmap_inertial.run.session import keep_colmap_quiet

    keep_colmap_quiet()
    capture = load_capture(folder)
    timing, _ = read_frames(capture)
    recording = Recording.of(capture, read_capture_imu(capture), timing, capture.calibration)
    context, options = RunContext(scratch=folder, num_threads=1), MappingOptions(pairing="sequential")
    features, database = folder / "features.db", folder / "database.db"
    if not features.is_file():
        extract_features(
            folder / "frames", dict.fromkeys(timing.names, capture.camera), features, options, context=context
        )
    database.unlink(missing_ok=True)
    record = pairing.match_capture(features, database, recording, capture.camera, options, context)
    truth = read_json(folder / "truth.json")
    centre, looking = (
        np.array(truth["cam_in_world_m"]),
        matrix_from_quat(np.array(truth["world_from_cam_xyzw"]))[:, :, 2],
    )
    place = {name: i for i, name in enumerate(truth["names"])}
    closed, false = 0, 0
    for first, second in verified_pairs(database):
        i, j = sorted((place[first], place[second]))
        if j - i > 2 * options.overlap:
            closed += 1
            apart = np.degrees(np.arccos(np.clip(looking[i] @ looking[j], -1, 1)))
            false += bool(np.linalg.norm(centre[i] - centre[j]) > NEAR_M or apart > SAME_DEG)
    return {"closed": closed, "false": false, "refused": record.loops_refused, "candidates": record.loop_candidates}


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
    parser.add_argument("--repeated", type=int, default=0, help="scenes")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--bare-sequential", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--bare-exhaustive", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.bare_sequential or args.bare_exhaustive:
        bare(args.bare_sequential or args.bare_exhaustive, args.folder, sequential=bool(args.bare_sequential))
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
    for seed in range(args.repeated):
        folder = args.folder / f"repeated{seed}"
        write_walk(Walk(seed=seed, frames=100, frame_rate_hz=3.0, laps=1.15, repeated=True), folder)
        found[folder.name] = false_loops(folder)
        print(json.dumps({folder.name: found[folder.name]}), flush=True)
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
