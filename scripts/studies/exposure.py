"""Exposure times that nobody states, estimated from blur and gyroscope: error, stated deviation and bounds.

    python -m scripts.studies.exposure [--exposures-ms 5 10 20 33] [--seeds 3] [--first-seed 2] [--noise-codes 0 4]
                                       [--cache FOLDER] [--shared ../shared] [--captures NAME ...] [--json study.json]

Photographs filmed by a camera that turns as a hand did (TUM-VI room 5; 960 x 540 px, 20 ms readout, noise, JPEG), eight
pairs of frames an exposure; noise in codes is added to the decoded frames. ``--captures`` are captures or videos of
their own, of which a stated exposure is taken away first and printed beside (karma's lens is taken as 60 degrees wide).
``deepgyro`` is the seven frames of that data set, 20 ms each.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_from_matrix
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel
from colmap_inertial.diagnose.frames import estimate_unstated_exposure
from colmap_inertial.imaging.exposure import (
    ExposureEstimate,
    compare_exposures,
    estimate_exposure,
    exposures_to_compare,
)
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.model import colmap_camera
from colmap_inertial.run.commands.diagnose import collect
from colmap_inertial.run.commands.scale import ScaleSource
from scripts.common.bench_report import write_report
from scripts.common.path_scenes import takes

SIZE, PAIRS, EVERY_S = (960, 540), 8, 1.3
SHARED = Path(__file__).parents[3] / "shared"


def film(shared: Path, exposure_s: float, seed: int, noise_codes: float, cache: Path | None) -> list[Array]:
    """What the frames of one simulated recording say."""
    (take,) = takes(
        shared / "data" / "sharp_photos",
        shared / "data" / "real_imu",
        [exposure_s],
        size=SIZE,
        every_s=EVERY_S,
        most=PAIRS,
        most_px=60,
        least_px=0.3,
        seed=seed,
        cache=cache,
    )
    rng = np.random.default_rng([seed, 17])
    exposures_s = exposures_to_compare(1.0)
    compared = []
    for pair in take.pairs:
        for k in (0, 1):
            motion, camera, shutter = pair.known(k, "exact")
            image = pair.frame(k) + noise_codes * rng.standard_normal(SIZE[::-1])
            shutter = replace(shutter, t_s=shutter.t_s + 0.5 * exposure_s)
            codes = np.clip(np.rint(image), 0, 255).astype(np.uint8)
            compared.append(compare_exposures(codes, motion, camera, shutter, exposures_s))
    return [one for one in compared if one is not None]


def deepgyro(folder: Path) -> list[Array]:
    """The seven frames of a tablet: its calibration is that of the paper's code."""
    stamps_ns = np.loadtxt(folder / "images" / "images.txt", dtype=np.int64)
    rows = np.loadtxt(folder / "imu" / "imu.txt")
    gyro = rows[rows[:, 0] == 4]
    # the gyroscope's first sample is 22 ms after the first exposure began
    t_s = (gyro[:, 1] - gyro[0, 1]) * 1e-9 + 0.022
    turn = -np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    path = GyroPath(t_s, gyro[:, 2:5], np.zeros(3))
    motion = GyroCamera(path=path, cam_from_imu_xyzw=quat_from_matrix(turn), offset_s=0.0)
    params = (1558.6899, 1558.6899, 939.6533, 518.4131)
    camera = colmap_camera(CameraModel(model="PINHOLE", width=1920, height=1080, params=params))
    compared = []
    for i, (stamp_ns, exposure_ns) in enumerate(stamps_ns.tolist()):
        image = cv2.imread(str(folder / "images" / f"{i + 1:04d}.jpg"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        middle_s = (stamp_ns - stamps_ns[0, 0] + 0.5 * exposure_ns) * 1e-9
        shutter = FrameShutter(width=1920, height=1080, t_s=middle_s, exposure_s=None, readout_s=0.0244944)
        if shutter.covered_by(motion):
            compared.append(compare_exposures(np.asarray(image), motion, camera, shutter, exposures_to_compare(1.0)))
    return [one for one in compared if one is not None]


def of_capture(path: Path) -> tuple[str, ExposureEstimate | NotObservableError]:
    """A capture's stated exposures, and the estimate without them."""
    recorded = collect(ScaleSource(source=path), lambda *_: None)
    timing, stated = recorded.timing, "unstated"
    if timing is not None and timing.exposure_s is not None:
        low, middle, high = np.percentile(1e3 * timing.exposure_s, [0, 50, 100])
        stated = f"{low:.1f} to {high:.1f}, median {middle:.1f} ms"
        timing = replace(timing, exposure_s=None, t_s=timing.t_s + 0.5 * timing.exposure_s)
    camera = recorded.camera
    if camera is None and recorded.images is not None:
        first = next(iter(recorded.images(recorded.in_full[:1])))
        params = (0.5 * first.width / np.tan(np.radians(30)), first.width / 2, first.height / 2)
        camera = CameraModel(model="SIMPLE_PINHOLE", width=first.width, height=first.height, params=params)
    try:
        return stated, estimate_unstated_exposure(replace(recorded, timing=timing, camera=camera))[0]
    except NotObservableError as error:
        return stated, error


def describe(found: ExposureEstimate | NotObservableError) -> str:
    """An estimate in words."""
    if isinstance(found, NotObservableError):
        return f"refused ({found.code}: {found.hint})"
    if found.exposure_s is None or found.sigma_s is None:
        return f"at most {1e3 * found.most_s:.1f} ms ({found.frames} frames)"
    return f"{1e3 * found.exposure_s:.1f} +- {1e3 * found.sigma_s:.1f} ms ({found.frames} frames)"


def estimated(compared: list[Array]) -> ExposureEstimate | NotObservableError:
    try:
        return estimate_exposure(compared, exposures_to_compare(1.0))
    except NotObservableError as error:
        return error


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--exposures-ms", nargs="*", type=float, default=[5.0, 10.0, 20.0, 33.0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=2)
    parser.add_argument("--noise-codes", nargs="+", type=float, default=[0.0])
    parser.add_argument("--cache", type=Path, help="keeps rendered frames")
    parser.add_argument("--shared", type=Path, default=SHARED)
    parser.add_argument("--captures", nargs="*", default=[])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for name in args.captures:
        if name == "deepgyro":
            stated, found = "20.0 ms", estimated(deepgyro(args.shared / "data" / "deepgyro" / "raw"))
        else:
            stated, found = of_capture(Path(name))
        print(f"{name}: stated {stated}, found {describe(found)}", flush=True)
    for exposure_ms in args.exposures_ms:
        for noise_codes in args.noise_codes:
            for seed in range(args.first_seed, args.first_seed + args.seeds):
                found = estimated(film(args.shared, 1e-3 * exposure_ms, seed, noise_codes, args.cache))
                print(f"{exposure_ms:5.1f} ms, seed {seed}, {noise_codes:g} codes: {describe(found)}", flush=True)
                told = asdict(found) if isinstance(found, ExposureEstimate) else {"refused": found.code}
                rows.append({"true_s": 1e-3 * exposure_ms, "seed": seed, "noise_codes": noise_codes, **told})
    if args.json is not None:
        write_report(args.json, {"rows": rows})


if __name__ == "__main__":
    main()
