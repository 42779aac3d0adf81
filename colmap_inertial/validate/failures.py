"""Why a target has no place in a model: mirrored images, a wrong size of the board, a target that is not there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.core.errors import FormatError, NotObservableError, TargetNotFoundError
from colmap_inertial.core.facts import Fact
from colmap_inertial.validate.detect import DETECTION, detect, find_any_checkerboard
from colmap_inertial.validate.place import Search
from colmap_inertial.validate.targets import Target, parse_target
from colmap_inertial.validate.views import sight


@dataclass(frozen=True, kw_only=True)
class HintLimits:
    """Images that are looked at for a mirrored target, and for a board of another size."""

    mirror_views: int = 20
    size_views: int = 10
    least_board_corners: int = 12


_LIMITS = HintLimits()


def explain_failure(search: Search, images: Path) -> Exception:
    """The error that says why there is no result."""
    target, views = search.target, search.views
    seen = sorted({s.view for s in search.sightings})
    mirrored = _find_mirroring(search)
    if mirrored is not None:
        return FormatError(images, Fact("images-mirrored", along=mirrored))
    if not seen:
        return TargetNotFoundError(
            Fact("target-not-found", spec=target.spec, images=len(search.searched), hint=_hint_at_absence(search))
        )
    if len(seen) == 1:
        return NotObservableError("scale", Fact("target-in-one-image", name=views[seen[0]].name))
    if search.one_line is not None:
        return search.one_line
    return TargetNotFoundError(
        Fact(
            "target-nowhere-alike",
            spec=target.spec,
            kind=target.kind,
            images=len(seen),
            residual_px=search.options.max_residual_px,
        )
    )


def _find_mirroring(search: Search) -> str | None:
    """Along which direction the images are mirrored against the model, if that explains the detections."""
    for flip, along in ((1, "horizontal"), (0, "vertical")):
        again = Search(search.views, search.target, search.options, None)
        for v in search.searched[: _LIMITS.mirror_views]:
            image = search.views[v].read(flip=flip)
            if isinstance(image, Fact):
                continue
            sightings = [sight(v, search.views[v].camera, d) for d in detect(image, search.target)]
            again.sightings += [s for s in sightings if len(s.corner) >= DETECTION.least_corners]
        if again.place():
            return along
    return None


def require_no_larger_board(search: Search) -> None:
    """Refuse a checkerboard that is a part of a larger one: the detector then takes another part in every image.

    Raises
    ------
    TargetNotFoundError
        That names the size of the larger board.
    """
    if search.target.kind != "checkerboard":
        return
    centre = {s.view: s.xy_px.mean(axis=0) for s in search.sightings}
    images = {v: image for v, image in _images_of_hints(search).items() if v in centre}
    area = search.target.columns * search.target.rows
    larger = {size: votes for size, votes in _vote_on_sizes(images, centre).items() if size[0] * size[1] > area}
    size = max(larger, key=larger.__getitem__, default=None)
    if size is not None and larger[size] > 1 and _count_boards(images, size, search.target) >= 0.5 * len(images):
        raise TargetNotFoundError(Fact("part-of-larger-board", spec=search.target.spec, columns=size[0], rows=size[1]))


def require_no_likelier_board(search: Search, used: int) -> None:
    """Refuse a checkerboard where a size that is miscounted easily is in more of the images.

    Raises
    ------
    TargetNotFoundError
        That names the likely size.
    """
    if search.target.kind != "checkerboard":
        return
    columns, rows = search.target.columns, search.target.rows
    images = _images_of_hints(search)
    stated = len({s.view for s in search.sightings} & set(images))
    # squares counted for corners first, then lines
    sizes = [(columns + x, rows + y) for x, y in ((-1, -1), (1, 1), (0, -1), (-1, 0), (1, 0), (0, 1))]
    sizes += _largest_of(_vote_on_sizes(images, {}))
    counts = Counter({size: _count_boards(images, size, search.target) for size in sizes if min(size) >= 3})
    likely = next(iter(_largest_of(counts)), None)
    if likely is not None and counts[likely] > max(stated + 1, len(images) // 4):
        raise TargetNotFoundError(
            Fact(
                "other-board-likelier",
                spec=search.target.spec,
                used=used,
                searched=len(search.searched),
                columns=likely[0],
                rows=likely[1],
            )
        )


def _images_of_hints(search: Search) -> dict[int, UInt8Array]:
    """Some of the searched images, by view."""
    picked = np.unique(np.linspace(0, len(search.searched) - 1, _LIMITS.size_views).astype(np.intp))
    images = {search.searched[i]: search.views[search.searched[i]].read() for i in picked.tolist()}
    return {v: image for v, image in images.items() if not isinstance(image, Fact)}


def _vote_on_sizes(images: Mapping[int, UInt8Array], centre: Mapping[int, Array]) -> Counter[tuple[int, int]]:
    """In how many images a board of each size was found, the longer side first.

    ``centre`` holds a point that the board must cover in a view.
    """
    import cv2

    votes: Counter[tuple[int, int]] = Counter()
    for v, image in images.items():
        board = find_any_checkerboard(image)
        if board is None:
            continue
        (columns, rows), xy = board
        hull = cv2.convexHull(xy.astype(np.float32))
        if v not in centre or cv2.pointPolygonTest(hull, centre[v].tolist(), False) >= 0:
            votes[max(columns, rows), min(columns, rows)] += 1
    return votes


def _largest_of(counts: Mapping[tuple[int, int], int]) -> list[tuple[int, int]]:
    """The size that most corners were found of, for parts of a board are in more images than the whole; or none."""
    corners = {(columns, rows): count * columns * rows for (columns, rows), count in counts.items() if count}
    return [max(corners, key=corners.__getitem__)] if corners else []


def _count_boards(images: Mapping[int, UInt8Array], size: tuple[int, int], target: Target) -> int:
    """In how many images a checkerboard of another size is."""
    other = parse_target(f"checkerboard:{size[0]}x{size[1]}:{target.length_m}")
    return sum(bool(detect(image, other)) for image in images.values())


def _hint_at_absence(search: Search) -> Fact:
    if search.target.kind == "aprilgrid":
        return Fact("aprilgrid-in-doubt")
    if search.target.kind != "checkerboard":
        return Fact("target-description-in-doubt")
    votes = _vote_on_sizes(_images_of_hints(search), {})
    stated = max(search.target.columns, search.target.rows), min(search.target.columns, search.target.rows)
    for size in _largest_of(votes):
        # textures and tiles pass for small boards now and then
        if size != stated and votes[size] > 1 and size[0] * size[1] >= _LIMITS.least_board_corners:
            return Fact("other-board-visible", columns=size[0], rows=size[1])
    return Fact("inner-corners")
