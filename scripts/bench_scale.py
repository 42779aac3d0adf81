"""Scale errors on InertialScale recordings, by method and window length.

    python scripts/bench_scale.py FOLDER [--methods joint spectral] [--windows 60 30 10]

FOLDER holds recordings (``poses.txt``, ``gyroscope.txt``, ``accelerometer.txt``) with ``groundtruth.txt``: metres per
model unit. Each window takes the first so many seconds of the camera's recording. Printed are the error in % of each
recording and, by method and window, mean, median and largest absolute error, how many 95 % intervals hold the truth,
the median half-width of the intervals, how many were refused, and the time per estimate.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from colmap_inertial.io.trajectories import read_inertial_scale
from colmap_inertial.scale import ScaleOptions, estimate_scale, first_seconds


def bench(folder: Path, methods: Sequence[str], windows: Sequence[float]) -> None:
    """Print the table that the module describes."""
    recordings = sorted(folder.glob("*/groundtruth.txt"), key=lambda path: (len(path.parent.name), path.parent.name))
    data = [(path.parent.name, *read_inertial_scale(path.parent), float(path.read_text())) for path in recordings]
    if not data:
        raise SystemExit(f"{folder}: no recording with a groundtruth.txt")
    print(
        "method    window s  "
        + "".join(f"{name:>8}" for name, *_ in data)
        + "    mean  median     max  inside  +-%  refused  s"
    )
    for method in methods:
        for window in windows:
            errors, inside, half_widths, seconds = [], 0, [], []
            for _, trajectory, imu, truth in data:
                start = time.perf_counter()
                estimate = estimate_scale(first_seconds(trajectory, window), imu, options=ScaleOptions(method=method))
                seconds.append(time.perf_counter() - start)
                if estimate.metres_per_unit is None or estimate.ci95 is None:
                    errors.append(np.nan)
                    continue
                low, high = estimate.ci95
                errors.append(100 * (estimate.metres_per_unit / truth - 1))
                inside += low <= truth <= high
                half_widths.append(50 * (high - low) / estimate.metres_per_unit)
            known = np.abs([error for error in errors if np.isfinite(error)])
            row = "".join(f"{error:>8.2f}" if np.isfinite(error) else " refused" for error in errors)
            figures = (
                (known.mean(), np.median(known), known.max(), np.median(half_widths)) if len(known) else (np.nan,) * 4
            )
            print(
                f"{method:<10}{window:>8g}  {row}{figures[0]:>8.2f}{figures[1]:>8.2f}{figures[2]:>8.2f}"
                f"{inside:>5}/{len(known)}{figures[3]:>6.1f}{len(errors) - len(known):>6}{np.median(seconds):>7.2f}",
                flush=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--methods", nargs="+", default=["joint", "spectral"], choices=["joint", "spectral"])
    parser.add_argument("--windows", nargs="+", type=float, default=[60, 30, 20, 10, 5])
    bench(**vars(parser.parse_args()))
