"""Reconstruction, from a recording to a result."""
