"""The page of a run: what its template takes beside the content, as labelled values and rows of tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from colmap_inertial.core.quantiles import Z95
from colmap_inertial.inertial.scale.verdict import scale_drifts
from colmap_inertial.report import figures
from colmap_inertial.report.content import find_refined_parts
from colmap_inertial.report.evidence import device_in_words, evidence_facts
from colmap_inertial.report.figure_3d import scene_figure
from colmap_inertial.report.page import render_page
from colmap_inertial.report.series import SIZES
from colmap_inertial.report.words import (
    Fact,
    checked_in_words,
    digits,
    model_facts,
    not_checked,
    place_facts,
    scale_facts,
    sensor_facts,
    target_facts,
)

Content = dict[str, Any]
Rows = list[tuple[str, ...]]

_METHODS = {"joint": "all measurements in one fit", "spectral": "spectra of both sensors"}
#: What the paths of a result are.
_WRITTEN = {
    "sparse": "COLMAP's own model",
    "sparse_metric": "the model in metres",
    "trajectory": "the camera's path in metres, smoothed by the IMU or refined",
    "fused": "the dense point cloud in metres",
    "mesh": "the mesh in metres",
    "project_metric": "the whole project in metres",
}
#: What COLMAP calls the parameters of its cameras; the others are distortion.
_PARAMETERS = {
    "f": "focal length",
    "fx": "focal length, across",
    "fy": "focal length, down",
    "cx": "principal point, across",
    "cy": "principal point, down",
}


def run_page(content: Content, out: Path) -> str:
    """The report as HTML.

    Parameters
    ----------
    content
        As ``colmap_inertial.report`` describes it.
    out
        Folder that its images' paths start from.
    """
    made, left_out = content["made"], Rows()
    versions = ", ".join(f"{name} {number}" for name, number in content["versions"].items())
    if made is not None:
        versions = f"{made['date']}, {versions}, {made['machine']}, {made['processors']} processors"

    def has_data(title: str, record: Content) -> bool:
        """Whether there is data for a section; noted where not."""
        if "missing" in record:
            left_out.append((title, record["missing"]))
        return "missing" not in record

    helpers: Sequence[Callable[..., Any]] = (
        *(run_facts, survey_facts, target_facts, intrinsics_rows, readout_rows, list_outputs, model_rows, gap_rows),
        *(
            count_drifted_parts,
            find_refined_parts,
            checked_in_words,
            not_checked,
            scale_drifts,
            scale_facts,
            scene_figure,
        ),
        *(device_in_words, evidence_facts),
    )
    return render_page(
        "report.html",
        out=out,
        content=content,
        title=content["title"],
        tone=content["outcome"]["verdict"],
        source=content["capture"],
        footer=f"{versions}. The same content for programs: report.json.",
        left_out=left_out,
        has_data=has_data,
        figures=figures,
        rms_of=_rms_of_images,
        z95=Z95,
        **{helper.__name__: helper for helper in helpers},
    )


def run_facts(content: Content) -> Iterator[Fact]:
    """The numbers below the outcome: of the first model, and of the recording."""
    recording, selection = content["recording"], content["selection"]
    for model in content["models"][:1]:
        count = recording["frames"]["count"] if recording else None
        yield from model_facts(model, f" of {count}" if count else "")
        path = model["scene"].get("path_length")
        if path is not None:
            yield "camera path", f"{digits(path, 3)} {_unit(model['scene'])}"
        if model["excitation_m_s2"] is not None and model["metres_per_unit"] is not None:
            yield "camera acceleration", f"{digits(model['excitation_m_s2'], 2)} m/s²"
        for sensor in model["rig"]:
            length = f"{digits(1000 * sensor['baseline_m'], 4)} mm"
            yield "rig", f"camera {sensor['camera_id']} is {length} from camera {sensor['reference_id']}"
        if model["metres_per_unit"] is not None:
            yield "how the scale was found", _METHODS.get(model["method"]) or str(model["method"])
        yield from sensor_facts(model)
    if selection is not None:
        yield "frames used", f"{selection['used']} of {selection['frames']}: {selection['note']}"
    if recording is not None:
        frames, imu = recording["frames"], recording["imu"]
        interval = frames["interval_s"]
        rate = f" at {digits(1 / interval, 3)} per s" if interval else ""
        yield "frames", f"{frames['count']} in {digits(frames['duration_s'], 3)} s{rate}"
        accel = f", accelerometer {digits(imu['accel_hz'], 3)}" if imu["accel_hz"] else ", no accelerometer"
        yield "IMU", f"gyroscope {digits(imu['gyro_hz'], 3)}{accel} Hz"
        if imu["device"]:
            yield "device", imu["device"]


def _unit(record: Content) -> str:
    return "m" if record["unit"] == "m" else "model units"


def survey_facts(survey: Content, scene: Content, place: Content | None) -> Iterator[Fact]:
    """Extent, ground sampling distance, tracks, and the model's place on Earth where it was asked for."""
    unit, images = _unit(survey), survey["images"]
    if survey["extent"] is not None:
        x, y, up = (digits(v, 3) for v in survey["extent"])
        yield "extent (nearly all points)", f"{x} × {y} {unit}, {up} {unit} high"
    gsd = sorted(image["gsd"] for image in images if image["gsd"] is not None)
    if gsd:
        middle = gsd[len(gsd) // 2]
        length = f"{digits(1000 * middle, 3)} mm" if unit == "m" else f"{digits(middle, 3)} {unit}"
        yield "ground sampling distance", f"{length} per pixel"
    if images:
        yield "points per image", f"{sum(i['observations'] for i in images) / len(images):.0f}"
    yield "mean track length", digits(survey["tracks"]["mean"], 3)
    if scene.get("path_length") is not None:
        yield "camera path", f"{digits(scene['path_length'], 3)} {unit}"
    yield from place_facts(place)


def _rms_of_images(images: Sequence[Content]) -> float:
    """Root mean square of the images' residuals (px)."""
    known = [image["rms_px"] for image in images if image["rms_px"] is not None]
    return math.sqrt(sum(value**2 for value in known) / len(known)) if known else 0.0


def intrinsics_rows(camera: Content) -> Rows:
    """Name, meaning, value and standard deviation of each parameter of a camera."""
    sigma = camera.get("sigma", {})
    return [
        (key, _PARAMETERS.get(key, "distortion"), *_round_to_sigma(value, sigma.get(key)))
        for key, value in camera["params"].items()
    ]


def _round_to_sigma(value: float, sigma: float | None) -> tuple[str, str]:
    """A value to the second digit of its standard deviation, and that."""
    if sigma is None or not sigma > 0:
        return f"{value:.6g}", ""
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    if decimals > SIZES.most_decimals:
        return f"{value:.6g}", f"{sigma:.2g}"
    return f"{value:.{decimals}f}", f"{sigma:.{decimals}f}"


def readout_rows(models: Sequence[Content]) -> Rows:
    """Changes of each model by removing the translation within the readout."""
    rows: Rows = []
    for model in models:
        change = model.get("readout_translation")
        if change:
            lengths = f"{change['shift_px']:.2f}", f"{change['before_px']:.3f}", f"{change['after_px']:.3f}"
            rows.append(
                (str(model["index"]), *lengths, "kept" if change["accepted"] else "no improvement, left as it was")
            )
    return rows


def list_outputs(content: Content) -> Rows:
    """Each path of the result, and what lies there."""
    paths = [(key, model[key]) for model in content["models"] for key in ("sparse", "sparse_metric", "trajectory")]
    paths += [(key, (model.get("dense") or {}).get(key)) for model in content["models"] for key in ("fused", "mesh")]
    paths.append(("project_metric", content["project_metric"]))
    return [("this folder" if path == "." else path, _WRITTEN[key]) for key, path in paths if path is not None]


def model_rows(models: Sequence[Content]) -> Rows:
    """Number, verdict, scale, images and method of each model."""
    return [
        (
            str(model["index"]),
            model["verdict"],
            "none" if model["metres_per_unit"] is None else f"{digits(model['metres_per_unit'], 5)} m",
            str(model["registered_images"]),
            model["method"],
        )
        for model in models
    ]


def gap_rows(gaps: Sequence[Content]) -> Rows:
    """The gaps between COLMAP's models: how long, how well known (1 sigma), and whether they were joined across it."""
    return [
        (
            f"{gap['first']}, {gap['second']}",
            f"{gap['seconds']:.2f}",
            "unknown" if gap["sigma_m"] is None else digits(100 * gap["sigma_m"], 2),
            "unknown" if gap["sigma_deg"] is None else digits(gap["sigma_deg"], 2),
            gap["reason"] if gap["joined"] else f"apart: {gap['reason']}",
        )
        for gap in gaps
    ]


def count_drifted_parts(parts: Sequence[Content]) -> int:
    """Number of parts of a path that had drifted by more than their 95 % interval."""
    return sum(abs(part["percent"]) > Z95 * part["sigma_percent"] for part in parts)
