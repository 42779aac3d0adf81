"""Make an existing COLMAP project metric: a scale for each of its models, then everything in the project under it.

    python scripts/example_existing_project.py PROJECT OUT --imu imu.csv --frame-times frames.csv

What ``colmap-inertial scale`` and ``apply`` do, as the calls behind them: the place to begin where times, poses or the
IMU come from somewhere else, or where a scale is to be judged by rules of one's own.
"""

import argparse
from pathlib import Path

from colmap_inertial import (
    InertialError,
    ModelScale,
    Similarity,
    apply_to_project,
    estimate_scale,
    find_models,
    read_frame_times,
    read_imu,
    read_model,
    trajectory_from_model,
)


def main() -> None:
    """Estimate, judge, apply."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("project", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--imu", type=Path, required=True)
    parser.add_argument("--frame-times", type=Path, required=True)
    parser.add_argument("--worst-percent", type=float, default=3.0, help="half-width of the 95 %% interval to accept")
    args = parser.parse_args()

    imu = read_imu(args.imu)  # any recording that the command line knows; in rad/s and m/s2 from here on
    timing = read_frame_times(args.frame_times)
    scales: dict[int | None, ModelScale] = {}
    for index, folder in find_models(args.project / "sparse").items():
        # Poses and times join by image name. Camera and IMU clocks may differ by any offset.
        trajectory, left_out = trajectory_from_model(read_model(folder), timing)
        estimate = estimate_scale(trajectory, imu)
        reasons = (*left_out, *estimate.reasons)
        similarity = None
        if estimate.metres_per_unit is not None and estimate.ci95 is not None:
            low, high = estimate.ci95
            percent = 50 * (high - low) / estimate.metres_per_unit
            print(f"model {index}: {estimate.metres_per_unit:.6g} m per unit +- {percent:.2g} %, {estimate.verdict}")
            if percent <= args.worst_percent:
                similarity = Similarity.from_scale(estimate, world="z-up", provenance=f"model {index}, {args.imu.name}")
        # Without a similarity, a model and what was made from it keep their own units.
        scales[index] = ModelScale(similarity=similarity, verdict=estimate.verdict, reasons=reasons)

    try:
        applied = apply_to_project(args.project, args.out, scales)  # OUT appears whole or not at all
    except InertialError as error:  # of every error that data or environment can cause
        raise SystemExit(f"error: {error}") from None
    for change in applied.changes:
        print(f"{change.path} ({change.kind}): {', '.join(change.changed)}")


if __name__ == "__main__":
    main()
