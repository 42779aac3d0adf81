"""Which pairs of a capture's images are matched: not those that the gyroscope or a quick comparison excludes."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.colmap.gyro_orientations import GyroOrientations, estimate_gyro_orientations
from colmap_inertial.colmap.loops import LoopSearch, name_pairs, split_pairs
from colmap_inertial.colmap.relative_track import RelativeTrack, estimate_relative_track
from colmap_inertial.colmap.sparse import image_pairs, match_pairs, matches_every_pair
from colmap_inertial.colmap.two_views import (
    Covisibility,
    FramePair,
    count_verified,
    read_observations,
    read_ray_pairs,
    read_rotations_rad,
)
from colmap_inertial.core.arrays import BoolArray, IndexArray
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.types import CameraModel
from colmap_inertial.pipeline.run.context import Recording, RunContext

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


@dataclass(frozen=True, kw_only=True)
class MatchRecord:
    """Pairs that were matched, and why not the rest.

    Attributes
    ----------
    device
        What extracted and matched features: ``"cpu"`` or ``"cuda"``.
    pairing
        ``"exhaustive"`` or ``"sequential"``.
    images, pairs
        How many there are, and pairs by the pairing.
    far
        Pairs of neighbours far apart in time that were left out, or matched only as candidates for loops: loops are
        sought in their place, where the gyroscope can be used.
    apart
        Pairs that were excluded: by the gyroscope the camera looked elsewhere.
    unlike
        Pairs that were excluded: their largest features show nothing in common.
    loops_compared
        Pairs of frames about a second apart and far apart in time whose largest features were compared, as neither the
        gyroscope nor the relative track excludes them.
    loop_candidates
        Pairs that were matched as they may close a loop.
    loops_refused
        Of these, pairs that COLMAP verified and that were left out: their matches cover too little of both pictures,
        contradict the gyroscope's rotation, the relative track, or other loops, or no pair beside them agrees.
    loops_closed
        Of these, pairs that stay.
    matched, verified
        Pairs that were matched, and those of them whose matches COLMAP verified.
    gyroscope
        How its heading was used, or why not.
    heading_sigma_deg
        Largest standard deviation of the heading between two frames; ``None`` where it was not used.
    """

    device: str
    pairing: str
    images: int
    pairs: int
    far: int = 0
    apart: int = 0
    unlike: int = 0
    loops_compared: int = 0
    loop_candidates: int = 0
    loops_refused: int = 0
    loops_closed: int = 0
    matched: int
    verified: int
    gyroscope: str
    heading_sigma_deg: float | None = None


def match_capture(
    features: Path,
    database: Path,
    recording: Recording,
    camera: CameraModel | None,
    options: MappingOptions,
    context: RunContext,
) -> MatchRecord:
    """Match and verify pairs of a recording's images in a copy of the features' database.

    Images close in time come first: their rotations give the gyroscope's calibration, and with it the orientation of
    all frames. Pairs that look apart are left out then, and where every pair is matched, those whose largest features
    have nothing in common. Of a capture too long for every pair, loops are closed. Where the gyroscope contradicts the
    images, all other pairs are matched; but nothing could tell a loop from a copy, and so none is closed.

    Parameters
    ----------
    recording
        Its timing holds the images that have features.
    camera
        Of the images, where it is known.
    options
        Which pairs there are.
    """
    shutil.copyfile(features, database)
    names = recording.timing.names
    pairs = image_pairs(names, options)
    every_pair = matches_every_pair(len(names), options)
    place = {name: k for k, name in enumerate(names)}
    i, j = split_pairs([(place[a], place[b]) for a, b in pairs])
    is_close, near = np.isin(j - i, _CLOSE), _NEAR * options.overlap
    far = ~is_close & (j - i > near) & (not every_pair)
    rest = ~is_close & ~far
    close = _list_pairs(i, j, is_close)
    match_pairs(database, name_pairs(names, close), context, total=len(pairs))
    matched = len(close)

    def match(more: Sequence[FramePair]) -> None:
        nonlocal matched
        total = max(len(pairs), matched + len(more))
        match_pairs(database, name_pairs(names, more), context, done=total - len(more), total=total)
        matched += len(more)

    counts: dict[str, int] = {}
    sigma_deg = None
    try:
        orientations = _estimate_orientations(database, recording, close, camera)
    except NotObservableError as error:
        note = f"not used: {error}"
        match(_list_pairs(i, j, rest))
    else:
        note = "the frames turn as the gyroscope does"
        sigma_deg = _largest_sigma_deg(orientations)
        covisibility = Covisibility.of(database, names)
        near_pairs, counts = _exclude_pairs(orientations, covisibility if every_pair else None, (i[rest], j[rest]))
        if every_pair:
            match(near_pairs)
        else:
            track = _estimate_track(database, names, close, orientations)
            search = LoopSearch(database, names, orientations, track, covisibility, near + 1)
            doubtful = _list_pairs(i, j, far & (j - i <= _NEAR * near))
            counts |= search.close_loops(match, doubtful=doubtful, neighbours=near_pairs).counts()
    record = MatchRecord(
        device=context.device,
        pairing="exhaustive" if every_pair else "sequential",
        images=len(names),
        pairs=len(pairs),
        far=int(far.sum()),
        matched=matched,
        verified=count_verified(database),
        gyroscope=note,
        heading_sigma_deg=sigma_deg,
        **counts,
    )
    log.info("matches: %s", record)
    return record


def _estimate_orientations(
    database: Path, recording: Recording, close: Sequence[FramePair], camera: CameraModel | None
) -> GyroOrientations:
    names = recording.timing.names
    turn_rad = read_rotations_rad(database, names)
    return estimate_gyro_orientations(recording, turn_rad, read_ray_pairs(database, names, close), camera)


def _estimate_track(
    database: Path, names: Sequence[str], close: Sequence[FramePair], orientations: GyroOrientations
) -> RelativeTrack:
    next_pairs = [(a, b) for a, b in close if b - a <= _NEXT]
    observations = read_observations(database, names, next_pairs, orientations.start_from_cam)
    return estimate_relative_track(observations, len(names))


def _exclude_pairs(
    orientations: GyroOrientations, covisibility: Covisibility | None, pairs: tuple[IndexArray, IndexArray]
) -> tuple[list[FramePair], dict[str, int]]:
    """Pairs that the gyroscope and, where given, a quick comparison do not exclude; how many these exclude."""
    i, j = pairs
    apart = orientations.see_nothing_in_common(i, j)
    unlike = np.zeros(len(i), dtype=np.bool_)
    if covisibility is not None:
        unlike[~apart] = covisibility.are_unlike(i[~apart], j[~apart], _LEAST_QUICK_MATCHES)
    return _list_pairs(i, j, ~apart & ~unlike), {"apart": int(apart.sum()), "unlike": int(unlike.sum())}


def _list_pairs(i: IndexArray, j: IndexArray, which: BoolArray) -> list[FramePair]:
    return list(zip(i[which].tolist(), j[which].tolist(), strict=True))


def _largest_sigma_deg(orientations: GyroOrientations) -> float:
    """Largest standard deviation of the rotation from the middle of the gyroscope's recording to any other frame."""
    recorded = np.flatnonzero(orientations.part >= 0)
    middle = np.full(len(recorded), recorded[len(recorded) // 2])
    known = orientations.known(middle, recorded)
    return float(np.degrees(orientations.sigma_rad(middle, recorded)[known].max(initial=0.0)))
