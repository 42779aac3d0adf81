"""How the camera turned and where its clock stands: pixels, gyroscope, alignment, smoothing."""
