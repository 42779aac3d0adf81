"""Results in words: label and text of each value with its unit, and sentences; the same on the terminal and the page.

Values come as ``result.json`` has them. Texts of facts are ASCII ("+-", "m/s2", "-"), which the page sets in type.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from colmap_inertial.inertial.scale.verdict import TRUSTED_HALF_WIDTH, describe_parts

#: A label, and the value with its unit.
Fact = tuple[str, str]

#: Camera acceleration below which there is too little to weigh gravity against; what filming by hand usually has.
_LITTLE_M_S2, _USUAL = 0.3, "0.5 to 2 m/s²"

_MOVE = (
    "Film again and move the camera itself: swing it by 20 cm or more, sideways and up and down, about once a "
    "second, throughout the recording, for 10 s or longer. Rotation on the spot, a tripod or motion at constant "
    "speed do not determine the scale."
)
_RAW = (
    "Record the raw gyroscope and accelerometer (with gravity), from before the first frame to after the last, with "
    "the camera's stabilisation switched off."
)
_TARGET = (
    "For a scale that does not depend on motion, put a printed board into the scene and name it in capture.toml "
    "([target]), or measure a length: reconstruct OUT/colmap NEW_FOLDER --scale-from distance, or --scale-from target."
)
_MODEL = (
    "Resolve the reasons below: check the model first (wrong poses show as jumps of the camera's path), then "
    "the axes, units and timestamps of the IMU."
)
_CHECK = "Resolve the reasons below; until then, check a known length before you measure in the model."


def digits(value: float, count: int = 4) -> str:
    """A number with so many significant digits, never in powers of ten where it can be avoided."""
    text = f"{value:.{count}g}"
    return f"{value:.0f}" if "e+" in text and abs(value) < 1e9 else text


def fixed(value: float, count: int = 4) -> str:
    """A number with so many significant digits, trailing zeros included: both ends of an interval are equally long."""
    text = f"{value:#.{count}g}".rstrip(".")
    return f"{value:.0f}" if "e+" in text and abs(value) < 1e9 else text


def length(metres: float, count: int = 3) -> str:
    """A length with so many digits, in a unit that fits."""
    factor, unit = next(((f, u) for f, u in ((1, "m"), (100, "cm")) if abs(metres) * f * (1 + 5e-4) >= 1), (1000, "mm"))
    return f"{digits(metres * factor, count)} {unit}"


def signed(value: float, decimals: int = 2) -> str:
    """A number with its sign."""
    return f"{value:+.{decimals}f}".replace("-", "−")


def half_width_pct(metres_per_unit: float, ci95: Sequence[float]) -> float:
    """Half of the 95 % interval, in per cent of the scale."""
    return 50 * (ci95[1] - ci95[0]) / metres_per_unit


def length_error(pct: float) -> str:
    """A relative error as a length error over ten metres, in a suitable unit."""
    return length(10 * pct / 100, 2)


def length_in_words(verdict: str, pct: float) -> str:
    """The error of a length of ten metres, by the half-width of the scale's interval."""
    if verdict == "trusted":
        return f"lengths of 10 m are accurate to {length_error(pct)}"
    return (
        f"lengths of 10 m may be off by {length_error(pct)}, or by more for the reasons below: check a known length "
        "before you measure"
    )


def scale_facts(estimate: Mapping[str, Any]) -> Iterator[Fact]:
    """The scale and its interval, of an estimate or any other source of metres."""
    if estimate["metres_per_unit"] is not None and estimate["ci95"] is not None:
        low, high = estimate["ci95"]
        pct = half_width_pct(estimate["metres_per_unit"], (low, high))
        yield "scale", f"{estimate['metres_per_unit']:.6g} m per unit, +-{pct:.2g} % (95 %)"
        yield "interval", f"{fixed(low, 6)} to {fixed(high, 6)} m per unit"


def sensor_facts(estimate: Mapping[str, Any]) -> Iterator[Fact]:
    """Time offsets and biases that a fit of the scale found."""
    if estimate["gyro_time_offset_s"] is not None:
        gyro_s, accel_s = estimate["gyro_time_offset_s"], estimate["accel_time_offset_s"]
        yield "time offset", f"gyro {gyro_s:+.4f} s, accelerometer {accel_s:+.4f} s (camera time = timestamp + offset)"
        yield "gyro bias", f"{', '.join(f'{value:+.4f}' for value in estimate['gyro_bias_rad_s'])} rad/s"
    if estimate["accel_bias_m_s2"] is not None:
        yield "accel. bias", f"{', '.join(f'{value:+.3f}' for value in estimate['accel_bias_m_s2'])} m/s2"


def model_facts(model: Mapping[str, Any], available: str = "") -> Iterator[Fact]:
    """Images and points of a model; ``available`` says of how many images."""
    yield "images", f"{model['registered_images']}{available}"
    yield "points", f"{model['points']}, mean reprojection error {model['mean_reprojection_error_px']:.2f} px"


def place_against_tolerance(error_pct: float, tolerance_pct: float, proved: bool) -> str:
    """Position of a scale error against a tolerance: outside, within, or not proved to be within."""
    return "outside" if abs(error_pct) > tolerance_pct else "within" if proved else "not proved to be within"


def target_facts(validation: Mapping[str, Any]) -> Iterator[Fact]:
    """Facts from a target of known size in a model, from ``Validation.as_json()``."""
    yield "target", validation["target"]
    if validation["scale_error_pct"] is not None:
        low, high = validation["ci95_pct"]
        error = f"{validation['scale_error_pct']:+.3f} % (95 %: {low:+.3f} to {high:+.3f})"
        place = place_against_tolerance(
            validation["scale_error_pct"], validation["tolerance_pct"], validation["within_tolerance"]
        )
        yield "scale error", f"{error}, {place} {validation['tolerance_pct']:g} %"
    low, high = validation["metres_per_unit_ci95"]
    yield "metres per unit", f"{validation['metres_per_unit']:.6g} (95 %: {low:.6g} to {high:.6g})"
    if validation["unscaled"] and validation["check_error_pct"] is not None:
        low, high = validation["check_ci95_pct"]
        yield "control against check", f"{validation['check_error_pct']:+.3f} % (95 %: {low:+.3f} to {high:+.3f})"
    lengths = validation.get("lengths")
    if lengths is not None:
        rms_mm, largest_mm = 1000 * lengths["rms_m"], 1000 * lengths["largest_m"]
        share = lengths["longest_share"]
        of_model = "" if share is None else f", {digits(100 * share, 2)} % of the model's diagonal"
        yield "length errors", f"rms {rms_mm:.3g} mm, largest {largest_mm:+.3g} mm of {lengths['count']}"
        yield "longest length", f"{lengths['longest_m']:.3g} m{of_model}; {lengths['directions']} directions"
    yield "images", f"{validation['views_used']} used of {validation['views_searched']} searched"
    yield "corner observations", f"{validation['corners_used']} used, {validation['corners_rejected']} rejected"
    corners, poses = (f"{validation[name]:.3f} px" for name in ("corner_noise_px", "pose_noise_px"))
    noise = f"corner noise {corners} per coordinate, pose errors {poses}"
    yield "residuals", f"{validation['rms_px']:.3f} px rms; {noise}"
    stated_lengths = [(f"bar {' to '.join(map(str, bar['markers']))}", bar) for bar in validation.get("bars") or ()]
    stated_lengths += [(f"to {apart['other']}", apart) for apart in [validation.get("apart")] if apart is not None]
    yield from (
        (of, f"{length['known_m']:.6g} m, off by {1000 * length['residual_m']:+.3g} mm")
        for of, length in stated_lengths
    )
    points = validation.get("check_points")
    if points is not None:
        level_mm, up_mm = 1000 * points["rmse_horizontal_m"], 1000 * points["rmse_vertical_m"]
        yield f"{len(points['points'])} check points", f"RMSE {level_mm:.3g} mm horizontal, {up_mm:.3g} mm vertical"


def place_facts(place: Mapping[str, Any] | None) -> Iterator[Fact]:
    """A model's place on Earth, by ``Georeference.as_json()``, or why it has none."""
    if place is None:
        return
    if "error" in place:
        yield "on the map", place["error"]
        return
    origin, positions, delay = place["origin"], place["positions"], place.get("delay")
    heading_deg, position_m = place["heading_ci95_deg"], place["position_ci95_m"]
    yield "on the map", f"{origin['latitude_deg']:.6f}, {origin['longitude_deg']:.6f} degrees"
    yield "heading, place", f"+-{digits(heading_deg, 2)} degrees, +-{digits(position_m, 2)} m (95 %)"
    yield "by", f"{positions['used']} positions ({positions['left_out']} left out): {positions['source']}"
    errors = place.get("errors")
    if errors is not None:
        assumed = " (assumed: the positions do not show it)" if errors.get("alike_assumed") else ""
        sizes = f"{digits(errors['white_m'], 2)} m independent, {digits(errors['slow_m'], 2)} m correlated"
        yield "errors of positions", f"{sizes} over {digits(errors['alike_s'], 2)} s{assumed}"
    if delay is not None:
        yield "lag of positions", f"{digits(delay['seconds'], 2)} s +-{digits(delay['ci95_s'], 2)} s"
    yield from (("note", note) for note in place["notes"])


def describe_joined(models: Collection[int], gaps: Sequence[Mapping[str, Any]]) -> str:
    """Describe which COLMAP models were joined, and how well each gap between them is known."""
    across = [
        f"{gap['seconds']:.1f} s to {100 * gap['sigma_m']:.1f} cm, {gap['sigma_deg']:.2f} degrees"
        for gap in gaps
        if gap["joined"] and gap["sigma_m"] is not None and {gap["first"], gap["second"]} <= set(models)
    ]
    known = f"; 1 sigma across: {'; '.join(across)}" if across else ""  # a user's own stage need not say it
    return f"COLMAP's models {', '.join(map(str, models))}{known}"


def checked_in_words(checked: Iterable[str]) -> str:
    """What of a recording was checked, as ``diagnosis.json`` lists it."""
    return ", ".join(checked).replace("pictures", "images")


def not_checked(checked: Collection[str]) -> str:
    """Checks of a recording that had no data and matter; empty otherwise."""
    if "gyroscope" not in checked:
        return ""
    sentences = []
    if "accelerometer" not in checked:
        sentences.append("gravity and scale (no accelerometer)")
    if not {"pictures", "pictures far apart", "poses"} & set(checked):
        sentences.append(
            "whether camera and gyroscope match: axes, unit and clocks (no poses, and no images that overlap enough)"
        )
    return "; ".join(sentences)


def parts_mapped_in_words(mapping: dict[str, Any] | None) -> list[str]:
    """Describe in how many parts a recording was mapped, and which do not fit, from ``mapping`` of the result."""
    if mapping is None or mapping["parts"] == 1:
        return []
    apart = [
        f"The images that two of them share ({_describe_overlap(overlap)}) do not fit and were left out "
        f"({100 * overlap['agree']:.0f} % of the matches agree)."
        for overlap in mapping.get("seams", ())
        if not overlap["joined"]
    ]
    return [f"COLMAP mapped the recording in {mapping['parts']} parts.", *apart]


def describe_mapping(mapping: dict[str, Any] | None, colmap_index: int | None) -> list[str]:
    """Describe the loops of one model that were closed, from ``mapping`` of the result."""
    sentences = []
    for closure in [] if mapping is None else mapping["ends"]:
        if closure["model"] == colmap_index:
            agree = f"{100 * closure['agree']:.0f} %"
            done = "was closed" if closure["joined"] else f"does not fit and stays open ({agree} of its matches agree)"
            sentences.append(f"The loop ({_describe_overlap(closure)}) {done}.")
    return sentences


def _describe_overlap(overlap: Mapping[str, Any]) -> str:
    return f"{' and '.join(overlap['images'])}, {overlap['pairs']} pairs of images"


def outcome_of_model(model: dict[str, Any]) -> dict[str, Any]:
    """First screen of the report for one model of ``result.json``.

    Parameters
    ----------
    model
        As there, with ``signals``, ``photogrammetry`` and ``findings`` where they were kept.

    Returns
    -------
    ``verdict``, ``headline``, ``answers`` (question and answer), ``summary`` (sentences about the scale), ``tried``
    (sentences; of a refused scale) and ``todo`` (sentences).
    """
    verdict, scale, ci95 = model["verdict"], model["metres_per_unit"], model["ci95"]
    if scale is None or ci95 is None:
        return _describe_refused_model(model)
    pct = half_width_pct(scale, ci95)
    extent = model.get("photogrammetry", {}).get("extent")
    sides = [length(side, 3 if verdict == "trusted" else 2) for side in extent or ()]
    headline = "The scale can be trusted" if verdict == "trusted" else "The scale is rough"
    if sides:
        about = "" if verdict == "trusted" else "roughly "
        headline = f"{about}{sides[0]} x {sides[1]}, {sides[2]} high".capitalize()
    summary = [
        f"One unit of COLMAP's own model is {digits(scale)} m; with 95 % certainty between {fixed(ci95[0])} and "
        f"{fixed(ci95[1])} m (+-{digits(pct, 2)} %).",
    ]
    if model.get("parts"):
        made_of = describe_parts(model["parts"])
        summary.append(f"Parts of the uncertainty: {made_of}. To reduce it most, {made_of.advice}.")
    return {
        "verdict": verdict,
        "headline": headline,
        "answers": [
            ("How sure", _describe_accuracy(pct, extent)),
            ("Trusted", _describe_trust(model)),
            ("Where", _describe_place(model.get("georeference"))),
        ],
        "summary": summary,
        "tried": [],
        "todo": _next_steps(model, pct),
    }


def _describe_accuracy(pct: float, extent: Sequence[float] | None) -> str:
    """An interval as errors of lengths: of the model's longest side, and of ten metres."""
    ten = f"10 m to +-{length_error(pct)} (+-{digits(pct, 2)} %, 95 %)"
    if not extent:
        return f"lengths of {ten}"
    longest = max(extent)
    return f"{length(longest)} are known to +-{length(longest * pct / 100, 2)}, lengths of {ten}"


def _describe_trust(model: dict[str, Any]) -> str:
    checked = model.get("validation")
    against = ""
    if checked and checked.get("scale_error_pct") is not None:
        off_pct, tolerance_pct = checked["scale_error_pct"], checked["tolerance_pct"]
        place = place_against_tolerance(off_pct, tolerance_pct, checked["within_tolerance"])
        against = (
            f"measured against the target in the images, lengths are {signed(off_pct)} % off, {place} the tolerance of "
            f"{tolerance_pct:g} %"
        )
        if place == "outside":
            return f"not until this is resolved: {against}"
    if model["verdict"] == "trusted":
        by = "the sensors determine" if model.get("sensors") else "the IMU determines"
        return f"yes; {against}" if against else f"yes: {by} the scale, and all checks passed"
    rough = "no, for the reasons below: check a known length before you measure"
    return f"{rough}; {against}" if against else rough


def _describe_place(place: Mapping[str, Any] | None) -> str:
    """A model's place on Earth in a few words."""
    if place is None:
        return "in its own coordinates, z up; no positions (GPS) were used"
    if "error" in place:
        return f"not on the map: {place['error']}"
    origin = place["origin"]
    sure = f"+-{digits(place['position_ci95_m'], 2)} m, heading +-{digits(place['heading_ci95_deg'], 2)} degrees (95 %)"
    return f"{origin['latitude_deg']:.6f}, {origin['longitude_deg']:.6f} degrees, {sure}"


def _next_steps(model: dict[str, Any], pct: float) -> list[str]:
    """Next steps for a model with a scale; commands are for its folder."""
    checked = model.get("validation")
    steps = []
    if model["verdict"] != "trusted":
        # livelier motion narrows the interval; it mends nothing else
        steps = [_MOVE if pct > 100 * TRUSTED_HALF_WIDTH else _CHECK, *([] if checked else [_TARGET])]
    elif checked and checked.get("scale_error_pct") is not None and not checked["within_tolerance"]:
        steps = ["Measure the board's squares, compare them with [target], and see below which images hold it."]
    steps.append("Explore and measure: `colmap-inertial view .`, in this folder.")
    if model["verdict"] == "trusted":
        steps.append("Export to other programs, in metres: `colmap-inertial export . ../export`; `--for` names one.")
        dense = model.get("dense")
        if dense:
            made = " and ".join(f"`{dense[kind]}`" for kind in ("fused", "mesh") if dense.get(kind))
            steps += [f"Open in CloudCompare or MeshLab, in metres: {made}."] if made else []
        else:
            steps.append("For depth maps, a dense cloud and a mesh, run `reconstruct` again with `--dense`.")
    return steps


def _describe_attempt(model: dict[str, Any]) -> list[str]:
    """Attempts at a scale that was refused, with their outcome."""
    signals = model.get("signals", {})
    rotation, acceleration = signals.get("rotation") or {}, signals.get("acceleration") or {}
    tried = [f"COLMAP placed {model['registered_images']} images and {model['points']} points."]
    if signals.get("alignment") == "found" and rotation.get("after"):
        apart, rate = (math.degrees(rotation["after"][f"rms_{name}_rad_s"]) for name in ("difference", "rate"))
        tried.append(
            "Camera and gyroscope were aligned: their rates differ by "
            f"{digits(apart, 2)} °/s (rms), at {digits(rate, 2)} °/s of rotation."
        )
    elif signals.get("alignment") == "failed":
        tried.append("No time offset and no rotation between camera and IMU make their rotations agree.")
    elif signals.get("alignment") == "not tried":
        tried.append("Camera and IMU were not aligned: the recording does not allow it.")
    if "correlation" in acceleration:
        tried.append(
            "The scale was fitted to all measurements; the accelerations of camera and accelerometer have a "
            f"correlation of {acceleration['correlation']:.2f} (1 where they agree)."
        )
    return tried


def _describe_refused_model(model: dict[str, Any]) -> dict[str, Any]:
    summary = ["The recording does not determine the scale, so none is given."]
    signals, findings = model.get("signals", {}), model.get("findings", ())
    causes = [finding for finding in findings if finding["severity"] == "error"]
    summary += [f"Found beforehand ({finding['code']}): {finding['evidence']}." for finding in causes]
    doubts = causes or [finding for finding in findings if finding["severity"] == "warning"]
    todo = [f"{finding['advice'][:1].upper()}{finding['advice'][1:]} ({finding['code']})." for finding in doubts]
    summary += _describe_refusal(signals)
    todo += [text for text in _advise_on_refusal(signals) if not causes or text is _MOVE]
    summary.append(f"COLMAP's own model ({model['sparse']}) is complete: only its size is unknown.")
    return {
        "verdict": "refused",
        "headline": "The scale could not be determined",
        "answers": [("Trusted", "no; the model is not in metres")],
        "summary": summary,
        "tried": _describe_attempt(model),
        "todo": [*todo, _TARGET],
    }


def _describe_refusal(signals: Mapping[str, Any]) -> list[str]:
    """Sentences on a refusal that no finding explains, by the signals of the fit."""
    if signals.get("alignment") == "not tried":
        return ["The IMU recording cannot be used as it is, for the reasons below."]
    if signals.get("alignment") == "failed":
        return [
            "Camera and IMU could not be aligned: check the reasons and the two curves of rotation below, which should "
            "look the same."
        ]
    accel_m_s2 = _acceleration_m_s2(signals)
    if accel_m_s2 is None or accel_m_s2 >= _LITTLE_M_S2:
        return []
    return [
        f"The device hardly accelerated: {digits(accel_m_s2, 2)} m/s² without gravity, where hand-held filming "
        f"usually has {_USUAL}. An accelerometer cannot sense motion at constant speed, so nothing could be compared "
        "with the images."
    ]


def _advise_on_refusal(signals: Mapping[str, Any]) -> list[str]:
    """Advice after such a refusal: to film again only where the motion was too little."""
    accel_m_s2 = _acceleration_m_s2(signals)
    if signals.get("alignment") == "not tried":
        return [_RAW]
    if signals.get("alignment") == "failed" or (accel_m_s2 is not None and accel_m_s2 >= _LITTLE_M_S2):
        return [_MODEL]
    return [_MODEL] if accel_m_s2 is None else [_MOVE]


def _acceleration_m_s2(signals: Mapping[str, Any]) -> float | None:
    """The device's acceleration, by the accelerometer: what the camera shows has no unit without a scale."""
    value: float | None = signals.get("acceleration", {}).get("rms_accelerometer_m_s2")
    return value


def outcome_of_stop(reason: str, *, findings: bool) -> dict[str, Any]:
    """The same where a run ended before there was a model, with or without findings about the recording."""
    return {
        "verdict": "stopped",
        "headline": "Stopped before there was a scale",
        "answers": [],
        "tried": [],
        "summary": [reason[:1].upper() + reason[1:]],
        "todo": ["See the findings below, each with its remedy."] if findings else [],
    }
