"""Refinement of real recordings, and of real motion and IMUs with synthetic points.

    python -m scripts.studies.refine_real --euroc DATASET FOLDER
    python -m scripts.studies.refine_real --recordings FOLDER [--noise-px 10]
    python -m scripts.studies.refine_real --imu FOLDER [--windows 6] [--seeds 0 1 2] [--readout-ms 20 [--declared]]

``--euroc``: the 100 keyframes of V1_01_easy (DATASET has ``keyframes/``, ``mav0/`` and ``gt/``), matched and mapped by
``reconstruct`` with and without ``--refine inertial``, in FOLDER. Both metric models against motion capture, as
``scripts/studies/check_euroc.py`` compares them: the camera centres' error and that of the scale, and what the
refinement said.

``--recordings`` (a folder of InertialScale, as ``scripts/benchmarks/scale.py`` takes it) has poses and no images: made
points are seen from every eighth pose with ``--noise-px``, as a camera in these places would see them, which holds each
pose to a milliradian and some millimetres, as surely as such poses are known, and the model goes through scale and
refinement as any other. The error of the scale before and after, and how far the refined centres lie from the poses
after one similarity.

``--imu`` (folder of TUM-VI rooms and EuRoC flights) films windows of real motion with their real IMU
(``real_world.py``) and prints of each model, before and after: errors of the path after one similarity, over 1 and
5 s, of rotations and gravity; drift of the scale from the first to the last third; error of the scale, and over its
standard deviation; velocity as written; normalised squares of errors of position and velocity, a third of them (1 where
covariances are right). A recording's own scale is the error that the scale has by the true poses. The summary says how
often intervals of scale and readout have the true value, how often a global shutter was taken for a rolling one, and
what ``--refine auto`` would choose; every window is refined all the same.
"""

import argparse
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from colmap_inertial.core.facts import sentences
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import CameraTrajectory, FrameTiming
from colmap_inertial.inertial.refine.shutter import SHUTTER_LIMITS
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.files import read_json
from colmap_inertial.io.trajectories import read_inertial_scale
from colmap_inertial.model import Model
from colmap_inertial.run.stages.metric import MetricStage
from colmap_inertial.run.stages.refine import RefineStage
from scripts.benchmarks.scale import recordings_in
from scripts.benchmarks.whole import euroc_capture
from scripts.common.bench_report import write_report
from scripts.common.real_scores import covered, scores, select_registered
from scripts.common.real_world import World, film, worlds
from scripts.studies.check_euroc import check, similarity

#: Of the made pictures: one pose of so many, points of each, how many frames on either side see one, and how far (m).
EVERY, POINTS, BESIDE, DEPTH_M = 8, 60, 5, (2.0, 7.0)


def euroc(dataset: Path, folder: Path) -> None:
    """V1_01 mapped by this code, with and without the refinement."""
    capture, _ = euroc_capture(dataset, folder)
    out, found = folder / "out", {}
    # the second run goes on from what the first one mapped
    for refine in ("off", "inertial"):
        command = [sys.executable, "-m", "colmap_inertial", "reconstruct", capture, out, "--deterministic"]
        subprocess.run([*map(str, command), "--refine", refine], check=True, stdout=subprocess.DEVNULL)
        found[refine] = one = check(out / "sparse" / "0", dataset)
        told: list[dict[str, Any]] = read_json(out / "result.json")["models"][0]["treatments"]
        said = "; ".join(each["reason"] for each in told if each["stage"] == "refine")
        print(
            f"--refine {refine}: {one['registered_images']} images, centres {1e3 * one['centre_rms_m']:.2f} mm off, "
            f"scale {one['scale_error_pct']:+.3f} %. {said}",
            flush=True,
        )
    off, on = found["off"], found["inertial"]
    farther = abs(on["scale_error_pct"]) - abs(off["scale_error_pct"])
    ratio = on["centre_rms_m"] / off["centre_rms_m"]
    print(f"centres' error {ratio:.3f} of that without, scale {farther:+.3f} % farther from the truth")


def seen_from(path: CameraTrajectory, metres: float, noise_px: float, seed: int) -> pycolmap.Reconstruction:
    """A model of poses and of made points around them."""
    rng, count = np.random.default_rng(seed), len(path.names)
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=1280, height=960, params=[1000.0, 1000.0, 640.0, 480.0]
    )
    rotation, centre = matrix_from_quat(path.cam_from_world_xyzw), path.cam_in_world
    keypoints: list[list[np.ndarray]] = [[] for _ in range(count)]
    points, tracks = [], []
    for i in np.repeat(np.arange(count), POINTS).tolist():
        ray = np.append((rng.uniform([5, 5], [1275, 955]) - [640, 480]) / 1000, 1.0)
        point = centre[i] + rotation[i].T @ ray * rng.uniform(*DEPTH_M) / metres
        track = pycolmap.Track()
        for j in range(max(0, i - BESIDE), min(count, i + BESIDE + 1)):
            in_cam = rotation[j] @ (point - centre[j])
            xy = camera.img_from_cam(in_cam) if in_cam[2] > 0.1 / metres else None
            if xy is not None and (xy > 0).all() and (xy < [1280, 960]).all():
                track.add_element(j + 1, len(keypoints[j]))
                keypoints[j].append(xy + noise_px * rng.standard_normal(2))
        points.append(point)
        tracks.append(track)
    built = pycolmap.Reconstruction()
    built.add_camera_with_trivial_rig(camera)
    for j, name in enumerate(path.names):
        image = pycolmap.Image(name=name, keypoints=np.array(keypoints[j]), camera_id=1, image_id=j + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation[j]), -rotation[j] @ centre[j])
        built.add_image_with_trivial_frame(image, pose)
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 2:
            built.add_point3D(point, track)
    return built


def recording(folder: Path, noise_px: float) -> None:
    """One recording of poses, before and after."""
    path, imu = read_inertial_scale(folder)
    path = path.select(np.arange(len(path.names)) % EVERY == 0)
    metres = float((folder / "groundtruth.txt").read_text())
    timing = FrameTiming(names=path.names, t_s=path.t_s, readout_s=0.0, epoch_ns=path.epoch_ns)
    prior = calibration_prior()
    model = Model(reconstruction=seen_from(path, metres, noise_px, 0), colmap_index=0, timing=timing)
    model = MetricStage(imu=imu, calibration=prior)(model)
    if model.similarity is None:
        print(f"{folder.name}: its scale is refused", flush=True)
        return
    refined = RefineStage(imu=imu, calibration=prior, refine_intrinsics=False)(model)
    said = refined.treatments[-1]
    errors, centres = [], []
    for one in (model, refined):
        images = sorted((one.reconstruction.image(i) for i in one.reconstruction.reg_image_ids()), key=_number)
        centres.append(np.array([image.projection_center() for image in images]))
        errors.append(100 * (1 / similarity(centres[-1], metres * path.cam_in_world)[0] - 1))
    scale, rotation, shift = similarity(centres[1], centres[0])
    moved = np.linalg.norm(scale * centres[1] @ rotation.T + shift - centres[0], axis=1)
    print(
        f"{folder.name}: {len(path.names)} poses, scale off by {errors[0]:+.2f} -> {errors[1]:+.2f} %; "
        f"moved by {1e3 * float(np.sqrt(np.mean(moved**2))):.1f} mm; {said.reason}",
        flush=True,
    )


def filmed_window(asked: argparse.Namespace, world: World) -> dict[str, Any]:
    """One window through scale and refinement."""
    filmed = film(asked.imu, world)
    timing = replace(filmed.timing, readout_s=world.readout_s) if asked.declared else filmed.timing
    prior = calibration_prior(Declared(readout_s=world.readout_s) if asked.declared and world.readout_s else None)
    model = Model(reconstruction=filmed.model, colmap_index=0, timing=timing)
    stages = {"imu": filmed.imu, "calibration": prior}
    model = MetricStage(**stages)(model)
    out: dict[str, Any] = {"recording": world.recording, "begin_s": world.begin_s, "seed": world.seed}
    out["recording_pct"] = 100 * filmed.recording_log
    if model.similarity is None:
        return out | {"said": "; ".join(sentences(model.scale.reasons))}
    out["shutter_ms"] = [1e3 * done.values["readout_s"] for done in model.treatments if done.stage == "shutter"]
    filmed = select_registered(model, filmed)
    out["before"] = scores(model, filmed) | covered(model, filmed)
    begin_s, processor_s = time.perf_counter(), time.process_time()
    refined = RefineStage(**stages, refine_intrinsics=True, auto=True)(model)
    out["auto"] = refined.treatments[-1].values.get("expected")
    out["declined"] = bool(out["auto"]) and "sigma_px" not in refined.treatments[-1].values
    if out["declined"]:
        # what it would have done, to judge the choice
        begin_s, processor_s = time.perf_counter(), time.process_time()
        refined = RefineStage(**stages, refine_intrinsics=True)(model)
    out["wall_s"], out["cpu_s"] = time.perf_counter() - begin_s, time.process_time() - processor_s
    said = refined.treatments[-1]
    out["readout"] = _readout(said.values, world.readout_s, declared=asked.declared)
    out |= {"said": str(said.reason), "accepted": said.action == "refined", "values": said.values}
    if out["accepted"]:
        out["after"] = scores(refined, filmed) | covered(refined, filmed)
        lever = np.array(said.values["imu_in_cam_m"]) - filmed.imu_in_cam_m
        out["lever_mm"] = 1e3 * float(np.linalg.norm(lever))
        out["lever_z"] = (lever / said.values["imu_in_cam_sigma_m"]).tolist()
    return out


def _readout(values: dict[str, Any], true_s: float, *, declared: bool) -> dict[str, Any]:
    """Whether a readout was found, its error over its standard deviation, and whether the interval has the true one."""
    found_s = float(values.get("readout_s", 0.0))
    changed = abs(found_s) >= SHUTTER_LIMITS.least_s
    if not changed:
        return {"changed": False, "z": None, "inside": true_s == 0 and not declared}
    z = (found_s - true_s) / float(values["readout_sigma_s"])
    return {"changed": True, "z": z, "inside": abs(z) <= Z95}


#: Of the table: columns of scores, and how they are shown.
COLUMNS = {
    "path_mm": "6.1f",
    "over_1_s_mm": "5.1f",
    "over_5_s_mm": "6.1f",
    "rotation_deg": "5.2f",
    "gravity_deg": "5.2f",
    "drift_pct": "6.2f",
    "scale_pct": "6.2f",
    "scale_z": "5.1f",
    "verdict": "7s",
    "velocity_mm_s": "5.0f",
    "position_nees": "6.1f",
    "velocity_nees": "6.1f",
    "rotation_nees": "6.1f",
}


def real_imus(asked: argparse.Namespace) -> None:
    """Windows of real motion and real IMUs, before and after."""
    options = {"readout_s": 1e-3 * asked.readout_ms, "loops": asked.loops}
    found = worlds(asked.imu, asked.length, 6 if asked.quick else asked.windows, **options)
    results = []
    print(f"{'':31}" + " ".join(f"{name:>{max(7, len(name))}}" for name in COLUMNS))
    for world in found:
        for seed in asked.seeds:
            one = filmed_window(asked, replace(world, seed=seed))
            results.append(one)
            for when in ("before", "after"):
                if when in one:
                    told = (f"{one[when][n]:{f}}".rjust(max(7, len(n))) for n, f in COLUMNS.items())
                    print(f"{world.recording:5} {world.begin_s:6.1f} {seed:2} {when:>6}{'':8}" + " ".join(told))
            print(
                f"    own scale {one['recording_pct']:+.2f} %, lever {one.get('lever_mm', np.nan):.0f} "
                f"mm, {one.get('wall_s', 0):.1f} s, {one.get('cpu_s', 0):.1f} s of CPU; {one['said']}",
                flush=True,
            )
    summarise(results, 1e-3 * asked.readout_ms)
    if asked.json:
        write_report(asked.json, {"windows": results})


def summarise(results: list[dict[str, Any]], readout_s: float) -> None:
    """What all windows come to."""
    judged = [one for one in results if "before" in one]
    good = [one for one in judged if one["accepted"]]
    shutters_ms = [shutter_ms for one in judged for shutter_ms in one["shutter_ms"]]
    span = f": {min(shutters_ms):.1f} to {max(shutters_ms):.1f} ms" if shutters_ms else ""
    print(f"rolling shutter found before the refinement in {len(shutters_ms)} of {len(judged)}{span}")
    ratio = np.array([one["before"]["path_mm"] / one["after"]["path_mm"] for one in good])
    if len(good):
        print(
            f"accepted {len(good)} of {len(results)}; path {np.median(ratio):.2f} times closer, worst "
            f"{ratio.min():.2f}; more than 1.2 times farther: {int(np.sum(ratio < 1 / 1.2))}"
        )
    for name, when, some in (("before, all", "before", judged), ("before", "before", good), ("after", "after", good)):
        if some:
            _summarise_scores(name, [one[when] for one in some])
    declined = [one for one in judged if one["declined"]]
    missed = sum(one["accepted"] and one["before"]["path_mm"] > 1.05 * one["after"]["path_mm"] for one in declined)
    chosen = [one for one in judged if not one["declined"]]
    worse = sum(one["accepted"] and one["after"]["path_mm"] > 1.05 * one["before"]["path_mm"] for one in chosen)
    print(
        f"auto: refines {len(chosen)} of {len(judged)}, {worse} of them more than 1.05 times farther; "
        f"of {len(declined)} left as they are {missed} would have come closer"
    )
    readouts = [one["readout"] for one in judged]
    changed = [one for one in readouts if one["changed"]]
    if changed:
        z = np.array([one["z"] for one in changed])
        print(f"readout found in {len(changed)}: {np.sqrt(np.mean(z**2)):.2f} sigma rms")
    print(
        f"readout inside 95 %: {sum(one['inside'] for one in readouts)} of {len(readouts)}"
        + ("" if readout_s else f"; global shutters changed: {len(changed)}")
    )
    own = np.array([one["recording_pct"] for one in good])
    lever = np.concatenate([one["lever_z"] for one in good]) if good else np.zeros(0)
    if len(good):
        print(f"recordings' own {np.sqrt(np.mean(own**2)):.2f} % rms; lever {np.sqrt(np.mean(lever**2)):.2f} sigma rms")


def _summarise_scores(name: str, of: list[dict[str, Any]]) -> None:
    scale = np.array([one["scale_pct"] for one in of])
    trusted = np.array([one["verdict"] == "trusted" for one in of])
    own = np.sqrt(np.mean(scale[trusted] ** 2)) if trusted.any() else np.nan
    medians = {column: float(np.median([one[column] for one in of])) for column, f in COLUMNS.items() if f[-1] == "f"}
    means = {n: float(np.mean([one[n] for one in of])) for n in of[0] if n.endswith(("_nees", "_inside"))}
    inside = np.array([one["inside"] for one in of])
    print(
        f"{name}: scale {np.sqrt(np.mean(scale**2)):.2f} % rms, inside 95 % {inside.sum()} of {len(of)} "
        f"({int(trusted.sum())} trusted {own:.2f} %, {inside[trusted].sum()} inside), medians "
        + ", ".join(f"{column} {value:.3g}" for column, value in medians.items())
        + "; means "
        + ", ".join(f"{column} {value:.2f}" for column, value in means.items())
    )


def _number(image: pycolmap.Image) -> int:
    return int(image.name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--euroc", type=Path, nargs=2, metavar=("DATASET", "FOLDER"))
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--noise-px", type=float, default=10.0)
    parser.add_argument("--imu", type=Path, help="folder of real IMUs with motion capture")
    parser.add_argument("--windows", type=int, default=100)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--length", type=float, default=30.0, help="of a window, s")
    parser.add_argument("--readout-ms", type=float, default=0.0)
    parser.add_argument("--declared", action="store_true", help="the readout is known")
    parser.add_argument("--loops", action="store_true", help="points are seen again")
    parser.add_argument("--quick", action="store_true", help="six windows")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    if asked.imu:
        real_imus(asked)
    if asked.euroc:
        euroc(*asked.euroc)
    if asked.recordings:
        for folder in recordings_in(asked.recordings):
            recording(folder, asked.noise_px)


if __name__ == "__main__":
    main()
