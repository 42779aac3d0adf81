"""Rotation and clock of the camera: pixels, gyroscope, alignment, smoothing."""
