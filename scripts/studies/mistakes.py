"""Mistakes of users: what is said, when, and whether following the advice gives a run.

    python -m scripts.studies.mistakes [--seed 0] [--kinds units axes ...] [--reconstruct] [--json mistakes.json]
    python -m scripts.studies.mistakes --declared 30

Each mistake changes a copy of ``example_scenes/desk`` by a seeded draw, and starts the command or the Python call that
a person would. It counts as caught where that ends before features are extracted, with an error of the right code, or
one that speaks of it. What has no code, as words on the command line and arguments in Python, must be told in words
that lead to the remedy. Then the advice is followed, with the numbers and settings that the error has. After that, the
check beforehand must find no error, and ``scale`` must find the metres of the true poses to 5 %; with
``--reconstruct``, the whole reconstruction must succeed. A call or command whose words were wrong is made again with
the right ones. Exit code 1 where any mistake is not caught or mended.

``--declared`` draws so many simulated recordings of 25 s instead, and declares values of their device wrongly: the
inverse rotation, another order or other axes, the time offset's other sign or unit, another lever arm, its inverse or
unit, the gains of another IMU; and of walks of 16 s with points, another focal length or readout. It counts as caught
where the check stops it by its code, or the scale is weak and names it first; as harmless where the interval holds the
truth, or the declared value was left out and said so.
Exit code 1 where any gives a trusted scale that is wrong, or more than one is called by another name.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from colmap_inertial.cli import main as run_command
from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import InertialError, fact_of
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_multiply, quat_normalize
from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import CameraTrajectory, ImuCalibration, ImuRecording, ScaleEstimate
from colmap_inertial.core.types.imu import IMU_CAL
from colmap_inertial.diagnose import Recorded, diagnose
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.io.calibration import Declared, calibration_prior
from colmap_inertial.io.imu import read_imu
from colmap_inertial.io.trajectories import read_tum
from colmap_inertial.model import Model
from colmap_inertial.run.stages.imaging_plan import GyroView
from colmap_inertial.run.stages.metric import MetricStage
from colmap_inertial.run.stages.readout import ReadoutStage
from colmap_inertial.run.stages.rolling_shutter import RollingShutterStage
from colmap_inertial.tools.simulate import IMU_PRESETS, MotionOptions, RecordingOptions, simulate_recording
from colmap_inertial.tools.simulate.tracks import TrackOptions, simulate_tracks
from scripts.common.bench_report import write_report

HERE = Path(__file__).resolve().parents[2]
DESK = HERE / "example_scenes" / "desk"
#: Metres per unit of the poses that ``scale`` is tried on.
TRUE_SCALE = 0.25
Change = Callable[[Path, np.random.Generator], None]
Call = Callable[[Path], object]
RECONSTRUCT = ("reconstruct", "{scene}", "{out}")
SCALE = ("scale", "{scene}/poses.txt", "--imu", "{scene}")


@dataclass(frozen=True, kw_only=True)
class Said:
    """What a command or call says.

    Attributes
    ----------
    text
        For a person.
    facts
        For a program: code and values of each fact, also of those that a fact speaks of.
    """

    text: str
    facts: tuple[dict[str, Any], ...] = ()

    @property
    def codes(self) -> list[str]:
        return [fact["code"] for fact in self.facts]

    def value(self, code: str, name: str) -> Any:
        """A value of the fact with this code; ``None`` where nothing is said of it."""
        return next((fact["values"].get(name) for fact in self.facts if fact["code"] == code), None)


Mend = Callable[[Path, Said], None]


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """A mistake in a copy of the scene, in the arguments of a command, or in a Python call.

    Attributes
    ----------
    kind, name
        What it is about, and what was done.
    codes
        One of which the error must have, or what it speaks of.
    says
        Where it has no code: pattern of what the message must hold, by which a person finds the remedy.
    make
        Changes the copy.
    mend
        Changes the copy as what was said, which it gets, advises.
    arguments, again
        Of the command, and as the advice has them; ``{scene}`` and ``{out}`` stand for the folders.
    call, call_again
        A Python call in place of the command, and as the advice has it.
    """

    kind: str
    name: str
    codes: tuple[str, ...] = ()
    says: str = ""
    make: Change = lambda scene, rng: None
    mend: Mend | None = None
    arguments: tuple[str, ...] = RECONSTRUCT
    again: tuple[str, ...] = ()
    call: Call | None = None
    call_again: Call | None = None


def text(file: str, old: str, new: str) -> Callable[[Path, object], None]:
    """Replace words of a file."""

    def change(scene: Path, _: object) -> None:
        path = scene / file
        before = path.read_text()
        assert old in before, (file, old)
        path.write_text(before.replace(old, new))

    return change


def toml(old: str, new: str) -> Callable[[Path, object], None]:
    """Replace words of capture.toml."""
    return text("capture.toml", old, new)


def rows(*files: str, change: Callable[[Array, np.random.Generator], Array]) -> Change:
    """Change the numbers of tables, with one draw for all of them."""

    def apply(scene: Path, rng: np.random.Generator) -> None:
        state = rng.bit_generator.state
        for file in files:
            rng.bit_generator.state = state
            path = scene / file
            header = path.read_text().splitlines()[0]
            table = change(np.loadtxt(path, delimiter=",", skiprows=1), rng)
            np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.12g")

    return apply


def values(*files: str, change: Callable[[Array, np.random.Generator], Array]) -> Change:
    """Change the readings, not the stamps."""
    return rows(*files, change=lambda table, rng: np.column_stack([table[:, 0], change(table[:, 1:], rng)]))


def stamps(*files: str, change: Callable[[Array, np.random.Generator], Array]) -> Change:
    """Change the stamps, not the readings."""
    return rows(*files, change=lambda table, rng: np.column_stack([change(table[:, 0], rng), table[:, 1:]]))


def frame_times(change: Callable[[float], float], header: str = "name,t_s") -> Callable[[Path, object], None]:
    """Change the times of the frames."""

    def apply(scene: Path, _: object) -> None:
        path = scene / "frames.csv"
        with path.open() as file:
            table = list(csv.reader(file))[1:]
        lines = [header, *(f"{name},{change(float(t_s)):.9f}" for name, t_s in table)]
        path.write_text("\n".join(lines) + "\n")

    return apply


def rename_frames(before: str, after: str) -> Callable[[Path, object], None]:
    """Let the names in frames.csv begin otherwise."""

    def change(scene: Path, _: object) -> None:
        path = scene / "frames.csv"
        header, *lines = path.read_text().splitlines()
        path.write_text("\n".join([header, *(after + line.removeprefix(before) for line in lines)]) + "\n")

    return change


def original(*files: str) -> Mend:
    """Give another file, where that is the advice."""

    def apply(scene: Path, _: object) -> None:
        for file in files:
            shutil.copy(DESK / file, scene / file)

    return apply


def set_axes(scene: Path, sensors: Sequence[str], axes: str, mirrored: bool) -> None:
    """Write axes under ``[imu.gyro]`` or ``[imu.accel]``."""
    lines = f'axes = "{axes}"\n' + ("mirrored = true\n" if mirrored else "")
    for sensor in sensors:
        toml(f"[imu.{sensor}]\n", f"[imu.{sensor}]\n{lines}")(scene, None)


def follow_axes(scene: Path, said: Said) -> None:
    """Write the axes of the gyroscope that an error has."""
    found = [setting for code in AXES if (setting := said.value(code, "gyro")) is not None]
    set_axes(scene, ["gyro"], *found[0])


def follow_gain(scene: Path, said: Said) -> None:
    """Divide the gyroscope's numbers by the gain that an error has."""
    gain = said.value("gyro-gain", "gain")
    toml('unit = "rad/s"', f'unit = "rad/s"\ncounts_per_unit = {gain:.2f}')(scene, None)


def follow_frame_rate(scene: Path, said: Said) -> None:
    """Time the frames by the rate that an error has."""
    rate = said.value("frame-rate", "rate")
    frame_times(lambda t_s: t_s / rate)(scene, None)


def follow_clock_rate(scene: Path, said: Said) -> None:
    """Correct the IMU's stamps by the rate that an error has."""
    rate = said.value("clock-rate", "rate")
    rng = np.random.default_rng(0)
    stamps("gyro.csv", "accel.csv", change=lambda t_s, _: t_s * (1 + rate))(scene, rng)


def leave_out_offsets(scene: Path, _: object) -> None:
    """Take what is said of clocks out of capture.toml."""
    path = scene / "capture.toml"
    path.write_text(re.sub(r"(shared_clock|gyro_time_offset_s|accel_time_offset_s) = .*\n", "", path.read_text()))


def misspell(file: str, *words: str) -> Change:
    """Lose a letter of one of some words, by a draw."""

    def change(scene: Path, rng: np.random.Generator) -> None:
        word = words[rng.integers(len(words))]
        at = int(rng.integers(1, len(word)))
        text(file, word, word[:at] + word[at + 1 :])(scene, None)

    return change


def restore_toml(scene: Path, _: object) -> None:
    """Write a name or path of capture.toml as the files have it."""
    shutil.copy(DESK / "capture.toml", scene / "capture.toml")


def read_desk(scene: Path) -> tuple[CameraTrajectory, ImuRecording]:
    return read_tum(scene / "poses.txt"), read_imu(scene)


def scale_of(change: Callable[[CameraTrajectory, ImuRecording], tuple[CameraTrajectory, ImuRecording]]) -> Call:
    """The scale of changed arrays; a refusal is an error, with its reasons."""

    def estimate(scene: Path) -> None:
        found = estimate_scale(*change(*read_desk(scene)))
        if found.verdict == "refused":
            raise InertialError(Fact("scale-refused", reasons=found.reasons))

    return estimate


def imu_with(change: Callable[[ImuRecording], dict[str, Array]]) -> Call:
    return scale_of(lambda poses, imu: (poses, replace(imu, **change(imu))))


def poses_with(change: Callable[[CameraTrajectory], dict[str, Array]]) -> Call:
    return scale_of(lambda poses, imu: (replace(poses, **change(poses)), imu))


def option(**values: object) -> Call:
    return lambda scene: ReconstructOptions(**values)  # type: ignore[arg-type]


def checkerboard(spec: str, code: str) -> Mistake:
    """A board in capture.toml that is none."""
    return Mistake(
        kind="boards",
        name=f"target {spec}",
        make=toml("checkerboard:8x6:0.04", spec),
        codes=(code,),
        mend=toml(spec, "checkerboard:8x6:0.04"),
    )


#: Of axes that are wrong.
AXES = ("axes-turned", "axes-mirrored", "gyro-mirrored")
GYRO_UNIT = 'columns = ["x", "y", "z"]\nunit = "rad/s"'
RIGHT_CALL = scale_of(lambda poses, imu: (poses, imu))
G = 9.80665


def units() -> Iterator[Mistake]:
    unit = partial(Mistake, kind="units")
    yield unit(
        name="gyroscope in deg/s, called rad/s",
        codes=("gyro-in-deg",),
        make=values("gyro.csv", change=lambda w, _: np.degrees(w)),
        mend=toml('unit = "rad/s"', 'unit = "deg/s"'),
    )
    yield unit(
        name="gyroscope in rad/s, called deg/s",
        codes=("gyro-not-in-deg",),
        make=toml('unit = "rad/s"', 'unit = "deg/s"'),
        mend=toml('unit = "deg/s"', 'unit = "rad/s"'),
    )
    yield unit(
        name="accelerometer in g, called m/s2",
        codes=("accel-in-g",),
        make=values("accel.csv", change=lambda a, _: a / G),
        mend=toml('unit = "m/s2"', 'unit = "g"'),
    )
    yield unit(
        name="accelerometer in m/s2, called g",
        codes=("accel-not-in-g",),
        make=toml('unit = "m/s2"', 'unit = "g"'),
        mend=toml('unit = "g"', 'unit = "m/s2"'),
    )
    yield unit(
        name="raw counts of the gyroscope",
        codes=("gyro-unit",),
        make=values("gyro.csv", change=lambda w, _: np.round(w * 939.65) + 12),
        mend=toml(GYRO_UNIT, f"{GYRO_UNIT}\nzero = 12\ncounts_per_unit = 939.65"),
    )
    yield unit(
        name="gyroscope with a wrong factor",
        codes=("gyro-gain",),
        make=values("gyro.csv", change=lambda w, rng: w * rng.uniform(1.28, 1.4)),
        mend=follow_gain,
    )
    yield unit(
        name="frame times in ms, called s",
        codes=("time-unit",),
        make=frame_times(lambda t_s: 1e3 * t_s),
        mend=frame_times(lambda t_ms: t_ms, "name,t_ms"),
    )
    yield unit(
        name="stamps of the IMU in ms, called s",
        codes=("time-unit",),
        make=stamps("gyro.csv", "accel.csv", change=lambda t_s, _: 1e3 * t_s),
        mend=toml('time_unit = "s"', 'time_unit = "ms"'),
    )


def axes() -> Iterator[Mistake]:
    axis = partial(Mistake, kind="axes", codes=AXES)
    yield axis(
        name="two axes of the gyroscope exchanged",
        make=values(
            "gyro.csv", change=lambda w, rng: np.roll(np.roll(w, k := rng.integers(3), 1)[:, [1, 0, 2]], -k, 1)
        ),
        mend=follow_axes,
    )
    yield axis(
        name="an axis of the gyroscope flipped",
        make=values("gyro.csv", change=lambda w, rng: w * np.roll([-1, 1, 1], rng.integers(3))),
        mend=follow_axes,
    )
    yield axis(
        name="both sensors left-handed",
        make=values("gyro.csv", "accel.csv", change=lambda w, _: w * [-1, 1, 1]),
        mend=lambda scene, _: set_axes(scene, ["gyro", "accel"], "-x,y,z", mirrored=True),
    )
    yield axis(
        name="gyroscope turned against the accelerometer",
        make=values("gyro.csv", change=lambda w, rng: np.roll(w, 1 + rng.integers(2), axis=1)),
        mend=follow_axes,
    )
    yield axis(
        name="gyroscope measures the opposite",
        make=values("gyro.csv", change=lambda w, _: -w),
        # both sensors mirrored look the same; the advice names this as the other way
        mend=lambda scene, _: set_axes(scene, ["gyro"], "-x,-y,-z", mirrored=True),
    )


def clocks() -> Iterator[Mistake]:
    clock = partial(Mistake, kind="clocks")
    yield clock(
        name="clocks 565 s apart, called shared",
        codes=("clock-offset",),
        make=toml("[timing]", "[timing]\nshared_clock = true"),
        mend=leave_out_offsets,
    )
    yield clock(
        name="times by another frame rate",
        codes=("frame-rate",),
        make=frame_times(lambda t_s: 1.25 * t_s),
        mend=follow_frame_rate,
    )
    yield clock(
        name="the clock of the IMU 3 % fast",
        codes=("clock-rate",),
        make=stamps("gyro.csv", "accel.csv", change=lambda t_s, _: 1.03 * t_s),
        mend=follow_clock_rate,
    )
    yield clock(
        name="IMU of another recording",
        codes=("imu-does-not-fit",),
        make=values("gyro.csv", "accel.csv", change=lambda w, _: w[::-1]),
        mend=original("gyro.csv", "accel.csv"),
    )
    yield clock(
        name="IMU stopped after a fifth",
        codes=("imu-too-short",),
        make=rows("gyro.csv", "accel.csv", change=lambda table, _: table[: len(table) // 5]),
        mend=original("gyro.csv", "accel.csv"),
    )
    yield clock(
        name="a time offset that is wrong",
        codes=("declared-offset",),
        make=toml("[target]", "[calibration]\ngyro_time_offset_s = 100.0\naccel_time_offset_s = 100.0\n\n[target]"),
        mend=leave_out_offsets,
    )


def columns() -> Iterator[Mistake]:
    column = partial(Mistake, kind="columns")
    yield column(
        name="a column that is not there",
        codes=("no-column",),
        make=toml(GYRO_UNIT, GYRO_UNIT.replace('"y"', '"gy"')),
        mend=toml('"gy"', '"y"'),
    )
    yield column(
        name="raw counts in columns named *_raw",
        codes=("gyro-unit",),
        make=lambda scene, rng: (
            values("gyro.csv", change=lambda w, _: np.round(w * 939.65) + 12)(scene, rng),
            text("gyro.csv", "t,x,y,z", "t,x_raw,y_raw,z_raw")(scene, rng),
            toml(GYRO_UNIT, GYRO_UNIT.replace('"x", "y", "z"', '"x_raw", "y_raw", "z_raw"'))(scene, rng),
        )[0],
        mend=toml('"z_raw"]\nunit = "rad/s"', '"z_raw"]\nunit = "rad/s"\nzero = 12\ncounts_per_unit = 939.65'),
    )
    yield column(
        name="a time column that is not there",
        codes=("no-column",),
        make=toml('file = "gyro.csv"\ntime = "t"', 'file = "gyro.csv"\ntime = "timestamp"'),
        mend=toml('time = "timestamp"', 'time = "t"'),
    )
    yield column(
        name="gyroscope and accelerometer exchanged",
        codes=("sensors-exchanged",),
        make=lambda scene, rng: (
            toml('"gyro.csv"', '"other"')(scene, rng),
            toml('"accel.csv"', '"gyro.csv"')(scene, rng),
            toml('"other"', '"accel.csv"')(scene, rng),
        )[0],
        mend=restore_toml,
    )
    yield column(
        name="a column given twice",
        codes=("columns-repeated",),
        make=toml(GYRO_UNIT, GYRO_UNIT.replace('"y"', '"x"')),
        mend=restore_toml,
    )
    yield column(
        name="frame times without a column of names",
        codes=("not-one-time-column",),
        make=text("frames.csv", "name,t_s", "image,when"),
        mend=text("frames.csv", "image,when", "name,t_s"),
    )


def boards() -> Iterator[Mistake]:
    yield checkerboard("checkerboard:8x6:40", "length-in-millimetres")
    yield checkerboard("checkerboard:8x6:40mm", "not-a-number-in-target")
    yield checkerboard("chessboard:8x6:0.04", "target-kind-unknown")
    yield checkerboard("checkerboard:8x6", "target-fields")
    yield checkerboard("checkerboard:8:6:0.04", "target-fields")


def paths() -> Iterator[Mistake]:
    path = partial(Mistake, kind="paths")
    yield path(
        name="folder of images misspelt",
        codes=("no-such-file",),
        make=toml('folder = "frames"', 'folder = "frame"'),
        mend=toml('folder = "frame"', 'folder = "frames"'),
    )
    yield path(
        name="IMU file misspelt",
        codes=("no-such-file",),
        make=misspell("capture.toml", "gyro.csv", "accel.csv"),
        mend=restore_toml,
    )
    yield path(
        name="capture misspelt",
        codes=("no-such-file",),
        arguments=("reconstruct", "{scene}s", "{out}"),
        again=("diagnose", "{scene}"),
    )
    yield path(
        name="result into a folder with other things",
        codes=("output-among-pictures",),
        arguments=("reconstruct", "{scene}", "{scene}/frames"),
        again=("diagnose", "{scene}"),
    )
    yield path(
        name="frame times of other images",
        codes=("pictures-without-row",),
        make=rename_frames("", "IMG_"),
        mend=rename_frames("IMG_", ""),
    )
    yield path(
        name="a model instead of a trajectory",
        codes=("no-model-here",),
        arguments=("scale", "{scene}/frames", "--imu", "{scene}"),
        again=SCALE,
    )


def options() -> Iterator[Mistake]:
    choice = partial(Mistake, kind="options")
    yield choice(
        name="--method joynt",
        arguments=(*SCALE, "--method", "joynt"),
        says="joint",
        again=(*SCALE, "--method", "joint"),
    )
    yield choice(
        name="--first-seconds 12",
        arguments=(*SCALE, "--first-seconds", "12"),
        says="--first-seconds.* --help",
        again=(*SCALE, "--first-s", "12"),
    )
    yield choice(
        name="--latitude-deg 478",
        arguments=(*SCALE, "--latitude-deg", "478"),
        says="90",
        again=(*SCALE, "--latitude-deg", "47.8"),
    )
    yield choice(
        name="--gravity-m-s2 1",
        arguments=(*SCALE, "--gravity-m-s2", "1"),
        says="gravity.*9\\.|9\\..*gravity|m/s2",
        again=(*SCALE, "--gravity-m-s2", "9.81"),
    )
    yield choice(name="Python: world='zup'", call=option(world="zup"), says="z-up", call_again=option(world="z-up"))
    yield choice(
        name="Python: deblur='weiner'", call=option(deblur="weiner"), says="wiener", call_again=option(deblur="wiener")
    )
    yield choice(
        name="Python: refine=True", call=option(refine=True), says="inertial", call_again=option(refine="inertial")
    )


def arrays() -> Iterator[Mistake]:
    array = partial(Mistake, kind="arrays", call_again=RIGHT_CALL)
    yield array(
        name="stamps of the gyroscope in ns",
        call=imu_with(lambda imu: {"gyro_t_s": 1e9 * imu.gyro_t_s, "accel_t_s": 1e9 * imu.accel_t_s}),
        says="second|unit|ns",
    )
    yield array(
        name="times of poses in ms", call=poses_with(lambda p: {"t_s": 1e3 * p.t_s}), codes=("poses-not-in-seconds",)
    )
    yield array(
        name="gyroscope of shape (3, N)", call=imu_with(lambda imu: {"gyro_rad_s": imu.gyro_rad_s.T}), says="shape|3\\)"
    )
    yield array(
        name="gyroscope in deg/s",
        call=imu_with(lambda imu: {"gyro_rad_s": np.degrees(imu.gyro_rad_s)}),
        codes=("gyro-in-degrees",),
    )
    yield array(
        name="accelerometer in g",
        call=imu_with(lambda imu: {"accel_m_s2": imu.accel_m_s2 / G}),
        codes=("accel-implausible",),
    )
    yield array(
        name="quaternions that are not of unit length",
        call=poses_with(lambda p: {"cam_from_world_xyzw": 2 * p.cam_from_world_xyzw}),
        says="unit|norm|length",
    )
    yield array(
        name="stamps out of order",
        call=imu_with(lambda imu: {"gyro_t_s": imu.gyro_t_s[::-1].copy()}),
        says="order|increas|ascend|grow",
    )
    yield array(
        name="NaN in the accelerometer",
        call=imu_with(
            lambda imu: {"accel_m_s2": np.where(np.arange(len(imu.accel_t_s))[:, None] == 9, np.nan, imu.accel_m_s2)}
        ),
        says="finite|NaN|nan",
    )


MISTAKES: tuple[Mistake, ...] = tuple(
    mistake for kind in (units, axes, clocks, columns, boards, paths, options, arrays) for mistake in kind()
)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What was said of a mistake, its time, whether it was caught and its advice helped, and what was said then."""

    message: str
    codes: list[str]
    seconds: float
    caught: bool
    mended: bool
    then: str


def run(arguments: list[str], *, as_json: bool = False) -> tuple[int, Said]:
    """Exit code of a command, and what it says; facts where it answers in JSON."""
    words = arguments + (["--json", "-"] if as_json else [])
    answer, said, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(answer), contextlib.redirect_stderr(said):
        try:
            run_command(words)
        except SystemExit as stopped:
            code = int(stopped.code or 0)
    facts = tuple(facts_in(json.loads(answer.getvalue()))) if as_json and answer.getvalue() else ()
    shown = said.getvalue() + ("" if as_json else answer.getvalue())
    return code, Said(text=" ".join(shown.split()), facts=facts)


def facts_in(content: object) -> Iterator[dict[str, Any]]:
    """Every code with its values in JSON, outer ones first."""
    if isinstance(content, dict):
        if content.keys() == {"code", "values"}:
            yield content
        content = list(content.values())
    if isinstance(content, list):
        for item in content:
            yield from facts_in(item)


def call(function: Call, scene: Path) -> tuple[int, Said]:
    """What a Python call ends with, and a traceback's last line, as a person reads it; -1 where it is another's."""
    try:
        function(scene)
    except InertialError as error:
        text = f"{type(error).__name__}: {error}"
        return 1, Said(text=text, facts=tuple(facts_in(fact_of(error).as_json())))
    except (TypeError, ValueError) as error:
        return 1, Said(text=f"{type(error).__name__}: {error}")
    except (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError) as error:
        return -1, Said(text=f"UNTYPED {type(error).__name__}: {error}")
    return 0, Said(text="")


def write_poses(scene: Path) -> None:
    """The true path in units of 0.25 m, as a table in TUM's format."""
    truth = json.loads((DESK / "truth.json").read_text())
    lines = []
    for frame in truth["frames"]:
        x, y, z, w = frame["cam_from_world_xyzw"]
        at = np.array(frame["cam_in_world_m"]) / TRUE_SCALE
        lines.append(" ".join(f"{value:.9f}" for value in (frame["t_middle_s"], *at, -x, -y, -z, w)))
    (scene / "poses.txt").write_text("\n".join(lines) + "\n")


def succeeds(scene: Path, folder: Path, *, reconstruct: bool) -> tuple[bool, Said]:
    """Whether a mended scene is reconstructed, or, quickly, is free of errors and has the right scale; what is said."""
    if reconstruct:
        code, said = run(["reconstruct", str(scene), str(folder / "mended")])
        return code == 0, said
    code, said = run(["diagnose", str(scene)])
    if code:
        return False, said
    code, said = run(["scale", str(scene / "poses.txt"), "--imu", str(scene), "--json", str(folder / "scale.json")])
    scale = json.loads((folder / "scale.json").read_text())["metres_per_unit"] if code == 0 else None
    return scale is not None and abs(scale / TRUE_SCALE - 1) < 0.05, said


def try_mistake(mistake: Mistake, folder: Path, seed: int, *, mend: bool = True, reconstruct: bool = False) -> Outcome:
    """Make a mistake, read what is said, and do what it advises."""
    scene, out = folder / "scene", folder / "out"
    shutil.copytree(DESK, scene)
    write_poses(scene)
    mistake.make(scene, np.random.default_rng(seed))
    begin_s = time.monotonic()
    if mistake.call is not None:
        code, said = call(mistake.call, scene)
    else:
        code, said = run([word.format(scene=scene, out=out) for word in mistake.arguments], as_json=True)
    seconds = time.monotonic() - begin_s
    begun = (out / "colmap" / "database.db").exists()
    if mistake.codes:
        named = not set(mistake.codes).isdisjoint(said.codes)
    else:
        named = not said.facts and re.search(mistake.says, said.text) is not None
    caught = code > 0 and not begun and named
    mended, then = True, Said(text="")
    if mend:
        try:
            if mistake.mend is not None:
                mistake.mend(scene, said)
                mended, then = succeeds(scene, folder, reconstruct=reconstruct)
            if mistake.again:
                code, then = run([word.format(scene=scene, out=folder / "again") for word in mistake.again])
                mended = mended and code == 0
            if mistake.call_again is not None:
                code, then = call(mistake.call_again, scene)
                mended = mended and code == 0
        except (AssertionError, LookupError, TypeError) as error:
            mended, then = False, Said(text=f"the advice cannot be followed: {error}")
    return Outcome(
        message=said.text[-600:],
        codes=said.codes,
        seconds=seconds,
        caught=caught,
        mended=mended,
        then=then.text[-400:],
    )


# --- declared values -------------------------------------------------------------------------------------------------

#: What is declared wrongly, and the codes that name it.
DECLARED = {
    "inverse rotation": ("declared-rotation",),
    "w of the rotation first": ("declared-rotation",),
    "axes of graphics": ("declared-rotation",),
    "time offset's sign": ("declared-offset",),
    "time offset in ms": ("declared-offset",),
    "lever arm of the inverse": ("declared-lever-arm",),
    "lever arm, 15 cm off": ("declared-lever-arm",),
    "lever arm in millimetres": ("declared-lever-arm",),
    "gains of another IMU, 4 %": ("calibrated-gain-contradicted",),
    "focal length, 8 to 35 % off": ("declared-focal-length",),
    "readout of 0": ("rolling-shutter-ignored",),
    "readout, 5 ms or more off": ("declared-readout",),
}
#: Those that points of a model tell.
OF_MODELS = ("focal length, 8 to 35 % off", "readout of 0", "readout, 5 ms or more off")


def draw_camera(kind: str, k: int, seed: int) -> tuple[str, str]:
    """A walk whose camera is declared wrongly, and COLMAP's model of it: what came of it, and what is said."""
    rng = np.random.default_rng([seed, 61, k])
    readout_s = 0.0 if kind.startswith("focal") else float(rng.uniform(0.01, 0.03))
    motion = MotionOptions(kind="walk", duration_s=16.0, speed_m_s=1.0, vigour=0.6, look_deg=40.0)
    device = IMU_PRESETS[list(IMU_PRESETS)[k % 2]]
    options = TrackOptions(motion=motion, imu=device, readout_s=readout_s, points_per_m=60.0)
    tracks = simulate_tracks(options, seed=int(rng.integers(1 << 31)))
    timing, xy_px, shutter, times = replace(tracks.timing, readout_s=0.0), tracks.xy_px.copy(), None, 1.0
    if kind == "readout, 5 ms or more off":
        stated_s = readout_s + (0.005 + float(rng.uniform(0, 0.01))) * (-1 if readout_s > 0.02 else 1)
        timing = replace(tracks.timing, readout_s=stated_s)
        view = GyroView(
            imu=tracks.imu, timing=timing, calibration=tracks.calibration, camera=tracks.camera, source="capture"
        )
        shutter = RollingShutterStage(view=view)
        for i, name in enumerate(timing.names):
            xy_px[tracks.frame == i] = shutter.moved(name, xy_px[tracks.frame == i])
    elif kind.startswith("focal"):
        times = float(np.exp(rng.choice([-1, 1]) * rng.uniform(np.log(1.08), np.log(1.35))))
    mapped = map_with_camera(tracks.reconstruction(xy_px), times)
    prior = calibration_prior(Declared(readout_s=timing.readout_s))
    model = Model(reconstruction=mapped, colmap_index=0, timing=timing, rectified=shutter is not None)
    stages: dict[str, Any] = {"imu": tracks.imu, "calibration": prior, "keeps_intrinsics": True}
    model = ReadoutStage(**stages, refine_intrinsics=False, num_threads=1)(model)
    estimate = MetricStage(**stages, shutter=shutter)(model).scale
    assert estimate is not None
    centres = np.array([mapped.find_image_with_name(name).projection_center() for name in timing.names])
    truth = tracks.motion.cam_in_world_m(timing.pose_t_s())
    spread = [float(np.sqrt(np.sum((at - at.mean(axis=0)) ** 2))) for at in (centres, truth)]
    return judge_declared(kind, estimate, spread[1] / spread[0], [])


def map_with_camera(reconstruction: pycolmap.Reconstruction, times: float) -> pycolmap.Reconstruction:
    """COLMAP's bundle adjustment with a focal length that is so many times the true one, and stays."""
    for camera in reconstruction.cameras.values():
        for i in camera.focal_length_idxs():
            camera.params[i] *= times
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_principal_point = False
    options.refine_focal_length = options.refine_extra_params = False
    getattr(options, "ceres", options).solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    reconstruction.update_point_3d_errors()
    return reconstruction


def draw_declared(kind: str, k: int, seed: int) -> tuple[str, str]:
    """A recording whose device is declared wrongly: what came of it, and what is said."""
    if kind in OF_MODELS:
        return draw_camera(kind, k, seed)
    rng = np.random.default_rng([seed, 60, k])
    motion = MotionOptions(kind=("orbit", "walk", "roam")[k % 3], duration_s=25.0)  # type: ignore[arg-type]
    device = IMU_PRESETS[list(IMU_PRESETS)[k % len(IMU_PRESETS)]]
    made = simulate_recording(RecordingOptions(motion=motion, imu=device), seed=int(rng.integers(1 << 40)))
    true = made.truth.calibration
    turn = quat_normalize(rng.standard_normal(4))
    turn_matrix = matrix_from_quat(turn)
    shift_s = float(rng.uniform(0.03, 0.3) * rng.choice([-1, 1]))
    moved_s = true.gyro_time_offset_s - shift_s
    imu = replace(
        made.imu,
        gyro_rad_s=made.imu.gyro_rad_s @ turn_matrix,
        accel_m_s2=made.imu.accel_m_s2 @ turn_matrix,
        gyro_t_s=made.imu.gyro_t_s + moved_s,
        accel_t_s=made.imu.accel_t_s + moved_s,
        noise=None,
    )
    rotation, arm_m = quat_multiply(true.cam_from_imu_xyzw, turn), true.imu_in_cam_m
    values: dict[str, object] = {"cam_from_imu_xyzw": rotation, "imu_in_cam_m": arm_m, "gyro_time_offset_s": shift_s}
    direction = rng.standard_normal(3)
    values |= {
        "inverse rotation": {"cam_from_imu_xyzw": quat_conjugate(rotation)},
        "w of the rotation first": {"cam_from_imu_xyzw": np.roll(rotation, 1)},
        "axes of graphics": {"cam_from_imu_xyzw": quat_multiply(np.array([1.0, 0.0, 0.0, 0.0]), rotation)},
        "time offset's sign": {"gyro_time_offset_s": -shift_s},
        "time offset in ms": {"gyro_time_offset_s": 1e3 * shift_s},
        "lever arm of the inverse": {"imu_in_cam_m": -matrix_from_quat(rotation).T @ arm_m},
        "lever arm in millimetres": {"imu_in_cam_m": 1e3 * arm_m},
        "lever arm, 15 cm off": {"imu_in_cam_m": arm_m + 0.15 * direction / np.linalg.norm(direction)},
    }.get(kind, {})
    own = None
    if kind == "gains of another IMU, 4 %":
        own = ImuCalibration(
            accel_gain=np.diag(rng.choice([-0.04, 0.04], 3)),
            accel_bias_m_s2=np.zeros(3),
            gyro_gain=np.zeros((3, 3)),
            gyro_bias_rad_s=np.zeros(3),
            cov=1e-6 * np.eye(IMU_CAL.COUNT),
            gravity_m_s2=G,
            attitudes=12,
        )
    prior = calibration_prior(Declared(**values))  # type: ignore[arg-type]
    recorded = Recorded(imu=imu, trajectory=made.trajectory, calibration=prior)
    told = diagnose(recorded)
    if told.stopping:
        said = [finding.code for finding in told.stopping]
        return ("stopped" if set(said) <= set(DECLARED[kind]) else "misnamed"), " ".join(said)
    estimate = estimate_scale(made.trajectory, imu, calibration=recorded.believed, imu_calibration=own)
    return judge_declared(kind, estimate, made.truth.metres_per_unit, recorded.contradicted.facts)


def judge_declared(kind: str, estimate: ScaleEstimate, truth: float, before: Sequence[Fact]) -> tuple[str, str]:
    """What came of a declared value by the scale, and what is said; facts of the check come before."""
    said = [fact.code for fact in (*before, *estimate.reasons)]
    off = np.inf
    if estimate.metres_per_unit is not None and estimate.sigma_log:
        off = abs(float(np.log(estimate.metres_per_unit / truth))) / estimate.sigma_log
    is_named = bool(said) and said[0] in DECLARED[kind]
    if estimate.verdict == "refused":
        outcome = "refused" if is_named else "misnamed"
    elif is_named:
        outcome = "weak" if estimate.verdict != "trusted" else "left out" if off < Z95 else "WRONG"
    elif estimate.verdict == "trusted":
        outcome = "harmless" if off < Z95 else "WRONG"
    else:
        outcome = "misnamed" if off >= Z95 else "harmless"
    return outcome, f"{' '.join(said)} ({off:.1f} sigma)"


def study_declared(count: int, seed: int) -> int:
    """Draw, and print a table of what came of each kind."""
    outcomes: dict[str, Counter[str]] = {kind: Counter() for kind in DECLARED}
    for k in range(count):
        kind = list(DECLARED)[k % len(DECLARED)]
        outcome, said = draw_declared(kind, k, seed)
        outcomes[kind][outcome] += 1
        print(f"{k:3d} {kind:28} {outcome:9} {said}", flush=True)
    columns = ("stopped", "refused", "weak", "left out", "harmless", "misnamed", "WRONG")
    print(f"{'':28}{'drawn':>7}" + "".join(f"{name:>10}" for name in columns))
    for kind, of in outcomes.items():
        print(f"{kind:28}{sum(of.values()):7d}" + "".join(f"{of[name]:10d}" for name in columns))
    total = sum(outcomes.values(), Counter())
    print(f"{'all':28}{sum(total.values()):7d}" + "".join(f"{total[name]:10d}" for name in columns))
    return int(total["WRONG"] > 0 or total["misnamed"] > 1)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", default=[])
    parser.add_argument("--declared", type=int, default=0, help="draw so many declared values instead")
    parser.add_argument("--reconstruct", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    if options.declared:
        return study_declared(options.declared, options.seed)
    report = []
    for i, mistake in enumerate(MISTAKES):
        if options.kinds and mistake.kind not in options.kinds:
            continue
        with tempfile.TemporaryDirectory() as folder:
            found = try_mistake(mistake, Path(folder), options.seed + i, reconstruct=options.reconstruct)
        report.append({"kind": mistake.kind, "name": mistake.name, **vars(found)})
        word = "ok    " if found.caught and found.mended else "MISSED" if not found.caught else "UNMENDED"
        named = " ".join(found.codes) or found.message[-150:]
        print(f"{word} {mistake.kind:8} {mistake.name:46} {found.seconds:5.1f} s  {named}", flush=True)
    bad = [row["name"] for row in report if not (row["caught"] and row["mended"])]
    print(f"{'':10}{'made':>6}{'caught':>8}{'mended':>8}")
    for kind in dict.fromkeys(row["kind"] for row in report):
        of = [row for row in report if row["kind"] == kind]
        print(f"{kind:10}{len(of):6d}{sum(row['caught'] for row in of):8d}{sum(row['mended'] for row in of):8d}")
    print(f"{len(report) - len(bad)} of {len(report)} mistakes were caught, and their advice helped")
    if options.json is not None:
        write_report(options.json, {"mistakes": report})
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
