"""EuRoC's stereo keyframes as a COLMAP rig of unknown extrinsics: the baseline in metres against its calibration.

    python -m scripts.studies.check_rig DATASET FOLDER [--frames 100] [--capture {declared,found}]

DATASET has ``keyframes/`` and ``mav0/`` of EuRoC V1_01_easy. COLMAP maps the images of both cameras, derives the rig
from that model and maps again with it; ``reconstruct`` gets this project, the IMU and the times of all images. With
``--capture``, it gets a capture with a rig in its place, whose extrinsics are declared or to be found. FOLDER takes the
work and is made. Printed: the distance and rotation between the cameras against the calibration of the data
set, the scale's interval and verdict, and the scale error against motion capture.
"""

import argparse
import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import yaml

from colmap_inertial import MappingOptions, ProjectOptions, ReconstructOptions, reconstruct, reconstruct_project
from colmap_inertial.core.geometry import quat_from_matrix, quat_log, quat_multiply
from colmap_inertial.io.sensor_yaml import read_camera
from scripts.studies.check_euroc import check

CAMERAS = ("cam0", "cam1")
#: Frames so many places apart are matched, images of one frame as well.
OVERLAP = 5
SEED = 1


def read_sensor(dataset: Path, camera: str) -> dict:
    """A camera's file of the data set."""
    return yaml.safe_load((dataset / "mav0" / camera / "sensor.yaml").read_text().replace("%YAML:1.0", ""))


def true_cam1_from_cam0(dataset: Path) -> np.ndarray:
    """(4, 4) by the calibration of the data set."""
    imu_from_cam = [np.array(read_sensor(dataset, name)["T_BS"]["data"]).reshape(4, 4) for name in CAMERAS]
    return np.linalg.inv(imu_from_cam[1]) @ imu_from_cam[0]


def write_project(dataset: Path, project: Path, most: int) -> Path:
    """Images, database and model of a COLMAP project with a rig; returns the table of times of all images."""
    stamps = sorted(path.name.split("_")[0] for path in (dataset / "keyframes").glob("*_0.jpg"))[:most]
    names = {camera: [f"{camera}/{stamp}.jpg" for stamp in stamps] for camera in CAMERAS}
    images, database = project / "images", project / "database.db"
    for number, camera in enumerate(CAMERAS):
        (images / camera).mkdir(parents=True)
        for stamp in stamps:
            shutil.copy(dataset / "keyframes" / f"{stamp}_{number}.jpg", images / camera / f"{stamp}.jpg")
        sensor = read_sensor(dataset, camera)
        params = [*sensor["intrinsics"], *sensor["distortion_coefficients"]]
        reader = pycolmap.ImageReaderOptions(camera_model="OPENCV", camera_params=",".join(map(str, params)))
        mode = pycolmap.CameraMode.PER_FOLDER
        pycolmap.extract_features(database, images, names[camera], mode, reader, device=pycolmap.Device.cpu)
    pairs = [
        f"{names[a][i]} {names[b][j]}"
        for i in range(len(stamps))
        for j in range(i, min(i + OVERLAP + 1, len(stamps)))
        for a in CAMERAS
        for b in CAMERAS
        if (i, a) < (j, b)
    ]
    (project / "pairs.txt").write_text("\n".join(pairs) + "\n")
    pairing = pycolmap.ImportedPairingOptions(match_list_path=project / "pairs.txt")
    pycolmap.match_image_pairs(database, pairing_options=pairing, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions(random_seed=SEED)
    (project / "apart").mkdir()
    apart = pycolmap.incremental_mapping(database, images, project / "apart", options)
    largest = max(apart.values(), key=lambda model: model.num_reg_images())
    rig = [
        pycolmap.RigConfigCamera(image_prefix=f"{name}/", ref_sensor=name == CAMERAS[0], cam_from_rig=None)
        for name in CAMERAS
    ]
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=rig)], opened, largest)
    shutil.rmtree(project / "apart")
    (project / "sparse").mkdir()
    pycolmap.incremental_mapping(database, images, project / "sparse", options)
    times = project / "times.csv"
    rows = [f"{name},{Path(name).stem}" for camera in CAMERAS for name in names[camera]]
    times.write_text("\n".join(["name,timestamp [ns]", *rows]) + "\n")
    return times


def write_capture(dataset: Path, capture: Path, most: int, *, declared: bool) -> Path:
    """A capture of both cameras, which gives the pose of the second one or not; returns its capture.toml."""
    stamps = sorted(path.name.split("_")[0] for path in (dataset / "keyframes").glob("*_0.jpg"))[:most]
    for number, camera in enumerate(CAMERAS):
        (capture / camera).mkdir(parents=True)
        for stamp in stamps:
            shutil.copy(dataset / "keyframes" / f"{stamp}_{number}.jpg", capture / camera / f"{stamp}.jpg")
    sheets = [(dataset / "mav0" / camera / "sensor.yaml").resolve() for camera in CAMERAS]
    second = f'sensor_yaml = "{sheets[1]}"'
    if not declared:  # the sheet would give the pose
        model = read_camera(sheets[1])
        second = f'model = "{model.model}"\nwidth = {model.width}\nheight = {model.height}\n'
        second += f'params = {list(model.params)}\npixel_origin = "corner"'
    (capture / "capture.toml").write_text(
        f'[images]\nfolder = "cam0"\ntimes = "name"\ntime_unit = "ns"\n[camera]\nsensor_yaml = "{sheets[0]}"\n'
        f'[imu]\npath = "{(dataset / "mav0" / "imu0").resolve()}"\n[timing]\nreadout_s = 0\nshared_clock = true\n'
        f'[rig.cam1]\nfolder = "cam1"\n[rig.cam1.camera]\n{second}\n'
    )
    return capture / "capture.toml"


def check_rig(dataset: Path, folder: Path, most: int, capture: str | None = None) -> dict[str, float | str]:
    """The figures that are printed."""
    folder.mkdir(parents=True)
    if capture is None:
        times = write_project(dataset, folder / "project", most)
        source = ProjectOptions(imu=dataset / "mav0" / "imu0", frame_times=times)
        made = reconstruct_project(folder / "project", folder / "out", source)
    else:
        toml = write_capture(dataset, folder / "capture", most, declared=capture == "declared")
        mapping = MappingOptions(pairing="sequential", overlap=OVERLAP)
        made = reconstruct(toml, folder / "out", ReconstructOptions(deterministic=True, mapping=mapping))
    model = json.loads((made.workspace.root / "result.json").read_text())["models"][0]
    (sensor,) = model["rig"]
    true = true_cam1_from_cam0(dataset)
    inverse = quat_from_matrix(true[:3, :3].T)
    apart = quat_log(quat_multiply(np.array(sensor["cam_from_reference_xyzw"]), inverse))
    baseline_m = float(np.linalg.norm(true[:3, 3]))
    truth = check(made.workspace.root / "sparse" / "0", dataset) if most >= 20 else {}
    return {
        "images": model["registered_images"],
        "verdict": model["verdict"],
        "baseline_m": sensor["baseline_m"],
        "true_baseline_m": baseline_m,
        "baseline_error_pct": 100 * (sensor["baseline_m"] / baseline_m - 1),
        "rotation_error_deg": float(np.degrees(np.linalg.norm(apart))),
        **truth,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--capture", choices=("declared", "found"))
    given = parser.parse_args()
    for name, value in check_rig(given.dataset, given.folder, given.frames, given.capture).items():
        print(f"{name:<22} {value if isinstance(value, str) else format(value, '.5g')}")


if __name__ == "__main__":
    main()
