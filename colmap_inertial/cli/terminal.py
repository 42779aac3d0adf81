"""What the command line shows at the end: one screen."""

from __future__ import annotations

import math
import shlex
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_inertial.cli.screen import SEVERITY_COLOUR, Screen
from colmap_inertial.core.errors import InertialError

# Only the annotations need these, and what a command does not load it does not wait for.
if TYPE_CHECKING:
    from rich.text import Text

    from colmap_inertial.checks.diagnose import Diagnosis
    from colmap_inertial.checks.validate import Validation
    from colmap_inertial.core.types import CameraImuCalibration, Gap, JoinedPart, ScaleEstimate
    from colmap_inertial.inertial.georeference import Georeference
    from colmap_inertial.inertial.static_calibration import RestCalibration
    from colmap_inertial.model.project import Applied
    from colmap_inertial.pipeline.run.workspace import Workspace
    from colmap_inertial.pipeline.stages.frame_folder import FrameRecord
    from colmap_inertial.reconstruction.drivers.deblur import DeblurResult
    from colmap_inertial.reconstruction.drivers.device_store import Remembered
    from colmap_inertial.reconstruction.drivers.reference import Reference
    from colmap_inertial.reconstruction.drivers.result import ReconstructResult
    from colmap_inertial.reconstruction.preparation.plan import ImagingPlan
    from colmap_inertial.tools.export.whole import Exported

#: A label and what there is to say.
Line = tuple[str, "str | Text"]

_COLOUR = {"trusted": "green", "weak": "yellow", "refused": "red"}


def headline(estimate: ScaleEstimate) -> str:
    """What a user wants to know first: how far off ten metres may be."""
    from colmap_inertial.checks.report.words import half_width_pct, length_error

    if estimate.metres_per_unit is None or estimate.ci95 is None:
        return "no metres: the recording does not tell how large things are"
    error = length_error(half_width_pct(estimate.metres_per_unit, estimate.ci95))
    if estimate.verdict == "trusted":
        return f"10 m are 10 m to within {error}"
    return f"10 m may be off by {error}, or by more for the reasons below: check a known length before you measure"


def next_command(result: ReconstructResult, source: Path) -> str:
    """What to type next, by how a reconstruction ended."""
    from colmap_inertial.checks.validate import Validation

    out, best = result.workspace.root, result.models[0]
    if all(model.sparse_metric is None for model in result.models):
        return shlex.join(["colmap-inertial", "diagnose", str(source)])
    if isinstance(best.validation, Validation) and not best.validation.within_tolerance:
        return shlex.join(["colmap-inertial", "diagnose", str(source)])
    if best.scale.verdict == "weak" and best.validation is None and best.sparse_metric is not None:
        images = result.workspace.images
        words = ["colmap-inertial", "validate", str(best.sparse_metric), "--images", str(images), "--target"]
        return f"{shlex.join(words)} checkerboard:8x6:0.03"
    return shlex.join(["colmap-inertial", "view", str(out)])


def scale_lines(estimate: ScaleEstimate) -> list[Line]:
    """The estimate as labelled lines, the first of them what a user wants to know."""
    from rich.text import Text

    from colmap_inertial.inertial.scale.parts import parts_in_words

    lines: list[Line] = [("Metres", Text(headline(estimate), "bold"))]
    lines.append(("Verdict", Text(estimate.verdict, f"bold {_COLOUR[estimate.verdict]}")))
    if estimate.metres_per_unit is not None and estimate.ci95 is not None:
        low, high = estimate.ci95
        half_width = 50 * (high - low) / estimate.metres_per_unit
        lines.append(("Scale", f"{estimate.metres_per_unit:.6g} m per unit, +-{half_width:.2g} % (95 %)"))
        lines.append(("Interval", f"{low:.6g} to {high:.6g} m per unit"))
    if estimate.parts is not None:
        made_of, advice = parts_in_words(estimate.parts)
        lines += [("Made of", made_of), ("Narrower", advice)]
    lines += [("Reason" if i == 0 else "", text) for i, text in enumerate(estimate.reasons)]
    lines += [("Note" if i == 0 else "", text) for i, text in enumerate(estimate.notes)]
    calibration = estimate.calibration
    if calibration is not None:
        gyro, accel = calibration.gyro_time_offset_s, calibration.accel_time_offset_s
        lines.append(
            ("Time offset", f"gyro {gyro:+.4f} s, accelerometer {accel:+.4f} s (camera time = stamp + offset)")
        )
        bias = ", ".join(f"{value:+.4f}" for value in calibration.gyro_bias_rad_s)
        lines.append(("Gyro bias", f"{bias} rad/s"))
    if estimate.accel_bias_m_s2 is not None:
        bias = ", ".join(f"{value:+.3f}" for value in estimate.accel_bias_m_s2)
        lines.append(("Accel. bias", f"{bias} m/s2"))
    return lines


def _show(title: str, lines: Sequence[Line]) -> None:
    from rich.console import Console
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for label, text in lines:
        # not as markup: square brackets of paths and tables are meant
        table.add_row(label, Text(text) if isinstance(text, str) else text)
    Console().print(Panel(table, title=Text(title), title_align="left", expand=False))


def show_scale(estimate: ScaleEstimate, source: Path) -> None:
    """Print one scale estimate."""
    _show(str(source), [*scale_lines(estimate), ("Method", f"{estimate.method}, {estimate.runtime_s:.2f} s")])


def show_applied(applied: Applied) -> None:
    """Print what was done to a project: each sub-model's scale, and what changed by kind."""
    from rich.text import Text

    lines: list[Line] = []
    for index, (folder, scale) in applied.models.items():
        done = "kept its own units" if scale.similarity is None else f"lengths times {scale.similarity.scale:.6g}"
        said = Text(f"{folder}: {done}")
        if scale.verdict is not None:
            said.append_text(Text.assemble(" (", (scale.verdict, f"bold {_COLOUR[scale.verdict]}"), ")"))
        lines.append((f"Model {index}", said))
        lines += [("", reason) for reason in scale.reasons if scale.similarity is None]
    kinds: dict[str, list[str]] = {}
    for change in applied.changes:
        kinds.setdefault(change.kind, []).append(f"{change.path} ({', '.join(change.changed)})")
    for kind, paths in kinds.items():
        more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
        lines.append((kind.capitalize(), f"{paths[0]}{more}"))
    lines.append(("Unchanged", ", ".join(f"{n} {how}" for how, n in applied.unchanged.items()) or "nothing"))
    lines += [("Note", note) for note in applied.notes]
    lines.append(("Written", str(applied.out)))
    _show("Project", lines)


def show_remembered(known: Remembered) -> None:
    """Say which calibrations of an earlier day are used, and how to do without."""
    for path, kind in known.files:
        print(f'{known.device}: uses the remembered calibration "{kind}", {path} (--no-remembered leaves it out)')


def _kept(kept: Path | None) -> list[Line]:
    return [] if kept is None else [("Remembered", f"{kept}; reconstruct and scale take it by the device's name")]


def show_imu_calibration(found: RestCalibration, source: Path, out: Path, kept: Path | None) -> None:
    """Print what the rests say of an IMU, with 95 % intervals."""
    from rich.text import Text

    from colmap_inertial.checks.report.imu_calibration import gain_effect

    calibration = found.calibration
    colour = {"good": "green", "weak": "yellow"}[found.verdict]
    lines: list[Line] = [("Verdict", Text(found.verdict, f"bold {colour}"))]
    lines += [("Reason" if i == 0 else "", reason) for i, reason in enumerate(found.reasons)]
    before, after = found.rms_pct(found.before_m_s2), found.rms_pct(found.after_m_s2)
    lines += [
        ("Rests", f"{len(found.rests)} in {calibration.attitudes} attitudes"),
        ("Gravity", f"off by {before:.2g} % rms over the rests as read, by {after:.2g} % corrected"),
    ]
    for name, label in (("accel", "Accel. gain"), ("gyro", "Gyro gain")):
        gains = [f"{100 * getattr(calibration, f'{name}_gain')[i, i]:+.3f}" for i in range(3)]
        spread = 196 * max(calibration.sigma(f"{name}_gain_{axis}{axis}") for axis in "xyz")
        lines.append((label, f"{', '.join(gains)} %, +-{spread:.2g} (95 %)"))
    units = {"accel": ("accel_bias_m_s2", "m_s2", "m/s2"), "gyro": ("gyro_bias_rad_s", "rad_s", "rad/s")}
    for name, (field, suffix, unit) in units.items():
        bias = ", ".join(f"{value:+.4f}" for value in getattr(calibration, field))
        spread = 1.96 * max(calibration.sigma(f"{name}_bias_{axis}_{suffix}") for axis in "xyz")
        lines.append(
            (f"{name.capitalize()}. bias" if name == "accel" else "Gyro bias", f"{bias} {unit}, +-{spread:.2g}")
        )
    lines += [("Scale", gain_effect(found)), ("Written", str(out)), ("", str(out.with_suffix(".html"))), *_kept(kept)]
    _show(str(source), lines)


def show_calibration(calibration: CameraImuCalibration, source: Path, kept: Path | None = None) -> None:
    """Print what an alignment found, with standard deviations."""
    rotation = ", ".join(f"{value:+.5f}" for value in calibration.cam_from_imu_xyzw)
    spread_deg = math.degrees(calibration.rotation_sigma_rad)
    bias = ", ".join(f"{value:+.4f}" for value in calibration.gyro_bias_rad_s)
    bias_spread = max(calibration.sigma(f"gyro_bias_{axis}_rad_s") for axis in "xyz")
    offset, offset_ms = calibration.gyro_time_offset_s, 1e3 * calibration.sigma("gyro_time_offset_s")
    _show(
        str(source),
        [
            ("Rotation", f"camera from IMU, xyzw: {rotation}, +-{spread_deg:.2g} deg"),
            ("Time offset", f"{offset:+.4f} s, +-{offset_ms:.2g} ms (camera time = stamp + offset)"),
            ("Gyro bias", f"{bias} rad/s, +-{bias_spread:.2g}"),
            *_kept(kept),
        ],
    )


def show_diagnosis(diagnosis: Diagnosis, source: Path) -> None:
    """Print findings, worst first."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    checked = ", ".join(diagnosis.checked) or "nothing"
    console = Console()
    if not diagnosis.findings:
        console.print(f"{escape(str(source))}: nothing found (looked at: {checked})")
        _say_not_checked(diagnosis)
        return
    table = Table(title=f"{escape(str(source))} (looked at: {checked})", title_justify="left", show_lines=True)
    for column in ("Severity", "Code", "Found", "What to do"):
        table.add_column(column, overflow="fold", no_wrap=column in ("Severity", "Code"))
    for finding in diagnosis.findings:
        colour = SEVERITY_COLOUR[finding.severity]
        severity = f"[bold {colour}]{finding.severity}[/]"
        table.add_row(severity, finding.code, escape(finding.evidence), escape(finding.advice))
    console.print(table)
    _say_not_checked(diagnosis)


def _say_not_checked(diagnosis: Diagnosis) -> None:
    from colmap_inertial.checks.report.words import not_checked

    left = not_checked(diagnosis.checked)
    if left:
        print(f"not checked: {left}")


def show_validation(result: Validation) -> None:
    """Print a validation."""
    from rich.console import Console

    from colmap_inertial.checks.validate import validation_table

    Console().print(validation_table(result))


def imaging_lines(frames: Sequence[FrameRecord], plan: ImagingPlan, rectified: Collection[str]) -> list[Line]:
    """What was done to the frames, as labelled lines."""
    from colmap_inertial.reconstruction.drivers.result import shutter_note

    counts = {action: sum(frame.action == action for frame in frames) for action in ("deblurred", "dropped")}
    done = ", ".join(f"{count} {action}" for action, count in counts.items() if count)
    view = plan.view
    lines: list[Line] = [
        ("Deblurring", f"{done} of {len(frames)} frames: {plan.deblur_note}" if done else plan.deblur_note),
        ("Shutter", shutter_note(plan, rectified)),
    ]
    return [*lines, *(("", note) for note in (() if view is None else view.notes))]


def show_nothing_to_do(workspace: Workspace) -> None:
    """Say that an earlier run's result stands."""
    print(f"nothing to do: kept from the earlier run; {workspace.root} holds the result of this with these options")


def show_reference(found: Reference) -> None:
    """Print where a project's metres come from, and how good they are."""
    from colmap_inertial.checks.report.words import half_width_pct, length_error

    low, high = found.ci95
    pct = half_width_pct(found.metres_per_unit, found.ci95)
    # a small target says how long things are where it lies, and no more
    lengths = None if found.validation is None else found.validation.lengths
    small = found.scale_from == "target" and lengths is not None and lengths.is_short
    _show(
        "Project",
        [
            (
                "Metres",
                f"10 m are 10 m to within {length_error(pct)}{', as far as the target reaches' if small else ''}",
            ),
            ("From", found.made_of),
            ("Scale", f"{found.metres_per_unit:.6g} m per unit, +-{pct:.2g} % (95 %)"),
            ("Interval", f"{low:.6g} to {high:.6g} m per unit"),
            *(("Note" if i == 0 else "", note) for i, note in enumerate(found.notes)),
            ("Written", str(found.out)),
        ],
    )
    print(f"next: {shlex.join(['colmap-inertial', 'view', str(found.out)])}")


def show_fused(lines: Sequence[str], screen: Screen) -> None:
    """Print what became of the pictures of several lenses or exposures."""
    if screen.unchanged:
        print("nothing to do: kept from the earlier run")
    for line in lines:
        print(line)


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
    _show("Images", [*lines, *(("Written" if i == 0 else "", str(path)) for i, path in enumerate(written))])


def _on_map(found: Georeference | InertialError) -> str:
    from colmap_inertial.core.quantiles import Z95

    if isinstance(found, InertialError):
        return str(found)
    heading, place = Z95 * found.heading_sigma_deg, Z95 * found.position_sigma_m
    at = f"{found.latitude_deg:.6f}, {found.longitude_deg:.6f}"
    return f"{at}: heading +-{heading:.1f} degrees, place +-{place:.1f} m, by {found.used} positions"


def show_result(result: ReconstructResult, source: Path) -> None:
    """Print the end of a reconstruction of ``source`` on one screen; the last line is what to type next."""
    from colmap_inertial.checks.report.words import mapped_in_words, parts_mapped_in_words
    from colmap_inertial.checks.validate import Validation

    mapping = None if result.mapping is None else asdict(result.mapping)
    if result.unchanged and not result.waiting:
        show_nothing_to_do(result.workspace)
    frames = result.frames
    used = sum(record.used for record in frames)
    registered = f" of {used} registered ({len(frames)} frames)" if frames else ""
    for model in result.models:
        summary = model.summary
        lines: list[Line] = [
            *scale_lines(model.scale),
            ("Images", f"{summary['registered_images']}{registered}"),
            ("Points", f"{summary['points']}, mean reprojection error {summary['mean_reprojection_error_px']:.2f} px"),
            *(imaging_lines(frames, result.imaging, result.keypoints.rectified()) if frames else []),
        ]
        said = parts_mapped_in_words(mapping) if model is result.models[0] else []
        if said := said + mapped_in_words(mapping, model.colmap_index):
            lines.append(("Mapping", " ".join(said)))
        if model.parts:
            lines.append(("Joined", _joined(model.parts, result.gaps)))
        if isinstance(model.validation, Validation) and model.validation.ci95_pct is not None:
            low, high = model.validation.ci95_pct
            error = f"{model.validation.scale_error_pct:+.2f} % (95 %: {low:+.2f} to {high:+.2f})"
            lines.append(("Target", f"{model.validation.target.spec}: scale error {error}"))
        elif isinstance(model.validation, InertialError):
            lines.append(("Target", str(model.validation)))
        if model.georeference is not None:
            lines.append(("On the map", _on_map(model.georeference)))
        dense = model.dense
        made = [] if dense is None else [dense.fused, dense.mesh]
        if dense is not None and not dense.waiting:
            maps = f"{dense.depth_maps} depth maps of {dense.images} images"
            lines.append(("Dense", f"{maps}, {dense.points} points, {dense.faces} faces"))
        paths = (model.sparse_metric, model.trajectory, *made, result.project_metric)
        written = [path for path in paths if path is not None]
        lines += [
            ("Written" if i == 0 else "", str(path))
            for i, path in enumerate([*written, result.workspace.result, *([result.report] if result.report else [])])
        ]
        if result.report is None:
            lines.append(("Report", f"failed, see {result.workspace.log}"))
        lines.append(("Time", ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in result.seconds.items())))
        number = "" if model.colmap_index == model.index else f" (COLMAP's {model.colmap_index})"
        _show(f"Model {model.index}{number}", lines)
    if all(model.sparse_metric is None for model in result.models) and result.workspace.colmap_sparse.is_dir():
        print(
            f"metres by hand: colmap-inertial reconstruct {shlex.quote(str(result.workspace.colmap))} NEW_FOLDER "
            "--scale-from target --target ..., or --scale-from distance (--help)"
        )
    print(_layout_in_a_line(result))
    for fragment in result.fragments:
        print(
            f"COLMAP's model {fragment.colmap_index} is a fragment of {fragment.registered_images} images, left out; "
            "--fragments makes it metric, too"
        )
    for gap in result.gaps:
        if not gap.joined:
            print(f"COLMAP's models {gap.first} and {gap.second}, {gap.seconds:.1f} s apart, stay apart: {gap.reason}")
    print(f"next: {next_command(result, source)}")


def _joined(parts: Sequence[JoinedPart], gaps: Sequence[Gap]) -> str:
    """What a model was joined of, and how sure that is."""
    inside = {part.colmap_index for part in parts}
    across = [
        f"{gap.seconds:.1f} s to {100 * (gap.sigma_m or 0.0):.1f} cm, {gap.sigma_deg:.2f} degrees"
        for gap in gaps
        if gap.joined and {gap.first, gap.second} <= inside
    ]
    numbers = ", ".join(str(part.colmap_index) for part in parts)
    return f"COLMAP's models {numbers}; 1 sigma across: {'; '.join(across)}"


def _layout_in_a_line(result: ReconstructResult) -> str:
    """Where what is metric lies, and where what is not."""
    workspace = result.workspace
    if all(model.sparse_metric is None for model in result.models):
        where = {str(model.sparse) for model in result.models}
        return f"no scale is accepted, so that nothing here is in metres: COLMAP's own is {', '.join(sorted(where))}"
    if result.project_metric is not None:
        return f"{workspace.root} is the whole project in metres"
    made = [path.name for path in (workspace.images, workspace.sparse, workspace.dense) if path.is_dir()]
    return f"{workspace.root} is a COLMAP project in metres ({', '.join(made)}); in COLMAP's units: {workspace.colmap}"


def show_exported(made: Exported) -> None:
    """Print what was exported, and the command line that keeps metres and up."""
    from rich.text import Text

    several = (
        f" of {len(made.others)}; --model takes {', '.join(map(str, made.others))}" if len(made.others) > 1 else ""
    )
    unit = "metres" if made.unit == "m" else Text("unknown: not metres", "bold red")
    lines: list[Line] = [
        ("Model", f"{made.model}{several}"),
        ("Unit", unit),
        *([("Images", str(made.images))] if made.images else []),
        *([("Points", str(made.points))] if made.points else []),
        *(("Note", note) for note in made.notes),
        *([("Use", made.says)] if made.says else []),
        ("Written", str(made.folder)),
    ]
    _show("Export" if made.program is None else f"Export for {made.program}", lines)
    if made.command:
        # not in the panel, which would break the line that is to be copied
        print(made.command)


def show_view(out: Path, url: str, host: str) -> None:
    """Where a model is shown, and to whom."""
    from colmap_inertial.tools.view.guard import is_loopback

    print(f"{out} is shown at {url} (Ctrl-C ends this)", flush=True)
    if not is_loopback(host):
        print(
            f"listening at {host}: everybody on the network who learns this address sees the model and its images, and "
            "nothing is encrypted; to look from elsewhere, ssh -L to this machine is safer",
            flush=True,
        )
