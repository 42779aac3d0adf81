"""Walks cut into two or three models: errors and coverage after joining by the IMU.

    python -m scripts.studies.join [--parts 2] [--gaps 1 2 4] [--seeds 1 2] [--spoil thrown] [--sigma-m .1] [--out F]
    python -m scripts.studies.join --back [--gaps 2 4] [--seeds 1 2]
    python -m scripts.studies.join --recordings FOLDER [--begins 6 25]
    python -m scripts.studies.join --real FOLDER [--gaps 1 2 4] [--sigma-m .5] [--sigma-deg 3]

Points beside the way are tracked as features are (no pictures are rendered), and nothing is seen for some seconds.
COLMAP's own bundle adjustment makes a model of each part, with its errors, in a world and units of its own; each gets
its scale from a phone's IMU, and the stage joins them.

Errors are those of the first image after a gap as seen from the last one before it (cm, degrees), with one standard
deviation along the worst direction, and whether the error lies within the 95 % region of its covariance. ``--spoil``
falsifies what cannot be joined: another recording's IMU within the gap, an IMU that was silent for half a second of it,
a later part that moved elsewhere in between (the device thrown, or a part of another recording), a clock that loses a
fifth of a second within the gap.

Of walks that become one model, the covariances of the whole path (``trajectory_cov.npz``) are judged as well: squared
errors of positions, rotations and velocities over three times their expectation, on average over the path, and the
share of positions within their 95 % region.

``--back``: a third of the way around a ring and back past the same walls, cut in two. What both parts saw is matched in
COLMAP's database, and each gap is told twice: by the IMU alone, and by matches, too.

``--recordings`` cuts real ones instead (a folder of InertialScale, as ``scripts/benchmarks/scale.py`` takes it): two
parts from so many seconds on, each fitted by itself; the truth is the path of the whole recording in its true scale.
``--real`` cuts windows of real IMUs with motion capture (``real_imu.py``), with pose errors of 2 mm; the truth is the
motion capture. Printed at last: errors over their standard deviations, rms over all gaps.
"""

import argparse
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import matrix_from_quat, quat_exp, so3_exp, so3_log
from colmap_inertial.core.options import JoinOptions, ScaleOptions
from colmap_inertial.core.types import CameraTrajectory, ImuRecording
from colmap_inertial.inertial.join.evidence import find_links
from colmap_inertial.inertial.join.grouping import join_submodels
from colmap_inertial.inertial.join.placement import FittedSubmodel, ImuLink, Placed
from colmap_inertial.inertial.join.relative_poses import end_images, tie_cov
from colmap_inertial.inertial.scale.posterior import FittedPath
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.files import read_json
from colmap_inertial.io.trajectories import read_inertial_scale, read_tum
from colmap_inertial.model import Model, trajectory_from_model
from colmap_inertial.model.submodels.matches import PlacedImages, place_images
from colmap_inertial.run.stages.join import JoinStage
from colmap_inertial.run.stages.metric import MetricStage, metric_trajectory, write_trajectory
from colmap_inertial.tools.simulate.motion import MotionOptions
from colmap_inertial.tools.simulate.tracks import TrackOptions, Tracks, simulate_tracks
from scripts.benchmarks.scale import recordings_in
from scripts.common.real_imu import Window, recorded, windows
from scripts.studies.refine import adjusted

#: Seconds of each part; 95 % quantile of chi-square with three degrees of freedom.
PART_S, CHI2_95 = 12.0, 7.815


def walk(seconds: float) -> TrackOptions:
    """A walk with a phone."""
    motion = MotionOptions(kind="walk", duration_s=seconds, speed_m_s=1.0, vigour=0.6, look_deg=40.0)
    return TrackOptions(motion=motion, vibration_m_s2=0.3, points_per_m=60.0)


def part_of(tracks: Tracks, begin_s: float, end_s: float, rng: np.random.Generator) -> pycolmap.Reconstruction:
    """COLMAP's model of a part of a walk, in a world and units of its own."""
    model = tracks.reconstruction()
    for image_id, t_s in enumerate(tracks.timing.pose_t_s().tolist(), start=1):
        if not begin_s <= t_s <= end_s:
            model.deregister_frame(model.image(image_id).frame_id)
    for point_id in list(model.point3D_ids()):
        if model.points3D[point_id].track.length() < 3:
            model.delete_point3D(point_id)
    model = adjusted(model)
    turn = pycolmap.Rotation3d(quat_exp(rng.standard_normal(3)))
    model.transform(pycolmap.Sim3d(float(rng.uniform(0.3, 3.0)), turn, rng.standard_normal(3)))
    return model


def spoiled(imu: ImuRecording, how: str, spans: list[tuple[float, float]], offset_s: float, seed: int) -> ImuRecording:
    """The recording, or what is false of it between the first two parts."""
    begin_s, end_s = spans[0][1] - offset_s, spans[1][0] - offset_s
    inside = [(t_s > begin_s) & (t_s < end_s) for t_s in (imu.gyro_t_s, imu.accel_t_s)]
    if how == "other":
        other = simulate_tracks(walk(spans[-1][1]), seed=seed + 1000).imu
        values = []
        for mine, t_s, theirs_s, theirs, own in (
            (inside[0], imu.gyro_t_s, other.gyro_t_s, other.gyro_rad_s, imu.gyro_rad_s),
            (inside[1], imu.accel_t_s, other.accel_t_s, other.accel_m_s2, imu.accel_m_s2),
        ):
            values.append(own.copy())
            shifted_s = t_s[mine] - t_s[0] + theirs_s[0]
            values[-1][mine] = np.stack([np.interp(shifted_s, theirs_s, theirs[:, k]) for k in range(3)], axis=1)
        return replace(imu, gyro_rad_s=values[0], accel_m_s2=values[1])
    if how == "silent":
        kept = [
            ~(t & (s > begin_s + 0.25) & (s < begin_s + 0.75))
            for t, s in zip(inside, (imu.gyro_t_s, imu.accel_t_s), strict=True)
        ]
        return replace(
            imu,
            gyro_t_s=imu.gyro_t_s[kept[0]],
            gyro_rad_s=imu.gyro_rad_s[kept[0]],
            accel_t_s=imu.accel_t_s[kept[1]],
            accel_m_s2=imu.accel_m_s2[kept[1]],
        )
    if how == "clock":
        # it loses time little by little: no pause between the readings tells of it
        lost_s = 0.2
        later = [
            t_s - 0.5 * np.clip(t_s - 0.5 * (begin_s + end_s) + lost_s, 0, 2 * lost_s)
            for t_s in (imu.gyro_t_s, imu.accel_t_s)
        ]
        return replace(imu, gyro_t_s=later[0], accel_t_s=later[1])
    if how == "thrown":  # an impact that the sensor does not follow: 2 m/s are gone
        late = inside[1] & (imu.accel_t_s > end_s - 0.1)
        values = imu.accel_m_s2.copy()
        values[late] += np.array([20.0, 0.0, 0.0])
        return replace(imu, accel_m_s2=values)
    return imu


def judged(
    fitted: list[FittedSubmodel],
    imu: ImuRecording,
    limits: JoinOptions,
    truth: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    found: Sequence[PlacedImages] = (),
) -> list[dict[str, Any]]:
    """The gaps between parts, and errors across them; the truth is (N, 3, 3) world_from_cam and (N, 3) by times."""
    joined = join_submodels(fitted, imu, limits, found)
    out: list[dict[str, Any]] = []
    for gap in joined.gaps:
        one: dict[str, Any] = {"joined": gap.joined, "reason": str(gap.reason)}
        one |= {"sigma_m": gap.sigma_m, "sigma_deg": gap.sigma_deg, "chi2": gap.chi2, "dof": gap.dof}
        out.append(one)
        for group in joined.groups:
            members = [fitted[k] for k in group.members]
            for link in find_links(members):
                if (members[link.first].number, members[link.second].number) == (gap.first, gap.second):
                    one |= error_across(members, group.placed, link, truth)
    return out


def error_across(
    parts: list[FittedSubmodel],
    placed: Placed,
    link: ImuLink,
    truth: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
) -> dict[str, Any]:
    """Of the first image after a gap as seen from the last one before it."""
    poses = []
    for k, image in zip((link.first, link.second), end_images(parts, link), strict=True):
        part = parts[k]
        at = placed.points(k, part.trajectory.cam_in_world[image : image + 1])[0]
        poses.append((placed.places.rotation[k] @ part.world_from_cam[image], at, float(part.trajectory.t_s[image])))
    true, centres = truth(np.array([pose[2] for pose in poses]))
    turn = poses[0][0].T @ poses[1][0] @ (true[0].T @ true[1]).T
    away = poses[0][0].T @ (poses[1][1] - poses[0][1]) - true[0].T @ (centres[1] - centres[0])
    error = np.concatenate([poses[0][0] @ so3_log(turn), poses[0][0] @ away])
    cov = tie_cov(parts, placed, link)
    squares = [
        float(error[part] @ np.linalg.solve(cov[part, part], error[part])) for part in (slice(3, 6), slice(0, 3))
    ]
    return {
        "error_m": float(np.linalg.norm(error[3:])),
        "error_deg": float(np.degrees(np.linalg.norm(error[:3]))),
        "inside_m": squares[0] < CHI2_95,
        "inside_deg": squares[1] < CHI2_95,
        "squares": squares,
    }


def judge_cut(
    path: CameraTrajectory, true: CameraTrajectory, imu: ImuRecording, metres: float, gap_s: float, limits: JoinOptions
) -> list[dict[str, Any]]:
    """Two parts of a path, from its begin on; the truth has the path's world, unit (``metres``) and clock."""
    fitted = []
    for k in range(2):
        first_s = path.t_s[0] + k * (PART_S + gap_s)
        part = path.select((path.t_s >= first_s) & (path.t_s <= first_s + PART_S))
        try:
            fit = FittedPath.of(part, imu, None, ScaleOptions())
        except NotObservableError as error:
            return [{"joined": False, "reason": str(error)}]
        fitted.append(FittedSubmodel(number=k, trajectory=part, path=fit))

    def truth(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = np.searchsorted(true.t_s, t_s - 1e-6)
        return matrix_from_quat(true.cam_from_world_xyzw[at]).transpose(0, 2, 1), metres * true.cam_in_world[at]

    return judged(fitted, imu, limits, truth)


def cut_recording(folder: Path, begin_s: float, gap_s: float, limits: JoinOptions) -> list[dict[str, Any]]:
    """Two parts of a real recording."""
    path, imu = read_inertial_scale(folder)
    metres = float((folder / "groundtruth.txt").read_text())
    path = path.select(path.t_s >= path.t_s[0] + begin_s)
    named = {"seed": f"{folder.name} from {begin_s:g} s", "gap_s": gap_s}
    return [gap | named for gap in judge_cut(path, path, imu, metres, gap_s, limits)]


def cut_window(folder: Path, window: Window, gap_s: float, limits: JoinOptions) -> list[dict[str, Any]]:
    """The first and the last ``PART_S`` of a window of a real IMU, with the motion capture as poses."""
    path, imu, metres = recorded(folder, window)
    true, _, _ = recorded(folder, replace(window, noise_m=0.0))
    named = {"seed": f"{window.recording} from {window.begin_s:.0f} s", "gap_s": gap_s}
    return [gap | named for gap in judge_cut(path, true, imu, metres, gap_s, limits)]


def ring(seconds: float) -> TrackOptions:
    """A third of the way around a ring of 25 m, and back; each point is known again."""
    motion = MotionOptions(
        kind="orbit", duration_s=seconds, vigour=0.6, radius_m=4.0, arc_deg=120.0, sweep_s=0.5 * seconds
    )
    return TrackOptions(motion=motion, vibration_m_s2=0.3, points_per_m=15.0, life_s=1e3)


def come_back(gap_s: float, seed: int, limits: JoinOptions) -> list[dict[str, Any]]:
    """A way there and back in two parts: by the IMU alone, and by matches, too."""
    spans = [(0.0, PART_S), (PART_S + gap_s, 2 * PART_S + gap_s)]
    tracks, rng = simulate_tracks(ring(spans[-1][1] + 0.3), seed=seed), np.random.default_rng(seed)
    metric = MetricStage(imu=tracks.imu, calibration=calibration_prior())
    models = []
    for k, span in enumerate(spans):
        model = part_of(tracks, *span, rng)
        models.append(metric(Model(reconstruction=model, colmap_index=k, timing=tracks.timing)))
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        tracks.write_database(database)
        found = place_images(database, [model.reconstruction for model in models], [0, 1])
    stage = JoinStage(imu=tracks.imu, calibration=calibration_prior(), limits=limits)
    fitted = [stage.part(model) for model in models]

    def truth(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        state = tracks.motion.at(t_s)
        return matrix_from_quat(state.world_from_cam_xyzw), state.cam_in_world_m

    out = []
    for matches in ((), found):
        for one in judged(fitted, tracks.imu, limits, truth, matches):
            out.append(one | {"seed": f"{seed}{', matched' if matches else ''}", "gap_s": gap_s})
    return out


def judge_path(
    model: Model, imu: ImuRecording, truth: Callable[[np.ndarray], tuple[np.ndarray, ...]]
) -> dict[str, float]:
    """Errors of a joined path over its covariances; the truth is in a world with z up, and has velocities."""
    trajectory = metric_trajectory(trajectory_from_model(model.reconstruction, model.timing)[0])
    with tempfile.TemporaryDirectory() as folder:
        write_trajectory(Path(folder) / "trajectory.tum", model, trajectory, imu)
        stored = np.load(Path(folder) / "trajectory_cov.npz")
        path = read_tum(Path(folder) / "trajectory.tum")
        velocity = read_json(Path(folder) / "trajectory_motion.json")["velocity_in_world_m_s"]
    if str(stored["relative_to"]) != "first image":
        return {}
    true, centres, speeds = truth(path.t_s + 1e-9 * path.epoch_ns)
    rotation = matrix_from_quat(path.cam_from_world_xyzw).transpose(0, 2, 1)
    # the first camera has its place and heading
    turn = true[0] @ rotation[0].T
    heading = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    world_from_true = so3_exp(np.array([0.0, 0.0, -heading]))
    cov = stored["cov"]
    errors = {
        "position": (
            path.cam_in_world - path.cam_in_world[0] - (centres - centres[0]) @ world_from_true.T,
            cov[:, :3, :3],
        ),
        "velocity": (np.array(velocity) - speeds @ world_from_true.T, cov[:, 3:6, 3:6]),
        "rotation": (
            np.array([so3_log(a @ (world_from_true @ b).T) for a, b in zip(rotation, true, strict=True)]),
            stored["rotation_cov"],
        ),
    }
    squares = {
        name: np.einsum("ti,ti->t", error[1:], np.linalg.solve(cov[1:], error[1:, :, None])[..., 0])
        for name, (error, cov) in errors.items()
    }
    shares = {f"nees_{name}": float(np.mean(values)) / 3 for name, values in squares.items()}
    return {**shares, "inside_path": float(np.mean(squares["position"] < CHI2_95))}


def studied(parts: int, gap_s: float, seed: int, spoil: str, limits: JoinOptions) -> list[dict[str, Any]]:
    """One walk, its gaps."""
    spans = [(k * (PART_S + gap_s), k * (PART_S + gap_s) + PART_S) for k in range(parts)]
    tracks, rng = simulate_tracks(walk(spans[-1][1] + 0.3), seed=seed), np.random.default_rng(seed)
    imu = spoiled(tracks.imu, spoil, spans, tracks.calibration.gyro_time_offset_s, seed)
    prior = calibration_prior()
    metric = MetricStage(imu=imu, calibration=prior)
    models = []
    for k, (begin_s, end_s) in enumerate(spans):
        model = part_of(tracks, begin_s, end_s, rng)
        models.append(metric(Model(reconstruction=model, colmap_index=k, timing=tracks.timing)))
    stage = JoinStage(imu=imu, calibration=prior, limits=limits)
    usable = [model for model in models if model.similarity is not None]
    fitted = [stage.part(model) for model in usable]

    def truth(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        state = tracks.motion.at(t_s)
        return matrix_from_quat(state.world_from_cam_xyzw), state.cam_in_world_m

    out = judged(fitted, imu, limits, truth)
    for one in out:
        one |= {"seed": seed, "gap_s": gap_s}
    whole, _ = stage.join_models(usable)
    if out and len(whole) == 1:
        out[0] |= judge_path(whole[0], imu, lambda t_s: (*truth(t_s), tracks.motion.at(t_s).velocity_in_world_m_s))
    if len(usable) < len(models):
        refused = [model.colmap_index for model in models if model.similarity is None]
        out.append({"seed": seed, "gap_s": gap_s, "joined": False, "reason": f"scale of {refused} refused"})
    return out


def main() -> None:
    pycolmap.logging.minloglevel = 3
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", type=int, default=2)
    parser.add_argument("--gaps", type=float, nargs="+", default=[1.0, 2.0, 4.0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--spoil", choices=("", "other", "silent", "thrown", "clock"), default="")
    parser.add_argument("--sigma-m", type=float, default=JoinOptions.sigma_m)
    parser.add_argument("--sigma-deg", type=float, default=JoinOptions.sigma_deg)
    parser.add_argument("--back", action="store_true")
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--real", type=Path)
    parser.add_argument("--begins", type=float, nargs="+", default=[6.0, 25.0])
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    limits, results = JoinOptions(sigma_m=asked.sigma_m, sigma_deg=asked.sigma_deg), []
    for gap_s in asked.gaps:
        if asked.back:
            walks = (come_back(gap_s, seed, limits) for seed in asked.seeds)
        elif asked.real is not None:
            cut = windows(asked.real, (2 * PART_S + gap_s,), (0.002,))
            walks = (cut_window(asked.real, window, gap_s, limits) for window in cut)
        elif asked.recordings is None:
            walks = (studied(asked.parts, gap_s, seed, asked.spoil, limits) for seed in asked.seeds)
        else:
            folders = recordings_in(asked.recordings)
            walks = (cut_recording(folder, begin, gap_s, limits) for folder in folders for begin in asked.begins)
        for walk_gaps in walks:
            for one in walk_gaps:
                results.append(one)
                found = ""
                if "error_m" in one:
                    found = (
                        f"error {100 * one['error_m']:.1f} cm {one['error_deg']:.2f} deg, inside {one['inside_m']} "
                        f"{one['inside_deg']}; "
                    )
                if one.get("sigma_m") is not None:
                    found += f"sigma {100 * one['sigma_m']:.1f} cm {one['sigma_deg']:.2f} deg, chi2 {one['chi2']:.1f}; "
                if "inside_path" in one:
                    found += f"path {one['nees_position']:.2f}; "
                print(f"{gap_s:g} s, {one['seed']}: {found}{one['reason']}", flush=True)
                if asked.out is not None:
                    asked.out.write_text(json.dumps(results, indent=1))
        of_gap = [one for one in results if one["gap_s"] == gap_s]
        matched = [one for one in of_gap if str(one["seed"]).endswith("matched")]
        told_of(f"{gap_s:g} s", [one for one in of_gap if one not in matched])
        if matched:
            told_of(f"{gap_s:g} s, matched", matched)


def told_of(what: str, gaps: list[dict[str, Any]]) -> None:
    """How many were joined, and how well."""
    told = [one for one in gaps if "error_m" in one]
    line = f"{what}: {sum(one['joined'] for one in gaps)} of {len(gaps)} joined"
    if told:
        median = [float(np.median([one[name] for one in told])) for name in ("error_m", "error_deg")]
        inside = [sum(one[name] for one in told) for name in ("inside_m", "inside_deg")]
        over = np.sqrt(np.mean([one["squares"] for one in told], axis=0) / 3)
        line += (
            f"; over sigma (rms) position {over[0]:.2f}, direction {over[1]:.2f}; median error "
            f"{100 * median[0]:.1f} cm {median[1]:.2f} deg; within the 95 % region {inside[0]} and {inside[1]} "
            f"of {len(told)}"
        )
    print(line, flush=True)
    paths = [one for one in gaps if "inside_path" in one]
    if paths:
        mean = {name: np.mean([one[name] for one in paths]) for name in paths[0] if name.startswith("nees_")}
        words = ", ".join(f"{name.removeprefix('nees_')} {value:.2f}" for name, value in mean.items())
        inside = 100 * np.mean([one["inside_path"] for one in paths])
        print(
            f"  {len(paths)} joined paths, squared errors over their expectation: {words}; {inside:.0f} % inside",
            flush=True,
        )


if __name__ == "__main__":
    main()
