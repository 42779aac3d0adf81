"""Content of a report, read from the files of an output folder; nothing is computed again."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial import __version__
from colmap_inertial.core.types import Action
from colmap_inertial.io.files import path_in, read_json, read_text
from colmap_inertial.io.toml_section import parse_toml
from colmap_inertial.report.folders import CROPS_FOLDER, DATA_FOLDER, model_file, recording_file
from colmap_inertial.report.series import SIZES, stride_indices
from colmap_inertial.report.words import (
    describe_joined,
    describe_mapping,
    half_width_pct,
    outcome_of_model,
    outcome_of_stop,
    parts_mapped_in_words,
)

VERSION = 1
#: Of a model in ``result.json``, what the page shows otherwise or not.
_NOT_SHOWN = ("drift", "validation", "cov", "findings")

Content = dict[str, Any]


def gather(
    out: Path, *, result: Content | None = None, stopped: str | None = None, capture: str | None = None
) -> Content:
    """The content of a report; its layout is that of ``colmap_inertial.report``.

    Parameters
    ----------
    out
        Folder of a run.
    result
        Content of ``result.json``, where it is not written yet.
    stopped
        Why the run ended without a result.
    capture
        What was run, where there is no result to say so.

    Raises
    ------
    FormatError
        For files that were damaged since they were written.
    """
    if result is None and stopped is None:
        result = read_json(out / "result.json")
    recording = read_json(recording_file(out)) if recording_file(out).is_file() else None
    nothing: Content = {"models": [], "frames": [], "seconds": {}, "versions": {"colmap_inertial": __version__}}
    done = nothing if result is None else result
    models = sorted(done["models"], key=lambda m: (m["metres_per_unit"] is None, -m["registered_images"], m["index"]))
    full = {model["index"] for model in models[: SIZES.models]}
    project = done.get("project") is not None
    findings = _findings(out)
    listed = findings.get("findings", [])
    shown = [
        _model(out, {**model, "findings": listed}, in_full=model["index"] in full, project=project) for model in models
    ]
    if shown:
        outcome = shown[0]["outcome"]
    else:
        outcome = outcome_of_stop(stopped or "COLMAP made no model.", findings=bool(findings.get("findings")))
    gaps = done.get("gaps", [])
    if shown and shown[0]["joined_of"]:
        models_joined = [part["colmap_index"] for part in shown[0]["joined_of"]]
        joined = f"It was joined from {describe_joined(models_joined, gaps)}."
        outcome = {**outcome, "summary": [*outcome["summary"], joined]}
    if shown:
        made = parts_mapped_in_words(done.get("mapping"))
        made += describe_mapping(done.get("mapping"), shown[0].get("colmap_index"))
        outcome = {**outcome, "summary": [*outcome["summary"], *made, *_describe_path(shown[0])]}
    if len(shown) > 1:
        several = f"There are {len(shown)} separate models. This is model {shown[0]['index']}; the others follow below."
        outcome = {**outcome, "summary": [*outcome["summary"], several]}
    source = done.get("capture", capture) or str(out)
    return {
        "format": "colmap-inertial report",
        "version": VERSION,
        "title": _title(source),
        "capture": source,
        "outcome": outcome,
        "models": shown,
        "gaps": gaps,
        "findings": findings,
        "selection": _selection(done),
        "recording": None if recording is None else _summarise_recording(recording),
        "made": None if recording is None else recording.get("made"),
        "blur": _blur(done, recording, project=project),
        "frame_table": _frame_table(out, done, recording, project=project),
        "crops": _crops(out, done),
        "rolling_shutter": _rolling_shutter(done, recording),
        "project_metric": done.get("project_metric"),
        "seconds": done["seconds"],
        "configuration": _configuration(out),
        "versions": done["versions"],
    }


def _describe_path(model: Content) -> list[str]:
    """A sentence on what the refinement changed in a model's path, or that it could be run."""
    done = [each for each in model.get("treatments", []) if each["stage"] == "refine"]
    if not done or not done[-1]["action"]:
        length = model.get("scene", {}).get("path_length")
        if model.get("sparse_metric") is None or length is None or length < SIZES.long_path_m:
            return []
        if done:
            return [f"The camera path is {length:.0f} m long and was {done[-1]['reason']}."]
        return [
            f"The camera path is {length:.0f} m long: --refine inertial fits it to the IMU, against bending and drift."
        ]
    percent = [part["percent"] for part in find_refined_parts(model)]
    if not percent:
        return []
    low, high = (f"{value:+.2f}" for value in (min(percent), max(percent)))
    return [f"The refinement corrected drift of the path: parts of it were stretched by {low} to {high} %."]


def find_refined_parts(model: Content) -> list[Content]:
    """Stretch of each part of a model's path by the refinement; empty where the model was left as it was."""
    done = [each for each in model.get("treatments", []) if each["stage"] == "refine" and each["action"]]
    parts: list[Content] = done[-1]["values"].get("drift", []) if done else []
    return parts


def _selection(done: Content) -> Content | None:
    selection = done.get("selection")
    return None if selection is None else {key: selection[key] for key in ("frames", "used", "note")}


def _mark_missing(why: str) -> Content:
    return {"missing": why}


def _title(source: str) -> str:
    path = Path(source)
    return (path.parent.name if path.name == "capture.toml" else path.name) or source


def _model(out: Path, model: Content, *, in_full: bool, project: bool) -> Content:
    scale, ci95 = model["metres_per_unit"], model["ci95"]
    kept = {key: value for key, value in model.items() if key not in _NOT_SHOWN}
    kept.setdefault("joined_of", [])
    kept.setdefault("rig", [])
    kept.setdefault("notes", [])  # earlier runs had all of it among the reasons
    kept["half_width_pct"] = None if scale is None else half_width_pct(scale, ci95)
    if scale is None:
        kept["drift"] = _mark_missing("There is no scale whose parts could be compared.")
    else:
        unknown = _mark_missing("This method does not estimate the scale of parts of the recording.")
        kept["drift"] = model.get("drift") or unknown
    kept["validation"] = _validation(out, model, project=project)
    file = model_file(out, model["index"])
    if in_full and file.is_file():
        kept |= read_json(file)
    else:
        failed = "Its data were not kept; where writing them failed, log.txt says why."
        why = failed if in_full else f"Only the {SIZES.models} largest models are shown in full."
        kept["scene"], kept["signals"] = _mark_missing(why), _mark_missing(why)
    kept.setdefault("photogrammetry", _mark_missing("Its data were not kept: the run was made by an earlier version."))
    kept["outcome"] = outcome_of_model({**model, "signals": kept["signals"], "photogrammetry": kept["photogrammetry"]})
    return kept


def _validation(out: Path, model: Content, *, project: bool) -> Content:
    validation = model.get("validation")
    if validation is None:
        if model["metres_per_unit"] is None:
            return _mark_missing("Without a scale there is nothing to measure a target with.")
        if project:
            return _mark_missing("No target was named, or the project's images are missing (the notes then say so).")
        return _mark_missing("The capture names no target of known size ([target] in capture.toml).")
    if "error" in validation:
        return _mark_missing(f"The target could not be measured: {validation['error']}.")
    folder = out / "validation" / str(model["index"])
    images = sorted(folder.glob("*.jpg")) if folder.is_dir() else []
    chosen = [str(images[i].relative_to(out)) for i in stride_indices(len(images), SIZES.target_images)]
    return {**validation, "pictures": chosen}


def _findings(out: Path) -> Content:
    file = out / "diagnosis.json"
    if not file.is_file():
        return _mark_missing("The recording was not checked before the reconstruction, or the findings were not kept.")
    diagnosis = read_json(file)
    return {"checked": diagnosis["checked"], "findings": diagnosis["findings"]}


def _summarise_recording(recording: Content) -> Content:
    frames = {key: value for key, value in recording["frames"].items() if key not in ("names", "t_s", "exposure_s")}
    exposures = [value for value in recording["frames"]["exposure_s"] or [] if value is not None]
    frames["median_exposure_s"] = float(np.median(exposures)) if exposures else None
    return {"imu": recording["imu"], "frames": frames}


def _blur(done: Content, recording: Content | None, *, project: bool) -> Content:
    if project:
        return _mark_missing("The images of an existing project are left as they are.")
    note = done.get("imaging", {}).get("deblur") or "the run did not get that far"
    known = [frame for frame in done["frames"] if frame["blur_px"] is not None]
    if not known or recording is None:
        return _mark_missing(f"No blur to show: {note}.")
    time_of = dict(zip(recording["frames"]["names"], recording["frames"]["t_s"], strict=True))
    blur_px = np.array([frame["blur_px"] for frame in known])
    some = stride_indices(len(known), SIZES.blur_frames)
    worst = np.argsort(-blur_px, kind="stable")[: SIZES.blur_frames // 10] if len(some) < len(known) else some[:0]
    return {
        "note": note,
        "counts": dict(Counter(frame["action"] for frame in done["frames"])),
        "median_px": float(np.median(blur_px)),
        "largest_px": float(blur_px.max()),
        "frames": [
            {"t_s": time_of.get(known[i]["name"]), **{k: known[i][k] for k in ("name", "action", "blur_px", "reason")}}
            for i in np.union1d(some, worst).tolist()
        ],
    }


def _frame_table(out: Path, done: Content, recording: Content | None, *, project: bool) -> Content:
    """What was done to each frame, the most blurred first; of many frames, only those."""
    if project:
        return _mark_missing("The images of an existing project are left as they are.")
    if not done["frames"]:
        return _mark_missing("The run did not get as far as the frames.")
    time_of: dict[str, float] = {}
    if recording is not None:
        time_of = dict(zip(recording["frames"]["names"], recording["frames"]["t_s"], strict=True))
    by_blur = sorted(done["frames"], key=lambda frame: (-(frame["blur_px"] or 0.0), frame["name"]))
    return {
        "count": len(by_blur),
        "rows": [
            {
                "t_s": time_of.get(frame["name"]),
                "image": _image_of_frame(out, frame["name"]),
                **{key: frame.get(key) for key in ("name", "blur_px", "action", "sharpened", "rectified", "reason")},
            }
            for frame in by_blur[: SIZES.frame_rows]
        ],
    }


def _image_of_frame(out: Path, name: str) -> str | None:
    """Path of the image that COLMAP saw, or of the one that agrees with the model; ``None`` where neither is there."""
    paths = (f"{folder}/{name}" for folder in ("colmap/images", "images"))
    return next((path for path in paths if path_in(out, path).is_file()), None)


def _crops(out: Path, done: Content) -> Content:
    file = out / DATA_FOLDER / CROPS_FOLDER / "crops.json"
    crops = read_json(file)["crops"] if file.is_file() else []
    if not crops:
        if any(frame.get("sharpened", frame["action"] == Action.DEBLURRED) for frame in done["frames"]):
            return _mark_missing("None of the frames that were compared differs before and after.")
        return _mark_missing("No frame was deblurred, so there is nothing to show before and after.")
    reason = {frame["name"]: frame["reason"] for frame in done["frames"]}
    folder = f"{DATA_FOLDER}/{CROPS_FOLDER}/"
    return {
        "pairs": [
            {**crop, "reason": reason.get(crop["name"], ""), **{s: folder + crop[s] for s in ("before", "after")}}
            for crop in crops
        ]
    }


def _rolling_shutter(done: Content, recording: Content | None) -> Content:
    movement = None if recording is None else recording["rolling_shutter"]
    if movement is None:
        note = done.get("imaging", {}).get("rolling_shutter")
        return _mark_missing(f"No rolling shutter was corrected{f': {note}' if note else ''}.")
    assert recording is not None
    note = done.get("imaging", {}).get("rolling_shutter", "")
    return {"note": note, "readout_s": recording["frames"]["readout_s"], **movement}


def _configuration(out: Path) -> Content:
    file = out / "config.toml"
    if not file.is_file():
        return _mark_missing("The run ended before its configuration was written.")
    text = read_text(file)
    return {"toml": text, "values": parse_toml(file, text)}
