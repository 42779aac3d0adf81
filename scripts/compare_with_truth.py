"""A finished reconstruction of a simulated capture against its checkerboard and the truth.

    python scripts/compare_with_truth.py OUT CAPTURE_FOLDER

OUT is a folder that ``colmap-inertial reconstruct`` made; CAPTURE_FOLDER holds ``truth.json``. Exit code 1 when the
true scale lies outside the stated interval or the error exceeds 2 %.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from colmap_inertial.io.files import read_json
from colmap_inertial.model import read_model
from colmap_inertial.tools.simulate.truth import read_truth, true_metres_per_unit

LARGEST_ERROR_PCT = 2.0


def compare(out: Path, capture: Path) -> bool:
    """Print the comparison; whether truth and checkerboard agree with what the reconstruction states."""
    truth = read_truth(capture / "truth.json")
    good = True
    for found in read_json(out / "result.json")["models"]:
        if found["sparse_metric"] is None:
            print(f"Model {found['index']}: scale refused: {'; '.join(found['reasons'])}")
            good = False
            continue
        folder = out / found["sparse_metric"]
        reconstruction = read_model(folder)
        images = [reconstruction.image(i) for i in reconstruction.reg_image_ids()]
        names = tuple(image.name for image in images)
        centres = np.array([image.projection_center() for image in images])
        metres_per_metre = true_metres_per_unit(names, centres, truth.trajectory)
        error_pct = 100 * (1 / metres_per_metre - 1)
        low, high = (100 * (bound / found["metres_per_unit"] - 1) for bound in found["ci95"])
        inside = low <= 100 * (metres_per_metre - 1) <= high
        print(f"Model {found['index']}: scale error against the truth {error_pct:+.3f} %; ", end="")
        print(f"stated interval {low:+.2f} to {high:+.2f} %: the truth is {'inside' if inside else 'OUTSIDE'}")
        check = found["validation"]
        if check is not None and "error" not in check:
            low, high = check["ci95_pct"]
            print(
                f"Model {found['index']}: scale error against the {check['target']} {check['scale_error_pct']:+.3f} % ",
                end="",
            )
            print(f"(95 %: {low:+.3f} to {high:+.3f} %)")
        good &= inside and abs(error_pct) <= LARGEST_ERROR_PCT
    return good


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("capture", type=Path)
    sys.exit(0 if compare(**vars(parser.parse_args())) else 1)
