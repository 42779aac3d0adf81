"""Sub-models of one recording in one world, by what the IMU felt between them."""
