"""Whether intervals hold the truth as often as they say, where windows of one recording count as dependent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

#: Coverage that is stated, and the level of the two-sided test.
STATED, LEVEL = 0.95, 0.01


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Of intervals that hold the truth.

    Attributes
    ----------
    held, count
        How many do, of how many.
    interval
        Clopper and Pearson's (1934) 95 % interval of the share, as if all were independent.
    design
        By how much larger the variance of the share is than that of independent ones (Rao and Scott 1992), at least 1.
    p_value
        Of the stated coverage, two-sided binomial with as many fewer intervals.
    """

    held: int
    count: int
    interval: tuple[float, float]
    design: float
    p_value: float

    def __str__(self) -> str:
        low, high = (100 * bound for bound in self.interval)
        verdict = "rejected" if self.p_value < LEVEL else "not rejected"
        return (
            f"{self.held} of {self.count} ({100 * self.held / self.count:.1f} %, {low:.1f} to {high:.1f}); "
            f"design effect {self.design:.1f}, p {self.p_value:.3f}: {100 * STATED:.0f} % {verdict}"
        )


def measure_coverage(held: Mapping[str, Sequence[bool]]) -> Coverage | None:
    """Coverage of intervals, by recording; ``None`` without any."""
    from scipy.stats import beta, binomtest

    sizes = np.array([len(of) for of in held.values()], dtype=float)
    counts = np.array([sum(of) for of in held.values()], dtype=float)
    k, n, clusters = int(counts.sum()), int(sizes.sum()), int(np.sum(sizes > 0))
    if n == 0:
        return None
    share, design = k / n, 1.0
    if clusters > 1 and 0 < k < n:
        between = clusters / (clusters - 1) * float(np.sum((counts - share * sizes) ** 2)) / n**2
        design = max(1.0, between / (share * (1 - share) / n))
    low = float(beta.ppf(0.025, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    fewer = max(1, round(n / design))
    p_value = float(binomtest(min(fewer, round(k / design)), fewer, STATED).pvalue)
    return Coverage(held=k, count=n, interval=(low, high), design=design, p_value=p_value)
