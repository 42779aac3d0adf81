"""Metres per model unit from inertial data."""
