"""Files of a COLMAP project: the sub-model whose units each has, and how each kind is transformed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Similarity
from colmap_inertial.io.files import read_bytes
from colmap_inertial.io.ply import transform_ply
from colmap_inertial.io.stand_ins import is_apple_double
from colmap_inertial.model import model_format, read_model, require_format
from colmap_inertial.model.artefacts import check_map, transform_depth_map, transform_obj, transform_options
from colmap_inertial.model.camera_files import (
    bounds_cameras,
    is_depth_params,
    splat_cameras,
    transform_bounds,
    transform_depth_params,
    transform_splat_cameras,
)
from colmap_inertial.model.database import PlacedModel, is_database
from colmap_inertial.model.inventory import lengths_of
from colmap_inertial.model.nerf import is_export, is_transforms, transform_export, transform_transforms
from colmap_inertial.model.other_files import (
    is_dataparser,
    is_rig_configuration,
    mvsnet_cameras,
    transform_dataparser,
    transform_mvsnet_camera,
    transform_rig_configuration,
)

#: Kinds of files that have the shape of the model that they were made from.
_SHAPED = (
    *("depth map", "ply", "obj", "transforms", "export", "splat cameras", "poses and bounds", "depth parameters"),
    *("MVSNet camera", "dataparser"),
)
#: Kinds of files that tell themselves whether they are of a model here.
CAMERA_KINDS = ("transforms", "splat cameras", "poses and bounds", "MVSNet camera", "rig configuration", "dataparser")


def kind_to_move(file: Path, path: Path) -> str | None:
    """Kind of a file whose lengths are moved; ``None`` for any other, and for what stands in for a file."""
    if path.name.startswith("._") and is_apple_double(read_bytes(file, 4)):
        return None
    return kind_of(file, path)


def kind_of(file: Path, path: Path) -> str | None:
    """Kind of a file that carries length; damaged maps are refused here even where they would not change."""
    suffix = path.suffix.lower()
    stereo = path.parts[:-1]
    if suffix == ".bin" and "depth_maps" in stereo:
        return "depth map"
    if suffix == ".bin" and "normal_maps" in stereo:
        check_map(file, 3)
        return None
    if suffix == ".obj":
        with open(file, "rb") as head:
            return None if b"\0" in head.read(1024) else "obj"  # a compiler's object file has the same ending
    if is_transforms(path):
        return "transforms"
    if is_export(file):
        return "export"
    if path.name == "cameras.json" and splat_cameras(file):
        return "splat cameras"
    if path.name == "poses_bounds.npy" and bounds_cameras(file):
        return "poses and bounds"
    if is_depth_params(file):
        return "depth parameters"
    if suffix == ".txt" and mvsnet_cameras(file):
        return "MVSNet camera"
    if is_dataparser(file):
        return "dataparser"
    if is_rig_configuration(file):
        return "rig configuration"
    return {".ply": "ply", ".ini": "options"}.get(suffix) or ("database" if is_database(file) else None)


WRITERS: dict[str, Callable[[Path, Path, Similarity], tuple[str, ...]]] = {
    "depth map": transform_depth_map,
    "ply": transform_ply,
    "obj": transform_obj,
    "options": transform_options,
    "transforms": transform_transforms,
    "export": transform_export,
    "splat cameras": transform_splat_cameras,
    "poses and bounds": transform_bounds,
    "depth parameters": transform_depth_params,
    "MVSNet camera": transform_mvsnet_camera,
    "rig configuration": transform_rig_configuration,
    "dataparser": transform_dataparser,
}


@dataclass(frozen=True, kw_only=True)
class Layout:
    """The models of a project; all folders are relative to its root.

    Attributes
    ----------
    submodels
        COLMAP's sub-models, by number.
    owners
        The sub-model that each model folder shows, that of dense workspaces and exports included.
    workspaces
        Dense workspaces, with the sub-model that they were made from.
    placed
        Where the sub-models' cameras stand.
    """

    submodels: Mapping[int, Path]
    owners: Mapping[Path, int]
    workspaces: Mapping[Path, int]
    placed: Sequence[PlacedModel]

    def owner(self, path: Path) -> int | None:
        """The sub-model in whose frame a file is; ``None`` where only the project as a whole is above it."""
        for folder in path.parents:
            if folder in self.owners:
                return self.owners[folder]
            if folder in self.workspaces:
                return self.workspaces[folder]
        return next(iter(self.submodels)) if len(self.submodels) == 1 else None


def read_layout(root: Path, folders: Sequence[Path], *, one_for_all: bool) -> Layout:
    """Find the models of a project and which of them belong together.

    Parameters
    ----------
    root
        The project.
    folders
        Its folders, relative to it, without those that are kept as they are.
    one_for_all
        The same similarity goes to everything, whatever belongs together.

    Raises
    ------
    FormatError
        Where there is no model, or one cannot be told to belong to a sub-model.
    """
    models = [folder for folder in (Path(), *folders) if model_format(root / folder) is not None]
    if not models:
        require_format(root)
    known = {Path(), *folders}
    dense = [f for f in known if f / "stereo" in known and any(m.is_relative_to(f / "sparse") for m in models)]
    submodels = _submodels(root, models, dense, one_for_all=one_for_all)
    placed = {folder: _place_model(root / folder, index) for index, folder in submodels.items()}
    owners = {folder: index for index, folder in submodels.items()}
    for folder in models:
        if folder not in owners:
            owners[folder] = next(iter(submodels)) if one_for_all else _owner(root, folder, placed)
    workspaces = {}
    for folder in dense:
        inside = {owners[m] for m in models if m.is_relative_to(folder / "sparse")}
        if len(inside) > 1 and folder != Path():
            raise FormatError(root / folder, Fact("workspace-of-several-models"))
        if len(inside) == 1:
            workspaces[folder] = inside.pop()
        elif (root / folder / "stereo" / "depth_maps").is_dir():
            raise FormatError(root / folder, Fact("depth-maps-of-several-models"))
    return Layout(submodels=submodels, owners=owners, workspaces=workspaces, placed=list(placed.values()))


def find_made_from(root: Path, layout: Layout, files: Sequence[Path]) -> Path | None:
    """A file of a project that carries length and is no sub-model of it: it was made from one, and has its shape.

    ``files`` are those of the project, relative to it.
    """
    own = {*layout.submodels.values()}
    for path in sorted(files):
        if path.parent in layout.owners and path.parent not in own:
            return path
        if (kind := kind_to_move(root / path, path)) in _SHAPED and path.parent not in own:
            return path
        lengths = None if kind is not None else lengths_of(root / path, path)
        if lengths is not None and lengths[1] == "carried":
            return path
    return None


def _submodels(root: Path, models: list[Path], dense: list[Path], *, one_for_all: bool) -> dict[int, Path]:
    """COLMAP's own models: ``sparse`` or its numbered folders, else what is nearest to the root."""
    outside = [m for m in models if not any(m.is_relative_to(d) for d in dense)] or models
    top = Path("sparse")
    numbered = [m for m in outside if m.parent == top and m.name.isdigit()]
    nearest = [top] if top in outside else numbered or _nearest_to_root(outside)
    if len(nearest) == 1 and nearest != numbered:
        return {0: nearest[0]}
    if len({m.parent for m in nearest}) == 1 and all(m.name.isdigit() for m in nearest):
        return dict(sorted((int(m.name), m) for m in nearest))
    if one_for_all:
        return dict(enumerate(sorted(nearest)))
    raise FormatError(root, Fact("several-candidates", folders=tuple(str(m) for m in nearest[:4])))


def _nearest_to_root(folders: list[Path]) -> list[Path]:
    depth = min(len(folder.parts) for folder in folders)
    return [folder for folder in folders if len(folder.parts) == depth]


#: So many of a model's points tell where it is.
_POINTS = 20_000


def _place_model(folder: Path, index: int) -> PlacedModel:
    model = read_model(folder, unique_names=False)
    images = [model.image(i) for i in model.reg_image_ids()]
    sensors: dict[tuple[int, int], Array] = {}
    for rig in model.rigs.values():
        for sensor, pose in rig.non_ref_sensors.items():
            if pose is not None:
                sensors[int(sensor.type), int(sensor.id)] = np.array(pose.translation)
    points = [point.xyz for point in model.points3D.values()]
    return PlacedModel(
        index=index,
        centres={image.name: image.projection_center() for image in images},
        sensors=sensors,
        points=np.array(points[:: len(points) // _POINTS + 1]).reshape(-1, 3),
    )


def _owner(root: Path, folder: Path, submodels: Mapping[Path, PlacedModel]) -> int:
    """The sub-model that shares images with a model, their cameras in the same places."""
    model = _place_model(root / folder, -1)
    fits: list[Path] = []
    elsewhere: list[Path] = []
    for other, placed in submodels.items():
        common = model.centres.keys() & placed.centres.keys()
        if 2 * len(common) < len(model.centres):
            continue
        same = placed.has_cameras_at([(placed.centres[name], model.centres[name]) for name in common])
        (fits if same else elsewhere).append(other)
    if len(fits) == 1:
        return submodels[fits[0]].index
    if fits:
        raise FormatError(root / folder, Fact("belongs-to-several", folders=tuple(str(f) for f in fits)))
    if elsewhere:
        raise FormatError(
            root / folder,
            Fact("model-elsewhere", other=str(elsewhere[0])),
        )
    raise FormatError(root / folder, Fact("images-of-no-submodel"))
