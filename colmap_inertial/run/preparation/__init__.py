"""Decisions before the reconstruction: the check, frames to use, calibration, treatment of frames."""
