"""Pairs of images to match."""
