"""The report says what the results say, leaves out what there is no data for, and runs nothing that a user named."""

import base64
import dataclasses
import gzip
import html.parser
import json
import re
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import plotly.graph_objects as graph_objects
import pycolmap
import pytest

from colmap_inertial.cli import main
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.core.errors import FormatError, InertialError, MappingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_exp, quat_rotate
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions
from colmap_inertial.core.types import (
    CameraModel,
    CameraTrajectory,
    FrameTiming,
    ImuRecording,
    ScaleDrift,
    ScaleEstimate,
)
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.files import write_json
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import trajectory_from_model
from colmap_inertial.report import figures, signals, write_report
from colmap_inertial.report.content import _describe_path
from colmap_inertial.report.figure_3d import _grid, scene_figure
from colmap_inertial.report.photogrammetry import scene_record
from colmap_inertial.report.series import SIZES, nice_length, round_values, stride_indices, thin_line
from colmap_inertial.report.signals import signal_record
from colmap_inertial.report.still import STYLE, draw_still
from colmap_inertial.report.still_3d import StillView, draw_scene_still
from colmap_inertial.report.still_axes import choose_axis, equalise
from colmap_inertial.report.words import outcome_of_model
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.commands.reconstruct_project import reconstruct_project
from colmap_inertial.run.commands.reporting import reporting_stops, write_recording
from colmap_inertial.run.stages.imaging_plan import GyroView
from colmap_inertial.run.stages.rolling_shutter import RollingShutterStage
from colmap_inertial.run.steps.runner import StepRunner
from colmap_inertial.run.steps.session import Session
from colmap_inertial.run.steps.workspace import Workspace
from tests.helpers.desk_scene import DETERMINISTIC, SCENE, copy_scene
from tests.helpers.report_runs import HOSTILE, cloud, recorded, write_run


class Page(html.parser.HTMLParser):
    """What a browser would make of a page: tags with attributes, and the text that is shown."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.packed: dict[str, str] = {}
        self._parts: list[str] = []
        self._inside: list[tuple[str, dict[str, str | None]]] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.text = re.sub(r"\s+", " ", "".join(self._parts).replace("\N{NO-BREAK SPACE}", " "))

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag in ("script", "style"):
            self._inside.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if self._inside and self._inside[-1][0] == tag:
            self._inside.pop()

    def handle_data(self, data):
        if not self._inside:
            self._parts.append(data)
        elif self._inside[-1][1].get("id"):
            self.packed[self._inside[-1][1]["id"]] = data

    def figures(self):
        return json.loads(gzip.decompress(base64.b64decode(self.packed["figures"])))

    def anchors(self):
        return [attrs["id"] for tag, attrs in self.tags if tag == "section"]


def report_of(out):
    write_report(out)
    return json.loads((out / "report.json").read_text(encoding="utf-8")), Page(out / "report.html")


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """A run with data for everything: (folder, content of result.json). Tests must not change it."""
    out = tmp_path_factory.mktemp("full") / "out"
    result = write_run(out)
    for path in (out / "validation" / "0").iterdir():  # each report makes them small again
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (480, 360), interpolation=cv2.INTER_AREA))
    return out, result


@pytest.fixture(scope="module")
def full_report(full):
    """Its report."""
    return report_of(full[0])


@pytest.fixture(scope="module")
def refused(tmp_path_factory):
    """A run whose scale was refused: (folder, content of result.json). Tests must not change it."""
    out = tmp_path_factory.mktemp("refused") / "out"
    return out, write_run(out, kind="constant_velocity", duration_s=10.0)


def copy_of(run, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(run[0], out)
    return out


# What is said


def test_the_numbers_are_those_of_the_result(full, full_report):
    _, result = full
    content, page = full_report
    (model,) = content["models"]
    for key, value in result["models"][0].items():
        if key not in ("drift", "validation", "cov"):
            assert model[key] == value
    assert model["drift"] == result["models"][0]["drift"]
    assert {**model["validation"], "pictures": None} == {**result["models"][0]["validation"], "pictures": None}
    assert content["seconds"] == result["seconds"]
    assert content["versions"] == result["versions"]
    assert content["configuration"]["values"] == {"seed": 0, "note": "frame"}
    scale, (low, high) = model["metres_per_unit"], model["ci95"]
    assert content["outcome"]["verdict"] == model["verdict"] == "trusted"
    assert model["half_width_pct"] == pytest.approx(50 * (high - low) / scale)
    for number in (scale, low, high):
        assert f"{number:.4g}" in page.text
    assert "−0.31 %" in page.text
    assert "saturated" in page.text
    assert "mapping" in page.text


def test_every_section_that_has_data_is_there_and_every_figure_has_its_place(full_report):
    _, page = full_report
    assert page.anchors() == [
        "outcome",
        "findings",
        "numbers",
        "scene",
        "survey",
        "residuals",
        "camera",
        "rotation",
        "acceleration",
        "spectra",
        "drift",
        "target",
        "blur",
        "frames",
        "shutter",
        "run",
    ]
    places = [attrs["data-figure"] for tag, attrs in page.tags if attrs.get("class") == "plot" and tag == "div"]
    assert places == list(page.figures())
    assert len(places) == 18
    assert sum(tag == "img" for tag, _ in page.tags) == 3 * 2 + 4


class Drawing(html.parser.HTMLParser):
    """Shapes and words of a still picture."""

    def __init__(self, svg):
        super().__init__()
        self.shapes, self.words = [], []
        self.feed(svg)

    def handle_starttag(self, tag, attrs):
        self.shapes.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.words.append(data)

    def lines(self, colour):
        """Corners of the lines of a colour, piece by piece."""
        paths = [a["d"] for tag, a in self.shapes if tag == "path" and a.get("stroke") == colour]
        pieces = [piece for path in paths for piece in path.split("M") if piece]
        return [np.array([corner.split() for corner in piece.split("L")], dtype=float) for piece in pieces]


def test_every_plot_has_a_still_picture_that_shows_the_same(full_report):
    _, page = full_report
    stills = [attrs for tag, attrs in page.tags if tag == "svg" and attrs["class"] == "still"]
    places = [attrs for tag, attrs in page.tags if attrs.get("class") == "plot" and tag == "div"]
    assert [s["aria-label"] for s in stills][1:] == [
        p["aria-label"] for p in places
    ]  # the first one is the first screen's
    for figure in page.figures().values():
        if "scene" not in figure["layout"]:
            words = Drawing(draw_still(figure, "x")).words
            assert figure["layout"]["xaxis"]["title"]["text"] in words


def test_a_still_line_lies_where_its_axes_say():
    line = {"type": "scatter", "mode": "lines", "x": [0.0, 5.0, None, 10.0, 10.0], "y": [0.0, 50.0, None, 100.0, 0.0]}
    spec = figures.layout(300, figures.axis("t", range=[0, 10]), figures.axis("v", range=[0, 100]))
    trace = {**line, "name": "a <b>", "line": {"color": "#123456", "width": 1}}
    still = Drawing(draw_still({"data": [trace], "layout": spec}, 'a "label"'))
    first, second = still.lines("#123456")
    ticks = {
        word: (float(attrs["x"]), float(attrs["y"]))
        for (tag, attrs), word in zip([s for s in still.shapes if s[0] == "text"], still.words, strict=True)
    }
    assert {"0", "2", "4", "6", "8", "10", "40", "60", "100", "t", "v"} <= set(ticks)
    # x ticks lie below their place, y ticks beside it, a quarter of a line lower
    assert first[0] == pytest.approx([ticks["2"][0] - (ticks["4"][0] - ticks["2"][0]), second[1, 1]], abs=0.2)
    assert first[1] == pytest.approx(
        [0.5 * (ticks["4"][0] + ticks["6"][0]), 0.5 * (ticks["40"][1] + ticks["60"][1]) - 4], abs=0.2
    )
    assert second[0] == pytest.approx([ticks["10"][0], ticks["100"][1] - 4], abs=0.2)


def test_logarithmic_equal_and_coloured_axes_of_stills():
    axis = choose_axis({"type": "log"}, [[0.1, None, 100.0]], 0.0, 300.0, pad=0.0)
    assert [axis.place(v) for v in (0.1, 1.0, 100.0)] == pytest.approx([0, 100, 300]) and axis.place(0.0) is None
    assert [text for _, text in axis.ticks(50.0)] == ["0.1", "1", "10", "100"]
    names = choose_axis({"type": "category"}, [["a", "b", "a"]], 0.0, 300.0, pad=0.0)
    assert (names.low, names.high) == (-0.5, 1.5)  # each in the middle of its half
    x, y = (choose_axis({"range": [0, 10 * n]}, [], 0.0, 100.0, pad=0.0) for n in (1, 2))
    x, y = equalise(x, y)
    assert x.px_per_unit == y.px_per_unit == 5 and (x.begin, x.end) == (25.0, 75.0)
    heat = {"type": "heatmap", "x0": 0.5, "dx": 1.0, "y0": 0.5, "dy": 1.0, "z": [[0, None], [5, 10]]}
    heat |= {"colorscale": [[0, "#000000"], [1, "#ff0000"]], "colorbar": {"title": {"text": "images"}}}
    shape = figures.layout(200, figures.axis("x"), figures.axis("y"))
    still = Drawing(draw_still({"data": [heat], "layout": shape}, "heat"))
    cells = {a["fill"]: a["d"] for tag, a in still.shapes if tag == "path" and "fill" in a}
    assert list(cells) == ["#050000", "#850000", "#fa0000"]  # the middles of 24 steps
    assert len({path.count("M") for path in cells.values()}) == 1 and "images" in still.words


def texts_of(still):
    return list(zip(still.words, (attrs for tag, attrs in still.shapes if tag == "text"), strict=True))


def test_everything_that_a_still_says_lies_within_it_and_names_have_room():
    lines = {"type": "scatter", "mode": "lines", "x": [0.0, 1.0], "line": {"color": "#123456", "width": 1}}
    left, right = figures.axis("left", range=[0, 1]), {**figures.axis("right"), "overlaying": "y", "side": "right"}
    spec = figures.layout(300, figures.axis("t", range=[0, 1]), left, yaxis2=right, showlegend=True)
    for names, rows in ((["a", "b", "c"], 1), ([f"a name that is long, number {i}" for i in range(5)], 3)):
        data = [{**lines, "y": [0.2, 0.4], "name": name} for name in names]
        data[-1] |= {"y": [1000.0, 3000.0], "yaxis": "y2"}
        texts = texts_of(Drawing(draw_still({"data": data, "layout": spec}, "x")))
        ends = {}
        for word, attrs in texts:
            x, y, wide = float(attrs["x"]), float(attrs["y"]), STYLE.letter * len(word)
            if "transform" in attrs:  # upwards: letters stand to the left of this line, tails to the right
                assert STYLE.font <= x <= STYLE.width - STYLE.font / 4
                continue
            begin = x - wide * {"start": 0.0, "middle": 0.5, "end": 1.0}[attrs["text-anchor"]]
            assert begin >= -1 and begin + wide <= STYLE.width + 1, word
            if word in names:
                assert begin >= ends.get(y, 0.0)
                ends[y] = begin + wide
        assert len(ends) == rows and set(names) <= {word for word, _ in texts}
        assert max(ends) < min(float(attrs["y"]) for word, attrs in texts if word == "1.0")


def test_bars_of_stills_are_as_high_as_their_numbers():
    bars = {"type": "bar", "x": ["a", "b", "c"], "y": [1.0, 4.0, 2.0], "marker": {"color": "#654321"}, "name": "n"}
    spec = figures.layout(300, figures.axis("x", type="category"), figures.axis("y", range=[0, 5]))
    still = Drawing(draw_still({"data": [bars], "layout": spec}, "bars"))
    boxes = [attrs for tag, attrs in still.shapes if tag == "rect" and attrs["fill"] == "#654321"]
    left, top, width, height = np.array([[float(b[k]) for k in ("x", "y", "width", "height")] for b in boxes]).T
    assert height / height[0] == pytest.approx([1, 4, 2], rel=0.02)
    assert top + height == pytest.approx([top[0] + height[0]] * 3, abs=0.2)
    assert width == pytest.approx(0.8 * np.diff(left).mean(), rel=0.01) and np.ptp(width) < 0.2
    (labels,) = [[float(a["x"]) for word, a in texts_of(still) if word in "abc"]]
    assert left + width / 2 == pytest.approx(labels, abs=0.2)


def test_long_lines_of_stills_keep_their_peaks_and_closed_ones_all_their_corners():
    count = 5000
    x, y = np.linspace(0, 10, count), np.zeros(count)
    y[1234], angle = 1.0, np.linspace(0, 2 * np.pi, count)
    look = {"type": "scatter", "mode": "lines", "name": "n", "line": {"color": "#123456", "width": 1}}
    spec = figures.layout(300, figures.axis("x"), figures.axis("y"))
    over_time, ring = (
        Drawing(draw_still({"data": [{**look, "x": list(a), "y": list(b)}], "layout": spec}, "x")).lines("#123456")
        for a, b in ((x, y), (np.cos(angle), np.sin(angle)))
    )
    (line,) = over_time
    assert len(line) <= STYLE.line_points and np.all(np.diff(line[:, 0]) >= 0)
    assert line[np.argmin(line[:, 1]), 0] == pytest.approx(line[0, 0] + x[1234] / 10 * np.ptp(line[:, 0]), abs=1.0)
    assert len(ring[0]) == count


def test_the_cells_of_a_table_fill_its_axes(subtests):
    for places in ({"x": [1.0, 3.0, 5.0], "y": [10.0, 20.0]}, {"x0": 1.0, "dx": 2.0, "y0": 10.0, "dy": 10.0}):
        with subtests.test(places=places):
            heat = {"type": "heatmap", **places, "z": [[0, 1, 2], [3, 4, 5]], "colorbar": {"title": {"text": "n"}}}
            heat["colorscale"] = [[0, "#000000"], [1, "#ffffff"]]
            spec = figures.layout(300, figures.axis("x"), figures.axis("y"))
            still = Drawing(draw_still({"data": [heat], "layout": spec}, "heat"))
            cells = [
                re.findall(r"[\d.]+", a["d"])
                for tag, a in still.shapes
                if tag == "path" and "fill" in a and "z" in a["d"]
            ]
            left, low, right, high = np.array(cells, dtype=float)[:, :4].T
            beside = left.min() - STYLE.left, STYLE.width - STYLE.right_axis - right.max()
            assert beside[0] == pytest.approx(beside[1], abs=0.1) and 0 <= beside[0] < 0.03 * STYLE.width
            assert (right - left) == pytest.approx((right.max() - left.min()) / 3, abs=0.1) and len(cells) == 6
            # columns are at their numbers
            ticks = {word: float(attrs["x"]) for word, attrs in texts_of(still) if attrs["text-anchor"] == "middle"}
            middles = sorted({round(v) for v in 0.5 * (left + right)})
            known = [(ticks[word], at) for word, at in zip("135", middles, strict=True) if word in ticks]
            assert known and all(abs(tick - at) < 1 for tick, at in known)
            # the first row at the bottom
            assert low - high == pytest.approx((low.max() - high.min()) / 2, abs=0.2) and np.argmax(low) < 3


def test_a_drift_and_distances_are_drawn_as_they_were_measured():
    parts = [
        {
            "begin_s": 105.0 + 10 * i,
            "end_s": 115.0 + 10 * i,
            "metres_per_unit": 2.0 * (1 + 0.01 * i),
            "sigma_log": 0.004,
        }
        for i in range(3)
    ]
    model = {
        "metres_per_unit": 2.0,
        "half_width_pct": 0.8,
        "drift": {"parts": parts},
        "signals": {"first_frame_s": 100.0},
    }
    figure = figures.drift(model)
    dots, spec = figure["data"][0], figure["layout"]
    assert dots["y"] == pytest.approx([0, 1, 2]) and dots["x"] == [10, 20, 30] and dots["error_x"]["array"] == [5, 5, 5]
    assert dots["error_y"]["array"] == pytest.approx([0.784] * 3, rel=0.01)
    assert spec["xaxis"]["range"] == [0, 35] and spec["yaxis"]["range"][1] == -spec["yaxis"]["range"][0] > 2.784
    assert (spec["shapes"][0]["y0"], spec["shapes"][0]["y1"]) == (-0.8, 0.8)
    many = [
        {"known_m": 0.1, "residual_m": 1e-4 * i, "pair": ("a", "b"), "set": "check"}
        for i in range(2 * SIZES.target_distances - 1)
    ]
    (shown,) = figures.target_distances({"distances": many})["data"]
    assert len(shown["x"]) == SIZES.target_distances and set(shown["x"]) == {100.0}
    assert shown["y"][:3] == pytest.approx([0, 0.2, 0.4])


def test_a_shutter_s_movements_are_drawn_in_their_picture(subtests):
    for size_px, times in ((0.5, 115), (400.0, 1)):
        with subtests.test(size_px=size_px, times=times):
            at, way = np.array([[100.0, 50], [640, 360], [1200, 700]]), np.array([[0.2, 0.1], [0, 1], [-0.6, -0.8]])
            worst = {
                "at_px": at.tolist(),
                "shift_px": (size_px * way).tolist(),
                "width": 1280,
                "height": 720,
                "name": "a.jpg",
            }
            figure = figures.shutter_field(worst)
            lines, ends = figure["data"]
            # the largest movement about a twelfth as long as the picture is wide, or as long as it is
            moved = at + (times * size_px if times == 1 else 0.09 * 1280) * way
            assert np.stack([ends["x"], ends["y"]], axis=1) == pytest.approx(moved, abs=0.5)
            assert (
                lines["x"][::3] == at[:, 0].tolist()
                and lines["y"][1::3] == ends["y"]
                and lines["x"][2::3] == [None] * 3
            )
            assert ends["text"][1] == f"{size_px:.2f} px"
            spec = figure["layout"]
            (left, right), (bottom, top) = spec["xaxis"]["range"], spec["yaxis"]["range"]
            # the picture with a margin, y downwards
            assert -left == pytest.approx(right - 1280) and -top == pytest.approx(bottom - 720) and 0 < -left < 200


def test_intervals_and_colours_of_stills_are_as_long_as_they_say():
    dots = {"type": "scatter", "mode": "markers", "name": "n", "x": [2.0, 8.0], "y": [10.0, 40.0]}
    dots |= {"marker": {"color": "#123456", "size": 5}}
    dots |= {f"error_{k}": {"array": a, "color": c, "thickness": 1} for k, a, c in (
        ("x", [1.0, 0.5], "#aa0000"), ("y", [4.0, 8.0], "#00aa00")
    )}  # fmt: skip
    spec = figures.layout(300, figures.axis("x", range=[0, 10]), figures.axis("y", range=[0, 50]))
    still = Drawing(draw_still({"data": [dots], "layout": spec}, "x"))
    across, upwards = (np.array(still.lines(colour)) for colour in ("#aa0000", "#00aa00"))
    middles = across.mean(axis=1)
    assert upwards.mean(axis=1) == pytest.approx(middles, abs=0.2)
    unit = (middles[1] - middles[0]) / [6.0, 30.0]
    assert np.ptp(across[:, :, 0], axis=1) == pytest.approx(2 * unit[0] * np.array([1.0, 0.5]), abs=0.5)
    assert np.ptp(upwards[:, :, 1], axis=1) == pytest.approx(-2 * unit[1] * np.array([4.0, 8.0]), abs=0.5)
    heat = {"type": "heatmap", "x0": 0.5, "dx": 1.0, "y0": 0.5, "dy": 1.0, "z": [[0, 6]]}
    heat |= {"colorscale": [[0, "#000000"], [1, "#ff0000"]], "colorbar": {"title": {"text": "n"}}}
    still = Drawing(
        draw_still({"data": [heat], "layout": figures.layout(200, figures.axis("x"), figures.axis("y"))}, "x")
    )
    bar = [{k: float(a[k]) for k in ("x", "y", "width", "height")} for tag, a in still.shapes if tag == "rect"]
    ticks = {word: attrs for word, attrs in texts_of(still) if attrs["text-anchor"] == "start"}
    assert len(bar) == STYLE.colours and all(box["width"] == 12 for box in bar)
    assert bar[0]["x"] > STYLE.width - STYLE.right_axis + 5  # apart from the table
    # dark below, at zero; numbers to the right of the colours, a quarter of a line lower
    assert float(ticks["0"]["y"]) - 4 == pytest.approx(bar[0]["y"] + bar[0]["height"], abs=0.2)
    assert float(ticks["6"]["y"]) - 4 == pytest.approx(bar[-1]["y"], abs=0.2)
    assert all(float(tick["x"]) > bar[0]["x"] + 12 for tick in ticks.values())


def test_the_grid_under_a_scene_lies_at_whole_steps():
    lines = _grid(np.array([-0.3, 0.2, 1.0]), np.array([1.1, 0.9, 2.0]), 0.5)
    across = [line for line in lines if line[0, 0] == line[1, 0]]
    assert [line[0, 0] for line in across] == pytest.approx([0, 0.5, 1])
    assert all(line[:, 1].tolist() == [0.2, 0.9] for line in across)
    (along,) = [line for line in lines if line[0, 1] == line[1, 1]]
    assert along.tolist() == [[-0.3, 0.5, 1.0], [1.1, 0.5, 1.0]]


def test_accelerations_and_spectra_have_axes_on_which_their_curves_lie(subtests):
    for unit in ("m/s2", "units/s2"):
        with subtests.test(unit=unit):
            curves = {side: [{"t_s": [0.0, 1.0], "values": [a, -b]} for a, b in sizes] for side, sizes in (
                ("accelerometer", ((1.0, 0.5), (9.0, 12.0), (0.1, 0.2))),
                ("camera", ((30.0, 20.0), (0.0, 0.0), (2.0, 5.0))),
            )}  # fmt: skip
            figure = figures.accelerations({"camera_unit": unit, **curves})
            spec, metric = figure["layout"], unit == "m/s2"
            domains = [spec[f"yaxis{key}"]["domain"] for key in ("", 2, 3)]
            assert domains[0][1] == 1 and domains[2][0] == pytest.approx(0) and domains[1][0] - domains[2][1] > 0.01
            assert [high - low for low, high in domains] == pytest.approx([0.3] * 3)
            assert ("yaxis4" in spec) is not metric
            if not metric:
                for trace in figure["data"]:
                    low, high = spec[f"yaxis{trace['yaxis'][1:]}"]["range"]
                    # zero in the middle, and the curve next to it
                    assert low == -high < min(trace["y"]) and max(trace["y"]) < high
                    assert high < 2 * max(map(abs, trace["y"])) or high < 1.2 * max(1.0, SIZES.hand_m_s2)
            spectrum = {"camera_unit": unit, "curves": {
                "imu": {"hz": [1.0, 20.0], "density": [1e-3, 0.5]}, "camera": {"hz": [1.0, 8.0], "density": [2.0, 9.0]}
            }}  # fmt: skip
            spec = figures.spectra(spectrum, unit="mm/s²", factor=1000.0)["layout"]
            # over more than two decades, at tens alone
            assert spec["yaxis"]["dtick"] == 1 and spec["xaxis"]["dtick"] == "D2"
            assert ("yaxis2" in spec) is not metric and spec.get("yaxis2", {"dtick": "D2"})["dtick"] == "D2"
            imu, camera = figures.spectra(spectrum, unit="mm/s²", factor=1000.0)["data"]
            assert imu["y"] == [1.0, 500.0] and camera["y"] == ([2000.0, 9000.0] if metric else [2.0, 9.0])


def test_the_picture_of_a_model_shows_near_over_far_and_up_upwards(full):
    points = {"x": [0.0, 0.0, 5.0], "y": [-1.0, 1.0, 5.0], "z": [0.0, 0.0, 5.0]}
    cloud = {"type": "scatter3d", "mode": "markers", "name": "points", **points}
    cloud["marker"] = {"color": ["#ff0000", "#0000ff", "#00ff00"], "size": 1}
    ends = {"x": [0.0, 0.0], "y": [0.0, 0.0], "z": [-1.0, 2.0]}
    line = {
        "type": "scatter3d",
        "mode": "lines",
        "name": "camera path",
        **ends,
        "line": {"color": "#abcdef", "width": 4},
    }
    grid = {**line, "name": "grid of 1 m"}
    level = StillView(
        azimuth_deg=-90.0, elevation_deg=0.0, distance=None
    )  # the eye is at -y: the red point hides the blue one
    still = Drawing(draw_scene_still({"data": [cloud, line, grid], "layout": {}}, "model", level))
    ((low, high),) = still.lines("#abcdef")
    assert low[0] == pytest.approx(high[0]) and high[1] < low[1] - 50
    (address,) = [attrs["href"] for tag, attrs in still.shapes if tag == "image"]
    image = cv2.imdecode(np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8), cv2.IMREAD_UNCHANGED)
    seen = {tuple(colour) for colour in image[image[:, :, 3] > 0].tolist()}
    assert seen == {(0, 0, 255, 255), (0, 255, 0, 255)}


def test_figures_are_what_plotly_takes(full_report):
    _, page = full_report
    for figure in page.figures().values():
        graph_objects.Figure(figure)  # raises on any name or value that plotly does not know


def test_notes_stand_apart_from_reasons_and_earlier_results_have_none(refused, tmp_path):
    out = copy_of(refused, tmp_path)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    (model,) = result["models"]
    write_json(out / "result.json", {**result, "models": [{**model, "notes": ["poses jump, which hardly counts"]}]})
    _, page = report_of(out)
    assert page.text.index("Reasons") < page.text.index("Notes") < page.text.index("oses jump, which hardly counts")
    del model["notes"]
    write_json(out / "result.json", result)
    content, page = report_of(out)
    assert content["models"][0]["notes"] == [] and "Notes" not in page.text


def test_a_refused_scale_has_no_number_and_says_what_to_do(refused):
    out, result = refused
    content, page = report_of(out)
    (model,) = content["models"]
    assert content["outcome"]["verdict"] == result["models"][0]["verdict"] == "refused"
    assert model["metres_per_unit"] is None and model["half_width_pct"] is None
    assert "What was tried" in page.text and "What to record or correct" in page.text
    assert "Film again" in page.text
    assert "their rates differ by" in page.text.partition("What was tried")[2]
    assert "How the scale was found" not in page.text and "how the scale was found" not in page.text
    assert model["reasons"][0] in page.text.replace("The scale", "the scale", 1) or model["reasons"][0][1:] in page.text
    assert model["signals"]["acceleration"]["camera_unit"] == "units/s2"
    assert "missing" in model["drift"] and "missing" in model["validation"]
    assert {"drift", "target"}.isdisjoint(page.anchors())
    assert {"scene", "rotation", "acceleration"} <= set(page.anchors())
    assert "scale bar" not in json.dumps(page.figures())
    assert model["drift"]["missing"] in page.text


def test_the_first_screen_says_how_large_how_sure_where_and_what_next(full, tmp_path):
    out = copy_of(full, tmp_path)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    stored = json.loads((out / "report_data" / "model_0.json").read_text(encoding="utf-8"))
    stored["photogrammetry"]["extent"] = [12.34, 0.456, 3.0]
    write_json(out / "report_data" / "model_0.json", stored)
    model = result["models"][0]
    model |= {"metres_per_unit": 0.2275, "ci95": [0.2251, 0.23], "georeference": None}
    model["dense"] = {"fused": "dense/0/fused.ply", "mesh": None}
    first, _, rest = report_of_changed(out, result)[1].text.partition("Check of the recording")
    assert "CloudCompare or MeshLab" in first and "with --dense" not in first and "the dense point cloud" in rest
    # half of 0.2251 to 0.2300 over 0.2275 is 1.0769 %
    for said in ("12.3 m × 45.6 cm, 3 m high", "12.3 m are known to ±13 cm, lengths of 10 m to ±11 cm (±1.1 %, 95 %)"):
        assert said in first
    assert "−0.31 % off, within the tolerance of 2 %" in first and "no positions (GPS) were used" in first
    assert "Next steps" in first and "colmap-inertial view ." in first
    assert "of COLMAP's own model" not in first  # the unit scale is of no use for the metric model
    model["georeference"] = {
        "origin": {"latitude_deg": 47.3769, "longitude_deg": 8.5417},
        "positions": {"used": 9, "left_out": 0, "source": "GPS"},
        "heading_ci95_deg": 2.5, "position_ci95_m": 3.25, "notes": [],
    }  # fmt: skip
    model["validation"] |= {"scale_error_pct": 3.5, "within_tolerance": False}
    text = report_of_changed(out, result)[1].text
    assert "47.376900, 8.541700°, ±3.2 m, heading ±2.5°" in text.partition("Check of the recording")[0]
    assert "not until this is resolved" in text and "+3.50 % off, outside the tolerance" in text
    model["validation"] |= {"scale_error_pct": 0.5}
    assert "+0.50 % off, not proved to be within the tolerance of 2 %" in report_of_changed(out, result)[1].text
    assert "between 0.2251 and 0.2300 m" in text
    assert "rms, in which large residuals weigh more than in their mean, 0.40 px" in text


def test_a_refused_report_does_not_say_that_nothing_was_wrong(refused, tmp_path):
    out = copy_of(refused, tmp_path)
    write_json(out / "diagnosis.json", {"version": 1, "worst": "info", "checked": ["gyroscope"], "findings": []})
    text = report_of(out)[1].text
    assert "Nothing was found wrong" not in text and "Nothing was found beforehand that explains this outcome" in text


@pytest.mark.parametrize(
    ("gone", "anchor", "said"),
    [
        ("diagnosis.json", "findings", "was not checked before the reconstruction"),
        ("report_data/model_0.json", "scene", "were not kept"),
        ("report_data/recording.json", "shutter", "No rolling shutter was corrected"),
    ],
)
def test_a_section_without_data_is_left_out_with_the_reason(full, tmp_path, gone, anchor, said):
    out = copy_of(full, tmp_path)
    (out / gone).unlink()
    _, page = report_of(out)
    assert anchor not in page.anchors()
    assert said in page.text


def test_without_exposure_times_there_is_no_blur(full, tmp_path):
    out = copy_of(full, tmp_path)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    result["imaging"]["deblur"] = "frames are not deblurred: the exposure time is unknown"
    for frame in result["frames"]:
        frame["blur_px"] = None
    content, page = report_of_changed(out, result)
    assert "exposure time is unknown" in content["blur"]["missing"]
    assert "blur" not in page.anchors()
    assert "the exposure time is unknown" in page.text


def report_of_changed(out, result):
    (out / "result.json").write_text(json.dumps(result), encoding="utf-8")
    return report_of(out)


def test_a_target_that_could_not_be_measured_is_said(full, tmp_path):
    out = copy_of(full, tmp_path)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    result["models"][0]["validation"] = {"error": "the board was found in 1 image"}
    _, page = report_of_changed(out, result)
    assert "target" not in page.anchors()
    assert "the board was found in 1 image" in page.text


def test_of_several_models_the_largest_with_a_scale_comes_first(full, tmp_path):
    out = copy_of(full, tmp_path)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    one = result["models"][0]
    refused = {**one, "index": 1, "registered_images": 10**6, "verdict": "refused", "validation": None}
    refused |= {"metres_per_unit": None, "ci95": None, "sigma_log": None}
    smaller = {**one, "index": 2, "registered_images": 5, "validation": None}
    result["models"] = [refused, smaller, one]
    content, page = report_of_changed(out, result)
    assert [model["index"] for model in content["models"]] == [0, 2, 1]
    assert content["outcome"]["verdict"] == "trusted"
    assert {"scene-0", "model-1", "model-2"} <= set(page.anchors())
    assert len(page.anchors()) == len(set(page.anchors()))


def test_a_weak_scale_is_told_from_a_trusted_one():
    model = {"verdict": "weak", "metres_per_unit": 2.0, "ci95": [1.8, 2.2], "reasons": ["x"], "validation": None}
    weak = outcome_of_model(model)
    assert weak["headline"] != outcome_of_model({**model, "verdict": "trusted"})["headline"]
    assert weak["todo"]
    assert "+-10 %" in weak["summary"][0] and "between 1.800 and 2.200 m" in weak["summary"][0]
    assert dict(weak["answers"])["How sure"] == "lengths of 10 m to +-1 m (+-10 %, 95 %)"
    assert weak["todo"][0].startswith("Film again")
    narrow = outcome_of_model({**model, "ci95": [1.99, 2.01]})
    assert not any("Film again" in text for text in narrow["todo"])
    assert "reasons" in narrow["todo"][0]


def test_parts_of_the_recording_are_judged_as_the_estimator_judges_them(full, tmp_path):
    out = copy_of(full, tmp_path)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    drift = result["models"][0]["drift"]
    drift |= {"p_value": 5e-3, "trend_log_per_s": 0.0, "trend_sigma_log_per_s": 1e-3}
    assert "They agree within their uncertainty" in report_of_changed(out, result)[1].text
    drift["trend_log_per_s"] = 4e-3  # steady: the estimator reports it whatever the parts scatter by
    text = report_of_changed(out, result)[1].text
    assert "They differ by more than chance" in text and "+24.00 ±12 % a minute" in text
    drift |= {"p_value": 1e-5, "trend_log_per_s": 0.0}
    assert "They differ by more than chance" in report_of_changed(out, result)[1].text
    drift |= {"p_value": 0.5}
    for part in drift["parts"][1:]:
        part["sigma_log"] = 1e4
    content, page = report_of_changed(out, result)
    assert "too uncertain to tell" in page.text
    assert f"{len(drift['parts']) - 1} of {len(drift['parts'])} parts do not determine a scale" in page.text
    figure = figures.drift(content["models"][0])
    assert len(figure["data"][0]["x"]) == 1
    part = drift["parts"][0]
    first_frame_s = content["models"][0]["signals"]["first_frame_s"]
    assert figure["data"][0]["x"][0] == pytest.approx(0.5 * (part["begin_s"] + part["end_s"]) - first_frame_s)
    drift["parts"][0]["sigma_log"] = 1e4
    content, page = report_of_changed(out, result)
    assert "too uncertain to tell" in page.text and "drift" in page.anchors()


def test_used_frames_of_a_video_are_told(full, tmp_path):
    out = copy_of(full, tmp_path)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    result["selection"] = {"frames": 900, "used": 120, "note": "the sharpest of each window", "left_out": []}
    content, page = report_of_changed(out, result)
    assert content["selection"] == {"frames": 900, "used": 120, "note": "the sharpest of each window"}
    assert "120 of 900: the sharpest of each window" in page.text


def test_frames_are_listed_with_what_was_done_to_them(full, tmp_path):
    out = copy_of(full, tmp_path)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    content, _ = report_of_changed(out, result)
    rows, blur_px = content["frame_table"]["rows"], {f["name"]: f["blur_px"] for f in result["frames"]}
    assert content["frame_table"]["count"] == len(blur_px) > len(rows) > 0
    assert all(blur_px[row["name"]] == row["blur_px"] for row in rows)
    # the most blurred first, and none that is more blurred left out
    known = sorted((blur or 0.0 for blur in blur_px.values()), reverse=True)
    assert [row["blur_px"] or 0.0 for row in rows] == known[: len(rows)]


def test_why_there_is_no_target_and_there_are_no_crops(full, tmp_path):
    out = copy_of(full, tmp_path)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    (out / "report_data" / "crops" / "crops.json").unlink()
    result["models"][0]["validation"] = None
    content, _ = report_of_changed(out, result)
    assert "names no target" in content["models"][0]["validation"]["missing"]
    assert "differs before and after" in content["crops"]["missing"]
    for frame in result["frames"]:
        frame |= {"action": "passed", "sharpened": False}
    del result["imaging"]
    content, _ = report_of_changed(out, {**result, "project": {"imu": "x"}})
    assert "are missing" in content["models"][0]["validation"]["missing"]
    assert "No frame was deblurred" in content["crops"]["missing"]


def test_a_folder_of_an_earlier_layout_still_has_its_report(full, tmp_path):
    out = copy_of(full, tmp_path)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    result["models"][0] |= {"sparse": "sparse/0", "sparse_metric": "sparse_metric/0"}
    content, page = report_of_changed(out, {**result, "project_metric": "project_metric"})
    assert content["models"][0]["sparse_metric"] == "sparse_metric/0"
    assert re.search(r"project_metric\s*the whole project in metres", page.text)
    _, page = report_of_changed(out, {**result, "project_metric": "."})
    assert re.search(r"this folder\s*the whole project in metres", page.text)


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(FormatError, match="no such file"):
        write_report(tmp_path)


# What must not happen


def test_names_from_users_are_text_and_nothing_else(tmp_path):
    out = tmp_path / "out"
    write_run(out, name=HOSTILE)
    _, page = report_of(out)
    assert [attrs.get("id") for tag, attrs in page.tags if tag == "script"] == ["library", "figures", None]
    assert all(attrs["src"].startswith("data:image/jpeg;base64,") for tag, attrs in page.tags if tag == "img")
    assert not [name for _, attrs in page.tags for name in attrs if name.startswith("on")]
    assert page.text.count(HOSTILE.replace("  ", " ")) > 8
    for figure in page.figures().values():
        assert "<script" not in json.dumps(figure)
        assert "<img" not in json.dumps(figure)


def test_the_page_names_no_place_to_load_from(full_report):
    _, page = full_report
    for tag, attrs in page.tags:
        for name in ("src", "href", "srcset", "action", "data", "poster"):
            target = attrs.get(name)
            assert target is None or target.startswith(("data:", "#")), (tag, target)
    policy = next(attrs["content"] for tag, attrs in page.tags if attrs.get("http-equiv"))
    assert policy.startswith("default-src 'none'")


def test_the_same_run_gives_the_same_bytes(full, tmp_path):
    out = copy_of(full, tmp_path)
    first = [write_report(out).read_bytes(), (out / "report.json").read_bytes()]
    other = tmp_path / "elsewhere"
    shutil.copytree(out, other)
    second = [write_report(other).read_bytes(), (other / "report.json").read_bytes()]
    assert first == second


def test_links_in_what_the_report_is_made_of_are_refused(subtests, full, tmp_path_factory):
    for name in ("result.json", "config.toml", "report_data", "report_data/recording.json", "validation/0"):
        with subtests.test(name=name):
            tmp_path = tmp_path_factory.mktemp("given")
            out = copy_of(full, tmp_path)
            for report in ("report.html", "report.json"):
                (out / report).unlink(missing_ok=True)
            place, elsewhere = out / name, tmp_path / "elsewhere"
            if place.exists():
                shutil.move(place, elsewhere)
            place.parent.mkdir(exist_ok=True)
            place.symlink_to(elsewhere)
            with pytest.raises(
                FormatError, match=r"is a link to .*elsewhere; links in an output folder are not followed"
            ):
                write_report(out)
            assert not (out / "report.html").exists() and not (out / "report.json").exists()


def test_a_long_recording_with_several_models_stays_below_five_megabytes(tmp_path):
    out = tmp_path / "out"
    result = write_run(out, duration_s=60.0, points=30000, models=3)
    assert len(result["frames"]) == 1800
    content, page = report_of(out)
    assert (out / "report.html").stat().st_size < 5e6
    for model in content["models"]:
        for line in model["signals"]["rotation"]["after"]["camera"]:
            assert len(line["t_s"]) <= SIZES.line_points
        assert len(model["scene"]["points"]["rgb"]) <= 12000
    assert len(page.anchors()) > 20


# What is drawn


def test_thinning_keeps_the_extremes_the_order_and_the_gaps():
    t_s = np.linspace(0, 100, 20001)
    values = np.sin(t_s)
    values[7777], values[15000] = 9.0, -9.0
    values[4000:6000] = np.nan
    line = thin_line(t_s, values)
    assert len(line["t_s"]) == len(line["values"]) <= SIZES.line_points
    assert line["t_s"] == sorted(line["t_s"])
    known = [value for value in line["values"] if value is not None]
    assert max(known) == 9.0 and min(known) == -9.0
    assert None in line["values"]
    assert not [t for t, v in zip(line["t_s"], line["values"], strict=True) if v is not None and 20.1 < t < 29.9]
    short = thin_line(t_s[:50], values[:50])
    assert len(short["t_s"]) == 50


def test_numbers_are_short_and_right():
    values = np.array([123456.789, -0.000123456, 0.0, np.nan, np.inf, 1e-300])
    assert round_values(values, 4) == [123500.0, -0.0001235, 0.0, None, None, 1e-300]
    assert stride_indices(5, 10).tolist() == [0, 1, 2, 3, 4]
    assert stride_indices(1000, 3).tolist() == [0, 500, 999]


def steady_turn(rate_rad_s, *, offset_s=0.0):
    """A camera that turns steadily about an axis of its own and flies along a sine, and what an IMU feels of it."""
    from colmap_inertial.io.calibration import calibration_prior

    t_s = np.arange(0, 20, 1 / 30)
    axis = np.asarray(rate_rad_s)
    cam_from_world = quat_exp(-axis * t_s[:, None])
    amplitude, hz = 0.1, 1.0
    path = np.zeros((len(t_s), 3))
    path[:, 0] = amplitude * np.sin(2 * np.pi * hz * t_s)
    trajectory = CameraTrajectory(
        names=tuple(map(str, range(len(t_s)))),
        t_s=t_s,
        cam_from_world_xyzw=cam_from_world,
        cam_in_world=path,
        length_unit="m",
    )
    imu_s = np.arange(-1, 21, 1 / 200)
    accel = np.zeros((len(imu_s), 3))
    accel[:, 0] = -amplitude * (2 * np.pi * hz) ** 2 * np.sin(2 * np.pi * hz * imu_s)
    accel[:, 2] = 9.8
    imu = ImuRecording(
        gyro_t_s=imu_s - offset_s,
        gyro_rad_s=np.tile(axis, (len(imu_s), 1)),
        accel_t_s=imu_s - offset_s,
        accel_m_s2=quat_rotate(quat_exp(-axis * imu_s[:, None]), accel),
    )
    calibration = dataclasses.replace(
        calibration_prior(),
        cam_from_imu_xyzw=np.array([0.0, 0, 0, 1]),
        gyro_time_offset_s=offset_s,
        accel_time_offset_s=offset_s,
        imu_in_cam_m=np.zeros(3),
    )
    estimate = ScaleEstimate(
        metres_per_unit=1.0,
        sigma_log=0.01,
        ci95=(0.98, 1.02),
        verdict="trusted",
        method="joint",
        calibration=calibration,
        gravity_in_world_m_s2=np.array([0, 0, -9.8]),
        accel_bias_m_s2=np.zeros(3),
    )
    return trajectory, imu, estimate


def test_rotation_and_acceleration_are_the_true_ones():
    rate = np.array([0.2, -0.3, 0.5])
    trajectory, imu, estimate = steady_turn(rate, offset_s=100.0)
    record = signal_record(trajectory, imu, estimate, estimate.gravity_in_world_m_s2)
    assert not record["rotation"]["same_clock_origin"]
    for side in ("camera", "gyroscope"):
        for line, true in zip(record["rotation"]["after"][side], rate, strict=True):
            assert line["values"] == pytest.approx([true] * len(line["values"]), abs=1e-4)
    acceleration = record["acceleration"]
    assert acceleration["correlation"] > 0.999
    # a second difference over h to both sides passes sinc(f h) squared of a sine
    reach_s = 0.5 * acceleration["averaged_over_s"]
    passed = np.sinc(reach_s) ** 2
    true = passed * 0.1 * (2 * np.pi) ** 2
    for side in ("camera", "accelerometer"):
        peaks = [max(abs(v) for v in line["values"] if v is not None) for line in acceleration[side]]
        assert peaks[2] < 0.02
        assert np.hypot(peaks[0], peaks[1]) == pytest.approx(true, rel=0.02)
    assert record["acceleration"]["rms_camera"] == pytest.approx(true / np.sqrt(2), rel=0.02)


def test_the_spectrum_of_a_sine_has_its_power_at_its_frequency():
    trajectory, imu, estimate = steady_turn(np.array([0.1, 0.0, 0.0]))
    record = signal_record(trajectory, imu, estimate, estimate.gravity_in_world_m_s2)
    curve = record["acceleration_spectrum"]["curves"]["imu"]
    hz, density = np.array(curve["hz"]), np.array(curve["density"])
    assert hz[np.argmax(density)] == pytest.approx(1.0, abs=0.13)
    near = np.abs(hz - 1.0) < 0.4
    power = np.sum(density[near] ** 2) * np.median(np.diff(hz[near]))
    assert power == pytest.approx((0.1 * (2 * np.pi) ** 2) ** 2 / 2, rel=0.1)


def test_spectra_are_those_of_scipy():
    from scipy.signal import welch

    values = np.random.default_rng(1).normal(0, 1, (3, 5000))
    for count in (100, 801):
        hz, power = signals._welch(values, 0.01, count)
        expected_hz, expected = welch(values, fs=100, nperseg=count)
        np.testing.assert_allclose(hz, expected_hz)
        inner = slice(1, -1)  # scipy counts both ends once
        np.testing.assert_allclose(power[:, inner], expected[:, inner], rtol=1e-9)


def test_a_wrong_scale_would_be_seen():
    trajectory, imu, estimate, gravity, _ = recorded()
    right = signal_record(trajectory, imu, estimate, gravity)["acceleration"]
    twice = dataclasses.replace(trajectory, cam_in_world=2 * trajectory.cam_in_world)
    wrong = signal_record(twice, imu, estimate, gravity)["acceleration"]
    assert right["correlation"] > 0.97
    assert right["rms_camera"] == pytest.approx(right["rms_accelerometer_m_s2"], rel=0.1)
    assert wrong["rms_camera"] == pytest.approx(2 * right["rms_accelerometer_m_s2"], rel=0.1)


def test_without_an_alignment_only_the_speed_of_turning_is_compared():
    trajectory, imu, _, _, _ = recorded()
    refused = ScaleEstimate(
        metres_per_unit=None, sigma_log=None, ci95=None, verdict="refused", method="joint", reasons=("no offset fits",)
    )
    trajectory = dataclasses.replace(trajectory, length_unit="model")
    record = signal_record(trajectory, imu, refused, None)
    assert record["rotation"]["after"] is None
    assert record["rotation"]["before"]["camera_size"]["values"]
    assert "missing" in record["acceleration"]


def test_a_recording_that_cannot_be_used_is_not_said_to_disagree_with_the_pictures(subtests, full, tmp_path_factory):
    for spoilt, said in (
        ({"accel_t_s": np.zeros(0), "accel_m_s2": np.zeros((0, 3))}, "no accelerometer"),
        ({"accel_in_g": True}, "it is in g"),
    ):
        with subtests.test(spoilt=spoilt, said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            trajectory, imu, _, _, _ = recorded()
            imu = dataclasses.replace(
                imu, **({"accel_m_s2": imu.accel_m_s2 / 9.80665} if "accel_in_g" in spoilt else spoilt)
            )
            estimate = estimate_scale(trajectory, imu)
            assert estimate.verdict == "refused"
            record = signal_record(trajectory, imu, estimate, None)
            assert record["alignment"] == "not tried"
            assert said in record["acceleration"]["missing"]
            out = copy_of(full, tmp_path)
            stored = json.loads((out / "report_data" / "model_0.json").read_text(encoding="utf-8"))
            write_json(out / "report_data" / "model_0.json", {**stored, "signals": record})
            result = json.loads((out / "result.json").read_text(encoding="utf-8"))
            result["models"][0] |= {**estimate.as_json(), "excitation_m_s2": 0.5, "validation": None}
            _, page = report_of_changed(out, result)
            assert "could not be aligned" not in page.text
            assert "cannot be used as it is" in page.text
            assert "camera acceleration" not in page.text  # which would be of the scale that was refused
            assert "COLMAP's own model (colmap/sparse/0) is complete" in page.text


@pytest.mark.skipif(not hasattr(pycolmap.CameraModelId, "EQUIRECTANGULAR"), reason="pycolmap has no such camera yet")
def test_a_camera_that_sees_all_around_has_a_place_too():
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 640, 320)
    assert camera.mean_focal_length() == 0
    reconstruction.add_camera_with_trivial_rig(camera)
    for i in range(3):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([float(i), 0, 0]))
        image = pycolmap.Image(name=f"{i}.jpg", camera_id=1, image_id=i + 1)
        reconstruction.add_image_with_trivial_frame(image, pose)
    timing = FrameTiming(names=("0.jpg", "1.jpg", "2.jpg"), t_s=np.arange(3.0) + 7)
    trajectory, _ = trajectory_from_model(reconstruction, timing)
    scene = scene_record(reconstruction, trajectory, None, first_frame_s=6.5)
    assert (scene["cameras"]["half_width"], scene["cameras"]["half_height"]) == (0.5, 0.25)
    assert scene["path"]["t_s"] == [0.5, 1.5, 2.5]
    scene_figure(scene)


def test_times_count_from_the_recording_s_first_frame():
    trajectory, imu, estimate, gravity, _ = recorded()
    late = signal_record(trajectory, imu, estimate, gravity, first_frame_s=float(trajectory.t_s[0]) - 5)
    usual = signal_record(trajectory, imu, estimate, gravity)
    for key in ("rotation", "acceleration"):
        lines = [record[key]["camera" if key == "acceleration" else "after"] for record in (late, usual)]
        a, b = (line[0] if key == "acceleration" else line["camera"][0] for line in lines)
        np.testing.assert_allclose(np.array(a["t_s"]) - b["t_s"], 5, atol=2e-4)


def test_the_scene_is_upright_and_holds_the_model():
    reconstruction = cloud()
    timing = FrameTiming(names=tuple(sorted(i.name for i in reconstruction.images.values())), t_s=np.arange(4.0))
    trajectory, _ = trajectory_from_model(reconstruction, timing)
    gravity = np.array([3.0, -5.0, 7.0])
    scene = scene_record(reconstruction, dataclasses.replace(trajectory, length_unit="m"), gravity)
    turn = np.array(scene["display_from_model_xyzw"])
    np.testing.assert_allclose(quat_rotate(turn, gravity / np.linalg.norm(gravity)), [0, 0, -1], atol=1e-8)
    centres = np.array(scene["path"]["xyz"]).T
    np.testing.assert_allclose(centres, quat_rotate(turn, trajectory.cam_in_world), atol=1e-3)
    points = np.array([point.xyz for point in reconstruction.points3D.values()])
    assert len(scene["points"]["rgb"]) > 0.9 * len(points)
    first = quat_rotate(turn, points)
    shown = np.array(scene["points"]["xyz"]).T
    assert max(np.linalg.norm(first - point, axis=1).min() for point in shown[:20]) < 2e-3
    figure = scene_figure(scene)
    names = [trace.get("name", "") for trace in figure["data"]]
    assert any("scale bar" in name for name in names)
    assert "gravity" in names


def test_grid_cells_are_round_lengths():
    assert [nice_length(v) for v in (0.011, 0.3, 1.0, 1.2, 47.0)] == [0.02, 0.5, 1.0, 2.0, 50.0]


# The pipeline


def test_reconstruct_writes_it_and_a_continued_run_does_too(tmp_path):
    capture = copy_scene(tmp_path / "capture", first=12)
    out = tmp_path / "out"
    result = reconstruct(capture, out, DETERMINISTIC)
    content, page = json.loads((out / "report.json").read_text()), Page(out / "report.html")
    written = json.loads((out / "result.json").read_text())
    assert content["models"][0]["metres_per_unit"] == written["models"][0]["metres_per_unit"]
    assert content["outcome"]["verdict"] == result.models[0].scale.verdict
    assert content["findings"]["checked"]
    assert content["recording"]["frames"]["count"] == 12
    assert content["models"][0]["scene"]["unit"] == ("m" if result.models[0].sparse_metric else "model")
    assert {"scene", "rotation", "acceleration"} <= set(page.anchors())
    assert result.workspace.report == out / "report.html"

    (out / "result.json").unlink()
    (out / "report.html").unlink()
    shutil.rmtree(out / "sparse", ignore_errors=True)
    reconstruct(capture, out, DETERMINISTIC)
    assert Page(out / "report.html").anchors() == page.anchors()

    again = write_report(out)  # from the folder alone
    assert Page(again).anchors() == page.anchors()


def test_a_run_that_stops_says_why(tmp_path):
    capture = copy_scene(tmp_path / "capture", first=4)
    for path in (capture / "frames").iterdir():
        cv2.imwrite(str(path), np.full((240, 320, 3), 120, np.uint8))
    with pytest.raises(MappingError) as stopped:
        reconstruct(capture, tmp_path / "out", ReconstructOptions(deblur="off", rolling_shutter="off"))
    content, page = json.loads((tmp_path / "out" / "report.json").read_text()), Page(tmp_path / "out" / "report.html")
    assert content["outcome"]["verdict"] == "stopped"
    assert str(stopped.value)[:40] in page.text
    assert content["title"] == "capture"
    assert page.anchors()[:2] == ["outcome", "findings"]


def broken(*_, **__):
    raise ZeroDivisionError("a report that nobody has seen before")


def test_a_report_that_fails_costs_no_result_and_is_told(project, tmp_path, monkeypatch, report_failures, capsys):
    source = ProjectOptions(imu=project.imu, frame_times=project.frame_times)
    for place in ("report.run_page.run_page", "run.commands.reporting.scene_record"):
        monkeypatch.setattr(f"colmap_inertial.{place}", broken)
    out = tmp_path / "out"
    arguments = ["--imu", str(project.imu), "--frame-times", str(project.frame_times)]
    with pytest.raises(SystemExit) as ended:
        main(["reconstruct", str(project.model.parents[1]), str(out), *arguments])
    assert ended.value.code == 0
    assert json.loads((out / "result.json").read_text())["models"][0]["metres_per_unit"] > 0
    assert not (out / "report.html").exists() and not (out / "report.json").exists()
    assert "failed, see" in capsys.readouterr().out
    text = (out / "log.txt").read_text()
    assert "ERROR what the report draws of model 0 failed" in text
    assert "ERROR the report failed" in text and "ZeroDivisionError" in text
    assert len(report_failures) == 2
    report_failures.clear()
    assert reconstruct_project(project.model.parents[1], tmp_path / "other", source).report is None
    report_failures.clear()


def test_a_failing_report_of_a_stop_hides_no_reason(tmp_path, monkeypatch, report_failures):
    workspace, capture = Workspace(tmp_path), Capture(path=tmp_path, calibration=calibration_prior())
    session = Session(workspace=workspace, runner=StepRunner(workspace), context=RunContext(scratch=workspace.stamps))
    with pytest.raises(MappingError, match="nothing matches") as stopped, reporting_stops(session, capture):
        raise MappingError(Fact.stated("nothing matches"))
    assert stopped.value.__notes__ == [f"findings and remedies: {tmp_path / 'report.html'}"]
    monkeypatch.setattr("colmap_inertial.run.commands.reporting.write_report", broken)
    with pytest.raises(MappingError, match="nothing matches"), reporting_stops(session, capture):
        raise MappingError(Fact.stated("nothing matches"))
    assert len(report_failures) == 1
    report_failures.clear()


def test_the_rolling_shutter_is_that_of_the_stages_in_use(project, tmp_path):
    imu = project.recording.imu
    timing = FrameTiming(names=("0.jpg", "1.jpg", "2.jpg"), t_s=imu.gyro_t_s[0] + 1 + np.arange(3.0), readout_s=0.02)
    camera = CameraModel(model="PINHOLE", width=640, height=480, params=(500.0, 500.0, 320.0, 240.0))
    view = GyroView(imu=imu, timing=timing, calibration=calibration_prior(), camera=camera, source="capture")
    workspace = Workspace(tmp_path)
    session = Session(workspace=workspace, runner=StepRunner(workspace), context=RunContext(scratch=workspace.stamps))
    capture = Capture(path=tmp_path, calibration=calibration_prior(), camera=camera)
    recording = Recording.of(capture, imu, timing, capture.calibration)
    write_recording(session, recording, [RollingShutterStage(view=view)], timing.names)
    record = json.loads((tmp_path / "report_data" / "recording.json").read_text())
    assert record["rolling_shutter"]["worst"]["width"] == 640
    assert max(record["rolling_shutter"]["largest_px"]) > 0
    write_recording(session, recording)
    assert json.loads((tmp_path / "report_data" / "recording.json").read_text())["rolling_shutter"] is None


def test_a_part_that_tells_nothing_of_its_scale_can_be_written():
    two = {key: np.array([0.0, 1.0]) for key in ("begin_s", "end_s")}
    drift = ScaleDrift(
        **two, log_ratio=np.array([-1e5, 1e5]), sigma_log=np.array([1e5, 1e5]), chi2=0.0, dof=1, p_value=1.0,
        trend_log_per_s=0.0, trend_sigma_log_per_s=1e5,
    )  # fmt: skip
    written = drift.as_json(1.0)
    assert np.isfinite([part["metres_per_unit"] for part in written["parts"]]).all()
    model = {"metres_per_unit": 1.0, "half_width_pct": 1.0, "drift": written, "signals": {}}
    assert figures.drift(model)["data"][0]["x"] == []


def test_a_missing_plotly_is_told_before_the_work(project, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly", None)
    with pytest.raises(InertialError, match="plotly"):
        reconstruct(SCENE, tmp_path / "out")
    with pytest.raises(InertialError, match="plotly"):
        reconstruct_project(project.model.parents[1], tmp_path / "out", ProjectOptions(imu=project.imu))
    assert not (tmp_path / "out").exists()


def test_an_existing_project_gets_one_with_and_without_a_scale(project, tmp_path):
    source = ProjectOptions(imu=project.imu, frame_times=project.frame_times)
    result = reconstruct_project(project.model.parents[1], tmp_path / "out", source)
    content = json.loads((tmp_path / "out" / "report.json").read_text())
    assert content["models"][0]["metres_per_unit"] == result.models[0].scale.metres_per_unit
    assert content["models"][0]["signals"]["acceleration"]["correlation"] > 0.97
    assert content["findings"]["checked"] and "missing" in content["blur"]

    other = tmp_path / "still"
    shutil.copytree(project.imu, other)
    stamps = [line.split()[0] for line in (other / "gyroscope.txt").read_text().splitlines()]
    (other / "gyroscope.txt").write_text(
        "".join(
            f"{stamp} {np.sin(i) / 500:.6f} {np.cos(i) / 500:.6f} {i % 7 / 500:.6f}\n" for i, stamp in enumerate(stamps)
        )
    )
    refused = reconstruct_project(
        project.model.parents[1],
        tmp_path / "none",
        ProjectOptions(imu=other, frame_times=project.frame_times),
        ReconstructOptions(force=True),
    )
    content, page = json.loads((tmp_path / "none" / "report.json").read_text()), Page(tmp_path / "none" / "report.html")
    assert refused.models[0].scale.verdict == content["outcome"]["verdict"] == "refused"
    assert content["models"][0]["signals"]["rotation"]["after"] is None
    assert "could not be aligned" in page.text


def test_a_long_path_is_said_to_bend_and_a_refined_one_how_much_it_did():
    done = {"stage": "refine", "action": "refined", "values": {"drift": [{"percent": -0.31}, {"percent": 0.2}]}}
    left = {"stage": "refine", "action": "", "reason": "not refined: images hold its shape", "values": {}}
    for treatments, length, said in (
        ([], 12.0, []),
        (
            [],
            85.2,
            ["The camera path is 85 m long: --refine inertial fits it to the IMU, against bending and drift."],
        ),
        ([left], 12.0, []),
        ([left], 85.2, ["The camera path is 85 m long and was not refined: images hold its shape."]),
        ([done], 12.0, ["The refinement corrected drift of the path: parts of it were stretched by -0.31 to +0.20 %."]),
    ):
        model = {"treatments": treatments, "sparse_metric": "sparse/0", "scene": {"path_length": length}}
        assert _describe_path(model) == said


def test_drift_before_and_after_a_refinement_is_drawn_with_its_intervals(full, tmp_path):
    out = copy_of(full, tmp_path)
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    model = result["models"][0]
    assert "refined" not in report_of_changed(out, result)[1].anchors()
    drift = [
        {"begin_s": 3.0, "end_s": 13.0, "percent": -0.3, "sigma_percent": 0.1, "end_sigma_m": [0.01] * 3},
        {"begin_s": 13.0, "end_s": 23.0, "percent": 0.1, "sigma_percent": 0.2, "end_sigma_m": [0.01] * 3},
    ]
    done = {"stage": "refine", "reason": "refined", "action": "refined", "values": {"drift": drift}}
    model["treatments"] = [*model.get("treatments", []), done]
    _, page = report_of_changed(out, result)
    assert "refined" in page.anchors()
    assert "1 of 2 parts had drifted by more than chance" in page.text
    before, after = figures.refined({"signals": {"first_frame_s": 3.0}}, drift)["data"]
    assert before["x"] == after["x"] == [5.0, 15.0]
    # what was stretched was too small before
    assert before["y"] == pytest.approx([0.3009, -0.0999], abs=1e-4) and after["y"] == [0.0, 0.0]
    assert before["error_y"]["array"] == after["error_y"]["array"] == pytest.approx([0.196, 0.392], rel=1e-3)
    # one that was left as it was has nothing to draw
    done["action"] = ""
    assert "refined" not in report_of_changed(out, result)[1].anchors()
