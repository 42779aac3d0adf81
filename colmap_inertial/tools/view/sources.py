"""Content of a folder that can be shown: the model, its unit, its scale's uncertainty, and other files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact, read_facts
from colmap_inertial.core.geometry import quat_rotate
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import LengthUnit
from colmap_inertial.io.files import a_record_of_ours, path_in, read_json, reader
from colmap_inertial.model import TRANSFORM_FILE, find_models, is_metric, model_format
from colmap_inertial.model.similarities import similarity_from_json
from colmap_inertial.run.steps.workspace import Workspace, places_of, refuse_links


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaleFacts:
    """Facts on a model's scale.

    Attributes
    ----------
    unit
        Of the model that is shown.
    verdict, reasons
        Of the estimate; ``None`` and empty where there was none.
    metres_per_unit
        What the original model was multiplied by; ``None`` where refused or unknown.
    relative_ci95
        The scale's 95 % interval divided by the scale; ``None`` where unknown.
    """

    unit: LengthUnit
    verdict: str | None = None
    reasons: tuple[Fact, ...] = ()
    metres_per_unit: float | None = None
    relative_ci95: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class KnownDistance:
    """A known distance of a target, and what it measures in the model: metres."""

    pair: tuple[str, str]
    known_m: float
    measured_m: float


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetFacts:
    """A target of known size, as the validation of a metric model found it.

    Attributes
    ----------
    spec
        The target's description.
    error_pct, ci95_pct
        How much larger than it should be the target is in the model, per cent, and the 95 % interval.
    tolerance_pct, within_tolerance
        The largest error that passes, and whether it is proved to.
    distances
        Known distances, measured.
    corners
        (3,) position of each corner by name, in the model; empty where the validation did not keep them.
    """

    spec: str
    error_pct: float
    ci95_pct: tuple[float, float]
    tolerance_pct: float
    within_tolerance: bool
    distances: tuple[KnownDistance, ...]
    corners: Mapping[str, Array]


@dataclass(frozen=True, kw_only=True)
class StretchedPart:
    """Stretch of a part of the path against the whole by the refinement, in per cent; times on the camera's clock."""

    begin_s: float
    end_s: float
    percent: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewSource:
    """A model to show.

    Attributes
    ----------
    folder
        The COLMAP model.
    index
        Its number.
    others
        Numbers of all models beside it, its own among them.
    scale
        What is known of its scale.
    down_in_world
        (3,) gravity's direction in the model; ``None`` where unknown.
    gravity_on_axis
        The model was turned so that gravity is along z or y, and it is not recorded which.
    images
        Folders that may have its images, best first.
    fused, mesh, trajectory
        Files made from it; ``None`` where there are none.
    target
        Where it was validated.
    stretched
        The drift that a refinement took out of it, part by part.
    """

    folder: Path
    index: int
    others: tuple[int, ...]
    scale: ScaleFacts
    down_in_world: Array | None = None
    gravity_on_axis: bool = False
    images: tuple[Path, ...] = ()
    fused: Path | None = None
    mesh: Path | None = None
    trajectory: Path | None = None
    target: TargetFacts | None = None
    stretched: tuple[StretchedPart, ...] = ()


@reader("a result or a COLMAP model")
def find_source(out: Path, index: int | None = None, *, images: Path | None = None) -> ViewSource:
    """Find the model to show.

    Parameters
    ----------
    out
        What ``reconstruct`` or ``apply`` wrote, or any folder with a COLMAP model.
    index
        Number of the model; ``None`` takes the largest.
    images
        Folder with the model's images, where they are not beside it. What a result says of such a folder is not
        followed: the result may be a stranger's, and the folder one's own.

    Raises
    ------
    FormatError
        Where there is no such model, or the run that makes it is not finished.
    """
    if not out.is_dir():
        raise FormatError(out, Fact("nothing-to-view"))
    if images is not None and not images.is_dir():
        raise FormatError(images, Fact("no-folder-of-images"))
    given = () if images is None else (images,)
    workspace = Workspace(out)
    if workspace.result.is_file() or workspace.stamps.is_dir():
        refuse_links(out)
    if workspace.result.is_file() and model_format(out) is None:
        return _find_in_result(workspace, index, given)
    if workspace.stamps.is_dir():
        raise FormatError(out, Fact("run-not-finished"))
    return _find_in_project(out, index, given)


def _find_in_result(workspace: Workspace, index: int | None, given: tuple[Path, ...]) -> ViewSource:
    root = workspace.root
    try:
        record = read_json(workspace.result)
    except FormatError as error:
        raise FormatError(root, Fact("result-damaged", detail=str(error))) from None
    with a_record_of_ours(workspace.result):
        models = {int(m["index"]): m for m in record.get("models", [])}
        if not models:
            raise FormatError(root, Fact("result-without-model"))
        sizes = {i: int(m["registered_images"]) for i, m in models.items()}
        chosen = _choose(root, sizes, index)
        fields = models[chosen]
        metric = fields["sparse_metric"] is not None
        place = str(fields["sparse_metric"] if metric else fields["sparse"])
        if Path(place).is_absolute():
            raise FormatError(root, Fact("result-without-own-model", project=place))
        folder = path_in(root, place, workspace.result)
        scale = _read_scale_facts(fields, "m" if metric else "model")
        gravity = fields["gravity_in_world_m_s2"]
        down = None if gravity is None else np.array(gravity, dtype=np.float64).reshape(3)
        if down is not None and metric:
            path = folder / TRANSFORM_FILE
            down = quat_rotate(similarity_from_json(path, read_json(path)).rotation_xyzw, down)
        dense = fields.get("dense") or {}
        validation = fields.get("validation")
        target = _target(validation) if metric and validation and "error" not in validation else None
        fused, mesh, path_file = dense.get("fused"), dense.get("mesh"), fields.get("trajectory")
        return ViewSource(
            folder=folder,
            index=chosen,
            others=tuple(models),
            scale=scale,
            down_in_world=down,
            images=(*given, *places_of(root).images, *(f for f in _image_folders(folder) if root in f.parents)),
            fused=path_in(root, fused, workspace.result) if fused else None,
            mesh=path_in(root, mesh, workspace.result) if mesh else None,
            trajectory=path_in(root, path_file, workspace.result) if path_file else None,
            target=target,
            stretched=_read_stretched_parts(fields),
        )


def _read_stretched_parts(fields: Mapping[str, Any]) -> tuple[StretchedPart, ...]:
    refined = [t for t in fields.get("treatments", []) if t["stage"] == "refine" and t["action"]]
    parts = refined[-1]["values"].get("drift", []) if refined else []
    keys = ("begin_s", "end_s", "percent")
    return tuple(StretchedPart(**{key: float(part[key]) for key in keys}) for part in parts)


def _find_in_project(out: Path, index: int | None, given: tuple[Path, ...]) -> ViewSource:
    """A COLMAP model, or a project with models where COLMAP has them, as they are or as ``apply`` wrote them."""
    for place in (out, *places_of(out).sparse):
        try:
            models = find_models(place)
            break
        except FormatError:
            continue
    else:
        raise FormatError(out, Fact("neither-result-nor-model"))
    # the file's size stands for the number of registered images: no model is read
    sizes = {i: (folder / f"images{model_format(folder)}").stat().st_size for i, folder in models.items()}
    chosen = _choose(out, sizes, index)
    folder = models[chosen]
    scale, on_axis = ScaleFacts(unit="model", **_read_verdict_of_apply(out, folder)), False
    if is_metric(folder):
        path = folder / TRANSFORM_FILE
        similarity = similarity_from_json(path, read_json(path))
        sigma = float(np.sqrt(max(similarity.cov[0, 0], 0.0)))
        factor = float(np.exp(Z95 * sigma))
        ci95 = (1 / factor, factor) if sigma > 0 else None
        scale = replace(scale, unit="m", metres_per_unit=similarity.scale, relative_ci95=ci95)
        on_axis = bool(similarity.cov[1:4, 1:4].any())
    single, beside = len(models) == 1, _image_folders(folder)
    linked = [candidate for candidate in beside if _leads_out(out, candidate)]
    if linked and not given:
        raise FormatError(linked[0], Fact("link-out-of-project", target=str(linked[0].resolve())))
    return ViewSource(
        folder=folder,
        index=chosen,
        others=tuple(models),
        scale=scale,
        gravity_on_axis=on_axis,
        images=(*given, *(candidate for candidate in beside if candidate not in linked)),
        fused=_beside(out, chosen, single, "fused.ply"),
        mesh=_beside(out, chosen, single, "meshed-tsdf.ply") or _beside(out, chosen, single, "meshed-poisson.ply"),
    )


def _choose(out: Path, sizes: Mapping[int, int], index: int | None) -> int:
    if index is None:
        return max(sizes, key=lambda i: (sizes[i], -i))
    if index not in sizes:
        raise FormatError(out, Fact("no-such-model", number=index, numbers=sorted(sizes)))
    return index


def _read_scale_facts(fields: Mapping[str, Any], unit: LengthUnit) -> ScaleFacts:
    scale, ci95 = fields["metres_per_unit"], fields["ci95"]
    relative = None if scale is None or ci95 is None else (float(ci95[0]) / scale, float(ci95[1]) / scale)
    return ScaleFacts(
        unit=unit,
        verdict=str(fields["verdict"]),
        reasons=read_facts(fields, "reasons"),
        metres_per_unit=scale,
        relative_ci95=relative,
    )


def _read_verdict_of_apply(out: Path, folder: Path) -> dict[str, Any]:
    """Verdict and reasons that ``apply`` wrote into the project's record, where there is one."""
    path = out / TRANSFORM_FILE
    if not path.is_file():
        return {}
    with a_record_of_ours(path):
        for model in read_json(path).get("models", []):
            if out / model["folder"] == folder:
                return {"verdict": model["verdict"], "reasons": read_facts(model, "reasons")}
    return {}


def _target(fields: Mapping[str, Any]) -> TargetFacts | None:
    if fields["scale_error_pct"] is None or fields["ci95_pct"] is None:
        return None
    low, high = map(float, fields["ci95_pct"])
    return TargetFacts(
        spec=str(fields["target"]),
        error_pct=float(fields["scale_error_pct"]),
        ci95_pct=(low, high),
        tolerance_pct=float(fields["tolerance_pct"]),
        within_tolerance=bool(fields["within_tolerance"]),
        distances=tuple(
            KnownDistance(
                pair=(str(d["pair"][0]), str(d["pair"][1])),
                known_m=float(d["known_m"]),
                measured_m=float(d["measured"]),
            )
            for d in fields["distances"]
        ),
        corners={
            str(c["name"]): np.array(c["in_model"], dtype=np.float64).reshape(3) for c in fields.get("corners", [])
        },
    )


def _image_folders(folder: Path) -> list[Path]:
    """Folders of a model's images in COLMAP's projects."""
    return [place / "images" for place in (folder, *folder.absolute().parents[:3])]


def _leads_out(out: Path, folder: Path) -> bool:
    """Whether a folder in a project is a link out of it: that may be a stranger's, and the images there one's own."""
    top = out.resolve()
    return folder.parent.resolve().is_relative_to(top) and not folder.resolve().is_relative_to(top)


def _beside(out: Path, index: int, single: bool, name: str) -> Path | None:
    """A dense result of a project's model, in the places where COLMAP's commands put it."""
    dense = places_of(out).dense
    places = [*(place / str(index) for place in dense), *([*dense, out] if single else [])]
    return next((place / name for place in places if (place / name).is_file()), None)
