"""COLMAP's work: features, matching, mapping, dense reconstruction."""
