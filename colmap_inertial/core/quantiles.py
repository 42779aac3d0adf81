"""Quantiles of the normal distribution."""

#: Two-sided, 95 per cent.
Z95 = 1.959963984540054
