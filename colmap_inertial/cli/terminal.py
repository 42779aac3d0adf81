"""Summary of a finished command: one screen."""

from __future__ import annotations

import math
import re
import shlex
import shutil
import sys
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_inertial.cli.screen import SEVERITY_COLOUR, Screen, clock
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.printing import open_console, say

# Only the annotations need these, and what a command does not load it does not wait for.
if TYPE_CHECKING:
    from rich.text import Text

    from colmap_inertial.core.types import CameraImuCalibration, ImuCalibration, ScaleEstimate
    from colmap_inertial.core.types.evidence import CombinedScale
    from colmap_inertial.diagnose import Diagnosis
    from colmap_inertial.inertial.static_calibration import RestCalibration
    from colmap_inertial.io.table_report import TableReport
    from colmap_inertial.model.project import Applied
    from colmap_inertial.run.commands.result import DeblurResult, ModelResult, ReconstructResult
    from colmap_inertial.run.commands.scale_by_reference import Reference
    from colmap_inertial.run.stages.frame_folder import FrameRecord
    from colmap_inertial.run.stages.imaging_plan import ImagingPlan
    from colmap_inertial.run.steps.workspace import Workspace
    from colmap_inertial.tools.export.whole import Exported
    from colmap_inertial.validate import Validation

#: A label and what there is to say.
Line = tuple[str, "str | Text"]

_COLOUR = {"trusted": "green", "weak": "yellow", "refused": "red"}


def _program() -> str:
    """The command that starts this program: its name if it is on the PATH, else its path."""
    beside = Path(sys.executable).with_name("colmap-inertial")
    return str(beside) if shutil.which("colmap-inertial") is None and beside.is_file() else "colmap-inertial"


def _next_to_see(out: Path, report: Path | None) -> str:
    """The command that shows a result: the viewer, or the report where the viewer is not installed."""
    if report is not None and find_spec("viser") is None:
        return f"open {shlex.quote(str(report))} in a browser"
    return shlex.join([_program(), "view", str(out)])


def next_command(result: ReconstructResult, source: Path) -> str:
    """The next command to type, by how a reconstruction ended."""
    from colmap_inertial.validate import Validation

    out, best = result.workspace.root, result.models[0]
    unfit = isinstance(best.validation, Validation) and not best.validation.within_tolerance
    if unfit or all(model.sparse_metric is None for model in result.models):
        return f"open {result.workspace.report}: cause and remedy"
    return _next_to_see(out, result.report)


def scale_lines(estimate: ScaleEstimate) -> list[Line]:
    """The estimate as labelled lines, the first of them what a user wants to know."""
    from rich.text import Text

    from colmap_inertial.report.words import half_width_pct, length_in_words, scale_facts, sensor_facts

    stopped = any(reason.code == "force-goes-on" for reason in estimate.reasons)
    metres = "no metres: " + ("stopped, see the reasons" if stopped else "the recording does not determine the scale")
    if estimate.metres_per_unit is not None and estimate.ci95 is not None:
        metres = length_in_words(estimate.verdict, half_width_pct(estimate.metres_per_unit, estimate.ci95))
    values = estimate.as_json()
    return [
        ("metres", Text(metres, "bold")),
        ("verdict", Text(estimate.verdict, f"bold {_COLOUR[estimate.verdict]}")),
        *scale_facts(values),
        *_part_lines(estimate),
        *_label_first("reason", estimate.reasons),
        *_label_first("note", estimate.notes),
        *sensor_facts(values),
    ]


def _part_lines(estimate: ScaleEstimate) -> list[Line]:
    """The parts of the interval, and what would reduce it."""
    from colmap_inertial.inertial.scale.verdict import describe_parts

    if estimate.parts is None:
        return []
    made_of = describe_parts(estimate.parts)
    return [("uncertainty", str(made_of)), ("to reduce it", made_of.advice)]


def _label_first(label: str, texts: Iterable[object]) -> list[Line]:
    """Lines of which the first one bears the label."""
    return [("" if i else label, str(text)) for i, text in enumerate(texts)]


def _print_panel(title: str, lines: Iterable[Line]) -> None:
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for label, text in lines:
        # not as markup: square brackets of paths and tables are meant
        table.add_row(label[:1].upper() + label[1:], Text(text) if isinstance(text, str) else text)
    open_console().print(Panel(table, title=Text(title), title_align="left", expand=False))


def show_scale(estimate: ScaleEstimate, source: Path) -> None:
    """Print one scale estimate."""
    lines = [*scale_lines(estimate)]
    if estimate.method != "none":
        lines.append(("method", f"{estimate.method}, {estimate.runtime_s:.2f} s"))
    if estimate.sensors is not None:
        lines += evidence_lines(estimate.sensors)
    _print_panel(str(source), lines)


def evidence_lines(combined: CombinedScale) -> list[Line]:
    """What each sensor says of the scale, a line for each, and how wrong the device's own metres are."""
    from colmap_inertial.report.evidence import device_in_words, evidence_rows

    lines: list[Line] = [(row.sensor, row.text) for row in evidence_rows(combined.as_json())]
    if combined.device is not None:
        lines.append(("device's metres", device_in_words(combined.device.as_json())))
    return lines


def show_applied(applied: Applied) -> None:
    """Print what was done to a project: each sub-model's scale, and what changed by kind."""
    from rich.text import Text

    lines: list[Line] = []
    for index, (folder, scale) in applied.models.items():
        done = "kept its own units" if scale.similarity is None else f"lengths times {scale.similarity.scale:.6g}"
        line = Text(f"{folder}: {done}")
        if scale.verdict is not None:
            line.append_text(Text.assemble(" (", (scale.verdict, f"bold {_COLOUR[scale.verdict]}"), ")"))
        lines.append((f"Model {index}", line))
        lines += [("", str(reason)) for reason in scale.reasons if scale.similarity is None]
    kinds: dict[str, list[str]] = {}
    for change in applied.changes:
        kinds.setdefault(change.kind, []).append(f"{change.path} ({', '.join(change.changed)})")
    for kind, paths in kinds.items():
        more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
        lines.append((kind, f"{paths[0]}{more}"))
    lines.append(("unchanged", ", ".join(f"{n} {how}" for how, n in applied.unchanged.items()) or "nothing"))
    lines += [*_label_first("note", applied.notes), ("written", str(applied.out))]
    _print_panel("Project", lines)


def _describe_remembered(kept: Path | None) -> list[Line]:
    return [] if kept is None else [("remembered", f"{kept}; reconstruct and scale take it by the device's name")]


def show_compared(calibration: ImuCalibration, out: Path, kept: Path | None) -> None:
    """Print what results with targets say of a device."""
    lines: list[Line] = [("scale", str(calibration.comparison())), ("written", str(out))]
    results = f"{calibration.compared} result{'s' * (calibration.compared > 1)}"
    _print_panel(f"{results} with targets", [*lines, *_describe_remembered(kept)])


def show_imu_calibration(calibration: RestCalibration, source: Path, out: Path, kept: Path | None) -> None:
    """Print what the rests say of an IMU, with 95 % intervals."""
    from rich.text import Text

    from colmap_inertial.report.imu_calibration import calibration_facts, gain_effect

    colour = {"good": "green", "weak": "yellow"}[calibration.verdict]
    lines: list[Line] = [
        ("verdict", Text(calibration.verdict, f"bold {colour}")),
        *_label_first("reason", calibration.reasons),
    ]
    lines += [*calibration_facts(calibration), ("scale", gain_effect(calibration))]
    lines += [*_label_first("written", (out, out.with_suffix(".html"))), *_describe_remembered(kept)]
    _print_panel(str(source), lines)


def show_calibration(calibration: CameraImuCalibration, source: Path, kept: Path | None = None) -> None:
    """Print what an alignment found, with standard deviations."""
    rotation = ", ".join(f"{value:+.5f}" for value in calibration.cam_from_imu_xyzw)
    spread_deg = math.degrees(calibration.rotation_sigma_rad)
    bias = ", ".join(f"{value:+.4f}" for value in calibration.gyro_bias_rad_s)
    bias_spread = max(calibration.sigma(f"gyro_bias_{axis}_rad_s") for axis in "xyz")
    offset, offset_ms = calibration.clock_offset_s, 1e3 * calibration.clock_sigma_s
    lines: list[Line] = [
        ("rotation", f"camera from IMU, xyzw: {rotation}, +-{spread_deg:.2g} deg"),
        ("time offset", f"{offset:+.4f} s, +-{offset_ms:.2g} ms (camera time = timestamp + offset)"),
        ("gyro bias", f"{bias} rad/s, +-{bias_spread:.2g}"),
    ]
    _print_panel(str(source), [*lines, *_describe_remembered(kept)])


def show_diagnosis(diagnosis: Diagnosis, source: Path) -> None:
    """Print findings, worst first, and what could not be checked."""
    from rich.table import Table
    from rich.text import Text

    from colmap_inertial.report.words import checked_in_words, not_checked

    title = f"{source} (checked: {checked_in_words(diagnosis.checked) or 'nothing'})"
    table = Table(title=Text(title), title_justify="left", show_lines=True)
    for column in ("Severity", "Code", "Found", "What to do"):
        table.add_column(column, overflow="fold", no_wrap=column in ("Severity", "Code"))
    for finding in diagnosis.findings:
        severity = Text(finding.severity, f"bold {SEVERITY_COLOUR[finding.severity]}")
        table.add_row(severity, finding.code, Text(finding.evidence), Text(finding.advice))
    open_console().print(table if diagnosis.findings else Text(f"{title}: nothing found"))
    unchecked = not_checked(diagnosis.checked)
    if unchecked:
        say(f"not checked: {unchecked}")


def show_table(report: TableReport, written: Path | None) -> None:
    """Print what each column of a table was taken for, and the capture.toml that says so."""
    from rich.table import Table
    from rich.text import Text

    title = f"{report.path}{': ' if report.found else ''}{', '.join(report.found)}"
    table = Table(title=Text(title), title_justify="left")
    for name in ("", "Column", "Taken for", "Unit", "Mean", "Scatter", "Rate"):
        table.add_column(name, overflow="fold", justify="right" if name in ("", "Mean", "Scatter", "Rate") else "left")
    for column in report.columns:
        numbers = ("" if value is None else f"{value:.4g}" for value in (column.mean, column.scatter))
        rate = "" if column.rate_hz is None else f"{column.rate_hz:.4g} Hz"
        word, _, rest = column.kind.partition(" ")
        kind = "" if word == "other" else f"{_KINDS.get(word, word)} {rest}".strip()
        table.add_row(str(column.number), Text(column.name), kind, Text(column.unit), *numbers, rate)
    open_console().print(table)
    for reason in report.why:
        say(f"interpreted so because {reason}")
    if written is not None:
        say(f"{written} describes it{'; replace each ?' if report.is_open else ''}")
        return
    fill = "; replace each ?" if report.is_open else ""
    say(f"as a capture.toml (--capture FILE writes it{fill}):\n{report.toml}")


#: What columns are called to people.
_KINDS = {
    "gyro": "gyroscope",
    "accel": "accelerometer",
    "linear": "acceleration without gravity",
    "axis": "an axis, quantity unknown",
}


def show_validation(result: Validation) -> None:
    """Print a validation."""

    from colmap_inertial.validate import validation_table

    open_console().print(validation_table(result))


def imaging_lines(frames: Sequence[FrameRecord], plan: ImagingPlan, rectified: Collection[str]) -> list[Line]:
    """Treatment of the frames, as labelled lines."""
    from colmap_inertial.run.commands.result import describe_shutter

    counts = {"deblurred": sum(f.sharpened for f in frames), "dropped": sum(not f.used for f in frames)}
    done = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    view = plan.view
    note, shutter = str(plan.deblur_note or ""), str(describe_shutter(plan, rectified) or "")
    lines: list[Line] = [
        ("deblurring", f"{done} of {len(frames)} frames: {note}" if done else note),
        ("shutter", shutter),
    ]
    return [*lines, *(("", str(note)) for note in (() if view is None else view.notes))]


def show_nothing_to_do(workspace: Workspace) -> None:
    """Say that an earlier run's result stands."""
    say(f"nothing to do: kept from the earlier run; {workspace.root} holds the result for these inputs and options")


def show_reference(reference: Reference) -> None:
    """Print where a project's metres come from, and how good they are."""
    from colmap_inertial.report.words import half_width_pct, length_in_words, scale_facts

    # a small target says how long things are where it lies, and no more
    lengths = None if reference.validation is None else reference.validation.lengths
    small = reference.scale_from == ("target",) and lengths is not None and lengths.is_short
    combined = reference.sensors
    metres = length_in_words(combined.verdict, half_width_pct(combined.metres_per_unit, combined.ci95))
    values = {"metres_per_unit": combined.metres_per_unit, "ci95": combined.ci95}
    lines: list[Line] = [("metres", f"{metres}{', as far as the target reaches' if small else ''}")]
    lines += [("from", reference.made_of), *scale_facts(values)]
    if len(combined.evidence) + len(combined.absent) > 1:
        lines += evidence_lines(combined)
    lines += _label_first("note", reference.notes)
    _print_panel("Project", [*lines, ("written", str(reference.out))])
    say(f"next: {_next_to_see(reference.out, None)}")


def show_fused(lines: Sequence[str], screen: Screen) -> None:
    """Print what became of the images of several lenses or exposures."""
    if screen.unchanged:
        say("nothing to do: kept from the earlier run")
    for line in lines:
        say(line)


def show_deblurred(result: DeblurResult) -> None:
    """Print what became of the images."""
    if result.unchanged:
        show_nothing_to_do(result.workspace)
    written = [result.workspace.images, result.workspace.result]
    if result.workspace.colmap.is_dir():
        written.insert(1, result.workspace.colmap_images)
    if result.sheet is not None:
        written.append(result.sheet)
    lines = imaging_lines(result.frames, result.imaging, result.rectified)
    _print_panel("Images", [*lines, *_label_first("written", written)])


def show_result(result: ReconstructResult, source: Path) -> None:
    """Print the end of a reconstruction of ``source`` on one screen; the last line is what to type next."""
    if result.unchanged and not result.waiting:
        show_nothing_to_do(result.workspace)
    for model in result.models:
        number = "" if model.colmap_index == model.index else f" (COLMAP's {model.colmap_index})"
        _print_panel(f"Model {model.index}{number}", _model_lines(model, result))
    if all(model.sparse_metric is None for model in result.models) and result.workspace.colmap_sparse.is_dir():
        say(
            f"metres without the IMU: colmap-inertial reconstruct {shlex.quote(str(result.workspace.colmap))} "
            "NEW_FOLDER --scale-from target --target ..., or --scale-from distance (--help)"
        )
    say(_describe_layout(result))
    for fragment in result.fragments:
        say(
            f"COLMAP's model {fragment.colmap_index} is a fragment of {fragment.registered_images} images, left out; "
            "--fragments scales it too"
        )
    for gap in result.gaps:
        if not gap.joined:
            say(
                f"COLMAP's models {gap.first} and {gap.second}, {gap.seconds:.1f} s apart, are not joined: {gap.reason}"
            )
    say(f"next: {next_command(result, source)}")


def _model_lines(model: ModelResult, result: ReconstructResult) -> Iterator[Line]:
    """Summary of one model, as labelled lines."""
    from colmap_inertial.report.words import (
        describe_joined,
        describe_mapping,
        model_facts,
        parts_mapped_in_words,
        place_facts,
        target_facts,
    )
    from colmap_inertial.run.commands.result import measurement_as_json

    frames, dense = result.frames, model.dense
    mapping = None if result.mapping is None else asdict(result.mapping)
    used = sum(record.used for record in frames)
    yield from scale_lines(model.scale)
    if model.scale.sensors is not None:
        yield from evidence_lines(model.scale.sensors)
    yield from model_facts(model.summary, f" of {used} registered ({len(frames)} frames)" if frames else "")
    if frames:
        yield from imaging_lines(frames, result.imaging, result.keypoints.rectified())
    made = parts_mapped_in_words(mapping) if model is result.models[0] else []
    made += describe_mapping(mapping, model.colmap_index)
    if made:
        yield "mapping", " ".join(made)
    if model.parts:
        yield "joined", describe_joined([part.colmap_index for part in model.parts], [asdict(g) for g in result.gaps])
    if isinstance(model.validation, InertialError):
        yield "target", str(model.validation)
    elif model.validation is not None and model.validation.scale_error_pct is not None:
        yield from list(target_facts(model.validation.as_json()))[:2]
    yield from place_facts(measurement_as_json(model.georeference))
    if dense is not None and not dense.waiting:
        maps = f"{dense.depth_maps} depth maps of {dense.images} images"
        yield "dense", f"{maps}, {dense.points} points, {dense.faces} faces"
    made_of_dense = () if dense is None else (dense.fused, dense.mesh)
    paths = (model.sparse_metric, model.trajectory, *made_of_dense, result.project_metric)
    yield from _label_first("written", filter(None, (*paths, result.workspace.result, result.report)))
    if result.report is None:
        yield "report", f"failed, see {result.workspace.log}"
    took: dict[str, float] = {}
    for step, seconds in result.seconds.items():
        name = re.sub(r"_\d+$", "", step).replace("_", " ")
        took[name] = took.get(name, 0.0) + seconds  # of all models together
    yield "time", ", ".join(f"{step} {clock(s)}" for step, s in took.items() if clock(s) != clock(0.0))


def _describe_layout(result: ReconstructResult) -> str:
    """Describe where the metric and the other outputs are."""
    workspace = result.workspace
    if all(model.sparse_metric is None for model in result.models):
        where = {str(model.sparse) for model in result.models}
        return f"no scale was accepted, so nothing here is in metres; COLMAP's own model: {', '.join(sorted(where))}"
    if result.project_metric is not None:
        return f"{workspace.root} is the whole project in metres"
    # an interrupted dense reconstruction leaves a workspace, which is none
    dense = [workspace.dense] if any(model.dense is not None for model in result.models) else []
    made = [path.name for path in (workspace.images, workspace.sparse, *dense) if path.is_dir()]
    return f"{workspace.root} is a COLMAP project in metres ({', '.join(made)}); in COLMAP's units: {workspace.colmap}"


def show_exported(made: Exported) -> None:
    """Print what was exported, and the command line that keeps metres and up."""
    from rich.text import Text

    several = (
        f" of {len(made.others)}; --model takes {', '.join(map(str, made.others))}" if len(made.others) > 1 else ""
    )
    unit = "metres" if made.unit == "m" else Text("unknown: not metres", "bold red")
    lines: list[Line] = [
        ("model", f"{made.model}{several}"),
        ("unit", unit),
        *([("images", str(made.images))] if made.images else []),
        *([("points", str(made.points))] if made.points else []),
        *_label_first("note", made.notes),
        *([("use", made.says)] if made.says else []),
        ("written", str(made.folder)),
    ]
    _print_panel("Export" if made.program is None else f"Export for {made.program}", lines)
    if made.command:
        # not in the panel, which would break the line that is to be copied
        say(made.command)


def show_view(out: Path, url: str, host: str) -> None:
    """Print the address of the viewer, and who may open it."""
    from colmap_inertial.tools.view.guard import is_loopback

    say(f"{out} is shown at {url} (Ctrl-C ends this)")
    if not is_loopback(host):
        say(
            f"listening on {host}: anyone on the network who knows this address sees the model and its images, "
            "unencrypted; from elsewhere, ssh -L to this machine is safer"
        )
