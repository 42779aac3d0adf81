"""Orientations, tracks and two-view rotations of images before there is a model."""
