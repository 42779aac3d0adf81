"""Bundle adjustment with the IMU and the rolling shutter in it."""
