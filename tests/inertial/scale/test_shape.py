"""Faults in the shape of a model: breaks, drifts, strains."""

import numpy as np
import pytest

from colmap_inertial.inertial.scale import _shape
from colmap_inertial.inertial.scale._shape import ShapeFault


def test_a_scale_that_breaks_is_told_by_lengths_and_undone_in_the_part_that_tells_less(subtests):
    for at_s, keeps_after, growth in ((110.0, True, 0.05), (110.0, False, 1 / 1.05 - 1), (150.0, False, 1 / 1.05 - 1)):
        with subtests.test(at_s=at_s, keeps_after=keeps_after):
            t_s = np.linspace(100.0, 160.0, 61)
            truth = np.stack([3 * np.sin(0.1 * t_s), 0.05 * t_s, np.cos(0.2 * t_s)], axis=1)
            # metres per unit are 5 % more behind the break, where lengths of the model are that much shorter
            longer = np.where(t_s[1:] <= at_s, 1.0, 1 / 1.05)
            model = np.concatenate([truth[:1], truth[0] + np.cumsum(np.diff(truth, axis=0) * longer[:, None], axis=0)])
            value, cov = np.array([np.log(1.05)]), np.array([[(0.02 / 1.96) ** 2]])
            fault = ShapeFault(
                kind="break", value=value, cov=cov, by_scale=np.zeros(1), at_s=at_s + 0.1, keeps_after=keeps_after
            )
            said = fault.as_fact(t_s, 1.0)
            assert said.code == "scale-breaks" and said.values["first"] == keeps_after
            assert said.values["growth"] == pytest.approx(growth)
            assert said.values["sigma"] == pytest.approx(0.02 / 1.96)
            assert said.values["since_s"] == pytest.approx(at_s + 0.1 - 100.0)
            # either part is as large as in the one that keeps its metres
            steps = np.diff(fault.undo(t_s, model), axis=0) / np.diff(truth, axis=0)
            assert steps == pytest.approx(np.full_like(steps, longer[-1] if keeps_after else 1.0), rel=1e-9)


def test_a_drift_of_the_scale_is_undone_and_told_from_end_to_end():
    t_s = np.linspace(0.0, 80.0, 81)
    truth = np.stack([np.sin(0.1 * t_s), 0.05 * t_s, np.cos(0.2 * t_s)], axis=1)
    middle_s = 0.5 * (t_s[1:] + t_s[:-1])
    log_scale = 0.08 * (middle_s - 40.0) / 80.0
    model = np.cumsum(np.concatenate([truth[:1], np.diff(truth, axis=0) / np.exp(log_scale)[:, None]]), axis=0)
    cov = np.array([[1e-4]])
    fault = ShapeFault(kind="drift", value=np.array([0.08]), cov=cov, by_scale=np.zeros(1))
    assert fault.undo(t_s, model) == pytest.approx(truth, abs=1e-9)
    # more metres per unit at the end: the model's lengths are smaller there
    said = fault.as_fact(t_s, 2.0)
    assert said.code == "scale-grows"
    assert said.values["growth"] == pytest.approx(np.exp(-0.08) - 1)
    assert said.values["sigma"] == pytest.approx(2e-4**0.5)
    tolerated = 0.01
    assert fault.chi2(2.0, tolerated) == pytest.approx(0.08**2 / (2e-4 + tolerated**2))


def test_strains_are_orthonormal_without_trace():
    np.testing.assert_allclose(np.einsum("aij,bij->ab", _shape._STRAINS, _shape._STRAINS), np.eye(5), atol=1e-12)
    np.testing.assert_allclose(np.trace(_shape._STRAINS, axis1=1, axis2=2), 0.0, atol=1e-12)
    np.testing.assert_array_equal(_shape._STRAINS, np.swapaxes(_shape._STRAINS, 1, 2))
