"""Why a target has no place in a model: mirrored images, a wrong size of the board, a target that is not there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.checks.validate.detect import DETECTION, detect, find_any_checkerboard
from colmap_inertial.checks.validate.place import Search
from colmap_inertial.checks.validate.targets import Target, parse_target
from colmap_inertial.checks.validate.views import sight
from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.core.errors import FormatError, NotObservableError, TargetNotFoundError


@dataclass(frozen=True, kw_only=True)
class HintLimits:
    """Images that are looked at for a mirrored target, and for a board of another size."""

    mirror_views: int = 20
    size_views: int = 10


_LIMITS = HintLimits()


def explain_failure(search: Search, images: Path) -> Exception:
    """The error that says why there is no result."""
    target, views = search.target, search.views
    seen = sorted({s.view for s in search.sightings})
    mirrored = _find_mirroring(search)
    if mirrored is not None:
        return FormatError(images, f"the images are mirrored {mirrored} against the model: give those it was made from")
    if not seen:
        return TargetNotFoundError(
            f"{target.spec} was not found in any of the {len(search.searched)} images that were searched; "
            + _hint_at_absence(search)
        )
    if len(seen) == 1:
        return NotObservableError(
            "scale",
            f"the target was found in one image only ({views[seen[0]].name}): a length needs it in two images or more, "
            "taken from different places",
        )
    if search.one_line is not None:
        return search.one_line
    return TargetNotFoundError(
        f"{target.spec} was found in {len(seen)} images, but no two of them agree on where it is in the model "
        f"(to {search.options.max_residual_px:g} px): {_REASONS.get(target.kind, _REASONS[''])}, a target that moved "
        "between the images, or images that do not belong to this model"
    )


#: What else than moving places a target that is found in many images nowhere, the likelier first.
_REASONS = {
    "aprilgrid": "columns and rows may be swapped (COLSxROWS of tags), or the tags not numbered row by row from the "
    "lower left one, as kalibr has them; else wrong poses",
    "": "false detections, wrong poses",
}


def _find_mirroring(search: Search) -> str | None:
    """The mirroring of the images against the model that explains the detections, if there is one."""
    for flip, words in ((1, "left to right"), (0, "top to bottom")):
        again = Search(search.views, search.target, search.options, None)
        for v in search.searched[: _LIMITS.mirror_views]:
            image = search.views[v].read(flip=flip)
            if isinstance(image, str):
                continue
            sightings = [sight(v, search.views[v].camera, d) for d in detect(image, search.target)]
            again.sightings += [s for s in sightings if len(s.corner) >= DETECTION.least_corners]
        if again.place():
            return words
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
        raise TargetNotFoundError(
            f"{search.target.spec} is a part of a board with {size[0]}x{size[1]} inner corners: give the size of the "
            "whole board"
        )


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
            f"{search.target.spec} agrees in {used} of {len(search.searched)} images, and a board with "
            f"{likely[0]}x{likely[1]} inner corners is in more of them: COLSxROWS counts inner corners, one less than "
            "squares"
        )


def _images_of_hints(search: Search) -> dict[int, UInt8Array]:
    """Some of the searched images, by view."""
    picked = np.unique(np.linspace(0, len(search.searched) - 1, _LIMITS.size_views).astype(np.intp))
    images = {search.searched[i]: search.views[search.searched[i]].read() for i in picked.tolist()}
    return {v: image for v, image in images.items() if not isinstance(image, str)}


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


def _hint_at_absence(search: Search) -> str:
    if search.target.kind == "aprilgrid":
        return (
            "its tags are those of kalibr, 36h11 from number 0 on with a black border of two bits: are those of yours, "
            "and is the target large and sharp enough in the images?"
        )
    if search.target.kind != "checkerboard":
        return "is the description right, and is the target large and sharp enough in the images?"
    votes = _vote_on_sizes(_images_of_hints(search), {})
    for size in _largest_of(votes):
        if size != tuple(sorted((search.target.columns, search.target.rows), reverse=True)):
            return f"a board with {size[0]}x{size[1]} inner corners is visible: is the size in the description right?"
    return "COLSxROWS counts inner corners, one less than squares; the whole board must be in view, with a white rim"
