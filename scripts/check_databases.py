"""EuRoC's 100 keyframes with features that others found: registered images, and the scale against that of a plain run.

    python scripts/check_databases.py DATASET FOLDER [--colmap /usr/bin/colmap]

DATASET has ``keyframes/``, ``mav0/`` and ``gt/`` of EuRoC V1_01_easy. ``own``: nothing of others. ``akaze``: a database
of OpenCV's AKAZE with matches of all pairs. ``filled``: a database that an installed COLMAP filled with features and
matches. ``executable``: that COLMAP finds features, matches and maps. FOLDER takes the work and is made.
"""

from __future__ import annotations

import argparse
import itertools
import os
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from bench_whole import euroc_capture
from check_euroc import check

from colmap_inertial import ReconstructOptions, reconstruct
from colmap_inertial.io.capture import load_capture

#: OpenCV's features of an image, the best first, and how much nearer the best match is than the next.
FEATURES, RATIO = 2000, 0.8


def write_akaze(capture: Path, database: Path) -> None:
    """Fill a database with OpenCV's AKAZE and matches of all pairs."""
    described = load_capture(capture)
    database.unlink(missing_ok=True)
    # OpenCV 5 has it in its extra modules
    create = cv2.AKAZE_create if hasattr(cv2, "AKAZE_create") else cv2.xfeatures2d.AKAZE_create
    finder, matcher, descriptors = create(threshold=1e-4), cv2.BFMatcher(cv2.NORM_HAMMING), {}
    with pycolmap.Database.open(str(database)) as opened:
        known = described.camera
        camera = pycolmap.Camera(model=known.model, width=known.width, height=known.height, params=known.params)
        camera.camera_id = opened.write_camera(camera)
        for file in sorted(described.frames.folder.iterdir()):
            picture = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            points = sorted(finder.detect(picture), key=lambda point: -point.response)[:FEATURES]
            points, described_points = finder.compute(picture, points)
            number = opened.write_image(pycolmap.Image(name=file.name, camera_id=camera.camera_id))
            # COLMAP counts from the corner of the first pixel
            opened.write_keypoints(number, np.array([p.pt for p in points], np.float32) + 0.5)
            descriptors[number] = described_points
        for a, b in itertools.combinations(descriptors, 2):
            pairs = matcher.knnMatch(descriptors[a], descriptors[b], k=2)
            near = [(m.queryIdx, m.trainIdx) for m, n in pairs if m.distance < RATIO * n.distance]
            opened.write_matches(a, b, np.array(near, np.uint32).reshape(-1, 2))


def fill(colmap: Path, capture: Path, database: Path) -> None:
    """Let an installed COLMAP find features in a capture's images and match all pairs."""
    database.unlink(missing_ok=True)
    described = load_capture(capture)
    if described.camera is None:
        raise ValueError("the capture declares no camera")
    model, params = described.camera.model, ",".join(map(str, described.camera.params))
    environment = os.environ | {"QT_QPA_PLATFORM": "offscreen"}
    given = [str(colmap), "feature_extractor", "--database_path", str(database), "--image_path"]
    given += [str(described.frames.folder), "--ImageReader.camera_model", model, "--ImageReader.camera_params", params]
    given += ["--ImageReader.single_camera", "1", "--SiftExtraction.use_gpu", "0"]
    subprocess.run(given, check=True, env=environment, stdout=subprocess.DEVNULL)
    given = [str(colmap), "exhaustive_matcher", "--database_path", str(database), "--SiftMatching.use_gpu", "0"]
    subprocess.run(given, check=True, env=environment, stdout=subprocess.DEVNULL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--colmap", type=Path, default=Path("/usr/bin/colmap"), help="the installed COLMAP")
    args = parser.parse_args()
    capture, _ = euroc_capture(args.dataset, args.folder / "capture")
    options = {"own": ReconstructOptions()}
    write_akaze(capture, args.folder / "akaze.db")
    options["akaze"] = ReconstructOptions(database=args.folder / "akaze.db")
    if args.colmap.is_file():
        fill(args.colmap, capture, args.folder / "filled.db")
        options["filled"] = ReconstructOptions(database=args.folder / "filled.db")
        options["executable"] = ReconstructOptions(colmap_executable=args.colmap)
    own = 0.0
    for name, chosen in options.items():
        out = reconstruct(capture, args.folder / name, chosen)
        figures = check(out.workspace.root / "sparse" / "0", args.dataset)
        own = figures["scale_error_pct"] if name == "own" else own
        print(
            f"{name:<11} {figures['registered_images']:.0f} registered, {out.models[0].scale.verdict}, scale "
            f"{figures['scale_error_pct']:+.2f} +- {figures['stated_half_width_pct']:.2f} %, "
            f"{figures['scale_error_pct'] - own:+.2f} % from the plain run's, centres {figures['centre_rms_m']:.4f} m",
            flush=True,
        )


if __name__ == "__main__":
    main()
