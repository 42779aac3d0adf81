"""What the tight refinement does to real recordings.

    python scripts/study_refine_real.py --euroc DATASET FOLDER
    python scripts/study_refine_real.py --recordings FOLDER

``--euroc``: the 100 keyframes of V1_01_easy (DATASET has ``keyframes/``, ``mav0/`` and ``gt/``), matched and mapped by
``reconstruct`` with and without ``--refine inertial``, in FOLDER. Both metric models against motion capture, as
``check_euroc.py`` compares them: the camera centres' error and that of the scale, and what the refinement said.
"""

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

from bench_whole import euroc_capture
from check_euroc import check

from colmap_inertial.io.files import read_json


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--euroc", type=Path, nargs=2, metavar=("DATASET", "FOLDER"))
    asked = parser.parse_args()
    if asked.euroc:
        euroc(*asked.euroc)


if __name__ == "__main__":
    main()
