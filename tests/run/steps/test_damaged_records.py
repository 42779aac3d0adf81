"""Damaged files that only this program writes and reads: manifests, configurations, results, records of a run."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.core.types import CameraModel, Treatment
from colmap_inertial.io.files import write_json
from colmap_inertial.model.similarities import read_scales, read_similarity
from colmap_inertial.run.stages.frame_folder import FrameRecord, read_frame_records
from colmap_inertial.run.steps.config import config_as_toml, read_config
from colmap_inertial.tools.batch import read_manifest
from colmap_inertial.tools.batch.task import CaptureStatus, read_end, read_status, write_status
from tests.helpers.cases import loop_over
from tests.helpers.damage import mutated, refusals
from tests.helpers.files import write_anew

MUTATIONS = 60
MODEL = {
    "index": 0,
    "registered_images": 3,
    "points": 100,
    "sparse_metric": "sparse/0",
    "metres_per_unit": 0.5,
    "sigma_log": 0.01,
    "ci95": [0.49, 0.51],
    "verdict": "trusted",
    "reasons": ["a"],
    "method": "joint",
    "gravity_in_world_m_s2": [0.0, 9.8, 0.1],
    "validation": {"scale_error_pct": 0.1, "within_tolerance": True},
}


def result(path: Path) -> None:
    write_json(path, {"models": [MODEL], "frames": [{"name": "a.jpg"}]})


def sim3(path: Path) -> None:
    write_json(path, {"scale": 2.0, "rotation_xyzw": [0, 0, 0, 1], "translation_m": [1, 2, 3], "provenance": "by hand"})


def manifest(path: Path) -> None:
    path.write_text(
        '[[capture]]\npath = "captures/hall"\n\n[[capture]]\nname = "yard-2"\npath = "yard/second.mp4"\n'
        'options.mapping.overlap = 5\noptions.world = "y-down"\nproject.imu = "imu.csv"\nproject.keep = ["old/*"]\n'
    )


def frames(path: Path) -> None:
    camera = CameraModel(model="PINHOLE", width=64, height=48, params=(50.0, 50.0, 32.0, 24.0))
    treated = Treatment(stage="deblur", reason="sharp", values={"blur_px": 0.3})
    records = [FrameRecord(name=f"{i}.jpg", action="passed", camera=camera, treatments=(treated,)) for i in range(3)]
    write_json(path, {"frames": records})


KINDS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "manifest": (manifest, read_manifest),
    "config": (
        lambda path: path.write_text(config_as_toml(ReconstructOptions())),
        lambda path: read_config(path, ReconstructOptions),
    ),
    "scales of a result": (result, lambda path: read_scales([str(path)])),
    "result in a batch": (result, lambda path: read_end(CaptureStatus(name="a"), path)),
    "similarity": (sim3, read_similarity),
    "frames": (frames, read_frame_records),
}


@loop_over("kind", KINDS)
def test_only_errors_of_our_own_escape(tmp_path, kind):
    write, read = KINDS[kind]
    path = tmp_path / "a.file"
    write(path)
    refusals(path, lambda: read(path), key=kind, count=MUTATIONS)


def test_a_damaged_status_is_none_and_never_an_error(tmp_path):
    path = tmp_path / "a.json"
    write_status(path, CaptureStatus(name="a", state="done", exit_code=0, models=(MODEL,)))
    whole = path.read_bytes()
    rng = np.random.default_rng(8)
    missing = 0
    for _ in range(MUTATIONS):
        write_anew(path, mutated(whole, rng))
        missing += read_status(path) is None
    assert missing > 0
