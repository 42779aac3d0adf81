"""Times left that the terminal showed, over those that were left.

    python -m scripts.studies.progress example_scenes/desk out/timed --dense [--cpu] --record desk.json
    python -m scripts.studies.progress --replay desk.json euroc.json

The first form reconstructs a capture, and writes when each step of each stage was done; with ``--cpu`` by the
processors' time, where other programs run beside it. The second prints for each stage, at a tenth, a quarter, a half
and nine tenths of its time, the time left that the bar shows over the true one; the target is a factor of two.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

from colmap_inertial import ReconstructOptions, reconstruct
from colmap_inertial.cli.screen import Stage

#: Shares of a stage's time at which the bar is read.
_READ_AT = (0.1, 0.25, 0.5, 0.9)


def record(
    capture: Path, out: Path, options: ReconstructOptions, clock: Callable[[], float]
) -> dict[str, list[tuple[float, int, int]]]:
    """Seconds since the start, steps done and steps in all, of each call, by stage."""
    begun_s, told = clock(), {}

    def progress(stage: str, done: int, total: int, /) -> None:
        told.setdefault(stage, []).append((round(clock() - begun_s, 3), done, total))

    reconstruct(capture, out, options, progress=progress)
    return told


def replay(name: str, calls: list[tuple[float, int, int]]) -> list[float | None]:
    """Shown over true time left at each of the shares; ``None`` where nothing is shown."""
    begin_s, end_s = calls[0][0], next((t_s for t_s, done, total in calls if total and done >= total), calls[-1][0])
    ratios: list[float | None] = []
    for share in _READ_AT:
        now_s = begin_s + share * (end_s - begin_s)
        stage = Stage(calls[0][0], *calls[0][1:], name=name)
        for t_s, done, total in calls[1:]:
            if t_s <= now_s:
                stage.moved(t_s, done, total)
        left_s = stage.left_s(now_s)
        ratios.append(None if left_s is None else left_s / max(end_s - now_s, 1e-9))
    return ratios


def main() -> None:
    """Time a run, or play recorded ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path)
    parser.add_argument("--record", type=Path)
    parser.add_argument("--replay", action="store_true")
    parser.add_argument("--dense", action="store_true")
    parser.add_argument("--cpu", action="store_true")
    given = parser.parse_args()
    if not given.replay:
        capture, out = given.paths
        clock = time.process_time if given.cpu else time.monotonic
        told = record(capture, out, ReconstructOptions(dense=given.dense), clock)
        given.record.write_text(json.dumps(told))
        return
    print(f"{'recording':<16} {'stage':<12} {'seconds':>8}  " + "  ".join(f"{share:>6.0%}" for share in _READ_AT))
    for path in given.paths:
        for name, calls in json.loads(path.read_text()).items():
            ratios = replay(name, calls)
            shown = "  ".join("  none" if ratio is None else f"{ratio:6.2f}" for ratio in ratios)
            print(f"{path.stem:<16} {name:<12} {calls[-1][0] - calls[0][0]:8.1f}  {shown}")


if __name__ == "__main__":
    main()
