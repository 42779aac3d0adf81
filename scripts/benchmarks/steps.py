"""Load of each step of a run: elapsed and processor time, and how many threads worked.

    python -m scripts.benchmarks.steps CAPTURE OUT [--json FILE] [-- OPTIONS OF RECONSTRUCT ...]

Runs ``reconstruct`` in a process of its own and looks at it 25 times a second. Printed per step: clock, processor time,
and of that the part during which one thread alone had work, by what the system says of all threads: that part is what
a second core cannot share, whatever else the machine does. ``alone`` is its share of all. ``two idle cores``: seconds
that the step would take on two cores of its own, what one thread does alone and half of the rest.

Also printed: which pairs were matched, and which of them were verified; what it would have been, had the finished model
chosen them (those of which both pictures show a share of the other's points, seen from within 40 degrees); and
milliseconds of processor time for each image that its pose's covariance takes.
"""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.files import read_json
from colmap_inertial.io.frames import read_frames
from colmap_inertial.model import find_models, read_model, trajectory_from_model
from scripts.common.bench_report import write_report
from scripts.common.measured_run import read_run_arguments

if TYPE_CHECKING:
    import pycolmap


EVERY_S = 0.04
#: Shares of points that two pictures must both show, and from how far apart in direction.
ASKED, MOST_DEG = (0.02, 0.05), 40.0
#: What is between the steps: reading, the check beforehand, the report.
BETWEEN = "between"


@dataclass(frozen=True, kw_only=True)
class Look:
    """At one instant: threads that had work, and processor time so far."""

    clock_s: float
    busy: int
    processor_s: float


def processes(root: int) -> Iterator[int]:
    """A process and those that it began."""
    yield root
    for task in Path(f"/proc/{root}/task").iterdir():
        for child in (task / "children").read_text().split():
            yield from processes(int(child))


def fields(path: Path) -> list[str]:
    """Of a ``stat`` file, those after the name."""
    return path.read_text().rpartition(")")[2].split()


def look(root: int, spent: dict[int, float]) -> Look:
    """At a process and all that it began; ``spent`` keeps what ended processes took."""
    busy, tick = 0, os.sysconf("SC_CLK_TCK")
    try:
        for pid in processes(root):
            own = Path(f"/proc/{pid}")
            busy += sum(fields(task / "stat")[0] == "R" for task in (own / "task").iterdir())
            values = fields(own / "stat")
            spent[pid] = (int(values[11]) + int(values[12])) / tick
    except (FileNotFoundError, ProcessLookupError):
        pass  # it ended meanwhile
    return Look(clock_s=time.time(), busy=busy, processor_s=sum(spent.values()))


def steps_of(log: Path) -> list[tuple[str, float, float]]:
    """Name, begin and end of each step, clock seconds, by the run's log."""
    begun: dict[str, float] = {}
    steps = []
    for line in log.read_text(encoding="utf-8").splitlines():
        stamp, _, rest = line.partition(" INFO ")
        name, colon, what = rest.partition(": ")
        if not colon or what.split(" ")[0] not in ("started", "finished"):
            continue
        at_s = datetime.strptime(stamp, "%Y-%m-%d %H:%M:%S,%f").timestamp()
        if what == "started":
            begun[name] = at_s
        elif name in begun:
            steps.append((name, begun.pop(name), at_s))
    return steps


def shared_out(looks: list[Look], steps: list[tuple[str, float, float]]) -> dict[str, dict[str, float]]:
    """Clock, processor time and what of it one thread took alone, for each step."""
    found: dict[str, dict[str, float]] = {}
    for before, now in itertools.pairwise(looks):
        name = next((name for name, begin_s, end_s in steps if begin_s <= now.clock_s < end_s), BETWEEN)
        one = found.setdefault(name, {"clock_s": 0.0, "processor_s": 0.0, "one_thread_s": 0.0})
        spent_s = now.processor_s - before.processor_s
        one["clock_s"] += now.clock_s - before.clock_s
        one["processor_s"] += spent_s
        one["one_thread_s"] += spent_s if now.busy <= 1 else 0.0
    for one in found.values():
        one["two_idle_cores_s"] = one["one_thread_s"] + 0.5 * (one["processor_s"] - one["one_thread_s"])
    return found


def covariance_ms(capture: Path, out: Path) -> float:
    """Processor time for each image of the largest model that covariances of poses take."""
    timing, _ = read_frames(load_capture(capture))
    model = max(map(read_model, find_models(out / "colmap" / "sparse").values()), key=lambda one: one.num_reg_images())
    spent_s = {}
    for covariances in (False, True):
        begun_s = time.process_time()
        for _ in range(5):
            trajectory_from_model(model, timing, covariances=covariances)
        spent_s[covariances] = (time.process_time() - begun_s) / 5
    return 1e3 * (spent_s[True] - spent_s[False]) / int(model.num_reg_images())


def chosen_by_model(out: Path) -> dict[str, dict[str, int]]:
    """By the least share of points that two pictures must both show: how many verified pairs that would leave out, how
    many that were matched in vain, and how many that were not matched it would add."""
    import pycolmap

    models = map(read_model, find_models(out / "colmap" / "sparse").values())
    model = max(models, key=lambda one: one.num_reg_images())
    ids = sorted(model.reg_image_ids())
    with pycolmap.Database.open(str(out / "colmap" / "database.db")) as opened:
        tried = {(i, j) for i, j in itertools.combinations(ids, 2) if opened.exists_matches(i, j)}
        pairs, counts = opened.read_two_view_geometry_num_inliers()
    verified = {
        tuple(sorted(pycolmap.pair_id_to_image_pair(pair))) for pair, count in zip(pairs, counts, strict=True) if count
    }
    place = {number: point.xyz for number, point in model.points3D.items()}
    seen = {
        i: np.array([place[p.point3D_id] for p in model.image(i).points2D if p.has_point3D()]).reshape(-1, 3)
        for i in ids
    }
    share = {
        (i, j): min(_shown(model, seen, i, j), _shown(model, seen, j, i)) for i, j in itertools.combinations(ids, 2)
    }
    found = {}
    for least in ASKED:
        chosen = {pair for pair, value in share.items() if value >= least}
        found[f"{least:.0%}"] = {
            "verified_lost": len((verified & share.keys()) - chosen),
            "vain_spared": len(tried - verified - chosen),
            "added": len(chosen - tried),
        }
    return found


def _shown(model: pycolmap.Reconstruction, seen: Mapping[int, Array], i: int, j: int) -> float:
    """Share of the points that image i sees that lie in image j, too, seen from not much elsewhere."""
    points, other = seen[i], model.image(j)
    pose, camera = other.cam_from_world(), model.camera(other.camera_id)
    cam = points @ pose.rotation.matrix().T + pose.translation
    before = cam[:, 2] > 0
    px = np.asarray(camera.img_from_cam(cam[before]))
    inside = ((px >= 0) & (px < [camera.width, camera.height])).all(axis=1)
    rays = [points[before] - image.projection_center() for image in (model.image(i), other)]
    cosine = np.sum(rays[0] * rays[1], axis=1) / np.prod(np.linalg.norm(rays, axis=2), axis=0)
    return float(np.sum(inside & (cosine > np.cos(np.radians(MOST_DEG))))) / max(len(points), 1)


def main() -> None:
    args = read_run_arguments(__doc__)
    shutil.rmtree(args.out, ignore_errors=True)
    command = [sys.executable, "-m", "colmap_inertial", "reconstruct", str(args.capture), str(args.out), *args.options]
    looks, spent = [], dict[int, float]()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        while run.poll() is None:
            looks.append(look(run.pid, spent))
            time.sleep(EVERY_S)
    found = shared_out(looks, steps_of(args.out / "log.txt"))
    total = {key: sum(one[key] for one in found.values()) for key in next(iter(found.values()))}
    print(f"{'step':24} clock  processor  alone  two idle cores")
    for name, one in (*found.items(), ("all", total)):
        alone = one["one_thread_s"] / max(one["processor_s"], 1e-9)
        print(
            f"{name:24} {one['clock_s']:5.1f} {one['processor_s']:10.1f} {alone:6.2f} {one['two_idle_cores_s']:15.1f}"
        )
    matching = read_json(args.out / "result.json")["matching"]
    print(f"pairs: {matching['pairs']}, matched {matching['matched']}, verified {matching['verified']}")
    by_model = chosen_by_model(args.out)
    for least, told in by_model.items():
        print(f"chosen by the model, {least} in common: {told}")
    each_ms = covariance_ms(args.capture, args.out)
    print(f"covariance of a pose: {each_ms:.1f} ms an image")
    if args.json:
        figures = {"steps": found, "all": total, "matching": matching, "chosen_by_model": by_model}
        figures["covariance_ms_an_image"] = each_ms
        write_report(args.json, figures)


if __name__ == "__main__":
    main()
