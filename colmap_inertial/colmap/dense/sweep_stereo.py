"""Depth and normal maps of a dense workspace by our own plane sweep, where there is no CUDA for COLMAP's patch-match.

First the depths of each image by itself, which are kept aside; then, from those that others agree with, the maps that
COLMAP's fusion reads. Both file by file, so that a sweep that was cut off goes on where it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from colmap_inertial.colmap.dense.depth_maps import map_file
from colmap_inertial.core.arrays import UInt8Array
from colmap_inertial.core.geometry import opencv_px_from_colmap
from colmap_inertial.core.threads import frames_at_once, map_in_order
from colmap_inertial.imaging.plane_sweep import (
    Agreement,
    DepthView,
    Partner,
    Pinhole,
    Sights,
    choose_partners,
    confirm_depth,
    depth_range,
    estimate_normals,
    estimate_sigma,
    keep_certain,
    score_partners,
    smooth_depth,
    sweep_depth,
)
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import convert_to_plain, path_in, read_json, write_json
from colmap_inertial.io.images import read_image
from colmap_inertial.model import read_model
from colmap_inertial.model.artefacts import read_map, write_map

#: Partners to match with (fewer measure less, more cost time), and views to ask for agreement.
PARTNERS, WITNESSES = 4, 8
#: Maps of each image: depths, their standard deviations, normals.
_MAPS = ("depth", "geometric"), ("depth", "sigma"), ("normal", "geometric")


@dataclass(frozen=True)
class SweptWorkspace:
    """A dense workspace of COLMAP's, and where depths are kept that nothing confirmed yet."""

    folder: Path
    raw: Path

    def begin(self, identity: object) -> None:
        """Go on with a sweep of the same images and model, or remove what there is of another one."""
        record, content = self.raw / "made_from.json", convert_to_plain({"identity": identity, "smoothed": True})
        if record.is_file() and read_json(record) == content:
            return
        remove(self.raw)
        for name in self.names:
            for what, kind in _MAPS:
                remove(map_file(self.folder, what, name, kind))
        self.raw.mkdir(parents=True)
        write_json(record, content)

    def sweep(self, threads: int, progress: Callable[[], object]) -> None:
        """Write the maps of all images that have partners; ``progress`` is called twice for each image.

        Parameters
        ----------
        threads
            0 takes all processors.
        """
        for view in range(len(self.names)):
            self._match(view, threads)
            progress()
        workers = threads or frames_at_once()
        for _ in map_in_order(self._confirm, range(len(self.names)), workers=workers):
            progress()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the images, in the order of the views."""
        return self._scene[0]

    @property
    def sights(self) -> Sights:
        """Cameras and the points that they see."""
        return self._scene[1]

    @cached_property
    def _scene(self) -> tuple[tuple[str, ...], Sights]:
        model = read_model(self.folder / "sparse")
        ids = sorted(model.points3D)
        points = np.array([model.points3D[i].xyz for i in ids]).reshape(-1, 3)
        images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
        views, observed = [], []
        for image in images:
            camera, pose = model.camera(image.camera_id), image.cam_from_world()
            fx, fy, cx, cy = camera.params
            views.append(
                Pinhole(
                    width=camera.width,
                    height=camera.height,
                    focal_px=np.array([fx, fy]),
                    centre_px=opencv_px_from_colmap(np.array([cx, cy])),
                    cam_from_world=pose.rotation.matrix(),
                    cam_in_world=image.projection_center(),
                )
            )
            seen = np.array([p.point3D_id for p in image.points2D if p.has_point3D()], dtype=np.int64)
            observed.append(np.searchsorted(ids, seen).astype(np.int64))
        return tuple(image.name for image in images), Sights.of(views, points, observed)

    def _raw_file(self, view: int) -> Path:
        return path_in(self.raw, f"{self.names[view]}.bin")

    def _match(self, view: int, threads: int) -> None:
        """The depths of one image by its partners."""
        target, sights = self._raw_file(view), self.sights
        depths = depth_range(sights, view)
        if target.is_file() or depths is None:
            return
        chosen = choose_partners(sights, view, score_partners(sights, view), PARTNERS)
        if chosen:
            partners = [Partner(codes=self._grey(k), camera=sights.views[k]) for k in chosen]
            write_map(target, sweep_depth(self._grey(view), sights.views[view], partners, depths, threads=threads))

    def _confirm(self, view: int) -> None:
        """The maps of one image: depths that others agree with, or planes through these have, if certain."""
        files = [map_file(self.folder, what, self.names[view], kind) for what, kind in _MAPS]
        if not self._raw_file(view).is_file() or all(file.is_file() for file in files):
            return
        agreement, camera, partners = self.compare(view), self.sights.views[view], self.partners(view)
        own = agreement.depth, estimate_sigma(agreement, camera, partners)
        depth, sigma = keep_certain(*smooth_depth(*own, self.picture(view), camera, partners))
        for file, values in zip(files, (depth, sigma, estimate_normals(depth, camera)), strict=True):
            write_map(file, values)

    def partners(self, view: int) -> list[Pinhole]:
        """Cameras of the images that an image is matched with."""
        scores = score_partners(self.sights, view)
        return [self.sights.views[k] for k in choose_partners(self.sights, view, scores, PARTNERS)]

    def compare(self, view: int) -> Agreement:
        """Compare the depths of one image with those of others."""
        scores = score_partners(self.sights, view)
        best = np.argsort(-scores, kind="stable")[:WITNESSES]
        witnesses = [int(k) for k in best if scores[k] > 0 and self._raw_file(int(k)).is_file()]
        return confirm_depth(self._depth_view(view), (self._depth_view(k) for k in witnesses))

    def _depth_view(self, view: int) -> DepthView:
        return DepthView(depth=read_map(self._raw_file(view)), camera=self.sights.views[view])

    def picture(self, view: int) -> UInt8Array:
        """(H, W) or (H, W, 3) codes."""
        picture = read_image(path_in(self.folder / "images", self.names[view]))
        return np.asarray(picture >> 8 if picture.dtype == np.uint16 else picture, dtype=np.uint8)

    def _grey(self, view: int) -> UInt8Array:
        import cv2

        picture = self.picture(view)
        return np.asarray(picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
