"""The sections of the page, in order: HTML text with figures between. Everything that comes from a user is escaped."""

from __future__ import annotations

import math
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

from colmap_inertial.checks.report import figures
from colmap_inertial.checks.report.content import refined_parts
from colmap_inertial.checks.report.figure_3d import scene_figure
from colmap_inertial.checks.report.markup import bars, facts, gauge, images, listing, prose, scale_text, sentence, table
from colmap_inertial.checks.report.parts import Plot, Section
from colmap_inertial.checks.report.photogrammetry_sections import camera_section, residual_section, survey_section
from colmap_inertial.checks.report.words import digits, not_checked, signed
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.inertial.scale.verdict import scale_drifts

Content = dict[str, Any]

_METHODS = {"joint": "all measurements in one fit", "spectral": "spectra of both sensors"}
#: What the paths of a result are.
_WRITTEN = {
    "sparse": "COLMAP's own model",
    "sparse_metric": "the model in metres",
    "trajectory": "the camera's path in metres, smoothed by the IMU or refined",
    "project_metric": "the whole project in metres",
}


def sections_of(content: Content, out: Path) -> Iterator[Section]:
    """The sections that the run has data for, and at the end those it has not, with the reason."""
    left_out = _LeftOut()
    yield _outcome(content)
    if left_out.has("Findings", content["findings"]):
        yield _findings(content["findings"])
    several = len(content["models"]) > 1
    for model in content["models"]:
        name = f"Model {model['index']}: " if several else ""
        mark = f"-{model['index']}" if several else ""
        if several:
            yield _model_head(model, mark)
        yield from _of_model(model, name, mark, left_out, out)
    for title, key, build in (("Blur", "blur", _blur), ("Rolling shutter", "rolling_shutter", _shutter)):
        if left_out.has(title, content[key]):
            yield build(content, out)
    if "missing" not in content["blur"]:
        left_out.has("Before and after", content["crops"])
    yield _run(content)
    if left_out:
        parts = ("<h2>Left out</h2>", table(("Section", "Why"), left_out))
        yield Section(anchor="left-out", short="Left out", parts=parts)


class _LeftOut(list[tuple[str, str]]):
    """Sections that the run has no data for, with the reason."""

    def has(self, title: str, record: Content) -> bool:
        """Whether there is data for a section; noted where not."""
        if "missing" in record:
            self.append((title, record["missing"]))
        return "missing" not in record


def _outcome(content: Content) -> Section:
    outcome = content["outcome"]
    model = content["models"][0] if content["models"] else None
    parts = [f'<span class="verdict">{escape(outcome["verdict"])}</span><h2>{escape(outcome["headline"])}</h2>']
    if model is not None and model["metres_per_unit"] is not None:
        parts.append(f'<p class="number">{scale_text(model)}</p>')
        parts.append(gauge(model["half_width_pct"]))
    parts += [f"<p>{prose(text)}</p>" for text in outcome["summary"]]
    if model is not None and model["reasons"]:
        parts += ["<h3>Reasons</h3>", listing(model["reasons"])]
    if model is not None and model["notes"]:
        parts += ["<h3>Notes</h3>", listing(model["notes"])]
    if outcome["todo"]:
        parts += ["<h3>What to do</h3>", listing(outcome["todo"])]
    parts.append(facts(_key_facts(content, model)))
    parts.append("<!--links-->")
    return Section(anchor="outcome", short="", parts=parts, classes=f"outcome {escape(outcome['verdict'])}")


def _key_facts(content: Content, model: Content | None) -> Iterator[tuple[str, str]]:
    recording = content["recording"]
    if model is not None:
        frames = recording["frames"]["count"] if recording else None
        of = f" of {frames}" if frames else ""
        yield "images in the model", f"{model['registered_images']}{of}"
        yield "points", f"{model['points']:,}".replace(",", " ")
        yield "reprojection error", f"{model['mean_reprojection_error_px']:.2f} px"
        path = model["scene"].get("path_length")
        if path is not None:
            yield "camera path", f"{digits(path, 3)} {'m' if model['scene']['unit'] == 'm' else 'model units'}"
        if model["excitation_m_s2"] is not None and model["metres_per_unit"] is not None:
            yield "camera acceleration", f"{digits(model['excitation_m_s2'], 2)} m/s²"
        yield "how the scale was found", _METHODS.get(model["method"]) or str(model["method"])
        if model["gyro_time_offset_s"] is not None:
            yield "camera clock − IMU clock", f"{signed(model['gyro_time_offset_s'], 4)} s"
    selection = content["selection"]
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


def _findings(found: Content) -> Section:
    parts = ["<h2>Before the reconstruction</h2>"]
    checked = ", ".join(found["checked"])
    looked = f' <span class="soft">Looked at: {escape(checked)}.</span>' if checked else ""
    left = not_checked(found["checked"])
    looked += f" <b>Not checked</b>: {escape(left)}." if left else ""
    if not found["findings"]:
        parts.append(f"<p>Nothing was found wrong with the recording.{looked}</p>")
    else:
        parts.append(f"<p>What the recording shows, worst first.{looked}</p>")
    for finding in found["findings"]:
        severity = escape(finding["severity"])
        parts.append(
            f'<div class="finding {severity}"><p><b>{severity}</b> <span class="soft">{escape(finding["code"])}</span>'
            f"</p><p>{sentence(finding['evidence'])}</p><p>What to do: {sentence(finding['advice'])}</p></div>"
        )
    return Section(anchor="findings", short="Before", parts=parts)


def _model_head(model: Content, mark: str) -> Section:
    outcome = model["outcome"]
    parts = [
        f'<span class="verdict">{escape(outcome["verdict"])}</span><h2>Model {model["index"]}: '
        f"{escape(outcome['headline'])}</h2>"
    ]
    if model["metres_per_unit"] is not None:
        parts.append(f'<p class="number">{scale_text(model)}</p>')
    parts += [f"<p>{model['registered_images']} images, {model['points']} points.</p>", listing(model["reasons"])]
    if model["notes"]:
        parts += ["<h3>Notes</h3>", listing(model["notes"])]
    return Section(
        anchor=f"model{mark}", short=f"Model {model['index']}", parts=parts, classes=f"outcome {outcome['verdict']}"
    )


def _of_model(model: Content, name: str, mark: str, left_out: _LeftOut, out: Path) -> Iterator[Section]:
    scene, signals = model["scene"], model["signals"]
    if left_out.has(f"{name}Model in 3-D", scene):
        yield _scene(scene, name, mark)
        if left_out.has(f"{name}Survey, residuals and camera", model["photogrammetry"]):
            yield survey_section(model["photogrammetry"], scene, model.get("georeference"), name, mark)
            yield residual_section(model["photogrammetry"], name, mark)
            yield camera_section(model["photogrammetry"], name, mark)
    if left_out.has(f"{name}Camera against IMU", signals):
        yield _rotation(signals, name, mark)
        if left_out.has(f"{name}Acceleration", signals["acceleration"]):
            yield _acceleration(signals, name, mark)
        if left_out.has(f"{name}Spectra", signals["acceleration_spectrum"]):
            yield _spectra(signals, name, mark)
    if left_out.has(f"{name}Scale along the recording", model["drift"]):
        yield _drift(model, name, mark)
    refined = refined_parts(model)
    if refined:
        yield _refined(model, refined, name, mark)
    if left_out.has(f"{name}Target", model["validation"]):
        yield _target(model["validation"], name, mark, out)


def _scene(scene: Content, name: str, mark: str) -> Section:
    if scene["unit"] == "m":
        said = "The metric model: drag to turn it, scroll or pinch to come closer. Compare the grid and the green bar "
        said += "with what you know of the place."
    else:
        said = "COLMAP's model, in its own units: without a scale there are no metres here."
    if not scene["gravity_known"]:
        said += " Where gravity points is not known; up is a guess from how the camera was held."
    figure = Plot(figure=scene_figure(scene), label="The model in 3-D with the camera's path")
    return Section(
        anchor=f"scene{mark}",
        short="" if name else "3-D",
        parts=(f"<h2>{escape(name)}Model and camera path</h2><p>{said}</p>", figure),
    )


def _rotation(signals: Content, name: str, mark: str) -> Section:
    rotation = signals["rotation"]
    parts: list[str | Plot] = [f"<h2>{escape(name)}Rotation: camera against gyroscope</h2>"]
    after, before = figures.rotation_after(rotation), figures.rotation_before(rotation)
    if after is not None:
        left, size = (math.degrees(rotation["after"][key]) for key in ("rms_difference_rad_s", "rms_rate_rad_s"))
        parts.append(
            "<p>How fast the camera rotated, by the images and by the gyroscope. Brought onto one clock and into the "
            f"camera's axes, the curves should lie on each other: they differ by {digits(left, 2)} °/s where the "
            f"camera rotates at {digits(size, 2)} °/s (rms).</p>"
        )
        parts += ["<h3>After alignment</h3>", Plot(figure=after, label="Rates of rotation after alignment")]
    else:
        parts.append(
            "<p>How fast the camera rotated, by the images and by the gyroscope. "
            f"{'They' if signals.get('alignment') == 'not tried' else 'They could not be brought together. They'} "
            "should have the same ups and downs at some shift in time; if they have not, this IMU recording does not "
            "belong to these images, or one of them is not what it says.</p>"
        )
    if before is not None:
        clocks = (
            "Each in its own axes, on the clocks as stamped."
            if rotation["same_clock_origin"]
            else "Each in its own axes; the clocks have no time in common, so each begins at its own first sample."
        )
        parts += [
            f'<h3>As recorded</h3><p class="soft">{clocks}</p>',
            Plot(figure=before, label="Rates of rotation as recorded"),
        ]
    return Section(anchor=f"rotation{mark}", short="" if name else "Rotation", parts=parts)


def _acceleration(signals: Content, name: str, mark: str) -> Section:
    acceleration = signals["acceleration"]
    correlation = acceleration["correlation"]
    correlated = "" if correlation is None else f" Their correlation is {correlation:.3f} (1 would be perfect)."
    if acceleration["camera_unit"] == "m/s2":
        said = (
            "This is what the scale rests on: the metric camera path, differentiated twice, must show the acceleration "
            "that the accelerometer measured (gravity and bias taken out), in two level directions and upwards."
        )
    else:
        said = (
            "A scale would be the factor between the two curves: the camera's in model units (right), the "
            "accelerometer's in m/s² (left, drawn to the size of what filming by hand has). Where one of them is flat, "
            "or they have nothing in common, there is none to be found."
        )
    averaged = f"Both averaged over {digits(acceleration['averaged_over_s'], 2)} s."
    figure = Plot(figure=figures.accelerations(acceleration), label="Accelerations of camera and accelerometer")
    return Section(
        anchor=f"acceleration{mark}",
        short="" if name else "Acceleration",
        parts=(
            f"<h2>{escape(name)}Acceleration: camera against accelerometer</h2><p>{said}{correlated} "
            f'<span class="soft">{averaged}</span></p>',
            figure,
        ),
    )


def _spectra(signals: Content, name: str, mark: str) -> Section:
    figure = figures.spectra(signals["acceleration_spectrum"], unit="(m/s²)")
    if signals["acceleration_spectrum"]["camera_unit"] == "m/s2":
        said = "Camera and IMU should agree up to where the camera's curve bends upwards: from there on it shows the "
        said += "noise of positions, which the estimate weighs down."
    else:
        said = "Units differ, so that only the shapes of the curves can be compared."
    if "camera" not in signals["acceleration_spectrum"]["curves"]:
        said = "The frames are too few or too unevenly spaced for a spectrum of the camera; this is the IMU's."
    parts: list[str | Plot] = [
        f"<h2>{escape(name)}Spectra</h2><p>The same by frequency. {prose(said)} Motion of the hand lies between 0.5 "
        "and 5 Hz; peaks above are vibration.</p>",
        "<h3>Acceleration</h3>",
        Plot(figure=figure, label="Spectra of acceleration"),
    ]
    rotation = signals["rotation_spectrum"]
    if "missing" not in rotation:
        figure = figures.spectra(rotation, unit="(°/s)", factor=math.degrees(1))
        parts += ["<h3>Rotation</h3>", Plot(figure=figure, label="Spectra of rotation")]
    return Section(anchor=f"spectra{mark}", short="" if name else "Spectra", parts=parts)


def _drift(model: Content, name: str, mark: str) -> Section:
    found = model["drift"]
    telling, every = len(figures.informative_parts(found["parts"])), len(found["parts"])
    trend, sigma = (60 * found[key] for key in ("trend_log_per_s", "trend_sigma_log_per_s"))
    if scale_drifts(found["p_value"], trend, sigma):
        said = (
            "They differ by more than chance explains: the reconstruction bends or breaks somewhere, and one scale "
            f"does not fit all of it. A steady change would be {signed(100 * trend)} ±{100 * Z95 * sigma:.2g} % a "
            "minute."
        )
    elif telling < 2:
        said = "The parts are too uncertain to tell whether the reconstruction keeps its scale."
    else:
        said = (
            "They agree within their uncertainty: nothing shows that the reconstruction does not keep its scale. (By "
            f"chance alone, differences as large come up in {100 * found['p_value']:.2g} % of cases.)"
        )
    if telling < every:
        said += f" {every - telling} of {every} parts tell no scale by themselves and are not drawn."
    text = f"<h2>{escape(name)}Scale along the recording</h2><p>Each part of the recording by itself against the whole."
    parts: list[str | Plot] = [f"{text} {prose(said)}</p>"]
    if telling:
        parts.append(Plot(figure=figures.drift(model), label="Scale of parts of the recording"))
    return Section(anchor=f"drift{mark}", short="" if name else "Scale over time", parts=parts)


def _refined(model: Content, parts: list[Content], name: str, mark: str) -> Section:
    off = [abs(part["percent"]) > Z95 * part["sigma_percent"] for part in parts]
    said = (
        "How much too large or too small each part of the path was against the whole, by what the IMU says of it, and "
        f"how well that is known now. {sum(off)} of {len(parts)} parts had drifted by more than chance explains."
    )
    return Section(
        anchor=f"refined{mark}",
        short="" if name else "Drift",
        parts=(
            f"<h2>{escape(name)}Drift before and after the refinement</h2><p>{said}</p>",
            Plot(figure=figures.refined(model, parts), label="Size of parts of the path before and after"),
        ),
    )


def _target(found: Content, name: str, mark: str, out: Path) -> Section:
    parts: list[str | Plot] = [f"<h2>{escape(name)}Measured against the target</h2>"]
    listed: list[tuple[str, str]] = [("target", found["target"])]
    if found["scale_error_pct"] is not None:
        low, high = found["ci95_pct"]
        listed.append(("error of lengths", f"{signed(found['scale_error_pct'])} % ({signed(low)} to {signed(high)})"))
        listed.append(
            ("tolerance", f"{found['tolerance_pct']:g} %, {'kept' if found['within_tolerance'] else 'exceeded'}")
        )
    listed += [
        ("images", f"{found['views_used']} used of {found['views_searched']} searched"),
        ("corners", f"{found['corners_used']} used, {found['corners_rejected']} rejected"),
        ("residual, rms", f"{found['rms_px']:.2f} px"),
    ]
    lengths = found.get("lengths")
    if lengths is not None:
        listed.append(
            (
                "errors of lengths",
                f"rms {1000 * lengths['rms_m']:.3g} mm, largest {1000 * lengths['largest_m']:+.3g} mm",
            )
        )
        listed.append(("longest length", f"{digits(lengths['longest_m'], 3)} m, {lengths['directions']} directions"))
    parts.append(facts(listed))
    if lengths is not None:
        parts.append(f"<p>The check proves that {prose(lengths['proves'])}.</p>")
    if found["distances"]:
        figure = Plot(figure=figures.target_distances(found), label="Measured minus known distances")
        parts += ["<h3>Known distances</h3>", figure]
    if found["views"]:
        figure = Plot(figure=figures.target_views(found), label="Residuals of the target in each image")
        parts += ["<h3>Corners in the images</h3>", figure]
    if found["reasons"]:
        parts += ["<h3>What limits this</h3>", listing(found["reasons"])]
    shown = images(out, found["pictures"])
    if shown:
        parts += [
            '<p class="soft">Circles: corners as seen. Lines: towards where the fitted target projects, 30 times '
            "longer than they are.</p>",
            shown,
        ]
    return Section(anchor=f"target{mark}", short="" if name else "Target", parts=parts)


def _blur(content: Content, out: Path) -> Section:
    found = content["blur"]
    parts: list[str | Plot] = [
        f"<h2>Blur</h2><p>How far a point smears while a frame is exposed, as predicted from the gyroscope and, where "
        f"it is known, the camera's translation: {digits(found['median_px'], 2)} px in the median, "
        f"{digits(found['largest_px'], 3)} px at most. "
        f"{sentence(found['note'])}</p>",
        Plot(figure=figures.blur(found["frames"]), label="Predicted blur of each frame"),
    ]
    if "missing" not in content["crops"]:
        parts.append("<h3>Before and after</h3>")
        for pair in content["crops"]["pairs"]:
            both = images(out, [pair["before"], pair["after"]], classes="pair", captions=("as filmed", "deblurred"))
            caption = f"{pair['name']}, {digits(pair['blur_px'], 3)} px of blur"
            parts.append(f'{both}<p class="soft small">{escape(caption)}</p>')
    return Section(anchor="blur", short="Blur", parts=parts)


def _shutter(content: Content, out: Path) -> Section:
    found = content["rolling_shutter"]
    worst = found["worst"]
    parts: list[str | Plot] = [
        f"<h2>Rolling shutter</h2><p>{sentence(found['note']) if found['note'] else ''} As the camera rotates within "
        f"the {digits(1000 * found['readout_s'], 3)} ms from the first line to the last, things lean; this is how far "
        "keypoints were moved to where a global shutter would have seen them.</p>",
        Plot(figure=figures.shutter_over_time(found), label="Movement of keypoints in each frame"),
        f"<h3>The frame that needed it most: {escape(worst['name'])}</h3>",
        Plot(figure=figures.shutter_field(worst), label="Movement of keypoints over the frame"),
    ]
    rows = []
    for model in content["models"]:
        settled = model.get("readout_translation")
        if settled:
            kept = "kept" if settled["accepted"] else "not worth it, left as it was"
            before, after = f"{settled['before_px']:.3f}", f"{settled['after_px']:.3f}"
            rows.append((str(model["index"]), f"{settled['shift_px']:.2f}", before, after, kept))
    if rows:
        head = ("Model", "Movement (px)", "Error before (px)", "Error after (px)", "")
        parts += [
            "<h3>Translation within the readout</h3><p>What is near also moves because the camera does. With depths "
            "from the model, points were moved for that too, and the model adjusted to them:</p>",
            table(head, rows, numbers=(1, 2, 3)),
        ]
    return Section(anchor="shutter", short="Rolling shutter", parts=parts)


def _gap_row(gap: Content) -> tuple[str, str, str, str, str]:
    position, direction = (
        "unknown" if gap[name] is None else digits(factor * gap[name], 2)
        for name, factor in (("sigma_m", 100), ("sigma_deg", 1))
    )
    became = gap["reason"] if gap["joined"] else f"apart: {gap['reason']}"
    return f"{gap['first']}, {gap['second']}", f"{gap['seconds']:.2f}", position, direction, str(became)


def _run(content: Content) -> Section:
    parts = ["<h2>The run</h2>"]
    if content["seconds"]:
        total = sum(content["seconds"].values())
        parts += [f"<h3>Time, {digits(total, 3)} s in all</h3>", bars(content["seconds"])]
    versions = content["versions"].items()
    parts += ["<h3>Versions</h3>", table(("Package", "Version"), [(k, str(v)) for k, v in versions])]
    models = content["models"]
    written = [(name, model[name]) for model in models for name in ("sparse", "sparse_metric", "trajectory")]
    written += [("project_metric", content["project_metric"])]
    listed = [("this folder" if path == "." else path, _WRITTEN[name]) for name, path in written if path is not None]
    if listed:
        parts += ["<h3>Written</h3>", table(("Where", "What"), listed)]
    if len(models) > 1:
        rows = []
        for model in models:
            scale = "none" if model["metres_per_unit"] is None else f"{digits(model['metres_per_unit'], 5)} m"
            rows.append(
                (str(model["index"]), model["verdict"], scale, str(model["registered_images"]), model["method"])
            )
        head = ("Model", "Verdict", "One unit is", "Images", "Method")
        parts += ["<h3>Models</h3>", table(head, rows, numbers=(3,))]
    if content["gaps"]:
        rows = [_gap_row(gap) for gap in content["gaps"]]
        head = ("COLMAP's models", "Gap (s)", "Position (cm)", "Direction (°)", "What became of it")
        parts += ["<h3>Gaps between COLMAP's models</h3>", table(head, rows, numbers=(1, 2, 3))]
    toml = content["configuration"].get("toml")
    if toml:
        parts.append(
            f"<h3>Configuration</h3><details><summary>config.toml</summary><pre>{escape(toml)}</pre></details>"
        )
    return Section(anchor="run", short="The run", parts=parts)
