"""More readers of files from outside: tables, maps, databases and records that single steps read."""

import shutil
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pycolmap

from colmap_inertial.colmap.features.given_database import read_given
from colmap_inertial.colmap.settings import read_settings
from colmap_inertial.colmap.views.two_views import open_features
from colmap_inertial.io.calibration import read_calibrations, write_imu_calibration
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.files import write_json
from colmap_inertial.io.frames import read_frame_timing
from colmap_inertial.io.imu import read_frame_log, read_imu
from colmap_inertial.io.ply import transform_ply
from colmap_inertial.io.positions import positions_in_video
from colmap_inertial.io.rig_calibration import read_rig_calibration
from colmap_inertial.model.artefacts import read_map, transform_depth_map, transform_obj, transform_options, write_map
from colmap_inertial.model.database import transform_database
from colmap_inertial.model.nerf import transform_transforms
from colmap_inertial.model.similarities import plain_factor
from colmap_inertial.model.submodels.matches import read_matches
from colmap_inertial.run.preparation.geolocation import read_georeference
from colmap_inertial.run.stages.frame_folder import read_frame_records
from colmap_inertial.tools.batch.task import CaptureStatus, read_end, read_status, write_status
from colmap_inertial.tools.export.source import read_source
from colmap_inertial.validate.markers import add_bars, add_check_points
from tests.helpers import imu_files, model_project
from tests.helpers.exposure_scenes import write_pair_capture
from tests.helpers.fuzz_readers import Reader, each, small_recording
from tests.helpers.markers_in_model import PLACES, validated
from tests.helpers.model_project import camera_poses, cast
from tests.helpers.position_walks import walk
from tests.helpers.report_runs import write_run
from tests.io.test_splats import write_splats, write_trained
from tests.run.commands.test_calibrate_imu import known
from tests.run.stages.test_apertures import ROTATION, SHIFT, write_plane_capture

DOUBLE = plain_factor(2.0)


def _clouds(folder: Path) -> list[Path]:
    write_splats(folder / "binary.ply", 1, kind="f4")
    write_splats(folder / "text.ply", 0, text=True)
    rows = "".join(f"{i} {i % 3} 1 {i} 0 0\n" for i in range(30))
    head = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    faces = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    (folder / "mesh.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 30\n{head}{faces}{rows}3 0 1 2\n3 2 3 4\n")
    return sorted(folder.glob("*.ply"))


def _read_clouds(folder: Path) -> None:
    each(*(lambda p=p: transform_ply(p, folder / "out", DOUBLE) for p in sorted(folder.glob("*.ply"))))


def _maps(folder: Path) -> list[Path]:
    depth, normals = cast(*next(iter(camera_poses())))
    write_map(folder / "depth.bin", depth)
    write_map(folder / "normal.bin", np.moveaxis(normals, 0, -1))
    (folder / "a.obj").write_text("mtllib a.mtl\nv 0 0 1\nv 1 0 1 0.5 0.5 0.5\nvn 0 0 1\nf 1//1 2//1 1//1\n")
    (folder / "a.ini").write_text("[PatchMatchStereo]\r\ndepth_min=0.25 \r\ndepth_max = -1\r\nwindow_radius=5\r\n")
    return sorted(folder.iterdir())


def _read_maps(folder: Path) -> None:
    out = folder / "out"
    each(
        lambda: read_map(folder / "depth.bin"),
        lambda: read_map(folder / "normal.bin", 3),
        lambda: transform_depth_map(folder / "depth.bin", out, DOUBLE),
        lambda: transform_obj(folder / "a.obj", out, DOUBLE),
        lambda: transform_options(folder / "a.ini", out, DOUBLE),
    )


def _nerf(folder: Path) -> list[Path]:
    write_trained(folder / "trained")
    for name in ("ours", "swapped"):
        shutil.copy(folder / "trained" / name / "transforms.json", folder / f"{name}.json")
    shutil.rmtree(folder / "trained")
    return sorted(folder.glob("*.json"))


def _read_nerf(folder: Path) -> None:
    each(*(lambda p=p: transform_transforms(p, folder / "out", DOUBLE) for p in sorted(folder.glob("*.json"))))


def _database(folder: Path) -> list[Path]:
    model = model_project.sparse_model(np.random.default_rng(4))
    model_project.write_database(folder / "database.db", model)
    with pycolmap.Database.open(str(folder / "database.db")) as opened:
        images = opened.read_all_images()
        for image in images:
            opened.write_keypoints(image.image_id, np.random.default_rng(1).random((20, 2), np.float32) * 90)
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.inlier_matches = np.tile(np.arange(20, dtype=np.uint32)[:, None], (1, 2))
        opened.write_two_view_geometry(images[0].image_id, images[1].image_id, geometry)
    return [folder / "database.db"]


def _read_database(folder: Path) -> None:
    path = folder / "database.db"

    def features() -> None:
        with open_features(path) as opened:
            names = sorted(opened.images)
            for name in names:
                opened.rays(name)
            opened.matches(*names[:2])

    each(
        lambda: list(read_matches(path, lambda first, second: True)),
        features,
        lambda: transform_database(path, folder / "copy.db", [], {}),
    )


def _rig_model(folder: Path) -> list[Path]:
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    for number, name in ((1, "PINHOLE"), (2, "OPENCV"), (3, "SIMPLE_RADIAL_FISHEYE")):
        camera = pycolmap.Camera.create_from_model_name(number, name, 500.0, 320, 240)
        model.add_camera(camera)
        if number == 1:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(pycolmap.Rotation3d(ROTATION), number * SHIFT))
    model.add_rig(rig)
    model.write_binary(str(folder))
    return [folder / "rigs.bin", folder / "cameras.bin"]


def _lengths(folder: Path) -> list[Path]:
    (folder / "bars.csv").write_text("marker_a,marker_b,length_m,sigma_m\n0,1,2.001,0.0002\n1,3,3.2,\n")
    rows = [f"{number},{10 + x},{20 + y},{z},0.002" for number, (x, y, z) in PLACES.items()]
    (folder / "points.csv").write_text("marker,x,y,z,sigma_m\n" + "\n".join(rows) + "\n")
    return sorted(folder.iterdir())


def _read_lengths(folder: Path) -> None:
    one = validated()
    each(lambda: add_bars(one, folder / "bars.csv"), lambda: add_check_points(one, folder / "points.csv"))


def _records(folder: Path) -> list[Path]:
    write_json(folder / "georeference.json", {"models": [{"model": 0, **walk(7).fitted().as_json()}]})
    write_imu_calibration(folder / "imu.json", known())
    write_status(folder / "status.json", CaptureStatus(name="a", state="running", steps=3))
    write_run(folder / "run", points=40, duration_s=8.0)
    shutil.copy(folder / "run" / "result.json", folder)
    shutil.rmtree(folder / "run")
    return sorted(folder.iterdir())


def _read_records(folder: Path) -> None:
    each(
        lambda: read_georeference(folder / "georeference.json", 0),
        lambda: read_calibrations(folder / "imu.json"),
        lambda: read_status(folder / "status.json"),
        lambda: read_end(CaptureStatus(name="a"), folder / "result.json"),
        lambda: read_frame_records(folder / "result.json"),
    )


def _positions(folder: Path) -> list[Path]:
    imu, place = small_recording(False), np.array([[t, 50 + 1e-5 * t, 8.0, 200.0] for t in np.arange(0.05, 3.0, 0.05)])
    gps = (b"GPS5", place[:, 0], place[:, 1:], -1)
    return [
        imu_files.write_gopro(folder / "gopro.mp4", imu, gps=gps),
        imu_files.write_camm(folder / "camm.mp4", imu, fixes=place),
    ]


def _exported(folder: Path) -> list[Path]:
    from tests.tools.view.test_view import ESTIMATE, write_result

    write_result(folder / "out", [ESTIMATE])
    return [path for path in sorted((folder / "out").rglob("*")) if path.suffix in (".json", ".bin", ".npz")]


def _apertures(folder: Path) -> list[Path]:
    write_plane_capture(folder)
    return [folder / "capture.toml", folder / "rig.yaml"]


def _exposures(folder: Path) -> list[Path]:
    write_pair_capture(folder / "capture", pairs=2, size=(120, 80))
    return [path for path in sorted((folder / "capture").iterdir()) if path.suffix in (".toml", ".csv")]


def _read_capture(folder: Path) -> None:
    capture = load_capture(folder)
    each(lambda: read_frame_timing(capture), lambda: capture.apertures)


def _given(folder: Path) -> list[Path]:
    path = folder / "given.db"
    with pycolmap.Database.open(str(path)) as opened:
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=320, height=240, params=[300, 160, 120, 0])
        camera.camera_id = opened.write_camera(camera)
        rng = np.random.default_rng(2)
        for name in ("a.jpg", "b.jpg"):
            number = opened.write_image(pycolmap.Image(name=name, camera_id=camera.camera_id))
            opened.write_keypoints(number, 90 * rng.random((20, 2), np.float32))
            kind = pycolmap.FeatureExtractorType.SIFT
            data = rng.integers(0, 255, (20, 128), np.uint8)
            opened.write_descriptors(number, pycolmap.FeatureDescriptors(kind, data))
        opened.write_matches(1, 2, np.tile(np.arange(20, dtype=np.uint32)[:, None], (1, 2)))
    return [path]


def _settings(folder: Path) -> list[Path]:
    (folder / "project.ini").write_text("[Mapper]\ninit_num_trials=60\n[SiftExtraction]\nmax_num_features=900\n")
    return [folder / "project.ini"]


def _telemetry(folder: Path) -> list[Path]:
    imu = small_recording(True)
    return [
        imu_files.write_insta360(
            folder / "VID.mp4", imu, next(iter(imu_files.INSTA360S)), counts=True, readout_ms=16.5
        ),
        imu_files.write_runcam(folder, imu, next(iter(imu_files.RUNCAMS))),
    ]


def _read_telemetry(folder: Path) -> None:
    each(*(lambda p=p: read_imu(p) for p in sorted(folder.iterdir())), lambda: read_frame_log(folder / "VID.mp4"))


#: Of the extra ``devices``, which not every Python has.
DEVICES = {"telemetry": Reader(_telemetry, _read_telemetry)} if find_spec("telemetry_parser") else {}
MORE: dict[str, Reader] = {
    **DEVICES,
    "given database": Reader(_given, lambda folder: read_given(folder / "given.db"), cost=3.0),
    "project.ini": Reader(_settings, lambda folder: read_settings((), folder / "project.ini")),
    "splats and meshes (ply)": Reader(_clouds, _read_clouds),
    "maps, meshes and options": Reader(_maps, _read_maps),
    "transforms.json": Reader(_nerf, _read_nerf),
    "database": Reader(_database, _read_database, cost=3.0),
    "rig (model)": Reader(_rig_model, read_rig_calibration),
    "measured lengths": Reader(_lengths, _read_lengths),
    "records": Reader(_records, _read_records),
    "positions": Reader(
        _positions, lambda folder: each(*(lambda p=p: positions_in_video(p) for p in sorted(folder.glob("*.mp4"))))
    ),
    "export": Reader(_exported, lambda folder: read_source(folder / "out"), cost=3.0),
    "apertures": Reader(_apertures, _read_capture),
    "exposures": Reader(_exposures, lambda folder: _read_capture(folder / "capture")),
}
