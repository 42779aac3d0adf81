"""Real video beside bare COLMAP: processor time by step, registered images, path and scale errors, verdict.

    python -m scripts.benchmarks.video FOLDER [--data ../shared/data] [--sets mh01_5hz room ...] [--only
    {bare,bare_exhaustive,ours,refined,exhaustive}] [--overlap N] [--json FILE]

FOLDER takes captures and reconstructions. Sets: ``mh01_20hz``, ``mh01_10hz``, ``mh01_5hz`` (EuRoC MH_01, 30 s, of which
the camera stands still in the last 14), ``room`` (a room by hand, 22 s at 8.3 Hz, rolling shutter; no truth), and the
first 62 frames of it, ``room_62``. Both find COLMAP's default features with the camera given, one thread each, seed 0;
bare COLMAP matches sequentially (by ``--overlap`` frames, and a quadratic overlap) and maps with its own settings;
``bare_exhaustive``, only where it is asked for, matches every pair.

Bare steps are the processor time of each call, ours that between the stamps of the process' steps. ``refined`` repeats
our metric step with ``--refine inertial``. ``exhaustive``, only where it is asked for, is ours with every pair matched;
where ours is there, too, it tells how far the cameras of both lie apart, after a similarity. Path: rms distance of
camera centres from the truth after a similarity, of COLMAP's model and of the metric one; scale: the metric model's
length over the true one, less one. A set without its recordings is skipped.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.files import read_json
from colmap_inertial.model import find_models, read_model
from scripts.benchmarks.whole import bare_pipeline
from scripts.common.bench_report import write_report
from scripts.studies.check_euroc import similarity

if TYPE_CHECKING:
    import pycolmap

Figures = dict[str, Any]
#: EuRoC's frames a second.
EUROC_HZ = 20
#: Sets by name: folder of the recordings; of EuRoC each which frame, of the room how many.
SETS = {"mh01_20hz": ("euroc_mh01", 1), "mh01_10hz": ("euroc_mh01", 2), "mh01_5hz": ("euroc_mh01", 4)}
SETS |= {"room": ("handheld_room", 185), "room_62": ("handheld_room", 62)}
#: Our steps in the columns of the table; any other is ``rest``.
STEPS = {"features": "features", "matches": "matching", "mapping": "mapping", "metric": "metric"}
#: All steps of a run; other stamps are of what these are made from.
RUN_STEPS = ("imaging", "frames", *STEPS, "images")
#: Options of our runs, and what is run where nothing is asked for.
OPTIONS = {
    "ours": ("--refine", "auto"),
    "refined": ("--refine", "inertial"),
    "exhaustive": ("--refine", "auto", "--mapping.pairing", "exhaustive"),
}
RUNS = ("bare", "ours", "refined")
BARE = ("bare", "bare_exhaustive")
COLUMNS = ("features", "matching", "mapping", "metric", "rest", "processor_s")


@dataclass(frozen=True, eq=False, kw_only=True)
class Video:
    """A capture and where its cameras truly were, by image name; empty where nobody knows."""

    capture: Path
    truth: dict[str, Array]


def copy_once(source: str | Path, target: str | Path) -> None:
    """Copy a file, unless it is there: a run goes on where its frames are as they were."""
    if not Path(target).exists():
        shutil.copyfile(source, target)


def euroc_video(dataset: Path, folder: Path, every: int) -> Video:
    """Every so many frames of EuRoC's left camera."""
    mav = dataset.resolve() / "mav0"
    names = sorted(path.name for path in (mav / "cam0" / "data").glob("*.jpg"))
    stamps_ns = np.array([int(Path(name).stem) for name in names])
    place = np.rint((stamps_ns - stamps_ns[0]) * 1e-9 * EUROC_HZ).astype(int)
    names = [name for name, at in zip(names, place.tolist(), strict=True) if at % every == 0]
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    for name in names:
        copy_once(mav / "cam0" / "data" / name, folder / "frames" / name)
    times = folder / "frames.csv"
    times.write_text("\n".join(["name,t_ns", *(f"{name},{Path(name).stem}" for name in names)]) + "\n")
    lines = ["[images]", 'folder = "frames"', 'times = "frames.csv"', "[timing]", "readout_s = 0"]
    lines += ["shared_clock = true", "[camera]", f'sensor_yaml = "{mav / "cam0" / "sensor.yaml"}"']
    lines += ["[imu]", f'path = "{mav / "imu0"}"']
    (folder / "capture.toml").write_text("\n".join(lines) + "\n")
    rows = np.array([line.split(",") for line in (dataset / "gt" / "camera.csv").read_text().splitlines()[1:]])
    truth_ns = np.array([int(row.partition(".")[0]) for row in rows[:, 0]])
    t_s, query_s = (truth_ns - truth_ns[0]) * 1e-9, (np.array([int(Path(n).stem) for n in names]) - truth_ns[0]) * 1e-9
    centre = np.stack([np.interp(query_s, t_s, rows[:, 1 + k].astype(float)) for k in range(3)], axis=1)
    inside = (query_s >= 0) & (query_s <= t_s[-1])
    truth = {name: at for name, at, known in zip(names, centre, inside, strict=True) if known}
    return Video(capture=folder / "capture.toml", truth=truth)


def video_of(kind: str, data: Path, folder: Path) -> Video:
    """A set's capture, written to ``folder``."""
    name, number = SETS[kind]
    if name == "euroc_mh01":
        return euroc_video(data / name, folder, every=number)
    lines = (data / name / "frames.csv").read_text().splitlines()[: number + 1]
    others = {path.name for path in (data / name / "frames").iterdir()} - {row.partition(",")[0] for row in lines}
    shutil.copytree(
        data / name, folder, dirs_exist_ok=True, copy_function=copy_once, ignore=lambda *_: {"frames.csv", *others}
    )
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    return Video(capture=folder / "capture.toml", truth={})


def bare(capture: Path, out: Path, overlap: int) -> Figures:
    """COLMAP by itself: what the other process of this script does; processor time of each step.

    Every pair is matched where the overlap is 0.
    """
    import pycolmap

    pycolmap.logging.minloglevel = 2
    described = load_capture(capture)
    camera, images = described.camera, described.frames.folder
    (out / "sparse").mkdir(parents=True)
    database = str(out / "database.db")
    reader = pycolmap.ImageReaderOptions(camera_model=camera.model, camera_params=",".join(map(repr, camera.params)))
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.sift.max_num_features = MappingOptions().max_num_features
    for options in (extraction, matching):
        options.use_gpu, options.num_threads = False, 1
    pycolmap.set_random_seed(0)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pairing: dict[str, Any] = {}
    match: Callable[..., None] = pycolmap.match_exhaustive
    if overlap:
        match = pycolmap.match_sequential
        pairing["pairing_options"] = pycolmap.SequentialPairingOptions(overlap=overlap, quadratic_overlap=True)
    cpu = pycolmap.Device.cpu
    steps = {
        "features": lambda: pycolmap.extract_features(
            database,
            str(images),
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=cpu,
        ),
        "matching": lambda: match(
            database,
            matching_options=matching,
            **pairing,
            verification_options=verification,
            device=cpu,
        ),
        "mapping": lambda: pycolmap.incremental_mapping(
            database, str(images), str(out / "sparse"), options=bare_pipeline()
        ),
    }
    figures: Figures = {}
    for name, step in steps.items():
        begun_s = time.process_time()
        step()
        figures[name] = time.process_time() - begun_s
    return {**figures, "processor_s": sum(figures.values())}


def run(command: list[object]) -> tuple[float, str]:
    """Processor time and output of a process."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(list(map(str, command)), check=True, stdout=subprocess.PIPE, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


def measure_bare(video: Video, out: Path, overlap: int) -> Figures:
    """Figures of bare COLMAP."""
    _, told = run(
        [sys.executable, "-m", "scripts.benchmarks.video", out, "--bare", video.capture, "--overlap", overlap]
    )
    return {**json.loads(told.splitlines()[-1]), **judge(out / "sparse", video.truth)}


def made_since(path: Path, begun: float) -> bool:
    """Whether a file is there, and was written since a time."""
    try:
        return path.stat().st_mtime >= begun
    except OSError:
        return False


def run_by_step(command: list[object], stamps: Path) -> tuple[float, dict[str, float]]:
    """Processor time of a process, and of its steps: which ends when its stamp appears in a folder."""
    begun, ended = time.time(), dict[str, float]()
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.DEVNULL)
    spent_s = 0.0
    while process.poll() is None:
        made = {path.stem for path in stamps.glob("*.json") if path.stem in RUN_STEPS and made_since(path, begun)}
        ended |= dict.fromkeys(made - ended.keys(), spent_s)
        try:
            # utime, stime, and those of its children that have ended, after the name in brackets
            fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            break
        spent_s = max(spent_s, sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK"))
        time.sleep(0.2)
    if process.wait():
        raise subprocess.CalledProcessError(process.returncode, process.args)
    steps = sorted(ended, key=lambda name: (ended[name], RUN_STEPS.index(name)))
    before = dict(zip(steps, [0.0, *(ended[name] for name in steps)], strict=False))
    return spent_s, {name: ended[name] - before[name] for name in steps}


def measure_ours(video: Video, out: Path, *options: str) -> Figures:
    """Figures of ``reconstruct``; of a folder that holds a run, the steps that it repeats."""
    command: list[object] = [sys.executable, "-m", "colmap_inertial", "reconstruct", video.capture, out, "--quiet"]
    command += ["--deterministic", "--overwrite", *options]
    processor_s, steps = run_by_step(command, out / ".stages")
    result = read_json(out / "result.json")
    figures: Figures = dict.fromkeys(COLUMNS, 0.0)
    for name, seconds in steps.items():
        figures[STEPS.get(name, "rest")] += seconds
    figures["rest"] += processor_s - sum(steps.values())
    figures |= {"processor_s": processor_s, **judge(out / "colmap" / "sparse", video.truth)}
    figures |= {"matched": result["matching"]["matched"], "gyroscope": result["matching"]["gyroscope"]}
    model = result["models"][0]
    figures["refinement"] = next((t["reason_details"] for t in model["treatments"] if t["stage"] == "refine"), None)
    figures["verdict"] = model["verdict"]
    if model["sparse_metric"] is not None:
        interval = np.array(model["ci95"]) / model["metres_per_unit"]
        figures["half_width_pct"] = 50 * float(interval[1] - interval[0])
        if video.truth:
            centre, true = aligned(read_model(out / model["sparse_metric"]), video.truth)
            scale = similarity(centre, true)[0]
            figures["scale_error_pct"] = 100 * (1 / scale - 1)
            figures["metric_path_mm"] = path_mm(centre, true)
    return figures


def aligned(model: pycolmap.Reconstruction, truth: dict[str, Array]) -> tuple[Array, Array]:
    """(N, 3) centres of a model's cameras, and where they truly were."""
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    known = [image for image in images if image.name in truth]
    centre = np.array([image.projection_center() for image in known])
    return centre, np.array([truth[image.name] for image in known])


def path_mm(centre: Array, true: Array) -> float:
    """Rms distance after a similarity."""
    scale, rotation, translation = similarity(centre, true)
    off_m = np.linalg.norm(scale * centre @ rotation.T + translation - true, axis=1)
    return 1e3 * float(np.sqrt(np.mean(off_m**2)))


def judge(models: Path, truth: dict[str, Array]) -> Figures:
    """Images of the models, and of the largest one residuals, points and path error."""
    model = largest(models)
    figures: Figures = {
        "images": sorted((int(read_model(one).num_reg_images()) for one in find_models(models).values()), reverse=True),
        "points": int(model.num_points3D()),
        "residual_px": float(model.compute_mean_reprojection_error()),
    }
    if truth:
        figures["path_mm"] = path_mm(*aligned(model, truth))
    return figures


def largest(models: Path) -> pycolmap.Reconstruction:
    """The model of most images."""
    return max((read_model(folder) for folder in find_models(models).values()), key=lambda m: m.num_reg_images())


def measure_apart_pct(one: Path, other: Path) -> float:
    """Rms distance of the cameras that both have, after a similarity, of the extent of their path."""
    model = largest(other)
    truth = {image.name: image.projection_center() for image in map(model.image, model.reg_image_ids())}
    centre, true = aligned(largest(one), truth)
    return 0.1 * path_mm(centre, true) / float(np.linalg.norm(np.ptp(true, axis=0)))


def show(kind: str, who: str, figures: Figures) -> str:
    """A row of the table."""
    seconds = " | ".join(f"{figures.get(name, 0.0):.0f}" for name in COLUMNS)
    images = " + ".join(map(str, figures["images"]))
    path, metric = (f"{figures[key]:.2f}" if key in figures else "" for key in ("path_mm", "metric_path_mm"))
    scale = f"{figures['scale_error_pct']:+.2f}" if "scale_error_pct" in figures else ""
    within = f" +- {figures['half_width_pct']:.2f}" if "half_width_pct" in figures else ""
    row = f"| {kind} | {who} | {seconds} | {figures.get('matched', '')} | {images} | {figures['points']} | "
    return row + f"{figures['residual_px']:.3f} | {path} | {metric} | {scale}{within} | {figures.get('verdict', '')} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[3] / "shared" / "data")
    parser.add_argument("--sets", nargs="*", choices=tuple(SETS), default=["mh01_5hz", "room"])
    parser.add_argument("--only", choices=(*BARE, *OPTIONS))
    parser.add_argument("--overlap", type=int, default=10, help="of bare COLMAP's sequential matching")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--bare", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.bare:
        print(json.dumps(bare(args.bare, args.folder, args.overlap)))
        return
    found: dict[str, Figures] = {}
    heads = ["set", "", *COLUMNS, "pairs", "images", "points", "px", "path mm", "metric path mm", "scale %", "verdict"]
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|", flush=True)
    for kind in args.sets:
        if not (args.data / SETS[kind][0]).is_dir():
            print(f"{kind}: skipped, as {args.data / SETS[kind][0]} is not there", flush=True)
            continue
        video = video_of(kind, args.data, args.folder / kind / "capture")
        for who in RUNS if args.only is None else (args.only,):
            out = args.folder / kind / ("ours" if who == "refined" else who)
            if who != "refined":
                shutil.rmtree(out, ignore_errors=True)
            if who in BARE:
                measured = measure_bare(video, out, args.overlap if who == "bare" else 0)
            else:
                measured = measure_ours(video, out, *OPTIONS[who])
            found[f"{kind} {who}"] = measured
            print(show(kind, who, measured), flush=True)
            ours = args.folder / kind / "ours" / "colmap" / "sparse"
            if who == "exhaustive" and find_models(ours):
                apart_pct = measure_apart_pct(ours, out / "colmap" / "sparse")
                print(f"{kind}: cameras of both lie {apart_pct:.2f} % of the path's extent apart (rms)", flush=True)
    write_report(args.json, found)


if __name__ == "__main__":
    main()
