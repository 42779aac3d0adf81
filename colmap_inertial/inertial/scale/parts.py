"""What makes a scale's interval as wide as it is, and what would narrow it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from colmap_inertial.inertial.scale.verdict import half_width


@dataclass(frozen=True, kw_only=True)
class Cause:
    """One cause of uncertainty.

    Attributes
    ----------
    words
        What it is.
    advice
        What removes it.
    """

    words: str
    advice: str


_TURN = "turn the camera about all of its axes while it moves"
_LONGER = "record longer, with brisker movements of the camera itself in several directions"

#: Every part of an interval, by its key in ``ScaleEstimate.parts``.
CAUSES: dict[str, Cause] = {
    "accel_gain": Cause(words="the accelerometer's gain", advice="calibrate the IMU once (calibrate-imu)"),
    "lens": Cause(
        words="the lens and the model's shape",
        advice="film a target of known size, or two points whose distance is measured, and take the metres from them",
    ),
    "accel_noise": Cause(words="the accelerometer's noise", advice=_LONGER),
    "lost_readings": Cause(
        words="readings that are missing", advice="record without pauses, and within the ranges of the sensors"
    ),
    "accel_bias": Cause(words="the accelerometer's bias", advice=_TURN),
    "camera_path": Cause(
        words="the camera's path",
        advice=f"{_LONGER}; sharper frames, more texture and more frames a second make the path better",
    ),
    "gyro": Cause(words="the gyroscope", advice=_TURN),
    "camera_imu": Cause(
        words="how camera and IMU stand to each other",
        advice="calibrate camera and IMU once (align), or give what is known of them",
    ),
    "gravity": Cause(words="the strength of gravity", advice="give the latitude"),
    "accel_faults": Cause(
        words="what was undone of the accelerometer's faults", advice="record what is undone here rightly"
    ),
    "noise_levels": Cause(words="how little the clip says of its own noise", advice="record longer"),
}


#: Parts below this share of the whole half-width are not worth a word.
_WORTH_SAYING = 0.2


def parts_in_words(parts: Mapping[str, float]) -> tuple[str, str]:
    """What an interval is made of, and what would narrow it most.

    Parameters
    ----------
    parts
        ``ScaleEstimate.parts``: standard deviations of the logarithm, whose squares add up.

    Returns
    -------
    Half-widths in per cent that the interval would have with each part alone, the largest first, and the advice for
    that one.
    """
    whole = sum(sigma**2 for sigma in parts.values()) ** 0.5
    largest = sorted(parts.items(), key=lambda part: -part[1])
    said = [
        f"{CAUSES[name].words} +-{100 * half_width(sigma):.2g} %"
        for name, sigma in largest
        if sigma >= _WORTH_SAYING * whole
    ]
    return f"{', '.join(said)}; they add up in squares", CAUSES[largest[0][0]].advice
