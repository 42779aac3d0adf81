"""The page of an IMU's calibration: verdict, numbers, and what is left over in each rest and each turn."""

from __future__ import annotations

import numpy as np

from colmap_inertial import __version__
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import sentences
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import IMU_CAL
from colmap_inertial.inertial.core.priors import KNOWN_GAIN, UNCALIBRATED, AccelPart, model_scale_sigma
from colmap_inertial.inertial.static_calibration import RestCalibration
from colmap_inertial.report.figures import BAD, IMU, QUIET, Figure, axis, layout
from colmap_inertial.report.page import render_page
from colmap_inertial.report.words import Fact


def calibration_page(found: RestCalibration, *, source: str) -> str:
    """The calibration as one HTML file that needs nothing else.

    Parameters
    ----------
    source
        The recording's path.
    """
    calibration, rests = found.calibration, found.rests
    middle_s, between_s = 0.5 * (rests.begin_s + rests.end_s), 0.5 * (rests.end_s[:-1] + rests.begin_s[1:])
    names = [f"attitude {number + 1}" for number in rests.attitude]
    before, after = (100 * error / calibration.gravity_m_s2 for error in (found.before_m_s2, found.after_m_s2))
    corrected = ("corrected", IMU, middle_s, after, names)
    turns = ("turn", BAD, between_s, np.degrees(found.turn_residual_rad), [""] * len(between_s))
    return render_page(
        "imu_calibration.html",
        title="IMU calibration" + (f" of {calibration.device}" if calibration.device else ""),
        tone={"good": "trusted", "weak": "weak"}[found.verdict],
        source=source,
        footer=f"colmap-inertial {__version__}. The calibration itself is the JSON file beside this page.",
        verdict=found.verdict,
        reasons=[*sentences(found.reasons), gain_effect(found)],
        values=calibration_facts(found),
        lengths=_dots([("as read", QUIET, middle_s, before, names), corrected], "error of gravity's magnitude (%)"),
        corrected=_dots([corrected], "error of gravity's magnitude (%)"),
        turns=_dots([turns], "gravity error after a turn (°)"),
        parameters=_parameters(found),
    )


def gain_effect(rests: RestCalibration) -> str:
    """A sentence on how the calibration changes the interval of a scale."""
    pct = 100 * Z95 * rests.calibration.gain_sigma
    evidence = (
        f"the accelerometer's gain is known to +-{pct:.2g} % in every direction (95 %; without calibration to +-1 %)"
    )
    if rests.calibration.gain_sigma > KNOWN_GAIN:
        return f"{evidence}; that is too little to lower the floor of a scale's interval"
    before, after = (100 * Z95 * model_scale_sigma(accel) for accel in (UNCALIBRATED, AccelPart(calibrated=True)))
    return f"{evidence}; the floor of a scale's interval falls from +-{before:.1g} % to +-{after:.1g} %"


def calibration_facts(rests: RestCalibration) -> list[Fact]:
    """Rests, gravity and the sensors' gains and biases with 95 % intervals."""
    calibration = rests.calibration
    turns = np.degrees(rests.turn_residual_rad[np.isfinite(rests.turn_residual_rad)])
    values = [
        ("rests", f"{len(rests.rests)} in {calibration.attitudes} attitudes"),
        ("gravity error, as read", f"{rests.rms_pct(rests.before_m_s2):.2g} % rms"),
        ("gravity error, corrected", f"{rests.rms_pct(rests.after_m_s2):.2g} % rms"),
        ("strength of gravity", f"{calibration.gravity_m_s2:.5f} m/s2"),
    ]
    if calibration.temperature_c is not None:
        values.append(("the sensors' temperature", f"{calibration.temperature_c:.0f} °C"))
    if len(turns) > 0:
        values.append(("gravity error after turns", f"{np.sqrt(np.mean(turns**2)):.2g} degrees rms"))
    for name, label in (("accel", "accel."), ("gyro", "gyro")):
        unit = "m/s2" if name == "accel" else "rad/s"
        gains = [f"{100 * getattr(calibration, f'{name}_gain')[i, i]:+.3f}" for i in range(3)]
        gain_pct = 100 * Z95 * max(calibration.sigma(f"{name}_gain_{axis}{axis}") for axis in "xyz")
        field = f"{name}_bias_{unit.replace('/', '_')}"
        bias = ", ".join(f"{value:+.4f}" for value in getattr(calibration, field))
        spread = Z95 * max(calibration.sigma(f"{name}_bias_{axis}_{unit.replace('/', '_')}") for axis in "xyz")
        values.append((f"{label} gain", f"{', '.join(gains)} %, +-{gain_pct:.2g} (95 %)"))
        values.append((f"{label} bias", f"{bias} {unit}, +-{spread:.2g} (95 %)"))
    return values


def _dots(series: list[tuple[str, str, Array, Array, list[str]]], title: str) -> Figure:
    data = []
    for name, colour, t_s, values, texts in series:
        shown = np.isfinite(values)
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": name,
                "x": np.round(t_s[shown], 2).tolist(),
                "y": [float(f"{value:.5g}") for value in values[shown]],
                "text": [text for text, keep in zip(texts, shown, strict=True) if keep],
                "hovertemplate": "%{x:.0f} s: %{y:.4g} %{text}<extra></extra>",
                "marker": {"color": colour, "size": 7},
            }
        )
    x, y = axis("time since the recording's start (s)"), axis(title, zeroline=True)
    shape = layout(260, x, y, showlegend=len(series) > 1, margin={"l": 68, "t": 30})
    return {"data": data, "layout": shape}


def _parameters(rests: RestCalibration) -> list[tuple[str, str, str]]:
    """Name, value and 95 % of each parameter that was estimated."""
    calibration = rests.calibration
    sigma = np.sqrt(np.diagonal(calibration.cov))
    rows = []
    kinds = (
        ("accelerometer", calibration.accel_gain, IMU_CAL.ACCEL_GAIN),
        ("gyroscope", calibration.gyro_gain, IMU_CAL.GYRO_GAIN),
    )
    for name, matrix, where in kinds:
        spread = sigma[where].reshape(3, 3)
        for i, j in np.ndindex(3, 3):
            if spread[i, j] == 0:
                continue
            factor, unit = (100.0, "%") if i == j else (180 / np.pi, "°")
            what = f"{name} gain {'xyz'[i]}" if i == j else f"{name} misalignment {'xyz'[i]}{'xyz'[j]}"
            rows.append((what, f"{factor * matrix[i, j]:+.4f} {unit}", f"±{factor * Z95 * spread[i, j]:.2g} {unit}"))
    for name, bias, where, unit in (
        ("accelerometer", calibration.accel_bias_m_s2, IMU_CAL.ACCEL_BIAS, "m/s²"),
        ("gyroscope", calibration.gyro_bias_rad_s, IMU_CAL.GYRO_BIAS, "rad/s"),
    ):
        for letter, value, s in zip("xyz", bias, sigma[where], strict=True):
            rows.append((f"{name} bias {letter}", f"{value:+.5f} {unit}", f"±{Z95 * s:.2g} {unit}"))
    return rows
