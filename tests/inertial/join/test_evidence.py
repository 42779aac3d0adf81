"""What speaks for and against submodels being of one recording: against closed forms and brute force."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from colmap_inertial.core.geometry import so3_exp, so3_log
from colmap_inertial.inertial.core.priors import PRIORS
from colmap_inertial.inertial.join import evidence, grouping
from colmap_inertial.inertial.join.evidence import chi2_limit, clocks_differ, mounting_differs, overlaps, times_counted
from colmap_inertial.inertial.join.placement import ImuLink
from colmap_inertial.inertial.scale import posterior as post
from tests.helpers.cases import loop_over


@loop_over("dof", [1, 2, 6, 9, 15, 60])
def test_the_limit_is_the_quantile_of_chi_square(dof):
    exact = stats.chi2.isf(stats.norm.sf(4.0), dof)
    # the root is not quite normal so far out
    assert chi2_limit(dof, real=False) == pytest.approx(exact, rel=0.1 / np.sqrt(dof))
    assert chi2_limit(dof, real=True) == 2 * chi2_limit(dof, real=False)


def submodel(nodes_s, *, names=(), cameras=(), fit=None):
    path = SimpleNamespace(nodes_s=np.asarray(nodes_s, dtype=float), at=lambda nodes: fit)
    return SimpleNamespace(path=path, trajectory=SimpleNamespace(names=names), cameras=frozenset(cameras))


def test_readings_of_an_overlap_count_as_often_as_they_are_in_a_fit():
    rng = np.random.default_rng(4)
    for _ in range(20):
        begin = rng.integers(0, 60, 4)
        spans = [(int(b), int(b + length)) for b, length in zip(begin, rng.integers(1, 40, 4), strict=True)]
        seconds = [second for b, e in spans for second in range(b, e)]
        found = times_counted([submodel([b, (b + e) / 2, e]) for b, e in spans])
        assert found == pytest.approx(len(seconds) / len(set(seconds)))


@loop_over(
    ("begin_s", "expected"),
    # nodes a tenth apart: one that ends while the other begins; a node in between; beside it, one and three steps away
    [(0.95, True), (1.05, False), (1.3, False), (0.35, True)],
)
def test_submodels_overlap_where_one_goes_on_while_the_other_comes(begin_s, expected):
    first = submodel(np.arange(0, 1.01, 0.1))
    second = submodel(begin_s + np.arange(0, 1.01, 0.1))
    before = int(np.searchsorted(first.path.nodes_s, begin_s) - 1)
    link = ImuLink(first=0, second=1, from_node=before, to_node=0)
    assert overlaps([first, second], link) == expected


def fitted(rng, size=15 + 60):
    root = rng.standard_normal((size, size)) / np.sqrt(size)
    return root @ root.T


def test_mountings_differ_by_the_mahalanobis_distance_of_both():
    rng = np.random.default_rng(8)
    cov = 1e-6 * fitted(rng)
    mounting = cov[-6:, -6:]
    direction = rng.standard_normal(6)
    direction /= np.sqrt(direction @ np.linalg.solve(2 * mounting, direction))
    turn, lever = so3_exp(np.array([0.4, -1.0, 0.2])), np.array([0.1, 0.0, -0.2])
    for share, differs in ((0.98, False), (1.02, True)):
        away = share * np.sqrt(chi2_limit(6, real=True)) * direction
        one = SimpleNamespace(cam_from_imu=so3_exp(away[:3]) @ turn, imu_in_cam_m=lever + away[3:], cov=cov)
        other = SimpleNamespace(cam_from_imu=turn, imu_in_cam_m=lever, cov=cov)
        assert mounting_differs(submodel([0], fit=one), submodel([0], fit=other)) == differs


def test_clocks_differ_by_what_delays_and_their_rates_leave(subtests):
    """Variance of the difference of two predicted stamps, by drawing what is predicted from."""
    for gap_s in (0.1, 40.0):
        with subtests.test(gap_s=gap_s):
            rng = np.random.default_rng(3)
            own = post.NODE + np.array([post.DELAY, post.CLOCK_RATE])
            covs = [1e-6 * fitted(rng) for _ in range(2)]
            since_s = (3.0, -2.0)
            drawn = [rng.multivariate_normal(np.zeros(2), cov[np.ix_(own, own)], 200_000) for cov in covs]
            off = [d[:, 0] + d[:, 1] * since for d, since in zip(drawn, since_s, strict=True)]
            drift = rng.normal(0, PRIORS.clock_rate * gap_s, 200_000)
            sigma = float(np.std(off[1] - off[0] + drift))
            for share, differs in ((0.97, False), (1.03, True), (-0.97, False), (-1.03, True)):
                away = share * sigma * np.sqrt(chi2_limit(1, real=True))
                fits = [
                    SimpleNamespace(
                        since_middle_s=np.array([since]),
                        cov=cov,
                        stamp_s=np.array([at + 100.0 + more]),
                        t_s=np.array([at]),
                    )
                    for since, cov, at, more in zip(since_s, covs, (1.0, 1.0 + gap_s), (0.0, away), strict=True)
                ]
                both = [submodel([1.0], fit=fits[0]), submodel([1.0 + gap_s], fit=fits[1])]
                assert clocks_differ(both, ImuLink(first=0, second=1, from_node=0, to_node=0)) == differs


def test_images_that_agree_are_those_of_a_loop_over_all():
    rng = np.random.default_rng(1)
    turn, shift = so3_exp(np.array([0.3, 0.8, -0.1])), np.array([4.0, 1.0, -2.0])
    own = rng.standard_normal((15, 3))
    rotations = np.array([turn @ so3_exp(2e-3 * rng.standard_normal(3)) for _ in range(15)])
    centres = own @ turn.T + shift + 0.01 * rng.standard_normal((15, 3))
    rotations[2] = rotations[2] @ so3_exp(np.array([0.0, 0.1, 0.0]))
    centres[9] += [0.0, 0.3, 0.0]
    agree, middle = evidence._agreeing(rotations, centres, own)
    assert np.flatnonzero(~agree).tolist() == [2, 9]
    medians = [np.median([np.linalg.norm(so3_log(a.T @ b)) for b in rotations]) for a in rotations]
    np.testing.assert_array_equal(middle, rotations[int(np.argmin(medians))])


@loop_over(
    ("shared", "cameras", "agree", "why"),
    [
        (0, ("a", "a"), False, None),
        (0, ("a", "b"), False, "different cameras"),
        (0, ("", "b"), False, None),
        (8, ("a", "a"), True, None),
        (9, ("a", "a"), True, "two models of the same part"),
        (2, ("a", "a"), False, None),
        (3, ("a", "a"), False, "different relative poses"),
        (3, ("a", "a"), True, None),
    ],
)
def test_pairs_that_cannot_be_one_model(shared, cameras, agree, why):
    names = [[f"{i}" for i in range(10)], [f"{i}" for i in range(10 - shared, 30 - shared)]]
    both = [submodel([0], names=n, cameras=filter(None, [c])) for n, c in zip(names, cameras, strict=True)]
    constraints = [SimpleNamespace(first=0, second=1)] if agree else []
    found = evidence.incompatible_pairs(both, constraints)
    assert (why is None and found == {}) or why in str(found[0, 1])


@loop_over(
    ("sigma_m", "sigma_deg", "code"),
    [(0.1, 1.0, None), (0.1001, 1.0, "gap-position-unsure"), (0.1, 1.001, "gap-direction-unsure")],
)
def test_a_gap_is_closed_up_to_the_limits(sigma_m, sigma_deg, code):
    gap = SimpleNamespace(sigma_m=sigma_m, sigma_deg=sigma_deg)
    found = grouping._unsure(gap, SimpleNamespace(sigma_m=0.1, sigma_deg=1.0))
    assert (None if found is None else found.code) == code
