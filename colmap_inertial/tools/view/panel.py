"""The texts of the viewer's panel, in Markdown."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence

import numpy as np

from colmap_inertial.report.series import stride_indices
from colmap_inertial.report.words import place_against_tolerance
from colmap_inertial.tools.view.measure import Measured, length_text
from colmap_inertial.tools.view.scene import Scene
from colmap_inertial.tools.view.sources import KnownDistance, TargetFacts

_COLOUR = {"trusted": "#40c057", "weak": "#fab005", "refused": "#fa5252"}


def _plain(text: str) -> str:
    """Text of files on one line, without meaning in Markdown, HTML or MDX: all punctuation is escaped."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(text.split()))


def _flag(colour: str, text: str, size: str) -> str:
    dot = f'<span style="color:{colour}">&#9679;</span>'
    return f'<div style="padding:0 1em;font-weight:600;font-size:{size}">{dot} {html.escape(text)}</div>'


def verdict_html(scene: Scene) -> str:
    """The verdict, with its colour."""
    verdict = scene.scale.verdict
    text = f"Scale {verdict}" if verdict else "Scale without a verdict"
    return _flag(_COLOUR.get(verdict or "", "#999"), text, "1.25em")


def scale_text(scene: Scene) -> str:
    """Scale, interval and reasons."""
    scale = scene.scale
    lines = []
    if scale.unit != "m":
        lines.append("**Units of the model, no scale.** Distances here are not metres.")
    elif scale.relative_ci95 is not None:
        half = 50 * (scale.relative_ci95[1] - scale.relative_ci95[0])
        lines.append(f"**Metres**, ± {half:.2g} % (95 %)")
    else:
        lines.append("**Metres**, as the user gave the scale; its uncertainty is not known.")
    if scale.unit == "m" and scale.metres_per_unit is not None:
        lines.append(f"{scale.metres_per_unit:.5g} m per unit of the original model")
    lines += [f"- {_plain(str(reason))}" for reason in scale.reasons]
    if not scene.gravity_known:
        lines.append("Gravity is not known: up is where the images' upper edges point on average.")
    return "\n\n".join(lines)


def contents_text(scene: Scene) -> str:
    """Number of points and cameras, in words."""
    cloud = scene.cloud
    kind = "points from depth maps" if cloud.dense else "points"
    of_all = "" if len(cloud.xyz) == cloud.total else f"of {cloud.total:,} "
    lines = [f"{len(scene.cameras)} cameras, {len(cloud.xyz):,} {of_all}{kind}"]
    if len(scene.source.others) > 1:
        others = ", ".join(map(str, scene.source.others))
        lines.append(f"Model {scene.source.index} of {others} (`--model`)")
    if scene.path_percent is not None:
        most = float(np.abs(scene.path_percent).max(initial=0.0))
        lines.append(f"Along the path, red was stretched by the refinement and blue shortened, by up to {most:.2g} %.")
    if scene.mesh_note is not None:
        lines.append(_plain(str(scene.mesh_note)))
    return "\n\n".join(lines)


def ground_text(scene: Scene) -> str:
    """Size of the grid's cells, in words."""
    return "" if scene.ground is None else f"One cell of the grid is {length_text(scene.ground.step_m)}."


def camera_text(scene: Scene, camera: int, problem: str = "") -> str:
    """Name and place of a camera, and why its image is not shown."""
    unit = "m" if scene.scale.unit == "m" else "units"
    x, y, z = scene.cameras.cam_in_world[camera] + scene.offset_in_world
    text = f"**{_plain(scene.cameras.names[camera])}** at {x:.3f}, {y:.3f}, {z:.3f} {unit}"
    return f"{text}\n\n{_plain(problem)}" if problem else text


def describe_distance(result: Measured) -> str:
    """A measured distance with its interval."""
    lines = [f"### {result.text}"]
    if result.ci95 is not None:
        low, high = result.ci95
        lines.append(
            f"95 % interval of the scale: {length_text(low, digits=4)} to {length_text(high, digits=4)}. "
            "Errors of the two picked points are not included."
        )
    elif result.unit == "m":
        lines.append("The uncertainty of the scale is not known.")
    return "\n\n".join(lines)


def tolerance_html(target: TargetFacts) -> str:
    """Whether the target has its size, with a colour."""
    place = place_against_tolerance(target.error_pct, target.tolerance_pct, target.within_tolerance)
    colour = {"within": "trusted", "outside": "refused"}.get(place, "weak")
    return _flag(_COLOUR[colour], f"{place.capitalize()} its tolerance", "1em")


def target_text(target: TargetFacts) -> str:
    """Results of the validation, with known against measured distances by length."""
    low, high = target.ci95_pct
    lines = [
        f"The target {_plain(target.spec)} measures **{target.error_pct:+.2f} %** (95 %: {low:+.2f} to {high:+.2f})",
        _table(target.distances),
    ]
    if not target.corners:
        lines.append("Its corners are not in this result, which an earlier version wrote.")
    return "\n\n".join(lines)


def distance_label(distance: KnownDistance) -> str:
    """Measured against known."""
    difference = 1000 * (distance.measured_m - distance.known_m)
    return f"{1000 * distance.measured_m:.1f} mm (known {1000 * distance.known_m:.1f}, {difference:+.1f})"


def _table(distances: Sequence[KnownDistance]) -> str:
    by_length: dict[int, list[float]] = {}
    for distance in distances:
        by_length.setdefault(round(distance.known_m * 1e5), []).append(distance.measured_m)
    lengths = sorted(by_length)
    lengths = [lengths[i] for i in stride_indices(len(lengths), 8)]
    rows = [
        f"| {length / 100:.1f} | {1000 * float(np.mean(by_length[length])):.2f} | {len(by_length[length])} |"
        for length in lengths
    ]
    return "\n".join(["| known, mm | measured, mm | pairs |", "|--:|--:|--:|", *rows])
