"""Quality and cost of multi-aperture fusion, against other methods.

    python -m scripts.benchmarks.multi_aperture [--data FOLDER] [--only SECTION ...] [--work FOLDER] [--json FILE]

FOLDER holds ``antinous`` (a light field with the disparity of its middle view) and ``cones`` (a stereo pair); sections
whose data are not there are left out.

Sections:

``antinous``
    Red, green, blue and luminance from the middle view and three views 2 steps, then 4 steps away, clean and with 2 %
    noise; the reference is red, then green. Gains of the fused picture in PSNR over direct fusion (dB) over the whole
    image and over the pixels that all views see, and the share of those pixels whose disparity is off by more than
    1 px of the 2-step baseline (%). Four views at once with census and with mutual information, the same pair by pair,
    OpenCV's StereoSGBM on the rectified pair, and the true disparity with what it does not see filled or not.
``graph_cuts``
    On a crop: the same costs by semi-global matching and by alpha-expansion.
``cones``
    One channel of each view against another of the other view, all six ways, and StereoSGBM on the grey pair: pixels
    off by more than 1 px (%), of those that both views see.
``simulated``
    A capture of the simulator, four apertures 10 mm apart, f = 1000 px, about 0.8 m before the subject: fused frames
    and true RGB frames in COLMAP, and depths against the truth.
``cost``
    One exposure of 1 megapixel and 64 candidates, by number of views; also at the package's default spacing.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
import time
import zlib  # noqa: F401 (before pycolmap)
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from colmap_inertial.core.arrays import AnyArray, Array, BoolArray, Float32Array, UInt8Array
from colmap_inertial.core.options import ApertureOptions, FuseAperturesOptions
from colmap_inertial.core.types import Aperture, ApertureRig, CameraModel
from colmap_inertial.imaging import semi_global
from colmap_inertial.imaging.multi_aperture import (
    _volume as volume,
    estimate_disparity,
    fuse_apertures,
    fuse_with,
    plane_of,
)
from colmap_inertial.imaging.multi_aperture.disparity import Disparity
from colmap_inertial.run.commands.images_alone import fuse_aperture_capture
from colmap_inertial.tools.simulate import MotionOptions, SceneRecipe, ShutterCamera, make_scene
from colmap_inertial.tools.simulate.aperture_array import write_aperture_capture
from scripts.common.aperture_baselines import (
    as_disparity,
    canvas_of,
    direct,
    expansion_moves,
    opencv_disparity,
    pairwise,
    psnr_db,
    read_pfm,
    warp_view,
)
from scripts.common.bench_report import write_report

SECTIONS = ("antinous", "graph_cuts", "cones", "simulated", "cost")
FLAT = np.array([0.0, 0.0, 0.0, 1.0])
#: Candidates reach a little beyond the truth; the package's own search for the range is measured beside it.
MARGIN_PX = 0.5


def rig_of(
    roles: Sequence[str], places: Sequence[tuple[float, float]], width: int, height: int, baseline_m: float = 0.01
) -> ApertureRig:
    camera = CameraModel(model="PINHOLE", width=width, height=height, params=(1000.0, 1000.0, width / 2, height / 2))
    return ApertureRig(
        apertures=tuple(
            Aperture(
                name=f"{i}_{role}",
                role=role,  # type: ignore[arg-type]
                camera=camera,
                cam_from_rig_xyzw=FLAT,
                cam_in_rig=baseline_m * np.array([*place, 0.0]),
            )
            for i, (role, place) in enumerate(zip(roles, places, strict=True))
        )
    )


# --- light field ----------------------------------------------------------------------------------------------------


def light_field(
    folder: Path, step: int, roles: str, noise: float, seed: int = 0
) -> tuple[list[UInt8Array], ApertureRig, UInt8Array, Array, BoolArray]:
    """Planes, rig, the reference's colours, its disparity to the partner, and which pixels all views see."""
    names = {"R": "red", "G": "green", "B": "blue", "L": "luminance"}
    places = ((0, 0), (1, 0), (0, 1), (1, 1))
    rig = rig_of([names[r] for r in roles], places, 512, 512)
    rng = np.random.default_rng(seed)
    planes, colours = [], None
    for aperture, (x, y) in zip(rig.apertures, places, strict=True):
        path = folder / f"input_Cam{9 * (4 + step * y) + 4 + step * x:03d}.png"
        picture = cv2.imread(str(path))[..., ::-1]
        colours = picture if colours is None else colours
        plane = plane_of(picture, aperture.role).astype(float)
        if noise:
            plane = plane + rng.normal(0, 255 * noise, plane.shape)
        planes.append(np.clip(np.rint(plane), 0, 255).astype(np.uint8))
    truth = step * read_pfm(folder / "gt_disp_lowres.pfm")
    everywhere = np.all([warp_view(truth, y, x, 0.5) for x, y in places[1:]], axis=0)
    assert colours is not None
    return planes, rig, np.ascontiguousarray(colours), truth, everywhere


def bench_antinous(folder: Path) -> list[dict[str, Any]]:
    rows = []
    for noise in (0.0, 0.02):
        for step in (2, 4):
            for roles in ("RGBL", "GRBL"):
                rows += antinous_case(folder, step, roles, noise)
    return rows


def antinous_case(folder: Path, step: int, roles: str, noise: float) -> list[dict[str, Any]]:
    planes, rig, wanted, truth, seen = light_field(folder, step, roles, noise)
    base = direct(planes, rig)
    canvas = canvas_of(rig)
    limits = (float(truth.min()) - MARGIN_PX, float(truth.max()) + MARGIN_PX)
    rows = []

    def row(way: str, image: AnyArray, disparities: list[AnyArray] | None, seconds: float | None) -> None:
        wrong = None
        if disparities is not None:
            far = [100 * float((np.abs(d - truth)[seen] * 2 / step > 1).mean()) for d in disparities]
            wrong = float(np.mean(far))
        rows.append(
            {
                "step": step,
                "roles": roles,
                "noise": noise,
                "way": way,
                "gain_all_db": psnr_db(image, wanted) - psnr_db(base, wanted),
                "gain_seen_db": psnr_db(image, wanted, seen) - psnr_db(base, wanted, seen),
                "psnr_all_db": psnr_db(image, wanted),
                "wrong_pct": wrong,
                "seconds": seconds,
            }
        )

    row("direct", base, None, None)
    for light in (True, False) if noise else (True,):
        suffix = "" if light else ", no luminance"
        for cost in ("census", "mutual-information"):
            options = ApertureOptions(
                cost=cost,  # type: ignore[arg-type]
                disparity_px=limits,
                use_luminance=light,
                luminance_cost=False,
            )
            start = time.perf_counter()
            fused = fuse_apertures(planes, rig, canvas, options)
            row(f"four views, {cost}{suffix}", fused.image, [fused.disparity_px], time.perf_counter() - start)
            start = time.perf_counter()
            image, maps = pairwise(planes, rig, options)
            row(f"pair by pair, {cost}{suffix}", image, maps, time.perf_counter() - start)
    fused = fuse_apertures(planes, rig, canvas, ApertureOptions(cost="mutual-information", disparity_px=limits))
    row("four views, mutual-information and luminance cost", fused.image, [fused.disparity_px], None)
    start = time.perf_counter()
    fused = fuse_apertures(planes, rig, canvas, ApertureOptions(disparity_px=limits))
    seconds = time.perf_counter() - start
    row("four views, census and luminance cost", fused.image, [fused.disparity_px], seconds)
    fused = fuse_apertures(planes, rig, canvas)
    row("the same, range found (the default)", fused.image, [fused.disparity_px], None)
    start = time.perf_counter()
    found = opencv_disparity(planes[0], planes[1], *limits)
    image = fuse_with(planes, rig, canvas, as_disparity(found, 3)).image
    row("StereoSGBM", image, [found], time.perf_counter() - start)
    exact = truth.astype(np.float32)
    row("truth, not filled", fuse_with(planes, rig, canvas, as_disparity(exact, 3)).image, None, None)
    visible = np.stack([warp_view(truth, y, x, 0.5) for x, y in ((1, 0), (0, 1), (1, 1))])
    filled = Disparity(disparity_px=exact, measured=visible.any(axis=0), visible=visible)
    row("truth, filled", fuse_with(planes, rig, canvas, filled).image, None, None)
    return rows


def bench_graph_cuts(folder: Path) -> list[dict[str, Any]]:
    """Both ways to choose disparities on one crop, by the same costs and penalties."""
    from colmap_inertial._kernels import _apertures

    planes, rig, _, truth, seen = light_field(folder, 2, "RGBL", 0.0)
    canvas = canvas_of(rig)
    crop = (slice(150, 310), slice(180, 340))
    spaced = volume.candidates(float(truth.min()), float(truth.max()), 0.5)
    columns, rows = canvas.sample_positions(spaced)
    cost = np.empty((512, 512, len(spaced)), dtype=np.uint8)
    _apertures.matching_costs(
        planes[0],
        np.stack(planes[1:]),
        columns=columns,
        rows=rows,
        cost=cost,
        share=semi_global.shares(3),
        unseen=18,
        radius=2,
    )
    part, guide = np.ascontiguousarray(cost[crop]), np.ascontiguousarray(planes[0][crop])
    small, jump = semi_global.jump_table(3)
    total = np.empty((*guide.shape, -(-len(spaced) // 32) * 32), dtype=np.uint16)
    start = time.perf_counter()
    _apertures.semi_global(part, guide, small=small, jump=jump, total=total)
    of_paths, paths_s = total[..., : len(spaced)].argmin(axis=-1), time.perf_counter() - start
    start = time.perf_counter()
    of_cuts, cuts_s = expansion_moves(part, guide, small=small, jump=jump), time.perf_counter() - start
    out = []
    for way, labels, seconds in (("semi-global", of_paths, paths_s), ("graph cuts", of_cuts, cuts_s)):
        error = np.abs(spaced[labels] - truth[crop])[seen[crop]]
        out.append(
            {
                "way": way,
                "wrong_pct": 100 * float((error > 1).mean()),
                "mean_px": float(error.mean()),
                "seconds": seconds,
            }
        )
    return out


# --- stereo pair ----------------------------------------------------------------------------------------------------


def bench_cones(folder: Path) -> list[dict[str, Any]]:
    left, right = (cv2.imread(str(folder / f"im{i}.ppm"))[..., ::-1] for i in (2, 6))
    truth, other = (cv2.imread(str(folder / f"disp{i}.pgm"), cv2.IMREAD_UNCHANGED) / 4.0 for i in (2, 6))
    height, width = truth.shape
    x = np.arange(width)[None]
    there = np.rint(x - truth).astype(int)
    back = np.take_along_axis(other, np.clip(there, 0, width - 1), axis=1)
    known = truth > 0
    seen = known & (there >= 0) & (back > 0) & (np.abs(back - truth) <= 1)
    rows: list[dict[str, Any]] = []

    def row(way: str, found: AnyArray, measured: BoolArray | None = None) -> None:
        wrong = np.abs(found - truth) > 1
        both = seen if measured is None else seen & measured
        rows.append(
            {
                "way": way,
                "wrong_seen_pct": 100 * float(wrong[seen].mean()),
                "wrong_known_pct": 100 * float(wrong[known].mean()),
                "measured_pct": None if measured is None else 100 * float(measured[seen].mean()),
                "wrong_measured_pct": None if measured is None else 100 * float(wrong[both].mean()),
            }
        )

    limits = (0.0, 64.0)
    grey = [cv2.cvtColor(p, cv2.COLOR_RGB2GRAY) for p in (left, right)]
    row("StereoSGBM, grey", opencv_disparity(grey[0], grey[1], *limits))

    def ours(first: UInt8Array, second: UInt8Array, cost: str) -> tuple[Float32Array, BoolArray]:
        rig = rig_of(("other", "other"), ((0, 0), (1, 0)), width, height)
        options = ApertureOptions(cost=cost, disparity_px=limits)  # type: ignore[arg-type]
        found = estimate_disparity([first, second], canvas_of(rig), options)
        return found.disparity_px, found.measured

    row("census, grey", *ours(grey[0], grey[1], "census"))
    for cost in ("census", "mutual-information"):
        of_cost = []
        for i in range(3):
            for j in range(3):
                if i != j:
                    channels = [np.ascontiguousarray(p[..., c]) for p, c in ((left, i), (right, j))]
                    row(f"{cost}, {'RGB'[i]} and {'RGB'[j]}", *ours(channels[0], channels[1], cost))
                    of_cost.append(rows[-1])
        mean = {k: float(np.mean([r[k] for r in of_cost])) for k in rows[-1] if k != "way"}
        rows.append({"way": f"{cost}, channels split, mean", **mean})
    channels = [np.ascontiguousarray(p[..., c]) for p, c in ((left, 0), (right, 1))]
    row("StereoSGBM, R and G", opencv_disparity(channels[0], channels[1], *limits))
    return rows


# --- simulator and COLMAP -------------------------------------------------------------------------------------------


def simulated_recipe() -> SceneRecipe:
    model = CameraModel(
        model="OPENCV", width=560, height=420, params=(1000.0, 1000.0, 280.0, 210.0, 0.05, -0.08, 0.0005, -0.0003)
    )
    motion = MotionOptions(duration_s=6.0, radius_m=0.69, height_m=0.4, arc_deg=60.0, sweep_s=6.0)
    return SceneRecipe(
        format="png", camera=ShutterCamera(model=model, exposure_s=0.001), motion=motion, frame_rate_hz=2.0
    )


def bench_simulated(work: Path) -> dict[str, Any]:
    recipe = simulated_recipe()
    capture = work / "capture"
    if not (capture / "capture.toml").is_file():
        shutil.rmtree(capture, ignore_errors=True)
        write_aperture_capture(recipe, capture, workers=len(os.sched_getaffinity(0)))
    fused = work / "fused"
    shutil.rmtree(fused, ignore_errors=True)
    start = time.perf_counter()
    pictures = fuse_aperture_capture(
        capture, fused, FuseAperturesOptions(fusion=ApertureOptions(depth=True)), progress=lambda *_: None
    )
    seconds = (time.perf_counter() - start) / len(pictures)
    unfused = work / "unfused"
    shutil.rmtree(unfused, ignore_errors=True)
    unfused.mkdir()
    for path in pictures:
        parts = [cv2.imread(str(capture / f / path.name), 0) for f in ("frames_blue", "frames", "frames_red")]
        cv2.imwrite(str(unfused / path.name), np.stack(parts, axis=-1))
    models = {
        "fused": mapped(fused / "images", recipe, work),
        "true RGB": mapped(capture / "frames_rgb", recipe, work),
        "direct": mapped(unfused, recipe, work),
    }
    scene = make_scene(replace(recipe, rig={}))
    renderer = scene.renderer()
    errors, measured, gains = [], [], []
    for i, path in enumerate(pictures):
        depth = np.load(fused / "depth" / f"{path.name}.npy")
        truth = renderer.depth_m(recipe.camera, scene.motion, recipe.camera.middle_s(float(scene.trigger_s[i])))
        with np.errstate(invalid="ignore"):
            error = np.abs(depth / truth - 1)
        near = truth < 1.5
        errors.append((error[np.isfinite(error)], error[np.isfinite(error) & near]))
        measured.append(float(np.isfinite(depth).mean()))
        rgb = cv2.imread(str(capture / "frames_rgb" / path.name))
        gains.append(psnr_db(cv2.imread(str(path)), rgb) - psnr_db(cv2.imread(str(unfused / path.name)), rgb))
    every, near = (np.concatenate([e[i] for e in errors]) for i in (0, 1))
    return {
        "models": models,
        "points_vs_true_rgb_pct": 100 * models["fused"]["points"] / max(1, models["true RGB"]["points"]),
        "same_images": models["fused"]["images"] == models["true RGB"]["images"],
        "depth_error_median_pct": 100 * float(np.median(every)),
        "depth_error_median_within_1_5_m_pct": 100 * float(np.median(near)),
        "depth_measured_pct": 100 * float(np.mean(measured)),
        "gain_over_direct_db": float(np.mean(gains)),
        "seconds_a_frame": seconds,
    }


def mapped(images: Path, recipe: SceneRecipe, work: Path) -> dict[str, Any]:
    """COLMAP at its defaults with the known camera, one thread and one seed."""
    folder = Path(tempfile.mkdtemp(dir=work))
    database = folder / "database.db"
    model = recipe.camera.model
    reader = pycolmap.ImageReaderOptions(camera_model=model.model, camera_params=",".join(map(str, model.params)))
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(0)
    pycolmap.extract_features(
        database, images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader, device=pycolmap.Device.cpu
    )
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions(
        ba_refine_focal_length=False, ba_refine_principal_point=False, ba_refine_extra_params=False, num_threads=1
    )
    models = pycolmap.incremental_mapping(database, images, folder, options)
    best = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    result = {
        "images": [] if best is None else sorted(image.name for image in best.images.values() if image.has_pose),
        "points": 0 if best is None else best.num_points3D(),
        "error_px": None if best is None else best.compute_mean_reprojection_error(),
        "models": len(models),
    }
    shutil.rmtree(folder)
    return result


# --- cost -----------------------------------------------------------------------------------------------------------


def bench_cost() -> list[dict[str, Any]]:
    """A textured wall of steps, so that every candidate is some pixel's."""
    rng = np.random.default_rng(0)
    side = 1000
    pattern = sum(s * cv2.GaussianBlur(rng.normal(size=(side, side + 128)), (0, 0), s) for s in (1.5, 3, 8))
    pattern = np.clip(128 + 45 * pattern / np.std(pattern), 0, 255).astype(np.uint8)
    truth = np.repeat(np.arange(side) * 60 // side, 1).astype(int)  # by row
    places = ((0, 0), (1, 0), (0.5, 0), (0.75, 0))
    planes = []
    for x, _ in places:
        at = np.arange(side)[None] + np.rint(x * truth).astype(int)[:, None]
        planes.append(np.take_along_axis(pattern, at, axis=1))
    rows = []
    for step, limits in ((1.0, (0.0, 61.0)), (0.5, (0.0, 61.0))):
        number = len(volume.candidates(*limits, step))
        for views in (2, 3, 4):
            rig = rig_of(("green", "red", "blue", "luminance")[:views], places[:views], side, side)
            canvas = canvas_of(rig)
            options = ApertureOptions(step_px=step, disparity_px=limits)
            for threads in (1, 2):
                timed = replace(options, threads=threads)
                matching = best_of(lambda c=canvas, o=timed, v=views: estimate_disparity(planes[:v], c, o))
                whole: tuple[float | None, float | None] = (None, None)
                if views == 4:
                    whole = best_of(lambda r=rig, c=canvas, o=timed: fuse_apertures(planes, r, c, o))
                rows.append(
                    {
                        "candidates": number,
                        "step_px": step,
                        "views": views,
                        "threads": threads,
                        "matching_s": matching[0],
                        "matching_cpu_s": matching[1],
                        "fusion_s": whole[0],
                        "fusion_cpu_s": whole[1],
                        "volumes_mib": semi_global.strips(side, side * 3 * number)[0][3] * side * 3 * number / 2**20,
                    }
                )
    return rows


def best_of(work: Any, runs: int = 4) -> tuple[float, float]:
    """Least wall time and least processor time of some runs, s; the latter hardly depends on what else is running."""
    walls, processors = [], []
    for _ in range(runs):
        wall, processor = time.perf_counter(), time.process_time()
        work()
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    return min(walls), min(processors)


# --- report ---------------------------------------------------------------------------------------------------------


def show(title: str, rows: list[dict[str, Any]]) -> None:
    print(f"\n{title}")
    keys = list(rows[0])

    def cell(value: object) -> str:
        return "-" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)

    table = [keys, *[[cell(r.get(k)) for k in keys] for r in rows]]
    widths = [max(len(line[i]) for line in table) for i in range(len(keys))]
    for line in table:
        print("  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).resolve().parents[3] / "shared" / "data" / "multi_aperture"
    parser.add_argument("--data", type=Path, default=default)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--work", type=Path, help="keeps the simulated capture for the next run")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    out: dict[str, Any] = {}
    antinous = arguments.data / "antinous"
    cones = next(
        (f for f in (arguments.data / "cones", arguments.data / "middlebury_2003" / "cones") if f.is_dir()), None
    )
    if "antinous" in arguments.only and antinous.is_dir():
        out["antinous"] = bench_antinous(antinous)
        show("antinous", out["antinous"])
    if "graph_cuts" in arguments.only and antinous.is_dir():
        out["graph_cuts"] = bench_graph_cuts(antinous)
        show("graph cuts", out["graph_cuts"])
    if "cones" in arguments.only and cones is not None:
        out["cones"] = bench_cones(cones)
        show("cones", out["cones"])
    if "simulated" in arguments.only:
        with tempfile.TemporaryDirectory() as scratch:
            work = arguments.work or Path(scratch)
            work.mkdir(parents=True, exist_ok=True)
            out["simulated"] = bench_simulated(work)
        print("\nsimulated")
        print(json.dumps(out["simulated"], indent=1))
    if "cost" in arguments.only:
        out["cost"] = bench_cost()
        show("cost", out["cost"])
    write_report(arguments.json, out)


if __name__ == "__main__":
    main()
