"""Which pairs of a capture's images are matched: not those that the gyroscope or a cheap look rules out."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_inertial.colmap.covisibility import Covisibility
from colmap_inertial.colmap.gyro_orientations import GyroOrientations, estimate_gyro_orientations
from colmap_inertial.colmap.loops import close_loops
from colmap_inertial.colmap.relative_track import estimate_relative_track
from colmap_inertial.colmap.sparse import image_pairs, match_pairs, matches_every_pair
from colmap_inertial.colmap.two_views import count_verified, ray_pairs, sightings_of, turns_rad
from colmap_inertial.core.arrays import IndexArray
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.core.types import CameraModel
from colmap_inertial.pipeline.run.context import Recording, RunContext

log = logging.getLogger(__name__)


#: Pairs with fewer votes are not worth matching: of V1_01, they hold .7 % of the inliers.
_LEAST_VOTES = 4
#: Images so many places apart are matched first, and in any case: the gyroscope is calibrated by them.
_CLOSE = (1, 2, 4)
#: The way is found by images so many places apart: farther apart, some join copies of what is there many times.
_NEXT = 2
#: Where neighbours are matched, those within so many times the overlap are no loop; those up to as many times that are
#: matched, and stay where they pass as one.
_NEAR = 2


@dataclass(frozen=True, kw_only=True)
class MatchRecord:
    """What was matched, and why not the rest.

    Attributes
    ----------
    device
        What found and matched features: ``"cpu"`` or ``"cuda"``.
    pairing
        ``"exhaustive"`` or ``"sequential"``.
    images, pairs
        How many there are, and pairs by the pairing.
    far
        Pairs of neighbours far apart in time that were left out, or matched only as candidates for loops: loops are
        sought in their place, where the gyroscope is of use.
    apart
        Pairs that were ruled out as the gyroscope says that the camera looked elsewhere.
    unlike
        Pairs that were ruled out as their largest features show nothing in common.
    loops_compared
        Pairs of frames about a second apart and far apart in time whose largest features were compared, as neither the
        gyroscope nor the way rules them out.
    loop_candidates
        Pairs that were matched as they may close a loop.
    loops_refused
        Of these, pairs that COLMAP verified and that were left out: their matches cover too little of both pictures,
        turn the camera otherwise than the gyroscope, bring it elsewhere than the way does, contradict other loops, or
        stand alone.
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

    Images close in time come first: how the camera turned between them gives the gyroscope's calibration, and with it
    the heading of all frames. Pairs that look apart are left out then, and where every pair is matched, those whose
    largest features have nothing in common. Of a capture too long for every pair, loops are closed. Where the gyroscope
    does not turn as the images do, all other pairs are matched; but nothing could tell a loop from a copy, and so none
    is closed.

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
    place = {name: index for index, name in enumerate(names)}
    close = [(place[a], place[b]) for a, b in pairs if place[b] - place[a] in _CLOSE]
    match_pairs(database, [(names[a], names[b]) for a, b in close], context, total=len(pairs))
    every_pair = matches_every_pair(len(names), options)
    kept: dict[str, int] = {}
    sigma_deg = None
    i, j = _places([pair for pair in pairs if place[pair[1]] - place[pair[0]] not in _CLOSE], place)
    near = _NEAR * options.overlap
    far = np.zeros(len(i), dtype=np.bool_) if every_pair else j - i > near
    next_to_near = far & (j - i <= _NEAR * near)
    doubtful = list(zip(i[next_to_near].tolist(), j[next_to_near].tolist(), strict=True))
    i, j = i[~far], j[~far]
    headings: GyroOrientations | None = None
    try:
        turn_rad = turns_rad(database, names)
        headings = estimate_gyro_orientations(recording, turn_rad, ray_pairs(database, names, close), camera)
    except NotObservableError as error:
        note = f"not used: {error}"
    else:
        note = "the frames turn as the gyroscope does"
        sigma_deg = _widest_deg(headings)
        away = headings.see_nothing_in_common(i, j)
        i, j = i[~away], j[~away]
        voters = Covisibility.of(database, names)
        alike = np.ones(len(i), dtype=np.bool_)
        if every_pair:
            alike = (voters.count(i, j) >= _LEAST_VOTES) | ~(voters.plenty[i] & voters.plenty[j])
        i, j = i[alike], j[alike]
        kept = {"apart": int(away.sum()), "unlike": int((~alike).sum())}
    matched = len(close)

    def match(more: Sequence[tuple[int, int]]) -> None:
        nonlocal matched
        total = max(len(pairs), matched + len(more))
        match_pairs(database, [(names[a], names[b]) for a, b in more], context, done=total - len(more), total=total)
        matched += len(more)

    rest = list(zip(i.tolist(), j.tolist(), strict=True))
    if headings is None or every_pair:
        match(rest)
    else:
        next_ones = [pair for pair in close if pair[1] - pair[0] <= _NEXT]
        way = estimate_relative_track(sightings_of(database, names, next_ones, headings.start_from_cam), len(names))
        loops = close_loops(
            database, names, headings, way, voters, near + 1, doubtful=doubtful, neighbours=rest, match=match
        )
        kept |= {
            "loops_compared": loops.compared,
            "loop_candidates": loops.candidates,
            "loops_refused": loops.refused,
            "loops_closed": len(loops.closed),
        }
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
        **kept,
    )
    log.info("matches: %s", record)
    return record


def _places(pairs: Sequence[tuple[str, str]], place: dict[str, int]) -> tuple[IndexArray, IndexArray]:
    found = np.array([(place[a], place[b]) for a, b in pairs], dtype=np.intp).reshape(-1, 2)
    return found[:, 0], found[:, 1]


def _widest_deg(headings: GyroOrientations) -> float:
    """How unsure the heading is from the middle of what the gyroscope recorded to any other frame."""
    recorded = np.flatnonzero(headings.part >= 0)
    middle = np.full(len(recorded), recorded[len(recorded) // 2])
    known = headings.known(middle, recorded)
    return float(np.degrees(headings.sigma_rad(middle, recorded)[known].max(initial=0.0)))
