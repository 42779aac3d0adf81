"""Depth maps, a fused point cloud and a mesh in metres, from a metric model.

Depth maps are made by COLMAP's patch-match where pycolmap has CUDA, else by our plane sweep; the rest is COLMAP's.
"""

from __future__ import annotations

import logging
import math
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_inertial.colmap.dense.depth_maps import (
    DenseResult,
    MadeFrom,
    choose_maker,
    coverage,
    digest_of_model,
    find_maps,
    fuse_maps,
    fusion_options,
    map_file,
    mesh_points,
    patch_match,
)
from colmap_inertial.colmap.dense.sweep_stereo import SweptWorkspace
from colmap_inertial.colmap.dense.tsdf import tsdf_mesh
from colmap_inertial.core.errors import FormatError, OutputError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import DenseOptions
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import a_record_of_ours, path_in, read_json, write_json
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.images import read_image
from colmap_inertial.io.ply import read_ply_header
from colmap_inertial.model import TRANSFORM_FILE, read_model
from colmap_inertial.run.steps.session import Session

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: Octree depths of Poisson meshing: COLMAP's own is the largest.
_LEAST_DEPTH, _MOST_DEPTH = 6, 13
#: COLMAP cuts away what is sampled three levels (8 times) more coarsely than the finest; so do we.
_TRIM_LEVELS = 3


@dataclass(frozen=True, kw_only=True)
class DenseWork:
    """Work for one image by step: its time on the example scene and on EuRoC (``scripts/studies/progress.py``)."""

    #: To find its depths by the plane sweep, 1.3 s of two cores, and to compare them with those of others.
    matched: int = 40
    confirmed: int = 6
    undistorted: int = 1
    #: 0.17 to 0.28 of the depths' time.
    fused: int = 11


_WORK = DenseWork()


def run_dense(session: Session, indices: Sequence[int], images: Path, options: DenseOptions) -> dict[int, DenseResult]:
    """Undistort, find depths, fuse and mesh the metric models; lengths are metres because the models' are.

    Parameters
    ----------
    session
        Of the run.
    indices
        Numbers of the models in ``sparse/``.
    images
        The images that agree with the models: the rectified ones where the rolling shutter was undone.
    options
        See :class:`DenseOptions`.

    Raises
    ------
    FormatError
        For an image or depth map that is missing or damaged.
    OutputExistsError
        Where depth maps of patch-match lie in the workspace that were made from another model.
    """
    prepared = {index: _prepare_model(session, index, images, options) for index in indices}
    # all are undistorted first: depth maps that come later then change nothing that others depend on
    images_of = {index: len(model.names) for index, model in prepared.items()}
    by_image = _WORK.matched + _WORK.confirmed + _WORK.fused
    done, total = 0, (_WORK.undistorted + by_image) * sum(images_of.values())

    def count(cost: int) -> None:
        nonlocal done
        done += cost
        session.progress("dense", done, total)

    for index in indices:
        _undistort_images(session, index, images, prepared[index])
        count(_WORK.undistorted * images_of[index])
    results: dict[int, DenseResult] = {}
    for index in indices:
        end = done + by_image * images_of[index]
        results[index] = _reconstruct_densely(session, index, prepared[index], options, count)
        # what was kept, or was not needed, counts as done
        count(end - done)
    return results


@dataclass(frozen=True, eq=False, kw_only=True)
class _Prepared:
    """A model before its dense reconstruction.

    Attributes
    ----------
    names
        Of its images, sorted.
    made_from
        What decides its depth maps, and who makes them.
    has_maps
        Whether some are there already.
    """

    names: tuple[str, ...]
    made_from: MadeFrom
    has_maps: bool


def _reconstruct_densely(
    session: Session, index: int, prepared: _Prepared, options: DenseOptions, count: Callable[[int], None]
) -> DenseResult:
    """Everything after undistortion."""
    import pycolmap

    runner, context = session.runner, session.context
    folder, names, maker = session.workspace.dense / str(index), prepared.names, prepared.made_from.maps
    before = [f"dense_{index}_undistorted"]
    if maker == "plane sweep":
        _sweep_depths(session, index, prepared, count)
    elif pycolmap.has_cuda:
        _match_patches(session, index, prepared, count)
    kind, mapped = find_maps(folder, names)
    result = DenseResult(folder=folder, images=len(names), depth_maps=len(mapped), maps=maker)
    if not mapped:
        waiting = Fact("no-depth-maps", folder=str(folder))
        log.warning("%s", waiting)
        return replace(result, waiting=waiting)
    if len(mapped) < len(names):
        log.warning("model %d: no depth map of %s", index, ", ".join(sorted(set(names) - set(mapped))))
    fused, mesh = folder / "fused.ply", folder / f"meshed-{options.mesh}.ply"

    def fuse(partial: Sequence[Path]) -> None:
        scratch = session.workspace.stamps / "fusion"
        targets = partial[0], partial[1]
        fuse_maps(folder, mapped, targets, maker=maker, kind=kind, scratch=scratch, context=context)
        write_json(partial[2], {"coverage": coverage(folder, mapped, kind)})

    maps = [fingerprint(place) for place in _list_map_folders(folder)]
    record = session.workspace.stamps / f"dense_{index}_measured.json"
    outputs = [fused, folder / "fused.ply.vis", record]
    chosen = fusion_options(maker, context)
    made_by: dict[str, object] = {"maps": maps, "colmap": context.colmap.identity("fusion")}
    made_by["options"] = [chosen.min_num_pixels, chosen.max_reproj_error]
    runner.run(f"dense_{index}_fused", made_by, outputs, fuse, after=before)
    count(len(names) * _WORK.fused)
    with a_record_of_ours(record):
        covered = float(read_json(record)["coverage"])
    result = replace(result, fused=fused, points=_count_elements(fused, "vertex"), coverage=covered)
    if options.mesh == "none" or not result.points:
        runner.discard(*folder.glob("meshed-*.ply"))
        return result
    if options.mesh == "tsdf":
        depends: dict[str, object] = {"maps": maps}
        make_mesh = partial(tsdf_mesh, folder, mapped, maker=maker, kind=kind)
    else:
        depth, trim = _choose_octree(fused, read_model(folder / "sparse"))
        depends = {"depth": depth, "trim": trim}
        make_mesh = partial(mesh_points, fused, depth=depth, trim=trim, context=context)

    def write_mesh(partial: Sequence[Path]) -> None:
        make_mesh(partial[0])
        for other in set(folder.glob("meshed-*.ply")) - {partial[0]}:
            remove(other)

    # its time does not follow from that of the depth maps: 0.4 to 4.6 times as long on two scenes
    session.progress("mesh", 0, 1)
    runner.run(f"dense_{index}_mesh", depends, [mesh], write_mesh, after=[f"dense_{index}_fused"])
    session.progress("mesh", 1, 1)
    return replace(result, mesh=mesh, faces=_count_elements(mesh, "face"))


def _prepare_model(session: Session, index: int, images: Path, options: DenseOptions) -> _Prepared:
    """Look at what there is, and decide who makes the depth maps."""
    model, folder = session.workspace.sparse / str(index), session.workspace.dense / str(index)
    reconstruction = read_model(model)
    names = tuple(sorted(reconstruction.image(i).name for i in reconstruction.reg_image_ids()))
    _check_images(images, model, reconstruction)
    made_from, has_maps = choose_maker(folder, digest_of_model(model), options.max_image_size, session.context.colmap)
    return _Prepared(names=names, made_from=made_from, has_maps=has_maps)


def _sweep_depths(session: Session, index: int, prepared: _Prepared, count: Callable[[int], None]) -> None:
    """Depth maps by our own sweep; those that a run made that was cut off are kept."""
    folder, stamps = session.workspace.dense / str(index), session.workspace.stamps
    record, raw = stamps / f"dense_{index}_depth_maps.json", stamps / f"sweep_{index}"

    def work(partial: Sequence[Path]) -> None:
        prepared.made_from.write(folder)
        swept = SweptWorkspace(folder, raw)
        swept.begin({"made_from": prepared.made_from, "images": fingerprint(folder / "images")})
        threads = session.context.num_threads
        costs = iter([_WORK.matched] * len(swept.names) + [_WORK.confirmed] * len(swept.names))
        swept.sweep(0 if threads < 0 else threads, lambda: count(next(costs)))
        write_json(partial[0], {"names": [n for n in prepared.names if map_file(folder, "depth", n).is_file()]})
        remove(raw)

    depends = {"maps": prepared.made_from.maps}
    after, step = [f"dense_{index}_undistorted"], f"dense_{index}_depth"
    session.runner.run(step, depends, [record], work, after=after, beside=partial(_list_map_folders, folder))


def _match_patches(session: Session, index: int, prepared: _Prepared, count: Callable[[int], None]) -> None:
    """Depth maps by COLMAP's patch-match, of each image a photometric one and a geometric one."""
    folder, made_from = session.workspace.dense / str(index), prepared.made_from
    whole, counted = len(prepared.names) * (_WORK.matched + _WORK.confirmed), 0

    def count_maps(there: int) -> None:
        nonlocal counted
        now = min(whole, whole * there // (2 * len(prepared.names)))
        if now > counted:
            count(now - counted)
            counted = now

    def work(_: Sequence[Path]) -> None:
        made_from.write(folder)
        patch_match(folder, made_from.max_image_size, session.context.colmap, count_maps)

    decided = {"maps": made_from.maps, "settings": made_from.settings}
    after, step = [f"dense_{index}_undistorted"], f"dense_{index}_depth"
    session.runner.run(step, decided, [], work, after=after, beside=partial(_list_map_folders, folder))
    count(whole - counted)


def _list_map_folders(folder: Path) -> list[Path]:
    return [folder / "stereo" / f"{what}_maps" for what in ("depth", "normal")]


def _undistort_images(session: Session, index: int, images: Path, prepared: _Prepared) -> None:
    """Write the dense workspace without depth maps."""
    import pycolmap

    runner, workspace = session.runner, session.workspace
    model, folder = workspace.sparse / str(index), workspace.dense / str(index)
    names, made_from = prepared.names, prepared.made_from

    def work(partial: Sequence[Path]) -> None:
        made_from.write(folder)  # before there is anything that must not outlive the model
        scratch = workspace.stamps / "dense"
        remove(scratch)
        scratch.mkdir(parents=True)
        undistortion = pycolmap.UndistortCameraOptions()
        undistortion.max_image_size = made_from.max_image_size or -1
        pycolmap.undistort_images(str(scratch), str(model), str(images), undistort_options=undistortion)
        lost = [name for name in names if not (scratch / "images" / name).is_file()]
        if lost:
            raise OutputError(
                Fact("images-not-undistorted", folder=str(folder), count=len(lost), of=len(names), image=lost[0])
            )
        shutil.copyfile(model / TRANSFORM_FILE, scratch / "sparse" / TRANSFORM_FILE)
        for source, target in zip((scratch / "images", scratch / "sparse"), partial, strict=True):
            os.replace(source, target)
        for path in scratch.iterdir():
            if not prepared.has_maps or path.name != "stereo":
                remove(folder / path.name)
                os.replace(path, folder / path.name)
        remove(scratch)

    depends = {
        "model": made_from.model,
        "max_image_size": made_from.max_image_size,
        "images": [fingerprint(path_in(images, name, model)) for name in names],
    }
    runner.run(f"dense_{index}_undistorted", depends, [folder / "images", folder / "sparse"], work, after=["metric"])


def _check_images(images: Path, model: Path, reconstruction: pycolmap.Reconstruction) -> None:
    """COLMAP ends the process where an image is missing or has another size than its camera."""
    checked = set()
    for i in reconstruction.reg_image_ids():
        image = reconstruction.image(i)
        path = path_in(images, image.name, model)
        if not path.is_file():
            raise FormatError(path, Fact("picture-of-model-missing"))
        if image.camera_id not in checked:
            checked.add(image.camera_id)
            height, width = read_image(path).shape[:2]
            camera = reconstruction.camera(image.camera_id)
            if (width, height) != (camera.width, camera.height):
                raise FormatError(
                    path,
                    Fact(
                        "picture-unlike-its-camera",
                        width=width,
                        height=height,
                        camera_width=camera.width,
                        camera_height=camera.height,
                    ),
                )


def _choose_octree(fused: Path, model: pycolmap.Reconstruction) -> tuple[int, float]:
    """Depth of the octree, so that its cells are as large as pixels on the surface, and where to trim it."""
    with open(fused, "rb") as file:
        header = read_ply_header(fused, file)
        start = file.tell()
    vertices = next(element for element in header.elements if element.name == "vertex")
    rows = np.memmap(fused, vertices.dtype("<"), "r", start, vertices.rows)
    extent_m = max(float(rows[axis].max()) - float(rows[axis].min()) for axis in "xyz")
    cells_m = []
    for i in model.reg_image_ids():
        image = model.image(i)
        pose, focal_px = image.cam_from_world(), model.camera(image.camera_id).mean_focal_length()
        points = [model.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()]
        if points:
            cam = np.array(points) @ pose.rotation.matrix().T + pose.translation
            cells_m.append(float(np.median(cam[:, 2])) / focal_px)
    if not cells_m or extent_m <= 0:
        return _MOST_DEPTH, float(_MOST_DEPTH - _TRIM_LEVELS)
    depth = math.ceil(math.log2(1.1 * extent_m / float(np.median(cells_m))))
    depth = min(max(depth, _LEAST_DEPTH), _MOST_DEPTH)
    return depth, float(depth - _TRIM_LEVELS)


def _count_elements(path: Path, element: str) -> int:
    with open(path, "rb") as file:
        return sum(e.rows for e in read_ply_header(path, file).elements if e.name == element)
