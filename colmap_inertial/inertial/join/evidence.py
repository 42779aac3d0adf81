"""Constraints between submodels of a recording, and evidence against one device and one recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, Int64Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import so3_log
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.inertial.core.parameters import DRIFT_S
from colmap_inertial.inertial.core.preintegration import SensorStreams
from colmap_inertial.inertial.core.priors import PRIORS
from colmap_inertial.inertial.join.placement import LEAST_STAMP_S, FittedSubmodel, ImuLink
from colmap_inertial.inertial.scale import posterior as post
from colmap_inertial.model.submodels.graph import Pair, SimilarityConstraint, pair_of
from colmap_inertial.model.submodels.matches import PlacedImages


@dataclass(frozen=True, kw_only=True)
class EvidenceLimits:
    """Limits for evidence between two submodels of a recording."""

    #: Links between the same two: the shortest ones; more say little beyond.
    links: int = 4
    #: Longer gaps are not looked at: the IMU alone says nothing of where one is after them.
    longest_s: float = 60.0
    #: So long the IMU may be silent in a gap (a sample at the end of its range), at the price of a gap.
    silent_s: float = 0.06
    #: So many images are believed, more than half of which agree ...
    images: int = 3
    #: ... to so many times their median error ...
    agree: float = 5.0
    #: ... or to errors that images hardly fall below.
    least_rad: float = 1e-3
    least_m: float = 5e-3
    #: Images that matches place far from where submodels meet have the bends of both between, which last for seconds:
    #: as far apart as shared images may be, one bend would count dozens of times.
    matched_alike_s: float = 4.0
    #: Models that share more of the smaller one's images than this are not pieces of one.
    most_shared: float = 0.8
    #: Submodels contradict each other where chance makes what they differ by no oftener than so many standard
    #: deviations ...
    sigmas: float = 4.0
    #: ... of squares that are this many times larger in real recordings than noise makes them.
    allowance: float = 2.0


LIMITS = EvidenceLimits()
#: Numbers that say how the camera is mounted: the last of a posterior.
MOUNTING = 6


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """Submodels of one recording, and all that ties them together.

    Attributes
    ----------
    submodels
        The largest one first.
    streams
        Readings by the stamps of the gyroscope, the accelerometer's own delay left to the submodels.
    links
        The IMU from any node to the next one in time, where that belongs to another submodel.
    usable
        Those that the IMU recorded from end to end, and that no fit has already.
    shared, matched
        Constraints by images that two have both, and by images of one that matches place in the other.
    incompatible
        Pairs that cannot be one model whatever the IMU says, and why.
    """

    submodels: Sequence[FittedSubmodel]
    streams: SensorStreams
    links: tuple[ImuLink, ...]
    usable: tuple[ImuLink, ...]
    shared: tuple[SimilarityConstraint, ...]
    matched: tuple[SimilarityConstraint, ...]
    incompatible: dict[Pair, Fact]

    @classmethod
    def of(
        cls, submodels: Sequence[FittedSubmodel], imu: ImuRecording, placed_images: Sequence[PlacedImages] = ()
    ) -> Evidence:
        """All evidence of a recording as it was read."""
        links, shared = find_links(submodels), find_shared(submodels)
        streams = SensorStreams.from_recording(imu, imu.gyro_t_s, imu.accel_t_s)
        by_images = {pair_of(constraint) for constraint in shared}
        usable = [
            link
            for link in links
            if link.seconds(submodels) <= LIMITS.longest_s
            and silent_s(submodels, streams, link) <= LIMITS.silent_s
            # readings that a fit has already do not count again where images say where the other one lies
            and (pair_of(link) not in by_images or not overlaps(submodels, link))
        ]
        return cls(
            submodels=submodels,
            streams=streams,
            links=tuple(links),
            usable=tuple(usable),
            shared=tuple(shared),
            matched=tuple(find_matched(submodels, placed_images)),
            incompatible=incompatible_pairs(submodels, shared),
        )


def find_links(submodels: Sequence[FittedSubmodel]) -> list[ImuLink]:
    """The IMU from any node to the next one in time, where that belongs to another submodel."""
    t_s = np.concatenate([submodel.path.nodes_s for submodel in submodels])
    nodes = [(k, node) for k, submodel in enumerate(submodels) for node in range(len(submodel.path.nodes_s))]
    links_of: dict[Pair, list[tuple[float, ImuLink]]] = {}
    for i, j in pairwise(np.argsort(t_s, kind="stable").tolist()):
        (a, from_node), (b, to_node) = nodes[i], nodes[j]
        if a != b and t_s[j] > t_s[i]:
            link = ImuLink(first=a, second=b, from_node=from_node, to_node=to_node)
            links_of.setdefault(pair_of(link), []).append((float(t_s[j] - t_s[i]), link))
    return [
        link
        for links in links_of.values()
        for _, link in sorted(links, key=lambda submodel: submodel[0])[: LIMITS.links]
    ]


def find_shared(submodels: Sequence[FittedSubmodel]) -> list[SimilarityConstraint]:
    """Constraints by images that two submodels have both, without those that contradict most of the others."""
    out = []
    for (a, first), (b, other) in combinations(enumerate(submodels), 2):
        place = {name: i for i, name in enumerate(other.trajectory.names)}
        both = [(i, place[name]) for i, name in enumerate(first.trajectory.names) if name in place]
        images = np.array(both, dtype=np.int64).reshape(-1, 2)
        poses = [_poses(submodels[k], images[:, i]) for i, k in enumerate((a, b))]
        out.append(_constraint(submodels, (a, b), images, (poses[0], poses[1]), first.trajectory.t_s[images[:, 0]]))
    return [constraint for constraint in out if constraint is not None]


def find_matched(
    submodels: Sequence[FittedSubmodel], placed_images: Sequence[PlacedImages]
) -> list[SimilarityConstraint]:
    """Constraints by images of one submodel that matches place in another."""
    place_of, out = {item.number: k for k, item in enumerate(submodels)}, []
    for placed in placed_images:
        if placed.first not in place_of or placed.second not in place_of:
            continue
        k, own = place_of[placed.first], place_of[placed.second]
        places, own_places = ({name: i for i, name in enumerate(submodels[j].trajectory.names)} for j in (k, own))
        there = [i for i, name in enumerate(placed.names) if name in own_places and placed.beside[i] in places]
        both = [(places[placed.beside[i]], own_places[placed.names[i]]) for i in there]
        images = np.array(both, dtype=np.int64).reshape(-1, 2)
        poses = (placed.world_from_cam[there], placed.cam_in_world[there]), _poses(submodels[own], images[:, 1])
        t_s = submodels[own].trajectory.t_s[images[:, 1]]
        constraint = _constraint(submodels, (k, own), images, poses, t_s, alike_s=LIMITS.matched_alike_s)
        if constraint is not None:
            out.append(constraint)
    # one's images in the other and the other's in it are the same matches, read twice
    times = Counter(pair_of(item) for item in out)
    return [item.weighted(1 / times[pair_of(item)]) for item in out]


def _poses(submodel: FittedSubmodel, images: Int64Array) -> tuple[Array, Array]:
    """(n, 3, 3) world_from_cam and (n, 3) centres of some images."""
    return submodel.world_from_cam[images], submodel.trajectory.cam_in_world[images]


def _constraint(
    submodels: Sequence[FittedSubmodel],
    places: tuple[int, int],
    images: Int64Array,
    poses: tuple[tuple[Array, Array], tuple[Array, Array]],
    t_s: Array,
    *,
    alike_s: float = DRIFT_S,
) -> SimilarityConstraint | None:
    """The similarity by poses of n images in two submodels; ``None`` where too few of them agree."""
    if len(images) < LIMITS.images:
        return None
    (turned, centres), (own, own_centres) = poses
    rotations = turned @ own.transpose(0, 2, 1)
    agree, middle = _agreeing(rotations, centres, own_centres)
    count = int(agree.sum())
    if count < max(LIMITS.images, len(images) / 2 + 1e-9):
        return None
    # errors of images a few hundredths of a second apart are alike
    weight = min(count, 1 + float(np.ptp(t_s[agree])) / alike_s) / count
    paths = [submodels[k].path for k in places]
    rotation_sigma, centre_sigma = np.sqrt(np.sum([path.seen_variances for path in paths], axis=0) / weight)
    return SimilarityConstraint.fitted(
        *places,
        (centres[agree] - paths[0].origin, own_centres[agree] - paths[1].origin),
        float(centre_sigma),
        start=(1.0, middle),
        rotations=(rotations[agree], float(rotation_sigma)),
        images=images[agree],
        equations=6 * weight * count,
    )


def _agreeing(rotations: Array, centres: Array, own_centres: Array) -> tuple[BoolArray, Array]:
    """(n,) which of n images lie in two submodels as most of them do, and (3, 3) the rotation between the two."""
    angles = [np.linalg.norm(so3_log(rotation.T @ rotations), axis=1) for rotation in rotations]
    middle = int(np.argmin([np.median(of_one) for of_one in angles]))
    away = centres - own_centres @ rotations[middle].T
    offsets = np.linalg.norm(away - np.median(away, axis=0), axis=1)
    agree = [
        errors < LIMITS.agree * max(float(np.median(errors)), least)
        for errors, least in ((angles[middle], LIMITS.least_rad), (offsets, LIMITS.least_m))
    ]
    return agree[0] & agree[1], rotations[middle]


def silent_s(submodels: Sequence[FittedSubmodel], streams: SensorStreams, link: ImuLink) -> float:
    """Duration of the IMU's gaps between two nodes."""
    ends = [submodels[k].path.stamps_s(np.array([node]))[0] for k, node in link.ends]
    return float(max(gap_s[0] for gap_s in streams.gap_s(np.array(ends))))


def overlaps(submodels: Sequence[FittedSubmodel], link: ImuLink) -> bool:
    """Whether one of two submodels goes on while the other one's node comes."""
    for (k, node), step in zip(link.ends, (1, -1), strict=True):
        nodes_s = submodels[k].path.nodes_s
        if 0 <= node + step < len(nodes_s):
            away_s = abs(float(nodes_s[node + step] - nodes_s[node]))
            if away_s < 2 * max(float(np.median(np.diff(nodes_s))), link.seconds(submodels)):
                return True
    return False


def incompatible_pairs(submodels: Sequence[FittedSubmodel], shared: Sequence[SimilarityConstraint]) -> dict[Pair, Fact]:
    """Reasons why pairs of submodels cannot be one model, whatever the IMU measured."""
    agree, out = {pair_of(constraint) for constraint in shared}, {}
    for (a, first), (b, other) in combinations(enumerate(submodels), 2):
        both = len(set(first.trajectory.names) & set(other.trajectory.names))
        if first.cameras and other.cameras and not first.cameras & other.cameras:
            out[a, b] = Fact("other-cameras")
        elif both > LIMITS.most_shared * min(len(first.trajectory.names), len(other.trajectory.names)):
            out[a, b] = Fact("same-part-twice", images=both)
        elif both >= LIMITS.images and (a, b) not in agree:
            out[a, b] = Fact("shared-images-disagree", images=both)
    return out


def mounting_differs(first: FittedSubmodel, second: FittedSubmodel) -> bool:
    """Whether the relative pose of camera and IMU differs between two submodels."""
    (a, b), at = (submodel.path.at(np.array([0])) for submodel in (first, second)), np.r_[-MOUNTING:0]
    away = np.concatenate([so3_log(a.cam_from_imu @ b.cam_from_imu.T), a.imu_in_cam_m - b.imu_in_cam_m])
    cov = a.cov[np.ix_(at, at)] + b.cov[np.ix_(at, at)]
    return float(away @ np.linalg.solve(cov, away)) > chi2_limit(MOUNTING, real=True)


def clocks_differ(submodels: Sequence[FittedSubmodel], link: ImuLink) -> bool:
    """Whether the clocks of IMU and camera disagree between two nodes by more than chance."""
    away_s, variance = 0.0, (PRIORS.clock_rate * link.seconds(submodels)) ** 2 + LEAST_STAMP_S**2
    for sign, (k, node) in zip((-1, 1), link.ends, strict=True):
        fit = submodels[k].path.at(np.array([node]))
        own = post.NODE + np.array([post.DELAY, post.CLOCK_RATE])
        by = np.array([1.0, float(fit.since_middle_s[0])])
        variance += float(by @ fit.cov[np.ix_(own, own)] @ by)
        away_s += sign * float(fit.stamp_s[0] - fit.t_s[0])
    return away_s**2 / variance > chi2_limit(1, real=True)


def times_counted(submodels: Sequence[FittedSubmodel]) -> float:
    """How often readings are counted: those of an overlap in time are in each fit."""
    spans = sorted((float(submodel.path.nodes_s[0]), float(submodel.path.nodes_s[-1])) for submodel in submodels)
    covered_s, reached_s = 0.0, -np.inf
    for begin_s, end_s in spans:
        covered_s += max(0.0, end_s - max(begin_s, reached_s))
        reached_s = max(reached_s, end_s)
    return sum(end_s - begin_s for begin_s, end_s in spans) / covered_s


def chi2_limit(dof: int, *, real: bool) -> float:
    """Upper limit of a sum of normalised squares by chance; ``real``: in real recordings.

    By Wilson and Hilferty's root: the third root of chi-square is next to normal.
    """
    share = 2 / (9 * dof)
    limit = float(dof * (1 - share + LIMITS.sigmas * share**0.5) ** 3)
    return LIMITS.allowance * limit if real else limit
