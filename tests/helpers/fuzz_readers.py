"""Every reader of files from outside, with whole files for it: what ``scripts/studies/fuzz.py`` damages."""

import dataclasses
import functools
import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.io.calibration import read_calibration
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.exif import read_exposures_s, stamps_of_exif
from colmap_inertial.io.frame_times import stamps_of_log
from colmap_inertial.io.images import read_image
from colmap_inertial.io.imu import read_frame_log, read_imu
from colmap_inertial.io.rig_calibration import read_rig_calibration
from colmap_inertial.io.trajectories import read_inertial_scale
from colmap_inertial.model import read_model
from colmap_inertial.model.project import apply_to_project, undo_project
from colmap_inertial.model.similarities import plain_factor, read_scales, read_similarity
from colmap_inertial.report import write_report
from colmap_inertial.run.steps.config import read_config
from colmap_inertial.tools.batch.manifest import read_manifest
from colmap_inertial.tools.simulate.recipe import load_recipe, recipe_text
from colmap_inertial.tools.simulate.truth import read_truth
from colmap_inertial.tools.view.clouds import dense_cloud, read_mesh
from colmap_inertial.tools.view.images import read_preview
from colmap_inertial.tools.view.scene import load_scene
from tests.helpers import imu_files, model_project, report_runs
from tests.helpers.damage import mutated
from tests.helpers.fuzz_structure import structural
from tests.helpers.simulated_imu import FRAME_NS, at_one_clock, recorded
from tests.io import test_damaged_files
from tests.io.test_recorders import LAYOUTS
from tests.run.stages.test_apertures import kalibr_text

SCENE = Path(__file__).resolve().parents[2] / "example_scenes" / "desk"
#: What a size, count, offset or measure may say instead.
EXTREME = [struct.pack(f"<{kind}", value) for kind, value in (
    ("I", 0), ("I", 1), ("I", 0x7FFFFFFF), ("I", 0x80000000), ("I", 0xFFFFFFFF), ("Q", 0), ("Q", 2**31), ("Q", 2**40),
    ("Q", 2**63 - 1), ("Q", 2**63), ("Q", 2**64 - 1), ("f", np.nan), ("f", np.inf), ("f", -1.0), ("f", 3e38),
    ("d", np.nan), ("d", -np.inf), ("d", -1.0), ("d", 1e300), ("d", 1e-300),
)]  # fmt: skip


@dataclass(frozen=True)
class Reader:
    """``build`` writes whole files into a folder and returns those that are damaged; ``read`` reads the folder.

    ``cost`` is roughly how many times longer it takes than the others: it gets as many fewer mutants.
    """

    build: Callable[[Path], list[Path]]
    read: Callable[[Path], object]
    cost: float = 1.0


def mutant(data: bytes, rng: np.random.Generator) -> bytes:
    """A damaged copy: mostly of its structure; of text as ``test_io_fuzz`` has it; of binary files also of sizes and
    measures that cannot be."""
    changed = structural(data, rng) if rng.random() < 0.75 else None
    if changed is not None:
        return changed
    if b"\0" in data and rng.random() < 0.6 and len(data) > 8:
        out = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            said = EXTREME[rng.integers(0, len(EXTREME))]
            said = said[::-1] if rng.random() < 0.4 else said
            # beginnings and ends of files hold what the rest is read by
            span = (0, min(len(out), 400)) if rng.random() < 0.4 else (0, len(out))
            span = (max(0, len(out) - 1200), len(out)) if rng.random() < 0.3 else span
            at = int(rng.integers(*span))
            out[at : at + len(said)] = said[: len(out) - at]
        return bytes(out)
    return mutated(data, rng)


def each(*calls: Callable[[], object]) -> None:
    """Make all calls; raise the last one's error where all of them were refused."""
    refused = []
    for call in calls:
        try:
            call()
        except InertialError as error:
            refused.append(error)
    if len(refused) == len(calls):
        raise refused[-1]


def _listed(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


@functools.cache
def small_recording(one_clock: bool):
    """Some hundred samples of both sensors."""
    imu = recorded(100.0, 100.0)
    imu = at_one_clock(imu) if one_clock else imu
    n = 120
    return dataclasses.replace(
        imu, gyro_t_s=imu.gyro_t_s[:n], gyro_rad_s=imu.gyro_rad_s[:n], accel_t_s=imu.accel_t_s[:n],
        accel_m_s2=imu.accel_m_s2[:n],
    )  # fmt: skip


def _recorder(name: str) -> Reader:
    layout = LAYOUTS[name]

    def build(folder: Path) -> list[Path]:
        path = layout.write(folder, small_recording(layout.one_clock))
        (folder / "at.txt").write_text(str(path.relative_to(folder)))
        return [found for found in _listed(folder) if found.name != "at.txt"]

    def read(folder: Path) -> None:
        path = folder / (folder / "at.txt").read_text()
        each(lambda: read_imu(path), lambda: read_frame_log(path), lambda: load_capture(path))

    return Reader(build, read, cost=3.0 if "ros" in name else 1.0)


def _one(name: str) -> Reader:
    """A reader of ``test_io_fuzz``."""
    build, read = test_damaged_files.READERS[name]
    at: dict[Path, Path] = {}

    def build_one(folder: Path) -> list[Path]:
        at[folder] = build(folder)
        return [at[folder]]

    return Reader(build_one, lambda folder: read(at[folder]), cost=4.0 if name == "video" else 1.0)


def _dji(folder: Path) -> list[Path]:
    return [imu_files.write_dji(folder / "a.mp4")]


def _project(folder: Path) -> list[Path]:
    model_project.write_project(folder / "project")
    for name in ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt"):
        (folder / "project" / "sparse" / "0" / name).unlink()
    return [path for path in _listed(folder / "project") if path.suffix not in (".png", ".jpg")]


def _text_model(folder: Path) -> list[Path]:
    model_project.sparse_model(np.random.default_rng(4)).write_text(str(folder))
    return _listed(folder)


def _binary_model(folder: Path) -> list[Path]:
    model_project.sparse_model(np.random.default_rng(4)).write_binary(str(folder))
    return _listed(folder)


def _applied(folder: Path) -> list[Path]:
    _project(folder)
    apply_to_project(folder / "project", folder / "metric", plain_factor(2.0))
    shutil.rmtree(folder / "project")
    return [path for path in _listed(folder / "metric") if path.suffix in (".json", ".bin", ".db")]


def _into_out(do: Callable[[Path, Path], object]) -> Callable[[Path], None]:
    """``do`` with the folder and a new folder for its output, of which nothing is left behind."""

    def read(folder: Path) -> None:
        out = folder / "out"
        try:
            do(folder, out)
            assert out.is_dir()
        except InertialError:
            assert not out.exists()
            raise
        finally:
            shutil.rmtree(out, ignore_errors=True)

    return read


def _clouds(folder: Path) -> list[Path]:
    model_project.write_project(folder)
    found = [folder / "dense" / name for name in ("fused.ply", "meshed-poisson.ply", "ascii.ply")]
    for path in _listed(folder):
        if path not in found:
            path.unlink()
    return found


def _read_clouds(folder: Path) -> None:
    paths = [folder / "dense" / name for name in ("fused.ply", "meshed-poisson.ply", "ascii.ply")]
    each(
        *(lambda path=path: dense_cloud(path, 1000) for path in paths), *(lambda p=p: read_mesh(p, 9000) for p in paths)
    )


def _jsons(folder: Path) -> list[Path]:
    similarity = {"scale": 2.0, "rotation_xyzw": [0, 0, 0, 1], "translation_m": [0, 0, 0], "provenance": "measured"}
    (folder / "sim3.json").write_text(json.dumps(similarity))
    scale = report_runs.recorded()[2].as_json()
    (folder / "scale.json").write_text(json.dumps(scale))
    shutil.copy(SCENE / "truth.json", folder)
    return _listed(folder)


def _read_jsons(folder: Path) -> None:
    each(
        lambda: read_similarity(folder / "sim3.json"),
        lambda: read_scales([str(folder / "scale.json")]),
        lambda: read_truth(folder / "truth.json"),
        lambda: read_calibration(folder / "scale.json"),
    )


def _tomls(folder: Path) -> list[Path]:
    from colmap_inertial.run.steps.config import config_as_toml

    (folder / "config.toml").write_text(config_as_toml(ReconstructOptions()))
    (folder / "manifest.toml").write_text(
        '[[capture]]\npath = "captures/hall"\n\n[[capture]]\nname = "yard-2"\npath = "yard/second.mp4"\n'
        'config = "config.toml"\noptions.mapping.overlap = 5\nstages.frame = ["a:b"]\n'
    )
    shutil.copy(SCENE / "recipe.toml", folder)
    return _listed(folder)


def _read_tomls(folder: Path) -> None:
    each(
        lambda: read_config(folder / "config.toml", ReconstructOptions),
        lambda: read_manifest(folder / "manifest.toml", allow_stages=True),
        lambda: recipe_text(load_recipe(folder / "recipe.toml")),
    )


def _frame_logs(folder: Path) -> list[Path]:
    rows = "\n".join(map(str, FRAME_NS))
    (folder / "bare.txt").write_text(rows)
    (folder / "named.csv").write_text(f"timestamp_ns\n{rows}")
    return _listed(folder)


def _rigs(folder: Path) -> list[Path]:
    (folder / "camchain.yaml").write_text(kalibr_text())
    numbers = ", ".join(map(str, np.eye(3).ravel()))
    matrix = "!!opencv-matrix {rows: 3, cols: 3, dt: d, data: [" + numbers + "]}"
    (folder / "stereo.yml").write_text(f"%YAML:1.0\n---\nM1: {matrix}\nM2: {matrix}\nR: {matrix}\nT: [0.1, 0, 0]\n")
    camera = {"image_prefix": "a/", "ref_sensor": True, "camera_model_name": "PINHOLE", "camera_params": [5, 5, 3, 2]}
    other = {
        **camera,
        "image_prefix": "b/",
        "cam_from_rig_rotation": [1, 0, 0, 0],
        "cam_from_rig_translation": [1, 0, 0],
    }
    (folder / "rig_config.json").write_text(json.dumps([{"cameras": [camera, {**other, "ref_sensor": False}]}]))
    return _listed(folder)


def _exif(folder: Path) -> list[Path]:
    import cv2

    from tests.io.test_frames import picture

    tiff = b"II*\0\x08\0\0\0\x02\0" + struct.pack("<HHII", 0x8769, 4, 1, 38) + struct.pack("<HHII", 0x0132, 2, 20, 80)
    tiff += bytes(4) + struct.pack("<H", 2) + struct.pack("<HHII", 0x829A, 5, 1, 100)
    tiff += struct.pack("<HHII", 0x9003, 2, 20, 110) + bytes(4)
    tiff = tiff.ljust(80, b"\0") + b"2026:01:01 12:00:00\0"
    tiff = tiff[:100] + struct.pack("<II", 1, 100) + bytes(2) + b"2026:01:01 12:00:01\0"
    body = b"Exif\0\0" + tiff
    data = cv2.imencode(".jpg", picture(1))[1].tobytes()
    (folder / "a.jpg").write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:])
    return [folder / "a.jpg"]


def _desk(folder: Path) -> list[Path]:
    for name in ("capture.toml", "gyro.csv", "accel.csv", "frames.csv"):
        shutil.copy(SCENE / name, folder)
    text = (folder / "capture.toml").read_text()
    (folder / "capture.toml").write_text(text)
    for name in ("gyro.csv", "accel.csv"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join(lines[:150]) + "\n")
    return _listed(folder)


def _read_desk(folder: Path) -> None:
    from colmap_inertial.io.frames import read_frame_timing
    from colmap_inertial.io.imu import read_capture_imu

    capture = load_capture(folder)
    each(lambda: read_capture_imu(capture), lambda: read_frame_timing(capture))


def _inertial_scale(folder: Path) -> list[Path]:
    test_damaged_files.inertial_scale(folder)
    lines = (f"{i * 10**8} {i} 0 0.5 0 0 0.6 0.8" for i in range(1, 30))
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    return _listed(folder)


def _run(folder: Path) -> list[Path]:
    report_runs.write_run(folder / "run", points=40, duration_s=8.0)
    return [path for path in _listed(folder / "run") if path.suffix not in (".jpg", ".png")]


def _shown(folder: Path) -> list[Path]:
    """A finished run with a model, as ``view`` takes it."""
    from tests.tools.view.test_view import ESTIMATE, write_result

    write_result(folder / "out", [ESTIMATE])
    return [path for path in _listed(folder / "out") if path.suffix in (".json", ".bin", ".tum", ".ply")]


READERS: dict[str, Reader] = {
    **{name: _one(name) for name in test_damaged_files.READERS},
    **{name: _recorder(name) for name in LAYOUTS},
    "dji": Reader(
        _dji, lambda folder: each(lambda: read_imu(folder / "a.mp4"), lambda: load_capture(folder / "a.mp4"))
    ),
    "capture with tables": Reader(_desk, _read_desk),
    "poses and sensors": Reader(_inertial_scale, read_inertial_scale),
    "frame log": Reader(
        _frame_logs,
        lambda folder: each(
            lambda: stamps_of_log(folder / "named.csv"), lambda: stamps_of_log(folder / "bare.txt", "ns")
        ),
    ),
    "exif": Reader(
        _exif,
        lambda folder: each(
            lambda: stamps_of_exif(folder, ["a.jpg"]),
            lambda: read_exposures_s([folder / "a.jpg"]),
            lambda: read_image(folder / "a.jpg"),
            lambda: read_preview(folder / "a.jpg", 32),
        ),
    ),
    "rig calibrations": Reader(
        _rigs, lambda folder: each(*(lambda path=path: read_rig_calibration(path) for path in _listed(folder)))
    ),
    "scales and truths (json)": Reader(_jsons, _read_jsons),
    "config, manifest, recipe (toml)": Reader(_tomls, _read_tomls),
    "model (text)": Reader(_text_model, read_model, cost=3.0),
    "model (binary)": Reader(_binary_model, read_model, cost=3.0),
    "clouds and meshes (ply)": Reader(_clouds, _read_clouds),
    "apply": Reader(
        _project,
        _into_out(lambda folder, out: apply_to_project(folder / "project", out, plain_factor(2.0))),
        cost=15.0,
    ),
    "apply --undo": Reader(_applied, _into_out(lambda folder, out: undo_project(folder / "metric", out)), cost=15.0),
    "report": Reader(_run, lambda folder: write_report(folder / "run"), cost=30.0),
    "view": Reader(_shown, lambda folder: load_scene(folder / "out", max_points=1000), cost=3.0),
}
