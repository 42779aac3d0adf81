"""Estimators that use the accelerometer: scale, refinement, joining, calibration at rest."""
