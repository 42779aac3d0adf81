"""The sections that photogrammetrists know: camera calibration, residuals, tracks and overlap."""

from __future__ import annotations

import math
from html import escape
from typing import Any

from colmap_inertial.checks.report import photogrammetry_figures as figures
from colmap_inertial.checks.report.markup import facts, prose, table
from colmap_inertial.checks.report.parts import Plot, Section
from colmap_inertial.checks.report.words import digits

Content = dict[str, Any]

_MOST_DECIMALS = 6
#: What COLMAP calls the parameters of its cameras.
_PARAMETERS = {
    "f": "focal length",
    "fx": "focal length, across",
    "fy": "focal length, down",
    "cx": "principal point, across",
    "cy": "principal point, down",
}


def survey_section(survey: Content, scene: Content, place: Content | None, name: str, mark: str) -> Section:
    """Extent, ground sampling distance, tracks, overlap, place on Earth."""
    metric = survey["unit"] == "m"
    unit = "m" if metric else "model units"
    said = facts(_survey_facts(survey, scene, unit) + _on_map(place))
    parts: list[str | Plot] = [f"<h2>{escape(name)}Survey</h2>", said]
    ground = survey["ground"]
    if ground is not None:
        share = 100 * figures.seldom_seen(ground)
        parts += [
            "<h3>Overlap, from above</h3>",
            f"<p>How many images see each place; of the places with points, {prose(f'{share:.0f} %')} are seen by "
            "fewer than three, where the model is least sure.</p>",
            Plot(figure=figures.overlap(ground, scene["path"]["xyz"], unit), label="Images that see each place"),
        ]
    mean = survey["tracks"]["mean"]
    parts += [
        "<h3>Track length</h3>",
        f"<p>A point is seen by {digits(mean, 3)} images in the mean; the more, the firmer it stands.</p>",
        Plot(figure=figures.track_lengths(survey["tracks"]), label="How many images see a point"),
    ]
    return Section(anchor=f"survey{mark}", short="" if name else "Survey", parts=parts)


def _survey_facts(survey: Content, scene: Content, unit: str) -> list[tuple[str, str]]:
    found = []
    if survey["extent"] is not None:
        x, y, up = (digits(v, 3) for v in survey["extent"])
        found.append(("extent (nearly all points)", f"{x} × {y} {unit}, {up} {unit} high"))
    gsd = sorted(image["gsd"] for image in survey["images"] if image["gsd"] is not None)
    if gsd:
        middle = gsd[len(gsd) // 2]
        text = f"{digits(1000 * middle, 3)} mm" if unit == "m" else f"{digits(middle, 3)} {unit}"
        found.append(("ground sampling distance", f"{text} a pixel"))
    images = survey["images"]
    if images:
        found.append(("points an image", f"{sum(i['observations'] for i in images) / len(images):.0f}"))
    found.append(("mean track length", digits(survey["tracks"]["mean"], 3)))
    if scene.get("path_length") is not None:
        found.append(("camera path", f"{digits(scene['path_length'], 3)} {unit}"))
    return found


def _on_map(place: Content | None) -> list[tuple[str, str]]:
    """The model's place on Earth, where it was asked for."""
    if place is None:
        return []
    if "error" in place:
        return [("on the map", place["error"])]
    origin, positions = place["origin"], place["positions"]
    return [
        ("on the map", f"{origin['latitude_deg']:.6f}°, {origin['longitude_deg']:.6f}°"),
        ("heading, place", f"±{digits(place['heading_ci95_deg'], 2)}°, ±{digits(place['position_ci95_m'], 2)} m"),
        ("by", f"{positions['used']} positions ({positions['left_out']} left out): {positions['source']}"),
        *_lag(place.get("delay")),
        *(("note", note) for note in place["notes"]),
    ]


def _lag(delay: Content | None) -> list[tuple[str, str]]:
    """By how much positions lag, where that was asked."""
    if delay is None:
        return []
    return [("they lag by", f"{digits(delay['seconds'], 2)} ±{digits(delay['ci95_s'], 2)} s")]


def residual_section(survey: Content, name: str, mark: str) -> Section:
    """Reprojection residuals by image, and over the sensor."""
    images = survey["images"]
    known = [image["rms_px"] for image in images if image["rms_px"] is not None]
    rms = math.sqrt(sum(value**2 for value in known) / len(known)) if known else 0.0
    parts: list[str | Plot] = [
        f"<h2>{escape(name)}Reprojection residuals</h2>",
        f"<p>How far points lie in the images from where the model puts them: {prose(f'{rms:.2f} px')} rms over the "
        "images. Images that stand out are blurred, badly placed, or see something that moved.</p>",
        Plot(figure=figures.residuals_by_image(images), label="Residuals by image"),
    ]
    if survey["sensor"] is not None:
        parts += [
            "<h3>Over the sensor</h3>",
            "<p>Lines that all point one way in a corner tell of a lens that the camera model does not fit, or of a "
            "rolling shutter.</p>",
            Plot(figure=figures.residuals_on_sensor(survey["sensor"]), label="Residuals over the sensor"),
        ]
    return Section(anchor=f"residuals{mark}", short="" if name else "Residuals", parts=parts)


def _with_sigma(value: float, sigma: float | None) -> tuple[str, str]:
    """A value to the second digit of its standard deviation, and that; at most six decimals, for the narrowest page."""
    if sigma is None or not sigma > 0:
        return f"{value:.6g}", ""
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    if decimals > _MOST_DECIMALS:
        return f"{value:.6g}", f"{sigma:.2g}"
    return f"{value:.{decimals}f}", f"{sigma:.{decimals}f}"


def camera_section(survey: Content, name: str, mark: str) -> Section:
    """Intrinsics and distortion of each camera."""
    parts: list[str | Plot] = [
        f"<h2>{escape(name)}Camera calibration</h2>",
        "<p>Intrinsics as the model has them, in pixels of the images. ± is their standard deviation by the scatter of "
        "the residuals, with the principal point held; what the camera model cannot describe is not in it.</p>",
    ]
    for camera in survey["cameras"]:
        field = " × ".join(f"{value:.1f}°" for value in camera["field_of_view_deg"])
        parts.append(
            f"<h3>Camera {camera['camera_id']}: {escape(camera['model'])}</h3><p>{camera['width']} × "
            f"{camera['height']} pixels, {field}, {camera['images']} images.</p>"
        )
        sigma = camera.get("sigma", {})
        rows = [
            (key, _PARAMETERS.get(key, "distortion"), *_with_sigma(v, sigma.get(key)))
            for key, v in camera["params"].items()
        ]
        parts.append(table(("Parameter", "What", "Value", "±"), rows, numbers=(2, 3)))
        if any(abs(v) > 0 for shift in camera["distortion"]["shift_px"] for v in shift):
            parts += [
                "<p>Where the lens puts points, from where a pinhole would:</p>",
                Plot(figure=figures.distortion(camera), label=f"Distortion of camera {camera['camera_id']}"),
            ]
        else:
            parts.append("<p>A pinhole: no distortion.</p>")
    return Section(anchor=f"camera{mark}", short="" if name else "Camera", parts=parts)
