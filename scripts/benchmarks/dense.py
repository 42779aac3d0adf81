"""Depth maps, fused cloud and mesh of simulated scenes against the truth.

    python -m scripts.benchmarks.dense FOLDER [--scenes desk seed12 seed13] [--json FILE]
    python -m scripts.benchmarks.dense FOLDER --scenes desk --cost 640 1200
    python -m scripts.benchmarks.dense FOLDER --world photo [--seeds 0 1] [--widths 640 1200]

FOLDER takes the captures and reconstructions; what is there already is continued. ``desk`` is the example scene, the
others are the same recipe with another seed: another world, path and device. Each is reconstructed by ``reconstruct
--dense``, in a process of its own.

Printed per scene: of all pixels whose true depth is below 2 m (exact, ``Renderer.depth_m``), the share that has a depth
and the share within 1, 2 and 5 %, and the same of those that have one; of these, the share within two standard
deviations, by decile of the relative one; of the table and what stands on it precision,
recall and F at 5 and 10 mm of the fused cloud and of the mesh, and the median distance from the truth; seconds of the
steps. Model and truth are brought together by a similarity over the camera centres: what is measured is the dense
reconstruction, not the scale.

``--world photo``: a ray-cast desk with photographs on it (``photo_world.py``), nearly true poses, no mapping: figures
of depth maps and fused cloud, and seconds of processor for each megapixel of depth maps.

``--cost``: for pictures of these widths, of the same scene and model, seconds of clock and processor for each megapixel
of depth maps, and the peak memory of a process that makes them and nothing else.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.dense.depth_maps import fuse_maps, map_file
from colmap_inertial.colmap.dense.sweep_stereo import SweptWorkspace
from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import CameraModel
from colmap_inertial.io.files import read_json
from colmap_inertial.model import read_model
from colmap_inertial.model.artefacts import read_map
from colmap_inertial.run.steps.workspace import Workspace
from colmap_inertial.tools.simulate import (
    Scene,
    SceneRecipe,
    ShutterCamera,
    develop,
    load_recipe,
    make_scene,
    read_truth,
    write_capture,
)
from colmap_inertial.tools.simulate.truth import true_metres_per_unit
from scripts.common.bench_report import write_report
from scripts.common.photo_world import PhotoWorld

EXAMPLE = Path(__file__).resolve().parents[2] / "example_scenes" / "desk"
SCENES = ("desk", "seed12", "seed13")
#: Depths that are judged, and by which share they may be off.
NEARER_M, SHARES = 2.0, (0.01, 0.02, 0.05)
#: The table's top and what stands on it.
LOW_M, HIGH_M = np.array([-0.8, -0.55, -0.065]), np.array([0.8, 0.55, 0.45])
WITHIN_M = (0.005, 0.010)
#: Truth and mesh are compared by points about this far apart.
SPACING_M = 0.002
#: Pictures that the cost is measured with.
COST_IMAGES = 9


@dataclass(frozen=True, kw_only=True)
class DepthFigures:
    """Shares of the pixels nearer than 2 m."""

    has: float
    of_all: tuple[float, ...]
    of_kept: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class SurfaceFigures:
    """How points agree with the true surface at 5 and 10 mm."""

    precision: tuple[float, ...]
    recall: tuple[float, ...]
    f: tuple[float, ...]
    median_m: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Truth:
    """What a dense workspace should hold.

    Attributes
    ----------
    depth_m
        By image name, (H, W) on the undistorted pixels.
    metres_per_unit, world_from_model, shift_m
        The similarity from the model to the world.
    surface_m
        (N, 3) points of the table and what stands on it, as far as two images see them.
    """

    depth_m: dict[str, Array]
    metres_per_unit: float
    world_from_model: Array
    shift_m: Array
    surface_m: Array


def recipe_of(scene: str) -> SceneRecipe:
    """The example scene's, with the seed of the scene's name."""
    recipe = load_recipe(EXAMPLE / "recipe.toml")
    return recipe if scene == "desk" else dataclasses.replace(recipe, seed=int(scene.removeprefix("seed")))


def truth_of(folder: Path, recipe: SceneRecipe, truth_file: Path) -> Truth:
    """Of a dense workspace of a simulated capture."""
    scene, truth = make_scene(recipe), read_truth(truth_file)
    renderer = scene.renderer()
    model = read_model(folder / "sparse")
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    names = tuple(image.name for image in images)
    centres = np.array([image.projection_center() for image in images])
    scale = true_metres_per_unit(names, centres, truth.trajectory)
    index = {name: i for i, name in enumerate(truth.trajectory.names)}
    true = truth.trajectory.cam_in_world[[index[name] for name in names]]
    u, _, vt = np.linalg.svd((true - true.mean(axis=0)).T @ (centres - centres.mean(axis=0)))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    depth_m, points = {}, []
    for image in images:
        camera = model.camera(image.camera_id)
        shutter = dataclasses.replace(recipe.camera, model=_pinhole(camera))
        t_s = shutter.middle_s(float(scene.trigger_s[index[image.name]]))
        depth = depth_m[image.name] = renderer.depth_m(shutter, scene.motion, t_s)
        points.append(_on_the_table(_lifted(scene, shutter, t_s, depth)))
    return Truth(
        depth_m=depth_m,
        metres_per_unit=scale,
        world_from_model=turn,
        shift_m=true.mean(axis=0) - scale * turn @ centres.mean(axis=0),
        surface_m=_seen_twice(points),
    )


def _pinhole(camera: pycolmap.Camera) -> CameraModel:
    params = tuple(float(p) for p in camera.params)
    return CameraModel(model="PINHOLE", width=camera.width, height=camera.height, params=params)


def _lifted(scene: Scene, shutter: ShutterCamera, t_s: float, depth: Array) -> Array:
    """(N, 3) world points of a true depth map."""
    xyzw, centre = scene.camera_pose(shutter, np.array([t_s]))
    fx, fy, cx, cy = shutter.model.params
    y, x = np.indices(depth.shape) + 0.5
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)
    known = np.isfinite(depth)
    return (rays[known] * depth[known][:, None]) @ matrix_from_quat(xyzw[0]) + centre[0]


def _on_the_table(points: Array) -> Array:
    return points[((points >= LOW_M) & (points <= HIGH_M)).all(axis=1)]


def _cells(points: Array) -> Int64Array:
    """One number for each cell of a grid."""
    cell = np.floor((points - LOW_M) / SPACING_M).astype(np.int64)
    return (cell[:, 0] * 4096 + cell[:, 1]) * 4096 + cell[:, 2]


def _seen_twice(points: Sequence[Array]) -> Array:
    """One point in each cell that at least two images see."""
    firsts = [np.unique(_cells(part), return_index=True) for part in points]
    cells = np.concatenate([cell for cell, _ in firsts])
    every = np.concatenate([part[first] for part, (_, first) in zip(points, firsts, strict=True)])
    _, first, count = np.unique(cells, return_index=True, return_counts=True)
    return every[first[count >= 2]]


def depth_figures(folder: Path, truth: Truth) -> DepthFigures:
    """Of the depth maps in a workspace; an image without one has no depth."""
    total = known = 0
    hits = np.zeros(len(SHARES))
    for name, true in truth.depth_m.items():
        path = map_file(folder, "depth", name)
        found = read_map(path) * truth.metres_per_unit if path.is_file() else np.zeros(true.shape)
        near = true < NEARER_M
        total += int(near.sum())
        known += int((near & (found > 0)).sum())
        hits += [int((near & (np.abs(found - true) <= share * true)).sum()) for share in SHARES]
    shares = (tuple(float(share) for share in hits / max(count, 1)) for count in (total, known))
    return DepthFigures(has=known / total, of_all=next(shares), of_kept=next(shares))


def sigma_coverage(folder: Path, truth: Truth) -> tuple[float, ...]:
    """Shares of depths nearer than 2 m within two standard deviations, by decile of the relative deviation."""
    shares, hits = [], []
    for name, true in truth.depth_m.items():
        depth, sigma = (read_map(map_file(folder, "depth", name, kind)) for kind in ("geometric", "sigma"))
        known = (true < NEARER_M) & (depth > 0)
        away_m = np.abs(depth * truth.metres_per_unit - true)[known]
        sigma_m = sigma[known] * truth.metres_per_unit
        shares.append(sigma_m / true[known])
        hits.append(away_m <= 2 * sigma_m)
    order = np.argsort(np.concatenate(shares))
    return tuple(float(decile.mean()) for decile in np.array_split(np.concatenate(hits)[order], 10))


def surface_figures(points: Array, truth: Truth) -> SurfaceFigures:
    """Of (N, 3) points of the model's unit."""
    world = _on_the_table(truth.metres_per_unit * points @ truth.world_from_model.T + truth.shift_m)
    away = cKDTree(truth.surface_m).query(world, distance_upper_bound=0.1)[0]
    missed = cKDTree(world).query(truth.surface_m, distance_upper_bound=0.1)[0]
    precision = tuple(float((away <= limit).mean()) for limit in WITHIN_M)
    recall = tuple(float((missed <= limit).mean()) for limit in WITHIN_M)
    f = tuple(2 * p * r / (p + r) for p, r in zip(precision, recall, strict=True))
    return SurfaceFigures(precision=precision, recall=recall, f=f, median_m=float(np.median(away)))


def points_of(path: Path) -> Array:
    """(N, 3) points of a PLY; of a mesh evenly over its faces, about as far apart as the truth's."""
    import trimesh

    loaded = trimesh.load(path, process=False)
    if not isinstance(loaded, trimesh.Trimesh):
        return np.asarray(loaded.vertices)
    sample, _ = trimesh.sample.sample_surface(loaded, 3_000_000, seed=0)
    return np.asarray(sample)


def reconstruct(scene: str, work: Path) -> tuple[Path, Path]:
    """Capture and reconstruct a scene; returns the capture's folder and the output."""
    capture, out = EXAMPLE if scene == "desk" else work / scene, work / f"{scene}_out"
    if not (capture / "capture.toml").is_file():
        shutil.rmtree(capture, ignore_errors=True)
        write_capture(recipe_of(scene), capture, workers=2)
    command = [
        sys.executable,
        "-m",
        "colmap_inertial",
        "reconstruct",
        str(capture / "capture.toml"),
        str(out),
        "--dense",
    ]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return capture, out


def measure(scene: str, work: Path) -> dict[str, object]:
    """All figures of a scene."""
    capture, out = reconstruct(scene, work)
    folder = Workspace(out).dense / "0"
    truth = truth_of(folder, recipe_of(scene), capture / "truth.json")
    result = read_json(out / "result.json")
    dense = result["models"][0]["dense"]
    return {
        "depth": dataclasses.asdict(depth_figures(folder, truth)),
        "within_two_sigma_by_decile": sigma_coverage(folder, truth),
        "fused": dataclasses.asdict(surface_figures(points_of(out / dense["fused"]), truth)),
        "mesh": dataclasses.asdict(surface_figures(points_of(out / dense["mesh"]), truth)),
        "points": dense["points"],
        "faces": dense["faces"],
        "coverage": dense["coverage"],
        "seconds": {k: v for k, v in result["seconds"].items() if k.startswith("dense_")},
    }


def photo_truth(world: PhotoWorld, depth_m: dict[str, Array]) -> Truth:
    """Of a photographic world whose images have these true depths."""
    points = []
    for depth, turn, centre in zip(depth_m.values(), world.cam_from_world, world.cam_in_world, strict=True):
        y, x = np.indices(depth.shape) + 0.5
        points.append(_on_the_table((world.rays(x, y) * depth[..., None]).reshape(-1, 3) @ turn + centre))
    return Truth(
        depth_m=depth_m,
        metres_per_unit=1.0,
        world_from_model=np.eye(3),
        shift_m=np.zeros(3),
        surface_m=_seen_twice(points),
    )


def measure_photo(world: PhotoWorld, folder: Path) -> dict[str, object]:
    """All figures of a photographic world; what the folder holds is made anew."""
    shutil.rmtree(folder, ignore_errors=True)
    truth = photo_truth(world, world.write_workspace(folder))
    swept = SweptWorkspace(folder, folder / "raw")
    swept.begin(None)
    begin_s = time.process_time()
    swept.sweep(1, lambda: None)
    spent_s = time.process_time() - begin_s
    fused = folder / "fused.ply"
    fuse_maps(
        folder,
        swept.names,
        (fused, folder / "fused.ply.vis"),
        maker="plane sweep",
        kind="geometric",
        scratch=folder / "scratch",
        context=RunContext(num_threads=1),
    )
    return {
        "depth": dataclasses.asdict(depth_figures(folder, truth)),
        "within_two_sigma_by_decile": sigma_coverage(folder, truth),
        "fused": dataclasses.asdict(surface_figures(points_of(fused), truth)),
        "processor_s_per_megapixel": spent_s / sum(v.width * v.height / 1e6 for v in swept.sights.views),
    }


def cost(scene: str, work: Path, width: int) -> dict[str, float]:
    """Seconds and memory of depth maps of pictures so wide, rendered along the same path."""
    capture, out = reconstruct(scene, work)
    recipe, folder = recipe_of(scene), work / f"{scene}_{width}"
    if not (folder / "sparse").is_dir():
        model = read_model(Workspace(out).dense / "0" / "sparse")
        render(model, recipe, capture, folder, width)
    shutil.rmtree(folder / "stereo", ignore_errors=True)
    code = (
        "import sys, tempfile, time\n"
        "from pathlib import Path\n"
        "from colmap_inertial.colmap.dense.sweep_stereo import SweptWorkspace\n"
        "with tempfile.TemporaryDirectory() as raw:\n"
        "    swept = SweptWorkspace(Path(sys.argv[1]), Path(raw) / 'raw')\n"
        "    swept.begin(None)\n"
        "    clock, processor = time.perf_counter(), time.process_time()\n"
        "    swept.sweep(0, lambda: None)\n"
        "    spent = time.perf_counter() - clock, time.process_time() - processor\n"
        # what getrusage says counts the parent's memory, too
        "(peak,) = (l for l in Path('/proc/self/status').read_text().splitlines() if l.startswith('VmHWM'))\n"
        "print(*spent, sum(v.width * v.height for v in swept.sights.views) / 1e6, peak.split()[1])\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(folder)], check=True, capture_output=True, text=True)
    clock, processor, megapixels, kib = (float(word) for word in done.stdout.split())
    return {
        "megapixels_each": megapixels / len(list((folder / "images").iterdir())),
        "clock_s_per_megapixel": clock / megapixels,
        "processor_s_per_megapixel": processor / megapixels,
        "peak_memory_gb": kib * 1024 / 1e9,
    }


def render(model: pycolmap.Reconstruction, recipe: SceneRecipe, capture: Path, folder: Path, width: int) -> None:
    """A dense workspace of some pictures of the model, as wide as asked for, without maps."""
    import cv2

    scene = make_scene(recipe)
    renderer, index = scene.renderer(), {name: i for i, name in enumerate(scene.names)}
    (folder / "images").mkdir(parents=True)
    for camera in model.cameras.values():
        camera.rescale(width / camera.width)
    for image in (model.image(i) for i in model.reg_image_ids()):
        camera = model.camera(image.camera_id)
        if len(list((folder / "images").iterdir())) < COST_IMAGES:
            shutter = dataclasses.replace(recipe.camera, model=_pinhole(camera))
            picture = develop(
                renderer.linear(shutter, scene.motion, float(scene.trigger_s[index[image.name]])),
                shutter,
                np.random.default_rng(0),
            )
            cv2.imwrite(str(folder / "images" / image.name), picture[..., ::-1])
        else:
            model.deregister_frame(image.frame_id)
    partial = folder / "sparse.partial"
    partial.mkdir()
    model.write_binary(str(partial))
    partial.rename(folder / "sparse")


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--cost", nargs="+", type=int, default=[])
    parser.add_argument("--world", choices=("simulated", "photo"), default="simulated")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--widths", nargs="+", type=int, default=[640])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    found: dict[str, object] = {}
    if arguments.world == "photo":
        for seed, width in itertools.product(arguments.seeds, arguments.widths):
            name = f"photo{seed}_{width}"
            found[name] = measure_photo(PhotoWorld.of(seed, width), arguments.folder / name)
            print(name, json.dumps(found[name], indent=1), flush=True)
        arguments.scenes = []
    for scene in arguments.scenes:
        if arguments.cost:
            found[scene] = {width: cost(scene, arguments.folder, width) for width in arguments.cost}
        else:
            found[scene] = measure(scene, arguments.folder)
        print(scene, json.dumps(found[scene], indent=1), flush=True)
    write_report(arguments.json, found)


if __name__ == "__main__":
    main()
