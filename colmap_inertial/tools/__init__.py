"""Batch, viewer, export, simulator."""
