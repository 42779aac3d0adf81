"""Goes through the images of a model for a target, and finds out why there is no result where there is none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

from colmap_inertial.checks.validate.detect import detect, other_checkerboard
from colmap_inertial.checks.validate.limits import DETECTION, PLACEMENT
from colmap_inertial.checks.validate.place import PartPlacement, place_part
from colmap_inertial.checks.validate.targets import Target
from colmap_inertial.checks.validate.views import Sighting, View, sight
from colmap_inertial.core.errors import FormatError, NotObservableError, TargetNotFoundError
from colmap_inertial.core.options import ValidateOptions

Progress = Callable[[int, int], None]


class Search:
    """Looks for the target in the images, and for its place in the model."""

    def __init__(self, views: list[View], target: Target, options: ValidateOptions, progress: Progress | None) -> None:
        self.views, self.target, self.options = views, target, options
        self.sightings: list[Sighting] = []
        self.searched: list[int] = []
        self.unreadable: dict[int, str] = {}
        self.parts: dict[int, list[Sighting]] = {}
        self.one_line: NotObservableError | None = None
        self._progress = progress

    def run(self, images: Path) -> None:
        found = 0
        for done, v in enumerate(_spread_evenly(len(self.views))):
            if self._progress is not None:
                self._progress(done, len(self.views))
            self.searched.append(v)
            found += self._search_view(v, thorough=False)
            if found >= self.options.max_views:
                break
        if self._progress is not None:
            self._progress(len(self.views), len(self.views))
        if len(self.unreadable) == len(self.searched):
            first = min(self.unreadable)
            raise FormatError(images / self.views[first].name, self.unreadable[first])

    def look_closer(self, which: list[int]) -> None:
        """Search these views again, thoroughly; what was found there before is forgotten."""
        self.sightings = [s for s in self.sightings if s.view not in which]
        for v in which:
            self._search_view(v, thorough=True)

    def _search_view(self, v: int, *, thorough: bool) -> bool:
        image = self.views[v].read()
        if isinstance(image, str):
            self.unreadable[v] = image
            return False
        found = [sight(v, self.views[v].camera, d) for d in detect(image, self.target, thorough=thorough)]
        found = [s for s in found if len(s.corner) >= DETECTION.least_corners]
        self.sightings += found
        return bool(found)

    def place(self) -> dict[int, PartPlacement]:
        """Where each part of the target is; parts on which no two views agree are left out."""
        self.parts, self.one_line = {}, None
        for s in self.sightings:
            self.parts.setdefault(s.part, []).append(s)
        out = {}
        for part, sightings in sorted(self.parts.items()):
            try:
                placed = place_part(
                    sightings,
                    self.target,
                    self.views,
                    max_residual_px=self.options.max_residual_px,
                    seed=self.options.seed,
                )
            except NotObservableError as error:
                self.one_line = error
                continue
            if placed is not None:
                out[part] = placed
        return out


def _spread_evenly(count: int) -> list[int]:
    """0..count-1 in an order that covers the range evenly however early it is cut off (van der Corput)."""
    bits = max(count - 1, 1).bit_length()
    reverse = [int(f"{i:0{bits}b}"[::-1], 2) for i in range(2**bits)]
    return [i for i in reverse if i < count]


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
        f"(to {search.options.max_residual_px:g} px): false detections, wrong poses, a target that moved between the "
        "images, or images that do not belong to this model"
    )


def _find_mirroring(search: Search) -> str | None:
    """How the images are mirrored against the model, if that explains them."""
    for flip, words in ((1, "left to right"), (0, "top to bottom")):
        again = Search(search.views, search.target, search.options, None)
        for v in search.searched[: PLACEMENT.mirror_views]:
            image = search.views[v].read(flip=flip)
            if isinstance(image, str):
                continue
            found = [sight(v, search.views[v].camera, d) for d in detect(image, search.target)]
            again.sightings += [s for s in found if len(s.corner) >= DETECTION.least_corners]
        if again.place():
            return words
    return None


def _hint_at_absence(search: Search) -> str:
    if search.target.kind != "checkerboard":
        return "is the description right, and is the target large and sharp enough in the images?"
    sizes: Counter[tuple[int, int]] = Counter()
    for v in search.searched[: PLACEMENT.hint_views]:
        image = search.views[v].read()
        size = None if isinstance(image, str) else other_checkerboard(image)
        if size is not None:
            sizes[max(size), min(size)] += 1
    if sizes:
        size = max(sizes, key=sizes.__getitem__)
        if size != tuple(sorted((search.target.columns, search.target.rows), reverse=True)):
            return f"a board with {size[0]}x{size[1]} inner corners is visible: is the size in the description right?"
    return "COLSxROWS counts inner corners, one less than squares; the whole board must be in view, with a white rim"
