"""Depth maps, their fusion, and a mesh."""
