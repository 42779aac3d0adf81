"""The page of an IMU's calibration: verdict, numbers, and what is left over in each rest and each turn."""

from __future__ import annotations

from html import escape

import numpy as np

from colmap_inertial import __version__
from colmap_inertial.checks.report.figures import BAD, IMU, QUIET, Figure
from colmap_inertial.checks.report.markup import facts, listing, table
from colmap_inertial.checks.report.page import document
from colmap_inertial.checks.report.parts import Plot, Section
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import IMU_CAL, Array
from colmap_inertial.inertial.core.priors import KNOWN_GAIN, model_scale_sigma
from colmap_inertial.inertial.static_calibration import RestCalibration

#: How the page is coloured.
_TONE = {"good": "trusted", "weak": "weak"}


def calibration_page(found: RestCalibration, *, source: str) -> str:
    """The calibration as one HTML file that needs nothing else.

    Parameters
    ----------
    source
        The recording's path.
    """
    return document(
        [_outcome(found), _residuals(found), _numbers(found)],
        title="IMU calibration" + (f" of {found.calibration.device}" if found.calibration.device else ""),
        verdict=_TONE[found.verdict],
        source=source,
        footer=f"colmap-inertial {__version__}. The calibration itself is the JSON file beside this page.",
    )


def gain_effect(found: RestCalibration) -> str:
    """What the calibration does for the interval of a scale, in words."""
    pct = 100 * Z95 * found.calibration.gain_sigma
    known = (
        f"the accelerometer's gain is known to +-{pct:.2g} % in every direction (95 %; without calibration to +-1 %)"
    )
    if found.calibration.gain_sigma > KNOWN_GAIN:
        return f"{known}; that is too little to lower the floor of a scale's interval"
    before, after = (100 * Z95 * model_scale_sigma(calibrated) for calibrated in (False, True))
    return f"{known}; the floor of a scale's interval falls from +-{before:.1g} % to +-{after:.1g} %"


def _outcome(found: RestCalibration) -> Section:
    calibration = found.calibration
    turns = np.degrees(found.turn_residual_rad[np.isfinite(found.turn_residual_rad)])
    values = [
        ("rests", f"{len(found.rests)} in {calibration.attitudes} attitudes"),
        ("gravity, as it was read", f"{found.rms_pct(found.before_m_s2):.2g} % rms off"),
        ("gravity, corrected", f"{found.rms_pct(found.after_m_s2):.2g} % rms off"),
        ("strength of gravity", f"{calibration.gravity_m_s2:.5f} m/s2"),
    ]
    if calibration.temperature_c is not None:
        values.append(("the sensors' temperature", f"{calibration.temperature_c:.0f} °C"))
    if len(turns) > 0:
        values.append(("turns miss gravity by", f"{np.sqrt(np.mean(turns**2)):.2g}° rms"))
    parts = [
        f'<span class="verdict">{escape(found.verdict)}</span><h2>{escape(_HEADLINES[found.verdict])}</h2>',
        listing([*found.reasons, gain_effect(found)]),
        facts(values),
        "<!--links-->",
    ]
    return Section(anchor="outcome", short="", parts=parts, classes=f"outcome {_TONE[found.verdict]}")


_HEADLINES = {"good": "The attitudes determine the calibration", "weak": "A part stays undetermined"}


def _residuals(found: RestCalibration) -> Section:
    middle_s = 0.5 * (found.rests.begin_s + found.rests.end_s)
    between_s = 0.5 * (found.rests.end_s[:-1] + found.rests.begin_s[1:])
    gravity = found.calibration.gravity_m_s2
    names = [f"attitude {number + 1}" for number in found.rests.attitude]
    lengths = _dots(
        [
            ("as read", QUIET, middle_s, 100 * found.before_m_s2 / gravity, names),
            ("corrected", IMU, middle_s, 100 * found.after_m_s2 / gravity, names),
        ],
        "gravity too long (%)",
    )
    left = _dots([("corrected", IMU, middle_s, 100 * found.after_m_s2 / gravity, names)], "gravity too long (%)")
    turned = _dots(
        [("turn", BAD, between_s, np.degrees(found.turn_residual_rad), [""] * len(between_s))],
        "gravity missed after a turn (°)",
    )
    parts: list[str | Plot] = [
        "<h2>What is left over</h2>",
        "<p>In each rest, the length of the mean reading against the strength of gravity:</p>",
        Plot(figure=lengths, label="Length of gravity in each rest, as read and corrected"),
        "<p>The same, corrected, by itself. Nothing but noise should be left:</p>",
        Plot(figure=left, label="Length of gravity in each rest, corrected"),
        "<p>From one rest to the next, the angle by which the corrected gyroscope misses gravity:</p>",
        Plot(figure=turned, label="Angle by which the gyroscope misses gravity after each turn"),
    ]
    return Section(anchor="residuals", short="Residuals", parts=parts)


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
    layout = {
        "height": 260,
        "margin": {"l": 68, "r": 12, "t": 30, "b": 46},
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom", "xanchor": "left"},
        "showlegend": len(series) > 1,
        "hovermode": "closest",
        "xaxis": {"title": {"text": "time since the recording's start (s)"}},
        "yaxis": {"title": {"text": title}, "zeroline": True},
    }
    return {"data": data, "layout": layout}


def _numbers(found: RestCalibration) -> Section:
    calibration = found.calibration
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
        for axis, value, s in zip("xyz", bias, sigma[where], strict=True):
            rows.append((f"{name} bias {axis}", f"{value:+.5f} {unit}", f"±{Z95 * s:.2g} {unit}"))
    parts = [
        "<h2>Parameters</h2>",
        "<p>True = (1 + gain) reading + misalignments - bias. Intervals hold 95 %.</p>",
        table(("parameter", "value", "95 %"), rows, numbers=(1, 2)),
    ]
    return Section(anchor="parameters", short="Parameters", parts=parts)
