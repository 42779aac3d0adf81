"""Which parts of a recording become one model, and which stay apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TypeVar

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.geometry import skew, so3_log
from colmap_inertial.core.options import JoinOptions
from colmap_inertial.core.types import Gap, ImuRecording
from colmap_inertial.inertial.join._problem import Ties
from colmap_inertial.inertial.join.doubts import at_most, clocks_differ, most, plainly_apart, times_counted, unlike
from colmap_inertial.inertial.join.links import find_links, find_matched, find_shared
from colmap_inertial.inertial.join.solve import Placed, place
from colmap_inertial.inertial.join.values import Found, Link, MatchedImages, Part, SharedImages, pair_of

Tie = TypeVar("Tie", Link, MatchedImages, SharedImages)

#: Gaps longer than this are not looked at: the IMU alone says nothing of where one is after them.
_LONGEST_S = 60.0
#: So long the IMU may be silent in it (a sample at the end of its range), at the price of a gap.
_LONGEST_SILENT_S = 0.06
#: Numbers of the device that a part tells once more, and those that each link adds: biases and clock.
_ALONE, _ALONE_BY_LINK = 26, 7
#: Numbers that say where a camera is.
_OF_POSE = 6
_OF_THE_IMU = "the two contradict each other about the IMU itself: its biases, gains, or clock changed in between"


@dataclass(frozen=True, eq=False, kw_only=True)
class Together:
    """Parts that become one model.

    Attributes
    ----------
    parts
        Places of the parts; the first one is held.
    placed
        Where they come to lie, in this order.
    shared
        Images whose poses agree, by places within ``parts``.
    matched
        COLMAP's numbers of pairs of parts whose matches helped to place them, the larger part first.
    """

    parts: tuple[int, ...]
    placed: Placed
    shared: tuple[SharedImages, ...]
    matched: frozenset[tuple[int, int]] = frozenset()


@dataclass(frozen=True, eq=False, kw_only=True)
class Joined:
    """What became of all parts.

    Attributes
    ----------
    groups
        Parts that become one model, at least two each.
    gaps
        Between neighbours in time, and parts that share images.
    """

    groups: tuple[Together, ...]
    gaps: tuple[Gap, ...]


def join_parts(parts: Sequence[Part], imu: ImuRecording, limits: JoinOptions, found: Sequence[Found] = ()) -> Joined:
    """Join what can be joined surely enough.

    Two by two first; then the surest pairs bring their groups together, one after the other, where all that ties the
    parts of both suits.

    Parameters
    ----------
    parts
        The largest one first: each joined model has the world of its first part.
    imu
        The recording that ran along, as it was read.
    limits
        Up to where gaps are closed.
    found
        Images of one part that matches place in another. They count beside the IMU, and where they agree with it: what
        looks the same may be a copy.
    """
    if len(parts) < 2:
        return Joined(groups=(), gaps=())
    links, shared, matched = find_links(parts), find_shared(parts), find_matched(parts, found)
    apart = plainly_apart(parts, shared)
    pairs = sorted({pair_of(one) for one in links} | {pair_of(one) for one in shared} | apart.keys())
    # readings that a part's own fit has already do not count again where images say where the other one lies
    both = {pair_of(one) for one in shared}
    usable = [one for one in _unbroken(parts, imu, links) if pair_of(one) not in both or not overlaps(parts, one)]
    gaps: dict[tuple[int, int], Gap] = {}
    groups: dict[int, tuple[int, ...]] = {k: (k,) for k in range(len(parts))}
    trials: dict[tuple[int, ...], Trial] = {}
    against, left_out = set(apart), set[tuple[int, int]]()
    for pair in pairs:
        gap = _gap(parts, pair, [one for one in links if pair_of(one) == pair], _of(shared, pair))
        if pair in apart:
            gaps[pair] = replace(gap, reason=apart[pair])
            continue
        if pair not in both and not _of(usable, pair):
            gaps[pair] = replace(gap, reason=_why_unlinked(parts, imu, _of(links, pair)))
            continue
        trial = trials[pair] = _with_matches(parts, imu, pair, usable, shared, matched)
        gap = replace(gap, matched_images=_count(trial.matched, pair))
        gap = _with_sigmas(replace(gap, chi2=trial.chi2, dof=trial.dof), trial, pair)
        if trial.contradiction:
            # with matches and without: these have no part in it
            against.add(pair)
            gaps[pair] = replace(gap, reason=trial.contradiction)
            continue
        left_out |= trial.left_out
        unsure = _unsure(gap, limits)
        gaps[pair] = replace(gap, joined=not unsure, reason=_with_left_out(unsure or _said(gap), trial, pair))
    for pair in sorted((pair for pair, gap in gaps.items() if gap.joined), key=lambda pair: gaps[pair].sigma_m or 0.0):
        one, other = (groups[k] for k in pair)
        if one == other:
            continue
        members = tuple(sorted(one + other))
        reason = _quarrel(parts, members, against)
        if not reason:
            if members not in trials:
                # what contradicts fewer parts contradicts more of them
                kept = [one for one in matched if pair_of(one) not in left_out]
                trials[members] = _with_matches(parts, imu, members, usable, shared, kept)
            reason = trials[members].contradiction
            if not reason:
                inside = (
                    _with_sigmas(gap, trials[members], k) for k, gap in gaps.items() if gap.joined and k in _in(members)
                )
                reason = next(filter(None, (_unsure(gap, limits) for gap in inside)), "")
            reason = f"with the parts that either is joined to: {reason}" if reason else ""
        if reason:
            gaps[pair] = replace(gaps[pair], joined=False, reason=reason)
        else:
            groups |= dict.fromkeys(members, members)
            left_out |= trials[members].left_out
            trials[members] = replace(trials[members], left_out=frozenset(left_out & _in(members)))
    together = []
    for members in dict.fromkeys(group for group in groups.values() if len(group) > 1):
        trial = trials[members]
        assert trial.placed is not None
        place_of = {k: i for i, k in enumerate(members)}
        images = tuple(one.among(place_of) for one in shared if pair_of(one) in _in(members))
        used = frozenset((parts[a].number, parts[b].number) for a, b in map(pair_of, trial.matched))
        together.append(Together(parts=members, placed=trial.placed, shared=images, matched=used))
        for pair in _in(members) & gaps.keys():
            gap = replace(gaps[pair], matched_images=_count(trial.matched, pair))
            reason = _with_left_out(_said(gap), trial, pair) if gap.joined else "in one model by way of others"
            gaps[pair] = replace(_with_sigmas(gap, trial, pair), joined=True, reason=reason)
    return Joined(groups=tuple(together), gaps=tuple(gaps.values()))


def _of(ties: Sequence[Tie], pair: tuple[int, int]) -> list[Tie]:
    return [one for one in ties if pair_of(one) == pair]


def _in(members: Sequence[int]) -> set[tuple[int, int]]:
    """All pairs of a group."""
    return set(combinations(members, 2))


def _quarrel(parts: Sequence[Part], members: Sequence[int], against: set[tuple[int, int]]) -> str:
    """Which parts of a group contradict each other, in words."""
    found = sorted(_in(members) & against)
    if not found:
        return ""
    numbers = " and ".join(str(parts[k].number) for k in found[0])
    return f"it would bring together models {numbers}, which contradict each other"


def silent_s(parts: Sequence[Part], imu: ImuRecording, link: Link) -> float:
    """How long the IMU was silent between two nodes."""
    streams = Ties.of(imu, (), ()).streams
    ends = [parts[k].path.stamps_s(np.array([node]))[0] for k, node in _ends(link)]
    gyro_s, accel_s = streams.gap_s(np.array(ends))
    return float(max(gyro_s[0], accel_s[0]))


def _ends(link: Link) -> tuple[tuple[int, int], tuple[int, int]]:
    return (link.first, link.from_node), (link.second, link.to_node)


def _unbroken(parts: Sequence[Part], imu: ImuRecording, links: Sequence[Link]) -> list[Link]:
    """Links that the IMU recorded from end to end, of no more than the longest time."""
    near = [one for one in links if _span_s(parts, one) <= _LONGEST_S]
    return [one for one in near if silent_s(parts, imu, one) <= _LONGEST_SILENT_S]


def _span_s(parts: Sequence[Part], link: Link) -> float:
    begin, end = (float(parts[k].path.nodes_s[node]) for k, node in _ends(link))
    return end - begin


def overlaps(parts: Sequence[Part], link: Link) -> bool:
    """Whether one of two parts goes on while the other one's node comes."""
    for (k, node), step in zip(_ends(link), (1, -1), strict=True):
        nodes_s = parts[k].path.nodes_s
        if 0 <= node + step < len(nodes_s):
            away_s = abs(float(nodes_s[node + step] - nodes_s[node]))
            if away_s < 2 * max(float(np.median(np.diff(nodes_s))), _span_s(parts, link)):
                return True
    return False


def _gap(parts: Sequence[Part], pair: tuple[int, int], links: Sequence[Link], shared: Sequence[SharedImages]) -> Gap:
    """What lies between two parts, before it is judged."""
    shortest = min(links, key=lambda one: _span_s(parts, one), default=None)
    (first, second), seconds = pair, 0.0
    if shortest is not None:
        first, second = shortest.first, shortest.second
        before, after = ends_of(parts, shortest).images
        seconds = float(parts[second].trajectory.t_s[after] - parts[first].trajectory.t_s[before])
    if shortest is None or overlaps(parts, shortest):
        begin_s, end_s = (f(float(parts[k].trajectory.t_s[i]) for k in pair) for f, i in ((max, 0), (min, -1)))
        seconds = begin_s - end_s
    return Gap(
        first=parts[first].number,
        second=parts[second].number,
        seconds=seconds,
        shared_images=sum(len(one.in_first) for one in shared),
        joined=False,
        reason="",
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Trial:
    """Some parts placed together.

    Attributes
    ----------
    placed
        ``None`` where they do not come to rest.
    chi2, dof
        Squares that the ties add to what the parts say of each other, and what chance makes of them.
    sigmas
        By pairs of places: standard deviations (m, rad) across the worst tie.
    contradiction
        Why the parts cannot be one model; empty where they can.
    matched
        What of the matches was used, by places of all parts.
    left_out
        Pairs of places whose matches contradict the rest.
    """

    placed: Placed | None
    chi2: float | None
    dof: int | None
    sigmas: Mapping[tuple[int, int], tuple[float, float]]
    contradiction: str
    matched: tuple[MatchedImages, ...] = ()
    left_out: frozenset[tuple[int, int]] = frozenset()


def _with_matches(
    parts: Sequence[Part],
    imu: ImuRecording,
    members: Sequence[int],
    links: Sequence[Link],
    shared: Sequence[SharedImages],
    matched: Sequence[MatchedImages],
) -> Trial:
    """Place some parts by all that ties them and by matches; without those of pairs that contradict the rest."""
    inside = tuple(one for one in matched if pair_of(one) in _in(members))
    if not inside:
        return _tried(parts, imu, members, links, shared)
    trial = _tried(parts, imu, members, links, [*shared, *inside])
    if not trial.contradiction:
        return replace(trial, matched=inside)
    best = _tried(parts, imu, members, links, shared)
    tied = {pair_of(one) for one in links} | {pair_of(one) for one in shared}
    pairs = {pair_of(one) for one in inside}
    if len(pairs) > 1 and not best.contradiction:
        # pairs that were tried by themselves agree with what ties them: they come first, then what shows most
        for pair in sorted(pairs, key=lambda pair: (pair not in tied, -_count(inside, pair), pair)):
            more = (*best.matched, *_of(inside, pair))
            trial = _tried(parts, imu, members, links, [*shared, *more])
            if not trial.contradiction:
                best = replace(trial, matched=more)
    return replace(best, left_out=frozenset(pairs - {pair_of(one) for one in best.matched}))


def _tried(
    parts: Sequence[Part],
    imu: ImuRecording,
    members: Sequence[int],
    links: Sequence[Link],
    shared: Sequence[SharedImages],
) -> Trial:
    """Place some parts by all that ties them, and see whether it agrees."""
    nothing = Trial(placed=None, chi2=None, dof=None, sigmas={}, contradiction="")
    one_of = [parts[k] for k in members]
    place_of = {k: i for i, k in enumerate(members)}
    inside = [one.among(place_of) for one in links if pair_of(one) in _in(members)]
    images = [one.among(place_of) for one in shared if pair_of(one) in _in(members)]
    every: list[Link | SharedImages] = [*inside, *images]
    why = next(filter(None, (unlike(one_of[i], one_of[j]) for i, j in {pair_of(one) for one in every})), "")
    why = why or (_OF_THE_IMU if any(clocks_differ(one_of, one) for one in inside) else "")
    if why:
        return replace(nothing, contradiction=why)
    ties = Ties.of(imu, inside, images)
    before = None
    try:
        before = place(one_of, ties, 0, by_imu=False)
        placed = place(one_of, ties, 0)
    except np.linalg.LinAlgError:
        alone = 0.0 if before is None else before.squares
        why = "what the IMU felt in it fits no place of one in the other"
        if alone > at_most(_alone_dof(len(members), inside)):
            why = _OF_THE_IMU
        return replace(nothing, contradiction=why)
    # heading and place are all that parts do not know of each other
    independent = sum(6 * one.weight * len(one.in_first) for one in images)
    dof = max(1, round(9 * len(inside) + independent) - 4 * (len(members) - 1))
    chi2, alone_dof = max(0.0, placed.squares - before.squares), _alone_dof(len(members), inside)
    placed = replace(placed, inflation=max(1.0, chi2 / dof, before.squares / alone_dof) * times_counted(one_of))
    sigmas: dict[tuple[int, int], tuple[float, float]] = {}
    farthest = 0.0
    misfits = [*placed.misfits, *(_apart(one_of, placed, one) for one in images)]
    for tie, misfit in zip(every, misfits, strict=True):
        cov = ends_of(one_of, tie).cov(one_of, placed)
        farthest = max(farthest, float(misfit @ np.linalg.solve(cov, misfit)))
        pair = (members[pair_of(tie)[0]], members[pair_of(tie)[1]])
        sigmas[pair] = tuple(np.maximum(sigmas.get(pair, (0.0, 0.0)), worst(cov)).tolist())
    why = ""
    if before.squares > at_most(alone_dof):
        why = _OF_THE_IMU
    elif chi2 > at_most(dof):
        why = (
            f"what the IMU felt in it contradicts the motion before and after it ({chi2:.0f} times the squares of one "
            f"standard deviation, where chance makes {dof})"
        )
    elif farthest > most(_OF_POSE):
        why = (
            f"the poses before and after it contradict what the IMU or shared images say of them "
            f"({farthest**0.5:.0f} standard deviations)"
        )
    return Trial(placed=placed, chi2=chi2, dof=dof, sigmas=sigmas, contradiction=why)


def _alone_dof(count: int, links: Sequence[Link]) -> int:
    """What parts say of one device: shared numbers, strength of gravity, and of each link biases and clock."""
    return _ALONE * (count - 1) + _ALONE_BY_LINK * len(links)


def _apart(parts: Sequence[Part], placed: Placed, images: SharedImages) -> Array:
    """(6,) by how much poses of shared images differ as the parts lie: rotation and position, medians."""
    turns, centres = [], []
    for k in (images.first, images.second):
        world_from_cam, places = images.poses(parts, k)
        turns.append(placed.placements[k].rotation @ world_from_cam)
        centres.append(placed.placements[k].points(places))
    twists = so3_log(turns[1] @ turns[0].transpose(0, 2, 1))
    return np.concatenate([np.median(twists, axis=0), np.median(centres[1] - centres[0], axis=0)])


def _with_sigmas(gap: Gap, trial: Trial, pair: tuple[int, int]) -> Gap:
    """With standard deviations as parts lie in a trial."""
    if pair not in trial.sigmas:
        return gap
    sigma_m, sigma_rad = trial.sigmas[pair]
    return replace(gap, sigma_m=sigma_m, sigma_deg=float(np.degrees(sigma_rad)))


def _why_unlinked(parts: Sequence[Part], imu: ImuRecording, links: Sequence[Link]) -> str:
    near = [one for one in links if _span_s(parts, one) <= _LONGEST_S]
    if not near:
        return f"it is longer than {_LONGEST_S:.0f} s"
    return f"the IMU itself recorded nothing for {min(silent_s(parts, imu, one) for one in near):.2f} s of it"


def _said(gap: Gap) -> str:
    by = [f"{gap.shared_images} images that both have"] if gap.shared_images else []
    by += [f"{gap.matched_images} images of one that match the other"] if gap.matched_images else []
    return f"joined by {', '.join(by)}, and the IMU" if by else "joined by the IMU"


def _with_left_out(reason: str, trial: Trial, pair: tuple[int, int]) -> str:
    return f"{reason} (matches between the two contradict it, and are left out)" if pair in trial.left_out else reason


def _count(matched: Sequence[MatchedImages], pair: tuple[int, int]) -> int:
    """How many images of a pair matches placed."""
    return sum(len(one.in_first) for one in _of(matched, pair))


def _unsure(gap: Gap, limits: JoinOptions) -> str:
    """What is not known well enough across a gap; empty where all is."""
    assert gap.sigma_m is not None and gap.sigma_deg is not None
    if gap.sigma_m > limits.sigma_m:
        return (
            f"the position after it is known to {100 * gap.sigma_m:.0f} cm only, and the limit is "
            f"{100 * limits.sigma_m:.3g} cm (--join-options.sigma-m)"
        )
    if gap.sigma_deg > limits.sigma_deg:
        return (
            f"the direction after it is known to {gap.sigma_deg:.1f} degrees only, and the limit is "
            f"{limits.sigma_deg:.3g} (--join-options.sigma-deg)"
        )
    return ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Ends:
    """The images on both sides of a gap.

    Attributes
    ----------
    pair
        Places of the two parts.
    images, nodes
        Of each, which image, and the node next to it.
    """

    pair: tuple[int, int]
    images: tuple[int, int]
    nodes: tuple[int, int]

    def cov(self, parts: Sequence[Part], placed: Placed) -> Array:
        """(6, 6) of the second one's pose as seen from the first: rotation and position, along the world's axes."""
        both, lie = [parts[k] for k in self.pair], [placed.placements[k] for k in self.pair]
        points = [part.trajectory.cam_in_world[i] for part, i in zip(both, self.images, strict=True)]
        cov = relative_cov(parts, placed, points, self.pair)
        here, there = (one.points(point[None])[0] for one, point in zip(lie, points, strict=True))
        for k, (part, one) in enumerate(zip(both, lie, strict=True)):
            by = np.eye(6)
            by[3:, :3] = -skew(there - here) if k == 0 else 0.0  # its own turn swings the other around it
            by = by @ np.kron(np.eye(2), one.rotation)
            cov += by @ part.path.seen_cov(self.nodes[k]) @ by.T
        return cov


def relative_cov(parts: Sequence[Part], placed: Placed, points: Sequence[Array], pair: tuple[int, int]) -> Array:
    """(6, 6) covariance of rotation and position of one part's point as seen from another part's.

    Parameters
    ----------
    points
        (3,) of each of the two, in its own world.
    pair
        Places of the two.
    """
    by, ends = np.zeros((6, 14)), []
    for i, (k, sign) in enumerate(zip(pair, (-1.0, 1.0), strict=True)):
        placement = placed.placements[k]
        at = placement.points(points[i][None])[0]
        arm, column = at - placement.translation_m, 7 * i
        by[:3, column + 1 : column + 4] = sign * np.eye(3)
        by[3:, column] = sign * arm
        by[3:, column + 1 : column + 4] = -sign * skew(arm)
        by[3:, column + 4 : column + 7] = sign * np.eye(3)
        ends.append(at)
    # as seen from the first: its own turn swings the other around it
    by[3:, 1:4] += skew(ends[1] - ends[0])
    by[:3, 1:4] = -np.eye(3)
    rows = np.r_[np.arange(7 * pair[0], 7 * pair[0] + 7), np.arange(7 * pair[1], 7 * pair[1] + 7)]
    cov = by @ placed.cov[np.ix_(rows, rows)] @ by.T
    cov *= placed.inflation
    # lens and accelerometer leave a share of any length, of all parts alike
    between = (ends[1] - ends[0]) * max(parts[k].path.floor_log for k in pair)
    cov[3:, 3:] += np.outer(between, between)
    return np.asarray(cov)


def worst(cov: Array) -> tuple[float, float]:
    """Standard deviations (m, rad) along the worst directions, of a pose's covariance: rotation, position."""
    largest = [float(np.linalg.eigvalsh(cov[part, part])[-1]) for part in (slice(3, 6), slice(0, 3))]
    return largest[0] ** 0.5, largest[1] ** 0.5


def ends_of(parts: Sequence[Part], tie: Link | SharedImages) -> Ends:
    """The images on both sides of a link; or the first one that both have."""
    pair = (tie.first, tie.second)
    times = [parts[k].trajectory.t_s for k in pair]
    if isinstance(tie, SharedImages):
        images = (int(tie.in_first[0]), int(tie.in_second[0]))
        at_s = [float(t_s[i]) for t_s, i in zip(times, images, strict=True)]
        near = [int(np.argmin(np.abs(parts[k].path.nodes_s - t_s))) for k, t_s in zip(pair, at_s, strict=True)]
        return Ends(pair=pair, images=images, nodes=(near[0], near[1]))
    begin_s, end_s = (float(parts[k].path.nodes_s[node]) for k, node in _ends(tie))
    middle_s = 0.5 * (begin_s + end_s)
    last = int(np.searchsorted(times[0], middle_s, side="right")) - 1
    return Ends(pair=pair, images=(last, int(np.searchsorted(times[1], middle_s))), nodes=(tie.from_node, tie.to_node))
