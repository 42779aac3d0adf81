"""COLMAP's own steps: features, matches, mapping, dense."""
