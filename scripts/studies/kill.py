"""``reconstruct --deterministic`` killed at random moments and restarted, against an undisturbed run.

    python -m scripts.studies.kill [CAPTURE] [--kills 20] [--seed 0]

One run goes undisturbed. Then others are killed (SIGKILL) after a random time, at most the undisturbed one's, and
started again in the same folder until one comes through; that one must end with the same model, bit for bit, the same
scale, and no file under a temporary name. This is repeated until there were enough kills. Exit code 1 where anything
differs.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCENE = Path(__file__).resolve().parents[2] / "example_scenes" / "desk"
OPTIONS = """deterministic = true
[mapping]
max_num_features = 1500
first_octave = 0
max_image_size = 480
"""
COMPARED = ("images", "sparse", "colmap/images", "colmap/sparse", "trajectory.tum")


def contents(out: Path) -> dict[str, bytes]:
    """Everything that a run made and that must not depend on interruptions, by its path."""
    paths = [path for name in COMPARED for path in [out / name, *(out / name).rglob("*")] if path.is_file()]
    found = {str(path.relative_to(out)): path.read_bytes() for path in sorted(paths)}
    models = json.loads((out / "result.json").read_text())["models"]
    for model in models:
        model.pop("runtime_s", None)
    return {**found, "result.json: models": json.dumps(models, sort_keys=True).encode()}


def stage(out: Path) -> str:
    """What a run was at when it was killed: the last line of its log."""
    log = out / "log.txt"
    lines = log.read_text().splitlines() if log.is_file() else []
    return lines[-1].split(" INFO ", 1)[-1].split(" (")[0][:48] if lines else "before the log"


def main() -> int:
    """Run the study; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path, nargs="?", default=SCENE)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    moments = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        (root / "options.toml").write_text(OPTIONS)

        def start(out: Path) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-m", "colmap_inertial", "reconstruct", args.capture, out]
            flags = ["--config", root / "options.toml"]
            with open(root / "said.txt", "ab") as said:
                return subprocess.Popen(list(map(str, [*command, *flags])), stdout=said, stderr=said)

        began = time.monotonic()
        if start(root / "whole").wait() not in (0, 1):
            print((root / "said.txt").read_text(errors="replace"))
            return 2
        whole_s = time.monotonic() - began
        expected = contents(root / "whole")
        print(f"undisturbed: {whole_s:.1f} s, {len(expected)} files to compare")

        kills = rounds = different = 0
        while kills < args.kills:
            out = root / f"killed{rounds}"
            while True:
                process = start(out)
                after_s = moments.uniform(0.0, whole_s) if kills < args.kills else None
                try:
                    process.wait(after_s)
                    break
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
                    kills += 1
                    partial = sum(".partial" in path.name or path.suffix == ".tmp" for path in out.rglob("*"))
                    print(f"kill {kills:3d} after {after_s:5.1f} s: {stage(out)}; {partial} unfinished files")
            found = contents(out) if (out / "result.json").is_file() else {}
            wrong = sorted(name for name in expected | found if expected.get(name) != found.get(name))
            left = [path.name for path in out.rglob("*") if ".partial" in path.name or path.suffix == ".tmp"]
            rounds += 1
            different += bool(wrong or left)
            print(
                f"run {rounds} came through: {'identical' if not wrong else f'different: {wrong}'}; left over: {left}"
            )
    print(f"{kills} kills, {rounds} runs, {rounds - different} identical to the undisturbed one")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
