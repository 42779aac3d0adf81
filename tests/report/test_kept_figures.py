"""Figures of the report and their still pictures are those that somebody has looked at.

``python tests/report/test_kept_figures.py FOLDER`` writes them as HTML to look at, and the file that they are
compared with.
"""

import json
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.report import figures
from colmap_inertial.report.figure_3d import scene_figure
from colmap_inertial.report.still import draw_still
from colmap_inertial.report.still_3d import StillView, draw_scene_still

KEPT = Path(__file__).parents[1] / "references" / "report_figures.json"
T_S = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]


def line(*values):
    return {"t_s": T_S[: len(values)], "values": list(values)}


THREE = [
    line(0.1, 0.2, None, -0.1, 0.0, 0.4),
    line(0.0, 0.1, 0.2, 0.3, 0.2, 0.1),
    line(-0.5, 0.5, -0.5, 0.5, -0.5, 0.5),
]
OTHER = [
    line(0.11, 0.18, 0.1, -0.12, 0.02, 0.38),
    line(0.02, 0.1, 0.21, 0.28, 0.2, 0.1),
    line(-0.4, 0.5, -0.5, 0.6, -0.5, 0.4),
]
SPECTRUM = {
    "imu": {"hz": [0.1, 1.0, 10.0, 100.0], "density": [0.02, 0.2, 0.5, 0.05]},
    "imu_at_frames": {"hz": [0.1, 1.0, 10.0], "density": [0.02, 0.19, None]},
    "camera": {"hz": [0.1, 1.0, 10.0], "density": [0.03, 0.18, 0.0]},
}
PARTS = [
    {"begin_s": 10.0, "end_s": 15.0, "metres_per_unit": 2.02, "sigma_log": 0.004, "percent": 1.0, "sigma_percent": 0.4},
    {
        "begin_s": 15.0,
        "end_s": 20.0,
        "metres_per_unit": 1.99,
        "sigma_log": 0.008,
        "percent": -0.5,
        "sigma_percent": 0.3,
    },
    {"begin_s": 20.0, "end_s": 24.0, "metres_per_unit": 2.4, "sigma_log": 0.9, "percent": 0.2, "sigma_percent": 0.9},
]
MODEL = {"metres_per_unit": 2.0, "half_width_pct": 0.8, "drift": {"parts": PARTS}, "signals": {"first_frame_s": 9.0}}
FRAMES = [
    {"action": action, "t_s": t_s, "blur_px": blur_px, "name": f"<{t_s}>.jpg"}
    for action, t_s, blur_px in (
        *(("deblurred", 0.0, 9.123), ("passed", 0.5, 2.0), ("dropped", 1.0, 31.5)),
        *(("passed", None, 1.0), ("passed", 2.0, 0.5)),
    )
]
SHIFTS = {
    "width": 640,
    "height": 480,
    "at_px": [[100.0, 100.0], [300.0, 240.0], [600.0, 400.0]],
    "shift_px": [[1.0, -0.5], [0.0, 2.0], [-3.0, 1.0]],
}
VALIDATION = {
    "distances": [
        {"set": "control", "known_m": 0.03, "residual_m": 0.0001, "pair": ["a<", "b"]},
        {"set": "check", "known_m": 0.25, "residual_m": -0.0004, "pair": ["a<", "z"]},
        {"set": "control", "known_m": 0.03, "residual_m": -0.00005, "pair": ["b", "c"]},
    ],
    "views": [{"name": f"{i}.jpg", "corners": 40 + i, "rms_px": 0.2 + 0.05 * i} for i in range(20)],
}
SENSOR = {
    "columns": 3,
    "rows": 2,
    "width": 300,
    "height": 200,
    "mean_x_px": [0.5, 0.0, -0.25, None, 0.1, 0.2],
    "mean_y_px": [0.0, 0.5, 0.25, None, -0.1, -0.3],
    "rms_px": [0.5, 0.5, 0.4, None, 0.3, 0.7],
}
GROUND = {"x0": -1.0, "y0": 2.0, "step": 0.5, "images": [[0, 2, 5], [7, 9, 1]]}
PATH = {"xyz": [[0.0, 1.0, 2.0, 2.0], [0.0, 0.0, 0.5, 1.5], [1.0, 1.0, 1.0, 1.2]], "t_s": [0.0, 0.5, 1.0, 1.5]}
POINTS = np.random.default_rng(0).uniform([[-1.0], [-1.0], [0.0]], [[3.0], [2.0], [0.4]], (3, 40)).round(2)


def scene(unit, *, gravity_known):
    return {
        "unit": unit,
        "gravity_known": gravity_known,
        "points_in_model": 900,
        "points": {"xyz": POINTS.tolist(), "rgb": [f"#{6 * i:02x}{3 * i:02x}80" for i in range(40)]},
        "path": PATH,
        "cameras": {
            # of two cameras: x, y, z
            "xyz": [[0.0, 2.0], [0.0, 0.5], [1.0, 1.0]],
            "right": [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]],
            "down": [[0.0, 0.0], [0.0, 0.0], [-1.0, -1.0]],
            "ahead": [[0.0, -1.0], [1.0, 0.0], [0.0, 0.0]],
            "half_width": 0.6,
            "half_height": 0.4,
        },
    }


def flat():
    before = {"camera": THREE, "gyroscope": OTHER, "camera_size": THREE[0], "gyroscope_size": OTHER[0]}
    after = {"camera": THREE, "gyroscope": OTHER}
    return {
        "rotation before": figures.rotation_before({"before": before, "after": after}),
        "speeds before": figures.rotation_before({"before": before, "after": None}),
        "rotation after": figures.rotation_after({"after": after}),
        "deviations": figures.deviations({"deviation_deg": line(0.1, 0.2, 40.0, 0.1, None, 0.3)}),
        "accelerations": figures.accelerations({"camera_unit": "m/s2", "accelerometer": THREE, "camera": OTHER}),
        "accelerations apart": figures.accelerations(
            {"camera_unit": "units/s2", "accelerometer": THREE, "camera": OTHER}
        ),
        "spectra": figures.spectra({"curves": SPECTRUM}, unit="°/s", factor=57.3),
        "spectra apart": figures.spectra({"curves": SPECTRUM, "camera_unit": "units/s2"}, unit="m/s²"),
        "drift": figures.drift(MODEL),
        "refined": figures.refined(MODEL, PARTS),
        "blur": figures.blur(FRAMES),
        "shutter over time": figures.shutter_over_time(
            {"t_s": T_S, "largest_px": [3, 2, 1, 4, 5, 3], "median_px": [1] * 6}
        ),
        "shutter field": figures.shutter_field(SHIFTS),
        "target distances": figures.target_distances(VALIDATION),
        "target views": figures.target_views(VALIDATION),
        "distortion": figures.distortion({"distortion": SHIFTS, "width": 640, "height": 480}),
        "residuals by image": figures.residuals_by_image(
            [{"name": f"{i}<", "observations": 9 * i, "rms_px": None if i == 1 else 0.3 + 0.1 * i} for i in range(4)]
        ),
        "residuals on the sensor": figures.residuals_on_sensor(SENSOR),
        "track lengths": figures.track_lengths({"counts": [50, 30, 20, 10, 5]}),
        "overlap": figures.overlap(GROUND, PATH["xyz"], "m"),
    }


def drawn():
    out = {name: [figure, draw_still(figure, name)] for name, figure in flat().items()}
    for name, unit, known, view in (
        ("scene", "m", True, StillView()),
        ("scene without a unit", "units", False, StillView()),
        ("scene from above", "m", True, StillView.from_above()),
    ):
        figure = scene_figure(scene(unit, gravity_known=known))
        # the points are a PNG, which encoders write differently
        still = re.sub(r"data:image/png;base64,[^\"]*", "PNG", draw_scene_still(figure, name, view))
        out[name] = [figure, still]
    return out


_NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")


def differences(seen, wanted, where=""):
    """Where two figures differ: numbers by more than a thousandth, or a tenth of a pixel in pictures."""
    if isinstance(wanted, dict) and isinstance(seen, dict) and seen.keys() == wanted.keys():
        return [d for key in wanted for d in differences(seen[key], wanted[key], f"{where}.{key}")]
    if isinstance(wanted, list) and isinstance(seen, list) and len(seen) == len(wanted):
        return [d for i, pair in enumerate(zip(seen, wanted, strict=True)) for d in differences(*pair, f"{where}[{i}]")]
    if isinstance(wanted, float | int) and isinstance(seen, float | int) and not isinstance(wanted, bool):
        same = math.isclose(seen, wanted, rel_tol=1e-3, abs_tol=1e-6)
    elif isinstance(wanted, str) and isinstance(seen, str) and wanted.startswith("<svg"):
        same = _NUMBER.sub("#", seen) == _NUMBER.sub("#", wanted) and np.allclose(
            *([float(n) for n in _NUMBER.findall(text)] for text in (seen, wanted)), rtol=0, atol=0.11
        )
    else:
        same = type(seen) is type(wanted) and seen == wanted
    return [] if same else [f"{where}: {str(seen)[:300]} instead of {str(wanted)[:300]}"]


def test_figures_and_stills_are_those_that_were_looked_at(subtests):
    kept = json.loads(KEPT.read_text())
    made = json.loads(json.dumps(drawn()))
    assert made.keys() == kept.keys()
    for name, wanted in kept.items():
        with subtests.test(name):
            assert differences(made[name], wanted) == []


@pytest.mark.parametrize("changed", ["<svg x='10.2'/>", "<svg y='10'/>", "<svg x='10' z='1'/>"])
def test_a_changed_picture_differs(changed):
    assert differences(["<svg x='10'/>"], ["<svg x='10.1'/>"]) == []
    assert len(differences([changed], ["<svg x='10'/>"])) == 1
    assert len(differences({"a": [1.0, None]}, {"a": [1.01, 2.0]})) == 2


if __name__ == "__main__":
    every = drawn()
    KEPT.write_text(json.dumps(every, separators=(",", ":"), ensure_ascii=False) + "\n")
    style = (Path(figures.__file__).parent / "templates" / "page.css").read_text()
    page = "".join(f"<h2>{name}</h2>{still}" for name, (_, still) in every.items())
    (Path(sys.argv[1]) / "figures.html").write_text(f"<meta charset='utf-8'><style>{style}</style>{page}")
