"""Choose the pairs of images to match.

Of few images, or of images taken seconds apart: all but those that the gyroscope or a quick comparison excludes. Of a
video: neighbours in time, and returns to a place. A frame that shows what the one before does, as the camera stands
still, is matched with the first of its kind alone. A frame that shares too little with its neighbours to be placed by
them is matched with others farther apart.
"""

from __future__ import annotations

import itertools
import logging
import shutil
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.features.extraction import (
    MatchRecord,
    image_pairs,
    match_pairs,
    matches_every_pair,
    matching_work,
)
from colmap_inertial.colmap.features.given_database import can_match, read_matched_pairs
from colmap_inertial.colmap.loops.search import LoopSearch, find_returns, name_pairs, split_pairs
from colmap_inertial.colmap.views.gyro_orientations import (
    GyroOrientations,
    ImageOrientations,
    estimate_gyro_orientations,
)
from colmap_inertial.colmap.views.relative_track import FramePair, RelativeTrack, estimate_relative_track
from colmap_inertial.colmap.views.two_views import (
    Covisibility,
    compare,
    count_shared,
    count_verified,
    delete_matches,
    read_observations,
    read_ray_pairs,
    read_rotations_rad,
    read_verified_pairs,
)
from colmap_inertial.core.arrays import BoolArray, IndexArray
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.types import CameraModel, FrameTiming
from colmap_inertial.io.recording import Recording

log = logging.getLogger(__name__)


#: Pairs with fewer quick matches are not worth matching: of V1_01, they hold .7 % of the inliers.
_LEAST_QUICK_MATCHES = 4
#: Images so many places apart are matched first, and in any case: the gyroscope is calibrated by them.
_CLOSE = (1, 2, 4)
#: The relative track is estimated by images so many places apart: farther apart, matches may join repeated structure.
_NEXT = 2
#: Where neighbours are matched, those within so many times the overlap are no loop; those up to as many times that are
#: matched, and stay where they pass as one.
_NEAR = 2
#: So many of a frame's features must be joined to two others, or it is matched with more: COLMAP's mapper places an
#: image by 30 points that others show, and not all of the others are in the model by then.
_LEAST_SHARED = 60


@dataclass(frozen=True, eq=False, kw_only=True)
class _Pairs:
    """Pairs of a capture's images: those of the pairing, and those that a given database has matches of.

    Attributes
    ----------
    i, j
        (M,) places in time, the earlier ones first.
    given
        Pairs that have matches already.
    only_given
        Whether no others can be matched, for want of descriptors.
    every
        Whether every pair is there.
    short
        Whether it is not, of a video so short that nothing speaks against it but time.
    near
        Pairs of images no more places apart are neighbours.
    """

    i: IndexArray
    j: IndexArray
    given: Set[FramePair]
    only_given: bool
    every: bool
    short: bool
    near: int

    @classmethod
    def of(cls, database: Path, timing: FrameTiming, options: MappingOptions) -> _Pairs:
        names, t_s = timing.names, timing.t_s
        place = {name: k for k, name in enumerate(names)}
        pairs = [(place[a], place[b]) for a, b in image_pairs(names, options, t_s)]
        given = read_matched_pairs(database, names)
        i, j = split_pairs([*pairs, *sorted(given.difference(pairs))])
        only_given = bool(given) and not can_match(database)
        every, near = matches_every_pair(len(names), options, t_s), _NEAR * options.overlap
        short = options.pairing == "auto" and not every and matches_every_pair(len(names), options)
        return cls(i=i, j=j, given=given, only_given=only_given, every=every, short=short, near=near)

    @property
    def count(self) -> int:
        return len(self.i)

    @cached_property
    def is_given(self) -> BoolArray:
        return np.array([pair in self.given for pair in self.where(np.ones(self.count, np.bool_))], dtype=np.bool_)

    @cached_property
    def close(self) -> BoolArray:
        """(M,) those that are matched first; of all others, ``far`` ones may be loops, and the rest are neighbours."""
        return np.isin(self.j - self.i, _CLOSE) & (self.is_given | (not self.only_given))

    @cached_property
    def far(self) -> BoolArray:
        return ~np.isin(self.j - self.i, _CLOSE) & (self.j - self.i > self.near) & (not self.every)

    @property
    def rest(self) -> BoolArray:
        return ~self.close & ~self.far

    def where(self, which: BoolArray) -> list[FramePair]:
        return list(zip(self.i[which].tolist(), self.j[which].tolist(), strict=True))

    def may_match(self, pair: FramePair) -> bool:
        """Whether a pair has matches, or can be matched."""
        return not self.only_given or pair in self.given


def match_capture(
    features: Path,
    database: Path,
    recording: Recording,
    camera: CameraModel | None,
    options: MappingOptions,
    context: RunContext,
) -> tuple[MatchRecord, ImageOrientations]:
    """Match and verify pairs of a recording's images in a copy of the features' database.

    Images close in time come first: their rotations give the gyroscope's calibration, and with it the orientation of
    all frames. Pairs that look apart are left out then, and where every pair is matched, those whose largest features
    have nothing in common. Of a video, loops are closed. Where the gyroscope contradicts the images, all other pairs
    are matched; but nothing could tell a loop from a copy. Those of a short video are then matched as they are, as
    where every pair is, and those of a longer one are left out.

    Parameters
    ----------
    recording
        Its timing holds the images that have features.
    camera
        Of the images, where it is known.
    options
        Which pairs there are.

    Returns
    -------
    What was matched; orientations of the images, empty where gyroscope and images disagree.
    """
    shutil.copyfile(features, database)
    every_name = recording.timing.names
    covisibility = Covisibility.of(database, every_name)
    still: list[FramePair] = []
    if options.pairing != "exhaustive":
        recording, covisibility, still = _leave_standing_frames(recording, covisibility)
    names = recording.timing.names
    pairs = _Pairs.of(database, recording.timing, options)
    close, beside = pairs.where(pairs.close), pairs.where(pairs.rest)
    first, rest = name_pairs(names, close) + name_pairs(every_name, still), name_pairs(names, beside)
    if not pairs.every:
        # as COLMAP indexes the features of all images anew each time, neighbours are matched in one go
        first, rest = [*first, *rest], []
    done, matched = match_pairs(database, first, context, total=_expect_work(first, rest)), len(first)

    def match(more: Sequence[FramePair]) -> None:
        nonlocal matched, done
        more = [pair for pair in more if pairs.may_match(pair)]
        named = name_pairs(names, more)  # more may come where loops are looked for
        done = match_pairs(database, named, context, done=done, total=done + matching_work(named) + 1)
        matched += len(more)

    counts: dict[str, int] = {}
    sigma_deg = orientations = None
    try:
        orientations = _estimate_orientations(database, recording, close, camera)
    except NotObservableError as error:
        note = f"not used: {error}"
        others, returns = pairs.where(pairs.far & pairs.is_given), []
        if pairs.short:
            returns = find_returns(covisibility, recording.timing.t_s, pairs.near + 1)
            counts = {"returns": len(returns)}
        match([*(beside if pairs.every else []), *sorted({*others, *returns})])
    else:
        note = "the frames turn as the gyroscope does"
        sigma_deg = _largest_sigma_deg(orientations)
        near_pairs, counts = _exclude_pairs(orientations, covisibility if pairs.every else None, pairs)
        loops = pairs.where(pairs.far & pairs.is_given)
        asked = pairs.given if pairs.every else {*pairs.given, *beside}
        delete_matches(database, name_pairs(names, sorted(asked - {*close, *near_pairs, *loops})))
        if pairs.every:
            match(near_pairs)
        else:
            track = _estimate_track(database, names, close, orientations)
            search = LoopSearch(database, names, orientations, track, covisibility, pairs.near + 1, lenient=pairs.short)
            doubtful = pairs.where(pairs.far & (pairs.j - pairs.i <= _NEAR * pairs.near) & ~pairs.is_given)
            counts |= search.close_loops(match, doubtful=doubtful, given=loops).counts()
    if not pairs.every and not pairs.only_given:
        more = _match_poor_frames(database, names, pairs, match, orientations)
        counts["returns"] = counts.get("returns", 0) + sum(j - i > pairs.near for i, j in more)
    context.progress("matches", done, done)
    record = MatchRecord(
        device=context.device if context.executable is None else context.executable.device,
        pairing="exhaustive" if pairs.every else "sequential",
        images=len(every_name),
        pairs=pairs.count + len(still),
        given=len(pairs.given),
        still=len(still),
        far=int(pairs.far.sum()),
        matched=matched,
        verified=count_verified(database),
        gyroscope=note,
        heading_sigma_deg=sigma_deg,
        **counts,
    )
    log.info("matches: %s", record)
    return record, ImageOrientations() if orientations is None else ImageOrientations.of(names, orientations)


def _leave_standing_frames(
    recording: Recording, covisibility: Covisibility
) -> tuple[Recording, Covisibility, list[FramePair]]:
    """The recording, and its features, without frames that show what one before them does; and pairs of the two."""
    anchor = covisibility.find_standing()
    place = np.arange(len(anchor))
    if (anchor == place).all():
        return recording, covisibility, []
    moving = np.flatnonzero(anchor == place)
    still = [(int(anchor[k]), k) for k in np.flatnonzero(anchor != place).tolist()]
    return recording.using(recording.timing.select(moving)), covisibility.only(moving), still


def _expect_work(first: Sequence[tuple[str, str]], rest: Sequence[tuple[str, str]]) -> int:
    """Work of all pairs before it is known how many of the rest are worth matching: 0.6 to 0.8 on desk and EuRoC."""
    return matching_work(first) + round(0.7 * matching_work(rest)) + 1


def _estimate_orientations(
    database: Path, recording: Recording, close: Sequence[FramePair], camera: CameraModel | None
) -> GyroOrientations:
    names = recording.timing.names
    turn_rad = read_rotations_rad(database, names, close)
    return estimate_gyro_orientations(recording, turn_rad, read_ray_pairs(database, names, close), camera)


def _estimate_track(
    database: Path, names: Sequence[str], close: Sequence[FramePair], orientations: GyroOrientations
) -> RelativeTrack:
    next_pairs = [(a, b) for a, b in close if b - a <= _NEXT]
    observations = read_observations(database, names, next_pairs, orientations.start_from_cam)
    return estimate_relative_track(observations, len(names))


def _exclude_pairs(
    orientations: GyroOrientations, covisibility: Covisibility | None, pairs: _Pairs
) -> tuple[list[FramePair], dict[str, int]]:
    """Neighbours that the gyroscope and a quick comparison do not exclude; how many these exclude.

    There is no quick comparison where there is no ``covisibility``, and of pairs that are matched already.
    """
    i, j = pairs.i, pairs.j
    apart, unlike = np.zeros((2, pairs.count), dtype=np.bool_)
    apart[pairs.rest] = orientations.see_nothing_in_common(i[pairs.rest], j[pairs.rest])
    if covisibility is not None:
        asked = pairs.rest & ~apart & ~pairs.is_given
        unlike[asked] = covisibility.are_unlike(i[asked], j[asked], _LEAST_QUICK_MATCHES)
    return pairs.where(pairs.rest & ~apart & ~unlike), {"apart": int(apart.sum()), "unlike": int(unlike.sum())}


def _match_poor_frames(
    database: Path,
    names: Sequence[str],
    pairs: _Pairs,
    match: Callable[[Sequence[FramePair]], None],
    orientations: GyroOrientations | None,
) -> set[FramePair]:
    """Match frames that share too little to be placed with all neighbours; of a short video, with others, too.

    Frames up to twice as far apart come next, as long as that brings more, until enough is shared. Of a longer video it
    ends with the neighbours: nothing could tell others from copies.

    Returns
    -------
    Pairs that were matched and stay.
    """
    reaches = [pairs.near]
    while pairs.short and reaches[-1] < len(names) - 1:
        reaches.append(2 * reaches[-1])
    neighbours = {*pairs.where(pairs.close), *pairs.where(pairs.rest)}
    tried = set(neighbours)
    poor, had = np.arange(len(names)), np.full(len(names), -1)
    for reach in reaches:
        shared = count_shared(database, names, poor)
        wanting = (shared < _LEAST_SHARED) & (shared > had)
        poor, had = poor[wanting], shared[wanting]
        if not len(poor):
            break
        around = {(min(k, o), max(k, o)) for k in poor.tolist() for o in range(max(0, k - reach), k + reach + 1)}
        possible = {(i, j) for i, j in around if i < j < len(names)} - tried - read_matched_pairs(database, names)
        more = sorted(possible)
        if orientations is not None:
            more = list(itertools.compress(more, (~orientations.see_nothing_in_common(*split_pairs(more))).tolist()))
        match(more)
        if orientations is not None:
            _delete_turned_otherwise(database, names, more, orientations)
        tried.update(more)
    return (tried - neighbours) & read_verified_pairs(database, names)


def _delete_turned_otherwise(
    database: Path, names: Sequence[str], matched: Sequence[FramePair], orientations: GyroOrientations
) -> None:
    """Delete the matches of pairs whose rotation contradicts the gyroscope's."""
    rotations = compare(database, name_pairs(names, matched)).first_from_second
    wrong = np.asarray(np.isfinite(rotations).all(axis=(1, 2)), dtype=np.bool_)
    i, j = split_pairs(matched)
    wrong[wrong] = ~orientations.agree(i[wrong], j[wrong], rotations[wrong])
    delete_matches(database, name_pairs(names, list(itertools.compress(matched, wrong.tolist()))))


def _largest_sigma_deg(orientations: GyroOrientations) -> float:
    """Largest standard deviation of the rotation from the middle of the gyroscope's recording to any other frame."""
    recorded = np.flatnonzero(orientations.part >= 0)
    middle = np.full(len(recorded), recorded[len(recorded) // 2])
    known = orientations.known(middle, recorded)
    return float(np.degrees(orientations.sigma_rad(middle, recorded)[known].max(initial=0.0)))
