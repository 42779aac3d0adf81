"""Refinement of simulated walks: camera centres, drift of scale, calibration.

    python -m scripts.studies.refine [--metres 100] [--readout-ms 0] [--undeclared] [--expected] [--seeds 1 2]
        [--chance] [--auto] [--spoil late] [--points-per-m 250] [--mapper] [--out F]
    python -m scripts.studies.refine --loop [--seeds 1 2]

Points beside the way are tracked as features are (no pictures are rendered), and COLMAP's own bundle adjustment makes
the model of them: the start, which drifts as real models do. With a readout, keypoints are rectified and the model goes
through the readout's stage first, as in a run. ``--undeclared``: nobody says so, and keypoints stay as they are.
``--loop``: around a ring and back, where each point is known again.

Errors are those of the camera centres after one similarity, in millimetres; drift is the scale of the last third of the
path over that of the first, in per cent; of the calibration, error and normalised error (over its standard deviation).
Seconds are the processor's (one), memory is the most until then. ``--mapper``: COLMAP's incremental mapper makes the
model, from true matches of all frames that see the same, with the options that ``reconstruct`` gives it. ``--spoil``
falsifies the IMU: another recording's, 30 ms late, an axis of the accelerometer flipped, or 5 % more of it.
``--expected``: a device whose axes and gains are as far off as the refinement's priors have it, and not as a phone's:
what tells whether the rotation's covariance is right.

``--auto`` prints what ``--refine auto`` chooses and expects; every walk is refined all the same, to judge the choice.

``--chance`` prints what the refinement's covariance says of its camera centres after one similarity: the error that is
to be expected, of it and of pictures alone, in millimetres; the normalised error of the path's shape (rms over its 12
weakest ways to bend, 1 where the covariance is right); and how often the refined centres of such a walk lie more than
1.1 times as far off as COLMAP's by chance: COLMAP's error is the refinement's and one that is independent of it.
"""

import argparse
import json
import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.mapping.mapper import map_images
from colmap_inertial.core.facts import sentences
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, quat_multiply, so3_log
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.types import CAL, CameraImuCalibration, ImuRecording
from colmap_inertial.inertial.core.priors import PRIORS
from colmap_inertial.inertial.refine._residuals import moving
from colmap_inertial.inertial.refine.pictures import apply_noise, measure_image_noise, pictures_alone
from colmap_inertial.inertial.refine.setup import (
    make_problem,
    move_to_middle_lines,
    read_seen,
)
from colmap_inertial.inertial.refine.solve import factor_information, solve
from colmap_inertial.inertial.refine.values import ACCEL_DENSITY, GYRO_DENSITY, Estimate, Problem
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.model import Model
from colmap_inertial.run.stages.imaging_plan import GyroView
from colmap_inertial.run.stages.metric import MetricStage
from colmap_inertial.run.stages.readout import ReadoutStage
from colmap_inertial.run.stages.refine import RefineStage
from colmap_inertial.run.stages.rolling_shutter import RollingShutterStage
from colmap_inertial.tools.simulate.motion import MotionOptions
from colmap_inertial.tools.simulate.tracks import TrackOptions, Tracks, simulate_tracks
from scripts.studies.check_euroc import similarity

#: Of an IMU that is late.
LATE_S = 0.03
#: Of what is to be expected: frames whose centres are looked at, ways to bend, draws.
CENTRES, WAYS, DRAWS = 200, 12, 2000


def adjusted(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """COLMAP's bundle adjustment of all that there is."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False
    solver = getattr(options, "ceres", options)
    solver.solver_options.num_threads = 1
    solver.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    # beyond 1000 images COLMAP takes conjugate gradients, which along a chain hardly move
    solver.max_num_images_direct_sparse_cpu_solver = max(
        solver.max_num_images_direct_sparse_cpu_solver, model.num_reg_images()
    )
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    return model


def by_mapper(tracks: Tracks, xy_px: np.ndarray) -> pycolmap.Reconstruction:
    """The largest model that COLMAP's mapper makes, the camera known."""
    with tempfile.TemporaryDirectory() as folder:
        database, sparse = Path(folder) / "database.db", Path(folder) / "sparse"
        tracks.write_database(database, xy_px)
        context = RunContext(scratch=Path(folder), num_threads=1)
        map_images(
            database,
            Path(folder),
            sparse,
            MappingOptions(refine_intrinsics=False),
            context=context,
        )
        models = [pycolmap.Reconstruction(str(one)) for one in sorted(sparse.iterdir())]
    return max(models, key=lambda model: int(model.num_reg_images()))


def spoiled(imu: ImuRecording, tracks: Tracks, how: str, options: TrackOptions, seed: int) -> ImuRecording:
    """The recording, or what is false of it."""
    if how == "other":
        other = simulate_tracks(options, seed=seed + 1000).imu
        shift_s = float(imu.gyro_t_s[0] - other.gyro_t_s[0])
        return replace(other, gyro_t_s=other.gyro_t_s + shift_s, accel_t_s=other.accel_t_s + shift_s)
    if how == "late":
        return replace(imu, gyro_t_s=imu.gyro_t_s + LATE_S, accel_t_s=imu.accel_t_s + LATE_S)
    if how == "flipped":
        return replace(imu, accel_m_s2=imu.accel_m_s2 * np.array([1.0, -1.0, 1.0]))
    if how == "gain":
        return replace(imu, accel_m_s2=imu.accel_m_s2 * 1.05)
    return imu


def centres_of(model: pycolmap.Reconstruction) -> np.ndarray:
    """Camera centres, in order of the names."""
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    return np.array([image.projection_center() for image in images])


def compared(centres: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Errors of camera centres, and how the scale drifts from the first to the last third."""
    scale, rotation, translation = similarity(centres, truth)
    left = np.linalg.norm(scale * centres @ rotation.T + translation - truth, axis=1)
    third = len(centres) // 3
    first, last = (similarity(centres[part], truth[part])[0] for part in (slice(0, third), slice(-third, None)))
    return {
        "rms_mm": 1e3 * float(np.sqrt(np.mean(left**2))),
        "drift_pct": 100 * (last / first - 1),
        "scale_error_pct": 100 * (1 / scale - 1),
    }


def walk(metres: float, readout_s: float, *, noise_px: float = 0.5) -> TrackOptions:
    """A walk with a phone."""
    motion = MotionOptions(kind="walk", duration_s=metres, speed_m_s=1.0, vigour=0.6, look_deg=40.0)
    return TrackOptions(motion=motion, readout_s=readout_s, vibration_m_s2=0.3, noise_px=noise_px)


def ring() -> TrackOptions:
    """Most of the way around a ring of 38 m, and back."""
    motion = MotionOptions(kind="orbit", duration_s=60.0, vigour=0.6, radius_m=6.0, arc_deg=330.0, sweep_s=30.0)
    return TrackOptions(motion=motion, vibration_m_s2=0.3, frame_rate_hz=3.0, points_per_m=8.0, life_s=1e3)


def centres_cov(problem: Problem, x: Estimate, some: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(3 K, 3 K) covariance of K camera centres but for one similarity."""
    cov = factor_information(problem, x).centres_cov(some, moving(problem, x))
    away, count = truth - truth.mean(axis=0), len(some)
    free = np.zeros((count, 3, 7))
    free[:, :, :3], free[:, :, 3] = np.eye(3), away
    free[:, :, 4:] = np.cross(np.eye(3)[None], away[:, None]).transpose(0, 2, 1)
    basis, _ = np.linalg.qr(free.reshape(3 * count, 7))
    left = np.eye(3 * count) - basis @ basis.T
    return left @ cov @ left


def by_chance(stage: RefineStage, before: Model, after: Model, truth: np.ndarray, seed: int) -> dict[str, float]:
    """What is to be expected of a refined walk, and whether it came so."""
    seen = read_seen(before.reconstruction, before.timing)
    values = after.treatments[-1].values
    known = stage.known_of(before, refine_intrinsics=stage.refine_intrinsics)
    levels = {ACCEL_DENSITY: values["accel_noise_m_s2_rthz"], GYRO_DENSITY: values["gyro_noise_rad_s_rthz"]}
    known = replace(known, noise=replace(known.noise, **levels))
    problem, start = make_problem(seen, before.timing, stage.imu, known, stage._expose_keypoints(before, seen))
    alone = pictures_alone(problem, seen.observations.xy_px)
    noise = measure_image_noise(alone, start)
    problem, alone = (apply_noise(one, noise) for one in (problem, alone))
    x = solve(problem, start).estimate
    some = np.linspace(0, len(truth) - 1, min(len(truth), CENTRES)).astype(int)
    centres, true = move_to_middle_lines(problem, x).cam_in_world[some], truth[some]
    scale, rotation, shift = similarity(centres, true)
    # the error in the world of the solution
    error = (scale * centres @ rotation.T + shift - true) @ rotation
    covs = [centres_cov(one, x, some, (true - shift) @ rotation) for one in (problem, alone)]
    weights, ways = np.linalg.eigh(covs[0])
    told = np.argsort(weights)[-WAYS:]
    normalised = ways[:, told].T @ error.ravel() / np.sqrt(weights[told])
    rng = np.random.default_rng(seed)
    own, beyond = (_drawn(cov, rng) for cov in (covs[0], covs[1] - covs[0]))
    worse = np.linalg.norm(own, axis=1) > 1.1 * np.linalg.norm(own + beyond, axis=1)
    expected_mm, colmap_mm = (1e3 * float(np.sqrt(np.trace(cov) / len(some))) for cov in covs)
    shape = float(np.sqrt(np.mean(normalised**2)))
    return {"expected_mm": expected_mm, "colmap_mm": colmap_mm, "shape": shape, "worse": float(worse.mean())}


def _drawn(cov: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(DRAWS, n) normal errors; directions that rounding left without variance have none."""
    weights, ways = np.linalg.eigh(cov)
    return rng.standard_normal((DRAWS, len(cov))) * np.sqrt(np.maximum(weights, 0)) @ ways.T


def studied(
    options: TrackOptions,
    seed: int,
    spoil: str,
    *,
    declared: bool = True,
    chance: bool = False,
    mapper: bool = False,
    auto: bool = False,
) -> dict[str, Any]:
    """One walk through the stages."""
    tracks = simulate_tracks(options, seed=seed)
    readout_s = options.readout_s if declared else 0.0
    rng = np.random.default_rng(seed)
    imu = spoiled(tracks.imu, tracks, spoil, options, seed)
    true, shutter, xy_px = tracks.calibration, None, tracks.xy_px
    prior = calibration_prior(Declared(readout_s=readout_s) if readout_s else None)
    timing = tracks.timing if declared else replace(tracks.timing, readout_s=None)
    if readout_s:
        # as good as a calibration from pixels
        known = replace(
            true,
            cam_from_imu_xyzw=quat_multiply(quat_exp(3e-3 * rng.standard_normal(3)), true.cam_from_imu_xyzw),
            gyro_time_offset_s=true.gyro_time_offset_s + 5e-4 * rng.standard_normal(),
        )
        view = GyroView(imu=imu, timing=tracks.timing, calibration=known, camera=tracks.camera, source="pixels")
        shutter = RollingShutterStage(view=view)
        xy_px = xy_px.copy()
        for i, name in enumerate(tracks.timing.names):
            mine = tracks.frame == i
            if shutter.covers(name):
                xy_px[mine] = shutter.moved(name, xy_px[mine])
    begin_s = time.process_time()
    mapped = by_mapper(tracks, xy_px) if mapper else adjusted(tracks.reconstruction(xy_px))
    seconds = {"mapper" if mapper else "bundle_adjustment": time.process_time() - begin_s}
    seen_s = dict(zip(timing.names, timing.pose_t_s().tolist(), strict=True))
    names = sorted(mapped.image(i).name for i in mapped.reg_image_ids())
    truth = tracks.motion.cam_in_world_m(np.array([seen_s[name] for name in names]))
    model = Model(reconstruction=mapped, colmap_index=0, timing=timing, rectified=shutter is not None)
    out: dict[str, Any] = {
        "seed": seed,
        "frames": len(names),
        "points": mapped.num_points3D(),
        "observations": mapped.compute_num_observations(),
        "colmap": compared(centres_of(mapped), truth),
    }
    begin_s = time.process_time()
    model = ReadoutStage(imu=imu, calibration=prior, refine_intrinsics=True, num_threads=1)(model)
    model = MetricStage(imu=imu, calibration=prior)(model)
    out["scale"] = {"verdict": model.scale.verdict, "reasons": list(sentences(model.scale.reasons))}
    noise = model.scale.noise
    out["scale"]["accel_noise"] = 0.0 if noise is None else noise.accel_density_m_s2_rthz
    out["before"] = compared(centres_of(model.reconstruction), truth)
    seconds["scale"] = time.process_time() - begin_s
    stage, metric = RefineStage(imu=imu, calibration=prior, refine_intrinsics=True, shutter=shutter), model
    begin_s = time.process_time()
    model = replace(stage, auto=auto)(metric)
    seconds["refine"] = time.process_time() - begin_s
    said = model.treatments[-1]
    out["expected"] = said.values.get("expected")
    out["declined"] = auto and not said.action and "sigma_px" not in said.values
    if out["declined"]:
        # what it would have done, to judge the choice
        out["why"], seconds["choice"], begin_s = str(said.reason), seconds["refine"], time.process_time()
        model = stage(metric)
        seconds["refine"] = time.process_time() - begin_s
        said = model.treatments[-1]
    out |= {"after": compared(centres_of(model.reconstruction), truth), "said": str(said.reason), "values": said.values}
    out["accepted"], out["seconds"] = said.action == "refined", seconds
    out["gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024e-9
    if chance and out["accepted"]:
        out["chance"] = by_chance(stage, metric, model, truth, seed)
    if "readout_s" in said.values:
        out["readout"] = [1e3 * said.values[name] for name in ("readout_s", "readout_sigma_s")]
    if out["accepted"]:
        out["calibration"] = judged_calibration(model, tracks, LATE_S if spoil == "late" else 0.0)
    return out


def axes_deg(
    found: CameraImuCalibration, gain: list[list[float]], true: CameraImuCalibration, matrix: np.ndarray
) -> np.ndarray:
    """(3,) from a sensor's own axes in the camera, as found, to where they are: nearest rotations of skew ones."""
    turns = []
    for calibration, errors in ((found, np.eye(3) + np.array(gain)), (true, np.linalg.inv(np.eye(3) + matrix))):
        u, _, vt = np.linalg.svd(matrix_from_quat(calibration.cam_from_imu_xyzw) @ errors)
        turns.append(u @ vt)
    return np.degrees(so3_log(turns[1] @ turns[0].T))


def judged_calibration(model: Model, tracks: Tracks, late_s: float) -> dict[str, Any]:
    """Errors of the refined calibration, and over their standard deviations; of an IMU whose stamps are late."""
    found, true, values = model.scale.calibration, tracks.calibration, model.treatments[-1].values
    turn = so3_log(matrix_from_quat(true.cam_from_imu_xyzw) @ matrix_from_quat(found.cam_from_imu_xyzw).T)
    # the truth's offsets hold in the middle of the recording
    at_s = tracks.sampled.errors.middle_s
    offset = found.gyro_time_offset_s + float(found.drift_s(np.array(at_s))) - true.gyro_time_offset_s + late_s
    accel = found.accel_time_offset_s - found.gyro_time_offset_s
    accel -= true.accel_time_offset_s - true.gyro_time_offset_s
    sigma = np.sqrt(np.diagonal(found.cov))
    cov = found.cov
    accel_sigma = np.sqrt(cov[4, 4] + cov[3, 3] - 2 * cov[3, 4])
    lever = found.imu_in_cam_m - true.imu_in_cam_m
    axes = {
        sensor: axes_deg(found, values[f"{sensor}_gain"], true, getattr(tracks.sampled.errors, f"{sensor}_matrix"))
        for sensor in ("gyro", "accel")
    }
    out = {
        "rotation_deg": np.degrees(turn).tolist(),
        "axes_deg": {sensor: float(np.linalg.norm(angle)) for sensor, angle in axes.items()},
        "lever_mm": (1e3 * lever).tolist(),
        "offset_ms": 1e3 * float(offset),
        "accel_delay_ms": 1e3 * float(accel),
        "normalised": {
            "rotation": (turn / sigma[CAL.ROTATION]).tolist(),
            "lever": (lever / sigma[CAL.LEVER_ARM]).tolist(),
            "offset": float(offset / sigma[CAL.GYRO_TIME_OFFSET]),
            "accel_delay": float(accel / accel_sigma),
        },
    }
    for sensor, angle in axes.items():
        out["normalised"][f"{sensor}_axes"] = (angle / values[f"{sensor}_axes_sigma_deg"]).tolist()
    if true.readout_s and "readout_s" in values:
        error = values["readout_s"] - true.readout_s
        out["readout_pct"] = 100 * error / true.readout_s
        out["normalised"]["readout"] = error / values["readout_sigma_s"]
    return out


def expected(options: TrackOptions) -> TrackOptions:
    """The same with a device that is as far off as it is expected to be."""
    names = {"gyro_scale_sd": PRIORS.gyro_gain, "gyro_misalignment_sd": PRIORS.gyro_gain}
    names |= {"accel_scale_sd": PRIORS.accel_gain, "accel_misalignment_sd": PRIORS.accel_gain}
    return replace(options, imu=replace(options.imu, **names))


def told_normalised(results: list[dict[str, Any]]) -> None:
    """Root mean squares of the normalised errors, all seeds and axes together."""
    judged = [one["calibration"]["normalised"] for one in results if one["accepted"]]
    for name in judged[0] if judged else ():
        errors = np.concatenate([np.atleast_1d(one[name]) for one in judged])
        print(f"normalised errors of {name}: {np.sqrt(np.mean(errors**2)):.2f} rms of {len(errors)}")


def told_choices(results: list[dict[str, Any]]) -> None:
    """What ``--refine auto`` chooses, against what the refinement does to each walk."""
    for one in results:
        worth, seconds = one["expected"], one["seconds"]
        ratio = one["after"]["rms_mm"] / one["before"]["rms_mm"]
        told = "no expectation"
        if worth is not None:
            told = (
                f"expected {1e3 * worth['alone_m']:.1f} -> {1e3 * worth['refined_m']:.1f} mm, risk "
                f"{worth['risk']:.3f}, share {worth['share']:.2f}"
            )
        print(
            f"seed {one['seed']}: {'left' if one['declined'] else 'refined'}; {told}; came "
            f"{one['before']['rms_mm']:.1f} -> {one['after']['rms_mm']:.1f} mm ({ratio:.2f}), {one['accepted']}; "
            f"{one['frames']} frames, {one['observations']} observations, {seconds}"
        )
    chosen = [one["after"]["rms_mm"] / one["before"]["rms_mm"] for one in results if not one["declined"]]
    missed = [one["after"]["rms_mm"] / one["before"]["rms_mm"] for one in results if one["declined"]]
    print(
        f"auto: refines {len(chosen)} of {len(results)}, worst {max(chosen, default=0):.2f} times as far off, "
        f"{sum(r > 1.05 for r in chosen)} above 1.05; of {len(missed)} left {sum(r < 0.95 for r in missed)} would have "
        "come closer"
    )


def main() -> None:
    pycolmap.logging.minloglevel = 3
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--metres", type=float, default=100.0)
    parser.add_argument("--readout-ms", type=float, default=0.0)
    parser.add_argument("--loop", action="store_true")
    parser.add_argument("--undeclared", action="store_true")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--expected", action="store_true")
    parser.add_argument("--points-per-m", type=float, default=TrackOptions.points_per_m)
    parser.add_argument("--mapper", action="store_true")
    parser.add_argument("--chance", action="store_true")
    parser.add_argument("--auto", action="store_true")
    parser.add_argument("--spoil", choices=("", "other", "late", "flipped", "gain"), default="")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    options, results = ring() if asked.loop else walk(asked.metres, asked.readout_ms * 1e-3), []
    options = expected(options) if asked.expected else options
    options = options if asked.loop else replace(options, points_per_m=asked.points_per_m)
    for seed in asked.seeds:
        one = studied(
            options,
            seed,
            asked.spoil,
            declared=not asked.undeclared,
            chance=asked.chance,
            mapper=asked.mapper,
            auto=asked.auto,
        )
        results.append(one)
        colmap, before, after = (one[k] for k in ("colmap", "before", "after"))
        print(
            f"seed {seed}: COLMAP {colmap['rms_mm']:.1f} before {before['rms_mm']:.1f} after {after['rms_mm']:.1f} mm; "
            f"drift {colmap['drift_pct']:+.2f} {before['drift_pct']:+.2f} -> {after['drift_pct']:+.2f} %; "
            f"{one['scale']['verdict']}; {one['said']}; seconds {one['seconds']}; readout {one.get('readout', '')} ms; "
            f"accelerometer's noise {1e3 * one['scale']['accel_noise']:.2f} -> "
            f"{1e3 * one['values'].get('accel_noise_m_s2_rthz', 0):.2f} mm/s2/rtHz; "
            f"{one['frames']} frames, {one['points']} points, {one['observations']} observations, {one['gb']:.1f} GB; "
            f"{one.get('chance', '')}; {one.get('calibration', '')}",
            flush=True,
        )
        if asked.out is not None:
            asked.out.write_text(json.dumps(results, indent=1))
    ratios = [one["colmap"]["rms_mm"] / one["after"]["rms_mm"] for one in results]
    print(f"median of COLMAP's error over the refined one's: {np.median(ratios):.2f}, least {min(ratios):.2f}")
    drifts = [abs(one["after"]["drift_pct"]) / max(abs(one["colmap"]["drift_pct"]), 1e-9) for one in results]
    print(f"median of the drift that is left: {np.median(drifts):.2f}")
    told_normalised(results)
    if asked.auto:
        told_choices(results)
    chances = [one["chance"] for one in results if "chance" in one]
    if chances:
        shape = np.sqrt(np.mean([one["shape"] ** 2 for one in chances]))
        worse = sum(one["colmap"]["rms_mm"] < one["after"]["rms_mm"] / 1.1 for one in results if "chance" in one)
        print(
            f"normalised errors of shape: {shape:.2f} rms; more than 1.1 times as far off: {worse} of {len(chances)}, "
            f"by chance {sum(one['worse'] for one in chances):.1f}"
        )


if __name__ == "__main__":
    main()
