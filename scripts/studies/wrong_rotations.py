"""Alignment by a mixture of sound and wrong rotations: is the own gyroscope found, and another recording's refused?

    python -m scripts.studies.wrong_rotations [--data ../shared/data/inertial_scale] [--windows N] [--seed SEED]

Windows of 6 to 30 s of recordings with their own gyroscope or another's, at 10, 5 or 2.5 poses a second, of whose
rotations up to 30 % are wrong by half a degree to nine. All offsets are searched, or a second about the true one, which
is that of the whole recording by least squares. The lead is in nats over the next offset, and over none.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import epoch_shift_s
from colmap_inertial.core.geometry import quat_conjugate, quat_cumulative, quat_exp, quat_log, quat_multiply
from colmap_inertial.core.types import CameraTrajectory, ImuRecording
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.trajectories import read_inertial_scale
from colmap_inertial.motion.align import _search, align_camera_imu
from colmap_inertial.motion.align._clock_search import TRIMMED, intervals_of, search_offsets


def spoil(trajectory: CameraTrajectory, wrong: float, rng: np.random.Generator) -> CameraTrajectory:
    """The poses with a share of their rotations wrong."""
    pose = trajectory.cam_from_world_xyzw
    turn = quat_log(quat_multiply(pose[:-1], quat_conjugate(pose[1:])))
    axis = rng.standard_normal(turn.shape)
    axis *= np.radians(rng.uniform(0.5, 9, len(turn)) / np.linalg.norm(axis, axis=1))[:, None]
    spoiled: Array = turn + (rng.random(len(turn)) < wrong)[:, None] * axis
    return replace(trajectory, cam_from_world_xyzw=quat_conjugate(quat_cumulative(quat_exp(spoiled))))


def judge(poses: CameraTrajectory, imu: ImuRecording, about_s: float | None) -> tuple[float, float | None] | None:
    """The lead of the best offset, and this offset where it is accepted; ``None`` where none is possible."""
    declared = Declared() if about_s is None else Declared(gyro_time_offset_s=about_s, time_offset_sigma_s=0.1)
    search = _search(poses, imu, calibration_prior(declared), None)
    spaced = intervals_of(poses, TRIMMED.spacing_s)
    fits = search_offsets(spaced, search.path, search.offsets_s, min_overlap=0.25, share=None)
    if not fits:
        return None
    lead = fits[0].log_likelihood - max([0.0, *(fit.log_likelihood for fit in fits[1:])])
    found = search.mixture(poses)
    return lead, None if found is None else found.offset_s - epoch_shift_s(imu, poses.epoch_ns)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(__file__).parents[3] / "shared" / "data" / "inertial_scale"
    parser.add_argument("--data", type=Path, default=data)
    parser.add_argument("--windows", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    if not args.data.is_dir():
        print(f"skipped: {args.data} is not there")
        return
    recordings = [read_inertial_scale(folder) for folder in sorted(args.data.glob("D*"))]
    true_s = [align_camera_imu(*recording).gyro_time_offset_s for recording in recordings]
    rng = np.random.default_rng(args.seed)
    leads: dict[bool, list[float]] = {True: [], False: []}
    accepted, worst_s = {True: 0, False: 0}, 0.0
    for _ in range(args.windows):
        of, other = rng.choice(len(recordings), 2, replace=False).tolist()
        own, narrow = bool(rng.random() < 0.5), bool(rng.random() < 0.5)
        poses, length_s = recordings[of][0], float(rng.choice([6, 10, 20, 30]))
        begin_s = poses.t_s[0] + rng.uniform(0, poses.t_s[-1] - poses.t_s[0] - length_s)
        inside = np.flatnonzero((poses.t_s >= begin_s) & (poses.t_s < begin_s + length_s))
        some = spoil(poses.select(inside[:: int(rng.choice([3, 6, 12]))]), float(rng.choice([0, 0.1, 0.2, 0.3])), rng)
        judged = judge(some, recordings[of if own else other][1], true_s[of] if narrow else None)
        if judged is None:
            continue
        leads[own].append(judged[0])
        if judged[1] is not None:
            accepted[own] += 1
            worst_s = max(worst_s, abs(judged[1] - true_s[of]) if own else 0.0)
    for own, name in ((True, "own"), (False, "another's")):
        least, most = np.min(leads[own]), np.max(leads[own])
        print(f"{name:<10} {accepted[own]} of {len(leads[own])} accepted, lead {least:.1f} to {most:.1f} nats")
    print(f"own: offset wrong by {1e3 * worst_s:.1f} ms at most")


if __name__ == "__main__":
    main()
