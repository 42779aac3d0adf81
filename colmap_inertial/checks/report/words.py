"""The outcome in plain words: what was found, what it means, what to do."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from colmap_inertial.inertial.scale.parts import parts_in_words
from colmap_inertial.inertial.scale.verdict import TRUSTED_HALF_WIDTH

#: Camera acceleration below which there is too little to weigh gravity against; what filming by hand usually has.
_LITTLE_M_S2, _USUAL = 0.3, "0.5 to 2 m/s²"

_MOVE = (
    "Film again, and move the camera itself: swing it by 20 cm or more, to and fro and up and down, about once a "
    "second, all through the recording, for 10 s or longer. Rotating on the spot, a tripod, or gliding at constant "
    "speed tells nothing."
)
_RAW = (
    "Record the raw gyroscope and accelerometer (with gravity), from before the first frame to after the last, with "
    "the camera's stabilisation switched off."
)
_TARGET = (
    "To be independent of motion, put a printed board into the scene and name it in capture.toml ([target]), or give "
    "metres by a length you measured: reconstruct OUT/colmap NEW_FOLDER --scale-from distance, or --scale-from target."
)
_CHECK = "Look into what the reasons name; until then, check lengths against one that you know."


def digits(value: float, count: int = 4) -> str:
    """A number with so many significant digits, never in powers of ten where it can be avoided."""
    text = f"{value:.{count}g}"
    return f"{value:.0f}" if "e+" in text and abs(value) < 1e9 else text


def signed(value: float, decimals: int = 2) -> str:
    """A number with its sign."""
    return f"{value:+.{decimals}f}".replace("-", "−")


def half_width_pct(metres_per_unit: float, ci95: Sequence[float]) -> float:
    """Half of the 95 % interval, in per cent of the scale."""
    return 50 * (ci95[1] - ci95[0]) / metres_per_unit


def length_error(pct: float) -> str:
    """What a relative error does to ten metres, in a unit that fits."""
    metres = 10 * pct / 100
    if metres >= 1:
        return f"{metres:.2g} m"
    return f"{100 * metres:.2g} cm" if metres >= 0.01 else f"{1000 * metres:.2g} mm"


def not_checked(checked: Collection[str]) -> str:
    """What a check beforehand had nothing to look at, where that leaves a doubt; empty otherwise."""
    if "gyroscope" not in checked:
        return ""
    said = []
    if "accelerometer" not in checked:
        said.append("gravity and scale (no accelerometer)")
    if not {"pictures", "pictures far apart", "poses"} & set(checked):
        said.append(
            "whether camera and gyroscope belong together, their axes, unit and clocks (no poses, and no pictures that "
            "show enough of the same)"
        )
    elif "pictures far apart" in checked:
        said.append("stabilisation and focal length (the pictures are too far apart in time)")
    return "; ".join(said)


def parts_mapped_in_words(mapping: dict[str, Any] | None) -> list[str]:
    """In how many parts a recording was mapped, and which of them do not fit; by ``mapping`` of the result."""
    if mapping is None or mapping["parts"] == 1:
        return []
    said = [f"COLMAP mapped the recording in {mapping['parts']} parts."]
    for met in mapping.get("seams", ()):
        if not met["joined"]:
            said.append(
                f"What two of them both show ({' and '.join(met['images'])}, {met['pairs']} pairs of images) does not "
                f"fit and was left out ({100 * met['agree']:.0f} % of the matches agree)."
            )
    return said


def mapped_in_words(mapping: dict[str, Any] | None, colmap_index: int | None) -> list[str]:
    """What there is to say of how one model was made: its ends that met; by ``mapping`` of the result."""
    if mapping is None:
        return []
    said = []
    for met in mapping["ends"]:
        if met["model"] == colmap_index:
            where = f"ends that met ({' and '.join(met['images'])}, {met['pairs']} pairs of images)"
            agree = f"{100 * met['agree']:.0f} %"
            done = "were joined" if met["joined"] else f"do not fit and stay apart ({agree} of their matches agree)"
            said.append(f"Its {where} {done}.")
    return said


def outcome_of_model(model: dict[str, Any]) -> dict[str, Any]:
    """Headline, summary and advice for one model of ``result.json``, with ``signals`` where they were kept.

    Returns
    -------
    ``verdict``, ``headline``, ``summary`` (sentences) and ``todo`` (sentences; empty where nothing needs doing).
    """
    verdict, scale, ci95 = model["verdict"], model["metres_per_unit"], model["ci95"]
    if scale is None or ci95 is None:
        return _refused(model)
    pct = half_width_pct(scale, ci95)
    summary = [
        f"One unit of COLMAP's model is {digits(scale)} m; with 95 % certainty between {digits(ci95[0])} and "
        f"{digits(ci95[1])} m (±{digits(pct, 2)} %).",
    ]
    todo = []
    if verdict == "trusted":
        headline = "The scale can be trusted"
        summary.append(f"In the metric model, 10 m are 10 m to within ±{length_error(pct)}, and it stands upright.")
    else:
        headline = "The scale is rough"
        summary.append(
            f"In the metric model, 10 m may be off by {length_error(pct)} or, if what is listed below is at fault, by "
            "more. It has the right order of size and stands upright; do not measure by it without a check against a "
            "known length."
        )
        # livelier motion narrows the interval; it mends nothing else
        todo = [_MOVE if pct > 100 * TRUSTED_HALF_WIDTH else _CHECK]
        todo += [] if model.get("validation") else [_TARGET]
    if model.get("parts"):
        made_of, advice = parts_in_words(model["parts"])
        summary.append(f"What makes the interval so wide: {made_of.replace('+-', '±')}. To narrow it most, {advice}.")
    checked = model.get("validation")
    if checked and checked.get("scale_error_pct") is not None:
        word = "within" if checked["within_tolerance"] else "outside"
        summary.append(
            f"Measured against the target in the images, lengths are {signed(checked['scale_error_pct'])} % off, "
            f"{word} the tolerance of {checked['tolerance_pct']:g} %."
        )
    return {"verdict": verdict, "headline": headline, "summary": summary, "todo": todo}


def _refused(model: dict[str, Any]) -> dict[str, Any]:
    summary = ["The recording does not tell how large things are, so no number is given rather than a wrong one."]
    todo = [_MOVE, _RAW, _TARGET]
    signals = model.get("signals", {})
    # by the accelerometer: what the camera shows has no unit without a scale
    accel_m_s2 = signals.get("acceleration", {}).get("rms_accelerometer_m_s2")
    if signals.get("alignment") == "not tried":
        summary.append("The IMU recording cannot be used as it is, for the reasons below.")
        todo = [_RAW, _TARGET]
    elif signals.get("alignment") == "failed":
        summary.append(
            "Camera and IMU could not be brought together: check the reasons and the two curves of rotation below, "
            "which should look the same."
        )
        todo = [_RAW, _MOVE, _TARGET]
    elif accel_m_s2 is not None and accel_m_s2 < _LITTLE_M_S2:
        summary.append(
            f"The device hardly sped up or slowed down: its accelerometer measured {digits(accel_m_s2, 2)} m/s² beside "
            f"gravity, where filming by hand usually has {_USUAL}. It measures no speed, so there was nothing to "
            "compare with the images."
        )
        todo = [_MOVE, _TARGET]
    summary.append(
        f"COLMAP's own model ({model['sparse']}) is complete: its shape is not affected, only its size is unknown."
    )
    return {"verdict": "refused", "headline": "No scale could be found", "summary": summary, "todo": todo}


def outcome_of_stop(reason: str, *, findings: bool) -> dict[str, Any]:
    """The same where a run ended before there was a model, with or without findings about the recording."""
    return {
        "verdict": "stopped",
        "headline": "Stopped before there was a scale",
        "summary": [reason[:1].upper() + reason[1:]],
        "todo": ["What was found in the recording is listed below, each with what to do about it."] if findings else [],
    }
