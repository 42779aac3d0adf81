"""Quantiles."""

import pytest
from scipy.stats import norm

from colmap_inertial.core.quantiles import Z95


def test_ninety_five_per_cent_of_a_normal_distribution_lie_within():
    assert norm.cdf(Z95) - norm.cdf(-Z95) == pytest.approx(0.95, abs=1e-12)
