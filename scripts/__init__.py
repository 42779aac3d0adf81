"""Benchmarks, studies, examples and tools of the checkout; not part of what is installed."""
