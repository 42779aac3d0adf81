"""Decide which submodels of a recording become one model."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import JoinOptions
from colmap_inertial.core.types import Gap, ImuRecording
from colmap_inertial.inertial.join.evidence import (
    LIMITS,
    Evidence,
    chi2_limit,
    clocks_differ,
    mounting_differs,
    overlaps,
    silent_s,
    times_counted,
)
from colmap_inertial.inertial.join.placement import FittedSubmodel, ImuLink, Placed, Problem, place_submodels
from colmap_inertial.inertial.join.relative_poses import JoinedGroup, end_images, tie_cov, worst_sigmas
from colmap_inertial.model.submodels.graph import Pair, SimilarityConstraint, among, pair_of
from colmap_inertial.model.submodels.matches import PlacedImages

#: Numbers of the device that each further submodel measures again, and those that each link adds: biases and clock.
DEVICE_DOF, LINK_DOF = 26, 7
#: Numbers that say where a camera is.
POSE_DOF = 6


@dataclass(frozen=True, eq=False, kw_only=True)
class Joined:
    """The submodels as they were joined.

    Attributes
    ----------
    groups
        Submodels that become one model, at least two each.
    gaps
        Between neighbours in time, and submodels that share images.
    """

    groups: tuple[JoinedGroup, ...] = ()
    gaps: tuple[Gap, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Trial:
    """Some submodels placed together.

    Attributes
    ----------
    placed
        ``None`` where they do not converge.
    chi2, dof
        Squares that the constraints add to what the submodels say of each other, and what chance makes of them.
    sigmas
        By pairs of places: standard deviations (m, rad) across the worst constraint.
    contradiction
        Why the submodels cannot be one model; ``None`` where they can.
    matched
        What of the matches was used, by places of all submodels.
    left_out
        Pairs of places whose matches contradict the rest.
    """

    placed: Placed | None = None
    chi2: float | None = None
    dof: int | None = None
    sigmas: Mapping[Pair, tuple[float, float]] = field(default_factory=dict)
    contradiction: Fact | None = None
    matched: tuple[SimilarityConstraint, ...] = ()
    left_out: frozenset[Pair] = frozenset()

    def describe(self, gap: Gap, pair: Pair) -> Gap:
        """A gap with its standard deviations and matches as submodels lie in this trial."""
        gap = replace(gap, matched_images=_count_images(self.matched, pair))
        if pair not in self.sigmas:
            return gap
        sigma_m, sigma_rad = self.sigmas[pair]
        return replace(gap, sigma_m=sigma_m, sigma_deg=float(np.degrees(sigma_rad)))

    def reason(self, gap: Gap, pair: Pair, why_not: Fact | None = None) -> Fact:
        """Reason why a gap was joined, or why it was not."""
        joined = Fact("gap-joined", shared_images=gap.shared_images, matched_images=gap.matched_images)
        reason = why_not or joined
        return Fact("gap-matches-left-out", reason=reason) if pair in self.left_out else reason


class _Judgement:
    """Gaps and trials as they are judged, two submodels at a time and then group by group."""

    def __init__(self, evidence: Evidence, limits: JoinOptions) -> None:
        self.evidence, self.limits = evidence, limits
        self.gaps: dict[Pair, Gap] = {}
        self.trials: dict[tuple[int, ...], Trial] = {}
        self.against = set(evidence.incompatible)
        self.left_out: set[Pair] = set()

    def judge_pair(self, pair: Pair) -> None:
        """Judge the gap between two submodels by themselves."""
        evidence, gap = self.evidence, _gap(self.evidence, pair)
        if pair in evidence.incompatible:
            gap = replace(gap, reason=evidence.incompatible[pair])
        elif not _select_ties(evidence.shared, pair) and not _select_ties(evidence.usable, pair):
            gap = replace(gap, reason=_why_unlinked(evidence, pair))
        else:
            trial = self.trials[pair] = _try_with_matches(evidence, pair, evidence.matched)
            gap = trial.describe(replace(gap, chi2=trial.chi2, dof=trial.dof), pair)
            if trial.contradiction is not None:
                # with matches and without: these have no part in it
                self.against.add(pair)
                gap = replace(gap, reason=trial.contradiction)
            else:
                self.left_out |= trial.left_out
                unsure = _unsure(gap, self.limits)
                gap = replace(gap, joined=unsure is None, reason=trial.reason(gap, pair, unsure))
        self.gaps[pair] = gap

    def try_group(self, members: tuple[int, ...]) -> Fact | None:
        """Place a group of more than two; why it cannot be one model, ``None`` where it can."""
        pairs = set(combinations(members, 2))
        if against := sorted(pairs & self.against):
            first, second = (self.evidence.submodels[k].number for k in against[0])
            return Fact("group-contradicts", first=first, second=second)
        if members not in self.trials:
            # what contradicts fewer submodels contradicts more of them
            kept = [constraint for constraint in self.evidence.matched if pair_of(constraint) not in self.left_out]
            self.trials[members] = _try_with_matches(self.evidence, members, kept)
        trial = self.trials[members]
        inside = (trial.describe(gap, pair) for pair, gap in self.gaps.items() if gap.joined and pair in pairs)
        return trial.contradiction or next(filter(None, (_unsure(gap, self.limits) for gap in inside)), None)

    def merge_groups(self) -> list[tuple[int, ...]]:
        """Bring groups together by the surest gaps, one after the other, where all that ties them suits."""
        groups: dict[int, tuple[int, ...]] = {k: (k,) for k in range(len(self.evidence.submodels))}
        joined = [pair for pair, gap in self.gaps.items() if gap.joined]
        for pair in sorted(joined, key=lambda pair: self.gaps[pair].sigma_m or 0.0):
            first, second = (groups[k] for k in pair)
            if first == second:
                continue
            members = tuple(sorted(first + second))
            why_not = self.try_group(members)
            if why_not is not None:
                reason = Fact("group-not-joined", why=why_not)
                self.gaps[pair] = replace(self.gaps[pair], joined=False, reason=reason)
                continue
            groups |= dict.fromkeys(members, members)
            trial = self.trials[members]
            self.left_out |= trial.left_out
            left_out = frozenset(self.left_out & set(combinations(members, 2)))
            self.trials[members] = replace(trial, left_out=left_out)
        return list(dict.fromkeys(group for group in groups.values() if len(group) > 1))

    def joined_group(self, members: tuple[int, ...]) -> JoinedGroup:
        """A group as it was placed; its gaps say so."""
        trial, submodels = self.trials[members], self.evidence.submodels
        assert trial.placed is not None
        for pair in set(combinations(members, 2)) & self.gaps.keys():
            gap = trial.describe(self.gaps[pair], pair)
            reason = trial.reason(gap, pair) if gap.joined else Fact("gap-joined-by-others")
            self.gaps[pair] = replace(gap, joined=True, reason=reason)
        return JoinedGroup(
            members=members,
            placed=trial.placed,
            shared=tuple(among(self.evidence.shared, members)),
            matched=frozenset((submodels[a].number, submodels[b].number) for a, b in map(pair_of, trial.matched)),
        )


def join_submodels(
    submodels: Sequence[FittedSubmodel],
    imu: ImuRecording,
    limits: JoinOptions,
    placed_images: Sequence[PlacedImages] = (),
) -> Joined:
    """Join submodels whose relative poses are known accurately enough.

    Pairs first; then the most accurate pairs merge their groups, one after the other, where all constraints between
    the submodels of both are consistent.

    Parameters
    ----------
    submodels
        The largest one first: each joined model has the world of its first submodel.
    imu
        The IMU recording, as it was read.
    limits
        Up to where gaps are closed.
    placed_images
        Images of one submodel that matches place in another. They count beside the IMU, and where they agree with it:
        what looks the same may be a copy.
    """
    if len(submodels) < 2:
        return Joined()
    evidence = Evidence.of(submodels, imu, placed_images)
    judgement = _Judgement(evidence, limits)
    ties = {*map(pair_of, evidence.links), *map(pair_of, evidence.shared), *evidence.incompatible}
    for pair in sorted(ties):
        judgement.judge_pair(pair)
    groups = tuple(judgement.joined_group(members) for members in judgement.merge_groups())
    return Joined(groups=groups, gaps=tuple(judgement.gaps.values()))


def _select_ties(
    ties: Sequence[ImuLink] | Sequence[SimilarityConstraint], pair: Pair
) -> list[ImuLink | SimilarityConstraint]:
    return [tie for tie in ties if pair_of(tie) == pair]


def _count_images(constraints: Sequence[SimilarityConstraint], pair: Pair) -> int:
    """Number of images of a pair that measured some constraints."""
    return sum(len(constraint.images) for constraint in constraints if pair_of(constraint) == pair)


def _gap(evidence: Evidence, pair: Pair) -> Gap:
    """The gap between two submodels, before it is judged."""
    submodels = evidence.submodels
    links = [link for link in evidence.links if pair_of(link) == pair]
    shortest = min(links, key=lambda link: link.seconds(submodels), default=None)
    (first, second), seconds = pair, 0.0
    if shortest is not None:
        first, second = shortest.first, shortest.second
        before, after = end_images(submodels, shortest)
        seconds = float(submodels[second].trajectory.t_s[after] - submodels[first].trajectory.t_s[before])
    if shortest is None or overlaps(submodels, shortest):
        begin_s, end_s = (f(float(submodels[k].trajectory.t_s[i]) for k in pair) for f, i in ((max, 0), (min, -1)))
        seconds = begin_s - end_s
    return Gap(
        first=submodels[first].number,
        second=submodels[second].number,
        seconds=seconds,
        shared_images=_count_images(evidence.shared, pair),
        joined=False,
        reason=Fact("gap-not-judged"),
    )


def _try_with_matches(evidence: Evidence, members: Sequence[int], matched: Sequence[SimilarityConstraint]) -> Trial:
    """Place some submodels by all that ties them and by matches; without those of pairs that contradict the rest."""
    inside = [constraint for constraint in matched if constraint.first in members and constraint.second in members]
    if inside:
        trial = _try(evidence, members, inside)
        if not trial.contradiction:
            return trial
    best = _try(evidence, members)
    pairs = {pair_of(constraint) for constraint in inside}
    if len(pairs) > 1 and not best.contradiction:
        # pairs that were tried by themselves agree with what ties them: they come first, then what shows most
        tied = {*map(pair_of, evidence.usable), *map(pair_of, evidence.shared)}
        for pair in sorted(pairs, key=lambda pair: (pair not in tied, -_count_images(inside, pair), pair)):
            trial = _try(
                evidence,
                members,
                (*best.matched, *(constraint for constraint in inside if pair_of(constraint) == pair)),
            )
            best = best if trial.contradiction else trial
    return replace(best, left_out=frozenset(pairs - {pair_of(constraint) for constraint in best.matched}))


def _try(evidence: Evidence, members: Sequence[int], matched: Collection[SimilarityConstraint] = ()) -> Trial:
    """Place some submodels by all that ties them, and see whether it agrees."""
    submodels = [evidence.submodels[k] for k in members]
    links = among(evidence.usable, members)
    images = among([*evidence.shared, *matched], members)
    ties: list[ImuLink | SimilarityConstraint] = [*links, *images]
    if any(mounting_differs(submodels[i], submodels[j]) for i, j in {pair_of(constraint) for constraint in ties}):
        return Trial(contradiction=Fact("other-mounting"))
    if any(clocks_differ(submodels, link) for link in links):
        return Trial(contradiction=Fact("other-imu"))
    problem = Problem(submodels, evidence.streams, links, images)
    device_dof, device_chi2 = DEVICE_DOF * (len(members) - 1) + LINK_DOF * len(links), 0.0
    try:
        device_chi2 = place_submodels(problem, by_imu=False).squares
        placed = place_submodels(problem)
    except np.linalg.LinAlgError:
        differs = device_chi2 > chi2_limit(device_dof, real=True)
        return Trial(contradiction=Fact("other-imu" if differs else "no-pose-fits"))
    # heading and place are all that submodels do not know of each other
    dof = max(1, round(9 * len(links) + sum(constraint.equations for constraint in images)) - 4 * (len(members) - 1))
    chi2 = max(0.0, placed.squares - device_chi2)
    inflation = max(1.0, chi2 / dof, device_chi2 / device_dof) * times_counted(submodels)
    placed = replace(placed, inflation=inflation)
    sigmas: dict[Pair, tuple[float, float]] = {}
    farthest = 0.0
    for tie, misfit in zip(
        ties, [*placed.misfits, *(_misfit(placed, constraint) for constraint in images)], strict=True
    ):
        cov = tie_cov(submodels, placed, tie)
        farthest = max(farthest, float(misfit @ np.linalg.solve(cov, misfit)))
        a, b = pair_of(tie)
        pair = members[a], members[b]
        sigmas[pair] = tuple(np.maximum(sigmas.get(pair, (0.0, 0.0)), worst_sigmas(cov)).tolist())
    why: Fact | None = None
    if device_chi2 > chi2_limit(device_dof, real=True):
        why = Fact("other-imu")
    elif chi2 > chi2_limit(dof, real=True):
        why = Fact("gap-motion-contradicts", chi2=chi2, dof=dof)
    elif farthest > chi2_limit(POSE_DOF, real=False):
        why = Fact("gap-poses-contradict", sigmas=farthest**0.5)
    return Trial(placed=placed, chi2=chi2, dof=dof, sigmas=sigmas, contradiction=why, matched=tuple(matched))


def _misfit(placed: Placed, constraint: SimilarityConstraint) -> Array:
    """(6,) by how much images contradict where submodels lie: rotation and position along the world's axes."""
    (away, _), turn = constraint.residual(placed.places), placed.places.rotation[constraint.first]
    return np.concatenate([turn @ away[1:4], placed.places.scale[constraint.first] * turn @ away[4:]])


def _why_unlinked(evidence: Evidence, pair: Pair) -> Fact:
    links = [link for link in evidence.links if pair_of(link) == pair]
    near = [link for link in links if link.seconds(evidence.submodels) <= LIMITS.longest_s]
    if not near:
        return Fact("gap-too-long", longest_s=LIMITS.longest_s)
    silent = min(silent_s(evidence.submodels, evidence.streams, link) for link in near)
    return Fact("gap-without-imu", silent_s=silent)


def _unsure(gap: Gap, limits: JoinOptions) -> Fact | None:
    """The part of a relative pose across a gap that is too uncertain; ``None`` where none is."""
    assert gap.sigma_m is not None and gap.sigma_deg is not None
    if gap.sigma_m > limits.sigma_m:
        return Fact("gap-position-unsure", sigma_m=gap.sigma_m, limit_m=limits.sigma_m)
    if gap.sigma_deg > limits.sigma_deg:
        return Fact("gap-direction-unsure", sigma_deg=gap.sigma_deg, limit_deg=limits.sigma_deg)
    return None
