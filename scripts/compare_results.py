"""Results of two checkouts on a fixed list of jobs, compared value by value.

    python scripts/compare_results.py prepare INPUTS                once, in a checkout's folder: scenes and projects
    python scripts/compare_results.py run FOLDER INPUTS [--quick]   with the python of each checkout, a FOLDER for each
    python scripts/compare_results.py compare FOLDER_A FOLDER_B [--tolerance 1e-9]

``run`` calls the command line of the ``colmap_inertial`` that is installed beside the running interpreter, and nothing
else of it: one copy of this script serves checkouts in which modules lie elsewhere. ``prepare`` also takes helpers from
``tests/`` and ``scripts/`` of the folder that it is called in; its INPUTS serve any number of checkouts.

``compare`` prints a line for each job. A number in JSON, a picture, a model, a table or another file that differs is a
failure (exit code 1), and so is a file, a key or an exit code that only one has. Texts that differ (strings in JSON,
pages, logs, screens) are counted and no failure. With ``--tolerance``, numbers in JSON, NumPy files, text files and
COLMAP models may differ by that share of the larger one; the largest difference is printed.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import fnmatch
import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

#: Keys of JSON files that are no results: how long something took, and by which version it was made.
EXCLUDED_KEYS = {"seconds", "runtime_s", "versions"}
#: Folders that are not compared: stamps of finished steps (keys, times) and locks.
EXCLUDED_FOLDERS = {".stages"}
#: Files of which only is counted how many differ: words, and times of the run.
TEXTS = ("*.html", "*.md", "log.txt", "screen_*.txt")
#: Files of a COLMAP model; with a tolerance they are compared as text.
MODEL = ("cameras.bin", "images.bin", "points3D.bin", "frames.bin", "rigs.bin")
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
#: Done, an error found by ``diagnose``, a scale refused; any other code means that a job has no sound input.
EXPECTED_CODES = {0, 1, 3}
#: One thread, and memory that is zero when it is handed out: COLMAP does not write the descriptors of a few keypoints
#: at the edge of a picture, so that even deterministic runs may differ.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "GLIBC_TUNABLES": "glibc.malloc.perturb=255:glibc.malloc.tcache_count=0"}

SMALL_FEATURES = "--mapping.pairing sequential --mapping.first-octave 0 --mapping.max-num-features"
EUROC = "--imu {data}/euroc_v101/mav0/imu0 --frame-times {in}/euroc.csv"
EXPORTS = "3dgs gsplat nerfstudio brush opensplat instant-ngp 3dgs-deblur metashape bundler ply las tum csv gltf"
RECORDINGS = ("D1", "D3", "D5", "D7", "D9", "D11", "D13", "D15")
#: What makes a small scene of the blurred one's recipe, in whose last table it stands.
SMALL_CAMERA = """\
width = 320
height = 240
params = [260.0, 260.0, 160.0, 120.0, 0.08, -0.12, 0.0005, -0.0003]
readout_s = 0.02
"""

#: Options that commands have in every job.
ALWAYS = {"reconstruct": "--deterministic", "scale": "--no-remembered"}
#: Commands of each job, in this order, in the job's own folder. {in}: INPUTS, {data}: recordings beside the checkout.
JOBS: dict[str, list[str]] = {
    # long ones first: the others fill the gaps
    "parts": [f"reconstruct {{in}}/long out {SMALL_FEATURES} 400"],
    "rolling_shutter": ["reconstruct {in}/rolling_shutter out"],
    "blurred": [
        "reconstruct {in}/blurred out",
        "export out original --images original --capture {in}/blurred",
    ],
    "desk": [
        "diagnose {in}/desk --json diagnosis.json",
        "reconstruct {in}/desk out",
        "validate out/sparse/0 --images out/images --target checkerboard:8x6:0.04 --json validation.json",
        "align out/sparse/0 --imu {in}/desk/capture.toml --frame-times {in}/desk/capture.toml --out calibration.json",
        "export out trainers",
        *(f"export out {target} --for {target}" for target in EXPORTS.split()),
        "reconstruct {in}/desk global --mapping.mapper global --mapping.first-octave 0",
    ],
    "hopeless": ["reconstruct {in}/hopeless out"],
    "loop": [f"reconstruct {{in}}/loop out {SMALL_FEATURES} 1000 --world y-down"],
    "joined": [
        "reconstruct {in}/joined/project out --imu {in}/joined/imu --frame-times {in}/joined/times.csv",
        "export out path --for tum",
    ],
    "refined": [
        "reconstruct {in}/refined/project out --imu {in}/refined/imu --frame-times {in}/refined/times.csv"
        " --refine inertial"
    ],
    "scale": [
        *(f"scale {{data}}/inertial_scale/{name} --json {name}.json" for name in RECORDINGS),
        "scale {data}/inertial_scale/D1 --method spectral --first-s 60 --json D1_spectral.json",
    ],
    "euroc": [
        f"scale {{data}}/euroc_v101/colmap_sparse {EUROC} --json scale.json",
        f"diagnose {{data}}/euroc_v101/colmap_sparse {EUROC} --json diagnosis.json",
        "apply {in}/euroc_project metric --scale scale.json",
    ],
    "apply": [
        "apply {in}/box factor --factor 2.5",
        "apply {in}/box moved --sim3 {in}/similarity.json",
        "apply moved undone --undo",
        "export factor gsplat --for gsplat",
        "reconstruct {in}/box measured --scale-from distance --between 0,0,0 1,0,0 --distance 2.5+-.1",
    ],
    "video": [
        "diagnose {data}/gopro/karma.mp4 --json karma.json",
        "diagnose {data}/gopro/max-heromode.mp4 --json max.json",
    ],
    "pictures": [
        "simulate {in}/small.toml scene --workers 1",
        "diagnose scene --json diagnosis.json",
        *(f"deblur scene {method} --rectify --method {method}" for method in ("wiener", "path", "deepgyro")),
        "fuse-exposures {in}/pairs exposures --fusion mertens --device cpu",
        "fuse-apertures {in}/apertures apertures --depth --refocus 0.8 --threads 1",
    ],
    "rests": [
        "calibrate-imu {in}/rests.csv --latitude-deg 47.4 --out rests.json",
        "diagnose {in}/rests.csv --json diagnosis.json",
        "scale {data}/inertial_scale/D1 --calibration rests.json --json scale.json",
    ],
}
#: What --quick leaves out.
LONG = ("parts", "rolling_shutter", "blurred", "desk")


def prepare(folder: Path, data: Path) -> None:
    """Everything that jobs read and that is not public data, made anew by the checkout of the working directory."""
    here = Path.cwd()
    sys.path.insert(0, str(here))
    from scripts.common import walk_scenes
    from tests.helpers import exposure_scenes, model_project, refine_walk
    from tests.inertial.join import test_join
    from tests.inertial.static_calibration import test_static_calibration as rests
    from tests.run.stages import test_apertures as apertures, test_refine

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    command = [sys.executable, "-m", "colmap_inertial", "simulate"]
    for scene in ("hopeless", "rolling_shutter", "blurred"):
        recipe = here / "example_scenes" / scene / "recipe.toml"
        subprocess.run([*command, recipe, folder / scene, "--workers", "2", "--quiet"], check=True)
    shutil.copytree(here / "example_scenes" / "desk", folder / "desk")
    for name, frames, width in (("loop", 160, 320), ("long", 1004, 240)):
        walk = walk_scenes.Walk(seed=100, frames=frames, frame_rate_hz=frames / 37.5, width=width)
        walk_scenes.write_walk(walk, folder / name)

    tracks = test_join.simulate_tracks(refine_walk.walk(18.0, points_per_m=30.0, vibration_m_s2=0.2), seed=3)
    halves = test_join.cut(tracks, [(0.0, 9.2), (10.2, 18.0)])
    test_join.project_of(tracks, halves, folder / "joined" / "project")
    tracks = refine_walk.tracks_of(refine_walk.walk(25.0, points_per_m=80.0))
    whole = test_refine.adjusted(tracks.reconstruction())
    test_join.project_of(tracks, [whole], folder / "refined" / "project")

    model_project.write_project(folder / "box")
    similarity = {"scale": 2.5, "rotation_xyzw": [0.5, 0.5, 0.5, 0.5], "translation_m": [1.0, -2.0, 0.25]}
    (folder / "similarity.json").write_text(json.dumps(similarity))
    exposure_scenes.write_pair_capture(folder / "pairs")
    model = apertures.CameraModel(model="PINHOLE", width=160, height=120, params=(300.0, 300.0, 80.0, 60.0))
    motion = apertures.MotionOptions(duration_s=2.0, radius_m=0.69, height_m=0.4, arc_deg=60.0, sweep_s=6.0)
    camera = apertures.ShutterCamera(model=model, exposure_s=0.001)
    recipe = apertures.SceneRecipe(format="png", camera=camera, motion=motion, frame_rate_hz=1.5)
    apertures.write_aperture_capture(recipe, folder / "apertures")
    blurred = (here / "example_scenes" / "blurred" / "recipe.toml").read_text()
    (folder / "small.toml").write_text(blurred.replace("duration_s = 18.0", "duration_s = 4.0") + SMALL_CAMERA)

    shutil.copytree(data / "euroc_v101" / "colmap_sparse", folder / "euroc_project" / "sparse" / "0")
    names = sorted(path.name for path in (data / "euroc_v101" / "keyframes").glob("*_0.jpg"))
    rows = [f"{name},{name.split('_')[0]}" for name in names]
    (folder / "euroc.csv").write_text("\n".join(["name,t_ns", *rows]) + "\n")
    still = rests.simulate_rests(rests.RestOptions(), seed=3).recording
    header = "t [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s2],ay [m/s2],az [m/s2]"
    table = np.column_stack([still.gyro_t_s, still.gyro_rad_s, still.accel_m_s2])
    np.savetxt(folder / "rests.csv", table, fmt="%.9f", delimiter=",", header=header, comments="")


def run_job(name: str, folder: Path, places: dict[str, Path]) -> float:
    """Run the commands of a job in a folder of its own, and write the manifest of what is there then; seconds."""
    own, begun_s, codes = folder / name, time.monotonic(), {}
    shutil.rmtree(own, ignore_errors=True)
    own.mkdir(parents=True)
    for number, line in enumerate(JOBS[name]):
        arguments = [word.format_map(places) for word in f"{line} {ALWAYS.get(line.split()[0], '')}".split()]
        with (own / f"screen_{number}.txt").open("wb") as screen:
            command = [sys.executable, "-m", "colmap_inertial", *arguments]
            done = subprocess.run(
                command, cwd=own, env=os.environ | ENVIRONMENT, stdout=screen, stderr=subprocess.STDOUT, timeout=1200
            )
        codes[line] = done.returncode
    seconds = time.monotonic() - begun_s
    paths = (path for path in sorted(own.rglob("*")) if path.is_file())
    files = {str(path.relative_to(own)): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    manifest = {"seconds": round(seconds, 1), "exit_codes": codes, "files": files}
    (folder / f"{name}.json").write_text(json.dumps(manifest, indent=1) + "\n")
    return seconds


def run_jobs(names: list[str], folder: Path, places: dict[str, Path], processes: int) -> bool:
    """Run jobs, several at once, and say how long each took; whether no command found its input bad."""
    begun_s, sound = time.monotonic(), True
    with concurrent.futures.ThreadPoolExecutor(processes) as pool:
        running = {pool.submit(run_job, name, folder, places): name for name in names}
        for job in concurrent.futures.as_completed(running):
            codes = json.loads((folder / f"{running[job]}.json").read_text())["exit_codes"].values()
            print(f"{running[job]:16} {job.result():6.0f} s, exit codes {sorted(set(codes))}", flush=True)
            sound = sound and EXPECTED_CODES.issuperset(codes)
    print(f"{'all':16} {time.monotonic() - begun_s:6.0f} s")
    return sound


class Differences:
    """What differs between two folders of a job."""

    def __init__(self, tolerance: float) -> None:
        self.tolerance = tolerance
        self.failures: list[str] = []
        self.texts = 0
        self.largest = 0.0

    def number(self, where: str, a: float, b: float) -> None:
        """Compare two numbers."""
        if a == b or (math.isnan(a) and math.isnan(b)):
            return
        share = abs(a - b) / max(abs(a), abs(b))
        self.largest = max(self.largest, share)
        if not share <= self.tolerance:
            self.failures.append(f"{where}: {a!r} -> {b!r}")

    def values(self, where: str, a: Any, b: Any) -> None:
        """Compare what two JSON files hold."""
        if isinstance(a, dict) and isinstance(b, dict):
            for key in sorted((a.keys() | b.keys()) - EXCLUDED_KEYS):
                if key in a and key in b:
                    self.values(f"{where}.{key}", a[key], b[key])
                else:
                    self.failures.append(f"{where}.{key}: only in the {'first' if key in a else 'second'}")
        elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
            for i, (one, other) in enumerate(zip(a, b, strict=True)):
                self.values(f"{where}[{i}]", one, other)
        elif isinstance(a, str) and isinstance(b, str):
            self.texts += a != b
        elif type(a) in (int, float) and type(b) in (int, float):
            self.number(where, a, b)
        elif a != b:
            self.failures.append(f"{where}: {str(a)[:60]} -> {str(b)[:60]}")

    def text_numbers(self, where: str, a: str, b: str) -> None:
        """Compare two texts number by number, their words exactly."""
        if NUMBER.split(a) != NUMBER.split(b):
            self.failures.append(f"{where}: words or layout differ")
            return
        for one, other in zip(NUMBER.findall(a), NUMBER.findall(b), strict=True):
            self.number(where, float(one), float(other))

    def file(self, name: str, a: Path, b: Path) -> None:
        """Compare two files whose bytes differ."""
        if any(fnmatch.fnmatch(a.name, pattern) for pattern in TEXTS):
            self.texts += 1
        elif a.suffix == ".json":
            self.values(name, *(json.loads(path.read_text()) for path in (a, b)))
        elif self.tolerance and all(texts := [as_text(path) for path in (a, b)]):
            self.text_numbers(name, *texts)
        else:
            self.failures.append(f"{name}: bytes differ")


def as_text(path: Path) -> str:
    """What a file holds, its numbers in full; nothing where it is not known how to read it."""
    if path.name in MODEL:
        import pycolmap

        with tempfile.TemporaryDirectory() as folder:
            pycolmap.Reconstruction(str(path.parent)).write_text(folder)
            return (Path(folder) / path.name).with_suffix(".txt").read_text()
    if path.suffix in (".npz", ".npy"):
        read = np.load(path)
        arrays = {"": read} if isinstance(read, np.ndarray) else dict(read)
        return "\n".join(f"{name} {one.dtype} {one.shape} {one.tolist()}" for name, one in arrays.items())
    try:
        return path.read_text()
    except UnicodeDecodeError:
        return ""


def compare_job(name: str, first: Path, second: Path, tolerance: float) -> Differences:
    """Compare what two runs of a job wrote."""
    found = Differences(tolerance)
    a, b = (json.loads((folder / f"{name}.json").read_text()) for folder in (first, second))
    found.values("exit_codes", a["exit_codes"], b["exit_codes"])
    for file in sorted(a["files"].keys() | b["files"].keys()):
        if EXCLUDED_FOLDERS.intersection(Path(file).parts):
            continue
        if file not in a["files"] or file not in b["files"]:
            found.failures.append(f"{file}: only in the {'first' if file in a['files'] else 'second'}")
        elif a["files"][file] != b["files"][file]:
            found.file(file, first / name / file, second / name / file)
    return found


def compare(first: Path, second: Path, tolerance: float, shown: int) -> bool:
    """Print a line for each job that both folders have, and what differs; whether all is the same."""
    made = [{path.stem for path in folder.glob("*.json")} for folder in (first, second)]
    same = bool(made[0])
    for name in sorted(made[0] | made[1], key=[*JOBS].index):
        if not all(name in one for one in made):
            print(f"{name:16} only in one folder")
            same = False
            continue
        found = compare_job(name, first, second, tolerance)
        word = f"{len(found.failures)} DIFFER" if found.failures else "same"
        largest = f", numbers by up to {found.largest:.1e}" if found.largest else ""
        print(f"{name:16} {word}{largest}; texts that differ: {found.texts}")
        for line in found.failures[:shown]:
            print(f"    {line}")
        same = same and not found.failures
    return same


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", required=True)
    making, running, comparing = (actions.add_parser(name) for name in ("prepare", "run", "compare"))
    running.add_argument("folder", type=Path)
    for one in (making, running):
        one.add_argument("inputs", type=Path)
        one.add_argument("--shared", type=Path, default=Path("../shared/data"), help="public recordings")
    running.add_argument("--jobs", nargs="+", choices=list(JOBS), default=list(JOBS))
    running.add_argument("--quick", action="store_true", help=f"without {', '.join(LONG)}")
    running.add_argument("--processes", type=int, default=2, help="jobs at once")
    comparing.add_argument("first", type=Path)
    comparing.add_argument("second", type=Path)
    comparing.add_argument("--tolerance", type=float, default=0.0, help="relative, of numbers")
    comparing.add_argument("--shown", type=int, default=10, help="differences that are printed for each job")
    asked = parser.parse_args()
    if asked.action == "compare":
        return 0 if compare(asked.first, asked.second, asked.tolerance, asked.shown) else 1
    places = {"in": asked.inputs.resolve(), "data": asked.shared.resolve()}
    if not places["data"].is_dir():
        parser.error(f"{places['data']}: no such folder; --shared says where recordings are")
    if asked.action == "prepare":
        prepare(places["in"], places["data"])
        return 0
    names = [name for name in asked.jobs if not (asked.quick and name in LONG)]
    return 0 if run_jobs(names, asked.folder.resolve(), places, asked.processes) else 1


if __name__ == "__main__":
    sys.exit(main())
